"""Argument checks: what passes, and what the message of a refusal says."""

import math
import re
import warnings
import weakref
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp

import warpshadow as ws
from warpshadow import check
from warpshadow.assets.mesh import MeshError
from warpshadow.torch import TorchRenderer


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


@pytest.fixture(params=["by the host", "by the device"])
def found(request, monkeypatch):
    """Arrays of a CPU are looked at by NumPy, and as those of a GPU are."""
    if request.param == "by the device":
        monkeypatch.setattr(check, "_is_awaited", lambda device: True)


@pytest.mark.usefixtures("found")
def test_finite_arrays_of_any_type_pass(device):
    matrices = wp.zeros((4, 2), dtype=wp.mat33, device=device)
    nothing = wp.zeros((0, 5), dtype=wp.vec3, device=device)
    numbers = wp.full(7, 1e18, dtype=wp.float32, device=device)
    check.finite_arrays({"points": vectors(device), "matrices": matrices, "normals": None, "nothing": nothing})
    check.finite_arrays({"numbers": numbers}, nonnegative=["numbers"])
    check.finite_arrays({"numbers": numbers})


@pytest.mark.usefixtures("found")
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_the_first_array_that_is_not_finite_is_named_with_the_place(value, device):
    arrays = {"points": vectors(device), "normals": vectors(device, _120=value, _111=value), "centers": None}
    with pytest.raises(
        ValueError, match=r"^normals: got 2 NaN or Inf values \(first at index \(1, 1, 1\)\), expected finite"
    ):
        check.finite_arrays(arrays)


@pytest.mark.usefixtures("found")
def test_numbers_out_of_range_are_named_with_the_range(device):
    with pytest.raises(
        ValueError, match=r"^points: got 1 values out of range \(first at index \(0, 2, 1\): -3\), expected -2 to 2$"
    ):
        check.finite_arrays({"points": vectors(device, _021=-3)}, maximum=2.0)
    with pytest.raises(
        ValueError, match=r"^radii: got 9 values out of range \(first at index \(0, 0, 0\): -1\), expected 0 to 2$"
    ):
        check.finite_arrays({"points": vectors(device), "radii": vectors(device)}, maximum=2.0, nonnegative=["radii"])


@pytest.mark.usefixtures("found")
def test_parts_of_arrays_are_looked_at_alone(device):
    whole = vectors(device, _000=np.nan)
    strided = wp.array(np.arange(12, dtype=np.float32).reshape(3, 4), device=device)[:, 1:3]
    check.finite_arrays({"part": whole[1:], "strided": strided}, maximum=10.0)  # 11 is not in the part
    for name, array in {"whole": whole, "part": vectors(device, _122=5)[1:], "strided": strided}.items():
        with pytest.raises(ValueError, match=f"^{name}: "):
            check.finite_arrays({"good": vectors(device), name: array}, maximum=4.0)


@pytest.fixture
def reads(monkeypatch):
    """Shapes of the arrays that are read, where all are awaited as on a GPU."""
    shapes, numpy = [], wp.array.numpy
    monkeypatch.setattr(check, "_is_awaited", lambda device: True)
    monkeypatch.setattr(wp.array, "numpy", lambda array: (shapes.append(array.shape), numpy(array))[1])
    return shapes


def test_a_call_reads_once_what_a_gpu_found_in_all_arrays(device, reads):
    arrays = [vectors(device) for _ in range(20)]
    for _ in range(2):
        with check.of_one_call():
            for array in arrays:
                check.finite_arrays({"points": array, "again": array})
            with check.of_one_call():
                check.finite_arrays({"radii": arrays[0]}, maximum=7.0)
            assert not reads
        assert len(reads) == 1
        reads.clear()


@pytest.mark.parametrize("number", [0, 7, 8, 19])
def test_a_call_ends_with_the_first_fault_that_a_gpu_found(number, device, reads):
    arrays = {f"points {index}": vectors(device) for index in range(20)}
    spoiled = dict.fromkeys([f"points {number}", "last"], vectors(device, _101=np.nan))

    def call():
        with check.of_one_call():
            for name, array in {**arrays, **spoiled}.items():
                check.finite_arrays({name: array})
            check.values_of(arrays["points 0"], lambda values: pytest.fail("called after a fault"))

    for _ in range(2):
        with pytest.raises(ValueError, match=rf"^points {number}: got 1 NaN"):
            call()
    spoiled.clear()
    with check.of_one_call():
        check.finite_arrays(arrays)


