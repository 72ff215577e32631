"""Fronts: which side of a flat sources of bounced light are on.

A body that touches a ground, or has sunk into it a little, has sources on its surface at the ground and below. What
lies below gets the light of the ground's back: that of the sky there. But receivers do not see the sources, they see
the spheres that stand in for them. So a source is on the side of a flat on which its sphere is:

    front = S(1.25 (h + c) / r)

h and c are the heights of the source and of its sphere's center, r is the sphere's radius, and S is the smoothstep of
:mod:`.cells`. A sphere that touches a flat from above has all its sources in front, and one that touches it from below,
behind; 1.25 leaves room for spheres that bulge out of their mesh. So what a source gets changes over the depth of a
sphere. With the margin of other receivers, a tenth of a texel, it jumped: the gradient of a ball that touches a ground
held for steps of 1/5000 of its radius.
"""

from __future__ import annotations

from typing import NamedTuple

import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.launch import launch
from warpshadow.stages.flats.cells import front_presence, step
from warpshadow.stages.flats.prepared import FlatGrid, Flats

_ROOM = wp.constant(1.25)
"""A source is wholly in front of a flat where its height and its sphere's add up to 1/1.25 of the sphere's radius."""

_TINY = wp.constant(1.0e-18)
"""Radius up to which a sphere stands in for nothing."""


class SpheresOfPoints(NamedTuple):
    """Spheres that stand in for points."""

    centers: wp.array  # [batch, sphere] vec3
    radii: wp.array  # [batch, sphere] float32
    numbers: wp.array  # [point] int32, the sphere of each; −1 for none

    def part(self, part: slice) -> SpheresOfPoints:
        """The same of some points."""
        return self._replace(numbers=self.numbers[part])


@wp.kernel
def _find_fronts(
    # in
    points: wp.array2d(dtype=wp.vec3),
    centers: wp.array2d(dtype=wp.vec3),
    radii: wp.array2d(dtype=wp.float32),
    numbers: wp.array(dtype=wp.int32),
    frames: wp.array2d(dtype=wp.vec3),
    grids: wp.array(dtype=FlatGrid),
    # out
    fronts: wp.array3d(dtype=wp.float32),
):
    """A thread owns a point of an instance and a flat."""
    batch, receiver, f = wp.tid()
    of_flats = instance_in(batch, frames.shape[0])
    origin = frames[of_flats, 3 * f]
    along = frames[of_flats, 3 * f + 1]
    up = wp.normalize(wp.cross(along, frames[of_flats, 3 * f + 2]))
    height = wp.dot(points[instance_in(batch, points.shape[0]), receiver] - origin, up)
    number = numbers[receiver]
    radius = float(0.0)
    middle = float(0.0)
    if number >= 0:
        radius = radii[instance_in(batch, radii.shape[0]), number]
        middle = wp.dot(centers[instance_in(batch, centers.shape[0]), number] - origin, up)
    front = float(0.0)
    if radius > _TINY:
        if _ROOM * wp.abs(height + middle) < radius:
            front = step(_ROOM * (height + middle) / radius)
        else:
            front = wp.where(height + middle > 0.0, 1.0, 0.0)
    elif wp.length_sq(along) > 0.0:
        front = front_presence(grids[f], height / wp.length(along))
    fronts[batch, receiver, f] = front


def find_fronts(points: wp.array, spheres: SpheresOfPoints, frames: wp.array, flats: Flats) -> wp.array:
    """Part of the front of each flat that sources of light see; of the back they see the rest.

    Args:
        points: The sources [scene units], vec3 of shape [batch, receiver].
        spheres: What stands in for them. Points without a sphere see what others do, by their own heights.
        frames: Where the flats are, vec3 of shape [batch, 3 · flat], from :meth:`.Flats.frames`. Any batch may be 1.
        flats: The flats.

    Returns:
        Float32 of shape [batch, receiver, flat], 0 to 1.

    Differentiable: points, centers and radii of spheres, frames.
    """
    centers, radii, numbers = spheres
    check.shape("numbers", numbers.shape, (points.shape[1],))
    check.shape("frames", frames.shape, ("batch", 3 * flats.count))
    count = common_batch({"points": points, "centers": centers, "radii": radii, "frames": frames})
    fronts = wp.empty((count, points.shape[1], flats.count), dtype=wp.float32, device=points.device)
    launch(_find_fronts, fronts.shape, inputs=[points, *spheres, frames, flats.grids], outputs=[fronts])
    return fronts
