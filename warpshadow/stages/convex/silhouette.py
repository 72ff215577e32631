"""Silhouettes of convex parts, as a block of receivers sees them, and the coverage of a cell by one.

The formulas are those of :mod:`warpshadow.stages.cell_coverage`. Receivers that are near each other see nearly the same
edges of a part, so a block of them goes over its edges together (:mod:`warpshadow.device.lanes`): an edge that only
some of them have on their silhouette has the sign 0 for the others. One receiver after another took five times as long.
"""

import functools
from typing import Any, NamedTuple

import warp as wp

from warpshadow.device.lane_code import ANGLE
from warpshadow.device.lanes import lane_type, make_lane_functions, vectors_type
from warpshadow.stages.cell_coverage import MIN_DISTANCE
from warpshadow.stages.convex.convex_blockers import ConvexArrays
from warpshadow.stages.convex.joint_lanes import coverage_type

EDGE_LANES = 5
"""Lanes of an edge: its normal m towards the part, three; its sign, 1 where a receiver sees the face to its right
alone, −1 where it sees the one to its left alone, else 0; and a number added to m·ω: 2 where the sign is 0, so that no
cell meets the edge, else 0."""

ADJOINT_LANES = 6  # lanes of an edge's gradients: of its normal; or of its two ends

SUM_LANES = 7  # lanes of sums over chords: area, product of complex numbers, its turns, and moment

_MIN_EDGE_SINE = 1.0e-6  # sine of the least angle under which a receiver sees an edge

_ENDS = """
    const float ax = a.c[0] - points.x.c[lane], bx = b.c[0] - points.x.c[lane];
    const float ay = a.c[1] - points.y.c[lane], by = b.c[1] - points.y.c[lane];
    const float az = a.c[2] - points.z.c[lane], bz = b.c[2] - points.z.c[lane];
"""
"""Ends of an edge, relative to a receiver."""

_NORMAL = """
    const float nx = ay * bz - az * by, ny = az * bx - ax * bz, nz = ax * by - ay * bx;
    const float square = nx * nx + ny * ny + nz * nz;
"""

_CHORD = """
    const float mx = wp::index(edges, row).c[lane];
    const float my = wp::index(edges, row + 1).c[lane];
    const float mz = wp::index(edges, row + 2).c[lane];
    const float sign = wp::index(edges, row + 3).c[lane];
    const bool is_near = cosine.c[lane] < radius && cosine.c[lane] > -radius;
    const float cosine_ = is_near ? cosine.c[lane] : (float)0;
    const float scale = (float)1 / wp::sqrt((float)1 - cosine_ * cosine_);
    const float distance = cosine_ * scale;
    const float half2 = radius * radius - distance * distance;
    const float half = wp::sqrt(half2 > (float)0 ? half2 : (float)0);
    const float tx = scale * (dy * mz - dz * my), ty = scale * (dz * mx - dx * mz), tz = scale * (dx * my - dy * mx);
    const float toward_x = scale * (mx - cosine_ * dx), toward_y = scale * (my - cosine_ * dy);
    const float toward_z = scale * (mz - cosine_ * dz);
    const float ahead_a = ax * dx + ay * dy + az * dz, ahead_b = bx * dx + by * dy + bz * dz;
    const float aside_a = ax * tx + ay * ty + az * tz, aside_b = bx * tx + by * ty + bz * tz;
    const float border_a = aside_a > (float)0 ? half : -half, border_b = aside_b > (float)0 ? half : -half;
    const bool ends_a = ahead_a * half <= aside_a * (aside_a > (float)0 ? (float)1 : (float)-1);
    const bool ends_b = ahead_b * half <= aside_b * (aside_b > (float)0 ? (float)1 : (float)-1);
    const float along_a = ahead_a <= (float)0 ? sign * half : ends_a ? border_a : aside_a / ahead_a;
    const float along_b = ahead_b <= (float)0 ? -sign * half : ends_b ? border_b : aside_b / ahead_b;
    const float begin = sign > (float)0 ? along_b : along_a, end = sign > (float)0 ? along_a : along_b;
    const bool crosses = is_near && half2 > (float)0 && (ahead_a > (float)0 || ahead_b > (float)0) && end > begin;
    const float length = crosses ? end - begin : (float)0;
"""
"""The chord of an edge: an end behind the receiver is at the disc's border."""

