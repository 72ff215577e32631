"""Visibility that methods find of a group of receivers."""

from typing import NamedTuple

import numpy as np
import warp as wp


class CellCoverages(NamedTuple):
    """Coverage (h, μ) of cells by blockers, vec4 of shape [batch, receiver, direction]."""

    all_cells: wp.array
    sharp_cells: wp.array | None = None  # [batch, receiver, 16]; None where no cell is sharp


class HarmonicVisibility(NamedTuple):
    """Visibility of a group in bands of spherical harmonics, past its spheres."""

    coefficients: wp.array | None  # float32 of shape [batch, receiver, order²]; None where nothing blocks


class CellVisibility(NamedTuple):
    """Visibility of a group in cells of directions: transmittances, float32 of shape [batch, receiver, cell].

    | transmittance | past | None |
    | --- | --- | --- |
    | ``_total`` | all bodies; before ``find_visibility_past_planes`` all but planes | before, without bounces |
    | ``_self`` | the receivers' body | where it is 1 |
    | ``_nonplanar`` | all bodies but planes | where no planes block, or light does not bounce |
    | ``_self_and_spheres`` | the receivers' body, and spheres | where it is 1 |
    """

    directions: np.ndarray  # of the cells, [cell, 3]
    transmittance_total: wp.array | None
    transmittance_self: wp.array | None = None
    transmittance_nonplanar: wp.array | None = None
    transmittance_self_and_spheres: wp.array | None = None
    part_coverages: CellCoverages | None = None  # by convex parts; None without any around
