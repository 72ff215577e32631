"""Constraints of a pose: knowledge of it besides the images.

A pose has six degrees of freedom: a turn, as an axis-angle vector, and a shift of the body's middle. A constraint
leaves each of them a subspace, and the values of a fit are coordinates in it, so that no step can violate it. A body
that stands on a plane keeps three: it turns about the plane's normal and slides, and its height follows from its lowest
vertex; fixed coordinates of its middle stay, and so it moves onto the plane along the other coordinates.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from warpshadow import check
from warpshadow.assets.mesh import Mesh
from warpshadow.maths.plane import plane_normal
from warpshadow.scene.body import Body

AXES = {"x": 0, "y": 1, "z": 2}
UP = (0.0, 1.0, 0.0)
RESTING = ("stable", "given", "free")
_MIN_SLOPE = 0.01  # of a plane along the coordinates that are not fixed
_INSIDE = 1e-6  # how far outside a triangle its centroid may project, in barycentric coordinates
_DISTURBANCE = np.radians(1.0)  # tilt from which a body returns to a support
_BASE = 0.005  # of a mesh's diagonal: unevenness of a scan's base
_BASE_ITERATIONS = 10
_AZIMUTHS = np.arange(24) * (np.pi / 12)  # directions in which it is tilted


@dataclass(frozen=True, eq=False)
class PlaneConstraint:
    """A plane that a body touches from above: points with normal · p = offset."""

    normal: np.ndarray  # unit vector away from the plane's solid side, shape [3]
    offset: float  # distance from the origin along the normal [scene units]


@dataclass(frozen=True, eq=False)
class PoseConstraint:
    """The poses that remain possible."""

    turns: np.ndarray  # orthonormal basis of possible axis-angle vectors, rows, [0 to 3, 3]
    shifts: np.ndarray  # the same of the shifts of the body's middle, [0 to 3, 3]
    rotation: np.ndarray  # from which the body turns, shape [3, 3]
    plane: PlaneConstraint | None = None  # that the body touches, if any
    onto: np.ndarray | None = None  # shift by a unit along the normal, and no fixed coordinate, [3]
    hull: np.ndarray | None = None  # vertices of the mesh's convex hull, [vertex, 3]; for a plane
    remark: str = ""  # how it rests on the plane, where the scene and stability differ

    def turn(self, values: torch.Tensor) -> torch.Tensor:
        """The axis-angle vector of coordinates among the possible ones. Differentiable: values."""
        return torch.as_tensor(self.turns).to(values).T @ values

    def shift(self, values: torch.Tensor) -> torch.Tensor:
        """The shift of coordinates among the possible ones. Differentiable: values."""
        return torch.as_tensor(self.shifts).to(values).T @ values

    def lower_onto_plane(
        self, pivot: torch.Tensor, rotation: torch.Tensor, scale: torch.Tensor, center: torch.Tensor
    ) -> torch.Tensor:
        """The body's middle in the world, ``pivot`` [3], moved until its lowest vertex touches the plane.

        In its own space the middle is ``center`` [3]; rotation is [3, 3]. Differentiable: pivot, rotation, scale.
        """
        if self.plane is None or self.onto is None or self.hull is None:
            return pivot
        normal, onto, hull = (torch.as_tensor(part).to(pivot) for part in (self.plane.normal, self.onto, self.hull))
        lowest_point = ((hull - center) @ (rotation.T @ normal)).amin() * scale
        return pivot + onto * (self.plane.offset - lowest_point - normal @ pivot)


def perpendicular_basis(removed: list[np.ndarray]) -> np.ndarray:
    """Orthonormal basis of the directions perpendicular to some, rows, shape [0 to 3, 3]."""
    if not removed:
        return np.eye(3)
    _, sizes, rows = np.linalg.svd(np.stack(removed))
    return rows[int((sizes > 1e-9).sum()) :]


def turned_direction(start: np.ndarray, turn: torch.Tensor) -> torch.Tensor:
    """A unit vector turned by angles about two axes that are perpendicular to it [radians], [2]. Differentiable: turn.

    It is where a step of that length leads from ``start`` over the unit sphere.
    """
    tangents, start_direction = (torch.tensor(array).to(turn) for array in (perpendicular_basis([start]), start))
    angle = (turn.square().sum() + 1e-12).sqrt()
    return angle.cos() * start_direction + angle.sin() / angle * (turn @ tangents)


def onto_plane(normal: np.ndarray, fixed: Sequence[str]) -> np.ndarray:
    """The least shift that moves by a unit along a plane's normal, and no fixed coordinate, shape [3].

    Raises:
        ValueError: for fixed coordinates beside which nothing, or hardly anything, of the normal is left.
    """
    onto = np.where([axis in fixed for axis in AXES], 0.0, normal)
    if np.linalg.norm(onto) < _MIN_SLOPE:
        raise ValueError(
            f"fixed: got {list(fixed)} beside stands_on a plane of normal {np.round(normal, 3).tolist()}, expected a "
            "coordinate that is free to move the body onto the plane"
        )
    return onto / (onto @ normal)


def plane_below(ground: Body, above: np.ndarray, argument: str = "stands_on") -> PlaneConstraint:
    """The plane of a flat body, its normal towards a point.

    Raises:
        ValueError: for a body that does not lie in a plane.
    """
    mesh = ground.world_mesh()
    points = mesh.positions.astype(np.float64)
    normal = plane_normal(points[mesh.faces])
    if normal is None:
        raise ValueError(f"{argument}: got {ground.name!r}, which is not flat; expected a plane, such as the ground")
    offset = float(np.median(points @ normal))
    sign = 1.0 if normal @ above >= offset else -1.0
    return PlaneConstraint(sign * normal, sign * offset)


def hull_points(mesh: Mesh) -> np.ndarray:
    """Vertices of a mesh's convex hull, float64 of shape [vertex, 3]."""
    from scipy.spatial import ConvexHull

    points = mesh.positions.astype(np.float64)
    return points[ConvexHull(points).vertices]


