"""Land and other height fields: which meshes are closed behind, and on which side."""

import dataclasses
import gc
import weakref

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import warpshadow as ws
from warpshadow.scene import height_fields
from warpshadow.scene.blockers import SPHERES_BESIDE_PARTS, blocking_parts, fitted_counts, fitted_meshes

CAMERA = ws.Camera.look_at((0, 2, 6), (0, 0.5, 0), size=(16, 16))


def height(x, z):
    return 0.3 * np.sin(2 * x) * np.cos(1.5 * z) + 0.1 * np.sin(5 * x - 3 * z)


def land(count: int = 16, size: float = 4.0) -> ws.Mesh:
    grid = ws.plane(size, count)
    positions = grid.positions.copy()
    positions[:, 1] = height(positions[:, 0], positions[:, 2])
    return ws.Mesh(positions, grid.faces, name="land")


def tent() -> ws.Mesh:
    grid = ws.plane(2.0, 8)
    positions = grid.positions.copy()
    positions[:, 1] = 0.8 - 0.8 * positions[:, 0] ** 2
    return ws.Mesh(positions, grid.faces, name="tent")


def ball(at=(0.3, 1.0, 0.2)) -> ws.Body:
    return ws.Body(ws.icosphere(1.0, 2), scale=0.2, translation=at, blockers=8)


def fitted(body: ws.Body, *others: ws.Body) -> ws.Mesh:
    return fitted_meshes(ws.Scene([body, *others], ws.EnvironmentMap.constant(), CAMERA))[0][0]


def test_solids_go_with_their_bodies_and_hold_no_others():
    gc.collect()
    count, other = len(height_fields._SOLIDS), ball()
    assert fitted(ws.Body(land()), other) is not None
    gone = weakref.ref(other)
    del other
    gc.collect()
    assert len(height_fields._SOLIDS) == count and gone() is None


