"""Stage 2: spheres that cast the shadows of the mesh.

Adam moves and scales the spheres until receivers on and around the mesh see as much past them, with the falloff of
warpshadow.stages.visibility.falloff, as past the mesh, under lights of several sharpnesses. None leaves the mesh
altogether.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warpshadow.device.lanes import (
    lane_count,
    lane_type,
    make_lane_functions,
    module_options,
    use_vector_registers,
    vectors_type,
)
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.maths.directions import bundle_cones
from warpshadow.spheres.normalized_mesh import NormalizedMesh
from warpshadow.spheres.receivers import FIT_BUNDLE, FitReceivers
from warpshadow.stages.visibility.cones import make_cone
from warpshadow.stages.visibility.falloff import make_falloff, make_sphere_adjoint
from warpshadow.stages.visibility.traversal import sphere_view_type

TOUCHING_RADII = 0.8
"""Largest distance of a sphere's center from the body, outside of it [radii]; one in the open stands for nothing."""

RADIUS_RATE = 10.0  # step of the logarithm of a radius for a step of 1 of a center [1 / diagonals of the bounding box]

RETURN_INTERVAL = 5  # steps after which spheres that are farther off are pulled back

_SPHERE_COST = 10.0  # nanoseconds that it takes to see a sphere from a receiver
_PAIR_COST = 0.1  # nanoseconds that a sphere costs for a receiver and a direction

_Bundle = lane_type(FIT_BUNDLE)
_Sums = wp.types.vector(length=6, dtype=wp.float32)
_FRAME_ROWS = 12  # numbers that say where a receiver is: its point, and the rows of its frame


@wp.struct
class _SphereEdge:
    """The soft edge of a sphere as a receiver sees it: its opacity rises with the cosine between them."""

    low: float  # lo, the cosine at which it begins
    slope: float  # 1/(hi − lo)
    opacity: float  # A, at its end


@functools.cache
def _make_frame_axis(lanes: int) -> wp.Function:
    """Make the kernel function of a row (step 1) or a column (step 3) of the frames of a block of receivers."""
    Vectors = vectors_type(lanes)

    @wp.func(inline=True)
    def frame_axis(frame_rows: wp.array2d(dtype=Any), block: int, first: int, step: int):
        return Vectors(frame_rows[first, block], frame_rows[first + step, block], frame_rows[first + 2 * step, block])

    return frame_axis


@functools.cache
def _make_view_sphere(lanes: int) -> wp.Function:
    """Make the kernel function of a sphere as a block of receivers sees it, in their frames."""
    Lane, Vectors, SphereView = lane_type(lanes), vectors_type(lanes), sphere_view_type(lanes)
    cone_of, frame_axis, fn = make_cone(lanes), _make_frame_axis(lanes), make_lane_functions(lanes)
    dot, offset_from = fn.dot, fn.offset

    @wp.func(inline=True)
    def view_sphere(frame_rows: wp.array2d(dtype=Lane), block: int, ball: wp.vec4):
        offset = offset_from(wp.vec3(ball[0], ball[1], ball[2]), frame_axis(frame_rows, block, 0, 1))
        sphere_view = SphereView()
        sphere_view.offset = Vectors(
            dot(frame_axis(frame_rows, block, 3, 1), offset),
            dot(frame_axis(frame_rows, block, 6, 1), offset),
            dot(frame_axis(frame_rows, block, 9, 1), offset),
        )
        sphere_view.curvature = 1.0 / ball[3]
        sphere_view.cone = cone_of(sphere_view.offset, sphere_view.curvature)
        sphere_view.merge_weight = Lane(1.0)
        return sphere_view

    return view_sphere


