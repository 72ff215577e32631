"""Beams of bodies, point and spot lights, and the lights of glTF files."""

import json

import numpy as np
import pytest
import trimesh

import warpshadow as ws

DARK = ws.EnvironmentMap.constant(0.0)
BALL = ws.icosphere(0.5, 1)
# Of 64 samples of a ball: the area that they show differs by 0.5% between directions, at most 1.6%. Measured 1.3%.
SAMPLES = 0.02


@pytest.mark.parametrize(
    ("beam", "message"),
    [
        ((30, 20), r"beam: got \(30.0, 20.0\), expected inner and outer angles \[degrees\] .* such as \(20, 30\)"),
        ((0, 0), "0 <= inner <= outer <= 180"),
        ((-1, 20), "0 <= inner <= outer <= 180"),
        ((20, 181), "0 <= inner <= outer <= 180"),
        (30, "beam: got 30, expected 2 finite numbers: inner and outer angles"),
        ((20, np.nan), "beam: got 1 NaN"),
        ("narrow", "beam: got 'narrow', expected 2 finite numbers"),
    ],
)
def test_beams_that_are_no_cone_are_refused(beam, message):
    with pytest.raises(ValueError, match=message):
        ws.Body(BALL, emission=(1, 1, 1), beam=beam)


def test_a_beam_without_emission_is_refused():
    with pytest.raises(ValueError, match="beam: got one without emission"):
        ws.Body(BALL, beam=(20, 30))


def test_scene_files_read_back_the_same_beam(tmp_path):
    beams = [None, (12.5, 40.0)]
    bodies = [ws.Body(BALL, emission=(1, 1, 1), beam=beam, name=f"lamp {beam}") for beam in beams]
    ws.write_scene(ws.Scene(bodies, DARK), tmp_path)
    read = ws.load_scene(tmp_path / "scene.toml").bodies
    assert [body.beam for body in read] == beams


def test_a_point_light_has_its_intensity_whatever_its_size():
    """White that faces it from a distance of 2 looks intensity / (4 π)."""
    ground = ws.Body(ws.plane(0.1, 1), (1, 1, 1))
    camera = ws.Camera.look_at((0.5, 1, 0), (0, 0, 0), fov_y=2, size=(8, 8))
    for make, options in ((ws.point_light, {}), (ws.spot_light, {"target": (0, 1, 0)})):
        for radius in (0.01, 0.1):
            lamp = make(position=(0, 2, 0), intensity=(3, 2, 1), radius=radius, **options)
            assert not lamp.casts_shadow and not lamp.albedo.any()
            image = ws.render(ws.Scene([ground, lamp], DARK, camera, supersampling=1))
            np.testing.assert_allclose(image[4, 4, :3], np.array([3, 2, 1]) / (4 * np.pi), rtol=SAMPLES)
    assert np.array_equal(ws.point_light((0, 0, 0), 2.0).emission, np.full(3, ws.point_light((0, 0, 0), 2).emission[0]))


@pytest.mark.parametrize("target", [(0, -1, 0), (0, 0, -4), (0, 0, 4), (1.5, -2, 0.7)])
def test_a_spot_light_faces_its_target(target):
    lamp = ws.spot_light((0.5, 0.2, 0.1), target, 1.0, beam=(5, 25))
    axis = np.subtract(target, (0.5, 0.2, 0.1))
    np.testing.assert_allclose(lamp.rotation_matrix() @ (0, 0, -1), axis / np.linalg.norm(axis), atol=1e-6)
    assert lamp.beam == (5, 25)
    np.testing.assert_allclose(lamp.translation, (0.5, 0.2, 0.1))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((0, 1, 0), (0, 1, 0), 1.0), r"target: got \[0.0, 1.0, 0.0\], the position, expected another point"),
        (((0, 1), (0, 0, 0), 1.0), "position: got"),
        (((0, 1, 0), (0, 0, 0), (1, 2)), r"intensity: got shape \(2,\)"),
        (((0, 1, 0), (0, 0, 0), -1.0), "intensity: got 1 values out of range"),
    ],
)
def test_spot_lights_that_cannot_be_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        ws.spot_light(*arguments)


