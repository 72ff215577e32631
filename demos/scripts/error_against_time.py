"""Error against time for your own scene: python demos/scripts/error_against_time.py [SCENE.toml]."""

import dataclasses
import sys
import time

import numpy as np
import warp as wp
import warp.examples

import warpshadow as ws

ws.quiet()
if len(sys.argv) > 1:
    scene = ws.load_scene(sys.argv[1])
else:
    bunny = ws.Body(warp.examples.get_asset_directory() + "/bunny.usd").on_ground(size=2)
    camera = ws.Camera.framing(bunny, size=(96, 96))
    scene = ws.Scene([bunny, ws.Body(ws.plane(6.0))], ws.synthetic_sky(), camera)
truth = ws.render(dataclasses.replace(scene, visibility=ws.Visibility("ray-traced", samples=1024)))
covered = truth[..., 3] == 1
settings = {f"{n} directions": ws.Visibility(directions=n) for n in (64, 128, 256)}
settings |= {"no shadows": ws.Visibility("none"), "64 rays": ws.Visibility("ray-traced", samples=64)}
for name, visibility in settings.items():
    renderer = ws.Renderer(dataclasses.replace(scene, visibility=visibility))
    image, poses, seconds = renderer.render(), renderer.scene_poses(), []
    for step in range(1, 4):  # bodies move a little, so that all is computed anew
        moved = wp.array(poses.translations.numpy() + 1e-4 * step, dtype=wp.vec3)
        geometry = renderer.placed(dataclasses.replace(poses, translations=moved))
        start = time.perf_counter()
        renderer.draw(view=renderer.view(geometry)).numpy()
        seconds.append(time.perf_counter() - start)
    error = np.linalg.norm((image - truth)[covered]) / np.linalg.norm(truth[covered])
    print(f"{name:15} error {error:6.1%}  {1e3 * min(seconds):7.1f} ms")
