"""Scene files that are written: they read back as the same scene; and the keys that this takes."""

from dataclasses import asdict, fields, replace

import numpy as np
import pytest

import warpshadow as ws
from warpshadow.scene import toml_tables
from warpshadow.scene.files import file_stems, write_scene

RANDOM = np.random.default_rng(0)
LIGHTS = {
    "map": ws.EnvironmentMap(RANDOM.uniform(0, 9, (8, 16, 3))),
    "sh": RANDOM.normal(size=(9, 3)).astype(np.float32),
}
BALL = ws.Spheres(RANDOM.uniform(-0.1, 0.1, (3, 3)), RANDOM.uniform(0.2, 0.4, 3))
TABLES = """
[camera]
eye = [0, 1, 4]
target = [0, 0, 0]
size = [8, 6]
[light]
sh = [[1, 1, 1], [0, 0, 0], [0.5, 0, 0], [0, 0, 0]]
[[body]]
primitive = "icosphere"
subdivisions = 1
"""
PINHOLE = """
intrinsics = [[40, 0.5, 3.5], [0, 42, 2.5], [0, 0, 1]]
rotation = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]
translation = [0.1, 0.2, 4]
"""


SETTINGS = {
    "directional": ws.Visibility(directions=32, softness=0.7, merging=0.3),
    "log-sh": ws.Visibility("log-sh", merging=0.3, order=4, log="cap", base="linear"),
    "ray-traced": ws.Visibility("ray-traced", order=4, samples=9),
}


def make_scene(light, camera=None, method="directional"):
    """A body of each kind of reflectance and blockers, with numbers that no decimal holds."""
    ball, tile = ws.icosphere(0.5, 1), ws.plane(4.0, 2)
    bodies = (
        ws.Body(ball, albedo=(1 / 3, 0.1, 2 / 7), blockers=BALL, rotation=(1 / 3, 10, 20), translation=(-1, 1 / 7, 0)),
        ws.Body(ball, albedo=RANDOM.uniform(size=(ball.vertex_count, 3)), blockers=0, translation=(1, 0.6, 0)),
        ws.Body(tile, texture=RANDOM.uniform(size=(4, 6, 3)), blockers=7, scale=1.1, receivers="pixel"),
    )
    camera = camera or ws.Camera.look_at((0.1, 2, 4), (0, 1 / 3, 0), fov_y=33, size=(16, 12), near=0.02)
    return ws.Scene(bodies, light, camera, SETTINGS[method], supersampling=1)


@pytest.fixture
def load(tmp_path):
    def load_text(text):
        (tmp_path / "scene.toml").write_text(text)
        return ws.load_scene(tmp_path / "scene.toml")

    return load_text


@pytest.fixture
def refused(load):
    def refuse(text, *parts, error=ws.SceneError):
        with pytest.raises(error) as caught:
            load(text)
        for part in ("scene.toml: ", *parts):
            assert part in str(caught.value)

    return refuse


# ---------------------------------------------------------------------------------------------- round trip


@pytest.mark.parametrize(
    ("kind", "method"), [*((kind, "directional") for kind in LIGHTS), *(("sh", m) for m in SETTINGS)]
)
def test_a_scene_that_is_written_reads_back_bit_for_bit_and_renders_the_same(tmp_path, kind, method):
    scene = make_scene(LIGHTS[kind], method=method)
    files = write_scene(scene, tmp_path / "new" / "folder")
    assert sorted(files) == sorted((tmp_path / "new" / "folder").iterdir())
    assert files[0].name == "scene.toml"
    again = ws.load_scene(files[0])
    for name in ("intrinsics", "rotation", "translation", "width", "height", "near"):
        np.testing.assert_array_equal(getattr(again.camera, name), getattr(scene.camera, name))
    for field in fields(ws.Visibility):
        assert getattr(again.visibility, field.name) == getattr(scene.visibility, field.name)
    assert again.supersampling == scene.supersampling
    lights = [light.radiance if kind == "map" else light for light in (again.light, scene.light)]
    np.testing.assert_array_equal(*lights)
    for got, expected in zip(again.bodies, scene.bodies, strict=True):
        assert got.mesh.content_hash == expected.mesh.content_hash
        for name in ("rotation", "translation", "scale", "receivers", "texture"):
            np.testing.assert_array_equal(getattr(got, name), getattr(expected, name))
        if expected.texture is None:
            np.testing.assert_array_equal(got.albedo, expected.albedo)
    assert [body.blockers for body in again.bodies[1:]] == [0, 7]
    np.testing.assert_array_equal(again.bodies[0].blockers.centers, BALL.centers)
    np.testing.assert_array_equal(again.bodies[0].blockers.radii, BALL.radii)
    np.testing.assert_array_equal(ws.render(again), ws.render(scene))


