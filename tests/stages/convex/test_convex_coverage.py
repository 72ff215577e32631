"""Coverage of cells by convex parts, against rays through NumPy's planes."""

import numpy as np
import pytest
import trimesh
import twins
import warp as wp
from scipy.spatial import ConvexHull

from warpshadow.maths.convex import find_convex_parts
from warpshadow.maths.directions import cell_radius, fibonacci
from warpshadow.maths.hull import find_hull
from warpshadow.stages.convex.convex_blockers import ConvexBlockers, ConvexBody
from warpshadow.stages.convex.coverage import part_coverage
from warpshadow.stages.receivers.body_spans import Span

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

# Rays of the twin: 200 across a cell. Measured: 4e-3.
RAYS = 5e-3
# Without the seam the error is 0.16.
DIRECTIONS = fibonacci(32)
BOX = trimesh.creation.box((1, 0.5, 0.3))
PRISM = trimesh.creation.cylinder(0.3, 1.0, sections=7)
BOARD = trimesh.creation.box((0.02, 1.5, 1.2))
SHIFTS = np.array([[0, 0, 1.0], [0.6, 1.0, 0.2], [-0.9, 0.1, 0.2]])
BODIES = [[0], [1, 2]]  # parts of each body
MESHES = [BOX, PRISM, BOARD]
VERTICES = [mesh.vertices + shift for mesh, shift in zip(MESHES, SHIFTS, strict=True)]


def blockers(device, *, blocks=(True, True)):
    starts, bodies = np.cumsum([0, *map(len, VERTICES)]), []
    for parts, is_blocking in zip(BODIES, blocks, strict=True):
        found = []
        for number in parts:
            (part,) = find_convex_parts(MESHES[number].vertices, MESHES[number].faces)
            found.append(part._replace(corners=part.corners + starts[number] - starts[parts[0]]))
        bodies.append(ConvexBody(found, int(starts[parts[0]]), is_blocking))
    return ConvexBlockers.from_bodies(bodies, int(starts[-1]), device=device)


