"""Silhouettes: found where edges are, smoothed to the area they leave, with gradients that move vertices."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
import warp.examples
from hypothesis import example, given, settings
from hypothesis import strategies as st
from meshes import through_plane

import warpshadow as ws
from warpshadow.device.warp_internals import check_strides
from warpshadow.maths.adjacency import edge_neighbors
from warpshadow.stages.raster.interpolation import interpolate
from warpshadow.stages.raster.project import to_clip
from warpshadow.stages.raster.rasterization import rasterize
from warpshadow.stages.silhouettes import silhouettes as silhouettes_file
from warpshadow.stages.silhouettes.silhouettes import MAX_SAMPLES, find_silhouettes
from warpshadow.stages.silhouettes.smooth import smooth_silhouettes

# float32 kernels against the float64 twin; measured 2e-6 for values and 7e-7 for gradients.
FLOAT32 = 2e-5
# Coverage of pixels that a straight edge cuts, against its exact area: it is exact where the edge cuts rows, if it is
# steep, but as it leans it counts a little where it cuts columns. Measured 1.0e-2.
STRAIGHT = 2e-2
# Total coverage of a triangle of hundreds of pixels: its corners count as if edges went on. Measured 1e-3 and below.
AREA = 3e-3
# Mean error of coverage over the pixels that silhouettes cut, against 16 × 16 samples: measured 0.012, without 0.20.
COVERAGE = 0.015
# Gradient of the total coverage against that of the exact area; measured 2%.
AREA_GRADIENT = 5e-2
# Gradient of the area of a half disc with teeth of a pixel, averaged over 64 positions: measured 0.6%; by the edges'
# normals 45 to 87%.
TEETH = 2e-2
# Gradients against differences of the loss, relative L2 over directions, as required; measured 1.0e-2 to 3.4e-2.
MOTION = 5e-2

CAMERA = ws.Camera.look_at((0, 0, 4), (0, 0, 0), fov_y=45, size=(97, 81))


def setup(positions, faces, device, *, camera=CAMERA, requires_grad=False, **options):
    """Everything there is from positions [vertex, 3] to silhouettes."""
    world = wp.array(np.float32(positions)[None], dtype=wp.vec3, device=device, requires_grad=requires_grad)
    clip = to_clip(world, wp.array(camera.clip_matrix()[None], dtype=wp.mat44, device=device))
    found = found_in(clip, faces, camera.width, camera.height, **options)
    found.world = world
    return found


def found_in(clip, faces, width, height, *, neighbors=None, surfaces=None, creases=None):
    faces = np.asarray(faces, np.int32).reshape(-1, 3)
    neighbors = edge_neighbors(faces) if neighbors is None else neighbors
    indices = wp.array(faces, dtype=wp.vec3i, device=clip.device)
    fragments = rasterize(clip, indices, width, height)
    surfaces, creases = (
        None if numbers is None else wp.array(np.int32(numbers), device=clip.device) for numbers in (surfaces, creases)
    )
    neighbors = wp.array(neighbors, dtype=wp.vec3i, device=clip.device)
    silhouettes = find_silhouettes(fragments, indices, neighbors, clip, surfaces, creases)
    return SimpleNamespace(clip=clip, faces=indices, fragments=fragments, silhouettes=silhouettes)


def on_screen(corners, size, device, depth=1.0):
    """Clip positions of pixel coordinates [vertex, 2]."""
    depth = np.broadcast_to(depth, len(corners))[:, None]
    clip = depth * np.column_stack([2 * np.array(corners) / size - 1, 0.5 / depth, np.ones(len(corners))])
    return wp.array(np.float32(clip)[None], dtype=wp.vec4, device=device)


def mask(found):
    return (found.fragments.face_ids.numpy() >= 0).astype(np.float32)


def coverage(found):
    """Smoothed mask, [height, width]."""
    image = wp.array(mask(found), device=found.clip.device)
    return smooth_silhouettes(image, found.silhouettes, found.clip).numpy()[0]


def lines_as_seen(found):
    """What lies between pixels: {(pixel, side 0 or 2): [the edge as the pixel has it, as its neighbor has it]}."""
    width = found.fragments.face_ids.shape[2]
    between = {}
    for pixel, sides in zip(found.silhouettes.samples.numpy(), found.silhouettes.edges.numpy().tolist(), strict=True):
        for side, edge in enumerate(sides):
            if pixel >= 0 and edge[0] != -1:
                first = pixel - (0, 1, 0, width)[side]
                between.setdefault((int(first), side & 2), [None, None])[side & 1] = edge
    return between


def lines(found):
    """What lies between pixels, of which both know the same: {(pixel, side 0 or 2): the two numbers of the edge}."""
    between = lines_as_seen(found)
    assert all(edge == its_edge for edge, its_edge in between.values())
    return {place: edge for place, (edge, _) in between.items()}


def triangle(angle=0.3):
    corners = angle + np.array([0, 2.2, 4.0])
    return np.stack([np.cos(corners), np.sin(corners), np.zeros(3)], axis=1)


def pixel_area(positions, camera=CAMERA):
    """Exact area of a projected triangle [pixels]."""
    a, b, c = camera.project(positions)
    return abs((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])) / 2


def supersampled(found_at, supersampling):
    """Coverage by across² samples a pixel."""
    fine = mask(found_at(CAMERA.resized(supersampling)))[0]
    return fine.reshape(CAMERA.height, supersampling, CAMERA.width, supersampling).mean((1, 3))


# ------------------------------------------------------------------------------------------------- the float64 twin


def twin(image, found, clip, at_rest, follows_points=False):
    """Smoothed image [height, width, channel] for clip positions [vertex, 4]; lines lean as they do at rest.

    With ``follows_points`` its derivative is the gradient: the point of an edge that is in a row at rest counts by its
    motion along the row, wholly, and areas do not overlap.
    """
    height, width, _ = image.shape
    face_ids = found.fragments.face_ids.numpy()[0].ravel()
    faces = found.faces.numpy()
    colors = image.reshape(height * width, -1)
    smoothed = colors.copy()

    def ray(pixel):
        return np.array([(2 * (pixel % width) + 1) / width - 1, (2 * (pixel // width) + 1) / height - 1, 1.0])

    def plane(positions, pixel):
        return np.linalg.solve(positions[faces[face_ids[pixel]]][:, [0, 1, 3]], np.ones(3))

    def closer(pixel):
        return (plane(clip, pixel) - plane(at_rest, pixel)) @ ray(pixel)

    def share(pixel, other, edge, axis):
        step = ray(other) - ray(pixel)
        if edge[0] >= 0:
            ends, ends_at_rest = (positions[edge][:, [0, 1, 3]] for positions in (clip, at_rest))
            line, line_at_rest = np.cross(*ends), np.cross(*ends_at_rest)
            t = -line @ ray(pixel) / (line @ step)
            if follows_points:
                offsets = ends_at_rest[:, 1 - axis] - ray(pixel)[1 - axis] * ends_at_rest[:, 2]
                point = offsets[::-1] * [1, -1] @ ends
                t = (point[axis] / point[2] - ray(pixel)[axis]) / step[axis]
        else:
            line_at_rest = plane(at_rest, pixel) - plane(at_rest, other)
            t = -(line_at_rest @ ray(pixel) + closer(pixel) - closer(other)) / (line_at_rest @ step)
        size = np.array([width, height])
        lean = abs(line_at_rest[1 - axis] * size[axis] / (line_at_rest[axis] * size[1 - axis]))
        m, t = min(lean, 1.0), np.clip(t, 0, 1)
        area = 0.5 - t if t <= (1 - m) / 2 else max((1 + m) / 2 - t, 0) ** 2 / (2 * m)
        return area, 1.0 if follows_points and edge[0] >= 0 else 1 / (1 + lean**4)

    found_edges, entries = found.silhouettes.edges.numpy(), found.silhouettes.entries.numpy()
    for pixel, edges in zip(found.silhouettes.samples.numpy(), found_edges, strict=True):
        if pixel >= 0:
            others = pixel + np.array([1, -1, width, -width])
            shares = [(0.0, 0.0, False)] * 4
            for side, (other, edge) in enumerate(zip(others, edges, strict=True)):
                if edge[0] != -1:
                    is_crease = (found_edges[entries[other], side ^ 1] != edge).any()
                    shares[side] = *share(pixel, other, edge, side // 2), is_crease
            for side, (area, counts, is_crease) in enumerate(shares):
                if area > 0:
                    overlapping = [] if follows_points else shares[2:] if side < 2 else shares[:2]
                    for its_area, its_counts, is_its_crease in overlapping:
                        part = 0.5 if is_crease == is_its_crease else float(is_crease)
                        counts -= part * max(shares[side][1] + its_counts - 1, 0) * its_area
                    smoothed[pixel] += area * counts * (colors[others[side]] - colors[pixel])
    return smoothed.reshape(image.shape)


SMALL = ws.Camera.look_at((0.3, 0.2, 4), (0, 0, 0), fov_y=45, size=(26, 22))
TETRAHEDRON = SimpleNamespace(
    positions=0.7 * np.array([[1, 0.9, 1.1], [1.2, -1, -1], [-1, 1.1, -0.8], [-1.1, -1, 1]]),
    faces=np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]),
)


@pytest.fixture
def small(device):
    """Edges, creases and intersections in an image of 26 × 22."""
    positions, faces, bodies = through_plane(TETRAHEDRON)
    mesh = ws.Mesh(positions, faces).creased()
    given = {"neighbors": mesh.surface.neighbors, "surfaces": bodies, "creases": mesh.creases}
    found = setup(mesh.positions, mesh.surface.faces, device, camera=SMALL, **given)
    kinds = [edge[0] if edge == its_edge else "crease" for edge, its_edge in lines_as_seen(found).values()]
    assert kinds.count("crease") > 15 and kinds.count(-2) > 5 and len(kinds) > 100
    return found


@pytest.mark.parametrize(("dtype", "channels"), [(wp.float32, 1), (wp.vec3, 3), (wp.vec4, 4)])
def test_a_smoothed_image_is_that_of_the_twin(dtype, channels, small, device, poisoned_outputs):
    image = np.random.default_rng(0).normal(size=(22, 26, channels))
    values = wp.array(np.float32(image if channels > 1 else image[..., 0])[None], dtype=dtype, device=device)
    smoothed = smooth_silhouettes(values, small.silhouettes, small.clip).numpy().reshape(image.shape)
    at_rest = small.clip.numpy()[0].astype(np.float64)
    np.testing.assert_allclose(smoothed, twin(image, small, at_rest, at_rest), atol=FLOAT32)


@pytest.mark.slow
def test_gradients_are_central_differences_of_the_twin(small, device, verified_tape, poisoned_outputs):
    rng = np.random.default_rng(1)
    image, weights, other_image = rng.normal(size=(3, 22, 26, 3))
    values = wp.array(np.float32(image)[None], dtype=wp.vec3, device=device, requires_grad=True)
    clip = wp.clone(small.clip, requires_grad=True)
    with wp.Tape() as tape:
        smoothed = smooth_silhouettes(values, small.silhouettes, clip)
    tape.backward(grads={smoothed: wp.array(np.float32(weights)[None], dtype=wp.vec3, device=device)})
    at_rest = small.clip.numpy()[0].astype(np.float64)

    along = np.sum(weights * twin(other_image, small, at_rest, at_rest))  # linear in the image
    assert np.sum(values.grad.numpy()[0] * other_image) == pytest.approx(along, rel=FLOAT32)

    gradient, expected = clip.grad.numpy()[0].astype(np.float64), []
    assert (np.abs(gradient).sum(axis=1) > 0).sum() >= 10  # vertices that are seen
    directions = rng.normal(size=(16, *at_rest.shape))
    for step in 1e-6 * directions:
        ahead, behind = (twin(image, small, at_rest + sign * step, at_rest, follows_points=True) for sign in (1, -1))
        expected.append(np.sum(weights * (ahead - behind)) / 2e-6)
    along = np.sum(gradient * directions, axis=(1, 2))
    assert np.linalg.norm(along - expected) < FLOAT32 * np.linalg.norm(expected)


# --------------------------------------------------------------------------------------------------- what is found


def test_the_edges_found_are_the_outline_of_a_convex_body(device):
    """Between two pixels of which one sees the body there is its outline, once: compared with all edges in float64."""
    mesh = ws.icosphere(1.0, 2)
    positions = mesh.positions + [0.013, 0.027, 0.0]
    found = setup(positions, mesh.faces, device)
    pixels = CAMERA.project(positions)
    sides = np.diff(pixels[mesh.faces], axis=1)
    is_front = np.linalg.det(sides) > 0
    neighbors = edge_neighbors(mesh.faces)
    outline = [
        (mesh.faces[face, (k + 1) % 3], mesh.faces[face, (k + 2) % 3])
        for face, k in np.argwhere(is_front[:, None] & ~is_front[neighbors])
    ]
    seen, expected = mask(found)[0], {}
    for pixel in range(CAMERA.width * CAMERA.height):
        row, column = divmod(pixel, CAMERA.width)
        for axis, other in ((0, (row, column + 1)), (1, (row + 1, column))):
            if other[0] < CAMERA.height and other[1] < CAMERA.width and seen[row, column] != seen[other]:
                center = np.array([column, row]) + 0.5
                for i, j in outline:
                    p, q = pixels[i] - center, pixels[j] - center
                    if p[1 - axis] * q[1 - axis] <= 0:
                        t = (p[axis] * q[1 - axis] - q[axis] * p[1 - axis]) / (q[1 - axis] - p[1 - axis])
                        if 0 <= t <= 1:
                            assert (pixel, 2 * axis) not in expected
                            expected[pixel, 2 * axis] = {i, j}
    assert len(expected) > 100
    assert {place: set(edge) for place, edge in lines(found).items()} == expected


def test_a_body_in_front_of_another_has_its_own_edges_only(device):
    near, far = ws.icosphere(0.5, 2), ws.icosphere(1.0, 2)
    positions = np.concatenate([near.positions + [0.4, 0.1, 1.5], far.positions])
    faces = np.concatenate([near.faces, far.faces + len(near.positions)])
    both = setup(positions, faces, device)
    alone = setup(positions, near.faces, device)
    is_near = (both.fragments.face_ids.numpy() >= 0) & (both.fragments.face_ids.numpy() < len(near.faces))
    np.testing.assert_array_equal(is_near, mask(alone) == 1)
    image = wp.array(np.float32(is_near), device=device)
    smoothed = smooth_silhouettes(image, both.silhouettes, both.clip)
    difference = np.abs(smoothed.numpy()[0] - coverage(alone))
    assert (difference > 0).sum() <= 8  # where the outlines meet, pixels have edges of both
    assert difference.max() < 0.01


QUADS = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]


def test_where_both_surfaces_end_the_nearer_one_has_the_edge(device):
    """The left one ends at 4.2, before the right one, which begins at 3.9, below it."""
    corners = [[-9, -9], [4.2, -9], [4.2, 9], [-9, 9], [3.9, -9], [19, -9], [19, 9], [3.9, 9]]
    clip = on_screen(corners, (8, 6), device, depth=np.repeat([1.0, 2.0], 4))
    found = found_in(clip, QUADS, 8, 6)
    assert {tuple(sorted(edge)) for edge in lines(found).values()} == {(1, 2)}
    values = wp.array((found.fragments.face_ids.numpy() < 2).astype(np.float32), device=device)
    smoothed = smooth_silhouettes(values, found.silhouettes, clip).numpy()[0]
    np.testing.assert_allclose(smoothed, np.tile([1, 1, 1, 1, 0.2, 0, 0, 0], (6, 1)), atol=FLOAT32)


def test_a_surface_that_ends_before_one_that_comes_nearer_has_the_edge(device):
    """The ground goes back so fast that it is nearer than the other surface at 3.5, farther at 4.2, where that ends."""
    corners = [[-1, -9], [9, -9], [9, 9], [-1, 9], [4.2, -9], [19, -9], [19, 9], [4.2, 9]]
    clip = on_screen(corners, (8, 6), device, depth=[1.0, 12.0, 12.0, 1.0, *[1.9] * 4])
    found = found_in(clip, QUADS, 8, 6)
    depth = interpolate(found.fragments, found.faces, wp.array(clip.numpy()[..., 3], device=device)).numpy()[0, 0]
    assert depth[3] < depth[4] and (found.fragments.face_ids.numpy()[0, 0] >= 2).tolist() == [False] * 4 + [True] * 4
    assert {tuple(sorted(edge)) for edge in lines(found).values()} == {(4, 7)}


def test_edges_within_rounding_of_pixel_centers_are_found(device):
    """Vertices snap when they are rasterized, so that an edge may be on the other side of a center than its pixel."""
    count = 64
    shifts = np.linspace(-3e-4, 3e-4, count)
    corners = [
        [[-9, 2 * k], [4.5 + shift, 2 * k], [4.5 + shift, 2 * k + 1], [-9, 2 * k + 1]] for k, shift in enumerate(shifts)
    ]
    faces = (np.array(QUADS[:2]) + 4 * np.arange(count)[:, None, None]).reshape(-1, 3)
    alpha = coverage(found_in(on_screen(np.concatenate(corners), (9, 2 * count), device), faces, 9, 2 * count))
    np.testing.assert_allclose(alpha[::2, 4], 0.5, atol=1e-3)


def test_every_change_of_the_mask_has_its_edge_also_where_faces_pass_the_eye(device):
    """Two hundred triangles, each alone, with corners before and behind the eye."""
    rng = np.random.default_rng(8)
    points = rng.normal(size=(200, 3, 3))
    assert ((points[..., 2] > 0).any(axis=1) & (points[..., 2] < 0).any(axis=1)).mean() > 0.5
    clip = np.concatenate([points[..., :2], np.full((200, 3, 1), 1e-5), points[..., 2:]], axis=-1)
    found = found_in(wp.array(np.float32(clip), dtype=wp.vec4, device=device), [[0, 1, 2]], 23, 19)
    seen = mask(found)
    changes = {(int(pixel), side) for pixel, side in mask_changes(seen)}
    assert len(changes) > 2000
    # vertices far off the screen are rounded, too: measured 0.2% on a CPU, 0.4% on a GPU
    assert len(changes - lines(found).keys()) <= 6e-3 * len(changes)
    assert lines(found).keys() <= changes


def mask_changes(seen):
    """Pixel and side of each change, from images [batch, height, width]."""
    _, height, width = seen.shape
    for side, (batch, row, column) in (
        (0, np.nonzero(seen[:, :, 1:] != seen[:, :, :-1])),
        (2, np.nonzero(seen[:, 1:] != seen[:, :-1])),
    ):
        for pixel in (batch * height + row) * width + column:
            yield pixel, side


def test_inner_edges_and_seams_are_left_alone(device):
    """A plane of many faces, of one color each: its inner edges are no silhouettes, so colors stay what they were."""
    mesh = ws.plane(40.0, 8)
    camera = ws.Camera.look_at((0, 5, 3), (0, 0, 0), fov_y=45, size=(64, 64))
    found = setup(mesh.positions, mesh.faces, device, camera=camera)
    assert mask(found).all() and not lines(found)
    values = wp.array(found.fragments.face_ids.numpy().astype(np.float32), device=device)
    smoothed = smooth_silhouettes(values, found.silhouettes, found.clip)
    np.testing.assert_array_equal(smoothed.numpy(), values.numpy())


def test_faces_with_vertices_of_their_own_are_one_surface_by_position(device):
    mesh = ws.icosphere(1.0, 2)
    apart = mesh.positions[mesh.faces].reshape(-1, 3)
    faces = np.arange(len(apart)).reshape(-1, 3)
    found = setup(apart, faces, device, neighbors=edge_neighbors(faces, apart))
    np.testing.assert_array_equal(coverage(found), coverage(setup(mesh.positions, mesh.faces, device)))


def test_how_faces_wind_does_not_matter(device):
    positions, faces, bodies = through_plane(ws.icosphere(0.8, 2))
    turned = faces.copy()
    turned[::3] = turned[::3, ::-1]
    expected = setup(positions, faces, device, surfaces=bodies)
    assert lines(setup(positions, turned, device, surfaces=bodies)).keys() == lines(expected).keys()


def test_small_faces_are_walked_over(device):
    """Faces far below a pixel: the outline is a few of them away from what the pixels beside it see."""
    fine, coarse = (setup((m := ws.icosphere(1.0, n)).positions, m.faces, device) for n in (6, 5))
    assert len(np.unique(fine.fragments.face_ids.numpy())) > 0.9 * mask(fine).sum()
    row_changes = np.sum(mask(fine)[0][:, 1:] != mask(fine)[0][:, :-1])
    assert sum(side == 0 for _, side in lines(fine)) == row_changes
    assert np.abs(coverage(fine) - coverage(coarse)).max() < 0.05


ROOF = ws.Mesh(
    np.array([[-1, -0.7, 0], [-1, 0.7, 0], [0.1, -0.9, 0.6], [0.2, 0.8, 0.5], [1, -0.7, 0], [1, 0.7, 0]]),
    np.array([[0, 2, 1], [1, 2, 3], [2, 4, 3], [3, 4, 5]]),
)
"""Two slopes, whose ridge is upright in the image."""


@pytest.mark.parametrize("turn", [1, -1], ids=["from above", "from below"])
def test_at_a_crease_each_pixel_has_the_edge_of_its_side(turn, device):
    mesh = ROOF.creased()
    flip = [turn, 1, turn]
    given = {"neighbors": mesh.surface.neighbors, "creases": mesh.creases}
    found = setup(mesh.positions * flip, mesh.faces, device, **given)
    outline = lines(setup(ROOF.positions * flip, ROOF.faces, device))
    creases = {place: edges for place, edges in lines_as_seen(found).items() if edges[0] != edges[1]}
    assert lines_as_seen(found).keys() - creases.keys() == outline.keys()
    slope = np.append([1, 1, 2, 2], 0)[found.fragments.face_ids.numpy()[0]]
    differs = {0: slope[:, 1:] * slope[:, :-1] == 2, 2: slope[1:] * slope[:-1] == 2}
    between = {(row * CAMERA.width + column, side) for side in differs for row, column in np.argwhere(differs[side])}
    assert creases.keys() == between and len(between) > 30
    for (pixel, side), edges in creases.items():
        for place, edge in zip((pixel, pixel + (1 if side == 0 else CAMERA.width)), edges, strict=True):
            assert np.isin(edge, mesh.faces[2 * slope.ravel()[place] - 2 : 2 * slope.ravel()[place]]).all()
            assert sorted(mesh.origins[edge]) == [2, 3]


def test_where_a_crease_ends_a_pixel_has_the_coverage_that_it_has_without(device):
    mesh = ROOF.creased()
    given = {"neighbors": mesh.surface.neighbors, "creases": mesh.creases}
    found = setup(mesh.positions, mesh.faces, device, **given)
    np.testing.assert_array_equal(coverage(found), coverage(setup(ROOF.positions, ROOF.faces, device)))


BALL, GROUND = 2, 3


def test_surfaces_intersect_where_they_are_told_apart(device):
    """Between a pixel of the ball and one of the plane lies an edge or an intersection."""
    positions, faces, bodies = through_plane(ws.icosphere(0.8, 2))
    found = setup(positions, faces, device, surfaces=bodies)
    edges_only = setup(positions, faces, device)
    body = np.append(np.array([BALL, GROUND])[bodies], 1)[found.fragments.face_ids.numpy()[0]]
    differs = {0: body[:, 1:] * body[:, :-1] == BALL * GROUND, 2: body[1:] * body[:-1] == BALL * GROUND}
    between = {(row * CAMERA.width + column, side) for side in differs for row, column in np.argwhere(differs[side])}
    assert between <= lines(found).keys()
    intersections = {place for place, edge in lines(found).items() if edge[0] == -2}
    assert len(intersections) > 30 and intersections <= between
    assert lines(edges_only).keys() == lines(found).keys() - intersections


def test_each_pixel_has_one_entry(device):
    positions, faces, bodies = through_plane(ws.icosphere(0.8, 2))
    pixels = setup(positions, faces, device, surfaces=bodies).silhouettes.samples.numpy()
    pixels = pixels[pixels >= 0]
    assert len(np.unique(pixels)) == len(pixels)


def test_without_reading_the_count_back_the_result_is_the_same(device, monkeypatch):
    """As while a CUDA graph is captured."""
    mesh = ROOF.creased()
    given = mesh.positions, mesh.faces, device
    options = {"neighbors": mesh.surface.neighbors, "creases": mesh.creases}
    values = wp.array(np.float32(np.random.default_rng(9).normal(size=(1, 81, 97))), device=device)
    alone = setup(*given, **options)
    monkeypatch.setattr(wp.Device, "is_capturing", True)
    found = setup(*given, **options)
    monkeypatch.undo()
    assert found.silhouettes.samples.size == values.size
    expected, got = (smooth_silhouettes(values, each.silhouettes, each.clip).numpy() for each in (alone, found))
    np.testing.assert_array_equal(got, expected)


def test_more_samples_than_int32_counts_are_refused(device, monkeypatch):
    monkeypatch.setattr(silhouettes_file, "MAX_SAMPLES", 81 * 97 - 1)
    mesh = ws.icosphere(1.0, 1)
    with pytest.raises(ValueError, match="fragments: got 7857 samples in all, expected at most 7856"):
        setup(mesh.positions, mesh.faces, device)


def test_as_many_samples_are_accepted_as_strides_of_int32_reach():
    check_strides((4, MAX_SAMPLES), wp.int32)
    with pytest.raises(MemoryError):
        check_strides((4, MAX_SAMPLES + 1), wp.int32)


def test_several_threads_that_follow_an_edge_find_the_same(device, monkeypatch):
    mesh = ws.icosphere(1.0, 1)
    expected = lines(setup(mesh.positions, mesh.faces, device))
    monkeypatch.setattr(silhouettes_file, "strip_count", lambda device: 7)
    assert lines(setup(mesh.positions, mesh.faces, device)) == expected


def test_nothing_seen_has_no_silhouettes(device):
    found = setup(triangle() + [0, 0, 10], [[0, 1, 2]], device)
    assert found.silhouettes.samples.size == 0
    assert (coverage(found) == 0).all()


# ------------------------------------------------------------------------------------------------------- topology


def test_edges_know_their_neighbors_by_position():
    faces = np.array([[0, 1, 2], [2, 1, 3], [4, 5, 6], [1, 3, 7], [7, 8, 9], [7, 8, 10], [7, 8, 11]])
    neighbors = edge_neighbors(faces)
    assert neighbors[0].tolist() == [1, -1, -1]  # edge 1-2 is opposite to corner 0
    assert neighbors[1].tolist() == [3, -1, 0]
    assert neighbors[2].tolist() == [-1, -1, -1]
    assert [row[2] for row in neighbors[4:].tolist()] == [-2, -2, -2]  # three faces meet at 7-8


def test_vertices_at_one_place_count_as_one_when_asked():
    mesh = ws.icosphere(1.0, 1)
    apart = mesh.positions[mesh.faces].reshape(-1, 3)
    faces = np.arange(len(apart)).reshape(-1, 3)
    assert (edge_neighbors(faces) == -1).all()
    np.testing.assert_array_equal(edge_neighbors(faces, apart), edge_neighbors(mesh.faces))


def test_a_face_without_area_between_two_others_does_not_part_them():
    """As at the pole of a sphere of longitudes and latitudes, whose rows of vertices meet there."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0]])
    neighbors = edge_neighbors(np.array([[0, 1, 2], [1, 3, 2], [2, 3, 4]]), positions)
    assert neighbors.tolist() == [[2, -1, -1], [-1, -1, -1], [-1, -1, 0]]


