"""The paper's tables: problems are as far from their answers as they say, results are kept, failures listed."""

import dataclasses
import json

import numpy as np
import pytest

import warpshadow as ws
from demos import problems
from demos.benchmarks import paper_tables as tables
from warpshadow import inverse


@pytest.fixture
def ball_case():
    """A ball with known spheres on a ground, from its side by a fifth of its size, and what measures it."""
    ball = ws.Body(ws.icosphere(0.5, 2), blockers=ws.Spheres([[0, 0, 0]], [0.5]), translation=(0, 0.5, 0))
    camera = ws.Camera.look_at((0, 2, 3), (0, 0.3, 0), size=(16, 16))
    truth = ws.Scene((ball, ws.Body(ws.plane(4, 8))), ws.synthetic_sky(height=32), camera)
    start = problems.changed(truth, 0, translation=np.array([0.2, 0.5, 0.0]))
    problem = inverse.Problem(start, inverse.Target(ws.render(truth)), inverse.Pose(0))
    stages = (inverse.Stage(30, 0.05),)
    return problems.Case(problem, truth, stages, lambda s: problems.pose_errors(s.bodies[0], truth.bodies[0]))


def test_a_displaced_body_is_turned_about_its_middle_and_shifted_as_far_as_it_says():
    body = ws.Body(ws.icosphere(1.0, 1), rotation=(0, 50, 0), translation=(3, 1, -2), scale=2.0)
    diagonal = np.linalg.norm(np.subtract(*body.world_mesh().bounds))
    for seed in range(20):
        moved = problems.displaced(body, np.random.default_rng(seed))
        errors = problems.pose_errors(moved, body)
        middle = np.mean(moved.world_mesh().bounds, axis=0)
        shift = np.linalg.norm(middle - np.mean(body.world_mesh().bounds, axis=0)) / diagonal
        assert np.radians(10) < errors["RE"] < np.radians(40)
        assert 0.05 - 0.02 < shift < 0.25 + 0.02  # the box turns, too


def test_errors_of_a_body_where_it_belongs_are_none_and_a_shift_is_its_part_of_the_diagonal():
    body = ws.Body(ws.icosphere(1.0, 2), rotation=(10, 20, 30))
    low, high = body.world_mesh().bounds
    shifted = dataclasses.replace(body, translation=(0, 0.1 * np.linalg.norm(high - low), 0))
    assert problems.distance_error(body, body) == 0
    errors = problems.pose_errors(shifted, body)
    assert errors["pose MDE"] == pytest.approx(10, abs=1e-4) and errors["RE"] < 1e-6
    assert errors["TE"] == pytest.approx(np.sum(np.square(shifted.translation)))


def test_bending_moves_the_top_far_and_the_foot_little():
    mesh = ws.icosphere(1.0, 3)
    for seed in range(5):
        bent = problems.bent(mesh, seed)
        moved = np.linalg.norm(bent.positions - mesh.positions, axis=1)
        height = mesh.positions[:, 1]
        assert moved[height > 0.9].mean() > 0.2 and moved[height < -0.9].max() < 0.1
        assert np.array_equal(bent.faces, mesh.faces)


@pytest.mark.slow
def test_a_fit_is_measured_and_one_that_fails_is_listed(ball_case):
    figures = tables.solve(ball_case, "directional", None)
    assert 3 < figures["iterations"] <= 30 and figures["reason"] in ("finished", "converged") and figures["ms"] > 0
    assert figures["TE"] < 0.1 * ball_case.measure(ball_case.problem.scene)["TE"]  # how a ball is turned, none can tell
    assert tables.solve(ball_case, "directional", 3)["iterations"] == 3
    key = "pose | 00 ball, sky | "
    shared = {key + "directional": figures, key + "direct illumination": {"error": "ValueError: it would not"}}
    text = tables.table("pose", shared)
    assert f"| directional | {figures['pose MDE']:.3g} ± 0 |" in text
    assert f"- failed: {key}direct illumination: ValueError: it would not" in text
    broken = dataclasses.replace(ball_case, stages=(inverse.Stage(softness=0.5),))
    assert "stages[0]: softness" in tables.solve(broken, "log-SH eigen", None)["error"]


def test_results_are_kept_at_once_and_with_those_of_other_processes(tmp_path):
    path = tmp_path / "results.json"
    first, second = tables.Results(path), tables.Results(path)
    first.add("a", {"x": 1.0})
    second.add("b", {"x": 2.0})
    assert json.loads(path.read_text()) == {"a": {"x": 1.0}, "b": {"x": 2.0}}
    assert tables.Results(path).figures == {"a": {"x": 1.0}, "b": {"x": 2.0}}
    assert [file.name for file in tmp_path.iterdir()] == ["results.json"]


def test_columns_with_bounces_are_those_of_direct_light_and_the_same_with_bounces():
    columns = tables.columns_with_bounces(2)
    assert [column.bounces for column in columns.values()] == [0, 0, 0, 2, 2]
    assert columns["directional, 2 bounces"].visibility.method == "directional"
    assert columns["ray traced, 2 bounces"].visibility is None


def test_a_case_is_solved_with_as_many_bounces_as_are_asked_for_whatever_its_targets_have(ball_case):
    full = dataclasses.replace(ball_case.problem.scene, bounces=12)
    case = dataclasses.replace(ball_case, problem=dataclasses.replace(ball_case.problem, scene=full))
    ours, direct = case.by(ws.Visibility(), 2), case.by(None)
    assert (ours.scene.bounces, ours.still) == (2, None)
    assert (direct.scene.bounces, direct.still) == (0, case.problem.still)
    assert case.by(problems.DIRECT).scene.visibility.method == "none"


def test_a_case_by_another_method_traces_no_rays(ball_case):
    direct = ball_case.by(problems.DIRECT)
    assert direct.still is None and direct.scene.visibility.method == "none"
    assert ball_case.by(None) is ball_case.problem
