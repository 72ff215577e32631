"""The log-SH method: visibility in spherical harmonics, the exponential of a sum of logarithms over the spheres."""

import functools
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warpshadow.assets.basis import Basis, HarmonicBasis
from warpshadow.assets.known_light import KnownLight
from warpshadow.device.batch import expand_rows
from warpshadow.device.constants import constant
from warpshadow.device.memory import zeros
from warpshadow.pipeline.bodies.blockers import BlockerKinds
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.bodies.self_visibility import SelfTransfer
from warpshadow.pipeline.node import Input
from warpshadow.pipeline.receivers.groups import Group
from warpshadow.pipeline.receivers.static import StaticBodies, VertexRows
from warpshadow.pipeline.shading.found_visibility import HarmonicVisibility
from warpshadow.pipeline.shading.shell_cells import ShellCells
from warpshadow.pipeline.shading.sphere_method import SphereMethod
from warpshadow.stages.light.cached_cells import add_rows
from warpshadow.stages.light.transfer import sh_product, sh_transfer
from warpshadow.stages.visibility import exponential, log_sh


class ProjectedBands(NamedTuple):
    """Light in bands of spherical harmonics; of the method "none", derived from this one, also in cells of a shell."""

    bands: int  # 0 of cells of a shell
    coefficients: wp.array | None = None  # of known light, vec3 of shape [1, bands²], or [1, patch]
    shell_cells: ShellCells | None = None  # that send the light, whose coefficients are theirs; None where it is far

    def with_coefficients(self, coefficients: wp.array) -> "ProjectedBands":
        """Light of the same basis."""
        return self._replace(coefficients=coefficients)


