"""How time grows with vertices, spheres, pixels, bodies and instances of a batch, and what memory each size takes.

    python demos/benchmarks/scaling.py [--curves vertices spheres pixels bodies batch] [--most 1000000] [--runs 5]
    python demos/benchmarks/scaling.py --million

Sizes take turns, and figures are medians, so that a slow moment of the machine strikes all alike. The exponent p of
time ∝ size^p is printed as fitted to all sizes and between the last two, where the costs that do not grow are small
beside those that do; and with it what ten times the size would cost. Memory is what the first call takes on top of what
the process has before it (Linux only). All is drawn in OUTPUT/scaling.png. ``--most`` leaves out larger sizes.

vertices   a ball of 64 spheres on a ground, half of the vertices each, 256 × 256 pixels
spheres    the bunny scene of scenes.py with fits of stage 1 (the first run fits them: 3 min)
pixels     the bunny scene with 64 spheres
bodies     balls of 642 vertices and 16 spheres on a ground, side by side
batch      poses of a ball of 642 vertices and 16 spheres, 64 × 64 pixels

"Visibility and shading" is of all vertices, "image" all of it from a scene with known spheres, set-up included, and
"iteration" that of a pose fit in torch, forward and backward. ``--million`` renders an image of a million vertices and
256 spheres at 1024 × 1024 pixels and goes back from it to the pose, with the most memory that the process ever had.
"""

import argparse
import ctypes
import dataclasses
import gc
import resource
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import warp as wp

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.scenes import bunny_scene, on_ground, shipped_mesh
from warpshadow.torch import TorchRenderer
from warpshadow.tuning.timing import median_times

Timed = dict[str, Callable[[], object]]

_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")

# ------------------------------------------------------------------------------------------------- scenes


def ball(subdivisions: int, sphere_count: int, **place) -> ws.Body:
    """A ball of radius 1 that is filled by spheres of 0.35."""
    spheres = ws.Spheres(0.65 * ws.fibonacci(sphere_count), np.full(sphere_count, 0.35))
    return ws.Body(ws.icosphere(1.0, subdivisions), blockers=spheres, **place)


def ball_scene(subdivisions: int, sphere_count: int, size: int) -> ws.Scene:
    """A ball on a ground of as many vertices."""
    body = ball(subdivisions, sphere_count)
    ground = ws.Body(ws.plane(6.0, round(body.mesh.vertex_count**0.5) - 1), blockers=0)
    scene = on_ground(body.mesh, ws.synthetic_sky(), blockers=body.blockers, ground=ground)
    return dataclasses.replace(scene, camera=scene.camera.resized(size / scene.camera.width), supersampling=1)


def crowded_scene(supersampling: int) -> ws.Scene:
    """Balls in rows and columns on a ground of 6 units."""
    places = (np.arange(supersampling) + 0.5) * 6 / supersampling - 3
    scale = 2.4 / supersampling
    balls = tuple(ball(3, 16, scale=scale, translation=(x, scale, z)) for x in places for z in places)
    scene = ball_scene(3, 16, 256)
    return dataclasses.replace(scene, bodies=(*balls, scene.bodies[1]))


def bunny_spheres(count: int) -> ws.Spheres:
    """Spheres that cover the bunny, hardly refined, which takes a moment."""
    return ws.fit_spheres(shipped_mesh("bunny"), count, steps=1, warns=False).spheres


def bunny_with(spheres: ws.Spheres, size: int = 256) -> ws.Scene:
    """The bunny scene with other spheres and another image size."""
    scene = bunny_scene()
    bunny, ground = scene.bodies
    bodies = (dataclasses.replace(bunny, blockers=spheres), ground)
    return dataclasses.replace(scene, bodies=bodies, camera=scene.camera.resized(size / scene.camera.width))


# ------------------------------------------------------------------------------------------------- what is timed


