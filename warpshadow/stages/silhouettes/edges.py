"""Edges between neighboring samples: where a surface ends, or has a crease, along a row or column."""

import warp as wp

from warpshadow.stages.raster.screen import ends_before, neighbor, orientation, relative_to_ray, sample_center
from warpshadow.stages.silhouettes.lines import FragmentArrays, image_index, line_between

MAX_STEPS = 32


"""Faces that the search for an edge between the centers of two samples crosses at most."""

# Rasterization moves vertices by up to 1/8192 sample: an edge may be this far on the wrong side of a center [samples].
SNAP = 1.0 / 2048.0


@wp.func
def sample_depth(fragments: FragmentArrays, sample: int):
    """Distance of a sample's point along the view, infinite for the background."""
    depth = float(wp.inf)
    face = fragments.face_ids[sample]
    if face >= 0:
        weights = fragments.barycentrics[sample]
        clip = fragments.clip_positions[image_index(fragments, sample)]
        corners = fragments.faces[face]
        depth = weights[0] * clip[corners[0]][3] + weights[1] * clip[corners[1]][3] + weights[2] * clip[corners[2]][3]
    return depth


@wp.func
def _opposite_corner(face: int, neighbor_face: int, neighbors: wp.array(dtype=wp.vec3i)):
    """Corner of a face that is opposite to the edge which it shares with another."""
    adjacent_faces = neighbors[neighbor_face]
    return wp.where(adjacent_faces[0] == face, 0, wp.where(adjacent_faces[1] == face, 1, 2))


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
    """Whether both faces at edge ab lie on the same side of it on screen, for any winding."""
    if neighbor_face < 0:
        return True
    corner = faces[neighbor_face][_opposite_corner(face, neighbor_face, neighbors)]
    return volume * orientation(a, b, clip_positions[corner]) >= 0.0


@wp.func
def is_crease(face: int, corner: int, creases: wp.array(dtype=wp.int32)):
    """Whether the edge opposite to a face's corner is a crease."""
    if creases:
        return (creases[face] >> corner) & 1 == 1
    return False


@wp.func
def _find_surface_end(
    start_face: int,
    goal_face: int,
    end_position: wp.vec2,
    axis: int,
    faces: wp.array(dtype=wp.vec3i),
    neighbors: wp.array(dtype=wp.vec3i),
    creases: wp.array(dtype=wp.int32),
    clip_positions: wp.array(dtype=wp.vec4),
):
    """Traverse a surface from face to face along a row or column, up to a position on screen.

    Returns 3 face + corner of the silhouette edge at which the surface ends before, −1 if it does not; and that of the
    first crease on the way to the goal, −1 if there is none or the goal is not reached.
    """
    half_edge = int(-1)
    crease = int(-1)
    face = start_face
    step = int(0)
    while face >= 0 and face != goal_face and step < MAX_STEPS:
        corners = faces[face]
        adjacent_faces = neighbors[face]
        volume = orientation(clip_positions[corners[0]], clip_positions[corners[1]], clip_positions[corners[2]])
        next_face = int(-1)
        for k in range(3):
            p = clip_positions[corners[(k + 1) % 3]]
            q = clip_positions[corners[(k + 2) % 3]]
            a = relative_to_ray(p, end_position)
            b = relative_to_ray(q, end_position)
            offset_a = a[1 - axis]
            offset_b = b[1 - axis]
            if wp.min(offset_a, offset_b) <= 0.0 and wp.max(offset_a, offset_b) > 0.0:
                line = wp.cross(a, b)
                is_in_front = wp.where(axis == 0, -line[0], line[1]) * (offset_b - offset_a) > 0.0
                if line[2] * volume < 0.0 and is_in_front:
                    if is_silhouette(face, adjacent_faces[k], p, q, volume, faces, neighbors, clip_positions):
                        half_edge = 3 * face + k
                    else:
                        next_face = adjacent_faces[k]
                        if crease < 0 and is_crease(face, k, creases):
                            crease = 3 * face + k
        face = wp.where(half_edge >= 0, -1, next_face)
        step += 1
    return half_edge, wp.where(face == goal_face, crease, -1)


@wp.func
def find_half_edge(
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
    neighbor_sample = neighbor(sample, direction, fragments.width)
    face = fragments.face_ids[sample]
    neighbor_face = fragments.face_ids[neighbor_sample]
    is_nearer = sample_depth(fragments, sample) <= sample_depth(fragments, neighbor_sample)
    sample_position = sample_center(sample, fragments.width, fragments.height)
    neighbor_position = sample_center(neighbor_sample, fragments.width, fragments.height)
    margin = SNAP * (neighbor_position - sample_position)
    clip = fragments.clip_positions[image_index(fragments, sample)]
    half_edge = int(-1)
    crease = int(-1)
    for attempt in range(2):
        if half_edge < 0 and crease < 0:
            starts_at_sample = is_nearer == (attempt == 0)
            start_face = wp.where(starts_at_sample, face, neighbor_face)
            goal_face = wp.where(starts_at_sample, neighbor_face, face)
            end_position = wp.where(starts_at_sample, neighbor_position + margin, sample_position - margin)
            half_edge, crease = _find_surface_end(
                start_face, goal_face, end_position, direction // 2, fragments.faces, neighbors, creases, clip
            )
    return wp.where(half_edge >= 0, half_edge, crease)


@wp.func
def oriented_edge(face: int, corner: int, faces: wp.array(dtype=wp.vec3i), clip_positions: wp.array(dtype=wp.vec4)):
    """The edge opposite to a face's corner, in the order in which its line is positive on the face."""
    corners = faces[face]
    a = corners[(corner + 1) % 3]
    b = corners[(corner + 2) % 3]
    if orientation(clip_positions[corners[0]], clip_positions[corners[1]], clip_positions[corners[2]]) < 0.0:
        return wp.vec2i(b, a)
    return wp.vec2i(a, b)


@wp.func
def edge_of_crossing(
    fragments: FragmentArrays,
    neighbors: wp.array(dtype=wp.vec3i),
    creases: wp.array(dtype=wp.int32),
    crossings: wp.array2d(dtype=wp.int32),
    sample: int,
    direction: int,
    is_seen_by_neighbor: bool,
):
    """Vertices of the edge between a sample and its neighbor, as the sample or the neighbor has them."""
    crossing = crossings[direction // 2, sample]
    if crossing < 0:
        return wp.vec2i(crossing, crossing)  # nothing, or where faces intersect
    face = crossing // 3
    corner = crossing - 3 * face
    clip = fragments.clip_positions[image_index(fragments, sample)]
    edge = oriented_edge(face, corner, fragments.faces, clip)
    if creases:
        neighbor_face = neighbors[face][corner]
        corners = fragments.faces[face]
        a = clip[corners[(corner + 1) % 3]]
        b = clip[corners[(corner + 2) % 3]]
        volume = orientation(clip[corners[0]], clip[corners[1]], clip[corners[2]])
        is_crease = not is_silhouette(face, neighbor_face, a, b, volume, fragments.faces, neighbors, clip)
        # the sample that the edge's line does not bound has the edge of the face beyond
        if (
            is_crease
            and ends_before(line_between(fragments, sample, direction, edge), direction) == is_seen_by_neighbor
        ):
            edge = oriented_edge(neighbor_face, _opposite_corner(face, neighbor_face, neighbors), fragments.faces, clip)
    return edge
