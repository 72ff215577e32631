"""Buried sites: which they are, and who lends them what it sees."""

import numpy as np
import pytest
import warp as wp

import warpshadow as ws
from warpshadow.stages.own_shadows.buried import find_buried, find_lenders
from warpshadow.stages.own_shadows.sites import find_sites
from warpshadow.stages.own_shadows.trace import LEAST_RAYS, trace_rows

pytestmark = pytest.mark.usefixtures("poisoned_outputs")


def two_balls() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Balls that overlap: points, faces, and the middle of the ball that each point is on."""
    ball = ws.icosphere(1.0, 2)
    middles = np.repeat([(0.0, 0.0, 0.0), (1.1, 0.3, 0.2)], len(ball.positions), axis=0)
    points = np.tile(ball.positions, (2, 1)) + middles
    return points.astype(np.float32), np.concatenate([ball.faces, ball.faces + len(ball.positions)]), middles


def buried_of(points, faces, normals, sides, device) -> np.ndarray:
    mesh = wp.Mesh(
        wp.array(points, dtype=wp.vec3, device=device), wp.array(faces.ravel(), dtype=wp.int32, device=device)
    )
    places, facing = np.tile(points, (len(sides), 1)), np.concatenate([side * normals for side in sides])
    rows = trace_rows(mesh, places, facing, LEAST_RAYS)
    return find_buried(mesh, places, facing, len(points), rows)


@pytest.mark.parametrize("sides", [(1,), (1, -1)])
def test_points_inside_another_part_are_buried_and_so_are_no_insides(device, sides):
    points, faces, middles = two_balls()
    is_buried = buried_of(points, faces, points - middles, sides, device)
    others = np.roll(middles, len(middles) // 2, axis=0)
    to_others = np.linalg.norm(points - others, axis=1)
    clear = np.abs(to_others - 1) > 0.05  # faces of few points are within their ball
    np.testing.assert_array_equal(is_buried[: len(points)][clear], (to_others < 1)[clear])
    assert to_others.min() < 0.9
    if len(sides) == 2:  # backs are inside their own ball; the other's inside is dark, too, but rightly so
        assert not is_buried[len(points) :][clear].any()


def test_a_dark_room_is_not_buried(device):
    room = ws.icosphere(1.0, 1)
    inward = room.faces[:, ::-1].copy()
    assert not buried_of(room.positions, inward, -room.positions, (1,), device).any()


@pytest.mark.parametrize("cuts", [1, 3])
def test_buried_sites_borrow_from_the_nearest_beside_them(cuts):
    positions = np.array([(0, 0, 0), (1, 0, 0), (0, 1.5, 0), (1.2, 1, 0.5)], np.float32)
    sites = find_sites(positions, np.tile(np.float32([[0, 0, 1]]), (4, 1)), np.array([(0, 1, 2), (3, 2, 1)]), cuts)
    count = len(sites.positions)
    beside = {site: set() for site in range(count)}
    for corners in sites.corners:  # sites of a lattice are beside each other where their steps are
        lattice = [(i, j) for j in range(cuts + 1) for i in range(cuts + 1 - j)]
        for site, (i, j) in zip(corners, lattice, strict=True):
            for other, (k, m) in zip(corners, lattice, strict=True):
                if (k - i, m - j) in {(1, 0), (-1, 0), (0, 1), (0, -1), (1, -1), (-1, 1)}:
                    beside[site].add(other)
    is_buried = np.random.default_rng(cuts).random(2 * count) < 0.6
    is_buried[:count][sorted({0, *beside[0]})] = True  # one has none beside it
    lenders = find_lenders(sites, is_buried)
    for row, lender in enumerate(lenders):
        first, site = row - row % count, row % count
        able = [other for other in beside[site] if not is_buried[first + other]]
        if not is_buried[row] or not able:
            assert lender == row
        else:
            distances = {other: np.linalg.norm(sites.positions[site] - sites.positions[other]) for other in able}
            assert lender - first in able
            assert distances[lender - first] == min(distances.values())
