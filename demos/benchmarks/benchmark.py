"""Time the stages of rendering the bunny scene, and how long their kernels take to compile.

    make bench       or        python demos/benchmarks/benchmark.py [--compile]
    python demos/benchmarks/benchmark.py --busy     a loop in torch beside processes that compute
    python demos/benchmarks/benchmark.py --set-up   the first image of meshes of several kinds
    python demos/benchmarks/benchmark.py --host     what Python costs around the kernels
    python demos/benchmarks/benchmark.py --graphs   calls of torch that are replayed as graphs, beside plain ones

The scene has 10 327 vertices, 20 392 faces, 64 spheres for the bunny and an image of 256 × 256 with one sample a pixel.
Visibility and shading are timed for all vertices; images, and iterations of fits, need those alone that are seen.
Figures are medians of runs that take turns, so that a slow moment of the machine strikes all alike: on one thread, and
on all cores (or what WARPSHADOW_NUM_THREADS says). Rows of the host are CPU time, of one thread, of a scene so small
that kernels take next to none of it: what Python around them costs.
"""

import argparse
import contextlib
import dataclasses
import itertools
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
import warp as wp

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos import shapes
from demos.benchmarks.lane_choice import cpu_text
from demos.scenes import bunny_scene, on_ground, shipped_mesh
from warpshadow import inverse
from warpshadow.stages import (
    accumulate,
    directional_transfer,
    exponentiate,
    find_silhouettes,
    interpolate,
    rasterize,
    sh_transfer,
    shade,
    smooth_silhouettes,
    to_clip,
    transmittance,
    vertex_normals,
)
from warpshadow.torch import TorchRenderer
from warpshadow.tuning.timing import median_times, whole_image

BOUNCED = ", two bounces"
"""What the labels of rows with bounces end with, where those without have nothing."""


def stages(device: str) -> tuple[str, dict[str, Callable[[], object]]]:
    """The size of the scene in words, and functions that run its stages once, by what they do."""
    scene = bunny_scene()
    renderer = ws.Renderer(scene, device=device, progress=True)
    positions, centers, radii = renderer.geometry().arrays().values()
    order = renderer.merged_scene.vertex_order  # in which renderers light them; all, also those that no sample sees
    normals = vertex_normals(positions, renderer.merged_scene.faces).numpy()[:, order]
    points, normals = (wp.array(a, dtype=wp.vec3, device=device) for a in (positions.numpy()[:, order], normals))
    cells = ws.CellBasis(ws.fibonacci(128))
    cell_light = wp.array(cells.coefficients(scene.light)[None], dtype=wp.vec3, device=device)
    sh_light = wp.array(ws.HarmonicBasis(8).coefficients(scene.light)[None], dtype=wp.vec3, device=device)
    clip_matrices = wp.array(scene.camera.clip_matrix()[None], dtype=wp.mat44, device=device)
    faces = renderer.merged_scene.faces

    def shade_directional() -> wp.array:
        seen = transmittance(points, normals, centers, radii, cells.directions)
        return shade(directional_transfer(seen, normals, cells.directions), cell_light)

    colors = shade_directional()

    def shade_log_sh() -> None:
        log = accumulate(points, normals, centers, radii, order=8)
        shade(sh_transfer(exponentiate(log), normals, order=8), sh_light)

    variables = [wp.clone(array, requires_grad=True) for array in (points, normals, centers, radii)]
    free_cells, free_sh = (wp.clone(light, requires_grad=True) for light in (cell_light, sh_light))

    def shade_directional_and_back() -> None:
        with wp.Tape() as tape:
            seen = transmittance(*variables, cells.directions)
            shaded = shade(directional_transfer(seen, variables[1], cells.directions), free_cells)
        shaded.grad.fill_(1.0)
        tape.backward()

    def shade_log_sh_and_back() -> None:
        with wp.Tape() as tape:
            seen = exponentiate(accumulate(*variables, order=8))
            shaded = shade(sh_transfer(seen, variables[1], order=8), free_sh)
        shaded.grad.fill_(1.0)
        tape.backward()

    def draw() -> None:
        clip = to_clip(renderer.geometry().positions, clip_matrices)
        interpolate(rasterize(clip, faces, scene.camera.width, scene.camera.height), faces, colors)

    def from_scratch() -> None:
        ws.Renderer(scene, device=device).render()

    torch_renderer = TorchRenderer(scene, device=device)
    rotations, translations, scales = torch_renderer.scene_poses()
    batch = rotations.expand(8, *rotations.shape), translations.repeat(8, 1, 1).requires_grad_()

    def fit_poses() -> None:
        torch_renderer(geometry=torch_renderer.placed(*batch, scales)).square().sum().backward()

    free_matrices = wp.clone(clip_matrices, requires_grad=True)

    def draw_smoothly(matrices: wp.array = clip_matrices) -> wp.array:
        clip = to_clip(renderer.geometry().positions, matrices)
        fragments = rasterize(clip, faces, scene.camera.width, scene.camera.height)
        found = find_silhouettes(
            fragments, faces, renderer.merged_scene.face_neighbors, clip, renderer.merged_scene.face_bodies
        )
        return smooth_silhouettes(interpolate(fragments, faces, colors), found, clip)

    def draw_and_back() -> None:
        with wp.Tape() as tape:
            image = draw_smoothly(free_matrices)
        image.grad.fill_(1.0)
        tape.backward()
        tape.zero()

    rows: dict[str, Callable[[], object]] = {
        "visibility and shading, directional, 128 directions": shade_directional,
        "visibility and shading, log-SH eigen, order 8": shade_log_sh,
        "directional, forward and backward": shade_directional_and_back,
        "log-SH, forward and backward": shade_log_sh_and_back,
        "project, rasterize and interpolate": draw,
        "project, rasterize, interpolate and smooth": draw_smoothly,
        "the same, forward and backward": draw_and_back,
        "image from the scene, set-up included": from_scratch,
        "iteration of 8 pose fits in a batch": fit_poses,
    }
    traced = dataclasses.replace(scene, visibility=scene.visibility.by("ray-traced"))
    still = ("iteration of a light fit in torch", "iteration of a texture fit in torch, 256² texels")
    for bounces, words in ((0, ""), (2, BOUNCED)):
        one = iterations(dataclasses.replace(scene, bounces=bounces), device)
        rows |= {f"{label}{words}": function for label, function in one.items()}
        one = iterations(dataclasses.replace(traced, bounces=bounces), device)
        rows |= {f"{label}, ray traced{words}": one[label] for label in still}
    size = f"{points.shape[1]} vertices, {faces.shape[0]} faces, {radii.shape[1]} spheres"
    return size, rows


