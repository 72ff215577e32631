"""Batches whose images are of different scenes: images and gradients of each scene's renderer, and what is refused."""

import copy
import dataclasses
import pickle

import numpy as np
import pytest
import torch
from tensors import random, small_scene
from torch.nn.utils.rnn import pad_sequence

import warpshadow as ws
from warpshadow.pipeline.image_inputs import ImageInputs
from warpshadow.torch import MixedRenderer, TorchRenderer

SIZE = 8
WHICH = [1, 0, 2, 1, 0]


def scenes() -> list[ws.Scene]:
    """A ball on a ground; two of fewer vertices; and a ground that is alone."""
    one = small_scene(size=SIZE, supersampling=1)
    ball, ground = one.bodies
    ground = dataclasses.replace(ground, name="ground")
    small = dataclasses.replace(ball, mesh=ws.icosphere(1.0, 1), scale=0.4, name="small")
    two = (
        dataclasses.replace(small, translation=(-0.5, 0.4, 0)),
        dataclasses.replace(small, translation=(0.5, 0.4, 0), name="other"),
        ground,
    )
    return [dataclasses.replace(one, bodies=bodies) for bodies in ((ball, ground), two, (ground,))]


@pytest.fixture(scope="module")
def mixed() -> MixedRenderer:
    """On the CPU, shared, which no test may change."""
    return MixedRenderer(TorchRenderer(scene) for scene in scenes())


def assert_images(images: torch.Tensor, expected: list[torch.Tensor]) -> None:
    np.testing.assert_array_equal(images.detach().numpy(), torch.stack(expected).detach().numpy())


def test_each_image_is_that_of_its_scenes_renderer(device):
    own = [TorchRenderer(scene, device=device) for scene in scenes()]
    mixed = MixedRenderer(own)
    lights = random(5, 32, 3, device=device)
    for which in (WHICH, torch.tensor(WHICH), torch.tensor(WHICH, dtype=torch.int32)):
        images = mixed(which, lights)
        assert images.device == mixed.device and images.shape == (5, SIZE, SIZE, 4)
        for scene, light, image in zip(WHICH, lights, images, strict=True):
            assert torch.equal(image, own[scene](light))


def test_what_has_no_batch_serves_all_images(mixed):
    own = [renderer() for renderer in mixed.renderers]
    assert_images(mixed(WHICH), [own[scene] for scene in WHICH])
    light = random(32, 3).detach()
    for given in (light, light[None], ws.EnvironmentMap.constant(height=8)):
        single = given[0] if isinstance(given, torch.Tensor) and given.ndim == 3 else given
        assert_images(mixed(WHICH, given), [mixed.renderers[scene](single) for scene in WHICH])


def test_poses_are_padded_to_the_scene_with_the_most_bodies(mixed):
    rotations, translations, scales = (poses[WHICH] for poses in mixed.scene_poses())
    assert rotations.shape == (5, 3, 3, 3) and translations.shape == (5, 3, 3) and scales.shape == (5, 3)
    shifts = 0.1 * random(5, 3, 3, seed=1)
    geometry = mixed.placed(WHICH, rotations, translations + shifts, scales)
    assert [None if each is None else len(each.positions) for each in geometry] == [2, 2, 1]
    images = mixed(WHICH, geometry=geometry)
    for row, scene in enumerate(WHICH):
        renderer = mixed.renderers[scene]
        count = len(renderer.scene.bodies)
        poses = rotations[row, :count], (translations + shifts)[row, :count], scales[row, :count]
        assert torch.equal(images[row], renderer(geometry=renderer.placed(*poses)))
    (gradient,) = torch.autograd.grad(images.square().sum(), shifts)
    assert gradient[1].abs().sum() > 0 and gradient[0].abs().sum() > 0
    assert not gradient[2, 1:].any() and not gradient[4, 2:].any()  # of bodies that there are not


def test_a_body_that_has_a_name_gets_its_own_wherever_it_stands(mixed):
    maps = random(5, 2, 2, 3, seed=2)
    images = mixed(WHICH, textures={"ground": maps})
    assert_images(
        images, [mixed.renderers[k](textures={"ground": image}) for k, image in zip(WHICH, maps, strict=True)]
    )
    assert torch.equal(images[2], mixed([2], textures=[maps[2], None, None])[0])  # of which it is body 0


