"""Quadtrees: squares of the image whose corners are receivers, and what samples get in them."""

import functools

import numpy as np
import pytest
import warp as wp

import warpshadow as ws
from warpshadow.stages.geometry.normals import vertex_normals
from warpshadow.stages.raster.interpolation import interpolate
from warpshadow.stages.raster.project import to_clip
from warpshadow.stages.raster.rasterization import rasterize
from warpshadow.stages.receivers.quadtree import find_quadtree, probe_grid
from warpshadow.stages.receivers.receivers import find_receivers
from warpshadow.stages.receivers.vertex_receivers import number_receivers

# Interpolated float32 positions of size 1.
FLOAT32 = 2e-6

KEYS = np.array([0, 0, -1])


def sheet_and_triangle(device, eyes=((0, 0, 3.0),), size=20):
    """A sheet of two faces that faces the camera and fills the image, and a triangle before a part of it."""
    sheet = [(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)]
    positions = wp.array([[*sheet, (0.1, 0.1, 1), (0.6, 0.1, 1), (0.1, 0.6, 1)]], dtype=wp.vec3, device=device)
    faces = wp.array([(0, 1, 2), (0, 2, 3), (4, 5, 6)], dtype=wp.vec3i, device=device)
    cameras = [ws.Camera.look_at(eye, (eye[0], eye[1], 0), size=(size, size)).clip_matrix() for eye in eyes]
    clip = to_clip(positions, wp.array(np.array(cameras), dtype=wp.mat44, device=device))
    return positions, faces, rasterize(clip, faces, size, size)


def shares_of(fragments, supersampling, value):
    """Light at probes that rises along a row from one column on."""
    _, height, width = fragments.face_ids.shape
    row, column = probe_grid((height, width), supersampling)
    return np.tile(value(column / supersampling), (len(fragments.face_ids), len(row), 1))


def squares_of(fragments, shares, supersampling, keys=None):
    """The squares of the sheet, or of other keys of sides."""
    keys = wp.array(np.append(KEYS, KEYS) if keys is None else keys, dtype=wp.int32, device=fragments.face_ids.device)
    on_device = wp.array(np.float32(shares), dtype=wp.float32, device=keys.device)
    return find_quadtree(fragments.face_ids, keys, on_device, supersampling)


def receivers_in(positions, faces, fragments, quadtree, supersampling):
    wants = KEYS >= 0
    numbering = number_receivers(np.repeat([[False, True]], [4, 3], axis=1), device=faces.device)
    normals = vertex_normals(positions, faces)
    return find_receivers(
        positions, normals, faces, fragments, numbering, wants, supersampling=supersampling, quadtree=quadtree
    )


@pytest.mark.parametrize("supersampling", [1, 2, 3])
@pytest.mark.parametrize("edge", [None, 9.0])
def test_samples_get_what_lies_where_they_look_from_few_receivers(device, supersampling, edge):
    """A sheet that faces the camera: what is linear on it is linear in the image, at its ends and beside others, too.

    But for samples of the same face that share a receiver at their mean, as without a quadtree.
    """
    positions, faces, fragments = sheet_and_triangle(device, ((0, 0, 3.0), (0.3, 0.1, 3.2)), size=22 * supersampling)
    shares = shares_of(fragments, supersampling, lambda x: np.zeros_like(x) if edge is None else 1.0 * (x > edge))
    quadtree = squares_of(fragments, shares, supersampling)
    found = receivers_in(positions, faces, fragments, quadtree, supersampling)
    got = interpolate(found.fragments, found.faces, found.points).numpy()
    gaps = np.linalg.norm(got - interpolate(fragments, faces, positions).numpy(), axis=-1)
    is_inside = found.fragments.face_ids.numpy() >= 3 + (found.points.shape[1] - 3)
    assert gaps[is_inside].max() < FLOAT32 and is_inside.mean() > 0.8
    pixel = 2 * np.tan(np.radians(20)) * 3.2 / 22
    assert gaps.max() < 1.5 * pixel
    sees_sheet = KEYS[fragments.face_ids.numpy()] >= 0
    assert (found.points.shape[1] - 3) < 0.4 * sees_sheet[0].sum() / supersampling**2


