"""Motion: rigid poses of bodies and embedded deformation, of vertices and spheres together.

Vertices and nodes of a graph at rest have no batch dimension; what moves has one: an instance for every pose.
"""

import itertools
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.batch import common_batch
from warpshadow.nearest_rotation import nearest_rotations
from warpshadow.tape import launch
from warpshadow.threads import one_at_a_time

Vec6 = wp.types.vector(length=6, dtype=wp.float32)

SHORTEST = 1.0e-18
"""Shorter quaternions and columns have no direction: its gradient would be out of float32's range."""

PARALLEL = 1.0e-6
"""Columns at a smaller angle [radians] are parallel: what is between them is rounding."""

NOT_ORTHONORMAL = 0.05
"""Largest entry of |RᵀR − I| of what is taken for a rotation: a step of 0.01 in all nine numbers stays below."""

_SHARED = 0.02  # points that two neighboring nodes carry together, as a part of what a node carries

# ---------------------------------------------------------------------------------------------- rotations


@wp.kernel
def _rotate_by_quaternions(
    # in
    quaternions: wp.array2d(dtype=wp.vec4),
    # out
    rotations: wp.array2d(dtype=wp.mat33),
):
    """A thread owns a rotation."""
    batch, body = wp.tid()
    q = wp.vec4(wp.normalize(wp.vec4d(quaternions[batch, body])))  # whose length squared may not be a float32
    x = q[0]
    y = q[1]
    z = q[2]
    w = q[3]
    rotations[batch, body] = wp.mat33(
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - z * w),
        2.0 * (x * z + y * w),
        2.0 * (x * y + z * w),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - x * w),
        2.0 * (x * z - y * w),
        2.0 * (y * z + x * w),
        1.0 - 2.0 * (x * x + y * y),
    )


@wp.kernel
def _rotate_by_axis_angles(
    # in
    vectors: wp.array2d(dtype=wp.vec3),
    # out
    rotations: wp.array2d(dtype=wp.mat33),
):
    """A thread owns a rotation: R = I + sin θ/θ K + (1 − cos θ)/θ² K², by series near θ = 0."""
    batch, body = wp.tid()
    v = vectors[batch, body]
    t = wp.dot(v, v)
    s = wp.min(t, 0.25)  # the series' adjoints run for all angles, and must not overflow
    a = 1.0 - s / 6.0 * (1.0 - s / 20.0 * (1.0 - s / 42.0 * (1.0 - s / 72.0)))
    b = 0.5 - s / 24.0 * (1.0 - s / 30.0 * (1.0 - s / 56.0 * (1.0 - s / 90.0)))
    if t > 0.25:
        angle = wp.sqrt(t)
        a = wp.sin(angle) / angle
        b = (1.0 - wp.cos(angle)) / t
    k = wp.skew(v)
    rotations[batch, body] = wp.identity(n=3, dtype=wp.float32) + a * k + b * (k * k)


@wp.kernel
def _rotate_by_columns(
    # in
    columns: wp.array2d(dtype=Vec6),
    # out
    rotations: wp.array2d(dtype=wp.mat33),
):
    """A thread owns a rotation: Gram–Schmidt of its first two columns, in float64 as they may be nearly parallel."""
    batch, body = wp.tid()
    c = columns[batch, body]
    x = wp.normalize(wp.vec3d(wp.vec3(c[0], c[1], c[2])))
    y = wp.vec3d(wp.vec3(c[3], c[4], c[5]))
    y = wp.normalize(y - wp.dot(x, y) * x)
    rotations[batch, body] = wp.matrix_from_cols(wp.vec3(x), wp.vec3(y), wp.vec3(wp.cross(x, y)))


_ROTATION_KERNELS = {
    wp.vec4: _rotate_by_quaternions,
    wp.vec3: _rotate_by_axis_angles,
    Vec6: _rotate_by_columns,
}


@one_at_a_time
def rotation_matrices(parameters: wp.array) -> wp.array:
    """Make rotation matrices of free parameters.

    Args:
        parameters: Shape [batch, body]; the dtype says what they are:
            vec4, quaternions (x, y, z, w) of any length from 1e-18 on;
            vec3, axis-angle vectors [radians], smooth at 0;
            :data:`Vec6`, the first two columns, of which Gram–Schmidt makes a rotation (Zhou et al. 2019);
            mat33, any matrix, whose nearest rotation is taken.

    Returns:
        Rotations, mat33 of shape [batch, body].

    Raises:
        ValueError: for another dtype, for NaN, Inf and numbers beyond 1e18, and for what is no rotation: quaternions
            and columns of length 0, parallel columns, and matrices that are as near to several rotations, as those of
            rank 1 and mirrored rotations are. (Reading them waits for a GPU. While a CUDA graph is captured that cannot
            be, and nothing is checked.)

    Differentiable: parameters.
    """
    if parameters.dtype not in (*_ROTATION_KERNELS, wp.mat33):
        raise ValueError(
            f"parameters: got dtype {parameters.dtype.__name__}, expected vec4, vec3, deform.Vec6 or mat33"
        )
    _check_rotations(parameters)
    if parameters.dtype is wp.mat33:
        return nearest_rotations(parameters)
    rotations = wp.empty(
        parameters.shape, dtype=wp.mat33, device=parameters.device, requires_grad=parameters.requires_grad
    )
    launch(
        _ROTATION_KERNELS[parameters.dtype],
        dim=parameters.shape,
        inputs=[parameters],
        outputs=[rotations],
        device=parameters.device,
    )
    return rotations


