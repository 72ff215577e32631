"""The directional method: transmittance of the spheres for cells of directions, lit by the light of each cell."""

import functools
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warpshadow.assets.basis import Basis, CellBasis
from warpshadow.assets.cells import draw_in_cells
from warpshadow.assets.color import LUMINANCE
from warpshadow.assets.light import EnvironmentMap
from warpshadow.device.tape import unrecorded
from warpshadow.maths.directions import CHUNK, cell_radius, fibonacci
from warpshadow.pipeline.assembly import Assembly
from warpshadow.pipeline.by_spheres import SphereMethod
from warpshadow.pipeline.groups import Group, Seen
from warpshadow.pipeline.lighting import LARGEST_COEFFICIENT, KnownLight, map_of
from warpshadow.pipeline.node import Source
from warpshadow.pipeline.own_shadows import Blocking, OwnLookup
from warpshadow.pipeline.static import Rows, Static
from warpshadow.scene.blockers import blocking_planes
from warpshadow.stages.flats.passing import flat_coverage, past_coverage
from warpshadow.stages.kept_cells import KeptRows, cell_transfer, light_cells
from warpshadow.stages.light_samples import CellSamples, cell_samples, even_samples, sample_map
from warpshadow.stages.own_shadows.gather import gather_own, multiply_transmittances
from warpshadow.stages.own_shadows.sun_cells import SunCells, find_sun_cells, trace_sun_cells
from warpshadow.stages.ray_tracing import trace_cells
from warpshadow.stages.shading import shade_cells
from warpshadow.stages.sides import split_sides
from warpshadow.stages.transfer import directional_transfer
from warpshadow.stages.visibility import directional
from warpshadow.stages.visibility.narrow import Narrow, find_narrow, put_narrow


class Cells(NamedTuple):
    """Light in cells."""

    directions: np.ndarray  # [direction, 3]
    coefficients: wp.array | None = None  # of known light, vec3 of shape [1, direction]
    spreads: np.ndarray | None = None  # half-angles of where known light comes from in its cells [direction]
    narrow: Narrow | None = None  # cells that a sun is in
    sun: SunCells | None = None  # the brightest cells, where bodies want rays to them


