"""A small scene, and tensors, for tests of renderers in torch."""

import numpy as np
import torch

import warpshadow as ws


def small_scene(method: str = "directional", *, size: int = 12, supersampling: int = 2, **options) -> ws.Scene:
    ball = ws.Body(
        ws.icosphere(1.0, 2),
        albedo=(0.7, 0.5, 0.3),
        blockers=ws.Spheres([[0, 0, 0]], [1.0]),
        translation=(0, 1, 0),
        scale=0.8,
    )
    texture = np.random.default_rng(0).uniform(0.1, 0.9, (8, 8, 3))
    ground = ws.Body(ws.plane(3.0, 12), texture=texture, blockers=0)
    camera = ws.Camera.look_at((0, 2.5, 5), (0, 0.6, 0), size=(size, size))
    visibility = ws.Visibility.of({"method": method, "samples": 64, "directions": 32, "order": 4} | options)
    sky = ws.synthetic_sky(height=16, sun_radius=12)
    return ws.Scene((ball, ground), sky, camera, visibility, supersampling)


def random(*shape: int, device: str = "cpu", seed: int = 0, low: float = 0.1) -> torch.Tensor:
    values = torch.rand(*shape, generator=torch.Generator().manual_seed(seed)) + low
    return values.to(device).requires_grad_()
