"""Problems, targets and losses: what counts, what does not, and what is refused."""

import dataclasses
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import warpshadow as ws
from warpshadow.assets.color import srgb_to_linear
from warpshadow.inverse import (
    Albedo,
    CameraPose,
    Deformation,
    Exposure,
    Light,
    Loss,
    Pose,
    Problem,
    Radii,
    Target,
    Texture,
)
from warpshadow.inverse.target import stack_targets

CPU = torch.device("cpu")
CODES = 3 * np.arange(60, dtype=np.float32).reshape(4, 5, 3)


def small_scene(*, size: tuple[int, int] = (24, 24), **visibility) -> ws.Scene:
    ball = ws.Body(
        ws.icosphere(1.0, 1),
        albedo=(0.7, 0.5, 0.3),
        blockers=ws.Spheres([[-0.4, 0, 0], [0.4, 0, 0]], [0.8, 0.7]),
        translation=(0, 1, 0),
    )
    ground = ws.Body(ws.plane(8.0, 16), blockers=0)
    camera = ws.Camera.look_at((0, 2.5, 5), (0, 0.6, 0), size=size)
    light = np.zeros((4, 3))
    light[:2] = [[3, 3, 3], [1, 1, 0.5]]
    return ws.Scene((ball, ground), light, camera, ws.Visibility.of({"directions": 64} | visibility), supersampling=1)


def noise(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.1, 1, shape).astype(np.float32)


