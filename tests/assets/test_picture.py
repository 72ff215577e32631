"""Pictures: exposure, tone, background and alpha against sRGB by hand; what notebooks and Pillow get."""

import io
import warnings

import numpy as np
import pytest

import warpshadow as ws
from warpshadow.assets.color import filmic

RANDOM = np.random.default_rng(0)
STEP = 0.5 + 1e-6  # of 8 bits: half a code, by rounding


def encoded(linear):
    """sRGB by IEC 61966-2-1, in codes."""
    linear = np.clip(linear, 0, 1)
    return 255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def image(height=6, width=8):
    """Straight colors and coverage, 0 and 1 among them."""
    alpha = RANDOM.random((height, width, 1))
    alpha[0], alpha[1] = 0, 1
    return RANDOM.random((height, width, 3)) * 3, alpha


def test_a_transparent_picture_has_straight_alpha():
    color, alpha = image()
    picture = ws.Picture(np.concatenate([alpha * color, alpha], axis=2), exposure=-1)
    assert picture.pixels.dtype == np.uint8 and picture.pixels.shape == (6, 8, 4)
    assert np.abs(picture.pixels[1:, :, :3] - encoded(color[1:] / 2)).max() <= STEP
    assert np.abs(picture.pixels[..., 3:] - 255 * alpha).max() <= STEP
    assert not picture.pixels[0].any()


def test_a_color_behind_is_seen_as_it_is():
    color, alpha = image()
    premultiplied = np.concatenate([alpha * color, alpha], axis=2)
    for background, linear in [((0.2, 1.0, 0.0), (0.2, 1.0, 0.0)), ("white", 1.0), ("#000", 0.0)]:
        picture = ws.Picture(premultiplied, exposure=-1, background=background)
        expected = alpha * np.clip(color / 2, 0, 1) + (1 - alpha) * np.array(linear)
        assert np.abs(picture.pixels - encoded(expected)).max() <= STEP


@pytest.mark.parametrize("tone", ["clip", "filmic"])
def test_an_image_behind_is_exposed_with_the_rest(tone):
    color, alpha = image()
    behind = RANDOM.random((6, 8, 3)) * 2
    image_ = np.concatenate([alpha * color, alpha], axis=2)
    picture = ws.Picture(image_, exposure=0.5, background=behind, tone=tone)
    shown = (alpha * color + (1 - alpha) * behind) * 2**0.5
    if tone == "filmic":
        shown = shown * (2.51 * shown + 0.03) / (shown * (2.43 * shown + 0.59) + 0.14)
    assert np.abs(picture.pixels - encoded(shown)).max() <= STEP


def test_without_an_exposure_the_brightest_hundredth_of_what_is_covered_saturates():
    covered = np.concatenate([RANDOM.random((50, 40, 3)) * 8, np.ones((50, 40, 1))], axis=2)
    picture = ws.Picture(np.concatenate([covered, np.zeros((50, 40, 4))]))
    brightest = np.percentile(covered[..., :3].max(axis=2), 99)
    assert picture.exposure == pytest.approx(-np.log2(brightest))
    assert 0 < (picture.pixels[:50, :, :3] == 255).any(axis=2).mean() <= 0.03
    assert ws.Picture(covered[..., :3]).exposure == picture.exposure
    assert ws.Picture(np.zeros((2, 2, 4))).exposure == 0


def test_the_filmic_curve_rises_from_0_to_1():
    curve = filmic(np.concatenate([[0], np.geomspace(1e-6, 1e18, 500)]))
    assert curve[0] == 0 and curve[-1] == 1 and (np.diff(curve) >= 0).all()
    assert filmic(np.array(0.18)) == pytest.approx(0.2669, abs=1e-4)  # by hand: 0.086724 / 0.324932


@pytest.mark.parametrize("value", [-3.0, 1e18, 3e38, np.inf])
@pytest.mark.parametrize("tone", ["clip", "filmic"])
def test_any_value_has_a_color(value, tone):
    pixels = np.full((2, 2, 4), value)
    pixels[..., 3] = 0.5
    for background in (None, "white", np.ones((2, 2, 3))):
        assert (ws.Picture(pixels, tone=tone, background=background).pixels[..., :3] >= 0).all()
    assert ws.Picture(pixels, exposure=0, tone=tone).pixels[0, 0, 0] == (0 if value < 0 else 255)


def test_pillow_and_notebooks_get_the_same_pixels():
    from PIL import Image

    for channels in (1, 3, 4):
        picture = ws.Picture(RANDOM.random((5, 7, channels)))
        drawn = Image.open(io.BytesIO(picture._repr_png_()))
        np.testing.assert_array_equal(np.asarray(drawn).reshape(picture.pixels.shape), picture.pixels)
        assert channels == 1 or Image.fromarray(picture.pixels).size == (7, 5)
    assert repr(picture).startswith("Picture(7 × 5, ")


