"""The rotation nearest to a matrix, against SciPy, and its gradient against central differences."""

import numpy as np
import pytest
import twins
import warp as wp
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

from warpshadow.device.tape import recorded
from warpshadow.stages.geometry.nearest_rotation import nearest_rotations

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

FLOAT32 = 2e-6
SLOPE = 1e-4  # of central differences, in float64


def matrices_near_rotations(*shape, seed=0):
    rng = np.random.default_rng(seed)
    rotations = Rotation.random(int(np.prod(shape)), rng).as_matrix().reshape(*shape, 3, 3)
    return rotations @ (np.eye(3) + 0.2 * rng.normal(size=(*shape, 3, 3)))


def nearest_twin(matrices):
    return np.stack([polar(matrix)[0] for matrix in matrices.reshape(-1, 3, 3)]).reshape(matrices.shape)


def on_device(matrices, device, requires_grad=True):
    return wp.array(matrices, dtype=wp.mat33, device=device, requires_grad=requires_grad)


def test_it_is_the_orthogonal_factor_of_the_polar_decomposition(device):
    matrices = matrices_near_rotations(2, 5)
    rotations = nearest_rotations(on_device(matrices, device)).numpy()
    np.testing.assert_allclose(rotations, nearest_twin(matrices), atol=FLOAT32)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=FLOAT32)


@pytest.mark.parametrize("size", [1e-15, 1.0, 1e15])
def test_the_size_of_the_matrix_does_not_matter(size, device):
    matrices = matrices_near_rotations(1, 4)
    rotations = nearest_rotations(on_device(size * matrices, device)).numpy()
    np.testing.assert_allclose(rotations, nearest_twin(matrices), atol=FLOAT32)


def test_a_matrix_that_mirrors_gets_a_rotation_all_the_same(device):
    mirrored = Rotation.random(random_state=1).as_matrix() @ np.diag([1.0, 0.8, -0.3])
    rotation = nearest_rotations(on_device(mirrored[None, None], device)).numpy()[0, 0]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=FLOAT32)
    np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=FLOAT32)


def test_its_gradient_is_that_of_central_differences_also_where_the_caller_changes_the_rotations(device):
    matrices, weights = matrices_near_rotations(1, 3), np.random.default_rng(1).normal(size=(1, 3, 3, 3))
    array = on_device(matrices, device)
    with recorded() as tape:
        rotations = nearest_rotations(array)
    expected = twins.central_differences(lambda m: np.sum(weights * nearest_twin(m)), matrices)
    rotations.fill_(wp.mat33(7.0))
    for count in (1, 2):  # gradients add up
        tape.backward(grads={rotations: wp.array(weights, dtype=wp.mat33, device=device)})
        np.testing.assert_allclose(array.grad.numpy(), count * expected, atol=SLOPE)
