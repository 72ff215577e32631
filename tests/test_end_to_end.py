"""Every path from a parameter to the loss, as a whole: gradients of images against central differences of them."""

import dataclasses

import numpy as np
import pytest
import torch
import warp as wp

import warpshadow as ws
from warpshadow.pipeline.views import receiver_finder
from warpshadow.pipeline.views import view as view_module
from warpshadow.stages.image import film
from warpshadow.stages.textures import pyramid, sample
from warpshadow.torch import TorchRenderer, apply, rotation_matrices

# Where no silhouette moves the loss is smooth, and what is left is float32 rounding over the step.
SMOOTH = 1e-2
# Silhouettes are sampled by pixels, whose colors stand for those at the edge.
SILHOUETTE = 5e-2

# Of a textured ball, whose own outline is in view, on average over places. Measured 1.4 and 0.9% at 1 and 2² samples a
# pixel, and 11.3 and 9.0% where albedo moves with the points of all samples.
TEXTURED = 3e-2

# Gradients are summed up in slices, whose number follows the size of the launch.
SUMS = {"rtol": 1e-4, "atol": 1e-4}

METHODS = ("directional", "log-sh", "none")

pytestmark = pytest.mark.usefixtures("one_thread")


def blob() -> ws.Body:
    """A bumpy ball with spheres that overlap, a little above the ground."""
    mesh = ws.icosphere(1.0, 3)
    bumps = 1 + 0.15 * np.sin(4 * mesh.positions[:, :1]) * np.cos(3 * mesh.positions[:, 1:2])
    mesh = ws.Mesh(mesh.positions * bumps, mesh.faces, name="blob")
    centers = [(0.3, 0, 0), (-0.3, 0.1, 0), (0, 0.3, 0.3), (0, -0.3, -0.2), (0.1, 0.2, -0.3), (-0.1, -0.2, 0.35)]
    spheres = ws.Spheres(centers, [0.7, 0.65, 0.6, 0.6, 0.65, 0.6])
    return ws.Body(mesh, albedo=(0.7, 0.5, 0.3), blockers=spheres, translation=(0, 0.9, 0), scale=0.6)


ON_BOTH = ws.Camera.look_at((0.5, 2.2, 3.6), (0, 0.5, 0), size=(64, 64))
ON_GROUND = ws.Camera.look_at((1.6, 0.6, -0.5), (1.35, 0.0, -0.4), fov_y=50, size=(32, 32))
"""Sees the ground alone, and on it the shadow of a body that is out of view."""


def scene_of(method: str, camera: ws.Camera, **visibility) -> ws.Scene:
    ground = ws.Body(ws.plane(6.0, 48), albedo=(0.3, 0.5, 0.6), blockers=0, receivers="vertex")
    sky = ws.synthetic_sky((-0.7, 0.5, 0.2), sun_radius=12, sun_strength=3, height=32)
    return ws.Scene((blob(), ground), sky, camera, ws.Visibility.of({"method": method} | visibility))


def smooth_weights(height: int, width: int) -> torch.Tensor:
    """A few waves, different in each channel."""
    rng = np.random.default_rng(3)
    row, column = np.mgrid[0 : 1 : height * 1j, 0 : 1 : width * 1j]
    waves = [np.sin(6 * (a * row + b * column) + c) for a, b, c in rng.normal(size=(4, 3)) * [1, 1, 3]]
    return torch.from_numpy(np.stack(waves, axis=-1))


class Poses:
    """The image as a function of (turn [3], shift [3], scale [1]) of the blob."""

    def __init__(self, renderer: TorchRenderer):
        self.renderer = renderer
        self.rotations, self.translations, self.scales = renderer.scene_poses()
        self.start = torch.zeros(7)

    def __call__(self, values: torch.Tensor) -> torch.Tensor:
        rest = torch.zeros(1, 3)
        turns = rotation_matrices(torch.cat([values[None, :3], rest]))
        shifts = self.translations + torch.cat([values[None, 3:6], rest])
        scales = self.scales * (1 + torch.cat([values[6:], torch.zeros(1)]))
        return self.renderer(geometry=self.renderer.placed(turns @ self.rotations, shifts, scales))


