"""Scene files to begin with: that of a mesh, and that of a bunny where there is none."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import warpshadow as ws
from warpshadow.cli import app
from warpshadow.scene.starter import write_bunny, write_starter

SKY = ws.EnvironmentMap.constant(2.0, height=8)


def box() -> ws.Mesh:
    """A box whose faces share vertices, with many edges."""
    corners = np.indices((2, 2, 2)).reshape(3, 8).T
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return ws.Mesh(corners, [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))])


@pytest.mark.parametrize("mesh", [ws.icosphere(0.5, 1), box()], ids=["ball", "box"])
@pytest.mark.parametrize(("up", "light"), [("y", None), ("z", Path("sky.exr"))])
def test_it_reads_as_the_default_scene_of_the_mesh(tmp_path, monkeypatch, mesh, up, light):
    monkeypatch.chdir(tmp_path)
    mesh.write("a.obj")
    SKY.write("sky.exr")
    Path("scenes").mkdir()
    expected = ws.default_scene("a.obj", up=up, size=(40, 30), light=light)
    write_starter(Path("scenes/a.toml"), Path("a.obj"), expected, light=light)
    monkeypatch.chdir("/")
    scene = ws.load_scene(tmp_path / "scenes" / "a.toml")
    for body, other in zip(scene.bodies, expected.bodies, strict=True):
        np.testing.assert_allclose(body.world_points(), other.world_points(), atol=1e-9)
        np.testing.assert_array_equal(body.mesh.faces, other.mesh.faces)
        np.testing.assert_array_equal(body.albedo, other.albedo)
    np.testing.assert_allclose(scene.camera.translation, expected.camera.translation, atol=1e-9)
    assert (scene.camera.width, scene.camera.height, scene.bounces) == (40, 30, 0)
    np.testing.assert_array_equal(scene.light.radiance, expected.light.radiance)


def test_the_command_writes_it_and_says_how_to_go_on(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ws.icosphere(0.5, 1).write("a.obj")
    result = CliRunner().invoke(app, ["scene", "a.obj", "-o", "a.toml", "--up", "z", "--size", "20", "10"])
    assert result.exit_code == 0 and "a.toml: warpshadow view a.toml shows it" in result.stdout
    scene = ws.load_scene("a.toml")
    assert scene.bodies[0].rotation.tolist() == [-90, 0, 0] and scene.camera.width == 20
    again = CliRunner().invoke(app, ["scene", "a.obj", "-o", "a.toml"])  # it would be another, and the first is edited
    assert again.exit_code == 1 and ws.load_scene("a.toml").camera.width == 20


def test_the_camera_stands_elsewhere_and_the_light_is_turned(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ws.icosphere(0.5, 1).write("a.obj")
    result = CliRunner().invoke(app, ["scene", "a.obj", "--direction", "-1", "0.5", "0", "--light-rotation", "30"])
    assert result.exit_code == 0, result.output
    scene = ws.load_scene("scene.toml")
    expected = ws.default_scene("a.obj", direction=(-1, 0.5, 0), size=(512, 512))
    np.testing.assert_allclose(scene.camera.eye, expected.camera.eye, atol=1e-9)
    assert scene.camera.eye[0] < -2
    np.testing.assert_array_equal(scene.light.radiance, expected.light.rotated(30).radiance)


def test_without_a_mesh_there_is_a_bunny(tmp_path, monkeypatch):
    pytest.importorskip("pxr")
    monkeypatch.chdir(tmp_path)
    assert CliRunner().invoke(app, ["scene"]).exit_code == 0
    assert [body.name for body in ws.load_scene("scene.toml").bodies] == ["bunny", "infinite_ground"]
    assert write_bunny(Path()) == Path("bunny.obj")  # again
    ws.icosphere(0.5, 1).write("bunny.obj")
    with pytest.raises(FileExistsError, match="bunny.obj: got another file than Warp's bunny"):
        write_bunny(Path())


def test_a_sky_of_a_scene_file_is_that_of_python(tmp_path):
    text = "[camera]\nframing = 'auto'\n[[body]]\nprimitive = 'icosphere'\n[light]\n"
    (tmp_path / "a.toml").write_text(text + "sky = {sun_direction = [0, 1, 0], height = 16}\nscale = 2.0\n")
    expected = ws.synthetic_sky((0, 1, 0), height=16).scaled(2.0)
    np.testing.assert_array_equal(ws.load_scene(tmp_path / "a.toml").light.radiance, expected.radiance)
    (tmp_path / "a.toml").write_text(text + "sky = {height = 16}\nsun = {direction = [0, 1, 0], irradiance = 3}\n")
    expected = ws.synthetic_sky(height=16).with_sun((0, 1, 0), 3)
    np.testing.assert_array_equal(ws.load_scene(tmp_path / "a.toml").light.radiance, expected.radiance)
    (tmp_path / "a.toml").write_text(text + "sky = {}\nsun = {direction = [0, 1, 0]}\n")
    with pytest.raises(ws.SceneError, match=r"\[light\]: sun: irradiance: missing"):
        ws.load_scene(tmp_path / "a.toml")
    (tmp_path / "a.toml").write_text(text + "sky = {sun = [0, 1, 0]}\n")
    with pytest.raises(ws.SceneError, match=r"\[light\]: sky: unknown key 'sun'"):
        ws.load_scene(tmp_path / "a.toml")
