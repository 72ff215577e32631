"""Own lobes: projected, turned, and multiplied, against NumPy in float64, with their gradients."""

import numpy as np
import pytest
import twins
import warp as wp

from warpshadow.device.tape import recorded
from warpshadow.maths import sh
from warpshadow.maths.directions import fibonacci
from warpshadow.stages.light.transfer import sh_product
from warpshadow.stages.self_visibility.probes import ProbeWeights
from warpshadow.stages.self_visibility.self_transfer import find_body_rotation, find_self_transfer, project_rows
from warpshadow.stages.self_visibility.trace import VisibilityRows

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

BATCH, RECEIVERS, ROWS = 2, 19, 7
FLOAT32 = 5e-6
# Slopes, as a part of the largest.
GRADIENT = 1e-4
STEP = 1e-5


def rotations_of(count: int) -> np.ndarray:
    matrices = np.linalg.qr(np.random.default_rng(0).normal(size=(count, 2, 3, 3)))[0]
    return matrices * np.sign(np.linalg.det(matrices))[..., None, None]


def turned_on(matrix: np.ndarray, delta: np.ndarray) -> np.ndarray:
    """A rotation, turned on by an angle |δ| about δ."""
    x, y, z = delta
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return (np.eye(3) + skew + skew @ skew / 2 + skew @ skew @ skew / 6) @ matrix


