"""Free shapes: other vertices or spheres of a body at rest, and the graph by which its vertices follow its spheres."""

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.batch import common_batch
from warpshadow.pipeline.bodies.geometry import Geometry, as_geometry, splice
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.scene.blockers import free_shape_remark
from warpshadow.scene.scene import BodyLike
from warpshadow.stages.geometry.bound_spheres import SphereBinding
from warpshadow.stages.geometry.deform import DeformationGraph


class FreeShapes:
    """Changes the shapes of bodies at rest; it binds the spheres of each to its vertices once.

    Args:
        merged_scene: The bodies.
    """

    def __init__(self, merged_scene: MergedScene):
        self._merged_scene = merged_scene
        self._bindings: dict[int, SphereBinding] = {}  # by body
        self._warned_of: set[int] = set()

    def deformation_graph(self, body: BodyLike, *, count: int = 4) -> DeformationGraph:
        """Bind the vertices of a body to its spheres, which are the nodes (the paper, section 4).

        Args:
            body: The body, its number or name.
            count: Nodes that carry a vertex.
        Raises:
            ValueError: for a body with too few spheres.
        """
        merged_scene = self._merged_scene
        number = merged_scene.scene.body_number(body)
        points = merged_scene.scene.bodies[number].mesh.positions
        return DeformationGraph.bind(
            points, merged_scene.body_spheres[number].centers, count=count, device=merged_scene.device
        )

    def deformed(
        self,
        body: BodyLike,
        positions: wp.array | None = None,
        centers: wp.array | None = None,
        radii: wp.array | None = None,
        *,
        rest: Geometry[wp.array] | None = None,
    ) -> Geometry[wp.array]:
        """Exchange the shape of one body at rest.

        Args:
            body: The body, its number or name.
            positions: Its vertices in its own space, vec3 of shape [batch, vertex].
            centers: Its spheres' centers, vec3 of shape [batch, sphere].
            radii: Its spheres' radii, float32 of shape [batch, sphere]. An item None stays as it is in ``rest``; but
                its spheres follow its vertices, both centers and radii, unless ``centers`` are given
                (:mod:`warpshadow.stages.geometry.bound_spheres`).
            rest: All bodies at rest, by default as their meshes are; batches of 1 serve every instance.
        Returns:
            All bodies at rest, for :meth:`.MergedScene.placed`, in arrays of their own.
        Raises:
            ValueError: for other vertices of a flat body where light bounces by spheres, for which it stays in its
                plane.
        Differentiable: positions, centers, radii, rest.
        """
        merged_scene = self._merged_scene
        number = merged_scene.scene.body_number(body)
        if positions is not None and merged_scene.is_flat[number] and merged_scene.scene.bounces:
            self._refuse_other_vertices(number)
        if positions is not None and number not in self._warned_of:
            self._warned_of.add(number)
            if remark := free_shape_remark(merged_scene.scene, number):
                check.warn(remark)
        rest = merged_scene.rest if rest is None else as_geometry("rest", rest)
        starts = merged_scene.first_vertex, merged_scene.first_sphere
        first_vertex, first_sphere = (start[number : number + 2] for start in starts)
        if positions is not None and centers is None and len(merged_scene.body_spheres[number]):
            vertices, spheres = slice(*first_vertex.tolist()), slice(*first_sphere.tolist())
            check.shape("positions", positions.shape, ("batch", vertices.stop - vertices.start))
            at_rest = rest.positions[:, vertices], rest.centers[:, spheres], rest.radii[:, spheres]
            centers, moved_radii = self._sphere_binding(number).moved(positions, *at_rest)
            radii = moved_radii if radii is None else radii
        return Geometry(
            _spliced("positions", rest.positions, positions, first_vertex),
            _spliced("centers", rest.centers, centers, first_sphere),
            _spliced("radii", rest.radii, radii, first_sphere),
            moving=None if rest.moving is None else (*rest.moving, number),
            rotations=None if rest.rotations is None else splice(rest.rotations, [], lambda *_: rest.rotations),
            deformed=(*rest.deformed, number),
        )

    def _refuse_other_vertices(self, number: int) -> None:
        """Raise ValueError for other vertices of a flat body where light bounces by spheres."""
        scene = self._merged_scene.scene
        if scene.visibility.traits.has_spheres:
            raise ValueError(
                f"positions: got some for body {number} ({scene.bodies[number].name!r}), which is flat; "
                f"expected None where light bounces (scene.bounces is {scene.bounces}), since a flat body "
                'reflects and blocks as a part of a plane; set bounces = 0, or take method "ray-traced"'
            )

    def _sphere_binding(self, number: int) -> SphereBinding:
        """Bind a body's spheres to the vertices of its faces."""
        merged_scene = self._merged_scene
        if number not in self._bindings:
            mesh, spheres = merged_scene.scene.bodies[number].mesh, merged_scene.body_spheres[number]
            arguments = mesh.positions, np.unique(mesh.faces), spheres.centers, spheres.radii
            self._bindings[number] = SphereBinding.bind(*arguments, device=merged_scene.device)
        return self._bindings[number]


def _spliced(name: str, whole: wp.array, part: wp.array | None, place: np.ndarray) -> wp.array:
    """Put a part [batch, item] in its place, from one item up to another, in the whole [batch, item]."""
    if part is None:
        return splice(whole, [], lambda *_: whole)
    first, end = place.tolist()
    check.shape(name, part.shape, ("batch", end - first))
    common_batch({"rest": whole, name: part})
    return splice(whole, [(first, end)], lambda *_: part)
