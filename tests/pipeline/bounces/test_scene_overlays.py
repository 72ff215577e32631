"""Flat bodies that cover others: which patches they cover, and that bodies before both see the flat one."""

import numpy as np
import pytest

import warpshadow as ws
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.bodies.reflectance import Materials
from warpshadow.pipeline.bounces.patches import ScenePatches
from warpshadow.pipeline.bounces.scene_overlays import find_overlays

WHITE = (0.8, 0.8, 0.8)


def slab(**options):
    points = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32) - 0.5
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [triangle for a, b, c, d in faces for triangle in ((a, b, c), (a, c, d))]
    mesh = ws.Mesh(points * np.float32((2.4, 0.12, 2.4)), triangles)
    return ws.Body(mesh, albedo=(0.1, 0.1, 0.1), translation=(0, 0.06, 0), name="frame", **options)


def squares(height=0.121, **options):
    return ws.Body(ws.plane(2.0, 4), albedo=WHITE, translation=(0, height, 0), name="squares", **options)


def ball(**options):
    return ws.Body(ws.icosphere(0.3, 2), albedo=WHITE, translation=(0, 0.45, 0), name="ball", **options)


def covers(*bodies):
    scene = ws.Scene([*bodies], ws.synthetic_sky(), ws.Camera.look_at((0, 3, 8), (0, 1, 0), size=(8, 8)))
    merged_scene = MergedScene(scene)
    senders = ScenePatches(merged_scene).senders(Materials.of_scene(merged_scene))
    return senders, find_overlays(senders, np.full(len(senders.areas), 0.5))


@pytest.mark.parametrize("rotation", [(0, 0, 0), (180, 0, 0)])
def test_a_slab_below_a_flat_body_on_which_another_stands_is_covered(rotation):
    senders, found = covers(slab(), squares(rotation=rotation), ball())
    is_covered = found.distances > 0
    assert set(senders.body_of_patch[is_covered]) == {0}
    assert 0.8 * 4 < senders.areas[is_covered].sum() < 2.4**2
    np.testing.assert_allclose(found.before.sum(axis=1).ravel()[0, is_covered], 1, rtol=1e-6)
    assert covers(slab(), squares(rotation=rotation))[1] is None  # nobody sees it


def test_a_slab_on_a_ground_and_one_far_below_a_flat_body_are_not_covered():
    ground = ws.Body(ws.plane(6.0), albedo=WHITE, name="ground")
    assert covers(slab(), ground, ball())[1] is None
    assert covers(slab(), squares(height=0.4), ball())[1] is None
