"""A light that is solved for at each geometry: it is the best one, and poses have the gradient of the loss with it."""

import dataclasses

import numpy as np
import pytest
import torch

import warpshadow as ws
from warpshadow.assets.basis import HarmonicBasis
from warpshadow.inverse import Albedo, Light, Loss, Pose, Problem, Stage, Target, fit
from warpshadow.inverse.model import Model
from warpshadow.inverse.variable_projection import ProjectedModel, make_model, nonnegative_least_squares

CPU = torch.device("cpu")
SOLVED = Stage(solves_light=True)
# Central differences of a float32 loss, whose soft shadows have corners in their second derivatives, over which edges
# pass pixels' centers: measured 3.2%; over 12 poses 3.4%, root mean square.
DIFFERENCE = 0.05
SIXTH_OF_A_PIXEL = 0.02
CELLS = Light(directions=64, smoothness=1e-3)


def scene(cells: int = 64) -> ws.Scene:
    mesh = ws.icosphere(1.0, 2)
    mesh = dataclasses.replace(mesh, positions=mesh.positions * (0.7, 1.0, 0.5))
    spheres = ws.Spheres(np.array([[0.0, 0.4, 0], [0, -0.4, 0]]), np.array([0.5, 0.5]))
    body = ws.Body(mesh, albedo=(0.7, 0.5, 0.3), blockers=spheres, rotation=(0, 20, 0), translation=(0, 1, 0))
    ground = ws.Body(ws.plane(8.0, 32), blockers=0, albedo=(0.6,) * 3)
    radiance = np.random.default_rng(0).uniform(0.2, 2.0, (cells, 3)) * (np.arange(cells) % 7 == 0)[:, None]
    light = ws.CellBasis(ws.fibonacci(cells)).to_map(radiance)
    camera = ws.Camera.look_at((1, 3, 4.5), (0, 0.6, 0), size=(40, 30))
    return ws.Scene((body, ground), light, camera, ws.Visibility(directions=64, softness=1.5))


def prepared(loss: Loss | None = None, free=None, **target):
    where = scene()
    image = ws.Renderer(where).render()[..., :3]
    problem = Problem(where, Target(np.asarray(image), **target), free or [CELLS, Pose(0)], loss or Loss(), still=None)
    context = problem.context(CPU)
    return problem, context, problem.start(context)


def test_the_least_squares_are_those_of_the_matrix():
    from scipy.optimize import nnls

    rng = np.random.default_rng(1)
    matrix, wanted = rng.normal(size=(40, 12)), rng.normal(size=40)
    expected, _ = nnls(matrix, wanted)
    assert (expected == 0).any()
    np.testing.assert_allclose(nonnegative_least_squares(matrix.T @ matrix, matrix.T @ wanted), expected, atol=1e-4)
    assert not nonnegative_least_squares(np.zeros((3, 3)), np.zeros(3)).any()


@pytest.mark.parametrize("loss", [Loss(), Loss("huber"), Loss("geman-mcclure", 0.3)], ids=lambda loss: loss.kind)
def test_no_light_beside_the_solution_has_a_lower_loss(loss):
    problem, context, values = prepared(loss)
    target = problem.targets[0].image
    target[5:12, 4:9] += 2.0  # that no light explains
    model = ProjectedModel(problem, context, SOLVED)
    least = float(model.loss(values)[0])
    plain, solution = Model(problem, context, Stage()), values["light"]["log_radiance"].clone()
    for seed in range(4):
        noise = torch.randn(solution.shape, generator=torch.Generator().manual_seed(seed))
        values["light"]["log_radiance"] = solution + 0.3 * noise
        assert float(plain.loss(values)[0].detach()) > least - 1e-3 * abs(least)


