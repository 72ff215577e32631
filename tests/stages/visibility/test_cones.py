"""The cone that a sphere blocks: on, in and far from the sphere, against the rule in float64."""

import functools

import numpy as np
import pytest
import twins
import warp as wp

from warpshadow.device.lanes import lane_type, make_lane_functions, module_options
from warpshadow.stages.visibility.cones import BLEND, FADE_RADIUS, TINY_RADIUS, make_cone

# cos θ and sin²θ where they are exact: a few float32 roundings.
FLOAT32 = 3e-7
# In the blend t = (D/r − 1)/0.01 magnifies the rounding of D/r (1e-7) a hundredfold, times the slope 0.3 of c(t).
BLEND_FLOAT32 = 5e-6


# As a GPU's compiler does unasked: a·b + c rounded once.
FUSED = {"cpu_compiler_flags": "-march=native -ffp-contract=fast"}


@functools.cache
def cone_kernel(lanes, is_fused):
    Lane = lane_type(lanes)
    load, find_cone = make_lane_functions(lanes).load, make_cone(lanes)

    options = module_options(lanes) | (FUSED if is_fused else {})

    @wp.kernel(module="unique", module_options=options, enable_backward=False)
    def write_cones(
        # in
        offsets: wp.array(dtype=wp.vec3),
        radii: wp.array(dtype=wp.float32),
        # out
        result: wp.array2d(dtype=Lane),
    ):
        """A thread owns a block of receivers that see one sphere."""
        block = wp.tid()
        cone = find_cone(load(offsets, block), 1.0 / radii[block])
        result[block, 0] = cone.axis.x
        result[block, 1] = cone.axis.y
        result[block, 2] = cone.axis.z
        result[block, 3] = cone.cosine
        result[block, 4] = cone.sine2
        result[block, 5] = cone.weight

    return write_cones


