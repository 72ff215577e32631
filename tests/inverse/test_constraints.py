"""Constraints of a pose: poses that stay possible, at any values, with their derivatives; and priors."""

import dataclasses
import re
import warnings

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

import warpshadow as ws
from warpshadow.inverse import Pose, Problem, Stage, Target, fit, load_fit
from warpshadow.inverse.constraints import hull_points, plane_below, stable_rotation, turn_onto
from warpshadow.inverse.free.base import PRIOR
from warpshadow.inverse.report import found_values

# Float32 of positions of a few units.
FLOAT32 = 2e-6
# Central differences of float32 values.
DIFFERENCE = 2e-3
TRUE_TURN, TILT = 12.0, (14.0, 0.0, -9.0)  # degrees


def box(rotation=(0.0, 0.0, 0.0), translation=(0.0, 1.0, 0.0)) -> ws.Body:
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-1, 1) for z in (-0.7, 0.7)], np.float32)
    faces = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)]
    faces += [(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
    mesh = ws.Mesh(corners, np.array(faces))
    return ws.Body(mesh, albedo=(0.7, 0.4, 0.2), blockers=0, rotation=rotation, translation=translation, name="box")


def scene(body: ws.Body, ground_turn=(0.0, 0.0, 0.0), height: float = 0.0) -> ws.Scene:
    ground = ws.Body(
        ws.plane(8.0, 4), blockers=0, rotation=ground_turn, translation=(0, height, 0), albedo=(0.1,) * 3, name="table"
    )
    light = np.zeros((4, 3))
    light[:, :] = np.array([3.0, 1.0, 0.6, -0.8])[:, None]
    camera = ws.Camera.look_at((1, 3, 5), (0, 0.8, 0), size=(48, 36))
    return ws.Scene((body, ground), light, camera, ws.Visibility("none"))


def prepared(where: ws.Scene, pose: Pose):
    problem = Problem(where, Target(np.full((36, 48, 3), 0.3)), pose)
    context = problem.context(torch.device("cpu"))
    (free,) = problem.free
    return free, context, free.start(context)


def moved_body(free: Pose, context, values) -> ws.Body:
    problem = Problem(context.scene, Target(np.full((36, 48, 3), 0.3)), free)
    return problem.fitted_scene({free.name: values}, context).scene.bodies[0]


def shaken(values: dict, seed: int) -> dict:
    generator = torch.Generator().manual_seed(seed)
    return {key: tensor + 0.5 * torch.randn(tensor.shape, generator=generator) for key, tensor in values.items()}


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("resting", ["stable", "given", "free"])
def test_a_body_that_stands_touches_its_plane_at_any_values(resting, seed):
    where = scene(box(TILT, (0.3, 2.0, -0.2)), ground_turn=(10, 0, 5), height=0.4)
    free, context, values = prepared(where, Pose("box", stands_on="table", resting=resting))
    assert values["turn"].numel() + values["shift"].numel() == (5 if resting == "free" else 3)
    body = moved_body(free, context, shaken(values, seed))
    plane = plane_below(where.bodies[1], np.array([0.0, 5.0, 0.0]))
    heights = np.sort(body.world_mesh().positions.astype(np.float64) @ plane.normal - plane.offset)
    assert abs(heights[0]) < 4 * FLOAT32
    lies_flat = heights[3] < 4 * FLOAT32
    assert lies_flat == (resting == "stable")
    if resting == "given":  # as steep as before
        up = body.rotation_matrix().T @ plane.normal
        np.testing.assert_allclose(up, where.bodies[0].rotation_matrix().T @ plane.normal, atol=10 * FLOAT32)


@pytest.mark.parametrize(
    ("ground_turn", "fixed"),
    [((0, 0, 0), ["x", "z"]), ((0, 0, 0), ["x"]), ((10, 0, 5), ["y"]), ((10, 0, 5), ["x", "y"]), ((0, 0, 90), ["y"])],
)
@pytest.mark.parametrize("resting", ["stable", "free"])
def test_what_is_fixed_stays_beside_a_plane(ground_turn, fixed, resting):
    where = scene(box(TILT, (0.3, 2.0, -0.2)), ground_turn=ground_turn, height=0.4)
    pose = Pose("box", stands_on="table", resting=resting, fixed=fixed)
    free, context, values = prepared(where, pose)
    body, start = moved_body(free, context, shaken(values, 4)), where.bodies[0]
    plane = plane_below(where.bodies[1], np.array(start.translation))
    lowest = (body.world_mesh().positions.astype(np.float64) @ plane.normal).min() - plane.offset
    assert abs(lowest) < 10 * FLOAT32
    stays = ["xyz".index(axis) for axis in fixed]  # the mesh's middle is its origin
    np.testing.assert_allclose(np.array(body.translation)[stays], np.array(start.translation)[stays], atol=FLOAT32)


@pytest.mark.parametrize(
    ("ground_turn", "fixed"), [((0, 0, 0), ["y"]), ((0, 0, 90), ["x", "z"]), ((10, 0, 5), ["z", "y", "x"])]
)
def test_what_cannot_stay_beside_a_plane_is_refused(ground_turn, fixed):
    with pytest.raises(ValueError, match=r"free\[0\].*fixed: got \[.*\] beside stands_on a plane of normal"):
        prepared(scene(box(), ground_turn=ground_turn), Pose("box", stands_on="table", fixed=fixed))


@pytest.mark.parametrize(("tilt", "down"), [(20.0, [0, -1, 0]), (70.0, [0, 0, -1])])
def test_a_box_rests_on_the_face_that_needs_the_least_turn(tilt, down):
    start = Rotation.from_euler("YX", [40.0, -tilt], degrees=True).as_matrix()
    resting = stable_rotation(box().mesh, start, np.array([0.0, 1.0, 0.0]))
    np.testing.assert_allclose(np.abs(resting @ down), [0, 1, 0], atol=1e-9)
    turned_by = np.degrees(Rotation.from_matrix(resting @ start.T).magnitude())
    np.testing.assert_allclose(turned_by, min(tilt, 90 - tilt), atol=1e-6)


def test_a_body_does_not_rest_where_it_would_tip_over():
    """A slanted prism: its small base is nearest, and its centroid is beside it."""
    points = np.array([[0, 0, 0], [0.3, 0, 0], [0, 0, 1], [0.3, 0, 1], [2, 1, 0], [3, 1, 0], [2, 1, 1], [3, 1, 1]])
    faces = np.array([(0, 1, 2), (1, 3, 2), (4, 6, 5), (5, 6, 7), (0, 4, 1), (1, 4, 5), (2, 3, 6), (3, 7, 6)])
    resting = stable_rotation(ws.Mesh(points.astype(np.float32), faces), np.eye(3), np.array([0.0, 1.0, 0.0]))
    lowest = np.sort((points @ resting.T)[:, 1])
    assert np.ptp(lowest[:4]) < 1e-6
    assert np.degrees(Rotation.from_matrix(resting).magnitude()) > 15


def hull_mesh(points: np.ndarray) -> ws.Mesh:
    return ws.Mesh(points.astype(np.float32), ConvexHull(points).simplices)


def test_a_tall_body_does_not_rest_on_its_chamfer():
    """The centroid projects into a narrow facet beside the base, from which half a degree tips the body over."""
    profile = np.array([(-0.40, 0.0084), (-0.34, 0.0), (0.5, 0.0), (0.5, 6.0), (-0.40, 6.0)])
    post = hull_mesh(np.array([(x, y, z) for x, y in profile for z in (-0.5, 0.5)]))
    up, chamfer = np.array([0.0, 1.0, 0.0]), np.array([-0.0084, -0.06, 0.0]) / np.hypot(0.0084, 0.06)
    start = turn_onto(chamfer, -up)
    resting = stable_rotation(post, start, up)
    np.testing.assert_allclose(resting @ up, up, atol=1e-6)
    sphere = ws.icosphere(1.0, 2)  # returns to no facet, and rests on the nearest that it can
    assert np.degrees(Rotation.from_matrix(stable_rotation(sphere, start, up) @ start.T).magnitude()) < 15


def test_the_base_of_a_scan_is_the_plane_nearest_to_all_of_it():
    """Of a base of 9 × 9 vertices, two grains below the middle: the post leans on them and on an edge."""
    rows = np.linspace(-0.5, 0.5, 9)
    base = np.array([(x, 0.0, z) for x in rows for z in rows])
    base[np.isclose(base[:, 2], 0.125) & np.isclose(np.abs(base[:, 0]), 0.25), 1] = -0.008
    top = np.array([(x, 2.0, z) for x in (-0.5, 0.5) for z in (-0.5, 0.5)])
    scan, up = hull_mesh(np.concatenate([base, top])), np.array([0.0, 1.0, 0.0])
    start = Rotation.from_euler("X", 9.0, degrees=True).as_matrix()
    tilts = []
    for uneven in (False, True):
        resting = stable_rotation(scan, start, up, base_is_uneven=uneven)
        tilts.append(np.degrees(np.arccos(np.clip((resting @ up) @ up, -1, 1))))
    assert tilts[1] < 0.1 < 0.5 < tilts[0]


@pytest.mark.parametrize("resting", ["stable", "given"])
def test_a_prior_of_the_tilt_counts_in_standard_deviations_at_any_turn(resting):
    where = scene(box(TILT, (0.3, 2.0, -0.2)), ground_turn=(10, 0, 5), height=0.4)
    free, context, values = prepared(where, Pose("box", stands_on="table", resting=resting, tilt=0.01))
    assert values["turn"].numel() == 3 and values["shift"].numel() == 2
    for turn, cost in (([1.3, 0.0, 0.0], 0.0), ([0.0, 0.02, 0.0], 4.0), ([0.0, -0.01, 0.02], 5.0)):
        turned = values | {"turn": torch.tensor(turn)}
        assert abs(float(free.regularizer(turned, context)) - cost * PRIOR) < 1e-2 * PRIOR
        body = moved_body(free, context, turned)
        plane = plane_below(where.bodies[1], np.array([0.0, 5.0, 0.0]))
        lowest = (body.world_mesh().positions.astype(np.float64) @ plane.normal).min() - plane.offset
        assert abs(lowest) < 4 * FLOAT32
    scattered = [free.scattered(values, number, torch.Generator())["turn"] for number in range(2)]
    np.testing.assert_allclose(scattered, [[0.55, 0, 0], [-0.55, 0, 0]], atol=1e-6)
    assert not values["turn"].any()


def test_a_scan_that_stands_a_little_tilted_is_found():
    leaning = box((2.5, TRUE_TURN, 0))
    leaning = dataclasses.replace(leaning, translation=(0, 1.0 - float(leaning.world_points()[:, 1].min()), 0))
    truth = scene(leaning)
    start = dataclasses.replace(truth, bodies=(box(TILT, (0.15, 1.4, -0.1)), truth.bodies[1]))
    errors = []
    for tilt in (None, 0.1):
        problem = Problem(start, Target(ws.render(truth)[..., :3]), Pose("box", stands_on="table", tilt=tilt))
        found = fit(problem, [Stage(60, 0.1)], progress=False).scene.bodies[0]
        gaps = found.world_mesh().positions - leaning.world_mesh().positions
        errors.append(np.linalg.norm(gaps, axis=1).max())
    assert errors[1] < 0.02 < 0.06 < errors[0]


@pytest.mark.parametrize(
    ("options", "turns", "stays"),
    [({"upright": True}, [0, 1, 0], []), ({"axis": (0, 0, -3)}, [0, 0, 1], []), ({"fixed": ["y", "z"]}, None, [1, 2])],
)
def test_a_pose_keeps_its_axis_and_its_fixed_coordinates(options, turns, stays):
    where = scene(box(TILT))
    free, context, values = prepared(where, Pose(0, **options))
    body = moved_body(free, context, shaken(values, 2))
    turn = Rotation.from_matrix(body.rotation_matrix() @ where.bodies[0].rotation_matrix().T).as_rotvec()
    if turns is not None:
        assert np.linalg.norm(turn) > 0.05
        np.testing.assert_allclose(np.cross(turn, turns), 0, atol=10 * FLOAT32)
    middle = np.array(body.translation)  # of a mesh whose middle is its origin
    np.testing.assert_allclose(middle[stays], np.array(where.bodies[0].translation)[stays], atol=FLOAT32)
    assert np.abs(np.delete(middle - where.bodies[0].translation, stays)).min() > 1e-3


def test_the_height_has_the_derivative_of_the_lowest_vertex():
    where = scene(box(TILT))
    free, context, values = prepared(where, Pose(0, stands_on=1, resting="free", scale=True))
    values = {key: tensor.requires_grad_() for key, tensor in shaken(values, 3).items()}
    weights = torch.tensor([0.3, -1.0, 0.7])

    def read(place: dict) -> torch.Tensor:
        return weights @ free.moved(place, context)[1]

    read(values).backward()
    for key, tensor in values.items():
        for number in range(tensor.numel()):
            step = torch.zeros_like(tensor).view(-1)
            step[number] = 1e-3
            step = step.view_as(tensor)
            with torch.no_grad():
                slope = float(read(values | {key: tensor + step}) - read(values | {key: tensor - step})) / 2e-3
            assert abs(float(tensor.grad.view(-1)[number]) - slope) < DIFFERENCE


def test_a_tilted_start_that_stands_is_found():
    truth = scene(box((0, TRUE_TURN, 0)))
    start = dataclasses.replace(truth, bodies=(box(TILT, (0.15, 1.4, -0.1)), truth.bodies[1]))
    problem = Problem(start, Target(ws.render(truth)[..., :3]), Pose("box", stands_on="table"))
    found = fit(problem, [Stage(60, 0.1)], progress=False).scene.bodies[0]
    gaps = found.world_mesh().positions - truth.bodies[0].world_mesh().positions
    assert np.linalg.norm(gaps, axis=1).max() < 0.01


def test_candidates_of_a_body_that_stands_turn_about_the_normal():
    free, context, values = prepared(scene(box(TILT)), Pose(0, stands_on=1, spread=0.3))
    turns = [float(free.scattered(values, number, torch.Generator())["turn"]) for number in range(4)]
    np.testing.assert_allclose(turns, [0.3, -0.3, 0.6, -0.6], atol=1e-6)


def test_priors_count_in_standard_deviations():
    where = scene(box(TILT))
    eye, body = where.camera.eye, where.bodies[0]
    distance = float(np.linalg.norm(eye - body.translation))
    low, high = body.mesh.bounds
    size = float(np.linalg.norm(high - low))
    priors = {"distance": (distance + 0.4, 0.2), "size": (size * 1.1, size * 0.05), "covariance": [0.1] * 6}
    free, context, values = prepared(where, Pose(0, scale=True, **priors))
    assert abs(float(free.regularizer(values, context)) - 8 * PRIOR) < 1e-2 * PRIOR
    turned = values | {"turn": torch.tensor([0.1, 0.0, -0.2])}
    assert abs(float(free.regularizer(turned, context)) - 13 * PRIOR) < 2e-2 * PRIOR
    turned["turn"].requires_grad_()
    free.regularizer(turned, context).backward()
    np.testing.assert_allclose(turned["turn"].grad, PRIOR * 2 * np.array([0.1, 0, -0.2]) / 0.01, atol=1e-2 * PRIOR)
    assert prepared(where, Pose(0))[0].regularizer(values, context) is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"stands_on": 0}, "stands_on: got 0, the body itself"),
        ({"stands_on": "floor"}, "stands_on: got 'floor'"),
        ({"resting": "lying"}, "resting: got 'lying'"),
        ({"fixed": "y"}, "fixed: got 'y'"),
        ({"fixed": ["w"]}, "fixed: got 'w'"),
        ({"axis": (0, 0, 0)}, "axis: got"),
        ({"upright": True, "axis": (1, 0, 0)}, "expected one axis"),
        ({"stands_on": 1, "rotation": "6d"}, "rotation: got '6d' beside stands_on"),
        ({"tilt": 0.1}, "tilt: got a prior of a tilt from no support"),
        ({"tilt": 0.1, "stands_on": 1, "resting": "free"}, "tilt: got a prior of a tilt from no support"),
        ({"tilt": 0.0, "stands_on": 1}, "tilt: got 0.0, expected a positive number"),
        ({"size": (1, 0.1)}, "size: got a prior of a size that is not free"),
        ({"distance": (1, 0)}, "distance"),
        ({"covariance": np.zeros((6, 6))}, "covariance: got a matrix"),
    ],
)
def test_mistakes_are_named(options, message):
    with pytest.raises(ValueError) as caught:
        Problem(scene(box()), Target(np.full((36, 48, 3), 0.3)), Pose(0, **options))
    assert message in str(caught.value)


