"""Paints what a page sees: an image as a picture, and how far away everything in it is."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from warpshadow import check
from warpshadow.assets.camera import Camera, framed_points
from warpshadow.assets.color import auto_exposure, linear_to_srgb
from warpshadow.assets.light import EnvironmentMap
from warpshadow.device.threads import one_at_a_time
from warpshadow.pipeline.assembly import Geometry
from warpshadow.pipeline.choice_of_receivers import for_picture
from warpshadow.pipeline.view import View
from warpshadow.scene.scene import Scene
from warpshadow.stages.poses import Poses
from warpshadow.tuning.renderer import Renderer
from warpshadow.viewer.look import ERROR, Look
from warpshadow.viewer.page_camera import PageCamera, page_scale
from warpshadow.viewer.quality import Quality

_BACKGROUND = 0.05  # linear gray behind what is not covered
_COARSE_MAP = 64  # rows of the light while something moves: it is turned in a millisecond then
_RENDERERS, _SIZES = 6, 8  # that are kept
_HORIZON = 100.0  # a flat body goes to the horizon that is so many times as large as all bodies that are not flat
_FAR = 160.0  # depth of what is not there [page units]; viser knows none beyond 167
_RAYS = 256  # of a pixel, that an error is told against
_DEPTH_PIXELS = 256**2  # of depths, which are sent without loss

Value = TypeVar("Value")


@dataclass(frozen=True, eq=False)
class Frame:
    """What a page is sent.

    Args:
        rgb: The picture, sRGB, uint8 of shape [height, width, 3].
        depth: Distance along the view [page units], float32 of shape [row, column], which may be fewer; None where
            nobody asked for it.
        quality: What it was allowed to cost.
        seconds: How long it took.
        cells: What it was made with, in words.
        error: Relative L2 error of the bodies' pixels against rays; None where nobody asked for it.
    """

    rgb: np.ndarray
    depth: np.ndarray | None
    quality: Quality
    seconds: float
    cells: str
    error: float | None = None


class Painter:
    """Renders a scene as pages want it; what several pictures have in common is computed once.

    Args:
        scene: The scene; a method "auto" has been replaced.
        device: Warp device.
        progress: Show progress where something takes longer than a second.

    Attributes:
        scene: The scene.
        page_scale: Units of a page in a unit of the scene.
        coarse_light: The scene's light, as it is used while something moves.
    """

    def __init__(self, scene: Scene, *, device: wp.DeviceLike = "cpu", progress: bool = False):
        self.scene = scene
        self._device, self._progress = device, progress
        low, high = bounds(scene)
        self.page_scale = page_scale(low, high)
        self._renderers: Recent[Renderer] = Recent(_RENDERERS)
        self._sized: Recent[Renderer] = Recent(_SIZES)
        self._lights: Recent[EnvironmentMap | np.ndarray] = Recent(4)
        self._geometries: Recent[Geometry] = Recent(_RENDERERS)
        self.coarse_light = coarse(scene.light)

    def paint(self, look: Look, page: PageCamera, quality: Quality, *, depth: bool = False) -> Frame:
        """Paint what a page sees.

        Args:
            look: What is shown.
            page: From where.
            quality: What it may cost.
            depth: Whether distances are asked for, too.
        """
        start = time.perf_counter()
        renderer, view, camera, image = self._drawn(look, page, quality)
        error = None
        if look.shows == ERROR and not quality.is_moving:
            truth = self.image(replace(look, method="ray-traced"), page, replace(quality, rays=_RAYS))
            error = relative_error(image, truth)
            rgb = error_picture(image, truth)
        else:
            rgb = picture(image, look.stops, behind=self._behind(look, camera, quality))
        depths = None
        if depth:
            depths = self.page_scale * distances(renderer, view)
            depths = np.minimum(depths, _FAR)[:: (step := _step(depths.size)), ::step].astype(np.float32)
        settings = renderer.scene.visibility
        if settings.method == "directional":
            cells = f"{settings.directions} directions"
        else:
            cells = f"{settings.samples} rays" if settings.method == "ray-traced" else settings.method
        return Frame(rgb, depths, quality, time.perf_counter() - start, cells, error)

    def image(self, look: Look, page: PageCamera, quality: Quality) -> np.ndarray:
        """Linear RGB, premultiplied, and coverage of what a page sees, shape [height, width, 4]."""
        return self._drawn(look, page, quality)[-1]

    @one_at_a_time
    def spheres(self, look: Look) -> list[tuple[np.ndarray, np.ndarray]]:
        """Centers and radii of each body's spheres, in its own space; fitted where that was not done yet."""
        quality = Quality(1, cells=64, rays=16, supersampling=1, is_moving=True)
        _, renderer = self._renderer(replace(look, method="directional"), quality)
        rest, first = renderer.rest(), renderer.assembly.first_sphere
        centers, radii = rest.centers.numpy()[0], rest.radii.numpy()[0]
        return [(centers[a:b], radii[a:b]) for a, b in zip(first[:-1], first[1:], strict=True)]

    def natural_stops(self) -> float:
        """Exposure [stops] of the scene's own picture, of few pixels."""
        camera = self.scene.camera
        page = PageCamera((1, 0, 0, 0), (0, 0, 0), 60, camera.width, camera.height)
        look = Look.of(self.scene)
        quality = Quality(128**2, cells=64, rays=16, supersampling=1, is_moving=True)
        _, renderer = self._renderer(look, quality)
        sized = camera.stretched(*page.size(quality.pixels))
        matrix = wp.array([sized.clip_matrix()], dtype=wp.mat44, device=renderer.device)
        small = renderer.with_cameras([sized])
        return round(auto_exposure(small.draw(view=small.view(clip_matrices=matrix)).numpy()[0]), 1)

    @one_at_a_time
    def _drawn(self, look: Look, page: PageCamera, quality: Quality) -> tuple[Renderer, View, Camera, np.ndarray]:
        size = page.size(quality.pixels)
        camera = page.camera(size, page_scale=self.page_scale, near=self.scene.camera.near)
        key, renderer = self._renderer(look, quality)
        sized = self._sized.get((key, size), lambda: renderer.with_cameras([camera]))
        matrix = wp.array([camera.clip_matrix()], dtype=wp.mat44, device=renderer.device)
        view = sized.view(self._geometry(key, renderer, look), matrix)
        light = self._light_of(look, quality)
        return sized, view, camera, sized.draw(light, view=view).numpy()[0]

    def _renderer(self, look: Look, quality: Quality) -> tuple[Hashable, Renderer]:
        """The renderer of what is shown, and by what it is known."""
        scene = look.settings(self.scene, quality)
        if not quality.is_moving:  # as the light is turned; it is given to each call
            scene = replace(for_picture(replace(scene, light=self._light_of(look, quality))), light=scene.light)
        choices = look.spheres, tuple(body.receivers for body in scene.bodies), quality.is_moving
        settings = scene.visibility, scene.bounces, scene.supersampling, *choices
        key = (*vars(settings[0]).values(), *settings[1:])
        return key, self._renderers.get(key, lambda: Renderer(scene, device=self._device, progress=self._progress))

    def _geometry(self, key: Hashable, renderer: Renderer, look: Look) -> Geometry | None:
        """Where bodies are; None where the scene has them."""
        if not look.has_moved(self.scene):
            return None
        turned = [Rotation.from_rotvec(pose.rotation, degrees=True).as_matrix() for pose in look.poses]
        moved = [pose.translation for pose in look.poses]
        scales = [body.scale for body in self.scene.bodies]

        def placed() -> Geometry:
            return renderer.placed(
                Poses(
                    wp.array(np.array(turned)[None], dtype=wp.mat33, device=renderer.device),
                    wp.array(np.array(moved)[None], dtype=wp.vec3, device=renderer.device),
                    wp.array(np.array(scales)[None], dtype=wp.float32, device=renderer.device),
                )
            )

        return self._geometries.get((key, look.poses), placed)

    def _light_of(self, look: Look, quality: Quality) -> EnvironmentMap | np.ndarray:
        light = self.coarse_light if quality.is_moving else self.scene.light
        return self._lights.get((look.turn, look.scale, quality.is_moving), lambda: look.light(light))

    def _behind(self, look: Look, camera: Camera, quality: Quality) -> np.ndarray:
        """What is behind the bodies: a gray, or the light itself."""
        if not (look.shows_light and isinstance(self.scene.light, EnvironmentMap)):
            return np.full(3, _BACKGROUND, np.float32)
        light = self._light_of(look, quality)
        assert isinstance(light, EnvironmentMap)
        return light.towards(camera.rays()[1]).astype(np.float32)


