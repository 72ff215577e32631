"""Shading, the dot product of transfer vectors and light: against NumPy, in batches, and its gradients."""

import numpy as np
import pytest
import twins
import warp as wp

from warpshadow.maths.directions import fibonacci
from warpshadow.stages.light import shading

# Sums of up to 10⁴ float32 products of size 1/100.
FLOAT32 = 5e-6


BATCHES = [(2, 2), (1, 3), (3, 1), (1, 1)]

pytestmark = pytest.mark.usefixtures("poisoned_outputs")


def random_light(device, batches=(2, 2), vertices=7, coefficients=16, requires_grad=False):
    rng = np.random.default_rng(5)
    transfer = rng.normal(size=(batches[0], vertices, coefficients)).astype(np.float32)
    light = rng.normal(size=(batches[1], coefficients, 3)).astype(np.float32)
    return (
        wp.array(transfer, device=device, requires_grad=requires_grad),
        wp.array(light, dtype=wp.vec3, device=device, requires_grad=requires_grad),
    )


@pytest.mark.parametrize("batches", BATCHES)
@pytest.mark.parametrize("coefficients", [4, 16, 25, 64])
def test_shading_is_the_dot_product_of_transfer_and_light(device, coefficients, batches):
    transfer, light = random_light(device, batches, coefficients=coefficients)
    got = shading.shade(transfer, light)
    assert not got.requires_grad
    expected = transfer.numpy().astype(float) @ light.numpy()  # batches of 1 broadcast
    assert np.abs(got.numpy() - expected).max() < FLOAT32 * np.abs(expected).max()


def test_shading_is_linear_in_the_light(device):
    transfer, light = random_light(device)
    other = wp.array(np.roll(light.numpy(), 1, axis=1), dtype=wp.vec3, device=device)
    both = wp.array(2 * light.numpy() - 3 * other.numpy(), dtype=wp.vec3, device=device)
    expected = 2 * shading.shade(transfer, light).numpy() - 3 * shading.shade(transfer, other).numpy()
    assert np.abs(shading.shade(transfer, both).numpy() - expected).max() < 5 * FLOAT32


def test_light_that_does_not_fit_the_transfer_is_refused(device):
    transfer, _ = random_light(device)
    with pytest.raises(ValueError, match=r"light: got shape \(2, 15\), expected \[batch, 16\]"):
        shading.shade(transfer, wp.zeros((2, 15), dtype=wp.vec3, device=device))


def tape_gradients(function, inputs, weights, device):
    """Gradients of Σ weights · function(*inputs) by the tape."""
    with wp.Tape() as tape:
        result = function(*inputs)
    tape.backward(grads={result: wp.array(weights, dtype=wp.vec3, device=device)})
    return [value.grad.numpy().astype(float) for value in inputs]


def test_a_gradient_that_nobody_asks_for_is_not_computed(device):
    transfer, light = random_light(device, requires_grad=True)
    transfer.requires_grad = False
    with wp.Tape() as tape:
        shaded = shading.shade(transfer, light)
    tape.backward(grads={shaded: wp.full(shaded.shape, wp.vec3(1.0), dtype=wp.vec3, device=device)})
    assert transfer.grad is None
    expected = np.repeat(transfer.numpy().sum(axis=1)[..., None], 3, axis=-1)
    assert np.abs(light.grad.numpy() - expected).max() < FLOAT32 * 10


# ---------------------------------------------------------------------------------------------------- known light


def known_light(device, requires_grad=False):
    """Transmittance, normals, directions and light of two instances."""
    rng = np.random.default_rng(7)
    directions = fibonacci(32)
    normals = rng.normal(size=(2, 5, 3))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    return (
        wp.array(rng.uniform(size=(2, 5, 32)), dtype=wp.float32, device=device, requires_grad=requires_grad),
        wp.array(normals, dtype=wp.vec3, device=device, requires_grad=requires_grad),
        directions,
        wp.array(rng.uniform(size=(1, 32, 3)), dtype=wp.vec3, device=device),
    )


def known_light_twin(transmittance, normals, directions, light):
    """The same in float64."""
    return np.stack(
        [twins.directional_transfer(t, n, directions) @ light for t, n in zip(transmittance, normals, strict=True)]
    )


def test_known_light_is_shaded_as_transfer_vectors_shade_it(device):
    transmittance, normals, directions, light = known_light(device)
    got = shading.shade_cells(transmittance, normals, directions, light)
    arrays = [array.numpy().astype(float) for array in (transmittance, normals)]
    expected = known_light_twin(*arrays, directions, light.numpy()[0].astype(float))
    assert not got.requires_grad
    assert np.abs(got.numpy() - expected).max() < FLOAT32 * np.abs(expected).max()


def test_the_gradients_of_known_light_are_those_of_the_twin(device):
    transmittance, normals, directions, light = known_light(device, requires_grad=True)
    weights = np.random.default_rng(8).normal(size=(2, 5, 3))
    got = tape_gradients(
        lambda t, n: shading.shade_cells(t, n, directions, light), [transmittance, normals], weights, device
    )
    given = [array.numpy().astype(float) for array in (transmittance, normals)]
    for number, gradient in enumerate(got):
        expected = np.zeros(gradient.shape)
        for index in np.ndindex(gradient.shape):
            ends = []
            for step in (1e-6, -1e-6):
                moved = [array.copy() for array in given]
                moved[number][index] += step
                ends.append((weights * known_light_twin(*moved, directions, light.numpy()[0].astype(float))).sum())
            expected[index] = (ends[0] - ends[1]) / 2e-6
        assert np.abs(gradient - expected).max() < FLOAT32 * np.abs(expected).max()


def test_known_light_that_does_not_fit_the_cells_is_refused(device):
    transmittance, normals, directions, light = known_light(device)
    with pytest.raises(ValueError, match=r"light: got shape \(1, 16\), expected \[batch, 32\]"):
        shading.shade_cells(transmittance, normals, directions, light[:, :16].contiguous())