# ------------------------------------------------------------------------------------------------------- coverage


@pytest.mark.parametrize("angle", np.linspace(0, 2, 7))
def test_the_coverage_of_a_triangle_is_its_area(angle, device):
    positions = triangle(angle)
    alpha = coverage(setup(positions, [[0, 1, 2]], device))
    assert alpha.min() >= 0 and alpha.max() <= 1
    assert abs(alpha.sum() - pixel_area(positions)) < AREA * pixel_area(positions)


def area_beside(normal, offset):
    """Area of each pixel on the side of a line where normal·(x, y) < offset, exactly."""
    row, column = np.mgrid[: CAMERA.height, : CAMERA.width]
    a, b = np.sort(np.abs(normal))
    t = offset - (column + 0.5) * normal[0] - (row + 0.5) * normal[1] + (a + b) / 2  # from the corner that is first in
    ramps = [np.maximum(t - shift, 0) ** 2 for shift in (0, a, b, a + b)]
    if a < 1e-9:
        return np.clip(t / b, 0, 1)
    return (ramps[0] - ramps[1] - ramps[2] + ramps[3]) / (2 * a * b)


@pytest.mark.parametrize("angle", np.linspace(0, 1.5, 7))
def test_a_straight_edge_leaves_each_pixel_its_exact_area(angle, device):
    """One edge of a triangle that is larger than the image."""
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    positions = np.array([[0.3, -30, 0], [0.3, 30, 0], [-60, 0, 0]]) @ turn.T
    alpha = coverage(setup(positions, [[0, 1, 2]], device))
    low, high, inside = CAMERA.project(positions)
    normal = np.array([high[1] - low[1], low[0] - high[0]]) / np.linalg.norm(high - low)
    normal *= np.sign(normal @ (low - inside))
    exact = area_beside(normal, normal @ low)
    assert 60 < ((exact > 1e-6) & (exact < 1 - 1e-6)).sum() < 300
    inner = np.s_[1:-1, 1:-1]  # beyond the border there is no neighbor
    assert np.abs(alpha - exact)[inner].max() < STRAIGHT


