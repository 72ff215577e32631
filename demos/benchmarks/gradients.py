"""Compare gradients of the bunny scene's image with central differences of it, for images of several sizes.

    python demos/benchmarks/gradients.py [--sizes 32 64 128 256] [--methods directional log-sh none] [--losses 5]

The losses are sums of the image weighted with a few random waves; the parameters the pose of the bunny (turn, shift)
and that of the camera. The error is the relative L2 of the gradient over all losses and parameters, against differences
of the same image ("own"), and for the pose of the means of one that is up to 16 times as large ("fine"), nearer to the
image that there would be without pixels. (More samples of a pixel would share its receivers on a ground.) Differences
reach over half a sample, since over less an image jumps where samples flip; in a small image so far that shadows bend
on the way, and "fine" is the one to trust. "shadow alone" sees the ground with the bunny out of view.
"""

import argparse
import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.scenes import bunny_scene
from warpshadow.torch import TorchRenderer, rotation_matrices

FINE = 1280
"""Pixels across an image whose means differences are compared with, as far as 16 times the size makes as many."""


def main(methods: list[str], sizes: list[int], loss_count: int) -> None:
    ws.quiet()
    torch.set_num_threads(1)
    print(f"{'':40}" + "".join(f"{f'{size} × {size}':>16}" for size in sizes))
    print(f"{'':40}" + f"{'own':>9}{'fine':>7}" * len(sizes))
    for method in methods:
        scene = dataclasses.replace(bunny_scene(), visibility=ws.Visibility(method))
        below = ws.Camera.look_at((1.6, 1.1, -1.2), (1.5, 0, -1.2), up=(0, 0, -1), fov_y=60, size=(256, 256))
        cases: dict[str, tuple[ws.Scene, Callable, list[int]]] = {
            "shadow alone, pose": (dataclasses.replace(scene, camera=below), pose_image, [1]),
            "pose": (scene, pose_image, [1, 2]),
            "camera": (scene, camera_image, [1, 2]),
        }
        for name, (seen, image_of, sample_counts) in cases.items():
            if method == "none" and "shadow" in name:
                continue
            fine = {
                size: differences(renderer_of(seen, times * size, 1), image_of, loss_count, times)
                for size, times in ((size, min(16, FINE // size)) for size in sizes)
                if name == "pose"
            }
            for supersampling in sample_counts:
                print(f"{f'{method}, {name}, {supersampling} × {supersampling} samples':40}", end="")
                for size in sizes:
                    renderer = renderer_of(seen, size, supersampling)
                    gradient = gradients(renderer, image_of, loss_count)
                    own = relative_error(gradient, differences(renderer, image_of, loss_count))
                    rest = f"{relative_error(gradient, fine[size]):7.1%}" if size in fine else " " * 7
                    print(f"{own:9.1%}{rest}", end="", flush=True)
                print()


def renderer_of(scene: ws.Scene, size: int, supersampling: int) -> TorchRenderer:
    camera = scene.camera.resized(size / scene.camera.width)
    return TorchRenderer(dataclasses.replace(scene, camera=camera, supersampling=supersampling))


def step_of(renderer: TorchRenderer) -> float:
    """How far a difference reaches to each side [scene units, radians]: half a sample or so."""
    scene = renderer.scene
    return 1.8 / (scene.camera.width * scene.supersampling)


def pose_image(renderer: TorchRenderer, values: torch.Tensor) -> torch.Tensor:
    """The image for a turn and a shift [6] of the bunny."""
    rotations, translations, scales = renderer.scene_poses()
    still = torch.zeros(1, 3)
    turns = rotation_matrices(torch.cat([values[None, :3], still]))
    shifts = translations + torch.cat([values[None, 3:], still])
    return renderer(geometry=renderer.placed(turns @ rotations, shifts, scales))


def camera_image(renderer: TorchRenderer, values: torch.Tensor) -> torch.Tensor:
    """The image for a turn and a shift [6] of the camera."""
    camera = renderer.scene.camera
    matrix, turn, shift = (
        torch.tensor(array, dtype=torch.float32) for array in (camera.intrinsics, camera.rotation, camera.translation)
    )
    turned = rotation_matrices(values[None, :3])[0] @ turn
    return renderer(clip_matrices=renderer.clip_matrices(turned, shift + values[3:], matrix))


def means(image: torch.Tensor, times: int) -> torch.Tensor:
    """Means of so many pixels across and down."""
    return torch.nn.functional.avg_pool2d(image.movedim(-1, 0), times).movedim(0, -1)


def losses(image: torch.Tensor, count: int) -> torch.Tensor:
    """Sums of the colors weighted with waves, shape [count]."""
    height, width, _ = image.shape
    row, column = np.mgrid[0 : 1 : height * 1j, 0 : 1 : width * 1j]
    weights = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        waves = [
            np.sin(2 * np.pi * (a * row + b * column) + c)[..., None] * rng.normal(size=3)
            for a, b, c in rng.uniform(-3, 3, (6, 3))
        ]
        weights.append(sum(waves))
    return (torch.from_numpy(np.stack(weights)) * image[..., :3].double()).sum(dim=(1, 2, 3))


def gradients(renderer: TorchRenderer, image_of: Callable, count: int) -> np.ndarray:
    """Gradients of the losses, shape [loss, parameter]."""
    start = torch.zeros(6, requires_grad=True)
    values = losses(image_of(renderer, start), count)
    return np.stack([torch.autograd.grad(value, start, retain_graph=True)[0].numpy() for value in values])


def differences(renderer: TorchRenderer, image_of: Callable, count: int, times: int = 1) -> np.ndarray:
    """Central differences of the losses, shape [loss, parameter], of the means of so many pixels across and down."""
    step = step_of(renderer)
    with torch.no_grad():
        ends = [
            [losses(means(image_of(renderer, sign * step * axis), times), count) for sign in (1, -1)]
            for axis in torch.eye(6)
        ]
    return np.stack([((right - left) / (2 * step)).numpy() for right, left in ends], axis=-1)


def relative_error(got: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(got - expected) / np.linalg.norm(expected))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", nargs="+", default=["directional", "log-sh", "none"], help="of visibility")
    parser.add_argument("--sizes", nargs="+", type=int, default=[32, 64, 128, 256], help="of the images [pixels]")
    parser.add_argument("--losses", type=int, default=5, help="random losses")
    arguments = parser.parse_args()
    main(arguments.methods, arguments.sizes, arguments.losses)
