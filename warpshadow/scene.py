"""Scenes: bodies, light, camera and how visibility is computed."""

from dataclasses import dataclass, field

import numpy as np

from warpshadow import check, sh
from warpshadow.camera import Camera
from warpshadow.directions import check_count, edge_width
from warpshadow.light import EnvironmentMap
from warpshadow.mesh import Mesh
from warpshadow.spheres import Spheres
from warpshadow.visibility.directional import SOFTNESS
from warpshadow.visibility.exponential import THRESHOLDS
from warpshadow.visibility.merging import MERGING, check_merging
from warpshadow.visibility.zonal_logs import LOGS

SPHERE_METHODS = ("directional", "log-sh")
METHODS = (*SPHERE_METHODS, "none", "ray-traced")
AUTO = "auto"
RECEIVERS = ("vertex", "pixel")


@dataclass(frozen=True, eq=False)
class Visibility:
    """How visibility is computed.

    Args:
        method: "directional" transmittance of spheres, "log-sh" of spheres, "none" (no shadows), or "ray-traced"
            visibility of the meshes, the reference. "auto" leaves the choice to :func:`warpshadow.tuning.resolved`.
        directions: Number of direction cells of "directional", a multiple of 16.
        softness: κ of "directional": half-width of a shadow's soft edge in cell radii.
        merging: τ: half-angle under which four neighboring spheres of 512 or more are seen as one, in radii of a cell
            ("directional") or of a cell for each coefficient ("log-sh"); 0 for never.
        order: Number of SH bands, 2 to 8: of "log-sh", and of the light that "none" shades with.
        log: Logarithm of one cap of "log-sh": "eigen" or "cap".
        base: Base approximation of the exponential of "log-sh": "quadratic", "linear" or "optimal_linear".
        samples: Number of directions of "ray-traced" for a pixel, dealt to its samples.
        error: Largest relative error of shading that "auto" is to accept.

    Raises:
        ValueError: naming the argument, what it got and what it accepts.
    """

    method: str = "directional"
    directions: int = 128
    softness: float = SOFTNESS
    merging: float = MERGING
    order: int = 8
    log: str = "eigen"
    base: str = "quadratic"
    samples: int = 1024
    error: float = 0.05

    def __post_init__(self) -> None:
        """Validate."""
        check.choice("method", self.method, (*METHODS, AUTO))
        check_count("directions", self.directions)
        sh.check_order(self.order)
        check.choice("log", self.log, LOGS)
        check.choice("base", self.base, THRESHOLDS)
        for name in ("directions", "order", "samples"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
                raise ValueError(f"{name}: got {value!r}, expected a whole number")
        if self.samples < 1:
            raise ValueError(f"samples: got {self.samples!r}, expected a positive number of directions")
        if not (np.isfinite(self.error) and self.error > 0):
            raise ValueError(f"error: got {self.error!r}, expected a positive number such as 0.05")
        edge_width(self.softness, self.directions)
        check_merging(self.merging)


@dataclass(frozen=True, eq=False)
class Body:
    """A mesh with its reflectance, placed in the world: scale first, then rotation, then translation.

    Args:
        mesh: The mesh.
        albedo: Reflectance, linear RGB, for the body [3] or for each vertex [vertex, 3].
        texture: Reflectance as an image in place of ``albedo``, linear RGB of shape [height, width, 3]; needs uvs.
        blockers: Number of spheres to fit to the mesh, or the spheres themselves; 0 or none casts no shadow, by rays
            neither. A flat body with all else on its front side is a ground, for which any number means one sphere
            touching it from behind.
        rotation: Axis-angle vector [degrees], shape [3].
        translation: Offset [scene units], shape [3].
        scale: Factor, positive.
        receivers: Where light is evaluated: at every "vertex", or at every "pixel" that shows the body, which a mesh
            of few faces needs to receive a shadow.

    Raises:
        ValueError: naming the argument, what it got and what it accepts.
    """

    mesh: Mesh
    albedo: np.ndarray | tuple[float, float, float] = (0.8, 0.8, 0.8)
    texture: np.ndarray | None = field(default=None, repr=False)
    blockers: int | Spheres = 64
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: float = 1.0
    receivers: str = "vertex"

    def __post_init__(self) -> None:
        """Validate, and hold arrays as float32."""
        albedo = np.array(self.albedo, np.float32)
        if albedo.shape not in ((3,), (self.mesh.vertex_count, 3)):
            raise ValueError(
                f"albedo: got shape {albedo.shape}, expected [3] or [{self.mesh.vertex_count}, 3] (one for each vertex)"
            )
        check.finite("albedo", albedo)
        if (albedo < 0).any() or (albedo > 1).any():
            raise ValueError(
                f"albedo: got values from {albedo.min()} to {albedo.max()}, expected reflectances in [0, 1]"
            )
        albedo.setflags(write=False)
        object.__setattr__(self, "albedo", albedo)
        if self.texture is not None:
            if self.mesh.uvs is None:
                raise ValueError(
                    f"texture: got an image, but mesh {self.mesh.name!r} has no uvs; expected none, or uvs"
                )
            texture = np.array(self.texture, np.float32)
            check.shape("texture", texture.shape, ("height", "width", 3))
            if texture.size == 0:
                raise ValueError(f"texture: got shape {texture.shape}, expected at least one texel")
            check.finite("texture", texture)
            texture.setflags(write=False)
            object.__setattr__(self, "texture", texture)
        if not isinstance(self.blockers, Spheres):
            is_count = isinstance(self.blockers, (int, np.integer)) and not isinstance(self.blockers, bool)
            if not is_count or self.blockers < 0:
                raise ValueError(
                    f"blockers: got {self.blockers!r}, expected a number of spheres, 0 or more, or Spheres"
                )
            object.__setattr__(self, "blockers", int(self.blockers))
        for name in ("rotation", "translation"):
            vector = np.array(getattr(self, name), np.float64)
            check.shape(name, vector.shape, (3,))
            check.finite(name, vector)
            object.__setattr__(self, name, vector)
        if not 0 < self.scale <= check.LARGEST:
            raise ValueError(f"scale: got {self.scale!r}, expected a positive number up to {check.LARGEST:g}")
        check.choice("receivers", self.receivers, RECEIVERS)

    @property
    def casts_shadow(self) -> bool:
        """Whether the body blocks light."""
        return bool(len(self.blockers) if isinstance(self.blockers, Spheres) else self.blockers)

    def rotation_matrix(self) -> np.ndarray:
        """The rotation as a matrix, float64 of shape [3, 3] (Rodrigues' formula)."""
        angle = np.radians(np.linalg.norm(self.rotation))
        if angle == 0:
            return np.eye(3)
        x, y, z = np.array(self.rotation) / np.linalg.norm(self.rotation)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross

    def world_mesh(self) -> Mesh:
        """The mesh in world space."""
        return self.mesh.transformed(
            rotation=self.rotation_matrix(), translation=np.array(self.translation), scale=self.scale
        )


@dataclass(frozen=True, eq=False)
class Scene:
    """What is rendered.

    Args:
        bodies: One or more bodies; they cast shadows on each other and on themselves.
        light: Environment map, or SH coefficients [order², 3].
        camera: The camera.
        visibility: How visibility is computed.
        supersampling: Each pixel averages this many samples across and down, which smooths silhouettes.

    Raises:
        ValueError: naming the argument, what it got and what it accepts.
    """

    bodies: tuple[Body, ...]
    light: EnvironmentMap | np.ndarray
    camera: Camera
    visibility: Visibility = field(default_factory=Visibility)
    supersampling: int = 2

    def __post_init__(self) -> None:
        """Validate."""
        object.__setattr__(self, "bodies", tuple(self.bodies))
        if not self.bodies:
            raise ValueError("bodies: got none, expected one or more")
        if not isinstance(self.light, EnvironmentMap):
            light = np.array(self.light, np.float32)
            check.shape("light", light.shape, ("order²", 3))
            check.finite("light", light)
            sh.check_order(sh.order_of("light", light))
            light.setflags(write=False)
            object.__setattr__(self, "light", light)
        if isinstance(self.supersampling, bool) or self.supersampling not in range(1, 17):
            raise ValueError(f"supersampling: got {self.supersampling!r}, expected a whole number from 1 to 16")
