"""What is left out changes nothing, what changes is noticed, and what is said to be left out is left out."""

import dataclasses
import functools
from collections import Counter

import numpy as np
import pytest
import torch
import warp as wp

import warpshadow as ws
from warpshadow.assets.basis import HarmonicBasis
from warpshadow.device import warp_internals
from warpshadow.device.batch import expand
from warpshadow.maths.directions import CHUNK, fibonacci
from warpshadow.pipeline import node
from warpshadow.pipeline.bodies import merged_scene
from warpshadow.pipeline.bodies.geometry import Geometry
from warpshadow.pipeline.methods import directional as directional_method
from warpshadow.pipeline.renderer import SceneRenderer
from warpshadow.pipeline.views.view import View
from warpshadow.stages.geometry.normals import vertex_normals
from warpshadow.stages.geometry.poses import Poses
from warpshadow.stages.light.light_samples import sample_map
from warpshadow.stages.ray_traced.traced_transfer import trace_transfer
from warpshadow.stages.rays.ray_tracing import trace_shading
from warpshadow.stages.visibility import directional
from warpshadow.torch import TorchRenderer

METHODS = ("directional", "log-sh", "none")
# The same float32 numbers, summed in another order.
FLOAT32 = 1e-5
# Exponentials of sums of float32 logs: squarings amplify how they are rounded.
EXPONENTIAL = 1e-3
# What rays find differs from sphere to mesh, by receiver and from run to run of the directions: 1.3% at 1024 rays.
RAY_NOISE = 0.02

UNIT_SPHERE = ws.Spheres([[0, 0, 0]], [1.0])

pytestmark = pytest.mark.usefixtures("one_thread", "poisoned_outputs")


def scene_of(method: str = "directional", *, still_blocks: bool = True, size: int = 24, **options) -> ws.Scene:
    """Two balls over a textured ground."""
    balls = [
        ws.Body(ws.icosphere(1.0, 2), albedo=(0.7, 0.5, 0.3), blockers=spheres, translation=place, scale=0.5)
        for spheres, place in ((UNIT_SPHERE, (-0.7, 0.8, 0.4)), (UNIT_SPHERE if still_blocks else 0, (0.6, 0.6, 0)))
    ]
    texture = np.random.default_rng(0).uniform(0.1, 0.9, (8, 8, 3))
    ground = ws.Body(ws.plane(5.0, 16), texture=texture, blockers=0, receivers="vertex")
    sky = ws.synthetic_sky((-0.6, 0.6, 0.3), height=32, sun_radius=8)
    camera = ws.Camera.look_at((0.5, 2.2, 4.6), (0, 0.5, 0), size=(size, size))
    rays = {"samples": 256} if method == "ray-traced" else {}
    visibility = ws.Visibility.of({"method": method, "directions": 32, "order": 4} | rays | options)
    return ws.Scene((*balls, ground), sky, camera, visibility)


def poses_of(renderer: SceneRenderer, shift=(0.0, 0.0, 0.0), requires_grad: bool = False) -> Poses:
    """The scene's, the first body shifted."""
    poses = renderer.scene_poses()
    translations = poses.translations.numpy().copy()
    translations[:, 0] += shift
    moved = wp.array(translations, dtype=wp.vec3, device=renderer.device, requires_grad=requires_grad)
    return Poses(poses.rotations, moved, poses.scales)


def gradient_and_image(
    renderer: SceneRenderer, moving, *, light=None, shift=(0.1, -0.1, 0.2)
) -> tuple[np.ndarray, ...]:
    """Of a weighted sum of the image to translations of all bodies, and the image."""
    poses = poses_of(renderer, shift, requires_grad=True)
    with wp.Tape() as tape:
        image = renderer.draw(light, view=renderer.view(renderer.placed(poses, moving=moving)))
    weights = np.random.default_rng(1).normal(size=(*image.shape, 4)).astype(np.float32)
    tape.backward(grads={image: wp.array(weights, dtype=wp.vec4, device=renderer.device)})
    return poses.translations.grad.numpy()[0], image.numpy()


def free_light(renderer: SceneRenderer, requires_grad: bool = False) -> wp.array:
    values = np.random.default_rng(2).uniform(0.1, 1, (1, renderer.basis.size, 3))
    return wp.array(values, dtype=wp.vec3, device=renderer.device, requires_grad=requires_grad)


