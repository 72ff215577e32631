"""Quasi-Newton steps: where they lead, how far they go, and that what is taken back leaves no trace but its lesson."""

import copy
import io
from collections.abc import Callable

import numpy as np
import pytest
import scipy.optimize
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from warpshadow.inverse import QuasiNewton, quasi_newton

CURVATURE = torch.tensor([[1.0, 0.3, 0.0], [0.3, 30.0, -0.5], [0.0, -0.5, 300.0]])
LOWEST = torch.tensor([0.7, -0.4, 0.2])


def bowl(x: torch.Tensor) -> torch.Tensor:
    return 0.5 * (x - LOWEST) @ CURVATURE @ (x - LOWEST)


def valley(x: torch.Tensor) -> torch.Tensor:
    """Rosenbrock's."""
    return (100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2).sum()


def walked(
    loss: Callable[[torch.Tensor], torch.Tensor], start: list[float], count: int, lr: float = 0.1
) -> tuple[list[float], list[np.ndarray], QuasiNewton]:
    """Losses and places of so many evaluations."""
    x = torch.tensor(start, requires_grad=True)
    optimizer = QuasiNewton([x], lr)
    losses, places = [], []

    def closure() -> float:
        optimizer.zero_grad()
        value = loss(x)
        value.backward()
        losses.append(float(value))
        places.append(x.detach().numpy().astype(np.float64))
        return losses[-1]

    for _ in range(count):
        optimizer.step(closure)
    return losses, places, optimizer


def test_it_finds_the_lowest_place_of_a_bowl_that_is_300_times_as_steep_one_way_as_another():
    losses, places, _ = walked(bowl, [0.0, 0.0, 0.0], 25)
    np.testing.assert_allclose(places[int(np.argmin(losses))], LOWEST, atol=1e-4)


def test_it_finds_the_end_of_a_bent_valley_as_scipy_does():
    losses, places, _ = walked(valley, [-1.2, 1.0, 0.8], 100)
    expected = scipy.optimize.minimize(scipy.optimize.rosen, [-1.2, 1.0, 0.8], jac=scipy.optimize.rosen_der).x
    np.testing.assert_allclose(places[int(np.argmin(losses))], expected, atol=5e-3)


def test_no_value_changes_by_more_than_the_rate_at_first_nor_ever_by_more_than_five_times_it():
    _, places, _ = walked(bowl, [40.0, 0.0, 0.0], 20, lr=0.5)
    longest = np.abs(np.diff(places, axis=0)).max(axis=1)
    assert longest[0] == pytest.approx(0.5, rel=1e-5)
    assert longest.max() == pytest.approx(2.5, rel=1e-5)


def test_a_step_that_raises_the_loss_is_taken_back_and_the_next_is_shorter():
    losses, places, _ = walked(lambda x: torch.where(x < 0.05, -x, 10 * x).sum(), [0.0], 3, lr=0.1)
    assert losses[1] > losses[0]
    first, second, third = (place[0] for place in places)
    assert first < third < first + 0.51 * (second - first)


def test_it_has_converged_where_steps_gain_nothing_and_not_before():
    losses, _, optimizer = walked(bowl, [0.0, 0.0, 0.0], 3)
    assert not optimizer.has_converged(1e-2)
    _, _, optimizer = walked(lambda x: bowl(x) + 1, [0.0, 0.0, 0.0], 30)
    assert optimizer.has_converged(1e-4)
    assert losses[0] > losses[2]


@pytest.mark.parametrize("ratio", [1, 25, 100, 400, 1e4, 1e5, 1e6])
def test_a_flat_tensor_beside_a_steep_one_is_found_before_it_has_converged(ratio):
    """As the roughness of a body that shows a sun, and of a dull one."""
    steep, flat = (torch.tensor([value], requires_grad=True) for value in (0.6, 0.7))
    optimizer = QuasiNewton([steep, flat], 0.02)
    for _ in range(25):

        def closure() -> float:
            optimizer.zero_grad()
            loss = torch.log(1 + 200 * (steep - 0.3) ** 2).sum() + (1 + 10 * (flat - 0.45) ** 2).sum() / ratio
            loss.backward()
            return float(loss.detach())

        optimizer.step(closure)
        if optimizer.has_converged(1e-4):
            break
    assert optimizer.has_converged(1e-4)
    assert float(steep) == pytest.approx(0.3, abs=1e-3) and float(flat) == pytest.approx(0.45, abs=5e-3)


def coupled(rng: np.random.Generator, ratio: float) -> torch.Tensor:
    """Curvature of a steep tensor of 3 values and one of 6 that is so much flatter, coupled by 0.9 at most."""
    axes = [np.linalg.qr(rng.normal(size=(size, size)))[0] for size in (3, 6)]
    steep, flat = (a @ np.diag(4 ** rng.uniform(0, 1, len(a))) @ a.T for a in axes)
    coupling = rng.normal(size=(3, 6))
    mixed = np.linalg.cholesky(steep) @ (0.9 / np.linalg.norm(coupling, 2) * coupling) @ np.linalg.cholesky(flat).T
    scale = np.r_[np.ones(3), np.full(6, ratio**-0.5)]
    return torch.from_numpy(scale[:, None] * np.block([[steep, mixed], [mixed.T, flat]]) * scale).float()