def hits(vertices, point, rays):
    """Whether rays meet a convex part, by the planes of its hull."""
    equations = ConvexHull(vertices).equations
    toward, height = rays @ equations[:, :3].T, equations[:, :3] @ point + equations[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        at = -height / toward
    entry = np.where(toward < 0, at, -np.inf).max(axis=1)
    leave = np.where(toward > 0, at, np.inf).min(axis=1)
    return (np.maximum(entry, 0) < leave) & ~((toward == 0) & (height > 0)).any(axis=1)


def twin(point, directions, radius, bodies, across=200, vertices=VERTICES):
    """Coverage (h, μ) of a receiver's cells, by rays through the disc of each."""
    axis = (np.arange(across) + 0.5) / across * 2 - 1
    u, v = np.meshgrid(axis, axis)
    disc = radius * np.stack([u, v], axis=-1)[u**2 + v**2 < 1]
    result = []
    for direction in directions:
        side = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
        frame = np.stack([side, np.cross(direction, side)]) / np.linalg.norm(side)
        rays = direction + disc @ frame
        covers = [sum(hits(vertices[part], point, rays).astype(float) for part in parts) for parts in bodies]
        result.append(
            twins.joint_coverage(
                [cover.mean() for cover in covers], [cover @ (disc @ frame) / radius / len(rays) for cover in covers]
            )
        )
    return np.array(result)


POINTS = np.array(
    [[0.4, 0.2, -0.9], [-0.5, 1.3, 0.7], [0.1, 0.1, 1.4], [2.0, -1.5, 0.4], [0, 0, 1.0], [0.1, 0.1, 1.151]]
)
"""The fifth is inside the box, and the last close to its side."""


def of_kernel(points, device, directions=DIRECTIONS, **options):
    placed = blockers(device).place(wp.array(np.concatenate(VERTICES)[None], dtype=wp.vec3, device=device))
    arguments = wp.array(points[None], dtype=wp.vec3, device=device), placed, blockers(device), directions
    return part_coverage(*arguments, **options).numpy()[0]


@pytest.mark.parametrize("number", range(len(POINTS)))
def test_coverages_of_cells_are_those_of_rays(number, device):
    expected = twin(POINTS[number], DIRECTIONS, cell_radius(32), BODIES)
    found = of_kernel(POINTS[[number]], device)[0]
    np.testing.assert_allclose(found[:, 0], expected[:, 0], rtol=0, atol=RAYS)
    is_open = expected[:, 0] < 1  # else the moment is that of the first body that covers all
    np.testing.assert_allclose(found[is_open], expected[is_open], rtol=0, atol=RAYS)


def test_a_panel_is_two_sided_and_blocks_nothing_of_receivers_in_its_plane(device):
    corners = np.array([[-0.5, 0.2, -0.4], [0.6, 0.2, -0.5], [0.5, 0.2, 0.6], [-0.4, 0.2, 0.3]])
    (panel,) = find_convex_parts(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    some = ConvexBlockers.from_bodies([ConvexBody([panel], 0)], 4, device=device)
    placed = some.place(wp.array(corners[None], dtype=wp.vec3, device=device))
    points = np.array([[0.1, 1.0, 0.0], [0.1, -0.1, 0.1], [0.1, 0.2, 0.1], [3.0, 0.2, 0.1]])
    arguments = wp.array(points[None], dtype=wp.vec3, device=device), placed, some, DIRECTIONS
    got = part_coverage(*arguments).numpy()[0]
    thick = np.concatenate([corners - [0, 1e-4, 0], corners + [0, 1e-4, 0]])
    expected = [twin(point, DIRECTIONS, cell_radius(32), [[0]], vertices=[thick]) for point in points[:2]]
    np.testing.assert_allclose(got[:2], expected, rtol=0, atol=RAYS)
    assert got[:2, :, 0].max(axis=1).min() > 0.9
    np.testing.assert_array_equal(got[2:], 0)


def test_a_shell_covers_where_it_is_met_once_or_twice(device):
    """Both walls of a mug, from outside, have the same outline; from within one is seen."""
    profile = np.array([(0, 0), (1, 0), (1, 1.5), (0.95, 1.5), (0.95, 0.05), (0, 0.05)])
    mug = trimesh.creation.revolve(profile, sections=24)
    parts = find_convex_parts(mug.vertices, mug.faces)
    outer = mug.vertices[np.unique(np.concatenate([part.corners for part in parts]))]
    some = ConvexBlockers.from_bodies([ConvexBody(parts, 0)], len(mug.vertices), device=device)
    placed = some.place(wp.array(mug.vertices[None], dtype=wp.vec3, device=device))
    below = np.array([[2.0, 0.3, -0.5], [-1.5, 0.4, -0.1], [0.2, 0.1, -1.0]])
    points = np.concatenate([below, [[0.3, 0.2, 0.7]]])
    got = part_coverage(wp.array(points[None], dtype=wp.vec3, device=device), placed, some, DIRECTIONS).numpy()[0]
    expected = [twin(point, DIRECTIONS, cell_radius(32), [[0]], vertices=[outer]) for point in below]  # filled
    rises = DIRECTIONS[:, 2] > 0.2  # light that comes in over the rim does not
    errors = got[:3, rises, 0] - np.array(expected)[:, rises, 0]
    assert np.abs(errors).mean() < 0.012  # measured: 0.006; of panels with two sides 0.056
    up, far = DIRECTIONS[:, 2] > 0.95, DIRECTIONS[:, 2] < 0.3
    assert got[3, far, 0].min() > 0.9  # from within
    assert got[3, up, 0].max() < 0.01


@pytest.mark.parametrize("turn", range(4))
def test_a_cell_whose_middle_is_on_an_edge_is_half_covered(turn, device):
    """Wherever the outline begins."""
    corners = np.roll(np.array([[0, 0, 1], [3, 0, 1], [3, 3, 1], [0, 3, 1.0]]), turn, axis=0)
    (panel,) = find_convex_parts(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    some = ConvexBlockers.from_bodies([ConvexBody([panel], 0)], 4, device=device)
    placed = some.place(wp.array(corners[None], dtype=wp.vec3, device=device))
    points = np.array([[0, 1, 0], [1, 0, 0], [0, 2, 2], [1, 1, 0.0]])
    directions = np.tile([0, 0, 1.0], (16, 1)) * np.where(np.arange(16) < 8, 1, -1)[:, None]
    arguments = wp.array(points[None], dtype=wp.vec3, device=device), placed, some, directions
    got = part_coverage(*arguments, radius=0.1).numpy()[0][:, [0, 15], 0]
    np.testing.assert_allclose(got, [[0.5, 0], [0.5, 0], [0, 0.5], [1, 0]], atol=1e-5)


def test_prisms_of_a_body_cover_their_seam_once(device):
    """A bracket of six corners, cut into two prisms, which both cover their seam where it is seen at a slant."""
    outline = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2.0]])
    triangles = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 5], [3, 4, 5]])
    bracket = trimesh.creation.extrude_triangulation(outline, triangles, 1.0)
    parts = find_convex_parts(bracket.vertices, bracket.faces)
    assert [part.is_seam for part in parts] == [False, False, True]
    some = ConvexBlockers.from_bodies([ConvexBody(parts, 0)], len(bracket.vertices), device=device)
    placed = some.place(wp.array(bracket.vertices[None], dtype=wp.vec3, device=device))
    points = np.array([[-1.5, -0.7, 1.8], [-0.6, -0.9, -1.2]])  # from outside the notch
    solids = [bracket.vertices[part.corners] for part in parts[:2]]
    for point in points:
        toward = bracket.triangles_center[::2] - point
        toward = np.resize(toward / np.linalg.norm(toward, axis=1, keepdims=True), (16, 3))
        arguments = wp.array(point[None, None], dtype=wp.vec3, device=device), placed, some, toward
        got = part_coverage(*arguments, radius=0.3).numpy()[0, 0, :, 0]
        axis = (np.arange(200) + 0.5) / 100 - 1
        u, v = np.meshgrid(axis, axis)
        for direction, share in zip(toward, got, strict=True):
            side = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
            frame = np.stack([side, np.cross(direction, side)]) / np.linalg.norm(side)
            rays = direction + 0.3 * np.stack([u, v], axis=-1)[u**2 + v**2 < 1] @ frame
            met = np.any([hits(solid, point, rays) for solid in solids], axis=0).mean()
            assert share == pytest.approx(met, abs=RAYS)


