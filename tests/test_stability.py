"""Numerical stability: finite in, finite out, values and gradients; the twins' values in hard cases; clear refusals.

Cases and measurement are those of demos/benchmarks/stability.py, which prints the figures that these tests bound.
"""

import dataclasses
import warnings

import numpy as np
import pytest
import twins
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import warpshadow as ws
from demos.benchmarks import stability
from warpshadow.maths.directions import fibonacci
from warpshadow.stages.geometry.normals import vertex_normals
from warpshadow.stages.geometry.poses import Poses
from warpshadow.stages.light.shading import shade
from warpshadow.stages.light.transfer import directional_transfer, sh_transfer
from warpshadow.stages.visibility import directional, exponential, log_sh

# Visibility: float32 against float64, relative to an unblocked receiver's. Measured 3e-5, where θ is nearly 90° and the
# cone's blend magnifies rounding a hundredfold, and at the rounded corners of the eigen log.
VALUE = 1e-4
# Gradients along random displacements. Measured 5e-3 where receivers meet a sphere (curvature jumps there, which
# differences of 1e-7 see), else 1e-3 and below.
GRADIENT = 1e-2
# Of receivers that spheres enclose, relative to nearly nothing: a GPU, whose blocks are one receiver wide, leaves out
# what is behind several spheres (2e-5 of the light); measured 0.14, on a CPU 1e-4.
ENCLOSED_GRADIENT = 0.2
# An eigenvalue that meets its floor rounds a corner of the log; measured 5e-2.
CORNER_GRADIENT = 0.1
# Of coordinates rounded to float32 far from the origin: eps · offset / radius is 2e-3 for the smallest radius here, and
# a soft edge makes half of it of an angle. Measured 8e-4, and 1e-2 for gradients.
OFFSET_VALUE = 3e-3
OFFSET_GRADIENT = 5e-2
# Squarings double the relative rounding of the base; measured 2e-3 (linear, where 7 of 20 squarings are not held) and
# 6e-3 (optimal_linear); of gradients 2e-2 (linear, of 10 000 spheres).
SQUARED = 1e-2
# The table of `optimal_linear` has corners 1e-3 apart, the twin's elsewhere; measured 0.15 of gradients. `linear` on a
# GPU, which rounds elsewhere: 0.095.
SQUARED_GRADIENT = {"quadratic": GRADIENT, "linear": 0.15, "optimal_linear": 0.2}
# Barycentrics of triangles of 1e-3 pixels: positions are known to 1e-6 pixels. Measured 1e-5 and 5e-5.
WEIGHTS = 1e-4

LOGS = ("eigen", "cap")
BASES = tuple(exponential.THRESHOLDS)
ORDERS = (2, 4, 8)  # each has kernels of its own, which compile for a second or more
BASES_OF_ORDERS = [(2, "quadratic"), (4, "quadratic"), *((8, base) for base in BASES)]

pytestmark = [
    pytest.mark.usefixtures("poisoned_outputs"),
    pytest.mark.filterwarnings("ignore:log-SH visibility"),  # of squarings that are held
]


def put(values, dtype, device="cpu"):
    return stability.to_device(np.asarray(values), dtype, device)


def backward(function, *inputs, seed=0):
    """Call a function under the tape and play back random weights: its result, and the gradients, in NumPy."""
    with wp.Tape() as tape:
        result = function(*inputs)
    result.grad.assign(np.random.default_rng(seed).normal(size=result.numpy().shape).astype(np.float32))
    tape.backward()
    return result.numpy(), [array.grad.numpy() for array in inputs if array is not None and array.grad is not None]


def assert_finite(values, gradients):
    assert np.isfinite(values).all()
    for gradient in gradients:
        assert np.isfinite(gradient).all()


# ------------------------------------------------------------------------------------------ hard scenes

SCENES = twins.hard_scenes()


@pytest.mark.slow
@pytest.mark.parametrize("count", [16, 64, 256])
@pytest.mark.parametrize("case", SCENES)
def test_transmittance_and_its_gradient_are_the_twins_in_hard_scenes(case, count, device):
    scene = SCENES[case]
    errors = stability.measure(stability.directional_stage(count), scene, stability.scene_displacements(scene), device)
    assert errors.is_finite
    assert errors.value < (OFFSET_VALUE if "offset" in case else VALUE)
    limit = ENCLOSED_GRADIENT if case == "enclosed" and device != "cpu" else GRADIENT
    assert errors.gradient < (OFFSET_GRADIENT if "offset" in case else limit)


