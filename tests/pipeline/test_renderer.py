"""The pipeline as a whole: images against rays, against formulas, and against each other."""

import dataclasses
import pickle
import warnings

import numpy as np
import pytest
import warp as wp

import warpshadow as ws
from warpshadow.assets.basis import CellBasis, HarmonicBasis
from warpshadow.device import array_checks
from warpshadow.maths import sh
from warpshadow.maths.directions import fibonacci
from warpshadow.pipeline.bodies.geometry import Geometry
from warpshadow.pipeline.methods import directional
from warpshadow.pipeline.receivers import groups
from warpshadow.pipeline.receivers.choice_of_receivers import for_still
from warpshadow.pipeline.renderer import SceneRenderer
from warpshadow.tuning.point_sample import PointSample

METHODS = ("directional", "log-sh", "none", "ray-traced")
# Sums of some hundred float32 terms.
FLOAT32 = 1e-5
# The cosine over 128 cells, or over the bands of the harmonics, is a quadrature: off by 0.18% at most (measured).
QUADRATURE = 3e-3
# 256 stratified rays for each of a pixel's four samples: 1.3% at the worst pixel (measured).
RAY_NOISE = 0.025
# The exact sphere by 128 soft cells or by 8 bands against the icosphere by rays, relative L2 over the image, under a
# dome and under a sky with a sun (measured): directional 1.0% and 0.8%, log-SH 1.0% and 2.5%; no shadows 18%.
IMAGE_ERROR = {"directional": 0.015, "log-sh": 0.035}

NEIGHBORS = [(0, 1), (0, -1), (1, 0), (-1, 0)]
UNIT_SPHERE = ws.Spheres([[0, 0, 0]], [1.0])
CAMERA = ws.Camera.look_at((0, 2.5, 5), (0, 0.6, 0), size=(32, 32))
FROM_ABOVE = ws.Camera.look_at((0, 5, 0), (0, 0, 0), up=(0, 0, -1), fov_y=40, size=(16, 16))


def dome() -> ws.EnvironmentMap:
    """Constant light from above the horizon, so that nothing depends on who blocks it from below."""
    radiance = np.ones((64, 128, 3), np.float32)
    radiance[32:] = 0
    return ws.EnvironmentMap(radiance)


def sunny() -> ws.EnvironmentMap:
    radiance = ws.synthetic_sky((0.5, 0.6, 0.4), sun_radius=6, sun_strength=1, height=64).radiance.copy()
    radiance[32:] = 0
    return ws.EnvironmentMap(radiance)


def ball(**options) -> ws.Body:
    defaults = {"blockers": UNIT_SPHERE, "translation": (0, 1, 0), "scale": 0.8, "albedo": (1, 1, 1)}
    return ws.Body(ws.icosphere(1.0, 3), **{**defaults, **options})


def ground(segments: int = 48, mesh=None, **options) -> ws.Body:
    defaults = {"blockers": 0, "albedo": (1, 1, 1), "receivers": "vertex"}
    return ws.Body(mesh or ws.plane(6.0, segments), **{**defaults, **options})


def scene_of(method: str, *bodies: ws.Body, light=None, camera=CAMERA, samples=1024, supersampling=2, **visibility):
    return ws.Scene(
        bodies or (ball(), ground()),
        dome() if light is None else light,
        camera,
        ws.Visibility.of({"method": method, "samples": samples} | visibility),
        supersampling,
    )


def relative_error(image: np.ndarray, truth: np.ndarray) -> float:
    covered = truth[..., 3] == 1
    return np.linalg.norm((image - truth)[covered, :3]) / np.linalg.norm(truth[covered, :3])


# ---------------------------------------------------------------------------------------------- against formulas


@pytest.mark.parametrize("method", METHODS)
def test_a_white_convex_body_in_a_white_furnace_is_invisible(device, method):
    camera = ws.Camera.look_at((0, 0, 4), (0, 0, 0), size=(16, 16))
    scene = scene_of(method, ball(blockers=0, translation=(0, 0, 0)), light=ws.EnvironmentMap.constant(), camera=camera)
    image = ws.render(scene, device=device)
    covered = image[..., 3] == 1
    assert 20 < covered.sum() < 256
    tolerance = RAY_NOISE if method == "ray-traced" else QUADRATURE
    assert np.abs(image[covered] - 1).max() < tolerance


@pytest.mark.parametrize("method", METHODS)
def test_an_unoccluded_white_plane_shows_the_radiance_of_constant_light(device, method):
    light = ws.EnvironmentMap.constant((0.5, 1, 2))
    image = ws.render(scene_of(method, ground(1), light=light, camera=FROM_ABOVE), device=device)
    tolerance = RAY_NOISE if method == "ray-traced" else QUADRATURE
    assert np.abs(image / [0.5, 1, 2, 1] - 1).max() < tolerance


@pytest.mark.slow
def test_the_ground_under_a_ball_gets_what_the_form_factor_leaves(device):
    """A ball of radius r at height h above a point, θ off its normal, blocks cos θ r²/h² of a constant dome."""
    grazing = ws.Camera.look_at((3.5, 0.4, 0), (0, 0, 0), fov_y=10, size=(32, 32))
    renderer = SceneRenderer(scene_of("ray-traced", camera=grazing, samples=8192, supersampling=1), device=device)
    shading, points = (array.numpy()[0] for array in (renderer.shade(), renderer.view().receivers.points))
    body_ids = renderer.body_ids()[0]
    on_ground = body_ids[body_ids >= 0] == 1
    toward = np.array([0, 1, 0]) - points[on_ground]
    distance = np.linalg.norm(toward, axis=1)
    expected = 1 - toward[:, 1] / distance * 0.64 / distance**2
    shown = shading[on_ground]
    assert len(shown) > 300 and expected.min() < 0.4
    facets = 0.006  # the icosphere is smaller than its sphere, by 1% of what it blocks; with noise 0.3% measured
    assert np.abs(shown[:, 0] - expected).max() < facets


