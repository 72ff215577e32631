"""The command line: what it writes, what it prints, and one clear line for each mistake."""

import csv
import dataclasses
import errno
import functools
import re
import subprocess
import sys
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import typer
import warp as wp
from typer.testing import CliRunner

import warpshadow as ws
from warpshadow.assets.image import exr_bytes
from warpshadow.cli import app
from warpshadow.maths import sh
from warpshadow.pipeline.receivers.choice_of_receivers import for_still
from warpshadow.scene import toml_tables
from warpshadow.scene.visibility import METHODS

PROGRAM = [sys.executable, "-c", "from warpshadow.cli import app; app(prog_name='warpshadow')"]
"""What the command that is installed runs."""

COMMANDS = ("render", "scene", "insert", "view", "tune", "fit", "dataset", "spheres", "envmap", "cache", "warmup")

SCENE = """
[camera]
eye = [0, 2, 4]
target = [0, 0.5, 0]
size = [16, 12]
[light]
envmap = "sky.exr"
[visibility]
directions = 32
samples = 64
[[body]]
primitive = "icosphere"
subdivisions = 1
translation = [0, 0.8, 0]
scale = 0.6
blockers = 0
[[body]]
primitive = "plane"
size = 4
segments = 8
"""


def run(*arguments: object):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def fails(*arguments: object, parts: tuple[str, ...], status: int = 1):
    """One line on stderr that holds all the parts, nothing on stdout, no traceback."""
    result = run(*arguments)
    assert result.exit_code == status, result.output
    assert isinstance(result.exception, SystemExit), result.exception
    assert "Traceback" not in result.output and not result.stdout
    for part in parts:
        assert part in result.stderr, f"{part!r} is not in {result.stderr!r}"
    if status == 1:
        assert result.stderr.startswith("error: ") and result.stderr.count("\n") == 1


@pytest.fixture
def scene(tmp_path):
    ws.synthetic_sky(height=16, sun_radius=12).write(tmp_path / "sky.exr")
    path = tmp_path / "scene.toml"
    path.write_text(SCENE)
    return path


# ---------------------------------------------------------------------------------------------- render


def test_render_writes_the_image_as_linear_rgba_float32(scene, tmp_path):
    output = tmp_path / "out.exr"
    result = run("render", scene, "-o", output)
    assert result.exit_code == 0, result.output
    assert re.search(r"out\.exr: directional, 16 × 12, \d+\.\d\d s", result.stdout)
    image = ws.read_image(output)
    assert image.shape == (12, 16, 4) and image.dtype == np.float32
    np.testing.assert_array_equal(image, ws.render(ws.load_scene(scene)))
    import OpenEXR

    with OpenEXR.File(str(output), separate_channels=True) as file:
        channels = file.channels()
        assert sorted(channels) == ["A", "B", "G", "R"]
        assert {channel.pixels.dtype for channel in channels.values()} == {np.dtype(np.float32)}


@pytest.mark.parametrize("method", ["directional", "log-sh", "none", "ray-traced"])
def test_the_method_can_be_changed(scene, tmp_path, method):
    result = run("render", scene, "-o", tmp_path / "out.exr", "--method", method)
    assert result.exit_code == 0 and f": {method}, " in result.stdout
    assert f'"{method}"' not in SCENE
    scene.write_text(SCENE.replace("[visibility]", f'[visibility]\nmethod = "{method}"'))
    np.testing.assert_array_equal(ws.read_image(tmp_path / "out.exr"), ws.render(ws.load_scene(scene)))


def test_the_number_of_samples_can_be_changed(scene, tmp_path):
    run("render", scene, "-o", tmp_path / "out.exr", "--method", "ray-traced", "--samples", 16)
    scene.write_text(SCENE.replace("samples = 64", 'samples = 16\nmethod = "ray-traced"'))
    np.testing.assert_array_equal(ws.read_image(tmp_path / "out.exr"), ws.render(ws.load_scene(scene)))


@pytest.mark.parametrize("exposure", [None, -1])
def test_render_also_writes_the_picture_that_python_writes(scene, tmp_path, exposure):
    options = () if exposure is None else ("--exposure", exposure)
    result = run("render", scene, "-o", tmp_path / "out.exr", "--png", tmp_path / "out.png", *options)
    picture = ws.Picture(ws.render(ws.load_scene(scene)), exposure=exposure)
    assert result.exit_code == 0 and f"exposure {picture.exposure:+.2f} stops" in result.stdout
    picture.write(tmp_path / "python.png")
    assert (tmp_path / "python.png").read_bytes() == (tmp_path / "out.png").read_bytes()


@pytest.mark.parametrize("name", ["out.png", "out.jpg"])
def test_the_output_may_be_a_picture(scene, tmp_path, name):
    result = run("render", scene, "-o", tmp_path / name, "--exposure", 1, "--background", "white")
    assert re.search(rf"{name}: directional, 16 × 12, \d+\.\d\d s, exposure \+1.00 stops\n$", result.stdout), (
        result.output
    )
    picture = ws.Picture(ws.render(ws.load_scene(scene)), exposure=1, background="white")
    ws.write_image(tmp_path / f"python_{name}", picture)
    assert (tmp_path / f"python_{name}").read_bytes() == (tmp_path / name).read_bytes()


# ---------------------------------------------------------------------------------------------- a mesh alone


@pytest.fixture
def cone(tmp_path):
    """A mesh that stands on z."""
    import trimesh

    path = tmp_path / "cone.ply"
    trimesh.creation.cone(0.5, 1.5, sections=8).export(path)
    return path


def test_a_mesh_is_rendered_in_place_of_a_scene(cone, tmp_path):
    result = run("render", cone, "-o", tmp_path / "x.exr", "--method", "none")
    assert result.exit_code == 0, result.output
    first, last = result.stdout.splitlines()
    assert first == f"{cone}: z is taken to be up (along y it is symmetric); --up y says otherwise"
    assert re.search(r"x.exr: none, 512 × 512, ", last)
    scene = ws.default_scene(cone, up="z", size=(512, 512))
    image = ws.render(dataclasses.replace(scene, visibility=ws.Visibility("none")))
    np.testing.assert_array_equal(ws.read_image(tmp_path / "x.exr"), image)


def test_the_axis_that_points_up_can_be_said(cone, tmp_path):
    for up in "yz":
        result = run("render", cone, "-o", tmp_path / f"{up}.exr", "--up", up, "--method", "none", "--bounces", 0)
        assert result.exit_code == 0 and "taken to be up" not in result.stdout
    one, other = (ws.read_image(tmp_path / f"{up}.exr") for up in "yz")
    assert np.abs(one - other).max() > 0.1


@pytest.mark.parametrize(("size", "expected"), [(("8",), (8, 8)), (("8x6",), (8, 6)), (("8", "6"), (8, 6))])
def test_a_size_is_one_number_or_two(cone, tmp_path, size, expected):
    result = run("render", cone, "--size", *size, "--method", "none", "-o", tmp_path / "x.exr")
    assert result.exit_code == 0, result.output
    assert ws.read_image(tmp_path / "x.exr").shape == (*expected[::-1], 4)
    fails("render", cone, "-o", "x.exr", "--size", "8xx", "6", parts=("expected width and height",), status=2)


