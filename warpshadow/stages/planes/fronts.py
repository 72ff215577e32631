"""Fronts: the side of a plane that a receiver is on, from 1 in front of the plane to 0 behind it.

Where bodies touch, a receiver may lie in the plane of another body, where its own height says nothing. Its body tells:

    front = S(b + (1 − b²) n·N + 2 h / m),  b = (u + l) / max(u − l, m), from −1 to 1

h is the receiver's height above the plane, n its normal, N the plane's; the receiver's body lies between the heights l
and u. S is the smoothstep from 0 at −1 to 1 at 1, and m the plane's margin, a thousandth of a texel.

- Body in front of the plane (b = 1), or behind it (b = −1): all its receivers are on that side.
- Body that the plane cuts: the height h of each receiver decides. It has no gradient: over the short margin that would
  be hundreds of times the gradients of other receivers.
- Body in the plane (b = 0, h = 0): its normals decide.

Receivers nearer than 2 k to a plane, k = 5 m, are moved off it, by k at most, before they are lit:

    x + Σ_f (2 front_f − 1) k (1 − (h_f / 2 k)²)² N_f

(On the line where two planes meet a receiver would lie in both, and neither, seen edge-on, would cover the half of the
sky that it hides.)

A patch sample is on the side of the sphere that is nearest to its patch, of radius r, with its center at the height c:

    front = S(1.25 (h + c) / r)

So a sphere on a plane has all its patch samples in front, even if the body has sunk into the ground a little; its light
changes over the depth of a sphere, not of a margin. 1.25 leaves room for spheres that bulge out of their mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.stages.planes.plane_blockers import PlaneBlockers, PlaneGrid
from warpshadow.stages.receivers.body_spans import (
    ReceiverSpans,
    Span,
    SpanValues,
    receiver_spans,
    span_values,
    value_of_receiver,
)

_FRONT_RADIUS_RATIO = wp.constant(1.25)
"""A patch sample is wholly in front of a plane where its height and its sphere's add up to 1/1.25 of the sphere's
radius."""

_LIFT_IN_MARGINS = wp.constant(5.0)  # how far receivers in a plane are lifted off it, in its margins
_MIN_BLOCKER_RADIUS = wp.constant(1.0e-18)  # radius up to which a sphere blocks nothing


class NearestBlockers(NamedTuple):
    """Sphere blockers nearest to the patches of patch samples."""

    centers: wp.array  # [batch, sphere] vec3
    radii: wp.array  # [batch, sphere] float32
    blocker_indices: wp.array  # [point] int32, the sphere of each; −1 for none

    def cut(self, points: slice) -> NearestBlockers:
        """Select some points."""
        return self._replace(blocker_indices=self.blocker_indices[points])


@wp.func
def _height(point: wp.vec3, frames: wp.array2d(dtype=wp.vec3), instance: int, plane: int):
    """Height of a point over a plane that has an area [units of the body]."""
    axis_u = frames[instance, 3 * plane + 1]
    plane_normal = wp.normalize(wp.cross(axis_u, frames[instance, 3 * plane + 2]))
    return wp.dot(point - frames[instance, 3 * plane], plane_normal) / wp.length(axis_u)


@wp.func
def _over_margin(height: float, margin: float):
    """Height in half margins; without a gradient, since over so short a way fronts change by a step."""
    return 2.0 * height / margin


@wp.func_grad(_over_margin)
def _over_margin_adjoint(height: float, margin: float, adj_result: float):
    return


@wp.func
def _find_extremes(corners: wp.array(dtype=wp.vec3), first: int, end: int, axis: wp.vec3):
    """Indices of the lowest and the highest corner along an axis; not differentiable."""
    lowest_corner, highest_corner = int(first), int(first)
    minimum, maximum = float(0.0), float(0.0)
    for corner in range(first + 1, end):
        height = wp.dot(corners[corner] - corners[first], axis)
        if height < minimum:
            lowest_corner, minimum = corner, height
        if height > maximum:
            highest_corner, maximum = corner, height
    return wp.vec2i(lowest_corner, highest_corner)


@wp.func_grad(_find_extremes)
def _find_extremes_adjoint(
    corners: wp.array(dtype=wp.vec3), first: int, end: int, axis: wp.vec3, adj_extremes: wp.vec2i
):
    return


@wp.kernel
def _find_body_sides(
    # in
    corners: wp.array2d(dtype=wp.vec3),
    first_corners: wp.array(dtype=wp.int32),
    frames: wp.array2d(dtype=wp.vec3),
    grids: wp.array(dtype=PlaneGrid),
    # out
    body_sides: wp.array3d(dtype=wp.float32),
):
    """A thread owns an instance, a body and a plane."""
    batch, body, plane = wp.tid()
    frame_batch = instance_in(batch, frames.shape[0])
    axis_u = frames[frame_batch, 3 * plane + 1]
    side_of_body = float(0.0)
    if wp.length_sq(axis_u) > 0.0:
        corner_batch = instance_in(batch, corners.shape[0])
        plane_normal = wp.cross(axis_u, frames[frame_batch, 3 * plane + 2])
        extremes = _find_extremes(corners[corner_batch], first_corners[body], first_corners[body + 1], plane_normal)
        min_height = _height(corners[corner_batch, extremes[0]], frames, frame_batch, plane)
        max_height = _height(corners[corner_batch, extremes[1]], frames, frame_batch, plane)
        side_of_body = wp.clamp(
            (max_height + min_height) / wp.max(max_height - min_height, grids[plane].margin), -1.0, 1.0
        )
    body_sides[batch, body, plane] = side_of_body


def find_body_sides(corners: wp.array, first_corners: np.ndarray, frames: wp.array, planes: PlaneBlockers) -> wp.array:
    """Find the side b of each plane on which each body lies.

    Args:
        corners: Vertices of all bodies that are farthest out [scene units], vec3 of shape [batch, corner].
        first_corners: Where each body's begin, and the end of the last, shape [body + 1].
        frames, planes: As for :func:`find_fronts`.
    Returns:
        Float32 of shape [batch, body, plane], −1 to 1.
    Differentiable: corners, frames.
    """
    check.shape("frames", frames.shape, ("batch", 3 * planes.count))
    shape = common_batch({"corners": corners, "frames": frames}), len(first_corners) - 1, planes.count
    body_sides = empty(shape, dtype=wp.float32, device=corners.device)
    inputs = [corners, constant(first_corners, wp.int32, corners.device), frames, planes.grids]
    launch(_find_body_sides, shape, inputs=inputs, outputs=[body_sides])
    return body_sides


@wp.func
def _front_by_sphere(height: float, center_height: float, radius: float):
    """Front of a patch sample beside a sphere of this height and radius."""
    front = wp.where(height + center_height > 0.0, 1.0, 0.0)
    if _FRONT_RADIUS_RATIO * wp.abs(height + center_height) < radius:
        front = wp.smoothstep(-1.0, 1.0, _FRONT_RADIUS_RATIO * (height + center_height) / radius)
    return front


@wp.func
def _front_by_height(height: float, margin: float, side_of_body: float, facing_cosine: float):
    front = wp.where(height > 0.0, 1.0, 0.0)
    if wp.abs(height) < 2.0 * margin:
        front = wp.smoothstep(
            -1.0, 1.0, side_of_body + (1.0 - side_of_body * side_of_body) * facing_cosine + _over_margin(height, margin)
        )
    return front


@wp.kernel
def _find_fronts(
    # in
    points: wp.array2d(dtype=wp.vec3),
    normals: wp.array2d(dtype=wp.vec3),
    body_sides: wp.array3d(dtype=wp.float32),
    spans: ReceiverSpans,
    body_of_span: SpanValues,
    centers: wp.array2d(dtype=wp.vec3),
    radii: wp.array2d(dtype=wp.float32),
    blocker_indices: wp.array(dtype=wp.int32),
    frames: wp.array2d(dtype=wp.vec3),
    grids: wp.array(dtype=PlaneGrid),
    self_plane: int,
    # out
    front_weights: wp.array3d(dtype=wp.float32),
    lifted_points: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a point of an instance."""
    batch, receiver = wp.tid()
    frame_batch = instance_in(batch, frames.shape[0])
    point = points[instance_in(batch, points.shape[0]), receiver]
    normal = normals[instance_in(batch, normals.shape[0]), receiver]
    blocker_index = int(-1)
    if blocker_indices:
        blocker_index = blocker_indices[receiver]
    radius = float(0.0)
    if blocker_index >= 0:
        radius = radii[instance_in(batch, radii.shape[0]), blocker_index]
    offset = wp.vec3()
    for plane in range(grids.shape[0]):
        axis_u = frames[frame_batch, 3 * plane + 1]
        front = float(0.0)
        if wp.length_sq(axis_u) > 0.0:
            margin = grids[plane].margin
            height = _height(point, frames, frame_batch, plane)
            plane_normal = wp.normalize(wp.cross(axis_u, frames[frame_batch, 3 * plane + 2]))
            if radius / wp.length(axis_u) > _MIN_BLOCKER_RADIUS:
                center = centers[instance_in(batch, centers.shape[0]), blocker_index]
                center_height = _height(center, frames, frame_batch, plane)
                front = _front_by_sphere(height, center_height, radius / wp.length(axis_u))
            else:
                side_of_body = float(1.0)
                if body_sides:
                    body = value_of_receiver(body_of_span, spans, receiver)
                    side_of_body = body_sides[instance_in(batch, body_sides.shape[0]), body, plane]
                front = _front_by_height(height, margin, side_of_body, wp.dot(normal, plane_normal))
            relative_height = height / (2.0 * _LIFT_IN_MARGINS * margin)
            if plane != self_plane and wp.abs(relative_height) < 1.0:
                nearness = 1.0 - relative_height * relative_height
                lift = (2.0 * front - 1.0) * nearness * nearness * _LIFT_IN_MARGINS * margin
                offset += lift * wp.length(axis_u) * plane_normal
        front_weights[batch, receiver, plane] = front
    lifted_points[batch, receiver] = point + offset


