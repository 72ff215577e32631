"""Poses: points and spheres of bodies, moved from their own space into the world."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.array_checks import finite_arrays, look_at_values
from warpshadow.device.batch import common_batch, expand, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.stages.geometry.rotations import check_orthonormal


@wp.func
def _posed(rotation: wp.mat33, translation: wp.vec3, scale: float, rest: wp.vec3):
    """The point S R x + t."""
    return scale * (rotation * rest) + translation


@wp.kernel
def _pose(
    # in
    rest: wp.array2d(dtype=wp.vec3),
    bodies: wp.array(dtype=wp.int32),
    rest_centers: wp.array2d(dtype=wp.vec3),
    rest_radii: wp.array2d(dtype=wp.float32),
    sphere_bodies: wp.array(dtype=wp.int32),
    rotations: wp.array2d(dtype=wp.mat33),
    translations: wp.array2d(dtype=wp.vec3),
    scales: wp.array2d(dtype=wp.float32),
    # out
    posed: wp.array2d(dtype=wp.vec3),
    centers: wp.array2d(dtype=wp.vec3),
    radii: wp.array2d(dtype=wp.float32),
):
    """A thread owns a point of an instance, or one of the spheres that follow; the two may differ in their batch."""
    batch, item = wp.tid()
    pose_batch = instance_in(batch, scales.shape[0])
    sphere = item - bodies.shape[0]
    if sphere < 0 and batch < posed.shape[0]:
        body = bodies[item]
        posed[batch, item] = _posed(
            rotations[pose_batch, body],
            translations[pose_batch, body],
            scales[pose_batch, body],
            rest[instance_in(batch, rest.shape[0]), item],
        )
    if sphere >= 0 and batch < radii.shape[0]:
        body = sphere_bodies[sphere]
        centers[batch, sphere] = _posed(
            rotations[pose_batch, body],
            translations[pose_batch, body],
            scales[pose_batch, body],
            rest_centers[instance_in(batch, rest_centers.shape[0]), sphere],
        )
        radii[batch, sphere] = scales[pose_batch, body] * rest_radii[instance_in(batch, rest_radii.shape[0]), sphere]


@wp.kernel
def _compose_rotations(
    # in
    rest: wp.array2d(dtype=wp.mat33),
    rotations: wp.array2d(dtype=wp.mat33),
    # out
    rotated: wp.array2d(dtype=wp.mat33),
):
    """A thread owns a body of an instance."""
    batch, body = wp.tid()
    rest_value = rest[instance_in(batch, rest.shape[0]), body]
    rotated[batch, body] = rotations[instance_in(batch, rotations.shape[0]), body] * rest_value


@wp.kernel
def _move_pivots(
    # in
    pivots: wp.array2d(dtype=wp.vec3),
    rotations: wp.array2d(dtype=wp.mat33),
    translations: wp.array2d(dtype=wp.vec3),
    scales: wp.array2d(dtype=wp.float32),
    sign: float,
    # out
    moved_translations: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a body of an instance."""
    batch, body = wp.tid()
    pose_batch = instance_in(batch, scales.shape[0])
    rotated_pivot = rotations[pose_batch, body] * pivots[instance_in(batch, pivots.shape[0]), body]
    moved_translations[batch, body] = translations[pose_batch, body] + sign * scales[pose_batch, body] * rotated_pivot


