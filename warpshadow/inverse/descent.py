"""The descent: from where a problem's scene is to where its images are like their targets."""

import contextlib
import math
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
import warp as wp

from warpshadow import check
from warpshadow.assets.image import write_image
from warpshadow.check import AnyPath
from warpshadow.device.progress import progress_bar, remark
from warpshadow.inverse import checkpoint as checkpoints
from warpshadow.inverse.anywhere import candidates_anywhere
from warpshadow.inverse.diagnostics import warn_before, warn_of
from warpshadow.inverse.free.base import Free, Values
from warpshadow.inverse.model import Model, torch_on_one_thread
from warpshadow.inverse.problem import Problem
from warpshadow.inverse.quasi_newton import Curvature, QuasiNewton
from warpshadow.inverse.result import Result
from warpshadow.inverse.schedule import Stage, check_part, stages_for
from warpshadow.inverse.uncertainty import candidates_along_flat_direction
from warpshadow.inverse.variable_projection import make_model
from warpshadow.inverse.watch import Watch, side_by_side, watching
from warpshadow.viewer import FitViewer

MAX_QUASI_NEWTON_VALUES = 100  # up to how many values are found by quasi-Newton steps unless an optimizer is named
CONVERGENCE_WINDOW = 25  # iterations over which a loss must fall for its stage to go on

PERTURBED_STARTS = 6
"""To how many scattered values a result is compared that may stand out: a pose turned about each axis, either way."""


class FitWarning(UserWarning):
    """A fit that ended before its time."""


GOOD_ENDINGS = ("converged", "finished")  # why a fit ends whose values can be used as they are


class _Diverged(Exception):
    """Something became non-finite; the message names it."""


class _Candidate(NamedTuple):
    """Start of a run."""

    values: dict[str, Values]
    curvature: Curvature | None  # that a QuasiNewton found in the stage before


class _FinishedRun(NamedTuple):
    """A candidate's descent that has ended."""

    loss: float
    best: dict[str, Values]
    failure: str | None  # the non-finite quantity
    curvature: Curvature | None  # of a QuasiNewton


