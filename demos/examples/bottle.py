"""A real photograph: where a bottle stands, by its outline and by its shadow, on a table of unknown texture.

    python demos/examples/bottle.py --data FOLDER

FOLDER/photograph has the photograph with mesh, camera and pose, from DLR-RM/3DObjectTracking, M3T (MIT license,
copyright 2023 Manuel Stoiber, German Aerospace Center). Without it, a ray-traced bunny on tiles stands in.

Starts are 15° and 10% of the diagonal away. Light, the bottle's color and the table's texture are unknown. The bottle
stands on the table; its mesh is a scan, so it may tilt by a few degrees, and the table may be a centimeter higher or
lower. ``stages = "photograph"`` finds the pose, with shadows and without. Of the image the light squares of
the table count, which are one albedo but for a slow change. The bottle does not: its print and its gloss are nothing
that one color explains.
"""

import argparse
import dataclasses
import functools
import statistics
import sys
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw
from scipy import ndimage
from scipy.spatial.transform import Rotation

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.problems import DIRECT, changed, displaced, distance_error, placement, ray_traced, unshadowed
from demos.scenes import on_ground, shipped_mesh
from warpshadow import inverse

BODY, TABLE = 0, 1
SHADOWS = ws.Visibility(directions=64)
TWO_COLORS: dict[str, Any] = {"palette": 1.0, "colors": 2}
FEW_EDGES: dict[str, Any] = {"total_variation": 0.05}
LIGHT = inverse.Light(directions=64)
TILT, HEIGHT = np.radians(2.0), 0.1  # of a scan's base, and of the table [scene units], standard deviations
TABLE_TILT = np.radians(0.2)
EXPOSURE = 0.25  # of the stand-in: white tiles in the sun do not saturate
PLAIN = ws.EnvironmentMap.constant(1.0)
HUBER = inverse.Loss("huber")


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph, and what a user knows of it.

    Args:
        image: Linear RGB, [height, width, 3].
        table: Where the table is seen and is matte, 0 to 1, [height, width].
        outline: Where the body is seen, 0 to 1, [height, width].
        scene: The body as it is known to stand, and the table, a plane, as one gray.
        texels: Of the table's texture, across and down.
        shadows: Directions from the body's foot, from x towards z [degrees]: between each two it casts one shadow, and
            nothing else does.
    """

    image: np.ndarray
    table: np.ndarray
    outline: np.ndarray
    scene: ws.Scene
    texels: int
    shadows: tuple[tuple[float, float], ...] = ((-180, 180),)

    def mask(self) -> np.ndarray:
        """What counts: the table clear of the outline and of other objects, and the body."""
        clear = round(self.image.shape[1] / 192)
        mask = np.where(self.outline < 0.01, ndimage.grey_erosion(self.table, size=clear), self.outline)
        is_saturated = (self.image >= ws.srgb_to_linear(np.float64(250 / 255))).any(axis=-1)
        return np.where(is_saturated, 0, mask).astype(np.float32)

    def around(self) -> np.ndarray:
        """The table well clear of the body."""
        wide = 2 * round(self.image.shape[1] / 137) + 1
        return np.where(ndimage.grey_dilation(self.outline, size=wide) < 0.01, self.mask(), 0).astype(np.float32)


# ------------------------------------------------------------------------------------------------ photographs

# The bottle's outline and the other objects, painted by hand [pixels].
_BOTTLE = """414.3 149.3, 420 140, 433.3 131.7, 446.7 126.7, 466.7 123.3, 480 123.3, 490 126, 495 133.3, 500 150,
510 176.7, 516.7 200, 521 230, 523.3 256.7, 524 280, 522.7 303.3, 520 330, 517.3 356.7, 515 383.3, 506.7 391.7,
496.7 399.3, 483.3 405, 466.7 404.3, 460 396.7, 452.3 383.3, 442 361.7, 433 338.3, 423 308.3, 414.7 276.7, 410.3 250,
409 223.3, 410.3 196.7, 412.3 170"""
_MATTE_TABLE = "395 105, 500 103, 740 178, 960 275, 960 540, 395 540"
_OTHERS = (
    "335 335, 405 270, 430 270, 430 360, 350 375",  # a brush, left and right of the bottle
    "520 225, 553 243, 553 262, 522 295, 505 290",
    "358 240, 430 245, 430 300, 370 300, 358 285",  # blocks
    "612 250, 730 250, 732 345, 655 352, 612 290",
    "390 0, 500 0, 502 135, 450 150, 405 150",  # a spray can
)
# The table in the camera's space: n · p = d [m]. The normal is that of the squares, by 200 of their corners, to 0.2°:
# how bottle_depth.png is turned is not known, and the plane that it sees is 1° off. It tells the distance alone.
_NORMAL, _DISTANCE = np.array([-0.1095, -0.8060, -0.5818]), -0.34873271
_DECIMETRES = 10.0  # of a meter: the unit of the scene


def bottle_photograph(folder: Path) -> Photograph:
    """The photograph of folder's README, in a world whose y is up and whose origin is on the table."""
    image = ws.read_image(folder / "bottle.png")[..., :3]
    height, width, _ = image.shape
    intrinsics = np.array([[698.128, 0, 478.459], [0, 698.617, 274.426], [0, 0, 1]])
    ray = np.linalg.inv(intrinsics) @ (width / 2, 330, 1)
    origin = ray * (_DISTANCE / (_NORMAL @ ray))
    up = _NORMAL / np.linalg.norm(_NORMAL)
    right = np.array([1.0, 0, 0]) - up[0] * up
    right /= np.linalg.norm(right)
    rotation = np.stack([right, up, np.cross(right, up)], axis=1)  # world to camera
    camera = ws.Camera(intrinsics, rotation, _DECIMETRES * origin, width, height, near=0.05)
    camera_to_model = np.array(
        [[0.607676, 0.408914, -0.680823], [0.786584, -0.428213, 0.444880], [-0.109620, -0.805867, -0.581860]]
    )
    body_to_camera = Rotation.from_matrix(camera_to_model.T)
    moved = np.array([0.297794, -0.189009, 0.255284]) + (0, 0, 0.097)
    turn = Rotation.from_matrix(rotation.T) * body_to_camera
    translation = _DECIMETRES * rotation.T @ (-body_to_camera.apply(moved) - origin)
    body = ws.Body(
        ws.load_mesh(folder / "bottle.obj"),
        albedo=(0.5, 0.2, 0.03),
        blockers=40,
        scale=_DECIMETRES,
        rotation=turn.as_rotvec(degrees=True),
        translation=translation,
    )
    table = ws.Body(ws.plane(6.6, 64), albedo=(0.4, 0.4, 0.4), translation=(1.6, 0, -1.2))
    others = np.max([_area(points, width, height) for points in _OTHERS], axis=0)
    matte = _area(_MATTE_TABLE, width, height) * (1 - others)
    scene = ws.Scene((body, table), PLAIN, camera, SHADOWS)
    return Photograph(image, matte, _area(_BOTTLE, width, height), scene, texels=160, shadows=((-60, 0), (0, 120)))


