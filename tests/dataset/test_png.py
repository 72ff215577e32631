"""Layers in PNG: what is read is what EXR has, but for rounding, and what is said of a picture is enough to read it."""

import io
import json
import tarfile
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import warpshadow as ws
from warpshadow.assets.image import ImageError
from warpshadow.dataset import DataSet, Recipe, read_shard, write_shards
from warpshadow.dataset.png import Even, Srgb, as_png, from_png

LAYERS = ("color", "shadow", "depth", "normals", "bodies", "masks")


def there_and_back(values, coding):
    channels = {name: values[..., k].astype(np.float32) for k, name in enumerate("RGBA"[: values.shape[2]])}
    content, about = as_png(channels, coding)
    found = from_png(content, json.loads(json.dumps(about)))
    return np.stack([found[name] for name in channels], axis=-1), about


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    """The same samples as EXR and as PNG, in a shard each."""
    recipe = Recipe(2, seed=4, size=(24, 16), layers=LAYERS, visibility=ws.Visibility("none"), supersampling=2)
    folder, written = tmp_path_factory.mktemp("shards"), {}
    for name in ("exr", "png"):
        (written[name],) = write_shards(DataSet(replace(recipe, format=name)), folder / name, workers=1)
    return written


def test_a_sample_reads_alike_from_png_and_exr_but_for_rounding(shards):
    for exact, rounded in zip(read_shard(shards["exr"]), read_shard(shards["png"]), strict=True):
        assert exact.key == rounded.key and exact.scene.items() <= rounded.scene.items()
        assert exact.channels.keys() == rounded.channels.keys()
        far = max(1, exact.channels["Z"].max())
        steps = {"Z": far / 65535, "N": 1 / 127, "body": 0, "mask": 1 / 255, "shadow": 1 / 255, "A": 1 / 255}
        for name, values in exact.channels.items():
            assert rounded.channels[name].dtype == np.float32
            if name not in "RGB":
                error = np.abs(rounded.channels[name] - values).max()
                assert error <= steps[name.split(".")[0]] / 2 + 1e-6, name
        nothing = exact.channels["body"] < 0
        assert nothing.any() and not any(rounded.channels[name][nothing].any() for name in ("Z", "N.X", "N.Y", "N.Z"))
        covered = exact.color[..., 3] == 1
        brightest = exact.color[..., :3].max()
        np.testing.assert_allclose(rounded.color[covered], exact.color[covered], atol=0.005 * brightest)
        np.testing.assert_allclose(rounded.color, exact.color, atol=0.01 * brightest)


def test_what_is_said_of_pictures_reads_them_without_this_library(shards):
    sample = next(read_shard(shards["png"]))
    with tarfile.open(shards["png"]) as archive:
        files = {each.name.partition(".")[2]: archive.extractfile(each).read() for each in archive.getmembers()[:10]}
    assert set(files) - {"json"} == set(sample.scene["png"])
    assert {"color.png", "shadow.png", "depth.png", "normals.png", "bodies.png", "mask.0.png", "mask.3.png"} < set(
        files
    )
    for ending, about in sample.scene["png"].items():
        codes = np.atleast_3d(np.asarray(Image.open(io.BytesIO(files[ending])), np.float64))
        most = 65535 if ending == "depth.png" else 255
        for k, name in enumerate(about["channels"]):
            if ending != "color.png":
                low, high = about["range"]
                expected = low + (high - low) * codes[..., k] / most
                np.testing.assert_allclose(sample.channels[name], expected, rtol=1e-6, atol=1e-6)
    assert sample.scene["png"]["color.png"]["below_zero"] == 0


def test_a_range_is_as_wide_as_an_image_needs():
    values = np.array([0.0, 0.3, 1.0])[None, :, None]
    read, about = there_and_back(values, Even())
    assert about["range"] == [0, 1]
    np.testing.assert_allclose(read, values, atol=0.5 / 255)
    read, about = there_and_back(4 * values - 1, Even())
    assert about["range"] == [-1, 3]
    np.testing.assert_allclose(read, 4 * values - 1, atol=2 / 255 + 1e-6)
    assert there_and_back(values + 1e-6, Even())[1]["range"] == [0, 1]  # of rounding, not of the image


def test_color_is_exposed_until_nothing_is_cut_off_and_what_is_below_zero_is_counted():
    rng = np.random.default_rng(0)
    alpha = np.repeat([[1.0], [0.5], [0.0]], 8, axis=1)[..., None]
    image = np.concatenate([alpha * rng.uniform(0, 300, (3, 8, 3)), alpha], axis=-1)
    image[0, 0, 0], image[0, 1] = -2, [1e-6, 0, 0, 1]
    read, about = there_and_back(image, Srgb())
    assert about["below_zero"] == 1 / 24
    straight = image[:2, :, :3] / image[:2, :, 3:]
    assert about["exposure"] == pytest.approx(-np.log2(straight.max()))
    image[0, 0, 0] = 0
    np.testing.assert_allclose(read, image, atol=0.005 * 300)
    nothing, about = there_and_back(np.zeros((2, 2, 4)), Srgb())
    assert about["exposure"] == 0 and not nothing.any()


def test_a_damaged_picture_is_named(shards, tmp_path):
    content, about = as_png({"Z": np.ones((4, 4), np.float32)}, Even(16))
    for damaged in (b"", b"no PNG", content[: len(content) // 2]):
        with pytest.raises(ImageError):
            from_png(damaged, about)
    with pytest.raises(ValueError, match=r"got shape \(4, 4, 1\), expected \[height, width, 3\]"):
        from_png(content, about | {"channels": ["R", "G", "B"]})
    with tarfile.open(shards["png"]) as archive, tarfile.open(tmp_path / "part.tar", "w") as part:
        for member in archive:
            if not member.name.endswith("depth.png"):
                part.addfile(member, archive.extractfile(member))
    with pytest.raises(ValueError, match=r"part\.tar: 0{9}: got .*, expected a \.depth\.png file, too"):
        list(read_shard(tmp_path / "part.tar"))
