"""What more cores give an image and an iteration of a pose fit: a simulation from the time of each slice.

    python demos/tools/core_scaling.py [--threads 1,2,4,8,16] [--runs 20] [--kernels]

Each launch that is cut for a number of threads runs its slices here one after another, on one thread, and the CPU time
of each is measured. Then they are dealt out as the pool does: the next to the thread that is free first, where all but
the calling one begin WAKING later. All else, which is Python and launches that cannot be cut, takes the time that it
takes on one thread. So a busy machine with few cores is enough; that threads share caches and memory is left out. The
scene is that of ``make bench``; figures are the least of all runs. ``--kernels`` lists launches that ran as one slice.
"""

import argparse
import collections
import heapq
import sys
import time
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import torch

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.benchmarks.benchmark import iterations
from demos.benchmarks.lane_choice import cpu_text
from demos.scenes import bunny_scene
from warpshadow.device import parallel, warp_internals

WAKING = 0.03  # milliseconds until a thread of the pool begins, of which the calling one spends a third
ROWS = {"image": "image of bodies that have moved", "pose iteration": "iteration of a pose fit in torch"}


def makespan(slices: list[float], threads: int) -> float:
    """Time until the last of some slices is done, dealt out in turn to threads that are free."""
    free = [(WAKING / 3 * (threads - 1), 0)] + [(WAKING, number) for number in range(1, threads)]
    heapq.heapify(free)
    last = 0.0
    for duration in slices:
        start, number = heapq.heappop(free)
        heapq.heappush(free, (start + duration, number))
        last = max(last, start + duration)
    return last


def simulated(function: Callable[[], object], threads: int) -> tuple[float, float]:
    """Milliseconds of a call on a number of threads, and those of it in which only one of them works."""
    cut, shared = 0.0, 0.0

    def share(run: Callable[[int, int], None], slice_count: int, workers: int) -> None:
        nonlocal cut, shared
        slices = []
        for number in range(slice_count):
            start = time.thread_time()
            run(number, 0)
            slices.append(1e3 * (time.thread_time() - start))
        cut += sum(slices)
        shared += makespan(slices, min(workers, slice_count)) if workers > 1 else sum(slices)

    ws.set_thread_count(threads)
    with mock.patch.object(parallel, "_share", share):
        start = time.thread_time()
        function()
        alone = 1e3 * (time.thread_time() - start) - cut
    return alone + shared, alone


def whole_launches(function: Callable[[], object], runs: int) -> dict[tuple[str, int], float]:
    """Least milliseconds of the launches of a call on two threads that are not cut, by kernel and number."""
    times: dict[tuple[str, int], float] = {}
    numbers: collections.Counter[str] = collections.Counter()
    bound_kernel = warp_internals.bound_kernel

    def timed(kernel: object, *arguments: object, **options: object) -> Callable[..., None]:
        launch = bound_kernel(kernel, *arguments, **options)
        label = kernel.key.split("__locals__")[-1] + (", adjoint" if options.get("gradients") else "")

        def run(dim: object, *first: object, **options: object) -> None:
            start = time.thread_time()
            launch(dim, *first, **options)
            if not first:
                key = label, numbers[label]
                numbers[label] += 1
                times[key] = min(times.get(key, 1e9), 1e3 * (time.thread_time() - start))

        return run

    ws.set_thread_count(2)
    with mock.patch.object(warp_internals, "bound_kernel", timed):
        for _ in range(runs):
            numbers.clear()
            function()
    return times


def main(counts: list[int], runs: int, lists_kernels: bool) -> None:
    ws.quiet()
    torch.set_num_threads(1)
    functions = iterations(bunny_scene(), "cpu")
    print(cpu_text())
    print(f"{'':16}{'threads':>8}{'ms':>8}{'of one':>8}{'times':>7}{'uncut':>8}")
    for label, row in ROWS.items():
        function = functions[row]
        for _ in range(4):
            function()
        found = [[simulated(function, count) for count in counts] for _ in range(runs)]
        least = [min(run[k] for run in found) for k in range(len(counts))]
        for count, (total, alone) in zip(counts, least, strict=True):
            ratio = total / least[0][0]
            print(f"{label:16}{count:8}{total:8.1f}{ratio:8.2f}{1 / ratio:7.2f}{alone:8.1f}", flush=True)
    for label, row in ROWS.items() if lists_kernels else ():
        print(f"\n{label}: launches that are not cut on two threads [ms]")
        for (kernel, _), milliseconds in sorted(
            whole_launches(functions[row], runs).items(), key=lambda pair: -pair[1]
        ):
            if milliseconds > 0.1:
                print(f"  {kernel:40}{milliseconds:8.2f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--threads", default="1,2,4,8,16", help="numbers of threads, the first of which others are compared with"
    )
    parser.add_argument("--runs", type=int, default=20, help="runs of each")
    parser.add_argument("--kernels", action="store_true", help="list the launches that are not cut")
    arguments = parser.parse_args()
    main([int(count) for count in arguments.threads.split(",")], arguments.runs, arguments.kernels)
