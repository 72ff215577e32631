"""Rendering with tensors: the same image, exact gradients, nothing shared by accident, nothing kept too long."""

import dataclasses
import gc
import os
import resource
import subprocess
import sys
import weakref
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp
from tensors import random, small_scene

import warpshadow as ws
from warpshadow.device import memory
from warpshadow.torch import TorchRenderer, clip_matrices_from_opengl, rotation_matrices

METHODS = ("directional", "log-sh", "none", "ray-traced")
# The same float32 products in another order.
FLOAT32 = 2e-6
# The image is linear in each input alone, so a central difference has no truncation error, only rounding: that of a
# loss over some hundred float32 pixels, for a step of 1.
DIFFERENCE = 1e-4

WHITE = (1.0, 1.0, 1.0)

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def renderer() -> TorchRenderer:
    """The CPU's, shared, which no test may change."""
    return TorchRenderer(small_scene())


def inputs_of(renderer: TorchRenderer) -> dict[str, torch.Tensor]:
    """Everything that can be free at once."""
    vertex_count = renderer.scene.bodies[0].mesh.vertex_count
    return {
        "light": random(renderer.basis.size, 3, seed=1),
        "color": random(3, seed=2),
        "vertices": random(vertex_count, 3, seed=3),
        "texture": random(5, 7, 3, seed=4),
    }


def image_of(renderer: TorchRenderer, name: str, values: dict[str, torch.Tensor]) -> torch.Tensor:
    """The image as a function of all inputs; ``color`` and ``vertices`` both stand for the ball's albedo."""
    ball = values["color"] if name == "color" else values["vertices"]
    return renderer(values["light"], albedo=[ball, None], textures=[None, values["texture"]])


# ---------------------------------------------------------------------------------------------- images


@pytest.mark.parametrize("supersampling", [1, 3])
@pytest.mark.parametrize("method", METHODS)
def test_the_image_is_the_renderers(device, method, supersampling):
    scene = small_scene(method, supersampling=supersampling)
    image = TorchRenderer(scene, device=device)()
    expected = ws.Renderer(scene, device=device).render()
    assert image.dtype == torch.float32 and image.device == torch.device(device)
    assert np.abs(image.cpu().numpy() - expected).max() < FLOAT32 * expected.max()


@pytest.mark.parametrize("method", ["directional", "log-sh", "none"])
def test_free_light_in_the_methods_own_basis_is_the_scenes_light(method):
    light = np.random.default_rng(1).normal(size=(16, 3)).astype(np.float32)
    scene = dataclasses.replace(small_scene(method), light=light)
    renderer = TorchRenderer(scene)
    coefficients = torch.from_numpy(renderer.basis.coefficients(light))
    expected = ws.Renderer(scene).render()
    assert np.abs(renderer(coefficients).numpy() - expected).max() < FLOAT32 * 5 * np.abs(expected).max()


def test_a_cell_of_free_light_is_as_bright_where_rays_found_what_static_bodies_block():
    """Few of the rays fall into each cell, and not as many into one as into another."""
    small = ws.icosphere(0.1, 1)
    far = [ws.Body(small, translation=(x, 0.1, 0), blockers=8, name=name) for x, name in ((-50, "one"), (50, "other"))]
    ground = ws.Body(ws.plane(100.0, 64), receivers="vertex")
    camera = ws.Camera.look_at((0, 5, 0.01), (0, 0, 0), fov_y=20, size=(4, 4))
    scene = ws.Scene([*far, ground], ws.EnvironmentMap.constant(1.0), camera, ws.Visibility(samples=1024), 1)
    renderer = TorchRenderer(scene)
    above = np.flatnonzero(renderer.basis.directions[:, 1] > 0.3)
    light = torch.zeros(len(above), renderer.basis.size, 3)
    light[range(len(above)), above] = 1
    placed = renderer.placed(*renderer.scene_poses(), moving=["one"])
    static, moving = (renderer(light, geometry=given)[..., 0].mean((1, 2)) for given in (None, placed))
    assert ((moving / static - 1).square().mean().sqrt()) < 0.03  # 0.13 with equal weights of the rays


def test_albedo_as_tensors_gives_the_same_image_as_in_the_scene(renderer):
    scene = renderer.scene
    ball, ground = scene.bodies
    color, texture = torch.from_numpy(ball.albedo), torch.from_numpy(ground.texture)
    expected = renderer()
    assert (renderer(albedo=[color, None], textures=[None, texture]) - expected).abs().max() < FLOAT32
    assert (renderer(albedo=[None, None]) - expected).abs().max() == 0
    of_vertices = torch.from_numpy(np.tile(ball.albedo, (ball.mesh.vertex_count, 1)))
    assert (renderer(albedo=[of_vertices, None]) - expected).abs().max() < FLOAT32 * 3
    flat = renderer(albedo=[None, torch.tensor([0.2, 0.4, 0.6])])
    scene = dataclasses.replace(scene, bodies=(ball, dataclasses.replace(ground, texture=None, albedo=(0.2, 0.4, 0.6))))
    assert np.abs(flat.numpy() - ws.Renderer(scene).render()).max() < FLOAT32 * 3


def test_vertex_albedo_of_the_second_body_stays_with_it():
    scene = small_scene()
    ball, ground = scene.bodies
    colors = np.random.default_rng(2).uniform(size=(ball.mesh.vertex_count, 3)).astype(np.float32)
    scene = dataclasses.replace(scene, bodies=(ground, dataclasses.replace(ball, albedo=colors)))
    renderer = TorchRenderer(dataclasses.replace(scene, bodies=(ground, ball)))
    image = renderer(albedo=[None, torch.from_numpy(colors)])
    assert np.abs(image.numpy() - ws.Renderer(scene).render()).max() < FLOAT32 * 3


def test_writing_into_an_image_does_not_change_the_next_one():
    for supersampling in (1, 2):
        renderer = TorchRenderer(small_scene(supersampling=supersampling))
        for light in (None, torch.ones(32, 3)):
            first = renderer(light)
            kept = first.clone()
            first.fill_(float("nan"))
            assert torch.equal(renderer(light), kept)


