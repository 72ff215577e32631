"""What a page costs a fit: time of an iteration with and without `view=`.

    python demos/benchmarks/fit_view.py [--rounds 5] [--iterations 40]

The same fit of the bunny's pose runs without a page, with a page that nobody opened, and with one that a client of
viser's wire format takes pictures from (a process of its own, like a browser), in turns. For each round the total time
of its iterations is compared with that of the same round without a page.
"""

import argparse
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


def seconds(problem: inverse.Problem, iterations: int, view: bool | inverse.FitViewer) -> float:
    """Time from the first iteration to the end."""
    began: list[float] = []

    class Adam(torch.optim.Adam):
        """Notes when it takes its first step."""

        def step(self, closure):  # type: ignore[override,no-untyped-def]
            if not began:
                began.append(time.perf_counter())
            return super().step(closure)

    inverse.fit(problem, [inverse.Stage(iterations, 1e-4)], optimizer=Adam, tolerance=0, view=view, progress=False)
    return time.perf_counter() - began[0]


def main(rounds: int, iterations: int) -> None:
    ws.quiet()
    scene = on_ground(shipped_mesh("bunny"), ws.synthetic_sky())
    problem = inverse.Problem(scene, inverse.Target(ws.render(scene)), inverse.Pose(0))
    times: dict[str, list[float]] = {"no page": [], "a page that is not open": [], "an open page": []}
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
    first = np.array(times["no page"])
    for name, each in times.items():
        ratio = np.median(np.array(each) / first)
        print(f"{name}: {1e3 * min(each) / iterations:.2f} ms an iteration at best, {ratio - 1:+.1%} at the median")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5, help="how often each is timed")
    parser.add_argument("--iterations", type=int, default=40, help="of a fit")
    arguments = parser.parse_args()
    main(arguments.rounds, arguments.iterations)
