"""Models: the shortcut for light alone is the loss of the images."""

import dataclasses

import numpy as np
import pytest
import torch

import warpshadow as ws
from warpshadow.inverse import Albedo, Light, Loss, Pose, Problem, Target, fit
from warpshadow.inverse.model import LightModel, Model
from warpshadow.inverse.schedule import Stage
from warpshadow.inverse.variable_projection import make_model

CPU = torch.device("cpu")


def scene_of(view: int = 0, *, segments: int = 16) -> ws.Scene:
    ball = ws.Body(
        ws.icosphere(1.0, 2),
        albedo=(0.7, 0.5, 0.3),
        blockers=ws.Spheres([[-0.3, 0, 0], [0.3, 0, 0]], [0.8, 0.7]),
        translation=(0, 1, 0),
    )
    ground = ws.Body(ws.plane(8.0, segments), albedo=(0.6, 0.5, 0.4), blockers=0, receivers="vertex")
    camera = ws.Camera.look_at((3 * view, 3, 5), (0, 0.4, 0), size=(24, 16))
    light = np.zeros((9, 3))
    light[:2] = [[3, 3, 3], [1, 1, 0.5]]
    return ws.Scene((ball, ground), light, camera, ws.Visibility(directions=64), supersampling=1)


def lit_problem(light: Light, *, views: int = 1, channels: int = 3, **options) -> Problem:
    """Light that is to explain noise, of which some is masked out."""
    rng = np.random.default_rng(views)
    targets = [
        Target(rng.uniform(0, 1, (16, 24, channels)), rng.uniform(0, 1, (16, 24)), scene_of(view).camera)
        for view in range(views)
    ]
    return Problem(scene_of(), targets, light, **{"still": None} | options)


@pytest.mark.slow
@pytest.mark.parametrize("still", [None, ws.Visibility("ray-traced", samples=32)], ids=["spheres", "rays"])
@pytest.mark.parametrize("reduction", ["mean", "sum"])
@pytest.mark.parametrize("views", [1, 2])
@pytest.mark.parametrize("light", [Light(3, nonnegativity=0.5), Light(None, 32)], ids=["harmonics", "cells"])
def test_light_alone_has_the_loss_of_its_images_and_its_gradient(light, views, reduction, still):
    problem = lit_problem(light, views=views, channels=4, loss=Loss(reduction=reduction, coverage=0.3), still=still)
    context = problem.context(CPU)
    start = problem.start(context)
    generator = torch.Generator().manual_seed(0)
    results = []
    for model in (make_model(problem, context, Stage(scale=0.5)), Model(problem, context, Stage(scale=0.5))):
        generator.manual_seed(0)
        values = {
            name: {
                key: (t + 0.3 * torch.randn(t.shape, generator=generator)).requires_grad_() for key, t in own.items()
            }
            for name, own in start.items()
        }
        loss, _ = model.loss(values)
        loss.backward()
        results.append((loss.item(), *(tensor.grad for tensor in values["light"].values())))
    assert isinstance(make_model(problem, context, Stage()), LightModel)
    (short, short_gradient), (long, long_gradient) = results
    assert short == pytest.approx(long, rel=1e-5)
    assert (short_gradient - long_gradient).abs().max() < 1e-5 * long_gradient.abs().max()


def test_the_loss_of_light_that_explains_all_is_zero_and_never_much_below():
    """What is left is a difference of large numbers, whose sums over pixels float32 would leave at 1e-5."""
    scene = scene_of()
    scene = dataclasses.replace(scene, camera=scene.camera.resized(8))
    problem = Problem(scene, Target(ws.render(scene)[..., :3]), Light(3), still=None)
    context = problem.context(CPU)
    values = problem.start(context)
    short, _ = make_model(problem, context, Stage()).loss(values)
    long, _ = Model(problem, context, Stage()).loss(values)
    assert abs(long.item()) < 1e-11 and abs(short.item()) < 1e-11


@pytest.mark.parametrize(
    ("free", "options"),
    [([Light(3), Albedo(0)], {}), ([Light(3), Pose(0)], {}), ([Albedo(0)], {}), (Light(3), {"loss": Loss("l1")})],
)
def test_what_is_no_quadratic_form_of_light_is_computed_by_images(free, options):
    problem = Problem(scene_of(), Target(np.ones((16, 24, 3))), free, still=None, **options)
    assert type(make_model(problem, problem.context(CPU), Stage())) is Model


def test_small_images_of_moving_bodies_are_shaded_where_they_are_seen():
    """Where a coarse stage has fewer samples than vertices, light is evaluated at samples, for about the same image."""
    scene = scene_of(segments=128)
    problem = Problem(scene, Target(ws.render(scene)), Pose(0), still=None)
    context = problem.context(CPU)
    with torch.no_grad():
        image = Model(problem, context, Stage(scale=0.5)).images(problem.start(context))[0].numpy()
    half = dataclasses.replace(scene, camera=scene.camera.resized(0.5))
    by_pixel = tuple(dataclasses.replace(body, receivers="pixel") for body in scene.bodies)
    expected = ws.render(dataclasses.replace(half, bodies=by_pixel))
    assert np.abs(image - expected).max() < 3e-6 * expected.max()
    assert np.abs(image - ws.render(half)).mean() < 0.01 * expected.mean()


def test_a_fit_of_light_alone_lowers_its_loss():
    result = fit(lit_problem(Light(3)), [Stage(20, 0.05)])
    assert result.losses[0][-1] < result.losses[0][0]


def test_a_fit_has_grounds_block_as_its_scene_has_them():
    """As planes, not by spheres; the found scene is then lit alike."""
    scene = ws.Scene(
        [
            ws.Body(ws.icosphere(0.4, 2), translation=(0, 0.5, 0), blockers=ws.Spheres([[0, 0, 0]], [0.4])),
            ws.Body(ws.plane(3.0, 8)),
        ],
        ws.EnvironmentMap.constant(1.0, height=16),
        ws.Camera.look_at((0, 1.5, 3), (0, 0.4, 0), size=(24, 24)),
    )
    image = ws.render(scene)
    problem = Problem(scene, [Target(image)], [Pose(0)])
    context = problem.context(CPU)
    found = problem.fitted_scene(problem.start(context), context).scene
    np.testing.assert_allclose(ws.render(found), image, atol=1e-5)
