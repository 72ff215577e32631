"""Images a second of small images in batches, in one process and in two, as a network that trains takes them.

    python demos/benchmarks/throughput.py [--sizes 64 256] [--instances 1 8 64] [--seconds 2] [--settings]

The scene is that of benchmark.py. Of "light" each instance has light of its own, five bands, and what is seen is kept;
of "pose" each has a bunny that moved, so all is computed; of "mixed" one after another shows the bunny and six other
shapes, each moved. A process has all threads; two have half of them each, and
work at the same time. An image is forward alone, or forward and backward to what varies. Figures are whole rates, host
work included, after a warm-up.

With --settings it prints instead what settings that are faster than the defaults cost: of "pose" in one process, time
and processor time, and the error of the image where the bunny stands, against 2048 rays.
"""

import argparse
import dataclasses
import itertools
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.benchmarks.lane_choice import cpu_text
from demos.scenes import bunny_scene, image_error, on_ground
from warpshadow.device.workers import run_tasks
from warpshadow.scene.random_scenes import primitives
from warpshadow.torch import MixedRenderer, TorchRenderer

WARM_UP = 3  # calls


class Case(NamedTuple):
    """What is timed."""

    what: str  # "light", "pose" or "mixed"
    size: int  # of images [pixels]
    instances: int  # of a call
    has_gradient: bool


class Setting(NamedTuple):
    """Other settings than the defaults."""

    visibility: dict[str, Any] = {}
    blockers: int = 64
    receivers: str = "vertex"  # of the bunny

    def __str__(self) -> str:
        changed = [f"{key} {value}" for key, value in self.visibility.items()]
        changed += [f"{self.blockers} spheres"] * (self.blockers != 64)
        changed += ["bunny by pixel"] * (self.receivers == "pixel")
        return ", ".join(changed) or "defaults"

    def scene(self, size: int) -> ws.Scene:
        """The scene of "pose" with these."""
        scene = bunny_scene()
        bunny = dataclasses.replace(scene.bodies[0], blockers=self.blockers, receivers=self.receivers)
        camera = scene.camera.resized(size / scene.camera.width)
        given = {"bodies": (bunny, scene.bodies[1]), "camera": camera}
        return dataclasses.replace(scene, **given, visibility=ws.Visibility.of(self.visibility))


SETTINGS = (
    Setting(),
    Setting(receivers="pixel"),
    *(Setting({"directions": count}, receivers="pixel") for count in (64, 32, 16)),
    Setting({"directions": 32}, 16, "pixel"),
    *(Setting({"method": "log-sh", "order": 4}, count, "pixel") for count in (64, 16)),
    Setting({"method": "none"}, receivers="pixel"),
)


class Run(NamedTuple):
    """A process' part in timing some cases."""

    cases: tuple[Case, ...]
    seconds: float  # of each


def renderer_of(case: Case) -> MixedRenderer:
    scenes = [bunny_scene()]
    if case.what == "mixed":
        sky, ground = scenes[0].light, scenes[0].bodies[1]
        bodies = [on_ground(shape.mesh, sky, blockers=32).bodies[0] for shape in primitives()[1:]]
        scenes += [dataclasses.replace(scenes[0], bodies=(body, ground)) for body in bodies]
    camera = scenes[0].camera.resized(case.size / scenes[0].camera.width)
    basis = ws.HarmonicBasis(5) if case.what == "light" else None
    return MixedRenderer(TorchRenderer(dataclasses.replace(scene, camera=camera), basis=basis) for scene in scenes)


def step_of(case: Case, renderer: MixedRenderer) -> Callable[[], None]:
    """A function that renders the images of a call once."""
    generator = torch.Generator().manual_seed(0)
    which = torch.arange(case.instances) % len(renderer.renderers)
    rotations, translations, scales = (poses[which] for poses in renderer.scene_poses())

    def varied() -> torch.Tensor:
        if case.what == "light":
            return torch.rand(case.instances, 25, 3, generator=generator)
        shifts = 0.05 * torch.randn(translations.shape, generator=generator)
        shifts[:, 1:] = 0  # the ground stays
        return translations + shifts

    def image(values: torch.Tensor) -> torch.Tensor:
        if case.what == "light":
            return renderer(which, values)
        return renderer(which, geometry=renderer.placed(which, rotations, values, scales))

    def step() -> None:
        if case.has_gradient:
            image(varied().requires_grad_()).square().mean().backward()
        else:
            with torch.no_grad():
                image(varied())

    return step


