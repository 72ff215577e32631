"""Joint coverage of two blockers, against half-planes whose union is known, and its float64 twin."""

import numpy as np
import pytest
import twins
import warp as wp

from warpshadow.stages.joint_coverage import transmittance_past

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

FLOAT32 = 1e-6
# The longest moment is known within 3% between shares of 0.02 and 0.98, of which T sees twice as much times G − R.
BOUND = 0.03
SHARES = np.linspace(0.05, 0.95, 16)


def half_plane(share, angle):
    """Coverage by a half-plane in the plane across z, whose inside is at an angle."""
    grid = np.linspace(-1, 1, 20001)
    covered = (np.arccos(grid) - grid * np.sqrt(1 - grid**2)) / np.pi
    distance = np.interp(-np.asarray(share), -covered, grid)
    moment = 2 / (3 * np.pi) * (1 - distance**2) ** 1.5
    return np.stack([share, moment * np.cos(angle), moment * np.sin(angle), 0 * moment], axis=-1)


def past(device, *coverages, transmittance=None):
    arrays = [wp.array(np.reshape(item, (1, 1, -1, 4)), dtype=wp.vec4, device=device) for item in coverages]
    rest = None if transmittance is None else wp.array(transmittance[None, None], dtype=wp.float32, device=device)
    return transmittance_past(rest, *arrays).numpy()[0, 0]


def test_one_blocker_leaves_the_rest(device):
    np.testing.assert_allclose(past(device, half_plane(SHARES, 1.0)), 1 - SHARES, atol=FLOAT32)
    np.testing.assert_array_equal(past(device, [[1.3, 0.2, 0, 0]]), 0)


@pytest.mark.parametrize("other", [0.2, 0.5, 0.9])
def test_half_planes_beside_each_other_add_up_and_one_behind_the_other_hides(device, other):
    first = half_plane(SHARES, 0.3)
    beside = past(device, first, half_plane(np.full(16, other), 0.3 + np.pi))
    np.testing.assert_allclose(beside, np.maximum(0, 1 - SHARES - other), atol=BOUND)
    behind = past(device, first, half_plane(np.full(16, other), 0.3))
    np.testing.assert_allclose(behind, 1 - np.maximum(SHARES, other), atol=BOUND)
    across = past(device, first, half_plane(np.full(16, other), 0.3 + np.pi / 2))
    np.testing.assert_allclose(across, (1 - SHARES) * (1 - other), atol=FLOAT32)


def test_halves_at_any_angle_are_nearly_as_they_are(device):
    angles = np.linspace(0, np.pi, 16)
    found = past(device, half_plane(np.full(16, 0.5), 0.0), half_plane(np.full(16, 0.5), angles))
    np.testing.assert_allclose(found, 0.5 - angles / (2 * np.pi), atol=0.06)


def test_values_are_those_of_the_twin_in_either_order(device):
    rng = np.random.default_rng(0)
    coverages = []
    for _ in range(2):
        share, moment = rng.uniform(-0.1, 1.2, (64, 1)), rng.normal(size=(64, 3))
        length = rng.uniform(0, 1, (64, 1)) * twins.moment_bound(np.clip(share, 0, 1))
        coverages.append(np.concatenate([share, length * twins.unit(moment)], axis=1))
    rest = rng.uniform(size=64)
    expected = [
        rest[q] * twins.open_share(*[[c[q, 0] for c in coverages], [c[q, 1:] for c in coverages]]) for q in range(64)
    ]
    found = past(device, *coverages, transmittance=rest)
    np.testing.assert_allclose(found, expected, atol=2e-5)
    np.testing.assert_allclose(past(device, *coverages[::-1], transmittance=rest), found, atol=FLOAT32)
    assert found.min() >= 0 and found.max() <= 1


def test_instances_share_a_batch_of_one(device):
    first = wp.array(np.tile(half_plane(SHARES, 0.0), (2, 1, 1, 1)), dtype=wp.vec4, device=device)
    second = wp.array(half_plane(SHARES, 1.0)[None, None], dtype=wp.vec4, device=device)
    found = transmittance_past(None, first, second).numpy()
    np.testing.assert_array_equal(found[0], found[1])


def test_what_does_not_fit_is_refused(device):
    coverages = wp.zeros((1, 2, 16), dtype=wp.vec4, device=device)
    with pytest.raises(ValueError, match=r"others: got shape \(1, 2, 8\)"):
        transmittance_past(None, coverages, wp.zeros((1, 2, 8), dtype=wp.vec4, device=device))
    with pytest.raises(ValueError, match=r"transmittance: got shape \(1, 3, 16\)"):
        transmittance_past(wp.zeros((1, 3, 16), dtype=wp.float32, device=device), coverages)