def assert_near(got: np.ndarray, expected: np.ndarray, tolerance: float = FLOAT32) -> None:
    assert np.abs(got - expected).max() <= tolerance * np.abs(expected).max()


# ---------------------------------------------------------------------------------------------- views that stand


@pytest.mark.slow
@pytest.mark.parametrize("method", (*METHODS, "ray-traced"))
def test_a_geometry_that_is_given_again_is_not_seen_again(method, monkeypatch):
    renderer, fresh = SceneRenderer(scene_of(method)), SceneRenderer(scene_of(method))
    light = free_light(renderer)
    for _ in range(2):
        geometry = renderer.placed(poses_of(renderer, (0.2, 0.1, 0)))
        view = renderer.view(geometry)
        known, free = renderer.draw(view=view).numpy(), renderer.draw(light, view=view).numpy()
    assert renderer.view(geometry) is view
    view = fresh.view(geometry)
    np.testing.assert_array_equal(known, fresh.draw(view=view).numpy())
    np.testing.assert_array_equal(free, fresh.draw(light, view=view).numpy())
    monkeypatch.setattr(warp_internals, "bound_kernel", None)
    assert renderer.shade(view=renderer.view(geometry)) is renderer.shade(view=renderer.view(geometry))


@pytest.mark.parametrize("method", (*METHODS, "ray-traced"))
def test_known_light_that_is_given_again_is_not_shaded_again(method, monkeypatch):
    renderer = SceneRenderer(scene_of(method))
    coefficients = np.random.default_rng(6).uniform(0.1, 1, (9, 3)).astype(np.float32)
    for light in (ws.synthetic_sky(height=32), coefficients):
        first = renderer.shade(light)
        scenes = renderer.shade()
        np.testing.assert_array_equal(first.numpy(), SceneRenderer(scene_of(method)).shade(light).numpy())
        with monkeypatch.context() as patch:
            patch.setattr(warp_internals, "bound_kernel", None)
            assert renderer.shade(light) is first and renderer.shade() is scenes
    coefficients *= 2
    assert_near(renderer.shade(coefficients).numpy(), 2 * first.numpy())


@pytest.mark.parametrize("name", ["positions", "centers", "radii", "clip_matrices"])
def test_what_is_mutated_in_place_is_seen_anew(name):
    renderer = SceneRenderer(scene_of())
    geometry = renderer.placed(poses_of(renderer))
    clip_matrices = wp.clone(renderer.clip_matrices)
    before = renderer.view(geometry, clip_matrices)
    first = renderer.draw(view=before).numpy().copy()
    array = clip_matrices if name == "clip_matrices" else getattr(geometry, name)
    array.assign(array.numpy() * np.float32(1.25) if name != "clip_matrices" else array.numpy() + np.eye(4) * 0.1)
    after = renderer.view(geometry, clip_matrices)
    image = renderer.draw(view=after).numpy()
    assert after is not before and (image != first).any()
    fresh = SceneRenderer(scene_of())
    np.testing.assert_array_equal(image, fresh.draw(view=fresh.view(geometry, clip_matrices)).numpy())


def test_a_view_is_of_its_geometry_as_it_was():
    """The arrays change before anything is computed from the view."""
    renderer = SceneRenderer(scene_of())
    geometry = renderer.placed(poses_of(renderer, (0.1, 0, 0)))
    expected = renderer.draw(view=renderer.view(geometry)).numpy().copy()
    other = SceneRenderer(scene_of())
    view = other.view(geometry)
    for array in geometry.arrays().values():
        array.zero_()
    np.testing.assert_array_equal(other.draw(view=view).numpy(), expected)


def test_tensors_that_are_mutated_in_place_are_seen_anew():
    renderer = TorchRenderer(scene_of())
    rotations, translations, scales = renderer.scene_poses()
    geometry = renderer.placed(rotations, translations, scales)
    first = renderer(geometry=geometry)
    assert torch.equal(renderer(geometry=geometry), first)
    geometry.positions.mul_(1.1)
    second = renderer(geometry=geometry)
    assert not torch.equal(second, first)
    assert torch.equal(second, TorchRenderer(scene_of())(geometry=geometry))


def test_tensors_that_are_not_written_to_are_known_again_without_a_look_at_them(monkeypatch):
    """As on a GPU, where arrays are not compared."""
    renderer = TorchRenderer(scene_of())
    monkeypatch.setattr(node, "is_readable", lambda device: False)
    geometry = renderer.placed(*renderer.scene_poses())
    seen = []
    for factor in (1.0, None, 1.1):
        if factor is not None:
            geometry.positions.mul_(factor)
        renderer(geometry=geometry)
        seen.append(renderer.array_renderer._views.last[1])
    assert seen[0] is seen[1] and seen[1] is not seen[2]


