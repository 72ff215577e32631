"""C++ for loops over lanes, in place of functions of the C library, which take one lane after another."""

import functools
import math

_ARCTANGENT = functools.reduce(
    lambda rest, k: f"((float){(-1) ** k / (2 * k + 1)!r} + t2 * {rest})", reversed(range(12)), "(float)0"
)
"""Σ (−1)ᵏ t²ᵏ / (2k + 1), the arctangent of t over t: up to t = tan π/8 terms left out are below 1e-11."""

ANGLE = f"""
    const float size_x = x > (float)0 ? x : -x, size_y = y > (float)0 ? y : -y;
    const float larger = size_x > size_y ? size_x : size_y, smaller = size_x > size_y ? size_y : size_x;
    const bool is_past = smaller > (float){math.tan(math.pi / 8)!r} * larger;
    const float t = (is_past ? smaller - larger : smaller) / (is_past ? smaller + larger : larger), t2 = t * t;
    const float octant = t * {_ARCTANGENT} + (is_past ? (float){math.pi / 4!r} : (float)0);
    const float quadrant = size_y > size_x ? (float){math.pi / 2!r} - octant : octant;
    const float half = x < (float)0 ? (float){math.pi!r} - quadrant : quadrant;
    const float angle = y < (float)0 ? -half : half;
"""
"""The angle of x + iy, by the series of the arctangent up to π/8. With the C library's, which takes one lane after
another, coverage by sixty boxes and rods took a quarter longer."""
