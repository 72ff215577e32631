"""Paths: light that bounces between the meshes, for the ray-traced method."""

from dataclasses import replace

import warp as wp

from warpshadow.device.batch import common_batch
from warpshadow.pipeline.assembly import Assembly
from warpshadow.pipeline.lighting import KnownLight, LitPoints, map_of, receiver_words
from warpshadow.pipeline.node import Node, Source
from warpshadow.pipeline.reflectance import Materials
from warpshadow.stages.bounces.total import total_light
from warpshadow.stages.light_samples import sample_map
from warpshadow.stages.path_tracing import Surfaces, trace_bounces
from warpshadow.stages.receivers import Receivers
from warpshadow.stages.textures.pyramid import Textures

_LIGHT_SAMPLES = 1024
"""Directions of each set from which hits draw light."""

_ALL = 64
"""Most bounces of a path where it may have any number: in a closed room of albedo 0.9 one in 800 ends there."""

_RAYS_OF_PATH = 2
"""Rays of direct light for each path, which varies about as much and takes 2.4 times as long with two bounces."""


def path_traced(
    direct: Node, meshes: Node, points: LitPoints, light: Source, materials: Materials, *, samples: int, progress: bool
) -> Node:
    """Shading with bounces: what direct light makes, and what paths bring.

    Args:
        direct: Node of the shading by direct light.
        meshes: Node of the meshes that block direct light, one for each instance.
        points: What is lit.
        light: Known light.
        materials: What the bodies reflect.
        samples: Rays of direct light for each receiver.
        progress: Show progress where it takes longer than a second.
    """
    assembly = points.assembly
    most, paths = assembly.scene.bounces, -(-samples // _RAYS_OF_PATH)
    bounces = _ALL if most == "all" else most

    def trace(
        shading: wp.array,
        receivers: Receivers,
        casting: list[wp.Mesh | None],
        positions: wp.array,
        normals: wp.array,
        radiance: KnownLight,
        vertex_albedo: wp.array,
        textures: Textures | None,
    ) -> wp.array:
        texels = None if textures is None else textures.texels
        count = common_batch({"geometry": shading, "albedo": vertex_albedo, "textures": texels})
        drawn = sample_map(map_of(radiance), _LIGHT_SAMPLES, seed=1)
        bounced = wp.empty((count, *shading.shape[1:]), dtype=wp.vec3, device=shading.device)

        def of_instance(array: wp.array) -> wp.array:
            return array[min(instance, len(array) - 1)]

        for instance in range(count):
            surfaces = Surfaces(
                _whole_mesh(assembly, of_instance(casting), of_instance(positions)),
                of_instance(casting),
                assembly.faces,
                of_instance(normals),
                of_instance(vertex_albedo),
                None if textures is None else replace(textures, texels=of_instance(texels).reshape((1, -1))),
                materials.texture_of_face,
                assembly.uvs[0],
                assembly.uv_faces,
            )
            places = of_instance(receivers.points), of_instance(receivers.normals)
            light = trace_bounces(surfaces, *places, drawn, bounces=bounces, paths=paths, progress=progress)
            wp.copy(bounced[instance], light)
        return total_light([shading, bounced])

    return Node(
        "bounces",
        trace,
        direct,
        points.receivers_node,
        meshes,
        points.vertices,
        points.normals,
        light,
        materials.vertex_albedo,
        materials.pyramids if materials.images else None,
        items=lambda: f"{receiver_words(points)} × {paths:,} paths of {most} bounces",
        has_adjoint=False,
    )


def _whole_mesh(assembly: Assembly, casting: wp.Mesh | None, positions: wp.array) -> wp.Mesh:
    """The mesh of all bodies: that of those that cast shadows, where all do."""
    is_whole = casting is not None and len(assembly.casting) == len(assembly.scene.bodies)
    return casting if is_whole else assembly.mesh(positions)
