"""Poses and lamps in photographs whose truth is known: starts 15° and 10% of the diagonal away.

    python demos/examples/photographs/table.py
    python demos/examples/photographs/table.py lamp_1m lamp_2m  # these alone

Each start is fitted by ``stages = "photograph"``, with the painted mask, and with ``--masks`` with masks that are a
pixel too large and too small; all are moved to the edges of the image first, unless ``--as-painted``. Light is a map
and a lamp, which starts straight above; with ``--light map`` it is a map alone. A sphere in place of the body is relit
by both lights, the true one and the one that was found.
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import torch

sys.path.append(str(Path(__file__).parents[3]))  # the folder of demos
import warpshadow as ws
from demos.examples.photographs.cases import BODY, CASES, TABLE, TABLE_SIZE, Case
from demos.problems import changed, displaced, distance_error, placement
from warpshadow import inverse
from warpshadow.maths.sh import equirectangular_directions, pixel_solid_angles

LIGHT = inverse.Light(directions=64)
LAMP = ws.Body(
    ws.icosphere(0.4, 2), emission=(20, 20, 20), albedo=(0, 0, 0), blockers=0, translation=(0, 6, 0), name="lamp"
)
FOOT = np.array([0, 0.5, 0])  # from which directions towards the light are measured


def problem(
    case: Case,
    seed: int,
    *,
    grown: int = 0,
    shadows: bool = True,
    table: str = "known",
    light: str = "lamp",
    stands: bool = True,
    moves_outlines: bool = True,
) -> inverse.Problem:
    """A start 15° and 10% away, of which color, light and pose are unknown; its table may be wrong, or free, too."""
    truth = case.truth()
    start = displaced(truth.bodies[0], np.random.default_rng(seed), degrees=(15, 15), part=(0.1, 0.1))
    scene = changed(truth, 0, albedo=(0.5, 0.5, 0.5), **placement(start))
    scene = dataclasses.replace(scene, visibility=ws.Visibility(directions=64) if shadows else ws.Visibility("none"))
    pose = inverse.Pose(BODY, stands_on=TABLE if stands else None, spread=0.3)
    free = [pose, inverse.Albedo(BODY), LIGHT, inverse.OutlineOffset()]
    if table != "known":
        scene = changed(scene, 1, rotation=(2.0, 0.0, -1.0), translation=(0.0, -0.1, 0.0))
        free += [inverse.Plane(TABLE, height=0.2, tilt=0.05)] if table == "free" else []
    if light == "lamp":
        scene = dataclasses.replace(scene, bodies=(*scene.bodies, LAMP))
        free += [inverse.Lamp("lamp"), inverse.Emission("lamp")]
    return inverse.Problem(
        scene, case.target(grown, moves_outlines=moves_outlines), free, inverse.Loss("huber"), still=None
    )


def lamp_error(case: Case, scene: ws.Scene) -> float:
    """Angle between the lamp and the strongest light [degrees]: a lamp's, or that of the map around its brightest."""
    assert isinstance(scene.light, ws.EnvironmentMap)
    towards = equirectangular_directions(len(scene.light.radiance))
    radiance = scene.light.radiance.mean(axis=-1) * pixel_solid_angles(len(scene.light.radiance))[:, None]
    brightest = towards.reshape(-1, 3)[scene.light.radiance.mean(axis=-1).argmax()]
    near = (towards @ brightest) > np.cos(np.radians(30))
    lights = [((radiance * near)[..., None] * towards).sum(axis=(0, 1))]  # of each as much as it lights, and its middle
    for lamp in (body for body in scene.bodies if body.emission is not None):
        offset = np.array(lamp.translation) - FOOT
        radius = np.linalg.norm(lamp.world_mesh().positions - lamp.translation, axis=1).max()
        lights.append(np.mean(lamp.emission) * np.pi * radius**2 * offset / np.linalg.norm(offset) ** 3)
    found = max(lights, key=lambda light: float(np.linalg.norm(light)))
    lamp = np.array(case.lamp) - FOOT
    return float(np.degrees(np.arccos(found @ lamp / np.linalg.norm(found) / np.linalg.norm(lamp))))


