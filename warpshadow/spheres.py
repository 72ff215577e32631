"""Spheres that stand in for a mesh as it casts shadows.

    start       balls of the medial axis, picked greedily until they cover volume and surface
                [Wang et al. 2006; Lyu et al. 2021, section 3.2]
    refine      move, grow, shrink and relocate them until receivers on and around the mesh see through
                them what they see past the mesh: gradient descent on ray-traced visibility
    measure     irradiance under a sky with a sun, the spheres' against the mesh's

The start serves volume, the refinement serves light: spheres leave the mesh where that helps the shadow.
It sees the cones of warpshadow.visibility.cones with the soft edge of the directional method, so the rules
that a renderer applies to receivers on and inside spheres are part of what is fitted.

All of it happens in a frame where the mesh's bounding box has diagonal 1 and its center at the origin, y up.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import tempfile
import time
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.directions import fibonacci
from warpshadow.mesh import Mesh, vertex_normals
from warpshadow.reference import trace_visibility
from warpshadow.visibility.cones import BLEND, FADE

ALGORITHM_VERSION = 2
"""Part of the key of cached fits: raise it whenever a fit would come out differently."""

LANES = 16
"""Directions that a thread of the refinement handles at once."""


# -------------------------------------------------------------------------------- spheres


@dataclass(frozen=True, eq=False)
class Spheres:
    """Spheres on the host, validated; the arrays are read-only copies.

    Args:
        centers: Centers [scene units], float32, shape [sphere, 3].
        radii: Radii [scene units], not negative, float32, shape [sphere]; a radius of 0 blocks nothing.

    Raises:
        ValueError: naming the argument, what it got and what it accepts.
    """

    centers: np.ndarray = field(repr=False)
    radii: np.ndarray = field(repr=False)

    def __post_init__(self) -> None:
        """Copy, convert and validate the arrays."""
        for name, shape in (("centers", ("sphere", 3)), ("radii", ("sphere",))):
            values = np.array(getattr(self, name), dtype=np.float32)
            check.shape(name, values.shape, shape)
            check.finite(name, values)
            values.flags.writeable = False
            object.__setattr__(self, name, values)
        if len(self.centers) != len(self.radii):
            raise ValueError(f"radii: got {len(self.radii)} radii for {len(self.centers)} centers, expected one each")
        if (self.radii < 0).any():
            raise ValueError(f"radii: got {self.radii.min()}, expected radii that are not negative")

    def __len__(self) -> int:
        """Number of spheres."""
        return len(self.radii)

    def __repr__(self) -> str:
        """How many."""
        return f"Spheres({len(self)})"

    def transformed(
        self,
        *,
        rotation: np.ndarray | None = None,
        translation: Iterable[float] = (0, 0, 0),
        scale: float = 1.0,
    ) -> Spheres:
        """Apply a similarity x → scale · R x + t.

        Args:
            rotation: Rotation matrix R, shape [3, 3]; None for no rotation.
            translation: Vector t [scene units], shape [3].
            scale: Factor of lengths, positive.

        Returns:
            New spheres.

        Raises:
            ValueError: when the matrix is no rotation, or a number is not finite or the scale not positive.
        """
        rotation = np.eye(3) if rotation is None else np.asarray(rotation, np.float64)
        translation = np.asarray(translation, np.float64)
        check.shape("rotation", rotation.shape, (3, 3))
        check.shape("translation", translation.shape, (3,))
        check.finite("rotation", rotation)
        check.finite("translation", translation)
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4):
            raise ValueError(f"rotation: got {rotation.tolist()}, expected an orthogonal matrix")
        if not (np.isfinite(scale) and scale > 0):
            raise ValueError(f"scale: got {scale!r}, expected a positive number")
        return Spheres(scale * self.centers.astype(np.float64) @ rotation.T + translation, scale * self.radii)

    @staticmethod
    def concatenate(parts: Iterable[Spheres]) -> Spheres:
        """Put the spheres of several bodies into one set, in order."""
        parts = list(parts)
        centers = [np.zeros((0, 3), np.float32), *(part.centers for part in parts)]
        radii = [np.zeros(0, np.float32), *(part.radii for part in parts)]
        return Spheres(np.concatenate(centers), np.concatenate(radii))


@dataclass(frozen=True)
class FitReport:
    """How well spheres stand in for a mesh.

    The errors are ‖E_spheres − E_mesh‖ / ‖E_mesh‖ over receivers, E the irradiance under a sky with a sun of
    10°, for four azimuths of the sun. Receivers whose hemisphere is less than 5% open, which hardly any
    camera sees, are left out.
    """

    sphere_count: int
    coverage: float
    """Share of the surface inside the spheres, each grown by 1% of the bounding box's diagonal."""
    outside_volume: float
    """Share of the union's volume that lies outside the mesh (1 for a sheet, which has no inside)."""
    ground_error: float
    """On a square of 2.5 times the bounding box's longest side at the height of the lowest point, y up."""
    surface_error: float
    """On the mesh's own vertices, weighted by area."""
    seconds: float
    """Time of the fit when it was made."""
    cached: bool = False
    """Whether the fit was read from the cache."""

    @property
    def visibility_error(self) -> float:
        """The larger of the errors on the ground and on the surface."""
        return max(self.ground_error, self.surface_error)