class Cameras:
    """The image as a function of (turn [3], shift [3], focal length [1]) of the camera."""

    def __init__(self, renderer: TorchRenderer):
        self.renderer = renderer
        self.start = torch.zeros(7)

    def __call__(self, values: torch.Tensor) -> torch.Tensor:
        camera = self.renderer.scene.camera
        matrix, turn, shift = (
            torch.tensor(array, dtype=torch.float32)
            for array in (camera.intrinsics, camera.rotation, camera.translation)
        )
        focal = torch.eye(3) + values[6] * torch.diag(torch.tensor([1.0, 1.0, 0.0]))
        matrices = self.renderer.clip_matrices(
            rotation_matrices(values[None, :3])[0] @ turn, shift + values[3:6], matrix @ focal
        )
        return self.renderer(clip_matrices=matrices)


class Deformations:
    """The image as a function of the rotations [node, 3], translations [node, 3] and radii [node] of a graph."""

    def __init__(self, renderer: TorchRenderer):
        self.renderer = renderer
        self.graph = renderer.deformation_graph(0, count=3)
        self.radii = torch.tensor(renderer.scene.bodies[0].blockers.radii)
        self.start = torch.zeros(7 * len(self.radii))

    def __call__(self, values: torch.Tensor) -> torch.Tensor:
        count = len(self.radii)
        turns, shifts = values[: 6 * count].reshape(2, 1, count, 3)
        radii = self.radii * (1 + values[6 * count :])
        matrices = rotation_matrices(turns)
        points = apply(self.graph.points, matrices, shifts, dtypes=(wp.mat33, wp.vec3))
        centers = apply(self.graph.centers, shifts, dtypes=(wp.vec3,))
        rest = self.renderer.deformed(0, points, centers, radii[None])
        rotations, translations, scales = self.renderer.scene_poses()
        return self.renderer(geometry=self.renderer.placed(rotations, translations, scales, rest=rest))[0]


def gradient_and_differences(image_of, directions: np.ndarray, step: float, channels: slice) -> tuple[np.ndarray, ...]:
    """Of Σ weights · image at the start, along directions [direction, parameter]: by autograd, by differences."""
    start = image_of.start.clone().requires_grad_()
    image = image_of(start)
    weights = smooth_weights(*image.shape[:2])[..., channels]

    def loss(image: torch.Tensor) -> torch.Tensor:
        return (image[..., channels].double() * weights).sum()

    (gradient,) = torch.autograd.grad(loss(image), start)
    assert gradient.isfinite().all()
    differences = []
    with torch.no_grad():
        for direction in torch.tensor(directions, dtype=torch.float32):
            ends = [loss(image_of(image_of.start + sign * step * direction)).item() for sign in (1, -1)]
            differences.append((ends[0] - ends[1]) / (2 * step))
    return directions @ gradient.double().numpy(), np.array(differences)


def relative_error(got: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(got - expected) / np.linalg.norm(expected))


def error_along_nodes(renderer: TorchRenderer) -> float:
    """Of the gradient of the image's color along six random directions of the blob's nodes."""
    image_of = Deformations(renderer)
    directions = np.random.default_rng(4).normal(size=(6, len(image_of.start)))
    return relative_error(*gradient_and_differences(image_of, directions, 2e-3, slice(3)))


# ---------------------------------------------------------------------------------------------- smooth paths


@pytest.mark.parametrize("method", ["directional", "log-sh"])
def test_a_shadow_alone_moves_the_body_that_casts_it(method):
    """The camera sees the ground alone; pose and scale of the blob out of view change what it sees by its shadow."""
    renderer = TorchRenderer(scene_of(method, ON_GROUND))
    assert set(np.unique(renderer.array_renderer.body_ids())) == {1}
    got, expected = gradient_and_differences(Poses(renderer), np.eye(7), 2e-3, slice(3))
    assert np.abs(expected[[0, 3, 4, 5, 6]]).min() > 0
    assert relative_error(got, expected) < SMOOTH


