"""Rasterization: a brute-force float64 twin, exactness of coverage, hostile triangles, and gradients."""

import sys

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from twins import central_differences

from warpshadow.assets.camera import Camera
from warpshadow.stages.raster.barycentrics import find_barycentrics
from warpshadow.stages.raster.interpolation import interpolate
from warpshadow.stages.raster.project import to_clip
from warpshadow.stages.raster.rasterization import Fragments, rasterize

# Vertices snap to 1/4096 pixel, so coverage may differ from the twin's within this distance of an edge
# [pixels].
SNAP = 1e-3
# Depths that differ by less, relatively, may be ordered either way in float32.
DEPTH_TIE = 1e-5


def twin_weights(clip, x, y):
    """Perspective-correct weights of clip-space triangles [..., 3, 4] at normalized device coordinates."""
    p = np.stack([clip[..., 0] - x * clip[..., 3], clip[..., 1] - y * clip[..., 3]], axis=-1)
    a, b, c = p[..., 0, :], p[..., 1, :], p[..., 2, :]

    def cross(u, v):
        return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]

    weights = np.stack([cross(b, c), cross(c, a), cross(a, b)], axis=-1)
    total = weights.sum(-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return weights / total


def twin(clip, faces, width, height):
    """Every face at every pixel. Returns face ids, weights, and where no rounding could change them."""
    corners = np.asarray(clip, np.float64)[faces]
    rows, columns = np.mgrid[:height, :width]

    def depths(dx, dy):
        x = ((2 * (columns + dx) + 1) / width - 1)[..., None, None]
        y = ((2 * (rows + dy) + 1) / height - 1)[..., None, None]
        weights = twin_weights(corners, x, y)
        with np.errstate(invalid="ignore", divide="ignore"):
            w = (weights * corners[..., 3]).sum(-1)
            depth = (weights * corners[..., 2]).sum(-1) / w
        covered = (weights >= 0).all(-1) & (w > 0) & (depth > 0) & (depth <= 1)
        return np.where(covered, depth, 0.0), weights

    depth, weights = depths(0.0, 0.0)
    certain = np.ones((height, width), bool)
    for dx, dy in ((-SNAP, -SNAP), (SNAP, -SNAP), (-SNAP, SNAP), (SNAP, SNAP)):
        certain &= ((depths(dx, dy)[0] > 0) == (depth > 0)).all(-1)
    order = np.sort(np.concatenate([np.zeros((height, width, 1)), depth], axis=-1), axis=-1)
    certain &= (order[..., -1] == 0) | (order[..., -1] - order[..., -2] > DEPTH_TIE * order[..., -1])
    face_ids = np.where(depth.max(-1) > 0, depth.argmax(-1), -1)
    visible = np.take_along_axis(weights, np.maximum(face_ids, 0)[..., None, None], axis=-2)[..., 0, :]
    return face_ids, np.where(face_ids[..., None] >= 0, visible, 0.0), certain


def from_pixels(x, y, depth=0.5, w=1.0, *, width, height):
    """Clip positions of pixel positions."""
    x, y, depth, w = np.broadcast_arrays(x, y, depth, w)
    return np.stack([(2 * x / width - 1) * w, (2 * y / height - 1) * w, depth * w, w], axis=-1)


def on_device(clip, faces, device, requires_grad=False):
    clip = np.asarray(clip, np.float32)
    clip = clip if clip.ndim == 3 else clip[None]
    return (
        wp.array(clip, dtype=wp.vec4, device=device, requires_grad=requires_grad),
        wp.array(np.asarray(faces, np.int32).reshape(-1, 3), dtype=wp.vec3i, device=device),
    )


def draw(clip, faces, width, height, device):
    fragments = rasterize(*on_device(clip, faces, device), width, height)
    return fragments.face_ids.numpy(), fragments.barycentrics.numpy()


def draw_each_alone(corners, width, height, device):
    """How many of the triangles [face, 3, 4] cover each pixel when nothing hides them."""
    face_ids, _ = draw(corners, [[0, 1, 2]], width, height, device)
    return (face_ids == 0).sum(0)


def random_triangles(rng, count, scale=1.0, near=0.3):
    """World-space triangles all around a camera at the origin that looks along z, as clip positions."""
    center = rng.uniform((-2, -2, -1), (2, 2, 4), (count, 1, 3))
    points = (center + rng.normal(size=(count, 3, 3)) * scale).reshape(-1, 3)
    clip = np.column_stack([points[:, :2] * 1.5, np.full(3 * count, near), points[:, 2]])
    return clip.astype(np.float32), np.arange(3 * count).reshape(-1, 3)


def assert_equals_twin(clip, faces, width, height, device, certain_share=0.8):
    face_ids, weights = draw(clip, faces, width, height, device)
    expected_ids, expected_weights, certain = twin(clip, faces, width, height)
    assert certain.mean() > certain_share
    np.testing.assert_array_equal(face_ids[0][certain], expected_ids[certain])
    # float32 weights of triangles of about a pixel or larger.
    np.testing.assert_allclose(weights[0][certain], expected_weights[certain], atol=2e-3)
    assert np.median(np.abs(weights[0][certain] - expected_weights[certain])) < 1e-6


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1), (33, 21), (48, 48)])
def test_random_triangles_before_across_and_behind_the_near_plane_match_the_twin(size, device):
    for seed in range(4):
        clip, faces = random_triangles(np.random.default_rng(seed), 40)
        behind = clip[:, 3].reshape(-1, 3) < 0.3
        assert behind.all(1).any() and (behind.any(1) & ~behind.all(1)).any() and (~behind).all(1).any()
        assert_equals_twin(clip, faces, *size, device, certain_share=0.8 if min(size) > 1 else 0.0)


