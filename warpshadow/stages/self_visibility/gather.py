"""Self-transmittance of receivers past their own body, gathered from its rows.

    T_self(x, q) = Σ_k w_qk Σ_j b_j S[row_j, c_qk]

over the lookups of cell q (:mod:`.lookup`) and the three rows of the receiver with their weights b (:mod:`.probes`).
It is found for cells above the receiver's horizon; for others, where the cosine is zero, it is 1.

Receivers of a block look up the same coarse cells, each in rows of its own. So these are first brought into lanes: then
a lookup is one vector, where it would be bytes from all over memory. A single lane reads its bytes.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import warp as wp

from warpshadow.device.batch import common_batch, expand, instance_in
from warpshadow.device.lanes import (
    Chunk,
    as_chunks,
    lane_count,
    lane_type,
    make_lane_functions,
    module_options,
    use_vector_registers,
)
from warpshadow.device.launch import launch, launch_with_adjoint
from warpshadow.device.memory import as_items, empty, require_gradient
from warpshadow.device.parallel import Scratch, scratch_slot
from warpshadow.device.warp_internals import struct_of
from warpshadow.device.warp_sums import sum_over_warp
from warpshadow.stages.receivers.body_spans import (
    ReceiverBlock,
    ReceiverSpans,
    Span,
    SpanValues,
    make_find_span,
    receiver_spans,
    span_values,
    value_of_span,
)
from warpshadow.stages.self_visibility.lookup import BodyKernels, ResamplingKernels, ResamplingWeights
from warpshadow.stages.self_visibility.probes import ProbeWeights
from warpshadow.stages.self_visibility.trace import VisibilityRows

_LOOKUP_COST, _ADJ_LOOKUP_COST = 0.6, 0.4  # nanoseconds that a lookup takes
_MEAN_LOOKUPS = 6  # lookups of a cell, for the cost
_CELLS_PER_WORD = 4  # coarse cells of a word of 32 bits


@wp.struct
class BodyTable:
    """Self-visibility of a body's probes."""

    bits: wp.array2d(dtype=wp.uint32)
    words: wp.array2d(dtype=wp.uint32)


@wp.struct
class GatherInputs:
    """Inputs of gathering, and of its adjoint."""

    normals: wp.array2d(dtype=wp.vec3)
    spans: ReceiverSpans
    table_of_span: SpanValues  # the number of its body among those of the tables
    rows: wp.array2d(dtype=wp.vec3i)
    probe_weights: wp.array2d(dtype=wp.vec3)
    directions: wp.array(dtype=wp.vec3)
    counts: wp.array3d(dtype=wp.int32)
    indices: wp.array4d(dtype=wp.int32)
    weights: wp.array4d(dtype=wp.float32)
    kernels: wp.array(dtype=ResamplingKernels)  # [body]
    tables: wp.array(dtype=BodyTable)  # [body]


@functools.cache
def _probes_type(lanes: int) -> Any:
    """Struct of the probe weights of a block of receivers."""
    Rows = wp.types.matrix(shape=(3, lanes), dtype=wp.int32)
    Weights = wp.types.matrix(shape=(3, lanes), dtype=wp.float32)

    @wp.struct
    class ProbeLanes:
        rows: Rows  # of each corner, the first of them thrice where all receivers are vertices
        weights: Weights
        corner_count: int  # 1 where all receivers are vertices

    return ProbeLanes


class _ProbeFunctions(NamedTuple):
    """Kernel functions on the probes of a block."""

    load_block: wp.Function
    add_cell_visibility: wp.Function
    load_visibility: wp.Function


