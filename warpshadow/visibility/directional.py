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
from warpshadow.directions import CHUNK, cell_radius, check_count, chunk_cones
from warpshadow.lanes import MODULE_OPTIONS, group_count, lane_count, lane_functions, lane_type
from warpshadow.visibility.cones import cone_function

SOFTNESS = 0.35
"""κ: half-width of the soft edge in cell radii. More gives wider gradients and more bias."""

_OPAQUE = 1.0e-4  # below this transmittance a chunk is not looked at any more


@functools.cache
def _transmittance_kernel(has_horizon: bool, lanes: int) -> wp.Kernel:
    Lane = lane_type(lanes)
    fn = lane_functions(lanes)
    load, store_columns, sqrt = fn.load, fn.store_columns, fn.sqrt
    cone = cone_function(lanes)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, enable_backward=False)
    def transmit(
        # in
        points: wp.array2d(dtype=wp.vec3),
        normals: wp.array2d(dtype=wp.vec3),
        centers: wp.array2d(dtype=wp.vec3),
        radii: wp.array2d(dtype=wp.float32),
        directions: wp.array(dtype=wp.vec3),
        chunk_axes: wp.array(dtype=wp.vec3),
        chunk_edges: wp.array(dtype=wp.vec2),
        cos_width: float,
        sin_width: float,
        # scratch
        scratch: wp.array3d(dtype=Lane),
        # out
        transmittance: wp.array3d(dtype=wp.float32),
    ):
        """A thread owns a group of receivers and a chunk of 16 directions."""
        batch, group, chunk = wp.tid()
        begin = chunk * CHUNK
        row = scratch[batch, group]
        for q in range(begin, begin + CHUNK):
            row[q] = Lane(1.0)
        x, y, z = load(points[batch], group)
        axis = chunk_axes[chunk]
        edge_cosine = chunk_edges[chunk][0]
        edge_sine = chunk_edges[chunk][1]
        brightest = float(1.0)
        if wp.static(has_horizon):
            nx, ny, nz = load(normals[batch], group)
            if wp.max(axis[0] * nx + axis[1] * ny + axis[2] * nz) < -edge_sine:
                brightest = 0.0  # wholly below the horizon: the cosine is zero there
        sphere = int(0)
        while sphere < centers.shape[1] and brightest > _OPAQUE:
            radius = radii[batch, sphere]
            center = centers[batch, sphere]
            if radius > 0.0:
                ux, uy, uz, cosine, sine2, weight = cone(
                    Lane(center[0]) - x, Lane(center[1]) - y, Lane(center[2]) - z, radius
                )
                sine = sqrt(sine2)
                low = cos_width * cosine - sin_width * sine
                # does the cone, widened, reach the chunk's?
                reach = edge_cosine * low - edge_sine * (sin_width * cosine + cos_width * sine)
                if wp.max(axis[0] * ux + axis[1] * uy + axis[2] * uz - reach) > 0.0:
                    # cos(max(θ − w, 0)): where θ < w the sine of the difference is cut off at 0
                    inner = wp.max(cos_width * sine - sin_width * cosine, Lane(0.0))
                    high = sqrt(Lane(1.0) - wp.cw_mul(inner, inner))
                    slope = wp.cw_div(Lane(1.0), high - low)
                    offset = -wp.cw_mul(low, slope)
                    ux = wp.cw_mul(ux, slope)
                    uy = wp.cw_mul(uy, slope)
                    uz = wp.cw_mul(uz, slope)
                    solid_angle = wp.cw_div(sine2, Lane(1.0) + cosine)
                    opacity = wp.cw_div(solid_angle, Lane(1.0) - 0.5 * (high + low))
                    opacity = wp.cw_mul(weight, wp.min(opacity, Lane(1.0)))
                    most = Lane(0.0)
                    for q in range(begin, begin + CHUNK):
                        omega = directions[q]
                        t = omega[0] * ux + omega[1] * uy + omega[2] * uz + offset
                        t = wp.min(wp.max(t, Lane(0.0)), Lane(1.0))
                        step = wp.cw_mul(wp.cw_mul(t, t), Lane(3.0) - 2.0 * t)
                        passing = wp.cw_mul(row[q], Lane(1.0) - wp.cw_mul(opacity, step))
                        most = wp.max(most, passing)
                        row[q] = passing
                    brightest = wp.max(most)
            sphere += 1
        store_columns(row, begin, CHUNK, group, transmittance[batch])

    return transmit


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
        normals: Unit normals, vec3 of shape [batch, vertex]: chunks of directions wholly below a receiver's horizon,
            where the cosine is zero, are left at 1. None computes them all.
        centers: Sphere centers [scene units], vec3 of shape [batch, sphere].
        radii: Sphere radii [scene units], float32 of shape [batch, sphere]; a radius of 0 blocks nothing.
        directions: Unit vectors ω, NumPy of shape [direction, 3], from :func:`warpshadow.directions.fibonacci`.
        softness: κ, half-width of the soft edge in cell radii.

    Returns:
        Transmittance in [0, 1], float32 of shape [batch, vertex, direction].

    Raises:
        ValueError: naming the argument, what it got and what it accepts.

    Differentiable: nothing yet.
    """
    check.shape("directions", directions.shape, ("direction", 3))
    check_count("directions", len(directions))
    width = softness * cell_radius(len(directions))
    if not 0 < width < np.pi / 4:
        raise ValueError(
            f"softness: got {softness!r} for {len(directions)} directions, expected a half-width "
            f"softness·2/√directions above 0 and below π/4"
        )
    device = points.device
    lanes = lane_count(device)
    batch_count, vertex_count = points.shape
    if normals is not None:
        check.shape("normals", normals.shape, points.shape)
    check.shape("centers", centers.shape, (batch_count, "sphere"))
    check.shape("radii", radii.shape, centers.shape)
    groups = group_count(vertex_count, lanes)
    axes, cosine, sine = chunk_cones(directions, width)
    result = wp.empty((batch_count, vertex_count, len(directions)), dtype=wp.float32, device=device)
    wp.launch(
        _transmittance_kernel(normals is not None, lanes),
        dim=(batch_count, groups, len(axes)),
        inputs=[
            points,
            normals,
            centers,
            radii,
            wp.array(directions, dtype=wp.vec3, device=device),
            wp.array(axes, dtype=wp.vec3, device=device),
            wp.array(np.stack([cosine, sine], axis=-1), dtype=wp.vec2, device=device),
            float(np.cos(width)),
            float(np.sin(width)),
            wp.empty((batch_count, groups, len(directions)), dtype=lane_type(lanes), device=device),
        ],
        outputs=[result],
        device=device,
    )
    return result
