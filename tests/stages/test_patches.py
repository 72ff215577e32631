"""Patches of bodies and grids of flat ones: what they cover, and where they are lit."""

import numpy as np
import pytest
from meshes import box

import warpshadow as ws
from demos.scenes import shipped_mesh
from warpshadow.maths.contacts import Contact
from warpshadow.stages.bounces.form_factors import patch_mesh, trace_form_factors
from warpshadow.stages.patches import find_patches, find_plane_patches
from warpshadow.stages.planes.grid import squeezed, stretched

ROUNDING = 1e-5


def patches_of(mesh, **options):
    return find_patches(mesh.positions, mesh.surface.faces, is_two_sided=not mesh.surface.is_closed, **options)


def area_of(mesh):
    corners = mesh.positions[mesh.faces].astype(float)
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2


def patch_sample_points(patches, mesh):
    patch_samples = patches.patch_samples
    return np.einsum("sk,skx->sx", patch_samples.barycentrics, mesh.positions[mesh.surface.faces[patch_samples.faces]])


@pytest.fixture(scope="module", params=["bunny", "rocks", "box"])
def mesh(request):
    return box() if request.param == "box" else shipped_mesh(request.param)


def test_patches_cover_the_surface_of_each_side_once(mesh):
    patches = patches_of(mesh)
    sides = 1 if mesh.surface.is_closed else 2
    assert 24 // sides <= patches.count <= 256  # four for each side of a box
    np.testing.assert_allclose(patches.areas.sum(), sides * area_of(mesh), rtol=ROUNDING)
    assert patches.areas.min() > 0
    front, back = patches.patch_of_pieces
    assert set(front) == set(range(patches.count // sides))
    np.testing.assert_array_equal(back, front + patches.count // 2 if sides == 2 else -1)
    pieces = patches.pieces.positions(mesh.positions, mesh.surface.faces)
    areas = np.linalg.norm(np.cross(pieces[:, 1] - pieces[:, 0], pieces[:, 2] - pieces[:, 0]), axis=1) / 2
    np.testing.assert_allclose(np.bincount(front, areas), patches.areas[: patches.count // sides], rtol=ROUNDING)


def joined(*meshes):
    counts = np.cumsum([0, *(len(mesh.positions) for mesh in meshes)])
    positions = np.concatenate([mesh.positions for mesh in meshes])
    return ws.Mesh(positions, np.concatenate([mesh.faces + n for mesh, n in zip(meshes, counts, strict=False)]))


def test_faces_between_boxes_that_touch_belong_to_no_patch():
    """Two steps: the front of the higher one is hidden up to the lower one's height, the back of this all over."""
    low, high = box((1.0, 1.0, 1.0)), box((1.0, 2.0, 1.0)).transformed(translation=np.array([0.0, 0, 1]))
    steps = joined(low, high)
    patches = patches_of(steps)
    pieces = patches.pieces.positions(steps.positions, steps.surface.faces)
    middles, front = pieces.mean(axis=1), patches.patch_of_pieces[0]
    is_between = np.isclose(pieces[..., 2], 1).all(axis=1) & (middles[:, 1] < 0.9)
    assert is_between.sum() > 10 and (front[is_between] == -1).all()
    is_outside = ~np.isclose(pieces[..., 2], 1).all(axis=1)
    assert (front[is_outside] >= 0).all()
    np.testing.assert_allclose(patches.areas.sum(), area_of(steps) - 2, rtol=0.03)
    assert set(front) == {-1, *range(patches.count)}


def test_narrow_steps_are_not_black_where_their_faces_go_on_below_the_next_one(device):
    """Terraces narrower than pieces: rays from outside meet patches, whatever lies inside the next box."""
    low, high = box((3.0, 0.1, 3.0)), box((2.8, 0.1, 2.8)).transformed(translation=np.array([0.1, 0.1, 0.1]))
    steps = joined(low, high)
    patches = patches_of(steps)
    corners = patches.pieces.positions(steps.positions, steps.surface.faces)
    assert np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1).max() > 0.1  # pieces reach below the next box
    places = np.linspace(0.1, 2.9, 60)
    points = np.stack([np.full(60, 0.05), np.full(60, 0.11), places], axis=1)
    normals = np.tile([0.0, -1.0, 0.0], (60, 1))
    of_patches, of_body = (
        trace_form_factors(
            patch_mesh(patches, steps.positions, steps.surface.faces, device=device), *of_faces, points, normals
        )
        for of_faces in ((patches.patch_of_pieces, patches.count), (np.zeros_like(patches.patch_of_pieces), 1))
    )
    seen = of_body.toarray().ravel()
    assert seen.min() > 0.9
    np.testing.assert_allclose(of_patches.toarray().sum(axis=1), seen, atol=0.01)
    hidden = 2 * 2.8**2
    np.testing.assert_allclose(patches.areas.sum(), area_of(steps) - hidden, rtol=0.05)


def test_every_patch_has_up_to_four_patch_samples_on_it_that_weigh_one(mesh):
    patches = patches_of(mesh)
    patch_samples = patches.patch_samples
    assert (np.diff(patch_samples.patches) >= 0).all()
    counts = np.bincount(patch_samples.patches, minlength=patches.count)
    assert counts.min() >= 1 and counts.max() <= 4
    np.testing.assert_allclose(np.bincount(patch_samples.patches, patch_samples.weights), 1, rtol=ROUNDING)
    np.testing.assert_allclose(patch_samples.barycentrics.sum(axis=1), 1, rtol=ROUNDING)
    assert patch_samples.barycentrics.min() >= 0
    # a patch sample is nearer to its patch's middle than the patch is wide
    distance = np.linalg.norm(patch_sample_points(patches, mesh) - patches.centers[patch_samples.patches], axis=1)
    assert (distance < 2 * np.sqrt(patches.areas[patch_samples.patches])).mean() > 0.95
    np.testing.assert_array_equal(patch_samples.is_back, patch_samples.patches >= len(set(patches.patch_of_pieces[0])))


def test_patch_samples_lie_on_large_faces_not_at_their_corners():
    """A vertex of a box sees three of its sides, and none as a patch does."""
    patches = patches_of(box())
    assert patches.patch_samples.barycentrics.max() < 0.99
    assert np.abs(patches.normals).max(axis=1).min() > 1 - ROUNDING  # none goes around an edge


def test_patch_samples_of_small_faces_are_vertices():
    patches = patches_of(shipped_mesh("bunny"))
    assert (patches.patch_samples.barycentrics.max(axis=1) == 1).all()


def test_needles_do_not_make_pieces_without_end():
    needles = np.array([[[0, y, 0], [100, y, 0], [0, y + 1e-4, 0]] for y in range(50)]).reshape(-1, 3)
    positions = np.concatenate([needles, [[0, 0, 1], [1, 0, 1], [0, 1, 1]]])
    patches = find_patches(positions, np.arange(len(positions)).reshape(-1, 3), is_two_sided=True, count=128)
    assert len(patches.pieces.faces) < 40 * 256
    assert patches.areas.sum() == pytest.approx(2 * (0.5 + 50 * 100 * 1e-4 / 2))


def test_patches_are_the_same_again():
    mesh = shipped_mesh("bear")
    first, second = patches_of(mesh), patches_of(mesh)
    np.testing.assert_array_equal(first.patch_of_pieces, second.patch_of_pieces)
    np.testing.assert_array_equal(first.patch_samples.faces, second.patch_samples.faces)


def test_a_mesh_without_area_has_no_patches():
    patches = find_patches(np.zeros((3, 3)), np.array([[0, 1, 2]]), is_two_sided=True)
    assert patches.count == 0 and patches.patch_of_pieces.shape == (2, 0) and not len(patches.patch_samples.faces)


def test_patches_belong_to_the_sphere_whose_surface_is_nearest():
    patches = patches_of(box())
    small, large = [0.4, 0.5, 0.5], [9.0, 0.5, 0.5]  # surfaces at x = 0.5 and x = 1
    nearest = patches.nearest_spheres(np.array([small, large]), np.array([0.1, 8.0]))
    x = patches.centers[:, 0]
    assert (nearest[x < 0.5] == 0).all() and (nearest[x > 0.9] == 1).all()


def flat_patches_of(mesh, **options):
    return find_plane_patches(mesh.positions, mesh.surface.faces, is_two_sided=False, **options)


def test_a_stretch_undoes_a_squeeze():
    z = np.linspace(-50, 50, 41)
    np.testing.assert_allclose(stretched(squeezed(z)), z, atol=1e-12)


def test_a_body_that_is_not_flat_has_no_grid():
    with pytest.raises(ValueError, match="faces: got 12 that do not lie in one plane, expected a flat body"):
        flat_patches_of(box())


@pytest.mark.parametrize("segments", [1, 16])
def test_an_even_grid_has_equal_texels(segments):
    mesh = ws.plane(3.0, segments).transformed(scale=(2, 1, 1), translation=(5, -1, 2))
    patches = flat_patches_of(mesh)
    grid = patches.grid
    assert grid.covered.shape in [(12, 24), (24, 12)] and grid.covered.min() == 1
    np.testing.assert_allclose(patches.areas, 18 / 288, rtol=0.02)
    np.testing.assert_allclose(patches.centers.mean(axis=0), [5, -1, 2], atol=1e-4)
    np.testing.assert_allclose(patches.normals, [[0, 1, 0]] * 288, atol=ROUNDING)
    np.testing.assert_allclose(patch_sample_points(patches, mesh), patches.centers, atol=1e-4)
    np.testing.assert_array_equal(patches.patch_samples.patches, np.arange(288))


def test_a_grid_is_finer_near_other_bodies():
    mesh = ws.plane(20.0, 1)
    others = np.array([[-4.0, 0, 2], [-2, 3, 4]])
    grid = flat_patches_of(mesh, others=others).grid
    assert grid.spread == pytest.approx(1)
    np.testing.assert_allclose(grid.origin, [-3, 0, 3], atol=ROUNDING)
    middles, sizes = grid.middles(), grid.texel_sizes().prod(axis=-1)
    assert np.linalg.norm(middles.reshape(-1, 2)[sizes.argmin()]) < 0.5
    assert sizes.sum() == pytest.approx(400)
    assert sizes.max() > 20 * sizes.min()


def test_a_grid_is_finest_at_a_contact():
    mesh, others = ws.plane(20.0, 1), np.array([[-4.0, 0, 2], [-2, 3, 4]])
    foot, contact = [-3.5, 0, 3], Contact(np.array([[-3.5, 0, 2.9], [-3.5, 0, 3.1]]), 0.5)
    before, patches = flat_patches_of(mesh, others=others), flat_patches_of(mesh, others=others, contact=contact)
    assert patches.grid.covered.shape == (28, 28) and patches.grid.covered.min() == 1
    np.testing.assert_allclose(patch_sample_points(patches, mesh), patches.centers, atol=1e-4)
    near = [each.areas[np.linalg.norm(each.centers - foot, axis=1) < 0.2].max() for each in (before, patches)]
    assert near[1] < 0.01 and near[1] < near[0] / 4


def test_patches_are_smaller_at_a_contact_and_no_more_in_all():
    mesh, foot = ws.icosphere(1.0, 4), np.array([[0.0, -1, 0]])
    before, patches = patches_of(mesh), patches_of(mesh, contacts=[Contact(foot, 1.0)])
    assert 250 <= patches.count <= before.count == 256
    np.testing.assert_allclose(patches.areas.sum(), area_of(mesh), rtol=ROUNDING)
    for distance, least in ((0.1, 15), (0.3, 5)):
        near = [np.linalg.norm(each.centers - foot, axis=1) < distance for each in (before, patches)]
        assert near[1].sum() > least * max(near[0].sum(), 1)
    assert patches.areas.max() < 3.5 * before.areas.max()


def test_a_square_that_is_turned_has_a_grid_of_its_own_size():
    angle = 0.5
    rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    grid = flat_patches_of(ws.plane(2.0, 4).transformed(rotation=rotation)).grid
    assert grid.texel_sizes().sum(axis=(0, 1)) == pytest.approx([2 * 24, 2 * 24], rel=1e-3)
    assert grid.covered.min() == 1
    assert np.linalg.det(grid.frame) == pytest.approx(1)


def test_texels_off_the_mesh_have_no_patch_samples():
    """An L of three squares."""
    corners = np.array([[x, 0, z] for x in range(3) for z in range(3)], float)
    squares = [(0, 1), (0, 0), (1, 0)]
    faces = [[3 * i + j, 3 * i + j + 1, 3 * i + j + 4] for i, j in squares]
    faces += [[3 * i + j, 3 * i + j + 4, 3 * i + j + 3] for i, j in squares]
    mesh = ws.Mesh(corners, faces)
    patches = flat_patches_of(mesh)
    assert patches.areas.sum() == pytest.approx(3, rel=0.02)
    has_patch_sample = np.isin(np.arange(patches.count), patches.patch_samples.patches)
    np.testing.assert_array_equal(has_patch_sample, patches.areas > 0)
    points = patch_sample_points(patches, mesh)
    assert not ((points[:, 0] > 1 + ROUNDING) & (points[:, 2] > 1 + ROUNDING)).any()


def test_both_sides_of_a_grid_have_patches():
    mesh = ws.plane(1.0, 2)
    patches = find_plane_patches(mesh.positions, mesh.surface.faces, is_two_sided=True)
    assert patches.count == 2 * 24 * 24 and patches.grid.sides == 2
    np.testing.assert_allclose(patches.normals[576:], [[0, -1, 0]] * 576, atol=ROUNDING)
    assert patches.patch_samples.is_back[576:].all() and not patches.patch_samples.is_back[:576].any()


def test_pieces_of_a_flat_body_belong_to_the_texels_in_which_they_lie():
    mesh = ws.plane(4.0, 1)
    patches = flat_patches_of(mesh, others=np.array([[0.0, 0, 0], [0.5, 1, 0.5]]))
    pieces = patches.pieces.positions(mesh.positions, mesh.surface.faces)
    areas = np.linalg.norm(np.cross(pieces[:, 1] - pieces[:, 0], pieces[:, 2] - pieces[:, 0]), axis=1) / 2
    assert areas.sum() == pytest.approx(16)
    away = np.linalg.norm(pieces.mean(axis=1) - patches.centers[patches.patch_of_pieces[0]], axis=1)
    assert (away < np.sqrt(patches.areas[patches.patch_of_pieces[0]]) * 1.5).all()
    assert (patches.patch_of_pieces[1] == -1).all()
