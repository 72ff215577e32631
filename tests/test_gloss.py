"""Bodies that shine, as a whole: images, and gradients of images against central differences of them."""

import dataclasses
import functools

import numpy as np
import pytest
import torch
import trimesh
import twins
import warp as wp

import warpshadow as ws
from warpshadow import inverse
from warpshadow.inverse.uncertainty import NormalMatrix
from warpshadow.maths import sh
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.bounces import static_form_factors
from warpshadow.pipeline.methods.directional import Directional
from warpshadow.pipeline.shading import lobe_light
from warpshadow.pipeline.shading.lobe_light import LobeVisibility
from warpshadow.torch import TorchRenderer, rotation_matrices

# Interpolation between texels is linear piece by piece, and steps of differences go over some. Measured 0.1 to 1.2%.
SMOOTH = 2e-2

# Gradients of an image of 32² pixels along a path. Measured 2.5 to 6.4%, and 19 to 69% with slopes at points alone.
OUTLINES = 0.12

# Of an image of 32² pixels of 2 × 2 samples under a sun. Measured 2.4% of plastic, 0.5 and 5.1% of metal of roughness
# 0.4 and 0.2; 31% and 284% where samples on a face share a receiver, and 4.0, 8.1 and 5.8% where normals vary over a
# pixel as it lies in the plane of its face.
SUN = 0.06

# Of metals that mirror each other: what they mirror is a constant of poses. Measured 22%, and 161% with outlines fixed.
OF_METALS = 0.35

# Of a highlight that is a sample off a limb. Measured 18%, and 52% with mean slopes up to one sample from outlines.
LIMB = 0.3

SKY = ws.synthetic_sky((-0.7, 0.5, 0.2), sun_radius=12, sun_strength=3, height=32)
BALL = ws.Body(
    ws.icosphere(1.0, 3),
    albedo=(0.8, 0.5, 0.3),
    blockers=ws.Spheres([(0, 0, 0)], [0.97]),
    translation=(0, 1.0, 0),
    roughness=0.4,
    metallic=0.6,
    name="ball",
)
GROUND = ws.Body(ws.plane(6.0, 8), albedo=(0.3, 0.5, 0.6), name="ground", receivers="pixel")
POST = ws.Body(
    ws.icosphere(0.4, 2), blockers=ws.Spheres([(0, 0, 0)], [0.39]), translation=(-1.3, 0.9, 0.9), name="post"
)


GROUND_ROWS = slice(25, 32)  # of images of :func:`scene_of`, which show nothing else


def scene_of(*bodies, **options):
    camera = ws.Camera.look_at((0.5, 2.2, 4.6), (0, 0.9, 0), size=(32, 32))
    return ws.Scene(bodies or (BALL, GROUND, POST), SKY, camera, supersampling=1, **options)


NEAR = ws.Camera.look_at((0.3, 1.6, 2.6), (0, 1.0, 0), fov_y=20, size=(32, 32))
"""Sees no silhouette: those of diffuse bodies have the same gradient."""


def weights():
    row, column = np.mgrid[0:1:32j, 0:1:32j]
    return torch.tensor(np.stack([np.sin(3 * row + 2 * column), np.cos(2 * row), 1 + column, 0 * row], -1)).float()


def test_a_diffuse_scene_makes_the_same_launches_and_bits_beside_no_gloss():
    plain = dataclasses.replace(BALL, roughness=None, metallic=None)
    renderer = ws.Renderer(scene_of(plain, GROUND))
    renderer.render()
    assert "gloss" not in str(renderer.explain()) and "lobes" not in str(renderer.explain())


def test_shadows_in_known_light_are_found_once_for_diffuse_light_and_gloss():
    light = np.full((1, 32), 0.5)
    basis, visibility = ws.CellBasis(ws.fibonacci(32)), ws.Visibility(directions=32)
    renderer = TorchRenderer(scene_of(visibility=visibility), basis=basis, progress=False)
    free = torch.tensor(np.repeat(light[..., None], 3, axis=2)).float()
    assert "visibility of gloss" not in str(renderer.explain())
    assert "visibility of gloss" in str(renderer.explain(free))


def test_shadows_in_light_that_a_call_gives_are_found_once_for_diffuse_light_and_gloss(monkeypatch):
    groups, find = [], Directional.find_visibility
    monkeypatch.setattr(
        Directional,
        "find_visibility",
        lambda self, group, light: groups.append(group.points) or find(self, group, light),
    )
    renderer = ws.Renderer(scene_of())
    renderer.render()
    count = len(groups)
    renderer.render(ws.EnvironmentMap.constant())
    assert len(groups) == 2 * count


@pytest.mark.parametrize("bounces", [0, 1])
def test_an_explanation_changes_no_later_call(bounces):
    other, renderer = ws.EnvironmentMap.constant(), ws.Renderer(scene_of(bounces=bounces))
    image, before = renderer.render(), str(renderer.explain())
    assert str(renderer.explain(light=other)) != before
    assert str(renderer.explain()) == before
    np.testing.assert_array_equal(renderer.render(), image)
    np.testing.assert_array_equal(renderer.render(other), ws.Renderer(scene_of(bounces=bounces)).render(other))


@pytest.mark.parametrize("sampling", ["independent", "shared"])
def test_rays_light_the_blockers_of_lobes_again_after_other_light(sampling):
    visibility = ws.Visibility("ray-traced", samples=64, sampling=sampling)
    renderer = ws.Renderer(scene_of(bounces=1, visibility=visibility))
    image = renderer.render()
    renderer.render(ws.EnvironmentMap.constant())
    np.testing.assert_array_equal(renderer.render(), image)


