"""Reflection: the light of a lobe and diffuse light, as glTF mixes them for metals and for all else.

With G = Σ w (T L + (1 − T) R + M) and G' = Σ w' (T L + (1 − T) R + M) over the samples of a lobe, T their
transmittance, R the mean radiance of blockers, M the radiance that bodies which lobes meet add to it
(:mod:`.mirrored`), diffuse light E, metallic m, specular s and F₀ = 0.04, a surface of albedo a reflects a A + C:

    A = (1 − m) (E − s (F₀ E + (1 − F₀) E')) + m (G − G'),
    C = (1 − m) s (F₀ G + (1 − F₀) G') + m G'.

R is the same in all directions that are blocked: their mean by the cosine, which bounced light tells. In stills it is
a ratio of two sums over the same rays, of which most noise cancels.
E' is diffuse light times (1 − v·h)⁵. We take E e(μ) for it, which is exact under an even sky.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.device.parallel import split_row

DIELECTRIC_F0 = 0.04  # f₀ of all that is not metal: an index of refraction of 1.5

MIN_BLOCKED_SHARE = 0.02
"""Part of the hemisphere below which it says little of blockers' radiance how much light they send."""

_COST = 10.0  # nanoseconds that a sample takes

wp.set_module_options({"max_unroll": 1})


