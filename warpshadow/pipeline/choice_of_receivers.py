"""The choice of receivers: bodies whose faces are large in the image are shaded by pixel, others at vertices.

Between vertices light is interpolated, which shows where a face is large. Measured on a ground of 6 × 6 units under a
sky with a sun, 256 × 256 pixels with 4 samples each, error of the image against rays, two cores:

    quads    pixels a face    at vertices    by pixel
    32²      34               5.8%           2.9%, in 3.5 times the time
    64²      9                4.0%           2.9%, in 4 times the time

A picture that is made once can afford that on its grounds and walls, where shadows' edges show most: a bunny of 64
spheres on a ground of 6 × 6 units and 64² quads, and what a whole ``ws.render`` took, of a busy machine:

    light            pixels    at vertices              by pixel
    sky with a sun   256²       3,724 points, 5.0%       31,176, 4.4%, 0.3 s longer
    sky with a sun   512²       3,735         5.2%       99,334  4.6%  0.7 s
    bare sun         256²       3,724         3.2%       31,176  2.8%  0.3 s
    bare sun         512²       3,735         3.5%       99,334  3.1%  0.2 s
"""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.assets.camera import Camera
from warpshadow.pipeline.assembly import Assembly
from warpshadow.scene.scene import AUTO, Body, Scene
from warpshadow.stages.project import to_clip
from warpshadow.stages.rasterize import rasterize

LARGE_FACE = 16.0
"""Pixels of an average face beyond which a body is shaded by pixel, in images of up to 256 × 256 pixels …"""

LARGE_SHARE = 2.0**-12
"""… and in larger images its share of them, since cost grows with pixels and the error of interpolation does not …"""

COARSE_FACE = 400.0
"""… up to so many pixels: then interpolation shows whatever it costs, and draws a warning where it was asked for."""


class Choice(NamedTuple):
    """Where light is evaluated on a body."""

    receivers: str
    """At every "vertex", or at every "pixel" that shows the body."""
    pixels_per_face: float | None
    """Pixels of an average face that is seen; None where nobody had to know."""


def choose_receivers(assembly: Assembly, cameras: Sequence[Camera]) -> list[Choice]:
    """Choose the receivers of the bodies that leave it open, as cameras see the scene.

    The same scene and cameras make the same choice, and what moves later does not change it.
    """
    wanted = [body.receivers for body in assembly.scene.bodies]
    if AUTO not in wanted:
        return [Choice(receivers, None) for receivers in wanted]
    sizes = pixels_per_face((_seen_faces(assembly, camera) for camera in cameras), assembly)
    share = LARGE_SHARE * cameras[0].width * cameras[0].height
    largest = min(max(LARGE_FACE, share), COARSE_FACE)
    chosen = np.where(sizes > largest, "pixel", "vertex").tolist()
    return [
        Choice(own if receivers == AUTO else receivers, float(size))
        for own, receivers, size in zip(chosen, wanted, sizes, strict=True)
    ]


def with_receivers(scene: Scene, choices: Sequence[Choice]) -> Scene:
    """The scene with a choice for each body in place of "auto"."""
    if all(body.receivers == choice.receivers for body, choice in zip(scene.bodies, choices, strict=True)):
        return scene
    bodies = (
        dataclasses.replace(body, receivers=choice.receivers)
        for body, choice in zip(scene.bodies, choices, strict=True)
    )
    return dataclasses.replace(scene, bodies=tuple(bodies))


def for_picture(scene: Scene) -> Scene:
    """The scene, for a picture that is made once: flat bodies that leave their receivers open are shaded by pixel.

    Interpolation between the vertices of a ground makes shadows' edges jagged.
    """
    if not any(map(_is_open_flat, scene.bodies)):
        return scene
    bodies = (dataclasses.replace(body, receivers="pixel") if _is_open_flat(body) else body for body in scene.bodies)
    return dataclasses.replace(scene, bodies=tuple(bodies))


def _is_open_flat(body: Body) -> bool:
    return body.receivers == AUTO and body.mesh.is_flat


def receiver_notes(scene: Scene, choices: Sequence[Choice]) -> list[str]:
    """Say what was chosen for each body that leaves it open, a line each."""
    return [
        f"Body {number} ({body.called!r}) has receivers at {'pixels' if choice.receivers == 'pixel' else 'vertices'}: "
        f"its faces have {choice.pixels_per_face:.2g} pixels each."
        for number, (body, choice) in enumerate(zip(scene.bodies, choices, strict=True))
        if body.receivers == AUTO and choice.pixels_per_face is not None
    ]


def pixels_per_face(images: Iterable[np.ndarray], assembly: Assembly) -> np.ndarray:
    """Pixels over the number of faces that are seen, of each body, over images of face ids, −1 for none."""
    count = len(assembly.scene.bodies)
    pixel_counts, face_counts = np.zeros((2, count))
    for face_ids in images:
        seen = face_ids[face_ids >= 0]
        pixel_counts += np.bincount(assembly.body_of_face[seen], minlength=count)
        face_counts += np.bincount(assembly.body_of_face[np.unique(seen)], minlength=count)
    return pixel_counts / np.maximum(face_counts, 1)


def _seen_faces(assembly: Assembly, camera: Camera) -> np.ndarray:
    """Face that each pixel sees of the scene, -1 for none; the bodies' spheres, which take long, need not be known."""
    device = assembly.device
    positions = np.concatenate([body.world_mesh().positions for body in assembly.scene.bodies])
    clip_matrix = wp.array([camera.clip_matrix()], dtype=wp.mat44, device=device)
    clip_positions = to_clip(wp.array(positions[None], dtype=wp.vec3, device=device), clip_matrix)
    return rasterize(clip_positions, assembly.faces, camera.width, camera.height).face_ids.numpy()
