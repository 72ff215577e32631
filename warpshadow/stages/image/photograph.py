"""Photographs: bodies put into one, with the shadows that they cast on its surfaces.

Some bodies, the catchers, model surfaces in the photograph and are not drawn. Where a sample sees one that receives the
light S with all bodies and S₀ with catchers alone, the photograph P becomes [Debevec 1998, section 6, by a ratio in
place of a difference, which asks for no albedo]

    P (1 + (S − S₀) r),    r = S₀⁺ / (S₀⁺² + ε²)

This is P S / S₀ where S₀ ≫ ε, up to a factor 1 + (ε/S₀)², and P where S₀ → 0 and the ratio is not known. ε is 1/256 of
the mean of S₀ over the samples that would see catchers without the other bodies: less than a photograph of 8 bits tells
from black. The factor of P is averaged over a pixel and smoothed at silhouettes, P is not: pixels without a shadow stay
as they are.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in, rows
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty

_RELATIVE_FLOOR = 1.0 / 256.0


@wp.func
def _regularized_inverse(light: float, floor: float):
    """r, from S₀ and ε."""
    if floor <= 0.0:
        return 0.0
    floor_ratio = wp.max(light, 0.0) / floor
    return floor_ratio / ((floor_ratio * floor_ratio + 1.0) * floor)


@wp.kernel
def _split_samples(
    # in
    face_ids: wp.array2d(dtype=wp.int32),
    is_catcher: wp.array(dtype=wp.bool),
    reflected_light: wp.array2d(dtype=wp.vec3),
    catcher_light: wp.array2d(dtype=wp.vec4),
    floors: wp.array(dtype=float),
    # out
    body_light: wp.array2d(dtype=wp.vec3),
    inverse_light: wp.array2d(dtype=wp.vec3),
    base_factor: wp.array2d(dtype=wp.vec4),
):
    """A thread owns a sample."""
    batch, sample = wp.tid()
    face = face_ids[instance_in(batch, face_ids.shape[0]), sample]
    if face < 0:
        body_light[batch, sample] = wp.vec3()
        inverse_light[batch, sample] = wp.vec3()
        base_factor[batch, sample] = wp.vec4(1.0, 1.0, 1.0, 1.0)
    elif is_catcher[face]:
        light = catcher_light[instance_in(batch, catcher_light.shape[0]), sample]
        floor = floors[instance_in(batch, floors.shape[0])]
        red = _regularized_inverse(light[0], floor)
        green = _regularized_inverse(light[1], floor)
        blue = _regularized_inverse(light[2], floor)
        body_light[batch, sample] = wp.vec3()
        inverse_light[batch, sample] = wp.vec3(red, green, blue)
        base_factor[batch, sample] = wp.vec4(1.0 - light[0] * red, 1.0 - light[1] * green, 1.0 - light[2] * blue, 0.0)
    else:
        body_light[batch, sample] = reflected_light[instance_in(batch, reflected_light.shape[0]), sample]
        inverse_light[batch, sample] = wp.vec3()
        base_factor[batch, sample] = wp.vec4()


class RatioImage(NamedTuple):
    """Light that samples reflect, and factors of the photograph, vec3 of shape [batch, height, width]."""

    body_light: wp.array  # where they see a body that is drawn
    inverse_light: wp.array  # r where they see a catcher, 0 elsewhere
    base_factor: wp.array  # 1 − S₀ r where they see a catcher, 1 where there is nothing; vec4


def find_ratio_image(
    face_ids: wp.array, is_catcher: wp.array, reflected_light: wp.array, catcher_light: wp.array
) -> RatioImage:
    """Split samples into samples of bodies and samples of the photograph, in the light or in shadow.

    Args:
        face_ids: Face that each sample sees, −1 for none, int32 of shape [batch, height, width].
        is_catcher: Whether a face is one of a catcher, bool of shape [face].
        reflected_light: Light that the samples reflect, vec3 of shape [batch, height, width].
        catcher_light: S₀, and whether a sample would see a catcher without the other bodies, 1 or 0; vec4 likewise.
            Any batch may be 1 and then serves every instance.

    It waits for the device, since the host finds ε, and so cannot be captured in a CUDA graph.
    Differentiable: reflected_light, catcher_light (but for ε).
    """
    batch_count = common_batch(
        {"face_ids": face_ids, "reflected_light": reflected_light, "catcher_light": catcher_light}
    )
    device = face_ids.device
    catcher_radiance = catcher_light.numpy()
    catcher_counts = np.maximum(catcher_radiance[..., 3].sum(axis=(1, 2)), 1.0)
    means = np.maximum(catcher_radiance[..., :3], 0).sum(axis=(1, 2, 3), dtype=np.float64) / (3 * catcher_counts)
    floors = wp.array(_RELATIVE_FLOOR * means, dtype=float, device=device)
    sample_shape = batch_count, face_ids[0].size
    ratio_arrays = [empty(sample_shape, dtype=dtype, device=device) for dtype in (wp.vec3, wp.vec3, wp.vec4)]
    launch(
        _split_samples,
        sample_shape,
        inputs=[rows(face_ids), is_catcher, rows(reflected_light), rows(catcher_light), floors],
        outputs=ratio_arrays,
    )
    return RatioImage(*(ratio_array.reshape((batch_count, *face_ids.shape[1:])) for ratio_array in ratio_arrays))


@wp.kernel
def _compose_pixels(
    # in
    photograph: wp.array3d(dtype=wp.vec3),
    body_light: wp.array3d(dtype=wp.vec4),
    relit_factor: wp.array3d(dtype=wp.vec4),
    base_factor: wp.array3d(dtype=wp.vec4),
    # out
    composed: wp.array3d(dtype=wp.vec3),
):
    """A thread owns a pixel."""
    batch, row, column = wp.tid()
    background = photograph[instance_in(batch, photograph.shape[0]), row, column]
    color = body_light[instance_in(batch, body_light.shape[0]), row, column]
    relit = relit_factor[instance_in(batch, relit_factor.shape[0]), row, column]
    base = base_factor[instance_in(batch, base_factor.shape[0]), row, column]
    factor = wp.vec3(relit[0] + base[0], relit[1] + base[1], relit[2] + base[2])
    composed[batch, row, column] = wp.vec3(color[0], color[1], color[2]) + wp.cw_mul(background, factor)


@wp.kernel(enable_backward=False)
def _composite_on_black(
    # in
    body_light: wp.array3d(dtype=wp.vec4),
    relit_factor: wp.array3d(dtype=wp.vec4),
    base_factor: wp.array3d(dtype=wp.vec4),
    # out
    composited: wp.array3d(dtype=wp.vec4),
):
    """A thread owns a pixel."""
    batch, row, column = wp.tid()
    color = body_light[instance_in(batch, body_light.shape[0]), row, column]
    relit = relit_factor[instance_in(batch, relit_factor.shape[0]), row, column]
    base = base_factor[instance_in(batch, base_factor.shape[0]), row, column]
    factor = (relit[0] + base[0] + relit[1] + base[1] + relit[2] + base[2]) / 3.0
    composited[batch, row, column] = wp.vec4(color[0], color[1], color[2], wp.clamp(1.0 - factor, 0.0, 1.0))


def composite_alone(body_light: wp.array, relit_factor: wp.array, base_factor: wp.array) -> wp.array:
    """Draw bodies over nothing; their shadows are coverage, the mean of the share they take of a white photograph.

    Args:
        body_light, relit_factor, base_factor: As for :func:`compose`.
    Returns:
        Linear RGB, premultiplied, and coverage, vec4 of shape [batch, height, width]. Not differentiable.
    """
    batch_count = common_batch({"body_light": body_light, "relit_factor": relit_factor, "base_factor": base_factor})
    composited = empty((batch_count, *body_light.shape[1:]), dtype=wp.vec4, device=body_light.device)
    launch(_composite_on_black, composited.shape, inputs=[body_light, relit_factor, base_factor], outputs=[composited])
    return composited


def compose(photograph: wp.array, body_light: wp.array, relit_factor: wp.array, base_factor: wp.array) -> wp.array:
    """Multiply a photograph by its ratio of light, and put bodies into it.

    Args:
        photograph: Linear RGB, vec3 of shape [batch, height, width].
        body_light: The film of the reflected light, vec4 of shape [batch, height, width].
        relit_factor: The film of ``inverse_light`` times the light at the samples, likewise.
        base_factor: That of ``base_factor``, likewise. Any batch may be 1 and then serves every instance.
    Returns:
        Linear RGB, vec3 of shape [batch, height, width].
    Differentiable: all.
    """
    batch_count = common_batch(
        {"photograph": photograph, "body_light": body_light, "relit_factor": relit_factor, "base_factor": base_factor}
    )
    check.shape("photograph", photograph.shape, ("batch", *body_light.shape[1:]))
    composed = empty((batch_count, *body_light.shape[1:]), dtype=wp.vec3, device=body_light.device)
    launch(
        _compose_pixels, composed.shape, inputs=[photograph, body_light, relit_factor, base_factor], outputs=[composed]
    )
    return composed
