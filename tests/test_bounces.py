"""Light that bounces, as a whole: energy, what runs, and gradients of images against central differences of them."""

import dataclasses
import functools
import json
import subprocess
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
import warp as wp
from test_end_to_end import (
    ON_BOTH,
    ON_GROUND,
    SILHOUETTE,
    SMOOTH,
    Cameras,
    Poses,
    blob,
    error_along_nodes,
    gradient_and_differences,
    image_of_batch,
    random_batch,
    relative_error,
    scene_of,
)

import warpshadow as ws
from warpshadow.pipeline.bounces import moving_bounces, patches, static_bounces, static_form_factors
from warpshadow.pipeline.receivers import groups
from warpshadow.torch import TorchRenderer, rotation_matrices

pytestmark = pytest.mark.usefixtures("one_thread")

METHODS = ("directional", "log-sh")

# A white scene under even light is as bright everywhere, whatever its shape: each receiver by itself is off where the
# body's spheres and its mesh block different light, and harmonics ring. The mean over receivers, and single ones:
FURNACE = {"directional": (0.005, 0.1), "log-sh": (0.02, 0.12)}

# Relative L2 of an image of balls, for which spheres stand in exactly, against paths: half of it is soft edges of
# shadows and the noise of 1024 paths a pixel. Measured 0.041 and 0.054; without bounces 0.168 and 0.172.
AGAINST_PATHS = {"directional": 0.055, "log-sh": 0.07}

# Relative L2 of a gradient to vertices that are not seen, but lit: cells pass their horizons, each a kink. Measured
# 0.009, and 0.05 and 0.12 with steps 4 and 16 times as long.
SOURCES = 2e-2


def bounced(method: str, camera: ws.Camera, bounces: int = 2, *, blockers: int = 0, **visibility) -> ws.Scene:
    """The blob and its ground, which casts a shadow if it has a blocker."""
    scene = scene_of(method, camera, **visibility)
    ground = dataclasses.replace(scene.bodies[1], blockers=blockers)
    return dataclasses.replace(scene, bounces=bounces, bodies=(scene.bodies[0], ground))


@functools.cache
def on_both(method: str) -> TorchRenderer:
    """A renderer of that, whose form factors are found once."""
    return TorchRenderer(bounced(method, ON_BOTH))


def balls(centers: list[tuple[float, float, float]], radii: list[float], **options) -> ws.Body:
    """Balls as one body, for which spheres stand in exactly."""
    ball = ws.icosphere(1.0, 3)
    positions = [radius * ball.positions + center for center, radius in zip(centers, radii, strict=True)]
    faces = [ball.faces + number * ball.vertex_count for number in range(len(radii))]
    mesh = ws.Mesh(np.concatenate(positions), np.concatenate(faces), name=f"{len(radii)} balls")
    return ws.Body(mesh, blockers=ws.Spheres(centers, radii), **options)


def balls_on_red(visibility: ws.Visibility, bounces: int, size: int = 32) -> ws.Scene:
    """Two balls that light each other, a third one, and a red ground under a wide sun."""
    pair = [(-0.42, 0, 0), (0.42, 0.1, 0)], [0.42, 0.4]
    bodies = [
        balls(*pair, albedo=(0.3, 0.5, 0.9), translation=(0, 0.44, 0)),
        balls([(0, 0, 0)], [0.35], albedo=(0.9, 0.9, 0.9), translation=(0.2, 0.36, 0.85)),
        ws.Body(ws.plane(6.0, 48), albedo=(0.9, 0.35, 0.2), blockers=1),
    ]
    sky = ws.synthetic_sky((-0.7, 0.5, 0.2), sun_radius=12, sun_strength=3, height=32)
    camera = ws.Camera.look_at((0.5, 2.0, 3.0), (0, 0.4, 0.2), size=(size, size))
    return ws.Scene(bodies, sky, camera, visibility, bounces=bounces)


PATHS = ws.Visibility("ray-traced", samples=1024)


# ---------------------------------------------------------------------------------------------- against paths


@pytest.fixture(scope="module")
def all_light() -> np.ndarray:
    """Traced along paths of up to 12 bounces."""
    return ws.render(balls_on_red(PATHS, 12))[..., :3]


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_bounces_by_spheres_are_those_of_paths(method, all_light):
    direct, found = (ws.render(balls_on_red(ws.Visibility(method), bounces))[..., :3] for bounces in (0, 2))
    assert relative_error(found, all_light) < AGAINST_PATHS[method]
    assert relative_error(direct, all_light) > 2 * AGAINST_PATHS[method]
    of_each_color = found.sum(axis=(0, 1)) / all_light.sum(axis=(0, 1))
    np.testing.assert_allclose(of_each_color, 1, atol=0.02)  # measured 0.010; without bounces 0.13