class SphereFit(NamedTuple):
    """Spheres in the mesh's own coordinates, and how good they are."""

    spheres: Spheres
    report: FitReport


# -------------------------------------------------------------------------------- exact occlusion


@wp.func
def _cone_cosine(distance: float):
    """Cosine of a sphere's cone, as warpshadow.visibility.cones has it, and its slope; distance in radii."""
    cosine = 0.0
    slope = 0.0
    if distance >= 1.0 + BLEND:
        cosine = wp.sqrt(1.0 - 1.0 / (distance * distance))
        slope = 1.0 / (distance * distance * distance * cosine)
    elif distance > 1.0:
        edge = wp.sqrt(1.0 - 1.0 / ((1.0 + BLEND) * (1.0 + BLEND)))
        rise = BLEND / ((1.0 + BLEND) * (1.0 + BLEND) * (1.0 + BLEND) * edge)
        t = (distance - 1.0) / BLEND
        cosine = t * t * ((3.0 - 2.0 * t) * edge + (t - 1.0) * rise)
        slope = t * (6.0 * (1.0 - t) * edge + (3.0 * t - 2.0) * rise) / BLEND
    return cosine, slope


@wp.func
def _near_weight(distance: float):
    """Weight that fades a sphere out near its center and its derivative, at a distance in radii."""
    t = wp.min(distance / FADE, 1.0)
    return t * t * (3.0 - 2.0 * t), 6.0 * t * (1.0 - t) / FADE


@wp.kernel(enable_backward=False)
def _exact_occlusion(
    # in
    points: wp.array2d[wp.vec3],
    directions: wp.array[wp.vec3],
    centers: wp.array2d[wp.vec3],
    radii: wp.array2d[float],
    # out
    occlusion: wp.array3d[wp.uint8],
):
    """Each thread owns one ray: a receiver and a direction."""
    batch, vertex, direction = wp.tid()
    blocked = wp.uint8(0)
    for sphere in range(radii.shape[1]):
        radius = radii[batch, sphere]
        toward = centers[batch, sphere] - points[batch, vertex]
        along = wp.dot(toward, directions[direction])
        if along > 0.0 and radius > 0.0:
            distance = wp.length(toward) / radius
            if distance >= 1.0 + BLEND:
                closest = wp.length_sq(toward - along * directions[direction])
                if closest < radius * radius:
                    blocked = wp.uint8(1)
                    break
            else:
                cosine, _slope = _cone_cosine(distance)
                weight, _rise = _near_weight(distance)
                if weight > 0.5 and along > cosine * distance * radius:
                    blocked = wp.uint8(1)
                    break
    occlusion[batch, vertex, direction] = blocked


def exact_occlusion(points: wp.array, directions: wp.array, centers: wp.array, radii: wp.array) -> wp.array:
    """Test which rays spheres block, without any smoothing: the reference of the approximations.

    A receiver on or inside a sphere sees it as warpshadow.visibility.cones has it: as a hemisphere around the
    direction of its center, and not at all nearer than FADE/2 radii to the center.

    Args:
        points: Receiver positions [scene units], vec3, shape [batch, vertex].
        directions: Unit directions toward the light, vec3, shape [direction].
        centers: Sphere centers [scene units], vec3, shape [batch, sphere].
        radii: Sphere radii [scene units], float32, shape [batch, sphere].

    Returns:
        1 where a sphere blocks the ray, else 0; uint8, shape [batch, vertex, direction].

    Raises:
        ValueError: naming the argument whose shape does not fit.

    Differentiable: no.
    """
    check.shape("points", points.shape, ("batch", "vertex"))
    check.shape("directions", directions.shape, ("direction",))
    check.shape("centers", centers.shape, (points.shape[0], "sphere"))
    check.shape("radii", radii.shape, centers.shape)
    occlusion = wp.empty(points.shape + directions.shape, dtype=wp.uint8, device=points.device)
    inputs = [points, directions, centers, radii]
    wp.launch(_exact_occlusion, dim=occlusion.shape, inputs=inputs, outputs=[occlusion], device=points.device)
    return occlusion


# -------------------------------------------------------------------------------- the mesh as a body


@wp.kernel(enable_backward=False)
def _closest_points(
    # in
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    # out
    closest: wp.array[wp.vec3],
    inside: wp.array[wp.uint8],
):
    """Each thread owns one point: its nearest point of the mesh, and whether the mesh winds around it."""
    i = wp.tid()
    query = wp.mesh_query_point_sign_winding_number(mesh, points[i], 1.0e6)
    closest[i] = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
    inside[i] = wp.uint8(wp.where(query.sign < 0.0, 1, 0))


@wp.kernel(enable_backward=False)
def _trace_frames(
    # in
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    frames: wp.array[wp.mat33],
    directions: wp.array[wp.vec3],
    # out
    visibility: wp.array2d[wp.uint8],
):
    """Each thread owns one ray: a receiver and a direction of its own frame."""
    receiver, direction = wp.tid()
    frame = frames[receiver]
    start = points[receiver] + 1.0e-4 * frame[2]
    blocked = wp.mesh_query_ray_anyhit(mesh, start, wp.transpose(frame) * directions[direction], 1.0e30)
    visibility[receiver, direction] = wp.uint8(wp.where(blocked, 0, 1))


