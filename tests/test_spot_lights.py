"""Spot lights as a whole: images by renderers, stills and paths, and gradients of images."""

import dataclasses
import functools

import numpy as np
import pytest
import torch
import twins

import warpshadow as ws
from warpshadow.torch import TorchRenderer, rotation_matrices

# Relative L2 of renderers against rays, of direct light. Measured 0.8%.
RENDERED = 0.02
# Relative, of the mean of light that bounces, by renderers and stills against paths. Measured 2.4 and 0.8%.
BOUNCED = 0.04
# Relative L2 of gradients against differences, where nothing moves at a silhouette. Measured at most 9e-4, of turns.
SMOOTH = 5e-3

DARK = ws.EnvironmentMap.constant(0.0)
ONE = ws.Spheres([(0, 0, 0)], [0.3])
BALL = ws.Body(ws.icosphere(0.3, 3), (0.8, 0.5, 0.3), blockers=ONE, translation=(0, 0.3, 0), name="ball")
GROUND = ws.Body(ws.plane(4.0, 8), (0.5, 0.5, 0.5), name="ground")
WALL = ws.Body(ws.plane(4.0, 8), (0.5, 0.6, 0.5), rotation=(90, 0, 0), translation=(0, 2, -1.2), name="wall")
PLACE = {"albedo": (0, 0, 0), "blockers": 0, "emission": (60, 54, 45), "translation": (0.3, 1.8, 0.6), "name": "lamp"}
ROUND = ws.Body(ws.icosphere(0.08, 2), beam=(20, 30), rotation=(-70, 0, 0), **PLACE)
FLAT = ws.Body(ws.plane(0.15, 2), beam=(20, 30), rotation=(-160, 0, 0), **PLACE)
CAMERA = ws.Camera.look_at((0, 2.4, 4), (0, 0.8, 0), fov_y=45, size=(32, 32))


def scene_of(*bodies, camera=CAMERA, **options):
    return ws.Scene(bodies, DARK, camera, supersampling=1, **options)


def image_of(*bodies, **options):
    return ws.Renderer(scene_of(*bodies, **options)).render()[..., :3]


def unlike(image, other):
    return np.linalg.norm(image - other) / np.linalg.norm(other)


KINDS = {
    "kept": ws.Visibility("directional"),
    "still": ws.Visibility("ray-traced", sampling="shared"),
    "paths": ws.Visibility("ray-traced", samples=512),
}


@pytest.mark.parametrize("lamp", [ROUND, FLAT], ids=["ball", "panel"])
def test_renderers_stills_and_paths_show_the_same_spot_and_what_bounces_of_it(lamp):
    bodies = BALL, GROUND, WALL, lamp
    direct, full = (
        {name: image_of(*bodies, visibility=kind, bounces=bounces) for name, kind in KINDS.items()}
        for bounces in (0, 2)
    )
    assert unlike(direct["kept"], direct["paths"]) < RENDERED
    everywhere = image_of(*bodies[:3], dataclasses.replace(lamp, beam=None), visibility=KINDS["kept"])
    outside = direct["kept"].max(axis=-1) < 1e-6
    assert 0.5 < outside.mean() < 0.95 and everywhere[outside].mean() > 0.01
    inside = direct["kept"].max(axis=-1) > 0.9 * everywhere.max(axis=-1)
    assert inside[everywhere.max(axis=-1) > 0.03].mean() > 0.05
    bounced = {name: (full[name] - direct[name]).mean() for name in KINDS}
    for name in ("kept", "still"):
        assert bounced[name] == pytest.approx(bounced["paths"], rel=BOUNCED)


def test_a_surface_that_mirrors_shows_a_spot_that_shines_on_it_alone():
    glossy = dataclasses.replace(BALL, roughness=0.35, metallic=1.0)
    for kind in ("directional", "ray-traced"):
        options = {"visibility": ws.Visibility(kind)}
        lamps = ROUND, dataclasses.replace(ROUND, beam=None), dataclasses.replace(ROUND, rotation=(110, 0, 0))
        lit, everywhere, away = (image_of(glossy, lamp, **options)[16:] for lamp in lamps)  # below the lamp
        assert lit.max() == pytest.approx(everywhere.max(), rel=0.01) and lit.max() > 0.1
        assert away.max() < 1e-6


