"""Packets of rays: what they meet is what single rays meet."""

import numpy as np
import pytest
import warp as wp

import warpshadow as ws
from warpshadow.device.lanes import lane_type, module_options, vectors_type
from warpshadow.maths.directions import fibonacci
from warpshadow.stages.rays.ray_packets import PACKET, FaceTree, Hits, build_face_tree, make_find_first, make_find_open
from warpshadow.stages.rays.ray_tracing import first_hit, trace_visibility

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

# Of so many rays some pass so near to an edge that float32 and float64 differ.
NEAR_EDGES = 2e-4

Lane, Vectors, find_open, find_first = lane_type(PACKET), vectors_type(PACKET), make_find_open(), make_find_first()


@wp.kernel(module="unique", module_options=module_options(PACKET), enable_backward=False)
def trace(
    tree: FaceTree,
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    directions: wp.array2d(dtype=Lane),
    wanted: wp.array2d(dtype=wp.int32),
    found: wp.array2d(dtype=wp.int32),
):
    point, packet = wp.tid()
    toward = Vectors(directions[packet, 0], directions[packet, 1], directions[packet, 2])
    open_rays, _face = find_open(tree, points[point], normals[point], toward, wanted[point, packet], -1)
    found[point, packet] = open_rays


@wp.kernel(module="unique", module_options=module_options(PACKET), enable_backward=False)
def meet(
    mesh: wp.uint64,
    tree: FaceTree,
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    directions: wp.array2d(dtype=Lane),
    by_packets: wp.array2d(dtype=Hits),
    by_rays: wp.array2d(dtype=Hits),
):
    point, packet = wp.tid()
    toward = Vectors(directions[packet, 0], directions[packet, 1], directions[packet, 2])
    found = find_first(tree, points[point], normals[point], toward)
    expected = Hits()
    for lane in range(PACKET):
        if found[lane] >= 0:
            found[lane] = 2 * tree.face_ids[found[lane] // 2] + found[lane] % 2
        ray = wp.vec3(toward.x[lane], toward.y[lane], toward.z[lane])
        hit = first_hit(mesh, points[point], normals[point], ray)
        expected[lane] = wp.where(hit.face < 0, -1, 2 * hit.face + wp.where(hit.is_back, 1, 0))
    by_packets[point, packet] = found
    by_rays[point, packet] = expected


def knot() -> tuple[np.ndarray, np.ndarray]:
    """A ball with dents and an icosahedron through it: sharp edges, and points inside another part."""
    ball, box = ws.icosphere(1.0, 3), ws.icosphere(0.5, 0)
    points = ball.positions * (1 - 0.5 * np.exp(-8 * np.abs(ball.positions[:, :1])))
    both = np.concatenate([points, box.positions + (0.7, 0.1, 0)])
    return both.astype(np.float32), np.concatenate([ball.faces, box.faces + len(points)])


@pytest.mark.parametrize("face_count", [0, 1, 7, None])
def test_packets_meet_what_single_rays_meet(device, face_count):
    positions, faces = knot()
    faces = faces[:face_count]
    rng = np.random.default_rng(0)
    corners = positions[knot()[1]]
    on_faces = np.einsum("fk,fkx->fx", rng.dirichlet([1, 1, 1], len(corners)), corners)
    points = np.concatenate([positions[::5], on_faces[::7], rng.normal(size=(50, 3))]).astype(np.float32)
    normals = rng.normal(size=points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    directions = fibonacci(256)
    is_up = normals @ directions.T > 0
    wanted = (is_up.reshape(len(points), -1, PACKET) << np.arange(PACKET)).sum(axis=2)
    found = wp.empty(wanted.shape, dtype=wp.int32, device=device)
    places, facing = (wp.array(values, dtype=wp.vec3, device=device) for values in (points, normals))
    lanes = wp.array(directions.reshape(-1, PACKET, 3).swapaxes(1, 2), dtype=Lane, device=device)
    tree = build_face_tree(positions, faces, device)
    inputs = [tree, places, facing, lanes, wp.array(wanted, dtype=wp.int32, device=device)]
    wp.launch(trace, dim=wanted.shape, inputs=inputs, outputs=[found], device=device)
    is_open = (found.numpy()[..., None] >> np.arange(PACKET) & 1).reshape(is_up.shape).astype(bool)
    towards = wp.array(directions, dtype=wp.vec3, device=device)
    mesh = None
    if len(faces):
        numbers = wp.array(faces.ravel(), dtype=wp.int32, device=device)
        mesh = wp.Mesh(wp.array(positions, dtype=wp.vec3, device=device), numbers)
    expected = trace_visibility(mesh, places.reshape((1, -1)), facing.reshape((1, -1)), towards).numpy()[0] > 0
    assert (is_open != expected).mean() < NEAR_EDGES
    if face_count is None:
        assert 0.2 < expected[is_up].mean() < 0.8


def test_packets_meet_the_first_faces_that_single_rays_meet(device):
    positions, faces = knot()
    rng = np.random.default_rng(0)
    corners = positions[faces][::3]
    on_faces = np.einsum("fk,fkx->fx", rng.dirichlet([1, 1, 1], len(corners)), corners)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    tilted = normals / np.linalg.norm(normals, axis=1, keepdims=True) + rng.normal(scale=0.2, size=normals.shape)
    inner = rng.uniform(-0.5, 0.5, size=(100, 3))
    points = np.concatenate([on_faces, inner]).astype(np.float32)
    normals = np.concatenate([tilted, rng.normal(size=inner.shape)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    directions = fibonacci(512)
    mesh = wp.Mesh(
        wp.array(positions, dtype=wp.vec3, device=device), wp.array(faces.ravel(), dtype=wp.int32, device=device)
    )
    lanes = wp.array(directions.reshape(-1, PACKET, 3).swapaxes(1, 2), dtype=Lane, device=device)
    places, facing = (wp.array(values, dtype=wp.vec3, device=device) for values in (points, normals))
    outputs = [wp.empty((len(points), len(lanes)), dtype=Hits, device=device) for _ in range(2)]
    inputs = [mesh.id, build_face_tree(positions, faces, device), places, facing, lanes]
    wp.launch(meet, dim=outputs[0].shape, inputs=inputs, outputs=outputs, device=device)
    is_up = normals @ directions.T > 0  # packets leave out faces below the horizon
    found, expected = (array.numpy().reshape(is_up.shape)[is_up] for array in outputs)
    assert (found != expected).mean() < NEAR_EDGES
    assert 0.1 < (expected >= 0).mean() < 0.9
    assert set(expected[expected >= 0] % 2) == {0, 1}


def test_every_face_is_in_a_leaf_and_within_its_boxes():
    positions, faces = knot()
    tree = build_face_tree(positions, faces)
    corners, lowers, uppers = (array.numpy() for array in (tree.corners, tree.lowers, tree.uppers))
    given = positions[faces].reshape(len(faces), -1)
    np.testing.assert_array_equal(corners, positions[faces[tree.face_ids.numpy()]])
    np.testing.assert_array_equal(np.unique(corners.reshape(len(faces), -1), axis=0), np.unique(given, axis=0))
    for face, points in enumerate(corners):
        box = tree.leaf_count + next(
            k for k in range(tree.leaf_count) if face < (k + 1) * len(faces) // tree.leaf_count
        )
        while box:
            assert (lowers[box] < points).all() and (points < uppers[box]).all()
            box //= 2
