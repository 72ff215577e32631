"""Rigid poses and embedded deformation: against float64 twins, and their gradients against central differences."""

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation
from twins import central_differences

from warpshadow.device.warp_internals import item_shape
from warpshadow.stages.geometry.deform import DeformationGraph
from warpshadow.stages.geometry.poses import Poses
from warpshadow.stages.geometry.rotations import Vec6, rotation_matrices

# Rounding of float32.
FLOAT32 = 1e-5
# Gradients of float32 kernels against float64 differences.
GRADIENT = 1e-3


def put(values, dtype, device, requires_grad=True):
    return wp.array(np.asarray(values, np.float32), dtype=dtype, device=device, requires_grad=requires_grad)


def sixd_twin(columns):
    x = columns[..., :3] / np.linalg.norm(columns[..., :3], axis=-1, keepdims=True)
    y = columns[..., 3:] - np.sum(columns[..., 3:] * x, axis=-1, keepdims=True) * x
    y /= np.linalg.norm(y, axis=-1, keepdims=True)
    return np.stack([x, y, np.cross(x, y)], axis=-1)


def nearest_twin(matrices):
    u, _, vt = np.linalg.svd(matrices.reshape(*matrices.shape[:-1], 3, 3))
    u[..., 2] *= np.linalg.det(u @ vt)[..., None]
    return u @ vt


TWINS = {
    "quaternion": (wp.vec4, 4, lambda q: Rotation.from_quat(q.reshape(-1, 4)).as_matrix().reshape(*q.shape[:-1], 3, 3)),
    "axis-angle": (
        wp.vec3,
        3,
        lambda v: Rotation.from_rotvec(v.reshape(-1, 3)).as_matrix().reshape(*v.shape[:-1], 3, 3),
    ),
    "columns": (Vec6, 6, sixd_twin),
    "matrix": (wp.mat33, 9, nearest_twin),
}


@pytest.mark.parametrize("kind", TWINS)
def test_rotations_and_their_gradients_are_those_of_the_twin(kind, device, verified_tape):
    dtype, size, twin = TWINS[kind]
    rng = np.random.default_rng(0)
    parameters = rng.normal(size=(3, 4, size))
    if kind == "axis-angle":
        parameters[0] *= [[1e-9], [1e-3], [0.3], [2.0]]  # both sides of the series, and near zero
    weights = rng.normal(size=(3, 4, 3, 3))
    array = put(parameters.reshape(3, 4, *item_shape(dtype)), dtype, device)
    with wp.Tape() as tape:
        rotations = rotation_matrices(array)
    np.testing.assert_allclose(rotations.numpy(), twin(parameters), atol=FLOAT32)
    rotations.grad.assign(weights.astype(np.float32))
    tape.backward()
    expected = central_differences(lambda p: np.sum(weights * twin(p)), parameters)
    gradient = array.grad.numpy().reshape(parameters.shape)
    assert np.linalg.norm(gradient - expected) < GRADIENT * np.linalg.norm(expected)


def test_a_rotation_is_nearest_to_itself_with_a_finite_gradient(device):
    """Its singular values are equal, by whose differences the adjoint of a decomposition divides."""
    rotations = Rotation.random(8, random_state=0).as_matrix()
    weights = np.random.default_rng(1).normal(size=(8, 3, 3))
    array = put(rotations[None], wp.mat33, device)
    with wp.Tape() as tape:
        nearest = rotation_matrices(array)
    np.testing.assert_allclose(nearest.numpy()[0], rotations, atol=FLOAT32)
    nearest.grad.assign(weights[None].astype(np.float32))
    tape.backward()
    expected = central_differences(lambda p: np.sum(weights * nearest_twin(p.reshape(8, 9))), rotations)
    assert np.linalg.norm(array.grad.numpy()[0] - expected) < GRADIENT * np.linalg.norm(expected)


