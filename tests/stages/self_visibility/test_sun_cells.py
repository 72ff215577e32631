"""Sun cells: which they are, where their rays go, and what receivers see of them, against single rays."""

import functools

import numpy as np
import pytest
import warp as wp

import warpshadow as ws
from warpshadow.assets.cells import draw_in_cells
from warpshadow.assets.color import LUMINANCE
from warpshadow.maths.directions import fibonacci
from warpshadow.stages.rays.ray_packets import PACKET, build_face_tree
from warpshadow.stages.rays.ray_tracing import trace_visibility
from warpshadow.stages.self_visibility.probes import ProbeWeights
from warpshadow.stages.self_visibility.sun_cells import RayProbes, find_sun_cells, trace_sun_cells

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

CELLS = 64
# Of so many rays some pass so near to an edge that float32 and float64 differ.
NEAR_EDGES = 2e-3


def sun_cells(light: ws.EnvironmentMap):
    directions = fibonacci(CELLS)
    draw = functools.partial(draw_in_cells, light.radiance, directions)
    return find_sun_cells(light.cells(directions).radiance @ LUMINANCE, draw)


@pytest.mark.parametrize("height", [16, 64])
def test_rays_go_to_where_the_light_of_their_cell_is(height):
    """Their mean, as the light's, and its spread; the map may be coarser than cells."""
    light = ws.synthetic_sky((0.3, 0.8, 0.5), height=height, sun_radius=12)
    cells, known = sun_cells(light), light.cells(fibonacci(CELLS))
    assert cells is not None and cells.directions.shape == (16, PACKET, 3)
    np.testing.assert_allclose(np.linalg.norm(cells.directions, axis=2), 1)
    bright = np.flatnonzero(cells.slots >= 0)
    assert 1 <= len(bright) < 16
    power = known.radiance @ LUMINANCE
    np.testing.assert_array_equal(np.sort(np.argsort(-power)[: len(bright)]), bright)
    for cell in bright:
        rays = cells.directions[cells.slots[cell]]
        mean = rays.mean(axis=0)
        assert np.linalg.norm(mean / np.linalg.norm(mean) - known.directions[cell]) < 0.03
        spread = np.arccos(2 * np.linalg.norm(mean) - 1)
        assert 0.75 < spread / known.half_angles[cell] < 1.35  # of all light; a cell's is that of its brightest part


def test_even_light_has_no_sun_cells():
    assert sun_cells(ws.EnvironmentMap.constant()) is None


def test_receivers_see_what_their_rays_meet_under_any_rotation(device):
    ball = ws.icosphere(1.0, 3)
    points = ball.positions * (1 - 0.5 * np.exp(-8 * np.abs(ball.positions[:, :1])))
    normals = ball.positions
    cells = sun_cells(ws.synthetic_sky((0.3, 0.8, 0.5), height=32, sun_radius=12))
    rng = np.random.default_rng(0)
    chosen, weights = ball.faces[rng.integers(0, len(ball.faces), 100)], rng.dirichlet([1, 1, 1], 100)
    matrices = np.linalg.qr(rng.normal(size=(2, 2, 3, 3)))[0]
    matrices *= 1.7 * np.sign(np.linalg.det(matrices))[..., None, None]  # scale is of no account
    places = ProbeWeights(
        wp.array(chosen[None], dtype=wp.vec3i, device=device), wp.array(weights[None], dtype=wp.vec3, device=device)
    )
    tree = build_face_tree(points, ball.faces, device)
    probes = RayProbes(tree, *(wp.array(each, dtype=wp.vec3, device=device) for each in (points, normals)))
    rotations = wp.array(matrices, dtype=wp.mat33, device=device)
    got = trace_sun_cells(probes, places, rotations, 1, cells).numpy()
    at, facing = (np.einsum("rk,rkx->rx", weights, values[chosen]) for values in (points, normals))
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    given = [wp.array(values[None], dtype=wp.vec3, device=device) for values in (at, facing)]
    faces = wp.array(ball.faces.ravel(), dtype=wp.int32, device=device)
    mesh = wp.Mesh(wp.array(points, dtype=wp.vec3, device=device), faces)
    assert got.shape == (2, 100, 16)
    for batch in range(2):
        rays = (cells.directions @ matrices[batch, 1] / 1.7).reshape(-1, 3)
        is_open = trace_visibility(mesh, *given, wp.array(rays, dtype=wp.vec3, device=device)).numpy()[0]
        cosines = np.maximum(facing @ rays.T, 0).reshape(100, 16, PACKET)
        sums = (is_open.reshape(cosines.shape) * cosines).sum(axis=2)
        total = cosines.sum(axis=2)
        expected = np.where(total > 0, sums / np.maximum(total, 1e-12), 1)
        assert (np.abs(got[batch] - expected) > 1e-5).mean() < NEAR_EDGES
        assert 0.1 < expected[total > 0].mean() < 0.9
