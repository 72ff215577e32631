"""The least time that an iteration of the bunny scene can take on an H200: operations and bytes of each stage.

    python demos/tools/kernel_floor.py [--batch 1 100]

No GPU is asked: this is arithmetic. A stage takes no less than its operations at the card's peak, its bytes at the
bandwidth of its memory, whichever is longer, and its launches within a graph:

operations  in float32: an addition, multiplication, comparison or conversion is one (so a fused multiply-add two, as
            the peak counts it); a division, root or exponential 16, as units that do an eighth of the work do them
bytes       each array that a kernel reads or writes, once; gradients that are added to, twice; what is zeroed, once
            more. What caches hold (spheres, directions, tables) is left out, and so are scratch rows
launches    kernels, and what zeroes or copies memory: 3 µs each

Kernels stay above that, by what they repeat, wait for and look up; `kernel_report.py` says how many threads wait
together. Directional visibility counts the spheres and directions that matter to a receiver, which are measured here,
but not the search for them. Log-SH of order 8 is shown beside it.
"""

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.scenes import bunny_scene
from warpshadow.maths.directions import falloff_width
from warpshadow.stages import vertex_normals

OPERATIONS_PER_SECOND = 67e12
BYTES_PER_SECOND = 4.8e12
SECONDS_PER_LAUNCH = 3e-6

SPECIAL = 16
"""Operations that a division, root or exponential counts as."""

PRODUCT = 2 * 6588  # multiply-adds of a symmetric SH product of order 8
FULL_PRODUCT = 2 * 12868  # with two different factors
SQUARINGS = 3  # of the scene's logs, and one product each for the base and for the blend


class Work(NamedTuple):
    """Operations and bytes of an item, and launches in all."""

    operations: float
    bytes: float
    launches: int


class Stage(NamedTuple):
    """What is done for each item."""

    name: str
    item: str
    forward: Work
    backward: Work


class Size(NamedTuple):
    """A scene in numbers."""

    vertices: int
    faces: int
    spheres: int
    directions: int
    samples: int
    open_faces: int = 0  # of bodies that are not closed


