"""Ray-traced visibility of a mesh against formulas and a float64 twin."""

import numpy as np
import pytest
import warp as wp

from warpshadow.directions import fibonacci
from warpshadow.mesh import Mesh, icosphere
from warpshadow.reference import trace_visibility

SEED = 5


def warp_mesh(mesh: Mesh, device) -> wp.Mesh:
    points = wp.array(mesh.positions, dtype=wp.vec3, device=device)
    return wp.Mesh(points, wp.array(mesh.faces.ravel(), dtype=wp.int32, device=device))


def trace(mesh: wp.Mesh, points, normals, directions, device, **options) -> np.ndarray:
    def vectors(values):
        return wp.array(np.asarray(values, np.float32), dtype=wp.vec3, device=device)

    return trace_visibility(mesh, vectors(points), vectors(normals), vectors(directions), **options).numpy()


def test_a_ball_over_a_plane_blocks_its_cone_of_directions(device):
    center, radius = np.array([0.2, 1.5, -0.1]), 0.8
    ball = icosphere(radius, 5)
    mesh = warp_mesh(Mesh(ball.positions + center, ball.faces), device)
    rng = np.random.default_rng(SEED)
    points = np.zeros((2, 30, 3))
    points[..., ::2] = rng.uniform(-3, 3, size=(2, 30, 2))
    normals = np.tile([0.0, 1.0, 0.0], (2, 30, 1))
    directions = fibonacci(512)
    visible = trace(mesh, points, normals, directions, device)

    toward = center - points
    distance = np.linalg.norm(toward, axis=-1, keepdims=True)
    cosine = (toward / distance) @ directions.T
    edge = np.sqrt(1 - (radius / distance) ** 2)
    expected = (cosine <= edge) & (directions[:, 1] > 0)
    clear = np.abs(np.arccos(np.clip(cosine, -1, 1)) - np.arccos(edge)) > 0.02  # the facets are not quite the sphere
    assert clear.mean() > 0.9
    np.testing.assert_array_equal(visible[clear], expected[clear])


def test_points_of_a_convex_mesh_see_their_whole_hemisphere(device):
    ball = icosphere(100.0, 3)
    normals = ball.positions / np.linalg.norm(ball.positions, axis=1, keepdims=True)
    directions = fibonacci(128)
    visible = trace(warp_mesh(ball, device), ball.positions[None], normals[None], directions, device)[0]
    cosine = normals @ directions.T
    facet_angle = 0.12  # facets next to a vertex tilt against its normal by this much
    assert visible[cosine > facet_angle].all()
    assert not visible[cosine <= 0].any()


def test_moeller_and_trumbore_find_the_same_rays_blocked(device):
    ball = icosphere(1.0, 2)
    mesh = Mesh(ball.positions * [1.5, 0.3, 1.0] + np.sin(3 * ball.positions[:, ::-1]), ball.faces)  # not convex
    rng = np.random.default_rng(SEED)
    points = rng.uniform(-2, 2, size=(40, 3)).astype(np.float32).astype(np.float64)
    normals = rng.normal(size=(40, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    directions = fibonacci(32)
    visible = trace(warp_mesh(mesh, device), points[None], normals[None], directions, device, offset=0.0)[0]

    corners = mesh.positions[mesh.faces].astype(np.float64)
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(directions[:, None], second[None])  # [direction, face, 3]
    determinant = (across * first).sum(axis=-1)
    from_corner = points[:, None] - corners[None, :, 0]  # [point, face, 3]
    u = np.einsum("pfi,dfi->pdf", from_corner, across) / determinant
    sideways = np.cross(from_corner, first)
    v = np.einsum("pfi,di->pdf", sideways, directions) / determinant
    along = (sideways * second).sum(axis=-1)[:, None] / determinant
    hit = ((u > 0) & (v > 0) & (u + v < 1) & (along > 0)).any(axis=-1)
    expected = ~hit & (normals @ directions.T > 0)
    assert 0.1 < hit.mean() < 0.9
    assert (visible == expected).mean() > 0.998  # rays through edges may go either way


def test_a_bad_offset_is_refused(device):
    mesh = warp_mesh(icosphere(1.0, 1), device)
    with pytest.raises(ValueError, match="offset: got nan"):
        trace(mesh, np.zeros((1, 1, 3)), np.ones((1, 1, 3)), fibonacci(16), device, offset=float("nan"))
    with pytest.raises(ValueError, match="normals: got shape"):
        trace(mesh, np.zeros((1, 2, 3)), np.ones((1, 1, 3)), fibonacci(16), device)
