"""Open sources: how much each source counts in its patch, so that what other bodies bury does not darken the rest.

Where bodies touch or stick in each other, sources of a patch may lie inside another body. These are black, and nobody
sees them. So a source s of patch p counts by how open the hemisphere is that other bodies leave it,

    o_s = (⟨T⟩ + ε) / (⟨T_self⟩ + ε),  ⟨T⟩ = 4/Q Σ_q max(n·ω_q, 0) T_q
    f_s = o_s / Σ_r w_pr o_r

with T the transmittance past all bodies but planes, T_self that past its own, and w the weights of sources in their
patch: the light of a patch is Σ_s w_ps f_s L_s. Seen from outside, parts of a patch count just by how open they are.

Without it, in a pile of bodies that stick in each other direct light on the patches of a ball was 19% too dark, and in
a shelf full of books that on the shelf 14%.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.stages.sparse import SparseMatrix, multiply

_HIDDEN = wp.constant(0.01)  # ε, by which sources count of a patch that is buried wholly


@wp.kernel
def _sum_open(
    # in
    normals: wp.array2d(dtype=wp.vec3),
    transmittance_self: wp.array3d(dtype=wp.float32),
    transmittance_spheres: wp.array3d(dtype=wp.float32),
    directions: wp.array(dtype=wp.vec3),
    # out
    sums: wp.array2d(dtype=wp.vec2),
):
    """A thread owns a source of an instance: ⟨T⟩ and ⟨T_self⟩, linear in both as Warp's adjoint needs it."""
    batch, source = wp.tid()
    normal = normals[instance_in(batch, normals.shape[0]), source]
    of_spheres = instance_in(batch, transmittance_spheres.shape[0])
    factor = 4.0 / float(directions.shape[0])
    total = wp.vec2()
    for q in range(directions.shape[0]):
        cosine = factor * wp.max(wp.dot(normal, directions[q]), 0.0)
        of_self = float(1.0)
        if transmittance_self:
            of_self = transmittance_self[instance_in(batch, transmittance_self.shape[0]), source, q]
        total += cosine * wp.vec2(transmittance_spheres[of_spheres, source, q], of_self)
    sums[batch, source] = total


@wp.kernel
def _divide(
    # in
    sums: wp.array2d(dtype=wp.vec2),
    # out
    openness: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a source of an instance: o, in three channels."""
    batch, source = wp.tid()
    part = sums[batch, source]
    openness[batch, source] = wp.vec3((part[0] + _HIDDEN) / (part[1] + _HIDDEN))


def find_openness(
    normals: wp.array, transmittance_self: wp.array | None, transmittance_spheres: wp.array, directions: np.ndarray
) -> wp.array:
    """Part of what a body leaves open of the hemispheres of its sources that other bodies leave open, too.

    Args:
        normals: Of the sources, vec3 of shape [batch, source].
        transmittance_self: T_self, float32 of shape [batch, source, direction]; None for 1.
        transmittance_spheres: T, of the same shape. Any batch may be 1.
        directions: Unit vectors ω of the cells, NumPy of shape [direction, 3].
    Returns:
        o, in three equal channels, vec3 of shape [batch, source].
    Differentiable: normals, transmittance_self, transmittance_spheres.
    """
    shape = "batch", normals.shape[1], len(directions)
    check.shape("transmittance_spheres", transmittance_spheres.shape, shape)
    arrays = {"normals": normals, "transmittance_spheres": transmittance_spheres}
    if transmittance_self is not None:
        check.shape("transmittance_self", transmittance_self.shape, shape)
        arrays["transmittance_self"] = transmittance_self
    count, device = common_batch(arrays), normals.device
    cells = constant(np.asarray(directions, np.float32), wp.vec3, device)
    sums = empty((count, normals.shape[1]), dtype=wp.vec2, device=device)
    openness = empty(sums.shape, dtype=wp.vec3, device=device)
    launch(_sum_open, sums.shape, inputs=[normals, transmittance_self, transmittance_spheres, cells], outputs=[sums])
    launch(_divide, sums.shape, inputs=[sums], outputs=[openness])
    return openness


@wp.kernel
def _share(
    # in
    openness: wp.array2d(dtype=wp.vec3),
    means: wp.array2d(dtype=wp.vec3),
    patch_of_source: wp.array(dtype=wp.int32),
    # out
    shares: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a source of an instance."""
    batch, source = wp.tid()
    shares[batch, source] = wp.cw_div(openness[batch, source], means[batch, patch_of_source[source]])


class Openness(NamedTuple):
    """How open sources and patches are."""

    shares: wp.array  # f, how much each source counts in its patch, vec3 of shape [batch, source]
    of_patches: wp.array  # Σ_s w_ps o_s, vec3 of shape [batch, patch]


def open_shares(openness: wp.array, mean: SparseMatrix, patch_of_source: np.ndarray) -> Openness:
    """How much sources count in their patches, by their openness: 1 on average.

    Args:
        openness: o, positive, vec3 of shape [batch, source].
        mean: The weights w, [patch, source], from :func:`.radiosity.mean_over_sources`.
        patch_of_source: The patch of each source, shape [source].
    Returns:
        f, and the openness of patches.
    Differentiable: openness.
    """
    check.shape("patch_of_source", patch_of_source.shape, (openness.shape[1],))
    owners = constant(np.asarray(patch_of_source, np.int32), wp.int32, openness.device)
    shares = empty(openness.shape, dtype=wp.vec3, device=openness.device)
    of_patches = multiply(mean, openness)
    launch(_share, shares.shape, inputs=[openness, of_patches, owners], outputs=[shares])
    return Openness(shares, of_patches)
