"""Log-SH visibility: the logs of one cap, their sum, its exponential, and what must not change them."""

import json

import numpy as np
import pytest
import twins
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warpshadow.maths import sh
from warpshadow.stages.visibility import exponential, log_sh, traversal, zonal_logs

# A sphere's coefficients reach 10 and carry some roundings each; sums of a dozen; relative to the row's norm. Where a
# receiver is within 1% of a sphere's surface, cos θ is good to 5e-6 only (see test_cones.py).
ACCUMULATE = 2e-5
# Where an eigenvalue passes its floor the eigen log has a corner, which the table's C² spline rounds over three of its
# 2048 intervals; measured: 0.0055 at most of one cap's coefficients (order 8), whose norm is 1 or more there.
CORNER = 6e-3
CORNER_WIDTH = 3 / 2048
# Each of p squarings doubles the relative error, 6e-8·2^p; measured 1.4e-6 for quadratic, 1.9e-5 for linear.
EXPONENTIATE = 5e-5
# Between neighbors of a scan: what the value rises beyond its adjoint's integral, measured 4e-6, and steps of
# the adjoint, measured 1.5e-3. A number of squarings that jumps has 3e-3 and 5e-3 or more.
SMOOTH = 1e-4
STEEPEST = 3e-3
# The golden zonal vectors are given to 1e-6 of numbers up to 10.
ZONAL = 1e-5

LOGS = list(zonal_logs.LOGS)
BASES = list(exponential.THRESHOLDS)


pytestmark = [
    pytest.mark.usefixtures("poisoned_outputs"),
    pytest.mark.filterwarnings("ignore:log-SH visibility"),  # of squarings that are held
]


def vectors(values, device):
    """[vertex, 3] or [batch, vertex, 3] → vec3 of shape [batch, vertex]."""
    values = np.asarray(values, np.float32)
    return wp.array(values[None] if values.ndim == 2 else values, dtype=wp.vec3, device=device)


def scalars(values, device):
    values = np.asarray(values, np.float32)
    return wp.array(values[None] if values.ndim == 1 else values, dtype=wp.float32, device=device)


def accumulate(points, normals, centers, radii, device="cpu", **options):
    """Call the library with NumPy arrays of one instance, or of several."""
    normals = None if normals is None else vectors(normals, device)
    arguments = vectors(points, device), normals, vectors(centers, device), scalars(radii, device)
    result = log_sh.accumulate(*arguments, **options).numpy()
    return result if np.ndim(points) == 3 else result[0]


def exponentiate(rows, device="cpu", **options):
    return exponential.exponentiate(wp.array(rows[None].astype(np.float32), device=device), **options).numpy()[0]


def row_errors(got, expected):
    """Distance of each row, relative to the root-mean-square norm of all rows."""
    scale = np.sqrt((expected**2).sum(axis=1).mean())
    return np.linalg.norm(got - expected, axis=1) / scale


# ------------------------------------------------------------------------------------------ one cap


@pytest.mark.parametrize("order", [2, 5, 8])
def test_zonal_caps_are_the_numeric_projections_of_caps(order):
    cosine = np.cos(np.linspace(1e-3, np.pi / 2, 50))
    assert np.abs(zonal_logs.zonal_cap(order, cosine) - twins.zonal_cap(order, cosine)).max() < 1e-12  # float64


@pytest.mark.parametrize("order", [2, 5, 8])
def test_eigen_logs_are_those_of_the_twin(order):
    cosine = np.cos(np.linspace(1e-2, np.pi / 2, 50))
    difference = zonal_logs.zonal_eigen_log(order, cosine) - twins.zonal_log(order, cosine, "eigen")
    assert np.abs(difference).max() < 1e-10  # float64; eigenvectors of near eigenvalues


def test_zonal_logs_are_the_golden_ones(golden_data):
    golden = json.loads((golden_data / "golden_zonal.json").read_text())
    for angle, logs in golden.items():
        cosine = np.cos(np.radians(float(angle)))
        assert np.abs(-zonal_logs.CAP_DEPTH * zonal_logs.zonal_cap(8, cosine) - logs["cap"]).max() < ZONAL
        assert np.abs(zonal_logs.zonal_eigen_log(8, cosine) - logs["eigen"]).max() < ZONAL


def upright(angles, radius=1.0):
    """Receivers below a sphere at the origin that see it straight up at half-angles [rad]."""
    points = np.zeros((len(angles), 3))
    points[:, 2] = -radius / np.sin(angles)
    return points, np.zeros((1, 3)), [radius]


