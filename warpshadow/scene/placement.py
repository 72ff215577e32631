"""Where bodies stand: whether one floats above a ground, or lies below it."""

from typing import NamedTuple

import numpy as np

from warpshadow.maths.plane import plane_normal
from warpshadow.scene.scene import Body, Scene

_LEVEL = 0.99  # cosine of the angle to +y up to which a flat body is a ground


class _Box(NamedTuple):
    """Bounds of a body in the world."""

    low: np.ndarray
    high: np.ndarray

    def is_over(self, other: "_Box") -> bool:
        """Whether it shares a place of the plane y = 0 with another."""
        return bool((self.low <= other.high)[[0, 2]].all() and (other.low <= self.high)[[0, 2]].all())


def misplacements(scene: Scene) -> list[str]:
    """Say which bodies are above or below a ground by more than their size, the longest edge of their bounds.

    Grounds are flat and face +y. A body over another that is near enough, a cup on a table, does not float.
    """
    boxes = [_Box(points.min(axis=0), points.max(axis=0)) for points in (b.world_points() for b in scene.bodies)]
    grounds = {number for number, body in enumerate(scene.bodies) if _is_ground(body, boxes[number])}
    remarks = []
    for number, (body, box) in enumerate(zip(scene.bodies, boxes, strict=True)):
        below = [other for other in grounds - {number} if box.is_over(boxes[other])]
        if number in grounds or not below:
            continue
        size = float((box.high - box.low).max())
        ground = max(below, key=lambda other: boxes[other].high[1])
        others = [other for k, other in enumerate(boxes) if k != number and box.is_over(other)]
        gap = min((box.low[1] - other.high[1] for other in others if other.low[1] <= box.low[1]), default=-np.inf)
        depth = boxes[ground].low[1] - box.low[1]
        where = f"body {number} ({body.called!r}), which is {size:.3g} large,"
        which = f"body {ground} ({scene.bodies[ground].called!r}); on_ground() stands it there"
        if gap > size:
            remarks.append(f"{where} floats {gap:.3g} above {which}")
        elif depth > size:
            remarks.append(f"{where} lies {depth:.3g} below {which}")
    return remarks


def _is_ground(body: Body, box: _Box) -> bool:
    size, mesh = box.high - box.low, body.mesh
    if size[1] > 0.2 * size.max():  # at once: most bodies are not flat
        return False
    normal = plane_normal(mesh.positions[mesh.faces].astype(np.float64))
    return normal is not None and bool((body.rotation_matrix() @ normal)[1] > _LEVEL)
