"""Receivers: vertices, points that samples see, and how an image gets its light from them."""

import itertools

import numpy as np
import pytest
import trimesh
import warp as wp

import warpshadow as ws
from warpshadow.assets.primitives import icosphere
from warpshadow.stages.geometry.normals import vertex_normals
from warpshadow.stages.raster.interpolation import interpolate
from warpshadow.stages.raster.project import to_clip
from warpshadow.stages.raster.rasterization import Fragments, rasterize
from warpshadow.stages.receivers.receivers import find_receivers
from warpshadow.stages.receivers.vertex_receivers import number_receivers, seen_vertices
from warpshadow.stages.silhouettes.silhouettes import Silhouettes, find_silhouettes

# Interpolated float32 positions of size 1.
FLOAT32 = 2e-6
# Sums of interpolated positions are linear in the vertices but for the normalization of normals.
GRADIENT = 5e-3

pytestmark = pytest.mark.usefixtures("poisoned_outputs")


def two_triangles(device, cameras: int, requires_grad=False):
    """A mesh of two bodies of a triangle each, seen by some cameras."""
    positions = np.array([[(-1, 0, 0), (0, 0, 0), (-0.5, 1, 0), (0.2, 0, 0.1), (1, 0.1, 0), (0.5, 1, 0.2)]])
    eyes = [(0.2 * k, 0.5, 3.0 - 0.3 * k) for k in range(cameras)]
    matrices = [ws.Camera.look_at(eye, (0, 0.5, 0), size=(12, 12)).clip_matrix() for eye in eyes]
    positions = wp.array(positions, dtype=wp.vec3, device=device, requires_grad=requires_grad)
    faces = wp.array([(0, 1, 2), (3, 4, 5)], dtype=wp.vec3i, device=device)
    return positions, faces, wp.array(np.array(matrices), dtype=wp.mat44, device=device)


def receivers_of(positions, faces, matrices, has_sample_receivers, supersampling=1):
    fragments = rasterize(to_clip(positions, matrices), faces, 12, 12)
    wants = np.array(has_sample_receivers)
    numbering = number_receivers(np.repeat(~wants, 3)[None], device=faces.device)
    found = find_receivers(
        positions, vertex_normals(positions, faces), faces, fragments, numbering, wants, supersampling=supersampling
    )
    return found, fragments


@pytest.mark.parametrize("cameras", [1, 3])
@pytest.mark.parametrize("has_sample_receivers", [(False, False), (True, False), (False, True), (True, True)])
def test_what_samples_get_from_their_receivers_is_what_lies_where_they_look(device, cameras, has_sample_receivers):
    positions, faces, matrices = two_triangles(device, cameras)
    found, fragments = receivers_of(positions, faces, matrices, has_sample_receivers)
    for own, attribute in ((found.points, positions), (found.normals, vertex_normals(positions, faces))):
        got = interpolate(found.fragments, found.faces, own).numpy()
        expected = interpolate(fragments, faces, attribute).numpy()
        assert np.abs(got - expected).max() < FLOAT32


