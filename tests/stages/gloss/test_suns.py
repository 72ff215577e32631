"""Light of suns in the lobes of receivers, against sums over their discs."""

import numpy as np
import pytest
import twins
import warp as wp

from warpshadow.maths.directions import cell_radius, fibonacci
from warpshadow.stages.gloss import suns
from warpshadow.stages.gloss.lobes import sample_lobes
from warpshadow.stages.gloss.normal_spread import NormalSpread
from warpshadow.stages.gloss.reflection import LobeLight

# Numbers near 1 after some tens of operations in float32.
FLOAT32 = 2e-5

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

CAMERA = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 0]])
"""In the origin."""
SUN = twins.unit(np.array([0.3, 0.5, -0.8]))


def receivers(slant, count=40):
    """Points, and normals whose lobes are at rising angles to SUN, which they see at a slant."""
    view = twins.unit(np.cross(SUN, [1.0, 0, 0]) * np.sin(slant) + SUN * np.cos(slant))
    normals = twins.unit(view + SUN) + np.linspace(0, 0.4, count)[:, None] * twins.unit(np.array([1.0, 0.3, 0.2]))
    return -5 * np.tile(view, (count, 1)), twins.unit(normals)


def sum_over_disc(points, normals, width, radius, count=20_000):
    """Means of f c and of that with (1 − v·h)⁵ over a disc around SUN; mirrors of a width along and across the view."""
    i = np.arange(count)
    z = 1 - (1 - np.cos(radius)) * (i + 0.5) / count
    side = twins.unit(np.cross(SUN, [0, 1.0, 0]))
    azimuth = np.pi * (1 + np.sqrt(5)) * i
    ring = np.cos(azimuth)[:, None] * side + np.sin(azimuth)[:, None] * np.cross(SUN, side)
    towards = z[:, None] * SUN + np.sqrt(1 - z**2)[:, None] * ring
    result = []
    for point, normal in zip(points, normals, strict=True):
        view = twins.unit(-point)
        tangent = twins.unit(view - view @ normal * normal)
        frame = np.stack([tangent, np.cross(normal, tangent), normal], axis=1)
        mirror, light, eye = twins.unit(view + towards) @ frame, towards @ frame, view @ frame
        scale = np.array([*width, 1.0])
        density = 1 / (np.pi * width[0] * width[1] * ((mirror / scale) ** 2).sum(axis=1) ** 2)
        slants = np.linalg.norm(light * scale, axis=1), np.linalg.norm(eye * scale)
        values = 0.5 * density * light[:, 2] / (light[:, 2] * slants[1] + eye[2] * slants[0])
        result.append([values.mean(), (values * (1 - mirror @ eye) ** 5).mean()])
    return np.array(result)


def reflect(device, points, normals, roughness, sun_light, transmittance, spread=None):
    """G and G' of suns alone, [receiver, 2, channel]."""

    def put(values, dtype=wp.vec3):
        return wp.array(np.asarray(values, np.float32)[None], dtype=dtype, device=device)

    rough = put(np.full(len(points), roughness), wp.float32)
    camera = wp.array(CAMERA[None].astype(np.float32), dtype=wp.mat44, device=device)
    varied = None if spread is None else NormalSpread(*map(put, spread))
    lobes = sample_lobes(put(points), put(normals), rough, camera, 8, varied).lobes
    nothing = LobeLight(put(0 * points), put(0 * points))
    through = put(np.broadcast_to(transmittance, (len(points), np.shape(transmittance)[-1])), wp.float32)
    return np.stack([light.numpy()[0] for light in suns.add_suns(nothing, lobes, sun_light, through)], axis=1)


# Of the brightest. Measured 0.003 to 0.2%, and 1.5% where the disc is wider than the lobe and seen at a slant.
@pytest.mark.parametrize(("roughness", "degrees"), [(0.1, 0.3), (0.1, 1.5), (0.2, 1.5), (0.2, 5.0), (0.6, 5.0)])
@pytest.mark.parametrize("slant", [0.2, 1.0])
def test_light_of_a_sun_is_the_sum_over_its_disc(device, roughness, degrees, slant):
    points, normals = receivers(slant)
    radius = np.radians(degrees)
    sun = suns.Suns(SUN[None], np.array([[1.0, 2.0, 0.5]]), np.array([2 * np.pi * (1 - np.cos(radius))]))
    got = reflect(device, points, normals, roughness, sun, [1.0])
    expected = sum_over_disc(points, normals, [roughness**2] * 2, radius)[..., None] * sun.irradiance
    np.testing.assert_allclose(got, expected, atol=0.02 * expected.max())


# Of the brightest. Measured 2.6%: a disc that is seen as an ellipse counts as one of its area.
def test_light_of_a_sun_is_the_sum_over_its_disc_although_normals_vary(device):
    points, normals = receivers(0.4)
    radius, roughness, spread = np.radians(2.0), 0.2, 0.4
    sun = suns.Suns(SUN[None], np.ones((1, 3)), np.array([2 * np.pi * (1 - np.cos(radius))]))
    tangents = twins.unit(-points - ((-points * normals).sum(axis=1, keepdims=True)) * normals)
    got = reflect(device, points, normals, roughness, sun, [1.0], (spread * tangents, 0 * tangents))
    expected = sum_over_disc(points, normals, [np.sqrt(roughness**4 + spread**2 / 12), roughness**2], radius)
    np.testing.assert_allclose(got, np.repeat(expected[..., None], 3, axis=2), atol=0.04 * expected.max())


def test_suns_are_dimmed_by_the_mean_transmittance_of_their_directions(device):
    points, normals = receivers(0.4, 3)
    both = suns.Suns(np.stack([SUN, SUN]), np.array([[1.0, 0, 0], [0, 1, 0]]), np.array([0.01, 0.01]))
    full = reflect(device, points, normals, 0.4, both, np.ones(4))
    got = reflect(device, points, normals, 0.4, both, [1.0, 0.5, 0.25, 0.0])
    np.testing.assert_allclose(got, full * [0.75, 0.125, 0], atol=FLOAT32 * full.max())


def test_lobes_see_no_sun_below_the_horizon(device):
    points, normals = receivers(0.4, 3)
    below = suns.Suns(-normals[:1], np.ones((1, 3)), np.array([0.01]))
    assert not reflect(device, points, normals, 0.4, below, [1.0]).any()


def test_suns_have_the_transmittance_of_their_cells_above_the_horizon(device):
    cells, rng = fibonacci(64), np.random.default_rng(3)
    normals = twins.unit(rng.normal(size=(20, 3)))
    values = rng.uniform(0, 1, size=(20, 64))
    sun = suns.Suns(cells[[5, 40]] + 0.02, np.ones((2, 3)), np.ones(2))
    towards = twins.unit(cells + 0.03 * rng.normal(size=cells.shape))
    arrays = [
        wp.array(array[None].astype(np.float32), dtype=dtype, device=device)
        for array, dtype in ((values, wp.float32), (normals, wp.vec3))
    ]
    got = suns.find_sun_transmittance(*arrays, sun, cells, towards).numpy()[0]
    height = np.clip(normals @ towards[[5, 40]].T / cell_radius(64) / 2 + 0.5, 0, 1)
    expected = np.minimum(values[:, [5, 40]] / (height**2 * (3 - 2 * height) + 1e-7), 1)
    np.testing.assert_allclose(got, expected, atol=FLOAT32)
