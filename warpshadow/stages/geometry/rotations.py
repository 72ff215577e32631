"""Rotations: matrices made of the parameters that an optimizer moves."""

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.array_checks import finite_arrays
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.device.threads import locked
from warpshadow.stages.geometry.nearest_rotation import nearest_rotations

Vec6 = wp.types.vector(length=6, dtype=wp.float32)

MIN_LENGTH = 1.0e-18  # shorter quaternions and columns have no direction: its gradient would be out of float32's range
MIN_ANGLE = 1.0e-6  # columns at a smaller angle [radians] are parallel: the angle is rounding

NOT_ORTHONORMAL = 0.05
"""Largest entry of |RᵀR − I| of a matrix that counts as a rotation: a step of 0.01 in all nine numbers stays below."""


@wp.kernel
def _rotate_by_quaternions(
    # in
    quaternions: wp.array2d(dtype=wp.vec4),
    # out
    rotations: wp.array2d(dtype=wp.mat33),
):
    """A thread owns a rotation."""
    batch, body = wp.tid()
    quaternion = wp.vec4(wp.normalize(wp.vec4d(quaternions[batch, body])))  # whose length squared may not be a float32
    rotations[batch, body] = wp.quat_to_matrix(wp.quat(quaternion[0], quaternion[1], quaternion[2], quaternion[3]))


@wp.kernel
def _rotate_by_axis_angles(
    # in
    vectors: wp.array2d(dtype=wp.vec3),
    # out
    rotations: wp.array2d(dtype=wp.mat33),
):
    """A thread owns a rotation: R = I + sin θ/θ K + (1 − cos θ)/θ² K², by series near θ = 0."""
    batch, body = wp.tid()
    axis_angle = vectors[batch, body]
    angle2 = wp.dot(axis_angle, axis_angle)
    series_angle2 = wp.min(angle2, 0.25)  # the series' adjoints run for all angles, and must not overflow
    sine_ratio = 1.0 - series_angle2 / 6.0 * (
        1.0 - series_angle2 / 20.0 * (1.0 - series_angle2 / 42.0 * (1.0 - series_angle2 / 72.0))
    )
    cosine_ratio = 0.5 - series_angle2 / 24.0 * (
        1.0 - series_angle2 / 30.0 * (1.0 - series_angle2 / 56.0 * (1.0 - series_angle2 / 90.0))
    )
    if angle2 > 0.25:
        angle = wp.sqrt(angle2)
        sine_ratio = wp.sin(angle) / angle
        cosine_ratio = (1.0 - wp.cos(angle)) / angle2
    cross_matrix = wp.skew(axis_angle)
    rotations[batch, body] = (
        wp.identity(n=3, dtype=wp.float32) + sine_ratio * cross_matrix + cosine_ratio * (cross_matrix * cross_matrix)
    )


@wp.kernel
def _rotate_by_columns(
    # in
    columns: wp.array2d(dtype=Vec6),
    # out
    rotations: wp.array2d(dtype=wp.mat33),
):
    """A thread owns a rotation: Gram–Schmidt of its first two columns, in float64 as they may be nearly parallel."""
    batch, body = wp.tid()
    entries = columns[batch, body]
    x = wp.normalize(wp.vec3d(wp.vec3(entries[0], entries[1], entries[2])))
    y = wp.vec3d(wp.vec3(entries[3], entries[4], entries[5]))
    y = wp.normalize(y - wp.dot(x, y) * x)
    rotations[batch, body] = wp.matrix_from_cols(wp.vec3(x), wp.vec3(y), wp.vec3(wp.cross(x, y)))


_ROTATION_KERNELS = {wp.vec4: _rotate_by_quaternions, wp.vec3: _rotate_by_axis_angles, Vec6: _rotate_by_columns}


