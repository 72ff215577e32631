"""Views of a scene: its geometries seen by cameras, which are used again while their inputs stay the same.

Two views are cached: the last one of the scene itself, and the last of another geometry or by other cameras, once their
receivers and silhouettes are found. Not cached are views to whose geometry or cameras a gradient is asked for, as they
never come again, and those of a graph that is captured, whose memory their values are.
"""

import copy
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.assets.camera import Camera
from warpshadow.device.batch import common_batch
from warpshadow.device.constants import note_use
from warpshadow.device.cuda_graph import is_readable
from warpshadow.pipeline.bodies.blockers import BlockerKinds
from warpshadow.pipeline.bodies.geometry import PLACED, Geometry, as_geometry
from warpshadow.pipeline.bodies.reflectance import Materials
from warpshadow.pipeline.node import Call, Clock, Input, Node, identity
from warpshadow.pipeline.receivers.scene_receivers import SceneReceivers
from warpshadow.pipeline.receivers.shading_context import ShadingContext
from warpshadow.pipeline.receivers.static import StaticBodies
from warpshadow.pipeline.transport import LightTransport
from warpshadow.pipeline.views.view import View, ViewDependencies
from warpshadow.pipeline.views.view_warnings import warn_of_view
from warpshadow.stages.geometry.normals import vertex_normals
from warpshadow.stages.raster.project import check_clip_space
from warpshadow.stages.receivers.receivers import Receivers, receivers_on_faces


