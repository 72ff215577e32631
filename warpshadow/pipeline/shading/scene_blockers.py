"""The blockers of a scene: which bodies are planes, or convex parts, or have traced self-visibility, and the rest."""

import functools
import weakref
from collections.abc import Iterable

import numpy as np
import warp as wp

from warpshadow.assets.mesh import Mesh
from warpshadow.device.progress import remark
from warpshadow.maths.convex import is_panel
from warpshadow.pipeline.bodies.blockers import ONLY_SPHERES, BlockerKinds, Blockers
from warpshadow.pipeline.bodies.convex import SceneConvexParts
from warpshadow.pipeline.bodies.geometry import Geometry
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.bodies.scene_planes import BodySides, ScenePlanes
from warpshadow.pipeline.bodies.self_visibility import FREE_SHAPE, SelfVisibility
from warpshadow.pipeline.node import Input
from warpshadow.pipeline.receivers.scene_receivers import SceneReceivers
from warpshadow.pipeline.receivers.shading_context import ShadingContext, receiver_text
from warpshadow.scene.blockers import why_spheres_block

_COSTLY_EDGES = 400
"""Edges of a body's convex parts above which images take twice as long as past spheres, or longer: of sheets with 449
and 475 edges 130 and 151 ms, past 256 spheres 59 and 63, of a vase with 1544 200 and 58, of a bowl with 1684 209 and
60. They are 3.1, 3.2, 3.5 and 4.0% off, past spheres 6.3, 6.2, 4.3 and 7.8% (256² pixels, a thread of an EPYC)."""

_remarked: weakref.WeakSet[Mesh] = weakref.WeakSet()  # meshes whose costs were said