def test_explanations_and_photographs_take_gloss():
    """In a photograph the ball is as rough as in a scene that says so; a call that gives it samples its lobes again."""
    caught = dataclasses.replace(GROUND, shadow_catcher=True)
    given = {name: {"ball": torch.tensor(value)} for name, value in (("roughness", 0.7), ("metallic", 0.1))}
    photograph = torch.full((32, 32, 3), 0.5)
    renderer = TorchRenderer(scene_of(BALL, caught), progress=False)
    image, plain = renderer.insert(photograph, **given), renderer.insert(photograph)
    rough = TorchRenderer(scene_of(dataclasses.replace(BALL, roughness=0.7, metallic=0.1), caught), progress=False)
    torch.testing.assert_close(image, rough.insert(photograph))
    assert (image - plain).abs().max() > 0.01
    renderer()
    assert not renderer.explain()["lobes"].forward and renderer.explain(**given)["lobes"].forward


def test_a_rough_dielectric_without_specular_is_diffuse():
    """All that differs is that its receivers are pixels."""
    plain = dataclasses.replace(BALL, roughness=None, metallic=None, receivers="pixel")
    dull = dataclasses.replace(BALL, specular=0.0, metallic=0.0)
    images = [ws.Renderer(scene_of(body, GROUND, POST)).render() for body in (plain, dull)]
    np.testing.assert_allclose(*images, atol=1e-6)


@pytest.mark.parametrize("roughness", [0.2, 0.6, 1.0])
def test_a_white_metal_in_a_white_furnace_loses_what_single_scattering_loses(roughness):
    """Measured at roughness 0.2, 0.6 and 1: 0.1%, 20.2% and 61.8%, of a ball seen from nearby."""
    metal = dataclasses.replace(BALL, albedo=(1, 1, 1), roughness=roughness, metallic=1.0, blockers=0)
    image = ws.Renderer(dataclasses.replace(scene_of(metal), light=ws.EnvironmentMap.constant(1.0))).render()
    cosines = np.sqrt((np.arange(16) + 0.5) / 16)  # of a ball far away, each as often
    expected = 1 - np.mean([twins.lobe_energy(cosine, roughness)[0] for cosine in cosines])
    got = 1 - image[image[..., 3] == 1, :3].mean()
    assert got == pytest.approx(expected, abs=0.03)


@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_stills_and_renderers_show_the_same_gloss(metallic):
    body = dataclasses.replace(BALL, metallic=metallic)
    kept, still = ws.Renderer(scene_of(body, GROUND, POST)).render(), ws.render(scene_of(body, GROUND, POST))
    assert np.linalg.norm(kept - still) < 0.06 * np.linalg.norm(still)


SUNNY = dataclasses.replace(
    scene_of(dataclasses.replace(BALL, mesh=ws.icosphere(1.0, 4), roughness=0.2, metallic=1.0)),
    light=ws.synthetic_sky((0.3, 0.6, 0.8)),
    camera=NEAR,
    supersampling=2,
)


def test_the_highlight_of_a_sun_is_that_of_many_samples_of_lobes(monkeypatch):
    image = ws.Renderer(SUNNY).render()[..., :3]
    monkeypatch.setattr(LobeVisibility, "_separated", lambda *_: None)
    monkeypatch.setattr(LobeVisibility, "sample_count", 4 * 2048)
    many = ws.Renderer(SUNNY).render()[..., :3]
    # measured 2.1%; 16% where samples look for the sun, as many as there are
    assert np.linalg.norm(image - many) < 0.03 * np.linalg.norm(many)


def test_explanations_look_for_no_suns_and_a_map_is_searched_once(monkeypatch):
    find, maps = lobe_light.separate_suns, []
    monkeypatch.setattr(lobe_light, "separate_suns", lambda radiance: maps.append(radiance) or find(radiance))
    constant = ws.EnvironmentMap.constant(1.0)
    renderer, other = ws.Renderer(dataclasses.replace(scene_of(), light=constant)), ws.synthetic_sky()
    renderer.explain(light=other)
    assert not maps
    for _ in range(2):
        renderer.draw(other)
    assert len(maps) == 1


@pytest.mark.parametrize("method", ["directional", "none", "ray-traced"])
def test_light_without_suns_and_images_without_bodies_that_shine_are_drawn(method):
    away = dataclasses.replace(BALL, translation=(0, 50, 0))
    for body, light in ((BALL, ws.EnvironmentMap.constant(1.0)), (away, ws.synthetic_sky())):
        scene = dataclasses.replace(scene_of(body, GROUND), light=light, visibility=ws.Visibility(method=method))
        image = ws.render(scene)
        assert np.isfinite(image).all() and image.any()


def test_gradients_to_the_roughness_of_a_smooth_metal_under_a_sun_agree_with_differences():
    renderer, image = TorchRenderer(SUNNY, progress=False), weights()

    def loss(value):
        return (renderer(roughness={"ball": value}).double() * image).sum()

    for roughness in (0.12, 0.2):
        gradient, difference = twins.slopes(loss, torch.tensor([roughness]), 3e-3)
        assert gradient == pytest.approx(difference, rel=SMOOTH)


def test_in_stills_samples_of_different_faces_of_a_body_that_shines_share_no_receiver():
    """Their normals differ by more than a lobe is wide; those of the diffuse post share."""
    merged_scene = MergedScene(scene_of(BALL, POST))
    ball, post = np.split(merged_scene.smooth_pieces.numpy(), merged_scene.first_face[1:-1])
    assert len(np.unique(ball)) == len(BALL.mesh.faces) and len(np.unique(post)) == 1
    assert not np.isin(post, ball).any()


