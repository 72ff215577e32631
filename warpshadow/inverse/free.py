"""What a fit may leave free: light, reflectance, poses, shapes, cameras, exposure.

Each starts where the scene has it. Values are in natural units (radians, diagonals of bodies, reflectances, the
targets' own radiance), so that one learning rate serves all.
"""

from __future__ import annotations

import abc
import functools
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
import warp as wp

from warpshadow import check
from warpshadow.basis import Basis, CellBasis, HarmonicBasis
from warpshadow.camera import Camera
from warpshadow.directions import fibonacci
from warpshadow.inverse.world import Found, Setting, World
from warpshadow.light import EnvironmentMap
from warpshadow.sh import equirectangular_directions
from warpshadow.spheres import Spheres
from warpshadow.torch import apply, rotation_matrices

Values = dict[str, torch.Tensor]

_NO_TURN = {
    "axis-angle": (0.0, 0.0, 0.0),
    "quaternion": (0.0, 0.0, 0.0, 1.0),
    "6d": (1.0, 0.0, 0.0, 0.0, 1.0, 0.0),
}
_DARKEST = 1e-3  # light of cells starts no lower [radiance of the targets]: a logarithm has to come back from there


class Free(abc.ABC):
    """A free parameter of a scene."""

    moves: ClassVar[bool] = False
    """Whether geometry or cameras change with it."""

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """What values, messages and files call it."""

    @abc.abstractmethod
    def start(self, setting: Setting) -> Values:
        """Values where the scene has them.

        Raises:
            ValueError: where the scene has no such thing; the message names the argument.
        """

    @abc.abstractmethod
    def place(self, values: Values, setting: Setting, world: World) -> None:
        """Put values into the world. Differentiable: values."""

    @abc.abstractmethod
    def settle(self, values: Values, setting: Setting, found: Found) -> None:
        """Put final values into what is found."""

    def energy(self, values: Values, setting: Setting) -> torch.Tensor | None:
        """Regularizer, to be added to the loss; None for none. Differentiable: values."""
        return None

    def project(self, values: Values) -> None:
        """Move values in place to the nearest that are possible, after each step."""
        return


def _check_weight(name: str, value: float) -> None:
    if not (np.isfinite(value) and value >= 0):
        raise ValueError(f"{name}: got {value!r}, expected a weight of 0 or more")


def _check_body(body: int, setting: Setting) -> None:
    check.choice("body", body, range(len(setting.scene.bodies)))


# ---------------------------------------------------------------------------------------------- light


