"""A free parameter that is a class of its own, here in a test: fits know of it all that it says, and no list has it."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

import warpshadow as ws
from warpshadow.inverse import DiagnosticWarning, Exposure, Free, Light, Problem, Stage, Target, fit
from warpshadow.inverse.free.base import PRIOR
from warpshadow.inverse.report import found_values
from warpshadow.inverse.schedule import photograph_stages

TRUE_TINT = 0.4


@dataclass(frozen=True)
class Tint(Free):
    """A factor of the red of all views, whose logarithm has a prior."""

    key = "tint"
    scales = "exposure"
    excludes = {"exposure": "both are factors of red"}
    has_prior = True
    relocation_count = 2
    min_directions = 128

    deviation: float = 10.0

    def start(self, context):
        return {"log": context.tensor(0.0)}

    def apply(self, values, context, world):
        world.exposures = torch.stack([values["log"].exp(), *torch.ones(2)])[None].expand(len(world.cameras), -1)

    def regularizer(self, values, context):
        return PRIOR * (values["log"] / self.deviation).square()

    def relocated(self, values, context, number):
        return {"log": values["log"].detach() + (-1.0) ** number}

    def export(self, values, context, fitted):
        fitted.exposures = [float(values["log"].exp())]

    def summary(self, fitted):
        return {"tint": fitted.exposures}

    def report(self, context, fitted):
        return [("tint", f"{fitted.exposures[0]:.2f} of red")]


def problem(*free: Free) -> Problem:
    ball, ground = ws.Body(ws.icosphere(0.5, 1), blockers=0, translation=(0, 0.6, 0)), ws.Body(ws.plane(4.0, 4))
    camera = ws.Camera.look_at((0, 2, 3), (0, 0.4, 0), size=(16, 12))
    settings = ws.Visibility(directions=32)
    scene = ws.Scene((ball, ground), ws.EnvironmentMap.constant(1.0), camera, settings, supersampling=1)
    image = np.array(ws.render(replace(scene, visibility=ws.Visibility("none")))[..., :3])
    image[..., 0] *= np.exp(TRUE_TINT)
    return Problem(scene, Target(image, mask=(image.sum(axis=2) > 0)), free, still=ws.Visibility("directional"))


def test_a_fit_finds_it_and_reports_it_as_it_says():
    result = fit(problem(Tint()), Stage(20), progress=False)
    (log,) = result.values["tint"].values()
    assert float(log) == pytest.approx(TRUE_TINT, abs=0.1)
    assert result.figures == {"tint": [pytest.approx(np.exp(float(log)))]}
    assert found_values(result) == [f"tint  {np.exp(float(log)):.2f} of red"]


def test_its_prior_is_a_measurement_of_uncertainties():
    stage = Stage(3)
    loose, tight = (fit(problem(Tint(sd)), stage, progress=False).uncertainty for sd in (10.0, 1e-3))
    assert loose.names == ["tint.log[0]"] and tight.covariance < 0.1 * loose.covariance


def test_it_excludes_others_and_is_told_of_as_a_factor_of_images():
    with pytest.raises(ValueError, match="free: got exposure and tint, expected one of them: both are factors of red"):
        problem(Exposure(), Tint())
    with pytest.warns(DiagnosticWarning, match="got light and exposure, expected all but one"):
        fit(problem(Light(3), Tint()), Stage(1), progress=False)


def test_it_has_the_cells_that_it_needs_and_is_searched_from_its_places():
    both = problem(Light(3), Tint())
    assert both.visibility.directions == 128 and problem(Light(3)).visibility.directions != 128
    (search,) = [stage for stage in photograph_stages(both) if stage.scatter == "lamps"]
    assert search.candidates == 3
    losses = fit(both, Stage(1, candidates=3, scatter="lamps"), progress=False).losses
    assert len({run[0] for run in losses}) == 3
