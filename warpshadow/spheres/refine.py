"""Stage 2: spheres that cast the shadows of the mesh.

Receivers are on the mesh, on grounds below it and in a shell around it. Rays tell which directions they see past the
mesh. Adam moves and scales the spheres until their transmittance, with the falloff of
warpshadow.stages.visibility.directional, agrees with that under lights of several sharpnesses. Spheres that matter
little are relocated on the way.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.lanes import lane_type, vectors_type
from warpshadow.device.launch import launch
from warpshadow.spheres.adam import Adam
from warpshadow.spheres.normalized_mesh import NormalizedMesh
from warpshadow.stages.visibility.cones import make_cone

LANES = 16
"""Directions that a thread handles at once."""

_RAY_COST = 500.0
"""Nanoseconds that a ray takes."""

_PAIR_COST = 0.5
"""Nanoseconds that a sphere costs for a receiver and a direction."""

_Lane = lane_type(LANES)
_Sums = wp.types.vector(length=6, dtype=wp.float32)
_Scalar, _Vectors = lane_type(1), vectors_type(1)
_cone = make_cone(1)

# ------------------------------------------------------------------------------------------------- transmittance


@wp.kernel
def _project_spheres(
    # in
    points: wp.array[wp.vec3],
    frames: wp.array[wp.mat33],
    chosen: wp.array[int],
    balls: wp.array2d[wp.vec4],
    width: float,
    # out
    axes: wp.array2d[wp.vec3],
    edges: wp.array2d[wp.vec3],
):
    """Each thread owns a sphere as one receiver sees it: direction in its frame; lo, 1/(hi − lo), opacity."""
    i, sphere = wp.tid()
    receiver = chosen[i]
    ball = balls[i, sphere]
    radius = ball[3]
    toward = frames[receiver] * (wp.vec3(ball[0], ball[1], ball[2]) - points[receiver])
    cone = _cone(_Vectors(_Scalar(toward[0]), _Scalar(toward[1]), _Scalar(toward[2])), 1.0 / radius)
    cosine = cone.cosine[0]
    sine2 = cone.sine2[0]
    sine = wp.sqrt(sine2)
    lo = cosine * wp.cos(width) - sine * wp.sin(width)
    inner = wp.max(sine * wp.cos(width) - cosine * wp.sin(width), 0.0)
    hi = wp.sqrt(1.0 - inner * inner)
    opacity = cone.weight[0] * wp.min((sine2 / (1.0 + cosine)) / (1.0 - 0.5 * (hi + lo)), 1.0)
    if toward[2] < -radius - width * wp.length(toward):
        opacity = 0.0  # wholly below the horizon
    axes[i, sphere] = wp.vec3(cone.axis.x[0], cone.axis.y[0], cone.axis.z[0])
    edges[i, sphere] = wp.vec3(lo, 1.0 / (hi - lo), opacity)


@wp.kernel(enable_backward=False)
def _transmit(
    first_row: int,
    worker: int,
    # in
    axes: wp.array2d[wp.vec3],
    edges: wp.array2d[wp.vec3],
    directions: wp.array2d[_Lane],
    # out
    transmittance: wp.array2d[_Lane],
):
    """Each thread owns one receiver and a lane of directions."""
    row, q = wp.tid()
    i = first_row + row
    x = directions[0, q]
    y = directions[1, q]
    z = directions[2, q]
    passing = _Lane(1.0)
    for sphere in range(axes.shape[1]):
        edge = edges[i, sphere]
        if edge[2] > 0.0:
            axis = edge[1] * axes[i, sphere]
            t = axis[0] * x + axis[1] * y + axis[2] * z - _Lane(edge[0] * edge[1])
            t = wp.min(wp.max(t, _Lane(0.0)), _Lane(1.0))
            passing = wp.cw_mul(passing, _Lane(1.0) - edge[2] * wp.cw_mul(wp.cw_mul(t, t), _Lane(3.0) - 2.0 * t))
    transmittance[i, q] = passing


# With t = k (u·ω − lo) clamped to [0, 1], k = 1/(hi − lo), s = t²(3 − 2t) and the gradient by log T_q in `upstream`,
# the factor 1 − A s of one sphere has d log T/ds = −A/(1 − A s), ds/dt = 6 t(1 − t). Six sums over the
# directions hold every derivative: of g (x, y, z), g and g t, with g = upstream t(1 − t)/(1 − A s), and of
# upstream s/(1 − A s).
# In C++ because its sums stay in vector registers: for 256 receivers × 64 spheres × 128 directions it takes
# 1.1 ms on one core, Warp's own vectors 5.7 ms.
_EDGE_SUMS = f"""
const int count = directions.shape[1] * {LANES};
const float *x = (const float*)directions.data, *y = x + count, *z = y + count;
const float *up = (const float*)upstream.data + (size_t)i * count;
const float ux = axis[0] * edge[1], uy = axis[1] * edge[1], uz = axis[2] * edge[1], u0 = edge[0] * edge[1];
float s0[{LANES}] = {{0}}, s1[{LANES}] = {{0}}, s2[{LANES}] = {{0}};
float s3[{LANES}] = {{0}}, s4[{LANES}] = {{0}}, s5[{LANES}] = {{0}};
for (int q = 0; q < count; q += {LANES}) {{
    for (int l = 0; l < {LANES}; ++l) {{
        float t = ux * x[q + l] + uy * y[q + l] + uz * z[q + l] - u0;
        t = t < 0.f ? 0.f : t;
        t = t > 1.f ? 1.f : t;
        const float s = t * t * (3.f - 2.f * t);
        float passing = 1.f - edge[2] * s;
        passing = passing < 1e-6f ? 1e-6f : passing;
        const float share = up[q + l] / passing;
        const float g = share * t * (1.f - t);
        s0[l] += g * x[q + l];
        s1[l] += g * y[q + l];
        s2[l] += g * z[q + l];
        s3[l] += g;
        s4[l] += g * t;
        s5[l] += share * s;
    }}
}}
wp::vec_t<6, wp::float32> sums;
for (int l = 0; l < {LANES}; ++l) {{
    sums[0] += s0[l]; sums[1] += s1[l]; sums[2] += s2[l];
    sums[3] += s3[l]; sums[4] += s4[l]; sums[5] += s5[l];
}}
return sums;
"""


@wp.func_native(_EDGE_SUMS)
def _edge_sums(
    axis: wp.vec3, edge: wp.vec3, directions: wp.array2d[_Lane], upstream: wp.array2d[_Lane], i: int
) -> _Sums: ...


@wp.kernel(enable_backward=False)
def _transmit_backward(
    first_row: int,
    worker: int,
    # in
    axes: wp.array2d[wp.vec3],
    edges: wp.array2d[wp.vec3],
    directions: wp.array2d[_Lane],
    upstream: wp.array2d[_Lane],
    # out
    by_axes: wp.array2d[wp.vec3],
    by_edges: wp.array2d[wp.vec3],
):
    """Each thread owns a sphere as one receiver sees it."""
    row, sphere = wp.tid()
    i = first_row + row
    edge = edges[i, sphere]
    by_axis = wp.vec3(0.0)
    by_edge = wp.vec3(0.0)
    if edge[2] > 0.0:
        sums = _edge_sums(axes[i, sphere], edge, directions, upstream, i)
        factor = -6.0 * edge[2] * edge[1]
        by_axis = factor * wp.vec3(sums[0], sums[1], sums[2])
        by_edge = wp.vec3(-factor * sums[3], factor * sums[4] / (edge[1] * edge[1]), -sums[5])
    by_axes[i, sphere] = by_axis
    by_edges[i, sphere] = by_edge


# ------------------------------------------------------------------------------------------------- receivers


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
    blocked = wp.mesh_query_ray_anyhit(mesh, start, wp.transpose(frame) * directions[direction], 1.0e30)
    visibility[receiver, direction] = wp.uint8(wp.where(blocked, 0, 1))


def hemisphere(count: int) -> np.ndarray:
    """Directions about z with the cosine as density: each stands for as much irradiance [count, 3]."""
    i = np.arange(count) + 0.5
    radius, azimuth = np.sqrt(i / count), i * np.pi * (1 + np.sqrt(5))
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.sqrt(1 - radius**2)], axis=1)


def _frames(normals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """World-to-local rotations with the normal as z and a random turn about it, float32 [receiver, 3, 3]."""
    helper = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(helper, normals)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(normals, x)
    turn = rng.uniform(0, 2 * np.pi, size=(len(normals), 1))
    rows = [np.cos(turn) * x + np.sin(turn) * y, np.cos(turn) * y - np.sin(turn) * x, normals]
    return np.stack(rows, axis=1).astype(np.float32)


def _light_metric(directions: np.ndarray) -> np.ndarray:
    """Matrix M of the loss e·M e that errors e of visibility cause under light of several sharpnesses.

    The error is smoothed with lobes of 0.6 and 0.25 radians and with the whole hemisphere: the irradiance
    error under lights of that width from anywhere.
    """
    count = len(directions)
    angles = np.arccos(np.clip(directions @ directions.T, -1, 1))
    metric = np.full((count, count), 1 / count)
    for lobe in (0.6, 0.25):
        smooth = np.exp(-0.5 * (angles / lobe) ** 2)
        smooth /= smooth.sum(axis=1, keepdims=True)
        metric += smooth.T @ smooth
    return (metric / count).astype(np.float32)


class _View(NamedTuple):
    """Spheres as the receivers of a batch see them."""

    chosen: wp.array  # [receiver] int32
    balls: wp.array  # [receiver, sphere] vec4
    axes: wp.array  # [receiver, sphere] vec3
    edges: wp.array  # [receiver, sphere] vec3


class Refinement:
    """Receivers around a body, their visibility past it by rays, and the loss of spheres against it."""

    DIRECTIONS = 128
    RECEIVERS = 12288
    GROUND, SHELL = 0.6, 0.15
    """Shares of the receivers on grounds and around the mesh; the others lie on it."""
    BATCH = 256
    WIDTHS = (0.1, 0.04)
    """Half-width of the cones' falloff [radians], first and last."""
    RATE = 0.003
    """Learning rate of the centers of 64 spheres or fewer; ten times that for the logarithm of the radii."""
    VISIBLE_FLOOR = 0.2
    """Weight of receivers that nothing can see, next to 1 for those in the open."""
    RELOCATIONS = 9

    def __init__(self, mesh: NormalizedMesh, rng: np.random.Generator):
        self.device, self.rng = mesh.device, rng
        points, normals = self._receivers(mesh)
        frames = _frames(normals, rng)
        directions = hemisphere(self.DIRECTIONS)
        array = partial(wp.array, device=self.device)
        self.points = array(points.astype(np.float32), dtype=wp.vec3)
        self.frames = array(frames, dtype=wp.mat33)
        lanes = np.ascontiguousarray(directions.T, dtype=np.float32).reshape(3, -1, LANES)
        self.directions = array(lanes, dtype=_Lane)
        visibility = wp.empty((len(points), self.DIRECTIONS), dtype=wp.uint8, device=self.device)
        rays = array(directions.astype(np.float32), dtype=wp.vec3)
        inputs = [mesh.mesh.id, self.points, self.frames, rays]
        launch(_trace_frames, visibility.shape, inputs=inputs, outputs=[visibility], cost=_RAY_COST)
        self.visibility = visibility.numpy().astype(np.float32)
        self.metric = _light_metric(directions)
        # a camera in the open sees a receiver along the rays that escape, so its error counts as often
        openness = (self.visibility / directions[:, 2]).mean(axis=1) / 2
        floor = self.VISIBLE_FLOOR
        self.weights = (floor + (1 - floor) * np.minimum(openness, 1)).astype(np.float32)[:, None]

    def _receivers(self, mesh: NormalizedMesh) -> tuple[np.ndarray, np.ndarray]:
        """Draw receivers on the surface, on grounds at and below the lowest point, and in a shell around."""
        rng = self.rng
        ground_count = int(self.GROUND * self.RECEIVERS)
        shell_count = int(self.SHELL * self.RECEIVERS)
        surface_count = self.RECEIVERS - ground_count - shell_count
        at_vertices = mesh.sample_vertices(surface_count // 2, rng)
        between = mesh.sample(surface_count - surface_count // 2, rng)
        surface, surface_normals = (np.concatenate(pair) for pair in zip(at_vertices, between, strict=True))

        square = rng.uniform(-1, 1, size=(ground_count, 2))
        square *= 1.25 * mesh.longest * np.abs(square).max(axis=1, keepdims=True) ** 0.5  # denser near the body
        drop = np.where(rng.uniform(size=ground_count) < 0.25, 0.3 * mesh.longest, 0.0) * rng.uniform(size=ground_count)
        ground = np.column_stack([square[:, 0], mesh.low[1] - 1e-5 - drop, square[:, 1]])
        ground_normals = np.tile([0.0, 1.0, 0.0], (ground_count, 1))

        away = rng.normal(size=(shell_count, 3))
        away *= (
            rng.uniform(size=(shell_count, 1)) ** 2 * 0.5 * mesh.longest / np.linalg.norm(away, axis=1, keepdims=True)
        )
        shell = mesh.sample(shell_count, rng)[0] + away
        distances, slopes = mesh.signed_distances(shell)
        inside = distances < 0
        toward = 0.5 * rng.normal(size=shell.shape) - slopes
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        shell[inside], toward[inside] = surface[:shell_count][inside], surface_normals[:shell_count][inside]
        return np.concatenate([surface, ground, shell]), np.concatenate([surface_normals, ground_normals, toward])

    def _project(self, spheres: np.ndarray, chosen: np.ndarray, width: float) -> _View:
        balls = np.broadcast_to(spheres.astype(np.float32), (len(chosen), *spheres.shape))
        view = _View(
            wp.array(chosen.astype(np.int32), dtype=wp.int32, device=self.device),
            wp.array(balls, dtype=wp.vec4, device=self.device),
            wp.empty(balls.shape[:2], dtype=wp.vec3, device=self.device),
            wp.empty(balls.shape[:2], dtype=wp.vec3, device=self.device),
        )
        inputs = [self.points, self.frames, view.chosen, view.balls, width]
        launch(_project_spheres, balls.shape[:2], inputs=inputs, outputs=[view.axes, view.edges])
        return view

    def _see_through(self, view: _View) -> np.ndarray:
        transmittance = wp.empty((len(view.chosen), self.directions.shape[1]), dtype=_Lane, device=self.device)
        launch(
            _transmit,
            transmittance.shape,
            inputs=[view.axes, view.edges, self.directions],
            outputs=[transmittance],
            cost=_PAIR_COST * LANES * view.axes.shape[1],
        )
        return transmittance.numpy().reshape(len(view.chosen), -1)

    def transmittance(self, spheres: np.ndarray, chosen: np.ndarray, width: float) -> np.ndarray:
        """Transmittance of spheres [sphere, 4] at the chosen receivers, [receiver, direction]."""
        return self._see_through(self._project(spheres, chosen, width))

    def _loss(self, transmittance: np.ndarray, chosen: np.ndarray) -> tuple[float, np.ndarray]:
        """Loss of a batch, and its gradient by the transmittance."""
        error = transmittance - self.visibility[chosen]
        upstream = (error @ self.metric) * self.weights[chosen]
        return float(np.vdot(upstream, error)) / len(chosen), upstream * (2 / len(chosen))

    def gradient(self, spheres: np.ndarray, chosen: np.ndarray, width: float) -> tuple[float, np.ndarray]:
        """Loss over the chosen receivers, and its gradient by centers and logarithms of radii [sphere, 4]."""
        view = self._project(spheres, chosen, width)
        transmittance = self._see_through(view)
        loss, by_transmittance = self._loss(transmittance, chosen)
        upstream = (by_transmittance * transmittance).astype(np.float32).reshape(len(chosen), -1, LANES)
        inputs = [view.axes, view.edges, self.directions, wp.array(upstream, dtype=_Lane, device=self.device)]
        by_view = [wp.empty_like(view.axes), wp.empty_like(view.edges)]
        cost = _PAIR_COST * self.DIRECTIONS
        launch(_transmit_backward, view.axes.shape, inputs=inputs, outputs=by_view, cost=cost)
        # every receiver has its own copy of the spheres: sums in a fixed order give the same bits on every run
        by_balls = wp.zeros_like(view.balls)
        wp.launch(
            _project_spheres,
            dim=view.balls.shape,
            inputs=[self.points, self.frames, view.chosen, view.balls, width],
            outputs=[view.axes, view.edges],
            adj_inputs=[None, None, None, by_balls, 0.0],
            adj_outputs=by_view,
            adjoint=True,
            device=self.device,
        )
        gradient = by_balls.numpy().sum(axis=0, dtype=np.float64)
        gradient[:, 3] *= spheres[:, 3]
        return loss, gradient

    def _relocate(self, spheres: np.ndarray, balls: np.ndarray, width: float) -> list[int]:
        """Move the spheres that matter least to where one helps most, in place; returns their indices."""
        rng = self.rng
        chosen = rng.choice(self.RECEIVERS, 384, replace=False)
        near = spheres[rng.choice(len(spheres), 75)]
        near = near * [1, 1, 1, 0] + 0.8 * near[:, 3:] * rng.normal(size=(75, 4)) * [1, 1, 1, 0] + near * [0, 0, 0, 1]
        near[:, 3] *= rng.uniform(0.4, 1.0, size=75)
        fresh = balls[rng.choice(len(balls), 75)]
        fresh[:, 3] = np.minimum(fresh[:, 3], 2 * np.median(spheres[:, 3])) * rng.uniform(0.5, 1.1, size=75)
        candidates = np.concatenate([fresh, near])

        alone = [self._alone(sphere, chosen, width) for sphere in spheres]
        together = np.prod(alone, axis=0)
        without = [self._loss(together / each, chosen)[0] for each in alone]
        offers = [self._alone(candidate, chosen, width) for candidate in candidates]
        current = self._loss(together, chosen)[0]
        moved = []
        for sphere in np.argsort(without)[:6]:
            rest = together / alone[sphere]
            losses = [self._loss(rest * offer, chosen)[0] for offer in offers]
            best = int(np.argmin(losses))
            if losses[best] > 0.999 * current:
                break
            spheres[sphere] = candidates[best]
            together, current = rest * offers[best], losses[best]
            moved.append(int(sphere))
        return moved

    def _alone(self, sphere: np.ndarray, chosen: np.ndarray, width: float) -> np.ndarray:
        """Transmittance of one sphere, kept from 0 so that it can be divided out again."""
        return np.maximum(self.transmittance(sphere[None], chosen, width).astype(np.float64), 1e-6)

    def run(self, spheres: np.ndarray, balls: np.ndarray, steps: int) -> Iterator[np.ndarray]:
        """Refine spheres by Adam; yields them [sphere, 4] after every step."""
        spheres = spheres.astype(np.float64)
        adam = Adam(len(spheres))
        relocation_count = min(self.RELOCATIONS, steps // 100)
        relocations = set(np.linspace(0, 0.6 * steps, relocation_count + 1).astype(int)[1:])
        first_rate = self.RATE * min(1.0, np.sqrt(64 / len(spheres)))
        queue = np.zeros(0, int)
        for step in range(steps):
            done = step / steps
            width = self.WIDTHS[0] * (self.WIDTHS[1] / self.WIDTHS[0]) ** min(1.0, 1.3 * done)
            if step in relocations:
                adam.forget(self._relocate(spheres, balls, width))
            if len(queue) < self.BATCH:
                queue = self.rng.permutation(self.RECEIVERS)
            chosen, queue = queue[: self.BATCH], queue[self.BATCH :]
            _, gradient = self.gradient(spheres, chosen, width)
            adam.step(spheres, gradient, first_rate * 0.5 * (1 + np.cos(np.pi * done)))
            yield spheres
