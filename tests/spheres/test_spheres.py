"""Sphere fits: the formulas they rest on, what they promise, and how good they are."""

import dataclasses
import os
import stat
import subprocess
import sys
import warnings
from functools import partial

import numpy as np
import pytest
import warp as wp

from warpshadow.assets.cache import cached_files
from warpshadow.assets.mesh import Mesh
from warpshadow.assets.mesh_files import load_mesh
from warpshadow.assets.primitives import icosphere, plane
from warpshadow.maths.directions import cell_radius, fibonacci
from warpshadow.spheres import Spheres, enough, exact_occlusion, fit_spheres, plot_spheres
from warpshadow.spheres import cover as stage_1
from warpshadow.spheres import fit as fit_module
from warpshadow.spheres import measure as stage_3
from warpshadow.spheres import refine as stage_2
from warpshadow.spheres.normalized_mesh import NormalizedMesh
from warpshadow.spheres.receivers import FitReceivers
from warpshadow.stages.visibility.cones import BLEND, FADE_RADIUS
from warpshadow.stages.visibility.directional import SOFTNESS, transmittance

SEED = 3
QUICK = {"steps": 60, "cache": False, "progress": False}


def box(size=(1.0, 0.6, 0.8), segments=8) -> Mesh:
    """A closed box with finely divided sides."""
    trimesh = pytest.importorskip("trimesh")
    solid = trimesh.creation.box(extents=size)
    positions, faces = trimesh.remesh.subdivide_to_size(solid.vertices, solid.faces, max(size) / segments)
    return Mesh(positions, faces)


def joined(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(mesh.positions) for mesh in meshes[:-1])])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]
    return Mesh(np.concatenate([mesh.positions for mesh in meshes]), np.concatenate(faces))


def bumpy() -> Mesh:
    """An irregular closed mesh, whose best spheres are unlike each other."""
    ball = icosphere(1.0, 3)
    x, y, z = ball.positions.astype(np.float64).T
    grow = 1 + 0.3 * np.sin(3 * x + 1) * np.cos(2 * y) + 0.2 * np.sin(4 * z)
    return Mesh(ball.positions * grow[:, None] * [1.3, 1.0, 0.7], ball.faces)


# ------------------------------------------------------------------------------ float64 twins


def twin_cone(distance):
    """Cosine of the cone by the distance in radii."""
    edge = 1 + BLEND
    cosine, slope = np.sqrt(1 - edge**-2), edge**-3 / np.sqrt(1 - edge**-2)
    t = np.clip((distance - 1) / BLEND, 0, 1)
    blend = cosine * (3 * t**2 - 2 * t**3) + BLEND * slope * (t**3 - t**2)
    return np.where(distance >= edge, np.sqrt(1 - np.maximum(distance, edge) ** -2), blend)


def twin_near(distance):
    t = np.minimum(distance / FADE_RADIUS, 1)
    return t**2 * (3 - 2 * t)


def twin_transmittance(points, directions, spheres, width):
    """DESIGN.md section 4 with an edge of fixed width, [receiver, direction]."""
    result = np.ones((len(points), directions.shape[1]))
    for sphere in spheres:
        toward = sphere[:3] - points
        distance = np.linalg.norm(toward, axis=1)
        cosine = twin_cone(distance / sphere[3])
        angle = np.arccos(cosine)
        lo, hi = np.cos(np.minimum(angle + width, np.pi)), np.cos(np.maximum(angle - width, 0))
        opacity = np.minimum(1, (1 - cosine) / (1 - (hi + lo) / 2)) * twin_near(distance / sphere[3])
        t = np.einsum("pi,pqi->pq", toward / distance[:, None], directions)
        t = np.clip((t - lo[:, None]) / (hi - lo)[:, None], 0, 1)
        result *= 1 - opacity[:, None] * t**2 * (3 - 2 * t)
    return result


def normalized(mesh, device) -> NormalizedMesh:
    diagonal = np.linalg.norm(np.ptp(mesh.positions, axis=0))
    return NormalizedMesh((mesh.positions / diagonal).astype(np.float32), mesh.faces, wp.get_device(device))


