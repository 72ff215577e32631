"""A cell of directions hits a plane: the covered part, and the radiosity there, with gradients.

Seen from a receiver x, a cell with direction ω and angular radius ρ = 2/√Q meets a plane with normal N, which is the
distance d below the receiver:

    c = −N·ω                                  cosine
    c′ = ρ s(c/ρ)                             mean cosine of the part of the cell that is below the plane's horizon:
                                              s(z) = z from z = 1 on; below 1/3 + 2/3 ((z + 1)/2)³, a cubic that
                                              joins with slope 1, and has slope 0 at z = −1, the cell's other edge
    t = d / c′                                distance
    y = x + t ω                               where, in the plane

The plane covers the part h of the cell that is within its outline (:mod:`warpshadow.stages.cell_coverage`); where edges
are many, the part within its rectangle times the mesh's share of the footprint, by texels.

Radiosity is bilinear in two mip levels of the grid, blended so that texels are half as wide as the footprint t ρ / √c′,
the geometric mean of both its axes: bilinear means reach twice as far. (Under the roof of a barn the light of the
ground is 7% too strong, with texels as wide as the footprint 17 to 23%.)

No receiver is nearer to a side than a margin, so that t is not 0. :mod:`.fronts` says which side a receiver is on; by
height alone the weight of the front falls from 1 in the plane to 0 a margin below it, where the back has 1.
"""

from weakref import WeakKeyDictionary

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.stages.planes.plane_blockers import PlaneBlockers, PlaneGrid


@wp.struct
class PlaneArrays:
    """The planes as kernels read them."""

    grids: wp.array(dtype=PlaneGrid)
    levels: wp.array(dtype=wp.vec3i)
    level_scales: wp.array(dtype=wp.vec2)
    covered: wp.array(dtype=wp.vec3)
    edges: wp.array(dtype=wp.vec4)
    edge_axes: wp.array(dtype=wp.vec2)
    self_plane: int  # the plane that the receivers are part of, -1 for none
    radius: float  # ρ
    per_radius: float


def check_planes(
    planes: PlaneBlockers, points: wp.array, frames: wp.array, directions: np.ndarray, self_plane: int | None
) -> None:
    """Raise ValueError for arrays that do not fit together."""
    check.shape("points", points.shape, ("batch", "receiver"))
    check.shape("directions", directions.shape, ("direction", 3))
    check.shape("frames", frames.shape, ("batch", 3 * planes.count))
    if self_plane is not None:
        check.choice("self_plane", self_plane, range(planes.count))


_ARRAYS: WeakKeyDictionary[PlaneBlockers, dict[tuple[float, int | None], PlaneArrays]] = WeakKeyDictionary()


def plane_arrays(planes: PlaneBlockers, radius: float, self_plane: int | None) -> PlaneArrays:
    """Plane blockers as seen in cells of a radius [rad] by receivers that are part of one, or of none."""
    known, key = _ARRAYS.setdefault(planes, {}), (radius, self_plane)
    if key in known:
        return known[key]
    arrays = PlaneArrays()
    arrays.grids, arrays.levels, arrays.level_scales = planes.grids, planes.levels, planes.level_scales
    arrays.covered, arrays.edges, arrays.edge_axes = planes.covered, planes.edges, planes.edge_axes
    arrays.self_plane, arrays.radius = -1 if self_plane is None else self_plane, radius
    arrays.per_radius = 1 / arrays.radius
    known[key] = arrays
    return arrays


@wp.func
def smoothstep_slope(z: float):
    """Derivative of the smoothstep from 0 at −1 to 1 at 1."""
    u = wp.clamp(0.5 * z + 0.5, 0.0, 1.0)
    return 3.0 * u * (1.0 - u)


# ---------------------------------------------------------------------------------------------------- receivers


@wp.struct
class LocalReceiver:
    """A receiver in the axes of a plane."""

    position: wp.vec3  # along both axes, and its height [units of the body]
    axis_u: wp.vec3  # axes of unit length
    axis_v: wp.vec3
    normal: wp.vec3  # 0 where the plane has no area
    scale: float  # of the body


@wp.func
def find_local_receiver(point: wp.vec3, frames: wp.array(dtype=wp.vec3), plane: int):
    """Transform a receiver to the axes of a plane."""
    local_receiver = LocalReceiver()
    scale_u = wp.length(frames[3 * plane + 1])
    scale_v = wp.length(frames[3 * plane + 2])
    if scale_u > 0.0 and scale_v > 0.0:
        local_receiver.axis_u = frames[3 * plane + 1] / scale_u
        local_receiver.axis_v = frames[3 * plane + 2] / scale_v
        local_receiver.normal = wp.cross(local_receiver.axis_u, local_receiver.axis_v)
        local_receiver.scale = scale_u
        offset = point - frames[3 * plane]
        local_receiver.position = wp.vec3(
            wp.dot(offset, local_receiver.axis_u) / scale_u,
            wp.dot(offset, local_receiver.axis_v) / scale_v,
            wp.dot(offset, local_receiver.normal) / scale_u,
        )
    return local_receiver


