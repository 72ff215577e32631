"""Bounces over geometry that does not move, of free light and reflectance: against paths, a twin and differences."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
import warp as wp

import warpshadow as ws
from warpshadow.pipeline.bounces import static_bounces, static_form_factors
from warpshadow.pipeline.bounces.patches import ScenePatches
from warpshadow.pipeline.methods import ray_traced as rays
from warpshadow.stages.bounces.irradiance_cache import choose_cache_points, interpolation_matrix
from warpshadow.torch import TorchRenderer

SEED = 2

RAYS = ws.Visibility(method="ray-traced", samples=512, order=3)


def ball_on_ground(*, bounces: int = 2, size: int = 20) -> ws.Scene:
    """A ball of many colors on a textured ground, beside a leaning wall, under a sky with a bright side."""
    rng = np.random.default_rng(SEED)
    ball = ws.icosphere(0.5, 3)
    bodies = [
        ws.Body(
            ball,
            albedo=rng.uniform(0.2, 0.9, ball.positions.shape),
            blockers=ws.Spheres([[0, 0, 0]], [0.5]),
            translation=(0, 0.5, 0),
            name="ball",
        ),
        ws.Body(ws.plane(4.0, 8), texture=rng.uniform(0.2, 0.9, (8, 8, 3)), name="ground"),
        ws.Body(
            ws.plane(1.5, 2),
            albedo=(0.9, 0.3, 0.2),
            blockers=ws.Spheres([[0, 0, 0]], [0.1]),
            rotation=(0, 0, -80),
            translation=(-0.9, 0.7, 0),
            name="wall",
        ),
    ]
    sky = np.full((16, 32, 3), 0.5, np.float32)
    sky[3:6, 8:14] = (8.0, 6.0, 4.0)
    camera = ws.Camera.look_at((1.5, 2.0, 3.0), (0, 0.4, 0), size=(size, size))
    return ws.Scene(bodies, ws.EnvironmentMap(sky), camera, RAYS, supersampling=1, bounces=bounces)


def bowl() -> ws.Mesh:
    """The ball's lower part, open above."""
    ball = ws.icosphere(0.5, 3)
    return ws.Mesh(ball.positions, ball.faces[ball.positions[ball.faces].mean(axis=1)[:, 1] < 0.1])


@pytest.fixture(scope="module")
def renderer() -> TorchRenderer:
    return TorchRenderer(ball_on_ground())


@pytest.fixture(scope="module")
def direct() -> TorchRenderer:
    return TorchRenderer(ball_on_ground(bounces=0))


def color_of(body: ws.Body, factor: float = 1.0) -> torch.Tensor:
    return torch.tensor(factor * np.atleast_2d(body.albedo), dtype=torch.float32)


def texture_of(body: ws.Body) -> torch.Tensor:
    return torch.tensor(body.texture)


def relative(some: torch.Tensor, others: torch.Tensor) -> float:
    return float(torch.linalg.norm(some - others) / torch.linalg.norm(others))


def test_given_colors_bounce_as_along_paths():
    """Noise and patches leave 2.5% of the light that bounced, of which there is a tenth."""
    scene = replace(ball_on_ground(), visibility=ws.Visibility(method="ray-traced", samples=4096))
    renderer = TorchRenderer(scene)
    with torch.no_grad():
        paths = renderer()
        cached = renderer(albedo={"ball": color_of(scene.bodies[0])})
        direct = TorchRenderer(replace(scene, bounces=0))()
    assert relative(direct, paths) > 0.08
    assert relative(cached, paths) < 0.02
    share = (cached - direct)[..., :3].mean() / (paths - direct)[..., :3].mean()
    assert abs(share - 1) < 0.04


def test_free_light_bounces_as_known_light(renderer, direct):
    """Light of nine harmonics, as free coefficients and known."""
    light = np.array([[3.0, 2.0, 1.0], *np.random.default_rng(SEED).normal(0, 0.3, size=(8, 3))], np.float32)
    given = {"ball": wp.array(renderer.scene.bodies[0].albedo[None], dtype=wp.vec3)}
    free, known, *without = (
        torch.from_numpy(each.array_renderer.draw(of, albedo=given).numpy())
        for each, of in itertools.product((renderer, direct), (wp.array(light[None], dtype=wp.vec3), light))
    )
    assert relative(without[0], free) > 0.05
    bounced = [(image - own)[..., :3].mean(dim=(0, 1, 2)) for image, own in zip((free, known), without, strict=True)]
    torch.testing.assert_close(*bounced, rtol=0.06, atol=0)  # of 512 rays, which are drawn, or even
    assert relative(free, known) < 0.02


