"""Geometry: the vertices and spheres of all bodies, which poses move and shapes change."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy.typing as npt
import warp as wp

from warpshadow.device.batch import concatenate

Array = TypeVar("Array")  # element type of a geometry: Warp's arrays, or tensors

Other = TypeVar("Other")


@dataclass(frozen=True, eq=False)
class Geometry(Generic[Array]):
    """Movable geometry: the vertices of all bodies, and the spheres that represent them.

    Args:
        positions: Vertices [scene units], vec3 of shape [batch, vertex].
        centers: Spheres' centers [scene units], vec3 of shape [batch, sphere].
        radii: Spheres' radii [scene units], float32 of shape [batch, sphere].
        moving: Bodies that differ from the scene's, from 0; None where any may. The others are the same in every
            instance, and no gradient to them is asked for.
        rotations: How each body is turned from its mesh, mat33 of shape [batch, body]; None where that is not known.
            Whoever changes the shape of a body in another way than by :meth:`Renderer.deformed` leaves them out.
        deformed: Bodies whose shape is not that of their mesh, from 0.
    """

    positions: Array
    centers: Array
    radii: Array
    moving: tuple[int, ...] | None = field(default=None, kw_only=True)
    rotations: Array | None = field(default=None, kw_only=True)
    deformed: tuple[int, ...] = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        """Hold the bodies in order."""
        if self.moving is not None:
            object.__setattr__(self, "moving", tuple(sorted(set(self.moving))))
        object.__setattr__(self, "deformed", tuple(sorted(set(self.deformed))))

    def arrays(self) -> dict[str, Array]:
        """The arrays of the bodies, by name."""
        return {"positions": self.positions, "centers": self.centers, "radii": self.radii}

    def map(self, function: Callable[[Array], Other]) -> "Geometry[Other]":
        """Apply a function to each array and return the geometry of the results."""
        return self.with_arrays(tuple(map(function, self.all_arrays())))

    def all_arrays(self) -> tuple[Array, ...]:
        """The arrays of the bodies, and their rotations if these are known."""
        return (*self.arrays().values(), *([] if self.rotations is None else [self.rotations]))

    def with_arrays(self, arrays: "tuple[Other, ...]") -> "Geometry[Other]":
        """The geometry with others in place of :meth:`all_arrays`."""
        rotations = None if self.rotations is None else arrays[3]
        return Geometry(*arrays[:3], moving=self.moving, rotations=rotations, deformed=self.deformed)


PLACED = "placed(…) makes a geometry of poses"  # message for arrays that do not form a geometry
CENTER = "center"  # of pivots: the middle of the bounds of a body's mesh

Pivot = str | npt.ArrayLike | wp.array | None
"""Pivots of the bodies, each in its own space: "center", a point, or one for each body; None: the origin."""

GEOMETRY_DTYPES = {"positions": wp.vec3, "centers": wp.vec3, "radii": wp.float32}
"""Dtypes of a geometry's arrays, by their names."""


def as_geometry(name: str, value: object) -> Geometry:
    """A geometry as it is, and a plain tuple of its arrays as one in which any body may move.

    Raises:
        ValueError: for anything else, by the name of the argument.
    """
    if isinstance(value, Geometry):
        return value
    if not isinstance(value, (tuple, list)) or len(value) != len(GEOMETRY_DTYPES):
        count = f" of {len(value)}" if isinstance(value, (tuple, list)) else ""
        raise ValueError(
            f"{name}: got {type(value).__name__}{count}, expected a Geometry, as placed and deformed return, or a "
            f"tuple of {', '.join(GEOMETRY_DTYPES)}"
        )
    return Geometry(*value)


def splice(whole: wp.array, ranges: Sequence[tuple[int, int]], part_of: Callable[[int, int], wp.array]) -> wp.array:
    """Replace ranges of items of a whole array by parts.

    Args:
        whole: Shape [batch, item].
        ranges: Where each range begins and ends, rising.
        part_of: Returns the replacement of a range, shape [batch, item], given its begin and end.
    Returns:
        Shape [batch, item], memory of its own; batches of 1 serve every instance of the others.
    Differentiable: whole, where no part replaces it, and the parts.
    """
    pieces, last = [] if ranges else [whole], 0
    for first, end in ranges:
        pieces += [whole[:, last:first]] if first > last else []
        pieces.append(part_of(first, end))
        last = end
    pieces += [whole[:, last:]] if ranges and last < whole.shape[1] else []
    return concatenate(pieces, [piece.shape[1] for piece in pieces])
