"""Transfer vectors against NumPy, and what they mean: white under unit light is one."""

import numpy as np
import pytest
import twins
import warp as wp

from warpshadow.maths import directions as cells
from warpshadow.stages.light import transfer as transfer_module
from warpshadow.stages.light.shading import shade
from warpshadow.stages.light.transfer import directional_transfer, sh_transfer
from warpshadow.stages.visibility import directional, exponential, log_sh

# Sums of up to 10⁴ float32 products of size 1/100.
FLOAT32 = 5e-6


pytestmark = pytest.mark.usefixtures("poisoned_outputs")


def unit_vectors(seed, *shape):
    values = np.random.default_rng(seed).normal(size=(*shape, 3))
    return (values / np.linalg.norm(values, axis=-1, keepdims=True)).astype(np.float32)


def clamped_cosines(order, normals):
    """SH of max(n·ω, 0) / π: the twin integrates numerically over z of the upper hemisphere."""
    node, weight = np.polynomial.legendre.leggauss(40)
    z = (node + 1) / 2
    return twins.turned(np.pi * (weight * z) @ twins.zonal_values(order, z) / np.pi, normals.astype(float))


@pytest.mark.slow
@pytest.mark.parametrize(("order", "lanes"), [(2, 16), (4, 1), (8, 16)])
def test_sh_transfer_is_the_product_of_visibility_and_cosine(order, lanes, monkeypatch, device):
    monkeypatch.setattr(transfer_module, "lane_count", lambda _: lanes)
    normals = unit_vectors(order, 2, 19)
    visibility = np.random.default_rng(order).normal(size=(2, 19, order**2)).astype(np.float32)
    got = sh_transfer(
        wp.array(visibility, device=device), wp.array(normals, dtype=wp.vec3, device=device), order=order
    ).numpy()
    expected = twins.Product(order)(visibility, clamped_cosines(order, normals))
    assert np.abs(got - expected).max() < FLOAT32


@pytest.mark.parametrize("order", [2, 8])
def test_unblocked_sh_transfer_is_the_cosine_and_that_of_full_visibility(order, device):
    normals = unit_vectors(1, 1, 33)
    on_device = wp.array(normals, dtype=wp.vec3, device=device)
    free = sh_transfer(None, on_device, order=order).numpy()
    assert np.abs(free - clamped_cosines(order, normals)).max() < FLOAT32
    full = wp.array(np.tile(np.eye(1, order**2) * twins.UNIT, (1, 33, 1)).astype(np.float32), device=device)
    assert np.abs(sh_transfer(full, on_device, order=order).numpy() - free).max() < FLOAT32


@pytest.mark.slow
@pytest.mark.parametrize("is_shadowed", [True, False])
@pytest.mark.parametrize(("order", "bands", "lanes"), [(2, 1, 16), (4, 2, 1), (8, 1, 16), (8, 3, 16), (8, 7, 16)])
def test_transfer_to_few_bands_is_the_start_of_that_to_all(order, bands, lanes, is_shadowed, monkeypatch, device):
    """And its adjoint that of all, where nothing comes from the others."""
    monkeypatch.setattr(transfer_module, "lane_count", lambda _: lanes)
    rng = np.random.default_rng(order)
    values = rng.normal(size=(2, 19, order**2)).astype(np.float32), unit_vectors(order, 2, 19)
    seed = np.zeros((2, 19, order**2), np.float32)
    seed[..., : bands**2] = rng.normal(size=(2, 19, bands**2))
    results = []
    for count in (bands, order):
        visibility = wp.array(values[0], device=device, requires_grad=True) if is_shadowed else None
        normals = wp.array(values[1], dtype=wp.vec3, device=device, requires_grad=True)
        with wp.Tape() as tape:
            transfer = sh_transfer(visibility, normals, order=order, bands=count)
        assert transfer.shape == (2, 19, count**2)
        seeds = np.ascontiguousarray(seed[..., : count**2])
        tape.backward(grads={transfer: wp.array(seeds, device=device)})
        gradients = [variable.grad.numpy() for variable in (visibility, normals) if variable is not None]
        results.append([transfer.numpy()[..., : bands**2], *gradients])
    for got, expected in zip(*results, strict=True):
        assert np.abs(got - expected).max() <= FLOAT32 * max(np.abs(expected).max(), 1)


def test_bands_that_visibility_does_not_have_are_refused(device):
    normals = wp.zeros((1, 5), dtype=wp.vec3, device=device)
    for bands in (0, 5):
        with pytest.raises(ValueError, match=f"bands: got {bands}, expected one of 1, 2, 3, 4"):
            sh_transfer(None, normals, order=4, bands=bands)


