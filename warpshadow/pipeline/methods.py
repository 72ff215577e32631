"""Methods of visibility by their names; a method's modules are imported with the first renderer that takes it."""

from typing import TYPE_CHECKING

from warpshadow.assets.basis import Basis
from warpshadow.device.threads import one_at_a_time
from warpshadow.pipeline.lighting import Method
from warpshadow.pipeline.merged_scene import MergedScene

if TYPE_CHECKING:
    from warpshadow.pipeline.by_spheres import SphereMethod


@one_at_a_time  # kernels must not be made while another thread loads some
def make_method(merged_scene: MergedScene, basis: Basis | None, *, progress: bool = False) -> Method:
    """Make the method of a scene, with light that bounces if the scene asks for it.

    Args:
        merged_scene: The bodies.
        basis: Basis of free light; None for the method's own.
    """
    scene = merged_scene.scene
    if scene.visibility.method == "ray-traced":
        from warpshadow.pipeline.rays import Rays

        return Rays(merged_scene, basis, progress=progress)
    if scene.visibility.method == "directional":
        from warpshadow.pipeline.directional import Directional

        method: SphereMethod = Directional(merged_scene, basis, progress=progress)
    else:  # "none", too: log-SH without blockers
        from warpshadow.pipeline.log_sh import LogSH

        method = LogSH(merged_scene, basis, progress=progress)
    if scene.bounces:
        from warpshadow.pipeline.bounces.by_spheres import SphereBounces

        method.bounces = SphereBounces(method)
    return method