def test_colors_of_vertices_are_padded_and_scenes_pass_over_bodies_that_they_have_not(mixed):
    counts = [42, 162, 1, 42, 162]  # of body 0, "small" or the ball; the third scene has a ground
    mixed = MixedRenderer(list(mixed.renderers)[:2])
    which = [WHICH[row] for row in (0, 1, 3, 4)]
    rows = [random(counts[row], 3, seed=row) for row in (0, 1, 3, 4)]
    expected = [mixed.renderers[k](albedo={0: colors}) for k, colors in zip(which, rows, strict=True)]
    padded = pad_sequence(rows, batch_first=True)
    images = mixed(which, albedo={0: padded})
    assert_images(images, expected)
    assert_images(mixed(which, albedo=[padded, None, None]), expected)
    gradients = torch.autograd.grad(images.square().sum(), rows)
    for gradient, image, colors in zip(gradients, expected, rows, strict=True):
        assert torch.equal(gradient, torch.autograd.grad(image.square().sum(), colors)[0])
    few = mixed(which, albedo={"small": padded[:, :42], "other": padded[:, :1]})
    alone = mixed.renderers[1](albedo={"small": padded[0, :42], "other": padded[0, :1]})
    assert torch.equal(few[0], alone) and torch.equal(few[1], mixed.renderers[0]())


def test_cameras_and_bodies_that_move_are_those_of_each_image(mixed):
    R, t, K = (cameras[WHICH] for cameras in mixed.scene_cameras())
    cameras = mixed.clip_matrices(R, t + 0.1 * random(5, 3, seed=3).detach(), K)
    rotations, translations, _ = mixed.scene_poses()
    geometry = mixed.placed(WHICH, rotations[0], translations[1], moving=["small", "ground"])
    assert [each and each.moving for each in geometry] == [(1,), (0, 2), (0,)]
    images = mixed(WHICH, clip_matrices=cameras, geometry=geometry)
    for row, scene in enumerate(WHICH):
        renderer, own = mixed.renderers[scene], slice(len(mixed.renderers[scene].scene.bodies))
        moved = renderer.placed(rotations[0, own], translations[1, own], moving=geometry[scene].moving)
        assert torch.equal(images[row], renderer(clip_matrices=cameras[row], geometry=moved))


