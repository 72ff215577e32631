"""What a GPU computes and how fast, beside this machine's CPU: one table to paste, and the same as JSON.

    make gpu      or      python demos/benchmarks/gpu_report.py [--devices cuda:0] [--folder out/gpu]

For each device, in this order:

- images and all gradients of a small scene, against those of the CPU, with every method;
- every test that takes a device, in a process a core but one;
- the launches of the first part under compute-sanitizer, for memory and for races, where it is on the path;
- kernels of a pose iteration, timed by CUDA's events, beside the least that an H200 would take for all of them;
- images and pose iterations in Warp, as calls and as CUDA graphs;
- many poses in a call;
- the benchmark, on the device and on the CPU.

It needs no network, and ends within ten minutes. The exit status is 1 if anything is wrong; a test that was not reached
is. ``--devices cpu`` tries it where there is no GPU.
"""

import argparse
import dataclasses
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
import torch
import warp as wp

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.benchmarks import benchmark
from demos.benchmarks.lane_choice import cpu_text
from demos.examples.warp_loop import FreePose, compare
from demos.scenes import bunny_scene
from demos.tools import kernel_floor
from warpshadow.device.cuda_graph import Captured, with_gradients
from warpshadow.torch import TorchRenderer, rotation_matrices
from warpshadow.tuning.timing import median_times

ROOT = Path(__file__).parents[2]

AGREEMENT = 1e-4
"""Largest relative L2 difference between devices that is taken for rounding."""

SECONDS = 570
"""Time for all of it."""

SHARES = {"tests": 0.6, "sanitizer": 0.3, "benchmark": 0.8}
"""Largest share of the remaining time for a part."""

CASES = [
    *((method, "vertex") for method in ("directional", "log-sh", "none", "ray-traced")),
    ("directional", "pixel"),
    ("log-sh", "pixel"),
]
"""Methods, and the ground's receivers, that are compared."""

POSE_ITERATION = "iteration of a pose fit in torch"
"""What the benchmark calls it."""

SHOWN_KERNELS = 12
"""Kernels of an iteration that the table lists, the longest first."""


# ------------------------------------------------------------------------------------------------ agreement


def small_scene(method: str, receivers: str) -> ws.Scene:
    """Two bodies on a textured ground, large enough for slices, silhouettes and every kind of receiver."""
    rng = np.random.default_rng(0)

    def body(x: float, albedo: tuple[float, float, float]) -> ws.Body:
        spheres = ws.Spheres(rng.uniform(-0.3, 0.3, (20, 3)), rng.uniform(0.2, 0.35, 20))
        return ws.Body(ws.icosphere(0.5, 3), albedo=albedo, blockers=spheres, translation=(x, 0.6, 0))

    ground = ws.Body(ws.plane(4.0, 24), texture=rng.uniform(0.1, 0.9, (16, 16, 3)), blockers=0, receivers=receivers)
    camera = ws.Camera.look_at((0.3, 2.0, 3.5), (0, 0.4, 0), size=(48, 40))
    visibility = ws.Visibility.of({"method": method, "samples": 64})
    return ws.Scene(
        (body(-0.6, (0.8, 0.5, 0.3)), body(0.6, (0.2, 0.6, 0.7)), ground), ws.synthetic_sky(), camera, visibility
    )


def image_and_gradients(scene: ws.Scene, device: str) -> dict[str, np.ndarray]:
    """An image of the scene, and what a fixed weighting of it has as gradients to all that may be free."""
    torch_device = torch.device("cpu" if device == "cpu" else device)

    def random(*shape: int, seed: int, scale: float = 1.0) -> torch.Tensor:
        return (scale * torch.rand(shape, generator=torch.Generator().manual_seed(seed))).to(torch_device)

    renderer = TorchRenderer(scene, device=torch_device)
    free = {
        "light": random(renderer.basis.size, 3, seed=1),
        "albedo": random(3, seed=2),
        "texture": random(16, 16, 3, seed=3),
    }
    rotations, translations, scales = renderer.scene_poses()
    method, body = scene.visibility.method, scene.bodies[0]
    moves = method != "ray-traced"  # rays have no derivative
    if moves:
        free |= {"turns": random(3, 3, seed=4, scale=0.2), "translations": translations, "scales": scales}
        free |= {
            "positions": torch.tensor(body.mesh.positions),
            "clip matrix": torch.tensor(scene.camera.clip_matrix()),
        }
    if method in ("directional", "log-sh"):
        free |= {"centers": torch.tensor(body.blockers.centers), "radii": torch.tensor(body.blockers.radii)}
    free = {name: value.to(torch_device, torch.float32, copy=True).requires_grad_() for name, value in free.items()}
    geometry = None
    if moves:
        rest = renderer.deformed(0, free["positions"], free.get("centers"), free.get("radii"))
        turned = rotation_matrices(free["turns"]) @ rotations
        geometry = renderer.placed(turned, free["translations"], free["scales"], rest=rest)
    image = renderer(
        free["light"],
        albedo=[free["albedo"], None, None],
        textures=[None, None, free["texture"]],
        geometry=geometry,
        clip_matrices=free.get("clip matrix"),
    )
    (image * random(*image.shape, seed=5)).sum().backward()
    results = {"image": image} | {name: value.grad for name, value in free.items()}
    return {name: value.detach().cpu().numpy() for name, value in results.items()}