def test_writing_into_a_geometry_does_not_change_the_next_image():
    expected, renderer = TorchRenderer(small_scene())(), TorchRenderer(small_scene())
    poses, centers = renderer.scene_poses(), torch.zeros(1, 3)
    for geometry in (renderer.placed(*poses, moving=[]), renderer.deformed(0, centers=centers)):
        for part in geometry.arrays().values():
            part.add_(0.5)
    assert not centers.any()
    assert torch.equal(renderer(), expected)
    assert torch.equal(renderer(geometry=renderer.placed(*poses)), expected)


def test_a_plain_tuple_is_a_geometry(renderer):
    placed = renderer.placed(*renderer.scene_poses())
    plain = tuple(placed.arrays().values())
    unturned = dataclasses.replace(placed, rotations=None)  # of which a plain tuple says nothing either
    assert torch.equal(renderer(geometry=plain), renderer(geometry=unturned))
    with pytest.raises(ValueError, match="^geometry: got tuple of 2, expected a Geometry"):
        renderer(geometry=plain[:2])
    with pytest.raises(ValueError, match=r"^geometry\.positions: got shape .*: placed\(…\) makes a geometry of poses$"):
        renderer(geometry=renderer.scene_poses())


# ---------------------------------------------------------------------------------------------- gradients


@pytest.mark.slow
@pytest.mark.parametrize("name", ["light", "color", "vertices", "texture"])
@pytest.mark.parametrize("method", METHODS)
def test_gradients_are_central_differences(method, name):
    renderer = TorchRenderer(small_scene(method))
    values = inputs_of(renderer)
    weights = torch.randn(12, 12, 4, generator=torch.Generator().manual_seed(5), dtype=torch.float64)

    def loss(changed: torch.Tensor) -> torch.Tensor:
        return (image_of(renderer, name, {**values, name: changed}).double() * weights).sum()

    (gradient,) = torch.autograd.grad(loss(values[name]), values[name])
    assert gradient.isfinite().all() and gradient.abs().max() > 0
    rng = np.random.default_rng(6)
    scale = gradient.abs().max().item()
    with torch.no_grad():
        for index in rng.choice(gradient.numel(), size=min(12, gradient.numel()), replace=False):
            step = torch.zeros_like(gradient).flatten()
            step[int(index)] = 0.5
            step = step.reshape(gradient.shape)
            difference = (loss(values[name] + step) - loss(values[name] - step)).item()
            assert abs(gradient.flatten()[int(index)].item() - difference) < DIFFERENCE * scale


@pytest.mark.parametrize("name", ["light", "color", "vertices", "texture"])
def test_forward_and_backward_are_adjoint(device, name):
    """⟨J v, w⟩ = ⟨v, Jᵀ w⟩ for random v and w, J the linear map from one input to the image."""
    renderer = TorchRenderer(small_scene(), device=device)
    values = {key: value.detach().to(device) for key, value in inputs_of(renderer).items()}
    values[name].requires_grad_()
    image = image_of(renderer, name, values)[..., :3]
    weights = torch.rand(image.shape, generator=torch.Generator().manual_seed(7)).to(image.device)
    if name in ("color", "vertices"):  # linear in the ball's albedo but for the ground, which is constant
        zero = image_of(renderer, name, {**values, name: torch.zeros_like(values[name])})[..., :3]
        image = image - zero
    elif name == "texture":
        image = image - image_of(renderer, name, {**values, name: torch.zeros_like(values[name])})[..., :3]
    left = (image * weights).sum()
    (gradient,) = torch.autograd.grad(left, values[name])
    right = (gradient * values[name].detach()).sum()
    assert abs(left.item() - right.item()) < DIFFERENCE * abs(left.item())


@pytest.mark.slow
def test_all_inputs_can_be_free_at_once(renderer):
    values = inputs_of(renderer)
    image_of(renderer, "vertices", values).square().sum().backward()
    together = {name: values[name].grad for name in ("light", "vertices", "texture")}
    for name, gradient in together.items():
        alone = {key: value.detach() for key, value in values.items()}
        alone[name].requires_grad_()
        image_of(renderer, "vertices", alone).square().sum().backward()
        torch.testing.assert_close(alone[name].grad, gradient)


def test_backward_twice_gives_the_same(renderer):
    values = inputs_of(renderer)
    loss = image_of(renderer, "vertices", values).square().sum()
    leaves = [values[name] for name in ("light", "vertices", "texture")]
    first = torch.autograd.grad(loss, leaves, retain_graph=True)
    kept = [gradient.clone() for gradient in first]
    second = torch.autograd.grad(loss, leaves)
    for before, after, untouched in zip(first, second, kept, strict=True):
        assert torch.equal(before, after) and torch.equal(before, untouched)


def test_an_image_that_is_kept_holds_no_memory_of_gradients(renderer, monkeypatch):
    blocks, take = [], memory.ZeroedMemory.take

    def noted(self, *arguments):
        array = take(self, *arguments)
        blocks.append(weakref.ref(self._block))
        return array

    monkeypatch.setattr(memory.ZeroedMemory, "take", noted)
    light = random(renderer.basis.size, 3)
    image = renderer(light)
    image.sum().backward()
    kept = image.detach()
    assert blocks and blocks[0]() is not None
    del image
    gc.collect()
    assert all(block() is None for block in blocks)
    torch.testing.assert_close(kept, renderer(light.detach()))


def test_gradients_of_two_images_in_any_order_do_not_mix(renderer):
    light = random(renderer.basis.size, 3)
    texture = random(8, 8, 3)
    weights = torch.rand(12, 12, 4, generator=torch.Generator().manual_seed(8))

    def loss(factor: float) -> torch.Tensor:
        return (renderer(factor * light, textures=[None, texture]) * weights).sum()

    (alone,) = torch.autograd.grad(loss(1.0), texture)
    first, second = loss(1.0), loss(3.0)
    (of_first,) = torch.autograd.grad(first, texture)
    (of_second,) = torch.autograd.grad(second, texture)
    torch.testing.assert_close(of_first, alone)
    torch.testing.assert_close(of_second, 3 * alone)


