"""Poses and light in photographs whose truth is known: fifteen starts, 15° and 10% of the diagonal away.

    python demos/examples/photographs/table.py
    python demos/examples/photographs/table.py lamp_1m lamp_2m  # these alone

Each start is fitted by ``stages = "photograph"``, once as painted, and with ``--masks`` with masks that are a pixel too
large and too small.
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
from demos.examples.photographs.cases import BODY, CASES, TABLE, Case
from demos.problems import changed, displaced, distance_error, placement
from warpshadow import inverse
from warpshadow.maths.sh import equirectangular_directions, pixel_solid_angles

LIGHT = inverse.Light(None, directions=64)


def problem(case: Case, seed: int, *, grown: int = 0, shadows: bool = True, table: str = "known") -> inverse.Problem:
    """A start 15° and 10% away, of which color, light and pose are unknown; its table may be wrong, or free, too."""
    truth = case.truth()
    start = displaced(truth.bodies[0], np.random.default_rng(seed), degrees=(15, 15), part=(0.1, 0.1))
    scene = changed(truth, 0, albedo=(0.5, 0.5, 0.5), **placement(start))
    scene = dataclasses.replace(scene, visibility=ws.Visibility(directions=64) if shadows else ws.Visibility("none"))
    pose = inverse.Pose(BODY, stands_on=TABLE, spread=0.3)
    free = [pose, inverse.Albedo(BODY), LIGHT, inverse.OutlineOffset()]
    if table != "known":
        scene = changed(scene, 1, rotation=(2.0, 0.0, -1.0), translation=(0.0, -0.1, 0.0))
        free += [inverse.Plane(TABLE, height=0.2, tilt=0.05)] if table == "free" else []
    return inverse.Problem(scene, case.target(grown), free, inverse.Loss("huber"), still=None)


def lamp_error(case: Case, light: ws.EnvironmentMap) -> float:
    """Angle between the lamp and the middle of the brightest light, the tenth of its radiance around it [degrees]."""
    towards = equirectangular_directions(len(light.radiance))
    radiance = light.radiance.mean(axis=-1) * pixel_solid_angles(len(light.radiance))[:, None]
    brightest = towards.reshape(-1, 3)[light.radiance.mean(axis=-1).argmax()]
    near = (towards @ brightest) > np.cos(np.radians(30))
    middle = (radiance * near)[..., None] * towards
    found = middle.sum(axis=(0, 1))
    lamp = np.array(case.lamp) - (0, 0.5, 0)
    return float(np.degrees(np.arccos(found @ lamp / np.linalg.norm(found) / np.linalg.norm(lamp))))


def fitted(case: Case, seed: int, **options: object) -> tuple[float, float, float, inverse.Result]:
    """MDE at the start and the end [%], angle of the light [degrees], and the result."""
    asked = problem(case, seed, **options)
    truth = case.truth().bodies[0]
    result = inverse.fit(asked, "photograph", progress=False)
    return (
        distance_error(asked.scene.bodies[0], truth),
        distance_error(result.scene.bodies[0], truth),
        lamp_error(case, result.scene.light),
        result,
    )


def main(names: list[str], starts: int, grown: list[int], **options: object) -> None:
    ws.quiet(progress=False)
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    for pixels in grown:
        errors, seconds = [], []
        for case in (case for case in CASES if not names or case.name in names):
            for seed in range(starts):
                began = time.process_time()
                before, after, angle, result = fitted(case, seed, grown=pixels, **options)
                errors.append(after)
                seconds.append(time.process_time() - began)
                (known,) = result.uncertainty.poses.values()
                print(
                    f"{case.name}, mask {pixels:+d} px, start {seed}: MDE {before:.1f} → {after:.2f}%, "
                    f"light {angle:.0f}° off, outline {result.found.outline_offsets[0]:+.2f} px, "
                    f"{known}, {seconds[-1]:.0f} s",
                    flush=True,
                )
        print(
            f"mask {pixels:+d} px: median MDE {statistics.median(errors):.2f}%, worst {max(errors):.2f}%; "
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
    arguments = parser.parse_args()
    masks = [0, 1, -1] if arguments.masks else [0]
    main(arguments.names, arguments.starts, masks, shadows=not arguments.no_shadows, table=arguments.table)
