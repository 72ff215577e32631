"""Normals: which bodies have some that round sharp edges, or that break where the surface is smooth."""

from warpshadow.assets.topology import CREASE
from warpshadow.scene.scene import Scene


def rounded_edges(scene: Scene) -> list[str]:
    """Say which bodies have many sharp edges whose faces share vertices, and so normals."""
    return [
        f"body {number} ({body.name!r}) has sharp edges whose faces share vertices, and so normals, which make them "
        f"dark or bright; Body(…).creased(), in scene files and recipes creased = {CREASE:g}, parts them"
        for number, body in enumerate(scene.bodies)
        if body.mesh.rounds_edges
    ]


def lined_surfaces(scene: Scene) -> list[str]:
    """Say over which bodies lines run, where vertices at one place have normals of their own."""
    return [
        f"body {number} ({body.name!r}): {body.mesh.split_count:,} vertices coincide with others, and their "
        "normals differ, which shows as lines over smooth surfaces; mesh.welded() joins them"
        for number, body in enumerate(scene.bodies)
        if body.mesh.split_count
    ]
