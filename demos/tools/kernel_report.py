"""What a GPU has for each kernel of the package: registers, spills, shared memory, and how many threads fit at once.

    pip install nvidia-cuda-nvcc
    python demos/tools/kernel_report.py [--architecture 90] [--block 256]

It takes no GPU: Warp compiles each kernel to PTX, and ptxas, the assembler of that package, says what it takes. The
*occupancy* is the part of the threads that a streaming multiprocessor can hold which it holds of this kernel alone:
registers are what limits it here. Below a quarter, a kernel that waits for memory has too few others to go on with.
Kernels that a factory makes are named after it and its arguments, others after their files.
"""

import argparse
import importlib.metadata
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import warp as wp

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.tools.cuda_kernels import FACTORIES, compile_ptx, file_modules

WARP = 32

# An H100 or H200, compute capability 9.0: what a streaming multiprocessor has, and in what portions it gives that.
REGISTERS = 65536
REGISTERS_AT_ONCE = 256  # of a warp
WARPS_AT_ONCE = 4  # one for each of its schedulers
THREADS = 2048
BLOCKS = 32
SHARED = 228 * 1024
SHARED_AT_ONCE = 128
SHARED_OF_SYSTEM = 1024  # of each block


class Resources(NamedTuple):
    """What ptxas says of an entry of a module; all but the registers in bytes."""

    entry: str
    registers: int
    stack: int
    spill_stores: int
    spill_loads: int
    shared: int


_ENTRY = re.compile(
    r"Compiling entry function '(?P<entry>\w+)'.*?Function properties for (?P=entry)\s+"
    r"(?P<stack>\d+) bytes stack frame, (?P<stores>\d+) bytes spill stores, (?P<loads>\d+) bytes spill loads.*?"
    r"Used (?P<registers>\d+) registers(?P<rest>[^\n]*)",
    re.DOTALL,
)


def parse(report: str) -> list[Resources]:
    """Read what ``ptxas -v`` prints."""
    found = []
    for match in _ENTRY.finditer(report):
        shared = re.search(r"(\d+) bytes smem", match["rest"])
        numbers = (int(match[name]) for name in ("registers", "stack", "stores", "loads"))
        found.append(Resources(match["entry"], *numbers, int(shared[1]) if shared else 0))
    return found


def occupancy(registers: int, shared: int, block: int) -> float:
    """Part of a streaming multiprocessor's threads that blocks of a kernel can fill.

    Args:
        registers: Of a thread.
        shared: Memory of a block [bytes].
        block: Threads of a block.
    """
    warps = -(-block // WARP)
    registers_of_warp = _in_portions(max(registers, 1) * WARP, REGISTERS_AT_ONCE)
    warps_by_registers = REGISTERS // registers_of_warp // WARPS_AT_ONCE * WARPS_AT_ONCE
    by_shared = SHARED // _in_portions(shared + SHARED_OF_SYSTEM, SHARED_AT_ONCE)
    blocks = min(BLOCKS, THREADS // (warps * WARP), warps_by_registers // warps, by_shared)
    return blocks * warps * WARP / THREADS


def _in_portions(amount: int, portion: int) -> int:
    return -(-amount // portion) * portion


def find_ptxas() -> Path | None:
    """The assembler of the package nvidia-cuda-nvcc, or one on the path; None where there is neither."""
    try:
        files = importlib.metadata.files("nvidia-cuda-nvcc") or []
    except importlib.metadata.PackageNotFoundError:
        files = []
    packaged = [Path(str(file.locate())) for file in files if file.name == "ptxas"]
    on_path = shutil.which("ptxas")
    return next(iter([*packaged, *([Path(on_path)] if on_path else [])]), None)


def assemble(ptxas: Path, module: wp.Module, architecture: int) -> list[Resources]:
    """Compile a module and ask what its entries take.

    Raises:
        RuntimeError: with what ptxas says, as of PTX that is newer than it.
    """
    with tempfile.TemporaryDirectory() as folder:
        (ptx,) = compile_ptx(module, [architecture], Path(folder))
        ptx.write_bytes(ptx.read_bytes().rstrip(b"\0"))  # Warp ends it as C ends a string
        command = [ptxas, "-v", "--gpu-name", f"sm_{architecture}", ptx, "-o", ptx.with_suffix(".cubin")]
        run = subprocess.run(command, capture_output=True, text=True)
    if run.returncode:
        raise RuntimeError(f"{ptxas}: {run.stderr.strip()}")
    return sorted(parse(run.stderr))


def kernels() -> Iterator[tuple[str, wp.Module]]:
    """Names and modules of all kernels."""
    for name, make in FACTORIES.items():
        yield name.lstrip("_"), make().module
    for name, module in file_modules().items():
        yield name.removeprefix("warpshadow."), module


def label(module_name: str, entry: str) -> str:
    """What the table calls an entry of a module: name_hash_cuda_kernel_forward, or …_backward, to Warp."""
    match = re.fullmatch(r"(?P<kernel>\w+?)_[0-9a-f]{8}_cuda_kernel_(?P<pass>forward|backward)", entry)
    assert match, entry
    kernel = "" if "_locals_" in match["kernel"] else f".{match['kernel'].lstrip('_')}"  # the module is the factory's
    return f"{module_name}{kernel}" + (", backward" if match["pass"] == "backward" else "")


def main(architecture: int, block: int) -> None:
    ptxas = find_ptxas()
    if ptxas is None:
        raise SystemExit("ptxas is not installed: pip install nvidia-cuda-nvcc")
    ws.quiet()
    print(f"sm_{architecture}, blocks of {block} threads; spills, stack and shared memory in bytes\n")
    print("| kernel | registers | spills | stack | shared | occupancy |\n| --- | --- | --- | --- | --- | --- |")
    for name, module in kernels():
        try:
            found = assemble(ptxas, module, architecture)
        except RuntimeError as error:
            raise SystemExit(f"{error}\n(if it is older than Warp's PTX: pip install -U nvidia-cuda-nvcc)") from error
        for entry, registers, stack, stores, loads, shared in found:
            part = occupancy(registers, shared, block)
            spills = f"{stores} / {loads}"
            print(f"| {label(name, entry)} | {registers} | {spills} | {stack} | {shared} | {part:.0%} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--architecture", type=int, default=90, help="compute capability, 90 for 9.0")
    parser.add_argument("--block", type=int, default=256, help="threads of a block; Warp takes 256")
    arguments = parser.parse_args()
    main(arguments.architecture, arguments.block)
