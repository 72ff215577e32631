"""Paint the view of a page: an image as a picture, and its depth."""

import functools
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from warpshadow import check
from warpshadow.assets.camera import Camera, framed_points
from warpshadow.assets.color import auto_exposure, linear_to_srgb
from warpshadow.assets.known_light import as_light
from warpshadow.assets.light import KnownLightArgument
from warpshadow.device.threads import locked
from warpshadow.pipeline.bodies.geometry import Geometry
from warpshadow.pipeline.bodies.self_visibility import SelfVisibility
from warpshadow.pipeline.receivers.choice_of_receivers import for_still
from warpshadow.pipeline.views.view import View
from warpshadow.rendering.renderer import Renderer
from warpshadow.scene.scene import Scene
from warpshadow.stages.geometry.poses import Poses
from warpshadow.stages.shell.shell_rays import exits_on_host
from warpshadow.viewer.page_camera import PageCamera, page_scale
from warpshadow.viewer.quality import Quality
from warpshadow.viewer.state import ERROR, ViewerState

_BACKGROUND = 0.05  # linear gray behind uncovered pixels
_COARSE_MAP = 64  # rows of the light while something moves: it is turned in a millisecond then
_RENDERERS, _SIZES = 6, 8  # that are cached
_NUMBERS = 64  # of gloss that are cached: an array that stays is known to be the same
_HORIZON = 100.0  # a flat body goes to the horizon that is so many times as large as all bodies that are not flat
_FAR = 160.0  # depth of uncovered pixels [page units]; viser knows none beyond 167
_RAYS = 256  # of a pixel, that an error is told against
_DEPTH_PIXELS = 256**2  # of depths, which are sent without loss

Value = TypeVar("Value")


@dataclass(frozen=True, eq=False)
class Frame:
    """A message to a page."""

    rgb: np.ndarray  # the picture, sRGB, uint8 of shape [height, width, 3]
    depth: np.ndarray | None  # distance along the view [page units], [row, column], maybe fewer; None if unasked
    quality: Quality  # the quality it was made with
    seconds: float  # how long it took
    cells: str  # its cells, in words
    error: float | None = None  # relative L2 error of the bodies' pixels against rays; None if unasked