@dataclass(frozen=True)
class Light(Free):
    """The light, in spherical harmonics or as a map of cells.

    Args:
        order: Number of SH bands; None with ``directions``.
        directions: In place of ``order`` the number of cells, whose radiance is the exponential of a value and so never
            negative: sharper light, and a longer way to it.
        nonnegativity: Weight of the mean square of what is negative in spherical harmonics [targets' radiance].
    """

    order: int | None = 5
    directions: int | None = None
    nonnegativity: float = 0.0

    def __post_init__(self) -> None:
        """Validate."""
        if (self.order is None) == (self.directions is None):
            raise ValueError(f"order, directions: got {self.order!r} and {self.directions!r}, expected one of them")
        _check_weight("nonnegativity", self.nonnegativity)

    @property
    def name(self) -> str:
        """What values, messages and files call it."""
        return "light"

    @functools.cached_property
    def basis(self) -> Basis:
        """What the light is expressed in."""
        return CellBasis(fibonacci(self.directions)) if self.order is None else HarmonicBasis(self.order)

    def start(self, setting: Setting) -> Values:
        """The scene's light."""
        radiance = self.basis.coefficients(setting.scene.light) / setting.unit
        if isinstance(self.basis, CellBasis):
            return {"log_radiance": setting.tensor(np.log(np.maximum(radiance, _DARKEST)))}
        return {"coefficients": setting.tensor(radiance / np.sqrt(4 * np.pi))}

    def coefficients(self, values: Values, setting: Setting) -> torch.Tensor:
        """Light in the basis, linear RGB, [coefficient, 3]. Differentiable: values."""
        if isinstance(self.basis, CellBasis):
            return values["log_radiance"].exp() * setting.unit
        return values["coefficients"] * (setting.unit * np.sqrt(4 * np.pi))

    def place(self, values: Values, setting: Setting, world: World) -> None:
        """Light the world with it."""
        world.light = self.coefficients(values, setting)

    def energy(self, values: Values, setting: Setting) -> torch.Tensor | None:
        """What is negative."""
        if isinstance(self.basis, CellBasis) or not self.nonnegativity:
            return None
        radiance = self._sampling(setting) @ values["coefficients"]
        return self.nonnegativity * torch.relu(-radiance).square().mean()

    def _sampling(self, setting: Setting) -> torch.Tensor:
        """Takes values to radiance in many directions, [direction, coefficient]."""
        return setting.tensor(np.sqrt(4 * np.pi) * self.basis.functions(fibonacci(512)))

    def settle(self, values: Values, setting: Setting, found: Found) -> None:
        """Spherical harmonics stay what they are; cells become a map."""
        coefficients = self.coefficients(values, setting).cpu().numpy()
        light: EnvironmentMap | np.ndarray = coefficients
        if isinstance(self.basis, CellBasis):
            towards = equirectangular_directions(64)
            light = EnvironmentMap((self.basis.functions(towards.reshape(-1, 3)) @ coefficients).reshape(64, 128, 3))
        found.scene = replace(found.scene, light=light)


@dataclass(frozen=True)
class Exposure(Free):
    """The exposure of each view, a factor of its colors; known light then keeps its unit."""

    @property
    def name(self) -> str:
        """What values, messages and files call it."""
        return "exposure"

    def start(self, setting: Setting) -> Values:
        """A factor of 1."""
        return {"log": setting.tensor(np.zeros(len(setting.cameras)))}

    def place(self, values: Values, setting: Setting, world: World) -> None:
        """Expose the world's images."""
        world.exposures = values["log"].exp()

    def settle(self, values: Values, setting: Setting, found: Found) -> None:
        """Factors of the views."""
        found.exposures = values["log"].exp().tolist()


# ---------------------------------------------------------------------------------------------- reflectance


@dataclass(frozen=True)
class Albedo(Free):
    """The reflectance of a body: one color, or one for each vertex.

    Args:
        body: The body, from 0.
        per_vertex: A color for each vertex.
    """

    body: int
    per_vertex: bool = False

    @property
    def name(self) -> str:
        """What values, messages and files call it."""
        return f"albedo[{self.body}]"

    def start(self, setting: Setting) -> Values:
        """The body's albedo."""
        _check_body(self.body, setting)
        body = setting.scene.bodies[self.body]
        if body.texture is not None:
            raise ValueError(f"body: got {self.body}, which has a texture; expected one without, or Texture")
        colors = np.atleast_2d(body.albedo)
        if self.per_vertex:
            colors = np.broadcast_to(colors, (body.mesh.vertex_count, 3))
        elif len(colors) > 1:
            raise ValueError(f"body: got {self.body}, which has a color for each vertex; expected per_vertex=True")
        return {"color": setting.tensor(colors)}

    def place(self, values: Values, setting: Setting, world: World) -> None:
        """Color the body."""
        world.albedo[self.body] = values["color"]

    def project(self, values: Values) -> None:
        """Reflectances are in [0, 1]."""
        values["color"].clamp_(0, 1)

    def settle(self, values: Values, setting: Setting, found: Found) -> None:
        """Color the body."""
        color = values["color"].cpu().numpy()
        found.change_body(self.body, albedo=color if self.per_vertex else color[0])


