"""A free sun: direction and strength from one image of a body and its shadow."""

import dataclasses

import numpy as np
import pytest
import torch

import warpshadow as ws
from warpshadow import inverse
from warpshadow.inverse.model import Model
from warpshadow.scene import toml_tables

# Degrees of the direction and relative error of the irradiance that a fit finds.
SIDE, STRENGTH = 2.0, 0.1
# Of the gradient of a loss by a tensor against differences, relative to its largest.
SLOPE = 0.01

TOWARDS = np.array([0.5, 0.8, 0.3]) / np.linalg.norm([0.5, 0.8, 0.3])
IRRADIANCE = np.array([3.0, 2.8, 2.4])
START = {"direction": (0.15, 0.85, 0.55), "irradiance": 1.5}  # 25° off
SKY = ws.EnvironmentMap.constant((0.25, 0.3, 0.4), height=32)
CAMERA = ws.Camera.look_at((0.4, 2.0, 2.6), (0, 0.2, 0), fov_y=45, size=(48, 48))
BODIES = (
    ws.Body(ws.plane(4.0, 12), albedo=(0.6, 0.55, 0.5), name="ground"),
    ws.Body(ws.icosphere(0.35, 3), albedo=(0.7, 0.7, 0.7), translation=(0, 0.45, 0), name="ball"),
)
CPU = torch.device("cpu")


def scene_of(light=SKY):
    return ws.Scene(BODIES, light, CAMERA, supersampling=1)


def problem_of(sun, angular_radius=3.0, *free, towards=TOWARDS, **options):
    light = SKY.with_sun(towards, IRRADIANCE, angular_radius=angular_radius)
    still = dataclasses.replace(scene_of(light), visibility=ws.Visibility("ray-traced"))
    return inverse.Problem(scene_of(), [inverse.Target(ws.render(still, progress=False))], [sun, *free], **options)


def degrees_off(direction, towards=TOWARDS):
    cosine = np.dot(direction, towards) / np.linalg.norm(direction) / np.linalg.norm(towards)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def irradiance_by(cells, sun, normal):
    """Irradiance of a surface without blockers by light in cells, RGB."""
    return 4 * np.pi / sun.directions * np.maximum(sun.basis.directions @ normal, 0) @ cells


@pytest.mark.parametrize("angular_radius", [0.27, 3.0])
def test_a_fit_finds_the_direction_and_the_strength_of_a_sun_that_started_25_degrees_off(tmp_path, angular_radius):
    assert 24 < degrees_off(START["direction"]) < 26
    problem = problem_of(inverse.Sun(**START, angular_radius=1.0), angular_radius)
    result = inverse.fit(problem, progress=False)
    assert degrees_off(result.figures["sun.direction"]) < SIDE
    np.testing.assert_allclose(result.figures["sun.irradiance"], IRRADIANCE, rtol=STRENGTH)
    assert result.figures["sun.angular_radius"] == pytest.approx([1.0])  # which 512 cells do not tell
    inverse.write_result(result, tmp_path)
    light = ws.load_scene(tmp_path / "scene.toml").light
    added = np.einsum("rck,r->k", light.radiance - SKY.radiance[0, 0], light.solid_angles())
    np.testing.assert_allclose(added, IRRADIANCE, rtol=STRENGTH)
    assert degrees_off(light.directions().reshape(-1, 3)[light.radiance.sum(axis=-1).argmax()]) < SIDE + 1
    summary = toml_tables.read(tmp_path / "summary.toml", "summary")["figures"]
    assert summary["sun.direction"] == pytest.approx(list(result.figures["sun.direction"]), abs=1e-5)


def test_a_sun_does_not_become_as_wide_as_a_sky():
    """With any size this one ended at 90°, its direction 17° off."""
    towards, start = (0.035, 0.625, 0.78), (0.118, 0.87, 0.48)
    result = inverse.fit(problem_of(inverse.Sun(start, 1.5), towards=towards), progress=False)
    assert degrees_off(result.figures["sun.direction"], towards) < SIDE
    np.testing.assert_allclose(result.figures["sun.irradiance"], IRRADIANCE, rtol=STRENGTH)


def test_a_fit_tells_the_size_of_a_sun_that_is_larger_than_its_cells_resolve():
    result = inverse.fit(problem_of(inverse.Sun(**START), 20.0), progress=False)
    assert result.figures["sun.angular_radius"] == pytest.approx([20.0], rel=0.15)