def test_an_image_of_257_by_129_matches_the_twin(device):
    clip, faces = random_triangles(np.random.default_rng(5), 12)
    assert_equals_twin(clip, faces, 257, 129, device)


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**32 - 1), st.floats(0.02, 30.0), st.floats(1e-3, 1.0))
def test_triangles_of_any_size_match_the_twin(device, seed, scale, near):
    clip, faces = random_triangles(np.random.default_rng(seed), 20, scale, near)
    face_ids, _ = draw(clip, faces, 19, 23, device)
    expected, _, certain = twin(clip, faces, 19, 23)
    np.testing.assert_array_equal(face_ids[0][certain], expected[certain])


def grid_patch(rng, count, low, high, jitter):
    """A square patch of count x count quads with random diagonals and random windings, in pixels: [face, 3,
    2].

    Faces overlap when jitter reaches a quarter of a quad.
    """
    axis = np.linspace(low, high, count + 1)
    points = np.stack(np.meshgrid(axis, axis), axis=-1)
    points[1:-1, 1:-1] += rng.uniform(-jitter, jitter, points[1:-1, 1:-1].shape) * (high - low) / count
    faces = []
    for i in range(count):
        for j in range(count):
            a, b, c, d = (i, j), (i, j + 1), (i + 1, j + 1), (i + 1, j)
            faces += [(a, b, c), (a, c, d)] if rng.random() < 0.5 else [(a, b, d), (b, c, d)]
    faces = [[face[k] for k in rng.permutation(3)] for face in faces]
    return np.array([[points[corner] for corner in face] for face in faces])


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.sampled_from([0.0, 0.1, 0.24]))
def test_a_patch_covers_each_pixel_exactly_once(device, seed, count, jitter):
    rng = np.random.default_rng(seed)
    corners = grid_patch(rng, count, -1.5, 33.5, jitter)
    clip = from_pixels(corners[..., 0], corners[..., 1], width=32, height=32)
    assert (draw_each_alone(clip, 32, 32, device) == 1).all()


@pytest.mark.parametrize("step", [1, 2, 4])
def test_edges_through_pixel_centers_belong_to_one_face(step, device):
    rng = np.random.default_rng(step)
    corners = grid_patch(rng, 16 // step, 0.5, 16.5, 0.0)
    clip = from_pixels(corners[..., 0], corners[..., 1], width=32, height=32)
    expected = np.zeros((32, 32), int)
    expected[:16, :16] = 1  # centers on the left and top border are inside, those on the right and bottom are not
    np.testing.assert_array_equal(draw_each_alone(clip, 32, 32, device), expected)


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 2**32 - 1), st.floats(0.1, 2.0))
def test_a_surface_around_the_camera_covers_each_pixel_exactly_once(device, seed, size):
    """A tessellated plane reaches from behind the camera to far ahead, tilted at random."""
    rng = np.random.default_rng(seed)
    corners = grid_patch(rng, 12, -50.0, 50.0, 0.24).astype(np.float32)
    height = -np.float32(size) + np.float32(rng.normal() * 0.1) * corners[..., 0]
    near = 1e-4
    clip = np.stack([corners[..., 0], -height, np.full_like(height, near), corners[..., 1]], axis=-1)
    count = draw_each_alone(clip, 64, 64, device)
    assert count.max() == 1
    # The ray (x, y, 1) meets the plane y = size - tilt x at 1/t = (y + tilt x) / size, if within the patch.
    v, u = (2 * (np.mgrid[:64, :64] + 0.5) / 64) - 1
    a, b, c = (np.append(p, 1.0) for p in ([0, 0], [1, 0], [0, 1]))
    tilt = np.float64(height.flat[0] + size) / corners[..., 0].flat[0]
    inverse = (v + tilt * u) / size
    inside = (inverse * 49 > 1.0) & (np.abs(u) < 49 * inverse)
    assert inside.any() and (count[inside] == 1).all()


