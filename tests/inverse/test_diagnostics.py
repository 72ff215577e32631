"""Warnings of fits that ended: pixels without a body, wrong exposure, and light that has not converged."""

import dataclasses
import re
import warnings

import numpy as np
import pytest
import torch

import warpshadow as ws
from warpshadow.inverse import (
    Albedo,
    DiagnosticWarning,
    Emission,
    Exposure,
    Light,
    Pose,
    Problem,
    Stage,
    Sun,
    Target,
    Texture,
    fit,
)
from warpshadow.inverse.diagnostics import gain_of_last, warn_before
from warpshadow.inverse.model import Model
from warpshadow.inverse.verdict import explained_shares


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


LAMP = ws.Body(ws.icosphere(0.2, 1), emission=(5, 5, 5), translation=(0, 1, 0), blockers=0)
BALL = ws.Body(ws.icosphere(0.4, 1), translation=(0, 0.4, 0), blockers=8)
BLACK = ws.EnvironmentMap.constant(0.0)
SUN = Sun((0, 1, 0.2), 3.0)


@pytest.mark.parametrize(
    ("free", "factors", "bodies", "changes"),
    [
        ([Light(2)], "", [], {}),
        ([Light(2), Exposure()], "light and exposure", [], {}),
        ([Light(2), Exposure(reference=0)], "", [], {}),
        ([Light(2), Albedo(0)], "light and the reflectance of all bodies", [], {}),
        ([Light(2), Texture(0, (4, 4))], "light and the reflectance of all bodies", [], {}),
        ([Exposure(), Albedo(0)], "exposure and the reflectance of all bodies", [], {}),
        ([Light(2), Exposure(), Albedo(0)], "light and exposure and the reflectance of all bodies", [], {}),
        ([Light(2), Albedo(0)], "", [BALL], {}),  # whose albedo is known
        ([Light(2), Albedo(0)], "light and .*", [dataclasses.replace(BALL, translation=(50, 0, 0))], {}),  # not seen
        ([Light(2), Albedo(0), Albedo(1)], "light and the reflectance of all bodies", [BALL], {}),
        ([Light(2), Albedo(0), Albedo(1)], "", [dataclasses.replace(BALL, roughness=0.3)], {}),  # reflects 4% more
        ([Light(2), Albedo(0), Albedo(1)], "", [BALL], {"bounces": 1, "visibility": ws.Visibility()}),
        ([Light(2), Exposure()], "", [LAMP], {}),  # whose radiance is known
        ([Light(2), Emission(1), Exposure()], "light and exposure", [LAMP], {}),
        ([Emission(1), Exposure()], "light and exposure", [LAMP], {"light": BLACK}),
        ([Emission(1), Albedo(0), Albedo(1)], "", [LAMP], {"light": BLACK}),  # the lamp itself is seen
        ([SUN, Exposure()], "", [], {"light": ws.EnvironmentMap.constant(1.0)}),
        ([SUN, Exposure()], "light and exposure", [], {"light": BLACK}),
    ],
)
def test_free_factors_of_all_images_are_told_and_no_others(free, factors, bodies, changes):
    where = dataclasses.replace(scene(), bodies=[*scene().bodies, *bodies], **changes)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warn_before(Problem(where, Target(np.ones((16, 16, 3))), free))
    told = [str(item.message) for item in caught]
    assert len(told) == bool(factors)
    for text in told:
        assert re.match(f"free: got {factors}, expected all but one of them to be known: .*; leave out", text)


def test_a_fit_says_before_it_begins_that_its_scale_is_not_told_and_a_reference_tells_it():
    image = ws.render(scene())[..., :3]
    targets = [Target(image), Target(2 * image)]
    stage = Stage(60, 0.05)
    told = messages(Problem(scene(), targets, [Light(2), Exposure()]), stage)
    assert any(text.startswith("free: got light and exposure") for text in told)
    known = Problem(scene(), targets, [Light(2), Exposure(reference=0)])
    assert not any(text.startswith("free:") for text in messages(known, stage))
    result = fit(known, [stage], progress=False)
    assert result.found.exposures[0] == 1 and result.found.exposures[1] == pytest.approx(2, rel=0.02)
    with pytest.raises(ValueError, match="reference: got 2, expected the number of a view, from 0 to 1"):
        Problem(scene(), targets, Exposure(reference=2))


def test_light_that_has_not_converged_is_told():
    problem = Problem(scene(), Target(np.full((16, 16, 3), 5.0)), Light(None, 64))
    (told,) = messages(problem, Stage(40, 1e-2))
    assert "light has not converged" in told and "or a learning_rate of 0.2" in told
    assert not messages(problem, Stage(200, 0.2))
    with pytest.raises(ValueError, match="light alone is free"):  # which beside a pose is the other remedy
        fit(problem, "photograph", progress=False)
    assert not messages(Problem(scene(), Target(ws.render(scene())[..., :3]), Light(2)), Stage(60, 0.05))