def test_a_sun_is_found_by_the_scenes_own_method_in_as_many_cells():
    problem = problem_of(inverse.Sun(**START), 3.0, still=None)
    assert problem.visibility.directions == 512 and problem.scene.visibility.directions is None
    assert degrees_off(inverse.fit(problem, progress=False).figures["sun.direction"]) < SIDE


@pytest.mark.parametrize("still", ["ray-traced", "directional"])
def test_gradients_of_the_loss_are_those_of_differences(still):
    problem = problem_of(inverse.Sun(**START, angular_radius=25.0), 3.0, still=ws.Visibility(still))
    context = problem.context(CPU)
    model, values = Model(problem, context, inverse.Stage()), problem.start(context)
    for tensor in values["sun"].values():
        tensor.requires_grad_()
    model.loss(values)[0].backward()
    for tensor in values["sun"].values():
        slopes = []
        for number in range(tensor.numel()):
            losses = []
            for step in (0.002, -0.002):
                with torch.no_grad():
                    tensor.view(-1)[number] += step
                    losses.append(float(model.loss(values)[0]))
                    tensor.view(-1)[number] -= step
            slopes.append((losses[0] - losses[1]) / 0.004)
        assert max(map(abs, slopes)) > 1e-3
        np.testing.assert_allclose(tensor.grad.view(-1), slopes, atol=SLOPE * max(map(abs, slopes)))


def test_its_cells_light_as_the_sun_does_wherever_it_is():
    context = problem_of(inverse.Sun(**START)).context(CPU)
    rng = np.random.default_rng(0)
    for direction in rng.normal(size=(20, 3)):
        sun = inverse.Sun(direction, IRRADIANCE)
        light = sun.coefficients(sun.start(context), context).numpy()
        assert (light >= 0).all()
        direction /= np.linalg.norm(direction)
        mean = light.sum(axis=1) @ sun.basis.directions
        np.testing.assert_allclose(mean / np.linalg.norm(mean), direction, atol=1e-5)
        side = np.cross(direction, (0.3, -0.2, 0.9))
        for normal in (direction, direction + 0.7 * side / np.linalg.norm(side)):
            normal = normal / np.linalg.norm(normal)
            np.testing.assert_allclose(irradiance_by(light, sun, normal), IRRADIANCE * (normal @ direction), rtol=1e-4)


def test_light_that_takes_no_sun_and_suns_that_are_none_are_refused():
    target = inverse.Target(np.zeros((48, 48, 4), np.float32))

    def problem(light, *free):
        return inverse.Problem(scene_of(light), [target], list(free))

    with pytest.raises(ValueError, match="direction: got a zero vector"):
        inverse.Sun((0, 0, 0), 1.0)
    with pytest.raises(ValueError, match="irradiance: got .* expected positive numbers"):
        inverse.Sun((0, 1, 0), (1.0, 0.0, 1.0))
    with pytest.raises(ValueError, match="angular_radius: got 120, expected degrees up to 90"):
        inverse.Sun((0, 1, 0), 1.0, angular_radius=120)
    with pytest.raises(ValueError, match="directions: "):
        inverse.Sun((0, 1, 0), 1.0, directions=0)
    sun = inverse.Sun((0, 1, 0), 1.0)
    with pytest.raises(ValueError, match="radius: got 5, expected a map infinitely far away"):
        problem(ws.EnvironmentMap.constant(0.5, radius=5.0), sun)
    with pytest.raises(ValueError, match="sun: got it for light in spherical harmonics"):
        problem(np.ones((9, 3), np.float32), sun)
    with pytest.raises(ValueError, match="free: got light and sun, expected one of them: free light has any sun in it"):
        problem(SKY, sun, inverse.Light())


def test_a_fit_file_frees_it(tmp_path):
    ws.write_scene(scene_of(), tmp_path)
    ws.write_image(tmp_path / "target.exr", np.zeros((48, 48, 4), np.float32))
    lines = 'scene = "scene.toml"\n[[target]]\nimage = "target.exr"\n[free]\nsun = {}\n'
    (tmp_path / "fit.toml").write_text(
        lines.format("{direction = [0.2, 1, 0], irradiance = [3, 3, 2], directions = 256}")
    )
    (sun,) = inverse.load_fit(tmp_path / "fit.toml").problem.free
    assert sun == inverse.Sun((0.2, 1, 0), (3, 3, 2), directions=256)
    (tmp_path / "fit.toml").write_text(lines.format("true"))
    with pytest.raises(inverse.FitFileError, match="sun.*direction"):
        inverse.load_fit(tmp_path / "fit.toml")