@pytest.mark.slow
@pytest.mark.parametrize("log", LOGS)
@pytest.mark.parametrize("case", SCENES)
def test_log_sh_visibility_and_its_gradient_are_the_twins_in_hard_scenes(case, log, device):
    scene = SCENES[case]
    for order in ORDERS:
        stage = stability.log_sh_stage(order, log)
        errors = stability.measure(stage, scene, stability.scene_displacements(scene), device)
        assert errors.is_finite
        assert errors.value < (OFFSET_VALUE if "offset" in case else VALUE)
        corner = CORNER_GRADIENT if log == "eigen" and case == "enclosed" else GRADIENT
        assert errors.gradient < (OFFSET_GRADIENT if "offset" in case else corner)


@pytest.mark.slow
@pytest.mark.parametrize("order, base", BASES_OF_ORDERS)
def test_every_base_gives_the_twins_visibility_in_hard_scenes(order, base, device):
    for log in LOGS:
        rows = np.concatenate([twins.log_sh(*scene, order, log) for scene in SCENES.values()])
        values, gradients = backward(lambda f: exponential.exponentiate(f, base=base), put(rows, wp.float32, device))
        assert_finite(values, gradients)
        expected = twins.exponential(rows, base, exponential.THRESHOLDS[base].default)
        assert np.linalg.norm(values[0] - expected, axis=1).max() < VALUE * twins.UNIT


@settings(max_examples=20, deadline=None)
@given(exponent=st.floats(-6, 6), seed=st.integers(0, 2**32 - 1), log=st.sampled_from(LOGS))
def test_scaling_the_scene_by_a_millionth_to_a_million_changes_nothing(exponent, seed, log):
    scene = [values.astype(float) for values in twins.random_scene(seed, vertex_count=16, sphere_count=6)]
    distances = np.linalg.norm(scene[0][:, None] - scene[2], axis=-1) / scene[3]
    clear = (np.abs(distances - 1) > 0.05).all(axis=1)  # near touch, cos θ magnifies rounding of the positions
    scaled = [scene[0] * 10**exponent, scene[1], scene[2] * 10**exponent, scene[3] * 10**exponent]
    for stage in (stability.log_sh_stage(4, log), stability.directional_stage(64)):
        here, there = (
            stage.run(*(put(values, dtype) for values, dtype in zip(arguments, stage.dtypes, strict=True))).numpy()[0]
            for arguments in (scene, scaled)
        )
        assert np.abs(there - here)[clear].max(initial=0) < VALUE * twins.UNIT


@pytest.mark.parametrize("label", stability.VISIBILITY)
def test_far_from_the_origin_the_error_is_that_of_rounding_positions_alone(label, device):
    """It grows with eps · offset / radius, and vanishes against the twin of the rounded scene."""
    stage = stability.VISIBILITY[label]
    points, normals, centers, radii = SCENES["ordinary"]
    for offset in (1e3, 1e4, 1e5):
        scene = points + offset, normals, centers + offset, radii
        errors = stability.measure(stage, scene, stability.scene_displacements(scene), device)
        assert errors.value < np.finfo(np.float32).eps * offset / radii.min()
        rounded = tuple(values.astype(np.float32).astype(float) for values in scene)
        arguments = [put(values, dtype, device) for values, dtype in zip(scene, stage.dtypes, strict=True)]
        difference = stage.run(*arguments).numpy()[0] - stage.twin(*rounded)
        assert np.linalg.norm(difference, axis=1).max() < VALUE * stage.unit


# ------------------------------------------------------------------------------------------ overlap