def named(*names):
    return ws.Scene([ws.Body(ws.icosphere(1.0, 0), name=name) for name in names], ws.EnvironmentMap.constant(1.0))


def test_files_are_called_as_the_bodies_where_nothing_else_is(tmp_path):
    def stems(*names):
        return [path.stem for path in write_scene(named(*names), tmp_path / "-".join(names)) if path.suffix == ".obj"]

    assert stems("spot", "the-ground") == ["spot", "the-ground"]
    assert stems("Spot", "spot", "ball") == ["body_0", "body_1", "ball"]
    others = "light", "body_0", "a.b", "a b", "a_roughness", "a_emission"
    assert stems(*others) == [f"body_{number}" for number in range(6)]
    assert file_stems(named("a/b", "Target"), ["target"]) == ["body_0", "body_1"]


def test_files_that_were_in_a_folder_stay_as_they_are_but_those_of_a_scene_that_was_written(tmp_path):
    (tmp_path / "cow.obj").write_text("mine")
    for scene in (named("cow", "ball"), named("cow", "ball")):
        assert [path.name for path in write_scene(scene, tmp_path)[1:]] == ["body_0.obj", "ball.obj", "light.exr"]
        assert (tmp_path / "cow.obj").read_text() == "mine"


@pytest.mark.parametrize("bounces", [3, "all"])
def test_bounces_are_written(bounces, tmp_path):
    camera = ws.Camera.look_at((0, 0, 4), (0, 0, 0))
    scene = ws.Scene([ws.Body(ws.icosphere(1.0, 0))], LIGHTS["sh"], camera, bounces=bounces)
    assert ws.load_scene(write_scene(scene, tmp_path)[0]).bounces == bounces


def test_no_spheres_at_all_are_written_as_none(tmp_path):
    body = ws.Body(ws.icosphere(1.0, 0), blockers=ws.Spheres(np.zeros((0, 3)), np.zeros(0)))
    scene = ws.Scene((body,), LIGHTS["sh"], ws.Camera.look_at((0, 0, 4), (0, 0, 0), size=(4, 4)))
    assert ws.load_scene(write_scene(scene, tmp_path)[0]).bodies[0].blockers == 0


def test_other_programs_find_the_texture_of_a_body_that_is_written(tmp_path):
    import trimesh

    texture = RANDOM.uniform(size=(4, 6, 3))
    scene = ws.Scene(
        (ws.Body(ws.plane(1.0, 1), texture=texture),), LIGHTS["sh"], ws.Camera.look_at((0, 1, 4), (0, 0, 0))
    )
    write_scene(scene, tmp_path)
    mesh = trimesh.load(tmp_path / "plane.obj", force="mesh")
    drawn = np.asarray(mesh.visual.material.image)[..., :3]
    expected = ws.read_image(tmp_path / "plane.png")
    np.testing.assert_allclose(ws.read_image(tmp_path / "plane.exr"), texture.astype(np.float32))
    assert drawn.shape == expected.shape == texture.shape
    assert np.abs(expected - texture).max() < 0.006  # half a step of 8-bit sRGB where it is steepest