@pytest.mark.slow
@pytest.mark.parametrize("light", [dome, sunny])
@pytest.mark.parametrize("method", ["directional", "log-sh"])
def test_images_of_an_exact_sphere_are_near_those_by_rays(device, method, light):
    truth = ws.render(scene_of("ray-traced", light=light(), samples=2048), device=device)
    image = ws.render(scene_of(method, light=light()), device=device)
    error = relative_error(image, truth)
    assert error < IMAGE_ERROR[method]
    assert error < 0.2 * relative_error(ws.render(scene_of("none", light=light()), device=device), truth)


def test_without_blockers_log_sh_is_no_visibility_at_all(device):
    bodies = ball(blockers=0), ground()
    shadowed, direct = (ws.render(scene_of(method, *bodies), device=device) for method in ("log-sh", "none"))
    np.testing.assert_array_equal(shadowed, direct)


# ---------------------------------------------------------------------------------------------- bodies without blockers


@pytest.mark.slow
@pytest.mark.parametrize("blockers", [0, ws.Spheres(np.empty((0, 3)), [])], ids=["0", "no spheres"])
@pytest.mark.parametrize("method", METHODS)
def test_a_body_without_blockers_casts_no_shadow_by_any_method(device, method, blockers):
    """Neither when all bodies may move nor when others do, nor on what it is compared with."""
    canopy = ws.Body(ws.plane(4.0, 8), blockers=blockers, translation=(0, 2.6, 0))  # beyond what the camera sees
    results = []
    for bodies in ((ball(), ground()), (ball(), ground(), canopy)):
        scene = scene_of(method, *bodies, samples=64)
        renderer = SceneRenderer(scene, device=device)
        moved = renderer.view(renderer.placed(moving=[0]))
        results.append((renderer.render(), renderer.draw(view=moved).numpy(), PointSample(scene, count=99).reference))
    for without, with_canopy in zip(*results, strict=True):
        np.testing.assert_array_equal(with_canopy, without)


def test_where_nothing_casts_a_shadow_rays_need_no_hierarchy(device, monkeypatch):
    monkeypatch.setattr(wp, "Mesh", None)
    renderer = SceneRenderer(scene_of("ray-traced", ball(blockers=0), ground()), device=device)
    assert renderer.explain()["visibility"].forward.why == "no body has blockers"
    direct = ws.render(scene_of("none", ball(blockers=0), ground()), device=device)
    assert relative_error(renderer.render(), direct) < RAY_NOISE
    light = wp.array(renderer.basis.coefficients(dome())[None], dtype=wp.vec3, device=device)
    assert not renderer.explain(light)["visibility"]
    assert relative_error(renderer.draw(light).numpy()[0], direct) < RAY_NOISE


# ---------------------------------------------------------------------------------------------- light


@pytest.mark.parametrize("method", ["directional", "log-sh", "none"])
def test_images_are_linear_in_sh_light(device, method):
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 16, 3)).astype(np.float32)
    renderer = SceneRenderer(scene_of(method), device=device)
    mixed = renderer.render(0.5 * a - 2 * b)[..., :3]
    parts = 0.5 * renderer.render(a)[..., :3] - 2 * renderer.render(b)[..., :3]
    assert np.abs(mixed - parts).max() < FLOAT32 * np.abs(parts).max()


@pytest.mark.parametrize("method", METHODS)
def test_twice_the_map_is_twice_the_image(device, method):
    renderer = SceneRenderer(scene_of(method, light=sunny()), device=device)
    once, twice = renderer.render()[..., :3], renderer.render(sunny().scaled(2))[..., :3]
    assert np.abs(twice - 2 * once).max() < FLOAT32 * once.max()


@pytest.mark.parametrize("method", METHODS)
def test_sh_light_and_the_map_it_came_from_give_nearly_the_same_image(device, method):
    """The light is of order 3, so what differs is its sampling: by cells, by pixels of its map, by rays."""
    coefficients = np.zeros((9, 3), np.float32)
    coefficients[0] = 3.5
    coefficients[1:] = np.random.default_rng(1).uniform(-0.5, 0.5, (8, 3))
    image = sh.reconstruct_map(coefficients, 64)
    assert image.min() > 0
    renderer = SceneRenderer(scene_of(method), device=device)
    by_map = renderer.render(ws.EnvironmentMap(image.astype(np.float32)))
    by_harmonics = renderer.render(coefficients)
    assert relative_error(by_map, by_harmonics) < 0.01  # the mean of a cell is not its middle: 0.3% measured