@pytest.mark.parametrize("name", ["roughness", "metallic", "specular"])
def test_gradients_to_gloss_agree_with_differences(name):
    renderer, image = TorchRenderer(scene_of(), progress=False), weights()

    def loss(value):
        return (renderer(**{name: {"ball": value}}) * image).sum()

    # 0.6: at other roughness differences of this sum, which has terms of either sign, have kinks of up to 8%, between
    # texels of prefiltered light
    gradient, difference = twins.slopes(loss, torch.tensor([0.6]), 3e-3)
    assert gradient == pytest.approx(difference, rel=SMOOTH)


@pytest.mark.parametrize("options", [{"roughness": 0.2}, {"roughness": 0.2, "metallic": 0.0}, {"roughness": None}])
def test_gradients_along_a_path_are_the_change_of_the_image_although_outlines_are_in_view(options):
    """Sums over eighths of an image, whose change is that of an image of 8 × 8 samples a pixel."""
    if options["roughness"] is None:
        options = {"roughness": None, "metallic": None, "receivers": "pixel"}
    height, azimuth = np.mgrid[0.2:1.5:32j, 0 : 2 * np.pi * 63 / 64 : 64j]
    light = ws.EnvironmentMap(np.repeat((height * (1 + 0.8 * np.cos(azimuth)))[..., None], 3, axis=2))
    visibility = ws.Visibility("none")
    scene = dataclasses.replace(scene_of(dataclasses.replace(BALL, **options), visibility=visibility), light=light)
    row, column = np.mgrid[-14:18, -16:16]
    eighths = torch.tensor((np.arctan2(row, column) // (np.pi / 4))[None] == np.arange(-4, 4)[:, None, None]).float()

    def sums(renderer, shifts):
        rotations, translations, scales = renderer.scene_poses()
        moved = translations + shifts[:, None, None] * torch.tensor([0.958, 0.287, 0.0])
        image = renderer(geometry=renderer.placed(rotations, moved, scales))
        return torch.einsum("ehw,bhw->eb", eighths, image[..., 0])

    shifts = (0.3 * (torch.arange(64) + 0.5) / 64).requires_grad_(True)
    values = sums(TorchRenderer(scene, progress=False), shifts)
    gradients = [torch.autograd.grad(value.sum(), shifts, retain_graph=True)[0].mean() * 0.3 for value in values]
    with torch.no_grad():
        fine = TorchRenderer(dataclasses.replace(scene, supersampling=8), progress=False)
        start, end = sums(fine, torch.tensor([0.0, 0.3])).T
    error = torch.linalg.norm(torch.stack(gradients) - (end - start)) / torch.linalg.norm(end - start)
    assert error < OUTLINES


@pytest.mark.parametrize(("metallic", "roughness"), [(0.0, 0.4), (1.0, 0.4), (1.0, 0.2)])
def test_gradients_along_a_path_are_the_change_of_the_image_although_a_sun_shines_on_large_faces(metallic, roughness):
    ball = ws.Body(
        ws.icosphere(0.4, 3),
        albedo=(0.8, 0.5, 0.3),
        blockers=ws.Spheres([(0, 0, 0)], [0.4]),
        roughness=roughness,
        metallic=metallic,
    )
    camera = ws.Camera.look_at((0.3, 1.2, 2.2), (0, 0.3, 0), fov_y=45, size=(32, 32))
    scene = ws.Scene([ball.on_ground()], ws.synthetic_sky(), camera, supersampling=2)
    renderer, image_weights, path = TorchRenderer(scene, progress=False), weights(), torch.tensor([0.12, 0.0, 0.048])
    rotations, translations, scales = renderer.scene_poses()

    def losses(shares):
        moved = translations + shares[:, None, None] * path
        images = renderer(geometry=renderer.placed(rotations, moved, scales))
        return torch.stack([(images * image_weights**k).sum((1, 2, 3)) for k in (1, 2)])

    gradient = torch.zeros(2)
    for shares in ((torch.arange(192) + 0.5) / 192).split(32):
        shares.requires_grad_(True)
        for k, loss in enumerate(losses(shares)):
            gradient[k] += torch.autograd.grad(loss.sum(), shares, retain_graph=True)[0].sum() / 192
    start, end = losses(torch.tensor([0.0, 1.0])).T
    error = torch.linalg.norm(gradient - (end - start)) / torch.linalg.norm(end - start)
    assert error < SUN


def test_gradients_at_the_limb_of_a_metal_that_hides_the_sun_are_on_average_the_slopes_of_the_image():
    """The highlight is about a sample wide, and a sample off the limb, above the middle: it moves along and across."""
    ball = ws.Body(ws.icosphere(0.4, 4), albedo=(0.9, 0.7, 0.3), roughness=0.3, metallic=1.0)
    sun = ws.synthetic_sky((0.2, 0.5, -1), sun_radius=2, sun_strength=3, height=64)
    size, half_width = 48, 0.03  # of the square in which the ball is moved: three pixels of 0.02
    camera = ws.Camera.look_at((0, 0, 3), (0, 0, 0), fov_y=18, size=(size, size))
    scene = ws.Scene([ball], sun, camera, supersampling=1)
    renderer, rng = TorchRenderer(scene, progress=False), np.random.default_rng(0)
    rotations, translations, scales = renderer.scene_poses()
    rows, columns = torch.meshgrid(torch.linspace(-1, 1, size), torch.linspace(-1, 1, size), indexing="ij")
    image_weights = (1 + 0.5 * columns + 0.3 * rows)[..., None]

    def losses(places):
        shifts = torch.nn.functional.pad(places, (0, 1))[:, None]
        images = renderer(geometry=renderer.placed(rotations, translations + shifts, scales))
        return (images[..., :3] * image_weights).sum((1, 2, 3))

    squares = np.mgrid[0:12, 0:12].reshape(2, -1).T  # each with a place
    places = torch.tensor(half_width * ((squares + rng.uniform(size=squares.shape)) / 6 - 1), dtype=torch.float32)
    gradient, slope = torch.zeros(2), torch.zeros(2)
    for some in places.split(24):
        some.requires_grad_(True)
        gradient += torch.autograd.grad(losses(some).sum(), some)[0].sum(0) / len(places)
        for axis in range(2):
            ends = some.detach().repeat(2, 1)
            ends[: len(some), axis], ends[len(some) :, axis] = half_width, -half_width
            above, below = losses(ends).reshape(2, -1).sum(1) / len(places)
            slope[axis] += (above - below) / (2 * half_width)
    assert torch.linalg.norm(gradient - slope) < LIMB * torch.linalg.norm(slope), (gradient, slope)


@pytest.mark.parametrize("render", [ws.render, lambda scene: ws.Renderer(scene).render()])
def test_a_metal_reflects_the_ground_where_light_bounces(render):
    """In a white furnace a smooth white metal on a white ground is nearly white; direct light leaves it 13% darker."""
    metal, ground = (dataclasses.replace(body, albedo=(1, 1, 1)) for body in (BALL, GROUND))
    metal = dataclasses.replace(metal, roughness=0.2, metallic=1.0)
    scene = dataclasses.replace(scene_of(metal, ground), light=ws.EnvironmentMap.constant(1.0), camera=NEAR)
    direct, bounced = (render(dataclasses.replace(scene, bounces=count))[..., :3].mean() for count in (0, "all"))
    assert direct < 0.9 and 0.95 < bounced < 1.03


@pytest.mark.parametrize("render", [ws.render, lambda scene: ws.Renderer(scene).render()])
def test_a_metal_that_a_metal_mirrors_shows_the_sky_that_it_mirrors(render):
    """A corner of two mirrors sends the light from behind the viewer back; diffuse patches would send two fifths."""
    color, options = np.array([0.9, 0.6, 0.3]), {"roughness": 0.2, "metallic": 1.0}
    ground = ws.Body(ws.plane(4.0, 8), color, name="ground", **options)
    wall = ws.Body(ws.plane(4.0, 8), color, rotation=(90, 0, 0), translation=(0, 2, -2), name="wall", **options)
    is_bright = sh.equirectangular_directions(32) @ np.array([0, 1, 1]) / np.sqrt(2) > np.cos(np.radians(40))
    light = ws.EnvironmentMap(np.where(is_bright[..., None], 2.0, 0.05).astype(np.float32).repeat(3, axis=2))
    camera = ws.Camera.look_at((0, 5, 3.5), (0, 0, -1.5), fov_y=4, size=(8, 8))
    image = render(ws.Scene([ground, wall], light, camera, bounces=2))[..., :3]
    np.testing.assert_allclose(image.mean(axis=(0, 1)), 2.0 * color**2, rtol=0.05)


def test_near_light_that_a_metal_mirrors_for_another_comes_from_where_the_first_stands():
    """A stripe of light is beside where a ray from the wall meets the shell, and where one from the ground would."""
    options = {"albedo": (1.0, 1.0, 1.0), "roughness": 0.1, "metallic": 1.0}
    ground = ws.Body(ws.plane(3.0), **options)
    wall = ws.Body(ws.plane(3.0), rotation=(0, 0, 90), translation=(1.5, 1.5, 0), **options)
    camera = ws.Camera.look_at((-5, 2.5, 0), (0, 0, 0), fov_y=2, size=(4, 4))
    direction, hit, radius = np.array([-2, 1, 0]) / np.sqrt(5), np.array([1.5, 0.75, 0]), 4.0
    along = hit @ direction
    exits = hit + (np.sqrt(along**2 - hit @ hit + radius**2) - along) * direction
    is_bright = sh.equirectangular_directions(64) @ exits / radius > np.cos(np.radians(8))
    radiance = np.where(is_bright[..., None], 2.0, 0.0).astype(np.float32).repeat(3, axis=2)
    light = ws.EnvironmentMap(radiance, radius=radius)
    image = ws.render(ws.Scene([ground, wall], light, camera, bounces=2))[..., :3]
    np.testing.assert_allclose(image.mean(axis=(0, 1)), 2.0, rtol=0.05)


METAL = ws.Body(
    ws.icosphere(0.5, 3), (0.9, 0.6, 0.3), blockers=ws.Spheres([(0, 0, 0)], [0.5]), roughness=0.3, metallic=1.0
)
METALS = tuple(dataclasses.replace(METAL, translation=(x, 0.5, 0), name=f"at {x}") for x in (-0.55, 0.55))


def metal_scene(*bodies):
    camera = ws.Camera.look_at((0, 1.2, 2.6), (0, 0.45, 0), fov_y=25, size=(24, 24))
    return ws.Scene(bodies, SKY, camera, supersampling=2, bounces=1, visibility=ws.Visibility(directions=64))


def by_paths(scene):
    return ws.render(dataclasses.replace(scene, visibility=ws.Visibility("ray-traced", samples=64)))


@pytest.mark.parametrize("render", [ws.render, lambda scene: ws.Renderer(scene).render(), by_paths])
def test_a_metal_mirrors_a_red_and_a_blue_ball_each_in_its_place(render):
    """By the mean radiance of blockers red would be less than twice blue."""
    colors, positions = ((0.8, 0.1, 0.1), (0.1, 0.1, 0.8)), ((-0.5, 0, 1), (0.5, 0, 1))
    balls = [
        ws.Body(ws.icosphere(0.45, 3), color, translation=position)
        for color, position in zip(colors, positions, strict=True)
    ]
    wall = ws.Body(ws.plane(4.0), (1, 1, 1), rotation=(90, 0, 0), roughness=0.1, metallic=1.0)
    camera = ws.Camera.look_at((-0.5, 2, 2.5), (-0.5, 0.571, 0), fov_y=4, size=(8, 8))
    image = render(ws.Scene([*balls, wall], ws.EnvironmentMap.constant(1.0), camera, bounces=1))[..., :3]
    red, _, blue = image.mean(axis=(0, 1))
    assert red > 5 * blue


@pytest.mark.parametrize("render", [ws.render, lambda scene: ws.Renderer(scene).render(), by_paths])
def test_a_metal_mirrors_a_red_and_a_blue_part_of_a_floor_each_in_its_place(render):
    """The floor is one face in each half of its texture, and its mean radiance is as red as blue."""
    texture = np.repeat(np.array([[[0.8, 0.1, 0.1], [0.1, 0.1, 0.8]]], np.float32), 32, axis=1).repeat(64, axis=0)
    floor = ws.Body(ws.plane(4.0), texture=texture, name="floor")
    wall = ws.Body(ws.plane(4.0), (1, 1, 1), rotation=(90, 0, 0), translation=(0, 0, -2), roughness=0.1, metallic=1.0)
    camera = ws.Camera.look_at((-1, 2, 2.5), (-1, 0.5, -2), fov_y=4, size=(8, 8))
    image = render(ws.Scene([floor, wall], ws.EnvironmentMap.constant(1.0), camera, bounces=1))[..., :3]
    red, _, blue = image.mean(axis=(0, 1))
    assert red > 3 * blue


@pytest.mark.parametrize("render", [ws.render, lambda scene: ws.Renderer(scene).render(), by_paths])
def test_a_metal_shows_what_a_metal_in_it_mirrors(render):
    """A periscope, whose upper mirror sees a red ball alone; the lower one is lit as much by a blue one."""
    mirrors = [
        ws.Body(ws.plane(2.0), (1, 1, 1), rotation=(angle, 0, 0), translation=(0, y, 0), roughness=0.1, metallic=1.0)
        for angle, y in ((45, 0), (135, 2))
    ]
    balls = [
        ws.Body(ws.icosphere(0.6, 3), color, translation=position)
        for color, position in (((0.8, 0.1, 0.1), (0, 2, 3)), ((0.1, 0.1, 0.8), (0, 3, 2)))
    ]
    camera = ws.Camera.look_at((0, 0, 5), (0, 0, 0), fov_y=4, size=(8, 8))
    image = render(ws.Scene([*balls, *mirrors], ws.EnvironmentMap.constant(1.0), camera, bounces=1))[..., :3]
    red, _, blue = image.mean(axis=(0, 1))
    assert red > 3 * blue


@pytest.mark.parametrize("render", [ws.render, lambda scene: ws.Renderer(scene).render(), by_paths])
def test_a_black_body_that_shines_lights_the_ground_as_a_gray_one_of_its_total_reflectance(render):
    """Of 7.3% at roughness 0.3."""
    black, gray, dull = (
        dataclasses.replace(BALL, albedo=(albedo,) * 3, specular=specular, roughness=0.3, metallic=0.0)
        for albedo, specular in ((0.0, 1.0), (0.073, 0.0), (0.0, 0.0))
    )
    scenes = [scene_of(ball, GROUND, bounces=1) for ball in (black, gray, dull)]
    of_black, of_gray, of_dull = (render(scene)[GROUND_ROWS] for scene in scenes)
    brighter = (of_gray - of_dull).max()
    assert brighter > 0.01 * of_dull.max()
    np.testing.assert_allclose(of_black, of_gray, atol=0.02 * brighter)


@pytest.mark.parametrize("name", ["roughness", "metallic", "specular", "albedo"])
def test_gradients_to_a_body_that_lights_a_ground_agree_with_differences(name):
    scene = scene_of(bounces=1)
    renderer, image = TorchRenderer(scene, progress=False), weights()

    def loss(value):
        return (renderer(**{name: {"ball": value}}) * image)[0, GROUND_ROWS].sum()

    gradient, difference = twins.slopes(loss, torch.full((1, 3) if name == "albedo" else (1,), 0.6), 3e-2)
    assert gradient == pytest.approx(difference, rel=SMOOTH)


@pytest.mark.parametrize("render", [ws.render, lambda scene: ws.Renderer(scene).render(), by_paths])
def test_a_metal_mirrors_no_body_that_blocks_no_light(render):
    """A green sheet above a red floor, which the metal shows through it."""
    floor = ws.Body(ws.plane(4.0), (0.8, 0.1, 0.1), name="floor")
    sheet = ws.Body(ws.plane(4.0), (0.1, 0.8, 0.1), translation=(0, 0.3, 0), blockers=0, name="sheet")
    wall = ws.Body(ws.plane(4.0), (1, 1, 1), rotation=(90, 0, 0), translation=(0, 0, -2), roughness=0.1, metallic=1.0)
    camera = ws.Camera.look_at((-1, 2, 2.5), (-1, 0.5, -2), fov_y=4, size=(8, 8))
    image = render(ws.Scene([floor, sheet, wall], ws.EnvironmentMap.constant(1.0), camera, bounces=1))[..., :3]
    red, green, _ = image.mean(axis=(0, 1))
    assert red > 3 * green


def test_metals_that_mirror_bodies_along_paths_take_no_batch_of_geometries():
    renderer = TorchRenderer(dataclasses.replace(metal_scene(METAL, GROUND), visibility=ws.Visibility("ray-traced")))
    poses = [torch.stack([values, values]) for values in renderer.scene_poses()]
    with pytest.raises(ValueError, match="geometry: got a batch of 2 .* or bodies of metal, expected one"):
        renderer(geometry=renderer.placed(*poses))


def test_gradients_to_the_color_of_a_body_that_a_metal_mirrors_agree_with_differences():
    ball = ws.Body(METAL.mesh, (0.7, 0.5, 0.4), blockers=METAL.blockers, translation=(0.55, 0.5, 0))
    renderer = TorchRenderer(metal_scene(METALS[0], ball, GROUND), progress=False)
    value, image = torch.tensor([[0.7, 0.5, 0.4]]), weights()[:24, :24]
    gradient, difference = twins.slopes(lambda color: (renderer(albedo={1: color}).double() * image).sum(), value, 3e-3)
    assert gradient == pytest.approx(difference, rel=SMOOTH)


def test_lobes_are_traced_where_metals_and_smooth_bodies_mirror_bodies():
    """One convex metal alone mirrors none; nor do rough plastics."""
    torus = trimesh.creation.torus(0.4, 0.15)
    ring = dataclasses.replace(METALS[0], mesh=ws.Mesh(torus.vertices, torus.faces), blockers=16)
    plastic = dataclasses.replace(METALS[1], metallic=0.0)
    for bodies, traces in (
        ((METALS[0],), False),
        ((METALS[0], GROUND), True),
        ((ring,), True),
        ((*METALS, GROUND), True),
        ((METALS[0], plastic, GROUND), True),
        ((dataclasses.replace(ring, metallic=0.0, roughness=0.4), GROUND), False),
        ((dataclasses.replace(ring, metallic=0.0, roughness=0.2), GROUND), True),
    ):
        renderer = ws.Renderer(metal_scene(*bodies))
        assert ("hits of lobes" in str(renderer.explain())) == traces


def test_metals_mirror_metals_where_poses_put_them():
    """A mesh that is refitted to one pose after another has the hits of one that is made there."""
    scene, steps, sizes = metal_scene(*METALS, GROUND), [[0.0, 0, 0], [0.4, 0.3, -0.5], [0.1, -0.1, 0.3]], [1, 1, 0.7]
    renderer, is_moved = TorchRenderer(scene, progress=False), torch.tensor([0.0, 1.0, 0.0])
    rotations, translations, scales = renderer.scene_poses()
    translations = translations + is_moved[:, None] * torch.tensor(steps)[:, None]
    scales = scales + is_moved * (torch.tensor(sizes)[:, None] - 1)
    images = renderer(geometry=renderer.placed(rotations.expand(3, 3, 3, 3), translations, scales))
    for image, *pose in zip(images, translations, scales, strict=True):
        fresh = TorchRenderer(scene, progress=False)
        assert torch.equal(fresh(geometry=fresh.placed(rotations, *pose)), image)
    assert not torch.allclose(images[0], images[1], atol=0.1)


@pytest.mark.parametrize("name", ["metallic", "albedo"])
def test_gradients_to_metals_that_mirror_each_other_agree_with_differences(name):
    renderer, image = TorchRenderer(metal_scene(*METALS, GROUND), progress=False), weights()[:24, :24]

    def loss(value):
        return (renderer(**{name: {0: value, 1: value}}).double() * image).sum()

    value = torch.tensor([[0.7, 0.5, 0.4]] if name == "albedo" else [0.4])
    gradient, difference = twins.slopes(loss, value, 3e-3)
    assert gradient == pytest.approx(difference, rel=SMOOTH)


def test_gradients_to_the_roughness_of_metals_that_mirror_each_other_are_the_change_of_the_image():
    """On average over a range: as samples turn, they leap from body to body, and differences by 30% with the step."""
    renderer, image = TorchRenderer(metal_scene(*METALS, GROUND), progress=False), weights()[:24, :24]

    def loss(value):
        return (renderer(roughness={0: value, 1: value}).double() * image).sum()

    values = (0.35 + 0.1 * (torch.arange(12) + 0.5) / 12).requires_grad_()
    gradients = [float(torch.autograd.grad(loss(value), value)[0]) for value in values.split(1)]
    change = float(loss(torch.tensor([0.45])) - loss(torch.tensor([0.35])))
    assert 0.1 * np.mean(gradients) == pytest.approx(change, rel=0.06)  # measured 3.3%


def test_gradients_to_poses_of_metals_are_about_the_change_of_the_image():
    """On average along a path. Within outlines that metals have in each other alone they are 1.6 times too large."""
    renderer, image = TorchRenderer(metal_scene(*METALS, GROUND), progress=False), weights()[:24, :24]
    rotations, translations, scales = renderer.scene_poses()
    path = torch.tensor([[0.1, 0.03, 0.08], [0, 0, 0], [0, 0, 0]])

    def losses(shares):
        geometry = renderer.placed(rotations, translations + shares[:, None, None] * path, scales)
        return (renderer(geometry=geometry) * image).sum((1, 2, 3))

    shares = ((torch.arange(12) + 0.5) / 12).requires_grad_()
    (gradient,) = torch.autograd.grad(losses(shares).mean(), shares)
    start, end = losses(torch.tensor([0.0, 1.0])).detach()
    assert float(gradient.sum()) == pytest.approx(float(end - start), rel=OF_METALS)


TILES = dataclasses.replace(GROUND, roughness=0.4, metallic=0.6)
"""A ground with uvs that shines."""


def test_stills_of_many_samples_widen_lobes_for_the_normals_within_a_sample():
    ball = ws.Body(ws.icosphere(1.0, 2), (0.9, 0.7, 0.4), roughness=0.2, metallic=1.0)
    scene = ws.Scene([ball], ws.synthetic_sky((0.3, 0.5, 0.8)), ws.Camera.framing(ball, size=(24, 24)))
    still, truth = (ws.render(dataclasses.replace(scene, supersampling=count))[..., :3] for count in (4, 12))
    assert np.linalg.norm(still - truth) < 0.03 * np.linalg.norm(truth)


def test_a_metal_in_a_still_has_no_grain_where_it_mirrors_the_ground(monkeypatch):
    """The light of blockers and their share of the hemisphere are found by the same rays, whose noise cancels."""
    ball = ws.Body(ws.icosphere(1.0, 4), roughness=0.25, metallic=1.0, translation=(0, 1, 0))
    camera = ws.Camera.look_at((0, 1, 6), (0, 0.8, 0), fov_y=18, size=(24, 24))
    light = ws.EnvironmentMap.constant()
    scene = ws.Scene([ball, ws.Body(ws.plane(8.0, 16))], light, camera, bounces=1, supersampling=1)
    few = ws.render(scene)[14:21, 7:17, :3]
    monkeypatch.setattr(static_form_factors, "STILL_RAYS", 4096)
    many = ws.render(scene)[14:21, 7:17, :3]
    assert np.linalg.norm(few - many) < 0.006 * np.linalg.norm(many)  # 0.4%; 1.0% where their noise differs


def texels(height, width, low=0.3):
    return torch.tensor(np.random.default_rng(0).uniform(low, 0.7, (height, width))).float()


@pytest.mark.parametrize("name", ["roughness", "metallic", "specular"])
def test_gradients_to_textures_of_gloss_agree_with_differences(name):
    """Beside a ball of one number; texels are smaller and larger than pixels."""
    renderer, image = TorchRenderer(scene_of(BALL, TILES, POST), progress=False), weights()
    others = {"roughness": texels(64, 64), "metallic": texels(4, 3), "specular": texels(2, 3)}

    def loss(value):
        given = {key: {"ground": texture} for key, texture in (others | {name: value}).items()}
        return (renderer(**given).double() * image).sum()  # float32 would round differences of small steps

    gradient, difference = twins.slopes(loss, texels(2, 4, low=0.4), 1e-3)
    assert np.linalg.norm(gradient - difference) < SMOOTH * np.linalg.norm(difference)


def test_gradients_to_a_pose_go_through_footprints_in_textures_of_gloss():
    camera = ws.Camera.look_at((0.3, 1.6, 2.6), (0.4, 0, 0.5), fov_y=14, size=(32, 32))
    renderer = TorchRenderer(dataclasses.replace(scene_of(BALL, TILES, POST), camera=camera), progress=False)
    given, image = {name: {"ground": texels(40, 40)} for name in ("roughness", "metallic")}, weights()
    rotations, translations, scales = renderer.scene_poses()

    def loss(value):
        shifts = torch.cat([torch.zeros(1, 3), value, torch.zeros(1, 3)])
        return (renderer(geometry=renderer.placed(rotations, translations + shifts, scales), **given) * image).sum()

    # measured 0.5%; steps of 1e-3 go past bends of the loss, which is 9% off
    gradient, difference = twins.slopes(loss, torch.zeros(1, 3), 1e-4)
    assert np.linalg.norm(gradient - difference) < SMOOTH * np.linalg.norm(difference)


def test_an_even_texture_of_gloss_shows_what_a_number_does():
    numbers = {"roughness": 0.4, "metallic": 0.6, "specular": 0.5}
    textures = {name: np.full((2 + 3 * len(name), 5), value) for name, value in numbers.items()}
    images = [
        ws.Renderer(scene_of(BALL, dataclasses.replace(GROUND, **values), POST)).render()
        for values in (numbers, textures)
    ]
    np.testing.assert_allclose(*images, atol=2e-6)


def test_textures_of_gloss_that_a_call_gives_show_as_those_of_a_scene():
    """Also in a batch, and where an image is as wide as its body has vertices."""
    values = texels(7, GROUND.mesh.vertex_count)
    scene = scene_of(BALL, dataclasses.replace(TILES, roughness=values.numpy()), POST)
    expected = torch.tensor(ws.Renderer(scene).render())
    renderer = TorchRenderer(scene_of(BALL, TILES, POST), progress=False)
    batch = renderer(roughness={"ground": torch.stack([values, 0 * values + 0.9])})
    torch.testing.assert_close(batch[0], expected, atol=2e-6, rtol=1e-5)
    assert (batch[1] - expected).abs().max() > 0.01
    part = values[:, :40].contiguous()
    torch.testing.assert_close(renderer(roughness={"ground": part}), renderer(roughness={"ground": part[None]})[0])


def test_a_texture_of_gloss_needs_uvs():
    with pytest.raises(ValueError, match=r"roughness\['ball'\]: got shape"):
        TorchRenderer(scene_of(), progress=False)(roughness={"ball": texels(3, 5)})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"body": "ball", "size": (2, 2)}, "whose mesh has no uvs"),
        ({"body": "ground", "size": 3}, "size: got 3, expected height and width"),
        ({"body": "ground", "per_vertex": True, "size": (2, 2)}, "per_vertex: got it beside size"),
        ({"body": "ground", "smoothness": 1.0}, "smoothness: got it without size"),
        ({"body": "ground", "per_vertex": True}, "whose metallic is a texture, expected size"),
    ],
)
def test_textures_of_gloss_that_cannot_be_free_are_refused(arguments, message):
    scene = scene_of(BALL, dataclasses.replace(TILES, metallic=np.zeros((2, 3))))
    with pytest.raises(ValueError, match=message):
        inverse.Problem(scene, inverse.Target(np.zeros((32, 32, 4))), [inverse.Metallic(**arguments)])


