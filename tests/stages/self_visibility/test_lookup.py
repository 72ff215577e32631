"""Lookups of a turned body: against a twin in NumPy, smooth in the rotation, with its gradient."""

import numpy as np
import pytest
import warp as wp

from warpshadow.device.tape import recorded
from warpshadow.maths.directions import cell_radius, fibonacci
from warpshadow.stages.self_visibility.lookup import find_body_kernels, find_resampling_weights
from warpshadow.stages.self_visibility.trace import RAYS_PER_CELL

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

RAYS, CELLS = 4096, 64
# Heights are differences of cosines over 1 − cos h, which may be 0.005.
FLOAT32 = 2e-4
# Slopes of weights, as a part of the largest.
GRADIENT = 2e-3
STEP = 1e-5


def rotations_of(count: int, seed: int = 0) -> np.ndarray:
    matrices = np.linalg.qr(np.random.default_rng(seed).normal(size=(count, 1, 3, 3)))[0]
    return matrices * np.sign(np.linalg.det(matrices))[..., None, None]


def spreads() -> np.ndarray:
    """Suns, and light of all widths up to even cells."""
    return np.linspace(0, 1.2 * cell_radius(CELLS), CELLS)


def twin(rotation: np.ndarray, directions: np.ndarray, uses_rays: np.ndarray, cos_radii: np.ndarray) -> np.ndarray:
    """Weights [direction, ray or coarse cell] in float64."""
    rays = fibonacci(RAYS)
    cells = rays.reshape(-1, RAYS_PER_CELL, 3).mean(axis=1)
    cells /= np.linalg.norm(cells, axis=1, keepdims=True)
    cells = np.concatenate([cells, np.full((RAYS - len(cells), 3), np.nan)])
    candidates = np.where(uses_rays[:, None, None], rays, cells)
    towards = directions @ rotation
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    heights = (np.einsum("qcx,qx->qc", candidates, towards) - cos_radii[:, None]) / (1 - cos_radii[:, None])
    heights = np.where(heights > 0, heights, 0)
    return heights**2 / (heights**2).sum(axis=1, keepdims=True)


def dense(lookup) -> np.ndarray:
    """Weights [batch, direction, ray or coarse cell]."""
    counts, indices, weights = (array.numpy()[:, 0] for array in lookup)
    found = np.zeros((*counts.shape, RAYS))
    batch, direction, k = np.nonzero(np.arange(weights.shape[2]) < counts[..., None])
    found[batch, direction, indices[batch, direction, k]] = weights[batch, direction, k]
    return found


def looked_up(matrices: np.ndarray, device, requires_grad=False):
    directions = fibonacci(CELLS)
    body_kernels = find_body_kernels((0,), (RAYS,), directions, spreads(), wp.get_device(device))
    (kernels,) = body_kernels.kernels
    rotations = wp.array(matrices, dtype=wp.mat33, device=device, requires_grad=requires_grad)
    described = directions, kernels.uses_rays.numpy() == 1, kernels.cos_radii.numpy().astype(np.float64)
    return rotations, find_resampling_weights(rotations, body_kernels), kernels, described


def test_weights_are_those_of_the_formula(device):
    matrices = rotations_of(3)
    _, lookup, _, described = looked_up(matrices, device)
    assert described[1].any() and not described[1].all()
    expected = np.stack([twin(matrix, *described) for matrix in matrices[:, 0]])
    assert np.abs(dense(lookup) - expected).max() < FLOAT32
    np.testing.assert_allclose(lookup.weights.numpy().sum(axis=3), 1, atol=1e-5)


def test_there_is_room_for_what_any_rotation_looks_up(device):
    _, lookup, kernels, _ = looked_up(rotations_of(300, seed=1), device)
    counts = lookup.counts.numpy()
    assert counts.min() >= 2 and counts.max() < kernels.max_lookups


def test_light_of_a_narrow_cell_looks_at_few_rays_and_that_of_an_even_one_at_coarse_cells(device):
    _, lookup, _, (_, uses_rays, cos_radii) = looked_up(rotations_of(20), device)
    angles = np.arccos(cos_radii)
    assert uses_rays[0] and angles[0] < 2.5 * cell_radius(RAYS)
    assert not uses_rays[-1]
    assert 3 < lookup.counts.numpy().mean() < 24


@pytest.mark.parametrize("is_rotation", [True, False])
def test_gradients_to_rotations_are_central_differences(is_rotation, device, verified_tape):
    """Also of matrices that are rotations nearly, as a step in all nine numbers leaves them."""
    rng = np.random.default_rng(2)
    matrices = rotations_of(2) + (0 if is_rotation else 0.01) * rng.normal(size=(2, 1, 3, 3))
    with recorded() as tape:
        rotations, lookup, _, described = looked_up(matrices, device, requires_grad=True)
    values = rng.normal(size=(2, CELLS, RAYS))
    batch, _, direction = np.indices(lookup.counts.shape)
    seeds = values[batch[..., None], direction[..., None], lookup.indices.numpy()]
    tape.backward(grads={lookup.weights: wp.array(seeds, dtype=wp.float32, device=device)})
    gradient = rotations.grad.numpy()[:, 0]
    expected = np.zeros((2, 3, 3))
    for place in np.ndindex(2, 3, 3):
        step = np.zeros((2, 3, 3))
        step[place] = STEP
        for sign in (1, -1):
            moved = twin((matrices[:, 0] + sign * step)[place[0]], *described)
            expected[place] += sign * (values[place[0]] * moved).sum() / (2 * STEP)
    assert np.abs(gradient - expected).max() < GRADIENT * np.abs(expected).max()
