"""The descent: its stages, why it ends, and that one that is interrupted goes on as if it had not been."""

import dataclasses
import functools
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

import warpshadow as ws
from warpshadow.device import progress
from warpshadow.inverse import (
    Albedo,
    CheckpointError,
    Exposure,
    FitWarning,
    Light,
    Loss,
    Pose,
    Problem,
    QuasiNewton,
    Result,
    Stage,
    Target,
    Texture,
    checkpoint,
    fit,
    short_adam,
)
from warpshadow.inverse.descent import CONVERGENCE_WINDOW
from warpshadow.inverse.model import Model
from warpshadow.inverse.schedule import check_stages, deformation_stages, pose_stages, unknown_pose_stages
from warpshadow.torch import rotation_matrices

pytestmark = pytest.mark.usefixtures("one_thread")


def small_scene(*, size: tuple[int, int] = (24, 24)) -> ws.Scene:
    ball = ws.Body(
        ws.icosphere(1.0, 2),
        albedo=(0.7, 0.5, 0.3),
        blockers=ws.Spheres([[-0.3, 0, 0], [0.3, 0, 0]], [0.8, 0.7]),
        translation=(0, 1, 0),
    )
    ground = ws.Body(ws.plane(8.0, 16), albedo=(0.6, 0.5, 0.4), blockers=0, receivers="vertex")
    camera = ws.Camera.look_at((0, 3, 5), (0, 0.4, 0), size=size)
    light = np.zeros((4, 3))
    light[:2] = [[3, 3, 3], [1, 1, 0.5]]
    return ws.Scene((ball, ground), light, camera, ws.Visibility(directions=64), supersampling=1)


def moved_scene(scene: ws.Scene) -> ws.Scene:
    """The truth: the ball elsewhere, in other light."""
    ball, ground = scene.bodies
    ball = dataclasses.replace(ball, translation=(0.3, 1.1, 0.2))
    return dataclasses.replace(scene, bodies=(ball, ground), light=scene.light * np.float32(1.3))


def small_problem(*free, scene: ws.Scene | None = None, **options) -> Problem:
    scene = small_scene() if scene is None else scene
    target = Target(ws.Renderer(moved_scene(scene)).render())
    return Problem(scene, target, free or (Pose(0), Albedo(0), Light(2)), **{"still": None} | options)


STAGES = (Stage(4, 0.02, scale=0.5, softness=1.0), Stage(3, 0.01))


@pytest.fixture(scope="module")
def problem() -> Problem:
    return small_problem()


def same(first: Result, second: Result) -> bool:
    """Bit for bit, time apart."""
    return (
        first.losses == second.losses
        and first.reason == second.reason
        and all(
            torch.equal(tensor, second.values[name][key])
            for name, own in first.values.items()
            for key, tensor in own.items()
        )
    )


class Recorded(Loss):
    """A loss that remembers the images it has seen."""

    seen: list

    def __call__(self, images, targets, weights, unit):
        self.__dict__.setdefault("seen", []).append(images.detach().clone())
        return super().__call__(images, targets, weights, unit)


# ---------------------------------------------------------------------------------------------- stages


def test_stages_go_from_coarse_to_fine_and_from_soft_to_sharp_and_carry_the_best_values_over():
    loss = Recorded()
    stages = [Stage(5, scale=0.25, softness=2.0), Stage(4, scale=0.5, directions=32), Stage(3)]
    result = fit(small_problem(loss=loss), stages)
    assert [len(losses) for losses in result.losses] == [5, 4, 3]
    # and once more where the last step of each led
    assert [image.shape[1] for image in loss.seen] == [6] * 6 + [12] * 5 + [24] * 4
    alike = [Stage(5, learning_rate=0.1), Stage(3, learning_rate=0.1)]
    result = fit(small_problem(), alike)
    assert result.losses[1][0] <= min(result.losses[0])


