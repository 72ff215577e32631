"""Slices of kernels on all cores: the same results whatever the number of threads, and who decides on it."""

import os
import subprocess
import sys
import threading

import numpy as np
import pytest
import twins
import warp as wp

from warpshadow.assets.primitives import icosphere
from warpshadow.device import parallel
from warpshadow.device.launch import launch
from warpshadow.device.parallel import Scratch, scratch_slot
from warpshadow.maths.adjacency import edge_neighbors
from warpshadow.maths.directions import fibonacci
from warpshadow.stages.geometry.normals import vertex_normals
from warpshadow.stages.light.shading import shade
from warpshadow.stages.light.transfer import directional_transfer, sh_transfer
from warpshadow.stages.raster.interpolation import interpolate
from warpshadow.stages.raster.rasterization import rasterize
from warpshadow.stages.silhouettes.silhouettes import find_silhouettes
from warpshadow.stages.visibility import directional, log_sh
from warpshadow.stages.visibility.exponential import exponentiate


@pytest.fixture(autouse=True)
def all_cores_afterwards():
    yield
    parallel.set_thread_count(None)


@wp.kernel(enable_backward=False)
def _spread(
    first_row: int,
    worker: int,
    # in
    values: wp.array(dtype=wp.float32),
    # scratch
    scratch: wp.array2d(dtype=wp.float32),
    # out
    squares: wp.array(dtype=wp.float32),
    workers: wp.array(dtype=wp.int32),
    # sums
    total: wp.array(dtype=wp.float32),
):
    """A thread owns a value; the scratch memory would not keep it, were it another thread's, too."""
    row = first_row + wp.tid()
    own = scratch[scratch_slot(worker, row)]
    for _ in range(200):
        own[0] = values[row]
    squares[row] = own[0] * own[0]
    workers[row] = worker
    if total:
        wp.atomic_add(total, 0, values[row])


def spread(values, *, wants_total=True, cost=1e4):
    device = wp.get_device("cpu")
    count = len(values)
    squares = wp.full(count, np.nan, dtype=wp.float32, device=device)
    workers = wp.empty(count, dtype=wp.int32, device=device)
    total = wp.full(1, 3.0, dtype=wp.float32, device=device) if wants_total else None
    launch(
        _spread,
        count,
        inputs=[wp.array(values, dtype=wp.float32, device=device)],
        scratch=[Scratch((1,), wp.float32)],
        outputs=[squares, workers],
        sums=[total],
        cost=cost,
    )
    return squares.numpy(), workers.numpy(), None if total is None else total.numpy()


@pytest.mark.parametrize("count", [1, 2, 3, 7])
def test_every_row_runs_once_and_sums_are_added_to_what_is_there(count):
    parallel.set_thread_count(count)
    values = np.arange(1000, dtype=np.float32)
    squares, workers, total = spread(values)
    np.testing.assert_array_equal(squares, values**2)
    assert total == values.sum() + 3  # whole numbers: exact
    assert set(workers) <= set(range(count))


def test_sums_are_the_same_to_the_bit_for_any_number_of_threads():
    values = np.random.default_rng(0).normal(size=5000).astype(np.float32)
    totals = []
    for count in (1, 2, 3, 8):
        parallel.set_thread_count(count)
        totals.append(spread(values)[2])
    assert len({total.tobytes() for total in totals}) == 1
    assert totals[0] != np.float32(3) + np.cumsum(values)[-1]  # they are the slices' sums, not one after the other


@wp.kernel(enable_backward=False)
def _add_to_last(
    first_row: int,
    worker: int,
    # in
    values: wp.array(dtype=wp.float32),
    # sums
    totals: wp.array4d(dtype=wp.float32),
):
    """A thread owns a value."""
    wp.atomic_add(totals, 1, 0, 0, 1, values[first_row + wp.tid()])


def test_sums_have_as_many_dimensions_as_an_array_can():
    parallel.set_thread_count(2)
    values = np.arange(1000, dtype=np.float32)
    totals = wp.full((2, 1, 1, 2), 3.0, dtype=wp.float32, device="cpu")
    launch(_add_to_last, 1000, inputs=[wp.array(values, device="cpu")], outputs=[], sums=[totals], cost=1e4)
    np.testing.assert_array_equal(totals.numpy().ravel(), [3, 3, 3, values.sum() + 3])


