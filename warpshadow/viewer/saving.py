"""A scene as it is shown, as a file to take home."""

from __future__ import annotations

import dataclasses
import io
import tempfile
import zipfile
from pathlib import Path

from warpshadow.assets.camera import Camera
from warpshadow.scene import toml_tables
from warpshadow.scene.files import camera_table, write_scene
from warpshadow.scene.scene import READ_BY, Scene
from warpshadow.viewer.look import AS_GIVEN, Look
from warpshadow.viewer.page_camera import PageCamera


def saved_camera(scene: Scene, page: PageCamera, page_scale: float) -> Camera:
    """The page's camera on an image as high as the scene's, as wide as the page makes it."""
    height = scene.camera.height
    size = max(1, round(height * page.width / page.height)), height
    return page.camera(size, page_scale=page_scale, near=scene.camera.near)


def as_toml(path: Path, scene: Scene, look: Look, camera: Camera) -> bytes:
    """A scene file with what was changed in it; what it names is named as before.

    Args:
        path: The file as it was.
        scene: The scene in it.
        look: How it is shown.
        camera: From where.
    """
    tables = toml_tables.read(path, "scene file")
    tables["camera"] = camera_table(camera) | {"supersampling": scene.supersampling}
    light = tables["light"]
    light["rotation"] = light.get("rotation", 0.0) + look.turn
    light["scale"] = light.get("scale", 1.0) * look.scale
    settings = look.settings(scene)
    light["bounces"] = settings.bounces
    visibility = tables.setdefault("visibility", {})
    for name in ("method", *READ_BY):
        value = getattr(settings.visibility, name)
        if value != getattr(scene.visibility, name):
            visibility[name] = value
    visibility["method"] = settings.visibility.method
    start = Look.of(scene)
    for table, body, pose, old in zip(tables["body"], settings.bodies, look.poses, start.poses, strict=True):
        if pose != old:
            table["rotation"], table["translation"] = list(pose.rotation), list(pose.translation)
            if table.pop("on_ground", False):  # which may have scaled it
                table["scale"] = float(body.scale)
        if look.receivers != AS_GIVEN:
            table["receivers"] = look.receivers
        if look.spheres is not None and body.casts_shadow:
            table.pop("spheres", None)
            table["blockers"] = look.spheres
    return toml_tables.text(tables).encode()


def as_archive(scene: Scene, look: Look, camera: Camera) -> bytes:
    """A ZIP archive of the scene file and all that it names."""
    shown = dataclasses.replace(look.scene(scene), camera=camera)
    packed = io.BytesIO()
    with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in write_scene(shown, folder):
            archive.write(path, path.relative_to(folder))
    return packed.getvalue()
