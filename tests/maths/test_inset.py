"""Vertices where walls meet, a little inside their own wall."""

import numpy as np
import pytest

import warpshadow as ws
from warpshadow.maths.inset import inset_vertices


def corner(scale: float = 1.0) -> ws.Mesh:
    """A floor and a wall that meet along z at x = 0, each with vertices of its own."""
    floor = ws.plane(1.0, 2)
    wall = floor.positions[:, [1, 0, 2]] + (0, 0.5, 0)
    points = np.concatenate([floor.positions + (0.5, 0, 0), wall])
    return ws.Mesh(scale * points, np.concatenate([floor.faces, floor.faces[:, ::-1] + floor.vertex_count]))


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_vertices_where_walls_meet_are_in_front_of_the_other_wall(scale):
    mesh = corner(scale)
    points = inset_vertices(mesh.positions, mesh.faces)
    of_floor, of_wall = np.arange(9), np.arange(9, 18)
    assert (points[of_floor, 1] == 0).all() and (points[of_wall, 0] == 0).all()
    assert (points[of_floor, 0] > 1e-5 * scale).all() and (points[of_wall, 1] > 1e-5 * scale).all()
    assert np.abs(points - mesh.positions).max() < 1e-3 * scale


def test_far_from_the_origin_they_move_by_more_than_rounding():
    mesh = corner(1e-2)
    points = inset_vertices(mesh.positions + 100, mesh.faces)
    assert (points[:9, 0] - 100 > 5e-4).all()  # of faces of 5e-3, where rays take 5e-5 for none


def test_vertices_of_bent_surfaces_and_of_no_face_stay():
    ball = ws.icosphere(1.0, 2)
    positions = np.concatenate([ball.positions, [[9, 9, 9]]]).astype(np.float32)
    np.testing.assert_array_equal(inset_vertices(positions, ball.faces), positions)
    slivers = np.array([[0, 1, 1], [2, 2, 2]])
    np.testing.assert_array_equal(inset_vertices(positions, slivers), positions)
    assert inset_vertices(positions, np.zeros((0, 3), int)).shape == positions.shape


def test_vertices_stay_on_the_faces_of_a_surface_that_is_all_but_flat():
    mesh = ws.plane(1.0, 32)
    positions = mesh.positions.astype(np.float64)
    positions[:, 1] = 0.5 + 2e-3 * np.cos(9 * positions[:, 0]) * np.cos(7 * positions[:, 2])
    points = inset_vertices(positions, mesh.faces)
    corners = positions[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    heights = ((points[mesh.faces] - corners) * normals[:, None]).sum(axis=2)  # of vertices, over their own faces
    assert np.abs(heights).max() < 2.0**-22  # rays take a height of 2^-21 for none
    assert (points != positions.astype(np.float32)).any()
