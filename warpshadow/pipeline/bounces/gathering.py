"""Gathering: bounced light at receivers, given the proxies of the bodies that send it.

A body's patches send to the body itself by form factors, a flat body's by its grid, and others' by the spheres that
stand in for them. Where the light of a cell is blocked, one of these takes its place.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.batch import common_batch, concatenate, cut, expand, expand_rows
from warpshadow.device.constants import constant
from warpshadow.maths.directions import fibonacci
from warpshadow.pipeline.bounces.covered import find_overlays
from warpshadow.pipeline.bounces.patches import Senders
from warpshadow.pipeline.bounces.self_form_factors import SelfFormFactors
from warpshadow.pipeline.by_spheres import SphereMethod
from warpshadow.pipeline.node import Call, Node, NodeStage
from warpshadow.pipeline.receivers.groups import Group, GroupVisibility, nonplanar_bodies
from warpshadow.pipeline.transfers import joined
from warpshadow.scene.visibility import Visibility
from warpshadow.stages.bounces.overlays import overlaid_radiosity
from warpshadow.stages.bounces.plane_light import plane_light
from warpshadow.stages.bounces.plane_texels import find_texels
from warpshadow.stages.bounces.projected_areas import find_projected_areas, tilt_normals_off_planes
from warpshadow.stages.bounces.proxies import find_depths, place_proxies
from warpshadow.stages.bounces.proxy_radiance import find_proxy_radiance, patches_of_clusters
from warpshadow.stages.bounces.self_light import self_light
from warpshadow.stages.bounces.sphere_light import sphere_light
from warpshadow.stages.bounces.tangent_planes import TangentPlanes, find_tangent_planes, find_tolerances
from warpshadow.stages.planes.fronts import NearestBlockers, find_fronts
from warpshadow.stages.planes.prepared import PlaneBlockers, PlaneBody
from warpshadow.stages.receivers import Receivers
from warpshadow.stages.sparse import SparseMatrix, multiply
from warpshadow.stages.visibility.directional import transmittance
from warpshadow.stages.visibility.traversal import ClusterTree, find_clusters

HARMONIC_GATHER_CELLS = fibonacci(64)  # where receivers look for bounced light if direct light is found in harmonics
ALL_FLAT = "all that reflects is flat"  # why no body sends light to itself, in words

_SOFTNESS_OF_PARTS = 1.0
"""κ of proxies where convex parts block, at least: parts are seen by a cell's whole disc, of radius ρ. With less, cells
that parts block have no proxy in them, which loses light, and light jumps as a proxy comes or goes."""


class CellTransmittance(NamedTuple):
    """Transmittance of a portion of the receivers in cells of directions."""

    transmittance_self: wp.array | None  # [batch, receiver, cell], past its own body; None where that is 1
    transmittance_spheres: wp.array  # [batch, receiver, cell], past all bodies but planes, its own included
    directions: np.ndarray  # [cell, 3]


def find_cell_transmittance(
    method: SphereMethod,
    group: Group,
    visibility: GroupVisibility,
    projected_light: Any,
    spheres: tuple[wp.array, wp.array],
) -> CellTransmittance:
    """Transmittance of a group in cells of directions.

    Args:
        method: How light is blocked.
        group: The receivers.
        visibility: Visibility of direct light.
        projected_light: Projected direct light.
        spheres: Centers and radii of all spheres.
    """
    merged_scene = method.merged_scene
    if method.sees_cells:
        directions, transmittance_self = projected_light.directions, visibility.transmittance_self
        transmittance_spheres = (
            visibility.transmittance_total
            if visibility.transmittance_spheres is None
            else visibility.transmittance_spheres
        )
    else:
        directions, transmittance_self = HARMONIC_GATHER_CELLS, None
        transmittance_spheres = _transmittance(method, group, nonplanar_bodies(merged_scene), spheres, directions)
    if transmittance_self is None and group.body is not None and not merged_scene.is_flat[group.body]:
        transmittance_self = _transmittance(method, group, [group.body], spheres, directions)
    if transmittance_spheres is None:
        transmittance_spheres = wp.full(
            (*group.points.shape, len(directions)), 1.0, wp.float32, device=group.points.device
        )
    return CellTransmittance(transmittance_self, transmittance_spheres, directions)


def _transmittance(
    method: SphereMethod, group: Group, bodies: list[int], spheres: tuple[wp.array, wp.array], directions: np.ndarray
) -> wp.array | None:
    """Transmittance of the spheres of some bodies, [batch, receiver, cell]; None without any."""
    centers, radii = method.merged_scene.spheres_of(bodies, spheres)
    if not (radii.shape[1] and group.points.size):
        return None
    count = common_batch({"points": group.points, "spheres": radii})  # cameras may see one geometry at other points
    points, normals, centers, radii = (expand(array, count) for array in (group.points, group.normals, centers, radii))
    softness, merging = method.visibility.softness, method.visibility.merging
    return transmittance(points, normals, centers, radii, directions, softness=softness, merging=merging)


class SenderPlanes(NamedTuple):
    """Flat bodies."""

    all: PlaneBlockers
    number: dict[int | None, int]  # of each among them, by the number of the body


class ProjectedPatches(NamedTuple):
    """Patches of bodies that are not flat, as their proxy spheres send them."""

    areas: wp.array  # part of its area that each shows towards each cell, [batch, patch, cell]
    centers: wp.array  # of the spheres, vec3 of shape [batch, patch + sphere of dark bodies]
    radii: wp.array  # likewise, 0 for patches of flat bodies
    clusters: ClusterTree
    tangent_planes: TangentPlanes


class Proxies:
    """Proxies of sending bodies: plane bodies for themselves, spheres for all others.

    Args:
        senders: The bodies.
        merging: As for the method of visibility.
    """

    def __init__(self, senders: Senders, merging: float):
        self.senders, self.merged_scene, self.merging = senders, senders.merged_scene, merging

    @functools.cached_property
    def planes(self) -> SenderPlanes | None:
        """The flat bodies among them; None without any."""
        merged_scene, senders = self.merged_scene, self.senders
        numbers = [number for number in senders.bodies if merged_scene.is_flat[number]]
        if not numbers:
            return None
        bodies = []
        for number in numbers:
            sender_index, body = senders.bodies.index(number), merged_scene.scene.bodies[number]
            grid = senders.patches[sender_index].grid
            assert grid is not None
            starts = int(merged_scene.first_vertex[number]), int(senders.first[sender_index])
            bodies.append(PlaneBody(grid, body.mesh.positions, body.mesh.surface.faces, *starts, body.casts_shadow))
        counts = len(senders.areas), int(merged_scene.first_vertex[-1])
        planes = PlaneBlockers.from_bodies(bodies, *counts, device=merged_scene.device)
        return SenderPlanes(planes, {number: k for k, number in enumerate(numbers)})

    @functools.cached_property
    def nonplanar_bodies(self) -> list[int]:
        """The bodies for which spheres stand in."""
        return nonplanar_bodies(self.merged_scene)

    @functools.cached_property
    def black_bodies(self) -> list[int]:
        """Nonplanar bodies that send no light: their blocker spheres are their proxies."""
        return [body for body in self.nonplanar_bodies if body not in self.senders.bodies]

    @functools.cached_property
    def overlays(self) -> tuple[SparseMatrix, np.ndarray] | None:
        """Texels before the patches that flat bodies cover, and how far away they are; None without any."""
        overlays = find_overlays(self.senders, self._depths)
        if overlays is None:
            return None
        return SparseMatrix.from_matrix(overlays.before, device=self.merged_scene.device), overlays.distances

    def span_of(self, body: int | None) -> tuple[int, int]:
        """Where the proxies of a body begin and end."""
        first = self.senders.first
        if body in self.senders.bodies:
            sender_index = self.senders.bodies.index(body)
            return int(first[sender_index]), int(first[sender_index + 1])
        begin, end = self.merged_scene.spheres_among(self.black_bodies, body)
        return (int(first[-1]) + begin, int(first[-1]) + end) if end else (0, 0)

    @functools.cached_property
    def patches_of_clusters(self) -> tuple[np.ndarray, np.ndarray]:
        """The patches of each proxy, and of the clusters that they merge into: where they begin, and numbers."""
        count = int(self.merged_scene.sphere_counts[self.black_bodies].sum())
        numbers = np.arange(len(self.senders.areas))
        return patches_of_clusters(numbers, np.full(len(numbers) + count, -1), merging=self.merging)

    @functools.cached_property
    def _blockers(self) -> tuple[np.ndarray, np.ndarray]:
        """For each patch, the nearest sphere of its body, −1 for none, and its proxy's radius relative to it."""
        rest, first_sphere, senders = self.merged_scene.rest, self.merged_scene.first_sphere, self.senders
        centers, radii = rest.centers.numpy()[0], rest.radii.numpy()[0]
        numbers, ratios = np.full(len(senders.areas), -1, np.int32), np.zeros(len(senders.areas), np.float32)
        start = 0
        for body in self.nonplanar_bodies:
            of_body = slice(*first_sphere[body : body + 2])
            if len(radii[of_body]) and body in senders.bodies:
                sender_index = senders.bodies.index(body)
                patches = senders.patches[sender_index]
                patch_range = slice(*senders.first[sender_index : sender_index + 2])
                nearest = patches.nearest_spheres(centers[of_body], radii[of_body])
                numbers[patch_range] = start + nearest
                ratios[patch_range] = np.sqrt(patches.areas / 2) / np.maximum(radii[of_body][nearest], 1e-30)
            start += len(radii[of_body])
        return numbers, ratios

    @functools.cached_property
    def _depths(self) -> np.ndarray:
        """How far below each patch its proxy is, in radii."""
        return np.concatenate([find_depths(item.centers, item.normals, item.areas) for item in self.senders.patches])

    @functools.cached_property
    def _tolerances(self) -> np.ndarray:
        """How bent the patches of each proxy and cluster are, from :func:`.tangent_planes.find_tolerances`."""
        return find_tolerances(self.senders.patches, *self.patches_of_clusters)

    @functools.cached_property
    def nearest_spheres(self) -> np.ndarray:
        """Sphere nearest to the patch of each patch sample, −1 for none: int32 of shape [patch sample]."""
        return self._blockers[0][self.senders.patch_of_sample]

    def projected_patches(
        self,
        patch_samples: Receivers,
        cells: list[CellTransmittance],
        spheres: tuple[wp.array, wp.array],
        frames: wp.array | None,
    ) -> ProjectedPatches:
        """Patches as receivers see them.

        Args:
            patch_samples: Where they are lit.
            cells: Transmittance of the patch samples, in portions.
            spheres: Centers and radii of all spheres.
            frames: Where flat bodies are.
        """
        normals, planes, senders = patch_samples.normals, self.planes, self.senders
        centers, radii = self.merged_scene.spheres_of(self.nonplanar_bodies, spheres)
        if planes is not None:
            numbers, points, device = self.nearest_spheres, patch_samples.points, normals.device
            of_patch_samples = NearestBlockers(centers, radii, constant(numbers, wp.int32, device))
            fronts = find_fronts(points, normals, None, of_patch_samples, frames, planes.all)
            if self.overlays is not None:
                numbers = np.where(self.overlays[1][senders.patch_of_sample] > 0, np.int32(-1), numbers)
            normals = tilt_normals_off_planes(points, normals, radii, numbers, fronts, frames, planes.all)
        rows = [
            wp.full_like(portion.transmittance_spheres, 1.0, requires_grad=False)
            if portion.transmittance_self is None
            else portion.transmittance_self
            for portion in cells
        ]
        transmittance = joined([row.reshape((len(row), -1)) for row in rows])
        directions = cells[0].directions
        transmittance = transmittance.reshape((len(transmittance), len(senders.sides), len(directions)))
        mean_points = multiply(senders.mean, patch_samples.points)
        mean_normals = multiply(senders.mean, patch_samples.normals)
        placed = place_proxies(mean_points, mean_normals, radii, *self._blockers, self._depths)
        if self.black_bodies:
            others = self.merged_scene.spheres_of(self.black_bodies, spheres)
            counts = [len(senders.areas), others[1].shape[1]]
            placed = tuple(concatenate(pair, counts) for pair in zip(placed, others, strict=True))
        areas = find_projected_areas(normals, transmittance, senders.mean, directions)
        clusters = find_clusters(*placed, self.merging)
        proxies = clusters.nodes.centers, *self.patches_of_clusters, self._tolerances
        tangent_planes = find_tangent_planes(mean_points, mean_normals, *proxies)
        return ProjectedPatches(areas, *placed, clusters, tangent_planes)


