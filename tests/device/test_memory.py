"""Memory: large arrays come in huge pages, where the system has them."""

import mmap
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from warpshadow.device.memory import in_huge_pages, require_gradient

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