@pytest.mark.parametrize("method", ["directional", "log-sh"])
def test_a_shadow_alone_moves_the_nodes_of_a_deforming_body(method):
    assert error_along_nodes(TorchRenderer(scene_of(method, ON_GROUND))) < SMOOTH


# ---------------------------------------------------------------------------------------------- with silhouettes


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("parameters", [Poses, Cameras])
def test_what_moves_the_image_has_the_gradient_of_the_image(method, parameters):
    renderer = TorchRenderer(scene_of(method, ON_BOTH))
    got, expected = gradient_and_differences(parameters(renderer), np.eye(7), 4e-3, slice(4))
    assert relative_error(got, expected) < SILHOUETTE


def test_a_limb_pulls_by_the_color_it_has_at_its_edge(monkeypatch):
    """Shading changes fast where a ball turns away: by the pixel beside the edge the gradient would be far off."""
    ball = ws.Body(ws.icosphere(0.7, 4), albedo=(0.75, 0.62, 0.5), blockers=0, translation=(0, 1.2, 0))
    ground = ws.Body(ws.plane(6.0, 16), blockers=0)
    camera = ws.Camera.look_at((1.6, 2.6, 4.6), (0, 0.9, 0), fov_y=36, size=(64, 64))
    scene = ws.Scene((ball, ground), ws.synthetic_sky(), camera, ws.Visibility("none"))
    image_of = Poses(TorchRenderer(scene))
    shifts = np.eye(7)[3:6]
    got, expected = gradient_and_differences(image_of, shifts, 1e-2, slice(3))
    assert relative_error(got, expected) < SILHOUETTE
    monkeypatch.setattr(view_module, "moving_radiance", lambda *inputs: (film.sample_radiance(*inputs[:4]), None))
    beside, _ = gradient_and_differences(image_of, shifts, 1e-2, slice(3))
    assert relative_error(beside, expected) > 2 * relative_error(got, expected)


@pytest.mark.parametrize("supersampling", [1, 2])
def test_the_outline_of_a_textured_ball_has_on_average_the_gradient_of_the_image(supersampling):
    """Along paths of two pixels from random places, across a plain background."""
    mesh, size, generator = ws.icosphere(0.5, 3), 48, torch.Generator().manual_seed(0)
    row, column = 2 * np.pi * np.mgrid[0:1:64j, 0:1:64j]
    waves = 0.5 + 0.4 * np.sin(6 * column + 2 * row) * np.sin(4 * row - 2 * column)
    across = mesh.positions @ [[0.35, 0.1], [-0.1, 0.7], [0.2, -0.25]]  # no seam is in view
    textured = ws.Mesh(mesh.positions, mesh.faces, across + 0.3)
    ball = ws.Body(textured, texture=np.repeat(waves[..., None], 3, axis=2).astype(np.float32), blockers=0)
    camera = ws.Camera.look_at((0.3, 0.9, 2.6), (0, 0, 0), fov_y=32, size=(size, size))
    light = ws.EnvironmentMap(np.ones((8, 16, 3)))
    scene = ws.Scene([ball], light, camera, ws.Visibility("none"), supersampling=supersampling)
    renderer, image_weights = TorchRenderer(scene, progress=False), smooth_weights(size, size)[..., :3].float()
    rotations, translations, scales = renderer.scene_poses()

    def losses(shifts):
        images = renderer(geometry=renderer.placed(rotations, translations + shifts[:, None], scales))
        return torch.einsum("hwc,bhwc->bc", image_weights, images[..., :3])

    pixel, count = 2 * np.tan(np.radians(16)) * 2.75 / size, 64
    gradients, slopes = [], []
    for axis in torch.eye(3)[:2]:
        starts = pixel * torch.rand(count, 3, generator=generator)
        shares = (torch.arange(count) % 8 + torch.rand(count, generator=generator)) / 8
        shifts = (starts + 2 * pixel * shares[:, None] * axis).requires_grad_(True)
        sums = losses(shifts).sum(0)
        means = [torch.autograd.grad(value, shifts, retain_graph=True)[0].mean(0) @ axis for value in sums]
        gradients.append(torch.stack(means))
        with torch.no_grad():
            slopes.append((losses(starts + 2 * pixel * axis) - losses(starts)).mean(0) / (2 * pixel))
    assert relative_error(torch.stack(gradients).numpy(), torch.stack(slopes).numpy()) < TEXTURED