def test_a_body_stands_on_flat_ones_alone():
    where = scene(box())
    where = dataclasses.replace(where, bodies=(where.bodies[0], dataclasses.replace(box(), name="crate")))
    with pytest.raises(ValueError, match="'crate', which is not flat"):
        Problem(where, Target(np.full((36, 48, 3), 0.3)), Pose(0, stands_on="crate"))


def test_a_fit_file_has_the_same_keys(tmp_path):
    ws.write_scene(scene(box()), tmp_path)
    ws.write_image(tmp_path / "photo.exr", np.full((36, 48, 3), 0.3))
    (tmp_path / "fit.toml").write_text(
        'scene = "scene.toml"\n[[target]]\nimage = "photo.exr"\n[[free.pose]]\nbody = "box"\nstands_on = "table"\n'
        'scale = true\ntilt = 0.03\nfixed = ["x"]\nsize = [2.6, 0.1]\ndistance = [5.0, 0.2]\n'
    )
    (pose,) = load_fit(tmp_path / "fit.toml").problem.free
    wanted = Pose(0, scale=True, stands_on=1, tilt=0.03, fixed=("x",), size=(2.6, 0.1), distance=(5.0, 0.2))
    assert pose == wanted


def test_a_hull_has_the_lowest_vertex_of_any_rotation():
    mesh = ws.icosphere(1.0, 2)
    hull = hull_points(mesh)
    for seed in range(5):
        down = np.random.default_rng(seed).standard_normal(3)
        assert (hull @ down).min() == pytest.approx((mesh.positions.astype(np.float64) @ down).min(), abs=1e-12)


