"""Cell coverage: the share of a cell of directions that lies within the outline of a shape, where in it, and gradients.

A cell is a disc of radius ρ around its direction ω, in the plane that touches the sphere of directions there. The plane
through a receiver x and an edge of the outline from a to b, n = (a − x) × (b − x) towards the shape, cuts the touching
plane in a line. Its signed distance d from ω is positive where ω is on the side of the shape; along it, the
edge within the disc is from s₀, towards b, to s₁, towards a: t runs against the edge.

    d = m·ω / √(1 − (m·ω)²),  m = n / |n|,  t = ω × m / |ω × m|,  position of a: (a − x)·t / (a − x)·ω

The area of the disc inside the outline is that of the whole disc, as often as the outline winds around ω, and for each
edge the area between the edge and the disc's border:

    π ρ² h = π ρ² w + ½ Σ_edges d (s₁ − s₀) − ρ² sign(d) atan2(|d| (s₁ − s₀), d² + s₀ s₁)

Angles are added by multiplying complex numbers d² + s₀ s₁ − i d (s₁ − s₀). The arc tangent of the product loses whole
turns, so its crossings of the negative axis are counted. One arc tangent for a cell, not one for an edge, takes 12 to
20% less time.

The first moment says where in the cell the shape is. By Green's theorem, with n̂ the unit vector across the line,
towards the shape:

    π ρ³ μ = ∫ y dA = ⅓ Σ_edges (s₁ − s₀) ((ρ² − d²) n̂ + ½ d (s₀ + s₁) t)

As a line moves by δ(s), the area grows by ∫ δ ds between s₀ and s₁, and the moment by ∫ y δ ds, where

    y = −d n̂ + s t,  δ = ∂n·(ω + y) / (|n| √(1 − (m·ω)²))

Shapes that meet at an edge share cells there without a remainder; within 1e-6 of a corner rounding decides.
"""

import warp as wp

MIN_DISTANCE = 1.0e-12  # the least distance of an edge from ω


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
    """Edge between two points relative to the receiver; the normal points to the shape, of any length but 0."""
    edge = ViewedEdge()
    edge.length = wp.length(n)
    edge.normal = (1.0 / edge.length) * n
    edge.begin = begin
    edge.end = end
    return edge


@wp.struct
class Chord:
    """Part of an edge within a cell, in the tangent plane of the sphere of directions there."""

    distance: float  # d, of the line from the middle of the cell
    begin: float  # s₀
    end: float  # s₁
    tangent: wp.vec3  # t
    scale: float  # 1/√(1 − (m·ω)²), of the angle between ω and the normal


@wp.func
def _position_on_line(end: wp.vec3, axis: wp.vec3, direction: wp.vec3, half_chord: float, position_behind: float):
    """Position s of an end of an edge on its line, clamped to the disc; ``position_behind`` behind the receiver."""
    forward_component = wp.dot(end, direction)
    if forward_component <= 0.0:
        return position_behind
    lateral_component = wp.dot(end, axis)
    if forward_component * half_chord <= wp.abs(lateral_component):
        return wp.where(lateral_component > 0.0, half_chord, -half_chord)
    return lateral_component / forward_component


@wp.func
def _find_chord(edges: wp.array(dtype=ViewedEdge), edge: int, cosine: float, direction: wp.vec3, radius: float):
    """Find the chord of an edge, m·ω = ``cosine``."""
    chord = Chord()
    chord.scale = 1.0 / wp.sqrt(wp.max(0.0, 1.0 - cosine * cosine))
    chord.distance = cosine * chord.scale
    half_chord2 = radius * radius - chord.distance * chord.distance
    a = edges[edge].begin
    b = edges[edge].end
    if half_chord2 > 0.0 and (wp.dot(a, direction) > 0.0 or wp.dot(b, direction) > 0.0):
        half_chord = wp.sqrt(half_chord2)
        chord.tangent = chord.scale * wp.cross(direction, edges[edge].normal)
        chord.begin = _position_on_line(b, chord.tangent, direction, half_chord, -half_chord)
        chord.end = _position_on_line(a, chord.tangent, direction, half_chord, half_chord)
    return chord


@wp.func
def _line_normal(edge: ViewedEdge, cosine: float, direction: wp.vec3, chord: Chord):
    """Unit vector n̂ from an edge's line towards the shape, in the plane that touches the sphere of directions."""
    return chord.scale * (edge.normal - cosine * direction)


