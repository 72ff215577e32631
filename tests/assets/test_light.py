"""Environment maps: which way is which, what is refused, and that moving light keeps its energy."""

import functools
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import warpshadow as ws
from warpshadow.assets.color import LUMINANCE
from warpshadow.assets.image import ImageError, exr_bytes, write_image
from warpshadow.assets.known_light import as_light
from warpshadow.assets.light import EnvironmentMap
from warpshadow.assets.sky import synthetic_sky
from warpshadow.maths import sh
from warpshadow.stages.light.light_samples import sample_map

RANDOM = np.random.default_rng(0)
ENERGY = 1e-4  # relative, the contract for float32 radiance
PIXELATION = 1e-3  # of SH coefficients: pixels of 64 rows have the value of their centers; measured 4e-4
X, Y, Z = np.eye(3)


def random_map(height=8, seed=0):
    return EnvironmentMap(np.random.default_rng(seed).random((height, 2 * height, 3)))


def with_places(places, height=8):
    """A map of ones with given values at (row, col, channel)."""
    pixels = np.ones((height, 2 * height, 3), np.float32)
    for place, value in places.items():
        pixels[place] = value
    return pixels


def spot(row, col, height=8):
    """A black map with one white pixel."""
    pixels = np.zeros((height, 2 * height, 3), np.float32)
    pixels[row, col] = 1
    return EnvironmentMap(pixels)


def direction_twin(row, col, height):
    """DESIGN.md, section 2, for a place between pixels too."""
    theta, phi = np.pi * row / height, 2 * np.pi * col / (2 * height)
    return np.array([np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)])


def solid_angle_twin(row, height):
    return np.pi / height * (np.cos(np.pi * row / height) - np.cos(np.pi * (row + 1) / height))


def integral(environment):
    """∫ L dω in float64."""
    height = len(environment.radiance)
    weights = np.array([solid_angle_twin(row, height) for row in range(height)])
    return np.einsum("h,hwc->c", weights, environment.radiance.astype(np.float64))


def turned_y(direction, degrees):
    angle = np.radians(degrees)
    x, y, z = direction
    return np.array([x * np.cos(angle) + z * np.sin(angle), y, z * np.cos(angle) - x * np.sin(angle)])


def fibonacci(count):
    index = np.arange(count)
    z = 1 - (2 * index + 1) / count
    phi = np.pi * (1 + np.sqrt(5)) * (index + 0.5)
    return np.stack([np.sqrt(1 - z**2) * np.cos(phi), np.sqrt(1 - z**2) * np.sin(phi), z], axis=1)


# ------------------------------------------------------------------------------------------------ validation


@pytest.mark.parametrize(
    ("pixels", "message"),
    [
        (with_places({(3, 7, 1): np.nan, (4, 0, 0): -1}), r"got 2 NaN, .*row 3, column 7, channel 1: nan\)"),
        (with_places({(0, 0, 2): np.inf}), r"got 1 NaN, Inf or negative .*row 0, column 0, channel 2: inf\)"),
        (with_places({(5, 1, 0): -2}), r"row 5, column 1, channel 0: -2.0\), expected .* sanitize="),
        (np.full((2, 4, 3), 1e39), "got 24 NaN, Inf"),
        (np.ones((8, 8, 3)), "got 8 x 8 pixels, expected an equirectangular map"),
        (np.ones((4, 24, 3)), "got 24 x 4 pixels, which looks like a cube map"),
        (np.ones((24, 4, 3)), "got 4 x 24 pixels, which looks like a cube map"),
        (np.ones((12, 16, 3)), "got 16 x 12 pixels, which looks like a cube map"),
        (np.ones((16, 12, 3)), "got 12 x 16 pixels, which looks like a cube map"),
        (np.ones((8, 16)), r"got shape \(8, 16\), expected \[height, 2·height, 3\]: gray"),
        (np.ones((8, 16, 4)), r"got shape \(8, 16, 4\), .*: \[..., :3\] is without alpha"),
        (np.ones((8, 16, 3), np.uint8), r"got values of uint8, .*srgb_to_linear\(values / 255\)"),
        ("park.exr", r"got 'park.exr', expected an array .*EnvironmentMap.read\(path\)"),
        (None, "got None, expected an array"),
        (np.ones((0, 0, 3)), r"got shape \(0, 0, 3\)"),
    ],
)
def test_a_bad_map_is_refused_with_what_and_where(pixels, message):
    with pytest.raises(ImageError, match=message):
        EnvironmentMap(pixels)


