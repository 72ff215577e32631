"""Receivers on and around a body, the light that they see past it by rays, and how errors of that count."""

from functools import partial

import numpy as np
import warp as wp

from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.maths.spatial_sort import compact_order
from warpshadow.spheres.normalized_mesh import NormalizedMesh

FIT_BUNDLE = 16
"""Directions of a receiver's hemisphere that are near each other, which a sphere reaches or misses together."""

SHARPNESS = 3.0
"""Weight of errors under a sun, next to 1 for each wider light, which do not see gaps between spheres: a tent's shadow
under a sun is 26% off, with 1 28%, with 0 35%."""

_RAY_COST = 500.0  # nanoseconds that a ray takes


@wp.kernel(enable_backward=False)
def _trace_frames(
    first_row: int,
    worker: int,
    # in
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    frames: wp.array[wp.mat33],
    directions: wp.array[wp.vec3],
    # out
    visibility: wp.array2d[wp.uint8],
):
    """Each thread owns one ray: a receiver and a direction of its own frame."""
    row, direction = wp.tid()
    receiver = first_row + row
    frame = frames[receiver]
    start = points[receiver] + 1.0e-4 * frame[2]
    is_blocked = wp.mesh_query_ray_anyhit(mesh, start, wp.transpose(frame) * directions[direction], 1.0e30)
    visibility[receiver, direction] = wp.uint8(wp.where(is_blocked, 0, 1))


def hemisphere(count: int) -> np.ndarray:
    """Directions about z with the cosine as density, each stands for as much irradiance; in bundles [count, 3]."""
    i = np.arange(count) + 0.5
    radius, azimuth = np.sqrt(i / count), i * np.pi * (1 + np.sqrt(5))
    directions = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.sqrt(1 - radius**2)], axis=1)
    return directions[compact_order(directions, runs=(FIT_BUNDLE,))]


class FitReceivers:
    """Receivers on a body, around it and in its cavities, and on grounds below it.

    Args:
        sharpness: Weight of errors under a sun relative to errors under each wider light.

    A receiver sees 128 directions of a hemisphere. Receivers on a mesh look along its normals, to both sides of an open
    one. Of the receivers in the space around a body and within its bounds, half look toward the nearest surface, and
    half anywhere: a sphere in the middle of a cavity is seen from all around it. Of a body that is seen from one side
    they are on that side, and none on grounds below.
    """

    DIRECTIONS = 128
    GROUND, SURFACE = 0.55, 0.25  # shares of the receivers on grounds and on the mesh; the others lie around it
    VISIBLE_FLOOR = 0.2  # weight of receivers that nothing can see, next to 1 for receivers in the open
    SHEET = 0.05
    """Weight of receivers on a sheet or on land, next to 1 on a solid: spheres bulge out of it and darken it, and
    shrink for that until light comes through. The shadow that 128 spheres of a tent cast is 8% off, with a weight of 1
    40%."""

    def __init__(self, mesh: NormalizedMesh, count: int, rng: np.random.Generator, *, sharpness: float = SHARPNESS):
        ground = int(self.GROUND * count) if mesh.seen_from is None else 0
        surface = int(self.SURFACE * count)
        parts = [_on_surface(mesh, surface, rng), _on_grounds(mesh, ground, rng)]
        parts.append(_around(mesh, count - ground - surface, rng))
        points, normals = (np.concatenate(item) for item in zip(*parts, strict=True))
        frames = _frames(normals, rng)
        self.frame_rows = np.column_stack([points, frames.reshape(-1, 9)]).T.astype(np.float32)
        """Points, and the rows of frames, [12, receiver]."""
        self.directions = hemisphere(self.DIRECTIONS)
        """Directions in the frame of each receiver [direction, 3]."""
        self.metric = _light_metric(self.directions, sharpness)
        """Matrix M [direction, direction] of the loss e·M e of errors e of visibility."""
        array = partial(wp.array, device=mesh.device)
        visibility = empty((count, self.DIRECTIONS), dtype=wp.uint8, device=mesh.device)
        rays = array(self.directions.astype(np.float32), dtype=wp.vec3)
        starts = array(points.astype(np.float32), dtype=wp.vec3), array(frames, dtype=wp.mat33)
        inputs = [mesh.mesh.id, *starts, rays]
        launch(_trace_frames, visibility.shape, inputs=inputs, outputs=[visibility], cost=_RAY_COST)
        self.visibility = visibility.numpy().astype(np.float32)
        """Whether light from each direction gets to each receiver [receiver, direction]."""
        # a camera in the open sees a receiver along the rays that escape, so its error counts as often
        openness = (self.visibility / self.directions[:, 2]).mean(axis=1) / 2
        floor = self.VISIBLE_FLOOR
        self.weights = (floor + (1 - floor) * np.minimum(openness, 1)).astype(np.float32)[:, None]
        """Weights of the errors at receivers [receiver, 1]."""
        if mesh.is_sheet or mesh.seen_from is not None:
            self.weights[:surface] *= self.SHEET
        self.off_surface = np.arange(surface, count)  # receivers that are not on the mesh

    def __len__(self) -> int:
        """Number of receivers."""
        return len(self.visibility)