def volume(mesh: ws.Mesh) -> float:
    a, b, c = np.moveaxis(mesh.positions[mesh.faces].astype(np.float64), 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


@pytest.mark.parametrize("winds_down", [False, True])
@pytest.mark.parametrize("rotation", [(0, 0, 0), (20, 150, -30)])
def test_land_is_closed_on_the_side_where_no_body_stands(winds_down, rotation):
    mesh = land()
    if winds_down:
        mesh = dataclasses.replace(mesh, faces=mesh.faces[:, ::-1])
    turn = Rotation.from_rotvec(rotation, degrees=True)
    poses = [
        {"rotation": rotation, "translation": (1, 2, 3), "scale": 2.0},
        {"translation": turn.apply((0.6, 2, 0.4)) + (1, 2, 3)},
    ]
    above = dataclasses.replace(ball(), **poses[1])
    solid = fitted(ws.Body(mesh, **poses[0]), above)
    assert solid.surface.is_closed
    assert {tuple(point) for point in mesh.positions} <= {tuple(point) for point in solid.positions}
    lowest = mesh.positions[:, 1].min()
    assert solid.positions[:, 1].max() == mesh.positions[:, 1].max()  # nothing before it
    assert solid.positions[:, 1].min() == pytest.approx(lowest - 4 / 4, abs=0.02)  # the mean normal leans a little
    assert volume(solid) == pytest.approx(16 * (mesh.positions[:, 1].mean() - lowest + 4 / 4), rel=0.05)


@pytest.mark.parametrize(
    ("body", "others"),
    [
        (ws.Body(land()), ()),  # nobody knows which side is seen
        (ws.Body(land()), (ball(), ball((-1, -1, 0)))),
        (ws.Body(land()), (ball((0.3, -1, 0.2)),)),  # a roof, past which light comes
        (ws.Body(land(), rotation=(0, 0, 80)), (ball((-2, 0, 0)),)),
        (ws.Body(tent()), (ball(), ws.Body(ws.plane(6.0), translation=(0, -0.01, 0)))),
        (ws.Body(ws.icosphere(1.0, 2)), (ball((0, 2, 0)),)),
    ],
    ids=["alone", "between bodies", "above bodies", "upright", "tent on a ground", "closed"],
)
def test_other_meshes_stay_as_they_are(body, others):
    assert fitted(body, *others) is body.mesh


def test_spirals_are_no_height_field():
    turns, radii = np.linspace(0, 4 * np.pi, 65), np.array([0.5, 1.0])
    points = np.stack(
        [np.outer(np.cos(turns), radii), np.outer(turns / 10, [1, 1]), np.outer(np.sin(turns), radii)], -1
    )
    first = 2 * np.arange(64)[:, None]
    faces = np.concatenate([first + [0, 1, 3], first + [0, 3, 2]])
    body = ws.Body(ws.Mesh(points.reshape(-1, 3), faces))
    assert fitted(body, ball((0.75, 3, 0))) is body.mesh


def plain() -> ws.Mesh:
    """Land of so little relief that a few panels are near it."""
    grid = ws.plane(4.0, 16)
    return ws.Mesh(grid.positions + np.outer(0.05 * np.sin(2 * grid.positions[:, 0]), (0, 1, 0)), grid.faces)


def trench() -> ws.Mesh:
    """Land of three flat pieces."""
    grid = ws.plane(4.0, 16)
    return ws.Mesh(grid.positions + np.outer(np.abs(grid.positions[:, 0]) <= 1, (0, -0.5, 0)), grid.faces).creased()


def bowl(level: int = 4) -> ws.Mesh:
    """Half a shell."""
    ball = ws.icosphere(1.0, level)
    return ws.Mesh(ball.positions, ball.faces[ball.positions[ball.faces][..., 1].mean(axis=1) < 0], name="bowl")


@pytest.mark.parametrize(
    ("mesh", "at", "expected"),
    [
        (plain(), (0.3, 1, 0.2), False),
        (plain(), (0.3, -1, 0.2), True),
        (trench(), (0.3, 1, 0.2), True),
        (bowl(), (0.1, -0.65, 0), True),
    ],
    ids=["land", "roof", "flat pieces", "bowl"],
)
def test_panels_do_not_stand_over_land(mesh, at, expected):
    scene = ws.Scene([ws.Body(mesh), ball(at)], ws.EnvironmentMap.constant(), CAMERA)
    assert mesh.convex_parts
    assert (0 in blocking_parts(scene)) is expected
    assert fitted_meshes(scene)[0][0].surface.is_closed is not expected
    assert (fitted_counts(scene)[0] == SPHERES_BESIDE_PARTS) is expected


def basin() -> ws.Mesh:
    """A sheet as deep as a bowl, whose panels are far from it at the bottom."""
    grid = ws.plane(6.0, 32)
    heights = 0.12 * (grid.positions[:, 0] ** 2 + grid.positions[:, 2] ** 2)
    return ws.Mesh(grid.positions + np.outer(heights, (0, 1, 0)).astype(np.float32), grid.faces, name="basin")


@pytest.mark.parametrize(("at", "expected"), [((0.2, 0.1, 0.1), False), ((0.2, 1.0, 0.1), True)])
def test_a_basin_has_panels_where_no_body_stands_behind_them(at, expected):
    scene = ws.Scene([ws.Body(basin()), ball(at)], ws.EnvironmentMap.constant(), CAMERA)
    assert (0 in blocking_parts(scene)) is expected


def test_spheres_of_land_lie_where_it_is_seen():
    """Fitted to the whole solid, half of them cover its bottom, and gaps below the land are 1.5 times as deep."""
    mesh = land(24)
    request = fitted_meshes(ws.Scene([ws.Body(mesh), ball()], ws.EnvironmentMap.constant(), CAMERA))[0]
    assert request.seen_from == pytest.approx((0, 1, 0), abs=0.1)

    def mean_gap(**options):
        spheres = ws.fit_spheres(
            request.mesh, 128, steps=40, progress=False, warns=False, cache=False, **options
        ).spheres
        gaps = np.linalg.norm(mesh.positions[:, None] - spheres.centers, axis=2) - spheres.radii
        return np.maximum(gaps.min(axis=1), 0).mean()

    assert mean_gap(seen_from=request.seen_from) < 0.8 * mean_gap()


def test_a_side_that_is_no_direction_is_refused():
    with pytest.raises(ValueError, match="seen_from: got a zero vector"):
        ws.fit_spheres(land(), 8, seen_from=(0, 0, 0))


@pytest.mark.slow
@pytest.mark.parametrize("level", [2, 3, 4])
def test_a_ball_in_a_bowl_of_one_layer_is_as_dark_as_by_rays(level):
    in_bowl = ws.Body(ws.icosphere(0.3, 3), translation=(0.1, -0.65, 0))
    camera = ws.Camera.look_at((0, 2.6, 2.2), (0, -0.4, 0), size=(48, 48))
    scene = ws.Scene([ws.Body(bowl(level)), in_bowl], ws.EnvironmentMap.constant(), camera)
    renderer = ws.Renderer(scene)
    traced = ws.Renderer(dataclasses.replace(scene, visibility=ws.Visibility("ray-traced", samples=256)))
    shows_ball = renderer.layers().bodies == 1
    light, expected = (each.render()[shows_ball][:, :3].mean() for each in (renderer, traced))
    assert light == pytest.approx(expected, rel=0.03)  # by spheres of the land below 18% brighter


@pytest.mark.slow
def test_a_ball_in_a_small_bowl_beside_a_large_one_is_as_dark_as_by_rays():
    """With panels as coarse as those of the large bowl 5% too dark."""
    large, small = bowl(3), bowl(3)
    positions = np.concatenate([large.positions, 0.15 * small.positions + np.float32([1.3, 0, 0])])
    bowls = ws.Mesh(positions, np.concatenate([large.faces, small.faces + len(large.positions)]), name="bowls")
    in_small = ws.Body(ws.icosphere(0.045, 3), translation=(1.31, -0.1, 0))
    camera = ws.Camera.look_at((1.3, 0.4, 0.33), (1.3, -0.06, 0), size=(48, 48))
    scene = ws.Scene([ws.Body(bowls), in_small], ws.EnvironmentMap.constant(), camera)
    renderer = ws.Renderer(scene)
    traced = ws.Renderer(dataclasses.replace(scene, visibility=ws.Visibility("ray-traced", samples=256)))
    shows_ball = renderer.layers().bodies == 1
    light, expected = (each.render()[shows_ball][:, :3].mean() for each in (renderer, traced))
    assert light == pytest.approx(expected, rel=0.03)


def test_water_and_rocks_stick_in_land():
    water = ws.Body(ws.plane(4.0), translation=(0, -0.1, 0))
    rock = ball((0.5, height(0.5, 0.5), 0.5))
    assert fitted(ws.Body(land()), water, rock, ball()).surface.is_closed