def _check_rotations(parameters: wp.array) -> None:
    """Raise ValueError for parameters that no rotation has."""
    if parameters.device.is_capturing:
        return
    check.finite_arrays({"parameters": parameters})
    if parameters.dtype is wp.vec3:
        return
    values = parameters.numpy().astype(np.float64)
    if parameters.dtype is wp.vec4:
        _refuse(np.linalg.norm(values, axis=-1) < SHORTEST, f"quaternions shorter than {SHORTEST:g}")
        return
    if parameters.dtype is wp.mat33:
        largest, middle, least = np.moveaxis(np.linalg.svd(values, compute_uv=False), -1, 0)
        _refuse(largest < SHORTEST, f"matrices smaller than {SHORTEST:g}")
        gaps = middle + np.sign(np.linalg.det(values / largest[..., None, None])) * least
        _refuse(gaps < PARALLEL * largest, "matrices as near to several rotations, as mirrored ones are,")
        return
    x, y = values[..., :3], values[..., 3:]
    lengths = np.linalg.norm(x, axis=-1), np.linalg.norm(y, axis=-1)
    _refuse(np.minimum(*lengths) < SHORTEST, f"columns shorter than {SHORTEST:g}")
    areas = np.linalg.norm(np.cross(x, y), axis=-1)
    _refuse(areas < PARALLEL * lengths[0] * lengths[1], "pairs of parallel columns")


def _refuse(faults: np.ndarray, what: str) -> None:
    """Raise ValueError where there are faults [batch, body]."""
    if faults.any():
        place = tuple(int(i) for i in np.argwhere(faults)[0])
        raise ValueError(f"parameters: got {int(faults.sum())} {what} (first at index {place}), expected rotations")


def _check_orthonormal(matrices: np.ndarray) -> None:
    """Raise ValueError for matrices [batch, body, 3, 3] that scale, shear or mirror."""
    check.finite("rotations", matrices)
    products = np.swapaxes(matrices, -1, -2) @ matrices
    gaps, determinants = np.abs(products - np.eye(3)).max(axis=(-1, -2)), np.linalg.det(matrices)
    faults = (gaps > NOT_ORTHONORMAL) | (determinants < 0)
    if faults.any():
        place = tuple(int(i) for i in np.argwhere(faults)[0])
        raise ValueError(
            f"rotations: got {int(faults.sum())} matrices that are no rotations (first at index {place}: det R = "
            f"{determinants[place]:.3g}, |RᵀR − I| = {gaps[place]:.3g}), expected det R > 0 and |RᵀR − I| up to "
            f"{NOT_ORTHONORMAL}, as rotation_matrices makes them of any nine numbers; to resize bodies there are scales"
        )


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
        return _launch(_pose_points, self._shape(rest, bodies), wp.vec3, inputs)

    def radii(self, rest: wp.array, bodies: wp.array) -> wp.array:
        """Scale radii, float32 of shape [batch, sphere], with their bodies. Differentiable: rest, scales."""
        return _launch(_pose_radii, self._shape(rest, bodies), wp.float32, [rest, bodies, self.scales])

    def _shape(self, rest: wp.array, bodies: wp.array) -> tuple[int, int]:
        """Shape of what moves."""
        check.shape("rest", rest.shape, ("batch", bodies.shape[0]))
        arrays = {"rest": rest, "rotations": self.rotations, "translations": self.translations, "scales": self.scales}
        check.finite_arrays(arrays, nonnegative=["scales"])
        return common_batch({"rest": rest, "scales": self.scales}), bodies.shape[0]


# ---------------------------------------------------------------------------------------------- embedded deformation


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
    total = wp.vec3()
    for k in range(nodes.shape[1]):
        node = nodes[point, k]
        center = node_positions[node]
        moved = matrices[batch, node] * (rest[point] - center) + center + translations[batch, node]
        total += weights[point, k] * moved
    deformed[batch, point] = total


