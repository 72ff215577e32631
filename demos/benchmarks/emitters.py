"""Images in near light: of lamps against Mitsuba's area lights, or the library's paths; of a map on a sphere.

    python demos/benchmarks/emitters.py [--by mitsuba|rays] [--size 96] [--bounces 0 all] [--scenes lamp table …]
        [--samples 4096] [--picture emitters.png]

Errors are of all pixels but those that show a lamp and those beside them, relative L2, noise of the reference taken
off; "edges" are errors without the pixels where the reference jumps, beside shadows' edges and outlines; "far" is a
renderer's error if the map is taken to be infinitely far away. CPU time is of a renderer's image of moved bodies, and
of that with its gradient.
Mitsuba knows no map on a sphere: scenes with one are compared by rays alone.
"""

import argparse
import dataclasses
import sys
import time
from pathlib import Path

import numpy as np
import torch

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.kinds import BLUE, GOLD, GRAY, RED, WHITE, body, ground, laid_table, room, seen, standing
from demos.references import Reference, Request
from demos.scenes import shipped_mesh
from demos.shapes import box, joined, rod
from warpshadow.torch import TorchRenderer

DARK = ws.EnvironmentMap.constant(0.0)
BLACK = (0.0, 0.0, 0.0)
_JUMP = 0.1  # of the reference between neighboring pixels, over its mean, beside which pixels do not count for "edges"


def lamp(mesh: ws.Mesh, at: tuple[float, float, float], power: float, **options) -> ws.Body:
    """A black body that emits a warm white."""
    color = power * np.array([1.0, 0.85, 0.65])
    return ws.Body(mesh, albedo=BLACK, emission=color, translation=at, name="lamp", **options)


def small_lamp(size: int) -> ws.Scene:
    """A lamp of 10 cm at 1 m over a bunny."""
    bodies = [standing(shipped_mesh("bunny"), WHITE, (0, 0, 0), 1.0), ground(4.0)]
    return seen([*bodies, lamp(ws.icosphere(0.05, 3), (0.5, 1.9, 0.6), 100)], DARK, size, (0.3, 1.6, 2.6), (0, 0.4, 0))


def table(size: int) -> ws.Scene:
    """A table with things on it under a round lamp, and a box and the floor below it."""
    return seen([*laid_table(), ground(), lamp(ws.icosphere(0.15, 3), (0.4, 2.6, 0.3), 40)], DARK, size)


def ball_room(size: int) -> ws.Scene:
    """A room with a lamp like a ball below its ceiling."""
    bodies = [
        standing(shipped_mesh("bear"), GOLD, (-0.5, 0, -0.4), 1.5, rotation=(0, 30, 0)),
        standing(joined("box", box((1, 1.6, 1))), WHITE, (0.7, 0, 0.2), 1.3, rotation=(0, -20, 0)),
    ]
    hanging = lamp(ws.icosphere(0.15, 3), (0.2, 2.4, 0.3), 50)
    return seen([*bodies, *room(), hanging], DARK, size, (0, 1.5, 6.6), (0, 1.45, 0), fov_y=34)


def panel_room(size: int) -> ws.Scene:
    """A room with a thin box that shines from its ceiling."""
    bodies = [
        standing(shipped_mesh("bunny"), WHITE, (-0.55, 0, 0.1), 1.2),
        standing(ws.icosphere(1.0, 4), BLUE, (0.65, 0, -0.2), 1.0, name="ball"),
    ]
    panel = lamp(joined("panel", box((1.0, 0.04, 1.0))), (0, 2.97, 0), 8)
    return seen([*bodies, *room(), panel], DARK, size, (0, 1.5, 6.6), (0, 1.45, 0), fov_y=34)


def tube(size: int) -> ws.Scene:
    """A corner with a column and a bear, beside a tube."""
    bodies = [
        standing(joined("column", rod((0, 0, 0), (0, 1, 0), 0.3, 32)), RED, (-0.5, 0, -0.3), 1.4, name="column"),
        standing(shipped_mesh("bear"), GRAY, (0.5, 0, 0.1), 1.0, rotation=(0, -30, 0)),
    ]
    walls = [part for part in room() if part.name in ("floor", "left wall", "back wall")]
    upright = lamp(joined("tube", rod((0, 0, 0), (0, 1.2, 0), 0.04, 16)), (1.3, 0.5, 0.9), 40)
    return seen([*bodies, *walls, upright], DARK, size, (2.4, 2.2, 4.2), (0, 0.8, 0), fov_y=34)