@pytest.mark.parametrize("size", [(8,), (24, 12), (8, 12)])
def test_a_scene_files_image_may_have_another_size(scene, tmp_path, size):
    result = run("render", scene, "--size", *size, "--method", "none", "-o", tmp_path / "x.exr")
    assert result.exit_code == 0, result.output
    scene.write_text(SCENE.replace("size = [16, 12]", f"size = {[*size, size[-1]][:2]}"))
    image = ws.render(ws.load_scene(scene, method="none"))
    np.testing.assert_allclose(ws.read_image(tmp_path / "x.exr"), image, atol=1e-5)


def test_a_mesh_gets_its_albedo(cone, tmp_path):
    options = "--albedo", 0.8, 0.4, 0.2, "--size", 16
    result = run("render", cone, "-o", tmp_path / "x.exr", "--up", "z", "--method", "none", *options)
    assert result.exit_code == 0, result.output
    scene = ws.default_scene(ws.Body(cone, albedo=(0.8, 0.4, 0.2)), up="z", size=(16, 16))
    unshadowed = dataclasses.replace(scene, visibility=ws.Visibility("none"))
    np.testing.assert_array_equal(ws.read_image(tmp_path / "x.exr"), ws.render(unshadowed))
    assert run("scene", cone, "-o", tmp_path / "cone.toml", *options).exit_code == 0
    np.testing.assert_array_equal(ws.load_scene(tmp_path / "cone.toml").bodies[0].albedo, scene.bodies[0].albedo)
    fails("scene", cone, "-q", "-o", tmp_path / "cone.toml", parts=("cone.toml: got a file", "-o other.toml"))
    fails("scene", cone, "-q", "--albedo", 200, 100, 50, parts=("albedo: got values from 50.0 to 200.0",))


def test_the_camera_and_the_light_of_a_mesh_can_be_turned(cone, tmp_path):
    options = "--direction", -1, 0.5, 0, "--light-rotation", 90, "--method", "none", "--size", 16, 16
    result = run("render", cone, "-o", tmp_path / "x.exr", "--up", "z", *options)
    assert result.exit_code == 0, result.output
    scene = ws.default_scene(cone, up="z", size=(16, 16), direction=(-1, 0.5, 0))
    turned = dataclasses.replace(scene, light=scene.light.rotated(90), visibility=ws.Visibility("none"))
    np.testing.assert_array_equal(ws.read_image(tmp_path / "x.exr"), ws.render(turned))


def test_a_mesh_is_shown_in_place_of_a_scene(cone, monkeypatch):
    served = []

    class Served:
        url = "http://here"

        def open(self, browser): ...

        def wait(self): ...

    def serve(scene, **options):
        served.append((scene, options["path"]))
        return Served()

    monkeypatch.setattr("warpshadow.cli.scenes.serve", serve)
    monkeypatch.setattr("warpshadow.cli.scenes.os._exit", lambda status: None)
    result = run("view", cone, "--no-browser")
    assert result.exit_code == 0, result.output
    assert "z is taken to be up" in result.stdout
    ((scene, path),) = served
    assert path is None and [body.name for body in scene.bodies] == ["cone", "infinite_ground"]


def test_a_picture_without_its_option_gets_the_option(cone, tmp_path):
    """But not another option's value."""
    fails("render", cone, "a.png", parts=("a.png", "expected -o a.png"), status=2)
    fails("render", cone, "--size", 8, 8, "a.gif", parts=("expected -o a.gif",), status=2)
    fails("render", cone, "--light", "a.exr", parts=("Missing option", "--output"), status=2)


def test_files_that_are_neither_scenes_nor_meshes_are_refused(cone, scene, tmp_path):
    (tmp_path / "a.fbx").write_bytes(b"Kaydara")
    fails(
        "render", tmp_path / "a.fbx", "-o", tmp_path / "x.png", parts=("a.fbx: got extension '.fbx'", ".toml", ".obj")
    )
    fails("render", tmp_path / "gone.obj", "-o", tmp_path / "x.png", parts=("gone.obj",))
    (tmp_path / "cut.stl").write_bytes(bytes(80) + b"\x09\0\0\0" + bytes(60))
    parts = ("cut.stl", "the file is cut off: got 144 bytes", "9 triangles, which are 534")
    fails("render", tmp_path / "cut.stl", "-o", tmp_path / "x.png", parts=parts)
    fails("render", scene, "-o", tmp_path / "x.png", "--up", "z", parts=("--up: got z with", "expected a mesh"))
    options = "--direction", 1, 0, 0
    fails("render", scene, "-o", tmp_path / "x.png", *options, parts=("--direction: got 1.0 0.0 0.0 with", "[camera]"))
    options = "--light-rotation", 30
    fails("render", scene, "-o", tmp_path / "x.png", *options, parts=("--light-rotation: got 30", "[light] rotation"))
    fails("render", cone, "-o", tmp_path / "x.png", "--up", "x", parts=("--up",), status=2)


@pytest.mark.parametrize(
    ("name", "options", "is_said"),
    [("a.jpg", (), True), ("a.png", (), False), ("a.jpg", ("--background", "environment"), False)],
)
def test_a_picture_without_transparency_is_said_to_be_white_behind_the_bodies(scene, tmp_path, name, options, is_said):
    result = run("render", scene, "-o", tmp_path / name, "--method", "none", *options)
    remark = f"{name}: white behind the bodies, as .jpg has no transparency; --background environment shows the light"
    assert result.exit_code == 0 and (remark in result.stdout) == is_said


@pytest.mark.parametrize("background", ["environment", "#ff8800"])
def test_the_picture_has_a_background_and_a_tone(scene, tmp_path, background):
    options = "--png", tmp_path / "out.png", "--background", background, "--tone", "filmic"
    assert run("render", scene, "-o", tmp_path / "out.exr", *options).exit_code == 0
    loaded = ws.load_scene(scene)
    behind = loaded.background() if background == "environment" else background
    ws.Picture(ws.render(loaded), background=behind, tone="filmic").write(tmp_path / "python.png")
    assert (tmp_path / "python.png").read_bytes() == (tmp_path / "out.png").read_bytes()


def test_files_of_a_pattern_that_the_shell_has_expanded_are_many_fits(tmp_path):
    for name in ("a", "b"):
        (tmp_path / f"{name}.toml").write_text("x = 3")
    result = run("fit", tmp_path / "a.toml", tmp_path / "b.toml", "-o", tmp_path / "out", "--workers", 1)
    assert result.exit_code == 1 and "a failed: " in result.output and "b failed: " in result.output


def test_files_that_are_no_fits_are_refused_before_any_starts(scene, tmp_path):
    (tmp_path / "a.toml").write_text("x = 3")
    options = "-o", tmp_path / "out"
    named = f'{scene}: got a scene file, expected a fit file, which names it: scene = "{scene.name}"'
    fails("fit", scene, *options, parts=(named,))
    fails("fit", tmp_path / "a.toml", scene, *options, parts=(named,))
    fails("fit", tmp_path / "a.toml", tmp_path / "truth.png", *options, parts=("truth.png: got extension '.png'",))
    assert not (tmp_path / "out").exists()


