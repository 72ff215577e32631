"""Rotations: matrices made of the parameters that an optimizer moves."""

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.device.threads import one_at_a_time
from warpshadow.stages.nearest_rotation import nearest_rotations

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
    q = wp.vec4(wp.normalize(wp.vec4d(quaternions[batch, body])))  # whose length squared may not be a float32
    rotations[batch, body] = wp.quat_to_matrix(wp.quat(q[0], q[1], q[2], q[3]))


@wp.kernel
def _rotate_by_axis_angles(
    # in
    vectors: wp.array2d(dtype=wp.vec3),
    # out
    rotations: wp.array2d(dtype=wp.mat33),
):
    """A thread owns a rotation: R = I + sin θ/θ K + (1 − cos θ)/θ² K², by series near θ = 0."""
    batch, body = wp.tid()
    v = vectors[batch, body]
    t = wp.dot(v, v)
    s = wp.min(t, 0.25)  # the series' adjoints run for all angles, and must not overflow
    a = 1.0 - s / 6.0 * (1.0 - s / 20.0 * (1.0 - s / 42.0 * (1.0 - s / 72.0)))
    b = 0.5 - s / 24.0 * (1.0 - s / 30.0 * (1.0 - s / 56.0 * (1.0 - s / 90.0)))
    if t > 0.25:
        angle = wp.sqrt(t)
        a = wp.sin(angle) / angle
        b = (1.0 - wp.cos(angle)) / t
    k = wp.skew(v)
    rotations[batch, body] = wp.identity(n=3, dtype=wp.float32) + a * k + b * (k * k)


@wp.kernel
def _rotate_by_columns(
    # in
    columns: wp.array2d(dtype=Vec6),
    # out
    rotations: wp.array2d(dtype=wp.mat33),
):
    """A thread owns a rotation: Gram–Schmidt of its first two columns, in float64 as they may be nearly parallel."""
    batch, body = wp.tid()
    c = columns[batch, body]
    x = wp.normalize(wp.vec3d(wp.vec3(c[0], c[1], c[2])))
    y = wp.vec3d(wp.vec3(c[3], c[4], c[5]))
    y = wp.normalize(y - wp.dot(x, y) * x)
    rotations[batch, body] = wp.matrix_from_cols(wp.vec3(x), wp.vec3(y), wp.vec3(wp.cross(x, y)))


_ROTATION_KERNELS = {wp.vec4: _rotate_by_quaternions, wp.vec3: _rotate_by_axis_angles, Vec6: _rotate_by_columns}


@one_at_a_time
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
    check.finite_arrays({"parameters": parameters})
    if parameters.dtype is wp.vec3:
        if parameters.device.is_cpu:
            _warn_of_degrees(parameters.numpy())
        return
    values = parameters.numpy().astype(np.float64)
    if parameters.dtype is wp.vec4:
        _refuse(np.linalg.norm(values, axis=-1) < MIN_LENGTH, f"quaternions shorter than {MIN_LENGTH:g}")
        return
    if parameters.dtype is wp.mat33:
        largest, middle, smallest = np.moveaxis(np.linalg.svd(values, compute_uv=False), -1, 0)
        _refuse(largest < MIN_LENGTH, f"matrices smaller than {MIN_LENGTH:g}")
        gaps = middle + np.sign(np.linalg.det(values / largest[..., None, None])) * smallest
        _refuse(gaps < MIN_ANGLE * largest, "matrices as near to several rotations, as mirrored ones are,")
        return
    x, y = values[..., :3], values[..., 3:]
    lengths = np.linalg.norm(x, axis=-1), np.linalg.norm(y, axis=-1)
    _refuse(np.minimum(*lengths) < MIN_LENGTH, f"columns shorter than {MIN_LENGTH:g}")
    areas = np.linalg.norm(np.cross(x, y), axis=-1)
    _refuse(areas < MIN_ANGLE * lengths[0] * lengths[1], "pairs of parallel columns")


def _refuse(faults: np.ndarray, what: str) -> None:
    """Raise ValueError where there are faults [batch, body]."""
    if faults.any():
        place = tuple(int(i) for i in np.argwhere(faults)[0])
        raise ValueError(f"parameters: got {int(faults.sum())} {what} (first at index {place}), expected rotations")


def check_orthonormal(matrices: np.ndarray) -> None:
    """Raise ValueError for matrices [batch, body, 3, 3] that scale, shear or mirror."""
    check.finite("rotations", matrices)
    products = np.swapaxes(matrices, -1, -2) @ matrices
    gaps, determinants = np.abs(products - np.eye(3)).max(axis=(-1, -2)), np.linalg.det(matrices)
    faults = (gaps > NOT_ORTHONORMAL) | (determinants < 0)
    if faults.any():
        place = tuple(int(i) for i in np.argwhere(faults)[0])
        raise ValueError(
            f"rotations: got {int(faults.sum())} matrices that are no rotations (first at index {place}: det R = "
            f"{determinants[place]:.3g}, |RᵀR − I| = {gaps[place]:.3g}), expected det R > 0 and |RᵀR − I| up to "
            f"{NOT_ORTHONORMAL}, as rotation_matrices makes them of any nine numbers; to resize bodies there are scales"
        )