def test_a_gradient_of_what_is_linear_can_be_differentiated_again(renderer):
    """Against differences of gradients, which have no truncation error here: light and texture are linear each."""
    values = random(renderer.basis.size, 3), random(8, 8, 3, seed=1)
    steps = random(renderer.basis.size, 3, seed=2).detach(), random(8, 8, 3, seed=3).detach()

    def loss(light: torch.Tensor, texture: torch.Tensor) -> torch.Tensor:
        return renderer(light, textures=[None, texture]).double().square().sum()

    def gradients(factor: float, *, of: int) -> tuple[torch.Tensor, ...]:
        moved = [value + factor * step * (n == of) for n, (value, step) in enumerate(zip(values, steps, strict=True))]
        return torch.autograd.grad(loss(*moved), moved)

    found = torch.autograd.grad(loss(*values), values, create_graph=True)
    for changed, step in enumerate(steps):
        ends = zip(gradients(1.0, of=changed), gradients(-1.0, of=changed), strict=True)
        expected = [0.5 * (one - other) for one, other in ends]
        along = (found[changed] * step).sum()
        for got, wanted in zip(torch.autograd.grad(along, values, retain_graph=True), expected, strict=True):
            torch.testing.assert_close(got, wanted, rtol=DIFFERENCE, atol=DIFFERENCE * float(wanted.abs().max()))
    shown, along = torch.autograd.functional.jvp(renderer, values[0].detach(), steps[0])
    torch.testing.assert_close(shown[..., :3] + along[..., :3], renderer(values[0] + steps[0])[..., :3])


def test_second_derivatives_of_colors_are_found_in_directions_that_are_no_colors():
    """Directions have numbers below 0, and some far beyond 1, which no albedo has."""
    lamp = ws.Body(ws.icosphere(0.3, 1), translation=(0, 2, 0), emission=(4.0, 3.0, 2.0), name="lamp")
    ground = ws.Body(ws.plane(4.0, 4), (0.5, 0.5, 0.5), name="ground")
    camera = ws.Camera.look_at((0, 2, 4), (0, 0.5, 0), size=(12, 12))
    renderer = TorchRenderer(ws.Scene((lamp, ground), ws.synthetic_sky(), camera), progress=False)
    for name, body, start in (("emission", "lamp", [4.0, 3.0, 2.0]), ("albedo", "ground", [0.5, 0.5, 0.5])):
        value, direction = torch.tensor([start], requires_grad=True), torch.tensor([[0.1, -0.2, 0.05]])

        def gradient(color, name=name, body=body):
            return torch.autograd.grad(renderer(**{name: {body: color}}).square().sum(), color, create_graph=True)[0]

        (found,) = torch.autograd.grad((gradient(value) * 100 * direction).sum(), value)
        expected = 100 * (gradient(value + direction) - gradient(value))
        expected = expected.detach()
        torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-3 * float(expected.abs().max()))


def test_other_second_derivatives_are_refused_instead_of_being_0(renderer):
    with pytest.raises(NotImplementedError, match=r"^parameters: got asked for a second derivative"):
        torch.autograd.functional.hessian(lambda turns: rotation_matrices(turns).sum(), torch.ones(3))
    light, poses = random(renderer.basis.size, 3), renderer.scene_poses()
    geometry = renderer.placed(*poses)
    centers = geometry.centers.clone().requires_grad_()

    def loss() -> torch.Tensor:
        return renderer(light, geometry=(geometry.positions, centers, geometry.radii)).square().sum()

    (gradient,) = torch.autograd.grad(loss(), centers, create_graph=True)
    total = loss() + gradient.square().sum()  # a penalty that torch would leave out without a word
    with pytest.raises(
        NotImplementedError, match=r"^geometry.centers: got .* of second order there are those of light"
    ):
        torch.autograd.grad(total, centers)
    with pytest.raises(NotImplementedError, match="forward mode AD"), torch.autograd.forward_ad.dual_level():
        renderer(torch.autograd.forward_ad.make_dual(light.detach(), light.detach()))


def test_without_gradients_nothing_is_recorded(renderer):
    light = random(renderer.basis.size, 3)
    with torch.no_grad():
        image = renderer(light, albedo=[random(3), None], textures=[None, random(4, 4, 3)])
    assert not image.requires_grad
    assert renderer(light).requires_grad
    assert not renderer(light.detach()).requires_grad


def test_tensors_need_not_be_contiguous(renderer):
    count = renderer.basis.size
    light = random(3, count).detach().T.requires_grad_()
    texture = random(3, 6, 5).detach().permute(1, 2, 0).requires_grad_()
    vertices = random(3, 162).detach().T.requires_grad_()
    assert not (light.is_contiguous() or texture.is_contiguous() or vertices.is_contiguous())
    weights = torch.rand(12, 4, 12).permute(0, 2, 1)  # so the gradient is not either
    (renderer(light, albedo=[vertices, None], textures=[None, texture]) * weights).sum().backward()
    copies = [tensor.detach().contiguous().requires_grad_() for tensor in (light, vertices, texture)]
    (renderer(copies[0], albedo=[copies[1], None], textures=[None, copies[2]]) * weights).sum().backward()
    for tensor, copy in zip((light, vertices, texture), copies, strict=True):
        torch.testing.assert_close(tensor.grad, copy.grad)


def test_texels_that_no_pixel_sees_have_a_zero_gradient():
    camera = ws.Camera.look_at((0.7, 1.0, 0.7), (0.7, 0, 0.7), up=(0, 0, -1), size=(12, 12))  # one corner of the ground
    renderer = TorchRenderer(dataclasses.replace(small_scene(), camera=camera))
    texture = random(64, 64, 3)
    renderer(textures=[None, texture]).sum().backward()
    assert texture.grad.isfinite().all()
    seen = (texture.grad != 0).any(dim=-1)
    rows, columns = torch.nonzero(seen, as_tuple=True)
    assert seen.sum() > 100 and rows.min() > 30 and columns.min() > 30
    inside = seen[rows.min() + 1 : rows.max(), columns.min() + 1 : columns.max()]
    assert inside.all()  # no holes, though a sample sees a point of several texels