def test_a_fit_in_the_place_of_a_scene_is_named(tmp_path):
    (tmp_path / "fit.toml").write_text('scene = "start.toml"\n[[target]]\nimage = "truth.png"\n[free]\n')
    named = "fit.toml: got a fit file, expected a scene file, such as the one that it names, start.toml"
    fails("render", tmp_path / "fit.toml", "-o", tmp_path / "out.png", parts=(named, "warpshadow fit fit.toml"))


def test_a_turntable_goes_around_at_one_exposure(scene, tmp_path):
    from PIL import Image, ImageSequence

    options = "--turntable", 4, "--background", "environment", "--fps", 5
    result = run("render", scene, "-o", tmp_path / "turn.gif", *options)
    assert result.exit_code == 0 and "turn.gif: 4 frames" in result.stdout
    with Image.open(tmp_path / "turn.gif") as file:
        assert file.info["duration"] == 200
        frames = np.stack([np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(file)]).astype(int)
    loaded = ws.load_scene(scene)
    first = ws.Picture(ws.render(loaded), background=loaded.background())
    camera = loaded.camera.turned(90, (0, 0.8, 0))  # about the ball
    second = dataclasses.replace(loaded, camera=camera)
    pictures = first, ws.Picture(ws.render(second), exposure=first.exposure, background=second.background())
    for frame, picture in zip(frames[:2], pictures, strict=True):
        assert np.abs(frame - picture.pixels).max() <= 2  # 256 colors for 192 pixels
    assert frames.shape == (4, 12, 16, 3) and np.abs(frames[1] - frames[0]).mean() > 3


@pytest.mark.parametrize("options", [(), ("--stills",)])
def test_frames_of_a_video_are_stills_where_that_is_asked_for(scene, tmp_path, monkeypatch, options):
    scene.write_text(SCENE.replace("directions = 32\n", ""))
    frames = []
    monkeypatch.setattr("warpshadow.cli.rendering.write_video", lambda path, pictures, fps: frames.extend(pictures))
    assert run("render", scene, "-o", tmp_path / "turn.gif", "--turntable", 4, *options).exit_code == 0
    loaded = ws.load_scene(scene)
    assert loaded.visibility.method is None
    camera = loaded.camera.around(loaded, 4)[1]
    still = ws.Picture(ws.render(dataclasses.replace(loaded, camera=camera)), exposure=frames[0].exposure)
    assert np.array_equal(frames[1].pixels, still.pixels) == bool(options)


def test_a_camera_path_is_a_video_through_its_keyframes(scene, tmp_path):
    from PIL import Image, ImageSequence

    keyframes = [ws.Keyframe(0, (0, 2, 4), (0, 0.5, 0)), ws.Keyframe(0.2, (4, 2, 0), (0, 0.5, 0))]
    ws.CameraPath(keyframes, fps=10).write(tmp_path / "path.toml")
    options = "--camera-path", tmp_path / "path.toml", "--background", "white"
    result = run("render", scene, "-o", tmp_path / "walk.gif", *options)
    assert result.exit_code == 0 and "walk.gif: 3 frames" in result.stdout
    with Image.open(tmp_path / "walk.gif") as file:
        assert file.info["duration"] == 100
        frames = [np.asarray(frame.convert("RGB")).astype(int) for frame in ImageSequence.Iterator(file)]
    loaded = ws.load_scene(scene)
    last = dataclasses.replace(loaded, camera=ws.Camera.look_at((4, 2, 0), (0, 0.5, 0), size=(16, 12)))
    first = ws.Picture(ws.render(loaded), background="white")
    pictures = first, ws.Picture(ws.render(last), exposure=first.exposure, background="white")
    for frame, picture in zip(frames[::2], pictures, strict=True):
        assert np.abs(frame - picture.pixels).max() <= 2  # 256 colors for 192 pixels


def test_render_also_writes_layers(scene, tmp_path):
    import OpenEXR

    result = run("render", scene, "-o", tmp_path / "out.exr", "--layers", "--png", tmp_path / "out.png")
    assert result.exit_code == 0, result.output
    layers = ws.Renderer(ws.load_scene(scene)).layers().channels()
    with OpenEXR.File(str(tmp_path / "out.exr"), separate_channels=True) as file:
        channels = file.channels()
        assert set(channels) == {*"RGBA", *layers}
        for name, layer in layers.items():
            np.testing.assert_array_equal(channels[name].pixels, layer)
    np.testing.assert_array_equal(ws.read_image(tmp_path / "out.exr"), ws.render(ws.load_scene(scene)))


@pytest.mark.parametrize(
    ("output", "options", "part"),
    [
        ("turn.exr", ("--turntable", 4), "got extension '.exr', expected .mp4 or .gif or .webp"),
        ("turn.gif", (), "videos take --turntable FRAMES or --camera-path FILE"),
        ("turn.gif", ("--turntable", 4, "--png", "out.png"), "--png: got it beside --turntable"),
        ("turn.gif", ("--turntable", 4, "--layers"), "--layers: got it beside --turntable"),
        ("turn.gif", ("--camera-path", "no.toml"), "no.toml: no such camera path"),
        ("turn.gif", ("--turntable", 4, "--fps", 60), "fps: got 60.0, expected 0.1 to 50 for .gif"),
        ("turn.exr", ("--stills",), "--stills: got it for an image, expected --turntable FRAMES or --camera-path FILE"),
        ("turn.exr", ("--fps", 12), "--fps: got 12 without --turntable, expected --turntable FRAMES with it"),
    ],
)
def test_a_turntable_is_a_video_and_a_video_a_turntable(scene, tmp_path, output, options, part):
    fails("render", scene, "-o", tmp_path / output, *options, parts=(part,))


def test_a_background_that_is_none_is_refused_before_the_work(scene, tmp_path):
    options = "--png", tmp_path / "out.png", "--background", "sky"
    fails("render", scene, "-o", tmp_path / "out.exr", *options, parts=("--background: got 'sky'", "such as 'white'"))
    assert not (tmp_path / "out.exr").exists()


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (("directions", "direction"), ["scene.toml: [visibility]", "'direction'", "did you mean 'directions'"]),
        (("eye = [0, 2, 4]", ""), ["[camera]", "eye: missing"]),
        (("sky.exr", "night.exr"), ["[light]", "envmap", "night.exr"]),
        (("scale = 0.6", "scale = -1"), ["1st [[body]]", "scale: got -1", "positive"]),
        (("[light]", "[light"), ["not valid TOML"]),
    ],
)
def test_a_mistake_in_a_scene_is_one_line_and_status_1(scene, tmp_path, change, parts):
    scene.write_text(SCENE.replace(*change))
    fails("render", scene, "-o", tmp_path / "out.exr", parts=parts)
    assert not (tmp_path / "out.exr").exists()


def test_a_missing_scene_is_one_line_and_status_1(tmp_path):
    fails("render", tmp_path / "no.toml", "-o", tmp_path / "out.exr", parts=("no.toml",))
    fails("render", tmp_path, "-o", tmp_path / "out.exr", parts=(str(tmp_path),))


