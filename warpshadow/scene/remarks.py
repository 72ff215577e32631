"""Remarks on a scene: where bodies and cameras stand, normals that show as lines or dark edges, light that is blurred
or hidden, metals that are black.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from warpshadow.assets.camera import Camera
from warpshadow.assets.light import EnvironmentMap
from warpshadow.assets.topology import CREASE
from warpshadow.maths.adjacency import solid_angles
from warpshadow.maths.plane import plane_normal
from warpshadow.maths.suns import separate_suns
from warpshadow.scene.body import Body
from warpshadow.scene.scene import Scene

_GROUND_COSINE = 0.99  # cosine of the angle to +y up to which a flat body is a ground
_CEILING_RATIO = 1.01  # ratio of breadths up to which a body is as broad as its ground, such as a ceiling
_LOW_SUN = -0.02  # height of the direction to a sun from which on it is below the horizon, by more than its rim
_MARGIN = 3.0  # breadths of the frame around its middle in which a body's shadow may be meant to be seen alone
_ROUNDED = 0.08  # mean difference of normals from which rounded edges are said
_METAL = 0.5  # share of metal from which a body is one


class _Box(NamedTuple):
    """Bounds of a body in the world."""

    low: np.ndarray
    high: np.ndarray

    @property
    def size(self) -> float:
        """Longest edge."""
        return float((self.high - self.low).max())

    @property
    def breadth(self) -> float:
        """Longest edge that is level."""
        return float((self.high - self.low)[[0, 2]].max())

    def is_over(self, other: "_Box") -> bool:
        """Whether it shares a place of the plane y = 0 with another."""
        return bool((self.low <= other.high)[[0, 2]].all() and (other.low <= self.high)[[0, 2]].all())

    def meets(self, other: "_Box") -> bool:
        """Whether it shares a point with another."""
        return bool((self.low <= other.high).all() and (other.low <= self.high).all())


def _boxes_of(scene: Scene) -> list[_Box]:
    return [_Box(points.min(axis=0), points.max(axis=0)) for points in (b.world_points() for b in scene.bodies)]


def misplacements(scene: Scene) -> list[str]:
    """Say which bodies are broader than any ground below, or above or below it by more than their size.

    Where nothing stands on any ground, it is said of bodies beside that are broader, too: they may be in other units.

    Grounds are flat, face +y and emit no light; the size is the longest edge of the bounds. A body over another that is
    near enough, a cup on a table, does not float; nor does a lamp, or a body whose bounds meet those of a lamp, such as
    its shade. A body over one ground does not lie below another, such as the board of a table.
    """
    boxes = _boxes_of(scene)

    def height(number: int) -> float:
        """Of the top of a body."""
        return float(boxes[number].high[1])

    grounds = {number for number, body in enumerate(scene.bodies) if _is_ground(body, boxes[number])}
    lamps = [box for body, box in zip(scene.bodies, boxes, strict=True) if body.is_emitter]
    solid_boxes = [box for k, box in enumerate(boxes) if k not in grounds and not scene.bodies[k].is_emitter]
    has_nothing_on = not any(box.is_over(boxes[ground]) for ground in grounds for box in solid_boxes)
    remarks = []
    for number, (body, box) in enumerate(zip(scene.bodies, boxes, strict=True)):
        level = [other for other in grounds - {number} if has_nothing_on or box.is_over(boxes[other])]
        if number in grounds or not level or body.is_emitter:
            continue
        broadest = max(level, key=lambda other: boxes[other].breadth)
        if box.breadth > _CEILING_RATIO * boxes[broadest].breadth:
            place, remedy = ("beside", "stands it there") if has_nothing_on else ("below", "makes it smaller")
            remarks.append(
                f"body {number} ({body.name!r}) is {box.breadth:.3g} broad, and body {broadest} "
                f"({scene.bodies[broadest].name!r}) {place} it {boxes[broadest].breadth:.3g}; on_ground(size=…) "
                f"{remedy}"
            )
            continue
        if has_nothing_on:
            continue
        size = box.size
        below = [other for other in level if boxes[other].low[1] <= box.low[1]]
        ground = max(below, key=height) if below else min(level, key=height)
        others = [other for k, other in enumerate(boxes) if k != number and box.is_over(other)]
        gap = min((box.low[1] - other.high[1] for other in others if other.low[1] <= box.low[1]), default=-np.inf)
        depth = boxes[ground].low[1] - box.low[1]
        body_words = f"body {number} ({body.name!r}), which is {size:.3g} large,"
        ground_words = f"body {ground} ({scene.bodies[ground].name!r}); on_ground() stands it there"
        if below and gap > size and not any(map(box.meets, lamps)):
            remarks.append(f"{body_words} floats {gap:.3g} above {ground_words}")
        elif depth > size:
            remarks.append(f"{body_words} lies {depth:.3g} below {ground_words}")
    return remarks


def grounds_of(scene: Scene) -> list[int]:
    """Numbers of the bodies that are grounds, cast shadows, and are as broad as all bodies."""
    boxes = _boxes_of(scene)
    broadest = max(box.breadth for box in boxes)
    return [
        number
        for number, (body, box) in enumerate(zip(scene.bodies, boxes, strict=True))
        if _CEILING_RATIO * box.breadth >= broadest and body.casts_shadow and _is_ground(body, box)
    ]


def enclosures(scene: Scene, cameras: Iterable[Camera]) -> list[str]:
    """Warn of the first camera inside a body, and name the body.

    A room whose walls face inwards, or are thick, does not enclose the bodies in it.
    """
    for camera in cameras:
        for number, body in enumerate(scene.bodies):
            low, high = body.mesh.bounds
            eye = body.from_world(camera.eye)
            if not ((low < eye).all() and (eye < high).all()):
                continue
            corners = body.mesh.positions[body.mesh.faces].astype(np.float64) - eye
            if solid_angles(corners).sum() > 2 * np.pi:  # a closed one that faces outwards has 4π around points inside
                place = ", ".join(f"{coordinate:.3g}" for coordinate in camera.eye)
                return [
                    f"camera: its eye ({place}) is inside body {number} ({body.name!r}), which is "
                    f"{body.scale * (high - low).max():.3g} large; Camera.framing(scene) sees it from outside"
                ]
    return []


def is_out_of_frame(body: Body, camera: Camera, margin: float = 1.0) -> bool:
    """Whether a body lies beyond one side of a frame of so many breadths, or behind the camera's near plane."""
    x, y, _, depth = (np.column_stack([(p := body.world_points()), np.ones(len(p))]) @ camera.clip_matrix().T).T
    is_behind = depth <= camera.near
    sides = [side > margin * depth for side in (x, -x, y, -y)]
    return any(bool(is_beyond.all()) for is_beyond in (is_behind, *sides))