def stages(size: Size, rising: float, reached: float) -> list[Stage]:
    """What an iteration of a pose fit does, all vertices being receivers, as they are on a GPU.

    Args:
        size: The scene.
        rising: Part of the pairs of receiver and sphere with a part of the sphere above the horizon.
        reached: Part of the triples of receiver, sphere and direction with the direction in the sphere's soft cone.
    """
    faces_per_vertex = size.faces / size.vertices
    q, s = size.directions, size.spheres
    cone = 40 + 4 * SPECIAL  # offset, distance, direction, sine, cosine, blend and fade
    edge = 14 + 4 * SPECIAL  # where the soft edge begins and ends, its slope, the opacity
    cull = 25 + 2 * SPECIAL  # height above the horizon
    pair = cull + rising * (cone + edge) + reached * 17 * q
    pair_back = pair - 17 * reached * q + rising * (200 + 6 * SPECIAL) + reached * (33 + SPECIAL) * q
    lit = 23 * reached * q  # a sphere's share of a cell, in four sums
    pair_light = cull + rising * (cone + edge + 12 + 2 * SPECIAL) + lit
    pair_light_back = pair_light - lit + rising * (220 + 6 * SPECIAL) + 2 * lit
    sums = 16 * q * min(1.0, s * reached)  # of cells that a sphere reaches
    harmonic_pair = cone + 20 + 6 * 8 + 4 * 64
    return [
        Stage("pose", "vertex", Work(18, 24, 9), Work(40, 48, 6)),
        Stage("project", "vertex", Work(28, 28, 1), Work(60, 56, 1)),
        Stage(
            "rasterize",
            "vertex",
            Work(30 + 2 * SPECIAL + 200 * faces_per_vertex, 28 + 12 * faces_per_vertex, 3),
            Work(0, 0, 0),
        ),
        Stage("visible faces, barycentrics", "sample", Work(45 + SPECIAL, 40, 2), Work(80 + SPECIAL, 28, 1)),
        Stage("sides", "open face", Work(40, 12 + 36 + 4, 1), Work(0, 0, 0)),
        Stage("normals", "vertex", Work(20 * faces_per_vertex + 30, 48 + 12 * faces_per_vertex, 1), Work(100, 84, 1)),
        Stage("silhouettes found", "vertex", Work(120 * faces_per_vertex, 24 * faces_per_vertex, 2), Work(0, 0, 0)),
        Stage("silhouettes listed", "sample", Work(20, 4 + 2 * 32 + 2 * 4 + 3 * 32, 2), Work(0, 0, 0)),
        Stage("visibility, directional", "receiver", Work(s * pair, 24 + 4 * q, 4), Work(s * pair_back, 48 + 8 * q, 2)),
        Stage("transfer, directional", "receiver", Work(8 * q, 12 + 8 * q, 0), Work(20 * q, 24 + 24 * q, 0)),
        Stage("shading, directional", "receiver", Work(6 * q, 12 + 4 * q, 2), Work(6 * q, 12 + 8 * q, 1)),
        Stage("albedo", "sample", Work(15, 40, 1), Work(0, 0, 0)),
        Stage("radiance", "sample", Work(20, 60, 1), Work(45, 92, 2)),
        Stage("smoothing", "sample", Work(60, 2 * 64 + 16 + 48, 2), Work(60, 64 + 2 * 16 + 64, 2)),
        Stage("slopes", "sample", Work(0, 0, 0), Work(160 + 6 * SPECIAL, 28 + 84, 0)),
        Stage("memory sets", "sample", Work(0, 0, 7), Work(0, 0, 1)),
        Stage("loss", "sample", Work(8, 32, 2), Work(8, 48, 2)),
        Stage(
            "bounces, from spheres",
            "receiver",
            Work(s * pair_light + (14 + SPECIAL) * q, 36 + 4 * q + sums, 5),
            Work(s * pair_light_back + (30 + SPECIAL) * q, 84 + 12 * q + sums, 3),
        ),
        Stage("visibility, log-SH sum", "pair", Work(harmonic_pair, 0, 1), Work(2.5 * harmonic_pair, 0, 1)),
        Stage(
            "visibility, log-SH exponential",
            "receiver",
            Work((SQUARINGS + 2) * PRODUCT, 2 * 256 + 256 * (SQUARINGS + 1), 2),
            Work((SQUARINGS + 2) * FULL_PRODUCT, 4 * 256 + 256 * (SQUARINGS + 1), 2),
        ),
        Stage("transfer, log-SH", "receiver", Work(PRODUCT, 12 + 512, 1), Work(2 * FULL_PRODUCT, 24 + 1024, 2)),
        Stage("shading, log-SH", "receiver", Work(6 * 64, 12 + 256, 2), Work(6 * 64, 12 + 512, 1)),
        Stage("texture: levels", "texel", Work(10, 40, 9), Work(10, 40, 10)),
        Stage("texture: footprints and samples", "sample", Work(150 + 8 * SPECIAL, 100, 2), Work(90, 64, 2)),
    ]


def counts(size: Size) -> dict[str, int]:
    """How many items of each kind an instance has; textures have 256 × 256 texels."""
    return {
        "vertex": size.vertices,
        "receiver": size.vertices,
        "pair": size.vertices * size.spheres,
        "sample": size.samples,
        "open face": size.open_faces,
        "texel": 256 * 256,
    }


def floor(work: Work, items: int) -> float:
    """The least time that it takes [s]."""
    busy = max(work.operations * items / OPERATIONS_PER_SECOND, work.bytes * items / BYTES_PER_SECOND)
    return busy + work.launches * SECONDS_PER_LAUNCH


def is_of_pose_iteration(stage: Stage) -> bool:
    """Whether a stage is one of a pose iteration with directional visibility, without textures and bounces."""
    return not any(word in stage.name for word in ("log-SH", "texture", "bounces"))


