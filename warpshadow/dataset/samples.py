"""Samples: an image and its labels, as files of a shard; written and read.

A sample has a key, the number of its image in nine digits, and these files:

    KEY.exr          layers of pixels, as channels; or, where the recipe says so, KEY.color.png, KEY.depth.png, …
    KEY.spheres.npy  the bodies' spheres, float32 of shape [sphere, 5]: center, radius, number of the body
    KEY.json         how the scene was drawn; README.md lists its keys
"""

import io
import itertools
import json
import tarfile
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from warpshadow import check
from warpshadow.assets.image import exr_bytes, exr_channels
from warpshadow.check import AnyPath
from warpshadow.dataset.data_set import DataSet
from warpshadow.dataset.layers import LAYERS, LazyLayers
from warpshadow.dataset.png import Channels, as_png, from_png
from warpshadow.dataset.recipe import Plain
from warpshadow.scene.body import Body
from warpshadow.scene.files import camera_table
from warpshadow.scene.material import GLOSS_ARGUMENTS
from warpshadow.scene.random_scenes import DrawnScene
from warpshadow.scene.scene import Scene
from warpshadow.spheres import Spheres

LIGHT_ORDER = 4  # bands of the coefficients that a sample has of its light


class Sample(NamedTuple):
    """An image and its labels, as read from a shard."""

    key: str
    """Number of the image, in nine digits."""
    channels: dict[str, np.ndarray]
    """Layers of pixels, float32 of shape [height, width], by their channels; the same of EXR and PNG."""
    spheres: np.ndarray | None
    """float32 of shape [sphere, 5]: center, radius [scene units], number of the body; None where the layer is not."""
    scene: dict[str, Plain]
    """Random choices of the scene."""

    @property
    def color(self) -> np.ndarray:
        """Linear RGB, premultiplied, and coverage, float32 of shape [height, width, 4]; of the layer "color".

        Raises:
            ValueError: where that layer is not.
        """
        if "R" not in self.channels:
            raise ValueError(
                f'channels: got {", ".join(self.channels) or "none"}, expected R, G, B, A, of the layer "color"'
            )
        return np.stack([self.channels[name] for name in "RGBA"], axis=-1)


def render_sample(data_set: DataSet, number: int) -> dict[str, bytes]:
    """Render an image of a data set: its files, by the ends of their names.

    The bits depend on the recipe, the number, and the content of the scene's meshes and maps; neither on earlier
    renders nor on the number of threads.
    """
    recipe, drawn_scene = data_set.recipe, data_set.draw(number)
    lazy_layers = LazyLayers(drawn_scene.scene, data_set.device, recipe.ranges.count[1] + 1)
    result = {name: layer.find(lazy_layers) for name, layer in LAYERS.items() if name in recipe.layers}
    record, files = _scene_record(data_set, number, drawn_scene), {}
    if result and recipe.format == "exr":
        files["exr"] = exr_bytes({name: values for layer in result.values() for name, values in layer.items()})
    elif result:
        files, record["png"] = _pictures(result)
    if "spheres" in recipe.layers:
        stream = io.BytesIO()
        np.save(stream, _spheres(drawn_scene.scene))
        files["spheres.npy"] = stream.getvalue()
    files["json"] = json.dumps(record, ensure_ascii=False).encode()
    return files


def _pictures(result: dict[str, Channels]) -> tuple[dict[str, bytes], dict[str, Plain]]:
    """PNG files of layers, by suffix; and the range of the codes of each."""
    files: dict[str, bytes] = {}
    codings: dict[str, Plain] = {}
    for name, channels in result.items():
        for ending, png_channels in LAYERS[name].pictures(name, channels).items():
            files[ending], codings[ending] = as_png(png_channels, LAYERS[name].coding)
    return files, codings


def _spheres(scene: Scene) -> np.ndarray:
    """Spheres of the bodies in the world; of flat bodies there are none."""
    rows = [np.zeros((0, 5), np.float32)]
    for number, body in enumerate(scene.bodies):
        if isinstance(body.blockers, Spheres):
            placed_spheres = body.blockers.transformed(
                rotation=body.rotation_matrix(), translation=body.translation, scale=body.scale
            )
            body_numbers = np.full((len(placed_spheres), 1), number)
            rows.append(np.concatenate([placed_spheres.centers, placed_spheres.radii[:, None], body_numbers], axis=1))
    return np.concatenate(rows).astype(np.float32)


def _scene_record(data_set: DataSet, number: int, drawn_scene: DrawnScene) -> dict[str, Plain]:
    """Random choices of a scene."""
    scene, recipe, split = drawn_scene.scene, data_set.recipe, data_set.split_of(number)
    stock = data_set.stocks[split]
    meshes = [stock.meshes[prototype] for prototype in drawn_scene.prototypes]
    light: dict[str, Plain] = {}
    if drawn_scene.light is not None and stock.maps is not None:
        light_placement = {"rotation": drawn_scene.light.rotation, "scale": drawn_scene.light.scale}
        light |= {"map": stock.maps[drawn_scene.light.number], **light_placement}
    if scene.shell is not None:
        light["radius"] = float(scene.shell[3])
    if "light" in recipe.layers:
        light["sh"] = _numbers(scene.known_light.sh(LIGHT_ORDER))
    return {
        "number": number,
        "split": split,
        "camera": camera_table(scene.camera),
        "bodies": [_body_record(body, mesh) for body, mesh in zip(scene.bodies, [*meshes, "ground"], strict=True)],
        "light": light,
    }


def _body_record(body: Body, mesh: str) -> dict[str, Plain]:
    albedo = None if body.texture is not None or body.albedo.ndim > 1 else _numbers(body.albedo)
    pose_record = {
        "rotation": body.rotation.tolist(),
        "translation": body.translation.tolist(),
        "scale": float(body.scale),
    }
    gloss = {name: getattr(body, name) for name in GLOSS_ARGUMENTS if getattr(body, name) is not None}
    numbers = {name: _numbers(values[0]) if values.size == 1 else None for name, values in gloss.items()}
    return {"mesh": mesh, "albedo": albedo, **numbers, **pose_record}


def _numbers(values: np.ndarray) -> Plain:
    """The shortest numbers that read back as the same float32."""
    return [_numbers(row) for row in values] if values.ndim else float(str(values))


def read_shard(path: AnyPath) -> Iterator[Sample]:
    """Read the samples of a shard, one after another.

    Args:
        path: A .tar file that :func:`warpshadow.dataset.write_shards` wrote.
    Raises:
        ValueError: for a file that is no shard, or is damaged.
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
    scene = json.loads(files["json"])
    channels = exr_channels(files["exr"]) if "exr" in files else {}
    for ending, coding in scene.get("png", {}).items():
        if ending not in files:
            raise ValueError(f"{key}: got {', '.join(files)}, expected a .{ending} file, too")
        channels |= from_png(files[ending], coding)
    spheres = np.load(io.BytesIO(files["spheres.npy"])) if "spheres.npy" in files else None
    return Sample(key, channels, spheres, scene)