def unframed(scene: Scene, cameras: Iterable[Camera]) -> list[str]:
    """Remark on the first camera that has none of the bodies but grounds and lamps in its frame or near it."""
    pairs = zip(scene.bodies, _boxes_of(scene), strict=True)
    others = [body for body, box in pairs if not body.is_emitter and not _is_ground(body, box)]
    for camera in cameras:
        if others and all(is_out_of_frame(body, camera, _MARGIN) for body in others):
            names = ", ".join(repr(body.name) for body in others)
            return [
                f"camera: got one that sees the ground alone, expected {names} in its frame or near it; "
                'Camera.framing(scene), or framing = "auto" in a scene file, shows all'
            ]
    return []


def _is_ground(body: Body, box: _Box) -> bool:
    size, mesh = box.high - box.low, body.mesh
    if body.is_emitter or size[1] > 0.2 * size.max():  # at once: most bodies are not flat
        return False
    normal = plane_normal(mesh.positions[mesh.faces].astype(np.float64))
    return normal is not None and bool((body.rotation_matrix() @ normal)[1] > _GROUND_COSINE)


def rounded_edges(scene: Scene) -> list[str]:
    """Say which bodies have many sharp edges whose faces share vertices, and so normals, where much of them shows it.

    Vases of 16 to 128 sides, where it is the lip, have up to 0.065 and are up to 7% off; a box of 3,000 faces 0.093 and
    17%, a bottle of flat shoulders 0.21 and 9%, a cube 0.87 and 50%.
    """
    return [
        f"body {number} ({body.name!r}) has sharp edges whose faces share vertices, and so normals, which make them "
        f"dark or bright; Body(…).creased(), in scene files and recipes creased = {CREASE:g}, parts them"
        for number, body in enumerate(scene.bodies)
        if body.mesh.rounds_edges and body.mesh.edge_rounding > _ROUNDED
    ]


def lined_surfaces(scene: Scene) -> list[str]:
    """Say over which bodies lines run, where vertices at one place have normals of their own."""
    return [
        f"body {number} ({body.name!r}): {body.mesh.split_count:,} vertices coincide with others, and their "
        "normals differ, which shows as lines over smooth surfaces; mesh.welded() joins them"
        for number, body in enumerate(scene.bodies)
        if body.mesh.split_count
    ]


def _share_of_brightest_half(light: EnvironmentMap) -> float:
    """Share of all directions from which half of the light of a map comes, the brightest ones."""
    solid_angles = np.repeat(light.solid_angles(), light.radiance.shape[1])
    luminances = light.radiance.reshape(-1, 3) @ np.full(3, 1 / 3)
    half_power = solid_angles @ luminances / 2
    brightest = (-luminances).argsort()
    end = int(np.searchsorted((luminances * solid_angles)[brightest].cumsum(), half_power)) + 1
    return float(solid_angles[brightest[:end]].sum() / (4 * np.pi))


def blurred_shell(scene: Scene) -> list[str]:
    """Say that half of the light comes from less of the shell than a cell, by which its shadows are blurred.

    A studio with a small soft box, at a radius of 3, was 16% off, and with 512 cells in place of 128 half of that.
    """
    light = scene.known_light.as_map
    if scene.shell is None or not scene.visibility.traits.has_cells or light is None:
        return []
    bright = _share_of_brightest_half(light)
    if bright * scene.direction_count >= 1:
        return []
    return [
        f"light: half of it comes from {bright:.2%} of its shell, less than one of the {scene.direction_count} cells "
        "through which bodies block it, so its shadows are blurred; stills have them sharp, as lamps do, "
        "Body(…, emission=…), and Visibility(directions=…) blurs them less"
    ]


def sun_below(scene: Scene) -> list[str]:
    """Remark on a map half of whose light is a sun's below the horizon, over a ground that is broader than all."""
    light = scene.known_light.as_map
    if light is None or light.shell is not None or len(scene.bodies) < 2:
        return []
    grounds = grounds_of(scene)
    if not grounds:
        return []
    directions, irradiance, _ = separate_suns(light.radiance).suns
    powers = irradiance.mean(axis=1)
    half_power = light.solid_angles() @ light.radiance.mean(axis=2).sum(axis=1) / 2
    low_suns = directions[(powers > half_power) & (directions[:, 1] < _LOW_SUN)]
    if not len(low_suns):
        return []
    x, y, z = low_suns[0].tolist()
    number = grounds[0]
    return [
        f"light: its sun is at ({x:.2g}, {y:.2g}, {z:.2g}), below body {number} ({scene.bodies[number].name!r}), which "
        "keeps its light from the others; y of a direction towards the sun is above 0"
    ]


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
