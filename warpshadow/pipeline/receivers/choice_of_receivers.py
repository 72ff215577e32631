"""The choice of receivers, by the table of README.md beside this file.

Flat bodies are adaptive (:mod:`.receivers.adaptive`) where shadows may have edges: of known light, and where arrays are
readable, on a CPU. A ground then has about the error that it has by pixel, in less time.

Between vertices light is interpolated, which shows where a face is large, or small and long, as spokes and rails are;
so faces count by their pixels and by their longest edges. A still can afford receivers at the pixels of its grounds and
walls, where shadows' edges show most.
"""

import dataclasses
from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.assets.camera import Camera
from warpshadow.assets.color import LUMINANCE
from warpshadow.assets.light import EnvironmentMap
from warpshadow.maths.directions import fibonacci
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.receivers.buried_vertices import find_bodies_with_buried_vertices
from warpshadow.pipeline.receivers.unevenness import EmitterLuminance, light_unevenness
from warpshadow.scene.body import Body
from warpshadow.scene.scene import Scene, change_bodies
from warpshadow.scene.visibility import AUTO, Visibility
from warpshadow.spheres import Spheres
from warpshadow.stages.raster.project import to_clip
from warpshadow.stages.raster.rasterization import rasterize
from warpshadow.stages.visibility.sharp_cells import find_sharp_cells

LARGE_FACE = 16.0
"""Pixels of an average face beyond which a body is shaded by pixel, in images of up to 256 × 256 pixels. README.md
beside this file has the measurements of this constant and of those below."""

LARGE_SHARE = 2.0**-12  # in larger images, their share of the pixels: cost grows with pixels, the error does not …

COARSE_FACE = 400.0  # … up to so many pixels: beyond, interpolation shows, and draws a warning if the user asked for it

SMALL_FACE = 2.0  # pixels of an average face beyond which a flat body is adaptive, since vertices are too far apart

FEW_FACES = 256
"""Faces up to which a body is shaded by pixel wherever one has a pixel or more: on a box with a vertex at every corner
a shadow on a side is seen at its ends or not at all, and few faces of few pixels cost little."""

UNEVEN = 0.06
"""Error of light that is interpolated between vertices, relative L2, from which a body is shaded by pixel, or a flat
one adaptively. Smooth bodies alone on a ground have 2 to 4%."""

UNEVEN_SHARE = 0.25
"""From this part of the largest area (:data:`LARGE_FACE`, :data:`LARGE_SHARE`) on, :data:`UNEVEN` is multiplied by
√(UNEVEN_SHARE · largest / area), which is ½ at the largest: teeth of a shadow's edge are as long as a face's side."""

_LONG_SHARE = 0.05
"""Share of a body's pixels that its longest faces show: in 256² pixels such faces are longer than 8 to 12 pixels on
scans and a torus of 48 × 24 quads, but than 56 to 145 on cylinders, capsules, wheels and fences …"""

_LENGTHS = 4.0
"""… and how often such a face may be as long as the side of a square of as many pixels as an average face may have."""


class FaceSize(NamedTuple):
    """How large the faces of a body are in images."""

    area: float  # pixels of an average face that is seen [pixels²]
    length: float  # longest edge beyond which faces show 5% of the body's pixels [pixels]

    def exceeds(self, area: float) -> bool:
        """Whether an average face has more pixels, or long faces are longer than four times the side of so many."""
        return max(self.area, (self.length / _LENGTHS) ** 2) > area

    def __str__(self) -> str:
        return f"its faces have {self.area:.2g} pixels each, and the long ones are {self.length:.2g} pixels long"


class ReceiverChoice(NamedTuple):
    """Where light is evaluated on a body."""

    receivers: str  # at every "vertex", at every "pixel" that shows the body, or "adaptive"
    size: FaceSize | None  # of its faces; None where nobody had to know
    unevenness: float = 0.0  # relative L2 error of light between its vertices; 0 where nobody had to know
    max_unevenness: float = UNEVEN  # up to which vertices will do
    shows_buried: bool = False  # whether pixels would have light of vertices inside other bodies, or behind planes


