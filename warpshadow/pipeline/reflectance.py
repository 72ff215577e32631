"""Reflectance: what the samples of a view reflect, by albedo of bodies and vertices and by textures."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import concatenate
from warpshadow.device.constants import constant
from warpshadow.device.cuda_graph import is_readable
from warpshadow.pipeline.assembly import Assembly
from warpshadow.pipeline.plan import (
    ALBEDO,
    TEXTURES,
    Ledger,
    ReflectanceFacts,
    ReflectancePlan,
    Stage,
    ViewFacts,
    plan_reflectance,
)
from warpshadow.pipeline.views import Kept, View
from warpshadow.stages.rasterize import interpolate
from warpshadow.stages.textures.footprint import Footprints, find_footprints
from warpshadow.stages.textures.pyramid import Textures, mip_pyramids
from warpshadow.stages.textures.sample import expose_albedo, sample_albedo, seen_texels

Given = Sequence[wp.array | None] | None
"""For each body an array or None for what the scene has; None for all of that."""


class _Materials(NamedTuple):
    """What each body reflects."""

    colors: list[wp.array]  # [batch, 1 or vertex] vec3
    images: list[wp.array | None]  # [batch, height, width] vec3

    @property
    def present(self) -> list[wp.array]:
        """The textures."""
        return [image for image in self.images if image is not None]

    @property
    def sizes(self) -> tuple[tuple[int, int] | None, ...]:
        """Heights and widths of the bodies' textures, None without one."""
        return tuple(None if image is None else image.shape[1:] for image in self.images)


