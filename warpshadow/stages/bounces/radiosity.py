"""Radiosity of patches: the light that they reflect of the light at their patch samples."""

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.stages.sparse import SparseMatrix, multiply


def mean_over_patch_samples(
    patches: np.ndarray, weights: np.ndarray, count: int, *, device: wp.DeviceLike
) -> SparseMatrix:
    """The matrix of means of patches over their patch samples.

    Args:
        patches: Patch of each patch sample, shape [patch sample].
        weights: Share of its patch that each patch sample has, shape [patch sample].
        count: Number of patches; one without patch samples has a mean of 0.
    """
    from scipy.sparse import csr_matrix

    entries = (weights, (patches, np.arange(len(patches))))
    return SparseMatrix.from_matrix(csr_matrix(entries, shape=(count, len(patches))), device=device)


@wp.kernel
def _reflect(
    # in
    albedo: wp.array2d(dtype=wp.vec3),
    light: wp.array2d(dtype=wp.vec3),
    # out
    radiosity: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a patch of an instance."""
    batch, patch = wp.tid()
    patch_albedo = albedo[instance_in(batch, albedo.shape[0]), patch]
    radiosity[batch, patch] = wp.cw_mul(patch_albedo, light[instance_in(batch, light.shape[0]), patch])


def patch_radiosity(
    albedo: wp.array,
    light: wp.array,
    mean: SparseMatrix,
    sample_weights: wp.array | None = None,
    addend: wp.array | None = None,
) -> wp.array:
    """Radiosity of patches: albedo times the mean light of their patch samples.

        B_p = c_p + a_p Σ_s w_ps f_s (S_s + I_s)

    A white patch under a radiance of 1 has radiosity 1, as receivers have.

    Args:
        albedo: Mean reflectance of each patch, vec3 of shape [batch, patch].
        light: Light that each patch sample would reflect if it were white, direct and bounced, vec3 of shape [batch,
            patch sample].
        mean: The weights w, from :func:`mean_over_patch_samples`.
        sample_weights: f, how much each patch sample counts, vec3 of shape [batch, patch sample], from
            :func:`.patch_weights.find_patch_weights`; None for 1.
        addend: c, other radiosity of the patches, vec3 of shape [batch, patch]; None for 0.
    Returns:
        vec3 of shape [batch, patch]; any batch may be 1, and then serves every instance.
    Differentiable: albedo, light, sample_weights, addend.
    """
    return multiply(mean, light, addend=addend, row_scales=albedo, column_scales=sample_weights)


def reflect(albedo: wp.array, light: wp.array) -> wp.array:
    """Albedo times light, of patches or points: vec3 of shape [batch, patch]; a batch of 1 serves every instance.

    Differentiable: albedo, light.
    """
    check.shape("albedo", albedo.shape, ("batch", light.shape[1]))
    batch_count = common_batch({"albedo": albedo, "light": light})
    radiosity = empty((batch_count, light.shape[1]), dtype=wp.vec3, device=light.device)
    launch(_reflect, radiosity.shape, inputs=[albedo, light], outputs=[radiosity])
    return radiosity