def test_images_are_linear_in_light_that_bounces(renderer):
    some, more = torch.tensor(np.random.default_rng(SEED).normal(size=(2, 9, 3)), dtype=torch.float32)
    with torch.no_grad():
        both, apart = renderer(some + 2 * more), renderer(some) + 2 * renderer(more)
        dark = renderer(torch.zeros(9, 3))
    assert relative(both[..., :3], apart[..., :3]) < 1e-5
    assert not dark[..., :3].any()


def test_images_in_a_batch_are_those_of_each(renderer):
    rng = np.random.default_rng(SEED)
    lights = torch.tensor(rng.normal(size=(2, 9, 3)), dtype=torch.float32)
    walls = torch.tensor(rng.uniform(size=(2, 1, 3)), dtype=torch.float32)
    with torch.no_grad():
        batch = renderer(lights, albedo={"wall": walls})
        each = [renderer(light, albedo={"wall": wall}) for light, wall in zip(lights, walls, strict=True)]
    torch.testing.assert_close(batch, torch.stack(each), rtol=1e-5, atol=1e-5)


def test_cameras_share_what_bounces_between_patches():
    scene = ball_on_ground(size=12)
    cameras = [scene.camera, ws.Camera.look_at((-2, 2, 2), (0, 0.4, 0), size=(12, 12))]
    light = torch.rand(9, 3, generator=torch.Generator().manual_seed(SEED))
    with torch.no_grad():
        both = TorchRenderer(scene, cameras=cameras)(light)
        each = [TorchRenderer(replace(scene, camera=camera))(light) for camera in cameras]
    torch.testing.assert_close(both, torch.stack(each), rtol=2e-2, atol=2e-2)  # rays of the same receivers are turned
    with pytest.raises(ValueError, match="got a batch of 2 for 2 views"):
        TorchRenderer(scene, cameras=cameras)(torch.stack([light, light]))


