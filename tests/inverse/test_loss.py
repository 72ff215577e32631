"""Losses: their costs, the weights that stand for them, and targets that are saturated."""

import numpy as np
import pytest
import torch

import warpshadow as ws
from warpshadow.inverse import Light, Loss, Problem, Target
from warpshadow.inverse.loss import clip_saturated
from warpshadow.inverse.model import LightModel
from warpshadow.inverse.target import stack_targets

KINDS = [Loss(), Loss("l1"), Loss("huber"), Loss("geman-mcclure", 0.3)]
KINDS += [Loss("barron", 0.3, alpha=alpha) for alpha in (2.0, 1.0, 0.0, -2.0, -7.5)]
CPU = torch.device("cpu")


def images(seed: int, scale: float = 0.4) -> torch.Tensor:
    return scale * torch.rand(1, 3, 5, 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("loss", KINDS, ids=lambda loss: f"{loss.kind} {loss.alpha}")
def test_reweighted_squares_have_the_gradient_of_the_loss(loss):
    got, target, weights = images(0).requires_grad_(), images(1)[..., :3], torch.rand(1, 3, 5, dtype=torch.float64)
    loss(got, target, weights, 0.7).backward()
    x = (got.detach()[..., :3] - target) / 0.7
    by_weights = 2 * loss.pixel_weights(x) * x * weights[..., None] / (0.7 * weights.sum())
    np.testing.assert_allclose(got.grad[..., :3], by_weights, rtol=1e-9, atol=1e-12)


def test_barrons_loss_has_its_special_cases():
    got, target, weights = images(0), images(1)[..., :3], torch.ones(1, 3, 5, dtype=torch.float64)

    def cost(kind: str, delta: float = 0.1, alpha: float = -2.0) -> float:
        return float(Loss(kind, delta, alpha=alpha)(got, target, weights, 1.0))

    assert cost("barron", 0.3, 2.0) == pytest.approx(cost("l2"))
    assert cost("barron", 0.3, -2.0) == pytest.approx(cost("geman-mcclure", 0.6))
    assert cost("barron", 0.3, 1e-7) == pytest.approx(cost("barron", 0.3, 0.0), rel=1e-5)
    charbonnier = 2 * 0.3**2 * (((got[..., :3] - target).square().sum(-1) / 0.3**2 + 1).sqrt() - 1).mean()
    assert cost("barron", 0.3, 1.0) == pytest.approx(float(charbonnier))


def test_a_redescending_loss_forgets_an_occluder():
    got = torch.zeros(1, 1, 2, 4)
    target = torch.zeros(1, 1, 2, 3)
    target[0, 0, 1] = 5.0
    loss = Loss("geman-mcclure", 0.2)
    weights = loss.pixel_weights(got[..., :3] - target)
    assert weights[0, 0, 0, 0] == 1 and weights[0, 0, 1, 0] < 1e-5
    assert float(loss(got, target, torch.ones(1, 1, 2), 1.0)) < 0.2**2


@pytest.mark.parametrize("loss", KINDS, ids=lambda loss: f"{loss.kind} {loss.alpha}")
def test_confidence_is_the_weight_relative_to_that_of_a_pixel_that_is_explained(loss):
    x = torch.tensor([[0.0, 0.0, 0.0], [0.05, 0.1, -0.02], [2.0, 1.0, -3.0]], dtype=torch.float64)
    confidence = loss.confidence(x)
    assert confidence[0] == 1 and (confidence >= 0).all() and (confidence <= 1).all()
    if loss.is_robust:
        ratio = (loss.pixel_weights(x) / loss.pixel_weights(x * 0)).mean(dim=-1)
        np.testing.assert_allclose(confidence, ratio)
        assert confidence[2] < 0.2 < confidence[1]
    else:
        assert (confidence == 1).all()


def test_a_saturated_target_is_a_lower_bound():
    target = Target(np.array([[[1.0, 0.5, 0.2], [0.3, 0.3, 0.3]]]), saturation=1.0)
    assert target.saturated.tolist() == [[[True, False, False], [False] * 3]]
    packed = stack_targets([target], 1.0, CPU)
    brighter, darker = packed.images + 0.5, packed.images - 0.5
    both = [(clip_saturated(image, *packed[::2]) - packed.images)[0, 0] for image in (brighter, darker)]
    np.testing.assert_allclose(both[0], [[0, 0.5, 0.5], [0.5] * 3])
    np.testing.assert_allclose(both[1], np.full((2, 3), -0.5))
    assert stack_targets([target], 0.5, CPU).saturated.tolist() == [[[[True, False, False]]]]


def test_saturation_is_a_value_as_it_is_stored(tmp_path):
    codes = np.array([[[250, 100, 0], [249, 255, 3]]], np.uint8)
    from PIL import Image

    Image.fromarray(codes).save(tmp_path / "photo.png")
    target = Target(tmp_path / "photo.png", saturation=250 / 255, exposure=1.0)
    assert target.saturated.tolist() == [[[True, False, False], [False, True, False]]]
    assert Target(tmp_path / "photo.png").saturated is None


def test_light_alone_is_no_quadratic_form_where_targets_are_saturated():
    ball = ws.Scene((ws.Body(ws.icosphere(1.0, 1), blockers=0),), np.ones((4, 3)))
    image = np.ones((8, 8, 3))
    camera = ws.Camera.look_at((0, 0, 4), (0, 0, 0), size=(8, 8))
    assert LightModel.applies(Problem(ball, Target(image, camera=camera), Light(2)))
    assert not LightModel.applies(Problem(ball, Target(image, camera=camera, saturation=1.0), Light(2)))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Loss("cauchy"), "kind: got 'cauchy'"),
        (lambda: Loss("barron", alpha=3), "alpha: got 3"),
        (lambda: Target(np.ones((2, 2, 3)), saturation=255), "saturation: got 255"),
    ],
)
def test_mistakes_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