@pytest.fixture
def refinement(device):
    """A refinement of a small body, and spheres that receivers see from near, far and inside."""
    mesh, rng = normalized(bumpy(), device), np.random.default_rng(SEED)
    spheres = stage_1.greedy_cover(mesh, 12, rng)
    return stage_2.Refinement(mesh, FitReceivers(mesh, 4096, rng), rng), spheres.astype(np.float32).astype(np.float64)


def seen_from(fit, chosen):
    """Points [receiver, 3] of a refinement, and the directions that they look to [receiver, direction, 3]."""
    places = fit.receivers.frame_rows[:, chosen].T.astype(np.float64)
    frames = places[:, 3:].reshape(-1, 3, 3)
    return places[:, :3], np.einsum("qi,pij->pqj", fit.receivers.directions, frames)


def differences(loss, spheres, step):
    """Central differences of a loss by centers and logarithms of radii."""
    result = np.zeros_like(spheres)
    for index in np.ndindex(spheres.shape):
        change = np.zeros_like(spheres)
        change[index] = step
        grown = np.where(np.arange(4) == 3, spheres * np.exp(change), spheres + change)
        shrunk = np.where(np.arange(4) == 3, spheres * np.exp(-change), spheres - change)
        result[index] = (loss(grown) - loss(shrunk)) / (2 * step)
    return result


# ------------------------------------------------------------------------------ stage 1


def test_signed_distances_are_those_of_a_box_and_negative_inside(device):
    half = np.array([0.5, 0.3, 0.4])
    mesh = normalized(box(2 * half), device)
    scale = np.linalg.norm(2 * half)
    points = np.random.default_rng(SEED).uniform(-0.8, 0.8, size=(200, 3))
    beyond = np.abs(points) - half
    expected = np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)
    got, slopes = mesh.signed_distances(points / scale)
    np.testing.assert_allclose(got * scale, expected, atol=1e-5)
    assert (expected < 0).sum() > 20
    ahead, _ = mesh.signed_distances(points / scale + 1e-3 * slopes)
    assert np.median(np.abs(ahead - got - 1e-3)) < 1e-5


# ------------------------------------------------------------------------------ stage 2


@pytest.mark.slow
def test_soft_transmittance_and_loss_agree_with_float64(refinement):
    fit, spheres = refinement
    chosen = np.arange(0, 4096, 31)
    width = 0.1
    got = fit.transmittance(spheres, chosen, width)
    points, directions = seen_from(fit, chosen)
    np.testing.assert_allclose(got, twin_transmittance(points, directions, spheres, width), atol=2e-4)


@pytest.mark.slow
def test_refinement_gradient_agrees_with_differences_in_float64(refinement):
    fit, spheres = refinement
    seen, chosen = fit.receivers, np.arange(0, 4096, 19)
    width = 0.1
    points, directions = seen_from(fit, chosen)

    def loss(balls):
        error = twin_transmittance(points, directions, balls, width) - seen.visibility[chosen]
        return (seen.weights[chosen] * (error @ seen.metric.astype(np.float64)) * error).sum() / len(chosen)

    got_loss, got = fit.gradient(spheres, chosen, width)
    assert got_loss == pytest.approx(loss(spheres), rel=1e-4)
    expected = differences(loss, spheres, 1e-6)
    np.testing.assert_allclose(got, expected, atol=2e-3 * np.abs(expected).max())


# ------------------------------------------------------------------------------ spheres and their occlusion


def test_exact_occlusion_agrees_with_the_cone_outside_on_and_inside_the_sphere(device):
    center, radius = np.array([0.3, -0.2, 0.5]), 0.7
    away = np.array([0.01, 0.1, 0.13, 0.5, 0.999, 1.0, 1.004, 1.02, 1.5, 20.0])
    outward = fibonacci(16)[: len(away)]
    points = (center + away[:, None] * radius * outward).astype(np.float32)
    directions = fibonacci(1024)

    def array(values, kind):
        return wp.array(np.asarray(values, np.float32), dtype=kind, device=device)

    got = exact_occlusion(
        array(points[None], wp.vec3),
        array(directions, wp.vec3),
        array([[center, center + 9]], wp.vec3),
        array([[radius, 0.0]], wp.float32),  # a radius of 0 blocks nothing
    ).numpy()[0]
    cosine = -outward @ directions.T
    edge = twin_cone(away)[:, None]
    expected = (cosine > edge) & (twin_near(away) > 0.5)[:, None]
    clear = np.abs(cosine - edge) > 2e-3
    assert clear.mean() > 0.95
    np.testing.assert_array_equal(got[clear], expected[clear])
    assert got[4].mean() == pytest.approx(0.5, abs=0.01)  # a hemisphere from inside


