"""Launching: what requires a gradient, what a tape records, and how often it plays back."""

import threading

import numpy as np
import pytest
import warp as wp

from warpshadow.device.batch import accumulate, instance_in
from warpshadow.device.launch import differentiable, launch
from warpshadow.device.parallel import (
    Scratch,
    run_dimensions,
    run_length,
    scratch_slot,
    set_thread_count,
    split_launch,
    strip_count,
)
from warpshadow.device.tape import recorded

pytestmark = pytest.mark.usefixtures("poisoned_outputs")


@wp.kernel
def _square(
    # in
    values: wp.array2d(dtype=wp.float32),
    # out
    squares: wp.array2d(dtype=wp.float32),
    signs: wp.array2d(dtype=wp.int32),
):
    """A thread owns a value; one row serves all."""
    batch, item = wp.tid()
    value = values[instance_in(batch, values.shape[0]), item]
    squares[batch, item] = value * value
    signs[batch, item] = int(wp.sign(value))


@wp.kernel(enable_backward=False)
def _cube(
    first_row: int,
    worker: int,
    # in
    values: wp.array(dtype=wp.float32),
    # scratch
    scratch: wp.array2d(dtype=wp.float32),
    # out
    cubes: wp.array(dtype=wp.float32),
    # sums
    total: wp.array(dtype=wp.float32),
):
    """A thread owns a value."""
    row = first_row + wp.tid()
    own = scratch[scratch_slot(worker, row)]
    own[0] = values[row] * values[row]
    cubes[row] = own[0] * values[row]
    if total:
        wp.atomic_add(total, 0, cubes[row])


@wp.kernel(enable_backward=False)
def _cube_adjoint(
    # in
    values: wp.array(dtype=wp.float32),
    adj_cubes: wp.array(dtype=wp.float32),
    # out
    adj_values: wp.array(dtype=wp.float32),
):
    """A thread owns a value."""
    row = wp.tid()
    adj_values[row] = adj_values[row] + 3.0 * values[row] * values[row] * adj_cubes[row]


def floats(device, *shape, requires_grad=True):
    values = np.random.default_rng(0).normal(size=shape)
    return wp.array(values, dtype=wp.float32, device=device, requires_grad=requires_grad)


def square(values, rows=3):
    squares = wp.empty((rows, values.shape[1]), dtype=wp.float32, device=values.device)
    signs = wp.empty(squares.shape, dtype=wp.int32, device=values.device)
    launch(_square, squares.shape, inputs=[values], outputs=[squares, signs])
    return squares, signs


def cube(values, cost=1.0):
    return differentiable(
        lambda cubes: launch(
            _cube,
            len(values),
            inputs=[values],
            scratch=[Scratch((1,), wp.float32)],
            outputs=[cubes],
            sums=[None],
            cost=cost,
        ),
        lambda adj_cubes: launch(_cube_adjoint, len(values), inputs=[values, adj_cubes], outputs=[values.grad]),
        result=wp.empty(values.shape, dtype=wp.float32, device=values.device),
        variables=[values, None],
    )


def test_outputs_of_warps_own_adjoint_require_a_gradient_if_an_input_does(device, verified_tape):
    values = floats(device, 1, 4)
    with recorded() as tape:
        squares, signs = square(values)
    assert squares.requires_grad and not signs.requires_grad
    np.testing.assert_array_equal(signs.numpy()[2], np.sign(values.numpy()[0]))
    tape.backward(grads={squares: wp.full(squares.shape, 1.0, dtype=wp.float32, device=device)})
    np.testing.assert_allclose(values.grad.numpy(), 3 * 2 * values.numpy(), rtol=1e-6)


@wp.kernel
def _weigh(
    first_row: int,
    worker: int,
    # in
    values: wp.array2d(dtype=wp.float32),
    weights: wp.array2d(dtype=wp.float32),
    # out
    weighted: wp.array2d(dtype=wp.float32),
):
    """A thread owns a row; all read the same weights, one as an item and the others from a row of them."""
    row = first_row + wp.tid()
    own = weights[0]
    for item in range(values.shape[1]):
        weighted[row, item] = values[row, item] * weights[0, 0] * own[item]


@pytest.mark.parametrize("cost", [1.0, 1e6])
def test_warps_own_adjoint_of_slices_adds_to_what_rows_share(cost, device, verified_tape):
    values, weights = floats(device, 20, 3), floats(device, 1, 3)
    weighted = wp.empty((20, 3), dtype=wp.float32, device=device)
    with recorded() as tape:
        launch(_weigh, 20, inputs=[values, weights], outputs=[weighted], shared=[weights], cost=cost)
    own = weights.numpy()[0]
    np.testing.assert_allclose(weighted.numpy(), values.numpy() * own[0] * own, rtol=1e-6)
    pulls = np.random.default_rng(1).normal(size=(20, 3)).astype(np.float32)
    for _ in range(2):
        weighted.grad.assign(pulls)
        tape.backward()
    np.testing.assert_allclose(values.grad.numpy(), 2 * pulls * own[0] * own, rtol=1e-6)
    sums = (pulls * values.numpy()).sum(axis=0)
    expected = own[0] * sums
    expected[0] += own @ sums
    np.testing.assert_allclose(weights.grad.numpy()[0], 2 * expected, rtol=1e-5)


