"""Poses: points, normals and spheres of bodies, moved from their own space into the world."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch
from warpshadow.device.tape import launch_new
from warpshadow.stages.rotations import _check_orthonormal

# ---------------------------------------------------------------------------------------------- rigid bodies


@wp.kernel
def _pose_points(
    # in
    rest: wp.array2d(dtype=wp.vec3),
    bodies: wp.array(dtype=wp.int32),
    rotations: wp.array2d(dtype=wp.mat33),
    translations: wp.array2d(dtype=wp.vec3),
    scales: wp.array2d(dtype=wp.float32),
    # out
    posed: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a point of an instance."""
    batch, point = wp.tid()
    body = bodies[point]
    pose = wp.min(batch, scales.shape[0] - 1)
    at_rest = rest[wp.min(batch, rest.shape[0] - 1), point]
    posed[batch, point] = scales[pose, body] * (rotations[pose, body] * at_rest) + translations[pose, body]


@wp.kernel
def _pose_radii(
    # in
    rest: wp.array2d(dtype=wp.float32),
    bodies: wp.array(dtype=wp.int32),
    scales: wp.array2d(dtype=wp.float32),
    # out
    posed: wp.array2d(dtype=wp.float32),
):
    """A thread owns a sphere of an instance."""
    batch, sphere = wp.tid()
    scale = scales[wp.min(batch, scales.shape[0] - 1), bodies[sphere]]
    posed[batch, sphere] = scale * rest[wp.min(batch, rest.shape[0] - 1), sphere]


@dataclass(frozen=True)
class Poses:
    """Similarities x → s R x + t of every body of every instance.

    Args:
        rotations: mat33 of shape [batch, body], from :func:`rotation_matrices`. Entries of RᵀR may differ from those of
            the identity by 0.05.
        translations: Offsets [scene units], vec3 of shape [batch, body].
        scales: Factors, float32 of shape [batch, body].

    Raises:
        ValueError: where the shapes differ, and for matrices that are no rotations. (Reading them waits for a GPU.
            While a CUDA graph is captured that cannot be, and nothing is checked.)
    """

    rotations: wp.array
    translations: wp.array
    scales: wp.array

    def __post_init__(self) -> None:
        """Validate."""
        check.shape("translations", self.translations.shape, self.rotations.shape)
        check.shape("scales", self.scales.shape, self.rotations.shape)
        if not self.rotations.device.is_capturing:
            _check_orthonormal(self.rotations.numpy().astype(np.float64))

    def points(self, rest: wp.array, bodies: wp.array) -> wp.array:
        """Move points with their bodies.

        Args:
            rest: Vertices or centers at rest [scene units], vec3 of shape [batch, point]; rest or poses may have a
                batch of 1, which then serves every instance of the other.
            bodies: Body of each point, int32 of shape [point].

        Returns:
            vec3 of shape [batch, point].

        Differentiable: rest, rotations, translations, scales.
        """
        inputs = [rest, bodies, self.rotations, self.translations, self.scales]
        return launch_new(_pose_points, self._shape(rest, bodies), wp.vec3, inputs)

    def radii(self, rest: wp.array, bodies: wp.array) -> wp.array:
        """Scale radii, float32 of shape [batch, sphere], with their bodies. Differentiable: rest, scales."""
        return launch_new(_pose_radii, self._shape(rest, bodies), wp.float32, [rest, bodies, self.scales])

    def _shape(self, rest: wp.array, bodies: wp.array) -> tuple[int, int]:
        """Shape of what moves."""
        check.shape("rest", rest.shape, ("batch", bodies.shape[0]))
        arrays = {"rest": rest, "rotations": self.rotations, "translations": self.translations, "scales": self.scales}
        check.finite_arrays(arrays, nonnegative=["scales"])
        return common_batch({"rest": rest, "scales": self.scales}), bodies.shape[0]