@pytest.mark.parametrize("log", LOGS)
def test_one_sphere_straight_up_gives_the_golden_zonal_log(log, golden_data, device):
    golden = json.loads((golden_data / "golden_zonal.json").read_text())
    points, centers, radii = upright(np.radians([float(angle) for angle in golden]))
    rows = accumulate(points, None, centers, radii, device, order=8, log=log)
    at_zero = [band**2 + band for band in range(8)]
    expected = np.zeros_like(rows)
    expected[:, at_zero] = [logs[log] for logs in golden.values()]
    # 89° is within 1% of touching, where the cone is blended: the golden value is of the exact cone
    exact = np.array([float(angle) < np.degrees(np.arcsin(1 / 1.01)) for angle in golden])
    assert exact.sum() >= 8
    assert np.abs(rows - expected)[exact].max() < ZONAL


@pytest.mark.parametrize("log", LOGS)
@pytest.mark.parametrize("order", [2, 4, 8])
def test_tiny_caps_keep_their_relative_accuracy(log, order, device):
    """The difference P_{l−1} − P_{l+1} would lose everything at sin θ = 1e-4."""
    sine = np.geomspace(1e-4, 1e-1, 20)
    points, centers, radii = upright(np.arcsin(sine))
    rows = accumulate(points, None, centers, radii, device, order=order, log=log)
    at_zero = [band**2 + band for band in range(order)]
    s2 = np.sin(np.arcsin(1 / np.abs(points[:, 2].astype(np.float32).astype(float)))) ** 2
    band = np.arange(1, order)
    cosine = np.sqrt(1 - s2)
    if log == "cap":
        first = -3 * np.sqrt(np.pi) * s2 / (1 + cosine)
        slopes = np.stack([np.polynomial.legendre.Legendre.basis(k).deriv()(cosine) for k in band], -1)
        rest = -3 * np.sqrt(np.pi * (2 * band + 1)) / (band * (band + 1)) * s2[:, None] * slopes
        expected = np.concatenate([first[:, None], rest], axis=-1)
    else:
        # float64 eigenvalues carry 1e-15 of 1, and so their logs of s² 1e-7 at s² = 1e-8
        expected = twins.zonal_log(order, cosine, log)
    np.testing.assert_allclose(rows[:, at_zero], expected, rtol=3e-6)


# ------------------------------------------------------------------------------------------ sums


@pytest.mark.slow
@pytest.mark.parametrize("has_horizon", [False, True])
@pytest.mark.parametrize("log", LOGS)
@pytest.mark.parametrize("order", [2, 4, 8])
def test_sums_are_those_of_the_float64_twin(order, log, has_horizon, device):
    points, normals, centers, radii = twins.random_scene(order, vertex_count=50)
    points[:4] = centers[:4] + radii[:4, None] * np.float32([0, 1.0, 0])  # touching
    points[4:6] = centers[4:6] + radii[4:6, None] * np.float32([0.1, 0, 0])  # nearly at the center
    normals = normals if has_horizon else None
    got = accumulate(points, normals, centers, radii, device, order=order, log=log)
    wide = [None if values is None else values.astype(float) for values in (points, normals, centers, radii)]
    expected = twins.log_sh(*wide, order, log)
    _, cosine, _ = twins.cones(wide[0][:, None], wide[2], wide[3])
    corners = twins.eigen_corners(order) if log == "eigen" else np.zeros(0)
    rounded = (np.abs(cosine[..., None] - corners) < CORNER_WIDTH).any(axis=(1, 2))
    assert rounded.mean() < 0.5
    assert row_errors(got, expected)[~rounded].max() < ACCUMULATE
    assert np.linalg.norm(got - expected, axis=1)[rounded].max(initial=0) < CORNER


@pytest.mark.parametrize("order", [3, 8])
def test_the_table_of_eigen_logs_is_exact_but_for_rounded_corners(order, device):
    """The table's rows are [interval, power, band]; it holds z / sin²θ over cos θ."""
    table = zonal_logs.zonal_table(order, "eigen", device).numpy().astype(float)
    cosine = (np.arange(30000) + 0.4) / 30000
    interval = (cosine * len(table)).astype(int)
    t = (cosine * len(table) - interval)[:, None]
    got = sum(table[interval, power] * t**power for power in range(4)) * (1 - cosine**2)[:, None]
    error = np.abs(got - twins.zonal_log(order, cosine, "eigen")).max(axis=1)
    rounded = (np.abs(cosine[:, None] - twins.eigen_corners(order)) < 2 * CORNER_WIDTH).any(axis=1)
    assert rounded.mean() < 0.05
    assert error[~rounded].max() < ZONAL
    assert error.max() < CORNER


