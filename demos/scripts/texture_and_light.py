"""A texture without the shadow on it, then the light of another image: python demos/scripts/texture_and_light.py."""

import numpy as np
import torch
import warp.examples

import warpshadow as ws
from warpshadow.torch import TorchRenderer

ws.quiet()
pattern = np.kron(np.random.default_rng(0).uniform(0.2, 0.8, (8, 8, 3)), np.ones((8, 8, 1))).astype(np.float32)
bunny = ws.Body(warp.examples.get_asset_directory() + "/bunny.usd", albedo=(0.5, 0.5, 0.5)).on_ground(size=2)
bodies = [bunny, ws.Body(ws.plane(4.0), texture=pattern, name="floor")]
camera = ws.Camera.look_at((-0.6, 4.6, 3.2), (0, 0.35, 0), fov_y=46, size=(96, 96))
skies = [ws.synthetic_sky(sun, sun_strength=2.0, sun_radius=10.0) for sun in ((0.6, 0.6, 0.4), (-0.7, 0.5, 0.2))]
morning, evening = (torch.from_numpy(ws.Renderer(ws.Scene(bodies, sky, camera)).render()) for sky in skies)


def fitted(draw, free, target, steps=400):
    optimizer = torch.optim.Adam([free], lr=0.1)
    for _ in range(steps):
        optimizer.zero_grad()
        torch.nn.functional.mse_loss(draw(free), target).backward()
        optimizer.step()
    return free.detach()


renderer = TorchRenderer(ws.Scene(bodies, skies[0], camera), basis=ws.CellBasis(ws.fibonacci(128)))
is_seen = renderer.array_renderer.seen_texels("floor") > 0.5
texels = fitted(
    lambda x: renderer(textures={"floor": x.sigmoid()}), torch.zeros(64, 64, 3, requires_grad=True), morning
)
texture = texels.sigmoid()
difference = (texture.numpy() - pattern)[is_seen]
print(f"error of the texture: {np.linalg.norm(difference) / np.linalg.norm(pattern[is_seen]):.1%}")

softplus = torch.nn.functional.softplus  # light is not negative
lit = {"textures": {"floor": texture}}
cells = fitted(lambda x: renderer(softplus(x), **lit), torch.zeros(128, 3, requires_grad=True), evening)
image = renderer(softplus(cells), **lit)
print(f"error of the image in the light found: {torch.linalg.norm(image - evening) / torch.linalg.norm(evening):.1%}")
ws.write_image("evening.png", np.concatenate([evening, image], axis=1))
