"""The reference for the approximations: the mesh itself, by rays through its bounding volume hierarchy."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, zeros
from warpshadow.device.parallel import split_row
from warpshadow.device.progress import progress_bar
from warpshadow.stages.light_samples import CellSamples, LightSamples

RAY_COST = 200.0  # nanoseconds that a ray takes

ROUNDING = 2.0**-21
"""How far a point interpolated in float32 may lie off its face: a part of the face's largest coordinate, by axis."""

WALL_COSINE = 1.0e-3
"""Cosine between a face's normal and a receiver's below which the face is a wall at whose foot the receiver lies: it is
in front of it then, against rounding.
"""

# height above a face, as a part of its size, from which rays of receivers on it start to meet it
MIN_HIT_HEIGHT = 1.0e-4


@wp.func
def _seen_from(mesh: wp.uint64, face: int, point: wp.vec3, normal: wp.vec3):
    """A face as a receiver sees it: corners relative to it and their normal, in float64, where they are exact.

    A receiver on a face, to float32's rounding, is put slightly above it, on the side of its own normal. It so gets no
    shadow from the face and its neighbors in the plane, but does where light comes from behind them. For all other
    faces rays start at the receiver itself, so that nothing is too thin or too near to cast a shadow.

    Returns:
        The corners, their normal times twice the area, and whether the receiver lies on the face; not at its foot.
    """
    corner_a = wp.mesh_get_point(mesh, 3 * face)
    corner_b = wp.mesh_get_point(mesh, 3 * face + 1)
    corner_c = wp.mesh_get_point(mesh, 3 * face + 2)
    a = wp.vec3d(corner_a) - wp.vec3d(point)
    b = wp.vec3d(corner_b) - wp.vec3d(point)
    c = wp.vec3d(corner_c) - wp.vec3d(point)
    face_normal = wp.cross(b - a, c - a)
    drop = wp.dot(face_normal, a)  # from the plane to the receiver, times |face_normal|
    largest = wp.max(wp.max(wp.abs(corner_a), wp.abs(corner_b)), wp.max(wp.abs(corner_c), wp.abs(point)))
    lies_on = bool(False)
    if wp.abs(drop) <= wp.float64(ROUNDING) * wp.dot(wp.abs(face_normal), wp.vec3d(largest)):
        length = wp.length(face_normal)
        upward = wp.dot(face_normal, wp.vec3d(normal))
        lies_on = wp.abs(upward) >= wp.float64(WALL_COSINE) * length
        height = wp.where(upward < wp.float64(-WALL_COSINE) * length, -MIN_HIT_HEIGHT, MIN_HIT_HEIGHT)
        move = (drop / length + wp.float64(height) * wp.sqrt(length)) / length * face_normal
        a -= move
        b -= move
        c -= move
    return a, b, c, face_normal, lies_on