@dataclass(frozen=True)
class Poses:
    """Similarities x → s R x + t of every body of every instance; they turn it about the origin of its own space.

    Args:
        rotations: mat33 of shape [batch, body], from :func:`rotation_matrices`. Entries of RᵀR may differ from the
            identity by 0.05.
        translations: Offsets [scene units], vec3 of shape [batch, body].
        scales: Factors, float32 of shape [batch, body].
    Raises:
        ValueError: where the shapes differ, and for matrices that are no rotations. (Not while a CUDA graph
            is captured, when they cannot be read.)
    """

    rotations: wp.array
    translations: wp.array
    scales: wp.array

    def __post_init__(self) -> None:
        """Validate."""
        check.shape("translations", self.translations.shape, self.rotations.shape)
        check.shape("scales", self.scales.shape, self.rotations.shape)
        look_at_values(self.rotations, lambda values: check_orthonormal(values.astype(np.float64)))

    def about(self, pivots: wp.array) -> "Poses":
        """Poses x → s R (x − pivot) + t: translations t are where pivots go.

        Args:
            pivots: A point of each body in its own space, vec3 of shape [batch, body]; either batch may be 1.
        Differentiable: pivots, rotations, translations, scales.
        """
        return self._shifted(pivots, -1.0)

    def of_pivots(self, pivots: wp.array) -> "Poses":
        """The inverse of :meth:`about`: translations are then where pivots are. Differentiable: as there."""
        return self._shifted(pivots, 1.0)

    def _shifted(self, pivots: wp.array, sign: float) -> "Poses":
        batch_count = common_batch({"pivot": pivots, "scales": self.scales})
        check.shape("pivot", pivots.shape, ("batch", self.scales.shape[1]))
        arrays = {"rotations": self.rotations, "translations": self.translations, "scales": self.scales}
        finite_arrays(arrays | {"pivot": pivots})
        moved_translations = empty((batch_count, pivots.shape[1]), dtype=wp.vec3, device=pivots.device)
        launch(
            _move_pivots,
            moved_translations.shape,
            inputs=[pivots, *arrays.values(), sign],
            outputs=[moved_translations],
        )
        return Poses(expand(self.rotations, batch_count), moved_translations, expand(self.scales, batch_count))

    def points(self, rest: wp.array, bodies: wp.array) -> wp.array:
        """Move points with their bodies.

        Args:
            rest: Vertices at rest [scene units], vec3 of shape [batch, point]; rest or poses may have a batch of 1,
                which then serves every instance of the other.
            bodies: Body of each point, int32 of shape [point].
        Returns:
            vec3 of shape [batch, point].
        Differentiable: rest, rotations, translations, scales.
        """
        return self.placed(rest, bodies, None, None, None)[0]

    def spheres(self, centers: wp.array, radii: wp.array, bodies: wp.array) -> tuple[wp.array, wp.array]:
        """Move spheres with their bodies: centers as points, radii float32 of shape [batch, sphere].

        Differentiable: centers, radii, rotations, translations, scales.
        """
        return self.placed(None, None, centers, radii, bodies)[1:]

    def placed(
        self,
        rest: wp.array | None,
        bodies: wp.array | None,
        centers: wp.array | None,
        radii: wp.array | None,
        sphere_bodies: wp.array | None,
    ) -> tuple[wp.array, wp.array, wp.array]:
        """Move points and spheres at once, arguments of :meth:`points` and :meth:`spheres`, None where there are none.

        Differentiable likewise.
        """
        poses = {"rotations": self.rotations, "translations": self.translations, "scales": self.scales}
        arrays = {"rest": rest, "centers": centers, "radii": radii}
        finite_arrays(arrays | poses, nonnegative=["scales"])
        point_shape, sphere_shape = (0, 0), (0, 0)
        if rest is not None and bodies is not None:
            check.shape("rest", rest.shape, ("batch", bodies.shape[0]))
            point_shape = common_batch({"rest": rest, "scales": self.scales}), bodies.shape[0]
        if centers is not None and radii is not None and sphere_bodies is not None:
            check.shape("centers", centers.shape, ("batch", sphere_bodies.shape[0]))
            check.shape("radii", radii.shape, ("batch", sphere_bodies.shape[0]))
            batch_count = common_batch({"centers": centers, "radii": radii, "scales": self.scales})
            sphere_shape = batch_count, sphere_bodies.shape[0]
        device = self.scales.device
        points, posed_centers = (empty(shape, dtype=wp.vec3, device=device) for shape in (point_shape, sphere_shape))
        posed_radii = empty(sphere_shape, dtype=wp.float32, device=device)
        dim = max(point_shape[0], sphere_shape[0]), point_shape[1] + sphere_shape[1]
        inputs = [rest, bodies, centers, radii, sphere_bodies, *poses.values()]
        launch(_pose, dim, inputs=inputs, outputs=[points, posed_centers, posed_radii])
        return points, posed_centers, posed_radii

    def turned(self, rest: wp.array) -> wp.array:
        """Compose rotations with rotations at rest, mat33 of shape [batch, body]. Differentiable: rest, rotations."""
        batch_count = common_batch({"rest": rest, "rotations": self.rotations})
        rotated = empty((batch_count, rest.shape[1]), dtype=wp.mat33, device=rest.device)
        launch(_compose_rotations, rotated.shape, inputs=[rest, self.rotations], outputs=[rotated])
        return rotated
