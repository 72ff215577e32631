"""Random scenes: a data set whose scenes come from a seed and a number, each by itself.

One to three bodies stand or lie on a ground of neutral gray, in colors of their own, under a sky with a sun or under
a few soft lights; a camera looks at them from above. Scenes are drawn when they are asked for, in any order, in any
process: the same seed, number and bodies give the same scene.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from warpshadow import check
from warpshadow.assets.camera import Camera
from warpshadow.assets.color import LUMINANCE
from warpshadow.assets.light import EnvironmentMap
from warpshadow.assets.mesh import Mesh
from warpshadow.assets.primitives import icosphere, plane
from warpshadow.assets.sky import synthetic_sky
from warpshadow.maths import sh
from warpshadow.scene.scene import Body, Scene, Visibility
from warpshadow.spheres import Spheres

GROUND_SIZE = 10.0  # scene units; a body is about one
SKY_HEIGHT = 64  # rows
FOV_Y = 40.0  # degrees


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
    return (sphere, *(Body(_creased(name, shape), blockers=32, receivers="pixel") for name, shape in shapes.items()))


def _creased(name: str, shape) -> Mesh:
    """The mesh of a trimesh.Trimesh, z turned up, parted at its sharp edges, so that normals do not round them."""
    from trimesh import graph

    parted = graph.smooth_shade(shape, angle=np.radians(35))
    x, y, z = np.asarray(parted.vertices).T
    return Mesh(np.stack([x, z, -y], axis=1), np.asarray(parted.faces), name=name)


@dataclass(frozen=True, eq=False)
class RandomScenes:
    """A data set of random scenes, which indexing draws; torch's samplers and loaders take it as it is.

    Args:
        seed: Number of the data set, 0 or more.
        count: Number of scenes; scene ``index`` is the same whatever the count.
        size: Width and height of the images [pixels].
        bodies: What bodies are drawn from; they get new poses, sizes and, if they have no texture, colors.
            Bodies of one's own: ``[Body(load_mesh("bunny.obj"), blockers=32)]``.
        visibility: How visibility is computed.
        supersampling: As of a :class:`warpshadow.Scene`.
    """

    seed: int = 0
    count: int = 1024
    size: tuple[int, int] = (64, 64)
    bodies: Sequence[Body] = field(default_factory=primitives, repr=False)
    visibility: Visibility = field(default_factory=Visibility)
    supersampling: int = 2

    def __post_init__(self) -> None:
        check.whole("seed", self.seed, least=0)
        check.whole("count", self.count, least=0)
        object.__setattr__(self, "bodies", tuple(self.bodies))
        if not self.bodies:
            raise ValueError("bodies: got none, expected one or more to draw from")

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
        if not -self.count <= index < self.count:
            raise IndexError(f"index: got {index}, expected a scene from 0 to {self.count - 1}")
        rng = np.random.default_rng([self.seed, index % self.count])
        bodies = _random_bodies(rng, self.bodies)
        ground = Body(plane(GROUND_SIZE, 1), albedo=np.full(3, rng.uniform(0.4, 0.6)), blockers=1, receivers="pixel")
        return Scene(
            (*bodies, ground),
            random_light(rng),
            _random_camera(rng, bodies, self.size),
            self.visibility,
            self.supersampling,
        )


# ------------------------------------------------------------------------------------------------- bodies


def _random_bodies(rng: np.random.Generator, prototypes: Sequence[Body]) -> list[Body]:
    """One to three bodies on the ground, in a ring in which none touches another."""
    count = int(rng.integers(1, 4))
    bodies = [_random_body(rng, prototypes) for _ in range(count)]
    widest = max(_footprint(body) for body in bodies)
    ring = 0.0 if count == 1 else rng.uniform(1.0, 1.3) * widest / np.sin(np.pi / count)
    angles = rng.uniform(0, 2 * np.pi) + 2 * np.pi * np.arange(count) / count
    places = ring * np.stack([np.cos(angles), np.zeros(count), np.sin(angles)], axis=1)
    return [replace(body, translation=body.translation + place) for body, place in zip(bodies, places, strict=True)]


def _random_body(rng: np.random.Generator, prototypes: Sequence[Body]) -> Body:
    """A body of a random size and color in the middle of the ground, upright half of the time."""
    prototype = prototypes[int(rng.integers(len(prototypes)))]
    axis = np.array([0.0, 1.0, 0.0]) if rng.random() < 0.5 else _random_direction(rng)
    low, high = prototype.mesh.bounds
    body = replace(
        prototype,
        albedo=rng.uniform(0.15, 0.9, 3),
        rotation=rng.uniform(0, 360) * axis,
        translation=np.zeros(3),
        scale=rng.uniform(0.8, 1.4) / (high - low).max(),
    )
    low, high = body.world_mesh().bounds
    foot = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    return replace(body, translation=-foot)


def _footprint(body: Body) -> float:
    """Radius of a circle around the box of a body, seen from above."""
    low, high = body.world_mesh().bounds
    return float(np.hypot(*(high - low)[[0, 2]])) / 2


def _random_direction(rng: np.random.Generator) -> np.ndarray:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


# ------------------------------------------------------------------------------------------------- light


def random_light(rng: np.random.Generator) -> EnvironmentMap:
    """Draw light: half of the time a sky with a sun, else a few soft lights; up to four times brighter or darker."""
    draw = _random_sky if rng.random() < 0.5 else _random_lamps
    return draw(rng).scaled(2 ** rng.uniform(-2, 2))


def _random_sky(rng: np.random.Generator) -> EnvironmentMap:
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(15, 75))
    sun = [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
    return synthetic_sky(sun, sun_strength=rng.uniform(0.5, 4), sun_radius=rng.uniform(3, 12), height=SKY_HEIGHT)


def _random_lamps(rng: np.random.Generator) -> EnvironmentMap:
    """One to four lobes of light from above (von Mises and Fisher's) in a dim room."""
    towards = sh.equirectangular_directions(SKY_HEIGHT)
    radiance = rng.uniform(0.05, 0.5) * _random_tint(rng) * np.ones_like(towards)
    for _ in range(rng.integers(1, 5)):
        middle = _random_direction(rng) + (0, 1, 0)
        middle /= np.linalg.norm(middle)
        sharpness = 10 ** rng.uniform(0.3, 2)  # half as bright 60° to 7° from the middle
        lobe = np.exp(sharpness * (towards @ middle - 1)) * sharpness / (1 - np.exp(-2 * sharpness))
        radiance += rng.uniform(0.2, 1.5) * lobe[..., None] / 2 * _random_tint(rng)
    return EnvironmentMap(radiance)


def _random_tint(rng: np.random.Generator) -> np.ndarray:
    """A pale color of luminance 1."""
    tint = rng.uniform(0.6, 1.0, 3)
    return tint / (LUMINANCE @ tint)


# ------------------------------------------------------------------------------------------------- camera


def _random_camera(rng: np.random.Generator, bodies: Sequence[Body], size: tuple[int, int]) -> Camera:
    """A camera above the ground that has all bodies in view, and some of their shadows."""
    low, high = np.transpose([body.world_mesh().bounds for body in bodies], (1, 0, 2))
    low, high = low.min(axis=0), high.max(axis=0)
    azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(20, 55))
    away = np.array([np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)])
    reach = np.linalg.norm(high - low) / 2
    narrowest = FOV_Y * min(1.0, size[0] / size[1])
    distance = rng.uniform(0.9, 1.2) * reach / np.sin(np.radians(narrowest / 2))
    middle = (low + high) / 2
    return Camera.look_at(middle + distance * away, middle, fov_y=FOV_Y, size=size)
