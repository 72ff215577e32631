"""Memory: new arrays are as Warp makes them, and large ones come in huge pages, where the system has them."""

import contextlib
import itertools
import mmap
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

import warpshadow as ws
from warpshadow.device import memory
from warpshadow.device.memory import in_huge_pages, require_gradient
from warpshadow.device.tape import recorded
from warpshadow.device.warp_internals import check_strides
from warpshadow.pipeline import renderer as renderer_module

SIZE = 2**24
MAPPINGS = Path("/proc/self/smaps")


def flags_at(address: int) -> list[str]:
    """What the system was told about the memory at an address."""
    flags: list[str] = []
    for line in MAPPINGS.read_text().splitlines():
        first, dash, rest = line.partition("-")
        if dash and " " in rest and ":" not in first:
            is_there = int(first, 16) <= address < int(rest.split()[0], 16)
        elif line.startswith("VmFlags:") and is_there:
            flags = line.split()[1:]
    return flags


@pytest.mark.skipif(not MAPPINGS.exists(), reason="Linux says what it was told about memory")
@pytest.mark.parametrize("is_asked", [False, True])
def test_huge_pages_are_asked_for(is_asked):
    memory = np.frombuffer(mmap.mmap(-1, 4 * SIZE), np.float32)  # new: what others have freed may have been asked for
    array = wp.array(memory, dtype=wp.float32, device="cpu", copy=False)
    if is_asked:
        in_huge_pages(array)
    assert ("hg" in flags_at(array.ptr + 2 * SIZE)) == is_asked


@pytest.mark.parametrize("size", [3, SIZE // 8])
def test_a_gradient_is_zero_and_belongs_to_its_array(size, device):
    array = wp.empty((1, size), dtype=wp.vec3, device=device)
    require_gradient(array)
    assert array.requires_grad and array.grad.shape == array.shape
    assert not array.grad.numpy().any()
    kept = array.grad
    require_gradient(array)
    assert array.grad is kept


def test_memory_that_is_asked_for_holds_what_is_written(device):
    values = np.arange(SIZE // 8, dtype=np.float32)
    array = in_huge_pages(wp.empty(values.shape, dtype=wp.float32, device=device))
    array.assign(values)
    np.testing.assert_array_equal(array.numpy(), values)


@pytest.mark.parametrize("shape", [5, (3, 4), (2, 0, 3)])
@pytest.mark.parametrize("dtype", [wp.float32, wp.vec3, wp.int32])
def test_new_arrays_are_as_warp_makes_them(device, shape, dtype):
    made, warps = memory.empty(shape, dtype, device), wp.empty(shape, dtype, device=device)
    hidden = ("ptr", "ctype", "deleter", "_array_interface", "_storage_base_ptr")
    assert vars(made).keys() == vars(warps).keys()
    assert all(getattr(made, name) == getattr(warps, name) for name in vars(warps) if name not in hidden)
    assert not memory.zeros(shape, dtype, device).numpy().any()
    again = memory.empty(shape, dtype, device)
    assert not made.size or made.ptr != again.ptr


def test_arrays_have_a_copy_of_numpys_values(device):
    values = np.arange(24.0).reshape(2, 4, 3)
    array = memory.from_numpy(values, wp.vec3, device)
    values[:] = 0
    assert array.shape == (2, 4) and array.numpy().ravel().tolist() == [*range(24)]


def test_views_share_values_and_gradients_and_hold_the_memory(device):
    array = memory.from_numpy(np.arange(24.0).reshape(2, 4, 3), wp.vec3, device)
    memory.require_gradient(array)
    view = memory.reshaped(array, (-1,))
    view.grad.fill_(2.0)
    assert view.shape == (8,) and view.requires_grad and (array.grad.numpy() == 2).all()
    del array
    assert view.numpy().ravel().tolist() == [*range(24)]
    with pytest.raises(RuntimeError):
        memory.reshaped(view, (7,))


@pytest.mark.parametrize("shape", [(2, 2**29), (2, 2**20, 1024), (3, 2**30, 1, 1)])
def test_arrays_beyond_the_reach_of_strides_are_refused(shape, device):
    """Warp's are int32: kernels would write elsewhere. Nothing is allocated."""
    with pytest.raises(MemoryError, match=r"fewer directions"):
        memory.empty(shape, wp.float32, device)


@pytest.mark.parametrize("shape", [(2, 2**29 - 1), (1, 2**20, 1024), (2**30,), (2**30, 1), (2, 2**29, 0)])
def test_arrays_whose_items_strides_reach_may_be_larger(shape):
    check_strides(shape, wp.float32)


def test_gradients_of_a_recording_are_parts_of_a_block_that_is_zeroed_at_once(device, monkeypatch):
    sets, zero = [], wp.array.zero_
    monkeypatch.setattr(wp.array, "zero_", lambda array: (sets.append(array.size), zero(array))[1])
    shapes = [(3, 7), (1, SIZE // 64), (5,), (2, 400)]  # the first is of no other test

    def gradients():
        sets.clear()
        arrays = [memory.empty(shape, wp.vec3, device) for shape in shapes]
        with recorded():
            for array in arrays:
                require_gradient(array)
        return [array.grad for array in arrays]

    first = gradients()
    assert len(sets) > 1  # nobody knew how much there would be
    for gradient in first:
        gradient.fill_(1.0)
    second = gradients()
    assert len(sets) == 1
    spans = sorted((gradient.ptr, gradient.ptr + gradient.size * 12) for gradient in second)
    assert all(end <= begin for (_, end), (begin, _) in itertools.pairwise(spans))
    for gradient, shape in zip(second, shapes, strict=True):
        assert gradient.shape == shape and not gradient.numpy().any()


def test_scratch_memory_is_zero_in_recordings_and_outside(device):
    for context in (contextlib.nullcontext, recorded):
        with context():
            scratch = memory.zeros((4, 5), wp.int64, device, outlives_recording=False)
            assert scratch.shape == (4, 5) and scratch.dtype is wp.int64 and not scratch.numpy().any()
            scratch.fill_(3)  # of which others see nothing
            assert not memory.zeros((4, 5), wp.int64, device, outlives_recording=False).numpy().any()


@pytest.mark.parametrize(
    ("is_cuda", "is_enabled", "before", "after"),
    [(True, True, 0, 2**30), (True, True, 5, 5), (True, False, 0, 0), (False, True, 0, 0)],
)
def test_a_gpus_memory_pool_keeps_freed_memory_unless_it_was_told_how_much(
    is_cuda, is_enabled, before, after, monkeypatch
):
    thresholds = [before]
    monkeypatch.setattr(wp, "is_mempool_enabled", lambda device: is_enabled)
    monkeypatch.setattr(wp, "get_mempool_release_threshold", lambda device: thresholds[-1])
    monkeypatch.setattr(wp, "set_mempool_release_threshold", lambda device, threshold: thresholds.append(threshold))
    memory.keep_pool(SimpleNamespace(is_cuda=is_cuda))
    assert thresholds[-1] == after


def test_a_renderer_keeps_the_pool_of_its_device(device, monkeypatch):
    devices = []
    monkeypatch.setattr(renderer_module, "keep_pool", devices.append)
    scene = ws.Scene([ws.Body(ws.plane(2.0))], ws.synthetic_sky())
    renderer_module.SceneRenderer(scene, device=device)
    assert devices == [wp.get_device(device)]
