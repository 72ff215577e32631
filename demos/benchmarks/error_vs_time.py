"""What each millisecond buys: error against the time of an image, for all settings and for a path tracer.

    python demos/benchmarks/error_vs_time.py [--data FOLDER] [--output FOLDER] [--light direct full] [--quick]
        [--scenes NAME ...] [--one-thread]

Three scenes of 256 × 256 pixels: a body in the sun, one under an overcast sky, and three bodies under a low sun.
``--data`` takes meshes (FOLDER/meshes) and environment maps (FOLDER/envmaps) from a folder: the map with the brightest
spot, the most even one and the one between. Four more are of demos/kinds.py. ``--scenes`` takes some of these, or
others of demos/kinds.py, or a metal bunny, a lamp over one, and a table beside a window (``metal``, ``lamp``,
``window``), which methods without gloss and near light leave out, and Mitsuba does the last; what an earlier run wrote
of other scenes to the same folder stays in tables and pictures.

Time is that of a warm image, forward, with the renderer made: each call places the bodies a hair's breadth elsewhere,
so that nothing can be kept from the call before: projection, rasterization, visibility, shading and film run anew. With
``--one-thread`` all run on one thread, Mitsuba too, and times are of the processor: other work on the machine changes
them little. Figures are medians of calls that take turns, all in one run; the default, and what seems better than it,
are timed again among themselves. Error is the relative L2 error over wholly covered pixels, against rays through the
meshes, 4096 a pixel.

Also measured: rays at few directions; Mitsuba 3 where it is installed, and how many times as long it needs to come as
near to its own image of 4096 samples as our default does; whether any setting is both faster and more accurate than
the default; what ``ws.tune`` picks; and what the default's error consists of.

Against full light, path traced with all bounces, there is less to compare: no shadows, the default, which knows direct
light alone, the default with 1, 2 and 4 bounces, and Mitsuba's path integrator. The demo prints tables and writes
error_vs_time.json and .png, and full_light_vs_time.json and .png.
"""

import argparse
import dataclasses
import functools
import importlib.util
import itertools
import json
import sys
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
import warp as wp

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.benchmarks.emitters import near_table, small_lamp
from demos.kinds import SCENES, Sources
from demos.scenes import image_error, on_ground, shipped_mesh
from warpshadow.scene.visibility import AUTO
from warpshadow.spheres import exact_occlusion
from warpshadow.stages import accumulate, exponentiate, sample_map, sh_transfer, shade, trace_visibility
from warpshadow.stages.visibility.merging import MERGED_FROM
from warpshadow.tuning.point_sample import PointReceivers, PointSample
from warpshadow.tuning.timing import median_times, whole_image
from warpshadow.tuning.tune import describe, pareto_front

DIRECTION_COUNTS = (32, 64, 128, 256, 512)
ORDERS = (4, 6, 8)
SPHERE_COUNTS = (16, 32, 64, 128, 256, 512)
THREE = ("sun", "overcast", "low_sun")
KINDS = ("bowl", "chair_wheel_fence", "city", "open_room")
SHINING = ("metal", "lamp", "window")  # with gloss, and with near light
KIND_COUNTS = (64, 256)  # of spheres, for scenes of several bodies
SIZE = 256  # pixels across
TUNED_ERROR = 0.05  # that tune is asked for
RAY_COUNTS = (16, 64, 256)
PATH_COUNTS = (4, 16, 64, 256, 1024)
TRUE_COUNT = 4096  # rays or paths of a pixel
BOUNCES = (1, 2, 4)
ALL_BOUNCES = 12  # of full light: what comes after is less than the noise of the truth
RECHECKS = 4  # times as many runs where it matters who is faster
MARGIN = 0.1  # by which a setting has to be better than the default in both
CONVERGED = 1 / 16  # threshold of the exponential
COLORS = {
    "none": "0.5",
    "directional": "tab:blue",
    "log-SH eigen": "tab:green",
    "log-SH cap": "tab:olive",
    "ray-traced": "tab:red",
    "Mitsuba": "tab:purple",
}


