"""The tail of bounces: light as a sum of geometric series, and its gradient."""

import numpy as np
import pytest
import warp as wp

from warpshadow.stages.bounces.tail import add_tail

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

RANDOM = np.random.default_rng(0)
AREAS = RANDOM.uniform(0.5, 2, 7)


def put(values, device, **options):
    return [wp.array(value, dtype=wp.vec3, device=device, **options) for value in values]


def series(scale, *ratios):
    """Radiosities after 0 to 4 bounces of light that is a sum of geometric series in each color; and after all."""
    shapes = scale * RANDOM.uniform(0.1, 1, (len(ratios), 2, 7, 3))
    powers = [sum(shape * ratio**n for shape, ratio in zip(shapes, ratios, strict=True)) for n in range(5)]
    return np.cumsum(powers, axis=0), sum(shape / (1 - ratio) for shape, ratio in zip(shapes, ratios, strict=True))


def twin(radiosities):
    """With 1e-7 on the diagonal left out."""
    terms = np.diff(radiosities, axis=0)
    products = np.einsum("ibpc,p,jbpc->bcij", terms[:3], AREAS, terms)
    matrix = products[..., :3] - products[..., 1:]
    coefficients = np.linalg.solve(matrix, products[..., :1])[..., 0]
    return radiosities[1] + np.einsum("bcj,jbpc->bpc", coefficients, terms[1:])


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("ratios", [[np.array([0.0, 0.5, 0.9])], [0.9, 0.5], [0.8, 0.3, -0.1]])
def test_sums_of_geometric_series_are_exact(scale, ratios, device):
    radiosities, all_of_it = series(scale, *ratios)
    np.testing.assert_allclose(add_tail(put(radiosities, device), AREAS).numpy(), all_of_it, rtol=2e-3)


def test_light_that_does_not_die_away_gets_forty_nine_more_terms(device):
    one = np.ones((1, 7, 3))
    found = add_tail(put([one, 2 * one, 3 * one, 4 * one, 5 * one], device), AREAS).numpy()
    np.testing.assert_allclose(found, 54, rtol=1e-4)
    dark = add_tail(put([0 * one] * 5, device), AREAS).numpy()
    assert (dark == 0).all()


def test_a_number_of_radiosities_other_than_five_is_refused(device):
    with pytest.raises(ValueError, match=r"radiosities: got 3, expected 5"):
        add_tail(put([np.ones((1, 7, 3))] * 3, device), AREAS)


def test_light_is_that_of_a_twin_and_the_gradient_that_of_differences(device):
    values = np.cumsum([RANDOM.uniform(0.5, 1, (1, 7, 3)) * ratio for ratio in (1, 0.5, 0.3, 0.2, 0.1)], axis=0)
    weights = RANDOM.normal(size=(1, 7, 3))
    arrays = put(values, device, requires_grad=True)
    with wp.Tape() as tape:
        result = add_tail(arrays, AREAS)
    np.testing.assert_allclose(result.numpy(), twin(values), rtol=1e-5)
    result.grad.assign(weights.astype(np.float32))
    tape.backward()
    for number, array in enumerate(arrays):
        expected = np.zeros((1, 7, 3))
        for index in np.ndindex(expected.shape):
            step = np.zeros((5, 1, 7, 3))
            step[(number, *index)] = 1e-6
            expected[index] = np.sum(weights * (twin(values + step) - twin(values - step))) / 2e-6
        np.testing.assert_allclose(array.grad.numpy(), expected, rtol=1e-3, atol=1e-4)
