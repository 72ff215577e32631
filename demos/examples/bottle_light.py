"""The light of a real photograph, found from the shadow of a bottle, and a second body put into it.

    python demos/examples/bottle_light.py --data FOLDER --output out

The photograph, or what stands in for it, is that of `bottle.py`, which also finds where the bottle stands. The table
has squares of two albedos. Of these only the light ones count, where they are seen whole, and they are one albedo: so
no texture can explain a shadow. Light is a map of cells that are never negative. What is near the windows is brighter,
which a light from infinitely far away cannot explain, so the albedo may change slowly across the table: bilinear
between four numbers.

Light and table explain the photograph, with shadows and without; from one half of the table they predict the other. In
the light that was found, a bunny is put onto the table, which is a shadow catcher. Is its shadow that of the bottle?
"""

import argparse
import dataclasses
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.examples.bottle import (
    BODY,
    FEW_EDGES,
    HUBER,
    PLAIN,
    SHADOWS,
    TABLE,
    Photograph,
    by_photograph,
    first_guess,
    halved,
    light_squares,
    open_photograph,
    painted,
    tiles,
)
from demos.examples.bunny import contact_sheet
from demos.problems import DIRECT, changed, distance_error, placement, unshadowed
from demos.scenes import shipped_mesh
from warpshadow import inverse

FINE = ws.Visibility(directions=256)
REACH = 1.25  # heights of the body: as far from its foot its shadow tells of the light
CELLS = inverse.Light(directions=256)
ALBEDO = 0.8  # of light squares: an image has only its product with the light
RING = 0.1, 0.4  # around a foot, where shadows are measured, from its edge [heights of the body]
SECTOR, FEWEST = 15, 20  # of a ring [degrees]; pixels that tell of it


@dataclass(frozen=True, eq=False)
class Squares:
    """The light squares of a table, where they are seen whole.

    Args:
        seen: Which pixels count, [height, width].
        points: What pixels see of the table, from the body's foot, x and z, [height, width, 2].
    """

    seen: np.ndarray
    points: np.ndarray


def squares_around(photo: Photograph, is_light: np.ndarray) -> Squares:
    """The light squares around the body, no farther from its foot than shadows reach; of texels, [height, width, 1]."""
    middle, _ = foot(photo.scene.bodies[BODY])
    points = table_points(photo.scene) - middle
    is_near = np.linalg.norm(points, axis=-1) < REACH * height(photo.scene.bodies[BODY])
    return Squares(light_squares(photo, is_light) & is_near & (photo.outline == 0) & (photo.mask() == 1), points)


def table_points(scene: ws.Scene) -> np.ndarray:
    """Where the rays of pixels meet the table, x and z, [height, width, 2]; far away where they do not."""
    eye, directions = scene.camera.rays()
    above = eye[1] - scene.bodies[TABLE].translation[1]
    return (eye - above * directions / np.minimum(directions[..., 1:2], -1e-6))[..., [0, 2]]


def foot(body: ws.Body) -> tuple[np.ndarray, float]:
    """The middle of what a body stands on, x and z, and its radius."""
    positions = body.world_mesh().positions
    low = positions[positions[:, 1] < positions[:, 1].min() + 0.05 * height(body)][:, [0, 2]]
    middle = (low.min(axis=0) + low.max(axis=0)) / 2
    return middle, float(np.linalg.norm(low - middle, axis=1).max())


def height(body: ws.Body) -> float:
    """Of a body, along y."""
    low, high = body.world_mesh().bounds
    return float((high - low)[1])


# ------------------------------------------------------------------------------------------------ light and table


def opaque(image: np.ndarray) -> np.ndarray:
    """Linear RGB with coverage, [height, width, 4]."""
    return np.concatenate([image, np.ones((*image.shape[:2], 1))], axis=-1)


def explained(photo: Photograph, where: np.ndarray, visibility: ws.Visibility, iterations: int = 300) -> inverse.Result:
    """Light and the albedo of light squares, from those where they count, [height, width]."""
    scene = changed(photo.scene, TABLE, albedo=(ALBEDO / 2,) * 3, texture=None)
    target = inverse.Target(photo.image, where)
    problem = inverse.Problem(scene, target, [CELLS, inverse.Texture(TABLE, (2, 2), smoothness=0.3)], still=visibility)
    scale = min(1.0, 240 / photo.image.shape[1])
    return inverse.fit(problem, [inverse.Stage(iterations, 0.1, scale, supersampling=1)], progress=False)


