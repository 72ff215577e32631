"""Float64 twins of the library's formulas, written from the design and from SciPy, not from the library's code.

Nothing here imports warpshadow. Arrays of receivers and spheres broadcast: [vertex, 1, 3] against [sphere, 3].
"""

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.special import eval_legendre, roots_legendre, sph_harm_y

UNIT = np.sqrt(4 * np.pi)
"""The coefficient of the constant function 1."""

# ------------------------------------------------------------------------------------------ spherical harmonics


def harmonics(order, directions):
    """Real harmonics without Condon–Shortley phase from SciPy's complex ones, [..., order²]."""
    directions = np.asarray(directions, np.float64)
    theta = np.arctan2(np.hypot(directions[..., 0], directions[..., 1]), directions[..., 2])
    phi = np.arctan2(directions[..., 1], directions[..., 0])
    columns = []
    for band in range(order):
        for m in range(-band, band + 1):
            value = sph_harm_y(band, abs(m), theta, phi) * (-1) ** m
            columns.append(value.real if m == 0 else np.sqrt(2) * (value.real if m > 0 else value.imag))
    return np.stack(columns, axis=-1)


def sphere_quadrature(size):
    """Directions and weights that integrate polynomials up to degree 2·size − 1."""
    z, weight = roots_legendre(size)
    phi = np.pi * (np.arange(2 * size) + 0.25) / size
    ring = np.sqrt(1 - z**2)[:, None]
    directions = np.stack(np.broadcast_arrays(ring * np.cos(phi), ring * np.sin(phi), z[:, None]), axis=-1)
    return directions.reshape(-1, 3), np.repeat(weight * np.pi / size, 2 * size)


class Product:
    """The SH product truncated to an order, by evaluating both factors."""

    def __init__(self, order):
        directions, self.weights = sphere_quadrature(2 * order)
        self.basis = harmonics(order, directions)

    def __call__(self, a, b):
        return ((a @ self.basis.T) * (b @ self.basis.T) * self.weights) @ self.basis


def zonal_values(order, z):
    """y_l0 at polar cosines, [..., order]."""
    return np.stack([np.sqrt((2 * k + 1) / (4 * np.pi)) * eval_legendre(k, z) for k in range(order)], axis=-1)


def turned(zonal, directions):
    """Zonal coefficients [..., order] turned to directions [..., 3]: f_lm = √(4π/(2l+1)) z_l y_lm(u)."""
    order = zonal.shape[-1]
    bands = np.array([band for band in range(order) for _ in range(2 * band + 1)])
    return np.sqrt(4 * np.pi / (2 * bands + 1)) * zonal[..., bands] * harmonics(order, directions)


# ------------------------------------------------------------------------------------------ cones and their logs


def cones(points, centers, radii):
    """Direction, cos θ and fade weight of spheres: exact from 1.01 r on, a cubic to 90° at r, faded inside of r/4."""
    offset = centers - points
    distance = np.linalg.norm(offset, axis=-1)
    ratio = distance / radii
    begin = 1.01
    cosine = np.sqrt(1 - begin**-2)
    blend = CubicHermiteSpline([1.0, begin], [0.0, cosine], [0.0, begin**-3 / cosine])
    with np.errstate(invalid="ignore", divide="ignore"):
        exact = np.sqrt(np.maximum(1 - ratio**-2.0, 0))
        directions = np.where(distance[..., None] > 0, offset / distance[..., None], 0.0)
    cosine = np.where(ratio >= begin, exact, np.where(ratio > 1, blend(np.clip(ratio, 1, begin)), 0.0))
    return directions, cosine, smoothstep(4 * ratio)


def smoothstep(t):
    t = np.clip(t, 0, 1)
    return t * t * (3 - 2 * t)


def zonal_cap(order, cosine):
    """Projection of caps' indicators: numeric integrals from cos θ to 1, exact for these polynomials."""
    node, weight = roots_legendre(order)
    cosine = np.asarray(cosine, np.float64)[..., None]
    half = (1 - cosine) / 2
    return 2 * np.pi * np.einsum("...q,...qk->...k", half * weight, zonal_values(order, cosine + half * (node + 1)))


def zonal_log(order, cosine, log, *, depth=3.0, floor=0.05):
    """Zonal log-visibility of caps: −ε inside (cap), or the logarithm of the product matrix (eigen)."""
    cap = zonal_cap(order, cosine)
    if log == "cap":
        return -depth * cap
    node, weight = roots_legendre(2 * order)
    basis = zonal_values(order, node)
    visibility = 1 - cap @ basis.T
    matrix = 2 * np.pi * np.einsum("...q,ql,qk->...lk", visibility * weight, basis, basis)
    eigenvalues, vectors = np.linalg.eigh(matrix)
    constant = vectors[..., 0, :] * UNIT
    return np.einsum("...lj,...j->...l", vectors, np.log(np.maximum(eigenvalues, floor)) * constant)


