"""Light of flat bodies, and what passes them, against NumPy, against rays, and against differences."""

import numpy as np
import pytest
import warp as wp
from plane_settings import DIRECTIONS, Setting, ramp

import warpshadow as ws
from warpshadow.device.tape import recorded
from warpshadow.maths.directions import fibonacci
from warpshadow.stages.bounces.plane_light import plane_light as light_of_texels
from warpshadow.stages.bounces.plane_texels import find_texels
from warpshadow.stages.joint_coverage import transmittance_past
from warpshadow.stages.patches import find_plane_patches
from warpshadow.stages.planes import plane_blockers
from warpshadow.stages.planes.coverage import plane_coverage
from warpshadow.stages.planes.plane_blockers import PlaneBlockers, PlaneBody

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

FLOAT32 = 2e-5


def plane_light(points, normals, transmittance, frames, radiosity, planes, directions, **options):
    ones = wp.full((1, radiosity.shape[1]), wp.vec3(1.0), dtype=wp.vec3, device=radiosity.device)
    texels = find_texels(radiosity, ones, planes)
    return light_of_texels(points, normals, transmittance, frames, texels, planes, directions, **options)


def passing_flats(points, transmittance, frames, planes, directions, **options):
    return transmittance_past(transmittance, plane_coverage(points, frames, planes, directions, **options))


# ---------------------------------------------------------------------------------------------------- values


@pytest.mark.parametrize("two_sided", [False, True])
@pytest.mark.parametrize("self_plane", [None, 0])
@pytest.mark.parametrize("names", [("ground",), ("l",), ("ground", "wall", "l")])
@pytest.mark.parametrize("coverage", ["outline", "texels"])
def test_light_is_that_of_the_formula(names, self_plane, two_sided, coverage, device, monkeypatch):
    if coverage == "texels":
        monkeypatch.setattr(plane_blockers, "MAX_EDGES", 5)
    setting = Setting(device, names=names, two_sided=two_sided, batch=2)
    points, normals, transmittance, vertices, radiosity = setting.arrays()
    frames = setting.planes.frames(vertices)
    light = plane_light(
        points, normals, transmittance, frames, radiosity, setting.planes, DIRECTIONS, self_plane=self_plane
    ).numpy()
    for batch in range(2):
        np.testing.assert_allclose(light[batch], setting.light(self_plane, batch), atol=FLOAT32)


@pytest.mark.parametrize("self_plane", [None, 0])
def test_white_flats_send_what_they_block(self_plane, device):
    """Where cells are divided between flats without a remainder; a tenth of the light was missing without that."""
    setting = Setting(device, two_sided=True)
    points, normals, transmittance, vertices, radiosity = setting.arrays()
    radiosity.fill_(1.0)
    frames, planes = setting.planes.frames(vertices), setting.planes
    light = plane_light(
        points, normals, transmittance, frames, radiosity, planes, DIRECTIONS, self_plane=self_plane
    ).numpy()
    options = {"self_plane": self_plane, "horizon_normals": normals}
    passing = passing_flats(points, transmittance, frames, planes, DIRECTIONS, **options).numpy()
    weights = 4 / len(DIRECTIONS) * np.maximum(setting.normals @ DIRECTIONS.T, 0)
    blocked = (weights * (setting.transmittance - passing)).sum(axis=2)
    assert blocked.max() > 0.1
    np.testing.assert_allclose(light[..., 0], blocked, atol=FLOAT32)


@pytest.mark.parametrize("self_plane", [None, 1])
@pytest.mark.parametrize("coverage", ["outline", "texels"])
def test_what_passes_is_that_of_the_formula(self_plane, coverage, device, monkeypatch):
    if coverage == "texels":
        monkeypatch.setattr(plane_blockers, "MAX_EDGES", 5)
    setting = Setting(device, blocks=(True, False, True))
    points, _, transmittance, vertices, _ = setting.arrays()
    frames = setting.planes.frames(vertices)
    passing = passing_flats(points, transmittance, frames, setting.planes, DIRECTIONS, self_plane=self_plane).numpy()
    np.testing.assert_allclose(passing[0], setting.passing(self_plane), atol=FLOAT32)
    assert passing.min() >= 0 and np.abs(passing - setting.transmittance).max() > 0.5


