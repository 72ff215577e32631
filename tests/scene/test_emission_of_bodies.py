"""Emission of bodies: its checks, scene files that have it, and glTF files."""

import json

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

import warpshadow as ws
from warpshadow.scene.files import write_scene

BALL = ws.icosphere(0.5, 1)
SKY = ws.EnvironmentMap.constant(1.0)


@pytest.mark.parametrize(
    ("emission", "message"),
    [
        ((1, 2), r"emission: got shape \(2,\), expected \[3\], \[42, 3\] \(one for each vertex\), or a texture"),
        ((1, -2, 0), "emission: got 1 values out of range"),
        ((np.nan, 1, 1), "emission: got 1 NaN"),
        ("bright", "emission: got 'bright', expected a linear color of 0 or more"),
    ],
)
def test_values_that_no_lamp_has_are_refused(emission, message):
    with pytest.raises(ValueError, match=message):
        ws.Body(BALL, emission=emission)


def test_a_catcher_does_not_emit():
    with pytest.raises(ValueError, match="emission: got some for a shadow catcher"):
        ws.Body(BALL, emission=(1, 1, 1), shadow_catcher=True)


def test_scene_files_read_back_the_same_emission(tmp_path):
    colors = np.random.default_rng(0).uniform(size=(42, 3)).astype(np.float32)
    texture = np.random.default_rng(1).uniform(size=(4, 5, 3)).astype(np.float32)
    emissions = [None, np.float32([40, 0.1, 7]), colors, texture]
    meshes = BALL, BALL, BALL, ws.plane(1.0, 2)
    pairs = zip(meshes, emissions, strict=True)
    bodies = [ws.Body(mesh, emission=item, name=str(number)) for number, (mesh, item) in enumerate(pairs)]
    write_scene(ws.Scene(bodies, SKY), tmp_path)
    for body, emission in zip(ws.load_scene(tmp_path / "scene.toml").bodies, emissions, strict=True):
        assert body.emission is None if emission is None else np.array_equal(body.emission, emission)


def test_emission_of_vertices_follows_creases():
    box = ws.Mesh.of(trimesh.creation.box()) if hasattr(ws.Mesh, "of") else ws.load_mesh(trimesh.creation.box())
    body = ws.Body(box, emission=np.arange(3 * box.vertex_count).reshape(-1, 3)).creased()
    np.testing.assert_array_equal(body.emission[:, 0] / 3, body.mesh.origins)
    texture = np.ones((2, 3, 3), np.float32)
    np.testing.assert_array_equal(ws.Body(ws.unwrap(box), emission=texture).creased().emission, texture)


def write(path, *factors, texture=None):
    scene = trimesh.Scene()
    for number, factor in enumerate(factors):
        ball = trimesh.creation.icosphere(subdivisions=1)
        name = f"material {number}"
        material = trimesh.visual.material.PBRMaterial(name, emissiveFactor=factor, emissiveTexture=texture)
        ball.visual = trimesh.visual.TextureVisuals(uv=np.zeros((42, 2)), material=material)
        scene.add_geometry(ball, transform=trimesh.transformations.translation_matrix((3 * number, 0, 0)))
    scene.export(path)
    return path


def test_a_body_has_the_emission_of_its_file(tmp_path):
    path = write(tmp_path / "a.glb", (0.5, 0.25, 0.125))
    np.testing.assert_array_equal(ws.Body(path).emission, np.float32([0.5, 0.25, 0.125]))
    assert ws.Body(path, albedo=(1, 1, 1)).emission is None
    assert ws.Body(path, shadow_catcher=True).emission is None
    np.testing.assert_array_equal(ws.Body(path, emission=(9, 9, 9)).emission, (9, 9, 9))
    assert ws.Body(write(tmp_path / "b.glb", None)).emission is None


def test_parts_that_emit_do_so_at_their_vertices(tmp_path):
    body = ws.Body(write(tmp_path / "a.glb", (0.5, 0.25, 0.125), None))
    is_first = body.mesh.positions[:, :1] < 1.5
    np.testing.assert_array_equal(body.emission, np.where(is_first, np.float32([0.5, 0.25, 0.125]), 0))


