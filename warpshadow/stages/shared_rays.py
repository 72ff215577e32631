"""Shared rays: all receivers look for light in the same directions, so that an image has no grain.

With directions ω_i and the light l_i that each stands for (:func:`.light_samples.cut_map`), a receiver gets

    Σ_i l_i V_i max(n·ω_i, 0) / π

Some receivers tell where light comes from, so that most directions go there (:func:`find_shares`).
Rays go through the scene in packets of 16 that are close to each other (:mod:`.ray_packets`).

Neighbors in an image mostly see the same light. So all rays of receivers at the corners of squares of pixels are traced
(:func:`find_corners`). Receivers within a square take over what its corners agree on, interpolate the visibility of
doubtful rays that bring little light, and trace the others. So edges of shadows are as sharp as if all were traced;
but a shadow that falls between the corners is missed.
"""

import functools
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.constants import constant
from warpshadow.device.lanes import lane_type, make_lane_functions, module_options, vectors_type
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, zeros
from warpshadow.stages.light_samples import LightSamples
from warpshadow.stages.ray_packets import PACKET, FaceTree, make_find_open, packets_of
from warpshadow.stages.ray_tracing import progress_slices
from warpshadow.stages.receivers import Receivers
from warpshadow.stages.sample_receivers import ALIKE, LEVEL

_PACKET_COST = 2000.0  # nanoseconds that a packet takes
_PILOT_RECEIVERS = 256  # receivers that stand for all, where directions are chosen

SQUARES = 128
"""Squares at whose corners all rays are traced, across the shorter side of an image, or more: their side in pixels is a
power of two. With squares of 4 pixels at 128², thin shadows are missed: chair_wheel_fence of demos/kinds.py is 4.4% off
a path tracer, in place of 2.5%."""

TOLERANCE = 0.02  # part of a receiver's light that may come from rays whose visibility is interpolated


@functools.cache
def _make_trace() -> wp.Kernel:
    Lane, Vectors, fn = lane_type(PACKET), vectors_type(PACKET), make_lane_functions(PACKET)
    find_open, dot_direction, bits_above = make_find_open(), fn.dot_direction, fn.bits_above

    # In plain Warp, which branches at every lane, receivers that trace few rays take four times as long.
    @wp.func_native(f"""
    float r = 0.0f, g = 0.0f, b = 0.0f;
    for (int lane = 0; lane < {PACKET}; ++lane) {{
        const float weight = (open_rays >> lane) & 1 ? cosine.c[lane] : 0.0f;
        r += weight * light.x.c[lane];
        g += weight * light.y.c[lane];
        b += weight * light.z.c[lane];
    }}
    return wp::vec3(r, g, b);
    """)
    def sum_open(open_rays: int, cosine: Lane, light: Vectors) -> wp.vec3: ...  # type: ignore[empty-body]

    @wp.func_native(f"""
    wp::vec_t<{PACKET}, wp::float32> shares;
    const int words[4] = {{a, b, c, d}};
    for (int lane = 0; lane < {PACKET}; ++lane) {{
        float open = 0.0f, known = 0.0f;
        for (int corner = 0; corner < 4; ++corner) {{
            const float is_open = (words[corner] >> lane) & 1, is_blocked = (words[corner] >> (lane + {PACKET})) & 1;
            open += weights[corner] * is_open;
            known += weights[corner] * (is_open + is_blocked);
        }}
        shares[lane] = known > 0.0f ? open / known : 0.0f;
    }}
    return shares;
    """)
    def interpolate(a: int, b: int, c: int, d: int, weights: wp.vec4) -> Lane:  # type: ignore[empty-body]
        """Share of corners that each ray escapes at, among corners that know."""
        ...

    @wp.kernel(module="unique", module_options=module_options(PACKET), enable_backward=False)
    def trace_shared(
        first_row: int,
        worker: int,
        # in
        tree: FaceTree,
        points: wp.array(dtype=wp.vec3),
        normals: wp.array(dtype=wp.vec3),
        directions: wp.array2d(dtype=Lane),
        light: wp.array2d(dtype=Lane),
        chosen: wp.array(dtype=wp.int32),
        corners: wp.array(dtype=wp.vec4i),
        weights: wp.array(dtype=wp.vec4),
        tolerances: wp.array(dtype=float),
        known: wp.array2d(dtype=wp.int32),
        # out
        shading: wp.array(dtype=wp.vec3),
        open_lanes: wp.array2d(dtype=wp.int32),
        received: wp.array3d(dtype=wp.float32),
    ):
        """A thread owns a chosen receiver: it traces the rays that its corners leave open.

        Where there is room, it stores which rays of each packet escape, in the low half of a word, and which meet
        something, in the high half; and its light from each direction.
        """
        row = first_row + wp.tid()
        receiver = row
        corner = wp.vec4i(-1)
        tolerance = float(0.0)
        if chosen:
            receiver = chosen[row]
        if corners:
            corner = corners[receiver]
            tolerance = tolerances[receiver]
        point = points[receiver]
        normal = normals[receiver]
        total = wp.vec3()
        last = int(-1)
        for packet in range(directions.shape[0]):
            toward = Vectors(directions[packet, 0], directions[packet, 1], directions[packet, 2])
            cosine = dot_direction(normal, toward)
            facing_rays = bits_above(cosine, 0.0)
            open_rays = int(0)
            if facing_rays != 0:
                color = Vectors(light[packet, 0], light[packet, 1], light[packet, 2])
                rays = facing_rays
                if corner[0] >= 0:
                    a = known[corner[0], packet]
                    b = known[corner[1], packet]
                    c = known[corner[2], packet]
                    d = known[corner[3], packet]
                    agreed = a & b & c & d
                    open_rays = facing_rays & agreed
                    rays = facing_rays & ~(agreed | (agreed >> PACKET))
                    some = a | b | c | d
                    if rays != 0 and rays & ~(some | (some >> PACKET)) == 0:
                        doubtful = wp.abs(sum_open(rays, cosine, color))
                        brightness = doubtful[0] + doubtful[1] + doubtful[2]
                        if brightness <= tolerance:
                            tolerance -= brightness
                            shares = interpolate(a, b, c, d, weights[receiver])
                            total += sum_open(rays, wp.cw_mul(shares, cosine), color)
                            rays = 0
                if rays != 0:
                    result = find_open(
                        tree.corners, tree.lowers, tree.uppers, tree.leaf_count, point, normal, toward, rays, last
                    )
                    open_rays = open_rays | result[0]
                    last = result[1]
                total += sum_open(open_rays, cosine, color)
                if received.shape[0] > 0:
                    for lane in range(PACKET):
                        if (open_rays >> lane) % 2 == 1:
                            brightness = wp.length(wp.vec3(color.x[lane], color.y[lane], color.z[lane]))
                            received[receiver, packet, lane] = cosine[lane] * brightness
            if open_lanes.shape[0] > 0:
                open_lanes[row, packet] = open_rays | ((facing_rays & ~open_rays) << PACKET)
        shading[receiver] = total / wp.pi

    return trace_shared