def choose_receivers(
    merged_scene: MergedScene,
    cameras: Sequence[Camera],
    *,
    is_light_free: bool = False,
    emitter_luminance: EmitterLuminance | None = None,
) -> list[ReceiverChoice]:
    """Choose the receivers of the bodies that leave it open, as cameras see the scene.

    The same scene, cameras and device make the same choice, for known light or for free light; later motion does not
    change it.

    Args:
        merged_scene: The bodies.
        cameras: The cameras that see them.
        is_light_free: Whether light is given as coefficients, so that nobody knows where shadows will have edges.
        emitter_luminance: Of emitters; None without any.
    """
    traits = merged_scene.scene.visibility.traits
    if traits.every_sample_receives:
        return [ReceiverChoice(body.receivers, None) for body in merged_scene.scene.bodies]
    requested = ["pixel" if body.is_glossy else body.receivers for body in merged_scene.scene.bodies]
    if AUTO not in requested:
        return [ReceiverChoice(receivers, None) for receivers in requested]
    positions = np.concatenate([body.world_mesh().positions for body in merged_scene.scene.bodies])
    images = [_seen_faces(merged_scene, positions, camera) for camera in cameras]
    sizes = face_sizes(images, merged_scene, cameras[0])
    large_face = LARGE_SHARE * cameras[0].width * cameras[0].height
    largest = min(max(LARGE_FACE, large_face), COARSE_FACE)
    is_sharp = traits.has_cells and not is_light_free and merged_scene.device.is_cpu
    has_few = np.diff(merged_scene.first_face) <= FEW_FACES
    limits = np.where(has_few, 1.0, largest)
    chosen = np.where([size.exceeds(limit) for size, limit in zip(sizes, limits, strict=True)], "pixel", "vertex")
    is_seen_large = np.array([size.area > SMALL_FACE for size in sizes])
    # where the shadows of emitters and of light from a shell have edges, probes do not tell
    has_unprobed_light = merged_scene.is_emitter.any() or merged_scene.scene.shell is not None
    choice_at_edges = "pixel" if has_unprobed_light else "adaptive"
    chosen = np.where(merged_scene.is_flat & is_sharp & is_seen_large, choice_at_edges, chosen)
    is_undecided = (chosen == "vertex") & (np.array(requested) == AUTO) & (~merged_scene.is_flat | is_sharp)
    unevenness, shows_buried = np.zeros(len(chosen)), np.zeros(len(chosen), bool)
    max_unevenness = UNEVEN * np.array([min(1.0, UNEVEN_SHARE * largest / (size.area or 1.0)) ** 0.5 for size in sizes])
    if is_undecided.any() and traits.has_shadows:
        faces = [np.unique(face_ids[face_ids >= 0], return_counts=True) for face_ids, _ in images]
        shown_faces = [(camera, *counted) for camera, counted in zip(cameras, faces, strict=True)]
        light = EnvironmentMap.constant() if is_light_free else merged_scene.scene.known_light
        bodies = np.flatnonzero(is_undecided).tolist()
        unevenness[is_undecided] = light_unevenness(
            merged_scene, positions, shown_faces, bodies, light, emitter_luminance
        )
        even_bodies = np.flatnonzero(is_undecided & (unevenness <= max_unevenness)).tolist()
        face_ids = [ids for ids, _ in faces]
        shows_buried[even_bodies] = find_bodies_with_buried_vertices(merged_scene, positions, face_ids, even_bodies)
    chosen = np.where(
        shows_buried | (unevenness > max_unevenness), np.where(merged_scene.is_flat, choice_at_edges, "pixel"), chosen
    )
    return [
        ReceiverChoice(choice if receivers == AUTO else receivers, size, float(error), float(limit), bool(buried))
        for choice, receivers, size, error, limit, buried in zip(
            chosen.tolist(), requested, sizes, unevenness, max_unevenness, shows_buried, strict=True
        )
    ]