@pytest.mark.parametrize(
    "options",
    [
        {"directions": np.int64(64)},
        {"method": "log-sh", "order": np.int32(4)},
        {"method": "ray-traced", "samples": np.uint16(64)},
        {"softness": np.float32(0.5), "merging": np.float64(0.25)},
    ],
)
def test_numpy_numbers_are_written_as_numbers(tmp_path, options):
    camera = ws.Camera.look_at((0, 0, 4), (0, 0, 0), size=tuple(np.array([4, 6])))
    bodies = (ws.Body(ws.icosphere(1.0, 0), blockers=np.int64(0), scale=np.float32(0.1)),)
    scene = ws.Scene(bodies, LIGHTS["sh"], camera, ws.Visibility(**options), supersampling=np.int64(3))
    again = ws.load_scene(write_scene(scene, tmp_path)[0])
    assert asdict(again.visibility) == asdict(scene.visibility)
    assert (again.camera.width, again.camera.height, again.supersampling) == (4, 6, 3)
    assert again.bodies[0].scale == np.float32(0.1)


def test_a_mark_at_the_head_of_a_file_is_passed_over(load, tmp_path):
    """As editors on Windows write it; line ends of theirs, too."""
    scene = load(TABLES + "[visibility]\ndirections = 32\n")
    (path,) = tmp_path.glob("*.toml")
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    assert asdict(ws.load_scene(path).visibility) == asdict(scene.visibility)


def test_tables_read_back_as_they_were_written(tmp_path):
    path = tmp_path / "x.toml"
    written = {
        "name": 'a "quoted" \\ line\nand µ × 𝄞',
        "flags": [True, False],
        "none": [],
        "small": 1e-300,
        "large": 12345678901234567890.0,
        "third": 1 / 3,
        "infinite": [float("inf"), -float("inf")],
        "one": {"matrix": [[1.5, 2.0], [3.0, 4.0]], "count": 3},
        "several": [{"a": 1}, {"b": [1, 2]}],
    }
    toml_tables.write(path, written)
    assert toml_tables.read(path, "file") == written
    toml_tables.write(path, {"loss": float("nan")})
    assert np.isnan(toml_tables.read(path, "file")["loss"])


# ---------------------------------------------------------------------------------------------- "auto"

AUTO = '[visibility]\nmethod = "auto"\nerror = 0.9\n'


def test_a_method_that_is_left_open_is_chosen_by_who_renders(load):
    scene = load(AUTO + TABLES + "blockers = 0\n")
    assert (scene.visibility.method, scene.visibility.error) == ("auto", 0.9)
    assert ws.Renderer(scene).scene.visibility.method == "none"


def test_a_scene_whose_method_is_open_is_written_as_such(load, tmp_path):
    scene = load(AUTO + TABLES + "blockers = 0\n")
    again = ws.load_scene(write_scene(scene, tmp_path / "again")[0]).visibility
    assert (again.method, again.error) == ("auto", 0.9)


@pytest.mark.parametrize("value", ["0", "-0.1", "nan", '"small"', "true"])
def test_an_error_that_is_none_is_refused(refused, value):
    refused(f"[visibility]\nerror = {value}\n{TABLES}", "[visibility]", "error: got", "expected a")


# ---------------------------------------------------------------------------------------------- cameras


def pinhole(**changes):
    """The tables with a camera by intrinsics, some of its lines changed or left out."""
    lines = dict(line.split(" = ", 1) for line in PINHOLE.strip().splitlines()) | {"size": "[8, 6]"} | changes
    camera = "".join(f"{key} = {value}\n" for key, value in lines.items() if value is not None)
    return "[camera]\n" + camera + TABLES[TABLES.index("[light]") :]


def test_a_camera_by_intrinsics_is_opencvs(load):
    scene = load(pinhole(near="0.5", supersampling="3"))
    camera = scene.camera
    np.testing.assert_array_equal(camera.intrinsics, [[40, 0.5, 3.5], [0, 42, 2.5], [0, 0, 1]])
    np.testing.assert_array_equal(camera.rotation, np.diag([1.0, -1.0, -1.0]))
    np.testing.assert_array_equal(camera.translation, [0.1, 0.2, 4])
    assert (camera.width, camera.height, camera.near, scene.supersampling) == (8, 6, 0.5, 3)
    np.testing.assert_allclose(camera.project(np.zeros(3)), [(40 * 0.1 + 0.5 * 0.2) / 4 + 3.5, 42 * 0.2 / 4 + 2.5])


