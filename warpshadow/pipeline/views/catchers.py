"""Shadow catchers: the light that they receive without the other bodies of their scene."""

from __future__ import annotations

import copy
import functools
from collections.abc import Sequence

import numpy as np
import warp as wp

from warpshadow.assets.camera import Camera
from warpshadow.pipeline.bodies.geometry import Geometry
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.image_inputs import ImageArrays
from warpshadow.pipeline.views.scene_views import SceneViews
from warpshadow.pipeline.views.view import View


class CatcherScene:
    """The catchers of a scene as a scene of their own, with the same receivers and spheres.

    Args:
        views: Of the catchers alone.
        merged_scene: All bodies.
    """

    def __init__(self, views: SceneViews, merged_scene: MergedScene):
        self._views, self._merged_scene, self._numbers = views, merged_scene, merged_scene.scene.catchers

    def with_cameras(self, cameras: Sequence[Camera]) -> CatcherScene:
        """Copy for other cameras."""
        alone = copy.copy(self)
        alone._views = self._views.with_cameras(cameras)
        return alone

    @functools.cached_property
    def has_face(self) -> wp.array:
        """Whether each face of the whole scene is one of a catcher, bool of shape [face]."""
        is_catcher = np.isin(self._merged_scene.body_of_face, self._numbers)
        return wp.array(is_catcher, dtype=wp.bool, device=self._merged_scene.device)

    def moved_geometry(self, geometry: Geometry[wp.array]) -> Geometry[wp.array] | None:
        """The catchers' part of a geometry; None where they are where the scene has them. Differentiable in it."""
        has_moved = geometry.moving is None or set(geometry.moving) & set(self._numbers)
        return self._merged_scene.part(geometry, self._numbers) if has_moved else None

    def light(self, inputs: ImageArrays, view: View) -> wp.array:
        """Light received by samples of catchers, and whether they see one; vec4, as of :meth:`.View.white_samples`.

        Args:
            inputs: Of the whole scene, but for the geometry, which is that of the catchers, from
                :meth:`moved_geometry`.
            view: The view of the whole scene.
        """
        views, scene = self._views, self._merged_scene.scene
        scene_values = {name: scene.per_body(inputs.of_bodies[name], name) for name in ("albedo", "textures")}
        catcher_view = views.view(inputs.geometry, inputs.clip_matrices)
        catcher_values = {name: [items[number] for number in self._numbers] for name, items in scene_values.items()}
        materials = catcher_view.materials.replaced(catcher_values)
        # rays are drawn by a receiver's number: the same for both views
        if scene.visibility.traits.every_sample_receives:
            catcher_view = catcher_view.at_receivers_of(view)
        # an input of their own: their method and view cache other nodes of the same light
        light = catcher_view.method.light_input(catcher_view, inputs.light, inputs.shell)
        return catcher_view.white_samples(light, materials).value(views.call(catcher_view))
