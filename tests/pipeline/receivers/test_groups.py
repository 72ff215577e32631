"""Receivers of many bodies in groups: neither the order of bodies nor how they are grouped shows in an image."""

import dataclasses
import itertools

import numpy as np
import pytest
import trimesh
import warp as wp

import warpshadow as ws
from warpshadow.assets.mesh import Mesh
from warpshadow.pipeline.receivers import groups
from warpshadow.pipeline.renderer import SceneRenderer
from warpshadow.stages.planes.fronts import NearestBlockers
from warpshadow.stages.receivers.body_spans import Span
from warpshadow.torch import TorchRenderer

CAMERA = ws.Camera.look_at((2.0, 2.6, 4.6), (0, 0.5, 0), fov_y=40, size=(24, 24))
VISIBILITY = ws.Visibility(directions=32)


def table_of_boxes():
    """A table whose top and legs block its own light as convex parts."""
    legs = [trimesh.creation.box((0.1, 0.8, 0.1)) for _ in range(2)]
    for leg, x in zip(legs, (-0.35, 0.35), strict=True):
        leg.apply_translation((x, 0.4, 0))
    top = trimesh.creation.box((0.9, 0.1, 0.6))
    top.apply_translation((0, 0.85, 0))
    mesh = trimesh.util.concatenate([*legs, top])
    return Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def bodies_of(kinds):
    box = trimesh.creation.box((0.5, 0.5, 0.5))
    meshes = {
        "ball": (ws.icosphere(0.4, 1), (-1.0, 0.4, 0.3), 8),
        "box": (Mesh(np.asarray(box.vertices), np.asarray(box.faces)), (1.0, 0.26, 0.5), None),
        "other_box": (Mesh(np.asarray(box.vertices), np.asarray(box.faces)), (0.2, 0.26, 1.2), None),
        "table": (table_of_boxes(), (0.1, 0.01, -0.5), None),
        "ground": (ws.plane(6.0, 4), (0, 0, 0), None),
    }
    for name in kinds:
        mesh, translation, blockers = meshes[name]
        options = {} if blockers is None else {"blockers": blockers}
        yield ws.Body(mesh, translation=translation, name=name, **options)


@pytest.mark.parametrize("bounces", [0, 1])
@pytest.mark.parametrize("kinds", [("box", "table", "ground"), ("ball", "ground", "box", "other_box")])
def test_the_order_of_bodies_does_not_change_an_image(kinds, bounces):
    """The second body is number 1, which Python takes for True."""
    images = {}
    for order in itertools.permutations(kinds):
        if order == kinds or order.index("ground") < 2:
            scene = ws.Scene(
                tuple(bodies_of(order)), ws.synthetic_sky(), CAMERA, visibility=VISIBILITY, bounces=bounces
            )
            images[order] = ws.Renderer(scene, progress=False).render()
    first = images.pop(kinds)
    for order, image in images.items():
        np.testing.assert_allclose(image, first, atol=2e-2 if bounces else 5e-4, err_msg=str(order))  # patches differ


def test_the_order_of_bodies_does_not_change_light_that_is_cached_for_static_ones():
    """Rays towards light are drawn for each vertex of a body, whatever number it has in the scene."""
    images = []
    for order in (("ball", "box", "ground"), ("ground", "ball", "box")):
        scene = ws.Scene(tuple(bodies_of(order)), ws.synthetic_sky(), CAMERA, visibility=VISIBILITY)
        renderer = TorchRenderer(scene, progress=False)
        geometry = renderer.placed(*renderer.scene_poses(), moving=["ball"])
        images.append(renderer(geometry=geometry).numpy())
    np.testing.assert_allclose(*images, atol=1e-6)


def test_points_of_no_body_get_light_from_flat_bodies():
    scene = ws.Scene(tuple(bodies_of(["ball", "ground"])), ws.synthetic_sky(), CAMERA, visibility=VISIBILITY)
    down = wp.array([[(0.0, 1.0, 0.0)]], dtype=wp.vec3), wp.array([[(0.0, -1.0, 0.0)]], dtype=wp.vec3)
    shadings = []
    for bounces in (0, 1):
        renderer = SceneRenderer(dataclasses.replace(scene, bounces=bounces), progress=False)
        shadings.append(renderer.shade(view=renderer.at_points(*down)).numpy())
    assert (shadings[1] > shadings[0] + 0.1).all()


def test_portions_have_their_receivers_part_of_each_array(monkeypatch):
    monkeypatch.setattr(groups, "RECEIVERS_AT_ONCE", 4)
    numbers = np.arange(10, dtype=np.float32)
    points = wp.array(np.repeat(numbers[None, :, None], 3, axis=2), dtype=wp.vec3)
    nearest = NearestBlockers(points, wp.zeros((1, 10)), wp.array(numbers, dtype=wp.int32))
    spans = Span(0, 0, 3), Span(1, 3, 10)
    group = groups.Group(points, points, groups.GroupBlockers(), points, spans, nearest_blockers=nearest)
    portions = list(group.portions())
    assert [portion.first for portion in portions] == [0, 3, 7]
    assert [portion.spans for portion in portions] == [(Span(0, 0, 3),), (Span(1, 0, 4),), (Span(1, 0, 3),)]
    for portion in portions:
        expected = numbers[portion.first : portion.first + portion.spans[-1].end]
        arrays = [value for value in vars(portion).values() if isinstance(value, wp.array)]
        assert len(arrays) == 3 and all((array.numpy()[0, :, 0] == expected).all() for array in arrays)
        assert (portion.nearest_blockers.blocker_indices.numpy() == expected).all()
