"""Walls that emit a map: where they are, and the light that they send."""

import numpy as np
import pytest

import warpshadow as ws
from warpshadow.maths import sh

CENTER = np.array([0.3, 1.0, -0.2])
SIZE = np.array([4.0, 3.0, 5.0])
DARK = ws.EnvironmentMap.constant(0.0)
# Relative, of light on an unblocked ground against a sum over the pixels of the map. Measured 0.7%.
SUM = 0.015


def window():
    """A dim room with a large window."""
    directions = sh.equirectangular_directions(64)
    is_window = directions @ np.array([0.8, 0.5, 0.33]) > 0.85
    return ws.EnvironmentMap(np.where(is_window[..., None], (12.0, 11.0, 9.0), (0.2, 0.2, 0.3)))


def exits(directions):
    """Where rays from the center leave the box, from there."""
    with np.errstate(divide="ignore"):
        return directions * (SIZE / 2 / np.abs(directions)).min(axis=-1, keepdims=True)


def test_walls_are_the_sides_of_a_box_and_show_the_map_from_its_middle():
    light = window()
    walls = ws.walls_of_light(light, SIZE, CENTER)
    assert [wall.name for wall in walls] == ["wall +x", "wall -x", "wall +y", "wall -y", "wall +z", "wall -z"]
    points = np.concatenate([wall.world_points() for wall in walls])
    np.testing.assert_allclose([points.min(axis=0), points.max(axis=0)], [CENTER - SIZE / 2, CENTER + SIZE / 2])
    for wall, axis, sign in zip(walls, (0, 0, 1, 1, 2, 2), (1, -1) * 3, strict=True):
        np.testing.assert_allclose(wall.mesh.positions[:, axis], CENTER[axis] + sign * SIZE[axis] / 2, rtol=1e-6)
    target = CENTER + (0.8, 0.5, 0.33)
    camera = ws.Camera.look_at(CENTER, target, fov_y=70, size=(32, 32))
    scene = ws.Scene(walls, DARK, camera, ws.Visibility("directional"), supersampling=1)
    shown, expected = ws.render(scene)[..., :3], light.radiance_from(camera.rays()[1])
    assert np.median(np.abs(shown - expected)) < 1e-3
    assert shown.mean() == pytest.approx(expected.mean(), rel=0.02)


@pytest.mark.parametrize("method", ["directional", "ray-traced"])
def test_light_of_walls_is_a_sum_over_the_map_as_the_box_has_it(method):
    light, ground = window(), ws.Body(ws.plane(2.0, 4), albedo=(1, 1, 1), blockers=0, receivers="vertex")
    camera = ws.Camera.look_at((0, 2, 0.1), (0, 0, 0), size=(16, 16))
    walls = ws.walls_of_light(light, SIZE, CENTER)
    renderer = ws.Renderer(ws.Scene([ground, *walls], DARK, camera, ws.Visibility(method)))
    view = renderer.view()
    points, found = view.receivers.points.numpy()[0], renderer.shade(view=view).numpy()[0]
    is_ground = np.abs(points[:, 1]) < 1e-4
    points, found = points[is_ground & (np.abs(points[:, 0]) <= 1)], found[is_ground & (np.abs(points[:, 0]) <= 1)]
    towards = light.directions().reshape(-1, 3)
    areas = np.repeat(light.solid_angles(), 128)
    on_box = exits(towards.astype(np.float64))
    axis = np.abs(on_box / (SIZE / 2)).argmax(axis=1)
    lengths = np.linalg.norm(on_box, axis=1)
    facing = np.abs(on_box[np.arange(len(on_box)), axis])
    box_areas = areas * lengths**3 / facing  # of a pixel on its wall
    beams = CENTER + on_box - points[:, None]
    distances = np.linalg.norm(beams, axis=2)
    cosines = np.maximum(beams[..., 1], 0) / distances
    normals = np.sign(on_box) * (np.arange(3) == axis[:, None])
    cosines_there = (beams * normals).sum(axis=2) / distances
    expected = (cosines * cosines_there / distances**2 * box_areas / np.pi) @ light.radiance.reshape(-1, 3)
    assert np.linalg.norm(found - expected) < SUM * np.linalg.norm(expected)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"size": 0.0}, "size: got 0.0, expected a size above 0"),
        ({"size": (1, 2)}, "size: got .*, expected a size above 0, or one along each axis"),
        ({"size": (1, np.nan, 2)}, "size: got .*, expected a size above 0"),
        ({"center": (0, 1)}, "center: got .*, expected 3 finite numbers: a point"),
        ({"sides": ["up"]}, r"sides: got 'up', expected one of '\+x'"),
        ({"sides": []}, r"sides: got \[\], expected some of \+x"),
        ({"sides": ["+x", "+x"]}, r"sides: got \['\+x', '\+x'\], expected .* each once"),
        ({"texels": 0}, "texels: got 0, expected a whole number of texels, at least 1"),
        ({"light": ws.EnvironmentMap.constant(1.0, radius=3.0)}, "light: got .*, expected an EnvironmentMap without"),
    ],
)
def test_walls_that_cannot_be_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        ws.walls_of_light(**{"light": DARK, "size": 4.0} | arguments)


def test_walls_keep_the_light_of_a_sun_that_is_smaller_than_their_texels():
    towards, strength, ambient = np.array([0.5, 0.7, 0.3]) / np.linalg.norm([0.5, 0.7, 0.3]), 3.0, 0.3
    light = ws.EnvironmentMap.constant(ambient).with_sun(towards, strength, angular_radius=0.27)
    total = np.zeros(3)
    for wall in ws.walls_of_light(light, SIZE, texels=64):
        height, width = wall.emission.shape[:2]
        u, v = np.meshgrid((np.arange(width) + 0.5) / width, 1 - (np.arange(height) + 0.5) / height)
        origin, across, _, up = wall.mesh.positions.astype(np.float64)
        points = origin + u[..., None] * (across - origin) + v[..., None] * (up - origin)
        edges = np.cross(across - origin, up - origin)
        distances = np.linalg.norm(points, axis=-1)
        solid_angles = np.abs(points @ edges) / (width * height) / distances**3
        total += np.einsum("rc,rck->k", solid_angles * np.maximum(points @ towards, 0) / distances, wall.emission)
    np.testing.assert_allclose(total, strength + np.pi * ambient, rtol=0.01)  # 0.1%; at texels' middles 76% less


def test_a_ground_may_take_the_place_of_a_side():
    sides = ("+x", "-x", "+y", "+z", "-z")
    assert [wall.name[-2:] for wall in ws.walls_of_light(DARK, 4.0, sides=sides)] == list(sides)