# ---------------------------------------------------------------------------------------------- energy


def furnace(method: str, bounces: int, albedo: float) -> np.ndarray:
    """Shading of a body on a ground under light of radiance 1 from everywhere."""
    bodies = [
        dataclasses.replace(blob(), albedo=(albedo,) * 3),
        ws.Body(ws.plane(6.0, 48), albedo=(albedo,) * 3, blockers=1),
    ]
    light = ws.EnvironmentMap.constant(1.0, height=16)
    return ws.Renderer(ws.Scene(bodies, light, ON_BOTH, ws.Visibility(method), bounces=bounces)).shade().numpy()


@pytest.mark.parametrize("method, bounces", [(METHODS[0], 16), *((method, "all") for method in METHODS)])
def test_in_a_white_furnace_all_is_as_bright_as_the_light(method, bounces):
    in_the_mean, at_most = FURNACE[method]
    shading = furnace(method, bounces, 1.0)
    assert abs(shading.mean() - 1) < in_the_mean
    assert abs(shading - 1).max() < at_most


def test_light_at_the_foot_of_a_ball_is_that_of_paths():
    """At 0.1 to 0.8 radii. Measured 1.21, 1.28, 1.12, 0.94, 0.97 and 0.98.

    Before patches and texels were finer there, 7.4, 3.8 and 2.2 at the first three, where all light is a twenty-seventh
    to a seventh of that far from the ball.
    """
    radii, tolerances = np.array([0.1, 0.15, 0.2, 0.4, 0.6, 0.8]), np.array([0.35, 0.35, 0.2, 0.1, 0.1, 0.1])
    ball = ws.Body(
        ws.icosphere(1.0, 4), (0.8, 0.8, 0.8), blockers=ws.Spheres([(0, 0, 0)], [1.0]), translation=(0, 1, 0)
    )
    ground = ws.Body(ws.plane(8.0, 1), (0.7, 0.7, 0.7), receivers="pixel")
    sky = ws.synthetic_sky((-0.7, 0.5, 0.2), sun_radius=12, sun_strength=3, height=32)
    scene = ws.Scene([ball, ground], sky, ON_BOTH, bounces=12)
    angles = 2 * np.pi * (np.arange(8) + 0.5) / 8
    places = np.stack([np.cos(angles), 0 * angles, np.sin(angles)], axis=-1) * radii[:, None, None]
    corners = ground.mesh.positions[ground.mesh.faces]
    edges = np.concatenate([corners[..., [0, 2]], np.ones((2, 3, 1))], axis=-1)  # barycentrics add up to 1
    places = np.concatenate([places[..., [0, 2]], np.ones((6, 8, 1))], axis=-1).reshape(-1, 3)
    both = np.stack([np.linalg.solve(edge.T, places.T).T for edge in edges])
    face = both.min(axis=2).argmax(axis=0)
    given = len(ball.mesh.faces) + face, both[face, np.arange(48)].astype(np.float32)

    def bounced_light(visibility: ws.Visibility) -> np.ndarray:
        shadings = []
        for bounces in (12, 0):
            renderer = ws.Renderer(dataclasses.replace(scene, visibility=visibility, bounces=bounces))
            shadings.append(renderer.shade(view=renderer.on_faces(*given)).numpy()[0])
        return (shadings[0] - shadings[1]).reshape(6, -1).mean(axis=1)

    ratios = bounced_light(ws.Visibility()) / bounced_light(ws.Visibility("ray-traced", samples=4096))
    assert (np.abs(ratios - 1) < tolerances).all(), ratios


def box(size: tuple[float, float, float], segments: int = 6) -> ws.Mesh:
    """A box around the origin, with vertices of their own on each side."""
    side = ws.plane(1.0, segments)  # looks up
    turns = [np.roll(np.eye(3), shift, axis=0) for shift in range(3)]
    turns += [np.diag([1, -1, -1]) @ turn for turn in turns]
    positions = [(side.positions + (0, 0.5, 0)) @ turn for turn in turns]
    faces = [side.faces + number * side.vertex_count for number in range(6)]
    return ws.Mesh(np.concatenate(positions) * size, np.concatenate(faces))


