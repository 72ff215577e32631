"""The directional method: transmittance past blockers for cells of directions, lit by the light of each cell."""

import functools
from typing import Any

import numpy as np
import warp as wp

from warpshadow.assets.basis import Basis, CellBasis
from warpshadow.assets.known_light import KnownLight
from warpshadow.device.memory import empty, from_numpy
from warpshadow.device.tape import unrecorded
from warpshadow.maths.directions import cell_radius, fibonacci
from warpshadow.pipeline.bodies.blockers import BlockerKinds
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.bodies.self_visibility import SelfVisibilityLookup
from warpshadow.pipeline.methods.cell_lobes import CellLobes
from warpshadow.pipeline.methods.glossy_cells import shading_with_cells_node
from warpshadow.pipeline.methods.sharpest_cells import SharpestCells, find_share_of_sharpest_light, find_sharpest_cells
from warpshadow.pipeline.node import Input, Node, field_of
from warpshadow.pipeline.receivers.groups import CoveringBlockers, Group, GroupConvexParts, GroupSpheres
from warpshadow.pipeline.receivers.shading_context import ShadingContext
from warpshadow.pipeline.receivers.static import StaticBodies, VertexRows
from warpshadow.pipeline.shading.found_visibility import CellCoverages, CellVisibility
from warpshadow.pipeline.shading.light_input import LightInput
from warpshadow.pipeline.shading.projected_cells import ProjectedCells, project_on_cells
from warpshadow.pipeline.shading.scene_blockers import SceneBlockers
from warpshadow.pipeline.shading.shell_cells import SHELL_BASIS, ShellCells, project_on_shell
from warpshadow.pipeline.shading.sphere_method import SphereMethod
from warpshadow.pipeline.shading.transfers import LARGEST_COEFFICIENT
from warpshadow.scene.blockers import blocking_planes
from warpshadow.stages.joint_coverage import transmittance_past
from warpshadow.stages.light.cached_cells import CachedRows, cell_transfer, shade_cached_cells
from warpshadow.stages.light.light_samples import CellSamples, cell_samples, even_samples, sample_map
from warpshadow.stages.light.shading import shade_cells
from warpshadow.stages.light.transfer import directional_transfer
from warpshadow.stages.raster.sides import split_sides
from warpshadow.stages.rays.ray_tracing import trace_cells
from warpshadow.stages.self_visibility.gather import multiply_transmittances
from warpshadow.stages.self_visibility.sun_cells import trace_sun_cells
from warpshadow.stages.visibility.directional import SOFTNESS
from warpshadow.stages.visibility.sharp_cells import RADII_PER_HALF_ANGLE, SharpCells, blend_sharp_cells


