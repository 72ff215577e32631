"""A pose from an image, in a plain torch loop: python demos/scripts/pose.py."""

import numpy as np
import torch
import warp.examples

import warpshadow as ws
from warpshadow.torch import TorchRenderer, rotation_matrices

ws.quiet()
np.set_printoptions(suppress=True)  # no powers of ten
bunny = ws.Body(warp.examples.get_asset_directory() + "/bunny.usd", albedo=(0.8, 0.4, 0.2)).on_ground(size=2)
camera = ws.Camera.framing(bunny, size=(96, 96), margin=0.4)
scene = ws.Scene([bunny, ws.Body(ws.plane(6.0))], ws.synthetic_sky(sun_radius=5.0), camera)
renderer = TorchRenderer(scene)
rotations, translations, scales = renderer.scene_poses()  # [body, 3, 3], [body, 3], [body]


def draw(turn, shift):  # axis-angle [radians], scene units
    turned = torch.stack([rotation_matrices(turn) @ rotations[0], rotations[1]])
    shifted = torch.stack([translations[0] + shift, translations[1]])
    return renderer(geometry=renderer.placed(turned, shifted, scales, moving=["bunny"]))


target = draw(torch.tensor([0.0, np.radians(30), 0.0], dtype=torch.float32), torch.tensor([0.15, 0.0, -0.1]))
turn, shift = torch.zeros(3, requires_grad=True), torch.zeros(3, requires_grad=True)
optimizer = torch.optim.Adam([turn, shift], lr=0.03)
schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 80)
for _ in range(80):
    optimizer.zero_grad()
    torch.nn.functional.mse_loss(draw(turn, shift), target).backward()
    optimizer.step()
    schedule.step()
print(f"turned by {np.degrees(turn.detach().numpy()).round(2)} degrees, shifted by {shift.detach().numpy().round(3)}")