def test_pieces_of_a_body_are_blockers_of_their_own(device):
    """From the second point one of them stands before another, which covers no more."""
    starts, parts = np.cumsum([0, *map(len, VERTICES)]), []
    for number, mesh in enumerate(MESHES):
        (part,) = find_convex_parts(mesh.vertices, mesh.faces)
        parts.append(part._replace(corners=part.corners + starts[number], piece=number))
    some = ConvexBlockers.from_bodies([ConvexBody(parts, 0)], int(starts[-1]), device=device)
    placed = some.place(wp.array(np.concatenate(VERTICES)[None], dtype=wp.vec3, device=device))
    points = np.array([[0.4, 0.2, -0.9], [0.5, 3.0, 0.3]])
    got = part_coverage(wp.array(points[None], dtype=wp.vec3, device=device), placed, some, DIRECTIONS).numpy()[0]
    for point, found in zip(points, got, strict=True):
        expected = twin(point, DIRECTIONS, cell_radius(32), [[0], [1], [2]])
        np.testing.assert_allclose(found[:, 0], expected[:, 0], rtol=0, atol=RAYS)


SLATS = [trimesh.creation.box((1.6, 0.25, 0.06)).apply_translation([0, y, 0]) for y in (-0.3, 0, 0.3)]
BLIND = trimesh.util.concatenate(SLATS)
BEFORE_BLIND = np.array([[0.2, 0.1, 0.8], [0.9, -0.5, -0.6], [0.2, 1.2, 0.2], [0.3, 0, 0.02]])
"""From the third point slats stand behind each other, and the last is in the middle one."""