LIGHTS = [
    {"type": "point", "color": [1, 0.5, 0.25], "intensity": 8.0, "name": "bulb"},
    {"type": "spot", "spot": {"innerConeAngle": 0.2, "outerConeAngle": 0.5}, "intensity": 4.0},
    {"type": "spot"},
    {"type": "directional", "intensity": 2.0},
]
HALF = float(np.sqrt(0.5))
NODES = [
    {"name": "parent", "translation": [0, 3, 0], "rotation": [-HALF, 0, 0, HALF], "scale": [2, 2, 2], "children": [1]},
    {"name": "down", "translation": [1, 0, 0], "extensions": {"KHR_lights_punctual": {"light": 1}}},
    {"translation": [4, 5, 6], "extensions": {"KHR_lights_punctual": {"light": 0}}},
    {"matrix": [0, 0, 1, 0, 0, 1, 0, 0, -1, 0, 0, 0, 7, 8, 9, 1], "extensions": {"KHR_lights_punctual": {"light": 2}}},
    {"rotation": [-HALF, 0, 0, HALF], "extensions": {"KHR_lights_punctual": {"light": 3}}},
    {"name": "of no scene", "extensions": {"KHR_lights_punctual": {"light": 0}}},
]


def with_lights(path):
    """A file of a ball and lights."""
    trimesh.Scene(trimesh.creation.icosphere(subdivisions=1)).export(path)
    tree = json.loads(path.read_text())
    first = len(tree["nodes"])
    nodes = [item | {"children": [first + child for child in item.get("children", [])]} for item in NODES]
    tree["nodes"] += [{key: value for key, value in node.items() if value != []} for node in nodes]
    tree["scenes"][tree["scene"]]["nodes"] += [first, first + 2, first + 3, first + 4]
    tree["extensions"] = {"KHR_lights_punctual": {"lights": LIGHTS}}
    path.write_text(json.dumps(tree))
    return path


def test_lights_of_gltf_files_are_lamps_and_suns(tmp_path):
    path = with_lights(tmp_path / "a.gltf")
    lamps, light = ws.load_lights(path, radius=0.1, angular_radius=5.0, scale=0.5)
    found = {lamp.name: lamp for lamp in lamps}
    assert sorted(found) == ["bulb", "down", "spot light"]
    np.testing.assert_allclose(found["bulb"].translation, (4, 5, 6))
    np.testing.assert_array_equal(found["bulb"].emission, ws.point_light((0, 0, 0), (4, 2, 1), radius=0.1).emission)
    assert found["bulb"].beam is None
    np.testing.assert_allclose(found["down"].translation, (2, 3, 0))
    np.testing.assert_allclose(found["down"].rotation_matrix() @ (0, 0, -1), (0, -1, 0), atol=1e-6)
    np.testing.assert_allclose(found["down"].beam, np.degrees([0.2, 0.5]))
    np.testing.assert_allclose(found["spot light"].rotation_matrix() @ (0, 0, -1), (1, 0, 0), atol=1e-6)
    np.testing.assert_allclose(found["spot light"].beam, (0, 45))
    expected = DARK.with_sun((0, 1, 0), 1.0, angular_radius=5.0)
    np.testing.assert_array_equal(light.radiance, expected.radiance)
    sky = ws.EnvironmentMap.constant(1.0)
    np.testing.assert_allclose(ws.load_lights(path, sky)[1].radiance.min(), 1)
    assert ws.Body(path).mesh.face_count == 80


def test_files_without_lights_have_none_and_other_files_are_refused(tmp_path):
    trimesh.creation.box().export(tmp_path / "box.glb")
    lamps, light = ws.load_lights(tmp_path / "box.glb")
    assert lamps == [] and not light.radiance.any()
    trimesh.creation.box().export(tmp_path / "box.obj")
    with pytest.raises(ValueError, match=r"path: got .*box.obj .*, expected a .glb or .gltf file"):
        ws.load_lights(tmp_path / "box.obj")
    with pytest.raises(FileNotFoundError, match="path: no such file"):
        ws.load_lights("nothing.glb")


def test_lights_of_other_kinds_and_files_without_their_parts_are_refused(tmp_path):
    tree = json.loads(with_lights(tmp_path / "a.gltf").read_text())
    lights = tree["extensions"]["KHR_lights_punctual"]["lights"]
    for broken, message in ((lights[:2], "index"), ([{"type": "area"}] * 4, "type: got 'area'"), ([{}] * 4, "'type'")):
        tree["extensions"]["KHR_lights_punctual"]["lights"] = broken
        (tmp_path / "b.gltf").write_text(json.dumps(tree))
        with pytest.raises(ValueError, match=rf"path: got .*b.gltf \(.*{message}.*\), expected a .glb or .gltf file"):
            ws.load_lights(tmp_path / "b.gltf")
