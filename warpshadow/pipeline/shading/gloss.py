"""Gloss: the light of bodies that shine, at receivers that pixels see.

Lobes are sampled at the receivers of glossy bodies; each sample looks up light without shadows, and without suns, in a
prefiltered map, and its transmittance in the way of the method. Suns and emitters are added one by one
(:mod:`.stages.gloss.suns`, :mod:`.stages.gloss.highlights`). Diffuse light is found as for all bodies, and mixed in at
the end.
"""

import functools

import numpy as np
import warp as wp

from warpshadow.assets.basis import Basis
from warpshadow.device.batch import rows
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.bodies.reflectance import Materials
from warpshadow.pipeline.node import Node, field_of
from warpshadow.pipeline.receivers.shading_context import receiver_text
from warpshadow.pipeline.shading.glossy_points import GlossyPoints
from warpshadow.pipeline.shading.light_input import LightInput
from warpshadow.pipeline.shading.lobe_light import LitLobes
from warpshadow.pipeline.shading.method import Method
from warpshadow.pipeline.shading.transfers import change_basis
from warpshadow.scene.material import GLOSS_ARGUMENTS
from warpshadow.stages.gloss.face_horizon import weigh_by_faces
from warpshadow.stages.gloss.lobes import LobeSamples, sample_lobes
from warpshadow.stages.gloss.normal_spread import NormalSpread, find_normal_spread
from warpshadow.stages.gloss.prefilter import look_up_light, prefilter
from warpshadow.stages.gloss.reflection import LobeLight, mix_reflection, sum_lobes
from warpshadow.stages.gloss.suns import add_suns
from warpshadow.stages.light.sums import add_light
from warpshadow.stages.planes.face_texels import FaceTexels
from warpshadow.stages.raster.interpolation import interpolate
from warpshadow.stages.raster.rasterization import Fragments
from warpshadow.stages.receivers.receivers import Receivers
from warpshadow.stages.receivers.sample_receivers import MAX_SHARED_SAMPLES, places_in_pixels
from warpshadow.stages.shell.shell_rays import exits_from_shell
from warpshadow.stages.textures.footprint import Footprints
from warpshadow.stages.textures.numbers import as_colors, as_scalars, average_over_receivers
from warpshadow.stages.textures.pyramid import Textures
from warpshadow.stages.textures.sample import sample_albedo

_CELL_ROWS = 64  # rows of the map of free light in cells: each pixel has the light of the nearest cell