def test_a_map_keeps_a_read_only_float32_copy():
    pixels = np.ones((2, 4, 3))
    environment = EnvironmentMap(pixels)
    pixels[:] = 7
    assert environment.radiance.dtype == np.float32 and environment.radiance.max() == 1
    with pytest.raises(ValueError, match="read-only"):
        environment.radiance[0] = 0


def unchecked_exr(pixels):
    """An .exr file of other programs, which may hold NaN."""
    return exr_bytes(dict(zip("RGB", np.moveaxis(pixels, 2, 0), strict=True)))


def test_a_bad_file_is_refused_with_its_path_unless_repaired(tmp_path):
    path = tmp_path / "bad.exr"
    bad = {(0, 0, 0): np.nan, (7, 15, 1): np.inf, (3, 4, 2): -5, (3, 5, 2): np.nan}
    path.write_bytes(unchecked_exr(with_places(bad)))
    with pytest.raises(ImageError, match="bad.exr: radiance: got 4 NaN, Inf or negative values"):
        EnvironmentMap.read(path)
    np.testing.assert_array_equal(
        EnvironmentMap.read(path, sanitize="zero").radiance, with_places(dict.fromkeys(bad, 0))
    )
    np.testing.assert_array_equal(EnvironmentMap.read(path, sanitize="neighbors").radiance, with_places({}))
    with pytest.raises(ValueError, match="sanitize: got 'neighbours', .*did you mean 'neighbors'"):
        EnvironmentMap.read(path, sanitize="neighbours")


def test_neighbors_wrap_around_and_fill_from_the_rim(tmp_path):
    pixels = np.broadcast_to(np.arange(8, dtype=np.float32)[:, None, None], (8, 16, 3)).copy()
    expected = pixels.copy()
    pixels[0, 0], expected[0, 0] = np.nan, (2 * 0 + 3 * 1) / 5
    pixels[3:6, 6:11], expected[4, 8] = np.nan, 4  # by symmetry; the block takes two rounds to fill
    (tmp_path / "a.exr").write_bytes(unchecked_exr(pixels))
    repaired = EnvironmentMap.read(tmp_path / "a.exr", sanitize="neighbors").radiance
    np.testing.assert_allclose(repaired[[0, 4], [0, 8]], expected[[0, 4], [0, 8]], rtol=1e-6)
    np.testing.assert_array_equal(repaired[np.isfinite(pixels)], pixels[np.isfinite(pixels)])


def test_neighbors_cannot_repair_a_channel_without_a_good_value(tmp_path):
    (tmp_path / "a.exr").write_bytes(unchecked_exr(np.full((2, 4, 3), np.nan)))
    with pytest.raises(ImageError, match="a.exr: .*no good value"):
        EnvironmentMap.read(tmp_path / "a.exr", sanitize="neighbors")


@pytest.mark.parametrize("name", ["load", "open", "from_file", "reed"])
def test_other_names_of_the_function_that_reads_a_file_get_its_name(name):
    with pytest.raises(AttributeError, match=rf"^EnvironmentMap has no '{name}' \(did you mean 'read'\?\)$"):
        getattr(EnvironmentMap, name)


def test_a_photograph_is_no_cube_map_alone():
    with pytest.raises(ImageError, match="a cube map or a photograph, expected an equirectangular map, 360° wide"):
        EnvironmentMap(np.ones((12, 16, 3)))


