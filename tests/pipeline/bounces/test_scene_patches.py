"""Patches of a scene: which bodies send light, where they are lit, and what they reflect."""

import numpy as np
import pytest
import warp as wp

import warpshadow as ws
from warpshadow.device.tape import recorded
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.bodies.reflectance import Materials
from warpshadow.pipeline.bounces.patches import ScenePatches
from warpshadow.pipeline.node import Call, Clock
from warpshadow.stages.bounces.proxy_radiance import find_proxy_radiance

RANDOM = np.random.default_rng(0)


@pytest.fixture
def merged_scene():
    ball = ws.icosphere(1.0, 2)
    ground = ws.plane(6.0, 8)
    bodies = (
        ws.Body(ball, RANDOM.uniform(0.1, 0.9, (ball.vertex_count, 3)), blockers=1, translation=(0, 1, 0)),
        ws.Body(ground, texture=RANDOM.uniform(0.1, 0.9, (16, 16, 3)), blockers=0),
        ws.Body(ball, (0.0, 0.0, 0.0), blockers=1, translation=(3, 1, 0), name="black"),
    )
    light = ws.EnvironmentMap.constant(1.0, height=8)
    return MergedScene(ws.Scene(bodies, light, ws.Camera.look_at((0, 3, 8), (0, 1, 0), size=(8, 8))))


def test_black_bodies_send_nothing(merged_scene):
    materials = Materials.of_scene(merged_scene)
    assert ScenePatches(merged_scene).senders(materials).bodies == (0, 1)
    given = [None, None, wp.zeros((1, 1), dtype=wp.vec3)]
    assert ScenePatches(merged_scene).senders(materials.replaced({"albedo": given})).bodies == (0, 1, 2)


def test_flat_bodies_have_a_grid_whose_back_nobody_sees(merged_scene):
    patches = ScenePatches(merged_scene)
    assert patches.plane_bodies == (1,)
    assert patches.of_body(1).grid.sides == 1
    assert patches.of_body(0).grid is None


def test_patch_samples_lie_on_the_bodies_and_face_outwards(merged_scene):
    senders = ScenePatches(merged_scene).senders(Materials.of_scene(merged_scene))
    positions = merged_scene.scene_geometry.positions
    normals = wp.array(_normals(merged_scene)[None], dtype=wp.vec3)
    found = senders.patch_samples(positions, normals)
    assert [span.body for span in found.spans] == [0, 1]
    _, first, end = found.spans[0]
    on_ball, outward = (array.numpy()[0, first:end] for array in (found.points, found.normals))
    away = on_ball - (0, 1, 0)
    assert (np.einsum("sk,sk->s", away, outward) > 0.9).all()
    _, first, end = found.spans[1]
    np.testing.assert_allclose(found.points.numpy()[0, first:end, 1], 0, atol=1e-6)
    np.testing.assert_allclose(found.normals.numpy()[0, first:end], [(0, 1, 0)] * (end - first), atol=1e-6)


def _normals(merged_scene):
    normals = [body.world_mesh().positions - body.translation for body in merged_scene.scene.bodies]
    normals[1] = np.tile([0.0, 1.0, 0.0], (len(normals[1]), 1))
    return np.concatenate(normals)


def test_albedo_of_patches_has_gradients_to_colors_and_textures(merged_scene):
    color = wp.array(RANDOM.uniform(size=(1, 162, 3)), dtype=wp.vec3, requires_grad=True)
    image = wp.array(RANDOM.uniform(size=(1, 16, 16, 3)), dtype=wp.vec3, requires_grad=True)
    replacements = {"albedo": [color, None, None], "textures": [None, image, None]}
    materials = Materials.of_scene(merged_scene).replaced(replacements)
    patches = ScenePatches(merged_scene)
    senders = patches.senders(materials)
    with recorded() as tape:
        albedo = patches.albedo(materials, senders.bodies).value(Call(Clock()))
    first = senders.first
    seed = np.zeros(albedo.numpy().shape, np.float32)
    seed[0, 0] = 1
    seed[0, first[1] : first[2]] = senders.areas[first[1] : first[2], None]
    albedo.grad.assign(seed)
    tape.backward()
    # a mean has weights that add up to 1; together the patches of a plane weigh each texel alike
    np.testing.assert_allclose(color.grad.numpy()[0].sum(axis=0), 1, rtol=1e-5)
    np.testing.assert_allclose(image.grad.numpy()[0].sum(axis=(0, 1)), 36, rtol=1e-4)
    assert image.grad.numpy().min() > 0


