"""Four spheres seen as one: how large it is, where it takes over, what that changes, and its gradient."""

import numpy as np
import pytest
import twins
import warp as wp

from warpshadow.maths.directions import cell_radius, fibonacci
from warpshadow.maths.spatial_sort import compact_order
from warpshadow.stages.visibility import directional, merging

EXACT = 3e-6  # float32, relative to sizes of about 1

pytestmark = pytest.mark.usefixtures("poisoned_outputs")


def random_clusters(seed, count=50):
    """Four spheres each within one unit, of radii that differ, shape [1, sphere, …]."""
    rng = np.random.default_rng(seed)
    centers = (rng.normal(size=(count, 1, 3)) * 5 + rng.uniform(-0.3, 0.3, size=(count, 4, 3))).reshape(-1, 3)
    return centers.astype(np.float32), rng.uniform(0.02, 0.4, 4 * count).astype(np.float32)


def merge(centers, radii, device, requires_grad=False):
    options = {"device": device, "requires_grad": requires_grad}
    arrays = wp.array(centers[None], dtype=wp.vec3, **options), wp.array(radii[None], dtype=wp.float32, **options)
    return arrays, merging.merge(*arrays)


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_quads_are_those_of_the_float64_twin(scale, device):
    centers, radii = random_clusters(0)
    centers, radii = centers[:-1] * np.float32(scale), radii[:-1] * np.float32(scale)  # three spheres are left over
    _, nodes = merge(centers, radii, device)
    expected = twins.merged_clusters(centers.astype(float), radii.astype(float))
    np.testing.assert_array_equal(nodes.centers.numpy()[0, :199], centers)
    np.testing.assert_array_equal(nodes.radii.numpy()[0, :199], radii)
    np.testing.assert_allclose(nodes.centers.numpy()[0, 199:], expected[0], rtol=0, atol=10 * EXACT * scale)
    np.testing.assert_allclose(nodes.radii.numpy()[0, 199:], expected[1], rtol=EXACT)
    np.testing.assert_allclose(nodes.extents.numpy()[0], expected[2], rtol=EXACT)


@pytest.mark.slow
@pytest.mark.parametrize(("spread", "measured"), [(0.7, 0.92), (1.2, 1.06), (2.5, 1.08)])
def test_a_quads_sphere_covers_what_its_spheres_do_on_average(spread, measured, device):
    """Discs of random directions, counted at points: of spheres that overlap much, little, and hardly."""
    rng = np.random.default_rng(1)
    centers = (rng.uniform(-1, 1, size=(40, 4, 3)) * spread).reshape(-1, 3).astype(np.float32)
    radii = rng.uniform(0.6, 1.0, 160).astype(np.float32)
    _, nodes = merge(centers, radii, device)
    ratios = []
    for cluster, radius in enumerate(nodes.radii.numpy()[0, 160:]):
        own, sizes = centers[4 * cluster : 4 * cluster + 4], radii[4 * cluster : 4 * cluster + 4]
        extent = np.abs(own).max() + 1
        areas = []
        for _ in range(20):
            image_plane = np.linalg.qr(rng.normal(size=(3, 2)))[0]
            places = rng.uniform(-extent, extent, size=(2000, 2))
            inside = np.linalg.norm(places[:, None] - own @ image_plane, axis=-1) < sizes
            areas.append(4 * extent**2 * inside.any(axis=1).mean())
        ratios.append(np.pi * radius**2 / np.mean(areas))
    assert abs(np.mean(ratios) - measured) < 0.03
    assert np.std(ratios) < 0.08


def many_spheres(seed, count=640):
    """Neighbors side by side, and receivers near and far."""
    rng = np.random.default_rng(seed)
    centers = rng.normal(size=(count, 3))
    centers *= 1 / np.linalg.norm(centers, axis=1, keepdims=True)
    centers = centers[compact_order(centers)].astype(np.float32)
    radii = rng.uniform(0.06, 0.1, count).astype(np.float32)
    away = rng.normal(size=(60, 3))
    points = away / np.linalg.norm(away, axis=1, keepdims=True) * rng.uniform(1.1, 9, size=(60, 1))
    return points.astype(np.float32), centers, radii


