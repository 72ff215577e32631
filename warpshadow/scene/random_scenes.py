"""Random scenes: a data set whose scenes come from a seed and a number, each by itself.

Some bodies stand or lie on a ground of neutral gray, in colors of their own, and may shine, under a sky with a sun or
under a few soft lights, or under given maps, which may be near; a camera looks at them from above. :class:`Ranges` has
the ranges of all random numbers.
Scenes are drawn when they are asked for, in any order, in any process: the same seed, number, bodies, maps and ranges
give the same scene.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from warpshadow import check
from warpshadow.assets.camera import Camera
from warpshadow.assets.color import LUMINANCE
from warpshadow.assets.light import EnvironmentMap
from warpshadow.assets.mesh import Mesh
from warpshadow.assets.primitives import icosphere, plane
from warpshadow.assets.sky import synthetic_sky
from warpshadow.maths import sh
from warpshadow.scene.body import Body
from warpshadow.scene.scene import Bounces, Scene
from warpshadow.scene.visibility import Visibility
from warpshadow.spheres import Spheres

GROUND_SIZE = 10.0  # scene units, or wider where bodies need it; a body is about one
SKY_HEIGHT = 64  # rows

Range = tuple[float, float]  # lower and upper bound of an even distribution; equal for a constant


@functools.cache
def primitives() -> tuple[Body, ...]:
    """Bodies to draw from: a sphere, a capsule, a torus, a box, a slab, a cylinder and a cone; about 1 unit large.

    They are few, so that their spheres, 32 each, are soon fitted, and then kept. The sphere needs no fit.
    """
    from trimesh import creation

    sphere = Body(icosphere(0.5, 3), blockers=Spheres(np.zeros((1, 3)), np.full(1, 0.5)), receivers="pixel")
    shapes = {
        "capsule": creation.capsule(height=0.6, radius=0.25, count=[24, 24]),
        "torus": creation.torus(major_radius=0.4, minor_radius=0.14, major_sections=48, minor_sections=20),
        "box": creation.box(extents=(0.8, 1.0, 0.6)),
        "slab": creation.box(extents=(1.0, 0.8, 0.2)),
        "cylinder": creation.cylinder(radius=0.35, height=1.0, sections=48),
        "cone": creation.cone(radius=0.45, height=1.0, sections=48),
    }
    return (
        sphere,
        *(Body(_primitive_mesh(name, shape), blockers=32, receivers="pixel") for name, shape in shapes.items()),
    )


def _primitive_mesh(name: str, shape) -> Mesh:
    """The mesh of a trimesh.Trimesh, z turned up, parted at its sharp edges, so that normals do not round them."""
    from trimesh import graph

    parted = graph.smooth_shade(shape, angle=np.radians(35))
    x, y, z = np.asarray(parted.vertices).T
    return Mesh(np.stack([x, z, -y], axis=1), np.asarray(parted.faces), name=name)


@dataclass(frozen=True)
class Ranges:
    """Ranges of the random numbers of a scene.

    Args:
        count: Number of bodies on the ground.
        size: Longest edge of a body's bounds before it is turned [scene units].
        upright: Part of the bodies that are turned about the vertical alone; the others lie in any way.
        gap: Distance between bodies, 1 where the two with the widest bounds could just touch.
        albedo: Reflectance of a body without a texture or a color for each vertex, in each of red, green and blue.
        ground_albedo: Reflectance of the ground, which is gray.
        glossy: Part of the bodies that shine, beside those that do so as they are given, which stay as they are.
        roughness: Of these.
        metal: Part of these that are of metal; the others are plastic.
        rotation: How far a given map is turned about the vertical [degrees].
        scale: Factor of the light; drawn evenly in its logarithm.
        radius: Of the sphere around the middle of the ground that the light comes from, 1 where the ground just fits
            into it; None for light from infinitely far away.
        fov_y: Vertical field of view [degrees].
        elevation: Of the camera above the ground [degrees].
        distance: Of the camera, 1 where a ball around all bodies just fills the image.
    """

    count: tuple[int, int] = (1, 3)
    size: Range = (0.8, 1.4)
    upright: float = 0.5
    gap: Range = (1.0, 1.3)
    albedo: Range = (0.15, 0.9)
    ground_albedo: Range = (0.4, 0.6)
    glossy: float = 0.0
    roughness: Range = (0.2, 0.7)
    metal: float = 0.5
    rotation: Range = (0.0, 360.0)
    scale: Range = (0.25, 4.0)
    radius: Range | None = None
    fov_y: Range = (40.0, 40.0)
    elevation: Range = (20.0, 55.0)
    distance: Range = (0.9, 1.2)

    def __post_init__(self) -> None:
        for name in _LIMITS:
            if getattr(self, name) is not None or name != "radius":
                object.__setattr__(self, name, _checked_range(name, getattr(self, name)))
        for name in ("upright", "glossy", "metal"):
            part = getattr(self, name)
            if not (check.is_number(part) and 0 <= part <= 1):
                raise ValueError(f"{name}: got {check.described(part)}, expected a part of all, from 0 to 1")


_LIMITS: dict[str, tuple[float, float]] = {
    "count": (1, 6),
    "size": (0.01, 1.5),
    "gap": (1.0, 1.5),
    "albedo": (0.0, 1.0),
    "ground_albedo": (0.0, 1.0),
    "roughness": (0.0, 1.0),
    "rotation": (-check.LARGEST, check.LARGEST),
    "scale": (1e-9, 1e9),
    "radius": (1.01, 1e3),
    "fov_y": (1.0, 120.0),
    "elevation": (1.0, 89.0),
    "distance": (0.5, 100.0),
}
"""Least and largest bound of each range."""


def _checked_range(name: str, value: object) -> tuple[float, float]:
    minimum, maximum = _LIMITS[name]
    is_whole = name == "count"
    expected = f"two {'whole ' * is_whole}numbers from {minimum:g} to {maximum:g}, the lesser first"
    ends = check.numbers(name, value, expected=expected, dtype=np.float64)
    is_range = ends.shape == (2,) and minimum <= ends[0] <= ends[1] <= maximum
    if not is_range or (is_whole and (ends % 1).any()):
        raise ValueError(f"{name}: got {check.described(value)}, expected {expected}")
    low, high = ends.tolist()
    return (int(low), int(high)) if is_whole else (low, high)


class DrawnLight(NamedTuple):
    """A drawn map and its changes."""

    number: int
    """Which one, from 0."""
    rotation: float
    """How far it is turned about +y [degrees]."""
    scale: float
    """Factor of its radiance."""


class DrawnScene(NamedTuple):
    """A scene, and the random choices in it."""

    scene: Scene
    """The bodies, the last one the ground; light and camera."""
    prototypes: tuple[int, ...]
    """Which of the given bodies each is, from 0; the ground's is left out."""
    light: DrawnLight | None
    """None where maps are not given."""


