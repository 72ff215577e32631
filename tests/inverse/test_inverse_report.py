"""Reports: what is written of a fit is what it found, and can be rendered again."""

import re
import sys
from dataclasses import replace

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
    Loss,
    Pose,
    Problem,
    Radii,
    Stage,
    Target,
    Texture,
    fit,
)
from warpshadow.inverse.report import Report, found_values, write_result
from warpshadow.maths import sh
from warpshadow.scene import toml_tables
from warpshadow.scene.files import parse_camera
from warpshadow.torch import TorchRenderer

# Bodies are placed in float32 in the fit, and by their written rotation vectors when rendered again.
PLACED = 2e-4
# A map of cells is sampled where they end, so their light is not quite the same again (0.4%).
CELLS = 0.01
DIRECTIONAL = ws.Visibility(directions=32)


def make_scene():
    ball = ws.Body(
        ws.icosphere(0.5, 1), blockers=ws.Spheres([[-0.2, 0, 0], [0.2, 0, 0]], [0.3, 0.3]), translation=(0, 0.6, 0)
    )
    ground = ws.Body(ws.plane(4.0, 8), blockers=0)
    camera = ws.Camera.look_at((0, 2, 3), (0, 0.4, 0), size=(16, 12))
    light = ws.synthetic_sky(height=16, sun_radius=12).sh(3)
    return ws.Scene((ball, ground), light, camera, DIRECTIONAL, supersampling=1)


def run(*free, views=1, scene=None, **options):
    """A few iterations towards brighter images, taken a little to the side."""
    scene = scene or make_scene()
    cameras = [ws.Camera.look_at((0.5 * view, 2, 3), (0, 0.4, 0), size=(16, 12)) for view in range(views)]
    aside = [replace(camera, translation=camera.translation + (0.1, 0, 0)) for camera in cameras]
    images = [1.2 * ws.Renderer(replace(scene, camera=camera)).render() for camera in aside]
    targets = [Target(image, camera=camera) for image, camera in zip(images, cameras, strict=True)]
    return fit(Problem(scene, targets, free, still=DIRECTIONAL), [Stage(4)], **options)


def rendered_again(folder, result):
    """Images of the scene that was written, by the views' cameras and exposures that were written.

    All cameras at once, as of the fit: receivers are chosen for them together.
    """
    scene, summary = ws.load_scene(folder / "scene.toml"), toml_tables.read(folder / "summary.toml", "summary")
    views = summary["view"]
    cameras = [parse_camera({key: value for key, value in view.items() if key != "exposure"}) for view in views]
    images = TorchRenderer(scene, cameras=cameras)().numpy().reshape(len(views), cameras[0].height, cameras[0].width, 4)
    exposures = np.float32([[view["exposure"]] * 3 + [1] for view in views])
    return exposures[:, None, None] * images


@pytest.mark.slow
@pytest.mark.parametrize(
    ("free", "tolerance"),
    [
        ([Light(3)], 1e-5),
        ([Light(order=None, directions=32)], CELLS),
        ([Albedo(0), Exposure()], 1e-5),
        ([Albedo(0, per_vertex=True), Texture(1, (8, 8))], 1e-5),
        ([Pose(0, scale=True)], PLACED),
        ([CameraPose(focal=True)], PLACED),
        ([Deformation(0, count=1), Radii(0), Pose(0)], PLACED),
    ],
    ids=lambda value: "+".join(free.name for free in value) if isinstance(value, list) else "",
)
def test_what_is_written_of_a_fit_renders_as_its_result(tmp_path, free, tolerance):
    result = run(*free, views=2)
    files = write_result(result, tmp_path / "out")
    assert sorted(files) == sorted((tmp_path / "out").iterdir())
    expected, before = result.images(), result.images_at_start()
    got = rendered_again(tmp_path / "out", result)
    error, change, size = (np.linalg.norm(image) for image in (got - expected, expected - before, expected))
    assert error < tolerance * size < change  # so that what was not written would show


def test_weights_show_an_occluder_that_a_redescending_loss_forgot(tmp_path):
    scene = make_scene()
    image = ws.Renderer(scene).render()[..., :3]
    mask = np.ones(image.shape[:2], np.float32)
    mask[:, :2] = 0.5
    image[4:8, 6:10] += 8 * image.mean()  # where the scene has no body
    problems = [
        Problem(scene, Target(image, mask), Albedo(0), Loss(kind), still=DIRECTIONAL)
        for kind in ("geman-mcclure", "l2")
    ]
    robust, squares = (fit(problem, [Stage(5)], progress=False) for problem in problems)
    weights = robust.pixel_weights[0].copy()
    assert weights[4:8, 6:10].max() < 0.01
    weights[4:8, 6:10] = mask[4:8, 6:10]
    np.testing.assert_allclose(weights, mask, atol=0.05)
    np.testing.assert_array_equal(squares.pixel_weights[0], mask)
    names = [file.name for file in write_result(squares, tmp_path / "squares")]
    assert "weights.png" not in names
    files = write_result(robust, tmp_path / "robust")
    assert tmp_path / "robust" / "weights.png" in files
    as_mask = Target(image, tmp_path / "robust" / "weights.png").mask
    np.testing.assert_allclose(as_mask, robust.pixel_weights[0], atol=1 / 255)