# ---------------------------------------------------------------------------------------------------- gradients


def slopes_of(setting, steps, twin, weights):
    """Derivative of the sum of weights times what the twin gives, by central differences along steps."""
    ends = []
    for sign in (1, -2):
        setting.move([sign * step for step in steps])
        ends.append((weights * twin(setting)).sum())
    setting.move(steps)
    return (ends[0] - ends[1]) / 2


def random_steps(setting, number, size=1e-6):
    """A step of one of the variables alone."""
    rng = np.random.default_rng(number)
    values = setting.values()
    steps = [np.zeros(value.shape) for value in values]
    steps[number] = size * rng.normal(size=values[number].shape)
    if number == 3:  # of frames three vertices decide, and they are to stay those of a body that is moved and scaled
        turn, shift = rng.normal(size=3), rng.normal(size=3)
        steps[3] = size * (np.cross(turn, values[3]) + shift + 0.3 * values[3])
    return steps


@pytest.mark.parametrize(("two_sided", "coverage"), [(False, "outline"), (True, "outline"), (True, "texels")])
@pytest.mark.parametrize("names", [("l",), ("ground", "wall", "l")])
def test_gradients_of_light_are_those_of_the_twin(names, two_sided, coverage, device, verified_tape, monkeypatch):
    if coverage == "texels":
        monkeypatch.setattr(plane_blockers, "MAX_EDGES", 5)
    setting = Setting(device, names=names, two_sided=two_sided)
    variables = setting.arrays()
    points, normals, transmittance, vertices, radiosity = variables
    with recorded() as tape:
        frames = setting.planes.frames(vertices)
        light = plane_light(points, normals, transmittance, frames, radiosity, setting.planes, DIRECTIONS)
    weights = np.random.default_rng(5).uniform(size=(7, 3))
    tape.backward(grads={light: wp.array(weights[None], dtype=wp.vec3, device=device)})
    for number, variable in enumerate(variables):
        steps = random_steps(setting, number)
        expected = slopes_of(setting, steps, Setting.light, weights)
        assert (variable.grad.numpy() * steps[number]).sum() == pytest.approx(expected, rel=2e-3), number


@pytest.mark.parametrize("names", [("ground",), ("ground", "wall", "l")])
def test_gradients_of_what_passes_are_those_of_the_twin(names, device, verified_tape):
    setting = Setting(device, names=names, blocks=(True, False, True))
    variables = setting.arrays()
    points, _, transmittance, vertices, _ = variables
    with recorded() as tape:
        frames = setting.planes.frames(vertices)
        passing = passing_flats(points, transmittance, frames, setting.planes, DIRECTIONS)
    weights = np.random.default_rng(5).uniform(size=passing.shape[1:])
    tape.backward(grads={passing: wp.array(weights[None], dtype=wp.float32, device=device)})
    for number in (0, 2, 3):
        steps = random_steps(setting, number)
        expected = slopes_of(setting, steps, Setting.passing, weights)
        assert (variables[number].grad.numpy() * steps[number]).sum() == pytest.approx(expected, rel=2e-3), number