class _Descent:
    """A fit under way: all of its state is in ``state()``.

    A stage has candidates, and each of them a run: the descent itself.
    """

    def __init__(
        self,
        problem: Problem,
        stages: tuple[Stage, ...],
        optimizer: Callable[..., torch.optim.Optimizer],
        tolerance: float,
        seed: int,
        device: torch.device,
        progress: bool,
    ):
        self.problem, self.stages, self.make_optimizer, self.tolerance = problem, stages, optimizer, tolerance
        self.seed = seed
        self.context = problem.context(device, progress=progress)
        self.stage = 0
        self.has_standout = False
        self.candidates = self._candidates_of_stage([_Candidate(problem.start(self.context), None)])
        self.ended: list[_FinishedRun] = []
        self.losses: list[list[float]] = []
        self.descents: list[int] = []
        self.reason: str | None = None
        self._begin_run(self.candidates[0])
        # The optimizer is identified by an instance of it: a partial or a lambda has no name that tells all of it.
        state = self.optimizer.state_dict()
        groups = [{key: value for key, value in group.items() if key != "params"} for group in state["param_groups"]]
        optimizer_text = f"{type(self.optimizer).__qualname__} {groups!r} {state['state']!r}"
        self.fingerprints = problem.fingerprints() | {
            "stages": repr(stages),
            "tolerance": repr(tolerance),
            "seed": repr(seed),
            "optimizer": optimizer_text,
        }

    def _candidates_of_stage(self, best: list[_Candidate]) -> list[_Candidate]:
        """The candidates of a stage: the best so far, and others scattered around the first where it wants more."""
        count = self._candidate_count(self.stages[self.stage])
        perturbed = self._perturbed_candidates(best[0].values, count - len(best))
        return [*best[:count], *(_Candidate(values, None) for values in perturbed)]

    def _candidate_count(self, stage: Stage) -> int:
        """Candidates of a stage: one that stood out is not turned any more."""
        return 1 if self.has_standout and stage.scatter == "turned" else stage.candidates

    def _perturbed_candidates(self, values: Mapping[str, Values], count: int) -> list[dict[str, Values]]:
        scatter = self.stages[self.stage].scatter
        if count > 0 and scatter == "flat":
            return candidates_along_flat_direction(self.problem, self.context, values, count)
        if count > 0 and scatter == "anywhere":
            model = Model(self.problem, self.context, self.stages[self.stage])
            return candidates_anywhere(model, values, count, self.seed)
        generator = torch.Generator().manual_seed(self.seed)

        def perturbed(free: Free, number: int) -> Values:
            if scatter == "lamps":
                return free.relocated(values[free.name], self.context, number)
            return free.scattered(values[free.name], number, generator)

        return [{free.name: perturbed(free, number) for free in self.problem.free} for number in range(count)]

    def begin_stage(self) -> None:
        """Set up the model of a stage, and its first candidate."""
        self.model = make_model(self.problem, self.context, self.stages[self.stage])
        self.images: torch.Tensor | None = None  # of the last iteration, if it took any
        self._begin_run(self.candidates[0])
        self.losses.append([])
        self.descents.append(1)

    def _begin_run(self, candidate: _Candidate) -> None:
        """Set up the optimizer for a candidate."""
        self.values, self.best = _copy_values(candidate.values), _copy_values(candidate.values)
        self.failure: str | None = None
        names = [free.name for free in self.problem.free if _descends(free, self.stages[self.stage])]
        self.tensors = {f"{name}.{key}": t for name in names for key, t in self.values[name].items()}
        for tensor in self.tensors.values():
            tensor.requires_grad_()
        self.optimizer = self.make_optimizer(list(self.tensors.values()), lr=self.stages[self.stage].learning_rate)
        if candidate.curvature is not None and isinstance(self.optimizer, QuasiNewton):
            self.optimizer.inherit(candidate.curvature)

    def state(self) -> dict[str, Any]:
        """State from which a descent is resumed."""
        return {
            "fingerprints": self.fingerprints,
            "stage": self.stage,
            "candidates": [tuple(candidate) for candidate in self.candidates],
            "has_standout": self.has_standout,
            "ended": [tuple(run) for run in self.ended],
            "values": _copy_values(self.values),
            "best": self.best,
            "failure": self.failure,
            "losses": self.losses,
            "descents": self.descents,
            "reason": self.reason,
            "optimizer": self.optimizer.state_dict(),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a state."""
        others = state.get("fingerprints")
        changed_fields = [
            name
            for name, fingerprint in self.fingerprints.items()
            if others is not None and others.get(name) != fingerprint
        ]
        if others is None or changed_fields:
            of_other = (
                f"of another fit (other {', '.join(changed_fields)})" if changed_fields else "of no fit of this version"
            )
            raise checkpoints.CheckpointError(
                f"checkpoint: got one {of_other}, expected one of this fit; "
                f"{checkpoints.OTHER_FILE_REMEDY}, or remove it"
            )
        device = self.context.device
        self.stage = state["stage"]
        self.candidates = [_Candidate(_copy_values(values, device), *fields) for values, *fields in state["candidates"]]
        self.has_standout = state["has_standout"]
        self.begin_stage()
        self._begin_run(_Candidate(_copy_values(state["values"], device), None))
        self.optimizer.load_state_dict(state["optimizer"])
        self.ended = [_FinishedRun(loss, _copy_values(best, device), *fields) for loss, best, *fields in state["ended"]]
        self.best, self.failure = _copy_values(state["best"], device), state["failure"]
        self.losses, self.descents, self.reason = state["losses"], state["descents"], state["reason"]

    def run(self) -> Iterator[None]:
        """Descend, step by step."""
        while self._advance():
            try:
                self._step()
            except _Diverged as error:
                self.failure = str(error)
            else:
                yield

    def _advance(self) -> bool:
        """Begin the next run or stage if one has ended; return whether there is a step to take.

        It asks the state alone, so that a state saved after any step goes on as the descent itself does.
        """
        if self.reason is not None:
            return False
        has_converged = self._has_converged()
        stage = self.stages[self.stage]
        is_over = has_converged or self.failure is not None or len(self.losses[-1]) == stage.iterations
        if not is_over:
            return True
        self.ended.append(self._ended_run())
        self.has_standout = self.has_standout or (len(self.candidates) > 1 and self._is_clearly_best(self.ended[-1]))
        if len(self.ended) < min(len(self.candidates), self._candidate_count(stage)):
            self._begin_run(self.candidates[len(self.ended)])
            self.losses.append([])
            self.descents[-1] += 1
            return True
        ranked_candidates = [
            _Candidate(run.best, run.curvature) for run in sorted(self.ended, key=lambda run: run.loss)
        ]
        is_last = self.stage + 1 == len(self.stages)
        if all(run.failure for run in self.ended):
            self.reason = self.ended[0].failure
        elif is_last:
            self.reason = "converged" if has_converged else "finished"
        if self.reason is not None:
            self.best = ranked_candidates[0].values
            return False
        stages = self.stages[self.stage : self.stage + 2]
        if len({tuple(free.name for free in self.problem.free if _descends(free, item)) for item in stages}) > 1:
            # curvature of other parameters
            ranked_candidates = [candidate._replace(curvature=None) for candidate in ranked_candidates]
        self.stage += 1
        self.candidates, self.ended = self._candidates_of_stage(ranked_candidates), []
        self.begin_stage()
        return True

    def iterations_left(self) -> int:
        """The most that may follow."""
        if self.reason is not None:
            return 0
        stage, *later_stages = self.stages[self.stage :]
        remaining_iterations = (len(self.candidates) - len(self.ended)) * stage.iterations - len(self.losses[-1])
        return remaining_iterations + sum(self._candidate_count(item) * item.iterations for item in later_stages)

    def _has_converged(self) -> bool:
        """Whether the loss has stopped falling by more than the tolerance; the optimizer decides where it can."""
        stage_tolerance = self.stages[self.stage].tolerance
        tolerance = self.tolerance if stage_tolerance is None else stage_tolerance
        losses = self.losses[-1]
        if losses and isinstance(self.optimizer, QuasiNewton):
            return self.optimizer.has_converged(tolerance)
        # means, as the least loss may be the luck of a passing iterate
        recent, earlier = losses[-CONVERGENCE_WINDOW:], losses[-2 * CONVERGENCE_WINDOW : -CONVERGENCE_WINDOW]
        return len(earlier) == CONVERGENCE_WINDOW and sum(recent) >= (1 - tolerance) * sum(earlier)

    def _is_clearly_best(self, run: _FinishedRun) -> bool:
        """Whether a run's loss is far below the losses at perturbed values around its result."""
        part = self.stages[self.stage].standout
        if part == 0 or run.failure is not None:
            return False
        losses = []
        for values in self._perturbed_candidates(run.best, PERTURBED_STARTS):
            with torch.no_grad(), contextlib.suppress(ValueError):  # one that cannot be drawn
                losses.append(float(self.model.loss(values)[0]))
        return run.loss < part * min(filter(math.isfinite, losses), default=0.0)

    def _ended_run(self) -> _FinishedRun:
        """Finish a run: its best values, which its last step may have reached."""
        curvature = self.optimizer.curvature if isinstance(self.optimizer, QuasiNewton) else None
        best = _FinishedRun(min(self.losses[-1], default=math.inf), self.best, self.failure, curvature)
        if self.failure is not None:
            return best
        try:
            with torch.no_grad():
                final_loss = float(self.model.loss(self.values)[0])
        except ValueError as error:  # a step too far to be drawn
            return best._replace(failure=str(error))
        return best._replace(loss=final_loss, best=_copy_values(self.values)) if final_loss < best.loss else best

    def best_so_far(self) -> dict[str, Values]:
        """The best values found in the current stage."""
        return min([*self.ended, self._ended_run()], key=lambda run: run.loss).best

    def _step(self) -> None:
        """Evaluate the loss and take a step."""
        stage = self.stages[self.stage]
        for group in self.optimizer.param_groups:
            group["lr"] = stage.rate(len(self.losses[-1]))
        evaluated_losses: list[float] = []
        evaluated_values: dict[str, Values] = {}

        def closure() -> float:
            self.optimizer.zero_grad()
            try:
                loss, images = self.model.loss(self.values)
            except ValueError as error:
                if not self.losses[0] and not evaluated_losses:
                    raise  # values that were bad from the beginning
                raise _Diverged(str(error)) from error
            if not evaluated_losses:  # with the light that was solved for there
                evaluated_values.update(_copy_values(self.values))
            self.images = None if images is None else images.detach()
            _check_finite({"the images": images, "the loss": loss})
            loss.backward()
            _check_finite({f"the gradient of {name}": tensor.grad for name, tensor in self.tensors.items()})
            evaluated_losses.append(float(loss.detach()))
            return evaluated_losses[-1]

        self.optimizer.step(closure)
        with torch.no_grad():
            for free in self.problem.free:
                free.project(self.values[free.name])
        losses = self.losses[-1]
        losses.append(evaluated_losses[0])
        if losses[-1] == min(losses):
            self.best = evaluated_values
        _check_finite(self.tensors)


def _descends(free: Free, stage: Stage) -> bool:
    if stage.compares == "outlines":
        return free.shows_in_outlines
    return not (stage.solves_light and free.is_light)


def _copy_values(values: Mapping[str, Values], device: torch.device | None = None) -> dict[str, Values]:
    """A copy, on another device if one is given."""
    return {
        name: {key: tensor.detach().to(device, copy=True) for key, tensor in tensors.items()}
        for name, tensors in values.items()
    }


def _check_finite(tensors: Mapping[str, torch.Tensor | None]) -> None:
    for name, tensor in tensors.items():
        if tensor is not None and not torch.isfinite(tensor).all():
            raise _Diverged(f"{name} became NaN or Inf")


def short_adam(parameters: list[torch.Tensor], lr: float) -> torch.optim.Optimizer:
    """Adam with a memory for descents of tens of iterations."""
    return torch.optim.Adam(parameters, lr=lr, betas=(0.8, 0.99))


def default_optimizer(parameters: list[torch.Tensor], lr: float) -> torch.optim.Optimizer:
    """Quasi-Newton steps for up to 100 values, such as poses and colors; :func:`short_adam` for more."""
    few = sum(tensor.numel() for tensor in parameters) <= MAX_QUASI_NEWTON_VALUES
    return QuasiNewton(parameters, lr) if few else short_adam(parameters, lr)


@check.keywords(**dict.fromkeys(("lr", "learning_rate", "iterations"), "stages=[Stage(iterations, learning_rate)]"))
@torch_on_one_thread()
def fit(
    problem: Problem,
    stages: str | Sequence[Stage] = (Stage(),),
    *,
    optimizer: Callable[..., torch.optim.Optimizer] = default_optimizer,
    tolerance: float = 1e-4,
    seed: int = 0,
    device: str | torch.device = "cpu",
    checkpoint: AnyPath | None = None,
    checkpoint_seconds: float = 10.0,
    preview: AnyPath | None = None,
    preview_seconds: float = 2.0,
    view: bool | FitViewer = False,
    progress: bool = True,
) -> Result:
    """Fit the free parameters of a problem.

    Args:
        problem: The problem.
        stages: Stages in order; "pose" and "deformation" are ready-made ones, :func:`pose_stages` and
            :func:`deformation_stages`. The paper's reference setting is ``[Stage(1000, learning_rate=1e-2)]`` with
            ``optimizer=torch.optim.SGD``.
        optimizer: Makes an optimizer of a list of tensors and ``lr``: any class of ``torch.optim``, by default
            :func:`default_optimizer`.
        tolerance: A stage has converged when over 25 iterations, or by the last and the next step of a QuasiNewton, its
            loss falls by less than this part.
        seed: Of candidates that are drawn at random.
        checkpoint: File to which the state is written, and from which a fit goes on where one that was interrupted left
            off, with the result that it would have had (on a CPU, to the bit). A line says from which iteration.
        checkpoint_seconds: Time between checkpoints [s].
        preview: PNG that shows targets, images and their difference while the fit runs.
        preview_seconds: Time between previews [s].
        view: Open a page in the browser that shows targets, images, their difference and the losses, and on which the
            fit can be paused and stopped; it is closed when the fit ends. Or a :class:`FitViewer`, which stays open. A
            fit that was stopped goes on from its checkpoint.
        progress: Show progress, that of sphere fits included.
    Returns:
        The result. If a value becomes NaN or Inf, the result has the best values before that, and a :class:`FitWarning`
        names the quantity.
    Raises:
        ValueError: for a problem that cannot be rendered.
        CheckpointError: for a checkpoint of another problem.
    """
    check.instance("problem", problem, Problem, "a Problem, as Problem(scene, targets, free) makes it")
    stages = stages_for(stages, problem)
    if not callable(optimizer):
        raise ValueError(
            f"optimizer: got {check.described(optimizer)}, expected a function (tensors, lr) → optimizer, such as "
            "torch.optim.Adam"
        )
    torch_device = torch.device(wp.device_to_torch(check.device("device", str(device))))
    check_part("tolerance", tolerance, "of the loss")
    for name, file in (("checkpoint", checkpoint), ("preview", preview)):
        if file is not None and not Path(file).parent.is_dir():
            raise ValueError(f"{name}: got {str(file)!r}, expected a file in a folder that is there")
    warn_before(problem)
    with checkpoints.exclusive(checkpoint), watching(view, progress=progress) as watch:
        descent = _Descent(problem, stages, optimizer, tolerance, seed, torch_device, progress)
        durations = _descend(descent, checkpoint, checkpoint_seconds, preview, preview_seconds, progress, watch)
        reason = descent.reason or "stopped"
        if watch is not None:
            watch.end(descent, reason)
    if descent.reason is not None and all(run.failure for run in descent.ended):
        check.warn(
            f"the fit stopped in stage {descent.stage + 1}: {descent.reason}; the best values before it are kept",
            FitWarning,
        )
    seconds = statistics.median(durations) if durations else math.nan
    values = descent.best if descent.reason else descent.best_so_far()
    result = Result(problem, descent.context, values, descent.losses, reason, seconds, descent.stages[-1])
    if reason in GOOD_ENDINGS and durations:  # not of one that had ended before
        warn_of(result)
    return result


def _descend(
    descent: _Descent,
    checkpoint: AnyPath | None,
    checkpoint_seconds: float,
    preview: AnyPath | None,
    preview_seconds: float,
    progress: bool,
    watch: Watch | None,
) -> list[float]:
    """Go on from a checkpoint, to the end or until it is stopped; returns the times of the last iterations [s]."""
    state = None if checkpoint is None else checkpoints.load(checkpoint)
    if state is None:
        descent.begin_stage()
    else:
        descent.restore(state)

    def save() -> None:
        if checkpoint is not None:
            checkpoints.save(checkpoint, descent.state())

    save_time = preview_time = time.perf_counter()
    durations: list[float] = []
    done = sum(map(len, descent.losses))
    if state is not None and state["reason"] is None:
        remark(f"going on from iteration {done}, of {checkpoint}", shows=progress)
    total, label = done + descent.iterations_left(), "preparing: kernels, shadows, form factors"
    with progress_bar(total, label, "iteration", done=done, shows=progress, stays=True) as bar:
        start = time.perf_counter()
        for _ in descent.run():
            current_time = time.perf_counter()
            durations = [*durations[-99:], current_time - start]
            if current_time - save_time >= checkpoint_seconds:
                save()
                save_time = time.perf_counter()
            if preview is not None and current_time - preview_time >= preview_seconds:
                with torch.no_grad():
                    write_image(preview, side_by_side(descent.model.targets, descent.model.images(descent.values)))
                preview_time = time.perf_counter()
            bar.update()
            stage_text = f"stage {descent.stage + 1} of {len(descent.stages)}"
            bar.describe("fitting", f"{stage_text}, loss {descent.losses[-1][-1]:.3e}")
            bar.expect(descent.iterations_left())
            if watch is not None and not watch.update(descent, save):
                break
            start = time.perf_counter()
        bar.expect(descent.iterations_left())
    if state is None or state["reason"] is None:  # else it would look as if it had ended now
        save()
    return durations
