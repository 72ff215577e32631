"""Bodies by name, wherever a number of one is taken."""

import dataclasses

import numpy as np
import pytest
import torch
import warp as wp

import warpshadow as ws
from warpshadow import inverse
from warpshadow.scene.files import SceneError
from warpshadow.torch import TorchRenderer

CAMERA = ws.Camera.look_at((0, 2, 4), (0, 0.5, 0), size=(8, 8))
BALL, GROUND = range(2)


def scene_of(*bodies: ws.Body) -> ws.Scene:
    return ws.Scene(bodies, ws.EnvironmentMap.constant(1.0, height=8), CAMERA, supersampling=1)


@pytest.fixture(scope="module")
def scene() -> ws.Scene:
    """A ball that is called as its mesh, and a ground with a name and a texture."""
    ball = ws.Body(ws.icosphere(0.5, 1), blockers=ws.Spheres([(0, 0.2, 0), (0, -0.2, 0)], [0.4, 0.4]))
    ground = ws.Body(ws.plane(3.0, 4), texture=np.full((2, 2, 3), 0.5), blockers=0, name="ground")
    return scene_of(ball, ground)


@pytest.fixture(scope="module")
def renderer(scene) -> TorchRenderer:
    return TorchRenderer(scene)


def test_a_body_is_called_as_its_meshs_file_unless_it_has_a_name(tmp_path):
    ws.icosphere(1.0, 0).write(tmp_path / "bunny.obj")
    path = tmp_path / "bunny.obj"
    assert ws.Body(path).name == "bunny" and ws.Body(path, name="rabbit").name == "rabbit"
    assert dataclasses.replace(ws.Body(path), scale=2).name == "bunny"


@pytest.mark.parametrize("body", [0, np.int64(0), "icosphere"])
def test_a_number_and_a_name_are_the_same_body(scene, body):
    number = scene.body_number(body)
    assert number == BALL and type(number) is int


def test_the_bodies_of_a_scene_are_a_tuple_in_which_names_are_found(scene):
    assert scene.bodies["icosphere"] is scene.bodies[BALL] is scene.bodies[-2]
    assert scene.bodies[:1] == (scene.bodies[BALL],) and len(scene.bodies) == 2
    with pytest.raises(ValueError, match=r"^body: got 'grund', expected one of 'icosphere', 'ground' \(did you mean"):
        scene.bodies["grund"]


def test_copies_of_a_body_may_share_the_name_of_its_mesh(scene):
    ball = scene.bodies[BALL]
    scene_of(ball, dataclasses.replace(ball, translation=(2, 0, 0)), dataclasses.replace(ball, mesh=ws.plane(1.0)))


@pytest.mark.parametrize("body", [-1, 2, True, 1.0, None, np.float64(0), b"ground", ("ground",)])
def test_what_is_neither_a_number_nor_a_name_is_refused(scene, body):
    with pytest.raises(ValueError, match="^body: got .*, expected the number of a body, from 0 to 1, or its name"):
        scene.body_number(body)


def test_an_unknown_name_is_refused_with_those_there_are_and_the_nearest(scene):
    message = r"^moving: got 'grund', expected one of 'icosphere', 'ground' \(did you mean 'ground'\?\)$"
    with pytest.raises(ValueError, match=message):
        scene.body_numbers(["grund"], "moving")


def test_bodies_of_one_mesh_need_names_only_where_they_are_called_by_them():
    mesh = ws.icosphere(0.5, 0)
    twins = scene_of(ws.Body(mesh), ws.Body(mesh), ws.Body(mesh, name="third"))
    assert twins.body_number("third") == 2
    with pytest.raises(ValueError, match=r"^body: got 'icosphere', as bodies \[0, 1\] are called, expected a number"):
        twins.body_number("icosphere")


def test_two_bodies_cannot_be_given_one_name():
    ball = ws.Body(ws.icosphere(0.5, 0), name="ball")
    with pytest.raises(ValueError, match=r"^bodies\[1\]: name: got 'ball', as another has"):
        scene_of(ball, ball)


@pytest.mark.parametrize("name", ["", 3, b"ball"])
def test_what_is_no_name_is_refused(name):
    with pytest.raises(ValueError, match="^name: got .*, expected a name"):
        ws.Body(ws.icosphere(0.5, 0), name=name)


# ---------------------------------------------------------------------------------------------- for each body


@pytest.mark.parametrize("given", [{"ground": 3}, {1: 3}, {np.int64(1): 3}, [None, 3], (None, 3)])
def test_what_is_given_for_bodies_is_a_list_of_all_or_a_mapping_of_some(scene, given):
    assert scene.per_body(given, "albedo") == [None, 3]
    assert scene.per_body(None, "albedo") == scene.per_body({}, "albedo") == [None, None]


@pytest.mark.parametrize("given", [np.ones(2), torch.ones(2, 3), "ab", 3, {0}])
def test_what_is_neither_is_refused(scene, given):
    with pytest.raises(ValueError, match="^albedo: got .*, expected a list of 2 items, one for each body"):
        scene.per_body(given, "albedo")
    with pytest.raises(ValueError, match="^albedo: got 1 items, expected 2, one for each body"):
        scene.per_body([None], "albedo")


def test_a_body_cannot_come_by_number_and_by_name(scene):
    with pytest.raises(ValueError, match="^albedo: got 'ground' beside the same body's number"):
        scene.per_body({1: 3, "ground": 4}, "albedo")
    with pytest.raises(ValueError, match="^albedo: got 'gruond', expected one of .*did you mean 'ground'"):
        scene.per_body({"gruond": 3}, "albedo")


