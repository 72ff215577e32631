"""Shared rays: all receivers look for light in the same directions, so that an image has no grain.

With directions ω_i and the light l_i that each stands for (:func:`.light_samples.cut_map`), a receiver gets

    Σ_i l_i V_i max(n·ω_i, 0) / π

Some receivers tell where light comes from, so that most directions go there (:func:`find_light_shares`).
Rays go through the scene in packets of 16 that are close to each other (:mod:`.ray_packets`).

Neighbors in an image mostly see the same light. So all rays are traced at the corners of squares of pixels alone
(:func:`find_corners`). Receivers within a square take over the visibility on which its corners agree, interpolate that
of doubtful rays that bring little light, and trace the others. Edges of shadows are as sharp as if all were traced, but
a shadow that falls between the corners is missed.
"""

import functools
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.batch import instance_of
from warpshadow.device.constants import constant
from warpshadow.device.lanes import lane_type, make_lane_functions, module_options, vectors_type
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, zeros
from warpshadow.stages.light.light_samples import LightSamples
from warpshadow.stages.rays.beam_packets import make_beams
from warpshadow.stages.rays.ray_packets import PACKET, FaceTree, make_find_open, packets_of
from warpshadow.stages.rays.ray_tracing import progress_slices
from warpshadow.stages.receivers.receivers import Receivers
from warpshadow.stages.receivers.sample_receivers import MAX_SHARED_SLOPE, MIN_SHARED_COSINE
from warpshadow.stages.shell.shell_rays import FAR

_PACKET_COST = 2000.0  # nanoseconds that a packet takes
_PILOT_RECEIVERS = 256  # receivers that stand for all, where directions are chosen

SQUARES = 128
"""Squares at whose corners all rays are traced, across the shorter side of an image, or more: their side in pixels is a
power of two. With squares of 4 pixels at 128², thin shadows are missed: chair_wheel_fence of demos/kinds.py is 4.4% off
a path tracer, in place of 2.5%."""

TOLERANCE = 0.02  # part of a receiver's light that may come from rays whose visibility is interpolated


