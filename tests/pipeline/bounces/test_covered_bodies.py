"""Which bodies are said to hide the light of flat ones before them."""

import numpy as np
import pytest

import warpshadow as ws
from warpshadow.pipeline.bounces.covered import covered_bodies


def slab(size, **options):
    points = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32) - 0.5
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [triangle for a, b, c, d in faces for triangle in ((a, b, c), (a, c, d))]
    return ws.Body(ws.Mesh(points * np.float32(size), triangles), albedo=(0.5, 0.5, 0.5), **options)


def scene(*bodies):
    return ws.Scene([*bodies, ws.Body(ws.plane(6.0), name="ground")], ws.synthetic_sky())


BALL = ws.Body(ws.icosphere(0.3, 2), translation=(0, 0.5, 0), name="ball")
BOARD = {"translation": (0, 0.121, 0), "name": "squares"}


@pytest.mark.parametrize("rotation", [(0, 0, 0), (180, 0, 0)])
def test_a_slab_below_a_flat_body_on_which_another_stands_is_named(rotation):
    frame = slab((2.4, 0.12, 2.4), translation=(0, 0.06, 0), name="frame")
    squares = ws.Body(ws.plane(2.0, 4), rotation=rotation, **BOARD)
    (remark,) = covered_bodies(scene(frame, squares, BALL))
    assert "body 0 ('frame') lies right behind body 1 ('squares')" in remark
    assert not covered_bodies(scene(frame, squares))  # nobody sees it


def test_a_box_on_a_ground_and_one_far_below_a_flat_body_are_not():
    box = slab((2.4, 0.12, 2.4), translation=(0, 0.06, 0), name="box")
    assert not covered_bodies(scene(box, BALL))
    squares = ws.Body(ws.plane(2.0, 4), translation=(0, 0.4, 0), name="squares")
    assert not covered_bodies(scene(box, squares, BALL))