@wp.func
def find_local_receiver_adjoint(
    point: wp.vec3,
    frames: wp.array(dtype=wp.vec3),
    plane: int,
    local_receiver: LocalReceiver,
    adj_receiver: LocalReceiver,
    instance: int,
    adj_frames: wp.array2d(dtype=wp.vec3),
):
    """Add to the gradients of the frames of an instance; returns the point's gradient."""
    scale_u = wp.length(frames[3 * plane + 1])
    scale_v = wp.length(frames[3 * plane + 2])
    if not (scale_u > 0.0 and scale_v > 0.0):
        return wp.vec3()
    offset = point - frames[3 * plane]
    adj_x = adj_receiver.position[0] / scale_u
    adj_y = adj_receiver.position[1] / scale_v
    adj_height = adj_receiver.position[2] / scale_u
    adj_offset = adj_x * local_receiver.axis_u + adj_y * local_receiver.axis_v + adj_height * local_receiver.normal
    if adj_frames:
        adj_normal = adj_receiver.normal + adj_height * offset
        adj_u = adj_receiver.axis_u + adj_x * offset + wp.cross(local_receiver.axis_v, adj_normal)
        adj_v = adj_receiver.axis_v + adj_y * offset + wp.cross(adj_normal, local_receiver.axis_u)
        # of an axis' direction, and of its length
        adj_u = (adj_u - wp.dot(adj_u, local_receiver.axis_u) * local_receiver.axis_u) / scale_u + (
            adj_receiver.scale - adj_x * local_receiver.position[0] - adj_height * local_receiver.position[2]
        ) * local_receiver.axis_u
        adj_v = (adj_v - wp.dot(adj_v, local_receiver.axis_v) * local_receiver.axis_v) / scale_v - (
            adj_y * local_receiver.position[1]
        ) * local_receiver.axis_v
        wp.atomic_add(adj_frames, instance, 3 * plane, -adj_offset)
        wp.atomic_add(adj_frames, instance, 3 * plane + 1, adj_u)
        wp.atomic_add(adj_frames, instance, 3 * plane + 2, adj_v)
    return adj_offset


@wp.func
def front_of(
    front_weights: wp.array3d(dtype=wp.float32), grid: PlaneGrid, height: float, batch: int, receiver: int, plane: int
):
    """Weight of the front that a receiver sees, given or by its height."""
    if front_weights:
        return front_weights[batch, receiver, plane]
    return front_weight(grid, height)


@wp.func
def front_of_adjoint(
    front_weights: wp.array3d(dtype=wp.float32),
    grid: PlaneGrid,
    height: float,
    adj_front: float,
    batch: int,
    receiver: int,
    plane: int,
    adj_front_weights: wp.array3d(dtype=wp.float32),
):
    """Add to the gradient of the front weights, or return the height's gradient where there are none."""
    if front_weights:
        if adj_front_weights:
            adj_front_weights[batch, receiver, plane] = adj_front_weights[batch, receiver, plane] + adj_front
        return float(0.0)
    return adj_front * front_weight_slope(grid, height)


@wp.func
def front_weight(grid: PlaneGrid, height: float):
    """Weight of the front that a receiver at a height sees; the back has the rest."""
    return wp.smoothstep(-1.0, 1.0, 1.0 + 2.0 * height / grid.margin)


@wp.func
def front_weight_slope(grid: PlaneGrid, height: float):
    """Derivative of :func:`front_weight` by the height."""
    return smoothstep_slope(1.0 + 2.0 * height / grid.margin) * 2.0 / grid.margin


# ---------------------------------------------------------------------------------------------------- footprints


@wp.struct
class PlaneFootprint:
    """Footprint of a cell on a plane, for a receiver over one side."""

    distance: float  # [units of the body]
    per_cosine: float  # 1 / c′, the mean cosine of the part of the cell below the horizon
    center: wp.vec2  # in the plane
    extent: float  # its width over a whole cell's


