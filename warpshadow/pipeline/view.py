"""Views: what cameras see of a geometry, wired from the vertices to the image."""

import copy
import functools
import operator

import numpy as np
import warp as wp

from warpshadow.assets.camera import Camera
from warpshadow.device.cuda_graph import is_readable
from warpshadow.pipeline.adaptive import find_squares
from warpshadow.pipeline.lighting import Light, LitPoints, Method, receiver_words
from warpshadow.pipeline.node import Call, Fixed, Node, Source
from warpshadow.pipeline.own_shadows import Blocking
from warpshadow.pipeline.reflectance import Given, Materials, SeenSurfaces
from warpshadow.pipeline.static import Static
from warpshadow.stages import film
from warpshadow.stages.normals import vertex_normals
from warpshadow.stages.photograph import Division, compose, divide_samples, over_nothing
from warpshadow.stages.project import to_clip
from warpshadow.stages.rasterize import Fragments, rasterize
from warpshadow.stages.receivers import Receivers, find_receivers, number_receivers, seen_vertices
from warpshadow.stages.sides import find_sides
from warpshadow.stages.silhouettes.find import Silhouettes, find_silhouettes
from warpshadow.stages.silhouettes.smooth import smooth_silhouettes
from warpshadow.stages.slopes import moving_radiance
from warpshadow.stages.textures.sample import textured_radiance