class Painter:
    """Render a scene for pages; values that several pictures share are computed once.

    Attributes:
        page_scale: Units of a page in a unit of the scene.
        coarse_light: The scene's light, as it is used while something moves.
        has_map: Whether the light is a map, which is drawn behind the bodies and beside the controls.
    """

    def __init__(self, scene: Scene, *, device: wp.DeviceLike = "cpu", progress: bool = False):
        self.scene = scene = scene.with_method()
        self.has_map = scene.known_light.as_map is not None
        self._device, self._progress = device, progress
        low, high = bounds(scene)
        self.page_scale = page_scale(low, high)
        self._renderers: RecentCache[Renderer] = RecentCache(_RENDERERS)
        self._sized: RecentCache[Renderer] = RecentCache(_SIZES)
        self._lights: RecentCache[KnownLightArgument] = RecentCache(4)
        self._geometries: RecentCache[Geometry] = RecentCache(_RENDERERS)
        self._numbers: RecentCache[wp.array] = RecentCache(_NUMBERS)
        self.coarse_light = scene.known_light.coarsened(_COARSE_MAP).as_argument

    def paint(self, viewer_state: ViewerState, page: PageCamera, quality: Quality, *, depth: bool = False) -> Frame:
        """Paint the image of a page."""
        start = time.perf_counter()
        renderer, view, camera, image = self._drawn(viewer_state, page, quality)
        error = None
        if viewer_state.shows == ERROR and not quality.is_moving:
            reference = self.image(
                replace(viewer_state, method="ray-traced", sampling="independent"), page, replace(quality, rays=_RAYS)
            )
            error = relative_error(image, reference)
            rgb = error_picture(image, reference)
        else:
            rgb = picture(image, viewer_state.stops, background=self._behind(viewer_state, camera, quality))
        depths = None
        if depth:
            depths = self.page_scale * distances(renderer, view)
            step = max(1, int(np.ceil(np.sqrt(depths.size / _DEPTH_PIXELS))))
            depths = np.minimum(depths, _FAR)[::step, ::step].astype(np.float32)
        settings = renderer.scene.visibility
        if settings.method == "directional":
            cells = f"{settings.directions} directions"
        else:
            cells = f"{settings.ray_count} rays" if settings.method == "ray-traced" else str(settings.method)
        return Frame(rgb, depths, quality, time.perf_counter() - start, cells, error)

    def image(self, viewer_state: ViewerState, page: PageCamera, quality: Quality) -> np.ndarray:
        """Linear RGB, premultiplied, and coverage of a page's view, shape [height, width, 4]."""
        return self._drawn(viewer_state, page, quality)[-1]

    @locked
    def spheres(self, viewer_state: ViewerState) -> list[tuple[np.ndarray, np.ndarray]]:
        """Centers and radii of each body's spheres, in its own space; fitted where that was not done yet."""
        quality = Quality(1, cells=64, rays=16, supersampling=1, is_moving=True)
        _, renderer = self._renderer(replace(viewer_state, method="directional"), quality)
        rest, first = renderer.rest(), renderer.merged_scene.first_sphere
        centers, radii = rest.centers.numpy()[0], rest.radii.numpy()[0]
        return [(centers[a:b], radii[a:b]) for a, b in zip(first[:-1], first[1:], strict=True)]

    def has_tables(self, viewer_state: ViewerState, quality: Quality) -> bool:
        """Whether the disk has the shadows of all bodies on themselves that images of a quality look up."""
        _, renderer = self._renderer(viewer_state, quality)
        samples_receive = np.array([body.receivers != "vertex" for body in renderer.scene.bodies])
        return SelfVisibility(renderer.merged_scene, samples_receive).is_cached

    def natural_stops(self, viewer_state: ViewerState | None = None) -> float:
        """Exposure [stops] of the picture of a look, by default the scene's own, of few pixels."""
        viewer_state = viewer_state or ViewerState.of(self.scene)
        camera = self.scene.camera
        page = PageCamera((1, 0, 0, 0), (0, 0, 0), 60, camera.width, camera.height)
        quality = Quality(128**2, cells=64, rays=16, supersampling=1, is_moving=True)
        _, renderer = self._renderer(viewer_state, quality)
        resized_camera = camera.stretched(*page.size(quality.pixels))
        matrix = wp.array([resized_camera.clip_matrix()], dtype=wp.mat44, device=renderer.device)
        small_renderer = renderer.with_cameras([resized_camera])
        return round(auto_exposure(small_renderer.draw(view=small_renderer.view(clip_matrices=matrix)).numpy()[0]), 1)

    @locked
    def _drawn(
        self, viewer_state: ViewerState, page: PageCamera, quality: Quality
    ) -> tuple[Renderer, View, Camera, np.ndarray]:
        size = page.size(quality.pixels)
        camera = page.camera(size, page_scale=self.page_scale, near=self.scene.camera.near)
        key, renderer = self._renderer(viewer_state, quality)
        sized_renderer = self._sized.get((key, size), lambda: renderer.with_cameras([camera]))
        matrix = wp.array([camera.clip_matrix()], dtype=wp.mat44, device=renderer.device)
        view = sized_renderer.view(self._geometry(key, renderer, viewer_state), matrix)
        light = self._light_of(viewer_state, quality)
        gloss = self._gloss(viewer_state, renderer.device)
        return sized_renderer, view, camera, sized_renderer.draw(light, **gloss, view=view).numpy()[0]

    def _renderer(self, viewer_state: ViewerState, quality: Quality) -> tuple[Hashable, Renderer]:
        """The renderer of the current state, and its key."""
        scene = viewer_state.settings(self.scene, quality)
        if not quality.is_moving:  # as the light is turned; it is given to each call
            scene = replace(for_still(replace(scene, light=self._light_of(viewer_state, quality))), light=scene.light)
        choices = viewer_state.spheres, tuple(body.receivers for body in scene.bodies), quality.is_moving
        settings = scene.visibility, scene.bounces, scene.supersampling, *choices
        key = (*vars(settings[0]).values(), *settings[1:])
        return key, self._renderers.get(key, lambda: Renderer(scene, device=self._device, progress=self._progress))

    def _gloss(self, viewer_state: ViewerState, device: wp.Device) -> dict[str, Any]:
        """Gloss of the bodies that have other numbers than in the scene, as arguments of an image."""
        arguments: dict[str, Any] = {}
        for number, body in enumerate(self.scene.bodies):
            for name, value in viewer_state.changed_gloss(body, number).items():
                key = name, value, str(device)
                make = functools.partial(wp.array, [[value]], dtype=wp.float32, device=device)
                arguments.setdefault(name, {})[number] = self._numbers.get(key, make)
        return arguments

    def _geometry(self, key: Hashable, renderer: Renderer, viewer_state: ViewerState) -> Geometry | None:
        """Placed bodies; None where they are as in the scene."""
        if not viewer_state.has_moved(self.scene):
            return None
        rotations = [Rotation.from_rotvec(pose.rotation, degrees=True).as_matrix() for pose in viewer_state.poses]
        moved = [pose.translation for pose in viewer_state.poses]
        scales = [body.scale for body in self.scene.bodies]

        def placed() -> Geometry:
            return renderer.placed(
                Poses(
                    wp.array(np.array(rotations)[None], dtype=wp.mat33, device=renderer.device),
                    wp.array(np.array(moved)[None], dtype=wp.vec3, device=renderer.device),
                    wp.array(np.array(scales)[None], dtype=wp.float32, device=renderer.device),
                )
            )

        return self._geometries.get((key, viewer_state.poses), placed)

    def _light_of(self, viewer_state: ViewerState, quality: Quality) -> KnownLightArgument:
        light = self.coarse_light if quality.is_moving else self.scene.light
        return self._lights.get(
            (viewer_state.turn, viewer_state.scale, quality.is_moving), lambda: viewer_state.light(light)
        )

    def _behind(self, viewer_state: ViewerState, camera: Camera, quality: Quality) -> np.ndarray:
        """Background behind the bodies: a gray, or the light itself."""
        if not (viewer_state.shows_light and self.has_map):
            return np.full(3, _BACKGROUND, np.float32)
        light = as_light(self._light_of(viewer_state, quality))
        directions = camera.rays()[1]
        if light.shell is not None:
            directions = exits_on_host(camera.eye, directions, light.shell)
        return light.radiance_from(directions).astype(np.float32)


