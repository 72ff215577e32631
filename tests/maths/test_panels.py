"""Panels of sheets."""

import numpy as np
import pytest
import trimesh

import warpshadow as ws
from warpshadow.maths.convex import find_convex_parts
from warpshadow.maths.panels import MAX_PANELS, TOLERANCES, find_panels

TOLERANCE = 0.02


def open_box(divisions=0):
    """A box of one layer without a lid."""
    mesh = trimesh.creation.box((1, 1, 1))
    for _ in range(divisions):
        mesh = mesh.subdivide()
    is_lid = mesh.triangles[:, :, 1].min(axis=1) > 0.49
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)[~is_lid]


def tent(size=24):
    """Two slopes that sag, and no ends."""
    grid = ws.plane(2.0, size)
    x, _, z = grid.positions.astype(np.float64).T
    return np.stack([x, 1 - np.abs(x) - 0.06 * np.sin(np.pi * np.abs(x)), z], axis=1), grid.faces


def areas(points, polygons):
    """Areas of polygons, about flat ones."""
    fans = [points[polygon] - points[polygon[0]] for polygon in polygons]
    return np.array([np.linalg.norm(np.cross(fan[1:-1], fan[2:]).sum(axis=0)) / 2 for fan in fans])


def area(points, triangles):
    return areas(points, triangles).sum()


@pytest.mark.parametrize("divisions", [0, 1, 2])
def test_a_box_without_a_lid_has_five_panels(divisions):
    points, triangles = open_box(divisions)
    panels = find_panels(points, triangles, TOLERANCE, 32)
    assert [len(panel) for panel in panels] == [4] * 5
    np.testing.assert_allclose(areas(points, panels), 1)


def test_cloth_is_cut_at_its_ridge_and_where_it_sags():
    points, triangles = tent()
    panels = find_panels(points, triangles, TOLERANCE, 32)
    assert 4 <= len(panels) <= 8
    assert all((points[panel, 0] >= 0).all() or (points[panel, 0] <= 0).all() for panel in panels)
    assert areas(points, panels).sum() == pytest.approx(area(points, triangles), rel=0.01)


def test_panels_are_convex_and_as_thin_as_asked():
    points, triangles = tent()
    for tolerance in (0.05, 0.02, 0.01):
        for panel in find_panels(points, triangles, tolerance, 64):
            corners = points[panel]
            middle = corners.mean(axis=0)
            normal = np.linalg.svd(corners - middle)[2][2]
            assert np.ptp((corners - middle) @ normal) <= tolerance
            sides, following = np.roll(corners, -1, axis=0) - corners, np.roll(corners, -2, axis=0)
            turns = np.cross(sides, following - corners) @ normal
            assert (turns > 0).all() or (turns < 0).all()


def test_a_flat_sheet_whose_outline_is_not_convex_is_cut():
    grid = ws.plane(2.0, 4)
    middles = grid.positions[grid.faces].mean(axis=1)
    triangles = grid.faces[(middles[:, 0] < 0) | (middles[:, 2] < 0)]  # an L
    panels = find_panels(grid.positions.astype(np.float64), triangles, TOLERANCE, 32)
    assert 2 <= len(panels) <= 4
    assert areas(grid.positions, panels).sum() == pytest.approx(3, rel=0.03)


def test_sheets_that_bend_too_often_have_no_panels():
    ball = trimesh.creation.icosphere(3)
    half = np.asarray(ball.faces)[ball.triangles_center[:, 1] > 0]
    assert find_panels(np.asarray(ball.vertices), half, TOLERANCE, 32) is None
    points, triangles = open_box()
    assert find_panels(points, triangles, TOLERANCE, 4) is None


@pytest.mark.parametrize("height", [0.3, 0.5, 1.0])
def test_domes_have_panels_and_deep_ones_coarser_ones(height):
    ball = trimesh.creation.icosphere(4)
    faces = np.asarray(ball.faces)[ball.triangles_center[:, 1] > 1 - height]
    parts = find_convex_parts(np.asarray(ball.vertices, np.float32), faces)
    assert 16 <= len(parts) <= MAX_PANELS
    polygons = [part.corners for part in parts]
    share = areas(ball.vertices, polygons).sum() / area(ball.vertices, faces)
    assert 0.95 < share < 1.25  # they overlap
    middles = np.array([ball.vertices[polygon].mean(axis=0) for polygon in polygons])
    assert 1 - np.linalg.norm(middles, axis=1).min() < TOLERANCES[-1] * 2


def test_triangles_without_area_do_not_count():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1], [0.5, 0, 0]], float)
    (panel,) = find_panels(points, np.array([[0, 1, 2], [0, 1, 3]]), TOLERANCE, 32)
    assert sorted(panel) == [0, 1, 2]
    assert find_panels(points, np.array([[0, 1, 3]]), TOLERANCE, 32) == []


@pytest.mark.parametrize("divisions", [8, 16])
def test_walls_with_windows_are_cut_exactly(divisions):
    """Two walls at a right angle of one mesh, a window in each, as a house of sheets has."""
    grid = ws.plane((4.0, 2.0), (2 * divisions, divisions))
    x, _, z = grid.positions.astype(np.float64).T
    middles = np.stack([x, z], axis=1)[grid.faces].mean(axis=1)
    is_wall = (np.abs(np.abs(middles[:, 0]) - 1) > 0.5) | (np.abs(middles[:, 1]) > 0.5)
    points = np.stack([np.maximum(x, 0), z, np.maximum(-x, 0)], axis=1)
    panels = find_panels(points, grid.faces[is_wall], TOLERANCE, 32)
    assert [len(panel) for panel in panels] == [4] * 8
    assert areas(points, panels).sum() == pytest.approx(6)
    assert all(np.ptp(points[panel], axis=0).min() == 0 for panel in panels)
    assert len(find_panels(points, grid.faces[is_wall], TOLERANCE, 8)) == 8
    assert find_panels(points, grid.faces[is_wall], TOLERANCE, 7) is None