@wp.kernel
def _move_nodes(
    # in
    node_positions: wp.array(dtype=wp.vec3),
    translations: wp.array2d(dtype=wp.vec3),
    # out
    moved: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a node of an instance."""
    batch, node = wp.tid()
    moved[batch, node] = node_positions[node] + translations[batch, node]


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
    batch, pair = wp.tid()
    node = neighbors[pair][0]
    other = neighbors[pair][1]
    edge = node_positions[other] - node_positions[node]
    gap = matrices[batch, node] * edge - edge + translations[batch, node] - translations[batch, other]
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
            device: Where the graph lives.

        Raises:
            ValueError: naming the argument; so when there are too few nodes.
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
        reach = np.maximum(distances[:, -1:], 1e-30)
        weights = (1 - distances[:, :-1] / reach) ** 2 + 1e-9  # a point as far from all of them is carried by all
        weights /= weights.sum(axis=1, keepdims=True)
        nearest = nearest[:, :-1]
        shared = np.zeros((len(nodes), len(nodes)))
        for i, j in itertools.product(range(count), repeat=2):
            np.add.at(shared, (nearest[:, i], nearest[:, j]), np.sqrt(weights[:, i] * weights[:, j]))
        are_neighbors = shared > _SHARED * len(points) / len(nodes)
        _, others = tree.query(nodes, k=count + 1)
        are_neighbors[np.arange(len(nodes))[:, None], others] = True
        are_neighbors |= are_neighbors.T
        np.fill_diagonal(are_neighbors, False)
        return DeformationGraph(
            wp.array(nodes, dtype=wp.vec3, device=device),
            wp.array(np.argwhere(are_neighbors), dtype=wp.vec2i, device=device),
            wp.array(points, dtype=wp.vec3, device=device),
            wp.array(nearest.astype(np.int32), device=device),
            wp.array(weights.astype(np.float32), device=device),
        )

    @one_at_a_time
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
        return _launch(_deform_points, (matrices.shape[0], self.rest.shape[0]), wp.vec3, inputs)

    @one_at_a_time
    def centers(self, translations: wp.array) -> wp.array:
        """Where the nodes themselves go: vec3 of shape [batch, node]. Differentiable: translations."""
        check.shape("translations", translations.shape, ("batch", self.node_positions.shape[0]))
        check.finite_arrays({"translations": translations})
        return _launch(_move_nodes, translations.shape, wp.vec3, [self.node_positions, translations])

    @one_at_a_time
    def rigidity(self, matrices: wp.array, translations: wp.array) -> wp.array:
        """As-rigid-as-possible energy Σ |M_j (g_k − g_j) + g_j + t_j − (g_k + t_k)|² over neighbors (E_reg of Sumner).

        Returns:
            float32 of shape [batch] [scene units²].

        Differentiable: matrices, translations.
        """
        self._check(matrices, translations)
        inputs = [self.node_positions, self.neighbors, matrices, translations]
        return _energy("matrices, translations", _sum_rigidity, (len(matrices), len(self.neighbors)), inputs)

    @one_at_a_time
    def shear(self, matrices: wp.array) -> wp.array:
        """How far the matrices are from rotations, Σ |MᵀM − I|² (as E_rot of Sumner): float32 of shape [batch].

        Differentiable: matrices.
        """
        check.shape("matrices", matrices.shape, ("batch", self.node_positions.shape[0]))
        check.finite_arrays({"matrices": matrices})
        return _energy("matrices", _sum_shear, matrices.shape, [matrices])

    def _check(self, matrices: wp.array, translations: wp.array) -> None:
        check.shape("matrices", matrices.shape, ("batch", self.node_positions.shape[0]))
        check.shape("translations", translations.shape, matrices.shape)
        check.finite_arrays({"matrices": matrices, "translations": translations})


def _launch(kernel: wp.Kernel, dim: tuple[int, ...], dtype: type, inputs: list[wp.array]) -> wp.array:
    """Launch a kernel whose result has the shape of the launch."""
    result = wp.empty(dim, dtype=dtype, device=inputs[0].device, requires_grad=_varies(inputs))
    launch(kernel, dim=dim, inputs=inputs, outputs=[result], device=result.device)
    return result


def _energy(names: str, kernel: wp.Kernel, dim: tuple[int, ...], inputs: list[wp.array]) -> wp.array:
    """Launch a kernel whose threads add to the energy of their instance; ValueError where that is no float32."""
    energy = wp.zeros(dim[0], dtype=wp.float32, device=inputs[0].device, requires_grad=_varies(inputs))
    launch(kernel, dim=dim, inputs=inputs, outputs=[energy], device=energy.device)
    if not energy.device.is_capturing and not np.isfinite(energy.numpy()).all():
        raise ValueError(f"{names}: got an energy beyond float32's range, expected smaller numbers")
    return energy


def _varies(inputs: list[wp.array]) -> bool:
    return any(array.requires_grad for array in inputs)
