"""Decimation of meshes."""

import numpy as np
import pytest
import trimesh

import warpshadow as ws
from warpshadow.maths.adjacency import edges_of
from warpshadow.maths.decimation import decimate
from warpshadow.maths.polygons import merge_triangles


def dome(level):
    ball = trimesh.creation.icosphere(level)
    return np.asarray(ball.vertices), np.asarray(ball.faces)[ball.triangles_center[:, 1] > 0]


def distances(points, triangles):
    return trimesh.proximity.closest_point_naive(trimesh.Trimesh(points, triangles, process=False), points)[1]


def rim_of(triangles):
    edges, counts = np.unique(np.sort(edges_of(triangles), axis=1), axis=0, return_counts=True)
    assert counts.max() <= 2
    return edges[counts == 1]


@pytest.mark.parametrize("tolerance", [0.01, 0.02, 0.04])
def test_a_dome_has_few_triangles_near_it(tolerance):
    points, triangles = dome(4)
    decimated = decimate(points, triangles, tolerance)
    assert len(decimated) < 4 / tolerance
    used = np.unique(triangles)
    assert distances(points, decimated)[used].max() < 4 * tolerance


def test_decimation_keeps_the_surface_and_its_winding():
    points, triangles = dome(3)
    decimated = decimate(points, triangles, 0.02)
    corners = points[decimated]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((normals * corners.mean(axis=1)).sum(axis=1) > 0).all()
    rim = rim_of(decimated)
    assert (np.unique(rim, return_counts=True)[1] == 2).all()
    assert len(np.unique(decimated)) - (len(decimated) * 3 + len(rim)) // 2 + len(decimated) == 1  # Euler: a disc
    assert np.abs(points[rim][..., 1]).max() < 0.1


def test_flat_meshes_keep_their_corners_only():
    grid = ws.plane(2.0, 12)
    decimated = decimate(grid.positions.astype(np.float64), grid.faces, 0.01)
    np.testing.assert_array_equal(np.sort(np.abs(grid.positions[np.unique(decimated)][:, [0, 2]])), 1.0)


def test_folds_stay_where_they_are():
    """Two halves of a book."""
    grid = ws.plane(2.0, 12)
    points = grid.positions.astype(np.float64) * [1, 1, 1] + np.outer(np.abs(grid.positions[:, 0]), [0, 1, 0])
    decimated = decimate(points, grid.faces, 0.02)
    assert len(decimated) <= 8
    assert distances(points, decimated).max() < 1e-6


@pytest.mark.parametrize("tolerance", [0.1, 1.0, 100.0])
def test_each_sheet_keeps_a_triangle(tolerance):
    """Leaves of two triangles, however coarse it gets."""
    leaf = np.array([(-0.7, 0, 0), (0, 0, 0.5), (0.9, 0, 0), (0, 0, -0.5)])
    points = np.concatenate([leaf, leaf + (3, 0, 0), dome(1)[0]])
    triangles = np.concatenate([[(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)], dome(1)[1] + 8])
    np.testing.assert_array_equal(
        np.unique(np.searchsorted([4, 8], decimate(points, triangles, tolerance), "right")), [0, 1, 2]
    )


def test_large_meshes_are_sampled_first():
    points, triangles = dome(6)
    decimated = decimate(points, triangles, 0.02)
    rim_of(decimated)
    assert 50 < len(decimated) < 200
    assert distances(points, decimated)[np.unique(triangles)[::50]].max() < 0.08


def test_edges_of_three_triangles_stay():
    """Three pages at one spine."""
    angles = 2 * np.pi * np.arange(3) / 3
    grid = ws.plane(1.0, 4)
    pages = [
        np.outer(grid.positions[:, 0] + 0.5, [np.cos(a), 0, np.sin(a)]) + np.outer(grid.positions[:, 2], [0, 1, 0])
        for a in angles
    ]
    points, number = np.unique(np.concatenate(pages).round(6), axis=0, return_inverse=True)
    triangles = number.reshape(-1)[np.concatenate([grid.faces + k * len(grid.positions) for k in range(3)])]
    decimated = decimate(points, triangles, 0.01)
    assert len(decimated) < len(triangles)
    assert np.isin(np.flatnonzero(np.abs(points[:, [0, 2]]).max(axis=1) < 1e-6), decimated).all()
    assert distances(points, decimated).max() < 1e-6


def test_triangles_are_joined_to_convex_polygons_that_cover_them():
    grid = ws.plane(2.0, 6)
    (square,) = merge_triangles(grid.positions.astype(np.float64), grid.faces, 0.01)
    assert len(square) == 4


def test_polygons_are_nearly_plane_and_share_sides():
    """A polygon that bends would leap from side to side of a receiver that passes its plane."""
    points, triangles = dome(3)
    polygons = merge_triangles(points, decimate(points, triangles, 0.02), 0.04)
    assert len(polygons) < len(decimate(points, triangles, 0.02))
    for polygon in polygons:
        corners = points[polygon] - points[polygon].mean(axis=0)
        assert np.ptp(corners @ np.linalg.svd(corners)[2][2]) < 0.12 * 0.04
    sides = {(a, b) for polygon in polygons for a, b in zip(polygon, np.roll(polygon, -1), strict=True)}
    rim = [side for side in sides if side[::-1] not in sides]
    assert np.abs(points[np.array(rim)][..., 1]).max() < 0.1
