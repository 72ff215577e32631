"""Methods of visibility by their names; a method's modules are imported with the first renderer that takes it.

A row of ``METHOD_TRAITS`` registers a method. The class is METHOD of the module here that has its name.
"""

import importlib

from warpshadow.assets.basis import Basis
from warpshadow.device.threads import locked
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.shading.method import Method
from warpshadow.scene.visibility import DEFAULT_METHOD


@locked  # kernels must not be made while another thread loads some
def make_method(merged_scene: MergedScene, basis: Basis | None, *, progress: bool = False) -> Method:
    """Make the method of a scene.

    Args:
        merged_scene: The bodies.
        basis: Basis of free light; None for the method's own.
    """
    name = merged_scene.scene.visibility.method or DEFAULT_METHOD
    module = importlib.import_module(f"{__package__}.{name.replace('-', '_')}")
    return module.METHOD(merged_scene, basis, progress=progress)  # type: ignore[no-any-return]