@pytest.mark.parametrize("distance", [1e5, 1e6, 1e9])
def test_huge_triangles_cover_every_pixel_once_and_interpolate_right(distance, device):
    rng = np.random.default_rng(7)
    angles = np.sort(rng.uniform(0, 2 * np.pi, 9))
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=-1) * distance
    center = np.array([20.3, 11.7])
    corners = np.array([[center, center + ring[i], center + ring[(i + 1) % 9]] for i in range(9)])
    clip = from_pixels(corners[..., 0], corners[..., 1], width=40, height=30)
    assert np.diff(np.append(angles, angles[0] + 2 * np.pi)).max() < np.pi
    assert (draw_each_alone(clip, 40, 30, device) == 1).all()
    assert_equals_twin(clip.reshape(-1, 4), np.arange(27).reshape(-1, 3), 40, 30, device)


def test_far_faces_around_a_vertex_beside_a_pixel_center_leave_no_hole_there(device):
    """Their edges must meet in the snapped vertex, not in that vertex before it snapped."""
    rng = np.random.default_rng(23)
    for _ in range(40):
        angles = np.sort(rng.uniform(0, 2 * np.pi / 9, 9) + np.arange(9) * 2 * np.pi / 9)
        ring = np.stack([np.cos(angles), np.sin(angles)], axis=-1) * rng.uniform(1e5, 1e6, (9, 1))
        center = rng.integers(0, 8, 2) + 0.5 + rng.uniform(-3e-4, 3e-4, 2)
        corners = np.array([[center, center + ring[i], center + ring[(i + 1) % 9]] for i in range(9)])
        clip = from_pixels(corners[..., 0], corners[..., 1], width=8, height=8)
        assert (draw_each_alone(clip, 8, 8, device) == 1).all()


def test_far_strips_are_drawn_once_between_parallel_edges_without_a_vertex_near_the_image(device):
    x = np.array([-1e6, 1e6])
    edges = np.linspace(-3.0, 40.0, 18)
    quads = [
        [[x[0], y0], [x[1], y0 + 5.0], [x[1], y1 + 5.0], [x[0], y1]]
        for y0, y1 in zip(edges[:-1], edges[1:], strict=True)
    ]
    corners = np.array([[q[k] for k in face] for q in quads for face in ((0, 1, 2), (2, 3, 0))])
    clip = from_pixels(corners[..., 0], corners[..., 1], width=32, height=32)
    assert (draw_each_alone(clip, 32, 32, device) == 1).all()


@pytest.mark.slow
def test_thousands_of_tiny_triangles_match_the_twin_and_leave_no_hole(device):
    rng = np.random.default_rng(8)
    corners = grid_patch(rng, 60, -0.5, 16.5, 0.24)  # 7200 faces on 16 x 16 pixels: most hold no center
    clip = from_pixels(corners[..., 0], corners[..., 1], rng.uniform(0.4, 0.6, 7200)[:, None], width=16, height=16)
    faces = np.arange(3 * 7200).reshape(-1, 3)
    face_ids, _ = draw(clip.reshape(-1, 4), faces, 16, 16, device)
    expected, _, certain = twin(clip.astype(np.float32).reshape(-1, 4), faces, 16, 16)
    assert (face_ids >= 0).all() and certain.mean() > 0.8
    np.testing.assert_array_equal(face_ids[0][certain], expected[certain])