@pytest.mark.parametrize("method", ["directional", "log-sh", "none"])
def test_a_scene_turned_with_its_light_and_camera_gives_the_same_image(device, method):
    """Harmonics turn exactly; cells stay where they are, so they differ as their quadrature does: 0.5%."""
    light = np.random.default_rng(2).normal(size=(16, 3)) * 0.2
    light[0] = 2
    scene = scene_of(method, light=light)
    turn = ws.Body(ws.icosphere(1.0, 0), rotation=(20, 50, -30)).rotation_matrix()
    bodies = [
        dataclasses.replace(body, rotation=(20, 50, -30), translation=turn @ body.translation) for body in scene.bodies
    ]
    camera = dataclasses.replace(CAMERA, rotation=CAMERA.rotation @ turn.T)
    turned = scene_of(method, *bodies, light=sh.harmonic_rotation(4, turn) @ light, camera=camera)
    image, expected = ws.render(turned, device=device), ws.render(scene, device=device)
    agrees = np.abs(image - expected)[..., 3] < FLOAT32  # at silhouettes a sample may flip
    assert agrees.mean() > 0.98
    difference = np.linalg.norm((image - expected)[agrees]) / np.linalg.norm(expected[agrees])
    assert difference < (0.01 if method == "directional" else FLOAT32)


# ---------------------------------------------------------------------------------------------- receivers


@pytest.mark.parametrize("method", ["directional", "log-sh"])
def test_two_triangles_receive_a_shadow_with_pixel_receivers(device, method):
    coarse, fine, at_corners = ground(1, receivers="pixel"), ground(128), ground(1, receivers="vertex")
    camera = ws.Camera.look_at((0, 2.0, 5), (0, 0, 0), size=(32, 32))
    by_pixel, by_vertex, missed = (
        ws.render(scene_of(method, ball(), body, camera=camera, supersampling=1), device=device)
        for body in (coarse, fine, at_corners)
    )
    interpolation = 1e-3  # of vertices 0.05 apart in a penumbra; 0.04% measured
    assert relative_error(by_pixel, by_vertex) < interpolation
    assert relative_error(missed, by_vertex) > 0.1


def test_pixel_and_vertex_receivers_mix_in_one_image(device):
    renderers = [
        SceneRenderer(scene_of("directional", ball(receivers=receivers), ground(), supersampling=1), device=device)
        for receivers in ("pixel", "vertex")
    ]
    mixed, by_vertex = (renderer.render() for renderer in renderers)
    body_ids = renderers[0].body_ids()[0]
    on_ball = body_ids == 0
    apart = body_ids == 1  # from the ball and the border, where silhouettes are smoothed
    apart[1:-1, 1:-1] &= np.all([np.roll(body_ids, shift, (0, 1))[1:-1, 1:-1] == 1 for shift in NEIGHBORS], axis=0)
    np.testing.assert_array_equal(mixed[apart], by_vertex[apart])
    assert (mixed[on_ball] != by_vertex[on_ball]).any()
    assert relative_error(mixed, by_vertex) < 2e-3  # interpolation again, on a ball of 642 vertices


@pytest.mark.parametrize("bounces", [0, 1])
@pytest.mark.parametrize("receivers", ["vertex", "pixel"])
@pytest.mark.parametrize("method", METHODS)
def test_a_camera_that_sees_no_body_renders_nothing(device, method, receivers, bounces):
    camera = ws.Camera.look_at((0, 0, 5), (0, 0, 10), size=(8, 8))
    if bounces and method == "none":
        pytest.skip("has no bounces")
    scene = dataclasses.replace(scene_of(method, ball(receivers=receivers), camera=camera), bounces=bounces)
    with pytest.warns(UserWarning, match="camera: the image shows nothing of the scene: .* behind the camera"):
        np.testing.assert_array_equal(ws.render(scene, device=device), np.zeros((8, 8, 4)))


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"near": 50.0}, "near = 50 cuts all of it away, which is .* or less in front of the camera"),
        ({"target": (50, 0, 4)}, "outside of the frame, at depths from"),
    ],
)
def test_an_image_that_shows_nothing_says_why_once(device, options, reason):
    camera = ws.Camera.look_at((0, 0, 5), **{"target": (0, 0, 0), "size": (8, 8)} | options)
    renderer = SceneRenderer(scene_of("none", camera=camera), device=device)
    with pytest.warns(UserWarning, match=f"camera: the image shows nothing of the scene: .*{reason}") as caught:
        renderer.render()
        renderer.draw(view=renderer.view(renderer.placed()))
    assert len(caught) == 1


def test_a_view_of_several_that_shows_nothing_is_named(device):
    views = [CAMERA, dataclasses.replace(CAMERA, translation=-CAMERA.translation)]
    with pytest.warns(UserWarning, match="camera: image 1 of 2 shows nothing of the scene: .* behind"):
        SceneRenderer(scene_of("none"), cameras=views, device=device).render()


def test_moving_geometry_that_leaves_the_image_is_remarked_on():
    renderer = SceneRenderer(scene_of("none"))
    positions, *spheres = renderer.geometry().arrays().values()
    away = wp.array(positions.numpy() + (0, 0, 100), dtype=wp.vec3)
    with pytest.warns(UserWarning, match="camera: the image shows nothing of the scene: .* behind the camera"):
        renderer.view(Geometry(away, *spheres))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scene": "scene.toml"}, r"scene: got 'scene.toml', expected a Scene; load_scene\(path\) reads one"),
        ({"basis": 5}, r"basis: got 5, expected HarmonicBasis\(5\)"),
        ({"cameras": CAMERA}, r"cameras: got Camera, expected a list of Cameras, \[camera\]"),
        ({"cameras": ["front"]}, r"cameras\[0\]: got 'front', expected a Camera"),
        ({"device": "gpu"}, "device: got 'gpu', expected one of 'cpu'"),
    ],
)
def test_what_a_renderer_is_not_made_of_is_refused_when_it_is_made(options, message):
    with pytest.raises(ValueError, match=message):
        ws.Renderer(**{"scene": scene_of("none")} | options)