def mix_gloss(
    method: Method,
    lobes: LitLobes,
    diffuse: Node,
    materials: Materials,
    blocked: Node | None,
    radiosity: tuple[Node, FaceTexels] | None,
) -> tuple[Node, Node]:
    """Mix mirrored light with diffuse light, of all receivers of the view.

    Args:
        method: How their light is blocked.
        lobes: The receivers on bodies that shine, and their light.
        diffuse: Node of the view's shading.
        materials: Of the bodies.
        blocked, radiosity: As of :meth:`.LightTransport.blocked_radiance` and :meth:`.LightTransport.radiosity`.
    Returns:
        Nodes of the light that colored and that white surfaces reflect, vec3 of shape [batch, receiver].
    """
    points, light, visibility = lobes.points, lobes.light, method.lobes
    item_text = functools.partial(receiver_text, points.weak_reference)
    values = {name: _find_values(points, materials, name) for name in GLOSS_ARGUMENTS}
    roughness = values["roughness"]

    has_metal = bool(materials.metals)

    def sample() -> Node:
        geometry = points.normals, points.vertices, points.cameras
        find_spread = functools.partial(_find_normal_spread, method)
        spread = Node("", find_spread, points.receivers_node, *geometry, points.fragments)
        inputs = points.receivers_node, roughness, points.cameras, spread, points.fragments, points.vertices
        find = functools.partial(_sample_lobes, method, method.lobes.samples_of_receiver(has_metal=has_metal))
        return Node("lobes", find, *inputs, items=item_text)

    samples = points.cached("lobes", (materials.roughness, has_metal), sample)
    directions, weights, blurs = (field_of(samples, name) for name in ("directions", "weights", "blurs"))
    texels = _prefiltered(method, points, light)
    starts = field_of(points.receivers_node, "points")
    radiance = _look_up(method, points, "prefiltered light", light, texels, directions, blurs, starts)
    transmittance = visibility.transmittance(lobes, directions)
    mirrored: Node | None = None
    mirrored_bodies = method.mirrored_bodies
    find_shown = functools.partial(mirrored_bodies.shown, materials, have_radiosity=radiosity is not None)
    shown = points.cached("bodies that lobes show", (materials, radiosity is None), find_shown)
    if blocked is not None and any(shown):
        texels = texels if light.is_free else visibility.prefiltered(points, light, with_suns=True)
        look_up = functools.partial(_look_up, method, points, "", light, texels)
        mirrored = mirrored_bodies.radiance(
            shown, points, light, materials, samples, transmittance, blocked, look_up, radiosity
        )
    lobe_light = Node("gloss", sum_lobes, weights, radiance, transmittance, blocked, mirrored, items=item_text)
    suns = visibility.suns(points, light)
    if suns is not None:
        sun_transmittance = visibility.sun_transmittance(lobes, suns)
        inputs = lobe_light, field_of(samples, "lobes"), suns, sun_transmittance
        lobe_light = Node("suns", add_suns, *inputs, items=item_text)
    if materials.emission:
        highlights = method.highlights_node(points, materials, roughness, points.cameras)
        lobe_light = Node("", _add_highlights, lobe_light, highlights)
    light_in_lobes = field_of(lobe_light, "light_f0"), field_of(lobe_light, "light_f90")
    of_surface = field_of(samples, "cosines"), values["metallic"], values["specular"]
    mix = Node("reflection", mix_reflection, points.numbers, diffuse, *light_in_lobes, *of_surface, items=item_text)
    return field_of(mix, "colored"), field_of(mix, "white")


def _look_up(
    method: Method,
    points: GlossyPoints,
    name: str,
    light: LightInput,
    texels: Node,
    directions: Node,
    blurs: Node,
    starts: Node,
) -> Node:
    """Node of light without shadows along rays from ``starts``, vec3 of shape [batch, receiver, sample]."""
    shell = method.shell_of(light)
    if shell is not None:
        directions = Node("", exits_from_shell, starts, directions, shell)
    return Node(
        name, look_up_light, texels, directions, blurs, items=functools.partial(receiver_text, points.weak_reference)
    )


def _find_values(points: GlossyPoints, materials: Materials, name: str) -> Node:
    """Node of roughness or the like at the receivers, float32 of shape [batch, receiver]."""
    of_vertices, textures = materials.of_vertices(name), materials.textures_of[name]
    if not textures.images:
        return Node("", functools.partial(_interpolate, points.merged_scene), points.receivers_node, of_vertices)
    arguments = points.fragments, points.clip_positions, textures.pyramids, ""
    cached_name = f"footprints in textures of {textures.sizes}"
    footprints = points.cached(cached_name, None, functools.partial(textures.footprints, *arguments))
    seen = points.fragments, points.merged_scene.faces, of_vertices
    samples = Node("", _sample_textures, *seen, textures.pyramids, footprints)
    return points.select(Node("", _average_samples, points.all_receivers, samples))


def _interpolate(merged_scene: MergedScene, receivers: Receivers, values: wp.array) -> wp.array:
    """Interpolate numbers of vertices at the receivers."""
    samples = receivers.sample_fragments
    assert samples is not None
    if not samples.face_ids.size:
        return wp.empty((1, 0), dtype=wp.float32, device=values.device)
    fragments = Fragments(*(array.reshape((len(array), 1, -1)) for array in (samples.face_ids, samples.barycentrics)))
    return rows(interpolate(fragments, merged_scene.side_faces, values))


