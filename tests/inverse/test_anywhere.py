"""Poses of which nothing is known: where the search for them starts, and that it finds them."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import warpshadow as ws
from demos import shapes
from warpshadow.inverse import Pose, Problem, Stage, Target, fit
from warpshadow.inverse.anywhere import candidates_anywhere
from warpshadow.inverse.model import Model

LETTER = ws.Body(shapes.letter("R"), albedo=(0.8, 0.3, 0.1), blockers=0, name="letter").on_ground(size=1)
GROUND = ws.Body(ws.plane(60.0), albedo=(0.4, 0.4, 0.4), blockers=0, name="ground")
CAMERA = ws.Camera.look_at((0, 2.5, 4), (0, 0.3, 0), fov_y=45, size=(48, 48))
START = ws.Scene([LETTER, GROUND], ws.synthetic_sky(height=16), CAMERA, ws.Visibility("none"))


def moved(turn: Rotation, shift: tuple[float, float, float]) -> ws.Body:
    rotation = (turn * Rotation.from_rotvec(LETTER.rotation, degrees=True)).as_rotvec(degrees=True)
    return dataclasses.replace(LETTER, rotation=rotation, translation=np.asarray(LETTER.translation) + shift)


def problem_of(truth: ws.Body, free: Pose) -> Problem:
    image = ws.render(dataclasses.replace(START, bodies=[truth, GROUND]))
    return Problem(START, Target(image[..., :3]), free)


def drawn_bodies(problem: Problem, count: int, seed: int = 0) -> list[ws.Body]:
    context = problem.context(torch.device("cpu"))
    model = Model(problem, context, Stage(scale=0.5))
    values = candidates_anywhere(model, problem.start(context), count, seed)
    return [problem.fitted_scene(each, context).scene.bodies[0] for each in values]


def middle(body: ws.Body) -> np.ndarray:
    return np.mean(body.world_mesh().bounds, axis=0)


ASIDE = moved(Rotation.from_rotvec([0, 150, 0], degrees=True), (1.0, 0.0, -0.7))


@pytest.mark.parametrize("rotation", ["axis-angle", "quaternion", "6d"])
def test_starts_are_turned_evenly_and_are_seen_where_the_target_differs(rotation):
    problem = problem_of(ASIDE, Pose("letter", rotation=rotation))
    bodies = drawn_bodies(problem, 200)
    matrices = np.stack([body.rotation_matrix() for body in bodies])
    assert np.abs(matrices.mean(axis=0)).max() < 0.15  # 0 of uniform rotations; the deviation of the mean is 0.04
    assert np.trace(matrices, axis1=1, axis2=2).mean() == pytest.approx(0, abs=0.3)
    pixels = CAMERA.project(np.stack([middle(body) for body in bodies]))
    gap = np.linalg.norm(pixels - CAMERA.project(middle(ASIDE)[None]), axis=1)
    assert np.median(gap) < 4 and np.linalg.norm(CAMERA.project(middle(LETTER)[None]) - pixels, axis=1).min() > 4
    again, other = drawn_bodies(problem, 2), drawn_bodies(problem, 2, seed=1)
    np.testing.assert_array_equal(bodies[1].translation, again[1].translation)
    assert not np.allclose(bodies[1].translation, other[1].translation)


def test_a_body_that_stands_starts_upright_on_its_plane_at_even_angles():
    bodies = drawn_bodies(problem_of(ASIDE, Pose("letter", stands_on="ground", resting="given")), 16)
    ups = np.stack([body.rotation_matrix() @ LETTER.rotation_matrix().T @ (0, 1, 0) for body in bodies])
    np.testing.assert_allclose(ups, np.tile([0, 1, 0], (16, 1)), atol=1e-5)
    np.testing.assert_allclose([body.world_points()[:, 1].min() for body in bodies], 0, atol=1e-5)
    turned = [body.rotation_matrix() @ LETTER.rotation_matrix().T for body in bodies]
    angles = np.sort([np.arctan2(turn[0, 2], turn[0, 0]) for turn in turned])
    assert np.diff(angles, append=angles[0] + 2 * np.pi).max() < 2 * np.pi / 8


@pytest.mark.slow
def test_a_pose_of_which_nothing_is_known_is_found():
    problem = problem_of(ASIDE, Pose("letter", stands_on="ground", resting="given"))
    result = fit(problem, "unknown-pose", progress=False)
    assert result.verdict.is_explained
    found = result.scene.bodies[0].world_points()
    assert np.linalg.norm(found - ASIDE.world_points(), axis=1).max() < 0.02