def agreement(device: str) -> Iterator[tuple[str, str, float]]:
    """Relative L2 differences from the CPU: method and receivers, what, how much."""
    for method, receivers in CASES:
        scene = small_scene(method, receivers)
        expected, got = image_and_gradients(scene, "cpu"), image_and_gradients(scene, device)
        for name, value in expected.items():
            yield f"{method}, {receivers} receivers", name, relative(got[name], value)


def relative(got: np.ndarray, expected: np.ndarray) -> float:
    """Relative L2 difference; infinite where either is not finite."""
    if not (np.isfinite(got).all() and np.isfinite(expected).all()):
        return float("inf")
    scale = np.linalg.norm(expected.astype(float))
    return float(np.linalg.norm(got.astype(float) - expected) / scale) if scale else float(np.abs(got).max())


# ------------------------------------------------------------------------------------------------ other parts


def sanitize(device: str, seconds: float) -> str:
    """Launch some of what :func:`agreement` launches under compute-sanitizer, and say how that ended."""
    executable = shutil.which("compute-sanitizer")
    if executable is None or not device.startswith("cuda"):
        return "left out: " + ("compute-sanitizer is not on the path" if executable is None else "not a CUDA device")
    script = f"from demos.benchmarks.gpu_report import *; [image_and_gradients(small_scene(m, 'vertex'), {device!r})"
    script += " for m in ('directional', 'log-sh', 'ray-traced')]"
    for tool in ("memcheck", "racecheck"):
        command = [executable, "--tool", tool, "--error-exitcode", "9", sys.executable, "-c", script]
        try:
            run = subprocess.run(command, cwd=ROOT, timeout=seconds / 2, capture_output=True, text=True)
        except subprocess.TimeoutExpired:
            return f"left out: {tool} was not done after {seconds / 2:.0f} s"
        if run.returncode:
            return f"{tool} failed ({run.returncode}): " + " ".join((run.stdout + run.stderr).split())[-600:]
    return "clean"


class KernelTimes(NamedTuple):
    """Kernels and copies of an iteration by CUDA's events, the longest first."""

    iteration: str
    kernels: list[tuple[str, int, float]]  # name, launches, milliseconds of all of them


