"""Numbering of items on the device, against NumPy."""

import numpy as np
import pytest
import warp as wp

from warpshadow.device.capacities import Capacities
from warpshadow.device.cuda_graph import capture
from warpshadow.stages.receivers.numbering import number_items


def numbers_twin(keys, key_count, order):
    """Numbers of the items, items of the numbers, and where those of a key end."""
    chosen = [[[i for i in order if row[i] == key] for key in range(key_count)] for row in keys]
    sizes = [max(len(row[key]) for row in chosen) for key in range(key_count)]
    ends = np.concatenate([[0], np.cumsum(sizes)])
    numbers, items = np.full(keys.shape, -1), np.full((len(keys), ends[-1]), -1)
    for row, of_keys in enumerate(chosen):
        for first, of_key in zip(ends, of_keys, strict=False):
            items[row, first : first + len(of_key)] = of_key
            numbers[row, of_key] = first + np.arange(len(of_key))
    return numbers, items, ends


@pytest.mark.parametrize("item_count", [1, 64, 65, 1000])
@pytest.mark.parametrize("is_ordered", [False, True])
def test_items_of_a_key_follow_each_other(item_count, is_ordered, device):
    rng = np.random.default_rng(item_count)
    keys, order = rng.integers(-1, 4, (3, item_count)), rng.permutation(item_count)
    keys[keys == 2] = -1  # a key of no item
    arrays = [wp.array(values, dtype=wp.int32, device=device) for values in (keys, order)]
    found = number_items("items", arrays[0], 4, arrays[1] if is_ordered else None)
    numbers, items, ends = numbers_twin(keys, 4, order if is_ordered else np.arange(item_count))
    np.testing.assert_array_equal(found.of_items.numpy(), numbers)
    np.testing.assert_array_equal(found.items.numpy(), items)
    np.testing.assert_array_equal(found.ends, ends)
    np.testing.assert_array_equal(found.ends_on_device.numpy(), ends)


def test_a_graph_numbers_what_it_has_room_for(device):
    """Its replays follow the keys, with −1 after the items of a key; what is too much is left out."""
    rng = np.random.default_rng(1)
    keys = wp.array(rng.integers(-1, 2, (1, 200)), dtype=wp.int32, device=device)
    capacities = Capacities(keys.device)
    with capacities.used():
        number_items("items", keys, 2)
    with capture(keys.device) as captured, capacities.used():
        found = number_items("items", keys, 2)
    for values in (rng.integers(-1, 2, (1, 200)), np.full((1, 200), -1), np.ones((1, 200), int)):
        keys.assign(values.astype(np.int32))
        wp.capture_launch(captured.graph)
        items, numbers = found.items.numpy()[0], found.of_items.numpy()[0]
        assert len(items) == found.ends[-1] and numbers.max() < len(items)
        for key in range(2):
            expected = np.flatnonzero(values[0] == key)[: found.ends[key + 1] - found.ends[key]]
            of_key = items[found.ends[key] : found.ends[key + 1]]
            np.testing.assert_array_equal(of_key[: len(expected)], expected)
            assert (of_key[len(expected) :] == -1).all()
            np.testing.assert_array_equal(numbers[expected], found.ends[key] + np.arange(len(expected)))
    assert capacities.is_exceeded
