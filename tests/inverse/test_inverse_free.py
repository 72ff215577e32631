"""What a fit may leave free: where it starts, how it is differentiated, what it finds, and the scene it leaves."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch

import warpshadow as ws
from warpshadow.inverse import (
    Albedo,
    CameraPose,
    Deformation,
    Exposure,
    Light,
    Pose,
    Problem,
    Radii,
    Result,
    Stage,
    Target,
    Texture,
    fit,
)
from warpshadow.inverse.model import Model
from warpshadow.maths import sh

# Sums of some hundred float32 products in another order.
FLOAT32 = 3e-6
# A pose becomes degrees and a matrix of float64 again, and back; a silhouette moves by as much.
POSED = 3e-5
# Images are float32, and soft edges of shadows and mip levels of textures have corners in their second derivatives.
DIFFERENCE = 5e-3

BALL, GROUND = 0, 1
VIEWS = 2

pytestmark = pytest.mark.usefixtures("one_thread")


def lump() -> ws.Body:
    """A body whose outline and shadow show how it is turned; no part of its pose is trivial."""
    rng = np.random.default_rng(3)
    shape = np.array([1.0, 0.6, 0.8])
    centers = rng.normal(size=(8, 3))
    centers *= 0.6 * shape / np.linalg.norm(centers, axis=1, keepdims=True)
    mesh = ws.icosphere(1.0, 2)
    return ws.Body(
        dataclasses.replace(mesh, positions=mesh.positions * shape),
        albedo=(0.7, 0.5, 0.3),
        blockers=ws.Spheres(centers, rng.uniform(0.2, 0.5, 8)),
        rotation=(20, -35, 10),
        translation=(0.1, 1.1, -0.2),
        scale=0.8,
    )


def camera(view: int = 0) -> ws.Camera:
    eye = (0, 3, 4.5) if view == 0 else (2.5, 3, 3.5)
    return ws.Camera.look_at(eye, (0, 0.4, 0), size=(32, 24))


@pytest.fixture(scope="module")
def scene() -> ws.Scene:
    light = np.zeros((9, 3))
    light[:4] = [[3, 3, 3], [1.2, 1, 0.8], [0.5, 0.4, 0.6], [-0.7, -0.6, -0.5]]
    texture = np.random.default_rng(0).uniform(0.2, 0.8, (6, 5, 3))
    ground = ws.Body(ws.plane(16.0, 48), texture=texture, blockers=0)
    return ws.Scene((lump(), ground), light, camera(), ws.Visibility("directional", directions=64), supersampling=2)


@pytest.fixture(scope="module")
def soft_scene(scene) -> ws.Scene:
    """With shadows so soft that differences over some hundredths do not step over their edges."""
    return dataclasses.replace(scene, visibility=ws.Visibility("directional", directions=64, softness=2.0))


@pytest.fixture(scope="module")
def dim_scene(scene) -> ws.Scene:
    """As a map, of about the same light, which is nowhere dark."""
    sky = ws.EnvironmentMap(np.maximum(sh.reconstruct_map(scene.light, 32), 0.05))
    return dataclasses.replace(scene, light=sky)


def blank(views: int = 1) -> list[Target]:
    """Targets to make a problem of before there are any."""
    return [Target(np.full((24, 32, 4), 0.3), camera=camera(view)) for view in range(views)]


def prepared(scene, free, targets=None) -> tuple[Problem, object, dict]:
    problem = Problem(scene, blank() if targets is None else targets, free, still=None)
    context = problem.context(torch.device("cpu"))
    return problem, context, problem.start(context)


def moved(values: dict, amount: float, seed: int = 0) -> dict:
    """Values a little away, each number by its own amount."""
    generator = torch.Generator().manual_seed(seed)
    return {
        name: {key: tensor + amount * torch.randn(tensor.shape, generator=generator) for key, tensor in own.items()}
        for name, own in values.items()
    }


def images_of(problem, context, values) -> np.ndarray:
    return Result(problem, context, values, [[]], "", math.nan).images()


def clear_of_outlines(scene: ws.Scene) -> np.ndarray:
    """Pixels that the ground fills, two pixels away from the body: what moves there is shadow alone."""
    renderer = ws.Renderer(scene)
    ids = renderer.body_ids()[0]
    rows, columns = scene.camera.height, scene.camera.width
    is_ground = (ids == GROUND).reshape(rows, 2, columns, 2).all(axis=(1, 3))
    padded = np.pad(is_ground, 2, constant_values=False)
    shifted = [padded[i : i + rows, j : j + columns] for i in range(5) for j in range(5)]
    return np.logical_and.reduce(shifted).astype(np.float32)


FREE = {
    "light in harmonics": [Light(3)],
    "light in cells": [Light(None, 64)],
    "exposure": [Exposure()],
    "albedo": [Albedo(BALL)],
    "albedo of vertices": [Albedo(BALL, per_vertex=True)],
    "texture": [Texture(GROUND)],
    "pose": [Pose(BALL, scale=True)],
    "pose by quaternion": [Pose(BALL, "quaternion")],
    "pose by columns": [Pose(BALL, "6d")],
    "deformation": [Deformation(BALL)],
    "radii": [Radii(BALL)],
    "camera": [CameraPose(focal=True)],
    "pose, deformation and radii": [Pose(BALL, scale=True), Deformation(BALL), Radii(BALL)],
    "radii before deformation and pose": [Radii(BALL), Deformation(BALL), Pose(BALL)],
    "light, albedo and pose of two bodies": [Light(3), Albedo(BALL), Pose(GROUND), Pose(BALL)],
    "camera and pose": [CameraPose(), Pose(BALL)],
}


# ---------------------------------------------------------------------------------------------- start and settle


@pytest.mark.parametrize(
    ("free", "expected"),
    [
        ([Pose(BALL)], (BALL,)),
        ([Deformation(BALL)], (BALL,)),
        ([Radii(BALL)], (BALL,)),
        ([Pose(GROUND), Radii(BALL)], (BALL, GROUND)),
        ([CameraPose(), Light()], None),
    ],
)
def test_what_is_free_says_which_bodies_move(scene, free, expected, monkeypatch):
    problem, context, values = prepared(scene, free)
    model = Model(problem, context, Stage())
    given = []
    forward = model.renderer.forward

    def recorded(*arguments, geometry, **options):
        given.append(geometry)
        return forward(*arguments, geometry=geometry, **options)

    monkeypatch.setattr(model.renderer, "forward", recorded)
    model.images(values)
    assert [geometry and geometry.moving for geometry in given] == [expected]


@pytest.mark.slow
@pytest.mark.parametrize("case", FREE)
def test_each_starts_where_the_scene_has_it(scene, dim_scene, case):
    in_cells = case == "light in cells"
    scene = dim_scene if in_cells else scene
    problem, context, values = prepared(scene, FREE[case])
    if any(isinstance(each, (Deformation, Radii)) for each in FREE[case]):  # a free shape shadows itself by its spheres
        visibility = dataclasses.replace(scene.visibility, self_shadows="spheres")
        scene = dataclasses.replace(scene, visibility=visibility)
    expected = ws.Renderer(scene, basis=problem.basis)
    if in_cells:  # free light comes from the middle of its cell, the scene's from where it is brightest
        light = torch.from_numpy(problem.basis.coefficients(scene.light))
        reference = ws.torch.TorchRenderer(scene, basis=problem.basis)(light).numpy()
    else:
        reference = expected.render()
    assert np.abs(images_of(problem, context, values)[0] - reference).max() < POSED * reference.max()


@pytest.mark.slow
@pytest.mark.parametrize("case", [case for case in FREE if case not in ("exposure", "light in cells")])
def test_the_scene_that_is_found_has_the_images_of_the_fit(scene, case):
    """With values away from the start, seen from two sides."""
    problem, context, start = prepared(scene, FREE[case], blank(VIEWS))
    values = moved(start, 0.02)
    for free in problem.free:
        free.project(values[free.name])
    found = problem.fitted_scene(values, context)
    got = images_of(problem, context, values)
    assert np.abs(got - images_of(problem, context, start)).max() > 1e-3  # what is to be found is not nothing
    for view, seen_by in enumerate(found.cameras):
        expected = ws.Renderer(dataclasses.replace(found.scene, camera=seen_by)).render()
        assert np.abs(got[view] - expected).max() < POSED * expected.max()
    assert found.scene.camera is found.cameras[0]


@pytest.mark.parametrize("rotation", ["axis-angle", "quaternion", "6d"])
def test_a_body_turns_about_its_middle_and_grows_from_there(scene, rotation):
    ball, ground = scene.bodies
    aside = dataclasses.replace(ball, mesh=ball.mesh.transformed(translation=np.array([0.5, -0.3, 0.2])))
    scene = dataclasses.replace(scene, bodies=(aside, ground))
    problem, context, values = prepared(scene, [Pose(BALL, rotation, scale=True)])
    values["pose[0]"]["turn"] += torch.randn(
        values["pose[0]"]["turn"].shape, generator=torch.Generator().manual_seed(0)
    )
    values["pose[0]"]["log_scale"] += math.log(1.5)
    found = problem.fitted_scene(values, context).scene.bodies[BALL]
    middle = context.middle(BALL)
    before, after = (body.to_world(middle) for body in (aside, found))
    assert np.abs(found.rotation - aside.rotation).max() > 10 and found.scale == pytest.approx(1.2)
    assert np.allclose(after, before, atol=1e-6)


def test_light_of_cells_settles_as_a_map_of_the_same_cells(dim_scene):
    problem, context, start = prepared(dim_scene, [Light(None, 64)])
    values = moved(start, 0.3)
    light = problem.fitted_scene(values, context).scene.light
    wanted = problem.free[0].coefficients(values["light"], context).numpy()
    assert np.abs(problem.basis.coefficients(light) / wanted - 1).max() < FLOAT32


def test_exposures_settle_as_factors_and_leave_coverage_alone(scene):
    problem, context, start = prepared(scene, [Exposure()], blank(VIEWS))
    values = {"exposure": {"log": torch.tensor([0.5, -0.25])}}
    factors = np.exp([0.5, -0.25])
    assert np.allclose(problem.fitted_scene(values, context).exposures, factors)
    before, after = images_of(problem, context, start), images_of(problem, context, values)
    assert np.allclose(after[..., :3], before[..., :3] * factors[:, None, None, None], rtol=1e-6)
    assert np.array_equal(after[..., 3], before[..., 3])


def test_two_views_are_the_images_of_two_cameras(scene):
    problem, context, values = prepared(scene, [Pose(BALL)], blank(VIEWS))
    images = images_of(problem, context, values)
    for view in range(VIEWS):
        expected = ws.Renderer(dataclasses.replace(scene, camera=camera(view))).render()
        assert np.abs(images[view] - expected).max() < FLOAT32 * expected.max()
    assert np.abs(images[0] - images[1]).max() > 0.1


def test_spheres_that_a_still_scene_does_not_need_are_in_what_is_found(scene):
    """Rays need no spheres, but the found scene has its own method again and must not lose its shadow."""
    problem = Problem(scene, blank(), [Albedo(BALL)], still=ws.Visibility("ray-traced", samples=16))
    context = problem.context(torch.device("cpu"))
    found = problem.fitted_scene(problem.start(context), context)
    expected = ws.Renderer(scene).render()
    assert np.abs(ws.Renderer(found.scene).render() - expected).max() < FLOAT32 * expected.max()


def test_a_texture_starts_from_a_color_and_at_another_size(scene):
    ball, ground = scene.bodies
    color = (0.2, 0.4, 0.6)
    plain = dataclasses.replace(scene, bodies=(ball, dataclasses.replace(ground, texture=None, albedo=color)))
    problem, context, values = prepared(plain, [Texture(GROUND, size=(7, 9))])
    texels = values["texture[1]"]["texels"]
    assert texels.shape == (7, 9, 3) and torch.allclose(texels, torch.tensor(color))
    assert np.abs(images_of(problem, context, values)[0] - ws.Renderer(plain).render()).max() < FLOAT32 * 3
    halved = Texture(GROUND, size=(3, 5)).start(setting_of(scene))["texels"].numpy()
    assert np.allclose(halved, ground.texture.reshape(3, 2, 5, 3).mean(axis=1), atol=1e-6)


def energy_of(texture: Texture, texels: np.ndarray, **values: np.ndarray) -> float:
    tensors = {key: torch.from_numpy(np.asarray(value)) for key, value in {"texels": texels, **values}.items()}
    regularizer = texture.regularizer(tensors, None)
    return 0.0 if regularizer is None else float(regularizer)


def test_variation_is_the_length_of_edges_times_their_height_however_soft():
    """A step, and the same rise over five texels; squares of differences, which hate edges, would tell them apart."""
    step, ramp = np.zeros((6, 12, 3)), np.zeros((6, 12, 3))
    step[:, 6:] = (0.3, 0.4, 0.0)
    ramp[:] = np.clip((np.arange(12)[:, None] - 3) / 5, 0, 1) * (0.3, 0.4, 0.0)
    for texels in (step, ramp, step.transpose(1, 0, 2)):
        assert energy_of(Texture(GROUND, total_variation=2.0), texels) == pytest.approx(2 * 6 * 0.5 / 72, rel=0.02)
    assert energy_of(Texture(GROUND, smoothness=1.0), step) > 4 * energy_of(Texture(GROUND, smoothness=1.0), ramp)
    assert energy_of(Texture(GROUND, total_variation=2.0), step[:1]) > 0  # of a single row, too


def test_a_palette_asks_for_the_distance_to_the_nearest_color():
    rng = np.random.default_rng(3)
    texels, colors = rng.uniform(0, 1, (5, 7, 3)), rng.uniform(0, 1, (3, 3))
    squares = [min(((texel - color) ** 2).sum() for color in colors) for texel in texels.reshape(-1, 3)]
    assert energy_of(Texture(GROUND, palette=2.0, colors=3), texels, palette=colors) == pytest.approx(
        2 * np.mean(squares), rel=1e-6
    )


def test_a_palette_starts_as_the_texture_has_it_and_as_grays_where_that_is_plain(scene):
    ball, ground = scene.bodies
    tiles = np.where(np.indices((8, 8)).sum(axis=0)[..., None] % 2, [0.9, 0.8, 0.7], [0.1, 0.0, 0.1]).astype(np.float32)
    for texture, expected in ((tiles, [[0.1, 0, 0.1], [0.9, 0.8, 0.7]]), (None, [[0.25] * 3, [0.75] * 3])):
        context = setting_of(
            dataclasses.replace(scene, bodies=(ball, dataclasses.replace(ground, texture=texture, albedo=(0.5,) * 3)))
        )
        start = Texture(GROUND, palette=1.0).start(context)
        assert np.allclose(start["palette"].numpy(), expected, atol=1e-6)
        assert set(Texture(GROUND).start(context)) == {"texels"}


@pytest.mark.parametrize(
    ("options", "tolerance"), [({"palette": 1.0}, 0.002), ({"total_variation": 0.05}, 0.015), ({}, None)]
)
def test_what_textures_are_likely_to_be_tells_a_shadow_from_paint(options, tolerance):
    """Two tiles that reach into a shadow: it darkens as they say, where a texture of any kind is as good without."""
    tiles = np.where(np.arange(12) < 6, 0.2, 0.8)[:, None]
    is_shaded = torch.arange(12)[:, None, None] < 6
    seen = torch.where(is_shaded, 0.85, 1.0) * torch.from_numpy(tiles)
    texture = Texture(GROUND, **options)
    values = {"texels": torch.full((12, 12, 3), 0.5, dtype=torch.float64), "palette": torch.tensor([[0.25], [0.75]])}
    shadow = torch.ones((), dtype=torch.float64)
    leaves = [leaf.requires_grad_() for leaf in (*values.values(), shadow)]
    optimizer = torch.optim.Adam(leaves, lr=0.02)
    for _ in range(300):
        optimizer.zero_grad()
        loss = (values["texels"] * torch.where(is_shaded, shadow, 1.0) - seen).square().sum(dim=-1).mean()
        (loss + (texture.regularizer(values, None) or 0)).backward()
        optimizer.step()
    error = abs(shadow.item() - 0.85)
    assert error > 0.03 if tolerance is None else error < tolerance


def test_a_texture_is_found_where_light_bounces(scene):
    problem, context, values = prepared(dataclasses.replace(scene, bounces=1), [Texture(GROUND)])
    found = problem.fitted_scene(values, context).scene
    assert found.bounces == 1
    assert found.bodies[GROUND].texture.shape == scene.bodies[GROUND].texture.shape


def setting_of(scene):
    return prepared(scene, [Exposure()])[1]


# ---------------------------------------------------------------------------------------------- gradients


def loss_of(problem, context) -> Callable[[dict], torch.Tensor]:
    """The loss that a fit descends as a function of values, of images at full size, regularizers included."""
    model = Model(problem, context, Stage())

    def loss(values: dict) -> torch.Tensor:
        energies = [free.regularizer(values[free.name], context) for free in problem.free]
        images = model.images(values).double()  # so that differences of sums over pixels are not of float32
        unlikeness = problem.loss(images, model.targets, model.weights, context.unit)
        return sum((regularizer for regularizer in energies if regularizer is not None), unlikeness)

    return loss


# A step for each: large where the loss is nearly a square, and small against a pixel where the camera moves.
GRADIENTS = {
    "light in harmonics": ([Light(3, nonnegativity=0.5)], 0.05),
    "light in cells": ([Light(None, 64)], 0.05),
    "exposure": ([Exposure()], 0.05),
    "albedo": ([Albedo(BALL)], 0.05),
    "albedo of vertices": ([Albedo(BALL, per_vertex=True)], 0.05),
    "texture": ([Texture(GROUND, smoothness=1.0)], 0.05),
    "texture of few edges": ([Texture(GROUND, total_variation=1.0)], 0.001),
    "texture of few colors": ([Texture(GROUND, palette=1.0, colors=3)], 0.001),
    "pose": ([Pose(BALL, scale=True)], 0.005),
    "pose by quaternion": ([Pose(BALL, "quaternion")], 0.005),
    "pose by columns": ([Pose(BALL, "6d")], 0.005),
    "deformation": ([Deformation(BALL, rigidity=1.0)], 0.005),
    "radii": ([Radii(BALL, persistence=0.1)], 0.01),
    "camera": ([CameraPose(focal=True)], 0.0005),
    "pose, deformation and radii": ([Pose(BALL, scale=True), Deformation(BALL, rigidity=1.0), Radii(BALL)], 0.005),
}
MESHES_MOVE = {"pose", "pose by quaternion", "pose by columns", "deformation", "radii", "camera"}
MESHES_MOVE |= {"pose, deformation and radii"}


@pytest.mark.slow
@pytest.mark.parametrize("case", GRADIENTS)
def test_the_gradient_of_the_loss_is_its_central_difference(soft_scene, dim_scene, case):
    """Of each number where there are few, and in random directions; where meshes move, of the ground in view.

    Silhouettes are differentiated to first order in the pixel only, so they are masked out.
    """
    free, step = GRADIENTS[case]
    scene = dim_scene if case == "light in cells" else soft_scene
    mask = clear_of_outlines(scene) if case in MESHES_MOVE else None
    pattern = np.random.default_rng(1).uniform(0, 1, (6, 8, 4)).repeat(4, axis=0).repeat(4, axis=1)
    problem, context, start = prepared(scene, free, [Target(pattern, mask=mask)])
    values = moved(start, 0.02, seed=1)
    leaves = {(name, key): tensor.requires_grad_() for name, own in values.items() for key, tensor in own.items()}
    loss = loss_of(problem, context)
    loss(values).backward()
    generator = torch.Generator().manual_seed(2)
    # each direction with its largest number 1, so that no number takes more than a step
    random = [{at: torch.randn(leaf.shape, generator=generator) for at, leaf in leaves.items()} for _ in range(3)]
    directions = [
        {at: part / max(p.abs().max() for p in each.values()) for at, part in each.items()} for each in random
    ]
    for at, leaf in leaves.items():
        numbers = range(leaf.numel()) if leaf.numel() <= 6 else range(0)
        directions += [{at: torch.eye(leaf.numel())[k].reshape(leaf.shape)} for k in numbers]
    gradients, differences = [], []
    with torch.no_grad():
        for direction in directions:

            def along(amount, direction=direction):
                shifted = {
                    name: {key: t + amount * direction.get((name, key), 0) for key, t in own.items()}
                    for name, own in values.items()
                }
                return float(loss(shifted))

            near, far = along(step) - along(-step), along(2 * step) - along(-2 * step)
            differences.append((8 * near - far) / (12 * step))
            gradients.append(sum(float((leaves[at].grad * part).sum()) for at, part in direction.items()))
    gradients, differences = np.array(gradients), np.array(differences)
    error = np.abs(gradients - differences).max() / np.abs(differences).max()
    assert np.abs(differences).max() > 1e-3  # a gradient of nothing would be easy
    assert error < DIFFERENCE, (error, gradients, differences)


def test_every_free_number_of_a_posed_body_has_an_influence(scene):
    """So that no rotation is passed over: the lump's shadow shows all three."""
    problem, context, start = prepared(
        scene, [Pose(BALL, scale=True)], [Target(ws.Renderer(scene).render()[..., :3] * 0.7)]
    )
    values = moved(start, 0.01)
    leaves = [tensor.requires_grad_() for tensor in values["pose[0]"].values()]
    loss_of(problem, context)(values).backward()
    assert all((leaf.grad.abs() > 1e-4).all() for leaf in leaves)


