"""The log-SH method: visibility in spherical harmonics, the exponential of a sum of logarithms over the spheres."""

from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.assets.basis import Basis, HarmonicBasis
from warpshadow.assets.light import EnvironmentMap
from warpshadow.maths import sh
from warpshadow.pipeline.assembly import Assembly
from warpshadow.pipeline.lighting import Group, KnownLight, Seen, SphereMethod
from warpshadow.pipeline.node import Source
from warpshadow.pipeline.own_shadows import OwnLobes
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
        self.in_free = Bands(min(order, self.basis.order) if isinstance(self.basis, HarmonicBasis) else order)
        self.traces_own = self.visibility.method == "log-sh"
        if not self.traces_own:
            self.why_no_shadows = "the method is to have no shadows"

    def in_known(self, light: KnownLight) -> Bands:
        """The bands that the light has."""
        count = self._band_count(light)
        coefficients = self.own_basis.coefficients(light)[None, : count**2]
        return Bands(count, wp.array(coefficients, dtype=wp.vec3, device=self.assembly.device))

    def _band_count(self, light: KnownLight) -> int:
        return self._order if isinstance(light, EnvironmentMap) else min(self._order, sh.order_of("light", light))

    def coefficient_count(self, light: Source | None) -> int:
        """Number of coefficients that take part."""
        known = None if light is None else light.value()
        if known is None or isinstance(known, wp.array):
            return self.in_free.bands**2
        return self._band_count(known) ** 2

    def own_shadows(self, bodies: tuple[int, ...], rotations: wp.array, light: Bands) -> dict[int, OwnLobes]:
        """The lobes of some bodies, turned. Differentiable: rotations."""
        return self.own.turned_lobes(bodies, rotations, self._order)

    def see(self, group: Group, light: Bands) -> Seen:
        """Visibility, float32 of shape [batch, receiver, order²]; None where nothing blocks."""
        points, _, _, radii, kept = group[:5]
        if not points.size or (kept is None and not radii.shape[1]):
            return Seen(None)
        if radii.shape[1]:
            log = self._logs(*group[:4])
        else:
            log = wp.zeros((*points.shape, self._order**2), dtype=wp.float32, device=points.device)
        if kept is not None:
            add_rows(kept, log)
        return Seen(exponential.exponentiate(log, base=self.visibility.base))

    def transfer(self, seen: Seen, group: Group, light: Bands) -> wp.array:
        """Transfer vectors, float32 of shape [batch, receiver, bands²]."""
        if group.own is not None and group.points.size:
            assert group.places is not None and isinstance(group.own, OwnLobes)
            lobes, turn = group.own
            if seen.through is None:
                return own_lobes(lobes, group.places, turn, order=self._order, bands=light.bands)
            own = own_lobes(lobes, group.places, turn, order=self._order)
            return sh_product(seen.through, own, order=self._order, bands=light.bands)
        return sh_transfer(seen.through, group.normals, order=self._order, bands=light.bands)

    def kept_rows(self, static: Static, light: Source | None) -> Rows:
        """The log-visibility of the static spheres, [row, 1, order²], for any light."""
        return static.rows("log sums", self._accumulate)

    def _accumulate(self, static: Static, vertices: np.ndarray, normals: wp.array) -> wp.array:
        logs = self._logs(*static.gathered(vertices, normals), *static.spheres)
        return logs.reshape((len(vertices), 1, self._order**2))

    def _logs(self, points: wp.array, normals: wp.array, centers: wp.array, radii: wp.array) -> wp.array:
        log, merging = self.visibility.log, self.visibility.merging
        return log_sh.accumulate(points, normals, centers, radii, order=self._order, log=log, merging=merging)
