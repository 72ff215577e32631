"""How long a pose fit takes, beside a plain loop of Adam.

    python demos/benchmarks/pose_fits.py [--count 10] [--first 0] [--size 128] [--ways stages]

The bunny on a ground, turned by 40°, its target rendered; and random poses, 10° to 40° and 5% to 25% of the diagonal
off, their targets ray traced. ``pose_stages`` and ``inverse.fit`` beside what one writes first: Adam on a turn and a
shift, 150 steps at a rate of 0.03, squares of differences at the target's size. The way "search" is
``unknown_pose_stages``.

Printed are iterations, times, and how far vertices are off in the end (MDE, in percent of the diagonal). Times are
from the call to the first iterate that is at most 0.5% off, to the one from which on all are, and to the end. They
include making renderers; kernels and spheres are best made before, by a run with --count 0.
"""

import argparse
import dataclasses
import functools
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.benchmarks.lane_choice import cpu_text
from demos.problems import changed, displaced, distance_error, placement, ray_traced, turned
from demos.scenes import shipped_mesh
from warpshadow import inverse
from warpshadow.torch import TorchRenderer, rotation_matrices

NEAR = 0.5  # MDE [%] that counts as found
STEPS, RATE = 150, 0.03  # of the plain loop
TURN = Rotation.from_rotvec([0, 40, 0], degrees=True)


@dataclass(frozen=True)
class Moment:
    """An iterate: when it was evaluated, by the clock and by the processor [s], and the body as it has it."""

    wall: float
    cpu: float
    body: ws.Body


class Stopwatch:
    """Notes iterates; the time from its making, less what noting takes."""

    def __init__(self) -> None:
        self.moments: list[Moment] = []
        self.wall, self.cpu = time.perf_counter(), time.process_time()

    def note(self, body: Callable[[], ws.Body]) -> None:
        """Note a body as it is now."""
        wall, cpu = time.perf_counter(), time.process_time()
        self.moments.append(Moment(wall - self.wall, cpu - self.cpu, body()))
        self.wall += time.perf_counter() - wall
        self.cpu += time.process_time() - cpu


@dataclass(frozen=True)
class Outcome:
    """What a fit took: seconds by the clock and by the processor until its iterates come near, stay near, and end."""

    error: float
    iterations: float
    first: tuple[float, float]
    last: tuple[float, float]
    whole: tuple[float, float]

    @classmethod
    def of(cls, moments: Sequence[Moment], true: ws.Body) -> "Outcome":
        """Judge the iterates of a fit, of which the last is its result."""
        errors = [distance_error(moment.body, true) for moment in moments]
        times = [(moment.wall, moment.cpu) for moment in moments]
        never = (float("inf"), float("inf"))
        near = [number for number, error in enumerate(errors) if error <= NEAR]
        far = [number for number, error in enumerate(errors) if error > NEAR]
        stays = far[-1] + 1 if far else 0
        return cls(
            errors[-1],
            len(moments) - 1,
            times[near[0]] if near else never,
            times[stays] if stays < len(times) else never,
            times[-1],
        )


def plain(scene: ws.Scene, target: np.ndarray) -> list[Moment]:
    """The loop that one writes first."""
    watch = Stopwatch()
    renderer = TorchRenderer(scene)
    rotations, translations, scales = renderer.scene_poses()
    wanted = torch.from_numpy(target)
    turn, shift = (torch.zeros(2, 3, requires_grad=True) for _ in range(2))
    optimizer = torch.optim.Adam([turn, shift], lr=RATE)

    def body() -> ws.Body:
        with torch.no_grad():
            rotation = (rotation_matrices(turn) @ rotations)[0].numpy()
            translation = (translations + shift)[0].numpy()
        return moved(scene.bodies[0], rotation, translation)

    for _ in range(STEPS):
        watch.note(body)
        optimizer.zero_grad()
        geometry = renderer.placed(rotation_matrices(turn) @ rotations, translations + shift, scales, moving=[0])
        torch.nn.functional.mse_loss(renderer(geometry=geometry), wanted).backward()
        optimizer.step()
    watch.note(body)
    return watch.moments


