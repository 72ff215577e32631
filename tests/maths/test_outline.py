"""Outlines of triangles in a plane, and the convex polygons into which they are cut."""

import numpy as np
import pytest

from warpshadow.maths.outline import cut_outline, find_outline

SQUARES = [(0, 0), (1, 0), (2, 0), (0, 1), (2, 1), (0, 2), (1, 2), (2, 2)]  # around a window


def triangles_of(squares, seed=0):
    """Points, and triangles of unit squares, each cut along either diagonal, of either winding."""
    rng = np.random.default_rng(seed)
    corners = {point: None for x, y in squares for point in ((x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1))}
    numbers = {point: number for number, point in enumerate(corners)}
    faces = []
    for x, y in squares:
        a, b, c, d = (numbers[point] for point in ((x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1)))
        for face in ([a, b, c], [a, c, d]) if rng.uniform() < 0.5 else ([a, b, d], [b, c, d]):
            faces.append(face[:: rng.choice([1, -1])])
    return np.array(list(corners), float), np.array(faces)


def area(polygon):
    x, y = polygon.T
    return (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2


@pytest.mark.parametrize("seed", range(4))
def test_an_outline_has_the_edges_around_a_sheet_and_its_holes(seed):
    points, triangles = triangles_of(SQUARES, seed)
    edges = points[find_outline(points, triangles)]
    assert len(edges) == 8  # corners on straight sides are none
    lengths = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
    assert sorted(lengths) == [1, 1, 1, 1, 3, 3, 3, 3]
    (a, b) = np.moveaxis(edges, 1, 0)
    assert (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2 == 8  # the sheet is to their left


def test_slivers_and_triangles_without_area_do_not_tear_an_outline():
    points = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0], [0.25, 1e-9]])
    triangles = np.array([[0, 1, 3], [1, 2, 3]])
    whole = points[find_outline(points, triangles)]
    # a vertex on an edge, and one a hair beside it, which a sliver joins to the sheet
    torn = points[find_outline(points, np.array([[0, 4, 1], [4, 1, 3], [0, 5, 4], [5, 4, 3], [0, 5, 3], [1, 2, 3]]))]
    assert len(whole) == 4
    assert sum(area(np.array([[0, 0], *edge])) for edge in torn) == pytest.approx(1)


@pytest.mark.parametrize("repeated", [(0, 0, 1), (1, 0, 0), (2, 2, 2)])
def test_a_triangle_that_has_a_corner_twice_adds_no_edge(repeated):
    points, square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float), [(0, 1, 2), (0, 2, 3)]
    np.testing.assert_array_equal(
        find_outline(points, np.array([*square, repeated])), find_outline(points, np.array(square))
    )


@pytest.mark.parametrize("turn", [0.0, 0.3, 2.0])
def test_a_square_with_a_window_is_four_polygons(turn):
    points, triangles = triangles_of(SQUARES)
    points = points @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
    polygons = cut_outline(points, find_outline(points, triangles), 32)
    assert [len(polygon) for polygon in polygons] == [4] * 4
    assert sum(area(points[polygon]) for polygon in polygons) == pytest.approx(8)


@pytest.mark.parametrize("seed", range(20))
def test_polygons_are_convex_and_cover_what_an_outline_encloses(seed):
    rng = np.random.default_rng(seed)
    squares = [(x, y) for x in range(6) for y in range(5) if rng.uniform() < 0.8]
    points, triangles = triangles_of(squares, seed)
    edges = find_outline(points, triangles)
    polygons = cut_outline(points, edges, 32)
    touches = len(np.unique(edges[:, 0])) < len(edges)  # squares that have a corner alone in common
    assert (polygons is None) == touches
    if polygons is None:
        return
    for polygon in polygons:
        sides = np.roll(points[polygon], -1, axis=0) - points[polygon]
        following = np.roll(sides, -1, axis=0)
        assert (sides[:, 0] * following[:, 1] - sides[:, 1] * following[:, 0] > 0).all()
    assert sum(area(points[polygon]) for polygon in polygons) == pytest.approx(len(squares))


def test_an_outline_that_takes_more_polygons_than_allowed_has_none():
    points, triangles = triangles_of(SQUARES)
    edges = find_outline(points, triangles)
    assert cut_outline(points, edges, 3) is None
    assert cut_outline(points, edges, 4) is not None