def kernel_cones(offsets, radius, device, lanes=16, is_fused=False):
    """Direction [n, 3], cos θ [n], sin²θ [n], weight [n] of offsets [n, 3] to a sphere of one radius, float64."""
    blocks = -(-len(offsets) // lanes)
    result = wp.full((blocks, 6), np.nan, dtype=lane_type(lanes), device=device)
    inputs = [
        wp.array(offsets, dtype=wp.vec3, device=device),
        wp.full(blocks, float(radius), dtype=wp.float32, device=device),
    ]
    wp.launch(cone_kernel(lanes, is_fused), dim=blocks, inputs=inputs, outputs=[result], device=device)
    rows = result.numpy().reshape(blocks, 6, lanes).transpose(0, 2, 1).reshape(-1, 6)[: len(offsets)]
    return rows[:, :3].astype(float), *rows[:, 3:].astype(float).T


def along(direction, distances):
    return (np.asarray(distances)[:, None] * np.asarray(direction) / np.linalg.norm(direction)).astype(np.float32)


def ratios_of(offsets, radius):
    """D/r in float64 of what the kernel was really given."""
    return np.linalg.norm(offsets.astype(float), axis=1) / float(np.float32(radius))


@pytest.mark.parametrize("lanes", [16, 1])
def test_the_kernel_follows_the_float64_rule_everywhere(lanes, device):
    ratios = np.r_[np.linspace(0, 1.2, 241), np.linspace(0.995, 1.015, 101), np.geomspace(1.02, 1e5, 60)]
    offsets = along((1, -2, 0.5), 0.7 * ratios)
    direction, cosine, sine2, weight = kernel_cones(offsets, 0.7, device, lanes)
    expected = twins.cones(np.zeros(3), offsets.astype(float), float(np.float32(0.7)))
    assert np.abs(direction - expected[0]).max() < FLOAT32
    assert np.abs(cosine - expected[1]).max() < BLEND_FLOAT32
    assert np.abs(sine2 - (1 - expected[1] ** 2)).max() < BLEND_FLOAT32
    assert np.abs(weight - expected[2]).max() < BLEND_FLOAT32


@pytest.mark.parametrize("is_fused", [False, True], ids=["rounded", "fused"])
@pytest.mark.parametrize("radius", [1e-3, 1.0, 1e3])
def test_from_1_01_radii_on_the_cone_is_exact_and_its_sine_keeps_its_digits(radius, is_fused, device):
    offsets = along((0.3, 0.2, -0.9), radius * np.geomspace(1.01001, 1e6, 400))
    lanes = 1 if is_fused else 16
    _, cosine, sine2, weight = kernel_cones(offsets, radius, device, lanes, is_fused)
    ratio = ratios_of(offsets, radius)
    assert np.abs(cosine - np.sqrt(1 - ratio**-2)).max() < 10 * FLOAT32  # 1 − s² cancels near touch, and c' is 7
    assert np.abs(sine2 * ratio**2 - 1).max() < 10 * FLOAT32  # relative: the solid angle of a distant sphere
    assert (weight == 1).all()


def test_inside_the_sphere_the_cone_is_a_hemisphere(device):
    offsets = along((1, 1, 1), 2.5 * np.linspace(0.001, 0.99999, 200))
    _, cosine, sine2, _ = kernel_cones(offsets, 2.5, device)
    assert np.abs(cosine).max() < FLOAT32
    assert np.abs(sine2 - 1).max() < FLOAT32


def test_the_sphere_fades_out_smoothly_towards_its_center(device):
    ratios = np.linspace(0, 1, 200)
    _, _, _, weight = kernel_cones(along((0, 1, 0), ratios), 1.0, device)
    assert weight[0] < 1e-30
    assert np.abs(weight - twins.smoothstep(ratios / FADE_RADIUS)).max() < FLOAT32 * 4
    assert (weight[ratios > FADE_RADIUS] == 1).all()
    direction, *_ = kernel_cones(np.zeros((1, 3), np.float32), 1.0, device)
    assert not direction.any()


@pytest.mark.parametrize("seam", [1.0, 1 + BLEND, FADE_RADIUS])
def test_value_and_slope_of_the_rule_are_continuous(seam, device):
    """Slopes on both sides of a seam, by differences over h, differ by no more than the curvature allows.

    The blend's |c''| is 7040 per r² at most, at D = r, so slopes of c over h = 2e-4 differ by 0.7 at most.
    A corner, as of the exact cosine clamped at 1.01 r, would be a jump of 7.
    """
    h = 2e-4
    ratios = seam + np.array([-h, 0, h])
    offsets = along((0, 0, 1), ratios)
    _, cosine, sine2, weight = kernel_cones(offsets, 1.0, device)
    step = np.diff(ratios_of(offsets, 1.0))
    for values in (cosine, weight):
        before, after = np.diff(values) / step
        assert abs(after - before) < 0.8
    assert np.abs(np.diff(cosine)).max() < 8 * h and np.abs(np.diff(weight)).max() < 7 * h


def test_the_slope_near_the_sphere_is_bounded_and_never_negative(device):
    """The exact cosine's slope grows without bound towards D = r; the rule's stays below 19.5, in the blend."""
    ratios = np.linspace(0.98, 1.03, 501)
    offsets = along((0, 0, 1), ratios)
    _, cosine, _, _ = kernel_cones(offsets, 1.0, device)
    slope = np.diff(cosine) / np.diff(ratios_of(offsets, 1.0))
    assert slope.max() < 20
    assert slope.min() > -0.02  # rounding: 2e-6 over steps of 1e-4


@pytest.mark.parametrize("lanes", [16, 1])
def test_cones_are_finite_and_in_range_at_any_scale(lanes, device):
    ratios = np.r_[0, np.geomspace(1e-7, 1e6, 111)]
    for radius in 10.0 ** np.arange(-12, 13, 2):  # radii 1e-12 … 1e6 in scenes of scale 1e-6 … 1e6
        direction, cosine, sine2, weight = kernel_cones(along((1, 2, 3), radius * ratios), radius, device, lanes)
        for values in (direction, cosine, sine2, weight):
            assert np.isfinite(values).all()
        assert cosine.min() > -FLOAT32 and cosine.max() <= 1
        assert sine2.min() >= 0 and sine2.max() <= 1 + FLOAT32
        assert weight.min() >= 0 and weight.max() <= 1
        lengths = np.linalg.norm(direction, axis=1)
        assert lengths.max() < 1 + FLOAT32
        assert np.abs(lengths[weight > 1e-3] - 1).max() < FLOAT32


@pytest.mark.parametrize("lanes", [16, 1])
def test_cones_are_finite_over_all_distances_and_radii_that_are_accepted(lanes, device):
    """Where (D/r)² is beyond float32, a sphere has no size, so it needs no direction."""
    for radius in (1.1 * TINY_RADIUS, 1e-9, 1.0, 1e9, 1e18):
        distances = np.r_[0, 1e-44, 1e-30, np.geomspace(1e-20, 1.99e18, 77)]
        direction, cosine, sine2, weight = kernel_cones(along((1, 0, 0), distances), radius, device, lanes)
        for values in (direction, cosine, sine2, weight):
            assert np.isfinite(values).all()
        lengths = np.linalg.norm(direction, axis=1)
        ratios = distances / radius
        assert np.abs(lengths[(ratios > 1e-18) & (ratios < 1e19)] - 1).max() < FLOAT32
        assert lengths.max() < 1 + FLOAT32
        assert (sine2[ratios > 1e19] < 1e-37).all()


def test_the_cone_depends_on_the_ratio_alone_over_twelve_decades(device):
    ratios = np.r_[np.linspace(0.05, 1.2, 100), np.geomspace(1.2, 1e4, 50)]
    expected = kernel_cones(along((1, 2, 3), ratios), 1.0, device)
    for exponent in (-20, -10, 10, 20):  # powers of two scale without rounding
        scale = 2.0**exponent
        got = kernel_cones(along((1, 2, 3), ratios) * np.float32(scale), scale, device)
        for a, b in zip(got, expected, strict=True):
            np.testing.assert_array_equal(a, b)