def iterations(scene: ws.Scene, device: str) -> dict[str, Callable[[], object]]:
    """Functions that draw an image, or run an iteration of a fit in torch, by what they do."""
    renderer = TorchRenderer(scene, device=device)
    rotations, translations, scales = renderer.scene_poses()
    translations.requires_grad_()
    ground_texture = torch.full((256, 256, 3), 0.5, device=renderer.device, requires_grad=True)
    light = torch.from_numpy(renderer.basis.coefficients(scene.light)).to(renderer.device).requires_grad_()

    def fit_light() -> None:
        renderer(light).square().sum().backward()

    def fit_texture() -> None:
        renderer(textures=[None, ground_texture]).square().sum().backward()

    def fit_pose() -> None:
        renderer(geometry=renderer.placed(rotations, translations, scales)).square().sum().backward()

    return {
        "image of bodies that have moved": whole_image(renderer.array_renderer),
        "iteration of a light fit in torch": fit_light,
        "iteration of a texture fit in torch, 256² texels": fit_texture,
        "iteration of a pose fit in torch": fit_pose,
    }


def measure(device: str, seconds: float) -> dict[str, float]:
    """Median milliseconds of each stage on a device, on all threads, of as many runs as there is time for, 3 to 15."""
    _, rows = stages(device)
    start = time.perf_counter()
    median_times(list(rows.values()), 1)  # compiles, too
    median_times(list(rows.values()), 1)
    runs = int(min(15, max(3, seconds / (time.perf_counter() - start))))
    return dict(zip(rows, median_times(list(rows.values()), runs), strict=True))


