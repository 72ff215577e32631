"""Interpolate an attribute of the vertices at the samples.

At a point of a face with corners i, j, k and barycentrics w it is a = w₀ a_i + w₁ a_j + w₂ a_k. Its adjoint gives each
corner the part w of the point's gradient ā, and each barycentric ā · a of its corner.
"""

import functools
import math
from typing import Any

import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, reshaped
from warpshadow.device.parallel import run_dimensions, run_length, split_launch
from warpshadow.device.warp_internals import scalar_type
from warpshadow.stages.raster.rasterization import Fragments

_COST = 5.0  # nanoseconds that a sample takes


@wp.func
def interpolate_at(values: wp.array(dtype=Any), corners: wp.vec3i, weights: wp.vec3):
    """A value of the vertices at a point of a face."""
    return weights[0] * values[corners[0]] + weights[1] * values[corners[1]] + weights[2] * values[corners[2]]


@wp.func
def interpolate_values_adjoint(adj_values: wp.array(dtype=Any), corners: wp.vec3i, weights: wp.vec3, adj_point: Any):
    """The adjoint of `interpolate_at` by the values."""
    wp.atomic_add(adj_values, corners[0], weights[0] * adj_point)
    wp.atomic_add(adj_values, corners[1], weights[1] * adj_point)
    wp.atomic_add(adj_values, corners[2], weights[2] * adj_point)


@wp.func
def inner_product(a: float, b: float):
    """Inner product of attributes of any dtype."""
    return a * b


@wp.func  # type: ignore[no-redef]
def inner_product(a: Any, b: Any):  # noqa: F811
    """Inner product of attributes of any dtype."""
    return wp.dot(a, b)


@wp.func
def interpolate_weights_adjoint(values: wp.array(dtype=Any), corners: wp.vec3i, adj_point: Any):
    """The adjoint of `interpolate_at` by the weights."""
    return wp.vec3(
        inner_product(adj_point, values[corners[0]]),
        inner_product(adj_point, values[corners[1]]),
        inner_product(adj_point, values[corners[2]]),
    )


@functools.cache
def _make_interpolate(dtype: type) -> wp.Kernel:
    """Make the kernel for attributes of a dtype."""

    @wp.kernel(module="unique")
    def interpolate(
        first_row: int,
        worker: int,
        # in
        face_ids: wp.array2d(dtype=wp.int32),
        barycentrics: wp.array2d(dtype=wp.vec3),
        faces: wp.array(dtype=wp.vec3i),
        attributes: wp.array2d(dtype=dtype),
        run: int,
        # out
        image: wp.array2d(dtype=dtype),
    ):
        """A thread owns a run of samples of an instance."""
        row, column = wp.tid()
        instance, thread = split_launch(worker, first_row + row, column)
        fragment_batch = instance_in(instance, face_ids.shape[0])
        instance_attributes = attributes[instance_in(instance, attributes.shape[0])]
        for sample in range(thread * run, (thread + 1) * run):
            face = face_ids[fragment_batch, sample]
            if face >= 0:
                image[instance, sample] = interpolate_at(
                    instance_attributes, faces[face], barycentrics[fragment_batch, sample]
                )
            else:
                image[instance, sample] = dtype(0.0)

    return interpolate


def interpolate(fragments: Fragments, faces: wp.array, attributes: wp.array) -> wp.array:
    """Interpolate an attribute of the vertices over the samples, perspective-correct.

    Args:
        faces: Indices of attributes, vec3i, shape [face]: the rasterized faces, or faces of another topology of the
            same mesh (uv_faces), face by face.
        attributes: float32 or a vector of them (vec2, vec3, ...), shape [batch, attribute].
            Either batch may be 1 and then serves every instance of the other.
    Returns:
        Image, dtype of the attributes, shape [batch, height, width], zero where there is no face.
    Differentiable: attributes, barycentrics of the fragments.
    """
    face_ids = fragments.face_ids
    check.shape("attributes", attributes.shape, ("batch", "attribute"))
    batch_count = common_batch({"fragments": face_ids, "attributes": attributes})
    if scalar_type(attributes.dtype) is not wp.float32:
        raise ValueError(f"attributes: got dtype {attributes.dtype.__name__}, expected float32 or a vector of them")
    device, width = face_ids.device, face_ids.shape[2]
    run = run_length(device, width)
    sample_count = math.prod(face_ids.shape[1:])
    image = empty((batch_count, sample_count), dtype=attributes.dtype, device=device)
    launch(
        _make_interpolate(attributes.dtype),
        run_dimensions(device, sample_count // run, batch_count),
        cost=_COST * run,
        inputs=[*fragments.rows, faces, attributes, run],
        outputs=[image],
        shared=[attributes],
    )
    return reshaped(image, (batch_count, *face_ids.shape[1:]))
