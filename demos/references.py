"""References: images by rays and paths, of the library and of Mitsuba, which are kept; and how images differ from them.

A reference is rendered twice, by other rays. Their mean stands for the truth, and half their difference is its noise.
"""

import dataclasses
import functools
import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import warpshadow as ws
from warpshadow.scene.material import GLOSS_ARGUMENTS

MIN_PIXELS = 16  # of a body, to be measured
BLOCK = 8  # pixels across
_ACROSS = 2
"""Samples across a pixel. Rays go in sixteen sets of directions, so few rays of many samples err all in the same way:
with 512, 2048 and 8192 rays a pixel a table was 1.1, 0.1 and 0.0% brighter than in Mitsuba; 4 across, 1.5 and 1.1%."""

_VERSION = 3  # part of the hash of a reference: raise it whenever one would come out differently
_MAP_ROWS = 2048  # of Mitsuba's map, whose rows lie elsewhere
_PASS = 64  # samples of Mitsuba at once


@dataclass(frozen=True)
class Reference:
    """Two independent images of a scene, and what they show.

    Args:
        images: Shape [2, height, width, 4].
        body: Body that most of a pixel's samples see, shape [height, width]; -1 for none.
        is_whole: Whether all of them do, shape [height, width].
    """

    images: np.ndarray
    body: np.ndarray
    is_whole: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """The mean of both, [height, width, 4]."""
        return self.images.mean(axis=0)

    @property
    def covered(self) -> np.ndarray:
        """Whether a pixel is wholly covered, [height, width]."""
        return (self.images[..., 3] == 1).all(axis=0)

    def noise(self) -> float:
        """Relative L2 error of the mean that is due to noise."""
        first, second = self.images[:, self.covered, :3]
        return float(np.linalg.norm(first - second) / 2 / np.linalg.norm(self.mean[self.covered, :3]))

    def error(self, image: np.ndarray) -> float:
        """Relative L2 error of an image, noise taken off."""
        truth = self.mean[self.covered, :3]
        error = np.linalg.norm(image[self.covered, :3] - truth) / np.linalg.norm(truth)
        return float(np.sqrt(max(error**2 - self.noise() ** 2, 0.0)))

    def pixels(self, number: int) -> np.ndarray:
        """Pixels of a body, [height, width]: those that show nothing else, or for thin bodies little else."""
        shown = self.covered & (self.body == number)
        whole = shown & self.is_whole
        return whole if whole.sum() >= MIN_PIXELS else shown

    def body_errors(self, image: np.ndarray, count: int) -> list[float | None]:
        """How much brighter each body is on average, relative; None for those that are hardly seen."""
        errors: list[float | None] = []
        for number in range(count):
            pixels = self.pixels(number)
            truth = self.mean[pixels, :3].mean() if pixels.sum() >= MIN_PIXELS else 0.0
            errors.append(float(image[pixels, :3].mean() / truth - 1) if truth > 0 else None)
        return errors

    def worst_block(self, image: np.ndarray) -> tuple[float, tuple[int, int]]:
        """Root mean square error of the worst block over the mean of the image, and its first row and column."""
        square = ((image - self.mean)[..., :3] ** 2).mean(axis=-1)
        square -= (((self.images[0] - self.images[1]) / 2)[..., :3] ** 2).mean(axis=-1)
        rows, columns = (length // BLOCK for length in square.shape)

        def blocks(values: np.ndarray) -> np.ndarray:
            cut = values[: rows * BLOCK, : columns * BLOCK].reshape(rows, BLOCK, columns, BLOCK)
            return cut.sum(axis=(1, 3))

        counts = blocks(self.covered)
        sums = np.where(counts >= BLOCK**2 / 2, blocks(np.where(self.covered, square, 0)) / np.maximum(counts, 1), 0)
        row, column = np.unravel_index(sums.argmax(), sums.shape)
        mean = self.mean[self.covered, :3].mean()
        return float(np.sqrt(max(sums.max(), 0.0)) / mean), (int(row) * BLOCK, int(column) * BLOCK)


@dataclass(frozen=True)
class Request:
    """A reference that is wanted.

    Args:
        scene: The scene; its visibility, supersampling and bounces do not count.
        by: "rays", of the library, or "mitsuba", or "principled": Mitsuba with its own surface of bodies that shine.
        bounces: How often light bounces.
        samples: Rays, or paths, of a pixel; half of them in each image.
        folder: Where references stay.
    """

    scene: ws.Scene
    by: str
    bounces: int
    samples: int
    folder: Path

    def path(self) -> Path:
        """Where it is kept, by a hash of all that it depends on."""
        digest, camera = hashlib.sha256(), self.scene.camera
        arrays = [self.scene.light.radiance, camera.intrinsics, camera.rotation, camera.translation]
        for body in self.scene.bodies:
            digest.update(f"{body.mesh.content_hash} {body.casts_shadow} {body.scale}".encode())
            texture = np.zeros(0) if body.texture is None else body.texture
            arrays += [body.albedo, texture, body.rotation, body.translation]
            arrays += [value for name in (*GLOSS_ARGUMENTS, "emission") if (value := getattr(body, name)) is not None]
        if self.scene.shell is not None:
            arrays.append(self.scene.shell)
        for array in arrays:
            digest.update(f"{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
        digest.update(f"{camera.width} {camera.height} {camera.near} {_ACROSS}".encode())
        digest.update(f"{self.by} {self.bounces} {self.samples} {_VERSION}".encode())
        return self.folder / f"{digest.hexdigest()[:32]}.npz"

    def reference(self) -> Reference:
        """The reference as it was kept, or made and kept."""
        path = self.path()
        if not path.exists():
            scene = dataclasses.replace(self.scene, supersampling=_ACROSS, bounces=self.bounces)
            images = _MAKERS[self.by](scene, self.samples // 2)
            path.parent.mkdir(parents=True, exist_ok=True)
            unfinished = path.with_suffix(f".{os.getpid()}.npz")
            np.savez_compressed(unfinished, images=images, **shown_bodies(scene))
            unfinished.replace(path)
        with np.load(path) as stored:
            return Reference(**stored)


def by_rays(scene: ws.Scene, samples: int) -> np.ndarray:
    """Two images by rays or paths, [2, height, width, 4].

    Samples of a pixel are pixels of a larger image, or those that see the same side of a face would share a receiver.
    """
    camera, across = scene.camera, scene.supersampling
    enlarged = camera.with_size((across * camera.width, across * camera.height))
    visibility = ws.Visibility(method="ray-traced", samples=max(1, samples // across**2))
    traced = dataclasses.replace(scene, camera=enlarged, supersampling=1, visibility=visibility)
    images = np.stack([ws.render(each, progress=False) for each in (traced, turned(traced))])
    return images.reshape(2, camera.height, across, camera.width, across, 4).mean(axis=(2, 4))


def turned(scene: ws.Scene, share: float = 0.382) -> ws.Scene:
    """The same scene turned about the y axis with its camera and its light, which turns by whole columns."""
    from scipy.spatial.transform import Rotation

    columns = scene.light.radiance.shape[1]
    shift = round(share * columns)
    degrees = -360 * shift / columns  # columns run from -z over +x
    turn = Rotation.from_euler("y", degrees, degrees=True)
    shell = {"radius": scene.light.radius, "center": turn.apply(np.array(scene.light.center))}
    light = ws.EnvironmentMap(np.roll(scene.light.radiance, shift, axis=1), **shell)
    bodies = [
        dataclasses.replace(
            body,
            rotation=(turn * Rotation.from_matrix(body.rotation_matrix())).as_rotvec(degrees=True),
            translation=turn.apply(np.array(body.translation)),
        )
        for body in scene.bodies
    ]
    camera = dataclasses.replace(scene.camera, rotation=scene.camera.rotation @ turn.inv().as_matrix())
    return dataclasses.replace(scene, bodies=bodies, light=light, camera=camera)


def shown_bodies(scene: ws.Scene) -> dict[str, np.ndarray]:
    """What a reference keeps of bodies: ``body`` and ``is_whole``."""
    unshadowed = dataclasses.replace(scene, visibility=ws.Visibility(method="none"), bounces=0)
    ids = ws.Renderer(unshadowed, progress=False).body_ids()[0]
    height, width = scene.camera.height, scene.camera.width
    samples = ids.reshape(height, _ACROSS, width, _ACROSS).swapaxes(1, 2).reshape(height, width, -1)
    counts = np.stack([(samples == number).sum(axis=-1) for number in range(-1, len(scene.bodies))])
    return {"body": (counts.argmax(axis=0) - 1).astype(np.int16), "is_whole": counts.max(axis=0) == _ACROSS**2}


def by_mitsuba(scene: ws.Scene, samples: int, gloss: str = "gltf") -> np.ndarray:
    """Two images by Mitsuba's path integrator, [2, height, width, 4]."""
    import mitsuba as mi

    from demos.benchmarks.mitsuba_fits import RayTracer

    enlarged = max(1, _MAP_ROWS // len(scene.light.radiance))
    light = ws.EnvironmentMap(scene.light.radiance.repeat(enlarged, axis=0).repeat(enlarged, axis=1))
    integrator = {"type": "path", "max_depth": scene.bounces + 2, "rr_depth": 1000}
    tracer = RayTracer(dataclasses.replace(scene, light=light), integrator, gloss)
    passes = max(1, samples // _PASS)
    size = min(samples, _PASS)
    images = [
        np.mean([np.array(mi.render(tracer.scene, spp=size, seed=passes * half + k)) for k in range(passes)], axis=0)
        for half in (0, 1)
    ]
    unshadowed = dataclasses.replace(scene, visibility=ws.Visibility(method="none"), bounces=0)
    coverage = ws.render(unshadowed, progress=False)[..., 3]
    return np.stack([np.dstack([image[..., :3], coverage]) for image in images]).astype(np.float32)


_MAKERS: dict[str, Callable[[ws.Scene, int], np.ndarray]] = {
    "rays": by_rays,
    "mitsuba": by_mitsuba,
    "principled": functools.partial(by_mitsuba, gloss="principled"),
}