def test_free_light_over_a_given_geometry_has_the_gradient_that_it_has_over_the_scenes():
    renderer = TorchRenderer(scene_of())
    light = torch.ones(renderer.basis.size, 3, requires_grad=True)
    geometry = renderer.placed(*renderer.scene_poses())
    gradients = []
    for given in (None, geometry, geometry):
        gradients.append(torch.autograd.grad(renderer(light, geometry=given).square().sum(), light)[0])
    assert torch.equal(gradients[0], gradients[1]) and torch.equal(gradients[1], gradients[2])


def test_textures_that_alone_vary_have_the_images_and_gradients_that_they_have_beside_cameras():
    """Alone, radiance is found with what samples reflect, in light that is kept; lights take turns."""
    renderer, random = TorchRenderer(scene_of()), np.random.default_rng(7)
    texture, colors, weights = (
        torch.tensor(random.uniform(size=shape), dtype=torch.float32) for shape in ((8, 8, 3), (162, 3), (24, 24, 4))
    )
    texture.requires_grad_(), colors.requires_grad_()
    cameras = torch.tensor(renderer.array_renderer.clip_matrices.numpy()[0], requires_grad=True)
    coefficients = torch.tensor(free_light(renderer.array_renderer).numpy()[0])
    other = ws.synthetic_sky((0.4, 0.8, 0.1), height=32, sun_radius=8)
    for light in (None, other, None, coefficients, 2 * coefficients, other):
        results = []
        for clip_matrices in (None, cameras):
            given = {"albedo": [None, colors, None], "textures": [None, None, texture], "clip_matrices": clip_matrices}
            image = renderer(light, **given)
            gradients = torch.autograd.grad((image * weights).sum(), [texture, colors])
            results.append([value.detach().numpy() for value in (image, *gradients)])
        for alone, extra_inputs in zip(*results, strict=True):
            assert_near(alone, extra_inputs, 10 * FLOAT32)


# ---------------------------------------------------------------------------------------------- moving bodies


@pytest.mark.parametrize("is_free", [False, True])
@pytest.mark.parametrize("method", METHODS)
def test_bodies_without_blockers_that_stand_still_change_nothing(method, is_free):
    renderer = SceneRenderer(scene_of(method, still_blocks=False))
    light = free_light(renderer) if is_free else None
    for _ in range(2):
        gradient, image = gradient_and_image(renderer, [0], light=light)
    expected_gradient, expected = gradient_and_image(renderer, None, light=light)
    assert_near(image, expected)
    assert_near(gradient[0], expected_gradient[0], 5 * FLOAT32)
    assert not gradient[1:].any()


@pytest.mark.parametrize("is_free", [False, True])
def test_log_sums_of_spheres_that_stand_still_change_nothing(is_free):
    renderer = SceneRenderer(scene_of("log-sh"))
    light = free_light(renderer) if is_free else None
    for _ in range(2):
        gradient, image = gradient_and_image(renderer, [0], light=light)
    expected_gradient, expected = gradient_and_image(renderer, None, light=light)
    assert_near(image, expected, EXPONENTIAL)
    assert_near(gradient[0], expected_gradient[0], EXPONENTIAL)
    assert not gradient[1:].any()


def mesh_of(body: ws.Body) -> wp.Mesh:
    mesh = body.world_mesh()
    return wp.Mesh(wp.array(mesh.positions, dtype=wp.vec3), wp.array(mesh.faces.ravel(), dtype=wp.int32))


def shading_and_truth(renderer: SceneRenderer, light, directions: int) -> list[np.ndarray]:
    """Of the receivers on still bodies, where the moving one is too far away to matter: as rendered, and by rays."""
    view = renderer.view(renderer.placed(poses_of(renderer, (0, 900, 0)), moving=[0]))
    shading = renderer.shade(light, view).numpy()[0, : len(view.receivers.static_vertices)]
    vertices = renderer.geometry().positions.numpy()[0]
    normals = vertex_normals(renderer.geometry().positions, renderer.merged_scene.faces).numpy()[0]
    seen = view.receivers.static_vertices
    points, normals = (wp.array(values[seen], dtype=wp.vec3) for values in (vertices, normals))
    mesh = mesh_of(renderer.scene.bodies[1])
    if light is None:
        truth = trace_shading(mesh, points, normals, sample_map(renderer.scene.light.radiance, directions)).numpy()
    else:
        transfer = trace_transfer(mesh, points, normals, renderer.basis.functions, directions).numpy()
        parts = renderer.basis.functions(fibonacci(directions)).mean(axis=0)  # of the sphere, which are to be the same
        truth = transfer @ (light.numpy()[0] / (len(parts) * parts)[:, None])
    return [shading, truth]


