"""The reference for the approximations: the mesh itself, by rays through its bounding volume hierarchy."""

from collections.abc import Iterator

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, zeros
from warpshadow.device.parallel import split_row
from warpshadow.device.progress import progress_bar
from warpshadow.stages.light.light_samples import CellSamples, LightSamples
from warpshadow.stages.shell.shell_rays import FAR, beam_to_shell

RAY_COST = 200.0  # nanoseconds that a ray takes

ROUNDING = 2.0**-21
"""Distance of a point, interpolated in float32, from its face, at most: a share of its largest coordinate, by axis."""

WALL_COSINE = 1.0e-3
"""Cosine between a face's normal and a receiver's below which the face is a wall at whose foot the receiver lies: it is
in front of it then, against rounding.
"""

# height above a face, as a part of its size, from which rays of receivers on it start to meet it
MIN_HIT_HEIGHT = 1.0e-4


SURFACE = 1.0e-4  # how far before a point the surface may be met that it is on, as a part of the point's distance


@wp.func
def _face_from_receiver(mesh: wp.uint64, face: int, point: wp.vec3, normal: wp.vec3):
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
    plane_offset = wp.dot(face_normal, a)  # from the plane to the receiver, times |face_normal|
    coordinate_bound = wp.max(wp.max(wp.abs(corner_a), wp.abs(corner_b)), wp.max(wp.abs(corner_c), wp.abs(point)))
    is_on_face = bool(False)
    if wp.abs(plane_offset) <= wp.float64(ROUNDING) * wp.dot(wp.abs(face_normal), wp.vec3d(coordinate_bound)):
        length = wp.length(face_normal)
        normal_component = wp.dot(face_normal, wp.vec3d(normal))
        is_on_face = wp.abs(normal_component) >= wp.float64(WALL_COSINE) * length
        height = wp.where(normal_component < wp.float64(-WALL_COSINE) * length, -MIN_HIT_HEIGHT, MIN_HIT_HEIGHT)
        shift = (plane_offset / length + wp.float64(height) * wp.sqrt(length)) / length * face_normal
        a -= shift
        b -= shift
        c -= shift
    return a, b, c, face_normal, is_on_face