def test_a_cube_map_file_is_named_as_such(tmp_path):
    import OpenEXR

    path = tmp_path / "cube.exr"
    OpenEXR.File({"envmap": OpenEXR.ENVMAP_CUBE}, {"RGB": np.ones((24, 4, 3), np.float32)}).write(str(path))
    with pytest.raises(ImageError, match="cube.exr: .*looks like a cube map"):
        EnvironmentMap.read(path)


@pytest.mark.parametrize(("channels", "expected"), [(1, [0.5, 0.5, 0.5]), (3, [0.5, 1, 2]), (4, [0.5, 1, 2])])
def test_gray_becomes_rgb_and_alpha_is_dropped(tmp_path, channels, expected):
    write_image(tmp_path / "a.exr", np.broadcast_to(np.float32([0.5, 1, 2, 0.25])[:channels], (2, 4, channels)))
    np.testing.assert_array_equal(EnvironmentMap.read(tmp_path / "a.exr").radiance[1, 2], expected)


def test_a_written_map_reads_back_bit_for_bit(tmp_path):
    environment = random_map()
    environment.write(tmp_path / "a.exr")
    np.testing.assert_array_equal(EnvironmentMap.read(tmp_path / "a.exr").radiance, environment.radiance)
    with pytest.raises(ImageError, match="expected .exr"):
        environment.write(tmp_path / "a.png")


def test_a_file_of_integers_that_is_white_somewhere_cuts_a_sun_off_and_a_warning_says_so(tmp_path):
    sky = np.full((4, 8, 3), 0.25)
    write_image(tmp_path / "dim.png", sky)
    sky[1, 2], sky[0, 0] = 60, (0.1, 0.1, 1.5)
    for name in ("sky.png", "sky.jpg", "sky.exr"):
        write_image(tmp_path / name, sky)
    with pytest.warns(UserWarning, match=r"sky.png: 2 of its pixels .* a .png file holds: brighter light.* is cut off"):
        assert EnvironmentMap.read(tmp_path / "sky.png").radiance.max() == 1
    with pytest.warns(UserWarning, match="sky.jpg: .* is cut off"):
        ws.Scene([ws.Body(ws.icosphere(1.0, 0))], tmp_path / "sky.jpg")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        EnvironmentMap.read(tmp_path / "dim.png")
        EnvironmentMap.read(tmp_path / "sky.exr")


MAPS = ["apartment.exr", "city.exr", "dawn.exr", "forest.exr", "night.exr", "studio.exr", "sunset.exr", "venice.exr"]


@pytest.mark.parametrize("name", [*MAPS, "workshop.hdr"])
def test_real_maps_are_read_and_their_cells_keep_their_energy(shared_data, name):
    environment = EnvironmentMap.read(shared_data / "envmaps" / name)
    assert environment.radiance.shape == ((512, 1024, 3) if name.endswith("hdr") else (256, 512, 3))
    cells = environment.cells(fibonacci(128)).radiance.astype(np.float64)
    np.testing.assert_allclose(4 * np.pi / 128 * cells.sum(axis=0), integral(environment), rtol=ENERGY)


# ------------------------------------------------------------------------------------------------ directions


@pytest.mark.parametrize("height", [1, 2, 7, 16])
def test_directions_and_solid_angles_equal_their_twins(height):
    environment = EnvironmentMap.constant(height=height)
    for row, col in np.ndindex(height, 2 * height):
        expected = direction_twin(row + 0.5, col + 0.5, height)
        np.testing.assert_allclose(environment.directions()[row, col], expected, atol=1e-6)
    expected = [solid_angle_twin(row, height) for row in range(height)]
    np.testing.assert_allclose(environment.solid_angles(), expected, rtol=1e-12)
    np.testing.assert_allclose(environment.solid_angles().sum() * 2 * height, 4 * np.pi, rtol=1e-12)


@pytest.mark.parametrize("degrees", [0, 22.5, 90, -90, 180, 360, 3600 + 45, 0.1 + 0.2 - 0.3])
def test_turning_by_whole_pixels_moves_light_as_the_rotation_moves_its_direction(degrees):
    turned = spot(2, 5).rotated(degrees)
    assert turned.radiance.sum() == 3
    _, brightest = divmod(int(turned.radiance[..., 0].argmax()), 16)
    expected = turned_y(direction_twin(2.5, 5.5, 8), degrees)
    np.testing.assert_allclose(turned.directions()[2, brightest], expected, atol=1e-6)