@pytest.mark.slow
@pytest.mark.parametrize("depth", [1, 10, 100, 1000, 10000])
def test_any_number_of_spheres_in_one_direction_is_bounded_with_finite_gradients(depth, device):
    points, normals, centers, radii = twins.stacked_spheres(depth)
    scene = [
        put(values, dtype, device)
        for values, dtype in zip((points, normals, centers, radii), stability.SCENE, strict=True)
    ]
    exact = stability.exact_ambient(points, normals)
    for label, stage in stability.VISIBILITY.items():
        values, gradients = backward(stage.run, *scene)
        assert_finite(values, gradients)
        if label.startswith("directional"):
            assert values.min() >= 0 and values.max() <= 1
        else:
            assert np.abs(values).max() < 2 * twins.UNIT
        values, _ = backward(lambda p, n, c, r, run=stage.run: run(p, None, c, r), *scene)
        error = np.sqrt(np.mean((stability.ambient(values[0].astype(float), normals) - exact) ** 2))
        assert error < {"2": 1.0, "4": 0.3, "8": 0.2}.get(label[-1], 0.2) if "log" in label else error < 0.04


@pytest.mark.parametrize("depth", [3, 30, 300, 10000])
@pytest.mark.parametrize("order, base", [(2, "quadratic"), *((8, base) for base in BASES)])  # 4: 3.5e-2 at 10 000
def test_held_squarings_and_their_gradients_are_the_twins(order, base, depth, device):
    points, _, centers, radii = twins.stacked_spheres(1)
    rows = depth * twins.log_sh(points, None, centers, radii, order, "eigen")
    threshold = exponential.THRESHOLDS[base].default
    stage = stability.Stage(
        lambda f: exponential.exponentiate(f, base=base),
        lambda f: twins.exponential(f, base, threshold),
        (wp.float32,),
        twins.UNIT,
    )
    errors = stability.measure(stage, (rows,), lambda rng: (0.1 * rows * rng.normal(size=rows.shape),), device)
    assert errors.is_finite
    assert errors.value < SQUARED
    assert errors.gradient < SQUARED_GRADIENT[base]


def test_held_squarings_draw_a_warning_and_plain_ones_none(device, recwarn):
    warnings.simplefilter("always")
    points, _, centers, radii = twins.stacked_spheres(1)
    one = twins.log_sh(points, None, centers, radii, 8, "eigen")
    exponential.exponentiate(put(10 * one, wp.float32, device))
    assert not recwarn.list
    with pytest.warns(UserWarning, match="log-SH visibility of 12 of 12 receivers is held back from rising above 1"):
        exponential.exponentiate(put(300 * one, wp.float32, device))


@pytest.mark.slow
def test_plain_squaring_would_have_overflowed_where_held_squaring_is_good():
    """What stages/README.md says of overlap."""
    errors = stability.overlap_errors()
    for log in LOGS:
        plain, held = np.array(errors[f"{log} 8, plain squaring"]), np.array(errors[f"log-SH {log} 8"])
        depths = np.array(stability.DEPTHS)
        np.testing.assert_allclose(held[depths <= 6], plain[depths <= 6], rtol=1e-3)  # exact while it is quiet
        assert plain[depths >= 50].min() > 0.5 and plain[-1] > np.finfo(np.float32).max
        assert held.max() < 0.2
    assert max(errors["directional 128"]) < 0.04


def test_squaring_explodes_beyond_the_thresholds_that_are_accepted():
    errors = stability.threshold_errors()
    for base, (default, limit) in exponential.THRESHOLDS.items():
        explodes = stability.first_above(stability.THRESHOLD_GRID, errors[base], 1.0)
        assert default <= limit < explodes < 10


# ------------------------------------------------------------------------------------------ any finite input

# Of every size, zeros and subnormals included.
LARGEST = float(np.float32(1e18))
NUMBERS = st.floats(-LARGEST, LARGEST, width=32)
RADII = st.floats(0, LARGEST, width=32)


