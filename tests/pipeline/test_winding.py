"""Images do not depend on how the faces of open bodies wind, however their vertices lie on those of others."""

import numpy as np
import pytest
import torch

import warpshadow as ws
from warpshadow.torch import TorchRenderer

pytestmark = pytest.mark.filterwarnings("ignore:.*float above")


def sides(size: tuple[float, float, float], cuts: int, count: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Sides of a box around the origin, wound outward, with vertices of their own: positions and faces."""
    side = ws.plane(1.0, cuts)  # looks up
    turns = [np.roll(np.eye(3), shift, axis=0) for shift in range(3)]
    turns += [np.diag([1, -1, -1]) @ turn for turn in turns]
    positions = [(side.positions + (0, 0.5, 0)) @ turn for turn in turns[:count]]
    faces = [side.faces + number * side.vertex_count for number in range(count)]
    return np.concatenate(positions) * size, np.concatenate(faces)


def turned_back(faces: np.ndarray) -> np.ndarray:
    """Faces that wind the other way, from the same first corner."""
    return faces[:, [0, 2, 1]]


def test_a_room_of_one_body_is_as_bright_whichever_way_it_winds():
    """Wound outward, the seams of its walls were twice to four times as bright: 20% of the image in direct light."""
    positions, faces = sides((3.0, 2.2, 3.0), 6, 5)
    images = []
    for each in (faces, turned_back(faces)):
        room = ws.Body(ws.Mesh(positions, each), albedo=(0.8,) * 3, receivers="pixel", name="room")
        ball = ws.Body(ws.icosphere(0.4, 2), blockers=ws.Spheres([[0, 0, 0]], [0.4]), translation=(0.7, -0.6, 0.2))
        camera = ws.Camera.look_at((0, 0.1, -4), (0, 0, 0), size=(32, 32))  # sees the open side
        scene = ws.Scene([room, ball], ws.EnvironmentMap.constant(1.0, height=16), camera, bounces=2)
        images.append(ws.Renderer(scene, progress=False).render()[..., :3])
    assert np.linalg.norm(images[0] - images[1]) < 0.01 * np.linalg.norm(images[1])


def on_ground(faces: np.ndarray, receivers: str, **options) -> ws.Scene:
    """A box that stands on a ground, and a ball beside it."""
    positions, box_faces = sides((1.0, 1.0, 1.0), 6)
    bodies = [
        ws.Body(ws.Mesh(positions + (0, 0.5, 0), box_faces), (0.8,) * 3, receivers=receivers, name="box"),
        ws.Body(ws.Mesh(GROUND.positions, faces), (0.5,) * 3, receivers=receivers, name="ground"),
        ws.Body(ws.icosphere(0.2, 2), blockers=ws.Spheres([[0, 0, 0]], [0.2]), translation=(1, 0.5, 1), name="ball"),
    ]
    camera = ws.Camera.look_at((2.2, 1, 3), (0, 0.4, 0), size=(64, 64), fov_y=32)
    return ws.Scene(bodies, ws.synthetic_sky(height=32), camera, **options)


GROUND = ws.plane(6.0, 32)
WINDINGS = GROUND.faces, turned_back(GROUND.faces)


def test_receivers_are_chosen_alike():
    """The lower vertices of a box once lay below a ground that looks down, in light from there."""
    choices = [
        [body.receivers for body in ws.Renderer(on_ground(faces, "auto"), progress=False).scene.bodies]
        for faces in WINDINGS
    ]
    assert choices[0] == choices[1]


def test_a_static_box_on_a_static_ground_has_its_light(device):
    """It was 4% darker above a ground that looks down, and bounced light by rays 2%."""
    images = []
    for faces in WINDINGS:
        renderer = TorchRenderer(on_ground(faces, "vertex"), device=device, progress=False)
        geometry = renderer.placed(*renderer.scene_poses(), moving=["ball"])
        bounced = TorchRenderer(on_ground(faces, "vertex", bounces=2), device=device, progress=False)
        colors = {"box": torch.full((3,), 0.8, device=renderer.device)}
        images.append([renderer(geometry=geometry).cpu().numpy(), bounced(albedo=colors).cpu().numpy()])
    for up, down in zip(*images, strict=True):
        assert np.linalg.norm(up - down) < 2e-3 * np.linalg.norm(up)