class SceneBlockers:
    """The blockers that the bodies of a scene are, by a method of visibility.

    Args:
        merged_scene: The bodies.
        plane_bodies: Bodies that block as the planes in which they lie, where they are not deformed.
        has_convex_parts: Whether bodies that consist of convex parts block by these.
        traces_self_visibility: Whether bodies' shadows on themselves may come from rays, not spheres.
        progress: Whether to show the progress of rays.
    Attributes:
        scene_planes: The bodies that lie in planes.
        scene_parts: The bodies that consist of convex parts.
        self_visibility: The bodies' shadows on themselves, from rays.
    """

    def __init__(
        self,
        merged_scene: MergedScene,
        *,
        plane_bodies: tuple[int, ...] = (),
        has_convex_parts: bool = False,
        traces_self_visibility: bool = True,
        progress: bool = False,
    ):
        self._merged_scene, self.plane_bodies = merged_scene, plane_bodies
        self._has_convex_parts, self._traces_self_visibility = has_convex_parts, traces_self_visibility
        self._progress = progress
        self.scene_planes, self.scene_parts = ScenePlanes(merged_scene), SceneConvexParts(merged_scene)
        self.self_visibility = SelfVisibility(
            merged_scene, SceneReceivers(merged_scene).at_samples(), progress=progress
        )

    def kinds(self, geometry: Geometry | None, rotations: Input | None) -> BlockerKinds:
        """Choose the kind of blocker that each body of a geometry is; the scene's geometry by default.

        Where light does not bounce, no deformed body is a plane.

        Args:
            rotations: Of its bodies; None where nobody knows on which body a receiver is.
        """
        scene = self._merged_scene.scene
        deformed = () if geometry is None or scene.bounces else geometry.deformed
        plane_bodies = tuple(body for body in self.plane_bodies if body not in deformed)
        if rotations is None or not self._traces_self_visibility:
            return ONLY_SPHERES._replace(plane_bodies=plane_bodies)
        why = tuple(self.self_visibility.why_spheres(body, geometry) for body in range(len(scene.bodies)))
        rigid = tuple(body for body, reason in enumerate(why) if not reason)
        convex = tuple(body for body in rigid if body in self.scene_parts.parts) if self._has_convex_parts else ()
        self._remark_on_costs(convex)
        solids = tuple(body for body in convex if body in self.scene_parts.solids)
        traced = tuple(body for body in rigid if body not in solids)
        bulging_bodies = tuple(body for body, reason in enumerate(why) if reason and self._can_bulge[body])
        return BlockerKinds(traced, rotations, why, plane_bodies, convex, solids, bulging_bodies)

    @functools.cached_property
    def _costly_bodies(self) -> set[int]:
        """Bodies whose convex parts have many edges."""
        edge_counts = {body: sum(len(part.edges) for part in parts) for body, parts in self.scene_parts.parts.items()}
        return {body for body, count in edge_counts.items() if count > _COSTLY_EDGES}

    def _remark_on_costs(self, convex: tuple[int, ...]) -> None:
        """Say once of each mesh that its convex parts take longer than spheres."""
        for number in convex:
            body = self._merged_scene.scene.bodies[number]
            if number in self._costly_bodies and body.mesh not in _remarked:
                _remarked.add(body.mesh)
                words = "blocks light by its convex parts: nearer to its shape than spheres, in twice the time or more"
                remark(f"{body.name!r} {words}; blockers = 256 takes spheres", shows=self._progress)

    @functools.cached_property
    def _can_bulge(self) -> list[bool]:
        """Whether each body is thin, so that its spheres bulge out of it, and its receivers were chosen, not asked for.

        They are at vertices where its spheres block its own light. By pixel, and at vertices, in 64² pixels, arched
        cloth is 39% and 23% too dark, and gradients to its vertices are 80% and 9% off; a table of five boxes 7 and 1%,
        162 and 15%; a wall of four boxes 6 and 1%, 40 and 19%. Images of others are nearer to rays by pixel.
        """
        are_chosen = self._merged_scene.has_chosen_receivers.tolist()
        return [
            is_chosen and body.casts_shadow and not body.is_glossy and body.is_thin
            for is_chosen, body in zip(are_chosen, self._merged_scene.scene.bodies, strict=True)
        ]

    def place_blockers(self, kinds: BlockerKinds, positions: wp.array, spheres: tuple[wp.array, wp.array]) -> Blockers:
        """Place the blockers among bodies, by their vertices and spheres. Differentiable: these."""
        frames = self.scene_planes.frames(kinds.plane_bodies, positions) if kinds.plane_bodies else None
        placed_parts = self.scene_parts.place_parts(kinds.convex, positions) if kinds.convex else None
        body_sides = None
        if kinds.plane_bodies or (self.scene_planes.numbers and self._merged_scene.scene.bounces):
            body_sides = BodySides(self.scene_planes, positions)
        return Blockers(
            self._merged_scene,
            kinds,
            scene_planes=self.scene_planes,
            scene_parts=self.scene_parts,
            self_visibility=self.self_visibility,
            merging=self._merged_scene.scene.visibility.merging,
            positions=positions,
            spheres=spheres,
            frames=frames,
            placed_parts=placed_parts,
            body_sides=body_sides,
        )

    def has_any(self, kinds: BlockerKinds, bodies: Iterable[int] | None = None) -> bool:
        """Whether some bodies, by default all, block light by spheres or convex parts."""
        counts = sum(self._counts(kinds).values())
        return bool(np.sum(counts if bodies is None else counts[list(bodies)]))

    def _counts(self, kinds: BlockerKinds) -> dict[str, np.ndarray]:
        """Number of blockers of each kind but planes by which each body blocks the light of others, shape [body]."""
        spheres = self._merged_scene.sphere_counts.copy()
        spheres[list(kinds.without_spheres)] = 0
        parts = np.zeros_like(spheres)
        for body in kinds.convex:
            parts[body] = len(self.scene_parts.parts[body])
        return {"spheres": spheres, "convex parts": parts}

    def pairs_with(self, context: ShadingContext) -> str:
        """Receivers and the blockers of all kinds but planes around them, in words."""
        counts = self._counts(context.blocker_kinds)

        def blockers(bodies: slice | list[int]) -> str:
            sums = {name: numbers[bodies].sum() for name, numbers in counts.items()}
            counted = [f"{count:,} {name}" for name, count in sums.items() if count or name == "spheres"]
            return f"up to {' and '.join(counted)}"  # some are culled, or merged

        item_text = f"{receiver_text(context, static=False)} × {blockers(slice(None))}"
        if context.static_bodies is None:
            return item_text
        moving = list(context.static_bodies.moving)
        return f"{item_text}, {receiver_text(context, moving=False)} on static bodies × {blockers(moving)}"

    def notes(self, kinds: BlockerKinds) -> list[str]:
        """Describe how each body blocks the light of others, and its own, and why; a line each."""
        return [
            f"Body {number} ({body.name!r}) blocks light {self._kind_in_words(number, kinds)}."
            for number, body in enumerate(self._merged_scene.scene.bodies)
            if body.casts_shadow
        ]

    def _kind_in_words(self, body: int, kinds: BlockerKinds) -> str:
        if body in kinds.plane_bodies:
            return "as a part of a plane: it is flat"
        convex_parts = self.scene_parts.parts[body] if body in kinds.convex else []
        parts = f"as {len(convex_parts)} convex part{'s' * (len(convex_parts) != 1)}"
        is_costly = body in kinds.convex and body in self._costly_bodies
        costs = "; spheres, blockers = 256, take half of the time or less, and are up to twice as far off" * is_costly
        if body in kinds.solids:
            return f"{parts}, its own, too: it consists of them{costs}"
        why = kinds.why_spheres[body] if kinds.why_spheres else "the method looks up no rays"
        of_its_own = f"and its own by {f'spheres: {why}' if why else 'rays, traced once'}"
        if body in kinds.convex:
            has_panels = any(map(is_panel, convex_parts))
            return f"{parts}: it is made of few {'panels' if has_panels else 'of them'}, {of_its_own}{costs}"
        count = int(self._merged_scene.sphere_counts[body])
        spheres = f"as {count} sphere{'s' * (count != 1)}"
        if why == FREE_SHAPE:
            return f"{spheres}, its own, too: {why}"
        return f"{spheres}{why_spheres_block(self._merged_scene.scene, body)}, {of_its_own}"

    def why_none_is_traced(self, kinds: BlockerKinds) -> str:
        """Why no body's shadow on itself is looked up."""
        if not self._traces_self_visibility:
            return "the method takes those of spheres"
        names = [body.name for body in self._merged_scene.scene.bodies]
        whys = {name: why for name, why in zip(names, kinds.why_spheres, strict=False) if why}
        whys |= {names[body]: "its convex parts block its own light" for body in kinds.solids}
        return "; ".join(f"{name}: {why}" for name, why in whys.items()) or "bodies are flat"
