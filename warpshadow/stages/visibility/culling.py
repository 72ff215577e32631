"""Culling: which spheres can block which directions for a group of receivers, found for many of them at once.

Spheres come in quads of four, quads in runs of four, and directions in bundles of four. A run that is below the horizon
of all receivers of a group, or too far from a bundle's cone, is not looked at; then its quads, then its spheres.
Nothing is lost by that: what is left out blocks nothing. Order in memory does not change results, but how much is left
out: neighbors had best be near each other, spheres as well as receivers (:mod:`warpshadow.maths.spatial_sort`).
"""

import functools

import numpy as np
import warp as wp

from warpshadow.device.constants import constant
from warpshadow.device.lanes import lane_functions, lane_type
from warpshadow.maths.directions import bundle_cones
from warpshadow.stages.visibility.cones import BLEND, TINY_RADIUS
from warpshadow.stages.visibility.merging import ITEMS, QUAD, Nodes, Spheres

_REACH = 1.001 + BLEND
"""Bounds are so much larger: cones of receivers as near as BLEND are wider than the sphere, and there is rounding."""

QUADS = 4
"""Quads that make up a run. Spheres of a run, and then of a quad, are culled together: they had best be neighbors."""


@wp.struct
class Cells:
    """Cells of directions and the cones around bundles of them, as kernels see them."""

    directions: wp.array(dtype=wp.vec3)
    axes: wp.array(dtype=wp.vec3)
    edges: wp.array(dtype=wp.vec2)  # cosine and sine of the half-angle
    cos_width: float
    sin_width: float


@wp.func
def find_node(quad: int, item: int, sphere_count: int, node_count: int):
    """Node of an item of a quad: its four spheres and then its own; −1 where there is none."""
    node = quad * QUAD + item
    last = sphere_count
    if item == QUAD:
        node = sphere_count + quad
        last = node_count
    if node >= last:
        node = -1
    return node