@wp.func
def _coverage_within_edges(
    edges: wp.array(dtype=ViewedEdge), first: int, count: int, direction: wp.vec3, radius: float
):
    """Share of a cell between its edges and its border, h − w, and the moment μ."""
    area = float(0.0)
    moment = wp.vec3()
    product = wp.vec2(1.0, 0.0)
    branch_crossings = float(0.0)
    for edge in range(first, first + count):
        cosine = wp.dot(edges[edge].normal, direction)
        if wp.abs(cosine) < radius:
            chord = _find_chord(edges, edge, cosine, direction, radius)
            if chord.end > chord.begin:
                length = chord.end - chord.begin
                # a line through ω counts as just behind it: the angle of its factor is +π then, never −π
                d = wp.where(cosine > 0.0, chord.distance, wp.min(chord.distance, -MIN_DISTANCE))
                area += 0.5 * d * length
                normal_part = (radius * radius - d * d) * _line_normal(edges[edge], cosine, direction, chord)
                moment += length * (normal_part + (0.5 * d * (chord.begin + chord.end)) * chord.tangent)
                x, y = d * d + chord.begin * chord.end, d * length
                scale = 1.0 / wp.max(wp.abs(x), wp.abs(y))
                imaginary_part = product[1]
                product = scale * wp.vec2(product[0] * x + imaginary_part * y, imaginary_part * x - product[0] * y)
                if y > 0.0 and imaginary_part < 0.0 and product[1] >= 0.0:
                    branch_crossings -= 1.0
                if y < 0.0 and imaginary_part >= 0.0 and product[1] < 0.0:
                    branch_crossings += 1.0
    area += 0.5 * radius * radius * (wp.atan2(product[1], product[0]) + 2.0 * wp.pi * branch_crossings)
    per_area = 1.0 / (wp.pi * radius * radius)
    moment = (per_area / (3.0 * radius)) * moment
    return wp.vec4(area * per_area, moment[0], moment[1], moment[2])


@wp.func
def _with_cell_share(coverage: wp.vec4, cell_share: float):
    """The coverage with its share replaced, clamped to [0, 1]."""
    return wp.vec4(wp.clamp(cell_share, 0.0, 1.0), coverage[1], coverage[2], coverage[3])


@wp.func
def convex_coverage(edges: wp.array(dtype=ViewedEdge), first: int, count: int, direction: wp.vec3, radius: float):
    """Coverage (h, μ) of a cell by a convex outline of ``count`` edges from ``first`` on; it is 0 without edges."""
    if count == 0:
        return wp.vec4()
    min_cosine = radius
    for edge in range(first, first + count):
        min_cosine = wp.min(min_cosine, wp.dot(edges[edge].normal, direction))
        if min_cosine <= -radius:
            return wp.vec4()
    if min_cosine >= radius:
        return wp.vec4(1.0, 0.0, 0.0, 0.0)
    winding = wp.where(min_cosine > 0.0, 1.0, 0.0)
    within_edges = _coverage_within_edges(edges, first, count, direction, radius)
    return _with_cell_share(within_edges, winding + within_edges[0])


@wp.func
def outline_coverage(
    edges: wp.array(dtype=ViewedEdge),
    first: int,
    count: int,
    plane_normal: wp.vec3,
    axis: wp.vec3,
    direction: wp.vec3,
    radius: float,
):
    """Coverage (h, μ) of a cell by any outline of a plane, given its normal away from the receiver and one axis."""
    winding = int(0)
    min_abs_cosine = radius
    is_ahead = wp.dot(plane_normal, direction) > 0.0
    side = wp.cross(direction, axis)
    for edge in range(first, first + count):
        cosine = wp.dot(edges[edge].normal, direction)
        min_abs_cosine = wp.min(min_abs_cosine, wp.abs(cosine))
        begins_below = wp.dot(edges[edge].begin, side) <= 0.0
        ends_below = wp.dot(edges[edge].end, side) <= 0.0
        if is_ahead and begins_below and not ends_below and cosine > 0.0:
            winding += 1
        if is_ahead and ends_below and not begins_below and cosine <= 0.0:
            winding -= 1
    within_edges = wp.vec4()
    if min_abs_cosine < radius:
        within_edges = _coverage_within_edges(edges, first, count, direction, radius)
    return _with_cell_share(within_edges, float(winding) + within_edges[0])


@wp.func
def coverage_adjoint(
    edges: wp.array(dtype=ViewedEdge), first: int, count: int, direction: wp.vec3, radius: float, adj_coverage: wp.vec4
):
    """Add to the gradients of the edges' normals, of either function, by the gradients of h and μ."""
    per_area = 1.0 / (wp.pi * radius * radius)
    adj_moment = (per_area / radius) * wp.vec3(adj_coverage[1], adj_coverage[2], adj_coverage[3])
    for edge in range(first, first + count):
        cosine = wp.dot(edges[edge].normal, direction)
        if wp.abs(cosine) < radius:
            chord = _find_chord(edges, edge, cosine, direction, radius)
            if chord.end > chord.begin:
                line_foot = -chord.distance * _line_normal(edges[edge], cosine, direction, chord)
                # ∫ (foot_value + s slope) (ω + line_foot + s t) ds
                foot_value = per_area * adj_coverage[0] + wp.dot(adj_moment, line_foot)
                slope = wp.dot(adj_moment, chord.tangent)
                length = chord.end - chord.begin
                first_integral = 0.5 * (chord.end * chord.end - chord.begin * chord.begin)
                second_integral = (chord.end * chord.end * chord.end - chord.begin * chord.begin * chord.begin) / 3.0
                foot_weight = foot_value * length + slope * first_integral
                tangent_weight = foot_value * first_integral + slope * second_integral
                adj_normal = foot_weight * (direction + line_foot) + tangent_weight * chord.tangent
                edges[edge].adj_normal = edges[edge].adj_normal + chord.scale * adj_normal
