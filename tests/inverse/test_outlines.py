"""Outlines of bodies in photographs, and their offset."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy import ndimage

import warpshadow as ws
from warpshadow.inverse import OutlineOffset, Pose, Problem, Stage, Target, fit, load_fit
from warpshadow.inverse.edges import signed_distances
from warpshadow.inverse.model import Model

# Distances of pixels of an edge that is not along the axes, from the part that they cover.
SUBPIXEL = 0.15
# Central differences of a mean of float32 pixels; over longer steps edges pass pixels' centers, where the loss bends.
# One slope is a hundredth of the other, 0.32: 4.1e-4 off; over 25 poses slopes of 0.1 are 0.0018 off, root mean square.
STEP, DIFFERENCE, SMALL_SLOPE = 1e-3, 0.02, 0.03


def scene() -> ws.Scene:
    corners = ws.icosphere(1.0, 2)
    body = ws.Body(
        dataclasses.replace(corners, positions=corners.positions * (0.8, 1.2, 0.6)), blockers=0, name="lump"
    ).on_ground()
    ground = ws.Body(ws.plane(8.0, 4), blockers=0, name="table")
    camera = ws.Camera.look_at((1, 2.5, 4), (0, 0.9, 0), size=(48, 48), fov_y=45)
    return ws.Scene((body, ground), np.ones((4, 3)), camera, ws.Visibility("none"))


@pytest.fixture(scope="module")
def outline() -> np.ndarray:
    alone = dataclasses.replace(scene(), bodies=scene().bodies[:1], supersampling=8)
    return ws.render(alone)[..., 3]


def target(outline: np.ndarray) -> Target:
    return Target(np.full((48, 48, 3), 0.3), outlines={"lump": outline})


def test_distances_are_those_from_the_edge():
    row, column = np.indices((40, 40)) + 0.5
    exact = 12.3 - np.hypot(row - 20.2, column - 19.6)
    distances = signed_distances(np.clip(exact + 0.5, 0, 1))
    np.testing.assert_allclose(distances[np.abs(exact) < 0.4], exact[np.abs(exact) < 0.4], atol=SUBPIXEL)
    assert np.abs(distances - exact).max() < 0.8
    assert signed_distances(np.zeros((4, 4))).max() < -4 and signed_distances(np.ones((4, 4))).min() > 4


def test_gradients_of_pose_and_offset_are_those_of_differences(outline):
    problem = Problem(scene(), target(outline), [Pose(0, stands_on=1, resting="given"), OutlineOffset()])
    context = problem.context(torch.device("cpu"))
    model = Model(problem, context, Stage(compares="outlines"))
    values = problem.start(context)
    values["pose[0]"]["shift"] += torch.tensor([0.04, -0.03])
    values["outline_offset"]["offset"] += 0.3  # at 0, pixels beside the edge have a derivative to one side
    tensors = [values["pose[0]"]["shift"], values["outline_offset"]["offset"]]
    for tensor in tensors:
        tensor.requires_grad_()
    loss, images = model.loss(values)
    loss.backward()
    assert images is None  # nothing was shaded
    for tensor in tensors:
        for number in range(tensor.numel()):
            losses = []
            for step in (STEP, -STEP):
                with torch.no_grad():
                    tensor[number] += step
                    losses.append(float(model.loss(values)[0]))
                    tensor[number] -= step
            slope = (losses[0] - losses[1]) / (2 * STEP)
            assert abs(float(tensor.grad[number]) - slope) < DIFFERENCE * max(abs(slope), SMALL_SLOPE)


@pytest.mark.parametrize("pixels", [-1, 1])
def test_a_mask_that_is_wrong_by_a_pixel_leaves_a_body_that_stands_where_it_is(outline, pixels):
    grow = ndimage.grey_dilation if pixels > 0 else ndimage.grey_erosion
    wrong = grow(outline, footprint=ndimage.generate_binary_structure(2, 1))
    truth = scene()
    start = dataclasses.replace(truth.bodies[0], translation=np.array(truth.bodies[0].translation) + (0.2, 0.1, -0.25))
    start = dataclasses.replace(truth, bodies=(start, truth.bodies[1]))
    problem = Problem(start, target(wrong), [Pose("lump", stands_on="table", resting="given"), OutlineOffset()])
    result = fit(problem, [Stage(60, 0.05, compares="outlines")], progress=False)
    (found,) = result.found.outline_offsets
    assert abs(found + pixels) < 0.6
    low, high = truth.bodies[0].world_mesh().bounds
    away = np.array(result.scene.bodies[0].translation) - truth.bodies[0].translation
    assert np.linalg.norm(away) < 0.01 * np.linalg.norm(high - low)


def test_outlines_must_be_there_and_be_masks(outline):
    with pytest.raises(ValueError, match=r"outlines\['lump'\]: mask: got"):
        Target(np.ones((4, 4, 3)), outlines={"lump": np.ones((4, 5))})
    with pytest.raises(ValueError, match=r"targets\[0\].outlines: got 'vase'"):
        Problem(scene(), Target(np.ones((48, 48, 3)), outlines={"vase": outline}), Pose(0))
    with pytest.raises(ValueError, match='compares = "outlines" for a target without'):
        fit(Problem(scene(), Target(np.ones((48, 48, 3))), Pose(0)), [Stage(compares="outlines")])


def test_a_fit_file_has_the_same_keys(tmp_path, outline):
    ws.write_scene(scene(), tmp_path)
    ws.write_image(tmp_path / "photo.exr", np.full((48, 48, 3), 0.3))
    ws.write_image(tmp_path / "lump.exr", outline)
    (tmp_path / "fit.toml").write_text(
        'scene = "scene.toml"\n[[target]]\nimage = "photo.exr"\n[target.outlines]\n0 = "lump.exr"\n'
        "[free]\noutline_offset = {deviation = 2.0}\n[[free.pose]]\nbody = 0\n[[stage]]\ncompares = 'outlines'\n"
    )
    loaded = load_fit(tmp_path / "fit.toml")
    assert OutlineOffset(2.0) in loaded.problem.free and loaded.stages[0].compares == "outlines"
    np.testing.assert_allclose(loaded.problem.targets[0].outlines[0], outline, atol=1e-6)
