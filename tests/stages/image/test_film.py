"""Film: color and coverage of samples and pixels against NumPy, and their gradients."""

import numpy as np
import pytest
import warp as wp

from warpshadow.stages.image.film import average, sample_radiance
from warpshadow.stages.raster.rasterization import Fragments

# A handful of float32 products.
FLOAT32 = 1e-6

HEIGHT, WIDTH, FACE_COUNT, RECEIVER_COUNT = 4, 5, 6, 7

pytestmark = pytest.mark.usefixtures("poisoned_outputs")


def random_samples(device, views=1, lights=1, colors=1):
    """Face ids, faces, and the three variables: barycentrics, shading, albedo."""
    rng = np.random.default_rng(0)
    face_ids = rng.integers(-1, FACE_COUNT, (views, HEIGHT, WIDTH))
    faces = rng.integers(0, RECEIVER_COUNT, (FACE_COUNT, 3))
    variables = [
        rng.dirichlet(np.ones(3), (views, HEIGHT, WIDTH)),
        rng.uniform(0, 2, (lights, RECEIVER_COUNT, 3)),
        rng.uniform(0, 1, (colors, HEIGHT, WIDTH, 3)),
    ]
    return (
        wp.array(face_ids, dtype=wp.int32, device=device),
        wp.array(faces, dtype=wp.vec3i, device=device),
        [wp.array(values, dtype=wp.vec3, device=device, requires_grad=True) for values in variables],
    )


def radiance_twin(face_ids, faces, weights, shading, albedo):
    corners = shading[:, faces[face_ids]] if len(face_ids) > 1 else shading[:, faces[face_ids[0]]][:, None]
    if len(face_ids) > 1:
        corners = np.stack([corners[min(b, len(shading) - 1), b] for b in range(len(face_ids))])
    else:
        corners = corners[:, 0]
    color = (weights[..., None] * corners).sum(axis=-2) * albedo
    coverage = np.broadcast_to((face_ids >= 0)[..., None], (*color.shape[:-1], 1))
    return np.concatenate([color * coverage, coverage], axis=-1)


BATCHES = [{}, {"views": 3, "lights": 3, "colors": 3}, {"views": 3}, {"lights": 3}, {"colors": 3, "views": 3}]


@pytest.mark.parametrize("batches", BATCHES)
def test_a_sample_is_the_light_it_receives_times_what_it_reflects(device, batches):
    face_ids, faces, variables = random_samples(device, **batches)
    samples = sample_radiance(Fragments(face_ids, variables[0]), faces, *variables[1:])
    expected = radiance_twin(face_ids.numpy(), faces.numpy(), *(array.numpy() for array in variables))
    assert samples.shape == expected.shape[:-1]
    assert np.abs(samples.numpy() - expected).max() < FLOAT32


def test_batches_that_differ_are_refused(device):
    face_ids, faces, (weights, shading, albedo) = random_samples(device, views=2, lights=3)
    with pytest.raises(ValueError, match="shading: got a batch of 3, expected 1 or 2"):
        sample_radiance(Fragments(face_ids, weights), faces, shading, albedo)


@pytest.mark.parametrize("supersampling", [1, 2, 3])
def test_pixels_are_the_means_of_their_samples_and_share_their_gradients(device, supersampling, verified_tape):
    rng = np.random.default_rng(2)
    values, weights = rng.normal(size=(2, 6, 12, 4)), rng.normal(size=(2, 6 // supersampling, 12 // supersampling, 4))
    samples = wp.array(values, dtype=wp.vec4, device=device, requires_grad=True)
    with wp.Tape() as tape:
        pixels = average(samples, supersampling)
    expected = values.reshape(2, 6 // supersampling, supersampling, 12 // supersampling, supersampling, 4).mean(
        axis=(2, 4)
    )
    assert np.abs(pixels.numpy() - expected).max() < FLOAT32
    if supersampling > 1:
        tape.backward(grads={pixels: wp.array(weights, dtype=wp.vec4, device=device)})
        shares = np.repeat(np.repeat(weights, supersampling, axis=1), supersampling, axis=2) / supersampling**2
        assert np.abs(samples.grad.numpy() - shares).max() < FLOAT32
