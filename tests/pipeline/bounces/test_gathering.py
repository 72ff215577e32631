"""Gathering of bounced light at receivers that cameras see."""

import pytest
import torch

import warpshadow as ws
from warpshadow.pipeline.bodies.self_visibility import SelfVisibility
from warpshadow.torch import TorchRenderer
from warpshadow.tuning.timing import whole_image


@pytest.mark.parametrize(
    ("method", "self_shadows", "roughness", "is_deformed"),
    [("log-sh", "traced", None, False), ("directional", "spheres", None, False), ("directional", "traced", 0.4, True)],
)
def test_cameras_that_see_one_geometry_by_pixel_have_their_own_images(method, self_shadows, roughness, is_deformed):
    ball = ws.Body(ws.icosphere(0.8, 1), translation=(0, 0.8, 0), receivers="pixel", roughness=roughness)
    ground = ws.Body(ws.plane(6.0, 4), receivers="vertex")
    cameras = [ws.Camera.look_at((x, 3, 4.5), (0, 0.6, 0), size=(12, 12)) for x in (2, 0)]
    visibility = ws.Visibility(method, self_shadows=self_shadows)
    scene = ws.Scene([ball, ground], ws.synthetic_sky(), cameras[0], bounces=1, visibility=visibility)

    def images(cameras: list[ws.Camera]) -> torch.Tensor:
        renderer = TorchRenderer(scene, cameras=cameras)
        rest = renderer.deformed(0, 1.1 * torch.tensor(ball.mesh.positions)) if is_deformed else None
        with torch.no_grad():
            return renderer(geometry=renderer.placed(*renderer.scene_poses(), rest=rest))

    alone = torch.cat([images([camera]) for camera in cameras])
    torch.testing.assert_close(images(cameras), alone, rtol=1e-4, atol=1e-4)


def test_samples_of_patches_and_receivers_share_the_lookups_of_self_visibility(monkeypatch):
    ball = ws.Body(ws.icosphere(0.8, 1), translation=(0, 0.8, 0))
    camera = ws.Camera.look_at((2, 3, 4.5), (0, 0.6, 0), size=(12, 12))
    scene = ws.Scene([ball, ws.Body(ws.plane(6.0, 4))], ws.synthetic_sky(), camera, bounces=2)
    draw, lookups, calls = whole_image(ws.Renderer(scene)), SelfVisibility.lookups, []

    def counted(self, *arguments, **options):
        calls.append(arguments)
        return lookups(self, *arguments, **options)

    monkeypatch.setattr(SelfVisibility, "lookups", counted)
    draw()
    assert len(calls) == 1