@dataclass(frozen=True)
class Texture(Free):
    """The reflectance of a body as an image, which needs uvs.

    Args:
        body: The body, from 0.
        size: Height and width [texels]; by default those of the body's texture, or 256 × 256.
        smoothness: Weight of the mean square of differences between neighboring texels.
    """

    body: int
    size: tuple[int, int] | None = None
    smoothness: float = 0.0

    def __post_init__(self) -> None:
        """Validate."""
        _check_weight("smoothness", self.smoothness)

    @property
    def name(self) -> str:
        """What values, messages and files call it."""
        return f"texture[{self.body}]"

    def start(self, setting: Setting) -> Values:
        """The body's texture, or its color."""
        _check_body(self.body, setting)
        body = setting.scene.bodies[self.body]
        if body.mesh.uvs is None:
            raise ValueError(f"body: got {self.body}, whose mesh has no uvs; expected uvs, as mesh.unwrap makes them")
        if body.texture is None and np.ndim(body.albedo) > 1:
            raise ValueError(f"body: got {self.body}, which has a color for each vertex; expected one color")
        image = np.reshape(body.albedo, (1, 1, 3)) if body.texture is None else body.texture
        size = self.size or ((256, 256) if body.texture is None else image.shape[:2])
        planes = setting.tensor(image).permute(2, 0, 1)[None]
        mode = "area" if size[0] <= image.shape[0] else "bilinear"
        return {"texels": torch.nn.functional.interpolate(planes, size, mode=mode)[0].permute(1, 2, 0).contiguous()}

    def place(self, values: Values, setting: Setting, world: World) -> None:
        """Cover the body."""
        world.textures[self.body] = values["texels"]

    def energy(self, values: Values, setting: Setting) -> torch.Tensor | None:
        """Differences of neighbors."""
        if not self.smoothness:
            return None
        texels = values["texels"]
        return self.smoothness * (texels.diff(dim=0).square().mean() + texels.diff(dim=1).square().mean())

    def project(self, values: Values) -> None:
        """Reflectances are in [0, 1]."""
        values["texels"].clamp_(0, 1)

    def settle(self, values: Values, setting: Setting, found: Found) -> None:
        """Cover the body."""
        found.change_body(self.body, texture=values["texels"].cpu().numpy())


# ---------------------------------------------------------------------------------------------- motion