def compound(device, vertices=BLIND.vertices, mesh=BLIND):
    """Slats of one body with their hull, and a board."""
    parts = find_convex_parts(mesh.vertices, mesh.faces)
    (board,) = find_convex_parts(BOARD.vertices, BOARD.faces)
    bodies = [ConvexBody(parts, 0, True, find_hull(mesh.vertices, parts)), ConvexBody([board], len(vertices))]
    some = ConvexBlockers.from_bodies(bodies, len(vertices) + 8, device=device)
    positions = np.concatenate([vertices, BOARD.vertices + [1.3, 0.2, 0]])
    return some.place(wp.array(positions[None], dtype=wp.vec3, device=device)), some


def twin_of_compound(point, directions, radius, across=200):
    """By :func:`twin`: of the parts together and the hull the one that covers less of each cell, and the board."""
    slats = [twin(point, directions, radius, [[0]], across, [slat.vertices]) for slat in SLATS]
    of_parts, of_hull = np.sum(slats, axis=0), twin(point, directions, radius, [[0]], across, [BLIND.vertices])
    of_board = twin(point, directions, radius, [[0]], across, [BOARD.vertices + [1.3, 0.2, 0]])
    smaller = np.where(of_parts[:, :1] > of_hull[:, :1], of_hull, of_parts)
    cells = zip(smaller, of_board, strict=True)
    return np.array([twins.joint_coverage([a[0], b[0]], [a[1:], b[1:]]) for a, b in cells]), of_parts, of_hull


@pytest.mark.parametrize("number", range(len(BEFORE_BLIND)))
def test_a_compound_covers_no_more_than_its_hull(number, device):
    point = BEFORE_BLIND[number]
    expected, of_parts, of_hull = twin_of_compound(point, DIRECTIONS, cell_radius(32))
    points = wp.array(point[None, None], dtype=wp.vec3, device=device)
    found = part_coverage(points, *compound(device), DIRECTIONS).numpy()[0, 0]
    np.testing.assert_allclose(found[:, 0], expected[:, 0], rtol=0, atol=2 * RAYS)
    is_open = expected[:, 0] < 1
    np.testing.assert_allclose(found[is_open], expected[is_open], rtol=0, atol=2 * RAYS)
    if number == 2:
        assert (of_parts - of_hull)[:, 0].max() > 0.1


def test_strips_that_touch_cover_as_much_as_the_panel_they_make(device):
    strips = [trimesh.creation.box((1.6, 0.1, 0.02)).apply_translation([0, 0.1 * k, 0]) for k in range(12)]
    panel = trimesh.creation.box((1.6, 1.2, 0.02)).apply_translation([0, 0.55, 0])
    found = []
    for mesh in (trimesh.util.concatenate(strips), panel):
        parts = find_convex_parts(mesh.vertices, mesh.faces)
        body = ConvexBody(parts, 0, True, find_hull(mesh.vertices, parts))
        some = ConvexBlockers.from_bodies([body], len(mesh.vertices), device=device)
        placed = some.place(wp.array(mesh.vertices[None], dtype=wp.vec3, device=device))
        points = wp.array([[(0.3, 0.2, 0.5), (-0.9, 1.4, -0.3), (0.2, -0.4, 2.0)]], dtype=wp.vec3, device=device)
        found.append(part_coverage(points, placed, some, DIRECTIONS).numpy())
    assert ((found[1][..., 0] > 0.1) & (found[1][..., 0] < 0.9)).sum() > 10
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=1e-4)