def test_an_upright_box_within_a_pixel_keeps_its_area(device):
    """Edges on all four sides of one center: what two of them cut off counts once."""
    box = on_screen([[4.3, 3.2], [4.9, 3.2], [4.9, 3.7], [4.3, 3.7]], (9, 7), device)
    alpha = coverage(found_in(box, [[0, 1, 2], [0, 2, 3]], 9, 7))
    assert alpha[3, 4] == pytest.approx(0.6 * 0.5, abs=FLOAT32)
    assert alpha.sum() == alpha[3, 4]


def test_coverage_is_near_that_of_many_samples(device):
    """The bunny that ships with Warp."""
    pytest.importorskip("pxr", reason="needs usd-core")
    mesh = ws.load_mesh(Path(warp.examples.get_asset_directory()) / "bunny.usd")
    low, high = mesh.bounds
    positions = 2.8 * (mesh.positions - (low + high) / 2) / (high - low).max()
    found = setup(positions, mesh.faces, device)
    exact = supersampled(lambda camera: setup(positions, mesh.faces, device, camera=camera), 16)
    cut = (exact > 0) & (exact < 1)
    assert cut.sum() > 150
    assert np.abs(mask(found)[0] - exact)[cut].mean() > 0.15
    assert np.abs(coverage(found) - exact)[cut].mean() < COVERAGE


