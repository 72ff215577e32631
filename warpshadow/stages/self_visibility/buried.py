"""Buried probes: points of a body that lie inside another part of it, as the root of a handle does in a cup.

They are dark, but faces lead from them to where light is, and would darken it. So a buried probe copies the nearest
unburied probe, along edges, as texels of light maps do (dilation).
"""

import numpy as np
import warp as wp

from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.maths.directions import fibonacci
from warpshadow.stages.rays.ray_tracing import first_hit
from warpshadow.stages.self_visibility.probes import VisibilityProbes
from warpshadow.stages.self_visibility.trace import VisibilityRows

_RAYS = 64  # directions that tell on which side faces are met


@wp.kernel(enable_backward=False)
def _find_buried(
    # in
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    are_backs: bool,
    directions: wp.array(dtype=wp.vec3),
    bits: wp.array2d(dtype=wp.uint32),
    # out
    is_buried: wp.array(dtype=wp.bool),
):
    """A thread owns a row."""
    row = wp.tid()
    if bits:
        for word in range(bits.shape[1]):
            if bits[row, word] != wp.uint32(0):
                is_buried[row] = False
                return
    front_hits = int(0)
    back_hits = int(0)
    for ray in range(directions.shape[0]):
        if wp.dot(normals[row], directions[ray]) > 0.0:
            hit = first_hit(mesh, points[row], normals[row], directions[ray])
            if hit.face >= 0:
                if hit.is_back == are_backs:
                    front_hits += 1
                else:
                    back_hits += 1
            elif not bits:
                is_buried[row] = False
                return
    is_buried[row] = back_hits > front_hits


def find_buried(
    mesh: wp.Mesh,
    points: np.ndarray,
    normals: np.ndarray,
    rows: VisibilityRows | None = None,
    *,
    are_backs: bool = False,
) -> np.ndarray:
    """Find the rows of probes that no ray escapes from, and whose rays mostly meet faces on their other side.

    Args:
        mesh: The mesh, in the frame of the points.
        points: Probes, [row, 3].
        normals: Unit normals [row, 3].
        rows: Their traced visibility; None traces rays instead.
        are_backs: Whether they are backs of probes.
    Returns:
        Bool of shape [row].
    """
    device = mesh.points.device
    point_array, normal_array, directions = (
        wp.array(values, dtype=wp.vec3, device=device) for values in (points, normals, fibonacci(_RAYS))
    )
    is_buried = empty(len(points), dtype=wp.bool, device=device)
    inputs = [mesh.id, point_array, normal_array, are_backs, directions, None if rows is None else rows.bits]
    launch(_find_buried, len(points), inputs=inputs, outputs=[is_buried])
    return is_buried.numpy()


def find_dilation(probes: VisibilityProbes, is_buried: np.ndarray) -> np.ndarray:
    """Find the row from which each row copies visibility: itself, or its nearest unburied neighbor along edges.

    Args:
        is_buried: Bool of shape [row]: the probes, or their backs.
    Returns:
        Numbers of rows, int of shape [row]. A buried row from which no way leads to another kind keeps its own.
    """
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import dijkstra

    dilation, probe_count = np.arange(len(is_buried)), len(is_buried)
    if not is_buried.any() or is_buried.all():
        return dilation
    edge_ends = np.unique(np.sort(probes.edges, axis=1), axis=0)
    lengths = np.linalg.norm(probes.positions[edge_ends[:, 0]] - probes.positions[edge_ends[:, 1]], axis=1)
    graph = csr_matrix((np.maximum(lengths, 1e-12), edge_ends.T), (probe_count, probe_count))  # 0 is no edge
    open_probes = np.flatnonzero(~is_buried)
    *_, nearest_open = dijkstra(graph, False, open_probes, return_predecessors=True, min_only=True)
    return np.where(is_buried & (nearest_open >= 0), nearest_open, dilation)
