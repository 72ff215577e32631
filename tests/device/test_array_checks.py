"""Arrays on a device: which are refused, in which words, and how often a GPU would be waited for."""

import weakref

import numpy as np
import pytest
import warp as wp

from warpshadow.device import array_checks
from warpshadow.device.array_checks import finite_arrays, late_checks, look_at_values


def vectors(device, **spoiled):
    """An array of shape [2, 3] of vec3, and what is spoiled in it: the index in NumPy → a value."""
    values = np.linspace(-1, 1, 18, dtype=np.float32).reshape(2, 3, 3)
    for index, value in spoiled.items():
        values[tuple(int(i) for i in index[1:])] = value
    return wp.array(values, dtype=wp.vec3, device=device)


@pytest.fixture(params=["by the host", "by the device"])
def found(request, monkeypatch):
    """Arrays of a CPU are looked at by NumPy, and as those of a GPU are."""
    if request.param == "by the device":
        monkeypatch.setattr(array_checks, "_is_awaited", lambda device: True)


@pytest.mark.usefixtures("found")
def test_finite_arrays_of_any_type_pass(device):
    matrices = wp.zeros((4, 2), dtype=wp.mat33, device=device)
    nothing = wp.zeros((0, 5), dtype=wp.vec3, device=device)
    numbers = wp.full(7, 1e18, dtype=wp.float32, device=device)
    finite_arrays({"points": vectors(device), "matrices": matrices, "normals": None, "nothing": nothing})
    finite_arrays({"numbers": numbers}, nonnegative=["numbers"])
    finite_arrays({"numbers": numbers})


@pytest.mark.usefixtures("found")
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_the_first_array_that_is_not_finite_is_named_with_the_place(value, device):
    arrays = {"points": vectors(device), "normals": vectors(device, _120=value, _111=value), "centers": None}
    with pytest.raises(
        ValueError, match=r"^normals: got 2 NaN or Inf values \(first at index \(1, 1, 1\)\), expected finite"
    ):
        finite_arrays(arrays)


@pytest.mark.usefixtures("found")
def test_numbers_out_of_range_are_named_with_the_range(device):
    with pytest.raises(
        ValueError, match=r"^points: got 1 values out of range \(first at index \(0, 2, 1\): -3\), expected -2 to 2$"
    ):
        finite_arrays({"points": vectors(device, _021=-3)}, maximum=2.0)
    with pytest.raises(
        ValueError, match=r"^radii: got 9 values out of range \(first at index \(0, 0, 0\): -1\), expected 0 to 2$"
    ):
        finite_arrays({"points": vectors(device), "radii": vectors(device)}, maximum=2.0, nonnegative=["radii"])


@pytest.mark.usefixtures("found")
def test_parts_of_arrays_are_looked_at_alone(device):
    whole = vectors(device, _000=np.nan)
    strided = wp.array(np.arange(12, dtype=np.float32).reshape(3, 4), device=device)[:, 1:3]
    finite_arrays({"part": whole[1:], "strided": strided}, maximum=10.0)  # 11 is not in the part
    for name, array in {"whole": whole, "part": vectors(device, _122=5)[1:], "strided": strided}.items():
        with pytest.raises(ValueError, match=f"^{name}: "):
            finite_arrays({"good": vectors(device), name: array}, maximum=4.0)


@pytest.fixture
def reads(monkeypatch):
    """Shapes of the arrays that are read, where all are awaited as on a GPU."""
    shapes, numpy = [], wp.array.numpy
    monkeypatch.setattr(array_checks, "_is_awaited", lambda device: True)
    monkeypatch.setattr(wp.array, "numpy", lambda array: (shapes.append(array.shape), numpy(array))[1])
    return shapes


def test_a_call_reads_once_what_a_gpu_found_in_all_arrays(device, reads):
    arrays = [vectors(device) for _ in range(20)]
    for _ in range(2):
        with late_checks():
            for array in arrays:
                finite_arrays({"points": array, "again": array})
            with late_checks():
                finite_arrays({"radii": arrays[0]}, maximum=7.0)
            assert not reads
        assert len(reads) == 1
        reads.clear()


@pytest.mark.parametrize("number", [0, 7, 8, 19])
def test_a_call_ends_with_the_first_fault_that_a_gpu_found(number, device, reads):
    arrays = {f"points {index}": vectors(device) for index in range(20)}
    spoiled = dict.fromkeys([f"points {number}", "last"], vectors(device, _101=np.nan))

    def call():
        with late_checks():
            for name, array in {**arrays, **spoiled}.items():
                finite_arrays({name: array})
            look_at_values(arrays["points 0"], lambda values: pytest.fail("called after a fault"))

    for _ in range(2):
        with pytest.raises(ValueError, match=rf"^points {number}: got 1 NaN"):
            call()
    spoiled.clear()
    with late_checks():
        finite_arrays(arrays)


@pytest.mark.usefixtures("reads")
def test_a_fault_is_raised_in_place_of_the_error_that_it_leads_to(device):
    with pytest.raises(ValueError, match=r"^points: got 1 NaN"), late_checks():
        finite_arrays({"points": vectors(device, _000=np.nan)})
        raise RuntimeError("nothing fits")
    with pytest.raises(RuntimeError, match="nothing fits"), late_checks():
        finite_arrays({"points": vectors(device)})
        raise RuntimeError("nothing fits")


@pytest.mark.usefixtures("reads")
def test_a_long_call_does_not_hold_all_its_arrays(device):
    held = []
    with late_checks():
        for _ in range(500):
            array = vectors(device)
            held.append(weakref.ref(array))
            finite_arrays({"points": array})
        assert sum(reference() is not None for reference in held) < 100


@pytest.mark.usefixtures("found")
def test_values_are_judged_once(device):
    judged = []
    look_at_values(vectors(device), lambda values: judged.append(values.shape))
    with late_checks():
        look_at_values(vectors(device), lambda values: judged.append(values.shape))
    assert judged == [(2, 3, 3)] * 2
