"""Footprints: the part of a texture that a sample covers.

A sample does not see a point of the texture but its *footprint*: to first order an ellipse, the image of the sample
under the derivative of uv by its position. It is covered by *probes* on a line along its major axis. So a ground seen
at a grazing angle neither blurs nor aliases.

The gradient of the footprint's width and direction is 1 to 15% of that of a textured plane's pose.
"""

import functools
import math
from dataclasses import dataclass

import warp as wp

from warpshadow import check
from warpshadow.device.array_checks import finite_arrays
from warpshadow.device.batch import common_batch, instance_in, rows
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, zeros
from warpshadow.stages.raster.rasterization import Fragments
from warpshadow.stages.raster.screen import center, volume_rates
from warpshadow.stages.textures.pyramid import Textures

PROBE_LINE_EXCESS = 0.25
"""Widths that a line of probes is longer than they are wide together: a probe reaches beyond its width.

Of 0 to 1, a quarter was nearest to the mean over the footprint, for noise, natural spectra and checkerboards.
"""

MAX_PROBES = 7  # most probes of a footprint, an odd number; where it is longer still, its probes grow wider

# Derivatives of uv are cut off here [texels per sample], so that their fourth powers stay finite.
_MAX_DERIVATIVE = 1.0e6


@dataclass(frozen=True, eq=False)
class Footprints:
    """Place of each sample in its texture, and its footprint there.

    Args:
        texture_ids: Texture that the sample sees, -1 where none, int32 of shape [batch, height, width].
        uvs: Texture coordinates, vec2 of shape [batch, height, width].
        probes: (Δu, Δv, width, count): probes lie Δ apart on a line through uv, each as wide as ``width`` texels of
            the finest level; ``count`` is the length of the line in widths, at least 1, and need not be whole. Vec4 of
            shape [batch, height, width].
    """

    texture_ids: wp.array
    uvs: wp.array
    probes: wp.array

    @functools.cached_property
    def rows(self) -> list[wp.array]:
        """The arrays as [batch, sample]."""
        return [*map(rows, (self.texture_ids, self.uvs, self.probes))]

    def coarsest_level(self) -> int:
        """Coarsest level that a probe takes, if textures have that many; it waits for the device."""
        width = self.probes.numpy()[..., 2].max(initial=1.0)
        return math.ceil(math.log2(width))


@wp.func
def _uv_derivatives(
    a: wp.vec4,
    b: wp.vec4,
    c: wp.vec4,
    uv_offset_a: wp.vec2,
    uv_offset_b: wp.vec2,
    uv_offset_c: wp.vec2,
    ray: wp.vec2,
    step: wp.vec2,
):
    """Derivative of uv by the position of a sample [1/sample], its columns by column and row.

    ``a``, ``b`` and ``c`` are the vertices in clip space, ``uv_offset_a``, ``uv_offset_b`` and ``uv_offset_c`` their
    uvs relative to that of the sample, and ``step`` is that of the ray from one sample to the next. It is that on the
    whole plane of the face.
    """
    rates_x, rates_y = volume_rates(a, b, c, ray, step)
    x = rates_x[0] * uv_offset_a + rates_x[1] * uv_offset_b + rates_x[2] * uv_offset_c
    y = rates_y[0] * uv_offset_a + rates_y[1] * uv_offset_b + rates_y[2] * uv_offset_c
    return wp.mat22(x[0], y[0], x[1], y[1])


@wp.func
def _probes(derivatives: wp.mat22, width: float, height: float):
    """Probes of a footprint (`Footprints`) in a texture of a size [texels].

    The derivative's singular values are the major and the minor axis of the footprint.
    """
    limit = wp.static(_MAX_DERIVATIVE)
    ux = wp.clamp(derivatives[0, 0] * width, -limit, limit)
    uy = wp.clamp(derivatives[0, 1] * width, -limit, limit)
    vx = wp.clamp(derivatives[1, 0] * height, -limit, limit)
    vy = wp.clamp(derivatives[1, 1] * height, -limit, limit)
    uu = ux * ux + uy * uy
    vv = vx * vx + vy * vy
    probes = wp.vec4(0.0, 0.0, 1.0, 1.0)
    if uu + vv > 1.0:  # else one probe of the finest level is enough
        uv = ux * vx + uy * vy
        half = 0.5 * (uu - vv)
        # the axes of a round footprint have no derivative: 1e-12 keeps it finite
        root = wp.sqrt(half * half + uv * uv + 1.0e-12 * (uu + vv) * (uu + vv))
        major = wp.sqrt(0.5 * (uu + vv) + root)
        minor = wp.abs(ux * vy - uy * vx) / major
        probe_width = wp.max(wp.max(minor, major / wp.static(MAX_PROBES + PROBE_LINE_EXCESS)), 1.0)
        count = wp.max(major / probe_width - wp.static(PROBE_LINE_EXCESS), 1.0)
        # eigenvector of the major axis, from the row in which nothing cancels
        along_u = wp.where(half > 0.0, root + half, uv)
        along_v = wp.where(half > 0.0, uv, root - half)
        step = probe_width / wp.sqrt(along_u * along_u + along_v * along_v)
        probes = wp.vec4(along_u * step / width, along_v * step / height, probe_width, count)
    return probes


