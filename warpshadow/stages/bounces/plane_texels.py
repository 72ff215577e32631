"""Texels of planes: the mean radiosity of their patches in mip levels, without patches that other bodies bury.

    B = Σ_p k_p v_p B_p / Σ_p k_p v_p                  [normalized convolution: Knutsson and Westin 1993]

with v the weight of a patch (:mod:`.patch_weights`), and k its share of the mesh in the texel, or 0.002 of that in a
texel beside it: a texel of buried patches alone, as under a box, has the light of those beside it. Otherwise its
darkness would be interpolated to the patches around the box (the foot of a thick wall in the sun was 2.5% too dark).
"""

import warp as wp

from warpshadow.device.batch import instance_in
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.stages.planes.plane_blockers import PlaneBlockers
from warpshadow.stages.sparse import multiply


@wp.kernel
def _divide(
    # in
    radiosity_sums: wp.array2d(dtype=wp.vec3),
    weight_sums: wp.array2d(dtype=wp.vec3),
    # out
    texels: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a texel of an instance; one far off the mesh is black."""
    batch, texel = wp.tid()
    weight = weight_sums[instance_in(batch, weight_sums.shape[0]), texel][0]
    mean_radiosity = wp.vec3()
    if weight > 0.0:
        mean_radiosity = radiosity_sums[batch, texel] / weight
    texels[batch, texel] = mean_radiosity


def sum_weights(patch_weights: wp.array, planes: PlaneBlockers) -> wp.array:
    """Sum up the weights of the patches of each texel: Σ k v, vec3 of shape [batch, texel]. Differentiable in them."""
    assert planes.texels_of_patches is not None
    return multiply(planes.texels_of_patches, patch_weights)


def find_texels(
    radiosity: wp.array, patch_weights: wp.array, planes: PlaneBlockers, weight_sums: wp.array | None = None
) -> wp.array:
    """Find the radiosity of texels in all mip levels of planes.

    Args:
        radiosity: Of the patches of all bodies, vec3 of shape [batch, patch].
        patch_weights: v of each patch, in three equal channels, vec3 of shape [batch, patch]. Either batch may be 1.
        weight_sums: From :func:`sum_weights`, where they are found already.
    Returns:
        vec3 of shape [batch, texel].
    Differentiable: radiosity, patch_weights, weight_sums.
    """
    assert planes.texels_of_patches is not None
    radiosity_sums = multiply(planes.texels_of_patches, radiosity, column_scales=patch_weights)
    if weight_sums is None:
        weight_sums = sum_weights(patch_weights, planes)
    texels = empty(radiosity_sums.shape, dtype=wp.vec3, device=radiosity.device)
    launch(_divide, radiosity_sums.shape, inputs=[radiosity_sums, weight_sums], outputs=[texels])
    return texels
