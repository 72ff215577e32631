"""Packets: sixteen rays from one receiver, that go through a hierarchy of a mesh's faces together.

A thread visits a box, or a face, once for all rays of a packet, each of which has a lane
(:mod:`warpshadow.device.lanes`). As all start at one point, a face is the same three planes for each: a lane takes
three dot products. They hit the same faces as single rays (:mod:`.ray_tracing`).

Sixteen of 4096 even rays take 1.8 µs on a bunny of 12 200 faces, for 66 boxes and 24 faces. The first faces that rays
meet take a fourth of the time of single rays on a bunny, a seventh on a shelf.

The hierarchy is a complete binary tree of boxes, numbered as a heap: box i is that of boxes 2i and 2i + 1, and box 1 of
all. It splits faces at the median along the longest extent of their middles.
"""

import functools

import numpy as np
import warp as wp

from warpshadow.device.lanes import vectors_type
from warpshadow.maths.directions import CHUNK
from warpshadow.stages.rays.ray_tracing import MIN_HIT_HEIGHT, ROUNDING, WALL_COSINE

PACKET = CHUNK  # rays of a packet
_ALL_RAYS = wp.constant((1 << PACKET) - 1)  # their bits

Hits = wp.types.vector(length=PACKET, dtype=wp.int32)
"""First face that each ray of a packet meets: 2 face + 1 for its back, the face numbered as in the tree.

−1 for no face, and for the one that the receiver lies on."""

_LEAF = 4  # faces of a leaf at most

_SLACK = 2.0**-20
"""Margin of leaves around their faces, as a share of their largest coordinate: points lie on faces to rounding.

Of the largest of all faces it would be too far: an infinite ground's reach 10⁵ times as far as the bodies on it."""


@wp.struct
class FaceTree:
    """A mesh's faces and the boxes around them."""

    corners: wp.array2d(dtype=wp.vec3)  # [face, 3], by leaves
    face_ids: wp.array(dtype=wp.int32)  # number of each in the mesh, [face]
    lowers: wp.array(dtype=wp.vec3)  # [box]; box 0 is none
    uppers: wp.array(dtype=wp.vec3)  # [box]
    axes: wp.array(dtype=wp.int32)  # along which each is split, [box]
    leaf_count: int


def build_face_tree(positions: np.ndarray, faces: np.ndarray, device: wp.DeviceLike = None) -> FaceTree:
    """Build the hierarchy of a mesh.

    Args:
        positions: Vertices [vertex, 3].
        faces: Indices of vertices [face, 3].
    """
    corners = np.asarray(positions, np.float32)[np.asarray(faces)]
    face_count, depth = len(corners), max(int(np.ceil(np.log2(max(len(corners), 1) / _LEAF))), 0)
    # [3, face]
    lower_corners, upper_corners = (np.ascontiguousarray(end(corners, axis=1).T) for end in (np.min, np.max))
    centers, permutation = (lower_corners + upper_corners) / 2, np.arange(face_count)
    axes = np.zeros(1 << depth, np.int32)
    for level in range(depth):
        bounds, halves = _bounds(face_count, level), _bounds(face_count, level + 1)[1::2]
        leaf_lowers, leaf_uppers = (end.reduceat(centers, bounds[:-1], axis=1) for end in (np.minimum, np.maximum))
        longest_axis = np.argmax(leaf_uppers - leaf_lowers, axis=0)
        axes[1 << level : 2 << level] = longest_axis
        sizes = np.stack([np.diff(bounds), halves - bounds[:-1]], axis=1)  # faces, and those of the first half
        for size, half in np.unique(sizes, axis=0):
            boxes = np.flatnonzero((sizes == (size, half)).all(axis=1))
            face_positions = bounds[boxes, None] + np.arange(size)
            partitioned = np.argpartition(centers[longest_axis[boxes, None], face_positions], half, axis=1)
            partitioned += bounds[boxes, None]
            permutation[face_positions], centers[:, face_positions] = permutation[partitioned], centers[:, partitioned]
    corners, leaf_count = corners[permutation], 1 << depth
    lowers, uppers = np.zeros((2, 2 * leaf_count, 3), np.float32)
    if face_count:
        starts = _bounds(face_count, depth)[:-1]
        leaf_lowers = np.minimum.reduceat(lower_corners[:, permutation], starts, axis=1).T
        leaf_uppers = np.maximum.reduceat(upper_corners[:, permutation], starts, axis=1).T
        slack = np.float32(_SLACK) * np.maximum(-leaf_lowers, leaf_uppers).max(axis=1, keepdims=True)
        lowers[leaf_count:], uppers[leaf_count:] = leaf_lowers - slack, leaf_uppers + slack
    for level in reversed(range(depth)):
        parents, children = slice(1 << level, 2 << level), slice(2 << level, 4 << level)
        lowers[parents] = lowers[children].reshape(-1, 2, 3).min(axis=1)
        uppers[parents] = uppers[children].reshape(-1, 2, 3).max(axis=1)
    tree = FaceTree()
    tree.corners, tree.lowers, tree.uppers = (
        wp.array(values, dtype=wp.vec3, device=device) for values in (corners.reshape(-1, 3, 3), lowers, uppers)
    )
    tree.face_ids = wp.array(permutation, dtype=wp.int32, device=device)
    tree.axes = wp.array(axes, dtype=wp.int32, device=device)
    tree.leaf_count = leaf_count
    return tree