@pytest.mark.parametrize("change", [{"softness": 2.0}, {"directions": 128}])
def test_a_stage_sees_shadows_of_its_own_softness_and_directions(problem, change):
    seen = ws.Renderer(
        dataclasses.replace(problem.scene, visibility=ws.Visibility(**{"directions": 64} | change))
    ).render()
    loss = Recorded()
    fit(small_problem(Pose(0), loss=loss), [Stage(1, **change)])
    assert np.abs(loss.seen[0][0].numpy() - seen).max() < 3e-6 * seen.max()
    assert np.abs(seen - ws.Renderer(problem.scene).render()).max() > 1e-2


def test_the_rate_falls_along_a_cosine_to_a_tenth():
    stage = Stage(100, learning_rate=2.0)
    rates = [stage.rate(iteration) for iteration in range(100)]
    assert rates[0] == 2 and rates[50] == pytest.approx(1.1) and 0.2 < rates[99] < 0.201
    assert sorted(rates, reverse=True) == rates


def test_where_the_last_step_led_counts():
    problem = small_problem()
    assert not np.array_equal(fit(problem, [Stage(1)]).images(), fit(problem, [Stage(1)]).images_at_start())


def test_a_stage_of_a_part_of_a_pixel_rounds_and_corrects_its_camera():
    """The scene explains its own image at sizes that are no whole part of it; by intrinsics times the scale, worse."""
    scene = dataclasses.replace(small_scene(size=(61, 47)), supersampling=4)
    problem = Problem(scene, Target(ws.Renderer(scene).render()), Pose(0))
    context = problem.context(torch.device("cpu"))
    for scale in (1 / 2, 0.3, 1 / 4):
        model = Model(problem, context, Stage(scale=scale))
        image, target = model.images(problem.start(context))[0].detach().numpy(), model.targets[0].numpy()
        assert image.shape == target.shape == (round(47 * scale), round(61 * scale), 4)
        intrinsics = np.diag([scale, scale, 1]) @ scene.camera.intrinsics
        uncorrected = ws.Renderer(
            dataclasses.replace(scene, camera=dataclasses.replace(model.cameras[0], intrinsics=intrinsics))
        ).render()
        assert np.abs(image - target).mean() < 0.5 * np.abs(uncorrected - target).mean()


def test_a_softness_that_directions_do_not_allow_is_refused_at_once_with_its_stage():
    with pytest.raises(ValueError, match=r"stages\[1\]: softness"):
        fit(small_problem(), [Stage(1000), Stage(1, softness=5.0, directions=64)])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"iterations": 0}, "iterations: got 0"),
        ({"iterations": 2.5}, "iterations: got 2.5"),
        ({"iterations": True}, "iterations: got True"),
        ({"learning_rate": 0}, "learning_rate: got 0"),
        ({"learning_rate": "fast"}, "learning_rate: got 'fast'"),
        ({"scale": None}, "scale: got None"),
        ({"supersampling": 2.0}, "supersampling: got 2.0"),
        ({"learning_rate": math.inf}, "learning_rate: got inf"),
        ({"learning_rate": math.nan}, "learning_rate: got nan"),
        ({"scale": 0}, "scale: got 0"),
        ({"scale": 2}, "scale: got 2"),
        ({"scale": math.nan}, "scale: got nan"),
        ({"softness": -1}, "softness: got -1"),
        ({"softness": math.nan}, "softness: got nan"),
        ({"directions": 50}, "directions: got 50"),
        ({"supersampling": 0}, "supersampling: got 0"),
        ({"candidates": 0}, "candidates: got 0"),
        ({"standout": 1.0}, "standout: got 1.0, expected a part of the loss of scattered values"),
        ({"standout": math.nan}, "standout: got nan"),
        ({"tolerance": -0.1}, "tolerance: got -0.1, expected a part of the loss"),
    ],
)
def test_a_stage_names_what_is_wrong_with_it(options, message):
    with pytest.raises(ValueError, match=message):
        Stage(**options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"stages": []}, "stages: got none"),
        ({"stages": "poses"}, "stages: got 'poses', .*did you mean 'pose'"),
        ({"stages": 100}, r"stages\[0\]: got 100, expected a Stage, such as Stage\(iterations=200\)"),
        ({"stages": [Stage(1), "pose"]}, r"stages\[1\]: got 'pose', expected a Stage"),
        ({"optimizer": "adam"}, "optimizer: got 'adam', .*torch.optim.Adam"),
        ({"device": "gpu"}, "device: got 'gpu', expected one of 'cpu'"),
        ({"tolerance": "1%"}, "tolerance: got '1%'"),
        ({"tolerance": -0.1}, "tolerance: got -0.1"),
        ({"tolerance": 1.0}, "tolerance: got 1.0"),
        ({"tolerance": math.nan}, "tolerance: got nan"),
        ({"checkpoint": "nowhere/fit.checkpoint"}, "checkpoint: got 'nowhere/fit.checkpoint'"),
        ({"preview": "nowhere/fit.png"}, "preview: got 'nowhere/fit.png'"),
    ],
)
def test_a_fit_names_what_is_wrong_with_it(problem, options, message):
    with pytest.raises(ValueError, match=message):
        fit(problem, **options)


