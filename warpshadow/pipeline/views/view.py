"""Views: a geometry seen by cameras, wired from the vertices to the image."""

import functools
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import warp as wp

from warpshadow.assets.camera import Camera
from warpshadow.device.launch import without_gradient
from warpshadow.pipeline.bodies.blockers import BlockerKinds
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.bodies.reflectance import Materials, SampleReflectance
from warpshadow.pipeline.node import Call, ExplainRow, Input, Node, detached, field_of, identity
from warpshadow.pipeline.receivers.scene_receivers import SceneReceivers
from warpshadow.pipeline.receivers.shading_context import ReceiverCount, ShadingContext, receiver_text
from warpshadow.pipeline.shading.light_input import LightInput
from warpshadow.pipeline.transport import LightTransport
from warpshadow.pipeline.views.receiver_finder import ReceiverFinder
from warpshadow.stages.geometry.normals import vertex_normals
from warpshadow.stages.image.film import average, sample_radiance, sum_radiance
from warpshadow.stages.image.outlines import detach_near_outlines, find_outline_samples
from warpshadow.stages.image.slopes import moving_radiance
from warpshadow.stages.raster.interpolation import interpolate
from warpshadow.stages.raster.project import to_clip
from warpshadow.stages.raster.rasterization import Fragments, rasterize
from warpshadow.stages.raster.sides import find_sides
from warpshadow.stages.receivers.receivers import Receivers
from warpshadow.stages.silhouettes.silhouettes import Silhouettes, find_silhouettes
from warpshadow.stages.silhouettes.smooth import smooth_silhouettes
from warpshadow.stages.textures.footprint import Footprints
from warpshadow.stages.textures.sample import sample_albedo, textured_radiance
from warpshadow.stages.textures.seen import seen_texels

if TYPE_CHECKING:
    from warpshadow.pipeline.receivers.static import StaticBodies
    from warpshadow.stages.image.photograph import RatioImage


class ViewDependencies(NamedTuple):
    """All that a view's receivers depend on: it is found again while these are the same."""

    vertices: Input  # positions of all vertices
    spheres: Input  # centers and radii of the spheres
    cameras: Input  # clip matrices
    static_bodies: "StaticBodies | None"
    blocker_kinds: BlockerKinds


