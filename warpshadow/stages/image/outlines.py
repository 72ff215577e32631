"""Outlines: samples near them move by the mean slopes of :mod:`.slopes` where else derivatives are exact.

Two quantities have exact derivatives: the light of a sample that is a receiver, and the albedo of vertices or a
texture, for its detail. Within :data:`REACH` steps of an outline both get mean slopes instead: towards a limb an exact
slope is often tiny and rarely huge, and does not match the colors at the edges. Color is a product, light times albedo,
of which either factor moves or both do.
"""

from dataclasses import replace

import warp as wp

from warpshadow.device.batch import rows
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.memory import copied, reshaped, zeros
from warpshadow.stages.raster.rasterization import Fragments
from warpshadow.stages.raster.screen import ends_before, half_size, has_neighbor, line_distance, neighbor
from warpshadow.stages.receivers.quadtree import Quadtree
from warpshadow.stages.silhouettes.lines import NOTHING, FragmentArrays, line_between, make_fragment_arrays
from warpshadow.stages.silhouettes.silhouettes import Silhouettes

MIN_DISTANCE = 0.02  # distance of an edge [samples] below which rounding outweighs how color changes on the way to it

REACH = 2  # steps from outlines up to which samples have mean slopes: farther in these would lose detail of textures


@wp.struct
class SurfaceArrays:
    """Fragments, and the edges beside them: of flat images, as kernels take them."""

    fragments: FragmentArrays
    entries: wp.array(dtype=wp.int32)  # [sample], −1 for none
    edges: wp.array2d(dtype=wp.vec2i)  # [entry, direction]


def make_surface_arrays(silhouettes: Silhouettes, clip_positions: wp.array) -> SurfaceArrays:
    """Fragments of silhouettes, and the edges beside them."""
    surfaces = SurfaceArrays()
    surfaces.fragments = make_fragment_arrays(silhouettes.fragments, silhouettes.faces, clip_positions)
    surfaces.entries, surfaces.edges = silhouettes.entries, silhouettes.edges
    return surfaces


@wp.func
def distance_to_end(surfaces: SurfaceArrays, sample: int, k: int):
    """Distance at which a sample's surface ends before its neighbor in direction k [samples].

    −1 if no edge is known between them; −2 if the neighbor sees another surface or nothing, or is outside.
    """
    fragments = surfaces.fragments
    if not has_neighbor(sample, k, fragments.width, fragments.height):
        return -2.0
    entry = surfaces.entries[sample]
    if entry >= 0:
        edge = surfaces.edges[entry, k]
        if edge[0] != NOTHING:
            if edge[0] >= 0:
                line = line_between(fragments, sample, k, edge)
                t = line_distance(line, k, half_size(fragments.width, fragments.height))
                if ends_before(line, k) and t > MIN_DISTANCE and t <= 1.0:
                    return t
            return -2.0
    return wp.where(fragments.face_ids[neighbor(sample, k, fragments.width)] >= 0, -1.0, -2.0)


@wp.func
def _mark_mean_slope(
    surfaces: SurfaceArrays,
    sides: wp.array(dtype=wp.int32),
    keys: wp.array(dtype=wp.int32),
    has_mean_slope: wp.array(dtype=wp.bool),
    sample: int,
):
    """Let a sample have a mean slope if slopes along both axes are known, and it is in no square."""
    if not has_mean_slope[sample]:
        is_known = bool(True)
        if keys:
            is_known = keys[sides[sample]] < 0
        for axis in range(2):
            forward = distance_to_end(surfaces, sample, 2 * axis)
            backward = distance_to_end(surfaces, sample, 2 * axis + 1)
            is_known = is_known and wp.max(forward, backward) > -2.0
        if is_known:
            has_mean_slope[sample] = True


@wp.kernel(enable_backward=False)
def _find_outline_samples(
    # in
    samples: wp.array(dtype=wp.int32),
    surfaces: SurfaceArrays,
    sides: wp.array(dtype=wp.int32),
    keys: wp.array(dtype=wp.int32),
    reach: int,
    # out
    has_mean_slope: wp.array(dtype=wp.bool),
):
    """A thread owns an entry: if its surface ends there, that and samples up to ``reach`` steps away on the surface.

    All are False before. Threads that write to the same place write the same.
    """
    sample = samples[wp.tid()]
    is_at_outline = bool(False)
    if sample >= 0:
        for k in range(4):
            is_at_outline = is_at_outline or distance_to_end(surfaces, sample, k) > 0.0
    if is_at_outline:
        _mark_mean_slope(surfaces, sides, keys, has_mean_slope, sample)
        for k in range(4):
            on_path = sample
            steps = int(0)
            while steps < reach and distance_to_end(surfaces, on_path, k) == -1.0:
                on_path = neighbor(on_path, k, surfaces.fragments.width)
                steps += 1
                _mark_mean_slope(surfaces, sides, keys, has_mean_slope, on_path)
                for turn in range(2):
                    direction = wp.where(k < 2, 2, 0) + turn
                    end = on_path
                    further_steps = steps
                    while further_steps < reach and distance_to_end(surfaces, end, direction) == -1.0:
                        end = neighbor(end, direction, surfaces.fragments.width)
                        further_steps += 1
                        _mark_mean_slope(surfaces, sides, keys, has_mean_slope, end)


def find_outline_samples(
    silhouettes: Silhouettes, clip_positions: wp.array, quadtree: Quadtree | None = None
) -> wp.array:
    """Find the samples that follow their surface by mean slopes although they are receivers.

    Args:
        silhouettes: Of :func:`warpshadow.stages.silhouettes.silhouettes.find_silhouettes`.
        clip_positions: The vertices that the silhouettes were found for, vec4 of shape [batch, vertex].
        quadtree: Squares in which samples interpolate, which none of these does; None for none.
    Returns:
        bool of shape [view, sample].

    Not differentiable.
    """
    fragments, surfaces = silhouettes.fragments, make_surface_arrays(silhouettes, clip_positions)
    sides = fragments.face_ids if fragments.sides is None else fragments.sides
    has_mean_slope = zeros(rows(sides).shape, dtype=wp.bool, device=sides.device)
    keys = None if quadtree is None else quadtree.square_key_of_side
    inputs = [silhouettes.samples, surfaces, reshaped(sides, (-1,)), keys, REACH]
    launch(_find_outline_samples, silhouettes.samples.size, inputs=inputs, outputs=[reshaped(has_mean_slope, (-1,))])
    return has_mean_slope


@wp.kernel(enable_backward=False)
def _detach_adjoint(
    # in
    has_mean_slope: wp.array2d(dtype=wp.bool),
    adj_detached: wp.array2d(dtype=wp.vec3),
    # out
    adj_barycentrics: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a sample."""
    view, sample = wp.tid()
    if not has_mean_slope[view, sample]:
        adj_barycentrics[view, sample] += adj_detached[view, sample]


def detach_near_outlines(fragments: Fragments, has_mean_slope: wp.array) -> Fragments:
    """Fragments by which a color moves with its point, but at samples where its mean slope tells how it moves.

    Args:
        has_mean_slope: Of :func:`find_outline_samples`.

    Differentiable: barycentrics of the other samples.
    """
    barycentrics = fragments.barycentrics
    detached_barycentrics = differentiable(
        lambda _: None,
        lambda adj_detached: launch(
            _detach_adjoint,
            has_mean_slope.shape,
            inputs=[has_mean_slope, rows(adj_detached)],
            outputs=[rows(barycentrics.grad)],
        ),
        copied(barycentrics),
        [barycentrics],
    )
    return replace(fragments, barycentrics=detached_barycentrics)