def iteration_floor(each: list[Stage], size: Size, instances: int) -> float:
    """The least time of a pose iteration, forward and backward [s]."""
    parts = [stage for stage in each if is_of_pose_iteration(stage)]
    items = counts(size)
    return sum(
        floor(work, instances * items[stage.item]) for stage in parts for work in (stage.forward, stage.backward)
    )


def needed(
    points: np.ndarray,
    normals: np.ndarray,
    centers: np.ndarray,
    radii: np.ndarray,
    directions: np.ndarray,
    width: float,
) -> tuple[float, float]:
    """Parts of all pairs with spheres, and of all triples with directions, that the transmittance depends on.

    Args:
        points: Receivers, shape [receiver, 3].
        normals: Their normals, shape [receiver, 3].
        centers: Of the spheres, shape [sphere, 3].
        radii: Of the spheres, shape [sphere].
        directions: Of the cells, shape [direction, 3].
        width: Half-width of the soft edge [rad].
    """
    rising = reached = 0
    for point, normal in zip(points, normals, strict=True):
        offsets = centers - point
        distances = np.maximum(np.linalg.norm(offsets, axis=1), 1e-12)
        reach = np.arcsin(np.minimum(radii / distances, 1.0)) + width
        towards = offsets / distances[:, None]
        rises = np.arcsin(np.clip(towards @ normal, -1, 1)) > -reach
        above = directions[directions @ normal > 0]
        rising += rises.sum()
        reached += (towards[rises] @ above.T > np.cos(reach[rises])[:, None]).sum()
    pair_count = len(points) * len(radii)
    return float(rising / pair_count), float(reached / pair_count / len(directions))


def measure(scene: ws.Scene) -> tuple[Size, float, float]:
    """A scene in numbers, and what culling leaves of its visibility."""
    renderer = ws.Renderer(scene)
    geometry = renderer.geometry()
    normals = vertex_normals(geometry.positions, renderer.merged_scene.faces)
    arrays = [geometry.positions, normals, geometry.centers, geometry.radii]
    directions = ws.fibonacci(scene.direction_count)
    width = falloff_width(scene.visibility.softness, len(directions))
    shares = needed(*(array.numpy()[0].astype(np.float64) for array in arrays), directions, width)
    vertex_count, sphere_count = arrays[0].shape[1], arrays[3].shape[1]
    face_count, sample_count = renderer.merged_scene.faces.shape[0], scene.camera.width * scene.camera.height
    size = Size(
        vertex_count,
        face_count,
        sphere_count,
        len(directions),
        sample_count,
        renderer.merged_scene.two_sided_faces.size,
    )
    return size, *shares


def main(batches: list[int]) -> None:
    ws.quiet()
    size, rising, reached = measure(bunny_scene())
    each = stages(size, rising, reached)
    items = counts(size)
    print(
        f"{size.vertices} receivers, {size.spheres} spheres, {size.directions} directions, {size.samples} samples; "
        f"{rising:.0%} of the spheres rise above a receiver's horizon, "
        f"and a sphere reaches {reached:.0%} of the directions\n"
    )
    columns = [f"µs, {_poses(count)}" for count in batches]
    print("| stage | per | operations | bytes | launches | " + " | ".join(columns) + " |")
    print("| --- | --- | --- | --- | --- |" + " --- |" * len(batches))
    for stage in each:
        works = (stage.forward, stage.backward)
        numbers = [" / ".join(f"{getattr(work, name):.0f}" for work in works) for name in Work._fields]
        times = [
            " / ".join(f"{1e6 * floor(work, count * items[stage.item]):.0f}" for work in works) for count in batches
        ]
        print(f"| {stage.name} | {stage.item} | {' | '.join([*numbers, *times])} |")
    for count in batches:
        milliseconds = 1e3 * iteration_floor(each, size, count)
        print(f"\n{_poses(count)} in a batch, forward and backward: {milliseconds:.2f} ms at the least")


def _poses(count: int) -> str:
    return "1 pose" if count == 1 else f"{count} poses"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", nargs="+", type=int, default=[1, 100], help="poses in a batch")
    main(parser.parse_args().batch)
