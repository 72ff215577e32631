"""Visibility as transmittance towards cells of directions.

Each sphere lets 1 − A·smoothstep of the light of a cell pass, the step going from the blocked cone's edge outwards and
inwards by the softness w, and A making up for it so that the blocked solid angle is exactly the cone's:

    T_q(x) = Π_i (1 − A_i smoothstep((u_i·ω_q − lo_i) / (hi_i − lo_i)))
    lo = cos(θ+w),  hi = cos(max(θ−w, 0)),  A = min(1, (1 − cos θ) / (1 − (hi+lo)/2)),  w = κ·ρ,  ρ = 2/√Q

There is no band limit to ring, T stays in [0, 1] however many spheres overlap, tiny spheres neither vanish nor bloat,
and the soft edge has a smooth gradient.
"""

import functools

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.directions import BUNDLE, CHUNK, bundle_cones, check_count, edge_width
from warpshadow.lanes import MODULE_OPTIONS, group_count, lane_count, lane_functions, lane_type
from warpshadow.parallel import empty_scratch, launch_slices, scratch_place
from warpshadow.tape import record_adjoint
from warpshadow.visibility.cones import TINY_RADIUS, check_spheres, cone_adjoint, relative_cone_function

SOFTNESS = 0.35
"""κ: half-width of the soft edge in cell radii. More gives wider gradients and more bias."""

_OPAQUE = 1.0e-4  # below this transmittance a bundle is not looked at any more

_PAIR_COST = 3.0e-3
"""Nanoseconds that a sphere costs for a receiver and a direction, culling included."""


@functools.cache
def _reach_function(lanes: int) -> wp.Function:
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
def _rise_function(lanes: int) -> wp.Function:
    """Make the kernel function that says whether a cone, widened by w, rises above the horizon of any receiver."""
    Lane = lane_type(lanes)
    is_any_above = lane_functions(lanes).is_any_above

    @wp.func
    def rises(ux: Lane, uy: Lane, uz: Lane, cosine: Lane, sine: Lane, nx: Lane, ny: Lane, nz: Lane):
        # u·n > cos(90° + θ + w), which a cone wider than 90° does anyway
        height = wp.cw_mul(ux, nx) + wp.cw_mul(uy, ny) + wp.cw_mul(uz, nz)
        return is_any_above(height + sine + 1.0e9 * wp.max(-cosine, Lane(0.0)), 0.0)

    return rises


@functools.cache
def _edge_function(lanes: int) -> wp.Function:
    """Make the kernel function of a cone's soft edge: cos θ, sin θ, sin²θ, weight, lo, w → hi, 1/(hi−lo), A."""
    Lane = lane_type(lanes)
    sqrt = lane_functions(lanes).sqrt

    @wp.func
    def edge(cosine: Lane, sine: Lane, sine2: Lane, weight: Lane, low: Lane, cos_width: float, sin_width: float):
        # cos(max(θ − w, 0)): where θ < w the sine of the difference is cut off at 0
        inner = wp.max(cos_width * sine - sin_width * cosine, Lane(0.0))
        high = sqrt(Lane(1.0) - wp.cw_mul(inner, inner))
        slope = wp.cw_div(Lane(1.0), high - low)
        solid_angle = wp.cw_div(sine2, Lane(1.0) + cosine)
        opacity = wp.cw_div(solid_angle, Lane(1.0) - 0.5 * (high + low))
        return high, slope, wp.cw_mul(weight, wp.min(opacity, Lane(1.0)))

    return edge


