"""Adaptive receivers: on flat bodies, close to each other where shadows have edges, far apart elsewhere.

Edges of shadows are sharp where light comes from few cells: a sun's, or else the brightest. Only these cells are found
at the probes of a quadtree (:mod:`warpshadow.stages.receivers.quadtree`): 16 of them at a quarter of the pixels, or in
small images at all.
"""

import itertools
from collections.abc import Callable

import numpy as np
import warp as wp

from warpshadow.device.batch import cut, rows
from warpshadow.device.constants import cached_by_values, constant
from warpshadow.device.launch import launch, without_gradient
from warpshadow.device.memory import empty, reshaped, zeros
from warpshadow.device.tape import unrecorded
from warpshadow.pipeline.bodies.blockers import Blockers
from warpshadow.pipeline.receivers.grouping import blockers_around, group_spheres
from warpshadow.pipeline.receivers.groups import Group
from warpshadow.pipeline.receivers.shading_context import AdaptiveSurfaces
from warpshadow.stages.receivers.numbering import number_items
from warpshadow.stages.receivers.quadtree import Quadtree, find_quadtree, keys_of_probes, probe_grid
from warpshadow.stages.receivers.receivers import points_of_fragments
from warpshadow.stages.receivers.sample_receivers import fragments_of_samples


def find_squares(
    place_blockers: Callable[[wp.array, tuple[wp.array, wp.array]], Blockers],
    share_of_sharpest_light: Callable[[Group], wp.array | None],
    surfaces: AdaptiveSurfaces,
) -> Quadtree:
    """Find the squares of images in which the samples of some bodies interpolate.

    Args:
        place_blockers: Places blockers, given the vertices, and the spheres.
        share_of_sharpest_light: Finds the share of the unblocked light of a group that comes from the cells with the
            sharpest shadows, float32 of shape [batch, receiver]; None where nothing blocks.
        surfaces: The samples, and the bodies; no gradient passes to them.
    """
    positions, normals, fragments, spheres, is_adaptive, supersampling, footprint_inputs = surfaces
    positions, normals, centers, radii = map(without_gradient, (positions, normals, *spheres))
    with unrecorded():
        blockers = place_blockers(positions, (centers, radii))
    merged_scene, device = blockers.merged_scene, positions.device
    sides = fragments.face_ids if fragments.sides is None else fragments.sides
    bodies = np.flatnonzero(is_adaptive)
    keys, ranks = _find_keys_of_sides(is_adaptive, merged_scene.first_face, device)
    probe_ranks = keys_of_probes(sides, ranks, supersampling)
    light_ratios = zeros(probe_ranks.shape, wp.float32, device, outlives_recording=False)
    order, samples = _order_by_tiles(sides.shape[1:], supersampling, device)
    with unrecorded():
        _, probes, ends, _ = number_items("probes", reshaped(probe_ranks, (len(sides), -1)), len(bodies), order)
        seen = fragments_of_samples(fragments, _samples_of(probes, samples))
        arrays = points_of_fragments(positions, normals, merged_scene.faces, seen, footprint_inputs)
        for body, (first, end) in zip(bodies.tolist(), itertools.pairwise(ends.tolist()), strict=True):
            if end == first:
                continue
            points, point_normals, footprints = (cut(array, first, end) for array in arrays)
            group_blockers = blockers_around(blockers, group_spheres(blockers), body)
            for portion in Group(points, point_normals, group_blockers, footprints).portions():
                ratios = share_of_sharpest_light(portion)
                if ratios is not None:
                    inputs = [cut(probes, first + portion.first, end), ratios]
                    launch(_scatter, ratios.shape, inputs=inputs, outputs=[rows(light_ratios)])
    return find_quadtree(sides, keys, light_ratios, supersampling)


@wp.kernel(enable_backward=False)
def _scatter(
    # in
    probes: wp.array2d(dtype=wp.int32),
    ratios: wp.array2d(dtype=float),
    # out
    light_ratios: wp.array2d(dtype=float),
):
    """A thread owns a probe of a list, −1 for none."""
    view, i = wp.tid()
    probe = probes[view, i]
    if probe >= 0:
        light_ratios[view, probe] = ratios[view, i]


@wp.kernel(enable_backward=False)
def _find_samples(
    # in
    probes: wp.array2d(dtype=wp.int32),
    sample_of_probe: wp.array(dtype=wp.int32),
    # out
    samples: wp.array2d(dtype=wp.int32),
):
    """A thread owns a probe of a list, −1 for none."""
    view, i = wp.tid()
    probe = probes[view, i]
    samples[view, i] = wp.where(probe < 0, -1, sample_of_probe[wp.max(probe, 0)])


def _samples_of(probes: wp.array, sample_of_probe: wp.array) -> wp.array:
    """The samples that probes are, −1 for none, int32 of shape [view, probe]."""
    samples = empty(probes.shape, dtype=wp.int32, device=probes.device)
    launch(_find_samples, probes.shape, inputs=[probes, sample_of_probe], outputs=[samples])
    return samples


@cached_by_values
def _find_keys_of_sides(
    is_adaptive: np.ndarray, first_face: np.ndarray, device: wp.DeviceLike
) -> tuple[wp.array, wp.array]:
    """Find a key for each face side, of its body and side, and the rank of its body; both −1 where it is not adaptive.

    Fronts come first, then backs.
    """
    numbers = np.where(is_adaptive, np.arange(len(is_adaptive)), -1)
    ranks = np.where(is_adaptive, np.cumsum(is_adaptive) - 1, -1)
    bodies, ranks = (np.repeat(values, np.diff(first_face)) for values in (numbers, ranks))
    keys = np.concatenate([bodies, np.where(bodies < 0, -1, len(is_adaptive) + bodies)])
    return constant(keys, wp.int32, device), constant(np.tile(ranks, 2), wp.int32, device)


@cached_by_values
def _order_by_tiles(size: tuple[int, int], supersampling: int, device: wp.DeviceLike) -> tuple[wp.array, wp.array]:
    """Order the probes of a grid by 4 × 4 tiles, so that neighbors are shaded one after another.

    Returns:
        Two int32 arrays: the probes in this order, and the sample of each probe.
    """
    row_samples, column_samples = probe_grid(size, supersampling)
    row, column = np.divmod(np.arange(len(row_samples) * len(column_samples)), len(column_samples))
    samples = (row_samples[:, None] * size[1] + column_samples).ravel()
    order = np.lexsort((column // 4, row // 4))
    return constant(order, wp.int32, device), constant(samples, wp.int32, device)