@pytest.mark.parametrize(
    ("light", "message"),
    [
        ("park.exr", r"light: got 'park.exr', expected an EnvironmentMap \(EnvironmentMap.read\(path\)"),
        ([[1.0, 1.0, 1.0]] * 4, "light: got list of 4 items, expected an EnvironmentMap"),
        (np.ones(9), r"light: got shape \(9,\), expected an EnvironmentMap .*, or SH coefficients \[order², 3\]"),
    ],
)
def test_what_is_no_light_is_refused(light, message):
    with pytest.raises(ValueError, match=message):
        SceneRenderer(scene_of("none")).render(light)


def test_the_texels_of_a_body_without_a_texture_are_refused():
    with pytest.raises(ValueError, match="body: got 0, a body without a texture"):
        SceneRenderer(scene_of("none")).seen_texels(0)


# ---------------------------------------------------------------------------------------------- pixels


def test_supersampling_averages_samples(device):
    fine_camera = CAMERA.resized(4)
    fine = SceneRenderer(scene_of("directional", camera=fine_camera, supersampling=1), device=device).render()
    coarse = SceneRenderer(scene_of("directional", supersampling=4), device=device).render()
    expected = fine.reshape(32, 4, 32, 4, 4).mean(axis=(1, 3))
    assert np.abs(coarse - expected).max() < FLOAT32
    assert ((coarse[..., 3] > 0) & (coarse[..., 3] < 1)).any()


def test_the_background_is_zero_and_color_is_premultiplied(device):
    image = ws.render(scene_of("none", ball(blockers=0), light=ws.EnvironmentMap.constant()), device=device)
    assert image.dtype == np.float32 and image.shape == (32, 32, 4)
    empty = image[..., 3] == 0
    assert empty[0, 0] and not image[empty].any()
    edge = (image[..., 3] > 0) & (image[..., 3] < 1)
    assert edge.any()
    assert np.abs(image[edge, :3] - image[edge, 3:]).max() < QUADRATURE  # white under L = 1 is its coverage


def test_writing_into_an_image_does_not_change_the_next_one(device):
    for supersampling in (1, 2):
        renderer = SceneRenderer(scene_of("directional", supersampling=supersampling), device=device)
        first = renderer.render()
        cached = first.copy()
        first[:] = np.nan
        np.testing.assert_array_equal(renderer.render(), cached)


# ---------------------------------------------------------------------------------------------- reflectance


def test_a_texture_lies_with_u_to_the_right_and_v_up(device):
    """Red lower left, green lower right, blue upper left, white upper right; row 0 is the top of the image."""
    texture = np.array([[(0, 0, 1), (1, 1, 1)], [(1, 0, 0), (0, 1, 0)]], np.float32)
    body = ground(1, texture=np.repeat(np.repeat(texture, 8, axis=0), 8, axis=1))
    scene = scene_of("none", body, light=ws.EnvironmentMap.constant(), camera=FROM_ABOVE)  # -z, which is +v, is up
    image = ws.render(scene, device=device)
    quarter = image[[3, 3, 12, 12], [3, 12, 3, 12], :3]
    assert np.abs(quarter - [(0, 0, 1), (1, 1, 1), (1, 0, 0), (0, 1, 0)]).max() < QUADRATURE


def test_two_texels_blend_linearly_from_center_to_center(device):
    body = ground(1, texture=np.array([[(0, 0, 0), (1, 1, 1)]], np.float32))
    width = np.degrees(2 * np.arctan(0.03))  # of the plane, from 100 units away
    camera = ws.Camera.look_at((0, 100, 0), (0, 0, 0), up=(0, 0, -1), fov_y=width, size=(16, 16))
    scene = scene_of("none", body, light=ws.EnvironmentMap.constant(), camera=camera, supersampling=1)
    image = ws.render(scene, device=device)
    u = (np.arange(16) + 0.5) / 16
    inside = (u > 0.25) & (u < 0.75)
    assert np.abs(image[8, inside, 0] - (2 * u[inside] - 0.5)).max() < QUADRATURE


def test_bodies_with_and_without_uvs_keep_their_own_reflectance(device):
    red, texture = (0.8, 0.1, 0.1), np.full((4, 4, 3), (0.1, 0.2, 0.9), np.float32)
    gray = (0.5, 0.5, 0.5)
    bodies = (ball(albedo=red), ground(texture=texture), ball(albedo=gray, translation=(1.5, 1, -1)))
    for order in (1, -1):
        renderer = SceneRenderer(scene_of("none", *bodies[::order]), device=device)
        albedo = renderer.reflect().numpy()[0]
        body_ids = renderer.body_ids()[0]
        for number, color in enumerate([red, (0.1, 0.2, 0.9), gray][::order]):
            shown = body_ids == number
            assert shown.sum() > 20
            assert np.abs(albedo[shown] - color).max() < FLOAT32
        assert not albedo[body_ids < 0].any()