def find_shares(tree: FaceTree, points: wp.array, normals: wp.array, samples: LightSamples) -> np.ndarray:
    """Find what share of receivers' light comes from each direction, on average over receivers, dim and bright ones.

    Args:
        tree: The blockers.
        points: Receiver positions [scene units], vec3 of shape [receiver]; a few stand for all.
        normals: Unit normals, vec3 of shape [receiver].
        samples: As for :func:`trace_shared`.
    Returns:
        Shares, of shape [direction], whose sum is 1, or less where some receivers see no light.
    Differentiable: no.
    """
    count = points.shape[0]
    chosen = np.arange(min(count, _PILOT_RECEIVERS)) * count // max(min(count, _PILOT_RECEIVERS), 1)
    at, facing = (wp.array(rows.numpy()[chosen], dtype=wp.vec3, device=points.device) for rows in (points, normals))
    shape = len(chosen), samples.directions.shape[1] // PACKET, PACKET
    received = zeros(shape, dtype=wp.float32, device=at.device)
    _Tracing(tree, at, facing, samples).trace(received=received)
    light = received.numpy().reshape(len(chosen), -1)
    light /= np.maximum(light.sum(axis=1, keepdims=True), 1e-12)
    return light.sum(axis=0) / max(len(chosen), 1)


class Corners(NamedTuple):
    """Receivers around others in an image."""

    receivers: np.ndarray
    """Four for each receiver, −1 for none, int of shape [receiver, 4]; these four have none themselves."""
    weights: np.ndarray
    """Of the bilinear interpolation between them, [receiver, 4]."""

    @classmethod
    def none(cls, count: int) -> "Corners":
        """No corners of any receiver."""
        return cls(np.full((count, 4), -1), np.zeros((count, 4)))


def trace_shared(
    tree: FaceTree,
    points: wp.array,
    normals: wp.array,
    samples: LightSamples,
    *,
    corners: Corners | None = None,
    progress: bool = False,
) -> wp.array:
    """Trace the shading of receivers: the radiance of a white surface in direct light.

    Args:
        tree: The blockers.
        points: Receiver positions [scene units], vec3 of shape [receiver].
        normals: Unit normals, vec3 of shape [receiver].
        samples: One set of directions, a multiple of 16, each run of 16 close to each other.
        corners: Receivers around others, whose visibility they take over; None for none.
        progress: Show a progress bar where it takes longer than a second.

    Returns:
        Shading, vec3 of shape [receiver].
    Differentiable: no.
    """
    tracing, size = _Tracing(tree, points, normals, samples), 2**24 // samples.directions.shape[1]
    if corners is None:
        corners = Corners.none(len(points))
    has_corners = corners.receivers[:, 0] >= 0
    at_corners, rows_of_corners = np.unique(corners.receivers[has_corners], return_inverse=True)
    if has_corners[at_corners].any():
        raise ValueError("corners: got receivers at corners that have corners themselves, expected none")
    known = empty((len(at_corners), tracing.packet_count), dtype=wp.int32, device=points.device)
    for part in progress_slices(len(at_corners), size, progress):
        tracing.trace(at_corners[part], open_lanes=known[part])
    if len(at_corners):
        rows = np.full(corners.receivers.shape, -1)
        rows[has_corners] = rows_of_corners.reshape(-1, 4)
        light = np.zeros(len(points), np.float32)  # of corners; the others are not traced yet
        light[at_corners] = np.abs(tracing.shading.numpy()[at_corners]).sum(axis=1)
        light = (light[corners.receivers] * corners.weights).sum(axis=1)
        tracing.take_over(known, rows, corners.weights, TOLERANCE * np.pi * light)
    others = np.setdiff1d(np.arange(len(points)), at_corners, assume_unique=True)
    for part in progress_slices(len(others), size, progress):
        tracing.trace(others[part])
    return tracing.shading


