"""A free plane: what stands on it moves along, its priors and points count, and images find it."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import warpshadow as ws
from warpshadow.inverse import Plane, Pose, Problem, Stage, Target, fit, load_fit
from warpshadow.inverse.constraints import plane_below
from warpshadow.inverse.free.base import PRIOR
from warpshadow.inverse.model import Model

# Float32 of positions of a few units.
FLOAT32 = 4e-6
GRAY = np.full((36, 48, 3), 0.3)


def box(size=(1.0, 2.0, 1.4), name="box", **placement) -> ws.Body:
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size
    faces = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)]
    faces += [(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
    mesh = ws.Mesh(corners.astype(np.float32), np.array(faces))
    return ws.Body(mesh, albedo=(0.7, 0.4, 0.2), blockers=0, name=name, **placement)


def scene(turn=(0.0, 0.0, 0.0), height: float = 0.0, **standing) -> ws.Scene:
    table = ws.Body(
        ws.plane(8.0, 4), blockers=0, rotation=turn, translation=(0, height, 0), albedo=(0.1,) * 3, name="table"
    )
    standing = {"rotation": (0, 20, 0), "translation": (0.3, 1.0, -0.2)} | standing
    above = table.rotation_matrix() @ (-1.2, 0.4, 0.2) + (0, height, 0)
    crate = box((0.8, 0.8, 0.8), "crate", rotation=turn, translation=above)
    light = np.zeros((4, 3))
    light[:, :] = np.array([3.0, 1.0, 0.6, -0.8])[:, None]
    camera = ws.Camera.look_at((1, 3, 5), (0, 0.8, 0), size=(48, 36))
    return ws.Scene((box(**standing), table, crate), light, camera, ws.Visibility("none"))


def shaken(problem: Problem, seed: int):
    context = problem.context(torch.device("cpu"))
    generator = torch.Generator().manual_seed(seed)
    values = {
        name: {key: tensor + 0.3 * torch.randn(tensor.shape, generator=generator) for key, tensor in own.items()}
        for name, own in problem.start(context).items()
    }
    return values, context


def lowest(body: ws.Body, plane) -> float:
    return float((body.world_points() @ plane.normal).min() - plane.offset)


@pytest.mark.parametrize("resting", ["stable", "free"])
def test_bodies_stay_on_the_plane_wherever_it_moves(resting):
    where = scene((6, 0, -4), 0.3, translation=(0.3, 2.0, -0.2))
    free = [Plane("table", carries=["crate"]), Pose("box", stands_on="table", resting=resting)]
    problem = Problem(where, Target(GRAY), free)
    values, context = shaken(problem, 1)
    bodies = problem.fitted_scene(values, context).scene.bodies
    before, after = (plane_below(table, np.array([0, 9.0, 0])) for table in (where.bodies[1], bodies[1]))
    assert before.normal @ after.normal < 0.999 and abs(lowest(bodies[0], after)) < FLOAT32
    assert abs(lowest(bodies[2], after) - lowest(where.bodies[2], before)) < FLOAT32
    turn = Rotation.from_matrix(bodies[1].rotation_matrix() @ where.bodies[1].rotation_matrix().T).as_rotvec()
    assert abs(turn @ before.normal) < FLOAT32  # not about its normal
    assert [item.name for item in problem.free] == ["pose[0]", "plane[1]"]


def test_a_fit_renders_the_bodies_where_they_are_found():
    problem = Problem(scene(), Target(GRAY), [Pose("box", stands_on="table"), Plane("table", carries=["crate"])])
    values, context = shaken(problem, 2)
    with torch.no_grad():
        image = Model(problem, context, Stage()).images(values)[0]
    found = ws.render(problem.fitted_scene(values, context).scene)
    np.testing.assert_allclose(image, found, atol=1e-4)


def test_images_have_the_derivatives_of_a_plane_that_bodies_shadow():
    """The bodies stay, a little above it: where they touch it, the images have edges."""
    where = scene(translation=(0.3, 1.1, -0.2))
    light = ws.CellBasis(ws.fibonacci(64)).to_map(np.geomspace(0.1, 4, 64)[:, None] * np.ones(3))
    crate = dataclasses.replace(where.bodies[2], blockers=8, translation=(-1.2, 0.5, 0.2))
    where = dataclasses.replace(
        where, bodies=(*where.bodies[:2], crate), light=light, visibility=ws.Visibility(directions=64)
    )
    problem = Problem(where, Target(GRAY), Plane("table"))
    context = problem.context(torch.device("cpu"))
    model, start = Model(problem, context, Stage()), problem.start(context)["plane[1]"]
    weights = torch.linspace(0.5, 1.5, 48)[None, None, :, None]

    def total(step: dict) -> torch.Tensor:
        values = {key: tensor + step.get(key, 0.0) for key, tensor in start.items()}
        return (weights * model.images({"plane[1]": values})[..., :3]).sum()

    leaves = {key: torch.zeros_like(tensor).requires_grad_() for key, tensor in start.items()}
    total(leaves).backward()
    for key, away in (("height", torch.tensor(1e-2)), ("tilt", torch.tensor([1e-2, 0.0]))):
        with torch.no_grad():
            slope = float(total({key: away}) - total({key: -away})) / 2e-2
        assert float(leaves[key].grad.view(-1)[0]) == pytest.approx(slope, rel=0.02)


def test_points_tell_where_the_plane_is():
    true_turn = Rotation.from_euler("xz", [4.0, -3.0], degrees=True)
    flat = np.random.default_rng(0).uniform(-2, 2, (20, 3)) * (1, 0, 1)
    points = true_turn.apply(flat) + (0, 0.25, 0)
    problem = Problem(scene(), Target(GRAY), Plane("table", points=points, deviation=0.01))
    context = problem.context(torch.device("cpu"))
    values = problem.start(context)
    (free,) = problem.free
    plane = plane_below(problem.fitted_scene(values, context).scene.bodies[1], np.array([0, 9.0, 0]))
    np.testing.assert_allclose(points @ plane.normal - plane.offset, 0, atol=FLOAT32)
    assert float(free.regularizer(values[free.name], context)) < 1e-4 * PRIOR
    values["plane[1]"]["height"] += 0.02
    reached = problem.fitted_scene(values, context).scene.bodies[1]
    gaps = points @ plane.normal - plane_below(reached, np.array([0, 9.0, 0])).offset
    expected = PRIOR * (gaps**2).sum() / 0.01**2
    assert float(free.regularizer(values[free.name], context)) == pytest.approx(expected, rel=1e-3)


def test_priors_and_their_derivatives_are_in_standard_deviations():
    points = np.random.default_rng(0).uniform(-2, 2, (5, 3))
    free = Plane("table", height=0.1, tilt=0.05, points=points, deviation=0.5)
    problem = Problem(scene(), Target(GRAY), [dataclasses.replace(free, points=None, deviation=None)])
    context = problem.context(torch.device("cpu"))
    plain, values = problem.free[0], {"tilt": torch.tensor([0.05, -0.1]), "height": torch.tensor(0.0)}
    assert float(plain.regularizer(values, context)) == pytest.approx(5 * PRIOR, rel=1e-5)
    values["tilt"].requires_grad_()
    values["height"] = torch.tensor(0.1).requires_grad_()
    whole = free.numbered(problem.scene)
    whole.regularizer(values, context).backward()
    for key, tensor in values.items():
        for number in range(tensor.numel()):
            ends = []
            for step in (1e-2, -1e-2):
                moved = {name: own.detach().clone() for name, own in values.items()}
                moved[key].view(-1)[number] += step
                ends.append(float(whole.regularizer(moved, context)) / PRIOR)
            slope = (ends[0] - ends[1]) / 2e-2
            assert float(tensor.grad.view(-1)[number]) / PRIOR == pytest.approx(slope, rel=5e-3)


def test_a_plane_and_the_body_on_it_are_found():
    """From an image alone: the body is known, so its plane is where it stands."""
    truth = scene()
    start = scene((2.0, 0, -3.0), -0.15, rotation=(0, 8, 0), translation=(0.45, 1.1, -0.1))
    free = [Pose("box", stands_on="table"), Plane("table", height=0.5, tilt=0.2, carries=["crate"])]
    result = fit(Problem(start, Target(ws.render(truth)[..., :3]), free), [Stage(80, 0.1)], progress=False)
    for found, true in zip(result.scene.bodies[:2], truth.bodies[:2], strict=True):
        gaps = found.world_points() - true.world_points()
        assert np.abs(gaps[:, 1]).max() < 0.005  # of up to 0.36
    known = result.uncertainty
    assert known.poses["box"].shift[1] > 0  # by the plane's height alone
    assert {"plane[1].height[0]", "plane[1].tilt[1]"} <= set(known.deviations)


@pytest.mark.parametrize(
    ("free", "message"),
    [
        (Plane("box"), "body: got 'box', which is not flat"),
        (Plane("table", carries=["table"]), "carries: got 1, the plane itself"),
        ([Plane("table"), Pose("table")], "free: got pose[1] and plane[1], expected one of them: both place the body"),
        (
            [Plane("table"), Pose("box", stands_on="table", distance=(5, 0.1))],
            "pose[0]: got a distance beside a free plane[1]",
        ),
    ],
)
def test_planes_that_cannot_be_free_are_refused(free, message):
    with pytest.raises(ValueError) as caught:
        Problem(scene(), Target(GRAY), free)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"height": 0.0}, "height: got 0"),
        ({"points": np.eye(3)}, "points, deviation: got one of them"),
        ({"points": [[0, 0, 0], [1, 1, 1], [2, 2, 2]], "deviation": 0.1}, "points: got 3 in a line"),
        ({"carries": "crate"}, "carries: got 'crate', expected a list"),
    ],
)
def test_mistakes_are_named(options, message):
    with pytest.raises(ValueError) as caught:
        Plane("table", **options)
    assert message in str(caught.value)


def test_a_fit_file_frees_a_plane(tmp_path):
    ws.write_scene(scene(), tmp_path)
    ws.write_image(tmp_path / "photo.exr", GRAY)
    (tmp_path / "fit.toml").write_text(
        'scene = "scene.toml"\n[[target]]\nimage = "photo.exr"\n[[free.plane]]\nbody = "table"\nheight = 0.1\n'
        "points = [[0, 0, 0], [1, 0, 0], [0, 0.1, 1]]\ndeviation = 0.01\ncarries = ['crate']\n"
        '[[free.pose]]\nbody = "box"\nstands_on = "table"\n'
    )
    pose, plane = load_fit(tmp_path / "fit.toml").problem.free
    points = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.1, 1.0))
    assert pose == Pose(0, stands_on=1)
    assert plane == Plane(1, height=0.1, points=points, deviation=0.01, carries=(0, 2))