def vectors(count, numbers=NUMBERS):
    return arrays(np.float32, (count, 3), elements=numbers)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    points=vectors(4),
    normals=vectors(4, st.floats(-1, 1, width=32)),
    centers=vectors(3),
    radii=arrays(np.float32, 3, elements=RADII),
    at_centers=st.booleans(),
    kernel=st.sampled_from(BASES_OF_ORDERS),
    log=st.sampled_from(LOGS),
)
def test_any_finite_spheres_and_receivers_give_finite_visibility_and_gradients(
    points, normals, centers, radii, at_centers, kernel, log
):
    order, base = kernel
    if at_centers:
        points[:3] = centers
    scene = put(points, wp.vec3), put(normals, wp.vec3), put(centers, wp.vec3), put(radii, wp.float32)
    for facing in (scene[1], None):
        assert_finite(*backward(stability.directional_stage(16).run, scene[0], facing, *scene[2:]))
        assert_finite(*backward(stability.log_sh_stage(order, log, base).run, scene[0], facing, *scene[2:]))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    scale=st.floats(-12, 7),
    spread=st.floats(-6, 3),
    sphere_count=st.integers(1, 300),
    kernel=st.sampled_from(BASES_OF_ORDERS),
    log=st.sampled_from(LOGS),
)
def test_receivers_at_any_distance_of_any_heap_give_finite_visibility_and_gradients(
    seed, scale, spread, sphere_count, kernel, log
):
    """Radii of all sizes around one center, receivers from their centers to 1e9 radii away."""
    order, base = kernel
    rng = np.random.default_rng(seed)
    radii = 10**scale * 10 ** rng.uniform(-3, 1, sphere_count)
    centers = 10**scale * 10**spread * rng.normal(size=(sphere_count, 3))
    own = rng.integers(sphere_count, size=8)
    distances = rng.choice([0, 1e-12, 0.1, 0.25, 1, 1 + 1e-7, 1.01, 2, 1e3, 1e9], 8)
    toward = rng.normal(size=(8, 3))
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    points = centers[own] + (distances * radii[own])[:, None] * toward
    normals = toward * rng.choice([-1, 0, 1], (8, 1))
    scene = put(points, wp.vec3), put(normals, wp.vec3), put(centers, wp.vec3), put(radii, wp.float32)
    values, gradients = backward(stability.directional_stage(64).run, *scene)
    assert_finite(values, gradients)
    assert values.min() >= 0 and values.max() <= 1
    values, gradients = backward(stability.log_sh_stage(order, log, base).run, *scene)
    assert_finite(values, gradients)
    assert np.abs(values).max() < 4 * twins.UNIT


@settings(max_examples=60, deadline=None)
@given(
    kernel=st.sampled_from(BASES_OF_ORDERS),
    rows=arrays(np.float32, (3, 64), elements=NUMBERS),
    scale=st.sampled_from([1.0, 1e-6, 1e-12, 1e-18]),
)
def test_any_finite_log_gives_finite_visibility_and_gradients(kernel, rows, scale):
    """Logs above 0, too, though no visibility has them."""
    order, base = kernel
    rows = put(rows[:, : order**2] * np.float32(scale), wp.float32)
    assert_finite(*backward(lambda f: exponential.exponentiate(f, base=base), rows))


# ------------------------------------------------------------------------------------------ refusals


def scene_arrays(device):
    scene = SCENES["ordinary"]
    names = ("points", "normals", "centers", "radii")
    return {name: put(v, t, device) for name, v, t in zip(names, scene, stability.SCENE, strict=True)}


def accumulate(points, normals, centers, radii):
    return log_sh.accumulate(points, normals, centers, radii, order=4)


def transmittance(points, normals, centers, radii):
    return directional.transmittance(points, normals, centers, radii, fibonacci(16))


def spoil(array, value):
    """Write a value into the middle of an array."""
    values = array.numpy().copy()
    values.ravel()[values.size // 2] = value
    array.assign(values)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["points", "normals", "centers", "radii"])
@pytest.mark.parametrize("stage", [accumulate, transmittance])
def test_visibility_refuses_what_is_not_finite_by_the_name_of_the_argument(stage, name, value, device):
    scene = scene_arrays(device)
    spoil(scene[name], value)
    with pytest.raises(ValueError, match=rf"^{name}: got 1 NaN or Inf values \(first at index \(0, \d.*\)\), expected"):
        stage(**scene)


@pytest.mark.parametrize("value", [1e30, -1e19])
@pytest.mark.parametrize("name", ["points", "normals", "centers", "radii"])
@pytest.mark.parametrize("stage", [accumulate, transmittance])
def test_visibility_refuses_numbers_whose_squares_would_overflow(stage, name, value, device):
    scene = scene_arrays(device)
    spoil(scene[name], value)
    least = "0" if name == "radii" else r"-1e\+18"
    with pytest.raises(ValueError, match=rf"^{name}: got 1 values out of range .*, expected {least} to 1e\+18$"):
        stage(**scene)


