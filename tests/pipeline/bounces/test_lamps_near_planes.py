"""Light that bounces off the narrow spot of a lamp close to a flat body."""

import dataclasses

import numpy as np
import pytest

import warpshadow as ws
from warpshadow.scene.visibility import DIRECTIONS, DIRECTIONS_OF_SPOTS

FLOOR = ws.plane(3.0, 8)


def scene_of(height: float, radius: float = 0.25, floor: ws.Mesh = FLOOR, **options: object) -> ws.Scene:
    """The wall behind a ball of light over a floor."""
    black, white = (0.0, 0.0, 0.0), (0.8, 0.8, 0.8)
    lamp = ws.Body(ws.icosphere(radius, 2), albedo=black, emission=(20, 20, 20), translation=(0, height, 0))
    ground = ws.Body(floor, albedo=white, name="floor")
    wall = ws.Body(ws.plane(3.0, 8), albedo=white, rotation=(90, 0, 0), translation=(0, 1.5, -1.5), name="wall")
    camera = ws.Camera.look_at((0, 1.7, 4.0), (0, 1.7, 0), size=(16, 16), fov_y=22)
    return ws.Scene([lamp, ground, wall], ws.EnvironmentMap.constant(0.0), camera, **{"bounces": 1, **options})


def bounced(image_of, scene: ws.Scene) -> np.ndarray:
    return (image_of(scene) - image_of(dataclasses.replace(scene, bounces=0)))[..., 0]


def test_a_lamp_on_the_floor_draws_no_bands_on_the_wall():
    """Bounced light is off by 18%; with 128 cells, the default elsewhere, by 70%."""
    scene = scene_of(0.25)
    by_rays = bounced(lambda item: ws.render(item, progress=False), scene)
    found = bounced(lambda item: ws.Renderer(item, progress=False).render(), scene)
    assert np.linalg.norm(found - by_rays) < 0.25 * np.linalg.norm(by_rays)


@pytest.mark.parametrize(
    ("scene", "count"),
    [
        (scene_of(0.4), DIRECTIONS_OF_SPOTS),
        (scene_of(0.4, bounces=0), DIRECTIONS),
        (scene_of(0.6), DIRECTIONS),
        (scene_of(0.4, radius=0.6), DIRECTIONS),
        (scene_of(0.4, floor=ws.infinite_ground(3.0)), DIRECTIONS_OF_SPOTS),
        (scene_of(0.6, floor=ws.infinite_ground(3.0)), DIRECTIONS),
        (scene_of(0.4, visibility=ws.Visibility("directional", directions=64)), 64),
    ],
)
def test_a_lamp_near_a_flat_body_takes_more_cells_where_light_bounces(scene, count):
    assert scene.direction_count == count
