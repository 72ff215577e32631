"""Tapes: a thread's own tape inside another's, and adjoints under it."""

import numpy as np
import warp as wp

from warpshadow.device.tape import record_adjoint, recorded, unrecorded


def array(device, requires_grad=True):
    return wp.full(3, 2.0, dtype=wp.float32, device=device, requires_grad=requires_grad)


def record_factor(factor, values, result):
    """Record that the result is a multiple of the values."""
    record_adjoint(lambda: values.grad.assign(values.grad.numpy() + factor * result.grad.numpy()), [values, result])


def test_adjoints_are_called_from_the_last_to_the_first_each_time(device):
    values, calls = array(device), []
    with recorded() as tape:
        for number in range(3):
            record_adjoint(lambda number=number: calls.append(number), [values])
    tape.backward()
    tape.backward()
    assert calls == [2, 1, 0, 2, 1, 0]


def test_a_tape_zeroes_the_gradients_that_its_adjoints_read_and_write(device):
    values, result = array(device), array(device)
    with recorded() as tape:
        record_factor(5.0, values, result)
    tape.backward(grads={result: wp.full(3, 1.0, dtype=wp.float32, device=device)})
    np.testing.assert_array_equal(values.grad.numpy(), 5.0)
    tape.zero()
    assert not values.grad.numpy().any() and not result.grad.numpy().any()


def test_an_adjoint_that_no_array_wants_is_not_recorded(device):
    with recorded() as tape:
        record_adjoint(lambda: None, [array(device, requires_grad=False), None])
    assert not tape.launches


def test_without_a_tape_nothing_is_recorded(device):
    record_adjoint(lambda: None, [array(device)])


def test_a_tape_inside_another_takes_what_is_recorded_until_it_ends(device):
    values = array(device)
    with wp.Tape() as outer:
        record_adjoint(lambda: None, [values])
        with recorded() as inner:
            record_adjoint(lambda: None, [values])
            with unrecorded():
                record_adjoint(lambda: None, [values])
            record_adjoint(lambda: None, [values])
        record_adjoint(lambda: None, [values])
    assert (len(outer.launches), len(inner.launches)) == (2, 2)


def test_a_tape_ends_where_its_function_raises(device):
    values = array(device)
    with wp.Tape() as outer:
        try:
            with recorded():
                raise KeyError
        except KeyError:
            record_adjoint(lambda: None, [values])
    assert len(outer.launches) == 1