# ---------------------------------------------------------------------------------------------- targets


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"image": np.zeros((4, 5))}, r"image: got shape \(4, 5\)"),
        ({"image": np.zeros((4, 5, 2))}, "image: got shape"),
        ({"image": np.zeros((4, 5, 3), np.uint8)}, r"image: got values of uint8, .*srgb_to_linear\(values / 255\)"),
        ({"image": np.zeros((4, 5, 3), np.int64)}, "image: got values of int64"),
        ({"image": np.zeros((4, 5, 3), bool)}, "image: got ndarray of bool"),
        ({"image": np.zeros((3, 4, 5))}, r"image: got shape \(3, 4, 5\), .*: channels come last"),
        ({"image": None}, "image: got None, expected linear RGB"),
        ({"image": CODES}, r"image: got whole numbers up to 177, .*srgb_to_linear\(values / 255\)"),
        ({"image": torch.tensor(CODES)}, r"image: got whole numbers up to 177, .*srgb_to_linear\(values / 255\)"),
        ({"mask": np.full((4, 5), 255, np.uint8)}, "mask: got values from 255 to 255, .*mask / 255"),
        ({"mask": "x"}, "mask: no such file: x"),
        ({"camera": "front"}, "camera: got 'front', expected a Camera"),
        ({"image": np.zeros((0, 5, 3))}, "image: got shape"),
        ({"image": np.full((4, 5, 3), np.nan)}, "image: got 60 NaN"),
        ({"mask": np.ones((5, 4))}, r"mask: got shape \(5, 4\)"),
        ({"mask": np.full((4, 5), 1.5)}, "mask: got values from 1.5"),
        ({"mask": np.full((4, 5), -0.5)}, "mask: got values from -0.5"),
        ({"mask": np.zeros((4, 5))}, "mask: got values from 0"),
        ({"mask": np.full((4, 5), np.nan)}, "mask: got 20 NaN"),
        ({"camera": ws.Camera.look_at((0, 0, 1), (0, 0, 0), size=(4, 5))}, "image: got 5 × 4 pixels, .* 4 × 5"),
    ],
)
def test_a_target_names_what_is_wrong_with_it(options, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        Target(**{"image": np.zeros((4, 5, 3))} | options)


def test_a_target_reads_files_as_fit_files_do(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    straight, alpha = np.full((2, 4, 3), 0.5, np.float32), np.full((2, 4, 1), 0.5, np.float32)
    ws.write_image("photo.png", ws.Picture(np.concatenate([alpha * straight, alpha], axis=2), exposure=0))
    ws.write_image("mask.png", srgb_to_linear(np.full((2, 4), 0.25, np.float32)))
    target = Target("photo.png", Path("mask.png"))
    eight_bits = 0.006  # half a step of sRGB where it is steepest
    np.testing.assert_allclose(target.image[..., :3], 0.25, atol=eight_bits)  # premultiplied
    np.testing.assert_allclose(target.image[..., 3], 0.5, atol=eight_bits)
    np.testing.assert_allclose(target.weights(), 0.25, atol=eight_bits)  # as it is stored


def test_a_mask_may_be_of_truth_values():
    mask = np.arange(20).reshape(4, 5) % 2 == 0
    np.testing.assert_array_equal(Target(np.ones((4, 5, 3)), mask).weights(), mask.astype(np.float32))


def test_what_is_masked_out_may_be_anything():
    mask = np.ones((4, 6))
    mask[:, 3:] = 0
    image = noise(4, 6, 3)
    broken = image.copy()
    broken[:, 3:] = [np.nan, np.inf, -1e30]
    assert np.array_equal(Target(broken, mask).image, Target(np.where(mask[..., None], image, 0)).image)


def test_coarse_images_are_means_of_what_counts_and_coarse_weights_how_much_that_is():
    image, mask = noise(6, 8, 3), np.random.default_rng(1).uniform(0, 1, (6, 8)) ** 2
    mask[:4, :4] = 0  # a coarse pixel without any
    images, weights, _ = stack_targets([Target(image, mask)], 0.5, CPU)
    blocks = (image * mask[..., None]).reshape(3, 2, 4, 2, 3).sum(axis=(1, 3))
    sums = mask.reshape(3, 2, 4, 2).sum(axis=(1, 3))
    assert np.allclose(weights[0].numpy(), sums / 4, atol=1e-6)
    counts = sums > 0
    assert np.allclose(images[0].numpy()[counts], (blocks / np.where(counts, sums, 1)[..., None])[counts], atol=1e-5)
    assert not images[0].numpy()[~counts].any()


@pytest.mark.parametrize("scale", [0.5, 0.3, 0.01])
def test_coarse_pixels_count_what_they_overlap_by_its_area(scale):
    image = noise(7, 10, 3)
    images, weights, _ = stack_targets([Target(image)], scale, CPU)
    height, width = max(1, round(7 * scale)), max(1, round(10 * scale))
    finer = np.repeat(np.repeat(image, height, axis=0), width, axis=1)  # of which coarse pixels are whole parts
    expected = finer.reshape(height, 7, width, 10, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(images[0].numpy(), expected, atol=1e-6)
    np.testing.assert_allclose(weights[0].numpy(), 1, atol=1e-6)


@pytest.mark.parametrize("scale", [1.0, 0.5, 0.25])
def test_masked_pixels_have_no_influence_whatever_is_in_them(scale):
    mask = noise(8, 8, seed=3).round()
    image, rendered = noise(8, 8, 4), torch.from_numpy(noise(1, int(8 * scale), int(8 * scale), 4, seed=2))
    other = np.where(mask[..., None] > 0, image, 1e6 * noise(8, 8, 4, seed=4))
    losses = []
    for pixels in (image, other):
        leaf = rendered.clone().requires_grad_()
        loss = Loss("huber")(leaf, *stack_targets([Target(pixels, mask)], scale, CPU)[:2], 1.0)
        loss.backward()
        losses.append((loss.item(), leaf.grad))
    assert losses[0][0] == losses[1][0] and torch.equal(losses[0][1], losses[1][1])
    assert losses[0][0] > 0


def test_the_unit_is_the_root_mean_square_of_what_counts():
    scene = small_scene()
    image, mask = noise(24, 24, 4), noise(24, 24, seed=1)
    context = Problem(scene, Target(image, mask), Exposure()).context(CPU)
    color = image[..., :3].astype(np.float64)
    assert context.unit == pytest.approx(np.sqrt((mask[..., None] * color**2).sum() / (3 * mask.sum())))
    assert Problem(scene, Target(np.zeros((24, 24, 3))), Exposure()).context(CPU).unit == 1


def test_arrays_are_targets_as_they_are():
    scene = small_scene()
    image = np.full((24, 24, 3), 0.5, np.float32)
    for targets in (image, [image], [Target(image)], torch.tensor(image)):
        (target,) = Problem(scene, targets, Exposure()).targets
        np.testing.assert_array_equal(target.image, image)
    with pytest.raises(ValueError, match=r"^targets\[0\]: image: got shape"):
        Problem(scene, [image[..., 0]], Exposure())


def test_cameras_that_see_no_body_are_refused_where_nothing_moves():
    scene, image = small_scene(), np.full((24, 24, 3), 0.5, np.float32)
    away = Target(image, camera=ws.Camera.look_at((0, 1, 5), (0, 1, 10), size=(24, 24)))
    with pytest.raises(ValueError, match="^targets: got cameras that see no body, expected one that does"):
        Problem(scene, [away, away], Light(2))
    assert Problem(scene, [away, Target(image)], Light(2)) and Problem(scene, away, CameraPose())


# ---------------------------------------------------------------------------------------------- losses


def cost(kind: str, difference: np.ndarray, delta: float) -> np.ndarray:
    """Of one number, from the definitions."""
    size = np.abs(difference)
    if kind == "huber":
        return np.where(size < delta, size**2 / 2, delta * (size - delta / 2))
    return size**2 if kind == "l2" else size


@pytest.mark.parametrize("reduction", ["mean", "sum"])
@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("kind", ["l2", "l1", "huber"])
def test_a_loss_is_its_definition(kind, channels, reduction):
    images, targets = noise(2, 3, 5, 4), noise(2, 3, 5, channels, seed=1)
    weights, unit = noise(2, 3, 5, seed=2), 0.7
    loss = Loss(kind, delta=0.3, coverage=0.25, reduction=reduction)
    got = loss(torch.from_numpy(images), torch.from_numpy(targets), torch.from_numpy(weights), unit)
    each = cost(kind, (images[..., :3] - targets[..., :3]) / unit, 0.3).sum(axis=-1)
    if channels == 4:
        each = each + 0.25 * cost(kind, images[..., 3] - targets[..., 3], 0.3)
    total = (weights * each).sum()
    assert float(got) == pytest.approx(total / weights.sum() if reduction == "mean" else total, rel=1e-5)


@pytest.mark.parametrize("kind", ["l2", "l1", "huber"])
def test_the_gradient_of_a_loss_is_its_derivative_and_finite_where_images_agree(kind):
    images = torch.from_numpy(noise(1, 3, 4, 4)).double().requires_grad_()
    targets, weights = torch.from_numpy(noise(1, 3, 4, 4, seed=1)).double(), torch.ones(1, 3, 4).double()
    assert torch.autograd.gradcheck(lambda leaf: Loss(kind)(leaf, targets, weights, 0.8), images)
    same = targets.clone().requires_grad_()
    Loss(kind)(same, targets, weights, 0.8).backward()
    assert not same.grad.any()


def test_coverage_counts_only_where_a_target_has_it_and_as_much_as_it_is_wanted():
    images, targets = torch.from_numpy(noise(1, 3, 4, 4)), torch.from_numpy(noise(1, 3, 4, 4, seed=1))
    weights = torch.ones(1, 3, 4)
    without = float(Loss()(images, targets[..., :3], weights, 1.0))
    assert float(Loss(coverage=0)(images, targets, weights, 1.0)) == without
    one, two = (float(Loss(coverage=weight)(images, targets, weights, 1.0)) - without for weight in (1, 2))
    assert one > 0 and two == pytest.approx(2 * one, rel=1e-4)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kind": "l3"}, "kind: got 'l3'.*did you mean"),
        ({"reduction": "median"}, "reduction: got 'median'"),
        ({"delta": 0}, "delta: got 0"),
        ({"delta": math.nan}, "delta: got nan"),
        ({"delta": math.inf}, "delta: got inf"),
        ({"coverage": -1}, "coverage: got -1"),
        ({"coverage": math.nan}, "coverage: got nan"),
        ({"coverage": math.inf}, "coverage: got inf"),
    ],
)
def test_a_loss_names_what_is_wrong_with_it(options, message):
    with pytest.raises(ValueError, match=message):
        Loss(**options)


# ---------------------------------------------------------------------------------------------- free parameters


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Light(5, 64), "order, directions: got 5 and 64"),
        (lambda: Light(0), "order: got 0"),
        (lambda: Light(99), "order: got 99"),
        (lambda: Light(None, 50), "directions: got 50"),
        (lambda: Light(nonnegativity=-1), "nonnegativity: got -1"),
        (lambda: Light(nonnegativity=math.nan), "nonnegativity: got nan"),
        (lambda: Texture(1, smoothness=math.inf), "smoothness: got inf"),
        (lambda: Texture(1, total_variation=-1), "total_variation: got -1"),
        (lambda: Texture(1, palette=math.nan), "palette: got nan"),
        (lambda: Texture(1, palette=1, colors=1), "colors: got 1"),
        (lambda: Texture(1, size=(0, 4)), r"size: got \(0, 4\)"),
        (lambda: Texture(1, size=(4.0, 4)), r"size: got \(4.0, 4\)"),
        (lambda: Texture(1, size=8), "size: got 8, expected height and width in whole texels"),
        (lambda: Pose(0, "euler"), "rotation: got 'euler'"),
        (lambda: Deformation(0, rigidity=-1), "rigidity: got -1"),
        (lambda: Deformation(0, count=0), "count: got 0"),
        (lambda: Radii(0, persistence=-1), "persistence: got -1"),
    ],
)
def test_a_free_parameter_names_what_is_wrong_with_it(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("free", "message"),
    [
        (Albedo(2), "body: got 2, expected the number of a body, from 0 to 1"),
        (Pose(7), "body: got 7, expected the number of a body, from 0 to 1"),
        (Texture(0), "body: got 0, whose mesh has no uvs"),
        (Radii(1), "body: got 1, which has no spheres"),
        (Deformation(0), "count: got 4 for 2 nodes"),
    ],
)
def test_what_the_scene_does_not_have_cannot_be_free(free, message):
    with pytest.raises(ValueError, match=rf"free\[1\]: {message}"):
        Problem(small_scene(), Target(noise(24, 24, 3)), [Light(), free])


