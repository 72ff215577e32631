"""Directional transmittance: against the float64 twin, its bounds, its conservation, and what must not change it."""

import numpy as np
import pytest
import twins
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warpshadow.maths import directions as cells
from warpshadow.stages.receivers.body_spans import Span
from warpshadow.stages.visibility import directional, traversal

# The step's slope in the dot product is 1/(hi − lo), up to 1/(1 − cos w) ≈ Q/0.245 for small caps: that much float32
# dot products are magnified. Measured 2e-6, 8e-6, 1.3e-5, 2.7e-5 and 1.9e-4.
FLOAT32 = {16: 1e-5, 64: 5e-5, 128: 1e-4, 256: 2e-4, 1024: 1e-3}
# A bundle whose brightest transmittance is below 1e-4 is not looked at any more.
OPAQUE = 1e-4


pytestmark = pytest.mark.usefixtures("poisoned_outputs")


def transmittance(points, normals, centers, radii, directions, device="cpu", **options):
    """Call the library with NumPy arrays of one instance [vertex, 3], or of several [batch, vertex, 3]."""
    is_single = np.ndim(points) == 2

    def put(values, dtype):
        values = np.asarray(values, np.float32)
        return wp.array(values[None] if is_single else values, dtype=dtype, device=device)

    normals = None if normals is None else put(normals, wp.vec3)
    arguments = put(points, wp.vec3), normals, put(centers, wp.vec3), put(radii, wp.float32)
    result = directional.transmittance(*arguments, directions, **options).numpy()
    return result[0] if is_single else result


def wide(*arrays):
    return [np.asarray(values, np.float64) for values in arrays]


@pytest.mark.parametrize("count", list(FLOAT32))
def test_transmittance_is_that_of_the_float64_twin(count, device):
    points, _, centers, radii = twins.random_scene(count, vertex_count=50)
    points[:4] = centers[:4] + radii[:4, None] * np.float32([0, 1.0, 0])  # touching
    points[4:6] = centers[4:6] + radii[4:6, None] * np.float32([0.1, 0, 0])  # nearly at the center
    points[6:10] = centers[6:10] + radii[6:10, None] * np.float32([0, 300, 0])  # far away
    directions = cells.fibonacci(count)
    got = transmittance(points, None, centers, radii, directions, device)
    expected = twins.transmittance(*wide(points, centers, radii), directions)
    assert np.abs(got - expected).max() < FLOAT32[count] + OPAQUE


@pytest.mark.parametrize("softness", [0.1, 0.35, 1.0, 1.5])
def test_softness_widens_the_edge_like_the_twins(softness, device):
    points, _, centers, radii = twins.random_scene(2)
    directions = cells.fibonacci(64)
    got = transmittance(points, None, centers, radii, directions, device, softness=softness)
    expected = twins.transmittance(*wide(points, centers, radii), directions, softness)
    assert np.abs(got - expected).max() < 10 * FLOAT32[64] + OPAQUE  # at κ = 0.1 the step is up to 12 times as steep


@pytest.mark.parametrize("facing", [False, True])
def test_footprints_widen_edges_like_the_twins_the_more_the_nearer_these_are(facing, device):
    points, normals, centers, radii = twins.random_scene(4, vertex_count=40)
    points[:4] = centers[:4] + radii[:4, None] * np.float32([0, 1.0, 0])  # touching: edges of 45°
    normals[:4] = [0, -1, 0]
    areas = np.random.default_rng(0).uniform(-0.4, 0.4, (40, 3)) ** 3  # as vectors: large along some directions
    areas[::5] = 0
    directions = cells.fibonacci(64)
    footprints = wp.array(areas[None], dtype=wp.vec3, device=device)
    arguments = points, normals if facing else None, centers, radii
    got = transmittance(*arguments, directions, device, softness=0.1, footprints=footprints)
    expected = twins.transmittance(*wide(points, centers, radii), directions, 0.1, areas)
    is_above = normals @ directions.T > 0 if facing else np.ones(got.shape, bool)
    assert np.abs(got - expected)[is_above].max() < 10 * FLOAT32[64] + OPAQUE


