"""Sides: whether samples see a face from the front, where its corners run counter-clockwise, or from behind.

An open surface shows both, and each has a light of its own, by normals that point to where it is seen from. Of F faces,
face f is side f from the front, and side F + f from behind; likewise vertex v of V is number v, with its normal, and
number V + v, with the opposite one. The corners of side F + f are the corners of f, plus V.
"""

from dataclasses import replace

import numpy as np
import warp as wp

from warpshadow.device.batch import instance_in, rows
from warpshadow.device.capacities import sizes_of
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty, zeros
from warpshadow.device.parallel import run_length
from warpshadow.stages.raster.rasterization import Fragments

_FACE_RUN = 1024  # faces that a thread owns on a CPU, so that it finds the camera's eye once for all of them


@wp.func
def split_side(number: int, count: int):
    """Split the number of a side into the index of ``count`` faces or vertices, and whether it is the back."""
    is_back = number >= count
    return wp.where(is_back, number - count, number), is_back


@wp.func
def join_side(index: int, is_back: bool, count: int):
    """Number of the front or back of a face or vertex among ``count``: the inverse of `split_side`."""
    return wp.where(is_back, index + count, index)


def split_sides(numbers: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """`split_side` for an array of numbers."""
    is_back = numbers >= count
    return numbers - count * is_back, is_back


@wp.func
def _eye_position(clip_matrix: wp.mat44):
    """Eye of a camera: the point whose x, y and w in clip space are zero."""
    x = wp.vec3d(wp.vec3(clip_matrix[0, 0], clip_matrix[0, 1], clip_matrix[0, 2]))
    y = wp.vec3d(wp.vec3(clip_matrix[1, 0], clip_matrix[1, 1], clip_matrix[1, 2]))
    w = wp.vec3d(wp.vec3(clip_matrix[3, 0], clip_matrix[3, 1], clip_matrix[3, 2]))
    origin_values = wp.vec3d(wp.vec3(clip_matrix[0, 3], clip_matrix[1, 3], clip_matrix[3, 3]))
    determinant_vector = (
        origin_values[0] * wp.cross(y, w) + origin_values[1] * wp.cross(w, x) + origin_values[2] * wp.cross(x, y)
    )
    return -determinant_vector / wp.dot(x, wp.cross(y, w))


@wp.kernel(enable_backward=False)
def _find_backs(
    # in
    positions: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    two_sided_faces: wp.array(dtype=wp.int32),
    clip_matrices: wp.array(dtype=wp.mat44),
    run: int,
    # out
    shows_back: wp.array2d(dtype=wp.bool),
    has_back: wp.array(dtype=wp.int32),
):
    """A thread owns a run of two-sided faces of a view: which of them the eye sees from behind; false before.

    In the world and in float64: in clip space a distant ground, seen at a grazing angle, would be lost in rounding.
    """
    view, thread = wp.tid()
    position_batch = instance_in(view, positions.shape[0])
    eye = _eye_position(clip_matrices[instance_in(view, clip_matrices.shape[0])])
    for i in range(thread * run, wp.min((thread + 1) * run, two_sided_faces.shape[0])):
        face = two_sided_faces[i]
        corners = faces[face]
        a = wp.vec3d(positions[position_batch, corners[0]])
        b = wp.vec3d(positions[position_batch, corners[1]])
        c = wp.vec3d(positions[position_batch, corners[2]])
        if wp.dot(wp.cross(b - a, c - a), a - eye) > wp.float64(0.0):
            shows_back[view, face] = True
            has_back[0] = 1


@wp.kernel(enable_backward=False)
def _find_sides(
    # in
    face_ids: wp.array2d(dtype=wp.int32),
    shows_back: wp.array2d(dtype=wp.bool),
    run: int,
    # out
    sides: wp.array2d(dtype=wp.int32),
    has_back: wp.array(dtype=wp.int32),
):
    """A thread owns a run of samples; ``has_back`` is 0 before."""
    view, thread = wp.tid()
    for sample in range(thread * run, (thread + 1) * run):
        face = face_ids[view, sample]
        is_back = shows_back[view, wp.max(face, 0)] and face >= 0
        sides[view, sample] = join_side(face, is_back, shows_back.shape[1])
        if is_back:
            has_back[0] = 1


def find_sides(
    fragments: Fragments, faces: wp.array, two_sided: wp.array, positions: wp.array, clip_matrices: wp.array
) -> Fragments:
    """Find which side of its face each sample sees.

    Args:
        fragments: The fragments, of shape [batch, height, width].
        faces: Vertex indices, vec3i of shape [face].
        two_sided: The faces of which both sides can be seen, int32 of shape [item].
        positions: Vertices [scene units], vec3 of shape [batch, vertex].
        clip_matrices: Cameras, mat44 of shape [batch]. Either of these batches may be 1 and then serves every instance.
    Returns:
        Fragments with sides; the same as before if no sample sees a back, which is read back as a count of 0 or 1
        (:mod:`warpshadow.device.capacities`).

    Not differentiable: which side is seen changes where a face is seen edge-on.
    """
    device = positions.device
    view_count, height, width = fragments.face_ids.shape
    shows_back = zeros((view_count, faces.shape[0]), wp.bool, device, outlives_recording=False)
    has_back = zeros(2, wp.int32, device, outlives_recording=False)
    run = run_length(device, _FACE_RUN)
    launch(
        _find_backs,
        (view_count, -(-two_sided.shape[0] // run)),
        inputs=[positions, faces, two_sided, clip_matrices, run],
        outputs=[shows_back, has_back[:1]],
    )
    if not sizes_of("backs of faces", has_back[:1], 1)[0]:
        return fragments
    sides = empty(fragments.face_ids.shape, dtype=wp.int32, device=device)
    run = run_length(device, width)
    launch(
        _find_sides,
        (view_count, height * width // run),
        inputs=[rows(fragments.face_ids), shows_back, run],
        outputs=[rows(sides), has_back[1:]],
    )
    if not sizes_of("backs that are seen", has_back[1:], 1)[0]:
        return fragments
    return replace(fragments, sides=sides)
