"""Smoothed silhouettes: coverage near the exact area, gradients that move vertices, and what must be left alone."""

import numpy as np
import pytest
import warp as wp

import warpshadow as ws
from warpshadow.camera import to_clip
from warpshadow.raster import interpolate, rasterize
from warpshadow.silhouette import edge_neighbors, smooth_silhouettes

# Edge pixels are blended by one axis at a time, so the area of a polygon is right only on average over its edges:
# relative error of the total coverage of shapes of hundreds of pixels, measured 1e-3 and below.
AREA = 5e-3
# Gradient of the total coverage against that of the exact area; measured 2%.
AREA_GRADIENT = 5e-2
# Gradients of a moving image against differences of the image itself.
MOTION = 5e-2


def setup(positions, faces, camera, device, requires_grad=False):
    world = wp.array(np.float32(positions)[None], dtype=wp.vec3, device=device, requires_grad=requires_grad)
    indices = wp.array(np.int32(faces), dtype=wp.vec3i, device=device)
    neighbors = wp.array(edge_neighbors(np.int32(faces)), dtype=wp.vec3i, device=device)
    matrices = wp.array(camera.clip_matrix()[None], dtype=wp.mat44, device=device)
    return world, indices, neighbors, matrices


def coverage(world, indices, neighbors, matrices, camera):
    clip = to_clip(world, matrices)
    fragments = rasterize(clip, indices, camera.width, camera.height)
    mask = wp.array((fragments.face_ids.numpy() >= 0).astype(np.float32), device=world.device)
    return smooth_silhouettes(mask, fragments, indices, neighbors, clip)


def triangle(angle=0.3):
    corners = angle + np.array([0, 2.2, 4.0])
    return np.stack([np.cos(corners), np.sin(corners), np.zeros(3)], axis=1)


CAMERA = ws.Camera.look_at((0, 0, 4), (0, 0, 0), fov_y=45, size=(97, 81))


def pixel_area(positions, camera=CAMERA):
    """Exact area of a projected triangle [pixels]."""
    a, b, c = camera.project(positions)
    return abs((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])) / 2


@pytest.mark.parametrize("angle", np.linspace(0, 2, 7))
def test_the_coverage_of_a_triangle_is_its_area(angle, device):
    positions = triangle(angle)
    alpha = coverage(*setup(positions, [[0, 1, 2]], CAMERA, device), CAMERA).numpy()
    assert alpha.min() >= 0 and alpha.max() <= 1 + 1e-6
    assert abs(alpha.sum() - pixel_area(positions)) < AREA * pixel_area(positions)


def test_the_gradient_of_coverage_is_that_of_the_area_averaged_over_angles(device):
    """Growing a triangle by s changes its area by 2·area/s; the sum over vertices of their gradients says so."""
    got, expected = 0.0, 0.0
    for angle in np.linspace(0, 2, 9):
        positions = triangle(angle)
        world, *rest = setup(positions, [[0, 1, 2]], CAMERA, device, requires_grad=True)
        with wp.Tape() as tape:
            alpha = coverage(world, *rest, CAMERA)
        alpha.grad.fill_(1.0)
        tape.backward()
        got += np.sum(world.grad.numpy()[0] * positions)
        expected += 2 * pixel_area(positions)
    assert abs(got - expected) < AREA_GRADIENT * expected


def test_the_gradient_of_motion_is_the_difference_of_the_image_averaged_over_directions(device, verified_tape):
    """A colored sphere moves, grows and shears under smooth weights; differences span half a pixel."""
    mesh = ws.icosphere(1.0, 2)
    colors = 1 + np.cos(2 * mesh.positions[None] + [0, 1, 2])
    attributes = wp.array(colors.astype(np.float32), dtype=wp.vec3, device=device)
    row, column = np.mgrid[: CAMERA.height, : CAMERA.width] / 20
    weights = np.stack([np.cos(row + column), np.sin(row), np.cos(column - 2 * row)], axis=-1)[None]

    def image(positions, requires_grad=False):
        world, faces, neighbors, matrices = setup(positions, mesh.faces, CAMERA, device, requires_grad)
        clip = to_clip(world, matrices)
        fragments = rasterize(clip, faces, CAMERA.width, CAMERA.height)
        return world, smooth_silhouettes(interpolate(fragments, faces, attributes), fragments, faces, neighbors, clip)

    with wp.Tape() as tape:
        world, smoothed = image(mesh.positions, requires_grad=True)
    smoothed.grad.assign(weights.astype(np.float32))
    tape.backward()
    rng = np.random.default_rng(2)
    gradients, expected = [], []
    for _ in range(12):
        toward = mesh.positions @ rng.normal(size=(3, 3)) * 0.5 + rng.normal(size=3)
        ends = [np.sum(weights * image(mesh.positions + sign * 0.01 * toward)[1].numpy()) for sign in (1, -1)]
        expected.append((ends[0] - ends[1]) / 0.02)
        gradients.append(np.sum(world.grad.numpy()[0] * toward))
    assert np.linalg.norm(np.subtract(gradients, expected)) < MOTION * np.linalg.norm(expected)