def test_what_receivers_see_of_fronts_can_be_given(device, verified_tape):
    setting, rng = Setting(device, two_sided=True, names=("ground", "wall")), np.random.default_rng(6)
    setting.fronts = rng.uniform(0.1, 0.9, size=(7, 2))
    setting.transmittance[:, 2:] = 0  # which spares the twin
    points, normals, transmittance, vertices, radiosity = setting.arrays()
    fronts = wp.array(setting.fronts[None], dtype=wp.float32, device=device, requires_grad=True)
    with recorded() as tape:
        frames, planes = setting.planes.frames(vertices), setting.planes
        light = plane_light(points, normals, transmittance, frames, radiosity, planes, DIRECTIONS, front_weights=fronts)
        passing = passing_flats(points, transmittance, frames, planes, DIRECTIONS, front_weights=fronts)
    np.testing.assert_allclose(light.numpy()[0], setting.light(), atol=FLOAT32)
    np.testing.assert_allclose(passing.numpy()[0], setting.passing(), atol=FLOAT32)

    weights = rng.uniform(size=(7, 3)), rng.uniform(size=passing.shape[1:])
    for found, twin, weight in ((light, Setting.light, weights[0]), (passing, Setting.passing, weights[1])):
        seed = wp.array(weight[None], dtype=found.dtype, device=device)
        tape.zero()
        tape.backward(grads={found: seed})
        steps = random_steps(setting, 0)
        expected = slopes_of(setting, steps, twin, weight)
        assert (points.grad.numpy() * steps[0]).sum() == pytest.approx(expected, rel=2e-3)
        step, ends = 1e-6 * rng.normal(size=setting.fronts.shape), []
        for sign in (1, -2, 1):
            setting.fronts = setting.fronts + sign * step
            ends.append((weight * twin(setting)).sum())
        assert (fronts.grad.numpy()[0] * step).sum() == pytest.approx((ends[0] - ends[1]) / 2, rel=2e-3)


@pytest.mark.parametrize("names", [("ground",), ("ground", "wall")])
def test_light_of_flats_is_that_of_the_part_that_bodies_before_them_leave_open(names, device, verified_tape):
    setting, rng = Setting(device, two_sided=True, names=names), np.random.default_rng(7)
    shares = rng.uniform(-0.3, 1, size=(7, len(DIRECTIONS))).clip(0)  # a third of the cells are open
    moments = rng.normal(size=(*shares.shape, 3))
    moments -= (moments * DIRECTIONS).sum(axis=-1, keepdims=True) * DIRECTIONS
    moments *= 0.4 * (shares * (1 - shares))[..., None]
    setting.coverages = np.concatenate([shares[..., None], moments], axis=-1)
    points, normals, transmittance, vertices, radiosity = variables = setting.arrays()
    coverages = wp.array(setting.coverages[None], dtype=wp.vec4, device=device, requires_grad=True)
    with recorded() as tape:
        frames, planes = setting.planes.frames(vertices), setting.planes
        light = plane_light(points, normals, transmittance, frames, radiosity, planes, DIRECTIONS, coverages=coverages)
    np.testing.assert_allclose(light.numpy()[0], setting.light(), atol=FLOAT32)
    covered, setting.coverages = setting.coverages, None
    assert np.abs(light.numpy()[0] - setting.light()).max() > 100 * FLOAT32
    setting.coverages = covered

    weights = rng.uniform(size=(7, 3))
    tape.backward(grads={light: wp.array(weights[None], dtype=wp.vec3, device=device)})
    for number in (0, 3, 4):
        steps = random_steps(setting, number)
        expected = slopes_of(setting, steps, Setting.light, weights)
        assert (variables[number].grad.numpy() * steps[number]).sum() == pytest.approx(expected, rel=2e-3), number
    step, ends = 1e-6 * rng.normal(size=covered.shape) * (covered[..., :1] > 0), []
    for sign in (1, -1):
        setting.coverages = covered + sign * step
        ends.append((weights * setting.light()).sum())
    expected = (ends[0] - ends[1]) / 2
    assert (coverages.grad.numpy()[0] * step).sum() == pytest.approx(expected, rel=2e-3)


def test_instances_that_share_an_array_add_to_its_gradient(device):
    setting = Setting(device, names=("ground",))
    points, normals, transmittance, vertices, radiosity = setting.arrays()
    twice = wp.array(np.repeat(setting.vertices, 2, axis=0), dtype=wp.vec3, device=device, requires_grad=True)
    gradients = []
    for placed in (vertices, twice):
        with recorded() as tape:
            passing = passing_flats(points, transmittance, setting.planes.frames(placed), setting.planes, DIRECTIONS)
            light = plane_light(
                points, normals, transmittance, setting.planes.frames(placed), radiosity, setting.planes, DIRECTIONS
            )
        seeds = {passing: wp.full(passing.shape, 1.0, device=device)}
        seeds[light] = wp.full(light.shape, wp.vec3(1.0), dtype=wp.vec3, device=device)
        tape.backward(grads=seeds)
        gradients.append([each.grad.numpy() for each in (points, normals, transmittance, radiosity)])
        tape.zero()
    for once, both in zip(*gradients, strict=True):
        np.testing.assert_allclose(both, 2 * once, rtol=1e-4, atol=1e-5)