@functools.cache
def _make_probe_functions(lanes: int) -> _ProbeFunctions:
    """Make the kernel functions for a number of lanes."""
    Lane, ProbeLanes = lane_type(lanes), _probes_type(lanes)
    Rows = wp.types.vector(length=lanes, dtype=wp.int32)
    fn = make_lane_functions(lanes)
    load, find_span = fn.load, make_find_span(lanes)

    @wp.func
    def load_probes(inputs: GatherInputs, block: ReceiverBlock):
        rows = inputs.rows[instance_in(block.batch, inputs.rows.shape[0])]
        weights = inputs.probe_weights[instance_in(block.batch, inputs.probe_weights.shape[0])]
        probes = ProbeLanes()
        probes.corner_count = 1
        for lane in range(lanes):
            receiver = wp.min(block.first + block.number * lanes + lane, block.end - 1)
            row = rows[receiver]
            weight = wp.vec3(1.0, 0.0, 0.0)
            if row[0] != row[1] or row[0] != row[2]:
                weight = weights[receiver]
                probes.corner_count = 3
            for corner in range(3):
                probes.rows[corner, lane] = row[corner]
                probes.weights[corner, lane] = weight[corner]
        return probes

    # In plain Warp, which finds the address of each word by itself, it takes six times as long.
    @wp.func_native(f"""
    const wp::float32 unit = 1.0 / 255.0;
    for (int word = 0; word < words.shape[1]; ++word) {{
        unsigned packed[{lanes}];
        for (int lane = 0; lane < {lanes}; ++lane)
            packed[lane] = wp::index(words, rows.c[lane], word);
        for (int part = 0; part < {_CELLS_PER_WORD}; ++part) {{
            auto& visibility = wp::index(cell_visibility, word * {_CELLS_PER_WORD} + part);
            for (int lane = 0; lane < {lanes}; ++lane)
                visibility.c[lane] += weights.c[lane] * ((wp::float32)((packed[lane] >> 8 * part) & 255) * unit);
        }}
    }}
    """)
    def add_cell_visibility(
        rows: Rows, weights: Lane, words: wp.array2d(dtype=wp.uint32), cell_visibility: wp.array(dtype=Lane)
    ):
        """cell_visibility[cell] += weight · S of all coarse cells in a row of each receiver."""
        ...

    @wp.func
    def load_visibility(rows: Rows, uses_rays: int, index: int, tables: wp.array(dtype=BodyTable), body: int):
        """Visibility S, 0 to 1, of a ray or coarse cell in one row for each receiver.

        The table is read at each lookup: held over all of them, it takes 12 registers more.
        """
        visibility = Lane()
        for lane in range(lanes):
            if uses_rays == 1:
                visibility[lane] = float(
                    int((tables[body].bits[rows[lane], index >> 5] >> wp.uint32(index & 31)) & wp.uint32(1))
                )
            else:
                word = tables[body].words[rows[lane], index // _CELLS_PER_WORD]
                byte = (word >> wp.uint32(8 * (index % _CELLS_PER_WORD))) & wp.uint32(255)
                visibility[lane] = float(int(byte)) * (1.0 / 255.0)
        return visibility

    @wp.func
    def load_block(inputs: GatherInputs, row: int, cell_visibility: wp.array(dtype=Lane)):
        """Load a block of receivers, and S of all coarse cells where there are several."""
        block = find_span(inputs.spans, row)
        probes = load_probes(inputs, block)
        body = value_of_span(inputs.table_of_span, block.span)
        if wp.static(lanes > 1):
            for cell in range(cell_visibility.shape[0]):
                cell_visibility[cell] = Lane(0.0)
            for corner in range(probes.corner_count):
                add_cell_visibility(
                    probes.rows[corner], probes.weights[corner], inputs.tables[body].words, cell_visibility
                )
        normals = inputs.normals[instance_in(block.batch, inputs.normals.shape[0])][block.first : block.end]
        return block, load(normals, block.number), probes, body

    return _ProbeFunctions(load_block, add_cell_visibility, load_visibility)


@functools.cache
def _make_gather(lanes: int) -> wp.Kernel:
    Lane, fn = lane_type(lanes), make_lane_functions(lanes)
    load_block, _add_cell_visibility, load_visibility = _make_probe_functions(lanes)
    store_columns, dot_direction, is_any_above = fn.store_columns, fn.dot_direction, fn.is_any_above

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def gather(
        first_row: int,
        worker: int,
        # in
        inputs: GatherInputs,
        # scratch
        scratch: wp.array3d(dtype=Lane),
        # out
        transmittance_self: wp.array3d(dtype=wp.float32),
    ):
        """A thread owns a block of receivers."""
        item = first_row + wp.tid()
        cell_visibility = scratch[scratch_slot(worker, item), 0]
        columns = scratch[scratch_slot(worker, item), 1]
        block, normal, probes, body = load_block(inputs, item, cell_visibility)
        weight_batch = instance_in(block.batch, inputs.counts.shape[0])
        kernels = inputs.kernels[body]
        rows = transmittance_self[block.batch][block.first : block.end]
        for q in range(inputs.directions.shape[0]):
            transmittance = Lane(0.0)
            cosine = dot_direction(inputs.directions[q], normal)
            if is_any_above(cosine, 0.0):
                indices = inputs.indices[weight_batch, body, q]
                weights = inputs.weights[weight_batch, body, q]
                uses_rays = kernels.uses_rays[q]
                if wp.static(lanes == 1) or uses_rays == 1:
                    for k in range(inputs.counts[weight_batch, body, q]):
                        for corner in range(3):
                            if corner < probes.corner_count:
                                visibility = load_visibility(
                                    probes.rows[corner], uses_rays, indices[k], inputs.tables, body
                                )
                                transmittance += weights[k] * wp.cw_mul(probes.weights[corner], visibility)
                else:
                    for k in range(inputs.counts[weight_batch, body, q]):
                        transmittance += weights[k] * cell_visibility[indices[k]]
            for lane in range(lanes):
                transmittance[lane] = wp.where(cosine[lane] > 0.0, transmittance[lane], 1.0)
            if wp.static(lanes == 1):
                rows[block.number, q] = transmittance[0]
            else:
                columns[q] = transmittance
        if wp.static(lanes > 1):
            store_columns(columns, 0, rows, 0, inputs.directions.shape[0], block.number)

    return gather


@functools.cache
def _make_gather_adjoint(lanes: int) -> wp.Kernel:
    Lane, fn = lane_type(lanes), make_lane_functions(lanes)
    load_block, add_cell_visibility, load_visibility = _make_probe_functions(lanes)
    dot_direction, is_any_above, total = fn.dot_direction, fn.is_any_above, fn.total
    Weights = wp.types.matrix(shape=(3, lanes), dtype=wp.float32)

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def gather_adjoint(
        first_row: int,
        worker: int,
        # in
        inputs: GatherInputs,
        adj_transmittance: wp.array3d(dtype=wp.float32),
        # scratch
        scratch: wp.array3d(dtype=Lane),
        # out
        adj_probe_weights: wp.array2d(dtype=wp.vec3),
        # sums
        adj_resampling_weights: wp.array4d(dtype=wp.float32),
    ):
        """A thread owns a block of receivers:  w̄_qk += T̄_q Σ_j b_j S_jqk,  b̄_j += Σ_qk T̄_q w_qk S_jqk.

        The latter is summed up by cells first:  S̄_c = Σ_qk T̄_q w_qk where c_qk = c,  b̄_j += Σ_c S̄_c S_jc.
        """
        item = first_row + wp.tid()
        cell_visibility = scratch[scratch_slot(worker, item), 0]
        adj_cell_visibility = scratch[scratch_slot(worker, item), 1]
        block, normal, probes, body = load_block(inputs, item, cell_visibility)
        weight_batch = instance_in(block.batch, inputs.counts.shape[0])
        kernels = inputs.kernels[body]
        first_receiver = block.first + block.number * lanes
        if wp.static(lanes > 1):
            for cell in range(cell_visibility.shape[0]):
                adj_cell_visibility[cell] = Lane(0.0)
        receiver_count = wp.min(lanes, block.end - first_receiver)
        adj_corner_weights = Weights()
        for q in range(inputs.directions.shape[0]):
            cosine = dot_direction(inputs.directions[q], normal)
            if is_any_above(cosine, 0.0):
                adj = Lane()
                for lane in range(receiver_count):
                    adj[lane] = wp.where(
                        cosine[lane] > 0.0, adj_transmittance[block.batch, first_receiver + lane, q], 0.0
                    )
                indices = inputs.indices[weight_batch, body, q]
                weights = inputs.weights[weight_batch, body, q]
                uses_rays = kernels.uses_rays[q]
                if wp.static(lanes == 1) or uses_rays == 1:
                    for k in range(inputs.counts[weight_batch, body, q]):
                        adj_weight = float(0.0)
                        for corner in range(3):
                            if corner < probes.corner_count:
                                adj_visibility = wp.cw_mul(
                                    adj,
                                    load_visibility(probes.rows[corner], uses_rays, indices[k], inputs.tables, body),
                                )
                                adj_corner_weights[corner] += weights[k] * adj_visibility
                                adj_weight += total(wp.cw_mul(probes.weights[corner], adj_visibility))
                        if adj_resampling_weights:
                            if wp.static(lanes == 1):
                                adj_weight = sum_over_warp(
                                    adj_weight,
                                    ((weight_batch * inputs.counts.shape[1] + body) * inputs.directions.shape[0] + q)
                                    * adj_resampling_weights.shape[3]
                                    + k,
                                )
                            if adj_weight != 0.0:
                                wp.atomic_add(adj_resampling_weights, weight_batch, body, q, k, adj_weight)
                else:
                    for k in range(inputs.counts[weight_batch, body, q]):
                        adj_cell_visibility[indices[k]] = adj_cell_visibility[indices[k]] + weights[k] * adj
                        if adj_resampling_weights:
                            adj_weight_sum = total(wp.cw_mul(adj, cell_visibility[indices[k]]))
                            wp.atomic_add(adj_resampling_weights, weight_batch, body, q, k, adj_weight_sum)
        if adj_probe_weights:
            for corner in range(3):
                adj_corner = adj_corner_weights[corner]
                if wp.static(lanes > 1):
                    for cell in range(cell_visibility.shape[0]):
                        cell_visibility[cell] = Lane(0.0)
                    add_cell_visibility(probes.rows[corner], Lane(1.0), inputs.tables[body].words, cell_visibility)
                    for cell in range(cell_visibility.shape[0]):
                        adj_corner += wp.cw_mul(adj_cell_visibility[cell], cell_visibility[cell])
                for lane in range(receiver_count):
                    receiver = first_receiver + lane
                    adj_corner_vector = wp.vec3()
                    adj_corner_vector[corner] = adj_corner[lane]
                    adj_probe_weights[block.batch, receiver] = (
                        adj_probe_weights[block.batch, receiver] + adj_corner_vector
                    )

    return gather_adjoint


class BodyTables(NamedTuple):
    """Self-visibility of the probes of some bodies."""

    rows: tuple[VisibilityRows, ...]  # of each body
    table: wp.array  # of :class:`BodyTable`, [body]

    @classmethod
    def of_rows(cls, rows: Sequence[VisibilityRows]) -> "BodyTables":
        """Tables of bodies, given the rows of each."""
        tables = []
        for rows_of_body in rows:
            table = BodyTable()
            table.bits, table.words = rows_of_body.bits, as_items(rows_of_body.cells, wp.uint32, _CELLS_PER_WORD)
            tables.append(table)
        return cls(tuple(rows), wp.array(tables, dtype=BodyTable, device=rows[0].bits.device))


def gather_self_transmittance(
    normals: wp.array,
    probe_weights: ProbeWeights,
    resampling_weights: ResamplingWeights,
    kernels: BodyKernels,
    tables: BodyTables,
    spans: Sequence[Span] = (),
    table_of_span: Sequence[int] = (0,),
) -> wp.array:
    """Gather the self-visibility of receivers of some bodies.

    Args:
        normals: Unit normals of the receivers, vec3 of shape [batch, receiver].
        spans: Of the receivers, by body; () for one of all.
        table_of_span: The number of each span's body among those of the tables.
    Returns:
        Transmittance T_self in [0, 1], float32 of shape [batch, receiver, direction].
    Differentiable: weights of probe_weights and of resampling_weights. Not: normals (they only cut off directions
    below the horizon).
    """
    batch_count = common_batch(
        {"normals": normals, "probe_weights": probe_weights.rows, "resampling_weights": resampling_weights.counts}
    )
    directions, device = kernels.kernels[0].directions, normals.device
    direction_count = directions.size
    shape = batch_count, normals.shape[1], direction_count
    if probe_weights.weights.requires_grad:
        # each instance has a gradient of its own
        probe_weights = ProbeWeights(probe_weights.rows, expand(probe_weights.weights, batch_count))
    lanes = lane_count(device)
    inputs = struct_of(
        GatherInputs,
        normals=normals,
        spans=receiver_spans(spans, shape[1], lanes, device),
        table_of_span=span_values(table_of_span, device),
        rows=probe_weights.rows,
        probe_weights=probe_weights.weights,
        directions=directions,
        **resampling_weights._asdict(),
        kernels=kernels.table,
        tables=tables.table,
    )
    lookup_count = _MEAN_LOOKUPS * direction_count * lanes
    cell_count = max(direction_count, *(rows.cells.shape[1] for rows in tables.rows)) if lanes > 1 else 1
    return launch_with_adjoint(
        _make_gather(lanes),
        lambda: _make_gather_adjoint(lanes),
        batch_count * inputs.spans.block_count,
        inputs=[inputs],
        result=empty(shape, dtype=wp.float32, device=device),
        variables=[probe_weights.weights],
        shared=[resampling_weights.weights],
        scratch=[Scratch((2, cell_count), lane_type(lanes))],
        cost=_LOOKUP_COST * lookup_count,
        adj_cost=_ADJ_LOOKUP_COST * lookup_count,
    )


@wp.kernel
def _multiply_chunks(
    # in
    factors: wp.array3d(dtype=Chunk),
    values: wp.array3d(dtype=Chunk),
    # out
    products: wp.array3d(dtype=Chunk),
):
    """A thread owns a receiver."""
    batch, receiver = wp.tid()
    for chunk in range(products.shape[2]):
        products[batch, receiver, chunk] = wp.cw_mul(factors[batch, receiver, chunk], values[batch, receiver, chunk])


def multiply_transmittances(first: wp.array, second: wp.array) -> wp.array:
    """The product of two transmittances, float32 of shape [batch, receiver, direction]. Differentiable: both."""
    use_vector_registers(__name__, first.device)
    product = empty(first.shape, dtype=wp.float32, device=first.device)
    if first.requires_grad or second.requires_grad:
        require_gradient(product)  # before it is seen as chunks
    inputs = [as_chunks(first), as_chunks(second)]
    launch(_multiply_chunks, first.shape[:2], inputs=inputs, outputs=[as_chunks(product)])
    return product
