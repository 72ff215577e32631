"""Form factors against analytic ones and visibility, and a body's light on itself against NumPy."""

import numpy as np
import pytest
import twins
import warp as wp

import warpshadow as ws
from demos.scenes import shipped_mesh
from warpshadow.device.tape import recorded
from warpshadow.maths.directions import fibonacci
from warpshadow.stages.bounces.form_factors import patch_mesh, trace_form_factors
from warpshadow.stages.bounces.self_light import self_light
from warpshadow.stages.geometry.normals import vertex_normals
from warpshadow.stages.patches import find_patches
from warpshadow.stages.rays.ray_tracing import trace_visibility
from warpshadow.stages.receivers.body_spans import Span
from warpshadow.stages.sparse import SparseMatrix, multiply

FLOAT32 = 1e-5
LATTICE = 0.01
"""Of 1024 rays, those that an edge of a patch puts on one side or the other."""


def square(height, faces_down=True):
    """A square of 2 × 2 units at a height, with its front below or above."""
    return ws.plane(2.0, 1).transformed(
        rotation=np.diag([1.0, -1, -1]) if faces_down else None, translation=(0, height, 0)
    )


def factors_of(mesh, points, normals, device, *, sides=True, rays=1024):
    faces = mesh.surface.faces
    patches = find_patches(mesh.positions, faces, is_two_sided=sides)
    traced = patch_mesh(patches, mesh.positions, faces, device=device)
    return patches, trace_form_factors(traced, patches.patch_of_pieces, patches.count, points, normals, rays=rays)


@pytest.mark.parametrize("height", [0.3, 1.0, 4.0])
@pytest.mark.parametrize("faces_down", [True, False])
def test_factors_are_those_of_a_square_and_on_the_side_that_is_seen(height, faces_down, device):
    points, normals = np.zeros((1, 3)), np.array([[0.0, 1, 0]])
    patches, factors = factors_of(square(height, faces_down), points, normals, device)
    front, back = factors.toarray()[0].reshape(2, -1).sum(axis=1)
    seen, other = (front, back) if faces_down else (back, front)
    assert seen == pytest.approx(twins.form_factor_of_square(height), abs=LATTICE)
    assert other == 0


def test_the_back_of_a_closed_body_is_black(device):
    patches, factors = factors_of(
        square(1.0, faces_down=False), np.zeros((1, 3)), np.array([[0.0, 1, 0]]), device, sides=False
    )
    assert factors.nnz == 0 and factors.shape == (1, patches.count)


def test_a_receiver_sees_patches_where_they_are(device):
    """Each patch's own factor is the integral of cosines over its pieces."""
    points, normals = np.array([[0.3, 0, 0.2]]), np.array([[0.0, 1, 0]])
    patches, factors = factors_of(square(1.0), points, normals, device, rays=16384)
    offsets = patches.centers - points
    distance = np.linalg.norm(offsets, axis=1)
    expected = patches.areas * (offsets[:, 1] / distance) ** 2 / (np.pi * distance**2)
    count = patches.count // 2
    np.testing.assert_allclose(factors.toarray()[0, :count], expected[:count], atol=0.1 * expected.max())


def test_rays_go_in_packets_of_sixteen(device):
    for count in (8, 100):
        with pytest.raises(ValueError, match=f"rays: got {count}, expected a positive multiple of 16"):
            factors_of(square(1.0), np.zeros((1, 3)), np.array([[0.0, 1, 0]]), device, rays=count)


def test_a_convex_body_sees_nothing_of_itself_and_all_of_it_from_within(device):
    """Rays that meet nothing are told apart sixteen at once, those that do one by one."""
    mesh = ws.icosphere(1.0, 2)
    _, outside = factors_of(mesh, mesh.positions, mesh.positions, device)
    assert outside.nnz == 0
    _, within = factors_of(mesh, 0.99 * mesh.positions, -mesh.positions, device)
    np.testing.assert_allclose(within.sum(axis=1), 1.0, atol=1e-3)


def test_a_receiver_without_a_normal_sees_nothing(device):
    _, factors = factors_of(square(1.0), np.zeros((1, 3)), np.zeros((1, 3)), device)
    assert factors.nnz == 0


def test_no_receivers_have_no_factors(device):
    patches, factors = factors_of(square(1.0), np.zeros((0, 3)), np.zeros((0, 3)), device)
    assert factors.shape == (0, patches.count)