# ---------------------------------------------------------------------------------------------------- what it means


def single(device, *, size=4.0, two_sided=False, mesh=None, others=None):
    """A ground, its patches, and its frames."""
    mesh = ws.plane(size, 1) if mesh is None else mesh
    faces = mesh.surface.faces
    patches = find_plane_patches(mesh.positions, faces, is_two_sided=two_sided, others=others)
    body = PlaneBody(patches.grid, mesh.positions, faces, 0, 0, blocks=True)
    planes = PlaneBlockers.from_bodies([body], patches.count, mesh.vertex_count, device=device)
    return patches, planes, planes.frames(wp.array(mesh.positions[None], dtype=wp.vec3, device=device))


def lit_by(planes, frames, points, normals, radiosity, directions, device, **options):
    points, normals = np.atleast_2d(points), np.atleast_2d(normals)
    arrays = [wp.array(values[None], dtype=wp.vec3, device=device) for values in (points, normals)]
    ones = wp.full((1, len(points), len(directions)), 1.0, dtype=wp.float32, device=device)
    sent = wp.array(radiosity[None], dtype=wp.vec3, device=device)
    return plane_light(*arrays, ones, frames, sent, planes, directions, **options).numpy()[0]


@pytest.mark.parametrize("normal", [[0, -1, 0], [0.6, -0.8, 0], [1, 0, 0], [0, 1, 0]])
def test_a_white_ground_without_end_fills_the_hemisphere_below(normal, device):
    patches, planes, frames = single(device, size=2000.0)
    radiosity = np.ones((patches.count, 3))
    light = lit_by(planes, frames, [0.3, 1.0, 0.2], normal, radiosity, fibonacci(256), device)
    assert light[0] == pytest.approx((1 - normal[1]) / 2, abs=0.01)


def test_a_receiver_below_a_ground_is_lit_by_its_back_alone(device):
    below, down, up = [0.1, -0.5, 0.2], [0, -1, 0], [0, 1, 0]
    for two_sided in (False, True):
        near = np.array([[-1.0, 0, -1], [1, 1, 1]])
        patches, planes, frames = single(device, size=2000.0, two_sided=two_sided, others=near)
        radiosity = np.repeat(np.repeat([0.3, 0.7][: patches.grid.sides], 24 * 24)[:, None], 3, axis=1)
        light = lit_by(planes, frames, [below] * 2, [up, down], radiosity, fibonacci(256), device)
        assert light[0] == pytest.approx(0.7 if two_sided else 0, abs=0.01)
        assert light[1] == pytest.approx(0, abs=0.01)
        passing = passing_flats(
            wp.array([[below]], dtype=wp.vec3, device=device),
            wp.full((1, 1, 64), 1.0, dtype=wp.float32, device=device),
            frames,
            planes,
            DIRECTIONS,
        ).numpy()[0, 0]
        assert (passing[DIRECTIONS[:, 1] > 0.3] < 0.01).all() and (passing[DIRECTIONS[:, 1] < -0.3] == 1).all()


def test_a_receiver_that_lies_on_a_ground_is_above_it(device):
    patches, planes, frames = single(device)
    radiosity = np.random.default_rng(0).uniform(0.5, 1, size=(patches.count, 3))
    points = [[0.3, height, 0.2] for height in (0, 1e-6, -1e-6)]
    light = lit_by(planes, frames, points, [[1, 0, 0]] * 3, radiosity, DIRECTIONS, device)
    assert light[0].min() > 0.1
    np.testing.assert_allclose(light[1:], light[:1].repeat(2, axis=0), rtol=1e-3)


