"""Projection: from the world to clip space, by cameras that may move."""

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.array_checks import finite_arrays
from warpshadow.device.batch import common_batch, instance_in
from warpshadow.device.launch import launch
from warpshadow.device.memory import empty
from warpshadow.device.threads import locked


@wp.func
def eye_position(clip_matrix: wp.mat44):
    """The point that a camera sees the world from, where x, y and w of clip space are all 0."""
    rows = wp.mat33(
        clip_matrix[0, 0],
        clip_matrix[0, 1],
        clip_matrix[0, 2],
        clip_matrix[1, 0],
        clip_matrix[1, 1],
        clip_matrix[1, 2],
        clip_matrix[3, 0],
        clip_matrix[3, 1],
        clip_matrix[3, 2],
    )
    return -(wp.inverse(rows) * wp.vec3(clip_matrix[0, 3], clip_matrix[1, 3], clip_matrix[3, 3]))


@wp.kernel
def _compose_clip_matrices(
    # in
    intrinsics: wp.array(dtype=wp.mat33),
    rotations: wp.array(dtype=wp.mat33),
    translations: wp.array(dtype=wp.vec3),
    to_ndc: wp.mat33,
    near: float,
    # out
    clip_matrices: wp.array(dtype=wp.mat44),
):
    """One thread owns one camera: the rows of [K R | K t] in clip space, the depth row apart."""
    camera = wp.tid()
    rotation = rotations[instance_in(camera, rotations.shape[0])]
    translation = translations[instance_in(camera, translations.shape[0])]
    ndc_intrinsics = to_ndc * intrinsics[instance_in(camera, intrinsics.shape[0])]
    rotation_rows = ndc_intrinsics * rotation
    translation_rows = ndc_intrinsics * translation
    clip_matrices[camera] = wp.mat44(
        rotation_rows[0, 0], rotation_rows[0, 1], rotation_rows[0, 2], translation_rows[0],
        rotation_rows[1, 0], rotation_rows[1, 1], rotation_rows[1, 2], translation_rows[1],
        0.0, 0.0, 0.0, near,
        rotation[2, 0], rotation[2, 1], rotation[2, 2], translation[2],
    )  # fmt: skip


@locked
def compose_clip_matrices(
    intrinsics: wp.array, rotations: wp.array, translations: wp.array, *, size: tuple[int, int], near: float = 0.01
) -> wp.array:
    """Compose the maps from world to clip space of cameras whose parameters are free.

    Args:
        intrinsics: K [pixels], last row (0, 0, 1), mat33 of shape [batch].
        rotations: R, world to camera, mat33 of shape [batch], from
            :func:`warpshadow.stages.geometry.rotations.rotation_matrices`.
        translations: t [scene units], world to camera, vec3 of shape [batch].
            Any batch may be 1 and then serves every instance.
        size: Width and height [pixels] of the image that K is for.
        near: Distance of the near plane [scene units].
    Returns:
        As :meth:`Camera.clip_matrix`, mat44 of shape [batch].
    Differentiable: intrinsics (so focal lengths and principal point), rotations, translations.
    """
    width, height = check.image_size(size)
    variables = {"intrinsics": intrinsics, "rotations": rotations, "translations": translations}
    finite_arrays(variables)
    to_ndc = wp.mat33(2.0 / width, 0.0, -1.0, 0.0, 2.0 / height, -1.0, 0.0, 0.0, 1.0)
    clip_matrices = empty(common_batch(variables), dtype=wp.mat44, device=intrinsics.device)
    inputs = [*variables.values(), to_ndc, check.positive("near", near)]
    launch(_compose_clip_matrices, clip_matrices.shape, inputs=inputs, outputs=[clip_matrices])
    return clip_matrices


@wp.kernel
def _to_clip(
    # in
    positions: wp.array2d(dtype=wp.vec3),
    clip_matrices: wp.array(dtype=wp.mat44),
    # out
    clip_positions: wp.array2d(dtype=wp.vec4),
):
    """One thread owns one vertex of one instance."""
    instance, vertex = wp.tid()
    p = positions[instance_in(instance, positions.shape[0]), vertex]
    matrix = clip_matrices[instance_in(instance, clip_matrices.shape[0])]
    clip_positions[instance, vertex] = matrix * wp.vec4(p[0], p[1], p[2], 1.0)


def to_clip(positions: wp.array, clip_matrices: wp.array) -> wp.array:
    """Take world positions to clip space.

    x/w and y/w run from −1 at the left and top of the image to 1 at the right and bottom, z/w from 1 at the near plane
    to 0 at infinity; w is the depth.

    Args:
        positions: World positions [scene units], vec3, shape [batch, vertex].
        clip_matrices: ``Camera.clip_matrix()`` of each instance, mat44, shape [batch].
            Either batch may be 1 and then serves every instance of the other.
    Returns:
        Clip positions, vec4, shape [batch, vertex].
    Differentiable: positions, clip_matrices.
    """
    finite_arrays({"clip_matrices": clip_matrices})
    batch_count = common_batch({"positions": positions, "clip_matrices": clip_matrices})
    clip_positions = empty((batch_count, positions.shape[1]), dtype=wp.vec4, device=positions.device)
    launch(_to_clip, clip_positions.shape, inputs=[positions, clip_matrices], outputs=[clip_positions])
    return clip_positions


def check_clip_space(clip_matrices: wp.array) -> None:
    """Raise ValueError for matrices whose z is not the near plane: other matrices have a depth there, of slope 1.

    A far plane or a step of an optimizer makes that row differ a little from ours, which changes nothing that is seen.
    """
    if clip_matrices.device.is_capturing:
        return
    finite_arrays({"clip_matrices": clip_matrices})
    matrices = clip_matrices.numpy()
    depth_row_slopes, depth_slopes = (np.linalg.norm(matrices[:, row, :3], axis=1) for row in (2, 3))
    other_indices = np.flatnonzero(
        (depth_row_slopes > 0.5 * depth_slopes) | (matrices[:, 2, 3] <= 0.0) | (depth_slopes == 0.0)
    )
    if len(other_indices):
        row_z, row_w = matrices[other_indices[0], 2:].tolist()
        raise ValueError(
            f"clip_matrices: got one with rows z = {row_z} and w = {row_w} (number {other_indices[0]}), expected "
            "z = [0, 0, 0, near] and w = depth, as Camera.clip_matrix() and TorchRenderer.clip_matrices(…) have them, "
            "y/w from -1 at the top to 1 at the bottom: those of OpenGL and nvdiffrast are "
            "warpshadow.torch.clip_matrices_from_opengl(matrices), or Camera.from_opengl(view, projection)"
        )