class View(ShadingContext):
    """A geometry seen by cameras: all inputs of an image except light and given reflectance.

    Args:
        transport: Light on receivers, by a method of visibility.
        scene_receivers: Where bodies have receivers.
        materials: Reflectance of the scene's bodies.
        dependencies: Bodies and cameras.
        call, is_scene_view: As for :class:`ShadingContext`.
        camera: Has the cameras' size and near plane.
        counts: Number of geometries, and of images.
    Attributes:
        clip_positions, fragments_node, silhouettes, receivers_node: Nodes of the visible surfaces.
    """

    def __init__(
        self,
        transport: LightTransport,
        scene_receivers: SceneReceivers,
        materials: Materials,
        dependencies: ViewDependencies,
        *,
        call: Call,
        camera: Camera,
        counts: tuple[int, int],
        is_scene_view: bool = False,
    ):
        self.dependencies, self.cameras = dependencies, dependencies.cameras
        self.transport, self.method, self._scene_receivers = transport, transport.method, scene_receivers
        merged_scene = self.method.merged_scene
        self._camera, self._supersampling, self._pose_count = camera, merged_scene.scene.supersampling, counts[0]
        self._size = self._supersampling * camera.width, self._supersampling * camera.height
        self._sample_count = counts[1] * self._size[0] * self._size[1]
        self._sample_text = f"{self._sample_count:,} samples"
        normals, receivers = self._make_nodes(merged_scene, dependencies)
        super().__init__(
            merged_scene,
            materials,
            dependencies.vertices,
            dependencies.spheres,
            receivers,
            call,
            static_bodies=dependencies.static_bodies,
            normals=normals,
            blocker_kinds=dependencies.blocker_kinds,
            is_scene_view=is_scene_view,
        )

    def _make_nodes(self, merged_scene: MergedScene, dependencies: ViewDependencies) -> tuple[Node, Node]:
        """From the vertices to their normals and to the receivers."""
        vertices, spheres, cameras, static_bodies, blocker_kinds = dependencies
        samples, width, height = self._sample_text, *self._size
        corners = functools.partial(View._vertices, self.weak_reference)
        faces, two_sided = merged_scene.faces, merged_scene.two_sided_faces
        if static_bodies is None or cameras.requires_grad:
            clip = Node("clip positions", to_clip, vertices, cameras, items=corners)
        else:
            cached = static_bodies.clip_positions(cameras)
            clip = Node(
                "clip positions", static_bodies.with_moving_clip_positions, vertices, cameras, cached, items=corners
            )
        fragments = Node("rasterization", rasterize, clip, faces, width, height, items=samples)
        if two_sided.size:
            side_inputs = fragments, faces, two_sided, detached(vertices), detached(cameras)
            sides = Node("sides", find_sides, *side_inputs, items=samples, has_adjoint=False)
        else:
            sides = Node("sides", identity, fragments, why_idle="every body is closed: none is seen from behind")
        edge_inputs = merged_scene.face_neighbors, clip, merged_scene.face_bodies, merged_scene.creases
        silhouettes = Node(
            "silhouettes", find_silhouettes, sides, faces, *edge_inputs, items=samples, has_adjoint=False
        )
        if static_bodies is None:
            normals = Node("normals", vertex_normals, vertices, merged_scene.one_rings, items=corners)
        else:
            normals = Node("normals", static_bodies.with_moving_normals, vertices, static_bodies.normals, items=corners)
        # gradients of receivers: at vertices to the vertices alone, at samples to the fragments, too
        receiver_fragments = sides if self._scene_receivers.at_samples(blocker_kinds).any() else detached(sides)
        item_text = functools.partial(receiver_text, self.weak_reference)
        inputs = [vertices, normals, receiver_fragments, detached(silhouettes), detached(clip)]
        if self._scene_receivers.is_adaptive.any():
            inputs.append(detached(spheres))
        finder = ReceiverFinder(self.method, self._scene_receivers, blocker_kinds, static_bodies, self._supersampling)
        receivers = Node("receivers", finder.find, *inputs, items=item_text)
        self.clip_positions, self.fragments_node, self.silhouettes = clip, sides, silhouettes
        return normals, receivers

    def shading(self, light: LightInput, materials: Materials | None = None) -> Node:
        """Light on the receivers: :meth:`.LightTransport.shading`."""
        return self.transport.shading(self, light, materials)

    @property
    def transfers(self) -> Node:
        """Transfer vectors of the receivers: :meth:`.Method.cached_transfer_node`."""
        return self.method.cached_transfer_node(self)

    def image(self, light: LightInput, materials: Materials) -> Node:
        """From the receivers to the image: linear RGB and coverage, vec4 of shape [batch, height, width]."""
        item_text, clip, fragments = self._sample_text, self.clip_positions, self.fragments_node
        shading, reflectance = self.shading(light, materials), self._moving_reflectance(materials)
        shines = materials.roughness or materials.emission
        if not shines and reflectance.pyramids.requires_grad and not (shading.requires_grad or clip.requires_grad):
            replaced_rows = (ExplainRow("reflectance", why_idle="found with the radiance"),)
            samples = Node(
                "radiance",
                textured_radiance,
                fragments,
                self.merged_scene.faces,
                reflectance.vertex_albedo,
                reflectance.pyramids,
                reflectance.footprints,
                self._white_radiance_of(shading),
                items=item_text,
                caches=False,
                rows=replaced_rows,
            )
        else:
            samples = self._reflected_and_emitted(shading, light, materials, reflectance.samples)
        return self._averaged(samples, is_moving=self._is_moving)

    def reflectance(self, materials: Materials) -> SampleReflectance:
        """Nodes of the samples' reflectance; the scene's own are cached."""
        return self._reflectance_of(materials, self.fragments_node)

    def _moving_reflectance(self, materials: Materials) -> SampleReflectance:
        """Nodes of the reflectance that :meth:`_radiance` takes, whose patterns move by mean slopes near outlines."""
        return self._reflectance_of(materials, self._fragments_for_color_motion(materials)[0])

    def _reflectance_of(self, materials: Materials, fragments: Node) -> SampleReflectance:
        make_nodes = functools.partial(self._find_reflectance, materials, fragments)
        return self.cached("reflectance", fragments, make_nodes) if materials is self.materials else make_nodes()

    def _fragments_for_color_motion(self, materials: Materials) -> tuple[Node, Node | None]:
        """Nodes of the fragments by which colors move, and of the samples whose colors have mean slopes instead.

        None have them, and the latter is None, where nothing moves or each body has one color, which moves by neither.
        """
        if not self._is_moving:
            return self.fragments_node, None
        if not materials.have_patterns:
            make_node = functools.partial(Node, "", _detach_fragments, detached(self.fragments_node))
            return self.cached("detached fragments", None, make_node), None

        def make_nodes() -> tuple[Node, Node]:
            silhouettes, clip = detached(self.silhouettes), detached(self.clip_positions)
            is_near_outline = Node("", find_outline_samples, silhouettes, clip)
            return Node("", detach_near_outlines, self.fragments_node, is_near_outline), is_near_outline

        return self.cached("mean slopes", None, make_nodes)

    def _find_reflectance(self, materials: Materials, fragments: Node) -> SampleReflectance:
        textures = materials.textures_of["textures"]
        if not textures.images:
            return materials.untextured_reflectance(fragments, self._sample_text)
        pyramids = textures.pyramids
        if materials.textures is not self.materials.textures:
            pyramids = textures.pyramids_to(functools.partial(self.coarsest_level, textures.sizes))
        make_nodes = functools.partial(textures.footprints, fragments, self.clip_positions, pyramids, self._sample_text)
        footprints = self.cached("footprints", (textures.sizes, fragments), make_nodes)
        return materials.reflectance(fragments, pyramids, footprints, self._sample_text)

    def coarsest_level(self, sizes: tuple) -> int | None:
        """Coarsest level that cached footprints in textures of some sizes take; on a GPU it waits for that, once."""
        known, footprints = self._cached.get("footprints", ((None, None), None))
        if known[0] != sizes or not footprints.is_cached:
            return None
        level = self.cached("coarsest", footprints, lambda: Node("", Footprints.coarsest_level, footprints))
        return None if self.merged_scene.device.is_capturing and not level.is_cached else level.value(self.call)

    def seen_texels(self, number: int) -> np.ndarray:
        """Weight of each texel of a body's texture in the samples, float32 of shape [height, width]."""
        has_texture = [size is not None for size in self.materials.textures_of["textures"].sizes]
        if not has_texture[number]:
            raise ValueError(f"body: got {number}, a body without a texture, expected one that has one")
        reflectance = self.reflectance(self.materials)
        textures, footprints = (node.value(self.call) for node in (reflectance.pyramids, reflectance.footprints))
        return seen_texels(textures, footprints)[sum(has_texture[:number])].sum(axis=0)

    def _reflected_and_emitted(self, shading: Node, light: LightInput, materials: Materials, reflectance: Node) -> Node:
        """Node of the samples, of bodies that may shine and emit."""
        if materials.roughness:
            reflected = self._glossy(shading, light, materials, reflectance)
        else:
            reflected = self._radiance(shading, reflectance, materials)
        if not materials.emission:
            return reflected
        emission = self._emission(materials, self._fragments_for_color_motion(materials)[0])
        emitted = self._radiance(Node("", _white_shading, self.receivers_node), emission, materials)
        return self._sum_of(reflected, emitted)

    def _emission(self, materials: Materials, fragments: Node) -> Node:
        """Node of the radiance that the samples emit, vec3 of shape [batch, height, width]."""
        textures = materials.textures_of["emission"]
        faces, of_vertices, pyramids = self.merged_scene.faces, materials.of_vertices("emission"), textures.pyramids
        if not textures.images:
            return self._dimmed_by_beams(Node("emission", interpolate, fragments, faces, of_vertices))
        make_nodes = functools.partial(textures.footprints, fragments, self.clip_positions, pyramids, "")
        footprints = self.cached("footprints in emission", (textures.sizes, fragments), make_nodes)
        emission = Node("emission", sample_albedo, fragments, faces, of_vertices, pyramids, footprints)
        return self._dimmed_by_beams(emission)

    def _dimmed_by_beams(self, emission: Node) -> Node:
        """Node of the part of emission that goes towards the cameras; itself where no emitter has a beam."""
        if not self.merged_scene.has_beams:
            return emission
        show, samples = self.method.emitters.emission_towards_cameras, self.method.emitters.samples_node(self)
        return Node("beams", show, emission, self.fragments_node, self.vertices, self.cameras, samples)

    def _sum_of(self, first: Node, second: Node) -> Node:
        """Node of the samples, of light of two kinds."""
        add = _sum_moving if self._is_moving else sum_radiance
        return Node("radiance", add, first, second, caches=False)

    def _glossy(self, shading: Node, light: LightInput, materials: Materials, reflectance: Node) -> Node:
        """Node of the samples where bodies shine: of light in the surface's color, and of light that has its own."""
        from warpshadow.pipeline.shading.gloss import mix_gloss
        from warpshadow.pipeline.shading.glossy_points import GlossyPoints
        from warpshadow.pipeline.shading.lobe_light import LitLobes

        make_points = functools.partial(GlossyPoints, self, self.cameras, self.fragments_node, self.clip_positions)
        points = self.cached("gloss", None, make_points)
        lobes = LitLobes(points, light, self)
        blocked = self.transport.blocked_radiance(lobes, materials)
        radiosity = self.transport.radiosity(self, light, materials)
        colored, white = mix_gloss(self.method, lobes, shading, materials, blocked, radiosity)
        reflected = self._radiance(colored, reflectance, materials)
        return self._sum_of(reflected, self._radiance(white, self._white_reflectance))

    @property
    def _is_moving(self) -> bool:
        return self.clip_positions.requires_grad

    @property
    def _white_reflectance(self) -> wp.array:
        """Reflectance of the samples if every surface were white, vec3 of shape [1, height, width]."""
        width, height = self._size
        return wp.full((1, height, width), wp.vec3(1.0), dtype=wp.vec3, device=self.merged_scene.device)

    def in_photograph(
        self,
        photograph: Input | None,
        unshadowed: Input,
        face_is_catcher: wp.array,
        light: LightInput,
        materials: Materials,
    ) -> Node:
        """The image in a photograph that the catchers model: linear RGB, vec3 of shape [batch, height, width].

        Args:
            photograph: Linear RGB, vec3 of shape [batch, height, width]; None for nothing, where shadows are coverage,
                vec4.
            unshadowed, face_is_catcher: ``catcher_light`` and ``is_catcher`` of
                :func:`warpshadow.stages.image.photograph.find_ratio_image`.
            light, materials: As for :meth:`image`.
        """
        from warpshadow.stages.image.photograph import compose, composite_alone, find_ratio_image

        shading, reflectance = self.shading(light, materials), self._moving_reflectance(materials)

        def divide(fragments: Fragments, samples: wp.array, catcher_light: wp.array) -> "RatioImage":
            return find_ratio_image(fragments.face_ids, face_is_catcher, samples, catcher_light)

        fragments = detached(self.fragments_node)
        ratio = Node("ratio", divide, fragments, reflectance.samples, unshadowed, items=self._sample_text, caches=False)
        body_light, inverse_light, base_factor = (
            field_of(ratio, name, caches=False) for name in ("body_light", "inverse_light", "base_factor")
        )
        surfaces = (
            self._reflected_and_emitted(shading, light, materials, body_light),
            self._radiance(shading, inverse_light),
        )
        body_film, relit_film = (self._averaged(samples, is_moving=self._is_moving) for samples in surfaces)
        base_film = self._averaged(base_factor)
        if photograph is None:
            return Node("photograph", composite_alone, body_film, relit_film, base_film, caches=False)
        return Node("photograph", compose, photograph, body_film, relit_film, base_film, caches=False)

    def white_samples(self, light: LightInput, materials: Materials) -> Node:
        """Light received by the samples, and coverage, vec4 of shape [batch, sample row, sample column].

        Materials matter where light bounces.
        """
        return self._white_radiance_of(self.shading(light, materials))

    def white_image(self, shading: Node) -> Node:
        """The image if every surface were white, of light on the receivers; vec4 of shape [batch, height, width]."""
        return self._averaged(self._white_radiance_of(shading))

    def at_receivers_of(self, other: "View") -> "View":
        """The view with the receivers of another view by the same cameras, among this view's blockers."""
        return other.cached("in another scene", self, lambda: self.with_receivers(other.receivers_node))

    def _radiance(self, shading: Node, reflectance: Node, materials: Materials | None = None) -> Node:
        """Node of the samples; given materials, the reflectance belongs to surfaces, with which it moves."""
        make_node = functools.partial(Node, "radiance", items=self._sample_text, caches=False)
        if self._is_moving:
            is_near_outline = None if materials is None else self._fragments_for_color_motion(materials)[1]
            moving = self.silhouettes, self.clip_positions, is_near_outline
            return make_node(_moving_radiance, self.receivers_node, shading, reflectance, *moving)
        return make_node(_radiance, self.receivers_node, shading, reflectance)

    def _averaged(self, samples: Node, *, is_moving: bool = False) -> Node:
        """Node of the pixels, from samples, or from samples and edge colors of moving surfaces."""
        make_node = functools.partial(Node, items=self._sample_text, caches=False)
        smooth = _smooth_moving if is_moving else smooth_silhouettes
        smoothed = make_node("smoothing", smooth, samples, self.silhouettes, self.clip_positions)
        if self._supersampling == 1:
            return Node("averaging", identity, smoothed, why_idle="a pixel has one sample", caches=False)
        return make_node("averaging", average, smoothed, self._supersampling)

    def _white_radiance_of(self, shading: Node) -> Node:
        """Node of the samples if every surface were white; cached with the last shading."""
        return self.cached("white samples", shading, lambda: Node("", _white_radiance, self.receivers_node, shading))

    # ------------------------------------------------------------------------------------------ in words

    @property
    def fragments(self) -> Fragments:
        """Fragment of each sample."""
        return self.fragments_node.value(self.call)

    def counts(self) -> ReceiverCount:
        """How many receivers may move and how many are static; at most so many where they are not found yet."""
        if self.receivers_node.value_if_known(self.call) is not None:
            return super().counts()
        at_vertices, static = self._scene_receivers.at_vertices(self.blocker_kinds), 0
        if self.static_bodies is not None:
            static = int((at_vertices & self.static_bodies.has_vertex).sum())
        samples = self._sample_count * self._scene_receivers.at_samples(self.blocker_kinds).any()
        return ReceiverCount(int(self._pose_count * (at_vertices.sum() - static) + samples), static, is_bound=True)

    def _vertices(self) -> str:
        count, static = int(self.merged_scene.first_vertex[-1]), 0
        if self.static_bodies is not None:
            static = int(self.static_bodies.has_vertex.sum())
        return f"{count - static:,} vertices, {static:,} cached" if static else f"{count:,} vertices"

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
        image_text = f"image {number} of {len(face_ids)}" if len(face_ids) > 1 else "the image"
        remedy = 'Camera.framing(scene), or framing = "auto" in a scene file, shows all of it'
        return f"camera: {image_text} shows nothing of the scene: {reason}; {remedy}"


