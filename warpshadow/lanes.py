"""Lanes: how one thread works on several receivers at once.

Warp runs a CPU kernel one thread after another. A thread that owns one receiver leaves the vector units idle; so here
a thread owns a *group* of receivers and holds each quantity as one vector with a lane for every receiver: 16 lanes on
a CPU, 1 on a GPU, where threads play that part. Arrays in memory stay [batch, vertex, …]; only scratch is [batch,
group, …] of lanes. A group that runs past the last receiver repeats it and writes it once.
"""

import functools
from typing import NamedTuple

import warp as wp

from warpshadow.directions import CHUNK
from warpshadow.parallel import split_row

Chunk = wp.types.vector(length=CHUNK, dtype=wp.float32)
"""Coefficients of one receiver that reach the vector units together."""

MODULE_OPTIONS = {"max_unroll": 1, "cpu_compiler_flags": "-march=native -fno-unroll-loops -fno-slp-vectorize"}
"""Options of modules whose kernels loop over lanes.

Unrolled by Warp, such loops take ten times as long to compile. Unrolled by the compiler, they are put together again
as far as it finds what belongs together; left alone, each becomes a vector instruction, and kernels run twice as fast.
"""


def lane_count(device: wp.DeviceLike) -> int:
    """Receivers of one thread: a vector register's worth on a CPU, one on a GPU."""
    return 16 if wp.get_device(device).is_cpu else 1


