"""Settings of flat bodies and receivers, and a float64 twin of their light and of what passes them."""

import cmath
import functools
import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import warp as wp

import warpshadow as ws
from warpshadow.maths.directions import cell_radius, fibonacci
from warpshadow.stages.patches import find_plane_patches
from warpshadow.stages.planes import plane_blockers
from warpshadow.stages.planes.plane_blockers import PlaneBlockers, PlaneBody

DIRECTIONS = fibonacci(64)


# ---------------------------------------------------------------------------------------------------- the twin


def ramp(z):
    u = np.clip((z + 1) / 2, 0, 1)
    return u**2 * (3 - 2 * u)


def halved(image, height, width):
    """Means over equal parts of an image, which may share texels: each texel is first cut into those of both."""
    return means_over_parts(image.tobytes(), image.shape, height, width)


@functools.cache
def means_over_parts(data, shape, height, width):
    image, (rows, columns, _) = np.frombuffer(data).reshape(shape), shape
    fine = np.repeat(np.repeat(image, height, axis=0), width, axis=1)
    return fine.reshape(height, rows, width, columns, -1).mean(axis=(1, 3))


def bilinear(image, x, y):
    height, width = image.shape[:2]
    x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
    left, top = int(min(x, max(width - 2, 0))), int(min(y, max(height - 2, 0)))
    right, below = min(left + 1, width - 1), min(top + 1, height - 1)
    s, t = x - left, y - top
    upper = (1 - s) * image[top, left] + s * image[top, right]
    return (1 - t) * upper + t * ((1 - s) * image[below, left] + s * image[below, right])


def part_in_disc(a, b):
    """Area and moment of the triangle of the middle of a disc of radius 1, a and b that the disc takes, by pieces.

    Points of the plane are complex numbers, which Python has ten times as fast as NumPy; a* b = a·b + i a×b.
    """
    along = b - a
    length = abs(along)
    distance = (a.conjugate() * along).imag / length if length else 1.0
    half = math.sqrt(max(0, 1 - distance**2))
    middle = -(a.conjugate() * along).real / length if length else 0.0
    cuts = [min(max((middle + sign * half) / length, 0), 1) for sign in (-1, 1)] if half > 0 else []
    area, moment = 0.0, 0j
    for p, q in itertools.pairwise([a + t * along for t in (0, *cuts, 1)]):
        if abs(p + q) < 2:
            triangle = (p.conjugate() * q).imag / 2
            area, moment = area + triangle, moment + triangle * (p + q) / 3
        elif p and q:
            area += cmath.phase(p.conjugate() * q) / 2
            moment += 1j * (p / abs(p) - q / abs(q)) / 3
    return np.array([area, moment.real, moment.imag])


def ahead(corners, direction):
    """The part of a polygon [corner, 3] that is in front of the origin."""
    heights, result = corners @ direction - 1e-3 * np.abs(corners[:, 2]).max(), []
    for k in range(len(corners)):
        before, after, step = heights[k - 1], heights[k], corners[k] - corners[k - 1]
        if before * after < 0:
            result.append(corners[k - 1] + before / (before - after) * step)
        if after >= 0:
            result.append(corners[k])
    return np.array(result)


def share_in_view(outline, at, toward, radius):
    """Part of a cell that an outline encloses, and its moment, by signed triangles projected to the plane that touches
    the sphere."""
    toward = toward / np.linalg.norm(toward)
    axis = np.cross(toward, np.eye(3)[np.abs(toward).argmin()])
    unit_axes = np.stack([axis, np.cross(toward, axis)]) / np.linalg.norm(axis)
    total = np.zeros(3)
    for a, b in outline:
        corners = np.stack([outline[0, 0], a, b])
        (x, y), (z, w) = (corners[1:] - corners[0]).tolist()
        sign = np.sign(x * w - y * z)
        seen = ahead(np.column_stack([corners - at[:2], np.full(3, at[2])]), toward)
        if sign and len(seen):
            projected = seen @ unit_axes.T / (radius * seen @ toward)[:, None]
            points = (projected @ [1, 1j]).tolist()
            part = sum(map(part_in_disc, [points[-1], *points[:-1]], points))
            total += sign * np.sign(part[0]) * part
    return np.array([np.clip(total[0] / np.pi, 0, 1), *(total[1:] / np.pi @ unit_axes)])