# ---------------------------------------------------------------------------------------------- batches


def random_batch(renderer: TorchRenderer, count: int) -> dict[str, torch.Tensor]:
    """Turns and shifts of both bodies, cameras, lights and colors."""
    generator = torch.Generator().manual_seed(0)
    basis_size = renderer.basis.size
    camera = torch.tensor(renderer.scene.camera.clip_matrix(), dtype=torch.float32)
    return {
        "turns": 0.3 * torch.randn(count, 2, 3, generator=generator),
        "shifts": 0.1 * torch.randn(count, 2, 3, generator=generator),
        "clip_matrices": camera * (1 + 0.01 * torch.randn(count, 4, 4, generator=generator)),
        "light": torch.rand(count, basis_size, 3, generator=generator),
        "albedo": torch.rand(count, 1, 3, generator=generator),
        "textures": torch.rand(count, 5, 4, 3, generator=generator),
    }


def image_of_batch(renderer: TorchRenderer, values: dict[str, torch.Tensor]) -> torch.Tensor:
    rotations, translations, scales = renderer.scene_poses()
    geometry = renderer.placed(rotation_matrices(values["turns"]) @ rotations, translations + values["shifts"], scales)
    return renderer(
        values["light"],
        albedo=[values["albedo"], None],
        textures=[None, values["textures"]],
        geometry=geometry,
        clip_matrices=values["clip_matrices"],
    )


@pytest.mark.slow
@pytest.mark.parametrize("receivers", ["vertex", "pixel"])
@pytest.mark.parametrize("method", METHODS)
def test_a_batch_is_its_instances_one_by_one(method, receivers):
    """Images to the bit; gradients, too, but for what all instances share, which is summed in another order."""
    scene = scene_of(method, ON_BOTH, directions=64, order=4)
    ground = dataclasses.replace(scene.bodies[1], receivers=receivers)
    renderer = TorchRenderer(dataclasses.replace(scene, bodies=(scene.bodies[0], ground)))
    values = random_batch(renderer, 3)
    together = {name: value.clone().requires_grad_() for name, value in values.items()}
    images = image_of_batch(renderer, together)
    weights = torch.randn(images.shape, generator=torch.Generator().manual_seed(1))
    (images * weights).sum().backward()
    for instance in range(3):
        alone = {name: value[instance : instance + 1].clone().requires_grad_() for name, value in values.items()}
        image = image_of_batch(renderer, alone)
        assert torch.equal(image[0], images[instance])
        (image[0] * weights[instance]).sum().backward()
        for name, value in alone.items():
            torch.testing.assert_close(value.grad[0], together[name].grad[instance], **SUMS)


@pytest.mark.parametrize("name", ["turns", "clip_matrices", "light", "albedo", "textures"])
def test_one_instance_of_anything_serves_all_of_the_rest(name):
    """A batch in which one argument is the same for all, given once or repeated."""
    renderer = TorchRenderer(scene_of("directional", ON_BOTH, directions=32))
    shared = ["turns", "shifts"] if name == "turns" else [name]
    values = random_batch(renderer, 2)
    once = {key: (value[:1].clone() if key in shared else value).requires_grad_() for key, value in values.items()}
    repeated = {key: value.detach().expand(2, *value.shape[1:]).clone().requires_grad_() for key, value in once.items()}
    images, expected = (image_of_batch(renderer, given) for given in (once, repeated))
    assert torch.equal(images, expected)
    weights = torch.randn(images.shape, generator=torch.Generator().manual_seed(2))
    for image in (images, expected):
        (image * weights).sum().backward()
    for key, value in once.items():
        gradient = repeated[key].grad
        expected_gradient = gradient.sum(dim=0, keepdim=True) if key in shared else gradient
        scale = expected_gradient.abs().max()
        assert (value.grad - expected_gradient).abs().max() < 1e-5 * scale


