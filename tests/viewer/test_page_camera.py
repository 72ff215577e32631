"""Cameras of pages: what is believed of them, and what becomes of it."""

import numpy as np
import pytest

import warpshadow as ws
from warpshadow.viewer.page_camera import PageCamera, page_scale, upward
from warpshadow.viewer.painter import own_page

ROUNDING = 1e-6  # float64, and rotations that are normalized once more


def scene_of(camera):
    return ws.Scene([ws.Body(ws.icosphere(subdivisions=1), blockers=1)], ws.EnvironmentMap.constant(1.0), camera)


@pytest.mark.parametrize("scale", [1.0, 0.01, 40.0])
def test_a_page_that_looks_as_the_scene_sees_the_same_points_at_the_same_pixels(scale):
    camera = ws.Camera.look_at((1.6, 2.6, 4.6), (0, 0.75, 0), fov_y=36, size=(320, 200))
    page = own_page(scene_of(camera), scale)
    again = page.camera((320, 200), page_scale=scale, near=camera.near)
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    np.testing.assert_allclose(again.project(points), camera.project(points), atol=1e3 * ROUNDING)


def test_an_image_of_fewer_pixels_shows_the_same_stretched():
    page = PageCamera((1, 0, 0, 0), (0, 0, -5), 40.0, 801, 401)
    width, height = page.size(10_000)
    assert abs(width * height / 10_000 - 1) < 0.25 and (width, height) != (801, 401)
    full = page.camera((801, 401), page_scale=1.0, near=0.01)
    small = page.camera((width, height), page_scale=1.0, near=0.01)
    point = np.array([0.3, -0.2, 1.0])
    np.testing.assert_allclose(small.project(point) / (width, height), full.project(point) / (801, 401), atol=ROUNDING)


def test_an_image_has_no_more_pixels_than_the_canvas():
    assert PageCamera((1, 0, 0, 0), (0, 0, 0), 40.0, 31, 17).size(1 << 20) == (31, 17)
    assert min(PageCamera((1, 0, 0, 0), (0, 0, 0), 40.0, 16384, 1).size(100)) >= 1


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("wxyz", (0, 0, 0, 0)),
        ("wxyz", (float("nan"), 0, 0, 1)),
        ("wxyz", (1, 0, 0)),
        ("position", (float("inf"), 0, 0)),
        ("position", (1e12, 0, 0)),
        ("position", "abc"),
        ("fov_y", 0.0),
        ("fov_y", float("nan")),
        ("fov_y", 180.0),
        ("width", 0),
        ("width", 1 << 20),
        ("height", -3),
        ("height", 2.5),
    ],
)
def test_what_is_no_camera_is_refused(name, value):
    good = {"wxyz": (1, 0, 0, 0), "position": (0, 0, 0), "fov_y": 40.0, "width": 64, "height": 48}
    with pytest.raises(ValueError, match=f"{name}: got .*expected"):
        PageCamera(**good | {name: value})


def test_scenes_of_any_size_are_as_large_on_a_page():
    for size in (1e-3, 1.0, 1e4):
        corner = np.full(3, size)
        assert page_scale(-corner, corner) * np.linalg.norm(corner) == pytest.approx(3.0)
    assert page_scale(np.zeros(3), np.zeros(3)) == 1.0


@pytest.mark.parametrize("up", [(0, 1, 0), (0, 0, 1), (-1, 0, 0)])
def test_a_page_orbits_about_the_axis_that_is_up_in_the_image(up):
    camera = ws.Camera.look_at((2.0, 2.5, 3.0), (0, 0, 0), up=np.array(up) + 0.1)
    assert upward(camera) == up
