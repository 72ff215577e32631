"""Argument checks: what passes, and what the message of a refusal says."""

import math
import re
import warnings
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


def test_a_missing_file_is_named_with_one_of_nearly_the_same_name(tmp_path):
    for name in ("scene.toml", "bunny.obj", "sky.exr"):
        (tmp_path / name).touch()
    for call, name in (
        (lambda: ws.load_scene(tmp_path / "scene.tml"), "scene.toml"),
        (lambda: ws.Body(tmp_path / "buny.obj"), "bunny.obj"),
        (lambda: ws.read_image(tmp_path / "skys.exr"), "sky.exr"),
    ):
        with pytest.raises(FileNotFoundError, match=rf"no such .* \(did you mean '{name}'\?\)$"):
            call()


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
        (lambda: ws.Body(ws.icosphere(), color=1), r"Body: unknown argument 'color' \(did you mean 'albedo'\?\)"),
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
