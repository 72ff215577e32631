"""Where bodies stand: on a ground, and what is remarked on where they do not."""

import dataclasses
import re
import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import warpshadow as ws
from warpshadow.scene.remarks import enclosures, misplacements

LIGHT = np.ones((4, 3))
GROUND = ws.Body(ws.plane(20.0, 2), name="ground", translation=(0, -1, 0))


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 3, 2)])
def test_a_body_stands_on_the_ground_as_it_is_turned(shape):
    body = ws.Body(
        ws.icosphere(0.7, 2).transformed(scale=shape, translation=(9, 9, 9)),
        rotation=(10, 200, 40),
        translation=(5, 6, 7),
        scale=2.0,
        albedo=(0.1, 0.2, 0.3),
    )
    for foot in ((0.0, 0.0, 0.0), (3.0, -1.0, 2.0)):
        standing = body.on_ground(foot)
        points = standing.world_mesh().positions
        low, high = points.min(axis=0), points.max(axis=0)
        np.testing.assert_allclose([(low + high)[0] / 2, low[1], (low + high)[2] / 2], foot, atol=1e-5)
        assert standing.mesh is body.mesh and standing.scale == body.scale  # so its spheres stay
        np.testing.assert_array_equal(standing.rotation, body.rotation)
        np.testing.assert_array_equal(standing.albedo, body.albedo)


def test_a_body_is_scaled_to_a_size_as_it_is_put_on_the_ground():
    mesh = ws.icosphere(0.7, 2).transformed(scale=(1, 3, 2), translation=(9, 9, 9))
    for rotation in ((0, 0, 0), (90, 0, 0)):
        points = ws.Body(mesh, scale=5.0, rotation=rotation).on_ground(size=2.5).world_points()
        assert np.ptp(points, axis=0).max() == pytest.approx(2.5)
        assert points[:, 1].min() == pytest.approx(0.0, abs=1e-12)


def test_a_body_that_is_turned_before_it_stands_has_the_same_size_and_place():
    """So two that differ by a turn about the vertical through their middle stand in each other's place."""
    mesh = ws.Mesh([(0, 0, 0), (2, 0, 0), (0, 1, 0), (0, 0, 1)], [(0, 1, 2), (0, 2, 3)])
    straight, turned = (ws.Body(mesh, rotation=(0, angle, 0)).on_ground((3, 0, 1), size=5.0) for angle in (0, 25))
    middle = np.mean(mesh.bounds, axis=0)
    for body in (straight, turned):
        assert body.scale == 2.5
        stands = body.to_world(middle)
        np.testing.assert_allclose(stands, (3, 1.25, 1), atol=1e-12)


@pytest.mark.parametrize(("name", "options"), [("size", {"size": 0}), ("foot", {"foot": (0, 1)})])
def test_standing_names_the_argument_it_refuses(name, options):
    with pytest.raises(ValueError, match=f"^{name}: got"):
        ws.Body(ws.icosphere()).on_ground(**options)


def test_a_mesh_whose_vertices_coincide_is_not_scaled():
    point = ws.Body(ws.Mesh(np.ones((3, 3)), [[0, 1, 2]]), name="point")
    with pytest.raises(ValueError, match=r"size: got 2 for a mesh \('point'\) whose vertices coincide"):
        point.on_ground(size=2)
    assert np.array_equal(point.on_ground().translation, [-1, -1, -1])


def test_the_world_points_of_a_body_are_those_of_its_mesh_in_the_world():
    body = ws.Body(ws.icosphere(0.7, 2), rotation=(10, 200, 40), translation=(5, 6, 7), scale=2.0)
    np.testing.assert_allclose(body.world_points(), body.world_mesh().positions, rtol=1e-6)


def ball(height, **options):
    return ws.Body(ws.icosphere(0.5, 1), translation=(0, height, 0), name="ball", **options)


@pytest.mark.parametrize(
    ("height", "said"), [(-0.5, None), (0.4, None), (0.6, "floats 1.1 above"), (-1.4, None), (-1.6, "lies 1.1 below")]
)
def test_a_body_that_floats_or_lies_below_by_more_than_its_size_is_remarked_on(height, said):
    remarks = misplacements(ws.Scene([GROUND, ball(height)], LIGHT))
    assert len(remarks) == (said is not None)
    if said:
        assert re.match(f"body 1 .*'ball'.*, which is 1 large, {said} body 0 .*'ground'", remarks[0])


@pytest.mark.parametrize(
    "others",
    [
        [],
        [ws.Body(ws.plane(4.0, 2), rotation=(90, 0, 0))],  # a wall
        [ws.Body(ws.plane(4.0, 2), translation=(50, -9, 0))],  # a ground beside it
        [GROUND, ws.Body(ws.icosphere(2.0, 1), translation=(0, 1, 0))],  # on what stands on the ground
    ],
)
def test_a_body_without_a_ground_below_or_on_another_does_not_float(others):
    assert not misplacements(ws.Scene([ball(3.6), *others], LIGHT))


@pytest.mark.parametrize("blockers", [0, 8])
def test_a_lamp_and_its_shade_do_not_float(blockers):
    """But a body beside them does."""
    lamp = ws.Body(ws.icosphere(0.1, 1), translation=(0, 5.2, 0), emission=(9, 9, 9), blockers=blockers)
    shade = ball(5.0, blockers=blockers)
    assert not misplacements(ws.Scene([GROUND, lamp, shade], LIGHT))
    (remark,) = misplacements(ws.Scene([GROUND, lamp, dataclasses.replace(shade, translation=(2, 5, 0))], LIGHT))
    assert "floats" in remark