@pytest.mark.parametrize("order", [2, 8])
def test_white_under_unit_light_in_sh_is_one(order, device):
    """The white furnace: albedo 1, L = 1, nothing blocked."""
    normals = wp.array(unit_vectors(2, 1, 50), dtype=wp.vec3, device=device)
    light = np.zeros((1, order**2, 3), np.float32)
    light[:, 0] = twins.UNIT
    transfer = sh_transfer(None, normals, order=order)
    got = shade(transfer, wp.array(light, dtype=wp.vec3, device=device)).numpy()
    assert np.abs(got - 1).max() < 1e-5


@pytest.mark.parametrize("count, error", [(64, 0.02), (128, 0.01), (256, 0.005)])
def test_white_under_unit_light_in_cells_is_nearly_one(count, error, device):
    """Cells at the horizon count wholly or not at all; that averages out as 1/Q, 0.9/Q at worst."""
    normals = wp.array(unit_vectors(3, 1, 500), dtype=wp.vec3, device=device)
    everything = wp.ones((1, 500, count), dtype=wp.float32, device=device)
    transfer = directional_transfer(everything, normals, cells.fibonacci(count))
    light = wp.ones((1, count), dtype=wp.vec3, device=device)
    assert np.abs(shade(transfer, light).numpy() - 1).max() < error


def test_directional_transfer_is_transmittance_times_cosine_and_solid_angle(device):
    normals = unit_vectors(4, 2, 19)
    transmittance = np.random.default_rng(4).uniform(size=(2, 19, 48)).astype(np.float32)
    directions = cells.fibonacci(48)
    got = directional_transfer(
        wp.array(transmittance, device=device), wp.array(normals, dtype=wp.vec3, device=device), directions
    ).numpy()
    expected = transmittance * np.maximum(normals @ directions.T, 0) * (4 * np.pi / 48) / np.pi
    assert np.abs(got - expected).max() < 1e-7  # numbers up to 4/48


def test_directional_transfer_of_every_other_receiver_is_that_of_its_copy(device):
    """A view with strides, not a copy."""
    rng = np.random.default_rng(9)
    whole = wp.array(rng.uniform(size=(1, 20, 32)).astype(np.float32), device=device)
    normals = wp.array(unit_vectors(9, 1, 20), dtype=wp.vec3, device=device)
    directions = cells.fibonacci(32)
    expected = directional_transfer(whole, normals, directions).numpy()[:, ::2]
    got = directional_transfer(whole[:, ::2], normals[:, ::2], directions).numpy()
    np.testing.assert_array_equal(got, expected)


def test_transfer_of_mismatched_visibility_is_refused(device):
    normals = wp.zeros((1, 5), dtype=wp.vec3, device=device)
    with pytest.raises(ValueError, match=r"visibility: got shape \(1, 4, 16\), expected \[1, 5, 16\]"):
        sh_transfer(wp.zeros((1, 4, 16), device=device), normals, order=4)
    with pytest.raises(ValueError, match="order: got 9, expected"):
        sh_transfer(None, normals, order=9)
    with pytest.raises(ValueError, match=r"transmittance: got shape \(1, 5, 16\), expected \[1, 5, 32\]"):
        directional_transfer(wp.zeros((1, 5, 16), device=device), normals, cells.fibonacci(32))


def test_a_blocked_receiver_is_darker_by_either_method_and_alike(device):
    """A sphere that fills half of the cosine-weighted sky: sin² θ = 1/2 right above the receiver."""
    points, normals = wp.zeros((1, 1), dtype=wp.vec3, device=device), np.float32([[[0, 1, 0]]])
    normals = wp.array(normals, dtype=wp.vec3, device=device)
    centers = wp.array(np.float32([[[0, np.sqrt(2), 0]]]), dtype=wp.vec3, device=device)
    radii = wp.ones((1, 1), dtype=wp.float32, device=device)
    visibility = exponential.exponentiate(log_sh.accumulate(points, normals, centers, radii, order=8))
    # truncated to 8 bands
    assert abs(sh_transfer(visibility, normals, order=8).numpy()[0, 0, 0] * twins.UNIT - 0.5) < 0.03
    directions = cells.fibonacci(256)
    transmittance = directional.transmittance(points, normals, centers, radii, directions)
    assert abs(directional_transfer(transmittance, normals, directions).numpy().sum() - 0.5) < 0.02
