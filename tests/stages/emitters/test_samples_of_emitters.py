"""Emitters: samples of their surfaces, blockers between, and the light of samples, against float64 twins."""

import numpy as np
import pytest
import trimesh
import twins
import warp as wp
from scipy.spatial.transform import Rotation

import warpshadow as ws
from warpshadow.device.tape import recorded
from warpshadow.stages.convex.convex_blockers import ConvexBlockers, ConvexBody
from warpshadow.stages.emitters import (
    convex_transmittance,
    light,
    plane_transmittance,
    sphere_transmittance,
    traced_transmittance,
)
from warpshadow.stages.emitters.emitter_self_visibility import find_self_visibility, look_up_self_visibility
from warpshadow.stages.emitters.samples import (
    SAMPLE_BUNDLE,
    EmitterSamples,
    EmitterSpan,
    SamplePieces,
    find_sample_weights,
    place_samples,
)
from warpshadow.stages.planes.grid import find_grid
from warpshadow.stages.planes.plane_blockers import PlaneBlockers, PlaneBody
from warpshadow.stages.rays.ray_tracing import trace_visibility
from warpshadow.stages.sparse import SparseMatrix

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

# Numbers near 1 after some tens of operations in float32.
FLOAT32 = 2e-5
# Of 64 samples against the irradiance of a ball and of a square by their formulas, at a distance of their size.
# Measured 0.3% and 0.5%.
FORM_FACTOR = 0.01
# Of a ball that a plane cuts, against points of its surface. Measured 1.3%; with whole samples before or beyond 8%.
SUNK = 0.02
# Of a panel, from 1 cm to 1.2 m away, against a sum over small pieces. Measured 0.8%, where samples begin to be points.
NEAR = 0.01
STEP = 1e-3  # of differences
# Of slopes, by float32 differences along random directions, relative to the gradient's length. Measured below 1e-2.
SLOPE = 2e-2

BALL, SQUARE = ws.icosphere(0.5, 3), ws.plane(1.0, 2)


def samples_of(mesh, device, *, is_two_sided=False):
    weights = find_sample_weights(mesh.positions, mesh.surface.faces, is_two_sided=is_two_sided, device=device)
    matrices = [SparseMatrix.from_matrix(matrix, device=device) for matrix in weights[:2]]
    pieces = SamplePieces.of_emitters([weights], SparseMatrix.from_matrix(weights.corners, device=device))
    faces = wp.array(mesh.surface.faces, dtype=wp.vec3i, device=device)
    first = np.array([0, weights.vertices.shape[0]])
    return EmitterSamples(*matrices, pieces, weights.surface_points, faces, (0,), (is_two_sided,), first)


def placed(samples, positions, device):
    return place_samples(wp.array(positions[None], dtype=wp.vec3, device=device), samples)


def receivers(device, count=40, seed=0, around=2.0):
    rng = np.random.default_rng(seed)
    points = around * twins.unit(rng.normal(size=(count, 3))) * rng.uniform(0.6, 1.4, size=(count, 1))
    normals = twins.unit(-points + 0.8 * rng.normal(size=points.shape))
    return points, normals, [wp.array(item[None], dtype=wp.vec3, device=device) for item in (points, normals)]


def numbers(array):
    return array.numpy()[0].astype(np.float64)