@functools.cache
def _make_project(lanes: int) -> wp.Kernel:
    Lane = lane_type(lanes)
    view_sphere, falloff, sqrt = _make_view_sphere(lanes), make_falloff(lanes), make_lane_functions(lanes).sqrt

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def project(
        first_row: int,
        worker: int,
        # in
        frame_rows: wp.array2d(dtype=Lane),
        balls: wp.array(dtype=wp.vec4),
        cos_width: float,
        sin_width: float,
        caps: wp.array2d(dtype=wp.float32),
        # out
        axes: wp.array2d(dtype=wp.vec3),
        edges: wp.array2d(dtype=_SphereEdge),
        reached_bundles: wp.array2d(dtype=wp.int32),
    ):
        """A thread owns a block of receivers and a sphere: its direction, its edge, and the bundles that it reaches."""
        row, sphere = wp.tid()
        block = first_row + row
        sphere_view = view_sphere(frame_rows, block, balls[sphere])
        cone = sphere_view.cone
        sine = sqrt(cone.sine2)
        low = cos_width * cone.cosine - sin_width * sine
        outer = cos_width * sine + sin_width * cone.cosine
        slope, opacity = falloff(cone, sine, low, Lane(cos_width), Lane(sin_width))
        bits = Lane(0.0)  # bit b: the sphere reaches bundle b; a float is exact for up to 24
        bit = float(1.0)
        for bundle in range(caps.shape[0]):
            axial = caps[bundle, 0] * cone.axis.x + caps[bundle, 1] * cone.axis.y + caps[bundle, 2] * cone.axis.z
            excess = axial - caps[bundle, 3] * low + caps[bundle, 4] * outer
            bits += bit * wp.min(wp.max(1.0e20 * excess, Lane(0.0)), Lane(1.0))
            bit *= 2.0
        for lane in range(lanes):
            i = block * lanes + lane
            axes[i, sphere] = wp.vec3(cone.axis.x[lane], cone.axis.y[lane], cone.axis.z[lane])
            edges[i, sphere] = _SphereEdge(low[lane], slope[lane], opacity[lane])  # type: ignore[call-arg]
            reached_bundles[i, sphere] = int(bits[lane])

    return project


@functools.cache
def _make_project_adjoint(lanes: int) -> wp.Kernel:
    Lane, Vectors = lane_type(lanes), vectors_type(lanes)
    view_sphere, sphere_adjoint = _make_view_sphere(lanes), make_sphere_adjoint(lanes)
    fn, frame_axis = make_lane_functions(lanes), _make_frame_axis(lanes)
    dot, sqrt, total = fn.dot, fn.sqrt, fn.total

    @wp.kernel(module="unique", module_options=module_options(lanes), enable_backward=False)
    def project_adjoint(
        first_row: int,
        worker: int,
        # in
        frame_rows: wp.array2d(dtype=Lane),
        balls: wp.array(dtype=wp.vec4),
        cos_width: float,
        sin_width: float,
        edges: wp.array2d(dtype=_SphereEdge),
        sums: wp.array2d(dtype=_Sums),
        # out
        adj_balls: wp.array2d(dtype=wp.vec4),
    ):
        """A thread owns a block of receivers and a sphere, and sums up the gradients of all of the block."""
        row, sphere = wp.tid()
        block = first_row + row
        sphere_view = view_sphere(frame_rows, block, balls[sphere])
        sine = sqrt(sphere_view.cone.sine2)
        low = cos_width * sphere_view.cone.cosine - sin_width * sine
        x = Lane()
        y = Lane()
        z = Lane()
        sum_ = Lane()
        sum_t = Lane()
        adj_opacity = Lane()
        slope = Lane()
        for lane in range(lanes):
            i = block * lanes + lane
            edge = edges[i, sphere]
            gradient = sums[i, sphere]
            factor = -6.0 * edge.opacity
            x[lane] = factor * gradient[0]
            y[lane] = factor * gradient[1]
            z[lane] = factor * gradient[2]
            sum_[lane] = factor * gradient[3]
            sum_t[lane] = factor * gradient[4]
            adj_opacity[lane] = -gradient[5]
            slope[lane] = edge.slope
        adj_offset, adj_radius, _, _, _ = sphere_adjoint(
            sphere_view, sine, low, Lane(cos_width), Lane(sin_width), slope, adj_opacity, sum_, sum_t, Vectors(x, y, z)
        )
        adj_balls[block, sphere] = wp.vec4(
            total(dot(frame_axis(frame_rows, block, 3, 3), adj_offset)),
            total(dot(frame_axis(frame_rows, block, 4, 3), adj_offset)),
            total(dot(frame_axis(frame_rows, block, 5, 3), adj_offset)),
            total(adj_radius),
        )

    return project_adjoint


