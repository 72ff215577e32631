"""Time kernels at other numbers of lanes and other register widths than those that the CPU is given.

    python demos/benchmarks/lane_choice.py

Directional visibility, log-SH and exponentiation, forward and backward, of the bunny scene's receivers and spheres, on
one thread; its processor time, least of several runs, so that other work on the machine counts little. Each choice has
a process of its own. The exit status is 1 if the choice that is made for this CPU is 15% slower than the best.
"""

import argparse
import itertools
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import warp as wp

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.scenes import bunny_scene
from warpshadow.device import lanes
from warpshadow.stages import accumulate, exponentiate, transmittance, vertex_normals

SLACK = 1.15
"""Times the best choice's time that the chosen one may take."""

RUNS = 9


def cpu_text() -> str:
    """The CPU, the lanes and the compiler's flags that follow from it."""
    named = [line for line in _cpuinfo() if line.startswith("model name")]
    model = named[0].partition(":")[2].strip() if named else platform.processor() or platform.machine()
    count = lanes.lane_count("cpu")
    cores = f"{ws.thread_count()} threads of {os.cpu_count()} cores"
    return f"{model} ({lanes.cpu_name()}), {cores}\n{count} lanes, {lanes.compiler_flags(count)}"


def _cpuinfo() -> list[str]:
    try:
        return Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return []


def time_stages(runs: int = RUNS) -> dict[str, float]:
    """Processor time of each stage, forward and backward, at the lanes that the environment says [ms]."""
    ws.quiet()
    ws.set_thread_count(1)
    renderer = ws.Renderer(bunny_scene(), device="cpu")
    positions, centers, radii = renderer.geometry().arrays().values()
    order = renderer.merged_scene.vertex_order
    normals = vertex_normals(positions, renderer.merged_scene.faces).numpy()[:, order]
    points, normals = (wp.array(a, dtype=wp.vec3, device="cpu") for a in (positions.numpy()[:, order], normals))
    scene = points, normals, centers, radii
    log = accumulate(*scene, order=8)
    stages: dict[str, tuple[Callable[..., wp.array], Sequence[wp.array]]] = {
        "directional": (lambda *variables: transmittance(*variables, ws.fibonacci(128)), scene),
        "log-SH": (lambda *variables: accumulate(*variables, order=8), scene),
        "exponentiation": (exponentiate, [log]),
    }
    best = dict.fromkeys(stages, float("inf"))
    for _ in range(runs + 1):  # the first compiles
        for name, (function, values) in stages.items():
            variables = [wp.clone(value, requires_grad=True) for value in values]
            start = time.thread_time()
            with wp.Tape() as tape:
                result = function(*variables)
            result.grad.fill_(1.0)
            tape.backward()
            best[name] = min(best[name], 1e3 * (time.thread_time() - start))
    return best


def compare() -> bool:
    """Print what each choice takes; whether the chosen one is as good as the best, but for the slack."""
    ws.quiet()
    wp.init()
    chosen = lanes.lane_count("cpu"), lanes.register_bits()
    print(cpu_text())
    widths = [bits for bits in lanes.REGISTER_BITS if bits <= chosen[1]]
    totals: dict[tuple[int, int], float] = {}
    print(
        "  lanes  bits" + "".join(f"{name:>16}" for name in ("directional", "log-SH", "exponentiation", "total [ms]"))
    )
    for count, bits in itertools.product(sorted({4, 8, 16, chosen[0]}), widths):
        times = _time_choice(count, bits).values()
        totals[count, bits] = sum(times)
        cells = "".join(f"{milliseconds:16.1f}" for milliseconds in (*times, totals[count, bits]))
        print(f"{count:7}{bits:6}{cells}{'  chosen' if (count, bits) == chosen else ''}", flush=True)
    ratio = totals[chosen] / min(totals.values())
    print(f"the choice takes {ratio:.2f} times as long as the best")
    return ratio <= SLACK


def _time_choice(count: int, bits: int) -> dict[str, float]:
    environment = os.environ | {lanes.LANES_VARIABLE: str(count), lanes.BITS_VARIABLE: str(bits)}
    run = subprocess.run(
        [sys.executable, __file__, "--one"], env=environment, capture_output=True, text=True, check=True
    )
    return json.loads(run.stdout.splitlines()[-1])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--one", action="store_true", help="time only what the environment chooses; print JSON")
    if parser.parse_args().one:
        print(json.dumps(time_stages()))
    else:
        sys.exit(0 if compare() else 1)