def test_a_stage_has_its_own_supersampling(problem):
    loss = Recorded()
    fit(small_problem(Pose(0), loss=loss), [Stage(1, supersampling=3)])
    seen = ws.Renderer(dataclasses.replace(problem.scene, supersampling=3)).render()
    assert np.abs(loss.seen[0][0].numpy() - seen).max() < 3e-6 * seen.max()


# ---------------------------------------------------------------------------------------------- candidates


def test_candidates_go_on_from_the_best_of_the_stage_before():
    problem = small_problem(Pose(0))
    slow = {"learning_rate": 1e-9}  # so that a candidate keeps its loss
    stages = [Stage(1, candidates=5, **slow), Stage(1, candidates=3, **slow), Stage(1, **slow)]
    result = fit(problem, stages)
    assert [len(losses) for losses in result.losses] == [1] * 9
    first, second, third = (sum(part, []) for part in (result.losses[:5], result.losses[5:8], result.losses[8:]))
    assert len(set(first)) == 5
    assert second == pytest.approx(sorted(first)[:3], rel=1e-6) and third == pytest.approx(second[:1], rel=1e-6)
    assert first[0] == fit(problem, [Stage(1)]).losses[0][0]  # the scene's own pose takes part


@pytest.mark.slow
def test_candidates_beyond_the_fourteen_turns_are_drawn_by_the_seed_alone():
    problem = small_problem(Pose(0))
    stages = [Stage(1, candidates=16)]
    torch.manual_seed(1)
    first = fit(problem, stages, seed=4)
    torch.manual_seed(2)
    assert same(first, fit(problem, stages, seed=4))
    other = fit(problem, stages, seed=5).losses
    assert first.losses[:15] == other[:15] and first.losses[15] != other[15]


def test_candidates_of_what_need_not_scatter_are_the_same():
    losses = fit(small_problem(Albedo(0)), [Stage(2, candidates=2)]).losses
    assert losses[0] == losses[1]


def stretched_problem() -> Problem:
    """The ball made long, so that its image tells how it is turned, and elsewhere, in the same light."""
    ball, ground = small_scene().bodies
    mesh = dataclasses.replace(ball.mesh, positions=ball.mesh.positions * np.float32([1.3, 0.6, 0.8]))
    ball = dataclasses.replace(ball, mesh=mesh)
    scene = dataclasses.replace(small_scene(), bodies=(ball, ground))
    moved = dataclasses.replace(ball, rotation=(0, 15, 0), translation=(0.2, 1.05, 0.1))
    target = Target(ws.Renderer(dataclasses.replace(scene, bodies=(moved, ground))).render())
    return Problem(scene, target, Pose(0), still=None)


