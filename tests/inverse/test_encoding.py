"""Photographs as files: their encoding, exposure, white balance and lens."""

import warnings

import numpy as np
import pytest
import torch
from PIL import Image, ImageCms, PngImagePlugin

import warpshadow as ws
from warpshadow.assets.lens import distorted, undistorted
from warpshadow.inverse import Exposure, Problem, Target, load_fit
from warpshadow.inverse.encoding import guess_encoding, toml_value
from warpshadow.inverse.model import Model
from warpshadow.inverse.schedule import Stage
from warpshadow.scene.files import parse_camera

# Codes of eight bits, decoded at a slope of up to 2.3.
EIGHT_BITS = 2.3 / 255
CODES = np.linspace(0, 255, 24).reshape(2, 4, 3).astype(np.uint8)
LENS = np.array([-0.21, 0.08, 0.004, -0.003, 0.01])


def write_png(path, gamma=None, is_srgb=False, has_profile=False):
    chunks = PngImagePlugin.PngInfo()
    if is_srgb:
        chunks.add(b"sRGB", b"\0")
    if gamma is not None:
        chunks.add(b"gAMA", round(1e5 * gamma).to_bytes(4, "big"))
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes() if has_profile else None
    Image.fromarray(CODES).save(path, pnginfo=chunks, icc_profile=profile)
    return path


@pytest.mark.parametrize(
    ("chunks", "encoding"),
    [
        ({}, "srgb"),
        ({"gamma": 0.45455}, "srgb"),
        ({"gamma": 1.0}, "linear"),
        ({"gamma": 1 / 1.8}, 1.8),
        ({"gamma": 1.0, "is_srgb": True}, "srgb"),
        ({"gamma": 1.0, "has_profile": True}, "srgb"),
        ({"gamma": 1 / 1.8, "has_profile": True}, "srgb"),
    ],
)
def test_a_png_says_how_it_is_encoded(tmp_path, chunks, encoding):
    path = write_png(tmp_path / "photo.png", **chunks)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        target = Target(path)
    assert target.encoding == pytest.approx(encoding) if isinstance(encoding, float) else target.encoding == encoding
    assert bool(caught) == (encoding != "srgb")  # said where it is not the usual one
    codes = CODES / 255
    linear = {"srgb": ws.srgb_to_linear(codes), "linear": codes}.get(encoding, codes**1.8)
    np.testing.assert_allclose(target.image, linear, atol=1e-4)


def test_sixteen_bits_without_a_word_are_linear(tmp_path):
    codes = np.linspace(0, 65535, 8).reshape(2, 4).astype(np.uint16)
    Image.fromarray(codes).save(tmp_path / "gray.png")
    with pytest.warns(UserWarning, match='taken for encoding = "linear", since it has 16 bits'):
        target = Target(tmp_path / "gray.png")
    np.testing.assert_allclose(target.image[..., 0], codes / 65535, atol=1e-5)
    Image.fromarray(codes).save(tmp_path / "gray.tif")
    with pytest.warns(UserWarning, match='taken for encoding = "linear", since it has 16 bits'):
        np.testing.assert_allclose(Target(tmp_path / "gray.tif").image, target.image)
    assert Target(tmp_path / "gray.png", encoding="srgb").image[0, 1, 0] < 0.6 * target.image[0, 1, 0]


def test_other_files_are_as_their_formats_are(tmp_path):
    ws.write_image(tmp_path / "a.exr", CODES / 255.0)
    assert guess_encoding(tmp_path / "a.exr") == "linear"
    np.testing.assert_allclose(Target(tmp_path / "a.exr", encoding=2.2).image, (CODES / 255) ** 2.2, atol=1e-6)
    ws.write_image(tmp_path / "a.jpg", CODES / 255.0)
    assert guess_encoding(tmp_path / "a.jpg") == "srgb"


def camera_response(radiance):
    """A tone curve of no known form, from 0 to 2 in radiance."""
    return np.log1p(9 * radiance / 2) / np.log(10)