# ---------------------------------------------------------------------------------------------- recovery

# What is moved how far, learning rate, and what part of the way may remain. Shapes, cells and vertices that the image
# hardly shows stay behind, and a camera's focal length is as good as its distance: there the images alone must agree.
RECOVERY = {
    "light in harmonics": ([Light(3)], 0.1, 0.03, None),
    "light in cells": ([Light(None, 64)], 0.3, 0.1, None),
    "exposure": ([Exposure()], 0.5, 0.1, 0.02),
    "albedo": ([Albedo(BALL)], 0.1, 0.05, 0.02),
    "albedo of vertices": ([Albedo(BALL, per_vertex=True)], 0.1, 0.05, None),
    "texture": ([Texture(GROUND)], 0.1, 0.05, None),
    "pose": ([Pose(BALL)], 0.05, 0.02, 0.3),
    "deformation": ([Deformation(BALL, rigidity=0)], 0.03, 0.01, None),
    "radii": ([Radii(BALL)], 0.1, 0.03, 0.3),
    "camera": ([CameraPose(focal=True)], 0.03, 0.01, None),
    "pose and light in harmonics": ([Pose(BALL), Light(2)], 0.05, 0.02, 0.3),
}


ITERATIONS = 60


@pytest.mark.slow
@pytest.mark.parametrize("case", RECOVERY)
def test_each_recovers_the_truth(scene, dim_scene, case):
    free, distance, rate, remains = RECOVERY[case]
    scene = dim_scene if case == "light in cells" else scene
    problem, context, start = prepared(scene, free, blank(VIEWS))
    truth = moved(start, distance, seed=5)
    for parameter in free:
        parameter.project(truth[parameter.name])
    images = images_of(problem, context, truth)
    targets = [Target(image, camera=camera(view)) for view, image in enumerate(images)]
    # light is in units of the targets, which were blank
    unit = context.unit
    problem = Problem(scene, targets, free, still=None)
    context = problem.context(torch.device("cpu"))
    start = problem.start(context)
    if "light in harmonics" in case:
        truth["light"]["coefficients"] *= unit / context.unit
    result = fit(problem, [Stage(ITERATIONS, learning_rate=rate)])
    assert min(result.losses[-1]) < 0.05 * result.losses[0][0]
    after, before = (np.abs(found - images).mean() for found in (result.images(), result.images_at_start()))
    assert after < 0.2 * before
    if remains is not None:
        assert _distance(result.values, truth) < remains * _distance(start, truth)


def test_light_is_found_to_the_last_coefficient_by_a_method_of_second_order(scene):
    """The loss is a square of the light, badly conditioned as the camera sees few normals."""
    light = scene.light + np.random.default_rng(4).normal(size=scene.light.shape) * 0.3
    image = ws.Renderer(dataclasses.replace(scene, light=light)).render()
    problem = Problem(scene, Target(image), Light(3, nonnegativity=0.0), still=None)  # this light is below 0 in places
    result = fit(problem, [Stage(20, learning_rate=1.0)], optimizer=torch.optim.LBFGS)
    assert np.abs(result.scene.light - light).max() < 0.02


def _distance(values, truth) -> float:
    squares = [
        float((values[name][key] - truth[name][key]).square().sum()) for name, own in truth.items() for key in own
    ]
    return math.sqrt(sum(squares))