@pytest.mark.parametrize("stage", [accumulate, transmittance])
def test_negative_radii_are_refused(stage, device):
    scene = scene_arrays(device)
    spoil(scene["radii"], -0.5)
    with pytest.raises(
        ValueError, match=r"^radii: got 1 values out of range \(first at index \(0, 3\): -0.5\), expected 0"
    ):
        stage(**scene)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30])
@pytest.mark.parametrize("coefficient", [0, 5])
def test_logs_that_are_not_finite_or_too_large_are_refused(coefficient, value, device):
    rows = np.zeros((4, 16))
    rows[2, coefficient] = value
    with pytest.raises(ValueError, match=rf"^log_sh: got 1 .* \(first at index \(0, 2, {coefficient}\)"):
        exponential.exponentiate(put(rows, wp.float32, device))


def test_directions_that_are_not_finite_or_not_unit_vectors_are_refused(device):
    scene = scene_arrays(device)
    for directions, message in (
        (np.full((16, 3), np.nan), "^directions: got 48 NaN or Inf values"),
        (2 * fibonacci(16), "^directions: got vectors of other lengths, expected unit vectors"),
    ):
        with pytest.raises(ValueError, match=message):
            directional.transmittance(*scene.values(), directions)


# ------------------------------------------------------------------------------------------ light


@pytest.mark.parametrize("case", stability.hard_lights())
@pytest.mark.parametrize("order", [0, 2, 8])
def test_shading_by_hard_lights_and_its_gradient_are_the_twins(order, case, device):
    """Order 0 stands for cells of directions."""
    stage, scene = stability.lit_stage(order, stability.hard_lights()[case]), SCENES["ordinary"]
    errors = stability.measure(stage, scene, stability.scene_displacements(scene), device)
    assert errors.is_finite
    assert errors.value < VALUE
    assert errors.gradient < GRADIENT


def test_a_sun_of_one_pixel_keeps_its_energy_in_cells_and_rings_in_spherical_harmonics():
    """In SH it has lobes below 0, and so has what they shade; that is the method's."""
    sun = stability.hard_lights()["a sun of one pixel"]
    integral = sun.solid_angles() @ sun.radiance.astype(float).sum(axis=1)
    np.testing.assert_allclose(sun.cells(fibonacci(128)).radiance.mean(axis=0), integral / (4 * np.pi), rtol=1e-6)
    coefficients = sun.sh(8).astype(float)
    np.testing.assert_allclose(coefficients[0] * twins.UNIT, integral, rtol=1e-6)
    radiance = twins.harmonics(8, fibonacci(4096)) @ coefficients[:, 0]
    assert -0.2 * radiance.max() < radiance.min() < -0.1 * radiance.max()


@settings(max_examples=40, deadline=None)
@given(light=arrays(np.float32, (64, 3), elements=st.floats(-1e6, 1e6, width=32)), order=st.sampled_from([0, 2, 8]))
def test_any_finite_light_gives_finite_shading_and_gradients(light, order):
    """Negative coefficients and negative radiance, too."""
    scene = [put(v, t) for v, t in zip(SCENES["ordinary"], stability.SCENE, strict=True)]
    directions = fibonacci(64)
    coefficients = put(light[: order**2 or 64], wp.vec3)

    def shading(points, normals, centers, radii, coefficients):
        if order:
            seen = stability.log_sh_stage(order, "eigen").run(points, normals, centers, radii)
            return shade(sh_transfer(seen, normals, order=order), coefficients)
        seen = directional.transmittance(points, normals, centers, radii, directions)
        return shade(directional_transfer(seen, normals, directions), coefficients)

    assert_finite(*backward(shading, *scene, coefficients))


# ------------------------------------------------------------------------------------------ one bound for all

METHODS = ("directional", "log-sh", "none", "ray-traced")


