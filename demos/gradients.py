"""Compare gradients of the bunny scene's image with central differences of it.

    python demos/gradients.py

The losses are sums of the image weighted with a few random waves; the parameters the pose of the bunny (turn, shift)
and that of the camera. The error is the relative L2 of the gradient over all losses and parameters, against differences
of the same image, and of one with 5 × 5 samples a pixel, which is nearer to the image that there would be without
pixels. "shadow alone" sees the ground with the bunny out of view.
"""

import argparse
import dataclasses
from collections.abc import Callable

import numpy as np
import torch
from scenes import bunny_scene

import warpshadow as ws
from warpshadow.torch import TorchRenderer, rotation_matrices

STEPS = {1: 7e-3, 2: 4e-3, 5: 4e-3}
"""Differences reach over half a sample or so: over less, an image jumps where its samples flip."""


def main(methods: list[str], loss_count: int) -> None:
    ws.quiet()
    torch.set_num_threads(1)
    print(f"{'':46}{'own image':>12}{'5 × 5 samples':>16}")
    for method in methods:
        scene = dataclasses.replace(bunny_scene(), visibility=ws.Visibility(method))
        below = ws.Camera.look_at((1.6, 1.1, -1.2), (1.5, 0, -1.2), up=(0, 0, -1), fov_y=60, size=(96, 96))
        cases: dict[str, tuple[ws.Scene, Callable, list[int]]] = {
            "shadow alone, pose": (dataclasses.replace(scene, camera=below), pose_image, [1]),
            "pose": (scene, pose_image, [1, 2]),
            "camera": (scene, camera_image, [1, 2]),
        }
        for name, (seen, image_of, sample_counts) in cases.items():
            if method == "none" and "shadow" in name:
                continue
            truth = differences(renderer_of(seen, 5), image_of, STEPS[5], loss_count) if name == "pose" else None
            for across in sample_counts:
                renderer = renderer_of(seen, across)
                gradient = gradients(renderer, image_of, loss_count)
                own = relative_error(gradient, differences(renderer, image_of, STEPS[across], loss_count))
                fine = "" if truth is None else f"{relative_error(gradient, truth):16.1%}"
                print(f"{f'{method}, {name}, {across} × {across} samples':46}{own:12.1%}{fine}")


def renderer_of(scene: ws.Scene, across: int) -> TorchRenderer:
    return TorchRenderer(dataclasses.replace(scene, supersampling=across))


def pose_image(renderer: TorchRenderer, values: torch.Tensor) -> torch.Tensor:
    """The image for a turn and a shift [6] of the bunny."""
    rotations, translations, scales = renderer.scene_poses()
    still = torch.zeros(1, 3)
    turns = rotation_matrices(torch.cat([values[None, :3], still]))
    shifts = translations + torch.cat([values[None, 3:], still])
    return renderer(geometry=renderer.placed(turns @ rotations, shifts, scales))


def camera_image(renderer: TorchRenderer, values: torch.Tensor) -> torch.Tensor:
    """The image for a turn and a shift [6] of the camera."""
    camera = renderer.renderer.scene.camera
    matrix, turn, shift = (
        torch.tensor(array, dtype=torch.float32) for array in (camera.intrinsics, camera.rotation, camera.translation)
    )
    turned = rotation_matrices(values[None, :3])[0] @ turn
    return renderer(clip_matrices=renderer.clip_matrices(turned, shift + values[3:], matrix))


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


def differences(renderer: TorchRenderer, image_of: Callable, step: float, count: int) -> np.ndarray:
    """Central differences of the losses, shape [loss, parameter]."""
    with torch.no_grad():
        ends = [[losses(image_of(renderer, sign * step * axis), count) for sign in (1, -1)] for axis in torch.eye(6)]
    return np.stack([((right - left) / (2 * step)).numpy() for right, left in ends], axis=-1)


def relative_error(got: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(got - expected) / np.linalg.norm(expected))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", nargs="+", default=["directional", "log-sh", "none"], help="of visibility")
    parser.add_argument("--losses", type=int, default=5, help="random losses")
    arguments = parser.parse_args()
    main(arguments.methods, arguments.losses)