@dataclass(frozen=True, eq=False)
class RandomScenes:
    """A data set of random scenes, which indexing draws; torch's samplers and loaders take it as it is.

    Args:
        seed: Number of the data set, 0 or more.
        count: Number of scenes; scene ``index`` does not depend on the count.
        size: Width and height of the images [pixels].
        bodies: Bodies to draw from; they get new poses and sizes, and new colors if they have one each.
            Bodies of one's own: ``[Body(load_mesh("bunny.obj"), blockers=32)]``. Like maps, a sequence that may read
            them when they are asked for.
        visibility: How visibility is computed.
        supersampling: As of a :class:`warpshadow.Scene`.
        maps: Light to draw from, turned and scaled; by default skies and lamps that are drawn, too.
        ranges: Ranges of the random numbers.
        bounces: As of a :class:`warpshadow.Scene`.
    """

    seed: int = 0
    count: int = 1024
    size: tuple[int, int] = (64, 64)
    bodies: Sequence[Body] = field(default_factory=primitives, repr=False)
    visibility: Visibility = field(default_factory=Visibility)
    supersampling: int = 2
    maps: Sequence[EnvironmentMap] | None = field(default=None, repr=False)
    ranges: Ranges = Ranges()
    bounces: Bounces = 0

    def __post_init__(self) -> None:
        check.integer("seed", self.seed, minimum=0)
        check.integer("count", self.count, minimum=0)
        for name, value in (("bodies", self.bodies), ("maps", self.maps)):
            if value is not None and not len(value):
                raise ValueError(f"{name}: got none, expected one or more to draw from")

    def __len__(self) -> int:
        """Number of scenes."""
        return self.count

    def __getitem__(self, index: int) -> Scene:
        """Draw a scene.

        Args:
            index: Its number; negative ones count from the end.
        Raises:
            IndexError: for a number out of range.
        """
        return self.draw(index).scene

    def draw(self, index: int) -> DrawnScene:
        """Draw a scene, as indexing does, and return the random choices with it."""
        if not -self.count <= index < self.count:
            raise IndexError(f"index: got {index}, expected a scene from 0 to {self.count - 1}")
        rng = np.random.default_rng([self.seed, index % self.count])
        ranges = self.ranges
        bodies, prototypes = _random_bodies(rng, self.bodies, ranges)
        gray = np.full(3, _draw_between(rng, ranges.ground_albedo))
        ground_size = _ground_size(bodies)
        ground = Body(_ground_mesh(ground_size), albedo=gray, blockers=1, receivers="pixel")
        if self.maps is None:
            light, drawn = random_light(rng, ranges.scale), None
        else:
            light, drawn = _turned_map(rng, self.maps, ranges)
        if ranges.radius is not None:
            light = replace(light, radius=_draw_between(rng, ranges.radius) * ground_size / np.sqrt(2))
        camera = _random_camera(rng, bodies, self.size, ranges)
        scene = Scene((*bodies, ground), light, camera, self.visibility, self.supersampling, self.bounces)
        return DrawnScene(scene, prototypes, drawn)