def shading(scene: ws.Scene) -> Timed:
    """Visibility and shading of all vertices, by themselves and with all gradients."""
    renderer = ws.Renderer(scene)
    own, merged_scene = renderer.geometry(), renderer.merged_scene
    vertices, places = np.unique(merged_scene.faces.numpy(), return_index=True)
    order = merged_scene.vertex_order[np.isin(merged_scene.vertex_order, vertices)]  # in which renderers light them, …
    order = order[np.argsort(merged_scene.body_of_vertex[order], kind="stable")]  # … a body after another
    places = places[np.searchsorted(vertices, order)]
    given = places // 3, np.eye(3, dtype=np.float32)[places % 3]
    free = [wp.clone(array, requires_grad=True) for array in (own.positions, own.centers, own.radii)]

    def forward_and_backward() -> None:
        with wp.Tape() as tape:
            geometry = ws.Geometry(*free, rotations=own.rotations)
            result = renderer.shade(view=renderer.on_faces(*given, geometry))
        result.grad.fill_(1.0)
        tape.backward()
        tape.zero()

    return {
        "visibility and shading": lambda: renderer.shade(view=renderer.on_faces(*given)),
        "… and back": forward_and_backward,
    }


def image(scene: ws.Scene) -> Timed:
    """The whole image from the scene."""
    return {"image": lambda: ws.Renderer(scene).render()}


def iteration(scene: ws.Scene, count: int = 1) -> Timed:
    """An iteration of a pose fit in torch, of a batch of poses."""
    renderer = TorchRenderer(scene)
    rotations, translations, scales = renderer.scene_poses()
    rotations = rotations.expand(count, *rotations.shape)
    translations = translations.repeat(count, 1, 1).requires_grad_()

    def iterate() -> None:
        renderer(geometry=renderer.placed(rotations, translations, scales)).square().sum().backward()

    return {"iteration": iterate}


class Curve(NamedTuple):
    """What grows, to which sizes, and what is timed at a size."""

    sizes: tuple[int, ...]
    prepare: Callable[[int], Timed]


def _at_vertices(count: int) -> Timed:
    scene = ball_scene(round(np.log(count / 20) / np.log(4)), 64, 256)
    return shading(scene) | image(scene)


def _at_spheres(count: int) -> Timed:
    scene = bunny_with(bunny_spheres(count))
    return shading(scene) | image(scene)


CURVES = {
    "vertices": Curve(tuple(2 * (10 * 4**s + 2) for s in range(3, 9)), _at_vertices),
    "spheres": Curve(tuple(2**k for k in range(4, 11)), _at_spheres),
    "pixels": Curve(tuple(4**k for k in range(7, 12)), lambda n: image(bunny_with(bunny_spheres(64), round(n**0.5)))),
    "bodies": Curve(tuple(k * k for k in (1, 2, 4, 7, 10)), lambda n: image(crowded_scene(round(n**0.5)))),
    "batch": Curve(tuple(2**k for k in range(7)), lambda n: iteration(ball_scene(3, 16, 64), n)),
}


# ------------------------------------------------------------------------------------------------- measures


class Point(NamedTuple):
    """What a size takes."""

    size: int
    milliseconds: float
    mebibytes: float


def measure(curve: Curve, most: int, runs: int) -> dict[str, list[Point]]:
    """Time and memory of each thing that is timed, at each size up to the largest that is wanted."""
    sizes = [size for size in curve.sizes if size <= most]
    for function in curve.prepare(sizes[0]).values():
        function()  # compiles, which takes memory, too
    memory, functions = {}, {}
    for size in sizes:
        for name, function in curve.prepare(size).items():
            memory[name, size] = added_mebibytes(function)
            functions[name, size] = function
    times = median_times(list(functions.values()), runs)
    rows: dict[str, list[Point]] = {}
    for (name, size), milliseconds in zip(functions, times, strict=True):
        rows.setdefault(name, []).append(Point(size, milliseconds, memory[name, size]))
    return rows


def added_mebibytes(function: Callable[[], object]) -> float:
    """The most memory that a call takes on top of what the process has before; NaN where the system does not tell."""
    if not _CLEAR.exists():
        return float("nan")
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # else memory that was given back counts as if it were still taken
    _CLEAR.write_text("5")  # the peak starts anew
    before = _resident_mebibytes("VmRSS")
    function()
    return _resident_mebibytes("VmHWM") - before


