"""How long many pose fits take on one worker and on two, and that they end alike where processes are killed.

    python demos/benchmarks/many_fits.py [--count 24] [--size 64] [--mesh FILE ...] [--repeats 1] [--kills 10]

Fits are poses of meshes in turn, by default the bunny's, the bear's and the rocks' that ship with Warp, 10° to 40° and
5% to 25% of the diagonal off, on a ground. `warpshadow fit FOLDER` does them with one worker of one thread, then with
two of one thread each.

With --kills, two workers do them undisturbed. Then a Ray cluster of two nodes of one core does them (without the extra
`ray`, two workers) while a worker, the command and a node are killed by turns, at random moments, with SIGKILL. A node
is started again, and the command is given again whenever it has ended. In the end the tables are compared, but for
seconds; and it is checked that no fit was done again whose end was on record.
"""

import argparse
import contextlib
import csv
import importlib.util
import os
import platform
import random
import resource
import secrets
import signal
import socket
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
ENDED = (0, 4)  # exit statuses: all images are explained, or some are not


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


def command(fits: Path, results: Path, *where: str, threads: int = 1) -> subprocess.Popen:
    """Begin to do the fits."""
    line = [sys.executable, "-m", "warpshadow", "fit", fits, "-o", results, *where]
    environment = os.environ | {"WARPSHADOW_NUM_THREADS": str(threads), "PYTHONPATH": str(ROOT)}
    quiet = [*line, "--checkpoint-seconds", "1", "--quiet"]
    return subprocess.Popen(quiet, env=environment, stdout=subprocess.DEVNULL)  # where Ray tells of deaths


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


def kill(victims: list[int]) -> bool:
    """Kill one of some processes; whether there was one."""
    if victims:
        with contextlib.suppress(ProcessLookupError):
            os.kill(random.choice(victims), signal.SIGKILL)
    return bool(victims)


class Workers:
    """Two worker processes of the command."""

    kinds = ("worker", "command")
    where = ("--workers", "2")

    def kill(self, kind: str, process: subprocess.Popen) -> bool:
        """Kill one of a kind, of which there is maybe none now."""
        workers = [child for child, line in descendants(process.pid) if "spawn_main" in line]
        return kill([process.pid] if kind == "command" else workers)

    def mend(self) -> None:
        """Workers are replaced by the command."""

    end = mend


class Cluster:
    """Two nodes of Ray on this machine, each of one core."""

    kinds = ("worker", "command", "other node", "worker", "command", "head node")

    def __init__(self) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.address = f"127.0.0.1:{free.getsockname()[1]}"
        self.where = ("--ray", self.address)
        os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(), "PYTHONPATH": str(ROOT)}
        self.nodes: dict[str, subprocess.Popen] = {}
        self.mend()

    def kill(self, kind: str, process: subprocess.Popen) -> bool:
        """Kill one of a kind, of which there is maybe none now."""
        if kind == "command":
            return kill([process.pid])
        own = [self.nodes[kind]] if kind in self.nodes else self.nodes.values()
        name = "ray::_alone" if kind == "worker" else "raylet/raylet"
        was = kill([child for node in own for child, line in descendants(node.pid) if name in line])
        if kind == "head node":  # the command has an error to tell
            process.wait(180)
        return was

    def mend(self) -> None:
        """Start the nodes that are not running; without a head none is any use."""
        has_head = "head node" in self.nodes and not self._has_died("head node")
        if not has_head:
            self.end()
            port = self.address.rpartition(":")[2]
            self.nodes["head node"] = self._start("--head", "--port", port, "--include-dashboard=false")
        if "other node" not in self.nodes or self._has_died("other node"):
            self.nodes["other node"] = self._start("--address", self.address)

    def end(self) -> None:
        """End all."""
        for node in self.nodes.values():
            node.terminate()
            node.wait()
        self.nodes.clear()

    def _has_died(self, name: str) -> bool:
        node = self.nodes[name]
        return node.poll() is not None or not any("raylet/raylet" in line for _, line in descendants(node.pid))

    @staticmethod
    def _start(*arguments: str) -> subprocess.Popen:
        line = [sys.executable, "-c", "from ray.scripts.scripts import main; main()", "start", "--block", *arguments]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        node = subprocess.Popen([*line, "--num-cpus=1", "--disable-usage-stats"], **pipes)
        if not any("Ray runtime started" in each for each in node.stdout):
            raise ChildProcessError("a node of Ray did not start")
        return node


def do_with_kills(fits: Path, results: Path, kills: int) -> list[str]:
    """Do the fits while processes are killed; the victims."""
    has_ray = importlib.util.find_spec("ray") is not None
    if not has_ray:
        print("no node is killed: Ray is not installed (the extra 'ray')")
    place = Cluster() if has_ray else Workers()
    victims, again = [], False
    process = command(fits, results, *place.where)
    records: dict[Path, int] = {}
    try:
        while True:
            kind = place.kinds[len(victims) % len(place.kinds)]
            wait = random.uniform(0, LONGEST) if len(victims) < kills else None
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(wait)
            if process.poll() is None and place.kill(kind, process):
                victims.append(kind)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(1)
            for record in results.glob("*/ending.json"):
                again = again or records.setdefault(record, record.stat().st_mtime_ns) != record.stat().st_mtime_ns
            place.mend()
            if process.poll() is not None:
                if process.returncode in ENDED:
                    break
                process = command(fits, results, *place.where)
    finally:
        process.kill()
        process.wait()
        place.end()
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
            for workers in (2,) if arguments.kills else (1, 2):
                start, before = time.perf_counter(), processor_seconds()
                process = command(fits, Path(folder, f"{workers}.{repeat}"), "--workers", str(workers), threads=workers)
                assert process.wait() in ENDED
                times.setdefault(workers, []).append(time.perf_counter() - start)
                used, load = processor_seconds() - before, os.getloadavg()[0]
                times_of = f"{times[workers][-1]:6.1f} s, {used:6.1f} s of processors, load {load:.1f}"
                print(f"{workers} worker{'s' * (workers > 1)}: {times_of}", flush=True)
        expected = table(Path(folder, "2.0"))
        if arguments.kills:
            victims = do_with_kills(fits, Path(folder, "killed"), arguments.kills)
            equal = table(Path(folder, "killed")) == expected
            print(f"tables are equal after kills of {', '.join(victims)}: {equal}")
        else:
            print(f"two take {min(times[2]) / min(times[1]):.2f} of one's time")
            print("tables are equal:", table(Path(folder, "1.0")) == expected)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=24, help="fits")
    parser.add_argument("--size", type=int, default=64, help="pixels across and down")
    parser.add_argument("--mesh", type=Path, nargs="*", default=[], help="meshes; by default those that ship with Warp")
    parser.add_argument("--repeats", type=int, default=1, help="times that are measured, of which the least counts")
    parser.add_argument("--kills", type=int, default=0, help="processes that are killed")
    parser.add_argument("--seed", type=int, default=0, help="of the moments of kills")
    main(parser.parse_args())
