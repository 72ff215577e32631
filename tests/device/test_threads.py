"""Threads and processes: calls from several of them give what they give one after another."""

import contextlib
import copy
import functools
import multiprocessing
import os
import pickle
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp
from tensors import small_scene

import warpshadow as ws
from warpshadow.device import tape, threads
from warpshadow.device.threads import locked
from warpshadow.device.warp_internals import current_tape
from warpshadow.torch import TorchRenderer, apply
from warpshadow.tuning import tune

TESTS = Path(__file__).parents[1]

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def restless():
    """Let Python change threads as often as it can: what comes between two steps of another comes soon."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(interval)


@contextlib.contextmanager
def beside(work):
    """Repeat work in another thread meanwhile; what it raises is raised here."""
    stop, runs, errors = threading.Event(), [], []

    def repeat():
        try:
            while not stop.is_set():
                runs.append(work())
        except Exception as error:
            errors.append(error)

    thread = threading.Thread(target=repeat)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
    if errors:
        raise errors[0]
    assert runs


def gradient(renderer: TorchRenderer) -> torch.Tensor:
    """Of an image's square to the bodies' translations."""
    rotations, translations, scales = renderer.scene_poses()
    translations.requires_grad_()
    renderer(geometry=renderer.placed(rotations, translations, scales)).square().sum().backward()
    return translations.grad


@wp.kernel
def _square(
    # in
    x: wp.array(dtype=wp.float32),
    # out
    y: wp.array(dtype=wp.float32),
):
    """A thread owns a number."""
    i = wp.tid()
    y[i] = x[i] * x[i]


def squares(x: wp.array) -> wp.array:
    y = wp.zeros_like(x)
    wp.launch(_square, dim=x.shape, inputs=[x], outputs=[y], device=x.device)
    return y


# ---------------------------------------------------------------------------------------------- gradients


def test_gradients_are_right_while_another_thread_renders(restless):
    renderer, tiny = TorchRenderer(small_scene()), small_scene(size=4)
    expected = gradient(renderer)
    with beside(lambda: ws.render(tiny)):
        for _ in range(15):
            assert torch.equal(gradient(renderer), expected)


def test_gradients_are_right_in_two_threads_that_share_a_renderer(restless):
    renderer = TorchRenderer(small_scene())
    expected = gradient(renderer)

    def check():
        assert torch.equal(gradient(renderer), expected)

    with beside(check):
        for _ in range(15):
            check()


def test_gradients_are_right_while_another_thread_records_a_tape_of_warp(restless):
    renderer = TorchRenderer(small_scene())
    expected = gradient(renderer)

    def record():
        x = wp.array(np.arange(4, dtype=np.float32), requires_grad=True, device="cpu")
        with wp.Tape() as recording:
            y = squares(x)
        assert len(recording.launches) == 1  # its own
        y.grad.fill_(1.0)
        recording.backward()
        np.testing.assert_array_equal(x.grad.numpy(), 2 * x.numpy())

    with beside(record):
        for _ in range(15):
            assert torch.equal(gradient(renderer), expected)


def test_two_threads_record_a_tape_each(restless):
    def record():
        x = wp.array(np.arange(4, dtype=np.float32), requires_grad=True, device="cpu")
        with tape.recorded() as recording:
            y = squares(squares(x))
        assert len(recording.launches) == 2
        y.grad.fill_(1.0)
        recording.backward()
        np.testing.assert_array_equal(x.grad.numpy(), 4 * x.numpy() ** 3)

    with beside(record):
        for _ in range(100):
            record()


def test_what_another_thread_launches_is_not_recorded():
    def launch():
        squares(wp.zeros(4, dtype=wp.float32, device="cpu", requires_grad=True))

    with tape.recorded() as recording:
        with ThreadPoolExecutor(1) as pool:
            pool.submit(launch).result()
        assert not recording.launches
        launch()
    assert len(recording.launches) == 1


def test_what_is_unrecorded_leaves_the_tapes_of_other_threads_alone():
    entered, left = threading.Event(), threading.Event()

    def stay():
        with tape.unrecorded():
            entered.set()
            assert left.wait(60)

    x = wp.zeros(4, dtype=wp.float32, device="cpu", requires_grad=True)
    with ThreadPoolExecutor(1) as pool, wp.Tape() as recording:
        future = pool.submit(stay)
        assert entered.wait(60)
        squares(x)
        left.set()
        future.result()
        squares(x)
    assert len(recording.launches) == 2


def test_a_tape_of_warp_around_a_tensor_function_goes_on_after_it():
    x = wp.array([3.0], dtype=wp.float32, device="cpu", requires_grad=True)
    t = torch.tensor([5.0], requires_grad=True)
    with wp.Tape() as recording:
        apply(squares, t, dtypes=[wp.float32]).sum().backward()
        y = squares(x)
    recording.backward(y)
    assert t.grad == 10 and x.grad.numpy() == 6


@pytest.mark.slow
def test_fits_of_spheres_are_beside_the_tape():
    """A pose that requires a gradient is often what asks for the spheres first."""
    with wp.Tape() as recording:
        ws.fit_spheres(ws.icosphere(1.0, 1), 2, steps=1, cache=False, progress=False)
        assert not recording.launches
        assert current_tape() is recording


# ---------------------------------------------------------------------------------------------- images


@pytest.mark.slow
@pytest.mark.parametrize("method", ["directional", "log-sh"])
def test_threads_that_share_a_renderer_each_see_what_they_ask_for(method, restless):
    """One body moves, so the renderer keeps what does not move, for the last camera."""
    scene = small_scene(method, size=8)
    eyes = [(0.4 * k, 2.5, 5) for k in range(4)]
    matrices = [
        torch.tensor(ws.Camera.look_at(eye, (0, 0.6, 0), size=(8, 8)).clip_matrix(), dtype=torch.float32)
        for eye in eyes
    ]

    def see(renderer: TorchRenderer, number: int) -> torch.Tensor:
        rotations, translations, scales = renderer.scene_poses()
        with torch.no_grad():
            placed = renderer.placed(rotations, translations + 0.1 * number, scales, moving=[0])
            light = ws.EnvironmentMap.constant(1.0 + number)
            return renderer(light, geometry=placed, clip_matrices=matrices[number])

    alone = TorchRenderer(scene)
    expected = [see(alone, number) for number in range(4)]
    shared = TorchRenderer(scene)
    with ThreadPoolExecutor(4) as pool:
        for number, image in zip([0, 1, 2, 3] * 6, pool.map(lambda k: see(shared, k), [0, 1, 2, 3] * 6), strict=True):
            assert torch.equal(image, expected[number])


def test_one_at_a_time_means_that_no_two_run_at_once():
    running, most = [], []

    @locked
    def step():
        running.append(None)
        most.append(len(running))
        threading.Event().wait(1e-3)
        running.pop()

    with ThreadPoolExecutor(4) as pool:
        for future in [pool.submit(step) for _ in range(8)]:
            future.result()
    assert len(most) == 8 and max(most) == 1


@pytest.mark.parametrize(
    "call",
    [
        lambda renderer: renderer.array_renderer.scene_poses(pivot="center"),
        lambda renderer: renderer.array_renderer.clip_matrices,
        lambda renderer: renderer.array_renderer.on_faces(np.zeros(1, int), np.full((1, 3), 1 / 3)),
        lambda renderer: renderer.scene_poses(pivot="center"),
        lambda renderer: renderer(),
    ],
    ids=["scene_poses", "clip_matrices", "on_faces", "torch", "image"],
)
def test_calls_wait_for_the_call_of_another_thread(call):
    renderer = TorchRenderer(small_scene("none", size=4))
    with ThreadPoolExecutor(1) as pool:
        with threads.one_call:
            future = pool.submit(call, renderer)
            assert not wait([future], 0.2).done
        future.result(60)


def test_a_call_of_a_renderer_takes_the_lock_once(monkeypatch):
    renderer, entries = ws.Renderer(small_scene("none", size=4)), []
    geometry = renderer.placed()
    renderer.draw(geometry=geometry)

    class Counting:
        def __enter__(self):
            entries.append(None)

        def __exit__(self, *_):
            pass

    monkeypatch.setattr(threads, "one_call", Counting())
    for call in (renderer.draw, renderer.explain, functools.partial(renderer.draw, geometry=geometry), renderer.placed):
        entries.clear()
        call()
        assert len(entries) == 1


@pytest.mark.slow
def test_the_first_calls_of_a_process_may_come_from_several_threads():
    script = """