@functools.cache
def _make_trace(is_near: bool) -> wp.Kernel:
    Lane, Vectors, fn = lane_type(PACKET), vectors_type(PACKET), make_lane_functions(PACKET)
    find_open, bits_above, (beams_to_light, cosines_of) = make_find_open(), fn.bits_above, make_beams(is_near)

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
    wp::vec_t<{PACKET}, wp::float32> visibility;
    const int words[4] = {{a, b, c, d}};
    for (int lane = 0; lane < {PACKET}; ++lane) {{
        float open = 0.0f, known = 0.0f;
        for (int corner = 0; corner < 4; ++corner) {{
            const float is_open = (words[corner] >> lane) & 1, is_blocked = (words[corner] >> (lane + {PACKET})) & 1;
            open += weights[corner] * is_open;
            known += weights[corner] * (is_open + is_blocked);
        }}
        visibility[lane] = known > 0.0f ? open / known : 0.0f;
    }}
    return visibility;
    """)
    def interpolate(a: int, b: int, c: int, d: int, weights: wp.vec4) -> Lane:  # type: ignore[empty-body]
        """Share of corners at which each ray escapes, among corners at which its visibility is known."""
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
        receiver_indices: wp.array(dtype=wp.int32),
        corners: wp.array(dtype=wp.vec4i),
        weights: wp.array(dtype=wp.vec4),
        tolerances: wp.array(dtype=float),
        corner_visibility: wp.array2d(dtype=wp.int32),
        shell: wp.vec4,
        # out
        shading: wp.array(dtype=wp.vec3),
        open_lanes: wp.array2d(dtype=wp.int32),
        ray_light: wp.array3d(dtype=wp.float32),
    ):
        """A thread owns a receiver of ``receiver_indices``: it traces the rays whose visibility its corners do not
        tell.

        Where there is room, it stores which rays of each packet escape, in the low half of a word, and which meet
        something, in the high half; and its light from each direction.
        """
        row = first_row + wp.tid()
        receiver = row
        corner_rows = wp.vec4i(-1)
        tolerance = float(0.0)
        if receiver_indices:
            receiver = receiver_indices[row]
        if corners:
            corner_rows = corners[receiver]
            tolerance = tolerances[receiver]
        point = points[receiver]
        normal = normals[receiver]
        irradiance = wp.vec3()
        last_face = int(-1)
        for packet in range(directions.shape[0]):
            light_directions = Vectors(directions[packet, 0], directions[packet, 1], directions[packet, 2])
            ray_directions = beams_to_light(shell, point, light_directions)
            cosine = cosines_of(shell, normal, light_directions, ray_directions)
            facing_rays = bits_above(cosine, 0.0)
            open_rays = int(0)
            if facing_rays != 0:
                color = Vectors(light[packet, 0], light[packet, 1], light[packet, 2])
                rays = facing_rays
                if corner_rows[0] >= 0:
                    a = corner_visibility[corner_rows[0], packet]
                    b = corner_visibility[corner_rows[1], packet]
                    c = corner_visibility[corner_rows[2], packet]
                    d = corner_visibility[corner_rows[3], packet]
                    agreed_rays = a & b & c & d
                    open_rays = facing_rays & agreed_rays
                    rays = facing_rays & ~(agreed_rays | (agreed_rays >> PACKET))
                    known_rays = a | b | c | d
                    if rays != 0 and rays & ~(known_rays | (known_rays >> PACKET)) == 0:
                        doubtful_light = wp.abs(sum_open(rays, cosine, color))
                        brightness = doubtful_light[0] + doubtful_light[1] + doubtful_light[2]
                        if brightness <= tolerance:
                            tolerance -= brightness
                            ray_visibility = interpolate(a, b, c, d, weights[receiver])
                            irradiance += sum_open(rays, wp.cw_mul(ray_visibility, cosine), color)
                            rays = 0
                traced_rays, last_face = find_open(tree, point, normal, ray_directions, rays, last_face)
                open_rays = open_rays | traced_rays
                irradiance += sum_open(open_rays, cosine, color)
                if ray_light.shape[0] > 0:
                    for lane in range(PACKET):
                        if (open_rays >> lane) % 2 == 1:
                            brightness = wp.length(wp.vec3(color.x[lane], color.y[lane], color.z[lane]))
                            ray_light[receiver, packet, lane] = cosine[lane] * brightness
            if open_lanes.shape[0] > 0:
                open_lanes[row, packet] = open_rays | ((facing_rays & ~open_rays) << PACKET)
        shading[receiver] = irradiance / wp.pi

    return trace_shared


def find_light_shares(
    tree: FaceTree, points: wp.array, normals: wp.array, samples: LightSamples, *, shell: np.ndarray = FAR
) -> np.ndarray:
    """Find the share of receivers' light that comes from each direction, on average over dim and bright receivers.

    Args:
        points: Receiver positions [scene units], vec3 of shape [receiver]; a few stand for all.
        normals: Unit normals, vec3 of shape [receiver].
        samples, shell: As for :func:`trace_shared`.
    Returns:
        Shares, of shape [direction], whose sum is 1, or less where some receivers see no light.
    Differentiable: no.
    """
    count = points.shape[0]
    pilot_receivers = np.arange(min(count, _PILOT_RECEIVERS)) * count // max(min(count, _PILOT_RECEIVERS), 1)
    pilot_points, pilot_normals = (
        wp.array(rows.numpy()[pilot_receivers], dtype=wp.vec3, device=points.device) for rows in (points, normals)
    )
    shape = len(pilot_receivers), samples.directions.shape[1] // PACKET, PACKET
    direction_light = zeros(shape, dtype=wp.float32, device=pilot_points.device)
    _Tracing(tree, pilot_points, pilot_normals, samples, shell).trace(ray_light=direction_light)
    light = direction_light.numpy().reshape(len(pilot_receivers), -1)
    light /= np.maximum(light.sum(axis=1, keepdims=True), 1e-12)
    return light.sum(axis=0) / max(len(pilot_receivers), 1)


class Corners(NamedTuple):
    """Receivers at the corners of squares around others in an image."""

    receivers: np.ndarray
    """Four for each receiver, −1 for none, int of shape [receiver, 4]; these four have none themselves."""
    weights: np.ndarray  # bilinear weights of the corners, [receiver, 4]

    @classmethod
    def none(cls, count: int) -> "Corners":
        """Make corners of receivers that have none."""
        return cls(np.full((count, 4), -1), np.zeros((count, 4)))


def trace_shared(
    tree: FaceTree,
    points: wp.array,
    normals: wp.array,
    samples: LightSamples,
    *,
    shell: np.ndarray = FAR,
    corners: Corners | None = None,
    progress: bool = False,
) -> wp.array:
    """Trace the shading of receivers: the radiance of a white surface in direct light.

    Args:
        points, normals: Receivers [scene units] and their unit normals, vec3 of shape [receiver].
        samples: One set of directions, a multiple of 16, each run of 16 close to each other.
        shell: As for :func:`warpshadow.stages.rays.ray_tracing.trace_shading`.
        corners: Receivers around others, whose visibility they take over; None for none.

    Returns:
        Shading, vec3 of shape [receiver].
    Differentiable: no.
    """
    tracing, block_size = _Tracing(tree, points, normals, samples, shell), 2**24 // samples.directions.shape[1]
    if corners is None:
        corners = Corners.none(len(points))
    has_corners = corners.receivers[:, 0] >= 0
    corner_receivers, corner_indices = np.unique(corners.receivers[has_corners], return_inverse=True)
    if has_corners[corner_receivers].any():
        raise ValueError("corners: got receivers at corners that have corners themselves, expected none")
    corner_visibility = empty((len(corner_receivers), tracing.packet_count), dtype=wp.int32, device=points.device)
    for block in progress_slices(len(corner_receivers), block_size, progress):
        tracing.trace(corner_receivers[block], open_lanes=corner_visibility[block])
    if len(corner_receivers):
        row_table = np.full(corners.receivers.shape, -1)
        row_table[has_corners] = corner_indices.reshape(-1, 4)
        corner_light = np.zeros(len(points), np.float32)  # of corners; the others are not traced yet
        corner_light[corner_receivers] = np.abs(tracing.shading.numpy()[corner_receivers]).sum(axis=1)
        corner_light = (corner_light[corners.receivers] * corners.weights).sum(axis=1)
        tracing.take_over(corner_visibility, row_table, corners.weights, TOLERANCE * np.pi * corner_light)
    other_receivers = np.setdiff1d(np.arange(len(points)), corner_receivers, assume_unique=True)
    for block in progress_slices(len(other_receivers), block_size, progress):
        tracing.trace(other_receivers[block])
    return tracing.shading


def find_corners(receivers: Receivers, instance: int, supersampling: int) -> Corners:
    """Find the receivers at the corners of the squares of pixels that receivers of an image are in.

    A receiver of a sample has corners if all of them lie on one smooth surface with it.
    """
    count = receivers.points.shape[1]
    corners = Corners.none(count)
    triangles, face_ids = receivers.faces.numpy(), receivers.fragments.face_ids.numpy()
    face_ids = instance_of(face_ids, instance)
    pixel_faces = triangles[face_ids]
    pixel_faces = np.where(
        (face_ids >= 0) & (pixel_faces == pixel_faces[..., :1]).all(axis=-1), pixel_faces[..., 0], -1
    )
    pixel_receivers = pixel_faces[::supersampling, ::supersampling]
    square_size = 1 << max(min(pixel_receivers.shape) // SQUARES, 1).bit_length() - 1
    if square_size == 1:
        return corners
    pixel_coordinates = np.full((count + 1, 2), -1)
    pixel_coordinates[pixel_faces] = np.moveaxis(np.indices(pixel_faces.shape), 0, -1) // supersampling
    pixel_coordinates = pixel_coordinates[:-1]  # the last item was for samples without a receiver
    visible_receivers = np.flatnonzero(pixel_coordinates[:, 0] >= 0)
    square_starts = pixel_coordinates[visible_receivers] // square_size * square_size
    square_ends = np.minimum(square_starts + square_size, np.array(pixel_receivers.shape) - 1)
    rows, columns = np.stack([square_starts, square_ends]).transpose(2, 1, 0)  # each [receiver, 2]
    corner_receivers = pixel_receivers[rows[:, [0, 0, 1, 1]], columns[:, [0, 1, 0, 1]]]
    points, normals = (instance_of(item.numpy(), instance) for item in (receivers.points, receivers.normals))
    offsets = points[corner_receivers] - points[visible_receivers, None]
    heights = np.abs(np.einsum("rcd,rd->rc", offsets, normals[visible_receivers]))
    is_one_surface = np.einsum("rcd,rd->rc", normals[corner_receivers], normals[visible_receivers]) > MIN_SHARED_COSINE
    is_one_surface &= (corner_receivers >= 0) & (heights <= MAX_SHARED_SLOPE * np.linalg.norm(offsets, axis=-1))
    is_one_surface |= corner_receivers == visible_receivers[:, None]
    is_one_surface = is_one_surface.all(axis=1)
    row_shares, column_shares = (
        (pixel_coordinates[visible_receivers] - square_starts) / np.maximum(square_ends - square_starts, 1)
    ).T
    weights = np.stack(
        [
            (1 - row_shares) * (1 - column_shares),
            (1 - row_shares) * column_shares,
            row_shares * (1 - column_shares),
            row_shares * column_shares,
        ],
        axis=1,
    )
    corners.receivers[visible_receivers[is_one_surface]], corners.weights[visible_receivers[is_one_surface]] = (
        corner_receivers[is_one_surface],
        weights[is_one_surface],
    )
    corners.receivers[np.unique(corner_receivers[is_one_surface])] = -1
    return corners


class _Tracing:
    """Launches that trace receivers."""

    _corners: tuple[wp.array | None, ...] = (None, None, None, None)

    def __init__(self, tree: FaceTree, points: wp.array, normals: wp.array, samples: LightSamples, shell: np.ndarray):
        device = points.device
        packets = packets_of(samples.directions[0])
        directions = constant(packets, lane_type(PACKET), device)
        light = constant(packets_of(samples.radiance[0]), lane_type(PACKET), device)
        self.packet_count = len(packets)
        self._inputs = tree, points, normals, directions, light
        self._shell = shell
        self.shading = empty(points.shape, dtype=wp.vec3, device=device)

    def take_over(
        self, corner_visibility: wp.array, corner_rows: np.ndarray, weights: np.ndarray, tolerances: np.ndarray
    ) -> None:
        """Interpolate visibility in later calls between receivers' corners, given as rows of ``corner_visibility``."""
        dtypes = zip((corner_rows, weights, tolerances), (wp.vec4i, wp.vec4, wp.float32), strict=True)
        self._corners = (
            *(wp.array(values, dtype=dtype, device=corner_visibility.device) for values, dtype in dtypes),
            corner_visibility,
        )

    def trace(
        self,
        receiver_indices: np.ndarray | None = None,
        *,
        open_lanes: wp.array | None = None,
        ray_light: wp.array | None = None,
    ) -> None:
        """Trace chosen receivers, or all, into :attr:`shading`."""
        device = self.shading.device
        count = len(self.shading) if receiver_indices is None else len(receiver_indices)
        index_array = None if receiver_indices is None else wp.array(receiver_indices, dtype=wp.int32, device=device)
        open_lanes = empty((0, 0), dtype=wp.int32, device=device) if open_lanes is None else open_lanes
        ray_light = empty((0, 0, 0), dtype=wp.float32, device=device) if ray_light is None else ray_light
        launch(
            _make_trace(bool(self._shell[3])),
            count,
            inputs=[*self._inputs, index_array, *self._corners, wp.vec4(*self._shell)],
            outputs=[self.shading, open_lanes, ray_light],
            cost=_PACKET_COST * self.packet_count,
        )