def test_receivers_on_a_compound_see_its_other_parts(device):
    """On the lowest slat, in the plane of the hull's side."""
    placed, some = compound(device)
    options = {"horizon_normals": wp.array([[(0, 1, 0)]], dtype=wp.vec3, device=device), "self_bodies": (1,)}
    point = wp.array([[(0.1, -0.175, 0.03)]], dtype=wp.vec3, device=device)
    found = part_coverage(point, placed, some, DIRECTIONS, on_surface=True, **options).numpy()[0, 0, :, 0]
    above = twin(np.array([0.1, -0.175, 0.03]), DIRECTIONS, cell_radius(32), [[0]], vertices=[SLATS[1].vertices])[:, 0]
    is_alone = (DIRECTIONS[:, 1] > 0) & (above > 0.1)
    assert is_alone.sum() > 3
    assert (found[is_alone] > above[is_alone] - RAYS).all()


SLAB, POST = trimesh.creation.box((2, 0.2, 1)), trimesh.creation.box((0.3, 1, 0.4))
POST.apply_translation([0.5, 0.55, 0])  # its foot is 5 cm within the slab
TILTED = np.array([0.25, 1, -0.2]) / np.linalg.norm([0.25, 1, -0.2])


@pytest.mark.parametrize(
    ("point", "normal", "blocking"),
    [
        ((-0.3, 0.1, 0.2), (0, 1, 0), [1]),
        ((-0.3, 0.1, 0.2), TILTED, [1]),  # of smooth normals
        ((-1, 0.1, 0.5), TILTED, [1]),  # a corner
        ((0.35, 0.5, 0.1), (-1, 0, 0), [0]),
        ((0.5, 1.05, 0), (0, 1, 0), []),
        ((0.5, -0.1, 0), (0, -1, 0), []),
        ((0.5, 0.08, 0), (1, 0, 0), [0, 1]),  # within both
        ((0.6, 0.1, 0), (0, 1, 0), [1]),  # on the slab, within the post
    ],
)
@pytest.mark.parametrize("shift", [0.0, 300.0])
def test_parts_block_no_light_of_receivers_that_lie_on_them(point, normal, blocking, shift, device):
    parts, meshes = [], [SLAB, POST]
    for number, mesh in enumerate(meshes):
        (part,) = find_convex_parts(mesh.vertices, mesh.faces)
        parts.append(part._replace(corners=part.corners + 8 * number, piece=number))
    some = ConvexBlockers.from_bodies([ConvexBody(parts, 0)], 16, device=device)
    vertices = np.concatenate([mesh.vertices for mesh in meshes]) + shift
    placed = some.place(wp.array(vertices[None], dtype=wp.vec3, device=device))
    at, facing = (wp.array(np.array([[v]]), dtype=wp.vec3, device=device) for v in (np.add(point, shift), normal))
    got = part_coverage(at, placed, some, DIRECTIONS, horizon_normals=facing, on_surface=True).numpy()[0, 0, :, 0]
    is_above = DIRECTIONS @ normal > 0
    radius = cell_radius(32)
    bodies = [[number] for number in blocking]
    solids = [mesh.vertices for mesh in meshes]
    expected = twin(np.array(point, float), DIRECTIONS, radius, bodies, vertices=solids)[:, 0] if bodies else 0 * got
    np.testing.assert_allclose(got[is_above], expected[is_above], rtol=0, atol=RAYS + 1e-4 * shift)
    np.testing.assert_array_equal(got[~is_above], 0)


@pytest.mark.parametrize("height", [0.09, 0.11])
def test_segments_of_bent_tubes_block_no_light_of_the_surface_they_stand_for(height, device):
    """The surface lies within a segment at its inner side, and outside at its outer one."""
    (part,) = find_convex_parts(SLAB.vertices, SLAB.faces)
    radius = np.linalg.norm(SLAB.extents) / 2
    at, facing = (wp.array([[v]], dtype=wp.vec3, device=device) for v in ((-0.3, height, 0.2), (0, 1, 0)))
    for gap, shares in ((0.0, 1.0 if height < 0.1 else 0.0), (0.012 / radius, 0.0)):
        some = ConvexBlockers.from_bodies([ConvexBody([part._replace(gap=gap)], 0)], 8, device=device)
        placed = some.place(wp.array(SLAB.vertices[None], dtype=wp.vec3, device=device))
        got = part_coverage(at, placed, some, DIRECTIONS, horizon_normals=facing, on_surface=True).numpy()[0, 0, :, 0]
        np.testing.assert_array_equal(got[DIRECTIONS[:, 1] > 0], shares)