class PlaneFronts(NamedTuple):
    """Sides of planes on which receivers are."""

    front_weights: wp.array  # float32 of shape [batch, receiver, plane], from 1 in front of it to 0 behind it
    lifted_points: wp.array  # the receivers, lifted off the planes in which they lie, vec3 of shape [batch, receiver]


def find_fronts(
    points: wp.array,
    normals: wp.array,
    body_sides: wp.array | None,
    spheres: NearestBlockers | None,
    frames: wp.array,
    planes: PlaneBlockers,
    *,
    spans: Sequence[Span] = (),
    self_plane: int | None = None,
) -> PlaneFronts:
    """Weight of each plane's front for each receiver, and receivers lifted off planes in which they lie.

    Args:
        points, normals: Receivers [scene units] and their unit normals, vec3 of shape [batch, receiver].
        body_sides: From :func:`find_body_sides`, float32 of shape [batch, body, plane]. None where it is not known:
            receivers are in front down to the plane itself.
        spheres: The blockers nearest to patch samples; None where no receiver is one.
        frames: Where the planes are, vec3 of shape [batch, 3 · plane], from :meth:`.PlaneBlockers.frames`. Any batch
            may be 1.
        spans: Of the receivers, which know their body; () for those of body 0.
        self_plane: Number of the plane that the receivers are part of, off which none is lifted; None for none.
    Differentiable: points, normals, body_sides, centers and radii of spheres, frames.
    """
    centers, radii, blocker_indices = (None, None, None) if spheres is None else spheres
    check.shape("normals", normals.shape, ("batch", points.shape[1]))
    check.shape("frames", frames.shape, ("batch", 3 * planes.count))
    if blocker_indices is not None:
        check.shape("blocker_indices", blocker_indices.shape, (points.shape[1],))
    arguments = {"points": points, "normals": normals, "centers": centers, "radii": radii, "frames": frames}
    shape = common_batch({**arguments, "body_sides": body_sides}), points.shape[1]
    front_weights = empty((*shape, planes.count), dtype=wp.float32, device=points.device)
    lifted_points = empty(shape, dtype=wp.vec3, device=points.device)
    kernel_spans = receiver_spans(spans, points.shape[1], 1, points.device)
    bodies = span_values([span.body for span in spans] or [0], points.device)
    inputs = [points, normals, body_sides, kernel_spans, bodies, centers, radii, blocker_indices, frames, planes.grids]
    launch(
        _find_fronts,
        shape,
        inputs=[*inputs, -1 if self_plane is None else self_plane],
        outputs=[front_weights, lifted_points],
    )
    return PlaneFronts(front_weights, lifted_points)