def stable_rotation(
    mesh: Mesh, rotation: np.ndarray, normal: np.ndarray, *, base_is_uneven: bool = False
) -> np.ndarray:
    """The rotation nearest to one in which a body rests on a plane without tipping over.

    A body rests on a triangle of its convex hull if the hull's centroid projects into it [Goldberg et al. 1999, "Part
    pose statistics"], and if it returns when it is tilted by 1° any way: the rounded edges of a scan have triangles on
    which it would rest to the letter. The body is turned onto the triangle that needs the least turn. Where it returns
    to none, as a ball, the first condition is enough.

    Args:
        mesh: Of the body.
        rotation: Of the body, shape [3, 3].
        normal: Of the plane, upwards, shape [3].
        base_is_uneven: Rest on the plane nearest to all vertices around that triangle, up to 0.5% of the diagonal above
            it, not on its three corners.
    """
    from scipy.spatial import ConvexHull
    from trimesh.triangles import points_to_barycentric

    points = mesh.positions.astype(np.float64)
    hull = ConvexHull(points)
    corners, downwards = points[hull.simplices], hull.equations[:, :3]
    apex = points[hull.vertices].mean(axis=0)
    tetrahedra = np.abs(np.linalg.det(corners - apex))
    centroid = (tetrahedra[:, None] * (corners.sum(axis=1) + apex) / 4).sum(axis=0) / tetrahedra.sum()
    barycentrics = points_to_barycentric(
        corners, np.broadcast_to(centroid, downwards.shape)
    )  # NaN of triangles of no area
    supports = downwards[(barycentrics >= -_INSIDE).all(axis=1)]
    arms = points[hull.vertices] - centroid
    returns = np.array([_returns_after_tilt(arms, down) for down in supports])
    supports = supports[returns] if returns.any() else supports
    best = supports[np.argmax(supports @ (-rotation.T @ normal))]
    if base_is_uneven:
        best = _base_normal(points, best)
    return turn_onto(rotation @ best, -normal) @ rotation


def _base_normal(points: np.ndarray, down: np.ndarray) -> np.ndarray:
    """The normal, outwards, of the plane nearest to the vertices of a base, from about that normal."""
    reach = _BASE * float(np.linalg.norm(np.ptp(points, axis=0)))
    for _ in range(_BASE_ITERATIONS):
        depths = points @ down
        base = points[depths > depths.max() - reach]
        normal = np.linalg.svd(base - base.mean(axis=0))[2][-1]
        down = normal * np.sign(normal @ down)
    return down


def _returns_after_tilt(arms: np.ndarray, down: np.ndarray) -> bool:
    """Whether a body on a support, tilted a little, is turned back by its weight: its contact is beyond its centroid.

    Its hull has vertices at ``arms`` from the centroid, [vertex, 3], and the support a normal ``down``, outwards, [3].
    """
    first, second = perpendicular_basis([down])
    level = np.cos(_AZIMUTHS)[:, None] * first + np.sin(_AZIMUTHS)[:, None] * second
    cosine, sine = np.cos(_DISTURBANCE), np.sin(_DISTURBANCE)
    contacts = arms[np.argmax((cosine * down + sine * level) @ arms.T, axis=1)]
    return bool(((contacts * (cosine * level - sine * down)).sum(axis=1) > 0).all())


def turn_onto(source: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """The least rotation that takes a unit vector onto another, shape [3, 3]."""
    from scipy.spatial.transform import Rotation

    axis, cosine = np.cross(source, goal), float(source @ goal)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        axis, sine = np.cross(source, np.eye(3)[np.argmin(np.abs(source))]), 0.0
    return Rotation.from_rotvec(np.arctan2(sine, cosine) * axis / np.linalg.norm(axis)).as_matrix()


def checked_axis(value: object) -> tuple[float, ...]:
    """A unit vector, of a direction of any length."""
    axis = check.array("axis", value, (3,), "a direction")
    if not axis.any():
        raise ValueError(f"axis: got {axis.tolist()}, expected a direction, of any length but 0")
    return tuple((axis / np.linalg.norm(axis)).tolist())


def checked_prior(name: str, value: object) -> tuple[float, float]:
    """A number and its standard deviation, both positive."""
    mean, deviation = check.array(name, value, (2,), "a value and its standard deviation").tolist()
    return check.positive(name, mean), check.positive(f"{name}[1]", deviation)


def checked_covariance(value: object) -> tuple[tuple[float, ...], ...]:
    """Symmetric and positive definite, of six numbers; or their six standard deviations."""
    numbers = check.numbers("covariance", value, expected="6 standard deviations, or [6, 6]", dtype=np.float64)
    if numbers.shape == (6,):
        numbers = np.diag(numbers**2)
    check.shape("covariance", numbers.shape, (6, 6), "or six standard deviations")
    check.finite("covariance", numbers)
    if not np.allclose(numbers, numbers.T) or np.linalg.eigvalsh(numbers).min() <= 0:
        raise ValueError("covariance: got a matrix that is not symmetric and positive definite")
    return tuple(map(tuple, numbers.tolist()))