@pytest.mark.usefixtures("reads")
def test_a_fault_is_raised_in_place_of_the_error_that_it_leads_to(device):
    with pytest.raises(ValueError, match=r"^points: got 1 NaN"), check.of_one_call():
        check.finite_arrays({"points": vectors(device, _000=np.nan)})
        raise RuntimeError("nothing fits")
    with pytest.raises(RuntimeError, match="nothing fits"), check.of_one_call():
        check.finite_arrays({"points": vectors(device)})
        raise RuntimeError("nothing fits")


@pytest.mark.usefixtures("reads")
def test_a_long_call_does_not_hold_all_its_arrays(device):
    held = []
    with check.of_one_call():
        for _ in range(500):
            array = vectors(device)
            held.append(weakref.ref(array))
            check.finite_arrays({"points": array})
        assert sum(reference() is not None for reference in held) < 100


@pytest.mark.usefixtures("found")
def test_values_are_judged_once(device):
    judged = []
    check.values_of(vectors(device), lambda values: judged.append(values.shape))
    with check.of_one_call():
        check.values_of(vectors(device), lambda values: judged.append(values.shape))
    assert judged == [(2, 3, 3)] * 2


@pytest.mark.parametrize("value", [1, -2.5, np.float32(3), np.int64(4)])
def test_numbers_are_pythons_and_numpys(value):
    assert check.is_number(value)
    assert check.is_integer(value) == (value in (1, 4))


@pytest.mark.parametrize("value", [True, "1", None, math.nan, math.inf, 10**400, np.ones(1), (1,), np.True_])
def test_what_is_no_finite_number_is_none(value):
    assert not check.is_number(value)


@pytest.mark.parametrize("value", [True, 1.0, "1", None, np.float32(1)])
def test_what_is_no_integer_is_none(value):
    assert not check.is_integer(value)


@pytest.mark.parametrize("value", [-1, 2, 1.0, True, "1", None])
def test_the_number_of_a_thing_is_a_whole_one_that_there_is(value):
    check.index("body", np.int64(1), 2, "body")
    with pytest.raises(ValueError, match=f"^body: got {value!r}, expected the number of a body, from 0 to 1$"):
        check.index("body", value, 2, "body")


@pytest.mark.parametrize(
    ("value", "called"),
    [
        ("cow.obj", "'cow.obj'"),
        (Path("cow.obj"), "'cow.obj'"),
        (None, "None"),
        ((1, 2, 1), "(1, 2, 1)"),
        (dict, "the class dict"),
        ([0.5] * 99, "list of 99 items"),
        ("x" * 99, "'" + "x" * 59 + "…"),
        (np.zeros((2, 3), np.uint8), "ndarray of uint8 and shape (2, 3)"),
        (torch.zeros(2, 3), "Tensor of torch.float32 and shape (2, 3)"),
        (wp.zeros(2, dtype=wp.vec3), "array of vec3f and shape (2,)"),
        (pytest, "module"),
    ],
)
def test_a_message_quotes_what_is_short_and_describes_the_rest(value, called):
    with pytest.raises(ValueError, match=f"^mesh: got {re.escape(called)}, expected a set$"):
        check.instance("mesh", value, set, "a set")


def test_numbers_are_copied_from_whatever_holds_them():
    for values in ([[1, 2], [3, 4]], np.array([[1, 2], [3, 4]]), torch.tensor([[1.0, 2], [3, 4]])):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            copied = check.numbers("x", values)
        np.testing.assert_array_equal(copied, np.array([[1, 2], [3, 4]], np.float32))
        assert copied.dtype == np.float32 and not np.shares_memory(copied, np.asarray(values))
    assert np.isinf(check.numbers("x", 1e39))


@pytest.mark.parametrize("values", ["red", None, [[1, 2], [3]], {}, [None], True, 1j, torch.zeros(2).bfloat16()])
def test_what_holds_no_numbers_is_named(values):
    with pytest.raises(MeshError, match="^x: got .*, expected three numbers"):
        check.numbers("x", values, expected="three numbers", error=MeshError)