def small_scene(method, *, scale=1.0, light=1.0):
    """A ball over a textured ground, whatever its size, in constant light or in harmonics."""
    ball = ws.Body(ws.icosphere(0.5, 1), blockers=ws.Spheres([[0, 0, 0]], [0.5]), translation=(0, 0.6 * scale, 0))
    ground = ws.Body(ws.plane(4.0, 4), blockers=0, texture=np.full((4, 4, 3), 0.5))
    bodies = [dataclasses.replace(body, scale=scale) for body in (ball, ground)]
    eye, target = np.array([0.3, 2, 3.5]) * scale, np.array([0, 0.4, 0]) * scale
    camera = ws.Camera.look_at(eye, target, size=(12, 8), near=0.01 * scale)
    light = ws.EnvironmentMap.constant(light, height=8) if np.isscalar(light) else light
    return ws.Scene(
        bodies, light, camera, ws.Visibility.of({"method": method, "directions": 32, "order": 4, "samples": 32})
    )


@pytest.mark.parametrize("method", METHODS)
def test_light_and_scenes_up_to_the_bound_give_finite_images_by_every_method(method):
    harmonics = np.random.default_rng(0).choice([-LARGEST, LARGEST], (16, 3))
    for light in (LARGEST, harmonics):
        assert np.isfinite(ws.render(small_scene(method, light=light))).all()
    expected = ws.render(small_scene(method))
    for scale in (2.0**-20, 2.0**40):
        assert np.abs(ws.render(small_scene(method, scale=scale)) - expected).max() < VALUE
    for scale in (2.0**-57, 2.0**57):  # 7e-18 to 1.4e17: silhouettes are no longer smoothed
        image = ws.render(small_scene(method, scale=scale))
        assert np.isfinite(image).all() and np.abs(image - expected)[expected[..., 3] == 1].mean() < 0.02


@pytest.mark.parametrize("method", METHODS)
def test_every_method_refuses_what_is_beyond_the_bound_by_the_name_of_the_argument(method):
    beyond = 1.1e18
    renderer = ws.Renderer(small_scene(method))
    free = np.full((renderer.basis.size, 3), beyond)
    calls = [
        ("rgb", lambda: small_scene(method, light=beyond)),
        ("light", lambda: small_scene(method, light=np.full((16, 3), beyond))),
        ("light", lambda: renderer.render(free[:16])),
        ("light", lambda: renderer.draw(put(free, wp.vec3))),
        ("scale", lambda: small_scene(method, scale=beyond)),
        ("eye", lambda: ws.Camera.look_at((0, 0, beyond), (0, 0, 0))),
        ("near", lambda: ws.Camera.look_at((0, 0, 1), (0, 0, 0), near=beyond)),
        ("clip_matrices", lambda: renderer.view(clip_matrices=put(np.full((4, 4), beyond), wp.mat44))),
        ("positions", lambda: ws.Mesh(beyond * np.eye(3), np.array([[0, 1, 2]]))),
        ("centers", lambda: ws.Spheres([[beyond, 0, 0]], [1])),
        ("radii", lambda: ws.Spheres([[0, 0, 0]], [beyond])),
    ]
    for name, call in calls:
        with pytest.raises(ValueError, match=rf"^{name}: got .*1e\+18"):
            call()


@pytest.mark.parametrize("method", METHODS)
def test_poses_are_refused_where_they_or_what_they_place_are_beyond_the_bound(method):
    renderer = ws.Renderer(small_scene(method))
    rotations = renderer.scene_poses().rotations
    for shift, scale, name in ((2e18, 1.0, "translations"), (0, 2e18, "scales"), (LARGEST, LARGEST, "positions")):
        poses = Poses(rotations, put(np.full((2, 3), shift), wp.vec3), put([scale, scale], wp.float32))
        with pytest.raises(ValueError, match=rf"^{name}: got .*1e\+18"):
            renderer.view(renderer.placed(poses))


@pytest.mark.parametrize("method", METHODS[:3])
@pytest.mark.parametrize("scale", [2.0**-57, 2.0**57])
def test_poses_of_the_smallest_and_the_largest_scenes_have_finite_gradients(method, scale):
    renderer = ws.Renderer(small_scene(method, scale=scale))
    poses = renderer.scene_poses()
    free = [wp.clone(array, requires_grad=True) for array in (poses.rotations, poses.translations, poses.scales)]
    values, gradients = backward(lambda *free: renderer.draw(view=renderer.view(renderer.placed(Poses(*free)))), *free)
    assert_finite(values, gradients)
    assert all(gradient.any() for gradient in gradients)