def two_lamps(size: int) -> ws.Scene:
    """A table's top with a wall behind it, a warm lamp that stands on it and a blue one behind a screen."""
    bodies = [
        standing(shipped_mesh("bunny"), WHITE, (0.1, 0, 0.3), 0.9),
        body(ws.plane((1.0, 1.2), 8), GRAY, (-0.8, 0.6, 0.2), name="screen", rotation=(0, 0, 90)),
        body(ws.plane((4.0, 2.0), 16), WHITE, (0, 1.0, -1.0), name="wall", rotation=(90, 0, 0)),
    ]
    standing_lamp = lamp(ws.icosphere(0.18, 3), (0.9, 0.35, -0.2), 12)
    cold = ws.Body(ws.icosphere(0.1, 3), BLACK, emission=(10, 25, 60), translation=(-1.5, 0.7, 0.4), name="cold lamp")
    return seen([*bodies, ground(), standing_lamp, cold], DARK, size, (0.3, 1.8, 3.4), (-0.1, 0.4, 0), fov_y=40)


def windows(radius: float, center: tuple[float, float, float], height: int = 64) -> ws.EnvironmentMap:
    """The walls of a dim room, with a large warm window and a small cold one, as a sphere."""
    radiance = np.full((height, 2 * height, 3), 0.15)
    radiance[: height // 2] *= 1.5
    directions = ws.EnvironmentMap(radiance).directions()
    for towards, angle, color in (((0.9, 0.35, 0.2), 0.3, (12, 11, 9)), ((-0.6, 0.7, 0.5), 0.18, (6, 8, 12))):
        radiance[directions @ np.array(towards) / np.linalg.norm(towards) > np.cos(angle)] = color
    return ws.EnvironmentMap(radiance, radius=radius, center=center)


def near_bunny(size: int) -> ws.Scene:
    """A bunny and a ball on a ground, the windows 2.2 away."""
    bodies = [
        standing(shipped_mesh("bunny"), WHITE, (0.2, 0, 0.1), 1.0),
        standing(ws.icosphere(1.0, 3), GOLD, (-0.8, 0, 0.3), 0.6, name="ball"),
        ground(2.6),
    ]
    return seen(bodies, windows(2.2, (0, 0.5, 0)), size, (0.6, 1.8, 2.8), (0, 0.4, 0))


def near_table(size: int) -> ws.Scene:
    """A table with things on it in a room of 6 across."""
    return seen([*laid_table(), ground(4.0)], windows(3.0, (0, 0.8, 0)), size)


def near_corner(size: int) -> ws.Scene:
    """A column and a bear in a corner, the windows 2.6 away."""
    bodies = [
        standing(joined("column", rod((0, 0, 0), (0, 1, 0), 0.3, 32)), RED, (-0.5, 0, -0.3), 1.4, name="column"),
        standing(shipped_mesh("bear"), GRAY, (0.5, 0, 0.1), 1.0, rotation=(0, -30, 0)),
        body(ws.plane((2.6, 1.6), 16), WHITE, (0, 0.8, -0.9), name="wall", rotation=(90, 0, 0)),
        ground(2.6),
    ]
    return seen(bodies, windows(2.6, (0, 0.6, 0)), size, (1.8, 1.7, 3.4), (0, 0.6, 0), fov_y=34)


SCENES = {
    "lamp": small_lamp,
    "table": table,
    "ball room": ball_room,
    "panel room": panel_room,
    "tube": tube,
    "two lamps": two_lamps,
    "near bunny": near_bunny,
    "near table": near_table,
    "near corner": near_corner,
}


def counted(reference: Reference, scene: ws.Scene) -> tuple[np.ndarray, np.ndarray]:
    """Pixels that show no lamp nor are beside one, and those among them away from jumps, bool [height, width]."""
    is_lamp = np.array([item.is_emitter for item in scene.bodies])
    lamps = np.pad(is_lamp[reference.body] & (reference.body >= 0), 1)
    height, width = reference.body.shape
    beside = np.any(
        [lamps[row : row + height, column : column + width] for row in range(3) for column in range(3)], axis=0
    )
    chosen = reference.covered & ~beside & reference.is_whole
    gray = reference.mean[..., :3].mean(axis=-1)
    jump = np.zeros(gray.shape, bool)
    for axis in (0, 1):
        large = np.abs(np.diff(gray, axis=axis)) > _JUMP * gray[chosen].mean()
        pad = [(0, 0), (0, 0)]
        for pad[axis] in ((0, 1), (1, 0)):
            jump |= np.pad(large, pad)
    return chosen, chosen & ~jump


def error(reference: Reference, image: np.ndarray, pixels: np.ndarray) -> float:
    """Relative L2 error of some pixels, noise taken off."""
    truth = reference.mean[pixels, :3]
    first, second = reference.images[:, pixels, :3]
    square = np.square(image[pixels, :3] - truth).sum() - np.square((first - second) / 2).sum()
    return float(np.sqrt(max(square, 0.0)) / np.linalg.norm(truth))


def seconds(scene: ws.Scene, *, has_gradient: bool) -> float:
    """CPU time of an image of moved bodies, the median of three after two that prepare."""
    renderer = TorchRenderer(scene, progress=False)
    rotations, translations, scales = renderer.scene_poses()
    times = []
    for number in range(5):
        moved = (translations + 1e-4 * number).requires_grad_(has_gradient)
        start = time.process_time()
        image = renderer(geometry=renderer.placed(rotations, moved, scales))
        if has_gradient:
            image.square().sum().backward()
        times.append(time.process_time() - start)
    return float(np.median(times[2:]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--by", choices=("mitsuba", "rays"), default="mitsuba")
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--samples", type=int, default=4096)
    parser.add_argument("--bounces", nargs="+", default=["0", "all"])
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--folder", type=Path, default=Path("out/emitters"))
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    ws.quiet()
    torch.manual_seed(0)
    heads = ("bounces", 8), ("renderer", 10), ("no edges", 10), ("light", 8), ("still", 8), ("light", 8), ("far", 8)
    print(f"{'scene':12}" + "".join(f"{head:>{width}}" for head, width in (*heads, ("image", 9), ("+ grad", 9))))
    rows, strips = [], []
    for name in options.scenes:
        for text in options.bounces:
            bounces = "all" if text == "all" else int(text)
            scene = dataclasses.replace(SCENES[name](options.size), bounces=bounces)
            deepest = 16 if bounces == "all" else bounces
            way = "rays" if scene.shell is not None else options.by
            reference = Request(scene, way, deepest, options.samples, options.folder).reference()
            moving = dataclasses.replace(scene, visibility=ws.Visibility("directional"))
            kept = ws.Renderer(moving).render()
            still = ws.render(scene, progress=False)
            chosen, smooth = counted(reference, scene)
            light = [image[chosen, :3].mean() / reference.mean[chosen, :3].mean() - 1 for image in (kept, still)]
            errors = [error(reference, *pair) for pair in ((kept, chosen), (kept, smooth), (still, chosen))]
            far = ""
            if scene.shell is not None:
                away = dataclasses.replace(moving, light=ws.EnvironmentMap(scene.light.radiance))
                far = f"{error(reference, ws.Renderer(away).render(), chosen):.1%}"
            times = [seconds(scene, has_gradient=has_gradient) for has_gradient in (False, True)]
            rows.append(errors)
            print(
                f"{name:12}{text:>8}{errors[0]:10.1%}{errors[1]:10.1%}{light[0]:+8.1%}{errors[2]:8.1%}{light[1]:+8.1%}"
                f"{far:>8}{times[0]:7.2f} s{times[1]:7.2f} s",
                flush=True,
            )
            strips.append(np.concatenate([kept, still, reference.mean], axis=1)[..., :3])
    means = np.mean(rows, axis=0)
    print(f"{'mean':20}{means[0]:10.1%}{means[1]:10.1%}{'':8}{means[2]:8.1%}")
    if options.picture:
        scaled = [strip * 0.6 / np.percentile(strip, 95) for strip in strips]
        ws.write_image(options.picture, np.clip(np.concatenate(scaled), 0, 1))


if __name__ == "__main__":
    main()
