"""Beams: their axes, and which part of the emission receivers and cameras get, against float64 twins."""

import numpy as np
import pytest
import twins
import warp as wp

import warpshadow as ws
from warpshadow.assets.camera import Camera
from warpshadow.stages.emitters.samples import EVERYWHERE, EmitterSpan, PlacedSamples
from warpshadow.stages.emitters.shown_beams import show_beams
from warpshadow.stages.emitters.spot_cones import beam_of, find_axis_weights, weigh_by_beam
from warpshadow.stages.raster.rasterization import Fragments

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

FLOAT32 = 1e-5  # numbers up to 1 after a few operations, of differences of about 0.1

WIDE = (25.0, 70.0)


def share(axis, way, angles):
    """By the cosines of the angles."""
    inner, outer = np.cos(np.radians(angles))
    return twins.smoothstep((twins.unit(way) @ twins.unit(axis) - outer) / (inner - outer))


def tube():
    """An open cylinder around the y axis, whose normals cancel."""
    angles = 2 * np.pi * np.arange(12) / 12
    rings = [np.stack([np.cos(angles), 0 * angles + height, np.sin(angles)], axis=1) for height in (0.0, 2.0)]
    begin, end = np.arange(12), np.roll(np.arange(12), -1)
    halves = np.stack([begin, begin + 12, end], axis=1), np.stack([end, begin + 12, end + 12], axis=1)
    return ws.Mesh(np.concatenate(rings), np.concatenate(halves))


SHADE = ws.Mesh([(0, 0, 0), (1, 0, 1), (1, 0, -1), (-1, 0, -1), (-1, 0, 1)], [(0, 1, 2), (0, 2, 3), (0, 3, 4)])


@pytest.mark.parametrize(
    ("mesh", "axis"),
    [
        (ws.plane(2.0, 3), (0, 1, 0)),
        (ws.icosphere(0.5, 2), (0, 0, -1)),
        (ws.icosphere(0.5, 2).transformed(translation=(7, 8, 9)), (0, 0, -1)),
        (tube(), (0, 0, -1)),
        (SHADE, (0, 1, 0)),
    ],
    ids=["plane", "ball", "moved ball", "tube", "shade"],
)
def test_an_axis_is_the_mean_normal_or_backward_and_turns_with_the_body(mesh, axis):
    faces = mesh.surface.faces
    of_vertices, of_faces = find_axis_weights(mesh.positions, faces)
    for body in (ws.Body(mesh), ws.Body(mesh, rotation=(30, -50, 70), translation=(3, 2, 1), scale=4.0)):
        points = body.to_world(mesh.positions.astype(np.float64))
        a, b, c = np.moveaxis(points[faces], 1, 0)
        found = of_vertices @ points + of_faces @ np.cross(b - a, c - a)
        np.testing.assert_allclose(twins.unit(found), body.rotation_matrix() @ axis, atol=1e-5)


def test_beams_of_close_angles_fall_off_in_float32():
    for angles in ((179.99, 180.0), (30.0, 30.0), (0.0, 1e-6)):
        inner, outer = np.float32(beam_of(angles))
        assert 0 <= inner < outer <= 2
    assert beam_of(None) == EVERYWHERE


@pytest.mark.parametrize("angles", [WIDE, (0.5, 1.0), (90.0, 170.0)])
@pytest.mark.parametrize("passes", [False, True])
def test_receivers_get_the_share_of_the_twin(angles, passes, device):
    rng = np.random.default_rng(0)
    axes = twins.unit(rng.normal(size=(2, 2, 3)))
    samples = 0.05 * rng.normal(size=(2, 16, 3))
    turned = rng.uniform(0, np.radians(angles[1]) * 1.3, size=(1, 30, 1))
    aside = twins.unit(np.cross(axes[:1, 1:], rng.normal(size=(1, 30, 3))))
    points = 4 * (np.cos(turned) * axes[:1, 1:] + np.sin(turned) * aside)
    transmittance = rng.uniform(size=(1, 30, 8)) if passes else None
    arrays = [wp.array(item, dtype=wp.vec3, device=device) for item in (points, samples, 3 * axes)]
    through = None if transmittance is None else wp.array(transmittance, dtype=wp.float32, device=device)
    span = EmitterSpan(1, 8, 16, False, beam_of(angles))
    got = weigh_by_beam(arrays[0], PlacedSamples(arrays[1], *arrays[:1] * 5, arrays[2]), span, through).numpy()
    expected = np.array(
        [
            [[share(axes[batch, 1], point - sample, angles) for sample in samples[batch, 8:]] for point in points[0]]
            for batch in range(2)
        ]
    )
    assert ((expected > 0.01) & (expected < 0.99)).mean() > 0.05
    tolerance = FLOAT32 * (60 if angles[1] < 2 else 1)  # whose falloff is within 0.5 degrees
    np.testing.assert_allclose(got, expected * (transmittance if passes else 1), atol=tolerance)


def test_an_emitter_without_a_beam_launches_nothing(device):
    points = wp.zeros((1, 3), dtype=wp.vec3, device=device)
    through = wp.zeros((1, 3, 8), dtype=wp.float32, device=device)
    placed = PlacedSamples(*[points] * 7)
    for transmittance in (through, None):
        assert weigh_by_beam(points, placed, EmitterSpan(0, 0, 8, False), transmittance) is transmittance


def test_cameras_see_the_share_of_the_twin(device):
    """Four samples: of two emitters with a beam, of another face, and of none."""
    rng = np.random.default_rng(1)
    positions, axes, emission = rng.normal(size=(2, 9, 3)), rng.normal(size=(2, 3, 3)), rng.uniform(size=(1, 2, 2, 3))
    eye = np.array([0.3, 0.8, 5.0])
    camera = Camera.look_at(eye, (0, 0, 0), fov_y=40, size=(2, 2)).clip_matrix()
    faces, ids = np.arange(9).reshape(3, 3), np.array([[[0, 1], [2, -1]]])
    weights = rng.dirichlet((1, 1, 1), size=(1, 2, 2))
    values = [(ids, wp.int32), (weights, wp.vec3), (emission, wp.vec3), (faces, wp.vec3i), (positions, wp.vec3)]
    values += [(camera[None], wp.mat44), (axes, wp.vec3), (np.array([2, 0, -1]), wp.int32)]
    ids_array, weights_array, *arrays = (wp.array(item, dtype=dtype, device=device) for item, dtype in values)
    shown, (faces_array, positions_array, cameras, axes_array, owners) = arrays[0], arrays[1:]
    angles = [(10.0, 120.0), None, WIDE]
    beams = np.array([beam_of(item) for item in angles])
    placed = PlacedSamples(*[positions_array] * 6, axes_array)
    arguments = Fragments(ids_array, weights_array), faces_array, positions_array, cameras, placed, owners, beams
    got = show_beams(shown, *arguments).numpy()
    expected = np.repeat(emission, 2, axis=0)
    for batch in range(2):
        for row, column, emitter in ((0, 0, 2), (0, 1, 0)):
            point = weights[0, row, column] @ positions[batch, faces[ids[0, row, column]]]
            expected[batch, row, column] *= share(axes[batch, emitter], eye - point, angles[emitter])
    assert (expected[:, 0] < 0.99 * emission[0, 0]).any()
    np.testing.assert_allclose(got, expected, atol=10 * FLOAT32)
