"""Every demo says what it does; those that are short loops of their own run, at a size at which they take no time."""

import dataclasses
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp

import warpshadow as ws
from demos.benchmarks import gloss, gradients
from demos.benchmarks.benchmark import bunny_scene
from demos.examples import shadow_gradient, warp_loop
from demos.scenes import on_ground

DEMOS = Path(__file__).parents[2] / "demos"
SCRIPTS = [path for path in sorted(DEMOS.glob("*/*.py")) if 'if __name__ == "__main__"' in path.read_text()]
SPHERES = ws.Spheres([(0.2, 0, 0), (-0.2, 0.1, 0), (0, 0.2, 0.2)], [0.3, 0.25, 0.2])


def test_the_pure_warp_loop_finds_the_way_to_a_pose():
    mesh = ws.icosphere(1.0, 2)
    mesh = ws.Mesh(mesh.positions * np.float32([1.0, 0.7, 0.5]), mesh.faces)
    sky = ws.synthetic_sky((-0.75, 0.6, -0.1), sun_radius=5.0, height=32)
    scene = on_ground(mesh, sky, blockers=SPHERES, ground=ws.Body(ws.plane(6.0, 16)))
    scene = ws.Scene(scene.bodies, sky, scene.camera.resized(1 / 16), ws.Visibility(directions=32))
    renderer = ws.Renderer(scene)
    truth = warp_loop.FreePose(renderer, warp_loop.TURN, warp_loop.SHIFT)
    pose = warp_loop.FreePose(renderer)
    angle, distance = pose.errors(truth)
    assert angle == pytest.approx(15, rel=1e-4)
    assert distance == pytest.approx(0.2, rel=1e-4)
    losses = list(warp_loop.recover(pose, wp.clone(truth.draw(), requires_grad=False), 12))
    assert len(losses) == 12
    assert losses[-1] < 0.3 * losses[0]
    closer_angle, closer_distance = pose.errors(truth)
    assert closer_angle < 0.7 * angle
    assert closer_distance < 0.7 * distance


@pytest.mark.slow
def test_a_shadow_seen_alone_has_the_derivatives_of_central_differences():
    shadow = shadow_gradient.Shadow(SPHERES, 12)
    assert set(np.unique(shadow.renderer.array_renderer.body_ids())) == {1}
    got, expected = shadow_gradient.by_adjoint(shadow), shadow_gradient.by_differences(shadow)
    assert (torch.linalg.norm(expected, dim=(0, 1)) > 1).all()
    assert (shadow_gradient.relative_errors(got, expected) < 1e-2).all()


def test_a_shadow_seen_alone_tells_the_way_of_what_casts_it():
    shadow = shadow_gradient.Shadow(SPHERES, 12)
    assert (shadow_gradient.cosines(shadow, torch.arange(4) * torch.pi / 2) > 0.9).all()


def test_a_small_image_has_the_gradient_of_its_differences():
    """At a size at which fits begin faces are smaller than samples; by the slopes of single ones the error is 16%."""
    scene = dataclasses.replace(bunny_scene(), visibility=ws.Visibility("none"))
    renderer = gradients.renderer_of(scene, 64, 2)
    got, expected = (of(renderer, gradients.pose_image, 5) for of in (gradients.gradients, gradients.differences))
    assert gradients.relative_error(got, expected) < 0.08


@pytest.mark.slow
def test_the_gloss_of_an_image_is_found():
    ball = ws.Body(ws.icosphere(1.0, 3), albedo=(0.9, 0.65, 0.35), roughness=0.3, metallic=1.0).on_ground(size=2)
    camera = ws.Camera.framing(ball, direction=(-0.4, 0.5, 1), size=24)
    scene = ws.Scene([ball, ws.Body(ws.plane(8.0, 8))], ws.synthetic_sky(sun_radius=8, height=32), camera)
    assert gloss.find_gloss(scene, ws.render(scene)) == pytest.approx((0.3, 1.0), abs=0.03)


def test_the_pictures_of_the_demos_are_drawn(tmp_path):
    image = wp.full((1, 4, 4), wp.vec4(0.2, 0.4, 0.6, 1.0), dtype=wp.vec4)
    warp_loop.plot({"target": image, "start": image}, tmp_path / "loop.png")
    derivatives = np.linspace(-1, 1, 16).reshape(4, 4)
    shadow_gradient.plot(image.numpy()[0], derivatives, 0.9 * derivatives, tmp_path / "gradient.png")
    for name in ("loop.png", "gradient.png"):
        assert np.ptp(ws.read_image(tmp_path / name)[..., :3]) > 0.1


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_every_demo_says_what_it_does_and_takes(script, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", [str(script), "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(script), run_name="__main__")
    assert ended.value.code == 0
    printed = capsys.readouterr().out
    assert f"demos/{script.parent.name}/{script.name}" in printed  # the docstring, which has the command


@pytest.mark.slow
@pytest.mark.parametrize("folder", ["examples", "benchmarks", "tools"])
def test_a_demo_starts_by_its_path_from_any_folder(folder, tmp_path):
    script = next(path for path in SCRIPTS if path.parent.name == folder)
    subprocess.run([sys.executable, script, "--help"], check=True, cwd=tmp_path, stdout=subprocess.DEVNULL)