@pytest.mark.parametrize("method", ["directional", "none", "ray-traced"])
def test_a_camera_sees_the_radiance_that_goes_its_way(method):
    """In the cone, in the falloff, and beside it."""
    for angle, share in ((10.0, 1.0), (45.0, None), (70.0, 0.0)):
        way = np.array([np.sin(np.radians(angle)), 0, -np.cos(np.radians(angle))])
        lamp = dataclasses.replace(ROUND, beam=(30, 60), translation=(0, 0, 0), rotation=(0, 0, 0))
        camera = ws.Camera.look_at(2 * way, (0, 0, 0), fov_y=2, size=(8, 8))
        shown = image_of(lamp, camera=camera, visibility=ws.Visibility(method))[3:5, 3:5].mean(axis=(0, 1))
        if share is None:
            inner, outer, cosine = np.cos(np.radians([30, 60, 45]))
            t = (cosine - outer) / (inner - outer)
            share = t * t * (3 - 2 * t)
        np.testing.assert_allclose(shown, share * np.array([60, 54, 45]), rtol=0.01, atol=1e-6)


def test_a_panel_with_a_beam_emits_to_its_front():
    above = dataclasses.replace(GROUND, translation=(0, 3, 0), rotation=(180, 0, 0))
    camera = ws.Camera.look_at((0, 1.2, 2), (0, 3, 0), fov_y=60, size=(16, 16))
    for beam, is_lit in (((20, 30), False), (None, True)):
        image = image_of(above, dataclasses.replace(FLAT, beam=beam), camera=camera)
        assert (image.max() > 0.1) == is_lit


def weights():
    row, column = np.mgrid[0:1:32j, 0:1:32j]
    return torch.tensor(np.stack([np.sin(3 * row + 2 * column), np.cos(2 * row), 1 + column, 0 * row], -1)).float()


@pytest.mark.parametrize("lamp", [ROUND, FLAT], ids=["ball", "panel"])
@pytest.mark.parametrize("glossy", [False, True])
def test_gradients_of_images_agree_with_differences(lamp, glossy):
    """To the place of the lamp, its turn and its radiance, and to the place of the ground, which fills the image."""
    camera = ws.Camera.look_at((0.2, 2.5, 1.5), (0.4, 0, 0.1), fov_y=24, size=(32, 32))
    ground = dataclasses.replace(GROUND, roughness=0.5) if glossy else GROUND
    scene = scene_of(ground, lamp, camera=camera, visibility=ws.Visibility("directional"))
    renderer = TorchRenderer(scene, progress=False)
    rotations, translations, scales = renderer.scene_poses()

    def loss(place, turn, emission, ground):
        turned = torch.stack([rotations[0], rotation_matrices(turn) @ rotations[1]])
        placed = renderer.placed(turned, translations + torch.stack([ground, place]), scales)
        return (renderer(geometry=placed, emission={"lamp": emission}) * weights()).sum()

    zero = torch.zeros(3)
    values = {"place": zero, "turn": zero, "emission": torch.tensor([60.0, 54, 45]), "ground": zero}
    for name, step in {"place": 5e-3, "turn": 5e-3, "emission": 5.0, "ground": 5e-3}.items():
        loss_of_one = functools.partial(lambda name, value: loss(**values | {name: value}), name)
        gradient, differences = twins.slopes(loss_of_one, values[name], step)
        assert np.linalg.norm(gradient - differences) < SMOOTH * np.linalg.norm(differences), name


def test_a_batch_of_turns_is_a_batch_of_images():
    renderer = TorchRenderer(scene_of(GROUND, WALL, ROUND, visibility=ws.Visibility("directional")), progress=False)
    rotations, translations, scales = renderer.scene_poses()
    turns = rotation_matrices(torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]]))
    turned = rotations.expand(2, 3, 3, 3).clone()
    turned[:, 2] = turns @ rotations[2]
    images = renderer(geometry=renderer.placed(turned, translations.expand(2, 3, 3), scales.expand(2, 3)))
    for image, rotation in zip(images, turned, strict=True):
        alone = renderer(geometry=renderer.placed(rotation, translations, scales))
        torch.testing.assert_close(image, alone, atol=1e-5, rtol=1e-4)
    assert (images[0] - images[1]).abs().max() > 0.05


def test_a_lamp_without_a_beam_pays_nothing_for_one():
    renderer = ws.Renderer(scene_of(GROUND, dataclasses.replace(ROUND, beam=None)))
    renderer.render()
    assert "beams" not in str(renderer.explain())
    assert "beams" in str(ws.Renderer(scene_of(GROUND, ROUND)).explain())