def test_albedo_of_vertices_is_interpolated(device):
    body = ground(4)
    colors = 0.5 + body.mesh.positions / 6  # linear in x and z, so exact between vertices
    scene = scene_of("none", ground(4, albedo=colors), supersampling=1, camera=FROM_ABOVE)
    renderer = SceneRenderer(scene, device=device)
    points = renderer.reflect().numpy()[0]
    rows, columns = np.mgrid[0.5:16, 0.5:16] / 16 - 0.5
    scale = 2 * 5 * np.tan(np.radians(20)) / 6  # of the plane that the image shows
    expected = np.stack([0.5 + columns * scale, np.full_like(rows, 0.5), 0.5 + rows * scale], axis=-1)
    assert np.abs(points - expected).max() < FLOAT32


@pytest.mark.parametrize("method", ["directional", "log-sh"])
def test_points_on_faces_are_lit_where_a_geometry_has_them(device, method):
    """As those of a scene whose ball has that place."""
    moved = ws.Renderer(scene_of(method, ball(translation=(0.3, 1.2, 0)), ground(8)), device=device)
    renderer = ws.Renderer(scene_of(method, ball(), ground(8)), device=device)
    sides = np.arange(0, len(renderer.merged_scene.body_of_face), 7)
    places = sides, np.full((len(sides), 3), 1 / 3, np.float32)
    expected = moved.shade(view=moved.on_faces(*places)).numpy()
    found = renderer.shade(view=renderer.on_faces(*places, moved.geometry())).numpy()
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert not np.allclose(renderer.shade(view=renderer.on_faces(*places)).numpy(), expected, atol=1e-2)


def test_two_bodies_are_the_same_as_one_mesh_of_both(device):
    first, second = ball(), ball(translation=(1.2, 0.6, 0.5), scale=0.5)
    meshes = [body.world_mesh() for body in (first, second)]
    joined = ws.Mesh(
        np.concatenate([mesh.positions for mesh in meshes]),
        np.concatenate([meshes[0].faces, meshes[1].faces + meshes[0].vertex_count]),
    )
    spheres = ws.Spheres([first.translation, second.translation], [0.8, 0.5])
    one = ws.Body(joined, albedo=(1, 1, 1), blockers=spheres)
    expected = ws.render(scene_of("directional", first, second, ground(), self_shadows="spheres"), device=device)
    image = ws.render(scene_of("directional", one, ground(), self_shadows="spheres"), device=device)
    assert np.abs(image - expected).max() < FLOAT32


# ---------------------------------------------------------------------------------------------- free light


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("basis", [HarmonicBasis(3), CellBasis(fibonacci(64))], ids=["harmonics", "cells"])
def test_transfer_to_any_basis_gives_nearly_the_image_of_its_light(device, method, basis):
    """Light of order 3 is in both bases, but in 64 cells as steps: 0.3%. Rays to free light are spread evenly: 1%."""
    light = np.random.default_rng(3).normal(size=(9, 3)) * 0.2
    light[0] = 3
    renderer = SceneRenderer(scene_of(method, samples=2048), device=device, basis=basis)
    transfer = renderer.transfer().numpy()[0]
    free = transfer @ basis.coefficients(light)
    expected = renderer.shade(light).numpy()[0]
    assert transfer.shape == (len(expected), basis.size)
    error = np.linalg.norm(free - expected) / np.linalg.norm(expected)
    assert error < (0.02 if method == "ray-traced" else 0.006)


@pytest.mark.slow
@pytest.mark.parametrize("count", [32, 128, 256, 512])
def test_no_light_is_lost_between_cells_of_different_size(device, count):
    """One cell of light after the other gives all that the method's own 128 cells give."""
    scene = scene_of("directional", directions=128)
    own = SceneRenderer(scene, device=device).transfer().numpy()[0]
    renderer = SceneRenderer(scene, device=device, basis=CellBasis(fibonacci(count)))
    transfer = renderer.transfer().numpy()[0]
    assert np.abs(transfer.sum(axis=1) - own.sum(axis=1)).max() < FLOAT32
    upward = fibonacci(count)[:, 1] > 0.3
    body_of_vertex = np.repeat([0, 1], np.diff(renderer.merged_scene.first_vertex))
    on_ground = renderer.view().receivers.receiver_of_vertex.numpy()[body_of_vertex == 1]
    on_ground = on_ground[on_ground >= 0]  # the ground sees every cell above it somewhere
    assert (transfer[on_ground].max(axis=0)[upward] > 0).all()
    if count == 128:
        assert np.abs(transfer - own).max() < FLOAT32


def test_a_mesh_of_few_faces_that_is_shaded_at_its_corners_draws_a_warning():
    floor = ws.Body(ws.plane(4.0, 1), blockers=0, receivers="vertex")
    camera = ws.Camera.look_at((0, 3, 3), (0, 0, 0), size=(64, 64))
    scene = ws.Scene((floor,), ws.EnvironmentMap.constant(), camera, ws.Visibility("directional"))
    expected = r"body 0 \('plane'\): its faces have 1.7e\+03 pixels each, and the long ones are 91 pixels .*\"pixel\""
    with pytest.warns(UserWarning, match=expected):
        ws.render(scene)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for receivers in ("auto", "pixel"):
            ws.render(dataclasses.replace(scene, bodies=(dataclasses.replace(floor, receivers=receivers),)))


# ---------------------------------------------------------------------------------------------- receivers = "auto"


def bent(segments: int = 1, **options) -> ws.Body:
    """A ground that does not quite lie in a plane."""
    sheet = ws.plane(6.0, segments)
    positions = sheet.positions.copy()
    positions[0, 1] = 0.1
    return ground(**options, mesh=ws.Mesh(positions, sheet.faces))