@pytest.mark.parametrize("mesh", [BALL, SQUARE], ids=["ball", "square"])
def test_samples_have_the_whole_area_in_bundles_close_to_each_other(mesh, device):
    samples = samples_of(mesh, device)
    own = placed(samples, mesh.positions, device)
    points, areas, bundles, balls = (numbers(item) for item in (own.points, own.areas, own.bundles, own.balls))
    assert len(points) % SAMPLE_BUNDLE == 0 and len(points) >= 64
    a, b, c = np.moveaxis(mesh.positions[mesh.surface.faces].astype(float), 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    seen = np.linalg.norm(areas, axis=1) * (1 + own.pieces.softness.numpy() ** 2 / 3)
    assert seen.sum() == pytest.approx(area, rel=1e-3)
    gaps = np.linalg.norm(points.reshape(-1, SAMPLE_BUNDLE, 3) - bundles[:, None, :3], axis=-1)
    assert (gaps < bundles[:, None, 3]).all() and bundles[:, 3].mean() < 0.6
    assert (np.linalg.norm(points - balls[0, :3], axis=1) < balls[0, 3]).all() and balls[0, 3] < 1


def test_a_ball_sends_the_light_of_a_ball(device):
    """Of radiance 1: (r/d)² where it is straight above a receiver [Howell's catalog, B-43]."""
    span = EmitterSpan(0, 0, 64, False)
    for distance in (1.0, 2.0, 8.0):
        at = np.array([[[0, -distance, 0]]]), np.array([[[0, 1.0, 0]]])
        arrays = [wp.array(item, dtype=wp.vec3, device=device) for item in at]
        ones = wp.full((1, 64), wp.vec3(1.0), dtype=wp.vec3, device=device)
        got = light.sum_light(*arrays, placed(samples_of(BALL, device), BALL.positions, device), ones, span)
        assert got.numpy()[0, 0, 0] == pytest.approx((0.5 / distance) ** 2, rel=FORM_FACTOR)


def test_a_square_sends_the_light_of_a_square(device):
    """Over its middle, at a distance of its edge [Howell's catalog, B-4]: 0.2395."""
    for turn, is_two_sided in ((1, False), (1, True), (-1, True), (-1, False)):
        samples = samples_of(SQUARE, device, is_two_sided=is_two_sided)
        span = next(samples.spans())
        at = np.array([[[0, turn, 0.0]]]), np.array([[[0, -turn, 0.0]]])
        arrays = [wp.array(item, dtype=wp.vec3, device=device) for item in at]
        ones = wp.full((1, span.size), wp.vec3(1.0), dtype=wp.vec3, device=device)
        got = light.sum_light(*arrays, placed(samples, SQUARE.positions, device), ones, span).numpy()[0, 0, 0]
        u = 0.5
        quarter = 2 * u / np.sqrt(1 + u**2) * np.arctan(u / np.sqrt(1 + u**2)) / (2 * np.pi)
        expected = 4 * quarter if turn > 0 or is_two_sided else 0
        assert got == pytest.approx(expected, rel=FORM_FACTOR)


PANEL = trimesh.creation.box((1.0, 0.04, 1.0))
SIDES = [
    (np.array(middle), np.array(u), np.array(v))
    for middle, u, v in (
        ((0, 0.02, 0), (0, 0, 0.5), (0.5, 0, 0)),
        ((0, -0.02, 0), (0.5, 0, 0), (0, 0, 0.5)),
        ((0.5, 0, 0), (0, 0.02, 0), (0, 0, 0.5)),
        ((-0.5, 0, 0), (0, 0, 0.5), (0, 0.02, 0)),
        ((0, 0, 0.5), (0.5, 0, 0), (0, 0.02, 0)),
        ((0, 0, -0.5), (0, 0.02, 0), (0.5, 0, 0)),
    )
]
"""Of the panel: middles and halves of edges, whose cross product points outward."""


def light_of_panel(points, normals, steps=2000):
    """Sum over small pieces of the sides of the panel."""
    total = np.zeros(len(points))
    for middle, u, v in SIDES:
        across = [max(round(steps * np.linalg.norm(edge)), 8) for edge in (u, v)]
        s, t = np.meshgrid(*(2 * (np.arange(count) + 0.5) / count - 1 for count in across), indexing="ij")
        pieces = middle + s[..., None] * u + t[..., None] * v
        area = 4 * np.cross(u, v) / s.size
        for k, (point, normal) in enumerate(zip(points, normals, strict=True)):
            beams = pieces.reshape(-1, 3) - point
            facing = np.maximum(-beams @ area, 0) * np.maximum(beams @ normal, 0)
            total[k] += (facing / (np.pi * (beams**2).sum(axis=1) ** 2)).sum()
    return total


def test_a_ceiling_that_a_panel_nearly_touches_has_its_light(device):
    """A centimeter above the panel, along its edge and away from it, where samples are 2 to 50 cm long."""
    along = [(0.52, 0.03, z) for z in np.linspace(-0.45, 0.45, 9)]
    away = [(x, 0.03, 0.1) for x in (0.2, 0.505, 0.55, 0.6, 0.8, 1.2)]
    down = [*along, *away, (0.2, 0.025, 0.1)]
    cut = [
        (0.6, 0.01, 0.2),
        (0.52, -0.01, 0.0),
        (0.2, 0.03, 0.1),
    ]  # by their horizons, below which middles of samples are
    points = np.array([*down, *cut])
    normals = np.array([(0, -1.0, 0)] * len(down) + [(-0.8, 0.6, 0), (0, -1, 0), (0.8, -0.6, 0)])
    arrays = [wp.array(item[None], dtype=wp.vec3, device=device) for item in (points, normals)]
    mesh = ws.Mesh(np.float32(PANEL.vertices), np.int32(PANEL.faces))
    samples = samples_of(mesh, device)
    span = next(samples.spans())
    ones = wp.full((1, span.size), wp.vec3(1.0), dtype=wp.vec3, device=device)
    got = light.sum_light(*arrays, placed(samples, mesh.positions, device), ones, span).numpy()[0, :, 0]
    np.testing.assert_allclose(got, light_of_panel(points, normals), rtol=NEAR)


@pytest.mark.parametrize("scale", [1e-6, 1e8])
def test_light_near_a_lamp_and_its_gradients_know_no_scale(scale, device):
    points, normals = np.array([[0, -0.55, 0], [0, -0.7, 0.1]]), np.array([[0, 1.0, 0], [0.6, 0.8, 0]])
    samples, found = samples_of(BALL, device), []
    span = next(samples.spans())
    ones = wp.full((1, span.size), wp.vec3(1.0), dtype=wp.vec3, device=device)
    for factor in (1.0, scale):
        inputs = (factor * points, normals, factor * BALL.positions)
        arrays = [wp.array(item[None], dtype=wp.vec3, device=device, requires_grad=True) for item in inputs]
        with recorded() as tape:
            result = light.sum_light(*arrays[:2], place_samples(arrays[2], samples), ones, span)
        tape.backward(grads={result: wp.ones_like(result)})
        found.append(
            [
                result.numpy(),
                *(array.grad.numpy() * size for array, size in zip(arrays, (factor, 1, factor), strict=True)),
            ]
        )
    for own, scaled in zip(*found, strict=True):
        np.testing.assert_allclose(scaled, own, atol=50 * FLOAT32 * np.abs(own).max())


def test_flat_lamps_are_not_soft_however_they_lie_in_their_mesh(device):
    for turn in Rotation.random(8, random_state=0).as_matrix():
        turned = np.float32(SQUARE.positions @ turn.T)
        weights = find_sample_weights(turned, SQUARE.surface.faces, is_two_sided=False, device=device)
        assert (weights.softness < 1e-3).all() and np.isfinite(weights.faces.data).all()


@pytest.mark.parametrize("is_two_sided", [False, True])
def test_light_is_that_of_the_twin(is_two_sided, device):
    points, normals, arrays = receivers(device)
    samples = samples_of(BALL, device)._replace(is_two_sided=(is_two_sided,))
    own = placed(samples, BALL.positions, device)
    rng = np.random.default_rng(1)
    radiance, logs = rng.uniform(size=(64, 3)), [-rng.uniform(size=(1, 40, 64)) for _ in range(2)]
    factor = rng.uniform(size=(1, 40, 64))
    on_device = [wp.array(item, dtype=wp.float32, device=device) for item in (*logs, factor)]
    radiance_array = wp.array(radiance[None], dtype=wp.vec3, device=device)
    options = dict(zip(("log_of_spheres", "log_of_planes", "transmittance_self"), on_device, strict=True))
    transmittance = light.find_transmittance_to_samples(**options)
    got = numbers(light.sum_light(*arrays, own, radiance_array, next(samples.spans()), transmittance))
    through = np.exp(logs[0] + logs[1])[0] * factor[0]
    softness = own.pieces.softness.numpy().astype(float)
    given = points, normals, numbers(own.points), numbers(own.areas), softness, radiance, through
    expected = twins.light_of_samples(*given, is_two_sided)
    assert (softness[:60] > 0.1).all()
    np.testing.assert_allclose(got, expected, atol=FLOAT32 * expected.max())


def test_batches_that_differ_are_named_by_their_blockers(device):
    transmittance = {
        name: wp.zeros((count, 3, 64), dtype=wp.float32, device=device)
        for name, count in (("log_of_spheres", 2), ("transmittance_self", 3))
    }
    with pytest.raises(ValueError, match="^own body: got a batch of 3, expected 1 or 2, as spheres has"):
        light.find_transmittance_to_samples(**transmittance)


def test_spheres_block_as_the_twin_does(device):
    points, normals, arrays = receivers(device)
    samples = samples_of(BALL, device)
    own = placed(samples, BALL.positions, device)
    rng = np.random.default_rng(2)
    centers, radii = rng.normal(size=(20, 3)) * 1.2, rng.uniform(0.05, 0.5, size=20)
    on_device = wp.array(centers[None], dtype=wp.vec3, device=device), wp.array(radii[None].astype(np.float32))
    on_device = on_device[0], wp.array(radii[None], dtype=wp.float32, device=device)
    skipped = (0, 3), (10, 12)
    span = next(samples.spans())
    got = numbers(sphere_transmittance.find_log_transmittance(*arrays, own, span, *on_device, skipped))
    sample_points, areas = numbers(own.points), numbers(own.areas)
    blocking = [sphere for sphere in range(20) if not (sphere < 3 or 10 <= sphere < 12)]
    expected = np.zeros((40, 64))
    for receiver, sample in np.ndindex(40, 64):
        beam, area = sample_points[sample] - points[receiver], areas[sample]
        if twins.may_light(beam, area, normals[receiver]):
            for sphere in blocking:
                offset = centers[sphere] - points[receiver], radii[sphere]
                share = twins.share_of_sphere(*offset, beam, np.sqrt(np.linalg.norm(area) / np.pi))
                expected[receiver, sample] += np.log(max(1 - share, 1e-4))
    assert (expected < -0.5).sum() > 60
    np.testing.assert_allclose(np.exp(got), np.exp(expected), atol=20 * FLOAT32)


def test_a_sphere_behind_the_emitter_or_the_receiver_blocks_nothing(device):
    at = np.array([[[0, -2.0, 0]]]), np.array([[[0, 1.0, 0]]])
    arrays = [wp.array(item, dtype=wp.vec3, device=device) for item in at]
    samples = samples_of(BALL, device)
    own, span = placed(samples, BALL.positions, device), next(samples.spans())
    for height, is_blocking in ((1.5, False), (-1.2, True), (-3.0, False)):
        sphere = wp.array([[(0, height, 0)]], dtype=wp.vec3, device=device), wp.array([[0.5]], dtype=wp.float32)
        sphere = sphere[0], wp.full((1, 1), 0.5, dtype=wp.float32, device=device)
        got = sphere_transmittance.find_log_transmittance(*arrays, own, span, *sphere, ((0, 0), (0, 0))).numpy()
        assert (got.min() < -1) == is_blocking


def rectangle(size, device):
    mesh = ws.plane(size, 2)
    surface = mesh.positions, mesh.surface.faces
    grid, _ = find_grid(*surface, is_two_sided=False, others=None)
    body = PlaneBody(grid, *surface, 0, 0, blocks=True)
    blockers = PlaneBlockers.from_bodies([body], 0, len(mesh.positions), device=device)
    return blockers, blockers.frames(wp.array(mesh.positions[None], dtype=wp.vec3, device=device))


def log_past_planes(*arguments):
    """Past a plane that the emitter, the only body, may be on both sides of."""
    *seen, skipped = arguments
    sides = wp.zeros((1, 1, 1), dtype=wp.float32, device=seen[0].device)
    return plane_transmittance.find_log_transmittance_of_planes(*seen, sides, 0, skipped)


def test_planes_block_as_the_twin_does(device):
    size = (1.5, 0.8)
    blockers, frames = rectangle(size, device)
    rng = np.random.default_rng(3)
    points = rng.uniform(-1, 1, size=(60, 3)) * (1.5, 0.3, 1.2) - (0, 1, 0)
    normals = np.tile([[0, 1.0, 0]], (60, 1))
    arrays = [wp.array(item[None], dtype=wp.vec3, device=device) for item in (points, normals)]
    samples = samples_of(BALL, device)
    own = placed(samples, BALL.positions + np.float32([0.2, 1.5, 0.1]), device)
    span = next(samples.spans())
    got = numbers(log_past_planes(*arrays, own, span, frames, blockers, (-1, -1)))
    sample_points, areas = numbers(own.points), numbers(own.areas)
    expected = np.zeros(got.shape)
    for receiver, sample in np.ndindex(*got.shape):
        beam, area = sample_points[sample] - points[receiver], areas[sample]
        if twins.may_light(beam, area, normals[receiver]):
            disc_radius = np.sqrt(np.linalg.norm(area) / np.pi)
            share = twins.share_of_rectangle(size, points[receiver], beam, disc_radius)
            expected[receiver, sample] = np.log(max(1 - share, 1e-4))
    assert (expected < -0.5).sum() > 200 and (expected == 0).sum() > 200
    np.testing.assert_allclose(np.exp(got), np.exp(expected), atol=50 * FLOAT32)
    none = log_past_planes(*arrays, own, span, frames, blockers, (-1, 0))
    assert not none.numpy().any()


@pytest.mark.parametrize("height", [-0.25, -0.1, 0.0, 0.05, 0.2])
def test_planes_hide_the_part_of_a_lamp_that_lies_beyond_them(height, device):
    """A ball half in a ground, seen by receivers above it; against rays, to all points of its surface."""
    blockers, frames = rectangle((4.0, 4.0), device)
    samples, positions = samples_of(BALL, device), BALL.positions + np.float32([0.02, height, 0.03])
    own, span = placed(samples, positions, device), next(samples.spans())
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    points = np.stack([1.5 * np.cos(angles), np.linspace(0.05, 0.8, 24), 1.5 * np.sin(angles)], axis=1)
    normals = twins.unit(-points * (1, 0, 1))
    arrays = [wp.array(item[None], dtype=wp.vec3, device=device) for item in (points, normals)]
    log = log_past_planes(*arrays, own, span, frames, blockers, (-1, -1))
    ones = wp.full((1, span.size), wp.vec3(1.0), dtype=wp.vec3, device=device)
    through = light.find_transmittance_to_samples(log_of_planes=log)
    got = numbers(light.sum_light(*arrays, own, ones, span, through))[:, 0]
    corners = positions[BALL.surface.faces].astype(float)
    shares = np.random.default_rng(4).dirichlet((1, 1, 1), 64)
    areas = np.repeat(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 128, 64, axis=0)
    surface_points = np.einsum("pk,fkx->fpx", shares, corners).reshape(-1, 3)
    beams = surface_points - points[:, None]
    facing = np.maximum(-(beams * areas).sum(-1), 0) * np.maximum(np.einsum("rpx,rx->rp", beams, normals), 0)
    exact = (facing / (np.pi * (beams**2).sum(-1) ** 2) * (surface_points[:, 1] > 0)).sum(axis=1)
    assert got.sum() == pytest.approx(exact.sum(), rel=SUNK)


def box(size, device):
    mesh = ws.load_mesh(trimesh.creation.box(size))
    blockers = ConvexBlockers.from_bodies([ConvexBody(mesh.convex_parts, 0)], mesh.vertex_count, device=device)
    return blockers, mesh.positions


def test_convex_parts_block_as_the_twin_does(device):
    size = (0.8, 0.3, 0.6)
    blockers, vertices = box(size, device)
    rng = np.random.default_rng(6)
    points = rng.uniform(-1, 1, size=(60, 3)) * (1.5, 0.2, 1.2) - (0, 1, 0)
    normals = np.tile([[0, 1.0, 0]], (60, 1))
    arrays = [wp.array(item[None], dtype=wp.vec3, device=device) for item in (points, normals)]
    samples = samples_of(BALL, device)
    own = placed(samples, BALL.positions + np.float32([0.2, 1.3, 0.1]), device)
    parts = blockers.place(wp.array(vertices[None], dtype=wp.vec3, device=device))
    span = next(samples.spans())
    got = numbers(convex_transmittance.find_log_transmittance_of_parts(*arrays, own, span, parts, blockers, (-1, -1)))
    sample_points, areas = numbers(own.points), numbers(own.areas)
    expected = np.zeros(got.shape)
    for receiver, sample in np.ndindex(*got.shape):
        beam, area = sample_points[sample] - points[receiver], areas[sample]
        if twins.may_light(beam, area, normals[receiver]):
            share = twins.share_of_box(size, points[receiver], beam, np.sqrt(np.linalg.norm(area) / np.pi))
            expected[receiver, sample] = np.log(max(1 - share, 1e-4))
    assert (expected < -0.5).sum() > 100 and (expected == 0).sum() > 200
    np.testing.assert_allclose(np.exp(got), np.exp(expected), atol=100 * FLOAT32)
    none = convex_transmittance.find_log_transmittance_of_parts(*arrays, own, span, parts, blockers, (-1, 0))
    assert not none.numpy().any()


def test_boards_that_touch_block_as_the_twin_does(device):
    """As the board that they make together, or as the sum of them where that is less."""
    count, size, board = 8, (1.2, 0.15, 0.1), (1.2, 1.2, 0.1)
    middles = np.stack([np.zeros(count), 0.15 * np.arange(count) - 0.525, np.zeros(count)], axis=1)
    mesh = ws.load_mesh(
        trimesh.util.concatenate([trimesh.creation.box(size).apply_translation(middle) for middle in middles])
    )
    assert mesh.hull_of_parts is not None
    points = np.random.default_rng(8).uniform(-0.8, 0.8, size=(60, 3)) - (0, 0, 1.5)
    normals = np.tile([[0, 0, 1.0]], (60, 1))
    own, got = log_past(mesh, points, normals, device, lamp=(0.2, 0.1, 0.8))
    sample_points, areas = numbers(own.points), numbers(own.areas)
    expected, sums = np.zeros(got.shape), np.zeros(got.shape)
    for receiver, sample in np.ndindex(*got.shape):
        beam, area = sample_points[sample] - points[receiver], areas[sample]
        if twins.may_light(beam, area, normals[receiver]):
            disc = beam, np.sqrt(np.linalg.norm(area) / np.pi)
            sums[receiver, sample] = sum(
                twins.share_of_box(size, points[receiver] - middle, *disc) for middle in middles
            )
            share = min(sums[receiver, sample], twins.share_of_box(board, points[receiver], *disc))
            expected[receiver, sample] = np.log(max(1 - share, 1e-4))
    assert (sums > 1 - np.exp(expected) + 0.05).sum() > 20 and (expected == 0).sum() > 200
    np.testing.assert_allclose(np.exp(got), np.exp(expected), atol=200 * FLOAT32)


def cone(sections, radii=(1.4, 0.9), heights=(-0.7, 0.7)):
    """The wall of a cone around the y axis, of one layer, open above and below."""
    angles = 2 * np.pi * np.arange(sections) / sections
    rings = [
        np.stack([r * np.cos(angles), np.full(sections, y), r * np.sin(angles)], axis=1)
        for r, y in zip(radii, heights, strict=True)
    ]
    begin, end = np.arange(sections), np.roll(np.arange(sections), -1)
    halves = np.stack([begin, begin + sections, end], axis=1), np.stack([end, begin + sections, end + sections], axis=1)
    return ws.Mesh(np.concatenate(rings), np.concatenate(halves))


def log_past(mesh, points, normals, device, lamp=(0, 0, 0)):
    """Logarithm of the transmittance past a mesh from receivers to a ball of radius 0.25."""
    body = ConvexBody(mesh.convex_parts, 0, hull=mesh.hull_of_parts)
    blockers = ConvexBlockers.from_bodies([body], mesh.vertex_count, device=device)
    samples = samples_of(BALL, device)
    own = placed(samples, 0.5 * BALL.positions + np.float32(lamp), device)
    arrays = [wp.array(item[None], dtype=wp.vec3, device=device) for item in (points, normals)]
    parts = blockers.place(wp.array(mesh.positions[None], dtype=wp.vec3, device=device))
    got = convex_transmittance.find_log_transmittance_of_parts(
        *arrays, own, next(samples.spans()), parts, blockers, (-1, -1)
    )
    return own, numbers(got)


def test_shares_of_panels_beside_each_other_add_up_as_those_of_the_twin(device):
    """Nothing passes where two panels touch."""
    mesh = cone(6)
    assert len(mesh.convex_parts) == 6
    points = np.random.default_rng(7).normal(size=(80, 3)) * (3, 1.5, 3)
    points = points[np.hypot(points[:, 0], points[:, 2]) > 1.6]
    own, got = log_past(mesh, points, twins.unit(-points), device)
    sample_points, areas = numbers(own.points), numbers(own.areas)
    expected = np.zeros(got.shape)
    for receiver, sample in np.ndindex(*got.shape):
        beam, area = sample_points[sample] - points[receiver], areas[sample]
        if twins.may_light(beam, area, -points[receiver]):
            disc = beam, np.sqrt(np.linalg.norm(area) / np.pi)
            panels = (mesh.positions[part.corners].astype(float) for part in mesh.convex_parts)
            shares = [twins.share_of_panel(corners, points[receiver], *disc) for corners in panels]
            expected[receiver, sample] = np.log(max(1 - sum(shares), 1e-4))
    assert (expected == np.log(1e-4)).sum() > 500 and (expected == 0).sum() > 500
    np.testing.assert_allclose(np.exp(got), np.exp(expected), atol=100 * FLOAT32)
    around = 3 * cone(200).positions[:200] * (1, 0, 1)
    assert set(log_past(mesh, around, twins.unit(-around), device)[1].ravel().round(3)) == {0, np.log(1e-4).round(3)}


def test_a_shell_hides_a_lamp_in_it_and_none_above_its_rim(device):
    """A receiver sees panels of a mug from outside, or from within; their backs hide nothing."""
    profile = np.array([(0, -0.7), (1, -0.7), (1, 0.7), (0.95, 0.7), (0.95, -0.65), (0, -0.65)])
    lathed = trimesh.creation.revolve(profile, sections=16)
    mug = ws.Mesh(lathed.vertices, lathed.faces)
    assert not any(np.ptp(part.faces[1]) for part in mug.convex_parts)
    points = np.array([[3.0, 0.2, -0.1], [0.1, -2.5, 0.1], [0.2, 0.1, -3.0], [0.2, 0.1, 3.0], [0.6, 0, 0]])
    hidden = log_past(mug, points, twins.unit(-points), device)[1]
    own = hidden[:, (hidden[:4] != 0).any(axis=0)]  # samples that light one of them
    assert own[:3].min(axis=1) == pytest.approx(np.log(1e-4))
    np.testing.assert_array_equal(hidden[3:], 0)


def test_a_panel_that_is_not_quite_flat_hides_nothing_beside_it(device):
    """Panels that stand in for two quads of a cone each, from receivers in their planes that see all of the lamp."""
    mesh = cone(48)
    assert len(mesh.convex_parts) < 48
    rng = np.random.default_rng(8)
    radius, angle = 3.0 * np.sqrt(rng.uniform(size=2000)), rng.uniform(0, 2 * np.pi, size=2000)
    points = np.stack([radius * np.cos(angle), np.full(2000, -4.0), radius * np.sin(angle)], axis=1)
    assert not log_past(mesh, points, np.tile([[0, 1.0, 0]], (2000, 1)), device)[1].any()


def test_rays_meet_what_is_between_and_not_what_is_behind(device):
    mesh = ws.plane(3.0, 2)
    at = np.array([[0, -2.0, 0]]), np.array([[0, 1.0, 0]])
    arrays = [wp.array(item, dtype=wp.vec3, device=device) for item in at]
    samples = samples_of(BALL, device)
    own, span = placed(samples, BALL.positions, device), next(samples.spans())
    for height, share in ((0.7, 1.0), (-1.0, 0.0), (-2.5, 1.0)):
        vertices = wp.array(mesh.positions + np.float32([0, height, 0]), dtype=wp.vec3, device=device)
        wall = wp.Mesh(vertices, wp.array(mesh.surface.faces.ravel(), dtype=wp.int32, device=device))
        lamp = samples, wp.array(BALL.positions, dtype=wp.vec3, device=device), own.points[0], own.areas[0], span
        got = traced_transmittance.trace_transmittance(wall, *arrays, *lamp, rays=4).numpy()
        faces_it = np.einsum("kx,kx->k", at[0] - numbers(own.points), numbers(own.areas)) > 0
        np.testing.assert_array_equal(got[0, faces_it], share)
        far = trace_visibility(wall, *(a.reshape((1, 1)) for a in arrays), wp.array([(0, 1.0, 0)], dtype=wp.vec3))
        assert far.numpy()[0, 0, 0] == (height < -2)


def test_rays_to_a_lamp_are_spread_over_each_sample_and_over_samples(device):
    """Half of a panel is hidden: its visible share varies less than by rays to points drawn one by one."""
    panel, wall = ws.plane(1.0, 4), ws.plane(2.0, 2)
    samples = samples_of(panel, device)
    own, span = placed(samples, panel.positions, device), next(samples.spans())
    points, normals = (wp.array(np.tile([[0, y, 0]], (500, 1)), dtype=wp.vec3, device=device) for y in (2.0, -1.0))
    vertices = wp.array(wall.positions + np.float32([1.03, 1.0, 0]), dtype=wp.vec3, device=device)
    hides = wp.Mesh(vertices, wp.array(wall.surface.faces.ravel(), dtype=wp.int32, device=device))
    lamp = samples, wp.array(panel.positions, dtype=wp.vec3, device=device), own.points[0], own.areas[0], span
    share = traced_transmittance.trace_transmittance(hides, points, normals, *lamp, rays=4).numpy()
    exact = traced_transmittance.trace_transmittance(hides, points, normals, *lamp, rays=32).numpy()
    np.testing.assert_allclose(exact, np.broadcast_to(exact[0], exact.shape), atol=FLOAT32)
    p = exact[0]
    drawn = np.sqrt((p * (1 - p)).sum() / 4) / len(p)
    error = share.mean(axis=1) - p.mean()
    assert abs(error.mean()) < 0.2 * drawn
    assert error.std() < 0.7 * drawn  # 0.59


@pytest.mark.parametrize("between", ["nothing", "spheres", "planes", "cutting plane", "parts", "panels"])
def test_gradients_of_light_agree_with_differences(between, device):
    """To receivers, the emitter's vertices and radiance, and to the blockers."""
    rng = np.random.default_rng(5)
    blockers, frames = rectangle((1.5, 0.8), device)
    samples = samples_of(BALL, device)
    span = next(samples.spans())
    points = rng.uniform(-1, 1, size=(1, 30, 3)) * (1.0, 0.2, 0.8) - (0, 1.5, 0)
    normals = twins.unit(np.array([0, 1.0, 0]) + 0.2 * rng.normal(size=points.shape))
    middle = np.float32([0.2, 0.1 if between == "cutting plane" else 1.5, 0.1])
    inputs = [points, normals, BALL.positions[None] + middle, rng.uniform(size=(1, 64, 3))]
    shade = cone(6)
    panels = ConvexBlockers.from_bodies([ConvexBody(shade.convex_parts, 0)], shade.vertex_count, device=device)
    box_blockers, box_vertices = (panels, shade.positions) if between == "panels" else box((0.8, 0.3, 0.6), device)
    inputs += {
        "nothing": [],
        "parts": [box_vertices[None]],
        "panels": [box_vertices[None]],
        "spheres": [rng.normal(size=(1, 6, 3)) * 0.5],
        "planes": [frames.numpy()],
        "cutting plane": [frames.numpy()],
    }[between]
    radii = wp.array(rng.uniform(0.2, 0.5, size=(1, 6)), dtype=wp.float32, device=device)

    def light_of(arrays):
        own = place_samples(arrays[2], samples)
        seen, logs = (*arrays[:2], own, span), {}
        if between == "spheres":
            found = sphere_transmittance.find_log_transmittance(*seen, arrays[4], radii, ((0, 0), (0, 0)))
            logs = {"log_of_spheres": found}
        if between in ("planes", "cutting plane"):
            found = log_past_planes(*seen, arrays[4], blockers, (-1, -1))
            logs = {"log_of_planes": found}
        if between in ("parts", "panels"):
            parts = box_blockers.place(arrays[4])
            found = convex_transmittance.find_log_transmittance_of_parts(*seen, parts, box_blockers, (-1, -1))
            logs = {"log_of_parts": found}
        return light.sum_light(*arrays[:2], own, arrays[3], span, light.find_transmittance_to_samples(**logs))

    arrays = [wp.array(item, dtype=wp.vec3, device=device, requires_grad=True) for item in inputs]
    with recorded() as tape:
        result = light_of(arrays)
    weights = rng.normal(size=result.numpy().shape)
    tape.backward(grads={result: wp.array(weights, dtype=wp.vec3, device=device)})

    def loss(values):
        made = light_of([wp.array(item, dtype=wp.vec3, device=device) for item in values])
        return (weights * made.numpy()).sum()

    for number, (array, values) in enumerate(zip(arrays, inputs, strict=True)):
        is_box = between in ("parts", "panels") and number == 4  # whose sides stay flat
        shift = STEP * np.broadcast_to(rng.normal(size=(1, 1, 3) if is_box else values.shape), values.shape)
        sides = [[*inputs[:number], values + sign * shift, *inputs[number + 1 :]] for sign in (1, -1)]
        difference, gradient = (loss(sides[0]) - loss(sides[1])) / 2, array.grad.numpy()
        scale = STEP * float(np.linalg.norm(gradient))
        assert (gradient * shift).sum() == pytest.approx(difference, abs=SLOPE * scale), number


# ------------------------------------------------------------------------------------------------ self-visibility


def tube():
    """An open cylinder around the y axis, of radius 0.5 and height 1."""
    mesh = trimesh.creation.cylinder(0.5, 1.0, sections=48)
    is_wall = np.abs(mesh.face_normals[:, 2]) < 0.5
    return ws.Mesh(mesh.vertices[:, [1, 2, 0]], mesh.faces[is_wall])


def tube_and_samples(device):
    mesh = tube()
    weights = find_sample_weights(mesh.positions, mesh.surface.faces, is_two_sided=True, device=device)
    samples = samples_of(mesh, device, is_two_sided=True)
    rest = weights.vertices @ mesh.positions.astype(float), weights.surface_points
    table = find_self_visibility(mesh.positions, mesh.surface.faces, *rest, is_two_sided=True, device=device)
    return mesh, samples, table


def turned(positions, angle=0.7, scale=3.0, shift=(5.0, -2.0, 1.0)):
    rotation = trimesh.transformations.rotation_matrix(angle, (0.3, -0.5, 0.8))[:3, :3]
    return scale * positions @ rotation.T + shift


def test_points_of_samples_lie_on_them(device):
    mesh, samples, _ = tube_and_samples(device)
    weights = find_sample_weights(mesh.positions, mesh.surface.faces, is_two_sided=True, device=device)
    faces, barycentrics = weights.surface_points
    corners = mesh.positions[mesh.surface.faces[faces]]
    points = np.einsum("spk,spkx->spx", barycentrics, corners)
    middles = weights.vertices @ mesh.positions
    np.testing.assert_allclose(np.linalg.norm(points[..., ::2], axis=-1), 0.5, atol=0.01)
    assert np.linalg.norm(points.mean(axis=1) - middles, axis=-1).max() < 0.05
    areas = np.linalg.norm(numbers(placed(samples, mesh.positions, device).areas), axis=-1)
    assert np.linalg.norm(points - middles[:, None], axis=-1).max() < 3 * np.sqrt(areas.max() / np.pi)


def test_a_tube_hides_its_far_side_from_outside_and_nothing_from_within(device):
    mesh, samples, table = tube_and_samples(device)
    span = next(samples.spans())
    inside, outside = np.array([[(0, 0, 0), (0.1, 0.2, -0.1)]]), np.array([[(3, 0.0, 0), (0, 0.0, -2)]])
    moved = placed(samples, turned(mesh.positions), device)
    for points, is_inside in ((inside, True), (outside, False)):
        array = wp.array(turned(points), dtype=wp.vec3, device=device)
        got = numbers(look_up_self_visibility(array, moved, span, table))
        rest = numbers(placed(samples, mesh.positions, device).points)
        for row, point in zip(got, points[0], strict=True):
            towards = (rest[:, ::2] * (point[::2] - rest[:, ::2])).sum(axis=1)  # positive on the near wall
            if is_inside:
                assert row.min() > 0.9
            else:
                near, far = row[towards > 0.3], row[(towards < -0.3) & (np.abs(rest[:, 1]) < 0.3)]
                assert near.min() > 0.95 and far.max() < 0.1 and len(near) > 5 and len(far) > 5


def test_a_convex_emitter_has_no_table(device):
    weights = find_sample_weights(BALL.positions, BALL.surface.faces, is_two_sided=False, device=device)
    rest = weights.vertices @ BALL.positions.astype(float), weights.surface_points
    ball = BALL.positions, BALL.surface.faces, *rest
    assert find_self_visibility(*ball, is_two_sided=False, device=device) is None


def test_gradients_of_self_visibility_agree_with_differences(device):
    """To receivers and to the pose of the emitter."""
    mesh, samples, table = tube_and_samples(device)
    span, rng = next(samples.spans()), np.random.default_rng(7)
    points = turned(2.0 * twins.unit(rng.normal(size=(1, 20, 3))))
    weights = rng.normal(size=(1, 20, span.size))

    def looked_up(points, angle, scale, requires_grad=False):
        arrays = [
            wp.array(values, dtype=wp.vec3, device=device, requires_grad=requires_grad)
            for values in (points, turned(mesh.positions, angle, scale)[None])
        ]
        return arrays, look_up_self_visibility(arrays[0], place_samples(arrays[1], samples), span, table)

    with recorded() as tape:
        arrays, result = looked_up(points, 0.7, 3.0, requires_grad=True)
    tape.backward(grads={result: wp.array(weights, dtype=wp.float32, device=device)})
    of_points, of_vertices = (array.grad.numpy() for array in arrays)

    def loss(*arguments):
        return float((weights * looked_up(*arguments)[1].numpy()).sum())

    step = 3e-3
    shift = rng.normal(size=points.shape)
    difference = (loss(points + step * shift, 0.7, 3.0) - loss(points - step * shift, 0.7, 3.0)) / (2 * step)
    assert (of_points * shift).sum() == pytest.approx(difference, abs=SLOPE * float(np.linalg.norm(of_points)))
    for angle, scale in ((step, 0.0), (0.0, step)):
        sides = [loss(points, 0.7 + sign * angle, 3.0 + sign * scale) for sign in (1, -1)]
        moved = [turned(mesh.positions, 0.7 + sign * angle, 3.0 + sign * scale) for sign in (1, -1)]
        expected, got = sides[0] - sides[1], (of_vertices[0] * (moved[0] - moved[1])).sum()
        assert float(got) == pytest.approx(expected, rel=0.03, abs=1e-3)
