"""Captured iterations: replays compute what calls do, on inputs that changed since. Captures are of the CPU's."""

import dataclasses

import numpy as np
import pytest
import warp as wp

import warpshadow as ws
from demos.examples import warp_loop
from warpshadow.assets.basis import CellBasis
from warpshadow.device import cuda_graph
from warpshadow.device.cuda_graph import Captured, with_gradients
from warpshadow.maths.directions import fibonacci
from warpshadow.pipeline import view as view_module

SPHERES = ws.Spheres([(0.2, 0, 0), (-0.2, 0.1, 0), (0, 0.2, 0.2)], [0.3, 0.25, 0.2])


@pytest.fixture
def captures(monkeypatch):
    """Capture on a CPU, too, where that is of no use but works."""
    monkeypatch.setattr(cuda_graph, "is_captured", lambda device: True)


@wp.kernel
def _sum_cubes(
    # in
    values: wp.array(dtype=float),
    # out
    total: wp.array(dtype=float),
):
    """A thread owns a number."""
    value = values[wp.tid()]
    wp.atomic_add(total, 0, value * value * value)


def sum_cubes(values):
    total = wp.zeros(1, dtype=float, device=values.device, requires_grad=True)
    wp.launch(_sum_cubes, dim=values.size, inputs=[values], outputs=[total], device=values.device)
    return total


@pytest.mark.usefixtures("captures")
def test_replays_follow_the_inputs_forward_and_backward(device):
    values = wp.array([1.0, 2.0], dtype=float, device=device, requires_grad=True)
    step = Captured(with_gradients(lambda: sum_cubes(values), [values]), device)
    for numbers in ([1.0, 2.0], [3.0, -1.0], [0.5, 0.0], [-2.0, 4.0]):
        values.assign(numbers)
        loss = step()
        assert loss.numpy()[0] == pytest.approx(np.power(numbers, 3).sum())
        assert values.grad.numpy() == pytest.approx(3 * np.square(numbers))


@pytest.mark.usefixtures("captures")
def test_each_call_runs_once_be_it_plain_captured_or_replayed(device):
    total = wp.zeros(1, dtype=float, device=device)
    ones = wp.ones(3, dtype=float, device=device)
    python_calls = []

    def add():
        python_calls.append(bool(wp.get_device(device).is_capturing))
        wp.launch(_sum_cubes, dim=3, inputs=[ones], outputs=[total], device=device)

    step = Captured(add, device)
    for calls in range(1, 6):
        step()
        assert total.numpy()[0] == 3 * calls
    assert python_calls == [False, True]


@pytest.mark.usefixtures("captures")
def test_a_capture_that_fails_ends_and_is_tried_again(device):
    ones = wp.ones(3, dtype=float, device=device)
    fails = [False, True, False]

    def add():
        if fails.pop(0):
            raise ValueError("no")
        return sum_cubes(ones)

    step = Captured(add, device)
    step()
    with pytest.raises(ValueError, match="no"):
        step()
    assert not wp.get_device(device).is_capturing
    assert step().numpy()[0] == 3
    assert step().numpy()[0] == 3
    assert fails == []


def test_on_a_cpu_calls_are_plain():
    ones = wp.ones(3, dtype=float, device="cpu")
    states = []

    def add():
        states.append(ones.device.is_capturing)
        return sum_cubes(ones)

    step = Captured(add, "cpu")
    results = [step() for _ in range(3)]
    assert states == [False] * 3
    assert len({result.ptr for result in results}) == 3


@pytest.fixture
def scene():
    """A ball with known spheres on a ground, 24 × 24 pixels."""
    ball = ws.Body(ws.icosphere(0.5, 2), blockers=SPHERES, translation=(0, 0.5, 0))
    camera = ws.Camera.look_at((0, 2, 3), (0, 0.3, 0), size=(24, 24))
    sky = ws.synthetic_sky(height=32)
    return ws.Scene((ball, ws.Body(ws.plane(4, 8))), sky, camera, ws.Visibility(directions=32))


def squared_difference(image, target):
    loss = wp.zeros(1, dtype=float, device=image.device, requires_grad=True)
    inputs = [image.flatten(), target]
    wp.launch(warp_loop._sum_squared_differences, dim=target.size, inputs=inputs, outputs=[loss], device=image.device)
    return loss