@locked
def rotation_matrices(parameters: wp.array) -> wp.array:
    """Make rotation matrices of free parameters, such as axis-angle vectors in radians.

    Args:
        parameters: Shape [batch, body]; the dtype decides their meaning: vec4, quaternions (x, y, z, w) of any length
            from 1e-18 on; vec3, axis-angle vectors [radians], smooth at 0; :data:`Vec6`, the first two columns, of
            which Gram–Schmidt makes a rotation (Zhou et al. 2019); mat33, any matrix, whose nearest rotation is taken.
    Returns:
        Rotations, mat33 of shape [batch, body].
    Raises:
        ValueError: for another dtype, for NaN, Inf and numbers beyond 1e18, and for parameters without a rotation:
            quaternions and columns of length 0, parallel columns, and matrices that are as near to several rotations,
            as matrices of rank 1 and mirrored rotations are. (Reading them waits for a GPU. While a CUDA graph is
            captured that cannot be, and nothing is checked.)
    Differentiable: parameters.
    """
    if parameters.dtype not in (*_ROTATION_KERNELS, wp.mat33):
        raise ValueError(f"parameters: got dtype {parameters.dtype.__name__}, expected vec4, vec3, Vec6 or mat33")
    _check_rotations(parameters)
    if parameters.dtype is wp.mat33:
        return nearest_rotations(parameters)
    rotations = empty(parameters.shape, dtype=wp.mat33, device=parameters.device)
    launch(_ROTATION_KERNELS[parameters.dtype], parameters.shape, inputs=[parameters], outputs=[rotations])
    return rotations


def _warn_of_degrees(vectors: np.ndarray) -> None:
    """Warn of axis-angle vectors so long that they may be in degrees."""
    angle = np.sqrt((vectors.astype(np.float64) ** 2).sum(axis=-1).max(initial=0.0))
    if angle > 4 * np.pi:
        check.warn(
            f"parameters: got an axis-angle vector of {angle:.4g} radians, more than two turns; are they degrees? "
            "np.radians or torch.deg2rad converts these"
        )


def _check_rotations(parameters: wp.array) -> None:
    """Raise ValueError for parameters that no rotation has."""
    if parameters.device.is_capturing:
        return
    finite_arrays({"parameters": parameters})
    if parameters.dtype is wp.vec3:
        if parameters.device.is_cpu:
            _warn_of_degrees(parameters.numpy())
        return
    values = parameters.numpy().astype(np.float64)
    if parameters.dtype is wp.vec4:
        _refuse_faults(np.linalg.norm(values, axis=-1) < MIN_LENGTH, f"quaternions shorter than {MIN_LENGTH:g}")
        return
    if parameters.dtype is wp.mat33:
        largest, middle, smallest = np.moveaxis(np.linalg.svd(values, compute_uv=False), -1, 0)
        _refuse_faults(largest < MIN_LENGTH, f"matrices smaller than {MIN_LENGTH:g}")
        gaps = middle + np.sign(np.linalg.det(values / largest[..., None, None])) * smallest
        _refuse_faults(gaps < MIN_ANGLE * largest, "matrices as near to several rotations, as mirrored ones are,")
        return
    x, y = values[..., :3], values[..., 3:]
    lengths = np.linalg.norm(x, axis=-1), np.linalg.norm(y, axis=-1)
    _refuse_faults(np.minimum(*lengths) < MIN_LENGTH, f"columns shorter than {MIN_LENGTH:g}")
    areas = np.linalg.norm(np.cross(x, y), axis=-1)
    _refuse_faults(areas < MIN_ANGLE * lengths[0] * lengths[1], "pairs of parallel columns")


def _refuse_faults(is_faulty: np.ndarray, fault: str) -> None:
    """Raise ValueError where there are faults [batch, body]."""
    if is_faulty.any():
        first_index = tuple(int(i) for i in np.argwhere(is_faulty)[0])
        raise ValueError(
            f"parameters: got {int(is_faulty.sum())} {fault} (first at index {first_index}), expected rotations"
        )


def check_orthonormal(matrices: np.ndarray) -> None:
    """Raise ValueError for matrices [batch, body, 3, 3] that scale, shear or mirror."""
    check.finite("rotations", matrices)
    products = np.swapaxes(matrices, -1, -2) @ matrices
    gaps, determinants = np.abs(products - np.eye(3)).max(axis=(-1, -2)), np.linalg.det(matrices)
    is_faulty = (gaps > NOT_ORTHONORMAL) | (determinants < 0)
    if is_faulty.any():
        first_index = tuple(int(i) for i in np.argwhere(is_faulty)[0])
        raise ValueError(
            f"rotations: got {int(is_faulty.sum())} matrices that are no rotations (first at index {first_index}: "
            f"det R = {determinants[first_index]:.3g}, |RᵀR − I| = {gaps[first_index]:.3g}), expected det R > 0 and "
            f"|RᵀR − I| up to {NOT_ORTHONORMAL}, as rotation_matrices makes them of any nine numbers; to resize bodies "
            "there are scales"
        )
