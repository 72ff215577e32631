"""Time of a video, before it is rendered: with a renderer, which is set up first, or as stills."""

import warp as wp

from warpshadow.device.parallel import thread_count
from warpshadow.device.progress import show_time
from warpshadow.pipeline.receivers.choice_of_receivers import for_still
from warpshadow.scene.blockers import fitted_meshes
from warpshadow.scene.scene import Scene
from warpshadow.scene.visibility import SHARED_DIRECTIONS
from warpshadow.spheres.fit import fit_seconds, is_fitted
from warpshadow.stages.self_visibility.trace import ray_count, trace_seconds

_BUNNY_FACES = 12_200
_STILL_PIXEL_SECONDS = 2.0e-5
"""Time of a pixel of a still on one thread [s]: 15 stills of that bunny on a ground, 256 × 256, took 1.15 to 1.5 s of
CPU time each (an AMD EPYC, Zen 4, busy). It grows with faces as that of other rays."""


def setup_seconds(scene: Scene, *, device: wp.DeviceLike = "cpu") -> float:
    """Estimate the time of a renderer before its first image, on one thread [s]: fits and self-visibility.

    Both are on disk for a mesh whose spheres are.
    """
    seconds = 0.0
    for fit in set(fitted_meshes(scene).values()):
        if not is_fitted(*fit, device=device):
            rays = fit.mesh.vertex_count * ray_count(fit.mesh.vertex_count)
            seconds += fit_seconds(fit.sphere_count) + trace_seconds(rays, fit.mesh.face_count)
    return seconds


def still_seconds(scene: Scene) -> float:
    """Estimate the time of a still by shared rays on one thread [s]; without bounces."""
    faces = sum(body.mesh.face_count for body in scene.bodies if not body.mesh.is_flat)
    pixels = scene.camera.width * scene.camera.height
    rays = for_still(scene).visibility.ray_count / SHARED_DIRECTIONS
    return _STILL_PIXEL_SECONDS * (max(faces, 1) / _BUNNY_FACES) ** 0.27 * pixels * rays


def remark_on_stills(scene: Scene, frame_count: int, *, device: wp.DeviceLike = "cpu") -> str:
    """Say that stills of all frames are done before a renderer is set up, where that is so; else it is empty."""
    if scene.visibility.method is not None or scene.bounces or for_still(scene).visibility.method != "ray-traced":
        return ""
    setup, stills = setup_seconds(scene, device=device), frame_count * still_seconds(scene)
    if setup <= stills:
        return ""
    threads = thread_count()
    return (
        f"the set-up, spheres and shadows of bodies on themselves, takes about {show_time(setup / threads)}, once; "
        f"--stills needs none, and all {frame_count} frames take about {show_time(max(stills / threads, 1.0))} with it"
    )
