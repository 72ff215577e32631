"""Uncertainty: standard deviations that repeated measurements have, and the direction that images do not tell."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import warpshadow as ws
from warpshadow.inverse import (
    DiagnosticWarning,
    Exposure,
    Light,
    Loss,
    OutlineOffset,
    Pose,
    Problem,
    Result,
    Target,
    write_result,
)
from warpshadow.inverse.model import Model
from warpshadow.inverse.uncertainty import CANDIDATE_SPACING, NormalMatrix, candidates_along_flat_direction
from warpshadow.inverse.verdict import small_stage

NOISE = 0.05
DIFFERENCE = 0.03  # central differences of a loss that bends where edges pass the centers of pixels
KNOWN_TURN = Pose("egg", covariance=[0.02] * 3 + [10.0] * 3)  # the outline of an egg hardly tells it


def scene(blockers: int = 0) -> ws.Scene:
    mesh = ws.icosphere(1.0, 3)
    mesh = dataclasses.replace(mesh, positions=mesh.positions * (0.5, 0.8, 0.6))
    body = ws.Body(mesh, albedo=(0.7, 0.5, 0.3), blockers=blockers, translation=(0, 0.8, 0), name="egg")
    ground = ws.Body(ws.plane(6.0, 8), blockers=0, albedo=(0.6,) * 3, name="table")
    light = np.zeros((4, 3))
    light[0], light[1], light[2] = 3.0, 0.8, 0.5
    camera = ws.Camera.look_at((0, 3, 5), (0, 0.6, 0), size=(64, 48))
    return ws.Scene((body, ground), light, camera, ws.Visibility("none"), supersampling=1)


def result_of(free, seed: int = 0, **target) -> Result:
    """A fit that has ended at the truth, of an image with noise."""
    where = scene()
    image = ws.render(where)[..., :3]
    image = image + NOISE * np.random.default_rng(seed).standard_normal(image.shape)
    problem = Problem(where, Target(image.astype(np.float32), **target), free, still=None)
    context = problem.context(torch.device("cpu"))
    return Result(problem, context, problem.start(context), [[]], "converged", math.nan)


@pytest.fixture(scope="module")
def outline() -> np.ndarray:
    alone = dataclasses.replace(scene(), bodies=scene().bodies[:1], supersampling=8)
    return ws.render(alone)[..., 3]


def test_the_exposure_is_as_uncertain_as_repetitions_say():
    known = result_of([Exposure()]).uncertainty
    clean = ws.render(scene())[..., :3].astype(np.float64)
    rng = np.random.default_rng(1)
    factors = [
        (clean * (clean + NOISE * rng.standard_normal(clean.shape))).sum() / (clean**2).sum() for _ in range(300)
    ]
    squares = [result_of([Exposure()], seed).uncertainty.stops[0] ** 2 for seed in range(8)]  # each by few tiles
    assert np.sqrt(np.mean(squares)) == pytest.approx(np.log2(factors).std(), rel=0.2)
    assert known.names == ["exposure.log[0]"] and known.light is None and not known.poses


def test_an_outline_does_not_tell_depth_and_a_plane_does(outline):
    free = result_of([KNOWN_TURN, OutlineOffset()], outlines={"egg": outline}, mask=np.eye(48, 64))
    standing = result_of(
        [Pose("egg", stands_on="table", resting="given"), OutlineOffset()],
        outlines={"egg": outline},
        mask=np.eye(48, 64),
    )
    lengths = []
    for result in (free, standing):
        (pose,) = result.uncertainty.poses.values()
        lengths.append(np.linalg.norm(pose.least))
        assert np.linalg.norm(pose.shift) >= 0.99 * lengths[-1]
        if result is free:
            assert pose.along_view > 0.9 and "along the view" in str(pose) and pose.is_flat
    assert lengths[1] < 0.5 * lengths[0]
    assert standing.uncertainty.deviations["outline_offset.offset[0]"] < 1  # less than the prior's


def test_a_free_light_leaves_less_curvature_to_a_pose():
    """As a projection does, it takes a part of each column away."""
    forms = []
    for free in ([Pose(0)], [Pose(0), Light(2)]):
        result = result_of(free)
        forms.append(NormalMatrix(result.problem, result.context, result.values).normal_matrix)
    assert np.linalg.eigvalsh(forms[0] - forms[1]).min() > -0.02 * np.linalg.eigvalsh(forms[0]).max()
    assert np.trace(forms[1]) < 0.99 * np.trace(forms[0])
    assert 0 < result_of([Pose(0), Light(2)]).uncertainty.light < 0.2


@pytest.mark.parametrize("rotation", ["axis-angle", "quaternion", "6d"])
@pytest.mark.parametrize("pose", [KNOWN_TURN, Pose("egg", covariance=[10.0] * 3 + [0.001] * 3)], ids=["shift", "turn"])
def test_starts_lie_along_the_direction_that_is_known_least(outline, pose, rotation):
    pose = dataclasses.replace(pose, rotation=rotation)
    result = result_of([pose, OutlineOffset()], outlines={"egg": outline}, mask=np.eye(48, 64))
    starts = candidates_along_flat_direction(result.problem, result.context, result.values, 4)
    (free, _), context, moves = result.problem.free, result.context, []
    first, origin, _ = free.moved(result.values[free.name], context)
    for start in starts:
        turned, middle, _ = free.moved(start[free.name], context)
        turn = Rotation.from_matrix((turned @ first.T).numpy()).as_rotvec()
        moves.append(np.concatenate([turn, (middle - origin).numpy() / context.extent(0)]))
    np.testing.assert_allclose(np.linalg.norm(moves, axis=1), CANDIDATE_SPACING * np.array([1, 1, 2, 2]), rtol=1e-2)
    np.testing.assert_allclose(moves[0], -moves[1], atol=1e-2 * CANDIDATE_SPACING)


@pytest.mark.parametrize("rotation", ["quaternion", "6d"])
def test_what_is_known_of_a_pose_does_not_depend_on_its_parameters(rotation):
    known, same = (result_of([Pose("egg", rotation=kind)]).uncertainty for kind in ("axis-angle", rotation))
    (pose,), (other,) = known.poses.values(), same.poses.values()
    np.testing.assert_allclose(other.shift, pose.shift, rtol=0.02)
    np.testing.assert_allclose(other.turn, pose.turn, rtol=0.02)
    np.testing.assert_allclose(other.least, pose.least * np.sign(pose.least @ other.least), rtol=0.02, atol=1e-5)
    assert max(same.deviations.values()) < 2 * max(known.deviations.values())


def test_the_summary_has_it_and_a_flat_direction_is_warned_of(tmp_path, outline):
    result = result_of([KNOWN_TURN, OutlineOffset()], outlines={"egg": outline}, mask=np.eye(48, 64))
    with pytest.warns(DiagnosticWarning, match="egg is uncertain by more than 2% of its size; known least: ±"):
        write_result(result, tmp_path)
    text = (tmp_path / "summary.toml").read_text()
    assert "[uncertainty]" in text and "along the view" in text
    from warpshadow.scene import toml_tables

    table = toml_tables.read(tmp_path / "summary.toml", "summary")["uncertainty"]
    np.testing.assert_allclose(table["egg"]["shift"], result.uncertainty.poses["egg"].shift)


@pytest.mark.parametrize("reduction", ["mean", "sum"])
@pytest.mark.parametrize("kind", ["l2", "huber", "geman-mcclure"])
def test_its_residuals_have_the_gradient_of_the_loss(kind, reduction):
    """So priors and light weigh against the images as in the fit."""
    where = scene()
    where = dataclasses.replace(where, bodies=where.bodies[:1])
    target = Target(ws.render(where) * np.array([0.8, 0.9, 1.1, 0.9], np.float32))
    loss = Loss(kind, delta=0.3, coverage=0.5, reduction=reduction)
    problem = Problem(where, target, [Exposure(), Pose(0, scale=True)], loss, still=None)
    context = problem.context(torch.device("cpu"))
    values = problem.start(context)
    values["pose[0]"]["log_scale"] += 0.1
    normal, model = NormalMatrix(problem, context, values), Model(problem, context, small_stage(problem))
    slopes = []
    for name, key, number in normal.parameter_entries:
        ends = []
        for step in (0.01, -0.01):
            values[name][key].view(-1)[number] += step
            ends.append(float(model.loss(values)[0]))
            values[name][key].view(-1)[number] -= step
        slopes.append((ends[0] - ends[1]) / 0.02)
    gradient = 2 * np.tensordot(normal.residuals, normal.columns, 4)
    slopes = normal.directions.T @ slopes
    np.testing.assert_allclose(gradient, slopes, atol=DIFFERENCE * np.abs(slopes).max())


def test_textures_alone_have_none():
    assert result_of([Light(2)]).uncertainty is None