@dataclass(frozen=True)
class Pose(Free):
    """The pose of a body: a rotation about the middle of its bounding box, a translation, and maybe a scale.

    Args:
        body: The body, from 0.
        rotation: Parameters: "axis-angle" [radians], "quaternion" or "6d" (two columns).
        scale: Whether the size is free, too.
    """

    moves: ClassVar[bool] = True

    body: int
    rotation: str = "axis-angle"
    scale: bool = False

    def __post_init__(self) -> None:
        """Validate."""
        check.choice("rotation", self.rotation, _NO_TURN)

    @property
    def name(self) -> str:
        """What values, messages and files call it."""
        return f"pose[{self.body}]"

    def start(self, setting: Setting) -> Values:
        """Where the body is."""
        _check_body(self.body, setting)
        values = {"turn": setting.tensor(_NO_TURN[self.rotation]), "shift": setting.tensor(np.zeros(3))}
        return values | ({"log_scale": setting.tensor(0.0)} if self.scale else {})

    def _posed(self, values: Values, setting: Setting) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Rotation, translation and scale of the body: it turns about its middle m, which moves by the shift."""
        body = setting.scene.bodies[self.body]
        at_start, middle = setting.tensor(body.rotation_matrix()), setting.tensor(setting.middle(self.body))
        rotation = rotation_matrices(values["turn"]) @ at_start
        scale = setting.tensor(body.scale) * (values["log_scale"].exp() if self.scale else 1)
        moved = body.scale * at_start @ middle + setting.tensor(body.translation)
        moved = moved + body.scale * setting.diagonal(self.body) * values["shift"]
        return rotation, moved - scale * rotation @ middle, scale

    def place(self, values: Values, setting: Setting, world: World) -> None:
        """Move the body."""
        rotation, translation, scale = self._posed(values, setting)
        world.rotations[self.body] = rotation
        world.translations[self.body] = translation
        world.scales[self.body] = scale
        world.moves = True

    def settle(self, values: Values, setting: Setting, found: Found) -> None:
        """Move the body."""
        from scipy.spatial.transform import Rotation

        rotation, translation, scale = (part.cpu().numpy() for part in self._posed(values, setting))
        vector = Rotation.from_matrix(rotation).as_rotvec(degrees=True)
        found.change_body(self.body, rotation=vector, translation=translation, scale=float(scale))


@dataclass(frozen=True)
class Deformation(Free):
    """The shape of a body, by embedded deformation (Sumner et al. 2007); its spheres are the nodes (the paper, sec. 4).

    Args:
        body: The body, from 0; it needs more spheres than ``count``.
        rigidity: Weight of the as-rigid-as-possible energy, the mean over pairs of neighboring nodes
            [squares of the diagonal].
        count: Nodes that carry a vertex, and neighbors of a node.
    """

    moves: ClassVar[bool] = True

    body: int
    rigidity: float = 100.0
    count: int = 4

    def __post_init__(self) -> None:
        """Validate."""
        _check_weight("rigidity", self.rigidity)

    @property
    def name(self) -> str:
        """What values, messages and files call it."""
        return f"deformation[{self.body}]"

    def start(self, setting: Setting) -> Values:
        """The shape as it is."""
        _check_body(self.body, setting)
        nodes = setting.graph(self.body, self.count).node_positions.shape[0]
        return {"turns": setting.tensor(np.zeros((nodes, 3))), "shifts": setting.tensor(np.zeros((nodes, 3)))}

    def _moved_nodes(self, values: Values, setting: Setting) -> tuple[torch.Tensor, torch.Tensor]:
        """Rotations [1, node, 3, 3] and translations [1, node, 3] in the body's own space."""
        return rotation_matrices(values["turns"])[None], (setting.diagonal(self.body) * values["shifts"])[None]

    def _deformed(self, values: Values, setting: Setting) -> tuple[torch.Tensor, torch.Tensor]:
        """Vertices and centers in the body's own space, with a batch of 1."""
        graph = setting.graph(self.body, self.count)
        rotations, shifts = self._moved_nodes(values, setting)
        points = apply(graph.points, rotations, shifts, dtypes=(wp.mat33, wp.vec3))
        return points, apply(graph.centers, shifts, dtypes=(wp.vec3,))

    def place(self, values: Values, setting: Setting, world: World) -> None:
        """Bend the body."""
        points, centers = self._deformed(values, setting)
        world.rest = world.renderer.deformed(self.body, points, centers, rest=world.rest)
        world.moves = True

    def energy(self, values: Values, setting: Setting) -> torch.Tensor | None:
        """Differences between where neighboring nodes take each other."""
        if not self.rigidity:
            return None
        graph = setting.graph(self.body, self.count)
        total = apply(graph.rigidity, *self._moved_nodes(values, setting), dtypes=(wp.mat33, wp.vec3))
        return total[0] * (self.rigidity / (graph.neighbors.size * setting.diagonal(self.body) ** 2))

    def settle(self, values: Values, setting: Setting, found: Found) -> None:
        """Bend the body, mesh and spheres."""
        points, centers = (part[0].cpu().numpy() for part in self._deformed(values, setting))
        body = found.scene.bodies[self.body]
        found.change_body(
            self.body,
            mesh=replace(body.mesh, positions=points),
            blockers=Spheres(centers, found.spheres(self.body).radii),
        )


