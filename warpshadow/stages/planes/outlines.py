"""The share of a footprint that a mesh with holes takes, or one that is no rectangle.

The footprint of a cell is the ellipse around y with semi-axes t ρ across the direction and t ρ √(1 + |s|²) along it,
s = (ω_u, ω_v) / c′ (:mod:`.cells`). Points p of the plane become

    w(p) = (I + k s sᵀ) (p − y) / (t ρ),  k = −1 / (r + r²),  r = √(1 + |s|²)

which makes it the disc of radius 1. Edges of the mesh's outline from a to b, with the mesh to their left, pass the
middle of the disc at a distance d, positive where the middle is to their left, and run in the disc from s₀ to s₁. So

    π h = π n + ½ Σ_edges d (s₁ − s₀) − sign(d) atan2(|d| (s₁ − s₀), d² + s₀ s₁)

is the area of the disc that the mesh takes, n how often the outline winds around its middle. As the edges move, it
grows by what they sweep.
"""

import warp as wp


@wp.struct
class Ellipse:
    """The footprint of a cell."""

    center: wp.vec2  # y
    slope: wp.vec2  # s
    per_size: float  # 1 / (t ρ)
    shrinking: float  # k


@wp.func
def find_ellipse(center: wp.vec2, slope: wp.vec2, size: float):
    """Find a footprint, ``size`` t ρ across."""
    r = wp.sqrt(1.0 + wp.dot(slope, slope))
    ellipse = Ellipse()
    ellipse.center = center
    ellipse.slope = slope
    ellipse.per_size = 1.0 / size
    ellipse.shrinking = -1.0 / (r + r * r)
    return ellipse


@wp.func
def _in_disc(ellipse: Ellipse, x: float, y: float):
    """A point of the plane where the ellipse is a disc."""
    offset = wp.vec2(x, y) - ellipse.center
    return ellipse.per_size * (offset + (ellipse.shrinking * wp.dot(ellipse.slope, offset)) * ellipse.slope)


@wp.struct
class DiscEdge:
    """An edge of the outline where the ellipse is a disc."""

    is_left: wp.bool  # whether the middle of the disc is to its left
    winding: int  # how often it winds around the middle: 1, 0 or −1
    distance: float  # d
    begin: float  # s₀
    end: float  # s₁, not above s₀ outside the disc
    along: wp.vec2  # unit vector
    first: float  # where the edge itself begins
    length: float


@wp.func
def _find_edge(ellipse: Ellipse, ends: wp.vec4):
    """Find an edge in the disc."""
    a = _in_disc(ellipse, ends[0], ends[1])
    b = _in_disc(ellipse, ends[2], ends[3])
    edge = DiscEdge()
    cross = a[0] * b[1] - a[1] * b[0]
    edge.is_left = cross > 0.0 or (cross == 0.0 and b[0] > a[0])
    if a[1] <= 0.0 and b[1] > 0.0 and edge.is_left:
        edge.winding = 1
    if b[1] <= 0.0 and a[1] > 0.0 and not edge.is_left:
        edge.winding = -1
    edge.length = wp.length(b - a)
    if wp.abs(cross) < edge.length:
        edge.along = (b - a) / edge.length
        edge.distance = cross / edge.length
        half = wp.sqrt(1.0 - edge.distance * edge.distance)
        edge.first = wp.dot(a, edge.along)
        edge.begin = wp.max(edge.first, -half)
        edge.end = wp.min(wp.dot(b, edge.along), half)
    return edge


@wp.func
def share_in_outline(edges: wp.array(dtype=wp.vec4), first: int, count: int, ellipse: Ellipse):
    """Share of a footprint, h, in an outline of ``count`` edges from ``first`` on; that of holes alone is negative."""
    winding = int(0)
    area = float(0.0)
    for e in range(first, first + count):
        edge = _find_edge(ellipse, edges[e])
        winding += edge.winding
        length = edge.end - edge.begin
        if length > 0.0:
            d = edge.distance
            angle = wp.atan2(wp.abs(d) * length, d * d + edge.begin * edge.end)
            area += 0.5 * (d * length - wp.where(edge.is_left, angle, -angle))
    return float(winding) + area / wp.pi


@wp.struct
class EllipseGradient:
    """Gradients of a footprint."""

    center: wp.vec2
    slope: wp.vec2
    log_size: float  # of the logarithm of t ρ


@wp.func
def share_in_outline_adjoint(edges: wp.array(dtype=wp.vec4), first: int, count: int, ellipse: Ellipse, adj: float):
    """Gradients of :func:`share_in_outline`."""
    result = EllipseGradient()
    s = ellipse.slope
    adj_shrinking = float(0.0)
    for e in range(first, first + count):
        ends = edges[e]
        edge = _find_edge(ellipse, ends)
        length = edge.end - edge.begin
        if length > 0.0:
            outward = wp.vec2(edge.along[1], -edge.along[0])
            pull = (adj * length / wp.pi) * outward
            middle_at = 0.5 * (edge.begin + edge.end)
            part = (middle_at - edge.first) / edge.length
            middle = wp.vec2(ends[0] + part * (ends[2] - ends[0]), ends[1] + part * (ends[3] - ends[1]))
            offset = middle - ellipse.center
            of_pull, of_offset = wp.dot(s, pull), wp.dot(s, offset)
            result.center -= ellipse.per_size * (pull + (ellipse.shrinking * of_pull) * s)
            result.slope += (ellipse.per_size * ellipse.shrinking) * (of_pull * offset + of_offset * pull)
            result.log_size -= wp.dot(pull, edge.distance * outward + middle_at * edge.along)
            adj_shrinking += ellipse.per_size * of_pull * of_offset
    r = wp.sqrt(1.0 + wp.dot(s, s))
    scale = adj_shrinking * (1.0 + 2.0 * r) * ellipse.shrinking * ellipse.shrinking / r
    result.slope += scale * s
    return result
