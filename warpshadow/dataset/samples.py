"""Samples: an image and what it shows, as the files that a shard has of it; written and read.

A sample has a key, the number of its image in nine digits, and up to three files:

    KEY.exr          layers that are images, as channels
    KEY.spheres.npy  what stands in for the bodies, float32 of shape [sphere, 5]: center, radius, number of the body
    KEY.json         how the scene was drawn; README.md says what it has
"""

from __future__ import annotations

import functools
import io
import itertools
import json
import tarfile
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.assets.image import exr_bytes, exr_channels
from warpshadow.assets.light import EnvironmentMap
from warpshadow.check import AnyPath
from warpshadow.dataset.data_set import DataSet
from warpshadow.dataset.recipe import Plain
from warpshadow.device.tape import unrecorded
from warpshadow.scene.files import camera_table
from warpshadow.scene.random_scenes import Drawn
from warpshadow.scene.scene import Body, Scene
from warpshadow.spheres import Spheres
from warpshadow.tuning.renderer import Renderer

LIGHT_ORDER = 4
"""Bands of the coefficients that a sample has of its light."""

_WHITE = (1.0, 1.0, 1.0)

_LAYER_OF = {"Z": "depth", "N": "normals", "body": "bodies", "mask": "masks"}
"""Layers by what the names of their channels begin with, as renderers call these."""


class Sample(NamedTuple):
    """An image and what it shows, as read from a shard."""

    key: str
    """Number of the image, in nine digits."""
    channels: dict[str, np.ndarray]
    """Layers that are images, float32 of shape [height, width], by their channels."""
    spheres: np.ndarray | None
    """float32 of shape [sphere, 5]: center, radius [scene units], number of the body; None where the layer is not."""
    scene: dict[str, Plain]
    """How the scene was drawn."""

    @property
    def color(self) -> np.ndarray:
        """Linear RGB, premultiplied, and coverage, float32 of shape [height, width, 4]."""
        return np.stack([self.channels[name] for name in "RGBA"], axis=-1)


def render_sample(data_set: DataSet, number: int) -> dict[str, bytes]:
    """Render an image of a data set: its files, by the ends of their names.

    The bits depend on the recipe, the number, and what is in the meshes and maps of the scene; neither on what was
    rendered before nor on the number of threads.
    """
    layers, drawn = data_set.recipe.layers, data_set.draw(number)
    scene = drawn.scene
    renderer = Renderer(scene, device=data_set.device, progress=False)
    channels: dict[str, np.ndarray] = {}
    if "color" in layers:
        channels |= dict(zip("RGBA", np.moveaxis(renderer.render(), -1, 0), strict=True))
    if "shadow" in layers:
        shadow = _shadow(renderer, data_set.device)
        channels |= {f"shadow.{color}": shadow[..., k] for k, color in enumerate("RGB")}
    if set(_LAYER_OF.values()) & set(layers):
        channels |= _chosen(renderer.layers().channels(), layers, data_set.recipe.ranges.count[1] + 1)
    files = {"json": json.dumps(_about(data_set, number, drawn), ensure_ascii=False).encode()}
    if channels:
        files["exr"] = exr_bytes(channels)
    if "spheres" in layers:
        stream = io.BytesIO()
        np.save(stream, _spheres(scene))
        files["spheres.npy"] = stream.getvalue()
    return files


def _chosen(channels: dict[str, np.ndarray], layers: tuple[str, ...], most_bodies: int) -> dict[str, np.ndarray]:
    """The channels of layers; masks for as many bodies as any scene has, so that images can be stacked."""
    empty = {f"mask.{number}": np.zeros_like(channels["Z"]) for number in range(most_bodies)}
    return {name: values for name, values in (empty | channels).items() if _LAYER_OF[name.split(".")[0]] in layers}


def _shadow(renderer: Renderer, device: str) -> np.ndarray:
    """Direct light on the bodies over that which they would get if nothing blocked any: [height, width, 3].

    All surfaces count as white. Where no light would come from, and where there is no body, it is 1.
    """
    scene = renderer.scene
    if scene.bounces:
        scene = replace(scene, bounces=0)
        renderer = Renderer(scene, device=device, progress=False)
    bodies = tuple(replace(body, blockers=0) for body in scene.bodies)
    others = Renderer(replace(scene, bodies=bodies), device=device, progress=False)
    received, unblocked = (_white_image(each)[..., :3] for each in (renderer, others))
    return np.divide(received, unblocked, out=np.ones_like(received), where=unblocked > 0)