@pytest.mark.parametrize("loss", [Loss(), Loss("huber")], ids=lambda loss: loss.kind)
def test_the_gradient_is_that_of_the_loss_at_the_best_light(loss):
    problem, context, values = prepared(loss, [CELLS, Pose(0, stands_on=1, resting="given")])
    model = ProjectedModel(problem, context, SOLVED)
    values["pose[0]"]["shift"] += torch.tensor([0.05, -0.04])
    shift = values["pose[0]"]["shift"].requires_grad_()
    model.loss(values)[0].backward()
    for number in range(2):
        losses = []
        for step in (0.01, -0.01):
            with torch.no_grad():
                shift[number] += step
                losses.append(float(model.loss(values)[0]))
                shift[number] -= step
        slope = (losses[0] - losses[1]) / 0.02
        assert abs(float(shift.grad[number]) - slope) < DIFFERENCE * float(shift.grad.abs().max())


def test_light_in_harmonics_is_the_projection_of_one_that_is_nowhere_negative():
    problem, context, values = prepared(free=[Light(4), Pose(0)])
    with torch.no_grad():
        before = float(Model(problem, context, Stage()).loss(values)[0])
    model = ProjectedModel(problem, context, SOLVED)
    loss, _ = model.loss(values)
    assert float(loss.detach()) < before
    assert model.solution.min() >= 0
    towards = ws.fibonacci(len(model.solution))
    expected = 4 * np.pi / len(towards) * HarmonicBasis(4).functions(towards).T @ model.solution
    found = values["light"]["coefficients"].numpy() * np.sqrt(4 * np.pi)
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_saturated_pixels_are_a_lower_bound_of_the_light():
    problem, context, _ = prepared()
    image = problem.targets[0].image
    clipped = np.minimum(image / (0.6 * image.max()), 1)
    totals = []
    for target in (Target(clipped, saturation=1.0), Target(clipped)):
        one_problem = dataclasses.replace(problem, targets=[target])
        own = one_problem.start(context)
        ProjectedModel(one_problem, context, SOLVED).loss(own)
        totals.append(float(own["light"]["log_radiance"].exp().sum()))
    assert totals[0] > totals[1] * 1.02


def test_a_pose_is_found_beside_a_light_and_a_color_that_are_unknown():
    truth = scene()
    image = np.asarray(ws.Renderer(truth).render()[..., :3])
    start = dataclasses.replace(truth.bodies[0], translation=(0.15, 1.0, -0.1), albedo=(0.5,) * 3)
    start = dataclasses.replace(truth, bodies=(start, truth.bodies[1]), light=ws.EnvironmentMap.constant(1.0))
    free = [CELLS, Pose(0, stands_on=1, resting="given"), Albedo(0)]
    problem = Problem(start, Target(image), free, still=None)
    result = fit(problem, [Stage(30, 0.03, solves_light=True)], progress=False)
    away = np.array(result.scene.bodies[0].translation) - truth.bodies[0].translation
    assert np.linalg.norm(away) < SIXTH_OF_A_PIXEL
    np.testing.assert_allclose(result.scene.bodies[0].albedo, truth.bodies[0].albedo, rtol=0.3)
    with torch.no_grad():  # the light that is returned is that of the pose that is returned
        best = float(Model(problem, result.context, Stage()).loss(result.values)[0])
    assert best <= min(result.losses[-1]) * 1.001


def test_a_stage_that_solves_for_light_needs_a_free_one_and_another_parameter():
    with pytest.raises(ValueError, match=r"stages\[0\]: got solves_light where light is not free"):
        fit(Problem(scene(), Target(np.ones((30, 40, 3))), Pose(0)), [SOLVED])
    for stages in ([SOLVED], "photograph"):
        with pytest.raises(ValueError, match=r"stages\[0\]: got solves_light where light alone is free, exp"):
            fit(Problem(scene(), Target(np.ones((30, 40, 3))), CELLS), stages)
    problem, context, _ = prepared()
    assert isinstance(make_model(problem, context, SOLVED), ProjectedModel)
