"""Exitance of spheres: the light that the patches of a body send, told by the spheres that stand in for it.

Each patch p has a sphere of its own; several share one only where spheres are merged. Towards a receiver that sees the
sphere in direction ω, its patches send

    E_j(ω) = Σ_p A_p (g_p + 0.01) B_p / Σ_p A_p (g_p + 0.01)

the mean of their radiosities B by the area that they show: g_p is that of a unit (:mod:`.openness`). Patches that face
away, or are hidden, count for a hundredth of their area: where none shows itself the mean is still one, so it is
smooth, and nothing is divided by zero.

What a receiver sees through a cell is a mean over the spheres in it (:mod:`warpshadow.stages.bounces.sphere_light`).
There, too, patches should count by the area that they show: the spheres on the far side of a body show none. So
numerator and denominator stay apart, both over Σ_p A_p. By g_p = max(−n_p·ω, 0), on a ground around a bunny of 64
spheres that is in the sky and the sun the light that the bunny sends is 14% off by either, of a sun alone 33%, where
equal weights give 37%; of a white bunny 8% and without bias, where equal weights lose 6% of the light.
"""

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.constants import constant
from warpshadow.device.launch import differentiable, launch
from warpshadow.stages.visibility.merging import MERGING, QUAD, merged_count

_HIDDEN = wp.constant(0.01)
"""Part of its area that a patch counts for where it shows none."""

_SHOWN = wp.constant(0.25)
"""Part of its area that a convex body shows on average: the weight of spheres without patches, which are black."""


def patches_of_nodes(
    spheres: np.ndarray, nearest: np.ndarray, *, merging: float = MERGING
) -> tuple[np.ndarray, np.ndarray]:
    """Patches of spheres and then, where spheres merge, of the quads' spheres, which have those of all four.

    Args:
        spheres: Sphere of each patch, −1 for none, shape [patch].
        nearest: Patch nearest to each sphere, which a sphere that has none takes; −1 if its body is black, as the
            sphere then is. Shape [sphere].
        merging: As for :func:`warpshadow.stages.visibility.directional.transmittance`.

    Returns:
        Where the patches of each node begin, and the end, int32 of shape [node + 1]; and these patches, int32.
    """
    order = np.argsort(spheres, kind="stable")
    ends = np.searchsorted(spheres[order], np.arange(len(nearest) + 1))
    lists = [order[first:end] for first, end in zip(ends[:-1], ends[1:], strict=True)]
    lists = [own if len(own) or patch < 0 else np.array([patch]) for own, patch in zip(lists, nearest, strict=True)]
    for quad in range(merged_count(len(nearest), merging)):
        lists.append(np.concatenate(lists[QUAD * quad : QUAD * (quad + 1)]))
    starts = np.cumsum([0, *map(len, lists)])
    return starts.astype(np.int32), np.concatenate([*lists, []]).astype(np.int32)


@wp.struct
class PatchesOfNodes:
    """Patches of nodes, as kernels see them."""

    shown: wp.array3d(dtype=wp.float32)
    areas: wp.array(dtype=wp.float32)
    starts: wp.array(dtype=wp.int32)
    numbers: wp.array(dtype=wp.int32)


@wp.func
def _sum_up(batch: int, node: int, direction: int, radiosity: wp.array2d(dtype=wp.vec3), patches: PatchesOfNodes):
    """Σ A (g + 0.01) B and Σ A (g + 0.01), both over Σ A, and Σ A."""
    light = wp.vec3()
    shown = float(0.0)
    area = float(0.0)
    for k in range(patches.starts[node], patches.starts[node + 1]):
        patch = patches.numbers[k]
        open = patches.shown[instance_in(batch, patches.shown.shape[0]), patch, direction]
        part = patches.areas[patch] * (open + _HIDDEN)
        light += part * radiosity[instance_in(batch, radiosity.shape[0]), patch]
        shown += part
        area += patches.areas[patch]
    if area > 0.0:
        light = light / area
        shown = shown / area
    else:
        shown = _SHOWN
    return light, shown, area


@wp.kernel(enable_backward=False)
def _tabulate(
    # in
    radiosity: wp.array2d(dtype=wp.vec3),
    patches: PatchesOfNodes,
    # out
    exitance: wp.array3d(dtype=wp.vec4),
):
    """A thread owns a node and a direction."""
    batch, node, direction = wp.tid()
    light, shown, _area = _sum_up(batch, node, direction, radiosity, patches)
    exitance[batch, node, direction] = wp.vec4(light[0], light[1], light[2], shown)