def find_corners(receivers: Receivers, instance: int, supersampling: int) -> Corners:
    """Find the receivers at the corners of the squares of pixels that receivers of an image are in.

    A receiver has corners if all of them lie on one smooth surface with it.

    Args:
        receivers: Of samples.
        instance: Which of their views.
        supersampling: Samples of a pixel across and down.
    """
    count = receivers.points.shape[1]
    result = Corners.none(count)
    triangles, face_ids = receivers.faces.numpy(), receivers.fragments.face_ids.numpy()
    face_ids = face_ids[min(instance, len(face_ids) - 1)]
    pixel_faces = triangles[face_ids]
    pixel_faces = np.where(
        (face_ids >= 0) & (pixel_faces == pixel_faces[..., :1]).all(axis=-1), pixel_faces[..., 0], -1
    )
    of_pixel = pixel_faces[::supersampling, ::supersampling]
    square = 1 << max(min(of_pixel.shape) // SQUARES, 1).bit_length() - 1
    if square == 1:
        return result
    places = np.full((count + 1, 2), -1)
    places[pixel_faces] = np.moveaxis(np.indices(pixel_faces.shape), 0, -1) // supersampling
    places = places[:-1]  # the last item was for samples without a receiver
    inside = np.flatnonzero(places[:, 0] >= 0)
    first = places[inside] // square * square
    last = np.minimum(first + square, np.array(of_pixel.shape) - 1)
    rows, columns = np.stack([first, last]).transpose(2, 1, 0)  # each [receiver, 2]
    corners = of_pixel[rows[:, [0, 0, 1, 1]], columns[:, [0, 1, 0, 1]]]
    points, normals = (item.numpy()[min(instance, len(item) - 1)] for item in (receivers.points, receivers.normals))
    steps = points[corners] - points[inside, None]
    climbs = np.abs(np.einsum("rcd,rd->rc", steps, normals[inside]))
    is_one = np.einsum("rcd,rd->rc", normals[corners], normals[inside]) > ALIKE
    is_one &= (corners >= 0) & (climbs <= LEVEL * np.linalg.norm(steps, axis=-1))
    is_one |= corners == inside[:, None]
    is_one = is_one.all(axis=1)
    down, right = ((places[inside] - first) / np.maximum(last - first, 1)).T
    weights = np.stack([(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right], axis=1)
    result.receivers[inside[is_one]], result.weights[inside[is_one]] = corners[is_one], weights[is_one]
    result.receivers[np.unique(corners[is_one])] = -1
    return result


class _Tracing:
    """Launches that trace receivers."""

    _corners: tuple[wp.array | None, ...] = (None, None, None, None)

    def __init__(self, tree: FaceTree, points: wp.array, normals: wp.array, samples: LightSamples):
        device = points.device
        packets = packets_of(samples.directions[0])
        directions = constant(packets, lane_type(PACKET), device)
        light = constant(packets_of(samples.radiance[0]), lane_type(PACKET), device)
        self.packet_count = len(packets)
        self._inputs = tree, points, normals, directions, light
        self.shading = empty(points.shape, dtype=wp.vec3, device=device)

    def take_over(self, known: wp.array, rows: np.ndarray, weights: np.ndarray, tolerances: np.ndarray) -> None:
        """From now on receivers take over the visibility of their corners, whose rows of ``known`` are given."""
        dtypes = zip((rows, weights, tolerances), (wp.vec4i, wp.vec4, wp.float32), strict=True)
        self._corners = *(wp.array(values, dtype=dtype, device=known.device) for values, dtype in dtypes), known

    def trace(
        self, chosen: np.ndarray | None = None, *, open_lanes: wp.array | None = None, received: wp.array | None = None
    ) -> None:
        """Trace chosen receivers, or all, into :attr:`shading`."""
        device = self.shading.device
        count = len(self.shading) if chosen is None else len(chosen)
        numbers = None if chosen is None else wp.array(chosen, dtype=wp.int32, device=device)
        open_lanes = empty((0, 0), dtype=wp.int32, device=device) if open_lanes is None else open_lanes
        received = empty((0, 0, 0), dtype=wp.float32, device=device) if received is None else received
        launch(
            _make_trace(),
            count,
            inputs=[*self._inputs, numbers, *self._corners],
            outputs=[self.shading, open_lanes, received],
            cost=_PACKET_COST * self.packet_count,
        )