@functools.cache
def _edge_adjoint(lanes: int) -> wp.Function:
    """Make the adjoint of :func:`_edge_function` → adjoints of cos θ, sin²θ and the weight.

    With k = 1 − cos θ the solid angle over 2π, h = 1 − (hi+lo)/2, g = k/h and m = min(1, g):

        w̄ = Ā m,  k̄ = Ā w/h and h̄ = −Ā w g/h where g < 1,  lo and hi each gain −h̄/2
        lo = cos w cos θ − sin w sin θ,  hi = √(1 − inner²),  inner = cos w sin θ − sin w cos θ where that is positive
    """
    Lane = lane_type(lanes)
    sqrt = lane_functions(lanes).sqrt

    @wp.func
    def adjoint(
        cosine: Lane,
        sine: Lane,
        sine2: Lane,
        weight: Lane,
        cos_width: float,
        sin_width: float,
        adj_low: Lane,
        adj_high: Lane,
        adj_opacity: Lane,
    ):
        low = cos_width * cosine - sin_width * sine
        inner = wp.max(cos_width * sine - sin_width * cosine, Lane(0.0))
        high = sqrt(Lane(1.0) - wp.cw_mul(inner, inner))
        inverse = wp.cw_div(Lane(1.0), Lane(1.0) - 0.5 * (high + low))
        share = wp.cw_mul(wp.cw_div(sine2, Lane(1.0) + cosine), inverse)
        is_partial = wp.min(wp.max((Lane(1.0) - share) * 1.0e20, Lane(0.0)), Lane(1.0))
        adj_weight = wp.cw_mul(adj_opacity, wp.min(share, Lane(1.0)))
        adj_solid_angle = wp.cw_mul(wp.cw_mul(is_partial, wp.cw_mul(adj_opacity, weight)), inverse)
        gain = 0.5 * wp.cw_mul(adj_solid_angle, share)
        low_ = adj_low + gain
        high_ = adj_high + gain
        adj_inner = -wp.cw_div(wp.cw_mul(high_, inner), high)
        adj_cosine = cos_width * low_ - sin_width * adj_inner - adj_solid_angle
        adj_sine = cos_width * adj_inner - sin_width * low_
        adj_sine2 = wp.cw_div(0.5 * adj_sine, wp.max(sine, Lane(1.0e-18)))
        return adj_cosine, adj_sine2, adj_weight

    return adjoint


RUN = 16
"""Spheres that are culled together, in the order in which they are given: best near each other."""


