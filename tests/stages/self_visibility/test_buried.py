"""Buried probes: which they are, and who lends them what it sees."""

import numpy as np
import pytest
import warp as wp

import warpshadow as ws
from warpshadow.stages.rays.ray_packets import build_face_tree
from warpshadow.stages.self_visibility.buried import find_buried, find_dilation
from warpshadow.stages.self_visibility.probes import find_probes
from warpshadow.stages.self_visibility.trace import MIN_RAYS, trace_rows

pytestmark = pytest.mark.usefixtures("poisoned_outputs")


def two_balls() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Balls that overlap: points, faces, and the middle of the ball that each point is on."""
    ball = ws.icosphere(1.0, 2)
    middles = np.repeat([(0.0, 0.0, 0.0), (1.1, 0.3, 0.2)], len(ball.positions), axis=0)
    points = np.tile(ball.positions, (2, 1)) + middles
    return points.astype(np.float32), np.concatenate([ball.faces, ball.faces + len(ball.positions)]), middles


def buried_of(points, faces, normals, side, device) -> np.ndarray:
    mesh = wp.Mesh(
        wp.array(points, dtype=wp.vec3, device=device), wp.array(faces.ravel(), dtype=wp.int32, device=device)
    )
    rows = trace_rows(build_face_tree(points, faces, device), points, side * normals, MIN_RAYS)
    return find_buried(mesh, points, side * normals, rows, are_backs=side < 0)


def test_points_inside_another_part_are_buried_and_so_are_no_insides(device):
    points, faces, middles = two_balls()
    is_buried = buried_of(points, faces, points - middles, 1, device)
    others = np.roll(middles, len(middles) // 2, axis=0)
    to_others = np.linalg.norm(points - others, axis=1)
    clear = np.abs(to_others - 1) > 0.05  # faces of few points are within their ball
    np.testing.assert_array_equal(is_buried[clear], (to_others < 1)[clear])
    assert to_others.min() < 0.9
    # backs are inside their own ball; the other's inside is dark, too, but rightly so
    assert not buried_of(points, faces, points - middles, -1, device)[clear].any()


def test_a_dark_room_is_not_buried(device):
    room = ws.icosphere(1.0, 1)
    inward = room.faces[:, ::-1].copy()
    assert not buried_of(room.positions, inward, -room.positions, 1, device).any()


def test_buried_probes_borrow_from_the_nearest_along_edges_over_many_rings():
    count, step = 12, np.array([0.5, 0.02, 0])
    rail = np.concatenate([np.arange(count)[:, None] * step, np.arange(count)[:, None] * step + [0, 0.1, 0]])
    near, far = np.arange(count - 1), np.arange(count - 1) + count
    faces = np.concatenate([np.stack([near, near + 1, far], 1), np.stack([far, near + 1, far + 1], 1)])
    island = np.array([(9, 9, 9), (10, 9, 9), (9, 10, 9)])  # all of it is buried
    points = np.concatenate([rail, island]).astype(np.float32)
    probes = find_probes(points, np.tile(np.float32([[0, 0, 1]]), (len(points), 1)), [*faces, (24, 25, 26)])
    is_buried = np.zeros(len(points), bool)
    is_buried[[*range(4), *range(count, count + 4), 24, 25, 26]] = True
    dilation = find_dilation(probes, is_buried)
    expected = np.arange(len(points))
    expected[:4] = 4  # four rings away; not across to the other rail, which is longer
    expected[count : count + 4] = 4 + count
    expected[3 + count] = 4  # the diagonal is shorter than the edge
    np.testing.assert_array_equal(dilation[24:], expected[24:])
    assert set(dilation[:4]) <= {4, 4 + count} and set(dilation[count : count + 4]) <= {4, 4 + count}
    np.testing.assert_array_equal(dilation[4:count], expected[4:count])
