"""Float64 twins of the library's formulas, written from the design and from SciPy, not from the library's code.

Nothing here imports warpshadow. Arrays of receivers and spheres broadcast: [vertex, 1, 3] against [sphere, 3].
"""

import functools

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


@functools.cache
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
    with np.errstate(invalid="ignore", divide="ignore"):  # spheres of radius 0 are infinitely many radii away
        ratio = np.nan_to_num(distance / radii, nan=np.inf, posinf=np.inf)
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
        with np.errstate(invalid="ignore", divide="ignore"):
            height = np.einsum("vsx,vx->vs", offset, normals) / radii
        weight = weight * smoothstep((height + 1) / 0.5)
    zonal = zonal_log(order, cosine, log) * weight[..., None]
    return turned(zonal, directions).sum(axis=1)


def multiplied_spheres(points, centers, radii, order):
    """Visibility by truncated products of the spheres' caps, one by one: what log space saves, [vertex, order²]."""
    directions, cosine, weight = cones(points[:, None], centers, radii)
    blocked = turned(zonal_cap(order, cosine) * weight[..., None], directions)
    one = np.eye(1, order**2) * UNIT
    visibility = np.repeat(one, len(points), axis=0)
    for sphere in range(len(radii)):
        visibility = Product(order)(visibility, one - blocked[:, sphere])
    return visibility


# ------------------------------------------------------------------------------------------ exponentiation


@functools.cache
def optimal_knots(order):
    """The norms of caps' eigen logs f̂, and the a and b of a·1 + b·f̂ that suit their exponentials."""
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
    return norms[:rising], a[:rising], b[:rising]


def optimal_linear(order, norm):
    """The factors a, b of a·1 + b·f̂ that suit exp(f̂) of one cap's eigen log whose norm is ``norm``."""
    norms, a, b = optimal_knots(order)
    return np.interp(norm, norms, a), np.interp(norm, norms, b)


def base_approximation(f, base, scale):
    """exp*(f scale) of rows [vertex, order²], by a base approximation with DC isolation."""
    order = int(np.sqrt(f.shape[1]))
    one = np.eye(1, order**2) * UNIT
    h = (f - f[:, :1] * np.eye(1, order**2)) * scale[:, None]
    if base == "quadratic":
        result = one + h + Product(order)(h, h) / 2
    elif base == "linear":
        result = one + h
    else:
        a, b = optimal_linear(order, np.linalg.norm(h, axis=1))
        result = a[:, None] * one + b[:, None] * h
    return np.exp(scale[:, None] * f[:, :1] / UNIT) * result


def held_square(rows, depth, quiet, loud):
    """Squares of rows [vertex, order²], held where |f̂|(⟨v²⟩ − ⟨v⟩) is between quiet and loud; None holds nothing."""
    square = Product(int(np.sqrt(rows.shape[1])))(rows, rows)
    if quiet is None:
        return square
    loudness = depth * (square[:, 0] - rows[:, 0]) / UNIT
    share = 1 - smoothstep(np.log(np.maximum(loudness / quiet, 1)) / np.log(loud / quiet))
    return rows + share[:, None] * (square - rows)


def exponential(f, base, threshold, *, quiet=6.0, loud=24.0):
    """exp*(f) of rows [vertex, order²] by DC isolation, scaling and squaring, each row with its own p.

    The base approximation passes into the square of that of half the log from 0.5 to 0.7 thresholds, so that nothing
    jumps with p. Squarings are held where |f̂|(⟨v²⟩ − ⟨v⟩) is between quiet and loud, and given up beyond; None holds
    nothing.
    """
    depth = np.hypot(np.linalg.norm(f[:, 1:], axis=1), np.maximum(f[:, 0], 0))
    with np.errstate(divide="ignore"):
        halvings = np.maximum(np.ceil(np.log2(depth / threshold)), 0).astype(int)
    powers = np.minimum(halvings, 20)
    scale = 0.5**halvings
    blend = smoothstep((scale * depth / threshold - 0.5) / 0.2)[:, None]
    squared = held_square(base_approximation(f, base, scale / 2), depth, quiet, loud)
    result = (1 - blend) * base_approximation(f, base, scale) + blend * squared
    for step in range(powers.max(initial=0)):
        result = np.where((step < powers)[:, None], held_square(result, depth, quiet, loud), result)
    return result


