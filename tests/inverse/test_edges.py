"""Edges of images beside painted outlines: masks that are not right to the pixel move to them."""

import numpy as np
import pytest
from scipy import ndimage

import warpshadow as ws
from warpshadow.inverse import Target, load_fit
from warpshadow.inverse.edges import MAX_EDGE_OFFSET, edge_offset, moved_outline, signed_distances

# Of the distance to an edge [pixels], of which distances to pixel centers already have 0.2. Measured below 0.16.
ERROR = 0.25

SIZE = 64


def blob(grown=0.0):
    """Coverage of pixels by a rounded triangle, larger by some pixels."""
    row, column = np.indices((SIZE, SIZE)) + 0.5
    angle = np.arctan2(row - 31.6, column - 32.3)
    return np.clip(0.5 + 18 + np.sin(3 * angle) + grown - np.hypot(row - 31.6, column - 32.3), 0, 1)


def photograph(noise=0.01, seed=0):
    """A textured body with a shadow beside it, before a bright checkered table."""
    row, column = np.indices((SIZE, SIZE))
    table = np.where((row // 9 + column // 9) % 2, 0.55, 0.4) * np.where(column > 50, 0.3, 1.0)
    body = 0.12 + 0.05 * np.sin(row / 4)
    image = table + (body - table) * blob()
    pixels = image[..., None] * (1.0, 0.9, 0.8) + np.random.default_rng(seed).normal(0, noise, (SIZE, SIZE, 3))
    return np.maximum(pixels, 0).astype(np.float32)


@pytest.mark.parametrize("grown", [-2.0, -1.0, 0.0, 0.5, 1.0, 2.5])
def test_the_edge_is_found_from_a_mask_of_another_size(grown):
    assert edge_offset(photograph(), blob(grown)) == pytest.approx(-grown, abs=ERROR)


def test_whole_pixels_of_a_segmentation_are_enough():
    mask = ndimage.binary_dilation(blob() > 0.5, iterations=1).astype(np.float32)
    offset = edge_offset(photograph(), mask)
    assert -1.3 < offset < -0.7
    error = np.abs(moved_outline(mask, offset) - blob()).mean()
    assert error < 0.3 * np.abs(mask - blob()).mean()


def test_where_no_edge_stands_out_a_mask_stays():
    even = np.full((SIZE, SIZE, 3), 0.4, np.float32)
    assert edge_offset(even, blob()) == 0
    assert edge_offset(even + np.random.default_rng(1).normal(0, 0.02, even.shape), blob()) == pytest.approx(0, abs=1.0)
    assert edge_offset(photograph(), np.zeros((SIZE, SIZE))) == 0
    assert edge_offset(photograph(), np.ones((SIZE, SIZE))) == 0


def test_an_edge_far_away_is_not_looked_for():
    assert abs(edge_offset(photograph(), blob(-8.0))) <= MAX_EDGE_OFFSET


def test_outlines_move_by_an_offset():
    distances = signed_distances(moved_outline(blob(), 1.5))
    assert np.median(distances - signed_distances(blob())) == pytest.approx(1.5, abs=ERROR)


def test_targets_and_fit_files_move_their_outlines(tmp_path):
    image, mask = photograph(), np.ones((SIZE, SIZE), np.float32)
    mask[:, 60:] = 0  # pixels that do not count have edges, too
    still, moved = (
        Target(image, mask, outlines={"body": blob(1.0)}, moves_outlines=moves).outlines["body"]
        for moves in (False, True)
    )
    np.testing.assert_allclose(still, blob(1.0), atol=1e-6)
    assert np.abs(moved - blob()).mean() < 0.3 * np.abs(still - blob()).mean()
    with pytest.raises(ValueError, match="moves_outlines: got 1, expected"):
        Target(image, outlines={"body": blob()}, moves_outlines=1)
    camera = ws.Camera.look_at((0, 1, 3), (0, 0, 0), size=(SIZE, SIZE))
    ws.write_scene(ws.Scene([ws.Body(ws.icosphere(1.0, 1), name="body")], np.ones((4, 3)), camera), tmp_path)
    ws.write_image(tmp_path / "image.exr", image)
    ws.write_image(tmp_path / "body.exr", np.repeat(blob(1.0)[..., None], 3, axis=2).astype(np.float32))
    (tmp_path / "fit.toml").write_text(
        'scene = "scene.toml"\n[[target]]\nimage = "image.exr"\nmoves_outlines = true\n'
        'outlines = {body = "body.exr"}\n[[free.pose]]\nbody = "body"\n'
    )
    (target,) = load_fit(tmp_path / "fit.toml").problem.targets
    assert np.abs(next(iter(target.outlines.values())) - moved).max() < 0.05
