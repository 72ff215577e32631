"""Convex parts of meshes."""

import numpy as np
import pytest
import trimesh

from warpshadow.maths.convex import MAX_FACES, find_convex_parts, is_convex


def parts_of(mesh):
    return find_convex_parts(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces))


def together(*meshes):
    return trimesh.util.concatenate(list(meshes))


def box(size=(1, 1, 1), middle=(0, 0, 0)):
    return trimesh.creation.box(size).apply_translation(middle)


PRISM = trimesh.creation.cylinder(0.5, 2.0, sections=9)


@pytest.mark.parametrize(
    ("mesh", "counts"),
    [
        (box(), (8, 6, 12)),
        (box().subdivide().subdivide(), (8, 6, 12)),
        (PRISM, (18, 11, 27)),
        (trimesh.creation.cone(0.5, 1.0, sections=12), (13, 13, 24)),
        (trimesh.creation.icosahedron(), (12, 20, 30)),
    ],
    ids=["box", "divided box", "prism", "cone", "icosahedron"],
)
def test_a_convex_solid_is_one_part_with_its_corners_faces_and_edges(mesh, counts):
    (part,) = parts_of(mesh)
    used = np.unique(part.edges[:, :2])
    assert (len(used), len(part.faces), len(part.edges)) == counts
    a, b, c = np.moveaxis(mesh.vertices[part.corners][part.faces], 1, 0)
    normals = np.cross(b - a, c - a)
    assert (np.einsum("fx,fx->f", normals, a - mesh.vertices.mean(axis=0)) > 0).all()  # outward
    begin, end, left, right = part.edges.T
    edges = (mesh.vertices[part.corners][end] - mesh.vertices[part.corners][begin])[:, None]
    turned = np.cross(normals[left], normals[right])[:, None]
    assert (np.einsum("eij,eij->e", edges, turned) > 0).all()  # counterclockwise around the left face


def test_a_solid_that_is_inside_out_has_the_same_part():
    turned = PRISM.copy()
    turned.invert()
    (part,) = parts_of(turned)
    (expected,) = parts_of(PRISM)
    assert len(part.edges) == len(expected.edges)
    a, b, c = np.moveaxis(PRISM.vertices[part.corners][part.faces], 1, 0)
    assert (np.einsum("fx,fx->f", np.cross(b - a, c - a), a - PRISM.vertices.mean(axis=0)) > 0).all()


@pytest.mark.parametrize("shift", [(1, 0, 0), (0.5, 0.2, 0), (0, 1, 1)], ids=["side by side", "overlapping", "an edge"])
def test_parts_may_touch_overlap_and_share_edges(shift):
    assert [len(part.edges) for part in parts_of(together(box(), box(middle=shift), PRISM))] == [12, 12, 27]


def test_bodies_that_are_not_all_convex_have_no_parts():
    dented = trimesh.creation.icosphere(0)
    dented.vertices[0] *= 0.2
    assert parts_of(dented) is None
    shell = trimesh.creation.revolve([(0, 0), (1, 0), (1, 1), (0.7, 1), (0.7, 0.3), (0, 0.3)], sections=16)
    assert parts_of(together(box(), shell)) is None
    assert parts_of(trimesh.creation.icosphere(2)) is None  # more than 64 faces
    assert parts_of(trimesh.creation.cylinder(1, 1, sections=MAX_FACES - 1)) is None
    assert len(parts_of(trimesh.creation.cylinder(1, 1, sections=MAX_FACES - 2))) == 1
    assert find_convex_parts(np.zeros((3, 3)), np.array([[0, 1, 2]])) is None


def test_an_open_piece_has_panels_whose_faces_are_their_sides():
    cloth = trimesh.Trimesh([(0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)], [(0, 1, 2), (0, 2, 3)])
    solid, panel = parts_of(together(box(), cloth.apply_translation((2, 0, 0))))
    assert len(solid.faces) == 6
    assert len(panel.edges) == 4
    corners = together(box(), cloth).vertices[panel.corners]
    a, b, c = np.moveaxis(corners[panel.faces], 1, 0)
    front, back = np.cross(b - a, c - a)
    np.testing.assert_allclose(front, -back)
    begin, end, left, right = panel.edges.T
    assert (left == 0).all()
    assert (right == 1).all()
    inward = np.cross(front, corners[end] - corners[begin])
    assert (np.einsum("ex,ex->e", inward, corners.mean(axis=0) - corners[begin]) > 0).all()  # left of its edges


def extruded(outline):
    """The solid of unit height over a convex outline, counterclockwise, [corner, 2]."""
    count = len(outline)
    vertices = np.concatenate([np.c_[outline, np.zeros(count)], np.c_[outline, np.ones(count)]])
    fan = np.c_[np.zeros(count - 2, int), np.arange(1, count - 1), np.arange(2, count)]
    here, there = np.arange(count), np.roll(np.arange(count), -1)
    sides = np.concatenate([np.c_[here, there, there + count], np.c_[here, there + count, here + count]])
    return vertices, np.concatenate([fan[:, ::-1], fan + count, sides])