def test_gradients_are_central_differences_of_the_loss_of_the_batch(mixed):
    """It is linear in light and in colors alone, so any step will do."""
    values = {"light": random(5, 32, 3, seed=1), "color": random(5, 1, 3, seed=2)}
    weights = torch.randn(5, SIZE, SIZE, 4, generator=torch.Generator().manual_seed(5), dtype=torch.float64)

    def loss(**changed: torch.Tensor) -> torch.Tensor:
        given = values | changed
        return (mixed(WHICH, given["light"], albedo={"small": given["color"]}).double() * weights).sum()

    gradients = torch.autograd.grad(loss(), list(values.values()))
    with torch.no_grad():
        for (name, value), gradient in zip(values.items(), gradients, strict=True):
            for index in gradient.flatten().abs().argsort(descending=True)[:: gradient.numel() // 6].tolist():
                step = torch.zeros(gradient.numel())
                step[index] = 0.5
                step = step.reshape(gradient.shape)
                difference = loss(**{name: value + step}) - loss(**{name: value - step})
                assert abs(gradient.flatten()[index] - difference) < 1e-4 * gradient.abs().max()


def test_it_is_copied_pickled_and_saved_as_its_renderers_are(mixed):
    light = random(32, 3).detach()
    for other in (copy.deepcopy(mixed), pickle.loads(pickle.dumps(mixed))):
        assert torch.equal(other([1, 2], light), mixed([1, 2], light))
    assert mixed.to("cpu") is mixed and not list(mixed.parameters())
    assert mixed.basis.size == 32
    mixed.load_state_dict(mixed.state_dict())
    with pytest.raises(ValueError, match="^state_dict: got that of a TorchRenderer"):
        MixedRenderer(list(mixed.renderers)[::-1]).load_state_dict(mixed.state_dict())


@pytest.mark.parametrize(
    ("which", "message"),
    [
        ([], r"^which: got \[\], expected the scene of each image"),
        (1, "^which: got 1, expected the scene of each image"),
        ([0, 3], r"^which\[1\]: got 3, expected the number of a scene, from 0 to 2"),
        (torch.tensor([0.0]), r"^which\[0\]: got 0.0, expected the number of a scene"),
        ([True], r"^which\[0\]: got True"),
        (torch.tensor([[0]]), r"^which\[0\]: got "),
    ],
)
def test_scenes_are_numbers(mixed, which, message):
    with pytest.raises(ValueError, match=message):
        mixed(which)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"light": torch.ones(3, 32, 3)}, "^light: got a batch of 3, expected 1 or 5, as which has"),
        ({"light": torch.ones(5, 9, 3)}, r"^light: got shape \(2, 9, 3\)"),
        ({"light": np.ones((32, 3))}, "^light: got ndarray"),
        ({"albedo": {"cat": torch.ones(3)}}, "^albedo: got 'cat', expected one of .*'ground'"),
        ({"albedo": {3: torch.ones(3)}}, "^albedo: got 3, expected one of"),
        ({"albedo": [torch.ones(3), None]}, "^albedo: got 2 items, expected 3, one for each body of the scene with"),
        ({"albedo": torch.ones(3)}, "^albedo: got Tensor"),
        ({"albedo": {0: torch.ones(5, 42, 3)}}, r"^albedo\[0\]: got shape \(5, 42, 3\), expected \[batch, 169, 3\]"),
        ({"albedo": {"ground": 1.0}}, r"^albedo\['ground'\]: got float"),
        ({"textures": {"ground": torch.ones(4, 2, 2, 3)}}, r"^textures\['ground'\]: got a batch of 4"),
        ({"geometry": []}, "^geometry: got 0 items, expected a list of 3"),
        ({"geometry": 1}, "^geometry: got 1, expected a list of 3"),
        ({"geometry": [None] * 3}, r"^geometry\[0\]: got 0 instances, expected 2"),
        ({"clip_matrices": torch.ones(2, 4, 4)}, "^clip_matrices: got a batch of 2, expected 1 or 5"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(mixed, given, message):
    with pytest.raises(ValueError, match=message):
        mixed(WHICH, **given)


def test_poses_and_geometries_of_other_batches_are_refused(mixed):
    rotations, translations, scales = mixed.scene_poses()
    with pytest.raises(
        ValueError, match=r"^rotations: got shape \(2, 3, 3\), expected \[3, 3, 3\]: for as many bodies"
    ):
        mixed.placed(WHICH, rotations[0, :2], translations[0])
    with pytest.raises(ValueError, match="^translations: got a batch of 3, expected 1 or 5"):
        mixed.placed(WHICH, rotations[0], translations)
    with pytest.raises(ValueError, match="^moving: got 'cat'"):
        mixed.placed(WHICH, rotations[0], translations[0], moving=["cat"])
    with pytest.raises(ValueError, match="^moving: got 'ground', expected a list"):
        mixed.placed(WHICH, rotations[0], translations[0], moving="ground")
    with pytest.raises(ValueError, match=r"^geometry\[1\]: got 3 instances, expected 2, as many images as which has"):
        which = [0, 1, 1, 1, 2]
        mixed(WHICH, geometry=list(mixed.placed(which, rotations[which], translations[which])))
    swapped = WHICH[::-1]  # as many images of each scene
    with pytest.raises(
        ValueError, match=r"^geometry: got that of placed with which = \[.*expected that of the same which"
    ):
        mixed(WHICH, geometry=mixed.placed(swapped, rotations[swapped], translations[swapped]))
    mixed(WHICH, geometry=mixed.placed(swapped, rotations[0], translations[0]))


def test_renderers_whose_images_are_no_batch_are_refused(mixed):
    one = mixed.renderers[0]
    with pytest.raises(ValueError, match="^renderers: got none"):
        MixedRenderer([])
    with pytest.raises(ValueError, match=r"^renderers\[0\]: got .*, expected a TorchRenderer"):
        MixedRenderer([one.scene])
    for other in (
        TorchRenderer(small_scene(size=9)),
        TorchRenderer(small_scene(size=SIZE), basis=ws.HarmonicBasis(3)),
        TorchRenderer(small_scene(size=SIZE, directions=64)),
    ):
        with pytest.raises(ValueError, match=r"^renderers\[1\]: got .* pixels, .*expected 8 × 8"):
            MixedRenderer([one, other])
    cameras = [one.scene.camera] * 2
    with pytest.raises(ValueError, match=r"^renderers\[0\]: got one with cameras of its own"):
        MixedRenderer([TorchRenderer(one.scene, cameras=cameras)])


def test_bodies_shine_and_emit_as_each_image_says():
    """Numbers, one for each vertex, and images, in batches; a scene passes over a body that it has not."""
    one, two, _ = scenes()
    image = torch.rand(4, 3, generator=torch.Generator().manual_seed(0))
    shiny = [
        dataclasses.replace(
            scene,
            bodies=[
                dataclasses.replace(scene.bodies[0], roughness=0.5, name="ball"),
                *(dataclasses.replace(body, emission=(0.2, 0.3, 0.1)) for body in scene.bodies[1:-1]),
                dataclasses.replace(scene.bodies[-1], roughness=0.5),
            ],
        )
        for scene in (one, two)
    ]
    mixed, which = MixedRenderer(TorchRenderer(scene) for scene in shiny), [1, 0, 1]
    count = max(scene.bodies[0].mesh.vertex_count for scene in shiny)
    rough = (0.3 + 0.1 * torch.rand(3, count, generator=torch.Generator().manual_seed(1))).requires_grad_()
    metallic, glow = torch.tensor([[0.1], [0.9], [0.5]]), torch.rand(3, 1, 3)
    given = {"metallic": {"ball": metallic}, "emission": {"other": glow}, "roughness": {"ball": rough, "ground": image}}
    images = mixed(which, **given)
    for row, scene in enumerate(which):
        vertices = shiny[scene].bodies[0].mesh.vertex_count
        own = {"ball": rough[row, :vertices], "ground": image}
        emission = {"other": glow[row]} if scene == 1 else None
        single = mixed.renderers[scene](roughness=own, metallic={"ball": metallic[row]}, emission=emission)
        assert torch.equal(images[row], single)
    images.square().sum().backward()
    assert rough.grad[1].any() and not rough.grad[0, shiny[1].bodies[0].mesh.vertex_count :].any()
    with pytest.raises(ValueError, match=r"roughness\['ball'\]: got shape"):
        mixed(which, roughness={"ball": torch.rand(5)})


def test_each_image_may_have_a_shell_of_its_own():
    light = ws.EnvironmentMap(np.random.default_rng(0).random((4, 8, 3), np.float32), radius=5.0)
    near = [dataclasses.replace(scene, light=light, visibility=ws.Visibility("none")) for scene in scenes()[:2]]
    mixed, which = MixedRenderer(TorchRenderer(scene) for scene in near), [1, 0, 1]
    shells = torch.tensor([[0.0, 0, 0, 5], [0, 1, 0, 4], [0.5, 0, 0, 6]], requires_grad=True)
    images = mixed(which, shell=shells)
    expected = [mixed.renderers[scene](shell=shell) for scene, shell in zip(which, shells, strict=True)]
    assert_images(images, expected)
    images.square().sum().backward()
    assert shells.grad.any(dim=1).all()


@pytest.fixture(scope="module")
def of_all_inputs() -> tuple[TorchRenderer, MixedRenderer]:
    """A renderer of a scene that takes every input of an image, and one of that scene alone."""
    ball, ground = small_scene(size=SIZE).bodies
    ball = dataclasses.replace(ball, roughness=0.4)
    lamp = ws.Body(ws.plane(0.5), translation=(0, 3, 0), rotation=(180, 0, 0), emission=(2, 2, 2), name="lamp")
    light = ws.EnvironmentMap(np.random.default_rng(0).random((4, 8, 3), np.float32), radius=5.0)
    scene = dataclasses.replace(small_scene("none", size=SIZE), bodies=(ball, ground, lamp), light=light)
    renderer = TorchRenderer(scene)
    return renderer, MixedRenderer([renderer])


OTHER_INPUTS = {
    "light": lambda renderer: random(renderer.basis.size, 3).detach(),
    "albedo": lambda _: {0: torch.tensor([0.1, 0.2, 0.9])},
    "textures": lambda _: {1: torch.full((2, 2, 3), 0.1)},
    "emission": lambda _: {"lamp": torch.tensor([9.0, 1.0, 1.0])},
    "roughness": lambda _: {0: torch.tensor(0.9)},
    "metallic": lambda _: {0: torch.tensor(1.0)},
    "specular": lambda _: {0: torch.tensor(0.0)},
    "shell": lambda _: torch.tensor([0.0, 0.0, 1.0, 7.0]),
    "geometry": lambda renderer: renderer.placed(renderer.scene_poses()[0], renderer.scene_poses()[1] + 0.2),
    "clip_matrices": lambda renderer: renderer.clip_matrices(
        *(item + (0.3 if item.ndim == 1 else 0) for item in renderer.scene_cameras())
    ),
}
"""Values other than those of the scene, by the names of the fields of ImageInputs."""


@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(ImageInputs)])
def test_every_input_of_an_image_arrives(of_all_inputs, name):
    renderer, mixed = of_all_inputs
    value = OTHER_INPUTS[name](renderer)
    image = renderer(**{name: value})
    assert not torch.equal(image, renderer())
    assert torch.equal(mixed([0], **{name: [value] if name == "geometry" else value})[0], image)
