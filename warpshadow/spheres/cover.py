"""Stage 1: balls of the medial axis of a mesh, and on its surface, picked greedily until they cover it.

They are where the descent of stage 2 starts [Wang et al. 2006; Lyu et al. 2021, section 3.2].
"""

import numpy as np

from warpshadow.maths.directions import fibonacci
from warpshadow.spheres.normalized_mesh import NormalizedMesh

SIDE_POINTS = 8192  # of the side from which a mesh is seen, and balls that touch it


def medial_balls(mesh: NormalizedMesh, count: int, rng: np.random.Generator) -> np.ndarray:
    """Balls inside the mesh that touch it at random points, as large as fit: [ball, (x, y, z, radius)].

    A ball that touches the surface at p shrinks until it contains no other point of it.
    """
    tangent_points, normals = mesh.sample(count, rng)
    radii = np.full(count, 0.5)
    shrinking = np.arange(count)  # balls that are too large so far
    for _ in range(12):
        points, axes, large_radii = tangent_points[shrinking], normals[shrinking], radii[shrinking]
        centers = points - large_radii[:, None] * axes
        nearest = mesh.nearest(centers)
        chord = nearest - points
        depth = np.maximum(-2 * (chord * axes).sum(axis=1), 1e-9)
        shrinks = np.linalg.norm(nearest - centers, axis=1) < 0.98 * large_radii - 1e-5
        shrinks &= np.linalg.norm(chord, axis=1) > 1e-4
        if not shrinks.any():
            break
        smaller = np.minimum(large_radii, np.maximum((chord**2).sum(axis=1) / depth, 1e-3))
        shrinking = shrinking[shrinks]
        radii[shrinking] = smaller[shrinks]
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
    sample_shares = [np.full(len(part), 0.5 / max(len(part), 1)) for part in (volume_samples, surface_samples)]
    left = np.concatenate(sample_shares).astype(np.float32)

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
    """Pick balls that touch the side from which a mesh is seen, each near the point farthest from balls before it."""
    points, _ = mesh.sample(SIDE_POINTS, rng)
    balls = medial_balls(mesh, SIDE_POINTS, rng)
    gaps, picked_balls = np.full(len(points), np.inf), []
    for _ in range(count):
        widest = points[np.argmax(gaps)]
        ball = balls[np.argmin(np.linalg.norm(balls[:, :3] - widest, axis=1) - balls[:, 3])]
        picked_balls.append(ball)
        gaps = np.minimum(gaps, np.linalg.norm(points - ball[:3], axis=1) - ball[3])
    return np.array(picked_balls)


def ball_samples(count: int, rng: np.random.Generator) -> np.ndarray:
    """Points evenly in the unit ball, turned at random, shape [count, 3]."""
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    shells = ((rng.permutation(count) + 0.5) / count) ** (1 / 3)
    return shells[:, None] * (fibonacci(count) @ rotation)