def test_the_refinement_sees_the_cones_that_the_renderer_sees(device):
    rng = np.random.default_rng(SEED)
    points = rng.normal(size=(1, 64, 3))
    centers, radii = 0.5 * rng.normal(size=(1, 6, 3)), rng.uniform(0.1, 0.6, size=(1, 6))

    def array(values, kind):
        return wp.array(np.asarray(values, np.float32), dtype=kind, device=device)

    directions = fibonacci(128)
    spheres = array(centers, wp.vec3), array(radii, wp.float32)
    got = transmittance(array(points, wp.vec3), None, *spheres, directions).numpy()[0]
    width = SOFTNESS * cell_radius(128)
    everywhere = np.broadcast_to(directions, (64, 128, 3))
    twin = twin_transmittance(points[0], everywhere, np.column_stack([centers[0], radii[0]]), width)
    np.testing.assert_allclose(got, twin, atol=2e-3)


def test_a_similarity_moves_and_scales_spheres():
    spheres = Spheres([[1, 0, 0], [0, 2, 0]], [0.5, 1.5])
    quarter_turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = spheres.transformed(rotation=quarter_turn, translation=(0, 0, 3), scale=2.0)
    np.testing.assert_allclose(moved.centers, [[0, 2, 3], [-4, 0, 3]], atol=1e-6)
    np.testing.assert_allclose(moved.radii, [1.0, 3.0])
    both = Spheres.concatenate([spheres, moved])
    assert len(both) == 4 and len(Spheres.concatenate([])) == 0
    np.testing.assert_array_equal(both.centers[2:], moved.centers)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Spheres([[0, 0]], [1]), r"centers: got shape \(1, 2\)"),
        (lambda: Spheres([[0, 0, np.nan]], [1]), "centers: got 1 NaN"),
        (lambda: Spheres([[0, 0, 0]], [-1]), "radii: got -1"),
        (lambda: Spheres([[0, 0, 0]], [1, 2]), "radii: got 2 radii for 1 centers"),
        (lambda: Spheres([[0, 0, 0]], [1]).transformed(scale=0), "scale: got 0"),
        (lambda: Spheres([[0, 0, 0]], [1]).transformed(rotation=2 * np.eye(3)), "rotation: got"),
    ],
)
def test_spheres_that_are_none_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


# ------------------------------------------------------------------------------ fits


@pytest.mark.slow
def test_a_ball_is_one_sphere():
    fit = fit_spheres(icosphere(2.0, 3), 1, **{**QUICK, "steps": 300})
    assert fit.spheres.radii[0] == pytest.approx(2.0, rel=0.03)
    assert np.linalg.norm(fit.spheres.centers[0]) < 0.08
    assert fit.report.coverage > 0.95
    assert fit.report.visibility_error < 0.03


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bits_and_another_one_does_not(device):
    options = {**QUICK, "device": device}
    first, second = (fit_spheres(bumpy(), 10, **options).spheres for _ in range(2))
    np.testing.assert_array_equal(first.centers, second.centers)
    np.testing.assert_array_equal(first.radii, second.radii)
    other = fit_spheres(bumpy(), 10, seed=1, **{**QUICK, "steps": 2, "device": device}).spheres
    assert not np.array_equal(first.centers, other.centers)


