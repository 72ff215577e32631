"""Probes of a body, and where receivers lie among them."""

import numpy as np
import pytest
import warp as wp

import warpshadow as ws
from warpshadow.stages.raster.rasterization import Fragments
from warpshadow.stages.receivers.body_spans import Span
from warpshadow.stages.self_visibility.probes import (
    _ENTRY_RATIO,
    ProbeTables,
    VisibilityProbes,
    find_probes,
    longest_edge,
)

# Interpolated float32 positions of size 1.
FLOAT32 = 1e-6
# Central differences of float32 weights, which are linear in barycentrics.
GRADIENT = 2e-3

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

POSITIONS = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0.5)], np.float32)
NORMALS = np.tile(np.float32([[0, 0, 1]]), (4, 1))
FACES = np.array([(0, 1, 2), (3, 2, 1)])


def table_of(
    probes: VisibilityProbes, device, *, first_vertex=0, vertex_count=4, first_face=0, face_count=2
) -> ProbeTables:
    return ProbeTables.of_bodies([probes], [first_vertex], [first_face], vertex_count, face_count, device)


def seen_at(faces, barycentrics, device, requires_grad=False) -> Fragments:
    return Fragments(
        wp.array(np.asarray(faces)[None], dtype=wp.int32, device=device),
        wp.array(np.asarray(barycentrics)[None], dtype=wp.vec3, device=device, requires_grad=requires_grad),
    )


@pytest.mark.parametrize(("longest", "least"), [(np.inf, 4), (0.7, 8), (0.12, 120)])
def test_no_edge_is_long_and_faces_share_the_probes_of_their_common_edge(longest, least):
    probes = find_probes(POSITIONS, NORMALS, FACES, longest)
    np.testing.assert_array_equal(probes.positions[:4], POSITIONS)
    np.testing.assert_allclose(np.linalg.norm(probes.normals, axis=1), 1, atol=FLOAT32)
    assert least <= len(probes.positions) < 3 * least
    ends, counts = np.unique(np.sort(probes.edges, axis=1), axis=0, return_counts=True)
    assert np.linalg.norm(probes.positions[ends[:, 0]] - probes.positions[ends[:, 1]], axis=1).max() <= longest
    # Euler: pieces that agree at all edges are a disc
    assert len(probes.positions) - len(ends) + counts.sum() // 3 == 1


@pytest.mark.parametrize("longest", [np.inf, 0.7, 0.3])
def test_edges_that_enter_another_part_are_cut_finer_and_faces_agree(longest):
    def is_inside(points: np.ndarray, _normals: np.ndarray | None = None) -> np.ndarray:
        return np.linalg.norm(points - POSITIONS[1], axis=1) < 0.4

    probes = find_probes(POSITIONS, NORMALS, FACES, longest, is_inside)
    ends, counts = np.unique(np.sort(probes.edges, axis=1), axis=0, return_counts=True)
    lengths = np.linalg.norm(probes.positions[ends[:, 0]] - probes.positions[ends[:, 1]], axis=1)
    inside = is_inside(probes.positions)
    enters = inside[ends[:, 0]] != inside[ends[:, 1]]
    assert enters.any() and lengths[enters].max() <= _ENTRY_RATIO * longest and lengths.max() <= longest
    assert len(probes.positions) - len(ends) + counts.sum() // 3 == 1
    without = find_probes(POSITIONS, NORMALS, FACES, longest)
    assert len(without.positions) <= len(probes.positions) < len(without.positions) + 60


def test_a_long_rail_is_cut_and_the_small_faces_beside_it_are_not():
    ball, rail = ws.icosphere(1.0, 5), np.array([(2, 0, 0), (6, 0, 0), (2, 0.01, 0), (6, 0.01, 0)])
    points = np.concatenate([ball.positions, rail]).astype(np.float32)
    faces = np.concatenate([ball.faces, FACES + len(ball.positions)])
    for has_sample_receivers in (False, True):
        longest = longest_edge(points, faces, has_sample_receivers=has_sample_receivers)
        new = find_probes(points, np.tile(NORMALS[:1], (len(points), 1)), faces, longest).positions[len(points) :]
        assert 20 < len(new) < 1000 and (new[:, 0] > 2).all()


def test_where_probes_would_be_too_many_edges_stay_longer(monkeypatch):
    monkeypatch.setattr("warpshadow.stages.self_visibility.probes._MAX_PROBES", 60)
    assert 30 < len(find_probes(POSITIONS, NORMALS, FACES, 0.05).positions) <= 60