@settings(max_examples=30, deadline=None)
@given(st.floats(-1000, 1000), st.integers(0, 2**32 - 1))
def test_turning_by_any_angle_keeps_the_energy_of_every_row(degrees, seed):
    environment = random_map(4, seed)
    turned = environment.rotated(degrees).radiance
    np.testing.assert_allclose(turned.sum(axis=1), environment.radiance.sum(axis=1), rtol=1e-5)


def test_turning_between_pixels_interpolates():
    turned = spot(2, 5).rotated(-22.5 * 0.25).radiance[2, :, 0]
    np.testing.assert_allclose(turned[[5, 6]], [0.75, 0.25], rtol=1e-6)


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0, (1.0, np.nan, 1.0)])
def test_factors_that_no_light_has_are_refused_by_their_names(value):
    for name, call in (
        ("factor", random_map().scaled),
        ("rgb", EnvironmentMap.constant),
        ("irradiance", functools.partial(random_map().with_sun, (0, 1, 0), angular_radius=30)),
    ):
        with pytest.raises(ImageError, match=rf"^{name}: got .*, expected numbers from 0 to 1e\+18"):
            call(value)


@pytest.mark.parametrize("degrees", [np.nan, np.inf])
def test_an_angle_must_be_finite(degrees):
    with pytest.raises(ValueError, match="degrees"):
        random_map().rotated(degrees)