class Directional(SphereMethod):
    """Visibility for each cell of directions by itself."""

    traces_own_shadows = True
    shades_what_is_seen = True

    def __init__(self, assembly: Assembly, basis: Basis | None, *, progress: bool = False):
        self._directions = fibonacci(assembly.scene.visibility.directions)
        super().__init__(assembly, CellBasis(self._directions), basis, progress=progress)
        self.taken_if_free = Cells(self._directions)

    def taken_from(self, light: KnownLight) -> Cells:
        """Cells that look to where their light comes from: a sun is rarely in the middle of one."""
        if not isinstance(light, EnvironmentMap):
            return Cells(self._directions, self._on_device(self.native_basis.coefficients(light)))
        cells = light.cells(self._directions)
        power, softness = cells.radiance @ LUMINANCE, self.visibility.softness
        narrow = find_narrow(power, cells.directions, cells.spreads, softness)
        draw = functools.partial(draw_in_cells, light.radiance, self._directions)
        sun = find_sun_cells(power, draw) if self.own_shadows.wants_rays else None
        return Cells(cells.directions, self._on_device(cells.radiance), cells.spreads, narrow, sun)

    def _on_device(self, coefficients: np.ndarray) -> wp.array:
        return wp.array(coefficients[None], dtype=wp.vec3, device=self.assembly.device)

    def coefficient_count(self, light: Source | None) -> int:
        """Number of coefficients that take part: all."""
        return len(self._directions)

    def look_up(self, bodies: tuple[int, ...], rotations: wp.array, taken: Cells) -> dict[int, OwnLookup]:
        """What receivers of some bodies look up of these. Differentiable: rotations."""
        has_sun = taken.sun is not None
        return self.own_shadows.lookups(bodies, rotations, taken.directions, taken.spreads, has_sun=has_sun)

    def see(self, group: Group, taken: Cells) -> Seen:
        """Transmittance, float32 of shape [batch, receiver, direction]."""
        points, normals, centers, radii, kept_rows = group[:5]
        past_own = self._past_own(group, taken)
        if not (radii.shape[1] and points.size):
            if past_own is not None:
                return Seen(past_own, past_own)
            shape = *points.shape, len(taken.directions)
            return Seen(wp.full(shape, 1.0, dtype=wp.float32, device=points.device))
        # kept cells have light although their middles are below the horizon
        facing = normals if kept_rows is None else None
        given, scales = (points, facing, centers, radii), self._scales
        block = functools.partial(directional.transmittance, *given, skip=group.skip, clusters=group.clusters)
        passing = block(taken.directions, **scales(1.0))
        if taken.narrow is not None:
            directions, places, scale = taken.narrow
            passing = put_narrow(passing, block(directions, **scales(scale)), places)
        return Seen(passing if past_own is None else multiply_transmittances(past_own, passing), past_own)

    def _scales(self, scale: float) -> dict[str, Any]:
        """Settings in radii of cells, of radii that are so much smaller."""
        return {"softness": scale * self.visibility.softness, "merging": scale * self.visibility.merging}

    @functools.cached_property
    def blocking_flats(self) -> tuple[int, ...]:
        """Those of the scene."""
        return blocking_planes(self.assembly.scene)

    def past_flats(self, group: Group, seen: Seen, taken: Cells) -> Seen:
        """Transmittance past the flat bodies around a group, too."""
        flats, past_solid = group.flats, seen.past_all
        if flats is None or past_solid is None or not group.points.size:
            return seen
        facing = group.normals if group.kept_rows is None else None
        points, fronts = group.among(flats.frames, flats.flats, flats.skip)
        cover = functools.partial(
            flat_coverage, points, flats.frames, flats.flats, facing=facing, fronts=fronts, skip=flats.skip
        )
        covered = cover(taken.directions)
        if covered is None:
            return seen
        if taken.narrow is not None:
            directions, places, scale = taken.narrow
            # a plane has its own edges: they need no room for the rest of a cell, as spheres do not
            narrow = cover(directions, radius=self.visibility.softness * scale * cell_radius(len(directions)))
            assert narrow is not None
            covered = put_narrow(covered, narrow, places)
        return seen._replace(past_all=past_coverage(past_solid, covered), past_solid=past_solid)

    def _past_own(self, group: Group, taken: Cells) -> wp.array | None:
        """Transmittance past the body of the receivers: looked up, and of a sun by rays where these are asked for."""
        if group.own_shadow is None or not group.points.size:
            return None
        assert group.places is not None and isinstance(group.own_shadow, OwnLookup)
        rows, lookup, supports, rays = group.own_shadow
        past_own = gather_own(group.normals, group.places, lookup, supports, rows)
        if rays is None or taken.sun is None:
            return past_own
        if past_own.requires_grad:
            raise ValueError(
                'self_shadows: got "rays" where a pose or a camera has a gradient, which rays under a sun do not '
                'have, expected "traced" or "spheres"'
            )
        assert group.body is not None
        of_sun = trace_sun_cells(rays[0], group.places, rays[1], group.body, taken.sun)
        return put_narrow(past_own, of_sun, taken.sun.places)

    def transfer(self, seen: Seen, group: Group, taken: Cells) -> wp.array:
        """Transfer vectors; the transmittance as it is where kept cells hold known light."""
        assert seen.past_all is not None
        if group.kept_rows is None:
            return directional_transfer(seen.past_all, group.normals, taken.directions)
        return seen.past_all if _has_light(group.kept_rows) else cell_transfer(seen.past_all, group.kept_rows)

    def light_part(self, transfer: wp.array, group: Group, taken: Cells) -> wp.array:
        """Shading of a part, vec3 of shape [batch, receiver]."""
        if group.kept_rows is not None and _has_light(group.kept_rows):
            return light_cells(transfer, group.kept_rows)
        return super().light_part(transfer, group, taken)

    def light_seen(self, seen: Seen, group: Group, taken: Cells) -> wp.array:
        """Shading of a group in known light."""
        if group.kept_rows is not None:
            return self.light_part(self.transfer(seen, group, taken), group, taken)
        assert seen.past_all is not None and taken.coefficients is not None
        given = seen.past_all, group.normals, taken.directions, taken.coefficients
        return shade_cells(*given, most=LARGEST_COEFFICIENT)

    @functools.cached_property
    def _sharpest(self) -> tuple[np.ndarray, wp.array, float, wp.array]:
        """Cells of the scene's light whose shadows are sharpest: narrow ones, or else the brightest.

        Returns:
            Directions [16, 3], their light in channel 0, with which 16 cells are lit as all are, their radius in radii
            of 16 cells, and the light of all cells [direction].
        """
        with unrecorded():
            taken = self.taken_from(self.light.value())
        assert taken.coefficients is not None
        power = taken.coefficients.numpy()[0] @ LUMINANCE
        directions, light = np.empty((CHUNK, 3)), np.zeros(CHUNK)
        if taken.narrow is None:
            chosen = np.sort(np.argsort(-power, kind="stable")[:CHUNK])
            directions, light = taken.directions[chosen], power[chosen]
            scale = cell_radius(len(power)) / cell_radius(CHUNK)
        else:
            directions, places, scale = taken.narrow
            light[places[places >= 0]] = power[places >= 0]
        light = light[:, None] * [CHUNK / len(power), 0, 0]
        return directions, wp.array(light[None], dtype=wp.vec3, device=self.assembly.device), scale, power

    def sharp_share(self, group: Group) -> np.ndarray | None:
        """Light of the sharpest cells, over all light if nothing blocked any."""
        directions, light, scale, power = self._sharpest
        points, normals, centers, radii = group[:4]
        if not radii.shape[1] and group.flats is None:
            return None
        if radii.shape[1]:
            passing = directional.transmittance(points, normals, centers, radii, directions, **self._scales(scale))
        else:
            passing = wp.full((*points.shape, CHUNK), 1.0, dtype=wp.float32, device=points.device)
        if group.flats is not None:
            flats, radius = group.flats, scale * cell_radius(CHUNK)
            lifted, fronts = group.among(flats.frames, flats.flats, flats.skip)
            given = lifted, flats.frames, flats.flats, directions
            covered = flat_coverage(*given, radius=radius, facing=normals, fronts=fronts, skip=flats.skip)
            passing = passing if covered is None else past_coverage(passing, covered)
        lit = shade_cells(passing, normals, directions, light, most=LARGEST_COEFFICIENT).numpy()[..., 0]
        facing, towards = normals.numpy(), self.taken_if_free.directions
        along = facing[:, :1]  # of all points of a plane, or the opposite
        whole = [4 / len(power) * np.maximum(sign * along @ towards.T, 0) @ power for sign in (1, -1)]  # [batch, 1]
        unblocked = np.where((facing * along).sum(axis=2) > 0, *whole)
        return np.divide(lit, unblocked, out=np.zeros_like(lit), where=unblocked > 0)

    def kept_rows(self, static: Static, light: Source | None, blocking: Blocking) -> Rows:
        """The light S_q that static bodies let through, [row, 3, direction]; but for the scene's, of 1: [row, 1, …]."""
        is_scenes = light is self.light
        return static.rows("lit cells" if is_scenes else "cells", functools.partial(self._trace, is_scenes))

    def _trace(self, is_scenes: bool, static: Static, vertices: np.ndarray, normals: wp.array) -> wp.array:
        points, facing = static.gathered(vertices, normals)
        numbers = wp.array(split_sides(vertices, len(static.has_vertex))[0], dtype=wp.int32, device=points.device)
        samples = self._lit_samples if is_scenes else self._even_samples
        return trace_cells(static.mesh, points[0], facing[0], numbers, samples, progress=self.progress)

    @functools.cached_property
    def _lit_samples(self) -> CellSamples:
        samples = sample_map(map_of(self.light.value()), self.visibility.samples)
        return cell_samples(samples, self._directions, device=self.assembly.device)

    @functools.cached_property
    def _even_samples(self) -> CellSamples:
        samples = even_samples(self.visibility.samples, self._directions)
        return cell_samples(samples, self._directions, device=self.assembly.device)


def _has_light(kept: KeptRows) -> bool:
    """Whether kept cells have known light, in three channels."""
    return kept.rows.shape[1] == 3
