"""Self light: light from a rigid body's patches to the body itself, by form factors that are computed once."""

import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.stages.interpolation import at_point
from warpshadow.stages.sparse import SparseMatrix, multiply


@wp.kernel
def _mix_probes(
    # in
    probe_light: wp.array2d(dtype=wp.vec3),
    rows: wp.array2d(dtype=wp.vec3i),
    weights: wp.array2d(dtype=wp.vec3),
    # out
    light: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver of an instance."""
    batch, receiver = wp.tid()
    light_batch = instance_in(batch, probe_light.shape[0])
    row_batch = instance_in(batch, rows.shape[0])
    light[batch, receiver] = at_point(probe_light[light_batch], rows[row_batch, receiver], weights[row_batch, receiver])


def self_light(factors: SparseMatrix, radiosity: wp.array, rows: wp.array, weights: wp.array) -> wp.array:
    """Light that receivers of a body get from the body itself; it does not depend on the pose.

        I_x = Σ_k w_xk Σ_p F_(row k of x)p B_p

    Args:
        factors: F of the body's probes, of shape [probe, patch], as :func:`.factors.trace_factors` traces it.
        radiosity: Of the body's patches, vec3 of shape [batch, patch].
        rows: Probes around each receiver, vec3i of shape [batch, receiver].
        weights: Their weights, vec3 of shape [batch, receiver].
    Returns:
        Light that a white receiver reflects of it, vec3 of shape [batch, receiver].
    Differentiable: radiosity, weights. Not: factors, rows.
    """
    check.shape("weights", weights.shape, rows.shape)
    probe_light = multiply(factors, radiosity)
    instances = common_batch({"radiosity": radiosity, "rows": rows})
    light = empty((instances, rows.shape[1]), dtype=wp.vec3, device=radiosity.device)
    launch(_mix_probes, light.shape, inputs=[probe_light, rows, weights], outputs=[light])
    return light
