"""Tangent planes of proxies: whether receivers are above the patches whose light they would see."""

import numpy as np
import trimesh

import warpshadow as ws
from warpshadow.stages.bounces.tangent_planes import find_tolerances
from warpshadow.stages.patches import find_patches


def of_each(patches):
    """Of proxies of a patch each."""
    return find_tolerances([patches], np.arange(patches.count + 1), np.arange(patches.count))


def test_a_proxy_of_none_or_of_several_bodies_is_seen_from_everywhere():
    box = trimesh.creation.box((1, 1, 1))
    patches = find_patches(np.asarray(box.vertices), np.asarray(box.faces), is_two_sided=False)
    found = find_tolerances([patches, patches], np.array([0, 1, 1, 3]), np.array([0, 1, patches.count]))
    np.testing.assert_allclose(found, [(0, 20), (1, 1), (1, 1)], atol=1e-3)


def test_what_is_flat_bends_by_nothing_and_a_ball_by_the_angle_of_its_patches():
    box = trimesh.creation.box((1, 1, 1))
    patches = find_patches(np.asarray(box.vertices), np.asarray(box.faces), is_two_sided=False)
    np.testing.assert_allclose(of_each(patches), np.tile((0, 20), (patches.count, 1)), atol=1e-3)
    ball = ws.icosphere(1.0, 4)
    patches = find_patches(ball.positions, ball.faces, is_two_sided=False, count=64)
    sines, ratios = of_each(patches).T
    radii = np.sqrt(patches.areas / np.pi)  # of discs
    assert 0.8 < sines.mean() / radii.mean() < 1.6
    assert 3 < ratios.mean() < 10
    opposite = np.array([0, np.argmin(patches.normals @ patches.normals[0])])
    assert find_tolerances([patches], np.array([0, 2]), opposite)[0, 0] == 1


def test_a_wall_has_no_light_of_the_top_of_the_roof_that_lies_on_it():
    """The sun, all light that there is, falls on the top alone."""

    def body(size, place):
        mesh = trimesh.creation.box(size).apply_translation(place)
        return ws.Body(ws.Mesh(mesh.vertices, mesh.faces), albedo=(0.7, 0.7, 0.7))

    wall, roof = body((0.05, 1, 2), (0, 0.5, 0)), body((1.5, 0.04, 2.2), (-0.7, 1.02, 0))
    sky = ws.synthetic_sky((0.6, 0.8, 0.0)).radiance
    sun = ws.EnvironmentMap(np.where(sky > sky.max() / 2, sky, 0))
    camera = ws.Camera.look_at((-2.5, 0.6, 0.3), (0, 0.5, 0), fov_y=30, size=(24, 24))
    image = ws.Renderer(ws.Scene((wall, roof), sun, camera, bounces=1)).render()
    is_wall = ws.Renderer(ws.Scene((wall, roof), sun, camera)).layers().bodies.reshape(24, 24) == 0
    above = ws.Camera.look_at((-0.7, 4.0, 0.1), (-0.7, 1, 0), fov_y=10, size=(4, 4))
    top = ws.Renderer(ws.Scene((wall, roof), sun, above)).render()[..., :3].mean()
    assert top > 0
    assert image[is_wall, :3].mean() < 1e-3 * top
