"""The kernel report: what it reads of cubins, how many threads fit, and the budgets of the kernels of visibility."""

import pytest
import warp as wp

from demos.tools import kernel_report
from demos.tools.cuda_kernels import FACTORIES, file_modules
from demos.tools.kernel_report import BUDGETS

ARCHITECTURES = [75, 90]  # the oldest and the newest: each compiles anew


@pytest.mark.parametrize(
    ("registers", "shared", "block", "expected"),
    [
        (32, 0, 256, 1.0),
        (33, 0, 256, 0.75),  # 40 registers a thread are given out: 51 warps, 48 on four schedulers, 6 blocks
        (64, 0, 256, 0.5),
        (65, 0, 256, 0.375),  # 28 warps are 3 blocks
        (168, 0, 256, 0.125),
        (168, 0, 128, 0.1875),  # smaller blocks waste less
        (255, 0, 256, 0.125),
        (255, 0, 512, 0.0),  # 8 warps fit: no block of 16
        (16, 0, 32, 0.5),  # 32 blocks at most
        (32, 100 * 1024, 256, 0.25),  # two blocks of 101 KiB
    ],
)
def test_blocks_fit_as_long_as_registers_shared_memory_and_threads_last(registers, shared, block, expected):
    assert kernel_report.occupancy(registers, shared, block) == expected


def test_entries_are_called_after_their_files_or_factories_and_passes():
    assert kernel_report.label("raster", "_snap_4a5184fe_cuda_kernel_forward") == "raster.snap"
    assert kernel_report.label("film", "_average_4a5184fe_cuda_kernel_backward") == "film.average, backward"
    entry = "_copy_kernel__locals__copy_0123abcd_cuda_kernel_backward"
    assert kernel_report.label("copy_kernel vec3f", entry) == "copy_kernel vec3f, backward"


@pytest.mark.slow
def test_what_a_kernel_takes_stands_in_its_cubin():
    Indexed = wp.types.vector(length=32, dtype=wp.float32)

    @wp.kernel(module="unique", enable_backward=False)
    def pick(
        # in
        values: wp.array(dtype=float),
        indices: wp.array(dtype=int),
        # out
        picked: wp.array(dtype=float),
    ):
        """A thread owns a number."""
        thread = wp.tid()
        indexed = Indexed()
        for k in range(indices.shape[0]):
            indexed[indices[k]] = values[thread] * indexed[indices[k + 1]]
        picked[thread] = indexed[indices[thread]]

    ((found,),) = kernel_report.resources(pick.module, [75])
    assert kernel_report.label("", found.entry) == ""
    assert found.stack == 32 * 4  # the vector, which registers cannot hold
    assert 8 <= found.registers <= 48


@pytest.mark.slow
@pytest.mark.parametrize("name", BUDGETS)
def test_kernels_of_visibility_stay_in_registers(name):
    module = FACTORIES[name]().module if name in FACTORIES else file_modules()[name]
    architectures = ARCHITECTURES if name in FACTORIES else ARCHITECTURES[-1:]  # compiling a file takes long
    for architecture, found in zip(architectures, kernel_report.resources(module, architectures), strict=True):
        taken = {kernel_report.label("", resources.entry).lstrip("."): resources for resources in found}
        for kernel, budget in BUDGETS[name].items():
            assert taken[kernel].registers <= budget.registers, f"sm_{architecture}: {taken[kernel]}"
            assert taken[kernel].stack <= budget.stack, f"sm_{architecture}: {taken[kernel]}"