# ---------------------------------------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("light", "message"),
    [
        (torch.ones(32, 3, dtype=torch.float64), r"light: got torch.float64, .*: .float\(\) converts it"),
        (torch.ones(9, 3), r"got shape \(9, 3\), .* cells of 32 directions; for 9 .* basis=HarmonicBasis\(3\)$"),
        (torch.ones(48, 3), r"for 48 .* basis=CellBasis\(warpshadow.fibonacci\(48\)\)$"),
        ("park.exr", "light: got 'park.exr', expected an EnvironmentMap"),
        (torch.ones(32, 3, dtype=torch.int32), "light: got torch.int32"),
        (torch.ones(31, 3), r"light: got shape \(31, 3\), expected \[32, 3\]"),
        (torch.ones(32), r"light: got shape \(32,\)"),
        (torch.ones(1, 31, 3), r"light: got shape \(1, 31, 3\), expected \[batch, 32, 3\]"),
        (torch.full((32, 3), float("nan")), "light: got 96 NaN or Inf"),
        (torch.full((32, 3), float("-inf")), "light: got 96 NaN or Inf"),
        (torch.ones(32, 3, device="meta"), "light: got device meta, expected cpu"),
    ],
)
def test_light_that_does_not_fit_is_refused(renderer, light, message):
    with pytest.raises(ValueError, match=message):
        renderer(light)


@pytest.mark.parametrize(
    ("albedo", "message"),
    [
        ([None], "albedo: got 1 items, expected 2"),
        ([torch.ones(4), None], r"albedo\[0\]: got shape \(4,\), expected \[3\]"),
        ([torch.ones(161, 3), None], r"albedo\[0\]: got shape \(161, 3\), expected \[162, 3\]"),
        ([torch.ones(4, 4, 3), None], r"albedo\[0\]: got shape \(4, 4, 3\), expected \[batch, 162, 3\]"),
        ([torch.ones(0, 3), None], r"albedo\[0\]: got shape \(0, 3\)"),
        ([None, torch.tensor([0.5, float("nan"), 0.5])], r"albedo\[1\]: got 1 NaN"),
        ([None, [0.5, 0.5, 0.5]], r"albedo\[1\]: got list, expected a tensor .*torch.as_tensor"),
        (torch.ones(2, 3), "albedo: got Tensor of .*, expected a list of 2 items, one for each body"),
    ],
)
def test_albedo_that_does_not_fit_is_refused(renderer, albedo, message):
    with pytest.raises(ValueError, match=message):
        renderer(albedo=albedo)


@pytest.mark.parametrize(
    ("textures", "message"),
    [
        ([None], "textures: got 1 items, expected 2"),
        ([None, torch.ones(4, 4, 4)], r"textures\[1\]: got shape \(4, 4, 4\), expected \[height, width, 3\]"),
        ([None, torch.ones(3, 8, 8)], r"textures\[1\]: got shape \(3, 8, 8\), .*: channels come last"),
        ([None, torch.ones(0, 4, 3)], r"textures\[1\]: got shape \(0, 4, 3\)"),
        ([None, torch.ones(4, 4, 3).double()], r"textures\[1\]: got torch.float64"),
        ([torch.ones(4, 4, 3), None], r"textures\[0\]: got an image, but the mesh of 'icosphere' has no uvs; .*unwrap"),
    ],
)
def test_a_texture_that_does_not_fit_is_refused(renderer, textures, message):
    with pytest.raises(ValueError, match=message):
        renderer(textures=textures)


def test_a_body_has_an_albedo_or_a_texture(renderer):
    with pytest.raises(ValueError, match=r"albedo\[1\], textures\[1\]: got both"):
        renderer(albedo=[None, torch.ones(3)], textures=[None, torch.ones(4, 4, 3)])


def test_a_batch_of_poses_and_one_of_cameras_are_both_named_with_how_to_pair_them(renderer):
    poses = [part.expand(4, *part.shape) for part in renderer.scene_poses()]
    geometry = renderer.placed(*poses)
    matrix = torch.tensor(renderer.cameras[0].clip_matrix(), dtype=torch.float32)
    matrices = matrix.expand(3, 4, 4)
    with pytest.raises(ValueError) as caught:
        renderer(geometry=geometry, clip_matrices=matrices)
    message = str(caught.value)
    assert message.startswith("clip_matrices: got a batch of 3, expected 1 or 4, as geometry.positions has")
    assert "the poses of geometry 3 times in a row, in torch repeat_interleave(3, 0)" in message
    assert "all of clip_matrices 4 times, repeat(4, 1, …)" in message
    paired = renderer.placed(*(part.repeat_interleave(3, 0) for part in poses))  # as it says
    assert renderer(geometry=paired, clip_matrices=matrices.repeat(4, 1, 1)).shape[0] == 12


@pytest.mark.parametrize("name", ["light", "albedo", "textures"])
def test_batches_of_other_arguments_are_named_as_they_were_given(renderer, name):
    matrix = torch.tensor(renderer.cameras[0].clip_matrix(), dtype=torch.float32)
    given = {
        "light": torch.ones(4, 32, 3),
        "albedo": [torch.ones(4, 1, 3), None],
        "textures": [None, torch.ones(4, 2, 2, 3)],
    }
    with pytest.raises(ValueError, match=r"got a batch of \d, expected 1 or \d, as .* has") as caught:
        renderer(**{name: given[name]}, clip_matrices=matrix.expand(3, 4, 4))
    assert name in str(caught.value) and "clip_matrices" in str(caught.value)


def test_a_batch_of_the_renderers_own_cameras_is_named():
    scene = small_scene()
    renderer = TorchRenderer(scene, cameras=[scene.camera] * 2)
    with pytest.raises(ValueError, match="light: got a batch of 3, expected 1 or 2, as cameras has"):
        renderer(torch.ones(3, 32, 3))


@pytest.mark.parametrize("moving", [[1.0], [True], [-1], [2], ["1"], 1])
def test_bodies_that_move_are_numbers_of_the_scenes(renderer, moving):
    with pytest.raises(ValueError, match="^moving: got .*, expected "):
        renderer.placed(*renderer.scene_poses(), moving=moving)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        (torch.zeros(3).double(), r"parameters: got torch.float64, .*.float\(\)"),
        (np.zeros(3), "parameters: got ndarray, expected a tensor"),
        (torch.tensor(1.0), "parameters: last dimension"),
    ],
)
def test_rotations_of_what_is_no_float32_tensor_are_refused(parameters, message):
    with pytest.raises(ValueError, match=message):
        rotation_matrices(parameters)


