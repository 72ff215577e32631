"""Seen texels: which parts of textures images show, and how to fill the others."""

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch
from warpshadow.device.memory import zeros
from warpshadow.stages.textures.footprint import Footprints
from warpshadow.stages.textures.pyramid import Textures, gather_levels
from warpshadow.stages.textures.sample import add_to_texels


def seen_texels(textures: Textures, footprints: Footprints) -> list[np.ndarray]:
    """Sum the weights of each texel in the samples of all images that see it.

    Args:
        textures: The textures; only their sizes matter.
        footprints: Of the samples, from :func:`warpshadow.stages.textures.footprint.find_footprints`.
    Returns:
        For each texture the weights of its texels, float32 of shape [batch, height, width]: 0 where none sees the
        texel, and small where it is only seen as a part of a coarser level.
    """
    device = footprints.uvs.device
    batch_count = common_batch({"textures": textures.texels, "footprints": footprints.uvs})
    weights = zeros(textures.texels.shape, dtype=wp.vec3, device=device)
    ones = wp.ones((batch_count, *footprints.uvs.shape[1:]), dtype=wp.vec3, device=device)
    add_to_texels(weights, textures, footprints, ones)
    images = [zeros((weights.shape[0], *size), dtype=wp.vec3, device=device) for size in textures.sizes]
    gather_levels(weights, images, textures.sizes, coarsest=footprints.coarsest_level())
    return [image.numpy()[..., 0].copy() for image in images]


def fill_unseen(texture: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Give texels that were never seen the color of the nearest one that was, so that seams do not bleed.

    Args:
        texture: Linear RGB, shape [height, width, 3].
        weights: Weight of each texel in the images (:func:`seen_texels`), shape [height, width].
    Returns:
        The texture, filled, shape [height, width, 3]; unchanged where no texel was seen.
    """
    from scipy.ndimage import distance_transform_edt

    check.shape("texture", texture.shape, ("height", "width", 3))
    check.shape("weights", weights.shape, texture.shape[:2])
    if not weights.any():
        return texture.copy()
    row, column = distance_transform_edt(weights == 0, return_distances=False, return_indices=True)
    return texture[row, column]