import sys, threading
from concurrent.futures import ThreadPoolExecutor
import torch
from tensors import small_scene
from warpshadow.torch import TorchRenderer
torch.set_num_threads(1)
sys.setswitchinterval(1e-5)
renderers = [TorchRenderer(small_scene()) for _ in range(4)]
start = threading.Barrier(4)
def draw(renderer):
    start.wait()
    return renderer()
with ThreadPoolExecutor(4) as pool:
    images = list(pool.map(draw, renderers))
assert all(torch.equal(image, images[0]) for image in images)
"""
    subprocess.run([sys.executable, "-c", script], cwd=TESTS, check=True)


# ---------------------------------------------------------------------------------------------- copies


class Estimator(torch.nn.Module):
    """A network whose last layer is the renderer."""

    def __init__(self, **options):
        super().__init__()
        self.layer = torch.nn.Linear(4, 4 * 3)
        self.renderer = TorchRenderer(small_scene(size=8), basis=ws.HarmonicBasis(2), **options)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        return self.renderer(self.layer(features).reshape(-1, 4, 3))


def saved_and_loaded(model: torch.nn.Module, folder: Path) -> torch.nn.Module:
    torch.save(model, folder / "model.pt")
    return torch.load(folder / "model.pt", weights_only=False)


@pytest.mark.parametrize(
    "copied",
    [
        lambda model, _: copy.deepcopy(model),
        lambda model, _: pickle.loads(pickle.dumps(model)),
        lambda model, _: torch.optim.swa_utils.AveragedModel(model).module,
        saved_and_loaded,
    ],
    ids=["deepcopy", "pickle", "AveragedModel", "save"],
)
@pytest.mark.parametrize("has_cameras", [False, True])
def test_a_copied_network_has_the_same_images_and_gradients(copied, has_cameras, tmp_path):
    camera = small_scene(size=8).camera
    model = Estimator(cameras=[camera, camera] if has_cameras else None)
    features = torch.ones(2, 4)
    model(features).sum().backward()  # what it keeps stays behind
    other = copied(model, tmp_path)
    other.zero_grad()
    image = other(features)
    assert torch.equal(image, model(features))
    image.sum().backward()
    assert torch.equal(other.layer.weight.grad, model.layer.weight.grad)
    assert other.renderer.array_renderer.merged_scene is not model.renderer.array_renderer.merged_scene


def test_a_copy_does_not_choose_its_method_anew(monkeypatch):
    choices = []

    def resolved(scene, **options):
        if scene.visibility.method != "auto":
            return scene
        choices.append(scene)
        return small_scene("none")

    monkeypatch.setattr(tune, "resolved", resolved)
    renderer = ws.Renderer(small_scene("auto"))
    assert copy.deepcopy(renderer).scene.visibility.method == "none"
    assert len(choices) == 1


# ---------------------------------------------------------------------------------------------- processes


class Images(torch.utils.data.Dataset):
    """Images of a renderer, made where they are asked for."""

    def __init__(self):
        self.renderer = TorchRenderer(small_scene(size=8))

    def __len__(self) -> int:
        return 4

    def __getitem__(self, number: int) -> torch.Tensor:
        return self.renderer(ws.EnvironmentMap.constant(1.0 + number))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_workers_of_a_data_loader_render(method):
    if method not in multiprocessing.get_all_start_methods():
        pytest.skip(f"this system does not {method}")
    images = Images()
    expected = torch.stack([images[number] for number in range(len(images))])
    loader = torch.utils.data.DataLoader(
        images, batch_size=2, num_workers=1, multiprocessing_context=method, timeout=120
    )
    assert torch.equal(torch.cat(list(loader)), expected)


def draw_into(queue, renderer: ws.Renderer) -> None:
    queue.put(renderer.render())


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_child_that_is_forked_while_another_thread_renders_does_not_wait_for_it():
    context = multiprocessing.get_context("fork")
    renderer, tiny = ws.Renderer(small_scene(size=8)), small_scene(size=4)
    expected = renderer.render()
    with beside(lambda: ws.render(tiny)):
        for _ in range(4):
            queue = context.Queue()
            child = context.Process(target=draw_into, args=(queue, renderer))
            child.start()
            np.testing.assert_array_equal(queue.get(timeout=120), expected)
            child.join()
