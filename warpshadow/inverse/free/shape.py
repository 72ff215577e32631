"""A free shape of a body: how it is deformed, and how large its spheres are."""

from dataclasses import dataclass, replace

import numpy as np
import torch
import warp as wp

from warpshadow import check
from warpshadow.inverse.free.base import FreeOfBody, Values
from warpshadow.inverse.world import FitContext, FittedScene, World
from warpshadow.scene.body import Body
from warpshadow.scene.scene import Scene
from warpshadow.scene.visibility import SPHERE_METHODS
from warpshadow.spheres import Spheres, fit_spheres
from warpshadow.torch import apply, rotation_matrices

_STRETCH_UNIT = 0.4  # a unit of stretch: nodes stretch less than they turn


def _sphere_count(body: Body) -> int:
    """Spheres of a body, or how many are asked for; where that is "auto" they are fitted."""
    if isinstance(body.blockers, Spheres):
        return len(body.blockers)
    return body.blockers if isinstance(body.blockers, int) else len(fit_spheres(body.mesh, progress=False).spheres)


@check.frozen()
@dataclass(frozen=True)
class Deformation(FreeOfBody):
    """The shape of a body, by embedded deformation (Sumner et al. 2007); its spheres are the nodes (the paper, sec. 4).

    A node's matrix is a rotation times a symmetric stretch. The parameters are node values before they are smoothed
    over the graph, T = (I + λ L)⁻¹ u, L the graph's Laplacian over the mean number of neighbors: so that a step of the
    descent moves parts of the body, and not nodes one by one (Nicolet et al. 2021, section 3.2).

    Args:
        body: The body, its number or name; it needs more spheres than ``count``.
        rigidity: Weight of the as-rigid-as-possible energy, the mean over pairs of neighboring nodes
            [squares of half the diagonal].
        firmness: Weight of the mean square of the nodes' stretches.
        smoothness: λ.
        count: Nodes that carry a vertex.
    """

    key = "deformation"
    moves = True
    reframes = True
    reshapes = True

    rigidity: float = 1.25
    firmness: float = 0.001
    smoothness: float = 6.0
    count: int = 4

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("rigidity", "firmness", "smoothness"):
            check.nonnegative(name, getattr(self, name))
        check.integer("count", self.count, unit="nodes")

    def check_scene(self, scene: Scene, view_count: int) -> None:
        nodes = _sphere_count(scene.bodies[self.number])
        if self.count >= nodes:
            raise ValueError(f"count: got {self.count} for {nodes} nodes, the body's spheres, expected fewer than them")

    def start(self, context: FitContext) -> Values:
        nodes = context.graph(self.number, self.count).node_positions.shape[0]
        sizes = {"turns": 3, "shifts": 3, "stretches": 6}
        return {key: context.tensor(np.zeros((nodes, size))) for key, size in sizes.items()}

    def _moved_nodes(self, values: Values, context: FitContext) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Matrices [node, 3, 3] and translations [node, 3] in the body's own space, and stretches [node, 3, 3]."""
        smoothing = context.smoothing(self.number, self.count, self.smoothness)
        turns, shifts, entries = (smoothing @ values[key] for key in ("turns", "shifts", "stretches"))
        stretches = (_STRETCH_UNIT * entries[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]]).reshape(-1, 3, 3)
        rotations = rotation_matrices(turns)
        return rotations + rotations @ stretches, context.extent(self.number) * shifts, stretches

    def _deformed(self, values: Values, context: FitContext) -> tuple[torch.Tensor, torch.Tensor]:
        """Vertices and centers in the body's own space, with a batch of 1."""
        graph = context.graph(self.number, self.count)
        matrices, shifts, _ = self._moved_nodes(values, context)
        points = apply(graph.points, matrices[None], shifts[None], dtypes=(wp.mat33, wp.vec3))
        return points, apply(graph.centers, shifts[None], dtypes=(wp.vec3,))

    def apply(self, values: Values, context: FitContext, world: World) -> None:
        points, centers = self._deformed(values, context)
        has_spheres = len(context.spheres(self.number)) > 0  # without shadows there are nodes, but no spheres
        world.rest = world.renderer.deformed(self.number, points, centers if has_spheres else None, rest=world.rest)
        world.moving.add(self.number)

    def regularizer(self, values: Values, context: FitContext) -> torch.Tensor | None:
        """Differences between where neighboring nodes take each other, and stretches."""
        graph = context.graph(self.number, self.count)
        matrices, shifts, stretches = self._moved_nodes(values, context)
        gaps = apply(graph.rigidity, matrices[None], shifts[None], dtypes=(wp.mat33, wp.vec3))[0]
        gaps = gaps / (graph.neighbors.shape[0] * context.extent(self.number) ** 2)
        return self.rigidity * gaps + self.firmness * stretches.square().sum((1, 2)).mean()

    def export(self, values: Values, context: FitContext, fitted: FittedScene) -> None:
        points, centers = (part[0].cpu().numpy() for part in self._deformed(values, context))
        mesh = replace(fitted.scene.bodies[self.number].mesh, positions=points)
        fitted.change_body(self.number, mesh=mesh, self_shadows="spheres")  # as in the images of the fit
        spheres = fitted.spheres(self.number)
        if len(spheres):
            fitted.change_body(self.number, blockers=Spheres(centers, spheres.radii))


@check.frozen()
@dataclass(frozen=True)
class Radii(FreeOfBody):
    """The radii of a body's spheres, as factors.

    Args:
        body: The body, its number or name.
        persistence: Weight of the mean square of the factors' logarithms.
    """

    key = "radii"
    moves = True
    reshapes = True

    persistence: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check.nonnegative("persistence", self.persistence)

    def check_scene(self, scene: Scene, view_count: int) -> None:
        if scene.visibility.method not in SPHERE_METHODS or not _sphere_count(scene.bodies[self.number]):
            raise ValueError(f"body: got {self.number}, which has no spheres; expected one that casts a shadow")

    def start(self, context: FitContext) -> Values:
        return {"log": context.tensor(np.zeros(len(context.spheres(self.number))))}

    def apply(self, values: Values, context: FitContext, world: World) -> None:
        radii = context.tensor(context.spheres(self.number).radii) * values["log"].exp()
        world.rest = world.renderer.deformed(self.number, radii=radii, rest=world.rest)
        world.moving.add(self.number)

    def regularizer(self, values: Values, context: FitContext) -> torch.Tensor | None:
        return self.persistence * values["log"].square().mean() if self.persistence else None

    def export(self, values: Values, context: FitContext, fitted: FittedScene) -> None:
        spheres = fitted.spheres(self.number)
        radii = spheres.radii * values["log"].exp().cpu().numpy()
        fitted.change_body(self.number, blockers=Spheres(spheres.centers, radii), self_shadows="spheres")