def test_a_face_far_smaller_than_a_pixel_is_drawn_if_it_holds_a_center(device):
    x, y = 10.5 + 0.002 * np.array([-1, 1, 0.1]), 3.5 + 0.002 * np.array([-1, -0.8, 1])
    face_ids, weights = draw(from_pixels(x, y, width=32, height=32), [[0, 1, 2]], 32, 32, device)
    assert np.argwhere(face_ids == 0).tolist() == [[0, 3, 10]]
    np.testing.assert_allclose(weights[0, 3, 10].sum(), 1.0, rtol=1e-6)


def test_faces_without_area_draw_nothing(device):
    points = np.array([[2.0, 2.0], [30.0, 20.0], [16.0, 11.0], [2.5, 2.5], [2.5, 30.5]])
    clip = from_pixels(points[:, 0], points[:, 1], width=32, height=32)
    clip = np.vstack([clip, [[0, 0, 0.1, -1]], [[0, 0, 0, 0]]])
    faces = [[0, 0, 0], [0, 1, 1], [0, 1, 2], [3, 4, 4], [3, 4, 3], [0, 5, 5], [6, 6, 6], [0, 6, 1]]
    face_ids, weights = draw(clip, faces, 32, 32, device)
    assert (face_ids == -1).all() and (weights == 0).all()


@pytest.mark.parametrize("shift", [-1e-7, 1e-7])
def test_a_sample_on_an_edge_has_gradients_on_whatever_side_it_is_rounded(shift, device):
    """The center of the one pixel lies on the edge of the first two corners, but for rounding."""
    clip = wp.array(
        [[(-0.9 + shift, -0.9, 0, 1), (0.9 + shift, 0.9, 0, 1), (-0.9, 0.9, 0, 1)]], dtype=wp.vec4, device=device
    )
    clip.requires_grad = True
    face_ids, faces = wp.zeros((1, 1, 1), dtype=wp.int32, device=device), wp.array([(0, 1, 2)], dtype=wp.vec3i)
    with wp.Tape() as tape:
        weights = find_barycentrics(face_ids, faces.to(device), clip)
    tape.backward(grads={weights: wp.array([[[(0.0, 0.0, 1.0)]]], dtype=wp.vec3, device=device)})
    expected = [[1, -1], [1, -1], [0, 0]]  # of the last weight, which the two corners share and the third does not move
    np.testing.assert_allclose(clip.grad.numpy()[0, :, :2] * 3.6, expected, atol=1e-5)


def test_slivers_and_edge_on_faces_have_finite_weights_in_the_unit_range(device):
    rng = np.random.default_rng(9)
    start, end = rng.uniform(0, 32, (2, 4000, 1, 2))
    along = start + (end - start) * rng.uniform(0, 1, (4000, 3, 1))
    corners = along + rng.normal(size=(4000, 3, 2)) * 10.0 ** rng.uniform(-9, -2, (4000, 1, 1))
    clip = from_pixels(corners[..., 0], corners[..., 1], rng.uniform(0.1, 0.9, (4000, 3)), width=32, height=32)
    face_ids, weights = draw(clip.reshape(-1, 4), np.arange(12000).reshape(-1, 3), 32, 32, device)
    drawn = face_ids >= 0
    assert drawn.any() and np.isfinite(weights).all() and weights.min() >= 0 and weights.max() <= 1
    np.testing.assert_allclose(weights[drawn].sum(-1), 1.0, rtol=1e-6)


def clip_at(fixed, depth, rng, size):
    """A clip position that snaps to given 1/4096 pixels, which float32 cannot hold itself but x/w can be."""
    w = rng.uniform(1.0, 2.0, 4096).astype(np.float32)
    xy = ((np.asarray(fixed) / 2048 / size - 1) * w[:, None]).astype(np.float32)
    snapped = np.rint((xy / w[:, None].astype(np.float64) + 1) * size * 2048)
    i = np.flatnonzero((snapped == fixed).all(1))[0]
    return [*xy[i], depth * w[i], w[i]]


