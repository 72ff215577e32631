"""A free lamp: where it is put, how it is solved for, and that a photograph's near lamp is found."""

import dataclasses

import numpy as np
import pytest
import torch

import warpshadow as ws
from warpshadow.inverse import Albedo, Emission, Lamp, Light, Pose, Problem, Stage, Target, fit, photograph_stages
from warpshadow.inverse.model import Model
from warpshadow.inverse.uncertainty import NormalMatrix
from warpshadow.inverse.variable_projection import ProjectedModel

CPU = torch.device("cpu")
SOLVED = Stage(solves_light=True)
CELLS = Light(directions=32, smoothness=1e-3)
PLACE = np.array([1.8, 3.8, 0.9])  # out of view
SMALL_ANGLE = 3.0  # degrees by which the lamp is off from a start 60° away. Measured 0.3.
CELL_LIGHT = 0.01  # relative L2 of an image in cells of light against one in the map. Measured 0.004.
DIFFERENCE = 0.05  # of gradients against central differences of a float32 loss

BODY = ws.Body(
    dataclasses.replace(ws.icosphere(1.0, 2), positions=ws.icosphere(1.0, 2).positions * np.float32([0.7, 1.0, 0.5])),
    albedo=(0.7, 0.5, 0.3),
    blockers=ws.Spheres(np.array([[0.0, 0.4, 0], [0, -0.4, 0]]), np.array([0.5, 0.5])),
    translation=(0, 1, 0),
    name="body",
)
GROUND = ws.Body(ws.plane(8.0, 32), blockers=0, albedo=(0.6,) * 3, name="ground")
LAMP = ws.Body(
    ws.icosphere(0.3, 1), emission=(30, 24, 18), albedo=(0, 0, 0), blockers=0, translation=PLACE, name="lamp"
)


def scene(*bodies: ws.Body) -> ws.Scene:
    camera = ws.Camera.look_at((1, 4, 4.5), (0, 0.4, 0), size=(40, 30))
    light = ws.EnvironmentMap.constant(0.4)
    return ws.Scene(bodies or (BODY, GROUND, LAMP), light, camera, ws.Visibility(directions=32), supersampling=1)


@pytest.fixture(scope="module")
def photograph() -> np.ndarray:
    return np.asarray(ws.Renderer(scene()).render()[..., :3])


def problem(image: np.ndarray, *free, start: ws.Scene | None = None) -> Problem:
    return Problem(start or scene(), Target(image), free or (CELLS, Lamp("lamp"), Emission("lamp")), still=None)


def placed(one: Problem, values: dict) -> ws.Body:
    context = one.context(CPU)
    return one.fitted_scene(values, context).scene.bodies[2]


def test_a_lamp_starts_where_the_scene_has_it(photograph):
    one = problem(photograph)
    lamp = placed(one, one.start(one.context(CPU)))
    np.testing.assert_allclose(lamp.translation, PLACE, atol=1e-4)
    assert lamp.scale == pytest.approx(1)


def test_a_lamp_keeps_its_size_as_seen_from_the_middle(photograph):
    one = problem(photograph)
    values = one.start(one.context(CPU))
    values["lamp[2]"]["turn"] += torch.tensor([0.1, -0.2])
    values["lamp[2]"]["log_distance"] += 0.15
    lamp = placed(one, values)
    distance, start = (np.linalg.norm(np.subtract(place, (0, 1, 0))) for place in (lamp.translation, PLACE))
    assert distance > 1.5 * start
    assert lamp.scale / distance == pytest.approx(1 / start, rel=1e-4)
    moved = Model(one, one.context(CPU), Stage()).images(values)[0].numpy()
    expected = ws.Renderer(scene(BODY, GROUND, lamp)).render()
    assert np.linalg.norm(moved - expected) < CELL_LIGHT * np.linalg.norm(expected)
    assert np.linalg.norm(moved[..., :3] - photograph) > 0.1 * np.linalg.norm(photograph)


def test_searches_start_all_over_the_upper_hemisphere(photograph):
    one = problem(photograph)
    context = one.context(CPU)
    lamp, start = Lamp(2), one.start(context)
    towards = []
    for number in range(Lamp.relocation_count):
        body = placed(one, start | {"lamp[2]": lamp.relocated(start["lamp[2]"], context, number)})
        offset = np.subtract(body.translation, (0, 1, 0))
        assert np.linalg.norm(offset) == pytest.approx(np.linalg.norm(PLACE - (0, 1, 0)), rel=1e-3)
        towards.append(offset / np.linalg.norm(offset))
    cosines = np.array(towards) @ np.array(towards).T - 2 * np.eye(Lamp.relocation_count)
    assert min(direction[1] for direction in towards) > 0
    assert np.degrees(np.arccos(cosines.max())) > 30