def test_a_response_curve_is_undone(tmp_path):
    radiance = np.linspace(0, 2, 4000)
    samples = np.stack([radiance, camera_response(radiance)], axis=1)
    truth = 2 * np.random.default_rng(0).random((4, 6, 3))
    Image.fromarray(np.round(255 * camera_response(truth)).astype(np.uint8)).save(tmp_path / "photo.png")
    target = Target(tmp_path / "photo.png", encoding=samples, saturation=0.9)
    np.testing.assert_allclose(target.image, truth, atol=0.012)  # half a code at a slope of up to 4.6 / 255
    np.testing.assert_array_equal(target.saturated, target.image >= 2 * (10**0.9 - 1) / 9 - 1e-4)
    np.savetxt(tmp_path / "curve.csv", samples, delimiter=",", header="radiance,value", comments="")
    np.testing.assert_allclose(Target(tmp_path / "photo.png", encoding=tmp_path / "curve.csv").image, target.image)
    ws.write_image(tmp_path / "photo.exr", camera_response(truth))  # of a linear file, too
    np.testing.assert_allclose(Target(tmp_path / "photo.exr", encoding=samples).image, truth, atol=1e-5)


def test_a_response_curve_may_differ_by_color(tmp_path):
    codes = CODES / 255
    Image.fromarray(CODES).save(tmp_path / "photo.png")
    value = np.linspace(0, 1, 256)[:, None]
    target = Target(tmp_path / "photo.png", encoding=np.concatenate([value * (3.0, 2.0, 1.0), value], axis=1))
    np.testing.assert_allclose(target.image, codes * (3.0, 2.0, 1.0), atol=1e-5)


@pytest.mark.parametrize(
    ("samples", "message"),
    [
        ([[0, 0], [1, 255]], "got a curve of values from 0 to 255, expected all from 0 to 1; of codes of 8 bits"),
        ([[0, 0], [0.5, 0.6], [0.4, 1]], r"got \[0.5, 0.6\] and then \[0.4, 1.0\] in a curve"),
        ([[0, 0, 0], [1, 1, 1]], r"got a curve of shape \(2, 3\), expected rows of radiance and value"),
        ([[0, 0], [np.nan, 1]], "got 1 NaN or Inf values"),
    ],
)
def test_curves_that_are_none_are_refused(tmp_path, samples, message):
    Image.fromarray(CODES).save(tmp_path / "photo.png")
    with pytest.raises(ValueError, match=message):
        Target(tmp_path / "photo.png", encoding=samples)
    np.savetxt(tmp_path / "curve.csv", samples, delimiter=",")
    with pytest.raises(ValueError, match=f"curve.csv: .*{message}"):
        Target(tmp_path / "photo.png", encoding=tmp_path / "curve.csv")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("value,radiance\n0,0\n1,1", 'got columns value, radiance, expected the last to be "value"'),
        ("0,0\n1,one", "could not convert string to float: 'one'"),
        ("", r"got a curve of shape \(0,\)"),
    ],
)
def test_files_that_hold_no_curve_are_refused(tmp_path, text, message):
    (tmp_path / "curve.csv").write_text(text)
    with pytest.raises(ValueError, match=f"curve.csv: encoding: {message}"):
        Target(tmp_path / "photo.png", encoding=tmp_path / "curve.csv")


def test_exposure_and_white_balance_are_divided_out():
    image = np.full((2, 3, 3), 0.4)
    target = Target(image, exposure=-1.0, white_balance=(2.0, 1.0, 0.5))
    np.testing.assert_allclose(target.image[0, 0], (0.4, 0.8, 1.6), rtol=1e-6)


