"""Rotations as tensors."""

import torch
import warp as wp

from warpshadow import check
from warpshadow.device.warp_internals import item_shape
from warpshadow.stages.geometry.rotations import Vec6
from warpshadow.stages.geometry.rotations import rotation_matrices as matrices_of_arrays
from warpshadow.torch.autograd import apply, check_float32, outside_torch_compile

_ROTATION_PARAMETERS = {3: wp.vec3, 4: wp.vec4, 6: Vec6, 9: wp.mat33}


@outside_torch_compile
def rotation_matrices(parameters: torch.Tensor) -> torch.Tensor:
    """Make rotation matrices of free parameters: of axis-angle vectors in radians (``torch.deg2rad``), quaternions, ….

    It does so as :func:`warpshadow.stages.geometry.rotations.rotation_matrices`.

    Args:
        parameters: Shape [..., n], where n decides their meaning: 4, quaternions (x, y, z, w) of any length but 0; 3,
            axis-angle vectors [radians], smooth at 0; 6, the first two columns; 9, the rows of any matrix, whose
            nearest rotation is taken (``matrices.flatten(-2)``).
    Returns:
        Rotations, shape [..., 3, 3].
    Raises:
        ValueError: for another n, and for parameters without a rotation, as
        :func:`warpshadow.stages.geometry.rotations.rotation_matrices` says.
    Warns:
        Of axis-angle vectors of more than two turns, which look like degrees; on a CPU.
    Differentiable: parameters.
    """
    check_float32("parameters", parameters)
    check.choice("parameters: last dimension", parameters.shape[-1] if parameters.ndim else 1, _ROTATION_PARAMETERS)
    dtype = _ROTATION_PARAMETERS[parameters.shape[-1]]
    rows = parameters.reshape(1, -1, *item_shape(dtype))
    matrices = apply(matrices_of_arrays, rows, dtypes=[dtype], device=parameters.device, names=["parameters"])
    return matrices.reshape(*parameters.shape[:-1], 3, 3)
