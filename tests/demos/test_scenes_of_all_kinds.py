"""Scenes of all kinds: how errors are measured, and two of the scenes, small."""

import dataclasses
import functools
import json
from concurrent.futures import Future

import numpy as np
import pytest

import warpshadow as ws
from demos import kinds, shapes
from demos.benchmarks import scenes_of_all_kinds as bench
from demos.references import Reference, Request, by_rays, turned
from warpshadow.pipeline.bounces import self_form_factors

SMALL = 40  # pixels across

# relative L2 error of two scenes, with spheres that are not fitted, half again as much as measured
BOUNDS = {"bowl": 0.33, "letters": 0.12}


@pytest.fixture
def gray():
    """A reference of 16 × 16 pixels: a gray body on the left, a white one on the right, a row of nothing."""
    images = np.ones((2, 16, 16, 4), np.float32)
    images[:, :, :8, :3] = 0.5
    images[:, 15] = 0
    body = np.where(np.arange(16) < 8, 0, 1) * np.ones((16, 1), int)
    body[15] = -1
    return Reference(images, body, np.ones((16, 16), bool))


class Here:
    """Stands for a pool of processes: does at once, in this one, all that is submitted."""

    def __init__(self, *arguments, **options):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        pass

    def submit(self, function, *arguments):
        future = Future()
        future.set_result(function(*arguments))
        return future


def with_quick_spheres(kind):
    """The same scene with spheres that are found at once: they touch the faces from within."""

    @functools.cache
    def scene(sources, size):
        whole = kind(sources, size)
        bodies = [
            body
            if body.mesh.is_flat
            else dataclasses.replace(body, blockers=spheres_within(body.mesh), self_shadows="spheres")
            for body in whole.bodies
        ]
        return dataclasses.replace(whole, bodies=bodies)

    return scene


def spheres_within(mesh, count=64):
    """Spheres behind points of a mesh that are drawn in proportion to area."""
    corners = mesh.positions[mesh.faces].astype(float)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    rng = np.random.default_rng(0)
    faces = rng.choice(len(area), count, p=area / area.sum())
    points = np.einsum("sk,skc->sc", rng.dirichlet([1, 1, 1], count), corners[faces])
    radius = 0.04 * np.ptp(mesh.positions, axis=0).max()
    return ws.Spheres(points - radius * normals[faces] / area[faces, None], np.full(count, radius))


def noisy(reference, deviation):
    """The same with noise of both images."""
    noise = np.random.default_rng(0).normal(scale=deviation, size=reference.images.shape)
    noise[..., 3] = 0
    return dataclasses.replace(reference, images=reference.images + noise * reference.covered[..., None])


# ---------------------------------------------------------------------------------------------- measures


def test_a_body_that_is_too_bright_is_named_and_others_are_not(gray):
    image = gray.mean.copy()
    image[:, 8:, :3] *= 1.1
    assert gray.body_errors(image, 3) == [pytest.approx(0), pytest.approx(0.1, rel=1e-5), None]
    assert gray.error(image) == pytest.approx(0.1 / np.sqrt(1.25))
    assert gray.worst_block(image) == (pytest.approx(0.1 / 0.75), (0, 8))


def test_noise_of_a_reference_is_taken_off(gray):
    reference = noisy(gray, 0.2)
    assert 0.1 < reference.noise() < 0.25
    assert reference.error(gray.mean) < 0.3 * reference.noise()
    brighter = gray.mean * (1.2, 1.2, 1.2, 1)
    assert reference.error(brighter) == pytest.approx(0.2, abs=0.05)


def test_a_body_of_few_pixels_is_measured_where_it_is_seen_at_all_and_one_of_fewer_is_not(gray):
    is_whole = gray.is_whole & ((gray.body != 1) | (np.indices((16, 16))[0] < 1))  # 8 pixels of the white one
    thin = dataclasses.replace(gray, is_whole=is_whole)
    assert (thin.pixels(1) == ((gray.body == 1) & gray.covered)).all()
    hardly = dataclasses.replace(gray, body=np.where((gray.body == 1) & ~is_whole, 0, gray.body))
    assert hardly.body_errors(gray.mean, 2)[1] is None


def test_a_scene_that_is_turned_with_its_light_looks_the_same():
    scene = kinds.nested_boxes(kinds.Sources(), SMALL)
    scene = dataclasses.replace(scene, visibility=ws.Visibility(method="none"))
    image, other = ws.render(scene), ws.render(turned(scene))
    difference = np.abs(image - other).max(axis=-1)
    assert np.quantile(difference, 0.98) < 2e-3 * image.max()  # others are edges