def kernel_times(device: str, runs: int = 3) -> list[KernelTimes]:
    """Times of the kernels of pose iterations of the bunny scene, without and with bounces; none on a CPU."""
    times = []
    for bounces in (0, 2) if wp.get_device(device).is_cuda else ():
        scene = dataclasses.replace(bunny_scene(), bounces=bounces)
        iterate = benchmark.iterations(scene, device)[POSE_ITERATION]
        for _ in range(3):
            iterate()
        wp.timing_begin(cuda_filter=wp.TIMING_ALL)
        for _ in range(runs):
            iterate()
        each: dict[str, list[float]] = {}
        for activity in wp.timing_end():
            each.setdefault(activity.name, []).append(activity.elapsed)
        kernels = [(name, len(values) // runs, sum(values) / runs) for name, values in each.items()]
        label = POSE_ITERATION + benchmark.BOUNCED * bool(bounces)
        times.append(KernelTimes(label, sorted(kernels, key=lambda kernel: -kernel[2])))
    return times


def least_milliseconds() -> float:
    """The least that an H200 takes for a pose iteration of the bunny scene, by its operations and bytes."""
    size, rising, reached = kernel_floor.measure(bunny_scene())
    return 1e3 * kernel_floor.iteration_floor(kernel_floor.stages(size, rising, reached), size, 1)


def captured(device: str, runs: int = 20) -> dict[str, tuple[float, float]]:
    """Milliseconds of a pose iteration in Warp, and of an image: as calls, and replayed as one CUDA graph each."""
    times = {}
    for bounces, words in ((0, ""), (2, benchmark.BOUNCED)):
        renderer = ws.Renderer(dataclasses.replace(bunny_scene(), bounces=bounces), device=device)
        pose = FreePose(renderer)
        target = wp.clone(pose.draw(), requires_grad=False)
        variables = [pose.turn, pose.translation]
        functions: dict[str, Callable[[], object]] = {
            "image": pose.draw,
            "pose iteration": with_gradients(lambda pose=pose, target=target: compare(pose.draw(), target), variables),
        }
        for label, function in functions.items():
            graph = Captured(function, device)
            times[f"{label}{words}"] = tuple(median_times([function, graph], runs))
    return times


def batches(device: str, size: int = 64) -> dict[int, tuple[float, float]]:
    """Milliseconds for each of many moved poses in a call, images of size², alone and with their gradient, by count."""
    scene = bunny_scene()
    camera = scene.camera.resized(size / scene.camera.width)
    renderer = TorchRenderer(dataclasses.replace(scene, camera=camera), device=device)
    rotations, translations, scales = renderer.scene_poses()
    times = {}
    for count in (1, 8, 64):
        moved = translations.repeat(count, 1, 1)
        moved[:, 0] += 0.05 * torch.randn(count, 3, generator=torch.Generator().manual_seed(0)).to(moved.device)
        batch = rotations.expand(count, *rotations.shape), moved.requires_grad_(), scales

        def draw(batch: tuple = batch) -> torch.Tensor:
            return renderer(geometry=renderer.placed(*batch))

        functions = torch.no_grad()(draw), lambda draw=draw: draw().square().mean().backward()
        times[count] = tuple(milliseconds / count for milliseconds in median_times(functions, 5))
    return times


def run_tests(device: str, seconds: float, folder: Path) -> dict[str, int | list[str]]:
    """Run every test that takes a device; what was not reached in time is counted."""
    report = folder / f"tests_{device.replace(':', '_')}.xml"
    command = [sys.executable, "-m", "pytest", "--devices", device, "-p", "no:cacheprovider"]
    listed = subprocess.run([*command, "--collect-only", "-q"], cwd=ROOT, capture_output=True, text=True).stdout
    total = sum(int(line.rpartition(": ")[2]) for line in listed.splitlines() if re.match(r"\S+\.py: \d+$", line))
    command += ["--seconds", str(int(seconds)), f"--junitxml={report}"]
    if importlib.util.find_spec("xdist"):
        command += ["--numprocesses", str(max(1, (os.cpu_count() or 1) - 1)), "--dist", "loadfile"]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if not report.exists():
        return {"passed": 0, "failed": [f"pytest: {(run.stdout + run.stderr)[-600:]}"], "skipped": 0, "not reached": 0}
    cases = list(ElementTree.parse(report).iter("testcase"))
    failed = [case for case in cases if case.find("failure") is not None or case.find("error") is not None]
    skipped = [case for case in cases if case.find("skipped") is not None]
    return {
        "passed": len(cases) - len(failed) - len(skipped),
        "failed": [f"{case.get('classname')}.{case.get('name')}" for case in failed],
        "skipped": len(skipped),
        "not reached": max(0, total - len(cases)),
    }


def report(device: str, folder: Path, seconds: float) -> dict:
    """All parts for one device."""
    end = time.monotonic() + seconds

    def left(part: str = "") -> float:
        return SHARES.get(part, 1.0) * (end - time.monotonic())

    result: dict = {"device": wp.get_device(device).name, "alias": device}

    def part(name: str, function: Callable[[], object]) -> None:
        print(f"{device}: {name} …", file=sys.stderr, flush=True)
        start = time.monotonic()
        try:
            result[name] = function()
        except Exception as error:  # the other parts are worth having, and this one is reported
            result[name] = {"error": f"{type(error).__name__}: {error}"}
        print(f"  {time.monotonic() - start:.0f} s", file=sys.stderr)

    part("agreement", lambda: list(agreement(device)))
    part("tests", lambda: run_tests(device, left("tests"), folder))
    part("sanitizer", lambda: sanitize(device, left("sanitizer")))
    part("kernels", lambda: kernel_times(device))
    part("captured", lambda: captured(device))
    part("batches", lambda: batches(device))
    part("benchmark", lambda: {name: benchmark.measure(name, left("benchmark") / 4) for name in ("cpu", device)})
    return result


def faults(result: dict) -> list[str]:
    """What is wrong in a report."""
    wrong = [f"{name}: {part['error']}" for name, part in result.items() if isinstance(part, dict) and "error" in part]
    if isinstance(result["agreement"], list):
        wrong += [
            f"{case}: {name} differs by {error:.1e}" for case, name, error in result["agreement"] if error > AGREEMENT
        ]
    if result["sanitizer"] not in ("clean",) and not str(result["sanitizer"]).startswith("left out"):
        wrong.append(f"sanitizer: {result['sanitizer']}")
    if result["tests"].get("not reached"):
        wrong.append(f"tests: {result['tests']['not reached']} were not reached")
    return wrong + list(result["tests"].get("failed", []))


# ------------------------------------------------------------------------------------------------ table


def table(result: dict) -> str:
    """A device's report in Markdown."""
    lines = [f"### {result['device']} ({result['alias']}) beside {cpu_text().splitlines()[0]}", ""]
    for name, part in result.items():
        if isinstance(part, dict) and "error" in part:
            lines += [f"{name}: {part['error']}", ""]
    if isinstance(result["agreement"], list):
        worst: dict[str, tuple[float, str, float]] = {}
        for case, name, error in result["agreement"]:
            image = error if name == "image" else worst[case][0]
            _, at, most = worst.get(case, (0.0, "", -1.0))
            worst[case] = (image, name, error) if name != "image" and error > most else (image, at, most)
        lines += ["| relative L2 difference from the CPU | image | worst gradient |", "| --- | --- | --- |"]
        lines += [f"| {case} | {image:.1e} | {error:.1e} ({at}) |" for case, (image, at, error) in worst.items()]
        lines += [""]
    lines += [f"compute-sanitizer: {result['sanitizer']}", ""]
    for times in result["kernels"] if isinstance(result["kernels"], list) else ():
        launches, total = (sum(kernel[k] for kernel in times.kernels) for k in (1, 2))
        lines += [f"| {times.iteration} | launches | ms |", "| --- | --- | --- |"]
        lines += [f"| {name} | {count} | {ms:.3f} |" for name, count, ms in times.kernels[:SHOWN_KERNELS]]
        lines += [f"| all | {launches} | {total:.3f} |", ""]
    if result["kernels"]:
        lines += [f"At the least, an H200 takes {least_milliseconds():.2f} ms without bounces.", ""]
    if "error" not in result["captured"]:
        lines += ["| in Warp, ms | as calls | as a CUDA graph |", "| --- | --- | --- |"]
        lines += [f"| {label} | {calls:.2f} | {graph:.2f} |" for label, (calls, graph) in result["captured"].items()]
        lines += [""]
    if "error" not in result["batches"]:
        lines += ["| moved poses in a call, 64², ms for each | image | with its gradient |", "| --- | --- | --- |"]
        lines += [f"| {count} | {image:.2f} | {both:.2f} |" for count, (image, both) in result["batches"].items()]
        lines += [""]
    if "error" not in result["benchmark"]:
        columns = list(result["benchmark"])
        lines += ["| benchmark, ms | " + " | ".join(columns) + " |", "| --- |" + " --- |" * len(columns)]
        for label in result["benchmark"][columns[0]]:
            lines += [f"| {label} | " + " | ".join(f"{result['benchmark'][at][label]:.2f}" for at in columns) + " |"]
        lines += [""]
    if "error" not in result["tests"]:
        tests = result["tests"]
        lines += [
            f"tests that take a device: {tests['passed']} passed, {len(tests['failed'])} failed, "
            f"{tests['skipped']} skipped, {tests['not reached']} not reached"
        ]
    lines += ["", *(f"**wrong:** {fault}" for fault in faults(result))]
    return "\n".join(lines).rstrip()


def main(devices: list[str], folder: Path) -> int:
    ws.quiet()
    wp.init()
    devices = devices or [device.alias for device in wp.get_cuda_devices()]
    if not devices:
        print("There is no CUDA device here; --devices cpu tries the report on the CPU.")
        return 1
    folder.mkdir(parents=True, exist_ok=True)
    results = [report(device, folder, SECONDS / len(devices)) for device in devices]
    (folder / "report.json").write_text(json.dumps(results, indent=1) + "\n")
    text = "\n\n".join(map(table, results))
    (folder / "report.md").write_text(text + "\n")
    print(text)
    return 1 if any(map(faults, results)) else 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--devices", nargs="+", default=[], help="all CUDA devices by default")
    parser.add_argument("--folder", type=Path, default=Path("out/gpu"), help="where report.json and report.md go")
    arguments = parser.parse_args()
    sys.exit(main(arguments.devices, arguments.folder))
