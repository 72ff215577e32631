"""Warnings of fits that ended: pixels without a body, wrong exposure, and light that has not converged."""

import dataclasses
import re
import warnings

import numpy as np
import pytest
import torch

import warpshadow as ws
from warpshadow.inverse import Albedo, DiagnosticWarning, Exposure, Light, Pose, Problem, Stage, Target, Texture, fit
from warpshadow.inverse.diagnostics import gain_of_last


def scene(size: float = 4.0) -> ws.Scene:
    ground = ws.Body(ws.plane(size, 4), blockers=0)
    camera = ws.Camera.look_at((0, 4, 0.1), (0, 0, 0), fov_y=40, size=(16, 16))
    light = np.zeros((4, 3))
    light[0], light[1] = 3.0, 1.0
    return ws.Scene((ground,), light, camera, ws.Visibility("none"))


def messages(problem: Problem, stage: Stage) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fit(problem, [stage], progress=False)
    return [str(item.message) for item in caught if item.category is DiagnosticWarning]


def test_pixels_that_see_no_body_are_told():
    small = scene(2.0)
    seen = ws.render(small)
    share = 1 - seen[..., 3].mean()
    assert 0.3 < share < 0.7
    stage = Stage(3, 0.05)
    (message,) = messages(Problem(small, Target(seen[..., :3] + 0.1), Light(2)), stage)
    assert abs(float(message.split("%")[0]) / 100 - share) < 0.1 and "of the counted pixels see no body" in message
    mask = seen[..., 3] == 1
    assert not messages(Problem(small, Target(seen[..., :3], mask), Light(2)), stage)
    assert not messages(Problem(small, Target(seen), Light(2)), stage)  # its coverage is compared


def test_a_texture_that_may_keep_a_shadow_is_told():
    ball = ws.Body(ws.icosphere(0.4, 1), translation=(0, 0.4, 0), name="ball", blockers=8)
    both = dataclasses.replace(scene(), bodies=[dataclasses.replace(scene().bodies[0], name="ground"), ball])
    target, moved, painted = Target(ws.render(both)[..., :3]), Pose("ball"), Texture("ground", (4, 4))
    (message,) = messages(Problem(both, target, [moved, painted]), Stage(1, 0.05))
    assert message.startswith("the texture of 'ground' is free beside the pose of 'ball'")
    for free in ([moved], [painted], [moved, dataclasses.replace(painted, palette=1.0)]):
        assert not any("is free beside" in text for text in messages(Problem(both, target, free), Stage(1, 0.05)))


def test_light_exposure_and_all_albedos_are_not_told_apart():
    target, free = Target(ws.render(scene())[..., :3]), [Light(2), Exposure(), Albedo(0)]
    told = [text for text in messages(Problem(scene(), target, free), Stage(1, 0.05)) if text.startswith("free:")]
    assert len(told) == 1 and "got light, exposure and the reflectance of all bodies" in told[0]
    for left_out in range(3):
        known = Problem(scene(), target, free[:left_out] + free[left_out + 1 :])
        assert not any(text.startswith("free:") for text in messages(known, Stage(1, 0.05)))


def test_light_that_has_not_converged_is_told():
    problem = Problem(scene(), Target(np.full((16, 16, 3), 5.0)), Light(None, 64))
    assert "light has not converged" in messages(problem, Stage(40, 1e-2))[0]
    assert not messages(Problem(scene(), Target(ws.render(scene())[..., :3]), Light(2)), Stage(60, 0.05))


@pytest.mark.parametrize(("losses", "gain"), [([1.0] * 30, 0.0), ([2.0] * 10 + [1.0] * 10, 0.5), ([9.0, 1.0], 0.0)])
def test_the_gain_is_that_of_the_last_iterations(losses, gain):
    assert gain_of_last(losses) == pytest.approx(gain)


def test_light_is_kept_from_being_negative_by_default():
    setting = Problem(scene(), Target(np.ones((16, 16, 3))), Light(2)).setting(torch.device("cpu"))
    values = Light(2).start(setting)
    assert float(Light(2).regularizer(values, setting)) == 0
    values["coefficients"][1] = 5.0
    assert float(Light(2).regularizer(values, setting)) > 0.01


@pytest.mark.parametrize("is_found", [False, True])
def test_images_that_are_explained_poorly_are_told(is_found):
    """A red ball is moved, or left where it is, on the other side of the ground."""
    ball = ws.Body(ws.icosphere(0.5, 2), albedo=(0.7, 0.1, 0.1), blockers=4, translation=(0.9, 0.5, 0))
    other = dataclasses.replace(ball, translation=(-0.9 if not is_found else 0.8, 0.5, 0))
    truth, start = (dataclasses.replace(scene(), bodies=(body, *scene().bodies)) for body in (ball, other))
    problem = Problem(start, Target(ws.render(truth)[..., :3]), Pose(0))
    told = messages(problem, Stage(60 if is_found else 1, 0.01))
    assert len(told) == (not is_found)
    for text in told:
        error = float(re.search(r"images are off by (\d+)% of their root mean square", text)[1]) / 100
        image, target = ws.render(start)[..., :3], ws.render(truth)[..., :3]
        assert error == pytest.approx(np.linalg.norm(image - target) / np.linalg.norm(target), abs=0.05)


@pytest.mark.parametrize("stops", [-1.65, 0.0])
def test_an_exposure_that_differs_from_the_light_is_told(stops):
    ball = ws.Body(ws.icosphere(0.5, 2), albedo=(0.7, 0.3, 0.2), blockers=4, translation=(0.3, 0.5, 0))
    problem_scene = dataclasses.replace(scene(), bodies=(ball, *scene().bodies))
    target = Target(2**stops * ws.render(problem_scene)[..., :3])
    told = messages(Problem(problem_scene, target, Pose(0)), Stage(20, 0.02))
    assert len(told) == (stops != 0)
    for text in told:
        assert "targets[0] is" in text and "set exposure = true" in text
        assert abs(float(re.search(r"exposure = (\S+) \[stops\]", text)[1]) - stops) < 0.1
    assert not messages(Problem(problem_scene, target, [Pose(0), Exposure()]), Stage(80, 0.05))
