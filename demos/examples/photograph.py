"""From a photograph: pose, exposure and reflectance, found by two fit files and nothing else.

    python demos/examples/photograph.py --output out

No photograph ships with the package, so one is taken of a ray-traced scene, as cameras take them: a bunny on a tiled
ground under a sky with a sun, and a gray card; at an exposure that nobody notes, through a lens that blurs, with the
noise of a sensor, clipped at white, as an 8-bit JPEG. With it go a mask, and the files that a user writes: scene.toml,
with the intrinsics of the camera, the measured light, and the bunny where it is not; pose.toml, which finds the bunny;
and reflectance.toml, which goes on from there and finds the ground without the shadow.

The same is done with the image as it was before all that, which tells what a photograph costs, and by direct
illumination, which tells what shadows are worth. Each has a folder, with the files that these commands would write:

    warpshadow fit pose.toml -o pose
    warpshadow fit reflectance.toml -o reflectance
"""

import argparse
import dataclasses
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy import ndimage

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.examples.bunny import checkers, contact_sheet
from demos.problems import DIRECT, changed, displaced, placement, pose_errors, ray_traced
from demos.scenes import image_error, on_ground, shipped_mesh
from warpshadow import inverse
from warpshadow.inverse.world import FittedScene
from warpshadow.maths.sh import equirectangular_directions

FOCAL_LENGTH, SENSOR_HEIGHT = 24.0, 15.6  # mm: as EXIF and the camera's data sheet have them
SIZE = 256  # pixels across and down
EXPOSURE = 0.32  # of the photograph, which the fits have to find
CARD = 0.18  # reflectance of a gray card
SUN, OTHER_SUN = (0.8, 0.65, -0.1), (-0.5, 0.6, 0.6)
SATURATED = ws.srgb_to_linear(np.float64(250 / 255))  # what a JPEG makes of white is not always 255
BUNNY, GROUND = 0, 1
PLAIN = ws.EnvironmentMap.constant(1.0)

POSE = """\
scene = "scene.toml"
stages = "pose"

[[target]]
image = "../{image}"
mask = "../mask.png"

[free]
exposure = true              # known: the light, and the card's reflectance

[[free.pose]]
body = 0

[[free.albedo]]
body = 0

[[free.albedo]]              # one color will do until the shadow is known
body = 1

[loss]
kind = "huber"
"""

REFLECTANCE = """\
scene = "pose/scene.toml"

[[target]]
image = "../{image}"
mask = "../mask.png"

[free]
exposure = true

[[free.albedo]]
body = 0

[[free.texture]]
body = 1
size = [128, 128]

[loss]
kind = "huber"

[still]                      # nothing moves, so shadows are those of rays
method = "{method}"
samples = 512

[optimizer]                  # the card is small: what it says of the exposure takes curvature to be heard
name = "lbfgs"
max_iter = 10

[[stage]]
iterations = 20
learning_rate = 1.0
"""


# ------------------------------------------------------------------------------------------------ the photograph


@dataclass(frozen=True)
class PhotoCamera:
    """A lens, a sensor and a file.

    Args:
        blur: Standard deviation of the point spread of the lens [pixels].
        full_well: Electrons of a pixel that is white: what shot noise depends on.
        read_noise: Standard deviation [electrons].
        quality: Of the JPEG.
    """

    blur: float = 0.7
    full_well: float = 6000.0
    read_noise: float = 6.0
    quality: int = 85

    def shoot(self, path: Path, light: np.ndarray, rng: np.random.Generator) -> None:
        """Write an 8-bit JPEG of what falls on the sensor, linear RGB [height, width, 3], of which 1 is white."""
        blurred = ndimage.gaussian_filter(light.astype(np.float64), (self.blur, self.blur, 0))
        electrons = rng.poisson(self.full_well * blurred) + rng.normal(0, self.read_noise, blurred.shape)
        encoded = ws.linear_to_srgb(np.clip(electrons / self.full_well, 0, 1))
        Image.fromarray(np.round(255 * encoded).astype(np.uint8)).save(path, quality=self.quality)


def make_mask(coverage: np.ndarray, photograph: np.ndarray) -> np.ndarray:
    """Pixels that count: the scene has a body for them and for all that is blurred into them, and none is saturated.

    Args:
        coverage: By bodies, [height, width].
        photograph: Linear RGB, [height, width, 3].
    """
    is_known = (coverage == 1) & (photograph < SATURATED).all(axis=-1)
    return ndimage.binary_erosion(is_known, iterations=2, border_value=1).astype(np.float32)


def backdrop(camera: ws.Camera, light: ws.EnvironmentMap) -> np.ndarray:
    """What a camera sees where no body is, linear RGB [height, width, 3]."""
    from scipy.spatial import cKDTree

    towards = equirectangular_directions(len(light.radiance)).reshape(-1, 3)
    _, nearest = cKDTree(towards).query(camera.rays()[1])
    return light.radiance.reshape(-1, 3)[nearest]


def sky(sun: tuple[float, float, float]) -> ws.EnvironmentMap:
    return ws.synthetic_sky(sun, sun_strength=3.0, sun_radius=3.0)


def true_scene() -> ws.Scene:
    """A bunny and a gray card on tiles; the card is a board that lies on the ground."""
    scene = on_ground(shipped_mesh("bunny"), sky(SUN), ground=ws.Body(ws.plane(6.0, 64), texture=checkers(128)))
    card = ws.Body(ws.plane(0.8, 8), albedo=(CARD,) * 3, blockers=0, translation=(0.8, 0.02, 1.1))
    focal = FOCAL_LENGTH / (SENSOR_HEIGHT / SIZE)  # pixels
    intrinsics = np.array([[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1]])
    camera = dataclasses.replace(scene.camera.resized(SIZE / scene.camera.width), intrinsics=intrinsics)
    return dataclasses.replace(scene, bodies=(*scene.bodies, card), camera=camera)


