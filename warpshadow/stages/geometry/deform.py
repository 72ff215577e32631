"""Embedded deformation: nodes that carry the points around them (the paper, section 4)."""

import itertools
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.array_checks import finite_arrays
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, zeros
from warpshadow.device.threads import locked

_SHARED_POINTS_RATIO = 0.02  # points that two neighboring nodes carry together, as a fraction of a node's points


@wp.kernel
def _deform_points(
    # in
    rest: wp.array(dtype=wp.vec3),
    nodes: wp.array2d(dtype=wp.int32),
    weights: wp.array2d(dtype=wp.float32),
    node_positions: wp.array(dtype=wp.vec3),
    matrices: wp.array2d(dtype=wp.mat33),
    translations: wp.array2d(dtype=wp.vec3),
    # out
    deformed: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a point of an instance: the weighted mean of where its nodes would take it."""
    batch, point = wp.tid()
    blended_point = wp.vec3()
    for k in range(nodes.shape[1]):
        node = nodes[point, k]
        center = node_positions[node]
        moved_point = matrices[batch, node] * (rest[point] - center) + center + translations[batch, node]
        blended_point += weights[point, k] * moved_point
    deformed[batch, point] = blended_point


@wp.kernel
def _move_nodes(
    # in
    node_positions: wp.array(dtype=wp.vec3),
    translations: wp.array2d(dtype=wp.vec3),
    # out
    moved_centers: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a node of an instance."""
    batch, node = wp.tid()
    moved_centers[batch, node] = node_positions[node] + translations[batch, node]


@wp.kernel
def _sum_rigidity(
    # in
    node_positions: wp.array(dtype=wp.vec3),
    neighbors: wp.array(dtype=wp.vec2i),
    matrices: wp.array2d(dtype=wp.mat33),
    translations: wp.array2d(dtype=wp.vec3),
    # out
    energy: wp.array(dtype=wp.float32),
):
    """A thread owns a node and one of its neighbors: where the node would take it, against where it goes."""
    batch, pair_index = wp.tid()
    node = neighbors[pair_index][0]
    neighbor = neighbors[pair_index][1]
    edge = node_positions[neighbor] - node_positions[node]
    gap = matrices[batch, node] * edge - edge + translations[batch, node] - translations[batch, neighbor]
    wp.atomic_add(energy, batch, wp.dot(gap, gap))


@wp.kernel
def _sum_shear(
    # in
    matrices: wp.array2d(dtype=wp.mat33),
    # out
    energy: wp.array(dtype=wp.float32),
):
    """A thread owns a node: how far its matrix is from a rotation, |MᵀM − I|²."""
    batch, node = wp.tid()
    m = matrices[batch, node]
    gap = wp.transpose(m) * m - wp.identity(n=3, dtype=wp.float32)
    wp.atomic_add(energy, batch, wp.ddot(gap, gap))


@dataclass(frozen=True)
class DeformationGraph:
    """Nodes that carry the points around them (Sumner et al. 2007; the paper's nodes are its spheres).

    Args:
        node_positions: Nodes at rest [scene units], vec3 of shape [node].
        neighbors: Pairs of nodes next to each other, each pair both ways, vec2i of shape [pair].
        rest: Points at rest [scene units], vec3 of shape [point].
        nodes: The nodes that carry each point, int32 of shape [point, k].
        weights: Their shares, positive with sum 1, float32 of shape [point, k].
    """

    node_positions: wp.array
    neighbors: wp.array
    rest: wp.array
    nodes: wp.array
    weights: wp.array

    @staticmethod
    def bind(
        points: np.ndarray, nodes: np.ndarray, *, count: int = 4, device: wp.DeviceLike = "cpu"
    ) -> "DeformationGraph":
        """Bind points to their nearest nodes, with the weights (1 − d/d_max)² of Sumner et al., section 3.

        Args:
            points: Vertices at rest [scene units], shape [point, 3].
            nodes: Node positions, such as the centers of spheres, shape [node, 3].
            count: Nodes that carry a point; d_max is the distance of the next one. Nodes are neighbors where one is
                among the ``count`` nearest to the other, or where they carry the same points.
        Raises:
            ValueError: when there are too few nodes.
        """
        from scipy.spatial import cKDTree

        points, nodes = np.asarray(points, np.float64), np.asarray(nodes, np.float64)
        for name, values in (("points", points), ("nodes", nodes)):
            check.shape(name, values.shape, (name[:-1], 3))
            check.finite(name, values)
        if not 1 <= count < len(nodes):
            raise ValueError(f"count: got {count!r} for {len(nodes)} nodes, expected 1 to {len(nodes) - 1}")
        tree = cKDTree(nodes)
        distances, nearest = tree.query(points, k=count + 1)
        radius = np.maximum(distances[:, -1:], 1e-30)
        weights = (1 - distances[:, :-1] / radius) ** 2 + 1e-9  # a point as far from all of them is carried by all
        weights /= weights.sum(axis=1, keepdims=True)
        nearest = nearest[:, :-1]
        shared_points = np.zeros((len(nodes), len(nodes)))
        for i, j in itertools.product(range(count), repeat=2):
            np.add.at(shared_points, (nearest[:, i], nearest[:, j]), np.sqrt(weights[:, i] * weights[:, j]))
        are_neighbors = shared_points > _SHARED_POINTS_RATIO * len(points) / len(nodes)
        _, nearest_nodes = tree.query(nodes, k=count + 1)
        are_neighbors[np.arange(len(nodes))[:, None], nearest_nodes] = True
        are_neighbors |= are_neighbors.T
        np.fill_diagonal(are_neighbors, False)
        return DeformationGraph(
            wp.array(nodes, dtype=wp.vec3, device=device),
            wp.array(np.argwhere(are_neighbors), dtype=wp.vec2i, device=device),
            wp.array(points, dtype=wp.vec3, device=device),
            wp.array(nearest.astype(np.int32), device=device),
            wp.array(weights.astype(np.float32), device=device),
        )

    @locked
    def points(self, matrices: wp.array, translations: wp.array) -> wp.array:
        """Deform the bound points.

        Args:
            matrices: Of the nodes, mat33 of shape [batch, node]: rotations, or free matrices with :meth:`shear`.
            translations: Of the nodes [scene units], vec3 of shape [batch, node].
        Returns:
            vec3 of shape [batch, point].
        Differentiable: matrices, translations.
        """
        self._check(matrices, translations)
        inputs = [self.rest, self.nodes, self.weights, self.node_positions, matrices, translations]
        deformed = empty((matrices.shape[0], self.rest.shape[0]), dtype=wp.vec3, device=matrices.device)
        launch(_deform_points, deformed.shape, inputs=inputs, outputs=[deformed])
        return deformed

    @locked
    def centers(self, translations: wp.array) -> wp.array:
        """Displaced positions of the nodes: vec3 of shape [batch, node]. Differentiable: translations."""
        check.shape("translations", translations.shape, ("batch", self.node_positions.shape[0]))
        finite_arrays({"translations": translations})
        moved_centers = wp.empty_like(translations, requires_grad=False)
        launch(_move_nodes, moved_centers.shape, inputs=[self.node_positions, translations], outputs=[moved_centers])
        return moved_centers

    @locked
    def rigidity(self, matrices: wp.array, translations: wp.array) -> wp.array:
        """As-rigid-as-possible energy Σ |M_j (g_k − g_j) + g_j + t_j − (g_k + t_k)|² over neighbors (E_reg of Sumner).

        Returns:
            float32 of shape [batch] [scene units²].
        Differentiable: matrices, translations.
        """
        self._check(matrices, translations)
        inputs = [self.node_positions, self.neighbors, matrices, translations]
        return _sum_energy("matrices, translations", _sum_rigidity, (len(matrices), len(self.neighbors)), inputs)

    @locked
    def shear(self, matrices: wp.array) -> wp.array:
        """Distance of the matrices from rotations, Σ |MᵀM − I|² (as E_rot of Sumner): float32 of shape [batch].

        Differentiable: matrices.
        """
        check.shape("matrices", matrices.shape, ("batch", self.node_positions.shape[0]))
        finite_arrays({"matrices": matrices})
        return _sum_energy("matrices", _sum_shear, matrices.shape, [matrices])

    def _check(self, matrices: wp.array, translations: wp.array) -> None:
        check.shape("matrices", matrices.shape, ("batch", self.node_positions.shape[0]))
        check.shape("translations", translations.shape, matrices.shape)
        finite_arrays({"matrices": matrices, "translations": translations})


def _sum_energy(names: str, kernel: wp.Kernel, dim: tuple[int, ...], inputs: list[wp.array]) -> wp.array:
    """Launch a kernel whose threads add to the energy of their instance; ValueError where that is no float32."""
    energy = zeros(dim[0], dtype=wp.float32, device=inputs[0].device)
    launch(kernel, dim, inputs=inputs, outputs=[energy])
    if not energy.device.is_capturing and not np.isfinite(energy.numpy()).all():
        raise ValueError(f"{names}: got an energy beyond float32's range, expected smaller numbers")
    return energy