def test_in_a_white_furnace_a_box_has_no_dark_ground_beside_it():
    """Its bottom, which lies on the ground and is black, does not count. Measured 0.005, and 0.216 if it does."""
    size, radius, counts = (1.6, 0.5, 1.0), 0.19, (6, 2, 4)
    most = 0.5 * np.array(size) - 0.95 * radius
    centers = np.stack(np.meshgrid(*map(np.linspace, -most, most, counts)), axis=-1).reshape(-1, 3)
    spheres = ws.Spheres(centers, np.full(len(centers), radius))
    body = ws.Body(box(size), albedo=(1, 1, 1), blockers=spheres, translation=(0, 0.25, 0))
    ground = ws.Body(ws.plane(6.0, 24), albedo=(1, 1, 1), blockers=1)
    light = ws.EnvironmentMap.constant(1.0, height=16)
    shading = ws.Renderer(ws.Scene([body, ground], light, ON_BOTH, bounces=8)).shade().numpy()
    assert abs(shading - 1).max() < 0.01


def test_bounces_add_ever_less_light():
    """Of albedo a the n-th bounce brings less than a times what the one before brought."""
    shadings = [furnace("directional", bounces, 0.5).mean() for bounces in range(5)]
    gains = np.diff(shadings)
    assert (gains > 0).all()
    assert (gains[1:] < 0.5 * gains[:-1]).all()


def open_room(albedo, **options):
    """Five planes of 2 × 2 around the origin, open in front, under a white sky."""
    walls = [((0, 0, 0), (0, -1, 0)), ((180, 0, 0), (0, 1, 0)), ((90, 0, 0), (0, 0, -1))]
    walls += [((0, 0, -90), (-1, 0, 0)), ((0, 0, 90), (1, 0, 0))]
    bodies = [
        ws.Body(ws.plane(2.0, 8), albedo=(albedo,) * 3, rotation=turn, translation=place, name=f"{place}", **options)
        for turn, place in walls
    ]
    camera = ws.Camera.look_at((0, 0, 4), (0, 0, 0), fov_y=36, size=(24, 24))
    return ws.Scene(bodies, ws.EnvironmentMap.constant(1.0, height=16), camera)


def test_all_bounces_are_those_that_many_come_to():
    """In a room of albedo 0.8, also if it is given. At 0.7 "all" is 0.2% off and four bounces 4%."""
    scene, images = open_room(0.8), []
    for bounces in (4, 16, "all"):
        renderer = TorchRenderer(dataclasses.replace(scene, bounces=bounces))
        images.append(renderer().numpy()[..., :3])
    four, many, every = images
    assert relative_error(every, many) < 1e-2
    assert relative_error(four, many) > 3e-2
    given = renderer(albedo=[torch.full((1, 1, 3), 0.8) for _ in scene.bodies]).numpy()[..., :3]
    assert relative_error(given, many) < 1e-2


def test_a_white_room_in_a_white_furnace_is_white():
    """Measured 0.2% too dark, at worst 3.0%, in corners; by walls that send less than they block 14%, and 21%."""
    scene = dataclasses.replace(open_room(1.0, receivers="vertex"), bounces="all")
    shading = ws.Renderer(scene, progress=False).shade().numpy()
    assert shading.mean() == pytest.approx(1, abs=0.003)
    assert abs(shading - 1).max() < 0.033


def test_a_black_body_hides_what_is_behind_it():
    """A white ball behind a black one: measured 0.045 of the light without that."""
    gained = []
    for has_screen in (False, True):
        white = ws.Body(ws.icosphere(1.0, 2), (1, 1, 1), blockers=ws.Spheres([(0, 0, 0)], [1.0]), translation=(0, 8, 0))
        screen = dataclasses.replace(white, albedo=(0, 0, 0), translation=(0, 2.5, 0))
        ground = ws.Body(ws.plane(0.2, 2), (0.1, 0.1, 0.1), receivers="vertex")
        bodies, shadings = [white, screen, ground] if has_screen else [white, ground], []
        for bounces in (0, 1):
            light = ws.EnvironmentMap.constant(1.0, height=16)
            camera = ws.Camera.look_at((0, 1, 0.5), (0, 0, 0), size=(16, 16))
            renderer = ws.Renderer(ws.Scene(bodies, light, camera, bounces=bounces))
            shadings.append(renderer.shade().numpy().mean())
        gained.append(shadings[1] - shadings[0])
    assert gained[1] < 0.1 * gained[0]


