"""Which spheres stand in for which body: explicit ones, fitted ones, none, or one for a ground."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import warpshadow as ws
from warpshadow.maths.directions import fibonacci
from warpshadow.pipeline.renderer import SceneRenderer
from warpshadow.scene import blockers

# Positions are float32; the ground's sphere has a radius of tens.
FLOAT32 = 1e-5

UNIT_SPHERE = ws.Spheres([[0, 0, 0]], [1.0])
CAMERA = ws.Camera.look_at((0, 2, 6), (0, 0.5, 0), size=(16, 16))


def ball(**options) -> ws.Body:
    return ws.Body(ws.icosphere(1.0, 3), **{"blockers": UNIT_SPHERE, "translation": (0, 1.2, 0), **options})


def scene_of(
    *bodies: ws.Body, method: str = "directional", light: ws.EnvironmentMap | None = None, **options
) -> ws.Scene:
    light = ws.EnvironmentMap.constant() if light is None else light
    return ws.Scene(bodies, light, CAMERA, ws.Visibility(method, **options))


def spheres_of(*bodies: ws.Body, device="cpu") -> tuple[np.ndarray, np.ndarray]:
    _, centers, radii = SceneRenderer(scene_of(*bodies), device=device).geometry().arrays().values()
    assert centers.shape == radii.shape and str(centers.device) == str(radii.device) == device
    return centers.numpy()[0], radii.numpy()[0]


@pytest.fixture
def fitted(monkeypatch) -> list:
    """Names and counts of the meshes that were to be fitted; the fit is one sphere off the origin."""
    calls = []

    def fit(mesh, count, **options):
        calls.append((mesh.name, count))
        return dataclasses.make_dataclass("Fit", ["spheres"])(ws.Spheres([[1.0, 0, 0]], [0.25]))

    monkeypatch.setattr(blockers, "fit_spheres", fit)
    return calls


# ---------------------------------------------------------------------------------------------- spheres of a body


def test_explicit_spheres_are_placed_as_the_mesh_is(device):
    rng = np.random.default_rng(0)
    centers, radii = rng.normal(size=(5, 3)), rng.uniform(0.1, 1, 5)
    body = ball(blockers=ws.Spheres(centers, radii), rotation=(10, 20, 30), translation=(1, 2, 3), scale=1.5)
    placed, placed_radii = spheres_of(body, device=device)
    turn = Rotation.from_rotvec((10, 20, 30), degrees=True)
    assert np.abs(placed - (turn.apply(1.5 * centers) + [1, 2, 3])).max() < FLOAT32
    assert np.abs(placed_radii - 1.5 * radii).max() < FLOAT32


def test_a_fit_is_asked_for_in_the_meshs_own_space_and_placed_as_the_mesh_is(fitted):
    centers, radii = spheres_of(ball(blockers=7, rotation=(0, 90, 0), scale=2))
    assert fitted == [("icosphere", 7)]
    assert np.abs(centers - [0, 1.2, -2]).max() < FLOAT32 and radii == [0.5]


def test_no_blockers_are_no_spheres(fitted):
    centers, radii = spheres_of(ball(blockers=0), ws.Body(ws.plane(4.0, 2), blockers=0))
    assert centers.shape == (0, 3) and radii.shape == (0,) and not fitted


def test_the_spheres_of_bodies_are_in_the_bodies_order(fitted):
    centers, _ = spheres_of(ball(translation=(3, 1, 0)), ball(blockers=0), ball(blockers=3), ball())
    assert np.abs(centers - [(3, 1, 0), (1, 1.2, 0), (0, 1.2, 0)]).max() < FLOAT32
    assert fitted == [("icosphere", 3)]


@pytest.mark.parametrize("method", ["directional", "log-sh"])
def test_a_scene_without_any_sphere_renders_without_shadows(method):
    bodies = ball(blockers=0), ws.Body(ws.plane(4.0, 8), blockers=0)
    image = ws.render(scene_of(*bodies, method=method))
    covered = image[..., 3] == 1
    quadrature = 3e-3
    assert np.abs(image[covered, :3] - 0.8).max() < quadrature


# ---------------------------------------------------------------------------------------------- the ground


@pytest.mark.parametrize("order", [1, -1], ids=["wound upward", "wound downward"])
def test_a_plane_below_the_other_bodies_becomes_one_sphere_that_touches_it_from_below(fitted, order):
    mesh = ws.plane(8.0, 4)
    mesh = ws.Mesh(mesh.positions, mesh.faces[:, ::order])
    placements = [(0, 0, 0), (0, 0, 90), (35, -20, 50)]
    for rotation in placements:
        turn = Rotation.from_rotvec(rotation, degrees=True)
        plane = ws.Body(mesh, rotation=rotation, translation=(1, 2, 3))
        above = ball(translation=turn.apply((0.5, 1.2, 0)) + (1, 2, 3))
        centers, radii = spheres_of(plane, above)
        assert len(radii) == 2 and not fitted
        along = turn.inv().apply(centers[0] - np.array((1, 2, 3)))
        assert abs(along[1] + radii[0]) < FLOAT32 * radii[0]  # tangent, below
        assert np.abs(along[[0, 2]] - [0.5, 0]).max() < 1e-3  # below the middle of the ball


def test_from_the_height_of_the_bodies_the_sphere_blocks_as_much_as_the_plane_does():
    """Solid angle of a square from above its middle, by quadrature over it."""
    centers, radii = spheres_of(ws.Body(ws.plane(6.0, 2)), ball())
    x, z = np.meshgrid(*[(np.arange(600) + 0.5) / 100 - 3] * 2)
    expected = (1.2 / (x**2 + z**2 + 1.2**2) ** 1.5).sum() / 100**2
    sine = radii[0] / np.linalg.norm(centers[0] - [0, 1.2, 0])
    assert abs(2 * np.pi * (1 - np.sqrt(1 - sine**2)) - expected) < 1e-3 * expected


def test_a_huge_ground_is_still_touched_from_behind(fitted):
    for size in (1e3, 1e6):
        centers, radii = spheres_of(ws.Body(ws.plane(size, 2)), ball())
        assert abs(centers[0, 1] + radii[0]) < 1e-3 and radii[0] > 100


def test_bodies_that_stand_on_the_ground_or_sink_in_a_little_still_have_a_ground(fitted):
    for height in (1.0, 0.97):
        assert len(spheres_of(ws.Body(ws.plane(8.0, 2)), ball(translation=(0, height, 0)))[1]) == 2
    assert not fitted


def test_a_plane_in_which_a_body_stands_deep_is_its_ground_still(fitted):
    """As it may where a fit of the body's pose starts."""
    _, radii = spheres_of(ws.Body(ws.plane(8.0, 2), blockers=9), ball(translation=(0, 0.3, 0)))
    assert not fitted and len(radii) == 1 + len(spheres_of(ball())[1])


