"""Sharp edges: which bodies have normals that round them."""

from warpshadow.assets.topology import CREASE
from warpshadow.scene.scene import Scene


def rounded_edges(scene: Scene) -> list[str]:
    """Say which bodies have many sharp edges whose faces share vertices, and so normals."""
    return [
        f"body {number} ({body.called!r}) has sharp edges whose faces share vertices, and so normals, which make them "
        f"dark or bright; Body(…).creased(), in scene files and recipes creased = {CREASE:g}, parts them"
        for number, body in enumerate(scene.bodies)
        if body.mesh.rounds_edges
    ]
