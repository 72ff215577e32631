"""The log-SH method: visibility in spherical harmonics, the exponential of a sum of logarithms over the spheres."""

import functools
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warpshadow.assets.basis import Basis, HarmonicBasis
from warpshadow.assets.light import EnvironmentMap
from warpshadow.device.batch import expand_rows
from warpshadow.maths import sh
from warpshadow.pipeline.assembly import Assembly
from warpshadow.pipeline.by_spheres import SphereMethod
from warpshadow.pipeline.groups import Group, Seen
from warpshadow.pipeline.lighting import KnownLight
from warpshadow.pipeline.node import Source
from warpshadow.pipeline.own_shadows import Blocking, OwnLobes
from warpshadow.pipeline.static import Rows, Static
from warpshadow.stages.kept_cells import add_rows
from warpshadow.stages.own_shadows.lobes import own_lobes
from warpshadow.stages.transfer import sh_product, sh_transfer
from warpshadow.stages.visibility import exponential, log_sh


class Bands(NamedTuple):
    """Light in bands of spherical harmonics."""

    bands: int
    coefficients: wp.array | None = None  # of known light, vec3 of shape [1, bands²]


class LogSH(SphereMethod):
    """Visibility of low frequencies. Where no body has spheres there are no shadows: so is the method "none"."""

    joins_kept = True

    def __init__(self, assembly: Assembly, basis: Basis | None, *, progress: bool = False):
        self._order = order = assembly.scene.visibility.order
        super().__init__(assembly, HarmonicBasis(order), basis, progress=progress)
        self.taken_if_free = Bands(min(order, self.basis.order) if isinstance(self.basis, HarmonicBasis) else order)
        self.traces_own_shadows = self.visibility.method == "log-sh"
        if not self.traces_own_shadows:
            self.why_no_shadows = "the method is to have no shadows"

    def taken_from(self, light: KnownLight) -> Bands:
        """The bands that the light has."""
        count = self._band_count(light)
        coefficients = self.native_basis.coefficients(light)[None, : count**2]
        return Bands(count, wp.array(coefficients, dtype=wp.vec3, device=self.assembly.device))

    def _band_count(self, light: KnownLight) -> int:
        return self._order if isinstance(light, EnvironmentMap) else min(self._order, sh.order_of("light", light))

    def coefficient_count(self, light: Source | None) -> int:
        """Number of coefficients that take part."""
        known = None if light is None else light.value()
        if known is None or isinstance(known, wp.array):
            return self.taken_if_free.bands**2
        return self._band_count(known) ** 2

    def look_up(self, bodies: tuple[int, ...], rotations: wp.array, taken: Bands) -> dict[int, OwnLobes]:
        """The lobes of some bodies, turned. Differentiable: rotations."""
        return self.own_shadows.turned_lobes(bodies, rotations, self._order)

    def see(self, group: Group, taken: Bands) -> Seen:
        """Visibility, float32 of shape [batch, receiver, order²]; None where nothing blocks."""
        points, _, _, radii, kept_rows = group[:5]
        if not points.size or (kept_rows is None and not radii.shape[1]):
            return Seen(None)
        if radii.shape[1]:
            log = self._logs(*group[:4], skip=group.skip, clusters=group.clusters)
        else:
            log = wp.zeros((*points.shape, self._order**2), dtype=wp.float32, device=points.device)
        if kept_rows is not None:
            add_rows(kept_rows, log)
        return Seen(exponential.exponentiate(log, base=self.visibility.base))

    def transfer(self, seen: Seen, group: Group, taken: Bands) -> wp.array:
        """Transfer vectors, float32 of shape [batch, receiver, bands²]."""
        lobes = self._own_lobes(seen, group, taken)
        if lobes is None:
            return sh_transfer(seen.past_all, group.normals, order=self._order, bands=taken.bands)
        if seen.past_all is None:
            return lobes
        lobes = expand_rows(lobes, len(seen.past_all))  # where cameras share what turns, but not the receivers
        return sh_product(seen.past_all, lobes, order=self._order, bands=taken.bands)

    def _own_lobes(self, seen: Seen, group: Group, taken: Bands) -> wp.array | None:
        """Lobes that receivers' own bodies leave, [batch, receiver, order²]; only the light's bands if nothing blocks.

        None where they are clamped cosines.
        """
        if group.kept_rows is not None and group.kept_rows.rows.shape[1] == 2:
            assert seen.past_all is not None
            lobes = wp.zeros(seen.past_all.shape, dtype=wp.float32, device=seen.past_all.device)
            add_rows(group.kept_rows, lobes, channel=1)
            return lobes
        if group.own_shadow is None or not group.points.size:
            return None
        assert group.places is not None and isinstance(group.own_shadow, OwnLobes)
        bands = taken.bands if seen.past_all is None else self._order
        return own_lobes(group.own_shadow.lobes, group.places, group.own_shadow.turn, order=self._order, bands=bands)

    def kept_rows(self, static: Static, light: Source | None, blocking: Blocking) -> Rows:
        """The log-visibility of the static spheres, for any light, [row, 1, order²]; and lobes, if one has its own."""
        if any(body in blocking.traced for body in static.bodies):
            find = functools.partial(self._accumulate_and_turn, blocking.traced)
            return static.rows(("log sums and lobes", blocking.traced), find)
        return static.rows("log sums", self._accumulate)

    def _accumulate(self, static: Static, vertices: np.ndarray, normals: wp.array) -> wp.array:
        logs = self._logs(*static.gathered(vertices, normals), *static.spheres)
        return logs.reshape((len(vertices), 1, self._order**2))

    def _accumulate_and_turn(
        self, traced: tuple[int, ...], static: Static, vertices: np.ndarray, normals: wp.array
    ) -> wp.array:
        """Log sums of the spheres of other bodies, and lobes, [vertex, 2, order²]."""
        assert static.rotations is not None
        body_of_vertex, device = self.assembly.body_of_vertex, self.assembly.device
        rows = np.empty((len(vertices), 2, self._order**2), np.float32)
        bodies = body_of_vertex[vertices % len(body_of_vertex)]
        named = tuple(np.intersect1d(traced, bodies).tolist())
        turned = self.own_shadows.turned_lobes(named, static.rotations, self._order)
        for body in np.unique(bodies).tolist():
            of_body = np.flatnonzero(bodies == body)
            given = static.gathered(vertices[of_body], normals)
            blocking = [other for other in static.bodies if not (other == body and body in traced)]
            rows[of_body, 0] = self._logs(*given, *static.spheres_of(blocking)).numpy()[0]
            if body in turned:
                lobes, turn = turned[body]
                found = own_lobes(lobes, self.own_shadows.places_of(body, vertices[of_body]), turn, order=self._order)
            else:
                found = sh_transfer(None, given[1], order=self._order)
            rows[of_body, 1] = found.numpy()[0]
        return wp.array(rows, dtype=wp.float32, device=device)

    def _logs(
        self, points: wp.array, normals: wp.array, centers: wp.array, radii: wp.array, **options: Any
    ) -> wp.array:
        log, merging = self.visibility.log, self.visibility.merging
        given = points, normals, centers, radii
        return log_sh.accumulate(*given, order=self._order, log=log, merging=merging, **options)