def put(points, centers, radii, device, **options):
    arrays = [wp.array(values[None], dtype=wp.vec3, device=device, **options) for values in (points, centers)]
    return [*arrays, wp.array(radii[None], dtype=wp.float32, device=device, **options)]


@pytest.mark.slow
@pytest.mark.parametrize("tau", [0.3, 0.75, 1.0])
def test_spheres_that_merge_block_what_the_float64_twin_says(tau, device):
    points, centers, radii = many_spheres(4)
    p, c, r = put(points, centers, radii, device)
    directions = fibonacci(128)
    got = directional.transmittance(p, None, c, r, directions, merging=tau).numpy()[0]
    wide = [values.astype(float) for values in (points, centers, radii)]
    expected = twins.merging_transmittance(*wide, directions, tau)
    assert np.abs(got - expected).max() < 5e-4  # float32, and 1e-4 where it is opaque
    apart = directional.transmittance(p, None, c, r, directions, merging=0).numpy()[0]
    assert np.abs(apart - twins.transmittance(*wide, directions)).max() < 5e-4
    assert np.abs(got - apart).max() > 0.01  # or nothing has merged


def test_merging_changes_irradiance_by_little(device):
    """Under even light, whose irradiance is the sum over directions. Measured 0.3% on average, 0.9% at most."""
    points, centers, radii = many_spheres(5)
    p, c, r = put(points, centers, radii, device)
    directions = fibonacci(128)
    normals = -points / np.linalg.norm(points, axis=1, keepdims=True)
    cosines = np.maximum(normals @ directions.T, 0)
    merged, apart = (
        (directional.transmittance(p, None, c, r, directions, merging=tau).numpy()[0] * cosines).sum(axis=1)
        for tau in (directional.MERGING, 0.0)
    )
    assert np.abs(merged / apart - 1).mean() < 0.006
    assert np.abs(merged / apart - 1).max() < 0.02


def test_fewer_spheres_do_not_merge(device):
    points, centers, radii = many_spheres(6, count=merging.MERGED_FROM - 1)
    p, c, r = put(points, centers, radii, device)
    results = [directional.transmittance(p, None, c, r, fibonacci(64), merging=tau).numpy() for tau in (0.0, 1.0)]
    np.testing.assert_array_equal(*results)


def test_nothing_jumps_while_spheres_merge(device):
    """A receiver that moves away in small steps: differences of a step are bounded by the slope, jumps would not be."""
    _, centers, radii = many_spheres(7)
    extent = merging.merge(*put(centers[:1], centers, radii, device)[1:]).extents.numpy().mean()
    begin = extent / (directional.MERGING * cell_radius(64))
    far = np.linspace(1 + 0.8 * begin, 1 + 1.6 * begin, 2000, dtype=np.float32)
    points = far[:, None] * np.float32([0.6, 0.0, 0.8])
    p, c, r = put(points, centers, radii, device)
    seen = directional.transmittance(p, None, c, r, fibonacci(64)).numpy()[0]
    assert np.abs(np.diff(seen, axis=0)).max() < 4e-3
    assert np.ptp(seen, axis=0).max() > 0.1


@pytest.mark.parametrize("tau", [-0.1, 1.1, np.nan])
def test_an_angle_out_of_range_is_refused(tau, device):
    points, centers, radii = many_spheres(10, count=4)
    with pytest.raises(ValueError, match="merging: got .*, expected 0 .never. to 1 cell radius"):
        arrays = put(points, centers, radii, device)
        directional.transmittance(arrays[0], None, *arrays[1:], fibonacci(64), merging=tau)