def main(device: str, runs: int) -> None:
    ws.quiet()
    torch.set_num_threads(1)  # what torch does here is little, and threads of two libraries wait for each other
    size, rows = stages(device)
    is_cpu = wp.get_device(device).is_cpu
    if is_cpu:
        print(cpu_text())
    print(f"{size}, {device}, medians of {runs} [ms]")
    counts = sorted({1, ws.thread_count()}) if is_cpu else [1]
    functions = [on_threads(count, function) for function in rows.values() for count in counts]
    flat = median_times(functions, runs)
    ws.set_thread_count(None)
    times = {label: flat[k * len(counts) : (k + 1) * len(counts)] for k, label in enumerate(rows)}
    print(f"  {'threads':84}" + "".join(f"{count:8}" for count in counts))
    for label, row in times.items():
        print(f"  {label:84}" + "".join(f"{milliseconds:8.1f}" for milliseconds in row))
    without, forward, both = (times[label] for label in rows if label.startswith(("project", "the same")))
    for label, base in (("forward and backward / forward", forward), ("the same / forward, not smoothed", without)):
        ratios = [longer / shorter for longer, shorter in zip(both, base, strict=True)]
        print(f"  {label:84}" + "".join(f"{ratio:8.2f}" for ratio in ratios))
    for label in (label for label in times if label.endswith(BOUNCED)):
        direct = times[label.removesuffix(BOUNCED)]
        ratios = [longer / shorter for longer, shorter in zip(times[label], direct, strict=True)]
        print(f"  {f'{label} / without':84}" + "".join(f"{ratio:8.2f}" for ratio in ratios))


def time_fits(device: str) -> None:
    """Median iterations of whole fits of the bunny scene: images of 256 × 256, steps of the optimizer included."""
    scene = bunny_scene()
    problems = {
        "light, order 5, ray traced": (inverse.Light(), {}),
        "light, order 5, images compared by l1": (inverse.Light(), {"loss": inverse.Loss("l1")}),
        "texture of the ground, 256 × 256, ray traced": (inverse.Texture(1), {}),
        "pose of the bunny": (inverse.Pose(0), {}),
        "deformation of the bunny": (inverse.Deformation(0), {}),
    }
    target = inverse.Target(ws.render(scene, device=device) * 0.9)
    for label, (free, options) in problems.items():
        result = inverse.fit(inverse.Problem(scene, target, free, **options), [inverse.Stage(30)], device=device)
        print(f"  {f'iteration of inverse.fit: {label}':70}{1e3 * result.seconds:8.2f} ms", flush=True)


def small_scene() -> ws.Scene:
    """A ball of 42 vertices and 8 spheres on a ground of 16 quads, 16 × 16 pixels, light in 16 cells."""
    ground = ws.Body(ws.plane(6.0, 4), blockers=0)
    scene = on_ground(ws.icosphere(1.0, 1), ws.synthetic_sky(), blockers=8, ground=ground)
    visibility = ws.Visibility(directions=16)
    return dataclasses.replace(scene, camera=scene.camera.resized(1 / 16), supersampling=1, visibility=visibility)


def time_host(device: str, runs: int) -> None:
    """CPU milliseconds of images and iterations of a small scene on one thread, medians."""
    ws.set_thread_count(1)
    for bounces, words in ((0, ""), (2, BOUNCED)):
        rows = iterations(dataclasses.replace(small_scene(), bounces=bounces), device)
        for label, function in rows.items():
            for _ in range(3):  # twice for places that images take turns with, and once for what is kept
                function()
            milliseconds = 1e3 * statistics.median(seconds_of(function) for _ in range(2 * runs))
            print(f"  {f'host: {label}, 42 vertices{words}':84}{milliseconds:8.2f} ms of CPU", flush=True)
    ws.set_thread_count(None)


def time_graphs(device: str, runs: int) -> None:
    """Milliseconds of plain calls and of replayed ones that take turns, on one thread; of a CPU, CPU time."""
    ws.set_thread_count(1)
    clock = time.process_time if wp.get_device(device).is_cpu else time.perf_counter
    scene = bunny_scene()
    camera = scene.camera
    scenes = {
        f"bunny, {size}²": dataclasses.replace(scene, camera=camera.resized(size / camera.width))
        for size in (64, 128, 256)
    }
    print(f"  {'':50}{'plain':>10}{'graph':>10}")
    for name, scene in {"42 vertices, 16²": small_scene(), **scenes}.items():
        renderers = [TorchRenderer(scene, device=device, graphs=graphs) for graphs in (False, True)]
        images, fits = zip(*map(moving_calls, renderers), strict=True)
        for label, calls in (("image of bodies that have moved", images), ("iteration of a pose fit", fits)):
            for _ in range(4):  # plain twice, then captured
                calls[1]()
            plain, graph = median_times(calls, runs, clock=clock)
            reason = renderers[1].replays.reason
            print(
                f"  {f'{name}: {label}':50}{plain:10.1f}{graph:10.1f}  {reason and f'not replayed: {reason}'}",
                flush=True,
            )
    ws.set_thread_count(None)