class Reflectance:
    """Finds what the samples of views reflect.

    Args:
        assembly: The scene's bodies.
        ledger: Where times are noted.
    """

    def __init__(self, assembly: Assembly, ledger: Ledger):
        self._assembly = assembly
        self._bodies = assembly.scene.bodies
        self._ledger = ledger
        self._scene_pyramids: Textures | None = None

    @functools.cached_property
    def _scene(self) -> _Materials:
        """Of the scene: vec3 of shape [1, 1] or [1, vertex], and of shape [1, height, width]."""
        colors = [self._array(np.atleast_2d(body.albedo)[None], wp.vec3) for body in self._bodies]
        images = [None if body.texture is None else self._array(body.texture[None], wp.vec3) for body in self._bodies]
        return _Materials(colors, images)

    @functools.cached_property
    def _scene_vertex_albedo(self) -> wp.array:
        return self._join(self._scene.colors)

    # ------------------------------------------------------------------------------------------ plans

    def plan(
        self, view: ViewFacts, albedo: Given, textures: Given, kept: Kept | None, *, exposes: bool
    ) -> ReflectancePlan:
        """What it takes to find what a view's samples reflect; nothing is computed.

        Args:
            view: What is known of the view.
            albedo: As for :meth:`find`.
            textures: As for :meth:`find`.
            kept: What the view keeps; None before it is made.
            exposes: Whether for :meth:`expose`.
        """
        return self._plan(view, self._materials(albedo, textures), kept, exposes)

    def _plan(self, view: ViewFacts, materials: _Materials, kept: Kept | None, exposes: bool) -> ReflectancePlan:
        is_scenes_color = _same(materials.colors, self._scene.colors)
        has_scenes_textures = _same(materials.images, self._scene.images)
        varies = {
            ALBEDO: any(color.requires_grad for color in materials.colors),
            TEXTURES: any(image.requires_grad for image in materials.present),
        }
        given = ReflectanceFacts(
            is_scenes=is_scenes_color and has_scenes_textures,
            keeps_pyramids=has_scenes_textures and self._scene_pyramids is not None,
            texels=sum(image.size for image in materials.present),
            keeps_footprints=kept is not None and materials.sizes in kept.footprints,
            is_flat=kept is not None and kept.footprints.get(materials.sizes, (None, None))[1] == 0,
            varying=tuple(name for name, does in varies.items() if does),
            exposes=exposes,
        )
        return plan_reflectance(view, given)

    def _materials(self, albedo: Given, textures: Given) -> _Materials:
        """The scene's, with what is given in their place."""
        bodies = self._bodies
        colors, images = list(self._scene.colors), list(self._scene.images)
        for name, given in (("albedo", albedo), ("textures", textures)):
            check.per_body(name, given, len(bodies))
        for number, color in enumerate(albedo or ()):
            if color is not None:
                vertex_count = bodies[number].mesh.vertex_count
                check.shape(f"albedo[{number}]", color.shape, ("batch", 1 if color.shape[1:] == (1,) else vertex_count))
                colors[number], images[number] = color, None
        for number, image in enumerate(textures or ()):
            if image is not None:
                check.shape(f"textures[{number}]", image.shape, ("batch", "height", "width"))
                if bodies[number].mesh.uvs is None:
                    raise ValueError(f"textures[{number}]: got an image, but the mesh has no uvs; expected None")
                if albedo is not None and albedo[number] is not None:
                    raise ValueError(f"albedo[{number}], textures[{number}]: got both, expected one of them")
                images[number] = image
        return _Materials(colors, images)

    # ------------------------------------------------------------------------------------------ samples

    def find(self, view: View, albedo: Given = None, textures: Given = None) -> wp.array:
        """Find what a view's samples reflect: vec3 of shape [batch, height, width].

        Args:
            view: The view.
            albedo: For each body, vec3 of shape [batch, 1] or [batch, vertex]; None for what the scene has.
            textures: For each body, vec3 of shape [batch, height, width], which needs uvs; None for what the scene has.

        Raises:
            ValueError: naming the argument, what it got and what it accepts.
        """
        materials = self._given(albedo, textures)
        plan = self._plan(view.facts, materials, view.kept, exposes=False)
        if not plan.reflectance:
            assert view.kept.reflectance is not None
            return view.kept.reflectance
        reflected = self._sample(plan, view, materials)
        is_scenes = _same(materials.colors, self._scene.colors) and _same(materials.images, self._scene.images)
        if is_scenes and view.keeps:
            view.kept.reflectance = reflected
        return reflected

    def expose(self, view: View, white: wp.array, exposure: Stage, albedo: Given, textures: Given) -> wp.array:
        """Expose a view's samples as it is found what they reflect: vec4 of shape [batch, height, width].

        Args:
            view: The view, which stands, as does what its samples receive.
            white: The samples if every surface were white.
            exposure: The stage.
            albedo: As for :meth:`find`.
            textures: As for :meth:`find`, one at least.

        Raises:
            ValueError: naming the argument, what it got and what it accepts.
        """
        materials = self._given(albedo, textures)
        plan = self._plan(view.facts, materials, view.kept, exposes=True)
        vertex_albedo = self._vertex_albedo(materials)
        pyramids, footprints = self._textures(plan, view, materials)
        with self._ledger.timed(exposure, [vertex_albedo, *materials.present]):
            return expose_albedo(view.fragments, self._assembly.faces, vertex_albedo, pyramids, footprints, white)

    def _given(self, albedo: Given, textures: Given) -> _Materials:
        """The scene's, with what is given in their place, of finite numbers."""
        materials = self._materials(albedo, textures)
        for name, given in (("albedo", albedo), ("textures", textures)):
            arrays = {f"{name}[{number}]": array for number, array in enumerate(given or ())}
            check.finite_arrays(arrays)
        return materials

    def _sample(self, plan: ReflectancePlan, view: View, materials: _Materials) -> wp.array:
        timed, faces = self._ledger.timed, self._assembly.faces
        vertex_albedo = self._vertex_albedo(materials)
        present = materials.present
        if not present:
            with timed(plan.reflectance, [vertex_albedo, view.clip_positions]):
                return interpolate(view.fragments, faces, vertex_albedo)
        pyramids, footprints = self._textures(plan, view, materials)
        with timed(plan.reflectance, [vertex_albedo, *present, view.clip_positions]):
            return sample_albedo(view.fragments, faces, vertex_albedo, pyramids, footprints)

    def _vertex_albedo(self, materials: _Materials) -> wp.array:
        """Reflectance of all vertices."""
        if _same(materials.colors, self._scene.colors):
            return self._scene_vertex_albedo
        return self._join(materials.colors)

    def _textures(self, plan: ReflectancePlan, view: View, materials: _Materials) -> tuple[Textures, Footprints]:
        """Mip levels of the textures, and what each sample covers of them."""
        with self._ledger.timed(plan.pyramids, materials.present):
            pyramids = self._pyramids(plan, view, materials)
        with self._ledger.timed(plan.footprints, [view.clip_positions]):
            return pyramids, self._footprints(plan, view, pyramids, materials.sizes)

    def _pyramids(self, plan: ReflectancePlan, view: View, materials: _Materials) -> Textures:
        """Mip levels: the scene's are kept, and of others only those are made that kept footprints take."""
        if _same(materials.images, self._scene.images):
            if plan.pyramids:
                self._scene_pyramids = mip_pyramids(materials.present)
            if self._scene_pyramids is not None:
                return self._scene_pyramids
        coarsest = None if plan.footprints else self._coarsest_level(view, materials.sizes)
        return mip_pyramids(materials.present, coarsest=coarsest)

    def _footprints(self, plan: ReflectancePlan, view: View, pyramids: Textures, sizes: tuple) -> Footprints:
        """What each sample covers of its texture; the last sizes are kept."""
        if not plan.footprints:
            return view.kept.footprints[sizes][0]
        footprints = self._find_footprints(view, pyramids, sizes)
        if view.keeps:
            coarsest = footprints.coarsest_level() if is_readable(self._assembly.device) else None
            view.kept.footprints = {sizes: (footprints, coarsest)}
        return footprints

    def _coarsest_level(self, view: View, sizes: tuple) -> int | None:
        """Coarsest level that kept footprints take; for a GPU's it waits once it is clear that they stand."""
        footprints, coarsest = view.kept.footprints[sizes]
        if coarsest is None and view.keeps:
            view.kept.footprints[sizes] = footprints, footprints.coarsest_level()
        return coarsest

    def seen_texels(self, view: View, number: int) -> np.ndarray:
        """What each texel of the texture of a body weighs in a view's samples, float32 of shape [height, width]."""
        has_texture = [image is not None for image in self._scene.images]
        check.index("number", number, len(has_texture), "body")
        if not has_texture[number]:
            raise ValueError(f"number: got {number}, a body without a texture, expected one that has one")
        pyramids = mip_pyramids(self._scene.present)
        footprints = self._find_footprints(view, pyramids, self._scene.sizes)
        return seen_texels(pyramids, footprints)[sum(has_texture[:number])].sum(axis=0)

    def _join(self, colors: list[wp.array]) -> wp.array:
        """Reflectance of all vertices."""
        return concatenate(colors, np.diff(self._assembly.first_vertex).tolist())

    def _find_footprints(self, view: View, pyramids: Textures, sizes: tuple) -> Footprints:
        """What each sample covers of its texture; sizes are those of the bodies' textures, None without one."""
        assembly = self._assembly
        has_texture = np.array([size is not None for size in sizes])
        texture_of_body = np.where(has_texture, np.cumsum(has_texture) - 1, -1)
        return find_footprints(
            view.fragments,
            assembly.faces,
            view.clip_positions,
            assembly.uvs,
            assembly.uv_faces,
            constant(texture_of_body[assembly.body_of_face], wp.int32, assembly.device),
            pyramids,
        )

    def _array(self, values: np.ndarray, dtype: type) -> wp.array:
        return wp.array(values, dtype=dtype, device=self._assembly.device)


def _same(arrays: Sequence[wp.array | None], others: Sequence[wp.array | None]) -> bool:
    """Whether arrays are the same objects."""
    return all(array is other for array, other in zip(arrays, others, strict=True))
