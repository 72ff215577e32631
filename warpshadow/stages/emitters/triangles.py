"""Form factors of triangles, exactly: the share of the cosine-weighted hemisphere of a receiver that they fill.

The receiver is the origin. With the directions a_j of the corners of the part above its horizon, and the angles γ_j
between a_j and a_{j+1}, it is [Lambert 1760; Baum, Rushmeier and Winget 1989]

    F = −Σ_j γ_j n·(a_j × a_{j+1}) / (2 π sin γ_j)
"""

import warp as wp

_TINY = wp.constant(1e-12)  # beside the square of a sine


@wp.func
def _edge_light(a: wp.vec3, b: wp.vec3, normal: wp.vec3):
    """2π times the light of an edge from a to b, seen from the origin."""
    a = wp.normalize(a)
    b = wp.normalize(b)
    cross = wp.cross(a, b)
    sine = wp.sqrt(wp.length_sq(cross) + _TINY)
    return wp.atan2(sine, wp.dot(a, b)) / sine * wp.dot(normal, cross)


@wp.func
def _cut(a: wp.vec3, b: wp.vec3, normal: wp.vec3):
    """Start of the part above the horizon of an edge from a to b that has such a part."""
    height = wp.dot(a, normal)
    other = wp.dot(b, normal)
    rises = height < 0.0 and other > 0.0
    edge_share = wp.where(rises, height, 0.0) / wp.where(rises, height - other, 1.0)
    return a + edge_share * (b - a)


@wp.func
def _cut_edge_light(a: wp.vec3, b: wp.vec3, normal: wp.vec3):
    """2π times the light of the part of an edge above the horizon."""
    light = float(0.0)
    if wp.dot(a, normal) > 0.0 or wp.dot(b, normal) > 0.0:
        light = _edge_light(_cut(a, b, normal), _cut(b, a, normal), normal)
    return light


@wp.func
def _crossing(a: wp.vec3, b: wp.vec3, normal: wp.vec3):
    """Point at which an edge from a to b sinks below the horizon; 0 for one that does not."""
    sinks = wp.dot(a, normal) > 0.0 and wp.dot(b, normal) <= 0.0
    return wp.where(sinks, _cut(b, a, normal), wp.vec3())


@wp.func
def form_factor_of_triangle(a: wp.vec3, b: wp.vec3, c: wp.vec3, normal: wp.vec3):
    """Share of the cosine-weighted hemisphere that a triangle fills, seen from the origin; negative from its back."""
    light = _cut_edge_light(a, b, normal) + _cut_edge_light(b, c, normal) + _cut_edge_light(c, a, normal)
    sink = _crossing(a, b, normal) + _crossing(b, c, normal) + _crossing(c, a, normal)
    rise = _crossing(b, a, normal) + _crossing(c, b, normal) + _crossing(a, c, normal)
    if wp.length_sq(sink) > 0.0 and wp.length_sq(rise) > 0.0:
        light = light + _edge_light(sink, rise, normal)
    return -light / (2.0 * wp.pi)
