"""Bounces between static patches: rays once for a geometry, then small matrices for each light and reflectance.

Rays find the form factors F from patches to patch samples, the points at which patches are lit, and to receivers, once.
With direct shading S and albedo a an iteration finds the radiosity of patches after n − 1 bounces, or after all,

    B = a (M S + M F B),  M the mean over patch samples outside of other bodies,        starting from B = a M S,

and receivers gather F B. Light that a body sends to itself may go on for longer than that. Receivers of an image are
many: F is found at some of them, and interpolated.

Two methods say how open a point is: spheres, past which its direct light comes, leave the share s of the hemisphere
open; rays, which find F, hit bodies in the share f. As s + f need not be 1, F of a point is scaled by (1 − s) / f.
Otherwise light is gained and lost: eighteen white balls in a white furnace were 0.91 to 1.06 bright.

Points inside another body see its inside; they count neither in means over patch samples nor as cache points. Where all
patch samples of a patch are inside, a part of the patch between them may be seen: it has the light of the nearest patch
of its body.

The radiosity is linear in light: of free light among bodies whose colors are known all of it is one matrix, which is
cached. Differentiable in light and albedo.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import warp as wp

from warpshadow.maths.inset import inset_vertices
from warpshadow.pipeline.bodies.reflectance import Materials
from warpshadow.pipeline.bounces.patches import ScenePatches, Senders, lit_patch_samples
from warpshadow.pipeline.bounces.repeated import SELF_BOUNCES, after_bounces
from warpshadow.pipeline.node import Input, Node, field_of
from warpshadow.pipeline.receivers.lit_points import LitPoints, receiver_text
from warpshadow.pipeline.shading.method import Method
from warpshadow.stages.bounces.bright_patches import BrightPatches, find_bright_patches
from warpshadow.stages.bounces.colored import ColoredTransfer, colored_light
from warpshadow.stages.bounces.form_factors import (
    BLACK_ENTRIES,
    PatchFormFactors,
    loose_mesh,
    mean_outside,
    scale_rows,
    scale_to_sky,
    scaling_factors,
    trace_form_factors,
)
from warpshadow.stages.bounces.irradiance_cache import choose_cache_points, interpolation_matrix
from warpshadow.stages.bounces.radiosity import reflect
from warpshadow.stages.receivers.find import Receivers
from warpshadow.stages.sparse import SparseMatrix, multiply

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix


RAYS = 1024  # rays of a cache point or patch sample, which find its form factors …

STILL_RAYS = 256
"""… and those of a still, which has no time to spare: of the table of demos/kinds.py (128²) it has an error of 1.95%
against paths with these, and of 1.93% with 1024, in 3.1 and 7.1 s of CPU time."""

_BRIGHT_PART = 4
"""Rays of a still for each one that it sends to bright patches besides. In a room lit by a bulb in a shade stills are
9.2% off without such rays, 3.0% with 32, 2.3% with 64 and 1.2% with 256."""


class _GeometryFactors(NamedTuple):
    """Cached results of a geometry."""

    patch_sample_means: SparseMatrix  # [patch, patch sample], means over the patch samples that lie in no other body
    within_bodies: SparseMatrix  # [patch, patch] of the same body, means over the patch samples of the first
    between_bodies: SparseMatrix  # [patch, patch] of different ones, likewise
    to_cache_points: SparseMatrix  # [cache point, patch], those of each view after one another
    receiver_weights: SparseMatrix  # [receiver, cache point]
    openness: wp.array  # part of receivers' hemispheres that no blocker takes, by the same rays, vec3 [view, receiver]
    shape: tuple[int, int]  # views, receivers of each

    def to_receivers(self, direct: wp.array, bounced: wp.array) -> wp.array:
        """Add bounced light of cache points to direct shading, vec3 [batch, receiver]. Differentiable: both."""
        if self.shape[0] == 1:
            return multiply(self.receiver_weights, bounced, addend=direct)
        if len(bounced) > 1:
            raise ValueError(
                f"light, albedo, textures: got a batch of {len(bounced)} for {self.shape[0]} views by "
                'method "ray-traced" with bounces, expected one for them all; method = "directional" takes '
                "batches"
            )
        return multiply(self.receiver_weights, bounced, addend=direct.reshape((1, -1))).reshape(self.shape)


class StaticBounces:
    """Light that bounces between bodies whose form factors rays find once.

    Args:
        method: How light is blocked.
        patches: Of the scene.
    """

    def __init__(self, method: Method, patches: ScenePatches):
        self._patches, self._progress, self._openness = patches, method.progress, method.openness
        self._bounces = method.merged_scene.scene.bounces  # 1 or more, or "all" until nothing is left
        self._is_still = method.shares_directions
        self._rays = STILL_RAYS if self._is_still else RAYS

    def patch_samples(self, points: LitPoints, materials: Materials) -> LitPoints:
        """The points of patches that are lit, of one instance."""
        senders = self._patches.senders(materials)
        return points.cached("patch samples", senders, lambda: lit_patch_samples(senders, points))

    def add_bounces(self, direct: Node, at_patch_samples: Node, points: LitPoints, materials: Materials) -> Node:
        """Add bounces to direct shading.

        Args:
            direct: Node of the direct shading of the receivers, vec3 of shape [batch, receiver].
            at_patch_samples: Node of that of :meth:`patch_samples`, vec3 of shape [batch, patch sample].
            points: The receivers.
            materials: Reflectance of the bodies.
        """
        senders = self._patches.senders(materials)
        if not senders.bodies:
            return direct
        factors = self._factors(points, materials, senders, at_patch_samples)
        make = functools.partial(Node, "", _light_on_patches, at_patch_samples, factors)
        light = points.cached("light of patches", at_patch_samples, make)
        return self._shading(direct, light, factors, points, materials)

    def add_free_bounces(
        self, direct: Node, transfers: Node, light: Input, points: LitPoints, materials: Materials
    ) -> Node:
        """Add bounces to the shading of free light; its transfer among the colors of the scene is cached.

        Args:
            direct: As above.
            transfers: Node of the transfer vectors of the patch samples, [1, patch sample, coefficient], in portions.
            light: The coefficients.
            points: The receivers.
            materials: Reflectance of the bodies.
        """
        senders = self._patches.senders(materials)
        if not senders.bodies:
            return direct

        def light_on_patches(portions: list[wp.array], factors: _GeometryFactors) -> wp.array:
            """Light on patches by each coefficient of white light, vec3 of shape [coefficient, patch]."""
            white_light = np.concatenate([portion.numpy()[0] for portion in portions]).T[..., None]
            return _light_on_patches(
                wp.array(np.repeat(white_light, 3, axis=2), dtype=wp.vec3, device=portions[0].device), factors
            )

        factors = self._factors(points, materials, senders)
        arguments = transfers, factors
        lit = points.cached("patches in each coefficient", transfers, lambda: Node("", light_on_patches, *arguments))
        if materials is not points.materials:
            transfer = points.cached("transfer of patches", lit, lambda: Node("", _as_transfer, lit))
            return self._shading(direct, Node("", colored_light, transfer, light), factors, points, materials)

        def bounced() -> Node:
            arguments = self._patches.albedo(materials, senders.bodies), lit, factors
            find = functools.partial(self._light_at_cache_points, senders=senders)
            return Node("transfer of bounces", lambda *arguments: _as_transfer(find(*arguments)), *arguments)

        def shade(direct: wp.array, transfer: ColoredTransfer, light: wp.array, factors: _GeometryFactors) -> wp.array:
            return factors.to_receivers(direct, colored_light(transfer, light))

        transfer = points.cached("bounces", lit, bounced)
        return Node("bounces", shade, direct, transfer, light, factors, items=self._item_text(points, senders))

    def _shading(self, direct: Node, patch_light: Node, factors: Node, points: LitPoints, materials: Materials) -> Node:
        """Shading with bounces, given the direct light on patches, vec3 of shape [batch, patch]."""
        senders = self._patches.senders(materials)

        def bounce(direct: wp.array, albedo: wp.array, patch_light: wp.array, factors: _GeometryFactors) -> wp.array:
            return factors.to_receivers(direct, self._light_at_cache_points(albedo, patch_light, factors, senders))

        albedo = self._patches.albedo(materials, senders.bodies)
        return Node("bounces", bounce, direct, albedo, patch_light, factors, items=self._item_text(points, senders))

    def _light_at_cache_points(
        self, albedo: wp.array, patch_light: wp.array, factors: _GeometryFactors, senders: Senders
    ) -> wp.array:
        """Bounced light at cache points, vec3 of shape [batch, cache point]. Differentiable: albedo, patch_light."""

        def light_of_others(radiosity: wp.array | None) -> wp.array:
            """Light on patches from the sky and from other bodies."""
            return patch_light if radiosity is None else multiply(factors.between_bodies, radiosity, addend=patch_light)

        def reflect_all(by_others: wp.array, radiosity: wp.array | None) -> wp.array:
            return reflect(
                albedo, by_others if radiosity is None else multiply(factors.within_bodies, radiosity, addend=by_others)
            )

        arguments = self._bounces, light_of_others, reflect_all, senders.areas
        return multiply(factors.to_cache_points, after_bounces(*arguments, self_bounces=SELF_BOUNCES))

    def openness(self, points: LitPoints, materials: Materials, at_patch_samples: Node | None) -> Node | None:
        """Part of the hemispheres of points that no blocker takes, by the rays that find the light of blockers.

        Both so vary alike, and blockers' mean radiance does not.

        Args:
            points, materials: As above.
            at_patch_samples: Node of direct shading as above; None in free light.

        Returns:
            Node of vec3 of shape [view, receiver]; None where no body sends light.
        """
        senders = self._patches.senders(materials)
        if not senders.bodies:
            return None
        return field_of(self._factors(points, materials, senders, at_patch_samples), "openness")

    def _item_text(self, points: LitPoints, senders: Senders) -> Callable[[], str]:
        weak_points = points.weak
        return lambda: f"{receiver_text(weak_points)}, {len(senders.areas):,} patches, {self._bounces} bounces"

    def _factors(
        self, points: LitPoints, materials: Materials, senders: Senders, at_patch_samples: Node | None = None
    ) -> Node:
        """Node of the form factors, which are those of any light: that of patch samples tells where rays are sent."""
        if not self._is_still or materials is not points.materials:  # form factors of a fit must not follow its light
            at_patch_samples = None

        def find(
            positions: wp.array,
            patch_samples: Receivers,
            receivers: Receivers,
            sky_at_patch_samples: wp.array | None,
            sky_at_receivers: wp.array | None,
            light: wp.array | None,
            albedo: wp.array | None,
        ) -> _GeometryFactors:
            from scipy.sparse import block_diag, coo_matrix, vstack

            if len(positions) > 1:
                raise ValueError(
                    f'geometry: got a batch of {len(positions)} for method "ray-traced" with bounces and free light or '
                    'given reflectance, expected one; method = "directional" takes batches'
                )
            mesh, of_faces = self._mesh(positions.numpy()[0], senders)
            bright = None
            if light is not None and albedo is not None:
                bright = self._bright_patches(light, albedo, mesh, of_faces, senders)
            casts = np.array([body.casts_shadow for body in self._patches.merged_scene.scene.bodies])

            def trace(points: np.ndarray, normals: np.ndarray, sky: np.ndarray | None) -> PatchFormFactors:
                count = len(senders.areas)
                arguments = mesh, of_faces, count + len(BLACK_ENTRIES), points, normals
                form_factors = trace_form_factors(*arguments, rays=self._rays, bright=bright, progress=self._progress)
                return scale_to_sky(
                    form_factors, np.append(casts[senders.body_of_patch], [True] * len(BLACK_ENTRIES)), sky
                )

            def find_cache_points(
                points: np.ndarray, normals: np.ndarray, sky: np.ndarray | None
            ) -> tuple[csr_matrix, csr_matrix, np.ndarray]:
                """Weights of cache points at receivers of a view, their form factors, and openness of receivers."""
                cache_points = choose_cache_points(points)
                form_factors = trace(
                    points[cache_points], normals[cache_points], None if sky is None else sky[cache_points]
                )
                is_cache_point = ~form_factors.is_buried | form_factors.is_buried.all()
                cache_points = cache_points[is_cache_point]
                means = interpolation_matrix(points, normals, cache_points)
                if sky is not None:
                    means = scale_rows(means, scaling_factors(1 - sky, means @ (1 - sky[cache_points])))
                openness = 1 - means @ form_factors.blocked[is_cache_point]
                return means, form_factors.factors[is_cache_point], openness

            receiver_points, receiver_normals = self._ray_origins(receivers, positions), receivers.normals.numpy()
            shape, device = receiver_points.shape[:2], positions.device
            skies = [None if sky is None else sky.numpy()[..., 0] for sky in (sky_at_patch_samples, sky_at_receivers)]
            sky_of_samples = None if skies[0] is None else skies[0][0]
            at_receivers = [None] * shape[0] if skies[1] is None else np.broadcast_to(skies[1], shape)
            seen_by_patch_samples = trace(
                patch_samples.points.numpy()[0], patch_samples.normals.numpy()[0], sky_of_samples
            )
            factors = map(find_cache_points, receiver_points, receiver_normals, at_receivers)
            receiver_weights, to_cache_points, openness = zip(*factors, strict=True)
            means, is_buried = senders.mean.to_scipy(), seen_by_patch_samples.is_buried
            mean = mean_outside(means, is_buried)[senders.nearest_open_patches(means @ ~is_buried > 0)]
            patch_factors = (mean @ seen_by_patch_samples.factors).tocoo()
            is_same_body = np.equal(*(senders.body_of_patch[patches] for patches in patch_factors.coords))
            within_bodies, between_bodies = (
                coo_matrix(
                    (patch_factors.data[which], (patch_factors.row[which], patch_factors.col[which])),
                    patch_factors.shape,
                )
                for which in (is_same_body, ~is_same_body)
            )
            return _GeometryFactors(
                SparseMatrix.from_matrix(mean, device=device),
                SparseMatrix.from_matrix(within_bodies, device=device),
                SparseMatrix.from_matrix(between_bodies, device=device),
                SparseMatrix.from_matrix(vstack(to_cache_points), device=device),
                SparseMatrix.from_matrix(block_diag(receiver_weights), device=device),
                wp.array(np.repeat(np.stack(openness)[..., None], 3, axis=-1), dtype=wp.vec3, device=device),
                shape,
            )

        def make() -> Node:
            patch_samples = self.patch_samples(points, materials)
            skies = [self._openness(item) for item in (patch_samples, points)]
            return Node(
                "form factors",
                find,
                points.vertices,
                patch_samples.receivers_node,
                points.receivers_node,
                *skies,
                at_patch_samples,
                None if at_patch_samples is None else self._patches.albedo(materials, senders.bodies),
                items=lambda: f"{len(senders.sides):,} patch samples × {len(senders.areas):,} patches",
                has_adjoint=False,
            )

        return points.cached("form factors", (senders, at_patch_samples), make)

    def _ray_origins(self, receivers: Receivers, positions: wp.array) -> np.ndarray:
        """Points from which rays of receivers leave, [view, receiver, 3]: where walls meet, within that of a vertex."""
        points, vertices = receivers.points.numpy().copy(), positions.numpy()[0]
        if receivers.receiver_of_vertex is None:  # of points that are given
            return points
        of_sides = receivers.receiver_of_vertex.numpy()
        sides = np.flatnonzero(of_sides >= 0)
        origins = inset_vertices(vertices, self._patches.merged_scene.faces.numpy())
        points[:, of_sides[sides]] = origins[sides % len(vertices)]
        return points

    def _bright_patches(
        self, light: wp.array, albedo: wp.array, mesh: wp.Mesh, of_faces: np.ndarray, senders: Senders
    ) -> BrightPatches:
        """Patches that reflect much direct light, given that of patch samples, vec3 of shape [batch, patch sample]."""
        radiosity = albedo.numpy().mean(axis=0) * (senders.mean.to_scipy() @ light.numpy().mean(axis=0))
        radiosity = np.concatenate([radiosity, np.zeros((len(BLACK_ENTRIES), 3))])
        corners = mesh.points.numpy().reshape(-1, 3, 3).astype(np.float64)
        return find_bright_patches(radiosity, of_faces, corners, rays=self._rays // _BRIGHT_PART, device=mesh.device)

    def _mesh(self, positions: np.ndarray, senders: Senders) -> tuple[wp.Mesh, np.ndarray]:
        """The mesh that rays meet, of the pieces of all bodies, and the patches of the sides of its faces.

        After all patches follow the entries BLACK_ENTRIES, for surfaces that send nothing.
        """
        merged_scene = self._patches.merged_scene
        corners, owners, count = [], [], len(senders.areas)
        for number, body in enumerate(merged_scene.scene.bodies):
            body_positions = positions[merged_scene.first_vertex[number] : merged_scene.first_vertex[number + 1]]
            faces = body.mesh.surface.faces
            if number in senders.bodies:
                sender_index = senders.bodies.index(number)
                patches = senders.patches[sender_index]
                corners.append(patches.pieces.positions(body_positions, faces))
                patch_of_side = np.where(
                    patches.patch_of_pieces < 0, -1, patches.patch_of_pieces + senders.first[sender_index]
                )
            else:
                corners.append(body_positions[faces])
                patch_of_side = np.full((2, len(faces)), -1)
            black_entry = np.array([0, 0 if merged_scene.is_two_sided[number] else 1])
            owners.append(np.where(patch_of_side < 0, count + black_entry[:, None], patch_of_side))
        return loose_mesh(np.concatenate(corners), device=merged_scene.device), np.concatenate(owners, axis=1)


def _light_on_patches(at_patch_samples: wp.array, factors: _GeometryFactors) -> wp.array:
    """Mean light on patches, vec3 of shape [batch, patch], of that at their samples, in which it is differentiable."""
    return multiply(factors.patch_sample_means, at_patch_samples)


def _as_transfer(lit: wp.array) -> ColoredTransfer:
    """The matrix of receivers that are lit by each coefficient alone, vec3 of shape [coefficient, receiver]."""
    return ColoredTransfer.from_lit_receivers(lit.numpy(), device=lit.device)