def _detach_fragments(fragments: Fragments) -> Fragments:
    """Fragments whose points pass no gradient on."""
    return replace(fragments, barycentrics=without_gradient(fragments.barycentrics))


def _radiance(receivers: Receivers, shading: wp.array, reflectance: wp.array) -> wp.array:
    return sample_radiance(receivers.fragments, receivers.faces, shading, reflectance)


def _moving_radiance(
    receivers: Receivers,
    shading: wp.array,
    reflectance: wp.array,
    silhouettes: Silhouettes,
    clip_positions: wp.array,
    albedo_has_mean_slope: wp.array | None,
) -> tuple[wp.array, wp.array]:
    """Samples, and the colors at edges."""
    return moving_radiance(
        receivers.fragments,
        receivers.faces,
        shading,
        reflectance,
        silhouettes,
        clip_positions,
        receivers.receiver_of_vertex,
        receivers.has_mean_slope,
        albedo_has_mean_slope,
    )


def _sum_moving(first: tuple[wp.array, wp.array], second: tuple[wp.array, wp.array]) -> tuple[wp.array, wp.array]:
    """Sums of samples and of the colors at edges."""
    samples, edge_colors = (sum_radiance(*pair) for pair in zip(first, second, strict=True))
    return samples, edge_colors


def _smooth_moving(radiance: tuple[wp.array, wp.array], silhouettes: Silhouettes, clip_positions: wp.array) -> wp.array:
    samples, edge_colors = radiance
    return smooth_silhouettes(samples, silhouettes, clip_positions, edge_colors)


def _white_radiance(receivers: Receivers, shading: wp.array) -> wp.array:
    _, height, width = receivers.fragments.face_ids.shape
    white = wp.full((1, height, width), wp.vec3(1.0), dtype=wp.vec3, device=shading.device)
    return sample_radiance(receivers.fragments, receivers.faces, shading, white)


def _white_shading(receivers: Receivers) -> wp.array:
    """Light of 1 on all receivers, vec3 of shape [1, receiver]."""
    count = len(receivers.static_vertices) + receivers.points.shape[1]
    return wp.full((1, count), wp.vec3(1.0), dtype=wp.vec3, device=receivers.points.device)