def test_without_alpha_what_is_transparent_is_white():
    color, alpha = image()
    picture = ws.Picture(np.concatenate([alpha * color, alpha], axis=2), exposure=-2)
    expected = encoded(alpha * color / 4 + 1 - alpha)
    assert np.abs(picture.opaque() - expected).max() <= 2  # rounded twice
    assert picture.opaque().shape == (6, 8, 3)


@pytest.mark.parametrize("tone", ["clip", "filmic"])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_a_written_picture_reads_as_radiance_again(tmp_path, tone, channels):
    path = tmp_path / "x.png"
    linear = np.geomspace(0.1, 6, 6 * 8).reshape(6, 8, 1).repeat(channels, axis=2).astype(np.float32)
    linear[..., 3:] = 1
    ws.Picture(linear, exposure=-3.0, tone=tone).write(path)
    np.testing.assert_allclose(ws.read_image(path, undo_exposure=True), linear, rtol=0.06)
    message = rf"exposed by -3.00 stops, tone {tone}, .* undo_exposure=True reads the radiance"
    with pytest.warns(UserWarning, match=message) as caught:
        shown = ws.read_image(path)
    assert caught[0].filename == __file__ and shown[..., 0].max() < 0.9
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_array_equal(ws.read_image(path, undo_exposure=False), shown)
        ws.write_image(path, linear[..., :1])  # as it is
        ws.read_image(path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"image": np.zeros((2, 2, 5))}, r"image: got shape \(2, 2, 5\)"),
        ({"image": np.full((2, 2, 3), np.nan)}, "image: got 12 NaN values"),
        ({"image": np.zeros((2, 2, 3), np.uint8)}, "image: got values of uint8"),
        ({"exposure": 101}, "exposure: got 101, expected -100 to 100 stops"),
        ({"exposure": "auto"}, "exposure: got 'auto'"),
        ({"tone": "aces"}, "tone: got 'aces', expected one of 'clip', 'filmic'"),
        ({"background": "wite"}, "background: got 'wite', expected a color such as 'white'"),
        ({"background": (1, 2, 0)}, "background: got 1 values out of range"),
        ({"background": np.zeros((3, 2, 3))}, r"background: got shape \(3, 2, 3\)"),
        ({"image": np.zeros((2, 2, 3)), "background": "white"}, "background: got one behind an image"),
    ],
)
def test_a_picture_names_the_argument_it_refuses(arguments, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        ws.Picture(**{"image": np.zeros((2, 2, 4))} | arguments)


# ------------------------------------------------------------------------------------------------ the light behind


def test_a_map_is_seen_where_its_pixels_are():
    light = ws.EnvironmentMap(RANDOM.random((8, 16, 3)))
    np.testing.assert_allclose(light.radiance_from(light.directions()), light.radiance, atol=1e-5)
    turned = np.radians(360 / 16 * 3.5)  # φ = 2π (column + ½) / 16: between columns 2 and 3
    between = light.radiance_from([np.sin(turned - np.pi / 16), 0, -np.cos(turned - np.pi / 16)])
    np.testing.assert_allclose(between, light.radiance[3:5, 2:4].mean(axis=(0, 1)), atol=1e-6)


@pytest.mark.parametrize("kind", ["map", "harmonics"])
def test_the_background_of_a_scene_is_its_light(kind):
    """Light that is 1 + y in luminance: seen by rays of the pixels."""
    height = 64
    y = ws.EnvironmentMap.constant(1.0, height).directions()[..., 1:2]
    light = ws.EnvironmentMap(np.broadcast_to(1 + y, (height, 2 * height, 3)))
    camera = ws.Camera.look_at((0, 0, 5), (0, 0.3, 0), fov_y=70, size=(12, 10))
    scene = ws.Scene([ws.Body(ws.icosphere(1.0, 1))], light if kind == "map" else light.sh(2), camera)
    _, directions = camera.rays()
    expected = np.broadcast_to(1 + directions[..., 1:2], (10, 12, 3))
    assert scene.background().dtype == np.float32
    np.testing.assert_allclose(scene.background(), expected, atol=4e-3)


def test_a_map_draws_itself_in_notebooks():
    from PIL import Image

    light = ws.synthetic_sky(height=1024)
    drawn = Image.open(io.BytesIO(light._repr_png_()))
    assert drawn.size == (512, 256) and drawn.mode == "RGB"
    small = ws.EnvironmentMap(RANDOM.random((4, 8, 3)))
    np.testing.assert_array_equal(
        np.asarray(Image.open(io.BytesIO(small._repr_png_()))), ws.Picture(small.radiance).pixels
    )
