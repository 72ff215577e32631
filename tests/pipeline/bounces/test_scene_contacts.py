"""Contacts of scenes: bodies that touch as the scene has them."""

import numpy as np
import pytest
import trimesh

import warpshadow as ws
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.bounces.contacts import find_contacts
from warpshadow.pipeline.bounces.patches import ScenePatches


def contacts_of(*bodies):
    return find_contacts(MergedScene(ws.Scene(list(bodies), ws.synthetic_sky())))


def ball(**pose):
    return ws.Body(ws.icosphere(1.0, 4), **pose)


def box() -> ws.Mesh:
    shape = trimesh.creation.box()
    return ws.Mesh(shape.vertices, shape.faces)


def test_a_ball_on_a_ground_touches_it_at_its_foot():
    """In each one's own frame."""
    on_ground = ball(scale=2.0, translation=(1, 2, 3), rotation=(0, 0, 90))
    (of_ball,), (of_ground,) = contacts_of(on_ground, ws.Body(ws.plane(8.0, 1), translation=(0.5, 0, 0)))
    foot = on_ground.from_world(np.array([1.0, 0, 3]))
    assert np.linalg.norm(of_ball.points - foot, axis=1).max() < 0.1
    assert np.linalg.norm(of_ground.points - [0.5, 0, 3], axis=1).max() < 0.2
    assert of_ball.half_size == pytest.approx(1) and of_ground.half_size == pytest.approx(2)


def test_two_balls_touch_between_them():
    (first,), (second,) = contacts_of(ball(translation=(-1, 0, 0)), ball(translation=(1, 0.0, 0)))
    assert np.linalg.norm(first.points - [1, 0, 0], axis=1).max() < 0.12
    assert np.linalg.norm(second.points - [-1, 0, 0], axis=1).max() < 0.12


@pytest.mark.parametrize(
    "bodies",
    [
        (ball(translation=(0, 1.05, 0)), ws.Body(ws.plane(8.0, 1))),
        (ball(translation=(6, 1, 0)), ws.Body(ws.plane(8.0, 1))),
        (ball(translation=(0, 0.8, 0)), ws.Body(ws.plane(8.0, 1))),
        (ws.Body(ws.plane(1.0, 6)), ws.Body(ws.plane(8.0, 1))),
        (ws.Body(box(), translation=(0, 0.5, 0)), ws.Body(ws.plane(8.0, 1))),
        (ws.Body(box(), translation=(0, 0.5, 0), rotation=(0, 0, 30)), ws.Body(box(), translation=(0, -0.3, 0))),
    ],
    ids=["above it", "beside it", "sticks in it", "flat on it", "stands on it", "an edge in it"],
)
def test_other_bodies_have_no_contact(bodies):
    assert contacts_of(*bodies) == [[], []]


def texel_width(*others: ws.Body) -> float:
    """Width of the texel of a ground that is nearest to the foot of a ball at (-1, 1, 0), beside other bodies."""
    ground = ws.Body(ws.plane(16.0, 1))
    patches = ScenePatches(MergedScene(ws.Scene([ground, ball(translation=(-1, 1, 0)), *others], ws.synthetic_sky())))
    of_ground = patches.of_body(0)
    return float(np.sqrt(of_ground.areas[np.linalg.norm(of_ground.centers - [-1, 0, 0], axis=1).argmin()]))


@pytest.mark.parametrize(
    "others",
    [[ball(translation=(2, 1, 0))], [ws.Body(box(), translation=(x, 0.5, 0)) for x in (-6, 6)]],
    ids=["two contacts", "a small body"],
)
def test_texels_are_small_around_the_one_contact_of_a_large_body_alone(others):
    apart = [ball(translation=(2, 3, 0))]
    assert texel_width() < 0.03 and texel_width(*apart) < 0.03
    assert texel_width(*others) > 0.2
