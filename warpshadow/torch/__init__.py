"""Rendering with torch tensors: images that are differentiable in light, reflectance, geometry and cameras.

While geometry and cameras stay the same, visibility and rasterization are computed once, by any method, the ray-traced
mesh included. With direct light on diffuse bodies an iteration is then a matrix product and a gather.
"""

from warpshadow.torch.autograd import apply
from warpshadow.torch.cameras import clip_matrices_from_opengl
from warpshadow.torch.mixed import MixedRenderer
from warpshadow.torch.renderer import LayerTensors, TorchRenderer
from warpshadow.torch.rotations import rotation_matrices

__all__ = ["LayerTensors", "MixedRenderer", "TorchRenderer", "apply", "clip_matrices_from_opengl", "rotation_matrices"]