def relit(scene: ws.Scene) -> np.ndarray:
    """A white sphere on a white table in the light of a scene, linear RGB."""
    sphere = ws.Body(ws.icosphere(0.6, 4), albedo=(0.8,) * 3, translation=(0, 0.6, 0))
    table = ws.Body(ws.plane(TABLE_SIZE, 64), albedo=(0.8,) * 3)
    lamps = (dataclasses.replace(body, blockers=0) for body in scene.bodies if body.emission is not None)
    visibility = ws.Visibility("ray-traced", samples=512)
    return ws.render(dataclasses.replace(scene, bodies=(sphere, table, *lamps), visibility=visibility))


def relighting_error(case: Case, scene: ws.Scene) -> float:
    """Relative L2 error of the relit sphere and table, each color scaled to the true one's mean, which no image has."""
    lamp = dataclasses.replace(
        LAMP,
        mesh=ws.icosphere(0.35, 3),
        emission=tuple(case.wattage * value for value in (34, 30, 24)),
        translation=case.lamp,
    )
    sky = ws.EnvironmentMap(np.broadcast_to(np.float32([0.22, 0.25, 0.3]), (16, 32, 3)))
    truth = dataclasses.replace(case.truth(), bodies=(lamp,), light=sky)
    true, found = (relit(item) for item in (truth, scene))
    covered = (true[..., 3] > 0.99) & (found[..., 3] > 0.99)
    true, found = true[covered][:, :3], found[covered][:, :3]
    return float(np.linalg.norm(found * (true.mean(axis=0) / found.mean(axis=0)) - true) / np.linalg.norm(true))


def fitted(case: Case, seed: int, **options: object) -> tuple[float, float, float, float, inverse.Result]:
    """MDE at the start and the end [%], angle of the light [degrees], relighting error [%], and the result."""
    asked = problem(case, seed, **options)
    truth = case.truth().bodies[0]
    result = inverse.fit(asked, "photograph", progress=False)
    return (
        distance_error(asked.scene.bodies[0], truth),
        distance_error(result.scene.bodies[0], truth),
        lamp_error(case, result.scene),
        100 * relighting_error(case, result.scene),
        result,
    )


def main(names: list[str], starts: int, grown: list[int], **options: object) -> None:
    ws.quiet(progress=False)
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    for pixels in grown:
        errors, angles, relights, seconds = [], [], [], []
        for case in (case for case in CASES if not names or case.name in names):
            for seed in range(starts):
                began = time.process_time()
                before, after, angle, relight, result = fitted(case, seed, grown=pixels, **options)
                errors.append(after)
                angles.append(angle)
                relights.append(relight)
                seconds.append(time.process_time() - began)
                (known,) = result.uncertainty.poses.values()
                print(
                    f"{case.name}, mask {pixels:+d} px, start {seed}: MDE {before:.1f} → {after:.2f}%, "
                    f"light {angle:.1f}° off, relit {relight:.1f}% off, "
                    f"outline {result.found.outline_offsets[0]:+.2f} px, {known}, {seconds[-1]:.0f} s",
                    flush=True,
                )
        print(
            f"mask {pixels:+d} px: median MDE {statistics.median(errors):.2f}%, worst {max(errors):.2f}%; "
            f"light: median {statistics.median(angles):.1f}°, worst {max(angles):.1f}°; "
            f"relit: median {statistics.median(relights):.1f}%, worst {max(relights):.1f}%; "
            f"{statistics.median(seconds):.0f} s of CPU time each"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="PHOTOGRAPH", help="by default all")
    parser.add_argument("--starts", type=int, default=5, help="of each photograph")
    parser.add_argument("--masks", action="store_true", help="masks a pixel too large and too small, too")
    parser.add_argument("--no-shadows", action="store_true", help="fit without shadows")
    tables = "known, or 5% of a body too low and tilted by 2.2°: taken as it is, or free with priors"
    parser.add_argument("--table", choices=("known", "wrong", "free"), default="known", help=tables)
    parser.add_argument("--light", choices=("lamp", "map"), default="lamp", help="a lamp and a map, or a map alone")
    parser.add_argument("--no-plane", action="store_true", help="nobody knows that the body stands on the table")
    parser.add_argument("--as-painted", action="store_true", help="masks as painted, not moved to the image's edges")
    arguments = parser.parse_args()
    masks = [0, 1, -1] if arguments.masks else [0]
    known: dict[str, object] = {"shadows": not arguments.no_shadows, "table": arguments.table, "light": arguments.light}
    known |= {"stands": not arguments.no_plane, "moves_outlines": not arguments.as_painted}
    main(arguments.names, arguments.starts, masks, **known)
