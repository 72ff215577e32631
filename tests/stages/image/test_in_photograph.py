"""Photographs: which light samples show, as a ratio, against NumPy, and the gradients."""

import numpy as np
import pytest
import warp as wp

from warpshadow.stages.image.photograph import compose, find_ratio_image

# A handful of float32 products.
FLOAT32 = 3e-6
# Central differences in float64 against float32 kernels.
GRADIENT = 1e-3

HEIGHT, WIDTH = 4, 6
CATCHES = np.array([False, True, True, False])

pytestmark = pytest.mark.usefixtures("poisoned_outputs")


def division_twin(face_ids, reflected, unshadowed, floors):
    """What samples reflect where they see bodies, r, and what they show beside that, float64."""
    light, floors = np.maximum(unshadowed[..., :3], 0), floors[:, None, None, None]
    inverse = light / (light**2 + floors**2)
    sees = (face_ids >= 0)[..., None]
    catches = CATCHES[face_ids][..., None] & sees
    rest = np.where(catches, 1 - unshadowed[..., :3] * inverse, np.where(sees, 0.0, 1.0))
    last = np.broadcast_to(~sees, (*rest.shape[:-1], 1))
    return np.where(sees & ~catches, reflected, 0), np.where(catches, inverse, 0), np.concatenate([rest, last], -1)


def floors_of(unshadowed):
    covered = unshadowed[..., 3].sum(axis=(1, 2))
    return np.maximum(unshadowed[..., :3], 0).sum(axis=(1, 2, 3)) / (3 * covered) / 256


def random_samples(batches):
    """Face ids, and the variables: reflected, unshadowed."""
    views, reflecting, lights = batches
    rng = np.random.default_rng(0)
    face_ids = rng.integers(-1, len(CATCHES), (views, HEIGHT, WIDTH))
    face_ids[:, 0, :4] = [-1, 0, 1, 2]
    unshadowed = rng.uniform(0.1, 1, (lights, HEIGHT, WIDTH, 4)) ** 2
    unshadowed[..., 3] = 1
    return face_ids, [rng.uniform(0, 1, (reflecting, HEIGHT, WIDTH, 3)), unshadowed]


def divided(face_ids, variables, device):
    """The arrays of the variables, and the parts."""
    arrays = [array_of(values, device) for values in variables]
    catches = wp.array(CATCHES, dtype=wp.bool, device=device)
    return arrays, find_ratio_image(wp.array(face_ids, dtype=wp.int32, device=device), catches, *arrays)


def array_of(values, device, requires_grad=True):
    dtype = wp.vec3 if values.shape[-1] == 3 else wp.vec4
    return wp.array(values, dtype=dtype, device=device, requires_grad=requires_grad)


def check_gradients(loss, variables, arrays):
    for values, array in zip(variables, arrays, strict=True):
        gradient = np.zeros_like(values)
        for index in np.ndindex(values.shape):
            kept, ends = values[index], []
            for sign in (1, -1):
                values[index] = kept + sign * 1e-6
                ends.append(loss())
            values[index] = kept
            gradient[index] = (ends[0] - ends[1]) / 2e-6
        assert np.linalg.norm(array.grad.numpy() - gradient) < GRADIENT * np.linalg.norm(gradient)


BATCHES = [(2, 1, 2), (1, 3, 1), (1, 1, 3), (1, 1, 1)]


@pytest.mark.parametrize("batches", BATCHES)
def test_samples_show_bodies_or_the_photograph(device, batches):
    face_ids, variables = random_samples(batches)
    _, got = divided(face_ids, variables, device)
    for array, values in zip(got, division_twin(face_ids, *variables, floors_of(variables[1])), strict=True):
        assert array.shape == (max(batches), HEIGHT, WIDTH)
        assert (np.abs(array.numpy() - values) <= FLOAT32 * (1 + np.abs(values))).all()


@pytest.mark.parametrize("batches", BATCHES)
def test_the_division_has_the_gradients_of_the_twin(device, batches):
    face_ids, variables = random_samples(batches)
    floors = floors_of(variables[1])  # which have no gradient
    weights = [np.random.default_rng(1).normal(size=(max(batches), HEIGHT, WIDTH, size)) for size in (3, 3, 4)]
    with wp.Tape() as tape:
        arrays, parts = divided(face_ids, variables, device)
    tape.backward(grads={part: array_of(each, device, False) for part, each in zip(parts, weights, strict=True)})

    def loss():
        parts = division_twin(face_ids, *variables, floors)
        return sum((np.broadcast_to(part, each.shape) * each).sum() for part, each in zip(parts, weights, strict=True))

    check_gradients(loss, variables, arrays)


@pytest.mark.parametrize("scale", [1e-18, 1.0, 1e18])
def test_the_ratio_is_that_of_the_light_where_there_is_light_and_1_where_there_is_none(device, scale):
    light = scale * np.array([1.0, 1.0, 1.0, 0.1, 1e-3, 1e-6, 0.0, -0.01]).reshape(1, 2, 4)
    unshadowed = np.stack([light] * 3 + [np.ones_like(light)], axis=-1)
    _, parts = divided(np.ones((1, 2, 4), int), [np.zeros((1, 2, 4, 3)), unshadowed], device)
    shadowed = 0.25 * light
    ratio = (parts.inverse_light.numpy()[..., 0] * shadowed + parts.base_factor.numpy()[..., 0]).ravel()
    assert ratio[:4] == pytest.approx(0.25, rel=0.005)
    assert (np.diff(ratio[2:7]) > 0).all() and ratio[5:7] == pytest.approx(1, abs=1e-3)
    assert ratio[7] == pytest.approx(1)  # bands of light ring below 0


def test_without_light_the_photograph_stays(device):
    dark = np.concatenate([np.zeros((1, 4, 6, 3)), np.ones((1, 4, 6, 1))], axis=-1)
    _, parts = divided(np.ones((1, 4, 6), int), [np.zeros((1, 4, 6, 3)), dark], device)
    assert not parts.inverse_light.numpy().any() and (parts.base_factor.numpy()[..., :3] == 1).all()


def test_a_photograph_is_multiplied_and_covered(device):
    rng = np.random.default_rng(0)
    variables = [rng.normal(size=(count, HEIGHT, WIDTH, size)) for count, size in ((1, 3), (2, 4), (2, 4), (1, 4))]
    arrays = [array_of(values, device) for values in variables]

    def twin():
        photograph, drawn, caught, rest = variables
        return drawn[..., :3] + photograph * (caught + rest)[..., :3]

    with wp.Tape() as tape:
        composed = compose(*arrays)
    np.testing.assert_allclose(composed.numpy(), twin(), atol=1e-5)
    weights = rng.normal(size=(2, HEIGHT, WIDTH, 3))
    composed.grad.assign(weights.astype(np.float32))
    tape.backward()
    check_gradients(lambda: (twin() * weights).sum(), variables, arrays)


def test_a_photograph_of_another_size_is_refused(device):
    arrays = [wp.zeros((1, 2, 2), dtype=wp.vec4, device=device) for _ in range(3)]
    with pytest.raises(ValueError, match=r"photograph: got shape \(1, 2, 3\), expected \[batch, 2, 2\]"):
        compose(wp.zeros((1, 2, 3), dtype=wp.vec3, device=device), *arrays)