class OutgoingRadiance:
    """Radiosity of the patches in the forms that receivers gather; each is computed when first asked for.

    Args:
        proxies: Proxies of the bodies whose patches they are.
        radiosity: Of the patches, vec3 of shape [batch, patch].
        projected_patches: The patches as receivers see them.
        frames: Where flat bodies are, vec3 of shape [batch, 3 · plane].
        patch_weights: Of the patches, vec3 of shape [batch, patch].
    """

    def __init__(
        self,
        proxies: Proxies,
        radiosity: wp.array,
        projected_patches: ProjectedPatches,
        frames: wp.array,
        patch_weights: wp.array,
    ):
        self.proxies, self.senders, self.radiosity = proxies, proxies.senders, radiosity
        self.projected_patches, self.frames, self.patch_weights = projected_patches, frames, patch_weights

    def of_body(self, body: int) -> wp.array:
        """Radiosity of the patches of a body, vec3 of shape [batch, patch]."""
        sender_index = self.senders.bodies.index(body)
        return cut(self.radiosity, *self.senders.first[sender_index : sender_index + 2].tolist())

    @functools.cached_property
    def proxy_radiance(self) -> wp.array:
        """Light that proxies of patches send towards cells, vec4 of shape [batch, proxy, cell]."""
        proxies, radiosity, patches = self.proxies, self.radiosity, self.projected_patches
        if proxies.overlays is not None:
            radiosity = overlaid_radiosity(radiosity, cut(patches.centers, 0, radiosity.shape[1]), *proxies.overlays)
        return find_proxy_radiance(
            radiosity, patches.areas, self.patch_weights, self.senders.areas, *proxies.patches_of_clusters
        )

    @functools.cached_property
    def texels(self) -> wp.array:
        """Radiosity of the flat bodies, vec3 of shape [batch, texel]."""
        assert self.proxies.planes is not None
        return find_texels(self.radiosity, self.patch_weights, self.proxies.planes.all)


