"""Edges of an image beside a painted outline: by how much the outline is too small or too large.

A mask is often a pixel too large or too small all around: by an annotator's habit, or a segmentation's. The edge itself
is sharper. Across it the color changes most, so the energy of the change along the outline's normal n, on a short part
of the outline,

    E(x) = mean of |∂c / ∂n|² where the distance from the outline is x,

has its peak at the edge. The offset is the median of the parts' peaks: some are at the edge of a shadow, or in a
texture.
"""

import numpy as np

MAX_EDGE_OFFSET = 3.0  # farthest from an outline that an edge is searched [pixels]
_MARGIN = 1.0  # pixels beyond, whose energy tells that of no edge
_GAMMA = 1 / 2.2  # of colors: noise and contrasts are about as large in shadows as in light
_BLUR = 0.6  # of derivatives, standard deviation [pixels]
_PART = 4.0  # of an outline, standard deviation of its weights [pixels]
_WIDTH = 0.5  # of the means over distances, standard deviation [pixels]
_SPACING = 0.1  # of distances [pixels]
_HALF_PEAK = 1.5  # distance from a peak within which its middle is found [pixels]
_MIN_CONTRAST = 1.5  # of a peak and the energy elsewhere, below which a part has no edge
_MIN_SHARE = 0.1  # of an outline that must have an edge


def edge_offset(image: np.ndarray, outline: np.ndarray) -> float:
    """Distance by which an outline lies inside the image's edge [pixels]; 0 where no edge stands out.

    Masks of four photographs, made a pixel too large or too small, are so known to a tenth of a pixel; that of gray
    rocks on a gray table to half a pixel.

    Args:
        image: Linear RGB, [height, width, 3].
        outline: Mask, 0 to 1, [height, width].
    """
    from scipy.ndimage import gaussian_filter

    distances = signed_distances(outline).astype(np.float64)
    reach = MAX_EDGE_OFFSET + _MARGIN
    rows, columns = np.nonzero(np.abs(distances) < reach + 3 * _WIDTH)
    is_contour = np.abs(distances) < 0.7
    if not is_contour.any():
        return 0.0
    box = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    distances, is_contour = distances[box], is_contour[box]
    slopes = np.gradient(gaussian_filter(distances, 1.0))
    color = np.maximum(image[box], 0).astype(np.float64) ** _GAMMA
    change = sum(
        slope[..., None] * gaussian_filter(color, (_BLUR, _BLUR, 0), order=order)
        for slope, order in zip(slopes, ((1, 0, 0), (0, 1, 0)), strict=True)
    )
    energies = (change**2).sum(axis=-1) / np.maximum(sum(slope**2 for slope in slopes), 1e-6)
    offsets = np.arange(-reach, reach + _SPACING / 2, _SPACING)

    def energies_at(offset: float) -> np.ndarray:
        weights = np.exp(-0.5 * ((distances + offset) / _WIDTH) ** 2)
        means = gaussian_filter(weights * energies, _PART) / np.maximum(gaussian_filter(weights, _PART), 1e-12)
        return means[is_contour]

    energy = np.stack([energies_at(offset) for offset in offsets.tolist()])  # [offset, pixel of the contour]
    background = np.percentile(energy, 20, axis=0)
    is_searched = np.abs(offsets) <= MAX_EDGE_OFFSET
    top = energy[is_searched].max(axis=0)
    best = offsets[is_searched][energy[is_searched].argmax(axis=0)]
    has_edge = top > _MIN_CONTRAST * background
    if has_edge.mean() < _MIN_SHARE:
        return 0.0
    peaks = np.maximum(energy - (top + background) / 2, 0) * (np.abs(offsets[:, None] - best) <= _HALF_PEAK)
    middles = (offsets @ peaks)[has_edge] / peaks.sum(axis=0)[has_edge]
    return float(np.median(middles))


def moved_outline(outline: np.ndarray, offset: float) -> np.ndarray:
    """An outline moved outwards by an offset [pixels], a mask of 0 to 1, float32."""
    return np.clip(0.5 + signed_distances(outline) + offset, 0, 1).astype(np.float32)


def signed_distances(mask: np.ndarray) -> np.ndarray:
    """Distance of pixel centers from the edge of a mask [pixels], positive inside, float32 of shape [height, width].

    Where the edge crosses a pixel, the part that is covered tells its distance.
    """
    from scipy.ndimage import distance_transform_edt

    is_inside = mask >= 0.5
    if is_inside.all() or not is_inside.any():
        return np.full(mask.shape, np.hypot(*mask.shape) * (1 if is_inside.all() else -1), np.float32)
    signed_distance = distance_transform_edt(is_inside) - distance_transform_edt(~is_inside)
    signed_distance -= 0.5 * np.sign(signed_distance)
    crosses = np.abs(signed_distance) <= 0.5
    return np.where(crosses, mask - 0.5, signed_distance).astype(np.float32)