def test_a_colored_ground_colors_what_stands_on_it():
    scene = bounced("directional", ON_BOTH, 1)
    red = dataclasses.replace(scene.bodies[1], albedo=(0.8, 0.0, 0.0))
    renderer = ws.Renderer(dataclasses.replace(scene, bodies=(scene.bodies[0], red)))
    direct = ws.Renderer(dataclasses.replace(renderer.scene, bounces=0)).shade().numpy()
    body = renderer.view().receivers.spans[0]
    gained = renderer.shade().numpy()[0, body.first : body.end].mean(axis=0) / direct[0].mean(axis=0)
    assert gained[0] > gained[1] + 0.05


# ---------------------------------------------------------------------------------------------- what runs


@pytest.mark.slow
def test_without_bounces_nothing_of_them_is_imported():
    script = (
        "import json, sys, warpshadow as ws;"
        "ball = ws.Body(ws.icosphere(1.0, 1), blockers=ws.Spheres([(0, 0, 0)], [1]), translation=(0, 1, 0));"
        "camera = ws.Camera.look_at((0, 2, 4), (0, 0, 0), size=(16, 16));"
        "scene = ws.Scene([ball, ws.Body(ws.plane(4.0, 2))], ws.EnvironmentMap.constant(1.0), camera);"
        "ws.render(scene);"
        "print(json.dumps([name for name in sys.modules if 'bounces' in name]))"
    )
    output = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert json.loads(output.splitlines()[-1]) == []


def test_black_bodies_send_nothing():
    scene = bounced("directional", ON_BOTH)
    black = [dataclasses.replace(body, albedo=(0, 0, 0)) for body in scene.bodies]
    dark = dataclasses.replace(scene, bodies=black)
    expected = ws.Renderer(dataclasses.replace(dark, bounces=0)).shade().numpy()
    renderer = ws.Renderer(dark)
    np.testing.assert_array_equal(np.sort(renderer.shade().numpy(), axis=1), np.sort(expected, axis=1))
    assert renderer.explain()["bounces"].forward.why == "every body is black"


def test_it_says_what_runs_for_bounces_and_what_does_not():
    renderer = ws.Renderer(bounced("directional", ON_BOTH))
    light = wp.zeros((1, renderer.basis.size), dtype=wp.vec3, requires_grad=True)
    explained = renderer.explain(light, geometry=renderer.placed())
    for name in ("self light", "plane light", "sphere light", "radiosity", "self light of patches"):
        assert explained[name].forward and explained[name].backward, name
    still = renderer.explain(light)
    for name in ("form factors", "transfer of patch samples", "bounces"):
        assert still[name].forward, name
    assert still["bounces"].backward and not still["form factors"].backward
    only = dataclasses.replace(renderer.scene, bodies=renderer.scene.bodies[:1])
    explained = ws.Renderer(only).explain()
    assert explained["plane light"].forward.why == "nothing flat reflects"
    ground = dataclasses.replace(renderer.scene, bodies=renderer.scene.bodies[1:])
    assert ws.Renderer(ground).explain()["self light"].forward.why == "all that reflects is flat"


def test_one_bounce_asks_for_no_light_between_bodies_patch_samples():
    explained = ws.Renderer(bounced("directional", ON_BOTH, 1)).explain()
    assert explained["self light of patches"].forward
    for name in ("plane light of patch samples", "sphere light of patch samples"):
        assert explained[name].forward.why == "light bounces once", name


@pytest.mark.parametrize("method", METHODS)
def test_receivers_lit_in_parts_are_lit_alike(method, monkeypatch):
    scene = bounced(method, ON_BOTH)
    whole = ws.Renderer(scene).shade().numpy()
    monkeypatch.setattr(groups, "RECEIVERS_AT_ONCE", 200)
    np.testing.assert_allclose(ws.Renderer(scene).shade().numpy(), whole, rtol=2e-5, atol=1e-6)


def bowl(receivers: str = "vertex", **options) -> ws.Body:
    """A ball's lower part, open above."""
    ball = ws.icosphere(0.8, 3)
    mesh = ws.Mesh(ball.positions, ball.faces[ball.positions[ball.faces].mean(axis=1)[:, 1] < 0.1])
    return ws.Body(mesh, blockers=0, translation=(0, 1, 0), receivers=receivers, **options)