@pytest.mark.parametrize("longest", [np.inf, 0.7, 0.12])
def test_probes_interpolate_positions_where_samples_see_a_face(device, longest):
    probes = find_probes(POSITIONS, NORMALS, FACES, longest)
    rng = np.random.default_rng(0)
    faces = rng.integers(0, 2, 300)
    barycentrics = rng.dirichlet([1, 1, 1], 300).astype(np.float32)
    barycentrics[:5] = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0.5, 0.5), (0.5, 0.5, 0)]
    rows, weights = (
        array.numpy()[0] for array in table_of(probes, device).of_samples(seen_at(faces, barycentrics, device))
    )
    expected = np.einsum("rk,rkx->rx", barycentrics, POSITIONS[FACES[faces]])
    np.testing.assert_allclose(np.einsum("rk,rkx->rx", weights, probes.positions[rows]), expected, atol=FLOAT32)
    assert weights.min() >= 0 and np.abs(weights.sum(axis=1) - 1).max() < FLOAT32


def test_vertices_and_backs_of_a_body_among_others_have_its_own_numbers(device):
    probes = find_probes(POSITIONS, NORMALS, FACES, 0.9)
    probe_count = len(probes.positions)
    table = table_of(probes, device, first_vertex=10, vertex_count=100, first_face=7, face_count=50)
    rows, weights = table.of_vertices(wp.array([10, 13, 112], dtype=wp.int32, device=device))
    np.testing.assert_array_equal(rows.numpy()[0], [[0] * 3, [3] * 3, [probe_count + 2] * 3])
    np.testing.assert_array_equal(weights.numpy()[0, :, 0], 1)
    front, back = table.of_samples(seen_at([7, 57, -1], [(0.2, 0.3, 0.5)] * 3, device)).rows.numpy()[0, :2]
    np.testing.assert_array_equal(back, front + probe_count)


def test_bodies_together_are_as_each_alone(device):
    probes = [find_probes(POSITIONS, NORMALS, FACES, longest) for longest in (0.9, 0.3)]
    starts = (0, 4), (0, 2), 8, 4, device
    together = ProbeTables.of_bodies(probes, *starts)
    alone = [ProbeTables.of_bodies([each], [4 * k], [2 * k], *starts[2:]) for k, each in enumerate(probes)]
    spans, bodies = (Span(1, 0, 2), Span(0, 2, 3), Span(1, 3, 5)), (1, 0, 1)
    vertices, faces = [4, 15, 2, 6, 7], [2, 7, 5, 3, 3]
    at_vertices = together.of_vertices(wp.array(vertices, dtype=wp.int32, device=device), spans, bodies)
    at_samples = together.of_samples(seen_at(faces, [(0.2, 0.3, 0.5)] * 5, device), spans, bodies)
    for (_, first, end), body in zip(spans, bodies, strict=True):
        of_vertices = alone[body].of_vertices(wp.array(vertices[first:end], dtype=wp.int32, device=device))
        of_samples = alone[body].of_samples(seen_at(faces[first:end], [(0.2, 0.3, 0.5)] * (end - first), device))
        for found, expected in zip((*at_vertices, *at_samples), (*of_vertices, *of_samples), strict=True):
            np.testing.assert_array_equal(found.numpy()[:, first:end], expected.numpy())


def test_gradients_to_barycentrics_are_central_differences(device, verified_tape):
    table = table_of(find_probes(POSITIONS, NORMALS, FACES, 0.4), device)
    rng = np.random.default_rng(1)
    faces, barycentrics = rng.integers(0, 2, 50), rng.dirichlet([1, 1, 1], 50)
    values = rng.normal(size=100)  # of each probe
    seen = seen_at(faces, barycentrics, device, requires_grad=True)
    with wp.Tape() as tape:
        places = table.of_samples(seen)
    seeds = values[places.rows.numpy()].astype(np.float32)
    tape.backward(grads={places.weights: wp.array(seeds, dtype=wp.vec3, device=device)})
    step = 1e-4 * rng.normal(size=(50, 3))
    step -= step.mean(axis=1, keepdims=True)  # they sum to 1
    ends = []
    for sign in (1, -1):
        moved = table.of_samples(seen_at(faces, barycentrics + sign * step, device))
        ends.append((values[moved.rows.numpy()[0]] * moved.weights.numpy()[0]).sum(axis=1))
    products = (seen.barycentrics.grad.numpy()[0] * step).sum(axis=1)
    same_piece = np.abs(products - (ends[0] - ends[1]) / 2) < GRADIENT * np.abs(step).max() * 50
    assert same_piece.mean() > 0.95  # the others cross from one small face to the next
