"""Convex parts of meshes."""

import numpy as np
import pytest
import trimesh

from warpshadow.maths.convex import MOST_FACES, find_convex_parts


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
    lid = np.asarray(box().faces)[2:]  # without one of the sides
    assert parts_of(dented) is None
    assert parts_of(together(box(), trimesh.creation.torus(1.0, 0.3))) is None
    assert find_convex_parts(np.asarray(box().vertices), lid) is None
    assert parts_of(trimesh.creation.icosphere(2)) is None  # more than 64 faces
    assert parts_of(trimesh.creation.cylinder(1, 1, sections=MOST_FACES - 1)) is None
    assert len(parts_of(trimesh.creation.cylinder(1, 1, sections=MOST_FACES - 2))) == 1
    assert find_convex_parts(np.zeros((3, 3)), np.array([[0, 1, 2]])) is None
