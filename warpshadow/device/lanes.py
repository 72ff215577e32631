"""Lanes: how one thread works on several receivers at once.

A thread owns a *block* of receivers and holds each quantity as one vector with a lane for every receiver: as many as a
vector register has floats on a CPU, where Warp runs a kernel one thread after another and one receiver would leave the
vector units idle; 1 on a GPU, where threads play that part. Arrays that stages hand on stay [batch, receiver, …];
vectors of lanes fill scratch memory, and arrays that one stage stores for its adjoint. A block that runs past the last
receiver repeats it, and writes it once.

Small functions on structs are inlined by force. Otherwise LLVM calls them, and copies the structs through memory:
kernels of visibility take 1.1 to 1.35 times as long.

How wide registers are is asked of the LLVM that compiles the kernels; for some CPUs it prefers narrower ones than there
are, so the width is among the flags. README.md beside this file has the times of other widths.
"""

import contextlib
import functools
import os
import sys
from typing import Any, NamedTuple

import warp as wp

from warpshadow import check
from warpshadow.device.memory import as_items
from warpshadow.device.parallel import split_row
from warpshadow.maths.directions import CHUNK

LANES_VARIABLE = "WARPSHADOW_LANES"
BITS_VARIABLE = "WARPSHADOW_VECTOR_BITS"
"""Environment variables: lanes, and bits of a vector register, instead of the CPU's own."""

LANE_COUNTS = (1, 2, 4, 8, 16)
REGISTER_BITS = (128, 256, 512)

Chunk = wp.types.vector(length=CHUNK, dtype=wp.float32)
"""Coefficients of one receiver that reach the vector units together."""

_FLOAT_BITS = 32

_HOST_FLAG = "-march=native"

_WHOLE_LOOPS = ("-fno-unroll-loops", "-fno-slp-vectorize")
"""Flags that leave loops alone, so that one over lanes becomes a vector instruction.

A loop that the compiler unrolls is vectorized again only in part: on a Zen 4, 16 lanes take 1.2 to 1.7 times as long.
But a loop wider than a register has to be unrolled: otherwise its values stay in memory, and it takes four to eight
times as long.
"""


@functools.cache
def _diagnostics() -> dict[str, Any]:
    """Warp's report about the machine; empty where it fails."""
    try:
        with contextlib.redirect_stdout(None):
            report = wp.print_diagnostics()
            return report | {"cpu_features": frozenset(report.get("cpu_features", ()))}
    except Exception:  # nothing but speed depends on it
        return {}


def cpu_name() -> str:
    """LLVM's name of the CPU that kernels are compiled for."""
    return _diagnostics().get("cpu_name", "unknown")


def _cpu_features() -> frozenset[str]:
    """CPU features that LLVM detects, by its names; empty where Warp does not tell."""
    return _diagnostics().get("cpu_features", frozenset())


def _own_flags() -> str:
    """Warp's flags for all CPU kernels, which a module's own flags replace."""
    flags = getattr(wp.config, "cpu_compiler_flags", None)
    return _HOST_FLAG if flags is None else flags


def _from_environment(name: str, choices: tuple[int, ...]) -> int | None:
    """Parse an environment variable; None if it is unset or empty.

    Raises:
        ValueError: for a value that is not among the choices.
    """
    text = os.environ.get(name)
    if not text:
        return None
    check.choice(name, text, map(str, choices))
    return int(text)


def register_bits() -> int:
    """Width of the vector registers that kernels with lanes are compiled for [bits]."""
    forced_bits = _from_environment(BITS_VARIABLE, REGISTER_BITS)
    if forced_bits is not None:
        return forced_bits
    features = _cpu_features() if _HOST_FLAG in _own_flags().split() else frozenset()
    return 512 if "avx512f" in features else 256 if "avx" in features else 128


def lane_count(device: wp.DeviceLike) -> int:
    """Receivers of one thread: a vector register's worth on a CPU, one on a GPU."""
    if not wp.get_device(device).is_cpu:
        return 1
    return _from_environment(LANES_VARIABLE, LANE_COUNTS) or register_bits() // _FLOAT_BITS


def compiler_flags(lanes: int) -> str:
    """The compiler's flags for CPU kernels with a number of lanes.

    Loops over lanes that fit a register are not unrolled, nor are loops over bands, of which there are 8 at most.
    Elsewhere Warp's own flags unroll them: with registers of 128 bits they are up to twice as fast.
    """
    flags, bits = _own_flags(), register_bits()
    if _HOST_FLAG not in flags.split():
        return flags  # for any CPU of the kind
    is_whole = lanes * _FLOAT_BITS <= bits and bits >= 8 * _FLOAT_BITS
    base, loops = (_HOST_FLAG, _WHOLE_LOOPS) if is_whole else (flags, ())
    return _accepted_flags(base, (*loops, f"-mprefer-vector-width={bits}"))


