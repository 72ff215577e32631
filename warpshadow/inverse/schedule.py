"""Schedules: the stages of a fit, coarse to fine; the stages of an image are another thing, warpshadow.stages."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from warpshadow import check
from warpshadow.inverse.free import Pose
from warpshadow.inverse.problem import Problem
from warpshadow.maths.directions import check_count
from warpshadow.scene.scene import check_supersampling
from warpshadow.scene.visibility import Visibility

LAST_RATE = 0.1  # share of its learning rate that a stage ends with


@check.frozen(lr="learning_rate", steps="iterations")
@dataclass(frozen=True)
class Stage:
    """A part of a descent; coarse ones first.

    Args:
        iterations: At most so many, for each candidate.
        learning_rate: At the start; it falls along a cosine to a tenth. It bounds the first step of a QuasiNewton, and
            five times it bounds the others.
        scale: Size of the images as a part of the targets'; rounded to whole pixels, and the view stays the same.
        softness: κ of directional visibility; by default the scene's. Softer shadows reach farther.
        directions: Number of cells of directional visibility; by default the scene's.
        supersampling: Samples a pixel across and down; by default the scene's.
        candidates: How many descents take part. They go on from the best of the stage before; missing ones start
            scattered around the best. The least loss tells them apart.
        standout: A candidate has found it, and no others are turned from then on, if its loss is below this part of
            that of each of six values scattered around it. 0: all are tried.
        tolerance: In place of the fit's.
        compares: "all", or "outlines" alone, for which nothing is shaded.
        solves_light: Solve for the light at each geometry in place of descending to it, where something else is free,
            too; see :mod:`~warpshadow.inverse.variable_projection`.
        scatter: How candidates differ: "turned"; "anywhere", turned any way, where targets differ from images without
            the body; "flat", moved along the direction that the images tell least of; or "lamps", with free lamps in
            other directions.
        regularization: Factor of all regularizers: coarse stages want more of them.
    """

    iterations: int = 200
    learning_rate: float = 0.02
    scale: float = 1.0
    softness: float | None = None
    directions: int | None = None
    supersampling: int | None = None
    candidates: int = 1
    regularization: float = 1.0
    standout: float = 0.0
    tolerance: float | None = None
    compares: str = "all"
    solves_light: bool = False
    scatter: str = "turned"

    def __post_init__(self) -> None:
        check.integer("iterations", self.iterations)
        check.integer("candidates", self.candidates)
        check.choice("compares", self.compares, ("all", "outlines"))
        check.choice("scatter", self.scatter, ("turned", "anywhere", "flat", "lamps"))
        check.flag("solves_light", self.solves_light)
        if not (check.is_number(self.learning_rate) and self.learning_rate > 0):
            raise ValueError(f"learning_rate: got {self.learning_rate!r}, expected a positive number")
        check.nonnegative("regularization", self.regularization)
        check_part("standout", self.standout, "of the loss of scattered values")
        if self.tolerance is not None:
            check_part("tolerance", self.tolerance, "of the loss")
        if not (check.is_number(self.scale) and 0 < self.scale <= 1):
            raise ValueError(f"scale: got {self.scale!r}, expected a part of the image, above 0 and up to 1")
        if self.softness is not None:
            check.positive("softness", self.softness)
        if self.directions is not None:
            check_count("directions", self.directions)
        if self.supersampling is not None:
            check_supersampling(self.supersampling)

    def rate(self, iteration: int) -> float:
        """Learning rate of an iteration."""
        fall = 0.5 * (1 + math.cos(math.pi * iteration / self.iterations))
        return self.learning_rate * (LAST_RATE + (1 - LAST_RATE) * fall)

    def visibility(self, visibility: Visibility) -> Visibility:
        """A scene's visibility with the overrides of a stage."""
        overrides: dict[str, Any] = {"softness": self.softness, "directions": self.directions}
        return replace(visibility, **{name: value for name, value in overrides.items() if value is not None})


def check_part(name: str, value: object, of: str) -> None:
    """Raise ValueError unless the number is in [0, 1)."""
    if not (check.is_number(value) and 0 <= value < 1):
        raise ValueError(f"{name}: got {value!r}, expected a part {of}, 0 or more and below 1")


def stages_for(stages: object, problem: Problem) -> tuple[Stage, ...]:
    """The stages of a problem: the given ones, or ready-made ones by name."""
    if isinstance(stages, str):
        check.choice("stages", stages, READY_STAGES)
        stages = READY_STAGES[stages](problem)
    stage_tuple = tuple(stages) if isinstance(stages, Iterable) else (stages,)
    check_stages(stage_tuple, problem)
    return stage_tuple


def check_stages(stages: Sequence[Stage], problem: Problem) -> None:
    """Raise ValueError early, for mistakes on which the last stage of a long fit would fail."""
    if not stages:
        raise ValueError("stages: got none, expected one or more")
    visibility = problem.visibility
    for number, stage in enumerate(stages):
        check.instance(f"stages[{number}]", stage, Stage, "a Stage, such as Stage(iterations=200)")
        if stage.solves_light and problem.light is None:
            raise ValueError(f"stages[{number}]: got solves_light where light is not free, expected Light among free")
        if stage.solves_light and all(free.is_light for free in problem.free):
            raise ValueError(
                f"stages[{number}]: got solves_light where light alone is free, expected another free parameter, or "
                "Stage(solves_light=False), which descends to the light"
            )
        if stage.compares == "outlines" and not all(target.outlines for target in problem.targets):
            raise ValueError(f'stages[{number}]: got compares = "outlines" for a target without, expected outlines')
        try:
            stage.visibility(visibility)
        except ValueError as error:
            raise ValueError(f"stages[{number}]: {error}") from error