def test_a_huge_finite_tensor_is_not_mistaken_for_infinity(renderer):
    assert renderer(torch.full((32, 3), 1e18)).isfinite().all()
    with pytest.raises(ValueError, match="light: got 96 values out of range"):
        renderer(torch.full((32, 3), 3e38))
    with pytest.raises(ValueError, match="NaN or Inf"):
        renderer(torch.full((32, 3), 3e38) * 10)


def test_a_tensor_that_changes_before_backward_is_noticed(renderer):
    light = random(renderer.basis.size, 3)
    loss = renderer(light).square().sum()
    with torch.no_grad():
        light.mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_geometry_and_cameras_that_rays_would_have_to_follow_are_refused():
    renderer = TorchRenderer(small_scene("ray-traced"))
    rotations, translations, scales = renderer.scene_poses()
    clip_matrix = torch.tensor(renderer.scene.camera.clip_matrix(), dtype=torch.float32, requires_grad=True)
    geometry = renderer.placed(rotations, translations.requires_grad_(), scales)
    for inputs in ({"geometry": geometry}, {"clip_matrices": clip_matrix}):
        with pytest.raises(ValueError, match="^geometry, clip_matrices: got arrays that require a gradient"):
            renderer(**inputs)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rotations": torch.eye(3).expand(3, 3, 3)}, r"rotations: got shape \(3, 3, 3\), expected \[2, 3, 3\]"),
        ({"translations": torch.zeros(2, 2)}, r"translations: got shape \(2, 2\), expected \[2, 3\]"),
        ({"scales": torch.full((2,), float("nan"))}, "scales: got 2 NaN"),
        ({"scales": torch.tensor([1.0, -1.0])}, r"scales: got 1 values out of range .*: -1\), expected 0 to"),
        ({"translations": torch.zeros(2, 3).double()}, "translations: got torch.float64"),
        (
            {"translations": torch.zeros(3, 2, 3), "rotations": torch.eye(3).expand(2, 2, 3, 3)},
            "translations: got a batch of 3, expected 1 or 2",
        ),
    ],
)
def test_poses_that_do_not_fit_are_refused(renderer, change, message):
    rotations, translations, scales = renderer.scene_poses()
    poses = {"rotations": rotations, "translations": translations, "scales": scales, **change}
    with pytest.raises(ValueError, match=message):
        renderer.placed(**poses)


def test_rotations_of_all_kinds_are_rotations():
    generator = torch.Generator().manual_seed(0)
    for count in (3, 4, 6, 9):
        matrices = rotation_matrices(torch.randn(2, 5, count, generator=generator))
        assert matrices.shape == (2, 5, 3, 3)
        assert (matrices @ matrices.mT - torch.eye(3)).abs().max() < FLOAT32
        assert (torch.linalg.det(matrices) - 1).abs().max() < FLOAT32
    with pytest.raises(ValueError, match="parameters: last dimension: got 5"):
        rotation_matrices(torch.zeros(2, 5))


def test_placed_refuses_what_is_no_rotation_and_takes_what_a_step_leaves_of_one(renderer):
    rotations, translations, scales = renderer.scene_poses()
    for wrong in (2 * rotations, 0.9 * rotations, rotations * torch.tensor([-1.0, 1, 1]), torch.zeros_like(rotations)):
        with pytest.raises(ValueError, match=r"^rotations: got 2 matrices that are no rotations \(first at index"):
            renderer.placed(wrong, translations, scales)
    stepped = rotations + 0.01 * torch.sign(torch.randn(rotations.shape, generator=torch.Generator().manual_seed(0)))
    renderer.placed(stepped, translations, scales)


@pytest.mark.slow
def test_nine_free_numbers_descend_to_a_rotation(renderer):
    """The nearest rotation is taken of them, which need not be one; they are found by their gradient."""
    wanted = rotation_matrices(torch.tensor([[0.3, -0.5, 0.2], [0.0, 0.1, 0.0]]))
    _, translations, scales = renderer.scene_poses()
    target = renderer.placed(wanted, translations, scales).positions
    numbers = torch.eye(3).repeat(2, 1, 1).requires_grad_()
    optimizer = torch.optim.Adam([numbers], lr=0.05)
    for _ in range(200):
        optimizer.zero_grad()
        turns = rotation_matrices(numbers.flatten(-2))
        (renderer.placed(turns, translations, scales).positions - target).square().mean().backward()
        optimizer.step()
    assert (turns - wanted).abs().max() < 1e-3


# ---------------------------------------------------------------------------------------------- over time


