"""How right images are on scenes of all kinds, body by body: stills and renderers, direct and bounced light.

    python demos/benchmarks/scenes_of_all_kinds.py [--scenes NAME ...] [--data FOLDER] [--size 256] [--jobs 1]
        [--settings still-direct renderer-direct still-full renderer-full] [--mitsuba] [--output FOLDER]

The scenes are those of demos/kinds.py. A still is ``ws.render``, an image of a renderer
``ws.Renderer(scene).render()``. Direct light is compared with rays, full light, ``bounces = "all"`` (or as many as
``--bounces`` says), with paths of all bounces, both by method "ray-traced". For each scene and setting the demo prints,
in percent

    error    relative L2 error of color over wholly covered pixels, as in the other demos
    bodies   of each body, how much brighter its pixels are on average: the worst first, as many as --bodies says
    block    the worst block of 8 × 8 pixels: root mean square of its error over the mean of the image

References are rendered twice, the second time with scene and light turned about the y axis, which draws other rays. The
first two figures are against the mean of both, with its noise, half their difference, taken off. They stay in
OUTPUT/references by a hash of all that they depend on, so that a second run renders ours alone.

Where a still and a renderer's image of one light are asked for, "still to renderer" is their relative L2 difference
over pixels that are wholly covered.

Also printed: CPU seconds of the first image (* where the cache lacked a fit, self-shadows or form factors of it; the
very first run also compiles kernels); CPU milliseconds of an image after all bodies moved; the most memory that the
scene's process had up to each setting. With ``--mitsuba`` the references are compared with Mitsuba's, and ours with
both. A contact sheet for each scene shows reference, still and renderer, and in red where they are too bright, in blue
where too dark. results.json has all figures.
"""

import argparse
import dataclasses
import json
import multiprocessing
import statistics
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.kinds import SCENES, Sources
from demos.references import Reference, Request
from warpshadow.assets.cache import KINDS, cached_files
from warpshadow.scene.scene import Bounces

SETTINGS = ("still-direct", "renderer-direct", "still-full", "renderer-full")
ALL_BOUNCES = 16
FULL_COLOR = 0.5  # difference, over the mean of the image, that is as red or blue as can be
MOVED_RUNS = 3
MIN_TILE = 256  # pixels across a picture of the contact sheet
SEEN = 0.95  # share of pixels of the reference that the contact sheet does not clip


@dataclass(frozen=True)
class Options:
    """What does not differ between scenes.

    Args:
        data: Folder with meshes/ and envmaps/.
        size: Pixels across and down.
        samples: Rays, or paths, of a pixel of a reference; half of them in each of its two images.
        bounces: Of ours, in full light: a number, or "all".
        settings: Some of SETTINGS.
        output: Folder of pictures, figures and references.
        references: Folder of references.
        mitsuba: Samples of Mitsuba, for a pixel; 0 for none.
    """

    data: Path | None = None
    size: int = 256
    samples: int = 2048
    bounces: Bounces = "all"
    settings: tuple[str, ...] = SETTINGS
    output: Path = Path("out/scenes_of_all_kinds")
    references: Path = Path("out/references")
    mitsuba: int = 0

    def scene(self, name: str) -> ws.Scene:
        """One of SCENES."""
        return SCENES[name](Sources(self.data), self.size)

    def request(self, name: str, light: str, by: str) -> Request:
        """A reference of a scene, in "direct" or "full" light, by "rays" or "mitsuba"."""
        samples = self.samples if by == "rays" else self.mitsuba
        return Request(self.scene(name), by, ALL_BOUNCES if light == "full" else 0, samples, self.references)

    def lights(self) -> list[str]:
        """The lights, "direct" and "full", that settings ask for."""
        return [light for light in ("direct", "full") if any(setting.endswith(light) for setting in self.settings)]


# -------------------------------------------------------------------------------- measurements