@pytest.mark.parametrize("make", [Albedo, Texture, Pose, Deformation, Radii])
@pytest.mark.parametrize("body", [-1, 0.0, 1.5, True, b"bunny", None])
def test_what_is_no_number_of_a_body_is_refused_by_whatever_is_free_of_one(make, body):
    with pytest.raises(ValueError, match=f"body: got {body!r}, expected the number of a body, from 0"):
        make(body)


def test_the_albedo_of_a_body_with_a_texture_is_refused():
    scene = small_scene()
    ball, ground = scene.bodies
    scene = dataclasses.replace(scene, bodies=(ball, dataclasses.replace(ground, texture=noise(4, 4, 3))))
    with pytest.raises(ValueError, match="which has a texture"):
        Problem(scene, Target(noise(24, 24, 3)), Albedo(1))


@pytest.mark.parametrize("free", [Albedo(1), Texture(1, (2, 2))])
def test_one_color_starts_as_the_mean_of_the_colors_of_vertices(free):
    scene = small_scene()
    ball, ground = scene.bodies
    colors = noise(ground.mesh.vertex_count, 3)
    scene = dataclasses.replace(scene, bodies=(ball, dataclasses.replace(ground, albedo=colors)))
    problem = Problem(scene, Target(noise(24, 24, 3)), free)
    (start,) = free.start(problem.context(torch.device("cpu"))).values()
    np.testing.assert_allclose(start, np.broadcast_to(colors.mean(axis=0), start.shape), rtol=1e-5)