@wp.kernel(enable_backward=False)
def _transmit(
    first_row: int,
    worker: int,
    # in
    axes: wp.array2d[wp.vec3],
    edges: wp.array2d[_SphereEdge],
    reached_bundles: wp.array2d[int],
    directions: wp.array2d[_Bundle],
    # out
    transmittance: wp.array2d[_Bundle],
):
    """Each thread owns one receiver and a bundle of directions."""
    row, bundle = wp.tid()
    i = first_row + row
    x = directions[0, bundle]
    y = directions[1, bundle]
    z = directions[2, bundle]
    passing = _Bundle(1.0)
    for sphere in range(axes.shape[1]):
        if (reached_bundles[i, sphere] >> bundle) & 1 != 0:
            edge = edges[i, sphere]
            axis = edge.slope * axes[i, sphere]
            t = axis[0] * x + axis[1] * y + axis[2] * z - _Bundle(edge.low * edge.slope)
            t = wp.min(wp.max(t, _Bundle(0.0)), _Bundle(1.0))
            step = wp.cw_mul(wp.cw_mul(t, t), _Bundle(3.0) - 2.0 * t)
            passing = wp.cw_mul(passing, _Bundle(1.0) - edge.opacity * step)
    transmittance[i, bundle] = passing


# With t = k (u·ω − lo) clamped to [0, 1], k = 1/(hi − lo), s = t²(3 − 2t) and the gradient by log T_q in `upstream`,
# the factor 1 − A s of one sphere has d log T/ds = −A/(1 − A s), ds/dt = 6 t(1 − t). Six sums over the
# directions hold every derivative: of g (x, y, z), g and g t, with g = upstream t(1 − t)/(1 − A s), and of
# upstream s/(1 − A s).
# In C++ because its sums stay in vector registers: for 256 receivers × 64 spheres × 128 directions it takes
# 1.1 ms on one core, Warp's own vectors 5.7 ms.
_EDGE_SUMS = f"""
const int bundles = directions.shape[1], count = bundles * {FIT_BUNDLE};
const float *x = (const float*)directions.data, *y = x + count, *z = y + count;
const float *up = (const float*)upstream.data + (size_t)i * count;
const float slope = edge.slope;
const float ux = axis[0] * slope, uy = axis[1] * slope, uz = axis[2] * slope, u0 = edge.low * slope;
float sum[6][{FIT_BUNDLE}] = {{}};
for (int bundle = 0; bundle < bundles; ++bundle) {{
    if (!((reached_bundles >> bundle) & 1))
        continue;
    const int first = bundle * {FIT_BUNDLE};
    for (int l = 0; l < {FIT_BUNDLE}; ++l) {{
        const int q = first + l;
        float t = ux * x[q] + uy * y[q] + uz * z[q] - u0;
        t = t < 0.f ? 0.f : t;
        t = t > 1.f ? 1.f : t;
        const float s = t * t * (3.f - 2.f * t);
        float passing = 1.f - edge.opacity * s;
        passing = passing < 1e-6f ? 1e-6f : passing;
        const float by_log = up[q] / passing;
        const float g = by_log * t * (1.f - t);
        sum[0][l] += g * x[q];
        sum[1][l] += g * y[q];
        sum[2][l] += g * z[q];
        sum[3][l] += g;
        sum[4][l] += g * t;
        sum[5][l] += by_log * s;
    }}
}}
wp::vec_t<6, wp::float32> sums;
for (int k = 0; k < 6; ++k) {{
    float eight[8], four[4];
    for (int l = 0; l < 8; ++l)
        eight[l] = sum[k][l] + sum[k][l + 8];
    for (int l = 0; l < 4; ++l)
        four[l] = eight[l] + eight[l + 4];
    sums[k] = (four[0] + four[1]) + (four[2] + four[3]);
}}
return sums;
"""


@wp.func_native(_EDGE_SUMS)
def _edge_sums(
    axis: wp.vec3,
    edge: _SphereEdge,
    reached_bundles: int,
    directions: wp.array2d[_Bundle],
    upstream: wp.array2d[_Bundle],
    i: int,
) -> _Sums: ...


@wp.kernel(enable_backward=False)
def _transmit_adjoint(
    first_row: int,
    worker: int,
    # in
    axes: wp.array2d[wp.vec3],
    edges: wp.array2d[_SphereEdge],
    reached_bundles: wp.array2d[int],
    directions: wp.array2d[_Bundle],
    upstream: wp.array2d[_Bundle],
    # out
    sums: wp.array2d[_Sums],
):
    """Each thread owns a sphere as one receiver sees it."""
    row, sphere = wp.tid()
    i = first_row + row
    gradient = _Sums()
    if reached_bundles[i, sphere] != 0 and edges[i, sphere].opacity > 0.0:
        gradient = _edge_sums(axes[i, sphere], edges[i, sphere], reached_bundles[i, sphere], directions, upstream, i)
    sums[i, sphere] = gradient


class _View(NamedTuple):
    """Spheres as the receivers of a batch see them."""

    frame_rows: wp.array  # [12, block] lanes
    balls: wp.array  # [sphere] vec4
    axes: wp.array  # [receiver, sphere] vec3
    edges: wp.array  # [receiver, sphere] _SphereEdge
    reached_bundles: wp.array  # [receiver, sphere] int32: a bit for each bundle


