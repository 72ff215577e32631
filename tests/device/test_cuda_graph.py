"""Captured iterations: replays compute what calls do, on inputs that changed since. Captures are of the CPU's."""

import contextlib
import dataclasses
import gc
import sys
import weakref

import numpy as np
import pytest
import warp as wp

import warpshadow as ws
from demos.examples import warp_loop
from warpshadow.assets.basis import CellBasis
from warpshadow.device import cuda_graph, memory
from warpshadow.device.batch import concatenate
from warpshadow.device.constants import collecting_constants
from warpshadow.device.cuda_graph import Captured, with_gradients
from warpshadow.maths.directions import fibonacci
from warpshadow.pipeline import node
from warpshadow.pipeline.receivers import scene_receivers
from warpshadow.pipeline.views import receiver_finder
from warpshadow.stages import Poses
from warpshadow.stages.textures.pyramid import mip_pyramids

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
def test_a_capture_that_fails_ends_and_is_tried_again_after_a_plain_call(device):
    """The plain call fills the caches that the capture found empty."""
    ones = wp.ones(3, dtype=float, device=device)
    fails, is_captured = [False, True, False, False], []

    def add():
        is_captured.append(bool(wp.get_device(device).is_capturing))
        if fails.pop(0):
            raise ValueError("no")
        return sum_cubes(ones)

    step = Captured(add, device)
    step()
    with pytest.raises(ValueError, match="no"):
        step()
    assert not wp.get_device(device).is_capturing
    for _ in range(3):
        assert step().numpy()[0] == 3
    assert is_captured == [False, True, False, True]


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
    monkeypatch.setattr(receiver_finder, "is_readable", lambda device: False)  # as on a GPU
    visibility = ws.Visibility.of({"method": method, "directions": 32, "order": 4})
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


def replace_everywhere(monkeypatch, old, new):
    """Replace a function in all modules of the package that have it."""
    for name, module in list(sys.modules.items()):
        if name.startswith("warpshadow") and getattr(module, old.__name__, None) is old:
            monkeypatch.setattr(module, old.__name__, new)


@pytest.fixture
def accesses(monkeypatch):
    """Copies from the host and to it, True for those while a graph is captured; nothing else can be read, as on a GPU.

    A CPU allows them in a capture. A GPU refuses to read back, and copies at each replay from memory that the host has
    long given to others.
    """
    result = {"from the host": [], "to the host": []}

    def watched(direction, function):
        def access(*arguments, **options):
            result[direction].append(wp.get_device("cpu").is_capturing)
            return function(*arguments, **options)

        return access

    monkeypatch.setattr(wp.array, "_init_from_data", watched("from the host", wp.array._init_from_data))
    monkeypatch.setattr(wp.array, "numpy", watched("to the host", wp.array.numpy))
    replace_everywhere(monkeypatch, memory.from_numpy, watched("from the host", memory.from_numpy))
    replace_everywhere(monkeypatch, cuda_graph.is_readable, lambda device: False)
    monkeypatch.setattr(cuda_graph, "refusing_unrecorded", contextlib.nullcontext)  # a GPU's graph can refit meshes
    return result


def assert_only_plain_calls_copy(evaluate, accesses):
    step = Captured(evaluate, "cpu")
    step()
    assert accesses["from the host"]  # by the first call
    for direction in accesses.values():
        direction.clear()
    step()
    assert not any(accesses["from the host"])
    assert not any(accesses["to the host"])


class MovingBall(warp_loop.FreePose):
    """A free pose of the first body, drawn with options; the others are named as static where it alone moves."""

    def __init__(self, scene, device, *, pivot=None, moving=None, **options):
        super().__init__(ws.Renderer(scene, device=device))
        self.pivot, self.moving, self.options = pivot, moving, options

    def draw(self):
        fixed = self.renderer.scene_poses(pivot=self.pivot)
        counts = [1, fixed.scales.shape[1] - 1]
        poses = Poses(
            concatenate([self.rotation(), fixed.rotations[:, 1:]], counts),
            concatenate([self.translation.reshape((1, 1)), fixed.translations[:, 1:]], counts),
            fixed.scales,
        )
        geometry = self.renderer.placed(poses, pivot=self.pivot, moving=self.moving)
        return self.renderer.draw(view=self.renderer.view(geometry), **self.options)

    def loss_with_gradients(self, target):
        return with_gradients(lambda: squared_difference(self.draw(), target), [self.turn, self.translation])