def test_spheres_that_the_method_does_not_use_cannot_be_free():
    scene = small_scene(method="none")
    with pytest.raises(ValueError, match="body: got 0, which has no spheres"):
        Problem(scene, Target(noise(24, 24, 3)), Radii(0))


# ---------------------------------------------------------------------------------------------- problems


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"targets": []}, "targets: got none"),
        ({"free": []}, "free: got none"),
        ({"scene": "scene.toml"}, r"scene: got 'scene.toml', expected a Scene; load_scene\(path\)"),
        ({"loss": "huber"}, r"loss: got 'huber', expected a Loss, such as Loss\('huber'\)"),
        ({"still": "none"}, "still: got 'none', expected a Visibility"),
        ({"free": "light"}, r"free\[0\]: got 'light', expected a free parameter"),
        ({"free": [Light(), "pose"]}, r"free\[1\]: got 'pose', expected a free parameter"),
        ({"free": Light}, r"free\[0\]: got the class Light, expected a free parameter, such as Pose\(0\) or Light\(\)"),
        ({"free": [Light(), Albedo(1), Texture(1)]}, r"free: got albedo\[1\] and texture\[1\], expected one"),
        ({"targets": [3.0]}, r"targets\[0\]: got 3.0, expected a Target, as Target\(image\) makes it, or an image"),
        ({"free": [Pose(0), Light(), Pose(0, "6d")]}, r"free: got pose\[0\] twice"),
        ({"free": [Light(), Light(None, 64)]}, "free: got light twice"),
        ({"targets": [Target(noise(24, 24, 3)), Target(noise(24, 24, 4))]}, "targets: got images of shapes"),
        ({"targets": [Target(noise(24, 24, 3)), Target(noise(12, 12, 3))]}, "targets: got images of shapes"),
        ({"targets": Target(noise(24, 20, 3))}, "targets: got an image of 20 × 24 pixels.* 24 × 24"),
    ],
)
def test_a_problem_names_what_is_wrong_with_it(options, message):
    with pytest.raises(ValueError, match=message):
        Problem(**{"scene": small_scene(), "targets": Target(noise(24, 24, 3)), "free": Light()} | options)


