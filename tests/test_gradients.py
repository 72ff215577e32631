"""Each adjoint written by hand, under the tape, against central differences of the float64 twin."""

import numpy as np
import pytest
import twins
import warp as wp

from warpshadow.maths import directions as cells
from warpshadow.maths import sh
from warpshadow.stages.transfer import directional_transfer, sh_transfer
from warpshadow.stages.visibility import directional, exponential, log_sh
from warpshadow.stages.visibility.sharp_cells import blend_sharp_cells

# Relative L2 of a whole gradient: float32 kernels against float64 differences. Measured 3e-6 to 2e-4.
ADJOINT = 1e-3
# The table of `eigen` rounds the corners where an eigenvalue meets its floor. Measured 1e-3 to 6e-3.
EIGEN_CORNERS = 2e-2


pytestmark = pytest.mark.filterwarnings("ignore:log-SH visibility")


def differences(function, arguments, weights, step=1e-6):
    """Central differences of Σ weights · function, for each argument, float64."""
    gradients = []
    for argument in arguments:
        gradient = np.zeros_like(argument)
        for index in np.ndindex(argument.shape):
            kept = argument[index]
            ends = []
            for sign in (1, -1):
                argument[index] = kept + sign * step
                ends.append(np.sum(weights * function(*arguments)))
            argument[index] = kept
            gradient[index] = (ends[0] - ends[1]) / (2 * step)
        gradients.append(gradient)
    return gradients


def tape_gradients(function, arguments, weights, device):
    """The same from the library: arguments [vertex or sphere, 3 or none] become arrays of one instance."""
    arrays = [
        wp.array(
            argument[None].astype(np.float32),
            dtype=wp.vec3 if argument.ndim == 2 and argument.shape[1] == 3 else wp.float32,
            device=device,
            requires_grad=True,
        )
        for argument in arguments
    ]
    with wp.Tape() as tape:
        result = function(*arrays)
    result.grad.assign(weights[None].astype(np.float32))
    tape.backward()
    return [array.grad.numpy()[0] for array in arrays]


def check(function, twin, arguments, device, tolerance=ADJOINT, seed=0):
    arguments = [np.asarray(argument, np.float64) for argument in arguments]
    weights = np.random.default_rng(seed).normal(size=np.shape(twin(*arguments)))
    expected = differences(twin, arguments, weights)
    for got, wanted in zip(tape_gradients(function, arguments, weights, device), expected, strict=True):
        assert np.isfinite(got).all()
        assert np.linalg.norm(got - wanted) < tolerance * np.linalg.norm(wanted)


@pytest.fixture
def scene():
    """Five receivers, seven spheres; a receiver within the blend at a surface, one inside, one where a sphere fades."""
    points, normals, centers, radii = twins.random_scene(3, vertex_count=19, sphere_count=7)
    up = np.float32([0.6, 0.8, 0])
    points[0] = centers[0] + 1.004 * radii[0] * up
    points[1] = centers[1] + 0.7 * radii[1] * up
    points[2] = centers[2] + 0.15 * radii[2] * up
    points[3] = centers[3] + 300 * radii[3] * up
    return points, normals, centers, radii


@pytest.mark.parametrize("softness", [0.35, 1.2])
def test_the_adjoint_of_transmittance_is_that_of_its_twin(softness, scene, device):
    points, _, centers, radii = scene
    directions = cells.fibonacci(32)
    check(
        lambda p, c, r: directional.transmittance(p, None, c, r, directions, softness=softness),
        lambda p, c, r: twins.transmittance(p, c, r, directions, softness),
        (points, centers, radii),
        device,
    )


def test_the_adjoint_past_narrow_cells_is_that_of_the_twin(scene, device):
    points, _, centers, radii = scene
    directions, places = cells.fibonacci(32), np.full(32, -1)
    places[[4, 17]] = 3, 11
    shares = np.where(np.arange(32) < 8, 0.6, 1.0)
    sharp, is_narrow = cells.fibonacci(64)[:16], places >= 0

    def twin(*given):
        passing = twins.transmittance(*given, directions)
        passing[:, is_narrow] *= 1 - shares[is_narrow]
        passing[:, is_narrow] += shares[is_narrow] * twins.transmittance(*given, sharp, 0.2)[:, places[is_narrow]]
        return passing

    def narrowed(points, *spheres):
        passing = directional.transmittance(points, None, *spheres, directions)
        narrow = directional.transmittance(points, None, *spheres, sharp, softness=0.2)
        return blend_sharp_cells(passing, narrow, places, shares)

    check(narrowed, twin, (points, centers, radii), device)


@pytest.mark.slow
@pytest.mark.parametrize("order, log", [(2, "cap"), (5, "cap"), (8, "cap"), (5, "eigen"), (8, "eigen")])
def test_the_adjoint_of_accumulation_is_that_of_its_twin(order, log, scene, device):
    check(
        lambda p, n, c, r: log_sh.accumulate(p, n, c, r, order=order, log=log),
        lambda p, n, c, r: twins.log_sh(p, n, c, r, order, log),
        scene,
        device,
        EIGEN_CORNERS if log == "eigen" else ADJOINT,
    )


