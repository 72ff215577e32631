"""Layers: what an image shows beside color, for programs that compose images and for data sets."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.pipeline.assembly import Assembly
from warpshadow.pipeline.view import View
from warpshadow.stages import film
from warpshadow.stages.interpolate import interpolate
from warpshadow.stages.rasterize import rasterize
from warpshadow.stages.sides import find_sides
from warpshadow.stages.silhouettes.smooth import smooth_silhouettes


class Layers(NamedTuple):
    """What an image shows beside color.

    Depth, normals and bodies are those of the point that the ray through a pixel's center meets, 0 (bodies: −1) where
    it meets none. Masks are means over pixels, smooth at silhouettes as the image is.
    """

    depth: np.ndarray
    """Distance along the view [scene units], so z in the camera's space; float32 of shape [height, width]."""
    normals: np.ndarray
    """Unit normals in the world, towards the camera's side of open surfaces; float32 of shape [height, width, 3]."""
    bodies: np.ndarray
    """Number of the body, from 0; int32 of shape [height, width]."""
    masks: np.ndarray
    """Part of each pixel that a body covers; float32 of shape [body, height, width]. Their sum is the coverage."""

    def channels(self) -> dict[str, np.ndarray]:
        """As channels of an OpenEXR file: ``Z``, ``N.X``, ``N.Y``, ``N.Z``, ``body``, and ``mask.0``, … by bodies."""
        normals = {f"N.{axis}": self.normals[..., k] for k, axis in enumerate("XYZ")}
        masks = {f"mask.{number}": mask for number, mask in enumerate(self.masks)}
        return {"Z": self.depth, **normals, "body": self.bodies.astype(np.float32), **masks}


def find_layers(view: View, size: tuple[int, int], *, across: int) -> Layers:
    """Find the layers of the images of a view, with a leading batch dimension.

    Args:
        view: What is seen.
        size: Width and height [pixels].
        across: Samples of a pixel across and down.
    """
    assembly, call = view.assembly, view.call
    vertices, cameras, clip = (each.value(call) for each in (view.vertices, view.cameras, view.clip_positions))
    centers = rasterize(clip, assembly.faces, *size)
    if assembly.two_sided_faces.size:
        centers = find_sides(centers, assembly.faces, assembly.two_sided_faces, vertices, cameras)
    faces = centers.face_ids.numpy()
    normals = interpolate(centers, assembly.faces, view.normals.value(call)).numpy()
    lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
    normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    if centers.sides is not None:
        normals[centers.sides.numpy() != faces] *= -1
    positions = wp.array(clip.numpy()[..., 3], dtype=wp.float32, device=clip.device)  # w of clip space is the distance
    depth = interpolate(centers, assembly.faces, positions).numpy()
    bodies = np.where(faces >= 0, assembly.body_of_face[faces], -1).astype(np.int32)
    return Layers(depth, normals, bodies, _masks(assembly, view, across))


def _masks(assembly: Assembly, view: View, across: int) -> np.ndarray:
    """Part of each pixel that each body covers, [batch, body, height, width]."""
    face_ids = view.fragments.face_ids.numpy()
    bodies = np.where(face_ids >= 0, assembly.body_of_face[face_ids], -1)
    clip, silhouettes = view.clip_positions.value(view.call), view.silhouettes.value(view.call)
    masks = []
    for first in range(0, len(assembly.scene.bodies), 4):  # four at a time are the color of an image
        shows = bodies[..., None] == np.arange(first, first + 4)
        samples = wp.array(shows.astype(np.float32), dtype=wp.vec4, device=clip.device)
        masks.append(film.average(smooth_silhouettes(samples, silhouettes, clip), across).numpy())
    return np.moveaxis(np.concatenate(masks, axis=-1), -1, 1)[:, : len(assembly.scene.bodies)]
