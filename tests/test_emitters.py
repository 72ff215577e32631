"""Bodies that emit, as a whole: images by renderers, stills and paths, and gradients of images."""

import dataclasses
import functools
import subprocess
import sys

import numpy as np
import pytest
import torch
import trimesh
import twins

import warpshadow as ws
from warpshadow import inverse
from warpshadow.pipeline.receivers import groups
from warpshadow.torch import TorchRenderer, rotation_matrices

# Relative L2 of gradients against differences of images, where nothing moves at a silhouette. Measured 1e-4 to 2e-3.
SMOOTH = 5e-3
# Relative L2 of images in the dark, kept against stills, whose 64 rays a pixel have grain at edges. Measured 3 to 4%.
KEPT = 0.06
# Mean of bounced light of stills against paths, which draw points of the lamp's surface. Measured 0.1%.
BOUNCED = 0.02
# The same of renderers. Measured 5.5 and 6%; 3.3 and 3.9% of the light of the sky, which is wider.
KEPT_BOUNCED = 0.08

DARK = ws.EnvironmentMap.constant(0.0)
SKY = ws.synthetic_sky((-0.7, 0.5, 0.2), sun_radius=12, sun_strength=3, height=32)
SMALL = ws.icosphere(0.3, 2)
BALL = ws.Body(ws.icosphere(0.5, 3), albedo=(0.8, 0.5, 0.3), translation=(0.4, 0.5, 0), name="ball")
GROUND = ws.Body(ws.plane(6.0, 8), albedo=(0.3, 0.5, 0.6), name="ground")
ONE = ws.Spheres([(0, 0, 0)], [0.29])
LAMP = ws.Body(SMALL, (0, 0, 0), blockers=ONE, translation=(-2.3, 2.2, 0.9), emission=(6, 5, 4), name="lamp")
POST = ws.Body(SMALL, blockers=ONE, translation=(-1.3, 1.6, 0.8), name="post")
WALL = ws.Body(ws.plane(1.2, 2), rotation=(0, 0, 90), translation=(-1.5, 1.3, 0.4), name="wall")

ABOVE = ws.Camera.look_at((0.5, 4.6, 3.6), (-0.2, 0.3, 0.3), fov_y=20, size=(32, 32))
"""Sees ground and ball, and neither the lamp nor what blocks it."""


def scene_of(*bodies, light=SKY, camera=ABOVE, **options):
    return ws.Scene(bodies or (LAMP, BALL, GROUND), light, camera, supersampling=1, **options)


def image_of(*bodies, **options):
    return ws.Renderer(scene_of(*bodies, **options)).render()[..., :3]


def unlike(image, other):
    return np.linalg.norm(image - other) / np.linalg.norm(other)


def without_emission(*bodies):
    return [dataclasses.replace(body, emission=None) for body in bodies]