# ------------------------------------------------------------------------------------------ directional


def transmittance(points, centers, radii, directions, softness=0.35, footprints=(0.0, 0.0, 0.0)):
    """Transmittance of spheres towards directions, [vertex, direction], by angles; footprints are [vertex, 3]."""
    toward, cosine, weight = cones(points[:, None], centers, radii)
    theta = np.arccos(cosine)
    squared = np.maximum(np.sum((centers - points[:, None]) ** 2, axis=-1) - radii**2, 0)
    areas = np.abs(np.broadcast_to(footprints, points.shape) @ directions.T).mean(axis=1)
    spread = 5 / 12 * areas[:, None]
    spread = spread / np.maximum(squared + 2 * spread, 1e-37)
    width = np.arcsin(np.sqrt(np.sin(softness * 2 / np.sqrt(len(directions))) ** 2 + spread))
    low = np.cos(np.minimum(theta + width, np.pi))
    high = np.cos(np.maximum(theta - width, 0))
    opacity = np.minimum(1, 2 * np.sin(theta / 2) ** 2 / (1 - (high + low) / 2)) * weight
    result = np.ones((len(points), len(directions)))
    for s in range(len(radii)):
        step = smoothstep((toward[:, s] @ directions.T - low[:, s, None]) / (high - low)[:, s, None])
        result *= 1 - opacity[:, s, None] * step
    return result


def blocked_shares(points, centers, radii, directions, softness=0.35):
    """The share of each cell that each sphere blocks, [vertex, sphere, direction]."""
    alone = [
        transmittance(points, centers[s : s + 1], radii[s : s + 1], directions, softness) for s in range(len(radii))
    ]
    return 1 - np.stack(alone, axis=1)


def moment_bound(share):
    """Moment of a half-plane that covers a share of a disc of radius 1, over the disc's area; nearly."""
    u = share * (1 - share)
    return 0.96935 * u - 0.81588 * u**2 + 1.36307 * u**3


def open_share(shares, moments):
    """Share of a disc that blockers leave open, which cover shares of it, by pairs of their moments [blocker, 3]."""
    shares, moments = np.clip(shares, 0, 1), np.asarray(moments, float).reshape(-1, 3)
    bounds, is_pair = moment_bound(shares), ~np.eye(len(shares), dtype=bool)
    relation = (moments @ moments.T)[is_pair].sum() / (np.outer(bounds, bounds)[is_pair].sum() + 1e-6)
    relation = np.clip(relation, -1, 1)
    related = max(0, 1 - shares.sum()) if relation < 0 else 1 - shares.max(initial=0)
    return (1 - abs(relation)) * np.prod(1 - shares) + abs(relation) * related


def joint_coverage(shares, moments):
    """Coverage (h, μ) of a disc by blockers together."""
    share, total = 1 - open_share(shares, moments), np.clip(shares, 0, 1).sum()
    return np.append(share, np.sum(moments, axis=0) * share / total if share > 0 else np.zeros(3))


def find_proxy_radiance(radiosity, shown, weights, areas, patches):
    """Light and area that the patches of spheres show, [sphere, direction, 4]; ``patches`` lists those of a sphere."""
    table, sent = np.zeros((len(patches), shown.shape[1], 4)), weights[:, :1] * shown + 1e-4
    for row, own in zip(table, patches, strict=True):
        share = areas[own] / areas[own].sum()
        row[:, 3] = share @ sent[own] if len(own) else 0.25
        row[:, :3] = np.einsum("p,pq,pc->qc", share, sent[own], radiosity[own])
    return table


def facing_share(points, centers, radii, planes, tolerances):
    """Part of each sphere's light that receivers see by its tangent plane, [vertex, sphere]."""
    offsets = points[:, None] - centers
    heights = (offsets * planes[:, :3]).sum(axis=-1) - planes[:, 3]
    heights += tolerances[:, 0] * np.linalg.norm(offsets, axis=-1)
    return 1e-8 + (1 - 1e-8) * smoothstep(heights * tolerances[:, 1] / radii)


