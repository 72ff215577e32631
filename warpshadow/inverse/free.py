"""What a fit may leave free: light, reflectance, poses, shapes, cameras, exposure.

Each starts where the scene has it. Values are in natural units (radians, half diagonals of bodies, reflectances, the
targets' own radiance), so that one learning rate serves all.
"""

from __future__ import annotations

import abc
import functools
import itertools
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
import warp as wp

from warpshadow import check
from warpshadow.assets.basis import Basis, CellBasis, HarmonicBasis
from warpshadow.assets.camera import Camera
from warpshadow.assets.light import EnvironmentMap
from warpshadow.inverse.world import Found, Setting, World
from warpshadow.maths.directions import check_count, fibonacci
from warpshadow.maths.sh import check_order, equirectangular_directions
from warpshadow.pipeline.renderer import Renderer
from warpshadow.scene.scene import SPHERE_METHODS, Body, Scene, Visibility
from warpshadow.spheres import Spheres
from warpshadow.stages.textures.sample import fill_unseen
from warpshadow.torch import apply, rotation_matrices

Values = dict[str, torch.Tensor]

_NO_TURN = {
    "axis-angle": (0.0, 0.0, 0.0),
    "quaternion": (0.0, 0.0, 0.0, 1.0),
    "6d": (1.0, 0.0, 0.0, 0.0, 1.0, 0.0),
}
_TURNS = np.array(
    [sign * axis for axis in np.eye(3) for sign in (-1, 1)] + list(itertools.product((-1.0, 1.0), repeat=3))
)
_STRETCH = 0.4  # a unit of stretch: nodes stretch less than they turn
_DARKEST = 1e-3  # light of cells starts no lower [radiance of the targets]: a logarithm has to come back from there


class Free(abc.ABC):
    """A free parameter of a scene."""

    moves: ClassVar[bool] = False
    """Whether geometry or cameras change with it."""

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """What values, messages and files call it."""

    def check_scene(self, scene: Scene) -> None:
        """Raise ValueError where a scene has no such thing; the message names the argument."""
        return

    @abc.abstractmethod
    def start(self, setting: Setting) -> Values:
        """Values where the scene has them."""

    @abc.abstractmethod
    def place(self, values: Values, setting: Setting, world: World) -> None:
        """Put values into the world. Differentiable: values."""

    def scattered(self, values: Values, number: int, generator: torch.Generator) -> Values:
        """Other values around these, for a descent that starts at several places; the same where one will do.

        Args:
            values: The first place.
            number: Of the other place, from 0.
            generator: Of random numbers.
        """
        return {key: tensor.detach().clone() for key, tensor in values.items()}

    @abc.abstractmethod
    def settle(self, values: Values, setting: Setting, found: Found) -> None:
        """Put final values into what is found."""

    def energy(self, values: Values, setting: Setting) -> torch.Tensor | None:
        """Regularizer, to be added to the loss; None for none. Differentiable: values."""
        return None

    def project(self, values: Values) -> None:
        """Move values in place to the nearest that are possible, after each step."""
        return


@dataclass(frozen=True)
class FreeOfBody(Free):
    """A free parameter of a body.

    Args:
        body: The body, from 0.
    """

    body: int

    def __post_init__(self) -> None:
        """Validate."""
        if not check.is_integer(self.body) or self.body < 0:
            raise ValueError(f"body: got {check.described(self.body)}, expected the number of a body, from 0")

    def check_scene(self, scene: Scene) -> None:
        """Raise ValueError where a scene has no such body."""
        check.index("body", self.body, len(scene.bodies), "body")


def _check_weight(name: str, value: float) -> None:
    if not (check.is_number(value) and value >= 0):
        raise ValueError(f"{name}: got {check.described(value)}, expected a weight of 0 or more")


def _sphere_count(body: Body) -> int:
    """Spheres of a body, or how many are asked for."""
    return body.blockers if isinstance(body.blockers, int) else len(body.blockers)


