"""Stage 1: spheres that cover a mesh and reach little beyond it.

    E(c, r) = Σ_i |S_i outside the mesh|  +  BARE ∫_surface max(min_i |p − c_i| − r_i, 0) dA

Both terms are volumes: of each sphere outside the mesh, and between the surface and the spheres that miss it. The start
are balls of the medial axis, picked greedily; Adam does the rest.    [Lyu et al. 2021, section 3.2; Wang et al. 2006]
"""

from collections.abc import Iterator

import numpy as np
import warp as wp

from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.maths.directions import fibonacci
from warpshadow.spheres.adam import Adam
from warpshadow.spheres.normalized_mesh import NormalizedMesh, signed_distance

BARE = 1.0  # weight of the volume between the surface and the spheres next to that of spheres outside the mesh

EDGE = 0.25
"""The boundary between in- and outside is soft over this share of a sphere's radius, so that it has a gradient."""

SAMPLES = 32  # points of each sphere whose distance to the mesh tells how much of it is outside

_QUERY_COST = 2000.0  # nanoseconds that a signed distance takes

SURFACE_POINTS = 1024
SIDE_POINTS = 8192  # of the side from which a mesh is seen, and balls that touch it
RATE = 0.003  # first learning rate of the centers of 64 spheres or fewer


def medial_balls(mesh: NormalizedMesh, count: int, rng: np.random.Generator) -> np.ndarray:
    """Balls inside the mesh that touch it at random points, as large as fit: [ball, (x, y, z, radius)].

    A ball that touches the surface at p shrinks until it contains no other point of it.
    """
    tangent_points, normals = mesh.sample(count, rng)
    radii = np.full(count, 0.5)
    for _ in range(12):
        centers = tangent_points - radii[:, None] * normals
        nearest = mesh.nearest(centers)
        chord = nearest - tangent_points
        depth = np.maximum(-2 * (chord * normals).sum(axis=1), 1e-9)
        shrinks = np.linalg.norm(nearest - centers, axis=1) < 0.98 * radii - 1e-5
        shrinks &= np.linalg.norm(chord, axis=1) > 1e-4
        if not shrinks.any():
            break
        radii = np.where(shrinks, np.minimum(radii, np.maximum((chord**2).sum(axis=1) / depth, 1e-3)), radii)
    centers = tangent_points - radii[:, None] * normals
    radii = -mesh.signed_distances(centers)[0]
    return np.column_stack([centers, radii])[radii > 1e-3]


def greedy_cover(mesh: NormalizedMesh, count: int, rng: np.random.Generator) -> np.ndarray:
    """Pick balls greedily until they cover volume and surface, [sphere, 4].

    Balls of the medial axis fill solid parts, balls on the surface cover thin or open parts. Of a mesh that is seen
    from one side they cover that side.
    """
    if mesh.seen_from is not None:
        return _cover_side(mesh, count, rng)
    spacing = np.sqrt(mesh.area / count)
    surface_samples, _ = mesh.sample(600 + 2 * count, rng)
    flat = np.column_stack([surface_samples, np.full(len(surface_samples), 0.35 * spacing)])
    balls = np.concatenate([medial_balls(mesh, 800 + 4 * count, rng), flat])
    box_samples = mesh.low + rng.uniform(size=(6000, 3)) * (mesh.high - mesh.low)
    volume_samples = box_samples[mesh.signed_distances(box_samples)[0] < 0][: 1500 + count]
    samples = np.concatenate([volume_samples, surface_samples])
    shares = [np.full(len(part), 0.5 / max(len(part), 1)) for part in (volume_samples, surface_samples)]
    left = np.concatenate(shares).astype(np.float32)

    cover_radii = balls[:, 3] + 0.1 * spacing
    squares = (samples**2).sum(axis=1)[:, None] + (balls[:, :3] ** 2).sum(axis=1) - 2 * samples @ balls[:, :3].T
    is_covering = (squares < cover_radii**2).astype(np.float32)  # [sample, ball]
    gain = left @ is_covering
    is_picked = np.zeros(len(balls), bool)
    picked_balls = []
    for _ in range(min(count, len(balls))):
        best_ball = int(np.argmax(np.where(is_picked, -1.0, gain)))
        if gain[best_ball] < 1e-4:  # nothing left to cover: descent will find work for the rest
            best_ball = int(rng.choice(np.flatnonzero(~is_picked)))
        is_picked[best_ball] = True
        picked_balls.append(best_ball)
        covered_samples = np.flatnonzero(is_covering[:, best_ball])
        gain -= 0.9 * left[covered_samples] @ is_covering[covered_samples]
        left[covered_samples] *= 0.1
    return balls[picked_balls]


def _cover_side(mesh: NormalizedMesh, count: int, rng: np.random.Generator) -> np.ndarray:
    """Pick balls that touch the side from which a mesh is seen, each near the point farthest from those before it."""
    points, _ = mesh.sample(SIDE_POINTS, rng)
    balls = medial_balls(mesh, SIDE_POINTS, rng)
    gaps, picked_balls = np.full(len(points), np.inf), []
    for _ in range(count):
        widest = points[np.argmax(gaps)]
        ball = balls[np.argmin(np.linalg.norm(balls[:, :3] - widest, axis=1) - balls[:, 3])]
        picked_balls.append(ball)
        gaps = np.minimum(gaps, np.linalg.norm(points - ball[:3], axis=1) - ball[3])
    return np.array(picked_balls)