def test_light_goes_on_within_a_bowl(monkeypatch):
    """As along paths that bounce as often, although it bounces once between bodies."""
    sky = ws.EnvironmentMap.constant(1.0, height=16)
    scene = ws.Scene([bowl(albedo=(0.8, 0.6, 0.4))], sky, ON_BOTH, ws.Visibility("directional"), bounces=1)
    paths = dataclasses.replace(
        scene, bounces=1 + static_bounces.SELF_BOUNCES, visibility=ws.Visibility("ray-traced", samples=4096)
    )
    expected, found = (ws.render(each)[..., :3].sum(axis=(0, 1)) for each in (paths, scene))
    np.testing.assert_allclose(found, expected, rtol=0.02)
    monkeypatch.setattr(moving_bounces, "SELF_BOUNCES", 0)
    once = ws.render(scene)[..., :3].sum(axis=(0, 1))
    assert once[0] < 0.9 * expected[0]


@pytest.mark.parametrize("receivers", ["vertex", "pixel"])
def test_receivers_at_pixels_and_backs_of_open_bodies_are_lit(receivers):
    """A bowl, seen from within and without."""
    ground = ws.Body(ws.plane(4.0, 8), blockers=1)
    sky = ws.EnvironmentMap.constant(1.0, height=16)
    scene = ws.Scene([bowl(receivers), ground], sky, ON_BOTH, ws.Visibility("directional"), bounces=2)
    direct, found = (ws.render(dataclasses.replace(scene, bounces=count)) for count in (0, 2))
    assert np.isfinite(found).all()
    assert (found - direct).min() > -1e-5
    assert (found - direct)[..., :3].max() > 0.05


@pytest.mark.parametrize("method", [*METHODS, "ray-traced"])
def test_it_says_how_often_and_how_light_bounces(method):
    scene = bounced(method, ON_BOTH)
    way = "along paths" if method == "ray-traced" else "between patches that may move"
    for bounces, times in ((0, None), (1, "1 time"), (2, "2 times")):
        explained = ws.Renderer(dataclasses.replace(scene, bounces=bounces)).explain()
        notes = [f"Light bounces {times}, {way}."] if times else []
        assert [note for note in explained.notes if "bounces" in note] == notes


@pytest.mark.parametrize("name", ["albedo", "textures"])
def test_reflectance_above_1_is_warned_of_where_light_bounces(name):
    scene = bounced("directional", ON_BOTH, directions=32)
    above = torch.full((4, 4, 3) if name == "textures" else (3,), 1.5)
    renderer = TorchRenderer(scene)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        renderer(**{name: {"plane": above.clamp(max=1.0)}})
        TorchRenderer(dataclasses.replace(scene, bounces=0))(**{name: {"plane": above}})
    with pytest.warns(UserWarning, match=rf"{name}\[1\]: got values above 1, with which light grows"):
        renderer(**{name: {"plane": above}})


# ---------------------------------------------------------------------------------------------- gradients


@pytest.mark.parametrize("blockers", [0, 1])
@pytest.mark.parametrize("method", METHODS)
def test_what_a_body_blocks_and_sends_moves_it(method, blockers):
    renderer = TorchRenderer(bounced(method, ON_GROUND, blockers=blockers))
    got, expected = gradient_and_differences(Poses(renderer), np.eye(7), 2e-3, slice(3))
    assert relative_error(got, expected) < SMOOTH


@pytest.mark.parametrize("method", METHODS)
def test_what_a_deforming_body_blocks_and_sends_moves_its_nodes(method):
    """And its vertices, by the patches that they carry."""
    assert error_along_nodes(TorchRenderer(bounced(method, ON_GROUND))) < SMOOTH


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("parameters", [Poses, Cameras])
def test_what_moves_an_image_with_bounces_has_its_gradient(method, parameters):
    renderer = TorchRenderer(bounced(method, ON_BOTH))
    got, expected = gradient_and_differences(parameters(renderer), np.eye(7), 4e-3, slice(4))
    assert relative_error(got, expected) < SILHOUETTE


class Shapes:
    """The image as a function of the vertices, the spheres' centers or their radii of the blob."""

    def __init__(self, renderer: TorchRenderer, name: str):
        body = renderer.scene.bodies[0]
        rest = {"positions": body.mesh.positions, "centers": body.blockers.centers, "radii": body.blockers.radii}
        self.renderer, self.name = renderer, name
        self.rest = {key: torch.tensor(value) for key, value in rest.items()}
        self.start = self.rest[name].flatten()

    def __call__(self, values: torch.Tensor) -> torch.Tensor:
        shape = self.rest | {self.name: values.reshape(self.rest[self.name].shape)}
        return self.renderer(
            geometry=self.renderer.placed(*self.renderer.scene_poses(), rest=self.renderer.deformed(0, **shape))
        )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["positions", "centers", "radii"])