def test_an_output_that_cannot_be_written_is_refused_before_the_work(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("warpshadow.scene.files.load_scene", lambda path: pytest.fail("the scene was read"))
    missing = tmp_path / "nowhere" / "out.exr"
    for name in ("out.bmp", "out"):
        parts = (name, f"got extension {Path(name).suffix!r}", "expected .exr or .png or .jpg or .jpeg")
        fails("render", scene, "-o", tmp_path / name, parts=parts)
    fails("render", scene, "-o", tmp_path / "a.gif", parts=("a.gif", "videos take --turntable FRAMES"))
    fails(
        "render", scene, "-o", tmp_path / "a.png", "--layers", parts=("--layers: got it with", "expected an .exr file")
    )
    fails("render", scene, "-o", missing, parts=("nowhere", "no such folder"))
    good = ("render", scene, "-o", tmp_path / "out.exr")
    fails(*good, "--png", tmp_path / "out.gif", parts=("out.gif", ".png or .jpg"))
    fails(*good, "--png", missing.with_suffix(".png"), parts=("nowhere", "no such folder"))
    (tmp_path / "folder.exr").mkdir()
    for folder in (tmp_path, tmp_path / "folder.exr"):
        fails("render", scene, "-o", folder, parts=(f"{folder}: got a folder, expected a file",))
    fails(*good, "--png", tmp_path, parts=(f"{tmp_path}: got a folder",))
    for stops in ("nan", "1e4", "-inf"):
        fails(*good, "--exposure", stops, parts=(f"--exposure: got {float(stops)!r}, expected -100 to 100 stops",))


@pytest.mark.parametrize("command", ["render", "fit", "spheres", "envmap"])
def test_a_folder_that_takes_no_files_is_refused_before_the_work(tmp_path, monkeypatch, command):
    """Before the input is even read: it is not there."""

    def refuse(*args, **options):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    name = {"spheres": "out.npz", "fit": "out"}.get(command, "out.exr")
    message = f"{tmp_path}: no file can be written in this folder (Permission denied)"
    fails(command, "missing.file", "-o", tmp_path / name, parts=(message,))


@pytest.mark.parametrize("name", ["gpu", "cuda:99", ""])
@pytest.mark.parametrize("command", ["render", "tune", "fit", "warmup"])
def test_an_unknown_device_names_the_known_ones(scene, tmp_path, command, name):
    arguments = {"warmup": (), "tune": (scene, "--error", 0.1)}.get(command, (scene, "-o", tmp_path / "out.exr"))
    fails(command, *arguments, "--device", name, parts=(f"device: got '{name}'", "expected one of", "cpu"))


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (("render", "scene.toml"), "--output"),
        (("render", "scene.toml", "-o", "x.exr", "--method", "rays"), "rays"),
        (("render", "scene.toml", "-o", "x.exr", "--method", "raytraced"), "(did you mean 'ray-traced'?)"),
        (("explain", "scene.toml"), "No such command 'explain': in Python, Renderer(scene).explain()"),
        (("render", "scene.toml", "-o", "x.exr", "--samples", "0"), "samples"),
        (("render", "scene.toml", "-o", "x.exr", "--colour", "red"), "--colour"),
        (("render", "cow.obj", "-o", "x.exr", "--width", "200"), "No such option: --width (write --size WIDTH HEIGHT)"),
        (("tune", "cow.obj", "--height=200"), "No such option: --height (write --size WIDTH HEIGHT)"),
        (
            ("render", "s.toml", "-o", "x.exr", "--spp", "64"),
            "No such option: --spp (write --samples COUNT, of --method",
        ),
        (("render", "scene.toml", "-o", "x.exr", "--bounces", "2.5"), "got '2.5', expected a whole number"),
        (("render", "scene.toml", "-o", "x.exr", "--bounces", "-1"), "got -1, expected a whole number from 0"),
        (("tune", "scene.toml", "--error", "0.1", "--bounces", "17"), "17, expected a whole number from 0 to 16"),
        (("envmap", "x.exr", "--order", "9"), "order"),
        (("rendre",), "rendre"),
    ],
)
def test_a_wrong_option_is_status_2_with_its_name(arguments, part):
    result = run(*arguments)
    assert result.exit_code == 2
    assert part in " ".join(re.sub(r"\x1b\[[0-9;]*m|│", "", result.output).split())


# ---------------------------------------------------------------------------------------------- tune


@pytest.fixture
def quick_tuning(monkeypatch):
    """Few settings, points and rays, so that a test takes no time."""
    from warpshadow.tuning import tune
    from warpshadow.tuning.point_sample import PointSample

    monkeypatch.setattr(tune, "PointSample", functools.partial(PointSample, count=60, direction_count=64))
    for name, values in (("DIRECTION_COUNTS", (16, 32)), ("ORDERS", (4,)), ("LOGS", ("eigen",))):
        monkeypatch.setattr(tune, name, values)


def lines_to_put_in(text):
    return text[text.index("[visibility]") :]


def test_tune_prints_what_it_tried_and_lines_that_the_scene_file_takes(scene, tmp_path, quick_tuning):
    result = run("tune", scene, "--error", "0.9")
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith(f"{scene}\nerror: of the shading at points of the image, relative, against rays\n")
    assert "image: time of a warm one of 16 × 12, 2 × 2 samples a pixel, after all bodies have moved" in result.stdout
    for method in ("none", "directional 16", "directional 32", "log-sh eigen 4"):
        assert re.search(rf"^[> ][* ]{method} .* auto .*\d\.\d\d% +\d+\.\d\d ms$", result.stdout, re.M)
    assert len(re.findall(r"^>", result.stdout, re.M)) == 1
    lines = lines_to_put_in(result.stdout).split("\n\n")[0]
    before, after = SCENE.split("[visibility]\ndirections = 32\n")
    scene.write_text(f"{before}{lines}\n{after}")
    method = re.search('method = "(.*)"', lines)[1]
    assert ws.load_scene(scene).visibility.method == method


def test_tune_takes_a_mesh(tmp_path, quick_tuning, monkeypatch):
    import trimesh

    from warpshadow.scene import blockers

    fit = SimpleNamespace(spheres=ws.Spheres([[0, 0, 0]], [1.0]))  # in place of 16 s
    monkeypatch.setattr(blockers, "fit_spheres", lambda *_, **__: fit)
    ball = ws.icosphere(1.0, 1)
    trimesh.Trimesh(ball.positions, ball.faces).export(tmp_path / "ball.ply")
    result = run("tune", tmp_path / "ball.ply", "--error", "0.9", "--up", "y", "--size", "16", "12")
    assert result.exit_code == 0, result.output
    assert "image: time of a warm one of 16 × 12" in result.stdout
    assert "[visibility]" in result.stdout


def test_tune_chooses_by_time_as_well(scene, quick_tuning):
    result = run("tune", scene, "--ms", "1e6")
    assert result.exit_code == 0, result.output
    errors = [float(error) for error in re.findall(r"(\d+\.\d+)% ", result.stdout)]
    (chosen,) = re.findall(r"^>.* (\d+\.\d+)% ", result.stdout, re.M)
    assert float(chosen) == min(errors)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("option", "value", "parts"),
    [
        ("--error", "1e-6", ("no setting reaches an error of 1e-06; nearest is ", ", with an error of ", "try more ")),
        ("--ms", "1e-6", ("no setting reaches 1e-06 ms; nearest is ", " ms; try a smaller image")),
    ],
)
def test_tune_says_what_comes_nearest_where_nothing_reaches_it(scene, quick_tuning, option, value, parts):
    result = run("tune", scene, option, value)
    assert result.exit_code == 1
    last = result.stderr.strip().splitlines()[-1]
    assert last.startswith("error: ") and all(part in last for part in parts)
    assert re.search(r"^>", result.stdout, re.M) and "[visibility]" not in result.stdout
    assert "> nearest" in result.stdout and "> chosen" not in result.stdout


