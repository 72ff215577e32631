"""Scenes of one mesh: which way is up, and what is around it."""

import functools

import numpy as np
import pytest
import trimesh
import warp.examples

import warpshadow as ws
from demos import shapes
from warpshadow.cli.mesh_options import NO_OPTIONS, load
from warpshadow.scene.mesh_scene import guess_up

TO_Z_UP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
ASSETS = warp.examples.get_asset_directory()
MADE = [
    "round_table",
    "chair",
    "fence",
    "bookshelf",
    "cage",
    "bowl",
    "cup",
    "bottle",
    "vase",
    "stairs",
    "spiral_stairs",
    "bracket",
    "tent",
    "wheel",
    "knot",
]
MADE_OF_PARTS = {
    "tree": lambda: shapes.tree()[0],
    "A": lambda: shapes.letter("A"),
    "W": lambda: shapes.letter("W"),
    "cone": lambda: shapes.joined("cone", shapes.cone(0.5, 1.5)),
    "box": lambda: shapes.joined("box", shapes.box((1, 2, 3))),
    "ball": lambda: ws.icosphere(1.0, 3),
}
MESHES = {
    **{name: getattr(shapes, name) for name in MADE},
    **MADE_OF_PARTS,
    **{name: functools.partial(ws.load_mesh, f"{ASSETS}/{name}.usd") for name in ("bear", "bunny", "rocks")},
}
MISTAKEN = {"knot"}
"""That stand firmer on another side."""
UNDECIDED = {"fence", "bookshelf", "spiral_stairs", "wheel", "tree", "box", "ball"}
"""Turned to z."""


@pytest.mark.filterwarnings("ignore:.*duplicate faces")
@pytest.mark.parametrize("name", MESHES)
def test_the_axis_that_points_up_is_guessed_by_the_shape(name):
    mesh = MESHES[name]()
    turned = mesh.transformed(rotation=TO_Z_UP)
    assert (guess_up(mesh).axis == "y") == (name not in MISTAKEN)
    assert (guess_up(turned).axis == "z") == (name not in MISTAKEN | UNDECIDED)
    if name in UNDECIDED:
        assert guess_up(turned).reason == "its shape does not say"
        assert guess_up(turned, ".stl") == ("z", "as .stl files often have it")
    assert guess_up(turned, ".glb") == ("y", "as .glb files have it")


def test_a_sheet_may_lie_or_stand_so_its_edges_are_no_base():
    sheet = shapes.sheet("sheet", lambda u, v: (u, 0.12 * np.sin(7 * u) * np.cos(4 * v), v), 20, 20)
    for mesh in (sheet, sheet.transformed(rotation=TO_Z_UP)):
        assert guess_up(mesh) == ("y", "its shape does not say")


def test_a_guess_is_the_same_for_any_size_and_place():
    mesh = MESHES["chair"]().transformed(rotation=TO_Z_UP)
    for scale in (1e-3, 1e3):
        assert guess_up(mesh.transformed(scale=scale, translation=(3, -2, 7))) == guess_up(mesh)


@pytest.mark.parametrize("positions", [[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 0, 0], [1, 1, 1], [1, 1, 1]]])
def test_a_mesh_without_volume_has_y_up(positions):
    assert guess_up(ws.Mesh(positions, [[0, 1, 2]])).axis == "y"


def test_a_mesh_stands_on_the_ground_upright_and_is_framed():
    chair = MESHES["chair"]()
    plain, turned = (
        ws.default_scene(mesh, up=up)
        for mesh, up in ((chair, "y"), (chair.transformed(rotation=TO_Z_UP, scale=40, translation=(9, 9, 9)), "z"))
    )
    np.testing.assert_allclose(plain.bodies[0].world_points(), turned.bodies[0].world_points(), atol=1e-5)
    points = turned.bodies[0].world_points()
    assert points[:, 1].min() == pytest.approx(0, abs=1e-6) and np.ptp(points, axis=0).max() == pytest.approx(2)
    pixels = turned.camera.project(points)
    assert pixels.min() >= 0 and pixels.max() <= 256


def test_a_mesh_stands_as_the_command_has_it_and_a_warning_says_that_z_is_up(tmp_path):
    chair = MESHES["chair"]()
    assert ws.default_scene(chair).bodies[0].rotation[0] == 0  # and no warning
    chair.transformed(rotation=TO_Z_UP).write(tmp_path / "chair.obj")
    trimesh.creation.icosphere().export(tmp_path / "ball.stl")
    with pytest.warns(UserWarning, match=r"chair: z is taken to be up \(it stands firmer than on y\); up='y' says"):
        turned = ws.default_scene(tmp_path / "chair.obj")
    with pytest.warns(UserWarning, match=r"ball: z is taken to be up \(as .stl files often have it\)"):
        ball = ws.default_scene(tmp_path / "ball.stl")
    assert turned.bodies[0].rotation[0] == ball.bodies[0].rotation[0] == -90
    assert load(tmp_path / "chair.obj", NO_OPTIONS, is_quiet=True).bodies[0].rotation[0] == -90
    assert ws.default_scene(tmp_path / "chair.obj", up="z").bodies[0].rotation[0] == -90


def test_sharp_edges_are_parted_and_a_body_keeps_its_color():
    box = shapes.joined("box", shapes.box((1, 1, 1)))
    edges = ws.Mesh(*_shared(box))
    assert edges.rounds_edges
    scene = ws.default_scene(ws.Body(edges, albedo=(0.1, 0.2, 0.3)))
    assert not scene.bodies[0].mesh.rounds_edges
    np.testing.assert_allclose(scene.bodies[0].albedo, (0.1, 0.2, 0.3))


def _shared(mesh):
    positions, places = np.unique(mesh.positions, axis=0, return_inverse=True)
    return positions, places.reshape(-1)[mesh.faces]


def test_default_scene_names_the_argument_it_refuses(tmp_path):
    with pytest.raises(ValueError, match="^up: got 'x', expected one of 'y', 'z', 'guess'"):
        ws.default_scene(ws.icosphere(), up="x")
    with pytest.raises(FileNotFoundError, match="^mesh: no such file"):
        ws.default_scene(tmp_path / "no.obj")


def test_a_mesh_may_have_a_light_and_a_size_of_its_own(tmp_path):
    light = ws.EnvironmentMap(np.ones((2, 4, 3)))
    scene = ws.default_scene(ws.Body(ws.icosphere()), light=light, size=(20, 10))
    assert scene.light is light and (scene.camera.width, scene.camera.height) == (20, 10)