@pytest.mark.slow
def test_a_mesh_moved_and_scaled_gets_its_spheres_moved_and_scaled():
    mesh = bumpy()
    moved = Mesh(mesh.positions.astype(np.float64) * 50 + [300, -70, 20], mesh.faces)
    options = {**QUICK, "steps": 10}  # rounding of the moved positions changes last bits, which descent amplifies
    here, there = (fit_spheres(each, 10, **options).spheres for each in (mesh, moved))
    np.testing.assert_allclose(here.transformed(translation=(300, -70, 20), scale=50).centers, there.centers, atol=1.0)
    np.testing.assert_allclose(50 * here.radii, there.radii, atol=1.0)
    power = Mesh(mesh.positions * np.float32(4), mesh.faces)
    np.testing.assert_array_equal(4 * here.centers, fit_spheres(power, 10, **options).spheres.centers)


@pytest.mark.slow
def test_refinement_and_more_spheres_lower_the_error():
    cover = fit_spheres(bumpy(), 16, **{**QUICK, "steps": 1}).report
    few, some, many = (fit_spheres(bumpy(), count, **{**QUICK, "steps": 200}).report for count in (4, 16, 40))
    assert some.surface_error < 0.8 * cover.surface_error
    assert few.visibility_error > some.visibility_error > many.visibility_error


@pytest.mark.slow
def test_a_requested_error_is_met_with_as_few_spheres_as_needed():
    fit = fit_spheres(bumpy(), error=0.09, **{**QUICK, "steps": 100})
    assert fit.report.visibility_error <= 0.09
    assert fit.report.sphere_count == len(fit.spheres) <= 64


@pytest.mark.slow
def test_open_and_multi_part_meshes_are_fitted():
    ball, bowl = icosphere(1.0, 3), half_shell()
    grid = np.linspace(-1, 1, 12)
    x, z = np.meshgrid(grid, grid)
    index = np.arange(144).reshape(12, 12)
    corners = [index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]]
    quads = np.stack(corners, axis=-1).reshape(-1, 4)
    sheet = Mesh(np.column_stack([x.ravel(), 0.3 * x.ravel(), z.ravel()]), quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3))
    two = joined(ball, Mesh(ball.positions + [2.5, 0.5, 0], ball.faces))
    for mesh, share in (
        (bowl, 0.6),
        (sheet, 0.6),
        (two, 0.15),
    ):  # small spheres are a poor sheet: they have a thickness
        none, fit = (fit_spheres(mesh, count, **{**QUICK, "steps": 100}) for count in (0, 24))
        assert 0 < len(fit.spheres) <= 24
        unshadowed, error = (np.hypot(each.report.ground_error, each.report.nearby_error) for each in (none, fit))
        assert error < share * unshadowed


def revolved(*profile) -> Mesh:
    """A solid of revolution by its outline, radius and height, from the axis to the axis."""
    trimesh = pytest.importorskip("trimesh")
    solid = trimesh.creation.revolve(np.array(profile, float), sections=32)
    solid.fix_normals()
    return Mesh(solid.vertices[:, [0, 2, 1]], solid.faces[:, ::-1])


def half_shell() -> Mesh:
    ball = icosphere(1.0, 3)
    return Mesh(ball.positions, ball.faces[ball.positions[ball.faces].mean(axis=1)[:, 1] < 0])


def test_no_sphere_is_in_the_open_and_cavities_stay_light(device):
    """Of 64 spheres fitted to a bowl without a view into its cavity, eight touched no solid."""
    angles = np.linspace(0, np.pi / 2, 12)
    arc = np.stack([np.sin(angles), 1 - np.cos(angles)], axis=1)
    bowl = revolved(*arc, *(arc * 0.93 + [0, 0.07])[::-1])
    mug = revolved((0, 0), (0.42, 0), (0.42, 1), (0.37, 1), (0.37, 0.06), (0, 0.06))
    for mesh in (bowl, mug, half_shell()):
        fit = fit_spheres(mesh, 64, **QUICK, device=device)
        corners = mesh.positions[mesh.faces].reshape(-1, 3)
        middle, diagonal = (corners.min(axis=0) + corners.max(axis=0)) / 2, np.linalg.norm(np.ptp(corners, axis=0))
        at_origin = Mesh(corners - middle, np.arange(len(corners)).reshape(-1, 3))
        distances, _ = normalized(at_origin, device).signed_distances((fit.spheres.centers - middle) / diagonal)
        assert (distances * diagonal <= fit.spheres.radii).all()
        cavity = middle + [[0.0, 0.1, 0.0], [0.1, 0.2, 0.0], [0.0, 0.3, 0.1]]
        gaps = np.linalg.norm(cavity[:, None] - fit.spheres.centers, axis=2) - fit.spheres.radii
        assert (gaps > 0).all()


