"""Bodies in photographs: shadows are those that a whole render has, and nothing else of the photograph changes."""

import dataclasses
import re
import warnings

import numpy as np
import pytest
import torch
import warp as wp

import warpshadow as ws
from warpshadow.torch import TorchRenderer, rotation_matrices

SIZE = 48, 36
SKY = ws.synthetic_sky((-0.7, 0.5, 0.2), sun_radius=12, sun_strength=3, height=32)
CAMERA = ws.Camera.look_at((0.5, 2.2, 3.6), (0, 0.4, 0), size=SIZE)
COLORS = np.random.default_rng(0).uniform(0.2, 0.8, (4, 4, 3)).astype(np.float32)

# Relative, of a whole image: a pixel of the photograph is multiplied, that is its mean by the mean ratio.
MEAN_OF_PIXEL = 0.01
# Of 256 rays a pixel, which are others in another image. Measured 0.03.
NOISE = 0.035
# Of gradients where silhouettes move, over so few pixels. Measured 0.034 to 0.066; of the scene's image 0.043 to 0.063.
SILHOUETTE = 0.08


def ball(**options):
    spheres = ws.Spheres([(0, 0, 0)], [1.0])
    given = {"albedo": (0.8, 0.3, 0.2), "blockers": spheres, "translation": (0, 0.55, 0), "scale": 0.5, "name": "ball"}
    return ws.Body(ws.icosphere(1.0, 3), **given | options)


def ground(**options):
    given = {"texture": COLORS, "receivers": "pixel", "name": "ground", "shadow_catcher": True}
    return ws.Body(ws.plane(8.0, 16), **given | options)


def scene_of(method="directional", bounces=0, bodies=None, **settings):
    visibility = ws.Visibility.of({"method": method, "samples": 256, **settings})
    return ws.Scene(bodies or [ball(), ground()], SKY, CAMERA, visibility, bounces=bounces)


def drawn(scene):
    """The image in which catchers are bodies as others are, over nothing."""
    bodies = [dataclasses.replace(body, shadow_catcher=False) for body in scene.bodies]
    return ws.Renderer(dataclasses.replace(scene, bodies=bodies), progress=False).render()


def relative_error(got, expected):
    return float(np.linalg.norm(got - expected) / np.linalg.norm(expected))


# ------------------------------------------------------------------------------------------------ what it computes


def test_over_nothing_shadows_are_the_mean_of_what_they_take_of_a_white_photograph():
    renderer = ws.Renderer(scene_of(), progress=False)
    black, white = (
        renderer.insert(wp.full((1, SIZE[1], SIZE[0]), wp.vec3(value), dtype=wp.vec3, device="cpu")).numpy()[0]
        for value in (0.0, 1.0)
    )
    image = renderer.render()
    np.testing.assert_array_equal(image[..., :3], black)
    np.testing.assert_allclose(image[..., 3], np.clip(1 - (white - black).mean(axis=2), 0, 1), atol=1e-6)
    both = ws.Renderer(scene_of(), cameras=[CAMERA, CAMERA.turned(40)], progress=False).render()
    np.testing.assert_allclose(both[0], image, atol=1e-6)


def test_what_is_brighter_than_white_is_said_with_an_exposure_that_is_not():
    scene = scene_of("none")
    photograph = np.full((36, 48, 3), 0.5, np.float32)
    dim = dataclasses.replace(scene, light=SKY.scaled(0.05))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ws.insert(dim, photograph, progress=False)
        ws.insert(scene, 4 * photograph, exposure=2, progress=False)  # linear beyond white
    with pytest.warns(UserWarning, match="^[0-9]+% of the inserted pixels are brighter than white, as is 0%") as caught:
        image = ws.insert(scene, photograph, exposure=2, progress=False)
    covered = ws.Renderer(scene, progress=False).layers().masks[0] > 0.5
    share, stops = re.match(r"(\d+)% .*--exposure (-?[\d.]+)\)", str(caught[0].message)).groups()
    assert int(share) == round(100 * float((image[covered].max(axis=1) > 1).mean())) > 10
    image = ws.insert(scene, photograph, exposure=float(stops), progress=False)
    assert (image[covered].max(axis=1) > 1).mean() <= 0.01 < (image[covered].max(axis=1) > 2**-0.1).mean()