def first_guess(truth: ws.Scene, seed: int) -> ws.Scene:
    """What a user writes into a scene file: the bunny roughly where it is, and the colors of nothing but the card."""
    bunny = displaced(truth.bodies[BUNNY], np.random.default_rng(seed))
    scene = changed(truth, BUNNY, albedo=(0.5, 0.5, 0.5), **placement(bunny))
    return changed(scene, GROUND, albedo=(0.5, 0.5, 0.5), texture=None)


# ------------------------------------------------------------------------------------------------ the recipe


def write_recipe(folder: Path, scene: ws.Scene, image: str) -> None:
    """Write scene.toml, pose.toml and reflectance.toml for an image and its mask in the folder above."""
    ws.write_scene(scene, folder)
    method = "none" if scene.visibility.method == "none" else "ray-traced"
    (folder / "pose.toml").write_text(POSE.format(image=image))
    (folder / "reflectance.toml").write_text(REFLECTANCE.format(image=image, method=method))


def follow_recipe(folder: Path) -> inverse.Result:
    """Do what ``warpshadow fit`` does, twice."""
    for step in ("pose", "reflectance"):
        result = inverse.load_fit(folder / f"{step}.toml").run(progress=True)
        inverse.write_result(result, folder / step)
    return result


def measure(found: FittedScene, truth: ws.Scene) -> dict[str, float]:
    """How far a result is from the truth, in percent, and by how many degrees it is turned."""
    (body, ground), (true_body, true_ground) = (scene.bodies[:2] for scene in (found.scene, truth))
    pose = pose_errors(body, true_body)
    seen = ws.Renderer(dataclasses.replace(truth, visibility=DIRECT)).seen_texels(GROUND) >= 4  # samples: a pixel
    return {
        "MDE": pose["pose MDE"],
        "turn": float(np.degrees(pose["RE"])),
        "exposure": 100 * (found.exposures[0] / EXPOSURE - 1),
        "albedo": 100 * relative(body.albedo, true_body.albedo),
        "texture": 100 * relative(ground.texture[seen], true_ground.texture[seen]),
    }


def relative(found: np.ndarray, true: np.ndarray) -> float:
    """Relative L2 error."""
    return float(np.linalg.norm(found - true) / np.linalg.norm(true))


# ------------------------------------------------------------------------------------------------ the comparison


def main(output: Path) -> None:
    ws.quiet()
    torch.set_num_threads(1)
    began = time.perf_counter()
    truth = true_scene()
    start = first_guess(truth, seed=1)
    folder = output / "photograph"
    folder.mkdir(parents=True, exist_ok=True)
    traced = ray_traced(truth, 1024)
    photograph = take(folder, truth, traced)
    relit_truth = picture(truth, sky(OTHER_SUN))
    plain, relit = [], []
    for name, label, image, scene in (
        ("direct", "photograph, no shadows", "photo.jpg", dataclasses.replace(start, visibility=DIRECT)),
        ("clean", "clean image", "clean.exr", start),
        ("shadows", "photograph", "photo.jpg", start),
    ):
        write_recipe(folder / name, scene, image)
        found = follow_recipe(folder / name).found
        figures = measure(found, truth)
        relit_image = picture(found.scene, sky(OTHER_SUN))
        figures["relit"] = 100 * image_error(relit_image, relit_truth)
        print(f"{label + ':':24}" + ", ".join(f"{key} {value:.2f}" for key, value in figures.items()), flush=True)
        plain.append((picture(found.scene, PLAIN), f"{label}\ntexture {figures['texture']:.1f}% off"))
        relit.append((relit_image, f"{label}\nrelit {figures['relit']:.1f}% off"))
    opaque = np.ones((SIZE, SIZE, 1), np.float32)
    exposed = np.array([EXPOSURE] * 3 + [1], np.float32)
    seen = [
        (np.concatenate([photograph, opaque], axis=-1), "photograph\n8-bit JPEG"),
        (exposed * picture(start, truth.light), "where fits start"),
        (exposed * picture(found.scene, truth.light), f"found\nMDE {figures['MDE']:.2f}%"),
        (exposed * traced, "truth\nray traced"),
    ]
    plain.append((picture(truth, PLAIN), "truth\nin plain light"))
    relit.append((relit_truth, "truth\nin another light"))
    contact_sheet([seen, plain, relit]).save(output / "photograph.png")
    print(f"{output / 'photograph.png'}; {time.perf_counter() - began:.0f} s in all")


def take(folder: Path, truth: ws.Scene, traced: np.ndarray) -> np.ndarray:
    """Take the photograph: write photo.jpg, mask.png and clean.exr, and give what a fit reads, [height, width, 3]."""
    color, coverage = traced[..., :3], traced[..., 3:]
    light = EXPOSURE * (color + (1 - coverage) * backdrop(truth.camera, truth.light))
    ws.write_image(folder / "clean.exr", light)
    PhotoCamera().shoot(folder / "photo.jpg", light, np.random.default_rng(0))
    photograph = ws.read_image(folder / "photo.jpg")
    ws.write_image(folder / "mask.png", make_mask(coverage[..., 0], photograph))
    return photograph


def picture(scene: ws.Scene, light: ws.EnvironmentMap) -> np.ndarray:
    """What was found in a light, ray traced."""
    visibility = ws.Visibility(method="ray-traced", samples=256)
    return ws.render(dataclasses.replace(scene, light=light, visibility=visibility))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("out"), help="folder for the picture and the recipes")
    main(parser.parse_args().output)
