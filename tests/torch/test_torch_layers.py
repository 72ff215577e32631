"""Layers of tensors: those of the renderer, and gradients that are central differences, inside and at silhouettes."""

import dataclasses

import numpy as np
import pytest
import torch

import warpshadow as ws
from warpshadow.torch import TorchRenderer, rotation_matrices

SIZE = 32, 24
# float32 kernels against float64 differences of the twin, relative L2.
ADJOINT = 2e-3
# Differences of float32 images over steps in which pixels pass from face to face, relative.
DIFFERENCE = 0.02
# Of coverage: edges of a ball move over whole samples, whose share is linear only between neighbors.
SILHOUETTE = 0.04
# Of the coverage by both: where the ball's outline meets the border of the sheet, pairs of samples have edges of both.
# Measured 4.7%; over 25 poses 4.4% on average, of the ball's own mask 1.1%.
JUNCTION = 0.06


def scene(*, supersampling=2, subdivisions=2, open_sheet=False):
    ball = ws.Body(ws.icosphere(0.7, subdivisions), blockers=0, translation=(0.2, 0.8, 0))
    sheet = ws.Body(ws.plane(3.0, 3), blockers=0, rotation=(180, 0, 0) if open_sheet else (0, 0, 0))
    camera = ws.Camera.look_at((1.0, 2.0, 4.0), (0, 0.6, 0), size=SIZE)
    return ws.Scene([ball, sheet], ws.EnvironmentMap.constant(), camera, ws.Visibility("none"), supersampling)


@pytest.mark.parametrize("open_sheet", [False, True])
def test_tensors_hold_the_layers_of_the_renderer(open_sheet):
    renderer = TorchRenderer(scene(open_sheet=open_sheet))
    plain, found = ws.Renderer(renderer.scene).layers(), renderer.layers()
    for name in plain._fields:
        np.testing.assert_array_equal(getattr(found, name).numpy(), getattr(plain, name))
    np.testing.assert_allclose(found.coverage.numpy(), renderer()[..., 3].numpy(), atol=1e-6)
    R, t, s = renderer.scene_poses()
    batch = renderer.layers(geometry=renderer.placed(R.expand(3, -1, -1, -1), t, s))
    assert batch.masks.shape == (3, 2, *SIZE[::-1]) and batch.coverage.shape == (3, *SIZE[::-1])
    torch.testing.assert_close(batch.depth[2], found.depth)


def test_more_than_four_bodies_have_a_mask_each():
    balls = [ws.Body(ws.icosphere(0.2, 1), blockers=0, translation=(x, 0.5, 0)) for x in np.linspace(-1, 1, 5)]
    renderer = TorchRenderer(dataclasses.replace(scene(), bodies=tuple(balls)))
    masks = renderer.layers().masks
    assert masks.shape[0] == 5
    for number in range(5):
        assert masks[number].sum() > 1


def twin(positions, faces, face_ids, is_back, camera):
    """Depth [pixel] and normals [pixel, 3] of the faces that rays through pixel centers meet, float64."""
    corners = positions[faces]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(positions)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], crosses)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    eye, directions = camera.rays()
    seen = face_ids >= 0
    a, b, c = np.moveaxis(corners[face_ids[seen]], 1, 0)
    # eye + distance d = a + v (b − a) + w (c − a)
    distance, v, w = np.linalg.solve(np.stack([-directions[seen], b - a, c - a], axis=-1), (eye - a)[..., None])[
        ..., 0
    ].T
    of_corners = normals[faces[face_ids[seen]]]
    summed = np.einsum("kp,pkd->pd", [1 - v - w, v, w], of_corners)
    depth = distance * (directions[seen] @ camera.rotation[2])
    sign = np.where(is_back[seen], -1.0, 1.0)[:, None]
    return depth, sign * summed / np.linalg.norm(summed, axis=1, keepdims=True)


@pytest.mark.parametrize("open_sheet", [False, True])
def test_gradients_of_depth_and_normals_to_vertices_are_those_of_the_twin(open_sheet):
    renderer = TorchRenderer(scene(subdivisions=1, open_sheet=open_sheet))
    camera = renderer.scene.camera
    geometry = renderer.placed(*renderer.scene_poses())
    positions = geometry.positions.clone().requires_grad_()
    found = renderer.layers(geometry=dataclasses.replace(geometry, positions=positions))
    plain = ws.Renderer(dataclasses.replace(renderer.scene, supersampling=1))  # a sample is a pixel's center
    fragments = plain.view().fragments
    face_ids = fragments.face_ids.numpy()[0]
    is_back = np.zeros(face_ids.shape, bool) if fragments.sides is None else fragments.sides.numpy()[0] != face_ids
    assert is_back.any() == open_sheet
    fixed = renderer.array_renderer.merged_scene.faces.numpy(), face_ids, is_back, camera
    seen = torch.tensor(face_ids >= 0)
    rng = np.random.default_rng(0)
    of_depth, of_normals = rng.normal(size=int(seen.sum())), rng.normal(size=(int(seen.sum()), 3))

    def weighed(points):
        depth, normals = twin(points, *fixed)
        return (of_depth * depth).sum(), (of_normals * normals).sum()

    at_rest = geometry.positions.double().numpy()
    depth, normals = twin(at_rest, *fixed)
    np.testing.assert_allclose(found.depth[seen].detach().numpy(), depth, atol=2e-5)
    np.testing.assert_allclose(found.normals[seen].detach().numpy(), normals, atol=2e-5)
    losses = [
        (found.depth[seen] * torch.tensor(of_depth)).sum(),
        (found.normals[seen] * torch.tensor(of_normals)).sum(),
    ]
    expected = np.zeros((2, *at_rest.shape))
    for index in np.ndindex(at_rest.shape):
        ends = []
        for step in (1e-6, -1e-6):
            moved = at_rest.copy()
            moved[index] += step
            ends.append(weighed(moved))
        expected[(slice(None), *index)] = (np.array(ends[0]) - ends[1]) / 2e-6
    for loss, wanted in zip(losses, expected, strict=True):
        (got,) = torch.autograd.grad(loss, positions, retain_graph=True)
        assert np.linalg.norm(got.numpy() - wanted) < ADJOINT * np.linalg.norm(wanted)


