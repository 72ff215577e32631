"""Take the photographs of ``cases.py``: path traced by Mitsuba 3, then lens, sensor and JPEG.

    pip install mitsuba
    python demos/examples/photographs/take.py
    python demos/examples/photographs/take.py lamp_1m lamp_2m  # these alone

The pictures lie beside this file, so that ``table.py`` needs no Mitsuba.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy import ndimage

sys.path.append(str(Path(__file__).parents[3]))  # the folder of demos
import warpshadow as ws
from demos.examples.photograph import PhotoCamera
from demos.examples.photographs.cases import BODY, CASES, FOLDER, SIZE, Case, alone
from warpshadow.assets.lens import distorted

FINER, MARGIN = 2, 60  # pixels of the rendered image in one of the photograph; and around it
SAMPLES = 256


def path_traced(case: Case, folder: Path) -> np.ndarray:
    """Linear RGB of a pinhole, finer and wider than the photograph, [height, width, 3]."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    truth = case.truth()
    mesh = truth.bodies[0].world_mesh()
    lines = [f"v {x} {y} {z}" for x, y, z in mesh.positions.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    (folder / "body.obj").write_text("\n".join(lines))
    camera = case.camera
    width, height = (FINER * (count + 2 * MARGIN) for count in SIZE)
    focal = FINER * camera.intrinsics[1, 1]
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 8},
        "sensor": {
            "type": "perspective",
            "fov": float(2 * np.degrees(np.arctan(height / 2 / focal))),
            "fov_axis": "y",
            "to_world": mi.ScalarTransform4f().look_at(origin=[1.6, 2.6, 4.6], target=[0, 0.75, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
            "sampler": {"type": "independent", "sample_count": SAMPLES // FINER**2},
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.22, 0.25, 0.3]}},
        "lamp": {
            "type": "sphere",
            "center": list(case.lamp),
            "radius": 0.35,
            "emitter": {
                "type": "area",
                "radiance": {"type": "rgb", "value": [case.wattage * value for value in (34, 30, 24)]},
            },
        },
        "body": {"type": "obj", "filename": str(folder / "body.obj"), "bsdf": material(case, list(case.albedo))},
        "table": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(15),
            "bsdf": material(case, {"type": "bitmap", "bitmap": mi.Bitmap(grain()), "raw": True}),
        },
    }
    return np.array(mi.render(mi.load_dict(scene)))[..., :3]


def material(case: Case, color: Any) -> dict[str, Any]:
    """A matte surface, or one under a coat."""
    color = {"type": "rgb", "value": color} if isinstance(color, list) else color
    if not case.gloss:
        return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": color}}
    return {"type": "twosided", "bsdf": {"type": "roughplastic", "diffuse_reflectance": color, "alpha": 0.15}}


def grain(size: int = 1024) -> np.ndarray:
    """Albedo of a table of wood: 8% darker and brighter, in streaks."""
    noise = np.random.default_rng(1).standard_normal((size, size))
    streaks = ndimage.gaussian_filter(noise, (1.0, 12.0), mode="wrap")
    albedo = 0.5 * (1 + 0.08 * np.clip(streaks / streaks.std(), -2, 2))
    return (albedo[..., None] * np.array([1.1, 1.0, 0.85])).astype(np.float32)


def through_the_lens(case: Case, image: np.ndarray, order: int = 1) -> np.ndarray:
    """What the lens makes of a finer and wider image of a pinhole, [height, width, channel] of the photograph."""
    camera, (width, height) = case.camera, SIZE
    inner = (np.arange(FINER) + 0.5) / FINER
    column = (np.arange(width)[:, None] + inner).ravel()
    row = (np.arange(height)[:, None] + inner).ravel()
    u, v = np.meshgrid(column, row)
    bent = (np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.intrinsics).T)[..., :2]
    plane = bent
    for _ in range(20):  # the inverse of the lens has no formula
        plane = bent - (distorted(plane, np.array(case.lens)) - plane)
    u, v = np.moveaxis((np.concatenate([plane, np.ones_like(u)[..., None]], -1) @ camera.intrinsics.T)[..., :2], -1, 0)
    places = [FINER * (v + MARGIN) - 0.5, FINER * (u + MARGIN) - 0.5]
    planes = [ndimage.map_coordinates(image[..., k], places, order=order) for k in range(image.shape[2])]
    fine = np.stack(planes, axis=-1)
    return fine.reshape(height, FINER, width, FINER, -1).mean(axis=(1, 3))


def masks(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """The body as somebody paints it, and where the table and the body are: 0 or 1, as the pinhole would see them.

    Corners are rounded, and the edge is out by up to a pixel.
    """
    truth = case.truth()
    body = ws.render(alone(truth, 0))[..., 3]
    wobble = ndimage.gaussian_filter(np.random.default_rng(2).standard_normal(body.shape), 6)
    painted = ndimage.gaussian_filter(body, 1.0) > 0.5 + 0.25 * np.clip(wobble / wobble.std(), -1, 1)
    known = np.maximum(ws.render(alone(truth, 1))[..., 3], body) > 0.99
    return painted, ndimage.binary_erosion(known, iterations=2, border_value=1)


def main() -> None:
    ws.quiet()
    for number, case in enumerate(CASES):
        if sys.argv[1:] and case.name not in sys.argv[1:]:
            continue
        rng = np.random.default_rng(number)
        with tempfile.TemporaryDirectory() as folder:
            fine = path_traced(case, Path(folder))
        light = through_the_lens(case, fine)
        light *= 0.8 / np.percentile(light, 98)  # highlights saturate
        PhotoCamera().shoot(FOLDER / f"{case.name}.jpg", light, rng)
        for label, mask in zip((BODY, "mask"), masks(case), strict=True):
            if any(case.lens):  # painted on the photograph
                padded = np.pad(mask.astype(float), MARGIN, mode="edge").repeat(FINER, 0).repeat(FINER, 1)
                mask = through_the_lens(case, padded[..., None])[..., 0] > 0.5
            Image.fromarray((255 * mask).astype(np.uint8)).save(FOLDER / f"{case.name}_{label}.png")
        print(FOLDER / f"{case.name}.jpg", flush=True)


if __name__ == "__main__":
    main()
