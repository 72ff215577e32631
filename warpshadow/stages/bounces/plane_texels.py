"""Texels of planes: the mean radiosity of their patches in mip levels, without patches that other bodies bury.

    B = Σ_p k_p v_p B_p / Σ_p k_p v_p                  [normalized convolution: Knutsson and Westin 1993]

with v the weight of a patch (:mod:`.patch_weights`), and k its share of the mesh in the texel, or 0.002 of that in a
texel beside it: a texel of buried patches alone, as under a box, has the light of those beside it. Otherwise its
darkness would be interpolated to the patches around the box (the foot of a thick wall in the sun was 2.5% too dark).
"""

import warp as wp

from warpshadow.device.batch import common_batch, expand
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.memory import empty
from warpshadow.device.parallel import run_length, split_row
from warpshadow.stages.planes.plane_blockers import PlaneBlockers

_ENTRY_COST = 4.0  # nanoseconds that a patch of a texel takes
_RUN = 32  # texels or patches that a thread owns on a CPU


@wp.kernel(enable_backward=False)
def _find_texels(
    first_row: int,
    worker: int,
    # in
    starts: wp.array(dtype=wp.int32),
    patches: wp.array(dtype=wp.int32),
    mesh_shares: wp.array(dtype=wp.float32),
    radiosity: wp.array2d(dtype=wp.vec3),
    patch_weights: wp.array2d(dtype=wp.vec3),
    run: int,
    # out
    weight_sums: wp.array2d(dtype=wp.float32),
    texels: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a run of texels of an instance; one far off the mesh is black."""
    batch, thread = split_row(first_row + wp.tid(), (texels.shape[1] + run - 1) // run)
    for texel in range(thread * run, wp.min((thread + 1) * run, texels.shape[1])):
        weight_sum = float(0.0)
        radiosity_sum = wp.vec3()
        for entry in range(starts[texel], starts[texel + 1]):
            weight = mesh_shares[entry] * patch_weights[batch, patches[entry]][0]
            weight_sum += weight
            radiosity_sum += weight * radiosity[batch, patches[entry]]
        weight_sums[batch, texel] = weight_sum
        texels[batch, texel] = wp.where(weight_sum > 0.0, radiosity_sum / weight_sum, wp.vec3())


@wp.kernel(enable_backward=False)
def _find_texels_adjoint(
    first_row: int,
    worker: int,
    # in
    starts: wp.array(dtype=wp.int32),
    texel_indices: wp.array(dtype=wp.int32),
    mesh_shares: wp.array(dtype=wp.float32),
    radiosity: wp.array2d(dtype=wp.vec3),
    patch_weights: wp.array2d(dtype=wp.vec3),
    weight_sums: wp.array2d(dtype=wp.float32),
    texels: wp.array2d(dtype=wp.vec3),
    adj_texels: wp.array2d(dtype=wp.vec3),
    run: int,
    # out
    adj_radiosity: wp.array2d(dtype=wp.vec3),
    adj_patch_weights: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a run of patches of an instance.

    With V_t = Σ_p k_tp v_p:  B̄_p += v_p Σ_t k_tp B̄_t / V_t,  v̄_p += Σ_t k_tp B̄_t · (B_p − B_t) / V_t
    """
    batch, thread = split_row(first_row + wp.tid(), (radiosity.shape[1] + run - 1) // run)
    for patch in range(thread * run, wp.min((thread + 1) * run, radiosity.shape[1])):
        adj_sum = wp.vec3()
        adj_weight = float(0.0)
        for entry in range(starts[patch], starts[patch + 1]):
            texel = texel_indices[entry]
            if weight_sums[batch, texel] > 0.0:
                adj = (mesh_shares[entry] / weight_sums[batch, texel]) * adj_texels[batch, texel]
                adj_sum += adj
                adj_weight += wp.dot(adj, radiosity[batch, patch] - texels[batch, texel])
        if adj_radiosity:
            adj_patch = patch_weights[batch, patch][0] * adj_sum
            adj_radiosity[batch, patch] = adj_radiosity[batch, patch] + adj_patch
        if adj_patch_weights:
            adj_patch_weights[batch, patch] = adj_patch_weights[batch, patch] + wp.vec3(adj_weight, 0.0, 0.0)


def find_texels(radiosity: wp.array, patch_weights: wp.array, planes: PlaneBlockers) -> wp.array:
    """Find the radiosity of texels in all mip levels of planes.

    Args:
        radiosity: Of the patches of all bodies, vec3 of shape [batch, patch].
        patch_weights: v of each patch, in three equal channels, vec3 of shape [batch, patch]. Either batch may be 1.
        planes: The planes.
    Returns:
        vec3 of shape [batch, texel].
    Differentiable: radiosity, patch_weights (by the first channel).
    """
    matrix, device = planes.texels_of_patches, radiosity.device
    assert matrix is not None
    (texel_count, patch_count), run = matrix.shape, run_length(device, _RUN)
    count = common_batch({"radiosity": radiosity, "patch_weights": patch_weights})
    radiosity, patch_weights = (expand(array, count) for array in (radiosity, patch_weights))
    weight_sums = empty((count, texel_count), dtype=wp.float32, device=device)
    texels = empty((count, texel_count), dtype=wp.vec3, device=device)
    cost, inputs = _ENTRY_COST * matrix.rows.columns.size, [radiosity, patch_weights]

    def forward(texels: wp.array) -> None:
        launch(
            _find_texels,
            count * -(-texel_count // run),
            inputs=[*matrix.rows, *inputs, run],
            outputs=[weight_sums, texels],
            cost=cost * run / max(texel_count, 1),
        )

    def adjoint(adj_texels: wp.array) -> None:
        launch(
            _find_texels_adjoint,
            count * -(-patch_count // run),
            inputs=[*matrix.columns, *inputs, weight_sums, texels, adj_texels, run],
            outputs=[radiosity.grad, patch_weights.grad],
            cost=cost * run / max(patch_count, 1),
        )

    return differentiable(forward, adjoint, texels, [radiosity, patch_weights])