def spun(order: int, lobes: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Coefficients of f(Rᵀω), by evaluating f."""
    directions, weights = twins.sphere_quadrature(2 * order)
    values = lobes @ twins.harmonics(order, directions @ rotation).T
    return (values * weights) @ twins.harmonics(order, directions)


class Case:
    """Random lobes, half of the receivers at vertices."""

    def __init__(self, order, device, requires_grad=False):
        rng = np.random.default_rng(order)
        self.lobes = rng.normal(size=(ROWS, order**2))
        self.numbers = rng.integers(0, ROWS, (BATCH, RECEIVERS, 3))
        self.weights = rng.dirichlet([1, 1, 1], (BATCH, RECEIVERS))
        self.numbers[:, ::2] = self.numbers[:, ::2, :1]
        self.weights[:, ::2] = (1, 0, 0)
        self.rotations = rotations_of(BATCH)
        self.on_device = wp.array(self.rotations, dtype=wp.mat33, device=device, requires_grad=requires_grad)
        self.places = ProbeWeights(
            wp.array(self.numbers, dtype=wp.vec3i, device=device),
            wp.array(self.weights, dtype=wp.vec3, device=device, requires_grad=requires_grad),
        )
        self.order, self.rows = order, wp.array(self.lobes, dtype=wp.float32, device=device)

    def found(self, bands=None) -> wp.array:
        turned = find_body_rotation(self.on_device, 1, self.order)
        return find_self_transfer(self.rows, self.places, turned, order=self.order, bands=bands)

    def expected(self, rotations: np.ndarray) -> np.ndarray:
        own = np.einsum("brj,brjk->brk", self.weights, self.lobes[self.numbers])
        return np.stack([spun(self.order, own[b], rotations[b, 1]) for b in range(BATCH)])


def test_lobes_of_rows_are_cosines_where_rays_escape(device):
    rng = np.random.default_rng(0)
    rays, order = fibonacci(1024), 5
    normals = rng.normal(size=(4, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[3] = 0
    is_open = rng.integers(0, 2, (4, 1024)).astype(np.uint8)
    is_open[0] = 1
    words = np.packbits(is_open, axis=1, bitorder="little").view(np.uint32)
    rows = VisibilityRows(wp.array(words, device=device), wp.zeros((4, 128), dtype=wp.uint8, device=device))
    got = project_rows(rows, normals, order).numpy()
    node, weight = np.polynomial.legendre.leggauss(40)
    z = (node + 1) / 2
    whole = twins.turned((weight * z) @ twins.zonal_values(order, z), normals[:1])
    np.testing.assert_allclose(got[:1], whole, atol=FLOAT32)
    sums = (is_open * np.maximum(normals @ rays.T, 0)) @ twins.harmonics(order, rays) * (4 / 1024)
    np.testing.assert_allclose(got[:3], sums[:3], atol=3e-3)  # the twin sums open rays, too
    assert not got[3].any()


@pytest.mark.parametrize(("order", "bands"), [(2, 1), (4, 4), (8, 8), (8, 3)])
def test_lobes_are_turned_as_functions_are(order, bands, device):
    case = Case(order, device)
    expected = case.expected(case.rotations)[..., : bands**2]
    np.testing.assert_allclose(case.found(bands).numpy(), expected, atol=FLOAT32)


@pytest.mark.parametrize(("order", "bands"), [(2, 1), (4, 4), (8, 3)])
def test_gradients_to_rotations_and_places_are_central_differences(order, bands, device, verified_tape):
    case = Case(order, device, requires_grad=True)
    with recorded() as tape:
        found = case.found(bands)
    seeds = np.random.default_rng(1).normal(size=found.shape).astype(np.float32)
    tape.backward(grads={found: wp.array(seeds, device=device)})
    adjoint, slopes, expected = case.on_device.grad.numpy(), np.zeros((BATCH, 2, 3)), np.zeros((BATCH, 2, 3))
    for batch, body, axis in np.ndindex(BATCH, 2, 3):
        ends = []
        for sign in (1, -1):
            turned = case.rotations.copy()
            turned[batch, body] = turned_on(case.rotations[batch, body], sign * STEP * np.eye(3)[axis])
            ends.append((turned, (seeds * case.expected(turned)[..., : bands**2]).sum()))
        expected[batch, body, axis] = (ends[0][1] - ends[1][1]) / (2 * STEP)
        slopes[batch, body, axis] = (adjoint * (ends[0][0] - ends[1][0])).sum() / (2 * STEP)
    assert np.abs(slopes - expected).max() <= GRADIENT * max(np.abs(expected).max(), 1)
    assert not slopes[:, 0].any()
    each = np.stack([spun(order, case.lobes, case.rotations[b, 1]) for b in range(BATCH)])[..., : bands**2]
    shares = np.einsum("brk,brjk->brj", seeds, np.stack([each[b][case.numbers[b]] for b in range(BATCH)]))
    np.testing.assert_allclose(case.places.weights.grad.numpy(), shares, atol=GRADIENT * np.abs(shares).max())


def test_one_rotation_serves_all_places_and_one_place_all_rotations(device):
    case = Case(4, device)
    both = case.found().numpy()
    case.places = ProbeWeights(*(array[:1].contiguous() for array in case.places))
    np.testing.assert_array_equal(case.found().numpy()[0], both[0])
    assert case.found().shape == both.shape
    case = Case(4, device)
    case.on_device = case.on_device[:1].contiguous()
    np.testing.assert_array_equal(case.found().numpy()[0], both[0])
    assert case.found().shape == both.shape


@pytest.mark.parametrize(("order", "bands"), [(4, 4), (8, 8), (8, 3)])
def test_products_are_those_of_harmonics_with_their_gradients(order, bands, device, verified_tape):
    rng = np.random.default_rng(order)
    values = rng.normal(size=(2, BATCH, RECEIVERS, order**2)).astype(np.float32)
    factors = [wp.array(each, device=device, requires_grad=True) for each in values]
    with recorded() as tape:
        product = sh_product(*factors, order=order, bands=bands)
    multiplied = twins.Product(order)
    expected = multiplied(*values.astype(float))[..., : bands**2]
    np.testing.assert_allclose(product.numpy(), expected, atol=2e-6 * np.abs(expected).max())
    seeds = np.zeros(values.shape[1:])
    seeds[..., : bands**2] = rng.normal(size=expected.shape)
    given = np.ascontiguousarray(seeds[..., : bands**2], np.float32)
    tape.backward(grads={product: wp.array(given, device=device)})
    for factor, other in zip(factors, values[::-1], strict=True):
        slopes = multiplied(other.astype(float), seeds)
        np.testing.assert_allclose(factor.grad.numpy(), slopes, atol=2e-6 * np.abs(slopes).max())


def test_generators_are_slopes_of_rotations():
    generators = sh.rotation_generators(5)
    for axis in range(3):
        ends = [sh.harmonic_rotation(5, turned_on(np.eye(3), sign * STEP * np.eye(3)[axis])) for sign in (1, -1)]
        np.testing.assert_allclose(generators[axis], (ends[0] - ends[1]) / (2 * STEP), atol=1e-7)
