"""Errors of the spheres that approximate a mesh."""

from dataclasses import dataclass
from functools import partial

import numpy as np
import warp as wp

from warpshadow.maths.directions import fibonacci
from warpshadow.spheres.cover import ball_samples
from warpshadow.spheres.normalized_mesh import NormalizedMesh
from warpshadow.spheres.occlusion import exact_occlusion
from warpshadow.spheres.receivers import draw_points_around
from warpshadow.stages.rays.ray_tracing import trace_visibility_on_host

GROUND, SURFACE, NEARBY = 20, 400, 400  # receivers on a side of the ground's grid, on the surface and in the air
DIRECTIONS = 512  # rays from each of them


@dataclass(frozen=True)
class FitReport:
    """Errors of the spheres that approximate a mesh.

    The errors are ‖E_spheres − E_mesh‖ / ‖E_mesh‖ over receivers, E the irradiance under a sky with a sun of
    10°, for four azimuths of the sun. Receivers whose hemisphere is less than 5% open, which hardly any
    camera sees, are left out.
    """

    sphere_count: int
    coverage: float
    """Share of the surface inside the spheres, each grown by 1% of the bounding box's diagonal."""
    outside_volume: float
    """Share of the union's volume that lies outside the mesh, the air of a cavity included; 1 for a sheet."""
    ground_error: float
    """Error on a square of 2.5 times the bounding box's longest side at the height of the lowest point, y up;
    of a mesh that is seen from one side, at points near it on that side that look up, as there is no ground below."""
    surface_error: float
    """Error on the mesh's own vertices, weighted by area; on both sides of an open mesh, for any winding."""
    nearby_error: float
    """Error in the air around it and in its cavities, mostly close to the mesh, on receivers of random normals."""
    shadow_error: float
    """``ground_error`` relative to the shadow there, ‖E_spheres − E_mesh‖ / ‖E_unshadowed − E_mesh‖."""
    seconds: float
    """Time that the fit took when it was made."""
    cached: bool = False
    """Whether the fit was read from the cache."""

    @property
    def visibility_error(self) -> float:
        """The largest of the errors on the ground, on the surface and in the air."""
        return max(self.ground_error, self.surface_error, self.nearby_error)


def _sky_radiance(directions: np.ndarray, azimuth: float) -> np.ndarray:
    """Radiance of a bright sky over a dim ground, with a sun lobe of 10° at a height of 52°."""
    sun = np.array([0.5, 0.7, 0.2]) / np.linalg.norm([0.5, 0.7, 0.2])
    c, s = np.cos(azimuth), np.sin(azimuth)
    sun = np.array([c * sun[0] + s * sun[2], sun[1], c * sun[2] - s * sun[0]])
    return 0.3 + 0.7 * np.maximum(directions[:, 1], 0) + 6 * np.exp((directions @ sun - 1) / 0.03)


def _irradiance_errors(
    mesh: NormalizedMesh, spheres: np.ndarray, points: np.ndarray, normals: np.ndarray
) -> tuple[float, float]:
    """L2 error of irradiance at receivers, over four azimuths of the sun, relative to it and to its blocked part."""
    directions = fibonacci(DIRECTIONS)
    array = partial(wp.array, dtype=wp.vec3, device=mesh.device)
    receivers, rays = array(points[None].astype(np.float32)), array(directions.astype(np.float32))
    visible = trace_visibility_on_host(mesh.mesh, points, normals, directions, mesh.device)
    centers = array(spheres[None, :, :3].astype(np.float32))
    radii = wp.array(spheres[None, :, 3].astype(np.float32), dtype=wp.float32, device=mesh.device)
    transmittance = 1 - exact_occlusion(receivers, rays, centers, radii).numpy()[0]
    cosine = np.maximum(normals @ directions.T, 0)
    light = np.stack([_sky_radiance(directions, azimuth) for azimuth in np.pi / 2 * np.arange(4)], axis=1)
    is_lit = 2 * visible.mean(axis=1) >= 0.05
    expected = (cosine * visible)[is_lit] @ light
    missing_shadow, wrong_shadow = 1.0 - visible, 1.0 * transmittance - visible
    error, shadow = (float(np.linalg.norm((cosine * part)[is_lit] @ light)) for part in (wrong_shadow, missing_shadow))
    return error / max(float(np.linalg.norm(expected)), 1e-15), error / max(shadow, 1e-15)


def measure(mesh: NormalizedMesh, spheres: np.ndarray, seconds: float) -> FitReport:
    """Judge spheres [sphere, 4] by receivers that the refinement has not seen."""
    rng = np.random.default_rng(2021)
    grid = (np.arange(GROUND) + 0.5) / GROUND - 0.5
    x, z = np.meshgrid(2.5 * mesh.longest * grid, 2.5 * mesh.longest * grid)
    ground = np.column_stack([x.ravel(), np.full(x.size, mesh.low[1] - 1e-5), z.ravel()])
    if mesh.seen_from is not None:  # then nobody sees a ground below
        ground, _ = draw_points_around(mesh, x.size, rng)
    up_normals = np.tile([0.0, 1.0, 0.0], (len(ground), 1))

    outside_volume = 0.0
    if (spheres[:, 3] > 0).any():
        samples = ball_samples(16 * max(1, 512 // len(spheres)), rng)
        points = spheres[:, None, :3] + spheres[:, None, 3:] * samples
        volumes = np.broadcast_to(spheres[:, 3:] ** 3, points.shape[:2]) / _count_containing(spheres, points)
        is_outside = mesh.signed_distances(points.reshape(-1, 3))[0].reshape(volumes.shape) > 0
        outside_volume = float(volumes[is_outside].sum() / volumes.sum())
    surface, _ = mesh.sample(4000, rng)
    grown_spheres = spheres + [0, 0, 0, 0.01]
    air, _ = draw_points_around(mesh, NEARBY, rng)
    random_directions = rng.normal(size=air.shape)
    nearby = air, random_directions / np.linalg.norm(random_directions, axis=1, keepdims=True)
    ground_error, shadow_error = _irradiance_errors(mesh, spheres, ground, up_normals)
    return FitReport(
        sphere_count=len(spheres),
        coverage=float((_count_containing(grown_spheres, surface) > 0).mean()),
        outside_volume=outside_volume,
        ground_error=ground_error,
        surface_error=_irradiance_errors(mesh, spheres, *mesh.sample_vertices(SURFACE, rng))[0],
        nearby_error=_irradiance_errors(mesh, spheres, *nearby)[0],
        shadow_error=shadow_error,
        seconds=seconds,
    )


def _count_containing(spheres: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Number of spheres [sphere, 4] that contain each of the points [..., 3]."""
    count = np.zeros(points.shape[:-1])
    for sphere in spheres:
        count += ((points - sphere[:3]) ** 2).sum(axis=-1) <= (sphere[3] * (1 + 1e-6)) ** 2
    return count