def _on_surface(mesh: NormalizedMesh, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Half at vertices, where renderers shade, half between them."""
    parts = mesh.sample_vertices(count // 2, rng), mesh.sample(count - count // 2, rng)
    points, normals = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return points, normals


def _on_grounds(mesh: NormalizedMesh, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw receivers on grounds at and below the lowest point."""
    square = rng.uniform(-1, 1, size=(count, 2))
    square *= 1.25 * mesh.longest * np.abs(square).max(axis=1, keepdims=True) ** 0.5  # denser near the body
    depth = np.where(rng.uniform(size=count) < 0.25, 0.3 * mesh.longest, 0.0) * rng.uniform(size=count)
    points = np.column_stack([square[:, 0], mesh.low[1] - 1e-5 - depth, square[:, 1]])
    return points, np.tile([0.0, 1.0, 0.0], (count, 1))


def draw_points_around(mesh: NormalizedMesh, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw points outside a body, most near it, a third anywhere within its bounds: positions, directions toward it.

    Where it is seen from one side all are near it, on that side.
    """
    box_count = count // 3 if mesh.seen_from is None else 0
    shell_count = count - box_count
    away = rng.normal(size=(shell_count, 3))
    away *= rng.uniform(size=(shell_count, 1)) ** 2 * 0.5 * mesh.longest / np.linalg.norm(away, axis=1, keepdims=True)
    if mesh.seen_from is not None:
        away *= np.where(away @ mesh.seen_from < 0, -1.0, 1.0)[:, None]
    box_points = mesh.low + rng.uniform(size=(box_count, 3)) * (mesh.high - mesh.low)
    points = np.concatenate([mesh.sample(shell_count, rng)[0] + away, box_points])
    distances, slopes = mesh.signed_distances(points)
    is_inside = distances < 0  # and from there out of it
    points[is_inside] -= (distances[is_inside, None] - 1e-3) * slopes[is_inside]
    return points, -slopes


def _around(mesh: NormalizedMesh, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    points, bias = draw_points_around(mesh, count, rng)
    bias = 0.5 * rng.normal(size=(count, 3)) + np.where(rng.uniform(size=(count, 1)) < 0.5, bias, 0.0)
    return points, bias / np.linalg.norm(bias, axis=1, keepdims=True)


def _frames(normals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """World-to-local rotations with the normal as z and a random turn about it, float32 [receiver, 3, 3]."""
    helper = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(helper, normals)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(normals, x)
    angles = rng.uniform(0, 2 * np.pi, size=(len(normals), 1))
    rows = [np.cos(angles) * x + np.sin(angles) * y, np.cos(angles) * y - np.sin(angles) * x, normals]
    return np.stack(rows, axis=1).astype(np.float32)


def _light_metric(directions: np.ndarray, sharpness: float) -> np.ndarray:
    """Matrix M [direction, direction] of the loss e·M e of errors e of visibility, under light of several sharpnesses.

    The error is smoothed with lobes of 0.6 and 0.25 radians and with the whole hemisphere: the irradiance
    error under lights of that width from anywhere. Under a sun single directions count, with weight ``sharpness``.
    """
    count = len(directions)
    angles = np.arccos(np.clip(directions @ directions.T, -1, 1))
    metric = np.full((count, count), 1 / count) + sharpness * np.eye(count)
    for lobe in (0.6, 0.25):
        smooth = np.exp(-0.5 * (angles / lobe) ** 2)
        smooth /= smooth.sum(axis=1, keepdims=True)
        metric += smooth.T @ smooth
    return (metric / count).astype(np.float32)