def test_short_launches_are_not_divided():
    parallel.set_thread_count(4)
    assert set(spread(np.ones(100), cost=1.0)[1]) == {0}


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_threads_have_as_many_slices_each(count, monkeypatch):
    counts = []
    share = parallel._share
    monkeypatch.setattr(parallel, "_share", lambda *arguments: (counts.append(arguments[1]), share(*arguments)))
    parallel.set_thread_count(count)
    for rows in (100, 400, 1000):
        spread(np.ones(rows), wants_total=False, cost=2e3)  # work for 2, 8 and 20 slices
    assert all(number % count == 0 or number < count for number in counts)
    assert len(counts) == (3 if count > 1 else 0)


def test_nothing_is_launched_over_no_rows():
    parallel.set_thread_count(4)
    assert spread(np.ones(0))[2] == 3


def test_launches_from_several_python_threads_do_not_meet():
    parallel.set_thread_count(3)
    failures = []

    def run(seed):
        values = np.random.default_rng(seed).normal(size=3000).astype(np.float32)
        for _ in range(20):
            if not np.array_equal(spread(values, wants_total=False)[0], values**2):
                failures.append(seed)

    threads = [threading.Thread(target=run, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures


def test_threads_that_get_no_core_are_not_waited_for():
    parallel.set_thread_count(2)
    is_over = threading.Event()
    parallel._pool(2).put(is_over.wait)  # to the only thread of the pool
    try:
        found = []
        launch = threading.Thread(target=lambda: found.append(spread(np.arange(1000))), daemon=True)
        launch.start()
        launch.join(60)
        assert found, "the launch waits for a thread that has not begun"
        np.testing.assert_array_equal(found[0][0], np.arange(1000.0) ** 2)
        assert set(found[0][1]) == {0}
    finally:
        is_over.set()


def shaded_with_gradients(method, forward=None, backward=None):
    """Shading of 3000 receivers in a batch of two, and its gradients, as bytes."""
    parts = [twins.random_scene(seed, vertex_count=3000, sphere_count=40) for seed in (0, 1)]
    dtypes = (wp.vec3, wp.vec3, wp.vec3, wp.float32)
    points, normals, centers, radii = (
        wp.array(np.stack(pair), dtype=dtype, device="cpu", requires_grad=True)
        for pair, dtype in zip(zip(*parts, strict=True), dtypes, strict=True)
    )
    directions = fibonacci(128)
    rng = np.random.default_rng(2)
    size = 128 if method == "directional" else 64
    light = wp.array(rng.uniform(size=(2, size, 3)), dtype=wp.vec3, device="cpu", requires_grad=True)
    if forward is not None:
        parallel.set_thread_count(forward)
    with wp.Tape() as tape:
        if method == "directional":
            seen = directional.transmittance(points, normals, centers, radii, directions)
            transfer = directional_transfer(seen, normals, directions)
        else:
            seen = exponentiate(log_sh.accumulate(points, normals, centers, radii))
            transfer = sh_transfer(seen, normals, order=8)
        shading = shade(transfer, light)
    shading.grad.assign(rng.normal(size=(2, 3000, 3)).astype(np.float32))
    tape.backward()
    return [shading.numpy().tobytes()] + [
        array.grad.numpy().tobytes() for array in (points, normals, centers, radii, light)
    ]


@pytest.mark.filterwarnings("ignore:log-SH visibility")
@pytest.mark.parametrize("method", ["directional", "log-sh"])
def test_shading_and_its_gradients_do_not_depend_on_the_number_of_threads(method):
    results = []
    for count in (1, 2, 5):
        parallel.set_thread_count(count)
        results.append(shaded_with_gradients(method))
    assert results[0] == results[1] == results[2]


def image_with_gradients():
    """A sphere that fills an image, and its gradients to positions in clip space and colors."""
    ball = icosphere(subdivisions=4)
    rng = np.random.default_rng(5)
    clip = np.concatenate([ball.positions * 0.9, np.ones((len(ball.positions), 1))], axis=1)
    clip[:, 2] = 0.5 - 0.4 * clip[:, 2]
    options = {"device": "cpu", "requires_grad": True}
    clip_positions = wp.array(clip[None], dtype=wp.vec4, **options)
    colors = wp.array(rng.uniform(size=(1, *ball.positions.shape)), dtype=wp.vec3, **options)
    faces = wp.array(ball.faces, dtype=wp.vec3i, device="cpu")
    with wp.Tape() as tape:
        image = interpolate(rasterize(clip_positions, faces, 200, 200), faces, colors)
    image.grad.assign(rng.normal(size=(1, 200, 200, 3)).astype(np.float32))
    tape.backward()
    return [array.numpy().copy() for array in (image, clip_positions.grad, colors.grad)]


def test_kernels_that_warp_differentiates_are_divided_both_ways(monkeypatch):
    parallel.set_thread_count(2)
    monkeypatch.setattr(parallel, "_MIN_SUMMED_WORK", 1e18)
    whole = image_with_gradients()
    monkeypatch.setattr(parallel, "_MIN_SUMMED_WORK", 1e4)
    results = []
    for count in (1, 2, 5):
        parallel.set_thread_count(count)
        results.append(image_with_gradients())
    for divided, *others in zip(*results, strict=True):
        for other in others:
            np.testing.assert_array_equal(divided, other)
    np.testing.assert_array_equal(results[0][0], whole[0])
    for divided, expected in zip(results[0][1:], whole[1:], strict=True):
        np.testing.assert_allclose(divided, expected, rtol=0, atol=1e-5 * np.abs(expected).max())
        assert not np.array_equal(divided, expected)  # or nothing was divided


def moved_balls():
    """Normals, fragments and silhouettes of a batch of balls, and a gradient to their positions, as bytes."""
    ball = icosphere(subdivisions=2)
    positions = 0.6 * ball.positions + np.linspace(-0.2, 0.2, 6)[:, None, None]
    positions[..., 2] = 0.5 + 0.4 * positions[..., 2]
    faces, edges = (wp.array(each, dtype=wp.vec3i, device="cpu") for each in (ball.faces, edge_neighbors(ball.faces)))
    moved = wp.array(positions, dtype=wp.vec3, device="cpu", requires_grad=True)
    clip = wp.array(np.insert(positions, 3, 1, axis=2), wp.vec4, device="cpu")
    with wp.Tape() as tape:
        normals = vertex_normals(moved, faces)
    normals.grad.assign(np.random.default_rng(0).normal(size=(*normals.shape, 3)).astype(np.float32))
    tape.backward()
    fragments = rasterize(clip, faces, 32, 32)
    silhouettes = find_silhouettes(fragments, faces, edges, clip)
    found = normals, moved.grad, *fragments.rows, silhouettes.samples, silhouettes.edges, silhouettes.line_areas
    return [array.numpy().tobytes() for array in found]


def test_images_of_a_batch_that_threads_share_are_the_same(monkeypatch):
    whole = moved_balls()
    monkeypatch.setattr(parallel, "_MIN_WORK", 1e3)
    monkeypatch.setattr(parallel, "_MIN_SUMMED_WORK", 1e3)
    for count in (2, 5):
        parallel.set_thread_count(count)
        assert moved_balls() == whole


def test_more_threads_may_go_back_than_went_forward():
    results = []
    for forward, backward in ((1, 1), (1, 6), (6, 1)):
        results.append(shaded_with_gradients("directional", forward, backward))
    assert results[0] == results[1] == results[2]


@pytest.mark.parametrize("count", [0, -1, 1.5, "2", True])
def test_a_count_that_is_none_is_refused(count):
    with pytest.raises(ValueError, match="count: got .*, expected a positive whole number, or None for all cores"):
        parallel.set_thread_count(count)


def test_the_environment_says_how_many_threads_run(monkeypatch):
    monkeypatch.setenv(parallel.ENVIRONMENT_VARIABLE, "3")
    assert parallel.thread_count() == 3
    parallel.set_thread_count(2)
    assert parallel.thread_count() == 2
    parallel.set_thread_count(None)
    for text in ("0", "-1", "two", "1.5"):
        monkeypatch.setenv(parallel.ENVIRONMENT_VARIABLE, text)
        with pytest.raises(ValueError, match=f"WARPSHADOW_NUM_THREADS: got '{text}', expected a positive whole number"):
            parallel.thread_count()
    monkeypatch.setenv(parallel.ENVIRONMENT_VARIABLE, "")
    assert parallel.thread_count() == len(os.sched_getaffinity(0))


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_process_has_threads_of_its_own():
    program = """
import os, sys
sys.path[:0] = ["tests", "tests/device"]
import numpy as np
import test_parallel as test
test.parallel.set_thread_count(2)
test.spread(np.ones(1000))
child = os.fork()
if child == 0:
    squares, _, total = test.spread(np.ones(1000))
    os._exit(0 if squares.sum() == 1000 and total == 1003 else 1)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)


def test_a_failure_of_a_thread_reaches_the_caller():
    parallel.set_thread_count(2)
    others_began = threading.Event()

    def run(number, worker):
        if worker:
            others_began.set()
            raise RuntimeError("no such luck")
        others_began.wait(60)

    for _ in range(2):  # the pool goes on
        others_began.clear()
        with pytest.raises(RuntimeError, match="no such luck"):
            parallel._share(run, 2, 2)
