"""Own light: what a rigid body's patches send to the body itself, by form factors that are found once."""

import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.launch import launch
from warpshadow.stages.interpolate import at_point
from warpshadow.stages.sparse import SparseMatrix, multiply


@wp.kernel
def _mix_sites(
    # in
    site_light: wp.array2d(dtype=wp.vec3),
    rows: wp.array2d(dtype=wp.vec3i),
    weights: wp.array2d(dtype=wp.vec3),
    # out
    light: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a receiver of an instance."""
    batch, receiver = wp.tid()
    lit = instance_in(batch, site_light.shape[0])
    placed = instance_in(batch, rows.shape[0])
    light[batch, receiver] = at_point(site_light[lit], rows[placed, receiver], weights[placed, receiver])


def own_light(factors: SparseMatrix, radiosity: wp.array, rows: wp.array, weights: wp.array) -> wp.array:
    """Light that receivers of a body get from the body itself; it does not depend on the pose.

        I_x = Σ_k w_xk Σ_p F_(row k of x)p B_p

    Args:
        factors: F of the body's sites, of shape [site, patch], as :func:`.factors.trace_factors` traces it.
        radiosity: Of the body's patches, vec3 of shape [batch, patch].
        rows: Sites around each receiver, vec3i of shape [batch, receiver].
        weights: What each of them weighs, vec3 of shape [batch, receiver].

    Returns:
        What a white receiver reflects of it, vec3 of shape [batch, receiver].

    Differentiable: radiosity, weights. Not: factors, rows.
    """
    check.shape("weights", weights.shape, rows.shape)
    site_light = multiply(factors, radiosity)
    instances = common_batch({"radiosity": radiosity, "rows": rows})
    light = wp.empty((instances, rows.shape[1]), dtype=wp.vec3, device=radiosity.device)
    launch(_mix_sites, light.shape, inputs=[site_light, rows, weights], outputs=[light])
    return light