def test_tune_points_to_fits_where_numbers_of_spheres_were_not_tried(scene, quick_tuning, monkeypatch):
    monkeypatch.setattr(ws.Tuning, "untried_counts", (256, 512))
    result = run("tune", scene, "--error", "1e-6")
    assert result.stderr.strip().endswith("; try --fit, which also fits 256, 512 spheres a body")


@pytest.mark.parametrize(("options", "got"), [((), "neither"), (("--error", 0.1, "--ms", 9), "both")])
def test_tune_takes_an_error_or_a_time(scene, options, got):
    fails("tune", scene, *options, parts=(f"--error, --ms: got {got}, expected one of them",))


@pytest.mark.parametrize(("option", "name"), [("--error", "error"), ("--ms", "milliseconds")])
def test_tune_refuses_what_is_no_error_or_time(scene, option, name):
    fails("tune", scene, option, -1, parts=(f"{name}: got -1.0, expected a positive number",))


def test_render_makes_the_choice_that_a_scene_leaves_to_it(scene, tmp_path, quick_tuning):
    scene.write_text(SCENE.replace("[visibility]", '[visibility]\nmethod = "auto"\nerror = 0.9'))
    result = run("render", scene, "-o", tmp_path / "out.exr")
    assert result.exit_code == 0, result.output
    assert "auto: none, receivers auto\n" in result.stdout and "out.exr: none, 16 × 12" in result.stdout
    np.testing.assert_array_equal(ws.read_image(tmp_path / "out.exr"), ws.render(ws.load_scene(scene)))


def test_a_method_that_is_given_takes_the_place_of_auto_before_anything_is_tried(scene, tmp_path, monkeypatch):
    from warpshadow.tuning import tune

    monkeypatch.setattr(tune, "PointSample", None)
    scene.write_text(SCENE.replace("[visibility]", '[visibility]\nmethod = "auto"'))
    result = run("render", scene, "-o", tmp_path / "out.exr", "--method", "directional")
    assert result.exit_code == 0, result.output


# ---------------------------------------------------------------------------------------------- fit

COLOR = (0.7, 0.4, 0.2)
FIT = """
scene = "scene.toml"
tolerance = 0
[[target]]
image = "photo.exr"
[[free.albedo]]
body = 0
[still]
method = "directional"
directions = 32
[[stage]]
iterations = 60
learning_rate = 0.05
"""
# From an image without noise; and from one of 8 bits, whose brightest hundredth saturates.
RECOVERED = 2e-3
RECOVERED_FROM_8_BITS = 0.02


@pytest.fixture
def fit_file(scene, tmp_path):
    """A fit that looks for the color of a ball, of which there is a rendered EXR and a PNG."""
    colored = f"blockers = 0\nalbedo = {list(COLOR)}"
    (tmp_path / "true.toml").write_text(SCENE.replace("blockers = 0", colored))
    image = ws.render(ws.load_scene(tmp_path / "true.toml"))
    ws.write_image(tmp_path / "photo.exr", image)
    ws.write_image(tmp_path / "photo.png", image[..., :3] / np.percentile(image[..., :3], 99))
    ws.write_image(tmp_path / "mask.png", image[..., 3:])
    path = tmp_path / "fit.toml"
    path.write_text(FIT)
    return path


def found(folder):
    return ws.load_scene(folder / "scene.toml")


def parameters(folder):
    with np.load(folder / "parameters.npz") as values:
        return {name: values[name] for name in values}


def assert_same(got, expected):
    assert got.keys() == expected.keys()
    for name, values in got.items():
        np.testing.assert_array_equal(values, expected[name])


@pytest.mark.slow
def test_fit_recovers_a_color_from_a_rendered_exr_and_says_what_it_wrote(fit_file, tmp_path):
    folder = tmp_path / "out"
    result = run("fit", fit_file, "-o", folder)
    assert result.exit_code == 0, result.output
    assert re.search(r"^(finished|converged) after \d+ iterations, [\d.]+ ms each$", result.stdout, re.M)
    assert re.search(r"^loss \d\S* before, \d\S* after$", result.stdout, re.M)
    (color,) = re.findall(r" albedo +\((.*), (.*), (.*)\)$", result.stdout, re.M)
    np.testing.assert_allclose([float(value) for value in color], COLOR, atol=RECOVERED)
    assert not result.stderr  # which is no terminal, so no bars
    (files,) = re.findall(rf"^{folder}: (.*)$", result.stdout, re.M)
    written = {path.name for path in folder.iterdir()}
    assert set(files.split(", ")) == written - {"checkpoint", "checkpoint.previous", "preview.png"}
    np.testing.assert_allclose(found(folder).bodies[0].albedo, COLOR, atol=RECOVERED)


