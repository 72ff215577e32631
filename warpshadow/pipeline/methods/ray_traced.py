"""The ray-traced method: rays past the meshes themselves. It has no gradient to geometry."""

import functools
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warpshadow.assets.basis import Basis, CellBasis, HarmonicBasis
from warpshadow.assets.known_light import KnownLight
from warpshadow.device.batch import common_batch, instance_of
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.bodies.reflectance import Materials
from warpshadow.pipeline.node import ExplainRow, Input, Node, detached
from warpshadow.pipeline.receivers.shading_context import ShadingContext, receiver_text
from warpshadow.pipeline.shading.light_input import LightInput
from warpshadow.pipeline.shading.lobe_light import LitLobes, LobeVisibility
from warpshadow.pipeline.shading.method import Method
from warpshadow.stages.gloss.reflection import find_blocked_radiance
from warpshadow.stages.gloss.traced_lobes import trace_lobes
from warpshadow.stages.light.light_samples import cut_map, sample_map
from warpshadow.stages.ray_traced.shared_rays import find_corners, find_light_shares, trace_shared
from warpshadow.stages.ray_traced.traced_transfer import trace_transfer
from warpshadow.stages.rays.ray_packets import PACKET, FaceTree, build_face_tree
from warpshadow.stages.rays.ray_tracing import trace_shading
from warpshadow.stages.receivers.receivers import Receivers
from warpshadow.stages.shell.shell_rays import FAR, check_within

if TYPE_CHECKING:  # it is imported where bodies emit
    from warpshadow.stages.emitters.samples import PlacedSamples

Meshes = list[wp.Mesh | None]  # mesh that blocks light of each instance, the last of the rest; None for no blocker
_RAYS_OF_CELL = 4  # least number of rays to a cell of free light, on average

_EVEN_RAYS = 128  # directions in which receivers that shine look for how much of the hemisphere is open