def test_no_candidates_are_tried_after_one_whose_loss_stands_out(tmp_path):
    stages = [Stage(30, 0.1, candidates=4, standout=0.3, tolerance=1e-2), Stage(2, 0.01, candidates=3)]
    problem = stretched_problem()
    result = fit(problem, stages, checkpoint=tmp_path / "fit")
    assert len(result.losses) == 2
    assert same(fit(problem, stages, checkpoint=tmp_path / "fit"), result)
    along = dataclasses.replace(stages[1], iterations=1, scatter="flat")  # no other turns, which are done with
    assert len(fit(problem, [*stages, along]).losses) == 2 + 3
    everyone = fit(problem, [dataclasses.replace(stage, standout=0.0) for stage in stages])
    assert len(everyone.losses) == 7 and everyone.losses[0] == result.losses[0]


def test_a_pose_that_may_be_turned_unseen_does_not_stand_out():
    problem = small_problem(Pose(0))  # of a ball
    assert len(fit(problem, [Stage(12, 0.1, candidates=3, standout=0.5)]).losses) == 3


def test_a_stage_begins_where_the_last_one_ended_in_loss_as_well():
    """The first step of Adam is as long as its rate, however near the goal; and its loss leaps."""
    problem = stretched_problem()
    stages = [Stage(60, 0.1, tolerance=1e-3, softness=1.0), Stage(10, 0.1)]
    leaps = {}
    for optimizer in (QuasiNewton, short_adam):
        _, second = fit(problem, stages, optimizer=optimizer).losses
        leaps[optimizer] = max(second[1:4]) / second[0]
    assert leaps[QuasiNewton] < 1.4 and leaps[short_adam] > 3  # 1.28, by a step that is taken back


@pytest.mark.parametrize("rotation", ["axis-angle", "quaternion", "6d"])
def test_candidates_of_a_pose_are_turned_by_its_spread_each_another_way(rotation):
    pose = Pose(0, rotation, spread=0.4)
    problem = small_problem(pose)
    start = problem.start(problem.context(torch.device("cpu")))[pose.name]
    generator = torch.Generator().manual_seed(0)
    turns = [pose.scattered(start, number, generator)["turn"] for number in range(15)]
    matrices = rotation_matrices(torch.stack(turns)).numpy().astype(np.float64)
    angles = np.arccos((np.trace(matrices, axis1=1, axis2=2) - 1) / 2)
    np.testing.assert_allclose(angles, 0.4, atol=1e-5)
    apart = np.linalg.norm(matrices[:, None] - matrices[None], axis=(2, 3))[np.triu_indices(15, 1)]
    assert apart.min() > 0.1


def test_a_candidate_that_diverges_leaves_the_others_alone():
    class Pit(Loss):
        """Infinite where a pose is not the first candidate's."""

        def __call__(self, images, targets, weights, unit):
            loss = super().__call__(images, targets, weights, unit)
            self.__dict__.setdefault("first", loss.item())
            return loss if abs(loss.item() - self.first) < 1e-6 else loss * math.inf

    result = fit(small_problem(Pose(0), loss=Pit()), [Stage(2, 1e-9, candidates=3)])
    assert [len(losses) for losses in result.losses] == [2, 0, 0] and result.reason == "finished"
    assert np.isfinite(result.images()).all()


def test_a_fit_of_which_all_candidates_diverge_says_so():
    with pytest.warns(FitWarning, match="became NaN or Inf|expected"):
        result = fit(small_problem(Pose(0)), [Stage(5, 1e30, candidates=2)])
    assert result.reason != "finished" and np.isfinite(result.images()).all()


@pytest.mark.parametrize("size", [(98, 98), (64, 48), (45, 60), (31, 31), (512, 384), (147, 98), (1568, 1568)])
def test_the_stages_for_poses_and_deformations_suit_every_size(size):
    """Also one of which 1 / 49 is a part, though 49 · (1 / 49) is not 1 in floating point."""
    width, height = size
    problem = Problem(small_scene(size=size), Target(np.ones((height, width, 3))), Pose(0))
    for stages in (pose_stages(problem), unknown_pose_stages(problem), deformation_stages(problem)):
        check_stages(stages, problem)
        sizes = [stage.scale * min(size) for stage in stages]
        assert sizes == sorted(sizes)