def test_a_tensor_whose_gradient_would_be_lost_is_refused():
    with pytest.raises(ValueError, match=r"^x: got Tensor of .* that requires a gradient.*\.detach\(\)"):
        check.numbers("x", torch.zeros(3, requires_grad=True))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int64])
def test_codes_of_a_picture_are_not_taken_for_light(dtype):
    with pytest.raises(ValueError, match=rf"^image: got values of {np.dtype(dtype)}, .*srgb_to_linear\(values / 255\)"):
        check.pixels("image", np.ones((2, 2, 3), dtype), expected="RGB")
    assert check.pixels("image", np.ones((2, 2, 3), np.float16), expected="RGB").dtype == np.float32


def test_a_device_is_warps_torchs_or_a_name(device):
    same = wp.get_device(device)
    assert check.device("device", device) == check.device("device", same) == same
    assert check.device("device", torch.device(device)) == same
    assert check.device("device", None) == wp.get_device()


@pytest.mark.parametrize("name", ["gpu", "cuda:99", "mps", 0, torch.device("meta")])
def test_a_device_that_is_not_there_is_refused_with_those_that_are(name, capfd):
    with pytest.raises(ValueError, match=f"^device: got '{name}', expected one of 'cpu'"):
        check.device("device", name)
    assert "error" not in "".join(capfd.readouterr()).lower()  # the driver's


def test_a_missing_file_is_named_with_the_folder_that_it_is_looked_for_in(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.obj").touch()
    assert check.file("mesh", "a.obj").is_file() and check.file("mesh", tmp_path / "a.obj").is_file()
    with pytest.raises(FileNotFoundError, match=rf"^mesh: no such file: b.obj \(in {re.escape(str(tmp_path))}\)$"):
        check.file("mesh", "b.obj")
    with pytest.raises(FileNotFoundError, match=f"^mesh: no such file: {re.escape(str(tmp_path / 'b.obj'))}$"):
        check.file("mesh", tmp_path / "b.obj")


def test_a_string_in_an_expected_shape_stands_for_any_length():
    check.shape("positions", (2, 3, 3), (2, "vertex", 3))
    check.shape("positions", (2, 0, 3), (2, "vertex", 3))


@pytest.mark.parametrize("got", [(), (2, 3), (2, 4, 2), (1, 4, 3), (2, 3, 3, 1)])
def test_a_wrong_shape_is_named_with_the_expected_one(got):
    with pytest.raises(ValueError, match=r"^positions: got shape \(.*\), expected \[2, vertex, 3\]$"):
        check.shape("positions", got, (2, "vertex", 3))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ws.Camera(eye=(0, 0, 1)), r"Camera: unknown argument 'eye' \(write Camera.look_at\(eye, target"),
        (lambda: ws.Body(ws.icosphere(), color=(1, 0, 0)), r"Body: unknown argument 'color' \(write albedo\)"),
        (lambda: ws.Body(ws.icosphere(), scal=2), r"Body: unknown argument 'scal' \(did you mean 'scale'\?\)"),
        (lambda: ws.render(None, bounces=2), r"render: unknown argument 'bounces' \(write Scene\(…, bounces=…\)\)"),
    ],
)
def test_an_unknown_keyword_names_what_is_meant(call, message):
    with pytest.raises(TypeError, match=f"^{message}"):
        call()


def test_a_warning_of_the_renderer_points_at_the_line_that_called_it():
    scene = ws.Scene([ws.Body(ws.icosphere(), blockers=0)], np.ones((4, 3)), ws.Camera.look_at((0, 0, 5), (0, 0, 9)))
    for render in (ws.render, lambda scene: TorchRenderer(scene)()):
        with pytest.warns(UserWarning, match="the image shows nothing") as caught:
            render(scene)
        assert caught[0].filename == __file__


def test_a_folder_that_begins_like_the_package_is_a_users():
    file = f"{Path(check.__file__).parent}_demo/mine.py"
    with pytest.warns(UserWarning, match="careful") as warned:
        exec(compile("check.warn('careful')", file, "exec"), {"check": check, "__name__": "mine"})
    assert warned[0].filename == file