_DIRECTION = "const float dx = direction.c[0], dy = direction.c[1], dz = direction.c[2];"


@functools.cache
def silhouette_type(lanes: int) -> Any:
    """Struct of a part's silhouette for a block of receivers, and memory for it."""
    Lane, Vectors = lane_type(lanes), vectors_type(lanes)

    @wp.struct
    class Silhouette:
        points: Vectors  # of the receivers
        corners: wp.array(dtype=wp.vec3)  # [corner] of all parts
        face_planes: wp.array(dtype=wp.vec4)  # [face]
        facing: wp.array(dtype=wp.int32)  # [face] which receivers it faces, a bit for each
        numbers: wp.array(dtype=wp.int32)  # [edge]
        edges: wp.array(dtype=Lane)  # [EDGE_LANES · edge]
        adj_edges: wp.array(dtype=Lane)  # [ADJOINT_LANES · edge]
        sums: wp.array(dtype=Lane)  # [SUM_LANES]
        count: int  # edges that it has for some of the receivers
        is_solid: Lane  # 1; 0 where it encloses nothing: tiny, or a polygon from the side

    return Silhouette


class SilhouetteFunctions(NamedTuple):
    """Kernel functions on silhouettes."""

    find_silhouette: wp.Function
    find_coverage: wp.Function
    coverage_adjoint: wp.Function
    silhouette_adjoint: wp.Function


