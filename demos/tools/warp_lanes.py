"""How many of a warp's 32 lanes have work in the traversal of spheres, and how many atomics their adjoint takes.

    python demos/tools/warp_lanes.py

No GPU is asked: which spheres reach which spans of directions at which receivers follows from the scene. The lanes of a
warp go through the spheres together, so a *visit* costs them all as much, however many of them a sphere reaches. Each
kind of warp that is compared is 32 threads: receivers in some order, and spans of 16 directions of each.
"""

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.scenes import bunny_scene
from warpshadow.maths.directions import BUNDLE, CHUNK, bundle_cones, falloff_width
from warpshadow.stages import vertex_normals

WARP = 32
NUMBERS = 4  # of a sphere: its center and radius


class Visits(NamedTuple):
    """What the warps of a launch do."""

    spheres: float  # that a warp visits
    lanes: float  # of a warp that have work in a visit
    atomics: int  # of the adjoint: each lane with work adds to a sphere's numbers
    reduced: int  # … where the lanes of a warp sum first


def reached(
    points: np.ndarray,
    normals: np.ndarray,
    centers: np.ndarray,
    radii: np.ndarray,
    directions: np.ndarray,
    width: float,
) -> np.ndarray:
    """Find which spheres may matter to which spans, bool of shape [receiver, sphere, span].

    Args:
        points: Receivers, shape [receiver, 3].
        normals: Their normals, shape [receiver, 3].
        centers: Of the spheres, shape [sphere, 3].
        radii: Of the spheres, shape [sphere].
        directions: Of the cells, shape [direction, 3].
        width: Half-width of the soft edge [rad].
    """
    axes, cos_half, sin_half = bundle_cones(directions, width)
    offsets = centers - points[:, None]
    distances = np.maximum(np.linalg.norm(offsets, axis=2), 1e-9)
    towards = offsets / distances[..., None]
    reach = np.minimum(np.arcsin(np.minimum(radii / distances, 1.0)) + width, np.pi)
    rises = np.arcsin(np.clip(np.einsum("rsk,rk->rs", towards, normals), -1, 1)) > -reach
    is_lit = normals @ axes.T > -sin_half
    half_angles = np.arctan2(sin_half, cos_half)
    within = np.arccos(np.clip(towards @ axes.T, -1, 1)) < reach[..., None] + half_angles
    meets = within & rises[..., None] & is_lit[:, None]
    return meets.reshape(*meets.shape[:2], -1, CHUNK // BUNDLE).any(axis=3)


def visits(reaches: np.ndarray, receivers_of_warp: int) -> Visits:
    """Count what warps do that have so many consecutive receivers, each with as many of its spans as then fit."""
    spans = WARP // receivers_of_warp
    _, sphere_count, span_count = reaches.shape
    count = len(reaches) // receivers_of_warp
    shape = count, receivers_of_warp, sphere_count, span_count // spans, spans
    lanes = reaches[: count * receivers_of_warp].reshape(shape).sum(axis=(1, 4))  # [warp's receivers, sphere, spans]
    is_visited = lanes > 0
    # lanes of one sphere add to the same numbers
    return Visits(
        float(is_visited.sum() / (count * span_count // spans)),
        float(lanes[is_visited].mean()),
        int(NUMBERS * lanes.sum()),
        int(NUMBERS * is_visited.sum()),
    )


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    ws.quiet()
    scene = bunny_scene()
    renderer = ws.Renderer(scene)
    merged_scene, geometry = renderer.merged_scene, renderer.geometry()
    normals = vertex_normals(geometry.positions, merged_scene.faces)
    arrays = [array.numpy()[0] for array in (geometry.positions, normals, geometry.centers, geometry.radii)]
    directions = ws.fibonacci(scene.direction_count)
    reaches = reached(*arrays, directions, falloff_width(scene.visibility.softness, len(directions)))
    orders = {"mesh": np.arange(len(reaches)), "Z": merged_scene.vertex_order}
    print("| receivers | of a warp | spheres visited | lanes at work | atomics | after sums by warps |")
    print("| --- | --- | --- | --- | --- | --- |")
    for body, name in enumerate(("bunny", "ground")):
        for kind, order in orders.items():
            chosen = reaches[order[merged_scene.body_of_vertex[order] == body]]
            for receivers in (WARP * CHUNK // len(directions), WARP):
                spheres, lanes, atomics, reduced = visits(chosen, receivers)
                label = f"{name}, {kind} order | {receivers} × {WARP // receivers} spans"
                print(f"| {label} | {spheres:.1f} | {lanes:.1f} | {atomics} | {reduced} |", flush=True)


if __name__ == "__main__":
    main()