class Gathering:
    """Gather at receivers the light that patches send: G.

    Args:
        visibility: How spheres block light.
        senders: The bodies whose patches send light.
        self_form_factors: Form factors of bodies for themselves.
        item_text: Number of receivers, in words.
        where: Put after the names of its stages.
        why_not: Why nobody asks for it, in words; empty if somebody does.
        only_others: Leave out light from a body to itself.
    Attributes:
        stages: Its parts.
    """

    def __init__(
        self,
        visibility: Visibility,
        senders: Senders,
        self_form_factors: SelfFormFactors,
        item_text: str | Callable[[], str],
        where: str = "",
        why_not: str = "",
        only_others: bool = False,
    ):
        self._visibility, self._self_form_factors = visibility, self_form_factors
        self._is_flat, sphere_counts = senders.merged_scene.is_flat, senders.merged_scene.sphere_counts
        nonplanar_bodies = [body for body in senders.bodies if not self._is_flat[body]]
        idle = (
            "" if nonplanar_bodies else ALL_FLAT,
            "" if len(nonplanar_bodies) < len(senders.bodies) else "nothing flat reflects",
            "" if any(sphere_counts[body] for body in nonplanar_bodies) else "nothing that reflects has spheres",
        )
        names = "self light", "plane light", "sphere light"
        stages = tuple(
            NodeStage(f"{name}{where}", item_text, why_not or why) for name, why in zip(names, idle, strict=True)
        )
        functions = self._from_itself, self._from_planes, self._from_spheres
        first = 1 if only_others else 0
        self.stages, self._functions = stages[first:], functions[first:]

    def lights(
        self, node: Node, call: Call, group: Group, cells: CellTransmittance, outgoing: OutgoingRadiance
    ) -> list[wp.array]:
        """Bounced light of a group by each path: its own body, planes, spheres; vec3 of shape [batch, receiver].

        ``node`` has the stages.
        """
        result = []
        for stage, function in zip(self.stages, self._functions, strict=True):
            if not stage.idle:
                with node.timed(call, stage):
                    result.append(function(group, cells, outgoing))
        return [light for light in result if light is not None]

    def _from_itself(self, group: Group, _: CellTransmittance, outgoing: OutgoingRadiance) -> wp.array | None:
        if group.body not in outgoing.senders.bodies or self._is_flat[group.body]:
            return None
        assert group.body is not None and group.probe_weights is not None
        return self_light(self._self_form_factors.of(group.body), outgoing.of_body(group.body), *group.probe_weights)

    def _from_planes(self, group: Group, cells: CellTransmittance, outgoing: OutgoingRadiance) -> wp.array:
        planes = outgoing.proxies.planes
        assert planes is not None
        skip = planes.number.get(group.body)
        points, fronts = group.lifted_points_and_fronts(outgoing.frames, planes.all, skip)
        # Cells look to where the light of the sky is, above horizons; light of planes is found around their middles. A
        # ball on a ground lost 4% of the ground's light by the former.
        middles = fibonacci(len(cells.directions))
        arguments = points, group.normals, cells.transmittance_spheres, outgoing.frames, outgoing.texels, planes.all
        return plane_light(*arguments, middles, fronts=fronts, skip=skip)

    def _from_spheres(self, group: Group, cells: CellTransmittance, outgoing: OutgoingRadiance) -> wp.array | None:
        if not any(body != group.body and not self._is_flat[body] for body in outgoing.senders.bodies):
            return None
        projected_patches, proxy_radiance = outgoing.projected_patches, outgoing.proxy_radiance
        softness = self._visibility.softness
        if group.convex_parts_around is not None:
            softness = max(softness, _SOFTNESS_OF_PARTS)
        count = common_batch({"geometry": group.points, "light": proxy_radiance, "proxies": projected_patches.radii})
        points, normals = expand(group.points, count), expand(group.normals, count)
        centers, radii = expand(projected_patches.centers, count), expand(projected_patches.radii, count)
        return sphere_light(
            points,
            normals,
            centers,
            radii,
            proxy_radiance,
            expand_rows(cells.transmittance_spheres, count),
            cells.transmittance_self,
            cells.directions,
            softness=softness,
            merging=self._visibility.merging,
            skip=outgoing.proxies.span_of(group.body),
            clusters=projected_patches.clusters
            if radii is projected_patches.radii and centers is projected_patches.centers
            else None,
            tangent_planes=projected_patches.tangent_planes,
        )
