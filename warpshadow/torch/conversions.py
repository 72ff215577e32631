"""Rotations of free parameters, and cameras of other libraries, as tensors."""

import torch
import warp as wp

from warpshadow import check
from warpshadow.device.warp_internals import item_shape
from warpshadow.stages.geometry.rotations import Vec6
from warpshadow.stages.geometry.rotations import rotation_matrices as matrices_of_arrays
from warpshadow.torch.autograd import apply, check_float32, outside_torch_compile

_ROTATION_PARAMETERS = {3: wp.vec3, 4: wp.vec4, 6: Vec6, 9: wp.mat33}

_ROUNDING = 1e-3  # of a camera's rows, as a part of their length: float32, where the far plane is far away


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


@outside_torch_compile
def clip_matrices_from_opengl(matrices: torch.Tensor) -> torch.Tensor:
    """Convert maps from world to clip space of OpenGL and nvdiffrast: y up, z/w from −1 at the near plane to 1.

    Images are then ours, row 0 on top; nvdiffrast's begin at the bottom.

    Args:
        matrices: Projection times view, perspectives that multiply column vectors, [4, 4] or [batch, 4, 4].
    Returns:
        The same cameras, near planes included, as :meth:`TorchRenderer.forward` takes them, of the same shape.
    Raises:
        ValueError: for matrices without perspective, or whose near plane is not at z/w = −1, such as Direct3D's.
    Differentiable: matrices, but for the near plane.
    """
    check_float32("matrices", matrices)
    shape = ("batch", 4, 4) if matrices.ndim > 2 else (4, 4)
    check.shape("matrices", tuple(matrices.shape), shape, "projection @ view")
    x, y, z, w = matrices.unbind(-2)
    with torch.no_grad():
        lengths = w[..., :3].square().sum(-1).clamp(min=1e-30)
        slope = (z * w)[..., :3].sum(-1) / lengths  # z = slope w + offset
        offset = z[..., 3] - slope * w[..., 3]
        near = -offset / (slope + 1)
        residual = (z - slope[..., None] * w)[..., :3].square().sum(-1)
        if not ((near > 0) & (residual <= _ROUNDING**2 * lengths * slope.square())).all():
            raise ValueError(
                f"matrices: got {check.described(matrices)} whose third and fourth rows are no perspective of OpenGL, "
                "expected projection @ view: z/w from -1 at the near plane, w the depth"
            )
        depth = torch.cat([torch.zeros_like(z[..., :3]), near[..., None]], dim=-1)
    return torch.stack([x, -y, depth, w], dim=-2)