def test_a_cloth_lets_no_light_through():
    """A sheet over a ridge. Its spheres, which darken the sheet itself, once shrank until its shadow was off by 40%."""
    flat = plane(2.0, 8)
    x, y, z = flat.positions.T
    cloth = Mesh(np.stack([x, 0.8 * (1 - abs(x)) + 0.05, z], axis=1), flat.faces)
    assert fit_spheres(cloth, 96, **QUICK).report.shadow_error < 0.2  # measured 9%


def test_an_open_mesh_has_the_same_spheres_whatever_its_winding():
    shell = half_shell()
    turned = Mesh(shell.positions, shell.faces[:, ::-1])
    one, other = (fit_spheres(each, 12, **QUICK) for each in (shell, turned))
    np.testing.assert_array_equal(one.spheres.centers, other.spheres.centers)
    assert dataclasses.replace(one.report, seconds=0) == dataclasses.replace(other.report, seconds=0)


def test_a_fit_that_fills_a_cavity_is_not_called_good():
    """A ball in half a shell has its shadow on the ground, and none of its light inside."""
    shell = normalized(half_shell(), "cpu")
    ball = np.array([[0, 0, 0, 1 / 3]])  # its diagonal is three radii
    filled = stage_3.measure(shell, ball, 0.0)
    assert filled.nearby_error > 0.3 and filled.outside_volume == 1
    assert filled.visibility_error >= filled.nearby_error


def test_a_body_has_as_many_spheres_as_it_needs(monkeypatch):
    """A ball few, and a slab, whose shadow has holes as long as they are few, as many as there may be."""
    monkeypatch.setattr(enough, "TRIED_COUNTS", (8, 32))
    meshes = (normalized(mesh, "cpu") for mesh in (icosphere(1.0, 3), box((1.0, 0.05, 0.8), 2)))
    for mesh, expected in zip(meshes, ((8, 16), (32, enough.MAX_SPHERES)), strict=True):
        receivers = FitReceivers(mesh, 2048, np.random.default_rng(SEED))
        assert enough.enough_spheres(mesh, receivers, seed=0) in expected


def test_bodies_of_one_shape_are_fitted_once_without_a_cache_on_disk(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path / "file"))
    options = {**QUICK, "cache": True}
    with pytest.warns(UserWarning, match="could not be cached"):
        assert not fit_spheres(icosphere(1.0, 1), 0, **options).report.cached
    assert fit_spheres(icosphere(3.0, 1), 0, **options).report.cached


def test_no_spheres_are_an_empty_fit():
    fit = fit_spheres(bumpy(), 0, **QUICK)
    assert len(fit.spheres) == 0 and fit.report.coverage == 0 and fit.report.ground_error > 0.05


def test_the_error_of_a_shadow_is_relative_to_it():
    """None of it is the mesh's without spheres, and nearly all with the ball that the mesh is."""
    mesh = normalized(icosphere(1.0, 4), "cpu")
    none, ball = np.zeros((0, 4)), np.array([[0, 0, 0, 1 / np.sqrt(12)]])
    assert stage_3.measure(mesh, none, 0.0).shadow_error == pytest.approx(1)
    assert stage_3.measure(mesh, ball, 0.0).shadow_error < 0.03
    assert stage_3.measure(mesh, ball * [1, 1, 1, 0.9], 0.0).shadow_error > 0.1