@pytest.mark.parametrize("method", METHODS)
def test_vertices_and_spheres_have_the_gradient_of_what_they_send(method, name):
    """The camera sees the ground alone: of vertices it sees what patches send, and nothing else."""
    image_of, rng = Shapes(TorchRenderer(bounced(method, ON_GROUND)), name), np.random.default_rng(6)
    directions = rng.normal(size=(4, len(image_of.start)))
    if name == "positions":  # noise would turn each vertex's normal by itself
        points = image_of.start.reshape(-1, 3).numpy()
        directions = np.stack([np.sin(points @ turn + 1).ravel() for turn in 2 * rng.normal(size=(4, 3, 3))])
    got, expected = gradient_and_differences(image_of, directions, 5e-4, slice(3))
    assert relative_error(got, expected) < SOURCES


class Given:
    """The image as a function of light, of both albedos, of colors of vertices or of a texture.

    Bodies that do not move are lit by what is kept; a geometry that is given, though it is the scene's, by spheres.
    """

    def __init__(self, renderer: TorchRenderer, name: str, *, stands: bool = True):
        generator = torch.Generator().manual_seed(0)
        self.renderer, self.name = renderer, name
        self.geometry = None if stands else renderer.placed(*renderer.scene_poses())
        count = renderer.scene.bodies[0].mesh.vertex_count
        sizes = {"light": (renderer.basis.size, 3), "albedo": (2, 3), "colors": (count, 3), "texture": (9, 7, 3)}
        self.shape = sizes[name]
        self.start = torch.rand(self.shape, generator=generator).flatten()

    def __call__(self, values: torch.Tensor) -> torch.Tensor:
        values = values.reshape(self.shape)
        if self.name == "light":
            return self.renderer(values, geometry=self.geometry)
        if self.name == "albedo":
            return self.renderer(albedo=list(values), geometry=self.geometry)
        if self.name == "colors":
            return self.renderer(albedo=[values, None], geometry=self.geometry)
        return self.renderer(textures=[None, values], geometry=self.geometry)


@pytest.mark.parametrize("stands", [True, False], ids=["still", "moving"])
@pytest.mark.parametrize("name", ["light", "albedo", "colors", "texture"])
@pytest.mark.parametrize("method", METHODS)
def test_light_and_reflectance_have_the_gradient_of_an_image_with_bounces(method, name, stands):
    image_of = Given(on_both(method), name, stands=stands)
    directions = np.random.default_rng(5).normal(size=(4, len(image_of.start)))
    got, expected = gradient_and_differences(image_of, directions, 1e-2, slice(4))
    assert relative_error(got, expected) < 1e-4


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", ["light", "albedo"])
@pytest.mark.parametrize("still", [True, False])
def test_light_that_goes_on_within_a_bowl_has_its_gradient(method, name, still):
    """Of the image, a polynomial of albedo; where geometry is given, too."""
    scene = ws.Scene([bowl()], ws.EnvironmentMap.constant(1.0, height=16), ON_BOTH, ws.Visibility(method), bounces=1)
    renderer = TorchRenderer(scene)
    given = {} if still else {"geometry": renderer.placed(*renderer.scene_poses())}
    start = torch.full((renderer.basis.size, 3), 0.3) if name == "light" else torch.full((1, 3), 0.7)

    def image_of(values: torch.Tensor) -> torch.Tensor:
        values = values.reshape(start.shape)
        return renderer(values, **given) if name == "light" else renderer(albedo=[values], **given)

    image_of.start = start.flatten()
    directions = np.random.default_rng(6).normal(size=(3, start.numel()))
    got, expected = gradient_and_differences(image_of, directions, 1e-2, slice(4))
    assert relative_error(got, expected) < 1e-3


