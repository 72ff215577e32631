"""Uncertainty of a fit: Gauss–Newton's normal matrix at its end, and the direction that the images tell least of.

With residuals r and their Jacobian J by the few parameters θ, such as poses and exposures, the loss curves as H = JᵀJ,
and errors of the images move θ by H⁻¹ Jᵀ r. Neighboring residuals have common causes (a shadow that is too soft, a
highlight), so their products are summed over tiles of pixels [Liang and Zeger 1986, the sandwich estimator]:

    cov θ = H⁻¹ (Σ_tile g gᵀ) H⁻¹,  g = Σ_{p in tile} J_p r_p.

A free light is linear, so it is projected out: from each column of J the best change of the light is subtracted. Priors
count as measurements with their own standard deviations. J is of central differences of small images.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from warpshadow.inverse.free import Plane, Pose
from warpshadow.inverse.free.base import PRIOR, Values
from warpshadow.inverse.loss import clip_saturated
from warpshadow.inverse.model import Model
from warpshadow.inverse.problem import Problem
from warpshadow.inverse.variable_projection import ProjectedModel
from warpshadow.inverse.verdict import MIN_EXPLAINED_SHARE, Verdict, small_stage
from warpshadow.inverse.world import FitContext, FittedScene

MAX_UNCERTAIN_NUMBERS = 32
"""Numbers that a parameter has at most to be among the uncertain ones; textures are taken as they are."""

MAX_POSE_UNCERTAINTY = 0.02  # part of its diagonal by which a body may be uncertain without a warning

CANDIDATE_SPACING = 0.06  # distance between candidates along a flat direction [half diagonals of the body]

_STEP = 0.01  # of differences: half a pixel or less of the small images
_TILE = 8  # pixels across of the small images
_RIDGE = 1e-9  # of normal matrices, as a share of their largest entry


@dataclass(frozen=True, eq=False)
class PoseUncertainty:
    """Standard deviations of a pose.

    Args:
        shift: Of the body's middle along x, y and z [scene units], shape [3].
        turn: Root mean square over all axes together [degrees].
        least: Shift of the middle by one deviation along the direction that is known least [scene units], [3].
        least_turn: Turn beside it [degrees].
        along_view: Part of the shift that is along the view, 0 to 1.
        diagonal: Of the body's bounding box [scene units].
        explained: Share of the body, by the pixels that it and its shadow change, that targets show, 0 to 1; below 0.85
            it may be elsewhere, whatever the deviations.
        remark: How it stands, if that was assumed: deviations do not know of it.
    """

    shift: np.ndarray
    turn: float
    least: np.ndarray
    least_turn: float
    along_view: float
    diagonal: float
    explained: float = 1.0
    remark: str = ""

    @property
    def is_flat(self) -> bool:
        """Whether the body is uncertain by more than 2% of its diagonal."""
        turn_distance = np.radians(self.least_turn) * self.diagonal / 2
        return float(np.hypot(np.linalg.norm(self.least), turn_distance)) > MAX_POSE_UNCERTAINTY * self.diagonal

    def __repr__(self) -> str:
        return f"PoseUncertainty({self})"

    def __str__(self) -> str:
        length = np.linalg.norm(self.least)
        direction_text = (
            "along the view" if self.along_view > 0.9 else f"along {np.round(self.least / max(length, 1e-12), 2)}"
        )
        text = f"known least: ±{length:.2g} {direction_text}, turned by ±{self.least_turn:.2g}°"
        text += f"; it {self.remark}" * bool(self.remark)
        doubt = f"; but targets show {self.explained:.0%} of it and its shadow: it may be elsewhere"
        return text + doubt * (self.explained < MIN_EXPLAINED_SHARE)


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Uncertainty of a fit's few parameters.

    Args:
        names: Of the numbers, as "pose[0].shift[1]".
        covariance: Of them in the units of the fit's values, [number, number].
        poses: By bodies' names.
        light: Standard deviation of the total radiance of a free light, as a part of it; None where it is not free.
    """

    names: list[str] = field(repr=False)
    covariance: np.ndarray = field(repr=False)
    poses: dict[str, PoseUncertainty]
    light: float | None

    @property
    def deviations(self) -> dict[str, float]:
        """Standard deviations of the numbers, in the units of the fit's values."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def stops(self) -> list[float]:
        """Standard deviations of the views' exposures."""
        return [sd / np.log(2.0) for name, sd in self.deviations.items() if name.startswith("exposure.log[")]


