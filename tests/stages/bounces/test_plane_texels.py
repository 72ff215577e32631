"""Radiosity of texels of planes: against NumPy, against differences, and of patches that other bodies bury."""

import numpy as np
import pytest
import warp as wp
from plane_settings import Setting, mesh_means

from warpshadow.device.tape import recorded
from warpshadow.stages.bounces.plane_texels import find_texels

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

FLOAT32 = 2e-5


def open_weights_of(setting, seed=3):
    """Of all patches: of some a thousandth, of others up to 1."""
    count = setting.values()[4].shape[1]
    return np.random.default_rng(seed).uniform(0.1, 1, size=count) ** 3


def twin(setting, open_weights):
    """Texels of all levels, sides and planes, one after another."""
    result, first = [], 0
    for grid, radiosity in zip(setting.grids, setting.radiosity, strict=True):
        for side in range(grid.sides):
            count = grid.covered.size
            weights = open_weights[first : first + count].reshape(*grid.covered.shape, 1)
            sizes = [grid.covered.shape]
            while max(sizes[-1]) > 1:
                sizes.append(tuple(max(size // 2, 1) for size in sizes[-1]))
            result += [mesh_means(grid, radiosity[side], *size, weights).reshape(-1, 3) for size in sizes]
            first += count
    return np.concatenate(result)


def arrays_of(setting, open_weights, device):
    values = setting.values()[4], np.repeat(open_weights[None, :, None], 3, axis=2)
    return [wp.array(value, dtype=wp.vec3, device=device, requires_grad=True) for value in values]


@pytest.mark.parametrize("two_sided", [False, True])
def test_texels_are_those_of_the_formula(two_sided, device):
    setting = Setting(device, two_sided=two_sided)
    open_weights = open_weights_of(setting)
    texels = find_texels(*arrays_of(setting, open_weights, device), setting.planes).numpy()[0]
    np.testing.assert_allclose(texels, twin(setting, open_weights), atol=FLOAT32)


def test_gradients_of_texels_are_those_of_the_twin(device, verified_tape):
    setting, rng = Setting(device, names=("ground", "l")), np.random.default_rng(4)
    open_weights = open_weights_of(setting)
    variables = arrays_of(setting, open_weights, device)
    with recorded() as tape:
        texels = find_texels(*variables, setting.planes)
    weights = rng.normal(size=texels.shape[1:] + (3,))
    tape.backward(grads={texels: wp.array(weights[None], dtype=wp.vec3, device=device)})
    steps = [rng.normal(size=variables[0].shape + (3,)), rng.normal(size=open_weights.shape) * open_weights]
    no_steps = [np.zeros(value.shape) for value in setting.values()[:4]]
    size, ends = 1e-6, []
    for sign in (1, -1):
        setting.move([*no_steps, sign * size * steps[0]])
        ends.append((weights * twin(setting, open_weights)).sum())
        setting.move([*no_steps, -sign * size * steps[0]])
        ends.append((weights * twin(setting, open_weights + sign * size * steps[1])).sum())
    slopes = (ends[0] - ends[2]) / (2 * size), (ends[1] - ends[3]) / (2 * size)
    found = (variables[0].grad.numpy() * steps[0]).sum(), (variables[1].grad.numpy()[0].sum(axis=1) * steps[1]).sum()
    np.testing.assert_allclose(found, slopes, rtol=2e-3)


def test_buried_patches_have_the_light_of_those_beside_them(device):
    """A black stripe of two buried texels between a bright and a dim side."""
    setting = Setting(device, names=("ground",))
    (grid,) = setting.grids
    columns = grid.covered.shape[1]
    middle = columns // 2
    bright = np.where(np.arange(columns) < middle, 1.0, 0.2)
    is_buried = np.isin(np.arange(columns), [middle - 1, middle])
    setting.radiosity[0][0] = np.where(is_buried, 0.0, bright)[None, :, None]
    open_weights = np.broadcast_to(np.where(is_buried, 1e-4, 1.0), grid.covered.shape).ravel()
    texels = find_texels(*arrays_of(setting, open_weights, device), setting.planes).numpy()[0]
    of_finest = texels[: grid.covered.size].reshape(*grid.covered.shape, 3)[..., 0]
    np.testing.assert_allclose(of_finest, np.tile(bright, (len(of_finest), 1)), rtol=0.06)
    assert texels.min() > 0.19
