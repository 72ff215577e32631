"""Lighting: what the receivers of a view send back as white surfaces, in known light or in free one."""

import functools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.assets.basis import Basis, CellBasis, HarmonicBasis, conversion
from warpshadow.assets.light import EnvironmentMap
from warpshadow.device.batch import common_batch, concatenate, expand
from warpshadow.device.constants import constant
from warpshadow.maths import sh
from warpshadow.maths.directions import fibonacci
from warpshadow.pipeline.assembly import Assembly
from warpshadow.pipeline.plan import BlockerFacts, Ledger, LightFacts, LightingPlan, Stage, ViewFacts, plan_lighting
from warpshadow.pipeline.still import CELLS, LIT_CELLS, LOG_SUMS, Still
from warpshadow.pipeline.views import View
from warpshadow.stages.kept_cells import KeptRows, add_rows, cell_transfer, light_cells
from warpshadow.stages.light_samples import sample_map
from warpshadow.stages.ray_tracing import trace_shading, trace_transfer
from warpshadow.stages.shading import shade
from warpshadow.stages.transfer import directional_transfer, sh_transfer
from warpshadow.stages.visibility import directional, exponential, log_sh

KnownLight = EnvironmentMap | np.ndarray
Light = KnownLight | wp.array
"""A map, SH coefficients [order², 3], or free coefficients in the renderer's basis, vec3 [batch, coefficient]."""


PART = 1 << 13
"""Receivers that are lit at once where no gradient is asked for."""

_LARGEST_COEFFICIENT = 1e3 * check.LARGEST
"""Light is larger in another basis than it was given in: 64 harmonics add up in a direction."""


class _Terms(NamedTuple):
    """What light is expressed in while receivers are lit: cells of directions, or bands of spherical harmonics."""

    kept: str  # what there is to keep of bodies that stand still
    directions: np.ndarray | None  # to which cells look, [direction, 3]
    bands: int  # of spherical harmonics
    coefficients: wp.array | None  # of known light, vec3 of shape [1, coefficient]


class _Group(NamedTuple):
    """Receivers that the same spheres block."""

    stage: Stage  # of their visibility
    points: wp.array  # [batch, receiver] vec3
    normals: wp.array  # [batch, receiver] vec3
    centers: wp.array  # [batch, sphere] vec3
    radii: wp.array  # [batch, sphere] float32
    kept: KeptRows | None  # what else blocks them


