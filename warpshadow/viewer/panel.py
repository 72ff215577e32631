"""The panel beside the picture, and the handles in it. All pages share it."""

import dataclasses
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from warpshadow.assets.known_light import as_light
from warpshadow.assets.primitives import icosphere
from warpshadow.scene.body import RECEIVERS
from warpshadow.viewer import gizmo
from warpshadow.viewer.loop import Loop
from warpshadow.viewer.page_camera import PAGE_RADIUS, quaternion
from warpshadow.viewer.painter import Painter, picture
from warpshadow.viewer.saving import as_archive, as_toml, saved_camera
from warpshadow.viewer.state import AS_GIVEN, ERROR, PICTURE, BodyPose, ViewerState

_NOTHING = "nothing"
_CELLS = (16, 32, 64, 128, 256, 512)
_SPHERES = (16, 32, 64, 128, 256, 512)
_HANDLES = "/handles"
_MAP_COLUMNS = 256


class Panel:
    """Controls that change a scene."""

    def __init__(self, server: viser.ViserServer, loop: Loop, painter: Painter, path: Path | None = None):
        self._server, self._loop, self._painter, self._path = server, loop, painter, path
        self._scene, self._scale = painter.scene, painter.page_scale
        self._inputs: list[tuple[Any, Callable[[ViewerState], Any]]] = []
        self._handles: viser.TransformControlsHandle | None = None
        self._dragged: int | None = None
        self._spheres: dict[int, viser.BatchedMeshHandle] = {}
        self._showing = threading.Lock()  # spheres may have to be fitted, so they are shown in threads of their own
        self._first = loop.viewer_state
        self._add_light()
        self._add_shadows()
        self._add_gloss()
        self._add_bodies()
        save = server.gui.add_button("Save scene", hint="Download the scene as it is shown, and from where you look")
        save.on_click(self._save)

    # ------------------------------------------------------------------------------------------ controls

    def _add_light(self) -> None:
        gui, viewer_state = self._server.gui, self._loop.viewer_state
        with gui.add_folder("Light"):
            self._map = None
            if self._painter.has_map:
                self._map = gui.add_image(self._map_picture(viewer_state), label="middle: +z", format="jpeg")
            turn = gui.add_slider("Turn [°]", -180.0, 180.0, 1.0, viewer_state.turn)
            self._bind(turn, "turn")
            scale = gui.add_slider("Scale [stops]", -6.0, 6.0, 0.1, 0.0)
            self._bind(scale, "scale", lambda scale: float(np.log2(max(scale, 2**-6))), lambda stops: 2.0**stops)
            if self._map is not None:
                behind = gui.add_checkbox("Behind the bodies", viewer_state.shows_light)
                self._bind(behind, "shows_light")
            stops = gui.add_slider(
                "Exposure [stops]", viewer_state.stops - 6, viewer_state.stops + 6, 0.1, viewer_state.stops
            )
            self._bind(stops, "stops")

    def _add_shadows(self) -> None:
        gui, viewer_state = self._server.gui, self._loop.viewer_state
        cells, counts = sorted({*_CELLS, viewer_state.directions}), (AS_GIVEN, *map(str, _SPHERES))
        with gui.add_folder("Shadows"):
            method = gui.add_dropdown("Method", self._scene.methods, initial_value=viewer_state.method)
            self._bind(method, "method")
            directions = gui.add_dropdown(
                "Directions", tuple(map(str, cells)), initial_value=str(viewer_state.directions)
            )
            self._bind(directions, "directions", str, int)
            softness = gui.add_slider("Softness", 0.05, 1.5, 0.05, viewer_state.softness)
            self._bind(softness, "softness")
            spheres = gui.add_dropdown("Spheres", counts, hint="Other numbers are fitted once, some 20 s a body")
            self._bind(
                spheres,
                "spheres",
                lambda count: AS_GIVEN if count is None else str(count),
                lambda text: None if text == AS_GIVEN else int(text),
            )
            receivers = gui.add_dropdown("Receivers", (AS_GIVEN, *RECEIVERS), initial_value=viewer_state.receivers)
            self._bind(receivers, "receivers")
            if self._scene.bounces and viewer_state.bounces != "all":
                bounces = gui.add_slider("Bounces", 0, max(4, viewer_state.bounces), 1, viewer_state.bounces)
                self._bind(bounces, "bounces")
            shows = gui.add_dropdown("Show", (PICTURE, ERROR), hint="Red: too bright, by 20% of the mean; blue: dark")
            self._bind(shows, "shows")

    def _add_gloss(self) -> None:
        """Sliders of the bodies that shine, in the scene, by one number."""
        gui, of_bodies = self._server.gui, self._loop.viewer_state.gloss
        if not any(of_bodies):
            return
        with gui.add_folder("Gloss"):
            for number, gloss in enumerate(of_bodies):
                for name, value in gloss.items():
                    label = f"{self._scene.bodies[number].name}: {name}"
                    self._bind_gloss(gui.add_slider(label, 0.0, 1.0, 0.01, value), number, name)

    def _bind_gloss(self, slider: Any, number: int, name: str) -> None:
        """Change a number of a body's gloss when a page moves its slider."""

        def read(value: float) -> tuple[dict[str, float], ...]:
            of_bodies = [*self._loop.viewer_state.gloss]
            of_bodies[number] = of_bodies[number] | {name: value}
            return tuple(of_bodies)

        self._bind(slider, "gloss", lambda of_bodies: of_bodies[number][name], read)

    def _add_bodies(self) -> None:
        gui = self._server.gui
        self._names = [f"{number}: {body.name}" for number, body in enumerate(self._scene.bodies)]
        with gui.add_folder("Bodies"):
            dragged_input = gui.add_dropdown("Drag", (_NOTHING, *self._names))
            self._balls = balls = gui.add_checkbox("Show spheres", False)
            back = gui.add_button("Put back", hint="Bodies and settings as the scene has them")

        @dragged_input.on_update
        async def _(event: viser.GuiEvent) -> None:
            if dragged_input.value in (_NOTHING, *self._names):
                self._drag(None if dragged_input.value == _NOTHING else self._names.index(dragged_input.value))

        @balls.on_update
        def _(event: viser.GuiEvent) -> None:  # in a thread of its own: spheres may have to be fitted
            self._obey(event, self._show_spheres)

        @back.on_click
        async def _(event: viser.GuiEvent) -> None:
            self._loop.update(lambda _: self._first)
            self._put_back()

    # ------------------------------------------------------------------------------------------ actions

    def _bind(
        self,
        handle: Any,
        field: str,
        show: Callable[[Any], Any] = lambda value: value,
        read: Callable[[Any], Any] = lambda value: value,
    ) -> None:
        """Change a field of the viewer state when a page changes an input; put the input back where that is refused."""
        self._inputs.append((handle, lambda viewer_state: show(getattr(viewer_state, field))))

        @handle.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:  # not by ourselves
                self._obey(event, lambda: self._changed(**{field: read(handle.value)}))

    def _obey(self, event: viser.GuiEvent, act: Callable[[], None]) -> None:
        """Obey a page's request; report why if it is refused."""
        try:
            act()
        except (ValueError, OverflowError, TypeError) as error:
            self._put_back()
            if event.client is not None:
                event.client.add_notification("Refused", str(error), color="red", auto_close_seconds=8)

    def _changed(self, **changes: Any) -> None:
        before = self._loop.viewer_state
        viewer_state = self._loop.change(**changes)
        if self._map is not None and viewer_state.turn != before.turn:
            self._map.image = self._map_picture(viewer_state)
        if viewer_state.spheres != before.spheres and self._spheres:
            self._server.get_event_loop().run_in_executor(None, self._show_spheres)

    def _put_back(self) -> None:
        """Update inputs and handles to the current state."""
        viewer_state = self._loop.viewer_state
        for handle, value_of in self._inputs:
            handle.value = value_of(viewer_state)
        if self._map is not None:
            self._map.image = self._map_picture(viewer_state)
        self._move_handles(viewer_state)
        self._move_spheres(viewer_state)

    def _map_picture(self, viewer_state: ViewerState) -> np.ndarray:
        """The light as it is turned."""
        radiance = as_light(viewer_state.light(self._painter.coarse_light)).radiance
        step = max(1, radiance.shape[1] // _MAP_COLUMNS)
        thumbnail = radiance[::step, ::step]
        alpha = np.ones((*thumbnail.shape[:2], 1), np.float32)
        stops = -float(np.log2(max(np.percentile(thumbnail.max(axis=-1), 95), 1e-12)))
        return picture(np.concatenate([thumbnail, alpha], axis=-1), stops, np.zeros(3))

    def _save(self, event: viser.GuiEvent) -> None:
        client = event.client
        page = None if client is None else self._loop.camera_of(client.client_id)
        if client is None or page is None:
            return
        camera, viewer_state = saved_camera(self._scene, page, self._scale), self._loop.viewer_state
        if self._path is not None:
            name, content = self._path.name, as_toml(self._path, self._scene, viewer_state, camera)
        else:
            name, content = "scene.zip", as_archive(self._scene, viewer_state, camera)
        client.send_file_download(name, content, save_immediately=True)

    # ------------------------------------------------------------------------------------------ in the picture

    def _drag(self, number: int | None) -> None:
        """Put handles at a body, and remove another body's."""
        if self._handles is not None:
            self._handles.remove()
        self._handles, self._dragged = None, number
        if number is not None:
            body = self._scene.bodies[number]
            wxyz, position = gizmo.handle_of(self._loop.viewer_state.poses[number], body, self._scale)
            radius = min(self._scale * gizmo.radius(body), PAGE_RADIUS)  # a ground may go to the horizon
            self._handles = self._server.scene.add_transform_controls(
                _HANDLES,
                scale=1.2 * radius,  # they begin inside the body, and end outside of it
                wxyz=wxyz,
                position=position,
            )
            self._handles.on_update(self._dragging)
        self._loop.repaint(depth=self._needs_depth)

    @property
    def _needs_depth(self) -> bool:
        return self._handles is not None or bool(self._spheres)

    async def _dragging(self, event: viser.TransformControlsEvent) -> None:
        number = self._dragged
        if number is None:
            return
        body = self._scene.bodies[number]
        try:
            pose = gizmo.pose_of(event.target.wxyz, event.target.position, body, self._scale)
        except ValueError:  # not finite
            self._move_handles(self._loop.viewer_state)
            return

        def moved(viewer_state: ViewerState) -> ViewerState:
            poses = [*viewer_state.poses]
            poses[number] = pose
            return dataclasses.replace(viewer_state, poses=tuple(poses))

        self._move_spheres(self._loop.update(moved))

    def _move_handles(self, viewer_state: ViewerState) -> None:
        if self._handles is not None and self._dragged is not None:
            body = self._scene.bodies[self._dragged]
            wxyz, position = gizmo.handle_of(viewer_state.poses[self._dragged], body, self._scale)
            self._handles.wxyz, self._handles.position = wxyz, position

    def _show_spheres(self) -> None:
        """Show spheres or none, as the panel says by the time it is this thread's turn."""
        with self._showing:
            self._replace_spheres(bool(self._balls.value))
        self._move_spheres(self._loop.viewer_state)
        self._loop.repaint(depth=self._needs_depth)

    def _replace_spheres(self, shows: bool) -> None:
        for handle in self._spheres.values():
            handle.remove()
        self._spheres = {}
        ball = icosphere(subdivisions=2)
        for number, (centers, radii) in enumerate(self._painter.spheres(self._loop.viewer_state) if shows else ()):
            if len(radii):
                factor = self._scale * self._scene.bodies[number].scale
                self._spheres[number] = self._server.scene.add_batched_meshes_simple(
                    f"/spheres/{number}",
                    ball.positions,
                    ball.faces,
                    np.tile([1.0, 0.0, 0.0, 0.0], (len(radii), 1)),
                    factor * centers,
                    batched_scales=factor * radii,
                    opacity=0.35,
                )

    def _move_spheres(self, viewer_state: ViewerState) -> None:
        for number, handle in list(self._spheres.items()):
            pose: BodyPose = viewer_state.poses[number]
            handle.wxyz = quaternion(Rotation.from_rotvec(pose.rotation, degrees=True))
            handle.position = self._scale * np.array(pose.translation)