@pytest.mark.parametrize(
    ("name", "others"), [("bodies on both sides of it", [(0, 1.5, 0), (0, -1.5, 0)]), ("nothing else", [])]
)
def test_a_plane_that_is_no_ground_is_fitted_as_any_mesh(fitted, name, others):
    spheres_of(ws.Body(ws.plane(8.0, 2), blockers=9), *(ball(translation=place) for place in others))
    assert fitted == [("plane", 9)]


def test_a_mesh_that_is_not_flat_is_no_ground(fitted):
    plane = ws.plane(8.0, 8)
    bumpy = ws.Mesh(
        plane.positions + 0.05 * np.cos(plane.positions[:, [1, 0, 1]]) * [0, 1, 0], plane.faces, name="bumpy"
    )
    spheres_of(ws.Body(bumpy, blockers=5), ball(translation=(0, 2, 0)))
    assert fitted == [("bumpy", 5)]


def test_explicit_spheres_of_a_plane_are_kept(fitted):
    body = ws.Body(ws.plane(8.0, 2), blockers=ws.Spheres([[0, -5, 0]], [5.0]))
    centers, radii = spheres_of(body, ball())
    assert np.abs(centers[0] - [0, -5, 0]).max() < FLOAT32 and radii[0] == 5 and not fitted


def test_the_ground_shadows_a_body_above_it_nearly_as_the_plane_does(device):
    """Light from all around, as bright from below: relative L2 error of the shading of a ball that floats over a square
    of six radii. Measured: 4.2% with the ground's sphere, 62% without."""
    errors = {}
    for number, blocker_count in (("one sphere", 1), ("none", 0)):
        scene = scene_of(ws.Body(ws.plane(6.0, 2), blockers=blocker_count, receivers="vertex"), ball(), directions=256)
        renderer = SceneRenderer(scene, device=device)
        shading = renderer.shade().numpy()[0, 9:]
        points, normals = (array.numpy()[0, 9:] for array in renderer.view().receivers[:2])
        expected = traced_shading(points, normals)
        errors[number] = np.linalg.norm(shading - expected) / np.linalg.norm(expected)
    assert errors["one sphere"] < 0.05
    assert errors["one sphere"] < errors["none"] / 10