@pytest.mark.parametrize("ratio", [5, 20, 200, 1e4])
def test_a_flat_tensor_that_is_coupled_to_a_steep_one_is_found_before_it_has_converged(ratio):
    counts, gaps = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        curvature = coupled(rng, ratio)
        start, lowest = (torch.from_numpy(rng.uniform(-0.3, 0.3, 9)).float() for _ in range(2))
        floor = 0.5 * (start - lowest)[3:] @ curvature[3:, 3:] @ (start - lowest)[3:]
        tensors = [part.clone().requires_grad_() for part in start.split([3, 6])]
        optimizer = QuasiNewton(tensors, 0.02)
        for count in range(1, 101):  # noqa: B007 (read after the loop)

            def closure(tensors=tensors, optimizer=optimizer, lowest=lowest, curvature=curvature, floor=floor):
                optimizer.zero_grad()
                offset = torch.cat(tensors) - lowest
                loss = 0.5 * offset @ curvature @ offset + floor
                loss.backward()
                return float(loss.detach())

            loss = optimizer.step(closure)
            if optimizer.has_converged(1e-4):
                break
        counts.append(count)
        gaps.append(loss / float(floor) - 1)
    assert max(gaps) < 10 * 1e-4 and np.median(counts) <= 25


def test_it_has_converged_where_the_loss_is_too_coarse_to_fall_further():
    """Steps that promise nothing are taken back for ever."""

    def coarse(x: torch.Tensor) -> torch.Tensor:
        loss = ((x - 0.3) ** 2 + 0.1 * (x - 0.3) ** 4).sum() + 1
        return loss + (torch.round(loss * 5e3) / 5e3 - loss).detach()

    for start in (0.5, 1.1, 1.3, 2.0):
        losses, _, optimizer = walked(coarse, [start], 20)
        assert optimizer.has_converged(1e-5) and min(losses) == 1


def test_where_nothing_changes_it_stays():
    losses, places, optimizer = walked(lambda x: (0 * x).sum() + 3, [0.5, 0.5], 3)
    assert losses == [3, 3, 3] and (np.array(places) == 0.5).all() and optimizer.has_converged(0.0)


def test_what_inherits_curvature_knows_the_way_at_once():
    _, _, optimizer = walked(bowl, [0.0, 0.0, 0.0], 20)
    x = torch.tensor([0.6, -0.35, 0.25], requires_grad=True)
    heir = QuasiNewton([x], 1.0)
    heir.inherit(optimizer.curvature)

    def closure() -> float:
        heir.zero_grad()
        value = bowl(x)
        value.backward()
        return float(value)

    before = heir.step(closure)
    assert float(bowl(x)) < 1e-2 * before


def test_its_state_goes_on_to_the_bit():
    def on(count: int, x: torch.Tensor, optimizer: QuasiNewton) -> None:
        def closure() -> float:
            optimizer.zero_grad()
            value = valley(x)
            value.backward()
            return float(value)

        for _ in range(count):
            optimizer.step(closure)

    x = torch.tensor([-1.2, 1.0, 0.8], requires_grad=True)
    optimizer = QuasiNewton([x], 0.1)
    on(15, x, optimizer)
    file = io.BytesIO()
    torch.save(optimizer.state_dict(), file)
    y = copy.deepcopy(x.detach()).requires_grad_()
    other = QuasiNewton([y], 0.1)
    file.seek(0)
    other.load_state_dict(torch.load(file, weights_only=True))
    on(15, x, optimizer), on(15, y, other)
    assert torch.equal(x, y)


def test_values_that_are_clamped_end_at_the_least_within_their_bounds():
    """Of convex functions, against L-BFGS-B; minima out of bounds pull values against these."""
    rng = np.random.default_rng(0)
    for _ in range(40):
        count = rng.integers(2, 7)
        axes, _ = np.linalg.qr(rng.normal(size=(count, count)))
        curvature, middle = axes @ np.diag(10 ** rng.uniform(-2, 0, count)) @ axes.T, rng.uniform(-0.5, 1.5, count)

        def loss(x, curvature=curvature, middle=middle):
            return 0.5 * (x - middle) @ curvature @ (x - middle) + 1e-3

        given = {"method": "L-BFGS-B", "bounds": [(0, 1)] * count, "options": {"ftol": 1e-15, "gtol": 1e-12}}
        least = scipy.optimize.minimize(loss, np.full(count, 0.5), **given).fun
        values = torch.full((count,), 0.5, dtype=torch.float64, requires_grad=True)
        optimizer = QuasiNewton([values], lr=0.02)
        tensors = torch.from_numpy(curvature), torch.from_numpy(middle)
        for _ in range(200):

            def closure(values=values, optimizer=optimizer, tensors=tensors):
                optimizer.zero_grad()
                found = loss(values, *tensors)
                found.backward()
                return float(found.detach())

            found = optimizer.step(closure)
            with torch.no_grad():
                values.clamp_(0, 1)
            if optimizer.has_converged(1e-6):
                break
        assert found < 1.001 * least


def test_a_step_waits_for_the_device_three_times_however_long_its_memory_is(monkeypatch):
    """A wait is a read of numbers: of torch's own, as by float(), or several at once."""
    read, waits = quasi_newton._read_numbers, []
    monkeypatch.setattr(quasi_newton, "_read_numbers", lambda *values: waits.append("several") or read(*values))

    class Reads(TorchDispatchMode):
        def __torch_dispatch__(self, function, types, arguments=(), options=None):
            if function is torch.ops.aten._local_scalar_dense.default:
                waits.append("one")
            return function(*arguments, **(options or {}))

    x = torch.tensor([-1.0, 1.2, 0.4, 1.3], requires_grad=True)
    optimizer = QuasiNewton([x], 0.1)

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        value = valley(x)
        value.backward()
        return value.detach()

    for _ in range(20):
        waits.clear()
        with Reads():
            optimizer.step(closure)
    assert len(optimizer.curvature[0]) > 8
    assert sorted(waits) == ["one", "several", "several", "several"]  # one of the loss