@pytest.mark.usefixtures("captures")
@pytest.mark.parametrize(
    ("method", "receivers", "bounces"),
    [
        ("directional", "vertex", 0),
        ("directional", "vertex", 2),
        ("log-sh", "vertex", 0),
        ("log-sh", "vertex", 2),
        ("none", "vertex", 0),
        ("none", "pixel", 0),
    ],
)
def test_a_captured_pose_fit_has_the_loss_and_gradient_of_a_plain_one(
    method, receivers, bounces, scene, device, monkeypatch
):
    """As on a GPU, all vertices are receivers."""
    monkeypatch.setattr(view_module, "is_readable", lambda device: False)  # as on a GPU
    visibility = ws.Visibility.of({"method": method, "directions": 32, "order": 3})
    bodies = [dataclasses.replace(body, receivers=receivers) for body in scene.bodies]
    scene = ws.Scene(bodies, scene.light, scene.camera, visibility, bounces=bounces)
    pose = warp_loop.FreePose(ws.Renderer(scene, device=device))
    target = wp.clone(pose.draw(), requires_grad=False).flatten()
    evaluate = with_gradients(lambda: squared_difference(pose.draw(), target), [pose.turn, pose.translation])
    step = Captured(evaluate, device)
    for shift in ((0.0, 0.5, 0.0), (0.1, 0.5, 0.0), (-0.2, 0.6, 0.1), (0.3, 0.4, -0.2)):
        pose.turn.assign([np.multiply(shift, 2)])
        pose.translation.assign([shift])
        expected = [evaluate().numpy()[0], *(array.grad.numpy().copy() for array in (pose.turn, pose.translation))]
        got = [step().numpy()[0], pose.turn.grad.numpy(), pose.translation.grad.numpy()]
        for one, other in zip(got, expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5 * np.abs(expected[2]).max())
    assert np.abs(expected[1]).max() > 0.01
    assert np.abs(expected[2]).max() > 0.1


@pytest.mark.slow
@pytest.mark.usefixtures("captures")
@pytest.mark.parametrize(
    ("method", "bounces"), [("directional", 0), ("directional", 2), ("log-sh", 0), ("log-sh", 2), ("none", 0)]
)
def test_nothing_is_copied_from_the_host_while_a_pose_fit_is_captured(method, bounces, scene, monkeypatch):
    """A graph would copy from memory that the host has long given to others."""
    monkeypatch.setattr(view_module, "is_readable", lambda device: False)  # as on a GPU
    ground = ws.Body(ws.plane(4, 8), texture=np.full((4, 4, 3), 0.5))
    visibility = ws.Visibility.of({"method": method, "directions": 32, "order": 3})
    scene = ws.Scene((scene.bodies[0], ground), scene.light, scene.camera, visibility, bounces=bounces)
    pose = warp_loop.FreePose(ws.Renderer(scene, device="cpu"))
    target = wp.zeros(24 * 24, dtype=wp.vec4, device="cpu")
    evaluate = with_gradients(lambda: squared_difference(pose.draw(), target), [pose.turn, pose.translation])
    copied = []
    from_host = wp.array._init_from_data

    def watched(*arguments, **options):
        copied.append(target.device.is_capturing)
        return from_host(*arguments, **options)

    monkeypatch.setattr(wp.array, "_init_from_data", watched)
    step = Captured(evaluate, "cpu")
    step()
    assert copied  # by the first call
    step()
    assert not any(copied)


@pytest.mark.usefixtures("captures")
@pytest.mark.parametrize("bounces", [0, 2])
@pytest.mark.parametrize("method", ["directional", "ray-traced"])
def test_a_captured_fit_of_light_and_texture_has_the_gradients_of_a_plain_one(method, bounces, scene, device):
    visibility = ws.Visibility.of({"method": method, "directions": 32, "samples": 64})
    basis = CellBasis(fibonacci(32))
    scene = ws.Scene(scene.bodies, scene.light, scene.camera, visibility, bounces=bounces)
    still = ws.Renderer(scene, basis=basis, device=device)
    free = [
        wp.array(np.full((1, 32, 3), 0.7), dtype=wp.vec3, device=device, requires_grad=True),
        wp.array(np.full((1, 8, 8, 3), 0.5), dtype=wp.vec3, device=device, requires_grad=True),
    ]
    target = wp.zeros(24 * 24, dtype=wp.vec4, device=device)

    def draw():
        return still.draw(free[0], textures=[None, free[1]])

    evaluate = with_gradients(lambda: squared_difference(draw(), target), free)
    step = Captured(evaluate, device)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        for array in free:
            array.assign(rng.uniform(size=(*array.shape, 3)).astype(np.float32))
        expected = [evaluate().numpy()[0], *(array.grad.numpy().copy() for array in free)]
        for one, other in zip([step().numpy()[0], *(array.grad.numpy() for array in free)], expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4)
    assert all(np.abs(gradient).max() > 0.1 for gradient in expected[1:])
