"""Bodies that emit in surfaces that shine, as a whole: images by renderers and stills, and gradients of images."""

import dataclasses

import numpy as np
import pytest
import torch
import twins

import warpshadow as ws
from warpshadow.torch import TorchRenderer

# Relative L2 of gradients against differences of images, where nothing moves at a silhouette.
SMOOTH = 2e-2
# Relative L2 of images in the dark, kept against stills. Measured 0.3%.
KEPT = 0.01

DARK = ws.EnvironmentMap.constant(0.0)
SMALL, ONE = ws.icosphere(0.3, 2), ws.Spheres([(0, 0, 0)], [0.29])
LAMP = ws.Body(SMALL, (0, 0, 0), blockers=ONE, translation=(-1.2, 2.0, -0.6), emission=(6, 5, 4), name="lamp")
BALL = ws.Body(
    ws.icosphere(0.5, 3), (0.8, 0.5, 0.3), translation=(0.4, 0.5, 0), roughness=0.35, metallic=0.7, name="ball"
)
GROUND = ws.Body(ws.plane(6.0, 8), (0.3, 0.5, 0.6), roughness=0.4, name="ground")
POST = ws.Body(SMALL, blockers=ONE, translation=(-0.92, 1.0, 0.24), name="post")

ABOVE = ws.Camera.look_at((0.2, 3.0, 3.6), (-0.2, 0.3, 0.1), fov_y=25, size=(32, 32))


def scene_of(*bodies, light=DARK, method="directional", **options):
    visibility = ws.Visibility(method, sampling="shared") if method == "ray-traced" else ws.Visibility(method)
    bodies = bodies or (LAMP, BALL, GROUND)
    return ws.Scene(bodies, light, ABOVE, visibility=visibility, supersampling=1, **options)


def image_of(*bodies, **options):
    return ws.Renderer(scene_of(*bodies, **options)).render()[..., :3]


def dull(*bodies):
    return [dataclasses.replace(body, specular=0.0) if body.roughness is not None else body for body in bodies]


def test_kept_renderers_and_stills_show_the_same_highlights():
    kept, still = image_of(), image_of(method="ray-traced")
    assert np.linalg.norm(kept - still) < KEPT * np.linalg.norm(still)
    metal = dataclasses.replace(BALL, metallic=1.0)
    assert image_of(LAMP, metal).max() > 1  # by its highlight alone: it has no diffuse light


def test_a_body_between_takes_the_highlight_away():
    highlight, behind_post = (
        image_of(*bodies, GROUND) - image_of(*dull(*bodies, GROUND)) for bodies in ((LAMP,), (LAMP, POST))
    )
    row, column, _ = np.unravel_index(highlight.argmax(), highlight.shape)
    assert highlight[row, column, 0] > 0.03 and abs(behind_post[row, column, 0]) < 0.003
    without = dataclasses.replace(POST, translation=(-1.5, 2.9, -1.35))  # behind the lamp
    beyond = image_of(LAMP, without, GROUND) - image_of(*dull(LAMP, without, GROUND))
    np.testing.assert_allclose(beyond, highlight, atol=1e-5)


@pytest.mark.parametrize("bounces", [0, 1])
def test_highlights_add_to_the_light_of_the_map_and_are_linear_in_emission(bounces):
    sky = ws.synthetic_sky((-0.7, 0.5, 0.2), sun_radius=12, sun_strength=3, height=32)
    twice = dataclasses.replace(LAMP, emission=(12, 10, 8))
    unlit = dataclasses.replace(LAMP, emission=None)
    off, once, double = (image_of(lamp, BALL, GROUND, light=sky, bounces=bounces) for lamp in (unlit, LAMP, twice))
    np.testing.assert_allclose(double - off, 2 * (once - off), atol=2e-4)


WEIGHTS = torch.tensor(np.sin(0.1 * np.arange(32 * 32 * 3)).reshape(32, 32, 3))


@pytest.mark.parametrize(
    ("name", "value"), [("roughness", [0.45]), ("metallic", [0.5]), ("specular", [0.7]), ("emission", [5.0, 4.0, 3.0])]
)
def test_gradients_of_highlights_agree_with_differences(name, value):
    renderer = TorchRenderer(scene_of(LAMP, BALL, GROUND, POST), progress=False)
    body = "lamp" if name == "emission" else "ball"

    def loss(values):
        return (renderer(**{name: {body: values}})[..., :3].double() * WEIGHTS).sum()

    gradient, difference = twins.slopes(loss, torch.tensor(value), 3e-3)
    np.testing.assert_allclose(gradient, difference, rtol=SMOOTH, atol=1e-3)


def test_gradients_to_the_pose_of_a_lamp_agree_with_differences():
    renderer = TorchRenderer(scene_of(LAMP, BALL, GROUND, POST), progress=False)
    rotations, translations, scales = renderer.scene_poses()

    def loss(value):
        shifts = torch.cat([value, torch.zeros(3, 3)])
        image = renderer(geometry=renderer.placed(rotations, translations + shifts, scales))
        return (image[..., :3].double() * WEIGHTS).sum()

    gradient, difference = twins.slopes(loss, torch.zeros(1, 3), 3e-3)
    assert np.linalg.norm(gradient - difference) < SMOOTH * np.linalg.norm(difference)
