"""Memory: large arrays come in huge pages, where the system has them."""

import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from warpshadow.device.memory import in_huge_pages, require_gradient

SIZE = 2**24
SWITCH = Path("/sys/kernel/mm/transparent_hugepage/enabled")


def faults_of_writing(array: wp.array) -> int:
    resource = pytest.importorskip("resource", reason="counts page faults")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    array.numpy()[:] = 1
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux gives huge pages to who asks")
def test_writing_to_a_large_array_takes_fewer_page_faults():
    if not SWITCH.exists() or "[never]" in SWITCH.read_text():
        pytest.skip("this system gives no huge pages")
    small = faults_of_writing(wp.empty(SIZE, dtype=wp.float32, device="cpu"))
    assert faults_of_writing(in_huge_pages(wp.empty(SIZE, dtype=wp.float32, device="cpu"))) < small / 2


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