def test_a_scene_without_emission_imports_and_computes_nothing_of_it():
    code = (
        "import sys, warpshadow as ws; renderer = ws.Renderer(ws.Scene([ws.Body(ws.plane(1.0))], "
        "ws.EnvironmentMap.constant(), visibility=ws.Visibility('directional'))); renderer.render(); "
        "assert not [name for name in sys.modules if 'emitters' in name or 'emitted' in name]; "
        "assert 'emit' not in str(renderer.explain())"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_an_emitter_shows_its_radiance():
    near = ws.Camera.look_at((-2.3, 2.2, 3.2), (-2.3, 2.2, 0.9), fov_y=10, size=(16, 16))
    for method in ("directional", "none", "ray-traced"):
        image = image_of(camera=near, light=DARK, visibility=ws.Visibility(method))
        np.testing.assert_allclose(image, np.broadcast_to((6, 5, 4), image.shape), rtol=1e-6)
    gray = dataclasses.replace(LAMP, albedo=(0.5, 0.5, 0.5))
    lit, unlit = (image_of(*bodies, camera=near) for bodies in ([gray], without_emission(gray)))
    np.testing.assert_allclose(lit - unlit, np.broadcast_to((6, 5, 4), lit.shape), rtol=1e-5)


def test_kept_renderers_and_stills_agree_in_the_light_of_a_lamp():
    kept = image_of(light=DARK, visibility=ws.Visibility("directional"))
    still = image_of(light=DARK, visibility=ws.Visibility("ray-traced", sampling="shared"))
    assert unlike(kept, still) < KEPT and still.mean() > 0.01
    assert kept.mean() == pytest.approx(still.mean(), rel=0.01)


def test_a_body_between_blocks_and_a_body_behind_does_not():
    open_ground = image_of(LAMP, GROUND, light=DARK)
    for blocker in (POST, WALL):
        behind = dataclasses.replace(blocker, translation=(-3.2, 2.8, 1.2), receivers="vertex")
        blocked, free = (image_of(LAMP, GROUND, body, light=DARK) for body in (blocker, behind))
        np.testing.assert_allclose(free, open_ground, atol=1e-5)
        assert (blocked < 0.1 * open_ground).mean() > 0.01 and blocked.mean() < 0.99 * open_ground.mean()


@pytest.mark.parametrize("bounces", [0, "all"])
def test_light_of_emitters_adds_to_that_of_the_map_and_is_linear_in_emission(bounces):
    twice = dataclasses.replace(LAMP, emission=(12, 10, 8))
    options = {"bounces": bounces, "visibility": ws.Visibility("directional")}
    dark, sky = image_of(light=DARK, **options), image_of(*without_emission(LAMP, BALL, GROUND), **options)
    np.testing.assert_allclose(image_of(twice, BALL, GROUND, light=DARK, **options), 2 * dark, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(image_of(**options), sky + dark, rtol=0.05, atol=5e-3)


@pytest.mark.slow
def test_light_of_emitters_bounces_as_along_paths():
    walls = [GROUND, dataclasses.replace(GROUND, rotation=(90, 0, 0), translation=(0, 0, -1), name="back")]
    bodies = LAMP, BALL, *walls
    kinds = {"kept": {"method": "directional"}, "still": {"method": "ray-traced", "sampling": "shared"}}
    kinds["paths"] = {"method": "ray-traced", "samples": 512}
    bounced = {}
    for name, settings in kinds.items():
        options = {"light": DARK, "visibility": ws.Visibility(**settings)}
        bounced[name] = (image_of(*bodies, bounces="all", **options) - image_of(*bodies, **options)).mean()
    assert bounced["kept"] == pytest.approx(bounced["paths"], rel=KEPT_BOUNCED)
    assert bounced["still"] == pytest.approx(bounced["paths"], rel=BOUNCED)


def weights():
    row, column = np.mgrid[0:1:32j, 0:1:32j]
    return torch.tensor(np.stack([np.sin(3 * row + 2 * column), np.cos(2 * row), 1 + column, 0 * row], -1)).float()


@pytest.mark.slow
@pytest.mark.parametrize("bounces", [0, 1])
@pytest.mark.parametrize("blocker", [POST, WALL], ids=["post", "wall"])
def test_gradients_of_images_agree_with_differences(blocker, bounces):
    """To the poses of the lamp and of what blocks it, to its radiance and to the albedo of the ground."""
    renderer = TorchRenderer(scene_of(LAMP, blocker, GROUND, bounces=bounces), progress=False)
    rotations, translations, scales = renderer.scene_poses()

    def loss(lamp, between, turn, emission, albedo):
        turned = torch.stack([rotations[0], rotation_matrices(turn) @ rotations[1], rotations[2]])
        placed = renderer.placed(turned, translations + torch.stack([lamp, between, 0 * lamp]), scales)
        image = renderer(geometry=placed, emission={"lamp": emission}, albedo={"ground": albedo})
        return (image * weights()).sum()

    zero = torch.zeros(3)
    values = {"lamp": zero, "between": zero, "turn": zero}
    values |= {"emission": torch.tensor([6.0, 5.0, 4.0]), "albedo": torch.tensor([0.3, 0.5, 0.6])}
    for name, step in {"lamp": 3e-3, "between": 3e-3, "turn": 3e-3, "emission": 0.5, "albedo": 0.05}.items():
        if name == "turn" and blocker is POST:
            continue
        loss_of_one = functools.partial(lambda name, value: loss(**values | {name: value}), name)
        gradient, differences = twins.slopes(loss_of_one, values[name], step)
        assert np.linalg.norm(gradient - differences) < SMOOTH * np.linalg.norm(differences), name


def test_a_lamp_in_a_bowl_changes_no_other_image_of_a_batch():
    ball = ws.icosphere(0.5, 3)
    low = ball.surface.faces[ball.positions[ball.surface.faces].mean(axis=1)[:, 1] < 0.1]
    used, faces = np.unique(low, return_inverse=True)
    bowl = ws.Body(ws.Mesh(ball.positions[used], faces.reshape(-1, 3)), translation=(0.9, 0.5, 0.4), name="bowl")
    lamp = dataclasses.replace(LAMP, mesh=ws.icosphere(0.08, 2), blockers=0, translation=(-1.3, 1.2, 0.6))
    renderer = TorchRenderer(scene_of(lamp, bowl, GROUND, light=DARK), progress=False)
    rotations, translations, scales = renderer.scene_poses()
    shifts = torch.zeros(2, 3, 3)
    shifts[1, 0] = torch.tensor([2.2, -0.7, -0.2])  # into the bowl
    images, gradients = [], []
    for shift in (*shifts, shifts):
        moved = shift.clone().requires_grad_()
        image = renderer(geometry=renderer.placed(rotations, translations + moved, scales))
        image.square().sum().backward()
        images.append(image.detach().numpy().reshape(-1, *image.shape[-3:]))
        gradients.append(moved.grad.numpy().reshape(-1, 3, 3))
    assert unlike(images[0][..., :3], images[1][..., :3]) > 0.1
    for found in (images, gradients):
        np.testing.assert_allclose(found[2], np.concatenate(found[:2]), atol=1e-5 * np.abs(found[2]).max())


def test_light_of_a_coarse_lamp_half_in_the_ground_bounces_in_stills():
    """The middles of its faces lie in the ground's plane."""
    lamp = ws.Body(ws.icosphere(0.16, 0), albedo=(0.1, 0.1, 0.1), emission=(3, 5, 12))
    camera = ws.Camera.look_at((1.2, 1.9, 3.6), (0, 0.25, 0), fov_y=34, size=(16, 16))
    scene = ws.Scene([ws.Body(ws.plane(5.0, 64)), lamp], ws.EnvironmentMap.constant(0.1), camera, bounces="all")
    assert np.isfinite(ws.render(scene)).all()


def test_emission_takes_a_batch_and_vertices_and_rays_have_its_gradient():
    for visibility in (ws.Visibility("directional"), ws.Visibility("ray-traced", samples=64)):
        renderer = TorchRenderer(scene_of(visibility=visibility), progress=False)
        colors = torch.tensor([[[6.0, 5.0, 4.0]], [[0.0, 1.0, 0.0]]], requires_grad=True)
        images = renderer(emission={"lamp": colors})
        assert images.shape == (2, 32, 32, 4)
        torch.testing.assert_close(images[0].detach(), renderer().detach(), atol=1e-6, rtol=1e-5)
        images.sum().backward()
        with torch.no_grad():
            brighter = renderer(emission={"lamp": torch.tensor([7.0, 5.0, 4.0])})
        change = (brighter - images[0]).sum().item()
        assert colors.grad[0, 0, 0].item() == pytest.approx(change, rel=1e-3)
        count = LAMP.mesh.vertex_count
        of_vertices = renderer(emission={"lamp": torch.tensor([[6.0, 5.0, 4.0]]).expand(count, 3)})
        torch.testing.assert_close(of_vertices, images[0].detach(), atol=1e-5, rtol=1e-4)


SCREEN = np.zeros((32, 48, 3), np.float32)
SCREEN[4:12, 5:20], SCREEN[20:30, 30:45] = (9, 3, 1), (1, 4, 12)


def with_screen(mesh, emission, **options):
    """A ball before a screen that stands on the ground."""
    screen = ws.Body(mesh, (0, 0, 0), emission=emission, rotation=(90, 0, 0), translation=(0, 0.7, -1), name="screen")
    camera = ws.Camera.look_at((0.3, 3.0, 1.6), (0, 0.2, -0.2), fov_y=40, size=(32, 32))
    return scene_of(screen, BALL, GROUND, light=DARK, camera=camera, **options)


@pytest.mark.parametrize("settings", [{"method": "directional"}, {}, {"method": "ray-traced", "samples": 2048}])
def test_a_texture_of_emission_lights_and_bounces_as_colors_of_many_vertices_do(settings):
    """In stills and paths grain differs; light that bounces is compared by its mean."""
    fine = ws.plane((1.2, 0.8), (48, 32))
    padded = np.pad(SCREEN, ((1, 1), (1, 1), (0, 0)))
    corners = (padded[1:, 1:] + padded[1:, :-1] + padded[:-1, 1:] + padded[:-1, :-1]) / 4  # between texels
    colors = corners[::-1].reshape(-1, 3)
    lights = []
    for mesh, emission in ((ws.plane((1.2, 0.8), 1), SCREEN), (fine, colors)):
        images = []
        for bounces in (0, 2):
            scene = with_screen(mesh, emission, bounces=bounces, visibility=ws.Visibility(**settings))
            render = ws.render if settings.get("method") != "directional" else lambda item: ws.Renderer(item).render()
            images.append(render(scene)[12:, :, :3])  # without the screen
        lights.append(images)
    (direct, full), (expected, all_expected) = lights
    assert unlike(direct, expected) < (0.03 if settings.get("method") == "directional" else 0.08)
    np.testing.assert_allclose(direct.mean(axis=(0, 1)), expected.mean(axis=(0, 1)), rtol=0.02)
    bounced, bounced_expected = (full - direct).mean(axis=(0, 1)), (all_expected - expected).mean(axis=(0, 1))
    np.testing.assert_allclose(bounced, bounced_expected, rtol=0.05)


def test_stills_send_rays_to_the_bright_part_of_a_screen():
    """Off by less than 0.5% beside 32 rays to each sample; with two to each, whatever its radiance, by 1.7%."""
    texture = np.full((16, 16, 3), 0.05)
    texture[4:8, 4:8] = 20
    screen = ws.Body(ws.plane(3.0, 1), (0, 0, 0), emission=texture, rotation=(180, 0, 0), translation=(0, 3, 0))
    scene = scene_of(screen, BALL, GROUND, light=DARK)
    samples = ws.Visibility("ray-traced", sampling="shared", samples=8192)
    found, exact = (ws.render(item, progress=False) for item in (scene, dataclasses.replace(scene, visibility=samples)))
    assert unlike(found[..., :3], exact[..., :3]) < 0.005


def test_a_screen_shows_its_texture():
    facing = ws.Camera.look_at((0, 0.7, 0.2), (0, 0.7, -1), up=(0, 1, 0), fov_y=36.87, size=(32, 32))  # its height
    for visibility in (ws.Visibility("directional"), ws.Visibility()):
        scene = with_screen(ws.plane((1.2, 0.8), 1), SCREEN, visibility=visibility)
        image = ws.render(dataclasses.replace(scene, bodies=scene.bodies[:1], camera=facing))[..., :3]
        np.testing.assert_allclose(image[3:13, 2:14], np.broadcast_to(image[8, 8], (10, 12, 3)), atol=9)
        np.testing.assert_allclose(image[8, 4], (9, 3, 1), rtol=0.01)
        np.testing.assert_allclose(image[24, 27], (1, 4, 12), rtol=0.01)
        np.testing.assert_allclose(image[24, 4], 0, atol=0.01)


def test_gradients_to_a_texture_of_emission_are_exact_since_images_are_linear_in_it():
    renderer = TorchRenderer(with_screen(ws.plane((1.2, 0.8), 1), SCREEN), progress=False)
    image = torch.tensor(SCREEN + 1, requires_grad=True)
    change = torch.tensor(np.random.default_rng(0).uniform(-1, 1, SCREEN.shape).astype(np.float32))
    (renderer(emission={"screen": image}) * weights()).sum().backward()
    with torch.no_grad():
        up, down = (renderer(emission={"screen": image + sign * change}) for sign in (1, -1))
        batch = renderer(emission={"screen": torch.stack([image + change, image])})
        gray = renderer(emission={"screen": torch.ones(3)})
    expected = ((up - down) * weights()).sum().item() / 2
    assert (image.grad * change).sum().item() == pytest.approx(expected, rel=1e-3)
    torch.testing.assert_close(batch[0], up, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(gray, renderer(emission={"screen": torch.ones(4, 3)}).detach(), atol=1e-5, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("start", [np.float32([2, 2, 2]), np.full((2, 3, 3), 2.0)], ids=["color", "texture"])
def test_a_fit_finds_a_texture_of_emission(start):
    truth = SCREEN.reshape(4, 8, 6, 8, 3).mean(axis=(1, 3))
    camera = ws.Camera.look_at((-1.5, 1.8, 0.5), (0, 0.6, -0.9), fov_y=40, size=(32, 32))  # past the ball
    scene, plain = (
        dataclasses.replace(with_screen(ws.plane((1.2, 0.8), 1), emission), camera=camera)
        for emission in (truth, start)
    )
    target = inverse.Target(ws.Renderer(scene).render())
    problem = inverse.Problem(
        plain, target, [inverse.Emission("screen", size=(4, 6))], still=ws.Visibility("directional")
    )
    result = inverse.fit(problem, [inverse.Stage(150)], progress=False)
    found = result.scene.bodies[0].emission
    assert found.shape == (4, 6, 3) and result.figures == {}
    assert unlike(found, truth) < 0.05


def test_a_texture_of_emission_that_cannot_be_is_refused():
    with pytest.raises(ValueError, match="emission: got an image, but mesh .* has no uvs"):
        ws.Body(SMALL, emission=SCREEN)
    with pytest.raises(ValueError, match=r"emission: got shape \(32, 48, 2\), expected \[3\], .* or a texture"):
        ws.Body(ws.plane(1.0, 1), emission=SCREEN[..., :2])
    with pytest.raises(ValueError, match="emission.*: got shape"):
        TorchRenderer(scene_of(), progress=False)(emission={"lamp": torch.tensor(SCREEN)})
    scene = with_screen(ws.plane((1.2, 0.8), 1), SCREEN)
    with pytest.raises(ValueError, match="body: got 0, whose mesh has no uvs"):
        inverse.Problem(scene_of(), inverse.Target(np.zeros((32, 32, 3))), [inverse.Emission("lamp", size=(2, 2))])
    with pytest.raises(ValueError, match="smoothness: got it without size"):
        inverse.Emission("screen", smoothness=0.1)
    with pytest.raises(ValueError, match="per_vertex: got it of a body whose emission is a texture, expected size"):
        inverse.Problem(scene, inverse.Target(np.zeros((32, 32, 3))), [inverse.Emission("screen", per_vertex=True)])


def light_on_wall(mesh, method, **options):
    """Mean light of a lamp that a wall receives."""
    wall = ws.Body(ws.plane(1.0, 4), (1, 1, 1), rotation=(90, 0, 0), translation=(0, 0, -1), name="wall")
    lamp = ws.Body(mesh, (0, 0, 0), **{"emission": (1, 1, 1), "name": "lamp", "blockers": 8} | options)
    camera = ws.Camera.look_at((0.9, 1.2, 1), (0.1, 0.3, -1), fov_y=12, size=(8, 8))
    return image_of(wall, lamp, light=DARK, camera=camera, visibility=ws.Visibility(method)).mean()


@pytest.mark.parametrize("method", ["directional", "ray-traced"])
def test_a_lamp_hides_its_far_side(method):
    """A ball whose faces look inward is open, and so both sides of its shell emit: the near ones alone are seen."""
    ball = ws.icosphere(0.2, 3)
    inward, sphere = ws.Mesh(ball.positions, ball.faces[:, ::-1]), ws.Spheres([(0, 0, 0)], [0.19])
    light, expected = (light_on_wall(mesh, method, blockers=sphere) for mesh in (inward, ball))
    assert light == pytest.approx(expected, rel=0.02)


def test_a_bulb_lights_the_inside_of_its_shade_past_which_the_other_side_is():
    """The far side of a shade is behind the bulb, and hides none of it."""
    tube = trimesh.creation.cylinder(0.4, 0.5, sections=24)
    shade = ws.Mesh(tube.vertices, tube.faces[np.abs(tube.face_normals[:, 2]) < 0.5]).transformed(
        rotation=np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    )
    bulb = ws.Body(ws.icosphere(0.08, 2), (0, 0, 0), emission=(6, 5, 4), name="bulb")
    camera = ws.Camera.look_at((0.2, -1.5, 0.1), (0, 0, 0), fov_y=35, size=(32, 32))
    bodies = ws.Body(shade, (0.7, 0.6, 0.5), name="shade"), bulb
    scene = scene_of(*bodies, light=DARK, camera=camera)
    renderer = ws.Renderer(scene)
    shows_shade = renderer.layers().bodies == 0
    light, expected = (image[shows_shade][:, :3].mean() for image in (renderer.render(), ws.render(scene)))
    assert light == pytest.approx(expected, rel=0.05)  # 0.5% off; by self-visibility to infinity 70% darker


def test_light_of_a_shade_is_that_of_rays():
    tube = trimesh.creation.cylinder(0.2, 0.4, sections=32)
    shade = ws.Mesh(tube.vertices, tube.faces[np.abs(tube.face_normals[:, 2]) < 0.5])
    kept, still = (light_on_wall(shade, method, rotation=(60, 20, 0)) for method in ("directional", "ray-traced"))
    assert kept == pytest.approx(still, rel=0.03)
    assert light_on_wall(shade, "directional", rotation=(60, 20, 0), blockers=0) > 1.2 * kept


@pytest.mark.parametrize("scale", [1e-7, 1e6])
def test_light_along_paths_does_not_depend_on_the_scale(scale):
    images = []
    for unit in (1.0, scale):
        bodies = [
            dataclasses.replace(body, scale=unit, translation=unit * np.asarray(body.translation))
            for body in (LAMP, BALL, GROUND)
        ]
        eye, target = np.array([(0.5, 4.6, 3.6), (-0.2, 0.3, 0.3)]) * unit
        camera = ws.Camera.look_at(eye, target, fov_y=20, size=(16, 16), near=0.01 * unit)
        options = {"camera": camera, "visibility": ws.Visibility("ray-traced", samples=64), "bounces": 2}
        images.append(image_of(*bodies, light=DARK, **options).mean())
    assert images[1] == pytest.approx(images[0], rel=0.01)


def test_one_side_of_a_body_that_emits_lights_that_side():
    halves = np.where(SMALL.positions[:, :1] > 0, (9.0, 9.0, 9.0), (0.0, 0.0, 0.0))
    lamp = dataclasses.replace(LAMP, emission=halves, translation=(0, 1.0, 0.3))
    image = image_of(lamp, GROUND, light=DARK)
    assert image[:, 20:].mean() > 4 * image[:, :8].mean()


def test_emission_of_bodies_without_it_is_refused():
    renderer = TorchRenderer(scene_of(), progress=False)
    with pytest.raises(ValueError, match=r"emission\[1\]: got some for 'ball', expected one for bodies that have"):
        renderer(emission={"ball": torch.ones(3)})
    with pytest.raises(ValueError, match="emission: got some for body 'lamp', whose light 'log-sh' lacks"):
        scene_of(visibility=ws.Visibility("log-sh"))


@pytest.mark.parametrize(("value", "message"), [(-0.1, "got 3 values out of range"), (np.nan, "got 3 NaN or Inf")])
def test_emission_that_no_body_has_is_refused_in_calls(value, message):
    renderer = TorchRenderer(scene_of(), progress=False)
    for colors in (torch.full((3,), value), torch.full((SMALL.vertex_count, 3), value)):
        count = message.replace("3", str(colors.numel()))
        with pytest.raises(ValueError, match=rf"emission\[.*\]: {count}"):
            renderer(emission={"lamp": colors})


def test_a_line_search_may_look_beyond_the_emission_that_there_is():
    renderer = TorchRenderer(scene_of(), progress=False)
    target = inverse.Target(renderer(emission={"lamp": torch.tensor([0.0, 5.0, 4.0])}).numpy())
    problem = inverse.Problem(renderer.scene, target, [inverse.Emission("lamp")])
    optimizer = functools.partial(torch.optim.LBFGS, max_iter=3, line_search_fn="strong_wolfe")
    result = inverse.fit(problem, inverse.Stage(1, 5e4), optimizer=optimizer, progress=False)
    assert result.reason == "finished"


def test_a_lamp_lights_a_photograph():
    caught = dataclasses.replace(GROUND, shadow_catcher=True)
    renderer = TorchRenderer(scene_of(LAMP, BALL, caught), progress=False)
    bare = TorchRenderer(scene_of(*without_emission(LAMP), BALL, caught), progress=False)
    photograph = torch.full((32, 32, 3), 0.5)
    lit, unlit = renderer.insert(photograph), bare.insert(photograph)
    assert (lit - unlit).mean() > 0.005 and (lit > unlit - 0.01).all()


def test_explanations_tell_of_emitters():
    renderer = ws.Renderer(scene_of())
    renderer.render()
    text = str(renderer.explain())
    assert "light of emitters" in text and "64 samples" not in text
    assert "64 samples" in str(ws.Renderer(scene_of()).explain())


@pytest.mark.parametrize("method", ["directional", "ray-traced"])
def test_samples_of_lamps_are_found_when_an_image_is_computed_not_while_its_nodes_are_made(method):
    renderer = ws.Renderer(scene_of(visibility=ws.Visibility(method)))
    view, emitters = renderer.view(), renderer._method.emitters
    image = view.image(view.method.light, view.materials)
    assert "samples" not in vars(emitters) and "self_visibility" not in vars(emitters)
    image.value(view.call)
    assert "samples" in vars(emitters)


def test_the_shadow_of_a_scene_is_that_of_its_map():
    np.testing.assert_allclose(
        ws.Renderer(scene_of()).shadow(),
        ws.Renderer(
            scene_of(*without_emission(LAMP), *(BALL, dataclasses.replace(GROUND, receivers="pixel")))
        ).shadow(),
        atol=0.02,
    )


@pytest.mark.slow
@pytest.mark.parametrize("free", ["emission", "emission and light", "emission and pose"])
def test_a_fit_finds_emission(free):
    dim = dataclasses.replace(LAMP, emission=(2, 2, 2))
    scene, start = (scene_of(lamp, BALL, GROUND, light=ws.EnvironmentMap.constant(0.01)) for lamp in (LAMP, dim))
    target = ws.Renderer(scene).render()
    parameters = [inverse.Emission("lamp")]
    parameters += {"emission and light": [inverse.Light(2)], "emission and pose": [inverse.Pose("ball")]}.get(free, [])
    still = None if free == "emission and pose" else ws.Visibility("directional")
    problem = inverse.Problem(start, inverse.Target(target), parameters, still=still)
    result = inverse.fit(problem, [inverse.Stage(80)], progress=False)
    np.testing.assert_allclose(result.scene.bodies[0].emission, (6, 5, 4), rtol=0.05)


@pytest.mark.parametrize("width", [0.1, 0.02])
def test_a_ground_hides_nothing_of_a_thin_lamp_that_lies_on_it(width):
    """Discs as large as its samples reach below the ground: light was 11% less."""
    strip = trimesh.creation.box((1, width, width))
    lamp = ws.Body(ws.Mesh(strip.vertices, strip.faces), emission=(9, 9, 9), translation=(0, width / 2, 0.8))
    ground = ws.Body(ws.plane(6.0), albedo=(0, 0, 0))
    camera = ws.Camera.look_at((0, 1.2, 2.2), (0, 0.3, 0), fov_y=12, size=(16, 16))
    ball = ws.Body(ws.icosphere(0.25, 3), translation=(0, 0.3, 0))
    dark = ws.EnvironmentMap(np.zeros((8, 16, 3), np.float32))
    above, alone = (ws.Renderer(ws.Scene(bodies, dark, camera)) for bodies in ([ball, lamp, ground], [ball, lamp]))
    shows_ball = above.layers().bodies == 0
    light, expected = (renderer.render()[shows_ball][:, :3].mean() for renderer in (above, alone))
    assert light == pytest.approx(expected, rel=2e-3)


def test_receivers_are_lifted_off_planes_once_however_many_lamps_there_are(monkeypatch):
    find, calls, counts = groups.find_fronts, [], []
    monkeypatch.setattr(
        groups, "find_fronts", lambda *arguments, **options: calls.append(1) or find(*arguments, **options)
    )
    for number in (1, 3):
        lamps = [ws.Body(ws.icosphere(0.1, 1), emission=(3, 3, 3), translation=(x, 2, 0)) for x in range(number)]
        flat = [ws.Body(ws.plane(size, 2), translation=(0, height, 0)) for size, height in ((4.0, 0), (0.5, 1))]
        camera = ws.Camera.look_at((0, 3, 4), (0, 0, 0), size=(8, 8))
        renderer = ws.Renderer(ws.Scene([*flat, *lamps], ws.EnvironmentMap.constant(), camera))
        renderer.render()
        materials, points = renderer._materials, renderer.view()
        calls.clear()
        renderer._method.emitted_light_node(points, materials).value(points.call)
        counts.append(len(calls))
    assert counts == [2, 2]  # of the receivers of each flat body
