"""Roughness and metallic of glTF materials are a body's."""

import numpy as np
import pytest
import trimesh
from PIL import Image

import warpshadow as ws


def write(path, *materials):
    scene = trimesh.Scene()
    for number, arguments in enumerate(materials):
        ball = trimesh.creation.icosphere(subdivisions=1)
        material = trimesh.visual.material.PBRMaterial(baseColorFactor=(200, 100, 50, 255), **arguments)
        ball.visual = trimesh.visual.TextureVisuals(uv=np.zeros((42, 2)), material=material)
        scene.add_geometry(ball, transform=trimesh.transformations.translation_matrix((3 * number, 0, 0)))
    scene.export(path)
    return path


@pytest.mark.parametrize(
    ("arguments", "roughness", "metallic"),
    [
        ({"roughnessFactor": 0.25, "metallicFactor": 0.75}, 0.25, 0.75),
        ({"roughnessFactor": 0.5}, 0.5, 0.0),  # of trimesh, in which no metal is meant
        ({"metallicFactor": 1.0}, 1.0, 1.0),  # roughness is 1 where none is said, as in glTF
    ],
)
def test_a_body_has_the_gloss_of_its_file(tmp_path, arguments, roughness, metallic):
    path = write(tmp_path / "a.glb", arguments)
    for source in (path, trimesh.load_scene(path, process=False)):
        body = ws.Body(source)
        assert body.roughness == np.float32(roughness) and body.metallic == np.float32(metallic)


@pytest.mark.parametrize("arguments", [{}, {"roughnessFactor": 1.0, "metallicFactor": 0.0}])
def test_a_file_that_says_nothing_or_rough_plastic_is_diffuse(tmp_path, arguments):
    assert not ws.Body(write(tmp_path / "a.glb", arguments)).is_glossy


@pytest.mark.parametrize(
    "chosen", [{"albedo": (0.5, 0.5, 0.5)}, {"shadow_catcher": True}, {"receivers": "vertex"}, {"roughness": 0.9}]
)
def test_a_surface_that_is_given_counts(tmp_path, chosen):
    path = write(tmp_path / "a.glb", {"roughnessFactor": 0.25, "metallicFactor": 1.0})
    body = ws.Body(path, **chosen)
    assert body.metallic is None
    assert body.roughness == chosen.get("roughness") or body.roughness == np.float32(chosen["roughness"])


def test_parts_of_different_gloss_have_it_at_vertices(tmp_path):
    shiny, plain = {"roughnessFactor": 0.2, "metallicFactor": 1.0}, {}
    body = ws.Body(write(tmp_path / "a.glb", shiny, plain))
    is_shiny = body.mesh.positions[:, 0] < 1.5
    np.testing.assert_array_equal(body.roughness, np.where(is_shiny, np.float32(0.2), 1))
    np.testing.assert_array_equal(body.metallic, is_shiny)


CODES = np.zeros((4, 6, 3), np.uint8)
CODES[..., 0], CODES[:, 1:3, 1], CODES[:2, :, 2] = 77, 102, 255


def test_roughness_and_metallic_are_the_green_and_the_blue_of_a_texture_as_they_are(tmp_path):
    path = write(
        tmp_path / "a.glb",
        {"metallicRoughnessTexture": Image.fromarray(CODES), "metallicFactor": 0.5, "roughnessFactor": 0.25},
    )
    for source in (path, trimesh.load_scene(path, process=False)):
        body = ws.Body(source)
        np.testing.assert_allclose(body.roughness, CODES[..., 1] / 255 * 0.25, rtol=1e-6)
        np.testing.assert_allclose(body.metallic, CODES[..., 2] / 255 * 0.5, rtol=1e-6)


def test_a_texture_that_is_even_is_a_number(tmp_path):
    codes = np.full((4, 4, 3), 51, np.uint8)
    body = ws.Body(write(tmp_path / "a.glb", {"metallicRoughnessTexture": Image.fromarray(codes)}))
    np.testing.assert_allclose([body.roughness, body.metallic], [[0.2], [0.2]], rtol=1e-6)


def test_where_parts_have_other_textures_the_means_count_and_a_line_says_so(tmp_path):
    textured = {"metallicRoughnessTexture": Image.fromarray(CODES), "metallicFactor": 0.5}
    with pytest.warns(UserWarning, match="of textures of roughness and metallic the means count, since a body takes"):
        body = ws.Body(write(tmp_path / "a.glb", textured, {"roughnessFactor": 0.3}))
    is_first = body.mesh.positions[:, 0] < 1.5
    np.testing.assert_allclose(body.roughness, np.where(is_first, 0.4 / 3, 0.3), rtol=1e-6)
    np.testing.assert_allclose(body.metallic, np.where(is_first, 0.25, 0.0), rtol=1e-6)