@functools.cache
def _accepted_flags(base: str, flags: tuple[str, ...]) -> str:
    """Join flags, and leave out flags that the compiler refuses, with a warning."""
    if _builds(" ".join((base, *flags))):
        return " ".join((base, *flags))
    refused_flags = [flag for flag in flags if not _builds(f"{base} {flag}")]
    message = f"Warp's compiler refuses {' '.join(refused_flags)}: kernels are built without, and may be slow"
    check.warn(message)
    return " ".join((base, *(flag for flag in flags if flag not in refused_flags)))


def _make_empty(flags: str) -> wp.Kernel:
    @wp.kernel(module="unique", module_options={"cpu_compiler_flags": flags}, enable_backward=False)
    def do_nothing():
        """Only the compiler's output matters."""

    return do_nothing


def _builds(flags: str) -> bool:
    """Whether a CPU kernel can be built with flags. Warp caches builds, so the next time is quick."""
    try:
        wp.launch(_make_empty(flags), dim=1, device="cpu", record_tape=False)
    except Exception:  # Warp raises no other
        return False
    return True


def module_options(lanes: int) -> dict[str, Any]:
    """Options of modules whose kernels loop over lanes.

    Unrolled by Warp, such loops take ten times as long to compile.
    """
    return {"max_unroll": 1} | ({"cpu_compiler_flags": compiler_flags(lanes)} if lanes > 1 else {})


def use_vector_registers(module_name: str, device: wp.Device) -> None:
    """Give the kernels on chunks of a Python module the flags that follow a CPU, before the first is built.

    Importing the module does not ask for the CPU: that starts Warp.
    """
    if device.is_cpu:
        _set_vector_options(module_name)


@functools.cache
def _set_vector_options(module_name: str) -> None:
    wp.set_module_options(module_options(CHUNK), sys.modules[module_name])


