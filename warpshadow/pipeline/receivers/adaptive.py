"""Adaptive receivers: on flat bodies, close to each other where shadows have edges, far apart elsewhere.

Edges of shadows are sharp where light comes from few cells: a sun's, or else the brightest. Only these cells are found
at the probes of a quadtree (:mod:`warpshadow.stages.receivers.quadtree`): 16 of them at a quarter of the pixels, or in
small images at all.
"""

import functools
from collections.abc import Callable

import numpy as np
import warp as wp

from warpshadow.device.constants import immutable
from warpshadow.device.launch import without_gradient
from warpshadow.device.tape import unrecorded
from warpshadow.pipeline.bodies.blockers import Blockers
from warpshadow.pipeline.receivers.grouping import blockers_around, group_spheres
from warpshadow.pipeline.receivers.groups import Group
from warpshadow.pipeline.receivers.shading_context import AdaptiveSurfaces
from warpshadow.stages.receivers.find import points_of_fragments
from warpshadow.stages.receivers.quadtree import Quadtree, find_quadtree, probe_grid
from warpshadow.stages.receivers.sample_receivers import fragments_of_samples


def find_squares(
    place_blockers: Callable[[wp.array, tuple[wp.array, wp.array]], Blockers],
    share_of_sharpest_light: Callable[[Group], np.ndarray | None],
    surfaces: AdaptiveSurfaces,
) -> Quadtree:
    """Find the squares of images in which the samples of some bodies interpolate.

    Args:
        place_blockers: Places blockers, given the vertices, and the spheres.
        share_of_sharpest_light: Finds the share of the unblocked light of a group that comes from the cells with the
            sharpest shadows, shape [batch, receiver]; None where nothing blocks.
        surfaces: The samples, and the bodies; no gradient passes to them.
    """
    positions, normals, fragments, spheres, is_adaptive, supersampling, footprint_inputs = surfaces
    positions, normals, centers, radii = map(without_gradient, (positions, normals, *spheres))
    with unrecorded():
        blockers = place_blockers(positions, (centers, radii))
    merged_scene = blockers.merged_scene
    sides = fragments.face_ids if fragments.sides is None else fragments.sides
    keys, bodies = _find_keys_of_sides(is_adaptive.tobytes(), merged_scene.first_face.tobytes())
    row, column = probe_grid(sides.shape[1:], supersampling)
    numbers, probes = _order_by_tiles(sides.shape[1:], supersampling)
    body_of_probe = bodies[sides.numpy().reshape(len(sides), -1)[:, probes[:-1]]]
    light_ratios = np.zeros((len(sides), len(probes)), np.float32)  # the last is of no probe
    with unrecorded():
        for body in np.flatnonzero(is_adaptive).tolist():
            columns = _list_chosen(body_of_probe == body)
            if not columns.shape[1]:
                continue
            seen = fragments_of_samples(fragments, probes[columns])
            probes_of_body = points_of_fragments(positions, normals, merged_scene.faces, seen, footprint_inputs)
            points, point_normals, footprints = probes_of_body
            group = Group(points, point_normals, blockers_around(blockers, group_spheres(blockers), body), footprints)
            portions = [share_of_sharpest_light(portion) for portion in group.portions()]
            known = [portion for portion in portions if portion is not None]
            if known:
                light_ratios[np.arange(len(sides))[:, None], numbers[columns]] = np.concatenate(known, axis=1)
    ratios_of_grid = light_ratios[:, :-1].reshape(len(sides), len(row), len(column))
    return find_quadtree(sides, keys, ratios_of_grid, supersampling)


@functools.lru_cache(maxsize=16)
def _find_keys_of_sides(is_adaptive: bytes, first_face: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Find a key for each face side, of its body and side, and its body; both −1 where that is not adaptive.

    Fronts come first, then backs. The last body, −1, is that of side −1.
    """
    adaptive, starts = np.frombuffer(is_adaptive, bool), np.frombuffer(first_face, int)
    bodies = np.repeat(np.where(adaptive, np.arange(len(adaptive), dtype=np.int32), -1), np.diff(starts))
    keys = np.concatenate([bodies, np.where(bodies < 0, -1, len(adaptive) + bodies)])
    return immutable(keys.astype(np.int32)), np.concatenate([bodies, bodies, [-1]])


@functools.lru_cache(maxsize=16)
def _order_by_tiles(size: tuple[int, int], supersampling: int) -> tuple[np.ndarray, np.ndarray]:
    """Order the probes of a grid by 4 × 4 tiles, so that neighbors are shaded one after another.

    Returns:
        Two arrays: index of each probe in the grid, and of its sample. Both end with an item for index −1: the number
        of probes, and −1.
    """
    rows, columns = probe_grid(size, supersampling)
    row, column = np.divmod(np.arange(len(rows) * len(columns)), len(columns))
    permutation = np.lexsort((column // 4, row // 4))
    samples = (rows[:, None] * size[1] + columns).ravel()[permutation]
    return np.append(permutation, len(permutation)), np.append(samples, -1)


def _list_chosen(chosen: np.ndarray) -> np.ndarray:
    """List the chosen columns of each row, padded with −1, shape [row, longest row]."""
    if len(chosen) == 1:
        return np.flatnonzero(chosen)[None]
    row, column = np.nonzero(chosen)
    counts = np.bincount(row, minlength=len(chosen))
    columns = np.full((len(chosen), counts.max(initial=0)), -1)
    columns[row, np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)] = column
    return columns