@pytest.mark.slow
@pytest.mark.parametrize("is_free", [False, True])
def test_bodies_that_stand_still_shadow_one_another_as_rays_say(is_free):
    """Under the sun, too: it is much smaller than a cell."""
    renderer = SceneRenderer(scene_of(samples=2048))
    light = free_light(renderer) if is_free else None
    shading, truth = shading_and_truth(renderer, light, 8192)
    assert len(shading) > 200
    assert np.linalg.norm(shading - truth) < RAY_NOISE * np.linalg.norm(truth)
    view = renderer.view(renderer.placed(poses_of(renderer, (0, 900, 0))))  # any body may move
    rows = view.receivers.receiver_of_vertex.numpy()[renderer.view(None).receivers.receiver_of_vertex.numpy() >= -1]
    still = renderer.view(renderer.placed(poses_of(renderer, (0, 900, 0)), moving=[0])).receivers.static_vertices
    by_spheres = renderer.shade(light, view).numpy()[0, rows[still]]
    assert np.linalg.norm(by_spheres - truth) > 3 * np.linalg.norm(shading - truth)


@pytest.mark.parametrize("is_free", [False, True])
@pytest.mark.parametrize("method", ["directional", "log-sh"])
def test_a_shadow_on_bodies_that_stand_still_has_the_gradient_of_central_differences(method, is_free):
    """A weighted sum of the shading of receivers on still bodies, to the translation of the moving one."""
    renderer = SceneRenderer(scene_of(method, samples=64))
    light = free_light(renderer) if is_free else None
    weight_of_vertex = np.random.default_rng(3).uniform(0.5, 1, (len(renderer.merged_scene.body_of_vertex), 3))

    def view_of(poses: Poses) -> View:
        return renderer.view(renderer.placed(poses, moving=[0]))

    def weights_of(view: View) -> np.ndarray:
        weights = np.zeros((1, (view.receivers.receiver_of_vertex.numpy() >= 0).sum(), 3), np.float32)
        vertices = view.receivers.static_vertices
        weights[0, : len(vertices)] = weight_of_vertex[vertices] * np.isin(vertices, always_seen)[:, None]
        return weights

    def loss(shift: np.ndarray) -> float:
        view = view_of(poses_of(renderer, shift))
        return (renderer.shade(light, view).numpy().astype(float) * weights_of(view)).sum()

    step = 4e-3  # at which float32 rounding and curvature are both below the tolerance
    shifts = step * np.concatenate([np.eye(3), -np.eye(3)])
    seen = [view_of(poses_of(renderer, shift)).receivers.static_vertices for shift in shifts]
    always_seen = functools.reduce(np.intersect1d, seen)
    differences = np.array([loss(shift) for shift in shifts])
    poses = poses_of(renderer, requires_grad=True)
    with wp.Tape() as tape:
        view = view_of(poses)
        shading = renderer.shade(light, view)
    tape.backward(grads={shading: wp.array(weights_of(view), dtype=wp.vec3, device=renderer.device)})
    assert_near(poses.translations.grad.numpy()[0, 0], (differences[:3] - differences[3:]) / (2 * step), 1e-2)