def gap(photo: Photograph, scene: ws.Scene, where: np.ndarray, visibility: ws.Visibility) -> float:
    """Relative L2 error of a scene where light squares count, at half the photograph's size."""
    scene = dataclasses.replace(scene, camera=photo.scene.camera.resized(0.5), visibility=visibility, supersampling=1)
    image, seen = ws.render(scene)[..., :3], halved(photo.image)
    counts = halved(where[..., None].astype(float))[..., 0] == 1
    return float(np.linalg.norm((image - seen)[counts]) / np.linalg.norm(seen[counts]))


def halves(squares: Squares) -> dict[str, np.ndarray]:
    """The table behind the foot, in front of it, left of it and right of it, [height, width]."""
    x, z = np.moveaxis(squares.points, -1, 0)
    return {"behind": z < 0, "in front": z > 0, "left": x < 0, "right": x > 0}


# ------------------------------------------------------------------------------------------------ the second body


def second_body(photo: Photograph) -> ws.Body:
    """A bunny on the table, on the right of the body and half as large."""
    body = photo.scene.bodies[BODY]
    middle, _ = foot(body)
    x, z = middle + np.array((0.6, 0.14)) * height(body)
    bunny = ws.Body(shipped_mesh("bunny"), albedo=(0.6, 0.6, 0.6), rotation=(0, -20, 0), name="second")
    return bunny.on_ground((x, photo.scene.bodies[TABLE].translation[1], z), size=0.57 * height(body))


def inserted(scene: ws.Scene, body: ws.Body) -> ws.Scene:
    """A scene whose own bodies stand for what a photograph shows, and a body that is new."""
    catchers = [dataclasses.replace(each, shadow_catcher=True) for each in scene.bodies]
    return dataclasses.replace(scene, bodies=(*catchers, body))


def darkening(scene: ws.Scene, body: ws.Body) -> np.ndarray:
    """Part of its light that a table keeps when a body is put onto it, [height, width]; NaN where the body is seen."""
    scene = dataclasses.replace(scene, bodies=scene.bodies[TABLE : TABLE + 1])
    white = np.ones((scene.camera.height, scene.camera.width, 3))
    kept = ws.insert(inserted(scene, body), white, progress=False).mean(axis=-1)
    seen = ws.render(dataclasses.replace(unshadowed(scene), bodies=(body,)))[..., 3]
    return np.where(seen > 0, np.nan, kept)