@pytest.mark.parametrize(("losses", "gain"), [([1.0] * 30, 0.0), ([2.0] * 10 + [1.0] * 10, 0.5), ([9.0, 1.0], 0.0)])
def test_the_gain_is_that_of_the_last_iterations(losses, gain):
    assert gain_of_last(losses) == pytest.approx(gain)


def test_light_is_kept_from_being_negative_by_default():
    context = Problem(scene(), Target(np.ones((16, 16, 3))), Light(2)).context(torch.device("cpu"))
    values = Light(2).start(context)
    assert float(Light(2).regularizer(values, context)) == 0
    values["coefficients"][1] = 5.0
    assert float(Light(2).regularizer(values, context)) > 0.01


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


SMALL = dataclasses.replace(BALL, scale=0.4, translation=(0.9, 0.16, 0), albedo=(0.7, 0.1, 0.1), name="ball")


def at(*bodies: ws.Body) -> ws.Scene:
    camera = scene().camera.resized(2)
    return dataclasses.replace(scene(), bodies=(*bodies, *scene().bodies), camera=camera, visibility=ws.Visibility())


def shares(start: ws.Scene, target: np.ndarray, **options) -> dict[int, float]:
    problem = Problem(start, Target(target, **options), Pose(0))
    context = problem.context(torch.device("cpu"))
    model, values = Model(problem, context, Stage()), problem.start(context)
    return explained_shares(model, values, model.images(values))


def test_a_body_is_explained_where_targets_show_it_and_its_shadow():
    target = ws.Renderer(at(SMALL)).render()
    noise = np.random.default_rng(0).normal(scale=0.02, size=target.shape)
    assert shares(at(SMALL), target + noise) == pytest.approx({0: 1.0}, abs=0.02)
    moved = [dataclasses.replace(SMALL, translation=(0.9 - shift, 0.16, 0)) for shift in (0.1, 0.3, 1.5, 90)]
    one, two, three, four = (shares(at(body), target)[0] for body in moved)
    assert 0.9 > one > two > three and two < 0.3 and three == four == 0  # the last is out of the frame
    occluder = target.copy()
    change = np.linalg.norm(target - ws.Renderer(at()).render(), axis=-1)
    occluder[np.unravel_index(change.argmax(), change.shape)] = 5.0
    assert 0.85 < shares(at(SMALL), occluder)[0] < 1.0


def test_a_body_with_outlines_is_explained_by_them_alone():
    outlines = {0: np.reshape(ws.Renderer(at(SMALL)).layers().masks, (-1, 32, 32))[0]}
    moved = [dataclasses.replace(SMALL, translation=(0.9 - shift, 0.16, 0)) for shift in (0.0, 0.1, 1.5)]
    one, two, three = (shares(at(body), np.ones((32, 32, 3)), outlines=outlines)[0] for body in moved)
    assert one > 0.9 and 0.3 < two < 0.8 and three == pytest.approx(0, abs=0.02)


def test_residuals_that_are_as_large_elsewhere_tell_nothing_of_a_body():
    target = ws.Renderer(at(SMALL)).render()
    pattern = np.where(np.indices((32, 32)).sum(axis=0) % 2, 1.0, -1.0)[..., None] * [0.3, 0.3, 0.3, 0]
    assert shares(at(SMALL), target + pattern) == pytest.approx({0: 1.0}, abs=0.05)


def test_a_small_body_in_a_wrong_place_is_told_and_its_uncertainty_says_so():
    """Though it is so small that the whole image is explained."""
    start, target = at(dataclasses.replace(SMALL, translation=(-0.9, 0.16, 0))), ws.Renderer(at(SMALL)).render()
    problem = Problem(start, Target(target), Pose("ball"))
    (told,) = messages(problem, Stage(1, 1e-3))
    assert "images are off by 1" in told and "and targets show 0% of 'ball', shadows included; a pose may be" in told
    with pytest.warns(DiagnosticWarning):
        result = fit(problem, [Stage(1, 1e-3)], progress=False)
    assert str(result.uncertainty.poses["ball"]).endswith(
        "but targets show 0% of it and its shadow: it may be elsewhere"
    )
    found = fit(dataclasses.replace(problem, scene=at(SMALL)), [Stage(1, 1e-3)], progress=False)
    assert "elsewhere" not in str(found.uncertainty.poses["ball"])


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