def traced_shading(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Shading under L = 1 of points on the ball, by the square's exact view: 8192 directions in float64."""
    directions = fibonacci(8192)
    cosine = np.maximum(normals.astype(np.float64) @ directions.T, 0)
    with np.errstate(divide="ignore"):
        distance = np.where(directions[:, 1] < 0, points[:, 1:2] / -directions[:, 1], np.inf)
    reach = np.where(np.isfinite(distance), distance, 0)
    hits = np.isfinite(distance)
    for axis in (0, 2):
        hits &= np.abs(points[:, axis : axis + 1] + reach * directions[:, axis]) < 3
    return np.repeat((cosine * ~hits).sum(axis=1, keepdims=True) * 4 / len(directions), 3, axis=1)


def test_fits_that_take_long_are_announced_with_the_way_around_them(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(blockers, "fit_seconds", lambda count: 1000.0 * count)
    monkeypatch.setenv("WARPSHADOW_NUM_THREADS", "1")
    scene = scene_of(ws.Body(ws.icosphere(1.0, 1), blockers=1))
    blockers.fit_scene_spheres(scene, progress=True)
    assert capsys.readouterr().err.startswith("fitting spheres to 1 mesh takes about 17 min, once; method")
    blockers.fit_scene_spheres(scene, progress=True)  # reads them
    blockers.fit_scene_spheres(scene_of(ws.Body(ws.icosphere(1.0, 2), blockers=1)), progress=False)
    assert not capsys.readouterr().err


@pytest.mark.parametrize(
    ("method", "body_options", "expected"),
    [
        ("directional", {}, blockers.SPHERES_BESIDE_PARTS),
        ("directional", {"blockers": 24}, 24),
        ("directional", {"self_shadows": "spheres"}, "auto"),
        ("log-sh", {}, "auto"),
    ],
)
def test_a_body_that_blocks_as_convex_parts_takes_few_spheres(method, body_options, expected):
    import trimesh

    scene = scene_of(ws.Body(trimesh.creation.box(), **body_options), method=method)
    assert blockers.fitted_counts(scene) == {0: expected}
    steps = blockers.STEPS_BESIDE_PARTS if not body_options and method == "directional" else blockers.STEPS
    assert blockers.fitted_meshes(scene)[0].steps == steps


@pytest.mark.parametrize(
    ("radius", "sides", "has_parts"),
    [(0.35, 24, False), (0.35, 8, True), (0.1, 24, True)],
    ids=["round", "of few sides", "thin"],
)
def test_rings_of_many_sides_block_as_spheres_where_few_cast_their_shadow(radius, sides, has_parts):
    import trimesh

    scene = scene_of(ws.Body(trimesh.creation.torus(1, radius, 48, sides)))
    parts = scene.bodies[0].mesh.convex_parts
    assert (sum(len(part.edges) for part in parts) > blockers.MANY_EDGES) == (sides == 24)
    assert blockers.blocking_parts(scene) == ({0: parts} if has_parts else {})
    assert blockers.fitted_counts(scene) == {0: blockers.SPHERES_BESIDE_PARTS}


def test_short_fits_beside_convex_parts_send_the_same_light(tmp_path, monkeypatch):
    """An image of a box on a ground with all bounces: measured 1e-6."""
    import trimesh

    monkeypatch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path))
    images = []
    for steps in (blockers.STEPS_BESIDE_PARTS, blockers.STEPS):
        monkeypatch.setattr(blockers, "STEPS_BESIDE_PARTS", steps)
        box = ws.Body(trimesh.creation.box((1, 0.6, 0.8)), (0.8, 0.4, 0.3), name="box").creased().on_ground()
        camera = ws.Camera.look_at((1, 2, 3), (0, 0.3, 0), size=(32, 32))
        scene = ws.Scene([box, ws.Body(ws.plane(4.0, 8))], ws.synthetic_sky(height=32), camera, bounces="all")
        images.append(ws.Renderer(scene, progress=False).render())
    assert 0 < np.linalg.norm(images[0] - images[1]) < 1e-3 * np.linalg.norm(images[1])


@pytest.mark.parametrize(("method", "warns"), [("directional", False), ("log-sh", True)])
def test_spheres_beside_convex_parts_cost_no_warning(method, warns, monkeypatch):
    import trimesh

    asked = []

    def fit(mesh, count, **options):
        asked.append(options["warns"])
        return dataclasses.make_dataclass("Fit", ["spheres"])(UNIT_SPHERE)

    monkeypatch.setattr(blockers, "fit_spheres", fit)
    blockers.fit_scene_spheres(scene_of(ws.Body(trimesh.creation.box((1, 1, 0.01))), method=method))
    assert asked == [warns]
