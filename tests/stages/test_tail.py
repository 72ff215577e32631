"""The tail of bounces: sums of geometric series, and their gradients."""

import numpy as np
import pytest
import warp as wp

from warpshadow.stages.bounces.tail import with_tail

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

RANDOM = np.random.default_rng(0)
AREAS = RANDOM.uniform(0.5, 2, 7)


def put(values, device, **options):
    return [wp.array(value, dtype=wp.vec3, device=device, **options) for value in values]


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_a_geometric_series_is_summed_in_each_color(scale, device):
    shape, ratio = RANDOM.uniform(0.1, 1, (2, 7, 3)), np.array([0.0, 0.5, 0.9])
    radiosities = [scale * sum(shape * ratio**n for n in range(count)) for count in (1, 2, 3)]
    got = with_tail(*put(radiosities, device), AREAS).numpy()
    np.testing.assert_allclose(got, scale * shape / (1 - ratio), rtol=1e-4)


def test_light_that_does_not_die_away_gets_forty_nine_more_terms(device):
    one = np.ones((1, 7, 3))
    np.testing.assert_allclose(with_tail(*put([one, 2 * one, 3 * one], device), AREAS).numpy(), 52, rtol=1e-4)
    dark = with_tail(*put([0 * one] * 3, device), AREAS).numpy()
    assert (dark == 0).all()


def test_the_gradient_is_that_of_differences(device):
    first = RANDOM.uniform(0.5, 1, (1, 7, 3))
    values = [first, first + RANDOM.uniform(0.3, 0.4, (1, 7, 3)), first + RANDOM.uniform(0.45, 0.55, (1, 7, 3))]
    weights = RANDOM.normal(size=(1, 7, 3))

    def twin(before, last, now):
        old, new = last - before, now - last
        ratio = (AREAS[:, None] * new * old).sum(axis=1) / (AREAS[:, None] * old**2).sum(axis=1)
        return np.sum(weights * (now + ratio / (1 - ratio) * new))

    arrays = put(values, device, requires_grad=True)
    with wp.Tape() as tape:
        result = with_tail(*arrays, AREAS)
    result.grad.assign(weights.astype(np.float32))
    tape.backward()
    for number, array in enumerate(arrays):
        expected = np.zeros((1, 7, 3))
        for index in np.ndindex(expected.shape):
            step = np.zeros((1, 7, 3))
            step[index] = 1e-6
            ends = [twin(*(v + sign * step * (k == number) for k, v in enumerate(values))) for sign in (1, -1)]
            expected[index] = (ends[0] - ends[1]) / 2e-6
        np.testing.assert_allclose(array.grad.numpy(), expected, rtol=1e-3, atol=1e-4)