@dataclass(frozen=True)
class Setting:
    """A way to compute an image of a scene."""

    family: str  # a key of COLORS
    size: int  # directions, order, rays or paths
    details: str  # what else differs from the default
    scene: ws.Scene


@dataclass(frozen=True)
class Measured:
    """What a setting costs and gives."""

    family: str
    size: int
    details: str
    milliseconds: float
    error: float

    @property
    def label(self) -> str:
        """The setting in words."""
        return f"{self.family} {self.size}{', ' if self.details else ''}{self.details}"


def main(
    data: Path | None,
    output: Path,
    runs: int,
    quick: bool,
    lights: Sequence[str] = ("direct", "full"),
    names: Sequence[str] = (*THREE, *KINDS),
) -> None:
    ws.quiet()
    warnings.simplefilter("ignore")  # many spheres in spherical harmonics; coarse faces
    scenes = quick_scenes() if quick else load_scenes(data, names)
    true_count = 1024 if quick else TRUE_COUNT
    output.mkdir(exist_ok=True)
    for light in lights:
        path = output / ("full_light_vs_time.json" if light == "full" else "error_vs_time.json")
        results = json.loads(path.read_text()) if path.exists() else {}
        for name, scene in scenes.items():
            print(f"\n{name}, {light} light", flush=True)
            if light == "full":
                results[name] = compare_full(scene, runs, true_count=true_count)
            else:
                counts = KIND_COUNTS if name in (*SCENES, *SHINING) else SPHERE_COUNTS
                results[name] = compare(scene, () if quick else counts, runs, true_count=true_count)
            path.write_text(json.dumps(results, indent=1, ensure_ascii=False))
            plot(results, path.with_suffix(".png"))


def compare(scene: ws.Scene, sphere_counts: Sequence[int], runs: int, *, true_count: int) -> dict:
    """Measure and print all there is to say of a scene."""
    measured, equal = measure(scene, settings(scene, sphere_counts), runs, true_count)
    default = measured[default_among(measured)]
    ours = [each for each in measured if each.family not in ("ray-traced", "Mitsuba")]
    front = [ours[number] for number in pareto_front([(each.milliseconds, each.error) for each in ours])]
    better = better_than(default, ours)
    parts = error_parts(scene) if "log-sh" in scene.methods else {}  # others' light is not of the map alone
    tuned = ws.tune(scene, error=TUNED_ERROR, progress=False)
    print_table(measured, {default.label: ">"} | {each.label: "*" for each in front if each is not default})
    print("> default    * no other setting is both faster and more accurate")
    print(f"both faster and more accurate than the default by {MARGIN:.0%}: ", end="")
    print("; ".join(each.label for each in better) or "none")
    print(f"the default is {'' if default in front else 'not '}on the Pareto front")
    print(
        f"tune, asked for {TUNED_ERROR:.0%}: {describe(tuned.scene)} ({tuned.error:.2%}, {tuned.milliseconds:.1f} ms)"
    )
    for method, of_method in parts.items():
        print(f"error of {method}: " + ", ".join(f"{part} {value:.2%}" for part, value in of_method.items()))
    print_equal(equal)
    return {
        "settings": [dataclasses.asdict(each) for each in measured],
        "default": default.label,
        "front": [each.label for each in front],
        "better_than_default": [each.label for each in better],
        "tuned": describe(tuned.scene),
        "parts": parts,
        "equal_error": equal,
    }


def compare_full(scene: ws.Scene, runs: int, *, true_count: int) -> dict:
    """Measure and print how near a scene comes to light of all bounces."""
    measured, equal = measure(scene, full_settings(scene), runs, true_count, bounces=ALL_BOUNCES)
    print_table(measured)
    print_equal(equal)
    return {"settings": [dataclasses.asdict(each) for each in measured], "equal_error": equal}


def print_table(measured: Sequence[Measured], marks: Mapping[str, str] = MappingProxyType({})) -> None:
    """Print figures, the fastest first."""
    print(f"  {'':42}{'error':>9}{'image':>14}")
    for each in sorted(measured, key=lambda each: each.milliseconds):
        print(f"{marks.get(each.label, ' ')} {each.label:42}{each.error:9.2%}{each.milliseconds:11.2f} ms")