def pose_stages(problem: Problem) -> tuple[Stage, ...]:
    """Find a pose from 10° to 40° and a quarter of the body away.

    A descent from there ends in a wrong pose about once in eight times, and its loss tells: right ones end at 1% to 4%
    of the loss of poses turned by 30°, wrong ones at a third and more. If the first does not stand out so, others start
    turned by 30° fourteen ways, until one does. Soft shadows have fewer wrong poses; under a sun firm ones lead nearer.
    """
    small_scale, middle_scale, large_scale = (_scale_of_size(problem, size) for size in (32, 64, 512))
    soft, firm = _softer_settings(problem, 1.0), _softer_settings(problem, 0.5)
    alone: dict[str, Any] = {"standout": 0.08, "tolerance": 0.01}
    return (
        Stage(30, 0.1, small_scale, candidates=15, **alone, **soft),
        Stage(20, 0.03, small_scale, candidates=4, **alone, **firm),
        Stage(20, 0.02, middle_scale, candidates=2, **alone),
        Stage(40, 0.01, large_scale),
    )


def unknown_pose_stages(problem: Problem) -> tuple[Stage, ...]:
    """Find an unknown pose of a body in view.

    A rotation drawn at random is within 45° of the right one, from where a descent leads there, in 2.5% of the draws.
    So 96 poses, or 24 of bodies that turn about one axis, go six steps in small images with soft shadows; the best 16
    go ten more, and of these the best four to where they lead. Then come the stages of a pose.
    """
    count = 24 if all(pose.has_axis for pose in problem.free_of(Pose)) else 96
    settings: dict[str, Any] = {"tolerance": 0.01, **_softer_settings(problem, 1.0)}
    small_scale = _scale_of_size(problem, 32)
    return (
        Stage(6, 0.1, small_scale, candidates=count, scatter="anywhere", **settings),
        Stage(10, 0.1, small_scale, candidates=count // 6, **settings),
        Stage(30, 0.1, small_scale, candidates=4, standout=0.08, **settings),
        *pose_stages(problem)[1:],
    )


def deformation_stages(problem: Problem) -> tuple[Stage, ...]:
    """Find the shape of a body that is bent, from coarse images with soft shadows to fine ones.

    The last stage goes on as long as the loss falls: 40 iterations end at a mean MDE of 2.4%, 150 at 2.2%.
    """
    middle_scale, large_scale = (_scale_of_size(problem, size) for size in (64, 128))
    return (
        Stage(50, 0.06, middle_scale, supersampling=1, regularization=4.0, **_softer_settings(problem, 0.7)),
        Stage(100, 0.04, middle_scale, supersampling=1, regularization=2.0),
        Stage(150, 0.02, large_scale),
    )


def photograph_stages(problem: Problem) -> tuple[Stage, ...]:
    """Find poses and light in a photograph: outlines first, and then poses along the direction that they do not tell.

    A light that is fitted at a wrong pose confirms it. So the light is solved for at each pose, and of five poses along
    the flat direction that with the least loss goes on.
    """
    side = {size: _scale_of_size(problem, size) for size in (32, 64, 160)}
    stages: list[Stage] = []
    has_outlines = all(target.outlines for target in problem.targets)
    if has_outlines:
        first: dict[str, Any] = {"compares": "outlines", "tolerance": 0.01}
        stages += [
            Stage(30, 0.1, side[32], candidates=7, standout=0.08, **first),
            Stage(20, 0.03, side[64], candidates=2, **first),
            Stage(20, 0.01, side[160], **first),
        ]
    solved_settings: dict[str, Any] = {"solves_light": problem.light is not None, "supersampling": 1}
    places = max(free.relocation_count for free in problem.free)
    if problem.light is not None and places:
        stages.append(
            Stage(6, 0.1, side[32], candidates=1 + places, scatter="lamps", tolerance=0.01, **solved_settings)
        )
    scatter = "flat" if has_outlines else "turned"
    return (
        *stages,
        Stage(12, 0.03, side[64], candidates=5, scatter=scatter, tolerance=0.01, **solved_settings),
        Stage(20, 0.01, side[160], tolerance=1e-3, **solved_settings),
    )


READY_STAGES: dict[str, Callable[[Problem], tuple[Stage, ...]]] = {
    "pose": pose_stages,
    "unknown-pose": unknown_pose_stages,
    "deformation": deformation_stages,
    "photograph": photograph_stages,
}
"""Ready-made stages, by name."""


def _softer_settings(problem: Problem, softness: float) -> dict[str, Any]:
    """Settings of a stage that sees softer shadows, of few directions, where the method has any."""
    return {"softness": softness, "directions": 64} if problem.visibility.method == "directional" else {}


def _scale_of_size(problem: Problem, size: int) -> float:
    """The part 1 / n of the targets' size whose shorter side is about a number of pixels."""
    shorter = min(problem.targets[0].image.shape[:2])
    return 1 / max(1, round(shorter / size))