@pytest.mark.parametrize("log", LOGS)
def test_one_lane_gives_what_sixteen_give(log, monkeypatch, device):
    """A GPU runs one lane a thread; so a CPU can check that code."""
    scene = twins.random_scene(3)
    many = accumulate(*scene, device, order=8, log=log)
    monkeypatch.setattr(traversal, "lane_count", lambda _: 1)
    one = accumulate(*scene, device, order=8, log=log)
    assert row_errors(one, many.astype(float)).max() < ACCUMULATE
    visibility = exponentiate(many, device)
    monkeypatch.undo()
    assert row_errors(visibility, exponentiate(many, device).astype(float)).max() < EXPONENTIATE


def test_spheres_below_the_horizon_contribute_nothing(device):
    normals = np.array([[0, 1, 0]])
    below = accumulate([[0, 0, 0]], normals, [[0.3, -1.001, 0.2]], [1.0], device)
    assert not below.any()
    above = [[0.3, -0.4999, 0.2]]  # half a radius below the plane, from where on nothing is faded
    got = accumulate([[0, 0, 0]], normals, above, [1.0], device)
    assert np.abs(got - accumulate([[0, 0, 0]], None, above, [1.0], device)).max() < 1e-4
    assert np.abs(got).max() > 1


def test_a_batch_of_three_is_three_single_calls(device):
    scenes = [twins.random_scene(seed, vertex_count=21) for seed in (5, 6, 7)]
    together = accumulate(*(np.stack(values) for values in zip(*scenes, strict=True)), device, order=4)
    for rows, scene in zip(together, scenes, strict=True):
        np.testing.assert_array_equal(rows, accumulate(*scene, device, order=4))
    visibility = exponential.exponentiate(wp.array(together, device=device)).numpy()
    for rows, row in zip(visibility, together, strict=True):
        np.testing.assert_array_equal(rows, exponentiate(row, device))


@pytest.mark.parametrize("vertex_count", [1, 15, 16, 17])
def test_a_vertex_does_not_depend_on_its_neighbors_or_their_number(vertex_count, device):
    points, normals, centers, radii = twins.random_scene(8, vertex_count=17)
    whole = accumulate(points, normals, centers, radii, device, order=4)
    part = accumulate(points[:vertex_count], normals[:vertex_count], centers, radii, device, order=4)
    np.testing.assert_array_equal(part, whole[:vertex_count])
    whole[-1] *= 20  # a neighbor that takes more squarings
    np.testing.assert_array_equal(exponentiate(whole, device)[:vertex_count][:16], exponentiate(part, device)[:16])


def test_permuting_vertices_permutes_the_result(device):
    points, normals, centers, radii = twins.random_scene(9)
    order = np.random.default_rng(9).permutation(len(points))
    rows = accumulate(points, normals, centers, radii, device, order=4)
    permuted = accumulate(points[order], normals[order], centers, radii, device, order=4)
    np.testing.assert_array_equal(permuted, rows[order])
    np.testing.assert_array_equal(exponentiate(permuted, device), exponentiate(rows, device)[order])


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_permuting_spheres_changes_nothing_but_rounding(seed):
    points, normals, centers, radii = twins.random_scene(seed)
    order = np.random.default_rng(seed).permutation(len(radii))
    rows = accumulate(points, normals, centers, radii, order=4).astype(float)
    assert row_errors(accumulate(points, normals, centers[order], radii[order], order=4), rows).max() < 2e-6


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), exponent=st.integers(-18, 18), log=st.sampled_from(LOGS))
def test_moving_and_scaling_the_scene_turns_the_result(seed, exponent, log):
    points, normals, centers, radii = twins.random_scene(seed)
    distances = np.linalg.norm(points[:, None] - centers, axis=-1)
    clear = (np.abs(distances / radii - 1) > 0.05).all(axis=1)  # near touch, cos θ magnifies rounding of the positions
    rotation, offset = twins.random_rotation(seed), np.float32([3.0, -1.0, 2.0])
    rows = accumulate(points, normals, centers, radii, order=4, log=log)
    moved = accumulate(
        2.0**exponent * (points @ rotation.T + offset),
        normals @ rotation.T,
        2.0**exponent * (centers @ rotation.T + offset),
        2.0**exponent * radii,
        order=4,
        log=log,
    )
    expected = rows @ sh.harmonic_rotation(4, rotation).T
    # the offset of 4 against radii of 0.05 costs a digit or two of float32
    assert row_errors(moved[clear], expected[clear]).max(initial=0) < 1e-4


