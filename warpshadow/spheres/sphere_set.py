"""A set of spheres on the host."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from warpshadow import check
from warpshadow.assets import files
from warpshadow.check import AnyPath


@check.frozen()
@dataclass(frozen=True, eq=False, init=False)
class Spheres:
    """Spheres on the host, validated; the arrays are read-only copies.

    As blockers of a :class:`warpshadow.Body` they are in units and axes of its mesh, and placed in the world with it.

    Args:
        centers: Centers [units of the mesh], float32, shape [sphere, 3].
        radii: Radii [units of the mesh], not negative, float32, shape [sphere]; a radius of 0 blocks nothing.
    """

    centers: np.ndarray = field(repr=False)
    radii: np.ndarray = field(repr=False)

    def __init__(self, centers: npt.ArrayLike, radii: npt.ArrayLike):
        shapes: tuple[tuple[int | str, ...], ...] = ("sphere", 3), ("sphere",)
        for name, array, shape in zip(("centers", "radii"), (centers, radii), shapes, strict=True):
            values = check.numbers(name, array, expected=f"an array [{', '.join(map(str, shape))}]")
            check.shape(name, values.shape, shape)
            check.finite(name, values)
            values.flags.writeable = False
            object.__setattr__(self, name, values)
        if len(self.centers) != len(self.radii):
            raise ValueError(f"radii: got {len(self.radii)} radii for {len(self.centers)} centers, expected one each")
        if (self.radii < 0).any():
            raise ValueError(f"radii: got {self.radii.min()}, expected radii that are not negative")

    @classmethod
    def read(cls, path: AnyPath) -> Spheres:
        """Read an .npz file of the arrays ``centers`` and ``radii``, as ``warpshadow spheres -o`` writes it.

        Raises:
            ValueError: for a file of another format.
        """
        try:
            with np.load(path, allow_pickle=False) as arrays:
                centers, radii = arrays["centers"], arrays["radii"]
        except (KeyError, TypeError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"got {path} ({error}), expected an .npz file of centers and radii") from error
        return cls(centers, radii)

    def write(self, path: AnyPath) -> None:
        """Write an .npz file of ``centers`` and ``radii``, which a scene file's ``spheres`` reads."""
        with files.atomic_write(path) as unfinished:
            np.savez(unfinished, centers=self.centers, radii=self.radii)

    def __len__(self) -> int:
        """Number of spheres."""
        return len(self.radii)

    def __repr__(self) -> str:
        """Number of spheres."""
        return f"Spheres({len(self)})"

    def transformed(
        self, *, rotation: npt.ArrayLike | None = None, translation: npt.ArrayLike = (0, 0, 0), scale: float = 1.0
    ) -> Spheres:
        """Apply a similarity x → scale · R x + t.

        Args:
            rotation: Rotation matrix R, shape [3, 3]; None for no rotation.
            translation: Vector t [scene units], shape [3].
            scale: Factor of lengths, positive.
        Returns:
            New spheres.
        Raises:
            ValueError: when the matrix is no rotation, or a number is not finite or the scale not positive.
        """
        rotation = np.eye(3) if rotation is None else check.array("rotation", rotation, (3, 3))
        translation = check.array("translation", translation, (3,))
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4):
            raise ValueError(f"rotation: got {rotation.tolist()}, expected an orthogonal matrix")
        if not (np.isfinite(scale) and scale > 0):
            raise ValueError(f"scale: got {scale!r}, expected a positive number")
        return Spheres(scale * self.centers.astype(np.float64) @ rotation.T + translation, scale * self.radii)

    @staticmethod
    def concatenate(parts: Iterable[Spheres]) -> Spheres:
        """Put the spheres of several bodies into one set, in order."""
        parts = list(parts)
        centers = [np.zeros((0, 3), np.float32), *(part.centers for part in parts)]
        radii = [np.zeros(0, np.float32), *(part.radii for part in parts)]
        return Spheres(np.concatenate(centers), np.concatenate(radii))
