"""The ray-traced method: rays past the meshes themselves. It has no gradient to geometry."""

import functools
from typing import TYPE_CHECKING

import warp as wp

from warpshadow.assets.basis import Basis, HarmonicBasis
from warpshadow.pipeline.assembly import Assembly
from warpshadow.pipeline.lighting import KnownLight, LitPoints, Method, map_of, receiver_words
from warpshadow.pipeline.node import Fixed, Node, Source
from warpshadow.pipeline.reflectance import Materials
from warpshadow.stages.light_samples import sample_map
from warpshadow.stages.ray_tracing import trace_shading, trace_transfer
from warpshadow.stages.receivers import Receivers

if TYPE_CHECKING:  # it is imported where light bounces
    from warpshadow.pipeline.bounces.kept import KeptBounces

Meshes = list[wp.Mesh | None]
"""What blocks the light of each instance of receivers; None for nothing."""


class Rays(Method):
    """Visibility of the meshes."""

    lights_samples = True

    def __init__(self, assembly: Assembly, basis: Basis | None, *, progress: bool = False):
        super().__init__(assembly, HarmonicBasis(assembly.scene.visibility.order), basis, progress=progress)

    def shading(self, points: LitPoints, light: Source, materials: Materials) -> Node:
        """Shading of points in known light, towards which rays are drawn.

        By what the scene's bodies reflect, light bounces along paths, without a gradient; by reflectance that a call
        gives, it bounces between patches, whose form factors rays find once.
        """
        meshes = self._meshes(points)

        def shaded() -> Node:
            return Node(
                "shading",
                self._shade,
                meshes,
                points.receivers_node,
                light,
                items=lambda: receiver_words(points),
                beside=(Node("transfer", None, idle="rays shade known light at once"),),
            )

        if not self.assembly.scene.bounces:
            return shaded()
        direct = points.kept("direct", light, shaded)
        if materials is points.materials:
            from warpshadow.pipeline.bounces.paths import path_traced

            given = direct, meshes, points, light, materials
            return path_traced(*given, samples=self._sample_count, progress=self.progress)
        sources = self._bounces.sources(points, materials)

        def shaded_sources() -> Node:
            return Node("", self._shade, self._meshes_for(points, sources), sources, light)

        at_sources = points.kept("direct at sources", (light, sources), shaded_sources)
        return self._bounces.in_known_light(direct, at_sources, points, materials)

    def free_shading(self, points: LitPoints, light: Source, materials: Materials) -> Node:
        """Shading of points in free light."""
        direct = super().free_shading(points, light, materials)
        if not self.assembly.scene.bounces:
            return direct
        sources = self._bounces.sources(points, materials)

        def transfers() -> Node:
            return Node("", self._transfer, self._meshes_for(points, sources), sources)

        at_sources = points.kept("transfer of sources", sources, transfers)
        return self._bounces.in_free_light(direct, at_sources, light, points, materials)

    @functools.cached_property
    def _bounces(self) -> "KeptBounces":
        from warpshadow.pipeline.bounces.kept import KeptBounces
        from warpshadow.pipeline.bounces.patches import ScenePatches

        given = ScenePatches(self.assembly), self.assembly.scene.bounces
        return KeptBounces(*given, progress=self.progress)

    def transfers(self, points: LitPoints) -> Node:
        """Transfer vectors of points to :attr:`basis`, by rays that are spread evenly."""
        node = Node(
            "transfer",
            self._transfer,
            self._meshes(points),
            points.receivers_node,
            items=lambda: f"{receiver_words(points)} × {self.basis.size} coefficients",
        )
        if node.requires_grad:
            node.function = _refuse
        return node

    def _meshes(self, points: LitPoints) -> Node:
        """Node of the meshes that rays meet."""
        alike = "rays treat all receivers alike"
        return Node(
            "visibility",
            self._casting_meshes,
            points.vertices,
            Fixed(points.receivers_node),
            items=lambda: f"{receiver_words(points)} by rays",
            idle="" if self.assembly.casting else "no body has blockers",
            keeps=False,
            beside=(Node("static shadows", None, idle=alike),),
        )

    def _meshes_for(self, points: LitPoints, receivers: Node) -> Node:
        """Node of the meshes that rays of other receivers among the same bodies meet."""
        return Node("", self._casting_meshes, points.vertices, Fixed(receivers), keeps=False)

    @property
    def _sample_count(self) -> int:
        """Rays of direct light for each receiver."""
        return max(1, self.visibility.samples // self.assembly.scene.supersampling**2)

    def _casting_meshes(self, positions: wp.array, receivers: Receivers) -> Meshes:
        points = receivers.points
        count = min(len(points) if points.size else 0, len(positions))
        meshes = [self.assembly.casting_mesh(positions[instance]) for instance in range(count)]
        return [*meshes, *meshes[-1:] * (len(points) - count)]

    def _shade(self, meshes: Meshes, receivers: Receivers, light: KnownLight) -> wp.array:
        points, normals = receivers.points, receivers.normals
        if points.requires_grad:
            raise ValueError(
                "geometry: got arrays that require a gradient, which rays do not have; expected none, or another method"
            )
        samples = sample_map(map_of(light), self._sample_count)
        traced = wp.empty(points.shape, dtype=wp.vec3, device=points.device)
        for instance, mesh in enumerate(meshes):
            lit = trace_shading(mesh, points[instance], normals[instance], samples, progress=self.progress)
            wp.copy(traced[instance], lit)
        return traced

    def _transfer(self, meshes: Meshes, receivers: Receivers) -> list[wp.array]:
        points, normals = receivers.points, receivers.normals
        transfer = wp.empty((*points.shape, self.basis.size), dtype=wp.float32, device=points.device)
        for instance, mesh in enumerate(meshes):
            traced = trace_transfer(
                mesh,
                points[instance],
                normals[instance],
                self.basis.functions,
                self.visibility.samples,
                progress=self.progress,
            )
            wp.copy(transfer[instance], traced)
        return [transfer]


def _refuse(*_: object) -> None:
    raise ValueError("light: got free light for moving geometry, which rays cannot shade; expected known light")