def _resident_mebibytes(name: str) -> float:
    (line,) = [line for line in _STATUS.read_text().splitlines() if line.startswith(name)]
    return int(line.split()[1]) / 1024


def exponents(points: Sequence[Point]) -> tuple[float, float]:
    """The p of time ∝ size^p: fitted to all points, and between the last two; NaN for a single one."""
    if len(points) < 2:
        return float("nan"), float("nan")
    size, time_ = np.log([(point.size, point.milliseconds) for point in points]).T
    slope, _ = np.polyfit(size, time_, 1)
    return float(slope), float(np.diff(time_)[-1] / np.diff(size)[-1])


def report(name: str, rows: dict[str, list[Point]]) -> None:
    """Print a curve."""
    for what, points in rows.items():
        print(f"\n{what} by {name}")
        for point in points:
            print(f"{point.size:12}{point.milliseconds:12.1f} ms{point.mebibytes:12.0f} MiB")
        whole, last = exponents(points)
        print(f"    exponent {whole:.2f}, at the end {last:.2f}: × 10 costs × {10**last:.1f}", flush=True)


def plot(curves: dict[str, dict[str, list[Point]]], path: Path) -> None:
    """Draw all curves, log-log, with dotted lines of what grows in proportion."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, len(curves), figsize=(3.2 * len(curves), 3), squeeze=False, layout="tight")
    for panel, (name, rows) in zip(panels[0], curves.items(), strict=True):
        for what, points in rows.items():
            sizes = np.array([point.size for point in points])
            (line,) = panel.loglog(sizes, [point.milliseconds for point in points], "o-", ms=3, label=what)
            panel.loglog(sizes, points[-1].milliseconds * sizes / sizes[-1], ":", color=line.get_color(), lw=0.8)
        panel.set(xlabel=name, ylabel="ms")
        panel.legend(fontsize=7)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    pyplot.close(figure)


# ------------------------------------------------------------------------------------------------- a million vertices


def million(subdivisions: int = 8, ground_segments: int = 587, sphere_count: int = 256, size: int = 1024) -> None:
    """Print what an image of a million vertices takes, and going back from it to the pose."""
    scene = ball_scene(subdivisions, sphere_count, size)
    ground = dataclasses.replace(scene.bodies[1], mesh=ws.plane(6.0, ground_segments))
    scene = dataclasses.replace(scene, bodies=(scene.bodies[0], ground))
    vertex_count = sum(body.mesh.vertex_count for body in scene.bodies)
    print(f"{vertex_count} vertices, {sphere_count} spheres, {size} × {size} pixels")
    renderer = ws.Renderer(scene, progress=True)
    steps = {"image": renderer.render} | iteration(scene)
    for name, step in steps.items():
        start = time.perf_counter()
        step()
        seconds = time.perf_counter() - start
        print(f"  {name:12}{seconds:8.1f} s{_peak_gibibytes():8.2f} GiB at most so far", flush=True)
    print(f"  shaded were the {renderer.view().receivers.points.shape[1]} vertices of faces that are seen")


def _peak_gibibytes() -> float:
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30


def main(names: Sequence[str], most: int, runs: int, output: Path) -> None:
    curves = {}
    for name in names:
        curves[name] = measure(CURVES[name], most, runs)
        report(name, curves[name])
    plot(curves, output / "scaling.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--curves", nargs="+", choices=CURVES, default=list(CURVES), help="what is to grow")
    parser.add_argument("--most", type=int, default=10**7, help="largest size of any curve")
    parser.add_argument("--runs", type=int, default=5, help="timed runs of each point")
    parser.add_argument("--output", type=Path, default=Path("out"), help="folder for the picture")
    parser.add_argument("--million", action="store_true", help="a million vertices instead")
    arguments = parser.parse_args()
    ws.quiet()
    torch.set_num_threads(1)
    if arguments.million:
        million()
    else:
        main(arguments.curves, arguments.most, arguments.runs, arguments.output)
