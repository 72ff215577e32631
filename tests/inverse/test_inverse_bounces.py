"""Fits to images with all light that bounces: with bounces they find what is there, and without they do not."""

import dataclasses

import numpy as np
import pytest
from test_bounces import PATHS, balls_on_red

import warpshadow as ws
from warpshadow.inverse import Albedo, Pose, Problem, Stage, Target, fit

DIRECTIONAL = ws.Visibility("directional")
FEW_RAYS = ws.Visibility("ray-traced", samples=256)

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def target() -> Target:
    """Traced along paths of up to 12 bounces."""
    return Target(ws.render(balls_on_red(PATHS, 12, size=48)))


def started(bounces: int, number: int, **changes) -> ws.Scene:
    """The scene with one body otherwise."""
    scene = balls_on_red(DIRECTIONAL, bounces, size=48)
    bodies = list(scene.bodies)
    bodies[number] = dataclasses.replace(bodies[number], **changes)
    return dataclasses.replace(scene, bodies=bodies)


@pytest.mark.parametrize("still", [FEW_RAYS, None], ids=["by rays", "by spheres"])
def test_an_albedo_is_found_where_light_bounces(still, target):
    """Without bounces it is 13% too bright, with two of them 1.9%."""
    true = balls_on_red(DIRECTIONAL, 0).bodies[0].albedo

    def error(bounces: int) -> float:
        problem = Problem(started(bounces, 0, albedo=(0.5, 0.5, 0.5)), target, Albedo(0), still=still)
        return abs(fit(problem, Stage(40, learning_rate=0.05)).scene.bodies[0].albedo / true - 1).max()

    assert error(2) < 0.03
    assert error(0) > 0.1


def test_a_pose_is_found_where_light_bounces(target):
    """Without bounces it is off by 0.021 of a ball of radius 0.35, with two of them by 0.001."""
    true = balls_on_red(DIRECTIONAL, 0).bodies[1].translation

    def error(bounces: int) -> float:
        start = started(bounces, 1, translation=(0.3, 0.45, 0.75))
        found = fit(Problem(start, target, Pose(1)), Stage(40, learning_rate=0.03))
        return float(np.linalg.norm(found.scene.bodies[1].translation - true))

    assert error(2) < 0.005
    assert error(0) > 0.015
