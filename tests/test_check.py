"""Argument checks: what passes, and what the message of a refusal says."""

import numpy as np
import pytest

from warpshadow import check


def test_a_known_choice_passes():
    check.choice("log", "cap", ("eigen", "cap"))
    check.choice("count", 2, iter((1, 2)))


def test_an_unknown_choice_names_the_argument_the_value_the_choices_and_the_nearest():
    with pytest.raises(
        ValueError, match=r"^log: got 'eigne', expected one of 'eigen', 'cap' \(did you mean 'eigen'\?\)$"
    ):
        check.choice("log", "eigne", ("eigen", "cap"))


def test_a_choice_far_from_all_gets_no_suggestion():
    with pytest.raises(ValueError, match=r"expected one of 'eigen', 'cap'$"):
        check.choice("log", "zzz", ("eigen", "cap"))


def test_an_unknown_key_names_where_and_the_nearest_known_key():
    check.known_keys("[light]", ["envmap"], ["envmap", "sh"])
    with pytest.raises(
        ValueError, match=r"\[light\]: unknown key 'envmpa' \(did you mean 'envmap'\?\); known keys are envmap, sh"
    ):
        check.known_keys("[light]", ["sh", "envmpa"], ["envmap", "sh"])


def test_non_finite_values_are_counted_and_the_first_is_located():
    values = np.zeros((3, 2), np.float32)
    check.finite("radii", values)
    values[1, 1], values[2, 0] = np.nan, np.inf
    with pytest.raises(ValueError, match=r"radii: got 2 NaN or Inf values \(first at index \(1, 1\)\)"):
        check.finite("radii", values)


def test_a_string_in_an_expected_shape_stands_for_any_length():
    check.shape("positions", (2, 3, 3), (2, "vertex", 3))
    check.shape("positions", (2, 0, 3), (2, "vertex", 3))


@pytest.mark.parametrize("got", [(), (2, 3), (2, 4, 2), (1, 4, 3), (2, 3, 3, 1)])
def test_a_wrong_shape_is_named_with_the_expected_one(got):
    with pytest.raises(ValueError, match=r"^positions: got shape \(.*\), expected \[2, vertex, 3\]$"):
        check.shape("positions", got, (2, "vertex", 3))