def test_the_gradient_of_a_place_is_that_of_the_loss_at_the_best_light_and_emission(photograph):
    one = problem(photograph)
    context = one.context(CPU)
    values = one.start(context)
    values["lamp[2]"]["turn"] += torch.tensor([0.03, 0.02])
    model = ProjectedModel(one, context, SOLVED)
    places = values["lamp[2]"]
    for tensor in places.values():
        tensor.requires_grad_()
    model.loss(values)[0].backward()
    gradients, slopes = [], []
    for tensor in places.values():
        for number in range(tensor.numel()):
            losses = []
            for step in (0.004, -0.004):
                with torch.no_grad():
                    tensor.view(-1)[number] += step
                    losses.append(float(model.loss(values)[0]))
                    tensor.view(-1)[number] -= step
            gradients.append(float(tensor.grad.view(-1)[number]))
            slopes.append((losses[0] - losses[1]) / 0.008)
    np.testing.assert_allclose(gradients, slopes, atol=DIFFERENCE * np.abs(slopes).max())


def test_emission_of_one_color_is_solved_for_beside_the_map(photograph):
    dim = dataclasses.replace(LAMP, emission=(2, 2, 2))
    one = problem(photograph, start=scene(BODY, GROUND, dim))
    context = one.context(CPU)
    values = one.start(context)
    model = ProjectedModel(one, context, SOLVED)
    with torch.no_grad():
        model.solve(values)
        least = float(model.loss(values)[0])
    fitted = one.fitted_scene(values, context).scene
    np.testing.assert_allclose(fitted.bodies[2].emission, LAMP.emission, rtol=0.05)
    assert fitted.light.radiance.mean() == pytest.approx(0.4, rel=0.1)
    plain, solution = Model(one, context, Stage()), values["emission[2]"]["radiance"].clone()
    for factor in (0.9, 1.1):
        values["emission[2]"]["radiance"] = factor * solution
        assert float(plain.loss(values)[0]) > 1.5 * least


def test_a_lamp_that_is_not_free_is_taken_as_it_is(photograph):
    second = dataclasses.replace(LAMP, translation=(-2, 2.5, 0.5), emission=(12, 12, 20), name="second")
    both = scene(BODY, GROUND, LAMP, second)
    image = np.asarray(ws.Renderer(both).render()[..., :3])
    one = problem(image, CELLS, Emission("lamp"), start=both)
    context = one.context(CPU)
    values = one.start(context)
    with torch.no_grad():
        ProjectedModel(one, context, SOLVED).solve(values)
    np.testing.assert_allclose(one.fitted_scene(values, context).scene.bodies[2].emission, LAMP.emission, rtol=0.05)


def test_what_is_solved_for_is_not_among_the_uncertain_numbers(photograph):
    one = problem(photograph)
    normal = NormalMatrix(one, one.context(CPU), one.start(one.context(CPU)))
    assert {name for name, _, _ in normal.parameter_entries} == {"lamp[2]"}
    without_map = problem(photograph, Lamp("lamp"), Emission("lamp"))
    normal = NormalMatrix(without_map, one.context(CPU), without_map.start(one.context(CPU)))
    assert {name for name, _, _ in normal.parameter_entries} == {"lamp[2]", "emission[2]"}


def test_a_near_lamp_is_found_from_straight_above_beside_pose_color_and_map(photograph):
    body = dataclasses.replace(BODY, translation=(0.15, 1.0, -0.1), albedo=(0.5,) * 3)
    lamp = dataclasses.replace(LAMP, translation=(0, 6, 0), emission=(5, 5, 5))
    start = dataclasses.replace(scene(body, GROUND, lamp), light=ws.EnvironmentMap.constant(1.0))
    free = CELLS, Lamp("lamp"), Emission("lamp"), Pose("body", stands_on="ground", resting="given"), Albedo("body")
    outlined = Target(photograph, outlines={"body": ws.Renderer(scene(BODY)).render()[..., 3]})
    one = Problem(start, outlined, free, still=None)
    stages = photograph_stages(one)
    assert [stage.scatter for stage in stages[3:]] == ["lamps", "flat", "turned"]
    result = fit(one, stages, progress=False)
    assert (
        len(result.losses) >= 3 + 1 + Lamp.relocation_count + 1
    )  # of all directions, also after an outline that stood out
    offset, true = (np.subtract(place, (0, 1, 0)) for place in (result.scene.bodies[2].translation, PLACE))
    cosine = offset @ true / np.linalg.norm(offset) / np.linalg.norm(true)
    assert np.degrees(np.arccos(cosine)) < SMALL_ANGLE
    assert np.linalg.norm(offset) == pytest.approx(np.linalg.norm(true), rel=0.15)
    assert np.linalg.norm(np.subtract(result.scene.bodies[0].translation, BODY.translation)) < 0.02


def test_bodies_that_do_not_emit_are_no_lamps(photograph):
    with pytest.raises(ValueError, match=r"free\[0\]: body: got 0, which does not emit"):
        problem(photograph, Lamp("body"))
    with pytest.raises(ValueError, match="a scene of lamps alone"):
        problem(photograph, Lamp("lamp"), start=scene(LAMP))
    with pytest.raises(ValueError, match=r"got pose\[2\] and lamp\[2\]"):
        problem(photograph, CELLS, Lamp("lamp"), Pose("lamp"))
