"""Bases of light: spherical harmonics, or cells of directions. Transfer vectors belong to one of them."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from warpshadow import check
from warpshadow.assets.cells import spread_in_cells
from warpshadow.assets.known_light import HarmonicLight, as_light
from warpshadow.assets.light import EnvironmentMap, KnownLightArgument
from warpshadow.maths import sh
from warpshadow.maths.directions import CHUNK, fibonacci


@check.frozen()
@dataclass(frozen=True)
class HarmonicBasis:
    """Real spherical harmonics of an order; the coefficients [order², 3] are the light's projection.

    Coefficients are linear RGB, at index l² + l + m for band l and degree m, −l to l: orthonormal functions without the
    Condon–Shortley phase, in the scene's axes, so that the first three after the constant one point along +y, +z, +x.
    Light of radiance 1 from everywhere has √(4π) in the first and 0 in the others.

    Args:
        order: Number of bands n, 2 to 8.
    """

    order: int

    def __post_init__(self) -> None:
        sh.check_order(self.order)

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return self.order**2

    def functions(self, directions: np.ndarray) -> np.ndarray:
        """Evaluate the basis functions at unit vectors [direction, 3]: shape [direction, coefficient]."""
        return sh.evaluate(self.order, directions)

    def coefficients(self, light: KnownLightArgument) -> np.ndarray:
        """Express a map, or SH coefficients of any order [order², 3], in the basis: float32 [coefficient, 3]."""
        return as_light(light).sh(self.order).copy()

    def to_map(self, coefficients: npt.ArrayLike) -> EnvironmentMap:
        """Make a map of light in the basis, for functions that take maps alone: files, ``rotated``, the viewer, other
        renderers.

        Negative radiance becomes 0, as no map holds it, so light that rings is brighter as a map. A Scene and
        ``ws.render`` also take the coefficients themselves, exactly. Where nothing is negative,
        ``basis.coefficients(basis.to_map(c))`` is c to 0.5%.

        Args:
            coefficients: Linear RGB, shape [order², 3].
        """
        light = _checked_coefficients(self, coefficients)
        return EnvironmentMap(np.maximum(HarmonicLight(light).radiance, 0))


@check.frozen()
@dataclass(frozen=True, eq=False, init=False)
class CellBasis:
    """Cells of directions, each with the directions nearest to it; the coefficients are mean radiances.

    Coefficients are linear RGB, in the order of the directions: light of radiance 1 from everywhere has 1 in each.
    All cells count as equally large, 4π/Q, which Fibonacci directions nearly are.

    Args:
        directions: Unit vectors towards the light in the scene's axes, shape [direction, 3]; ``warpshadow.fibonacci``
            makes them.
    """

    directions: np.ndarray

    def __init__(self, directions: npt.ArrayLike):
        remedy = "warpshadow.fibonacci(128) makes 128"
        expected = f"unit vectors [direction, 3]; {remedy}"
        vectors = check.numbers("directions", directions, expected=expected, dtype=np.float64)
        check.shape("directions", vectors.shape, ("direction", 3), remedy)
        if not len(vectors) or not np.allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-3):
            raise ValueError(f"directions: got others than {expected}")
        vectors.setflags(write=False)
        object.__setattr__(self, "directions", vectors)

    def __repr__(self) -> str:
        return f"CellBasis({self.size} cells)"

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return len(self.directions)

    def functions(self, directions: np.ndarray) -> np.ndarray:
        """Evaluate the basis functions at unit vectors [direction, 3]: shape [direction, coefficient], 0 or 1."""
        return np.eye(self.size)[self.cells(directions)]

    def balanced_functions(self, directions: np.ndarray) -> np.ndarray:
        """Evaluate the functions at samples of the sphere, weighted so that all cells with a sample count alike.

        Cells hold more or fewer than their share of a few samples: of 2 on average, 1 to 4.
        """
        functions = self.functions(directions)
        return functions * (len(directions) / self.size / np.maximum(functions.sum(axis=0), 1))

    def cells(self, directions: np.ndarray) -> np.ndarray:
        """Number of the cell that each unit vector [direction, 3] is in, shape [direction]."""
        from scipy.spatial import cKDTree

        nearest: np.ndarray = cKDTree(self.directions).query(directions)[1]
        return nearest

    def coefficients(self, light: KnownLightArgument) -> np.ndarray:
        """Express a map, or SH coefficients of any order [order², 3], in the basis: float32 [coefficient, 3]."""
        return as_light(light).cells(self.directions).radiance.copy()

    def to_map(self, coefficients: npt.ArrayLike) -> EnvironmentMap:
        """Make a map of light in the basis, by which a Scene is lit, files are written, and other renderers, too.

        Each cell is evenly bright and keeps its energy: ``basis.coefficients(basis.to_map(c))`` is c to rounding.
        Negative radiance becomes 0, as no map holds it.

        Args:
            coefficients: Linear RGB, shape [direction, 3].
        """
        light = _checked_coefficients(self, coefficients)
        return EnvironmentMap(np.maximum(spread_in_cells(light, self.directions), 0))


Basis = HarmonicBasis | CellBasis


def check_basis(basis: object) -> None:
    """Raise ValueError unless it is a basis, or None; the message says how to make one."""
    if basis is not None and not isinstance(basis, (HarmonicBasis, CellBasis)):
        order = basis if check.is_integer(basis) and basis in sh.ORDERS else 5
        raise ValueError(
            f"basis: got {check.described(basis)}, expected HarmonicBasis({order}) for {order} bands of spherical "
            "harmonics, CellBasis(warpshadow.fibonacci(128)) for cells of 128 directions, or None for "
            "the method's own"
        )


def describe_coefficients(basis: Basis, count: int) -> str:
    """Describe the coefficients of a basis, for messages to callers who gave ``count`` of them."""
    basis_name = (
        f"HarmonicBasis({basis.order})" if isinstance(basis, HarmonicBasis) else f"cells of {basis.size} directions"
    )
    order = int(round(np.sqrt(count)))
    others = [f"HarmonicBasis({order})"] if order in sh.ORDERS and order**2 == count else []
    others += [f"CellBasis(warpshadow.fibonacci({count}))"] if count and not count % CHUNK else []
    remedy = f"; for {count} make the renderer with basis={' or '.join(others)}" if others else ""
    return f"coefficients in renderer.basis, {basis_name}{remedy}"


def _checked_coefficients(basis: Basis, coefficients: npt.ArrayLike) -> np.ndarray:
    """Coefficients in a basis as float64 [coefficient, 3]; ValueError for others."""
    expected = f"linear RGB in this basis [{basis.size}, 3]"
    light = check.numbers("coefficients", coefficients, expected=expected, dtype=np.float64)
    check.shape("coefficients", light.shape, (basis.size, 3))
    check.finite("coefficients", light)
    return light


def conversion(basis: Basis, other: Basis) -> np.ndarray | None:
    """The matrix M [other coefficient, coefficient] that takes light from a basis to another; None for the same.

    Transfer vectors T to the other basis become T M.
    """
    if basis is other or basis == other:
        return None
    if isinstance(other, CellBasis) and not isinstance(basis, CellBasis):
        return basis.functions(other.directions).astype(np.float32)
    # to cells: the mean of the harmonics over a cell, or how cells overlap, from many directions
    fine = fibonacci(64 * max(basis.size, other.size))
    values = other.functions(fine)
    weights = 1 / values.sum(axis=0)[:, None] if isinstance(other, CellBasis) else 4 * np.pi / len(fine)
    if not isinstance(basis, CellBasis):
        return (weights * (values.T @ basis.functions(fine))).astype(np.float32)
    from scipy.sparse import csr_matrix

    in_cells = csr_matrix((np.ones(len(fine)), (basis.cells(fine), np.arange(len(fine)))), (basis.size, len(fine)))
    return (weights * (in_cells @ values).T).astype(np.float32)