class Lighting:
    """Lights the receivers of views.

    Args:
        assembly: The scene's bodies.
        basis: What free light is expressed in; None for what the scene's method computes in.
        ledger: Where times are noted.
        progress: Show progress where something takes longer than a second.

    Attributes:
        basis: What free light is expressed in.
    """

    def __init__(self, assembly: Assembly, basis: Basis | None, ledger: Ledger, *, progress: bool = False):
        self._scene = assembly.scene
        self._assembly = assembly
        self._ledger = ledger
        self._progress = progress
        visibility = self._scene.visibility
        is_cellular = visibility.method == "directional"
        self._own_basis: Basis = (
            CellBasis(fibonacci(visibility.directions)) if is_cellular else HarmonicBasis(visibility.order)
        )
        self.basis = self._own_basis if basis is None else basis

    @property
    def is_traced(self) -> bool:
        """Whether rays find what blocks light."""
        return self._scene.visibility.method == "ray-traced"

    def plan(self, facts: ViewFacts, light: Light | None, *, view: View | None, still: Still | None) -> LightingPlan:
        """What it takes to light a view; nothing is computed.

        Args:
            facts: What is known of the view.
            light: None for the scene's.
            view: The view; None before it is made.
            still: What is known of the bodies that stand still among moving ones; None for nothing yet.
        """
        _check_light(light)
        light = self._scene.light if light is None else light
        bands = self._free_bands if isinstance(light, wp.array) else self._known_bands(light)
        light_facts = LightFacts(
            is_kept=view is not None and self._kept_shading(view, light) is not None,
            is_free=isinstance(light, wp.array),
            varies=isinstance(light, wp.array) and light.requires_grad,
            coefficients=bands**2 if isinstance(self._own_basis, HarmonicBasis) else self._own_basis.size,
        )
        counts = self._assembly.sphere_counts
        moves = np.ones(len(counts), bool) if facts.moving is None else np.isin(np.arange(len(counts)), facts.moving)
        missing = facts.still_receivers
        if still is not None:
            missing = still.missing(self._kept_of(light), None if view is None else view.receivers.still)
        blockers = BlockerFacts(
            self._scene.visibility.method,
            spheres=int(counts.sum()),
            moving_spheres=int(counts[moves].sum()),
            casting=len(self._assembly.casting),
            missing=missing,
        )
        return plan_lighting(facts, light_facts, blockers)

    def _kept_shading(self, view: View, light: Light) -> wp.array | None:
        """Shading of a view in known light, if it is kept; a map never changes, coefficients may have."""
        if light is self._scene.light:
            return view.kept.shading
        if view.kept.other_shading is None or isinstance(light, wp.array):
            return None
        known, shading = view.kept.other_shading
        if isinstance(known, np.ndarray) and isinstance(light, np.ndarray):
            return shading if np.array_equal(known, light) else None
        return shading if known is light else None

    # ------------------------------------------------------------------------------------------ shading

    def shade(self, view: View, light: Light | None = None) -> wp.array:
        """Light the receivers of a view, by default in the scene's light: vec3 of shape [batch, receiver]."""
        _check_light(light)
        light = self._scene.light if light is None else light
        if isinstance(light, np.ndarray):
            check.finite("light", light)
        kept = self._kept_shading(view, light)
        if kept is not None:  # as the plan says, which takes longer to make than all else here
            return kept
        plan = self._plan_of(view, light)
        if isinstance(light, wp.array):
            return self._shade_free(plan, view, light)
        shading = self._trace(plan, view, light) if self.is_traced else self._shade_known(plan, view, light)
        if view.keeps and light is self._scene.light:
            view.kept.shading = shading
        elif view.keeps:
            view.kept.other_shading = (light.copy() if isinstance(light, np.ndarray) else light), shading
        return shading

    def _plan_of(self, view: View, light: Light) -> LightingPlan:
        return self.plan(view.facts, light, view=view, still=view.still)

    def _shade_free(self, plan: LightingPlan, view: View, light: wp.array) -> wp.array:
        most = check.LARGEST
        if not view.varying:
            transfers = self._kept_transfers(plan, view)
        elif self.is_traced:
            raise ValueError("light: got free light for moving geometry, which rays cannot shade; expected known light")
        else:
            terms = self._free_terms
            transfers = self._transfers(plan, self._groups(plan, view, terms), terms)
            if self._own_from_basis is not None:
                light = shade(constant(self._own_from_basis[None], wp.float32, light.device), light)
                most = _LARGEST_COEFFICIENT
        with self._ledger.timed(plan.shading, [*transfers, light]):
            return _joined([shade(transfer, light, most=most) for transfer in transfers])

    def _shade_known(self, plan: LightingPlan, view: View, light: KnownLight) -> wp.array:
        terms = self._scene_terms if light is self._scene.light else self._known_terms(light)
        groups = self._groups(plan, view, terms)
        if any(array.requires_grad for group in groups for array in group[1:5]):
            transfers = self._transfers(plan, groups, terms)
            with self._ledger.timed(plan.shading, transfers):
                pairs = zip(groups, transfers, strict=True)
                return _joined([_lit(group, transfer, terms) for group, transfer in pairs])
        shadings = []
        self._ledger.forget([*(group.stage for group in groups), plan.transfer, plan.shading])
        for part in self._parts(groups):  # transfer vectors of all at once would fill the memory
            (transfer,) = self._transfers(plan, [part], terms, continues=True)
            with self._ledger.timed(plan.shading, continues=True):
                shadings.append(_lit(part, transfer, terms))
        return _joined(shadings)

    def _parts(self, groups: list[_Group]) -> Iterator[_Group]:
        """Cut groups into parts of at most PART receivers, with a progress bar over them; those with kept rows stay."""
        from tqdm import tqdm

        total = sum(group.points.shape[1] for group in groups)
        with tqdm(total=total, desc="shading", unit="receiver", delay=1, disable=not self._progress) as bar:
            for group in groups:
                count = group.points.shape[1]
                size = PART if group.kept is None and count else max(count, 1)
                for start in range(0, max(count, 1), size):
                    end = min(start + size, count)
                    is_whole = end - start == count
                    points, normals = (a if is_whole else a[:, start:end].contiguous() for a in group[1:3])
                    yield group._replace(points=points, normals=normals)
                    bar.update(end - start)

    # ------------------------------------------------------------------------------------------ terms

    @functools.cached_property
    def _scene_terms(self) -> _Terms:
        return self._known_terms(self._scene.light)

    @functools.cached_property
    def _free_terms(self) -> _Terms:
        """What the method expresses free light in."""
        kept = CELLS if isinstance(self._own_basis, CellBasis) else LOG_SUMS
        return _Terms(kept, None, self._free_bands, None)

    def _known_terms(self, light: KnownLight) -> _Terms:
        """What the method expresses known light in, and the light in it."""
        own, bands = self._own_basis, self._known_bands(light)
        if isinstance(own, CellBasis) and isinstance(light, EnvironmentMap):
            # a cell looks to where its light comes from: a sun is rarely in the middle
            coefficients, directions, _ = light.cells(own.directions)
        else:
            coefficients, directions = own.coefficients(light), None
        if isinstance(own, HarmonicBasis):
            coefficients = coefficients[: bands**2]
        return _Terms(self._kept_of(light), directions, bands, self._array(coefficients[None], wp.vec3))

    def _kept_of(self, light: Light) -> str:
        """What there is to keep of bodies that stand still: the scene's light does, too."""
        if not isinstance(self._own_basis, CellBasis):
            return LOG_SUMS
        return LIT_CELLS if light is self._scene.light else CELLS

    @property
    def _free_bands(self) -> int:
        """Bands of spherical harmonics that free light needs, of those that the method has."""
        order = self._scene.visibility.order
        return min(order, self.basis.order) if isinstance(self.basis, HarmonicBasis) else order

    def _known_bands(self, light: KnownLight) -> int:
        """The same for known light."""
        order = self._scene.visibility.order
        return order if isinstance(light, EnvironmentMap) else min(order, sh.order_of("light", light))

    @functools.cached_property
    def _own_from_basis(self) -> np.ndarray | None:
        """What takes free light to what the method computes in; None where it is that, or bands of it."""
        own = self._own_basis
        if isinstance(own, HarmonicBasis) and isinstance(self.basis, HarmonicBasis) and self.basis.order <= own.order:
            return None
        return conversion(self.basis, own)

    # ------------------------------------------------------------------------------------------ transfer

    def transfer(self, view: View) -> wp.array:
        """Transfer vectors of a view that stands to :attr:`basis`, float32 of shape [batch, receiver, coefficient].

        Those of receivers on bodies that stand still among moving ones are left out.
        """
        any_light = wp.empty((1, self.basis.size), dtype=wp.vec3, device=self._assembly.device)
        return self._kept_transfers(self._plan_of(view, any_light), view)[-1]

    def _kept_transfers(self, plan: LightingPlan, view: View) -> list[wp.array]:
        """Transfer vectors of a view's groups of receivers to the basis, computed once."""
        if not plan.transfer:
            assert view.kept.transfer is not None
            return view.kept.transfer
        if self.is_traced:
            transfers = [self._trace_transfer(plan, view)]
        else:
            terms, matrix = self._free_terms, self._own_from_basis
            transfers = self._transfers(plan, self._groups(plan, view, terms), terms)
            if matrix is not None:
                transfers = [self._array(own.numpy() @ matrix, wp.float32) for own in transfers]
        if view.keeps:
            view.kept.transfer = transfers
        return transfers

    def _groups(self, plan: LightingPlan, view: View, terms: _Terms) -> list[_Group]:
        """A view's receivers: those on bodies that stand still among moving ones, then the others."""
        receivers, geometry, still = view.receivers, view.geometry, view.still
        others = _Group(plan.visibility, receivers.points, receivers.normals, geometry.centers, geometry.radii, None)
        if still is None or not len(receivers.still):
            return [others]
        visibility, kept = self._scene.visibility, None
        if still.blocks:
            with self._ledger.timed(plan.still_shadows):
                if terms.kept == LOG_SUMS:
                    kept = still.log_sums(
                        receivers.still, order=visibility.order, log=visibility.log, merging=visibility.merging
                    )
                else:
                    light = self._scene.light if terms.kept == LIT_CELLS else None
                    kept = still.cells(receivers.still, light, self._own_directions, visibility.samples)
        points, normals = still.receivers(receivers.still)
        on_still = _Group(plan.still_visibility, points, normals, *still.moving_spheres(geometry), kept)
        return [on_still, others] if receivers.points.shape[1] else [on_still]

    def _transfers(
        self, plan: LightingPlan, groups: list[_Group], terms: _Terms, *, continues: bool = False
    ) -> list[wp.array]:
        """Transfer vectors of groups in some terms; where kept cells hold the light, transmittance of moving bodies."""
        groups = [_in_step(group) for group in groups]
        seen = []
        for group in groups:
            with self._ledger.timed(group.stage, group[1:5], continues=continues):
                seen.append(self._visibility(group, terms))
        with self._ledger.timed(plan.transfer, [*seen, *(group.normals for group in groups)], continues=continues):
            return [self._transfer(group, part, terms) for group, part in zip(groups, seen, strict=True)]

    def _visibility(self, group: _Group, terms: _Terms) -> wp.array | None:
        """What a group's spheres let pass; None for all of it in spherical harmonics."""
        stage, points, normals, centers, radii, kept = group
        visibility = self._scene.visibility
        if terms.kept != LOG_SUMS:
            directions = self._own_directions if terms.directions is None else terms.directions
            if not stage:
                shape = *points.shape, len(directions)
                return wp.full(shape, 1.0, dtype=wp.float32, device=points.device)
            softness, merging = visibility.softness, visibility.merging
            # what is kept has light of cells whose middles are below the horizon
            facing = normals if kept is None else None
            return directional.transmittance(
                points, facing, centers, radii, directions, softness=softness, merging=merging
            )
        if not stage:
            return None
        if radii.shape[1]:
            order, kind, merging = visibility.order, visibility.log, visibility.merging
            log = log_sh.accumulate(points, normals, centers, radii, order=order, log=kind, merging=merging)
        else:
            log = wp.zeros((*points.shape, visibility.order**2), dtype=wp.float32, device=points.device)
        if kept is not None:
            add_rows(kept, log)
        return exponential.exponentiate(log, base=visibility.base)

    def _transfer(self, group: _Group, seen: wp.array | None, terms: _Terms) -> wp.array:
        if terms.kept == LOG_SUMS:
            return sh_transfer(seen, group.normals, order=self._scene.visibility.order, bands=terms.bands)
        assert seen is not None
        if group.kept is None:
            directions = self._own_directions if terms.directions is None else terms.directions
            return directional_transfer(seen, group.normals, directions)
        return seen if terms.kept == LIT_CELLS else cell_transfer(seen, group.kept)

    @functools.cached_property
    def _own_directions(self) -> np.ndarray:
        assert isinstance(self._own_basis, CellBasis)
        return self._own_basis.directions

    # ------------------------------------------------------------------------------------------ rays

    def _trace_transfer(self, plan: LightingPlan, view: View) -> wp.array:
        points, normals, *_ = view.receivers
        transfer = wp.empty((*points.shape, self.basis.size), dtype=wp.float32, device=points.device)
        with self._ledger.timed(plan.visibility or plan.transfer):
            for instance, mesh in enumerate(self._ray_meshes(view)):
                traced = trace_transfer(
                    mesh,
                    points[instance],
                    normals[instance],
                    self.basis.functions,
                    self._scene.visibility.samples,
                    progress=self._progress,
                )
                wp.copy(transfer[instance], traced)
        return transfer

    def _trace(self, plan: LightingPlan, view: View, light: KnownLight) -> wp.array:
        points, normals, *_ = view.receivers
        if points.requires_grad:
            raise ValueError(
                "geometry: got arrays that require a gradient, which rays do not have; expected none, or another method"
            )
        radiance = light.radiance if isinstance(light, EnvironmentMap) else sh.reconstruct_map(light, 64)
        count = max(1, self._scene.visibility.samples // self._scene.supersampling**2)
        samples = sample_map(radiance, count)
        traced = wp.empty(points.shape, dtype=wp.vec3, device=points.device)
        with self._ledger.timed(plan.visibility or plan.shading):
            for instance, mesh in enumerate(self._ray_meshes(view)):
                lit = trace_shading(mesh, points[instance], normals[instance], samples, progress=self._progress)
                wp.copy(traced[instance], lit)
        return traced

    def _ray_meshes(self, view: View) -> Iterator[wp.Mesh | None]:
        """What blocks the light of each instance of receivers; None for nothing."""
        points, positions = view.receivers.points, view.geometry.positions
        for instance in range(points.shape[0] if points.size else 0):
            if instance < positions.shape[0]:
                mesh = self._assembly.casting_mesh(positions[instance])
            yield mesh

    def _array(self, values: np.ndarray, dtype: type) -> wp.array:
        return wp.array(values, dtype=dtype, device=self._assembly.device)


def _check_light(light: object) -> None:
    """Raise ValueError for what is no light, or None."""
    expected = (
        "an EnvironmentMap, as EnvironmentMap.read(path) reads it, known SH coefficients as an array [order², 3], or "
        "free coefficients in renderer.basis as a tensor"
    )
    check.instance("light", light, (EnvironmentMap, np.ndarray, wp.array, type(None)), expected)
    if isinstance(light, np.ndarray):
        check.shape("light", light.shape, ("order²", 3))


def _lit(group: _Group, transfer: wp.array, terms: _Terms) -> wp.array:
    """Shading of a group in known light."""
    if terms.kept == LIT_CELLS and group.kept is not None:
        return light_cells(transfer, group.kept)
    return shade(transfer, terms.coefficients, most=_LARGEST_COEFFICIENT)


def _in_step(group: _Group) -> _Group:
    """A group whose arrays have the same instances; without spheres nothing has to."""
    stage, points, normals, centers, radii, kept = group
    if not radii.shape[1]:
        return group
    count = common_batch({"points": points, "centers": centers, "radii": radii})
    points, normals, centers, radii = (expand(array, count) for array in (points, normals, centers, radii))
    return _Group(stage, points, normals, centers, radii, kept)


def _joined(parts: list[wp.array]) -> wp.array:
    """Receivers of groups one after another, of shape [batch, receiver]."""
    return parts[0] if len(parts) == 1 else concatenate(parts, [part.shape[1] for part in parts])