@wp.func
def _volumes(ray_direction: wp.vec3, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Unnormalized barycentrics of a line on the plane of a face: of one sign if the line meets the face."""
    ray = wp.vec3d(ray_direction)
    return wp.vec3d(wp.dot(ray, wp.cross(c, b)), wp.dot(ray, wp.cross(a, c)), wp.dot(ray, wp.cross(b, a)))


@wp.func
def _is_hit(ray_direction: wp.vec3, a: wp.vec3d, face_normal: wp.vec3d, volumes: wp.vec3d):
    is_inside = wp.min(volumes) >= wp.float64(0.0) or wp.max(volumes) <= wp.float64(0.0)
    return is_inside and wp.dot(face_normal, a) * wp.dot(face_normal, wp.vec3d(ray_direction)) > wp.float64(0.0)


@wp.func
def _nonzero_direction(ray_direction: wp.vec3):
    """Direction of a ray with no component of 0, since the slabs of boxes divide by them."""
    return wp.vec3(
        wp.where(ray_direction[0] == 0.0, 1.0e-20, ray_direction[0]),
        wp.where(ray_direction[1] == 0.0, 1.0e-20, ray_direction[1]),
        wp.where(ray_direction[2] == 0.0, 1.0e-20, ray_direction[2]),
    )


@wp.func
def meets_face(mesh: wp.uint64, face: int, point: wp.vec3, normal: wp.vec3, ray_direction: wp.vec3):
    """Whether a ray from a receiver meets a face of a mesh."""
    a, b, c, face_normal, _is_on_face = _face_from_receiver(mesh, face, point, normal)
    return _is_hit(ray_direction, a, face_normal, _volumes(ray_direction, a, b, c))


@wp.func
def any_hit(mesh: wp.uint64, point: wp.vec3, normal: wp.vec3, ray_direction: wp.vec3):
    """Find a face of a mesh that a ray from a receiver meets, not always the first, -1 for none; mesh 0 has none."""
    if mesh == wp.uint64(0):
        return int(-1)
    query = wp.bvh_query_ray(wp.mesh_get_bvh(mesh), point, _nonzero_direction(ray_direction))
    face = int(0)
    while wp.bvh_query_next(query, face):
        if meets_face(mesh, face, point, normal, ray_direction):
            return face
    return int(-1)


@wp.func
def escapes(mesh: wp.uint64, point: wp.vec3, normal: wp.vec3, ray_direction: wp.vec3):
    """Whether a ray from a receiver meets no face of a mesh; 0 is the mesh that has none."""
    return any_hit(mesh, point, normal, ray_direction) < 0


@wp.func
def sees_point(mesh: wp.uint64, point: wp.vec3, normal: wp.vec3, ray_direction: wp.vec3, distance: float):
    """Whether no face of a mesh lies between a receiver and a point at a distance; 0 is the mesh that has none."""
    if mesh == wp.uint64(0):
        return True
    query = wp.bvh_query_ray(wp.mesh_get_bvh(mesh), point, _nonzero_direction(ray_direction))
    face = int(0)
    while wp.bvh_query_next(query, face, distance):
        a, b, c, face_normal, _is_on_face = _face_from_receiver(mesh, face, point, normal)
        if _is_hit(ray_direction, a, face_normal, _volumes(ray_direction, a, b, c)):
            hit_distance = float(wp.dot(face_normal, a) / wp.dot(face_normal, wp.vec3d(ray_direction)))
            if hit_distance < distance * (1.0 - SURFACE):
                return False
    return True


@wp.struct
class RayHit:
    """First hit of a ray."""

    face: int  # number of the face, -1 for none
    weights: wp.vec3  # barycentrics on it
    is_back: bool  # whether it is met from behind
    is_below: bool  # whether there is none since the ray leaves below the face that its receiver lies on


@wp.func
def first_hit(mesh: wp.uint64, point: wp.vec3, normal: wp.vec3, ray_direction: wp.vec3):
    """First hit of a ray from a receiver; none where it leaves below the face that the receiver lies on.

    Smooth normals, which lean away from faces, have such rays. Direct light has none from there, too.
    """
    hit = RayHit()
    hit.face = -1
    distance = float(wp.inf)
    query = wp.bvh_query_ray(wp.mesh_get_bvh(mesh), point, _nonzero_direction(ray_direction))
    face = int(0)
    while wp.bvh_query_next(query, face, distance):
        a, b, c, face_normal, is_on_face = _face_from_receiver(mesh, face, point, normal)
        volumes = _volumes(ray_direction, a, b, c)
        if _is_hit(ray_direction, a, face_normal, volumes):
            slope = wp.dot(face_normal, wp.vec3d(ray_direction))
            hit_distance = float(wp.dot(face_normal, a) / slope)
            if hit_distance < distance:
                distance = hit_distance
                hit.face = wp.where(is_on_face, -1, face)
                hit.weights = wp.vec3(volumes / (volumes[0] + volumes[1] + volumes[2]))
                hit.is_back = slope > wp.float64(0.0)
                hit.is_below = is_on_face
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
    batch, receiver = split_row(first_row + row, points.shape[1])
    normal = normals[batch, receiver]
    ray_direction = directions[direction]
    is_seen = wp.uint8(0)
    if wp.dot(normal, ray_direction) > 0.0 and escapes(mesh, points[batch, receiver], normal, ray_direction):
        is_seen = wp.uint8(1)
    visibility[batch, receiver, direction] = is_seen


def trace_visibility(mesh: wp.Mesh | None, points: wp.array, normals: wp.array, directions: wp.array) -> wp.array:
    """Trace which directions every receiver sees past the mesh, exactly.

    Receivers may lie on the mesh. Directions below a receiver's horizon (n·ω ≤ 0) are not traced and count as blocked.

    Args:
        mesh: The blockers, one mesh for all batches; build it once, it holds the hierarchy. None for nothing.
        points: Receiver positions [scene units], vec3, shape [batch, receiver].
        normals: Unit normals of the receivers, vec3, shape [batch, receiver].
        directions: Unit directions toward the light, vec3, shape [direction].
    Returns:
        1 where the ray escapes, else 0; uint8, shape [batch, receiver, direction].
    Raises:
        ValueError: naming the argument whose shape or value does not fit.
    Differentiable: no.
    """
    check.shape("points", points.shape, ("batch", "receiver"))
    check.shape("normals", normals.shape, points.shape)
    check.shape("directions", directions.shape, ("direction",))
    visibility = empty(points.shape + directions.shape, dtype=wp.uint8, device=points.device)
    inputs = [mesh_id(mesh), points, normals, directions]
    launch(_trace_visibility, (points.size, *directions.shape), inputs=inputs, outputs=[visibility], cost=RAY_COST)
    return visibility


def trace_visibility_on_host(
    mesh: wp.Mesh | None, points: np.ndarray, normals: np.ndarray, directions: np.ndarray, device: wp.DeviceLike
) -> np.ndarray:
    """Trace as :func:`trace_visibility` does, of NumPy arrays of one instance: bool of shape [receiver, direction]."""
    point_array, normal_array, direction_array = (
        wp.array(values, dtype=wp.vec3, device=device) for values in (points, normals, directions)
    )
    receivers = point_array.reshape((1, -1)), normal_array.reshape((1, -1))
    visibility: np.ndarray = trace_visibility(mesh, *receivers, direction_array).numpy()[0]
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
    shell: wp.vec4,
    # out
    shading: wp.array[wp.vec3],
):
    """A thread owns a receiver."""
    receiver = first_row + wp.tid()
    sample_set = int(wp.rand_init(17, receiver) % wp.uint32(directions.shape[0]))
    point = points[receiver]
    normal = normals[receiver]
    total = wp.vec3()
    for sample in range(directions.shape[1]):
        beam = beam_to_shell(shell, point, directions[sample_set, sample])
        ray_direction = wp.vec3(beam[0], beam[1], beam[2])
        cosine = beam[3] * wp.dot(normal, ray_direction)
        if cosine > 0.0 and escapes(mesh, point, normal, ray_direction):
            total += cosine * radiance[sample_set, sample]
    shading[receiver] = total / wp.pi


def trace_shading(
    mesh: wp.Mesh | None,
    points: wp.array,
    normals: wp.array,
    samples: LightSamples,
    *,
    shell: np.ndarray = FAR,
    progress: bool = False,
) -> wp.array:
    """Trace the shading of receivers: the radiance of a white surface, single bounce, as a path tracer gives it.

    Args:
        mesh: The blockers, None for none.
        points: Receiver positions [scene units], vec3 of shape [receiver].
        normals: Unit normals, vec3 of shape [receiver].
        samples: Directions drawn from the light, from the center of its shell.
        shell: Center and radius of the sphere that sends the light [scene units], shape [4]; the mesh is within it.
    Returns:
        Shading, vec3 of shape [receiver].
    Differentiable: no.
    """
    device = points.device
    directions = wp.array(samples.directions, dtype=wp.vec3, device=device)
    radiance = wp.array(samples.radiance, dtype=wp.vec3, device=device)
    shading = empty(points.shape, dtype=wp.vec3, device=device)
    for receivers in progress_slices(points.shape[0], 2**20 // samples.directions.shape[1], progress):
        launch(
            _trace_shading,
            receivers.stop - receivers.start,
            inputs=[mesh_id(mesh), points[receivers], normals[receivers], directions, radiance, wp.vec4(*shell)],
            outputs=[shading[receivers]],
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
    receiver_ids: wp.array[wp.int32],
    directions: wp.array2d[wp.vec3],
    cells: wp.array2d[wp.int32],
    radiance: wp.array3d[wp.float32],
    # out
    light: wp.array3d[wp.float32],
):
    """A thread owns a receiver, whose cells are zero before."""
    receiver = first_row + wp.tid()
    sample_set = int(wp.rand_init(17, receiver_ids[receiver]) % wp.uint32(directions.shape[0]))
    point = points[receiver]
    normal = normals[receiver]
    for sample in range(directions.shape[1]):
        ray_direction = directions[sample_set, sample]
        cosine = wp.dot(normal, ray_direction) / wp.pi
        if cosine > 0.0 and escapes(mesh, point, normal, ray_direction):
            cell = cells[sample_set, sample]
            for channel in range(light.shape[1]):
                light[receiver, channel, cell] = (
                    light[receiver, channel, cell] + cosine * radiance[sample_set, sample, channel]
                )


def trace_cells(
    mesh: wp.Mesh | None,
    points: wp.array,
    normals: wp.array,
    receiver_ids: wp.array,
    samples: CellSamples,
    *,
    progress: bool = False,
) -> wp.array:
    """Trace how much light each cell of directions sends past a mesh: :func:`trace_shading`, apart for each cell.

    Args:
        mesh, points, normals: As for :func:`trace_shading`.
        receiver_ids: Identifiers of the receivers, int32 of shape [receiver]: a receiver gets the same rays in any
            company.
        samples: Directions drawn from the light.
    Returns:
        ∫ L V max(n·ω, 0) dω / π over each cell, float32 of shape [receiver, channel, cell].
    Differentiable: no.
    """
    shape = points.shape[0], samples.radiance.shape[2], samples.cell_count
    light = zeros(shape, dtype=wp.float32, device=points.device)
    for receivers in progress_slices(points.shape[0], 2**20 // samples.directions.shape[1], progress):
        launch(
            _trace_cells,
            receivers.stop - receivers.start,
            inputs=[mesh_id(mesh), points[receivers], normals[receivers], receiver_ids[receivers], *samples[:3]],
            outputs=[light[receivers]],
            cost=RAY_COST * samples.directions.shape[1],
        )
    return light


def progress_slices(
    total: int, size: int, progress: bool, label: str = "tracing rays", *, first: int = 0
) -> Iterator[slice]:
    """Cut a range into slices of at most ``size``, with a labeled progress bar over them.

    Rows before ``first`` count as done.
    """
    size = max(size, 1)
    with progress_bar(total, label, "point", done=first, shows=progress) as bar:
        for start in range(first, total, size):
            stop = min(start + size, total)
            yield slice(start, stop)
            bar.update(stop - start)
