"""A real photograph: where a bottle stands, by its outline and by its shadow, on a table of unknown texture.

    python demos/examples/bottle.py --data FOLDER

FOLDER/photograph has the photograph with mesh, camera and pose, from DLR-RM/3DObjectTracking, M3T (MIT license,
copyright 2023 Manuel Stoiber, German Aerospace Center). Without it, a ray-traced bunny on tiles stands in.

Starts are 15° and 10% of the diagonal away. Light, the bottle's color and the table's texture are unknown; all else in
the picture is masked out. First the bottle is moved until it covers its outline, which was painted by hand. There
light, color and texture are fitted. Then light and texture stay, and the pose goes on, with shadows and without. The
inside of the bottle is masked out: its print, its gloss and the other orange of its cap are nothing that one color
explains. `--priors` compares what the table's texture may be.
"""

import argparse
import dataclasses
import functools
import statistics
import sys
import time
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
PRIORS: dict[str, dict[str, Any]] = {
    "anything": {},
    "few edges": FEW_EDGES,
    "few colors": TWO_COLORS,
    "two albedos": TWO_COLORS,  # as recognized, and then they stay
}
LIGHT = inverse.Light(None, directions=128)
RIM = 1 / 96  # of the image's width: what counts of the body, along its outline
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

    def mask(self, *, inside: bool = True) -> np.ndarray:
        """What counts: the table clear of the outline and of other objects, and the body, or its rim alone."""
        width = self.image.shape[1]
        clear, rim = round(width / 192), 2 * round(width * RIM) + 1
        mask = np.where(self.outline < 0.01, ndimage.grey_erosion(self.table, size=clear), self.outline)
        if not inside:
            mask = np.where(ndimage.grey_erosion(self.outline, size=rim) < 0.5, mask, 0)
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
# The table in the camera's space, a plane through what bottle_depth.png sees: n · p = d [m].
_NORMAL, _DISTANCE = np.array([-0.09942538, -0.81529769, -0.57044217]), -0.34873271
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


def by_outline(photo: Photograph, start: ws.Body) -> ws.Body:
    """The body where it covers the outline: black on nothing, so that coverage is all that is compared."""
    black = dataclasses.replace(start, albedo=np.zeros(3))
    scene = dataclasses.replace(unshadowed(photo.scene), bodies=(black,))
    target = inverse.Target(np.concatenate([np.zeros_like(photo.image), photo.outline[..., None]], axis=-1))
    problem = inverse.Problem(scene, target, inverse.Pose(BODY, spread=0.3))
    *coarse, _ = inverse.pose_stages(problem)
    stages = [*coarse, inverse.Stage(40, 0.01, _scale(photo, 240))]
    return inverse.fit(problem, stages, progress=False).scene.bodies[BODY]


def by_image(
    photo: Photograph, start: ws.Body, visibility: ws.Visibility, prior: str = "few colors", iterations: int = 100
) -> ws.Scene:
    """The scene, from the body near where it is and all else unknown: light, color and texture, and then the pose."""
    mask = photo.mask(inside=False)
    unknown: list[inverse.Free] = [inverse.Albedo(BODY), LIGHT]
    if prior == "two albedos":
        mask = np.where((photo.outline == 0) & ~whole_squares(photo), 0, mask).astype(np.float32)
        texture = two_albedos(photo)
    else:
        unknown.append(inverse.Texture(TABLE, **PRIORS[prior]))
        texture = painted(photo, **PRIORS[prior]).scene.bodies[0].texture
    target = inverse.Target(photo.image, mask)
    scene = dataclasses.replace(photo.scene, visibility=visibility)
    scene = changed(changed(scene, BODY, **placement(start)), TABLE, texture=texture)
    scale = _scale(photo, 160)
    for free, stage in (
        (unknown, inverse.Stage(iterations, 0.03, scale, supersampling=1)),
        ([inverse.Pose(BODY), inverse.Albedo(BODY)], inverse.Stage(30, 0.01, scale, supersampling=1)),
    ):
        scene = inverse.fit(inverse.Problem(scene, target, free, HUBER, still=None), [stage], progress=False).scene
    return scene


def two_albedos(photo: Photograph) -> np.ndarray:
    """The table as squares of the two colors that it was painted with, [height, width, 3]."""
    dark, light = _by_brightness(painted(photo, **TWO_COLORS).values["texture[0]"]["palette"]).numpy()
    return np.where(tiles(photo), light, dark).astype(np.float32)


def whole_squares(photo: Photograph) -> np.ndarray:
    """Where the table's squares are seen well away from their edges, bool of shape [height, width]."""
    pattern = drawn_pattern(photo, tiles(photo))
    return (ndimage.minimum_filter(pattern, size=5) > 0.95) | (ndimage.maximum_filter(pattern, size=5) < 0.05)


def drawn_pattern(photo: Photograph, is_light: np.ndarray) -> np.ndarray:
    """How much of each pixel is of light texels, 0 to 1, [height, width]; the body is black."""
    scene = changed(dataclasses.replace(unshadowed(photo.scene), light=PLAIN), BODY, albedo=np.zeros(3))
    texture = np.where(is_light, np.ones(3), np.zeros(3)).astype(np.float32)
    pattern: np.ndarray = ws.render(changed(scene, TABLE, texture=texture))[..., 0]
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


def main(data: Path | None, starts: int, priors: list[str]) -> None:
    ws.quiet()
    torch.set_num_threads(1)
    began = time.perf_counter()
    photo = open_photograph(data)
    truth = photo.scene.bodies[BODY]
    errors: dict[str, list[float]] = {}
    for seed in range(starts):
        start = first_guess(photo, seed)
        outlined = by_outline(photo, start)
        bodies = {"outline": outlined}
        for prior in priors:
            for label, visibility in (("with shadows", SHADOWS), ("without", DIRECT)):
                bodies[f"{prior}, {label}"] = by_image(photo, outlined, visibility, prior).bodies[BODY]
        for label, body in bodies.items():
            errors.setdefault(label, []).append(distance_error(body, truth))
        figures = "; ".join(f"{label} {own[-1]:.2f}%" for label, own in errors.items())
        print(f"start {seed}: MDE {distance_error(start, truth):.1f}% → {figures}", flush=True)
    for label, own in errors.items():
        print(f"{label}: median MDE {statistics.median(own):.2f}%, worst {max(own):.2f}%")
    print(f"{time.perf_counter() - began:.0f} s in all")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data", type=Path, help="folder with photograph/bottle.png; without it, a stand-in is rendered"
    )
    parser.add_argument("--starts", type=int, default=10, help="number of starts")
    parser.add_argument("--priors", action="store_true", help="compare what the table's texture may be")
    arguments = parser.parse_args()
    main(arguments.data, arguments.starts, list(PRIORS) if arguments.priors else ["few colors"])