class Adam:
    """Gradient descent that does not depend on the gradient's scale."""

    def __init__(self, count: int):
        self.mean, self.square, self.age = np.zeros((count, 4)), np.zeros((count, 4)), 0

    def step(self, spheres: np.ndarray, gradient: np.ndarray, rate: float) -> None:
        """Move spheres [sphere, 4] in place, against the gradient by centers and logarithms of radii."""
        self.age += 1
        self.mean += 0.1 * (gradient - self.mean)
        self.square += 0.01 * (gradient**2 - self.square)
        update = self.mean / (1 - 0.9**self.age) / (np.sqrt(self.square / (1 - 0.99**self.age)) + 1e-12)
        spheres[:, :3] -= rate * update[:, :3]
        spheres[:, 3] *= np.exp(-RADIUS_RATE * rate * update[:, 3])


class DescentState(NamedTuple):
    """A refinement after some of its steps: all that it goes on from, to the same bits."""

    spheres: np.ndarray  # [sphere, 4]
    mean: np.ndarray  # Adam's, [sphere, 4]
    square: np.ndarray  # Adam's, [sphere, 4]
    step_count: np.ndarray  # int, a scalar
    queue: np.ndarray  # receivers that are drawn for the next batches
    random: np.ndarray  # state of the generator, JSON

    @classmethod
    def from_optimizer(
        cls, spheres: np.ndarray, adam: Adam, queue: np.ndarray, rng: np.random.Generator
    ) -> DescentState:
        """Copy the state of the optimizer, of the spheres that it moves, and of the random numbers."""
        random = np.array(json.dumps(rng.bit_generator.state))
        return cls(spheres.copy(), adam.mean.copy(), adam.square.copy(), np.array(adam.age), queue, random)