def interior(bodies):
    """Pixels whose neighbors show the same body."""
    same = np.ones(bodies.shape, bool)
    for axis in (0, 1):
        for way in (-1, 1):
            same &= np.roll(bodies, way, axis) == bodies
    same[[0, -1]] = same[:, [0, -1]] = False
    return same & (bodies == 0)


@pytest.mark.parametrize("layer", ["depth", "normals"])
@pytest.mark.parametrize("moved", ["turns", "shifts", "camera"])
def test_gradients_of_depth_and_normals_to_poses_and_cameras_are_differences(layer, moved):
    body = ws.Body(ws.icosphere(0.7, 4).transformed(scale=(1, 0.7, 1.3)), blockers=0, translation=(0.2, 0.8, 0))
    renderer = TorchRenderer(dataclasses.replace(scene(), bodies=(body,)))
    R, t, s = renderer.scene_poses()
    to_camera, origin, K = renderer.scene_cameras()
    inside = torch.tensor(interior(renderer.layers().bodies.numpy()))
    rows, columns = torch.meshgrid(*(torch.linspace(-1, 1, count) for count in SIZE[::-1]), indexing="ij")
    weights = inside * (1 + rows + 2 * columns)

    def loss(values):
        turn, shift, eye = (values if moved == name else torch.zeros(3) for name in ("turns", "shifts", "camera"))
        geometry = renderer.placed(rotation_matrices(turn[None]) @ R, t + shift, s)
        matrices = renderer.clip_matrices(to_camera, origin + eye, K)
        found = getattr(renderer.layers(geometry=geometry, clip_matrices=matrices), layer)
        found = found if layer == "depth" else found @ torch.tensor([0.5, -1.0, 0.7])
        return (weights * found).sum()

    values = torch.zeros(3, requires_grad=True)
    (got,) = torch.autograd.grad(loss(values), values)
    step = 0.01
    with torch.no_grad():
        wanted = torch.stack([(loss(step * way) - loss(-step * way)) / (2 * step) for way in torch.eye(3)])
    assert (got - wanted).norm() < DIFFERENCE * wanted.norm()


@pytest.mark.parametrize("body", [0, 1, None])
def test_gradients_of_masks_and_coverage_are_differences_at_silhouettes(body):
    renderer = TorchRenderer(scene(subdivisions=3))
    R, t, s = renderer.scene_poses()
    rows, columns = torch.meshgrid(*(torch.linspace(-1, 1, count) for count in SIZE[::-1]), indexing="ij")
    weights = torch.sin(2 * rows + 1) + torch.cos(3 * columns)

    def loss(shift):
        found = renderer.layers(geometry=renderer.placed(R, t + torch.stack([shift, torch.zeros(3)]), s))
        return (weights * (found.coverage if body is None else found.masks[body])).sum()

    shift = torch.zeros(3, requires_grad=True)
    (got,) = torch.autograd.grad(loss(shift), shift)
    step = 0.05
    with torch.no_grad():
        wanted = torch.stack([(loss(step * way) - loss(-step * way)) / (2 * step) for way in torch.eye(3)])
    assert wanted.norm() > 1
    assert (got - wanted).norm() < (JUNCTION if body is None else SILHOUETTE) * wanted.norm()


def test_a_shape_is_found_by_its_depth_and_mask():
    renderer = TorchRenderer(scene())
    R, t, s = renderer.scene_poses()
    target = renderer.layers()
    shift = torch.tensor([0.15, -0.1, 0.1], requires_grad=True)
    optimizer = torch.optim.Adam([shift], lr=0.02)
    for _ in range(40):
        optimizer.zero_grad()
        found = renderer.layers(geometry=renderer.placed(R, t + torch.stack([shift, torch.zeros(3)]), s))
        both = (found.bodies == 0) & (target.bodies == 0)
        loss = (found.masks - target.masks).square().mean() + (found.depth - target.depth)[both].square().mean()
        loss.backward()
        optimizer.step()
    assert shift.detach().norm() < 0.02