@pytest.mark.slow
def test_fit_recovers_a_color_and_the_exposure_from_a_picture_of_8_bits_under_a_mask(fit_file, tmp_path):
    """Only what does not move in known light has a known color: the ground is known."""
    lines = 'image = "photo.png"\nmask = "mask.png"'
    text = FIT.replace('image = "photo.exr"', lines).replace("[[free", "[free]\nexposure = true\n[[free")
    fit_file.write_text(text.replace("iterations = 60", "iterations = 200"))
    result = run("fit", fit_file, "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    np.testing.assert_allclose(found(tmp_path / "out").bodies[0].albedo, COLOR, atol=RECOVERED_FROM_8_BITS)


@pytest.mark.slow
def test_a_fit_that_is_done_is_not_done_again(fit_file, tmp_path):
    folder = tmp_path / "out"
    first = run("fit", fit_file, "-o", folder)
    files = {path: path.read_bytes() for path in folder.iterdir()}
    (ending,) = re.findall(r"^(\w+ after \d+ iterations),", first.stdout)
    for _ in range(2):
        again = run("fit", fit_file, "-o", folder)
        assert again.exit_code == 0
        time_of_end = datetime.fromtimestamp((folder / "checkpoint").stat().st_mtime)
        remedy = f"remove {folder} or choose another folder by -o to start anew"
        assert again.stdout == f"already {ending} (on {time_of_end:%Y-%m-%d at %H:%M}); {remedy}\n"
    assert {path: path.read_bytes() for path in folder.iterdir()} == files


def test_a_fit_that_left_no_checkpoint_is_said_to_begin_anew(fit_file, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "preview.png").touch()
    result = run("fit", fit_file, "-o", tmp_path / "out")
    assert result.exit_code == 0 and result.stdout.startswith(f"no checkpoint in {tmp_path / 'out'} yet; ")


@pytest.mark.slow
def test_an_interrupted_fit_says_how_to_go_on_and_ends_where_it_would_have(fit_file, tmp_path, monkeypatch):
    from warpshadow.inverse import checkpoint

    save, saved = checkpoint.save, []

    def save_twice_and_interrupt(path, state):
        save(path, state)
        saved.append(path)
        if len(saved) == 2:
            raise KeyboardInterrupt

    run("fit", fit_file, "-o", tmp_path / "whole")
    with monkeypatch.context() as patched:
        patched.setattr(checkpoint, "save", save_twice_and_interrupt)
        result = run("fit", fit_file, "-o", tmp_path / "out", "--checkpoint-seconds", 0, "--no-preview")
    assert result.exit_code == 130
    last, state = result.stderr.strip().splitlines()[-1], tmp_path / "out" / "checkpoint"
    assert last == f"interrupted; the same command goes on from {state}"
    assert not (tmp_path / "out" / "scene.toml").exists()
    result = run("fit", fit_file, "-o", tmp_path / "out")
    assert result.exit_code == 0 and f"going on from iteration 2, of {state}\n" in result.stderr
    assert_same(parameters(tmp_path / "out"), parameters(tmp_path / "whole"))


def test_a_fit_that_is_interrupted_as_it_writes_its_results_writes_them_the_next_time(fit_file, tmp_path, monkeypatch):
    def interrupt(*args, **options):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("warpshadow.inverse.report.write_scene", interrupt)
        result = run("fit", fit_file, "-o", tmp_path / "out")
    assert result.exit_code == 130 and "the same command goes on" in result.stderr
    assert run("fit", fit_file, "-o", tmp_path / "out").exit_code == 0
    np.testing.assert_allclose(found(tmp_path / "out").bodies[0].albedo, COLOR, atol=RECOVERED)


@pytest.mark.slow
def test_a_fit_that_is_interrupted_before_a_checkpoint_says_so(fit_file, tmp_path, monkeypatch):
    def interrupt(*args, **options):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("warpshadow.inverse.fit_file.fit", interrupt)
        result = run("fit", fit_file, "-o", tmp_path / "out")
    assert result.exit_code == 130 and "interrupted before a checkpoint; the same command starts over" in result.stderr
    assert run("fit", fit_file, "-o", tmp_path / "out").exit_code == 0


def test_a_fit_that_diverges_is_status_3_and_keeps_what_it_had(fit_file, tmp_path):
    """Light so strong, after one step, that nothing can be computed with it."""
    text = FIT.replace("[[free.albedo]]\nbody = 0", "[free]\nlight = {order = 2}").replace("0.05", "1e30")
    fit_file.write_text(text + '[optimizer]\nname = "sgd"\n')
    for _ in range(2):  # when it is run again, too
        result = run("fit", fit_file, "-o", tmp_path / "out")
        assert result.exit_code == 3, result.output
        assert "Traceback" not in result.output and "diverged after " in result.stdout
        last = result.stderr.strip().splitlines()[-1]
        assert last.startswith("error: ") and last.endswith(f"{tmp_path / 'out'} has the best values before that")
    assert np.isfinite(found(tmp_path / "out").light).all()
    assert (tmp_path / "out" / "after.png").exists()


def test_a_fit_that_does_not_explain_its_images_is_status_4_and_its_summary_says_so(fit_file, tmp_path):
    """The image is three times as bright; another fit, of the right one, is explained."""
    ws.write_image(tmp_path / "bright.exr", 3 * ws.read_image(tmp_path / "photo.exr"))
    (tmp_path / "bright.toml").write_text(FIT.replace("photo", "bright").replace("iterations = 60", "iterations = 2"))
    (tmp_path / "right.toml").write_text(FIT.replace("iterations = 60", "iterations = 30"))
    folder = tmp_path / "bright"
    for _ in range(2):  # when it is run again, too
        result = run("fit", tmp_path / "bright.toml", "-o", folder)
        assert result.exit_code == 4, result.output
        last = result.stderr.strip().splitlines()[-1]
        assert last.startswith(f"error: {folder} does not explain its images: images are off by ")
    verdict = toml_tables.read(folder / "summary.toml", "summary")["verdict"]
    assert verdict["is_explained"] is False and verdict["image_error"] > 0.5
    result = run("fit", tmp_path / "right.toml", tmp_path / "bright.toml", "-o", tmp_path / "both", "--workers", 1)
    assert result.exit_code == 4 and "error: bright does not explain its images: images are off by" in result.stderr
    assert result.stdout.strip().endswith("; 1 of them do not explain their images")
    with (tmp_path / "both" / "table.csv").open() as table:
        assert [bool(row["doubt"]) for row in csv.DictReader(table)] == [False, True]
    assert toml_tables.read(tmp_path / "both" / "right" / "summary.toml", "summary")["verdict"]["is_explained"]


def test_a_fit_writes_only_into_a_folder_of_its_own(fit_file, tmp_path):
    """Least of all over the scene that it starts from."""
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    fails("fit", fit_file, "-o", tmp_path, parts=(str(tmp_path), "expected a new one or that of this fit"))
    fails("fit", fit_file, "-o", tmp_path / "no" / "out", parts=("no: no such folder",))
    fails("fit", fit_file, "-o", tmp_path / "sky.exr", parts=("sky.exr: got a file, expected a folder",))
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_another_fit_is_not_gone_on_with(fit_file, tmp_path):
    run("fit", fit_file, "-o", tmp_path / "out")
    fit_file.write_text(FIT.replace("0.05", "0.04"))
    result = run("fit", fit_file, "-o", tmp_path / "out")
    assert result.exit_code == 1
    assert (
        "checkpoint: got one of another fit (other stages" in result.stderr and "another folder by -o" in result.stderr
    )


def test_a_folder_that_another_fit_writes_is_left_to_it(fit_file, tmp_path):
    from warpshadow.inverse import checkpoint

    (tmp_path / "out").mkdir()
    with checkpoint.exclusive(tmp_path / "out" / "checkpoint"):
        result = run("fit", fit_file, "-o", tmp_path / "out")
    assert result.exit_code == 1 and result.stdout == ""
    assert "out/checkpoint: another fit is writing it" in result.stderr and "another folder by -o" in result.stderr
    assert run("fit", fit_file, "-o", tmp_path / "out").exit_code == 0


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (("iterations", "iteration"), ["fit.toml: 1st [[stage]]", "did you mean 'iterations'"]),
        (("photo.exr", "no.exr"), ["fit.toml: 1st [[target]]", "no.exr"]),
        (("body = 0", "body = 5"), ["fit.toml: 1st [[free.albedo]]", "body: got 5"]),
    ],
)
def test_a_mistake_in_a_fit_file_is_one_line_and_leaves_no_folder(fit_file, tmp_path, change, parts):
    fit_file.write_text(FIT.replace(*change))
    fails("fit", fit_file, "-o", tmp_path / "out", parts=parts)
    assert not (tmp_path / "out").exists()


# ---------------------------------------------------------------------------------------------- the others


def test_envmap_prints_statistics_and_writes_the_reconstruction(tmp_path):
    light = ws.EnvironmentMap(np.random.default_rng(0).uniform(size=(16, 32, 3)).astype(np.float32))
    light.write(tmp_path / "sky.exr")
    result = run("envmap", tmp_path / "sky.exr", "--order", 3)
    assert result.exit_code == 0
    for name in light.statistics():
        assert name.replace("_", " ") in result.stdout
    assert f"{light.statistics()['mean_radiance'][0]:.4g}" in result.stdout
    reconstruction = ws.read_image(tmp_path / "sky.sh3.exr")
    np.testing.assert_allclose(reconstruction, sh.reconstruct_map(light.sh(3), 16), atol=1e-5)


