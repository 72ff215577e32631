"""How much patch samples count in their patches: against float64 NumPy, differences of it, and cases with known
answers."""

import numpy as np
import pytest
import warp as wp
from test_projected_areas import DIRECTIONS, compare

from warpshadow.stages.bounces.patch_weights import find_mean_transmittance, find_patch_weights
from warpshadow.stages.bounces.radiosity import mean_over_patch_samples, patch_radiosity

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

HIDDEN = 0.01
PATCHES, WEIGHTS = np.array([0, 0, 2, 2, 2]), np.array([0.4, 0.6, 0.5, 0.2, 0.3])
UP = np.array([0.0, 1.0, 0.0])


def sums(normals, *transmittances):
    cosines = 4 / len(DIRECTIONS) * np.maximum(normals @ DIRECTIONS.T, 0)
    return [(cosines * passing).sum(axis=1) + HIDDEN for passing in transmittances]


def twin_sample_weights(normals, past_self, past_all):
    (means,) = sums(normals, past_all)
    return np.repeat((means / np.bincount(PATCHES, WEIGHTS * means)[PATCHES])[:, None], 3, axis=1)


def twin_weights(normals, past_self, past_all):
    of_self, of_all = (np.bincount(PATCHES, WEIGHTS * each) for each in sums(normals, past_self, past_all))
    ratio = np.divide(of_all, of_self, out=np.zeros(3), where=of_self > 0)
    return np.repeat((ratio**8 / (ratio**8 + 0.04**8))[:, None], 3, axis=1)


def find(normals, past_self, past_all, device):
    mean = mean_over_patch_samples(PATCHES, WEIGHTS, 3, device=device)
    return find_patch_weights(find_mean_transmittance(normals, past_self, past_all, DIRECTIONS), mean, PATCHES)


def sample_weights(normals, past_self, past_all, device):
    return find(normals, past_self, past_all, device).sample_weights


@pytest.mark.parametrize(("name", "twin"), [("sample_weights", twin_sample_weights), ("weights", twin_weights)])
def test_weights_of_patch_samples_and_of_patches_are_those_of_the_twin(name, twin, device):
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(5, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    past_self = rng.random((5, 32))
    values = [normals, past_self, 0.08 * past_self * rng.random((5, 32))]
    compare(
        lambda *arrays: getattr(find(*arrays, device), name), twin, values, (wp.vec3, wp.float32, wp.float32), device
    )


@pytest.mark.parametrize("has_self", [True, False])
def test_a_buried_patch_sample_hardly_darkens_its_patch(has_self, device):
    """Patch samples 1 and 4 are black inside another body, the others stand free."""
    normals = wp.array(np.tile(UP, (1, 5, 1)), dtype=wp.vec3, device=device)
    is_free = np.float32([1, 0, 1, 1, 0])
    past_all = wp.array(np.tile(is_free[None, :, None], (1, 1, 32)), dtype=wp.float32, device=device)
    past_self = wp.full((1, 5, 32), 1.0, dtype=wp.float32, device=device) if has_self else None
    light = wp.array(is_free[None, :, None] * np.ones(3), dtype=wp.vec3, device=device)
    white = wp.full((1, 3), wp.vec3(1.0), dtype=wp.vec3, device=device)
    mean = mean_over_patch_samples(PATCHES, WEIGHTS, 3, device=device)
    weighted = patch_radiosity(white, light, mean, sample_weights(normals, past_self, past_all, device)).numpy()[
        0, :, 0
    ]
    np.testing.assert_allclose(weighted, [1, 0, 1], atol=0.02)
    np.testing.assert_allclose(patch_radiosity(white, light, mean).numpy()[0, :, 0], [0.4, 0, 0.7], atol=1e-6)


def test_of_a_patch_that_is_buried_wholly_all_patch_samples_count(device):
    normals = wp.array(np.tile(UP, (1, 5, 1)), dtype=wp.vec3, device=device)
    nothing = wp.zeros((1, 5, 32), dtype=wp.float32, device=device)
    np.testing.assert_allclose(sample_weights(normals, None, nothing, device).numpy(), 1, rtol=1e-5)


def test_what_does_not_fit_is_refused(device):
    normals = wp.zeros((1, 5), dtype=wp.vec3, device=device)
    passing = wp.zeros((1, 5, 8), dtype=wp.float32, device=device)
    with pytest.raises(ValueError, match=r"transmittance_nonplanar: got shape \(1, 5, 8\), expected \[batch, 5, 32\]"):
        find_mean_transmittance(normals, None, passing, DIRECTIONS)
