"""Patches of a ground under what stands on it do not light the foot of that."""

import dataclasses

import numpy as np
import pytest
import trimesh
import warp as wp

import warpshadow as ws
from warpshadow.pipeline.bounces import gathering


def foot_of_a_wall(sun, **options):
    """The lowest third of a thick wall, seen from near the ground, on which it stands."""
    block = trimesh.creation.box((3.0, 2.0, 0.3)).apply_translation((0, 1.0, -0.15))
    wall = ws.Body(ws.Mesh(block.vertices, block.faces).creased(), (0.8, 0.8, 0.8), receivers="pixel", name="wall")
    ground = ws.Body(ws.plane(6.0, 1), (0.7, 0.7, 0.7), name="ground")
    camera = ws.Camera.look_at((0, 0.3, 3), (0, 0.3, 0), fov_y=10, size=(24, 24))
    return ws.Scene([wall, ground], ws.synthetic_sky(sun, sun_radius=12), camera, bounces="all", **options)


@pytest.mark.parametrize("sun", [(0.3, 0.7, 0.8), (0.3, 0.7, -0.8)], ids=["before it", "behind it"])
def test_the_foot_of_a_wall_is_as_bright_as_by_paths(sun, monkeypatch):
    scene, find_texels = foot_of_a_wall(sun), gathering.find_texels
    renderer = ws.Renderer(dataclasses.replace(scene, supersampling=1), progress=False)
    lowest = np.flatnonzero((renderer.body_ids()[0] == 0).all(axis=1))[-5:]
    found = renderer.render()[lowest, :, :3].mean()
    monkeypatch.setattr(
        gathering, "find_texels", lambda b, weights, planes: find_texels(b, wp.full_like(weights, wp.vec3(1.0)), planes)
    )
    without = ws.Renderer(dataclasses.replace(scene, supersampling=1), progress=False).render()[lowest, :, :3].mean()
    paths = ws.Visibility("ray-traced", samples=2048)
    truth = ws.render(dataclasses.replace(scene, visibility=paths, supersampling=1))[lowest, :, :3].mean()
    assert abs(found / truth - 1) < 0.1
    assert abs(without / truth - 1) > 1.5 * abs(found / truth - 1)