def block_count(receiver_count: int, lanes: int) -> int:
    """Blocks, and so threads, that ``receiver_count`` receivers take."""
    return -(-receiver_count // lanes)


def sector_count(device: wp.Device, direction_count: int) -> int:
    """Threads of a block of receivers, a *sector* of directions each: on a CPU one, so that a cone is found once."""
    return 1 if device.is_cpu else direction_count // CHUNK


@functools.cache
def lane_type(lanes: int) -> type:
    """Vector of float32 with a lane for each receiver of a thread."""
    return wp.types.vector(length=lanes, dtype=wp.float32)


@functools.cache
def vectors_type(lanes: int) -> Any:
    """Struct of the coordinates of a 3D vector for each receiver of a thread."""
    Lane = lane_type(lanes)

    @wp.struct
    class Vectors:
        x: Lane
        y: Lane
        z: Lane

    return Vectors


class LaneFunctions(NamedTuple):
    """Kernel functions on lanes that Warp's vectors lack."""

    is_any_above: wp.Function
    bits_above: wp.Function
    is_positive: wp.Function
    dot: wp.Function
    dot_direction: wp.Function
    offset: wp.Function
    scale: wp.Function
    add: wp.Function
    subtract: wp.Function
    find_block: wp.Function
    load: wp.Function
    load_columns: wp.Function
    multiply_by_columns: wp.Function
    store_columns: wp.Function
    add_columns: wp.Function
    add_vectors: wp.Function
    load_rows: wp.Function
    add_rows: wp.Function
    store_rows: wp.Function
    sqrt: wp.Function
    smoothstep: wp.Function
    total: wp.Function


def _sum_of_halves(lanes: int) -> str:
    """C++ that adds up a vector. A loop over halves goes through memory: half the time of some adjoints."""
    if lanes == 1:
        return "return value.c[0];"
    half = lanes // 2
    lines = [
        f"typedef float Numbers __attribute__((ext_vector_type({lanes})));",
        "Numbers numbers;",
        "__builtin_memcpy(&numbers, value.c, sizeof numbers);",
        f"const auto part_{half} = numbers.lo + numbers.hi;",
    ]
    while half > 1:
        half //= 2
        lines.append(f"const auto part_{half} = part_{2 * half}.lo + part_{2 * half}.hi;")
    return "\n".join([*lines, "return part_1;"])


@wp.func_native(
    f"""
#if defined(__CUDA_ARCH__)
    float sum = value.c[0];
    for (int k = 1; k < {CHUNK}; ++k)
        sum += value.c[k];
    return sum;
#else
{_sum_of_halves(CHUNK)}
#endif
""",
    adj_snippet=f"""
    for (int k = 0; k < {CHUNK}; ++k)
        adj_value.c[k] += adj_ret;
""",
)
def total_of_chunk(value: Chunk) -> float:  # type: ignore[empty-body, valid-type]
    """Sum of a chunk, on any device. Differentiable."""
    ...


@wp.func(inline=True)
def is_positive_in_chunk(value: Chunk):
    """1 where an item of a chunk is above 0, else 0."""
    return wp.min(wp.max(1.0e30 * value, Chunk(0.0)), Chunk(1.0))


def _on_columns(statement: str, lanes: int) -> str:
    """C++ that runs a statement on each ``number`` of rows of a block's receivers and its ``item`` of scratch memory.

    Plain Warp finds the address of each number anew, and loads or stores a whole vector for it. For one lane that
    takes fewer registers than addresses that are kept.
    """
    if lanes == 1:
        return f"""
        const int receiver_count = block < rows.shape[0] ? 1 : 0;
        for (int k = 0; k < receiver_count * count; ++k) {{
            wp::float32& number = wp::index(rows, block, begin + k);
            wp::float32& item = wp::index(scratch, first + k).c[0];
            {statement};
        }}
        """
    return f"""
    const int first_receiver = block * {lanes};
    const int receiver_count = rows.shape[0] - first_receiver < {lanes} ? rows.shape[0] - first_receiver : {lanes};
    const int column_step = rows.strides[1] / (int)sizeof(wp::float32);
    for (int lane = 0; lane < receiver_count; ++lane) {{
        wp::float32* row = &wp::index(rows, first_receiver + lane, begin);
        wp::float32* lane_items = &wp::index(scratch, first).c[lane];
        for (int k = 0; k < count; ++k) {{
            wp::float32& number = row[k * column_step];
            wp::float32& item = lane_items[k * {lanes}];
            {statement};
        }}
    }}
    """


@functools.cache
def make_lane_functions(lanes: int) -> LaneFunctions:
    """Make the kernel functions for a number of lanes."""
    Lane, Vectors = lane_type(lanes), vectors_type(lanes)

    # Warp's maximum and sum of a vector go from item to item, each waiting for the one before.
    @wp.func_native(f"""
    bool is_above = false;
    for (int lane = 0; lane < {lanes}; ++lane)
        is_above |= value.c[lane] > limit;
    return is_above;
    """)
    def is_any_above(value: Lane, limit: float) -> bool: ...  # type: ignore[empty-body]

    @wp.func_native(f"""
    unsigned bits = 0;
    for (int lane = 0; lane < {lanes}; ++lane)
        bits |= value.c[lane] > limit ? 1u << lane : 0u;
    return (int)bits;
    """)
    def bits_above(value: Lane, limit: float) -> int: ...  # type: ignore[empty-body]

    @wp.func_native(_sum_of_halves(lanes))
    def total(value: Lane) -> float: ...  # type: ignore[empty-body]

    @wp.func(inline=True)
    def is_positive(value: Lane):
        """1 where a lane is above 0, else 0."""
        return wp.min(wp.max(1.0e30 * value, Lane(0.0)), Lane(1.0))

    @wp.func(inline=True)
    def smoothstep(t: Lane):
        """From 0 at 0 to 1 at 1."""
        return wp.cw_mul(wp.cw_mul(t, t), Lane(3.0) - 2.0 * t)

    @wp.func(inline=True)
    def dot(a: Vectors, b: Vectors):
        return wp.cw_mul(a.x, b.x) + wp.cw_mul(a.y, b.y) + wp.cw_mul(a.z, b.z)

    @wp.func(inline=True)
    def dot_direction(direction: wp.vec3, a: Vectors):
        """Dot products with one direction."""
        return direction[0] * a.x + direction[1] * a.y + direction[2] * a.z

    @wp.func(inline=True)
    def offset(center: wp.vec3, points: Vectors):
        """From each point to a center."""
        return Vectors(Lane(center[0]) - points.x, Lane(center[1]) - points.y, Lane(center[2]) - points.z)

    @wp.func(inline=True)
    def scale(factor: Lane, a: Vectors):
        return Vectors(wp.cw_mul(factor, a.x), wp.cw_mul(factor, a.y), wp.cw_mul(factor, a.z))

    @wp.func(inline=True)
    def add(a: Vectors, b: Vectors):
        return Vectors(a.x + b.x, a.y + b.y, a.z + b.z)

    @wp.func(inline=True)
    def subtract(a: Vectors, b: Vectors):
        return Vectors(a.x - b.x, a.y - b.y, a.z - b.z)

    @wp.func
    def find_block(row: int, receiver_count: int):
        """Instance and block of a row, where the blocks of all instances follow each other."""
        return split_row(row, (receiver_count + (lanes - 1)) // lanes)

    @wp.func
    def load(values: wp.array(dtype=wp.vec3), block: int):
        """A block's vectors."""
        last = values.shape[0] - 1
        x = Lane()
        y = Lane()
        z = Lane()
        for lane in range(lanes):
            value = values[wp.min(block * lanes + lane, last)]
            x[lane] = value[0]
            y[lane] = value[1]
            z[lane] = value[2]
        return Vectors(x, y, z)

    @wp.func
    def add_vectors(a: Vectors, block: int, values: wp.array(dtype=wp.vec3)):
        """Add to a block's vectors."""
        for lane in range(wp.min(lanes, values.shape[0] - block * lanes)):
            wp.atomic_add(values, block * lanes + lane, wp.vec3(a.x[lane], a.y[lane], a.z[lane]))

    @wp.func_native(
        _on_columns("item = number", lanes)
        + f"""
    for (int lane = receiver_count; lane < {lanes}; ++lane)
        for (int k = 0; k < count; ++k)
            wp::index(scratch, first + k).c[lane] = outside;
    """
    )
    def load_columns(
        rows: wp.array2d(dtype=wp.float32),
        begin: int,
        count: int,
        block: int,
        outside: float,
        scratch: wp.array(dtype=Lane),
        first: int,
    ):
        """scratch[first + k] = rows[the block's vertices, begin + k] for ``count`` columns; past them ``outside``."""
        ...

    @wp.func_native(_on_columns("item *= number", lanes))
    def multiply_by_columns(
        rows: wp.array2d(dtype=wp.float32),
        begin: int,
        count: int,
        block: int,
        scratch: wp.array(dtype=Lane),
        first: int,
    ):
        """scratch[first + k] *= rows[the block's vertices, begin + k] for ``count`` columns."""
        ...

    @wp.func_native(_on_columns("number = item", lanes))
    def store_columns(
        scratch: wp.array(dtype=Lane),
        first: int,
        rows: wp.array2d(dtype=wp.float32),
        begin: int,
        count: int,
        block: int,
    ):
        """rows[the block's vertices, begin + k] = scratch[first + k] for ``count`` columns."""
        ...

    @wp.func_native(_on_columns("wp::atomic_add(&number, factor * item)", lanes))
    def add_columns(
        factor: float,
        scratch: wp.array(dtype=Lane),
        first: int,
        rows: wp.array2d(dtype=wp.float32),
        begin: int,
        count: int,
        block: int,
    ):
        """rows[the block's vertices, begin + k] += factor · scratch[first + k] for ``count`` columns."""
        ...

    @wp.func
    def load_rows(rows: wp.array2d(dtype=wp.float32), block: int, scratch: wp.array(dtype=Lane)):
        """scratch[k] = rows[the block's vertices, k], 0 past the last receiver."""
        load_columns(rows, 0, rows.shape[1], block, 0.0, scratch, 0)

    @wp.func
    def add_rows(scratch: wp.array(dtype=Lane), block: int, rows: wp.array2d(dtype=wp.float32)):
        """rows[the block's vertices, k] += scratch[k]."""
        add_columns(1.0, scratch, 0, rows, 0, rows.shape[1], block)

    @wp.func
    def store_rows(scratch: wp.array(dtype=Lane), block: int, rows: wp.array2d(dtype=wp.float32)):
        """rows[the block's vertices, k] = scratch[k]."""
        store_columns(scratch, 0, rows, 0, rows.shape[1], block)

    @wp.func
    def sqrt(value: Lane):
        """Square root of each lane."""
        root = Lane()
        for lane in range(lanes):
            root[lane] = wp.sqrt(value[lane])
        return root

    functions = locals()
    return LaneFunctions(*(functions[name] for name in LaneFunctions._fields))


def as_chunks(rows: wp.array | None) -> wp.array | None:
    """View rows of coefficients [batch, row, coefficient] as rows of whole chunks; the remainder is left out."""
    return None if rows is None else as_items(rows, Chunk, CHUNK)
