"""Self light: light from rigid bodies' patches to each body itself, by form factors that are computed once."""

from collections.abc import Sequence

import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.stages.raster.interpolation import interpolate_at
from warpshadow.stages.receivers.body_spans import (
    ReceiverSpans,
    Span,
    SpanValues,
    receiver_spans,
    span_values,
    value_of_receiver,
)


@wp.kernel
def _interpolate_probes(
    # in
    probe_light: wp.array2d(dtype=wp.vec3),
    spans: ReceiverSpans,
    first_probes: SpanValues,
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
    receiver_light = wp.vec3()
    first_probe = value_of_receiver(first_probes, spans, receiver)
    if first_probe >= 0:
        probes = probe_indices[probe_batch, receiver] + wp.vec3i(first_probe, first_probe, first_probe)
        receiver_light += interpolate_at(probe_light[light_batch], probes, weights[probe_batch, receiver])
    if addend:
        receiver_light += addend[instance_in(batch, addend.shape[0]), receiver]
    light[batch, receiver] = receiver_light


def self_light(
    probe_light: wp.array,
    probe_indices: wp.array,
    weights: wp.array,
    addend: wp.array | None = None,
    *,
    body_spans: Sequence[Span] = (),
    first_probes: Sequence[int] = (0,),
) -> wp.array:
    """Add the light from the receivers' own body, which does not depend on its pose, to other light.

        I_x = c_x + Σ_k w_xk Σ_p F_(row k of x)p B_p

    Args:
        probe_light: F B, vec3 of shape [batch, probe]: form factors of the probes of bodies to their own patches, as
            :func:`.form_factors.trace_form_factors` traces them, times the radiosity of these.
        probe_indices: Probes of its body around each receiver, vec3i of shape [batch, receiver].
        weights: Their weights, vec3 of shape [batch, receiver].
        addend: c, vec3 of shape [batch, receiver]; None for 0.
        body_spans: Of the receivers, by body; () for one of all.
        first_probes: Where the probes of each span's body begin; −1 for a body that sends itself nothing.
    Returns:
        Light that a white receiver reflects of it, vec3 of shape [batch, receiver].
    Differentiable: probe_light, weights, addend. Not: probe_indices.
    """
    check.shape("weights", weights.shape, probe_indices.shape)
    batch_count = common_batch({"probe_light": probe_light, "probe_indices": probe_indices, "addend": addend})
    receiver_count, device = probe_indices.shape[1], probe_light.device
    light = empty((batch_count, receiver_count), dtype=wp.vec3, device=device)
    spans = receiver_spans(body_spans, receiver_count, 1, device)
    inputs = [probe_light, spans, span_values(first_probes, device), probe_indices, weights, addend]
    launch(_interpolate_probes, light.shape, inputs=inputs, outputs=[light])
    return light