@pytest.mark.parametrize("facets", [223, 240, 256])
def test_facets_that_bend_little_each_are_no_face_together(facets):
    """Each bends by less than 0.81°; as one face, the arc would be a plate."""
    angles = np.linspace(0, np.pi, facets + 1)
    assert find_convex_parts(*extruded(np.stack([np.cos(angles), np.sin(angles)], axis=1))) is None


@pytest.mark.parametrize(("height", "count"), [(5e-6, 6), (5e-5, 6), (2e-3, 7)])
def test_a_ridge_within_a_face_is_no_higher_than_the_tolerance(height, count):
    (part,) = find_convex_parts(*extruded(np.array([[0, 0], [1, 0], [1, 1], [0.5, 1 + height], [0, 1]])))
    assert len(part.faces) == count


WINDOWS = {  # squares of a wall, and parts at most
    "window": (["####", "#  #", "#  #", "####"], 4, 1),
    "two windows": (["#######", "#  #  #", "#######"], 6, 2),
    "ell": (["#   ", "#   ", "####"], 2, 0),
    "fork": (["# # #", "#####"], 4, 0),
}


def wall_of(rows, thickness, seed=0):
    """A closed wall of squares, each cut along either diagonal; turned."""
    rng = np.random.default_rng(seed)
    (row, column), width = np.nonzero([[letter == "#" for letter in line] for line in rows]), len(rows[0]) + 1
    a = (row * width + column)[:, None]
    halves = np.where(
        rng.uniform(size=(len(a), 1)) < 0.5, [0, 1, width + 1, 0, width + 1, width], [0, 1, width, 1, width + 1, width]
    )
    used, faces = np.unique((a + halves).reshape(-1, 3), return_inverse=True)
    points = np.stack([used % width, used // width], axis=1).astype(float)
    wall = trimesh.creation.extrude_triangulation(points, faces.reshape(-1, 3), thickness)
    wall.merge_vertices()
    return wall.apply_transform(trimesh.transformations.random_rotation_matrix(rng.uniform(size=3)))


def is_inside(points, mesh, part):
    corners = mesh.vertices[part.corners]
    a, b, c = np.moveaxis(corners[part.faces], 1, 0)
    normals = np.cross(b - a, c - a)
    return (np.einsum("pfx,fx->pf", points[:, None] - a, normals) < 0).all(axis=1)


@pytest.mark.parametrize("thickness", [0.1, 3.0])
@pytest.mark.parametrize("name", WINDOWS)
def test_a_prism_with_holes_is_cut_into_few_convex_ones(name, thickness):
    """Each point inside is in one of them, and no point outside in any, however the mesh is triangulated."""
    rows, most, holes = WINDOWS[name]
    counts = set()
    for seed in range(3):
        wall = wall_of(rows, thickness, seed)
        parts = [part for part in parts_of(wall) if not part.is_seam]
        seams = parts_of(wall)[len(parts) :]
        assert len(seams) == len(parts) + holes - 1 and all(seam.is_seam for seam in seams)
        for seam in seams:  # points beside its middle are in a prism each
            corners = wall.vertices[seam.corners]
            aside = 1e-3 * np.cross(corners[1] - corners[0], corners[2] - corners[0])
            both = [is_inside(corners.mean(axis=0) + np.stack([aside, -aside]), wall, part) for part in parts]
            np.testing.assert_array_equal(np.sum(both, axis=0), 1)
            assert np.argmax(both, axis=0)[0] != np.argmax(both, axis=0)[1]
        counts.add(len(parts))
        points = np.random.default_rng(1).uniform(*wall.bounds, size=(4000, 3))
        owners = sum(is_inside(points, wall, part).astype(int) for part in parts)
        assert owners.max() == 1
        assert np.mean(owners) * np.ptp(wall.bounds, axis=0).prod() == pytest.approx(wall.volume, rel=0.15)
        assert sum(volume_of(wall, part) for part in parts) == pytest.approx(wall.volume, rel=1e-5)
    assert len(counts) == 1
    assert counts.pop() <= most


def slab_with_a_round_hole(edge_count, corner_count):
    """A regular prism of a corner count, with a round hole of as many edges as told along its axis."""
    angles = 2 * np.pi * np.arange(edge_count) / edge_count
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    across = 2 * np.pi / corner_count
    rims = 0.5 * circle, circle * (np.cos(across / 2) / np.cos(angles % across - across / 2))[:, None]
    here, there = np.arange(edge_count), np.roll(np.arange(edge_count), -1)
    strip = np.concatenate([np.c_[here, there + edge_count, there], np.c_[here, here + edge_count, there + edge_count]])
    return trimesh.creation.extrude_triangulation(np.concatenate(rims), strip, 0.2)


@pytest.mark.parametrize(("edge_count", "part_count"), [(32, 32), (48, 48), (64, 64), (80, None)])
def test_a_slab_with_a_round_hole_has_a_prism_for_each_edge_of_the_hole(edge_count, part_count):
    slab = slab_with_a_round_hole(edge_count, 4)
    parts = parts_of(slab)
    assert (parts is None) == (part_count is None)
    if parts is not None:
        prisms = [part for part in parts if not part.is_seam]
        assert len(prisms) == len(parts) - len(prisms) == part_count
        assert sum(volume_of(slab, part) for part in prisms) == pytest.approx(slab.volume, rel=1e-5)


def test_a_washer_of_many_sides_is_a_tube_of_fewer_segments():
    """One of 32 is as many prisms; one of 48 is a tube whose segments are two or more sides long."""
    prisms, segments = (parts_of(slab_with_a_round_hole(count, count)) for count in (32, 48))
    assert len(prisms) == 64 and max(part.gap for part in prisms) == 0
    assert len(segments) <= 48 and all(part.gap > 0 for part in segments if not part.is_seam)


def volume_of(mesh, part):
    """Volume of a part by what is to the left of its edges."""
    corners = mesh.vertices[part.corners]
    middle = corners.mean(axis=0)
    begin, end, left, right = part.edges.T
    total = 0.0
    for face, first, last in ((left, begin, end), (right, end, begin)):
        apex = corners[part.faces[face, 0]] - middle
        total += np.einsum("ex,ex->", apex, np.cross(corners[first] - middle, corners[last] - middle)) / 6
    return total


def test_prisms_that_are_none_have_no_parts():
    rows = WINDOWS["window"][0]
    tapered, twisted, sieve = wall_of(rows, 2.0), wall_of(["###", "# #", "###"], 2.0), ["#" * 21, "# " * 10 + "#"] * 5
    tapered.vertices[np.linalg.norm(tapered.vertices, axis=1).argmax()] *= 1.1
    assert parts_of(tapered) is None
    twisted.vertices[:4] += 0.01
    assert parts_of(twisted) is None
    assert parts_of(wall_of([*sieve, "#" * 21], 1.0)) is None  # 50 windows
    parts = parts_of(together(wall_of(rows, 1.0), box(middle=(9, 0, 0))))
    assert [(part.piece, part.is_seam) for part in parts] == [(0, False)] * 4 + [(0, True)] * 4 + [(1, False)]


def roof(ridge, top, slope):
    """A block with a roof of two slopes: points of the ridge, and triangles of them and the eaves, the last four."""
    base, four = [[-1, -1], [1, -1], [1, 1], [-1, 1]], np.full(4, 1.0)
    vertices = np.concatenate([ridge, np.c_[base, -slope * four], np.c_[base, -four]])
    upper = len(ridge) + np.arange(4)
    lower, following = upper + 4, np.roll(upper, -1)
    sides = np.concatenate([np.c_[lower, following + 4, following], np.c_[lower, following, upper]])
    bottom = [lower[[0, 2, 1]], lower[[0, 3, 2]]]
    return vertices, np.concatenate([sides, bottom, top])


@pytest.mark.parametrize(("aside", "is_convex"), [(0.0, True), (0.008, False)])
def test_edges_of_a_part_are_straight(aside, is_convex):
    """Both slopes are flat within the tolerance, but the ridge between them is straight only where it does not bend."""
    top = [(0, 4, 1), (4, 5, 1), (1, 5, 2), (0, 1, 3), (3, 1, 6), (1, 2, 6), (3, 4, 0), (2, 5, 6)]
    parts = find_convex_parts(*roof(np.array([[0, -1, 0], [aside, 0, 0], [0, 1, 0]]), top, 0.01))
    assert (parts is not None) == is_convex


def test_faces_that_share_two_edges_are_of_no_part():
    """A face as wide as a hair lies on the middle of the ridge."""
    ridge = np.array([[0, -1, 0], [0, -0.3, 0], [5e-4, 0, -2.5e-5], [-5e-4, 0, -2.5e-5], [0, 0.3, 0], [0, 1, 0]])
    right = [(0, 7, 1), (1, 7, 2), (7, 8, 2), (2, 8, 4), (4, 8, 5)]
    left = [(0, 1, 6), (1, 3, 6), (3, 9, 6), (3, 4, 9), (4, 5, 9)]
    top = [*right, *left, (1, 2, 3), (2, 4, 3), (6, 7, 0), (5, 8, 9)]
    assert find_convex_parts(*roof(ridge, top, 0.05)) is None


def test_solids_without_a_dent_are_convex():
    ball, torus = trimesh.creation.icosphere(3), trimesh.creation.torus(0.4, 0.15)
    assert is_convex(ball.vertices, ball.faces) and is_convex(ball.vertices, ball.faces[:, ::-1])
    dented = ball.vertices * (1 - 0.1 * (ball.vertices[:, 1:2] > 0.9))
    assert not is_convex(dented, ball.faces) and not is_convex(torus.vertices, torus.faces)
