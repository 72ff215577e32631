"""Found light: which directions the images determined, against what images of other light show."""

import functools
import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import warpshadow as ws
from warpshadow import inverse
from warpshadow.inverse.found_light import influence_of_cells
from warpshadow.maths import sh
from warpshadow.maths.directions import fibonacci
from warpshadow.maths.sh import equirectangular_directions

ONE = [inverse.Stage(1)]


def ball(**options):
    spheres = ws.Spheres([[0, 0, 0]], [0.5])
    return ws.Body(ws.icosphere(0.5, 3), blockers=spheres, translation=(0, 0.5, 0), **options)


def camera(*eye):
    return ws.Camera.look_at(eye, (0, 0.5, 0), fov_y=30, size=(64, 48))


@functools.cache
def over_a_ground():
    sky = ws.EnvironmentMap.constant(1.0)
    return ws.Scene([ball(), ws.Body(ws.plane(40.0, 8))], sky, camera(0, 2, 4))


def alone(**options):
    return ws.Scene([ball(**options)], ws.EnvironmentMap.constant(1.0), camera(0, 0.5, 4))


def fitted(scene, *free, cameras=(None,), mask=None):
    views = [replace(scene, camera=each or scene.camera) for each in cameras]
    targets = [inverse.Target(ws.render(view), mask=mask, camera=view.camera) for view in views]
    return inverse.fit(inverse.Problem(scene, targets, free), ONE, progress=False)


@pytest.mark.parametrize(
    "free",
    [(inverse.Light(3),), (inverse.Light(directions=64), inverse.Albedo(0)), (inverse.Light(3), inverse.Pose(0))],
    ids=["light", "cells and albedo", "light and pose"],
)
def test_over_a_ground_the_lower_half_is_not_determined(free):
    light = fitted(over_a_ground(), *free).light
    heights = equirectangular_directions(len(light.determined))[..., 1]
    assert not light.determined[heights < -0.3].any() and light.determined[heights > 0.2].all()
    assert light.undetermined_share == pytest.approx(0.5, abs=0.07)
    assert str(light) == f"{100 * light.undetermined_share:.0f}% of the sphere was not determined by the images"


def test_where_a_body_is_seen_from_all_sides_all_is_determined():
    light = fitted(alone(), inverse.Light(3), cameras=[camera(0, 0.5, 4), camera(0, 0.5, -4)]).light
    assert light.determined.all() and light.undetermined_share == 0


def test_what_is_not_determined_changes_no_image_and_the_rest_does():
    scene = over_a_ground()
    light = fitted(scene, inverse.Light(3)).light
    before = ws.render(scene)
    for mask, least, most in ((~light.determined, 0, 0.02), (light.determined, 0.5, 2)):
        after = ws.render(replace(scene, light=ws.EnvironmentMap(1.0 + mask[..., None] * np.ones(3))))
        change = np.linalg.norm((after - before)[..., :3]) / np.linalg.norm(before[..., :3])
        assert least <= change < most


def test_influence_is_the_sum_of_cosines_over_what_is_seen():
    """Of a white ball, whose normals under the pixels are known."""
    scene = alone()
    problem = inverse.Problem(scene, inverse.Target(ws.render(scene)), inverse.Light(3))
    result = inverse.fit(problem, ONE, progress=False)
    got = influence_of_cells(problem, result.context, result.values)
    eye, towards = scene.camera.rays()
    offset = eye - np.array([0, 0.5, 0])
    along = -(towards @ offset)
    inside = along**2 - (offset @ offset - 0.25)
    distance = along[inside > 0] - np.sqrt(inside[inside > 0])
    normals = (offset + distance[:, None] * towards[inside > 0]) / 0.5
    expected = np.maximum(normals @ fibonacci(512).T, 0).sum(axis=0)
    smooth = sh.evaluate(4, fibonacci(512))  # few rays stand for a cell
    got, expected = smooth.T @ got, smooth.T @ (expected / expected.mean())
    assert np.linalg.norm(got - expected) < 0.03 * np.linalg.norm(expected)


def test_what_is_masked_out_determines_nothing():
    scene = alone()
    mask = np.zeros((48, 64), np.float32)
    mask[22:26, 30:34] = 1  # which looks at the camera
    share = fitted(scene, inverse.Light(3), mask=mask).light.undetermined_share
    assert 0.4 < share < 0.55 and fitted(scene, inverse.Light(3)).light.undetermined_share < 0.2


def test_its_picture_has_stripes_where_it_is_not_determined_and_only_there():
    light = fitted(over_a_ground(), inverse.Light(3)).light
    pixels = np.asarray(Image.open(io.BytesIO(light._repr_png_())))
    known = light.determined.repeat(4, axis=0).repeat(4, axis=1)
    gray = light.picture().pixels[-1, :, 0].min()
    is_gray = (pixels == gray).all(axis=-1)
    assert pixels.shape == (256, 512, 3)
    assert is_gray[~known].mean() == pytest.approx(0.5, abs=0.05) and not is_gray[known].any()


def test_light_that_was_not_free_was_not_found():
    assert fitted(alone(), inverse.Albedo(0)).light is None