@wp.kernel(enable_backward=False)
def _bound(
    # in
    centers: wp.array2d(dtype=wp.vec3),
    radii: wp.array2d(dtype=wp.float32),
    sphere_count: int,
    quad_count: int,
    # out
    bounds: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a run of quads: center and radius of a sphere around all of theirs, negative for none."""
    batch, run = wp.tid()
    low = wp.vec3(wp.inf)
    high = wp.vec3(-wp.inf)
    for k in range(quad_count * ITEMS):
        node = find_node(run * quad_count + k // ITEMS, k % ITEMS, sphere_count, radii.shape[1])
        if node >= 0 and radii[batch, wp.max(node, 0)] > TINY_RADIUS:
            extent = wp.vec3(radii[batch, node])
            low = wp.min(low, centers[batch, node] - extent)
            high = wp.max(high, centers[batch, node] + extent)
    middle = 0.5 * (low + high)
    reach = float(-1.0)
    for k in range(quad_count * ITEMS):
        node = find_node(run * quad_count + k // ITEMS, k % ITEMS, sphere_count, radii.shape[1])
        if node >= 0 and radii[batch, wp.max(node, 0)] > TINY_RADIUS:
            reach = wp.max(reach, wp.length(centers[batch, node] - middle) + radii[batch, node])
    if reach < 0.0:
        middle = wp.vec3(0.0)
    bounds[batch, run] = wp.vec4(middle[0], middle[1], middle[2], reach)


def make_spheres(nodes: Nodes, sphere_count: int, merging_angle: float) -> Spheres:
    """Put spheres together with those around their quads and runs."""
    spheres = Spheres()
    spheres.centers, spheres.radii, spheres.extents = nodes
    spheres.count, spheres.merging_angle = sphere_count, merging_angle
    spheres.bounds_of_quads = _find_bounds(nodes, sphere_count, 1)
    spheres.bounds_of_runs = _find_bounds(nodes, sphere_count, QUADS)
    return spheres


def _find_bounds(nodes: Nodes, sphere_count: int, quad_count: int) -> wp.array:
    """Spheres around runs of quads, vec4 of shape [batch, run]."""
    batch_count = nodes.radii.shape[0]
    run_count = -(-sphere_count // (QUAD * quad_count))
    bounds = wp.empty((batch_count, run_count), dtype=wp.vec4, device=nodes.radii.device)
    wp.launch(
        _bound,
        dim=bounds.shape,
        inputs=[nodes.centers, nodes.radii, sphere_count, quad_count],
        outputs=[bounds],
        device=bounds.device,
        record_tape=False,
    )
    return bounds


def make_cells(directions: np.ndarray, width: float, device: wp.Device) -> Cells:
    """Put cells together with the cones around their bundles."""
    axes, cosine, sine = bundle_cones(directions, width)
    cells = Cells()
    cells.directions = constant(directions, wp.vec3, device)
    cells.axes = constant(axes, wp.vec3, device)
    cells.edges = constant(np.stack([cosine, sine], axis=-1), wp.vec2, device)
    cells.cos_width, cells.sin_width = float(np.cos(width)), float(np.sin(width))
    return cells


@functools.cache
def reach_function(lanes: int) -> wp.Function:
    """Make the kernel function that says whether a cone, widened by w, reaches that of a bundle for any receiver."""
    Lane = lane_type(lanes)
    is_any_above = lane_functions(lanes).is_any_above

    @wp.func
    def reaches(
        ux: Lane,
        uy: Lane,
        uz: Lane,
        cosine: Lane,
        sine: Lane,
        axis: wp.vec3,
        bundle_edge: wp.vec2,
    ):
        # u·axis > cos(θ + w + the bundle's half-angle), cosine and sine being those of θ + w
        limit = bundle_edge[0] * cosine - bundle_edge[1] * sine
        return is_any_above(axis[0] * ux + axis[1] * uy + axis[2] * uz - limit, 0.0)

    return reaches


@functools.cache
def rise_function(lanes: int) -> wp.Function:
    """Make the kernel function that says whether a cone, widened by w, rises above the horizon of any receiver."""
    Lane = lane_type(lanes)
    is_any_above = lane_functions(lanes).is_any_above

    @wp.func
    def rises(ux: Lane, uy: Lane, uz: Lane, cosine: Lane, sine: Lane, nx: Lane, ny: Lane, nz: Lane):
        # u·n > cos(90° + θ + w), which a cone wider than 90° does anyway
        height = wp.cw_mul(ux, nx) + wp.cw_mul(uy, ny) + wp.cw_mul(uz, nz)
        return is_any_above(height + sine + 1.0e9 * wp.max(Lane(0.0) - cosine, Lane(0.0)), 0.0)

    return rises


@functools.cache
def find_bundles_function(has_horizon: bool, lanes: int) -> wp.Function:
    """Make the kernel function that lists the bundles of directions that spheres can reach."""
    Lane = lane_type(lanes)
    sqrt, is_any_above = lane_functions(lanes).sqrt, lane_functions(lanes).is_any_above
    reaches, rises = reach_function(lanes), rise_function(lanes)

    @wp.func
    def find_bundles(
        x: Lane,
        y: Lane,
        z: Lane,
        nx: Lane,
        ny: Lane,
        nz: Lane,
        bound: wp.vec4,
        quad: int,
        first_bundle: int,
        cells: Cells,
        ends: wp.array(dtype=wp.int32),
        candidates: wp.array(dtype=wp.int32),
        candidate_count: int,
        found: wp.array(dtype=wp.int32),
    ):
        """Returns how many of the candidates, none for spheres that are wholly below the horizon."""
        count = int(0)
        if bound[3] > 0.0:
            reach = _REACH * bound[3]
            dx = Lane(bound[0]) - x
            dy = Lane(bound[1]) - y
            dz = Lane(bound[2]) - z
            distance = sqrt(wp.cw_mul(dx, dx) + wp.cw_mul(dy, dy) + wp.cw_mul(dz, dz))
            is_within = is_any_above(-distance, -reach)
            inverse = wp.cw_div(Lane(1.0), wp.max(distance, Lane(reach)))
            ux = wp.cw_mul(dx, inverse)
            uy = wp.cw_mul(dy, inverse)
            uz = wp.cw_mul(dz, inverse)
            sine = reach * inverse
            cosine = sqrt(Lane(1.0) - wp.cw_mul(sine, sine))
            wide_cosine = cells.cos_width * cosine - cells.sin_width * sine
            wide_sine = cells.sin_width * cosine + cells.cos_width * sine
            is_up = bool(True)
            if wp.static(has_horizon):
                is_up = is_within or rises(ux, uy, uz, wide_cosine, wide_sine, nx, ny, nz)
            if is_up:
                for k in range(candidate_count):
                    bundle = candidates[k]
                    if ends[bundle] > quad * ITEMS:
                        place = first_bundle + bundle
                        if is_within or reaches(
                            ux, uy, uz, wide_cosine, wide_sine, cells.axes[place], cells.edges[place]
                        ):
                            found[count] = bundle
                            count += 1
        return count

    return find_bundles
