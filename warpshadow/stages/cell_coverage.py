"""Cell coverage: the share of a cell of directions that lies within the outline of a shape, where in it, and gradients.

A cell is a disc of radius ρ around its direction ω, in the plane that touches the sphere of directions there. The plane
through a receiver x and an edge of the outline from a to b, n = (a − x) × (b − x) towards the shape, cuts the touching
plane in a line. Its signed distance from ω, positive where the shape is, and where along it the edge runs, from s₀ to
s₁ within the disc, are

    d = m·ω / √(1 − (m·ω)²),  m = n / |n|,  s = (a − x)·t / (a − x)·ω,  t = ω × m / |ω × m|

and the area of the disc inside the outline is that of the whole disc, as often as the outline winds around ω, and a
term for each edge that crosses the disc, the area between the edge and the disc's border:

    π ρ² h = π ρ² w + ½ Σ_edges d (s₁ − s₀) − ρ² sign(d) atan2(|d| (s₁ − s₀), d² + s₀ s₁)

The angles together are that of the product of complex numbers d² + s₀ s₁ − i d (s₁ − s₀), and a turn each time that it
crosses the negative axis: one arc tangent for a cell, not one for an edge, saves 12 to 20% of the time.

Where in the cell the shape is, its first moment says, by Green's theorem, with n̂ the unit vector from the line to ω:

    π ρ³ μ = ∫ y dA = ⅓ Σ_edges (s₁ − s₀) ((ρ² − d²) n̂ + ½ d (s₀ + s₁) t)

As a line moves by δ(s), the area grows by ∫ δ ds between s₀ and s₁, and the moment by ∫ y δ ds, where

    y = −d n̂ + s t,  δ = ∂n·(ω + y) / (|n| √(1 − (m·ω)²))

Where a corner is nearer to ω than some 1e-6, rounding decides how its edges
share the disc. Shapes that meet at an edge share the cells there without a remainder: edges are exact.
"""

import warp as wp

LEAST_DISTANCE = 1.0e-12
"""The least distance of an edge from ω."""


@wp.struct
class ViewedEdge:
    """An edge of an outline as a receiver sees it; along it the shape is on the side of n."""

    normal: wp.vec3  # m
    begin: wp.vec3  # a − x
    end: wp.vec3  # b − x
    length: float  # |n|, by which the gradient of n is divided
    adj_normal: wp.vec3  # gradient of n, times its length


@wp.func
def viewed_edge(begin: wp.vec3, end: wp.vec3, n: wp.vec3):
    """An edge between two points relative to the receiver, by a normal of any length but 0 towards the shape."""
    edge = ViewedEdge()
    edge.length = wp.length(n)
    edge.normal = (1.0 / edge.length) * n
    edge.begin = begin
    edge.end = end
    return edge


@wp.struct
class Chord:
    """Part of an edge that is seen within a cell, in the plane that touches the sphere of directions there."""

    distance: float  # d, of the line from the middle of the cell
    begin: float  # s₀
    end: float  # s₁
    tangent: wp.vec3  # t
    scale: float  # 1/√(1 − (m·ω)²), of the angle between ω and the normal


@wp.func
def _along_line(end: wp.vec3, axis: wp.vec3, direction: wp.vec3, half: float, behind: float):
    """Where an end of an edge lies on its line, up to the disc's border; ``behind`` if it is behind the receiver."""
    ahead = wp.dot(end, direction)
    if ahead <= 0.0:
        return behind
    aside = wp.dot(end, axis)
    if ahead * half <= wp.abs(aside):
        return wp.where(aside > 0.0, half, -half)
    return aside / ahead


@wp.func
def _find_chord(edges: wp.array(dtype=ViewedEdge), e: int, cosine: float, direction: wp.vec3, radius: float):
    """Find the chord of an edge, m·ω = ``cosine``."""
    chord = Chord()
    chord.scale = 1.0 / wp.sqrt(wp.max(0.0, 1.0 - cosine * cosine))
    chord.distance = cosine * chord.scale
    half2 = radius * radius - chord.distance * chord.distance
    a = edges[e].begin
    b = edges[e].end
    if half2 > 0.0 and (wp.dot(a, direction) > 0.0 or wp.dot(b, direction) > 0.0):
        half = wp.sqrt(half2)
        chord.tangent = chord.scale * wp.cross(direction, edges[e].normal)
        chord.begin = _along_line(b, chord.tangent, direction, half, -half)
        chord.end = _along_line(a, chord.tangent, direction, half, half)
    return chord


@wp.func
def _toward_shape(edge: ViewedEdge, cosine: float, direction: wp.vec3, chord: Chord):
    """Unit vector n̂ from an edge's line towards the shape, in the plane that touches the sphere of directions."""
    return chord.scale * (edge.normal - cosine * direction)


