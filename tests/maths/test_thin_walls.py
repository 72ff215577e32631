"""Layers of thin walls."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from warpshadow.maths.convex import find_convex_parts, is_panel
from warpshadow.maths.thin_walls import find_layer

WALL = 0.08


def lathed(*profile, sections=32):
    return trimesh.creation.revolve(np.array(profile, float), sections=sections)


def mug(wall=WALL, sections=32):
    """A mug of radius 1 and height 2 with a round lip."""
    angles = np.linspace(0, np.pi, 7)
    lip = np.stack([1 - wall / 2 + wall / 2 * np.cos(angles), 2 + wall / 2 * np.sin(angles)], axis=1)
    return lathed((0, 0), (0.9, 0), (1, 0.1), *lip, (1 - wall, wall), (0, wall), sections=sections)


def layer_of(mesh):
    return find_layer(np.asarray(mesh.vertices), np.asarray(mesh.faces))


@pytest.mark.parametrize("mesh", [mug(), mug().subdivide(), mug(sections=96)], ids=["mug", "divided", "round"])
def test_the_layer_of_a_mug_is_its_outside(mesh):
    outside = trimesh.Trimesh(mesh.vertices, layer_of(mesh), process=False)
    low = outside.triangles_center[:, 2] < 1.9
    radii = np.linalg.norm(outside.triangles_center[low, :2], axis=1)
    assert ((radii > 0.96) | (outside.triangles_center[low, 2] < 0.1)).all()  # neither the inside of its wall
    assert (outside.face_normals[low, 2] < 0.1).all()  # nor of its bottom
    exact = np.pi * (0.9**2 + 0.1 * 2**0.5 * 1.9 + 2 * 1.9)
    assert outside.area == pytest.approx(exact, rel=0.03)


def test_the_layer_is_the_same_of_a_mug_that_is_inside_out_and_turned():
    mesh, turned = mug(), mug()
    turned.invert()
    turned.apply_transform(trimesh.transformations.euler_matrix(0.4, 1.1, 2.0))
    areas = [trimesh.Trimesh(each.vertices, layer_of(each), process=False).area for each in (mesh, turned)]
    assert areas[1] == pytest.approx(areas[0], rel=0.01)


@pytest.mark.parametrize(
    "mesh",
    [
        mug(0.3),
        trimesh.creation.icosphere(3),
        trimesh.creation.torus(1, 0.05, 48, 12),
        trimesh.creation.capsule(2, 0.05, count=[16, 16]),
        lathed((0, 0), (1, 0), (1.02, 0.04), (1, 0.08), (0, 0.08)),
        lathed((0, 0), (0.9, 0), (1, 0.04), (0.9, 0.08), (0.7, 0.06), (0, 0.06)),
    ],
    ids=["thick", "ball", "ring", "rod", "slab", "coin"],
)
def test_solids_rods_and_slabs_have_no_layer(mesh):
    assert layer_of(mesh) is None


DISHES = {
    "plate with a foot": [
        *[(0, 0), (0.3, 0), (0.32, 0.05), (0.55, 0.09), (0.75, 0.17)],
        *[(0.76, 0.19), (0.54, 0.115), (0.3, 0.075), (0, 0.07)],
    ],
    "lid with a knob": [
        *[(0, 0.03), (0.5, 0), (0.75, -0.05), (0.76, -0.03), (0.5, 0.03), (0.12, 0.055)],
        *[(0.06, 0.06), (0.05, 0.1), (0.1, 0.14), (0.08, 0.17), (0, 0.18)],
    ],
}


@pytest.mark.parametrize("profile", DISHES.values(), ids=DISHES)
@pytest.mark.parametrize("scale", [1, 1e-3])
def test_the_panels_of_a_dish_leave_no_gaps(profile, scale):
    mesh = lathed(*profile, sections=40)
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])
    mesh.apply_transform(turn).apply_scale(scale)
    parts = find_convex_parts(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    assert len({part.piece for part in parts}) == 2
    corners = [mesh.vertices[part.corners] for part in parts if part.piece == 0]
    areas = [np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0) @ turn[:3, 2] / 2 for points in corners]
    radius = max(r for r, _ in profile) * scale
    assert abs(sum(areas)) == pytest.approx(20 * np.sin(np.pi / 20) * radius**2, rel=0.03)  # along the axis


def test_a_mug_blocks_as_panels_for_receivers_outside_and_others_for_receivers_inside():
    mesh = mug()
    parts = find_convex_parts(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    assert all(map(is_panel, parts))
    pieces = [[part for part in parts if part.piece == number] for number in (0, 1)]
    assert len(pieces[0]) == len(pieces[1]) == len(parts) / 2 > 32
    middle = np.array([0, 0, 1.0])
    for sign, piece in zip((1, -1), pieces, strict=True):
        for part in piece:
            a, b, c = mesh.vertices[part.corners][part.faces[0]]
            assert sign * (np.cross(b - a, c - a) @ (a - middle)) > 0
            assert not np.ptp(part.faces[1])  # a face without area


def bowl(pinhole=0.0):
    """A bowl of radius 1 with a wall of 0.06, whose profile may stop before the axis."""
    angles = np.linspace(0.05, 1.4, 24)[:, None]
    outer, inner = (radius * np.hstack([np.sin(angles), -np.cos(angles)]) for radius in (1.06, 1.0))
    return lathed((pinhole, -1.06), *outer, *inner[::-1], (pinhole, -1), sections=48)


@pytest.mark.parametrize("pinhole", [0.0, 1e-3])
def test_the_panels_of_a_bowl_are_those_of_its_outside_and_cast_a_shadow_of_its_size(pinhole):
    mesh = bowl(pinhole)
    assert mesh.is_watertight == (not pinhole)
    parts = find_convex_parts(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    assert len({part.piece for part in parts}) == 2
    corners = mesh.vertices[np.unique(np.concatenate([part.corners for part in parts]))]
    inside = corners[np.linalg.norm(corners, axis=1) < 1.03]
    assert inside[:, 2].min() > -0.2  # its rim
    for axes in (np.eye(3)[:2], np.eye(3)[1:], np.array([(0.8, 0, -0.6), (0, 1, 0)])):
        shadow, expected = (ConvexHull(points @ axes.T).volume for points in (corners, mesh.vertices))
        assert shadow > 0.98 * expected  # of panels of both sides 0.94


def test_a_mug_of_a_handle_and_a_spoon_has_their_parts_too():
    handle = trimesh.creation.torus(0.4, 0.08, 24, 8).apply_translation((1.2, 0, 1))
    spoon = trimesh.creation.box((0.05, 0.05, 2)).apply_translation((0.5, 0, 1.5))
    mesh = trimesh.util.concatenate([mug(), handle, spoon])
    parts = find_convex_parts(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    assert len({part.piece for part in parts}) == 4
    assert len([part for part in parts if len(part.faces) > 2]) == 24 + 1
