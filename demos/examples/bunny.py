"""The main job, on meshes that ship with Warp: soft shadows by every method, then the light recovered from an image.

    make demo        or        python demos/examples/bunny.py --output out

A bunny stands on a textured ground under an HDR sky with a sun. It is rendered without shadows, with each method,
and ray traced. Then the light is forgotten and recovered from the ray-traced image, once by a renderer with shadows
and once by one without (direct illumination), and both estimates relight a bear.
"""

import argparse
import dataclasses
import sys
import time
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.scenes import image_error, on_ground, shipped_mesh
from warpshadow.torch import TorchRenderer

METHODS = {
    "no shadows": ws.Visibility(method="none"),
    "log-SH, cap": ws.Visibility(method="log-sh", log="cap"),
    "log-SH, eigen": ws.Visibility(method="log-sh"),
    "directional": ws.Visibility(method="directional"),
}
RAY_TRACED = ws.Visibility(method="ray-traced", samples=400)
LIGHT_ORDER = 5


def main(output: Path, iterations: int) -> None:
    ws.quiet()
    start = time.perf_counter()
    output.mkdir(parents=True, exist_ok=True)

    sky_file = output / "sky.exr"
    ws.synthetic_sky((-0.75, 0.6, -0.1), sun_strength=2.0, sun_radius=5.0).write(sky_file)
    sky = ws.EnvironmentMap.read(sky_file)
    ground = ws.Body(ws.plane(6.0, 64), texture=checkers())
    bunny, bear = (on_ground(shipped_mesh(name), sky, ground=ground) for name in ("bunny", "bear"))

    print("rendering the bunny")
    truth, truth_seconds = timed(bunny, RAY_TRACED)
    ws.write_image(output / "ray_traced.exr", truth)
    panels = []
    for label, visibility in METHODS.items():
        timed(bunny, visibility)  # compiles kernels and fits spheres
        image, seconds = timed(bunny, visibility)
        panels.append((image, f"{label}\n{image_error(image, truth):.1%} error, {1e3 * seconds:.0f} ms"))
        ws.write_image(output / f"{label.replace(', ', '_').replace(' ', '_')}.exr", image)
    panels.append((truth, f"ray traced\n{RAY_TRACED.samples} directions, {1e3 * truth_seconds:.0f} ms"))

    print(f"recovering {LIGHT_ORDER**2} SH coefficients of the light from the ray-traced image")
    relit_truth, _ = timed(bear, RAY_TRACED)
    relit = []
    for label, visibility in (("directional", METHODS["directional"]), ("no shadows", METHODS["no shadows"])):
        estimate, seconds = recover_light(bunny, visibility, truth, iterations)
        image, _ = timed(dataclasses.replace(bear, light=estimate), METHODS["directional"])
        relit.append(
            (image, f"light recovered with {label}\n{image_error(image, relit_truth):.1%} error, {seconds:.1f} s")
        )
        np.save(output / f"light_{label.replace(' ', '_')}.npy", estimate)
    relit.append((relit_truth, "true light\nray traced"))

    sheet = contact_sheet([panels, relit])
    sheet.save(output / "demo.png")
    for _, caption in panels + relit:
        name, figures = caption.split("\n")
        print(f"  {name:38}{figures}")
    print(f"{output / 'demo.png'} and EXR files beside it; {time.perf_counter() - start:.0f} s in all")


def checkers(size: int = 512, tiles: int = 12) -> np.ndarray:
    """A linear RGB texture of two-colored tiles with a little grain."""
    row, column = np.indices((size, size)) * tiles // size
    colors = np.array([[0.55, 0.53, 0.5], [0.32, 0.36, 0.42]])[(row + column) % 2]
    grain = np.random.default_rng(0).uniform(0.9, 1.1, (size, size, 1))
    return (colors * grain).astype(np.float32)


def timed(scene: ws.Scene, visibility: ws.Visibility) -> tuple[np.ndarray, float]:
    """Render a scene from nothing kept but kernels and sphere fits."""
    start = time.perf_counter()
    image = ws.render(dataclasses.replace(scene, visibility=visibility), progress=True)
    return image, time.perf_counter() - start


def recover_light(
    scene: ws.Scene, visibility: ws.Visibility, target: np.ndarray, iterations: int
) -> tuple[np.ndarray, float]:
    """Fit SH light to an image with Adam, from darkness."""
    start = time.perf_counter()
    renderer = TorchRenderer(dataclasses.replace(scene, visibility=visibility), basis=ws.HarmonicBasis(LIGHT_ORDER))
    wanted = torch.from_numpy(target)
    light = torch.zeros(LIGHT_ORDER**2, 3, requires_grad=True)
    optimizer = torch.optim.Adam([light], lr=0.1)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, iterations)
    for _ in range(iterations):
        optimizer.zero_grad()
        torch.nn.functional.mse_loss(renderer(light), wanted).backward()
        optimizer.step()
        schedule.step()
    return light.detach().numpy(), time.perf_counter() - start


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
    parser.add_argument("--iterations", type=int, default=150, help="Adam steps of each recovery")
    arguments = parser.parse_args()
    main(arguments.output, arguments.iterations)