class Refinement:
    """The loss of spheres against the visibility of receivers around a body, and its descent."""

    BATCH = 256
    WIDTHS = (0.1, 0.04)  # half-width of the cones' falloff [radians], first and last
    RATE = 0.003  # learning rate of the centers of 64 spheres or fewer; ten times that for the logarithm of the radii

    def __init__(self, mesh: NormalizedMesh, receivers: FitReceivers, rng: np.random.Generator):
        use_vector_registers(__name__, mesh.device)
        self.mesh, self.receivers, self.rng, self.device = mesh, receivers, rng, mesh.device
        bundles = np.ascontiguousarray(receivers.directions.T, dtype=np.float32).reshape(3, -1, FIT_BUNDLE)
        self.directions = wp.array(bundles, dtype=_Bundle, device=self.device)
        caps = np.column_stack(bundle_cones(receivers.directions, max(self.WIDTHS), FIT_BUNDLE))
        self.caps = wp.array(caps, dtype=wp.float32, device=self.device)

    def _project(self, spheres: np.ndarray, receiver_indices: np.ndarray, width: float) -> _View:
        lanes = lane_count(self.device)
        padded_indices = np.pad(receiver_indices, (0, -len(receiver_indices) % lanes), mode="edge")
        frame_rows = np.ascontiguousarray(self.receivers.frame_rows[:, padded_indices]).reshape(_FRAME_ROWS, -1, lanes)
        frame_lanes = wp.array(frame_rows, dtype=lane_type(lanes), device=self.device)
        balls = wp.array(spheres.astype(np.float32), dtype=wp.vec4, device=self.device)
        shape = len(padded_indices), len(spheres)
        outputs = [empty(shape, dtype=dtype, device=self.device) for dtype in (wp.vec3, _SphereEdge, wp.int32)]
        launch(
            _make_project(lanes),
            (frame_lanes.shape[1], len(spheres)),
            inputs=[frame_lanes, balls, np.cos(width), np.sin(width), self.caps],
            outputs=outputs,
            cost=_SPHERE_COST * lanes,
        )
        return _View(frame_lanes, balls, *outputs)

    def _find_transmittance(self, view: _View) -> np.ndarray:
        count, sphere_count = view.axes.shape
        transmittance = empty((count, self.directions.shape[1]), dtype=_Bundle, device=self.device)
        launch(
            _transmit,
            transmittance.shape,
            inputs=[view.axes, view.edges, view.reached_bundles, self.directions],
            outputs=[transmittance],
            cost=_PAIR_COST * FIT_BUNDLE * sphere_count,
        )
        return transmittance.numpy().reshape(count, -1)

    def transmittance(self, spheres: np.ndarray, receiver_indices: np.ndarray, width: float) -> np.ndarray:
        """Transmittance of spheres [sphere, 4] at the chosen receivers, [receiver, direction]."""
        return self._find_transmittance(self._project(spheres, receiver_indices, width))[: len(receiver_indices)]

    def _loss(self, transmittance: np.ndarray, receiver_indices: np.ndarray) -> tuple[float, np.ndarray]:
        """Loss of a batch, and its gradient by the transmittance."""
        errors = transmittance - self.receivers.visibility[receiver_indices]
        weighted_errors = (errors @ self.receivers.metric) * (
            self.receivers.weights[receiver_indices] / len(receiver_indices)
        )
        return float(np.vdot(weighted_errors, errors)), 2 * weighted_errors

    def gradient(self, spheres: np.ndarray, receiver_indices: np.ndarray, width: float) -> tuple[float, np.ndarray]:
        """Loss over the chosen receivers, and its gradient by centers and logarithms of radii [sphere, 4]."""
        view = self._project(spheres, receiver_indices, width)
        transmittance = self._find_transmittance(view)
        upstream = np.zeros_like(transmittance)
        passing = transmittance[: len(receiver_indices)]
        loss, adj_transmittance = self._loss(passing, receiver_indices)
        upstream[: len(receiver_indices)] = adj_transmittance * passing
        adj_logs = wp.array(upstream.reshape(len(upstream), -1, FIT_BUNDLE), dtype=_Bundle, device=self.device)
        sums = empty(view.axes.shape, dtype=_Sums, device=self.device)
        inputs = [view.axes, view.edges, view.reached_bundles, self.directions, adj_logs]
        cost = 2 * _PAIR_COST * len(self.receivers.directions)
        launch(_transmit_adjoint, sums.shape, inputs=inputs, outputs=[sums], cost=cost)
        # every block of receivers has a gradient of its own: sums in a fixed order give the same bits on every run
        shape = view.frame_rows.shape[1], len(spheres)
        adj_balls = empty(shape, dtype=wp.vec4, device=self.device)
        inputs = [view.frame_rows, view.balls, np.cos(width), np.sin(width), view.edges, sums]
        lanes = lane_count(self.device)
        launch(_make_project_adjoint(lanes), shape, inputs=inputs, outputs=[adj_balls], cost=2 * _SPHERE_COST * lanes)
        gradient = adj_balls.numpy().sum(axis=0, dtype=np.float64)
        gradient[:, 3] *= spheres[:, 3]
        return loss, gradient

    def _return_to_body(self, spheres: np.ndarray) -> None:
        """Move spheres that left the body to where they touch it, in place."""
        distances, slopes = self.mesh.signed_distances(spheres[:, :3])
        excess = np.maximum(distances - TOUCHING_RADII * spheres[:, 3], 0.0)
        spheres[:, :3] -= excess[:, None] * slopes

    def run(self, start: np.ndarray | DescentState, steps: int) -> Iterator[DescentState]:
        """Refine spheres [sphere, 4] by Adam, or go on with that; yields where it is after every step."""
        resumed_state = start if isinstance(start, DescentState) else None
        spheres = np.array(start if resumed_state is None else resumed_state.spheres, np.float64)
        adam, queue = Adam(len(spheres)), np.zeros(0, int)
        if resumed_state is not None:
            adam.mean, adam.square, adam.age = (
                resumed_state.mean.copy(),
                resumed_state.square.copy(),
                int(resumed_state.step_count),
            )
            queue, self.rng.bit_generator.state = resumed_state.queue, json.loads(str(resumed_state.random))
        first_rate = self.RATE * min(1.0, np.sqrt(64 / len(spheres)))
        for step in range(adam.age, steps):
            progress_share = step / steps
            width = self.WIDTHS[0] * (self.WIDTHS[1] / self.WIDTHS[0]) ** min(1.0, 1.3 * progress_share)
            if len(queue) < self.BATCH:
                queue = self.rng.permutation(len(self.receivers))
            receiver_indices, queue = queue[: self.BATCH], queue[self.BATCH :]
            _, gradient = self.gradient(spheres, receiver_indices, width)
            adam.step(spheres, gradient, first_rate * 0.5 * (1 + np.cos(np.pi * progress_share)))
            if step % RETURN_INTERVAL == 0 or step == steps - 1:
                self._return_to_body(spheres)
            yield DescentState.from_optimizer(spheres, adam, queue, self.rng)