class NormalMatrix:
    """The normal matrix at some values, and the sum over tiles.

    Attributes:
        parameter_entries: Of each number: the parameter's name, its key, and the index in its flat tensor.
        normal_matrix: H, by directions in which the numbers move, [direction, direction].
        score_covariance: Σ g gᵀ, likewise.
    """

    def __init__(self, problem: Problem, context: FitContext, values: Mapping[str, Values]):
        self.problem, self.context = problem, context
        self.values = {name: {key: t.detach().clone() for key, t in parts.items()} for name, parts in values.items()}
        stage = small_stage(problem)
        self.model = (ProjectedModel if problem.light else Model)(problem, context, stage)
        self.parameter_entries = _few_number_entries(problem, self.values)
        self.directions = self._directions()
        self.roots: list[torch.Tensor] = []  # of the weights of colors, and of coverage
        with torch.no_grad():
            if isinstance(self.model, ProjectedModel):
                self.model.solve(self.values)
            self.residuals = self._residuals()
            self.columns = np.stack([self._difference(direction) for direction in self.directions.T], axis=-1)
            self.light = self._project_light() if isinstance(self.model, ProjectedModel) else None
        curvature = self.directions.T @ self._prior() @ self.directions
        flat = self.columns.reshape(-1, self.columns.shape[-1])
        self.normal_matrix = flat.T @ flat + PRIOR * curvature
        self.normal_matrix += _RIDGE * np.abs(self.normal_matrix).max() * np.eye(len(self.normal_matrix))
        scores = _by_tiles(self.columns * self.residuals[..., None])
        self.score_covariance = scores.T @ scores + PRIOR**2 * curvature

    def _directions(self) -> np.ndarray:
        """Directions in which the numbers may move, [number, direction].

        Of the numbers of a quaternion or of two columns the changes that turn the body by a radian about each axis, and
        none along which they change and it does not, such as a quaternion's length.
        """
        directions = np.eye(len(self.parameter_entries))
        for free in self.problem.free_of(Pose):
            if free.rotation != "axis-angle":
                entries = enumerate(self.parameter_entries)
                rows = [index for index, entry in entries if entry[:2] == (free.name, "turn")]
                turns = np.zeros((len(directions), 3))
                turns[rows] = np.linalg.pinv(self.slopes(free, rows)[3:])
                directions = np.concatenate([directions[:, ~directions[rows].any(axis=0)], turns], axis=1)
        return directions

    def moved(self, step: np.ndarray) -> dict[str, Values]:
        """The values, their numbers moved by a step, [number]."""
        values = {name: {key: t.clone() for key, t in parts.items()} for name, parts in self.values.items()}
        for (name, key, number), part in zip(self.parameter_entries, step.tolist(), strict=True):
            values[name][key].view(-1)[number] += part
        return values

    def plane(self, free: Pose) -> Plane | None:
        """The free plane that a body stands on."""
        return next((plane for plane in self.problem.free_of(Plane) if free.number in plane.carries), None)

    def pose_of(self, free: Pose) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Rotation, middle in the world, and scale of a body, its plane moved."""
        rotation, center, scale = free.moved(self.values[free.name], self.context)
        plane = self.plane(free)
        if plane is not None:
            rotation, center = plane.moved(self.values[plane.name], self.context, rotation, center)
        return rotation, center, scale

    def slopes(self, free: Pose, rows: Sequence[int]) -> np.ndarray:
        """Derivatives of a body's middle [scene units] and turn [radians] by some of the numbers, [6, row]."""
        slopes = np.zeros((6, len(rows)))
        for column, index in enumerate(rows):
            name, key, number = self.parameter_entries[index]
            parts = self.values[name]
            ends = []
            for step in (_STEP, -_STEP):
                parts[key].view(-1)[number] += step
                rotation, center, _ = self.pose_of(free)
                ends.append((rotation.double().numpy(force=True), center.double().numpy(force=True)))
                parts[key].view(-1)[number] -= step
            turn = (ends[0][0] @ ends[1][0].T - ends[1][0] @ ends[0][0].T) / 2  # of small turns
            slopes[:, column] = [*(ends[0][1] - ends[1][1]), turn[2, 1], turn[0, 2], turn[1, 0]]
        return slopes / (2 * _STEP)

    def _residuals(self) -> np.ndarray:
        """Differences, weighted so that their squares have the loss's gradient, [view, height, width, channel].

        The weights of reweighted least squares are the first call's: at the result.
        """
        model, loss = self.model, self.problem.loss
        world = model.world(self.values)
        bounded_images = clip_saturated(world.images(), model.targets, model.saturated)
        residuals = [(bounded_images[..., :3] - model.targets[..., :3]) / self.context.unit]
        if model.targets.shape[-1] == 4:
            residuals.append(bounded_images[..., 3:] - model.targets[..., 3:])
        if not self.roots:
            weights = loss.pixel_shares(model.weights)[..., None]
            factors = (1.0, loss.coverage)
            self.roots = [
                (f * weights * loss.pixel_weights(x)).sqrt() for f, x in zip(factors, residuals, strict=False)
            ]
        parts = [roots * x for roots, x in zip(self.roots, residuals, strict=True)]
        if model.outlines is not None:
            gaps = model.outlines.differences(world.masks(), world.outline_offsets)
            pixels = gaps.new_zeros(len(model.cameras), *gaps.shape[1:], len(gaps))
            for number, view in enumerate(model.outlines.views):
                pixels[view, ..., number] = gaps[number]
            parts.append(pixels * float(np.sqrt(loss.coverage / gaps[0].numel())))
        return torch.cat(parts, dim=-1).double().cpu().numpy()

    def _difference(self, direction: np.ndarray) -> np.ndarray:
        """Derivative of the residuals along a direction of the numbers; from one side where they end at a bound."""
        start, residual_pair, number_pair = self.values, [], []
        for values in (self.moved(_STEP * direction), self.moved(-_STEP * direction)):
            for free in self.problem.free:
                free.project(values[free.name])
            self.values = values
            residual_pair.append(self._residuals())
            number_pair.append([float(values[name][key].view(-1)[n]) for name, key, n in self.parameter_entries])
        self.values = start
        length = np.subtract(number_pair[0], number_pair[1]) @ direction / (direction @ direction)
        return (residual_pair[0] - residual_pair[1]) / length

    def _project_light(self) -> float:
        """Take the best change of the light out of the columns; the relative deviation of its total."""
        assert isinstance(self.model, ProjectedModel)
        model = self.model
        design = (model.design(self.values, model.emitted(self.values)) * self.roots[0]).double().cpu().numpy()
        radiance, is_lamp = model.solution, np.arange(len(model.solution)) >= len(model.atoms)
        prior, total, variance = model.prior(), 0.0, 0.0
        for color in range(3):
            active = radiance[:, color] > 1e-3 * radiance[:, color].max()
            basis = design[active][..., color].reshape(int(active.sum()), -1).T  # [pixel, atom]
            form = basis.T @ basis + prior[np.ix_(active, active)]
            form += 1e-6 * np.trace(form) / max(len(form), 1) * np.eye(len(form))
            columns = self.columns[..., color, :]
            flat = columns.reshape(-1, columns.shape[-1])
            flat -= basis @ np.linalg.solve(form, basis.T @ flat)
            self.columns[..., color, :] = flat.reshape(columns.shape)
            errors = self.residuals[..., color]
            shape = (*errors.shape, 1, basis.shape[1])
            scores = _by_tiles((basis * errors.reshape(-1, 1)).reshape(shape))
            ones = np.linalg.solve(form, 1.0 - is_lamp[active])
            total += radiance[active & ~is_lamp, color].sum()
            variance += float(((scores @ ones) ** 2).sum())
        return float(np.sqrt(variance) / total) if total > 0 else 0.0

    def _prior(self) -> np.ndarray:
        """Precision that priors have, [number, number]: the curvature of their regularizers."""
        rows = []
        for name, key, number in self.parameter_entries:
            ends = []
            for step in (_STEP, -_STEP):
                self.values[name][key].view(-1)[number] += step
                ends.append(self._prior_slopes())
                self.values[name][key].view(-1)[number] -= step
            rows.append((ends[0] - ends[1]) / (2 * _STEP))
        return np.reshape(rows, (len(rows), len(rows))) / (2 * PRIOR)

    def _prior_slopes(self) -> np.ndarray:
        """Derivatives of the regularizers that are priors by the numbers, [number]."""
        leaves = {
            name: {key: t.clone().requires_grad_() for key, t in parts.items()} for name, parts in self.values.items()
        }
        total = torch.zeros(())
        for free in self.problem.free:
            if free.has_prior:
                term = free.regularizer(leaves[free.name], self.context)
                total = total if term is None else total + term
        if total.requires_grad:
            total.backward()
        slopes = []
        for name, key, number in self.parameter_entries:
            gradient = leaves[name][key].grad
            slopes.append(0.0 if gradient is None else float(gradient.view(-1)[number]))
        return np.array(slopes)