# ---------------------------------------------------------------------------------------------- results


class Turning(torch.optim.SGD):
    """Goes down three times, and from then on up."""

    def step(self, closure=None):
        self.count = getattr(self, "count", 0) + 1
        for group in self.param_groups:
            group["maximize"] = self.count > 3
        return super().step(closure)


def test_the_result_has_the_values_of_the_least_loss(problem):
    result = fit(problem, [Stage(8, learning_rate=0.05)], optimizer=Turning)
    losses = result.losses[0]
    assert losses.index(min(losses)) == 3
    images = torch.from_numpy(result.images())
    target = torch.from_numpy(problem.targets[0].image)[None]
    weights = torch.ones(images.shape[:3])
    assert float(problem.loss(images, target, weights, result.context.unit)) == pytest.approx(min(losses), rel=1e-5)


def test_a_fit_is_the_same_each_time(problem):
    assert same(fit(problem, STAGES), fit(problem, STAGES))


def test_a_fit_does_not_depend_on_exposure():
    """Light and targets of a thousandth: the same descent of what has no unit."""
    scene = small_scene()
    dark = dataclasses.replace(scene, light=scene.light * np.float32(2.0**-10))
    bright_fit, dark_fit = (fit(small_problem(scene=each), [Stage(10)]) for each in (scene, dark))
    assert np.allclose(dark_fit.losses, bright_fit.losses, rtol=1e-3)
    assert np.allclose(dark_fit.scene.light * 2**10, bright_fit.scene.light, atol=1e-3)


# ---------------------------------------------------------------------------------------------- stops


@pytest.mark.slow
def test_a_fit_at_its_goal_has_converged_as_soon_as_that_can_be_said():
    scene = small_scene()
    problem = Problem(scene, Target(ws.Renderer(scene).render()), Pose(0), still=None)
    for optimizer, count in ((QuasiNewton, 2), (short_adam, 2 * CONVERGENCE_WINDOW)):
        result = fit(problem, [Stage(500)], tolerance=1e-3, optimizer=optimizer)
        assert result.reason == "converged"
        assert len(result.losses[0]) == count


def test_a_loss_of_zero_has_converged():
    scene = small_scene()
    black = dataclasses.replace(scene, light=np.zeros((4, 3)))
    problem = Problem(black, Target(np.zeros((24, 24, 3))), Albedo(0), still=None)
    for optimizer, count in ((QuasiNewton, 2), (short_adam, 2 * CONVERGENCE_WINDOW)):
        result = fit(problem, [Stage(500)], optimizer=optimizer)
        assert result.losses[0] == [0.0] * count and result.reason == "converged"


def test_the_bar_of_a_fit_ends_where_the_fit_does(monkeypatch, capsys):
    scene = small_scene()
    black = dataclasses.replace(scene, light=np.zeros((4, 3)))
    problem = Problem(black, Target(np.zeros((24, 24, 3))), Albedo(0), still=None)
    left = []
    monkeypatch.setattr(progress, "_can_be_seen", lambda: True)
    monkeypatch.setattr(
        progress.Wait, "expect", lambda self, count, do=progress.Wait.expect: (left.append(count), do(self, count))
    )
    result = fit(problem, [Stage(500, candidates=2), Stage(3, tolerance=0.0)], progress=True)
    counts = [len(losses) for losses in result.losses]
    assert counts[:2] == [2, 2] and result.reason != "stopped"
    # of the first candidate a loss, and then both; of the second the same; then the last stage
    assert left[:4] == [1002, 1001, 502, 501] and left[-1] == 0
    assert f"{sum(counts)}/{sum(counts)}" in capsys.readouterr().err.split("\r")[-1]