def moving_calls(renderer: TorchRenderer) -> tuple[Callable[[], object], Callable[[], object]]:
    """Functions that draw an image of bodies that have moved, and that run an iteration of a pose fit."""
    rotations, translations, scales = renderer.scene_poses()
    translations.requires_grad_()
    shifts = itertools.cycle(1e-4 * step for step in range(7))

    def draw() -> None:
        with torch.no_grad():
            renderer(geometry=renderer.placed(rotations, translations + next(shifts), scales))

    def fit_pose() -> None:
        renderer(geometry=renderer.placed(rotations, translations, scales)).square().sum().backward()

    return draw, fit_pose


def on_threads(count: int, function: Callable[[], object]) -> Callable[[], object]:
    """Make a function run on a number of threads."""

    def run() -> None:
        ws.set_thread_count(count)
        function()

    return run


def time_busy(runs: int) -> None:
    """Mean iterations of a torch loop of light and texture, on an idle machine and beside more processes than cores."""
    ws.quiet()
    scene = bunny_scene()
    scene = dataclasses.replace(scene, camera=scene.camera.resized(0.5), supersampling=2)
    renderer = TorchRenderer(scene, basis=ws.HarmonicBasis(5))
    light = torch.full((25, 3), 0.1, requires_grad=True)
    ground = torch.full((256, 256, 3), 0.5, requires_grad=True)
    with torch.no_grad():
        target = 0.9 * renderer(light, textures=[None, ground])

    def seconds(has_light: bool, has_texture: bool) -> float:
        given = light if has_light else None, [None, ground if has_texture else None]
        optimizer = torch.optim.Adam([light] * has_light + [ground] * has_texture, lr=1e-4)
        start = 0.0
        for iteration in range(runs + 2):
            if iteration == 2:  # the first find what stands
                start = time.perf_counter()
            optimizer.zero_grad()
            torch.nn.functional.mse_loss(renderer(given[0], textures=given[1]), target).backward()
            optimizer.step()
        return (time.perf_counter() - start) / runs

    rows = {"light": (True, False), "texture": (False, True), "light and texture": (True, True)}
    counts = sorted({1, torch.get_num_threads()})
    processes = (os.cpu_count() or 1) + 1
    print(cpu_text())
    print(f"128 × 128 pixels, means of {runs} iterations [ms]; busy: beside {processes} processes that compute")
    print(f"  {'':20}{'threads of torch':>18}{'idle':>8}{'busy':>8}{'ratio':>8}")
    for label, free in rows.items():
        for count in counts:
            torch.set_num_threads(count)
            idle = 1e3 * seconds(*free)
            with computing(processes):
                busy = 1e3 * seconds(*free)
            print(f"  {label:20}{count:18}{idle:8.1f}{busy:8.1f}{busy / idle:8.1f}", flush=True)


def time_set_up(device: str) -> None:
    """CPU seconds of the first image of meshes, with kernels compiled and nothing else cached."""
    ws.quiet(progress=False)
    meshes = {
        "box": shapes.joined("box", shapes.box((1, 1, 1))),
        "chair": shapes.chair(),
        "bunny": shipped_mesh("bunny"),
        "ball": ws.icosphere(1.0, 6),
    }
    print(cpu_text())
    print("CPU seconds; image: of a Renderer, with all that is left of it; again: of another, all cached")
    print(f"{'':12}{'vertices':>10}{'spheres':>9}{'fit':>8}{'tracing':>9}{'image':>8}{'again':>8}{'still':>8}")
    for name, mesh in {"": ws.icosphere(1.0, 1), **meshes}.items():  # the first loads kernels
        scene = on_ground(mesh, ws.synthetic_sky(), blockers="auto")
        with empty_cache():
            still = seconds_of(lambda scene=scene: ws.render(scene, device=device))
        mesh = ws.Mesh(mesh.positions, mesh.faces)  # of which nothing is known yet
        scene = on_ground(mesh, ws.synthetic_sky(), blockers="auto")
        with empty_cache():
            fit = seconds_of(lambda mesh=mesh: ws.fit_spheres(mesh, device=device))
            count = len(ws.fit_spheres(mesh, device=device).spheres)
            first, again = (seconds_of(lambda scene=scene: ws.Renderer(scene, device=device).render()) for _ in "12")
        times = (fit, first - again, fit + first, again, still)
        if name:
            cells = "".join(f"{seconds:{width}.1f}" for seconds, width in zip(times, (8, 9, 8, 8, 8), strict=True))
            print(f"{name:12}{mesh.vertex_count:10,}{count:9}{cells}", flush=True)