class LogSH(SphereMethod[ProjectedBands, HarmonicVisibility]):
    """Visibility of low frequencies. Where no body has spheres there are no shadows."""

    adds_cached_rows = True

    def __init__(self, merged_scene: MergedScene, basis: Basis | None, *, progress: bool = False):
        self._order = order = merged_scene.scene.visibility.order
        super().__init__(merged_scene, HarmonicBasis(order), basis, progress=progress)
        self.free_basis = ProjectedBands(
            min(order, self.basis.order) if isinstance(self.basis, HarmonicBasis) else order
        )

    def project_light(self, light: KnownLight, shell: wp.array | None = None) -> ProjectedBands:
        """The bands that the light has."""
        count = light.bands(self._order)
        coefficients = light.sh(self._order)[None, : count**2]
        return ProjectedBands(count, constant(coefficients, wp.vec3, self.merged_scene.device))

    def coefficient_count(self, light: Input | None) -> int:
        """Number of coefficients that take part."""
        known = None if light is None else light.value()
        if known is None or isinstance(known, wp.array):
            return self.free_basis.bands**2
        return known.bands(self._order) ** 2

    def self_lookups(
        self, bodies: tuple[int, ...], rotations: wp.array, projected_light: ProjectedBands
    ) -> dict[int, SelfTransfer]:
        """Self-transfer of some bodies. Differentiable: rotations."""
        return self.scene_blockers.self_visibility.self_transfer_of(bodies, rotations, self._order)

    def find_visibility(self, group: Group, projected_light: ProjectedBands) -> HarmonicVisibility:
        """Visibility, float32 of shape [batch, receiver, order²]; None where nothing blocks."""
        points, spheres, cached_rows = group.points, group.blockers.spheres, group.cached_rows
        if cached_rows is None and spheres is None:
            return HarmonicVisibility(None)
        if spheres is not None:
            arguments, spans = (points, group.normals, spheres.centers, spheres.radii), group.spans
            log = self._logs(*arguments, body_spans=spans, skips=spheres.skips(spans), clusters=spheres.clusters)
        else:
            log = zeros((*points.shape, self._order**2), dtype=wp.float32, device=points.device)
        if cached_rows is not None:
            add_rows(cached_rows, log)
        return HarmonicVisibility(exponential.exponentiate(log, base=self.visibility.base))

    def find_transfer(self, visibility: HarmonicVisibility, group: Group, projected_light: ProjectedBands) -> wp.array:
        """Transfer vectors, float32 of shape [batch, receiver, bands²]."""
        self_transfer = self._self_transfer(visibility, group, projected_light)
        if self_transfer is None:
            return sh_transfer(visibility.coefficients, group.normals, order=self._order, bands=projected_light.bands)
        if visibility.coefficients is None:
            return self_transfer
        # where cameras share the rotations, but not the receivers
        self_transfer = expand_rows(self_transfer, len(visibility.coefficients))
        return sh_product(visibility.coefficients, self_transfer, order=self._order, bands=projected_light.bands)

    def _self_transfer(
        self, visibility: HarmonicVisibility, group: Group, projected_light: ProjectedBands
    ) -> wp.array | None:
        """Self-transfer of receivers, [batch, receiver, order²]; only the light's bands if nothing blocks.

        None where it is the clamped cosine.
        """
        if group.cached_rows is not None and group.cached_rows.rows.shape[1] == 2:
            assert visibility.coefficients is not None
            shape, device = visibility.coefficients.shape, visibility.coefficients.device
            self_transfer = zeros(shape, dtype=wp.float32, device=device)
            add_rows(group.cached_rows, self_transfer, channel=1)
            return self_transfer
        lookup = group.blockers.self_blocker
        if not isinstance(lookup, SelfTransfer):
            return None
        bands = projected_light.bands if visibility.coefficients is None else self._order
        return lookup.of_receivers(group.probe_weights, order=self._order, bands=bands)

    def cached_rows(self, static_bodies: StaticBodies, light: Input | None, blocker_kinds: BlockerKinds) -> VertexRows:
        """The log-visibility of the static spheres, for any light, [row, 1, order²]; and self-transfer of bodies."""
        if any(body in blocker_kinds.self_traced for body in static_bodies.bodies):
            find = functools.partial(self._accumulate_and_turn, blocker_kinds.self_traced)
            return static_bodies.rows(("log sums and self-transfer", blocker_kinds.self_traced), find)
        return static_bodies.rows("log sums", self._accumulate)

    def _accumulate(self, static_bodies: StaticBodies, vertices: np.ndarray, normals: wp.array) -> wp.array:
        logs = self._logs(*static_bodies.gathered(vertices, normals), *static_bodies.spheres)
        return logs.reshape((len(vertices), 1, self._order**2))

    def _accumulate_and_turn(
        self, traced: tuple[int, ...], static_bodies: StaticBodies, vertices: np.ndarray, normals: wp.array
    ) -> wp.array:
        """Log sums of the spheres of other bodies, and self-transfer, [vertex, 2, order²]."""
        assert static_bodies.rotations is not None
        body_of_vertex, device = self.merged_scene.body_of_vertex, self.merged_scene.device
        rows = np.empty((len(vertices), 2, self._order**2), np.float32)
        bodies = body_of_vertex[vertices % len(body_of_vertex)]
        traced_bodies = tuple(np.intersect1d(traced, bodies).tolist())
        self_visibility = self.scene_blockers.self_visibility
        self_transfer_of_bodies = self_visibility.self_transfer_of(traced_bodies, static_bodies.rotations, self._order)
        for body in np.unique(bodies).tolist():
            chosen_rows = np.flatnonzero(bodies == body)
            arguments = static_bodies.gathered(vertices[chosen_rows], normals)
            others = [other for other in static_bodies.bodies if not (other == body and body in traced)]
            rows[chosen_rows, 0] = self._logs(*arguments, *static_bodies.spheres_of(others)).numpy()[0]
            if body in self_transfer_of_bodies:
                weights = self_visibility.probe_weights_of(body, vertices[chosen_rows])
                result = self_transfer_of_bodies[body].of_receivers(weights, order=self._order)
            else:
                result = sh_transfer(None, arguments[1], order=self._order)
            rows[chosen_rows, 1] = result.numpy()[0]
        return wp.array(rows, dtype=wp.float32, device=device)

    def _logs(
        self, points: wp.array, normals: wp.array, centers: wp.array, radii: wp.array, **options: Any
    ) -> wp.array:
        log, merging = self.visibility.log, self.visibility.merging
        arguments = points, normals, centers, radii
        return log_sh.accumulate(*arguments, order=self._order, log=log, merging=merging, **options)


METHOD = LogSH
