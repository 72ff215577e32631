"""Metals that mirror other bodies, which they show black where light does not bounce."""

import numpy as np

from warpshadow.scene.scene import Scene

_METAL = 0.5  # share of metal from which a body is one


def black_metals(scene: Scene) -> list[str]:
    """Remark on bodies of metal beside others, in a scene without bounces."""
    if scene.bounces or len(scene.bodies) < 2:
        return []
    metals = [
        f"body {number} ({body.name!r})"
        for number, body in enumerate(scene.bodies)
        if body.is_glossy and body.metallic is not None and np.mean(body.metallic) > _METAL
    ]
    if not metals:
        return []
    are, show = ("is of metal", "shows") if len(metals) == 1 else ("are of metal", "show")
    return [
        f"{', '.join(metals)} {are}, which {show} other bodies black where light does not bounce: got bounces=0; "
        'Scene(…, bounces="all"), in scene files bounces = "all", has them mirrored'
    ]