def eigen_corners(order, floor=0.05):
    """The cos θ at which an eigenvalue passes the floor: there the eigen log has a corner."""
    cosine = (np.arange(20000) + 0.5) / 20000
    node, weight = roots_legendre(2 * order)
    basis = zonal_values(order, node)
    visibility = 1 - zonal_cap(order, cosine) @ basis.T
    eigenvalues = np.linalg.eigvalsh(np.einsum("cq,ql,qk->clk", 2 * np.pi * visibility * weight, basis, basis))
    return cosine[1:][np.diff((eigenvalues < floor).sum(axis=1)) != 0]


def log_sh(points, normals, centers, radii, order, log):
    """Sum of the spheres' log-visibility, [vertex, order²]; ``normals`` None for no horizon."""
    offset = centers - points[:, None]
    directions, cosine, weight = cones(points[:, None], centers, radii)
    if normals is not None:
        height = np.einsum("vsx,vx->vs", offset, normals) / radii
        weight = weight * smoothstep((height + 1) / 0.5)
    zonal = zonal_log(order, cosine, log) * weight[..., None]
    return turned(zonal, directions).sum(axis=1)


# ------------------------------------------------------------------------------------------ exponentiation


def optimal_linear(order, norm):
    """The factors a, b of a·1 + b·f̂ that suit exp(f̂) of one cap's eigen log whose norm is ``norm``."""
    theta = np.linspace(1e-3, np.pi / 2, 4000)
    logs = zonal_log(order, np.cos(theta), "eigen")
    logs[:, 0] = 0
    norms = np.linalg.norm(logs, axis=1)
    node, weight = roots_legendre(80)
    basis = zonal_values(order, node)
    exponential = 2 * np.pi * (np.exp(logs @ basis.T) * weight) @ basis
    a = exponential[:, 0] / UNIT
    b = (exponential * logs).sum(1) / (logs**2).sum(1)
    rising = norms.argmax()
    return np.interp(norm, norms[:rising], a[:rising]), np.interp(norm, norms[:rising], b[:rising])


def exponential(f, base, threshold):
    """exp*(f) of rows [vertex, order²] by DC isolation, scaling and squaring, each row with its own p."""
    order = int(np.sqrt(f.shape[1]))
    product = Product(order)
    residual = f.copy()
    residual[:, 0] = 0
    norm = np.linalg.norm(residual, axis=1)
    with np.errstate(divide="ignore"):
        powers = np.maximum(np.ceil(np.log2(norm / threshold)), 0).astype(int)
    h = residual / 2.0 ** powers[:, None]
    one = np.eye(1, order**2) * UNIT
    if base == "quadratic":
        result = one + h + product(h, h) / 2
    elif base == "linear":
        result = one + h
    else:
        a, b = optimal_linear(order, norm / 2.0**powers)
        result = a[:, None] * one + b[:, None] * h
    for step in range(powers.max(initial=0)):
        result = np.where((step < powers)[:, None], product(result, result), result)
    return np.exp(f[:, :1] / UNIT) * result


# ------------------------------------------------------------------------------------------ directional


def transmittance(points, centers, radii, directions, softness=0.35):
    """Transmittance of spheres towards directions, [vertex, direction], by angles."""
    toward, cosine, weight = cones(points[:, None], centers, radii)
    theta = np.arccos(cosine)
    width = softness * 2 / np.sqrt(len(directions))
    low = np.cos(np.minimum(theta + width, np.pi))
    high = np.cos(np.maximum(theta - width, 0))
    opacity = np.minimum(1, 2 * np.sin(theta / 2) ** 2 / (1 - (high + low) / 2)) * weight
    result = np.ones((len(points), len(directions)))
    for s in range(len(radii)):
        step = smoothstep((toward[:, s] @ directions.T - low[:, s, None]) / (high - low)[:, s, None])
        result *= 1 - opacity[:, s, None] * step
    return result


# ------------------------------------------------------------------------------------------ scenes


def random_scene(seed, *, vertex_count=40, sphere_count=12):
    """Receivers on, in and around a cloud of spheres: points, unit normals, centers, radii, all float32."""
    rng = np.random.default_rng(seed)
    centers = rng.normal(size=(sphere_count, 3))
    radii = rng.uniform(0.05, 0.6, sphere_count)
    points = rng.normal(size=(vertex_count, 3)) * 1.5
    normals = rng.normal(size=(vertex_count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return tuple(values.astype(np.float32) for values in (points, normals, centers, radii))


def random_rotation(seed):
    """A random proper rotation [3, 3]."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)