def test_undistorted_pixels_are_where_the_lens_images_them():
    camera = ws.Camera(np.array([[80.0, 0, 33], [0, 75, 25], [0, 0, 1]]), np.eye(3), np.zeros(3), 64, 48)
    column, row = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    taken = np.stack([column, row, 2 * column - row], axis=-1)  # linear in the place, so bilinear samples are exact
    pinhole = undistorted(taken, camera, LENS)
    for i, j in ((24, 32), (5, 10), (40, 55)):
        x, y = (j + 0.5 - 33) / 80, (i + 0.5 - 25) / 75
        r2 = x * x + y * y
        k1, k2, p1, p2, k3 = LENS
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        u = 80 * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + 33
        v = 75 * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + 25
        np.testing.assert_allclose(pinhole[i, j], (u, v, 2 * u - v), atol=1e-4)
    np.testing.assert_allclose(undistorted(taken, camera, 0 * LENS), taken, atol=1e-4)


def test_pixels_that_the_lens_did_not_see_do_not_count():
    camera = ws.Camera(np.array([[40.0, 0, 16], [0, 40, 12], [0, 0, 1]]), np.eye(3), np.zeros(3), 32, 24)
    target = Target(np.full((24, 32, 3), 0.5), camera=camera, distortion=[0.4, 0, 0, 0])
    assert target.mask[0, 0] == 0 and target.mask[12, 16] == 1 and not target.image[0, 0].any()
    corner = distorted(np.array([-15.5 / 40, -11.5 / 40]), np.array([0.4, 0, 0, 0, 0]))
    assert 40 * corner[0] + 16 < 0  # beyond the image


def test_intrinsics_with_centers_at_whole_numbers_are_moved_by_half_a_pixel():
    table = {"intrinsics": [[70, 0, 32], [0, 70, 24], [0, 0, 1]], "rotation": np.eye(3), "translation": [0, 0, 4]}
    table |= {"size": [64, 48]}
    half, whole = parse_camera(table), parse_camera(table | {"pixel_centers": "whole"})
    np.testing.assert_allclose(whole.intrinsics - half.intrinsics, [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    expected = ws.Camera.from_opencv(np.eye(3), [0, 0, 4], table["intrinsics"], (64, 48))
    np.testing.assert_allclose(whole.intrinsics, expected.intrinsics)
    with pytest.raises(ValueError, match="pixel_centers: got 'corner'"):
        parse_camera(table | {"pixel_centers": "corner"})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"encoding": "rec709"}, "encoding: got 'rec709'"),
        ({"encoding": 0}, "encoding: got 0"),
        ({"encoding": "srgb"}, "encoding: got 'srgb' for an array"),
        ({"white_balance": (1, 0, 1)}, "white_balance: got"),
        ({"exposure": "1"}, "exposure: got"),
        ({"distortion": (0.1, 0, 0, 0)}, "distortion: got it without a camera"),
    ],
)
def test_mistakes_are_named(options, message):
    with pytest.raises(ValueError, match="encoding|white|exposure|distortion") as caught:
        Target(np.full((4, 4, 3), 0.5), **options)
    assert message in str(caught.value)


def one_ball() -> ws.Scene:
    light = np.zeros((4, 3))
    light[0], light[2] = 2.0, 0.7
    camera = ws.Camera.look_at((0, 1, 4), (0, 0, 0), size=(16, 12))
    return ws.Scene((ws.Body(ws.icosphere(1.0, 2), blockers=0),), light, camera, ws.Visibility("none"))


def test_white_balance_is_a_gain_of_each_color():
    problem = Problem(one_ball(), Target(np.full((12, 16, 3), 0.3)), Exposure(white_balance=True), still=None)
    context = problem.context(torch.device("cpu"))
    model, values = Model(problem, context, Stage()), problem.start(context)
    with torch.no_grad():
        before = model.images(values)
        values["exposure"]["log"] += np.log(2.0)
        values["exposure"]["log_white"] += torch.tensor([[np.log(3.0), np.log(0.5)]], dtype=torch.float32)
        after = model.images(values)
    np.testing.assert_allclose(after[..., :3], before[..., :3] * torch.tensor([6.0, 2.0, 1.0]), rtol=1e-5)
    fitted = problem.fitted_scene(values, context)
    assert fitted.exposures == pytest.approx([2.0])
    assert fitted.white_balances[0] == pytest.approx((3.0, 1.0, 0.5))


