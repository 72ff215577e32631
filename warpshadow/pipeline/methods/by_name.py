"""Methods of visibility by their names; a method's modules are imported with the first renderer that takes it."""

import importlib

from warpshadow.assets.basis import Basis
from warpshadow.device.threads import one_at_a_time
from warpshadow.pipeline.merged_scene import MergedScene
from warpshadow.pipeline.method import Method
from warpshadow.scene.visibility import DEFAULT_METHOD, SPHERE_METHODS

_CLASSES = {
    "directional": ("directional", "Directional"),
    "log-sh": ("log_sh", "LogSH"),
    "none": ("log_sh", "LogSH"),  # without blockers
    "ray-traced": ("ray_traced", "Rays"),
}


@one_at_a_time  # kernels must not be made while another thread loads some
def make_method(merged_scene: MergedScene, basis: Basis | None, *, progress: bool = False) -> Method:
    """Make the method of a scene, with light that bounces if the scene asks for it.

    Args:
        merged_scene: The bodies.
        basis: Basis of free light; None for the method's own.
    """
    scene = merged_scene.scene
    module, name = _CLASSES[scene.visibility.method or DEFAULT_METHOD]
    kind = getattr(importlib.import_module(f"{__package__}.{module}"), name)
    method = kind(merged_scene, basis, progress=progress)
    if scene.bounces and scene.visibility.method in SPHERE_METHODS:
        from warpshadow.pipeline.bounces.by_spheres import SphereBounces

        method.bounces = SphereBounces(method)
    return method