def sphere_light(
    points, normals, centers, radii, proxy_radiance, passing, unblocked, directions, shares=None, facing=None
):
    """Light of spheres, [vertex, 3]: a weighted mean of what they show in each cell, times what the cell lacks.

    ``shares`` are those of nodes whose centers and radii are given, where spheres merge; ``facing`` are planes and
    tolerances.
    """
    shares = blocked_shares(points, centers, radii, directions) if shares is None else shares
    distance2 = ((centers - points[:, None]) ** 2).sum(axis=-1)
    weights = shares / ((distance2 + radii**2 / 16) ** 2)[:, :, None]
    if facing is not None:
        weights = weights * facing_share(points, centers, radii, *facing)[:, :, None]
    sums = np.einsum("vsq,sqc->vqc", weights, proxy_radiance)
    is_met = sums[..., 3:] > 0
    mean = np.where(is_met, sums[..., :3] / np.where(is_met, sums[..., 3:], 1), 0)
    cosine = np.maximum(normals @ directions.T, 0)
    return np.einsum("vq,vqc->vc", 4 / len(directions) * cosine * (unblocked - passing), mean)


def merged_clusters(centers, radii):
    """Centers [cluster, 3], radii [cluster] and extents [cluster] of the clusters' spheres: moments by eigenvalues."""
    clusters = len(radii) // 4
    c, r = centers[: 4 * clusters].reshape(-1, 4, 3), radii[: 4 * clusters].reshape(-1, 4)
    share = r**3 / (r**3).sum(axis=1, keepdims=True)
    middle = np.einsum("qk,qkx->qx", share, c)
    d = c - middle[:, None]
    moments = np.einsum("qk,qkx,qky->qxy", share, d, d)
    moments += np.einsum("qk,qk,xy->qxy", share, r**2, np.eye(3)) / 5
    x, y, z = np.linalg.eigvalsh(moments).T
    shadow, total = 5.4 * np.sqrt((x * y + y * z + z * x) / 3), (r**2).sum(axis=1)
    extents = ((np.sum(d**2, axis=-1) + r**2) ** 4).sum(axis=1) ** (1 / 8)
    return middle, (shadow**-4.0 + total**-4.0) ** (-1 / 8), extents


def merging_transmittance(points, centers, radii, directions, merging, softness=0.35):
    """Transmittance of spheres that merge, [vertex, direction]: each cluster's four and its own by their shares."""
    middle, radius, extents = merged_clusters(centers, radii)
    tau = merging * 2 / np.sqrt(len(directions))
    q = (extents / np.linalg.norm(middle - points[:, None], axis=-1)) ** 2
    m = smoothstep((tau**2 - q) / (tau**2 - (0.7 * tau) ** 2))
    result = np.ones((len(points), len(directions)))
    for s in range(len(radii)):
        blocked = 1 - transmittance(points, centers[s : s + 1], radii[s : s + 1], directions, softness)
        share = 1 - m[:, s // 4] if s // 4 < len(radius) else np.ones(len(points))
        result *= 1 - share[:, None] * blocked
    for k in range(len(radius)):
        blocked = 1 - transmittance(points, middle[k : k + 1], radius[k : k + 1], directions, softness)
        result *= 1 - m[:, k, None] * blocked
    return result


# ------------------------------------------------------------------------------------------ shading


def cosine_lobes(order, normals):
    """Coefficients of max(n·ω, 0)/π around unit normals [..., 3], [..., order²]."""
    node, weight = roots_legendre(2 * order)
    z = (node + 1) / 2
    return turned((weight * z) @ zonal_values(order, z), normals)


def sh_transfer(visibility, normals):
    """Transfer vectors of SH visibility [vertex, order²]: its product with the cosine lobe."""
    order = int(np.sqrt(visibility.shape[1]))
    return Product(order)(visibility, cosine_lobes(order, normals))


def directional_transfer(visibility, normals, directions):
    """Transfer vectors of transmittance [vertex, direction]."""
    return visibility * np.maximum(normals @ directions.T, 0) * 4 / len(directions)


def form_factor_of_square(height):
    """Form factor from below the middle of a square of 2 × 2 units to it, four quarters [Hottel's formula]."""
    a = 1 / height
    return 4 * 2 * a / np.sqrt(1 + a**2) * np.arctan(a / np.sqrt(1 + a**2)) / (2 * np.pi)


# ------------------------------------------------------------------------------------------ triangles


def barycentrics(clip, x, y):
    """Perspective-correct weights, not below 0, of a clip-space triangle [3, 4] at device coordinates [...]."""
    p = clip[:, :2] - np.stack([x, y], axis=-1)[..., None, :] * clip[:, 3:]
    a, b, c = np.moveaxis(p, -2, 0)
    volumes = np.stack([u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0] for u, v in ((b, c), (c, a), (a, b))], axis=-1)
    inside = np.maximum(np.sign(volumes.sum(axis=-1, keepdims=True)) * volumes, 0)
    total = inside.sum(axis=-1, keepdims=True)
    return np.where(total > 0, inside / np.where(total > 0, total, 1), 1 / 3)


