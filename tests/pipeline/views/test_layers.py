"""Layers: depth, normals, bodies and masks against rays, and what other programs read of them."""

import numpy as np
import pytest

import warpshadow as ws

SIZE = 48, 32
# Rounding of depths of some 10 units in float32, through barycentrics.
FLOAT32 = 2e-5
# A ball of 20 480 faces lies within its sphere by 1 − cos of half an edge.
CHORD = 1e-3


def ball_on_ground(eye=(1.0, 2.0, 4.0), **options):
    ball = ws.Body(ws.icosphere(0.7, 5), blockers=0, translation=(0.2, 0.7, 0), receivers="vertex")
    ground = ws.Body(ws.plane(30, 4), blockers=0, receivers="vertex")
    camera = ws.Camera.look_at(eye, (0, 0.6, 0), size=SIZE)
    return ws.Scene([ball, ground], ws.EnvironmentMap.constant(), camera, ws.Visibility("none"), **options)


def met_by_rays(scene):
    """Distances along rays to ball and ground, Inf where they are missed, in float64."""
    eye, directions = scene.camera.rays()
    center, radius = scene.bodies[0].translation, 0.7
    b = (directions * (eye - center)).sum(axis=-1)
    discriminant = b**2 - ((eye - center) ** 2).sum() + radius**2
    ball = np.where(discriminant > 0, -b - np.sqrt(np.maximum(discriminant, 0)), np.inf)
    ground = np.where(directions[..., 1] * eye[1] < 0, -eye[1] / directions[..., 1], np.inf)
    points = eye + np.where(np.isfinite(ground), ground, 0)[..., None] * directions
    ground[(np.abs(points) > 15).any(axis=-1)] = np.inf
    return eye, directions, ball, ground


@pytest.mark.parametrize(("eye", "seen"), [((1.0, 2.0, 4.0), {-1, 0, 1}), ((1.0, -2.0, 20.0), {-1, 1})])
@pytest.mark.parametrize("supersampling", [1, 2])
def test_layers_are_what_rays_through_the_middles_of_pixels_meet(device, eye, seen, supersampling):
    scene = ball_on_ground(eye, supersampling=supersampling)
    layers = ws.Renderer(scene, device=device).layers()
    origin, directions, ball, ground = met_by_rays(scene)
    distances = np.minimum(ball, ground)
    expected = np.where(np.isfinite(distances), np.where(ball < ground, 0, 1), -1)
    same = layers.bodies == expected
    assert same.mean() > 0.995 and set(np.unique(expected)) == seen  # at its limb the ball has corners
    along = (directions @ scene.camera.rotation[2]) * np.where(expected >= 0, distances, 0)
    for number, tolerance in ((0, 10 * CHORD), (1, FLOAT32 * 15)):
        is_seen = same & (expected == number)
        assert np.abs(layers.depth - along)[is_seen].max(initial=0) < tolerance
    points = origin + np.where(expected >= 0, distances, 0)[..., None] * directions
    normals = (points - scene.bodies[0].translation) / 0.7
    off = np.linalg.norm((layers.normals - normals)[same & (expected == 0)], axis=-1)
    assert off.max(initial=0) < 0.06  # at the limb
    assert np.abs(layers.normals[same & (expected == 1)] - [0, np.sign(eye[1]), 0]).max() < 1e-6  # towards the eye
    assert not layers.depth[layers.bodies < 0].any() and not layers.normals[layers.bodies < 0].any()


def test_masks_of_bodies_add_up_to_the_coverage_and_are_as_smooth(device):
    scene = ball_on_ground()
    renderer = ws.Renderer(scene, device=device)
    image, layers = renderer.render(), renderer.layers()
    assert np.abs(layers.masks.sum(axis=0) - image[..., 3]).max() < 1e-6
    alone = ws.Renderer(ws.Scene(scene.bodies[:1], scene.light, scene.camera, scene.visibility), device=device)
    assert np.abs(layers.masks[0] - alone.render()[..., 3]).max() < 0.02  # where it stands on the ground
    assert ((layers.masks[0] > 0.05) & (layers.masks[0] < 0.95)).sum() > 20


def test_more_bodies_than_an_image_has_channels_have_masks(device):
    balls = [ws.Body(ws.icosphere(0.4, 2), blockers=0, translation=(k - 2, 0, 0), name=f"{k}") for k in range(5)]
    camera = ws.Camera.look_at((0, 0, 8), (0, 0, 0), size=SIZE)
    scene = ws.Scene(balls, ws.EnvironmentMap.constant(), camera, ws.Visibility("none"))
    masks = ws.Renderer(scene, device=device).layers().masks
    assert masks.shape == (5, 32, 48)
    middles = [(mask * (np.arange(48) + 0.5)).sum() / mask.sum() for mask in masks]
    assert middles == pytest.approx(scene.camera.project([[k - 2, 0, 0] for k in range(5)])[:, 0], abs=0.1)


def test_layers_of_several_cameras_are_those_of_each(device):
    scene = ball_on_ground()
    cameras = [scene.camera, scene.camera.turned(40)]
    both = ws.Renderer(scene, cameras=cameras, device=device).layers()
    for number, camera in enumerate(cameras):
        each = ws.Renderer(ws.Scene(scene.bodies, scene.light, camera, scene.visibility), device=device).layers()
        for got, expected in zip(both, each, strict=True):
            np.testing.assert_array_equal(got[number], expected)


def test_a_file_has_them_as_channels_that_openexr_reads(tmp_path):
    import OpenEXR

    renderer = ws.Renderer(ball_on_ground())
    image, layers = renderer.render(), renderer.layers()
    ws.write_image(tmp_path / "a.exr", image, layers=layers.channels())
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        read = {name: channel.pixels for name, channel in file.channels().items()}
    assert sorted(read) == sorted([*"RGBA", "Z", "N.X", "N.Y", "N.Z", "body", "mask.0", "mask.1"])
    assert {pixels.dtype for pixels in read.values()} == {np.dtype(np.float32)}
    np.testing.assert_array_equal(read["Z"], layers.depth)
    np.testing.assert_array_equal(np.stack([read[f"N.{axis}"] for axis in "XYZ"], axis=-1), layers.normals)
    np.testing.assert_array_equal(read["body"], layers.bodies)
    np.testing.assert_array_equal(np.stack([read["mask.0"], read["mask.1"]]), layers.masks)
    np.testing.assert_array_equal(ws.read_image(tmp_path / "a.exr"), image)  # as before


@pytest.mark.parametrize(
    ("name", "layers", "message"),
    [
        ("a.exr", {"R": np.zeros((4, 5))}, "layers: got the name 'R', expected one that no other channel has"),
        ("a.exr", {"Z": np.zeros((5, 4))}, r"layers: Z: got shape \(5, 4\), expected \[4, 5\]"),
        ("a.png", {"Z": np.zeros((4, 5))}, "a.png: got layers, which only .exr files have"),
    ],
)
def test_layers_that_cannot_be_written_are_refused(tmp_path, name, layers, message):
    with pytest.raises(ws.ImageError, match=message):
        ws.write_image(tmp_path / name, np.zeros((4, 5, 4), np.float32), layers=layers)
    assert not list(tmp_path.iterdir())