def test_envmap_refuses_or_repairs_bad_pixels(tmp_path):
    pixels = np.ones((8, 16, 3), np.float32)
    pixels[2, 3] = np.nan
    (tmp_path / "bad.exr").write_bytes(exr_bytes(dict(zip("RGB", np.moveaxis(pixels, 2, 0), strict=True))))
    fails("envmap", tmp_path / "bad.exr", parts=("bad.exr", "NaN", "row 2, column 3"))
    assert run("envmap", tmp_path / "bad.exr", "--sanitize", "neighbors").exit_code == 0
    fails("envmap", tmp_path / "no.exr", parts=("no.exr",))
    ws.write_image(tmp_path / "square.exr", np.ones((8, 8, 3), np.float32))
    fails("envmap", tmp_path / "square.exr", parts=("square.exr", "twice as wide as high"))


@pytest.mark.slow
def test_spheres_reports_writes_and_draws_the_fit(tmp_path, monkeypatch):
    """Of few steps: how good a fit is, test_spheres.py asks."""
    monkeypatch.setattr("warpshadow.spheres.fit_spheres", functools.partial(ws.fit_spheres, steps=100))
    monkeypatch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path / "fits"))
    ws.icosphere(1.0, 1).write(tmp_path / "ball.obj")
    picture, output = tmp_path / "fit.png", tmp_path / "fit.npz"
    result = run("spheres", tmp_path / "ball.obj", "--count", 1, "--picture", picture, "-o", output)
    assert result.exit_code == 0, result.output
    assert "42 vertices, 80 faces" in result.stdout
    error = float(re.search(r"error of the shadow there +(\S+)%", result.stdout)[1])
    assert error < 20 and "the shadow on the ground is whole, as its error is below 20%" in result.stdout
    with np.load(output) as fit:
        assert fit["centers"].shape == (1, 3) and fit["radii"].shape == (1,)
        assert np.abs(fit["centers"]).max() < 0.1 and abs(fit["radii"][0] - 1) < 0.15  # it is nearly a ball
    assert ws.read_image(picture).shape[2] >= 3


def test_spheres_says_where_a_shadow_has_holes(tmp_path, monkeypatch):
    monkeypatch.setattr("warpshadow.spheres.fit_spheres", functools.partial(ws.fit_spheres, steps=10))
    monkeypatch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path / "fits"))
    ws.icosphere(1.0, 1).transformed(scale=(1, 0.3, 3)).write(tmp_path / "long.obj")
    result = run("spheres", tmp_path / "long.obj", "--count", 1)
    assert result.exit_code == 0, result.output
    assert "the shadow on the ground has holes, as its error is above 20%; --count 2 may mend them" in result.stdout


def test_spheres_refuses_what_it_cannot_read_or_write(tmp_path):
    mesh = tmp_path / "ball.obj"
    fails("spheres", mesh, parts=("ball.obj",))
    ws.icosphere(1.0, 1).write(mesh)
    fails("spheres", mesh, "--picture", tmp_path / "x.txt", parts=("x.txt", "expected .png"))
    fails("spheres", mesh, "-o", tmp_path / "x.csv", parts=("x.csv", "expected .npz"))
    fails("spheres", mesh, "--device", "gpu", parts=("device: got 'gpu'",))
    fails("spheres", mesh, "--error", -1, parts=("error",))


@pytest.mark.slow
def test_the_cache_is_shown_and_cleared_of_what_is_kept_there_alone(tmp_path, monkeypatch):
    monkeypatch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path))
    ws.fit_spheres(ws.icosphere(subdivisions=0), 1, steps=1)
    (tmp_path / "spheres/mine.txt").write_text("mine")
    (tmp_path / "spheres/mine_too.npz").write_text("mine")
    (tmp_path / "mine.npz").write_text("mine")
    result = run("cache")
    assert result.stdout.splitlines()[0] == str(tmp_path)
    assert re.search(r"fits of spheres +1 files +0\.0 MB", result.stdout)
    assert re.search(rf"{wp.config.kernel_cache_dir}\n  compiled kernels.* [1-9]\d* files", result.stdout)
    assert f"{tmp_path}: cleared" in run("cache", "--clear").stdout
    assert re.search(r"fits of spheres +0 files", run("cache").stdout)
    assert sorted(path.name for path in tmp_path.rglob("mine*")) == ["mine.npz", "mine.txt", "mine_too.npz"]


def test_warmup_says_when_a_device_is_ready():
    result = run("warmup")
    assert result.exit_code == 0, result.output
    assert re.search(r"cpu: ready in \d+\.\d s", result.stdout)


def test_warmup_renders_as_stills_and_renderers_do(monkeypatch):
    rendered = []

    class Recorder:
        def __init__(self, scene, device):
            rendered.append(scene.visibility)

        def render(self):
            pass

    monkeypatch.setattr("warpshadow.pipeline.renderer.SceneRenderer", Recorder)
    assert run("warmup").exit_code == 0
    still = for_still(ws.Scene([ws.Body(ws.icosphere(1.0, 0))], np.ones((4, 3)))).visibility
    assert {visibility.method for visibility in rendered} == {*METHODS}
    assert (still.method, still.sampling) in [(visibility.method, visibility.sampling) for visibility in rendered]


def test_a_picture_of_spheres_needs_matplotlib_which_is_said_before_the_fit(tmp_path, monkeypatch):
    monkeypatch.setattr("warpshadow.spheres.fit_spheres", lambda *args, **options: pytest.fail("it was fitted"))
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    ws.icosphere(1.0, 1).write(tmp_path / "ball.obj")
    arguments = ("spheres", tmp_path / "ball.obj", "--picture", tmp_path / "ball.png")
    fails(*arguments, parts=('needs the package matplotlib: pip install "warpshadow[plot]"',))


# ---------------------------------------------------------------------------------------------- insert


@pytest.fixture
def catching(scene):
    scene.write_text(SCENE.replace("blockers = 0", "blockers = 1") + "shadow_catcher = true\n")
    ws.Spheres([(0, 0, 0)], [1.0]).write(scene.with_name("ball.npz"))
    scene.write_text(scene.read_text().replace("blockers = 1", 'spheres = "ball.npz"'))
    ws.write_image(scene.with_name("photo.png"), np.random.default_rng(0).uniform(size=(24, 32, 3)))
    return scene


@pytest.mark.parametrize("name", ["out.png", "out.jpg", "out.exr"])
def test_insert_writes_what_python_makes(catching, tmp_path, name):
    result = run("insert", catching, "--into", tmp_path / "photo.png", "-o", tmp_path / name, "--exposure", -0.5)
    assert result.exit_code == 0, result.output
    assert re.search(rf"{name}: 32 × 24, \d+\.\d\d s", result.stdout)
    image = ws.insert(ws.load_scene(catching), tmp_path / "photo.png", exposure=-0.5)
    ws.write_image(tmp_path / f"python_{name}", image)
    assert (tmp_path / f"python_{name}").read_bytes() == (tmp_path / name).read_bytes()
    photograph = ws.read_image(tmp_path / "photo.png")
    darker = (image < 0.9 * photograph).all(axis=2)
    assert 0.05 < darker.mean() < 0.8


