"""Suns: discs that are taken out of maps, and directions in them."""

import functools

import numpy as np
import pytest
import twins

import warpshadow as ws
from warpshadow.maths.suns import Suns, directions_in_suns, separate_suns

SUN = twins.unit(np.array([0.3, 0.5, -0.8]))


def test_a_sun_is_separated_from_a_map_with_all_its_light():
    sky = ws.synthetic_sky((0.3, 0.8, 0.5), sun_strength=0, height=512)
    whole = sky.with_sun((0.3, 0.8, 0.5), (3.0, 2.0, 1.0), angular_radius=1.5)
    sun, rest = separate_suns(whole.radiance)
    np.testing.assert_allclose(sun.directions, twins.unit(np.array([[0.3, 0.8, 0.5]])), atol=2e-3)
    np.testing.assert_allclose(np.degrees(np.sqrt(sun.solid_angles / np.pi)), 1.5, rtol=0.05)
    # what is left of it is ten times as bright as all on average, 1.3% of its light
    np.testing.assert_allclose(sun.irradiance, [[3.0, 2.0, 1.0]], rtol=0.05)
    total = np.einsum("rcx,r->x", rest, whole.solid_angles()) + sun.irradiance[0]
    np.testing.assert_allclose(total, np.einsum("rcx,r->x", whole.radiance, whole.solid_angles()), rtol=1e-6)
    assert rest.max() < 0.1 * whole.radiance.max()


def test_two_suns_are_separated_and_lamps_that_are_larger_stay_in_the_map():
    sky = ws.synthetic_sky(sun_strength=0, height=64)
    two = sky.with_sun((0, 1, 0.2), 2.0, angular_radius=2).with_sun((-1, 1, -1), 1.0, angular_radius=3)
    found, _ = separate_suns(two.radiance)
    expected = twins.unit(np.array([[0, 1, 0.2], [-1, 1, -1]]))
    np.testing.assert_allclose(found.directions, expected, atol=0.01)
    for even in (sky, sky.with_sun((0, 1, 0.2), 6.0, angular_radius=12), ws.EnvironmentMap.constant()):
        found, rest = separate_suns(even.radiance)
        assert not len(found.directions)
        np.testing.assert_array_equal(rest, even.radiance)


@pytest.mark.parametrize(("gap", "count"), [(2.5, 0), (8.0, 2), (11.0, 2)])
def test_lights_close_to_each_other_are_not_one_sun_between_them(gap, count):
    sky, side = ws.synthetic_sky(sun_strength=0, height=256), np.radians(gap / 2)
    middles = [np.array([sign * np.sin(side), 0.3, np.cos(side)]) for sign in (-1, 1)]
    lights = functools.reduce(lambda light, middle: light.with_sun(middle, 2.0, angular_radius=0.5), middles, sky)
    found, rest = separate_suns(lights.radiance)
    assert len(found.directions) == count
    if count:
        order = np.argsort(found.directions[:, 0])
        np.testing.assert_allclose(found.directions[order], twins.unit(np.array(middles)), atol=0.01)
    else:
        np.testing.assert_array_equal(rest, lights.radiance)


@pytest.mark.parametrize(("radius", "count"), [(5.5, 1), (6.2, 0), (6.3, 0)])
def test_a_disc_is_separated_as_a_whole_or_not_at_all(radius, count):
    sky = ws.synthetic_sky(sun_strength=0, height=256).with_sun((0.3, 1, 0.4), 3.0, angular_radius=radius)
    found, rest = separate_suns(sky.radiance)
    assert len(found.directions) == count
    assert rest.max() < 0.2 * sky.radiance.max() if count else np.array_equal(rest, sky.radiance)


@pytest.mark.parametrize(("rows", "count"), [(8, 0), (32, 1)])
def test_a_pixel_of_a_coarse_map_is_wider_than_a_sun(rows, count):
    radiance = np.full((rows, 2 * rows, 3), 0.1, np.float32)
    radiance[rows // 2, rows] = 100
    assert len(separate_suns(radiance)[0].directions) == count


def test_eight_suns_are_separated():
    sky = ws.synthetic_sky(sun_strength=0, height=128)
    for angle in np.arange(8) * np.pi / 4:
        sky = sky.with_sun((np.cos(angle), 0.8, np.sin(angle)), 1.0, angular_radius=1)
    found, rest = separate_suns(sky.radiance)
    assert len(found.directions) == 8
    assert rest.max() < 0.1 * sky.radiance.max()


def test_a_tube_of_light_stays_in_the_map():
    tube = ws.synthetic_sky(sun_strength=0, height=256)
    for angle in np.radians(np.linspace(-5, 5, 21)):
        tube = tube.with_sun((np.sin(angle), 0.3, np.cos(angle)), 1.0, angular_radius=0.7)
    assert not len(separate_suns(tube.radiance)[0].directions)


@pytest.mark.parametrize("count", [1, 16])
def test_directions_in_a_sun_are_even_over_its_disc(count):
    sun = Suns(np.stack([SUN, -SUN]), np.ones((2, 3)), np.array([0.01, 0.02]))
    directions = directions_in_suns(sun, count)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=2), 1)
    np.testing.assert_allclose(twins.unit(directions.mean(axis=1)), sun.directions, atol=0.01)
    if count > 1:  # of an even disc the mean square of angles to its middle is Ω / (2π)
        squares = 2 - 2 * np.einsum("snx,sx->sn", directions, sun.directions).mean(axis=1)
        np.testing.assert_allclose(squares, sun.solid_angles / (2 * np.pi), rtol=0.02)