def with_receivers(scene: Scene, choices: Sequence[ReceiverChoice]) -> Scene:
    """The scene with a choice for each body in place of "auto"."""
    pairs = enumerate(zip(scene.bodies, choices, strict=True))
    changed = {number: choice.receivers for number, (body, choice) in pairs if body.receivers != choice.receivers}
    return change_bodies(scene, "receivers", changed)


def for_still(scene: Scene) -> Scene:
    """The scene, for a still: by rays, where it names neither a method nor settings that rays leave unused.

    All receivers share their directions, as many as ``samples`` says, 512 by default. They need no spheres and no
    tables, whose making a picture would wait for, and the picture does not depend on the cache. Bodies with spheres or
    ``self_shadows`` of their own name "directional", which has them.

    By other methods flat bodies that leave their receivers open are shaded by pixel, unless spheres bulge out of them.

    Interpolation between the vertices of a ground makes shadows' edges jagged. Under a sun all other bodies are shaded
    by pixel, too, and ``self_shadows`` "traced" becomes "rays", which have no gradient: of a still nobody asks for one.
    Edges are as clean as of ``ray-traced``: README.md beside this file has errors and times.
    """
    if scene.visibility.method is None:
        if not any(isinstance(body.blockers, Spheres) or body.self_shadows for body in scene.bodies):
            shared = Visibility("ray-traced", samples=scene.visibility.samples, sampling="shared")
            return dataclasses.replace(scene, visibility=shared)
        scene = scene.with_method()
    visibility, has_sun = scene.visibility, _has_sun(scene)
    if has_sun and visibility.self_shadows == "traced":
        scene = dataclasses.replace(scene, visibility=dataclasses.replace(visibility, self_shadows="rays"))
    by_pixel = [
        body.receivers == AUTO
        and (has_sun or body.mesh.is_flat)
        and not (body.self_shadows_in(visibility) == "spheres" and body.is_thin)
        for body in scene.bodies
    ]
    return change_bodies(scene, "receivers", dict.fromkeys(np.flatnonzero(by_pixel).tolist(), "pixel"))


def _has_sun(scene: Scene) -> bool:
    """Whether shadows of a sun are to be found in cells."""
    if not scene.visibility.traits.has_cells or scene.shell is not None:
        return False
    cell_light = scene.known_light.cells(fibonacci(scene.direction_count))
    if cell_light.spots is None or cell_light.half_angles is None:
        return False
    return find_sharp_cells(cell_light.radiance @ LUMINANCE, cell_light.spots, cell_light.half_angles) is not None


def receiver_notes(scene: Scene, choices: Sequence[ReceiverChoice], bulging_bodies: Collection[int] = ()) -> list[str]:
    """Describe the choice for each body that leaves it open, a line each.

    Args:
        scene: The scene as it was given.
        choices: The choices for its bodies.
        bulging_bodies: Bodies out of which their spheres bulge: :class:`.BlockerKinds`.
    """
    notes = []
    for number, (body, choice) in enumerate(zip(scene.bodies, choices, strict=True)):
        if body.receivers == AUTO and choice.size is not None:
            where, why = _RECEIVER_WORDS[choice.receivers], _reason(choice)
            if number in bulging_bodies:
                where, why = _RECEIVER_WORDS["vertex"], "spheres block its light, and bulge out of it between vertices"
            notes.append(f"Body {number} ({body.name!r}) has receivers at {where}: {why}.")
    return notes


def _reason(choice: ReceiverChoice) -> str:
    if choice.unevenness > choice.max_unevenness:
        error, limit = choice.unevenness, choice.max_unevenness
        return f"between its vertices light is off by {error:.1%}, more than {limit:.1%}"
    if choice.shows_buried:
        return "vertices inside other bodies, or behind planes, are dark, beside pixels that are not"
    return str(choice.size)


