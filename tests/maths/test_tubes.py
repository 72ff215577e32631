"""Tubes, cut into straight segments."""

import numpy as np
import pytest
import trimesh

from warpshadow.maths.convex import find_convex_parts
from warpshadow.maths.tubes import MAX_SEGMENTS, find_tube


def ring(sections=48, corners=12, thickness=0.13):
    return trimesh.creation.torus(0.4, thickness, major_sections=sections, minor_sections=corners)


def lofted(points):
    """The closed mesh of sections of points, [section, corner, 3], flat at both ends."""
    number = np.arange(points[..., 0].size).reshape(points.shape[:2])
    a, b, c, d = number[:-1], np.roll(number, -1, 1)[:-1], np.roll(number, -1, 1)[1:], number[1:]
    sides = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    rest = range(1, points.shape[1] - 1)
    fans = [[(end[0], end[k], end[k + 1]) for k in rest] for end in (number[0, ::-1], number[-1])]
    return trimesh.Trimesh(points.reshape(-1, 3), np.concatenate([sides, *fans]), process=False)


def hook(corners=12):
    """A rod that is straight at first, and then bends in a plane; flat at both ends."""
    angles = np.append([0, 0, 0], np.linspace(0, np.pi, 25))
    along = np.append([-1.0, -0.7, -0.4], np.zeros(25))
    middles = np.stack([1 - np.cos(angles), np.sin(angles) + along, 0 * angles], axis=1)
    around = 2 * np.pi * np.arange(corners) / corners
    outward = np.stack([-np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    points = middles[:, None] + 0.1 * (np.cos(around)[:, None] * outward[:, None] + np.sin(around)[:, None] * [0, 0, 1])
    mesh = lofted(points)
    mesh.fix_normals()
    assert mesh.is_watertight
    return mesh


def column(depth):
    """A column turned on a lathe, of twelve grooves."""
    heights, around = np.linspace(0, 1, 121), 2 * np.pi * np.arange(24) / 24
    radii = 0.3 * (1 + depth * np.sin(2 * np.pi * 12 * heights))
    points = np.stack([radii[:, None] * np.cos(around), radii[:, None] * np.sin(around)], axis=-1)
    return lofted(np.concatenate([points, np.broadcast_to(2 * heights[:, None, None], (121, 24, 1))], axis=-1))


def parts_of(mesh):
    return find_convex_parts(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces))


@pytest.mark.parametrize(
    ("mesh", "is_closed"), [(ring(), True), (ring(40, 10), True), (hook(), False)], ids=["ring", "flat rows", "hook"]
)
def test_a_tube_is_cut_into_segments_that_fill_it(mesh, is_closed):
    parts = parts_of(mesh)
    solids = [part for part in parts if not part.is_seam]
    assert 1 < len(solids) == len(parts) - len(solids) + (not is_closed)
    hulls = [trimesh.convex.convex_hull(mesh.vertices[part.corners]) for part in solids]
    assert sum(hull.volume for hull in hulls) == pytest.approx(mesh.volume, rel=0.05)
    for hull, part in zip(hulls, solids, strict=True):
        radius = np.linalg.norm(hull.vertices - hull.vertices.mean(axis=0), axis=1).max()
        assert part.gap * radius < 0.2 * 0.2


def test_surfaces_lie_as_far_from_segments_as_their_gaps_say():
    mesh = ring()
    far = np.full(len(mesh.vertices), np.inf)
    gaps = []
    for part in parts_of(mesh):
        if not part.is_seam:
            corners = mesh.vertices[part.corners]
            hull = trimesh.convex.convex_hull(corners)
            planes = (hull.face_normals * hull.triangles[:, 0]).sum(axis=1)
            far = np.minimum(far, np.abs((mesh.vertices @ hull.face_normals.T - planes).max(axis=1)))
            gaps.append(part.gap * np.linalg.norm(corners - corners.mean(axis=0), axis=1).max())
    assert 0.3 * max(gaps) < far.max() <= max(gaps) + 1e-6


def test_shells_and_balls_are_no_tubes():
    profile = [(0, 0), (0.4, 0), (0.5, 0.4), (0.45, 0.4), (0.35, 0.05), (0, 0.05)]
    for mesh in (trimesh.creation.revolve(profile, sections=24), trimesh.creation.icosphere(3)):
        assert find_tube(np.asarray(mesh.vertices), np.asarray(mesh.faces), MAX_SEGMENTS) is None


def test_a_ring_whose_section_is_not_convex_has_no_parts():
    section = np.array([[0.8, 0], [1.2, 0], [1.2, 0.4], [1.1, 0.4], [1.0, 0.15], [0.9, 0.4], [0.8, 0.4], [0.8, 0]])
    gutter = trimesh.creation.revolve(section, sections=40)
    assert gutter.is_watertight
    assert parts_of(gutter) is None
    assert parts_of(trimesh.creation.revolve(section[[0, 1, 2, 6, 7]], sections=40)) is not None


def test_a_mesh_of_too_many_segments_has_no_parts():
    links = [ring().apply_translation((k, 0, 0)) for k in range(MAX_SEGMENTS // 24 + 1)]
    assert parts_of(trimesh.util.concatenate(links[:-1])) is not None
    assert parts_of(trimesh.util.concatenate(links)) is None


@pytest.mark.parametrize("depth", [0.05, 0.1, 0.19])
def test_grooves_are_not_filled(depth):
    """They are within the slack of a single segment, which would have no shadow on itself."""
    solids = [part for part in parts_of(column(depth)) if not part.is_seam]
    assert len(solids) >= 24 and max(part.gap for part in solids) < 0.05