def print_equal(equal: Mapping[str, Mapping[str, float]]) -> None:
    """Print how long a path tracer takes to come as near to the truth."""
    for label, figures in equal.items():
        print(
            f"Mitsuba takes {figures['times_as_long']:.0f} times as long to come as near to its image of "
            f"{TRUE_COUNT} samples as {label} ({figures['error']:.2%})",
            flush=True,
        )


def default_among(measured: Sequence[Measured]) -> int:
    """Where the default is."""
    return [(each.family, each.size, each.details) for each in measured].index(("directional", 128, ""))


def better_than(default: Measured, others: Sequence[Measured]) -> list[Measured]:
    """Settings that are both faster and more accurate by MARGIN."""
    most = 1 - MARGIN
    return [
        each for each in others if each.milliseconds < most * default.milliseconds and each.error < most * default.error
    ]


# ---------------------------------------------------------------------------------------------- scenes


def load_scenes(data: Path | None, wanted: Sequence[str]) -> dict[str, ws.Scene]:
    """Scenes of THREE by their meshes and maps, and of all kinds by name."""
    three = dict(zip(THREE, three_scenes(data).items(), strict=True)) if set(wanted) & set(THREE) else {}
    scenes = SCENES | {name: functools.partial(shining_scene, name) for name in SHINING}
    return dict(three[name] if name in three else (name, scenes[name](Sources(data), SIZE)) for name in wanted)


def shining_scene(name: str, sources: Sources, size: int) -> ws.Scene:
    """A scene of SHINING."""
    if name == "metal":
        scene = on_ground(shipped_mesh("bunny"), ws.synthetic_sky(sun_radius=8), blockers=AUTO)
        metal = dataclasses.replace(scene.bodies[0], albedo=(0.9, 0.65, 0.35), roughness=0.35, metallic=1.0)
        return dataclasses.replace(
            scene, bodies=(metal, scene.bodies[1]), camera=scene.camera.resized(size / scene.camera.width)
        )
    return {"lamp": small_lamp, "window": near_table}[name](size)