# ------------------------------------------------------------------------------------------ triangles


@pytest.mark.parametrize("case", twins.hard_triangles())
def test_barycentrics_of_hard_triangles_and_their_gradients_are_the_twins(case, device):
    clip = twins.hard_triangles()[case]
    errors = stability.measure(
        stability.weights_stage(clip, device), (clip,), stability.triangle_displacements(clip), device
    )
    assert errors.is_finite
    assert errors.value < WEIGHTS
    assert errors.gradient < WEIGHTS


DEGENERATE = {
    "a point": [[0, 0, 0], [0, 0, 0], [0, 0, 0]],
    "two equal vertices": [[0, 0, 0], [0, 0, 0], [1, 2, 3]],
    "a line": [[0, 0, 0], [1, 1, 1], [3, 3, 3]],
    "a thinner sliver than any": [[0, 0, 0], [1e6, 0, 0], [5e5, 1e-40, 0]],
}


@pytest.mark.parametrize("case", DEGENERATE)
def test_faces_without_area_have_normals_and_gradients_of_zero(case, device):
    positions = put(np.array(DEGENERATE[case], float), wp.vec3, device)
    faces = wp.array([[0, 1, 2]], dtype=wp.vec3i, device=device)
    values, gradients = backward(lambda p: vertex_normals(p, faces), positions)
    assert not values.any() and not gradients[0].any()


def normals_twin(positions):
    normal = np.cross(positions[1] - positions[0], positions[2] - positions[0])
    return np.tile(normal / np.linalg.norm(normal), (3, 1))


@pytest.mark.parametrize("height", [1.0, 1e-3, 1e-6, 1e-11])
@pytest.mark.parametrize("scale", [1e-15, 1e-6, 1.0, 1e6, 1e15])
def test_normals_of_slivers_of_any_size_and_their_gradients_are_the_twins(scale, height, device):
    positions = scale * np.array([[0, 0, 0], [1, 0.1, -0.3], [0.4 * height, 0.8 * height, 0.6 * height]])
    faces = wp.array([[0, 1, 2]], dtype=wp.vec3i, device=device)
    stage = stability.Stage(lambda p: vertex_normals(p, faces), normals_twin, (wp.vec3,))
    errors = stability.measure(stage, (positions,), lambda rng: (scale * height * rng.normal(size=(3, 3)),), device)
    assert errors.is_finite
    assert errors.value < 1e-6
    assert errors.gradient < 1e-4


@settings(max_examples=60, deadline=None)
@given(positions=vectors(6))
def test_any_finite_positions_give_finite_normals_and_gradients(positions):
    faces = wp.array([[0, 1, 2], [0, 2, 3], [3, 2, 4], [5, 5, 1]], dtype=wp.vec3i)
    values, gradients = backward(lambda p: vertex_normals(p, faces), put(positions, wp.vec3))
    assert_finite(values, gradients)
    lengths = np.linalg.norm(values, axis=-1)
    assert ((lengths == 0) | (np.abs(lengths - 1) < 1e-6)).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_normals_of_positions_that_are_not_finite_or_too_large_are_refused(value, device):
    positions = put(np.eye(3), wp.vec3, device)
    spoil(positions, value)
    with pytest.raises(ValueError, match="^positions: got 1 "):
        vertex_normals(positions, wp.array([[0, 1, 2]], dtype=wp.vec3i, device=device))


# ------------------------------------------------------------------------------------------ optimization


@pytest.mark.parametrize("rate", [1e-2, 1e3, 1e8])
@pytest.mark.parametrize("method", ["directional", *LOGS])
def test_adam_of_any_learning_rate_meets_no_nan(method, rate, device):
    losses = stability.descend(method, rate, 10, device)
    assert np.isfinite(losses).all()
    if rate < 1:
        assert losses[-1] < 0.95 * losses[0]


@pytest.mark.parametrize("method", ["directional", *LOGS])
def test_what_leaves_the_range_of_floats_stops_by_the_name_of_the_first_such_array(method, device):
    for rate in (1e30, np.inf, np.nan):
        with pytest.raises(ValueError, match="^parameters: got 21 (values out of range|NaN or Inf values)"):
            stability.descend(method, rate, 10, device)