# ---------------------------------------------------------------------------------------------- batches


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_a_batch_with_bounces_is_its_instances_one_by_one(method):
    renderer = TorchRenderer(bounced(method, ON_BOTH, directions=64, order=4))
    values = random_batch(renderer, 2)
    together = {name: value.clone().requires_grad_() for name, value in values.items()}
    images = image_of_batch(renderer, together)
    weights = torch.randn(images.shape, generator=torch.Generator().manual_seed(1))
    (images * weights).sum().backward()
    for instance in range(2):
        alone = {name: value[instance : instance + 1].clone().requires_grad_() for name, value in values.items()}
        image = image_of_batch(renderer, alone)
        torch.testing.assert_close(image[0], images[instance], rtol=1e-5, atol=1e-6)
        (image[0] * weights[instance]).sum().backward()
        for name, value in alone.items():
            expected = together[name].grad[instance]
            assert (value.grad[0] - expected).abs().max() < 1e-4 * expected.abs().max(), name


@pytest.mark.parametrize("name", ["turns", "clip_matrices", "light", "albedo", "textures"])
def test_one_instance_of_anything_serves_all_with_bounces(name):
    renderer = TorchRenderer(bounced("directional", ON_BOTH, directions=32))
    varied = ["turns", "shifts"] if name == "turns" else [name]
    values = random_batch(renderer, 2)
    given = {key: value if key in varied else value[:1] for key, value in values.items()}
    images = image_of_batch(renderer, given)
    for instance in range(2):
        one = {key: value[instance : instance + 1] if key in varied else value for key, value in given.items()}
        torch.testing.assert_close(image_of_batch(renderer, one)[0], images[instance], rtol=1e-5, atol=1e-6)


# ---------------------------------------------------------------------------------------------- what does not move


@pytest.mark.parametrize("name", ["light", "albedo"])
@pytest.mark.parametrize("method", METHODS)
def test_what_bounces_between_bodies_that_stand_still_is_kept(method, name, monkeypatch):
    """Rays find form factors once, for nearly the image by spheres; nothing of geometry is computed again."""
    image_of = Given(on_both(method), name)
    renderer = image_of.renderer
    values = image_of.start.reshape(image_of.shape)
    given = {"light": values} if name == "light" else {"albedo": list(values)}
    with torch.no_grad():
        cached = image_of(image_of.start)
        anew = renderer(**given, geometry=renderer.placed(*renderer.scene_poses()))
        direct = TorchRenderer(dataclasses.replace(renderer.scene, bounces=0))(**given)
    assert relative_error(direct[..., :3].numpy(), anew[..., :3].numpy()) > 0.04
    assert relative_error(cached[..., :3].numpy(), anew[..., :3].numpy()) < 0.02

    def refuse(*_, **__):
        raise AssertionError("it is computed again")

    monkeypatch.setattr(static_form_factors, "trace_form_factors", refuse)
    monkeypatch.setattr(type(renderer.array_renderer._method), "find_visibility", refuse)
    monkeypatch.setattr(type(renderer.array_renderer._method), "find_visibility_past_planes", refuse)
    with torch.no_grad():
        assert torch.equal(image_of(image_of.start), cached)
        assert not torch.equal(image_of(0.5 * image_of.start), cached)


def image_and_gradient(renderer: TorchRenderer, name: str, values: torch.Tensor, geometry) -> tuple[torch.Tensor, ...]:
    """The image of a geometry in free light, or with free colors, and the gradient of its squares to these."""
    values = values.clone().requires_grad_()
    image = renderer(**{name: values if name == "light" else [values, None]}, geometry=geometry)
    image.square().sum().backward()
    return image.detach(), values.grad


@pytest.mark.parametrize(("method", "name"), [("directional", "light"), ("directional", "albedo"), ("log-sh", "light")])
def test_a_geometry_given_again_is_not_seen_again_where_light_bounces(method, name, monkeypatch):
    """Other light and colors meet what is kept: images and gradients are those of a new renderer, to the bit."""
    scene = bounced(method, ON_BOTH, blockers=1, directions=32, order=4)
    renderer, fresh = TorchRenderer(scene), TorchRenderer(scene)
    geometry = renderer.placed(*renderer.scene_poses())
    start = torch.full((renderer.basis.size, 3) if name == "light" else (1, 3), 0.4)
    image_and_gradient(renderer, name, start, geometry)

    def refuse(*_, **__):
        raise AssertionError("it is seen again")

    with monkeypatch.context() as patch:
        for function in ("find_visibility", "find_visibility_past_planes", "find_transfer", "self_lookups"):
            patch.setattr(type(renderer.array_renderer._method), function, refuse)
        patch.setattr(moving_bounces, "find_cell_transmittance", refuse)
        patch.setattr(patches, "receivers_on_faces", refuse)
        found = image_and_gradient(renderer, name, 2 * start, geometry)
        explained = renderer.explain(**{name: 2 * start if name == "light" else [2 * start, None]}, geometry=geometry)
    assert all(map(torch.equal, found, image_and_gradient(fresh, name, 2 * start, geometry)))
    last_cached = "transfer" if name == "light" else "shading"  # known light is shaded once
    for stage in (
        "patch samples",
        "visibility of patch samples",
        f"{last_cached} of patch samples",
        "visibility",
        last_cached,
    ):
        assert explained[stage].forward.why.startswith("cached: "), stage
    assert explained["plane light"].forward
    if name == "light":
        assert explained["shading"].forward
    moved = geometry.map(lambda array: array.clone())
    moved.positions[:, :5] += 0.1
    moved.radii[:] *= 0.8
    again, anew = (image_and_gradient(each, name, start, moved) for each in (renderer, TorchRenderer(scene)))
    assert all(map(torch.equal, again, anew)) and not torch.equal(again[0], found[0])
    moved.radii[:] *= 0.8  # in place
    again, anew = (image_and_gradient(each, name, start, moved) for each in (renderer, TorchRenderer(scene)))
    assert all(map(torch.equal, again, anew))