def moved(body: ws.Body, rotation: np.ndarray, translation: np.ndarray) -> ws.Body:
    """The body at a pose, its rotation a matrix."""
    vector = Rotation.from_matrix(rotation).as_rotvec(degrees=True)
    return dataclasses.replace(body, rotation=vector, translation=translation)


def staged(
    scene: ws.Scene,
    target: np.ndarray,
    stages: Callable[[inverse.Problem], Sequence[inverse.Stage]] = inverse.pose_stages,
) -> list[Moment]:
    """The ready-made stages."""
    watch = Stopwatch()
    problem = inverse.Problem(scene, inverse.Target(target), inverse.Pose(0))
    context = problem.context(torch.device("cpu"))

    def make(tensors: list[torch.Tensor], lr: float) -> torch.optim.Optimizer:
        optimizer = inverse.default_optimizer(tensors, lr=lr)
        step = optimizer.step

        def watched(closure: Callable[[], float]) -> object:
            values = {
                "pose[0]": dict(zip(("turn", "shift"), (tensor.detach().clone() for tensor in tensors), strict=True))
            }
            watch.note(lambda: problem.fitted_scene(values, context).scene.bodies[0])
            return step(closure)

        optimizer.step = watched
        return optimizer

    result = inverse.fit(problem, stages(problem), optimizer=make, progress=False)
    watch.note(lambda: result.scene.bodies[0])
    return watch.moments


def bunny_on_ground(size: int) -> ws.Scene:
    """The bunny that ships with Warp, on a ground."""
    bunny = ws.Body(shipped_mesh("bunny"), albedo=(0.8, 0.6, 0.5)).on_ground(size=2)
    camera = ws.Camera.framing(bunny, size=(size, size))
    return ws.Scene([bunny, ws.Body(ws.plane(6.0), name="ground")], ws.synthetic_sky(), camera)


def median(outcomes: Sequence[Outcome]) -> Outcome:
    """Of each figure by itself."""
    figures = [[getattr(outcome, each.name) for outcome in outcomes] for each in dataclasses.fields(Outcome)]
    return Outcome(*(np.median(figure, axis=0).tolist() for figure in figures))


def row(name: str, way: str, outcome: Outcome) -> str:
    first, last, whole = (f"{wall:6.2f} {cpu:6.2f}" for wall, cpu in (outcome.first, outcome.last, outcome.whole))
    return f"{name:10} {way:6} {outcome.iterations:4.0f}   {first}   {last}   {whole}   {outcome.error:8.4f}"


def main(count: int, first: int, size: int, ways: list[str]) -> None:
    ws.quiet()
    torch.set_num_threads(1)
    print(f"{cpu_text().splitlines()[0]}; seconds by the clock and by the processor")
    print(f"{'pose':10} {'way':6} {'it.':>4}   {'first':>13}   {'last':>13}   {'end':>13}   {'MDE [%]':>8}")
    truth = bunny_on_ground(2 * size)
    cases = {"bunny 40°": (changed(truth, 0, **placement(turned(truth.bodies[0], TURN))), ws.Renderer(truth).render())}
    truth = bunny_on_ground(size)
    wanted = ray_traced(truth)
    for seed in range(first, count):
        body = displaced(truth.bodies[0], np.random.default_rng(seed))
        cases[f"random {seed}"] = (changed(truth, 0, **placement(body)), wanted)
    outcomes: dict[str, list[Outcome]] = {way: [] for way in ways}
    for name, (start, target) in cases.items():
        for way in ways:
            outcome = Outcome.of(WAYS[way](start, target), truth.bodies[0])
            print(row(name, way, outcome), flush=True)
            if name.startswith("random"):
                outcomes[way].append(outcome)
    for way, each in outcomes.items():
        if each:
            print(row("median", way, median(each)))


WAYS = {"plain": plain, "stages": staged, "search": functools.partial(staged, stages=inverse.unknown_pose_stages)}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10, help="random poses")
    parser.add_argument("--first", type=int, default=0, help="number of the first of them")
    parser.add_argument(
        "--size", type=int, default=128, help="pixels of random poses' images; that of 40° has twice it"
    )
    parser.add_argument(
        "--ways", nargs="*", choices=[*WAYS], default=["plain", "stages"], help="plain and stages by default"
    )
    arguments = parser.parse_args()
    main(arguments.count, arguments.first, arguments.size, arguments.ways)