class SceneViews:
    """Views of a scene, and points in it that are lit.

    Args:
        transport: Light on receivers, by a method of visibility.
        materials: Reflectance of the bodies.
        cameras: The cameras that see the scene, of one size and near plane.
        clock: Where times are noted.
    Attributes:
        has_warned: Whether a view has warned of an image that shows nothing, and the like; set it to draw no warning.
        clip_matrices: The cameras.
        last: The last views that were cached: of the scene itself, and of another geometry or by other cameras.
    """

    def __init__(self, transport: LightTransport, materials: Materials, cameras: Sequence[Camera], clock: Clock):
        self._transport, self._method = transport, transport.method
        merged_scene = self._merged_scene = self._method.merged_scene
        self._materials, self._clock, self._receivers = materials, clock, SceneReceivers(merged_scene)
        self.vertices = Input("vertices", lambda: merged_scene.scene_geometry.positions)
        self._spheres = Input(
            "spheres", lambda: (merged_scene.scene_geometry.centers, merged_scene.scene_geometry.radii)
        )
        self._rotations = Input("rotations", lambda: merged_scene.scene_geometry.rotations)
        self.has_warned = False
        self._static: dict[tuple[int, ...], StaticBodies] = {}  # by moving bodies
        self._set_cameras(cameras)

    def _set_cameras(self, cameras: Sequence[Camera]) -> None:
        matrices, device = [camera.clip_matrix() for camera in cameras], self._merged_scene.device
        self._cameras = tuple(cameras)
        self.clip_matrices = Input("cameras", lambda: wp.array(matrices, dtype=wp.mat44, device=device))
        self.last: tuple[View | None, View | None] = None, None
        self._last_cameras: Input | None = None

    def with_cameras(self, cameras: Sequence[Camera]) -> "SceneViews":
        """Views by other cameras of the same bodies, which draw no warning."""
        other = copy.copy(self)
        other.has_warned = True
        other._set_cameras(cameras)
        return other

    def call(self, context: ShadingContext | None = None) -> Call:
        """A call, with the cached values of points."""
        return Call(self._clock, context.call if context else None, caches=not self._merged_scene.device.is_capturing)

    def view(self, geometry: Geometry | None = None, clip_matrices: wp.array | None = None) -> View:
        """The view of a geometry, with its receivers and silhouettes, which are found unless it is cached."""
        view = self.lazy_view(geometry, clip_matrices)
        if view not in self.last:
            for node in (view.receivers_node, view.silhouettes):
                node.value(view.call)
            self._warn_once(view)
            self._cache_view(view)
        return view

    def _warn_once(self, view: View) -> None:
        """Say once why an image shows nothing, and the likely mistakes in the scene itself."""
        is_of_scene, device = self._is_of_scene(view), self._merged_scene.device
        if not self.has_warned and (is_readable(device) or (is_of_scene and not device.is_capturing)):
            self.has_warned = warn_of_view(view, self._cameras if is_of_scene else None)

    def _is_of_scene(self, view: View) -> bool:
        """Whether a view is of the bodies where the scene has them, by its cameras."""
        return view.vertices is self.vertices and view.cameras is self.clip_matrices

    def _cache_view(self, view: View) -> None:
        """Cache a view whose receivers are found, unless it has gradients or belongs to a graph."""
        if self._merged_scene.device.is_capturing:
            return
        self._last_cameras = view.cameras
        if view.static_bodies is not None:
            self._static[view.static_bodies.moving] = view.static_bodies
        if view.receivers_node.is_cached:
            self.last = (view, self.last[1]) if self._is_of_scene(view) else (self.last[0], view)

    def lazy_view(self, geometry: Geometry | None = None, clip_matrices: wp.array | None = None) -> View:
        """Build a view, and compute nothing of it, or reuse a cached one if its inputs match."""
        vertices, spheres, cameras, static_bodies = self.vertices, self._spheres, self.clip_matrices, None
        last, poses, matrices = self.last[1], [None], self._cameras
        if geometry is not None:
            geometry = as_geometry("geometry", geometry)
            rest = self._merged_scene.rest.arrays()
            for name, array in geometry.arrays().items():
                check.shape(f"geometry.{name}", array.shape, ("batch", *rest[name].shape[1:]), PLACED)
            poses = geometry.positions
            vertices = Input.renewed("vertices", poses, last.vertices if last else None)
            spheres = Input.renewed("spheres", (geometry.centers, geometry.radii), last.spheres if last else None)
        if clip_matrices is not None:
            matrices = clip_matrices
            cameras = Input.renewed("cameras", matrices, self._last_cameras)
        image_count = common_batch({"geometry": poses, "clip_matrices": matrices})
        if geometry is not None and geometry.moving is not None and self._receivers.caches_rows:
            static_bodies = self._static.get(geometry.moving)
            if static_bodies is None or not static_bodies.matches(geometry):
                static_bodies = StaticBodies(self._merged_scene, geometry)
            note_use(static_bodies)
        blocker_kinds = self._blocker_kinds(geometry, last)
        dependencies = ViewDependencies(vertices, spheres, cameras, static_bodies, blocker_kinds)
        for view in self.last:
            if view is not None and view.dependencies == dependencies:
                return view
        if clip_matrices is not None:
            check_clip_space(clip_matrices)
        return View(
            self._transport,
            self._receivers,
            self._materials,
            dependencies,
            call=self.call(),
            camera=self._cameras[0],
            counts=(len(poses), image_count),
            is_scene_view=geometry is None and clip_matrices is None and image_count == 1,
        )

    def _blocker_kinds(self, geometry: Geometry | None, last: ShadingContext | None = None) -> BlockerKinds:
        """The kind of blocker that each body of a geometry, by default the scene's, is."""
        rotations = self._rotations
        if geometry is not None and geometry.rotations is not None:
            count = len(self._merged_scene.scene.bodies)
            check.shape("geometry.rotations", geometry.rotations.shape, ("batch", count))
            rotations = Input.renewed("rotations", geometry.rotations, last.blocker_kinds.rotations if last else None)
        return self._method.blocker_kinds(geometry, rotations)

    def _bodies(self, geometry: Geometry | None) -> tuple[Input, Input]:
        """Vertices and spheres of a geometry, by default the scene's."""
        if geometry is None:
            return self.vertices, self._spheres
        return Input("vertices", geometry.positions), Input("spheres", (geometry.centers, geometry.radii))

    def at_points(self, points: wp.array, normals: wp.array, geometry: Geometry | None = None) -> ShadingContext:
        """Points to be lit by :meth:`.SceneRenderer.shade` that are given, not found in an image.

        Nobody knows which body a point is on: all spheres and planes block its light, and where light bounces, none
        comes from its own body as such. For points of bodies take :meth:`on_faces`.

        Args:
            points: Positions [scene units], vec3 of shape [batch, receiver].
            normals: Unit normals, vec3 of shape [batch, receiver].
            geometry: Geometry of the blockers, by default the scene's bodies.
        Differentiable: all.
        """
        receivers = Input("receivers", Receivers(points, normals, None, None, None))  # type: ignore[arg-type]
        node = Node("", identity, receivers)
        (vertices, spheres), kinds = self._bodies(geometry), self._method.blocker_kinds(geometry, None)
        return ShadingContext(
            self._merged_scene, self._materials, vertices, spheres, node, self.call(), blocker_kinds=kinds
        )

    def on_faces(self, sides: np.ndarray, barycentrics: np.ndarray, geometry: Geometry | None = None) -> ShadingContext:
        """Points on faces to be lit by :meth:`.SceneRenderer.shade`, which knows their bodies: self-visibility counts.

        Args:
            sides: Face of each, backs numbered after the last face, int of shape [receiver]; receivers of a body are
                consecutive.
            barycentrics: Where on it, shape [receiver, 3].
            geometry: Where the bodies are, by default where the scene has them.
        Differentiable: geometry.
        """
        merged_scene, kinds = self._merged_scene, self._blocker_kinds(geometry)
        vertices, spheres = self._bodies(geometry)
        span_bodies = self._receivers.span_bodies(kinds)
        if span_bodies is not None:
            span_bodies = span_bodies[merged_scene.body_of_face[sides % len(merged_scene.body_of_face)]]
        normals = Node("", vertex_normals, vertices, merged_scene.faces)
        node = Node("", receivers_on_faces, vertices, normals, merged_scene.faces, sides, barycentrics, span_bodies)
        return ShadingContext(
            merged_scene, self._materials, vertices, spheres, node, self.call(), normals=normals, blocker_kinds=kinds
        )


def camera_batch(cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """Cameras whose images are a batch, checked; all get the nearest of their near planes."""
    check.instance("cameras", cameras, Sequence, "a list of Cameras, [camera], or None for the scene's")
    if not cameras:
        raise ValueError("cameras: got none, expected at least one, or None for the scene's")
    first = cameras[0]
    for number, camera in enumerate(cameras):
        check.instance(f"cameras[{number}]", camera, Camera, "a Camera")
        if (camera.width, camera.height) != (first.width, first.height):
            raise ValueError(
                f"cameras[{number}]: got {camera.width} × {camera.height} pixels, "
                f"expected {first.width} × {first.height}, as the first has"
            )
    near = min(camera.near for camera in cameras)
    return tuple(camera if camera.near == near else replace(camera, near=near) for camera in cameras)