def hard_triangles():
    """Triangles at the limits, by name: clip positions [3, 4] for an image of 32 × 32 pixels, float64."""

    def on_screen(pixels, depth=0.5, w=1.0):
        x, y = 2 * np.transpose(pixels) / 32 - 1
        x, y, z, w = np.broadcast_arrays(x, y, depth, w)
        return np.stack([x * w, y * w, z * w, w], axis=-1).astype(float)

    large = np.array([[3.1, 4.2], [29.3, 6.1], [11.2, 27.7]])  # no pixel's center is on an edge
    center = np.array([16.5, 16.5])

    def sliver(height):
        return on_screen(center + [[-12.0, -height / 3], [12.0, -height / 3], [0.0, 2 * height / 3]])

    through = on_screen(large)
    through[2] = [0.3, -2.0, 0.5, -0.4]
    at_eye = on_screen(large)
    at_eye[2] = [0.4, 1.0, 0.5, 0.0]
    return {
        "ordinary": on_screen(large, w=[1.0, 3.0, 8.0]),
        "through the near plane": through,
        "with a vertex at the eye": at_eye,
        "behind the eye": -on_screen(large),
        "edge-on": on_screen([[2.5, 2.5], [16.5, 16.5], [30.5, 30.5]], w=[1.0, 2.0, 3.0]),
        "of two equal vertices": on_screen(large[[0, 1, 1]]),
        "of three equal vertices": on_screen(large[[0, 0, 0]]),
        "a sliver of 1e-2 pixels": sliver(1e-2),
        "a sliver of 1e-6 pixels": sliver(1e-6),
        "of 1e-3 pixels": on_screen(center + 1e-3 * (large - large.mean(axis=0)) / 26),
        "of 1e6 pixels": on_screen(center + 1e6 * (large - center)),
        "at a distance of 1e6": on_screen(large, depth=1e-6, w=1e6),
        "at a distance of 1e15": on_screen(large, depth=1e-15, w=1e15),
    }


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


def hard_scenes():
    """Scenes at the limits, by name: 12 points and unit normals, 6 centers, 6 radii, float64 and not yet rounded."""
    points, normals, centers, radii = (a.astype(float) for a in random_scene(0, vertex_count=12, sphere_count=6))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    own = np.arange(12) % 6
    toward = np.random.default_rng(1).normal(size=(12, 3))
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    axes = np.concatenate([np.eye(3), -np.eye(3)])

    def at(distance):
        """Each receiver so many radii from the center of a sphere of its own."""
        return centers[own] + distance * radii[own, None] * toward, normals, centers, radii

    return {
        "ordinary": (points, normals, centers, radii),
        "at the centers": at(0),
        "inside": at(0.6),
        "where spheres fade": at(0.15),
        "on the surfaces": at(1),
        "1e-7 outside": at(1 + 1e-7),
        "θ → 90°": at(1.0 + np.geomspace(1e-5, 2e-2, 12)[:, None]),
        "θ → 0°": at(np.geomspace(1e2, 1e5, 12)[:, None]),
        "1e6 radii away": at(1e6),
        "radii 0": (points, normals, centers, radii * [0, 1, 0, 1, 0, 1]),
        "radii 1e-12": (points, normals, centers, np.full(6, 1e-12)),
        "a radius of 1e6": (points, normals, np.r_[[[0, -1e6 - 0.5, 0]], centers[1:]], np.r_[1e6, radii[1:]]),
        "scaled by 1e-6": (1e-6 * points, normals, 1e-6 * centers, 1e-6 * radii),
        "scaled by 1e6": (1e6 * points, normals, 1e6 * centers, 1e6 * radii),
        "offset by 1e4": (points + 1e4, normals, centers + 1e4, radii),
        "concentric": (points, normals, 0 * centers, radii),
        "duplicates": (points, normals, 0 * centers, 0 * radii + 0.5),
        "enclosed": (0.1 * points, normals, 2 * axes, np.full(6, 1.8)),
        "along the axes": (0.2 * axes[own], axes[own[::-1]], 2 * axes, np.full(6, 0.5)),
        "zero normals": (points, normals * (own % 2)[:, None], centers, radii),
    }