def test_a_ragged_shadow_costs_one_warning_for_a_mesh_with_the_remedy(monkeypatch):
    report = stage_3.FitReport(64, 0.9, 0.1, 0.02, 0.02, 0.02, shadow_error=0.21, seconds=1.0)
    monkeypatch.setattr(fit_module._MeshFits, "fit", lambda *_: (np.ones((1, 4), np.float32), report))
    thin, others = bumpy(), {"count": 64, "cache": False}
    with pytest.warns(UserWarning, match='.mesh. is thin for 64 spheres: .*21%.*blockers = "auto".*ray-traced') as told:
        fit_spheres(thin, **others)
    assert len(told) == 1
    with pytest.warns(UserWarning, match="around it is off by 21%"):
        fit_spheres(bumpy(), **others, seen_from=(0, 1, 0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit_spheres(thin, **others)
        fit_spheres(bumpy(), 16, cache=False)  # whoever asks for few knows
        fit_spheres(Mesh([[0, 0, 0], [1, 0, 0], [0, 0, 1]], [[0, 1, 2]]), **others)
        slab = report = dataclasses.replace(report, ground_error=0.004)  # on the ground, with next to no shadow
        fit_spheres(bumpy(), **others)
        good = report = dataclasses.replace(slab, ground_error=0.02, shadow_error=0.08)
        fit_spheres(bumpy(), **others)
    report = dataclasses.replace(good, nearby_error=0.5)
    with pytest.warns(UserWarning, match="the light in its cavities and around it is off by 50%"):
        fit_spheres(bumpy(), **others)
    report = dataclasses.replace(good, surface_error=0.33)
    with pytest.warns(UserWarning, match="the light on its sides is off by 33%, so some comes through"):
        fit_spheres(bumpy(), **others)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit_spheres(bumpy(), **others, warns=False)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"count": -1}, "count: got -1"),
        ({"count": 2.5}, "count: got 2.5"),
        ({"count": "many"}, "count: got 'many', expected one of 'auto'"),
        ({"error": 0.0}, "error: got 0.0"),
        ({"steps": None}, "steps: got None"),
        ({"steps": 0}, "steps: got 0"),
    ],
)
def test_arguments_out_of_range_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        fit_spheres(bumpy(), **{**QUICK, **arguments})


def test_a_mesh_without_surface_is_refused():
    line = Mesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]])
    with pytest.raises(ValueError, match="without area"):
        fit_spheres(line, 4, **QUICK)
    with pytest.raises(ValueError, match=r"mesh: got 'cow.obj', expected a Mesh; load_mesh\(path\) reads one"):
        fit_spheres("cow.obj")


# ------------------------------------------------------------------------------ cache and picture


@pytest.mark.slow
def test_a_fit_goes_on_where_an_interrupt_left_it_to_the_same_bits(tmp_path, monkeypatch):
    """In the second short fit, and in the descent, before it draws receivers once more (after 32 batches)."""
    steps, limit, gradient = [], [np.inf], stage_2.Refinement.gradient

    def counted(self, *args):
        if len(steps) == limit[0]:
            raise KeyboardInterrupt
        steps.append(1)
        return gradient(self, *args)

    def fit(folder):
        monkeypatch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path / folder))
        steps.clear()
        return fit_spheres(bumpy(), **{**QUICK, "cache": True, "steps": 40})

    monkeypatch.setattr(stage_2.Refinement, "gradient", counted)
    monkeypatch.setattr(enough, "TRIED_COUNTS", (2, 4))
    monkeypatch.setattr(enough, "_MAX_ERROR", 0.0)
    monkeypatch.setattr(enough, "_STEPS", 10)
    whole = fit("whole").spheres
    assert len(steps) == 60  # of two short fits, and the descent
    for stop, kept, known in ((15, "1 short fits", 10), (40, "20 of 40 steps", 40)):
        limit[0] = stop
        with pytest.raises(KeyboardInterrupt, match=f"^{kept} of the fit are cached"):
            fit(kept)
        (part,) = cached_files("spheres")
        assert part.name.endswith(".part.npz")
        limit[0] = np.inf
        resumed = fit(kept).spheres
        np.testing.assert_array_equal(resumed.centers, whole.centers)
        np.testing.assert_array_equal(resumed.radii, whole.radii)
        assert len(steps) == 60 - known
        assert [path.name for path in cached_files("spheres")] == [part.name.replace(".part", "")]


