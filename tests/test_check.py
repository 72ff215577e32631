"""Argument checks: what passes, and what the message of a refusal says."""

import numpy as np
import pytest
import warp as wp

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


def vectors(device, **spoiled):
    """An array of shape [2, 3] of vec3, and what is spoiled in it: the index in NumPy → a value."""
    values = np.linspace(-1, 1, 18, dtype=np.float32).reshape(2, 3, 3)
    for index, value in spoiled.items():
        values[tuple(int(i) for i in index[1:])] = value
    return wp.array(values, dtype=wp.vec3, device=device)


def test_finite_arrays_of_any_type_pass(device):
    matrices = wp.zeros((4, 2), dtype=wp.mat33, device=device)
    nothing = wp.zeros((0, 5), dtype=wp.vec3, device=device)
    numbers = wp.full(7, 1e18, dtype=wp.float32, device=device)
    check.finite_arrays({"points": vectors(device), "matrices": matrices, "normals": None, "nothing": nothing})
    check.finite_arrays({"numbers": numbers}, nonnegative=["numbers"])
    check.finite_arrays({"numbers": numbers})


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_the_first_array_that_is_not_finite_is_named_with_the_place(value, device):
    arrays = {"points": vectors(device), "normals": vectors(device, _120=value, _111=value), "centers": None}
    with pytest.raises(
        ValueError, match=r"^normals: got 2 NaN or Inf values \(first at index \(1, 1, 1\)\), expected finite"
    ):
        check.finite_arrays(arrays)


def test_numbers_out_of_range_are_named_with_the_range(device):
    with pytest.raises(
        ValueError, match=r"^points: got 1 values out of range \(first at index \(0, 2, 1\): -3\), expected -2 to 2$"
    ):
        check.finite_arrays({"points": vectors(device, _021=-3)}, most=2.0)
    with pytest.raises(
        ValueError, match=r"^radii: got 9 values out of range \(first at index \(0, 0, 0\): -1\), expected 0 to 2$"
    ):
        check.finite_arrays({"points": vectors(device), "radii": vectors(device)}, most=2.0, nonnegative=["radii"])


@pytest.mark.parametrize("find", [check._outside_on_host, check._outside_on_device])
def test_host_and_device_find_the_same_arrays(find, device):
    """The host reads arrays of the device; the device's kernel runs on a CPU as well."""
    whole = vectors(device, _000=np.nan)
    arrays = {"nan": whole, "inf": vectors(device, _111=np.inf), "part": whole[1:], "large": vectors(device, _122=5)}
    strided = wp.array(np.arange(12, dtype=np.float32).reshape(3, 4), device=device)[:, 1:3]
    arrays["strided"] = strided
    assert find(arrays, dict.fromkeys(arrays, (-4.0, 4.0))) == ["nan", "inf", "large", "strided"]
    assert find({"strided": strided}, {"strided": (0.0, 10.0)}) == []  # 11 is not in the part


def test_a_string_in_an_expected_shape_stands_for_any_length():
    check.shape("positions", (2, 3, 3), (2, "vertex", 3))
    check.shape("positions", (2, 0, 3), (2, "vertex", 3))


@pytest.mark.parametrize("got", [(), (2, 3), (2, 4, 2), (1, 4, 3), (2, 3, 3, 1)])
def test_a_wrong_shape_is_named_with_the_expected_one(got):
    with pytest.raises(ValueError, match=r"^positions: got shape \(.*\), expected \[2, vertex, 3\]$"):
        check.shape("positions", got, (2, "vertex", 3))