@pytest.mark.slow
def test_a_fit_recovers_a_texture_of_metal():
    truth = torch.tensor([[0.0, 1.0], [1.0, 0.0]])
    scene = scene_of(BALL, TILES, POST)
    renderer = TorchRenderer(scene, progress=False)
    target = inverse.Target(renderer(metallic={"ground": truth}).numpy())
    problem = inverse.Problem(scene, target, [inverse.Metallic("ground", size=(2, 2))])
    fitted = inverse.fit(problem, inverse.Stage(30), progress=False).scene.bodies[1]
    np.testing.assert_allclose(fitted.metallic, truth, atol=0.1)  # measured 0.08, where the ball's shadow lies


def test_gradients_to_light_agree_with_differences():
    basis = ws.CellBasis(ws.fibonacci(32))
    scene = scene_of(visibility=ws.Visibility(directions=32))
    renderer, image = TorchRenderer(scene, basis=basis, progress=False), weights()
    light = torch.tensor(basis.coefficients(SKY))
    chosen = torch.randn(light.shape, generator=torch.Generator().manual_seed(0))

    def loss(value):
        return (renderer(light + value * chosen) * image).sum()

    gradient, difference = twins.slopes(loss, torch.tensor([0.0]), 0.1)
    assert gradient == pytest.approx(difference, rel=1e-3)