def by_sector(kept: np.ndarray, photo: Photograph, body: ws.Body) -> np.ndarray:
    """Medians of what the table keeps around a body's foot, in sectors of 15° from -180° to 180°; NaN for a few pixels.

    Args:
        kept: Part of the light, or NaN, [height, width].
        photo: Whose camera sees it.
        body: Around which there is a ring of its own size.
    """
    middle, radius = foot(body)
    points = table_points(photo.scene) - middle
    distances = (np.linalg.norm(points, axis=-1) - radius) / height(body)
    numbers = np.floor(np.degrees(np.arctan2(points[..., 1], points[..., 0])) / SECTOR)
    counts = np.isfinite(kept) & (distances > RING[0]) & (distances < RING[1])
    rows = [kept[counts & (numbers == number)] for number in range(-180 // SECTOR, 180 // SECTOR)]
    return np.array([np.median(row) if len(row) >= FEWEST else np.nan for row in rows])


@dataclass(frozen=True)
class Shadow:
    """A shadow around a foot.

    Args:
        direction: Where it is darkest, from x towards z, which is to the right and towards the camera [degrees].
        depth: Part of the light that is missing there.
        width: Over which at least half as much is missing as there [degrees].
    """

    direction: float
    depth: float
    width: float

    def __str__(self) -> str:
        return f"darkest at {self.direction:.0f}°, {self.depth:.0%} less light, {self.width:.0f}° wide"


def shadow(kept: np.ndarray, between: tuple[float, float] = (-180, 180)) -> Shadow:
    """The darkest sector between two directions [degrees], and those beside it that are half as dark or more."""
    middles = SECTOR * (np.arange(len(kept)) + 0.5) - 180
    darkness = np.where((middles > between[0]) & (middles < between[1]), np.nan_to_num(1 - kept), 0)
    count, darkest = len(darkness), int(darkness.argmax())
    around = np.roll(darkness, count // 2 - darkest) >= darkness[darkest] / 2
    right = int(np.argmin(np.append(around[count // 2 :], False)))
    left = int(np.argmin(np.append(around[: count // 2][::-1], False)))
    return Shadow(float(middles[darkest]), float(darkness[darkest]), (left + right) * SECTOR)


def explanation(photo: Photograph, light: ws.EnvironmentMap) -> np.ndarray:
    """The photograph as the body's color and the table's texture explain it in a light, [height, width, 3].

    What was masked out is pale.
    """
    scene = changed(photo.scene, TABLE, texture=painted(photo, **FEW_EDGES).scene.bodies[0].texture)
    scene = dataclasses.replace(scene, light=light, visibility=FINE)
    free = [inverse.Albedo(BODY), inverse.Texture(TABLE, (2 * photo.texels,) * 2, total_variation=0.01)]
    problem = inverse.Problem(scene, inverse.Target(photo.image, photo.mask()), free, HUBER, still=None)
    stage = inverse.Stage(80, 0.05, min(1.0, 480 / photo.image.shape[1]), supersampling=1)
    image = ws.render(inverse.fit(problem, [stage], progress=False).scene)[..., :3]
    counts = np.maximum(photo.table, photo.outline)[..., None]
    return counts * image + (1 - counts) * (0.7 + 0.3 * photo.image)


# ------------------------------------------------------------------------------------------------ all of it


def main(data: Path | None, output: Path) -> None:
    ws.quiet()
    torch.set_num_threads(1)
    began = time.perf_counter()
    output.mkdir(parents=True, exist_ok=True)
    photo = open_photograph(data)
    truth = photo.scene.bodies[BODY]
    placed = by_photograph(photo, first_guess(photo, seed=0), SHADOWS).scene.bodies
    for number in (BODY, TABLE):
        photo = dataclasses.replace(photo, scene=changed(photo.scene, number, **placement(placed[number])))
    error = distance_error(placed[BODY], truth)
    print(f"pose: MDE {error:.2f}%", flush=True)
    squares = squares_around(photo, tiles(photo))
    parts = halves(squares)
    for known, other in (("behind", "in front"), ("in front", "behind"), ("left", "right"), ("right", "left")):
        gaps = []
        for visibility in (FINE, DIRECT):
            scene = explained(photo, squares.seen & parts[known], visibility).scene
            gaps.append(gap(photo, scene, squares.seen & parts[other], visibility))
        print(f"{other} predicted from {known}: with shadows {gaps[0]:.1%} off, without {gaps[1]:.1%}", flush=True)
    without = gap(photo, explained(photo, squares.seen, DIRECT).scene, squares.seen, DIRECT)
    result = explained(photo, squares.seen, FINE)
    found = dataclasses.replace(result.scene, visibility=FINE)
    with_shadows = gap(photo, found, squares.seen, FINE)
    print(f"all explained: with shadows {with_shadows:.1%} off, without {without:.1%}; {result.light}", flush=True)

    second = second_body(photo)
    plain = dataclasses.replace(unshadowed(found), bodies=found.bodies[TABLE:], supersampling=1)
    bright = np.maximum(ws.render(plain)[..., :3].mean(axis=-1), 1e-6)
    kept = {
        "the photograph": np.where(squares.seen, photo.image.mean(axis=-1) / bright, np.nan),
        "the same, as found": np.where(squares.seen, darkening(found, found.bodies[BODY]), np.nan),
        "the second body": darkening(found, second),
    }
    sectors = {
        label: by_sector(part, photo, second if "second" in label else found.bodies[BODY])
        for label, part in kept.items()
    }
    for label, row in sectors.items():
        for between in photo.shadows:
            print(f"shadow in {label}: {shadow(row, between)}")
        print("    " + " ".join(f"{100 * part:.0f}" if np.isfinite(part) else "–" for part in row))

    albedo = ws.render(dataclasses.replace(plain, light=PLAIN))[squares.seen, :3].mean()
    exposure = float(np.log2(albedo / ALBEDO))
    pictures = {
        "photograph": photo.image,
        f"as found, MDE {error:.1f}%": explanation(photo, found.light),
        "with a second body": ws.insert(inserted(found, second), photo.image, exposure=exposure, progress=False),
    }
    sheet = contact_sheet([[(opaque(halved(image)), label) for label, image in pictures.items()]])
    sheet.save(output / "bottle_light.jpg", quality=85)
    ws.write_image(output / "inserted.png", pictures["with a second body"])
    result.light.picture().write(output / "light.png")
    print(f"{output / 'bottle_light.jpg'}; {time.perf_counter() - began:.0f} s in all")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data", type=Path, help="folder with photograph/bottle.png; without it, a stand-in is rendered"
    )
    parser.add_argument("--output", type=Path, default=Path("out"), help="folder for the pictures")
    arguments = parser.parse_args()
    main(arguments.data, arguments.output)
