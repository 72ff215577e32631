"""Overlays: planes right before other bodies, as a cloth on a table, whose light these send in place of their own.

    B′_p = B_p + c_p (Σ_t k_pt B_t − B_p),  c_p = S(3 − 2 |x_p − Σ_t k_pt x_t| / d_p)

A patch p that texels t of a plane cover, with weights k, sends their mean radiosity as long as it is near them: x_p is
the center of its proxy, d_p, at least its radius, its distance from these texels in the scene as given, and S the
smoothstep from 0 at −1 to 1 at 1. Otherwise receivers before a cloth would see the dark patches that it covers, since
spheres and convex parts block a cell before planes do.
"""

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.stages.sparse import SparseMatrix, multiply


@wp.kernel
def _blend_overlays(
    # in
    radiosity: wp.array2d(dtype=wp.vec3),
    centers: wp.array2d(dtype=wp.vec3),
    overlay_radiosity: wp.array2d(dtype=wp.vec3),
    overlay_centers: wp.array2d(dtype=wp.vec3),
    distances: wp.array(dtype=wp.float32),
    # out
    overlaid: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a patch of an instance."""
    batch, patch = wp.tid()
    patch_radiosity = radiosity[instance_in(batch, radiosity.shape[0]), patch]
    sent_radiosity = patch_radiosity
    if distances[patch] > 0.0:
        center_batch = instance_in(batch, centers.shape[0])
        distance = wp.length(centers[center_batch, patch] - overlay_centers[center_batch, patch])
        overlay_share = wp.smoothstep(-1.0, 1.0, 3.0 - 2.0 * distance / distances[patch])
        sent_radiosity = patch_radiosity + overlay_share * (
            overlay_radiosity[instance_in(batch, radiosity.shape[0]), patch] - patch_radiosity
        )
    overlaid[batch, patch] = sent_radiosity


def overlaid_radiosity(
    radiosity: wp.array, centers: wp.array, overlay_weights: SparseMatrix, distances: np.ndarray
) -> wp.array:
    """Radiosity of patches, and of the texels before them where flat bodies cover them.

    Args:
        radiosity: B, vec3 of shape [batch, patch].
        centers: x, of proxies and texels [scene units], vec3 of shape [batch, patch].
        overlay_weights: k, [patch, patch]: weights of the texels before each covered patch, which add up to 1.
        distances: d, 0 for patches that nothing covers, float32 of shape [patch].
    Returns:
        B′, vec3 of shape [batch, patch]. Any batch may be 1.
    Differentiable: radiosity, centers.
    """
    check.shape("centers", centers.shape, ("batch", overlay_weights.shape[0]))
    check.shape("distances", distances.shape, (overlay_weights.shape[0],))
    count = common_batch({"radiosity": radiosity, "centers": centers})
    overlaid = empty((count, overlay_weights.shape[0]), dtype=wp.vec3, device=radiosity.device)
    distance_array = constant(np.asarray(distances, np.float32), wp.float32, radiosity.device)
    arguments = [
        radiosity,
        centers,
        multiply(overlay_weights, radiosity),
        multiply(overlay_weights, centers),
        distance_array,
    ]
    launch(_blend_overlays, overlaid.shape, inputs=arguments, outputs=[overlaid])
    return overlaid