@pytest.mark.parametrize("receivers", ["pixel", "vertex"])
@pytest.mark.parametrize("method", ["directional", "log-sh", "none", "ray-traced"])
def test_in_a_photograph_of_the_ground_alone_the_image_is_that_of_all(method, receivers):
    scene = scene_of(method, bodies=[ball(), ground(receivers=receivers, blockers=0)])
    photograph = drawn(dataclasses.replace(scene, bodies=scene.bodies[1:]))[..., :3]
    whole = drawn(scene)[..., :3]
    got = ws.insert(scene, photograph, progress=False)
    noise = NOISE if method == "ray-traced" else 0
    assert relative_error(got, whole) < MEAN_OF_PIXEL + noise
    assert relative_error(photograph, whole) > 10 * MEAN_OF_PIXEL  # which has neither the ball nor its shadow


@pytest.mark.slow
@pytest.mark.parametrize(("method", "noise"), [("directional", 0), ("log-sh", 0), ("ray-traced", NOISE)])
def test_light_that_bounces_tints_the_photograph(method, noise):
    scene = scene_of(method, bounces=1, bodies=[ball(albedo=(0.9, 0.05, 0.05)), ground(texture=None, blockers=0)])
    photograph = drawn(dataclasses.replace(scene, bodies=scene.bodies[1:]))[..., :3]
    whole = drawn(scene)[..., :3]
    got = ws.insert(scene, photograph, progress=False)
    assert relative_error(got, whole) < MEAN_OF_PIXEL + noise
    direct = ws.insert(dataclasses.replace(scene, bounces=0), photograph, progress=False)
    bodies = ws.Renderer(scene, progress=False).layers().bodies
    gain = (got - direct)[bodies == 1].sum(axis=0)
    assert gain[0] > 5 * gain[2] > 0  # a red ball


@pytest.mark.parametrize("method", ["directional", "log-sh", "ray-traced"])
def test_a_ground_that_blocks_light_changes_nothing_of_itself(method):
    """What blocks the catcher's light is the same with the other bodies and without them: a far one has no shadow."""
    far = ball(translation=(0, 500, 0), scale=0.1)
    photograph = np.random.default_rng(1).uniform(size=(36, 48, 3)).astype(np.float32)
    with pytest.warns(UserWarning, match="floats"):
        got = ws.insert(scene_of(method, bodies=[far, ground()]), photograph, progress=False)
    assert np.abs(got - photograph).max() < 1e-4


def test_what_shows_no_body_and_no_shadow_stays_as_it_is(tmp_path):
    """To the code of 8 bits, from file to file."""
    photograph = np.random.default_rng(1).uniform(size=(36, 48, 3))
    ws.write_image(tmp_path / "photo.png", photograph)
    scene = scene_of(bodies=[ball(translation=(-1.4, 1, 0)), ground()])
    ws.write_image(tmp_path / "out.png", ws.insert(scene, tmp_path / "photo.png", progress=False))
    before, after = (ws.Picture(ws.read_image(tmp_path / name), exposure=0).pixels for name in ("photo.png", "out.png"))
    assert (after == before).all(axis=2).mean() > 0.2
    sky = ws.Renderer(scene, progress=False).layers().masks.sum(axis=0) == 0
    assert sky.any() and (after[sky] == before[sky]).all()


def test_the_dark_and_the_light_of_any_scale_are_harmless():
    photograph = np.random.default_rng(1).uniform(size=(36, 48, 3)).astype(np.float32)
    scene = scene_of()
    expected = ws.insert(scene, photograph, progress=False)
    shows_ground = ws.Renderer(scene, progress=False).layers().masks[0] == 0
    for scale in (1e-12, 1e6):
        got = ws.insert(dataclasses.replace(scene, light=SKY.scaled(scale)), photograph, progress=False)
        assert np.abs(got - expected)[shows_ground].max() < 1e-4
    dark = ws.insert(dataclasses.replace(scene, light=SKY.scaled(0)), photograph, progress=False)
    assert np.abs(dark - photograph)[shows_ground].max() < 1e-6