def seconds_of(function: Callable[[], object]) -> float:
    """CPU seconds of all threads."""
    start = time.process_time()
    function()
    return time.process_time() - start


@contextlib.contextmanager
def empty_cache() -> Iterator[None]:
    """Keep fits and shadows of bodies on themselves in a folder that is empty before and gone after."""
    before = os.environ.get("WARPSHADOW_CACHE_DIR")
    with tempfile.TemporaryDirectory() as folder:
        os.environ["WARPSHADOW_CACHE_DIR"] = folder
        yield
    if before is None:
        del os.environ["WARPSHADOW_CACHE_DIR"]
    else:
        os.environ["WARPSHADOW_CACHE_DIR"] = before


@contextlib.contextmanager
def computing(count: int) -> Iterator[None]:
    """Have a number of processes compute meanwhile."""
    processes = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        time.sleep(1.0)  # they are there
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def time_compilation(device: str) -> None:
    """Compile what each method needs, for an image and for a pose fit, in a new process with an empty kernel cache."""
    scene = (
        "import time, torch, warpshadow as ws; from warpshadow.torch import TorchRenderer; ws.quiet()\n"
        "scene = ws.Scene((ws.Body(ws.icosphere(), blockers=ws.Spheres([[0, 0, 0]], [1])), "
        "ws.Body(ws.plane(), blockers=0)), "
        "ws.EnvironmentMap.constant(1.0), ws.Camera.look_at((0, 1, 5), (0, 0, 0)), ws.Visibility(method={method!r}))\n"
    )
    tasks = {
        "an image": "def run(): ws.render(scene, device={device!r})\n",
        "a pose fit": (
            "renderer = TorchRenderer(scene, device={device!r})\n"
            "def run():\n"
            "    poses = [pose.requires_grad_() for pose in renderer.scene_poses()]\n"
            "    renderer(geometry=renderer.placed(*poses)).sum().backward()\n"
        ),
    }
    timing = (
        "start = time.perf_counter(); run(); cold = time.perf_counter() - start\n"
        "start = time.perf_counter(); run(); print(cold - (time.perf_counter() - start))\n"
    )
    for method, (task, steps) in itertools.product(("directional", "log-sh", "none"), tasks.items()):
        program = (scene + steps).format(method=method, device=device) + timing
        with tempfile.TemporaryDirectory() as cache:
            environment = os.environ | {"WARP_CACHE_PATH": cache}
            run = subprocess.run(
                [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
            )
        print(f"  {f'cold compile for {task}, {method}':54}{float(run.stdout.split()[-1]):8.1f} s")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", help="cpu, cuda:0, …")
    parser.add_argument("--runs", type=int, default=15, help="timed runs of each row")
    parser.add_argument("--compile", action="store_true", help="also time compilation from an empty cache")
    parser.add_argument("--busy", action="store_true", help="time a loop in torch beside other processes")
    parser.add_argument("--set-up", action="store_true", help="time the first image of meshes, with nothing cached")
    parser.add_argument("--host", action="store_true", help="time the host alone: CPU time of a small scene")
    parser.add_argument("--graphs", action="store_true", help="time replayed calls of torch beside plain ones")
    arguments = parser.parse_args()
    if arguments.busy:
        time_busy(arguments.runs)
        sys.exit()
    if arguments.set_up:
        time_set_up(arguments.device)
        sys.exit()
    if arguments.host or arguments.graphs:
        ws.quiet()
        torch.set_num_threads(1)
        print(cpu_text())
        (time_host if arguments.host else time_graphs)(arguments.device, arguments.runs)
        sys.exit()
    main(arguments.device, arguments.runs)
    time_host(arguments.device, arguments.runs)
    time_fits(arguments.device)
    if arguments.compile:
        time_compilation(arguments.device)