@wp.kernel(enable_backward=False)
def _bound_runs(
    # in
    centers: wp.array2d(dtype=wp.vec3),
    radii: wp.array2d(dtype=wp.float32),
    # out
    bounds: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a run of spheres: center and radius of a sphere around them, which is negative for none."""
    batch, run = wp.tid()
    begin = run * RUN
    end = wp.min(begin + RUN, radii.shape[1])
    low = wp.vec3(wp.inf)
    high = wp.vec3(-wp.inf)
    for sphere in range(begin, end):
        if radii[batch, sphere] > TINY_RADIUS:
            extent = wp.vec3(radii[batch, sphere])
            low = wp.min(low, centers[batch, sphere] - extent)
            high = wp.max(high, centers[batch, sphere] + extent)
    middle = 0.5 * (low + high)
    reach = float(-1.0)
    for sphere in range(begin, end):
        if radii[batch, sphere] > TINY_RADIUS:
            reach = wp.max(reach, wp.length(centers[batch, sphere] - middle) + radii[batch, sphere])
    if reach < 0.0:
        middle = wp.vec3(0.0)
    bounds[batch, run] = wp.vec4(middle[0], middle[1], middle[2], reach)


@functools.cache
def _load_normals_function(has_horizon: bool, lanes: int) -> wp.Function:
    """Make the kernel function that loads the normals of a group, 0 where there is no horizon."""
    Lane = lane_type(lanes)
    load = lane_functions(lanes).load

    @wp.func
    def load_normals(normals: wp.array2d(dtype=wp.vec3), batch: int, group: int):
        x = Lane(0.0)
        y = Lane(0.0)
        z = Lane(0.0)
        if wp.static(has_horizon):
            x, y, z = load(normals[batch], group)
        return x, y, z

    return load_normals


@functools.cache
def _find_bundles_function(has_horizon: bool, lanes: int) -> wp.Function:
    """Make the kernel function that lists the bundles of directions that a run of spheres can reach."""
    Lane = lane_type(lanes)
    sqrt, is_any_above = lane_functions(lanes).sqrt, lane_functions(lanes).is_any_above
    reaches, rises = _reach_function(lanes), _rise_function(lanes)

    @wp.func
    def find_bundles(
        x: Lane,
        y: Lane,
        z: Lane,
        nx: Lane,
        ny: Lane,
        nz: Lane,
        bound: wp.vec4,
        sphere: int,
        first_bundle: int,
        axes: wp.array(dtype=wp.vec3),
        edges: wp.array(dtype=wp.vec2),
        cos_width: float,
        sin_width: float,
        ends: wp.array(dtype=wp.int32),
        found: wp.array(dtype=wp.int32),
    ):
        """Returns how many, 0 for a run that is wholly below the horizon."""
        count = int(0)
        if bound[3] > 0.0:
            reach = 1.001 * bound[3]  # rounding included
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
            wide_cosine = cos_width * cosine - sin_width * sine
            wide_sine = sin_width * cosine + cos_width * sine
            is_up = bool(True)
            if wp.static(has_horizon):
                is_up = is_within or rises(ux, uy, uz, wide_cosine, wide_sine, nx, ny, nz)
            if is_up:
                for bundle in range(ends.shape[0]):
                    if ends[bundle] > sphere:
                        place = first_bundle + bundle
                        if is_within or reaches(ux, uy, uz, wide_cosine, wide_sine, axes[place], edges[place]):
                            found[count] = bundle
                            count += 1
        return count

    return find_bundles


@functools.cache
def _block_function(lanes: int) -> wp.Function:
    """Make the kernel function that lets a sphere block its share of what passes towards a bundle of directions."""
    Lane = lane_type(lanes)
    is_any_above = lane_functions(lanes).is_any_above

    @wp.func
    def block(
        ux: Lane,
        uy: Lane,
        uz: Lane,
        low: Lane,
        slope: Lane,
        opacity: Lane,
        direction: int,
        directions: wp.array(dtype=wp.vec3),
        place: int,
        passing: wp.array(dtype=Lane),
    ):
        """Returns whether anything is left."""
        most = Lane(0.0)
        for i in range(BUNDLE):
            omega = directions[direction + i]
            t = wp.cw_mul(omega[0] * ux + omega[1] * uy + omega[2] * uz - low, slope)
            t = wp.min(wp.max(t, Lane(0.0)), Lane(1.0))
            step = wp.cw_mul(wp.cw_mul(t, t), Lane(3.0) - 2.0 * t)
            left = wp.cw_mul(passing[place + i], Lane(1.0) - wp.cw_mul(opacity, step))
            most = wp.max(most, left)
            passing[place + i] = left
        return is_any_above(most, _OPAQUE)

    return block


@functools.cache
def _transmit_kernel(has_horizon: bool, lanes: int) -> wp.Kernel:
    Lane = lane_type(lanes)
    fn = lane_functions(lanes)
    find_group, load, load_normals = fn.find_group, fn.load, _load_normals_function(has_horizon, lanes)
    store_columns, sqrt, is_any_above = fn.store_columns, fn.sqrt, fn.is_any_above
    cone, edge, block = relative_cone_function(lanes), _edge_function(lanes), _block_function(lanes)
    reaches, rises = _reach_function(lanes), _rise_function(lanes)
    find_bundles = _find_bundles_function(has_horizon, lanes)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, enable_backward=False)
    def transmit(
        first_row: int,
        worker: int,
        # in
        points: wp.array2d(dtype=wp.vec3),
        normals: wp.array2d(dtype=wp.vec3),
        centers: wp.array2d(dtype=wp.vec3),
        radii: wp.array2d(dtype=wp.float32),
        bounds: wp.array2d(dtype=wp.vec4),
        directions: wp.array(dtype=wp.vec3),
        axes: wp.array(dtype=wp.vec3),
        edges: wp.array(dtype=wp.vec2),
        cos_width: float,
        sin_width: float,
        # scratch
        scratch: wp.array2d(dtype=Lane),
        found_bundles: wp.array2d(dtype=wp.int32),
        # out
        all_ends: wp.array3d(dtype=wp.int32),
        transmittance: wp.array3d(dtype=wp.float32),
    ):
        """A thread owns a group of receivers and a span of bundles; ends are the spheres where it stopped looking."""
        item, span = wp.tid()
        row = first_row + item
        batch, group = find_group(row, points.shape[1])
        place = scratch_place(worker, row * all_ends.shape[1] + span)
        passing = scratch[place]
        found = found_bundles[place]
        ends = all_ends[row, span]
        first_bundle = span * ends.shape[0]
        x, y, z = load(points[batch], group)
        nx, ny, nz = load_normals(normals, batch, group)
        for bundle in range(ends.shape[0]):
            for i in range(BUNDLE):
                passing[bundle * BUNDLE + i] = Lane(1.0)
            ends[bundle] = centers.shape[1]
            if wp.static(has_horizon):
                axis = axes[first_bundle + bundle]
                height = axis[0] * nx + axis[1] * ny + axis[2] * nz
                if not is_any_above(height, -edges[first_bundle + bundle][1]):
                    ends[bundle] = 0  # wholly below the horizon: the cosine is zero there
        for run in range(bounds.shape[1]):
            begin = run * RUN
            end = wp.min(begin + RUN, centers.shape[1])
            found_count = find_bundles(
                x,
                y,
                z,
                nx,
                ny,
                nz,
                bounds[batch, run],
                begin,
                first_bundle,
                axes,
                edges,
                cos_width,
                sin_width,
                ends,
                found,
            )
            if found_count == 0:
                end = begin
            for sphere in range(begin, end):
                radius = radii[batch, sphere]
                center = centers[batch, sphere]
                if radius > TINY_RADIUS:
                    curvature = 1.0 / radius
                    ux, uy, uz, cosine, sine2, weight = cone(
                        curvature * (Lane(center[0]) - x),
                        curvature * (Lane(center[1]) - y),
                        curvature * (Lane(center[2]) - z),
                    )
                    sine = sqrt(sine2)
                    low = cos_width * cosine - sin_width * sine
                    wide_sine = sin_width * cosine + cos_width * sine
                    is_up = bool(True)
                    if wp.static(has_horizon):
                        is_up = rises(ux, uy, uz, low, wide_sine, nx, ny, nz)
                    if is_up:
                        _high, slope, opacity = edge(cosine, sine, sine2, weight, low, cos_width, sin_width)
                        for k in range(found_count):
                            bundle = found[k]
                            at = first_bundle + bundle
                            is_met = ends[bundle] > sphere
                            if is_met:
                                is_met = reaches(ux, uy, uz, low, wide_sine, axes[at], edges[at])
                            if is_met:
                                is_left = block(
                                    ux, uy, uz, low, slope, opacity, at * BUNDLE, directions, bundle * BUNDLE, passing
                                )
                                if not is_left:
                                    ends[bundle] = sphere + 1
        count = ends.shape[0] * BUNDLE
        store_columns(passing, first_bundle * BUNDLE, count, group, transmittance[batch])

    return transmit


@functools.cache
def _transmit_adjoint_kernel(has_horizon: bool, lanes: int) -> wp.Kernel:
    Lane = lane_type(lanes)
    fn = lane_functions(lanes)
    find_group, load, load_normals = fn.find_group, fn.load, _load_normals_function(has_horizon, lanes)
    load_products, sqrt, add_vectors, add_to_sphere = fn.load_products, fn.sqrt, fn.add_vectors, fn.add_to_sphere
    cone, cone_adjoint_ = relative_cone_function(lanes), cone_adjoint(lanes)
    edge, edge_adjoint = _edge_function(lanes), _edge_adjoint(lanes)
    reaches, rises = _reach_function(lanes), _rise_function(lanes)
    find_bundles = _find_bundles_function(has_horizon, lanes)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, enable_backward=False)
    def transmit_adjoint(
        first_row: int,
        worker: int,
        # in
        points: wp.array2d(dtype=wp.vec3),
        normals: wp.array2d(dtype=wp.vec3),
        centers: wp.array2d(dtype=wp.vec3),
        radii: wp.array2d(dtype=wp.float32),
        bounds: wp.array2d(dtype=wp.vec4),
        directions: wp.array(dtype=wp.vec3),
        axes: wp.array(dtype=wp.vec3),
        edges: wp.array(dtype=wp.vec2),
        cos_width: float,
        sin_width: float,
        all_ends: wp.array3d(dtype=wp.int32),
        transmittance: wp.array3d(dtype=wp.float32),
        adj_transmittance: wp.array3d(dtype=wp.float32),
        # scratch
        scratch: wp.array2d(dtype=Lane),
        found_bundles: wp.array2d(dtype=wp.int32),
        # out
        adj_points: wp.array2d(dtype=wp.vec3),
        adj_centers: wp.array2d(dtype=wp.vec3),
        adj_radii: wp.array2d(dtype=wp.float32),
    ):
        """A thread owns a group of receivers and a span of bundles.

        With a = A·step(t) the share that a sphere blocks and t = (u·ω − lo) slope:
        ā_i = −T̄ T / (1 − a_i),  Ā = Σ ā step,  t̄ = ā A 6t(1−t),
        ū = slope Σ t̄ ω,  lō = slope (Σ t̄ t − Σ t̄),  hī = −slope Σ t̄ t
        """
        item, span = wp.tid()
        row = first_row + item
        batch, group = find_group(row, points.shape[1])
        place = scratch_place(worker, row * all_ends.shape[1] + span)
        products = scratch[place]
        found = found_bundles[place]
        ends = all_ends[row, span]
        first_bundle = span * ends.shape[0]
        count = ends.shape[0] * BUNDLE
        load_products(transmittance[batch], adj_transmittance[batch], first_bundle * BUNDLE, count, group, products)
        x, y, z = load(points[batch], group)
        nx, ny, nz = load_normals(normals, batch, group)
        adj_x = Lane(0.0)
        adj_y = Lane(0.0)
        adj_z = Lane(0.0)
        for run in range(bounds.shape[1]):
            begin = run * RUN
            end = wp.min(begin + RUN, centers.shape[1])
            found_count = find_bundles(
                x,
                y,
                z,
                nx,
                ny,
                nz,
                bounds[batch, run],
                begin,
                first_bundle,
                axes,
                edges,
                cos_width,
                sin_width,
                ends,
                found,
            )
            if found_count == 0:
                end = begin
            for sphere in range(begin, end):
                radius = radii[batch, sphere]
                center = centers[batch, sphere]
                if radius > TINY_RADIUS:
                    curvature = 1.0 / radius
                    dx = curvature * (Lane(center[0]) - x)
                    dy = curvature * (Lane(center[1]) - y)
                    dz = curvature * (Lane(center[2]) - z)
                    ux, uy, uz, cosine, sine2, weight = cone(dx, dy, dz)
                    sine = sqrt(sine2)
                    low = cos_width * cosine - sin_width * sine
                    wide_sine = sin_width * cosine + cos_width * sine
                    is_up = bool(True)
                    if wp.static(has_horizon):
                        is_up = rises(ux, uy, uz, low, wide_sine, nx, ny, nz)
                    if is_up:
                        _high, slope, opacity = edge(cosine, sine, sine2, weight, low, cos_width, sin_width)
                        is_any_met = bool(False)
                        sum_ = Lane(0.0)
                        sum_t = Lane(0.0)
                        sum_x = Lane(0.0)
                        sum_y = Lane(0.0)
                        sum_z = Lane(0.0)
                        adj_opacity = Lane(0.0)
                        for k in range(found_count):
                            bundle = found[k]
                            at = first_bundle + bundle
                            is_met = ends[bundle] > sphere
                            if is_met:
                                is_met = reaches(ux, uy, uz, low, wide_sine, axes[at], edges[at])
                            if is_met:
                                is_any_met = True
                                for i in range(BUNDLE):
                                    omega = directions[at * BUNDLE + i]
                                    t = wp.cw_mul(omega[0] * ux + omega[1] * uy + omega[2] * uz - low, slope)
                                    t = wp.min(wp.max(t, Lane(0.0)), Lane(1.0))
                                    step = wp.cw_mul(wp.cw_mul(t, t), Lane(3.0) - 2.0 * t)
                                    left = wp.max(Lane(1.0) - wp.cw_mul(opacity, step), Lane(1.0e-7))
                                    adj_blocked = -wp.cw_div(products[bundle * BUNDLE + i], left)
                                    adj_opacity += wp.cw_mul(adj_blocked, step)
                                    rise = wp.cw_mul(t, Lane(1.0) - t)
                                    adj_t = 6.0 * wp.cw_mul(wp.cw_mul(adj_blocked, opacity), rise)
                                    sum_ += adj_t
                                    sum_t += wp.cw_mul(adj_t, t)
                                    sum_x += omega[0] * adj_t
                                    sum_y += omega[1] * adj_t
                                    sum_z += omega[2] * adj_t
                        if is_any_met:
                            adj_low = wp.cw_mul(slope, sum_t - sum_)
                            adj_high = -wp.cw_mul(slope, sum_t)
                            adj_cosine, adj_sine2, adj_weight = edge_adjoint(
                                cosine, sine, sine2, weight, cos_width, sin_width, adj_low, adj_high, adj_opacity
                            )
                            adj_dx, adj_dy, adj_dz, adj_radius = cone_adjoint_(
                                dx,
                                dy,
                                dz,
                                curvature,
                                wp.cw_mul(slope, sum_x),
                                wp.cw_mul(slope, sum_y),
                                wp.cw_mul(slope, sum_z),
                                adj_cosine,
                                adj_sine2,
                                adj_weight,
                            )
                            adj_x -= adj_dx
                            adj_y -= adj_dy
                            adj_z -= adj_dz
                            add_to_sphere(adj_dx, adj_dy, adj_dz, adj_radius, batch, sphere, adj_centers, adj_radii)
        if adj_points:
            add_vectors(adj_x, adj_y, adj_z, group, adj_points[batch])

    return transmit_adjoint


def transmittance(
    points: wp.array,
    normals: wp.array | None,
    centers: wp.array,
    radii: wp.array,
    directions: np.ndarray,
    *,
    softness: float = SOFTNESS,
) -> wp.array:
    """Transmittance of spheres towards cells of directions.

    Args:
        points: Receiver positions [scene units], vec3 of shape [batch, vertex].
        normals: Unit normals, vec3 of shape [batch, vertex]: what lies below a receiver's horizon, where the cosine
            is zero, may be left at 1. None computes it all.
        centers: Sphere centers [scene units], vec3 of shape [batch, sphere].
        radii: Sphere radii [scene units], float32 of shape [batch, sphere]; a radius of 0 blocks nothing.
        directions: Unit vectors ω, NumPy of shape [direction, 3], from :func:`warpshadow.directions.fibonacci`.
        softness: κ, half-width of the soft edge in cell radii.

    Returns:
        Transmittance in [0, 1], float32 of shape [batch, vertex, direction].

    Raises:
        ValueError: naming the argument, what it got and what it accepts; so for NaN, Inf, numbers beyond 1e18 and
            negative radii. (On a GPU that reads a count back, and is left out while a CUDA graph is captured.)

    Differentiable: points, centers, radii. Not: normals (they only cull), directions, softness.
    """
    check.shape("directions", directions.shape, ("direction", 3))
    check_count("directions", len(directions))
    check.finite("directions", directions)
    if not np.allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-3):
        raise ValueError("directions: got vectors of other lengths, expected unit vectors")
    width = edge_width(softness, len(directions))
    check_spheres(points, normals, centers, radii)
    device = points.device
    lanes = lane_count(device)
    batch_count, vertex_count = points.shape
    axes, cosine, sine = bundle_cones(directions, width)
    cells = [
        wp.array(directions, dtype=wp.vec3, device=device),
        wp.array(axes, dtype=wp.vec3, device=device),
        wp.array(np.stack([cosine, sine], axis=-1), dtype=wp.vec2, device=device),
        float(np.cos(width)),
        float(np.sin(width)),
    ]
    # threads for a group: on a CPU one, which finds a sphere's cone once for all directions
    span_count = 1 if device.is_cpu else len(directions) // CHUNK
    bundle_count = len(axes) // span_count
    bounds = wp.empty((batch_count, -(-radii.shape[1] // RUN)), dtype=wp.vec4, device=device)
    wp.launch(
        _bound_runs, dim=bounds.shape, inputs=[centers, radii], outputs=[bounds], device=device, record_tape=False
    )
    row_count = batch_count * group_count(vertex_count, lanes)
    dim = row_count, span_count
    scratch = [
        empty_scratch(row_count * span_count, (bundle_count * BUNDLE,), lane_type(lanes), device),
        empty_scratch(row_count * span_count, (bundle_count,), wp.int32, device),
    ]
    ends = wp.empty((*dim, bundle_count), dtype=wp.int32, device=device)
    variables = [points, centers, radii]
    result = wp.empty(
        (batch_count, vertex_count, len(directions)),
        dtype=wp.float32,
        device=device,
        requires_grad=any(variable.requires_grad for variable in variables),
    )
    cost = _PAIR_COST * lanes * radii.shape[1] * bundle_count * BUNDLE
    launch_slices(
        _transmit_kernel(normals is not None, lanes),
        dim=dim,
        cost=cost,
        inputs=[points, normals, centers, radii, bounds, *cells, *scratch],
        outputs=[ends, result],
        device=device,
    )

    def adjoint() -> None:
        launch_slices(
            _transmit_adjoint_kernel(normals is not None, lanes),
            dim=dim,
            cost=2 * cost,
            inputs=[points, normals, centers, radii, bounds, *cells, ends, result, result.grad, *scratch],
            outputs=[points.grad],
            sums=[centers.grad, radii.grad],
            device=device,
        )

    record_adjoint(adjoint, [*variables, result])
    return result