@pytest.mark.parametrize("key", ["eye", "target", "up", "fov_y"])
def test_a_camera_is_given_in_one_way_or_the_other(refused, key):
    value = "30" if key == "fov_y" else "[0, 1, 0]"
    refused(pinhole(**{key: value}), "[camera]", f"{key}: got it beside intrinsics", "expected either eye")


@pytest.mark.parametrize("key", ["intrinsics", "rotation", "translation", "size"])
def test_a_camera_by_intrinsics_needs_all_of_them(refused, key):
    refused(pinhole(**{key: None}), "[camera]", f"{key}: missing, expected")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("intrinsics", "[40, 40, 4, 3]"),
        ("intrinsics", "[[40, 0, 4], [0, 40, 3]]"),
        ("intrinsics", "[[40, 0, 4], [0, 40, 3], [0, 0, 2]]"),
        ("intrinsics", '[[40, 0, 4], [0, "f", 3], [0, 0, 1]]'),
        ("rotation", "[0, 30, 0]"),
        ("rotation", "[[1, 0, 0], [0, 1, 0], [0, 0, -1]]"),
        ("rotation", "[[1, 0, 0], [0, 1, 0], [0, 0, nan]]"),
        ("translation", "[0, 4]"),
        ("size", "[8, 6, 3]"),
        ("near", "0"),
    ],
)
def test_a_wrong_value_of_a_camera_by_intrinsics_is_refused(refused, key, value):
    refused(pinhole(**{key: value}), "[camera]", f"{key}: got", "expected")


def test_an_unknown_key_of_a_camera_names_the_nearest(refused):
    refused(pinhole(intrinsic="1"), "[camera]", "unknown key 'intrinsic'", "did you mean 'intrinsics'")


# ---------------------------------------------------------------------------------------------- spheres and colors


FRAMED = TABLES.replace("eye = [0, 1, 4]\ntarget = [0, 0, 0]", 'framing = "auto"')


def test_a_camera_can_be_left_to_frame_the_bodies(load):
    scene = load(FRAMED)
    expected = ws.Camera.framing(scene, size=(8, 6))
    np.testing.assert_array_equal(scene.camera.clip_matrix(), expected.clip_matrix())
    scene = load(
        FRAMED.replace("framing", "direction = [1, 1, 0]\nmargin = 0.5\nfov_y = 30\nsupersampling = 1\nframing")
    )
    expected = ws.Camera.framing(scene, direction=(1, 1, 0), margin=0.5, fov_y=30, size=(8, 6))
    np.testing.assert_array_equal(scene.camera.clip_matrix(), expected.clip_matrix())


@pytest.mark.parametrize(
    ("key", "parts"),
    [
        ("eye = [0, 1, 4]", ("[camera]: eye", "beside framing")),
        ("translation = [0, 1, 4]", ("[camera]: translation", "beside framing")),
        ("margin = 2", ("[camera]: margin: got 2",)),
    ],
)
def test_a_camera_that_frames_takes_no_place(refused, key, parts):
    refused(FRAMED.replace("framing", f"{key}\nframing"), *parts)


def test_an_image_of_another_size_is_framed_anew_or_has_the_same_view(load, tmp_path):
    framed = load(FRAMED)
    expected = ws.Camera.framing(framed, size=(16, 6))
    np.testing.assert_array_equal(
        ws.load_scene(tmp_path / "scene.toml", size=(16, 6)).camera.intrinsics, expected.intrinsics
    )
    scene = make_scene(np.ones((4, 3)))
    off_center = scene.camera.intrinsics + [[0, 0, 1.5], [0, 0, -1], [0, 0, 0]]
    scene = replace(scene, camera=replace(scene.camera, intrinsics=off_center))
    ws.write_scene(scene, tmp_path)
    camera = ws.load_scene(tmp_path / "scene.toml", size=(40, 24)).camera
    assert (camera.width, camera.height) == (40, 24)
    expected = [[2 * off_center[0, 0], 0, 20 + 2 * 1.5], [0, 2 * off_center[1, 1], 2 * off_center[1, 2]], [0, 0, 1]]
    np.testing.assert_allclose(camera.intrinsics, expected)


