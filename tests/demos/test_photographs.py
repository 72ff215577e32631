"""The photographs whose truth is known: what lies beside their script is what it says."""

import dataclasses

import numpy as np
import pytest

import warpshadow as ws
from demos.examples.photographs.cases import BODY, CASES, alone
from demos.examples.photographs.table import LAMP, lamp_error, problem, relighting_error

SCALED = 1e-3  # relative L2 of an image in twice the light, scaled


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_painted_outlines_are_those_of_the_truth_to_a_pixel_or_so(case):
    (target, larger, smaller), truth = (case.target(n, moves_outlines=False) for n in (0, 1, -1)), case.truth()
    assert abs(truth.bodies[0].world_mesh().bounds[0][1]) < 1e-5  # it stands on the table
    body = ws.render(alone(truth, 0))[..., 3] > 0.5
    painted = target.outlines[BODY] > 0.5
    assert (body & painted).sum() / (body | painted).sum() > 0.93
    assert (painted != body).any()
    assert larger.outlines[BODY].sum() > target.outlines[BODY].sum() > smaller.outlines[BODY].sum()
    assert 0.3 < (target.mask > 0).mean() < 0.95


def test_near_lamps_are_as_far_as_they_are_called_and_light_the_bodies_as_much():
    for case in CASES[-2:]:
        away = np.array(case.lamp) - (0, 0.75, 0)
        assert np.linalg.norm(away) * 0.3 / 2 == pytest.approx(float(case.name[-2]), rel=1e-6)  # bodies of 0.3 m
        first = np.array(CASES[0].lamp) - (0, 0.75, 0)
        np.testing.assert_allclose(case.wattage / (away @ away), 1 / (first @ first), rtol=1e-6)
        colors = [photograph.target().image[photograph.target().mask > 0] for photograph in (case, CASES[0])]
        np.testing.assert_allclose(*(color.mean(axis=0) for color in colors), rtol=0.2)


def test_starts_are_away_and_light_is_measured_from_the_lamp():
    case = CASES[0]
    start = problem(case, 0).scene.bodies[0]
    assert np.linalg.norm(np.array(start.translation) - case.truth().bodies[0].translation) > 0.05
    cells = ws.fibonacci(256)
    lamp = np.array(case.lamp) - (0, 0.5, 0)
    radiance = np.where((cells @ lamp / np.linalg.norm(lamp))[:, None] > 0.97, 5.0, 0.1) * np.ones(3)
    truth = case.truth()
    lit = dataclasses.replace(truth, light=ws.CellBasis(cells).to_map(radiance))
    assert lamp_error(case, lit) < 5
    bright = dataclasses.replace(LAMP, emission=(500.0,) * 3, translation=(-3, 5, 0))
    lit = dataclasses.replace(lit, bodies=(*truth.bodies, bright))
    assert lamp_error(case, lit) > 30
    assert relighting_error(case, lit) > 0.2
    bright = dataclasses.replace(LAMP, mesh=ws.icosphere(0.35, 3), emission=(68, 60, 48), translation=case.lamp)
    sky = np.broadcast_to(np.float32([0.44, 0.5, 0.6]), (8, 16, 3))
    lit = dataclasses.replace(truth, bodies=(*truth.bodies, bright), light=ws.EnvironmentMap(sky))
    assert relighting_error(case, lit) < SCALED