def test_a_part_of_an_image_is_smoothed_as_in_the_whole_but_for_its_border(device):
    """A window at which a triangle goes out on three sides."""
    positions = 1.3 * triangle(0.1)
    left, top, width, height = 20, 10, 50, 40
    intrinsics = CAMERA.intrinsics - np.array([[0, 0, left], [0, 0, top], [0, 0, 0]])
    window = ws.Camera(intrinsics, CAMERA.rotation, CAMERA.translation, width, height, CAMERA.near)
    whole = coverage(setup(positions, [[0, 1, 2]], device))[top : top + height, left : left + width]
    part = coverage(setup(positions, [[0, 1, 2]], device, camera=window))
    border = np.concatenate([part[0], part[-1], part[:, 0], part[:, -1]])
    assert ((border > 0) & (border < 1)).sum() >= 3
    np.testing.assert_allclose(part[1:-1, 1:-1], whole[1:-1, 1:-1], atol=FLOAT32)


def test_an_upright_edge_leaves_its_pixels_nothing_beyond_itself(device):
    """It leans by nothing at all, which is divided by otherwise."""
    clip = on_screen([[2.3, -20.0], [2.3, 20.0], [-30.0, 0.0]], (7, 5), device)
    alpha = coverage(found_in(clip, [[0, 1, 2]], 7, 5))
    np.testing.assert_allclose(alpha, np.tile([1, 1, 0.3, 0, 0, 0, 0], (5, 1)), atol=FLOAT32)