def test_gradients_to_colors_agree_with_differences():
    renderer, image = TorchRenderer(scene_of(), progress=False), weights()
    gradient, difference = twins.slopes(
        lambda value: (renderer(albedo={"ball": value}) * image).sum(), torch.tensor([0.8, 0.5, 0.3]), 0.05
    )
    np.testing.assert_allclose(gradient, difference, rtol=1e-3)


def test_gradients_to_poses_of_blockers_and_of_bodies_that_shine_agree_with_differences():
    renderer, image = TorchRenderer(dataclasses.replace(scene_of(), camera=NEAR), progress=False), weights()
    rotations, translations, scales = renderer.scene_poses()

    def loss(value):
        shifts = torch.zeros_like(translations)
        shifts = torch.cat([value[:1], shifts[1:2], value[1:]])
        return (renderer(geometry=renderer.placed(rotations, translations + shifts, scales)) * image).sum()

    gradient, difference = twins.slopes(loss, torch.zeros(2, 3), 3e-3)
    assert np.linalg.norm(gradient - difference) < SMOOTH * np.linalg.norm(difference)


def test_gradients_to_the_camera_agree_with_differences():
    renderer, image = TorchRenderer(dataclasses.replace(scene_of(), camera=NEAR), progress=False), weights()
    R, t, K = renderer.scene_cameras()

    def loss(value):
        turned = rotation_matrices(value[0]) @ R
        return (renderer(clip_matrices=renderer.clip_matrices(turned, t + value[1], K)) * image).sum()

    gradient, difference = twins.slopes(loss, torch.zeros(2, 3), 1e-3)
    assert np.linalg.norm(gradient - difference) < SMOOTH * np.linalg.norm(difference)