@pytest.mark.slow
def test_a_stage_that_has_converged_makes_way_for_the_next():
    scene = small_scene()
    problem = Problem(scene, Target(ws.Renderer(scene).render()), Pose(0), still=None)
    result = fit(problem, [Stage(500), Stage(3)], tolerance=1e-3, optimizer=short_adam)
    assert [len(losses) for losses in result.losses] == [2 * CONVERGENCE_WINDOW, 3] and result.reason == "finished"
    result = fit(problem, [Stage(500, tolerance=0.5), Stage(3)], tolerance=0.0, optimizer=short_adam)
    assert [len(losses) for losses in result.losses] == [2 * CONVERGENCE_WINDOW, 3]  # by its own tolerance


def test_a_swing_through_a_low_loss_is_not_convergence():
    """Adam overshoots; that the loss was low for a moment does not mean that it falls no more."""
    scene = small_scene()
    problem = Problem(scene, Target(1.6 * ws.Renderer(scene).render()[..., :3]), Exposure(), still=None)
    result = fit(problem, [Stage(150, learning_rate=0.2)], optimizer=short_adam)
    assert result.found.exposures[0] == pytest.approx(1.6, rel=1e-3)


class Leaping(torch.optim.SGD):
    """Steps out of float32 where its rate says so."""

    def step(self, closure=None):
        loss = super().step(closure)
        for group in self.param_groups:
            for tensor in group["params"]:
                if group["lr"] == 1.0:
                    tensor.data *= 1e38 * 1e2
        return loss


UNBOUNDED = {
    "a loss that overflows": (Light(2), torch.optim.Adam, 1e30, "the loss became NaN or Inf"),
    "light that overflows": (Light(None, 64), torch.optim.Adam, 1e3, "the loss became NaN or Inf"),
    "values that overflow": (Light(2), Leaping, 1.0, "light.coefficients became NaN or Inf"),
    "an exponent that overflows": (Exposure(), torch.optim.Adam, 1e3, "the images became NaN or Inf"),
    "a pose beyond all numbers": (Pose(0), torch.optim.Adam, 1e30, "got .* expected"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", UNBOUNDED)
def test_what_becomes_infinite_ends_the_fit_with_the_values_before(case):
    free, optimizer, rate, what = UNBOUNDED[case]
    problem = small_problem(free)
    stages = [Stage(5, learning_rate=1e-3), Stage(50, learning_rate=rate)]
    with pytest.warns(FitWarning, match=rf"stopped in stage 2: .*{what}.*the best values before it are kept"):
        result = fit(problem, stages, optimizer=optimizer)
    calm = fit(problem, stages[:1], optimizer=optimizer)
    assert min(result.losses[-1]) <= min(calm.losses[0])
    assert all(torch.isfinite(tensor).all() for own in result.values.values() for tensor in own.values())
    assert np.isfinite(ws.Renderer(result.scene).render()).all() and np.isfinite(result.images()).all()
    assert np.array_equal(result.images(), calm.images())


def test_a_gradient_that_becomes_infinite_is_named():
    class Steep(Loss):
        def __call__(self, images, targets, weights, unit):
            return super().__call__(images, targets, weights, unit) + torch.sqrt((images - images.detach()).abs().sum())

    with pytest.warns(FitWarning, match=r"the gradient of albedo\[0\].color became NaN or Inf"):
        result = fit(small_problem(Albedo(0), Pose(0), loss=Steep()), [Stage(5)])
    assert result.losses == [[]] and np.isfinite(result.images()).all()


def test_what_is_wrong_from_the_beginning_is_an_error_and_no_end():
    scene = small_scene()
    ball, ground = scene.bodies
    scene = dataclasses.replace(scene, bodies=(ball, dataclasses.replace(ground, texture=np.full((2, 2, 3), 0.5))))
    problem = Problem(scene, Target(np.ones((24, 24, 3))), [Texture(1, size=(1, 4), smoothness=1.0)], still=None)
    assert np.isfinite(fit(problem, [Stage(2)]).losses[0]).all()  # a single row has no neighbors

    class Refusing(Loss):
        def __call__(self, *_):
            raise ValueError("images: got none of mine")

    with pytest.raises(ValueError, match="images: got none of mine"):
        fit(dataclasses.replace(problem, loss=Refusing()), [Stage(2)])


# ---------------------------------------------------------------------------------------------- going on

OPTIMIZERS = {
    "QuasiNewton": QuasiNewton,
    "Adam": torch.optim.Adam,
    "SGD with momentum": functools.partial(torch.optim.SGD, momentum=0.9),
    "LBFGS": functools.partial(torch.optim.LBFGS, max_iter=3, history_size=4),
}


class Killed(BaseException):
    """The process ends here."""


def dies_after_each_save(monkeypatch):
    save = checkpoint.save

    def save_and_die(path, state):
        save(path, state)
        raise Killed

    monkeypatch.setattr(checkpoint, "save", save_and_die)


ROUNDS = (Stage(3, 0.02, scale=0.5, candidates=3), Stage(2, 0.01, candidates=2))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "stages"),
    [*((name, STAGES) for name in OPTIMIZERS), *((name, ROUNDS) for name in ("Adam", "QuasiNewton"))],
    ids=[*OPTIMIZERS, "candidates", "candidates that hand on curvature"],
)
def test_a_fit_that_dies_after_every_iteration_has_the_result_of_one_that_does_not(
    problem, tmp_path, monkeypatch, name, stages
):
    options = {"stages": stages, "optimizer": OPTIMIZERS[name]}
    whole = fit(problem, **options)
    path = tmp_path / "fit.checkpoint"
    with monkeypatch.context() as patch:
        dies_after_each_save(patch)
        lives = 0
        while checkpoint.load(path) is None or checkpoint.load(path)["reason"] is None:
            with pytest.raises(Killed):
                fit(problem, **options, checkpoint=path, checkpoint_seconds=0.0)
            lives += 1
            assert lives < 20
    assert lives == sum(stage.iterations * stage.candidates for stage in stages) + 1
    assert same(fit(problem, **options, checkpoint=path), whole)