@wp.kernel(enable_backward=False)
def _outside_volume(
    first_row: int,
    worker: int,
    # in
    mesh: wp.uint64,
    is_sheet: bool,
    spheres: wp.array[wp.vec4],
    samples: wp.array[wp.vec3],
    # out
    volumes: wp.array2d[float],
    gradient: wp.array2d[wp.vec4],
):
    """Each thread owns a sphere and one sample of its inside, and with it a share of the sphere's volume."""
    row, sample = wp.tid()
    sphere = first_row + row
    ball = spheres[sphere]
    radius = ball[3]
    offset = radius * samples[sample]
    distance, slope = signed_distance(mesh, is_sheet, wp.vec3(ball[0], ball[1], ball[2]) + offset)

    share = 4.0 / 3.0 * wp.pi * radius * radius * radius / float(samples.shape[0])
    depth = distance / (EDGE * radius)  # from −1, inside, to 1, outside
    t = wp.clamp(0.5 + 0.5 * depth, 0.0, 1.0)
    outside_volume = share * t * t * (3.0 - 2.0 * t)
    volume_slope = share * 3.0 * t * (1.0 - t)  # by the depth
    adj_center = volume_slope / (EDGE * radius) * slope
    volumes[sphere, sample] = outside_volume
    adj_radius = 3.0 * outside_volume + wp.dot(adj_center, offset) - volume_slope * depth
    gradient[sphere, sample] = wp.vec4(adj_center[0], adj_center[1], adj_center[2], adj_radius)


@wp.kernel(enable_backward=False)
def _bare_gaps(
    # in
    points: wp.array[wp.vec3],
    spheres: wp.array[wp.vec4],
    # out
    gaps: wp.array[float],
    nearest: wp.array[int],
    gradient: wp.array[wp.vec4],
):
    """Each thread owns a point of the surface: the gap to the sphere nearest to it, 0 if that covers the point."""
    i = wp.tid()
    gap = float(1.0e30)
    nearest_ball = int(0)
    for sphere in range(spheres.shape[0]):
        ball = spheres[sphere]
        excess = wp.length(points[i] - wp.vec3(ball[0], ball[1], ball[2])) - ball[3]
        if excess < gap:
            gap = excess
            nearest_ball = sphere
    ball = spheres[nearest_ball]
    gap_gradient = wp.vec4(0.0)
    if gap > 0.0:
        away = wp.normalize(wp.vec3(ball[0], ball[1], ball[2]) - points[i])
        gap_gradient = wp.vec4(away[0], away[1], away[2], -ball[3])
    gaps[i] = wp.max(gap, 0.0)
    nearest[i] = nearest_ball
    gradient[i] = gap_gradient


def cover_energy(
    mesh: NormalizedMesh, spheres: np.ndarray, samples: np.ndarray, points: np.ndarray
) -> tuple[float, np.ndarray]:
    """Energy of a cover, and its gradient.

    Args:
        mesh: The mesh to cover.
        spheres: Centers and radii [diagonals], shape [sphere, 4].
        samples: Points evenly in the unit ball, shape [sample, 3].
        points: Points evenly on the surface, shape [point, 3].
    Returns:
        The energy, and its gradient by centers and logarithms of radii, shape [sphere, 4].
    """
    device = mesh.device
    balls = wp.array(spheres.astype(np.float32), dtype=wp.vec4, device=device)
    shape = (len(spheres), len(samples))
    volumes = empty(shape, dtype=wp.float32, device=device)
    adj_volumes = empty(shape, dtype=wp.vec4, device=device)
    inputs = [mesh.mesh.id, mesh.is_sheet, balls, wp.array(samples.astype(np.float32), dtype=wp.vec3, device=device)]
    launch(_outside_volume, shape, inputs=inputs, outputs=[volumes, adj_volumes], cost=_QUERY_COST)

    gaps = empty(len(points), dtype=wp.float32, device=device)
    nearest = empty(len(points), dtype=wp.int32, device=device)
    adj_gaps = empty(len(points), dtype=wp.vec4, device=device)
    inputs = [wp.array(points.astype(np.float32), dtype=wp.vec3, device=device), balls]
    launch(_bare_gaps, len(points), inputs=inputs, outputs=[gaps, nearest, adj_gaps])

    bare = BARE * mesh.area / len(points)
    energy = volumes.numpy().sum(dtype=np.float64) + bare * gaps.numpy().sum(dtype=np.float64)
    gradient = adj_volumes.numpy().sum(axis=1, dtype=np.float64)
    np.add.at(gradient, nearest.numpy(), bare * adj_gaps.numpy())
    return float(energy), gradient


def ball_samples(count: int, rng: np.random.Generator) -> np.ndarray:
    """Points evenly in the unit ball, turned at random, shape [count, 3]."""
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    shells = ((rng.permutation(count) + 0.5) / count) ** (1 / 3)
    return shells[:, None] * (fibonacci(count) @ rotation)


def descend_cover(
    mesh: NormalizedMesh, spheres: np.ndarray, steps: int, rng: np.random.Generator
) -> Iterator[np.ndarray]:
    """Improve a cover by Adam; yields the spheres [sphere, 4] after every step."""
    spheres = spheres.astype(np.float64)
    adam = Adam(len(spheres))
    first_rate = RATE * min(1.0, np.sqrt(64 / len(spheres)))
    for step in range(steps):
        samples, points = ball_samples(SAMPLES, rng), mesh.sample(SURFACE_POINTS, rng)[0]
        _, gradient = cover_energy(mesh, spheres, samples, points)
        adam.step(spheres, gradient, first_rate * 0.5 * (1 + np.cos(np.pi * step / steps)))
        yield spheres