def test_what_rows_share_has_the_same_gradient_for_any_number_of_threads():
    values, weights = floats("cpu", 4000, 3), floats("cpu", 1, 3)
    gradients = set()
    for count in (1, 2, 3, 7):
        set_thread_count(count)
        weighted = wp.empty((4000, 3), dtype=wp.float32, device="cpu")
        with recorded() as tape:
            launch(_weigh, 4000, inputs=[values, weights], outputs=[weighted], shared=[weights], cost=1e4)
        weighted.grad.fill_(1.0)
        tape.backward()
        gradients.add(weights.grad.numpy().tobytes())
        tape.zero()
    set_thread_count(None)
    assert len(gradients) == 1


@pytest.mark.parametrize("compute", [lambda values: square(values)[0], lambda values: cube(values.flatten())])
def test_nothing_is_recorded_and_no_result_requires_a_gradient_if_no_input_does(compute, device):
    with recorded() as tape:
        result = compute(floats(device, 1, 4, requires_grad=False))
    assert not result.requires_grad and not tape.launches


def test_a_view_is_refused_where_its_gradient_would_be_lost(device):
    values = floats(device, 1, 4)
    squares = wp.empty(12, dtype=wp.float32, device=device)
    signs = wp.empty((3, 4), dtype=wp.int32, device=device)
    with pytest.raises(RuntimeError, match="_square: got an output that is a view"):
        launch(_square, (3, 4), inputs=[values], outputs=[squares.reshape((3, 4)), signs])


@pytest.mark.parametrize("cost", [1.0, 1e6])
def test_an_adjoint_written_by_hand_adds_to_gradients_each_time_that_the_tape_plays_back(cost, device, verified_tape):
    values = floats(device, 5)
    with recorded() as tape:
        cubes = cube(values, cost=cost)
    np.testing.assert_allclose(cubes.numpy(), values.numpy() ** 3, rtol=1e-6)
    for factor in (1.0, 2.0):
        cubes.grad.fill_(factor)
        tape.backward()
    np.testing.assert_allclose(values.grad.numpy(), (1 + 2) * 3 * values.numpy() ** 2, rtol=1e-6)
    tape.zero()
    assert not values.grad.numpy().any() and not cubes.grad.numpy().any()


def test_results_require_a_gradient_without_a_tape_too(device):
    assert cube(floats(device, 5)).requires_grad


def test_a_launch_that_is_cut_into_slices_adds_to_sums(device):
    values, total = floats(device, 5), wp.full(1, 3.0, dtype=wp.float32, device=device)
    cubes = wp.empty(5, dtype=wp.float32, device=device)
    scratch = [Scratch((1,), wp.float32)]
    launch(_cube, 5, inputs=[values], scratch=scratch, outputs=[cubes], sums=[total], cost=1e6)
    np.testing.assert_allclose(total.numpy(), 3 + (values.numpy() ** 3).sum(), rtol=1e-6)


def test_threads_record_on_their_own_tapes(device):
    gradients, barrier = {}, threading.Barrier(2)
    cube(floats(device, 5))  # loads the module, which threads must not be the first to do
    launch(_cube_adjoint, 1, inputs=[floats(device, 1)] * 2, outputs=[floats(device, 1)])

    def work(factor):
        values = floats(device, 5)
        barrier.wait()
        with recorded() as tape:
            cubes = cube(values)
        barrier.wait()
        tape.backward(grads={cubes: wp.full(5, factor, dtype=wp.float32, device=device)})
        gradients[factor] = values.grad.numpy() / values.numpy() ** 2

    threads = [threading.Thread(target=work, args=(factor,)) for factor in (1.0, 2.0)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for factor in (1.0, 2.0):
        np.testing.assert_allclose(gradients[factor], 3 * factor, rtol=1e-5)


def test_accumulating_adds_in_place_on_any_shape(device):
    for shape in ((4,), (2, 3)):
        values, totals = floats(device, *shape), wp.full(shape, 2.0, dtype=wp.float32, device=device)
        accumulate(values, totals)
        np.testing.assert_allclose(totals.numpy(), 2 + values.numpy(), rtol=1e-6)


def test_a_thread_owns_a_row_on_a_cpu_and_a_sample_on_a_gpu():
    class Gpu:
        is_cuda = True

    assert run_length(wp.get_device("cpu"), 640) == 640 and run_length(Gpu(), 640) == 1
    assert strip_count(wp.get_device("cpu")) == 1 and strip_count(Gpu()) > 1
    assert run_dimensions(wp.get_device("cpu"), 480, 2) == (480, 2) and run_dimensions(Gpu(), 480, 2) == (2, 480)


@wp.kernel(enable_backward=False)
def _name_runs(
    first_row: int,
    worker: int,
    # out
    runs: wp.array2d(dtype=wp.vec2i),
):
    """A thread owns a run."""
    row, column = wp.tid()
    instance, run = split_launch(worker, first_row + row, column)
    runs[instance, run] = wp.vec2i(instance, run)


@pytest.mark.parametrize("worker, dimensions", [(0, (4, 3)), (-1, (3, 4))])
def test_each_run_of_each_instance_has_a_thread(worker, dimensions, device):
    runs = wp.empty((3, 4), dtype=wp.vec2i, device=device)
    wp.launch(_name_runs, dimensions, inputs=[0, worker], outputs=[runs], device=device)
    np.testing.assert_array_equal(runs.numpy(), np.moveaxis(np.indices((3, 4)), 0, -1))