def coarse_and_fine(size: int = 64, receivers: str = "auto") -> ws.Scene:
    """A ground of two triangles, and a ball of faces of a pixel or so."""
    camera = ws.Camera.look_at((0, 2.0, 5), (0, 0, 0), size=(size, size))
    return scene_of("directional", ball(receivers=receivers), bent(receivers=receivers), camera=camera)


def chosen_receivers(scene: ws.Scene, **options) -> list[str]:
    return [body.receivers for body in SceneRenderer(scene, **options).scene.bodies]


def test_bodies_of_large_faces_are_shaded_by_pixel(device):
    scene = coarse_and_fine()
    assert chosen_receivers(scene, device=device) == ["vertex", "pixel"]
    explicit = dataclasses.replace(scene, bodies=(ball(receivers="vertex"), bent(receivers="pixel")))
    np.testing.assert_array_equal(ws.render(scene, device=device), ws.render(explicit, device=device))
    assert chosen_receivers(explicit, device=device) == ["vertex", "pixel"]
    assert chosen_receivers(coarse_and_fine(receivers="vertex"), device=device) == ["vertex", "vertex"]


def test_what_is_large_is_the_mean_over_the_faces_that_the_cameras_see():
    scene = coarse_and_fine()
    renderer = SceneRenderer(dataclasses.replace(scene, supersampling=1))
    face_ids = renderer.view().fragments.face_ids.numpy()
    on_ground = face_ids >= ball().mesh.face_count
    size = on_ground.sum() / len(np.unique(face_ids[on_ground]))
    assert f"Body 1 ('mesh') has receivers at pixels: its faces have {size:.2g} pixels each" in str(renderer.explain())
    assert "Body 0 ('icosphere') has receivers at vertices" in str(renderer.explain())
    assert "has receivers" not in str(SceneRenderer(coarse_and_fine(receivers="vertex")).explain())
    far = [ws.Camera.look_at((0, 240.0, 600), (0, 0, 0), size=(64, 64))]
    assert chosen_receivers(scene, cameras=far) == ["vertex", "vertex"]


@pytest.mark.parametrize(("segments", "expected"), [(11, "pixel"), (12, "vertex")])
def test_of_few_faces_a_pixel_each_is_large(segments, expected):
    """Those of 242 and 288, which have 7 pixels each on average."""
    camera = ws.Camera.look_at((0, 4.0, 9), (0, 0, 0), size=(64, 64))
    scene = scene_of("directional", bent(segments, receivers="auto"), camera=camera)
    assert chosen_receivers(scene) == [expected]


@pytest.mark.parametrize(("size", "largest"), [(64, 16), (256, 16), (512, 64), (2048, 400)])
def test_in_large_images_faces_may_be_larger(size, largest):
    """Sheets that fill the image, cut into faces that are all of one size."""
    camera = ws.Camera.look_at(
        (0, 1e3, 0), (0, 0, 0), up=(0, 0, -1), fov_y=np.degrees(2 * np.arctan(1e-3)), size=(size, size)
    )
    for factor, expected in ((0.7, "vertex"), (1.4, "pixel")):
        quads = round(size / np.sqrt(2 * largest * factor))
        sheet = ws.Body(ws.plane(2.0, quads), blockers=0)
        scene = ws.Scene((sheet,), ws.EnvironmentMap.constant(), camera, ws.Visibility("log-sh"))
        assert chosen_receivers(scene) == [expected]


def test_long_faces_are_large_though_they_have_few_pixels():
    """A capsule of 62 sides of a pixel or so each, and its two caps of many faces; also behind the near plane."""
    angles = np.linspace(0, np.pi, 32)
    profile = np.stack([0.3 * np.sin(angles), -0.3 * np.cos(angles) + np.where(angles < np.pi / 2, -0.7, 0.7)], axis=1)
    turns = np.linspace(0, 2 * np.pi, 62, endpoint=False)
    ring = np.stack([np.cos(turns), np.zeros(62), np.sin(turns)], axis=1)
    positions = (profile[:, None, :1] * ring + profile[:, None, 1:] * [0, 1, 0]).reshape(-1, 3)
    first = (62 * np.arange(31)[:, None] + np.arange(62)).ravel()
    second = (62 * np.arange(31)[:, None] + (np.arange(62) + 1) % 62).ravel()
    faces = np.concatenate([np.stack([first, first + 62, second], 1), np.stack([second, first + 62, second + 62], 1)])
    capsule = ws.Body(ws.Mesh(positions, faces), blockers=0)
    for eye in ((0, 0, 4.0), (0, 0, 0.5)):  # in front of it, and between its ends, near its side
        camera = ws.Camera.look_at(eye, (0, 0.1, 0), size=(64, 64), near=0.3)
        renderer = SceneRenderer(ws.Scene((capsule, ball()), ws.EnvironmentMap.constant(), camera))
        assert renderer.scene.bodies[0].receivers == "pixel"
        assert np.isfinite(renderer.render()).all()


@pytest.mark.slow
def test_in_a_picture_shadows_end_sharply_on_a_coarse_ground():
    """On faces of 13 pixels, under a sun of 2 degrees of radius."""
    sun = ws.synthetic_sky((0.5, 0.6, 0.4), sun_radius=2, sun_strength=3, height=128)
    scene = scene_of("directional", ball(), ground(12, receivers="auto"), light=sun, camera=CAMERA.resized(2))
    truth = ws.render(dataclasses.replace(scene, visibility=ws.Visibility("ray-traced", samples=512)))
    at_vertices = dataclasses.replace(scene, bodies=(ball(), ground(12, receivers="vertex")))
    images = SceneRenderer(at_vertices).render(), SceneRenderer(scene).render(), ws.render(scene)
    cached, adaptive, once = (relative_error(image, truth) for image in images)
    assert chosen_receivers(scene) == ["vertex", "adaptive"] and cached > 0.05  # measured 6.2%
    assert max(adaptive, once) < 0.03  # measured 2.5% and 2.4%