def stacked_spheres(count):
    """Twelve receivers at the origin's height that see ``count`` equal spheres in one direction, at 5° to 80°."""
    angles = np.radians(np.linspace(5, 80, 12))
    points = np.array([0.6, -0.48, 0.64]) / -np.sin(angles)[:, None]
    normals = np.random.default_rng(2).normal(size=(12, 3))
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True), np.zeros((count, 3)), np.ones(count)


def random_rotation(seed):
    """A random proper rotation [3, 3]."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def central_differences(function, values, step=1e-6):
    """Gradient of a function of one array by each of its numbers."""
    gradient = np.zeros_like(values)
    for index in np.ndindex(values.shape):
        ahead, behind = values.copy(), values.copy()
        ahead[index] += step
        behind[index] -= step
        gradient[index] = (function(ahead) - function(behind)) / (2 * step)
    return gradient


def slopes(loss, value, step):
    """Gradient of a loss by a tensor, of its tape, and by central differences of each of its numbers."""
    import torch

    value = value.clone().requires_grad_()
    loss(value).backward()
    differences = []
    with torch.no_grad():
        for place in np.ndindex(*value.shape):
            shift = torch.zeros_like(value)
            shift[place] = step
            differences.append(float(loss(value + shift) - loss(value - shift)) / (2 * step))
    return value.grad.numpy().ravel(), np.array(differences)


# ------------------------------------------------------------------------------------------ gloss


def unit(vectors):
    """Vectors of length 1."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def eye_of(clip_matrix):
    """The point at which x, y and w of clip space are 0."""
    rows = clip_matrix[[0, 1, 3]]
    return -np.linalg.solve(rows[:, :3], rows[:, 3])


def lobe_samples(points, normals, roughness, clip_matrix, count, spread=None, turns=0.0):
    """Directions, (w, w'), σ and cosines of visible normals on a spiral over their cap (Dupuy and Benyoub 2023).

    A spread is (a, b), by which mirrors are wider; spirals are turned about the cap's axis.
    """
    view = unit(eye_of(clip_matrix) - points)
    mu = (view * normals).sum(axis=-1)
    tangent = unit(view - mu[..., None] * normals)
    frame = np.stack([tangent, np.cross(normals, tangent), normals], axis=-1)
    square = (roughness**4)[..., None, None] * np.eye(2)
    for vectors in () if spread is None else spread:
        flat = (vectors[..., None, :] @ frame)[..., 0, :2]
        square = square + flat[..., :, None] * flat[..., None, :] / 12
    values, axes = np.linalg.eigh(square)
    width = (axes * np.sqrt(values)[..., None, :]) @ axes.swapaxes(-1, -2)
    determinant = np.sqrt(values.prod(axis=-1))

    def stretched(vectors):
        return np.concatenate([(width @ vectors[..., :2, None])[..., 0], vectors[..., 2:]], axis=-1)

    local = np.stack([np.sqrt(1 - mu**2), 0 * mu, mu], axis=-1)
    slant, axis = np.linalg.norm(stretched(local), axis=-1), unit(stretched(local))
    directions, weights, blurs = [], [], []
    for i in range(count):
        share, turn = (i + 0.5) / count, np.pi * (1 + np.sqrt(5)) * i + turns
        z = (1 - share) * (1 + axis[..., 2]) - axis[..., 2]
        ring = np.sqrt(1 - z**2)
        mirror = unit(stretched(np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=-1) + axis))
        facing = (mirror * local).sum(axis=-1)
        to = 2 * facing[..., None] * mirror - local
        up, other = to[..., 2], np.linalg.norm(stretched(to), axis=-1)
        w = np.where(up > 0, up * (mu + slant) / (up * slant + mu * other), 0) / count
        flat = np.linalg.solve(width, mirror[..., :2, None])[..., 0]
        density = 1 / (np.pi * determinant * ((flat**2).sum(axis=-1) + mirror[..., 2] ** 2) ** 2) / (2 * (mu + slant))
        directions.append((frame @ to[..., None])[..., 0])
        weights.append(np.stack([w, w * (1 - facing) ** 5], axis=-1))
        blurs.append(1 / np.sqrt(2 * np.pi * count * density))
    return np.stack(directions, axis=-2), np.stack(weights, axis=-2), np.stack(blurs, axis=-1), mu