@pytest.mark.parametrize(
    ("method", "bounces", "roughness"),
    [
        *((method, 0, None) for method in METHODS),
        ("directional", 2, None),
        ("log-sh", 2, None),
        ("ray-traced", 1, None),
        ("directional", 0, 0.4),
        ("directional", 1, 0.4),
        ("ray-traced", 0, 0.4),
    ],
)
def test_the_memory_of_a_call_is_free_without_garbage_collection(method, bounces, roughness):
    """Python's collector knows nothing of how much memory an array holds, least of all on a GPU."""
    scene = small_scene(method)
    bodies = dataclasses.replace(scene.bodies[0], roughness=roughness), *scene.bodies[1:]
    renderer = TorchRenderer(dataclasses.replace(scene, bodies=bodies, bounces=bounces))
    rotations, translations, scales = renderer.scene_poses()
    has_gradient = method != "ray-traced"

    def iterate() -> None:
        for requires_grad in {False, has_gradient}:
            moved = translations.clone().requires_grad_(requires_grad)
            image = renderer(geometry=renderer.placed(rotations, moved, scales))
            if requires_grad:
                image.sum().backward()

    iterate()
    gc.collect()
    gc.disable()
    try:
        iterate()
        gc.set_debug(gc.DEBUG_SAVEALL)
        gc.collect()
        arrays = [item for item in gc.garbage if type(item) is wp.array]
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()
    assert not arrays


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="resident memory is read from Linux's /proc")
def test_memory_does_not_grow_over_iterations(renderer):
    values = inputs_of(renderer)

    big = random(160, 160, 3)  # 0.3 MB, and as much its gradient, so that what is kept would be seen

    def iterate(count: int) -> int:
        """Resident memory afterwards [bytes]."""
        for _ in range(count):
            renderer(values["light"], albedo=[values["vertices"], None], textures=[None, big]).sum().backward()
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()

    before = iterate(20)
    grown = iterate(200) - before  # 6 MB measured
    assert grown < 20e6, f"{grown / 1e6:.0f} MB more after 200 iterations of 0.6 MB"


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="resident memory is read from Linux's /proc")
def test_memory_does_not_grow_while_bodies_move(renderer):
    rotations, translations, scales = renderer.scene_poses()
    translations.requires_grad_()

    def iterate(count: int) -> int:
        """Resident memory afterwards [bytes]."""
        for _ in range(count):
            renderer(geometry=renderer.placed(rotations, translations, scales)).sum().backward()
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()

    before = iterate(20)
    grown = iterate(400) - before  # 2.3 MB measured
    assert grown < 8e6, f"{grown / 1e6:.0f} MB more after 400 iterations"


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_light_is_recovered_from_an_image(method):
    """Adam explains the image; a second-order method on this least-squares problem finds the light itself."""
    truth = torch.tensor([[3.0, 2.5, 2.0], [1.0, 0.8, 0.6], [-0.5, 0.2, 0.3], [0.4, -0.3, 0.1]])
    renderer = TorchRenderer(small_scene(method), basis=ws.HarmonicBasis(2))
    with torch.no_grad():
        wanted = renderer(truth)
    light = torch.zeros(4, 3, requires_grad=True)

    def loss() -> torch.Tensor:
        optimizer.zero_grad()
        value = torch.nn.functional.mse_loss(renderer(light), wanted) / wanted.square().mean()
        value.backward()
        return value

    optimizer = torch.optim.Adam([light], lr=0.2)
    for _ in range(80):
        optimizer.step(loss)
    assert loss().sqrt() < 0.05  # relative error of the image: 3% measured
    optimizer = torch.optim.LBFGS(
        [light], max_iter=100, tolerance_change=0, tolerance_grad=0, line_search_fn="strong_wolfe"
    )
    optimizer.step(loss)
    conditioning = 1e-4  # float32 rounding times the condition number: 2e-6 measured
    assert (light.detach() - truth).abs().max() < conditioning


def test_a_texture_is_recovered_under_known_shadows():
    renderer = TorchRenderer(small_scene(size=24))
    truth = random(4, 4, 3, seed=9).detach()
    with torch.no_grad():
        wanted = renderer(textures=[None, truth])
    texture = torch.full((4, 4, 3), 0.5, requires_grad=True)
    optimizer = torch.optim.Adam([texture], lr=0.1)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 200)
    for _ in range(200):
        optimizer.zero_grad()
        torch.nn.functional.mse_loss(renderer(textures=[None, texture]), wanted).backward()
        optimizer.step()
        schedule.step()
    assert (texture.detach() - truth).abs().max() < 0.02


# ---------------------------------------------------------------------------------------------- networks


class LightEstimator(torch.nn.Module):
    """A network whose last layer is the renderer."""

    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(4, 4 * 3)
        self.renderer = TorchRenderer(small_scene("none"), basis=ws.HarmonicBasis(2))

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        return self.renderer(self.layer(features).reshape(-1, 4, 3))


