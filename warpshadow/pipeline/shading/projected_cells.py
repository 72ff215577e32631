"""Light in cells of directions: its radiance, and where in each cell it comes from."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.assets.cells import draw_in_cells, gather_cells, without_spots
from warpshadow.assets.color import LUMINANCE
from warpshadow.assets.known_light import KnownLight
from warpshadow.device.constants import constant
from warpshadow.pipeline.shading.shell_cells import ShellCells
from warpshadow.stages.planes.partial_cells import SAMPLES
from warpshadow.stages.self_visibility.sun_cells import SunCells, find_sun_cells
from warpshadow.stages.visibility.sharp_cells import MAX_RADIUS_PAST_PLANES, SharpCells, find_sharp_cells

_NEAR_SPOT = 2.0  # half-angles of a spot within which light is its own: of the pixels at a sun's edge, too


class ProjectedCells(NamedTuple):
    """Light in cells, and the directions that stand for a cell.

    | field | towards | read where |
    | --- | --- | --- |
    | ``blocking_directions`` | light of the cell, but for the spot of a sharp one | blockers are seen |
    | ``cosine_directions`` | all light of the cell | the cosine is taken |
    | ``spots`` | the brightest part of the cell | self-visibility is looked up |
    | ``sharp_cells`` | spots of sharp cells, whose shadow has an edge of its own | spheres are seen, once more |
    | ``sharp_cells_past_planes`` | likewise | planes and convex parts are seen, once more |
    | ``samples`` | light of the cell, but for such spots: eight directions drawn | planes with holes are seen |

    Of free light all but the first two are None, and both are the middles of the cells.
    """

    blocking_directions: np.ndarray  # [direction, 3]
    coefficients: wp.array | None = None  # of known light, vec3 of shape [1, direction]
    mean_directions: np.ndarray | None = None  # ``cosine_directions``, where others [direction, 3]
    spots: np.ndarray | None = None  # [direction, 3]
    half_angles: np.ndarray | None = None  # half-angles of those spots [direction]
    sharp_cells: SharpCells | None = None  # cells that a sun is in, where spheres block it
    sharp_cells_past_planes: SharpCells | None = None  # and where planes do
    spot_shares: np.ndarray | None = None  # share of the light of sharp cells that their spot has [direction]
    samples: np.ndarray | None = None  # even ones in cells without light [direction, 8, 3]
    sun: SunCells | None = None  # the brightest cells, where bodies want rays to them
    shell_cells: ShellCells | None = None  # of near light: coefficients are then radiances of these, not of cells

    @property
    def cosine_directions(self) -> np.ndarray:
        """Directions for the cosine, [direction, 3]."""
        return self.blocking_directions if self.mean_directions is None else self.mean_directions

    def with_coefficients(self, coefficients: wp.array) -> ProjectedCells:
        """Light of the same basis."""
        return self._replace(coefficients=coefficients)


def project_on_cells(
    light: KnownLight,
    cell_directions: np.ndarray,
    *,
    softness: float,
    has_planes: bool,
    wants_sun: bool,
    device: wp.DeviceLike,
) -> ProjectedCells:
    """Project known light, infinitely far away, on cells that look to where their light comes from.

    A sun is rarely in the middle of a cell.

    Args:
        light: The light.
        cell_directions: Middles of the cells, [direction, 3].
        softness: Half-width of a shadow's soft edge, in cell radii.
        has_planes: Whether planes block light, which asks for directions drawn from each cell.
        wants_sun: Whether bodies send rays to the brightest cells.
        device: Where the coefficients are.
    """
    cell_light = light.cells(cell_directions)
    coefficients = constant(cell_light.radiance[None], wp.vec3, device)
    if cell_light.spots is None or cell_light.half_angles is None:
        return ProjectedCells(cell_light.directions, coefficients, cell_light.directions)
    power = cell_light.radiance @ LUMINANCE
    find = functools.partial(find_sharp_cells, power, cell_light.spots, cell_light.half_angles, softness)
    sharp_cells, sharp_cells_past_planes = find(), find(MAX_RADIUS_PAST_PLANES)
    rest, rest_light, directions, spot_shares = light.radiance, cell_light, cell_light.directions, np.ones(len(power))
    if sharp_cells is not None and sharp_cells_past_planes is not None:
        is_sharp = (sharp_cells.slots >= 0) & (sharp_cells_past_planes.slots >= 0)
        rest = without_spots(light.radiance, cell_light.spots[is_sharp], _NEAR_SPOT * cell_light.half_angles[is_sharp])
        rest_light = gather_cells(rest, cell_directions)
        directions = np.where(is_sharp[:, None], rest_light.directions, directions)
        spot_shares[is_sharp] = 1 - (rest_light.radiance @ LUMINANCE)[is_sharp] / power[is_sharp]
    draw = functools.partial(draw_in_cells, light.radiance, cell_directions)
    return ProjectedCells(
        directions,
        coefficients,
        cell_light.directions,
        cell_light.spots,
        cell_light.half_angles,
        sharp_cells,
        sharp_cells_past_planes,
        spot_shares=spot_shares,
        samples=_samples(rest, rest_light.radiance, cell_directions) if has_planes else None,
        sun=find_sun_cells(power, draw) if wants_sun else None,
    )


def _samples(radiance: np.ndarray, of_cells: np.ndarray, cell_directions: np.ndarray) -> np.ndarray:
    """Directions drawn from the light of a map in each cell, [direction, 8, 3]; even ones in a dark cell."""
    numbers = np.arange(len(cell_directions))
    samples = draw_in_cells(np.ones_like(radiance), cell_directions, numbers, SAMPLES)
    lit_cells = np.flatnonzero(of_cells @ LUMINANCE > 0)
    samples[lit_cells] = draw_in_cells(radiance, cell_directions, lit_cells, SAMPLES)
    return samples
