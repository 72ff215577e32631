"""A scene as it is shown, as a file to take home."""

import dataclasses
import io
import tempfile
import zipfile
from pathlib import Path

from warpshadow.assets.camera import Camera
from warpshadow.scene import toml_tables
from warpshadow.scene.files import camera_table, write_scene
from warpshadow.scene.scene import Scene
from warpshadow.scene.visibility import METHODS_OF_SETTING
from warpshadow.viewer.page_camera import PageCamera
from warpshadow.viewer.state import AS_GIVEN, ViewerState


def saved_camera(scene: Scene, page: PageCamera, page_scale: float) -> Camera:
    """The page's camera on an image as high as the scene's, as wide as the page makes it."""
    height = scene.camera.height
    size = max(1, round(height * page.width / page.height)), height
    return page.camera(size, page_scale=page_scale, near=scene.camera.near)


def as_toml(path: Path, scene: Scene, viewer_state: ViewerState, camera: Camera) -> bytes:
    """A scene file with the changes in it; it names the same files as before."""
    tables = toml_tables.read(path, "scene file")
    tables["camera"] = camera_table(camera) | {"supersampling": scene.supersampling}
    light = tables["light"]
    light["rotation"] = light.get("rotation", 0.0) + viewer_state.turn
    light["scale"] = light.get("scale", 1.0) * viewer_state.scale
    settings = viewer_state.settings(scene)
    light["bounces"] = settings.bounces
    visibility = tables.setdefault("visibility", {})
    given_settings = vars(scene.visibility.with_method()) | {"directions": scene.direction_count}
    for name in ("method", *METHODS_OF_SETTING):
        value = getattr(settings.visibility, name)
        if value is not None and value != given_settings[name]:
            visibility[name] = value
    if "method" in visibility:  # "auto" was replaced
        visibility["method"] = settings.visibility.method
    start = ViewerState.of(scene)
    pairs = zip(tables["body"], settings.bodies, viewer_state.poses, start.poses, strict=True)
    for number, (table, body, pose, old) in enumerate(pairs):
        table.update(viewer_state.changed_gloss(body, number))
        if pose != old:
            table["rotation"], table["translation"] = list(pose.rotation), list(pose.translation)
            if table.pop("on_ground", False):  # which may have scaled it
                table["scale"] = float(body.scale)
        if viewer_state.receivers != AS_GIVEN:
            table["receivers"] = viewer_state.receivers
        if viewer_state.spheres is not None and body.casts_shadow:
            table.pop("spheres", None)
            table["blockers"] = viewer_state.spheres
    return toml_tables.text(tables).encode()


def as_archive(scene: Scene, viewer_state: ViewerState, camera: Camera) -> bytes:
    """A ZIP archive of the scene file and all that it names."""
    shown_scene = dataclasses.replace(viewer_state.scene(scene), camera=camera)
    packed = io.BytesIO()
    with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in write_scene(shown_scene, folder):
            archive.write(path, path.relative_to(folder))
    return packed.getvalue()