@pytest.mark.parametrize("name", ["turns", "clip_matrices", "light", "albedo", "textures"])
def test_only_one_argument_in_a_batch_makes_a_batch_of_images(name):
    renderer = TorchRenderer(scene_of("directional", ON_BOTH, directions=32))
    varied = ["turns", "shifts"] if name == "turns" else [name]
    values = random_batch(renderer, 2)
    given = {key: value if key in varied else value[:1] for key, value in values.items()}
    images = image_of_batch(renderer, given)
    for instance in range(2):
        one = {key: value[instance : instance + 1] if key in varied else value for key, value in given.items()}
        assert torch.equal(image_of_batch(renderer, one)[0], images[instance])
    assert not torch.equal(images[0], images[1])


def test_colors_in_a_batch_make_a_batch_of_images_without_any_texture():
    renderer = TorchRenderer(scene_of("none", ON_BOTH))
    colors = torch.rand(3, 1, 3, generator=torch.Generator().manual_seed(3), requires_grad=True)
    images = renderer(albedo=[colors, None])
    weights = torch.randn(images.shape, generator=torch.Generator().manual_seed(4))
    (images * weights).sum().backward()
    for instance, color in enumerate(colors.detach()):
        alone = color.clone().requires_grad_()
        image = renderer(albedo=[alone, None])
        assert torch.equal(image, images[instance])
        (image * weights[instance]).sum().backward()
        torch.testing.assert_close(alone.grad, colors.grad[instance])


