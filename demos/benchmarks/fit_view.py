"""What a page costs a fit: time of an iteration with and without `view=`.

    python demos/benchmarks/fit_view.py [--rounds 5] [--iterations 40]

The same fit of the bunny's pose runs without a page, with a page that nobody opened, and with one that a client of
viser's wire format takes pictures from (a process of its own, like a browser), in turns. It prints the time of an
iteration and what it takes of the process's cores, which depends less on what else the machine does.
"""

import argparse
import dataclasses
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.scenes import on_ground, shipped_mesh
from warpshadow import inverse

CLIENT = """
import sys
sys.path.append(sys.argv[1])
from pages import WirePage
page = WirePage(sys.argv[2])
page.look_from()
print("looks", flush=True)
while True:
    page.listen(1.0)
    page.heard.clear()
"""


def seconds(problem: inverse.Problem, iterations: int, view: bool | inverse.FitViewer) -> np.ndarray:
    """Time of an iteration, and of cores in it, from the first one to the end [s]."""
    began: list[np.ndarray] = []

    class Adam(torch.optim.Adam):
        """Notes when it takes its first step."""

        def step(self, closure):  # type: ignore[override,no-untyped-def]
            began.append(now())
            return super().step(closure)

    inverse.fit(problem, [inverse.Stage(iterations, 1e-4)], optimizer=Adam, tolerance=0, view=view, progress=False)
    return (now() - began[0]) / iterations


def now() -> np.ndarray:
    """Wall clock, and time of cores in all threads [s]."""
    return np.array([time.perf_counter(), time.process_time()])


def main(rounds: int, iterations: int) -> None:
    ws.quiet()
    scene = on_ground(shipped_mesh("bunny"), ws.synthetic_sky())
    scene = dataclasses.replace(scene, camera=scene.camera.resized(0.5))
    problem = inverse.Problem(scene, inverse.Target(ws.Renderer(scene).render()), inverse.Pose(0))
    times: dict[str, list[np.ndarray]] = {"no page": [], "a page that is not open": [], "an open page": []}
    tests = str(Path(__file__).parents[2] / "tests" / "viewer")
    seconds(problem, 3, False)
    for _ in range(rounds):
        times["no page"].append(seconds(problem, iterations, False))
        viewer = inverse.FitViewer(port=0)
        times["a page that is not open"].append(seconds(problem, iterations, viewer))
        viewer.close()
        viewer = inverse.FitViewer(port=0)
        command = [sys.executable, "-c", CLIENT, tests, viewer.url]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as client:
            assert client.stdout is not None
            client.stdout.readline()
            times["an open page"].append(seconds(problem, iterations, viewer))
            client.kill()
        viewer.close()
    alone = np.array(times["no page"])
    for name, each in times.items():
        best, ratio = np.min(each, axis=0), np.median(np.array(each) / alone, axis=0) - 1
        print(
            f"{name}: {1e3 * best[0]:.1f} ms an iteration at best, {ratio[0]:+.1%} at the median; "
            f"{1e3 * best[1]:.1f} ms of a core, {ratio[1]:+.1%}"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5, help="how often each is timed")
    parser.add_argument("--iterations", type=int, default=40, help="of a fit")
    arguments = parser.parse_args()
    main(arguments.rounds, arguments.iterations)