@pytest.mark.slow
def test_a_body_is_seen_where_light_does_not_come_past_it(device):
    mesh = shipped_mesh("bunny")
    faces = mesh.surface.faces
    points = wp.array(mesh.positions[None], dtype=wp.vec3, device=device)
    normals = vertex_normals(points, wp.array(faces, dtype=wp.vec3i, device=device))
    chosen = np.arange(0, mesh.vertex_count, 20)
    at = points.numpy()[:, chosen], normals.numpy()[:, chosen]
    _, factors = factors_of(mesh, at[0][0], at[1][0], device, sides=False)
    on_device = [wp.array(values, dtype=wp.vec3, device=device) for values in at]
    whole = wp.Mesh(points[0], wp.array(faces.ravel(), dtype=wp.int32, device=device))
    directions = fibonacci(4096)
    is_open = trace_visibility(whole, *on_device, wp.array(directions, dtype=wp.vec3, device=device)).numpy()[0]
    open_share = 4 / 4096 * (is_open * np.maximum(at[1][0] @ directions.T, 0)).sum(axis=1)
    seen = np.asarray(factors.sum(axis=1)).ravel()
    assert (seen <= 1 - open_share + 2 * LATTICE).all()
    # what is neither leaves below a face of its own
    assert np.mean(1 - open_share - seen) < LATTICE


def uniform(*shape, seed=0):
    return np.random.default_rng(seed).uniform(size=shape).astype(np.float32)


def test_receivers_of_several_bodies_are_as_those_of_each_alone(device):
    light, weights, addend = (wp.array(uniform(1, n, 3, seed=n), dtype=wp.vec3, device=device) for n in (9, 5, 5))
    rows = np.random.default_rng(4).integers(0, 3, size=(1, 5, 3))
    spans, first_probes = [Span(2, 0, 2), Span(0, 2, 3), Span(5, 3, 5)], (6, -1, 3)
    probes = wp.array(rows, dtype=wp.vec3i, device=device)
    got = self_light(light, probes, weights, addend, body_spans=spans, first_probes=first_probes).numpy()[0]
    for (_, first, end), first_probe in zip(spans, first_probes, strict=True):
        own = light.numpy()[0, first_probe + rows[0, first:end]] if first_probe >= 0 else np.zeros((end - first, 3, 3))
        mixed = addend.numpy()[0, first:end] + np.einsum("rk,rkc->rc", weights.numpy()[0, first:end], own)
        np.testing.assert_allclose(got[first:end], mixed, rtol=FLOAT32)


@pytest.mark.parametrize(("lit", "placed"), [(1, 1), (2, 1), (1, 2), (2, 2)])
def test_light_is_mixed_from_the_sites_around_a_receiver(lit, placed, device, poisoned_outputs, verified_tape):
    factors = uniform(6, 4) * (uniform(6, 4, seed=1) > 0.5)
    radiosity, weights = uniform(lit, 4, 3, seed=2), uniform(placed, 5, 3, seed=3)
    rows = np.random.default_rng(4).integers(0, 6, size=(placed, 5, 3))
    given = [wp.array(values, dtype=wp.vec3, device=device, requires_grad=True) for values in (radiosity, weights)]
    with recorded() as tape:
        light = self_light(
            multiply(SparseMatrix.from_matrix(factors, device=device), given[0]),
            wp.array(rows, dtype=wp.vec3i, device=device),
            given[1],
        )
    at_sites = (factors @ radiosity)[[0] * 2 if lit == 1 else [0, 1]][: max(lit, placed)]
    rows, weights = (np.broadcast_to(values, (max(lit, placed), 5, 3)) for values in (rows, weights))
    mixed = np.stack([at_sites[batch][rows[batch]] for batch in range(len(rows))])  # [batch, receiver, corner, 3]
    np.testing.assert_allclose(light.numpy(), np.einsum("brk,brkc->brc", weights, mixed), rtol=FLOAT32)
    adj_light = uniform(*light.shape, 3, seed=5)
    tape.backward(grads={light: wp.array(adj_light, dtype=wp.vec3, device=device)})
    adj_sites = np.zeros((len(rows), 6, 3))
    for batch, receiver, corner in np.ndindex(rows.shape):
        adj_sites[batch, rows[batch, receiver, corner]] += weights[batch, receiver, corner] * adj_light[batch, receiver]
    for variable, expected in zip(
        given, (factors.T @ adj_sites, np.einsum("brc,brkc->brk", adj_light, mixed)), strict=True
    ):
        if len(variable.grad) == 1:
            expected = expected.sum(axis=0, keepdims=True)
        np.testing.assert_allclose(variable.grad.numpy(), expected, rtol=1e-4)