def _by_tiles(pixels: np.ndarray) -> np.ndarray:
    """Sums over tiles and channels, [view, height, width, channel, number] to [tile, number]."""
    sums = pixels.sum(axis=-2)
    rows = np.add.reduceat(sums, np.arange(0, sums.shape[1], _TILE), axis=1)
    return np.add.reduceat(rows, np.arange(0, sums.shape[2], _TILE), axis=2).reshape(-1, sums.shape[-1])


def uncertainty(
    problem: Problem, context: FitContext, values: Mapping[str, Values], fitted: FittedScene, verdict: Verdict
) -> Uncertainty | None:
    """Find the uncertainty of a fit's few parameters; None without any."""
    if not _few_number_entries(problem, values):
        return None
    normal = NormalMatrix(problem, context, values)
    inverse = normal.directions @ np.linalg.inv(normal.normal_matrix)
    covariance = inverse @ normal.score_covariance @ inverse.T
    poses = {
        pose.called(fitted): _pose_uncertainty(pose, normal, covariance, verdict.shown[pose.called(fitted)])
        for pose in problem.free_of(Pose)
    }
    names = [f"{name}.{key}[{number}]" for name, key, number in normal.parameter_entries]
    return Uncertainty(names, covariance, poses, normal.light)


def _pose_uncertainty(free: Pose, normal: NormalMatrix, covariance: np.ndarray, explained: float) -> PoseUncertainty:
    """The uncertainty of a pose in scene units and degrees."""
    context = normal.context
    plane = normal.plane(free)
    names = {free.name} if plane is None else {free.name, plane.name}
    rows = [index for index, (name, _, _) in enumerate(normal.parameter_entries) if name in names]
    _, center, scale = normal.pose_of(free)
    half = context.extent(free.number) * float(scale)
    slopes = normal.slopes(free, rows)
    cov = slopes @ covariance[np.ix_(rows, rows)] @ slopes.T
    units = np.array([1.0] * 3 + [half] * 3)  # a turn by a radian moves vertices about as far
    sizes, directions = np.linalg.eigh(cov * units[:, None] * units)
    weakest_direction = np.sqrt(max(sizes[-1], 0.0)) * directions[:, -1]
    view = center.double().numpy(force=True) - context.cameras[0].eye
    length = float(np.linalg.norm(weakest_direction[:3]))
    view_share = abs(float(weakest_direction[:3] @ view)) / (length * float(np.linalg.norm(view))) if length else 0.0
    return PoseUncertainty(
        np.sqrt(np.diag(cov)[:3]),
        float(np.degrees(np.sqrt(np.trace(cov[3:, 3:])))),
        weakest_direction[:3],
        float(np.degrees(np.linalg.norm(weakest_direction[3:]) / half)),
        view_share,
        2 * half,
        explained,
        free.constraint(context).remark,
    )


