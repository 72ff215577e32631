"""Quasi-Newton steps with a trust region that grows and shrinks by the achieved decrease."""

import math
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import numpy as np
import torch

T = TypeVar("T")

Curvature = tuple[list[torch.Tensor], list[torch.Tensor]]  # steps, and how the gradient changed over them, [value] each

HISTORY = 12  # how many steps are kept: of six values, their curvature wholly

_BOUND_GROWTH = 2.0  # of the bound, where a step that reached it was kept
_MIN_BOUND_FACTOR, _MAX_BOUND_FACTOR = 0.1, 0.5  # factors of the bound after a rejected step, relative to the step
_MAX_BOUND = 5.0  # the bound at most, in learning rates
_MIN_CURVATURE_COSINE = 1e-3  # least cosine of a step and the change of the gradient that tell the curvature
_ALIKE = 10.0
"""Ratio up to which a tensor has the scale of all; of a larger ratio this part is left out, so that scales do not jump.
With 1, losses of poses leaped between stages."""

_MAX_SCALE_RATIO = 1e4  # of the rest of that ratio


class QuasiNewton(torch.optim.Optimizer):
    """L-BFGS with bounded steps, one evaluation each.

    - **Direction:** that of Nocedal and Wright 2006, algorithm 7.4, but curvature that no step has told of may differ
      between tensors: one whose scale is beyond tenfold of that of all has its own, but for that tenfold. By one scale,
      the steepest tensor's, a flat one would not move, and the fit would count as converged. (The roughness of a shiny
      ball had 1e4 times the curvature of a dull bunny's.) The change of a tensor's gradient over a step tells of its
      curvature, not how far it went itself: the loss may couple a flat tensor to a steep one.
    - **Length:** no value changes by more than a bound. A step that lowers the loss is kept, and the bound grows if it
      was reached. Another one is taken back and makes the bound shorter; its gradient tells of curvature nonetheless.
    - **Clamped values** stay where they are as long as the loss would fall beyond, and the direction is that of the
      others [Nocedal and Wright 2006, section 16.7, gradient projection].

    Args:
        parameters: Tensors of one device.
        lr: The first bound, which may change from step to step: the bound grows to five times of it at most.
    """

    def __init__(self, parameters: Iterable[torch.Tensor], lr: float):
        super().__init__(parameters, {"lr": lr})
        self._tensors: list[torch.Tensor] = self.param_groups[0]["params"]

    @property
    def _memory(self) -> dict[str, Any]:
        """All that is kept: tensors, numbers, and lists of tensors."""
        return self.state[self._tensors[0]]

    @property
    def curvature(self) -> Curvature:
        """Curvature estimates."""
        memory = self._memory
        return memory.get("steps", []), memory.get("changes", [])

    def inherit(self, curvature: Curvature) -> None:
        """Take over the curvature that another one found, of a similar loss."""
        place = self._tensors[0]
        names = ("steps", "changes")
        self._memory.update({n: [item.to(place) for item in part] for n, part in zip(names, curvature, strict=True)})

    def has_converged(self, tolerance: float) -> bool:
        """Whether the last step gained, and the next may gain, at most this part of the loss.

        A step that was taken back tells if it had promised no more: then the loss is as low as it is exact.
        """
        memory = self._memory
        return max(memory.get("gained", math.inf), memory["hoped"]) <= tolerance * abs(memory["loss"])

    @torch.no_grad()
    def step(self, closure: Callable[[], float]) -> float:  # type: ignore[override]
        """Evaluate where the last step led, keep it or take it back, and take the next."""
        with torch.enable_grad():
            loss = float(closure())
        memory, place, gradient = self._memory, self._flatten(self._tensors), self._flatten(self._gradients())
        if "loss" not in memory:
            memory["bound"] = self._rate
            self._keep(loss, place, gradient, torch.zeros_like(place))
        else:
            self._accept_or_reject(loss, place, gradient)
        direction, bound = self._direction(), memory["bound"]
        longest_step, slope = _read_numbers(direction.abs().max(), _dot(memory["gradient"], direction))
        if longest_step > bound or not self.curvature[0]:  # a gradient alone does not tell how far
            factor = bound / longest_step if longest_step > 0 else 0.0
            direction, slope = factor * direction, factor * slope
        memory["hoped"] = -slope
        memory["aim"] = memory["place"] + direction
        self._move_to(memory["aim"])
        return loss

    @property
    def _rate(self) -> float:
        return self.param_groups[0]["lr"]

    def _gradients(self) -> list[torch.Tensor]:
        return [torch.zeros_like(t) if t.grad is None else t.grad for t in self._tensors]

    @staticmethod
    def _flatten(tensors: Iterable[torch.Tensor]) -> torch.Tensor:
        return torch.cat([tensor.reshape(-1) for tensor in tensors])

    def _move_to(self, place: torch.Tensor) -> None:
        parts = place.split([tensor.numel() for tensor in self._tensors])
        for tensor, part in zip(self._tensors, parts, strict=True):
            tensor.copy_(part.view_as(tensor))

    def _keep(self, loss: float, place: torch.Tensor, gradient: torch.Tensor, sides: torch.Tensor) -> None:
        self._memory.update(loss=loss, place=place, gradient=gradient, sides=sides)

    def _clamped_sides(self, place: torch.Tensor) -> torch.Tensor:
        """Side of the bound to which a value was clamped, ±1; 0 for other values."""
        memory = self._memory
        unchanged_sides = torch.where(place == memory["place"], memory["sides"], 0.0)
        return torch.where(place == memory["aim"], unchanged_sides, torch.sign(memory["aim"] - place))

    def _accept_or_reject(self, loss: float, place: torch.Tensor, gradient: torch.Tensor) -> None:
        """Keep the last step or take it back, and bound the next."""
        memory = self._memory
        step, change = place - memory["place"], gradient - memory["gradient"]  # maybe clamped
        numbers = (
            _dot(memory["gradient"], step),
            step.abs().max(),
            *(_dot(*pair) for pair in _curvature_pairs(step, change)),
        )
        slope, length, *products = _read_numbers(*numbers)
        if _has_positive_curvature(*products):
            steps, changes = self.curvature
            memory["steps"], memory["changes"] = [*steps, step][-HISTORY:], [*changes, change][-HISTORY:]
        loss_increase = loss - memory["loss"]
        if loss_increase >= 0 and length > 0:
            # of the parabola through both
            lower_bound = -slope / (2 * (loss_increase - slope)) if loss_increase > slope else _MAX_BOUND_FACTOR
            memory["bound"] = length * min(max(lower_bound, _MIN_BOUND_FACTOR), _MAX_BOUND_FACTOR)
            memory["gained"] = min(memory.get("gained", math.inf), memory["hoped"])
            return
        if length > 0.8 * memory["bound"]:
            memory["bound"] = min(_BOUND_GROWTH * memory["bound"], _MAX_BOUND * self._rate)
        memory["gained"] = -loss_increase
        self._keep(loss, place, gradient, self._clamped_sides(place))

    def _direction(self) -> torch.Tensor:
        """Quasi-Newton direction: minus the gradient times the inverse curvature estimated from the steps.

        All vectors of the recursion are sums of steps, changes and the gradient. So it works on the factors of these
        [Chen et al. 2014, Large-scale L-BFGS using MapReduce], whose dot products are read all at once. Values are in
        units of their tensor's scale meanwhile.
        """
        memory, (steps, changes) = self._memory, self.curvature
        is_movable = (memory["sides"] * memory["gradient"] >= 0).to(memory["gradient"])
        downhill = -memory["gradient"] * is_movable
        if not steps:
            return downhill
        step_rows, change_rows = torch.stack(steps).double(), torch.stack([*changes, downhill]).double()
        scales = self._scales(step_rows, change_rows[:-1])
        vectors = torch.cat([step_rows / scales, change_rows * scales]) * is_movable
        products = np.array(_read_numbers(*(vectors @ vectors.T)))
        count = len(steps)
        pairs = [(k, count + k) for k in range(count)]
        pairs = [
            (k, j) for k, j in pairs if _has_positive_curvature(*(products[pair] for pair in _curvature_pairs(k, j)))
        ]
        factors, parts = np.zeros(2 * count + 1), []
        factors[-1] = 1.0
        for step, change in reversed(pairs):
            parts.append(products[step] @ factors / products[step, change])
            factors[change] -= parts[-1]
        if pairs:
            step, change = pairs[-1]
            factors *= products[step, change] / products[change, change]
        for (step, change), part in zip(pairs, reversed(parts), strict=True):
            factors[step] += part - products[change] @ factors / products[step, change]
        return (torch.from_numpy(factors).to(vectors) @ vectors * scales).to(downhill)

    def _scales(self, steps: torch.Tensor, changes: torch.Tensor) -> torch.Tensor:
        """Scale of each value, the same over its tensor: 1/√(curvature of the tensor), [value].

        For a curvature matrix H, whose diagonal block of the tensor is H_t, a step s and a change y = H s,

            |y_t|² ≤ λ_max(H_t) s·y,

        by the inequality of Cauchy and Schwarz, however the loss couples tensors. So the largest |y_t|² / s·y over
        steps [step, value] is no more than the tensor's curvature, and reaches it by a step along that tensor alone.
        """
        curvatures = _row_dots(steps, changes).clamp_min(torch.finfo(steps.dtype).tiny)
        sizes = [tensor.numel() for tensor in self._tensors]
        parts = torch.stack([_row_dots(part, part) for part in changes.split(sizes, dim=1)]) / curvatures
        of_all, of_tensors = parts.sum(dim=0).max(), parts.max(dim=1).values
        ratios = torch.where(of_tensors > 0, of_all / of_tensors, 1.0)
        ratios = (ratios / _ALIKE).clamp(1.0, _MAX_SCALE_RATIO)
        scales = (ratios / of_all).sqrt()
        return torch.cat([scale.expand(size) for scale, size in zip(scales, sizes, strict=True)])


def _curvature_pairs(step: T, change: T) -> tuple[tuple[T, T], ...]:
    """Dot products that decide whether the loss curves upwards over a step."""
    return (step, change), (step, step), (change, change)


def _has_positive_curvature(mixed_product: float, step: float, change: float) -> bool:
    """Whether the loss curves upwards over a step, by its :func:`_curvature_pairs` with how the gradient changed."""
    return mixed_product > _MIN_CURVATURE_COSINE * math.sqrt(step * change)


def _row_dots(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    return (first * second).sum(dim=1)


def _dot(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    return first.double() @ second.double()


def _read_numbers(*values: torch.Tensor) -> list[Any]:
    """Numbers of a device, for which the host waits once."""
    return torch.stack([value.double() for value in values]).cpu().numpy().tolist()
