"""Sparse products, colored transfer and radiosity of patches against NumPy, and their gradients."""

import numpy as np
import pytest
import warp as wp

from warpshadow.device.tape import recorded
from warpshadow.stages.bounces.colored import ColoredTransfer, colored_light
from warpshadow.stages.bounces.radiosity import mean_over_patch_samples, patch_radiosity
from warpshadow.stages.sparse import SparseMatrix, multiply

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

FLOAT32 = 1e-5
PATCHES = np.array([0, 0, 0, 1, 3, 3])  # of each patch sample; patch 2 has none
WEIGHTS = np.array([0.2, 0.3, 0.5, 1.0, 0.6, 0.4])


def uniform(*shape, seed=0):
    return np.random.default_rng(seed).uniform(size=shape).astype(np.float32)


def colors(values, device):
    return wp.array(values, dtype=wp.vec3, device=device, requires_grad=True)


def gradients(tape, result, weights, *variables):
    tape.backward(grads={result: wp.array(weights, dtype=wp.vec3, device=result.device)})
    return [variable.grad.numpy() for variable in variables]


@pytest.mark.parametrize("shape", [(7, 5), (300, 200)])
def test_a_sparse_product_and_its_adjoint_are_those_of_the_matrix(shape, device, verified_tape):
    matrix = uniform(*shape) * (uniform(*shape, seed=1) > 0.7)
    values = uniform(2, shape[1], 3, seed=2)
    given = colors(values, device)
    with recorded() as tape:
        product = multiply(SparseMatrix.from_matrix(matrix, device=device), given)
    np.testing.assert_allclose(product.numpy(), matrix @ values, rtol=FLOAT32, atol=FLOAT32)
    weights = uniform(2, shape[0], 3, seed=3)
    (gradient,) = gradients(tape, product, weights, given)
    np.testing.assert_allclose(gradient, matrix.T @ weights, rtol=FLOAT32, atol=FLOAT32)


@pytest.mark.parametrize("given", [(1, 2), (2, 1), (2, 2)])
def test_what_is_added_to_a_product_has_the_gradient_of_the_sum(given, device, verified_tape):
    matrix, values, more = uniform(7, 5), uniform(given[0], 5, 3, seed=1), uniform(given[1], 7, 3, seed=2)
    on_device = colors(values, device), colors(more, device)
    sparse = SparseMatrix.from_matrix(matrix, device=device)
    assert np.array_equal(sparse.to_scipy().toarray(), matrix)
    with recorded() as tape:
        total = multiply(sparse, on_device[0], addend=on_device[1])
    np.testing.assert_allclose(total.numpy(), matrix @ values + more, rtol=FLOAT32)
    weights = uniform(2, 7, 3, seed=3)
    adj_values, adj_more = gradients(tape, total, weights, *on_device)
    for found, passed, count in ((adj_values, matrix.T @ weights, given[0]), (adj_more, weights, given[1])):
        expected = passed if count == 2 else passed.sum(axis=0, keepdims=True)
        np.testing.assert_allclose(found, expected, rtol=FLOAT32)


def test_colored_transfer_lights_each_color_by_itself(device, verified_tape):
    lit, light = uniform(6, 50, 3), uniform(2, 6, 3, seed=1)
    given = colors(light, device)
    with recorded() as tape:
        found = colored_light(ColoredTransfer.from_lit_receivers(lit, device=device), given)
    np.testing.assert_allclose(found.numpy(), np.einsum("kxc,bkc->bxc", lit, light), rtol=FLOAT32)
    weights = uniform(2, 50, 3, seed=2)
    (gradient,) = gradients(tape, found, weights, given)
    np.testing.assert_allclose(gradient, np.einsum("kxc,bxc->bkc", lit, weights), rtol=FLOAT32)


def test_a_matrix_of_zeros_gives_zeros(device):
    product = multiply(SparseMatrix.from_matrix(np.zeros((3, 2)), device=device), colors(uniform(1, 2, 3), device))
    assert np.array_equal(product.numpy(), np.zeros((1, 3, 3)))


@pytest.mark.parametrize(("albedos", "lights"), [(1, 1), (1, 2), (2, 1), (2, 2)])
def test_radiosity_is_albedo_times_the_mean_of_the_patch_samples(albedos, lights, device, verified_tape):
    albedo, light = uniform(albedos, 4, 3, seed=1), uniform(lights, 6, 3, seed=2)
    mean = mean_over_patch_samples(PATCHES, WEIGHTS, 4, device=device)
    on_device = colors(albedo, device), colors(light, device)
    with recorded() as tape:
        radiosity = patch_radiosity(*on_device, mean)
    means = np.stack([(WEIGHTS[:, None] * light * (patch == PATCHES)[:, None]).sum(axis=1) for patch in range(4)], 1)
    np.testing.assert_allclose(radiosity.numpy(), albedo * means, rtol=FLOAT32)
    weights = uniform(max(albedos, lights), 4, 3, seed=3)
    adj_albedo, adj_light = gradients(tape, radiosity, weights, *on_device)
    expected = (weights * means).sum(axis=0, keepdims=True) if albedos == 1 else weights * means
    np.testing.assert_allclose(adj_albedo, expected, rtol=FLOAT32)
    passed = (weights * albedo)[:, PATCHES] * WEIGHTS[:, None]
    expected = passed.sum(axis=0, keepdims=True) if lights == 1 else passed
    np.testing.assert_allclose(adj_light, expected, rtol=FLOAT32)


def test_white_patches_in_unit_light_have_unit_radiosity(device):
    mean = mean_over_patch_samples(PATCHES, WEIGHTS, 4, device=device)
    white = wp.full((1, 4), wp.vec3(1.0), dtype=wp.vec3, device=device)
    lit = wp.full((1, 6), wp.vec3(1.0), dtype=wp.vec3, device=device)
    expected = np.array([1, 1, 0, 1])[:, None] * np.ones(3)
    np.testing.assert_allclose(patch_radiosity(white, lit, mean).numpy()[0], expected, rtol=FLOAT32)
