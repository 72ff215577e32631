"""Remarks on likely mistakes: metals without bounces, a sun below the ground, rotations in radians, other frames."""

import warnings

import numpy as np
import pytest

import warpshadow as ws
from warpshadow.scene.remarks import black_metals, is_out_of_frame, sun_below, unframed

GROUND = ws.Body(ws.plane(4.0, 1), name="ground")
SKY = ws.EnvironmentMap.constant(0.2, height=64)


def gold(**options):
    return ws.Body(ws.icosphere(0.5, 1), albedo=(0.9, 0.6, 0.2), roughness=0.3, name="gold", **options).on_ground()


@pytest.mark.parametrize(
    ("metallic", "bounces", "is_black"), [(1.0, 0, True), (1.0, "all", False), (1.0, 1, False), (0.2, 0, False)]
)
def test_a_metal_beside_others_is_remarked_on_where_light_does_not_bounce(metallic, bounces, is_black):
    scene = ws.Scene([gold(metallic=metallic), GROUND], SKY, bounces=bounces)
    assert bool(black_metals(scene)) == is_black


def test_a_metal_alone_has_nothing_to_mirror():
    assert not black_metals(ws.Scene([gold(metallic=1.0)], SKY))


@pytest.mark.parametrize("draw", [ws.render, lambda scene: ws.Renderer(scene).render()])
def test_stills_and_renderers_name_the_metal_and_say_what_to_write(draw):
    camera = ws.Camera.framing(gold(), size=(16, 16))
    with pytest.warns(UserWarning, match=r"body 0 \('gold'\) is of metal.*got bounces=0; Scene\(…, bounces=\"all\"\)"):
        draw(ws.Scene([gold(metallic=1.0), GROUND], SKY, camera))


@pytest.mark.parametrize(("height", "is_below"), [(-0.5, True), (0.3, False), (0.0, False)])
def test_a_sun_below_a_ground_is_remarked_on(height, is_below):
    light = SKY.with_sun((0.6, height, 0.3), irradiance=3.0)
    remarks = sun_below(ws.Scene([gold(), GROUND], light))
    assert bool(remarks) == is_below
    assert not is_below or "(0.72, -0.6, 0.36), below body 1 ('ground')" in remarks[0]
    assert not sun_below(ws.Scene([gold()], light))  # nothing keeps its light from the body
    assert not sun_below(ws.Scene([GROUND], light))  # nor is there a body that it could be kept from


TWO_SUNS = SKY.with_sun((0.4, 0.9, -0.3), irradiance=3.0).with_sun((0.1, -0.8, 0.6), irradiance=3.1)


@pytest.mark.parametrize("light", [SKY, ws.synthetic_sky(), ws.EnvironmentMap.constant(0.0), TWO_SUNS])
def test_light_without_a_low_sun_draws_no_remark(light):
    assert not sun_below(ws.Scene([gold(), GROUND], light))


@pytest.mark.parametrize("rotation", [(0, 1.57, 0), (0, 0, -np.pi), (0.785398, 0, 0), (0, 4.712, 0)])
def test_a_rotation_by_eighths_of_a_turn_in_radians_draws_a_warning(rotation):
    degrees = ", ".join(f"{round(number / 0.785) * 45}" for number in rotation)
    with pytest.warns(UserWarning, match=rf"rotation: got .*expected degrees; .*\({degrees}\) is meant"):
        ws.Body(ws.icosphere(0.5, 1), rotation=rotation)


def test_a_body_that_is_stood_on_the_ground_warns_of_radians_once():
    with pytest.warns(UserWarning, match="expected degrees") as said:
        ws.Body(ws.icosphere(0.5, 1), rotation=(0, 1.57, 0)).on_ground(size=2)
    assert len(said) == 1


@pytest.mark.parametrize(
    ("eye", "target", "is_unframed"),
    [
        ((0, 1, 4), (0, 0.5, 0), False),
        ((0, 1, 4), (0, 1, 8), True),  # the ball is behind it
        ((0, 3, 0), (1.3, 0, 0), False),  # the ball's shadow may be meant
        ((0, 1, 4), (9, 1, 4), True),
    ],
)
def test_a_camera_that_sees_the_ground_alone_is_remarked_on(eye, target, is_unframed):
    camera = ws.Camera.look_at(eye, target, fov_y=20, size=(16, 16))
    remarks = unframed(ws.Scene([gold(), GROUND], SKY), [camera])
    assert bool(remarks) == is_unframed
    assert not is_unframed or "got one that sees the ground alone, expected 'gold' in its frame" in remarks[0]
    assert not unframed(ws.Scene([GROUND, ws.point_light((0, 9, 0), 5.0)], SKY), [camera])


def test_a_renderer_says_that_its_camera_sees_an_endless_ground_alone():
    camera = ws.Camera.look_at((0, 1, 4), (0, 0.5, 8), size=(16, 16))
    scene = ws.Scene([gold(), ws.Body(ws.infinite_ground(6.0), name="ground")], SKY, camera, bounces="all")
    with pytest.warns(UserWarning, match="camera: got one that sees the ground alone") as said:
        ws.render(scene)
    assert len(said) == 1


def test_points_on_several_sides_of_a_frame_may_be_a_body_in_it():
    camera = ws.Camera.look_at((0, 0, 4), (0, 0, 0), fov_y=10, size=(16, 16))
    assert not is_out_of_frame(ws.Body(ws.plane(9.0, 1), rotation=(90, 0, 0)), camera)  # all its corners are outside
    assert is_out_of_frame(ws.Body(ws.icosphere(0.3, 1), translation=(0, 0.7, 0)), camera)
    assert not is_out_of_frame(ws.Body(ws.icosphere(0.3, 1), translation=(0, 0.7, 0)), camera, 3.0)


@pytest.mark.parametrize(
    "rotation", [(0, 90, 0), (0, 1.5, 0), (0, 3, 0), (0, 5.5, 0), (0.9, 1.57, 0.2), np.eye(3), (0, 0, 0)]
)
def test_other_rotations_draw_none(rotation):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ws.Body(ws.icosphere(0.5, 1), rotation=rotation)