def _white_image(renderer: Renderer) -> np.ndarray:
    """The image if all bodies were white."""
    white = functools.partial(wp.full, value=wp.vec3(_WHITE), dtype=wp.vec3, device=renderer.device)
    albedo, textures = {}, {}
    for number, body in enumerate(renderer.scene.bodies):
        if body.texture is None:
            albedo[number] = white((1, 1))
        else:
            textures[number] = white((1, 1, 1))
    with unrecorded():
        return renderer.draw(albedo=albedo, textures=textures).numpy()[0].copy()


def _spheres(scene: Scene) -> np.ndarray:
    """Spheres of the bodies in the world; of flat bodies there are none."""
    rows = [np.zeros((0, 5), np.float32)]
    for number, body in enumerate(scene.bodies):
        if isinstance(body.blockers, Spheres):
            placed = body.blockers.transformed(
                rotation=body.rotation_matrix(), translation=body.translation, scale=body.scale
            )
            owner = np.full((len(placed), 1), number)
            rows.append(np.concatenate([placed.centers, placed.radii[:, None], owner], axis=1))
    return np.concatenate(rows).astype(np.float32)


def _about(data_set: DataSet, number: int, drawn: Drawn) -> dict[str, Plain]:
    """How a scene was drawn."""
    scene, recipe, split = drawn.scene, data_set.recipe, data_set.split_of(number)
    stock = data_set.stocks[split]
    meshes = [stock.meshes[place] for place in drawn.prototypes]
    light: dict[str, Plain] = {}
    if drawn.light is not None and stock.maps is not None:
        turned = {"rotation": drawn.light.rotation, "scale": drawn.light.scale}
        light |= {"map": stock.maps[drawn.light.number], **turned}
    if "light" in recipe.layers and isinstance(scene.light, EnvironmentMap):
        light["sh"] = _numbers(scene.light.sh(LIGHT_ORDER))
    return {
        "number": number,
        "split": split,
        "camera": camera_table(scene.camera),
        "bodies": [_placed(body, mesh) for body, mesh in zip(scene.bodies, [*meshes, "ground"], strict=True)],
        "light": light,
    }


def _placed(body: Body, mesh: str) -> dict[str, Plain]:
    albedo = None if body.texture is not None else _numbers(body.albedo)
    place = {"rotation": body.rotation.tolist(), "translation": body.translation.tolist(), "scale": float(body.scale)}
    return {"mesh": mesh, "albedo": albedo, **place}


def _numbers(values: np.ndarray) -> Plain:
    """The shortest numbers that read back as the same float32."""
    return [_numbers(row) for row in values] if values.ndim else float(str(values))


# ---------------------------------------------------------------------------------------------- reading


def read_shard(path: AnyPath) -> Iterator[Sample]:
    """Read the samples of a shard, one after another.

    Args:
        path: A .tar file that :func:`warpshadow.dataset.write_shards` wrote.

    Raises:
        ValueError: for what is not a shard, or is damaged.
        FileNotFoundError: for a file that is not there.
    """
    path = check.file("path", path)
    with check.located(str(path)):
        try:
            with tarfile.open(path) as archive:
                content = ((member.name, archive.extractfile(member)) for member in archive)
                files = ((name, stream.read()) for name, stream in content if stream is not None)
                for key, group in itertools.groupby(files, lambda file: file[0].partition(".")[0]):
                    yield _sample(key, {name.partition(".")[2]: bits for name, bits in group})
        except tarfile.TarError as error:
            raise ValueError(f"not a shard, or a damaged one ({error})") from error


def _sample(key: str, files: dict[str, bytes]) -> Sample:
    if "json" not in files:
        raise ValueError(f"{key}: got {', '.join(files)}, expected a .json file")
    channels = exr_channels(files["exr"]) if "exr" in files else {}
    spheres = np.load(io.BytesIO(files["spheres.npy"])) if "spheres.npy" in files else None
    return Sample(key, channels, spheres, json.loads(files["json"]))
