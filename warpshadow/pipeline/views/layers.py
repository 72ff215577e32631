"""Layers: further channels of an image beside color, for compositing and for data sets."""

from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.views.view import View
from warpshadow.stages.image.film import average
from warpshadow.stages.raster.interpolation import interpolate
from warpshadow.stages.raster.rasterization import rasterize
from warpshadow.stages.raster.sides import find_sides
from warpshadow.stages.silhouettes.smooth import smooth_silhouettes


class Layers(NamedTuple):
    """Layers of an image beside color.

    Depth, normals and bodies are sampled along the ray through a pixel's center, 0 (bodies: −1) where it meets none.
    Masks are means over pixels, smooth at silhouettes as the image is.
    """

    depth: np.ndarray
    """Distance along the view [scene units], so z in the camera's space; float32 of shape [height, width]."""
    normals: np.ndarray
    """Unit normals in the world, towards the camera's side of open surfaces; float32 of shape [height, width, 3]."""
    bodies: np.ndarray
    """Number of the body, from 0; int32 of shape [height, width]."""
    masks: np.ndarray
    """Part of each pixel that a body covers; float32 of shape [body, height, width]. Their sum is the coverage."""

    def __repr__(self) -> str:
        return f"Layers({self.masks.shape[-1]} × {self.masks.shape[-2]}, {self.masks.shape[-3]} bodies)"

    def channels(self) -> dict[str, np.ndarray]:
        """As channels of an OpenEXR file: ``Z``, ``N.X``, ``N.Y``, ``N.Z``, ``body``, and ``mask.0``, … by bodies."""
        normals = {f"N.{axis}": self.normals[..., k] for k, axis in enumerate("XYZ")}
        masks = {f"mask.{number}": mask for number, mask in enumerate(self.masks)}
        return {"Z": self.depth, **normals, "body": self.bodies.astype(np.float32), **masks}


class LayerArrays(NamedTuple):
    """:class:`Layers` as arrays of a device, of shape [batch, height, width]; all but bodies are differentiable."""

    depth: wp.array  # float32
    normals: wp.array  # vec3
    bodies: wp.array  # int32
    masks: list[wp.array]  # vec4: four bodies' each; 0 where there are fewer


@wp.kernel
def _take_depths(
    # in
    clip_positions: wp.array2d(dtype=wp.vec4),
    # out
    depths: wp.array2d(dtype=wp.float32),
):
    """A thread owns a vertex: w of clip space is the distance along the view."""
    batch, vertex = wp.tid()
    depths[batch, vertex] = clip_positions[batch, vertex][3]


@wp.kernel
def _orient(
    # in
    sums: wp.array3d(dtype=wp.vec3),
    signs: wp.array3d(dtype=wp.float32),
    # out
    normals: wp.array3d(dtype=wp.vec3),
):
    """A thread owns a sample: interpolated normals become unit ones, on the side that is seen."""
    batch, row, column = wp.tid()
    normals[batch, row, column] = signs[batch, row, column] * wp.normalize(sums[batch, row, column])


def find_layer_arrays(view: View, size: tuple[int, int], *, supersampling: int) -> LayerArrays:
    """Find the layers of the images of a view.

    Args:
        size: Width and height [pixels].
        supersampling: Samples of a pixel across and down.
    Differentiable: view. Depth and normals as the surface that a pixel shows moves, and not as another one comes in
    front; masks as the image is, at silhouettes.
    """
    merged_scene, call = view.merged_scene, view.call
    vertices, cameras, clip = (item.value(call) for item in (view.vertices, view.cameras, view.clip_positions))
    device = clip.device
    centers = rasterize(clip, merged_scene.faces, *size)
    if merged_scene.two_sided_faces.size:
        centers = find_sides(centers, merged_scene.faces, merged_scene.two_sided_faces, vertices, cameras)
    faces = centers.face_ids.numpy()
    depths = empty(clip.shape, dtype=wp.float32, device=device)
    launch(_take_depths, clip.shape, inputs=[clip], outputs=[depths])
    sums = interpolate(centers, merged_scene.faces, view.normals.value(call))
    is_back = np.zeros(faces.shape, bool) if centers.sides is None else centers.sides.numpy() != faces
    signs = wp.array(np.broadcast_to(np.where(is_back, -1, 1), sums.shape), dtype=wp.float32, device=device)
    normals = empty(sums.shape, dtype=wp.vec3, device=device)
    launch(_orient, sums.shape, inputs=[sums, signs], outputs=[normals])
    bodies = wp.array(_bodies_of(merged_scene, faces), dtype=wp.int32, device=device)
    return LayerArrays(
        interpolate(centers, merged_scene.faces, depths), normals, bodies, _masks(merged_scene, view, supersampling)
    )


def find_layers(view: View, size: tuple[int, int], *, supersampling: int) -> Layers:
    """Find the layers of the images of a view, as :func:`find_layer_arrays` does, with a leading batch dimension."""
    depth, normals, bodies, quartets = find_layer_arrays(view, size, supersampling=supersampling)
    masks = np.moveaxis(np.concatenate([item.numpy() for item in quartets], axis=-1), -1, 1)
    masks = masks[:, : len(view.merged_scene.scene.bodies)]
    return Layers(depth.numpy(), normals.numpy(), bodies.numpy(), masks)


def _bodies_of(merged_scene: MergedScene, face_ids: np.ndarray) -> np.ndarray:
    """Body of each face, -1 for none."""
    return np.where(face_ids >= 0, merged_scene.body_of_face[face_ids], -1)


def _masks(merged_scene: MergedScene, view: View, supersampling: int) -> list[wp.array]:
    """Part of each pixel that each body covers; four bodies at a time are the color of an image."""
    bodies = _bodies_of(merged_scene, view.fragments.face_ids.numpy())
    clip, silhouettes = view.clip_positions.value(view.call), view.silhouettes.value(view.call)
    masks = []
    for first in range(0, len(merged_scene.scene.bodies), 4):
        shows = bodies[..., None] == np.arange(first, first + 4)
        samples = wp.array(shows.astype(np.float32), dtype=wp.vec4, device=clip.device)
        masks.append(average(smooth_silhouettes(samples, silhouettes, clip), supersampling))
    return masks
