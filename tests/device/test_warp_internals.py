"""What Warp does not call public works as it did, all that we use of it, and no other file uses any."""

import os
import re
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from packaging.requirements import Requirement

from warpshadow.device import warp_internals
from warpshadow.device.workers import run_tasks

ROOT = Path(__file__).resolve().parents[2]

INTERNAL = re.compile(
    r"(?<![\w.])(wp|warp)\._[a-z]\w*|\b_(wp_scalar_type|shape)_\b|\bfwd_args\b|\buser_modules\b|\._ref\b"
)
"""Names of Warp's that are not public, of those that have been used."""


@wp.kernel(enable_backward=False)
def _count_up(first: int, values: wp.array(dtype=wp.int32)):
    values[first + wp.tid()] = first


def a_thread_has_a_tape_of_its_own():
    outer, inner, seen = wp.Tape(), wp.Tape(), []
    with outer:
        with warp_internals.thread_tape(inner):
            other = threading.Thread(target=lambda: seen.append(warp_internals.current_tape()))
            other.start()
            other.join()
            wp.launch(_count_up, dim=1, inputs=[0], outputs=[wp.zeros(1, dtype=wp.int32, device="cpu")], device="cpu")
            assert warp_internals.current_tape() is inner
        assert warp_internals.current_tape() is outer and seen == [outer]
    assert warp_internals.current_tape() is None
    assert len(inner.launches) == 1 and not outer.launches


@wp.struct
class _Scaled:
    values: wp.array(dtype=wp.float32)
    factor: float


@wp.kernel
def _fill(
    first: int,
    is_shifted: bool,
    offset: wp.vec3,
    scaled: _Scaled,
    missing: wp.array(dtype=wp.float32),
    results: wp.array2d(dtype=wp.float32),
):
    row, column = wp.tid()
    value = scaled.factor * scaled.values[row] + offset[column]
    if is_shifted:
        value += float(first)
    if not missing:
        results[row, column] = value


def _filled(launch) -> tuple[np.ndarray, np.ndarray]:
    """Results of a launch of a kernel with arguments of all kinds, and a gradient by its adjoint."""
    scaled = _Scaled()
    scaled.values = wp.array([1.0, 2.0, 4.0], dtype=wp.float32, device="cpu", requires_grad=True)
    scaled.factor = 0.5
    results = wp.empty((3, 2), dtype=wp.float32, device="cpu", requires_grad=True)
    arguments = [7, True, wp.vec3(10.0, 20.0, 30.0), scaled, None, results]
    launch(arguments, None)
    results.grad.assign(np.arange(6).reshape(3, 2))
    gradient = wp.Tape().get_adjoint(scaled)
    launch(arguments, [None, None, None, gradient, None, results.grad])
    return results.numpy(), scaled.values.grad.numpy()


def kernels_take_their_arguments_as_warp_passes_them():
    device = wp.get_device("cpu")

    def by_warp(arguments, gradients):
        options = {} if gradients is None else {"adj_inputs": gradients, "adjoint": True}
        wp.launch(_fill, dim=(3, 2), inputs=arguments, device=device, **options)

    def directly(arguments, gradients):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(wp, "launch", None)
            warp_internals.bound_kernel(_fill, arguments, device, gradients=gradients)((3, 2))

    expected, found = _filled(by_warp), _filled(directly)
    assert expected[0].tolist() == [[17.5, 27.5], [18, 28], [19, 29]] and expected[1].tolist() == [0.5, 2.5, 4.5]
    assert all(map(np.array_equal, expected, found))


@wp.struct
class _Record:
    missing: wp.array2d(dtype=wp.vec3)
    scaled: _Scaled
    is_shifted: bool
    offset: wp.vec3
    values: wp.array(dtype=wp.float32)


def structs_are_as_if_their_fields_were_set():
    values = wp.zeros(3, dtype=wp.float32, device="cpu", requires_grad=True)
    scaled = warp_internals.struct_of(_Scaled, values=values, factor=0.5)
    fields = {"missing": None, "scaled": scaled, "is_shifted": True, "offset": wp.vec3(1, 2, 3), "values": values}
    expected, found = _Record(), warp_internals.struct_of(_Record, **fields)
    for name, value in fields.items():
        setattr(expected, name, value)
    assert bytes(found.__ctype__()) == bytes(expected.__ctype__())
    assert found._values_grad is values.grad and found.scaled.values is values and found.missing is None
    for wrong in ({"values": None}, {"values": values, "factor": 1.0, "other": 2.0}, {"values": 1, "factor": 1.0}):
        with pytest.raises(TypeError):
            warp_internals.struct_of(_Scaled, **wrong)


def a_module_that_was_unloaded_is_loaded_again():
    values = wp.zeros(4, dtype=wp.int32, device="cpu")
    for first in (1, 2):
        warp_internals.bound_kernel(_count_up, [first, values], wp.get_device("cpu"))((2,))
        _count_up.module.unload()
    assert values.numpy().tolist() == [0, 1, 2, 2]