def test_no_rotation_is_the_identity_with_a_finite_gradient(device):
    array = put(np.zeros((1, 1, 3)), wp.vec3, device)
    with wp.Tape() as tape:
        rotations = rotation_matrices(array)
    np.testing.assert_array_equal(rotations.numpy()[0, 0], np.eye(3))
    rotations.grad.assign(np.float32([[[[0, -1, 0], [1, 0, 0], [0, 0, 0]]]]))
    tape.backward()
    np.testing.assert_allclose(array.grad.numpy()[0, 0], [0, 0, 2], atol=1e-6)


@pytest.mark.parametrize("length", [1e-17, 1e-9, 1.0, 1e9, 1e17])
@pytest.mark.parametrize("kind", ["quaternion", "columns", "matrix"])
def test_rotations_and_their_gradients_do_not_depend_on_the_length_of_parameters(kind, length, device):
    """But that gradients are as much longer as parameters are shorter. Squares of these lengths overflow float32."""
    dtype, size, twin = TWINS[kind]
    rng = np.random.default_rng(5)
    parameters, weights = rng.normal(size=(1, 6, size)), rng.normal(size=(1, 6, 3, 3))
    array = put(length * parameters.reshape(1, 6, *item_shape(dtype)), dtype, device)
    with wp.Tape() as tape:
        rotations = rotation_matrices(array)
    np.testing.assert_allclose(rotations.numpy(), twin(parameters), atol=FLOAT32)
    rotations.grad.assign(weights.astype(np.float32))
    tape.backward()
    expected = central_differences(lambda p: np.sum(weights * twin(p)), parameters)
    gradient = length * array.grad.numpy().reshape(parameters.shape)
    assert np.linalg.norm(gradient - expected) < GRADIENT * np.linalg.norm(expected)


@pytest.mark.parametrize("angle", [1e-5, 1e-3])
def test_nearly_parallel_columns_are_a_rotation_with_a_gradient(angle, device):
    x, y = np.array([0.6, 0.0, 0.8]), np.array([0.0, 1.0, 0.0])
    array = put([[[*x, *(x + angle * y)]]], Vec6, device)
    with wp.Tape() as tape:
        rotations = rotation_matrices(array)
    expected = np.stack([x, y, np.cross(x, y)], axis=-1)
    # the columns are rounded to 6e-8, which is that much more of the angle between them
    np.testing.assert_allclose(rotations.numpy()[0, 0], expected, atol=2e-7 / angle)
    rotations.grad.assign(np.ones((1, 1, 3, 3), np.float32))
    tape.backward()
    assert 0.1 / angle < np.linalg.norm(array.grad.numpy()) < 10 / angle


@pytest.mark.parametrize("angle", [1e-30, 1e3, 1e6, 1e17])
def test_axis_angles_of_any_length_are_rotations_with_finite_gradients(angle, device):
    array = put([[[0.36 * angle, 0.48 * angle, -0.8 * angle]]], wp.vec3, device)
    with wp.Tape() as tape:
        rotations = rotation_matrices(array)
    rotation = rotations.numpy()[0, 0]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=FLOAT32)
    rotations.grad.assign(np.random.default_rng(0).normal(size=(1, 1, 3, 3)).astype(np.float32))
    tape.backward()
    assert np.isfinite(array.grad.numpy()).all() and np.abs(array.grad.numpy()).max() < 100