@pytest.mark.parametrize("progress", [True, False])
def test_a_fit_that_goes_on_says_from_where(problem, tmp_path, monkeypatch, capsys, progress):
    path = tmp_path / "fit.checkpoint"
    with monkeypatch.context() as patch:
        dies_after_each_save(patch)
        with pytest.raises(Killed):
            fit(problem, STAGES, checkpoint=path, checkpoint_seconds=0.0)
    assert "going on" not in capsys.readouterr().err
    fit(problem, STAGES, checkpoint=path, progress=progress)
    assert (f"going on from iteration 1, of {path}\n" in capsys.readouterr().err) == progress
    fit(problem, STAGES, checkpoint=path)  # which had ended
    assert "going on" not in capsys.readouterr().err


def test_a_fit_that_has_ended_is_not_computed_again(tmp_path):
    loss = Recorded()
    path = tmp_path / "fit.checkpoint"
    problem = small_problem(loss=loss)
    first = fit(problem, STAGES, checkpoint=path)
    count = len(loss.seen)
    second = fit(problem, STAGES, checkpoint=path)
    assert len(loss.seen) == count == 9 and same(first, second)  # 7 steps, and where the last of each stage led
    assert np.array_equal(first.images(), second.images())


@pytest.mark.slow
def test_a_converged_and_a_diverged_fit_stay_so(tmp_path):
    scene = small_scene()
    goal = Problem(scene, Target(ws.Renderer(scene).render()), Pose(0), still=None)
    converged = [fit(goal, [Stage(500)], tolerance=1e-3, checkpoint=tmp_path / "a") for _ in range(2)]
    assert same(*converged) and converged[1].reason == "converged"
    diverged = []
    for _ in range(2):
        with pytest.warns(FitWarning, match="stopped in stage 1"):
            diverged.append(fit(small_problem(), [Stage(9, 1e30)], checkpoint=tmp_path / "b"))
    assert same(*diverged) and "finished" not in diverged[1].reason