@pytest.mark.parametrize(("height", "said"), [(-0.5, None), (1.0, "floats 1.5 above body 0")])
def test_a_body_over_a_ground_does_not_lie_below_another(height, said):
    board = ws.Body(ws.plane(4.0, 2), name="board", translation=(0, 3, 0))
    remarks = misplacements(ws.Scene([GROUND, ball(height), board], LIGHT))
    assert [said in remark for remark in remarks] == [True] * (said is not None)
    (remark,) = misplacements(ws.Scene([ball(height), board], LIGHT))
    assert "below body 1 ('board')" in remark


@pytest.mark.parametrize("sides", ["+y -y +x", "+y", "-y"])
def test_walls_of_light_are_no_grounds(sides):
    walls = ws.walls_of_light(ws.EnvironmentMap.constant(1.0), 6.0, sides=sides.split(), texels=2)
    assert not misplacements(ws.Scene([ball(0.0), *walls], LIGHT))


def test_a_body_that_is_broader_than_the_ground_is_remarked_on():
    large = ws.Body(ws.icosphere(150.0, 1), translation=(0, 150, 0), name="cow")
    (remark,) = misplacements(ws.Scene([GROUND, large], LIGHT))
    breadth = float(np.ptp(GROUND.world_points()[:, 0]))
    assert re.match(rf"body 1 \('cow'\) is 300 broad, and body 0 \('ground'\) below it {breadth:.3g}; ", remark)
    for ground in (ws.Body(ws.plane(400.0, 2)), ws.Body(ws.infinite_ground())):  # one of two is large enough
        assert not misplacements(ws.Scene([GROUND, ground, large], LIGHT))


def test_a_body_in_other_units_beside_the_ground_is_remarked_on():
    mug = ws.Body(ws.icosphere(50.0, 1), translation=(1200, 50, 0), name="mug")
    (remark,) = misplacements(ws.Scene([mug, GROUND], LIGHT))
    assert re.match(
        r"body 0 \('mug'\) is 100 broad, and body 1 \('ground'\) beside it 20; on_ground\(size=…\) st", remark
    )
    lamp = ws.Body(ws.icosphere(0.1, 1), translation=(0, 3, 0), emission=(9, 9, 9))
    assert len(misplacements(ws.Scene([mug, lamp, GROUND], LIGHT))) == 1
    assert not misplacements(ws.Scene([mug, ball(0.0), GROUND], LIGHT))  # such as a mountain behind it
    assert not misplacements(ws.Scene([dataclasses.replace(mug, scale=0.1), GROUND], LIGHT))


def camera_at(*eye):
    return ws.Camera.look_at(eye, (9, 9, 9), size=(8, 8))


def test_a_camera_inside_a_body_is_remarked_on():
    body = ws.Body(ws.icosphere(1.0, 2), rotation=(10, 20, 30), translation=(1, 2, 3), scale=4.0, name="cow")
    scene = ws.Scene([GROUND, body], LIGHT)
    outside, inside = camera_at(1, 2, 7.1), camera_at(1, 2, 6.8)
    assert not enclosures(scene, [outside])
    (remark,) = enclosures(scene, [outside, inside])
    assert re.match(r"camera: its eye \(1, 2, 6.8\) is inside body 1 \('cow'\), which is 8 large; Camera.fr", remark)
    corner = camera_at(3.6, 4.6, 5.6)  # within the bounds alone
    assert not enclosures(scene, [corner])


def test_a_room_is_not_around_its_camera():
    outwards = ws.icosphere(1.0, 2)
    inwards = ws.Mesh(outwards.positions, outwards.faces[:, ::-1])
    assert not enclosures(ws.Scene([ws.Body(inwards)], LIGHT), [camera_at(0, 0, 0.1)])


def test_a_renderer_warns_once_of_each_thing_that_is_out_of_place():
    camera = ws.Camera.look_at((0, 0, 5), (0, 5, 20), size=(8, 8))
    scene = ws.Scene([GROUND, ball(30.0, blockers=0)], LIGHT, camera, ws.Visibility("none"))
    renderer = ws.Renderer(scene)
    with pytest.warns(UserWarning) as caught:
        renderer.render()
        renderer.render()
    nothing, floating = [str(item.message) for item in caught]
    assert "shows nothing of the scene: " in nothing and floating.startswith("body 1 ('ball'), which is")


@pytest.mark.parametrize("kind", ["ground", "no ground"])
def test_a_body_that_was_put_on_the_ground_and_framed_gives_no_warning(kind):
    body = ws.Body(ws.icosphere(70.0, 1), blockers=0, translation=(900, 900, 900))
    bodies = [body] if kind == "no ground" else [body.on_ground(size=1), ws.Body(ws.plane(4.0, 4), blockers=0)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        image = ws.render(ws.Scene(bodies, LIGHT, visibility=ws.Visibility("none")))
    assert image[128, 128, 3] == 1


def test_a_ceiling_as_broad_as_its_floor_is_not_remarked_on():
    """Turned, their bounds differ by rounding."""
    turn = Rotation.from_euler("y", np.arange(0, 45, 3)[:, None], degrees=True)
    over = turn * Rotation.from_euler("x", 180, degrees=True)
    for rotation, rotation_over in zip(turn.as_matrix(), over.as_matrix(), strict=True):
        floor = ws.Body(ws.plane((3.0, 4.0)), rotation=rotation)
        ceiling = ws.Body(ws.plane((3.0, 4.0)), rotation=rotation_over, translation=(0, 3, 0))
        assert not misplacements(ws.Scene([floor, ceiling], ws.synthetic_sky(height=8)))