@functools.cache
def make_silhouette_functions(lanes: int) -> SilhouetteFunctions:
    """Make the kernel functions for a number of lanes."""
    Lane, Vectors, Silhouette = lane_type(lanes), vectors_type(lanes), silhouette_type(lanes)
    Coverages, fn = coverage_type(lanes), make_lane_functions(lanes)
    bits_above, is_any_above, dot_direction = fn.bits_above, fn.is_any_above, fn.dot_direction
    scale, total = fn.scale, fn.total
    STRIDE, ADJOINT_STRIDE = wp.constant(EDGE_LANES), wp.constant(ADJOINT_LANES)

    @wp.func_native(f"""
    wp::vec_t<{lanes}, float> x, y, z, signs, cosine_offset;
    for (int lane = 0; lane < {lanes}; ++lane) {{
        {_ENDS} {_NORMAL}
        const float least = (float){_MIN_EDGE_SINE**2} * (ax * ax + ay * ay + az * az) * (bx * bx + by * by + bz * bz);
        const int side = ((right >> lane) & 1) - ((left >> lane) & 1);
        const float sign = square > least ? (float)side : (float)0;
        const float scale = sign / wp::sqrt(square > least ? square : (float)1);
        x.c[lane] = sign != (float)0 ? scale * nx : (float)0;
        y.c[lane] = sign != (float)0 ? scale * ny : (float)0;
        z.c[lane] = sign != (float)0 ? scale * nz : (float)0;
        signs.c[lane] = sign;
        cosine_offset.c[lane] = sign != (float)0 ? (float)0 : (float)2;
    }}
    wp::index(edges, row) = x;
    wp::index(edges, row + 1) = y;
    wp::index(edges, row + 2) = z;
    wp::index(edges, row + 3) = signs;
    wp::index(edges, row + 4) = cosine_offset;
    """)
    def store_edge(
        points: Vectors, a: wp.vec3, b: wp.vec3, left: int, right: int, row: int, edges: wp.array(dtype=Lane)
    ):
        """Store an edge: ``left`` and ``right`` are bits of the receivers that the faces beside it face."""
        ...

    @wp.func_native(f"""
    {_DIRECTION}
    wp::vec_t<{lanes}, float> area = wp::index(sums, 0), real = wp::index(sums, 1);
    wp::vec_t<{lanes}, float> imaginary = wp::index(sums, 2), turns = wp::index(sums, 3);
    wp::vec_t<{lanes}, float> moment_x = wp::index(sums, 4), moment_y = wp::index(sums, 5);
    wp::vec_t<{lanes}, float> moment_z = wp::index(sums, 6);
    for (int lane = 0; lane < {lanes}; ++lane) {{
        {_ENDS} {_CHORD}
        const float least = distance < (float)-{MIN_DISTANCE} ? distance : (float)-{MIN_DISTANCE};
        const float d = cosine_ > (float)0 ? distance : least;  // of 0, turns by +pi
        const float x = d * d + begin * end, y = d * length;
        const float size_x = x > (float)0 ? x : -x, size_y = y > (float)0 ? y : -y;
        const float inverse = (float)1 / (size_x > size_y ? size_x : size_y);
        const float before = imaginary.c[lane];
        const float after_real = inverse * (real.c[lane] * x + before * y);
        const float after = inverse * (before * x - real.c[lane] * y);
        const float turns_down = y > (float)0 && before < (float)0 && after >= (float)0 ? (float)1 : (float)0;
        const float turns_up = y < (float)0 && before >= (float)0 && after < (float)0 ? (float)1 : (float)0;
        const float from_line = length * (radius * radius - d * d), on_line = (float)0.5 * d * length * (begin + end);
        area.c[lane] += (float)0.5 * d * length;
        moment_x.c[lane] += from_line * toward_x + on_line * tx;
        moment_y.c[lane] += from_line * toward_y + on_line * ty;
        moment_z.c[lane] += from_line * toward_z + on_line * tz;
        real.c[lane] = crosses ? after_real : real.c[lane];
        imaginary.c[lane] = crosses ? after : before;
        turns.c[lane] += crosses ? turns_up - turns_down : (float)0;
    }}
    wp::index(sums, 0) = area;
    wp::index(sums, 1) = real;
    wp::index(sums, 2) = imaginary;
    wp::index(sums, 3) = turns;
    wp::index(sums, 4) = moment_x;
    wp::index(sums, 5) = moment_y;
    wp::index(sums, 6) = moment_z;
    """)
    def add_chord(
        points: Vectors,
        a: wp.vec3,
        b: wp.vec3,
        cosine: Lane,
        direction: wp.vec3,
        radius: float,
        row: int,
        edges: wp.array(dtype=Lane),
        sums: wp.array(dtype=Lane),
    ):
        """Add the chord of an edge to the sums."""
        ...

    @wp.func_native(f"""
    const float pi = (float){wp.pi!r};
    const float per_moment = (float)1 / ((float)3 * pi * radius * radius * radius);
    wp::vec_t<{lanes}, float> cell_share;
    for (int lane = 0; lane < {lanes}; ++lane) {{
        const float cosine = nearest.c[lane], x = wp::index(sums, 1).c[lane], y = wp::index(sums, 2).c[lane];
        {ANGLE}
        const float sector = (float)0.5 * radius * radius * (angle + (float)2 * pi * wp::index(sums, 3).c[lane]);
        const float part = (wp::index(sums, 0).c[lane] + sector) / (pi * radius * radius);
        const float sum = (cosine > (float)0 ? (float)1 : (float)0) + part;
        const float within = sum < (float)0 ? (float)0 : sum > (float)1 ? (float)1 : sum;
        const float covered = cosine >= radius ? (float)1 : cosine > -radius ? within : (float)0;
        cell_share.c[lane] = is_solid.c[lane] * covered;
    }}
    for (int lane = 0; lane < {lanes}; ++lane) {{
        const bool crosses = nearest.c[lane] < radius && cell_share.c[lane] > (float)0;
        const float factor = crosses ? per_moment : (float)0;
        wp::index(sums, 4).c[lane] *= factor;
        wp::index(sums, 5).c[lane] *= factor;
        wp::index(sums, 6).c[lane] *= factor;
    }}
    return cell_share;
    """)
    def finish_sums(nearest: Lane, is_solid: Lane, sums: wp.array(dtype=Lane), radius: float) -> Lane:  # type: ignore[empty-body, valid-type]
        """Share of a cell; its moment replaces the sum."""
        ...

    @wp.func_native(f"""
    {_DIRECTION}
    const float per_area = (float)1 / ((float){wp.pi!r} * radius * radius), per_moment = per_area / radius;
    wp::vec_t<{lanes}, float> sum_x = wp::index(gradients, first), sum_y = wp::index(gradients, first + 1);
    wp::vec_t<{lanes}, float> sum_z = wp::index(gradients, first + 2);
    for (int lane = 0; lane < {lanes}; ++lane) {{
        {_ENDS} {_CHORD}
        const float adj_x = per_moment * adj.moment.x.c[lane], adj_y = per_moment * adj.moment.y.c[lane];
        const float adj_z = per_moment * adj.moment.z.c[lane];
        const float foot_x = -distance * toward_x, foot_y = -distance * toward_y, foot_z = -distance * toward_z;
        // the integral of (at_foot + s slope) (direction + foot + s t) ds
        const float at_foot = per_area * adj.cell_share.c[lane] + adj_x * foot_x + adj_y * foot_y + adj_z * foot_z;
        const float slope = adj_x * tx + adj_y * ty + adj_z * tz;
        const float by_first = crosses ? (float)0.5 * (begin + end) * length : (float)0;
        const float cubes = (begin * begin + begin * end + end * end) / (float)3;
        const float by_second = crosses ? cubes * length : (float)0;
        const float along_foot = scale * (at_foot * length + slope * by_first);
        const float along_line = scale * (at_foot * by_first + slope * by_second);
        sum_x.c[lane] += along_foot * (dx + foot_x) + along_line * tx;
        sum_y.c[lane] += along_foot * (dy + foot_y) + along_line * ty;
        sum_z.c[lane] += along_foot * (dz + foot_z) + along_line * tz;
    }}
    wp::index(gradients, first) = sum_x;
    wp::index(gradients, first + 1) = sum_y;
    wp::index(gradients, first + 2) = sum_z;
    """)
    def add_chord_adjoint(
        points: Vectors,
        a: wp.vec3,
        b: wp.vec3,
        cosine: Lane,
        direction: wp.vec3,
        radius: float,
        adj: Coverages,
        row: int,
        edges: wp.array(dtype=Lane),
        first: int,
        gradients: wp.array(dtype=Lane),
    ):
        """Add to the gradient of an edge's normal, times its length."""
        ...

    @wp.func_native(f"""
    for (int lane = 0; lane < {lanes}; ++lane) {{
        {_ENDS} {_NORMAL}
        const float sign = wp::index(edges, row + 3).c[lane];
        const float scale = sign / wp::sqrt(sign != (float)0 ? square : (float)1);
        const float x = scale * wp::index(gradients, first).c[lane];
        const float y = scale * wp::index(gradients, first + 1).c[lane];
        const float z = scale * wp::index(gradients, first + 2).c[lane];
        wp::index(gradients, first).c[lane] = by * z - bz * y;
        wp::index(gradients, first + 1).c[lane] = bz * x - bx * z;
        wp::index(gradients, first + 2).c[lane] = bx * y - by * x;
        wp::index(gradients, first + 3).c[lane] = y * az - z * ay;
        wp::index(gradients, first + 4).c[lane] = z * ax - x * az;
        wp::index(gradients, first + 5).c[lane] = x * ay - y * ax;
    }}
    """)
    def ends_adjoint(
        points: Vectors,
        a: wp.vec3,
        b: wp.vec3,
        row: int,
        edges: wp.array(dtype=Lane),
        first: int,
        gradients: wp.array(dtype=Lane),
    ):
        """Replace the gradient of an edge's normal by gradients of its ends."""
        ...

    @wp.func(inline=True)
    def edge_cosine(silhouette: Silhouette, k: int, direction: wp.vec3):
        """m·ω of an edge; 2 where it is not on the silhouette."""
        row = STRIDE * k
        normal = Vectors(silhouette.edges[row], silhouette.edges[row + 1], silhouette.edges[row + 2])
        return dot_direction(direction, normal) + silhouette.edges[row + 4]

    @wp.func
    def find_silhouette(parts: ConvexArrays, part: int, silhouette: Silhouette):
        """Store a part's silhouette; return its ``count`` and ``is_solid``: the struct would take 47 registers more."""
        first_face = parts.first_face[part]
        face_count = parts.first_face[part + 1] - first_face
        outside = int(0)
        for face in range(face_count):
            face_plane = silhouette.face_planes[first_face + face]
            height = dot_direction(wp.vec3(face_plane[0], face_plane[1], face_plane[2]), silhouette.points) - Lane(
                face_plane[3]
            )
            bits = bits_above(height, 0.0)
            silhouette.facing[face] = bits
            outside = outside | bits
        count = int(0)
        edge_counts = Lane(0.0)
        for e in range(parts.first_edge[part], parts.first_edge[part + 1]):
            edge = parts.edges[e]
            left = silhouette.facing[edge[2]]
            right = silhouette.facing[edge[3]]
            if left != right:
                a, b = silhouette.corners[edge[0]], silhouette.corners[edge[1]]
                store_edge(silhouette.points, a, b, left, right, STRIDE * count, silhouette.edges)
                silhouette.numbers[count] = e
                sign = silhouette.edges[STRIDE * count + 3]
                edge_counts += wp.cw_mul(sign, sign)
                count += 1
        is_solid = wp.min(wp.max(edge_counts - Lane(2.0), Lane(0.0)), Lane(1.0))  # fewer edges enclose nothing
        if face_count > 2:
            for lane in range(lanes):
                if ((outside >> lane) & 1) == 0:  # the receiver is inside
                    is_solid[lane] = 1.0
        return count, is_solid

    @wp.func
    def find_coverage(parts: ConvexArrays, silhouette: Silhouette, direction: wp.vec3, radius: float):
        """Coverage of a cell by a silhouette."""
        nearest = Lane(radius)
        for k in range(silhouette.count):
            nearest = wp.min(nearest, edge_cosine(silhouette, k, direction))
            if not is_any_above(nearest, -radius):
                return Coverages()
        for i in range(wp.static(SUM_LANES)):
            silhouette.sums[i] = Lane(0.0)
        silhouette.sums[1] = Lane(1.0)
        if is_any_above(-nearest, -radius):
            for k in range(silhouette.count):
                cosine = edge_cosine(silhouette, k, direction)
                if is_any_above(-wp.max(cosine, -cosine), -radius):
                    edge = parts.edges[silhouette.numbers[k]]
                    a, b = silhouette.corners[edge[0]], silhouette.corners[edge[1]]
                    edges, sums = silhouette.edges, silhouette.sums
                    add_chord(silhouette.points, a, b, cosine, direction, radius, STRIDE * k, edges, sums)
        cell_share = finish_sums(nearest, silhouette.is_solid, silhouette.sums, radius)
        return Coverages(cell_share, Vectors(silhouette.sums[4], silhouette.sums[5], silhouette.sums[6]))

    @wp.func
    def coverage_adjoint(
        parts: ConvexArrays, silhouette: Silhouette, direction: wp.vec3, radius: float, adj: Coverages
    ):
        """Add to the gradients of the edges' normals."""
        adj_where_solid = Coverages(
            wp.cw_mul(silhouette.is_solid, adj.cell_share), scale(silhouette.is_solid, adj.moment)
        )
        for k in range(silhouette.count):
            cosine = edge_cosine(silhouette, k, direction)
            if is_any_above(-wp.max(cosine, -cosine), -radius):
                edge = parts.edges[silhouette.numbers[k]]
                a, b = silhouette.corners[edge[0]], silhouette.corners[edge[1]]
                points, edges, adj_edges = silhouette.points, silhouette.edges, silhouette.adj_edges
                row, adj_row = STRIDE * k, ADJOINT_STRIDE * k
                add_chord_adjoint(
                    points, a, b, cosine, direction, radius, adj_where_solid, row, edges, adj_row, adj_edges
                )

    @wp.func
    def silhouette_adjoint(
        parts: ConvexArrays, silhouette: Silhouette, instance: int, adj_corners: wp.array2d(dtype=wp.vec3)
    ):
        """Add to the gradients of corners; returns the receivers' gradients."""
        adj_points = Vectors()
        for k in range(silhouette.count):
            edge = parts.edges[silhouette.numbers[k]]
            row = ADJOINT_STRIDE * k
            a, b = silhouette.corners[edge[0]], silhouette.corners[edge[1]]
            ends_adjoint(silhouette.points, a, b, STRIDE * k, silhouette.edges, row, silhouette.adj_edges)
            for end in range(2):
                x = silhouette.adj_edges[row + 3 * end]
                y = silhouette.adj_edges[row + 3 * end + 1]
                z = silhouette.adj_edges[row + 3 * end + 2]
                adj_points = Vectors(adj_points.x - x, adj_points.y - y, adj_points.z - z)
                if adj_corners:
                    wp.atomic_add(adj_corners, instance, edge[end], wp.vec3(total(x), total(y), total(z)))
        return adj_points

    return SilhouetteFunctions(find_silhouette, find_coverage, coverage_adjoint, silhouette_adjoint)