def measure(name: str, options: Options) -> dict[str, Any]:
    """Render a scene in all settings, compare, draw the contact sheet; a process of its own tells memory apart."""
    ws.quiet(progress=False)
    warnings.simplefilter("ignore")  # of coarse meshes and thin bodies: how wrong they are, is measured here
    scene = options.scene(name)
    names = [body.name for body in scene.bodies]
    references = {light: options.request(name, light, "rays").reference() for light in options.lights()}
    checks = {}
    if options.mitsuba:
        checks = {light: options.request(name, light, "mitsuba").reference() for light in options.lights()}
    result: dict[str, Any] = {"references": {}, "settings": {}}
    for light, truth in references.items():
        result["references"][light] = {"noise": truth.noise()}
        if light in checks:
            theirs = checks[light]
            spread = np.hypot(theirs.noise(), truth.noise())
            difference = relative(truth.mean, theirs.mean, theirs.covered & truth.covered)
            result["references"][light] |= {
                "noise of Mitsuba": theirs.noise(),
                "error to Mitsuba": float(np.sqrt(max(difference**2 - spread**2, 0.0))),
                "brighter than Mitsuba": brighter(truth.mean, theirs.mean, theirs.covered & truth.covered),
                "bodies to Mitsuba": dict(zip(names, theirs.body_errors(truth.mean, len(names)), strict=True)),
            }
    images = {}
    for setting in options.settings:
        kind, light = setting.split("-")
        lit = dataclasses.replace(scene, bounces=options.bounces if light == "full" else 0)
        before = cached_counts()
        image, figures = (still if kind == "still" else of_renderer)(lit)
        figures["made"] = {each: count - before[each] for each, count in cached_counts().items()}
        truth = references[light]
        block, place = truth.worst_block(image)
        figures |= {"error": truth.error(image), "block": block, "block at": place}
        figures["bodies"] = dict(zip(names, truth.body_errors(image, len(names)), strict=True))
        if light in checks:
            figures["error to Mitsuba"] = checks[light].error(image)
        result["settings"][setting] = figures
        images[setting] = image
    result["still to renderer"] = {
        light: relative(images[f"renderer-{light}"], images[f"still-{light}"], references[light].covered)
        for light in options.lights()
        if {f"still-{light}", f"renderer-{light}"} <= set(images)
    }
    draw_sheet(name, images, references, result, options.output / f"{name}.png")
    return result


def still(scene: ws.Scene) -> tuple[np.ndarray, dict[str, Any]]:
    """A picture that is made once, and what it took."""
    start = time.process_time()
    image = ws.render(scene, progress=False)
    return image, {"first CPU s": time.process_time() - start, "peak MiB": peak_mebibytes()}


def of_renderer(scene: ws.Scene) -> tuple[np.ndarray, dict[str, Any]]:
    """The picture of a renderer, and what it and those of moved bodies take."""
    from warpshadow.tuning.timing import whole_image

    start = time.process_time()
    renderer = ws.Renderer(scene, progress=False)
    image = renderer.render()
    figures: dict[str, Any] = {"first CPU s": time.process_time() - start}
    moved = whole_image(renderer)
    moved()
    runs = [timed(moved) for _ in range(MOVED_RUNS)]
    cpu, wall = (statistics.median(column) for column in zip(*runs, strict=True))
    return image, figures | {"moved CPU ms": 1e3 * cpu, "moved ms": 1e3 * wall, "peak MiB": peak_mebibytes()}


def cached_counts() -> dict[str, int]:
    """How many fits, self-shadows and form factors the cache has."""
    return {kind: len(cached_files(kind)) for kind in KINDS}


def timed(function: Callable[[], object]) -> tuple[float, float]:
    """CPU seconds, of all threads, and seconds by the clock of a call."""
    cpu, wall = time.process_time(), time.perf_counter()
    function()
    return time.process_time() - cpu, time.perf_counter() - wall


