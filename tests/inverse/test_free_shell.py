"""A free shell: how far away a window is, from one image of bodies on a table."""

import dataclasses

import numpy as np
import pytest
import torch
import trimesh

import warpshadow as ws
from warpshadow import inverse
from warpshadow.inverse.model import Model
from warpshadow.inverse.report import found_values
from warpshadow.maths.sh import equirectangular_directions
from warpshadow.scene import toml_tables

# Relative error of the radius that a fit finds, and degrees of the window's direction. Measured 1% and 3°.
RADIUS, SIDE = 0.1, 8.0
# Relative, of the gradient of a loss by the radius against differences. Measured 1e-3.
SLOPE = 0.01

CENTER = (0.0, 0.3, 0.0)
TOWARDS = np.array([-1.0, 0.6, 0.35]) / np.linalg.norm([-1.0, 0.6, 0.35])
CAMERA = ws.Camera.look_at((0.6, 1.6, 2.2), (0, 0.2, 0), fov_y=45, size=(48, 48))
BODIES = (
    ws.Body(ws.plane(2.4, 12), albedo=(0.6, 0.55, 0.5), name="table"),
    ws.Body(ws.icosphere(0.3, 3), albedo=(0.7, 0.7, 0.7), translation=(-0.1, 0.3, 0), name="ball"),
    ws.Body(
        ws.load_mesh(trimesh.creation.box((0.12, 0.7, 0.12))).creased(), translation=(0.55, 0.35, -0.3), name="post"
    ),
)


def window(radius):
    """A map that is bright in a square, as the center of its shell sees it."""
    directions = equirectangular_directions(32)
    across = np.cross((0, 1, 0), TOWARDS)
    across /= np.linalg.norm(across)
    depth, right, up = (directions @ axis for axis in (TOWARDS, across, np.cross(TOWARDS, across)))
    is_window = (depth > 0) & (np.maximum(np.abs(right), np.abs(up)) < 0.25 * depth)
    return ws.EnvironmentMap(np.where(is_window[..., None], 12.0, (0.15, 0.15, 0.2)), radius=radius, center=CENTER)


def scene_of(light):
    return ws.Scene(BODIES, light, CAMERA, supersampling=1)


def problem_of(light, target_light, *free):
    target = inverse.Target(ws.Renderer(scene_of(target_light), progress=False).render())
    return inverse.Problem(scene_of(light), [target], list(free))


DIM = ws.EnvironmentMap.constant(0.5, radius=5.0, center=CENTER)


@pytest.mark.slow
def test_a_fit_finds_the_side_and_the_distance_of_a_window(tmp_path):
    problem = problem_of(DIM, window(2.0), inverse.Shell(), inverse.Light(directions=128))
    stages = [inverse.Stage(30, 0.05, solves_light=True), inverse.Stage(10, 0.02, solves_light=True)]
    result = inverse.fit(problem, stages, progress=False)
    light = result.scene.light
    assert light.radius == pytest.approx(2.0, rel=RADIUS)
    np.testing.assert_allclose(light.center, CENTER, atol=1e-6)
    brightness = light.radiance.sum(axis=-1)
    middle = equirectangular_directions(len(brightness))[brightness > 0.5 * brightness.max()].mean(axis=0)
    assert np.degrees(np.arccos(middle @ TOWARDS / np.linalg.norm(middle))) < SIDE
    assert result.figures["light.radius"] == pytest.approx([light.radius])
    inverse.write_result(result, tmp_path)
    again = ws.load_scene(tmp_path / "scene.toml").light
    assert again.radius == pytest.approx(light.radius) and np.allclose(again.center, CENTER)


def test_the_radius_that_a_fit_finds_is_in_its_summary_and_said_after_few_steps(tmp_path):
    """Its last steps are below the rounding of the loss; they went on for all 200 iterations."""
    result = inverse.fit(problem_of(window(4.0), window(2.0), inverse.Shell()), progress=False)
    assert result.reason == "converged" and sum(map(len, result.losses)) < 40
    inverse.write_result(result, tmp_path)
    radius = result.scene.light.radius
    summary = toml_tables.read(tmp_path / "summary.toml", "summary")
    assert summary["figures"] == {"light.radius": pytest.approx(radius)} and radius == pytest.approx(2.0, rel=RADIUS)
    assert f"light radius  {radius:.4g} scene units" in found_values(result)


def test_light_that_a_fit_finds_keeps_its_radius():
    problem = problem_of(DIM, window(5.0), inverse.Light(directions=64))
    light = inverse.fit(problem, [inverse.Stage(2)], progress=False).scene.light
    assert light.radius == 5.0 and np.allclose(light.center, CENTER)


def test_the_gradient_of_a_loss_is_that_of_differences():
    problem = problem_of(window(4.0), window(2.0), inverse.Shell())
    model = Model(problem, problem.context(torch.device("cpu")), inverse.Stage())

    def loss(gap):
        return model.loss({"shell": {"log_gap": gap}})[0]

    gap = torch.tensor(0.05, requires_grad=True)
    loss(gap).backward()
    with torch.no_grad():
        sides = [float(loss(torch.tensor(0.05 + sign * 2e-3))) for sign in (1, -1)]
    assert float(gap.grad) == pytest.approx((sides[0] - sides[1]) / 4e-3, rel=SLOPE)


def test_bodies_stay_within_the_shell():
    problem = problem_of(DIM, window(2.0), inverse.Shell())
    shell = inverse.Shell().shell({"log_gap": torch.tensor(-50.0)}, problem.context(torch.device("cpu")))
    farthest = max(np.linalg.norm(body.world_points() - CENTER, axis=1).max() for body in BODIES)
    assert farthest < float(shell[3]) < 1.05 * farthest


def test_light_without_a_radius_and_coefficients_with_one_are_refused():
    target = inverse.Target(np.zeros((48, 48, 4), np.float32))
    with pytest.raises(ValueError, match="shell: got it for a scene whose light is infinitely far away"):
        inverse.Problem(scene_of(ws.EnvironmentMap.constant()), [target], [inverse.Shell()])
    with pytest.raises(ValueError, match="order: got 5 for light that has a radius, expected cells"):
        inverse.Problem(scene_of(DIM), [target], [inverse.Light()])


def test_a_fit_file_frees_it(tmp_path):
    ws.write_scene(dataclasses.replace(scene_of(DIM)), tmp_path)
    ws.write_image(tmp_path / "target.exr", np.zeros((48, 48, 4), np.float32))
    lines = 'scene = "scene.toml"\n[[target]]\nimage = "target.exr"\n[free]\nshell = true\nlight = {directions = 64}\n'
    (tmp_path / "fit.toml").write_text(lines)
    problem = inverse.load_fit(tmp_path / "fit.toml").problem
    assert [free.name for free in problem.free] == ["light", "shell"]