def test_the_adjoint_of_accumulation_without_a_horizon_is_that_of_its_twin(scene, device):
    points, _, centers, radii = scene
    check(
        lambda p, c, r: log_sh.accumulate(p, None, c, r, order=4, log="cap"),
        lambda p, c, r: twins.log_sh(p, None, c, r, 4, "cap"),
        (points, centers, radii),
        device,
    )


@pytest.mark.parametrize("order, base", [(2, "quadratic"), (5, "linear"), (4, "quadratic"), (5, "quadratic")])
@pytest.mark.parametrize("size", [0.1, 0.6, 2.2, 3.0, 20.0])
def test_the_adjoint_of_the_exponential_is_that_of_its_twin(order, base, size, device):
    rows = np.random.default_rng(order).normal(size=(3, order**2))
    rows[:, 0] = -np.abs(rows[:, 0])
    rows *= size / np.linalg.norm(rows, axis=1, keepdims=True)
    threshold = exponential.THRESHOLDS[base].default
    check(
        lambda f: exponential.exponentiate(f, base=base),
        lambda f: twins.exponential(f, base, threshold),
        (rows,),
        device,
    )


def test_the_adjoint_of_the_optimal_linear_exponential_is_its_own_difference(device):
    """The twin interpolates another table, so the float32 function itself is differenced, over wide steps."""
    rows = np.random.default_rng(0).normal(size=(40, 16))
    rows *= 1.5 / np.linalg.norm(rows, axis=1, keepdims=True)
    toward = np.random.default_rng(1).normal(size=rows.shape)
    weights = np.random.default_rng(2).normal(size=rows.shape)

    def function(f):
        return exponential.exponentiate(f, base="optimal_linear", threshold=2.0)

    def value(step):
        array = wp.array((rows + step * toward)[None].astype(np.float32), device=device)
        return np.sum(weights * function(array).numpy()[0].astype(np.float64))

    (gradient,) = tape_gradients(function, [rows], weights, device)
    difference = (value(0.01) - value(-0.01)) / 0.02
    assert abs(np.sum(gradient * toward) - difference) < 1e-2 * abs(difference)


@pytest.mark.parametrize("order", [2, 5, 8])
def test_the_adjoint_of_sh_transfer_is_that_of_the_product(order, device):
    rng = np.random.default_rng(order)
    normals = rng.normal(size=(4, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    zonal = sh.clamped_cosine(order) / np.pi

    def twin(visibility, normals):
        # the kernel's polynomials extend off the unit sphere, so differences are taken of unit normals
        unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        return twins.Product(order)(visibility, twins.turned(zonal, unit))

    visibility = rng.normal(size=(4, order**2))
    weights = rng.normal(size=(4, order**2))
    expected = differences(twin, [visibility, normals], weights)
    got = tape_gradients(lambda v, n: sh_transfer(v, n, order=order), [visibility, normals], weights, device)
    got[1] = got[1] - np.sum(got[1] * normals, axis=1, keepdims=True) * normals  # the tangential part
    for ours, wanted in zip(got, expected, strict=True):
        assert np.linalg.norm(ours - wanted) < ADJOINT * np.linalg.norm(wanted)


def test_the_adjoint_of_directional_transfer_is_that_of_its_twin(device):
    directions = cells.fibonacci(48)
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(5, 3))
    check(
        lambda t, n: directional_transfer(t, n, directions),
        lambda t, n: t * np.maximum(n @ directions.T, 0) * 4 / len(directions),
        (rng.random((5, 48)), normals),
        device,
    )


def test_a_tape_played_back_twice_gives_the_same_gradient(scene, device):
    points, normals, centers, radii = (
        wp.array(a[None], dtype=wp.vec3 if a.ndim == 2 else wp.float32, device=device) for a in scene
    )
    for array in (points, centers, radii):
        array.requires_grad = True
    with wp.Tape() as tape:
        log = log_sh.accumulate(points, normals, centers, radii, order=4)
        result = sh_transfer(exponential.exponentiate(log), normals, order=4)
    gradients = []
    for _ in range(2):
        result.grad.fill_(1.0)
        tape.backward()
        gradients.append([array.grad.numpy().copy() for array in (points, centers, radii)])
        tape.zero()
    for first, second in zip(*gradients, strict=True):
        np.testing.assert_array_equal(first, second)


def test_only_what_requires_a_gradient_gets_one(scene, device):
    arrays = [wp.array(a[None], dtype=wp.vec3 if a.ndim == 2 else wp.float32, device=device) for a in scene]
    points, normals, centers, radii = arrays
    radii.requires_grad = True
    with wp.Tape() as tape:
        result = directional.transmittance(points, normals, centers, radii, cells.fibonacci(32))
    result.grad.fill_(1.0)
    tape.backward()
    assert np.abs(radii.grad.numpy()).max() > 0
    assert points.grad is None and centers.grad is None