def lobe_energy(cosine, roughness):
    """∫ f c dω of GGX and Smith, and with (1 − v·h)⁵, over a hemisphere cut finely around the mirrored direction."""
    alpha, view = roughness**2, np.array([-np.sqrt(1 - cosine**2), 0, cosine])
    u = (np.arange(2000) + 0.5) / 2000
    polar = np.arctan(alpha * np.sqrt(u / (1 - u)))  # mirrors, drawn from D max(n·h, 0)
    azimuth = 2 * np.pi * (np.arange(400) + 0.5) / 400
    mirror = np.stack(
        np.broadcast_arrays(
            np.sin(polar)[:, None] * np.cos(azimuth), np.sin(polar)[:, None] * np.sin(azimuth), np.cos(polar)[:, None]
        ),
        axis=-1,
    )
    facing = mirror @ view
    up = 2 * facing * mirror[..., 2] - cosine
    slants = [np.sqrt(x**2 * (1 - alpha**2) + alpha**2) for x in (cosine, up)]
    shown = 0.5 / np.where(up > 0, up * slants[0] + cosine * slants[1], 1)
    values = np.where((up > 0) & (facing > 0), 4 * shown * up * facing / mirror[..., 2], 0)
    return values.mean(), (values * (1 - np.clip(facing, 0, 1)) ** 5).mean()


def even_grazing(cosine):
    """∫ (1 − v·h)⁵ max(n·l, 0) dω / π."""
    directions, weights = sphere_quadrature(64)
    view = np.array([np.sqrt(1 - cosine**2), 0, cosine])
    facing = np.sqrt(np.maximum(1 + directions @ view, 0) / 2)
    return weights @ ((1 - facing) ** 5 * np.maximum(directions[:, 2], 0)) / np.pi


def blurred(radiance, directions, sigma):
    """A map under exp((cos − 1) / σ²) around directions, [direction, channel]."""
    height, width, _ = radiance.shape
    theta = np.pi * (np.arange(height)[:, None] + 0.5) / height
    phi = 2 * np.pi * (np.arange(width) + 0.5) / width
    towards = np.stack(
        np.broadcast_arrays(np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)), axis=-1
    )
    weights = np.exp((towards @ directions.T - 1) / sigma**2) * np.sin(theta)[..., None]
    return np.einsum("ijd,ijc->dc", weights, radiance) / weights.sum(axis=(0, 1))[:, None]


def transmittance_near(transmittance, normals, directions, cells, reach):
    """Mean over cells, weighted by max(l·ω − cos ρ, 0)², of the light above the horizon."""
    radius = 2 / np.sqrt(len(cells))
    near = np.maximum(directions @ cells.T - np.cos(reach * radius), 0) ** 2
    rise = np.clip(0.5 + 0.5 / radius * normals @ cells.T, 0, 1)
    above = (rise**2 * (3 - 2 * rise))[:, :, None]
    return (near * np.minimum(transmittance[:, :, None], above)).sum(axis=-1) / (near * above).sum(axis=-1)


# ---------------------------------------------------------------------------------------------------- emitters


def may_light(beam, area, normal, is_two_sided=False):
    """Whether a part of a sample may light a receiver, given the way to it."""
    size = np.linalg.norm(area)
    facing = -beam @ area / size / np.linalg.norm(beam)
    return beam @ normal > -np.sqrt(size) and (facing > -0.3 or is_two_sided)


