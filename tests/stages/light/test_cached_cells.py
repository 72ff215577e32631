"""Kept visibility of static bodies, combined with that of what moves, against NumPy."""

import numpy as np
import pytest
import warp as wp

from warpshadow.device.tape import recorded
from warpshadow.maths.directions import CHUNK
from warpshadow.stages.light.cached_cells import CachedRows, add_rows, cell_transfer, shade_cached_cells

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

BATCH, RECEIVERS, ROWS, CELLS = 2, 5, 3, 2 * CHUNK
INDEX = np.array([2, 0, 1, 1, 2])  # receivers share rows
FLOAT32 = 1e-5


def uniform(*shape, seed=0):
    return np.random.default_rng(seed).uniform(size=shape).astype(np.float32)


def cached_rows(channels, device):
    values = uniform(ROWS, channels, CELLS, seed=1)
    return CachedRows(wp.array(values, device=device), wp.array(INDEX, dtype=wp.int32, device=device)), values[INDEX]


def transmittance_of(device, requires_grad=True):
    values = uniform(BATCH, RECEIVERS, CELLS)
    return wp.array(values, device=device, requires_grad=requires_grad), values


def gradient_of(transmittance, tape, result, weights):
    tape.backward(grads={result: wp.array(weights, dtype=result.dtype, device=result.device)})
    return transmittance.grad.numpy()


def test_shading_is_the_sum_of_kept_light_over_what_is_let_through(device, verified_tape):
    cached, light = cached_rows(3, device)
    transmittance, values = transmittance_of(device)
    with recorded() as tape:
        shading = shade_cached_cells(transmittance, cached)
    np.testing.assert_allclose(shading.numpy(), np.einsum("brq,rcq->brc", values, light), rtol=FLOAT32)
    weights = uniform(BATCH, RECEIVERS, 3, seed=2)
    expected = np.einsum("brc,rcq->brq", weights, light)
    np.testing.assert_allclose(gradient_of(transmittance, tape, shading, weights), expected, rtol=FLOAT32)


def test_transfer_is_the_product_cell_by_cell(device, verified_tape):
    cached, light = cached_rows(1, device)
    transmittance, values = transmittance_of(device)
    with recorded() as tape:
        transfer = cell_transfer(transmittance, cached)
    np.testing.assert_allclose(transfer.numpy(), values * light[:, 0], rtol=FLOAT32)
    weights = uniform(BATCH, RECEIVERS, CELLS, seed=2)
    np.testing.assert_allclose(gradient_of(transmittance, tape, transfer, weights), weights * light[:, 0], rtol=FLOAT32)


def test_a_tape_that_is_played_back_again_adds_to_the_gradient(device):
    cached, _ = cached_rows(3, device)
    transmittance, _ = transmittance_of(device)
    with recorded() as tape:
        shading = shade_cached_cells(transmittance, cached)
    weights = uniform(BATCH, RECEIVERS, 3, seed=2)
    once = gradient_of(transmittance, tape, shading, weights).copy()
    np.testing.assert_allclose(gradient_of(transmittance, tape, shading, weights), 2 * once, rtol=FLOAT32)


@pytest.mark.parametrize(("combine", "channels"), [(shade_cached_cells, 3), (cell_transfer, 1)])
def test_nothing_is_recorded_without_a_gradient_to_find(combine, channels, device):
    with recorded() as tape:
        result = combine(transmittance_of(device, requires_grad=False)[0], cached_rows(channels, device)[0])
    assert not tape.launches and not result.requires_grad


def test_rows_are_added_to_the_sums_of_the_receivers_that_have_them(device):
    cached, rows = cached_rows(1, device)
    sums, values = transmittance_of(device)
    with recorded() as tape:
        add_rows(cached, sums)
    np.testing.assert_allclose(sums.numpy(), values + rows[:, 0], rtol=FLOAT32)
    assert not tape.launches
