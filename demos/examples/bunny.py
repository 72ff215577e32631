"""The main job, on meshes that ship with Warp: soft shadows, light that bounces, and the light recovered from an image.

    make demo        or        python demos/examples/bunny.py --output out

A bunny stands on a textured ground under an HDR sky with a sun. It is rendered without shadows, with them, with light
that bounces, and by a path tracer that follows all bounces. Then the light is forgotten and recovered from the path
traced image, by renderers that know of as much, and each estimate relights a bear.
"""

import argparse
import dataclasses
import functools
import multiprocessing
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.scenes import image_error, on_ground, shipped_mesh
from warpshadow import inverse

BOUNCES = 2
ALL_BOUNCES = 8  # of the path tracer: what comes after is 0.1% of the light
SAMPLES = 800  # of the path tracer, for a pixel: noise of 2.6%
CELLS = 512  # of the light that is recovered: it is never negative


def main(output: Path, iterations: int) -> None:
    ws.quiet()
    start = time.perf_counter()
    output.mkdir(parents=True, exist_ok=True)

    sky_file = output / "sky.exr"
    ws.synthetic_sky((-0.75, 0.6, -0.1), sun_strength=2.0, sun_radius=5.0).write(sky_file)
    sky = ws.EnvironmentMap.read(sky_file)
    ground = ws.Body(ws.plane(6.0, 64), texture=checkers())
    bunny, bear = (on_ground(shipped_mesh(name), sky, ground=ground) for name in ("bunny", "bear"))

    # another process traces the paths, while this one compiles kernels, fits spheres and traces self-shadows
    quiet, processes = functools.partial(ws.quiet, progress=False), multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, processes, initializer=quiet) as beside:
        references = [beside.submit(ws.render, path_traced(scene)) for scene in (bunny, bear)]
        print("rendering the bunny")
        for scene in (*models(bunny).values(), models(bear)[f"{BOUNCES} bounces"]):
            ws.render(scene)
        truth, relit_truth = (reference.result() for reference in references)

    ws.write_image(output / "path_traced.exr", truth)
    panels = []
    for label, scene in models(bunny).items():
        beginning = time.perf_counter()
        image = ws.render(scene)
        seconds = time.perf_counter() - beginning
        panels.append((image, f"{label}\n{image_error(image, truth):.1%} error, {1e3 * seconds:.0f} ms"))
        ws.write_image(output / f"{label.replace(' ', '_')}.exr", image)
    panels.append((truth, f"path traced\n{SAMPLES} samples"))

    print(f"recovering {CELLS} cells of the light from the path traced image")
    relit = []
    for label, scene in models(bunny).items():
        light, seconds = recover_light(scene, truth, iterations)
        light.write(output / f"light_{label.replace(' ', '_')}.exr")
        image = ws.render(dataclasses.replace(models(bear)[f"{BOUNCES} bounces"], light=light))
        relit.append((image, f"light by {label}\n{image_error(image, relit_truth):.1%} error, {seconds:.1f} s"))
    relit.append((relit_truth, "true light\npath traced"))

    sheet = contact_sheet([panels, relit])
    sheet.save(output / "demo.png")
    for _, caption in panels + relit:
        name, figures = caption.split("\n")
        print(f"  {name:38}{figures}")
    print(f"{output / 'demo.png'} and EXR files beside it; {time.perf_counter() - start:.0f} s in all")


def models(scene: ws.Scene) -> dict[str, ws.Scene]:
    """A scene as renderers see it that know of more and more."""
    by_spheres = dataclasses.replace(scene, visibility=ws.Visibility(method="directional"))
    return {
        "no shadows": dataclasses.replace(scene, visibility=ws.Visibility(method="none")),
        "shadows": by_spheres,
        f"{BOUNCES} bounces": dataclasses.replace(by_spheres, bounces=BOUNCES),
    }


def path_traced(scene: ws.Scene) -> ws.Scene:
    """A scene as it is, all but the noise."""
    visibility = ws.Visibility(method="ray-traced", samples=SAMPLES)
    return dataclasses.replace(scene, visibility=visibility, bounces=ALL_BOUNCES)


def checkers(size: int = 512, tiles: int = 12) -> np.ndarray:
    """A linear RGB texture of two-colored tiles with a little grain."""
    row, column = np.indices((size, size)) * tiles // size
    colors = np.array([[0.55, 0.53, 0.5], [0.32, 0.36, 0.42]])[(row + column) % 2]
    grain = np.random.default_rng(0).uniform(0.9, 1.1, (size, size, 1))
    return (colors * grain).astype(np.float32)


def recover_light(scene: ws.Scene, target: np.ndarray, iterations: int) -> tuple[ws.EnvironmentMap, float]:
    """Fit a map of light to an image, from a gray sky: with rays past what does not move, if the scene has shadows."""
    start = time.perf_counter()
    unknown = dataclasses.replace(scene, light=ws.EnvironmentMap.constant(0.5))
    still = ws.Visibility(method="none" if scene.visibility.method == "none" else "ray-traced")
    light = inverse.Light(directions=CELLS)
    problem = inverse.Problem(unknown, inverse.Target(target), light, still=still)
    # a quarter of the pixels tells as much of the light
    stage = inverse.Stage(iterations, learning_rate=0.15, scale=0.5)
    result = inverse.fit(problem, [stage], progress=True)
    return result.scene.light, time.perf_counter() - start


def contact_sheet(rows: list[list[tuple[np.ndarray, str]]], margin: int = 44) -> Image.Image:
    """Images side by side with captions under them, each row under one exposure."""
    height, width, _ = rows[0][0][0].shape
    sheet = Image.new("RGB", (width * max(map(len, rows)), (height + margin) * len(rows)), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=14)
    for top, row in enumerate(rows):
        truth = row[-1][0]
        white = np.percentile(truth[truth[..., 3] > 0, :3], 99.5)
        for left, (image, caption) in enumerate(row):
            color = np.clip(image[..., :3] / white, 0, 1) + (1 - image[..., 3:])
            picture = Image.fromarray((255 * ws.linear_to_srgb(np.minimum(color, 1)) + 0.5).astype(np.uint8))
            corner = (left * width, top * (height + margin))
            sheet.paste(picture, corner)
            draw.multiline_text((corner[0] + 6, corner[1] + height + 4), caption, fill="black", font=font)
    return sheet


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("out"), help="folder for the pictures")
    parser.add_argument("--iterations", type=int, default=500, help="steps of each recovery")
    arguments = parser.parse_args()
    main(arguments.output, arguments.iterations)