def around(texels):
    """A little of the texels beside each one, along both sides of [row, column, channel]."""
    for axis in (0, 1):
        padded = np.pad(texels, [(1, 1) if each == axis else (0, 0) for each in range(3)])
        before, after = (np.take(padded, np.arange(texels.shape[axis]) + shift, axis) for shift in (0, 2))
        texels = texels + 0.002 * (before + after)
    return texels


def mesh_means(grid, image, rows, columns, weights=1.0):
    """Means of an image over the mesh in a mip level; of texels beside it, those of their neighbors."""
    weights = weights * grid.covered[..., None].astype(float)
    sums, totals = (around(halved(values, rows, columns)) for values in (image * weights, weights))
    return sums / np.where(totals > 0, totals, 1)


def fetched(image, grid, y, cosine, t, radius, level_of):
    """Mean of an image [row, column, channel] over a footprint at a place in the plane."""
    height, width = image.shape[:2]
    z = y / grid.spread
    count = np.array([width, height])
    texel = (np.sign(z) * np.log1p(np.abs(z)) - grid.low) / (grid.high - grid.low) * count
    slopes = 1 / (1 + np.abs(z)) * count / (grid.high - grid.low) / grid.spread
    footprint = max(t * radius * np.sqrt(slopes.prod() / cosine), 1.0)
    sizes = [(height, width)]
    while max(sizes[-1]) > 1:
        sizes.append(tuple(max(size // 2, 1) for size in sizes[-1]))
    level = min(int(np.log2(footprint)), len(sizes) - 1)
    part = footprint / 2**level - 1 if level < len(sizes) - 1 else 0.0
    values = []
    for rows, columns in sizes[level : level + 2]:
        x, y = texel / count * (columns, rows) - 0.5
        values.append(bilinear(level_of(image, rows, columns), x, y))
    return values[0] if part == 0 else (1 - part) * values[0] + part * values[1]


def margin_of(grid):
    return 0.001 * grid.texel_sizes().min()


class MetSide(NamedTuple):
    """What a cell meets of a side of a flat."""

    coverage: np.ndarray  # (h, μ)
    inverse: np.ndarray  # g: the flat is 1/(g·ω) away
    light: Callable[[np.ndarray, float], np.ndarray]  # its mean over a footprint along a direction, of an extent
    flat: int


def met_sides(point, omega, disc, radius, frames, grids, radiosity, self_plane, fronts=None):
    """The sides that a cell meets."""
    sides = []
    for f, grid in enumerate(grids):
        origin, u, v = frames[3 * f : 3 * f + 3]
        scales = np.linalg.norm(u), np.linalg.norm(v)
        axes = np.stack([u / scales[0], v / scales[1]])
        normal = np.cross(*axes)
        place = axes @ (point - origin) / scales
        height = normal @ (point - origin) / scales[0]
        margin = margin_of(grid)
        front = ramp(1 + 2 * height / margin) if fronts is None else fronts[f]
        for side, side_weight in ((1, front), (-1, 1 - front)):
            away = -side * normal
            if f == self_plane or side_weight <= 0 or away @ omega <= -radius:
                continue
            rise = np.clip(side * height / margin, 0, 2)
            above = margin * (1 + rise**2 / 4) + max(side * height - 2 * margin, 0)
            footprint = functools.partial(footprint_along, place, above, axes, away, radius)
            is_exact = len(grid.outline) <= plane_blockers.MAX_EDGES
            at, toward = np.array([*place, above]), np.array([*(axes @ omega), away @ omega])
            local = share_in_view(grid.outline if is_exact else grid.rectangle(), at, toward, disc)
            coverage = side_weight * np.array([local[0], *(local[1:3] @ axes + local[3] * away)])
            if not is_exact:
                covered = grid.covered[..., None].astype(float)
                coverage = coverage * fetched(covered, grid, *footprint(omega), radius, halved)[0]
            if coverage[0] <= 0:
                continue
            image = radiosity[f][0 if side == 1 else 1] if side == 1 or grid.sides == 2 else None
            light = functools.partial(light_along, image, grid, footprint, radius)
            sides.append(MetSide(coverage, away / (above * scales[0]), light, f))
    return sides


def footprint_along(place, above, axes, away, radius, omega):
    """Center in the plane, mean cosine and distance of a cell's footprint along a direction."""
    cosine = away @ omega
    mean = cosine if cosine >= radius else radius * (1 / 3 + 2 / 3 * ((cosine / radius + 1) / 2) ** 3)
    return place + above / mean * (axes @ omega), mean, above / mean


def light_along(image, grid, footprint, radius, omega, extent):
    """Mean of a side's radiosity over a footprint; a side without patches is black."""
    means = functools.partial(mesh_means, grid)
    return np.zeros(3) if image is None else fetched(image, grid, *footprint(omega), radius * extent, means)


def share_in_front(omega, disc, side, other):
    """Share of what two sides cover both in which the other is in front."""
    h, other_h = side.coverage[0], other.coverage[0]
    place = side.coverage[1:] / h + other.coverage[1:] / other_h
    difference = other.inverse - side.inverse
    across = difference - omega * (omega @ difference)
    slope = np.sqrt(across @ across + 1e-6 * (side.inverse @ side.inverse + other.inverse @ other.inverse))
    return ramp(difference @ (omega + disc * place) / (disc * slope * np.sqrt(h * other_h)))


def seen_of(omega, disc, sides, k, before):
    """Part of a side that is seen, and its light, past bodies before all sides that cover (h, μ)."""
    others = [side for j, side in enumerate(sides) if j != k]
    shares = [share_in_front(omega, disc, sides[k], other) for other in others]
    blocked = sum((share * other.coverage for share, other in zip(shares, others, strict=True)), np.zeros(4))
    seen = max(1 - blocked[0], 1e-4)
    is_open, moment = max(seen * (1 - before[0]), 1e-4), blocked[1:] + before[1:]
    along = omega - disc * moment / np.sqrt(is_open**2 + moment @ moment)
    return sides[k].coverage[0] * seen, sides[k].light(along / np.linalg.norm(along), np.sqrt(is_open))


def above_horizon(omega, normal, radius):
    """Direction and radius of the largest disc in a cell that is above a horizon."""
    cosine = normal @ omega
    if not 0 < cosine < radius:
        return omega, radius
    shifted = omega + (radius - cosine) / 2 * (normal - cosine * omega)
    return shifted / np.linalg.norm(shifted), (radius + cosine) / 2


def twin_light(
    points, normals, transmittance, frames, grids, radiosity, directions, self_plane=None, fronts=None, coverages=None
):
    """Of one instance, [receiver, 3]; radiosity is [side, row, column, 3] for each flat."""
    radius, result = cell_radius(len(directions)), np.zeros((len(points), 3))
    for receiver, (point, normal) in enumerate(zip(points, normals, strict=True)):
        for q, omega in enumerate(directions):
            weight = 4 / len(directions) * max(normal @ omega, 0) * transmittance[receiver, q]
            if weight == 0:
                continue
            own = None if fronts is None else fronts[receiver]
            seen = (omega, radius) if self_plane is None else above_horizon(omega, normal, radius)
            sides = met_sides(point, *seen, radius, frames, grids, radiosity, self_plane, own)
            before = np.zeros(4) if coverages is None else coverages[receiver, q]
            seen_parts = [seen_of(*seen, sides, k, before) for k in range(len(sides))]
            shares = sum(share for share, _ in seen_parts)
            if shares > 0:
                sent = sum(share * light for share, light in seen_parts) / shares
                result[receiver] += weight * min(1.0, sum(side.coverage[0] for side in sides)) * sent
    return result


def twin_passing(points, transmittance, frames, grids, blocks, directions, self_plane=None, fronts=None):
    radius, covered = cell_radius(len(directions)), np.zeros(np.shape(transmittance))
    black = [np.zeros((2, *grid.covered.shape, 3)) for grid in grids]
    for receiver, point in enumerate(points):
        for q, omega in enumerate(directions):
            if transmittance[receiver, q] == 0:
                continue
            own = None if fronts is None else fronts[receiver]
            for side in met_sides(point, omega, radius, radius, frames, grids, black, self_plane, own):
                covered[receiver, q] += side.coverage[0] * blocks[side.flat]
    return transmittance * np.maximum(0, 1 - covered)


# ---------------------------------------------------------------------------------------------------- scenes


def l_shape():
    """An L of three unit squares, whose corner is at the origin."""
    corners = np.array([[x, 0, z] for x in range(3) for z in range(3)], float) - [1, 0, 1]
    squares = [(0, 1), (0, 0), (1, 0)]
    faces = [[3 * i + j, 3 * i + j + 1, 3 * i + j + 4] for i, j in squares]
    faces += [[3 * i + j, 3 * i + j + 4, 3 * i + j + 3] for i, j in squares]
    return ws.Mesh(corners, faces)


WALL = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # turns a ground into a wall that looks to −z … or +z


class Setting:
    """PlaneBlockers with random radiosity, and receivers above, below and beside them."""

    def __init__(self, device, *, two_sided=False, blocks=(True, True, True), names=("ground", "wall", "l"), batch=1):
        rng = np.random.default_rng(1)
        meshes = {
            "ground": (ws.plane(4.0, 4), np.eye(3), [0.0, 0, 0], 1.0),
            "wall": (ws.plane(3.0, 1), WALL.T, [0.1, 1.2, -1.3], 0.8),
            "l": (l_shape(), np.diag([1.0, -1, -1]), [0.4, 1.9, 0.1], 0.7),
        }
        near = np.array([[-0.5, 0, -0.4], [0.6, 1, 0.5]])
        self.parts, self.radiosity, posed, bodies = [], [], [], []
        vertex_count = patch_count = 0
        for name, is_blocking in zip(names, blocks, strict=False):
            mesh, rotation, translation, scale = meshes[name]
            faces = mesh.surface.faces
            patches = find_plane_patches(mesh.positions, faces, is_two_sided=two_sided, others=near)
            bodies.append(PlaneBody(patches.grid, mesh.positions, faces, vertex_count, patch_count, is_blocking))
            self.radiosity.append(rng.uniform(size=(2, *patches.grid.covered.shape, 3)))
            posed.append(scale * mesh.positions.astype(float) @ rotation.T + translation)
            vertex_count, patch_count = vertex_count + mesh.vertex_count, patch_count + patches.count
        self.grids, self.blocks = [body.grid for body in bodies], blocks
        self.planes = PlaneBlockers.from_bodies(bodies, patch_count, vertex_count, device=device)
        self.vertices = np.repeat(np.concatenate(posed)[None], batch, axis=0)
        points = rng.uniform([-1.2, 0.05, -1], [1.2, 1.6, 1.2], size=(7, 3))
        points[5] = [0.4, -0.2, 0.3]  # below the ground
        points[6] = [-0.5, -0.3 * margin_of(self.grids[0]), 0.2]  # in its margin
        normals = rng.normal(size=(7, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        self.points, self.normals = (np.repeat(values[None], batch, axis=0) for values in (points, normals))
        self.transmittance = rng.uniform(size=(batch, 7, len(DIRECTIONS))) * (rng.uniform(size=len(DIRECTIONS)) > 0.2)
        if batch > 1:
            self.points[1:] += 0.05
            self.vertices[1:] += 0.02
        self.coverages = None  # of bodies before the flats [receiver, direction, 4]
        self.fronts = None  # of each receiver [receiver, flat], where its height does not decide
        self.device = device

    def values(self):
        """Points, normals, transmittance, vertices, and radiosity of patches."""
        sides = [each[: grid.sides].reshape(-1, 3) for each, grid in zip(self.radiosity, self.grids, strict=True)]
        return self.points, self.normals, self.transmittance, self.vertices, np.concatenate(sides)[None]

    def move(self, steps):
        """Add to all of these."""
        for name, step in zip(("points", "normals", "transmittance", "vertices"), steps[:4], strict=True):
            setattr(self, name, getattr(self, name) + step)
        first = 0
        for each, grid in zip(self.radiosity, self.grids, strict=True):
            own = each[: grid.sides]
            own += steps[4][0, first : first + own[..., 0].size].reshape(own.shape)
            first += own[..., 0].size

    def arrays(self):
        """The same on the device, wanting gradients."""
        values = self.values()
        dtypes = wp.vec3, wp.vec3, wp.float32, wp.vec3, wp.vec3
        return [
            wp.array(value, dtype=dtype, device=self.device, requires_grad=True)
            for value, dtype in zip(values, dtypes, strict=True)
        ]

    def frames(self, vertices):
        rows = self.planes.frames_of_vertices
        starts, columns, weights = (array.numpy() for array in rows.rows)
        return np.array(
            [weights[a:b].astype(float) @ vertices[columns[a:b]] for a, b in zip(starts[:-1], starts[1:], strict=True)]
        )

    def light(self, self_plane=None, batch=0):
        at = self.points[batch], self.normals[batch], self.transmittance[batch]
        given = self.frames(self.vertices[batch]), self.grids, self.radiosity, DIRECTIONS, self_plane
        return twin_light(*at, *given, self.fronts, self.coverages)

    def passing(self, self_plane=None, batch=0):
        at = self.points[batch], self.transmittance[batch]
        given = self.frames(self.vertices[batch]), self.grids, self.blocks, DIRECTIONS, self_plane, self.fronts
        return twin_passing(*at, *given)