def test_a_face_that_passes_beside_the_eye_keeps_its_area(device):
    """Two of its corners are far ahead and one is behind: edges are smoothed up to the border of the image."""
    positions = np.array([[0, -1, 8], [1, -1, -8], [-1, -1, -8]])
    assert (positions[:, 2] > 4).any()  # behind the eye
    alpha = coverage(setup(positions, [[0, 1, 2]], device))
    exact = supersampled(lambda camera: setup(positions, [[0, 1, 2]], device, camera=camera), 16)
    cut = (exact > 0) & (exact < 1)
    cut[[0, -1]] = cut[:, [0, -1]] = False
    assert cut.sum() > 50
    assert np.abs(alpha - exact)[cut].mean() < COVERAGE


# ------------------------------------------------------------------------------------------------------ gradients


def test_the_gradient_of_coverage_is_that_of_the_area_averaged_over_angles(device):
    """Growing a triangle by s changes its area by 2·area/s; the sum over vertices of their gradients says so."""
    got, expected = 0.0, 0.0
    for angle in np.linspace(0, 2, 9):
        positions = triangle(angle)
        with wp.Tape() as tape:
            found = setup(positions, [[0, 1, 2]], device, requires_grad=True)
            alpha = smooth_silhouettes(wp.array(mask(found), device=device), found.silhouettes, found.clip)
        tape.backward(grads={alpha: wp.ones_like(alpha)})
        got += np.sum(found.world.grad.numpy()[0] * positions)
        expected += 2 * pixel_area(positions)
    assert abs(got - expected) < AREA_GRADIENT * expected