def test_squares_are_small_where_light_has_an_edge_and_large_where_it_rises_evenly(device):
    positions, faces, fragments = sheet_and_triangle(device, size=32)
    sizes = {}
    for name, value in (
        ("even", lambda x: 0.02 * x),
        ("edge", lambda x: 1.0 * (x > 21)),
        ("weak", lambda x: 0.01 * (x > 21)),
    ):
        shares = shares_of(fragments, 1, value)
        sizes[name] = squares_of(fragments, shares, 1).sizes.numpy()[0]
    far_left = np.s_[:, :8]  # the triangle is in the upper right quarter
    assert all((size[far_left] == 4).all() for size in sizes.values())
    below = np.s_[24:, 16:28]
    assert (sizes["even"][below] == 4).all() and (sizes["weak"][below] == 4).all()
    np.testing.assert_array_equal(sizes["edge"][below], np.tile([4] * 4 + [0] * 2 + [2] * 2 + [4] * 4, (8, 1)))
    behind = fragments.face_ids.numpy()[0] == 2
    assert behind.any() and (sizes["even"][behind] < 4).any()
    assert all(((size == 0) | (size == 2) | (size == 4)).all() for size in sizes.values())


@pytest.mark.parametrize(("size", "spacing"), [(128, 1), (132, 2)])
def test_each_pixel_of_a_small_image_is_a_probe(size, spacing, device):
    """A stripe of one pixel is seen there, wherever it is."""
    positions, faces, fragments = sheet_and_triangle(device, size=size)
    missed = 0
    for stripe in range(20, 24):
        shares = shares_of(fragments, 1, functools.partial(np.equal, stripe))
        assert shares.shape[2] == size // spacing + 1
        sizes = squares_of(fragments, shares, 1).sizes.numpy()[0]
        missed += (sizes[-8:, stripe] > 0).all()
    assert missed == (0 if spacing == 1 else 2)


def test_bodies_and_sides_do_not_share_squares(device):
    positions, faces, fragments = sheet_and_triangle(device, size=32)
    shares = shares_of(fragments, 1, np.zeros_like)
    apart = np.array([0, 1, -1, 2, 3, -1])
    quadtree = squares_of(fragments, shares, 1, apart)
    sides = fragments.face_ids.numpy().ravel()[quadtree.corners.numpy()]
    assert (sides == sides[:, :1]).all() and set(sides[:, 0]) == {0, 1}
    assert len(quadtree.corners) > len(squares_of(fragments, shares, 1).corners)


def test_gradients_to_corners_are_central_differences(device, verified_tape):
    """Receivers move along their rays, and the weights of samples stay."""
    eye = (0.05, 0, 3.0)  # so no sample lies on the edge between the sheet's faces
    positions, faces, fragments = sheet_and_triangle(device, (eye,), size=22)
    camera = ws.Camera.look_at(eye, (0.05, 0, 0), size=(22, 22))
    matrix = wp.array([camera.clip_matrix()], dtype=wp.mat44, device=device)
    shares = shares_of(fragments, 2, lambda x: 0.05 * np.abs(x - 6))
    quadtree = squares_of(fragments, shares, 2)
    assert {2, 4} <= set(quadtree.sizes.numpy()[0, -3].tolist())
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(1, 7, 3)) * [[[1, 1, 1]] * 4 + [[0, 0, 0]] * 3]  # else other samples see the triangle
    start = wp.array(positions.numpy(), dtype=wp.vec3, device=device, requires_grad=True)

    def values(array):
        seen = rasterize(to_clip(array, matrix), faces, 22, 22)
        return receivers_in(array, faces, seen, quadtree, 2).points

    with wp.Tape() as tape:
        points = values(start)
    weights = rng.normal(size=(*points.shape, 3)).astype(np.float32)
    tape.backward(grads={points: wp.array(weights, dtype=wp.vec3, device=device)})
    moved = [wp.array(positions.numpy() + step * direction, dtype=wp.vec3, device=device) for step in (2e-3, -2e-3)]
    losses = [(weights * values(array).numpy().astype(float)).sum() for array in moved]
    products = start.grad.numpy() * direction
    assert abs(products.sum() - (losses[0] - losses[1]) / 4e-3) < 5e-3 * np.linalg.norm(products)