def test_the_strength_of_an_emissive_material_counts(tmp_path):
    path = write(tmp_path / "a.gltf", (0.5, 0.25, 0.125))
    tree = json.loads(path.read_text())
    tree["materials"][0]["extensions"] = {"KHR_materials_emissive_strength": {"emissiveStrength": 20.0}}
    path.write_text(json.dumps(tree))
    np.testing.assert_allclose(ws.Body(path).emission, (10, 5, 2.5))


def test_materials_of_one_factor_have_strengths_of_their_own(tmp_path):
    path = write(tmp_path / "a.gltf", (1, 1, 1), (1, 1, 1))
    tree = json.loads(path.read_text())
    assert len(tree["materials"]) == 2 and tree["materials"][0]["name"] != tree["materials"][1]["name"]
    tree["materials"][0]["extensions"] = {"KHR_materials_emissive_strength": {"emissiveStrength": 20.0}}
    path.write_text(json.dumps(tree))
    assert sorted(set(ws.Body(path).emission[:, 0].tolist())) == [1, 20]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int64, torch.uint8])
def test_codes_of_a_picture_are_no_radiance(dtype):
    codes = torch.full((4, 6, 3), 200, dtype=dtype) if dtype is torch.uint8 else np.full((4, 6, 3), 200, dtype)
    with pytest.raises(ValueError, match="emission: got codes of a picture .*srgb_to_linear"):
        ws.Body(ws.plane(1.0), emission=codes)
    np.testing.assert_array_equal(ws.Body(ws.plane(1.0), emission=(5, 4, 3)).emission, (5, 4, 3))


def test_the_texture_of_an_emissive_material_counts_times_factor_and_strength(tmp_path):
    codes = np.zeros((4, 6, 3), np.uint8)
    codes[:2, 3:] = (255, 188, 0)
    path = write(tmp_path / "a.gltf", (0.5, 0.25, 0.125), texture=Image.fromarray(codes))
    tree = json.loads(path.read_text())
    tree["materials"][0]["extensions"] = {"KHR_materials_emissive_strength": {"emissiveStrength": 20.0}}
    path.write_text(json.dumps(tree))
    expected = ws.srgb_to_linear(codes / 255) * (10, 5, 2.5)
    np.testing.assert_allclose(ws.Body(path).emission, expected, rtol=1e-5, atol=1e-7)


def test_a_texture_of_emission_that_is_even_is_a_color(tmp_path):
    white = Image.fromarray(np.full((4, 6, 3), 255, np.uint8))
    np.testing.assert_allclose(ws.Body(write(tmp_path / "a.glb", (1, 1, 0.5), texture=white)).emission, (1, 1, 0.5))


def test_where_parts_have_other_textures_of_emission_the_means_count_and_a_line_says_so(tmp_path):
    codes = np.zeros((4, 4, 3), np.uint8)
    codes[:2] = 255
    with pytest.warns(UserWarning, match="of textures of emission the means count, since a body takes"):
        body = ws.Body(write(tmp_path / "a.glb", (1, 1, 1), (0.5, 0.5, 0.5), texture=Image.fromarray(codes)))
    is_first = body.mesh.positions[:, :1] < 1.5
    np.testing.assert_allclose(body.emission, np.broadcast_to(np.where(is_first, 0.5, 0.25), body.emission.shape))


@pytest.mark.parametrize("texture", [{"texCoord": 1}, {"extensions": {"KHR_texture_transform": {"texCoord": 1}}}])
def test_a_texture_of_emission_on_other_uvs_counts_by_its_mean_and_a_line_says_so(tmp_path, texture):
    codes = np.zeros((4, 4, 3), np.uint8)
    codes[:2] = 255
    path = write(tmp_path / "a.gltf", (1, 0.5, 1), texture=Image.fromarray(codes))
    tree = json.loads(path.read_text())
    tree["materials"][0]["emissiveTexture"] |= texture
    path.write_text(json.dumps(tree))
    with pytest.warns(UserWarning, match="of textures of emission the means count, .* first uvs, of texCoord 0"):
        body = ws.Body(path)
    np.testing.assert_allclose(body.emission, (0.5, 0.25, 0.5))
