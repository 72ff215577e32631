"""Patches of a scene: which bodies send light, where they are lit, and what they reflect."""

import numpy as np
import pytest
import warp as wp

import warpshadow as ws
from warpshadow.device.tape import recorded
from warpshadow.pipeline.assembly import Assembly
from warpshadow.pipeline.node import Call, Clock
from warpshadow.pipeline.patches import ScenePatches
from warpshadow.pipeline.reflectance import Materials

RANDOM = np.random.default_rng(0)


@pytest.fixture
def assembly():
    ball = ws.icosphere(1.0, 2)
    ground = ws.plane(6.0, 8)
    bodies = (
        ws.Body(ball, RANDOM.uniform(0.1, 0.9, (ball.vertex_count, 3)), blockers=1, translation=(0, 1, 0)),
        ws.Body(ground, texture=RANDOM.uniform(0.1, 0.9, (16, 16, 3)), blockers=0),
        ws.Body(ball, (0.0, 0.0, 0.0), blockers=1, translation=(3, 1, 0), name="black"),
    )
    light = ws.EnvironmentMap.constant(1.0, height=8)
    return Assembly(ws.Scene(bodies, light, ws.Camera.look_at((0, 3, 8), (0, 1, 0), size=(8, 8))))


def test_black_bodies_send_nothing(assembly):
    materials = Materials.of_scene(assembly)
    assert ScenePatches(assembly).senders(materials).bodies == (0, 1)
    given = [None, None, wp.zeros((1, 1), dtype=wp.vec3)]
    assert ScenePatches(assembly).senders(materials.replaced(given, None)).bodies == (0, 1, 2)


def test_flat_bodies_have_a_grid_whose_back_nobody_sees(assembly):
    patches = ScenePatches(assembly)
    assert patches.flats == (1,)
    assert patches.of_body(1).grid.sides == 1
    assert patches.of_body(0).grid is None


def test_sources_lie_on_the_bodies_and_face_outwards(assembly):
    senders = ScenePatches(assembly).senders(Materials.of_scene(assembly))
    positions = assembly.scene_geometry.positions
    normals = wp.array(_normals(assembly)[None], dtype=wp.vec3)
    found = senders.sources(positions, normals)
    assert [span.body for span in found.spans] == [0, 1]
    _, first, end = found.spans[0]
    on_ball, outward = (array.numpy()[0, first:end] for array in (found.points, found.normals))
    away = on_ball - (0, 1, 0)
    assert (np.einsum("sk,sk->s", away, outward) > 0.9).all()
    _, first, end = found.spans[1]
    np.testing.assert_allclose(found.points.numpy()[0, first:end, 1], 0, atol=1e-6)
    np.testing.assert_allclose(found.normals.numpy()[0, first:end], [(0, 1, 0)] * (end - first), atol=1e-6)


def _normals(assembly):
    normals = [body.world_mesh().positions - body.translation for body in assembly.scene.bodies]
    normals[1] = np.tile([0.0, 1.0, 0.0], (len(normals[1]), 1))
    return np.concatenate(normals)


def test_albedo_of_patches_has_gradients_to_colors_and_textures(assembly):
    color = wp.array(RANDOM.uniform(size=(1, 162, 3)), dtype=wp.vec3, requires_grad=True)
    image = wp.array(RANDOM.uniform(size=(1, 16, 16, 3)), dtype=wp.vec3, requires_grad=True)
    materials = Materials.of_scene(assembly).replaced([color, None, None], [None, image, None])
    patches = ScenePatches(assembly)
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


def test_one_color_is_that_of_all_patches(assembly):
    patches = ScenePatches(assembly)
    materials = Materials.of_scene(assembly)
    given = wp.array([[(0.2, 0.3, 0.4)]], dtype=wp.vec3)
    albedo = patches.albedo(materials.replaced([given, given, None], None), (0, 1)).value(Call(Clock()))
    np.testing.assert_allclose(albedo.numpy()[0], np.tile([0.2, 0.3, 0.4], (albedo.shape[1], 1)), rtol=1e-6)
