"""Radiance of proxies: the light that the patches of each send towards cells of directions.

    E_j(ω) = Σ_p A_p (v_p g_p + ε) B_p / Σ_p A_p (v_p g_p + ε),  ε = 0.0001

is the mean of the radiosities B of proxy j's patches (a cluster has several) by the area that they show in direction ω:
g_p of a unit (:mod:`.projected_areas`), counted by v_p, since other bodies may bury them (:mod:`.patch_weights`). With
ε the mean stays smooth where no patch faces the receiver; it is small since a sunlit top is some hundred times brighter
than the bottom.

Numerator and denominator stay apart, both over Σ_p A_p: through a cell a receiver sees a mean over the proxies in it,
which count by the area that they show, too (:mod:`.sphere_light`).
"""

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.launch import launch_with_adjoint
from warpshadow.device.memory import empty
from warpshadow.device.parallel import run_length, split_row
from warpshadow.stages.visibility.merging import CLUSTER_SIZE, MERGING, merged_count

_AVERTED_WEIGHT = wp.constant(1.0e-4)  # ε, the part of its area that a patch counts for where it shows none

_CELL_COST = 3.0  # time of a cell of a proxy [ns]

_BLACK_SPHERE_WEIGHT = 0.25
"""Part of its area that a convex body shows on average: the weight of spheres without patches, which are black."""


def patches_of_clusters(
    spheres: np.ndarray, nearest: np.ndarray, *, merging: float = MERGING
) -> tuple[np.ndarray, np.ndarray]:
    """Patches of proxies and then, where proxies merge, of their clusters, which have the patches of all four.

    Args:
        spheres: Proxy of each patch, −1 for none, shape [patch].
        nearest: Patch nearest to each proxy, which a proxy that has none takes; −1 if its body is black, as the
            proxy then is. Shape [proxy].
        merging: As for :func:`warpshadow.stages.visibility.directional.transmittance`.
    Returns:
        Where the patches of each proxy begin, and the end, int32 of shape [proxy + 1]; and these patches, int32.
    """
    permutation = np.argsort(spheres, kind="stable")
    patch_bounds = np.searchsorted(spheres[permutation], np.arange(len(nearest) + 1))
    patch_lists = [permutation[first:end] for first, end in zip(patch_bounds[:-1], patch_bounds[1:], strict=True)]
    patch_lists = [
        patches_of_sphere if len(patches_of_sphere) or patch < 0 else np.array([patch])
        for patches_of_sphere, patch in zip(patch_lists, nearest, strict=True)
    ]
    for cluster in range(merged_count(len(nearest), merging)):
        patch_lists.append(np.concatenate(patch_lists[CLUSTER_SIZE * cluster : CLUSTER_SIZE * (cluster + 1)]))
    starts = np.cumsum([0, *map(len, patch_lists)])
    return starts.astype(np.int32), np.concatenate([*patch_lists, []]).astype(np.int32)


@wp.kernel(enable_backward=False)
def _tabulate(
    first_row: int,
    worker: int,
    # in
    radiosity: wp.array2d(dtype=wp.vec3),
    projected_areas: wp.array3d(dtype=wp.float32),
    patch_weights: wp.array2d(dtype=wp.vec3),
    starts: wp.array(dtype=wp.int32),
    patch_indices: wp.array(dtype=wp.int32),
    area_shares: wp.array(dtype=wp.float32),
    black_sphere_weights: wp.array(dtype=wp.float32),
    length: int,
    # out
    proxy_radiance: wp.array3d(dtype=wp.vec4),
):
    """A thread owns a run of directions of a proxy; shares are A / Σ A."""
    i, run = wp.tid()
    batch, proxy = split_row(first_row + i, proxy_radiance.shape[1])
    radiosity_batch = instance_in(batch, radiosity.shape[0])
    areas_batch = instance_in(batch, projected_areas.shape[0])
    weights_batch = instance_in(batch, patch_weights.shape[0])
    for direction in range(run * length, (run + 1) * length):
        light = wp.vec3()
        weight_sum = float(black_sphere_weights[proxy])
        for k in range(starts[proxy], starts[proxy + 1]):
            patch = patch_indices[k]
            counted_area = patch_weights[weights_batch, patch][0] * projected_areas[areas_batch, patch, direction]
            patch_weight = area_shares[k] * (counted_area + _AVERTED_WEIGHT)
            light += patch_weight * radiosity[radiosity_batch, patch]
            weight_sum += patch_weight
        proxy_radiance[batch, proxy, direction] = wp.vec4(light[0], light[1], light[2], weight_sum)