def test_framing_is_auto_or_left_out(refused):
    refused(FRAMED.replace('"auto"', '"fit"'), "[camera]: framing: got 'fit', expected one of 'auto'")
    for key in ("margin = 0.1", "direction = [1, 1, 1]"):
        message = f'[camera]: {key.split()[0]} goes with framing = "auto", in place of eye and target'
        refused(TABLES.replace("eye =", f"{key}\neye ="), message)


def test_a_body_in_a_file_stands_on_the_ground_where_its_translation_says(load):
    lines = "rotation = [0, 0, 30]\ntranslation = [1, 2, 3]\nscale = 2.0\n"
    (body,) = load(TABLES + lines + "on_ground = true").bodies
    (plain,) = load(TABLES + lines + "on_ground = false").bodies
    np.testing.assert_array_equal(plain.translation, (1, 2, 3))
    np.testing.assert_array_equal(body.translation, plain.on_ground((1, 2, 3)).translation)
    assert body.world_points()[:, 1].min() == pytest.approx(2) and body.scale == 2


def test_a_body_in_a_file_may_be_given_a_size_there(load, tmp_path):
    lines = "rotation = [0, 0, 30]\ntranslation = [1, 2, 3]\non_ground = {size = 3.0}\n"
    scene = load(TABLES + lines)
    plain = replace(scene.bodies[0], translation=(0, 0, 0), scale=1.0)
    standing = plain.on_ground((1, 2, 3), size=3.0)
    assert scene.bodies[0].scale == standing.scale != 1
    np.testing.assert_array_equal(scene.bodies[0].translation, standing.translation)
    ws.write_scene(scene, tmp_path / "written")
    written = ws.load_scene(tmp_path / "written" / "scene.toml").bodies[0]
    assert written.scale == standing.scale
    np.testing.assert_array_equal(written.translation, standing.translation)


def test_a_body_in_a_file_may_be_creased(load, refused, tmp_path):
    """Its colors are those of the file's vertices."""
    ws.Mesh(np.eye(4)[:, :3], [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]).write(tmp_path / "box.obj")
    np.save(tmp_path / "colors.npy", np.linspace(0, 1, 12, dtype=np.float32).reshape(4, 3))
    lines = 'mesh = "box.obj"\nalbedo = "colors.npy"\ncreased = '
    (body,) = load(TABLES[: TABLES.index("primitive")] + lines + "30").bodies
    assert body.mesh.vertex_count == 12
    np.testing.assert_array_equal(body.albedo, np.load(tmp_path / "colors.npy")[body.mesh.origins])
    refused(TABLES + "creased = 200", "creased: angle: got 200, expected degrees from 0 to 180")


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("on_ground = 1", "on_ground: got 1, expected true or false, or a table such as {size = 2.0}"),
        ("on_ground = {size = 0}", "on_ground: size: got 0, expected a positive number"),
        ("on_ground = {foot = [1, 0, 0]}", "on_ground: foot: got [1, 0, 0], expected it as translation"),
        ("on_ground = {sizes = 2}", "on_ground: unknown key 'sizes' (did you mean 'size'?); known keys are size"),
        ("scale = 2\non_ground = {size = 1}", "on_ground: size: got it beside the body's scale"),
    ],
)
def test_on_ground_is_true_or_false_or_a_size(refused, lines, message):
    refused(TABLES + lines, message)


def test_the_spheres_that_the_command_line_writes_can_be_named(load, tmp_path):
    np.savez(tmp_path / "ball.npz", centers=BALL.centers, radii=BALL.radii)
    (body,) = load(TABLES + 'spheres = "ball.npz"\n').bodies
    np.testing.assert_array_equal(body.blockers.centers, BALL.centers)
    np.testing.assert_array_equal(body.blockers.radii, BALL.radii)