def packets_of(directions: np.ndarray) -> np.ndarray:
    """Lanes of x, y and z of each packet, [packet, 3, 16], of directions [direction, 3], a multiple of 16."""
    return np.ascontiguousarray(directions.reshape(-1, PACKET, 3).swapaxes(1, 2))


def _bounds(count: int, level: int) -> np.ndarray:
    """First face of each box of a level, and the end; counts of faces differ by at most one."""
    return np.arange((1 << level) + 1) * count >> level


_STOP_RAY = """
            is_blocked |= is_met & (reach[lane] > 0.0f);
            reach[lane] = is_met ? 0.0f : reach[lane];
            is_left_now |= reach[lane] > 0.0f;
"""

_SHORTEN_RAY = """
            const float distance = height / (e + f + g);
            const bool is_nearer = is_met & (distance < reach[lane]);
            reach[lane] = is_nearer ? distance : reach[lane];
            hits[lane] = is_nearer ? hit : hits[lane];
            is_left_now = true;
"""


def _make_traverse(meet_face: str, result: str, result_type: type) -> wp.Function:
    """Make the kernel function that sends a packet through a tree, through the near half of each box first.

    Args:
        meet_face: C++ for a face and a lane, whose ray ends there, or reaches only that far, if it meets it.
        result: C++ that returns the rays that left, or the faces found.
    """
    Vectors = vectors_type(PACKET)

    # In plain Warp, which copies lanes at every call, it takes eight times as long.
    # A face that the receiver lies on is moved down as by `ray_tracing._face_from_receiver`.
    @wp.func_native(f"""
    const int face_count = corners.shape[0];
    float x[{PACKET}], y[{PACKET}], z[{PACKET}], a[{PACKET}], b[{PACKET}], c[{PACKET}], reach[{PACKET}];
    int hits[{PACKET}];
    for (int lane = 0; lane < {PACKET}; ++lane) {{
        x[lane] = ray_directions.x.c[lane];
        y[lane] = ray_directions.y.c[lane];
        z[lane] = ray_directions.z.c[lane];
        a[lane] = 1.0f / (x[lane] == 0.0f ? 1.0e-20f : x[lane]);
        b[lane] = 1.0f / (y[lane] == 0.0f ? 1.0e-20f : y[lane]);
        c[lane] = 1.0f / (z[lane] == 0.0f ? 1.0e-20f : z[lane]);
        reach[lane] = (facing_rays >> lane) & 1 ? 3.0e38f : 0.0f;
        hits[lane] = -1;
    }}
    const int near_half[3] = {{x[0] + x[8] < 0.0f, y[0] + y[8] < 0.0f, z[0] + z[8] < 0.0f}};
    bool is_left = facing_rays != 0;
    // whether all rays pass a face on whose plane the receiver does not lie: float32 tells where none is near an edge
    auto passes_by = [&](const wp::vec3 *corner) {{
        const wp::vec3 p = corner[0] - point, q = corner[1] - point, r = corner[2] - point;
        const wp::vec3 first = corner[1] - corner[0], second = corner[2] - corner[0], across = wp::cross(first, second);
        const float size2 = wp::max(wp::dot(p, p), wp::max(wp::dot(q, q), wp::dot(r, r))), size = wp::sqrt(size2);
        const float edge2 = wp::max(wp::dot(first, first), wp::dot(second, second));
        const float bound = wp::length(across) * (wp::length(point) + 2.0f * size) + edge2 * size;
        if (wp::abs(wp::dot(across, p)) <= 2.0f * {ROUNDING}f * bound)
            return false;
        const wp::vec3 u = wp::cross(r, q), v = wp::cross(p, r), w = wp::cross(q, p);
        const float slack = 4.0e-6f * size2;
        bool is_near = false;
        for (int lane = 0; lane < {PACKET}; ++lane) {{
            const float e = u[0] * x[lane] + u[1] * y[lane] + u[2] * z[lane];
            const float f = v[0] * x[lane] + v[1] * y[lane] + v[2] * z[lane];
            const float g = w[0] * x[lane] + w[1] * y[lane] + w[2] * z[lane];
            const float least = wp::min(e, wp::min(f, g)), most = wp::max(e, wp::max(f, g));
            is_near |= ((least >= -slack) | (most <= slack)) & (reach[lane] > 0.0f);
        }}
        return !is_near;
    }};
    auto meet = [&](int face) {{
        const wp::vec3 *corner = &wp::index(corners, face, 0);
        const float top = wp::max(wp::dot(normal, corner[0] - point),
                                  wp::max(wp::dot(normal, corner[1] - point), wp::dot(normal, corner[2] - point)));
        if (top <= 0.0f)
            return;
        if (passes_by(corner))
            return;
        wp::vec3d p, q, r;
        for (int k = 0; k < 3; ++k) {{
            p[k] = (double)(corner[0][k]) - point[k];
            q[k] = (double)(corner[1][k]) - point[k];
            r[k] = (double)(corner[2][k]) - point[k];
        }}
        wp::vec3d across = wp::cross(q - p, r - p);
        double drop = wp::dot(across, p), size = 0.0;
        bool is_on_face = false;
        for (int k = 0; k < 3; ++k)
            size += wp::abs(across[k]) * wp::max(wp::max(wp::abs(corner[0][k]), wp::abs(corner[1][k])),
                                                 wp::max(wp::abs(corner[2][k]), wp::abs(point[k])));
        if (wp::abs(drop) <= {ROUNDING} * size) {{
            const double length = wp::length(across);
            const double upward = across[0] * normal[0] + across[1] * normal[1] + across[2] * normal[2];
            const double height = upward < -{WALL_COSINE} * length ? -{MIN_HIT_HEIGHT} : {MIN_HIT_HEIGHT};
            const wp::vec3d move = wp::mul(across, (drop / length + height * wp::sqrt(length)) / length);
            is_on_face = wp::abs(upward) >= {WALL_COSINE} * length;
            p -= move;
            q -= move;
            r -= move;
            drop = wp::dot(across, p);
        }}
        if (!(drop < 0.0 || drop > 0.0))
            return;
        if (drop > 0.0) {{
            const wp::vec3d swapped = q;
            q = r;
            r = swapped;
        }}
        const wp::vec3 u(wp::cross(r, q)), v(wp::cross(p, r)), w(wp::cross(q, p));
        const float height = (float)wp::abs(drop);
        const int hit = is_on_face ? -1 : 2 * face + (drop > 0.0 ? 1 : 0);
        bool is_left_now = false, is_blocked = false;
        for (int lane = 0; lane < {PACKET}; ++lane) {{
            const float e = u[0] * x[lane] + u[1] * y[lane] + u[2] * z[lane];
            const float f = v[0] * x[lane] + v[1] * y[lane] + v[2] * z[lane];
            const float g = w[0] * x[lane] + w[1] * y[lane] + w[2] * z[lane];
            const bool is_met = (e >= 0.0f) & (f >= 0.0f) & (g >= 0.0f) & (e + f + g > 0.0f);
            {meet_face}
        }}
        is_left = is_left_now;
        if (is_blocked)
            last_face = face;
    }};
    if (last_face >= 0 && is_left)
        meet(last_face);
    for (int box = is_left ? 1 : 0; box > 0;) {{
        const wp::vec3 lower = wp::index(lowers, box) - point, upper = wp::index(uppers, box) - point;
        bool is_met = false;
        for (int lane = 0; lane < {PACKET}; ++lane) {{
            const float x0 = lower[0] * a[lane], x1 = upper[0] * a[lane];
            const float y0 = lower[1] * b[lane], y1 = upper[1] * b[lane];
            const float z0 = lower[2] * c[lane], z1 = upper[2] * c[lane];
            const float x2 = x0 < x1 ? x0 : x1, x3 = x0 < x1 ? x1 : x0;
            const float y2 = y0 < y1 ? y0 : y1, y3 = y0 < y1 ? y1 : y0;
            const float z2 = z0 < z1 ? z0 : z1, z3 = z0 < z1 ? z1 : z0;
            const float xy2 = x2 > y2 ? x2 : y2, xy3 = x3 < y3 ? x3 : y3;
            const float near = xy2 > z2 ? xy2 : z2, far = xy3 < z3 ? xy3 : z3;
            is_met |= (near <= far) & (far >= 0.0f) & (near < reach[lane]) & (reach[lane] > 0.0f);
        }}
        if (is_met && box >= leaf_count) {{
            const long long leaf = box - leaf_count;
            const long long end = (leaf + 1) * face_count / leaf_count;
            for (long long face = leaf * face_count / leaf_count; face < end && is_left; ++face)
                meet((int)face);
            if (!is_left)
                break;
        }}
        if (is_met && box < leaf_count)
            box = 2 * box + near_half[wp::index(axes, box)];
        else {{
            while (box > 1 && box % 2 != near_half[wp::index(axes, box / 2)])
                box /= 2;
            if (box == 1)
                break;
            box ^= 1;
        }}
    }}
    {result}
    """)
    def traverse(  # type: ignore[empty-body]
        corners: wp.array2d(dtype=wp.vec3),
        lowers: wp.array(dtype=wp.vec3),
        uppers: wp.array(dtype=wp.vec3),
        axes: wp.array(dtype=wp.int32),
        leaf_count: int,
        point: wp.vec3,
        normal: wp.vec3,
        ray_directions: Vectors,
        facing_rays: wp.int32,
        last_face: int,
    ) -> result_type:
        """The fields of a tree, a receiver, the rays, bits of rays to trace, a face that is met first; −1 for none."""
        ...

    return traverse


