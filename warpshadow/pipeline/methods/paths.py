"""Paths: light that bounces between the meshes, for the ray-traced method."""

from dataclasses import replace
from typing import TYPE_CHECKING

import warp as wp

from warpshadow.assets.known_light import KnownLight
from warpshadow.device.batch import common_batch, instance_of
from warpshadow.device.memory import empty
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.bodies.reflectance import Materials
from warpshadow.pipeline.node import Input, Node
from warpshadow.pipeline.receivers.shading_context import ShadingContext, receiver_text
from warpshadow.stages.light.light_samples import sample_map
from warpshadow.stages.light.sums import add_light
from warpshadow.stages.ray_traced.path_tracing import PathSurfaces, trace_bounces
from warpshadow.stages.receivers.receivers import Receivers
from warpshadow.stages.shell.shell_rays import FAR
from warpshadow.stages.textures.numbers import as_colors
from warpshadow.stages.textures.pyramid import Textures

if TYPE_CHECKING:  # it is imported where bodies emit
    from warpshadow.stages.emitters.samples import PlacedSamples

_LIGHT_SAMPLES = 1024  # directions of each set from which hits draw light
# most bounces of a path where it may have any number: in a closed room of albedo 0.9 one in 800 ends there
_MAX_PATH_BOUNCES = 64

_RAYS_OF_PATH = 2
"""Rays of direct light for each path, which varies about as much and takes 2.4 times as long with two bounces."""


def path_traced(
    direct: Node,
    meshes: Node,
    context: ShadingContext,
    light: Input,
    shell: Input | wp.array | None,
    materials: Materials,
    emitters: Node | None,
    *,
    samples: int,
    progress: bool,
) -> Node:
    """Shading with bounces: direct light, and light along paths.

    Args:
        direct: Node of the shading by direct light.
        meshes: Node of the meshes that block direct light, one for each instance.
        context: The receivers.
        light: Known light.
        shell: Center and radius of the sphere that sends it, vec4 of shape [batch]; None for light infinitely far away.
        materials: Reflectance of the bodies.
        emitters: Node of the samples of emitters, where one emits within a cone alone; else None.
        samples: Rays of direct light for each receiver.
    """
    merged_scene = context.merged_scene
    colors, emission_images = materials.textures_of["textures"], materials.textures_of.get("emission")
    maximum, paths = merged_scene.scene.bounces, -(-samples // _RAYS_OF_PATH)
    bounces = _MAX_PATH_BOUNCES if maximum == "all" else maximum

    def trace(
        shading: wp.array,
        receivers: Receivers,
        casting: list[wp.Mesh | None],
        positions: wp.array,
        normals: wp.array,
        known_light: KnownLight,
        shell: wp.array | None,
        vertex_albedo: wp.array,
        textures: Textures | None,
        emission: wp.array | None,
        emission_textures: Textures | None,
        placed_samples: "PlacedSamples | None",
    ) -> wp.array:
        if not receivers.points.size:
            return shading
        axes = None if placed_samples is None else placed_samples.axes
        texels, emitted = (None if item is None else item.texels for item in (textures, emission_textures))
        shells = FAR[None] if shell is None else shell.numpy()
        count = common_batch(
            {"shell": shells, "geometry": shading, "albedo": vertex_albedo, "textures": texels}
            | {"emission": emission, "textures of emission": emitted}
        )
        drawn = sample_map(known_light.radiance, _LIGHT_SAMPLES, seed=1)
        bounced = empty((count, *shading.shape[1:]), dtype=wp.vec3, device=shading.device)

        def instance_rows(array: wp.array) -> wp.array:
            return instance_of(array, instance)

        def textures_of_instance(textures: Textures | None) -> Textures | None:
            return (
                None if textures is None else replace(textures, texels=instance_rows(textures.texels).reshape((1, -1)))
            )

        for instance in range(count):
            surfaces = PathSurfaces(
                _whole_mesh(merged_scene, instance_rows(casting), instance_rows(positions)),
                instance_rows(casting),
                merged_scene.faces,
                instance_rows(normals),
                instance_rows(vertex_albedo),
                textures_of_instance(textures),
                colors.texture_of_face,
                merged_scene.uvs[0],
                merged_scene.uv_faces,
                None
                if emission is None or emission_images is None
                else merged_scene.emitting_faces(
                    instance_rows(positions),
                    instance_rows(emission),
                    textures_of_instance(emission_textures),
                    emission_images.texture_of_face,
                    None if axes is None else instance_rows(axes),
                ),
            )
            places = instance_rows(receivers.points), instance_rows(receivers.normals)
            options = {"bounces": bounces, "paths": paths, "shell": instance_rows(shells), "progress": progress}
            light = trace_bounces(surfaces, *places, drawn, **options)
            wp.copy(bounced[instance], light)
        return add_light(shading, bounced)

    weak_context = context.weak_reference
    return Node(
        "bounces",
        trace,
        direct,
        context.receivers_node,
        meshes,
        context.vertices,
        context.normals,
        light,
        shell,
        _vertex_reflectance(materials),
        colors.pyramids if colors.images else None,
        materials.of_vertices("emission") if materials.emission else None,
        emission_images.pyramids if emission_images and emission_images.images else None,
        emitters,
        items=lambda: f"{receiver_text(weak_context)} × {paths:,} paths of {maximum} bounces",
        has_adjoint=False,
    )


def _whole_mesh(merged_scene: MergedScene, casting: wp.Mesh | None, positions: wp.array) -> wp.Mesh:
    """The mesh of all bodies: the mesh of shadow casters if that is all of them."""
    is_whole = casting is not None and len(merged_scene.shadow_casters) == len(merged_scene.scene.bodies)
    return casting if is_whole else merged_scene.mesh(positions)


def _vertex_reflectance(materials: Materials) -> Node:
    """Node of the reflectance of vertices, gloss included, vec3 of shape [batch, vertex]; textures count without it."""
    if not materials.roughness:
        return materials.vertex_albedo
    from warpshadow.stages.gloss.total_reflectance import total_reflectance

    def find(albedo: wp.array, *gloss: wp.array) -> wp.array:
        return total_reflectance(albedo, *map(as_colors, gloss))

    gloss = (materials.of_vertices(name) for name in ("roughness", "metallic", "specular"))
    return Node("", find, materials.vertex_albedo, *gloss)