def warn_of_coarse_faces(bodies: Sequence[Body], sizes: Sequence[FaceSize]) -> None:
    """Warn of bodies whose receivers are at vertices, and whose faces are so large that shadows fall between these."""
    for number, (body, size) in enumerate(zip(bodies, sizes, strict=True)):
        if body.receivers == "vertex" and size.exceeds(COARSE_FACE):
            check.warn(
                f"body {number} ({body.name!r}): {size}, and light is evaluated at their corners alone; "
                'receivers = "auto" or "pixel" evaluates it at every pixel'
            )


_RECEIVER_WORDS = {
    "vertex": "vertices",
    "pixel": "pixels",
    "adaptive": "pixels, close to each other where shadows have edges, since it is flat",
}
"""Where receivers are, in words."""


def face_sizes(
    images: Iterable[tuple[np.ndarray, np.ndarray]], merged_scene: MergedScene, camera: Camera
) -> list[FaceSize]:
    """How large the faces of each body are in images; 0 for bodies that none shows.

    Args:
        images: Of each the face that every sample sees, −1 for none, shape [height, width], and the vertices in clip
            space, shape [vertex, 4].
        merged_scene: The bodies.
        camera: Has the images' size in pixels and their near plane.
    """
    bodies, counts, lengths = np.empty(0, int), np.empty(0), np.empty(0)
    faces = merged_scene.faces.numpy()
    for face_ids, clip_positions in images:
        seen_faces, sample_counts = np.unique(face_ids[face_ids >= 0], return_counts=True)
        bodies = np.concatenate([bodies, merged_scene.body_of_face[seen_faces]])
        counts = np.concatenate([counts, sample_counts * (camera.width * camera.height / face_ids.size)])
        lengths = np.concatenate([lengths, _longest_edges(clip_positions[faces[seen_faces]], camera)])
    return [_size_of(counts[bodies == body], lengths[bodies == body]) for body in range(len(merged_scene.scene.bodies))]


def _size_of(pixel_counts: np.ndarray, lengths: np.ndarray) -> FaceSize:
    if not len(lengths):
        return FaceSize(0.0, 0.0)
    falling = np.argsort(-lengths)
    pixel_shares = np.cumsum(pixel_counts[falling]) / pixel_counts.sum()
    return FaceSize(float(pixel_counts.mean()), float(lengths[falling][np.searchsorted(pixel_shares, _LONG_SHARE)]))


def _longest_edges(corners: np.ndarray, camera: Camera) -> np.ndarray:
    """Longest edges of faces [pixels], given their corners in clip space [face, 3, 4].

    Edges reach to the near plane, and beyond the image: light is interpolated from there, too.
    """
    starts, ends = corners.astype(float), np.roll(corners, -1, axis=1).astype(float)
    steps = ends - starts
    with np.errstate(divide="ignore", invalid="ignore"):
        to_near = np.nan_to_num((camera.near - starts[..., 3]) / steps[..., 3])
    first = np.where(starts[..., 3] < camera.near, to_near, 0.0)
    last = np.where(ends[..., 3] < camera.near, to_near, 1.0)
    size = np.array([camera.width, camera.height])
    points = (starts + np.clip(position, 0, 1)[..., None] * steps for position in (first, last))
    start, end = (point[..., :2] / np.maximum(point[..., 3:], camera.near) * size / 2 for point in points)
    return np.minimum(np.linalg.norm(end - start, axis=-1).max(axis=1), np.linalg.norm(size))


def _seen_faces(merged_scene: MergedScene, positions: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Face that each pixel sees of the scene, −1 for none, and the vertices, which are given, in clip space.

    The bodies' spheres, which take long, need not be known.
    """
    device = merged_scene.device
    clip_matrix = wp.array([camera.clip_matrix()], dtype=wp.mat44, device=device)
    clip_positions = to_clip(wp.array(positions[None], dtype=wp.vec3, device=device), clip_matrix)
    face_ids = rasterize(clip_positions, merged_scene.faces, camera.width, camera.height).face_ids
    return face_ids.numpy()[0], clip_positions.numpy()[0]