@pytest.mark.parametrize("radii, centers", [([0.0, 0.0], [[1, 0, 0], [0, 0, 0]]), ([], np.zeros((0, 3)))])
@pytest.mark.parametrize("log", LOGS)
def test_no_spheres_and_spheres_of_radius_zero_leave_all_visible(log, radii, centers, device):
    points, normals, *_ = twins.random_scene(11)
    points[0] = 0  # at a center
    rows = accumulate(points, normals, centers, radii, device, order=4, log=log)
    assert not rows.any()
    visibility = exponentiate(rows, device)
    expected = np.eye(1, 16) * twins.UNIT
    np.testing.assert_allclose(visibility, np.repeat(expected, len(points), axis=0), rtol=1e-6)


@pytest.mark.parametrize("log", LOGS)
@pytest.mark.parametrize(
    "centers",
    [np.zeros((500, 3)), np.random.default_rng(0).normal(size=(500, 3)) * 0.3, [[0, 0, 0]] * 2 + [[1e-8, 0, 0]]],
    ids=["concentric", "overlapping", "nearly the same"],
)
def test_visibility_stays_bounded_however_spheres_overlap(centers, log, device):
    points, normals, *_ = twins.random_scene(12)
    points[:3] = [[0, 0, 0], [1e-8, 0, 0], [1, 0, 0]]
    rows = accumulate(points, normals, centers, np.full(len(centers), 1.0), device, log=log)
    assert np.isfinite(rows).all()
    visibility = exponentiate(rows, device)
    assert np.isfinite(visibility).all()
    assert np.abs(visibility).max() < 2 * twins.UNIT


# ------------------------------------------------------------------------------------------ exponentials


@pytest.mark.slow
@pytest.mark.parametrize("order, base", [(2, "quadratic"), *((8, base) for base in BASES)])
def test_exponentials_are_those_of_the_float64_twin(order, base, device):
    points, normals, centers, radii = twins.random_scene(order, vertex_count=50)
    rows = accumulate(points, normals, centers, radii, device, order=order).astype(float)
    rows[0] = 0
    rows[1] *= 1e-6
    rows[2] *= 4
    got = exponentiate(rows, device, base=base)
    expected = twins.exponential(rows, base, exponential.THRESHOLDS[base].default)
    assert row_errors(got, expected).max() < EXPONENTIATE


@pytest.mark.slow
@pytest.mark.parametrize("base, error", [("quadratic", 5e-3), ("linear", 5e-3), ("optimal_linear", 5e-2)])
def test_the_default_threshold_is_near_convergence(base, error, device):
    """Converged: quadratic with a threshold of 1/1000. The errors are the base approximation's, not roundings."""
    rows = accumulate(*twins.random_scene(13), device).astype(float)
    converged = twins.exponential(rows, "quadratic", 1e-3)
    got = exponentiate(rows, device, base=base)
    assert np.linalg.norm(got - converged) < error * np.linalg.norm(converged)


def test_the_constant_part_scales_the_result_and_may_be_far_below_zero(device):
    rows = accumulate(*twins.random_scene(14), device).astype(float)
    darker = rows + np.eye(1, 64) * -2 * twins.UNIT
    got, expected = exponentiate(darker, device), np.exp(-2.0) * exponentiate(rows, device)
    assert np.abs(got - expected).max() < EXPONENTIATE * np.abs(expected).max()
    darkest = rows + np.eye(1, 64) * -500 * twins.UNIT
    assert np.abs(exponentiate(darkest, device)).max() == 0  # below float32, not NaN


@pytest.mark.parametrize("base", BASES)
def test_nothing_jumps_where_the_number_of_squarings_changes(base, device):
    """Over four octaves of |f̂|: the value rises by the integral of its adjoint, and the adjoint has no steps."""
    rng = np.random.default_rng(16)
    direction, weights = -np.abs(rng.normal(size=(2, 16)))
    direction /= np.linalg.norm(direction[1:])
    sizes = exponential.THRESHOLDS[base].default * np.geomspace(0.4, 6.4, 4000)
    rows = wp.array((sizes[:, None] * direction)[None].astype(np.float32), device=device, requires_grad=True)
    with wp.Tape() as tape:
        visibility = exponential.exponentiate(rows, base=base)
    visibility.grad.assign(np.tile(weights, (1, len(sizes), 1)).astype(np.float32))
    tape.backward()
    values = visibility.numpy()[0] @ weights
    slopes = rows.grad.numpy()[0] @ direction * sizes  # by log |f̂|
    rises = (slopes[1:] + slopes[:-1]) / 2 * np.diff(np.log(sizes))
    assert np.abs(np.diff(values) - rises).max() < SMOOTH * np.ptp(values)
    assert np.abs(np.diff(slopes)).max() < STEEPEST * np.ptp(slopes)