def three_scenes(data: Path | None) -> dict[str, ws.Scene]:
    """A sunny, an overcast scene, and one with several bodies."""
    meshes = [shipped_mesh(name) for name in ("bunny", "bear", "rocks")]
    names = ["sun", "overcast", "low sun"]
    skies = [
        ws.synthetic_sky((0.5, 0.9, 0.3)),
        ws.synthetic_sky((0.3, 0.8, -0.4), sun_strength=0.0),
        ws.synthetic_sky((0.8, 0.35, 0.3)),
    ]
    if data is not None:
        meshes = [*(ws.load_mesh(file) for file in sorted((data / "meshes").iterdir())), *meshes][:3]
        maps = {file.stem: ws.EnvironmentMap.read(file) for file in sorted((data / "envmaps").iterdir())}
        names = sorted(maps, key=lambda name: -maps[name].statistics()["brightest_percent_share"])
        names = [names[0], names[-1], names[len(names) // 2]]
        skies = [maps[name] for name in names]
    bodies = ", ".join(mesh.name for mesh in meshes)
    return {
        f"{meshes[0].name}, {names[0]}": on_ground(meshes[0], skies[0], blockers=AUTO),
        f"{meshes[1].name}, {names[1]}": on_ground(meshes[1], skies[1], blockers=AUTO),
        f"{bodies}, {names[2]}": several_on_ground(meshes, skies[2]),
    }


def several_on_ground(meshes: Sequence[ws.Mesh], light: ws.EnvironmentMap) -> ws.Scene:
    """Three bodies of 1.3 units beside one another, on the ground of one."""
    whole = on_ground(meshes[0], light, blockers=AUTO)
    places = [(-1.2, 0.0, 0.4), (0.2, 0.0, -0.9), (1.2, 0.0, 0.7)]
    bodies = []
    for mesh, place in zip(meshes, places, strict=True):
        body = on_ground(mesh, light, blockers=AUTO).bodies[0]
        bodies.append(dataclasses.replace(body, scale=0.65 * body.scale, translation=0.65 * body.translation + place))
    return dataclasses.replace(whole, bodies=(*bodies, whole.bodies[1]))


def quick_scenes() -> dict[str, ws.Scene]:
    """A ball on a ground, at a size at which all takes no time."""
    ball = ws.Spheres([(0, 0, 0)], [1])
    scene = on_ground(
        ws.icosphere(1.0, 2), ws.synthetic_sky(height=32, sun_radius=6), ground=ws.Body(ws.plane(6.0, 16))
    )
    bodies = (dataclasses.replace(scene.bodies[0], blockers=ball), scene.bodies[1])
    return {"ball": dataclasses.replace(scene, bodies=bodies, camera=scene.camera.resized(1 / 8))}


# ---------------------------------------------------------------------------------------------- settings


def settings(scene: ws.Scene, sphere_counts: Sequence[int]) -> list[Setting]:
    """What is compared: methods with all numbers of spheres; bases and pixels as receivers with some."""
    found = list(methods(scene, ""))
    for count in sphere_counts:
        found += methods(with_spheres(scene, count), f"{count} spheres")
    is_harmonic = "log-sh" in scene.methods
    for log, base in itertools.product(("eigen", "cap") if is_harmonic else (), ("linear", "optimal_linear")):
        found += [
            Setting(
                f"log-SH {log}", order, base, with_visibility(scene, method="log-sh", log=log, order=order, base=base)
            )
            for order in ORDERS
        ]
    for count in (None, *(count for count in sphere_counts if count in (128, 256))):
        pixels = with_receivers(with_spheres(scene, count) if count else scene, "pixel")
        spheres = f"{count} spheres, " if count else ""
        found += [
            Setting("directional", directions, f"{spheres}pixel", with_visibility(pixels, directions=directions))
            for directions in (64, 128, 256)
        ]
        if is_harmonic:
            found.append(Setting("log-SH eigen", 8, f"{spheres}pixel", with_visibility(pixels, method="log-sh")))
    for count in (count for count in sphere_counts if count >= MERGED_FROM):
        apart = with_spheres(scene, count)
        found += [
            Setting(f"{method}, merging 0", size, f"{count} spheres", with_visibility(apart, merging=0.0, **options))
            for method, size, options in (("directional", 128, {}), ("log-SH eigen", 8, {"method": "log-sh"}))
            if is_harmonic or not options
        ]
    found += [
        Setting("ray-traced", count, "", with_visibility(scene, method="ray-traced", samples=count))
        for count in RAY_COUNTS
    ]
    return [*found, Setting("none", 8, "", with_visibility(scene, method="none"))]


def methods(scene: ws.Scene, details: str) -> list[Setting]:
    """Directions and orders, for the spheres of a scene."""
    directional = [
        Setting("directional", count, details, with_visibility(scene, directions=count)) for count in DIRECTION_COUNTS
    ]
    harmonic = [
        Setting(f"log-SH {log}", order, details, with_visibility(scene, method="log-sh", log=log, order=order))
        for log, order in itertools.product(("eigen", "cap") if "log-sh" in scene.methods else (), ORDERS)
    ]
    return directional + harmonic


def full_settings(scene: ws.Scene) -> list[Setting]:
    """What is compared with full light: models of direct light, and of 1, 2 and 4 bounces."""
    return [
        Setting("none", 8, "", with_visibility(scene, method="none")),
        Setting("directional", 128, "", scene),
        *(
            Setting("directional", 128, f"{count} {'bounce' if count == 1 else 'bounces'}", with_bounces(scene, count))
            for count in BOUNCES
        ),
    ]


def with_bounces(scene: ws.Scene, count: int) -> ws.Scene:
    return dataclasses.replace(scene, bounces=count)


def with_visibility(scene: ws.Scene, **options: object) -> ws.Scene:
    return dataclasses.replace(scene, visibility=ws.Visibility(**options))


def with_spheres(scene: ws.Scene, count: int) -> ws.Scene:
    return dataclasses.replace(scene, bodies=[dataclasses.replace(body, blockers=count) for body in scene.bodies])


def with_receivers(scene: ws.Scene, receivers: str) -> ws.Scene:
    return dataclasses.replace(scene, bodies=[dataclasses.replace(body, receivers=receivers) for body in scene.bodies])


# ---------------------------------------------------------------------------------------------- measurements


def measure(
    scene: ws.Scene, compared: Sequence[Setting], runs: int, true_count: int, *, bounces: int = 0
) -> tuple[list[Measured], dict[str, dict[str, float]]]:
    """Measure settings, and Mitsuba where it is installed.

    Args:
        scene: The scene with the default settings.
        compared: Other ways to compute its image.
        runs: Timed calls of each.
        true_count: Samples of the truth, for a pixel.
        bounces: Of the truth.

    Returns:
        All that was measured; and for the default, or each number of bounces, the comparison at equal error.
    """
    reference = with_bounces(with_visibility(scene, method="ray-traced", samples=true_count), bounces)
    truth = ws.render(reference, progress=True)
    draws = [whole_image(ws.Renderer(setting.scene)) for setting in compared]
    errors = [image_error(draw().numpy()[0], truth) for draw in draws]
    knows_light = scene.shell is None and importlib.util.find_spec("mitsuba")
    paths = paths_of(scene, bounces) if knows_light else None
    path_counts = PATH_COUNTS if paths else ()
    calls = [(lambda count=count: paths(count, seed=1)) for count in path_counts]
    times = median_times([*draws, *calls], runs, clock=clock(), progress=True)
    measured = [
        Measured(setting.family, setting.size, setting.details, milliseconds, error)
        for setting, milliseconds, error in zip(compared, times, errors, strict=False)
    ]
    time_again(measured, draws, RECHECKS * runs)
    if paths is None:
        return measured, {}
    path_truth = np.dstack([paths(TRUE_COUNT, seed=2), truth[..., 3]])
    path_times = times[len(compared) :]
    path_errors = [error_of_paths(paths(count, seed=1), path_truth) for count in path_counts]
    equal = {}
    for setting, own in zip(compared, measured, strict=True):
        if setting.scene.bounces or setting.scene is compared[default_among(measured)].scene:
            error = image_error(ws.Renderer(setting.scene).render(), path_truth)
            longer = time_at_error(path_times, path_errors, error)
            equal[own.label] = {
                "error": error,
                "milliseconds": own.milliseconds,
                "path_milliseconds": longer,
                "times_as_long": longer / own.milliseconds,
            }
    measured += [
        Measured("Mitsuba", count, "", milliseconds, error)
        for count, milliseconds, error in zip(path_counts, path_times, path_errors, strict=True)
    ]
    return measured, equal


def time_again(measured: list[Measured], draws: Sequence[Callable[[], object]], runs: int) -> None:
    """Time the default, and what seems better than it, once more, so that one slow moment decides nothing."""
    default, timed = default_among(measured), set()
    while True:
        better = better_than(measured[default], measured)
        doubtful = [n for n, each in enumerate(measured) if n not in timed and (n == default or each in better)]
        if not doubtful:
            return
        for number, milliseconds in zip(
            doubtful, median_times([draws[n] for n in doubtful], runs, clock=clock()), strict=True
        ):
            measured[number] = dataclasses.replace(measured[number], milliseconds=milliseconds)
        timed.update(doubtful)


def clock() -> Callable[[], float]:
    """Of the processor where all runs on one thread, else of the wall."""
    return time.process_time if ws.thread_count() == 1 else time.perf_counter


def paths_of(scene: ws.Scene, bounces: int) -> Callable[..., np.ndarray]:
    """Make the function that renders an image in Mitsuba, [height, width, 3], of direct light or with bounces."""
    import drjit
    import mitsuba as mi

    from demos.benchmarks.mitsuba_fits import RayTracer

    path = {"type": "path", "max_depth": bounces + 2}  # what is seen, the light, and what lies between
    tracer = RayTracer(scene, path if bounces else {"type": "direct"})
    drjit.set_thread_count(ws.thread_count())
    return lambda samples, seed: np.array(mi.render(tracer.scene, spp=samples, seed=seed))


def error_of_paths(image: np.ndarray, truth: np.ndarray) -> float:
    """Relative L2 error of an image without coverage."""
    return image_error(np.dstack([image, truth[..., 3]]), truth)


def time_at_error(times: Sequence[float], errors: Sequence[float], error: float) -> float:
    """Time at which a path tracer reaches an error, between what was measured; beyond, errors fall as 1/√time."""
    order = np.argsort(errors)
    times, errors = np.array(times)[order], np.array(errors)[order]
    nearest = np.clip(error, errors[0], errors[-1])
    between = np.exp(np.interp(np.log(nearest), np.log(errors), np.log(times)))
    return float(between * (nearest / error) ** 2)


# ---------------------------------------------------------------------------------------------- parts of the error


def error_parts(scene: ws.Scene, *, count: int = 1024, direction_count: int = 4096) -> dict[str, dict[str, float]]:
    """Split the error of the default and of log-SH into parts, each by exchanging one thing that it approximates.

    All are relative L2 errors of shading at points that the camera sees:

        spheres      rays through the spheres against rays through the mesh
        directions   the method against rays through the same spheres; of log-SH, converged: its band limit
        exponential  of log-SH: the base approximation against a converged one
        vertices     rays from vertices, interpolated, against rays from the points
        whole        all together; parts partly cancel

    Args:
        scene: The scene; its light is a map.
        count: Number of points.
        direction_count: Rays of each, the same for all, drawn in proportion to light.
    """
    sample = PointSample(scene, count=count, direction_count=1)
    bodies = len(scene.bodies)
    at_points, at_vertices = sample.receivers(["pixel"] * bodies), sample.receivers(["vertex"] * bodies)
    rays = Rays(scene, direction_count)
    truth, interpolated = rays.past_mesh(at_points), rays.past_mesh(at_vertices)
    through_spheres = rays.past_spheres(at_points)

    def difference(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.linalg.norm(a - b) / np.linalg.norm(truth))

    pixels, vertices = (with_receivers(scene, receivers) for receivers in ("pixel", "vertex"))
    harmonic = sample.shading(with_visibility(pixels, method="log-sh"))
    converged = rays.by_converged_log_sh(at_points)
    shared = {"spheres": difference(through_spheres, truth), "vertices": difference(interpolated, truth)}
    return {
        "directional 128": {
            **shared,
            "directions": difference(sample.shading(with_visibility(pixels)), through_spheres),
            "whole": difference(sample.shading(with_visibility(vertices)), truth),
        },
        "log-SH eigen 8": {
            **shared,
            "bands": difference(converged, through_spheres),
            "exponential": difference(harmonic, converged),
            "whole": difference(sample.shading(with_visibility(vertices, method="log-sh")), truth),
        },
    }


class Rays:
    """Shading by rays that are the same for all receivers, so that what is compared differs in nothing else.

    Args:
        scene: The scene.
        count: Number of directions, drawn in proportion to light.
    """

    def __init__(self, scene: ws.Scene, count: int):
        self.scene = scene
        renderer = ws.Renderer(with_visibility(scene))
        self.geometry = renderer.geometry()
        self.mesh = renderer.merged_scene.blocker_mesh(self.geometry.positions[0])
        samples = sample_map(scene.light.radiance, count)
        self.directions, self.radiance = samples.directions[0], samples.radiance[0]

    def past_mesh(self, receivers: PointReceivers) -> np.ndarray:
        """Shading of points [point, 3] past the meshes."""
        seen = trace_visibility(self.mesh, *self._arrays(receivers), self._towards())
        return self._shade(receivers, seen.numpy()[0])

    def past_spheres(self, receivers: PointReceivers) -> np.ndarray:
        """Shading of points [point, 3] past the spheres, exactly."""
        points, _ = self._arrays(receivers)
        occluded = exact_occlusion(points, self._towards(), self.geometry.centers, self.geometry.radii)
        return self._shade(receivers, 1 - occluded.numpy()[0])

    def by_converged_log_sh(self, receivers: PointReceivers) -> np.ndarray:
        """Shading of points [point, 3] by log-SH of order 8 whose exponential has converged."""
        points, normals = self._arrays(receivers)
        log = accumulate(points, normals, self.geometry.centers, self.geometry.radii, order=8)
        transfer = sh_transfer(exponentiate(log, threshold=CONVERGED), normals, order=8)
        return shade(transfer, wp.array(self.scene.light.sh(8)[None], dtype=wp.vec3)).numpy()[0]

    def _shade(self, receivers: PointReceivers, seen: np.ndarray) -> np.ndarray:
        cosine = np.maximum(receivers.normals @ self.directions.T.astype(np.float32), 0)
        lit = (seen * cosine) @ self.radiance / np.pi
        return np.einsum("pk,pkc->pc", receivers.weights, lit[receivers.corners])

    def _arrays(self, receivers: PointReceivers) -> tuple[wp.array, wp.array]:
        return tuple(wp.array(values[None], dtype=wp.vec3) for values in (receivers.points, receivers.normals))

    def _towards(self) -> wp.array:
        return wp.array(self.directions, dtype=wp.vec3)


# ---------------------------------------------------------------------------------------------- picture


def plot(results: dict[str, dict], path: Path) -> None:
    """Draw error over time for each scene: with the Pareto front of our settings, or with the number of bounces."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    columns = min(len(results), 4)
    rows = -(-len(results) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(5.5 * columns, 4.5 * rows), squeeze=False)
    for axis in axes.flat[len(results) :]:
        axis.axis("off")
    for axis, (name, result) in zip(axes.flat, results.items(), strict=False):
        measured = [Measured(**each) for each in result["settings"]]
        for family, color in COLORS.items():
            of_family = sorted((each.milliseconds, 100 * each.error) for each in measured if each.family == family)
            style = "o-" if family in ("Mitsuba", "ray-traced") else "o"
            if of_family:
                axis.plot(*zip(*of_family, strict=True), style, color=color, markersize=4, alpha=0.7, label=family)
        if "front" in result:
            front = [(each.milliseconds, 100 * each.error) for each in measured if each.label in result["front"]]
            axis.step(*zip(*sorted(front), strict=True), where="post", color="k", linewidth=1, label="Pareto front")
            default = next(each for each in measured if each.label == result["default"])
            axis.plot(default.milliseconds, 100 * default.error, "k*", markersize=13, label="default")
        else:
            for each in (each for each in measured if each.family == "directional"):
                at = (each.milliseconds, 100 * each.error)
                axis.annotate(each.details or "direct light", at, (6, 3), textcoords="offset points", fontsize=8)
        axis.set(xscale="log", yscale="log", xlabel="image [ms]", ylabel="error [%]", title=name)
        for each in (axis.xaxis, axis.yaxis):
            each.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter("{x:g}")
        axis.grid(which="both", alpha=0.2)
    axes.flat[len(results) - 1].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with meshes/ and envmaps/")
    parser.add_argument("--output", type=Path, default=Path("out"), help="folder for the JSON and the picture")
    parser.add_argument("--runs", type=int, default=5, help="timed calls of each setting")
    parser.add_argument(
        "--light", nargs="+", choices=["direct", "full"], default=["direct", "full"], help="what errors are against"
    )
    parser.add_argument(
        "--scenes", nargs="+", choices=[*THREE, *SCENES, *SHINING], default=[*THREE, *KINDS], help="which scenes"
    )
    parser.add_argument("--quick", action="store_true", help="a ball on a ground of few pixels, to try it out")
    parser.add_argument("--one-thread", action="store_true", help="one thread for all, and its time of the processor")
    arguments = parser.parse_args()
    if arguments.one_thread:
        ws.set_thread_count(1)
    main(arguments.data, arguments.output, arguments.runs, arguments.quick, arguments.light, arguments.scenes)
