"""How far below their patches proxies lie: where a body is thin, on the side of the patch."""

import numpy as np
import pytest
from meshes import box

from warpshadow.stages.bounces.proxies import find_depths
from warpshadow.stages.patches import find_patches


def depths_of(size, **options):
    mesh = box(size)
    patches = find_patches(mesh.positions, mesh.surface.faces, is_two_sided=False, **options)
    return patches, find_depths(patches.centers, patches.normals, patches.areas)


def test_proxies_of_a_thick_body_lie_half_a_radius_below():
    patches, depths = depths_of((1, 1, 1), count=64)
    assert patches.count == len(depths) > 30
    np.testing.assert_allclose(depths, 0.5)


@pytest.mark.parametrize("thickness", [0.001, 0.05, 0.2])
def test_proxies_on_both_sides_of_a_slab_do_not_change_sides(thickness):
    patches, depths = depths_of((2, thickness, 2), count=64)
    is_level = np.abs(patches.normals[:, 1]) > 0.9
    heights = patches.centers[:, 1] - thickness / 2 - depths * np.sqrt(patches.areas / 2) * patches.normals[:, 1]
    assert is_level.sum() > 20
    assert (heights * patches.normals[:, 1])[is_level].min() > 0
    assert depths[is_level].min() >= -0.25


def test_proxies_of_a_sheet_lie_a_quarter_of_a_radius_above():
    centers, normals = np.zeros((2, 3)), np.array([[0, 1.0, 0], [0, -1, 0]])
    np.testing.assert_allclose(find_depths(centers, normals, np.ones(2)), -0.25)
    np.testing.assert_allclose(find_depths(centers[:1], normals[:1], np.ones(1)), 0.5)
    assert find_depths(centers[:0], normals[:0], np.ones(0)).shape == (0,)
