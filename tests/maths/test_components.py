"""Connected components agree with SciPy's."""

import numpy as np
import pytest
from scipy.sparse import coo_array, csgraph

from warpshadow.maths.components import connected_components

RNG = np.random.default_rng(0)
CHAIN = RNG.permutation(1000)


@pytest.mark.parametrize(
    ("ends", "other_ends", "count"),
    [
        ([], [], 3),
        (np.arange(999), np.arange(1, 1000), 1000),
        (CHAIN[:-1], CHAIN[1:], 1000),
        *((*RNG.integers(0, count, (2, links)), count) for count, links in ((50, 20), (500, 400), (500, 3000))),
    ],
)
def test_nodes_that_links_join_have_one_number(ends, other_ends, count):
    ends, other_ends = np.array(ends, int), np.array(other_ends, int)
    links = coo_array((np.ones(len(ends)), (ends, other_ends)), shape=(count, count))
    _, expected = csgraph.connected_components(links, directed=False)
    number = connected_components(ends, other_ends, count)
    _, first = np.unique(number, return_index=True)
    assert np.array_equal(np.unique(number), np.arange(len(first))) and (np.diff(first) > 0).all()
    _, expected_first, inverse = np.unique(expected, return_index=True, return_inverse=True)
    np.testing.assert_array_equal(number, np.argsort(np.argsort(expected_first))[inverse])