def test_in_a_picture_only_flat_bodies_that_leave_it_open_are_shaded_by_pixel():
    bodies = ball(), ground(12, receivers="auto"), ground(12)
    scene = for_still(scene_of("directional", *bodies))
    assert [body.receivers for body in scene.bodies] == ["auto", "pixel", "vertex"]
    assert for_still(scene) is scene


def test_what_moves_does_not_change_the_choice_and_a_copy_makes_the_same():
    renderer = SceneRenderer(coarse_and_fine())
    poses = renderer.scene_poses()
    nearer = wp.array(poses.translations.numpy() + [0, 0, 4.5], dtype=wp.vec3, device=renderer.device)
    geometry = renderer.placed(dataclasses.replace(poses, translations=nearer))
    view = renderer.view(geometry, wp.array([renderer.cameras[0].clip_matrix()], dtype=wp.mat44))
    assert view.receivers.points.shape[1] > 0
    assert [body.receivers for body in renderer.scene.bodies] == ["vertex", "pixel"]
    copy = pickle.loads(pickle.dumps(renderer))
    assert [body.receivers for body in copy.scene.bodies] == ["vertex", "pixel"]


def test_rays_need_no_choice():
    renderer = SceneRenderer(dataclasses.replace(coarse_and_fine(), visibility=ws.Visibility("ray-traced")))
    assert [body.receivers for body in renderer.scene.bodies] == ["auto", "auto"]
    assert "has receivers" not in str(renderer.explain())


# ---------------------------------------------------------------------------------------------- several cameras

EYES = [(0, 2.5, 5), (4, 1.5, -2)]


def cameras() -> list[ws.Camera]:
    return [ws.Camera.look_at(eye, (0, 0.6, 0), size=(24, 16)) for eye in EYES]


def textured_scene(method: str, receivers: str) -> ws.Scene:
    texture = np.random.default_rng(4).uniform(0.1, 0.9, (8, 8, 3)).astype(np.float32)
    bodies = ball(receivers="vertex"), ground(12, texture=texture, receivers=receivers, blockers=1)
    return scene_of(method, *bodies, samples=64, directions=32, order=4)


@pytest.mark.parametrize("receivers", ["vertex", "pixel"])
@pytest.mark.parametrize("method", METHODS)
def test_images_of_several_cameras_are_those_of_each_alone(device, method, receivers):
    scene = textured_scene(method, receivers)
    together = SceneRenderer(scene, cameras=cameras(), device=device)
    light = wp.array(np.random.default_rng(5).uniform(size=(1, together.basis.size, 3)), dtype=wp.vec3, device=device)
    images, lit = together.render(), together.draw(light).numpy()
    assert images.shape == lit.shape == (2, 16, 24, 4)
    for number, camera in enumerate(cameras()):
        alone = SceneRenderer(dataclasses.replace(scene, camera=camera), device=device)
        assert np.abs(images[number] - alone.render()).max() < FLOAT32 * images.max()
        assert np.abs(lit[number] - alone.draw(light).numpy()[0]).max() < FLOAT32 * lit.max()


def test_one_camera_that_is_given_makes_a_batch_of_one(device):
    scene = textured_scene("none", "vertex")
    images = SceneRenderer(scene, cameras=cameras()[:1], device=device).render()
    expected = ws.render(dataclasses.replace(scene, camera=cameras()[0]), device=device)
    np.testing.assert_array_equal(images, expected[None])


def test_cameras_share_the_visibility_of_moving_geometry(device):
    renderer = SceneRenderer(textured_scene("directional", "vertex"), cameras=cameras(), device=device)
    view = renderer.view(renderer.placed())
    assert view.fragments.face_ids.shape[0] == 2 and view.receivers.points.shape[0] == 1
    np.testing.assert_array_equal(renderer.draw(view=view).numpy(), renderer.render())


@pytest.mark.parametrize("method", METHODS)
def test_a_renderer_for_other_cameras_draws_what_one_made_for_them_does(device, method):
    scene = scene_of(method, ball(), ground(receivers="vertex"), light=sunny())
    renderer = SceneRenderer(scene, device=device)
    before = renderer.render()
    cameras = [ws.Camera.look_at((x, 2, 4), (0, 0.6, 0), size=(24, 40)) for x in (-1, 1)]
    other = renderer.with_cameras(cameras)
    expected = SceneRenderer(scene, cameras=cameras, device=device).render()
    np.testing.assert_allclose(other.render(), expected, atol=FLOAT32)
    np.testing.assert_array_equal(renderer.render(), before)  # which has kept its own
    np.testing.assert_allclose(pickle.loads(pickle.dumps(other)).render(), expected, atol=FLOAT32)
    assert other.merged_scene is renderer.merged_scene


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ([], "cameras: got none, expected at least one"),
        ([CAMERA, FROM_ABOVE], r"cameras\[1\]: got 16 × 16 pixels, expected 32 × 32, as the first has"),
    ],
)
def test_cameras_of_another_size_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        SceneRenderer(scene_of("none"), cameras=given)


