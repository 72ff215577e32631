"""A loop in pure Warp: the pose of a bunny on a ground, recovered from one image of it and its shadow with Adam.

    python demos/examples/warp_loop.py [--output out] [--iterations 60] [--device cpu]

Nothing here is torch. The bunny is turned by 15° and shifted by 0.2 units, and its image is the target. From where it
stood, ``wp.optim.Adam`` descends along the gradient that ``wp.Tape`` finds of the squared difference of the images, in
an axis-angle vector and a translation, all six of their numbers free; the ground keeps its pose.
"""

import argparse
import dataclasses
import math
import statistics
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import warp as wp
import warp.optim

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.scenes import on_ground, shipped_mesh
from warpshadow.device.batch import concatenate
from warpshadow.stages import Poses, rotation_matrices

TURN = np.radians([0.0, 15.0, 0.0])
SHIFT = np.array([0.16, 0.0, 0.12])
BUNNY_SIZE = 2.0  # scene units: what on_ground makes of a mesh
LEARNING_RATE = 0.03  # radians and scene units alike: turned by a radian, most of the bunny moves by about a unit
MOMENTA = (0.8, 0.99)  # Adam's betas; its own remember too long for so few steps


@wp.kernel
def _sum_squared_differences(
    # in
    image: wp.array(dtype=wp.vec4),
    target: wp.array(dtype=wp.vec4),
    # out
    loss: wp.array(dtype=wp.float32),
):
    """A thread owns a pixel."""
    pixel = wp.tid()
    difference = image[pixel] - target[pixel]
    wp.atomic_add(loss, 0, wp.dot(difference, difference))


class FreePose:
    """The image as a function of the pose of a scene's first body; the others keep theirs.

    Args:
        renderer: Of the scene.
        turn: Rotation of the body, axis-angle [radians], shape [3].
        shift: Translation away from where the scene has it [scene units], shape [3].
    """

    def __init__(
        self, renderer: ws.Renderer, turn: Sequence[float] = (0.0, 0.0, 0.0), shift: Sequence[float] = (0.0, 0.0, 0.0)
    ):
        self.renderer = renderer
        translation = renderer.scene.bodies[0].translation + shift
        # flat, as the optimizer wants them
        self.turn = wp.array([turn], dtype=wp.vec3, device=renderer.device, requires_grad=True)
        self.translation = wp.array([translation], dtype=wp.vec3, device=renderer.device, requires_grad=True)

    def draw(self) -> wp.array:
        """Draw the image, vec4 of shape [1, height, width]."""
        fixed = self.renderer.scene_poses()
        counts = [1, fixed.scales.shape[1] - 1]
        poses = Poses(
            concatenate([self.rotation(), fixed.rotations[:, 1:]], counts),
            concatenate([self.translation.reshape((1, 1)), fixed.translations[:, 1:]], counts),
            fixed.scales,
        )
        return self.renderer.draw(view=self.renderer.view(self.renderer.placed(poses)))

    def rotation(self) -> wp.array:
        """The rotation as a matrix, mat33 of shape [1, 1]."""
        return rotation_matrices(self.turn.reshape((1, 1)))

    def errors(self, other: "FreePose") -> tuple[float, float]:
        """How far the pose is from another: angle [degrees] and distance [scene units]."""
        chord = np.linalg.norm(self.rotation().numpy() - other.rotation().numpy())  # √8 sin(angle / 2)
        angle = 2 * math.degrees(math.asin(min(chord / math.sqrt(8), 1.0)))
        return angle, float(np.linalg.norm(self.translation.numpy() - other.translation.numpy()))


def compare(image: wp.array, target: wp.array) -> wp.array:
    """Sum of the squared differences of two images, float32 of shape [1]."""
    loss = wp.zeros(1, dtype=wp.float32, device=target.device, requires_grad=True)
    inputs = [image.flatten(), target.flatten()]
    wp.launch(_sum_squared_differences, dim=target.size, inputs=inputs, outputs=[loss], device=target.device)
    return loss


def recover(pose: FreePose, target: wp.array, iterations: int) -> Iterator[float]:
    """Descend from a pose to that of a target image, vec4 of shape [1, height, width].

    Yields:
        The loss of each iteration before it takes its step: the squared difference of a pixel on average.
    """
    optimizer = warp.optim.Adam([pose.turn, pose.translation], lr=LEARNING_RATE, betas=MOMENTA)
    for iteration in range(iterations):
        optimizer.lr = 0.5 * LEARNING_RATE * (1 + math.cos(math.pi * iteration / iterations))
        with wp.Tape() as tape:
            loss = compare(pose.draw(), target)
        yield float(loss.numpy()[0]) / target.size
        tape.backward(loss)
        optimizer.step([pose.turn.grad, pose.translation.grad])
        tape.zero()


def main(output: Path, iterations: int, device: str) -> None:
    ws.quiet()
    scene = on_ground(shipped_mesh("bunny"), ws.synthetic_sky((-0.75, 0.6, -0.1), sun_strength=2.0, sun_radius=5.0))
    scene = dataclasses.replace(scene, camera=scene.camera.resized(0.5))
    renderer = ws.Renderer(scene, device=device)
    truth, pose = FreePose(renderer, TURN, SHIFT), FreePose(renderer)
    target, start = wp.clone(truth.draw(), requires_grad=False), pose.draw()

    def report(iteration: int, loss: str) -> None:
        angle, distance = pose.errors(truth)
        print(f"{iteration:9}{loss:>12}{angle:17.2f}°{distance:12.4f} ({distance / BUNNY_SIZE:5.2%})", flush=True)

    print(f"{'iteration':>9}{'loss':>12}{'rotation error':>18}{'translation error':>20}")
    seconds = [time.perf_counter()]
    for iteration, loss in enumerate(recover(pose, target, iterations)):
        seconds.append(time.perf_counter())
        if iteration % 10 == 0:
            report(iteration, f"{loss:.3e}")
    report(iterations, "")
    print(
        f"{1e3 * statistics.median(np.diff(seconds)):.0f} ms per iteration (median), {seconds[-1] - seconds[0]:.1f} s"
    )

    output.mkdir(parents=True, exist_ok=True)
    path = output / "warp_loop.png"
    plot({"target": target, "start": start, "end": pose.draw()}, path)
    print(f"wrote {path}")


def plot(images: dict[str, wp.array], path: Path) -> None:
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    figure, row = pyplot.subplots(1, len(images), figsize=(4 * len(images), 4.3), layout="constrained")
    white = np.percentile(images["target"].numpy()[..., :3], 99.5)
    for axes, (label, image) in zip(row, images.items(), strict=True):
        pixels = image.numpy()[0]
        color = np.minimum(pixels[..., :3] / white + (1 - pixels[..., 3:]), 1)
        axes.imshow(ws.linear_to_srgb(color))
        axes.set_title(label)
        axes.axis("off")
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("out"), help="folder for the picture")
    parser.add_argument("--iterations", type=int, default=60, help="Adam steps")
    parser.add_argument("--device", default="cpu", help="Warp device")
    arguments = parser.parse_args()
    main(arguments.output, arguments.iterations, arguments.device)
