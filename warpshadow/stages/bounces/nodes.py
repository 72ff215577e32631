"""Nodes: some of many receivers, at which light that bounces is found for all of them. It varies slowly."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warpshadow.maths.spatial_sort import z_order

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

NODE_COUNT = 2048
"""Nodes of an image: of 256 × 256 pixels one in 32."""

_NEIGHBORS = 3

_TURN = 0.1
"""Distance that a difference of normals by 1 counts as, in parts of the receivers' extent."""


def choose_nodes(points: np.ndarray, count: int = NODE_COUNT) -> np.ndarray:
    """Choose receivers that are as dense as all are, numbers of shape [node].

    Args:
        points: Receivers, shape [receiver, 3].
        count: Most nodes; all receivers where they are fewer.
    """
    along = z_order(points.astype(np.float64))
    return along[np.arange(min(count, len(along))) * len(along) // max(min(count, len(along)), 1)]


def interpolation(points: np.ndarray, normals: np.ndarray, nodes: np.ndarray) -> csr_matrix:
    """The matrix that interpolates between the nearest nodes, by place and normal.

    With d_i the distances to the nearest nodes in order, the three nearest weigh (1/d_i − 1/d_4)² [Renka 1988].

    Args:
        points: Receivers, shape [receiver, 3].
        normals: Their unit normals, shape [receiver, 3].
        nodes: Which of them are nodes, shape [node].

    Returns:
        Shape [receiver, node]; rows sum to 1.
    """
    from scipy.sparse import csr_matrix
    from scipy.spatial import cKDTree

    extent = float(np.ptp(points, axis=0).max(initial=0.0)) or 1.0
    features = np.concatenate([points / extent, _TURN * normals], axis=1).astype(np.float64)
    reached = min(_NEIGHBORS + 1, len(nodes))
    distances, neighbors = cKDTree(features[nodes]).query(features, k=reached)
    distances, neighbors = distances.reshape(len(points), reached), neighbors.reshape(len(points), reached)
    nearness = 1 / np.maximum(distances, 1e-9)
    weights = (nearness - nearness[:, -1:]) ** 2
    weights[weights.sum(axis=1) == 0, 0] = 1  # all are as far
    weights /= weights.sum(axis=1, keepdims=True)
    starts = np.arange(len(points) + 1) * reached
    return csr_matrix((weights.astype(np.float32).ravel(), neighbors.ravel(), starts), (len(points), len(nodes)))