def train(estimator: LightEstimator, model: torch.nn.Module, share: slice) -> dict[str, torch.Tensor]:
    """One step of training on a share of a batch of four; returns the parameters."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        estimator.layer.reset_parameters()
    features = torch.randn(4, 4, generator=torch.Generator().manual_seed(1))
    optimizer = torch.optim.SGD(model.parameters(), lr=0.1)
    model(features[share]).square().mean().backward()
    optimizer.step()
    return {name: value.clone() for name, value in estimator.layer.state_dict().items()}


def parallel_step(rank: int, folder: str) -> None:
    """What one of two processes does; its parameters are saved."""
    torch.set_num_threads(1)
    store = torch.distributed.FileStore(f"{folder}/store", 2)
    torch.distributed.init_process_group("gloo", store=store, rank=rank, world_size=2)
    estimator = LightEstimator()
    model = torch.nn.parallel.DistributedDataParallel(estimator)
    torch.save(train(estimator, model, slice(2 * rank, 2 * rank + 2)), f"{folder}/{rank}.pt")
    torch.distributed.barrier()  # a process that leaves while another still talks to it takes that one down
    torch.distributed.destroy_process_group()


@pytest.mark.slow
@pytest.mark.skipif(not torch.distributed.is_available(), reason="this torch has no torch.distributed")
def test_two_processes_train_as_one(tmp_path):
    """DistributedDataParallel averages gradients that went through the renderer."""
    estimator = LightEstimator()
    expected = train(estimator, estimator, slice(4))
    torch.multiprocessing.spawn(parallel_step, (str(tmp_path),), nprocs=2)
    first, second = (torch.load(tmp_path / f"{rank}.pt") for rank in range(2))
    share = train(estimator, estimator, slice(2))
    for name, alone in expected.items():
        torch.testing.assert_close(first[name], alone)
        assert torch.equal(first[name], second[name])
        assert not torch.allclose(alone, share[name], rtol=1e-4)  # each has learned of the other


# ---------------------------------------------------------------------------------------------- several cameras


def test_several_cameras_make_a_batch_of_images_and_add_up_their_gradients():
    scene = small_scene()
    cameras = [ws.Camera.look_at(eye, (0, 0.6, 0), size=(12, 12)) for eye in [(0, 2.5, 5), (3, 2, -3)]]
    together = TorchRenderer(scene, cameras=cameras)
    light, texture = random(together.basis.size, 3, seed=1), random(5, 7, 3, seed=2)
    shifts = together.scene_poses()[1].requires_grad_()
    weights = random(2, 12, 12, 4, seed=3).detach()

    def image_of(renderer: TorchRenderer) -> torch.Tensor:
        rotations, _, scales = renderer.scene_poses()
        moved = renderer(light, textures=[None, texture], geometry=renderer.placed(rotations, shifts, scales))
        return renderer(light, textures=[None, texture]) + moved

    images = image_of(together)
    assert images.shape == (2, 12, 12, 4)
    gradients = torch.autograd.grad((images * weights).sum(), (light, texture, shifts))
    sums = [torch.zeros_like(gradient) for gradient in gradients]
    for number, camera in enumerate(cameras):
        image = image_of(TorchRenderer(dataclasses.replace(scene, camera=camera)))
        assert (image - images[number]).abs().max() < FLOAT32 * images.max()
        for total, part in zip(
            sums, torch.autograd.grad((image * weights[number]).sum(), (light, texture, shifts)), strict=True
        ):
            total += part
    for gradient, expected in zip(gradients, sums, strict=True):
        assert (gradient - expected).abs().max() < 5 * FLOAT32 * expected.abs().max()


def test_a_camera_that_a_call_is_given_replaces_several():
    scene = small_scene("none")
    camera = dataclasses.replace(scene.camera)
    renderer = TorchRenderer(scene, cameras=[camera, camera])
    matrix = torch.tensor(camera.clip_matrix(), dtype=torch.float32)
    assert torch.equal(renderer(clip_matrices=matrix), renderer()[1])


def test_matrices_of_opengl_are_refused_and_converted(renderer):
    ours = torch.tensor(renderer.cameras[0].clip_matrix(), dtype=torch.float32)
    near, far = float(ours[2, 3]), 50.0
    theirs = ours * torch.tensor([1.0, -1.0, 1.0, 1.0])[:, None]  # y up; z/w from -1 at the near plane to 1 at the far
    theirs[2] = (far + near) / (far - near) * ours[3]
    theirs[2, 3] -= 2 * far * near / (far - near)
    with pytest.raises(ValueError, match=r"clip_matrices: got one with rows z = .*clip_matrices_from_opengl"):
        renderer(clip_matrices=theirs)
    theirs.requires_grad_()
    converted = clip_matrices_from_opengl(theirs)
    torch.testing.assert_close(converted, ours)
    weights = torch.rand(3, 4, 4)
    (gradient,) = torch.autograd.grad((clip_matrices_from_opengl(theirs.expand(3, 4, 4)) * weights).sum(), theirs)
    expected = weights.sum(0) * torch.tensor([1.0, -1.0, 0.0, 1.0])[:, None]
    torch.testing.assert_close(gradient, expected)
    with pytest.raises(ValueError, match="matrices: got Tensor .* no perspective of OpenGL"):
        clip_matrices_from_opengl(ours)


SLEEPERS = """
import os, torch, warp as wp
wp.config.quiet = True
from warpshadow.torch import apply
torch.set_num_threads(2)
threads = lambda: len(os.listdir("/proc/self/task"))
before = threads()
for _ in range(3):
    apply(lambda array: wp.clone(array), torch.zeros(3), dtypes=[wp.float32])
