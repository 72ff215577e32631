"""Ray-traced visibility, shading and transfer of a mesh against formulas and a float64 twin."""

import numpy as np
import pytest
import warp as wp

import warpshadow as ws
from warpshadow.assets.basis import CellBasis, HarmonicBasis
from warpshadow.assets.mesh import Mesh
from warpshadow.assets.primitives import icosphere, plane
from warpshadow.maths import sh
from warpshadow.maths.directions import cell_radius, fibonacci
from warpshadow.pipeline.renderer import SceneRenderer
from warpshadow.stages.light.light_samples import SET_COUNT, cell_samples, even_samples, sample_map
from warpshadow.stages.ray_traced.traced_transfer import trace_transfer
from warpshadow.stages.rays import ray_tracing
from warpshadow.stages.rays.ray_tracing import first_hit, trace_cells, trace_shading, trace_visibility

SEED = 5


def warp_mesh(mesh: Mesh, device) -> wp.Mesh:
    points = wp.array(mesh.positions, dtype=wp.vec3, device=device)
    return wp.Mesh(points, wp.array(mesh.faces.ravel(), dtype=wp.int32, device=device))


def trace(mesh: wp.Mesh | None, points, normals, directions, device) -> np.ndarray:
    def vectors(values):
        return wp.array(np.asarray(values, np.float32), dtype=wp.vec3, device=device)

    return trace_visibility(mesh, vectors(points), vectors(normals), vectors(directions)).numpy()


def test_a_ball_over_a_plane_blocks_its_cone_of_directions(device):
    center, radius = np.array([0.2, 1.5, -0.1]), 0.8
    ball = icosphere(radius, 5)
    mesh = warp_mesh(Mesh(ball.positions + center, ball.faces), device)
    rng = np.random.default_rng(SEED)
    points = np.zeros((2, 30, 3))
    points[..., ::2] = rng.uniform(-3, 3, size=(2, 30, 2))
    normals = np.tile([0.0, 1.0, 0.0], (2, 30, 1))
    directions = fibonacci(512)
    visible = trace(mesh, points, normals, directions, device)

    toward = center - points
    distance = np.linalg.norm(toward, axis=-1, keepdims=True)
    cosine = (toward / distance) @ directions.T
    edge = np.sqrt(1 - (radius / distance) ** 2)
    expected = (cosine <= edge) & (directions[:, 1] > 0)
    clear = np.abs(np.arccos(np.clip(cosine, -1, 1)) - np.arccos(edge)) > 0.02  # the facets are not quite the sphere
    assert clear.mean() > 0.9
    np.testing.assert_array_equal(visible[clear], expected[clear])


def test_points_of_a_convex_mesh_see_their_whole_hemisphere(device):
    ball = icosphere(100.0, 3)
    normals = ball.positions / np.linalg.norm(ball.positions, axis=1, keepdims=True)
    directions = fibonacci(128)
    visible = trace(warp_mesh(ball, device), ball.positions[None], normals[None], directions, device)[0]
    cosine = normals @ directions.T
    facet_angle = 0.12  # facets next to a vertex tilt against its normal by this much
    assert visible[cosine > facet_angle].all()
    assert not visible[cosine <= 0].any()