def test_an_edge_moves_over_a_footprint_as_its_mean_over_a_square_does(device):
    """Of a receiver on a plane, beside the shadow of a sphere under a light from above, by the variance of the step."""
    side, towards = 0.1, np.tile([0.0, 0, 1], (16, 1))
    x = np.linspace(0.7, 1.3, 400)
    points = np.stack([x, np.zeros(400), np.full(400, -1.0)], axis=1)
    footprints = wp.full((1, 400), wp.vec3(0.0, 0.0, side**2), dtype=wp.vec3, device=device)
    options = {"device": device, "softness": 2.1 * cells.MIN_WIDTH, "footprints": footprints}
    steps = np.diff(transmittance(points, None, [[0, 0, 0]], [1.0], towards, **options)[:, 0])
    middles = (x[1:] + x[:-1]) / 2
    middle = np.average(middles, weights=steps)
    assert abs(middle - 1) < 0.01
    variance = np.average((middles - middle) ** 2, weights=steps)
    assert abs(variance / (side**2 / 12) - 1) < 0.1


@pytest.mark.parametrize("count", [32, 64])
def test_a_bundle_that_footprints_alone_bring_into_reach_is_not_culled(count, device):
    """They widen soft edges beyond 60° where these are wider than 30° without."""
    directions = cells.fibonacci(count)
    softness = 0.9 * np.pi / 4 / cells.cell_radius(count)
    for axis in cells.bundle_cones(directions).axes:
        point = np.float32(1.0001 * axis)[None]  # touches the sphere, which is opposite to the axis; alone in its group
        footprints = wp.full((1, 1), wp.vec3(100.0, 50.0, -80.0), dtype=wp.vec3, device=device)
        options = {"softness": softness, "footprints": footprints}
        got = transmittance(point, None, [[0, 0, 0]], [1.0], directions, device, **options)
        expected = twins.transmittance(*wide(point, [[0, 0, 0]], [1.0]), directions, softness, [100.0, 50.0, -80.0])
        assert np.abs(got - expected).max() < FLOAT32[64]


@pytest.mark.parametrize("count", [64, 128])
@pytest.mark.parametrize("share", [0.2, 0.5, 0.95])
def test_a_bundle_opposite_to_a_sphere_is_not_culled_where_the_soft_edge_reaches_it(count, share, device):
    """The blocked cone, the softness and a bundle's cone may add up to more than 180°."""
    directions = cells.fibonacci(count)
    softness = share * np.pi / 4 / cells.cell_radius(count)
    for axis in cells.bundle_cones(directions).axes:
        point = np.float32(0.9 * axis)[None]  # inside the sphere, which is opposite to the axis; alone in its group
        got = transmittance(point, None, [[0, 0, 0]], [1.0], directions, device, softness=softness)
        expected = twins.transmittance(*wide(point, np.zeros((1, 3)), np.ones(1)), directions, softness)
        assert np.abs(got - expected).max() < FLOAT32[count]


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), sphere_count=st.integers(0, 60), scale=st.floats(1e-6, 1e6))
def test_transmittance_is_within_0_and_1(seed, sphere_count, scale):
    points, normals, centers, radii = twins.random_scene(seed, sphere_count=sphere_count)
    for facing in (None, normals):
        got = transmittance(points * scale, facing, centers * scale, radii * scale, cells.fibonacci(64))
        assert got.min() >= 0 and got.max() <= 1


@pytest.mark.slow
@pytest.mark.parametrize("count", [64, 256])
@pytest.mark.parametrize("distance", [1.0, 1.003, 1.009, 1.02])
def test_a_lone_sphere_at_its_surface_is_not_culled_where_its_cone_is_wider_than_the_sphere(count, distance, device):
    """From 1.01 radii on inwards a cone is blended over to a hemisphere."""
    rng = np.random.default_rng(3)
    directions = cells.fibonacci(count)
    away = rng.normal(size=(200, 3))
    points = distance * away / np.linalg.norm(away, axis=1, keepdims=True)
    one, unit = np.zeros((1, 3)), np.ones(1)
    alone = np.stack([transmittance(point[None], None, one, unit, directions, device)[0] for point in points])
    expected = twins.transmittance(points.astype(np.float32).astype(float), one, unit, directions)
    assert np.abs(alone - expected).max() < 5 * FLOAT32[count]  # steeper where the cone is blended


def test_directions_that_coincide_block_light_like_any(device):
    """As the cells of a tiny sun may look: the cone around four of them has no width."""
    directions = np.repeat(np.random.default_rng(1).normal(size=(4, 3)), 4, axis=0).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert not any(np.isnan(part).any() for part in cells.bundle_cones(directions))
    points, _, centers, radii = twins.random_scene(6)
    got = transmittance(points, None, centers, radii, directions, device)
    expected = twins.transmittance(*wide(points, centers, radii), directions.astype(float))
    assert np.abs(got - expected).max() < FLOAT32[16] + OPAQUE