def test_images_are_the_same_by_names_and_by_numbers(renderer):
    color, texture = torch.tensor([0.2, 0.5, 0.9]), torch.rand(3, 3, 3, generator=torch.Generator().manual_seed(0))
    by_number = renderer(albedo=[color, None], textures=[None, texture])
    assert torch.equal(renderer(albedo={"icosphere": color}, textures={"ground": texture}), by_number)
    assert not torch.equal(renderer(), by_number)
    array = wp.array([[tuple(color.tolist())]], dtype=wp.vec3, device="cpu")
    plain = ws.Renderer(renderer.scene)
    named = plain.draw(albedo={"icosphere": array}).numpy()
    np.testing.assert_array_equal(named, plain.draw(albedo=[array, None]).numpy())
    assert str(plain.explain(albedo={"icosphere": array})) == str(plain.explain(albedo=[array, None]))


def test_geometry_is_the_same_by_names_and_by_numbers(renderer):
    poses = renderer.scene_poses()
    assert renderer.placed(*poses, moving=["icosphere"]).moving == (BALL,)
    points = torch.tensor(renderer.scene.bodies[BALL].mesh.positions) * 1.5
    by_name, by_number = renderer.deformed("icosphere", points), renderer.deformed(BALL, points)
    assert by_name.moving == (BALL,) and torch.equal(by_name.positions, by_number.positions)
    nodes = renderer.deformation_graph("icosphere", count=1).node_positions
    assert nodes.shape == renderer.deformation_graph(BALL, count=1).node_positions.shape == (2,)
    for call in (renderer.deformed, renderer.deformation_graph):
        with pytest.raises(ValueError, match="^body: got 'ball', expected one of 'icosphere', 'ground'"):
            call("ball")
    with pytest.raises(ValueError, match="^moving: got 'icosphere', expected a list of bodies"):
        renderer.placed(*poses, moving="icosphere")


def test_texels_of_a_body_are_seen_by_its_name(scene):
    plain = ws.Renderer(scene)
    assert plain.seen_texels("ground").any()
    np.testing.assert_array_equal(plain.seen_texels("ground"), plain.seen_texels(GROUND))


# ---------------------------------------------------------------------------------------------- fits and files


def test_what_is_free_of_a_body_has_its_name_or_number(scene):
    target = inverse.Target(np.ones((8, 8, 3), np.float32))
    problem = inverse.Problem(scene, target, [inverse.Texture("ground"), inverse.Pose(body="icosphere")])
    assert [free.body for free in problem.free] == [GROUND, BALL]
    assert [free.name for free in problem.free] == ["texture[1]", "pose[0]"]
    assert problem.fingerprint() == inverse.Problem(scene, target, [inverse.Texture(1), inverse.Pose(0)]).fingerprint()
    with pytest.raises(ValueError, match=r"^free\[0\]: body: got 'grond', expected .*did you mean 'ground'"):
        inverse.Problem(scene, target, inverse.Texture("grond"))
    with pytest.raises(ValueError, match=r"^free: got albedo\[0\] twice"):
        inverse.Problem(scene, target, [inverse.Albedo("icosphere"), inverse.Albedo(0)])


SCENE = """
[camera]
eye = [0, 2, 4]
target = [0, 0, 0]
size = [8, 8]
[light]
sh = [[1, 1, 1], [0, 0, 0], [0, 0, 0], [0, 0, 0]]
[[body]]
primitive = "icosphere"
blockers = 0
name = "Ball №1"
[[body]]
primitive = "plane"
blockers = 0
"""


def test_scene_files_name_bodies(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(SCENE, encoding="utf-8")
    scene = ws.load_scene(path)
    assert [body.name for body in scene.bodies] == ["Ball №1", "plane"]
    again = ws.load_scene(ws.write_scene(scene, tmp_path / "again")[0])
    assert [body.name for body in again.bodies] == ["Ball №1", "plane"]
    path.write_text(SCENE.replace('"Ball №1"', "3"), encoding="utf-8")
    with pytest.raises(SceneError, match=r"1st \[\[body\]\]: name: got 3, expected a name"):
        ws.load_scene(path)


def test_bodies_of_one_mesh_are_written_without_names_that_would_be_one(tmp_path):
    body = ws.Body(ws.icosphere(0.5, 0), blockers=0)
    again = ws.load_scene(ws.write_scene(scene_of(body, body), tmp_path)[0])
    assert [body.name for body in again.bodies] == ["body_0", "body_1"]


def test_fit_files_name_bodies(tmp_path):
    from warpshadow.inverse.fit_file import FitFileError, load_fit

    (tmp_path / "scene.toml").write_text(SCENE, encoding="utf-8")
    ws.write_image(tmp_path / "seen.exr", np.ones((8, 8, 4), np.float32))
    text = 'scene = "scene.toml"\n[[target]]\nimage = "seen.exr"\n[[free.albedo]]\nbody = "plane"\n'
    path = tmp_path / "fit.toml"
    path.write_text(text, encoding="utf-8")
    (free,) = load_fit(path).problem.free
    assert free == inverse.Albedo(1)
    path.write_text(text.replace('"plane"', '"plain"'), encoding="utf-8")
    with pytest.raises(FitFileError, match=r"1st \[\[free.albedo\]\]: body: got 'plain'.*did you mean 'plane'"):
        load_fit(path)
