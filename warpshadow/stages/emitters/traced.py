"""Light of emitters by rays, to points drawn from their surfaces: it judges the sums over samples, and stills have it.

A point y of a face is drawn in proportion to area and mean radiance, with the density p. Of N of them a receiver gets

    E(x) = 1/N Σ L(y) V max(n·ω, 0) max(−m·ω, 0) / (π d² p)                   [Shirley et al. 1996, "Monte Carlo
                                                                               Techniques for Direct Lighting"]

m the normal of the face; of an open body |m·ω| counts.
"""

import numpy as np
import warp as wp

from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.stages.interpolation import interpolate_at
from warpshadow.stages.ray_tracing import RAY_COST, mesh_id, progress_slices, sees_point

_SEED = 43
_MIN_DISTANCE2 = 1.0e-12

_STEP_U, _STEP_V, _STEP_FACE = wp.uint32(3518319155), wp.uint32(2882110345), wp.uint32(2360945575)
"""Roberts' R3 sequence, which spreads the points of a receiver, in parts of 2³²."""

EMITTER_RAYS = 64  # rays of a receiver to emitters


@wp.struct
class EmittingFaces:
    """The faces of emitters, one instance."""

    faces: wp.array(dtype=wp.vec3i)  # [emitting face]
    is_two_sided: wp.array(dtype=wp.int32)  # [emitting face]
    distribution: wp.array(dtype=wp.float32)  # sums of their probabilities, [emitting face]
    positions: wp.array(dtype=wp.vec3)  # of all vertices
    emission: wp.array(dtype=wp.vec3)  # of all vertices


def emitting_faces(positions: wp.array, emission: wp.array, faces: wp.array, is_two_sided: np.ndarray) -> EmittingFaces:
    """Prepare the faces of emitters.

    Args:
        positions: Of all vertices [scene units], vec3 of shape [vertex].
        emission: Radiance of all vertices, vec3 of shape [vertex].
        faces: That emit, vec3i of shape [face].
        is_two_sided: Whether their bodies are open, bool of shape [face].
    """
    result = EmittingFaces()
    result.positions, result.emission, result.faces = positions, emission, faces
    corner_ids, device = faces.numpy(), positions.device
    corners = positions.numpy().astype(np.float64)[corner_ids]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    power = areas * (emission.numpy()[corner_ids].mean(axis=(1, 2)))
    sums = np.cumsum(power)
    has_power = bool(len(sums) and sums[-1] > 0)
    result.distribution = wp.array(sums / sums[-1] if has_power else [], dtype=wp.float32, device=device)
    result.is_two_sided = wp.array(is_two_sided.astype(np.int32), dtype=wp.int32, device=device)
    return result


@wp.func
def light_of_point(
    emitters: EmittingFaces,
    mesh: wp.uint64,
    point: wp.vec3,
    normal: wp.vec3,
    share: float,
    u: float,
    v: float,
):
    """Light of a point of the emitters on a receiver over the point's density, given three numbers even in [0, 1).

    Returns it past the blockers, and as it would be without them.
    """
    index = wp.lower_bound(emitters.distribution, share)
    index = wp.min(index, emitters.distribution.shape[0] - 1)
    probability = emitters.distribution[index]
    if index > 0:
        probability -= emitters.distribution[index - 1]
    corners = emitters.faces[index]
    root = wp.sqrt(u)
    weights = wp.vec3(1.0 - root, root * (1.0 - v), root * v)
    a = emitters.positions[corners[0]]
    area_vector = 0.5 * wp.cross(emitters.positions[corners[1]] - a, emitters.positions[corners[2]] - a)
    beam = interpolate_at(emitters.positions, corners, weights) - point
    distance2 = wp.max(wp.length_sq(beam), _MIN_DISTANCE2)
    distance = wp.sqrt(distance2)
    ray_direction = beam / distance
    facing_area = -wp.dot(ray_direction, area_vector)
    if emitters.is_two_sided[index] == 1:
        facing_area = wp.abs(facing_area)
    cosine = wp.dot(ray_direction, normal)
    light = wp.vec3()
    unblocked_light = wp.vec3()
    if facing_area > 0.0 and cosine > 0.0 and probability > 0.0:
        radiance = interpolate_at(emitters.emission, corners, weights)
        unblocked_light = cosine * facing_area / (wp.pi * distance2 * probability) * radiance
        if sees_point(mesh, point, normal, ray_direction, distance):
            light = unblocked_light
    return light, unblocked_light


@wp.func
def _quasi_random(shift: wp.uint32, step: wp.uint32, number: int):
    """A number of a low-discrepancy sequence, from 0 to 1."""
    return float((shift + step * wp.uint32(number)) >> wp.uint32(8)) / 16777216.0


@wp.kernel(enable_backward=False)
def _trace_emitters(
    first_row: int,
    worker: int,
    # in
    emitters: EmittingFaces,
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    first_receiver: int,
    ray_count: int,
    unblocked: wp.array(dtype=wp.vec3),
    # out
    light: wp.array(dtype=wp.vec3),
):
    """A thread owns a receiver."""
    receiver = first_row + wp.tid()
    state = wp.rand_init(_SEED, first_receiver + receiver)
    shift_u = wp.randu(state)
    shift_v = wp.randu(state)
    shift_face = wp.randu(state)
    total = wp.vec3()
    unblocked_total = wp.vec3()
    for ray in range(ray_count):
        ray_light, unblocked_light = light_of_point(
            emitters,
            mesh,
            points[receiver],
            normals[receiver],
            _quasi_random(shift_face, _STEP_FACE, ray),
            _quasi_random(shift_u, _STEP_U, ray),
            _quasi_random(shift_v, _STEP_V, ray),
        )
        total += ray_light
        unblocked_total += unblocked_light
    if unblocked:
        for channel in range(3):
            share = total[channel] / wp.max(unblocked_total[channel], 1.0e-30)
            light[receiver][channel] = share * unblocked[receiver][channel]
    else:
        light[receiver] = total / float(ray_count)


def trace_emitters(
    emitters: EmittingFaces,
    mesh: wp.Mesh | None,
    points: wp.array,
    normals: wp.array,
    *,
    rays: int = EMITTER_RAYS,
    unblocked: wp.array | None = None,
    progress: bool = False,
) -> wp.array:
    """Trace the direct light of emitters on receivers, as white surfaces reflect it.

    Args:
        emitters: Their faces.
        mesh: The blockers, emitters among them; None for none.
        points: Receivers [scene units], vec3 of shape [receiver].
        normals: Their unit normals, vec3 of shape [receiver].
        rays: Of each receiver.
        unblocked: The light without blockers, from :func:`.light.sum_light`, vec3 of shape [receiver]: rays then find
            but the share of it that is left, without grain where nothing blocks. None for the light by rays alone.
    Returns:
        vec3 of shape [receiver].
    Differentiable: no.
    """
    light = empty(points.shape, dtype=wp.vec3, device=points.device)
    if not emitters.distribution.size:
        light.zero_()
        return light
    for receivers in progress_slices(points.shape[0], 2**20 // rays, progress):
        launch(
            _trace_emitters,
            receivers.stop - receivers.start,
            inputs=[
                *(emitters, mesh_id(mesh), points[receivers], normals[receivers], receivers.start, rays),
                None if unblocked is None else unblocked[receivers],
            ],
            outputs=[light[receivers]],
            cost=RAY_COST * rays,
        )
    return light