def test_checkpoints_are_written_by_the_clock_and_at_the_end(problem, tmp_path, monkeypatch):
    written = []
    monkeypatch.setattr(checkpoint, "save", lambda path, state: written.append(len(sum(state["losses"], []))))
    fit(problem, STAGES, checkpoint=tmp_path / "fit", checkpoint_seconds=1e9)
    assert written[-1] == 7 and len(written) <= 2
    written.clear()
    fit(problem, STAGES, checkpoint=tmp_path / "fit", checkpoint_seconds=0.0)
    assert [count for count in written if count] == [1, 2, 3, 4, 5, 6, 7, 7]


def test_a_checkpoint_of_another_fit_is_refused_and_stays(problem, tmp_path):
    path = tmp_path / "fit.checkpoint"
    adam = functools.partial(torch.optim.Adam, betas=(0.8, 0.99))
    own = {"problem": problem, "stages": STAGES, "optimizer": adam, "tolerance": 1e-4, "seed": 0}
    fit(**own, checkpoint=path)
    content = path.read_bytes()
    others = {
        "problem": small_problem(Pose(0)),
        "stages": (Stage(4, 0.02, scale=0.5, softness=1.0), Stage(3, 0.011)),
        "optimizer": functools.partial(torch.optim.Adam, betas=(0.9, 0.99)),
        "tolerance": 1e-3,
        "seed": 1,
    }
    for name, other in others.items():
        words = "free" if name == "problem" else name
        with pytest.raises(CheckpointError, match=rf"checkpoint: got one of another fit \(other {words}\), expected"):
            fit(**own | {name: other}, checkpoint=path)
    assert path.read_bytes() == content
    # the same optimizer by another name is the same
    made = lambda tensors, lr: torch.optim.Adam(tensors, lr=lr, betas=(0.8, 0.99))  # noqa: E731
    assert same(fit(**own | {"optimizer": made}, checkpoint=path), fit(**own))


def test_what_is_no_checkpoint_is_refused_and_stays(problem, tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text("[camera]\n")
    with pytest.raises(CheckpointError, match=r"scene\.toml: not a whole checkpoint"):
        fit(problem, STAGES, checkpoint=path)
    assert path.read_text() == "[camera]\n"
    checkpoint.save(tmp_path / "epochs", {"epoch": 3})
    with pytest.raises(CheckpointError, match="checkpoint: got one of no fit of this version"):
        fit(problem, STAGES, checkpoint=tmp_path / "epochs")


LONG = (Stage(40, 0.02, scale=0.5), Stage(40, 0.01))


def long_fit(path: Path | None) -> Result:
    """One that lasts about a second; its checkpoints are written after each iteration."""
    torch.set_num_threads(1)
    optimizer = functools.partial(torch.optim.Adam, betas=(0.8, 0.99))
    return fit(small_problem(), LONG, optimizer=optimizer, tolerance=0.0, checkpoint=path, checkpoint_seconds=0.0)


@pytest.mark.slow
def test_a_process_that_is_killed_goes_on_in_another_with_the_result_that_it_would_have_had(tmp_path):
    path = tmp_path / "fit.checkpoint"
    command = f"import pathlib, test_inverse_descent as t; t.long_fit(pathlib.Path({str(path)!r}))"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen([sys.executable, "-c", command], env=environment, stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 300
    while not checkpoint.previous_path(path).exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(0.1)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL  # it was under way
    done = sum(map(len, checkpoint.load(path)["losses"]))
    assert 0 < done < 80
    assert same(long_fit(path), long_fit(None))


# ---------------------------------------------------------------------------------------------- previews


def test_a_preview_shows_each_view_and_appears_whole(problem, tmp_path):
    from PIL import Image

    fit(problem, STAGES, preview=tmp_path / "fit.png", preview_seconds=0.0)
    with Image.open(tmp_path / "fit.png") as picture:
        assert picture.size == (3 * 24, 24)
    assert [file.name for file in tmp_path.iterdir()] == ["fit.png"]
