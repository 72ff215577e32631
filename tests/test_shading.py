"""Transfer vectors, light and textures, against NumPy; and the gradients of what is linear."""

import numpy as np
import pytest
import twins
import warp as wp

from warpshadow import directions as cells
from warpshadow import sh, shading
from warpshadow.visibility import directional, exponential, log_sh

# Sums of up to 10⁴ float32 products of size 1/100.
FLOAT32 = 5e-6
# Central differences of functions linear in float32 numbers: exact but for roundings over the step of 0.1.
GRADIENT = 2e-3


pytestmark = pytest.mark.usefixtures("poisoned_outputs")


def unit_vectors(seed, *shape):
    values = np.random.default_rng(seed).normal(size=(*shape, 3))
    return (values / np.linalg.norm(values, axis=-1, keepdims=True)).astype(np.float32)


def clamped_cosines(order, normals):
    """SH of max(n·ω, 0) / π: the twin integrates numerically over z of the upper hemisphere."""
    node, weight = np.polynomial.legendre.leggauss(40)
    z = (node + 1) / 2
    return twins.turned(np.pi * (weight * z) @ twins.zonal_values(order, z) / np.pi, normals.astype(float))


# ------------------------------------------------------------------------------------------ transfer vectors


@pytest.mark.parametrize("lanes", [16, 1])
@pytest.mark.parametrize("order", [2, 5, 8])
def test_sh_transfer_is_the_product_of_visibility_and_cosine(order, lanes, monkeypatch, device):
    monkeypatch.setattr(shading, "lane_count", lambda _: lanes)
    normals = unit_vectors(order, 2, 19)
    visibility = np.random.default_rng(order).normal(size=(2, 19, order**2)).astype(np.float32)
    got = shading.sh_transfer(
        wp.array(visibility, device=device), wp.array(normals, dtype=wp.vec3, device=device), order=order
    ).numpy()
    expected = twins.Product(order)(visibility, clamped_cosines(order, normals))
    assert np.abs(got - expected).max() < FLOAT32


@pytest.mark.parametrize("order", [2, 8])
def test_unblocked_sh_transfer_is_the_cosine_and_that_of_full_visibility(order, device):
    normals = unit_vectors(1, 1, 33)
    on_device = wp.array(normals, dtype=wp.vec3, device=device)
    free = shading.sh_transfer(None, on_device, order=order).numpy()
    assert np.abs(free - clamped_cosines(order, normals)).max() < FLOAT32
    full = wp.array(np.tile(np.eye(1, order**2) * twins.UNIT, (1, 33, 1)).astype(np.float32), device=device)
    assert np.abs(shading.sh_transfer(full, on_device, order=order).numpy() - free).max() < FLOAT32


@pytest.mark.parametrize("order", [2, 8])
def test_white_under_unit_light_in_sh_is_one(order, device):
    """The white furnace: albedo 1, L = 1, nothing blocked."""
    normals = wp.array(unit_vectors(2, 1, 50), dtype=wp.vec3, device=device)
    light = np.zeros((1, order**2, 3), np.float32)
    light[:, 0] = twins.UNIT
    transfer = shading.sh_transfer(None, normals, order=order)
    got = shading.shade(transfer, wp.array(light, dtype=wp.vec3, device=device)).numpy()
    assert np.abs(got - 1).max() < 1e-5


@pytest.mark.parametrize("count, error", [(64, 0.02), (128, 0.01), (256, 0.005)])
def test_white_under_unit_light_in_cells_is_nearly_one(count, error, device):
    """Cells at the horizon count wholly or not at all; that averages out as 1/Q, 0.9/Q at worst."""
    normals = wp.array(unit_vectors(3, 1, 500), dtype=wp.vec3, device=device)
    everything = wp.ones((1, 500, count), dtype=wp.float32, device=device)
    transfer = shading.directional_transfer(everything, normals, cells.fibonacci(count))
    light = wp.ones((1, count), dtype=wp.vec3, device=device)
    assert np.abs(shading.shade(transfer, light).numpy() - 1).max() < error


