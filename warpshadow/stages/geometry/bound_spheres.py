"""Bound spheres: they follow the vertices around them, as points in a lattice do.

A center moves by the weighted mean of how its vertices move, and a radius grows as their distances from the center do:

    c' = c + Σ w_v (x'_v − x_v)        r' = r (Σ a_v |x'_v − c'|² / Σ a_v |x_v − c|²)^½

where a_v falls off with the distance, and w are the moving least squares weights of it (Σ w_v = 1, Σ w_v x_v = c;
Schaefer et al. 2006): so centers follow any affine map, rotations and stretches among them, as if they were its points,
to within the ridge that keeps weights small (Σ w_v x_v is c to 0.2% of the distances).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpshadow.device.array_checks import finite_arrays
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty

_BINDING_RADIUS = 2.0  # a sphere follows vertices within so many radii, or distances of the nearest one if that is more
_MIN_VERTICES = 12  # and this many at least, or all
_RIDGE = 1e-3  # of the spread of its vertices: where they lie in a plane, weights stay small
_SPREAD_SOFTENING = 1e-6  # squares of radii by which spreads differ from 0, where a root has no derivative


@wp.kernel
def _move_centers(
    # in
    item_starts: wp.array(dtype=wp.int32),
    vertices: wp.array(dtype=wp.int32),
    weights: wp.array(dtype=wp.float32),
    positions: wp.array2d(dtype=wp.vec3),
    rest_positions: wp.array2d(dtype=wp.vec3),
    rest_centers: wp.array2d(dtype=wp.vec3),
    # out
    centers: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a sphere of an instance."""
    instance, sphere = wp.tid()
    position_batch = instance_in(instance, positions.shape[0])
    rest_batch = instance_in(instance, rest_positions.shape[0])
    shift = wp.vec3()
    for item in range(item_starts[sphere], item_starts[sphere + 1]):
        vertex = vertices[item]
        shift += weights[item] * (positions[position_batch, vertex] - rest_positions[rest_batch, vertex])
    centers[instance, sphere] = rest_centers[instance_in(instance, rest_centers.shape[0]), sphere] + shift


@wp.kernel
def _sum_spreads(
    # in
    item_starts: wp.array(dtype=wp.int32),
    vertices: wp.array(dtype=wp.int32),
    spread_weights: wp.array(dtype=wp.float32),
    positions: wp.array2d(dtype=wp.vec3),
    centers: wp.array2d(dtype=wp.vec3),
    # out
    spreads: wp.array2d(dtype=wp.float32),
):
    """A thread owns a sphere of an instance: the mean square distance of its vertices."""
    instance, sphere = wp.tid()
    position_batch = instance_in(instance, positions.shape[0])
    center = centers[instance_in(instance, centers.shape[0]), sphere]
    total = float(0.0)
    for item in range(item_starts[sphere], item_starts[sphere + 1]):
        total += spread_weights[item] * wp.length_sq(positions[position_batch, vertices[item]] - center)
    spreads[instance, sphere] = total


@wp.kernel
def _grow_radii(
    # in
    rest_radii: wp.array2d(dtype=wp.float32),
    rest_spreads: wp.array2d(dtype=wp.float32),
    spreads: wp.array2d(dtype=wp.float32),
    softening: float,
    # out
    radii: wp.array2d(dtype=wp.float32),
):
    """A thread owns a sphere of an instance."""
    instance, sphere = wp.tid()
    radius = rest_radii[instance_in(instance, rest_radii.shape[0]), sphere]
    regularizer = softening * radius * radius
    rest_spread = rest_spreads[instance_in(instance, rest_spreads.shape[0]), sphere]
    radii[instance, sphere] = radius * wp.sqrt((spreads[instance, sphere] + regularizer) / (rest_spread + regularizer))