def test_a_color_for_each_vertex_can_be_named(load, tmp_path):
    colors = RANDOM.uniform(size=(42, 3)).astype(np.float32)
    np.save(tmp_path / "colors.npy", colors)
    np.testing.assert_array_equal(load(TABLES + 'albedo = "colors.npy"\n').bodies[0].albedo, colors)


@pytest.mark.parametrize(
    ("lines", "parts"),
    [
        ('spheres = "good.npz"\nblockers = 3\n', ["expected either blockers or spheres"]),
        ("spheres = 3\n", ["spheres: got 3, expected a file name"]),
        ('spheres = "empty"\n', ["spheres: got", "empty", "expected an .npz file of centers and radii"]),
        ('spheres = "text"\n', ["spheres: got", "text", "expected an .npz file of centers and radii"]),
        ('spheres = "colors.npy"\n', ["spheres: got", "colors.npy", "expected an .npz file"]),
        ('spheres = "other.npz"\n', ["spheres: got", "other.npz", "centers", "expected an .npz file"]),
        ('spheres = "bad.npz"\n', ["radii: got -1.0"]),
        ('albedo = "red"\n', ["albedo: got 'red'", "a linear color such as (0.8, 0.1, 0.1)", "or an .npy file"]),
        ('albedo = "colors.npy"\n', ["albedo: got shape (5, 3), expected [3] or [42, 3]"]),
        ('albedo = "text.npy"\n', ["albedo: got", "text.npy", "expected an .npy file"]),
        ('albedo = "objects.npy"\n', ["albedo: got", "objects.npy", "expected an .npy file"]),
    ],
)
def test_a_file_of_spheres_or_colors_that_is_none_is_refused(refused, tmp_path, lines, parts):
    np.savez(tmp_path / "good.npz", centers=BALL.centers, radii=BALL.radii)
    np.savez(tmp_path / "bad.npz", centers=BALL.centers, radii=[1, 1, -1])
    np.savez(tmp_path / "other.npz", radii=BALL.radii)
    np.save(tmp_path / "colors.npy", np.ones((5, 3)))
    np.save(tmp_path / "objects.npy", np.array([print, 1], object), allow_pickle=True)
    (tmp_path / "empty").write_bytes(b"")
    for name in ("text", "text.npy"):
        (tmp_path / name).write_text("no numbers at all")
    refused(TABLES + lines, "1st [[body]]", *parts)


@pytest.mark.parametrize("line", ['spheres = "no.npz"', 'albedo = "no.npy"'])
def test_a_missing_file_of_spheres_or_colors_is_named(refused, line):
    refused(TABLES + line, "1st [[body]]", "no such file", error=FileNotFoundError)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            TABLES.replace("[[body]]", "[body]") + "[body]\n",
            "a table that comes several times has two brackets, [[body]]",
        ),
        (TABLES + "name = cow\n", 'text is in quotes, "…"'),
        (TABLES + "color = [1, 0, 0]\n", "unknown key 'color' (did you mean 'albedo'?)"),
        (TABLES + "foot = [1, 0, 0]\n", "unknown key 'foot' (did you mean 'translation'?)"),
        (TABLES + "height = 2\n", "unknown key 'height' (did you mean 'on_ground'?)"),
        (TABLES.replace("primitive =", "primitve ="), "unknown key 'primitve' (did you mean 'primitive'?)"),
        (TABLES.replace("eye =", "position ="), "unknown key 'position' (did you mean 'eye'?)"),
        (TABLES.replace("target =", "look_at ="), "unknown key 'look_at' (did you mean 'target'?)"),
        (
            TABLES.replace("eye = [0, 1, 4]\ntarget = [0, 0, 0]\n", ""),
            'eye: missing, expected eye and target, or framing = "auto"',
        ),
    ],
)
def test_a_newcomers_mistake_is_answered_with_what_to_write(refused, text, said):
    refused(text, said)


def test_a_mesh_in_place_of_a_scene_file_is_named(tmp_path):
    path = tmp_path / "cow.obj"
    ws.icosphere().write(path)
    with pytest.raises(ws.SceneError, match=r'cow.obj: got a mesh, expected a scene file, .* mesh = "cow.obj"'):
        ws.load_scene(path)