def test_inner_edges_and_seams_are_left_alone(device):
    """A plane of many faces, of one color each: its inner edges are no silhouettes, so colors stay what they were."""
    mesh = ws.plane(40.0, 8)
    camera = ws.Camera.look_at((0, 5, 3), (0, 0, 0), fov_y=45, size=(64, 64))
    world, faces, neighbors, matrices = setup(mesh.positions, mesh.faces, camera, device)
    clip = to_clip(world, matrices)
    fragments = rasterize(clip, faces, 64, 64)
    values = fragments.face_ids.numpy().astype(np.float32)
    assert (values >= 0).all()  # fills the image
    smoothed = smooth_silhouettes(wp.array(values, device=device), fragments, faces, neighbors, clip)
    np.testing.assert_array_equal(smoothed.numpy(), values)


def test_edges_know_their_neighbors_by_position():
    faces = np.array([[0, 1, 2], [2, 1, 3], [4, 5, 6], [1, 3, 7], [7, 8, 9], [7, 8, 10], [7, 8, 11]])
    across = edge_neighbors(faces)
    assert across[0].tolist() == [1, -1, -1]  # edge 1-2 is opposite to corner 0
    assert across[1].tolist() == [3, -1, 0]
    assert across[2].tolist() == [-1, -1, -1]
    assert [row[2] for row in across[4:].tolist()] == [-2, -2, -2]  # three faces meet at 7-8


def test_vertices_at_one_place_count_as_one_when_asked():
    mesh = ws.icosphere(1.0, 1)
    apart = mesh.positions[mesh.faces].reshape(-1, 3)
    faces = np.arange(len(apart)).reshape(-1, 3)
    assert (edge_neighbors(faces) == -1).all()
    np.testing.assert_array_equal(edge_neighbors(faces, apart), edge_neighbors(mesh.faces))


def test_a_closed_sphere_has_silhouettes_only_around_it(device):
    mesh = ws.icosphere(1.0, 3)
    alpha = coverage(*setup(mesh.positions, mesh.faces, CAMERA, device), CAMERA).numpy()[0]
    row, column = np.mgrid[0.5 : CAMERA.height, 0.5 : CAMERA.width]
    center = CAMERA.project(np.zeros(3))
    radius = CAMERA.intrinsics[0, 0] * np.tan(np.arcsin(1 / 4))
    distance = np.hypot(column - center[0], row - center[1])
    assert (alpha[distance < radius - 1.5] == 1).all()
    assert (alpha[distance > radius + 1.5] == 0).all()
    assert ((alpha > 0) & (alpha < 1)).sum() > 50
    assert abs(alpha.sum() - np.pi * radius**2) < 0.02 * np.pi * radius**2  # an inscribed polyhedron is smaller


def test_edges_at_the_border_of_the_image_are_smoothed_inside_it_alone(device):
    positions = 10 * triangle(0.1) + [7, 3, 0]
    alpha = coverage(*setup(positions, [[0, 1, 2]], CAMERA, device), CAMERA).numpy()
    assert np.isfinite(alpha).all() and alpha.min() >= 0 and alpha.max() <= 1 + 1e-6
    assert 0 < alpha.mean() < 1


def test_faces_through_the_near_plane_are_finite(device):
    positions = np.array([[0, -1, 0], [1, -1, 8], [-1, -1, 8]])
    alpha = coverage(*setup(positions, [[0, 1, 2]], CAMERA, device), CAMERA).numpy()
    assert np.isfinite(alpha).all()
