"""Gathering: bounced light at receivers, given the proxies of the bodies that send it.

A body's patches send to the body itself by form factors, a plane's by its grid, and others' by their proxies. Where the
light of a cell is blocked, one of these takes its place.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import warp as wp

from warpshadow.device.batch import common_batch, cut, expand, expand_rows
from warpshadow.maths.directions import fibonacci
from warpshadow.pipeline.bounces.cell_transmittance import CellTransmittance
from warpshadow.pipeline.bounces.patches import Senders
from warpshadow.pipeline.bounces.proxies import PlacedProxies, Proxies
from warpshadow.pipeline.bounces.self_form_factors import ProbeFormFactors, SelfFormFactors
from warpshadow.pipeline.node import Call, ExplainRow, Node
from warpshadow.pipeline.receivers.groups import Group
from warpshadow.scene.visibility import Visibility
from warpshadow.stages.bounces.overlays import overlaid_radiosity
from warpshadow.stages.bounces.plane_light import plane_light
from warpshadow.stages.bounces.plane_texels import find_texels
from warpshadow.stages.bounces.proxy_radiance import find_proxy_radiance
from warpshadow.stages.bounces.self_light import self_light
from warpshadow.stages.bounces.sphere_light import sphere_light
from warpshadow.stages.sparse import multiply

ALL_FLAT = "all that reflects is flat"  # why no body sends light to itself, in words

_SOFTNESS_OF_PARTS = 1.0
"""κ of proxies where convex parts block, at least: parts are seen by a cell's whole disc, of radius ρ. With less, cells
that parts block have no proxy in them, which loses light, and light jumps as a proxy comes or goes."""


class PortionForBounces(NamedTuple):
    """Some receivers, and their visibility of bounced light."""

    direct: wp.array  # direct light, vec3 of shape [batch, receiver]; if it is free, transfer vectors
    group: Group
    transmittance: CellTransmittance


class OutgoingRadiance:
    """Radiosity of the patches in the forms that receivers gather; each is computed when first asked for.

    Args:
        proxies: Proxies of the bodies whose patches they are.
        self_form_factors: Form factors of these bodies for themselves.
        radiosity: Of the patches, vec3 of shape [batch, patch].
        placed_proxies: Their proxies, in the world.
        frames: Where flat bodies are, vec3 of shape [batch, 3 · plane].
        patch_weights: Of the patches, vec3 of shape [batch, patch].
    """

    def __init__(
        self,
        proxies: Proxies,
        self_form_factors: SelfFormFactors,
        radiosity: wp.array,
        placed_proxies: PlacedProxies,
        frames: wp.array,
        patch_weights: wp.array,
    ):
        self.proxies, self.senders, self.radiosity = proxies, proxies.senders, radiosity
        self.placed_proxies, self.frames, self.patch_weights = placed_proxies, frames, patch_weights
        self._self_form_factors = self_form_factors

    @functools.cached_property
    def probe_form_factors(self) -> ProbeFormFactors:
        """Form factors by which bodies send light to their own probes."""
        return self._self_form_factors.of_senders(self.senders)

    @functools.cached_property
    def probe_light(self) -> wp.array:
        """Light that bodies send to their own probes, vec3 of shape [batch, probe]."""
        return multiply(self.probe_form_factors.matrix, self.radiosity)

    @functools.cached_property
    def proxy_radiance(self) -> wp.array:
        """Light that proxies of patches send towards cells, vec4 of shape [batch, proxy, cell]."""
        proxies, radiosity, placed_proxies = self.proxies, self.radiosity, self.placed_proxies
        if proxies.overlays is not None:
            radiosity = overlaid_radiosity(
                radiosity, cut(placed_proxies.centers, 0, radiosity.shape[1]), *proxies.overlays
            )
        return find_proxy_radiance(
            radiosity, placed_proxies.projected_areas, self.patch_weights, self.senders.areas, *proxies.seen_patches
        )

    @functools.cached_property
    def texels(self) -> wp.array:
        """Radiosity of the flat bodies, vec3 of shape [batch, texel]."""
        planes = self.proxies.senders.planes
        assert planes is not None
        return find_texels(self.radiosity, self.patch_weights, planes.blockers)


class BounceGatherer:
    """Gather at receivers the light that patches send: G.

    Args:
        visibility: How spheres block light.
        senders: The bodies whose patches send light.
        item_text: Number of receivers, in words.
        suffix: Ends the names of its rows.
        why_not: Why nobody asks for it, in words; empty if somebody does.
        only_others: Leave out light from a body to itself.
    Attributes:
        rows: Its rows of ``explain``.
    """

    def __init__(
        self,
        visibility: Visibility,
        senders: Senders,
        item_text: str | Callable[[], str],
        suffix: str = "",
        why_not: str = "",
        only_others: bool = False,
    ):
        self._visibility = visibility
        self._is_flat, sphere_counts = senders.merged_scene.is_flat, senders.merged_scene.sphere_counts
        nonplanar_bodies = [body for body in senders.bodies if not self._is_flat[body]]
        idle = (
            "" if nonplanar_bodies else ALL_FLAT,
            "" if len(nonplanar_bodies) < len(senders.bodies) else "nothing flat reflects",
            "" if any(sphere_counts[body] for body in nonplanar_bodies) else "nothing that reflects has spheres",
        )
        names = "self light", "plane light", "sphere light"
        rows = tuple(
            ExplainRow(f"{name}{suffix}", item_text, why_not or why) for name, why in zip(names, idle, strict=True)
        )
        functions = self._from_itself, self._from_planes, self._from_spheres
        first = 1 if only_others else 0
        self.rows, self._functions = rows[first:], functions[first:]

    def add_bounced(self, node: Node, call: Call, portion: PortionForBounces, outgoing: OutgoingRadiance) -> wp.array:
        """Add bounced light to direct light of a portion, by each path: its own body, planes, spheres.

        ``node`` has the rows. The result is vec3 of shape [batch, receiver].
        """
        light = portion.direct
        for row, function in zip(self.rows, self._functions, strict=True):
            if not row.why_idle:
                with node.timed(call, row):
                    light = function(portion.group, portion.transmittance, outgoing, light)
        return light

    def _from_itself(
        self, group: Group, _: CellTransmittance, outgoing: OutgoingRadiance, others: wp.array
    ) -> wp.array:
        first_probes = outgoing.probe_form_factors.first_of(group.spans)
        if max(first_probes, default=-1) < 0:  # convex bodies send themselves nothing
            return others
        rows, weights = group.probe_weights
        return self_light(
            outgoing.probe_light, rows, weights, others, body_spans=group.spans, first_probes=first_probes
        )

    def _from_planes(
        self, group: Group, transmittance: CellTransmittance, outgoing: OutgoingRadiance, others: wp.array
    ) -> wp.array:
        planes = outgoing.proxies.senders.planes
        assert planes is not None
        self_plane = None if group.body is None else planes.index_of_body.get(group.body)
        if planes.blockers.count == (self_plane is not None):
            return others
        fronts = group.find_fronts(outgoing.frames, planes.blockers, self_plane)
        # Planes are seen through the middles of cells. Through transmittance.directions, where skylight comes from,
        # which are above horizons, a ball on a ground lost 4% of the ground's light.
        middles = fibonacci(len(transmittance.directions))
        return plane_light(
            fronts.lifted_points,
            group.normals,
            transmittance.transmittance_nonplanar,
            outgoing.frames,
            outgoing.texels,
            planes.blockers,
            middles,
            front_weights=fronts.front_weights,
            self_plane=self_plane,
            addend=others,
            coverages=transmittance.part_coverages,
        )

    def _from_spheres(
        self, group: Group, transmittance: CellTransmittance, outgoing: OutgoingRadiance, others: wp.array
    ) -> wp.array:
        bodies = {span.body for span in group.spans}
        if not any({body} != bodies and not self._is_flat[body] for body in outgoing.senders.bodies):
            return others
        proxies, proxy_radiance = outgoing.placed_proxies, outgoing.proxy_radiance
        softness = self._visibility.softness
        if group.blockers.convex_parts is not None:
            softness = max(softness, _SOFTNESS_OF_PARTS)
        geometry = {"geometry": group.points, "proxies": proxies.radii}
        count = common_batch({**geometry, "light": proxy_radiance, "other light": others})
        points, normals = expand(group.points, count), expand(group.normals, count)
        centers, radii = expand(proxies.centers, count), expand(proxies.radii, count)
        is_same = centers is proxies.centers and radii is proxies.radii
        return sphere_light(
            points,
            normals,
            centers,
            radii,
            proxy_radiance,
            expand_rows(transmittance.transmittance_nonplanar, count),
            transmittance.transmittance_self,
            transmittance.directions,
            softness=softness,
            merging=self._visibility.merging,
            body_spans=group.spans,
            skips=[outgoing.proxies.range_of(span.body) for span in group.spans],
            clusters=proxies.clusters if is_same else None,
            tangent_planes=proxies.tangent_planes,
            addend=others,
        )