@dataclass(frozen=True)
class SphereBinding:
    """Spheres bound to the vertices around them."""

    item_starts: wp.array  # where the items of each sphere begin, and the end of the last, int32 of shape [sphere + 1]
    vertices: wp.array  # of each item, int32 of shape [item]
    weights: wp.array  # w, by which centers follow, float32 of shape [item]
    spread_weights: wp.array  # a, whose sum is 1 for each sphere, float32 of shape [item]

    @staticmethod
    def bind(
        points: np.ndarray, vertices: np.ndarray, centers: np.ndarray, radii: np.ndarray, *, device: wp.DeviceLike
    ) -> SphereBinding:
        """Bind spheres to vertices at rest.

        Args:
            points: Vertices [scene units], shape [vertex, 3].
            vertices: The candidates that spheres may follow, shape [candidate].
            centers, radii: Spheres [scene units], shapes [sphere, 3] and [sphere].
        """
        from scipy.spatial import cKDTree

        candidate_positions = points[vertices].astype(np.float64)
        tree = cKDTree(candidate_positions)
        distances = tree.query(centers, k=min(_MIN_VERTICES, len(candidate_positions)))[0].reshape(len(centers), -1)
        binding_radii = np.maximum(_BINDING_RADIUS * np.maximum(distances[:, 0], radii), 1.1 * distances[:, -1])
        bound_items = tree.query_ball_point(centers, binding_radii, return_sorted=True)
        rows = [
            _weights(candidate_positions[bound_vertices], *sphere)
            for bound_vertices, *sphere in zip(bound_items, centers, binding_radii, strict=True)
        ]
        weights, spread_weights = (np.concatenate(column) for column in zip(*rows, strict=True))
        return SphereBinding(
            wp.array(np.cumsum([0, *map(len, bound_items)]), dtype=wp.int32, device=device),
            wp.array(vertices[np.concatenate(bound_items)], dtype=wp.int32, device=device),
            wp.array(weights, dtype=wp.float32, device=device),
            wp.array(spread_weights, dtype=wp.float32, device=device),
        )

    def moved(
        self, positions: wp.array, rest_positions: wp.array, rest_centers: wp.array, rest_radii: wp.array
    ) -> tuple[wp.array, wp.array]:
        """Spheres that follow vertices from one place to another.

        Args:
            positions: Where the vertices go [scene units], vec3 of shape [batch, vertex].
            rest_positions: Where they come from, vec3 of shape [batch, vertex].
            rest_centers: The spheres there [scene units], vec3 of shape [batch, sphere].
            rest_radii: Their radii [scene units], float32 of shape [batch, sphere].
                Batches of 1 serve every instance of the others.
        Returns:
            Centers, vec3 of shape [batch, sphere], and radii, float32 of shape [batch, sphere].
        Differentiable: all.
        """
        arguments = {"positions": positions, "rest": rest_positions, "centers": rest_centers, "radii": rest_radii}
        finite_arrays(arguments)
        shape, device = (common_batch(arguments), len(self.item_starts) - 1), positions.device
        binding = [self.item_starts, self.vertices]
        centers = empty(shape, dtype=wp.vec3, device=device)
        inputs = [*binding, self.weights, positions, rest_positions, rest_centers]
        launch(_move_centers, shape, inputs=inputs, outputs=[centers])
        rest_spreads = self._spreads(rest_positions, rest_centers)
        radii = empty(shape, dtype=wp.float32, device=device)
        inputs = [rest_radii, rest_spreads, self._spreads(positions, centers), _SPREAD_SOFTENING]
        launch(_grow_radii, shape, inputs=inputs, outputs=[radii])
        return centers, radii

    def _spreads(self, positions: wp.array, centers: wp.array) -> wp.array:
        """Mean square distances of vertices from centers, float32 of shape [batch, sphere]."""
        shape = max(len(positions), len(centers)), centers.shape[1]
        spreads = empty(shape, dtype=wp.float32, device=positions.device)
        inputs = [self.item_starts, self.vertices, self.spread_weights, positions, centers]
        launch(_sum_spreads, shape, inputs=inputs, outputs=[spreads])
        return spreads


def _weights(
    candidate_positions: np.ndarray, center: np.ndarray, binding_radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Weights w and a of vertices [vertex, 3] around a center."""
    spread_weights = (1.0 - ((candidate_positions - center) ** 2).sum(axis=1) / binding_radius**2).clip(0.0) ** 2
    spread_weights /= spread_weights.sum()
    mean = spread_weights @ candidate_positions
    offsets = candidate_positions - mean
    spread = (spread_weights[:, None] * offsets).T @ offsets
    slopes = np.linalg.solve(spread + (_RIDGE * np.trace(spread) + 1e-30) * np.eye(3), center - mean)
    return spread_weights * (1.0 + offsets @ slopes), spread_weights