def moeller_trumbore(mesh: Mesh, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Whether rays meet any face, float64: bool of shape [point, direction]."""
    corners = mesh.positions[mesh.faces].astype(np.float64)
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    directions_by_second = np.cross(directions[:, None], second[None])  # [direction, face, 3]
    determinant = (directions_by_second * first).sum(axis=-1)
    from_corner = points[:, None] - corners[None, :, 0]  # [point, face, 3]
    u = np.einsum("pfi,dfi->pdf", from_corner, directions_by_second) / determinant
    sideways = np.cross(from_corner, first)
    v = np.einsum("pfi,di->pdf", sideways, directions) / determinant
    distance = (sideways * second).sum(axis=-1)[:, None] / determinant
    return ((u > 0) & (v > 0) & (u + v < 1) & (distance > 0)).any(axis=-1)


def test_moeller_and_trumbore_find_the_same_rays_blocked(device):
    ball = icosphere(1.0, 2)
    mesh = Mesh(ball.positions * [1.5, 0.3, 1.0] + np.sin(3 * ball.positions[:, ::-1]), ball.faces)  # not convex
    rng = np.random.default_rng(SEED)
    points = rng.uniform(-2, 2, size=(40, 3)).astype(np.float32).astype(np.float64)
    normals = rng.normal(size=(40, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    directions = fibonacci(32)
    visible = trace(warp_mesh(mesh, device), points[None], normals[None], directions, device)[0]

    hit = moeller_trumbore(mesh, points, directions)
    expected = ~hit & (normals @ directions.T > 0)
    assert 0.1 < hit.mean() < 0.9
    assert (visible == expected).mean() > 0.998  # rays through edges may go either way


def test_normals_of_another_shape_are_refused(device):
    mesh = warp_mesh(icosphere(1.0, 1), device)
    with pytest.raises(ValueError, match="normals: got shape"):
        trace(mesh, np.zeros((1, 2, 3)), np.ones((1, 1, 3)), fibonacci(16), device)


# ---------------------------------------------------------------------------------------------- receivers on faces


def joined(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(mesh.vertex_count for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(np.concatenate([mesh.positions for mesh in meshes]), np.concatenate(faces))


OBJECTS = {
    "a ball that touches the ground": lambda size: icosphere(size / 2, 2).transformed(translation=[0, size / 2, 0]),
    "a plate a thousandth of its size above": lambda size: plane(size, 1).transformed(translation=[0, size / 1000, 0]),
    "a leaning plate": lambda size: plane(size, 1).transformed(
        rotation=np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]]), translation=[0, 0.301 * size, 0]
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("segments", [1, 64])
@pytest.mark.parametrize("name", OBJECTS)
def test_shadows_of_what_touches_a_ground_of_any_size_are_its_own_whatever_its_size(name, segments, device):
    """No ray starts beyond what it is to meet, and none meets the ground that it starts from."""
    directions = fibonacci(64)
    spots = np.random.default_rng(SEED).uniform(-1, 1, size=(40, 3)) * [1, 0, 1]
    for size in (1e-3, 1.0, 1e3):
        body = OBJECTS[name](size)
        for ground_size in (1.0, 1e2, 1e5):
            points = (spots * min(0.8 * size, 0.5 * ground_size)).astype(np.float32)
            mesh = warp_mesh(joined(body, plane(ground_size, segments)), device)
            up = np.tile([0.0, 1.0, 0.0], (1, len(points), 1))
            visible = trace(mesh, points[None], up, directions, device)[0]
            expected = ~moeller_trumbore(body, points.astype(np.float64), directions) & (directions[:, 1] > 0)
            assert (visible != expected).mean() < 0.002  # rays through edges may go either way


@pytest.mark.parametrize(("size", "distance"), [(1.0, 0.0), (1e5, 0.0), (100.0, 1e5), (1e5, 1e5)])
@pytest.mark.parametrize("segments", [1, 16])
def test_grounds_of_any_size_slope_and_place_cast_no_shadow_on_their_points(size, distance, segments, device):
    """Points are interpolated in float32, as those of pixels are, so they lie beside their faces, or on edges."""
    rng = np.random.default_rng(SEED)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.linalg.det(rotation)
    directions = fibonacci(128)
    ground = plane(size, segments).transformed(rotation=rotation, translation=distance * np.array([0.5, 0.3, -0.8]))
    weights = rng.dirichlet(np.ones(3), size=400)
    weights[::4, 0] = 0
    weights[::4] /= weights[::4].sum(axis=1, keepdims=True)
    corners = ground.positions[rng.choice(ground.faces, 400)]
    points = np.einsum("pk,pkx->px", weights.astype(np.float32), corners, dtype=np.float32)
    normals = np.tile(rotation[:, 1], (400, 1))
    visible = trace(warp_mesh(ground, device), points[None], normals[None], directions, device)[0]
    slope = 1e-2  # float32 turns faces of 6 units, 1e5 away, by a tenth of that
    assert visible[:, directions @ rotation[:, 1] > slope].all()


def test_scaling_a_scene_by_a_power_of_two_changes_no_ray(device):
    ball = icosphere(1.0, 2)
    bumpy = Mesh(ball.positions * (1 + 0.3 * np.sin(5 * ball.positions[:, ::-1])), ball.faces)
    normals = bumpy.positions / np.linalg.norm(bumpy.positions, axis=1, keepdims=True)
    directions = fibonacci(64)
    expected = trace(warp_mesh(bumpy, device), bumpy.positions[None], normals[None], directions, device)
    assert 0.2 < expected.mean() < 0.45
    for scale in (2.0**-40, 2.0**40):
        scaled = Mesh(scale * bumpy.positions, bumpy.faces)
        visible = trace(warp_mesh(scaled, device), scaled.positions[None], normals[None], directions, device)
        np.testing.assert_array_equal(visible, expected)


def test_light_from_behind_a_receivers_own_face_does_not_reach_it(device):
    """Smooth normals lean away from faces; then a face shades what lies on it, in the middle and at the corners."""
    sheet = plane(1.0, 1)
    points = np.array([[0.1, 0, 0.2], [0, 0, 0], [-0.5, 0, 0], [0.5, 0, 0.5]])
    normals = np.tile([0.6, 0.8, 0.0], (4, 1))
    directions = fibonacci(256)
    directions = directions[(directions @ normals[0] > 0) & (np.abs(directions[:, 1]) > 0.01)]
    visible = trace(warp_mesh(sheet, device), points[None], normals[None], directions, device)[0]
    from_behind = directions[:, 1] < 0
    assert from_behind.sum() > 20 and visible[:, ~from_behind].all()
    assert not visible[:3, from_behind].any()  # all such light comes from +x
    assert visible[3, from_behind].all()  # there past the corner


def test_rays_along_axes_meet_flat_faces(device):
    """Boxes of no height, met exactly from below, on them, on edges between them, and beside them."""
    points = np.array([[0.2, -1, 0.3], [0.2, 0, 0.3], [0.5, -1, 0.5], [0.5, 0, 0.5], [1.1, -1, 0.3], [1.1, 0, 0.3]])
    up = np.array([[0.0, 1.0, 0.0]])
    visible = trace(warp_mesh(plane(2.0, 4), device), points[None], np.repeat(up, 6, axis=0)[None], up, device)
    np.testing.assert_array_equal(visible[0, :, 0], [0, 1, 0, 1, 1, 1])


def test_faces_without_area_stop_no_ray(device):
    corners = np.array([[0, 1, 0], [1, 1, 0], [2, 1, 0], [0, 1, 0]], np.float32)
    mesh = warp_mesh(Mesh(corners, np.array([[0, 1, 2], [0, 0, 3], [1, 1, 2]])), device)
    up = np.array([[0.0, 1.0, 0.0]])
    assert trace(mesh, np.array([[[0.5, 0, 0], [0.5, 1, 0]]]), np.tile(up, (1, 2, 1)), up, device).all()


# ---------------------------------------------------------------------------------------------- nearest hits


@wp.kernel(enable_backward=False)
def _find_nearest(
    # in
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    # out
    faces: wp.array(dtype=wp.int32),
    weights: wp.array(dtype=wp.vec3),
    is_back: wp.array(dtype=wp.bool),
):
    """A thread owns a ray."""
    i = wp.tid()
    hit = first_hit(mesh, points[i], normals[i], directions[i])
    faces[i] = hit.face
    weights[i] = hit.weights
    is_back[i] = hit.is_back


def find_first_hits(mesh: Mesh, points, normals, directions, device) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Face, barycentrics, and whether it is met from behind, of the nearest hit of each ray."""
    count = len(points)
    outputs = [wp.empty(count, dtype=dtype, device=device) for dtype in (wp.int32, wp.vec3, wp.bool)]
    rays = [vectors(values, device) for values in (points, normals, directions)]
    hierarchy = warp_mesh(mesh, device)
    wp.launch(_find_nearest, count, inputs=[hierarchy.id, *rays], outputs=outputs, device=device)
    return tuple(output.numpy() for output in outputs)


def test_rays_meet_the_face_that_is_nearest_of_all(device):
    """Against the intersection of each ray with each face, in float64."""
    ball = icosphere(1.0, 2)
    mesh = Mesh(ball.positions * [1.5, 0.3, 1.0] + np.sin(3 * ball.positions[:, ::-1]), ball.faces)
    rng = np.random.default_rng(SEED)
    points, directions = rng.uniform(-2, 2, size=(2, 600, 3)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    faces, weights, is_back = find_first_hits(mesh, points, directions, directions, device)

    a, b, c = np.moveaxis(mesh.positions[mesh.faces].astype(np.float64), 1, 0)
    matrices = np.stack(np.broadcast_arrays(-directions[:, None], b - a, c - a), axis=-1)  # [ray, face, 3, 3]
    distance, v, w = np.moveaxis(np.linalg.solve(matrices, (points[:, None] - a)[..., None])[..., 0], -1, 0)
    is_hit = (distance > 0) & (np.minimum(v, w) > 0) & (v + w < 1)
    expected = np.where(is_hit, distance, np.inf).argmin(axis=1)
    expected[~is_hit.any(axis=1)] = -1
    assert 0.1 < (expected >= 0).mean() < 0.9
    same = faces == expected
    assert same.mean() > 0.995  # rays through edges may go either way
    hit, face = np.flatnonzero(same & (faces >= 0)), faces[same & (faces >= 0)]
    exact = np.stack([1 - v - w, v, w], axis=-1)[hit, face]
    np.testing.assert_allclose(weights[hit], exact, atol=2e-5)  # of float32 rays that graze faces
    from_behind = (np.cross(b - a, c - a)[face] * directions[hit]).sum(axis=1) > 0
    np.testing.assert_array_equal(is_back[hit], from_behind)
    assert 0.1 < from_behind.mean() < 0.9


def test_rays_below_the_face_that_a_receiver_lies_on_meet_nothing(device):
    """Not that face, and not what lies behind it; above it they meet what is there."""
    sheets = joined(*(plane(2.0, 1).transformed(translation=[0, height, 0]) for height in (-1.0, 0.0, 1.0)))
    normal = np.array([0.6, 0.8, 0.0])
    directions = fibonacci(256)
    directions = directions[(directions @ normal > 0) & (np.abs(directions[:, 1]) > 0.01)]
    points = np.tile([0.1, 0.0, 0.2], (len(directions), 1))
    faces, _, is_back = find_first_hits(sheets, points, np.tile(normal, (len(directions), 1)), directions, device)
    from_behind = directions[:, 1] < 0
    assert from_behind.sum() > 20 and (faces[from_behind] == -1).all()
    reached = points + directions / np.abs(directions[:, 1:2])
    inside = (np.abs(reached[:, [0, 2]]) < 1).all(axis=1)
    np.testing.assert_array_equal(faces[~from_behind] >= 4, inside[~from_behind])
    assert inside[~from_behind].sum() > 20 and is_back[~from_behind & inside].all()


# ---------------------------------------------------------------------------------------------- shading by rays

# 4096 directions of each of 16 sets: all together integrate any map to 0.1%, each by itself one that differs from pixel
# to pixel to 0.9% (measured).
SMOOTH, ROUGH = 2e-3, 1.5e-2


def smooth_functions(directions) -> np.ndarray:
    """Some low-order functions of directions, the last one the cosine that shading has, shape [..., function]."""
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    return np.stack([np.ones_like(x), x, y, z, x * y, z * z, np.maximum(0.6 * y + 0.8 * x, 0)], axis=-1)


def map_integral(radiance: np.ndarray, split: int = 4) -> np.ndarray:
    """∫ L f dω over every pixel of a map, by many points in each, float64 of shape [function, RGB]."""
    height = len(radiance)
    weights = np.repeat(sh.pixel_solid_angles(height * split)[:, None], 2 * height * split, axis=1)
    fine = np.repeat(np.repeat(radiance.astype(np.float64), split, axis=0), split, axis=1)
    functions = smooth_functions(sh.equirectangular_directions(height * split))
    return np.einsum("rcf,rcv,rc->fv", functions, fine, weights)


def maps() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(SEED)
    sun = rng.uniform(0.5, 1, size=(32, 64, 3)).astype(np.float32)
    sun[9, 20] = 1e5
    signed = sh.reconstruct_map(rng.normal(size=(16, 3)), 32)
    return {
        "constant": np.ones((16, 32, 3), np.float32),
        "rough": rng.uniform(size=(32, 64, 3)).astype(np.float32),
        "one hot pixel": sun,
        "negative lobes": signed.astype(np.float32),
        "dark": np.zeros((8, 16, 3), np.float32),
    }


@pytest.mark.parametrize("name", maps())
def test_drawn_light_integrates_every_function_as_the_map_does(name):
    radiance = maps()[name]
    samples = sample_map(radiance, 4096)
    estimates = np.einsum("snf,snv->sfv", smooth_functions(samples.directions), samples.radiance.astype(np.float64))
    exact = map_integral(radiance)
    scale = max(np.abs(map_integral(np.abs(radiance))).max(), 1e-30)
    assert np.abs(estimates.mean(axis=0) - exact).max() < SMOOTH * scale
    assert np.abs(estimates - exact).max() < ROUGH * scale


def test_directions_are_spread_evenly_over_each_pixel_however_large():
    """Even in latitude, which is not even in solid angle, would be off by 1.5% for four rows."""
    radiance = np.arange(1.0, 5.0).repeat(24).reshape(4, 8, 3).astype(np.float32)
    samples = sample_map(radiance, 2**14)
    estimate = np.einsum("snf,snv->fv", smooth_functions(samples.directions), samples.radiance) / SET_COUNT
    exact = map_integral(radiance, split=64)
    assert np.abs(estimate - exact).max() < 1e-3 * np.abs(exact).max()


def test_drawn_directions_are_unit_vectors_and_every_set_is_different():
    samples = sample_map(maps()["rough"], 64)
    assert samples.directions.shape == samples.radiance.shape == (SET_COUNT, 64, 3)
    assert np.abs(np.linalg.norm(samples.directions, axis=-1) - 1).max() < 1e-6
    for first in range(SET_COUNT):
        for second in range(first):
            distance = np.linalg.norm(samples.directions[first][:, None] - samples.directions[second], axis=-1)
            assert distance.min() > 0
    np.testing.assert_array_equal(sample_map(maps()["rough"], 64).directions, samples.directions)
    assert (sample_map(maps()["rough"], 64, seed=1).directions != samples.directions).any()


def test_a_set_is_stratified():
    """Of n directions from a constant map, each band of latitude gets its share to within a few, where random ones
    would miss by √n."""
    samples = sample_map(maps()["constant"], 1024)
    for directions in samples.directions:
        counts, _ = np.histogram(directions[:, 1], bins=8, range=(-1, 1))
        assert np.abs(counts - 128).max() <= 4


def test_a_drawn_direction_looks_at_the_pixel_whose_radiance_it_has():
    """Red and green halves, blue zenith, as warpshadow.assets.light lays a map out."""
    radiance = np.zeros((32, 64, 3), np.float32)
    radiance[:, :32, 0] = radiance[:, 32:, 1] = radiance[:8, :, 2] = 1
    samples = sample_map(radiance, 256)
    x, y, _ = np.moveaxis(samples.directions, -1, 0)
    red, green, blue = np.moveaxis(samples.radiance > 0, -1, 0)
    inside = (np.abs(x) > 1e-6) & (np.abs(y - np.cos(np.pi / 4)) > 1e-6)
    np.testing.assert_array_equal(red[inside], x[inside] > 0)
    np.testing.assert_array_equal(green[inside], x[inside] < 0)
    np.testing.assert_array_equal(blue[inside], y[inside] > np.cos(np.pi / 4))


def vectors(values, device) -> wp.array:
    return wp.array(np.asarray(values, np.float32), dtype=wp.vec3, device=device)


def test_an_unoccluded_white_receiver_shows_the_radiance_of_constant_light(device):
    far = warp_mesh(Mesh(icosphere(1.0, 1).positions * 0.01 + [0, -50, 0], icosphere(1.0, 1).faces), device)
    normals = np.random.default_rng(SEED).normal(size=(40, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    samples = sample_map(np.full((16, 32, 3), (0.5, 1, 2), np.float32), 4096)
    shading = trace_shading(far, vectors(np.zeros((40, 3)), device), vectors(normals, device), samples).numpy()
    assert np.abs(shading / [0.5, 1, 2] - 1).max() < ROUGH  # the horizon is a kink: 0.34% measured


def ball_over_points(device):
    """A ball above points of the ground: the mesh, the points, and the share of L = 1 they keep, 1 − cos θ (r/d)²."""
    center, radius = np.array([0.0, 1.5, 0.0]), 0.8
    ball = icosphere(radius, 5)
    points = np.stack([np.linspace(-4, 4, 33), np.zeros(33), np.linspace(-1, 2, 33)], axis=1)
    distance = np.linalg.norm(center - points, axis=1)
    expected = 1 - center[1] / distance * (radius / distance) ** 2
    mesh = warp_mesh(Mesh(ball.positions + center, ball.faces), device)
    return mesh, vectors(points, device), vectors(np.tile([0.0, 1.0, 0.0], (33, 1)), device), expected


def test_a_ball_takes_its_form_factor_from_the_ground(device):
    mesh, points, normals, expected = ball_over_points(device)
    shading = trace_shading(mesh, points, normals, sample_map(np.ones((16, 32, 3), np.float32), 4096)).numpy()
    edge = 0.012  # rays at the rim of the ball and the horizon: 0.6% measured
    assert expected.min() < 0.8
    assert np.abs(shading - expected[:, None]).max() < edge


@pytest.mark.parametrize("basis", [HarmonicBasis(4), CellBasis(fibonacci(64))], ids=["harmonics", "cells"])
def test_transfer_times_light_is_the_shading_of_that_light(device, basis):
    """The same rays' question asked twice, once of evenly spread rays: light of order 3 for harmonics, one value for
    each cell for cells."""
    mesh, points, normals, expected = ball_over_points(device)
    transfer = trace_transfer(mesh, points, normals, basis.functions, 8192).numpy()
    assert transfer.shape == (33, basis.size)
    ones = np.sqrt(4 * np.pi) * np.eye(1, basis.size)[0] if isinstance(basis, HarmonicBasis) else np.ones(basis.size)
    assert np.abs(transfer @ ones - expected).max() < 5e-3

    rng = np.random.default_rng(SEED)
    coefficients = rng.uniform(0, 0.3, size=(basis.size, 3)) + 2 * ones[:, None]
    height = 128
    directions = sh.equirectangular_directions(height)
    image = basis.functions(directions.reshape(-1, 3)) @ coefficients
    samples = sample_map(image.reshape(height, 2 * height, 3).astype(np.float32), 8192)
    shading = trace_shading(mesh, points, normals, samples).numpy()
    assert np.abs(transfer @ coefficients - shading).max() < ROUGH * shading.max()


@pytest.mark.parametrize("count", [64, 512, 1024])
def test_cells_count_alike_however_few_rays_there_are(count):
    """Without blockers a cell lights as a light of its size towards its middle, whichever rays happen to be in it."""
    ground = ws.Body(ws.plane(2.0, 1), albedo=(1, 1, 1))
    camera = ws.Camera.look_at((0, 2, 0.1), (0, 0, 0), size=(8, 8), fov_y=20)
    scene = ws.Scene([ground], ws.EnvironmentMap.constant(), camera, ws.Visibility("ray-traced", samples=256))
    basis = CellBasis(fibonacci(count))
    renderer = SceneRenderer(scene, basis=basis)
    view = renderer.view()
    (transfer,) = renderer._method.cached_transfer_node(view).value(view.call)
    cosines = basis.directions[:, 1]
    chosen = cosines > 3 * cell_radius(count)  # not cut by the horizon
    shares = transfer.numpy()[0, 0, chosen] / (4 / count * cosines[chosen])
    assert np.abs(shares - 1).max() < 0.2  # 13%: rays are not in the middle of a cell; by counts alone 79%


def test_receivers_in_several_launches_get_what_they_get_in_one(device, monkeypatch):
    mesh, points, normals, expected = ball_over_points(device)
    basis, samples = HarmonicBasis(3), sample_map(np.ones((16, 32, 3), np.float32), 256)
    transfer = trace_transfer(mesh, points, normals, basis.functions, 256).numpy()
    parts = ray_tracing.progress_slices
    monkeypatch.setattr(ray_tracing, "progress_slices", lambda total, size, progress: parts(total, 5, progress))
    assert np.abs(trace_transfer(mesh, points, normals, basis.functions, 256).numpy() - transfer).max() < 1e-6
    shading = trace_shading(mesh, points, normals, samples).numpy()
    assert np.abs(shading - expected[:, None]).max() < 0.06  # 256 rays: 4% measured


def test_no_receivers_are_no_work(device):
    mesh, points, normals, _ = ball_over_points(device)
    samples = sample_map(np.ones((8, 16, 3), np.float32), 16)
    none = wp.empty(0, dtype=wp.vec3, device=device)
    assert trace_shading(mesh, none, none, samples).shape == (0,)
    assert trace_transfer(mesh, none, none, HarmonicBasis(2).functions, 16).shape == (0, 4)


@pytest.mark.usefixtures("poisoned_outputs")
def test_cells_add_up_to_shading_whoever_is_traced_together(device):
    """The same rays, each in the cell that it belongs to; a receiver has its own by its number."""
    ball = icosphere(1.0, 3)
    mesh = warp_mesh(Mesh(ball.positions + [0, 1.5, 0], ball.faces), device)
    rng = np.random.default_rng(SEED)
    points = np.zeros((40, 3))
    points[:, ::2] = rng.uniform(-2, 2, size=(40, 2))
    places, normals = (
        wp.array(values, dtype=wp.vec3, device=device) for values in (points, np.tile([0.0, 1.0, 0.0], (40, 1)))
    )
    radiance = rng.uniform(size=(8, 16, 3))
    drawn, directions = sample_map(radiance, 200), fibonacci(32)
    expected = trace_shading(mesh, places, normals, drawn).numpy()
    samples = cell_samples(drawn, directions, device=device)
    numbers = wp.array(np.arange(40), dtype=wp.int32, device=device)
    light = trace_cells(mesh, places, normals, numbers, samples).numpy()
    assert light.shape == (40, 3, 32)
    rounding = 1e-5  # of sums of some hundred float32 terms
    assert np.abs(light.sum(axis=2) - expected).max() < rounding * expected.max()
    below = fibonacci(32)[:, 1] < -0.4  # whose cells end below the horizon
    assert not light[:, :, below].any()
    part = trace_cells(mesh, places[20:], normals[20:], numbers[20:], samples).numpy()
    np.testing.assert_array_equal(part, light[20:])


def test_cells_of_unit_light_are_transfer_to_them(device):
    """Each cell has its part of the sphere, 4π/Q, over π, however many rays belong to it."""
    ball = icosphere(1.0, 3)
    mesh = warp_mesh(Mesh(ball.positions + [0, 1.5, 0], ball.faces), device)
    places = np.random.default_rng(SEED).uniform(-2, 2, (30, 3)) * [1, 0, 1]
    up = np.tile([0.0, 1.0, 0.0], (30, 1))
    points, normals = (wp.array(values, dtype=wp.vec3, device=device) for values in (places, up))
    directions = fibonacci(32)
    samples = cell_samples(even_samples(512, directions), directions, device=device)
    numbers = wp.zeros(30, dtype=wp.int32, device=device)
    light = trace_cells(mesh, points, normals, numbers, samples).numpy()[:, 0]

    rays = samples.directions.numpy()[0].astype(np.float64)
    belongs = np.eye(32)[np.argmax(rays @ directions.T, axis=1)]
    seen = trace(mesh, places[None], up[None], rays, device)[0]
    expected = (seen * np.maximum(rays[:, 1], 0)) @ belongs * 4 / 32 / belongs.sum(axis=0)
    assert np.abs(light - expected).max() < 1e-6


@pytest.mark.parametrize("count", [16, 128, 200, 1024])
def test_even_samples_give_each_cell_its_part_of_the_sphere(count):
    directions = fibonacci(128)
    drawn = even_samples(count, directions)
    assert len(drawn.directions[0]) >= max(count, 128)
    cells = cell_samples(drawn, directions, device="cpu").cells.numpy()
    per_cell = np.bincount(cells[0], weights=drawn.radiance[0, :, 0], minlength=128)
    np.testing.assert_allclose(per_cell, 4 * np.pi / 128, rtol=1e-12)


def test_past_no_mesh_nothing_is_traced(device):
    mesh, points, normals, _ = ball_over_points(device)
    samples, basis = sample_map(np.ones((16, 32, 3), np.float32), 2048), HarmonicBasis(2)
    assert np.abs(trace_shading(None, points, normals, samples).numpy() - 1).max() < ROUGH
    transfer = trace_transfer(None, points, normals, basis.functions, 4096).numpy()
    assert np.abs(transfer @ [np.sqrt(4 * np.pi), 0, 0, 0] - 1).max() < 5e-3
    everything = trace(None, np.zeros((1, 1, 3)), np.array([[[0.0, 1, 0]]]), fibonacci(64), device)[0, 0]
    np.testing.assert_array_equal(everything, fibonacci(64)[:, 1] > 0)


@pytest.mark.parametrize("angle", [0.0, 10.0, 37.0])
def test_nothing_leaks_past_a_wall_at_whose_foot_a_receiver_lies(angle, device):
    """The wall's plane holds the receiver, whose normal says nothing of the side: rounding must not decide."""
    turn = ws.Body(ws.plane(), rotation=(0, angle, 0)).rotation_matrix()
    wall = np.array([(-1, 0, 0), (1, 0, 0), (1, 2, 0), (-1, 2, 0)]) @ turn.T  # looks to +z
    mesh = wp.Mesh(
        wp.array(wall.astype(np.float32), dtype=wp.vec3, device=device),
        wp.array(np.array([0, 1, 2, 0, 2, 3], np.int32), device=device),
    )
    feet = np.stack([np.linspace(-0.9, 0.9, 31), np.zeros(31), np.zeros(31)], axis=-1) @ turn.T
    up = np.tile([0.0, 1.0, 0.0], (31, 1))
    towards = np.array([(0, 0.3, -1), (0.2, 0.3, -1), (0, 0.3, 1), (-0.2, 0.3, 1)]) @ turn.T
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    arrays = [wp.array(a.astype(np.float32), dtype=wp.vec3, device=device) for a in (feet[None], up[None], towards)]
    seen = trace_visibility(mesh, *arrays).numpy()[0]
    np.testing.assert_array_equal(seen, np.tile([0, 0, 1, 1], (31, 1)))