@wp.func
def find_footprint(planes: PlaneArrays, position: wp.vec3, direction: wp.vec3):
    """Find the footprint of a cell on a side.

    Args:
        planes: Have the radius of cells.
        position: Where the receiver is: along both axes, and its height above the side.
        direction: Direction of the cell along both axes, and its cosine, above −ρ.
    """
    footprint = PlaneFootprint()
    footprint.extent = 1.0
    cosine = direction[2]
    if cosine < planes.radius:
        u = 0.5 * cosine * planes.per_radius + 0.5
        cosine = planes.radius * (1.0 / 3.0 + 2.0 / 3.0 * u * u * u)
    footprint.per_cosine = 1.0 / cosine
    footprint.distance = position[2] * footprint.per_cosine
    footprint.center = wp.vec2(
        position[0] + footprint.distance * direction[0], position[1] + footprint.distance * direction[1]
    )
    return footprint


@wp.func
def find_footprint_adjoint(
    planes: PlaneArrays,
    direction: wp.vec3,
    footprint: PlaneFootprint,
    adj_distance: float,
    adj_cosine: float,
    adj_center: wp.vec2,
):
    """Gradients of ``position`` and ``direction``, given the footprint's and the mean cosine's, c′."""
    adj_t = adj_distance + adj_center[0] * direction[0] + adj_center[1] * direction[1]
    adj_c = adj_cosine - adj_t * footprint.distance * footprint.per_cosine
    if direction[2] < planes.radius:
        u = 0.5 * direction[2] * planes.per_radius + 0.5
        adj_c = adj_c * u * u
    adj_position = wp.vec3(adj_center[0], adj_center[1], adj_t * footprint.per_cosine)
    return adj_position, wp.vec3(adj_center[0] * footprint.distance, adj_center[1] * footprint.distance, adj_c)


# ---------------------------------------------------------------------------------------------------- radiosity


@wp.struct
class MipFootprint:
    """Position and size of a footprint on a grid."""

    texel: wp.vec2  # in texels of the finest level, from its corner
    slopes: wp.vec2  # of that by the center in the plane
    level: int  # finer of the two levels
    coarse_share: float  # of the coarser one
    coarse_share_slope: float  # its derivative by the logarithm of the footprint's width


@wp.func
def is_covered_by_texels(grid: PlaneGrid):
    """Whether the covered share of a footprint is found from its texels."""
    return grid.is_covered_by_texels == 1


@wp.func
def find_mip_footprint(grid: PlaneGrid, planes: PlaneArrays, footprint: PlaneFootprint):
    """Find the mip level and the texels of a footprint."""
    mip = MipFootprint()
    x = footprint.center[0] * grid.per_spread
    y = footprint.center[1] * grid.per_spread
    size_x = 1.0 + wp.abs(x)
    size_y = 1.0 + wp.abs(y)
    mip.texel = grid.first + wp.vec2(
        wp.sign(x) * wp.log(size_x) * grid.texels[0], wp.sign(y) * wp.log(size_y) * grid.texels[1]
    )
    mip.slopes = grid.per_spread * wp.vec2(grid.texels[0] / size_x, grid.texels[1] / size_y)
    width = footprint.distance * footprint.extent * planes.radius
    width *= wp.sqrt(mip.slopes[0] * mip.slopes[1] * footprint.per_cosine)
    while mip.level < grid.level_count - 1 and width >= 2.0:
        mip.level = mip.level + 1
        width *= 0.5
    if width > 1.0 and mip.level < grid.level_count - 1:
        mip.coarse_share = width - 1.0
        mip.coarse_share_slope = width
    return mip


@wp.func
def _log_slope(z: float):
    """Derivative of log √g′(z), g the squeeze of a grid's coordinates."""
    return -0.5 * wp.sign(z) / (1.0 + wp.abs(z))


@wp.struct
class _Corners:
    """The four texels of a level around a footprint, and its position between them."""

    upper_left: int  # the left one above
    lower_left: int
    column_step: int  # step from the left texel to the right one: 1, or 0 in a level of one column
    s: float
    t: float
    slopes: wp.vec2  # of s and t by the texel of the finest level


@wp.func
def _find_corners(planes: PlaneArrays, level_index: int, texel: wp.vec2):
    corners = _Corners()
    level = planes.levels[level_index]
    scale = planes.level_scales[level_index]
    last_x = float(level[1] - 1)
    last_y = float(level[2] - 1)
    x = texel[0] * scale[0] - 0.5
    y = texel[1] * scale[1] - 0.5
    corners.slopes = wp.vec2(
        wp.where(x > 0.0 and x < last_x, scale[0], 0.0), wp.where(y > 0.0 and y < last_y, scale[1], 0.0)
    )
    x = wp.clamp(x, 0.0, last_x)
    y = wp.clamp(y, 0.0, last_y)
    column = wp.min(int(x), wp.max(level[1] - 2, 0))
    row = wp.min(int(y), wp.max(level[2] - 2, 0))
    corners.s = x - float(column)
    corners.t = y - float(row)
    corners.column_step = wp.min(level[1] - 1, 1)
    corners.upper_left = level[0] + row * level[1] + column
    corners.lower_left = corners.upper_left + wp.where(level[2] > 1, level[1], 0)
    return corners


