"""What probes see past their own body, against rays through the same faces in NumPy."""

import numpy as np
import pytest

import warpshadow as ws
from warpshadow.maths.directions import cell_radius, fibonacci
from warpshadow.stages.rays.ray_packets import build_face_tree
from warpshadow.stages.self_visibility import trace
from warpshadow.stages.self_visibility.trace import MAX_MEMORY, MIN_RAYS, RAYS, RAYS_PER_CELL, ray_count, trace_rows

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

COUNT = 1024
# Of so many rays some pass so near to an edge that float32 and float64 differ.
NEAR_EDGES = 2e-3
# Of rays below the horizon, some pass an edge on another side than the ray does that is nearest to the mirrored one.
NEAREST = 0.03


def corner() -> tuple[np.ndarray, np.ndarray]:
    """A floor and a wall, which overlap no axis."""
    turn = ws.Body(ws.plane(1.0, 1), rotation=(20, 30, 40)).rotation_matrix()
    points = np.array([(0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1), (0, 1, 0), (1, 1, 0)]) @ turn.T
    return points.astype(np.float32), np.array([(0, 2, 1), (0, 3, 2), (0, 1, 5), (0, 5, 4)], np.int32)


def twin(points, faces, probe, normal, directions) -> np.ndarray:
    """Whether rays escape (Möller and Trumbore 1997, float64); those below the horizon are mirrored."""
    cosines = directions @ normal
    up = directions - 2 * np.minimum(cosines, 0)[:, None] * normal
    escapes = np.ones(len(directions), bool)
    for a, b, c in points[faces].astype(np.float64):
        p = np.cross(up, c - a)
        determinant = p @ (b - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = p @ (probe - a) / determinant
            q = np.cross(probe - a, b - a)
            v, distance = up @ q / determinant, (c - a) @ q / determinant
        escapes &= ~((u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 1e-4))
    return escapes


def bits_of(rows: trace.VisibilityRows) -> np.ndarray:
    """Bits [row, ray]."""
    return np.unpackbits(rows.bits.numpy().view(np.uint8), axis=1, bitorder="little").astype(bool)


def traced(device, progress=False):
    points, faces = corner()
    probes = points[faces].mean(axis=1)
    edges = points[faces[:, 1:]] - points[faces[:, :1]]
    normals = np.cross(edges[:, 0], edges[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return (
        probes,
        normals,
        trace_rows(build_face_tree(points, faces, device), probes, normals, COUNT, progress=progress),
    )


def test_bits_are_what_rays_meet_also_mirrored_ones(device):
    points, faces = corner()
    probes, normals, rows = traced(device)
    assert rows.ray_count == COUNT
    directions = fibonacci(COUNT)
    lowest = np.sin(3.5 * cell_radius(COUNT // RAYS_PER_CELL))
    blocked = 0
    for probe, normal, bits in zip(probes, normals, bits_of(rows), strict=True):
        cosines = directions @ normal
        is_cached = cosines > -lowest
        expected = twin(points, faces, probe.astype(np.float64), normal.astype(np.float64), directions) & is_cached
        is_mirrored = cosines <= -np.sin(2 * cell_radius(COUNT))
        assert (bits != expected)[~is_mirrored].mean() < NEAR_EDGES
        assert (bits != expected)[is_mirrored].mean() < NEAREST
        blocked += (~expected & (cosines > 0)).sum()
        below = is_cached & (cosines < 0)
        assert below.any() and bits[below].any()
    assert blocked > 100


def test_cells_are_means_of_their_bits_weighted_with_cosines(device):
    _, normals, rows = traced(device)
    cosines = np.abs(np.einsum("rx,dx->rd", normals, fibonacci(COUNT)))
    is_cached = np.einsum("rx,dx->rd", normals, fibonacci(COUNT)) > -np.sin(3.5 * cell_radius(COUNT // RAYS_PER_CELL))
    weights = (cosines * is_cached).reshape(len(normals), -1, RAYS_PER_CELL)
    totals = weights.sum(axis=2)
    sums = (weights * bits_of(rows).reshape(weights.shape)).sum(axis=2)
    expected = np.where(totals > 0, sums / np.maximum(totals, 1e-12), 1)
    assert np.abs(rows.cells.numpy() / 255 - expected).max() < 0.51 / 255


def test_a_convex_body_blocks_none_of_its_own_light(device):
    mesh = ws.icosphere(1.0, 2)
    tree = build_face_tree(mesh.positions, mesh.faces, device)
    rows = trace_rows(tree, mesh.positions, mesh.positions, COUNT)
    cosines = mesh.positions @ fibonacci(COUNT).T
    assert bits_of(rows)[cosines > 1e-3].all()


def test_memory_is_bounded_by_fewer_rays():
    assert ray_count(10_000) == ray_count(MAX_MEMORY * 4 // RAYS) == RAYS
    assert ray_count(1_000_000) == 1024 and MAX_MEMORY >= 1_000_000 * 1024 // 4
    assert ray_count(10**9) == MIN_RAYS