@wp.func
def _coverage_past_edges(edges: wp.array(dtype=ViewedEdge), first: int, count: int, direction: wp.vec3, radius: float):
    """Share of a cell between its edges and its border, h − w, and the moment μ."""
    area = float(0.0)
    moment = wp.vec3()
    product = wp.vec2(1.0, 0.0)
    turn_count = float(0.0)
    for e in range(first, first + count):
        cosine = wp.dot(edges[e].normal, direction)
        if wp.abs(cosine) < radius:
            chord = _find_chord(edges, e, cosine, direction, radius)
            if chord.end > chord.begin:
                length = chord.end - chord.begin
                d = wp.where(cosine > 0.0, chord.distance, wp.min(chord.distance, -LEAST_DISTANCE))  # of 0, turns by +π
                area += 0.5 * d * length
                from_line = (radius * radius - d * d) * _toward_shape(edges[e], cosine, direction, chord)
                moment += length * (from_line + (0.5 * d * (chord.begin + chord.end)) * chord.tangent)
                x, y = d * d + chord.begin * chord.end, d * length
                scale = 1.0 / wp.max(wp.abs(x), wp.abs(y))
                before = product[1]
                product = scale * wp.vec2(product[0] * x + before * y, before * x - product[0] * y)
                if y > 0.0 and before < 0.0 and product[1] >= 0.0:
                    turn_count -= 1.0
                if y < 0.0 and before >= 0.0 and product[1] < 0.0:
                    turn_count += 1.0
    area += 0.5 * radius * radius * (wp.atan2(product[1], product[0]) + 2.0 * wp.pi * turn_count)
    per_area = 1.0 / (wp.pi * radius * radius)
    moment = (per_area / (3.0 * radius)) * moment
    return wp.vec4(area * per_area, moment[0], moment[1], moment[2])


@wp.func
def _with_share(coverage: wp.vec4, share: float):
    """A coverage with another share, of 0 to 1, and the same moment."""
    return wp.vec4(wp.clamp(share, 0.0, 1.0), coverage[1], coverage[2], coverage[3])


@wp.func
def convex_coverage(edges: wp.array(dtype=ViewedEdge), first: int, count: int, direction: wp.vec3, radius: float):
    """Coverage (h, μ) of a cell by a convex outline of ``count`` edges from ``first`` on; it is 0 without edges."""
    if count == 0:
        return wp.vec4()
    nearest = radius
    for e in range(first, first + count):
        nearest = wp.min(nearest, wp.dot(edges[e].normal, direction))
        if nearest <= -radius:
            return wp.vec4()
    if nearest >= radius:
        return wp.vec4(1.0, 0.0, 0.0, 0.0)
    past_edges = _coverage_past_edges(edges, first, count, direction, radius)
    return _with_share(past_edges, wp.where(nearest > 0.0, 1.0, 0.0) + past_edges[0])


@wp.func
def outline_coverage(
    edges: wp.array(dtype=ViewedEdge),
    first: int,
    count: int,
    down: wp.vec3,
    axis: wp.vec3,
    direction: wp.vec3,
    radius: float,
):
    """Coverage (h, μ) of a cell by any outline of a plane, given its normal away from the receiver and one axis."""
    winding = int(0)
    nearest = radius
    is_ahead = wp.dot(down, direction) > 0.0
    side = wp.cross(direction, axis)
    for e in range(first, first + count):
        cosine = wp.dot(edges[e].normal, direction)
        nearest = wp.min(nearest, wp.abs(cosine))
        begins_below = wp.dot(edges[e].begin, side) <= 0.0
        ends_below = wp.dot(edges[e].end, side) <= 0.0
        if is_ahead and begins_below and not ends_below and cosine > 0.0:
            winding += 1
        if is_ahead and ends_below and not begins_below and cosine <= 0.0:
            winding -= 1
    past_edges = wp.vec4()
    if nearest < radius:
        past_edges = _coverage_past_edges(edges, first, count, direction, radius)
    return _with_share(past_edges, float(winding) + past_edges[0])


@wp.func
def coverage_adjoint(
    edges: wp.array(dtype=ViewedEdge), first: int, count: int, direction: wp.vec3, radius: float, adj: wp.vec4
):
    """Add to the gradients of the edges' normals, of either function, by those of h and μ."""
    per_area = 1.0 / (wp.pi * radius * radius)
    adj_moment = (per_area / radius) * wp.vec3(adj[1], adj[2], adj[3])
    for e in range(first, first + count):
        cosine = wp.dot(edges[e].normal, direction)
        if wp.abs(cosine) < radius:
            chord = _find_chord(edges, e, cosine, direction, radius)
            if chord.end > chord.begin:
                foot = -chord.distance * _toward_shape(edges[e], cosine, direction, chord)
                # ∫ (at_foot + s slope) (ω + foot + s t) ds
                at_foot = per_area * adj[0] + wp.dot(adj_moment, foot)
                slope = wp.dot(adj_moment, chord.tangent)
                length = chord.end - chord.begin
                first_integral = 0.5 * (chord.end * chord.end - chord.begin * chord.begin)
                second_integral = (chord.end * chord.end * chord.end - chord.begin * chord.begin * chord.begin) / 3.0
                along_foot = at_foot * length + slope * first_integral
                along_line = at_foot * first_integral + slope * second_integral
                adj_normal = along_foot * (direction + foot) + along_line * chord.tangent
                edges[e].adj_normal = edges[e].adj_normal + chord.scale * adj_normal