def test_rounding_does_not_carry_the_depth_of_a_sliver_beyond_that_of_its_vertices(device):
    """Slivers of 60 000 pixels in length with next to no area through a pixel center, and a plane nearby."""
    rng = np.random.default_rng(24)
    size, center = 32, 16 * 4096 + 2048
    x, y = np.array([-99.0, 199.0, -99.0]), np.array([-99.0, -99.0, 199.0])
    for _ in range(10):
        p, q = 2, 2
        while np.gcd(p, q) != 1:
            p, q = (int(n) for n in rng.integers(1 << 25, 1 << 27, 2))
        v = pow(p, -1, q)
        u = (p * v - 1) // q  # p v - q u = 1: the least area that is not zero
        fixed = center + np.array([[-p, -q], [p, q], [u, v], [-u, -v]])
        for side, sliver_wins in ((1, True), (-1, False)):
            depths = 0.5 + side * np.array([1e-5, 1e-5, 0.4, 0.4])
            sliver = [clip_at(f, d, rng, size) for f, d in zip(fixed, depths, strict=True)]
            plane = from_pixels(x, y, 0.5, width=size, height=size)
            ids, _ = draw(np.vstack([sliver, plane]), [[0, 1, 2], [0, 1, 3], [4, 5, 6]], size, size, device)
            assert (ids[0, 16, 16] != 2) == sliver_wins


def test_both_sides_of_a_face_are_drawn_alike(device):
    clip, faces = random_triangles(np.random.default_rng(10), 30)
    front, _ = draw(clip, faces, 32, 32, device)
    back, _ = draw(clip, faces[:, ::-1], 32, 32, device)
    certain = twin(clip, faces, 32, 32)[2]
    np.testing.assert_array_equal(front[0][certain], back[0][certain])


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 2**32 - 1))
def test_the_order_of_faces_does_not_change_the_image(device, seed):
    rng = np.random.default_rng(seed)
    clip, faces = random_triangles(rng, 60)
    order = rng.permutation(60)
    face_ids, weights = draw(clip, faces, 32, 32, device)
    permuted_ids, permuted_weights = draw(clip, faces[order], 32, 32, device)
    np.testing.assert_array_equal(np.where(permuted_ids >= 0, order[permuted_ids], -1), face_ids)
    np.testing.assert_array_equal(permuted_weights, weights)


def test_of_equal_faces_the_lowest_index_wins(device):
    clip, faces = random_triangles(np.random.default_rng(11), 20)
    face_ids, _ = draw(clip, faces, 32, 32, device)
    for copies in (np.vstack([faces, faces]), np.repeat(faces, 2, axis=0)):
        first = np.array([np.flatnonzero((copies == face).all(1))[0] for face in faces])
        doubled, _ = draw(clip, copies, 32, 32, device)
        np.testing.assert_array_equal(doubled, np.where(face_ids >= 0, first[face_ids], -1))


def test_interpolation_is_perspective_correct(device):
    """World positions interpolated over a slanted plane are where the rays of the pixels meet that plane."""
    camera = Camera.look_at((0.3, 1.0, 2.0), (0, 0, 0), fov_y=50.0, size=(31, 17))
    corners = np.array([[-9, 0, -9], [9, 0, -9], [9, 0, 9], [-9, 0, 9]], np.float32)  # reaches behind the camera
    positions = wp.array(corners[None], dtype=wp.vec3, device=device)
    matrices = wp.array(camera.clip_matrix()[None], dtype=wp.mat44, device=device)
    clip = to_clip(positions, matrices)
    faces = wp.array([[0, 1, 2], [2, 3, 0]], dtype=wp.vec3i, device=device)
    fragments = rasterize(clip, faces, camera.width, camera.height)
    hit = interpolate(fragments, faces, positions).numpy()[0]
    origin, directions = camera.rays()
    expected = origin - directions * (origin[1] / directions[..., 1:2])
    seen = fragments.face_ids.numpy()[0] >= 0
    inside = (directions[..., 1] < 0) & (np.abs(expected) < 8.9).all(-1)
    assert inside.mean() > 0.5 and seen[inside].all()
    np.testing.assert_allclose(hit[inside], expected[inside], rtol=1e-4, atol=1e-4)
    assert (hit[~seen] == 0).all()