def test_black_bodies_send_nothing(renderer, direct):
    scene = renderer.scene
    black = [torch.zeros(1, 3), None, torch.zeros(1, 3)]
    light = torch.rand(9, 3, generator=torch.Generator().manual_seed(SEED))
    with torch.no_grad():
        ground = torch.zeros_like(texture_of(scene.bodies[1]))
        lit = renderer(light, albedo=black, textures=[None, ground, None])
        assert not lit[..., :3].any()
        given = {"albedo": black, "textures": [None, texture_of(scene.bodies[1]), None]}
        bounced, without = renderer(light, **given), direct(light, **given)
    at_ground = bounced[..., :3] > 0
    assert at_ground.any()
    # a flat ground gets nothing back from black bodies
    torch.testing.assert_close(bounced[..., :3][at_ground], without[..., :3][at_ground], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("method", ["ray-traced", "directional"])
@pytest.mark.parametrize("given", ["light", "light and colors"])
def test_iterations_are_those_of_a_twin_in_float64(given, method, monkeypatch):
    """B = a M (S + F B) and I = W F B, of the form factors F that rays find; some go on where patches share a body."""
    traced, find = [], static_form_factors.scale_to_sky

    def listed(*arguments):
        traced.append(find(*arguments))
        return traced[-1]

    monkeypatch.setattr(static_form_factors, "scale_to_sky", listed)
    scene = ball_on_ground()
    scene = replace(scene, bodies=(replace(scene.bodies[0], mesh=bowl()), *scene.bodies[1:]))
    scene = replace(scene, visibility=ws.Visibility(method, samples=512))
    engine = ws.Renderer(scene, basis=ws.HarmonicBasis(3))
    view = engine.view()
    light = wp.array(np.random.default_rng(SEED).normal(size=(1, 9, 3)), dtype=wp.vec3)
    materials = view.materials
    if given == "light and colors":  # those that it has
        color = wp.array(np.atleast_2d(scene.bodies[2].albedo)[None], dtype=wp.vec3)
        materials = materials.replaced({"albedo": [None, None, color]})
    shading = view.shading(view.method.light_input(view, light), materials).value(view.call).numpy()[0]
    (factors,) = (node for name, (_, node) in view._cached.items() if name == "form factors")
    factors = factors.value(view.call)
    patches = ScenePatches(engine.merged_scene)
    senders = patches.senders(view.materials)
    albedo = patches.albedo(view.materials, senders.bodies).value(view.call).numpy()[0].astype(np.float64)
    (patch_samples,) = (points for name, (_, points) in view._cached.items() if name == "patch samples")
    transfers = view.method.cached_transfer_node(patch_samples)
    transfer = np.concatenate([each.numpy()[0] for each in transfers.value(view.call)]).astype(np.float64)

    def dense(matrix) -> np.ndarray:
        starts, columns, weights = (array.numpy() for array in matrix.rows)
        result = np.zeros(matrix.shape)
        result[np.repeat(np.arange(matrix.shape[0]), np.diff(starts)), columns] = weights
        return result

    mean, (between, of_nodes) = dense(senders.mean), [each.factors.toarray().astype(np.float64) for each in traced]
    at_patch_samples = transfer @ light.numpy()[0].astype(np.float64)
    of_bodies = np.repeat(np.arange(len(senders.bodies)), np.diff(senders.first))
    is_own = of_bodies[senders.patch_of_sample][:, None] == of_bodies
    assert (between * is_own).sum(axis=1).max() > 0.3
    once = albedo * (mean @ at_patch_samples)
    radiosity = albedo * (mean @ (at_patch_samples + between @ once))
    for _ in range(static_bounces.SELF_BOUNCES):
        past = at_patch_samples + (between * ~is_own) @ once
        radiosity = albedo * (mean @ (past + (between * is_own) @ radiosity))
    expected = dense(factors.receiver_weights) @ (of_nodes @ radiosity)
    rows = np.concatenate([each.numpy()[0] for each in view.transfers.value(view.call)]).astype(np.float64)
    direct = rows @ light.numpy()[0]
    scale = np.abs(shading).max()
    assert np.abs(expected).max() > 0.05 * scale
    np.testing.assert_allclose(shading, direct + expected, atol=2e-5 * scale)


@pytest.mark.parametrize("gap", [1.0, 0.6], ids=["touching", "intersecting"])
def test_white_balls_in_a_white_furnace_are_white(gap):
    """Rays and the spheres of direct light see as much of the sky; what lies in the other ball does not count.

    Their light was off by 0.08 and 0.16 before the two were made to agree.
    """
    ball, blockers = ws.icosphere(0.5, 3), ws.Spheres([[0, 0, 0]], [0.5])
    bodies = [ws.Body(ball, albedo=(1, 1, 1), blockers=blockers, translation=(x, 0, 0)) for x in (-gap / 2, gap / 2)]
    camera = ws.Camera.look_at((0, 1, 4), (0, 0, 0), size=(32, 32), fov_y=30)
    scene = ws.Scene(bodies, ws.EnvironmentMap.constant(1.0), camera, bounces=16)
    image = TorchRenderer(scene, progress=False)(albedo=[torch.ones(1, 3), None]).numpy()
    seen = image[image[..., 3] > 0.99]
    np.testing.assert_allclose(seen[:, :3], 1, atol=0.03)


def test_what_sticks_out_of_another_body_has_the_light_of_patch_samples_outside():
    """A ball shows a cap that is smaller than its patches: all patch samples of these lie in the box."""
    box = trimesh.creation.box((2, 1, 2))
    bodies = [
        ws.Body(ws.icosphere(0.5, 3), albedo=(1, 1, 1), translation=(0, 0.06, 0)),
        ws.Body(ws.Mesh(box.vertices, box.faces), albedo=(1, 1, 1)),
    ]
    camera = ws.Camera.look_at((0, 2, 4), (0, 0.5, 0), size=(16, 16), fov_y=30)
    visibility = ws.Visibility("ray-traced", sampling="shared", samples=64)
    engine = ws.Renderer(ws.Scene(bodies, ws.EnvironmentMap.constant(1.0), camera, visibility, bounces=1))
    view = engine.view()
    shading = view.shading(view.method.light)
    shading.value(view.call)
    (factors,) = (node for name, (_, node) in view._cached.items() if name == "form factors")
    means = factors.value(view.call).patch_sample_means.to_scipy()
    senders = ScenePatches(engine.merged_scene).senders(view.materials)
    points = senders.patch_samples(view.vertices.value(view.call), view.normals.value(view.call)).points.numpy()[0]
    is_outside = points[:, 1] > 0.5
    of_ball = senders.body_of_patch[senders.patch_of_sample] == 0
    is_closed = senders.body_of_patch == 0
    is_closed &= np.bincount(senders.patch_of_sample, of_ball & is_outside, len(senders.areas)) == 0
    assert 0 < (of_ball & is_outside).sum() < 0.1 * of_ball.sum() and is_closed.sum() > 50
    outside_parts = means @ (of_ball & is_outside).astype(np.float32)
    np.testing.assert_allclose(outside_parts[senders.body_of_patch == 0], 1, atol=1e-5)


def gradient_and_difference(loss, tensor: torch.Tensor, step: float) -> tuple[float, float]:
    """Derivative of a loss along a random direction: by its gradient, and by a central difference."""
    direction = torch.randn(tensor.shape, generator=torch.Generator().manual_seed(SEED))
    free = tensor.clone().requires_grad_()
    loss(free).backward()
    with torch.no_grad():
        difference = (loss(tensor + step * direction) - loss(tensor - step * direction)) / (2 * step)
    return float((free.grad * direction).sum()), float(difference)


@pytest.mark.parametrize("what", ["albedo", "colors of vertices", "texture", "light", "light beside free albedo"])
def test_gradients_are_differences_through_all_bounces(what, renderer):
    """Images are polynomials of what is free, so differences may be large."""
    scene = renderer.scene
    weights = torch.rand(20, 20, 4, generator=torch.Generator().manual_seed(SEED))
    light = torch.tensor(renderer.basis.coefficients(scene.light))
    wall = torch.full((1, 3), 0.5)
    losses = {
        "albedo": (lambda x: renderer(albedo={"wall": x}), wall),
        "colors of vertices": (lambda x: renderer(albedo={"ball": x}), color_of(scene.bodies[0], 0.5)),
        "texture": (lambda x: renderer(textures={"ground": x}), texture_of(scene.bodies[1])),
        "light": (lambda x: renderer(x), light),
        "light beside free albedo": (lambda x: renderer(x, albedo={"wall": wall.clone().requires_grad_()}), light),
    }
    image, start = losses[what]
    by_gradient, by_difference = gradient_and_difference(lambda x: (weights * image(x)).mean(), start, 0.03)
    assert by_gradient == pytest.approx(by_difference, rel=3e-3, abs=1e-6)


def test_colors_of_a_wall_are_seen_in_what_it_lights(renderer):
    """The gradient of pixels of the ground to the color of the wall beside it is that of bounced light alone."""
    wall = torch.full((1, 3), 0.5, requires_grad=True)
    image = renderer(albedo={"wall": wall})
    on_ground = torch.from_numpy(renderer.array_renderer.body_ids()[0] == 1)
    image[on_ground].sum().backward()
    assert (wall.grad > 0).all()


def test_no_ray_is_traced_in_an_iteration(renderer, monkeypatch):
    """What rays find is kept, whatever the light and the colors are."""
    wall = torch.full((1, 3), 0.5)
    light = torch.rand(9, 3)
    with torch.no_grad():
        first = renderer(light, albedo={"wall": wall}), renderer(albedo={"wall": wall})

        def refuse(*_, **__):
            raise AssertionError("rays are traced")

        for module, name in (
            (static_form_factors, "trace_form_factors"),
            (rays, "trace_shading"),
            (rays, "trace_transfer"),
        ):
            monkeypatch.setattr(module, name, refuse)
        again = renderer(light, albedo={"wall": wall}), renderer(albedo={"wall": wall})
        renderer(2 * light, albedo={"wall": 0.5 * wall})
    for one, other in zip(first, again, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)


# ---------------------------------------------------------------------------------------------- nodes


def test_what_is_interpolated_between_nodes_is_near_what_it_was():
    rng = np.random.default_rng(SEED)
    normals = rng.normal(size=(3000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = normals + [1.0, 0, 0]
    nodes = choose_cache_points(points, 400)
    assert len(np.unique(nodes)) == 400
    matrix = interpolation_matrix(points, normals, nodes)
    np.testing.assert_allclose(matrix.sum(axis=1), 1, atol=1e-6)
    assert matrix.data.min() >= 0
    np.testing.assert_allclose(matrix[nodes].toarray(), np.eye(400), atol=1e-6)
    values = points[:, 0] + points[:, 1] ** 2
    assert np.abs(matrix @ values[nodes] - values).mean() < 0.05


def test_nodes_are_not_those_of_the_other_side():
    """Front and back of a sheet are at the same place."""
    rng = np.random.default_rng(SEED)
    points = np.concatenate([np.zeros((3000, 1)), rng.uniform(size=(3000, 2))], axis=1)
    points[1::2] = points[::2]
    normals = np.tile([1.0, 0, 0], (3000, 1)) * np.where(np.arange(3000) % 2, -1, 1)[:, None]
    nodes = choose_cache_points(points, 1001)
    matrix = interpolation_matrix(points, normals, nodes)
    np.testing.assert_allclose(matrix @ normals[nodes, 0], normals[:, 0], atol=1e-6)


def test_places_on_a_body_count_beside_a_ground_without_end():
    """Distances are parts of an extent, beside which those on the body vanished: its light was streaked."""
    rng = np.random.default_rng(SEED)
    azimuth, height, distance = rng.uniform(0, 2 * np.pi, 3000), rng.uniform(0, 2, 3000), 1 / rng.uniform(1e-3, 1, 2000)
    pillar = np.stack([np.cos(azimuth), height, np.sin(azimuth)], axis=1)
    ground = np.stack([rng.normal(size=2000) * distance, np.zeros(2000), distance], axis=1)
    points = np.concatenate([pillar, ground])
    normals = np.concatenate([pillar * [1, 0, 1], np.tile([0.0, 1, 0], (2000, 1))])
    nodes = choose_cache_points(points, 1000)
    interpolated = interpolation_matrix(points, normals, nodes) @ points[nodes, 1]
    assert np.abs(interpolated - points[:, 1])[:3000].mean() < 0.08  # 0.04; 0.32 where they vanish


def test_a_few_receivers_are_all_nodes():
    points = np.random.default_rng(SEED).normal(size=(3, 3))
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    nodes = choose_cache_points(points)
    assert sorted(nodes) == [0, 1, 2]
    np.testing.assert_allclose((interpolation_matrix(points, normals, nodes) @ points[nodes]), points, atol=1e-6)
    assert interpolation_matrix(points[:1], normals[:1], np.array([0])).toarray() == [[1.0]]


def test_the_bounced_light_of_a_bulb_in_a_shade_has_no_grain_in_stills(monkeypatch):
    """Nearly all comes from inside the shade, which few rays meet by chance: 13% of grain without others, 5% with."""
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    rings = [
        np.stack([r * np.cos(angle), np.full(12, y), r * np.sin(angle)], axis=1) for r, y in ((0.3, 0), (0.2, 0.3))
    ]
    i, j = np.arange(12), (np.arange(12) + 1) % 12
    faces = np.concatenate([np.stack([i, i + 12, j], axis=1), np.stack([j, i + 12, j + 12], axis=1)])
    bodies = [
        ws.Body(ws.Mesh(np.concatenate(rings), faces), albedo=(0.8,) * 3, translation=(0, 1.3, 0), name="shade"),
        ws.Body(ws.icosphere(0.06, 1), emission=(99,) * 3, albedo=(0,) * 3, translation=(0, 1.4, 0), name="bulb"),
        ws.Body(ws.plane(4.0), albedo=(0.6,) * 3, rotation=(90, 0, 0), translation=(0, 2, -1), name="wall"),
    ]
    camera = ws.Camera.look_at((0, 1.5, 4), (0, 1.6, 0), fov_y=35, size=(24, 24))
    scene = ws.Scene(bodies, ws.EnvironmentMap.constant(0.0), camera, bounces="all")
    still = ws.render(scene)[..., :3]
    monkeypatch.setattr(static_form_factors, "STILL_RAYS", 2048)
    expected = ws.render(scene)[..., :3]
    assert np.linalg.norm(still - expected) < 0.07 * np.linalg.norm(expected)


@pytest.mark.parametrize("light", ["known", "free"])
def test_an_image_that_shows_no_body_is_empty(light):
    away = ws.Camera.look_at((0, 2, 5), (0, 4, 12), size=(8, 8))
    rays = ws.Visibility("ray-traced", samples=16, sampling="shared")
    scene = replace(ball_on_ground(), camera=away, visibility=rays)
    basis = ws.HarmonicBasis(3) if light == "free" else None
    with pytest.warns(UserWarning, match="no"):
        image = TorchRenderer(scene, basis=basis)(None if basis is None else torch.ones(9, 3))
    assert not image.any()
