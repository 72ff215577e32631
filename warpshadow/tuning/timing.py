"""Timing: how long images take, as medians of warm calls in turns."""

import itertools
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import warp as wp

from warpshadow.device.progress import progress_bar
from warpshadow.pipeline.renderer import SceneRenderer
from warpshadow.scene.scene import Scene
from warpshadow.tuning.point_sample import places_of_receivers, seen_on_faces

TIMED_RECEIVERS = 2048
"""Receivers on which visibility and shading are timed, in neighborhoods, which are culled together."""

NEIGHBORS = 64  # receivers of a neighborhood


def image_times(
    scenes: Sequence[Scene], *, runs: int = 5, device: wp.DeviceLike = "cpu", progress: bool = False
) -> list[float]:
    """Estimate how long images take once kernels are compiled and renderers made, from few of their receivers.

    The whole image is timed without shadows, once for each choice of receivers. The time of shadows is measured on
    TIMED_RECEIVERS of the image's receivers, and extrapolated to all of them. Where light bounces, which takes time for
    patches, too, for any number of receivers, whole images are timed.

    Args:
        scenes: Variants of a scene, which differ in visibility, spheres and receivers.
        runs: Timed calls of each, in turns.
    Returns:
        Milliseconds of each scene's image, forward.
    """
    if any(scene.bounces for scene in scenes):
        return whole_image_times(scenes, runs=runs, device=device, progress=progress)
    keys = [tuple(body.receivers for body in scene.bodies) for scene in scenes]
    firsts = dict(zip(reversed(keys), reversed(scenes), strict=True))
    stages = {key: _SharedTiming(scene, device) for key, scene in firsts.items()}
    functions = [stages[key].sampled_shading(scene) for key, scene in zip(keys, scenes, strict=True)]
    stage_functions = [
        function for stage in stages.values() for function in (stage.draw, stage.sampled_shading(stage.scene))
    ]
    times = median_times([*functions, *stage_functions], runs, progress=progress)
    unshadowed = dict(zip(stages, zip(times[len(scenes) :: 2], times[len(scenes) + 1 :: 2], strict=True), strict=True))
    estimates = []
    for key, milliseconds in zip(keys, times, strict=False):
        whole_time, sampled_time = unshadowed[key]
        estimates.append(whole_time + stages[key].extrapolation * max(milliseconds - sampled_time, 0.0))
    return estimates


def whole_image_times(
    scenes: Sequence[Scene], *, runs: int = 3, device: wp.DeviceLike = "cpu", progress: bool = False
) -> list[float]:
    """Measure how long images take, as :func:`image_times` estimates it: milliseconds of each scene's."""
    images = [whole_image(SceneRenderer(scene, device=device)) for scene in scenes]
    return median_times(images, runs, progress=progress)


def median_times(
    functions: Sequence[Callable[[], object]],
    runs: int,
    *,
    clock: Callable[[], float] = time.perf_counter,
    progress: bool = False,
) -> list[float]:
    """Median milliseconds of functions that take turns, so that a slow moment of the machine strikes all alike.

    Each is called twice and timed the second time: the first pays for compilation and cold memory.

    Args:
        clock: Clock [s]; on one thread, ``time.process_time`` leaves out other processes of a busy machine.
    """
    times: list[list[float]] = [[] for _ in functions]
    turns = range(runs * len(functions))
    with progress_bar(len(turns), "timing, kernels to be compiled", "call", shows=progress) as bar:
        for turn in turns:
            if turn == len(functions):  # all are compiled: from here on the time that is left can be told
                bar.describe("timing")
            function = functions[turn % len(functions)]
            function()
            wp.synchronize()
            start = clock()
            function()
            wp.synchronize()
            times[turn % len(functions)].append(1e3 * (clock() - start))
            bar.update()
    return [statistics.median(item) for item in times]


class _SharedTiming:
    """Shared by all scenes with the same receivers: the image without shadows, and a sample of its receivers.

    Attributes:
        scene: Any of them, without shadows.
        draw: Draws the image.
        extrapolation: Receivers of the image divided by receivers of the sample.
    """

    def __init__(self, scene: Scene, device: wp.DeviceLike):
        shadowed_renderer = SceneRenderer(scene, device=device)
        self.scene = replace(shadowed_renderer.scene, visibility=scene.visibility.by("none"))
        self._renderer = SceneRenderer(self.scene, device=device)
        self._view = self._renderer.view()
        self.draw = whole_image(self._renderer)
        visible_samples = np.flatnonzero(self._view.fragments.face_ids.numpy()[0] >= 0)
        one_per_pixel = visible_samples[:: scene.supersampling**2]
        sides, vertices, barycentrics = seen_on_faces(self._view, one_per_pixel)
        merged_scene = self._renderer.merged_scene
        bodies = merged_scene.body_of_face[sides % len(merged_scene.body_of_face)]
        samples_receive = np.array([body.receivers != "vertex" for body in self._renderer.scene.bodies])
        receiver_rows, weights, _ = places_of_receivers(vertices, barycentrics, samples_receive[bodies])
        corners = self._renderer.geometry().positions.numpy()[0][
            vertices[receiver_rows] % merged_scene.first_vertex[-1]
        ]
        neighborhoods = _neighborhoods(np.einsum("rk,rkc->rc", weights, corners))
        # as on_faces wants them
        neighborhoods = neighborhoods[np.argsort(bodies[receiver_rows[neighborhoods]], kind="stable")]
        self._sample = sides[receiver_rows[neighborhoods]], weights[neighborhoods]
        is_adaptive = any(body.receivers == "adaptive" for body in shadowed_renderer.scene.bodies)
        # adaptive receivers are where shadows end
        view = shadowed_renderer.view() if is_adaptive else self._view
        self.extrapolation = view.receivers.points.shape[1] / len(neighborhoods)

    def sampled_shading(self, scene: Scene) -> Callable[[], object]:
        """Make the function that shades the sample as a scene does."""
        glimpse = replace(scene.camera, width=1, height=1)  # no image is drawn
        renderer = SceneRenderer(scene, cameras=[glimpse], device=self._renderer.device)
        return lambda: renderer.shade(view=renderer.on_faces(*self._sample))


def _neighborhoods(points: np.ndarray) -> np.ndarray:
    """Draw TIMED_RECEIVERS of points [point, 3], the nearest to a few of them: near points are culled together."""
    size = min(NEIGHBORS, len(points))
    centers = np.random.default_rng(0).choice(points, min(TIMED_RECEIVERS, len(points)) // size, replace=False)
    nearest = [np.argpartition(((points - center) ** 2).sum(axis=1), size - 1)[:size] for center in centers]
    return np.sort(nearest, axis=1).ravel()  # in the order of receivers


def whole_image(renderer: SceneRenderer) -> Callable[[], wp.array]:
    """Make the function that draws a whole image, without cached results of the call before.

    Each call has the bodies in another of two places, a hair's breadth from where the scene has them.
    """
    poses = renderer.scene_poses()
    extent = np.abs(renderer.geometry().positions.numpy()).max() + np.linalg.norm(renderer.scene.camera.eye)
    poses_cycle = itertools.cycle(
        replace(
            poses,
            translations=wp.array(poses.translations.numpy() + shift * extent, dtype=wp.vec3, device=renderer.device),
        )
        for shift in (1e-5, 2e-5)
    )
    return lambda: renderer.draw(view=renderer.view(renderer.placed(next(poses_cycle))))