@wp.kernel(enable_backward=False)
def _tabulate_adjoint(
    first_row: int,
    worker: int,
    # in
    radiosity: wp.array2d(dtype=wp.vec3),
    projected_areas: wp.array3d(dtype=wp.float32),
    patch_weights: wp.array2d(dtype=wp.vec3),
    starts: wp.array(dtype=wp.int32),
    patch_indices: wp.array(dtype=wp.int32),
    area_shares: wp.array(dtype=wp.float32),
    black_sphere_weights: wp.array(dtype=wp.float32),
    length: int,
    adj_proxy_radiance: wp.array3d(dtype=wp.vec4),
    # sums
    adj_radiosity: wp.array2d(dtype=wp.vec3),
    adj_projected_areas: wp.array3d(dtype=wp.float32),
    adj_patch_weights: wp.array2d(dtype=wp.vec3),
):
    """A thread owns a run of directions of a proxy."""
    i, run = wp.tid()
    batch, proxy = split_row(first_row + i, adj_proxy_radiance.shape[1])
    radiosity_batch = instance_in(batch, radiosity.shape[0])
    areas_batch = instance_in(batch, projected_areas.shape[0])
    weights_batch = instance_in(batch, patch_weights.shape[0])
    for k in range(starts[proxy], starts[proxy + 1]):
        patch = patch_indices[k]
        patch_radiosity = radiosity[radiosity_batch, patch]
        weight = patch_weights[weights_batch, patch][0]
        adj_patch_radiosity = wp.vec3()
        adj_weight = float(0.0)
        for direction in range(run * length, (run + 1) * length):
            area = projected_areas[areas_batch, patch, direction]
            adj = adj_proxy_radiance[batch, proxy, direction]
            adj_light = wp.vec3(adj[0], adj[1], adj[2])
            adj_patch_radiosity += area_shares[k] * (weight * area + _AVERTED_WEIGHT) * adj_light
            adj_counted_area = area_shares[k] * (wp.dot(adj_light, patch_radiosity) + adj[3])
            adj_weight += area * adj_counted_area
            if adj_projected_areas:
                wp.atomic_add(adj_projected_areas, areas_batch, patch, direction, weight * adj_counted_area)
        if adj_radiosity:
            wp.atomic_add(adj_radiosity, radiosity_batch, patch, adj_patch_radiosity)
        if adj_patch_weights:
            wp.atomic_add(adj_patch_weights, weights_batch, patch, wp.vec3(adj_weight, 0.0, 0.0))


def find_proxy_radiance(
    radiosity: wp.array,
    projected_areas: wp.array,
    patch_weights: wp.array,
    areas: np.ndarray,
    starts: np.ndarray,
    patch_indices: np.ndarray,
) -> wp.array:
    """Light that proxies send towards cells of directions, for :func:`.sphere_light.sphere_light`.

    It costs proxies × directions × patches of a proxy, for any number of receivers.

    Args:
        radiosity: Of patches: white under a radiance of 1 has 1, vec3 of shape [batch, patch].
        projected_areas: g of each patch towards each cell, float32 of shape [batch, patch, direction], from
            :func:`.projected_areas.find_projected_areas`.
        patch_weights: v of each patch, in three equal channels, vec3 of shape [batch, patch], from
            :func:`.patch_weights.find_patch_weights`.
        areas: Of patches [scene units²], not negative, float32 of shape [patch].
        starts, patch_indices: Patches of each proxy, from :func:`patches_of_clusters`.
    Returns:
        Σ A (v g + ε) B / Σ A and Σ A (v g + ε) / Σ A, vec4 of shape [batch, proxy, direction].
    Differentiable: radiosity, projected_areas, patch_weights.
    """
    arrays = {"radiosity": radiosity, "projected_areas": projected_areas, "patch_weights": patch_weights}
    batch_count = common_batch(arrays)
    patch_count = len(areas)
    check.shape("radiosity", radiosity.shape, (radiosity.shape[0], patch_count))
    check.shape("projected_areas", projected_areas.shape, (projected_areas.shape[0], patch_count, "direction"))
    check.shape("patch_weights", patch_weights.shape, (patch_weights.shape[0], patch_count))
    check.finite("areas", np.asarray(areas), minimum=0.0)
    if starts[0] != 0 or (np.diff(starts) < 0).any() or starts[-1] != len(patch_indices):
        raise ValueError(f"starts: got {np.asarray(starts)!r}, expected 0 to the {len(patch_indices)} indices, rising")
    if len(patch_indices) and not 0 <= min(patch_indices) <= max(patch_indices) < patch_count:
        raise ValueError(
            f"patch_indices: got {min(patch_indices)} to {max(patch_indices)}, expected patches, 0 to {patch_count - 1}"
        )
    device = radiosity.device
    proxies = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    area_sums = np.bincount(proxies, areas[patch_indices], len(starts) - 1)
    area_shares = areas[patch_indices] / np.where(area_sums > 0, area_sums, 1)[proxies]
    int_tables = [constant(np.asarray(values, np.int32), wp.int32, device) for values in (starts, patch_indices)]
    float_tables = [area_shares, np.where(area_sums > 0, 0.0, _BLACK_SPHERE_WEIGHT)]
    proxy_arrays = [*int_tables, *(constant(values.astype(np.float32), wp.float32, device) for values in float_tables)]
    direction_count = projected_areas.shape[2]
    length = run_length(device, direction_count)
    return launch_with_adjoint(
        _tabulate,
        _tabulate_adjoint,
        (batch_count * (len(starts) - 1), direction_count // length),
        inputs=[*arrays.values(), *proxy_arrays, length],
        result=empty((batch_count, len(starts) - 1, direction_count), dtype=wp.vec4, device=device),
        variables=[],
        shared=list(arrays.values()),
        cost=_CELL_COST * length,
        adj_cost=_CELL_COST * length,
    )