@pytest.mark.parametrize(
    "values, dtype, message",
    [
        (
            [0, 0, 0, 0],
            wp.vec4,
            r"got 1 quaternions shorter than 1e-18 \(first at index \(1, 2\)\), expected rotations",
        ),
        ([1e-19, 0, 0, 0], wp.vec4, "got 1 quaternions shorter than 1e-18"),
        ([0, 0, 0, 0, 1, 0], Vec6, "got 1 columns shorter than 1e-18"),
        ([0, 1, 0, 0, 0, 0], Vec6, "got 1 columns shorter than 1e-18"),
        ([1, 2, 3, -2, -4, -6], Vec6, r"got 1 pairs of parallel columns \(first at index \(1, 2\)\)"),
        (np.zeros((3, 3)), wp.mat33, "got 1 matrices smaller than 1e-18"),
        (np.ones((3, 3)), wp.mat33, "got 1 matrices as near to several rotations"),
        (np.diag([-1, 1, 1]), wp.mat33, r"got 1 matrices as near to several rotations, .* at index \(1, 2\)"),
        ([np.nan, 0, 0, 1], wp.vec4, r"got 1 NaN or Inf values \(first at index \(1, 2, 0\)\)"),
        ([0, np.inf, 0], wp.vec3, "got 1 NaN or Inf values"),
        ([0, 1e19, 0], wp.vec3, "got 1 values out of range"),
    ],
)
def test_parameters_of_no_rotation_are_refused(values, dtype, message, device):
    parameters = np.random.default_rng(6).normal(size=(2, 3, *np.shape(values)))
    parameters[1, 2] = values
    with pytest.raises(ValueError, match=f"^parameters: {message}"):
        rotation_matrices(put(parameters, dtype, device))


def test_rotations_of_another_type_are_refused(device):
    with pytest.raises(ValueError, match="parameters: got dtype vec2f?, expected vec4, vec3, Vec6 or mat33"):
        rotation_matrices(wp.zeros((1, 1), dtype=wp.vec2, device=device))


def test_bodies_move_as_one_and_their_gradients_are_those_of_the_twin(device, verified_tape):
    rng = np.random.default_rng(1)
    rest, radii, bodies = rng.normal(size=(1, 9, 3)), rng.random((1, 9)), np.arange(9) % 3
    centers = rng.normal(size=(1, 9, 3))
    rotations = Rotation.random(6, random_state=1).as_matrix().reshape(2, 3, 3, 3)
    translations, scales = rng.normal(size=(2, 3, 3)), rng.uniform(0.5, 2, (2, 3))
    weights, center_weights, radius_weights = *rng.normal(size=(2, 2, 9, 3)), rng.normal(size=(2, 9))

    def twin(rest, rotations, translations, scales, radii, centers):
        def moved(points):
            rotated = np.einsum("bpij,opj->bpi", rotations[:, bodies], points)
            return rotated * scales[:, bodies, None] + translations[:, bodies]

        radius_sum = np.sum(radius_weights * scales[:, bodies] * radii)
        return np.sum(weights * moved(rest)) + np.sum(center_weights * moved(centers)) + radius_sum

    values = [rest, rotations, translations, scales, radii, centers]
    dtypes = [wp.vec3, wp.mat33, wp.vec3, wp.float32, wp.float32, wp.vec3]
    arrays = [put(value, dtype, device) for value, dtype in zip(values, dtypes, strict=True)]
    members = wp.array(bodies.astype(np.int32), device=device)
    with wp.Tape() as tape:
        poses = Poses(*arrays[1:4])
        moved = poses.placed(arrays[0], members, arrays[5], arrays[4], members)
        separate = poses.points(arrays[0], members), *poses.spheres(arrays[5], arrays[4], members)
    for one, other in zip(moved, separate, strict=True):
        np.testing.assert_array_equal(one.numpy(), other.numpy())
    points, posed_centers, posed_radii = moved
    points.grad.assign(weights.astype(np.float32))
    posed_centers.grad.assign(center_weights.astype(np.float32))
    posed_radii.grad.assign(radius_weights.astype(np.float32))
    tape.backward()
    total = np.sum(weights * points.numpy()) + np.sum(center_weights * posed_centers.numpy())
    total += np.sum(radius_weights * posed_radii.numpy())
    assert abs(total - twin(*values)) < 10 * FLOAT32
    for k, array in enumerate(arrays):
        expected = central_differences(lambda v, k=k: twin(*values[:k], v, *values[k + 1 :]), values[k])
        assert np.linalg.norm(array.grad.numpy() - expected) < GRADIENT * np.linalg.norm(expected)


@pytest.fixture
def graph(device):
    rng = np.random.default_rng(2)
    return DeformationGraph.bind(rng.normal(size=(30, 3)), rng.normal(size=(12, 3)), count=3, device=device)