def test_directional_transfer_is_transmittance_times_cosine_and_solid_angle(device):
    normals = unit_vectors(4, 2, 19)
    transmittance = np.random.default_rng(4).uniform(size=(2, 19, 48)).astype(np.float32)
    directions = cells.fibonacci(48)
    got = shading.directional_transfer(
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
    expected = shading.directional_transfer(whole, normals, directions).numpy()[:, ::2]
    got = shading.directional_transfer(whole[:, ::2], normals[:, ::2], directions).numpy()
    np.testing.assert_array_equal(got, expected)


def test_transfer_of_mismatched_visibility_is_refused(device):
    normals = wp.zeros((1, 5), dtype=wp.vec3, device=device)
    with pytest.raises(ValueError, match=r"visibility: got shape \(1, 4, 16\), expected \[1, 5, 16\]"):
        shading.sh_transfer(wp.zeros((1, 4, 16), device=device), normals, order=4)
    with pytest.raises(ValueError, match="order: got 9, expected"):
        shading.sh_transfer(None, normals, order=9)
    with pytest.raises(ValueError, match=r"transmittance: got shape \(1, 5, 16\), expected \[1, 5, 32\]"):
        shading.directional_transfer(wp.zeros((1, 5, 16), device=device), normals, cells.fibonacci(32))


def test_a_blocked_receiver_is_darker_by_either_method_and_alike(device):
    """A sphere that fills half of the cosine-weighted sky: sin² θ = 1/2 right above the receiver."""
    points, normals = wp.zeros((1, 1), dtype=wp.vec3, device=device), np.float32([[[0, 1, 0]]])
    normals = wp.array(normals, dtype=wp.vec3, device=device)
    centers = wp.array(np.float32([[[0, np.sqrt(2), 0]]]), dtype=wp.vec3, device=device)
    radii = wp.ones((1, 1), dtype=wp.float32, device=device)
    visibility = exponential.exponentiate(log_sh.accumulate(points, normals, centers, radii, order=8))
    assert (
        abs(shading.sh_transfer(visibility, normals, order=8).numpy()[0, 0, 0] * twins.UNIT - 0.5) < 0.03
    )  # truncated to 8 bands
    directions = cells.fibonacci(256)
    transmittance = directional.transmittance(points, normals, centers, radii, directions)
    assert abs(shading.directional_transfer(transmittance, normals, directions).numpy().sum() - 0.5) < 0.02


# ------------------------------------------------------------------------------------------ light


def random_light(device, batch=2, vertices=7, coefficients=16, requires_grad=False):
    rng = np.random.default_rng(5)
    transfer = rng.normal(size=(batch, vertices, coefficients)).astype(np.float32)
    light = rng.normal(size=(batch, coefficients, 3)).astype(np.float32)
    return (
        wp.array(transfer, device=device, requires_grad=requires_grad),
        wp.array(light, dtype=wp.vec3, device=device, requires_grad=requires_grad),
    )


def test_shading_is_the_dot_product_of_transfer_and_light(device):
    transfer, light = random_light(device)
    got = shading.shade(transfer, light)
    assert not got.requires_grad
    assert np.abs(got.numpy() - np.einsum("bvk,bkc->bvc", transfer.numpy(), light.numpy())).max() < FLOAT32


def test_shading_is_linear_in_the_light(device):
    transfer, light = random_light(device)
    other = wp.array(np.roll(light.numpy(), 1, axis=1), dtype=wp.vec3, device=device)
    both = wp.array(2 * light.numpy() - 3 * other.numpy(), dtype=wp.vec3, device=device)
    expected = 2 * shading.shade(transfer, light).numpy() - 3 * shading.shade(transfer, other).numpy()
    assert np.abs(shading.shade(transfer, both).numpy() - expected).max() < 5 * FLOAT32


def test_light_that_does_not_fit_the_transfer_is_refused(device):
    transfer, _ = random_light(device)
    with pytest.raises(ValueError, match=r"light: got shape \(2, 15\), expected \[2, 16\]"):
        shading.shade(transfer, wp.zeros((2, 15), dtype=wp.vec3, device=device))


def tape_gradients(function, inputs, weights, device):
    """Gradients of Σ weights · function(*inputs) by the tape."""
    with wp.Tape() as tape:
        result = function(*inputs)
    tape.backward(grads={result: wp.array(weights, dtype=wp.vec3, device=device)})
    return [tape.gradients[value].numpy().astype(float) for value in inputs]


def difference(function, inputs, index, direction, weights, step=0.1):
    """Central difference of Σ weights · function(*inputs) along a direction of one input."""
    sums = []
    for sign in (1, -1):
        moved = list(inputs)
        values = inputs[index].numpy() + np.float32(sign * step) * direction
        moved[index] = wp.array(values, dtype=inputs[index].dtype, device=inputs[index].device)
        sums.append((weights * function(*moved).numpy().astype(float)).sum())
    return (sums[0] - sums[1]) / (2 * step)


def test_gradients_of_shading_are_its_central_differences(device, verified_tape):
    inputs = random_light(device, requires_grad=True)
    rng = np.random.default_rng(6)
    weights = rng.normal(size=(2, 7, 3)).astype(np.float32)
    gradients = tape_gradients(shading.shade, inputs, weights, device)
    for index, gradient in enumerate(gradients):
        for _ in range(3):
            direction = rng.normal(size=gradient.shape).astype(np.float32)
            expected = difference(shading.shade, inputs, index, direction, weights)
            assert abs((gradient * direction).sum() - expected) < GRADIENT * np.abs(gradient * direction).sum()


# ------------------------------------------------------------------------------------------ textures


def bilinear(texture, uvs):
    """Texture [height, width, 3], row 0 at v = 1, repeated, sampled between texel centers at (i + ½)/size."""
    height, width = texture.shape[:2]
    x, y = uvs[:, 0] * width - 0.5, (1 - uvs[:, 1]) * height - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    s, t = (x - left)[:, None], (y - top)[:, None]

    def texel(row, column):
        return texture[row % height, column % width]

    above = (1 - s) * texel(top, left) + s * texel(top, left + 1)
    below = (1 - s) * texel(top + 1, left) + s * texel(top + 1, left + 1)
    return (1 - t) * above + t * below


def random_texture(device, requires_grad=False):
    rng = np.random.default_rng(7)
    texture = rng.uniform(size=(5, 8, 3)).astype(np.float32)
    uvs = rng.uniform(-2, 3, size=(40, 2)).astype(np.float32)
    uvs[:6] = [[0, 0], [1, 1], [0.5, 0.5], [-0.0, 1e-9], [0.999999, 0.03], [-1, 2]]
    pixels = np.r_[0:6, 8:40:2].astype(np.int32)
    return (
        wp.array(texture, dtype=wp.vec3, device=device, requires_grad=requires_grad),
        wp.array(pixels, device=device),
        wp.array(uvs, dtype=wp.vec2, device=device),
    )


def test_textures_are_sampled_bilinearly_and_repeat(device):
    texture, pixels, uvs = random_texture(device)
    albedo = wp.full(40, wp.vec3(7.0), dtype=wp.vec3, device=device)
    shading.sample_texture(texture, pixels, uvs, albedo)
    expected = bilinear(texture.numpy().astype(float), uvs.numpy().astype(float))
    shown = pixels.numpy()
    assert np.abs(albedo.numpy() - expected)[shown].max() < 1e-5  # uvs up to 3 carry 1e-7, times 8 texels
    assert (np.delete(albedo.numpy(), shown, axis=0) == 7).all()  # pixels of other bodies stay


def test_texel_centers_get_their_texels(device):
    texture, *_ = random_texture(device)
    row, column = np.mgrid[:5, :8]
    uvs = np.stack([(column + 0.5) / 8, 1 - (row + 0.5) / 5], axis=-1).reshape(-1, 2)
    albedo = wp.full(40, wp.vec3(np.nan), dtype=wp.vec3, device=device)
    arguments = wp.array(np.arange(40, dtype=np.int32), device=device), wp.array(uvs, dtype=wp.vec2, device=device)
    shading.sample_texture(texture, *arguments, albedo)
    assert np.abs(albedo.numpy() - texture.numpy().reshape(-1, 3)).max() < 2e-6


def test_gradients_of_a_texture_are_its_central_differences(device, verified_tape):
    texture, pixels, uvs = random_texture(device, requires_grad=True)

    def sample(values):
        albedo = wp.zeros(40, dtype=wp.vec3, device=device, requires_grad=values.requires_grad)
        shading.sample_texture(values, pixels, uvs, albedo)
        return albedo

    rng = np.random.default_rng(8)
    weights = rng.normal(size=(40, 3)).astype(np.float32)
    (gradient,) = tape_gradients(sample, [texture], weights, device)
    for _ in range(3):
        direction = rng.normal(size=gradient.shape).astype(np.float32)
        expected = difference(sample, [texture], 0, direction, weights)
        assert abs((gradient * direction).sum() - expected) < GRADIENT * np.abs(gradient * direction).sum()


def test_no_textured_pixel_is_no_work(device):
    texture, _, uvs = random_texture(device)
    albedo = wp.ones(40, dtype=wp.vec3, device=device)
    shading.sample_texture(texture, wp.zeros(0, dtype=wp.int32, device=device), uvs, albedo)
    assert (albedo.numpy() == 1).all()


def test_the_cosine_used_by_the_kernel_has_no_odd_bands_above_the_first():
    """The transfer's product table leaves them out."""
    assert np.abs(sh.clamped_cosine(8)[[3, 5, 7]]).max() < 1e-12