def coverage_gradients(corners, faces, size, weights, device):
    """Gradient of weighted coverage by pixel coordinates [instance, vertex, 2], like them."""
    depth = np.ones((*corners.shape[:2], 1))
    clip = np.concatenate([2 * corners / size - 1, 0.5 * depth, depth], axis=-1)
    clip = wp.array(np.float32(clip), dtype=wp.vec4, device=device, requires_grad=True)
    with wp.Tape() as tape:
        found = found_in(clip, faces, size, size)
        alpha = smooth_silhouettes(wp.array(mask(found), device=device), found.silhouettes, clip)
    weights = np.ascontiguousarray(np.broadcast_to(np.float32(weights), alpha.shape))
    tape.backward(grads={alpha: wp.array(weights, device=device)})
    return clip.grad.numpy()[..., :2] * (2 / size)


def test_the_gradient_of_an_upright_box_is_that_of_its_area_averaged_over_positions(device):
    """An edge counts in 2 or in 3 rows where the box is 2.5 high; its own area has the mean."""
    offsets = (np.mgrid[:8, :8].reshape(2, 1, -1).T + 0.5) / 8
    corners = np.array([[4.0, 3.0], [7.6, 3.0], [7.6, 5.5], [4.0, 5.5]]) + offsets
    by_corner = coverage_gradients(corners, [[0, 1, 2], [0, 2, 3]], 12, 1.0, device).mean(axis=0)
    np.testing.assert_allclose(by_corner[[1, 2], 0].sum(), 2.5, rtol=1e-3)  # the right edge
    np.testing.assert_allclose(by_corner[[0, 3], 0].sum(), -2.5, rtol=1e-3)
    np.testing.assert_allclose(by_corner[[2, 3], 1].sum(), 3.6, rtol=2e-2)  # 3 or 4 columns in 5 of 8 offsets
    np.testing.assert_allclose(by_corner[[0, 1], 1].sum(), -3.6, rtol=2e-2)