@functools.cache
def make_find_open() -> wp.Function:
    """Make the kernel function that finds which rays of a packet meet no face of a tree."""
    Vectors = vectors_type(PACKET)
    find_bits = f"""
    unsigned found = 0;
    for (int lane = 0; lane < {PACKET}; ++lane)
        found |= reach[lane] > 0.0f ? 1u << lane : 0u;
    return wp::vec_t<2, int>((int)found, last_face);
    """
    traverse = _make_traverse(_STOP_RAY, find_bits, wp.vec2i)

    @wp.func
    def find_open(
        tree: FaceTree, point: wp.vec3, normal: wp.vec3, ray_directions: Vectors, facing_rays: int, last_face: int
    ):
        """Find which rays of a packet meet no face.

        Args:
            point, normal: The receiver; none of these rays goes below its horizon.
            facing_rays: Bits of the rays to trace, which are above the horizon.
            last_face: A face that is likely to block them, −1 for none.
        Returns:
            Bits of the rays that escape; and a face that blocked some, or ``last_face``.
        """
        open_and_face = wp.vec2i(0, last_face)
        if facing_rays != 0:
            open_and_face = traverse(
                tree.corners,
                tree.lowers,
                tree.uppers,
                tree.axes,
                tree.leaf_count,
                point,
                normal,
                ray_directions,
                facing_rays,
                last_face,
            )
        return open_and_face[0], open_and_face[1]

    return find_open


@functools.cache
def make_find_first() -> wp.Function:
    """Make the kernel function that finds the face of a tree that each ray of a packet meets first."""
    Vectors = vectors_type(PACKET)
    find_hits = f"""
    wp::vec_t<{PACKET}, int> found;
    for (int lane = 0; lane < {PACKET}; ++lane)
        found[lane] = hits[lane];
    return found;
    """
    traverse = _make_traverse(_SHORTEN_RAY, find_hits, Hits)

    @wp.func
    def find_first(tree: FaceTree, point: wp.vec3, normal: wp.vec3, ray_directions: Vectors):
        """Find the faces that the rays of a packet meet first, :data:`Hits`.

        Args:
            tree: The faces.
            point, normal: The receiver; no ray goes below its horizon.
            ray_directions: Directions of the rays.
        """
        return traverse(
            tree.corners,
            tree.lowers,
            tree.uppers,
            tree.axes,
            tree.leaf_count,
            point,
            normal,
            ray_directions,
            _ALL_RAYS,
            -1,
        )

    return find_first