def test_a_translation_is_printed_with_the_shift_of_the_middle_from_the_start():
    scene = make_scene()
    far = scene.bodies[0].mesh.transformed(translation=(50, 0, 0))
    ball = replace(scene.bodies[0], mesh=far, blockers=0, translation=(-50, 0.6, 0))
    result = run(Pose(0), scene=replace(scene, bodies=[ball, scene.bodies[1]]))
    (line,) = [line for line in found_values(result) if "translation" in line]
    pattern = r"\S+ translation  \((.*)\) scene units, its middle moved by \((.*)\)"
    found, shift = re.fullmatch(pattern, line).groups()
    body = result.scene.bodies[0]
    np.testing.assert_allclose([float(part) for part in found.split(", ")], body.translation, rtol=1e-3)
    moved = [float(part) for part in shift.split(", ")]
    np.testing.assert_allclose(moved, body.to_world(np.array([50.0, 0, 0])) - (0, 0.6, 0), atol=1e-4)
    assert 0 < np.linalg.norm(moved) < 1
    twin = replace(ball, translation=(-48, 0.6, 0))
    twins = run(Pose(0), scene=replace(scene, bodies=[ball, twin, scene.bodies[1]]))
    assert [line.split()[0] for line in found_values(twins) if "translation" in line] == ["body_0"]


def test_found_values_stand_below_each_other_with_their_units():
    *others, exposure = found_values(run(Albedo(0), Exposure()))
    assert re.fullmatch(r"exposure  +-?[\d.]+ stops", exposure) and others
    assert {re.match(r".*?  +", line).end() for line in others} == {re.match(r"exposure +", exposure).end()}


def test_all_values_are_in_an_archive_by_their_names(tmp_path):
    result = run(Light(3), Albedo(0))
    write_result(result, tmp_path)
    with np.load(tmp_path / "parameters.npz") as archive:
        assert set(archive) == {"light.coefficients", "albedo[0].color"}
        np.testing.assert_array_equal(archive["light.coefficients"], result.values["light"]["coefficients"])


def test_light_in_harmonics_is_also_written_as_a_map(tmp_path):
    result = run(Light(3))
    write_result(result, tmp_path)
    image = ws.read_image(tmp_path / "light.exr")
    np.testing.assert_allclose(image, sh.reconstruct_map(result.scene.light, 64), atol=1e-5)


def test_free_light_is_drawn_and_the_summary_says_how_much_of_it_is_a_guess(tmp_path):
    result = run(Light(3))
    write_result(result, tmp_path)
    summary = toml_tables.read(tmp_path / "summary.toml", "summary")
    assert 0.0 < summary["light"]["undetermined"] == round(result.light.undetermined_share, 4) < 0.5
    np.testing.assert_allclose(ws.read_image(tmp_path / "light.png").shape, (256, 512, 3))
    write_result(run(Albedo(0)), tmp_path / "other")
    assert not (tmp_path / "other" / "light.png").exists()
    assert "light" not in toml_tables.read(tmp_path / "other" / "summary.toml", "summary")


def test_the_summary_says_how_the_fit_ended(tmp_path):
    result = run(Albedo(0), Exposure())
    report = Report(result)
    report.write(tmp_path)
    summary = toml_tables.read(tmp_path / "summary.toml", "summary")
    assert summary["fit"]["reason"] == result.reason == "finished"
    assert summary["fit"]["iterations"] == 4
    assert summary["fit"]["loss_before"] == pytest.approx(result.losses[0][0], rel=1e-5)
    assert summary["fit"]["loss_after"] == report.loss_after < report.loss_before
    assert summary["fit"]["milliseconds_per_iteration"] == pytest.approx(1e3 * result.seconds, abs=1e-3)
    assert [view["exposure"] for view in summary["view"]] == result.found.exposures


def test_the_loss_after_is_that_of_the_values_at_full_size_whatever_the_stages_were(tmp_path):
    scene = make_scene()
    problem = Problem(scene, Target(1.2 * ws.Renderer(scene).render()), Albedo(0), still=DIRECTIONAL)
    coarse = fit(problem, [Stage(4, scale=0.25)])
    with torch.no_grad():
        images = torch.tensor(coarse.images())
        target = torch.tensor(problem.targets[0].image[None])
        expected = problem.loss(images, target, torch.ones(images.shape[:3]), coarse.context.unit)
    assert Report(coarse).loss_after == pytest.approx(float(expected), rel=1e-5)


def test_pictures_show_target_and_images_at_one_exposure_side_by_side(tmp_path):
    result = run(Albedo(0), views=2)
    write_result(result, tmp_path)
    targets = np.stack([target.image for target in result.problem.targets])[..., :3]
    white = np.percentile(targets.max(axis=-1), 99)
    for name, images in {"target": targets, "before": result.images_at_start(), "after": result.images()}.items():
        picture = ws.read_image(tmp_path / f"{name}.png")
        expected = np.clip(np.concatenate([*images[..., :3]], axis=1) / white, 0, 1)
        assert np.abs(picture - expected).max() < 0.006  # half a step of 8-bit sRGB where it is steepest


def test_the_losses_are_plotted_and_without_matplotlib_a_warning_says_why_not(tmp_path, monkeypatch):
    result = run(Albedo(0))
    assert tmp_path / "loss.png" in write_result(result, tmp_path)
    (tmp_path / "loss.png").unlink()
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.warns(UserWarning, match="not drawn, which needs the package matplotlib: pip install"):
        files = write_result(result, tmp_path)
    assert tmp_path / "loss.png" not in files and not (tmp_path / "loss.png").exists()
