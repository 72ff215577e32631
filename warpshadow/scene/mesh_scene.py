"""Scenes of one mesh: which of its axes is up, a ground, a sky and a camera that frames it."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from warpshadow import check
from warpshadow.assets.camera import DIRECTION, Camera, ImageSize
from warpshadow.assets.light import EnvironmentMap
from warpshadow.assets.mesh import Mesh
from warpshadow.assets.mesh_files import MeshSource
from warpshadow.assets.primitives import infinite_ground
from warpshadow.assets.sky import synthetic_sky
from warpshadow.check import AnyPath
from warpshadow.maths.adjacency import area_normals
from warpshadow.scene.body import Body
from warpshadow.scene.scene import Scene

GROUND_SIZE = 6.0  # within which the ground's faces are small, as infinite_ground has it [scene units]

GUESSED_AXIS = "guess"  # ways to point up: the one that :func:`guess_up` finds

_AXES = {"y": 1, "z": 2}
_Y_UP_FORMATS = (".glb", ".gltf", ".usd", ".usda", ".usdc", ".usdz")  # glTF says so, and USD is turned as it is read
_Z_UP_FORMATS = (".stl",)  # as programs for printing and construction have it

_FOOT_HEIGHT = 0.02  # height of the part that touches the ground, as a part of the size
_MIN_FOOTING_DIFFERENCE = 0.2  # difference of footings that decides
_PLATE_THINNESS = 0.3  # extent of plates and doors along their normal, as a part of the next
_SAMPLES = 4000
_SYMMETRIC, _ASYMMETRIC = 1.1, 2.0  # distances to the mirrored surface, in distances between samples


class UpGuess(NamedTuple):
    """Which axis of a mesh points up, and why."""

    axis: str
    reason: str


def guess_up(mesh: Mesh, suffix: str = "") -> UpGuess:
    """Guess whether y or z of a mesh points up.

    Things stand on feet or bases that are large beside the parts above, and upside down they are not their own mirror
    image. A plate may lie and a door may stand, so their bases do not count. Where nothing decides it is y.

    Args:
        suffix: Of its file, in lower case. glTF and USD have y up as they are read; where nothing decides, STL has z.

    Of 24 shapes that have y up, one, a knot, is taken for z; turned to z, 16 are found, and of
    the others, such as a fence, a ball and a tree, nothing but the suffix decides (tests/scene/test_mesh_scene.py).
    """
    if suffix in _Y_UP_FORMATS:
        return UpGuess("y", f"as {suffix} files have it")
    rng = np.random.default_rng(0)
    samples = _draw_surface_points(mesh, rng), _draw_surface_points(mesh, rng)
    usual = _mean_distance(*samples) or np.inf
    mirrored = {
        axis: _mean_distance(_upside_down(samples[0], number), samples[1]) / usual for axis, number in _AXES.items()
    }
    for axis, other in (("y", "z"), ("z", "y")):
        if mirrored[other] < _SYMMETRIC and mirrored[axis] > _ASYMMETRIC:
            return UpGuess(axis, f"along {other} it is symmetric")
    points = mesh.world_points().astype(np.float64)
    footing = {axis: _standing_share(points, samples[0].mean(axis=0), number) for axis, number in _AXES.items()}
    axis, other = sorted(footing, key=lambda item: -footing[item])
    extents = np.ptp(points, axis=0)
    thickness, breadth, _ = np.sort(extents)
    is_plate = extents.argmin() in _AXES.values() and thickness < _PLATE_THINNESS * breadth
    if footing[axis] < footing[other] + _MIN_FOOTING_DIFFERENCE or is_plate:
        is_z = suffix in _Z_UP_FORMATS
        return UpGuess("z" if is_z else "y", f"as {suffix} files often have it" if is_z else "its shape does not say")
    return UpGuess(axis, f"it stands firmer than on {other}")


def default_scene(
    body: Body | Mesh | MeshSource,
    *,
    up: str = GUESSED_AXIS,
    size: ImageSize = (256, 256),
    light: EnvironmentMap | AnyPath | None = None,
    direction: npt.ArrayLike = DIRECTION,
) -> Scene:
    """Put a mesh on a ground without end, under a sky with a sun, before a camera that frames it.

    Args:
        body: A body, or a source of one: a mesh, or any source that :func:`warpshadow.load_mesh` reads. It becomes 2
            units large. Where it has many sharp edges that its normals round, they are parted, :meth:`Body.creased`.
            Where it is a metal, light bounces once, so that it reflects the ground.
        up: Axis of the mesh that points up, "y" or "z"; by default "guess", which :func:`guess_up` finds by its shape
            and its file, as the commands do. A warning says so where that is z.
        size: Width and height of the image [pixels], or one number for both.
        light: In place of the sky: an environment map, or the file of one.
        direction: From the body's middle to the camera, in the world, whose y is up, shape [3], any length.
    """
    check.choice("up", up, (*_AXES, GUESSED_AXIS))
    suffix = Path(body).suffix.lower() if check.is_path(body) else ""
    body = body if isinstance(body, Body) else Body(body)
    axis, reason = guess_up(body.mesh, suffix) if up == GUESSED_AXIS else (up, "")
    if reason and axis == "z":
        check.warn(f"{body.name}: z is taken to be up ({reason}); up='y' says otherwise, and up='z' the same")
    body = body.creased() if body.mesh.rounds_edges else body
    body = replace(body, rotation=np.array([-90.0 if axis == "z" else 0.0, 0.0, 0.0])).on_ground(size=2)
    ground = Body(infinite_ground(GROUND_SIZE), albedo=(0.4, 0.4, 0.4))
    camera = Camera.framing(body, direction=direction, size=size)
    sky = synthetic_sky() if light is None else light
    return Scene([body, ground], sky, camera, bounces=int(body.metallic is not None and body.metallic.any()))


def _standing_share(points: np.ndarray, middle: np.ndarray, axis: int) -> float:
    """Area on which points stand, over the area of their shadow from above; 0 where they would fall over."""
    from scipy.spatial import ConvexHull, QhullError

    level = np.delete(points, axis, axis=1)
    height = points[:, axis] - points[:, axis].min()
    try:
        foot = level[height < _FOOT_HEIGHT * np.ptp(points, axis=0).max()]
        base, shadow = ConvexHull(foot), ConvexHull(level)
    except (QhullError, ValueError):  # of a line or a point, or of too few
        return 0.0
    is_stable = (base.equations @ [*np.delete(middle, axis), 1.0] < 0).all()
    return float(base.volume / shadow.volume) if is_stable else 0.0


def _upside_down(points: np.ndarray, axis: int) -> np.ndarray:
    result = points.copy()
    result[:, axis] = points[:, axis].min() + points[:, axis].max() - points[:, axis]
    return result


def _mean_distance(points: np.ndarray, others: np.ndarray) -> float:
    from scipy.spatial import cKDTree

    return float(cKDTree(others).query(points)[0].mean())


def _draw_surface_points(mesh: Mesh, rng: np.random.Generator) -> np.ndarray:
    """Points of a mesh's surface, as many on equal areas, shape [sample, 3]."""
    corners = mesh.positions[mesh.faces].astype(np.float64)
    areas = np.linalg.norm(area_normals(corners), axis=1)
    total = areas.sum()
    chosen = corners[rng.choice(len(corners), _SAMPLES, p=areas / total if total else None)]
    return np.einsum("sk,skd->sd", rng.dirichlet((1, 1, 1), _SAMPLES), chosen)