def soft_shadow(places):
    """Radiosity of a ground under a disc: dark in the middle, with a gradient."""
    radius = np.hypot(places[..., 0] - 0.1, places[..., 1] + 0.05)
    return 0.7 * (0.15 + 0.85 * ramp(4 * (radius - 0.8))) * (1 + 0.03 * places[..., 0])


def test_light_above_the_shadow_of_a_disc_is_that_of_rays(device):
    """Measured: 2.0% with 128 cells; with 1024 1.3%, which is the grid's."""
    others = np.array([[-0.8, 0, -0.8], [0.8, 1.6, 0.8]])
    patches, planes, frames = single(device, size=6.0, others=others)
    grid = patches.grid
    centers = grid.middles() @ grid.frame[:2][:, [0, 2]] + grid.origin[[0, 2]]
    radiosity = np.repeat(soft_shadow(centers).reshape(-1, 1), 3, axis=1)
    rng = np.random.default_rng(2)
    normals = rng.normal(size=(150, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = 0.75 * normals + [0, 0.8, 0]
    rays = fibonacci(40_000)
    rays = rays[rays[:, 1] < -1e-3]
    hits = points[:, None, [0, 2]] - points[:, None, 1:2] * rays[:, [0, 2]] / rays[:, 1:2]
    sent = np.where((np.abs(hits) < 3).all(axis=2), soft_shadow(hits), 0)
    expected = 4 / 40_000 * (np.maximum(normals @ rays.T, 0) * sent).sum(axis=1)
    for count, tolerance in ((128, 0.025), (1024, 0.018)):
        light = lit_by(planes, frames, points, normals, radiosity, fibonacci(count), device)[:, 0]
        assert np.linalg.norm(light - expected) < tolerance * np.linalg.norm(expected)


@pytest.mark.parametrize("scale", [1.0, 0.05])
def test_a_wall_hides_the_bright_ground_behind_it(scale, device):
    """Measured: of the light that rays lose to the wall 88% are lost, at any scale of the wall's body, 21% off."""
    corners = np.array([[-3.0, 0.4, 2], [3, 0.4, 2], [3, 2.4, 2], [-3, 2.4, 2]])
    ground, wall = ws.plane(12.0, 1), ws.Mesh(corners / scale, [[0, 1, 2], [0, 2, 3]])
    points = np.stack(np.meshgrid([-1.0, 0.2, 1.1], np.linspace(0.3, 2.2, 8), [-2.0, -1]), axis=-1).reshape(-1, 3)
    vertices = np.concatenate([ground.positions, scale * wall.positions])
    lights = []
    for meshes in ([ground], [ground, wall]):
        bodies, vertex_count, patch_count = [], 0, 0
        for mesh in meshes:
            faces = mesh.surface.faces
            patches = find_plane_patches(mesh.positions, faces, is_two_sided=False)
            bodies.append(PlaneBody(patches.grid, mesh.positions, faces, vertex_count, patch_count, blocks=True))
            vertex_count, patch_count = vertex_count + mesh.vertex_count, patch_count + patches.count
        planes = PlaneBlockers.from_bodies(bodies, patch_count, vertex_count, device=device)
        grid = bodies[0].grid
        centers = (grid.middles() @ grid.frame[:2][:, [0, 2]] + grid.origin[[0, 2]]).reshape(-1, 2)
        radiosity = np.zeros((patch_count, 3))
        radiosity[: len(centers)] = ramp(centers[:, 1:] - 2)
        frames = planes.frames(wp.array(vertices[None, :vertex_count], dtype=wp.vec3, device=device))
        lights.append(lit_by(planes, frames, points, [[0, 0, 1]] * len(points), radiosity, fibonacci(128), device))
    taken = (lights[0] - lights[1])[:, 0]

    rays = fibonacci(40_000)
    rays = rays[(rays[:, 1] < -1e-3) & (rays[:, 2] > 1e-3)]
    hits = points[:, None, [0, 2]] - points[:, None, 1:2] * rays[:, [0, 2]] / rays[:, 1:2]
    through = points[:, None, :2] + (2 - points[:, None, 2:]) * rays[:, :2] / rays[:, 2:]
    is_hidden = (np.abs(through - [0, 1.4]) < [3, 1]).all(axis=2) & (hits[..., 1] > 2)
    sent = np.where((np.abs(hits) < 6).all(axis=2) & is_hidden, ramp(hits[..., 1] - 2), 0)
    expected = 4 / 40_000 * (rays[:, 2] * sent).sum(axis=1)
    assert np.linalg.norm(taken - expected) < 0.25 * np.linalg.norm(expected)


def bends(values):
    """Largest second difference, against the largest first one."""
    return np.abs(np.diff(values, 2)).max() / np.abs(np.diff(values)).max()


@pytest.mark.parametrize(
    ("start", "end"),
    [
        ([0.3, 2e-3, 0.2], [0.3, -2e-3, 0.2]),
        ([0.5, 0.3, 0], [3.5, 0.3, 0.1]),
        ([2.06, -0.05, 0.28], [1.96, 0.075, 0.23]),
    ],
    ids=["through the plane", "past the border", "around the edge"],
)
def test_what_passes_has_no_step_and_no_kink_along_a_path(start, end, device):
    """In a path of ever more steps, second differences vanish against first ones; at a kink they would not."""
    _, planes, frames = single(device)
    ratios = []
    for count in (2000, 8000):
        points = np.linspace(start, end, count)[None]
        ones = wp.full((1, count, 64), 1.0, dtype=wp.float32, device=device)
        on_device = wp.array(points, dtype=wp.vec3, device=device)
        passing = passing_flats(on_device, ones, frames, planes, DIRECTIONS).numpy()[0].astype(float)
        ratios.append(max(bends(column) for column in passing.T if np.ptp(column) > 0.1))
    assert ratios[1] < 0.5 * ratios[0] + 0.02


def test_no_other_flat_leaves_all_as_it_is(device):
    setting = Setting(device, names=("ground",))
    points, normals, transmittance, vertices, radiosity = setting.arrays()
    frames = setting.planes.frames(vertices)
    assert plane_coverage(points, frames, setting.planes, DIRECTIONS, self_plane=0) is None
    light = plane_light(points, normals, transmittance, frames, radiosity, setting.planes, DIRECTIONS, self_plane=0)
    assert not light.numpy().any()


def test_what_does_not_fit_is_refused(device):
    setting = Setting(device, names=("ground",))
    points, normals, transmittance, vertices, radiosity = setting.arrays()
    frames = setting.planes.frames(vertices)
    with pytest.raises(ValueError, match="transmittance"):
        passing_flats(points, transmittance, frames, setting.planes, fibonacci(16))
    with pytest.raises(ValueError, match="frames"):
        passing_flats(points, transmittance, vertices, setting.planes, DIRECTIONS)
    with pytest.raises(ValueError, match="self_plane"):
        plane_light(points, normals, transmittance, frames, radiosity, setting.planes, DIRECTIONS, self_plane=1)


def test_a_far_scale_gives_finite_light_and_gradients(device):
    for scale in (1e-6, 1e8):
        mesh = ws.plane(4.0, 2).transformed(scale=scale)
        patches, planes, frames = single(device, mesh=mesh, others=scale * np.array([[0.0, 0, 0], [1, 1, 1]]))
        points = np.array([[0.1, 0.2, 0.3], [0, 0, 0], [2, 0, 2], [1e9, 1e-9, 0]]) * scale
        variables = [
            wp.array(values[None], dtype=wp.vec3, device=device, requires_grad=True)
            for values in (points, np.tile([0.0, -0.6, 0.8], (4, 1)), np.ones((patches.count, 3)))
        ]
        frames = wp.clone(frames, requires_grad=True)
        passing = wp.full((1, 4, 64), 1.0, dtype=wp.float32, device=device)
        with recorded() as tape:
            light = plane_light(variables[0], variables[1], passing, frames, variables[2], planes, DIRECTIONS)
        tape.backward(grads={light: wp.full(light.shape, wp.vec3(1.0), dtype=wp.vec3, device=device)})
        for array in (light, frames.grad, *(variable.grad for variable in variables)):
            assert np.isfinite(array.numpy()).all()