def test_a_fit_file_has_the_same_keys(tmp_path):
    ws.write_scene(one_ball(), tmp_path)
    write_png(tmp_path / "photo.png")
    (tmp_path / "fit.toml").write_text(
        'scene = "scene.toml"\n[[target]]\nimage = "photo.png"\nencoding = "linear"\nexposure = 1.0\n'
        "white_balance = [1.0, 2.0, 1.0]\ndistortion = [0.01, 0.0, 0.0, 0.0, 0.0]\n[target.camera]\n"
        'intrinsics = [[10, 0, 2], [0, 10, 1], [0, 0, 1]]\npixel_centers = "whole"\n'
        "rotation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\ntranslation = [0, 0, 3]\n"
        "[free]\nexposure = {white_balance = true}\n"
    )
    problem = load_fit(tmp_path / "fit.toml").problem
    (target,) = problem.targets
    assert target.camera.intrinsics[0, 2] == 2.5 and problem.free == (Exposure(white_balance=True),)
    plain = CODES / 255 / np.array([2.0, 4.0, 2.0])
    np.testing.assert_allclose(target.image[1, 2], plain[1, 2], atol=0.02)


def test_a_fit_file_names_a_response_curve(tmp_path):
    ws.write_scene(one_ball(), tmp_path)
    lines = 'scene = "scene.toml"\n[[target]]\nimage = "photo.png"\nencoding = "curve.csv"\n[free]\nlight = true\n'
    (tmp_path / "fit.toml").write_text(lines)
    codes = CODES.repeat(3, axis=0).repeat(2, axis=1)
    Image.fromarray(codes).save(tmp_path / "photo.png")
    with pytest.raises(FileNotFoundError, match="encoding: .*curve.csv"):
        load_fit(tmp_path / "fit.toml")
    (tmp_path / "curve.csv").write_text("# of the camera\nradiance,value\n0,0\n0.2,0.5\n1,1\n")
    (target,) = load_fit(tmp_path / "fit.toml").problem.targets
    np.testing.assert_allclose(target.image, np.interp(codes / 255, (0, 0.5, 1), (0, 0.2, 1)), atol=1e-5)
    assert toml_value(target.encoding) == "curve.csv"


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("tone", ["clip", "filmic"])
def test_a_picture_of_our_own_is_the_linear_image_again(tmp_path, tone, suffix):
    linear = np.geomspace(0.05, 50.0, 32 * 32).reshape(32, 32, 1).repeat(3, axis=2)
    picture = ws.Picture(linear, exposure=-1.5, tone=tone)
    path = tmp_path / f"x{suffix}"
    picture.write(path)
    target, codes = Target(path), picture.pixels
    if suffix == ".png":
        np.testing.assert_array_equal(target.saturated, codes == 255)
    kept = (codes < 215) & (codes > 20)  # filmic is flat above, and a code a large step
    np.testing.assert_allclose(target.image[kept], linear[kept], rtol=0.06 if suffix == ".jpg" else 0.04)
    np.testing.assert_allclose(Target(path, exposure=0.0).image, 2**-1.5 * target.image, rtol=1e-5)
    Image.open(path).save(path)  # by other programs, which may leave comments out
    assert Target(path).saturated is None or suffix == ".jpg"


def test_a_picture_on_nothing_is_premultiplied_again(tmp_path):
    image = np.array([[[0.4, 0.2, 0.1, 0.5], [3.0, 1.5, 0.5, 1.0], [0, 0, 0, 0]]], np.float32)
    ws.write_image(tmp_path / "x.png", ws.Picture(image, exposure=-2.0))
    np.testing.assert_allclose(Target(tmp_path / "x.png").image, image, rtol=0.03)