def _ground_size(bodies: Sequence[Body]) -> float:
    """Width of a ground under all bodies."""
    reach = max(float(np.hypot(*body.translation[[0, 2]])) + _footprint(body) for body in bodies)
    return GROUND_SIZE if 2 * reach <= GROUND_SIZE else 2.5 * reach


@functools.lru_cache(8)
def _ground_mesh(size: float) -> Mesh:
    """Mesh of the ground: one for all scenes but wide ones, since renderers cache results by mesh."""
    return plane(size, 1)


def _draw_between(rng: np.random.Generator, limits: Range) -> float:
    low, high = limits
    return low if low == high else float(rng.uniform(low, high))


# ------------------------------------------------------------------------------------------------- bodies


def _random_bodies(
    rng: np.random.Generator, prototypes: Sequence[Body], ranges: Ranges
) -> tuple[list[Body], tuple[int, ...]]:
    """Some bodies on the ground, in a ring in which none touches another; and which they are."""
    minimum, maximum = ranges.count
    count = int(rng.integers(minimum, maximum + 1))
    bodies, chosen = zip(*(_random_body(rng, prototypes, ranges) for _ in range(count)), strict=True)
    widest = max(_footprint(body) for body in bodies)
    ring = 0.0 if count == 1 else _draw_between(rng, ranges.gap) * widest / np.sin(np.pi / count)
    angles = rng.uniform(0, 2 * np.pi) + 2 * np.pi * np.arange(count) / count
    positions = ring * np.stack([np.cos(angles), np.zeros(count), np.sin(angles)], axis=1)
    pairs = zip(bodies, positions, strict=True)
    return [replace(body, translation=body.translation + place) for body, place in pairs], chosen


def _random_body(rng: np.random.Generator, prototypes: Sequence[Body], ranges: Ranges) -> tuple[Body, int]:
    """A body of a random size and color in the middle of the ground, upright or lying in any way; and which it is."""
    chosen = int(rng.integers(len(prototypes)))
    prototype = prototypes[chosen]
    axis = np.array([0.0, 1.0, 0.0]) if rng.random() < ranges.upright else _random_direction(rng)
    low, high = prototype.mesh.bounds
    color = rng.uniform(*ranges.albedo, 3)
    body = replace(
        prototype,
        albedo=color if prototype.mesh.colors is None and prototype.albedo.ndim == 1 else prototype.albedo,
        rotation=rng.uniform(0, 360) * axis,
        translation=np.zeros(3),
        scale=_draw_between(rng, ranges.size) / (high - low).max(),
    )
    if ranges.glossy and not body.is_glossy and rng.random() < ranges.glossy:
        metallic = np.full(1, rng.random() < ranges.metal, np.float32)
        body = replace(body, roughness=np.full(1, _draw_between(rng, ranges.roughness)), metallic=metallic)
    low, high = body.world_mesh().bounds
    foot = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    return replace(body, translation=-foot), chosen