def test_cameras_get_the_nearest_of_their_near_planes():
    cameras = [dataclasses.replace(CAMERA, near=near) for near in (0.5, 0.25)]
    assert [camera.near for camera in SceneRenderer(scene_of("none"), cameras=cameras).cameras] == [0.25, 0.25]


def test_a_coarse_face_in_one_view_of_two_is_as_coarse_as_in_one_alone():
    floor = ws.Body(ws.plane(4.0, 1), blockers=0)
    camera = ws.Camera.look_at((0, 3, 3), (0, 0, 0), size=(28, 28))
    scene = ws.Scene((floor,), ws.EnvironmentMap.constant(), camera)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a face covers 330 pixels of either image
        SceneRenderer(scene, cameras=[camera, camera]).render()


@pytest.mark.parametrize("method", ["directional", "log-sh", "none"])
def test_receivers_lit_in_portions_are_those_lit_at_once(method, monkeypatch):
    """In portions, transfer vectors take memory for those alone that are lit at once."""
    ball = ws.Body(ws.icosphere(1.0, 3), blockers=UNIT_SPHERE, translation=(0, 1, 0))
    scene = ws.Scene((ball, ws.Body(ws.plane(4, 16), blockers=0)), dome(), CAMERA, ws.Visibility(method))
    whole = SceneRenderer(scene).render()
    monkeypatch.setattr(groups, "RECEIVERS_AT_ONCE", 37)
    renderer = SceneRenderer(scene)
    np.testing.assert_array_equal(renderer.render(), whole)
    assert "transfer" in str(renderer.explain())


def test_portions_of_receivers_need_little_memory(monkeypatch):
    """What is shaded at once is told by the largest array of what is seen."""
    monkeypatch.setattr(groups, "RECEIVERS_AT_ONCE", 64)
    sizes = []
    shade = directional.shade_cells
    monkeypatch.setattr(
        directional,
        "shade_cells",
        lambda seen, *rest, **most: sizes.append(seen.shape[1]) or shade(seen, *rest, **most),
    )
    scene = ws.Scene((ws.Body(ws.icosphere(1.0, 3), blockers=UNIT_SPHERE),), dome(), CAMERA)
    SceneRenderer(scene).render()
    assert len(sizes) > 2
    assert max(sizes) <= 64


# ---------------------------------------------------------------------------------------------- views and geometry


def test_a_view_of_another_renderer_is_refused(device):
    """It keeps what the other computed in its light and of its reflectance."""
    scene = scene_of("none", ball(), light=dome())
    first = SceneRenderer(scene, device=device)
    second = SceneRenderer(dataclasses.replace(scene, light=sunny()), device=device)
    view = first.view()
    image = first.draw(view=view).numpy()
    calls = second.draw, second.shade, second.reflect, second.explain, second.body_ids
    for call in calls:
        with pytest.raises(ValueError, match="^view: got one that another renderer made, expected one of this"):
            call(view=view)
    np.testing.assert_array_equal(first.draw(view=view).numpy(), image)


def test_a_plain_tuple_is_a_geometry_whose_rotations_are_not_known(device):
    scene = scene_of("directional", ball(), light=dome(), self_shadows="spheres")
    renderer = SceneRenderer(scene, device=device)
    plain = tuple(renderer.placed().arrays().values())
    image = renderer.draw().numpy()
    np.testing.assert_array_equal(renderer.draw(view=renderer.view(plain)).numpy(), image)
    for wrong in (plain[:2], plain[0], "ball"):
        with pytest.raises(ValueError, match="^geometry: got .*, expected a Geometry, as placed and deformed return"):
            renderer.view(wrong)


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e30])
@pytest.mark.parametrize("name", ["positions", "centers", "radii", "translations", "clip_matrices", "light", "albedo"])
@pytest.mark.parametrize("method", ["directional", "log-sh"])
def test_a_gpu_names_the_argument_at_fault_after_the_call(method, name, value, monkeypatch):
    """There arrays are looked at when a call ends, until when kernels work on what is at fault."""
    renderer = SceneRenderer(scene_of(method, ball(), ground(8), camera=FROM_ABOVE, directions=32, order=4))
    poses = renderer.scene_poses()

    def draw(spoiled: str):
        def copy_of(name: str, array: wp.array) -> wp.array:
            values = array.numpy().copy()
            if name == spoiled:
                values.flat[0] = value
            return wp.array(values, dtype=array.dtype, device=renderer.device)

        translations = copy_of("translations", poses.translations)
        geometry = renderer.placed(dataclasses.replace(poses, translations=translations))
        arrays = {part: copy_of(part, array) for part, array in geometry.arrays().items()}
        view = renderer.view(
            Geometry(**arrays, rotations=geometry.rotations), copy_of("clip_matrices", renderer.clip_matrices)
        )
        light = copy_of("light", wp.full((1, renderer.basis.size), wp.vec3(0.5), dtype=wp.vec3))
        albedo = copy_of("albedo", wp.full((1, 1), wp.vec3(0.5), dtype=wp.vec3))
        return renderer.draw(light, albedo=[albedo, None], view=view).numpy()

    plain = draw("")
    monkeypatch.setattr(array_checks, "_is_awaited", lambda device: True)
    np.testing.assert_array_equal(draw(""), plain)
    with pytest.raises(ValueError, match=rf"^{name}(\[0\])?: got 1 "):
        draw(name)
    np.testing.assert_array_equal(draw(""), plain)