def test_a_warning_says_by_how_much_a_body_is_turned_onto_its_stable_support():
    for pose in (Pose("box", stands_on="table"), Pose("box", stands_on="table", resting="stable")):
        with pytest.warns(UserWarning, match=r'box was turned by 1\.2° onto its stable support; resting = "given"'):
            free, context, values = prepared(scene(box((1.2, 0.0, 0.0))), pose)
        np.testing.assert_allclose(moved_body(free, context, values).rotation_matrix(), np.eye(3), atol=1e-6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        prepared(scene(box((0.0, 30.0, 0.0))), Pose("box", stands_on="table"))
        prepared(scene(box((1.2, 0.0, 0.0))), Pose("box", stands_on="table", resting="given"))


def test_a_body_that_touches_the_plane_stands_as_in_the_scene_and_the_result_says_so():
    placed = box((1.2, 0.0, 0.0)).on_ground((0.2, 0.0, 0.1))
    problem = Problem(scene(placed), Target(np.full((36, 48, 3), 0.3)), Pose("box", stands_on="table"))
    with pytest.warns(UserWarning, match=r'box stands 1\.2° off its stable support; resting = "stable" turns it'):
        result = fit(problem, Stage(1), progress=False)
    start, found = placed.rotation_matrix(), result.scene.bodies[0].rotation_matrix()
    np.testing.assert_allclose(found[:, 1] @ [0, 1, 0], start[:, 1] @ [0, 1, 0], atol=1e-5)
    assert any(re.fullmatch(r"box +stands 1\.2° off its stable support", line) for line in found_values(result))
    assert str(result.uncertainty.poses["box"]).endswith("°; it stands 1.2° off its stable support")


def test_a_body_on_another_side_than_its_stable_one_stands_so_without_a_warning():
    placed = box((40.0, 0.0, 0.0)).on_ground((0.2, 0.0, 0.1))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        free, context, values = prepared(scene(placed), Pose("box", stands_on="table"))
    np.testing.assert_allclose(moved_body(free, context, values).rotation_matrix(), placed.rotation_matrix(), atol=1e-6)


def test_a_body_that_nearly_stands_keeps_the_rotation_of_the_scene():
    where = scene(box((0.8, 30.0, 0.0)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        free, context, values = prepared(where, Pose("box", stands_on="table"))
    body = moved_body(free, context, values)
    np.testing.assert_allclose(body.rotation_matrix(), where.bodies[0].rotation_matrix(), atol=1e-6)
    assert abs(body.world_points()[:, 1].min()) < 4 * FLOAT32
