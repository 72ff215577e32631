"""Hulls of bodies whose pieces stand side by side."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from warpshadow.maths.convex import find_convex_parts
from warpshadow.maths.hull import find_hull


def boxes(extents, middles):
    solids = [trimesh.creation.box(extents).apply_translation(middle) for middle in middles]
    return trimesh.util.concatenate(solids)


def hull_of(mesh):
    return find_hull(mesh.vertices, find_convex_parts(mesh.vertices, mesh.faces))


SLATS = boxes((2, 0.02, 0.15), [(0, 0.16 * k, 0.02 * (k % 2)) for k in range(8)])
TURNED = SLATS.copy().apply_transform(trimesh.transformations.rotation_matrix(0.7, [1, 2, 3]))


@pytest.mark.parametrize("mesh", [SLATS, TURNED])
def test_a_hull_is_a_closed_convex_part(mesh):
    hull = hull_of(mesh)
    points = mesh.vertices[hull.corners]
    a, b, c = np.moveaxis(points[hull.faces], 1, 0)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    heights = ((mesh.vertices[:, None] - a) * normals).sum(axis=-1)  # [vertex, face]
    assert np.abs(heights.max(axis=0)).max() < 1e-6
    assert len(hull.corners) - len(hull.edges) + len(hull.faces) == 2
    expected = np.unique(ConvexHull(mesh.vertices).equations.round(6), axis=0)
    assert len(hull.faces) == len(expected)
    for begin, end, left, right in hull.edges:  # both faces contain it, and wind around it in opposite ways
        on_faces = ((points[[begin, end]][:, None] - a[[left, right]]) * normals[[left, right]]).sum(axis=-1)
        assert np.abs(on_faces).max() < 1e-6
        assert np.cross(normals[left], normals[right]) @ (points[end] - points[begin]) > 0


def test_pieces_behind_each_other_have_no_hull():
    """Trunks of a wood: from the side three and more are in one direction."""
    middles = np.random.default_rng(0).uniform(-1, 1, size=(60, 3)) * [1, 0, 1]
    assert hull_of(boxes((0.06, 1, 0.06), middles)) is None
    assert hull_of(boxes((0.06, 1, 0.06), np.linspace([-1, 0, 0], [1, 0, 0], 20))) is not None


def test_one_piece_and_pieces_of_other_kinds_have_none():
    assert hull_of(boxes((1, 1, 1), [(0, 0, 0)])) is None
    sheets = trimesh.util.concatenate([trimesh.Trimesh(np.eye(3) + k, [[0, 1, 2]]) for k in range(2)])
    assert len(find_convex_parts(sheets.vertices, sheets.faces)) == 2
    assert hull_of(sheets) is None


def test_a_hull_of_many_faces_is_none():
    """Posts in a ring."""
    angles = np.linspace(0, 2 * np.pi, 80, endpoint=False)
    ring = np.stack([np.cos(angles), 0 * angles, np.sin(angles)], axis=1)
    assert hull_of(boxes((0.05, 1, 0.05), ring)) is None