def _find_normal_spread(
    method: Method, receivers: Receivers, normals: wp.array, positions: wp.array, cameras: wp.array, seen: Fragments
) -> NormalSpread:
    """Find how normals vary over the receivers. Differentiable: all but seen."""
    supersampling = method.merged_scene.scene.supersampling
    sharing = supersampling // method.lobes.receivers_across  # samples of a receiver, across
    if method.shares_directions and supersampling > MAX_SHARED_SAMPLES:
        sharing = 1
    _, height, width = seen.face_ids.shape
    fragments, size = receivers.sample_fragments, (width // sharing, height // sharing)
    assert fragments is not None
    arguments = fragments, method.merged_scene.side_faces, normals, positions, cameras
    return find_normal_spread(*arguments, size, sharing)


def _sample_lobes(
    method: Method,
    sample_count: int,
    receivers: Receivers,
    roughness: wp.array,
    cameras: wp.array,
    spread: NormalSpread,
    seen: Fragments,
    positions: wp.array,
) -> LobeSamples:
    """Samples of the lobes of the receivers. Differentiable: all but seen."""
    places, receivers_across = None, method.lobes.receivers_across
    if receivers_across > 1 and receivers.samples is not None:
        places = places_in_pixels(receivers.samples, seen.face_ids.shape[2], receivers_across)
    arguments = receivers.points, receivers.normals, roughness, cameras, sample_count
    samples, fragments = sample_lobes(*arguments, spread, places, receivers_across**2), receivers.sample_fragments
    assert fragments is not None
    above = fragments, method.merged_scene.side_faces, positions, receivers.normals
    return samples._replace(weights=weigh_by_faces(*above, samples.directions, samples.weights))


def _sample_textures(
    fragments: Fragments, faces: wp.array, values: wp.array, textures: Textures, footprints: Footprints
) -> wp.array:
    """Find numbers of the view's samples: of textures and, on bodies without one, of vertices."""
    return as_scalars(sample_albedo(fragments, faces, as_colors(values), textures, footprints))


def _prefiltered(method: Method, points: GlossyPoints, light: LightInput) -> Node:
    """Node of prefiltered light, vec3 of shape [batch, texel]."""
    if not light.is_free:
        return method.lobes.prefiltered(points, light)
    find, items = functools.partial(_prefilter_free, method.basis), f"{method.basis.size} coefficients"
    return points.cached("prefiltered", light, lambda: Node("prefiltering", find, light, items=items))


def _prefilter_free(basis: Basis, light: wp.array) -> wp.array:
    """Prefilter free light. Differentiable: light."""
    return change_basis(light, _prefilter_basis(basis))


@functools.lru_cache(maxsize=4)
def _prefilter_basis(basis: Basis) -> np.ndarray:
    """Prefilter the functions of a basis: a matrix from coefficients to texels, float32 [texel, coefficient]."""
    from warpshadow.maths import sh

    directions = sh.equirectangular_directions(_CELL_ROWS)
    functions = basis.functions(directions.reshape(-1, 3))
    return prefilter(functions.reshape(_CELL_ROWS, 2 * _CELL_ROWS, -1))


def _add_highlights(lobe_light: LobeLight, highlights: LobeLight) -> LobeLight:
    """Add the highlights of emitters to other light in lobes. Differentiable: all."""
    return LobeLight(*(add_light(*pair) for pair in zip(lobe_light, highlights, strict=True)))


def _average_samples(receivers: Receivers, samples: wp.array) -> wp.array:
    """Average the samples that share a receiver, float32 of shape [batch, receiver]. Differentiable: samples."""
    count = len(receivers.static_vertices) + receivers.points.shape[1]
    return average_over_receivers(samples, rows(receivers.fragments.face_ids), receivers.faces, count)