@wp.kernel
def _find_footprints(
    # in
    face_ids: wp.array2d(dtype=wp.int32),
    barycentrics: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    clip_positions: wp.array2d(dtype=wp.vec4),
    uv_faces: wp.array(dtype=wp.vec3i),
    uvs: wp.array2d(dtype=wp.vec2),
    texture_of_face: wp.array(dtype=wp.int32),
    levels: wp.array2d(dtype=wp.vec3i),
    image_width: int,
    image_height: int,
    batch_count: int,
    # out
    texture_ids: wp.array(dtype=wp.int32),
    sample_uvs: wp.array(dtype=wp.vec2),
    probes: wp.array(dtype=wp.vec4),
):
    """A thread owns a sample; uvs and probes are zero before."""
    thread = wp.tid()
    instance = int(0)
    if batch_count > 1:  # on a CPU dividing takes as long as much of the rest
        instance = thread // (image_width * image_height)
    sample = thread - instance * image_width * image_height
    fragment_batch = instance_in(instance, face_ids.shape[0])
    face = face_ids[fragment_batch, sample]
    texture = int(-1)
    if face >= 0:
        texture = texture_of_face[face]
    texture_ids[thread] = texture
    if texture >= 0:
        clip = clip_positions[instance_in(instance, clip_positions.shape[0])]
        a = clip[faces[face][0]]
        b = clip[faces[face][1]]
        c = clip[faces[face][2]]
        instance_uvs = uvs[instance_in(instance, uvs.shape[0])]
        uv_a = instance_uvs[uv_faces[face][0]]
        uv_b = instance_uvs[uv_faces[face][1]]
        uv_c = instance_uvs[uv_faces[face][2]]
        weights = barycentrics[fragment_batch, sample]
        uv = weights[0] * uv_a + weights[1] * uv_b + weights[2] * uv_c
        row = sample // image_width
        ray = center(sample - row * image_width, row, image_width, image_height)
        step = wp.vec2(2.0 / float(image_width), 2.0 / float(image_height))
        derivatives = _uv_derivatives(a, b, c, uv_a - uv, uv_b - uv, uv_c - uv, ray, step)
        sample_uvs[thread] = uv
        probes[thread] = _probes(derivatives, float(levels[texture, 0][1]), float(levels[texture, 0][2]))


def find_footprints(
    fragments: Fragments,
    faces: wp.array,
    clip_positions: wp.array,
    uvs: wp.array,
    uv_faces: wp.array,
    texture_of_face: wp.array,
    textures: Textures,
) -> Footprints:
    """Find the place of each sample in its texture, and its footprint there.

    Footprints depend on the sizes of the textures, not on their texels: where geometry and camera do not move, they are
    found once. A footprint is that of the sample's face, continued beyond its edges, so neither seams of the uvs nor
    occlusions disturb it.

    Args:
        faces: Vertex indices, vec3i of shape [face].
        clip_positions: The rasterized vertices in clip space, vec4 of shape [batch, vertex].
        uvs: Texture coordinates, vec2 of shape [batch, uv].
        uv_faces: Indices of uvs, vec3i of shape [face]; faces without a texture are not read.
            Any batch may be 1 and then serves every instance.
        texture_of_face: Texture on each face, -1 for none, int32 of shape [face].
    Returns:
        Footprints.
    Differentiable: clip_positions, barycentrics of the fragments, uvs; the width and the direction of a footprint
    included.
    """
    check.shape("uv_faces", uv_faces.shape, faces.shape)
    check.shape("texture_of_face", texture_of_face.shape, faces.shape)
    finite_arrays({"uvs": uvs})
    batch_count = common_batch({"fragments": fragments.barycentrics, "clip_positions": clip_positions, "uvs": uvs})
    _, height, width = fragments.face_ids.shape
    count, shape = batch_count * height * width, (batch_count, height, width)
    texture_ids = empty(count, dtype=wp.int32, device=faces.device)
    sample_uvs = zeros(count, dtype=wp.vec2, device=faces.device)
    probes = zeros(count, dtype=wp.vec4, device=faces.device)
    launch(
        _find_footprints,
        count,
        inputs=[
            *fragments.rows,
            faces,
            clip_positions,
            uv_faces,
            uvs,
            texture_of_face,
            textures.levels,
            width,
            height,
            batch_count,
        ],
        outputs=[texture_ids, sample_uvs, probes],
    )
    return Footprints(*(array.reshape(shape) for array in (texture_ids, sample_uvs, probes)))