def light_of_samples(points, normals, samples, areas, softness, radiance, transmittance, is_two_sided=False):
    """Σ L T cos f(−A·ω) / √(π² d⁴ + |A|²), [receiver, 3], far from all samples."""
    beams = samples - points[:, None]
    distances = np.linalg.norm(beams, axis=-1)
    cosines = np.maximum(np.einsum("rsx,rx->rs", beams, normals) / distances, 0)
    sizes = np.linalg.norm(areas, axis=-1)
    facing = -np.einsum("rsx,sx->rs", beams, areas) / distances
    facing = sum(
        np.where(np.abs(side) < softness * sizes, (side + softness * sizes) ** 2 / (4 * softness * sizes), side.clip(0))
        for side in ([facing, -facing] if is_two_sided else [facing])
    )
    factors = cosines * facing / np.hypot(np.pi * distances**2, sizes)
    return (factors * transmittance) @ radiance


def share_of_sphere(center, radius, beam, disc_radius, softness=0.05):
    """The share of the beam of a disc that a sphere takes; the receiver is the origin."""
    distance = np.linalg.norm(beam)
    depth = center @ beam / distance
    height = np.linalg.norm(center - depth * beam / distance)
    width = np.hypot(disc_radius * np.clip(depth / distance, 0, 1), softness * radius)
    middle = np.sqrt(radius**2 - min(width, radius) ** 2 / 5)
    high, low = middle + width, max(middle - width, 0)
    opacity = min(1, radius**2 / (((high + low) / 2) ** 2 + (high - low) ** 2 / 20))
    around = smoothstep(depth / radius + 0.5) * smoothstep((distance - depth) / radius + 0.5)
    return opacity * smoothstep((high - height) / (high - low)) * around


def share_of_box(size, point, beam, disc_radius):
    """The share of the beam of a disc that a box around the origin takes."""
    half = np.array(size) / 2
    seen = [(axis, sign) for axis in range(3) for sign in (-1, 1) if sign * point[axis] > half[axis]]
    if not seen:
        return 0.0
    depth = min(half[axis] - sign * (point + beam)[axis] for axis, sign in seen)
    direction, sines = beam / np.linalg.norm(beam), []
    for axis in range(3):
        first, second = (other for other in range(3) if other != axis)
        for signs in np.ndindex(2, 2):
            sides = (first, 2 * signs[0] - 1), (second, 2 * signs[1] - 1)
            if (sides[0] in seen) != (sides[1] in seen):  # the edge between them is on the silhouette
                ends = np.zeros((2, 3))
                for other, sign in sides:
                    ends[:, other] = sign * half[other]
                ends[:, axis] = half[axis], -half[axis]
                normal = unit(np.cross(ends[0] - point, ends[1] - point))
                sines.append(np.sign(-normal @ point) * normal @ direction)
    width = disc_radius / np.linalg.norm(beam)
    return smoothstep((min(sines) / width + 1) / 2) * smoothstep((depth / disc_radius + 1) / 2)


def share_of_panel(corners, point, beam, disc_radius):
    """The share of the beam of a disc that a flat convex panel takes, given its corners in order."""
    normal = unit(np.cross(corners[1] - corners[0], corners[2] - corners[0]))
    normal *= np.sign(normal @ (point - corners[0]))
    depth, middle, positions = normal @ (corners[0] - point - beam), corners.mean(axis=0), []
    for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        towards = unit(np.cross(begin - point, end - point))
        positions.append(np.sign(towards @ (middle - point)) * towards @ beam)
    return smoothstep((min(positions) / disc_radius + 1) / 2) * smoothstep((depth / disc_radius + 1) / 2)


def share_of_rectangle(size, point, beam, disc_radius):
    """The share of the beam of a disc that a rectangle takes, in the plane y = 0 around the origin."""
    position = -point[1] / beam[1]
    if not 0 < position < 1:
        return 0.0
    hit = (point + position * beam)[[0, 2]]
    gaps = np.array(size) / 2 - np.abs(hit)
    if (gaps >= 0).all():
        axis = int(np.argmin(gaps))
        distance, towards = gaps[axis], np.eye(2)[axis]
    else:
        away = np.maximum(-gaps, 0)
        distance, towards = -np.linalg.norm(away), away * np.sign(hit) / np.linalg.norm(away)
    slope = towards @ beam[[0, 2]] / beam[1]
    return smoothstep((distance / (disc_radius * position * np.sqrt(1 + slope**2)) + 1) / 2)