@wp.kernel(enable_backward=False)
def _tabulate_adjoint(
    # in
    radiosity: wp.array2d(dtype=wp.vec3),
    patches: PatchesOfNodes,
    adj_exitance: wp.array3d(dtype=wp.vec4),
    # out
    adj_radiosity: wp.array2d(dtype=wp.vec3),
    adj_shown: wp.array3d(dtype=wp.float32),
):
    """A thread owns a node and a direction:  B̄_p = A (g + 0.01) L̄ / ΣA,  ḡ_p = A (L̄·B_p + s̄) / ΣA."""
    batch, node, direction = wp.tid()
    adj = adj_exitance[batch, node, direction]
    adj_light = wp.vec3(adj[0], adj[1], adj[2])
    _light, _shown, area = _sum_up(batch, node, direction, radiosity, patches)
    if area > 0.0:
        for k in range(patches.starts[node], patches.starts[node + 1]):
            patch = patches.numbers[k]
            shown_batch = instance_in(batch, patches.shown.shape[0])
            radiosity_batch = instance_in(batch, radiosity.shape[0])
            share = patches.areas[patch] / area
            if adj_radiosity:
                factor = share * (patches.shown[shown_batch, patch, direction] + _HIDDEN)
                wp.atomic_add(adj_radiosity, radiosity_batch, patch, factor * adj_light)
            if adj_shown:
                pull = share * (wp.dot(adj_light, radiosity[radiosity_batch, patch]) + adj[3])
                wp.atomic_add(adj_shown, shown_batch, patch, direction, pull)


def sphere_exitance(
    radiosity: wp.array,
    shown: wp.array,
    areas: np.ndarray,
    starts: np.ndarray,
    numbers: np.ndarray,
) -> wp.array:
    """Light that spheres send towards cells of directions, for :func:`.sphere_light.sphere_light`.

    It costs nodes × directions × patches of a node, whatever the receivers.

    Args:
        radiosity: Of patches: what white under a radiance of 1 sends is 1, vec3 of shape [batch, patch].
        shown: g, part of its area that each patch shows towards each cell, float32 of shape [batch, patch, direction],
            from :func:`.openness.shown_areas`.
        areas: Of patches [scene units²], not negative, float32 of shape [patch].
        starts, numbers: Patches of each node, from :func:`patches_of_nodes`.

    Returns:
        Σ A (g + 0.01) B / Σ A and Σ A (g + 0.01) / Σ A, vec4 of shape [batch, node, direction].

    Differentiable: radiosity, shown.
    """
    batch_count = common_batch({"radiosity": radiosity, "shown": shown})
    patch_count = len(areas)
    check.shape("radiosity", radiosity.shape, (radiosity.shape[0], patch_count))
    check.shape("shown", shown.shape, (shown.shape[0], patch_count, "direction"))
    check.finite("areas", np.asarray(areas), least=0.0)
    if starts[0] != 0 or (np.diff(starts) < 0).any() or starts[-1] != len(numbers):
        raise ValueError(f"starts: got {np.asarray(starts)!r}, expected 0 to the {len(numbers)} numbers, rising")
    if len(numbers) and not 0 <= min(numbers) <= max(numbers) < patch_count:
        raise ValueError(f"numbers: got {min(numbers)} to {max(numbers)}, expected patches, 0 to {patch_count - 1}")
    device = radiosity.device
    patches = PatchesOfNodes()
    patches.shown = shown
    patches.areas = constant(np.asarray(areas, np.float32), wp.float32, device)
    patches.starts = constant(np.asarray(starts, np.int32), wp.int32, device)
    patches.numbers = constant(np.asarray(numbers, np.int32), wp.int32, device)
    inputs = [radiosity, patches]
    shape = batch_count, len(starts) - 1, shown.shape[2]
    return differentiable(
        lambda exitance: launch(_tabulate, shape, inputs=inputs, outputs=[exitance]),
        lambda adj_exitance: launch(
            _tabulate_adjoint, shape, inputs=[*inputs, adj_exitance], outputs=[radiosity.grad, shown.grad]
        ),
        result=wp.empty(shape, dtype=wp.vec4, device=device),
        variables=[radiosity, shown],
    )
