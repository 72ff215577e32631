"""Own transmittance: what receivers see past their own body, gathered from its rows.

    T_self(x, q) = Σ_k w_qk Σ_j b_j S[row_j, c_qk]

over the lookups of cell q (:mod:`.lookup`) and the three rows of the receiver with their weights b (:mod:`.sites`).
It is found where the receiver's horizon is below, and 1 elsewhere, where the cosine is zero.
"""

import warp as wp

from warpshadow.device.batch import common_batch, expand, instance_in
from warpshadow.device.lanes import Chunk, as_chunks, use_vector_registers
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.parallel import split_row
from warpshadow.stages.own_shadows.lookup import Lookup, Supports
from warpshadow.stages.own_shadows.sites import Places
from warpshadow.stages.own_shadows.trace import OwnRows

_LOOKUP_COST = 2.0
"""Nanoseconds that a lookup takes."""

_MEAN_LOOKUPS = 6
"""Lookups of a cell, for the cost."""


@wp.func
def _open_share(
    bits: wp.array2d(dtype=wp.uint32), cells: wp.array2d(dtype=wp.uint8), of_rays: int, row: int, index: int
):
    """S of a row, from 0 to 1."""
    if of_rays == 1:
        return float((bits[row, index >> 5] >> wp.uint32(index & 31)) & wp.uint32(1))
    return float(cells[row, index]) * (1.0 / 255.0)


