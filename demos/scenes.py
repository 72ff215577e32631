"""What the demos share: meshes that ship with Warp, a body on a ground, and the error of an image."""

import dataclasses
from pathlib import Path

import numpy as np
import warp.examples

import warpshadow as ws


def shipped_mesh(name: str) -> ws.Mesh:
    """A mesh that ships with Warp: bunny, bear or rocks."""
    return ws.load_mesh(Path(warp.examples.get_asset_directory()) / f"{name}.usd")


def on_ground(
    mesh: ws.Mesh, light: ws.EnvironmentMap, *, blockers: int | str = 64, ground: ws.Body | None = None
) -> ws.Scene:
    """A mesh made 2 units large, on the middle of a ground of 6 × 6 units and 64 × 64 quads, seen from above."""
    low, high = mesh.bounds
    scale = 2 / (high - low).max()
    middle = (low + high) / 2
    foot = np.array([middle[0], low[1], middle[2]])
    body = ws.Body(mesh, albedo=(0.75, 0.62, 0.5), blockers=blockers, scale=scale, translation=-scale * foot)
    camera = ws.Camera.look_at((1.6, 2.6, 4.6), (0, 0.75, 0), fov_y=36, size=(256, 256))
    return ws.Scene((body, ground or ws.Body(ws.plane(6.0, 64))), light, camera)


def bunny_scene() -> ws.Scene:
    """The bunny on a plane of 64 × 64 quads that casts no shadow, under a sky with a sun."""
    ground = ws.Body(ws.plane(6.0, 64), blockers=0)
    scene = on_ground(shipped_mesh("bunny"), ws.synthetic_sky(), ground=ground)
    return dataclasses.replace(scene, supersampling=1)


def image_error(image: np.ndarray, truth: np.ndarray) -> float:
    """Relative L2 error of color over the pixels that are wholly covered."""
    covered = truth[..., 3] == 1
    return float(np.linalg.norm((image - truth)[covered, :3]) / np.linalg.norm(truth[covered, :3]))
