"""Roughness, metallic and specular of bodies: their checks, and scene files that have them."""

import numpy as np
import pytest

import warpshadow as ws
from warpshadow.scene.files import write_scene

BALL = ws.icosphere(0.5, 1)
SKY = ws.EnvironmentMap.constant(1.0)


def test_a_body_without_roughness_is_diffuse():
    assert not ws.Body(BALL).is_glossy
    assert ws.Body(BALL, roughness=0.3).is_glossy


@pytest.mark.parametrize(
    ("roughness", "given", "expected"),
    [
        (None, None, 128),
        (0.3, None, 128),
        (0.29, None, 256),
        (np.linspace(0.2, 1, 42), None, 256),
        (0.29, 64, 64),
        (0.9, 512, 512),
    ],
)
def test_narrow_lobes_have_finer_cells_unless_a_number_is_given(roughness, given, expected):
    bodies = [ws.Body(BALL), ws.Body(BALL, roughness=roughness)]
    scene = ws.Scene(bodies, SKY, visibility=ws.Visibility(directions=given))
    assert scene.direction_count == expected
    assert ws.Renderer(scene).basis.size == expected


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"roughness": 1.2}, "roughness: got 1 values out of range"),
        ({"roughness": "matte"}, "roughness: got 'matte', expected a number from 0 to 1"),
        (
            {"roughness": np.zeros(7)},
            r"roughness: got shape \(7,\), expected a number from 0 to 1, one for each of the 42",
        ),
        (
            {"roughness": np.zeros((7, 7, 1))},
            r"roughness: got shape \(7, 7, 1\), expected .* or a texture \[height, width",
        ),
        ({"roughness": 0.5, "metallic": np.zeros((4, 4))}, r"metallic: got an image, but mesh .* has no uvs"),
        ({"metallic": 1.0}, "metallic: got 1.0 without roughness, expected roughness, too, such as 0.3"),
        ({"roughness": 0.5, "receivers": "vertex"}, "receivers: got 'vertex' beside roughness"),
    ],
)
def test_values_that_no_surface_has_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        ws.Body(BALL, **arguments)


@pytest.mark.parametrize(
    ("texture", "message"),
    [
        (np.full((2, 3), np.nan), "metallic: got 6 NaN"),
        ([[0.5, 1.5]], "metallic: got 1 values out of range"),
        (np.zeros((0, 4)), r"metallic: got shape \(0, 4\)"),
    ],
)
def test_textures_that_no_surface_has_are_refused(texture, message):
    with pytest.raises(ValueError, match=message):
        ws.Body(ws.plane(1.0), roughness=0.5, metallic=texture)


def test_a_method_that_does_not_show_gloss_refuses_it():
    with pytest.raises(ValueError, match="roughness: got some for body 'ball', which 'log-sh'"):
        ws.Scene([ws.Body(BALL, roughness=0.5, name="ball")], SKY, visibility=ws.Visibility("log-sh"))


def test_scene_files_read_back_the_same_gloss(tmp_path):
    values = np.random.default_rng(0).uniform(size=BALL.vertex_count).astype(np.float32)
    texture = np.random.default_rng(1).uniform(size=(3, 5)).astype(np.float32)
    bodies = [
        ws.Body(BALL, roughness=1 / 3, name="plain"),
        ws.Body(BALL, roughness=values, metallic=1.0, specular=0.25, name="each", translation=(2, 0, 0)),
        ws.Body(ws.plane(1.0), roughness=texture, metallic=texture[:2], name="textured", translation=(4, 0, 0)),
    ]
    write_scene(ws.Scene(bodies, SKY), tmp_path)
    plain, each, textured = ws.load_scene(tmp_path / "scene.toml").bodies
    assert plain.roughness == np.float32(1 / 3) and plain.metallic is None
    assert np.array_equal(each.roughness, values) and each.metallic == 1 and each.specular == 0.25
    assert np.array_equal(textured.roughness, texture) and np.array_equal(textured.metallic, texture[:2])


def test_vertex_values_follow_creases():
    box = ws.icosphere(0.5, 0)
    values = np.linspace(0, 1, box.vertex_count, dtype=np.float32)
    body = ws.Body(box, roughness=values).creased(10)
    assert np.array_equal(body.roughness, values[body.mesh.origins]) and body.roughness.size > box.vertex_count
