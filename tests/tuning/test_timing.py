"""Times of images: measured in turns, nothing kept, and extrapolated from a sample."""

import dataclasses
import time

import numpy as np
import pytest
from test_point_sample import make_scene

import warpshadow as ws
from warpshadow.pipeline.bodies import self_visibility
from warpshadow.pipeline.renderer import SceneRenderer
from warpshadow.tuning import timing
from warpshadow.tuning.timing import image_times, median_times, whole_image


def test_functions_are_timed_in_turns_and_the_first_call_of_each_turn_is_not():
    calls = []
    times = median_times([lambda: calls.append("a"), lambda: calls.append("b")], 2)
    assert calls == ["a", "a", "b", "b"] * 2
    assert len(times) == 2 and min(times) >= 0


def test_a_slow_first_call_does_not_count():
    waits = iter([0.3, 0, 0.3, 0, 0.3, 0])
    (median,) = median_times([lambda: time.sleep(next(waits))], 3)
    assert median < 200


def test_each_image_is_of_bodies_that_have_moved_by_nothing_to_speak_of(monkeypatch):
    scene = make_scene()
    placed, geometries = ws.Renderer.placed, []

    def noted(renderer, poses=None, rest=None, **options):
        geometry = placed(renderer, poses, rest, **options)
        geometries.extend([geometry] * (poses is not None))  # or the bodies are where the scene has them
        return geometry

    monkeypatch.setattr(ws.Renderer, "placed", noted)
    draw = whole_image(ws.Renderer(scene))
    images = [draw().numpy()[0].copy() for _ in range(3)]
    first, second, third = (geometry.positions.numpy() for geometry in geometries)
    assert 0 < np.abs(second - first).max() < 1e-3
    np.testing.assert_array_equal(third, first)
    truth = ws.Renderer(scene).render()
    for image in images:
        assert np.linalg.norm(image - truth) < 1e-2 * np.linalg.norm(truth)


def test_nothing_of_an_image_is_kept_for_the_next(monkeypatch):
    from warpshadow.stages.visibility import directional

    transmittance, calls = directional.transmittance, []
    monkeypatch.setattr(
        directional, "transmittance", lambda *given, **options: calls.append(1) or transmittance(*given, **options)
    )
    draw = whole_image(ws.Renderer(make_scene()))
    counts = []
    for _ in range(3):
        draw()
        counts.append(len(calls))
    assert counts[0] >= 1 and np.diff(counts).min() >= 1


def test_what_shadows_add_on_a_sample_is_extrapolated_to_all_receivers(monkeypatch):
    """With a clock by which shadows take 3 ms a receiver, shading takes 1 and a whole image without shadows 1000."""
    monkeypatch.setattr(timing, "TIMED_RECEIVERS", 128)
    scene = dataclasses.replace(make_scene(), camera=make_scene().camera.resized(4))
    unshadowed = dataclasses.replace(scene, visibility=ws.Visibility(method="none"))
    count = ws.Renderer(scene).view().receivers.points.shape[1]
    assert count > 2 * 128
    clock = []

    def shade(self, light=None, view=None):
        receivers = view.receivers.points.shape[1]
        clock.append(receivers * (1.0 if self.scene.visibility.method == "none" else 4.0))

    monkeypatch.setattr(SceneRenderer, "shade", shade)
    monkeypatch.setattr(SceneRenderer, "draw", lambda self, view: clock.append(1000.0))
    monkeypatch.setattr(
        timing, "median_times", lambda functions, runs, **_: [(function(), clock[-1])[1] for function in functions]
    )
    assert image_times([scene, unshadowed]) == pytest.approx([1000 + 3 * count, 1000])


def test_bodies_shadows_on_themselves_are_timed(monkeypatch):
    gather, bodies = self_visibility.gather_self_transmittance, []
    monkeypatch.setattr(self_visibility, "gather_self_transmittance", lambda *given: bodies.append(1) or gather(*given))
    monkeypatch.setattr(
        timing, "median_times", lambda functions, runs, **_: [function() and 1.0 for function in functions]
    )
    scene = make_scene()
    image_times([scene])
    assert len(bodies) == 1
    receivers = dataclasses.replace(
        scene, bodies=[dataclasses.replace(body, receivers="pixel") for body in scene.bodies]
    )
    image_times([receivers])
    assert len(bodies) == 2
