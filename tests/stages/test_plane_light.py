"""Light of flat bodies, and what passes them, against NumPy, against rays, and against differences."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
import warp as wp

import warpshadow as ws
from warpshadow.device.tape import recorded
from warpshadow.maths.directions import cell_radius, fibonacci
from warpshadow.stages.bounces.plane_light import plane_light as light_of_texels
from warpshadow.stages.bounces.plane_texels import find_texels
from warpshadow.stages.joint_coverage import transmittance_past
from warpshadow.stages.patches import find_plane_patches
from warpshadow.stages.planes import prepared
from warpshadow.stages.planes.coverage import plane_coverage
from warpshadow.stages.planes.prepared import PlaneBlockers, PlaneBody

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

FLOAT32 = 2e-5
DIRECTIONS = fibonacci(64)


def plane_light(points, normals, transmittance, frames, radiosity, planes, directions, **options):
    ones = wp.full((1, radiosity.shape[1]), wp.vec3(1.0), dtype=wp.vec3, device=radiosity.device)
    texels = find_texels(radiosity, ones, planes)
    return light_of_texels(points, normals, transmittance, frames, texels, planes, directions, **options)


def passing_flats(points, transmittance, frames, planes, directions, **options):
    return transmittance_past(transmittance, plane_coverage(points, frames, planes, directions, **options))


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
    """Area and moment of the triangle of the middle of a disc of radius 1, a and b that the disc takes, by pieces."""
    along = b - a
    length = np.linalg.norm(along)
    distance = np.linalg.det([a, along]) / length if length else 1.0
    half = np.sqrt(max(0, 1 - distance**2))
    cuts = [(-along @ a / length + sign * half) / length for sign in (-1, 1)] if half > 0 else []
    ends = [a + t * along for t in (0, *np.clip(cuts, 0, 1), 1)]
    total = np.zeros(3)
    for p, q in zip(ends[:-1], ends[1:], strict=True):
        cross = p[0] * q[1] - p[1] * q[0]
        if np.linalg.norm(p + q) < 2:
            total += cross / 2 * np.array([1.0, *((p + q) / 3)])
        elif np.linalg.norm(p) > 0 and np.linalg.norm(q) > 0:
            angle = np.arctan2(cross, p @ q)
            p, q = p / np.linalg.norm(p), q / np.linalg.norm(q)
            total += np.array([angle / 2, (q[1] - p[1]) / 3, (p[0] - q[0]) / 3])
    return total


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
        sign = np.sign(np.linalg.det(corners[1:] - corners[0]))
        seen = ahead(np.column_stack([corners - at[:2], np.full(3, at[2])]), toward)
        if sign and len(seen):
            projected = seen @ unit_axes.T / (radius * seen @ toward)[:, None]
            part = sum(map(part_in_disc, np.roll(projected, 1, axis=0), projected))
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


def met_sides(point, omega, disc, radius, frames, grids, radiosity, skip, fronts=None):
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
            if f == skip or side_weight <= 0 or away @ omega <= -radius:
                continue
            rise = np.clip(side * height / margin, 0, 2)
            above = margin * (1 + rise**2 / 4) + max(side * height - 2 * margin, 0)
            footprint = functools.partial(footprint_along, place, above, axes, away, radius)
            is_exact = len(grid.outline) <= prepared.MAX_EDGES
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
    points, normals, transmittance, frames, grids, radiosity, directions, skip=None, fronts=None, coverages=None
):
    """Of one instance, [receiver, 3]; radiosity is [side, row, column, 3] for each flat."""
    radius, result = cell_radius(len(directions)), np.zeros((len(points), 3))
    for receiver, (point, normal) in enumerate(zip(points, normals, strict=True)):
        for q, omega in enumerate(directions):
            weight = 4 / len(directions) * max(normal @ omega, 0) * transmittance[receiver, q]
            if weight == 0:
                continue
            own = None if fronts is None else fronts[receiver]
            seen = (omega, radius) if skip is None else above_horizon(omega, normal, radius)
            sides = met_sides(point, *seen, radius, frames, grids, radiosity, skip, own)
            before = np.zeros(4) if coverages is None else coverages[receiver, q]
            seen_parts = [seen_of(*seen, sides, k, before) for k in range(len(sides))]
            shares = sum(share for share, _ in seen_parts)
            if shares > 0:
                sent = sum(share * light for share, light in seen_parts) / shares
                result[receiver] += weight * min(1.0, sum(side.coverage[0] for side in sides)) * sent
    return result


def twin_passing(points, transmittance, frames, grids, blocks, directions, skip=None, fronts=None):
    radius, covered = cell_radius(len(directions)), np.zeros(np.shape(transmittance))
    black = [np.zeros((2, *grid.covered.shape, 3)) for grid in grids]
    for receiver, point in enumerate(points):
        for q, omega in enumerate(directions):
            if transmittance[receiver, q] == 0:
                continue
            own = None if fronts is None else fronts[receiver]
            for side in met_sides(point, omega, radius, radius, frames, grids, black, skip, own):
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

    def light(self, skip=None, batch=0):
        at = self.points[batch], self.normals[batch], self.transmittance[batch]
        given = self.frames(self.vertices[batch]), self.grids, self.radiosity, DIRECTIONS, skip
        return twin_light(*at, *given, self.fronts, self.coverages)

    def passing(self, skip=None, batch=0):
        at = self.points[batch], self.transmittance[batch]
        given = self.frames(self.vertices[batch]), self.grids, self.blocks, DIRECTIONS, skip, self.fronts
        return twin_passing(*at, *given)


# ---------------------------------------------------------------------------------------------------- values


@pytest.mark.parametrize("two_sided", [False, True])
@pytest.mark.parametrize("skip", [None, 0])
@pytest.mark.parametrize("names", [("ground",), ("l",), ("ground", "wall", "l")])
@pytest.mark.parametrize("coverage", ["outline", "texels"])
def test_light_is_that_of_the_formula(names, skip, two_sided, coverage, device, monkeypatch):
    if coverage == "texels":
        monkeypatch.setattr(prepared, "MAX_EDGES", 5)
    setting = Setting(device, names=names, two_sided=two_sided, batch=2)
    points, normals, transmittance, vertices, radiosity = setting.arrays()
    frames = setting.planes.frames(vertices)
    light = plane_light(
        points, normals, transmittance, frames, radiosity, setting.planes, DIRECTIONS, skip=skip
    ).numpy()
    for batch in range(2):
        np.testing.assert_allclose(light[batch], setting.light(skip, batch), atol=FLOAT32)


@pytest.mark.parametrize("skip", [None, 0])
def test_white_flats_send_what_they_block(skip, device):
    """Where cells are divided between flats without a remainder; a tenth of the light was missing without that."""
    setting = Setting(device, two_sided=True)
    points, normals, transmittance, vertices, radiosity = setting.arrays()
    radiosity.fill_(1.0)
    frames, planes = setting.planes.frames(vertices), setting.planes
    light = plane_light(points, normals, transmittance, frames, radiosity, planes, DIRECTIONS, skip=skip).numpy()
    options = {"skip": skip, "horizon_normals": normals}
    passing = passing_flats(points, transmittance, frames, planes, DIRECTIONS, **options).numpy()
    weights = 4 / len(DIRECTIONS) * np.maximum(setting.normals @ DIRECTIONS.T, 0)
    blocked = (weights * (setting.transmittance - passing)).sum(axis=2)
    assert blocked.max() > 0.1
    np.testing.assert_allclose(light[..., 0], blocked, atol=FLOAT32)


@pytest.mark.parametrize("skip", [None, 1])
@pytest.mark.parametrize("coverage", ["outline", "texels"])
def test_what_passes_is_that_of_the_formula(skip, coverage, device, monkeypatch):
    if coverage == "texels":
        monkeypatch.setattr(prepared, "MAX_EDGES", 5)
    setting = Setting(device, blocks=(True, False, True))
    points, _, transmittance, vertices, _ = setting.arrays()
    frames = setting.planes.frames(vertices)
    passing = passing_flats(points, transmittance, frames, setting.planes, DIRECTIONS, skip=skip).numpy()
    np.testing.assert_allclose(passing[0], setting.passing(skip), atol=FLOAT32)
    assert passing.min() >= 0 and np.abs(passing - setting.transmittance).max() > 0.5


# ---------------------------------------------------------------------------------------------------- gradients


def slopes_of(setting, steps, twin, weights):
    """Derivative of the sum of weights times what the twin gives, by central differences along steps."""
    ends = []
    for sign in (1, -2):
        setting.move([sign * step for step in steps])
        ends.append((weights * twin(setting)).sum())
    setting.move(steps)
    return (ends[0] - ends[1]) / 2


def random_steps(setting, number, size=1e-6):
    """A step of one of the variables alone."""
    rng = np.random.default_rng(number)
    values = setting.values()
    steps = [np.zeros(value.shape) for value in values]
    steps[number] = size * rng.normal(size=values[number].shape)
    if number == 3:  # of frames three vertices decide, and they are to stay those of a body that is moved and scaled
        turn, shift = rng.normal(size=3), rng.normal(size=3)
        steps[3] = size * (np.cross(turn, values[3]) + shift + 0.3 * values[3])
    return steps


@pytest.mark.parametrize("two_sided", [False, True])
@pytest.mark.parametrize("names", [("ground",), ("l",), ("ground", "wall", "l")])
@pytest.mark.parametrize("coverage", ["outline", "texels"])
def test_gradients_of_light_are_those_of_the_twin(names, two_sided, coverage, device, verified_tape, monkeypatch):
    if coverage == "texels":
        monkeypatch.setattr(prepared, "MAX_EDGES", 5)
    setting = Setting(device, names=names, two_sided=two_sided)
    variables = setting.arrays()
    points, normals, transmittance, vertices, radiosity = variables
    with recorded() as tape:
        frames = setting.planes.frames(vertices)
        light = plane_light(points, normals, transmittance, frames, radiosity, setting.planes, DIRECTIONS)
    weights = np.random.default_rng(5).uniform(size=(7, 3))
    tape.backward(grads={light: wp.array(weights[None], dtype=wp.vec3, device=device)})
    for number, variable in enumerate(variables):
        steps = random_steps(setting, number)
        expected = slopes_of(setting, steps, Setting.light, weights)
        assert (variable.grad.numpy() * steps[number]).sum() == pytest.approx(expected, rel=2e-3), number


@pytest.mark.parametrize("names", [("ground",), ("ground", "wall", "l")])
def test_gradients_of_what_passes_are_those_of_the_twin(names, device, verified_tape):
    setting = Setting(device, names=names, blocks=(True, False, True))
    variables = setting.arrays()
    points, _, transmittance, vertices, _ = variables
    with recorded() as tape:
        frames = setting.planes.frames(vertices)
        passing = passing_flats(points, transmittance, frames, setting.planes, DIRECTIONS)
    weights = np.random.default_rng(5).uniform(size=passing.shape[1:])
    tape.backward(grads={passing: wp.array(weights[None], dtype=wp.float32, device=device)})
    for number in (0, 2, 3):
        steps = random_steps(setting, number)
        expected = slopes_of(setting, steps, Setting.passing, weights)
        assert (variables[number].grad.numpy() * steps[number]).sum() == pytest.approx(expected, rel=2e-3), number


def test_what_receivers_see_of_fronts_can_be_given(device, verified_tape):
    setting, rng = Setting(device, two_sided=True, names=("ground", "wall")), np.random.default_rng(6)
    setting.fronts = rng.uniform(0.1, 0.9, size=(7, 2))
    setting.transmittance[:, 2:] = 0  # which spares the twin
    points, normals, transmittance, vertices, radiosity = setting.arrays()
    fronts = wp.array(setting.fronts[None], dtype=wp.float32, device=device, requires_grad=True)
    with recorded() as tape:
        frames, planes = setting.planes.frames(vertices), setting.planes
        light = plane_light(points, normals, transmittance, frames, radiosity, planes, DIRECTIONS, fronts=fronts)
        passing = passing_flats(points, transmittance, frames, planes, DIRECTIONS, fronts=fronts)
    np.testing.assert_allclose(light.numpy()[0], setting.light(), atol=FLOAT32)
    np.testing.assert_allclose(passing.numpy()[0], setting.passing(), atol=FLOAT32)

    weights = rng.uniform(size=(7, 3)), rng.uniform(size=passing.shape[1:])
    for found, twin, weight in ((light, Setting.light, weights[0]), (passing, Setting.passing, weights[1])):
        seed = wp.array(weight[None], dtype=found.dtype, device=device)
        tape.zero()
        tape.backward(grads={found: seed})
        steps = random_steps(setting, 0)
        expected = slopes_of(setting, steps, twin, weight)
        assert (points.grad.numpy() * steps[0]).sum() == pytest.approx(expected, rel=2e-3)
        step, ends = 1e-6 * rng.normal(size=setting.fronts.shape), []
        for sign in (1, -2, 1):
            setting.fronts = setting.fronts + sign * step
            ends.append((weight * twin(setting)).sum())
        assert (fronts.grad.numpy()[0] * step).sum() == pytest.approx((ends[0] - ends[1]) / 2, rel=2e-3)


@pytest.mark.parametrize("names", [("ground",), ("ground", "wall")])
def test_light_of_flats_is_that_of_the_part_that_bodies_before_them_leave_open(names, device, verified_tape):
    setting, rng = Setting(device, two_sided=True, names=names), np.random.default_rng(7)
    shares = rng.uniform(-0.3, 1, size=(7, len(DIRECTIONS))).clip(0)  # a third of the cells are open
    moments = rng.normal(size=(*shares.shape, 3))
    moments -= (moments * DIRECTIONS).sum(axis=-1, keepdims=True) * DIRECTIONS
    moments *= 0.4 * (shares * (1 - shares))[..., None]
    setting.coverages = np.concatenate([shares[..., None], moments], axis=-1)
    points, normals, transmittance, vertices, radiosity = variables = setting.arrays()
    coverages = wp.array(setting.coverages[None], dtype=wp.vec4, device=device, requires_grad=True)
    with recorded() as tape:
        frames, planes = setting.planes.frames(vertices), setting.planes
        light = plane_light(points, normals, transmittance, frames, radiosity, planes, DIRECTIONS, coverages=coverages)
    np.testing.assert_allclose(light.numpy()[0], setting.light(), atol=FLOAT32)
    covered, setting.coverages = setting.coverages, None
    assert np.abs(light.numpy()[0] - setting.light()).max() > 100 * FLOAT32
    setting.coverages = covered

    weights = rng.uniform(size=(7, 3))
    tape.backward(grads={light: wp.array(weights[None], dtype=wp.vec3, device=device)})
    for number in (0, 3, 4):
        steps = random_steps(setting, number)
        expected = slopes_of(setting, steps, Setting.light, weights)
        assert (variables[number].grad.numpy() * steps[number]).sum() == pytest.approx(expected, rel=2e-3), number
    step, ends = 1e-6 * rng.normal(size=covered.shape) * (covered[..., :1] > 0), []
    for sign in (1, -1):
        setting.coverages = covered + sign * step
        ends.append((weights * setting.light()).sum())
    expected = (ends[0] - ends[1]) / 2
    assert (coverages.grad.numpy()[0] * step).sum() == pytest.approx(expected, rel=2e-3)


def test_instances_that_share_an_array_add_to_its_gradient(device):
    setting = Setting(device, names=("ground",))
    points, normals, transmittance, vertices, radiosity = setting.arrays()
    twice = wp.array(np.repeat(setting.vertices, 2, axis=0), dtype=wp.vec3, device=device, requires_grad=True)
    gradients = []
    for placed in (vertices, twice):
        with recorded() as tape:
            passing = passing_flats(points, transmittance, setting.planes.frames(placed), setting.planes, DIRECTIONS)
            light = plane_light(
                points, normals, transmittance, setting.planes.frames(placed), radiosity, setting.planes, DIRECTIONS
            )
        seeds = {passing: wp.full(passing.shape, 1.0, device=device)}
        seeds[light] = wp.full(light.shape, wp.vec3(1.0), dtype=wp.vec3, device=device)
        tape.backward(grads=seeds)
        gradients.append([each.grad.numpy() for each in (points, normals, transmittance, radiosity)])
        tape.zero()
    for once, both in zip(*gradients, strict=True):
        np.testing.assert_allclose(both, 2 * once, rtol=1e-4, atol=1e-5)


# ---------------------------------------------------------------------------------------------------- what it means


def single(device, *, size=4.0, two_sided=False, mesh=None, others=None):
    """A ground, its patches, and its frames."""
    mesh = ws.plane(size, 1) if mesh is None else mesh
    faces = mesh.surface.faces
    patches = find_plane_patches(mesh.positions, faces, is_two_sided=two_sided, others=others)
    body = PlaneBody(patches.grid, mesh.positions, faces, 0, 0, blocks=True)
    planes = PlaneBlockers.from_bodies([body], patches.count, mesh.vertex_count, device=device)
    return patches, planes, planes.frames(wp.array(mesh.positions[None], dtype=wp.vec3, device=device))


def lit_by(planes, frames, points, normals, radiosity, directions, device, **options):
    points, normals = np.atleast_2d(points), np.atleast_2d(normals)
    arrays = [wp.array(values[None], dtype=wp.vec3, device=device) for values in (points, normals)]
    ones = wp.full((1, len(points), len(directions)), 1.0, dtype=wp.float32, device=device)
    sent = wp.array(radiosity[None], dtype=wp.vec3, device=device)
    return plane_light(*arrays, ones, frames, sent, planes, directions, **options).numpy()[0]


@pytest.mark.parametrize("normal", [[0, -1, 0], [0.6, -0.8, 0], [1, 0, 0], [0, 1, 0]])
def test_a_white_ground_without_end_fills_the_hemisphere_below(normal, device):
    patches, planes, frames = single(device, size=2000.0)
    radiosity = np.ones((patches.count, 3))
    light = lit_by(planes, frames, [0.3, 1.0, 0.2], normal, radiosity, fibonacci(256), device)
    assert light[0] == pytest.approx((1 - normal[1]) / 2, abs=0.01)


def test_a_receiver_below_a_ground_is_lit_by_its_back_alone(device):
    below, down, up = [0.1, -0.5, 0.2], [0, -1, 0], [0, 1, 0]
    for two_sided in (False, True):
        near = np.array([[-1.0, 0, -1], [1, 1, 1]])
        patches, planes, frames = single(device, size=2000.0, two_sided=two_sided, others=near)
        radiosity = np.repeat(np.repeat([0.3, 0.7][: patches.grid.sides], 24 * 24)[:, None], 3, axis=1)
        light = lit_by(planes, frames, [below] * 2, [up, down], radiosity, fibonacci(256), device)
        assert light[0] == pytest.approx(0.7 if two_sided else 0, abs=0.01)
        assert light[1] == pytest.approx(0, abs=0.01)
        passing = passing_flats(
            wp.array([[below]], dtype=wp.vec3, device=device),
            wp.full((1, 1, 64), 1.0, dtype=wp.float32, device=device),
            frames,
            planes,
            DIRECTIONS,
        ).numpy()[0, 0]
        assert (passing[DIRECTIONS[:, 1] > 0.3] < 0.01).all() and (passing[DIRECTIONS[:, 1] < -0.3] == 1).all()


def test_a_receiver_that_lies_on_a_ground_is_above_it(device):
    patches, planes, frames = single(device)
    radiosity = np.random.default_rng(0).uniform(0.5, 1, size=(patches.count, 3))
    points = [[0.3, height, 0.2] for height in (0, 1e-6, -1e-6)]
    light = lit_by(planes, frames, points, [[1, 0, 0]] * 3, radiosity, DIRECTIONS, device)
    assert light[0].min() > 0.1
    np.testing.assert_allclose(light[1:], light[:1].repeat(2, axis=0), rtol=1e-3)


def soft_shadow(places):
    """Radiosity of a ground under a disc: dark in the middle, with a gradient."""
    radius = np.hypot(places[..., 0] - 0.1, places[..., 1] + 0.05)
    return 0.7 * (0.15 + 0.85 * ramp(4 * (radius - 0.8))) * (1 + 0.03 * places[..., 0])


def test_light_above_the_shadow_of_a_disc_is_that_of_rays(device):
    """Measured: 2.0% with 128 cells; with 1024 1.3%, which is the grid's."""
    others = np.array([[-0.8, 0, -0.8], [0.8, 1.6, 0.8]])
    patches, planes, frames = single(device, size=6.0, others=others)
    grid = patches.grid
    centers = grid.middles() @ grid.frame[:2][:, [0, 2]] + grid.origin[[0, 2]]
    radiosity = np.repeat(soft_shadow(centers).reshape(-1, 1), 3, axis=1)
    rng = np.random.default_rng(2)
    normals = rng.normal(size=(150, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = 0.75 * normals + [0, 0.8, 0]
    rays = fibonacci(40_000)
    rays = rays[rays[:, 1] < -1e-3]
    hits = points[:, None, [0, 2]] - points[:, None, 1:2] * rays[:, [0, 2]] / rays[:, 1:2]
    sent = np.where((np.abs(hits) < 3).all(axis=2), soft_shadow(hits), 0)
    expected = 4 / 40_000 * (np.maximum(normals @ rays.T, 0) * sent).sum(axis=1)
    for count, tolerance in ((128, 0.025), (1024, 0.018)):
        light = lit_by(planes, frames, points, normals, radiosity, fibonacci(count), device)[:, 0]
        assert np.linalg.norm(light - expected) < tolerance * np.linalg.norm(expected)


@pytest.mark.parametrize("scale", [1.0, 0.05])
def test_a_wall_hides_the_bright_ground_behind_it(scale, device):
    """Measured: of the light that rays lose to the wall 88% are lost, at any scale of the wall's body, 21% off."""
    corners = np.array([[-3.0, 0.4, 2], [3, 0.4, 2], [3, 2.4, 2], [-3, 2.4, 2]])
    ground, wall = ws.plane(12.0, 1), ws.Mesh(corners / scale, [[0, 1, 2], [0, 2, 3]])
    points = np.stack(np.meshgrid([-1.0, 0.2, 1.1], np.linspace(0.3, 2.2, 8), [-2.0, -1]), axis=-1).reshape(-1, 3)
    vertices = np.concatenate([ground.positions, scale * wall.positions])
    lights = []
    for meshes in ([ground], [ground, wall]):
        bodies, vertex_count, patch_count = [], 0, 0
        for mesh in meshes:
            faces = mesh.surface.faces
            patches = find_plane_patches(mesh.positions, faces, is_two_sided=False)
            bodies.append(PlaneBody(patches.grid, mesh.positions, faces, vertex_count, patch_count, blocks=True))
            vertex_count, patch_count = vertex_count + mesh.vertex_count, patch_count + patches.count
        planes = PlaneBlockers.from_bodies(bodies, patch_count, vertex_count, device=device)
        grid = bodies[0].grid
        centers = (grid.middles() @ grid.frame[:2][:, [0, 2]] + grid.origin[[0, 2]]).reshape(-1, 2)
        radiosity = np.zeros((patch_count, 3))
        radiosity[: len(centers)] = ramp(centers[:, 1:] - 2)
        frames = planes.frames(wp.array(vertices[None, :vertex_count], dtype=wp.vec3, device=device))
        lights.append(lit_by(planes, frames, points, [[0, 0, 1]] * len(points), radiosity, fibonacci(128), device))
    taken = (lights[0] - lights[1])[:, 0]

    rays = fibonacci(40_000)
    rays = rays[(rays[:, 1] < -1e-3) & (rays[:, 2] > 1e-3)]
    hits = points[:, None, [0, 2]] - points[:, None, 1:2] * rays[:, [0, 2]] / rays[:, 1:2]
    through = points[:, None, :2] + (2 - points[:, None, 2:]) * rays[:, :2] / rays[:, 2:]
    is_hidden = (np.abs(through - [0, 1.4]) < [3, 1]).all(axis=2) & (hits[..., 1] > 2)
    sent = np.where((np.abs(hits) < 6).all(axis=2) & is_hidden, ramp(hits[..., 1] - 2), 0)
    expected = 4 / 40_000 * (rays[:, 2] * sent).sum(axis=1)
    assert np.linalg.norm(taken - expected) < 0.25 * np.linalg.norm(expected)


def bends(values):
    """Largest second difference, against the largest first one."""
    return np.abs(np.diff(values, 2)).max() / np.abs(np.diff(values)).max()


@pytest.mark.parametrize(
    ("start", "end"),
    [
        ([0.3, 2e-3, 0.2], [0.3, -2e-3, 0.2]),
        ([0.5, 0.3, 0], [3.5, 0.3, 0.1]),
        ([2.06, -0.05, 0.28], [1.96, 0.075, 0.23]),
    ],
    ids=["through the plane", "past the border", "around the edge"],
)
def test_what_passes_has_no_step_and_no_kink_along_a_path(start, end, device):
    """In a path of ever more steps, second differences vanish against first ones; at a kink they would not."""
    _, planes, frames = single(device)
    ratios = []
    for count in (2000, 8000):
        points = np.linspace(start, end, count)[None]
        ones = wp.full((1, count, 64), 1.0, dtype=wp.float32, device=device)
        on_device = wp.array(points, dtype=wp.vec3, device=device)
        passing = passing_flats(on_device, ones, frames, planes, DIRECTIONS).numpy()[0].astype(float)
        ratios.append(max(bends(column) for column in passing.T if np.ptp(column) > 0.1))
    assert ratios[1] < 0.5 * ratios[0] + 0.02


def test_no_other_flat_leaves_all_as_it_is(device):
    setting = Setting(device, names=("ground",))
    points, normals, transmittance, vertices, radiosity = setting.arrays()
    frames = setting.planes.frames(vertices)
    assert plane_coverage(points, frames, setting.planes, DIRECTIONS, skip=0) is None
    light = plane_light(points, normals, transmittance, frames, radiosity, setting.planes, DIRECTIONS, skip=0)
    assert not light.numpy().any()


def test_what_does_not_fit_is_refused(device):
    setting = Setting(device, names=("ground",))
    points, normals, transmittance, vertices, radiosity = setting.arrays()
    frames = setting.planes.frames(vertices)
    with pytest.raises(ValueError, match="transmittance"):
        passing_flats(points, transmittance, frames, setting.planes, fibonacci(16))
    with pytest.raises(ValueError, match="frames"):
        passing_flats(points, transmittance, vertices, setting.planes, DIRECTIONS)
    with pytest.raises(ValueError, match="skip"):
        plane_light(points, normals, transmittance, frames, radiosity, setting.planes, DIRECTIONS, skip=1)


def test_a_far_scale_gives_finite_light_and_gradients(device):
    for scale in (1e-6, 1e8):
        mesh = ws.plane(4.0, 2).transformed(scale=scale)
        patches, planes, frames = single(device, mesh=mesh, others=scale * np.array([[0.0, 0, 0], [1, 1, 1]]))
        points = np.array([[0.1, 0.2, 0.3], [0, 0, 0], [2, 0, 2], [1e9, 1e-9, 0]]) * scale
        variables = [
            wp.array(values[None], dtype=wp.vec3, device=device, requires_grad=True)
            for values in (points, np.tile([0.0, -0.6, 0.8], (4, 1)), np.ones((patches.count, 3)))
        ]
        frames = wp.clone(frames, requires_grad=True)
        passing = wp.full((1, 4, 64), 1.0, dtype=wp.float32, device=device)
        with recorded() as tape:
            light = plane_light(variables[0], variables[1], passing, frames, variables[2], planes, DIRECTIONS)
        tape.backward(grads={light: wp.full(light.shape, wp.vec3(1.0), dtype=wp.vec3, device=device)})
        for array in (light, frames.grad, *(variable.grad for variable in variables)):
            assert np.isfinite(array.numpy()).all()