@pytest.mark.parametrize(
    ("convention", "center", "right"),
    [
        ("mitsuba", Z, -X),  # φ = 2π u, d = (sin φ, ·, −cos φ)
        ("openexr", Z, -X),  # ImfEnvmap.h: longitude π at the left edge, 0 is +z, π/2 is +x
        ("usd", Z, -X),  # UsdLux DomeLight cites OpenEXR
        ("blender", X, Z),  # u = ½ − atan2(y, x)/2π; its exporters map z to y and y to −z
        ("three.js", X, Z),  # u = ½ + atan2(z, x)/2π
        ("debevec", -Z, X),  # d = (sin π(2u−1), ·, −cos π(2u−1))
    ],
)
def test_a_convention_says_where_the_file_looks(tmp_path, convention, center, right):
    height = 64
    for column, expected in ((height, center), (height * 3 // 2, right)):
        pixels = np.zeros((height, 2 * height, 3), np.float32)
        pixels[height // 2 - 1 : height // 2 + 1, column - 1 : column + 1] = 1
        write_image(tmp_path / "a.exr", pixels)
        read = EnvironmentMap.read(tmp_path / "a.exr", convention=convention)
        mean = np.einsum("hwc,hwd->d", read.radiance, read.directions())
        np.testing.assert_allclose(mean / np.linalg.norm(mean), expected, atol=1e-6)


def test_an_unknown_convention_is_refused_by_name(tmp_path):
    with pytest.raises(ValueError, match="convention: got 'Blender', .*did you mean 'blender'"):
        EnvironmentMap.read(tmp_path / "a.exr", convention="Blender")


# --------------------------------------------------------------------------------------------- scaling and SH


def test_scaling_is_linear_and_never_negative():
    environment = random_map()
    np.testing.assert_allclose(environment.scaled(3).radiance, 3 * environment.radiance)
    np.testing.assert_allclose(environment.scaled([1, 0, 2]).radiance, environment.radiance * np.float32([1, 0, 2]))
    with pytest.raises(ImageError, match=r"expected numbers from 0 to 1e\+18"):
        environment.scaled(-1)


def test_a_constant_map_projects_to_band_zero_and_a_linear_one_to_band_one():
    constant = EnvironmentMap.constant([1, 2, 3], height=64).sh(3)
    assert constant.shape == (9, 3) and constant.dtype == np.float32
    np.testing.assert_allclose(constant[0], np.sqrt(4 * np.pi) * np.array([1, 2, 3]), rtol=1e-6)
    np.testing.assert_allclose(constant[1:], 0, atol=1e-6)
    tilted = EnvironmentMap(1 + EnvironmentMap.constant(height=64).directions() * [0.5, 0.25, 1]).sh(2)
    expected = np.zeros((3, 3))  # rows y, z, x; channels x, y, z
    expected[[2, 0, 1], [0, 1, 2]] = np.sqrt(4 * np.pi / 3) * np.array([0.5, 0.25, 1])
    np.testing.assert_allclose(tilted[1:], expected, atol=PIXELATION)


@pytest.mark.slow
@pytest.mark.parametrize("height", [1, 2, 3, 4, 16])
def test_a_constant_map_of_any_height_lights_white_to_its_radiance(height):
    """In whatever light is expressed, for the method in question: "log-sh" and "none", "directional", rays."""
    normals = np.random.default_rng(3).normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    environment = EnvironmentMap.constant([1, 2, 3], height=height)
    band = sh.band_of(8)
    cosine = sh.clamped_cosine(8)[band] * np.sqrt(4 * np.pi / (2 * band + 1)) * sh.evaluate(8, normals)
    np.testing.assert_allclose(cosine @ environment.sh(8) / np.pi, np.tile([1, 2, 3], (50, 1)), rtol=1e-5)
    cells = environment.cells(fibonacci(256))
    drawn = sample_map(environment.radiance, 4096)
    for directions, energy in (
        (cells.directions, 4 * np.pi / 256 * cells.radiance),
        (drawn.directions.reshape(-1, 3), drawn.radiance.reshape(-1, 3) / len(drawn.radiance)),
    ):
        shading = np.maximum(normals @ directions.T, 0) @ energy / np.pi
        np.testing.assert_allclose(shading, np.tile([1, 2, 3], (50, 1)), rtol=5e-3)  # of 256 cells: measured 2e-3


@pytest.mark.parametrize("height", [1, 2, 3, 4])
def test_light_depends_on_what_pixels_cover_and_not_on_their_number(height):
    """A pixel and the 32 × 32 of its radiance that cover the same."""
    few, split = random_map(height, 5), 32
    many = EnvironmentMap(few.radiance.repeat(split, axis=0).repeat(split, axis=1))
    np.testing.assert_allclose(few.sh(8), many.sh(8), atol=1e-6)
    cells, expected = (each.cells(fibonacci(64)) for each in (few, many))
    edge = 0.02  # pixels are split into eighths of a cell's radius, each of which is one cell's: measured 1.1%
    assert np.linalg.norm(cells.radiance - expected.radiance) < edge * np.linalg.norm(expected.radiance)
    np.testing.assert_allclose(cells.directions, expected.directions, atol=edge)


@pytest.mark.parametrize("height", [2, 4, 8])
@pytest.mark.parametrize("degrees", [90, 180, -90])
def test_harmonics_of_a_turned_map_are_turned_harmonics(height, degrees):
    environment = random_map(height, 6)
    rotation = np.stack([turned_y(axis, degrees) for axis in np.eye(3)], axis=1)
    expected = sh.harmonic_rotation(6, rotation) @ environment.sh(6)
    np.testing.assert_allclose(environment.rotated(degrees).sh(6), expected, atol=1e-6)


# ------------------------------------------------------------------------------------------------ cells


def cells_twin(environment, directions, split):
    """Every sub-pixel to the nearest direction, one at a time, in float64."""
    height = len(environment.radiance)
    (energy, moment), squares = np.zeros((2, len(directions), 3)), np.zeros((len(directions), 4))
    for row, col in np.ndindex(height * split, 2 * height * split):
        towards = direction_twin(row + 0.5, col + 0.5, height * split)
        light = environment.radiance[row // split, col // split] * solid_angle_twin(row, height * split)
        owner = np.argmin(np.linalg.norm(directions - towards, axis=1))
        energy[owner] += light
        moment[owner] += light @ LUMINANCE * towards
        squares[owner] += (light @ LUMINANCE) ** 2 / solid_angle_twin(row, height * split) * np.append(towards, 1)
    return energy, moment, squares


def test_cells_and_their_moments_equal_their_twins():
    environment, directions = random_map(8), fibonacci(10)
    energy, moment, squares = cells_twin(environment, directions, split=int(np.ceil(4 * np.pi * np.sqrt(10) / 8)))
    cells = environment.cells(directions).radiance
    assert cells.dtype == np.float32
    np.testing.assert_allclose(cells, energy * 10 / (4 * np.pi), rtol=1e-5)
    _, mean, spots, spreads = environment.cells(directions)
    np.testing.assert_allclose(mean, moment / np.linalg.norm(moment, axis=1)[:, None], atol=1e-5)
    length = np.linalg.norm(squares[:, :3], axis=1)
    np.testing.assert_allclose(spots, squares[:, :3] / length[:, None], atol=1e-5)
    np.testing.assert_allclose(spreads, np.arccos(2 * length / squares[:, 3] - 1), atol=1e-5)


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 200), st.integers(1, 12), st.integers(0, 2**32 - 1))
def test_cells_keep_the_energy_for_any_directions(count, height, seed):
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    environment = random_map(height, seed)
    total = 4 * np.pi / count * environment.cells(directions).radiance.astype(np.float64).sum(axis=0)
    np.testing.assert_allclose(total, integral(environment), rtol=ENERGY)


def test_cells_of_an_even_light_are_even_and_as_wide_as_their_solid_angle():
    directions = fibonacci(128)
    environment = EnvironmentMap.constant(2.0, height=128)
    np.testing.assert_allclose(environment.cells(directions).radiance, 2, rtol=0.1)  # Fibonacci cells vary by 6%
    np.testing.assert_allclose(environment.cells(directions).half_angles, 2 / np.sqrt(128), rtol=0.1)


def test_a_point_light_has_its_own_direction_and_no_spread():
    environment = spot(20, 30, height=64)
    towards = direction_twin(20.5, 30.5, 64)
    directions = fibonacci(32)
    _, mean, spots, spreads = environment.cells(directions)
    lit = np.argmax(environment.cells(directions).radiance[:, 0])
    assert lit == np.argmax(directions @ towards)
    np.testing.assert_allclose([mean[lit], spots[lit]], [towards, towards], atol=1e-3)
    assert spreads[lit] < np.pi / 64
    dark = np.arange(32) != lit
    np.testing.assert_allclose([mean[dark], spots[dark]], [directions[dark], directions[dark]], atol=1e-6)
    np.testing.assert_allclose(spreads[dark], np.arccos(1 - 2 / 32), rtol=1e-6)  # a cap of 4π/32


def test_the_sky_around_a_sun_does_not_widen_it():
    sun, directions = EnvironmentMap(2000 * spot(20, 30, height=64).radiance), fibonacci(32)
    lit = np.argmax(sun.cells(directions).radiance[:, 0])
    both = EnvironmentMap(sun.radiance + np.float32(1)).cells(directions)
    np.testing.assert_allclose(both.spots[lit], direction_twin(20.5, 30.5, 64), atol=1e-3)
    assert both.half_angles[lit] < 1.1 * np.pi / 64  # a tenth of its cell
    assert both.directions[lit] @ both.spots[lit] < np.cos(np.radians(0.3))  # the mean of both is beside it


@pytest.mark.parametrize("directions", [np.zeros((0, 3)), np.ones((4, 3)), np.full((4, 3), np.nan), np.ones(3)])
def test_cells_want_unit_vectors(directions):
    with pytest.raises(ValueError, match="directions: "):
        random_map().cells(directions)


# ------------------------------------------------------------------------------------------------ statistics


def test_statistics_describe_a_map_in_plain_numbers():
    import json

    environment = EnvironmentMap(spot(2, 5, height=16).radiance * 9 + 1)
    statistics = json.loads(json.dumps(environment.statistics()))
    assert (statistics["width"], statistics["height"]) == (32, 16)
    assert (statistics["min_radiance"], statistics["max_radiance"]) == ([1] * 3, [10] * 3)
    np.testing.assert_allclose(statistics["integral"], integral(environment), rtol=1e-6)
    np.testing.assert_allclose(statistics["mean_radiance"], integral(environment) / (4 * np.pi), rtol=1e-6)
    np.testing.assert_allclose(statistics["brightest_direction"], direction_twin(2.5, 5.5, 16), atol=1e-6)
    share = (0.04 * np.pi + 9 * solid_angle_twin(2, 16)) / integral(environment)[0]
    np.testing.assert_allclose(statistics["brightest_percent_share"], share, rtol=1e-6)


def test_an_even_map_has_a_hundredth_of_its_energy_in_a_hundredth_of_the_sphere():
    np.testing.assert_allclose(EnvironmentMap.constant().statistics()["brightest_percent_share"], 0.01, rtol=1e-6)
    assert EnvironmentMap.constant(0).statistics()["brightest_percent_share"] == 0


# ---------------------------------------------------------------------------------------- maps from a formula


def irradiance_on_the_ground(environment, split=256):
    """∫ L max(cos θ, 0) dω over what the pixels cover, by many rows in each, [RGB]."""
    height = len(environment.radiance) * split
    theta = np.pi * (np.arange(height) + 0.5) / height
    rows = np.repeat(environment.radiance.astype(np.float64).sum(axis=1), split, axis=0)
    azimuth = 2 * np.pi / (2 * len(environment.radiance))
    return azimuth * np.pi / height * np.maximum(np.cos(theta), 0) * np.sin(theta) @ rows


@pytest.mark.parametrize("height", [2, 3, 4, 32])
def test_a_sky_of_any_height_has_the_irradiance_it_promises(height):
    sky = synthetic_sky(sun_strength=0, height=height)
    np.testing.assert_allclose(irradiance_on_the_ground(sky) @ LUMINANCE, np.pi, rtol=1e-4)


@pytest.mark.parametrize("sun", [(0.5, 0.7, 0.2), (0, 1, 0), (0, 0.1, -1)])
def test_the_sky_and_the_sun_have_the_irradiance_they_promise(sun):
    height = 64
    sun = np.array(sun) / np.linalg.norm(sun)
    bright, dim = (synthetic_sky(3 * sun, sun_strength=strength, height=height) for strength in (3.0, 0.0))
    weights = np.array([solid_angle_twin(row, height) for row in range(height)])[:, None]
    towards = dim.directions().astype(np.float64)
    up = towards[..., 1] > 0
    np.testing.assert_allclose(irradiance_on_the_ground(dim) @ LUMINANCE, np.pi, rtol=1e-5)
    only_sun = (bright.radiance.astype(np.float64) - dim.radiance) @ LUMINANCE * up * weights
    np.testing.assert_allclose(only_sun.sum(), 3 * np.pi, rtol=1e-4)
    mean = np.einsum("hw,hwd->d", only_sun, towards) / only_sun.sum()
    np.testing.assert_allclose(mean, sun, atol=np.pi / height)


def test_the_sun_reddens_as_it_sinks_and_is_gone_below_the_horizon():
    def red_over_blue(sky):
        row, col = np.unravel_index(np.argmax(sky.radiance @ LUMINANCE), sky.radiance.shape[:2])
        return sky.radiance[row, col, 0] / sky.radiance[row, col, 2]

    high, low = synthetic_sky((0, 1, 1), height=64), synthetic_sky((0, 0.1, 1), height=64)
    assert red_over_blue(low) > 2 * red_over_blue(high)
    assert synthetic_sky((0, -0.5, 1), height=64).radiance.max() < 0.05 * high.radiance.max()


def test_the_ground_reflects_what_it_gets():
    white, black = (synthetic_sky((0, 1, 0), ground_albedo=albedo, height=64) for albedo in (1.0, 0.0))
    down = (white.radiance[-1] - black.radiance[-1]) @ LUMINANCE
    np.testing.assert_allclose(down, 1 + 3, rtol=1e-2)  # the sky's π and three times that from a sun overhead


@pytest.mark.parametrize("sun", [(0, 0, 0), (0, np.nan, 1), (1, 0)])
def test_a_sun_needs_a_direction(sun):
    with pytest.raises(ValueError, match="sun_direction"):
        synthetic_sky(sun)


# ------------------------------------------------------------------------------------------------ suns


@pytest.mark.parametrize("angular_radius", [0.27, 3.0, 20.0, 60.0])
def test_a_sun_has_its_irradiance_direction_and_size(angular_radius):
    dim = random_map(16)
    direction = np.array([-0.4, 0.7, 0.5])
    lit = dim.with_sun(direction, (3.0, 2.0, 1.0), angular_radius=angular_radius)
    assert np.pi / len(lit.radiance) <= np.radians(angular_radius)
    divided = dim.radiance.repeat(len(lit.radiance) // 16, axis=0).repeat(len(lit.radiance) // 16, axis=1)
    sun = lit.radiance.astype(np.float64) - divided
    weights = np.array([solid_angle_twin(row, len(sun)) for row in range(len(sun))])
    mean = np.einsum("h,hw,hwx->x", weights, sun[..., 0], lit.directions())
    unit = direction / np.linalg.norm(direction)
    facing = np.maximum(lit.directions() @ unit, 0)
    np.testing.assert_allclose(np.einsum("h,hw,hwc->c", weights, facing, sun), (3, 2, 1), rtol=1e-3)
    assert np.degrees(np.arccos(mean @ unit / np.linalg.norm(mean))) < 0.15 * angular_radius
    angles = np.degrees(np.arccos(np.clip(lit.directions() @ unit, -1, 1)))
    assert angles[sun[..., 0] > 1e-3].max() < angular_radius + 180 / len(sun)


def test_suns_that_no_map_holds_are_refused():
    with pytest.raises(ValueError, match=r"angular_radius: got 0.001, expected 0.044 or more, for which this map gets"):
        random_map(16).with_sun(Y, 1, angular_radius=0.001)
    with pytest.raises(ValueError, match="direction: got a zero vector"):
        random_map(16).with_sun((0, 0, 0), 1)
    with pytest.raises(ValueError, match="angular_radius: got 120, expected degrees up to 90"):
        random_map(16).with_sun(Y, 1, angular_radius=120)
    with pytest.raises(ValueError, match="radius: got 4, expected a map infinitely far away"):
        EnvironmentMap.constant(1.0, radius=4.0).with_sun(Y, 1)
    with pytest.raises(TypeError, match="angular_radius, in degrees"):
        random_map(16).with_sun(Y, 1, radius=2)


def test_coarse_light_has_the_same_integral():
    light = EnvironmentMap(np.random.default_rng(0).uniform(0, 5, (256, 512, 3)).astype(np.float32))
    small = light.coarsened(64)
    assert small.radiance.shape == (64, 128, 3)
    np.testing.assert_allclose(small.statistics()["integral"], light.statistics()["integral"], rtol=1e-3)
    assert EnvironmentMap.constant(1.0).coarsened(64).radiance.shape == (16, 32, 3)
    near = EnvironmentMap(light.radiance, radius=3.0, center=(0, 1, 0)).coarsened(64)
    assert near.radius == 3 and near.center.tolist() == [0, 1, 0]


def test_light_in_harmonics_answers_as_a_map_does_and_goes_on_as_it_came():
    coefficients = np.random.default_rng(0).normal(size=(9, 3)).astype(np.float32)
    light, light_map = as_light(coefficients), EnvironmentMap.constant(1.0)
    assert as_light(light_map) is light_map and light_map.as_argument is light_map
    np.testing.assert_array_equal(light.as_argument, coefficients)
    assert light.coarsened(4) == light and light.shell is None and light_map.shell is None
    assert not {name for name in dir(light) if name[0] != "_"} - {"coefficients"} - set(dir(light_map))