@pytest.mark.parametrize("free", [Pose(0), Deformation(0), Radii(0), CameraPose()])
def test_geometry_that_rays_would_have_to_differentiate_cannot_be_free(free):
    with pytest.raises(ValueError, match='scene: got visibility.method = "ray-traced" with free geometry'):
        Problem(small_scene(method="ray-traced"), Target(noise(24, 24, 3)), free)


def test_one_target_and_one_free_parameter_need_no_list():
    problem = Problem(small_scene(), Target(noise(24, 24, 3)), Light())
    assert len(problem.targets) == 1 and problem.free == (Light(),)


@pytest.mark.parametrize(("size", "smaller"), [(24, 12), (22, 15), (49, 7)])
def test_the_scenes_camera_becomes_as_large_as_the_image(size, smaller):
    """Of any size, though 22 · (15 / 22) is not 15 in floating point."""
    scene = small_scene(size=(size, size))
    (camera,) = Problem(scene, Target(noise(smaller, smaller, 3)), Light()).cameras()
    assert (camera.width, camera.height) == (smaller, smaller)
    points = np.random.default_rng(0).normal(size=(10, 3))
    assert np.allclose(camera.project(points), scene.camera.project(points) * (smaller / size))


def test_visibility_is_by_rays_where_all_stands_still_and_by_the_scenes_method_where_not():
    scene, target = small_scene(), Target(noise(24, 24, 3))
    methods = {
        "ray-traced": Problem(scene, target, [Light(), Albedo(0), Texture(1), Exposure()]),
        "directional": Problem(scene, target, [Light(), Pose(0)]),
        "log-sh": Problem(small_scene(method="log-sh"), target, [Light()], still=None),
    }
    for method, problem in methods.items():
        assert problem.context(CPU).scene.visibility.method == method


# ---------------------------------------------------------------------------------------------- fingerprints


def changed(scene: ws.Scene, number: int, **changes) -> ws.Scene:
    bodies = list(scene.bodies)
    bodies[number] = dataclasses.replace(bodies[number], **changes)
    return dataclasses.replace(scene, bodies=tuple(bodies))