@wp.kernel(enable_backward=False)
def _gather(
    first_row: int,
    worker: int,
    # in
    normals: wp.array2d(dtype=wp.vec3),
    rows: wp.array2d(dtype=wp.vec3i),
    place_weights: wp.array2d(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    looks_at_rays: wp.array(dtype=wp.int32),
    counts: wp.array2d(dtype=wp.int32),
    indices: wp.array3d(dtype=wp.int32),
    weights: wp.array3d(dtype=wp.float32),
    bits: wp.array2d(dtype=wp.uint32),
    cells: wp.array2d(dtype=wp.uint8),
    # out
    own: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver."""
    batch, receiver = split_row(first_row + wp.tid(), own.shape[1])
    normal = normals[instance_in(batch, normals.shape[0]), receiver]
    turn = instance_in(batch, counts.shape[0])
    place = instance_in(batch, rows.shape[0])
    row = rows[place, receiver]
    weight = place_weights[instance_in(batch, place_weights.shape[0]), receiver]
    is_vertex = row[0] == row[1] and row[0] == row[2]
    for q in range(directions.shape[0]):
        passing = float(1.0)
        if wp.dot(normal, directions[q]) > 0.0:
            passing = float(0.0)
            of_rays = looks_at_rays[q]
            for k in range(counts[turn, q]):
                index = indices[turn, q, k]
                seen = _open_share(bits, cells, of_rays, row[0], index)
                if not is_vertex:
                    seen = (
                        weight[0] * seen
                        + weight[1] * _open_share(bits, cells, of_rays, row[1], index)
                        + weight[2] * _open_share(bits, cells, of_rays, row[2], index)
                    )
                passing += weights[turn, q, k] * seen
        own[batch, receiver, q] = passing


@wp.kernel(enable_backward=False)
def _gather_adjoint(
    first_row: int,
    worker: int,
    # in
    normals: wp.array2d(dtype=wp.vec3),
    rows: wp.array2d(dtype=wp.vec3i),
    place_weights: wp.array2d(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    looks_at_rays: wp.array(dtype=wp.int32),
    counts: wp.array2d(dtype=wp.int32),
    indices: wp.array3d(dtype=wp.int32),
    weights: wp.array3d(dtype=wp.float32),
    bits: wp.array2d(dtype=wp.uint32),
    cells: wp.array2d(dtype=wp.uint8),
    adj_own: wp.array3d(dtype=wp.float32),
    # out
    adj_place_weights: wp.array2d(dtype=wp.vec3),
    adj_weights: wp.array3d(dtype=wp.float32),
):
    """A thread owns a receiver:  w̄_qk += T̄_q Σ_j b_j S_jqk,  b̄_j += Σ_qk T̄_q w_qk S_jqk."""
    batch, receiver = split_row(first_row + wp.tid(), adj_own.shape[1])
    normal = normals[instance_in(batch, normals.shape[0]), receiver]
    turn = instance_in(batch, counts.shape[0])
    place = instance_in(batch, rows.shape[0])
    row = rows[place, receiver]
    weight = place_weights[instance_in(batch, place_weights.shape[0]), receiver]
    is_vertex = row[0] == row[1] and row[0] == row[2]
    adj_weight = wp.vec3()
    for q in range(directions.shape[0]):
        adj = adj_own[batch, receiver, q]
        if adj != 0.0 and wp.dot(normal, directions[q]) > 0.0:
            of_rays = looks_at_rays[q]
            for k in range(counts[turn, q]):
                index = indices[turn, q, k]
                seen = _open_share(bits, cells, of_rays, row[0], index)
                if not is_vertex:
                    others = wp.vec3(
                        seen,
                        _open_share(bits, cells, of_rays, row[1], index),
                        _open_share(bits, cells, of_rays, row[2], index),
                    )
                    adj_weight += adj * weights[turn, q, k] * others
                    seen = wp.dot(weight, others)
                if adj_weights:
                    wp.atomic_add(adj_weights, turn, q, k, adj * seen)
    if adj_place_weights:
        adj_place_weights[batch, receiver] = adj_place_weights[batch, receiver] + adj_weight


def gather_own(normals: wp.array, places: Places, lookup: Lookup, supports: Supports, rows: OwnRows) -> wp.array:
    """Gather what receivers of a body see past it.

    Args:
        normals: Unit normals of the receivers, vec3 of shape [batch, receiver].
        places: Where they lie on the body.
        lookup: What cells of directions look up.
        supports: From which the lookup is.
        rows: What sites see.

    Returns:
        Transmittance T_self in [0, 1], float32 of shape [batch, receiver, direction].

    Differentiable: weights of places and of the lookup. Not: normals (they only leave out what lies below the horizon).
    """
    count = common_batch({"normals": normals, "places": places.rows, "rotations": lookup.counts})
    direction_count = supports.directions.size
    shape = count, normals.shape[1], direction_count
    if places.weights.requires_grad:
        places = Places(places.rows, expand(places.weights, count))  # whose gradients are apart
    inputs = [normals, *places, supports.directions, supports.looks_at_rays, *lookup, *rows]
    cost = _LOOKUP_COST * _MEAN_LOOKUPS * direction_count / 2
    return differentiable(
        lambda own: launch(_gather, shape[0] * shape[1], inputs=inputs, outputs=[own], cost=cost),
        lambda adj_own: launch(
            _gather_adjoint,
            shape[0] * shape[1],
            inputs=[*inputs, adj_own],
            outputs=[places.weights.grad],
            sums=[lookup.weights.grad],
            cost=2 * cost,
        ),
        result=wp.empty(shape, dtype=wp.float32, device=normals.device),
        variables=[places.weights, lookup.weights],
    )


@wp.kernel(enable_backward=False)
def _add_products(
    # in
    factors: wp.array3d(dtype=Chunk),
    values: wp.array3d(dtype=Chunk),
    # out
    products: wp.array3d(dtype=Chunk),
):
    """A thread owns a receiver, to whose products it adds."""
    batch, receiver = wp.tid()
    for chunk in range(products.shape[2]):
        products[batch, receiver, chunk] = products[batch, receiver, chunk] + wp.cw_mul(
            factors[batch, receiver, chunk], values[batch, receiver, chunk]
        )


def multiply_transmittances(own: wp.array, others: wp.array) -> wp.array:
    """The product of two transmittances, float32 of shape [batch, receiver, direction]. Differentiable: both."""
    if own.device.is_cpu:
        use_vector_registers(__name__)

    def add_product(first: wp.array, second: wp.array, total: wp.array) -> None:
        launch(
            _add_products,
            own.shape[:2],
            inputs=[as_chunks(first), as_chunks(second)],
            outputs=[as_chunks(total)],
        )

    def adjoint(adj: wp.array) -> None:
        for factor, other in ((own, others), (others, own)):
            if factor.requires_grad:
                add_product(other, adj, factor.grad)

    return differentiable(
        lambda product: add_product(own, others, product),
        adjoint,
        result=wp.zeros(own.shape, dtype=wp.float32, device=own.device),
        variables=[own, others],
    )
