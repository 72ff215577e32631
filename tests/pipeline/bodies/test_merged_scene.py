"""MergedScene: bodies as one mesh and one set of spheres, placed, deformed, and their arguments checked."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

import warpshadow as ws
from warpshadow.pipeline.bodies.free_shapes import FreeShapes
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.stages.geometry.poses import Poses

# Rotated float32 positions of size 2.
FLOAT32 = 2e-6

pytestmark = pytest.mark.usefixtures("poisoned_outputs")


def two_bodies(device) -> MergedScene:
    rng = np.random.default_rng(0)
    bodies = [
        ws.Body(
            ws.icosphere(1.0, level),
            blockers=ws.Spheres(rng.normal(size=(5 + level, 3)), rng.uniform(0.1, 1, 5 + level)),
            rotation=rng.normal(size=3) * 40,
            translation=rng.normal(size=3),
            scale=0.5 + level,
        )
        for level in (0, 1)
    ]
    camera = ws.Camera.look_at((0, 0, 9), (0, 0, 0), size=(8, 8))
    return MergedScene(ws.Scene(bodies, ws.EnvironmentMap.constant(), camera), device=device)


def test_placed_bodies_are_where_the_scene_has_them(device):
    merged_scene = two_bodies(device)
    bodies = merged_scene.scene.bodies
    geometry = merged_scene.placed().map(lambda array: array.numpy()[0])
    expected = np.concatenate([body.world_mesh().positions for body in bodies])
    assert np.abs(geometry.positions - expected).max() < FLOAT32
    placed = [
        body.blockers.transformed(rotation=body.rotation_matrix(), translation=body.translation, scale=body.scale)
        for body in bodies
    ]
    assert np.abs(geometry.centers - np.concatenate([part.centers for part in placed])).max() < 4 * FLOAT32
    assert np.abs(geometry.radii - np.concatenate([part.radii for part in placed])).max() < FLOAT32


@pytest.mark.parametrize("moving", [[0], [1], [], [1, 0]])
def test_bodies_that_do_not_move_stand_where_the_scene_has_them(device, moving, verified_tape):
    merged_scene = two_bodies(device)
    rng = np.random.default_rng(5)
    rotations = Rotation.random(6, random_state=5).as_matrix().reshape(3, 2, 3, 3)
    arrays = rotations, rng.normal(size=(3, 2, 3)), rng.uniform(0.5, 2, (3, 2))
    dtypes = wp.mat33, wp.vec3, wp.float32
    poses = Poses(
        *(
            wp.array(array, dtype=dtype, device=device, requires_grad=True)
            for array, dtype in zip(arrays, dtypes, strict=True)
        )
    )
    with wp.Tape() as tape:
        placed = merged_scene.placed(poses, moving=moving)
    assert placed.moving == tuple(sorted(moving))
    starts = merged_scene.first_vertex, merged_scene.first_sphere, merged_scene.first_sphere
    geometries = (each.arrays().values() for each in (placed, merged_scene.placed(poses), merged_scene.placed()))
    for got, all_moved, still, start in zip(*geometries, starts, strict=True):
        for number in range(2):
            place = np.s_[:, start[number] : start[number + 1]]
            expected = all_moved if number in moving else still
            np.testing.assert_array_equal(
                got.numpy()[place], np.broadcast_to(expected.numpy()[place], got.numpy()[place].shape)
            )
    if moving:
        weights = rng.normal(size=(*placed.positions.shape, 3)).astype(np.float32)
        tape.backward(grads={placed.positions: wp.array(weights, dtype=wp.vec3, device=device)})
        gradient = poses.translations.grad.numpy()
        for number in range(2):
            part = weights[:, merged_scene.first_vertex[number] : merged_scene.first_vertex[number + 1]].sum(axis=1)
            expected = part if number in moving else np.zeros_like(part)
            assert np.abs(gradient[:, number] - expected).max() < 50 * FLOAT32  # sums of some dozens


def test_a_geometry_with_other_positions_remembers_what_moves(device):
    geometry = two_bodies(device).placed(moving=[1])
    assert replace(geometry, positions=None).moving == (1,)
    assert replace(geometry, moving=[1, 0]).moving == (0, 1)
    other = replace(geometry, radii=None)
    assert other.positions is geometry.positions and other.centers is geometry.centers


def test_what_is_handed_out_is_not_the_assemblys_own_memory(device):
    merged_scene = two_bodies(device)
    own = merged_scene.rest, merged_scene.scene_geometry
    cached = [each.map(lambda array: array.numpy().copy()) for each in own]
    handed_out = [
        merged_scene.placed(),
        merged_scene.placed(moving=[]),
        merged_scene.placed(moving=[0]),
        FreeShapes(merged_scene).deformed(0),
        FreeShapes(merged_scene).deformed(
            0, centers=wp.clone(merged_scene.rest.centers[:, : merged_scene.first_sphere[1]])
        ),
    ]
    for geometry in handed_out:
        for array in geometry.arrays().values():
            array.fill_(-7.0)
    for before, each in zip(cached, own, strict=True):
        for name, array in each.arrays().items():
            np.testing.assert_array_equal(array.numpy(), getattr(before, name))


def test_a_body_alone_is_not_deformed_in_the_memory_of_the_argument(device):
    body = two_bodies(device).scene.bodies[0]
    scene = ws.Scene([body], ws.EnvironmentMap.constant(), ws.Camera.look_at((0, 0, 9), (0, 0, 0), size=(8, 8)))
    positions = wp.array(body.mesh.positions[None], dtype=wp.vec3, device=device)
    FreeShapes(MergedScene(scene, device=device)).deformed(0, positions).positions.fill_(-7.0)
    np.testing.assert_array_equal(positions.numpy()[0], body.mesh.positions)


def test_faces_belong_to_the_vertices_of_their_body(device):
    merged_scene = two_bodies(device)
    faces, body_of_face = merged_scene.faces.numpy(), merged_scene.body_of_face
    for number, body in enumerate(merged_scene.scene.bodies):
        own = faces[body_of_face == number] - merged_scene.first_vertex[number]
        np.testing.assert_array_equal(own, body.mesh.faces)
    edges = merged_scene.face_neighbors.numpy()
    assert (body_of_face[edges] == body_of_face[:, None]).all()  # closed meshes: each edge has its other face


@pytest.mark.parametrize("number", [0, 1])
def test_deforming_a_body_leaves_the_other_as_it_is(device, number, verified_tape):
    merged_scene = two_bodies(device)
    rng = np.random.default_rng(1)
    vertices = slice(*merged_scene.first_vertex[number : number + 2])
    spheres = slice(*merged_scene.first_sphere[number : number + 2])
    shapes = (3, vertices.stop - vertices.start), (3, spheres.stop - spheres.start)
    positions, centers = (
        wp.array(rng.normal(size=(*shape, 3)), dtype=wp.vec3, device=device, requires_grad=True) for shape in shapes
    )
    with wp.Tape() as tape:
        rest = FreeShapes(merged_scene).deformed(number, positions, centers)
    np.testing.assert_array_equal(rest.radii.numpy(), merged_scene.rest.radii.numpy())
    for got, given, cached, place in (
        (rest.positions, positions, merged_scene.rest.positions, vertices),
        (rest.centers, centers, merged_scene.rest.centers, spheres),
    ):
        expected = np.repeat(cached.numpy(), 3, axis=0)
        expected[:, place] = given.numpy()
        np.testing.assert_array_equal(got.numpy(), expected)
    weights = rng.normal(size=(*rest.positions.shape, 3)).astype(np.float32)
    tape.backward(grads={rest.positions: wp.array(weights, dtype=wp.vec3, device=device)})
    np.testing.assert_array_equal(positions.grad.numpy(), weights[:, vertices])


def test_a_graph_that_does_not_move_leaves_its_body_as_it_is(device):
    merged_scene = two_bodies(device)
    graph = FreeShapes(merged_scene).deformation_graph(1, count=3)
    count = len(merged_scene.scene.bodies[1].blockers)
    still = wp.zeros((1, count), dtype=wp.vec3, device=device)
    matrices = wp.full((1, count), wp.mat33(np.eye(3)), dtype=wp.mat33, device=device)
    rest = FreeShapes(merged_scene).deformed(1, graph.points(matrices, still), graph.centers(still))
    expected = merged_scene.placed()
    for name, got in merged_scene.placed(rest=rest).arrays().items():
        assert np.abs(got.numpy() - getattr(expected, name).numpy()).max() < 4 * FLOAT32


def test_what_does_not_fit_is_refused(device):
    merged_scene = two_bodies(device)
    with pytest.raises(ValueError, match="^body: got 2, expected the number of a body, from 0 to 1"):
        FreeShapes(merged_scene).deformation_graph(2)
    wrong = wp.zeros((1, 7), dtype=wp.vec3, device=device)
    with pytest.raises(ValueError, match=r"^positions: got shape \(1, 7\), expected \[batch, 12\]"):
        FreeShapes(merged_scene).deformed(0, wrong)
    one = merged_scene.poses
    poses = Poses(one.rotations[:, :1], one.translations[:, :1], one.scales[:, :1])
    with pytest.raises(ValueError, match=r"^poses: got shape \(1, 1\), expected \[batch, 2\]"):
        merged_scene.placed(poses)
