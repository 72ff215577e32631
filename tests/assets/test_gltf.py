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


def test_of_a_texture_the_means_count_and_a_line_says_so(tmp_path):
    codes = np.zeros((4, 4, 3), np.uint8)
    codes[..., 1], codes[:2, :, 2] = 102, 255
    path = write(tmp_path / "a.glb", {"metallicRoughnessTexture": Image.fromarray(codes), "metallicFactor": 0.5})
    with pytest.warns(UserWarning, match=r"the means count \(roughness 0.4, metallic 0.25\)"):
        body = ws.Body(path)
    assert body.roughness == pytest.approx(0.4) and body.metallic == pytest.approx(0.25)