class Directional(SphereMethod[ProjectedCells, CellVisibility]):
    """Visibility for each cell of directions by itself."""

    shades_without_transfer = True

    def __init__(self, merged_scene: MergedScene, basis: Basis | None, *, progress: bool = False):
        self._directions = fibonacci(merged_scene.scene.direction_count)
        is_near = merged_scene.scene.shell is not None
        native_basis = SHELL_BASIS if is_near else CellBasis(self._directions)
        super().__init__(merged_scene, native_basis, basis, progress=progress)
        self.edges_as_wide_as_footprints = not is_near
        self.free_basis = ProjectedCells(
            self._directions, shell_cells=None if self.shell is None else ShellCells(self.shell)
        )

    def project_light(self, light: KnownLight, shell: wp.array | None = None) -> ProjectedCells:
        """Cells that look to where their light comes from: a sun is rarely in the middle of one.

        From a shell light comes to each receiver from other directions: cells are even.
        """
        if shell is not None:
            shell_cells, radiance = project_on_shell(light, shell)
            return self.free_basis._replace(shell_cells=shell_cells, coefficients=radiance)
        blockers = self.scene_blockers
        return project_on_cells(
            light,
            self._directions,
            softness=self.visibility.softness,
            has_planes=bool(blockers.plane_bodies),
            wants_sun=blockers.self_visibility.wants_rays,
            device=self.merged_scene.device,
        )

    def free_basis_of_shell(self, shell: wp.array) -> ProjectedCells:
        """The basis of free light of another shell than the scene's. Differentiable: shell."""
        return self.free_basis._replace(shell_cells=ShellCells(shell))

    def coefficient_count(self, light: Input | None) -> int:
        """Number of coefficients that take part: all."""
        return self.native_basis.size

    def self_lookups(
        self, bodies: tuple[int, ...], rotations: wp.array, projected_light: ProjectedCells
    ) -> dict[int, SelfVisibilityLookup]:
        """Lookups of the receivers of some bodies. Differentiable: rotations."""
        directions = projected_light.blocking_directions if projected_light.spots is None else projected_light.spots
        has_sun = projected_light.sun is not None
        lookups = self.scene_blockers.self_visibility.lookups
        return lookups(bodies, rotations, directions, projected_light.half_angles, has_sun=has_sun)

    def find_visibility(self, group: Group, projected_light: ProjectedCells) -> CellVisibility:
        """Transmittance of a group past its own body, spheres and convex parts."""
        directions, blockers = projected_light.blocking_directions, group.blockers
        transmittance_self = self._transmittance_self(group, projected_light)
        past_spheres = transmittance_self
        if blockers.spheres is not None:
            factor = self._past_spheres(blockers.spheres, group, projected_light)
            past_spheres = factor if past_spheres is None else multiply_transmittances(past_spheres, factor)
        parts = blockers.convex_parts and self._coverages(blockers.convex_parts, group, projected_light)
        visibility = CellVisibility(
            directions, None, transmittance_self, transmittance_self_and_spheres=past_spheres, part_coverages=parts
        )
        # planes multiply their share in later; only bounces need the product without them, too
        if blockers.planes is not None and not self.merged_scene.scene.bounces:
            return visibility
        total = past_spheres if parts is None else self._past_coverages(past_spheres, parts, None, projected_light)
        if total is None:
            total = empty((*group.points.shape, len(directions)), dtype=wp.float32, device=group.points.device)
            total.fill_(1.0)
        return visibility._replace(transmittance_total=total)

    def _coverages(self, kind: CoveringBlockers, group: Group, projected_light: ProjectedCells) -> CellCoverages:
        """Coverage of all cells and of sharp ones by blockers of a kind."""
        coverage = kind.coverage(group, projected_light.blocking_directions)
        sharp_cells = projected_light.sharp_cells_past_planes
        if sharp_cells is None:
            return CellCoverages(coverage)
        return CellCoverages(coverage, kind.coverage(group, sharp_cells.directions, self._edge_radius(sharp_cells)))

    def _past_coverages(
        self,
        transmittance: wp.array | None,
        coverages: CellCoverages,
        others: CellCoverages | None,
        projected_light: ProjectedCells,
    ) -> wp.array:
        """Transmittance past blockers that cover cells, and others that may cover the same parts of them."""
        other_coverages = (None, None) if others is None else others
        sharp_cells = projected_light.sharp_cells_past_planes
        if sharp_cells is None or coverages.sharp_cells is None:
            return transmittance_past(transmittance, coverages.all_cells, other_coverages[0])
        blended = blend_sharp_cells(
            transmittance_past(None, coverages.all_cells, other_coverages[0]),
            transmittance_past(None, coverages.sharp_cells, other_coverages[1]),
            sharp_cells.slots,
            projected_light.spot_shares,
        )
        return blended if transmittance is None else multiply_transmittances(transmittance, blended)

    def _edge_radius(self, sharp_cells: SharpCells) -> float:
        """Radius of the disc by which planes and convex parts cover sharp cells [rad]: the sun's, for κ = 0.35."""
        softness = self.visibility.softness / SOFTNESS
        return softness * sharp_cells.scale * cell_radius(len(sharp_cells.directions)) / RADII_PER_HALF_ANGLE

    def _past_spheres(self, spheres: GroupSpheres, group: Group, projected_light: ProjectedCells) -> wp.array:
        transmittance = spheres.transmittance(group, projected_light.blocking_directions, **self._scales(1.0))
        if projected_light.sharp_cells is None:
            return transmittance
        directions, slots, scale = projected_light.sharp_cells
        sharp = spheres.transmittance(group, directions, footprints=group.footprints, **self._scales(scale))
        return blend_sharp_cells(transmittance, sharp, slots, projected_light.spot_shares)

    def _scales(self, scale: float) -> dict[str, Any]:
        """Settings in radii of cells, of radii that are so much smaller."""
        return {"softness": scale * self.visibility.softness, "merging": scale * self.visibility.merging}

    @functools.cached_property
    def emitter_cells(self) -> ProjectedCells:
        """Even light in cells that are finer than those of the map: emitters are small."""
        from warpshadow.pipeline.shading.emitted_light import EMITTER_CELLS

        return ProjectedCells(EMITTER_CELLS)

    @functools.cached_property
    def scene_blockers(self) -> SceneBlockers:
        """The blockers that the bodies are: planes, too, and convex parts."""
        planes = blocking_planes(self.merged_scene.scene)
        return SceneBlockers(self.merged_scene, plane_bodies=planes, has_convex_parts=True, progress=self.progress)

    def find_visibility_past_planes(
        self, group: Group, visibility: CellVisibility, projected_light: ProjectedCells
    ) -> CellVisibility:
        """Transmittance past the flat bodies around a group, too."""
        planes, directions, samples = group.blockers.planes, visibility.directions, projected_light.samples
        assert planes is not None
        covered = self._coverages(planes, group, projected_light)
        if samples is not None and planes.blockers.has_holes:
            all_cells = planes.coverage_of_light(group, covered.all_cells, directions, samples)
            covered = covered._replace(all_cells=all_cells)
        total = self._past_coverages(
            visibility.transmittance_self_and_spheres, covered, visibility.part_coverages, projected_light
        )
        return visibility._replace(transmittance_total=total, transmittance_nonplanar=visibility.transmittance_total)

    def _transmittance_self(self, group: Group, projected_light: ProjectedCells) -> wp.array | None:
        """Transmittance past the body of the receivers: by its parts, or looked up, and by rays where asked."""
        lookup = group.blockers.self_blocker
        if isinstance(lookup, GroupConvexParts):
            coverages = self._coverages(lookup, group, projected_light)
            return self._past_coverages(None, coverages, None, projected_light)
        transmittance_self = group.looked_up_transmittance()
        rays = lookup.rays if isinstance(lookup, SelfVisibilityLookup) else None
        if transmittance_self is None or rays is None or projected_light.sun is None:
            return transmittance_self
        if transmittance_self.requires_grad:
            raise ValueError(
                'self_shadows: got "rays" where a pose or a camera has a gradient, which rays under a sun do not '
                'have, expected "traced" or "spheres"'
            )
        assert group.body is not None
        sun_transmittance = trace_sun_cells(rays[0], group.probe_weights, rays[1], group.body, projected_light.sun)
        return blend_sharp_cells(transmittance_self, sun_transmittance, projected_light.sun.slots)

    def find_transfer(self, visibility: CellVisibility, group: Group, projected_light: ProjectedCells) -> wp.array:
        """Transfer vectors; the transmittance as it is where cached cells hold known light."""
        assert visibility.transmittance_total is not None
        if projected_light.shell_cells is not None:
            arguments = group.points, group.normals, visibility.transmittance_total, projected_light.blocking_directions
            return projected_light.shell_cells.find_transfer(*arguments)
        if group.cached_rows is None:
            return directional_transfer(
                visibility.transmittance_total, group.normals, projected_light.cosine_directions
            )
        if _has_light(group.cached_rows):
            return visibility.transmittance_total
        return cell_transfer(visibility.transmittance_total, group.cached_rows)

    def shade_transfer(self, transfer: wp.array, group: Group, projected_light: ProjectedCells) -> wp.array:
        """Shading of a portion, vec3 of shape [batch, receiver]."""
        if group.cached_rows is not None and _has_light(group.cached_rows):
            return shade_cached_cells(transfer, group.cached_rows)
        return super().shade_transfer(transfer, group, projected_light)

    def shade_transmittance(
        self, visibility: CellVisibility, group: Group, projected_light: ProjectedCells
    ) -> wp.array:
        """Shading of a group in known light."""
        if group.cached_rows is not None or projected_light.shell_cells is not None:
            return super().shade_transmittance(visibility, group, projected_light)
        assert visibility.transmittance_total is not None and projected_light.coefficients is not None
        cells = projected_light.cosine_directions, projected_light.coefficients
        return shade_cells(visibility.transmittance_total, group.normals, *cells, maximum=LARGEST_COEFFICIENT)

    @functools.cached_property
    def _sharpest_cells(self) -> SharpestCells:
        """Cells of the scene's light whose shadows are sharpest: sharp cells, or else the brightest."""
        with unrecorded():
            projected_light = self.project_light(self.light.value())
        return find_sharpest_cells(projected_light, self._edge_radius)

    def share_of_sharpest_light(self, group: Group) -> wp.array | None:
        """Share of a group's unblocked light that still comes from the sharpest cells; None where nothing blocks."""
        sharpest = self._sharpest_cells
        cell_directions, scales = self.free_basis.blocking_directions, self._scales(sharpest.relative_radius)
        return find_share_of_sharpest_light(group, sharpest, cell_directions, **scales)

    @functools.cached_property
    def lobes(self) -> CellLobes:
        """Visibility in lobes, between cells."""
        return CellLobes(self, self._directions)

    def known_shading_node(self, context: ShadingContext, light: LightInput) -> Node:
        """Direct known light on points; where no light bounces, with the cells of bodies that shine."""
        if self.merged_scene.scene.bounces or context.materials.roughness is None:
            return super().known_shading_node(context, light)
        return field_of(shading_with_cells_node(self, context, light), "shading")

    def cached_rows(self, static_bodies: StaticBodies, light: Input | None, blocker_kinds: BlockerKinds) -> VertexRows:
        """Rows of the light of each cell that static bodies let through.

        Scene light: [row, 3, cell], premultiplied. Any other: [row, 1, cell], for white light.
        """
        is_scene_light = light is self.light
        return static_bodies.rows(
            "lit cells" if is_scene_light else "cells", functools.partial(self._trace, is_scene_light)
        )

    def _trace(
        self, is_scene_light: bool, static_bodies: StaticBodies, vertices: np.ndarray, normals: wp.array
    ) -> wp.array:
        points, normals = static_bodies.gathered(vertices, normals)
        numbers = split_sides(vertices, len(static_bodies.has_vertex))[0]
        arrays = from_numpy(static_bodies.ray_origins[numbers], dtype=wp.vec3, device=points.device), normals[0]
        merged_scene = self.merged_scene
        of_bodies = numbers - merged_scene.first_vertex[merged_scene.body_of_vertex[numbers]]  # whatever their order
        ids = wp.array(of_bodies, dtype=wp.int32, device=points.device)
        samples = self._lit_samples if is_scene_light else self._even_samples
        return trace_cells(static_bodies.mesh, *arrays, ids, samples, progress=self.progress)

    @functools.cached_property
    def _lit_samples(self) -> CellSamples:
        samples = sample_map(self.light.value().radiance, self.visibility.ray_count)
        return cell_samples(samples, self._directions, device=self.merged_scene.device)

    @functools.cached_property
    def _even_samples(self) -> CellSamples:
        samples = even_samples(self.visibility.ray_count, self._directions)
        return cell_samples(samples, self._directions, device=self.merged_scene.device)


def _has_light(cached: CachedRows) -> bool:
    """Whether cached cells have known light, in three channels."""
    return cached.rows.shape[1] == 3


METHOD = Directional