def test_culling_below_the_horizon_changes_nothing_above_it(device):
    points, normals, centers, radii = twins.random_scene(4, vertex_count=64)
    normals[:] = np.repeat(normals[::16], 16, axis=0)  # groups that face one way, so that whole bundles are culled
    directions = cells.fibonacci(128)
    everything = transmittance(points, None, centers, radii, directions, device)
    culled = transmittance(points, normals, centers, radii, directions, device)
    above = normals @ directions.T > 0
    np.testing.assert_array_equal(culled[above], everything[above])
    assert (culled != everything).any()  # or nothing was culled


@pytest.mark.parametrize("ratio", [4.0, 30.0, 1000.0])
@pytest.mark.parametrize("count", [64, 256])
def test_a_sphere_however_small_blocks_its_cones_solid_angle_on_average(count, ratio, device):
    """Averaged over orientations: a cell sees the sphere in all positions; 10 000 leave a few percent of noise."""
    rng = np.random.default_rng(5)
    centers = np.zeros((1, 3))
    points = rng.normal(size=(10000, 3))
    points *= ratio / np.linalg.norm(points, axis=1, keepdims=True)
    blocked = 1 - transmittance(points, None, centers, [1.0], cells.fibonacci(count), device).astype(float)
    expected = (1 - np.sqrt(1 - ratio**-2)) / 2  # share of the sphere of directions
    noise = np.std(blocked.mean(axis=1)) / np.sqrt(10000)
    assert abs(blocked.mean() - expected) < 4 * noise + 2e-3 * expected
    assert noise < 0.05 * expected


def test_one_lane_gives_what_sixteen_give(monkeypatch, device):
    points, normals, centers, radii = twins.random_scene(6)
    directions = cells.fibonacci(128)
    many = transmittance(points, normals, centers, radii, directions, device)
    monkeypatch.setattr(traversal, "lane_count", lambda _: 1)
    one = transmittance(points, normals, centers, radii, directions, device)
    above = normals @ directions.T > 0
    assert np.abs(one - many)[above].max() < OPAQUE


def test_the_threads_of_a_gpu_give_what_those_of_a_cpu_give(request):
    values, directions = twins.random_scene(6), cells.fibonacci(64)
    above = values[1] @ directions.T > 0
    weights = np.where(above, np.random.default_rng(0).normal(size=above.shape), 0.0)

    def result_and_gradients():
        arrays = [wp.array(v[None], dtype=wp.vec3 if v.ndim == 2 else float, requires_grad=True) for v in values]
        with wp.Tape() as tape:
            result = directional.transmittance(*arrays, directions)
        tape.backward(grads={result: wp.array(weights[None], dtype=float)})
        return result.numpy()[0], [arrays[k].grad.numpy() for k in (0, 2, 3)]

    on_cpu, gradients_on_cpu = result_and_gradients()
    request.getfixturevalue("gpu_branches")
    as_on_gpu, gradients_as_on_gpu = result_and_gradients()
    assert np.abs(as_on_gpu - on_cpu)[above].max() < OPAQUE
    for ours, theirs in zip(gradients_as_on_gpu, gradients_on_cpu, strict=True):
        assert np.linalg.norm(ours - theirs) < 1e-4 * np.linalg.norm(theirs)


@pytest.mark.parametrize("vertex_count", [1, 15, 16, 17])
def test_any_number_of_vertices_gives_each_its_own(vertex_count, device):
    """Not bit by bit: a group goes on past the opaque while one of its receivers is bright."""
    points, _, centers, radii = twins.random_scene(7, vertex_count=17)
    directions = cells.fibonacci(64)
    whole = transmittance(points, None, centers, radii, directions, device)
    part = transmittance(points[:vertex_count], None, centers, radii, directions, device)
    assert part.shape == (vertex_count, 64)
    assert np.abs(part - whole[:vertex_count]).max() < OPAQUE