def beside_static_bodies(scene, method="directional"):
    """The ball over a ground that receives at vertices, where results about static bodies are cached."""
    ground = dataclasses.replace(scene.bodies[1], receivers="vertex")
    visibility = ws.Visibility.of({"method": method, "directions": 32, "order": 4})
    return ws.Scene((scene.bodies[0], ground), scene.light, scene.camera, visibility)


@pytest.mark.slow
@pytest.mark.usefixtures("captures")
@pytest.mark.parametrize(
    ("method", "bounces"), [("directional", 0), ("directional", 2), ("log-sh", 0), ("log-sh", 2), ("none", 0)]
)
@pytest.mark.parametrize("options", [{}, {"pivot": "center", "light": ws.synthetic_sky((0.5, 0.6, 0.2), height=32)}])
@pytest.mark.parametrize("is_glossy", [False, True])
def test_nothing_is_copied_from_the_host_while_a_pose_fit_is_captured(
    method, bounces, is_glossy, options, scene, accesses
):
    """What a graph would have copied at its replays, only a GPU can show."""
    if is_glossy and method == "log-sh":
        pytest.skip("the method does not show gloss")
    gloss = {"roughness": 0.4, "metallic": 0.3} if is_glossy else {}
    textured = {"roughness": np.full((4, 4), 0.5)} if is_glossy else {}
    ground = ws.Body(ws.plane(4, 8), texture=np.full((4, 4, 3), 0.5), **textured)
    ball = dataclasses.replace(scene.bodies[0], **gloss)
    visibility = ws.Visibility.of({"method": method, "directions": 32, "order": 4})
    scene = ws.Scene((ball, ground), scene.light, scene.camera, visibility, bounces=bounces)
    target = wp.zeros(24 * 24, dtype=wp.vec4, device="cpu")
    assert_only_plain_calls_copy(MovingBall(scene, "cpu", **options).loss_with_gradients(target), accesses)


@pytest.mark.slow
@pytest.mark.usefixtures("captures")
def test_bodies_that_shine_by_pixel_are_captured(scene, accesses):
    """A graph has room for a receiver at each sample: there are other numbers of them than in plain calls."""
    ball = dataclasses.replace(scene.bodies[0], roughness=0.4, receivers="pixel")
    scene = ws.Scene((ball, scene.bodies[1]), scene.light, scene.camera, scene.visibility)
    target = wp.zeros(24 * 24, dtype=wp.vec4, device="cpu")
    assert_only_plain_calls_copy(MovingBall(scene, "cpu").loss_with_gradients(target), accesses)


@pytest.mark.usefixtures("captures")
@pytest.mark.parametrize(
    "method",
    ["directional", pytest.param("log-sh", marks=pytest.mark.slow), pytest.param("none", marks=pytest.mark.slow)],
)
def test_nothing_is_copied_while_a_fit_beside_static_bodies_is_captured(method, scene, accesses):
    """Their receivers are the same in plain calls and in graphs, those on backs too: results are cached for them."""
    scene = beside_static_bodies(scene, method)
    target = wp.zeros(24 * 24, dtype=wp.vec4, device="cpu")
    assert_only_plain_calls_copy(MovingBall(scene, "cpu", moving=[0]).loss_with_gradients(target), accesses)


@pytest.mark.usefixtures("captures")
@pytest.mark.parametrize(
    "method",
    ["directional", pytest.param("log-sh", marks=pytest.mark.slow), pytest.param("none", marks=pytest.mark.slow)],
)
def test_a_captured_fit_beside_static_bodies_has_the_loss_and_gradient_of_a_plain_one(
    method, scene, device, monkeypatch
):
    replace_everywhere(monkeypatch, cuda_graph.is_readable, lambda device: False)  # as on a GPU
    scene = beside_static_bodies(scene, method)
    ball, every = MovingBall(scene, device, moving=[0]), MovingBall(scene, device)
    target = wp.clone(ball.draw(), requires_grad=False).flatten()
    np.testing.assert_allclose(target.numpy(), every.draw().flatten().numpy(), atol=0.1)  # its shadows are by rays
    evaluate = ball.loss_with_gradients(target)
    step = Captured(evaluate, device)
    numbered = []
    for shift in ((0.0, 0.5, 0.0), (0.1, 0.5, 0.0), (-0.2, 0.6, 0.1), (0.3, 0.4, -0.2)):
        ball.turn.assign([np.multiply(shift, 2)])
        ball.translation.assign([shift])
        expected = [evaluate().numpy()[0], *(array.grad.numpy().copy() for array in (ball.turn, ball.translation))]
        monkeypatch.setattr(scene_receivers, "number_receivers", numbered.append)  # no more than once
        got = [step().numpy()[0], ball.turn.grad.numpy(), ball.translation.grad.numpy()]
        for one, other in zip(got, expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5 * np.abs(expected[2]).max())
    assert np.abs(expected[2]).max() > 0.1


