"""The paper's tables on open scenes: texture, light, pose and geometry from one image, by each method.

    python demos/benchmarks/paper_tables.py [--data FOLDER] [--scenes 10] [--iterations N]
                                            [--problems texture light pose geometry]
    python demos/benchmarks/paper_tables.py --bounces 2 [as above]
    python demos/benchmarks/paper_tables.py --ablation

Ten scenes: a body of 2 units on a ground of 6, 128 × 128 pixels (texture: 256 × 256), targets ray traced with 2048
directions. With ``--data`` the meshes (FOLDER/meshes) and environment maps (FOLDER/envmaps) of a folder take part,
without it what ships with Warp and synthetic skies. Every result is kept in OUTPUT/paper_tables.json as soon as it is
there, and a run takes up what is not yet in it; ``--scenes`` and ``--iterations`` (of each stage) cut it short. Tables
are printed as Markdown: mean ± standard deviation over the scenes, and every fit that failed.

texture    mean squared error of the ground's texture, over the texels that a pixel or more sees
light      mean squared error of images of two other bodies in the light that was found, relative to their mean square
pose       MDE, mean distance of vertices to where they belong [% of the bounding box's diagonal]; RE, angle between the
           rotations [rad]; TE, squared distance between the translations
geometry   MDE of a body that was bent, twisted and stretched

Where nothing moves, "ray traced" is what a fit does by default. With ``--bounces`` targets are path traced with
all bounces, and fits that know direct light alone stand beside those that know so many; results are kept in
OUTPUT/full_light_tables.json. ``--ablation`` repeats the pose for 50 to 200
spheres and 16 to 64 coefficients of log-SH. Mitsuba 3 takes part where it is installed (mitsuba_fits.py).
"""

import argparse
import dataclasses
import importlib.util
import itertools
import json
import os
import sys
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos import problems
from demos.problems import Case
from demos.scenes import shipped_mesh
from warpshadow import inverse


@dataclass(frozen=True)
class Column:
    """How a fit computes images.

    Args:
        visibility: The method; None for what a fit does by default where nothing moves.
        bounces: How often light bounces.
    """

    visibility: ws.Visibility | None
    bounces: int = 0


COLUMNS: dict[str, Column] = {
    "direct illumination": Column(problems.DIRECT),
    "log-SH cap": Column(ws.Visibility(method="log-sh", log="cap")),
    "log-SH eigen": Column(ws.Visibility(method="log-sh")),
    "directional": Column(ws.Visibility("directional")),
    "ray traced": Column(None),
}
ALL_BOUNCES = 12  # of targets with bounces: what comes after is less than their noise
STILL = ("texture", "light")
CELLS = "ray traced, 512 cells"
MITSUBA = "Mitsuba 3"
SPHERES, ORDERS = (50, 100, 150, 200), (4, 5, 6, 7, 8)


def scenes(data: Path | None) -> list[tuple[ws.Mesh, str, ws.EnvironmentMap]]:
    """Ten pairs of a mesh and a sky."""
    meshes = [shipped_mesh(name) for name in ("bunny", "bear", "rocks")]
    if data is None:
        skies = {
            "high sun": ws.synthetic_sky((0.5, 0.9, 0.3)),
            "low sun": ws.synthetic_sky((0.8, 0.4, 0.3)),
            "soft sun": ws.synthetic_sky((-0.75, 0.6, -0.1), sun_strength=2.0, sun_radius=5.0),
            "overcast": ws.synthetic_sky((0.3, 0.8, -0.4), sun_strength=0.5, sun_radius=10.0),
        }
    else:
        meshes += [ws.load_mesh(file) for file in sorted((data / "meshes").iterdir())]
        skies = {file.stem: ws.EnvironmentMap.read(file) for file in sorted((data / "envmaps").iterdir())}
    names = list(skies)
    return [(meshes[i % len(meshes)], names[i % len(names)], skies[names[i % len(names)]]) for i in range(10)]


def columns_with_bounces(bounces: int) -> dict[str, Column]:
    """Fits that know direct light alone, and fits that know bounces."""
    ours = {"directional": ws.Visibility("directional"), "ray traced": None}
    known = {f"{name}, {bounces} bounces": Column(visibility, bounces) for name, visibility in ours.items()}
    return {name: COLUMNS[name] for name in ("direct illumination", *ours)} | known