@pytest.mark.parametrize("method", ["directional", "none"])
def test_colors_in_a_batch_over_one_geometry_have_the_gradients_of_each(method):
    renderer = TorchRenderer(scene_of(method, ON_BOTH))
    rotations, translations, scales = renderer.scene_poses()
    colors = torch.rand(3, 1, 3, generator=torch.Generator().manual_seed(3))

    def gradient(given: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        moved = translations.clone().requires_grad_()
        image = renderer(albedo=[given, None], geometry=renderer.placed(rotations, moved, scales))
        (image * weights).sum().backward()
        return moved.grad

    weights = torch.randn(3, 64, 64, 4, generator=torch.Generator().manual_seed(4))
    alone = sum(gradient(color, weight) for color, weight in zip(colors, weights, strict=True))
    torch.testing.assert_close(gradient(colors, weights), alone, rtol=1e-3, atol=1e-3)


def test_a_tensor_that_is_read_through_data_is_seen_to_change():
    renderer = TorchRenderer(scene_of("none", ON_BOTH))
    geometry = renderer.placed(*renderer.scene_poses())
    positions = torch.nn.Parameter(geometry.positions.clone())

    def draw() -> torch.Tensor:
        return renderer(geometry=dataclasses.replace(geometry, positions=positions.data))

    before = draw()
    with torch.no_grad():
        positions.add_(0.1)
    assert not torch.equal(draw(), before)
    with torch.inference_mode():
        draw()


def test_it_does_not_matter_whether_a_thread_owns_a_row_of_samples_or_one(monkeypatch):
    """Rows are for CPUs; GPUs start a thread for every sample."""
    results = []
    for modules in ((), (film, pyramid, sample)):
        for module in modules:
            monkeypatch.setattr(module, "run_length", lambda device, width: 1)
        renderer = TorchRenderer(scene_of("none", ON_BOTH))
        values = {name: value.requires_grad_() for name, value in random_batch(renderer, 2).items()}
        images = image_of_batch(renderer, values)
        weights = torch.randn(images.shape, generator=torch.Generator().manual_seed(6))
        (images * weights).sum().backward()
        results.append([images.detach(), *(value.grad for value in values.values())])
    assert torch.equal(results[0][0], results[1][0])
    for of_rows, of_samples in zip(results[0][1:], results[1][1:], strict=True):
        torch.testing.assert_close(of_rows, of_samples, **SUMS)


def test_geometry_that_does_not_move_gives_the_scenes_image():
    for method in METHODS:
        renderer = TorchRenderer(scene_of(method, ON_BOTH))
        geometry = renderer.placed(*renderer.scene_poses())
        assert torch.equal(renderer(geometry=geometry), renderer())


# ---------------------------------------------------------------------------------------------- what is not seen


@pytest.mark.usefixtures("poisoned_outputs")
@pytest.mark.parametrize(("size", "coarsest"), [(16, 0), (300, 1), (700, 3)])
def test_levels_that_no_sample_takes_have_no_part_in_images_or_gradients(size, coarsest):
    """The first image finds out which levels it takes, the second one computes no others."""
    renderer = TorchRenderer(scene_of("none", ON_BOTH))
    image = torch.rand(size, size, 3, generator=torch.Generator().manual_seed(7), requires_grad=True)
    results = []
    for _ in range(2):
        (gradient,) = torch.autograd.grad(renderer(textures=[None, image]).square().sum(), image)
        results.append((renderer(textures=[None, image]).detach(), gradient))
    assert renderer.array_renderer.view().coarsest_level((None, (size, size))) == coarsest
    for first, second in zip(*results, strict=True):
        assert torch.equal(first, second)


def all_marked(vertex_count):
    """As if all vertices were seen."""
    return wp.array(np.ones((1, vertex_count)), dtype=wp.bool, device="cpu")


@pytest.mark.slow
@pytest.mark.parametrize("receivers", ["vertex", "pixel"])
@pytest.mark.parametrize("method", ["directional", "log-sh", "none"])
def test_what_is_not_seen_has_no_part_in_images_or_gradients(method, receivers, monkeypatch):
    """A body lies behind the camera; then light is evaluated at every vertex, and nothing changes."""
    scene = scene_of(method, ON_BOTH, directions=32, order=4)
    behind = dataclasses.replace(scene.bodies[0], translation=(0.5, 2.2, 8.0))
    ground = dataclasses.replace(scene.bodies[1], receivers=receivers)
    scene = dataclasses.replace(scene, bodies=(scene.bodies[0], ground, behind))
    results, counts = {}, {}
    for name in ("seen", "every"):
        if name == "every":
            monkeypatch.setattr(receiver_finder, "mark_seen_vertices", lambda *arguments: all_marked(arguments[-1]))
        renderer = TorchRenderer(scene)
        counts[name] = renderer.array_renderer.view().receivers.points.shape[1]
        rotations, translations, scales = renderer.scene_poses()
        shifts = torch.zeros(3, 3, 3)
        shifts[1, :, 0], shifts[2] = 0.1, 50.0  # the last instance sees nothing
        variables = [(translations + shift).requires_grad_() for shift in (shifts[0], shifts)]
        images = [renderer(geometry=renderer.placed(rotations, variable, scales)) for variable in variables]
        weights = torch.randn(images[1].shape, generator=torch.Generator().manual_seed(5))
        (images[0] * weights[0]).sum().backward()
        (images[1] * weights).sum().backward()
        results[name] = [renderer(), *images, *(variable.grad for variable in variables)]
    assert counts["seen"] < counts["every"] - 642  # the vertices of the body behind, and others
    for got, expected in zip(results["seen"], results["every"], strict=True):
        assert (got - expected).abs().max() <= 2e-6 * expected.abs().max()


@pytest.mark.parametrize("method", METHODS)
def test_an_image_of_nothing_has_no_gradient(method):
    renderer = TorchRenderer(scene_of(method, ws.Camera.look_at((0, 5, 0), (0, 10, 0.1), size=(16, 16))))
    rotations, translations, scales = renderer.scene_poses()
    translations.requires_grad_()
    light = torch.ones(renderer.basis.size, 3, requires_grad=True)
    geometry = renderer.placed(rotations, translations, scales)
    images = [renderer(light), renderer(light, geometry=geometry)]
    assert not images[0].any() and not images[1].any()
    assert renderer.array_renderer.view().receivers.points.shape == (1, 0)
    for image in images:
        image.sum().backward()
    assert not light.grad.any() and not translations.grad.any()