def test_exposure_is_of_the_bodies_not_of_the_photograph():
    photograph = np.random.default_rng(1).uniform(size=(36, 48, 3)).astype(np.float32)
    scene = scene_of()
    masks = ws.Renderer(scene, progress=False).layers().masks
    plain, brighter = (ws.insert(scene, photograph, exposure=stops, progress=False) for stops in (0, 1))
    np.testing.assert_allclose(brighter[masks[0] == 1], 2 * plain[masks[0] == 1], rtol=1e-5)
    np.testing.assert_allclose(brighter[masks[0] == 0], plain[masks[0] == 0], rtol=1e-4, atol=1e-6)


def test_edges_of_bodies_are_as_soft_as_in_the_image():
    scene = scene_of(bodies=[ball(albedo=(0, 0, 0)), ground(blockers=0)])
    masks = ws.Renderer(scene, progress=False).layers().masks
    got = ws.insert(scene_of("none", bodies=scene.bodies), np.ones((36, 48, 3), np.float32), progress=False)
    assert np.abs(got - (1 - masks[:1]).transpose(1, 2, 0)).max() < 1e-5
    assert ((masks[0] > 0.1) & (masks[0] < 0.9)).sum() > 10


def test_several_catchers_catch_and_shadow_each_other_as_in_the_photograph():
    """A wall beside the ground: its shadow on the ground is in the photograph already."""
    wall = ws.Body(ws.plane(3.0, 8), rotation=(90, 0, 0), translation=(0, 1.2, -1.2), shadow_catcher=True, name="wall")
    scene = scene_of(bodies=[wall, ball(), ground()])
    photograph = drawn(dataclasses.replace(scene, bodies=[scene.bodies[0], scene.bodies[2]]))[..., :3]
    got = ws.insert(scene, photograph, progress=False)
    assert relative_error(got, drawn(scene)[..., :3]) < 2 * MEAN_OF_PIXEL


# ------------------------------------------------------------------------------------------------ images of scenes


def test_shadows_are_caught_pixel_by_pixel():
    """By a ground that would have its receivers at its vertices in a renderer."""
    photograph = np.full((36, 48, 3), 0.5, np.float32)
    images = [
        ws.insert(scene_of(bodies=[ball(), ground(receivers=receivers)]), photograph)
        for receivers in ("auto", "pixel", "vertex")
    ]
    np.testing.assert_array_equal(images[0], images[1])
    assert np.abs(images[0] - images[2]).max() > 1e-3


def test_in_an_image_catchers_are_shadows_in_the_coverage():
    gray = ws.EnvironmentMap(SKY.radiance.mean(axis=2, keepdims=True).repeat(3, axis=2))
    scene = dataclasses.replace(scene_of(), light=gray)
    image = ws.render(scene, progress=False)
    over_white = image[..., :3] + (1 - image[..., 3:])
    expected = ws.insert(scene, np.ones((36, 48, 3), np.float32), progress=False)
    assert np.abs(over_white - expected).max() < 1e-4
    masks = ws.Renderer(scene, progress=False).layers().masks
    assert (image[masks.sum(axis=0) == 0] == 0).all()
    shadow = masks[0] == 0
    assert np.abs(image[shadow][:, :3]).max() < 1e-6 and image[shadow][:, 3].max() > 0.5
    cameras = [CAMERA, CAMERA.turned(90)]
    both = ws.Renderer(scene, cameras=cameras, progress=False).render()
    assert np.abs(both[0] - image).max() < 1e-5
    assert np.abs(ws.Renderer(scene, progress=False).with_cameras(cameras[1:]).render()[0] - both[1]).max() < 1e-5


def test_a_catcher_is_one_in_a_file_that_reads_back(tmp_path):
    ws.write_scene(scene_of(), tmp_path)
    read = ws.load_scene(tmp_path / "scene.toml")
    assert read.catchers == (1,) and [body.shadow_catcher for body in read.bodies] == [False, True]
    with pytest.raises(ValueError, match="shadow_catcher: got 1, expected true or false"):
        ground(shadow_catcher=1)