# ---------------------------------------------------------------------------------------------- light


@dataclass(frozen=True)
class Light(Free):
    """The light, in spherical harmonics or as a map of cells.

    Args:
        order: Number of SH bands; None with ``directions``.
        directions: In place of ``order`` the number of cells, whose radiance is the exponential of a value and so never
            negative: sharper light, and a longer way to it.
        nonnegativity: Weight of the mean square of what is negative in spherical harmonics [targets' radiance].
        smoothness: Weight of the mean square of differences between neighboring cells [targets' radiance].
    """

    order: int | None = 5
    directions: int | None = None
    nonnegativity: float = 0.0
    smoothness: float = 1e-4

    def __post_init__(self) -> None:
        """Validate."""
        if (self.order is None) == (self.directions is None):
            raise ValueError(
                f"order, directions: got {self.order!r} and {self.directions!r}, expected one of them, such as "
                "Light(5) or Light(None, directions=512)"
            )
        if self.directions is not None:
            check_count("directions", self.directions)
        if self.order is not None:
            check_order(self.order)
        for name in ("nonnegativity", "smoothness"):
            _check_weight(name, getattr(self, name))

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
        """What is negative, and how neighboring cells differ."""
        if isinstance(self.basis, CellBasis):
            first, second = _neighbors(self.basis.size)
            radiance = values["log_radiance"].exp()
            return self.smoothness * (radiance[first] - radiance[second]).square().mean() if self.smoothness else None
        if not self.nonnegativity:
            return None
        towards = np.sqrt(4 * np.pi) * self.basis.functions(fibonacci(512))
        radiance = setting.tensor(towards) @ values["coefficients"]
        return self.nonnegativity * torch.relu(-radiance).square().mean()

    def settle(self, values: Values, setting: Setting, found: Found) -> None:
        """Spherical harmonics stay what they are; cells become a map."""
        coefficients = self.coefficients(values, setting).cpu().numpy()
        light: EnvironmentMap | np.ndarray = coefficients
        if isinstance(self.basis, CellBasis):
            towards = equirectangular_directions(64)
            light = EnvironmentMap((self.basis.functions(towards.reshape(-1, 3)) @ coefficients).reshape(64, 128, 3))
        found.scene = replace(found.scene, light=light)


