"""A .glb file relit by a lamp, and its gloss from that image: python demos/scripts/relight_a_glb.py [FILE.glb]."""

import sys

import numpy as np
import torch
import trimesh
from PIL import Image

import warpshadow as ws
from warpshadow.torch import TorchRenderer

ws.quiet()
path = sys.argv[1] if len(sys.argv) > 1 else "ball.glb"
if len(sys.argv) == 1:  # a ball with rings of gold
    v, u = (x.ravel() for x in np.meshgrid(np.linspace(0, 1, 33), np.linspace(0, 1, 33), indexing="ij"))
    ring = np.sin(np.pi * (0.98 * v + 0.01))
    points = np.stack([ring * np.sin(2 * np.pi * u), -np.cos(np.pi * v), ring * np.cos(2 * np.pi * u)], axis=-1)
    corners = (33 * np.arange(32)[:, None] + np.arange(32)).reshape(-1, 1, 1)
    faces = (corners + [(0, 1, 33), (1, 34, 33)]).reshape(-1, 3)
    blue_and_gold = np.uint8([(25, 60, 140), (255, 200, 110)]), np.uint8([(255, 50, 0), (255, 90, 255)])
    images = [Image.fromarray(each[np.indices((16, 2))[0] // 2 % 2]) for each in blue_and_gold]
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=images[0], metallicRoughnessTexture=images[1])
    visual = trimesh.visual.TextureVisuals(np.stack([u, v], axis=-1), material=material)
    trimesh.Trimesh(points, faces, visual=visual).export(path)
body = ws.Body(path, name="body").on_ground(size=2)
lamp = ws.Body(ws.icosphere(0.1, 3), emission=(120, 84, 44), translation=(1.4, 1.9, 1.2), name="lamp")
dusk = ws.synthetic_sky((0.9, 0.05, -0.6), sun_strength=0.0).scaled(0.15)
camera = ws.Camera.framing(body, size=(96, 96))
renderer = TorchRenderer(ws.Scene([body, ws.Body(ws.plane(6.0)), lamp], dusk, camera, bounces=1))
maps = torch.as_tensor(body.roughness), torch.as_tensor(body.metallic)
target, free = renderer(), torch.full((2,), 0.5, requires_grad=True)  # factors of roughness and metallic
optimizer = torch.optim.Adam([free], lr=0.05)
schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 60)
for _ in range(60):
    image = renderer(roughness={"body": free[0] * maps[0]}, metallic={"body": free[1] * maps[1]})
    optimizer.zero_grad()
    torch.nn.functional.mse_loss((image + 0.1).log(), (target + 0.1).log()).backward()
    optimizer.step()
    free.data.clamp_(0, 1)  # no number of a surface is above 1
    schedule.step()
print("factors of roughness and metallic:", free.detach().numpy().round(2))
ws.Picture(np.concatenate([target, image.detach()], axis=1), exposure=0.5, tone="filmic").write("relit.png")
