"""The light that spheres send: means over the patches that they show, and their gradients."""

import numpy as np
import pytest
import twins
import warp as wp

from warpshadow.stages.bounces.proxy_radiance import find_proxy_radiance, patches_of_clusters
from warpshadow.stages.visibility import merging

ROUNDING = 1e-6  # float32 sums of a few patches. Measured 2e-7
ADJOINT = 1e-5  # relative L2; the function is linear but for a clamp. Measured 3e-7
COUNT = 16  # of directions

pytestmark = pytest.mark.usefixtures("poisoned_outputs")


@pytest.fixture
def patches():
    """Radiosities, parts shown, weights of 9 patches in two instances, areas, spheres, of four; the last has none."""
    rng = np.random.default_rng(0)
    projected_areas = np.maximum(rng.uniform(-1, 1, (2, 9, COUNT)), 0)
    weights = np.repeat(rng.random((2, 9, 1)) ** 4, 3, axis=2)
    return (
        rng.random((2, 9, 3)),
        projected_areas,
        weights,
        rng.uniform(0.1, 1, 9),
        np.array([0, 0, 1, 2, 2, 2, 0, 1, 0]),
    )


def table(radiosity, projected_areas, open_weights, areas, spheres, nearest, device="cpu", **options):
    given = (radiosity, wp.vec3), (projected_areas, wp.float32), (open_weights, wp.vec3)
    arrays = [wp.array(values, dtype=dtype, device=device, requires_grad=True) for values, dtype in given]
    nodes = patches_of_clusters(spheres, nearest, **options)
    with wp.Tape() as tape:
        result = find_proxy_radiance(*arrays, areas, *nodes)
    return result, tape, arrays


def lists(spheres, count):
    return [np.flatnonzero(spheres == sphere) for sphere in range(count)]


def test_the_table_is_that_of_the_float64_twin(patches, device):
    *values, spheres = patches
    got = table(*values, spheres, [-1] * 4, device)[0].numpy()
    for rows, *instance in zip(got, *values[:3], strict=True):
        expected = twins.find_proxy_radiance(*instance, values[3], lists(spheres, 4))
        assert np.abs(rows - expected).max() < ROUNDING


@pytest.mark.parametrize("counts", [(2, 2, 2), (1, 2, 1), (2, 1, 1), (1, 1, 2)])
def test_gradients_are_those_of_the_twin_in_batches_that_are_shared_or_not(counts, patches, device):
    *values, areas, spheres = patches
    values = [each[:count] for each, count in zip(values, counts, strict=True)]
    result, tape, arrays = table(*values, areas, spheres, [-1] * 4, device)
    weights = np.random.default_rng(1).normal(size=(*result.shape, 4))
    result.grad.assign(weights.astype(np.float32))
    tape.backward()

    def loss():
        shared = [np.broadcast_to(each, (2, *each.shape[1:])) for each in values]
        tables = [twins.find_proxy_radiance(*each, areas, lists(spheres, 4)) for each in zip(*shared, strict=True)]
        return np.sum(weights * tables)

    for number, array in enumerate(arrays):
        expected = np.zeros_like(values[number])
        for index in np.ndindex(expected.shape):
            kept = values[number][index]
            ends = []
            for step in (1e-6, -1e-6):
                values[number][index] = kept + step
                ends.append(loss())
            values[number][index] = kept
            expected[index] = (ends[0] - ends[1]) / 2e-6
        assert np.linalg.norm(array.grad.numpy() - expected) < ADJOINT * np.linalg.norm(expected)


def test_patches_of_one_radiosity_send_it_in_all_directions_even_where_none_shows(device):
    """So nothing is lost: patches that show nothing have a mean, too."""
    projected_areas = np.random.default_rng(0).random((1, 3, COUNT)) * (np.arange(COUNT) % 2)
    radiosity = np.broadcast_to(np.float32([0.2, 0.5, 1.0]), (1, 3, 3))
    weights = np.broadcast_to(np.float32([[1], [0.5], [0]]), (1, 3, 3))
    got = table(radiosity, projected_areas, weights, np.ones(3), np.zeros(3, int), [0], device)[0].numpy()[0, 0]
    np.testing.assert_allclose(got[:, :3] / got[:, 3:], radiosity[0, :1].repeat(COUNT, axis=0), rtol=ROUNDING)


def test_a_sphere_without_patches_takes_the_nearest_or_is_black(patches, device):
    *values, spheres = patches
    taken = table(*values, spheres, [0, 0, 0, 5], device)[0].numpy()[:, 3]
    alone = table(*values, np.where(np.arange(9) == 5, 3, spheres), [-1] * 4, device)[0].numpy()[:, 3]
    np.testing.assert_array_equal(taken, alone)
    black = table(*values, spheres, [0, 0, 0, -1], device)[0].numpy()[:, 3]
    assert (black[..., :3] == 0).all() and (black[..., 3] == 0.25).all()


def test_quads_have_the_patches_of_their_spheres(patches, monkeypatch):
    monkeypatch.setattr(merging, "MERGED_FROM", 4)
    spheres = np.array([0, 4, 1, 2, 2, -1, 0, 1, 4])
    starts, numbers = patches_of_clusters(spheres, [-1, -1, -1, 3, 0], merging=0.5)
    nodes = [numbers[begin:end].tolist() for begin, end in zip(starts[:-1], starts[1:], strict=True)]
    assert nodes == [[0, 6], [2, 7], [3, 4], [3], [1, 8], [0, 6, 2, 7, 3, 4, 3]]
    assert len(patches_of_clusters(spheres, [-1] * 5, merging=0.0)[0]) == 6


def test_no_spheres_have_no_table(patches, device):
    *values, spheres = patches
    assert table(*values, spheres, [], device)[0].shape == (2, 0, COUNT)


def test_what_does_not_fit_is_refused(patches, device):
    radiosity, projected_areas, weights, areas, spheres = patches
    nodes = patches_of_clusters(spheres, [-1] * 4)
    b, v = (wp.array(each, dtype=wp.vec3, device=device) for each in (radiosity, weights))
    g = wp.array(projected_areas, dtype=wp.float32, device=device)
    with pytest.raises(ValueError, match=r"projected_areas: got shape \(2, 8, 16\), expected \[2, 9, direction\]"):
        find_proxy_radiance(b, wp.array(projected_areas[:, :8], dtype=wp.float32, device=device), v, areas, *nodes)
    with pytest.raises(ValueError, match=r"patch_weights: got shape \(2, 8\), expected \[2, 9\]"):
        find_proxy_radiance(b, g, wp.array(weights[:, :8], dtype=wp.vec3, device=device), areas, *nodes)
    with pytest.raises(ValueError, match="areas: got 1 values out of range"):
        find_proxy_radiance(b, g, v, np.r_[areas[:8], -1.0], *nodes)
    with pytest.raises(ValueError, match="patch_indices: got 0 to 9, expected patches, 0 to 8"):
        find_proxy_radiance(b, g, v, areas, nodes[0], np.arange(1, 10) % 10 * (np.arange(9) > 0))
    with pytest.raises(ValueError, match="starts: got .*, expected 0 to the 9 indices, rising"):
        find_proxy_radiance(b, g, v, areas, nodes[0][:-2], nodes[1])
