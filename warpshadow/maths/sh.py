"""Real spherical harmonics: orthonormal, no Condon–Shortley phase, coefficient of band l and degree m at l² + l + m.

With that sign convention band 1 is (y, z, x)·√(3/4π). The order n is the number of bands, so an expansion has
n² coefficients:

    i   0        1 2 3          4 5 6 7 8          9 …
    l   0        1 1 1          2 2 2 2 2          3 …
    m   0       −1 0 1         −2 −1 0 1 2        −3 …

Functions are NumPy in float64; sh_kernels.py has the kernels' versions.
"""

import functools
from typing import NamedTuple

import numpy as np

from warpshadow import check

ORDERS = range(2, 9)  # orders (numbers of bands) that the kernels are made for


def check_order(order: int) -> None:
    """Raise ValueError unless ``order`` is a number of bands that the kernels are made for."""
    if not check.is_integer(order) or order not in ORDERS:
        raise ValueError(f"order: got {order!r}, expected a number of bands from {ORDERS[0]} to {ORDERS[-1]}")


# ---------------------------------------------------------------------------------------------- evaluation


@functools.cache
def schmidt_recurrence(order: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coefficients that raise the band of Schmidt semi-normalized Legendre functions S_lm, √(4π/(2l+1)) of the basis.

        S_mm = diagonal[m] (1 − z²)^{m/2},    S_{l+1,m} = up[l,m] z S_lm − back[l,m] S_{l−1,m}

    Returns:
        diagonal [order], up [order, order], back [order, order].
    """
    diagonal = np.ones(order)
    for m in range(1, order):
        diagonal[m] = diagonal[m - 1] * np.sqrt((2 * m - 1) / (2 * m)) * (np.sqrt(2) if m == 1 else 1)
    band, degree = np.tril_indices(order)
    sqrt_term = np.sqrt((band + 1.0) ** 2 - degree**2)
    up, back = np.zeros((2, order, order))
    up[band, degree] = (2 * band + 1) / sqrt_term
    back[band, degree] = np.sqrt(band**2.0 - degree**2) / sqrt_term
    return diagonal, up, back


def evaluate(order: int, directions: np.ndarray) -> np.ndarray:
    """Evaluate the basis.

    Args:
        order: Number of bands n, 1 or more.
        directions: Unit vectors, shape [..., 3].
    Returns:
        y_lm at every direction, shape [..., order²], float64.
    """
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    diagonal, up, back = schmidt_recurrence(order)
    basis = np.empty((*z.shape, order**2))
    cosine, sine = np.ones_like(z), np.zeros_like(z)
    for m in range(order):
        previous, legendre = np.zeros_like(z), np.full_like(z, diagonal[m])
        for band in range(m, order):
            norm = np.sqrt((2 * band + 1) / (4 * np.pi))
            basis[..., band**2 + band - m] = norm * legendre * sine
            basis[..., band**2 + band + m] = norm * legendre * cosine
            previous, legendre = legendre, up[band, m] * z * legendre - back[band, m] * previous
        cosine, sine = cosine * x - sine * y, cosine * y + sine * x
    return basis


def band_of(order: int) -> np.ndarray:
    """Band l of every coefficient, shape [order²]."""
    return np.repeat(np.arange(order), 2 * np.arange(order) + 1)


# ---------------------------------------------------------------------------------------------- projection


class Quadrature(NamedTuple):
    """Directions [direction, 3] and weights [direction] that integrate over the sphere."""

    directions: np.ndarray
    weights: np.ndarray


@functools.cache
def quadrature(degree: int) -> Quadrature:
    """Product quadrature, exact for polynomials up to ``degree``: Gauss–Legendre in z, uniform in azimuth."""
    z, weight = np.polynomial.legendre.leggauss(degree // 2 + 1)
    azimuth = 2 * np.pi * np.arange(degree + 1) / (degree + 1)
    radius = np.sqrt(1 - z**2)[:, None]
    rings = np.broadcast_arrays(radius * np.cos(azimuth), radius * np.sin(azimuth), z[:, None])
    weights = np.repeat(weight * 2 * np.pi / (degree + 1), degree + 1)
    return Quadrature(np.stack(rings, axis=-1).reshape(-1, 3), weights)


def equirectangular_directions(height: int) -> np.ndarray:
    """Directions of the pixel centers of an equirectangular map, shape [height, 2·height, 3].

    Pixel (row, col) looks along d = (sin φ sin θ, cos θ, −cos φ sin θ), θ = π(row+½)/H, φ = 2π(col+½)/W.
    """
    theta = np.pi * (np.arange(height) + 0.5)[:, None] / height
    phi = np.pi * (np.arange(2 * height) + 0.5)[None, :] / height
    sine = np.sin(theta)
    return np.stack(np.broadcast_arrays(np.sin(phi) * sine, np.cos(theta), -np.cos(phi) * sine), axis=-1)


def pixel_solid_angles(height: int) -> np.ndarray:
    """Solid angle of one pixel of each row of an equirectangular map [sr], shape [height]; a map sums to 4π."""
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    return np.pi / height * (edges[:-1] - edges[1:])


def project_map(pixels: np.ndarray, order: int) -> np.ndarray:
    """Project an equirectangular map, constant over each pixel, onto the basis.

    About the map's own axis, +y, the basis is a product, so its integral over a pixel is, too: over polar angles by
    Gauss–Legendre quadrature, exact to rounding for maps of any height, and over azimuth in closed form,
    ∫ cos mφ dφ = Δ sinc(mΔ/2) cos mφ at the middle of a column of width Δ. Coefficients are then turned to the axis +z.

    Args:
        pixels: Map, shape [height, 2·height, channel].
        order: Number of bands n.
    Returns:
        Coefficients, shape [order², channel], float64.
    """
    height = pixels.shape[0]
    check.shape("pixels", pixels.shape, (height, 2 * height, "channel"))
    band = band_of(order)
    degree = np.arange(order**2) - band**2 - band

    node, weight = np.polynomial.legendre.leggauss(2 * order + 8)
    theta = np.pi / height * (np.arange(height)[:, None] + (node + 1) / 2)
    meridian = np.stack([np.sin(theta), np.zeros_like(theta), np.cos(theta)], axis=-1)  # where cos mφ is 1
    legendre = evaluate(order, meridian)[..., band**2 + band + np.abs(degree)]
    polar = np.einsum("hn,hnk->hk", np.pi / (2 * height) * weight * np.sin(theta), legendre)

    m = np.arange(1 - order, order)[:, None]
    phase = np.abs(m) * np.pi * (np.arange(2 * height) + 0.5) / height
    azimuth = np.pi / height * np.sinc(m / (2 * height)) * np.where(m < 0, np.sin(phase), np.cos(phase))
    rows = np.stack([azimuth @ row.astype(np.float64) for row in pixels])  # one at a time: float64 is twice as large
    coefficients = np.einsum("hk,hkc->kc", polar, rows[:, order - 1 + degree])

    own_from_map = np.array([[0, 1, 0], [0, 0, 1], [-1, 0, 0]])  # of (cos φ sin θ, sin φ sin θ, cos θ), a direction
    return harmonic_rotation(order, own_from_map) @ coefficients


def reconstruct_map(coefficients: np.ndarray, height: int) -> np.ndarray:
    """Evaluate an expansion over an equirectangular map.

    Args:
        coefficients: Shape [order², channel].
        height: Rows of the map, which has twice as many columns.
    Returns:
        Pixels, shape [height, 2·height, channel], float64; band-limited, so it may be negative.
    """
    order = order_of("coefficients", coefficients)
    rows = equirectangular_directions(height)
    return np.stack([evaluate(order, row) @ coefficients for row in rows])


def order_of(name: str, coefficients: np.ndarray) -> int:
    """Order n of coefficients of shape [order², ...]; ValueError where the length is no square."""
    order = int(round(np.sqrt(len(coefficients))))
    if order < 1 or order**2 != len(coefficients):
        raise ValueError(f"{name}: got {len(coefficients)} coefficients, expected a square number (order²)")
    return order


def clamped_cosine(order: int) -> np.ndarray:
    """Zonal coefficients of max(z, 0), shape [order]; odd bands above the first vanish."""
    z, weight = np.polynomial.legendre.leggauss(order + 1)
    z, weight = (z + 1) / 2, weight / 2  # onto [0, 1], where the integrand is a polynomial
    return 2 * np.pi * (weight * z) @ zonal_basis(order, z)


def zonal_basis(order: int, z: np.ndarray) -> np.ndarray:
    """The zonal functions y_l0 at polar cosine ``z`` [...], shape [..., order]."""
    norm = np.sqrt((2 * np.arange(order) + 1) / (4 * np.pi))
    return np.polynomial.legendre.legvander(z, order - 1) * norm


# ---------------------------------------------------------------------------------------------- rotation


def harmonic_rotation(order: int, rotation: np.ndarray) -> np.ndarray:
    """Matrix that turns coefficients as ``rotation`` turns directions, block-diagonal in the bands.

    Args:
        order: Number of bands n.
        rotation: Orthogonal matrix R, shape [3, 3].
    Returns:
        Shape [order², order²]: if f' = M f, then f'(R d) = f(d).
    """
    directions, weights = quadrature(2 * order - 2)
    rotated_values = evaluate(order, directions @ np.asarray(rotation, np.float64).T)
    return (rotated_values * weights[:, None]).T @ evaluate(order, directions)


@functools.cache
def rotation_generators(order: int) -> np.ndarray:
    """Generators G of rotations about x, y and z: turned on by a small δ, coefficients change by Σ_a δ_a G_a f.

    About z, cos mφ becomes cos m(φ − δ), and sin mφ sin m(φ − δ). The others are that, with z turned to their axis.

    Args:
        order: Number of bands n.
    Returns:
        Shape [3, order², order²].
    """
    band = band_of(order)
    degree = np.arange(order**2) - band**2 - band
    about_z = np.zeros((order**2, order**2))
    about_z[np.arange(order**2) - 2 * degree, np.arange(order**2)] = degree
    axis_rotations = np.roll(np.eye(3), 1, axis=0), np.roll(np.eye(3), 2, axis=0), np.eye(3)  # z to x, to y, and to z
    basis_rotations = [harmonic_rotation(order, turn) for turn in axis_rotations]
    return np.stack([turn @ about_z @ turn.T for turn in basis_rotations])


# ---------------------------------------------------------------------------------------------- products


class TripleProducts(NamedTuple):
    """The non-zero Γ_ijk = ∫ y_i y_j y_k, sorted by k; entries of k are at first[k] … first[k+1]."""

    first: np.ndarray
    i: np.ndarray
    j: np.ndarray
    value: np.ndarray


@functools.cache
def triple_product_tensor(order: int) -> np.ndarray:
    """Γ_ijk of the basis by exact quadrature, dense, shape [order², order², order²]."""
    directions, weights = quadrature(3 * (order - 1))
    basis = evaluate(order, directions)
    pairs = (basis[:, :, None] * basis[:, None, :]).reshape(len(weights), -1)
    tensor = (pairs.T @ (basis * weights[:, None])).reshape([order**2] * 3)
    tensor[np.abs(tensor) < 1e-12] = 0.0
    return tensor


def triple_products(order: int, bands_of_j: tuple[int, ...] | None = None, symmetric: bool = False) -> TripleProducts:
    """Sparse Γ_ijk for kernels.

    Args:
        order: Number of bands n.
        bands_of_j: Keep only these bands of the second factor (a clamped cosine has few).
        symmetric: For squares: keep i ≤ j only and double the off-diagonal entries.
    """
    tensor = triple_product_tensor(order)
    if bands_of_j is not None:
        tensor = tensor * np.isin(band_of(order), bands_of_j)[None, :, None]
    if symmetric:
        tensor = np.triu(tensor.transpose(2, 0, 1)).transpose(1, 2, 0)
        tensor = tensor * (2 - np.eye(order**2))[:, :, None]
    k, i, j = np.nonzero(tensor.transpose(2, 0, 1))
    first = np.searchsorted(k, np.arange(order**2 + 1))
    return TripleProducts(first, i, j, tensor[i, j, k])
