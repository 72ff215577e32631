"""The first mistakes of everybody get an answer that says what to write."""

import copy
import dataclasses
import inspect
import warnings

import pytest
import torch

import warpshadow as ws
from warpshadow import inverse
from warpshadow.torch import MixedRenderer, TorchRenderer, rotation_matrices

BALL = ws.Body(ws.icosphere(1.0, 0))
SKY = ws.EnvironmentMap.constant(1.0)
SCENE = ws.Scene([BALL], SKY, ws.Camera.framing(BALL, size=(8, 8)), ws.Visibility("none"))
MIXED = MixedRenderer([TorchRenderer(SCENE)])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ws.Scene([BALL]), r"Scene: missing a required argument: 'light' \(write .*synthetic_sky\(\)"),
        (lambda: ws.Scene(), "Scene: missing a required argument: 'bodies'; its arguments are bodies, light, camera"),
        (lambda: ws.render(SCENE, SCENE.camera), r"render: too many positional arguments \(write Scene\(…, camera="),
        (lambda: ws.render(SCENE, camera=SCENE.camera), r"render: unknown argument 'camera' \(write Scene\(…, camera="),
        (lambda: ws.Renderer(SCENE, camera=SCENE.camera), r"unknown argument 'camera' \(write cameras=\[camera\]"),
        (lambda: ws.synthetic_sky(sun=(0, 1, 0)), r"synthetic_sky: unknown argument 'sun' \(write sun_direction="),
        (lambda: ws.synthetic_sky((0, 1, 0), 3.0), "too many positional arguments; .* are sun_direction, sun_strength"),
        (
            lambda: ws.Renderer(SCENE).render(cameras=[SCENE.camera]),
            r"unknown argument 'cameras' \(write renderer.with_cameras\(",
        ),
        (lambda: TorchRenderer(SCENE)(cameras=[SCENE.camera]), r"\(write TorchRenderer\(.*clip_matrices="),
        (lambda: TorchRenderer(SCENE)(vertices=None), r"\(write geometry=renderer.placed\(.*renderer.deformed\("),
        (lambda: ws.Body(BALL.mesh, size=2), r"Body: unknown argument 'size' \(write Body\(…\).on_ground\(size=…\)\)"),
        (
            lambda: ws.render(SCENE, samples=16),
            r"\(write Scene\(…, visibility=Visibility\('ray-traced', samples=…\)\)\)",
        ),
        (lambda: ws.render(SCENE, spp=16), r"\(write Scene\(…, visibility=Visibility\('ray-traced', samples=…\)\)\)"),
        (lambda: ws.Visibility("ray-traced", spp=16), r"Visibility: unknown argument 'spp' \(write samples\)"),
        (lambda: ws.Picture([[1.0]], gamma=2.2), r"Picture: unknown argument 'gamma' \(write exposure=… in stops"),
        (lambda: ws.Renderer(SCENE, softness=1.0), r"\(write Scene\(…, visibility=Visibility\(…\)\)\)"),
        (lambda: TorchRenderer(SCENE)(emision=None), r"unknown argument 'emision' \(did you mean 'emission'\?\)"),
        (lambda: MIXED([0], emision=None), r"MixedRenderer.forward: unknown .* \(did you mean 'emission'\?\)"),
        (lambda: MIXED([0], cameras=None), r"unknown argument 'cameras' \(write clip_matrices=renderer.clip_matrices"),
        (lambda: ws.Renderer(SCENE).draw(emision=None), r"draw: unknown .* \(did you mean 'emission'\?\)"),
        (lambda: inverse.fit(None, stage="pose"), r"fit: unknown argument 'stage' \(did you mean 'stages'\?\)"),
        (lambda: inverse.Problem(SCENE, target=None), r"Problem: .* 'target' \(did you mean 'targets'\?\)"),
        (lambda: ws.Body(), "Body: missing a required argument: 'mesh'"),
        (lambda: inverse.Sun((0, 1, 0), intensity=3), r"Sun: unknown argument 'intensity' \(write irradiance\)"),
        (lambda: inverse.Sun((0, 1, 0), 3, radius=2), r"unknown .* \(write angular_radius, in degrees\)"),
        (lambda: inverse.Sun((0, 1, 0)), "missing a required argument: 'irradiance'; its arguments are direction, irr"),
        (lambda: inverse.Stage(lr=0.1), r"Stage: unknown argument 'lr' \(write learning_rate\)"),
        (
            lambda: SKY.with_sun((0, 1, 0), 3.0, 0.27),
            r"with_sun: too many positional arguments \(write angular_radius=0.27\); its arguments are direction, irr",
        ),
    ],
)
def test_arguments_that_do_not_fit_are_told_with_those_that_do(call, message):
    with pytest.raises(TypeError, match=message):
        call()


_RESULTS = {"Ending", "Fit", "FoundLight", "Geometry", "PoseUncertainty", "Recipe", "Result", "Tuning", "Uncertainty"}
"""Public dataclasses that functions return."""


