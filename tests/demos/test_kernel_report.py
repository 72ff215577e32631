"""The kernel report: what it reads of ptxas, and how many threads fit."""

import pytest
import warp as wp

from demos.tools import kernel_report
from demos.tools.kernel_report import Resources

REPORT = """\
ptxas info    : 154 bytes gmem
ptxas info    : Compiling entry function '_add_1234abcd_cuda_kernel_backward' for 'sm_90'
ptxas info    : Function properties for _add_1234abcd_cuda_kernel_backward
    232 bytes stack frame, 244 bytes spill stores, 248 bytes spill loads
ptxas info    : Used 255 registers, used 0 barriers, 232 bytes cumulative stack size, 1024 bytes smem
ptxas info    : Compile time = 17.938 ms
ptxas info    : Compiling entry function 'make__locals__add_1234abcd_cuda_kernel_forward' for 'sm_90'
ptxas info    : Function properties for helper
    8 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Function properties for make__locals__add_1234abcd_cuda_kernel_forward
    16 bytes stack frame, 4 bytes spill stores, 12 bytes spill loads
ptxas info    : Used 24 registers, used 0 barriers
"""


def test_a_report_of_ptxas_is_read_entry_by_entry():
    assert kernel_report.parse(REPORT) == [
        Resources("_add_1234abcd_cuda_kernel_backward", 255, 232, 244, 248, 1024),
        Resources("make__locals__add_1234abcd_cuda_kernel_forward", 24, 16, 4, 12, 0),
    ]
    assert kernel_report.parse("ptxas info    : 0 bytes gmem\n") == []


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


def test_without_an_assembler_the_report_says_what_to_install(monkeypatch):
    monkeypatch.setattr(kernel_report, "find_ptxas", lambda: None)
    with pytest.raises(SystemExit, match="pip install nvidia-cuda-nvcc"):
        kernel_report.main(90, 256)


def test_an_assembler_that_fails_is_quoted(tmp_path, monkeypatch):
    monkeypatch.setattr(kernel_report, "compile_ptx", lambda *arguments: [write(tmp_path / "a.ptx", "text\0")])
    refusing = write(tmp_path / "ptxas", "#!/bin/sh\necho Unsupported .version >&2\nexit 255\n")
    refusing.chmod(0o755)
    with pytest.raises(RuntimeError, match="ptxas: Unsupported .version"):
        kernel_report.assemble(refusing, None, 90)
    assert (tmp_path / "a.ptx").read_text() == "text"
    monkeypatch.setattr(kernel_report, "find_ptxas", lambda: refusing)
    with pytest.raises(SystemExit, match=r"Unsupported .version\n.*pip install -U nvidia-cuda-nvcc"):
        kernel_report.main(90, 256)


@pytest.mark.slow
def test_the_resources_of_a_module_are_found_by_the_assembler():
    ptxas = kernel_report.find_ptxas()
    if ptxas is None:
        pytest.skip("needs nvidia-cuda-nvcc")

    @wp.kernel(module="unique")
    def square(
        # in
        values: wp.array(dtype=float),
        # out
        squares: wp.array(dtype=float),
    ):
        """A thread owns a number."""
        thread = wp.tid()
        squares[thread] = values[thread] * values[thread]

    try:
        found = kernel_report.assemble(ptxas, square.module, 90)
    except RuntimeError as error:
        if "Unsupported .version" in str(error):
            pytest.skip(f"{ptxas} is older than Warp's PTX")
        raise
    assert [kernel_report.label("", resources.entry) for resources in found] == [", backward", ""]
    for resources in found:
        assert 8 <= resources.registers <= 48
        assert resources.spill_stores == resources.spill_loads == 0


def write(path, text):
    path.write_text(text)
    return path