@pytest.mark.slow
def test_a_fit_is_read_from_the_cache_and_made_again_when_the_file_is_damaged(tmp_path, monkeypatch):
    monkeypatch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path))
    options = {**QUICK, "cache": True, "steps": 5}
    made = fit_spheres(bumpy(), 6, **options)
    (file,) = (tmp_path / "spheres").iterdir()
    read = fit_spheres(bumpy(), 6, **options)
    assert not made.report.cached and read.report.cached
    np.testing.assert_array_equal(made.spheres.centers, read.spheres.centers)
    assert read.report.ground_error == made.report.ground_error

    file.write_bytes(b"not a fit")
    with pytest.warns(UserWarning, match="cannot be read"):
        again = fit_spheres(bumpy(), 6, **options)
    np.testing.assert_array_equal(made.spheres.centers, again.spheres.centers)
    assert fit_spheres(bumpy(), 6, **options).report.cached
    fit_spheres(bumpy(), 7, **options)
    assert len(list((tmp_path / "spheres").iterdir())) == 2  # and no temporary files


def test_the_fit_of_a_mesh_in_memory_is_not_read_again(tmp_path, monkeypatch):
    monkeypatch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path))
    options, mesh = {**QUICK, "cache": True}, icosphere(1.0, 1)
    made = fit_spheres(mesh, 0, **options)
    (file,) = (tmp_path / "spheres").iterdir()
    file.unlink()
    kept = fit_spheres(mesh, 0, **options)
    assert kept.spheres is made.spheres and kept.report.cached and not file.exists()
    assert not fit_spheres(mesh, 0, **options, seed=1).report.cached
    monkeypatch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path / "other"))
    assert not fit_spheres(mesh, 0, **options).report.cached  # which is not there


@pytest.mark.slow
def test_of_two_processes_that_want_the_same_fit_one_waits_and_reads_it(tmp_path):
    command = (
        "from warpshadow import fit_spheres, icosphere; "
        "print(fit_spheres(icosphere(1.0, 1), 6, steps=20, progress=False).report.cached)"
    )
    environment = os.environ | {"WARPSHADOW_CACHE_DIR": str(tmp_path)}
    start = partial(
        subprocess.Popen, [sys.executable, "-c", command], env=environment, stdout=subprocess.PIPE, text=True
    )
    processes = [start(), start()]
    answers = [process.communicate(timeout=300)[0].splitlines()[-1] for process in processes]
    assert sorted(answers) == ["False", "True"]


@pytest.mark.slow
def test_a_cache_that_cannot_be_written_costs_a_warning(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path / "file"))
    with pytest.warns(UserWarning, match="the fit could not be cached in"):
        assert not fit_spheres(bumpy(), 6, **{**QUICK, "cache": True, "steps": 5}).report.cached


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows has no umask")
def test_fits_in_a_folder_that_is_shared_can_be_read_by_others(tmp_path, monkeypatch):
    monkeypatch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path))
    before = os.umask(0o002)
    try:
        fit_spheres(bumpy(), 6, **{**QUICK, "cache": True, "steps": 5})
    finally:
        os.umask(before)
    (file,) = (tmp_path / "spheres").iterdir()
    assert stat.S_IMODE(file.stat().st_mode) == 0o664


def test_a_picture_needs_matplotlib_and_says_so(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError, match=r'package matplotlib: pip install "warpshadow\[plot\]"'):
        plot_spheres(bumpy(), Spheres([[0, 0, 0]], [0.5]), tmp_path / "spheres.png")


def test_the_picture_of_a_fit_is_written(tmp_path):
    pytest.importorskip("matplotlib")
    path = tmp_path / "spheres.png"
    plot_spheres(bumpy(), Spheres([[0, 0, 0]], [0.5]), path)
    assert path.stat().st_size > 10_000


# ------------------------------------------------------------------------------ accuracy and portability


@pytest.mark.slow
def test_64_spheres_on_the_bunny_meet_the_targets():
    pytest.importorskip("pxr", reason="reading bunny.usd takes usd-core")
    import warp.examples

    mesh = load_mesh(os.path.join(warp.examples.get_asset_directory(), "bunny.usd"))
    report = fit_spheres(mesh, 64, cache=False, progress=False).report
    assert report.ground_error < 0.035
    assert report.surface_error < 0.06
