"""Sums of light on several ways, and their gradients."""

import numpy as np
import pytest
import warp as wp

from warpshadow.stages.light.sums import add_light


@pytest.mark.parametrize("count", [2, 3, 4])
def test_light_adds_up_and_its_gradient_goes_to_every_part(count, device):
    random = np.random.default_rng(0)
    shapes = [(2, 5, 3), (1, 5, 3), (2, 5, 3), (1, 5, 3)][:count]
    values = [random.normal(size=shape).astype(np.float32) for shape in shapes]
    parts = [wp.array(each, dtype=wp.vec3, device=device, requires_grad=True) for each in values]
    with wp.Tape() as tape:
        total = add_light(*parts)
    np.testing.assert_allclose(total.numpy(), sum(values), rtol=1e-6)
    seed = random.normal(size=total.numpy().shape).astype(np.float32)
    total.grad.assign(seed)
    tape.backward()
    for part in parts:
        expected = seed if len(part) == 2 else seed.sum(axis=0, keepdims=True)
        np.testing.assert_allclose(part.grad.numpy(), expected, rtol=1e-5, atol=1e-6)


def test_one_part_is_the_total(device):
    part = wp.ones((1, 3), dtype=wp.vec3, device=device)
    assert add_light(part) is part