class RayTraced(Method):
    """Visibility of the meshes."""

    shares_lobes = True

    def __init__(self, merged_scene: MergedScene, basis: Basis | None, *, progress: bool = False):
        super().__init__(merged_scene, HarmonicBasis(merged_scene.scene.visibility.order), basis, progress=progress)
        self.shares_directions = self.visibility.sampling == "shared"

    def known_shading_node(self, context: ShadingContext, light: LightInput) -> Node:
        """Direct known light on points, towards which rays are drawn."""
        return Node(
            f"shading{context.suffix}",
            self._shade_shared if self.shares_directions else self._shade,
            self.trees_around(context) if self.shares_directions else self._meshes(context),
            context.receivers_node,
            light,
            self.shell_of(light),
            items=functools.partial(receiver_text, context.weak_reference),
            rows=(ExplainRow("transfer", why_idle="rays shade known light at once"),),
        )

    def path_shading_node(self, direct: Node, context: ShadingContext, light: LightInput, materials: Materials) -> Node:
        """Shading of points in known light that bounces along paths, which have no gradient."""
        from warpshadow.pipeline.methods.paths import path_traced

        emitters = self.emitters.samples_node(context) if self.merged_scene.has_beams else None
        trace = functools.partial(path_traced, samples=self._sample_count, progress=self.progress)
        return trace(direct, self._meshes(context), context, light, self.shell_of(light), materials, emitters)

    def emitted_light_node(self, context: ShadingContext, materials: Materials) -> Node:
        """Direct light of emitters on points, by rays to their samples. Differentiable: emission."""
        name = f"light of emitters{context.suffix}"
        return Node(name, self.emitters.traced_light, *self._rays_to_emitters(context, materials))

    def highlights_node(self, context: ShadingContext, materials: Materials, roughness: Node, cameras: Input) -> Node:
        """Direct light of emitters in the lobes of points, by rays to their samples."""
        rays = self._rays_to_emitters(context, materials)
        return Node("highlights", self.emitters.traced_highlights, *rays, roughness, cameras)

    def _rays_to_emitters(self, context: ShadingContext, materials: Materials) -> tuple[Node, Node, Node, Node]:
        """Receivers, samples, their radiance, and the transmittance between."""
        receivers, samples = context.receivers_node, self.emitters.samples_node(context)

        def traced() -> Node:
            name, items = f"rays to emitters{context.suffix}", functools.partial(receiver_text, context.weak_reference)
            trace = self._trace_emitters
            return Node(name, trace, context.vertices, receivers, samples, items=items, has_adjoint=False)

        transmittance = context.cached("rays to emitters", None, traced)
        return receivers, samples, self.emitters.radiance(materials), transmittance

    def _trace_emitters(
        self, positions: wp.array, receivers: Receivers, placed_samples: "PlacedSamples"
    ) -> list[wp.array]:
        """Transmittance to the samples of each emitter, float32 of shape [batch, receiver, sample]."""
        from warpshadow.pipeline.shading.emitted_light import trace_transmittances
        from warpshadow.stages.emitters.samples import SAMPLES

        points, normals, samples = _checked_points(receivers.points), receivers.normals, self.emitters.samples
        trace = functools.partial(trace_transmittances, progress=self.progress)
        rays = max(1, (self.visibility.ray_count if self.shares_directions else self._sample_count) // (4 * SAMPLES))
        meshes = [self.merged_scene.blocker_mesh(positions[instance]) for instance in range(len(positions))]
        pairs = zip(samples.spans(), self.emitters.ray_counts(placed_samples, rays), strict=True)
        return [
            trace(meshes, points, normals, samples, positions, placed_samples, span, rays=counts)
            for span, counts in pairs
        ]

    @functools.cached_property
    def lobes(self) -> "TracedLobes":
        """Visibility in lobes, by rays."""
        return TracedLobes(self)

    def transfer_node(self, context: ShadingContext, shell: Input | None) -> Node:
        """Transfer vectors of points to :attr:`basis`, by rays that are spread evenly."""
        weak_context = context.weak_reference
        node = Node(
            f"transfer{context.suffix}",
            self._transfer,
            self._meshes(context),
            context.receivers_node,
            self.shell if shell is None else shell,
            items=lambda: f"{receiver_text(weak_context)} × {self.basis.size} coefficients",
        )
        if node.requires_grad:
            node.function = _refuse
        return node

    def trees_around(self, context: ShadingContext) -> Node:
        """Node of the trees of all vertices around points."""
        name, vertices = "visibility" if self.shares_directions else "", context.vertices
        items = f"{len(self.merged_scene.body_of_face):,} faces"
        return context.cached_for_bodies("trees", None, lambda: Node(name, self._trees, vertices, items=items))

    def _trees(self, positions: wp.array) -> list[FaceTree]:
        """Hierarchies of the blockers, for packets of rays."""
        merged_scene = self.merged_scene
        faces = merged_scene.faces.numpy()[np.isin(merged_scene.body_of_face, merged_scene.shadow_casters)]
        return [build_face_tree(item, faces, merged_scene.device) for item in positions.numpy()]

    def _meshes(self, context: ShadingContext) -> Node:
        """Node of the meshes that rays from points meet."""

        def meshes() -> Node:
            weak_context = context.weak_reference
            return Node(
                f"visibility{context.suffix}",
                self._blocker_meshes,
                context.vertices,
                detached(context.receivers_node),
                items=lambda: f"{receiver_text(weak_context)} by rays",
                why_idle="" if self.merged_scene.shadow_casters else "no body has blockers",
                caches=False,
                rows=(ExplainRow("static shadows", why_idle="rays treat all receivers alike"),),
            )

        return context.cached("meshes", None, meshes)

    @property
    def _sample_count(self) -> int:
        """Rays of direct light for each receiver."""
        return max(1, self.visibility.ray_count // self.merged_scene.scene.supersampling**2)

    def _blocker_meshes(self, positions: wp.array, receivers: Receivers) -> Meshes:
        count = min(len(receivers.points) if receivers.points.size else 0, len(positions))
        return [self.merged_scene.blocker_mesh(positions[instance]) for instance in range(count)]

    def _shade(
        self, meshes: Meshes, receivers: Receivers, light: KnownLight, shell: wp.array | None = None
    ) -> wp.array:
        points, shells = _checked_points(receivers.points), _shells(receivers, shell)
        samples = sample_map(light.radiance, self._sample_count)
        shading = wp.empty(_batch_shape(points, shells), dtype=wp.vec3, device=points.device)
        instances = _instances(shading, meshes, points, receivers.normals, shells)
        for result, mesh, origins, normals, instance_shell in instances:
            wp.copy(
                result, trace_shading(mesh, origins, normals, samples, shell=instance_shell, progress=self.progress)
            )
        return shading

    def _shade_shared(
        self, trees: list[FaceTree], receivers: Receivers, light: KnownLight, shell: wp.array | None = None
    ) -> wp.array:
        """Shading by rays in directions that all receivers share, or to points of a shell."""
        points, shells = _checked_points(receivers.points), _shells(receivers, shell)
        count = -(-self.visibility.ray_count // PACKET) * PACKET
        shading = wp.empty(_batch_shape(points, shells), dtype=wp.vec3, device=points.device)
        instances = _instances(shading, trees, points, receivers.normals, shells)
        for instance, (result, tree, origins, normals, instance_shell) in enumerate(instances):
            # a ratio image has the same directions with the bodies and without
            share_finder = None
            if not self.merged_scene.scene.catchers:
                share_finder = functools.partial(find_light_shares, tree, origins, normals, shell=instance_shell)
            samples = cut_map(light.radiance, count, share_finder)
            corners = None
            if receivers.fragments.face_ids.ndim == 3:  # of an image
                corners = find_corners(receivers, instance, self.merged_scene.scene.supersampling)
            trace = functools.partial(trace_shared, shell=instance_shell, progress=self.progress)
            wp.copy(result, trace(tree, origins, normals, samples, corners=corners))
        return shading

    def _transfer(self, meshes: Meshes, receivers: Receivers, shell: wp.array | None = None) -> list[wp.array]:
        points, shells = receivers.points, _shells(receivers, shell)
        shape = *_batch_shape(points, shells), self.basis.size
        transfer = wp.empty(shape, dtype=wp.float32, device=points.device)
        functions, count = self.basis.functions, self.visibility.ray_count
        if isinstance(self.basis, CellBasis):
            functions, count = self.basis.balanced_functions, max(count, _RAYS_OF_CELL * self.basis.size)
        trace = functools.partial(trace_transfer, progress=self.progress)
        instances = _instances(transfer, meshes, points, receivers.normals, shells)
        for result, mesh, origins, normals, instance_shell in instances:
            wp.copy(result, trace(mesh, origins, normals, functions, count, shell=instance_shell))
        return [transfer]


class TracedLobes(LobeVisibility):
    """Visibility in lobes by rays, each of its own."""

    sample_count = 64  # each is blocked or not: with 32, reflected edges show as many edges
    sun_sample_count = 16

    def __init__(self, method: RayTraced):
        super().__init__(method.merged_scene, method.light, shares_receivers=method.shares_lobes)
        self._method = method

    def transmittance(self, lobes: LitLobes, directions: Node) -> Node:
        """Transmittance towards the samples of lobes."""
        trees, receivers = self._method.trees_around(lobes.points), lobes.points.receivers_node
        item_text = functools.partial(receiver_text, lobes.points.weak_reference)
        return Node("transmittance of lobes", _trace_lobes, trees, receivers, directions, items=item_text)

    def blocked_radiance(self, lobes: LitLobes, diffuse: Node, openness: Node | None) -> Node:
        """Mean radiance of the blockers of receivers, by their light with bounces and without."""
        points = lobes.points
        direct = self._method.direct_shading_node(lobes.all_points, lobes.light)
        trees = self._method.trees_around(points)
        if openness is None:
            openness = points.cached("openness", None, lambda: Node("", _openness, trees, points.receivers_node))
        return Node("light of blockers", find_blocked_radiance, diffuse, points.select(direct), openness)


def _trace_lobes(trees: list[FaceTree], receivers: Receivers, directions: wp.array) -> wp.array:
    points = _checked_points(receivers.points)
    traced = wp.empty(directions.shape, dtype=wp.float32, device=points.device)
    instances = _instances(traced, trees, points, receivers.normals, directions)
    for result, tree, origins, normals, samples in instances:
        wp.copy(result, trace_lobes(tree, origins, normals, samples))
    return traced


def _openness(trees: list[FaceTree], receivers: Receivers) -> wp.array:
    """Light under an even sky of 1, vec3 of shape [batch, receiver]."""
    points = _checked_points(receivers.points)
    openness = wp.empty(points.shape, dtype=wp.vec3, device=points.device)
    samples = cut_map(np.ones((64, 128, 3), np.float32), _EVEN_RAYS)
    for result, tree, origins, normals in _instances(openness, trees, points, receivers.normals):
        wp.copy(result, trace_shared(tree, origins, normals, samples))
    return openness


def _instances(results: wp.array, *batches: Sequence[Any] | wp.array | np.ndarray) -> Iterator[tuple[Any, ...]]:
    """Results of each instance, unless empty, with its item of each batch; the last item serves the rest."""
    for instance in range(len(results) if results.size else 0):
        yield results[instance], *(instance_of(batch, instance) for batch in batches)


def _checked_points(points: wp.array) -> wp.array:
    """Points, which may require no gradient."""
    if points.requires_grad:
        raise ValueError(
            "geometry, clip_matrices: got arrays that require a gradient, which rays do not have; expected none, or "
            "another method"
        )
    return points


def _batch_shape(points: wp.array, shells: np.ndarray) -> tuple[int, int]:
    """Shape of results, [batch, receiver], where points or shells may be one for all instances."""
    return common_batch({"points": points, "shell": shells}), points.shape[1]


def _shells(receivers: Receivers, shell: wp.array | None) -> np.ndarray:
    """Center and radius of the sphere that sends light to receivers, of each instance, [batch, 4]."""
    if shell is None:
        return FAR[None]
    if shell.requires_grad:
        raise ValueError("shell: got one that requires a gradient, which rays do not have; expected another method")
    check_within(receivers.points, shell)
    shells: np.ndarray = shell.numpy()
    return shells


def _refuse(*_: object) -> None:
    raise ValueError("light: got free light for moving geometry, which rays cannot shade; expected known light")


METHOD = RayTraced