def _footprint(body: Body) -> float:
    """Radius of a circle around the box of a body, seen from above."""
    low, high = body.world_mesh().bounds
    return float(np.hypot(*(high - low)[[0, 2]])) / 2


def _random_direction(rng: np.random.Generator) -> np.ndarray:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


# ------------------------------------------------------------------------------------------------- light


def random_light(rng: np.random.Generator, scale: Range = Ranges.scale) -> EnvironmentMap:
    """Draw light: half of the time a sky with a sun, else a few soft lights; scaled by a factor of the range."""
    draw = _random_sky if rng.random() < 0.5 else _random_lamps
    return draw(rng).scaled(_random_scale(rng, scale))


def _turned_map(
    rng: np.random.Generator, maps: Sequence[EnvironmentMap], ranges: Ranges
) -> tuple[EnvironmentMap, DrawnLight]:
    drawn = DrawnLight(
        int(rng.integers(len(maps))), _draw_between(rng, ranges.rotation), _random_scale(rng, ranges.scale)
    )
    return maps[drawn.number].rotated(drawn.rotation).scaled(drawn.scale), drawn


def _random_scale(rng: np.random.Generator, limits: Range) -> float:
    """A factor, as often half as large as twice."""
    low, high = limits
    return float(2 ** _draw_between(rng, (np.log2(low), np.log2(high))))


def _random_sky(rng: np.random.Generator) -> EnvironmentMap:
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(15, 75))
    sun = [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
    return synthetic_sky(sun, sun_strength=rng.uniform(0.5, 4), sun_radius=rng.uniform(3, 12), height=SKY_HEIGHT)


def _random_lamps(rng: np.random.Generator) -> EnvironmentMap:
    """One to four lobes of light from above (von Mises and Fisher's) in a dim room."""
    directions = sh.equirectangular_directions(SKY_HEIGHT)
    radiance = rng.uniform(0.05, 0.5) * _random_tint(rng) * np.ones_like(directions)
    for _ in range(rng.integers(1, 5)):
        middle = _random_direction(rng) + (0, 1, 0)
        middle /= np.linalg.norm(middle)
        sharpness = 10 ** rng.uniform(0.3, 2)  # half as bright 60° to 7° from the middle
        lobe = np.exp(sharpness * (directions @ middle - 1)) * sharpness / (1 - np.exp(-2 * sharpness))
        radiance += rng.uniform(0.2, 1.5) * lobe[..., None] / 2 * _random_tint(rng)
    return EnvironmentMap(radiance)


def _random_tint(rng: np.random.Generator) -> np.ndarray:
    """A pale color of luminance 1."""
    tint = rng.uniform(0.6, 1.0, 3)
    return tint / (LUMINANCE @ tint)


# ------------------------------------------------------------------------------------------------- camera


def _random_camera(rng: np.random.Generator, bodies: Sequence[Body], size: tuple[int, int], ranges: Ranges) -> Camera:
    """A camera above the ground that has all bodies in view, and some of their shadows."""
    low, high = np.transpose([body.world_mesh().bounds for body in bodies], (1, 0, 2))
    low, high = low.min(axis=0), high.max(axis=0)
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(_draw_between(rng, ranges.elevation))
    away = np.array([np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)])
    reach = np.linalg.norm(high - low) / 2
    fov_y = _draw_between(rng, ranges.fov_y)
    narrowest = fov_y * min(1.0, size[0] / size[1])
    distance = _draw_between(rng, ranges.distance) * reach / np.sin(np.radians(narrowest / 2))
    middle = (low + high) / 2
    return Camera.look_at(middle + distance * away, middle, fov_y=fov_y, size=size)