@pytest.mark.parametrize("teeth", [15, 30, 60])
def test_a_border_with_teeth_of_a_pixel_has_the_gradient_of_its_area_averaged_over_positions(teeth, device):
    """A disc of radius 6, half of it with teeth; only one of the edges between two pixels is found."""
    rng = np.random.default_rng(9)
    angles = np.pi * np.arange(4 * teeth) / (2 * teeth)
    is_tip = (np.arange(4 * teeth) % 2 == 1) & (angles < np.pi)
    outline = (6 * (1 + 0.15 * is_tip))[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    disc = np.concatenate([[[0, 0]], outline])
    faces = [[0, 1 + (k + 1) % len(outline), 1 + k] for k in range(len(outline))]
    corners = 10 + disc + rng.uniform(-0.5, 0.5, (64, 1, 2))
    by_corner = coverage_gradients(corners, faces, 20, 1.0, device).mean(axis=0)
    # either half, moved down, changes the area by the width
    np.testing.assert_allclose(by_corner[1:][angles < np.pi, 1].sum(), 12, rtol=TEETH)
    np.testing.assert_allclose(by_corner[1:][angles >= np.pi, 1].sum(), -12, rtol=TEETH)


@pytest.fixture(params=["before", "through"])
def motion(request, device):
    """A colored ball, before a plane or half in it: its images, and the gradient of a smooth loss by its motion."""
    ball = ws.icosphere(0.8, 2)
    positions, faces, bodies = through_plane(ball)
    is_ball = np.arange(len(positions)) < len(ball.positions)
    positions[is_ball] += [0.1, 0.2, 1.3 if request.param == "before" else 0.3]
    colors = np.where(is_ball[:, None], [0.9, 0.5, 0.2], [0.1, 0.4, 0.8]) + 0.1 * np.cos(2 * positions)
    colors = wp.array(np.float32(colors)[None], dtype=wp.vec3, device=device)

    def image(positions, camera=CAMERA, requires_grad=False):
        found = setup(positions, faces, device, camera=camera, surfaces=bodies, requires_grad=requires_grad)
        return found, interpolate(found.fragments, found.faces, colors)

    def smoothed(positions):
        found, sharp = image(positions)
        return smooth_silhouettes(sharp, found.silhouettes, found.clip).numpy()[0]

    def averaged(positions):
        _, samples = image(positions, CAMERA.resized(8))
        return samples.numpy().reshape(CAMERA.height, 8, CAMERA.width, 8, 3).mean((1, 3))

    row, column = np.mgrid[: CAMERA.height, : CAMERA.width] / 20
    weights = np.stack([np.cos(row + column), np.sin(row), np.cos(column - 2 * row)], axis=-1)
    with wp.Tape() as tape:
        found, sharp = image(positions, requires_grad=True)
        result = smooth_silhouettes(sharp, found.silhouettes, found.clip)
    tape.backward(grads={result: wp.array(np.float32(weights)[None], dtype=wp.vec3, device=device)})
    gradient = found.world.grad.numpy()[0]

    def differences(render, step=0.01):
        """Of the gradient along random affine motions of the ball, and central differences over half a pixel."""
        rng = np.random.default_rng(2)
        pairs = []
        for _ in range(12):
            toward = (positions @ rng.normal(size=(3, 3)) * 0.5 + rng.normal(size=3)) * is_ball[:, None]
            change = render(positions + step * toward) - render(positions - step * toward)
            pairs.append((np.sum(gradient * toward), np.sum(weights * change) / (2 * step)))
        return np.array(pairs).T

    return SimpleNamespace(smoothed=smoothed, averaged=averaged, differences=differences)


@pytest.mark.slow
@pytest.mark.parametrize("image", ["smoothed", "averaged"])
def test_gradients_of_motion_are_differences_of_the_image(image, motion):
    """Of the smoothed image itself, and of one with 64 samples a pixel, on average over directions."""
    got, expected = motion.differences(getattr(motion, image))
    assert np.linalg.norm(got - expected) < MOTION * np.linalg.norm(expected)


def gradients(image, silhouettes, clip, weights):
    """Gradients by an image and clip positions, None by what requires none."""
    with wp.Tape() as tape:
        smoothed = smooth_silhouettes(image, silhouettes, clip)
    tape.backward(grads={smoothed: weights})
    return [None if array.grad is None else array.grad.numpy().copy() for array in (image, clip)]


def assert_sums_equal(got, expected):
    """But for rounding: threads of a GPU add to one gradient in any order."""
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


def test_gradients_are_computed_of_what_requires_them(small, device):
    rng = np.random.default_rng(3)
    image, weights = (wp.array(np.float32(rng.normal(size=(1, 22, 26))), device=device) for _ in range(2))
    variable, moving = wp.clone(image, requires_grad=True), wp.clone(small.clip, requires_grad=True)
    by_image, by_clip = gradients(variable, small.silhouettes, moving, weights)
    variable.grad.zero_()
    moving.grad.zero_()
    alone, nothing = gradients(variable, small.silhouettes, small.clip, weights)
    assert_sums_equal(alone, by_image)
    assert nothing is None
    nothing, alone = gradients(image, small.silhouettes, moving, weights)
    assert_sums_equal(alone, by_clip)
    assert nothing is None
    assert smooth_silhouettes(image, small.silhouettes, small.clip).grad is None


def test_gradients_add_to_what_is_there(small, device):
    rng = np.random.default_rng(4)
    image, weights = (wp.array(np.float32(rng.normal(size=(1, 22, 26))), device=device) for _ in range(2))
    image.requires_grad = True
    moving = wp.clone(small.clip, requires_grad=True)
    once = gradients(image, small.silhouettes, moving, weights)
    with wp.Tape() as tape:
        smoothed = [smooth_silhouettes(image, small.silhouettes, moving) for _ in range(2)]
    tape.zero()
    tape.backward(grads=dict.fromkeys(smoothed, weights))
    for one, array in zip(once, (image, moving), strict=True):
        np.testing.assert_allclose(array.grad.numpy(), 2 * one, rtol=1e-5, atol=1e-5)


def test_results_on_a_cpu_are_the_same_bits_again(small, device):
    if device != "cpu":
        pytest.skip("atomics add up in any order")
    rng = np.random.default_rng(5)
    image, weights = (wp.array(np.float32(rng.normal(size=(1, 22, 26))), device=device) for _ in range(2))

    def results():
        variables = [wp.clone(array, requires_grad=True) for array in (image, small.clip)]
        found = found_in(small.clip, small.faces.numpy(), 26, 22)
        return gradients(variables[0], found.silhouettes, variables[1], weights)

    for first, second in zip(results(), results(), strict=True):
        np.testing.assert_array_equal(first, second)


# -------------------------------------------------------------------------------------------------------- batches


def test_each_instance_of_a_batch_is_what_it_is_alone(device):
    positions, faces, bodies = through_plane(ws.icosphere(0.8, 2))
    rng = np.random.default_rng(6)
    image, weights = np.float32(rng.normal(size=(2, 2, CAMERA.height, CAMERA.width, 3)))
    matrices = wp.array(CAMERA.clip_matrix()[None], dtype=wp.mat44, device=device)
    world = np.float32([positions, positions * [1.1, 0.9, 1.0] + [0.2, -0.1, 0.3]])

    def results(some):
        clip = to_clip(wp.array(world[some], dtype=wp.vec3, device=device), matrices)
        clip.requires_grad = True
        found = found_in(clip, faces, CAMERA.width, CAMERA.height, surfaces=bodies)
        values = wp.array(image[some], dtype=wp.vec3, device=device, requires_grad=True)
        seeds = wp.array(weights[some], dtype=wp.vec3, device=device)
        smoothed = smooth_silhouettes(values, found.silhouettes, clip).numpy()
        return smoothed, *gradients(values, found.silhouettes, clip, seeds)

    for i in range(2):
        for alone, batched in zip(results([i]), results([0, 1]), strict=True):
            assert_sums_equal(batched[i], alone[0])


def test_silhouettes_of_one_view_serve_many_images(small, device):
    rng = np.random.default_rng(7)
    images, weights = np.float32(rng.normal(size=(2, 3, 22, 26)))

    def results(some):
        values = wp.array(images[some], device=device, requires_grad=True)
        moving = wp.clone(small.clip, requires_grad=True)
        smoothed = smooth_silhouettes(values, small.silhouettes, moving).numpy()
        return smoothed, *gradients(values, small.silhouettes, moving, wp.array(weights[some], device=device))

    smoothed, by_image, by_clip = results([0, 1, 2])
    singles = [results([i]) for i in range(3)]
    np.testing.assert_array_equal(smoothed, np.concatenate([single[0] for single in singles]))
    np.testing.assert_array_equal(by_image, np.concatenate([single[1] for single in singles]))
    np.testing.assert_allclose(by_clip, sum(single[2] for single in singles), rtol=1e-4, atol=1e-4)


# ------------------------------------------------------------------------------------------------------- hostility


def hostile_triangles(rng, count, size):
    """Clip positions and faces: of all sizes, through each other and the eye, slivers, edge-on, on pixel centers."""
    centers = rng.uniform((-2, -2, -1), (2, 2, 4), (count, 1, 3))
    points = centers + rng.normal(size=(count, 3, 3)) * 10.0 ** rng.choice([-4, -2, 0, 2, 15], (count, 1, 1))
    kinds = rng.integers(6, size=count)
    points[kinds == 1, 2] = points[kinds == 1, 0] * 0.3 + points[kinds == 1, 1] * 0.7  # no area, or nearly
    points[kinds == 2, 2] = points[kinds == 2, 1]
    points[kinds == 3, :, 0] = 0.0  # edge-on
    clip = np.concatenate([1.5 * points[..., :2], np.full((count, 3, 1), 0.1), points[..., 2:]], axis=-1)
    corners = rng.integers(0, 2 * np.array(size), (count, 3, 2)) / size - 1  # pixel centers and corners
    clip[kinds == 4] = np.concatenate([corners, np.full((count, 3, 2), [0.05, 1.0])], axis=-1)[kinds == 4]
    faces = np.arange(3 * count).reshape(-1, 3)
    faces[kinds == 5] = rng.integers(3 * count, size=(count, 3))[kinds == 5]  # edges of any number of faces
    return np.float32(clip.reshape(-1, 4)), faces


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.sampled_from([(1, 1), (1, 9), (9, 1), (16, 12)]))
@example(seed=3089, size=(9, 1))  # overflow
@example(seed=693097, size=(1, 9))  # surfaces that would intersect around the border
def test_whatever_is_seen_values_and_gradients_are_finite_and_means(device, seed, size):
    rng = np.random.default_rng(seed)
    clip, faces = hostile_triangles(rng, 24, size)
    clip = wp.array(clip[None], dtype=wp.vec4, device=device, requires_grad=True)
    given = {"surfaces": rng.integers(4, size=len(faces)), "creases": rng.integers(8, size=len(faces))}
    found = found_in(clip, faces, *size, **given)
    image = rng.normal(size=(1, size[1], size[0])).astype(np.float32)
    values = wp.array(image, device=device, requires_grad=True)
    with wp.Tape() as tape:
        smoothed = smooth_silhouettes(values, found.silhouettes, clip)
    tape.backward(grads={smoothed: wp.array(rng.normal(size=image.shape).astype(np.float32), device=device)})
    padded = np.pad(image[0], 1, constant_values=np.nan)
    near = np.stack([padded[1:-1, 1:-1], padded[1:-1, 2:], padded[1:-1, :-2], padded[2:, 1:-1], padded[:-2, 1:-1]])
    assert (smoothed.numpy()[0] >= np.nanmin(near, axis=0) - 1e-5).all()
    assert (smoothed.numpy()[0] <= np.nanmax(near, axis=0) + 1e-5).all()
    assert np.isfinite(clip.grad.numpy()).all() and np.isfinite(values.grad.numpy()).all()
    for pixel, side in lines_as_seen(found):  # between neighbors
        assert pixel % size[0] < size[0] - 1 if side == 0 else pixel // size[0] < size[1] - 1