def cases(pairs: list[tuple[ws.Mesh, str, ws.EnvironmentMap]], bounces: int = 0) -> dict[str, Callable[..., Case]]:
    """How each problem is made for a scene of a number; the targets have so many bounces."""
    meshes = list({mesh.name: mesh for mesh, *_ in pairs}.values())

    def light(number: int) -> Case:
        mesh, _, sky = pairs[number]
        others = [other for other in meshes if other.name != mesh.name]
        return problems.light_case(mesh, sky, [others[(number + k) % len(others)] for k in (0, 1)], bounces=bounces)

    return {
        "texture": lambda number: problems.texture_case(*_pair(pairs, number), number, bounces=bounces),
        "light": light,
        "pose": lambda number, **options: problems.pose_case(*_pair(pairs, number), number, bounces=bounces, **options),
        "geometry": lambda number: problems.deformation_case(*_pair(pairs, number), number, bounces=bounces),
    }


def _pair(pairs: list, number: int) -> tuple[ws.Mesh, ws.EnvironmentMap]:
    mesh, _, sky = pairs[number]
    return mesh, sky


class Results:
    """Figures by key, kept in a JSON file that is replaced as a whole."""

    def __init__(self, path: Path):
        self.path = path
        self.figures: dict[str, dict[str, Any]] = json.loads(path.read_text()) if path.exists() else {}

    def add(self, key: str, figures: dict[str, Any]) -> None:
        """Put figures in their place."""
        if self.path.exists():  # another process may have added to it
            self.figures = json.loads(self.path.read_text()) | self.figures
        self.figures[key] = figures
        unfinished = self.path.with_suffix(f".{os.getpid()}.part")
        unfinished.write_text(json.dumps(self.figures, indent=1, sort_keys=True))
        os.replace(unfinished, self.path)


def solve(case: Case, column: str, iterations: int | None, columns: Mapping[str, Column] = COLUMNS) -> dict[str, Any]:
    """Figures of one fit; one that fails has its error in place of them."""
    stages = [
        dataclasses.replace(stage, iterations=min(stage.iterations, iterations or stage.iterations))
        for stage in case.stages
    ]
    start = time.perf_counter()
    try:
        if column == MITSUBA:
            from demos.benchmarks.mitsuba_fits import fit_by_mitsuba

            scene, seconds, count, reason = fit_by_mitsuba(case, iterations)
        else:
            how = columns.get(column, Column(None))
            problem = case.by(how.visibility, how.bounces)
            if column == CELLS:  # a map in place of 25 coefficients: lamps and suns, not their blur
                problem = dataclasses.replace(problem, free=inverse.Light(order=None, directions=512))
                stages = [
                    dataclasses.replace(stage, iterations=min(500, iterations or 500), learning_rate=0.15)
                    for stage in stages
                ]
            result = inverse.fit(problem, stages, progress=True)
            scene, seconds, reason = result.scene, result.seconds, result.reason
            count = sum(map(len, result.losses))
        figures: dict[str, Any] = case.measure(scene)
    except (ValueError, ArithmeticError, RuntimeError) as error:
        return {"error": f"{type(error).__name__}: {error}"}
    seconds_in_all = time.perf_counter() - start
    return figures | {"ms": 1e3 * seconds, "iterations": count, "seconds": seconds_in_all, "reason": reason}


def main(
    data: Path | None, output: Path, count: int, names: list[str], iterations: int | None, bounces: int = 0
) -> None:
    prepare(output)
    results = Results(output / ("full_light_tables.json" if bounces else "paper_tables.json"))
    pairs = scenes(data)
    make = cases(pairs, ALL_BOUNCES if bounces else 0)
    columns = columns_with_bounces(bounces) if bounces else COLUMNS
    has_mitsuba = not bounces and importlib.util.find_spec("mitsuba") is not None  # its fits are of direct light
    for number, name in itertools.product(range(count), names):
        mesh, sky_name, _ = pairs[number]
        own = [column for column in columns if name in STILL or columns[column].visibility is not None]
        more = [CELLS] if name == "light" and not bounces else []
        wanted = {
            column: f"{name} | {number:02} {mesh.name}, {sky_name} | {column}"
            for column in [*own, *more, *([MITSUBA] if has_mitsuba else [])]
        }
        missing = {column: key for column, key in wanted.items() if key not in results.figures}
        case = make[name](number) if missing else None
        for column, key in missing.items():
            results.add(key, solve(case, column, iterations, columns))
            print(f"{key}: {shown(results.figures[key])}", flush=True)
    for name in names:
        print(f"\n{table(name, results.figures, columns)}")