def rate(step: Callable[[], None], instances: int, seconds: float) -> float:
    """Images a second."""
    for _ in range(WARM_UP):
        step()
    start, count = time.perf_counter(), 0
    while (past := time.perf_counter() - start) < seconds or count < 2:
        step()
        count += 1
    return count * instances / past


def rates(run: Run) -> list[float]:
    """Images a second of this process, of each case."""
    ws.quiet()
    torch.set_num_threads(1)
    return [rate(step_of(case, renderer_of(case)), case.instances, run.seconds) for case in run.cases]


def all_rates(cases: tuple[Case, ...], processes: int, seconds: float) -> Iterator[float]:
    """Images a second of all processes together, of each case."""
    found = []
    for ended in run_tasks(rates, [Run(cases, seconds)] * processes, workers=processes):
        if ended.error is not None:
            raise ended.error
        found.append(ended.result)
    return map(sum, zip(*found, strict=True))


def processor_time(step: Callable[[], None], seconds: float) -> float:
    """Processor seconds of a step on all threads, the least of those that end within some seconds."""
    end, least = time.perf_counter() + seconds, np.inf
    while time.perf_counter() < end:
        start = time.process_time()
        step()
        least = min(least, time.process_time() - start)
    return least


def print_settings(sizes: list[int], instances: int, seconds: float) -> None:
    """What settings cost."""
    ws.quiet()
    torch.set_num_threads(1)
    print(cpu_text())
    for size in sizes:
        print(f"\n{instances} instances of {size} × {size}, ms an image; processor time; error against rays")
        print(f"{'settings':44} {'forward':>9} {'processor':>10} {'and back':>9} {'processor':>10} {'error':>7}")
        rays = Setting({"method": "ray-traced", "samples": 2048}).scene(size)
        truth = ws.Renderer(rays).render()
        for setting in SETTINGS:
            scene = setting.scene(size)
            figures = []
            for has_gradient in (False, True):
                step = step_of(Case("pose", size, instances, has_gradient), MixedRenderer([TorchRenderer(scene)]))
                figures += [1 / rate(step, instances, seconds), processor_time(step, seconds) / instances]
            forward, of_forward, both, of_both = (1e3 * each for each in figures)
            error = image_error(ws.Renderer(scene).render(), truth)
            times = f"{forward:6.2f} ms {of_forward:7.2f} ms {both:6.2f} ms {of_both:7.2f} ms"
            print(f"{str(setting):44} {times} {error:7.1%}", flush=True)


def main(sizes: list[int], instances: list[int], seconds: float) -> None:
    print(cpu_text())
    cases = tuple(
        itertools.starmap(Case, itertools.product(("light", "pose", "mixed"), sizes, instances, (False, True)))
    )
    one, two = (list(all_rates(cases, processes, seconds)) for processes in (1, 2))
    print("\nimages a second, and ms an image")
    print(f"{'varies':7} {'size':>9} {'instances':>9}  {'':21} {'one process':>19} {'two processes':>19}")
    for case, *both in zip(cases, one, two, strict=True):
        way = "forward and backward" if case.has_gradient else "forward"
        figures = " ".join(f"{each:8.0f} {1e3 / each:7.2f} ms" for each in both)
        print(f"{case.what:7} {case.size:4} × {case.size:<4}{case.instances:7}  {way:21} {figures}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 256], help="of images [pixels]")
    parser.add_argument("--instances", type=int, nargs="+", default=[1, 8, 64], help="of a call")
    parser.add_argument("--seconds", type=float, default=2.0, help="for each figure")
    parser.add_argument("--settings", action="store_true", help="time faster settings, and print their errors")
    arguments = parser.parse_args()
    if arguments.settings:
        print_settings(arguments.sizes, max(arguments.instances), arguments.seconds)
        sys.exit()
    main(arguments.sizes, arguments.instances, arguments.seconds)
