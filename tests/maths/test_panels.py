"""Panels of sheets."""

import numpy as np
import pytest
import trimesh

import warpshadow as ws
from warpshadow.maths.convex import find_convex_parts
from warpshadow.maths.panels import MAX_PANELS_OF, find_panels

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
            assert (turns >= -1e-6).all() or (turns <= 1e-6).all()  # neighbors may have corners on its sides


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
    assert 16 <= len(parts) <= max(MAX_PANELS_OF.values())
    polygons = [part.corners for part in parts]
    share = areas(ball.vertices, polygons).sum() / area(ball.vertices, faces)
    assert 0.9 < share < 1  # chords are shorter
    middles = np.array([ball.vertices[polygon].mean(axis=0) for polygon in polygons])
    assert 1 - np.linalg.norm(middles, axis=1).min() < max(MAX_PANELS_OF) * 2


SHELLS = {
    "icosphere 2": trimesh.creation.icosphere(2),
    "icosphere 3": trimesh.creation.icosphere(3),
    "icosphere 4": trimesh.creation.icosphere(4),
    "sphere of 16": trimesh.creation.uv_sphere(1.0, (16, 16)),
    "sphere of 32": trimesh.creation.uv_sphere(1.0, (32, 32)),
    "sphere of 64": trimesh.creation.uv_sphere(1.0, (64, 64)),
}


def shell(name, height, noise=0.0, axis=1):
    """A sphere without what is above a part of its height, and with noise in its vertices."""
    ball = SHELLS[name]
    faces = np.asarray(ball.faces)[ball.triangles_center[:, axis] < 2 * height - 1]
    return ball.vertices + noise * np.random.default_rng(0).normal(size=ball.vertices.shape), faces


@pytest.mark.parametrize("height", [0.2, 0.5, 0.8])
@pytest.mark.parametrize("name", SHELLS)
def test_shells_have_panels_however_they_are_tessellated(name, height):
    points, faces = shell(name, height, axis=2 if "of" in name else 1)
    parts = find_convex_parts(points.astype(np.float32), faces)
    share = areas(points, [part.corners for part in parts]).sum() / area(points, faces)
    assert 0.85 < share < 1.02


@pytest.mark.parametrize("noise", [0.002, 0.006])
def test_shells_of_a_scan_have_panels(noise):
    points, faces = shell("icosphere 4", 0.5, noise)
    assert find_convex_parts(points.astype(np.float32), faces)


def test_there_are_no_gaps_between_panels_of_a_shell():
    """Where two meet, they share a side, or corners on it: all that is not is the rim."""
    points, faces = shell("icosphere 3", 0.5)
    panels = [part.corners for part in find_convex_parts(points.astype(np.float32), faces)]
    sides = {(a, b) for panel in panels for a, b in zip(panel, np.roll(panel, -1), strict=True)}
    rim = np.array([side for side in sides if side[::-1] not in sides])
    assert points[rim][..., 1].min() > -0.2
    assert len(rim) < 0.2 * len(sides)


def test_rims_with_teeth_are_cut_between_tips_and_roots():
    """So that as much light comes in: teeth that are cut away alone would leave 0.86 of the area, not 0.97."""
    points, faces = shell("sphere of 16", 0.5, axis=2)
    panels = [part.corners for part in find_convex_parts(points.astype(np.float32), faces)]
    assert areas(points, panels).sum() / area(points, faces) > 0.93


def leaves(count):
    """Leaves of two triangles, about as large as a tenth of the mesh."""
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    leaf = np.array([(-0.07, 0, 0), (0, 0, 0.05), (0.09, 0, 0), (0, 0, -0.05)])
    points = (leaf @ axes + rng.uniform(-1, 1, (count, 1, 3))).reshape(-1, 3)
    return points, (np.array([(0, 1, 2), (0, 2, 3)]) + 4 * np.arange(count)[:, None, None]).reshape(-1, 3)


@pytest.mark.parametrize("count", [40, 100, max(MAX_PANELS_OF.values())])
def test_all_leaves_of_a_tree_are_panels_each_a_piece_of_its_own(count):
    points, faces = leaves(count)
    parts = find_convex_parts(points.astype(np.float32), faces)
    assert [part.piece for part in parts] == list(range(count))
    np.testing.assert_allclose(areas(points, [part.corners for part in parts]), 0.16 * 0.05, rtol=1e-4)


def test_more_leaves_than_that_have_spheres():
    points, faces = leaves(max(MAX_PANELS_OF.values()) + 1)
    assert find_convex_parts(points.astype(np.float32), faces) is None


@pytest.mark.parametrize("size", [0.4, 0.15, 0.03])
def test_small_bowls_beside_large_ones_are_bowls(size):
    """With the tolerance of the large one, the smaller ones had 17, 9 and 1 panels."""
    points, faces = shell("icosphere 3", 0.5)
    both = np.concatenate([points, size * points + (1.5, 0, 0)]).astype(np.float32)
    parts = find_convex_parts(both, np.concatenate([faces, faces + len(points)]))
    assert [part.piece for part in parts] == sorted(part.piece for part in parts)
    large, small = ([part.corners for part in parts if part.piece == piece] for piece in (0, 1))
    assert 20 <= len(small) < len(large)
    share = areas(both, small).sum() / (area(points, faces) * size**2)
    assert 0.85 < share < 1.02


def test_sheets_that_share_an_edge_are_one_piece():
    """Walls that meet in a T; a leaf that touches one of them in a corner is a piece of its own."""
    points = [(x, y, z) for x, z in ((0, 0), (1, 0), (-1, 0), (0, 1)) for y in (0, 1)]
    points += [(1, 2, 0), (2, 1, 0)]
    walls = [triangle for a, b in ((0, 2), (4, 0), (0, 6)) for triangle in ((a, b, b + 1), (a, b + 1, a + 1))]
    parts = find_convex_parts(np.array(points, np.float32), np.array([*walls, (3, 8, 9)]))
    assert np.bincount([part.piece for part in parts]).tolist() == [3, 1]
    assert len(parts[-1].corners) == 3


@pytest.mark.parametrize("sections", [24, 48, 200])
def test_lamp_shades_have_no_more_panels_than_sides(sections):
    angles = 2 * np.pi * np.arange(sections) / sections
    ring = np.stack([np.cos(angles), 0 * angles, np.sin(angles)], axis=1)
    begin, end = np.arange(sections), np.roll(np.arange(sections), -1)
    faces = [
        np.stack([begin, begin + sections, end], axis=1),
        np.stack([end, begin + sections, end + sections], axis=1),
    ]
    panels = find_panels(np.concatenate([ring, 0.7 * ring + [0, 1, 0]]), np.concatenate(faces), 0.04, 144)
    assert len(panels) <= min(sections, 40)


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