class View(LitPoints):
    """What cameras see of a geometry: all that an image takes but light and reflectance.

    Args:
        method: How light is blocked.
        materials: What the scene's bodies reflect.
        vertices: Positions of all vertices.
        spheres: Centers and radii of the spheres.
        cameras: Clip matrices.
        static: The static bodies among moving ones; None where any may move.
        blocking: How the bodies block light.
        call: Has what may not be kept of it.
        camera: Has the cameras' size and near plane.
        counts: Number of geometries, and of images.
        stands: As for :class:`LitPoints`.

    Attributes:
        given: Vertices, spheres, cameras, static bodies, and how all block light.
        clip_positions, fragments_node, silhouettes, receivers_node: Nodes of what is seen.
    """

    def __init__(
        self,
        method: Method,
        materials: Materials,
        vertices: Source,
        spheres: Source,
        cameras: Source,
        static: Static | None,
        blocking: Blocking,
        *,
        call: Call,
        camera: Camera,
        counts: tuple[int, int],
        stands: bool = False,
    ):
        self.given = vertices, spheres, cameras, static, blocking
        self._apart = method.apart(blocking)
        self.cameras = cameras
        self._camera, self._across, self._pose_count = camera, method.assembly.scene.supersampling, counts[0]
        self._size = self._across * camera.width, self._across * camera.height
        self._sample_count = counts[1] * self._size[0] * self._size[1]
        normals, receivers = self._wire(method, vertices, spheres, cameras, static)
        super().__init__(method, materials, vertices, spheres, receivers, call, static, normals, blocking, stands)
        self.surfaces = SeenSurfaces(materials, self.fragments_node, self.clip_positions, call, self._samples)
        self._white = receivers, receivers  # a node of shading, and one of white samples in it

    def _wire(
        self, method: Method, vertices: Source, spheres: Source, cameras: Source, static: Static | None
    ) -> tuple[Node, Node]:
        """From the vertices to their normals and to the receivers."""
        assembly, samples, corners = method.assembly, self._samples, self._vertices
        faces, two_sided = assembly.faces, assembly.two_sided_faces
        if static is None or cameras.requires_grad:
            clip = Node("clip positions", to_clip, vertices, cameras, items=corners)
        else:
            kept = static.clip_positions(cameras)
            clip = Node("clip positions", static.with_moving_clip_positions, vertices, cameras, kept, items=corners)
        fragments = Node("rasterization", rasterize, clip, faces, *self._size, items=samples)
        if two_sided.size:
            placed = Fixed(vertices), Fixed(cameras)
            sides = Node("sides", find_sides, fragments, faces, two_sided, *placed, items=samples, has_adjoint=False)
        else:
            sides = Node("sides", _same, fragments, idle="every body is closed: none is seen from behind")
        around = assembly.edges, clip, assembly.face_bodies, assembly.creases
        silhouettes = Node("silhouettes", find_silhouettes, sides, faces, *around, items=samples, has_adjoint=False)
        if static is None:
            normals = Node("normals", vertex_normals, vertices, faces, items=corners)
        else:
            normals = Node("normals", static.with_moving_normals, vertices, static.normals, items=corners)
        # receivers at vertices move with these alone; those of samples move with what a sample sees, too
        seen = sides if method.samples_receive.any() else Fixed(sides)
        words = functools.partial(receiver_words, self)
        given = [vertices, normals, seen, Fixed(silhouettes)]
        if method.is_adaptive.any():
            given.append(Fixed(spheres))
        receivers = Node("receivers", self._receive, *given, items=words)
        self.clip_positions, self.fragments_node, self.silhouettes = clip, sides, silhouettes
        return normals, receivers

    def _receive(
        self,
        positions: wp.array,
        normals: wp.array,
        fragments: Fragments,
        silhouettes: Silhouettes,
        spheres: tuple[wp.array, wp.array] | None = None,
    ) -> Receivers:
        """Receivers at the vertices that are seen, or at all where that cannot be read without waiting."""
        assembly, method, quadtree = self.assembly, self.method, None
        has_backs = fragments.sides is not None
        keeps_vertex, wants_samples = method.can_receive[: 1 + has_backs], method.samples_receive
        is_static = None if self.static is None else self.static.has_vertex
        apart = self._apart
        bodies = None if apart is None else apart[assembly.body_of_vertex]
        if is_readable(assembly.device):
            by_rows = method.is_adaptive & self._has_kept_shadows
            if by_rows.any():
                keeps_vertex = keeps_vertex | by_rows[assembly.body_of_vertex]
                wants_samples = wants_samples & ~by_rows
            keeps_vertex = keeps_vertex & seen_vertices(fragments, silhouettes, keeps_vertex.shape[1])
            numbering = number_receivers(assembly.faces, keeps_vertex, is_static, assembly.vertex_order, bodies)
            if spheres is not None and (is_adaptive := method.is_adaptive & ~by_rows).any():
                seen = positions, normals, fragments, spheres
                quadtree = find_squares(self, *seen, is_adaptive, self._across)
        elif is_static is None:
            numbering = method.numbering(self.blocking, has_backs)
        else:
            numbering = number_receivers(assembly.faces, keeps_vertex, is_static, bodies=bodies)
        bodies = None if apart is None else apart[assembly.body_of_face]
        given = positions, normals, assembly.faces, fragments, numbering, wants_samples[assembly.body_of_face]
        return find_receivers(*given, bodies=bodies, across=self._across, quadtree=quadtree)

    @functools.cached_property
    def _has_kept_shadows(self) -> np.ndarray:
        """Static bodies on which shadows of others are kept at vertices, bool of shape [body]."""
        static, count = self.static, len(self.assembly.scene.bodies)
        found = np.zeros(count, bool)
        if static is not None:
            casting = [body for body in static.bodies if self.assembly.scene.bodies[body].casts_shadow]
            found[[body for body in static.bodies if set(casting) - {body}]] = True
        return found

    def image(self, light: Light | None = None, albedo: Given = None, textures: Given = None) -> Node:
        """From the receivers to the image: linear RGB and coverage, vec4 of shape [batch, height, width]."""
        words, clip, fragments = self._samples, self.clip_positions, self.fragments_node
        materials = self.materials.replaced(albedo, textures)
        lit, reflected = self.shading(light, materials), self.surfaces.reflect(materials)
        if reflected.pyramids.requires_grad and not (lit.requires_grad or clip.requires_grad):
            found = (Node("reflectance", None, idle="found with the radiance"),)
            reflecting = reflected.vertex_albedo, reflected.pyramids, reflected.footprints
            given = fragments, self.assembly.faces, *reflecting, self._white_radiance_of(lit)
            samples = Node("radiance", textured_radiance, *given, items=words, keeps=False, beside=found)
        else:
            samples = self._radiance(lit, reflected.samples)
        averaged = self._averaged(samples, is_moving=clip.requires_grad)
        return averaged

    def in_photograph(
        self,
        photograph: Source | None,
        unshadowed: Source,
        catches: wp.array,
        light: Light | None = None,
        albedo: Given = None,
        textures: Given = None,
    ) -> Node:
        """The image in a photograph of what the catchers are: linear RGB, vec3 of shape [batch, height, width].

        Args:
            photograph: Linear RGB, vec3 of shape [batch, height, width]; None for nothing, where shadows are coverage,
                vec4.
            unshadowed, catches: As for :func:`warpshadow.stages.photograph.divide_samples`.
            light, albedo, textures: As for :meth:`image`.
        """
        materials = self.materials.replaced(albedo, textures)
        lit, reflected = self.shading(light, materials), self.surfaces.reflect(materials)

        def divide(fragments: Fragments, *given: wp.array) -> Division:
            return divide_samples(fragments.face_ids, catches, *given)

        seen = Fixed(self.fragments_node), reflected.samples, unshadowed
        division = Node("ratio", divide, *seen, items=self._samples, keeps=False)
        drawn, inverse, rest = (Node("", operator.itemgetter(part), division, keeps=False) for part in range(3))
        is_moving = self.clip_positions.requires_grad
        films = [self._averaged(self._radiance(lit, each), is_moving=is_moving) for each in (drawn, inverse)]
        films.append(self._averaged(rest))
        if photograph is None:
            return Node("photograph", over_nothing, *films, keeps=False)
        return Node("photograph", compose, photograph, *films, keeps=False)

    def white(self, light: Light | None = None, albedo: Given = None, textures: Given = None) -> Node:
        """What samples receive, and coverage, vec4 of shape [batch, height · across, width · across].

        Albedo and textures matter where light bounces.
        """
        return self._white_radiance_of(self.shading(light, self.materials.replaced(albedo, textures)))

    def white_image(self, lit: Node) -> Node:
        """The image if every surface were white, of light on the receivers; vec4 of shape [batch, height, width]."""
        return self._averaged(self._white_radiance_of(lit))

    def at_receivers_of(self, other: "View") -> "View":
        """The view with the receivers of another of the same cameras, among what blocks light in this one."""

        def exchanged() -> View:
            given = self.vertices, self.spheres, other.receivers_node, self.call, None, self.normals, self.blocking
            view = copy.copy(self)
            LitPoints.__init__(view, self.method, self.materials, *given)
            view._white = view.receivers_node, view.receivers_node
            return view

        return other.kept("in another scene", self, exchanged)

    def _radiance(self, lit: Node, reflected: Node) -> Node:
        """Node of the samples."""
        samples_of = functools.partial(Node, "radiance", items=self._samples, keeps=False)
        if self.clip_positions.requires_grad:
            moving = self.silhouettes, self.clip_positions
            return samples_of(_moving_radiance, self.receivers_node, lit, reflected, *moving)
        return samples_of(_radiance, self.receivers_node, lit, reflected)

    def _averaged(self, samples: Node, *, is_moving: bool = False) -> Node:
        """Node of the pixels of samples, or of samples and edge colors of what moves."""
        samples_of = functools.partial(Node, items=self._samples, keeps=False)
        smooth = _smooth_moving if is_moving else smooth_silhouettes
        smoothed = samples_of("smoothing", smooth, samples, self.silhouettes, self.clip_positions)
        if self._across == 1:
            return Node("averaging", _same, smoothed, idle="a pixel has one sample", keeps=False)
        return samples_of("averaging", film.average, smoothed, self._across)

    def _white_radiance_of(self, lit: Node) -> Node:
        """Node of the samples if every surface were white; kept with the last shading."""
        if self._white[0] is not lit:
            self._white = lit, Node("", _white_radiance, self.receivers_node, lit)
        return self._white[1]

    # ------------------------------------------------------------------------------------------ in words

    @property
    def fragments(self) -> Fragments:
        """What each sample sees."""
        return self.fragments_node.value(self.call)

    def counts(self) -> tuple[str, int, int]:
        """How many receivers may move and how many are static; "up to " where they are not found yet."""
        if self.receivers_node.known(self.call) is not None:
            return super().counts()
        can_receive, static = self.method.can_receive, 0
        if self.static is not None:
            static = int((can_receive & self.static.has_vertex).sum())
        samples = self._sample_count * self.method.samples_receive.any()
        return "up to ", int(self._pose_count * (can_receive.sum() - static) + samples), static

    def _samples(self) -> str:
        return f"{self._sample_count:,} samples"

    def _vertices(self) -> str:
        count, static = int(self.assembly.first_vertex[-1]), 0
        if self.static is not None:
            static = int(self.static.has_vertex.sum())
        return f"{count - static:,} vertices, {static:,} kept" if static else f"{count:,} vertices"

    def preview(self) -> "View":
        """The view, to be asked what it would compute: what it is given it does not remember."""
        view = copy.copy(self)
        view.surfaces = copy.copy(self.surfaces)
        return view

    def emptiness(self) -> str | None:
        """Say of the first image that shows nothing of the scene why; None if there is none."""
        face_ids = self.fragments.face_ids.numpy()
        empty = np.flatnonzero(face_ids.max(axis=(1, 2), initial=-1) < 0)
        if not len(empty):
            return None
        number, near = int(empty[0]), self._camera.near
        depths = self.clip_positions.value(self.call).numpy()
        depths = depths[min(number, len(depths) - 1), :, 3]
        nearest, farthest = float(depths.min()), float(depths.max())
        if farthest <= 0:
            reason = f"all of it is behind the camera, by {-farthest:g} or more"
        elif farthest <= near:
            reason = f"near = {near:g} cuts all of it away, which is {farthest:g} or less in front of the camera"
        else:
            reason = f"it is outside of the frame, at depths from {nearest:g} to {farthest:g}"
        which = f"image {number} of {len(face_ids)}" if len(face_ids) > 1 else "the image"
        remedy = 'Camera.framing(scene), or framing = "auto" in a scene file, shows all of it'
        return f"camera: {which} shows nothing of the scene: {reason}; {remedy}"


def _same(value: object) -> object:
    return value


def _radiance(receivers: Receivers, lit: wp.array, reflected: wp.array) -> wp.array:
    return film.sample_radiance(receivers.fragments, receivers.faces, lit, reflected)


def _moving_radiance(
    receivers: Receivers, lit: wp.array, reflected: wp.array, silhouettes: Silhouettes, clip_positions: wp.array
) -> tuple[wp.array, wp.array]:
    """Samples, and the colors at edges."""
    seen = receivers.fragments, receivers.faces, lit, reflected
    return moving_radiance(*seen, silhouettes, clip_positions, receivers.of_vertices)


def _smooth_moving(radiance: tuple[wp.array, wp.array], silhouettes: Silhouettes, clip_positions: wp.array) -> wp.array:
    samples, edge_colors = radiance
    return smooth_silhouettes(samples, silhouettes, clip_positions, edge_colors)


def _white_radiance(receivers: Receivers, lit: wp.array) -> wp.array:
    _, height, width = receivers.fragments.face_ids.shape
    white = wp.full((1, height, width), wp.vec3(1.0), dtype=wp.vec3, device=lit.device)
    return film.sample_radiance(receivers.fragments, receivers.faces, lit, white)