@pytest.mark.slow
@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_a_fit_recovers_roughness_and_tells_metal_from_plastic(metallic):
    truth = dataclasses.replace(BALL, metallic=metallic, roughness=0.3)
    start = dataclasses.replace(BALL, metallic=0.5, roughness=0.6)
    target = inverse.Target(ws.Renderer(scene_of(truth, GROUND, POST)).render())
    free = [inverse.Roughness("ball"), inverse.Metallic("ball")]
    problem = inverse.Problem(scene_of(start, GROUND, POST), target, free)
    fitted = inverse.fit(problem, inverse.Stage(30), progress=False).scene.bodies[0]
    assert fitted.roughness == pytest.approx([0.3], abs=0.03)
    assert fitted.metallic == pytest.approx([metallic], abs=0.05)


@pytest.mark.parametrize("name", ["roughness", "metallic", "specular"])
@pytest.mark.parametrize(
    ("value", "message"),
    [
        (1.5, r"got 1 values out of range \(first at index \(0, 0\): 1.5\), expected 0 to 1"),
        (-0.1, r"got 1 values out of range \(first at index \(0, 0\): -0.1\), expected 0 to 1"),
        (np.nan, "got 1 NaN or Inf values"),
    ],
)
def test_gloss_that_no_surface_has_is_refused(name, value, message):
    renderer = TorchRenderer(scene_of(), progress=False)
    with pytest.raises(ValueError, match=rf"{name}\[.*\]: {message}"):
        renderer(**{name: {"ball": torch.tensor([value])}})
    with pytest.raises(ValueError, match=rf"{name}\[0\]: {message}"):
        renderer.array_renderer.draw(**{name: {0: wp.array([[value]], dtype=wp.float32)}})