class RecentCache(Generic[Value]):
    """The last values, by key."""

    def __init__(self, count: int):
        self._count = count
        self._cached: OrderedDict[Hashable, Value] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """The value of a key, made if it is not cached."""
        if key not in self._cached:
            self._cached[key] = make()
        self._cached.move_to_end(key)
        while len(self._cached) > self._count:
            self._cached.popitem(last=False)
        return self._cached[key]


def bounds(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the box around all bodies but grounds that go to the horizon."""
    parts = [body.world_points() for body in scene.bodies]
    maximum = _HORIZON * np.ptp(framed_points(scene), axis=0).max()
    points = np.concatenate([part for part in parts if np.ptp(part, axis=0).max() <= maximum])
    return points.min(axis=0), points.max(axis=0)


def picture(image: np.ndarray, stops: float, background: np.ndarray) -> np.ndarray:
    """The picture of an image for a page: as :class:`warpshadow.Picture` makes it, in a tenth of the time.

    Args:
        image: Linear RGB, premultiplied, and coverage, shape [height, width, 4].
        stops: Exposure.
        background: Linear RGB of the background: a color of the picture [3], or radiance [height, width, 3], which is
            exposed like the rest.
    Returns:
        uint8 of shape [height, width, 3], but for a code the same.
    """
    color, alpha, factor = image[..., :3], image[..., 3:], np.float32(2.0**stops)
    if background.ndim == 1:
        linear = np.clip(factor * color, 0, 1) + (1 - alpha) * background
    else:
        linear = factor * (color + (1 - alpha) * background)
    codes = np.sqrt(np.clip(linear, 0, 1))  # which spreads a table's entries about as sRGB does
    return _SRGB[(codes * (len(_SRGB) - 1) + 0.5).astype(np.int32)]


_SRGB = np.round(255 * linear_to_srgb(np.linspace(0, 1, 4096) ** 2)).astype(np.uint8)


def relative_error(image: np.ndarray, reference: np.ndarray) -> float | None:
    """Relative L2 error of color over pixels that are wholly covered in both; None where there is none."""
    is_covered = (image[..., 3] == 1) & (reference[..., 3] == 1)
    size = np.linalg.norm(reference[is_covered, :3])
    return float(np.linalg.norm((image - reference)[is_covered, :3]) / size) if size > 0 else None


def error_picture(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Difference of an image from the reference, a fifth of its mean as full red (too bright) or blue (too dark).

    Returns:
        uint8 of shape [height, width, 3].
    """
    covered_colors = reference[reference[..., 3] > 0, :3]
    mean = float(covered_colors.mean()) if len(covered_colors) else 0.0
    excess = (
        np.clip((image - reference)[..., :3].mean(axis=-1) / (0.2 * mean), -1, 1) if mean > 0 else 0 * image[..., 0]
    )
    white = np.ones_like(excess)
    red, blue = np.minimum(white, 1 + excess), np.minimum(white, 1 - excess)
    return (255 * np.stack([red, np.minimum(red, blue), blue], axis=-1)).round().astype(np.uint8)


def distances(renderer: Renderer, view: View) -> np.ndarray:
    """Distance along the view of the surface at the middle sample of each pixel, Inf where there is nothing.

    Returns:
        Scene units, shape [height, width].
    """
    supersampling = renderer.scene.supersampling
    middle = slice(supersampling // 2, None, supersampling)
    faces = view.fragments.face_ids.numpy()[0, middle, middle]
    weights = view.fragments.barycentrics.numpy()[0, middle, middle]
    depths = view.clip_positions.value(view.call).numpy()[0, :, 3]  # w of clip space is the distance
    corners = depths[renderer.merged_scene.faces.numpy()[np.maximum(faces, 0)]]
    return np.where(faces < 0, np.inf, (corners * weights).sum(axis=-1))


def own_page(scene: Scene, scale: float) -> PageCamera:
    """The page with the view of the scene's camera, except for a lens that is off center."""
    camera = scene.camera
    check.instance("camera", camera, Camera, "a Camera")
    fov = np.degrees(2 * np.arctan(0.5 * camera.height / camera.intrinsics[1, 1]))
    w, x, y, z = np.roll(Rotation.from_matrix(camera.rotation.T).as_quat(), 1)
    return PageCamera((w, x, y, z), tuple(scale * camera.eye), float(fov), camera.width, camera.height)
