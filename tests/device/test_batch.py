"""Batches: lengths that agree, parts after one another, one instance that serves them all."""

import numpy as np
import pytest
import warp as wp

from warpshadow.device import batch
from warpshadow.device.batch import common_batch, concatenate, cut, expand

pytestmark = pytest.mark.usefixtures("poisoned_outputs")


def random(device, *shape, dtype=wp.vec3, seed=0):
    size = () if dtype is wp.float32 else (3,)
    values = np.random.default_rng(seed).normal(size=(*shape, *size))
    return wp.array(values, dtype=dtype, device=device, requires_grad=True)


def test_the_common_batch_is_the_one_length_that_is_not_one():
    arrays = {name: np.zeros((count, 2)) for name, count in (("a", 1), ("b", 4), ("c", 4))}
    assert common_batch(arrays) == 4
    assert common_batch({"a": arrays["a"], "none": None}) == 1
    with pytest.raises(ValueError, match="^d: got a batch of 3, expected 1 or 4"):
        common_batch({**arrays, "d": np.zeros((3, 2))})


def test_lengths_that_differ_are_both_named_with_how_to_pair_them():
    with pytest.raises(
        ValueError,
        match=r"as b has; for all 12 pairs repeat each of b 3 times .*repeat_interleave\(3, 0\), and all of d 4 times",
    ):
        common_batch({"a": np.zeros(1), "b": np.zeros(4), "d": np.zeros(3)})


@pytest.mark.parametrize("dtype", [wp.vec3, wp.float32])
def test_parts_lie_after_one_another_for_every_instance(device, dtype):
    parts = [random(device, *shape, dtype=dtype, seed=seed) for seed, shape in enumerate([(1, 2), (3, 4), (3, 1)])]
    whole = concatenate(parts, [2, 4, 5]).numpy()
    first, second, third = (part.numpy() for part in parts)
    np.testing.assert_array_equal(whole[:, :2], np.repeat(first, 3, axis=0))
    np.testing.assert_array_equal(whole[:, 2:6], second)
    np.testing.assert_array_equal(whole[:, 6:], np.repeat(third, 5, axis=1))


def test_gradients_of_what_serves_several_are_summed(device, verified_tape):
    parts = [random(device, 1, 2), random(device, 3, 1, seed=1)]
    weights = np.random.default_rng(2).normal(size=(3, 6, 3)).astype(np.float32)
    with wp.Tape() as tape:
        whole = concatenate(parts, [2, 4])
    tape.backward(grads={whole: wp.array(weights, dtype=wp.vec3, device=device)})
    np.testing.assert_allclose(parts[0].grad.numpy(), weights[:, :2].sum(axis=0, keepdims=True), atol=1e-6)
    np.testing.assert_allclose(parts[1].grad.numpy(), weights[:, 2:].sum(axis=1, keepdims=True), atol=1e-6)


def test_expanding_repeats_one_instance_and_leaves_several_alone(device):
    one, several = random(device, 1, 3), random(device, 2, 3)
    np.testing.assert_array_equal(expand(one, 2).numpy(), np.repeat(one.numpy(), 2, axis=0))
    assert expand(several, 2) is several


@pytest.mark.parametrize("has_quick_views", [True, False])
def test_items_of_one_instance_are_cut_out_as_a_contiguous_view(has_quick_views, device, monkeypatch):
    """Only a CPU makes quick views, and not while it captures a graph."""
    if not has_quick_views:
        monkeypatch.setattr(batch, "contiguous_view", lambda *arguments, **options: None)
    values = wp.array(np.arange(15.0).reshape(1, 5, 3), dtype=wp.vec3, device=device, requires_grad=True)
    items = cut(values, 1, 4)
    assert items.is_contiguous
    assert items.ptr == values.ptr + 12
    np.testing.assert_array_equal(items.numpy(), values.numpy()[:, 1:4])
    items.grad.fill_(1.0)
    np.testing.assert_array_equal(values.grad.numpy()[0, :, 0], [0, 1, 1, 1, 0])
