"""The sample of points at which settings are compared: what it draws, and how it interpolates."""

import dataclasses

import numpy as np
import pytest

import warpshadow as ws
from warpshadow.tuning.point_sample import PointSample

BALL = ws.Spheres([(0, 0, 0)], [1])
# Of an estimate from 600 points, drawn with other seeds than those of the image.
SAMPLED = 0.35


def make_scene(**options):
    ball = ws.Body(ws.icosphere(0.6, 3), blockers=ws.Spheres([(0, 0, 0)], [0.6]), translation=(0, 0.8, 0))
    ground = ws.Body(ws.plane(4.0, 12))
    camera = ws.Camera.look_at((0.5, 2, 4), (0, 0.4, 0), fov_y=50, size=(48, 40))
    sky = ws.synthetic_sky(height=32, sun_radius=8)
    return ws.Scene((ball, ground), sky, camera, **options)


def variant(scene, receivers="vertex", **visibility):
    bodies = [dataclasses.replace(body, receivers=receivers) for body in scene.bodies]
    return dataclasses.replace(scene, bodies=bodies, visibility=ws.Visibility(**visibility))


@pytest.fixture(scope="module")
def sample():
    return PointSample(make_scene(), count=600, direction_count=1024)


def test_the_same_seed_draws_the_same_points_and_another_does_not(sample):
    again, other = (PointSample(make_scene(), count=600, direction_count=1024, seed=seed) for seed in (0, 1))
    np.testing.assert_array_equal(again.reference, sample.reference)
    assert other.reference.shape == sample.reference.shape
    assert not np.array_equal(other.receivers(["pixel"] * 2).points, sample.receivers(["pixel"] * 2).points)


def test_points_are_where_the_camera_sees_the_bodies(sample):
    scene = make_scene(supersampling=1)
    points = sample.receivers(["pixel"] * 2).points
    pixels = np.floor(scene.camera.project(points)).astype(int)
    seen = ws.Renderer(scene).body_ids()[0]
    np.testing.assert_array_equal(seen[pixels[:, 1], pixels[:, 0]], sample.bodies)
    shares = np.bincount(sample.bodies) / len(sample.bodies)
    np.testing.assert_allclose(shares, np.bincount(seen[seen >= 0]) / (seen >= 0).sum(), atol=0.01)


def test_a_camera_that_sees_few_points_gets_them_all():
    sample = PointSample(make_scene(), count=10**6, direction_count=16)
    assert len(sample.bodies) == (ws.Renderer(make_scene(supersampling=1)).body_ids() >= 0).sum()


def test_points_are_interpolated_from_the_corners_of_their_faces(sample):
    points, at_vertices = (sample.receivers([kind] * 2) for kind in ("pixel", "vertex"))
    interpolated = np.einsum("pk,pkc->pc", at_vertices.weights, at_vertices.points[at_vertices.corners])
    np.testing.assert_allclose(interpolated, points.points, atol=1e-6)
    np.testing.assert_array_equal(points.corners, np.repeat(np.arange(600)[:, None], 3, axis=1))
    assert len(at_vertices.points) == len(np.unique(at_vertices.corners))


def test_bodies_can_be_shaded_at_points_and_at_vertices_side_by_side(sample):
    scene = make_scene()
    mixed = dataclasses.replace(
        scene, bodies=(scene.bodies[0], dataclasses.replace(scene.bodies[1], receivers="pixel"))
    )
    shading = sample.shading(mixed)
    is_ground = sample.bodies == 1
    for receivers, of_body in (("vertex", ~is_ground), ("pixel", is_ground)):
        expected = sample.shading(variant(scene, receivers))
        np.testing.assert_allclose(shading[of_body], expected[of_body], atol=1e-6)


@pytest.mark.parametrize("receivers", ["vertex", "pixel"])
def test_the_error_is_that_of_the_image_of_white_bodies(sample, receivers):
    scene = make_scene(supersampling=1)
    white = [dataclasses.replace(body, albedo=(1, 1, 1)) for body in scene.bodies]
    scene = dataclasses.replace(scene, bodies=white)
    truth = ws.render(variant(scene, method="ray-traced", samples=1024))
    image = ws.render(variant(scene, receivers))
    inside = truth[..., 3] == 1
    expected = np.linalg.norm((image - truth)[inside, :3]) / np.linalg.norm(truth[inside, :3])
    got = sample.error(sample.shading(variant(make_scene(), receivers)))
    assert got == pytest.approx(expected, rel=SAMPLED)


def test_rays_have_no_error_at_points_and_that_of_interpolation_at_vertices(sample):
    traced = variant(make_scene(supersampling=1), "pixel", method="ray-traced", samples=1024)
    assert sample.error(sample.shading(traced)) < 1e-6
    of_bodies = sample.interpolation_errors()
    whole = sample.error(sample.interpolated_reference)
    assert np.linalg.norm(of_bodies) == pytest.approx(whole, rel=1e-5)
    assert of_bodies[1] > of_bodies[0] > 0  # the ground is coarser


def test_a_camera_that_sees_nothing_and_a_scene_without_light_are_refused():
    away = ws.Camera.look_at((0, 2, 4), (0, 2, 8), size=(8, 8))
    with pytest.raises(ValueError, match="scene: the camera sees no body"):
        PointSample(dataclasses.replace(make_scene(), camera=away))
    with pytest.raises(ValueError, match="light: none falls"):
        PointSample(dataclasses.replace(make_scene(), light=ws.EnvironmentMap.constant(0.0)))
