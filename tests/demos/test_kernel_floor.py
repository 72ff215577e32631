"""The floor under an iteration's time: its arithmetic, what visibility needs, and that no launch is forgotten."""

import numpy as np
import pytest
import warp as wp

import warpshadow as ws
from demos.examples import warp_loop
from demos.tools import kernel_floor
from demos.tools.kernel_floor import Size, Work
from warpshadow.device.cuda_graph import with_gradients
from warpshadow.maths.directions import fibonacci
from warpshadow.pipeline.views import receiver_finder

SIZE = Size(vertices=1000, faces=1900, spheres=20, directions=64, samples=4096)


def test_a_stage_takes_its_operations_or_its_bytes_and_its_launches():
    assert kernel_floor.floor(Work(67e6, 1, 0), 1000) == pytest.approx(1e-3)
    assert kernel_floor.floor(Work(1, 4.8e6, 0), 1000) == pytest.approx(1e-3)
    assert kernel_floor.floor(Work(1, 1, 5), 1) == pytest.approx(15e-6, rel=1e-3)


def test_the_floor_grows_with_what_is_needed_and_less_than_in_proportion_to_the_batch():
    each = kernel_floor.stages(SIZE, 0.5, 0.1)
    one, hundred = (kernel_floor.iteration_floor(each, SIZE, count) for count in (1, 100))
    assert one < hundred < 100 * one
    assert kernel_floor.iteration_floor(kernel_floor.stages(SIZE, 1.0, 1.0), SIZE, 100) > hundred
    assert {stage.item for stage in each} <= set(kernel_floor.counts(SIZE))


def test_a_sphere_below_the_horizon_is_not_needed_and_one_around_the_receiver_for_all_directions_above_it():
    up, origin = np.array([[0.0, 1.0, 0.0]]), np.zeros((1, 3))
    directions = fibonacci(128)
    below = kernel_floor.needed(origin, up, np.array([[0, -5.0, 0]]), np.array([1.0]), directions, 0.05)
    assert below == (0, 0)
    tangent = np.array([[1e-9, 0, 0]])
    rising, reached = kernel_floor.needed(origin, up, tangent, np.ones(1), directions, np.pi / 2)
    assert (rising, reached) == (1, 0.5)


def test_a_sphere_overhead_is_needed_for_the_directions_in_its_soft_cone():
    directions, width = fibonacci(4096), 0.1
    distance = np.array([[0.0, 2.0, 0.0]])
    rising, reached = kernel_floor.needed(np.zeros((1, 3)), distance / 2, distance, np.ones(1), directions, width)
    assert rising == 1
    assert reached == pytest.approx(0.5 * (1 - np.cos(np.pi / 6 + width)), rel=0.01)
    two = np.concatenate([distance, -distance])
    parts = kernel_floor.needed(np.zeros((1, 3)), distance / 2, two, np.ones(2), directions, width)
    assert parts == pytest.approx((0.5, reached / 2))


def test_the_table_and_the_floors_are_printed(monkeypatch, capsys):
    monkeypatch.setattr(kernel_floor, "bunny_scene", lambda: None)
    monkeypatch.setattr(kernel_floor, "measure", lambda scene: (SIZE, 0.5, 0.1))
    kernel_floor.main([1, 7])
    printed = capsys.readouterr().out
    assert "1000 receivers" in printed
    assert "| µs, 1 pose | µs, 7 poses |" in printed
    assert printed.count("ms at the least") == 2


def test_the_scene_is_measured():
    ball = ws.Body(ws.icosphere(0.5, 1), blockers=ws.Spheres([[0, 0, 0]], [0.5]), translation=(0, 0.5, 0))
    camera = ws.Camera.look_at((0, 2, 3), (0, 0.3, 0), size=(8, 6))
    scene = ws.Scene((ball, ws.Body(ws.plane(4, 4), blockers=0)), ws.synthetic_sky(height=16), camera)
    size, rising, reached = kernel_floor.measure(scene)
    assert size == Size(42 + 25, 80 + 32, 1, 128, 48, open_faces=32)
    assert 0 < reached < rising <= 1


def test_the_launches_of_the_stages_are_those_of_a_captured_pose_iteration(monkeypatch):
    """Captured on the CPU, whose graphs count what they hold; all vertices are receivers, as on a GPU."""
    monkeypatch.setattr(receiver_finder, "is_readable", lambda device: False)  # as on a GPU
    spheres = ws.Spheres([[0, 0, 0]], [0.5])
    ball = ws.Body(ws.icosphere(0.5, 1), blockers=spheres, translation=(0, 0.5, 0), receivers="vertex")
    camera = ws.Camera.look_at((0, 2, 3), (0, 0.3, 0), size=(8, 8))
    by_spheres = ws.Visibility(self_shadows="spheres")
    ground = ws.Body(ws.plane(4, 4), blockers=0, receivers="vertex")  # the floor knows of no planes that block light
    scene = ws.Scene((ball, ground), ws.synthetic_sky(height=16), camera, by_spheres, supersampling=1)
    pose = warp_loop.FreePose(ws.Renderer(scene))
    target = wp.zeros(64, dtype=wp.vec4)

    def loss():
        total = wp.zeros(1, dtype=float, requires_grad=True)
        inputs = [pose.draw().flatten(), target]
        wp.launch(warp_loop._sum_squared_differences, dim=64, inputs=inputs, outputs=[total])
        return total

    evaluate = with_gradients(loss, [pose.turn, pose.translation])
    evaluate()
    with wp.ScopedCapture(device="cpu") as capture:
        evaluate()
    each = filter(kernel_floor.is_of_pose_iteration, kernel_floor.stages(SIZE, 1.0, 1.0))
    counted = sum(stage.forward.launches + stage.backward.launches for stage in each)
    assert counted == pytest.approx(capture.graph._apic_capture.operation_count, rel=0.15)
