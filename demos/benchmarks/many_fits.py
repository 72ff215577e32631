"""How long many pose fits take on one worker and on two, and that they end alike where processes are killed.

    python demos/benchmarks/many_fits.py [--count 24] [--size 64] [--mesh FILE ...] [--repeats 1] [--kills 10]

Fits are poses of meshes in turn, by default the bunny's, the bear's and the rocks' that ship with Warp, 10° to 40° and
5% to 25% of the diagonal off, on a ground. `warpshadow fit FOLDER` does them with one worker of one thread, then with
two of one thread each. With --kills, another folder gets them while workers and the command are killed by turns, at
random moments, with SIGKILL; the command is given again whenever it has ended. In the end the tables are compared, but
for seconds; and it is checked that no fit was done again whose end was on record.
"""

import argparse
import contextlib
import csv
import os
import platform
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.problems import body_on_ground, changed, displaced, placement
from demos.scenes import shipped_mesh
from warpshadow.spheres import fit_spheres

ROOT = Path(__file__).parents[2]
FIT = 'scene = "scene.toml"\nstages = "pose"\n[[target]]\nimage = "photo.exr"\n[[free.pose]]\nbody = 0\n'
LONGEST = 20.0  # until a kill [s]


def write_fits(folder: Path, meshes: list[ws.Mesh], count: int, size: int) -> None:
    """Write fit files, each with a scene and a target of its own."""
    spheres = [fit_spheres(mesh).spheres for mesh in meshes]
    for number in range(count):
        which = number % len(meshes)
        truth = changed(body_on_ground(meshes[which], ws.synthetic_sky(), size), 0, blockers=spheres[which])
        start = displaced(truth.bodies[0], np.random.default_rng(number))
        own = folder / f"{number:02}"
        ws.write_scene(changed(truth, 0, **placement(start)), own)
        ws.write_image(own / "photo.exr", ws.render(truth))
        (own / "fit.toml").write_text(FIT)


def command(fits: Path, results: Path, workers: int) -> subprocess.Popen:
    """Begin to do the fits."""
    line = [sys.executable, "-m", "warpshadow", "fit", fits, "-o", results, "--workers", str(workers)]
    environment = os.environ | {"WARPSHADOW_NUM_THREADS": str(workers), "PYTHONPATH": str(ROOT)}
    return subprocess.Popen([*line, "--checkpoint-seconds", "1", "--quiet"], env=environment)


def processor_seconds() -> float:
    """Time that processors gave to the commands so far, which depends less on what else runs [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def table(results: Path) -> list[dict[str, str]]:
    """The table of results, without seconds."""
    with (results / "table.csv").open(newline="") as file:
        return [{name: value for name, value in row.items() if name != "seconds"} for row in csv.DictReader(file)]


# ------------------------------------------------------------------------------------------------ kills


def descendants(process: int) -> Iterator[tuple[int, str]]:
    """Processes that a process started, and those that they started, with their command lines."""
    listed = subprocess.run(["ps", "-o", "pid=,args=", "--ppid", str(process)], capture_output=True, text=True).stdout
    for line in listed.splitlines():
        child, _, arguments = line.strip().partition(" ")
        yield int(child), arguments
        yield from descendants(int(child))


def kill_one(head: int, victim: str) -> bool:
    """Kill a process by what it is; whether there was one."""
    workers = [child for child, line in descendants(head) if "spawn_main" in line]
    found = [head] if victim == "command" else workers
    if found:
        with contextlib.suppress(ProcessLookupError):
            os.kill(random.choice(found), signal.SIGKILL)
    return bool(found)


def do_with_kills(fits: Path, results: Path, kills: int) -> list[str]:
    """Do the fits while processes are killed; the victims."""
    victims, kinds, again = [], ["worker", "command"], False
    head = command(fits, results, 2)
    records: dict[Path, int] = {}
    try:
        while True:
            wait = random.uniform(0, LONGEST) if len(victims) < kills else None
            with contextlib.suppress(subprocess.TimeoutExpired):
                head.wait(wait)
            if head.poll() is None and kill_one(head.pid, kinds[len(victims) % len(kinds)]):
                victims.append(kinds[len(victims) % len(kinds)])
                with contextlib.suppress(subprocess.TimeoutExpired):
                    head.wait(0.1 if victims[-1] == "worker" else 120)
            for record in results.glob("*/ending.json"):
                again = again or records.setdefault(record, record.stat().st_mtime_ns) != record.stat().st_mtime_ns
            if head.poll() is not None:
                if head.returncode == 0:
                    break
                head = command(fits, results, 2)
    finally:
        head.kill()
        head.wait()
    if again:
        raise AssertionError("a fit was done again whose end was on record")
    return victims


def main(arguments: argparse.Namespace) -> None:
    ws.quiet()
    random.seed(arguments.seed)
    shipped = [shipped_mesh(name) for name in ("bunny", "bear", "rocks")]
    meshes = [ws.load_mesh(file) for file in arguments.mesh] or shipped
    with tempfile.TemporaryDirectory() as folder:
        fits, times = Path(folder, "fits"), {}
        fits.mkdir()
        write_fits(fits, meshes, arguments.count, arguments.size)
        print(f"{arguments.count} fits, {platform.machine()}, {os.cpu_count()} cores")
        for repeat in range(arguments.repeats):
            for workers in (1, 2):
                start, before = time.perf_counter(), processor_seconds()
                assert command(fits, Path(folder, f"{workers}.{repeat}"), workers).wait() == 0
                times.setdefault(workers, []).append(time.perf_counter() - start)
                used, load = processor_seconds() - before, os.getloadavg()[0]
                times_of = f"{times[workers][-1]:6.1f} s, {used:6.1f} s of processors, load {load:.1f}"
                print(f"{workers} worker{'s' * (workers > 1)}: {times_of}", flush=True)
        print(f"two take {min(times[2]) / min(times[1]):.2f} of one's time")
        expected = table(Path(folder, "1.0"))
        print("tables are equal:", table(Path(folder, "2.0")) == expected)
        if arguments.kills:
            victims = do_with_kills(fits, Path(folder, "killed"), arguments.kills)
            equal = table(Path(folder, "killed")) == expected
            print(f"tables are equal after kills of {', '.join(victims)}: {equal}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=24, help="fits")
    parser.add_argument("--size", type=int, default=64, help="pixels across and down")
    parser.add_argument("--mesh", type=Path, nargs="*", default=[], help="meshes; by default those that ship with Warp")
    parser.add_argument("--repeats", type=int, default=1, help="times that are measured, of which the least counts")
    parser.add_argument("--kills", type=int, default=0, help="processes that are killed")
    parser.add_argument("--seed", type=int, default=0, help="of the moments of kills")
    main(parser.parse_args())