def peak_mebibytes() -> float | None:
    """The most memory that this process ever had; None where the system does not tell."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))


def relative(image: np.ndarray, truth: np.ndarray, pixels: np.ndarray) -> float:
    """Relative L2 difference."""
    return float(np.linalg.norm((image - truth)[pixels, :3]) / np.linalg.norm(truth[pixels, :3]))


def brighter(image: np.ndarray, truth: np.ndarray, pixels: np.ndarray) -> float:
    """How much brighter an image is on average."""
    return float(image[pixels, :3].mean() / truth[pixels, :3].mean() - 1)


# -------------------------------------------------------------------------------- contact sheet


def draw_sheet(
    name: str, images: dict[str, np.ndarray], references: dict[str, Reference], result: dict[str, Any], path: Path
) -> None:
    """Write the pictures of a scene: a row for each light, of the reference, our images and their differences."""
    from PIL import Image, ImageDraw

    rows = []
    for light, truth in references.items():
        ours = {setting: image for setting, image in images.items() if setting.endswith(light)}
        mean = truth.mean[truth.covered, :3].mean()
        exposure = 0.85 / max(np.quantile(truth.mean[truth.covered, :3], SEEN), 1e-9)
        tiles = [(f"{name}, {light}: reference", encoded(truth.mean, exposure))]
        for setting, image in ours.items():
            figures = result["settings"][setting]
            tiles.append((f"{setting} {figures['error']:.1%}", encoded(image, exposure)))
        for setting, image in ours.items():
            signed = np.where(truth.covered, (image - truth.mean)[..., :3].mean(axis=-1) / mean, 0) / FULL_COLOR
            red, blue = (np.clip(sign * signed, 0, 1)[..., None] for sign in (1, -1))
            color = 1 - red * (0, 1, 1) - blue * (1, 1, 0)
            tiles.append((f"{setting}, difference", np.uint8(255 * color)))
        rows.append(tiles)
    label, times = 16, max(1, MIN_TILE // len(next(iter(images.values()))))
    height, width = (times * length for length in next(iter(images.values())).shape[:2])
    sheet = Image.new("RGB", (max(map(len, rows)) * width, len(rows) * (height + label)), "white")
    for row, tiles in enumerate(rows):
        for column, (text, pixels) in enumerate(tiles):
            corner = column * width, row * (height + label)
            ImageDraw.Draw(sheet).text((corner[0] + 2, corner[1] + 2), text, fill="black")
            enlarged = pixels.repeat(times, axis=0).repeat(times, axis=1)
            sheet.paste(Image.fromarray(enlarged), (corner[0], corner[1] + label))
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(path)


def encoded(image: np.ndarray, exposure: float) -> np.ndarray:
    """Linear RGB as sRGB of 8 bits."""
    return np.uint8(255 * ws.linear_to_srgb(np.clip(exposure * image[..., :3], 0, 1)) + 0.5)


# -------------------------------------------------------------------------------- by itself


def main(names: Sequence[str], options: Options, *, jobs: int = 1, body_count: int = 6) -> dict[str, Any]:
    """Measure scenes, each in a process of its own; print the figures and write them."""
    ws.quiet(progress=False)
    unknown = [name for name in names if name not in SCENES]
    if unknown:
        raise ValueError(f"scenes: got {', '.join(unknown)}, expected some of {', '.join(SCENES)}")
    print(f"{processor()}; {options.size}² pixels, {options.samples} samples, {options.bounces} bounces")
    print(f"{'':34}{'error':>7}{'block':>8}{'first':>10}{'moved':>9}{'memory':>10}  bodies", flush=True)
    results: dict[str, Any] = {}
    options.output.mkdir(parents=True, exist_ok=True)
    path = options.output / "results.json"
    context = multiprocessing.get_context("spawn")
    with (
        ProcessPoolExecutor(jobs, mp_context=context, max_tasks_per_child=1) as processes,
        ThreadPoolExecutor(jobs) as threads,
    ):

        def measured(name: str) -> dict[str, Any]:
            """What a process finds, after another one has made the references."""
            if missing_references(name, options):
                processes.submit(make_references, name, options).result()
            return processes.submit(measure, name, options).result()

        for name, result in zip(names, threads.map(measured, names), strict=True):
            results[name] = result
            print_scene(name, result, body_count)
            found = {"options": described(options), "scenes": results}
            path.write_text(json.dumps(found, indent=1, ensure_ascii=False))
    print_means(results, options)
    print(f"{path}, and a picture of each scene beside it")
    return results


def missing_references(name: str, options: Options) -> list[Request]:
    """References of a scene that are not there."""
    makers = ["rays", "mitsuba"] if options.mitsuba else ["rays"]
    wanted = [options.request(name, light, by) for light in options.lights() for by in makers]
    return [request for request in wanted if not request.path().exists()]


def make_references(name: str, options: Options) -> None:
    """Make and keep the references of a scene that are not there."""
    ws.quiet(progress=False)
    warnings.simplefilter("ignore")
    for request in missing_references(name, options):
        request.reference()


def print_scene(name: str, result: dict[str, Any], body_count: int) -> None:
    """Print the figures of a scene, a line a setting, and how far the references are from Mitsuba's."""
    for setting, figures in result["settings"].items():
        moved = f"{figures['moved CPU ms']:6.0f} ms" if "moved CPU ms" in figures else ""
        memory = "" if figures["peak MiB"] is None else f"{figures['peak MiB']:6.0f} MiB"
        first = f"{figures['first CPU s']:.1f} s{'*' if any(figures['made'].values()) else ' '}"
        bodies = ", ".join(f"{body} {error:+.1%}" for body, error in worst_bodies(figures["bodies"])[:body_count])
        errors = f"{figures['error']:7.1%}{figures['block']:8.0%}"
        theirs = f"; to Mitsuba {figures['error to Mitsuba']:.1%}" if "error to Mitsuba" in figures else ""
        print(f"{name:20}{setting:14}{errors}{first:>10}{moved:>9}{memory:>10}  {bodies}{theirs}")
    for light, figures in result["references"].items():
        line = f"{name:20}{light + ' rays':14} noise {figures['noise']:.1%}"
        if "error to Mitsuba" in figures:
            bodies = worst_bodies(figures["bodies to Mitsuba"])[:body_count]
            line += f", to Mitsuba {figures['error to Mitsuba']:.1%}, {figures['brighter than Mitsuba']:+.2%}; "
            line += ", ".join(f"{body} {error:+.1%}" for body, error in bodies)
        print(line)
    for light, difference in result["still to renderer"].items():
        print(f"{name:20}{light + ' light':14} still to renderer {difference:.1%}")
    sys.stdout.flush()