def stand_in(size: int = 256) -> Photograph:
    """A ray-traced bunny on tiles, black and white ones as the photograph's: two colors must be told apart."""
    sky = ws.synthetic_sky((0.8, 0.65, -0.1), sun_strength=3.0, sun_radius=10.0)
    tiles = np.where(np.indices((12, 12)).sum(axis=0)[..., None] % 2, 0.8, 0.1) * np.ones(3)
    texture = tiles.repeat(10, axis=0).repeat(10, axis=1).astype(np.float32)
    ground = ws.Body(ws.plane(6.0, 64), texture=texture)
    truth = on_ground(shipped_mesh("bunny"), sky, blockers=40, ground=ground)
    camera = truth.camera.resized(size / truth.camera.width)
    truth = dataclasses.replace(truth, camera=camera, visibility=SHADOWS)
    traced = ray_traced(truth, 512)
    bunny = dataclasses.replace(unshadowed(truth), bodies=truth.bodies[:1], supersampling=4)
    plain = dataclasses.replace(changed(truth, TABLE, albedo=(0.4, 0.4, 0.4), texture=None), light=PLAIN)
    return Photograph(EXPOSURE * traced[..., :3], np.floor(traced[..., 3]), ws.render(bunny)[..., 3], plain, texels=64)


def _area(points: str, width: int, height: int, finer: int = 4) -> np.ndarray:
    """Coverage by a polygon, [height, width]."""
    corners = [tuple(finer * float(number) for number in point.split()) for point in points.split(",")]
    mask = Image.new("L", (finer * width, finer * height))
    ImageDraw.Draw(mask).polygon(corners, fill=255)
    return np.asarray(mask.resize((width, height), Image.Resampling.BOX)) / 255.0


# ------------------------------------------------------------------------------------------------ fits


@functools.cache
def painted(photo: Photograph, **prior: Any) -> inverse.Result:
    """The table's texture with all that is on it, the body apart: where a fit starts, and which square is which."""
    scene = dataclasses.replace(unshadowed(photo.scene), bodies=photo.scene.bodies[TABLE:])
    target = inverse.Target(photo.image, photo.around())
    problem = inverse.Problem(scene, target, inverse.Texture(0, (photo.texels,) * 2, **prior), HUBER, still=None)
    return inverse.fit(problem, [inverse.Stage(60, 0.05, _scale(photo, 240), supersampling=1)], progress=False)