def test_narrow_cells_and_a_receivers_own_body_are_left_to_it(device):
    # beside corners, where silhouettes are
    toward = np.concatenate([VERTICES[0], VERTICES[1]])[:16] - POINTS[0] + 0.004
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    got = of_kernel(POINTS[[0]], device, toward, radius=0.02, self_bodies=[1])[0]
    expected = twin(POINTS[0], toward, 0.02, BODIES[:1])
    assert ((expected[:, 0] > 0.1) & (expected[:, 0] < 0.9)).sum() > 4
    np.testing.assert_allclose(got, expected, rtol=0, atol=RAYS)


def test_parts_so_far_away_that_they_have_no_size_block_nothing(device):
    """Some or all edges are under 1e-6 rad, the least that counts."""
    distances = np.repeat(10.0 ** np.arange(4, 9, 0.25), len(DIRECTIONS))
    points = distances[:, None] * np.tile(DIRECTIONS, (20, 1))
    assert of_kernel(points, device)[..., 0].max() < 1e-4


def test_bodies_that_cast_no_shadow_block_nothing(device):
    vertices = wp.array(np.concatenate(VERTICES)[None], dtype=wp.vec3, device=device)
    some = blockers(device, blocks=(True, False))
    points = wp.array(POINTS[None], dtype=wp.vec3, device=device)
    got = part_coverage(points, some.place(vertices), some, DIRECTIONS).numpy()[0]
    np.testing.assert_array_equal(got, of_kernel(POINTS, device, self_bodies=[1]))


def test_receivers_of_several_bodies_are_as_those_of_each_alone(device):
    spans, self_bodies = [Span(0, 0, 1), Span(-1, 1, 4), Span(1, 4, 6)], (0, -1, 1)
    got = of_kernel(POINTS, device, body_spans=spans, self_bodies=self_bodies)
    for (_, first, end), self_body in zip(spans, self_bodies, strict=True):
        np.testing.assert_array_equal(got[first:end], of_kernel(POINTS[first:end], device, self_bodies=[self_body]))


def test_nothing_below_the_horizon_is_blocked(device):
    normals = np.random.default_rng(0).normal(size=POINTS.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    horizon_normals = wp.array(normals[None], dtype=wp.vec3, device=device)
    expected = np.where((normals @ DIRECTIONS.T > 0)[..., None], of_kernel(POINTS, device), 0)
    np.testing.assert_array_equal(of_kernel(POINTS, device, horizon_normals=horizon_normals), expected)


def test_instances_have_parts_of_their_own(device):
    shift = np.array([0.2, 0.1, -0.3])
    positions = np.stack([np.concatenate(VERTICES), np.concatenate(VERTICES) + shift])
    points = np.stack([POINTS, POINTS + shift])
    some = blockers(device)
    placed = some.place(wp.array(positions, dtype=wp.vec3, device=device))
    got = part_coverage(wp.array(points[:, :4], dtype=wp.vec3, device=device), placed, some, DIRECTIONS)
    np.testing.assert_allclose(got.numpy()[1], got.numpy()[0], rtol=0, atol=1e-4)  # rounding of 1e-7 beside edges
    np.testing.assert_array_equal(got.numpy()[0], of_kernel(POINTS[:4], device))


def test_errors_name_the_argument(device):
    with pytest.raises(ValueError, match=r"self_bodies: got 2"):
        of_kernel(POINTS, device, self_bodies=[2])
    with pytest.raises(ValueError, match=r"positions: got"):
        blockers(device).place(wp.zeros((1, 3), dtype=wp.vec3, device=device))
