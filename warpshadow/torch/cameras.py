"""Cameras of other libraries as tensors."""

import torch

from warpshadow import check
from warpshadow.torch.autograd import check_float32, outside_torch_compile

_ROUNDING = 1e-3  # of a matrix's rows, as a part of their length: float32, where the far plane is far away


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