def worst_bodies(errors: dict[str, float | None]) -> list[tuple[str, float]]:
    """Bodies that are seen, those that are farthest off first."""
    known = [(body, error) for body, error in errors.items() if error is not None]
    return sorted(known, key=lambda item: -abs(item[1]))


def print_means(results: dict[str, Any], options: Options) -> None:
    """Print what all scenes together say of each setting."""
    for setting in options.settings:
        figures = {name: result["settings"][setting] for name, result in results.items()}
        errors = {name: each["error"] for name, each in figures.items()}
        bodies = {name: worst_bodies(each["bodies"])[0] for name, each in figures.items()}
        worst, worst_body = (
            max(errors, key=lambda name: errors[name]),
            max(bodies, key=lambda name: abs(bodies[name][1])),
        )
        print(
            f"{setting}: mean error {statistics.mean(errors.values()):.1%}, worst {errors[worst]:.1%} ({worst}); "
            f"worst body {bodies[worst_body][1]:+.1%} ({bodies[worst_body][0]}, {worst_body})"
        )
    for light in next(iter(results.values()))["still to renderer"]:
        differences = {name: result["still to renderer"][light] for name, result in results.items()}
        worst = max(differences, key=lambda name: differences[name])
        print(
            f"{light} light, still to renderer: mean {statistics.mean(differences.values()):.1%}, "
            f"worst {differences[worst]:.1%} ({worst})"
        )


def processor() -> str:
    """The CPU's name, and how many of its cores there are."""
    from demos.benchmarks.lane_choice import cpu_text

    return cpu_text().splitlines()[0]


def bounce_count(text: str) -> Bounces:
    """What ``--bounces`` says."""
    return "all" if text == "all" else int(text)


def described(options: Options) -> dict[str, Any]:
    """Options, for JSON."""
    given = dataclasses.asdict(options) | {"cpu": processor()}
    return {name: str(value) if isinstance(value, Path) else value for name, value in given.items()}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--scenes", nargs="+", default=list(SCENES), metavar="NAME", help=f"some of {', '.join(SCENES)}"
    )
    parser.add_argument("--data", type=Path, help="folder with meshes/ and envmaps/")
    parser.add_argument("--size", type=int, default=Options.size, help="pixels across and down")
    parser.add_argument("--samples", type=int, default=Options.samples, help="rays of a pixel of a reference")
    parser.add_argument("--bounces", type=bounce_count, default=Options.bounces, help="of ours, in full light")
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=SETTINGS)
    parser.add_argument("--mitsuba", type=int, nargs="?", const=1024, default=0, metavar="SAMPLES", help="compare, too")
    parser.add_argument("--output", type=Path, default=Options.output, help="folder of pictures and figures")
    parser.add_argument("--references", type=Path, default=Options.references, help="folder where references stay")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time")
    parser.add_argument("--bodies", type=int, default=6, help="how many bodies are printed, the worst first")
    given = vars(parser.parse_args())
    names, jobs, body_count = given.pop("scenes"), given.pop("jobs"), given.pop("bodies")
    main(names, Options(**given | {"settings": tuple(given["settings"])}), jobs=jobs, body_count=body_count)
