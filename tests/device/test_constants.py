"""Constants and cached values: what counts as the same argument."""

import numpy as np
import pytest
import warp as wp

from warpshadow.device.constants import cached_by_values, constant, gather_of_owners, immutable


def test_arrays_are_compared_by_values_and_immutable_ones_by_identity():
    calls = []

    @cached_by_values
    def total(values):
        calls.append(values)
        return float(values.sum())

    changing = np.arange(4.0)
    assert [total(changing), total(changing.copy())] == [6.0, 6.0] and len(calls) == 1
    changing[0] = 10.0
    assert total(changing) == 16.0 and len(calls) == 2

    first, second = (immutable(np.arange(4.0)) for _ in range(2))
    assert [total(first), total(first), total(second)] == [6.0, 6.0, 6.0] and len(calls) == 4
    with pytest.raises(ValueError, match="read-only"):
        first[0] = 10.0


def test_values_of_owners_are_made_once_for_equal_values():
    owners = immutable(np.array([0, 0, 2, 1]))
    values = gather_of_owners(np.array([5, 6, 7]), owners)
    assert values.tolist() == [5, 5, 7, 6] and gather_of_owners(np.array([5, 6, 7]), owners) is values
    assert gather_of_owners(np.array([True, False, True]), owners).tolist() == [True, True, True, False]


def test_values_in_use_outlive_those_that_are_not():
    """A graph takes the constants of the call before it, however early equal values came first."""
    used = constant(np.array([7.0, 11.0]), wp.float32, "cpu")
    for number in range(400):
        constant(np.array([float(number), -1.0]), wp.float32, "cpu")
        assert constant(np.array([7.0, 11.0]), wp.float32, "cpu") is used