@dataclass(frozen=True)
class Radii(Free):
    """The radii of a body's spheres, as factors.

    Args:
        body: The body, from 0.
        persistence: Weight of the mean square of the factors' logarithms.
    """

    moves: ClassVar[bool] = True

    body: int
    persistence: float = 0.0

    def __post_init__(self) -> None:
        """Validate."""
        _check_weight("persistence", self.persistence)

    @property
    def name(self) -> str:
        """What values, messages and files call it."""
        return f"radii[{self.body}]"

    def start(self, setting: Setting) -> Values:
        """The radii as they are."""
        _check_body(self.body, setting)
        count = len(setting.spheres(self.body))
        if not count:
            raise ValueError(f"body: got {self.body}, which has no spheres; expected one that casts a shadow")
        return {"log": setting.tensor(np.zeros(count))}

    def place(self, values: Values, setting: Setting, world: World) -> None:
        """Swell and shrink the spheres."""
        radii = setting.tensor(setting.spheres(self.body).radii) * values["log"].exp()
        batch = radii if world.rest is None or world.rest.radii.ndim == 1 else radii[None]
        world.rest = world.renderer.deformed(self.body, radii=batch, rest=world.rest)
        world.moves = True

    def energy(self, values: Values, setting: Setting) -> torch.Tensor | None:
        """Logarithms of the factors."""
        return self.persistence * values["log"].square().mean() if self.persistence else None

    def settle(self, values: Values, setting: Setting, found: Found) -> None:
        """Swell and shrink the spheres."""
        spheres = found.spheres(self.body)
        found.change_body(
            self.body, blockers=Spheres(spheres.centers, spheres.radii * values["log"].exp().cpu().numpy())
        )


@dataclass(frozen=True)
class CameraPose(Free):
    """Where each view was taken: the eye, how it looks, and maybe the focal length.

    Args:
        focal: Whether the focal length is free, too.
    """

    moves: ClassVar[bool] = True

    focal: bool = False

    @property
    def name(self) -> str:
        """What values, messages and files call it."""
        return "camera"

    def start(self, setting: Setting) -> Values:
        """The cameras as they are."""
        views = len(setting.cameras)
        values = {"turn": setting.tensor(np.zeros((views, 3))), "shift": setting.tensor(np.zeros((views, 3)))}
        return values | ({"log_focal": setting.tensor(np.zeros(views))} if self.focal else {})

    def _posed(
        self, values: Values, setting: Setting, cameras: tuple[Camera, ...]
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """R, t and K of the views; shifts of the eye are in units of its distance from the scene."""
        low, high = zip(*(body.world_mesh().bounds for body in setting.scene.bodies), strict=True)
        middle = (np.min(low, axis=0) + np.max(high, axis=0)) / 2
        eyes = np.stack([camera.eye for camera in cameras])
        distances = np.linalg.norm(eyes - middle, axis=1, keepdims=True)
        rotations = rotation_matrices(values["turn"]) @ setting.tensor([camera.rotation for camera in cameras])
        moved = setting.tensor(eyes) + setting.tensor(distances) * values["shift"]
        intrinsics = setting.tensor([camera.intrinsics for camera in cameras])
        if self.focal:
            zoom = torch.ones_like(intrinsics)
            zoom[:, :2, :2] = values["log_focal"].exp()[:, None, None]
            intrinsics = intrinsics * zoom
        return rotations, -(rotations @ moved[..., None])[..., 0], intrinsics

    def place(self, values: Values, setting: Setting, world: World) -> None:
        """Move the cameras."""
        rotations, translations, intrinsics = self._posed(values, setting, world.cameras)
        world.clip_matrices = world.renderer.clip_matrices(rotations, translations, intrinsics)

    def settle(self, values: Values, setting: Setting, found: Found) -> None:
        """Move the cameras."""
        rotations, translations, intrinsics = (
            part.cpu().numpy().astype(np.float64) for part in self._posed(values, setting, setting.cameras)
        )
        found.cameras = [
            replace(camera, rotation=rotations[view], translation=translations[view], intrinsics=intrinsics[view])
            for view, camera in enumerate(found.cameras)
        ]
        found.scene = replace(found.scene, camera=found.cameras[0])