@wp.func
def _interpolate_corners(texels: wp.array(dtype=wp.vec3), corners: _Corners):
    upper_value = (1.0 - corners.s) * texels[corners.upper_left] + corners.s * texels[
        corners.upper_left + corners.column_step
    ]
    lower_value = (1.0 - corners.s) * texels[corners.lower_left] + corners.s * texels[
        corners.lower_left + corners.column_step
    ]
    return (1.0 - corners.t) * upper_value + corners.t * lower_value


@wp.func
def _interpolation_slopes(texels: wp.array(dtype=wp.vec3), corners: _Corners, adj_value: wp.vec3):
    """Slopes of the dot product with a color by the position, in texels of the finest level."""
    a = wp.dot(adj_value, texels[corners.upper_left])
    b = wp.dot(adj_value, texels[corners.upper_left + corners.column_step])
    c = wp.dot(adj_value, texels[corners.lower_left])
    d = wp.dot(adj_value, texels[corners.lower_left + corners.column_step])
    slope_s = (1.0 - corners.t) * (b - a) + corners.t * (d - c)
    slope_t = (1.0 - corners.s) * (c - a) + corners.s * (d - b)
    return wp.vec2(corners.slopes[0] * slope_s, corners.slopes[1] * slope_t)


@wp.func
def fetch(texels: wp.array(dtype=wp.vec3), planes: PlaneArrays, first_level: int, mip: MipFootprint):
    """Mean over a footprint, in the mip levels from ``first_level`` on."""
    value = _interpolate_corners(texels, _find_corners(planes, first_level + mip.level, mip.texel))
    if mip.coarse_share > 0.0:
        coarse = _interpolate_corners(texels, _find_corners(planes, first_level + mip.level + 1, mip.texel))
        value = (1.0 - mip.coarse_share) * value + mip.coarse_share * coarse
    return value


@wp.func
def fetch_adjoint(
    texels: wp.array(dtype=wp.vec3),
    grid: PlaneGrid,
    planes: PlaneArrays,
    first_level: int,
    footprint: PlaneFootprint,
    mip: MipFootprint,
    adj_value: wp.vec3,
):
    """Gradients of the position in the plane, and of the logarithm of the footprint's width, t / √c′ and its extent."""
    fine = _find_corners(planes, first_level + mip.level, mip.texel)
    slopes = _interpolation_slopes(texels, fine, adj_value)
    adj_log = float(0.0)
    if mip.coarse_share > 0.0:
        coarse = _find_corners(planes, first_level + mip.level + 1, mip.texel)
        slopes = (1.0 - mip.coarse_share) * slopes + mip.coarse_share * _interpolation_slopes(texels, coarse, adj_value)
        adj_log = mip.coarse_share_slope * wp.dot(
            adj_value, _interpolate_corners(texels, coarse) - _interpolate_corners(texels, fine)
        )
    adj_x = slopes[0] * mip.slopes[0]
    adj_y = slopes[1] * mip.slopes[1]
    if adj_log != 0.0:
        adj_x += adj_log * grid.per_spread * _log_slope(footprint.center[0] * grid.per_spread)
        adj_y += adj_log * grid.per_spread * _log_slope(footprint.center[1] * grid.per_spread)
    return wp.vec3(adj_x, adj_y, adj_log)


@wp.func
def scatter(
    adj_texels: wp.array(dtype=wp.vec3), planes: PlaneArrays, first_level: int, mip: MipFootprint, adj_value: wp.vec3
):
    """Add to the gradients of texels: the adjoint of :func:`fetch` by its values."""
    level_share = 1.0 - mip.coarse_share
    for coarser in range(2):
        if level_share > 0.0:
            c = _find_corners(planes, first_level + mip.level + coarser, mip.texel)
            adj_upper = (level_share * (1.0 - c.t)) * adj_value
            adj_lower = (level_share * c.t) * adj_value
            wp.atomic_add(adj_texels, c.upper_left, (1.0 - c.s) * adj_upper)
            wp.atomic_add(adj_texels, c.upper_left + c.column_step, c.s * adj_upper)
            wp.atomic_add(adj_texels, c.lower_left, (1.0 - c.s) * adj_lower)
            wp.atomic_add(adj_texels, c.lower_left + c.column_step, c.s * adj_lower)
        level_share = mip.coarse_share
