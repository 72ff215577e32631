"""A scene file to begin with, of a mesh as :func:`warpshadow.default_scene` shows it, to be edited by hand."""

import json
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from warpshadow.assets import files
from warpshadow.assets.camera import DIRECTION
from warpshadow.assets.mesh_files import load_mesh
from warpshadow.assets.topology import CREASE
from warpshadow.scene.mesh_scene import GROUND_SIZE
from warpshadow.scene.scene import Scene

_SCENE = """\
# warpshadow render {name} -o picture.png, or warpshadow view {name}

[camera]
framing = "auto"             # as near as the bodies are in view
direction = {direction}  # from the bodies to the camera; y is up
size = [{width}, {height}]            # width, height

[light]
{light}
rotation = {rotation}               # degrees about the vertical
bounces = {bounces}                  # how often light bounces between bodies, or "all"

[[body]]
mesh = {mesh}
on_ground = {{size = 2.0}}     # 2 units large, standing
{options}
[[body]]
primitive = "infinite_ground"
size = {ground_size}
albedo = {albedo}
"""

_SKY = "sky = {}                     # clear, with a sun"


def write_starter(
    path: Path,
    mesh: Path,
    scene: Scene,
    *,
    albedo: Sequence[float] | None = None,
    light: Path | None = None,
    direction: Sequence[float] = DIRECTION,
    rotation: float = 0.0,
) -> None:
    """Write the default scene of a mesh; its file names the mesh's, and is short.

    Raises:
        FileExistsError: where the file is there, and differs: it may have been edited.
    """
    body, ground = scene.bodies
    options = []
    if body.rotation.any():
        options.append(f"rotation = {body.rotation.tolist()}  # axis-angle vector, degrees: z is up")
    if albedo is not None:
        options.append(f"albedo = {[float(number) for number in albedo]}")
    if body.mesh.origins is not None:
        options.append(f"creased = {CREASE:g}                 # edges stay sharp where faces bend by more degrees")
    lines = _SCENE.format(
        name=path.name,
        direction=[float(number) for number in direction],
        rotation=float(rotation),
        width=scene.camera.width,
        height=scene.camera.height,
        light=_SKY if light is None else f"envmap = {_relative_path(path, light)}",
        bounces=scene.bounces,
        mesh=_relative_path(path, mesh),
        options="".join(f"{option}\n" for option in options),
        ground_size=GROUND_SIZE,
        albedo=[round(float(value), 4) for value in ground.albedo],
    )
    if path.exists() and path.read_text(encoding="utf-8") != lines:
        raise FileExistsError(
            f"{path}: got a file that is there and may have been edited, expected none; remove "
            "it, or write another, -o other.toml"
        )
    with files.atomic_write(path) as unfinished:
        unfinished.write_text(lines, encoding="utf-8")


def write_bunny(folder: Path) -> Path:
    """Write Warp's bunny as bunny.obj, and return its path.

    Raises:
        FileExistsError: where another file has its name.
        ImportError: without the package usd-core.
    """
    import warp.examples

    path = folder / "bunny.obj"
    mesh = load_mesh(Path(warp.examples.get_asset_directory(), "bunny.usd"))
    if path.exists() and not np.array_equal(load_mesh(path).positions, mesh.positions):
        raise FileExistsError(f"{path}: got another file than Warp's bunny, expected none; give it as MESH")
    mesh.write(path)
    return path


def _relative_path(path: Path, file: Path) -> str:
    """A file as a scene file names it, from its folder, in quotes."""
    return json.dumps(Path(os.path.relpath(file, path.parent)).as_posix(), ensure_ascii=False)
