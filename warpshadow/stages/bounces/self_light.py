"""Self light: light from a rigid body's patches to the body itself, by form factors that are computed once."""

import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.stages.raster.interpolation import interpolate_at
from warpshadow.stages.sparse import SparseMatrix, multiply


@wp.kernel
def _interpolate_probes(
    # in
    probe_light: wp.array2d(dtype=wp.vec3),
    probe_indices: wp.array2d(dtype=wp.vec3i),
    weights: wp.array2d(dtype=wp.vec3),
    addend: wp.array2d(dtype=wp.vec3),
    # out
    light: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver of an instance."""
    batch, receiver = wp.tid()
    light_batch = instance_in(batch, probe_light.shape[0])
    probe_batch = instance_in(batch, probe_indices.shape[0])
    receiver_light = interpolate_at(
        probe_light[light_batch], probe_indices[probe_batch, receiver], weights[probe_batch, receiver]
    )
    if addend:
        receiver_light += addend[instance_in(batch, addend.shape[0]), receiver]
    light[batch, receiver] = receiver_light


def self_light(
    form_factors: SparseMatrix,
    radiosity: wp.array,
    probe_indices: wp.array,
    weights: wp.array,
    addend: wp.array | None = None,
) -> wp.array:
    """Light that receivers of a body get from the body itself, added to other light; it does not depend on the pose.

        I_x = c_x + Σ_k w_xk Σ_p F_(row k of x)p B_p

    Args:
        form_factors: F of the body's probes, of shape [probe, patch], as :func:`.form_factors.trace_form_factors`
            traces it.
        radiosity: Of the body's patches, vec3 of shape [batch, patch].
        probe_indices: Probes around each receiver, vec3i of shape [batch, receiver].
        weights: Their weights, vec3 of shape [batch, receiver].
        addend: c, vec3 of shape [batch, receiver]; None for 0.
    Returns:
        Light that a white receiver reflects of it, vec3 of shape [batch, receiver].
    Differentiable: radiosity, weights, addend. Not: form_factors, probe_indices.
    """
    check.shape("weights", weights.shape, probe_indices.shape)
    probe_light = multiply(form_factors, radiosity)
    batch_count = common_batch({"radiosity": radiosity, "probe_indices": probe_indices, "addend": addend})
    light = empty((batch_count, probe_indices.shape[1]), dtype=wp.vec3, device=radiosity.device)
    launch(_interpolate_probes, light.shape, inputs=[probe_light, probe_indices, weights, addend], outputs=[light])
    return light
