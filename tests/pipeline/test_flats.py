"""Flat bodies that cast shadows block direct light as planes."""

import dataclasses

import numpy as np
import pytest
import torch
import warp as wp

import warpshadow as ws
from warpshadow.maths.directions import fibonacci
from warpshadow.scene.blockers import scene_blockers
from warpshadow.torch import TorchRenderer

STEP = 1e-3


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


def inside_ball(image):
    """Pixels away from its silhouette."""
    return image[11:20, 12:20, :3]


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


MOVES = {
    "ball": np.float32([[0.1, 1, 0.2], [0, 0, 0]]),
    "ground": np.float32([[0, 0, 0], [0.1, -1, 0.1]]),
    "both": np.float32([[0.3, 1, 0.2], [-0.2, 1.5, 0.1]]),
}


@pytest.mark.parametrize("step", MOVES.values(), ids=MOVES)
def test_gradients_of_shading_alone_are_those_of_differences(step):
    """Points stay where they are on the ball, so no rasterizer takes part."""
    renderer = ws.Renderer(scene_of(directions=64, tilt=5.0))
    poses = renderer.scene_poses()
    translations = poses.translations.numpy()
    normals = fibonacci(192).astype(np.float32)
    on_ball_at_rest = translations[0, 0] + np.float32(0.5) * normals
    weights = np.random.default_rng(0).normal(size=(1, len(normals), 3)).astype(np.float32)

    def shading(shift):
        placed = wp.array(translations + np.float32(shift) * step, dtype=wp.vec3, requires_grad=True)
        points = wp.array((on_ball_at_rest + np.float32(shift) * step[0])[None], dtype=wp.vec3, requires_grad=True)
        with wp.Tape() as tape:
            geometry = renderer.placed(dataclasses.replace(poses, translations=placed))
            lit = renderer.shade(view=renderer.at_points(points, wp.array(normals[None], dtype=wp.vec3), geometry))
        return lit, points, placed, tape

    lit, points, placed, tape = shading(0)
    tape.backward(grads={lit: wp.array(weights, dtype=wp.vec3)})
    found = (placed.grad.numpy()[0] * step).sum() + (points.grad.numpy()[0] @ step[0]).sum()
    below, above = ((shading(shift)[0].numpy().astype(float) * weights).sum() for shift in (-STEP, STEP))
    assert found == pytest.approx((above - below) / (2 * STEP), rel=0.005)


@pytest.mark.parametrize("moving", [None, ["ball"], ["ground"]])
def test_gradients_of_pixels_inside_the_ball_are_those_of_differences(moving):
    """At silhouettes a difference of images is of another kind: pixels there have a gradient of areas."""
    renderer = TorchRenderer(scene_of(directions=64, tilt=5.0))
    rotations, translations, scales = renderer.scene_poses()
    step = torch.from_numpy(MOVES["both" if moving is None else moving[0]])

    def loss(shift):
        geometry = renderer.placed(rotations, translations + shift * step, scales, moving=moving)
        return (inside_ball(renderer(geometry=geometry)).double() ** 2).sum()

    shift = torch.zeros((), requires_grad=True)
    loss(shift).backward()
    ends = [float(loss(torch.tensor(sign * STEP))) for sign in (1, -1)]
    assert float(shift.grad) == pytest.approx((ends[0] - ends[1]) / (2 * STEP), rel=0.01)


# By the heights of the sources themselves a step of 0.003 is off by a third, and one of 0.02 twice or more.
@pytest.mark.parametrize(("bounces", "off"), [(1, 0.03), (2, 0.05)])
def test_a_ball_that_touches_the_ground_has_the_gradient_of_wide_steps(bounces, off):
    """Its lowest sources sink into the ground, whose back does not light them: the loss is as smooth as above it."""
    touching = scene_of(directions=64)
    ball = dataclasses.replace(touching.bodies[0], translation=(0, 0.5, 0), receivers="vertex")
    floor = dataclasses.replace(touching.bodies[1], mesh=ws.plane(4.0, 20), receivers="vertex")
    renderer = TorchRenderer(dataclasses.replace(touching, bodies=(ball, floor), bounces=bounces))
    rotations, translations, scales = renderer.scene_poses()
    up = torch.from_numpy(np.float32([[0, 1, 0], [0, 0, 0]]))
    assert (renderer.warp.body_ids()[0, 48:] == 1).all()

    def loss(height):
        image = renderer(geometry=renderer.placed(rotations, translations + height * up, scales))
        return (image[24:, :, :3].double() * torch.linspace(0, 1, 32)[:, None]).sum()  # of the ground alone

    height = torch.zeros((), requires_grad=True)
    loss(height).backward()
    for step in (0.003, 0.02):
        with torch.no_grad():
            ends = [float(loss(torch.tensor(sign * step))) for sign in (1, -1)]
        assert float(height.grad) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=off), step
