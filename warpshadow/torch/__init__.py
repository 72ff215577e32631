"""Rendering with torch tensors: images that are differentiable in light, reflectance, geometry and cameras.

While geometry and cameras stay the same, visibility and rasterization are computed once, by any method, the ray-traced
mesh included. With direct light on diffuse bodies an iteration is then a matrix product and a gather.
"""

from warpshadow.torch.autograd import apply
from warpshadow.torch.conversions import clip_matrices_from_opengl, rotation_matrices
from warpshadow.torch.mixed import MixedRenderer
from warpshadow.torch.renderer import LayerTensors, TorchRenderer

__all__ = ["LayerTensors", "MixedRenderer", "TorchRenderer", "apply", "clip_matrices_from_opengl", "rotation_matrices"]