def test_transfer_vectors_are_refused_where_light_bounces():
    renderer = ws.Renderer(bounced("directional", ON_BOTH))
    with pytest.raises(
        ValueError, match=r"scene\.bounces: got 2, expected 0 for transfer vectors.* shade and draw take"
    ):
        renderer.transfer()


@pytest.mark.parametrize("method", METHODS)
def test_a_flat_body_is_not_bent_where_light_bounces(method):
    renderer = ws.Renderer(bounced(method, ON_BOTH, blockers=1))
    bent = renderer.scene.bodies[1].mesh.positions[None].copy()
    bent[..., 1] += 0.2 * bent[..., 0] ** 2
    bent = wp.array(bent, dtype=wp.vec3)
    with pytest.raises(ValueError, match=r"positions: got some for body 1 \('plane'\), which is flat; expected None"):
        renderer.deformed(1, bent)
    renderer.deformed(1, radii=renderer.rest().radii[:, -1:])
    ws.Renderer(dataclasses.replace(renderer.scene, bounces=0)).deformed(1, bent)


# ---------------------------------------------------------------------------------------------- as anything else runs


def test_bodies_that_stand_among_moving_ones_are_lit_as_if_they_moved():
    """With bounces nothing is kept of what stands: images are the same, and so are gradients to what moves."""
    renderer = TorchRenderer(bounced("directional", ON_GROUND, blockers=1, directions=32))
    images, gradients = [], []
    for moving in ([0], None):
        turns = torch.full((2, 3), 0.1, requires_grad=True)
        rotations, translations, scales = renderer.scene_poses()
        rotations = torch.cat([rotation_matrices(turns[:1]) @ rotations[:1], rotations[1:]])
        image = renderer(geometry=renderer.placed(rotations, translations, scales, moving=moving))
        image.square().sum().backward()
        images.append(image.detach())
        gradients.append(turns.grad)
    torch.testing.assert_close(*images, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(*gradients, rtol=1e-3, atol=1e-3 * float(gradients[1].abs().max()))
    assert gradients[1][0].any()


def test_threads_share_a_renderer_of_light_that_bounces():
    renderer = ws.Renderer(bounced("directional", ON_BOTH, directions=32))
    black = {0: wp.zeros((1, 1), dtype=wp.vec3)}
    expected = [ws.Renderer(renderer.scene).draw(albedo=given).numpy() for given in (None, black)] * 2
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(lambda given: renderer.draw(albedo=given).numpy(), [None, black] * 2))
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_two_threads_at_once_find_the_images_and_gradients_that_one_finds(method):
    scene = bounced(method, ON_BOTH, directions=32, order=4)

    def found(shift: float) -> list[torch.Tensor]:
        image_of = Poses(TorchRenderer(scene))
        values = torch.full((7,), shift, requires_grad=True)
        images = [image_of(values) for _ in range(3)]
        sum(image.square().sum() for image in images).backward()
        return [*(image.detach() for image in images), values.grad]

    shifts = [0.0, 0.05]
    expected = [found(shift) for shift in shifts]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(found, shifts))
    for one, other in zip(together, expected, strict=True):
        assert all(map(torch.equal, one[:3], other[:3]))
        torch.testing.assert_close(one[3], other[3], rtol=1e-4, atol=1e-4 * float(other[3].abs().max()))
    assert not torch.equal(expected[0][0], expected[1][0])