# ------------------------------------------------------------------------------------------------ gradients


class Inserted:
    """The image as a function of numbers, of one kind."""

    def __init__(self, kind, method="directional", bounces=0):
        bodies = [ball(), ground(texture=None, receivers="pixel" if kind != "vertices" else "vertex")]
        self.renderer = TorchRenderer(scene_of(method, bounces, bodies, directions=64), progress=False)
        self.photograph = (
            0.5 + 0.4 * torch.linspace(0, 6, 36)[:, None, None].sin() * torch.linspace(0, 5, 48)[:, None].cos()
        )
        self.photograph = self.photograph * torch.tensor([1.0, 0.8, 0.6])
        self.poses = self.renderer.scene_poses()
        self.kind = kind
        size = {"pose": 7, "camera": 3, "light": self.renderer.basis.size, "albedo": 6, "photograph": 9}[kind]
        self.start = torch.ones(size) if kind == "light" else torch.zeros(size)

    def __call__(self, values):
        insert = self.renderer.insert
        rotations, translations, scales = self.poses
        if self.kind == "pose":
            rest = torch.zeros(1, 3)
            turns = rotation_matrices(torch.cat([values[None, :3], rest])) @ rotations
            shifts = translations + torch.cat([values[None, 3:6], rest])
            scales = scales * (1 + torch.cat([values[6:], torch.zeros(1)]))
            return insert(self.photograph, geometry=self.renderer.placed(turns, shifts, scales))
        if self.kind == "camera":
            R, t, K = self.renderer.scene_cameras()
            return insert(self.photograph, clip_matrices=self.renderer.clip_matrices(R, t + values, K))
        if self.kind == "light":
            return insert(self.photograph, values[:, None] * torch.tensor([1.0, 0.8, 0.5]))
        if self.kind == "albedo":
            return insert(self.photograph, albedo={"ball": 0.5 + values[:3], "ground": 0.5 + values[3:]})
        waves = torch.einsum("k,khw->hw", values, torch.linspace(-1, 1, 9 * 36 * 48).reshape(9, 36, 48).sin())
        return insert(self.photograph + waves[..., None])


def gradient_and_differences(image_of, directions, step):
    rng = np.random.default_rng(2)
    row, column = np.mgrid[0:1:36j, 0:1:48j]
    waves = [np.sin(6 * (a * row + b * column) + c) for a, b, c in rng.normal(size=(3, 3)) * [1, 1, 3]]
    weights = torch.from_numpy(np.stack(waves, axis=-1))

    def loss(values):
        return (image_of(values).double() * weights).sum()

    start = image_of.start.clone().requires_grad_()
    loss(start).backward()
    differences = []
    with torch.no_grad():
        for direction in torch.from_numpy(directions.astype(np.float32)):
            ends = [loss(image_of.start + sign * step * direction) for sign in (1, -1)]
            differences.append(float(ends[0] - ends[1]) / (2 * step))
    return directions @ start.grad.numpy(), np.array(differences)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "method", "bounces", "tolerance"),
    [
        ("light", "directional", 0, 1e-3),
        ("light", "log-sh", 0, 2e-3),
        ("light", "ray-traced", 0, 1e-3),
        ("light", "directional", 1, 2e-3),
        ("albedo", "directional", 1, 2e-3),
        ("photograph", "directional", 0, 1e-3),
        ("pose", "directional", 0, SILHOUETTE),
        ("pose", "log-sh", 0, SILHOUETTE),
        ("pose", "directional", 1, SILHOUETTE),
        ("camera", "directional", 0, SILHOUETTE),
    ],
)
def test_gradients_are_those_of_the_image(kind, method, bounces, tolerance):
    image_of = Inserted(kind, method, bounces)
    size = len(image_of.start)
    directions = np.eye(size) if size < 10 else np.random.default_rng(3).normal(size=(4, size)) / size**0.5
    step = 4e-3 if kind in ("pose", "camera") else 1e-2
    got, expected = gradient_and_differences(image_of, directions, step)
    assert relative_error(got, expected) < tolerance