def test_a_batch_of_three_is_three_single_calls(device):
    scenes = [twins.random_scene(seed, vertex_count=21) for seed in (8, 9, 10)]
    directions = cells.fibonacci(64)
    together = transmittance(*(np.stack(values) for values in zip(*scenes, strict=True)), directions, device)
    for rows, scene in zip(together, scenes, strict=True):
        np.testing.assert_array_equal(rows, transmittance(*scene, directions, device))


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_permuting_vertices_and_spheres_changes_nothing_but_rounding(seed):
    points, _, centers, radii = twins.random_scene(seed)
    directions = cells.fibonacci(64)
    rng = np.random.default_rng(seed)
    vertices, spheres = rng.permutation(len(points)), rng.permutation(len(radii))
    expected = transmittance(points, None, centers, radii, directions)[vertices]
    got = transmittance(points[vertices], None, centers[spheres], radii[spheres], directions)
    assert np.abs(got - expected).max() < 1e-6 + OPAQUE


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), exponent=st.integers(-18, 18))
def test_moving_and_scaling_scene_and_directions_together_changes_nothing(seed, exponent):
    points, _, centers, radii = twins.random_scene(seed)
    distances = np.linalg.norm(points[:, None] - centers, axis=-1)
    clear = (np.abs(distances / radii - 1) > 0.05).all(axis=1)  # near touch, cos θ magnifies rounding of the positions
    rotation, offset = twins.random_rotation(seed), np.float32([3.0, -1.0, 2.0])
    directions = cells.fibonacci(64)
    expected = transmittance(points, None, centers, radii, directions)
    got = transmittance(
        2.0**exponent * (points @ rotation.T + offset),
        None,
        2.0**exponent * (centers @ rotation.T + offset),
        2.0**exponent * radii,
        directions @ rotation.T,
    )
    # the step is up to 260 times as steep as its argument, rounded at 3e-7 after the offset of 4
    assert np.abs(got - expected)[clear].max(initial=0) < 1e-3


def test_directions_in_any_order_give_their_columns_in_that_order(device):
    points, _, centers, radii = twins.random_scene(11)
    directions = cells.fibonacci(64)
    shuffle = np.random.default_rng(11).permutation(64)
    expected = transmittance(points, None, centers, radii, directions, device)[:, shuffle]
    got = transmittance(points, None, centers, radii, directions[shuffle], device)
    assert np.abs(got - expected).max() < 1e-6 + OPAQUE


@pytest.mark.parametrize("count", range(16, 1025, 112))
def test_any_multiple_of_sixteen_directions_will_do(count, device):
    points, _, centers, radii = twins.random_scene(12, vertex_count=3)
    directions = cells.fibonacci(count)
    got = transmittance(points, None, centers, radii, directions, device)
    expected = twins.transmittance(*wide(points, centers, radii), directions)
    assert np.abs(got - expected).max() < FLOAT32[1024] + OPAQUE


@pytest.mark.parametrize("radii, centers", [([0.0, 0.0], [[1, 0, 0], [0, 0, 0]]), ([], np.zeros((0, 3)))])
def test_no_spheres_and_spheres_of_radius_zero_let_everything_pass(radii, centers, device):
    points, normals, *_ = twins.random_scene(13)
    points[0] = 0
    assert (transmittance(points, normals, centers, radii, cells.fibonacci(64), device) == 1).all()


def test_spheres_that_are_left_out_block_nothing(device):
    points, normals, centers, radii = twins.random_scene(15)
    without = radii.copy()
    without[3:7] = 0
    expected = transmittance(points, normals, centers, without, cells.fibonacci(64), device)
    got = transmittance(points, normals, centers, radii, cells.fibonacci(64), device, skips=[(3, 7)])
    np.testing.assert_array_equal(got, expected)
    with pytest.raises(ValueError, match="skips: got"):
        transmittance(points, normals, centers, radii, cells.fibonacci(64), device, skips=[(3, len(radii) + 1)])


def test_receivers_of_several_bodies_are_as_those_of_each_alone(device):
    """Spans do not end where blocks of lanes do, and one is empty."""
    points, normals, centers, radii = (np.stack([values] * 2) for values in twins.random_scene(15, vertex_count=50))
    points[1] += 0.1
    directions, skips = cells.fibonacci(64), [(3, 7), (0, 0), (0, len(radii[0])), (1, 2)]
    spans = [Span(0, 0, 19), Span(1, 19, 19), Span(2, 19, 30), Span(3, 30, 50)]
    got = transmittance(points, normals, centers, radii, directions, device, body_spans=spans, skips=skips)
    for (_, first, end), skip in zip(spans, skips, strict=True):
        of_body = points[:, first:end], normals[:, first:end]
        expected = transmittance(*of_body, centers, radii, directions, device, skips=[skip])
        np.testing.assert_array_equal(got[:, first:end], expected)