def test_surfaces_in_one_plane_have_bounded_gradients(device):
    """Which of them a pixel sees is rounding; no intersection is made of it."""
    plane = np.array([[-1, -1, 0], [1, -1, 0.3], [1, 1, 0.5], [-1, 1, 0.2]])
    plane[3] = plane[0] + plane[2] - plane[1]
    positions = np.concatenate([plane, plane[[1, 2, 3, 0]] * 0.9 + plane.mean(0) * 0.1])
    found = setup(positions, [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], device, surfaces=[0, 0, 1, 1])
    assert all(edge[0] >= 0 for edge in lines(found).values())


# ---------------------------------------------------------------------------------------------------------- errors


def test_arrays_that_do_not_belong_together_are_refused(small, device):
    image = wp.zeros((1, 22, 26), dtype=wp.vec3, device=device)
    with pytest.raises(ValueError, match="^image: got shape"):
        smooth_silhouettes(wp.zeros((1, 22, 25), dtype=wp.vec3, device=device), small.silhouettes, small.clip)
    with pytest.raises(ValueError, match="^clip_positions: got shape"):
        smooth_silhouettes(image, small.silhouettes, wp.zeros((2, 8), dtype=wp.vec4, device=device))
    with pytest.raises(ValueError, match="^image: got dtype int32"):
        smooth_silhouettes(wp.zeros((1, 22, 26), dtype=wp.int32, device=device), small.silhouettes, small.clip)
    faces, neighbors = small.faces, wp.array(edge_neighbors(small.faces.numpy()), dtype=wp.vec3i, device=device)
    with pytest.raises(ValueError, match="^neighbors: got shape"):
        find_silhouettes(small.fragments, faces, neighbors[:3], small.clip)
    with pytest.raises(ValueError, match="^clip_positions: got shape"):
        find_silhouettes(small.fragments, faces, neighbors, wp.zeros((2, 8), dtype=wp.vec4, device=device))
    wrong = wp.zeros(3, dtype=int, device=device)
    with pytest.raises(ValueError, match="^bodies: got shape"):
        find_silhouettes(small.fragments, faces, neighbors, small.clip, wrong)
    with pytest.raises(ValueError, match="^creases: got shape"):
        find_silhouettes(small.fragments, faces, neighbors, small.clip, None, wrong)
