"""What a GPU has for each kernel of the package: registers, stack, shared memory, and how many threads fit at once.

    python demos/tools/kernel_report.py [--architecture 90] [--block 256] [--only REGEX]

It takes no GPU: Warp compiles each kernel to machine code, a cubin, which says what it takes. The *stack* is memory of
a thread outside the registers: what is spilled, and what is indexed by a variable. The *occupancy* is the part of the
threads that a streaming multiprocessor can hold which it holds of this kernel alone: registers are what limits it here.
Below a quarter, a kernel that waits for memory has too few others to go on with. Kernels that a factory makes are named
after it and its arguments, others after their files.
"""

import argparse
import re
import struct
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import warp as wp

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.tools.cuda_kernels import FACTORIES, compile_module, file_modules

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


# A cubin is an ELF file of 64 bits whose section .nv.info has a record for each number of an entry.
SECTION_TABLE, SECTION_SIZE = 0x28, 0x3A
SYMBOL_SIZE = 24
RECORD_OF_SYMBOL = 4  # a record's format: the symbol and a number
REGISTER_COUNT, FRAME_SIZE = 0x2F, 0x11


class Budget(NamedTuple):
    """The most that an entry may take."""

    registers: int
    stack: int = 0  # [bytes]


BUDGETS = {
    "_make_transmit True False": {"": Budget(80)},
    # as many threads as with 112, and so of the lights below with 128: a skip of each span takes registers
    "_make_transmit_adjoint True False": {"": Budget(120)},
    "_make_transmit True True": {"": Budget(80)},
    "_make_transmit_adjoint True True": {"": Budget(128)},
    "_make_light": {"": Budget(128)},
    "_make_light_adjoint": {"": Budget(168)},
    "_make_accumulate 8 True": {"": Budget(96)},
    # the stack is that of vectors of eight bands, which loops index
    "_make_accumulate_adjoint 8 True": {"": Budget(128, 2 * 4 * 8)},
    "_make_gather": {"": Budget(64)},
    "_make_gather_adjoint": {"": Budget(80)},
    "warpshadow.stages.self_visibility.lookup": {"find_weights": Budget(56), "find_weights_adjoint": Budget(64)},
    "warpshadow.stages.planes.coverage": {"find_coverage": Budget(112), "find_coverage_adjoint": Budget(200)},
    "warpshadow.stages.bounces.plane_light": {"light_receivers": Budget(160), "light_receivers_adjoint": Budget(200)},
}
"""Of kernels of visibility, by the name of a factory's kernel, or of a file and its kernels: compiling a file takes
long, so tests do it for sm_90 alone."""


class Resources(NamedTuple):
    """What an entry of a cubin takes."""

    entry: str
    registers: int  # of a thread
    stack: int  # of a thread [bytes]
    shared: int  # memory of a block [bytes]


def read_cubin(cubin: bytes) -> list[Resources]:
    """Read what the entries of a cubin take, by name."""
    (table,) = struct.unpack_from("<Q", cubin, SECTION_TABLE)
    size, count, names_at = struct.unpack_from("<HHH", cubin, SECTION_SIZE)
    headers = [struct.unpack_from("<IIQQQQII", cubin, table + k * size) for k in range(count)]

    def text(strings: int, at: int) -> str:
        begin = headers[strings][4] + at
        return cubin[begin : cubin.index(b"\0", begin)].decode()

    sections = {text(names_at, header[0]): header for header in headers}
    _, _, _, _, begin, length, strings, _ = sections[".symtab"]
    symbols = [text(strings, *struct.unpack_from("<I", cubin, begin + at)) for at in range(0, length, SYMBOL_SIZE)]
    _, _, _, _, at, length, _, _ = sections[".nv.info"]
    numbers: dict[int, dict[str, int]] = {REGISTER_COUNT: {}, FRAME_SIZE: {}}
    end = at + length
    while at < end:
        kind, attribute, size = struct.unpack_from("<BBH", cubin, at)
        if kind == RECORD_OF_SYMBOL and attribute in numbers:
            symbol, number = struct.unpack_from("<II", cubin, at + 4)
            numbers[attribute][symbols[symbol]] = number
        at += 4 + (size if kind == RECORD_OF_SYMBOL else 0)
    return [
        Resources(entry, registers, numbers[FRAME_SIZE][entry], sections.get(f".nv.shared.{entry}", [0] * 6)[5])
        for entry, registers in sorted(numbers[REGISTER_COUNT].items())
    ]


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


def resources(module: wp.Module, architectures: list[int]) -> list[list[Resources]]:
    """Compile a module, and read what its entries take on each architecture."""
    with tempfile.TemporaryDirectory() as folder:
        cubins = compile_module(module, architectures, Path(folder), to_cubin=True)
        return [read_cubin(cubin.read_bytes()) for cubin in cubins]


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


def main(architecture: int, block: int, only: str) -> None:
    ws.quiet()
    print(f"sm_{architecture}, blocks of {block} threads; stack and shared memory in bytes\n")
    print("| kernel | registers | stack | shared | occupancy |\n| --- | --- | --- | --- | --- |")
    for name, module in kernels():
        if re.search(only, name):
            (found,) = resources(module, [architecture])
            for entry, registers, stack, shared in found:
                part = occupancy(registers, shared, block)
                print(f"| {label(name, entry)} | {registers} | {stack} | {shared} | {part:.0%} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--architecture", type=int, default=90, help="compute capability, 90 for 9.0")
    parser.add_argument("--block", type=int, default=256, help="threads of a block; Warp takes 256")
    parser.add_argument("--only", default="", help="only kernels whose name this finds")
    arguments = parser.parse_args()
    main(arguments.architecture, arguments.block, arguments.only)