def test_concentric_and_hundreds_of_overlapping_spheres_are_finite(device):
    points, *_ = twins.random_scene(14)
    points[:3] = [[0, 0, 0], [1e-8, 0, 0], [1, 0, 0]]
    for centers in (np.zeros((500, 3)), np.random.default_rng(0).normal(size=(500, 3)) * 0.3):
        got = transmittance(points, None, centers, np.full(500, 1.0), cells.fibonacci(64), device)
        assert np.isfinite(got).all() and got.min() >= 0 and got.max() <= 1


def test_a_receiver_on_a_large_sphere_sees_half_of_the_sky(device):
    """A sphere that it touches blocks the hemisphere below; the soft edge averages out."""
    got = transmittance([[0, 1, 0]], None, [[0, 0, 0]], [1.0], cells.fibonacci(256), device)[0]
    height = cells.fibonacci(256)[:, 1]
    assert (got[height > 0.1] == 1).all()
    assert (got[height < -0.1] == 0).all()
    assert abs(got.mean() - 0.5) < 0.01


@pytest.mark.parametrize("count", [0, 8, 100])
def test_a_number_of_directions_that_is_no_multiple_of_16_is_refused(count, device):
    with pytest.raises(ValueError, match=f"directions: got {count}, expected a positive multiple of 16"):
        transmittance(*twins.random_scene(0), np.zeros((count, 3)), device)


def test_directions_that_are_no_vectors_are_refused(device):
    with pytest.raises(ValueError, match=r"directions: got shape \(16, 2\), expected \[direction, 3\]"):
        transmittance(*twins.random_scene(0), np.zeros((16, 2)), device)


@pytest.mark.parametrize("softness", [0.0, -0.35, 2.0, float("nan")])
def test_a_softness_without_meaning_is_refused(softness, device):
    with pytest.raises(ValueError, match="softness: got .* for 16 directions, expected 0.004 to 1.57"):
        transmittance(*twins.random_scene(0), cells.fibonacci(16), device, softness=softness)


def test_arrays_that_do_not_fit_together_are_refused(device):
    """Unchecked, the kernel would read beyond them."""

    def zeros(*shape, dtype=wp.vec3):
        return wp.zeros(shape, dtype=dtype, device=device)

    points, normals, centers, radii = zeros(2, 5), zeros(2, 5), zeros(2, 3), zeros(2, 3, dtype=wp.float32)
    with pytest.raises(ValueError, match=r"normals: got shape \(2, 4\), expected \[2, 5\]"):
        directional.transmittance(points, zeros(2, 4), centers, radii, cells.fibonacci(16))
    with pytest.raises(ValueError, match=r"centers: got shape \(1, 3\), expected \[2, sphere\]"):
        directional.transmittance(points, normals, zeros(1, 3), radii, cells.fibonacci(16))
    footprints = zeros(2, 4)
    with pytest.raises(ValueError, match=r"footprints: got shape \(2, 4\), expected \[2, 5\]"):
        directional.transmittance(points, normals, centers, radii, cells.fibonacci(16), footprints=footprints)
    with pytest.raises(ValueError, match=r"radii: got shape \(2, 2\), expected \[2, 3\]"):
        directional.transmittance(points, normals, centers, zeros(2, 2, dtype=wp.float32), cells.fibonacci(16))


def test_no_receivers_is_no_work(device):
    nobody = np.zeros((0, 3))
    assert transmittance(nobody, nobody, [[0, 0, 0]], [1.0], cells.fibonacci(16), device).shape == (0, 16)


def test_only_inputs_that_require_a_gradient_get_one(device):
    points, normals, centers, radii = twins.random_scene(3, vertex_count=19, sphere_count=7)
    vectors = [wp.array(values[None], dtype=wp.vec3, device=device) for values in (points, normals, centers)]
    sizes = wp.array(radii[None], dtype=wp.float32, device=device, requires_grad=True)
    with wp.Tape() as tape:
        result = directional.transmittance(*vectors, sizes, cells.fibonacci(32))
    result.grad.fill_(1.0)
    tape.backward()
    assert sizes.grad.numpy().any() and all(array.grad is None for array in vectors)