def test_render_shows_the_shadow_alone_of_a_catcher(catching, tmp_path):
    result = run("render", catching, "-o", tmp_path / "out.exr", "--png", tmp_path / "out.png", "--background", "white")
    assert result.exit_code == 0, result.output
    image = ws.read_image(tmp_path / "out.exr")
    np.testing.assert_array_equal(image, ws.render(ws.load_scene(catching)))
    ball = ws.Renderer(ws.load_scene(catching)).layers().masks[0]
    assert not image[ball == 0][:, :3].any() and image[ball == 0][:, 3].max() > 0.3


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (("--into", "tall.png", "-o", "out.png"), "photograph: got 24 × 32 pixels, expected the proportions"),
        (("--into", "no.png", "-o", "out.png"), "photograph: no such file"),
        (("--into", "scene.toml", "-o", "out.png"), "photograph: "),
        (("--into", "photo.png", "-o", "out.gif"), "got extension '.gif', expected .exr or .png"),
        (("--into", "photo.png", "-o", "no/out.png"), "no"),
    ],
)
def test_what_cannot_be_inserted_is_one_line(catching, tmp_path, monkeypatch, arguments, part):
    monkeypatch.chdir(tmp_path)
    ws.write_image("tall.png", np.zeros((32, 24, 3), np.float32))
    fails("insert", catching, *arguments, parts=(part,))


# ---------------------------------------------------------------------------------------------- a full disk


@pytest.fixture
def full_disk():
    """Files can have 512 bytes at most, once the fixture's value is called."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (512, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("name", ["out.exr", "out.png"])
def test_a_full_disk_is_one_line_and_leaves_nothing_behind(scene, tmp_path, full_disk, monkeypatch, name):
    """Of the image or of the picture, which is the second file."""
    scene.write_text(SCENE.replace("[16, 12]", "[64, 48]"))
    files_before = {path.name for path in tmp_path.iterdir()}
    write = ws.write_image

    def write_with_the_disk_full(path, pixels, **layers):
        if path.name == name:
            full_disk()
        write(path, pixels, **layers)

    monkeypatch.setattr("warpshadow.assets.image.write_image", write_with_the_disk_full)
    result = run("render", scene, "-o", tmp_path / "out.exr", "--png", tmp_path / "out.png")
    assert result.exit_code == 1 and isinstance(result.exception, SystemExit)
    assert result.stderr.startswith("error: ") and result.stderr.count("\n") == 1
    assert "File too large" in result.stderr and str(tmp_path / name) in result.stderr
    assert {path.name for path in tmp_path.iterdir()} - files_before == {"out.exr"} - {name}


@pytest.mark.slow
def test_spheres_on_a_full_disk_leave_no_file(tmp_path, monkeypatch):
    """Neither the fit that is asked for nor the one that is to be kept: of that, there is a warning."""
    monkeypatch.setattr("warpshadow.spheres.fit_spheres", functools.partial(ws.fit_spheres, steps=100))
    monkeypatch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path / "fits"))
    ws.icosphere(1.0, 1).write(tmp_path / "ball.obj")

    def savez_to_a_full_disk(path, **arrays):
        Path(path).write_bytes(b"PK")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "savez", savez_to_a_full_disk)
    result = run("spheres", tmp_path / "ball.obj", "--count", 1, "-o", tmp_path / "fit.npz")
    assert result.exit_code == 1 and isinstance(result.exception, SystemExit)
    *_, warning, error = result.stderr.strip().splitlines()
    assert "the fit could not be cached" in warning and "No space left on device" in warning
    assert error == f"error: [Errno {errno.ENOSPC}] No space left on device: '{tmp_path / 'fit.npz'}'"
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["ball.obj"]


# ---------------------------------------------------------------------------------------------- help


def test_every_command_can_be_quiet(scene, tmp_path, fit_file):
    for command in typer.main.get_command(app).commands.values():
        assert "--quiet" in {option for parameter in command.params for option in parameter.opts}
    for arguments in (
        ("render", scene, "-o", tmp_path / "out.exr", "--png", tmp_path / "out.png"),
        ("fit", fit_file, "-o", tmp_path / "out"),
    ):
        result = run(*arguments, "--quiet")
        assert (result.exit_code, result.output) == (0, "")
    result = run("envmap", tmp_path / "sky.exr", "--order", 2, "-q")
    assert "width" in result.stdout and "reconstruction" not in result.stdout
    fails("render", tmp_path / "no.toml", "-o", tmp_path / "out.exr", "-q", parts=("no.toml",))


@pytest.mark.parametrize("command", ["render", "view"])
def test_an_interrupt_is_one_line_and_status_130(scene, tmp_path, monkeypatch, command):
    def interrupt(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("warpshadow.scene.files.load_scene", interrupt)
    result = run(command, scene, *(("-o", tmp_path / "out.exr") if command == "render" else ()))
    assert (result.exit_code, result.stdout, result.stderr) == (130, "", "interrupted\n")


def test_an_interrupt_says_how_much_of_a_fit_is_kept(scene, tmp_path, monkeypatch):
    def interrupt(*args):
        raise KeyboardInterrupt

    scene.write_text(SCENE.replace("blockers = 0", "blockers = 2"))
    monkeypatch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr("warpshadow.spheres.fit.measure", interrupt)
    result = run("render", scene, "-o", tmp_path / "out.exr")
    kept = "320 of 320 steps of the fit are cached, and the next call goes on from there"
    assert (result.exit_code, result.stdout, result.stderr) == (130, "", f"interrupted; {kept}\n")


def test_the_version_is_printed():
    result = run("--version")
    assert result.exit_code == 0 and result.stdout == f"warpshadow {ws.__version__}\n"


def test_every_command_and_every_option_has_help():
    group = typer.main.get_command(app)
    assert sorted(group.commands) == sorted(COMMANDS)
    for command in group.commands.values():
        assert command.help
        for parameter in command.params:
            assert parameter.name == "help" or parameter.help, f"{command.name} {parameter.name}"


@pytest.mark.slow
def test_the_command_runs_as_a_program(tmp_path):
    """A process of its own: help and a mistake, without a traceback and without Warp's messages."""
    result = subprocess.run([*PROGRAM, "--help"], capture_output=True, text=True, timeout=300)
    assert result.returncode == 0
    for command in COMMANDS:
        assert command in result.stdout
    missing = [*PROGRAM, "render", str(tmp_path / "no.toml"), "-o", str(tmp_path / "x.exr")]
    result = subprocess.run(missing, capture_output=True, text=True, timeout=300)
    assert result.returncode == 1
    assert result.stdout == "" and result.stderr.startswith("error: ") and "no.toml" in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.slow
def test_the_package_is_the_command_too():
    result = subprocess.run(
        [sys.executable, "-m", "warpshadow", "--version"], capture_output=True, text=True, timeout=300
    )
    assert (result.returncode, result.stdout) == (0, f"warpshadow {ws.__version__}\n")
