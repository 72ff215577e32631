"""Capacities: sizes that plain calls read, and graphs have some more of."""

import numpy as np
import pytest
import warp as wp

from warpshadow.device.capacities import Capacities, sizes_of, write_numbers
from warpshadow.device.cuda_graph import capture


@pytest.fixture
def counts(device):
    return wp.array([3, 0, 100], dtype=wp.int32, device=device)


def captured_sizes(capacities, counts, name="items"):
    with capture(counts.device) as captured, capacities.used():
        sizes = sizes_of(name, counts, 1000)
    return captured.graph, sizes


def test_a_plain_call_reads_and_a_graph_has_room_for_a_quarter_more(counts):
    capacities = Capacities(counts.device)
    with capacities.used():
        np.testing.assert_array_equal(sizes_of("items", counts, 1000), [3, 0, 100])
    graph, sizes = captured_sizes(capacities, counts)
    np.testing.assert_array_equal(sizes, [11, 0, 133])
    for values, is_exceeded in (([3, 0, 100], False), ([11, 0, 133], False), ([3, 1, 100], True), ([0, 0, 0], False)):
        counts.assign(values)
        wp.capture_launch(graph)
        assert capacities.is_exceeded == is_exceeded


def test_there_is_room_for_the_most_that_plain_calls_counted(counts):
    capacities = Capacities(counts.device)
    for values in ([3, 0, 100], [20, 0, 8]):
        counts.assign(values)
        with capacities.used():
            sizes_of("items", counts, 1000)
            sizes_of("items", counts[:1], 1000)
    _, sizes = captured_sizes(capacities, counts)
    np.testing.assert_array_equal(sizes, [33, 0, 133])


def test_a_graph_refuses_to_count_what_no_call_before_it_did(counts):
    capacities = Capacities(counts.device)
    with pytest.raises(RuntimeError, match="a graph is captured that counts squares"):
        captured_sizes(capacities, counts, "squares")
    assert not counts.device.is_capturing


def test_a_graph_without_capacities_has_as_many_as_there_can_be(counts):
    with capture(counts.device):
        np.testing.assert_array_equal(sizes_of("items", counts, 7), [7, 7, 7])


def test_numbers_that_a_graph_writes_are_there_at_each_replay(device):
    numbers = np.arange(150) ** 2
    with capture(wp.get_device(device)) as captured:
        result = write_numbers(numbers, wp.get_device(device))
    wp.capture_launch(captured.graph)
    np.testing.assert_array_equal(result.numpy(), numbers)
    result.zero_()
    wp.capture_launch(captured.graph)
    np.testing.assert_array_equal(result.numpy(), numbers)
