"""Radiosity at points of faces, of a plane whose radiosity is linear, and of a body that is not flat."""

import numpy as np
import warp as wp

from warpshadow.stages.patches import find_plane_patches
from warpshadow.stages.planes.face_texels import FaceTexels, find_face_texels, radiosity_at
from warpshadow.stages.planes.plane_blockers import PlaneBlockers, PlaneBody

SQUARE = np.array([[-2.0, 0, -2], [-2, 0, 2], [2, 0, 2], [2, 0, -2]])
FACES = np.int32([[0, 1, 2], [0, 2, 3]])
OF_TEXELS = 0.02  # grids are not quite even


@wp.kernel
def _look_up(
    radiosity: wp.array(dtype=wp.vec3),
    texels: FaceTexels,
    faces: wp.array(dtype=wp.vec3i),
    sides: wp.array(dtype=wp.int32),
    weights: wp.array(dtype=wp.vec3),
    found: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    found[i] = radiosity_at(radiosity, texels, faces, sides[i], weights[i])


def test_planes_have_the_radiosity_of_a_point_and_other_faces_have_one(device):
    """The second face is of another body, before the plane; of whose back nothing comes."""
    patches = find_plane_patches(SQUARE, FACES, is_two_sided=False)
    body = PlaneBody(patches.grid, SQUARE, FACES, 3, 0, True)
    blockers = PlaneBlockers.from_bodies([body], patches.count, 7, device=device)
    texels = find_face_texels(blockers, [body], [1], 3, 7)
    matrix = blockers.texels_of_patches.to_scipy()
    of_texels = matrix @ (patches.centers + 3.0) / matrix.sum(axis=1).A1[:, None]
    of_sides = np.arange(18.0).reshape(6, 3)
    of_sides[4:] = 0  # the plane's back
    faces = np.concatenate([[[0, 1, 2]], FACES + 3] * 2)
    rng = np.random.default_rng(0)
    weights, sides = rng.dirichlet(np.full(3, 3.0), 6), np.arange(6)
    found = wp.empty(6, dtype=wp.vec3, device=device)
    arrays = [
        wp.array(values, dtype=dtype, device=device)
        for values, dtype in ((faces, wp.vec3i), (sides, wp.int32), (weights, wp.vec3))
    ]
    radiosity = wp.array(np.concatenate([of_texels, of_sides]), dtype=wp.vec3, device=device)
    wp.launch(_look_up, 6, inputs=[radiosity, texels, *arrays], outputs=[found], device=device)
    points = np.einsum("fc,fcx->fx", weights[1:3], SQUARE[FACES])
    expected = of_sides.copy()
    expected[1:3] = points + 3.0
    np.testing.assert_allclose(found.numpy(), expected, atol=OF_TEXELS * 4)