# ---------------------------------------------------------------------------------------------- what a graph holds


@pytest.mark.usefixtures("captures")
def test_a_graph_holds_the_cached_values_that_it_reads(scene):
    """A plain call in other light puts its own in their place. What a replay would then read, only a GPU can show."""
    renderer = ws.Renderer(scene, device="cpu")
    texture = wp.full((1, 8, 8), wp.vec3(0.5), dtype=wp.vec3, device="cpu", requires_grad=True)
    lights = [ws.synthetic_sky((0.5, 0.6, x), height=32) for x in (-0.3, 0.3)]
    target = wp.zeros(24 * 24, dtype=wp.vec4, device="cpu")

    def draw(light):
        return renderer.draw(light, textures=[None, texture])

    step = Captured(with_gradients(lambda: squared_difference(draw(lights[0]), target), [texture]), "cpu")
    step()
    expected = step().numpy()[0]
    _, white = renderer.view()._cached["white samples"]
    held = weakref.ref(white.value(renderer.view().call))
    del white
    draw(lights[1])
    gc.collect()
    assert held() is not None
    assert step().numpy()[0] == pytest.approx(expected)
    del step
    gc.collect()
    assert held() is None


def test_values_that_caches_may_let_go_are_noted_while_they_are_collected(scene, device):
    renderer = ws.Renderer(beside_static_bodies(scene), device=device)
    view = renderer.view(renderer.placed(moving=[0]))
    renderer.draw(view=view)
    static_bodies, receivers = view.static_bodies, view.receivers
    normals = static_bodies.normals.value(view.call)
    points = static_bodies.receivers(receivers.static_vertices, normals)
    (rows,) = static_bodies._rows.values()
    with collecting_constants() as held:
        cached = rows.of_receivers(receivers, normals)
        static_bodies.receivers(receivers.static_vertices, normals)
        levels = mip_pyramids([wp.zeros((1, 4, 4), dtype=wp.vec3, device=device)]).levels
        renderer.draw(view=renderer.view(renderer.placed(moving=[0])))
    for value in (*cached, *points, levels, static_bodies):
        assert any(item is value for item in held)


@pytest.mark.usefixtures("captures")
def test_replays_follow_arrays_of_tensors_that_the_first_call_saw_as_they_were(scene, device, monkeypatch):
    """Arrays of tensors have the same version during a capture as in the call before it, as in ``torch.cuda.graph``
    after a warm-up. That torch's graphs then hold the launches, only a GPU can show.
    """
    replace_everywhere(monkeypatch, cuda_graph.is_readable, lambda device: False)  # as on a GPU
    monkeypatch.setattr(node, "copied", wp.clone)  # so that a CPU, too, captures a copy
    renderer = ws.Renderer(scene, device=device)
    geometry = renderer.placed()
    for array in geometry.arrays().values():
        array.origin, array.version = geometry, 1
    step = Captured(lambda: renderer.draw(view=renderer.view(geometry)), device)
    first = step().numpy()
    np.testing.assert_array_equal(step().numpy(), first)
    shift = np.zeros((1, 1, 3), np.float32) + [0.2, 0, 0]
    geometry.positions.assign(geometry.positions.numpy() + shift)
    geometry.centers.assign(geometry.centers.numpy() + shift)
    replayed = step().numpy()
    assert np.abs(replayed - first).max() > 0.1
    other = ws.Renderer(scene, device=device)
    np.testing.assert_allclose(replayed, other.draw(view=other.view(geometry)).numpy(), atol=1e-5)


@pytest.mark.usefixtures("captures")
def test_views_of_a_capture_are_not_used_again_outside(scene, device):
    """Their values are of the graph's memory, which only replays fill."""
    renderer = ws.Renderer(scene, device=device)
    geometry, cameras = renderer.placed(), wp.clone(renderer.clip_matrices)
    step = Captured(lambda: renderer.draw(view=renderer.view(geometry, cameras)), device)
    step()
    views = renderer._views
    before = views.last, views._last_cameras
    step()
    assert (views.last, views._last_cameras) == before


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