@pytest.mark.parametrize(("dtype", "channels"), [(wp.float32, ()), (wp.vec2, (2,)), (wp.vec3, (3,)), (wp.vec4, (4,))])
def test_interpolation_takes_scalars_and_vectors_and_other_topologies_and_one_batch_for_all(dtype, channels, device):
    rng = np.random.default_rng(12)
    (clip, faces), (other, _) = random_triangles(rng, 15), random_triangles(rng, 15)
    fragments = rasterize(*on_device(np.stack([clip, other]), faces, device), 16, 24)
    attribute_faces = rng.integers(0, 9, (15, 3))
    device_faces = wp.array(attribute_faces, dtype=wp.vec3i, device=device)
    ids, weights = fragments.face_ids.numpy(), fragments.barycentrics.numpy()
    for batch_count in (1, 2):
        attributes = rng.normal(size=(batch_count, 9, *channels)).astype(np.float32)
        image = interpolate(fragments, device_faces, wp.array(attributes, dtype=dtype, device=device)).numpy()
        full = np.broadcast_to(attributes, (2, 9, *channels))
        for i in range(2):
            corners = full[i][attribute_faces[ids[i]]]
            expected = np.einsum("hwk,hwk...->hw...", weights[i], corners)
            expected[ids[i] < 0] = 0.0
            np.testing.assert_allclose(image[i], expected, rtol=1e-5, atol=1e-6)


def test_each_instance_of_a_batch_equals_its_own_image(device):
    (a, faces), (b, _) = (random_triangles(np.random.default_rng(seed), 25) for seed in (13, 14))
    ids, weights = draw(np.stack([a, b]), faces, 21, 13, device)
    for i, clip in enumerate((a, b)):
        alone_ids, alone_weights = draw(clip, faces, 21, 13, device)
        np.testing.assert_array_equal(ids[i], alone_ids[0])
        np.testing.assert_array_equal(weights[i], alone_weights[0])


def test_dealing_the_rows_of_a_face_to_several_threads_gives_the_same_image(device, monkeypatch):
    clip, faces = random_triangles(np.random.default_rng(15), 30)
    expected, _ = draw(clip, faces, 40, 31, device)
    monkeypatch.setattr(sys.modules[rasterize.__module__], "strip_count", lambda device: 7)
    face_ids, _ = draw(clip, faces, 40, 31, device)
    np.testing.assert_array_equal(face_ids, expected)


def test_no_faces_and_no_vertices_give_background(device):
    ids, weights = draw(np.zeros((1, 0, 4)), np.zeros((0, 3)), 3, 2, device)
    assert ids.shape == (1, 2, 3) and (ids == -1).all() and (weights == 0).all()


def test_non_finite_positions_are_refused(device):
    clip, faces = random_triangles(np.random.default_rng(16), 3)
    for value in (np.nan, np.inf):
        clip[4, 1] = value
        with pytest.raises(ValueError, match="^clip_positions: got 1 "):
            draw(clip, faces, 8, 8, device)


@pytest.mark.parametrize("index", [-1, 9, 2**31 - 1])
def test_indices_of_no_vertex_are_refused(index, device):
    clip, faces = random_triangles(np.random.default_rng(17), 3)
    faces[1, 2] = index
    with pytest.raises(ValueError, match="^faces: got 1 .*expected 0 to 8"):
        draw(clip, faces, 8, 8, device)


@pytest.mark.parametrize(("width", "height", "name"), [(0, 4, "width"), (4, -1, "height"), (40000, 4, "width")])
def test_image_sizes_out_of_range_are_refused(width, height, name, device):
    with pytest.raises(ValueError, match=f"^{name}: got"):
        rasterize(*on_device(np.zeros((3, 4)), [[0, 1, 2]], device), width, height)


def test_attributes_of_a_wrong_batch_or_dtype_are_refused(device):
    clip, faces = on_device(*random_triangles(np.random.default_rng(18), 3), device)
    fragments = rasterize(clip, faces, 4, 4)
    two = Fragments(
        *(
            wp.array(np.repeat(array.numpy(), 2, axis=0), dtype=array.dtype, device=device)
            for array in (fragments.face_ids, fragments.barycentrics)
        )
    )
    with pytest.raises(ValueError, match="^attributes: got a batch of 3, expected 1 or 2"):
        interpolate(two, faces, wp.zeros((3, 9), dtype=wp.vec3, device=device))
    with pytest.raises(ValueError, match="^attributes: got dtype"):
        interpolate(fragments, faces, wp.zeros((1, 9), dtype=wp.vec3d, device=device))