def candidates_along_flat_direction(
    problem: Problem, context: FitContext, values: Mapping[str, Values], count: int
) -> list[dict[str, Values]]:
    """Displace values along the least determined direction of the poses, both ways, and solve for the light anew."""
    normal = NormalMatrix(problem, context, values)
    poses = [index for index, (name, _, _) in enumerate(normal.parameter_entries) if name.startswith(f"{Pose.key}[")]
    weakest_direction = np.zeros(len(normal.parameter_entries))
    if poses:
        moving = normal.directions[poses].any(axis=0)
        spread = np.linalg.inv(normal.normal_matrix)[np.ix_(moving, moving)]
        weakest_direction = normal.directions[:, moving] @ np.linalg.eigh(spread)[1][:, -1]
    return [
        normal.moved(CANDIDATE_SPACING * (number // 2 + 1) * (-1) ** number * weakest_direction)
        for number in range(count)
    ]


def _few_number_entries(problem: Problem, values: Mapping[str, Values]) -> list[tuple[str, str, int]]:
    """Name, key and index of the numbers of parameters that have few.

    Light is projected out: that of a map, and beside it that of lamps, whose emission is then left out here.
    """
    light_names = {free.name for free in problem.free if free.is_light and problem.light}
    return [
        (name, key, number)
        for name, parts in values.items()
        for key, tensor in parts.items()
        if name not in light_names and tensor.numel() <= MAX_UNCERTAIN_NUMBERS
        for number in range(tensor.numel())
    ]