@pytest.mark.parametrize("module", [ws, inverse])
def test_all_public_classes_say_which_arguments_they_take_and_do_not_change(module):
    kinds = [value for value in vars(module).values() if isinstance(value, type) and dataclasses.is_dataclass(value)]
    kinds = [kind for kind in kinds if kind.__name__ in module.__all__ and kind.__name__ not in _RESULTS]
    assert len(kinds) >= 10
    for kind in kinds:
        name = kind.__name__
        with pytest.raises(TypeError, match=rf"^{name}: unknown argument 'nonsense'"):
            kind(nonsense=1)
        with pytest.raises(TypeError, match=rf"^{name}: too many positional arguments.*; its arguments are "):
            kind(*range(99))
        with pytest.raises(dataclasses.FrozenInstanceError, match=f"nonsense: a {name} has no such field"):
            object.__new__(kind).nonsense = 1
        assert f"help({name})" in inspect.getdoc(kind.__init__)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("cow.obj", r"got 'cow.obj', expected a Scene; .*; default_scene\('cow.obj'\) makes one of that file"),
        ("scene.toml", r"; load_scene\('scene.toml'\) makes one of that file"),
        (BALL, r"got Body, .*; default_scene\(body\) puts it on a ground"),
        (BALL.mesh, r"; default_scene\(mesh\) puts it"),
        ([BALL, BALL], r"; Scene\(\[…\], synthetic_sky\(\)\) makes one of bodies"),
        ([], "got \\[\\], expected a Scene; load_scene\\(path\\) reads one$"),
        (TorchRenderer(SCENE), r"got TorchRenderer, .*; renderer.scene is its, and renderer\(\) is an image of it"),
        (ws.Renderer(SCENE), r"got Renderer, .*, and renderer.render\(\) is an image of it"),
    ],
    ids=str,
)
def test_what_is_no_scene_gets_the_way_to_one(value, message):
    for function in (ws.render, ws.Renderer, ws.view, TorchRenderer):
        with pytest.raises(ValueError, match=f"^scene: {'' if message.startswith('got') else 'got .*'}{message}"):
            function(value)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ws.Body(BALL.mesh, albedo=0.5), r"albedo: got 0.5, .*; that gray is \(0.5, 0.5, 0.5\)"),
        (lambda: ws.Body(BALL.mesh, emission=4.5), r"emission: got 4.5, .* such as .*; that gray is \(4.5, 4.5, 4.5\)"),
        (lambda: ws.Body(BALL.mesh, rotation=45), r"rotation: got 45, .* about the vertical \(0, 45, 0\)"),
        (lambda: ws.Scene([BALL], SKY, visibility="ray-traced"), r"got 'ray-traced', .* Visibility\('ray-traced'\)$"),
        (lambda: ws.Scene([BALL], SKY, visibility="rays"), r"got 'rays', .* Visibility\('directional'\)$"),
        (lambda: SCENE.body_numbers("cow", "moving"), r"moving: got 'cow', .* such as \['cow'\]$"),
    ],
)
def test_values_of_another_kind_get_an_example_with_theirs(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_poses_of_some_bodies_get_the_number_of_all():
    renderer = TorchRenderer(dataclasses.replace(SCENE, bodies=[BALL, BALL]))
    rotations, translations, scales = renderer.scene_poses()
    with pytest.raises(ValueError, match=r"rotations: got shape \(1, 3, 3\), .* all 2 bodies, as scene_poses\(\) has"):
        renderer.placed(rotations[:1], translations, scales)
    with pytest.raises(ValueError, match=r"translations: got shape \(1, 3\), .* all 2 bodies, as scene_poses\(\) has"):
        renderer.placed(rotations, translations[:1], scales)


def test_cameras_go_to_the_renderer():
    with pytest.raises(ValueError, match="light: got a Camera, .*cameras go to the renderer: renderer.with_cameras"):
        ws.Renderer(SCENE).render(SCENE.camera)


def test_a_map_in_place_of_coefficients_gets_the_way_to_them():
    renderer = TorchRenderer(SCENE)
    with pytest.raises(ValueError, match=r"light: .* light=EnvironmentMap\(map.numpy\(\)\); its coefficients are"):
        renderer(torch.ones(4, 8, 3))
    map = torch.ones(4, 8, 3)
    coefficients = renderer.basis.coefficients(ws.EnvironmentMap(map.numpy()))
    renderer(torch.as_tensor(coefficients, dtype=torch.float32))


def test_a_geometry_in_the_place_of_the_light_is_named():
    renderer = TorchRenderer(SCENE)
    geometry = renderer.placed(*renderer.scene_poses())
    for call in (
        lambda: renderer(geometry),
        lambda: ws.Renderer(SCENE).draw(ws.Renderer(SCENE).placed()),
        lambda: MIXED([0], [geometry]),
    ):
        with pytest.raises(ValueError, match="light: got a Geometry, expected light first: .* geometry=…"):
            call()


@pytest.mark.parametrize(
    ("value", "field", "message"),
    [
        (BALL, "rotation", r"rotation: that of a Body does not change; dataclasses.replace\(body, rotation=…\)"),
        (SCENE, "camera", r"dataclasses.replace\(scene, camera=…\) makes another"),
        (SCENE.camera, "fov_y", "fov_y: a Camera has no such field, and does not change"),
        (SCENE.visibility, "method", r"dataclasses.replace\(visibility, method=…\)"),
    ],
)
def test_fields_do_not_change_and_the_error_says_how_to_make_another(value, field, message):
    with pytest.raises(dataclasses.FrozenInstanceError, match=message):
        setattr(value, field, None)


def test_several_cameras_go_to_a_renderer_and_not_to_a_scene():
    with pytest.raises(
        ValueError, match=r"camera: got .*several go to Renderer\(scene, .* to TorchRenderer\(scene, cameras"
    ):
        ws.Scene([BALL], SKY, [SCENE.camera, SCENE.camera])


def test_names_that_arrays_of_a_mesh_have_elsewhere_get_theirs():
    with pytest.raises(AttributeError, match=r"a Mesh has no 'vertices' \(write positions\)"):
        BALL.mesh.vertices  # noqa: B018
    assert not hasattr(BALL.mesh, "color")
    assert (copy.deepcopy(BALL.mesh).positions == BALL.mesh.positions).all()


def test_a_picture_says_how_it_is_written():
    with pytest.raises(AttributeError, match=r"a Picture has no 'save' \(write write\(path\)\)"):
        ws.Picture([[1.0]]).save("picture.png")


def test_a_scene_gives_a_body_by_its_name_or_number():
    named = dataclasses.replace(BALL, name="ball")
    scene = dataclasses.replace(SCENE, bodies=(BALL, named))
    assert scene["ball"] is scene.bodies[1] and scene[0] is scene.bodies[0]
    with pytest.raises(ValueError, match="body: got 'bal', expected one of"):
        scene["bal"]
    with pytest.raises(TypeError, match="not iterable"):
        list(scene)


def test_a_size_of_one_number_is_that_of_a_square():
    one, two = (ws.Camera.framing(BALL, size=size) for size in (8, (8, 8)))
    assert repr(one) == repr(two) and (one.intrinsics == two.intrinsics).all()
    with pytest.raises(ValueError, match="size: got 'big', expected width and height .*, or a square's width"):
        ws.Camera.framing(BALL, size="big")


def test_a_folder_is_no_file(tmp_path):
    with pytest.raises(FileNotFoundError, match="mesh: no such file: .*, which is a folder"):
        ws.Body(tmp_path)


def test_functions_that_are_looked_for_in_the_wrong_place_are_named():
    for name in ("render", "explain", "tune", "view", "fit"):
        with pytest.raises(AttributeError, match=rf"a Scene has no '{name}' \(write .*scene"):
            getattr(SCENE, name)
    with pytest.raises(AttributeError, match="'warpshadow' has no attribute 'fit' \\(write warpshadow.inverse.fit\\)"):
        ws.fit  # noqa: B018
    with pytest.raises(AttributeError, match=r"has no attribute 'TorchRenderer' \(write warpshadow.torch.TorchR"):
        ws.TorchRenderer  # noqa: B018
    for name, remedy in (
        ("look_at", r"Camera.look_at\(eye, target"),
        ("Light", "EnvironmentMap"),
        ("load_envmap", r"EnvironmentMap.read\(path"),
        ("cube", r"Body\(trimesh.creation.box\("),
        ("cylinder", r"Body\(trimesh.creation.cylinder\("),
    ):
        with pytest.raises(AttributeError, match=rf"has no attribute '{name}' \(write {remedy}"):
            getattr(ws, name)
    with pytest.raises(AttributeError, match=r"has no attribute 'rendr' \(did you mean 'render'\?\)"):
        ws.rendr  # noqa: B018
    assert not hasattr(SCENE, "__array__") and (copy.deepcopy(SCENE).bodies[0].mesh.faces == BALL.mesh.faces).all()


def test_angles_that_look_like_degrees_draw_a_warning():
    with pytest.warns(UserWarning, match="axis-angle vector of 90 radians, .*are they degrees"):
        rotation_matrices(torch.tensor([0.0, 90.0, 0.0]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rotation_matrices(torch.tensor([0.0, 6.3, 0.0]))


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
@pytest.mark.parametrize("move", [lambda: TorchRenderer(SCENE).cuda(), lambda: TorchRenderer(SCENE, device="cuda")])
def test_without_a_gpu_cuda_is_refused_by_the_devices_that_there_are(move):
    with pytest.raises(ValueError, match="device: got 'cuda', expected one of 'cpu'; there is no CUDA device"):
        move()