def test_one_instance_of_fragments_or_attributes_serves_all_of_the_other(device, verified_tape):
    clip, faces = on_device(*random_triangles(np.random.default_rng(20), 5), device)
    fragments = rasterize(clip, faces, 12, 12)
    rng = np.random.default_rng(21)
    attributes = wp.array(rng.normal(size=(3, 15, 3)), dtype=wp.vec3, device=device, requires_grad=True)
    with wp.Tape() as tape:
        images = interpolate(fragments, faces, attributes)
    weights = rng.normal(size=(*images.shape, 3)).astype(np.float32)
    tape.backward(grads={images: wp.array(weights, dtype=wp.vec3, device=device)})
    for instance in range(3):
        own = attributes[instance : instance + 1]
        alone = wp.array(own.numpy(), dtype=wp.vec3, device=device, requires_grad=True)
        with wp.Tape() as tape:
            image = interpolate(fragments, faces, alone)
        tape.backward(grads={image: wp.array(weights[instance][None], dtype=wp.vec3, device=device)})
        np.testing.assert_array_equal(image.numpy()[0], images.numpy()[instance])
        np.testing.assert_allclose(alone.grad.numpy()[0], attributes.grad.numpy()[instance], atol=1e-5)


def test_the_gradient_of_barycentrics_matches_central_differences_also_across_the_near_plane(device, verified_tape):
    rng = np.random.default_rng(19)
    width, height = 24, 18
    clip, faces = random_triangles(rng, 12)
    clip_positions, device_faces = on_device(clip, faces, device, requires_grad=True)
    seed = rng.normal(size=(1, height, width, 3)).astype(np.float32)
    with wp.Tape() as tape:
        fragments = rasterize(clip_positions, device_faces, width, height)
    tape.backward(grads={fragments.barycentrics: wp.array(seed, dtype=wp.vec3, device=device)})
    ids = fragments.face_ids.numpy()[0]
    assert (clip[faces[np.unique(ids[ids >= 0])], 3] < 0.0).any(), "no face behind the eye is seen"
    rows, columns = np.nonzero(ids >= 0)
    x, y = (2 * columns + 1) / width - 1, (2 * rows + 1) / height - 1

    def loss(positions):
        weights = twin_weights(positions[faces[ids[rows, columns]]], x[:, None], y[:, None])
        return (weights * seed[0, rows, columns]).sum()

    expected = central_differences(loss, clip.astype(np.float64))
    got = clip_positions.grad.numpy()[0]
    assert np.abs(expected).max() > 1.0
    # float32, and faces seen edge-on have large derivatives: relative to the largest of each vertex.
    scale = np.abs(expected).max(axis=-1, keepdims=True) + 1e-2
    np.testing.assert_allclose(got / scale, expected / scale, atol=2e-3)


def test_barycentrics_refuse_positions_of_another_batch(device):
    clip, faces = on_device(*random_triangles(np.random.default_rng(22), 3), device)
    face_ids = wp.zeros((2, 4, 4), dtype=wp.int32, device=device)
    with pytest.raises(ValueError, match="^clip_positions: got shape"):
        find_barycentrics(face_ids, faces, clip)


def test_barycentrics_of_kept_face_ids_equal_those_of_rasterize(device):
    clip, faces = on_device(*random_triangles(np.random.default_rng(21), 20), device)
    fragments = rasterize(clip, faces, 20, 20)
    again = find_barycentrics(fragments.face_ids, faces, clip)
    np.testing.assert_array_equal(again.numpy(), fragments.barycentrics.numpy())


def test_gradients_flow_through_the_whole_pipeline_into_positions(device, verified_tape):
    """Sliding a textured quad sideways changes each pixel by minus the slope of its texture."""
    corners = np.array([[-1, -1, 2], [1, -1, 2], [1, 1, 2], [-1, 1, 2]], np.float32)
    camera = Camera(np.diag([8.0, 8.0, 1.0]) + [[0, 0, 4], [0, 0, 4], [0, 0, 0]], np.eye(3), np.zeros(3), 8, 8)
    positions = wp.array(corners[None], dtype=wp.vec3, device=device, requires_grad=True)
    matrices = wp.array(camera.clip_matrix()[None], dtype=wp.mat44, device=device)
    faces = wp.array([[0, 1, 2], [2, 3, 0]], dtype=wp.vec3i, device=device)
    texture = wp.array(3.0 * corners[None, :, 0], dtype=wp.float32, device=device)
    with wp.Tape() as tape:
        image = interpolate(rasterize(to_clip(positions, matrices), faces, 8, 8), faces, texture)
    tape.backward(grads={image: wp.ones_like(image)})
    slide = positions.grad.numpy()[0, :, 0].sum()
    assert slide == pytest.approx(-3.0 * 64, rel=1e-4)