def test_a_reference_is_found_again_until_its_scene_changes(tmp_path):
    scene = kinds.letters(kinds.Sources(), 16)
    request = Request(scene, "rays", 0, 32, tmp_path)
    first = request.reference()
    assert request.path().exists()
    np.testing.assert_array_equal(request.reference().images, first.images)
    bodies = [dataclasses.replace(scene.bodies[0], translation=scene.bodies[0].translation + 0.01), *scene.bodies[1:]]
    for change in ({"bounces": 1}, {"samples": 64}, {"scene": dataclasses.replace(scene, bodies=bodies)}):
        assert dataclasses.replace(request, **change).path() != request.path()
    settings = dataclasses.replace(scene, visibility=ws.Visibility(method="none"), supersampling=1)
    assert dataclasses.replace(request, scene=settings).path() == request.path()


def test_samples_of_a_reference_share_no_receiver():
    """Below a slat that shades the left sample of each third pixel, and not its middle, half of the light is left."""
    sun = np.zeros((512, 1024, 3), np.float32)
    sun[128, 512] = 1e5  # 45° high over +z
    camera = ws.Camera.look_at((0, 1, 0), (0, 0, 0), up=(0, 0, -1), fov_y=90, size=16)
    slats = [shapes.box((0.04, 0.001, 0.4), (2 / 16 * (column + 0.25) - 1, 0.3, 1.2)) for column in range(0, 16, 3)]
    bodies = [ws.Body(ws.plane(4, 1), name="ground"), ws.Body(shapes.joined("slats", slats))]
    scene = ws.Scene(bodies, ws.EnvironmentMap(sun), camera, supersampling=2)
    row = by_rays(scene, 2048)[0, -1, :, 0]
    light = row.max()
    assert row[::3] == pytest.approx(np.full(6, light / 2), rel=0.1)
    assert row[1::3] == pytest.approx(np.full(5, light), rel=0.1)


# ---------------------------------------------------------------------------------------------- scenes


def test_solids_are_closed_and_sheets_are_not():
    closed = [shapes.bowl(), shapes.cup(), shapes.bottle(), shapes.bracket(), shapes.wheel()]
    assert all(mesh.surface.is_closed for mesh in closed)
    assert not shapes.tent().surface.is_closed and not shapes.wall_with_window(3, 3, (1, 1)).surface.is_closed


def test_scenes_have_all_that_they_are_about_in_sight():
    assert len(kinds.SCENES) >= 16
    assert len(kinds.city(kinds.Sources(), SMALL).bodies) == 61
    for name in ("cups", "shelf", "corner", "thousand_to_one"):
        scene = kinds.SCENES[name](kinds.Sources(), SMALL)
        renderer = ws.Renderer(dataclasses.replace(scene, visibility=ws.Visibility(method="none")), progress=False)
        assert set(renderer.body_ids().ravel()) >= set(range(len(scene.bodies))) - (
            {0} if name == "thousand_to_one" else set()
        )


@pytest.mark.slow
def test_two_scenes_are_measured_and_drawn(tmp_path, monkeypatch, capsys):
    """In this process, with spheres that need no fit and form factors of few rays, so that it takes seconds."""
    monkeypatch.setattr(bench, "SCENES", {name: with_quick_spheres(kinds.SCENES[name]) for name in BOUNDS})
    monkeypatch.setattr(bench, "ProcessPoolExecutor", Here)
    monkeypatch.setattr(bench, "MOVED_RUNS", 1)
    monkeypatch.setattr(self_form_factors, "_RAYS", 64)
    settings = ("still-direct", "renderer-full")
    options = bench.Options(
        size=SMALL, samples=128, settings=settings, output=tmp_path / "out", references=tmp_path / "references"
    )
    results = bench.main(list(BOUNDS), options)
    assert list(results) == list(BOUNDS) == list(json.loads((options.output / "results.json").read_text())["scenes"])
    printed = capsys.readouterr().out
    for name, result in results.items():
        assert list(result["settings"]) == list(settings)
        scene = options.scene(name)
        for setting, figures in result["settings"].items():
            assert 0 < figures["error"] < min(BOUNDS[name], figures["block"])
            assert figures["peak MiB"] > 50 and ("moved CPU ms" in figures) == setting.startswith("renderer")
            assert list(figures["bodies"]) == [body.name for body in scene.bodies]
            assert all(abs(error) < 0.7 for error in figures["bodies"].values() if error is not None)
            assert abs(list(figures["bodies"].values())[-1]) < 0.2
            assert f"{name:20}{setting}" in printed
        sheet = ws.read_image(options.output / f"{name}.png")
        assert sheet.shape[1] > 5 * SMALL and np.ptp(sheet[..., :3]) > 0.9
    assert sum(error is not None for error in results["letters"]["settings"]["renderer-full"]["bodies"].values()) == 5
    assert bench.missing_references("bowl", options) == []