def variations() -> dict[str, Problem]:
    """Problems of which each differs from the first in one thing that its result depends on."""
    scene, image = small_scene(), noise(24, 24, 4)
    bare = scene.bodies[0].mesh
    wrapped = dataclasses.replace(bare, uvs=np.zeros((1, 2)), uv_faces=np.zeros_like(bare.faces))
    scene = changed(scene, 0, mesh=wrapped)  # so that either body may have a texture
    problem = Problem(scene, Target(image), [Light(3), Texture(1, size=(1, 23))])
    ball = scene.bodies[0]
    brighter, positions, centers = image.copy(), ball.mesh.positions.copy(), ball.blockers.centers.copy()
    brighter[7, 5, 1] = np.nextafter(image[7, 5, 1], 2)
    positions[3, 0] += 1e-6
    centers[1, 2] += 1e-6
    mask = np.ones((24, 24))
    mask[0, 0] = 0.5
    mesh = dataclasses.replace(ball.mesh, positions=positions)
    scenes = {
        "pose": changed(scene, 0, translation=(1e-9, 1, 0)),
        "rotation": changed(scene, 0, rotation=(0, 0, 1e-9)),
        "scale": changed(scene, 0, scale=1 + 1e-9),
        "albedo": changed(scene, 1, albedo=(0.8, 0.8, 0.81)),
        "receivers": changed(scene, 1, receivers="pixel"),
        "a vertex": changed(scene, 0, mesh=mesh),
        "a sphere": changed(scene, 0, blockers=ws.Spheres(centers, ball.blockers.radii)),
        "number of spheres": changed(scene, 0, blockers=2),
        "light": dataclasses.replace(scene, light=scene.light * 1.001),
        "kind of light": dataclasses.replace(scene, light=ws.EnvironmentMap.constant(1)),
        "softness": dataclasses.replace(scene, visibility=ws.Visibility(directions=64, softness=0.5)),
        "supersampling": dataclasses.replace(scene, supersampling=2),
        "camera": dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, near=0.02)),
        "order of bodies": dataclasses.replace(scene, bodies=scene.bodies[::-1]),
    }
    return {
        "itself": problem,
        **{name: dataclasses.replace(problem, scene=other) for name, other in scenes.items()},
        "a pixel": dataclasses.replace(problem, targets=Target(brighter)),
        "no coverage": dataclasses.replace(problem, targets=Target(image[..., :3])),
        "mask": dataclasses.replace(problem, targets=Target(image, mask)),
        "camera of the target": dataclasses.replace(problem, targets=Target(image, camera=scene.camera)),
        "two views": dataclasses.replace(problem, targets=[Target(image)] * 2),
        "order of light": dataclasses.replace(problem, free=[Light(4), Texture(1, size=(1, 23))]),
        "cells of light": dataclasses.replace(problem, free=[Light(None, 64), Texture(1, size=(1, 23))]),
        "weight": dataclasses.replace(problem, free=[Light(3, nonnegativity=1e-9), Texture(1, size=(1, 23))]),
        "size": dataclasses.replace(problem, free=[Light(3), Texture(1, size=(12, 3))]),
        "body": dataclasses.replace(problem, free=[Light(3), Texture(0, size=(1, 23))]),
        "order of free": dataclasses.replace(problem, free=[Texture(1, size=(1, 23)), Light(3)]),
        "loss": dataclasses.replace(problem, loss=Loss("l1")),
        "delta": dataclasses.replace(problem, loss=Loss(delta=0.2)),
        "still": dataclasses.replace(problem, still=None),
        "samples": dataclasses.replace(problem, still=ws.Visibility("ray-traced", samples=64)),
    }


def test_fingerprints_differ_where_anything_does_that_a_result_depends_on():
    problems = variations()
    prints = {name: problem.fingerprint() for name, problem in problems.items()}
    assert len(set(prints.values())) == len(prints)


def test_fingerprints_do_not_change_with_being_asked_or_made_again_or_with_what_is_masked_out():
    problem = variations()["itself"]
    before = problem.fingerprint()
    problem.start(problem.context(CPU))  # what is made on the way is no part of it
    assert problem.basis is not None and problem.fingerprint() == before == variations()["itself"].fingerprint()
    image, mask = noise(24, 24, 3), np.ones((24, 24))
    mask[3, 4] = 0
    other = image.copy()
    other[3, 4] = 9
    first, second = (Problem(small_scene(), Target(pixels, mask), Light()) for pixels in (image, other))
    assert first.fingerprint() == second.fingerprint()


@pytest.mark.slow
def test_fingerprints_are_those_of_another_process():
    command = "import test_inverse_problem as t; print({n: p.fingerprint() for n, p in t.variations().items()})"
    environment = os.environ | {"PYTHONHASHSEED": "7", "PYTHONPATH": os.pathsep.join(sys.path)}
    output = subprocess.run(
        [sys.executable, "-c", command], env=environment, capture_output=True, text=True, check=True, cwd=Path.cwd()
    ).stdout
    here = {name: problem.fingerprint() for name, problem in variations().items()}
    assert output.splitlines()[-1] == str(here)
