"""What receivers see past their own body: sums over lookups and rows, against NumPy, with their gradients."""

import numpy as np
import pytest
import warp as wp

from warpshadow.device.tape import recorded
from warpshadow.maths.directions import fibonacci
from warpshadow.stages.receivers.body_spans import Span
from warpshadow.stages.self_visibility.gather import BodyTables, gather_self_transmittance, multiply_transmittances
from warpshadow.stages.self_visibility.lookup import find_body_kernels, find_resampling_weights
from warpshadow.stages.self_visibility.probes import ProbeWeights
from warpshadow.stages.self_visibility.trace import VisibilityRows

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

BATCH, RECEIVERS, ROWS, RAYS, CELLS = 2, 20, 7, 4096, 32
FLOAT32 = 2e-6
GRADIENT = 2e-5


class Case:
    """Random rows, half of the receivers at vertices."""

    def __init__(self, device, requires_grad=False):
        rng = np.random.default_rng(0)
        self.bits = rng.integers(0, 2, (ROWS, RAYS))
        cells = rng.integers(0, 256, (ROWS, RAYS // 8)).astype(np.uint8)
        self.shares = cells / 255
        words = np.packbits(self.bits.astype(np.uint8), axis=1, bitorder="little").view(np.uint32)
        self.tables = BodyTables.of_rows(
            [VisibilityRows(wp.array(words, device=device), wp.array(cells, device=device))]
        )
        numbers = rng.integers(0, ROWS, (BATCH, RECEIVERS, 3))
        weights = rng.dirichlet([1, 1, 1], (BATCH, RECEIVERS)).astype(np.float32)
        numbers[:, ::2] = numbers[:, ::2, :1]
        weights[:, ::2] = (1, 0, 0)
        self.numbers, self.weights = numbers, weights
        self.places = ProbeWeights(
            wp.array(numbers, dtype=wp.vec3i, device=device),
            wp.array(weights, dtype=wp.vec3, device=device, requires_grad=requires_grad),
        )
        normals = rng.normal(size=(BATCH, RECEIVERS, 3))
        self.directions = fibonacci(CELLS)
        normals /= np.linalg.norm(normals, axis=2, keepdims=True)
        self.is_up = normals @ self.directions.T > 0
        self.normals = wp.array(normals, dtype=wp.vec3, device=device)
        spreads = np.where(np.arange(CELLS) % 2, 0.05, 1.0)
        self.kernels = find_body_kernels((0,), (RAYS,), self.directions, spreads, wp.get_device(device))
        matrices = np.linalg.qr(rng.normal(size=(BATCH, 1, 3, 3)))[0]
        matrices *= np.sign(np.linalg.det(matrices))[..., None, None]
        rotations = wp.array(matrices, dtype=wp.mat33, device=device)
        self.lookup = find_resampling_weights(rotations, self.kernels)
        self.lookup.weights.requires_grad = requires_grad

    def of_rows(self) -> np.ndarray:
        """S of each row, [batch, receiver, direction, lookup, corner]."""
        indices = self.lookup.indices.numpy()[:, 0]
        of_rays = self.kernels.kernels[0].uses_rays.numpy() == 1
        assert of_rays.any() and not of_rays.all()
        row = self.numbers[:, :, None, None, :]
        index = indices[:, None, :, :, None]
        coarse = self.shares[row, np.minimum(index, RAYS // 8 - 1)]
        return np.where(of_rays[:, None, None], self.bits[row, index], coarse)


def test_own_transmittance_is_the_sum_over_lookups_and_rows(device):
    case = Case(device)
    own = gather_self_transmittance(case.normals, case.places, case.lookup, case.kernels, case.tables).numpy()
    sums = np.einsum("brqkj,bqk,brj->brq", case.of_rows(), case.lookup.weights.numpy()[:, 0], case.weights)
    np.testing.assert_allclose(own, np.where(case.is_up, sums, 1), atol=FLOAT32)
    assert own.min() >= 0 and own.max() <= 1 + FLOAT32


def test_gradients_to_lookups_and_places_are_those_of_the_sum(device, verified_tape):
    case = Case(device, requires_grad=True)
    with recorded() as tape:
        own = gather_self_transmittance(case.normals, case.places, case.lookup, case.kernels, case.tables)
    seeds = np.random.default_rng(1).normal(size=own.shape).astype(np.float32)
    tape.backward(grads={own: wp.array(seeds, device=device)})
    pulls = seeds * case.is_up
    expected = np.einsum("brqkj,brq,brj->bqk", case.of_rows(), pulls, case.weights)
    is_looked_up = np.arange(expected.shape[2]) < case.lookup.counts.numpy()[:, 0, :, None]
    gaps = np.abs(case.lookup.weights.grad.numpy()[:, 0] - expected)[is_looked_up]
    assert gaps.max() < GRADIENT * np.abs(expected).max()
    expected = np.einsum("brqkj,brq,bqk->brj", case.of_rows(), pulls, case.lookup.weights.numpy()[:, 0])[:, 1::2]
    gaps = np.abs(case.places.weights.grad.numpy()[:, 1::2] - expected)
    assert gaps.max() < GRADIENT * np.abs(expected).max()


def test_one_place_serves_all_rotations(device):
    case = Case(device)
    one = ProbeWeights(case.places.rows[:1].contiguous(), case.places.weights[:1].contiguous())
    got = gather_self_transmittance(case.normals[:1].contiguous(), one, case.lookup, case.kernels, case.tables).numpy()
    both = gather_self_transmittance(case.normals, case.places, case.lookup, case.kernels, case.tables).numpy()
    assert got.shape == both.shape
    np.testing.assert_array_equal(got[0], both[0])


@pytest.mark.parametrize("requires_grad", [False, True])
def test_bodies_together_are_as_each_alone(requires_grad, device, verified_tape):
    """Two bodies of other rotations, rows and rays; the first has receivers on both sides of the second's."""
    rng, spans, table_of_span = np.random.default_rng(4), (Span(3, 0, 7), Span(5, 7, 17), Span(3, 17, 20)), (0, 1, 0)
    case, ray_counts = Case(device), (RAYS, RAYS // 2)
    rows = [
        VisibilityRows(
            wp.array(rng.integers(0, 2**32, (ROWS, count // 32), dtype=np.uint32), device=device),
            wp.array(rng.integers(0, 256, (ROWS, count // 8), dtype=np.uint8), device=device),
        )
        for count in ray_counts
    ]
    matrices = np.linalg.qr(rng.normal(size=(BATCH, 6, 3, 3)))[0]
    matrices *= np.sign(np.linalg.det(matrices))[..., None, None]
    seeds = rng.normal(size=(BATCH, RECEIVERS, CELLS)).astype(np.float32)

    def gathered(bodies, of_bodies, first, end, **places):
        """Transmittance, and gradients to rotations and to weights of probes."""
        rotations = wp.array(matrices, dtype=wp.mat33, device=device, requires_grad=requires_grad)
        probes = ProbeWeights(
            wp.array(case.numbers[:, first:end], dtype=wp.vec3i, device=device),
            wp.array(case.weights[:, first:end], dtype=wp.vec3, device=device, requires_grad=requires_grad),
        )
        counts = tuple(ray_counts[table] for table in of_bodies)
        kernels = find_body_kernels(bodies, counts, case.directions, None, wp.get_device(device))
        tables = BodyTables.of_rows([rows[table] for table in of_bodies])
        normals = wp.array(case.normals.numpy()[:, first:end], dtype=wp.vec3, device=device)
        with recorded() as tape:
            lookup = find_resampling_weights(rotations, kernels)
            found = gather_self_transmittance(normals, probes, lookup, kernels, tables, **places)
        if not requires_grad:
            return [found.numpy()]
        tape.backward(grads={found: wp.array(seeds[:, first:end], device=device)})
        return [found.numpy(), probes.weights.grad.numpy(), rotations.grad.numpy()]

    together = gathered((3, 5), (0, 1), 0, RECEIVERS, spans=spans, table_of_span=table_of_span)
    alone = [
        gathered((body,), (table,), *span[1:]) for span, body, table in zip(spans, (3, 5, 3), (0, 1, 0), strict=True)
    ]
    for of_receivers, parts in zip(together[:2], list(zip(*alone, strict=True))[:2], strict=False):
        np.testing.assert_array_equal(of_receivers, np.concatenate(parts, axis=1))
    if requires_grad:
        np.testing.assert_allclose(together[2], sum(part[2] for part in alone), atol=GRADIENT)


def test_a_product_has_the_gradients_of_a_product(device, verified_tape):
    rng = np.random.default_rng(3)
    values = rng.uniform(size=(3, BATCH, RECEIVERS, CELLS)).astype(np.float32)
    own, others = (wp.array(each, device=device, requires_grad=True) for each in values[:2])
    with recorded() as tape:
        product = multiply_transmittances(own, others)
    np.testing.assert_allclose(product.numpy(), values[0] * values[1], rtol=FLOAT32)
    tape.backward(grads={product: wp.array(values[2], device=device)})
    np.testing.assert_allclose(own.grad.numpy(), values[1] * values[2], rtol=FLOAT32)
    np.testing.assert_allclose(others.grad.numpy(), values[0] * values[2], rtol=FLOAT32)
