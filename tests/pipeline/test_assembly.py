"""Assembly: bodies as one mesh and one set of spheres, placed, deformed, and their arguments checked."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

import warpshadow as ws
from warpshadow.pipeline.assembly import Assembly
from warpshadow.stages.poses import Poses

# Rotated float32 positions of size 2.
FLOAT32 = 2e-6

pytestmark = pytest.mark.usefixtures("poisoned_outputs")


def two_bodies(device) -> Assembly:
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
    return Assembly(ws.Scene(bodies, ws.EnvironmentMap.constant(), camera), device=device)


def test_placed_bodies_are_where_the_scene_has_them(device):
    assembly = two_bodies(device)
    bodies = assembly.scene.bodies
    geometry = assembly.placed().map(lambda array: array.numpy()[0])
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
    assembly = two_bodies(device)
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
        placed = assembly.placed(poses, moving=moving)
    assert placed.moving == tuple(sorted(moving))
    starts = assembly.first_vertex, assembly.first_sphere, assembly.first_sphere
    geometries = (each.arrays().values() for each in (placed, assembly.placed(poses), assembly.placed()))
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
            part = weights[:, assembly.first_vertex[number] : assembly.first_vertex[number + 1]].sum(axis=1)
            expected = part if number in moving else np.zeros_like(part)
            assert np.abs(gradient[:, number] - expected).max() < 50 * FLOAT32  # sums of some dozens


def test_a_geometry_with_other_positions_remembers_what_moves(device):
    geometry = two_bodies(device).placed(moving=[1])
    assert replace(geometry, positions=None).moving == (1,)
    assert replace(geometry, moving=[1, 0]).moving == (0, 1)
    other = replace(geometry, radii=None)
    assert other.positions is geometry.positions and other.centers is geometry.centers


def test_what_is_handed_out_is_not_the_assemblys_own_memory(device):
    assembly = two_bodies(device)
    own = assembly.rest, assembly.scene_geometry
    kept = [each.map(lambda array: array.numpy().copy()) for each in own]
    handed_out = [
        assembly.placed(),
        assembly.placed(moving=[]),
        assembly.placed(moving=[0]),
        assembly.deformed(0),
        assembly.deformed(0, centers=wp.clone(assembly.rest.centers[:, : assembly.first_sphere[1]])),
    ]
    for geometry in handed_out:
        for array in geometry.arrays().values():
            array.fill_(-7.0)
    for before, each in zip(kept, own, strict=True):
        for name, array in each.arrays().items():
            np.testing.assert_array_equal(array.numpy(), getattr(before, name))


def test_a_body_alone_is_not_deformed_in_the_memory_of_the_argument(device):
    body = two_bodies(device).scene.bodies[0]
    scene = ws.Scene([body], ws.EnvironmentMap.constant(), ws.Camera.look_at((0, 0, 9), (0, 0, 0), size=(8, 8)))
    positions = wp.array(body.mesh.positions[None], dtype=wp.vec3, device=device)
    Assembly(scene, device=device).deformed(0, positions).positions.fill_(-7.0)
    np.testing.assert_array_equal(positions.numpy()[0], body.mesh.positions)


def test_faces_belong_to_the_vertices_of_their_body(device):
    assembly = two_bodies(device)
    faces, body_of_face = assembly.faces.numpy(), assembly.body_of_face
    for number, body in enumerate(assembly.scene.bodies):
        own = faces[body_of_face == number] - assembly.first_vertex[number]
        np.testing.assert_array_equal(own, body.mesh.faces)
    edges = assembly.edges.numpy()
    assert (body_of_face[edges] == body_of_face[:, None]).all()  # closed meshes: each edge has its other face


@pytest.mark.parametrize("number", [0, 1])
def test_deforming_a_body_leaves_the_other_as_it_is(device, number, verified_tape):
    assembly = two_bodies(device)
    rng = np.random.default_rng(1)
    vertices = slice(*assembly.first_vertex[number : number + 2])
    spheres = slice(*assembly.first_sphere[number : number + 2])
    shapes = (3, vertices.stop - vertices.start), (3, spheres.stop - spheres.start)
    positions, centers = (
        wp.array(rng.normal(size=(*shape, 3)), dtype=wp.vec3, device=device, requires_grad=True) for shape in shapes
    )
    with wp.Tape() as tape:
        rest = assembly.deformed(number, positions, centers)
    np.testing.assert_array_equal(rest.radii.numpy(), assembly.rest.radii.numpy())
    for got, given, kept, place in (
        (rest.positions, positions, assembly.rest.positions, vertices),
        (rest.centers, centers, assembly.rest.centers, spheres),
    ):
        expected = np.repeat(kept.numpy(), 3, axis=0)
        expected[:, place] = given.numpy()
        np.testing.assert_array_equal(got.numpy(), expected)
    weights = rng.normal(size=(*rest.positions.shape, 3)).astype(np.float32)
    tape.backward(grads={rest.positions: wp.array(weights, dtype=wp.vec3, device=device)})
    np.testing.assert_array_equal(positions.grad.numpy(), weights[:, vertices])


def test_a_graph_that_does_not_move_leaves_its_body_as_it_is(device):
    assembly = two_bodies(device)
    graph = assembly.deformation_graph(1, count=3)
    count = len(assembly.scene.bodies[1].blockers)
    still = wp.zeros((1, count), dtype=wp.vec3, device=device)
    matrices = wp.full((1, count), wp.mat33(np.eye(3)), dtype=wp.mat33, device=device)
    rest = assembly.deformed(1, graph.points(matrices, still), graph.centers(still))
    expected = assembly.placed()
    for name, got in assembly.placed(rest=rest).arrays().items():
        assert np.abs(got.numpy() - getattr(expected, name).numpy()).max() < 4 * FLOAT32


def test_what_does_not_fit_is_refused(device):
    assembly = two_bodies(device)
    with pytest.raises(ValueError, match="^body: got 2, expected the number of a body, from 0 to 1"):
        assembly.deformation_graph(2)
    wrong = wp.zeros((1, 7), dtype=wp.vec3, device=device)
    with pytest.raises(ValueError, match=r"^positions: got shape \(1, 7\), expected \[batch, 12\]"):
        assembly.deformed(0, wrong)
    one = assembly.poses
    poses = Poses(one.rotations[:, :1], one.translations[:, :1], one.scales[:, :1])
    with pytest.raises(ValueError, match=r"^poses: got shape \(1, 1\), expected \[batch, 2\]"):
        assembly.placed(poses)