@wp.kernel
def _sum_lobes(
    first_row: int,
    worker: int,
    # in
    weights: wp.array3d(dtype=wp.vec2),
    light: wp.array3d(dtype=wp.vec3),
    transmittance: wp.array3d(dtype=wp.float32),
    blocked_light: wp.array2d(dtype=wp.vec3),
    mirrored_light: wp.array3d(dtype=wp.vec3),
    # out
    light_f0: wp.array2d(dtype=wp.vec3),
    light_f90: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver: G and G'."""
    batch, receiver = split_row(first_row + wp.tid(), light_f0.shape[1])
    weight_batch = instance_in(batch, weights.shape[0])
    light_batch = instance_in(batch, light.shape[0])
    transmittance_batch = instance_in(batch, transmittance.shape[0])
    blocked_batch = instance_in(batch, blocked_light.shape[0])
    mirrored_batch = instance_in(batch, mirrored_light.shape[0])
    sum_f0 = wp.vec3()
    sum_f90 = wp.vec3()
    for i in range(weights.shape[2]):
        weight = weights[weight_batch, receiver, i]
        open_share = transmittance[transmittance_batch, receiver, i]
        radiance = open_share * light[light_batch, receiver, i]
        if blocked_light:
            radiance += (1.0 - open_share) * blocked_light[blocked_batch, receiver]
        if mirrored_light:
            radiance += mirrored_light[mirrored_batch, receiver, i]
        sum_f0 += weight[0] * radiance
        sum_f90 += weight[1] * radiance
    light_f0[batch, receiver] = sum_f0
    light_f90[batch, receiver] = sum_f90


class LobeLight(NamedTuple):
    """Light in the lobes of receivers, vec3 of shape [batch, receiver]."""

    light_f0: wp.array  # G
    light_f90: wp.array  # G'


def sum_lobes(
    weights: wp.array,
    light: wp.array,
    transmittance: wp.array,
    blocked_light: wp.array | None = None,
    mirrored_light: wp.array | None = None,
) -> LobeLight:
    """Sum the light of lobes.

    Args:
        weights: Of :func:`.lobes.sample_lobes`, vec2 of shape [batch, receiver, sample].
        light: Radiance from the samples, vec3 of shape [batch, receiver, sample].
        transmittance: Float32 of shape [batch, receiver, sample].
        blocked_light: R, of :func:`find_blocked_radiance`, vec3 of shape [batch, receiver]; None where light does not
            bounce.
        mirrored_light: M, of :func:`.mirrored.mix_mirrored`, vec3 of shape [batch, receiver, sample]; None for none.

    Differentiable: all.
    """
    arrays = {"weights": weights, "light": light, "transmittance": transmittance}
    arrays |= {"blocked_light": blocked_light, "mirrored_light": mirrored_light}
    count = common_batch(arrays)
    sums = [wp.empty((count, weights.shape[1]), dtype=wp.vec3, device=weights.device) for _ in range(2)]
    launch(
        _sum_lobes,
        count * weights.shape[1],
        inputs=[*arrays.values()],
        outputs=sums,
        shared=[array for array in arrays.values() if array is not None and len(array) < count],
        cost=_COST * weights.shape[2],
    )
    return LobeLight(*sums)


@wp.kernel
def _find_blocked_radiance(
    # in
    bounced_light: wp.array2d(dtype=wp.vec3),
    direct: wp.array2d(dtype=wp.vec3),
    openness: wp.array2d(dtype=wp.vec3),
    # out
    blocked_light: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver."""
    batch, receiver = wp.tid()
    light = bounced_light[instance_in(batch, bounced_light.shape[0]), receiver]
    indirect_light = light - direct[instance_in(batch, direct.shape[0]), receiver]
    blocked_share = 1.0 - openness[instance_in(batch, openness.shape[0]), receiver][0]
    blocked_light[batch, receiver] = wp.max(indirect_light, wp.vec3()) / wp.max(blocked_share, MIN_BLOCKED_SHARE)


def find_blocked_radiance(bounced_light: wp.array, direct: wp.array, openness: wp.array) -> wp.array:
    """Mean radiance of all that blocks a receiver's light, (E − S) / (1 − O).

    Args:
        bounced_light: E, light that receivers would reflect as white diffuse surfaces, with bounces; vec3 [batch,
            receiver].
        direct: S, the same without bounces.
        openness: O, the same under an even sky of 1 without bounces; best found by the rays that found E − S.

    Returns:
        Vec3 of shape [batch, receiver].

    Differentiable: all.
    """
    count = common_batch({"bounced_light": bounced_light, "direct": direct, "openness": openness})
    blocked_light = wp.empty((count, bounced_light.shape[1]), dtype=wp.vec3, device=bounced_light.device)
    launch(
        _find_blocked_radiance, blocked_light.shape, inputs=[bounced_light, direct, openness], outputs=[blocked_light]
    )
    return blocked_light


@functools.cache
def even_grazing() -> wp.vec3:
    """Coefficients of e(μ) = c₀ + c₁ (1 − μ)² + c₂ (1 − μ)⁴, fitted to ∫ (1 − v·h)⁵ max(n·l, 0) dω / π."""
    count = 64
    z = (np.arange(count) + 0.5) / count
    azimuth = 2 * np.pi * (np.arange(2 * count) + 0.5) / (2 * count)
    sine = np.sqrt(1 - z**2)
    cosines = np.linspace(0, 1, 33)
    cosine_products = cosines[:, None, None] * z[:, None] + np.sqrt(1 - cosines**2)[:, None, None] * np.outer(
        sine, np.cos(azimuth)
    )
    values = (2 * z[:, None] * (1 - np.sqrt(np.maximum((1 + cosine_products) / 2, 0))) ** 5).mean(axis=(1, 2))
    powers = np.stack([np.ones_like(cosines), (1 - cosines) ** 2, (1 - cosines) ** 4], axis=1)
    return wp.vec3(*np.linalg.lstsq(powers, values, rcond=None)[0].tolist())


@wp.kernel
def _mix_reflection(
    # in
    receiver_indices: wp.array(dtype=wp.int32),
    diffuse: wp.array2d(dtype=wp.vec3),
    light_f0: wp.array2d(dtype=wp.vec3),
    light_f90: wp.array2d(dtype=wp.vec3),
    cosines: wp.array2d(dtype=wp.float32),
    metallic: wp.array2d(dtype=wp.float32),
    specular: wp.array2d(dtype=wp.float32),
    even_coefficients: wp.vec3,
    # out
    colored_reflection: wp.array2d(dtype=wp.vec3),
    white: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver of any body."""
    batch, receiver = wp.tid()
    receiver_index = receiver_indices[receiver]
    light = diffuse[instance_in(batch, diffuse.shape[0]), receiver]
    if receiver_index < 0:
        colored_reflection[batch, receiver] = light
        white[batch, receiver] = wp.vec3()
    else:
        lobe_f0 = light_f0[instance_in(batch, light_f0.shape[0]), receiver_index]
        lobe_f90 = light_f90[instance_in(batch, light_f90.shape[0]), receiver_index]
        m = metallic[instance_in(batch, metallic.shape[0]), receiver_index]
        s = specular[instance_in(batch, specular.shape[0]), receiver_index]
        complement = 1.0 - cosines[instance_in(batch, cosines.shape[0]), receiver_index]
        complement = complement * complement
        reflectance = DIELECTRIC_F0 + (1.0 - DIELECTRIC_F0) * (
            even_coefficients[0] + complement * (even_coefficients[1] + complement * even_coefficients[2])
        )
        colored_reflection[batch, receiver] = (1.0 - m) * (1.0 - s * reflectance) * light + m * (lobe_f0 - lobe_f90)
        white[batch, receiver] = (1.0 - m) * s * (
            DIELECTRIC_F0 * lobe_f0 + (1.0 - DIELECTRIC_F0) * lobe_f90
        ) + m * lobe_f90


@wp.kernel(enable_backward=False)
def _count_from(
    # in
    first: int,
    # out
    numbers: wp.array(dtype=wp.int32),
):
    """A thread owns an item."""
    numbers[wp.tid()] = first + wp.tid()


def number_runs(count: int, runs: Sequence[tuple[int, int]], device: wp.DeviceLike) -> wp.array:
    """Number the items of runs, one run after another; −1 for other items.

    It is done on the device: where samples are receivers, the runs of a graph are other ones than before its capture.

    Args:
        count: Number of items.
        runs: Begin and end of each run.

    Returns:
        int32 of shape [item].
    """
    numbers = empty(count, dtype=wp.int32, device=device)
    numbers.fill_(-1)
    first = 0
    for begin, end in runs:
        launch(_count_from, end - begin, inputs=[first], outputs=[numbers[begin:end]])
        first += end - begin
    return numbers


class ReflectedLight(NamedTuple):
    """Light that receivers reflect, vec3 of shape [batch, receiver]; E and 0 of diffuse ones."""

    colored: wp.array  # A, in the color of the surface
    white: wp.array  # C


def mix_reflection(
    receiver_indices: wp.array,
    diffuse: wp.array,
    light_f0: wp.array,
    light_f90: wp.array,
    cosines: wp.array,
    metallic: wp.array,
    specular: wp.array,
) -> ReflectedLight:
    """Mix diffuse and glossy light.

    Args:
        receiver_indices: Of each receiver among the glossy ones, −1 for diffuse ones, int32 of shape [receiver].
        diffuse: E, light that receivers would reflect as white diffuse surfaces, vec3 of shape [batch, receiver].
        light_f0, light_f90: G and G' of the glossy ones, vec3 of shape [batch, glossy].
        cosines: μ of them, float32 of shape [batch, glossy].
        metallic, specular: m and s of them, float32 of shape [batch, glossy].

    Differentiable: all but receiver_indices.
    """
    check.shape("receiver_indices", receiver_indices.shape, diffuse.shape[1:])
    arrays = {"diffuse": diffuse, "gloss": light_f0, "cosines": cosines, "metallic": metallic, "specular": specular}
    shape = common_batch(arrays), diffuse.shape[1]
    reflected = ReflectedLight(*(wp.empty(shape, dtype=wp.vec3, device=diffuse.device) for _ in range(2)))
    inputs = [receiver_indices, diffuse, light_f0, light_f90, cosines, metallic, specular, even_grazing()]
    launch(_mix_reflection, shape, inputs=inputs, outputs=[*reflected])
    return reflected
