"""Exact occlusion by spheres, ray by ray: the reference for methods that smooth it or limit its bands."""

import warp as wp

from warpshadow import check
from warpshadow.device.lanes import lane_type, vectors_type
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.device.parallel import split_row
from warpshadow.stages.visibility.cones import BLEND, make_cone

_cone = make_cone(1)
_Lane, _Vectors = lane_type(1), vectors_type(1)

_TEST_COST = 2.0  # nanoseconds that a sphere costs for a ray


@wp.kernel(enable_backward=False)
def _exact_occlusion(
    first_row: int,
    worker: int,
    # in
    points: wp.array2d[wp.vec3],
    directions: wp.array[wp.vec3],
    centers: wp.array2d[wp.vec3],
    radii: wp.array2d[float],
    # out
    occlusion: wp.array3d[wp.uint8],
):
    """Each thread owns one ray: a receiver and a direction."""
    row, direction = wp.tid()
    batch, vertex = split_row(first_row + row, points.shape[1])
    is_blocked = wp.uint8(0)
    for sphere in range(radii.shape[1]):
        radius = radii[batch, sphere]
        center_offset = centers[batch, sphere] - points[batch, vertex]
        axial = wp.dot(center_offset, directions[direction])
        if axial > 0.0 and radius > 0.0:
            distance = wp.length(center_offset)
            if distance >= (1.0 + BLEND) * radius:  # the cone is exact, and this test needs no root
                distance2 = wp.length_sq(center_offset - axial * directions[direction])
                if distance2 < radius * radius:
                    is_blocked = wp.uint8(1)
                    break
            else:
                cone = _cone(
                    _Vectors(_Lane(center_offset[0]), _Lane(center_offset[1]), _Lane(center_offset[2])), 1.0 / radius
                )
                if cone.weight[0] > 0.5 and axial > cone.cosine[0] * distance:
                    is_blocked = wp.uint8(1)
                    break
    occlusion[batch, vertex, direction] = is_blocked


def exact_occlusion(points: wp.array, directions: wp.array, centers: wp.array, radii: wp.array) -> wp.array:
    """Test which rays spheres block, without any smoothing: the reference of the approximations.

    For a receiver on or inside a sphere, the rule of warpshadow.stages.visibility.cones holds: the sphere blocks the
    hemisphere around the direction of its center, and nothing if that is nearer than FADE/2 radii.

    Args:
        points: Receiver positions [scene units], vec3, shape [batch, vertex].
        directions: Unit directions toward the light, vec3, shape [direction].
        centers: Sphere centers [scene units], vec3, shape [batch, sphere].
        radii: Sphere radii [scene units], float32, shape [batch, sphere].
    Returns:
        1 where a sphere blocks the ray, else 0; uint8, shape [batch, vertex, direction].
    Raises:
        ValueError: for shapes that do not fit.
    Differentiable: no.
    """
    check.shape("points", points.shape, ("batch", "vertex"))
    check.shape("directions", directions.shape, ("direction",))
    check.shape("centers", centers.shape, (points.shape[0], "sphere"))
    check.shape("radii", radii.shape, centers.shape)
    occlusion = empty(points.shape + directions.shape, dtype=wp.uint8, device=points.device)
    inputs = [points, directions, centers, radii]
    cost = _TEST_COST * max(1, radii.shape[1])
    launch(_exact_occlusion, (points.size, *directions.shape), inputs=inputs, outputs=[occlusion], cost=cost)
    return occlusion