class Recent(Generic[Value]):
    """What was made last, by keys.

    Args:
        count: How many are kept.
    """

    def __init__(self, count: int):
        self._count = count
        self._kept: OrderedDict[Hashable, Value] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """The value of a key, made if it is not kept."""
        if key not in self._kept:
            self._kept[key] = make()
        self._kept.move_to_end(key)
        while len(self._kept) > self._count:
            self._kept.popitem(last=False)
        return self._kept[key]


def bounds(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the box around all bodies but grounds that go to the horizon."""
    parts = [body.world_points() for body in scene.bodies]
    most = _HORIZON * np.ptp(framed_points(scene), axis=0).max()
    points = np.concatenate([part for part in parts if np.ptp(part, axis=0).max() <= most])
    return points.min(axis=0), points.max(axis=0)


def coarse(light: EnvironmentMap | np.ndarray) -> EnvironmentMap | np.ndarray:
    """Light of at most 64 rows, each pixel the mean of those that it covers, weighted by what they see of the sky."""
    if not isinstance(light, EnvironmentMap):
        return light
    step = len(light.radiance) // _COARSE_MAP
    if step < 2 or len(light.radiance) % step:
        return light
    rows, columns, _ = light.radiance.shape
    weights = light.solid_angles().reshape(-1, step, 1, 1, 1)
    blocks = light.radiance.reshape(rows // step, step, columns // step, step, 3)
    return EnvironmentMap((weights * blocks).sum(axis=(1, 3)) / (step * weights.sum(axis=(1, 3))))


def picture(image: np.ndarray, stops: float, behind: np.ndarray) -> np.ndarray:
    """What a page shows of an image: a picture as :class:`warpshadow.Picture` makes it, in a tenth of the time.

    Args:
        image: Linear RGB, premultiplied, and coverage, shape [height, width, 4].
        stops: Exposure.
        behind: Linear RGB of the background: a color of the picture [3], or radiance [height, width, 3], which is
            exposed like the rest.

    Returns:
        uint8 of shape [height, width, 3], but for a code the same.
    """
    color, alpha, factor = image[..., :3], image[..., 3:], np.float32(2.0**stops)
    if behind.ndim == 1:
        linear = np.clip(factor * color, 0, 1) + (1 - alpha) * behind
    else:
        linear = factor * (color + (1 - alpha) * behind)
    codes = np.sqrt(np.clip(linear, 0, 1))  # which spreads a table's entries about as sRGB does
    return _SRGB[(codes * (len(_SRGB) - 1) + 0.5).astype(np.int32)]


_SRGB = np.round(255 * linear_to_srgb(np.linspace(0, 1, 4096) ** 2)).astype(np.uint8)


def relative_error(image: np.ndarray, truth: np.ndarray) -> float | None:
    """Relative L2 error of color over pixels that are wholly covered in both; None where there is none."""
    covered = (image[..., 3] == 1) & (truth[..., 3] == 1)
    size = np.linalg.norm(truth[covered, :3])
    return float(np.linalg.norm((image - truth)[covered, :3]) / size) if size > 0 else None


def error_picture(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """How far an image is from the truth, a fifth of its mean as full red (too bright) or blue (too dark).

    Args:
        image: Linear RGB and coverage, shape [height, width, 4].
        truth: Likewise.

    Returns:
        uint8 of shape [height, width, 3].
    """
    covered = truth[truth[..., 3] > 0, :3]
    mean = float(covered.mean()) if len(covered) else 0.0
    excess = np.clip((image - truth)[..., :3].mean(axis=-1) / (0.2 * mean), -1, 1) if mean > 0 else 0 * image[..., 0]
    white = np.ones_like(excess)
    red, blue = np.minimum(white, 1 + excess), np.minimum(white, 1 - excess)
    return (255 * np.stack([red, np.minimum(red, blue), blue], axis=-1)).round().astype(np.uint8)


def distances(renderer: Renderer, view: View) -> np.ndarray:
    """Distance along the view of what the middle sample of each pixel sees, Inf where there is nothing.

    Args:
        renderer: Made the view.
        view: What is seen.

    Returns:
        Scene units, shape [height, width].
    """
    across = renderer.scene.supersampling
    middle = slice(across // 2, None, across)
    faces = view.fragments.face_ids.numpy()[0, middle, middle]
    weights = view.fragments.barycentrics.numpy()[0, middle, middle]
    depths = view.clip_positions.value(view.call).numpy()[0, :, 3]  # w of clip space is the distance
    corners = depths[renderer.assembly.faces.numpy()[np.maximum(faces, 0)]]
    return np.where(faces < 0, np.inf, (corners * weights).sum(axis=-1))


def _step(count: int) -> int:
    """Every so many pixels a depth is sent."""
    return max(1, int(np.ceil(np.sqrt(count / _DEPTH_PIXELS))))


def own_page(scene: Scene, scale: float) -> PageCamera:
    """The page that sees what the scene's camera sees, but for a lens that is off center."""
    camera = scene.camera
    check.instance("camera", camera, Camera, "a Camera")
    fov = np.degrees(2 * np.arctan(0.5 * camera.height / camera.intrinsics[1, 1]))
    w, x, y, z = np.roll(Rotation.from_matrix(camera.rotation.T).as_quat(), 1)
    return PageCamera((w, x, y, z), tuple(scale * camera.eye), float(fov), camera.width, camera.height)