def by_photograph(photo: Photograph, start: ws.Body, visibility: ws.Visibility) -> inverse.Result:
    """The body on the table, by its outline, and by the table's light squares in a light that is not known."""
    counts = light_squares(photo, tiles(photo)) & (photo.outline == 0)
    outlines = {BODY: photo.outline.astype(np.float32)}
    target = inverse.Target(photo.image, np.where(counts, photo.mask(), 0), outlines=outlines, moves_outlines=True)
    scene = dataclasses.replace(changed(photo.scene, BODY, **placement(start)), visibility=visibility)
    free = [
        inverse.Pose(BODY, stands_on=TABLE, tilt=TILT, spread=0.3),
        inverse.Plane(TABLE, height=HEIGHT, tilt=TABLE_TILT),
        inverse.Texture(TABLE, (2, 2), smoothness=0.3),
        LIGHT,
        inverse.OutlineOffset(),
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a start that is turned onto its stable support
        return inverse.fit(inverse.Problem(scene, target, free, HUBER, still=None), "photograph", progress=False)


def light_squares(photo: Photograph, is_light: np.ndarray) -> np.ndarray:
    """Where light squares are seen whole, well away from their edges, of texels [height, width, 1] of the table.

    Returns:
        Bool of shape [height, width].
    """
    is_whole: np.ndarray = ndimage.minimum_filter(drawn_pattern(photo, is_light), size=5) > 0.95
    return is_whole


def drawn_pattern(photo: Photograph, is_light: np.ndarray) -> np.ndarray:
    """How much of each pixel is of light texels, 0 to 1, [height, width], as if the body were not there."""
    texture = np.where(is_light, np.ones(3), np.zeros(3)).astype(np.float32)
    table = dataclasses.replace(photo.scene.bodies[TABLE], texture=texture)
    scene = dataclasses.replace(unshadowed(photo.scene), bodies=(table,), light=PLAIN)
    pattern: np.ndarray = ws.render(scene)[..., 0]
    return pattern / max(pattern.max(), 1e-6)


def first_guess(photo: Photograph, seed: int) -> ws.Body:
    """The body 15° and 10% of its diagonal from where it is known to be."""
    rng = np.random.default_rng(seed)
    return displaced(photo.scene.bodies[BODY], rng, degrees=(15, 15), part=(0.1, 0.1))


def open_photograph(data: Path | None) -> Photograph:
    """The photograph in data/photograph, where it is; the stand-in elsewhere. Says which."""
    is_real = data is not None and (data / "photograph" / "bottle.png").exists()
    print("the photograph" if is_real else "no photograph here: a ray-traced stand-in")
    return bottle_photograph(data / "photograph") if data is not None and is_real else stand_in()


def tiles(photo: Photograph) -> np.ndarray:
    """Which texels of the table are light, as the nearer of two colors, bool of shape [height, width, 1]."""
    whole = painted(photo, **TWO_COLORS)
    colors = _by_brightness(whole.values["texture[0]"]["palette"])
    texels = whole.values["texture[0]"]["texels"]
    return (texels[:, :, None] - colors).square().sum(dim=-1).argmin(dim=-1).numpy()[..., None] == 1


def halved(image: np.ndarray) -> np.ndarray:
    """An image of half the size, by means of four pixels."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    return image[: 2 * height, : 2 * width].reshape(height, 2, width, 2, -1).mean(axis=(1, 3))


def _by_brightness(colors: torch.Tensor) -> torch.Tensor:
    return colors[colors.sum(dim=1).argsort()]


def _scale(photo: Photograph, width: int) -> float:
    """The part of the photograph's size that makes it so wide, at most all of it."""
    return min(1.0, width / photo.image.shape[1])


# ------------------------------------------------------------------------------------------------ the comparison


def main(data: Path | None, starts: int) -> None:
    ws.quiet()
    torch.set_num_threads(1)
    photo = open_photograph(data)
    truth = photo.scene.bodies[BODY]
    errors: dict[str, list[float]] = {}
    for seed in range(starts):
        start = first_guess(photo, seed)
        figures = []
        for label, visibility in (("with shadows", SHADOWS), ("without", DIRECT)):
            began = time.process_time()
            result = by_photograph(photo, start, visibility)
            seconds = time.process_time() - began
            error = distance_error(result.scene.bodies[BODY], truth)
            errors.setdefault(label, []).append(error)
            (known,) = result.uncertainty.poses.values()
            figures.append(f"{label} {error:.2f}%, {known}, {seconds:.0f} s")
        print(f"start {seed}: MDE {distance_error(start, truth):.1f}% → {'; '.join(figures)}", flush=True)
    for label, own in errors.items():
        print(f"{label}: median MDE {statistics.median(own):.2f}%, worst {max(own):.2f}%")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data", type=Path, help="folder with photograph/bottle.png; without it, a stand-in is rendered"
    )
    parser.add_argument("--starts", type=int, default=10, help="number of starts")
    arguments = parser.parse_args()
    main(arguments.data, arguments.starts)
