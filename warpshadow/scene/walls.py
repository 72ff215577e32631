"""Light from a box: the walls of a room, as bodies that emit the radiance of a map."""

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from warpshadow import check
from warpshadow.assets.light import EnvironmentMap
from warpshadow.assets.mesh import Mesh
from warpshadow.scene.body import Body

SIDES = ("+x", "-x", "+y", "-y", "+z", "-z")

_POINTS_PER_PIXEL = 1.5  # of the map, straight ahead of a wall, at which the wall takes its mean radiance

_CORNERS = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
_FACES = np.array([[0, 1, 2], [0, 2, 3]])


def walls_of_light(
    light: EnvironmentMap,
    size: npt.ArrayLike,
    center: npt.ArrayLike = (0.0, 0.0, 0.0),
    *,
    sides: Iterable[str] = SIDES,
    texels: int = 64,
) -> list[Body]:
    """Make the walls of a box that emit a map as it is seen from the middle of the box, which is where it was taken.

    They are lamps (:class:`.Body`, ``emission``) that are black and block no light, so the camera and all other bodies
    are within the box; the scene's light is ``EnvironmentMap.constant(0)``. Two triangles each, with a texture.

    Args:
        light: The map, without a radius.
        size: Of the box along x, y and z [scene units], one number or [3].
        center: Its middle [scene units], shape [3].
        sides: Which walls, of "+x", "-x", "+y", "-y", "+z" and "-z"; a ground may stand in the place of "-y".
        texels: Of each texture, along and across.
    Returns:
        A body for each side, called "wall +x" and so on.
    """
    expected = "an EnvironmentMap without a radius"
    check.instance("light", light, EnvironmentMap, expected)
    if light.shell is not None:
        raise ValueError(f"light: got {light!r}, expected {expected}: the box says how far it is")
    edges = check.numbers("size", size, expected="a size, or one along each axis [3]", dtype=np.float64)
    if edges.shape not in ((), (3,)) or not (np.isfinite(edges).all() and (edges > 0).all()):
        raise ValueError(f"size: got {check.described(size)}, expected a size above 0, or one along each axis [3]")
    middle = check.array("center", center, (3,), "a point (x, y, z)")
    check.integer("texels", texels, unit="texels")
    names = list(sides)
    for side in names:
        check.choice("sides", side, SIDES)
    if not names or len(set(names)) < len(names):
        raise ValueError(f"sides: got {names}, expected some of {', '.join(SIDES)}, each once")
    return [_wall(light, side, np.broadcast_to(edges, (3,)), middle, texels) for side in names]


def _wall(light: EnvironmentMap, side: str, edges: np.ndarray, center: np.ndarray, texels: int) -> Body:
    axis, sign = "xyz".index(side[1]), 1.0 if side[0] == "+" else -1.0
    axis_u, axis_v = (axis + 1) % 3, (axis + 2) % 3

    def on_wall(wall_positions: np.ndarray) -> np.ndarray:
        """Points of the wall, from the middle of the box, of places from -0.5 to 0.5, [..., 2]."""
        points = np.full((*wall_positions.shape[:-1], 3), 0.5 * sign * edges[axis])
        points[..., axis_u], points[..., axis_v] = np.moveaxis(wall_positions * edges[[axis_u, axis_v]], -1, 0)
        return points

    def radiance(row: int) -> np.ndarray:
        """Mean radiance of a row of texels, from finer points than the map's pixels: a sun is smaller than a texel."""
        places = (np.arange(texels * point_count) + 0.5) / (texels * point_count)
        u, v = np.meshgrid(places, 1 - (row + (np.arange(point_count) + 0.5) / point_count) / texels)
        beams = on_wall(np.stack([u, v], axis=-1) - 0.5)
        distances = np.linalg.norm(beams, axis=-1, keepdims=True)
        weights = distances**-3.0  # solid angle of a point's part of the wall, but for a factor
        weighted = weights * light.radiance_from(beams / distances)
        sums = [item.reshape(point_count, texels, point_count, -1).sum(axis=(0, 2)) for item in (weighted, weights)]
        return sums[0] / sums[1]

    pixel = np.pi / len(light.radiance)
    point_count = int(np.ceil(_POINTS_PER_PIXEL * edges[[axis_u, axis_v]].max() / texels / (0.5 * edges[axis] * pixel)))
    emission = np.stack([radiance(row) for row in range(texels)])
    mesh = Mesh(center + on_wall(_CORNERS), _FACES, _CORNERS + 0.5, _FACES, f"wall {side}")
    return Body(mesh, albedo=(0.0, 0.0, 0.0), emission=emission, blockers=0)
