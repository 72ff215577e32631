"""Scene files: every key, its default, and the message for everything that can be wrong with it."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import warpshadow as ws
from warpshadow.maths import sh

# A rotation in float64 from an angle in degrees.
FLOAT64 = 1e-12
# Positions are float32 of size 10 or less.
FLOAT32 = 3e-6

CAMERA = "[camera]\neye = [0, 1, 4]\ntarget = [0, 0, 0]\n"
LIGHT = "[light]\nsh = [[1, 1, 1], [0, 0, 0], [0.5, 0, 0], [0, 0, 0]]\n"
BODY = '[[body]]\nprimitive = "icosphere"\n'
MINIMAL = CAMERA + LIGHT + BODY


@pytest.fixture
def load(tmp_path):
    def load_text(text: str | bytes) -> ws.Scene:
        path = tmp_path / "scene.toml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return ws.load_scene(path)

    return load_text


def refused(load, text, *parts, error=ws.SceneError):
    """Every message starts with the file and names all the parts."""
    with pytest.raises(error) as caught:
        load(text)
    message = str(caught.value)
    assert "scene.toml: " in message
    for part in parts:
        assert part in message, f"{part!r} is not in {message!r}"


# ---------------------------------------------------------------------------------------------- what is right


def test_every_key_has_the_documented_default_but_camera_light_and_a_body(load):
    scene = load(MINIMAL)
    assert (scene.camera.width, scene.camera.height, scene.camera.near) == (256, 256, 0.01)
    expected = ws.Camera.look_at((0, 1, 4), (0, 0, 0), up=(0, 1, 0), fov_y=40)
    np.testing.assert_array_equal(scene.camera.clip_matrix(), expected.clip_matrix())
    visibility = scene.visibility
    assert (visibility.method, visibility.directions, visibility.softness) == (None, None, 0.35)
    assert visibility.sampling == "independent"
    assert visibility.merging == 0.75
    assert (visibility.order, visibility.log, visibility.base) == (8, "eigen", "quadratic")
    (body,) = scene.bodies
    assert (body.blockers, body.scale, body.receivers, body.texture) == ("auto", 1.0, "auto", None)
    np.testing.assert_array_equal(body.rotation, np.zeros(3))
    np.testing.assert_array_equal(body.translation, np.zeros(3))
    np.testing.assert_array_equal(body.mesh.positions, ws.icosphere().positions)
    np.testing.assert_allclose(scene.light, [[1, 1, 1], [0, 0, 0], [0.5, 0, 0], [0, 0, 0]], atol=FLOAT32)


def test_every_key_of_the_camera_is_read(load):
    scene = load(
        "[camera]\neye = [1, 2, 3]\ntarget = [0, 0.5, 0]\nup = [0, 0, 1]\nfov_y = 55.5\n"
        "size = [12, 8]\nnear = 0.5\nsupersampling = 3\n" + LIGHT + BODY
    )
    expected = ws.Camera.look_at((1, 2, 3), (0, 0.5, 0), up=(0, 0, 1), fov_y=55.5, size=(12, 8), near=0.5)
    np.testing.assert_array_equal(scene.camera.clip_matrix(), expected.clip_matrix())
    assert (scene.camera.width, scene.camera.height, scene.supersampling) == (12, 8, 3)


SETTINGS = (
    'directions = 64\nsoftness = 1\norder = 4\nlog = "cap"\nbase = "optimal_linear"\nsamples = 33\nmerging = 0.5\n'
    "error = 0.02\n"
)


@pytest.mark.parametrize(
    ("method", "read"),
    [
        ("directional", {"directions": 64, "softness": 1, "merging": 0.5, "samples": 33}),
        ("log-sh", {"order": 4, "log": "cap", "base": "optimal_linear", "merging": 0.5}),
        ("none", {"order": 4}),
        ("ray-traced", {"order": 4, "samples": 33}),
        ("auto", {"softness": 1, "order": 4, "merging": 0.5, "error": 0.02}),
    ],
)
def test_of_the_settings_in_a_file_those_that_the_method_reads_count(load, tmp_path, method, read):
    """A file may hold some for each method, of which --method chooses one."""
    load(MINIMAL + f"[visibility]\n{SETTINGS}")
    expected = dataclasses.asdict(ws.Visibility(method, **read))
    assert dataclasses.asdict(ws.load_scene(tmp_path / "scene.toml", method=method).visibility) == expected
    (tmp_path / "scene.toml").write_text(MINIMAL + f'[visibility]\nmethod = "{method}"\n{SETTINGS}')
    assert dataclasses.asdict(ws.load_scene(tmp_path / "scene.toml").visibility) == expected


def test_every_key_of_a_body_is_read_and_paths_are_relative_to_the_file(load, tmp_path, monkeypatch):
    folder = tmp_path / "parts"
    folder.mkdir()
    ws.plane(1.0, 1).write(folder / "tile.obj")
    ws.write_image(folder / "tile.exr", np.full((2, 4, 3), 0.25, np.float32))
    sky = np.random.default_rng(0).uniform(size=(8, 16, 3)).astype(np.float32)
    ws.EnvironmentMap(sky).write(folder / "sky.exr")
    monkeypatch.chdir("/")  # not the folder of the file
    scene = load(
        CAMERA + '[light]\nenvmap = "parts/sky.exr"\nrotation = 90\nscale = 2\n'
        '[[body]]\nmesh = "parts/tile.obj"\ntexture = "parts/tile.exr"\nblockers = 0\n'
        '[[body]]\nprimitive = "plane"\nsize = [3, 2]\nsegments = [2, 1]\nalbedo = [0.1, 0.2, 0.3]\nblockers = 7\n'
        'rotation = [0, 30, 0]\ntranslation = [1, 2, 3]\nscale = 2\nreceivers = "pixel"\n'
        '[[body]]\nprimitive = "icosphere"\nradius = 0.5\nsubdivisions = 1\n'
    )
    tile, plane, ball = scene.bodies
    np.testing.assert_array_equal(tile.texture, np.full((2, 4, 3), 0.25))
    assert tile.mesh.vertex_count == 4 and tile.blockers == 0
    np.testing.assert_array_equal(plane.mesh.positions, ws.plane((3, 2), (2, 1)).positions)
    np.testing.assert_allclose(plane.albedo, [0.1, 0.2, 0.3], rtol=FLOAT32)
    assert (plane.blockers, plane.scale, plane.receivers) == (7, 2, "pixel")
    np.testing.assert_array_equal(ball.mesh.positions, ws.icosphere(0.5, 1).positions)
    expected = ws.EnvironmentMap(sky).rotated(90).scaled(2)
    np.testing.assert_array_equal(scene.light.radiance, expected.radiance)


@pytest.mark.parametrize("channel_count", [1, 3, 4])
def test_a_texture_may_be_gray_or_have_alpha(load, tmp_path, channel_count):
    ws.write_image(tmp_path / "x.png", np.ones((2, 3, channel_count), np.float32))
    (body,) = load(MINIMAL.replace("icosphere", "plane") + 'texture = "x.png"\n').bodies
    np.testing.assert_array_equal(body.texture, np.ones((2, 3, 3)))


def test_sh_light_turns_as_a_map_does(load):
    """A map band-limited to order 2 is turned, and projected again."""
    coefficients = np.array([[3, 2, 1], [0.1, 0.2, 0.3], [0.4, 0.1, 0], [0.3, -0.5, 0.2]])
    image = sh.reconstruct_map(coefficients, 64).astype(np.float32)
    expected = ws.EnvironmentMap(image).rotated(90).scaled(1.5).sh(2)
    rows = ", ".join(map(str, coefficients.tolist()))
    light = load(CAMERA + f"[light]\nsh = [{rows}]\nrotation = 90\nscale = 1.5\n" + BODY).light
    quadrature = 1e-3  # of 64 rows of pixels
    np.testing.assert_allclose(light, expected, atol=quadrature)


# ---------------------------------------------------------------------------------------------- placing


@settings(max_examples=40, deadline=None)
@given(st.tuples(*[st.floats(-400, 400)] * 3))
def test_the_rotation_matrix_is_scipys(vector):
    body = ws.Body(ws.icosphere(1.0, 0), rotation=vector)
    expected = Rotation.from_rotvec(vector, degrees=True).as_matrix()
    assert np.abs(body.rotation_matrix() - expected).max() < FLOAT64


def test_a_body_is_scaled_then_rotated_then_translated():
    body = ws.Body(ws.icosphere(1.0, 1), rotation=(0, 90, 0), translation=(1, 2, 3), scale=2)
    x, y, z = body.mesh.positions.T
    expected = np.stack([2 * z + 1, 2 * y + 2, -2 * x + 3], axis=1)  # a quarter turn takes z to x
    assert np.abs(body.world_mesh().positions - expected).max() < FLOAT32


# ---------------------------------------------------------------------------------------------- what is wrong


@pytest.mark.parametrize(
    ("text", "where", "nearest"),
    [
        (MINIMAL + "[visibilty]\n", "the scene", "visibility"),
        (MINIMAL.replace("eye", "eyes", 1), "[camera]", "eye"),
        (MINIMAL.replace("eye", "supersample = 3\neye", 1), "[camera]", "supersampling"),
        (CAMERA + '[light]\nenv_map = "x.exr"\n' + BODY, "[light]", "envmap"),
        (MINIMAL + '[visibility]\nmetod = "none"\n', "[visibility]", "method"),
        (MINIMAL + "albdo = [1, 1, 1]\n", "1st [[body]]", "albedo"),
        (MINIMAL + "radios = 1\n", "1st [[body]]", "radius"),
        (MINIMAL + BODY.replace("icosphere", "plane") + "segment = 4\n", "2nd [[body]]", "segments"),
        (MINIMAL + '[[body]]\nmesh = "x.obj"\nblocker = 3\n', "2nd [[body]]", "blockers"),
    ],
)
def test_an_unknown_key_of_any_table_names_the_nearest_known_key(load, text, where, nearest):
    refused(load, text, f"{where}: unknown {'table' if where == 'the scene' else 'key'} ", f"did you mean '{nearest}'?")


@pytest.mark.parametrize("name", ["camera", "light", "body"])
def test_a_missing_table_is_named(load, name):
    tables = {"camera": CAMERA, "light": LIGHT, "body": BODY}
    del tables[name]
    refused(load, "".join(tables.values()), f"[{name}] is missing")


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        (MINIMAL.replace("eye = [0, 1, 4]", ""), ["[camera]", "eye: missing", "expected 3 finite numbers"]),
        (MINIMAL.replace("target = [0, 0, 0]", ""), ["[camera]", "target: missing", "expected 3 finite numbers"]),
        (CAMERA + "[light]\n" + BODY, ["[light]", "one of envmap", "sky", "and sh"]),
        (CAMERA + LIGHT + 'envmap = "x.exr"\n' + BODY, ["[light]", "one of envmap", "sky", "and sh"]),
        (CAMERA + LIGHT + "[[body]]\n", ["1st [[body]]", "either mesh", "or primitive"]),
        (MINIMAL + 'mesh = "x.obj"\n', ["1st [[body]]", "either mesh", "'plane', 'icosphere'"]),
        (MINIMAL + 'albedo = [1, 1, 1]\ntexture = "x.png"\n', ["1st [[body]]", "either albedo or texture"]),
        (MINIMAL.replace('"icosphere"', '"cube"'), ["primitive", "'cube'", "'plane', 'icosphere'"]),
        (MINIMAL.replace("[[body]]", "[body]"), ["expected [[body]]"]),
        (MINIMAL.replace("[camera]", "[[camera]]"), ["[camera]", "a table of keys"]),
        ("visibility = 3\n" + MINIMAL, ["[visibility]", "3", "a table of keys"]),
        ("body = [1]\n" + CAMERA + LIGHT, ["1st [[body]]", "a table of keys"]),
        ("body = []\n" + CAMERA + LIGHT, ["bodies: got none"]),
    ],
)
def test_missing_and_contradictory_keys_say_what_is_accepted(load, text, parts):
    refused(load, text, *parts)


NOT_THREE_NUMBERS = ('"red"', "1", "[1, 2]", '["a", 1, 2]', "[true, 1, 2]", "[nan, 1, 2]", "[inf, 1, 2]", "[[1], 1, 2]")
NOT_A_NUMBER = ('"1"', "true", "[1]", "nan", "inf", "1979-05-27")
NOT_WHOLE = ('"1"', "true", "[1]", "2.0", "nan")
NOT_POSITIVE = ("0", "-1")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("table", "key", "values"),
    [
        ("camera", "up", NOT_THREE_NUMBERS),
        ("camera", "fov_y", (*NOT_A_NUMBER, *NOT_POSITIVE, "180")),
        ("camera", "near", (*NOT_A_NUMBER, *NOT_POSITIVE)),
        ("camera", "size", ('"8"', "[8]", "[8, 8, 8]", "[8, 8.5]", "[8, true]", '[8, "8"]', "[8, [8]]", "[8, 0]")),
        ("camera", "supersampling", (*NOT_WHOLE, "0", "17")),
        ("light", "bounces", (*NOT_WHOLE, "-1", "17")),
        ("light", "scale", (*NOT_A_NUMBER, "-1")),
        ("light", "rotation", NOT_A_NUMBER),
        ("visibility", "method", ('"rays"', "3", '["none"]')),
        ("visibility", "directions", (*NOT_WHOLE, *NOT_POSITIVE, "100")),
        ("visibility", "softness", (*NOT_A_NUMBER, *NOT_POSITIVE)),
        ("visibility", "merging", (*NOT_A_NUMBER, "-0.1", "1.5")),
        ("visibility", "order", (*NOT_WHOLE, "1", "9")),
        ("visibility", "log", ('"egen"', "3")),
        ("visibility", "base", ('"cubic"', "3")),
        ("visibility", "samples", (*NOT_WHOLE, *NOT_POSITIVE)),
        ("body", "albedo", (*NOT_THREE_NUMBERS, "[-1, 0, 0]")),
        ("body", "rotation", NOT_THREE_NUMBERS),
        ("body", "translation", NOT_THREE_NUMBERS),
        ("body", "scale", (*NOT_A_NUMBER, *NOT_POSITIVE)),
        ("body", "blockers", (*NOT_WHOLE, "-1")),
        ("body", "receivers", ('"face"', "3")),
        ("body", "radius", (*NOT_A_NUMBER, *NOT_POSITIVE)),
        ("body", "subdivisions", (*NOT_WHOLE, "-1", "9")),
        ("plane", "size", (*NOT_A_NUMBER, *NOT_POSITIVE, "[1, 2, 3]", '[1, "a"]')),
        ("plane", "segments", (*NOT_WHOLE, *NOT_POSITIVE, "[1, 2, 3]", '[1, "a"]')),
        ("body", "texture", ("3",)),
    ],
)
def test_a_wrong_value_is_refused_with_its_table_its_key_and_what_is_accepted(load, table, key, values):
    tables = {"camera": CAMERA, "light": LIGHT, "visibility": "[visibility]\n", "body": BODY}
    if table == "plane":
        table, tables["body"] = "body", BODY.replace("icosphere", "plane")
    where = {"body": "1st [[body]]"}.get(table, f"[{table}]")
    for value in values:
        text = "".join(lines + f"{key} = {value}\n" * (name == table) for name, lines in tables.items())
        refused(load, text, where, f" {key}", "got", "expected")


@pytest.mark.parametrize(
    ("table", "key", "others"),
    [
        ("[visibility]", "bounces", "[light]"),
        ("[camera]", "bounces", "[light]"),
        ("[visibility]", "receivers", "[[body]]"),
        ("[visibility]", "blockers", "[[body]]"),
        ("[visibility]", "supersampling", "[camera]"),
        ("[light]", "size", "[camera] or [[body]]"),
        ("the scene", "bounces", "[light]"),
        ("the scene", "self_shadows", "[visibility] or [[body]]"),
    ],
)
def test_a_key_of_another_table_is_refused_with_the_table_that_has_it(load, table, key, others):
    line = f"{key} = 2\n"
    if table == "the scene":
        text = line + MINIMAL
    else:
        text = MINIMAL.replace(f"{table}\n", f"{table}\n{line}") if table in MINIMAL else MINIMAL + f"{table}\n{line}"
    refused(load, text, table, f"got {key}, expected it in {others}")


def test_bounces_are_read_and_what_a_call_says_counts(load, tmp_path):
    assert load(MINIMAL).bounces == 0
    assert load(MINIMAL.replace("[light]", "[light]\nbounces = 2")).bounces == 2
    (path,) = tmp_path.glob("*.toml")
    assert ws.load_scene(path, bounces=3).bounces == 3


def test_light_does_not_bounce_without_visibility(load):
    text = MINIMAL.replace("[light]", "[light]\nbounces = 2")
    refused(load, text + '[visibility]\nmethod = "none"\n', "bounces: got 2, which 'none' does not find, expected 0")


@pytest.mark.parametrize("value", NOT_THREE_NUMBERS)
@pytest.mark.parametrize("key", ["eye", "target"])
def test_an_eye_or_target_that_is_not_three_numbers_is_refused(load, key, value):
    lines = [f"{key} = {value}" if line.startswith(key) else line for line in CAMERA.splitlines()]
    refused(load, "\n".join(lines) + "\n" + LIGHT + BODY, "[camera]", f"{key}: got", "expected", "finite numbers")


@pytest.mark.parametrize(
    "value",
    ["3", '"x"', "[1, 2, 3]", "[[1, 1]]", '[["a", 1, 1]]', "[[true, 1, 1]]", "[[nan, 1, 1]]", "[[1, 1, 1]]", "[]"],
)
def test_sh_light_that_is_not_a_square_number_of_colors_is_refused(load, value):
    refused(load, CAMERA + f"[light]\nsh = {value}\n" + BODY, "sh", "got", "expected")


def test_a_texture_on_a_mesh_without_uvs_is_refused(load, tmp_path):
    ws.write_image(tmp_path / "x.png", np.ones((2, 2, 3), np.float32))
    refused(load, MINIMAL + 'texture = "x.png"\n', "1st [[body]]", "texture", "'icosphere' has no uvs")


@pytest.mark.parametrize(
    ("text", "where", "key"),
    [
        (CAMERA + '[light]\nenvmap = "no.exr"\n' + BODY, "[light]", "envmap"),
        (CAMERA + '[light]\nenvmap = ""\n' + BODY, "[light]", "envmap"),
        (CAMERA + LIGHT + '[[body]]\nmesh = "no.obj"\n', "1st [[body]]", "mesh"),
        (MINIMAL.replace("icosphere", "plane") + 'texture = "no.png"\n', "1st [[body]]", "texture"),
    ],
)
def test_a_missing_file_is_named_with_its_key_and_its_whole_path(load, tmp_path, text, where, key):
    refused(load, text, where, f"{key}: no such file: {tmp_path}", error=FileNotFoundError)


@pytest.mark.parametrize("broken", ["no.obj", "no.exr"])
def test_a_file_of_another_kind_is_refused_with_its_path(load, tmp_path, broken):
    (tmp_path / broken).write_bytes(b"\x00 not a mesh, not a picture")
    light = LIGHT if broken.endswith("obj") else f'[light]\nenvmap = "{broken}"\n'
    body = BODY if broken.endswith("exr") else f'[[body]]\nmesh = "{broken}"\n'
    refused(load, CAMERA + light + body, broken)


@pytest.mark.parametrize("text", ["x =", "[camera", b"\xff\xfe\x00", "[camera]\n[camera]\n"])
def test_text_that_is_not_toml_is_refused_as_such(load, text):
    refused(load, text, "not valid TOML")


def test_a_missing_scene_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="nothing.toml"):
        ws.load_scene(tmp_path / "nothing.toml")


# ---------------------------------------------------------------------------------------------- in Python


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"albedo": (1, 1)}, r"albedo: got shape \(2,\), expected \[3\] or \[12, 3\]"),
        ({"albedo": np.ones((11, 3))}, r"albedo: got shape \(11, 3\)"),
        ({"albedo": (np.nan, 0, 0)}, "albedo: got 1 NaN"),
        ({"texture": np.ones((2, 2, 3))}, "texture: got an image, but mesh 'icosphere' has no uvs"),
        ({"albedo": "red"}, r"albedo: got 'red', expected a linear color such as .*: that color is \(1, 0, 0\)"),
        ({"albedo": "#808080"}, r": that color is \(0.2159, 0.2159, 0.2159\)"),  # 50.2% of sRGB
        ({"albedo": "rde"}, r"albedo: got 'rde', expected a linear color such as .* of them$"),
        ({"albedo": (255, 100, 3)}, r"albedo: got values from 3.0 to 255.0, .*srgb_to_linear\(colors / 255\)"),
        ({"albedo": np.ones((12, 3), np.uint8)}, "albedo: got values of uint8"),
        ({"blockers": -1}, "blockers: got -1"),
        ({"rotation": (1, 2)}, r"rotation: got \(1, 2\), expected 3 finite numbers: an axis-angle"),
        ({"rotation": (0, 0, 0, 1)}, r"rotation: got 4 numbers, .*Rotation.from_quat\(\(x, y, z, w\)\).as_matrix\(\)"),
        ({"rotation": np.eye(4)}, r"rotation: got ndarray .* shape \(4, 4\), expected 3 .*: .* or a rotation matrix"),
        ({"rotation": 2 * np.eye(3)}, r"rotation: got .*, expected a rotation \(orthonormal, determinant \+1\)"),
        ({"rotation": [[1, 0], [0]]}, r"rotation: got \[\[1, 0\], \[0\]\], expected 3 finite numbers"),
        ({"translation": (np.inf, 0, 0)}, "translation: got 1 NaN or Inf"),
        ({"translation": None}, "translation: got None, expected 3 finite numbers"),
        ({"scale": 0.0}, "scale: got 0.0, expected a positive number"),
        ({"scale": (1, 2, 1)}, r"scale: got \(1, 2, 1\), .*mesh.transformed\(scale=\(x, y, z\)\)"),
        ({"scale": "2"}, "scale: got '2', expected a positive number"),
        ({"mesh": None}, "mesh: got None, expected a Mesh or the path of a file"),
        ({"mesh": np.ones((4, 3))}, r"mesh: got ndarray .* Mesh\(positions, faces\) makes one"),
        ({"receivers": "vertices"}, "receivers: got 'vertices'.*did you mean 'vertex'"),
    ],
)
def test_a_bad_argument_of_a_body_is_named(options, message):
    with pytest.raises(ValueError, match=message):
        ws.Body(**{"mesh": ws.icosphere(1.0, 0)} | options)


@pytest.mark.parametrize(
    ("texture", "message"),
    [
        (np.full((2, 2, 3), 200, np.uint8), r"texture: got values of uint8, .*srgb_to_linear\(values / 255\)"),
        (np.full((2, 2, 3), 200.0), "texture: got values from 200.0 to 200.0, expected reflectances in"),
        (np.full((2, 2, 3), -0.1), "texture: got values from -0.1"),
        (np.ones((2, 2, 4)), r"texture: got shape \(2, 2, 4\), .*: \[..., :3\] is without alpha"),
        (np.ones((2, 2)), "gray images are repeated"),
        (np.ones((3, 8, 8)), "channels come last"),
    ],
)
def test_an_image_that_is_no_reflectance_is_refused(texture, message):
    with pytest.raises(ValueError, match=message):
        ws.Body(ws.plane(1.0, 1), texture=texture)


@pytest.mark.parametrize("kind", [str, Path])
def test_paths_stand_for_what_is_in_them_as_in_a_scene_file(load, tmp_path, monkeypatch, kind):
    ws.plane(1.0, 1).write(tmp_path / "tile.obj")
    ws.write_image(tmp_path / "tile.png", np.full((2, 4), 0.25))  # gray, which becomes RGB
    np.save(tmp_path / "colors.npy", np.full((4, 3), 0.5, np.float32))
    np.savez(tmp_path / "ball.npz", centers=[[0, 1, 0]], radii=[0.5])
    ws.synthetic_sky(height=8).write(tmp_path / "sky.exr")
    expected = load(
        CAMERA + '[light]\nenvmap = "sky.exr"\n[[body]]\nmesh = "tile.obj"\ntexture = "tile.png"\n'
        '[[body]]\nmesh = "tile.obj"\nalbedo = "colors.npy"\nspheres = "ball.npz"\n'
    )
    monkeypatch.chdir(tmp_path)
    textured = ws.Body(kind("tile.obj"), texture=kind("tile.png"))
    colored = ws.Body(kind("tile.obj"), albedo=kind("colors.npy"), blockers=kind("ball.npz"))
    scene = ws.Scene((textured, colored), kind("sky.exr"), expected.camera)
    np.testing.assert_array_equal(scene.light.radiance, expected.light.radiance)
    for body, other in zip(scene.bodies, expected.bodies, strict=True):
        assert body.mesh.content_hash == other.mesh.content_hash and body.mesh.name == "tile"
        np.testing.assert_array_equal(body.albedo, other.albedo)
    np.testing.assert_array_equal(textured.texture, expected.bodies[0].texture)
    np.testing.assert_array_equal(colored.blockers.centers, [[0, 1, 0]])
    np.testing.assert_array_equal(colored.blockers.radii, expected.bodies[1].blockers.radii)


@pytest.mark.parametrize(
    ("name", "file"), [("mesh", "cow.obj"), ("texture", "wood.png"), ("albedo", "x.npy"), ("blockers", "x.npz")]
)
def test_a_file_that_a_body_names_is_missed_or_unfit_by_the_name_of_the_argument(name, file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError, match=rf"^{name}: no such file: {file} \(in "):
        ws.Body(**{"mesh": ws.plane(1.0, 1), name: file})
    (tmp_path / file).write_bytes(b"\x00 nothing of the kind")
    with pytest.raises(ValueError, match=f"^{name}: .*{file}"):
        ws.Body(**{"mesh": ws.plane(1.0, 1), name: file})


def test_a_texture_without_texels_is_refused():
    with pytest.raises(ValueError, match=r"texture: got shape \(0, 4, 3\), expected at least one texel"):
        ws.Body(ws.plane(1.0, 1), texture=np.ones((0, 4, 3)))


@pytest.mark.parametrize("blockers", [2.5, "64", None, True])
def test_blockers_that_are_neither_a_number_nor_spheres_are_refused(blockers):
    with pytest.raises(ValueError, match="blockers: got"):
        ws.Body(ws.icosphere(1.0, 0), blockers=blockers)


def test_an_array_given_to_a_body_is_copied():
    albedo = np.ones(3, np.float32)
    body = ws.Body(ws.icosphere(1.0, 0), albedo=albedo)
    albedo[:] = np.nan
    np.testing.assert_array_equal(body.albedo, 1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bodies": ()}, "bodies: got none"),
        ({"bodies": ws.Body(ws.icosphere(1.0, 0))}, "bodies: got Body, expected a list"),
        ({"bodies": [ws.icosphere(1.0, 0)]}, r"bodies\[0\]: got Mesh, expected a Body"),
        ({"light": None}, r"light: got None, expected an EnvironmentMap .*, or the path of a map"),
        ({"light": 1.0}, r"light: got shape \(\), .*EnvironmentMap.constant"),
        ({"light": np.ones((4, 8, 3))}, r"light: got shape \(4, 8, 3\), .*EnvironmentMap\(pixels\)"),
        ({"light": np.ones((100, 3))}, "light: order: got 10, expected a number of bands from 2 to 8"),
        ({"camera": "front"}, "camera: got 'front', expected a Camera"),
        ({"camera": [ws.Camera.look_at((0, 0, 3), (0, 0, 0))] * 2}, r"camera: got list .*Renderer\(scene, cameras="),
        ({"visibility": "log-sh"}, "visibility: got 'log-sh', expected a Visibility"),
        ({"supersampling": 2.0}, "supersampling: got 2.0"),
        ({"light": np.ones((5, 3))}, r"light: got shape \(5, 3\), expected .*, or SH coefficients \[order², 3\]"),
        ({"light": np.full((4, 3), np.nan)}, "light: got 12 NaN"),
        ({"supersampling": 0}, "supersampling: got 0"),
        ({"supersampling": True}, "supersampling: got True"),
        ({"bounces": -1}, "bounces: got -1, expected a whole number from 0 to 16"),
        ({"bounces": 1.0}, "bounces: got 1.0"),
    ],
)
def test_a_bad_argument_of_a_scene_is_named(options, message):
    arguments = {
        "bodies": (ws.Body(ws.icosphere(1.0, 0)),),
        "light": np.ones((4, 3)),
        "camera": ws.Camera.look_at((0, 0, 3), (0, 0, 0)),
    }
    with pytest.raises(ValueError, match=message):
        ws.Scene(**{**arguments, **options})


def test_light_that_is_no_file_is_missed_by_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    bodies, camera = [ws.Body(ws.icosphere(1.0, 0))], ws.Camera.look_at((0, 0, 3), (0, 0, 0))
    with pytest.raises(FileNotFoundError, match=r"^light: no such file: park.exr \(in "):
        ws.Scene(bodies, "park.exr", camera)
    ws.write_image("square.exr", np.ones((4, 4, 3)))
    with pytest.raises(ws.ImageError, match="^light: square.exr: radiance: got 4 x 4 pixels"):
        ws.Scene(bodies, "square.exr", camera)


@pytest.mark.parametrize(
    "options",
    [
        {"method": "directionl"},
        {"directions": "128"},
        {"directions": 128.0},
        {"order": "8"},
        {"order": 8.0},
        {"softness": "soft"},
        {"softness": None},
        {"merging": "x"},
        {"samples": 1e3},
        {"error": "5%"},
    ],
)
def test_a_bad_argument_of_visibility_is_named(options):
    ((name, value),) = options.items()
    with pytest.raises(ValueError, match=f"^{name}: got {value!r}.*, expected"):
        ws.Visibility(**options)


@pytest.mark.parametrize(
    ("method", "name", "value", "readers"),
    [
        ("log-sh", "softness", 0.5, "'directional' or 'auto'"),
        ("none", "directions", 64, "'directional'"),
        ("ray-traced", "merging", 0.0, "'directional' or 'log-sh' or 'auto'"),
        ("directional", "order", 4, "'log-sh' or 'none' or 'ray-traced' or 'auto'"),
        ("directional", "log", "cap", "'log-sh'"),
        ("none", "base", "linear", "'log-sh'"),
        ("log-sh", "samples", 64, "'directional' or 'ray-traced'"),
        ("auto", "directions", 64, "'directional'"),
        ("directional", "error", 0.1, "'auto'"),
    ],
)
def test_a_setting_that_a_method_does_not_read_is_refused_with_those_that_do(method, name, value, readers):
    with pytest.raises(ValueError, match=f"^{name}: got {value!r}, which '{method}' .* or method = {readers};"):
        ws.Visibility(method, **{name: value})
    default = getattr(ws.Visibility(), name)
    assert getattr(ws.Visibility(method, **{name: default}), name) == default


def test_settings_of_visibility_are_compared_by_their_values():
    assert ws.Visibility() == ws.Visibility()
    assert len({ws.Visibility("log-sh", order=4), ws.Visibility("log-sh", order=4)}) == 1
    assert ws.Visibility("log-sh", order=4) != ws.Visibility("log-sh", order=5)
    assert ws.Visibility() != ws.Visibility("directional")


def test_another_method_takes_along_the_settings_that_it_reads():
    directional = ws.Visibility(directions=64, softness=0.5, merging=0.25)
    with pytest.raises(ValueError, match=r"^directions: got 64, which 'log-sh' does not read.*\.by\('log-sh'\)"):
        dataclasses.replace(directional, method="log-sh")
    harmonic = directional.by("log-sh")
    assert dataclasses.asdict(harmonic) == dataclasses.asdict(ws.Visibility("log-sh", merging=0.25))
    assert dataclasses.replace(ws.Visibility(), method="none").method == "none"


@pytest.mark.parametrize(
    "settings", [{"order": 9}, {"method": "rays"}, {"method": "none", "softness": -1}, {"ordre": 8}]
)
def test_settings_that_are_not_read_are_checked(settings):
    with pytest.raises(ValueError, match="order: got 9|method: got 'rays'|softness: got -1|did you mean 'order'"):
        ws.Visibility.of(settings)


def test_arguments_in_each_others_places_are_named():
    body, light = ws.Body(ws.icosphere(1.0, 0)), ws.EnvironmentMap.constant(1.0)
    camera, visibility = ws.Camera.framing(body), ws.Visibility("none")
    for message, arguments in (
        ("camera in place of light and light in place of camera", ([body], camera, light)),
        ("camera in place of bodies and bodies in place of light", (camera, [body], light)),
        ("light in place of bodies and bodies in place of light", (light, body)),
        ("visibility in place of camera", ([body], light, visibility)),
    ):
        with pytest.raises(ValueError, match=rf"^Scene: got {message}.*, expected Scene\(bodies, light, camera"):
            ws.Scene(*arguments)


def test_a_matrix_is_a_rotation():
    matrix = ws.Body(ws.icosphere(1.0, 0), rotation=(10, -130, 25)).rotation_matrix()
    body = ws.Body(ws.icosphere(1.0, 0), rotation=matrix)
    np.testing.assert_allclose(body.rotation, (10, -130, 25), atol=1e-9)
    np.testing.assert_allclose(body.rotation_matrix(), matrix, atol=1e-12)