class _Body:
    """A mesh in the frame of the fit (bounding box of diagonal 1 around the origin), ready to be queried."""

    def __init__(self, positions: np.ndarray, faces: np.ndarray, device: wp.Device):
        self.device = device
        self.positions, self.faces = positions, faces
        points = wp.array(positions, dtype=wp.vec3, device=device)
        normals = vertex_normals(points.reshape((1, -1)), wp.array(faces, dtype=wp.vec3i, device=device))
        self.normals = normals.numpy()[0].astype(np.float64)
        self.mesh = wp.Mesh(points, wp.array(faces.ravel(), dtype=wp.int32, device=device), support_winding_number=True)
        corners = positions[faces].astype(np.float64)
        edges = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        lengths = np.linalg.norm(edges, axis=1)
        self.face_areas = lengths / 2
        self.face_normals = edges / np.maximum(lengths, 1e-30)[:, None]
        self.area = self.face_areas.sum()
        areas = np.bincount(faces.ravel(), np.repeat(self.face_areas, 3), minlength=len(positions))
        self.vertex_shares = areas / areas.sum()
        self.low, self.high = (
            positions.min(axis=0).astype(np.float64),
            positions.max(axis=0).astype(np.float64),
        )
        self.longest = (self.high - self.low).max()

    def sample(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draw points evenly from the surface: positions, interpolated normals, face normals."""
        shares = np.cumsum(self.face_areas) / self.area
        chosen = np.searchsorted(shares, (np.arange(count) + rng.uniform(size=count)) / count)
        chosen = np.minimum(chosen, len(shares) - 1)
        u, v = np.sqrt(rng.uniform(size=count)), rng.uniform(size=count)
        weights = np.stack([1 - u, u * (1 - v), u * v], axis=1)[:, :, None]
        corners = self.faces[chosen]
        normals = (weights * self.normals[corners]).sum(axis=1)
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        face_normals = self.face_normals[chosen]
        normals = np.where(lengths > 1e-3, normals / np.maximum(lengths, 1e-3), face_normals)
        return (weights * self.positions[corners]).sum(axis=1), normals, face_normals

    def closest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nearest points of the mesh [point, 3], and which points are inside [point]."""
        closest = wp.empty(len(points), dtype=wp.vec3, device=self.device)
        inside = wp.empty(len(points), dtype=wp.uint8, device=self.device)
        inputs = [self.mesh.id, wp.array(points.astype(np.float32), dtype=wp.vec3, device=self.device)]
        wp.launch(_closest_points, len(points), inputs=inputs, outputs=[closest, inside], device=self.device)
        return closest.numpy().astype(np.float64), inside.numpy().astype(bool)

    def vertex_receivers(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw vertices in proportion to the area around them, with their normals."""
        chosen = rng.choice(len(self.positions), count, p=self.vertex_shares)
        return self.positions[chosen].astype(np.float64), self.normals[chosen]


# -------------------------------------------------------------------------------- start


def _medial_balls(body: _Body, count: int, rng: np.random.Generator) -> np.ndarray:
    """Balls inside the mesh that touch it at random points, as large as fit: [ball, (x, y, z, radius)].

    A ball that touches the surface at p shrinks until it contains no other point of it.
    """
    touching, _, normals = body.sample(count, rng)
    radii = np.full(count, 0.5)
    for _ in range(12):
        centers = touching - radii[:, None] * normals
        closest, _ = body.closest(centers)
        chord = closest - touching
        depth = np.maximum(-2 * (chord * normals).sum(axis=1), 1e-9)
        shrinks = np.linalg.norm(closest - centers, axis=1) < 0.98 * radii - 1e-5
        shrinks &= np.linalg.norm(chord, axis=1) > 1e-4
        radii = np.where(shrinks, np.minimum(radii, np.maximum((chord**2).sum(axis=1) / depth, 1e-3)), radii)
    centers = touching - radii[:, None] * normals
    closest, inside = body.closest(centers)
    radii = np.linalg.norm(closest - centers, axis=1)
    return np.column_stack([centers, radii])[inside & (radii > 1e-3)]


def _start(body: _Body, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Pick balls greedily until they cover volume and surface: the picked, and all balls [ball, 4].

    Balls of the medial axis fill what has an inside, balls on the surface cover what is thin or open.
    """
    spacing = np.sqrt(body.area / count)
    balls = _medial_balls(body, 2000, rng)
    on_surface, _, _ = body.sample(800, rng)
    balls = np.concatenate([balls, np.column_stack([on_surface, np.full(800, 0.35 * spacing)])])
    in_box = body.low + rng.uniform(size=(20000, 3)) * (body.high - body.low)
    in_volume = in_box[body.closest(in_box)[1]][:3000]
    samples = np.concatenate([in_volume, on_surface])
    shares = [np.full(len(part), 0.5 / max(len(part), 1)) for part in (in_volume, on_surface)]
    left = np.concatenate(shares).astype(np.float32)

    reach = balls[:, 3] + 0.1 * spacing
    squares = (balls[:, :3] ** 2).sum(axis=1)[:, None] + (samples**2).sum(axis=1) - 2 * balls[:, :3] @ samples.T
    covers = (squares < reach[:, None] ** 2).astype(np.float32)
    picked = np.zeros(len(balls), bool)
    chosen = []
    for _ in range(min(count, len(balls))):
        gain = np.where(picked, -1.0, covers @ left)
        best = int(np.argmax(gain))
        if gain[best] < 1e-4:  # nothing left to cover: the refinement will find work for the rest
            best = int(rng.choice(np.flatnonzero(~picked)))
        picked[best] = True
        chosen.append(best)
        left *= 1 - 0.9 * covers[best]
    return balls[chosen], balls


# -------------------------------------------------------------------------------- refinement

_Lane = wp.types.vector(length=LANES, dtype=wp.float32)
_Sums = wp.types.vector(length=6, dtype=wp.float32)


@wp.func
def _soft_edge(distance: float, width: float):
    """Soft edge of a cone at a distance in radii: lo, hi, opacity, and their derivatives by the distance."""
    cosine, slope = _cone_cosine(distance)
    weight, weight_slope = _near_weight(distance)
    sine2 = wp.min(1.0 / (distance * distance), 1.0)
    if distance < 1.0 + BLEND:
        sine2 = 1.0 - cosine * cosine
    sine = wp.sqrt(sine2)
    cotangent = cosine / sine
    cw = wp.cos(width)
    sw = wp.sin(width)
    lo = cosine * cw - sine * sw
    lo_slope = (cw + cotangent * sw) * slope
    hi = 1.0
    hi_slope = 0.0
    if cosine < cw:
        hi = cosine * cw + sine * sw
        hi_slope = (cw - cotangent * sw) * slope
    middle = 1.0 - 0.5 * (hi + lo)
    opacity = (sine2 / (1.0 + cosine)) / middle
    opacity_slope = (0.5 * opacity * (hi_slope + lo_slope) - slope) / middle
    if opacity >= 1.0:
        opacity = 1.0
        opacity_slope = 0.0
    return lo, hi, opacity * weight, lo_slope, hi_slope, opacity_slope * weight + opacity * weight_slope


@wp.kernel(enable_backward=False)
def _project_spheres(
    # in
    points: wp.array[wp.vec3],
    frames: wp.array[wp.mat33],
    chosen: wp.array[int],
    spheres: wp.array[wp.vec4],
    width: float,
    # out
    axes: wp.array2d[wp.vec3],
    edges: wp.array2d[wp.vec3],
):
    """Each thread owns a sphere as one receiver sees it: direction in its frame; lo, 1/(hi − lo), opacity."""
    i, sphere = wp.tid()
    receiver = chosen[i]
    ball = spheres[sphere]
    radius = ball[3]
    toward = frames[receiver] * (wp.vec3(ball[0], ball[1], ball[2]) - points[receiver])
    distance = wp.max(wp.length(toward), 1.0e-9)
    lo, hi, opacity, _lo, _hi, _opacity = _soft_edge(distance / radius, width)
    if toward[2] < -radius - width * distance:
        opacity = 0.0  # wholly below the horizon
    axes[i, sphere] = toward / distance
    edges[i, sphere] = wp.vec3(lo, 1.0 / (hi - lo), opacity)


@wp.kernel(enable_backward=False)
def _transmit(
    # in
    axes: wp.array2d[wp.vec3],
    edges: wp.array2d[wp.vec3],
    directions: wp.array2d[_Lane],
    # out
    transmittance: wp.array2d[_Lane],
):
    """Each thread owns one receiver and a lane of directions."""
    i, q = wp.tid()
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


# With t = (u·ω − lo)/(hi − lo) clamped to [0, 1], s = t²(3 − 2t) and the gradient by log T_q in `upstream`,
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
    # in
    points: wp.array[wp.vec3],
    frames: wp.array[wp.mat33],
    chosen: wp.array[int],
    spheres: wp.array[wp.vec4],
    width: float,
    axes: wp.array2d[wp.vec3],
    edges: wp.array2d[wp.vec3],
    directions: wp.array2d[_Lane],
    upstream: wp.array2d[_Lane],
    # out
    gradient: wp.array2d[wp.vec4],
):
    """Each thread owns a sphere as one receiver sees it: gradient by its center and log radius."""
    i, sphere = wp.tid()
    edge = edges[i, sphere]
    result = wp.vec4(0.0)
    if edge[2] > 0.0:
        receiver = chosen[i]
        ball = spheres[sphere]
        radius = ball[3]
        axis = axes[i, sphere]
        distance = wp.max(wp.length(wp.vec3(ball[0], ball[1], ball[2]) - points[receiver]), 1.0e-9)
        _lo, _hi, _opacity, lo_slope, hi_slope, opacity_slope = _soft_edge(distance / radius, width)
        sums = _edge_sums(axis, edge, directions, upstream, i)
        factor = -6.0 * edge[2] * edge[1]
        along_axis = factor * wp.vec3(sums[0], sums[1], sums[2])
        along_hi = -factor * sums[4]
        along_lo = -factor * (sums[3] - sums[4])
        along_distance = along_lo * lo_slope + along_hi * hi_slope - sums[5] * opacity_slope
        center = (along_axis - wp.dot(along_axis, axis) * axis) / distance + (along_distance / radius) * axis
        center = wp.transpose(frames[receiver]) * center
        result = wp.vec4(center[0], center[1], center[2], -along_distance * distance / radius)
    gradient[i, sphere] = result


def _hemisphere(count: int) -> np.ndarray:
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


class _Refinement:
    """Receivers around a body, what they see past it, and how the spheres' view differs."""

    DIRECTIONS = 128
    RECEIVERS = 12288
    BATCH = 256
    WIDTHS = (0.1, 0.04)
    """Soft edge of the cones [radians], first and last."""
    RATE = 0.003
    """Learning rate of the centers of 64 spheres or fewer; ten times that for the logarithm of the radii."""
    VISIBLE_FLOOR = 0.2
    """Weight of receivers that nothing can see, next to 1 for those in the open."""
    RELOCATIONS = 9

    def __init__(self, body: _Body, rng: np.random.Generator):
        self.device, self.rng = body.device, rng
        points, normals = self._receivers(body)
        frames = _frames(normals, rng)
        directions = _hemisphere(self.DIRECTIONS)
        array = partial(wp.array, device=self.device)
        self.points = array(points.astype(np.float32), dtype=wp.vec3)
        self.frames = array(frames, dtype=wp.mat33)
        lanes = np.ascontiguousarray(directions.T, dtype=np.float32).reshape(3, -1, LANES)
        self.directions = array(lanes, dtype=_Lane)
        visibility = wp.empty((len(points), self.DIRECTIONS), dtype=wp.uint8, device=self.device)
        rays = array(directions.astype(np.float32), dtype=wp.vec3)
        wp.launch(
            _trace_frames,
            dim=visibility.shape,
            inputs=[body.mesh.id, self.points, self.frames, rays],
            outputs=[visibility],
            device=self.device,
        )
        self.visibility = visibility.numpy().astype(np.float32)
        self.metric = _light_metric(directions)
        # a camera in the open sees a receiver along the rays that escape, so its error counts as often
        openness = (self.visibility / directions[:, 2]).mean(axis=1) / 2
        floor = self.VISIBLE_FLOOR
        self.weights = (floor + (1 - floor) * np.minimum(openness, 1)).astype(np.float32)[:, None]

    def _receivers(self, body: _Body) -> tuple[np.ndarray, np.ndarray]:
        """Draw receivers on the surface, on grounds at and below the lowest point, and in a shell around."""
        rng = self.rng
        ground_count = int(0.4 * self.RECEIVERS)
        shell_count = int(0.15 * self.RECEIVERS)
        surface_count = self.RECEIVERS - ground_count - shell_count
        at_vertices = body.vertex_receivers(surface_count // 2, rng)
        between = body.sample(surface_count - surface_count // 2, rng)[:2]
        surface, surface_normals = (np.concatenate(pair) for pair in zip(at_vertices, between, strict=True))

        square = rng.uniform(-1, 1, size=(ground_count, 2))
        square *= 1.25 * body.longest * np.abs(square).max(axis=1, keepdims=True) ** 0.5  # denser near the body
        drop = np.where(rng.uniform(size=ground_count) < 0.25, 0.3 * body.longest, 0.0) * rng.uniform(size=ground_count)
        ground = np.column_stack([square[:, 0], body.low[1] - 1e-5 - drop, square[:, 1]])
        ground_normals = np.tile([0.0, 1.0, 0.0], (ground_count, 1))

        away = rng.normal(size=(shell_count, 3))
        away *= (
            rng.uniform(size=(shell_count, 1)) ** 2 * 0.5 * body.longest / np.linalg.norm(away, axis=1, keepdims=True)
        )
        shell = body.sample(shell_count, rng)[0] + away
        closest, inside = body.closest(shell)
        toward = closest - shell
        toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-6)
        toward += 0.5 * rng.normal(size=toward.shape)
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        shell[inside], toward[inside] = surface[:shell_count][inside], surface_normals[:shell_count][inside]
        return np.concatenate([surface, ground, shell]), np.concatenate([surface_normals, ground_normals, toward])

    def _project(self, chosen: wp.array, spheres: wp.array, width: float) -> tuple[wp.array, wp.array]:
        shape = (len(chosen), len(spheres))
        axes = wp.empty(shape, dtype=wp.vec3, device=self.device)
        edges = wp.empty(shape, dtype=wp.vec3, device=self.device)
        inputs = [self.points, self.frames, chosen, spheres, width]
        wp.launch(_project_spheres, dim=shape, inputs=inputs, outputs=[axes, edges], device=self.device)
        return axes, edges

    def _transmittance(self, axes: wp.array, edges: wp.array) -> np.ndarray:
        shape = (axes.shape[0], self.directions.shape[1])
        transmittance = wp.empty(shape, dtype=_Lane, device=self.device)
        inputs = [axes, edges, self.directions]
        wp.launch(_transmit, dim=shape, inputs=inputs, outputs=[transmittance], device=self.device)
        return transmittance.numpy().reshape(len(axes), -1)

    def _loss(self, transmittance: np.ndarray, chosen: np.ndarray) -> tuple[float, np.ndarray]:
        """Loss of a batch, and its gradient by the transmittance."""
        error = transmittance - self.visibility[chosen]
        upstream = (error @ self.metric) * self.weights[chosen]
        return float(np.vdot(upstream, error)) / len(chosen), upstream * (2 / len(chosen))

    def gradient(self, spheres: np.ndarray, chosen: np.ndarray, width: float) -> tuple[float, np.ndarray]:
        """Loss over the chosen receivers, and its gradient by centers and logarithms of radii [sphere, 4]."""
        batch = wp.array(chosen.astype(np.int32), dtype=wp.int32, device=self.device)
        balls = wp.array(spheres.astype(np.float32), dtype=wp.vec4, device=self.device)
        axes, edges = self._project(batch, balls, width)
        transmittance = self._transmittance(axes, edges)
        loss, upstream = self._loss(transmittance, chosen)
        upstream = (upstream * transmittance).reshape(len(chosen), -1, LANES)
        gradient = wp.empty(axes.shape, dtype=wp.vec4, device=self.device)
        wp.launch(
            _transmit_backward,
            dim=axes.shape,
            inputs=[
                *(self.points, self.frames, batch, balls, width, axes, edges, self.directions),
                wp.array(upstream.astype(np.float32), dtype=_Lane, device=self.device),
            ],
            outputs=[gradient],
            device=self.device,
        )
        return loss, gradient.numpy().sum(axis=0, dtype=np.float64)

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
        batch = wp.array(chosen.astype(np.int32), dtype=wp.int32, device=self.device)
        ball = wp.array(sphere[None].astype(np.float32), dtype=wp.vec4, device=self.device)
        return np.maximum(self._transmittance(*self._project(batch, ball, width)).astype(np.float64), 1e-6)

    def run(self, spheres: np.ndarray, balls: np.ndarray, steps: int) -> Iterator[np.ndarray]:
        """Refine spheres by Adam; yields them [sphere, 4] after every step."""
        spheres = spheres.astype(np.float64)
        mean, square = np.zeros_like(spheres), np.zeros_like(spheres)
        age = np.zeros((len(spheres), 1))
        relocation_count = min(self.RELOCATIONS, steps // 100)
        relocations = set(np.linspace(0, 0.6 * steps, relocation_count + 1).astype(int)[1:])
        first_rate = self.RATE * min(1.0, np.sqrt(64 / len(spheres)))
        queue = np.zeros(0, int)
        for step in range(steps):
            done = step / steps
            width = self.WIDTHS[0] * (self.WIDTHS[1] / self.WIDTHS[0]) ** min(1.0, 1.3 * done)
            if step in relocations:
                moved = self._relocate(spheres, balls, width)
                mean[moved] = square[moved] = age[moved] = 0
            if len(queue) < self.BATCH:
                queue = self.rng.permutation(self.RECEIVERS)
            chosen, queue = queue[: self.BATCH], queue[self.BATCH :]
            _, gradient = self.gradient(spheres, chosen, width)
            age += 1
            mean += 0.1 * (gradient - mean)
            square += 0.01 * (gradient**2 - square)
            move = mean / (1 - 0.9**age) / (np.sqrt(square / (1 - 0.99**age)) + 1e-12)
            rate = first_rate * 0.5 * (1 + np.cos(np.pi * done))
            spheres[:, :3] -= rate * move[:, :3]
            spheres[:, 3] *= np.exp(-10 * rate * move[:, 3])
            yield spheres


# -------------------------------------------------------------------------------- measurement


def _sky(directions: np.ndarray, azimuth: float) -> np.ndarray:
    """Radiance of a bright sky over a dim ground, with a sun lobe of 10° at a height of 52°."""
    sun = np.array([0.5, 0.7, 0.2]) / np.linalg.norm([0.5, 0.7, 0.2])
    c, s = np.cos(azimuth), np.sin(azimuth)
    sun = np.array([c * sun[0] + s * sun[2], sun[1], c * sun[2] - s * sun[0]])
    return 0.3 + 0.7 * np.maximum(directions[:, 1], 0) + 6 * np.exp((directions @ sun - 1) / 0.03)


def _relative_error(body: _Body, spheres: np.ndarray, points: np.ndarray, normals: np.ndarray) -> float:
    """Relative L2 error of the irradiance at receivers, over four azimuths of the sun."""
    directions = fibonacci(1024)
    array = partial(wp.array, dtype=wp.vec3, device=body.device)
    receivers, rays = array(points[None].astype(np.float32)), array(directions.astype(np.float32))
    visible = trace_visibility(body.mesh, receivers, array(normals[None].astype(np.float32)), rays).numpy()[0]
    centers = array(spheres[None, :, :3].astype(np.float32))
    radii = wp.array(spheres[None, :, 3].astype(np.float32), dtype=wp.float32, device=body.device)
    passing = 1 - exact_occlusion(receivers, rays, centers, radii).numpy()[0]
    cosine = np.maximum(normals @ directions.T, 0)
    light = np.stack([_sky(directions, azimuth) for azimuth in np.pi / 2 * np.arange(4)], axis=1)
    seen = 2 * visible.mean(axis=1) >= 0.05
    mesh = (cosine * visible)[seen] @ light
    difference = (cosine * passing)[seen] @ light - mesh
    return float(np.sqrt((difference**2).sum() / max((mesh**2).sum(), 1e-30)))


def _measure(body: _Body, spheres: np.ndarray, seconds: float) -> FitReport:
    """Judge spheres by receivers that the refinement has not seen."""
    rng = np.random.default_rng(2021)
    grid = (np.arange(24) + 0.5) / 24 - 0.5
    x, z = np.meshgrid(2.5 * body.longest * grid, 2.5 * body.longest * grid)
    ground = np.column_stack([x.ravel(), np.full(x.size, body.low[1] - 1e-5), z.ravel()])
    up = np.tile([0.0, 1.0, 0.0], (len(ground), 1))

    surface, _, _ = body.sample(4000, rng)
    gaps = np.linalg.norm(surface[:, None] - spheres[None, :, :3], axis=2) - spheres[:, 3] if len(spheres) else None
    volumes = spheres[:, 3] ** 3
    outside_volume = 0.0
    if volumes.sum() > 0:
        owner = rng.choice(len(spheres), 4000, p=volumes / volumes.sum())
        inside_ball = rng.normal(size=(4000, 3))
        inside_ball *= rng.uniform(size=(4000, 1)) ** (1 / 3) / np.linalg.norm(inside_ball, axis=1, keepdims=True)
        points = spheres[owner, :3] + inside_ball * spheres[owner, 3:]
        shared = (np.linalg.norm(points[:, None] - spheres[None, :, :3], axis=2) <= spheres[:, 3] * (1 + 1e-6)).sum(
            axis=1
        )
        share = 1 / np.maximum(shared, 1)
        outside_volume = float(share[~body.closest(points)[1]].sum() / share.sum())
    return FitReport(
        sphere_count=len(spheres),
        coverage=float((gaps.min(axis=1) <= 0.01).mean()) if len(spheres) else 0.0,
        outside_volume=outside_volume,
        ground_error=_relative_error(body, spheres, ground, up),
        surface_error=_relative_error(body, spheres, *body.vertex_receivers(600, rng)),
        seconds=seconds,
    )


# -------------------------------------------------------------------------------- fit


def fit_spheres(
    mesh: Mesh,
    count: int = 64,
    *,
    error: float | None = None,
    seed: int = 0,
    steps: int = 2000,
    device: wp.DeviceLike = "cpu",
    cache: bool = True,
    progress: bool = True,
) -> SphereFit:
    """Fit spheres to a mesh so that they cast its shadows.

    The same mesh, moved or scaled, gets the same spheres, moved or scaled (up to float32 rounding). The same
    call on the same device gives the same bits.

    Args:
        mesh: The mesh [scene units], y up; open and multi-part meshes, too.
        count: Number of spheres; 0 gives none.
        error: Instead of a count, the visibility error to reach (see FitReport), for example 0.05: the number
            of spheres is doubled from 16 until it is met, then bisected. If 1024 do not meet it, their fit
            comes with a warning.
        seed: Seed of the random choices.
        steps: Steps of gradient descent; 0 keeps the greedy start.
        device: Where to fit.
        cache: Read and write the fit in a cache on disk, by the mesh's shape and the arguments above. The
            folder is the user's cache folder, or WARPSHADOW_CACHE_DIR.
        progress: Show a progress bar when it takes longer than a second.

    Returns:
        The spheres in the mesh's coordinates, and a report. Spheres that shrank to nothing are left out.

    Raises:
        ValueError: naming the argument, what it got and what it accepts.
    """
    for name, value, least in (("count", count, 0), ("seed", seed, 0), ("steps", steps, 0)):
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
            raise ValueError(f"{name}: got {value!r}, expected an integer of at least {least}")
    if error is not None and not (np.isfinite(error) and error > 0):
        raise ValueError(f"error: got {error!r}, expected a positive number such as 0.05, or None")
    positions = np.asarray(mesh.positions, np.float64)
    faces = np.asarray(mesh.faces, np.int32)
    check.shape("mesh.positions", positions.shape, ("vertex", 3))
    check.shape("mesh.faces", faces.shape, ("face", 3))
    if not len(faces):
        raise ValueError("mesh: got no faces, expected at least one")
    used, faces = np.unique(faces, return_inverse=True)
    positions, faces = positions[used], faces.reshape(-1, 3).astype(np.int32)
    check.finite("mesh.positions", positions)
    low, high = positions.min(axis=0), positions.max(axis=0)
    middle, diagonal = (low + high) / 2, float(np.linalg.norm(high - low))
    corners = positions[faces]
    if not np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).any():
        raise ValueError("mesh: got only faces without area, expected a surface")

    # the grid makes the normalized mesh, and so the fit and its cache key, independent of float32 rounding
    normalized = (np.round((positions - middle) / diagonal * 2**18) / 2**18).astype(np.float32)
    fit = partial(_cached_fit, normalized, faces, seed, steps, wp.get_device(device), cache, progress)
    balls, report = fit(int(count)) if error is None else _search(fit, error)
    spheres = Spheres(balls[:, :3] * diagonal + middle, balls[:, 3] * diagonal)
    return SphereFit(spheres, report)


def _search(fit: partial, error: float) -> tuple[np.ndarray, FitReport]:
    """Find the least number of spheres, within an eighth, whose error is met."""
    failed, count = 0, 16
    best = fit(count)
    while best[1].visibility_error > error and count < 1024:
        failed, count = count, 2 * count
        best = fit(count)
    if best[1].visibility_error > error:
        message = f"error: {error} is not met with {count} spheres; the fit has {best[1].visibility_error:.4f}"
        warnings.warn(message, stacklevel=3)
        return best
    while count - failed > max(count // 8, 1):
        middle = (failed + count) // 2
        attempt = fit(middle)
        if attempt[1].visibility_error <= error:
            best, count = attempt, middle
        else:
            failed = middle
    return best


def _fit(
    positions: np.ndarray,
    faces: np.ndarray,
    seed: int,
    steps: int,
    device: wp.Device,
    progress: bool,
    count: int,
) -> tuple[np.ndarray, FitReport]:
    """Fit spheres [sphere, 4] to a normalized mesh."""
    from tqdm import tqdm

    began = time.perf_counter()
    body = _Body(positions, faces, device)
    spheres = np.zeros((0, 4))
    if count:
        rng = np.random.default_rng(seed)
        spheres, balls = _start(body, count, rng)
        refined = _Refinement(body, rng).run(spheres, balls, steps) if steps else iter(())
        with tqdm(total=steps, desc=f"fitting {count} spheres", delay=1.0, disable=not progress, leave=False) as bar:
            for refined_spheres in refined:
                spheres = refined_spheres
                bar.update()
    spheres = spheres[spheres[:, 3] > 1e-4].astype(np.float32)
    report = _measure(body, spheres.astype(np.float64), 0.0)
    return spheres, replace(report, seconds=time.perf_counter() - began)


# -------------------------------------------------------------------------------- cache


def _cache_folder() -> Path:
    """Folder of cached fits: WARPSHADOW_CACHE_DIR, or the platform's place for caches."""
    override = os.environ.get("WARPSHADOW_CACHE_DIR")
    if override:
        return Path(override) / "spheres"
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "warpshadow" / "spheres"


def _cached_fit(
    positions: np.ndarray,
    faces: np.ndarray,
    seed: int,
    steps: int,
    device: wp.Device,
    cache: bool,
    progress: bool,
    count: int,
) -> tuple[np.ndarray, FitReport]:
    """Read a fit from the cache, or make it and write it there."""
    fit = partial(_fit, positions, faces, seed, steps, device, progress, count)
    if not cache:
        return fit()
    kind = "cpu" if device.is_cpu else "cuda"
    key = hashlib.sha256(json.dumps([ALGORITHM_VERSION, count, seed, steps, kind, positions.shape]).encode())
    key.update(positions.tobytes())
    key.update(faces.tobytes())
    path = _cache_folder() / f"{key.hexdigest()}.npz"
    if path.exists():
        try:
            with np.load(path, allow_pickle=False) as stored:
                spheres, report = stored["spheres"], FitReport(**json.loads(str(stored["report"])))
            check.shape("spheres", spheres.shape, (report.sphere_count, 4))
            return spheres, replace(report, cached=True)
        except Exception as problem:  # whatever a damaged file raises: a fit can always be made again
            warnings.warn(f"cached fit {path} cannot be read ({problem}); fitting again", stacklevel=4)
    spheres, report = fit()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
        with os.fdopen(handle, "wb") as file:
            np.savez(file, spheres=spheres, report=json.dumps(asdict(report)))
        os.replace(temporary, path)
    except OSError as problem:
        warnings.warn(f"the fit could not be cached in {path.parent} ({problem})", stacklevel=4)
    return spheres, report


# -------------------------------------------------------------------------------- picture


def plot_spheres(mesh: Mesh, spheres: Spheres, path: str | Path) -> None:
    """Draw the spheres inside the translucent mesh, from two sides.

    Args:
        mesh: The mesh, y up.
        spheres: Spheres in the mesh's coordinates.
        path: Image file to write; the format follows its suffix.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    upright = [0, 2, 1]  # matplotlib's z is up
    figure = Figure(figsize=(12, 6), layout="constrained")
    FigureCanvasAgg(figure)
    low, high = mesh.positions.min(axis=0), mesh.positions.max(axis=0)
    middle, half = (low + high) / 2, 0.5 * (high - low).max()
    azimuth, polar = np.meshgrid(np.linspace(0, 2 * np.pi, 25), np.linspace(0, np.pi, 13))
    ball = np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)])
    stride = max(1, len(mesh.faces) // 6000)
    for place, turn in enumerate((-60, 30)):
        axes = figure.add_subplot(1, 2, place + 1, projection="3d")
        triangles = mesh.positions[mesh.faces[::stride]][:, :, upright] * [1, -1, 1]
        axes.add_collection3d(Poly3DCollection(triangles, facecolors="0.5", alpha=0.12))
        for center, radius in zip(spheres.centers[:, upright] * [1, -1, 1], spheres.radii, strict=True):
            axes.plot_surface(*(center[:, None, None] + radius * ball), color="tab:orange", alpha=0.6, linewidth=0)
        for set_limits, axis, sign in ((axes.set_xlim, 0, 1), (axes.set_ylim, 2, -1), (axes.set_zlim, 1, 1)):
            set_limits(sign * middle[axis] - half, sign * middle[axis] + half)
        axes.set_box_aspect((1, 1, 1))
        axes.view_init(elev=15, azim=turn)
        axes.set_axis_off()
    figure.suptitle(f"{mesh.name}: {len(spheres)} spheres")
    figure.savefig(path, dpi=110)