def test_a_line_search_may_look_beyond_the_gloss_that_there_is():
    """Its steps of 10 leave [0, 1] by far; at the bound the uncertainty is that of a step to one side."""
    target = inverse.Target(ws.Renderer(scene_of(dataclasses.replace(BALL, metallic=0.0), GROUND)).render())
    problem = inverse.Problem(scene_of(BALL, GROUND), target, [inverse.Metallic("ball")])
    optimizer = functools.partial(torch.optim.LBFGS, max_iter=6, line_search_fn="strong_wolfe")
    result = inverse.fit(problem, inverse.Stage(2, 10.0), optimizer=optimizer, progress=False)
    assert result.reason == "finished" and 0 <= result.scene.bodies[0].metallic[0] <= 1
    columns = []
    for value in (0.0, 0.02):
        values = {"metallic[0]": {"value": torch.tensor([value])}}
        columns.append(NormalMatrix(problem, result.context, values).columns)
    assert np.linalg.norm(columns[0] - columns[1]) < 0.1 * np.linalg.norm(columns[1])


def test_gloss_of_a_diffuse_body_is_refused():
    renderer = TorchRenderer(scene_of(), progress=False)
    with pytest.raises(ValueError, match=r"roughness\[1\]: got some for 'ground', expected one for bodies that have"):
        renderer(roughness={"ground": torch.tensor(0.5)})