@wp.func
def _volumes(toward: wp.vec3, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Barycentrics of where a line meets the plane of a face, not normalized: of one sign where it meets the face."""
    ray = wp.vec3d(toward)
    return wp.vec3d(wp.dot(ray, wp.cross(c, b)), wp.dot(ray, wp.cross(a, c)), wp.dot(ray, wp.cross(b, a)))


@wp.func
def _meets(toward: wp.vec3, a: wp.vec3d, face_normal: wp.vec3d, volumes: wp.vec3d):
    """Whether a ray meets a face."""
    is_inside = wp.min(volumes) >= wp.float64(0.0) or wp.max(volumes) <= wp.float64(0.0)
    return is_inside and wp.dot(face_normal, a) * wp.dot(face_normal, wp.vec3d(toward)) > wp.float64(0.0)


@wp.func
def _slope(toward: wp.vec3):
    """A ray's direction for the boxes, whose slabs need a slope."""
    return wp.vec3(
        wp.where(toward[0] == 0.0, 1.0e-20, toward[0]),
        wp.where(toward[1] == 0.0, 1.0e-20, toward[1]),
        wp.where(toward[2] == 0.0, 1.0e-20, toward[2]),
    )


@wp.func
def is_met(mesh: wp.uint64, face: int, point: wp.vec3, normal: wp.vec3, toward: wp.vec3):
    """Whether a ray from a receiver meets a face of a mesh."""
    a, b, c, face_normal, _lies_on = _seen_from(mesh, face, point, normal)
    return _meets(toward, a, face_normal, _volumes(toward, a, b, c))


@wp.func
def find_blocker(mesh: wp.uint64, point: wp.vec3, normal: wp.vec3, toward: wp.vec3):
    """Find a face of a mesh that a ray from a receiver meets, not always the first, -1 for none; mesh 0 has none."""
    if mesh == wp.uint64(0):
        return int(-1)
    query = wp.bvh_query_ray(wp.mesh_get_bvh(mesh), point, _slope(toward))
    face = int(0)
    while wp.bvh_query_next(query, face):
        if is_met(mesh, face, point, normal, toward):
            return face
    return int(-1)


@wp.func
def escapes(mesh: wp.uint64, point: wp.vec3, normal: wp.vec3, toward: wp.vec3):
    """Whether a ray from a receiver meets no face of a mesh; 0 is the mesh that has none."""
    return find_blocker(mesh, point, normal, toward) < 0


@wp.struct
class Hit:
    """First hit of a ray."""

    face: int  # number of the face, -1 for none
    weights: wp.vec3  # barycentrics on it
    is_back: bool  # whether it is met from behind


@wp.func
def nearest(mesh: wp.uint64, point: wp.vec3, normal: wp.vec3, toward: wp.vec3):
    """First hit of a ray from a receiver; none where it leaves below the face that the receiver lies on.

    Smooth normals, which lean away from faces, have such rays. Direct light has none from there, too.
    """
    hit = Hit()
    hit.face = -1
    distance = float(wp.inf)
    query = wp.bvh_query_ray(wp.mesh_get_bvh(mesh), point, _slope(toward))
    face = int(0)
    while wp.bvh_query_next(query, face, distance):
        a, b, c, face_normal, lies_on = _seen_from(mesh, face, point, normal)
        volumes = _volumes(toward, a, b, c)
        if _meets(toward, a, face_normal, volumes):
            slope = wp.dot(face_normal, wp.vec3d(toward))
            reached = float(wp.dot(face_normal, a) / slope)
            if reached < distance:
                distance = reached
                hit.face = wp.where(lies_on, -1, face)
                hit.weights = wp.vec3(volumes / (volumes[0] + volumes[1] + volumes[2]))
                hit.is_back = slope > wp.float64(0.0)
    return hit


@wp.kernel(enable_backward=False)
def _trace_visibility(
    first_row: int,
    worker: int,
    # in
    mesh: wp.uint64,
    points: wp.array2d[wp.vec3],
    normals: wp.array2d[wp.vec3],
    directions: wp.array[wp.vec3],
    # out
    visibility: wp.array3d[wp.uint8],
):
    """Each thread owns one ray: a receiver and a direction."""
    row, direction = wp.tid()
    batch, vertex = split_row(first_row + row, points.shape[1])
    normal = normals[batch, vertex]
    toward = directions[direction]
    is_seen = wp.uint8(0)
    if wp.dot(normal, toward) > 0.0 and escapes(mesh, points[batch, vertex], normal, toward):
        is_seen = wp.uint8(1)
    visibility[batch, vertex, direction] = is_seen


def trace_visibility(mesh: wp.Mesh | None, points: wp.array, normals: wp.array, directions: wp.array) -> wp.array:
    """Trace which directions every receiver sees past the mesh, exactly.

    Receivers may lie on the mesh. Directions below a receiver's horizon (n·ω ≤ 0) are not traced and count as blocked.

    Args:
        mesh: The blockers, one mesh for all batches; build it once, it holds the hierarchy. None for nothing.
        points: Receiver positions [scene units], vec3, shape [batch, vertex].
        normals: Unit normals of the receivers, vec3, shape [batch, vertex].
        directions: Unit directions toward the light, vec3, shape [direction].
    Returns:
        1 where the ray escapes, else 0; uint8, shape [batch, vertex, direction].
    Raises:
        ValueError: naming the argument whose shape or value does not fit.
    Differentiable: no.
    """
    check.shape("points", points.shape, ("batch", "vertex"))
    check.shape("normals", normals.shape, points.shape)
    check.shape("directions", directions.shape, ("direction",))
    visibility = empty(points.shape + directions.shape, dtype=wp.uint8, device=points.device)
    inputs = [mesh_id(mesh), points, normals, directions]
    launch(_trace_visibility, (points.size, *directions.shape), inputs=inputs, outputs=[visibility], cost=RAY_COST)
    return visibility


def trace_visibility_on_host(
    mesh: wp.Mesh | None, points: np.ndarray, normals: np.ndarray, directions: np.ndarray, device: wp.DeviceLike
) -> np.ndarray:
    """The same for NumPy's arrays of one batch, of shape [vertex, 3] and [direction, 3]: bool [vertex, direction]."""
    at, facing, towards = (wp.array(values, dtype=wp.vec3, device=device) for values in (points, normals, directions))
    visibility: np.ndarray = trace_visibility(mesh, at.reshape((1, -1)), facing.reshape((1, -1)), towards).numpy()[0]
    return visibility.astype(bool)


def mesh_id(mesh: wp.Mesh | None) -> wp.uint64:
    """Number of a mesh in kernels; 0 is the mesh that has no face."""
    return wp.uint64(0) if mesh is None else mesh.id


@wp.kernel(enable_backward=False)
def _trace_shading(
    first_row: int,
    worker: int,
    # in
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    directions: wp.array2d[wp.vec3],
    radiance: wp.array2d[wp.vec3],
    # out
    shading: wp.array[wp.vec3],
):
    """A thread owns a receiver."""
    receiver = first_row + wp.tid()
    chosen = int(wp.rand_init(17, receiver) % wp.uint32(directions.shape[0]))
    point = points[receiver]
    normal = normals[receiver]
    total = wp.vec3()
    for sample in range(directions.shape[1]):
        toward = directions[chosen, sample]
        cosine = wp.dot(normal, toward)
        if cosine > 0.0 and escapes(mesh, point, normal, toward):
            total += cosine * radiance[chosen, sample]
    shading[receiver] = total / wp.pi


def trace_shading(
    mesh: wp.Mesh | None, points: wp.array, normals: wp.array, samples: LightSamples, *, progress: bool = False
) -> wp.array:
    """Trace the shading of receivers: the radiance of a white surface, single bounce, as a path tracer gives it.

    Args:
        mesh: The blockers, None for none.
        points: Receiver positions [scene units], vec3 of shape [receiver].
        normals: Unit normals, vec3 of shape [receiver].
        samples: Directions drawn from the light.
    Returns:
        Shading, vec3 of shape [receiver].
    Differentiable: no.
    """
    device = points.device
    directions = wp.array(samples.directions, dtype=wp.vec3, device=device)
    radiance = wp.array(samples.radiance, dtype=wp.vec3, device=device)
    shading = empty(points.shape, dtype=wp.vec3, device=device)
    for part in parts(points.shape[0], 2**20 // samples.directions.shape[1], progress):
        launch(
            _trace_shading,
            part.stop - part.start,
            inputs=[mesh_id(mesh), points[part], normals[part], directions, radiance],
            outputs=[shading[part]],
            cost=RAY_COST * directions.shape[1],
        )
    return shading


@wp.kernel(enable_backward=False)
def _trace_cells(
    first_row: int,
    worker: int,
    # in
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    numbers: wp.array[wp.int32],
    directions: wp.array2d[wp.vec3],
    cells: wp.array2d[wp.int32],
    radiance: wp.array3d[wp.float32],
    # out
    light: wp.array3d[wp.float32],
):
    """A thread owns a receiver, whose cells are zero before."""
    receiver = first_row + wp.tid()
    chosen = int(wp.rand_init(17, numbers[receiver]) % wp.uint32(directions.shape[0]))
    point = points[receiver]
    normal = normals[receiver]
    for sample in range(directions.shape[1]):
        toward = directions[chosen, sample]
        cosine = wp.dot(normal, toward) / wp.pi
        if cosine > 0.0 and escapes(mesh, point, normal, toward):
            cell = cells[chosen, sample]
            for channel in range(light.shape[1]):
                light[receiver, channel, cell] = (
                    light[receiver, channel, cell] + cosine * radiance[chosen, sample, channel]
                )


def trace_cells(
    mesh: wp.Mesh | None,
    points: wp.array,
    normals: wp.array,
    numbers: wp.array,
    samples: CellSamples,
    *,
    progress: bool = False,
) -> wp.array:
    """Trace how much light each cell of directions sends past a mesh: :func:`trace_shading`, apart for each cell.

    Args:
        mesh, points, normals: As for :func:`trace_shading`.
        numbers: Identifiers of the receivers, int32 of shape [receiver]: a receiver gets the same rays in any company.
        samples: Directions drawn from the light.
    Returns:
        ∫ L V max(n·ω, 0) dω / π over each cell, float32 of shape [receiver, channel, cell].
    Differentiable: no.
    """
    shape = points.shape[0], samples.radiance.shape[2], samples.cell_count
    light = zeros(shape, dtype=wp.float32, device=points.device)
    for part in parts(points.shape[0], 2**20 // samples.directions.shape[1], progress):
        launch(
            _trace_cells,
            part.stop - part.start,
            inputs=[mesh_id(mesh), points[part], normals[part], numbers[part], *samples[:3]],
            outputs=[light[part]],
            cost=RAY_COST * samples.directions.shape[1],
        )
    return light


def parts(total: int, size: int, progress: bool, what: str = "tracing rays", *, first: int = 0) -> Iterator[slice]:
    """Cut a range into slices of at most ``size``, with a labeled progress bar over them.

    Rows before ``first`` count as done.
    """
    size = max(size, 1)
    with progress_bar(total, what, "point", done=first, shows=progress) as bar:
        for start in range(first, total, size):
            stop = min(start + size, total)
            yield slice(start, stop)
            bar.update(stop - start)