@functools.cache
def _neighbors(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Pairs of cells that lie side by side: each and the six nearest to it."""
    from scipy.spatial import cKDTree

    directions = fibonacci(count)
    _, nearest = cKDTree(directions).query(directions, k=7)
    pairs = np.stack([np.repeat(np.arange(count), 6), nearest[:, 1:].ravel()])
    pairs = np.unique(np.sort(pairs, axis=0), axis=1)
    return torch.from_numpy(pairs[0]), torch.from_numpy(pairs[1])


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
class Albedo(FreeOfBody):
    """The reflectance of a body: one color, or one for each vertex.

    Args:
        body: The body, from 0.
        per_vertex: A color for each vertex.
    """

    per_vertex: bool = False

    @property
    def name(self) -> str:
        """What values, messages and files call it."""
        return f"albedo[{self.body}]"

    def check_scene(self, scene: Scene) -> None:
        """Raise ValueError for a body whose reflectance is of another kind."""
        super().check_scene(scene)
        body = scene.bodies[self.body]
        if body.texture is not None:
            raise ValueError(f"body: got {self.body}, which has a texture; expected one without, or Texture")
        if np.ndim(body.albedo) > 1 and not self.per_vertex:
            raise ValueError(f"body: got {self.body}, which has a color for each vertex; expected per_vertex=True")

    def start(self, setting: Setting) -> Values:
        """The body's albedo."""
        body = setting.scene.bodies[self.body]
        colors = np.atleast_2d(body.albedo)
        if self.per_vertex:
            colors = np.broadcast_to(colors, (body.mesh.vertex_count, 3))
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
class Texture(FreeOfBody):
    """The reflectance of a body as an image, which needs uvs.

    Args:
        body: The body, from 0.
        size: Height and width [texels]; by default those of the body's texture, or 256 × 256.
        smoothness: Weight of the mean square of differences between neighboring texels.
    """

    size: tuple[int, int] | None = None
    smoothness: float = 0.0

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        if self.size is not None:
            is_pair = isinstance(self.size, (tuple, list, np.ndarray)) and len(self.size) == 2
            if not is_pair or not all(check.is_integer(count) and count > 0 for count in self.size):
                raise ValueError(f"size: got {self.size!r}, expected height and width in whole texels, (256, 256)")
        _check_weight("smoothness", self.smoothness)

    @property
    def name(self) -> str:
        """What values, messages and files call it."""
        return f"texture[{self.body}]"

    def check_scene(self, scene: Scene) -> None:
        """Raise ValueError for a body that cannot have a texture."""
        super().check_scene(scene)
        body = scene.bodies[self.body]
        if body.mesh.uvs is None:
            raise ValueError(
                f"body: got {self.body}, whose mesh has no uvs; expected uvs, as "
                "warpshadow.assets.unwrap.unwrap makes them"
            )
        if body.texture is None and np.ndim(body.albedo) > 1:
            raise ValueError(f"body: got {self.body}, which has a color for each vertex; expected one color")

    def start(self, setting: Setting) -> Values:
        """The body's texture, or its color."""
        body = setting.scene.bodies[self.body]
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
        down, across = (texels.diff(dim=dim).square().sum() for dim in (0, 1))  # sums: a single row has no mean down
        return self.smoothness * (down + across) / texels.numel()

    def project(self, values: Values) -> None:
        """Reflectances are in [0, 1]."""
        values["texels"].clamp_(0, 1)

    def settle(self, values: Values, setting: Setting, found: Found) -> None:
        """Cover the body; texels that no view sees get the color of the nearest one that is seen."""
        texels = values["texels"].cpu().numpy()
        found.change_body(self.body, texture=texels)
        unshadowed = replace(found.scene, visibility=Visibility(method="none"))
        renderer = Renderer(unshadowed, cameras=found.cameras, device=str(setting.device))
        found.change_body(self.body, texture=fill_unseen(texels, renderer.seen_texels(self.body)))


# ---------------------------------------------------------------------------------------------- motion


@dataclass(frozen=True)
class Pose(FreeOfBody):
    """The pose of a body: a rotation about the middle of its bounding box, a translation, and maybe a scale.

    Args:
        body: The body, from 0.
        rotation: Parameters: "axis-angle" [radians], "quaternion" or "6d" (two columns).
        scale: Whether the size is free, too.
        spread: By what angle candidates are turned [radians]: about each axis, either way, then about the eight
            directions in their midst, then about any.
    """

    moves: ClassVar[bool] = True

    rotation: str = "axis-angle"
    scale: bool = False
    spread: float = 0.55

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        check.choice("rotation", self.rotation, _NO_TURN)
        if not (check.is_number(self.spread) and 0 <= self.spread <= np.pi):
            raise ValueError(f"spread: got {self.spread!r}, expected an angle from 0 to π")

    @property
    def name(self) -> str:
        """What values, messages and files call it."""
        return f"pose[{self.body}]"

    def start(self, setting: Setting) -> Values:
        """Where the body is."""
        values = {"turn": setting.tensor(_NO_TURN[self.rotation]), "shift": setting.tensor(np.zeros(3))}
        return values | ({"log_scale": setting.tensor(0.0)} if self.scale else {})

    def scattered(self, values: Values, number: int, generator: torch.Generator) -> Values:
        """The pose, turned."""
        from scipy.spatial.transform import Rotation

        known = number < len(_TURNS)
        axis = _TURNS[number] if known else torch.randn(3, generator=generator).numpy().astype(np.float64)
        turn = Rotation.from_rotvec(self.spread * axis / np.linalg.norm(axis))
        start = values["turn"].cpu().numpy()
        if self.rotation == "axis-angle":
            turned = (turn * Rotation.from_rotvec(start)).as_rotvec()
        elif self.rotation == "quaternion":
            turned = (turn * Rotation.from_quat(start)).as_quat()
        else:
            turned = turn.apply(start.reshape(2, 3)).ravel()
        copies = super().scattered(values, number, generator)
        return copies | {"turn": torch.tensor(turned, dtype=torch.float32, device=values["turn"].device)}

    def _posed(self, values: Values, setting: Setting) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Rotation, translation and scale of the body: it turns about its middle m, which moves by the shift."""
        body = setting.scene.bodies[self.body]
        at_start, middle = setting.tensor(body.rotation_matrix()), setting.tensor(setting.middle(self.body))
        rotation = rotation_matrices(values["turn"]) @ at_start
        scale = setting.tensor(body.scale) * (values["log_scale"].exp() if self.scale else 1)
        moved = body.scale * at_start @ middle + setting.tensor(body.translation)
        moved = moved + body.scale * setting.extent(self.body) * values["shift"]
        return rotation, moved - scale * rotation @ middle, scale

    def place(self, values: Values, setting: Setting, world: World) -> None:
        """Move the body."""
        rotation, translation, scale = self._posed(values, setting)
        world.rotations[self.body] = rotation
        world.translations[self.body] = translation
        world.scales[self.body] = scale
        world.moving.add(self.body)

    def settle(self, values: Values, setting: Setting, found: Found) -> None:
        """Move the body."""
        from scipy.spatial.transform import Rotation

        rotation, translation, scale = (part.cpu().numpy() for part in self._posed(values, setting))
        vector = Rotation.from_matrix(rotation).as_rotvec(degrees=True)
        found.change_body(self.body, rotation=vector, translation=translation, scale=float(scale))


@dataclass(frozen=True)
class Deformation(FreeOfBody):
    """The shape of a body, by embedded deformation (Sumner et al. 2007); its spheres are the nodes (the paper, sec. 4).

    A node's matrix is a rotation times a symmetric stretch. Values are those of the nodes before they are smoothed over
    the graph, T = (I + λ L)⁻¹ u, L the graph's Laplacian over the mean number of neighbors: so that a step of the
    descent moves parts of the body, and not nodes one by one (Nicolet et al. 2021, section 3.2).

    Args:
        body: The body, from 0; it needs more spheres than ``count``.
        rigidity: Weight of the as-rigid-as-possible energy, the mean over pairs of neighboring nodes
            [squares of half the diagonal].
        firmness: Weight of the mean square of the nodes' stretches.
        smoothness: λ.
        count: Nodes that carry a vertex.
    """

    moves: ClassVar[bool] = True

    rigidity: float = 1.25
    firmness: float = 0.001
    smoothness: float = 6.0
    count: int = 4

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        for name in ("rigidity", "firmness", "smoothness"):
            _check_weight(name, getattr(self, name))
        if not check.is_integer(self.count) or self.count < 1:
            raise ValueError(f"count: got {self.count!r}, expected a whole number of nodes from 1 on")

    @property
    def name(self) -> str:
        """What values, messages and files call it."""
        return f"deformation[{self.body}]"

    def check_scene(self, scene: Scene) -> None:
        """Raise ValueError for a body with too few spheres."""
        super().check_scene(scene)
        nodes = _sphere_count(scene.bodies[self.body])
        if self.count >= nodes:
            raise ValueError(f"count: got {self.count} for {nodes} nodes, the body's spheres, expected fewer than them")

    def start(self, setting: Setting) -> Values:
        """The shape as it is."""
        nodes = setting.graph(self.body, self.count).node_positions.shape[0]
        sizes = {"turns": 3, "shifts": 3, "stretches": 6}
        return {key: setting.tensor(np.zeros((nodes, size))) for key, size in sizes.items()}

    def _moved_nodes(self, values: Values, setting: Setting) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Matrices [node, 3, 3] and translations [node, 3] in the body's own space, and stretches [node, 3, 3]."""
        smoothing = setting.smoothing(self.body, self.count, self.smoothness)
        turns, shifts, entries = (smoothing @ values[key] for key in ("turns", "shifts", "stretches"))
        stretches = (_STRETCH * entries[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]]).reshape(-1, 3, 3)
        rotations = rotation_matrices(turns)
        return rotations + rotations @ stretches, setting.extent(self.body) * shifts, stretches

    def _deformed(self, values: Values, setting: Setting) -> tuple[torch.Tensor, torch.Tensor]:
        """Vertices and centers in the body's own space, with a batch of 1."""
        graph = setting.graph(self.body, self.count)
        matrices, shifts, _ = self._moved_nodes(values, setting)
        points = apply(graph.points, matrices[None], shifts[None], dtypes=(wp.mat33, wp.vec3))
        return points, apply(graph.centers, shifts[None], dtypes=(wp.vec3,))

    def place(self, values: Values, setting: Setting, world: World) -> None:
        """Bend the body."""
        points, centers = self._deformed(values, setting)
        has_spheres = len(setting.spheres(self.body)) > 0  # without shadows there are nodes, but no spheres
        world.rest = world.renderer.deformed(self.body, points, centers if has_spheres else None, rest=world.rest)
        world.moving.add(self.body)

    def energy(self, values: Values, setting: Setting) -> torch.Tensor | None:
        """Differences between where neighboring nodes take each other, and stretches."""
        graph = setting.graph(self.body, self.count)
        matrices, shifts, stretches = self._moved_nodes(values, setting)
        gaps = apply(graph.rigidity, matrices[None], shifts[None], dtypes=(wp.mat33, wp.vec3))[0]
        gaps = gaps / (graph.neighbors.shape[0] * setting.extent(self.body) ** 2)
        return self.rigidity * gaps + self.firmness * stretches.square().sum((1, 2)).mean()

    def settle(self, values: Values, setting: Setting, found: Found) -> None:
        """Bend the body, mesh and spheres."""
        points, centers = (part[0].cpu().numpy() for part in self._deformed(values, setting))
        found.change_body(self.body, mesh=replace(found.scene.bodies[self.body].mesh, positions=points))
        spheres = found.spheres(self.body)
        if len(spheres):
            found.change_body(self.body, blockers=Spheres(centers, spheres.radii))