def test_weights_are_shares_of_the_nearest_nodes(graph):
    weights, nodes = graph.weights.numpy(), graph.nodes.numpy()
    assert (weights > 0).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=FLOAT32)
    distances = np.linalg.norm(graph.rest.numpy()[:, None] - graph.node_positions.numpy(), axis=2)
    np.testing.assert_array_equal(np.sort(nodes), np.sort(np.argsort(distances, axis=1)[:, :3]))
    assert (np.diff(weights, axis=1) <= FLOAT32).all()  # nearer nodes carry more


def test_a_rigid_motion_of_all_nodes_is_one_of_the_points_and_costs_nothing(graph, device):
    rotation = Rotation.random(random_state=3).as_matrix()
    nodes, rest = graph.node_positions.numpy(), graph.rest.numpy()
    shift = np.array([0.3, -1.0, 2.0])
    matrices = put(np.broadcast_to(rotation, (1, 12, 3, 3)), wp.mat33, device)
    translations = put((nodes @ rotation.T + shift - nodes)[None], wp.vec3, device)
    np.testing.assert_allclose(graph.points(matrices, translations).numpy()[0], rest @ rotation.T + shift, atol=1e-5)
    np.testing.assert_allclose(graph.centers(translations).numpy()[0], nodes @ rotation.T + shift, atol=1e-5)
    assert graph.rigidity(matrices, translations).numpy()[0] < 1e-9
    assert graph.shear(matrices).numpy()[0] < 1e-9


def test_gradients_of_a_deformation_are_those_of_the_twin(graph, device, verified_tape):
    rng = np.random.default_rng(4)
    values = [np.eye(3) + 0.3 * rng.normal(size=(2, 12, 3, 3)), rng.normal(size=(2, 12, 3))]
    weights = rng.normal(size=(2, 30, 3))
    centers, rest = graph.node_positions.numpy().astype(float), graph.rest.numpy().astype(float)
    nodes, shares, neighbors = (a.numpy() for a in (graph.nodes, graph.weights, graph.neighbors))

    def twin(matrices, translations):
        offset = rest[:, None] - centers[nodes]
        moved = np.einsum("bpkij,pkj->bpki", matrices[:, nodes], offset) + centers[nodes] + translations[:, nodes]
        node, other = neighbors.T
        edge = centers[other] - centers[node]
        gap = np.einsum("bkij,kj->bki", matrices[:, node], edge) - edge + translations[:, node] - translations[:, other]
        shear = np.einsum("bnji,bnjk->bnik", matrices, matrices) - np.eye(3)
        points = np.sum(weights * np.einsum("pk,bpki->bpi", shares, moved))
        return points + np.sum(gap**2) + 0.5 * np.sum(shear**2) + np.sum((centers + translations) ** 2)

    arrays = [put(values[0], wp.mat33, device), put(values[1], wp.vec3, device)]
    with wp.Tape() as tape:
        points, moved = graph.points(*arrays), graph.centers(arrays[1])
        rigidity, shear = graph.rigidity(*arrays), graph.shear(arrays[0])
    points.grad.assign(weights.astype(np.float32))
    moved.grad.assign(2 * moved.numpy())
    rigidity.grad.fill_(1.0)
    shear.grad.fill_(0.5)
    tape.backward()
    for k, array in enumerate(arrays):
        expected = central_differences(lambda v, k=k: twin(*values[:k], v, *values[k + 1 :]), values[k])
        assert np.linalg.norm(array.grad.numpy() - expected) < GRADIENT * np.linalg.norm(expected)


def test_neighbors_are_pairs_both_ways_of_the_nearest_and_of_those_that_carry_the_same_points():
    line = np.linspace(0, 1, 9)[:, None] * [[1.0, 0, 0]]
    near = {tuple(pair) for pair in DeformationGraph.bind(line[:1], line, count=1).neighbors.numpy()}
    assert near == {(other, node) for node, other in near} and {(0, 1), (1, 2), (7, 8)} <= near
    assert all(abs(node - other) == 1 for node, other in near)
    far = np.array([[-5.0, 0, 0], [-4.9, 0, 0], [5.0, 0, 0], [5.1, 0, 0]])  # two pairs, joined by what lies between
    between = DeformationGraph.bind(np.zeros((20, 3)) + [0.05, 0, 0], far, count=2).neighbors.numpy()
    assert [1, 2] in between.tolist()