@pytest.mark.parametrize("base", BASES)
def test_a_threshold_beyond_stability_is_refused(base):
    rows = np.zeros((1, 64))
    limit = exponential.THRESHOLDS[base].limit
    assert np.isfinite(exponentiate(rows, base=base, threshold=limit)).all()
    for threshold in (1.01 * limit, 4.0 * limit, 0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=rf"threshold: got .* for base '{base}', expected 0.01 to"):
            exponentiate(rows, base=base, threshold=threshold)


@pytest.mark.slow
@pytest.mark.parametrize("base", BASES)
def test_the_largest_threshold_allowed_does_not_explode(base, device):
    rows = accumulate(*twins.random_scene(15, sphere_count=100), device).astype(float)
    converged = twins.exponential(rows, "quadratic", 1e-3)
    got = exponentiate(rows, device, base=base, threshold=exponential.THRESHOLDS[base].limit)
    assert np.linalg.norm(got - converged) < np.linalg.norm(converged)


def test_no_receivers_is_no_work(device):
    nobody = np.zeros((0, 3))
    rows = accumulate(nobody, nobody, [[0, 0, 0]], [1.0], device, order=4)
    assert rows.shape == (0, 16)
    assert exponentiate(rows, device).shape == (0, 16)


def test_unknown_bases_and_logs_are_refused_with_a_suggestion(device):
    with pytest.raises(ValueError, match=r"base: got 'quadratc', .*did you mean 'quadratic'"):
        exponentiate(np.zeros((1, 16)), device, base="quadratc")
    with pytest.raises(ValueError, match=r"log: got 'eigne', .*did you mean 'eigen'"):
        accumulate(*twins.random_scene(0), device, log="eigne")


@pytest.mark.parametrize("order", [1, 9])
def test_orders_without_kernels_are_refused(order, device):
    with pytest.raises(ValueError, match=f"order: got {order}, expected a number of bands from 2 to 8"):
        accumulate(*twins.random_scene(0), device, order=order)
    with pytest.raises(ValueError, match=f"order: got {order}, expected"):
        exponentiate(np.zeros((1, order**2)), device)


def test_log_visibility_of_no_order_is_refused(device):
    with pytest.raises(ValueError, match=r"log_sh: got shape \(1, 1, 60\), expected \[batch, receiver, 64\]"):
        exponentiate(np.zeros((1, 60)), device)


def test_arrays_that_do_not_fit_together_are_refused(device):
    """Unchecked, the kernel would read beyond them."""

    def zeros(*shape, dtype=wp.vec3):
        return wp.zeros(shape, dtype=dtype, device=device)

    points, normals, centers, radii = zeros(2, 5), zeros(2, 5), zeros(2, 3), zeros(2, 3, dtype=wp.float32)
    with pytest.raises(ValueError, match=r"normals: got shape \(2, 4\), expected \[2, 5\]"):
        log_sh.accumulate(points, zeros(2, 4), centers, radii)
    with pytest.raises(ValueError, match=r"centers: got shape \(1, 3\), expected \[2, sphere\]"):
        log_sh.accumulate(points, normals, zeros(1, 3), radii)
    with pytest.raises(ValueError, match=r"radii: got shape \(2, 2\), expected \[2, 3\]"):
        log_sh.accumulate(points, normals, centers, zeros(2, 2, dtype=wp.float32))


def test_a_tape_played_back_twice_gives_the_same_gradient(device):
    dtypes = wp.vec3, wp.vec3, wp.vec3, wp.float32
    scene = zip(twins.random_scene(3, vertex_count=19, sphere_count=7), dtypes, strict=True)
    arrays = [wp.array(values[None], dtype=dtype, device=device, requires_grad=True) for values, dtype in scene]
    with wp.Tape() as tape:
        result = exponential.exponentiate(log_sh.accumulate(*arrays, order=4))
    gradients = []
    for _ in range(2):
        result.grad.fill_(1.0)
        tape.backward()
        gradients.append([array.grad.numpy().copy() for array in arrays])
        tape.zero()
    for first, second in zip(*gradients, strict=True):
        assert first.any()
        np.testing.assert_array_equal(first, second)