def means_over_pixels(image, face_ids, supersampling):
    """Twin: the mean over the samples of a pixel that see the same face."""
    views, height, width = face_ids.shape
    means = np.zeros(image.shape)
    for view, row, column in np.argwhere(face_ids >= 0):
        block = (
            view,
            *(
                slice(k // supersampling * supersampling, k // supersampling * supersampling + supersampling)
                for k in (row, column)
            ),
        )
        means[view, row, column] = image[block][face_ids[block] == face_ids[view, row, column]].mean(axis=0)
    return means


@pytest.mark.parametrize("supersampling", [2, 3])
@pytest.mark.parametrize("has_sample_receivers", [(True, False), (True, True)])
def test_samples_of_a_pixel_that_see_the_same_face_share_a_receiver_at_their_mean(
    device, supersampling, has_sample_receivers
):
    positions, faces, matrices = two_triangles(device, 2)
    found, fragments = receivers_of(positions, faces, matrices, has_sample_receivers, supersampling)
    face_ids = fragments.face_ids.numpy()
    is_own = (face_ids >= 0) & np.array(has_sample_receivers)[face_ids]
    for own, attribute in ((found.points, positions), (found.normals, vertex_normals(positions, faces))):
        got = interpolate(found.fragments, found.faces, own).numpy()
        at_samples = interpolate(fragments, faces, attribute).numpy()
        expected = np.where(is_own[..., None], means_over_pixels(at_samples, face_ids, supersampling), at_samples)
        assert np.abs(got - expected).max() < FLOAT32
    own_count = found.points.shape[1] - 3 * (2 - sum(has_sample_receivers))
    assert is_own.sum(axis=(1, 2)).max() / supersampling**2 < own_count < 0.8 * is_own.sum(axis=(1, 2)).max()


def slats(device, *, bend: float = 0.0):
    """Two slats side by side with a gap narrower than a pixel, of two long faces each, which bend along the diagonal.

    Returns positions, faces, fragments and, for each sample of 10 × 10 pixels, the point that it sees.
    """
    corners = np.array([(-3, 0, 0), (3, 0, 0), (3, 0.45, bend), (-3, 0.45, 0)])
    positions = np.concatenate([corners, corners + (0, 0.53, 0)])[None]
    positions = wp.array(positions, dtype=wp.vec3, device=device)
    faces = np.array([(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)], np.int32)
    faces = wp.array(faces, dtype=wp.vec3i, device=device)
    camera = ws.Camera.look_at((0.1, 0.4, 3.0), (0, 0.38, 0), size=(20, 20), fov_y=40)
    matrix = wp.array(camera.clip_matrix()[None], dtype=wp.mat44, device=device)
    fragments = rasterize(to_clip(positions, matrix), faces, 20, 20)
    return positions, faces, fragments, interpolate(fragments, faces, positions).numpy()[0]


def shared_receivers(positions, faces, fragments, pieces):
    wants, normals = np.ones(4, bool), vertex_normals(positions, faces)
    numbering = number_receivers(np.zeros((1, 8), bool), device=faces.device)
    pieces = wp.array(pieces, dtype=wp.int32, device=faces.device)
    arguments = positions, normals, faces, fragments, numbering, wants
    found = find_receivers(*arguments, supersampling=2, smooth_pieces=pieces)
    return found.points.shape[1], interpolate(found.fragments, found.faces, found.points).numpy()[0]


def test_samples_of_a_pixel_that_see_two_slats_have_receivers_on_their_own(device):
    positions, faces, fragments, seen = slats(device)
    is_seen, own_slat = (fragments.face_ids.numpy()[0] >= 0, seen[..., 1] > 0.49)
    count, got = shared_receivers(positions, faces, fragments, (0, 0, 1, 1))
    assert ((got[..., 1] > 0.49) == own_slat)[is_seen].all()
    fewer, mixed = shared_receivers(positions, faces, fragments, (0, 0, 0, 0))
    assert ((mixed[..., 1] > 0.49) != own_slat)[is_seen].any()  # pixels do see both
    most, _ = shared_receivers(positions, faces, fragments, (0, 1, 2, 3))
    assert fewer < count < most  # but faces of one slat share


def test_a_receiver_of_several_faces_is_on_them_where_it_is_nearest_to_the_mean_of_its_samples(device):
    positions, faces, fragments, seen = slats(device, bend=0.1)
    face_ids = fragments.face_ids.numpy()[0]
    _, got = shared_receivers(positions, faces, fragments, (0, 0, 1, 1))
    corners = positions.numpy()[0][faces.numpy()]
    several = 0
    for row, column in np.ndindex(10, 10):
        block = slice(2 * row, 2 * row + 2), slice(2 * column, 2 * column + 2)
        for slat in (0, 1):
            of_slat = face_ids[block] // 2 == slat
            of_slat &= face_ids[block] >= 0
            own = np.unique(face_ids[block][of_slat])
            if len(own) == 2:
                several += 1
                middle = seen[block][of_slat].mean(axis=0)
                on_faces = trimesh.triangles.closest_point(corners[own], np.tile(middle, (2, 1)))
                nearest = on_faces[np.linalg.norm(on_faces - middle, axis=1).argmin()]
                assert np.abs(got[block][of_slat] - nearest).max() < 10 * FLOAT32
    assert several > 5


def test_while_a_graph_is_captured_every_sample_has_room_for_a_receiver(device):
    positions, faces, matrices = two_triangles(device, 2)
    arguments = positions, faces, matrices, (True, False), 2
    expected, _ = receivers_of(*arguments)
    fragments = rasterize(to_clip(positions, matrices), faces, 12, 12)
    normals = vertex_normals(positions, faces)
    wants = np.array([True, False])
    numbering = number_receivers(np.repeat(~wants, 3)[None], device=faces.device)
    with wp.ScopedCapture(device=device) as capture:
        found = find_receivers(positions, normals, faces, fragments, numbering, wants, supersampling=2)
    wp.capture_launch(capture.graph)
    assert found.points.shape[1] == 3 + 12 * 12
    for own, others in ((found.points, expected.points), (found.normals, expected.normals)):
        got = interpolate(found.fragments, found.faces, own).numpy()
        np.testing.assert_array_equal(got, interpolate(expected.fragments, expected.faces, others).numpy())


def test_vertices_that_only_samples_stand_for_are_not_receivers(device):
    positions, faces, matrices = two_triangles(device, 1)
    found, fragments = receivers_of(positions, faces, matrices, (True, False))
    sample_count = (fragments.face_ids.numpy() == 0).sum()
    assert found.points.shape == (1, 3 + sample_count) and sample_count > 10
    np.testing.assert_array_equal(found.points.numpy()[0, :3], positions.numpy()[0, 3:])
    all_vertices, _ = receivers_of(positions, faces, matrices, (False, False))
    assert all_vertices.points is positions


def test_views_of_one_geometry_share_the_vertices_that_any_of_them_sees(device):
    positions, faces, matrices = two_triangles(device, 3)
    normals = vertex_normals(positions, faces)
    fragments = rasterize(to_clip(positions, matrices), faces, 12, 12)
    numbering = number_receivers(np.array([[False, False, False, True, True, True]]), device=faces.device)
    found = find_receivers(positions, normals, faces, fragments, numbering, np.zeros(2, bool))
    np.testing.assert_array_equal(found.points.numpy(), positions.numpy()[:, 3:])
    np.testing.assert_array_equal(found.normals.numpy(), normals.numpy()[:, 3:])
    np.testing.assert_array_equal(found.receiver_of_vertex.numpy(), [-1, -1, -1, 0, 1, 2])
    np.testing.assert_array_equal(found.faces.numpy()[1], [0, 1, 2])
    assert found.fragments is fragments


def test_vertices_of_seen_faces_and_of_edges_at_silhouettes_have_a_part_in_the_image(device):
    faces = wp.array([(0, 1, 2), (2, 3, 4), (5, 6, 7)], dtype=wp.vec3i, device=device)
    face_ids = wp.array([[[-1, 1, 1]], [[-1, -1, -1]]], dtype=wp.int32, device=device)
    edges = wp.array([[(-1, -1), (-2, -2), (7, 0), (-1, -1)]], dtype=wp.vec2i, device=device)
    fragments = Fragments(face_ids, None)
    seen = seen_vertices(fragments, Silhouettes(None, edges, None, None, fragments, faces), 9)
    np.testing.assert_array_equal(np.argwhere(seen), [[0, vertex] for vertex in (0, 2, 3, 4, 7)])


def test_no_vertex_has_a_part_in_an_image_of_nothing(device):
    positions, faces, matrices = two_triangles(device, 1)
    away = wp.array(positions.numpy() + [100, 0, 0], dtype=wp.vec3, device=device)
    clip = to_clip(away, matrices)
    fragments = rasterize(clip, faces, 12, 12)
    edges = wp.array(np.full((2, 3), -1), dtype=wp.vec3i, device=device)
    assert not seen_vertices(fragments, find_silhouettes(fragments, faces, edges, clip), 6).any()


@pytest.mark.parametrize("supersampling", [1, 2])
def test_gradients_through_receivers_are_central_differences(device, verified_tape, supersampling):
    """The samples of a moving mesh stay on their faces, and their receivers move along their rays."""
    positions, faces, matrices = two_triangles(device, 2, requires_grad=True)
    rng = np.random.default_rng(0)

    def loss(array):
        found, _ = receivers_of(array, faces, matrices, (True, False), supersampling)
        return found.points, found.normals

    with wp.Tape() as tape:
        points, normals = loss(positions)
    weights = rng.normal(size=(2, *points.shape, 3)).astype(np.float32)
    seeds = [wp.array(weight, dtype=wp.vec3, device=device) for weight in weights]
    tape.backward(grads={points: seeds[0], normals: seeds[1]})
    direction = rng.normal(size=(1, 6, 3))
    losses = []
    for step in (2e-3, -2e-3):
        moved = wp.array(positions.numpy() + step * direction, dtype=wp.vec3, device=device)
        results = loss(moved)
        if results[0].shape != points.shape:
            pytest.fail("the step is so large that a sample sees another face")
        losses.append(sum((w * r.numpy().astype(float)).sum() for w, r in zip(weights, results, strict=True)))
    products = positions.grad.numpy() * direction
    assert abs(products.sum() - (losses[0] - losses[1]) / 4e-3) < GRADIENT * np.linalg.norm(products)


@pytest.mark.parametrize("has_sample_receivers", [(False, False), (True, False), (False, True), (True, True)])
def test_receivers_of_bodies_that_are_told_apart_follow_each_other(device, has_sample_receivers):
    """The order differs, and nothing else; each span has receivers of its body alone."""
    positions, faces, matrices = two_triangles(device, 3)
    normals, wants = vertex_normals(positions, faces), np.array(has_sample_receivers)
    fragments = rasterize(to_clip(positions, matrices), faces, 12, 12)
    bodies = np.array([1, -1])
    numbering = number_receivers(np.repeat(~wants, 3)[None], bodies=np.repeat(bodies, 3), device=faces.device)
    found = find_receivers(positions, normals, faces, fragments, numbering, wants, bodies)
    got = interpolate(found.fragments, found.faces, found.points).numpy()
    assert np.abs(got - interpolate(fragments, faces, positions).numpy()).max() < FLOAT32
    assert [span.first for span in found.spans] == [0, *(span.end for span in found.spans[:-1])]
    assert found.spans[-1].end == found.points.shape[1]
    at_vertices = found.vertices.size
    for body, first, end in found.spans:
        face = bodies.tolist().index(body)
        if first < at_vertices:
            assert set(found.vertices.numpy()[first:end] // 3) == {face}
        else:
            sides = found.sample_fragments.face_ids.numpy()[:, first - at_vertices : end - at_vertices]
            assert set(sides[sides >= 0]) == {face}
            corners = positions.numpy()[0][faces.numpy()[sides]]
            at = np.einsum(
                "brk,brkx->brx",
                found.sample_fragments.barycentrics.numpy()[:, first - at_vertices : end - at_vertices],
                corners,
            )
            gaps = np.abs(at - found.points.numpy()[:, first:end])[sides >= 0]
            assert gaps.max() < FLOAT32


def seen_points(device, mesh, matrix, *, lifts_to_smooth_surface, turned=False):
    """Points of all samples that see a mesh, from its front or, turned over, from behind."""
    positions = wp.array(mesh.positions[None], dtype=wp.vec3, device=device)
    faces = wp.array(mesh.faces[:, ::-1] if turned else mesh.faces, dtype=wp.vec3i, device=device)
    normals = vertex_normals(positions, faces)
    fragments = rasterize(to_clip(positions, wp.array([matrix], dtype=wp.mat44, device=device)), faces, 24, 24)
    wants = np.ones(len(mesh.faces), bool)
    numbering = number_receivers(np.zeros((1, len(mesh.positions)), bool), device=faces.device)
    return find_receivers(
        positions, normals, faces, fragments, numbering, wants, lifts_to_smooth_surface=lifts_to_smooth_surface
    ).points.numpy()[0]


def test_points_for_rays_rise_towards_the_surface_that_normals_round(device):
    ball, matrix = icosphere(1.0, 2), ws.Camera.look_at((0, 0, 3), (0, 0, 0), fov_y=30, size=(24, 24)).clip_matrix()
    flat, risen = (
        np.linalg.norm(seen_points(device, ball, matrix, lifts_to_smooth_surface=lifts_to_smooth_surface), axis=1)
        for lifts_to_smooth_surface in (False, True)
    )
    assert 1 - flat.min() > 0.015
    assert risen.min() > 1 - FLOAT32 and risen.max() - 1 < 1 - flat.min()  # out of its faces, and not far


def test_points_for_rays_stay_where_normals_say_nothing_of_a_smooth_surface(device):
    matrix = ws.Camera.look_at((1, 2, 3), (0, 0, 0), fov_y=30, size=(24, 24)).clip_matrix()
    corners = np.array([*itertools.product((-0.5, 0.5), repeat=3)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    box = ws.Mesh(corners, [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))])
    for mesh in (ws.plane(1.0, 2), box):  # vertices of the box have one normal for three faces
        flat, risen = (
            seen_points(device, mesh, matrix, lifts_to_smooth_surface=lifts_to_smooth_surface)
            for lifts_to_smooth_surface in (False, True)
        )
        assert np.abs(risen - flat).max() < FLOAT32
    hollow = seen_points(device, icosphere(1.0, 2), matrix, lifts_to_smooth_surface=True, turned=True)
    np.testing.assert_allclose(
        hollow, seen_points(device, icosphere(1.0, 2), matrix, lifts_to_smooth_surface=False), atol=FLOAT32
    )


@pytest.mark.parametrize("sampling", ["independent", "shared"])
def test_a_coarse_ball_has_a_smooth_terminator_by_rays(sampling):
    lamp = np.zeros((32, 64, 3), np.float32)
    lamp[12, 16] = 1.0  # above the horizon, to one side
    camera = ws.Camera.look_at((0, 0, 4), (0, 0, 0), fov_y=40, size=(48, 48))
    rays = ws.Visibility("ray-traced", samples=64, sampling=sampling)
    lit, unshadowed = (
        ws.render(ws.Scene([body], ws.EnvironmentMap(lamp), camera, rays), progress=False)[..., 0]
        for body in (ws.Body(icosphere(1.0, 2)), ws.Body(icosphere(1.0, 2), blockers=0))
    )
    assert unshadowed.max() > 0
    assert np.abs(lit - unshadowed).max() < 0.02 * unshadowed.max()  # nothing is there to cast a shadow on the ball