def group_count(vertex_count: int, lanes: int) -> int:
    """Groups, and so threads, that ``vertex_count`` receivers take."""
    return -(-vertex_count // lanes)


@functools.cache
def lane_type(lanes: int) -> type:
    """Vector of float32 with a lane for each receiver of a thread."""
    return wp.types.vector(length=lanes, dtype=wp.float32)


class LaneFunctions(NamedTuple):
    """Kernel functions on lanes that Warp's vectors lack."""

    is_any_above: wp.Function
    find_group: wp.Function
    load: wp.Function
    load_products: wp.Function
    add_vectors: wp.Function
    add_to_sphere: wp.Function
    load_rows: wp.Function
    add_rows: wp.Function
    store_rows: wp.Function
    store_columns: wp.Function
    sqrt: wp.Function
    total: wp.Function


@functools.cache
def lane_functions(lanes: int) -> LaneFunctions:
    """Make the kernel functions for a number of lanes."""
    Lane = lane_type(lanes)

    # Warp's maximum and sum of a vector go from item to item, each waiting for the one before.
    @wp.func_native(f"""
    bool is_above = false;
    for (int lane = 0; lane < {lanes}; ++lane)
        is_above |= value.c[lane] > limit;
    return is_above;
    """)
    def is_any_above(value: Lane, limit: float) -> bool: ...  # type: ignore[empty-body]

    @wp.func_native(f"""
    float part[{lanes}];
    for (int lane = 0; lane < {lanes}; ++lane)
        part[lane] = value.c[lane];
    for (int half = {lanes} / 2; half > 0; half /= 2)
        for (int lane = 0; lane < half; ++lane)
            part[lane] += part[lane + half];
    return part[0];
    """)
    def total(value: Lane) -> float: ...  # type: ignore[empty-body]

    @wp.func
    def find_group(row: int, vertex_count: int):
        """Instance and group of a row, where the groups of all instances follow each other."""
        return split_row(row, (vertex_count + (lanes - 1)) // lanes)

    @wp.func
    def load(values: wp.array(dtype=wp.vec3), group: int):
        """The x, y and z of a group's vectors."""
        last = values.shape[0] - 1
        x = Lane()
        y = Lane()
        z = Lane()
        for lane in range(lanes):
            value = values[wp.min(group * lanes + lane, last)]
            x[lane] = value[0]
            y[lane] = value[1]
            z[lane] = value[2]
        return x, y, z

    @wp.func
    def load_products(
        a: wp.array2d(dtype=wp.float32),
        b: wp.array2d(dtype=wp.float32),
        begin: int,
        count: int,
        group: int,
        scratch: wp.array(dtype=Lane),
    ):
        """scratch[k] = a b of the group's vertices in the column ``begin`` + k, 0 past the last vertex."""
        for k in range(count):
            value = Lane()
            for lane in range(wp.min(lanes, a.shape[0] - group * lanes)):
                vertex = group * lanes + lane
                value[lane] = a[vertex, begin + k] * b[vertex, begin + k]
            scratch[k] = value

    @wp.func
    def add_vectors(x: Lane, y: Lane, z: Lane, group: int, values: wp.array(dtype=wp.vec3)):
        """Add to a group's vectors."""
        for lane in range(wp.min(lanes, values.shape[0] - group * lanes)):
            wp.atomic_add(values, group * lanes + lane, wp.vec3(x[lane], y[lane], z[lane]))

    @wp.func
    def add_to_sphere(
        dx: Lane,
        dy: Lane,
        dz: Lane,
        radius: Lane,
        batch: int,
        sphere: int,
        adj_centers: wp.array2d(dtype=wp.vec3),
        adj_radii: wp.array2d(dtype=wp.float32),
    ):
        """Add a group's share to the gradients of a sphere, those that are wanted."""
        if adj_centers:
            wp.atomic_add(adj_centers, batch, sphere, wp.vec3(total(dx), total(dy), total(dz)))
        if adj_radii:
            wp.atomic_add(adj_radii, batch, sphere, total(radius))

    @wp.func
    def load_rows(rows: wp.array2d(dtype=wp.float32), group: int, scratch: wp.array(dtype=Lane)):
        """scratch[k] = rows[the group's vertices, k], 0 past the last vertex."""
        for k in range(rows.shape[1]):
            value = Lane()
            for lane in range(wp.min(lanes, rows.shape[0] - group * lanes)):
                value[lane] = rows[group * lanes + lane, k]
            scratch[k] = value

    @wp.func
    def add_rows(scratch: wp.array(dtype=Lane), group: int, rows: wp.array2d(dtype=wp.float32)):
        """rows[the group's vertices, k] += scratch[k]."""
        for lane in range(wp.min(lanes, rows.shape[0] - group * lanes)):
            vertex = group * lanes + lane
            for k in range(rows.shape[1]):
                rows[vertex, k] = rows[vertex, k] + scratch[k][lane]

    @wp.func
    def store_columns(
        scratch: wp.array(dtype=Lane), begin: int, count: int, group: int, rows: wp.array2d(dtype=wp.float32)
    ):
        """rows[the group's vertices, begin + k] = scratch[k] for ``count`` columns."""
        for lane in range(wp.min(lanes, rows.shape[0] - group * lanes)):
            vertex = group * lanes + lane
            for k in range(count):
                rows[vertex, begin + k] = scratch[k][lane]

    @wp.func
    def store_rows(scratch: wp.array(dtype=Lane), group: int, rows: wp.array2d(dtype=wp.float32)):
        """rows[the group's vertices, k] = scratch[k]."""
        store_columns(scratch, 0, rows.shape[1], group, rows)

    @wp.func
    def sqrt(value: Lane):
        """Square root of each lane."""
        root = Lane()
        for lane in range(lanes):
            root[lane] = wp.sqrt(value[lane])
        return root

    return LaneFunctions(
        is_any_above,
        find_group,
        load,
        load_products,
        add_vectors,
        add_to_sphere,
        load_rows,
        add_rows,
        store_rows,
        store_columns,
        sqrt,
        total,
    )


def as_chunks(rows: wp.array | None) -> wp.array | None:
    """View rows of coefficients [batch, row, coefficient] as rows of whole chunks; what is left over is not in it."""
    if rows is None:
        return None
    instances, row_count, count = rows.shape
    chunks = wp.array(
        ptr=rows.ptr,
        dtype=Chunk,
        shape=(instances, row_count, count // CHUNK),
        strides=(*rows.strides[:2], CHUNK * rows.strides[2]),
        device=rows.device,
    )
    chunks._ref = rows  # the memory stays while the view does
    return chunks