print(threads() - before, torch.get_num_threads())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="GNU's OpenMP")
@pytest.mark.parametrize("policy", [None, "active"])
def test_openmp_has_more_threads_than_cores_so_that_those_that_wait_sleep(policy):
    """Unless the environment says how to wait; and torch keeps its number of threads."""
    environment = {name: text for name, text in os.environ.items() if name not in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")}
    if policy is not None:
        environment["OMP_WAIT_POLICY"] = policy
    run = subprocess.run(
        [sys.executable, "-c", SLEEPERS], env=environment, capture_output=True, text=True, check=True, timeout=120
    )
    more, team = map(int, run.stdout.split()[-2:])
    assert team == 2
    if policy is None:
        assert more >= 2 * len(os.sched_getaffinity(0))  # each begins a team of two and stays
    else:
        assert more < 2


def test_the_rotations_that_a_caller_gets_may_be_changed_before_the_gradient_is_asked_for():
    numbers = torch.randn(4, 9, generator=torch.Generator().manual_seed(0))
    gradients = []
    for copies in (False, True):
        free = numbers.clone().requires_grad_()
        rotations = rotation_matrices(free)
        rotations = rotations.clone() if copies else rotations
        rotations.mul_(torch.arange(9.0).reshape(3, 3))
        rotations.square().sum().backward()
        gradients.append(free.grad)
    torch.testing.assert_close(*gradients)


def test_light_that_is_no_tensor_is_refused(renderer):
    light = np.ones((renderer.basis.size, 3), np.float32)
    with pytest.raises(ValueError, match="light: got ndarray, expected a tensor of torch.float32"):
        renderer(light)


@pytest.mark.parametrize("count", [None, 1, 3])
def test_the_cameras_and_poses_of_a_scene_are_what_the_renderer_takes(count):
    scene = small_scene()
    cameras = None if count is None else [scene.camera.turned(10 * k) for k in range(count)]
    renderer = TorchRenderer(scene, cameras=cameras)
    composed = renderer.clip_matrices(*renderer.scene_cameras())
    expected = np.stack([camera.clip_matrix() for camera in renderer.cameras])
    np.testing.assert_allclose(composed, expected[0] if count is None else expected, rtol=1e-5, atol=1e-5)
    placed = renderer.placed(*renderer.scene_poses())
    np.testing.assert_allclose(
        placed.positions.numpy(), renderer.array_renderer.geometry().positions.numpy()[0], atol=1e-6
    )


def test_rotations_are_scipys_quaternions_with_w_last_and_vectors_in_radians():
    """What a body's rotation is in degrees."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_euler("xyz", (10, 50, -70), degrees=True)
    body = ws.Body(ws.icosphere(1.0, 0), rotation=turn.as_rotvec(degrees=True))
    np.testing.assert_allclose(body.rotation_matrix(), turn.as_matrix(), atol=1e-12)
    for parameters in (turn.as_quat(), turn.as_rotvec()):
        made = rotation_matrices(torch.tensor(parameters, dtype=torch.float32))
        np.testing.assert_allclose(made, turn.as_matrix(), atol=1e-6)


def off_center_scene():
    """A box whose own origin is far outside, turned and scaled."""
    box = ws.plane(1.0, 2).transformed(translation=(3.0, 0.5, -2.0))
    posed = ws.Body(box, rotation=(0, 30, 10), translation=(-1, 0, 1), scale=0.7, blockers=0)
    ball = ws.Body(ws.icosphere(0.5, 1), blockers=ws.Spheres([[0, 0, 0]], [0.5]), translation=(0, 1, 0))
    return dataclasses.replace(small_scene(), bodies=(posed, ball))


def test_a_body_turns_about_its_middle_and_stays_there():
    renderer = TorchRenderer(off_center_scene())
    R, t, s = renderer.scene_poses(pivot="center")
    own = renderer.placed(*renderer.scene_poses()).positions
    torch.testing.assert_close(renderer.placed(R, t, s, pivot="center").positions, own, rtol=0, atol=1e-5)
    turn = rotation_matrices(torch.tensor([[0.3, -0.8, 0.4], [0.0, 0.0, 0.0]]))
    turned = renderer.placed(turn @ R, t, s, pivot="center").positions
    mesh = renderer.scene.bodies[0].mesh.positions.astype(np.float64)
    middle = (mesh.min(axis=0) + mesh.max(axis=0)) / 2  # of the body's own space
    world = 0.7 * middle @ R[0].double().numpy().T + (-1, 0, 1)
    expected = (own[: len(mesh)].double().numpy() - world) @ turn[0].double().numpy().T + world
    np.testing.assert_allclose(turned[: len(mesh)].numpy(), expected, atol=1e-5)
    torch.testing.assert_close(turned[len(mesh) :], own[len(mesh) :], rtol=0, atol=1e-5)
    points = torch.tensor(np.array([middle, [0, 0, 0]]), dtype=torch.float32)
    torch.testing.assert_close(renderer.placed(turn @ R, t, s, pivot=points).positions, turned, rtol=0, atol=1e-5)
    torch.testing.assert_close(renderer.scene_poses(pivot=points)[1], t, rtol=0, atol=1e-5)


@pytest.mark.parametrize("batch", [(), (3,)])
def test_the_gradients_of_poses_about_a_pivot_are_those_of_the_formula(batch):
    renderer = TorchRenderer(off_center_scene())
    turns, shifts = random(*batch, 2, 3, seed=1), random(*batch, 2, 3, seed=2)
    scales, pivots = random(*batch, 2, seed=3, low=0.5), random(2, 3, seed=4)
    mesh = [torch.tensor(body.mesh.positions) for body in renderer.scene.bodies]
    weights = torch.rand(*batch, sum(map(len, mesh)), 3, generator=torch.Generator().manual_seed(5))

    def by_formula(turns, shifts, scales, pivots):
        R, posed = rotation_matrices(turns), []
        for body, points in enumerate(mesh):
            arms = (points - pivots[body]) @ R[..., body, :, :].mT
            posed.append(scales[..., body, None, None] * arms + shifts[..., body, None, :])
        return torch.cat(posed, dim=-2)

    def by_renderer(turns, shifts, scales, pivots):
        return renderer.placed(rotation_matrices(turns), shifts, scales, pivot=pivots).positions

    inputs = turns, shifts, scales, pivots
    ours, expected = (
        (positions := function(*inputs), *torch.autograd.grad((positions * weights).sum(), inputs))
        for function in (by_renderer, by_formula)
    )
    for one, other in zip(ours, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)


def test_pivots_that_are_none_are_refused():
    renderer = TorchRenderer(off_center_scene())
    poses = renderer.scene_poses()
    with pytest.raises(ValueError, match="^pivot: got 'middle', expected one of 'center'"):
        renderer.placed(*poses, pivot="middle")
    with pytest.raises(ValueError, match=r"^pivot: got shape \(3, 3\), expected \[2, 3\]"):
        renderer.placed(*poses, pivot=torch.zeros(3, 3))
    with pytest.raises(ValueError, match="^pivot: got 1 NaN"):
        renderer.array_renderer.scene_poses(pivot=(0, np.nan, 0))


@pytest.mark.parametrize("backend", ["eager", "aot_eager"])  # the latter is the default, inductor, but for its C++
@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")  # torch's own, of its compiler
def test_code_that_torch_compiles_may_render(backend):
    renderer = TorchRenderer(small_scene(), basis=ws.HarmonicBasis(3))

    def loss(light, turn, shift):
        rotations, translations, scales = renderer.scene_poses()
        placed = renderer.placed(rotation_matrices(turn.sin()) @ rotations, translations + shift.exp(), scales)
        cameras = renderer.clip_matrices(*renderer.scene_cameras())
        return (renderer(2 * light.square(), geometry=placed, clip_matrices=cameras)[..., :3] ** 2).mean()

    torch.compiler.reset()
    found = []
    for function in (loss, torch.compile(loss, backend=backend)):
        inputs = random(9, 3), random(2, 3, seed=1), random(2, 3, seed=2, low=-3.0)
        for _ in range(2):
            value = function(*inputs)
        found.append((value.detach(), *torch.autograd.grad(value, inputs)))
    for plain, compiled in zip(*found, strict=True):
        assert plain.abs().max() > 0
        torch.testing.assert_close(compiled, plain, rtol=1e-4, atol=1e-6)


def test_a_compiled_renderer_is_one_and_the_compiler_is_not_imported_before():
    renderer = TorchRenderer(small_scene())
    torch.compiler.reset()
    torch.testing.assert_close(torch.compile(renderer, backend="eager")(), renderer(), rtol=0, atol=0)
    program = "import sys, warpshadow.torch; print('torch._dynamo' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "False"


@pytest.mark.parametrize(
    ("argument", "value"),
    [("albedo", {0: torch.tensor([200.0, 90.0, 30.0])}), ("textures", {1: torch.full((4, 4, 3), 180.0)})],
)
def test_colors_from_0_to_255_are_refused_as_those_of_bodies_are(renderer, argument, value):
    message = rf"^{argument}\[\d\]: got values from .*, expected reflectances in \[0, 1\], linear: those of sRGB colors"
    with pytest.raises(ValueError, match=message):
        renderer(**{argument: value})


def test_an_albedo_that_a_step_took_out_of_its_range_is_drawn(renderer):
    assert renderer(albedo={0: torch.tensor([1.3, -0.2, 4.0])}).isfinite().all()