@pytest.mark.parametrize("method", METHODS)
def test_instances_share_what_stands_still(method):
    renderer = SceneRenderer(scene_of(method))
    poses = renderer.scene_poses()
    shifts = np.zeros((3, 3, 3))
    shifts[:, 0] = np.random.default_rng(4).normal(size=(3, 3)) * [0.2, 0.1, 0.2]
    translations = poses.translations.numpy() + shifts

    def image_and_gradient(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        count = len(values)
        rotations, scales = (expand(array, count) for array in (poses.rotations, poses.scales))
        moved = wp.array(values, dtype=wp.vec3, device=renderer.device, requires_grad=True)
        with wp.Tape() as tape:
            geometry = renderer.placed(Poses(rotations, moved, scales), moving=[0])
            image = renderer.draw(view=renderer.view(geometry))
        tape.backward(grads={image: wp.full(image.shape, wp.vec4(1.0, 2.0, 3.0, 4.0), dtype=wp.vec4)})
        return image.numpy().copy(), moved.grad.numpy()

    images, gradients = image_and_gradient(translations)
    for number in range(3):
        image, gradient = image_and_gradient(translations[number : number + 1])
        assert_near(images[number], image[0])
        assert_near(gradients[number], gradient[0], 10 * FLOAT32)


@pytest.mark.parametrize("method", METHODS)
def test_cameras_share_what_stands_still(method):
    cameras = [ws.Camera.look_at(eye, (0, 0.5, 0), size=(24, 24)) for eye in ((0.5, 2.2, 4.6), (3, 1.5, -3))]
    renderer = SceneRenderer(scene_of(method, still_blocks=False), cameras=cameras)
    gradient, image = gradient_and_image(renderer, [0])
    expected_gradient, expected = gradient_and_image(renderer, None)
    assert image.shape[0] == 2
    assert_near(image, expected)
    assert_near(gradient[0], expected_gradient[0], 5 * FLOAT32)


@pytest.mark.parametrize("method", METHODS)
def test_samples_that_are_receivers_are_lit_by_everything_that_moves_or_not(method):
    """Bodies that do not move and have no spheres: nothing may change."""
    scene = scene_of(method, still_blocks=False)
    ground = dataclasses.replace(scene.bodies[2], receivers="pixel")
    renderer = SceneRenderer(dataclasses.replace(scene, bodies=(*scene.bodies[:2], ground)))
    gradient, image = gradient_and_image(renderer, [0])
    expected_gradient, expected = gradient_and_image(renderer, None)
    assert_near(image, expected)
    assert_near(gradient[0], expected_gradient[0], 5 * FLOAT32)


# ---------------------------------------------------------------------------------------------- few bands


@pytest.mark.parametrize("method", ["log-sh", "none"])
def test_light_of_few_bands_gives_the_image_that_it_gives_with_all_of_them(method):
    """Free light in a basis of few bands over a pose with a gradient, and known light."""
    few, all_ = (SceneRenderer(scene_of(method), basis=HarmonicBasis(order)) for order in (2, 4))
    values = np.random.default_rng(5).uniform(0.1, 1, (4, 3)).astype(np.float32)
    padded = np.concatenate([values, np.zeros((12, 3), np.float32)])
    light, same = (wp.array(each[None], dtype=wp.vec3) for each in (values, padded))
    gradient, image = gradient_and_image(few, None, light=light)
    expected_gradient, expected = gradient_and_image(all_, None, light=same)
    assert_near(image, expected)
    assert_near(gradient, expected_gradient, 5 * FLOAT32)
    for got, whole in ((values, padded), (light, same)):
        assert_near(few.draw(got).numpy(), all_.draw(whole).numpy())
    assert few.transfer().shape[-1] == 4 and "4 coefficients" in str(few.explain(2 * values))


# ---------------------------------------------------------------------------------------------- what no longer stands


@pytest.mark.slow
@pytest.mark.parametrize("method", ["directional", "log-sh"])
def test_other_bodies_that_move_are_noticed(method):
    renderer = SceneRenderer(scene_of(method))
    for moving in ([0], [1], [0, 1], [2], [], [0]):
        fresh = SceneRenderer(scene_of(method))
        image, expected = (
            each.draw(view=each.view(each.placed(poses_of(each, (0.1, 0, 0)), moving=moving))).numpy()
            for each in (renderer, fresh)
        )
        np.testing.assert_array_equal(image, expected)
    assert_near(image, expected)


@pytest.mark.parametrize("method", METHODS)
def test_bodies_that_stand_elsewhere_are_noticed(method):
    """A geometry that was not placed, in which what is said not to move is somewhere else."""
    renderer, fresh = SceneRenderer(scene_of(method)), SceneRenderer(scene_of(method))
    image = renderer.draw(view=renderer.view(renderer.placed(moving=[0]))).numpy().copy()
    poses = renderer.scene_poses()
    shift = wp.array(poses.translations.numpy() + np.array([[[0, 0, 0], [0.3, 0.1, 0.2], [0, 0, 0]]]), dtype=wp.vec3)
    elsewhere = dataclasses.replace(renderer.placed(Poses(poses.rotations, shift, poses.scales)), moving=[0])
    moved = renderer.draw(view=renderer.view(elsewhere)).numpy()
    assert (moved != image).any()
    np.testing.assert_array_equal(moved, fresh.draw(view=fresh.view(elsewhere)).numpy())


@pytest.mark.parametrize("method", METHODS)
def test_another_camera_sees_what_stands_still_anew(method):
    """It shows vertices that the first did not, and shows all of them elsewhere."""
    renderer = SceneRenderer(scene_of(method))
    images = []
    for camera in (renderer.scene.camera, ws.Camera.look_at((-3, 1.0, -3.6), (0.4, 0.3, 0), size=(24, 24))):
        clip_matrices = wp.array(camera.clip_matrix()[None], dtype=wp.mat44)
        fresh = SceneRenderer(scene_of(method))
        image, expected = (
            each.draw(view=each.view(each.placed(poses_of(each, (0.1, 0, 0)), moving=[0]), clip_matrices)).numpy()
            for each in (renderer, fresh)
        )
        assert_near(image, expected)
        images.append(image)
    assert (images[0] != images[1]).any()


def test_instances_that_differ_in_what_stands_still_are_refused():
    renderer = SceneRenderer(scene_of("none"))
    positions, centers, radii = renderer.geometry().arrays().values()
    two = wp.array(positions.numpy() * np.array([1, 1.1])[:, None, None], dtype=wp.vec3)
    with pytest.raises(ValueError, match=r"geometry: got instances that differ in more than the bodies \(0,\)"):
        renderer.view(Geometry(two, centers, radii, moving=[0]))


def test_a_body_that_moves_is_one_of_the_scenes():
    renderer = SceneRenderer(scene_of("none"))
    with pytest.raises(ValueError, match="moving: got 3, expected the number of a body, from 0 to 2"):
        renderer.placed(moving=[3])


def test_what_is_deformed_moves():
    renderer = TorchRenderer(scene_of())
    points = torch.tensor(renderer.scene.bodies[1].mesh.positions)[None] * 1.1
    rest = renderer.deformed(1, points)
    assert rest.moving == (1,)
    poses = renderer.scene_poses()
    assert renderer.placed(*poses, rest=rest, moving=[0]).moving == (0, 1)
    assert renderer.placed(*poses, rest=rest).moving is None
    whole = renderer.placed(*poses, rest=rest)
    for name, part in renderer.placed(*poses, rest=rest, moving=[0]).arrays().items():
        expected = getattr(whole, name)
        assert torch.equal(part, expected)


# ---------------------------------------------------------------------------------------------- what is launched

VISIBILITY = "visibility"
SHADOWS = ("static shadows", VISIBILITY)


def stage_of(kernel: wp.Kernel, inputs: list) -> str | None:
    """The stage that a kernel with some inputs belongs to; None for copies, poses and corners, which come before."""
    module, key = kernel.func.__module__.removeprefix("warpshadow."), kernel.key
    if module in ("device.batch", "stages.geometry.poses", "stages.self_visibility.probes", "stages.sparse"):
        return None
    if module in (
        "stages.self_visibility.trace",
        "stages.self_visibility.lookup",
        "stages.self_visibility.self_transfer",
    ):
        return "self-shadows"
    of_visibility = "stages.visibility", "stages.self_visibility.gather", "stages.rays.ray_tracing"
    if module.startswith(of_visibility) or key == "_add_cached_rows":
        return VISIBILITY
    if module.startswith("stages.silhouettes"):
        after = {"_find_edge_colors": "radiance", "blend": "smoothing"}
        return next((name for part, name in after.items() if part in key), "silhouettes")
    if module.startswith("stages.textures"):
        if "_sample" in key:  # given the samples of white surfaces, it exposes them
            has_samples = any(getattr(each, "dtype", None) is wp.vec4 for each in inputs) and "coordinates" not in key
            return "radiance" if has_samples else "reflectance"
        return "footprints" if "footprints" in key else "mip pyramids"
    if module == "stages.raster.interpolation":
        return "reflectance"
    if module in ("stages.raster.rasterization", "stages.raster.barycentrics"):
        return "rasterization"
    if module in ("stages.light.transfer", "stages.light.cached_cells"):
        return "shading" if "_shade_cells" in key else "transfer"
    if module == "stages.image.film":
        return "averaging" if "average" in key else "radiance"
    if module.startswith("stages.receivers.") or module == "device.capacities":
        return "receivers"
    return {
        "stages.geometry.normals": "normals",
        "stages.raster.project": "clip positions",
        "stages.raster.sides": "sides",
        "stages.light.shading": "shading",
        "stages.image.outlines": "radiance",
        "stages.image.slopes": "radiance",
    }[module]


class Launches:
    """Counts launches by stage, those of a call and those of its adjoint."""

    def __init__(self, monkeypatch):
        self.counts: Counter = Counter()
        bound_kernel = warp_internals.bound_kernel

        def counted(kernel, arguments, device, **options):
            self.counts[stage_of(kernel, arguments)] += 1
            return bound_kernel(kernel, arguments, device, **options)

        monkeypatch.setattr(warp_internals, "bound_kernel", counted)

    def of(self, call, variables) -> tuple[set, set]:
        """Stages that a call launches, and those of its adjoint, which is asked for gradients to variables."""
        results = []
        for variable in variables:
            variable.grad.zero_()
        with wp.Tape() as tape:
            self.counts.clear()
            image = call()
            results.append({name for name in self.counts if name})
        self.counts.clear()
        if image.requires_grad:
            tape.backward(grads={image: wp.full(image.shape, wp.vec4(1.0), dtype=wp.vec4, device=image.device)})
        return results[0], {name for name in self.counts if name}


def said(explanation) -> tuple[set, set]:
    """Stages that are said to run, and to be played back; all shadows as one."""
    stages = explanation.stages.values()
    return tuple(
        {VISIBILITY if stage.name in SHADOWS else stage.name for stage in stages if getattr(stage, way)}
        for way in ("forward", "backward")
    )


def texture_fit(renderer):
    texture = wp.array(np.full((1, 8, 8, 3), 0.5), dtype=wp.vec3, device=renderer.device, requires_grad=True)
    given = {"textures": [None, None, texture]}
    return lambda: renderer.draw(**given), [texture], lambda: renderer.explain(**given)


def light_fit(renderer):
    light = free_light(renderer, requires_grad=True)
    return lambda: renderer.draw(light), [light], lambda: renderer.explain(light)


def still_image(renderer):
    return renderer.draw, [], renderer.explain


def pose_fit(renderer, moving=None, **given):
    poses = poses_of(renderer, (0.1, 0, 0), requires_grad=True)

    def geometry():
        return renderer.placed(poses, moving=moving)

    return (
        lambda: renderer.draw(view=renderer.view(geometry()), **given),
        [poses.translations],
        lambda: renderer.explain(geometry=geometry(), **given),
    )


def one_of_three(renderer):
    return pose_fit(renderer, [0])


def light_over_one_of_three(renderer):
    return pose_fit(renderer, [0], light=free_light(renderer))


def radii_fit(renderer):
    positions, centers, radii = renderer.geometry().arrays().values()
    radii = wp.clone(radii, requires_grad=True) if radii.size else radii
    geometry = Geometry(positions, centers, radii)
    variables = [radii] if radii.size else []
    return (lambda: renderer.draw(view=renderer.view(geometry)), variables, lambda: renderer.explain(geometry=geometry))


def camera_fit(renderer):
    matrices = wp.clone(renderer.clip_matrices, requires_grad=True)
    return (
        lambda: renderer.draw(view=renderer.view(None, matrices)),
        [matrices],
        lambda: renderer.explain(clip_matrices=matrices),
    )


FITS = [texture_fit, light_fit, still_image, pose_fit, one_of_three, light_over_one_of_three, radii_fit, camera_fit]


@pytest.mark.slow
@pytest.mark.parametrize("blocks", [True, False])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("fit", FITS)
def test_what_is_said_to_run_runs_and_what_is_said_to_be_left_out_is_left_out(fit, method, blocks, monkeypatch):
    scene = scene_of(method)
    if not blocks:
        scene = dataclasses.replace(scene, bodies=[dataclasses.replace(body, blockers=0) for body in scene.bodies])
    call, variables, explain = fit(SceneRenderer(scene))
    launches = Launches(monkeypatch)
    for _ in range(3):  # the first call finds out what the others keep
        explanation = explain()
        assert launches.of(call, variables) == said(explanation)
    if not blocks or method == "none":
        assert not any(explanation[name] for name in SHADOWS)


def test_only_what_moves_is_projected_onto_what_stands_still(monkeypatch):
    """Pairs of receivers and spheres, forward; and the adjoint asks for no gradient to points that stand.

    The body that moves has its shadow on itself from rays, so that only the other's sphere blocks its light.
    """
    renderer = SceneRenderer(scene_of())
    call, _, explain = one_of_three(renderer)
    call()
    asked = []
    transmittance = directional.transmittance

    def recorded(points, normals, centers, radii, directions, **options):
        ((first, end),) = options["skips"] or ((0, 0),)
        asked.append((points.shape[1], radii.shape[1] - (end - first), points.requires_grad, len(directions)))
        return transmittance(points, normals, centers, radii, directions, **options)

    monkeypatch.setattr(directional, "transmittance", recorded)
    call()
    on_still, sun_on_still, on_moving, sun_on_moving = asked
    assert on_still[1:] == (1, False, 32) and on_moving[1:] == (1, True, 32)
    assert sun_on_still == (*on_still[:3], CHUNK) and sun_on_moving == (*on_moving[:3], CHUNK)  # its cells again
    vertex_count = len(renderer.merged_scene.body_of_vertex)
    assert 0 < on_still[0] < vertex_count - 162 and 0 < on_moving[0] <= 162
    items = explain()["visibility"].items
    assert "receivers × up to 2 spheres" in items and "receivers on static bodies × up to 1 spheres" in items


def test_rays_are_traced_once(monkeypatch):
    renderer = SceneRenderer(scene_of())
    call, _, explain = one_of_three(renderer)
    assert explain()["static shadows"]
    call()
    monkeypatch.setattr(directional_method, "trace_cells", None)
    call()
    assert "not seen before" in explain()["static shadows"].items


# ---------------------------------------------------------------------------------------------- what is said


def test_the_explanation_is_a_table_of_stages_with_times_and_reasons():
    renderer = SceneRenderer(scene_of())
    call, variables, explain = texture_fit(renderer)
    assert "nothing is cached yet" in str(explain())
    with wp.Tape() as tape:
        image = call()
    tape.backward(grads={image: wp.full(image.shape, wp.vec4(1.0), dtype=wp.vec4)})
    lines = str(explain()).splitlines()
    assert [line.split()[0] for line in (lines[0], lines[19])] == ["forward", "backward"]
    (rasterization,) = (line for line in lines[:19] if "rasterization" in line)
    assert "–" in rasterization and "cached: vertices and cameras are the same" in rasterization
    (radiance,) = (line for line in lines[19:] if "radiance" in line)
    assert "runs" in radiance and " ms" in radiance and "a gradient to textures is asked for" in radiance
    assert "2,304 samples" in radiance
    assert "backward" not in str(SceneRenderer(scene_of()).explain())


def test_an_explanation_computes_nothing(monkeypatch):
    """Not even the spheres of bodies, which take seconds to fit; the ground blocks as a plane."""
    scene = scene_of()
    scene = dataclasses.replace(scene, bodies=[dataclasses.replace(body, blockers=7) for body in scene.bodies])
    renderer = SceneRenderer(scene)
    monkeypatch.setattr(merged_scene, "fit_scene_spheres", None)
    monkeypatch.setattr(warp_internals, "bound_kernel", None)
    assert "up to 902 receivers × up to 14 spheres" in str(renderer.explain())


def test_tensors_explain_themselves():
    renderer = TorchRenderer(scene_of())
    rotations, translations, scales = renderer.scene_poses()
    geometry = renderer.placed(rotations, translations.requires_grad_(), scales, moving=[1])
    explanation = renderer.explain(geometry=geometry)
    assert explanation["visibility"].backward and "a gradient to vertices" in explanation["normals"].forward.why
    light = torch.ones(32, 3, requires_grad=True)
    colors = torch.ones(3), torch.ones(162, 3, requires_grad=True), None
    explanation = renderer.explain(light, albedo=colors, textures=[None, None, torch.ones(4, 4, 3)])
    assert explanation["shading"].backward.why == "a gradient to light is asked for"
    assert explanation["reflectance"].backward.why == "a gradient to albedo is asked for"
    assert not explanation["mip pyramids"].backward
    matrix = torch.tensor(renderer.scene.camera.clip_matrix(), dtype=torch.float32, requires_grad=True)
    assert renderer.explain(clip_matrices=matrix)["clip positions"].backward
    assert not renderer.explain(clip_matrices=matrix)["visibility"].backward
