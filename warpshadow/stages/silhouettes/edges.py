"""Edges between neighboring samples: where a surface ends, or has a crease, along a row or column."""

import warp as wp

from warpshadow.stages.screen import ends_before, neighbor, orientation, relative, sample_center
from warpshadow.stages.silhouettes.lines import FragmentArrays, image_of, line_between

MAX_STEPS = 32


"""Faces that are walked over between the centers of two samples before the search for an edge is given up."""

# Rasterization moves vertices by up to 1/8192 sample: an edge may be this far on the wrong side of a center [samples].
SNAP = 1.0 / 2048.0


@wp.func
def depth_of(fragments: FragmentArrays, sample: int):
    """Distance of a sample's point along the view, infinite for the background."""
    depth = float(wp.inf)
    face = fragments.face_ids[sample]
    if face >= 0:
        weights = fragments.barycentrics[sample]
        clip = fragments.clip_positions[image_of(fragments, sample)]
        corners = fragments.faces[face]
        depth = weights[0] * clip[corners[0]][3] + weights[1] * clip[corners[1]][3] + weights[2] * clip[corners[2]][3]
    return depth


@wp.func
def _corner_before(face: int, neighbor_face: int, neighbors: wp.array(dtype=wp.vec3i)):
    """Corner of a face that is opposite to the edge which it shares with another."""
    surrounding = neighbors[neighbor_face]
    return wp.where(surrounding[0] == face, 0, wp.where(surrounding[1] == face, 1, 2))


@wp.func
def is_silhouette(
    face: int,
    neighbor_face: int,
    a: wp.vec4,
    b: wp.vec4,
    volume: float,
    faces: wp.array(dtype=wp.vec3i),
    neighbors: wp.array(dtype=wp.vec3i),
    clip_positions: wp.array(dtype=wp.vec4),
):
    """Whether the faces on both sides of edge ab lie on one side of it on screen, however they wind."""
    if neighbor_face < 0:
        return True
    corner = faces[neighbor_face][_corner_before(face, neighbor_face, neighbors)]
    return volume * orientation(a, b, clip_positions[corner]) >= 0.0


@wp.func
def is_crease(face: int, corner: int, creases: wp.array(dtype=wp.int32)):
    """Whether the edge opposite to a face's corner is a crease."""
    if creases:
        return (creases[face] >> corner) & 1 == 1
    return False


@wp.func
def _end_of_surface(
    start: int,
    goal: int,
    end: wp.vec2,
    axis: int,
    faces: wp.array(dtype=wp.vec3i),
    neighbors: wp.array(dtype=wp.vec3i),
    creases: wp.array(dtype=wp.int32),
    clip_positions: wp.array(dtype=wp.vec4),
):
    """Walk over a surface, from face to face along a row or column, until a position on screen is reached.

    Returns 3 face + corner of the silhouette edge at which the surface ends before, −1 if it does not; and that of the
    first crease on the way to the goal, −1 if there is none or the goal is not reached.
    """
    edge_found = int(-1)
    crease = int(-1)
    face = start
    step = int(0)
    while face >= 0 and face != goal and step < MAX_STEPS:
        corners = faces[face]
        surrounding = neighbors[face]
        volume = orientation(clip_positions[corners[0]], clip_positions[corners[1]], clip_positions[corners[2]])
        onward = int(-1)
        for k in range(3):
            p = clip_positions[corners[(k + 1) % 3]]
            q = clip_positions[corners[(k + 2) % 3]]
            a = relative(p, end)
            b = relative(q, end)
            across_a = a[1 - axis]
            across_b = b[1 - axis]
            if wp.min(across_a, across_b) <= 0.0 and wp.max(across_a, across_b) > 0.0:
                line = wp.cross(a, b)
                is_before_eye = wp.where(axis == 0, -line[0], line[1]) * (across_b - across_a) > 0.0
                if line[2] * volume < 0.0 and is_before_eye:
                    if is_silhouette(face, surrounding[k], p, q, volume, faces, neighbors, clip_positions):
                        edge_found = 3 * face + k
                    else:
                        onward = surrounding[k]
                        if crease < 0 and is_crease(face, k, creases):
                            crease = 3 * face + k
        face = wp.where(edge_found >= 0, -1, onward)
        step += 1
    return edge_found, wp.where(face == goal, crease, -1)


@wp.func
def edge_between(
    fragments: FragmentArrays,
    neighbors: wp.array(dtype=wp.vec3i),
    creases: wp.array(dtype=wp.int32),
    sample: int,
    direction: int,
):
    """The one edge between a sample and its neighbor in a direction, as 3 face + corner, or −1.

    It is where the surface of the nearer sample ends before the other's center. If that surface goes on, hidden behind
    the other's, it is where the other's ends instead. If they are one surface, it is its first crease.
    """
    other = neighbor(sample, direction, fragments.width)
    here = fragments.face_ids[sample]
    there = fragments.face_ids[other]
    is_nearer = depth_of(fragments, sample) <= depth_of(fragments, other)
    first = sample_center(sample, fragments.width, fragments.height)
    last = sample_center(other, fragments.width, fragments.height)
    margin = SNAP * (last - first)
    clip = fragments.clip_positions[image_of(fragments, sample)]
    edge_found = int(-1)
    crease = int(-1)
    for attempt in range(2):
        if edge_found < 0 and crease < 0:
            from_here = is_nearer == (attempt == 0)
            start = wp.where(from_here, here, there)
            goal = wp.where(from_here, there, here)
            end = wp.where(from_here, last + margin, first - margin)
            edge_found, crease = _end_of_surface(
                start, goal, end, direction / 2, fragments.faces, neighbors, creases, clip
            )
    return wp.where(edge_found >= 0, edge_found, crease)


@wp.func
def edge_of(face: int, corner: int, faces: wp.array(dtype=wp.vec3i), clip_positions: wp.array(dtype=wp.vec4)):
    """The edge opposite to a face's corner, in the order in which its line is positive on the face."""
    corners = faces[face]
    a = corners[(corner + 1) % 3]
    b = corners[(corner + 2) % 3]
    if orientation(clip_positions[corners[0]], clip_positions[corners[1]], clip_positions[corners[2]]) < 0.0:
        return wp.vec2i(b, a)
    return wp.vec2i(a, b)


@wp.func
def edge_at(
    fragments: FragmentArrays,
    neighbors: wp.array(dtype=wp.vec3i),
    creases: wp.array(dtype=wp.int32),
    crossings: wp.array2d(dtype=wp.int32),
    sample: int,
    direction: int,
    is_neighbor: bool,
):
    """The edge between a sample and its neighbor, if there is any, as the one or the other has it."""
    crossing = crossings[direction / 2, sample]
    if crossing < 0:
        return wp.vec2i(crossing, crossing)  # nothing, or where faces intersect
    face = crossing / 3
    corner = crossing - 3 * face
    clip = fragments.clip_positions[image_of(fragments, sample)]
    edge = edge_of(face, corner, fragments.faces, clip)
    if creases:
        other = neighbors[face][corner]
        corners = fragments.faces[face]
        a = clip[corners[(corner + 1) % 3]]
        b = clip[corners[(corner + 2) % 3]]
        volume = orientation(clip[corners[0]], clip[corners[1]], clip[corners[2]])
        is_crease = not is_silhouette(face, other, a, b, volume, fragments.faces, neighbors, clip)
        # the sample that the edge's line does not bound has the edge of the face beyond
        if is_crease and ends_before(line_between(fragments, sample, direction, edge), direction) == is_neighbor:
            edge = edge_of(other, _corner_before(face, other, neighbors), fragments.faces, clip)
    return edge