def test_a_body_that_moves_alone_leaves_the_same_shadow():
    renderer = TorchRenderer(scene_of(), progress=False)
    rotations, translations, scales = renderer.scene_poses()
    photograph = torch.rand(36, 48, 3)
    shifted = translations + torch.tensor([[0.3, 0, 0], [0, 0, 0]])
    both = (renderer.placed(rotations, shifted, scales, moving=moving) for moving in (None, ["ball"]))
    images = [renderer.insert(photograph, geometry=geometry) for geometry in both]
    assert torch.allclose(*images, atol=1e-5)
    moved = scene_of(bodies=[ball(translation=(0.3, 0.55, 0)), ground()])
    assert np.abs(images[0].numpy() - ws.insert(moved, photograph.numpy(), progress=False)).max() < 1e-4


def test_a_batch_is_its_instances_one_by_one():
    renderer = TorchRenderer(scene_of(), progress=False)
    generator = torch.Generator().manual_seed(0)
    photographs = torch.rand(2, 36, 48, 3, generator=generator)
    lights = torch.rand(2, renderer.basis.size, 3, generator=generator) * torch.tensor([1.0, 50.0])[:, None, None]
    images = renderer.insert(photographs, lights)
    assert images.shape == (2, 36, 48, 3)
    for number in range(2):
        assert torch.allclose(renderer.insert(photographs[number], lights[number]), images[number], atol=1e-6)


# ------------------------------------------------------------------------------------------------ what is refused


def test_a_scene_without_a_catcher_is_refused():
    with pytest.raises(ValueError, match=r"scene: got no body that is a shadow catcher, .*shadow_catcher=True"):
        ws.insert(scene_of(bodies=[ball(), ground(shadow_catcher=False)]), np.zeros((36, 48, 3), np.float32))


@pytest.mark.parametrize("size", [(36, 48), (72, 96), (70, 93), (9, 12)])
def test_a_photograph_of_the_same_proportions_may_have_any_size(size):
    """70 × 93 is as near to 3 : 4 as whole pixels are."""
    image = ws.insert(scene_of("none"), np.full((*size, 3), 0.5, np.float32), progress=False)
    assert image.shape == (*size, 3)


@pytest.mark.parametrize(
    ("photograph", "message"),
    [
        (np.zeros((48, 36, 3), np.float32), r"photograph: got 36 × 48 pixels, expected the proportions of .*48 × 36"),
        (np.zeros((36, 52, 3), np.float32), "photograph: got 52 × 36 pixels"),
        (np.zeros((36, 48), np.float32), r"photograph: got shape \(36, 48\), expected \[height, width, 3\]"),
        (np.full((36, 48, 3), np.nan, np.float32), "photograph: got .*NaN"),
        (np.zeros((36, 48, 3), np.uint8), "photograph: got values of uint8, expected linear ones"),
        ("no.png", "photograph: no such file"),
    ],
)
def test_what_is_no_photograph_of_the_camera_is_refused(photograph, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        ws.insert(scene_of("none"), photograph, progress=False)


@pytest.mark.parametrize("feature", ["gloss", "near light"])
def test_a_photograph_of_the_catchers_becomes_that_of_all_with_gloss_and_near_light(feature):
    """The photograph is the image of the ground alone; its light is near, or the ball on it a metal."""
    shiny = {"roughness": 0.3, "metallic": 1.0} if feature == "gloss" else {}
    radius = 7.0 if feature == "near light" else None
    light = ws.EnvironmentMap(SKY.radiance, radius=radius)
    scene = dataclasses.replace(scene_of(bounces=1, bodies=[ball(**shiny), ground()]), light=light)
    alone = drawn(dataclasses.replace(scene, bodies=scene.bodies[1:]))[..., :3]
    expected = drawn(scene)
    inside = expected[..., 3] == 1
    other = dataclasses.replace(scene, bodies=[ball(), ground()], light=SKY)  # without the feature
    images = [ws.insert(item, alone, progress=False) for item in (scene, other)]
    error, error_without = (relative_error(image[inside], expected[inside][:, :3]) for image in images)
    assert error < 0.02 and error_without > 0.04
