"""Flat bodies that cast shadows block direct light as planes."""

import numpy as np
import pytest
import torch

import warpshadow as ws
from warpshadow.scene.blockers import scene_blockers
from warpshadow.torch import TorchRenderer


def scene_of(*, ground=1, directions=128, method="directional", tilt=0.0):
    """A ball close to a ground that casts shadows."""
    ball = ws.Body(ws.icosphere(0.5, 3), blockers=ws.Spheres([[0, 0, 0]], [0.5]), translation=(0, 0.55, 0), name="ball")
    floor = ws.Body(ws.plane(4.0, 1), blockers=ground, rotation=(0, 0, tilt), name="ground")
    sky = ws.EnvironmentMap(np.linspace(0.5, 1.5, 32)[:, None, None] * np.ones((32, 64, 3)))
    camera = ws.Camera.look_at((0, 0.7, 3), (0, 0.5, 0), size=(32, 32))
    visibility = ws.Visibility(method, **({"directions": directions} if method == "directional" else {"samples": 4096}))
    return ws.Scene([ball, floor], sky, camera, visibility=visibility)


def on_ball(image):
    return image[9:22, 10:22, :3]


def test_a_ground_darkens_a_ball_as_rays_find_it_and_its_sphere_does_not():
    truth = on_ball(ws.render(scene_of(method="ray-traced")))
    own_sphere = scene_blockers(scene_of())[1]
    errors = [np.abs(on_ball(ws.render(scene_of(ground=given))) - truth).mean() for given in (1, own_sphere)]
    assert errors[0] < 0.02 * truth.mean()
    assert errors[1] > 1.5 * errors[0]


def test_explanations_tell_of_flats():
    assert ws.Renderer(scene_of()).explain()["flats"]
    assert not ws.Renderer(scene_of(ground=0)).explain()["flats"]
    assert not ws.Renderer(scene_of(ground=ws.Spheres([[0, -9, 0]], [9.0]))).explain()["flats"]


@pytest.mark.parametrize("moving", [None, ["ball"], ["ground"]])
def test_gradients_to_poses_are_those_of_differences(moving):
    renderer = TorchRenderer(scene_of(directions=64, tilt=5.0))
    rotations, translations, scales = renderer.scene_poses()
    step = torch.tensor([[0.1, 1.0, 0.2], [0.1, -1.0, 0.1]])
    if moving is not None:
        step[1 if moving == ["ball"] else 0] = 0

    def loss(shift):
        geometry = renderer.placed(rotations, translations + shift * step, scales, moving=moving)
        return (on_ball(renderer(geometry=geometry)).double() ** 2).sum()

    shift = torch.zeros((), requires_grad=True)
    loss(shift).backward()
    ends = [float(loss(torch.tensor(sign * 1e-3))) for sign in (1, -1)]
    assert float(shift.grad) == pytest.approx((ends[0] - ends[1]) / 2e-3, rel=0.01)