def test_too_few_nodes_are_refused():
    with pytest.raises(ValueError, match="count: got 4 for 3 nodes, expected 1 to 2"):
        DeformationGraph.bind(np.zeros((5, 3)), np.eye(3))


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
@pytest.mark.parametrize("name", ["rest", "rotations", "translations", "scales"])
def test_poses_refuse_what_is_not_finite_or_too_large_by_its_name(name, value, device):
    values = {
        "rest": np.ones((1, 2, 3)),
        "rotations": np.eye(3)[None, None].copy(),
        "translations": np.ones((1, 1, 3)),
        "scales": np.ones((1, 1)),
    }
    values[name].flat[-1] = value
    dtypes = wp.vec3, wp.mat33, wp.vec3, wp.float32
    rest, *similarity = (put(v, dtype, device) for v, dtype in zip(values.values(), dtypes, strict=True))
    members = wp.zeros(2, dtype=wp.int32, device=device)
    with pytest.raises(ValueError, match=f"^{name}: got 1 (NaN or Inf values|values out of range|matrices that)"):
        Poses(*similarity).points(rest, members)


@pytest.mark.parametrize("value", [np.nan, -np.inf, 2e18])
@pytest.mark.parametrize("name", ["matrices", "translations"])
def test_deformations_refuse_what_is_not_finite_or_too_large_by_its_name(name, value, graph, device):
    values = {"matrices": np.ones((1, 12, 3, 3)), "translations": np.ones((1, 12, 3))}
    values[name].flat[5] = value
    matrices, translations = put(values["matrices"], wp.mat33, device), put(values["translations"], wp.vec3, device)
    for call in (graph.points, graph.rigidity):
        with pytest.raises(ValueError, match=f"^{name}: got 1 "):
            call(matrices, translations)
    with pytest.raises(ValueError, match=f"^{name}: got 1 "):
        graph.shear(matrices) if name == "matrices" else graph.centers(translations)


def test_bodies_and_nodes_may_be_as_large_and_far_as_everything_else(graph, device):
    poses = Poses(
        put(np.eye(3)[None, None], wp.mat33, device),
        put(np.full((1, 1, 3), 5e17), wp.vec3, device),
        put([[4e17]], wp.float32, device),
    )
    members = wp.zeros(1, dtype=wp.int32, device=device)
    assert (poses.points(put(np.ones((1, 1, 3)), wp.vec3, device), members).numpy() == np.float32(9e17)).all()
    shifts = put(np.full((1, 12, 3), 1e18), wp.vec3, device)
    np.testing.assert_allclose(graph.centers(shifts).numpy(), 1e18)


@pytest.mark.parametrize("name", ["rigidity", "shear"])
def test_energies_that_are_no_float32_are_refused_and_smaller_ones_have_gradients(name, device):
    rng = np.random.default_rng(2)
    nodes = 100 * rng.normal(size=(12, 3))
    graph = DeformationGraph.bind(nodes, nodes, count=3, device=device)
    values = rng.normal(size=(1, 12, 3, 3))

    def energy(size):
        matrices, translations = put(size * values, wp.mat33, device), put(np.zeros((1, 12, 3)), wp.vec3, device)
        with wp.Tape() as tape:
            result = graph.shear(matrices) if name == "shear" else graph.rigidity(matrices, translations)
        tape.backward(grads={result: wp.ones_like(result, requires_grad=False)})
        return result.numpy(), matrices.grad.numpy()

    assert all(np.isfinite(found).all() for found in energy(1e8))
    with pytest.raises(
        ValueError, match="^matrices.*: got an energy beyond float32's range, expected smaller numbers$"
    ):
        energy(2e17)
