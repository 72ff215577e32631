"""Images a second of small images in batches, in one process and in two, as a network that trains takes them.

    python demos/benchmarks/throughput.py [--sizes 64 256] [--instances 1 8 64] [--seconds 2]

The scene is that of benchmark.py. Of "light" each instance has light of its own, five bands, and what is seen is kept;
of "pose" each has a bunny that moved, so all is computed; of "mixed" one after another shows the bunny and six other
shapes, each moved. A process has all threads; two have half of them each, and
work at the same time. An image is forward alone, or forward and backward to what varies. Figures are whole rates, host
work included, after a warm-up.
"""

import argparse
import dataclasses
import itertools
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import torch

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.benchmarks.lane_choice import cpu_text
from demos.scenes import bunny_scene, on_ground
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
    arguments = parser.parse_args()
    main(arguments.sizes, arguments.instances, arguments.seconds)