def ablate(data: Path | None, output: Path, count: int, iterations: int | None) -> None:
    """The pose by log-SH eigen, over numbers of spheres and coefficients."""
    prepare(output)
    results, pairs = Results(output / "ablation.json"), scenes(data)
    make = cases(pairs)["pose"]
    settings = [(spheres, 8) for spheres in SPHERES] + [(100, order) for order in ORDERS if order < 8]
    for number, (spheres, order) in itertools.product(range(count), settings):
        key = f"{spheres} spheres, {order**2} coefficients | {number:02} {pairs[number][0].name}, {pairs[number][1]}"
        if key not in results.figures:
            columns = {"ablation": Column(ws.Visibility(method="log-sh", order=order))}
            results.add(key, solve(make(number, spheres=spheres), "ablation", iterations, columns))
            print(f"{key}: {shown(results.figures[key])}", flush=True)
    print("\n| spheres | coefficients | pose MDE [%] | ms per iteration |\n| --- | --- | --- | --- |")
    for spheres, order in settings:
        prefix = f"{spheres} spheres, {order**2} coefficients |"
        rows = [
            figures for key, figures in results.figures.items() if key.startswith(prefix) and "error" not in figures
        ]
        if rows:
            print(
                f"| {spheres} | {order**2} | {spread(rows, 'pose MDE')} | {np.mean([row['ms'] for row in rows]):.0f} |"
            )


def prepare(output: Path) -> None:
    ws.quiet()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # meshes with unreferenced vertices
    output.mkdir(parents=True, exist_ok=True)


def table(name: str, figures: dict[str, dict[str, Any]], columns: Mapping[str, Column] = COLUMNS) -> str:
    """Markdown of one problem: a row for each method, mean ± standard deviation over the scenes, and what failed."""
    present = [column for column in [*columns, CELLS, MITSUBA] if any(_is(key, name, column) for key in figures)]
    kinds = {"texture": ["texture MSE"], "light": ["relighting MSE"], "pose": ["pose MDE", "RE", "TE"]}
    kinds["geometry"] = ["geometry MDE"]
    lines = [f"| {name} | " + " | ".join(kinds[name]) + " | ms per iteration | scenes |"]
    lines.append("| --- |" + " --- |" * (len(kinds[name]) + 2))
    failures = []
    for column in present:
        own = {key: row for key, row in figures.items() if _is(key, name, column)}
        failures += [f"- failed: {key}: {row['error']}" for key, row in own.items() if "error" in row]
        rows = [row for row in own.values() if "error" not in row]
        if rows:
            values = " | ".join(spread(rows, kind) for kind in kinds[name])
            lines.append(f"| {column} | {values} | {np.median([row['ms'] for row in rows]):.1f} | {len(rows)} |")
    return "\n".join([*lines, *failures])


def _is(key: str, name: str, column: str) -> bool:
    parts = key.split(" | ")
    return parts[0] == name and parts[-1] == column


def spread(rows: list[dict[str, Any]], kind: str) -> str:
    values = [row[kind] for row in rows]
    return f"{np.mean(values):.3g} ± {np.std(values):.2g}"


def shown(figures: dict[str, Any]) -> str:
    return ", ".join(
        f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}" for name, value in figures.items()
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with meshes/ and envmaps/")
    parser.add_argument("--output", type=Path, default=Path("out"), help="folder for the results")
    parser.add_argument("--scenes", type=int, default=10, choices=range(1, 11), help="the first so many")
    parser.add_argument("--problems", nargs="+", default=["texture", "light", "pose", "geometry"])
    parser.add_argument("--iterations", type=int, help="at most so many for each stage")
    parser.add_argument("--bounces", type=int, default=0, help="targets of full light; bounces that our fits know")
    parser.add_argument("--ablation", action="store_true", help="spheres and coefficients in place of methods")
    arguments = parser.parse_args()
    if arguments.ablation:
        ablate(arguments.data, arguments.output, arguments.scenes, arguments.iterations)
    else:
        main(
            arguments.data,
            arguments.output,
            arguments.scenes,
            arguments.problems,
            arguments.iterations,
            arguments.bounces,
        )