def test_one_color_is_that_of_all_patches(merged_scene):
    patches = ScenePatches(merged_scene)
    materials = Materials.of_scene(merged_scene)
    given = wp.array([[(0.2, 0.3, 0.4)]], dtype=wp.vec3)
    albedo = patches.albedo(materials.replaced({"albedo": [given, given, None]}), (0, 1)).value(Call(Clock()))
    np.testing.assert_allclose(albedo.numpy()[0], np.tile([0.2, 0.3, 0.4], (albedo.shape[1], 1)), rtol=1e-6)


def test_patches_of_bodies_of_different_scale_count_by_their_areas_in_the_scene():
    """Where a cluster has spheres of two bodies, what it sends is a mean over the patches of both."""
    big, small = ws.icosphere(1.0, 2), ws.icosphere(100.0, 2)  # as meshes; in the scene the first is 3 times as large
    bodies = ws.Body(big, scale=3.0, name="big"), ws.Body(small, scale=0.01, translation=(9, 0, 0), name="small")
    flat = ws.Body(ws.plane(2.0, 4), scale=2.5, translation=(0, -9, 0), name="ground")
    light = ws.EnvironmentMap.constant(1.0, height=8)
    camera = ws.Camera.look_at((0, 3, 8), (0, 1, 0), size=(8, 8))
    merged_scene = MergedScene(ws.Scene((*bodies, flat), light, camera))
    senders = ScenePatches(merged_scene).senders(Materials.of_scene(merged_scene))
    areas = [senders.areas[first:end].sum() for first, end in zip(senders.first[:-1], senders.first[1:], strict=True)]
    expected = []
    for body in merged_scene.scene.bodies:
        a, b, c = np.moveaxis(body.world_mesh().positions[body.mesh.faces].astype(np.float64), 1, 0)
        expected.append(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)
    np.testing.assert_allclose(areas, expected, rtol=1e-5)

    # a cluster of two spheres of each body, whose patches all show the same, is as bright as areas say
    starts, numbers = np.int32([0, senders.first[2]]), np.arange(senders.first[2], dtype=np.int32)
    radiosity = np.repeat([1.0, 0.0, 0.0], np.diff(senders.first))[None, :, None].repeat(3, axis=2)
    shown = wp.full((1, len(senders.areas), 4), 0.25, wp.float32)
    arrays = wp.array(radiosity, dtype=wp.vec3), shown, wp.full(shown.shape[:2], wp.vec3(1.0), wp.vec3)
    sent = find_proxy_radiance(*arrays, senders.areas, starts, numbers).numpy()[0, 0]
    np.testing.assert_allclose(sent[:, 0] / sent[:, 3], expected[0] / (expected[0] + expected[1]), rtol=1e-5)


def test_many_bodies_share_a_scenes_patches_by_their_areas():
    ball, light = ws.icosphere(1.0, 4), ws.EnvironmentMap.constant(1.0, height=8)
    camera = ws.Camera.look_at((0, 3, 8), (0, 1, 0))
    scales = [1.0] * 19 + [0.1]
    bodies = [ws.Body(ball, blockers=1, scale=scale, name=f"{number}") for number, scale in enumerate(scales)]
    few, many = (ScenePatches(MergedScene(ws.Scene(tuple(some), light, camera))) for some in (bodies[:2], bodies))
    assert few.of_body(0).count == 256
    assert len(few.of_body(0).patch_samples.patches) > 3 * 256
    assert [many.of_body(number).count for number in (0, 19)] == [64, 32]
    assert len(many.of_body(0).patch_samples.patches) == 3 * 64


def test_closed_patches_have_the_nearest_open_one_of_their_body_for_a_stand_in(merged_scene):
    senders = ScenePatches(merged_scene).senders(Materials.of_scene(merged_scene))
    first, end, last = senders.first
    ball = senders.patches[0]
    is_open = np.ones(last, bool)
    is_open[:end] = ball.centers[:, 1] > 0.2
    found = senders.nearest_open_patches(is_open)
    np.testing.assert_array_equal(found[is_open], np.flatnonzero(is_open))
    closed = np.flatnonzero(~is_open)
    assert len(closed) > 20 and is_open[found[closed]].all() and (found[closed] < end).all()
    away = np.linalg.norm(ball.centers[closed] - ball.centers[found[closed]], axis=1)
    steps = np.linalg.norm(ball.centers[closed][:, None] - ball.centers[is_open[:end]], axis=2).min(axis=1)
    np.testing.assert_allclose(away, steps, atol=0.05)  # normals count, too, which are a ball's places
    is_open[:end] = False
    # nothing stands in for a body
    np.testing.assert_array_equal(senders.nearest_open_patches(is_open), np.arange(last))