def arguments_of_a_wrong_type_are_refused():
    values = wp.zeros(3, dtype=wp.float32, device="cpu")
    for arguments in ([0, values], [0, wp.zeros((3, 1), dtype=wp.int32, device="cpu")], [0.5, "text"], [0]):
        with pytest.raises(RuntimeError, match="Error launching kernel"):
            warp_internals.bound_kernel(_count_up, arguments, wp.get_device("cpu"))((3,))
    assert not values.numpy().any()


def a_dtype_says_of_what_its_items_are():
    shapes = {wp.float32: (), wp.vec3: (3,), wp.mat44: (4, 4), wp.types.vector(length=6, dtype=wp.float32): (6,)}
    for dtype, shape in shapes.items():
        assert warp_internals.item_shape(dtype) == shape and warp_internals.scalar_type(dtype) is wp.float32
    assert warp_internals.scalar_type(wp.vec3i) is wp.int32


@wp.struct
class _Arrays:
    colors: wp.array2d(dtype=wp.vec3)
    indices: wp.array(dtype=wp.int32)


def a_struct_says_of_what_its_arrays_are():
    assert warp_internals.field_dtype(_Arrays, "colors") is wp.vec3
    assert warp_internals.field_dtype(_Arrays, "indices") is wp.int32


def views_know_that_they_are_views():
    whole = wp.zeros((4, 2), dtype=wp.float32, device="cpu")
    assert warp_internals.viewed_array(whole) is None
    assert all(warp_internals.viewed_array(view) is whole for view in (whole[1:], whole.reshape((8,))))


def modules_list_their_kernels():
    module = warp_internals.kernel_modules()[__name__]
    assert any("_count_up" in str(key) for key in module.kernels)


def a_module_that_two_processes_need_is_compiled_once():
    with tempfile.TemporaryDirectory() as folder:
        ended = [*run_tasks(_compiles, [folder, folder], workers=2)]
        assert sorted(result for _, result, _ in ended) == [[False], [True]], ended
        assert not [*Path(folder).glob("*.lock")]


def _compiles(folder):
    """Launch a kernel that is not in the cache, as another process does; whether its module was compiled here."""
    compile_or_wait, was_compiled = wp.Module._compile, []
    wp.Module._compile = lambda *args, **options: was_compiled.append(compile_or_wait(*args, **options))
    wp.config.kernel_cache_dir = folder
    Path(folder, str(os.getpid())).touch()
    while len([*Path(folder).glob("[0-9]*")]) < 2:
        time.sleep(0.01)
    wp.launch(_count_up, dim=1, inputs=[0], outputs=[wp.zeros(1, dtype=wp.int32, device="cpu")], device="cpu")
    return was_compiled


def check(works):
    """Run a check; that it fails is a fault of the Warp that is installed."""
    try:
        works()
    except Exception as error:
        what = works.__name__.replace("_", " ")
        pytest.fail(f"Warp {wp.__version__} breaks device/warp_internals.py, where {what}: {error!r}")


@pytest.mark.parametrize(
    "works",
    [
        a_thread_has_a_tape_of_its_own,
        kernels_take_their_arguments_as_warp_passes_them,
        structs_are_as_if_their_fields_were_set,
        a_module_that_was_unloaded_is_loaded_again,
        arguments_of_a_wrong_type_are_refused,
        a_dtype_says_of_what_its_items_are,
        a_struct_says_of_what_its_arrays_are,
        views_know_that_they_are_views,
        modules_list_their_kernels,
        pytest.param(a_module_that_two_processes_need_is_compiled_once, marks=pytest.mark.slow),
    ],
)
def test_the_installed_warp_works_as_those_before(works):
    check(works)


def test_a_warp_that_does_not_is_named(monkeypatch):
    monkeypatch.delattr(warp_internals, "item_shape")
    with pytest.raises(pytest.fail.Exception, match=f"Warp {re.escape(wp.__version__)} breaks .* of what its items"):
        check(a_dtype_says_of_what_its_items_are)


def test_no_other_file_uses_internals_of_warp():
    own = {Path(warp_internals.__file__).resolve(), Path(__file__).resolve()}
    files = [path for folder in ("warpshadow", "demos", "tests") for path in (ROOT / folder).rglob("*.py")]
    found = [
        f"{path.relative_to(ROOT)}: {match.group()}"
        for path in files
        if path.resolve() not in own
        for match in INTERNAL.finditer(path.read_text(encoding="utf-8"))
    ]
    assert len(files) > 100 and not found


def test_no_release_of_warp_is_accepted_that_was_not_tested():
    """The pinned release is the last that pyproject.toml accepts; it goes up with it."""
    pattern = r'"?(warp-lang[^"\n;]+)'
    accepted, pinned = (
        Requirement(re.search(pattern, (ROOT / name).read_text(encoding="utf-8")).group(1)).specifier
        for name in ("pyproject.toml", "constraints.txt")
    )
    (version,) = (each.version for each in pinned)
    major, minor, _ = map(int, version.split("."))
    assert accepted.contains(version) and accepted.contains(wp.__version__)
    assert not accepted.contains(f"{major}.{minor + 1}.0")