@dataclass(frozen=True)
class Radii(FreeOfBody):
    """The radii of a body's spheres, as factors.

    Args:
        body: The body, from 0.
        persistence: Weight of the mean square of the factors' logarithms.
    """

    moves: ClassVar[bool] = True

    persistence: float = 0.0

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        _check_weight("persistence", self.persistence)

    @property
    def name(self) -> str:
        """What values, messages and files call it."""
        return f"radii[{self.body}]"

    def check_scene(self, scene: Scene) -> None:
        """Raise ValueError for a body without spheres."""
        super().check_scene(scene)
        if scene.visibility.method not in SPHERE_METHODS or not _sphere_count(scene.bodies[self.body]):
            raise ValueError(f"body: got {self.body}, which has no spheres; expected one that casts a shadow")

    def start(self, setting: Setting) -> Values:
        """The radii as they are."""
        return {"log": setting.tensor(np.zeros(len(setting.spheres(self.body))))}

    def place(self, values: Values, setting: Setting, world: World) -> None:
        """Swell and shrink the spheres."""
        radii = setting.tensor(setting.spheres(self.body).radii) * values["log"].exp()
        world.rest = world.renderer.deformed(self.body, radii=radii, rest=world.rest)
        world.moving.add(self.body)

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
        rotations = rotation_matrices(values["turn"]) @ setting.tensor([camera.rotation for camera in cameras])
        eyes = setting.tensor([camera.eye for camera in cameras])
        moved = eyes + setting.tensor(setting.distances) * values["shift"]
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
