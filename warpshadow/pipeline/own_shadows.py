"""Own shadows: which bodies have their shadows on themselves from rays, and what is kept of them."""

import numpy as np
import warp as wp

from warpshadow.device.batch import cut
from warpshadow.pipeline.assembly import Assembly
from warpshadow.stages.normals import vertex_normals
from warpshadow.stages.own_shadows.sites import Places, Sites, SiteTable, cuts_of, find_sites
from warpshadow.stages.rasterize import Fragments
from warpshadow.stages.receivers import Receivers, Span


class OwnShadows:
    """What rays found of the bodies' shadows on themselves, each in its own frame.

    Args:
        assembly: The bodies.
        samples_receive: Bodies on which samples are receivers, bool of shape [body]: they have sites within faces.

    Attributes:
        is_traced: Bodies whose own spheres do not block them, bool of shape [body].
    """

    def __init__(self, assembly: Assembly, samples_receive: np.ndarray):
        self._assembly, self._samples_receive = assembly, samples_receive
        self.is_traced = np.zeros(len(samples_receive), bool)
        self._tables: dict[int, SiteTable] = {}

    def sites(self, body: int) -> Sites:
        """The sites of a body in its own space."""
        mesh = self._assembly.scene.bodies[body].mesh
        faces = mesh.surface.faces
        points = wp.array(mesh.positions[None], dtype=wp.vec3, device=self._assembly.device)
        normals = vertex_normals(points, wp.array(faces, dtype=wp.vec3i, device=points.device)).numpy()[0]
        return find_sites(mesh.positions, normals, faces, cuts_of(len(faces)) if self._samples_receive[body] else 1)

    def places(self, receivers: Receivers, span: Span) -> Places:
        """Where receivers of a body lie among its sites. Differentiable: barycentrics of samples."""
        assert receivers.vertices is not None
        table, first, end = self._table(span.body), span.first, span.end
        vertex_count = receivers.vertices.size
        if first < vertex_count:
            return table.of_vertices(receivers.vertices[first:end])
        seen, first, end = receivers.seen, first - vertex_count, end - vertex_count
        assert seen is not None
        return table.of_samples(Fragments(cut(seen.face_ids, first, end), cut(seen.barycentrics, first, end)))

    def _table(self, body: int) -> SiteTable:
        if body not in self._tables:
            assembly, sites = self._assembly, self.sites(body)
            self._tables[body] = SiteTable(
                int(assembly.first_vertex[body]),
                int(assembly.first_vertex[-1]),
                int(assembly.first_face[body]),
                int(assembly.first_face[-1]),
                len(sites.positions),
                wp.array(sites.corners, dtype=wp.int32, device=assembly.device),
                sites.cuts,
            )
        return self._tables[body]
