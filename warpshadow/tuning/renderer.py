"""Renderers of any scene: what "auto" leaves open is chosen before the pipeline sees the scene."""

from collections.abc import Sequence

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.assets.basis import Basis, check_basis
from warpshadow.assets.camera import Camera
from warpshadow.pipeline import renderer
from warpshadow.pipeline.choice_of_receivers import for_picture
from warpshadow.scene.scene import AUTO, SCENE, Scene
from warpshadow.tuning import tune


class Renderer(renderer.Renderer):
    """Renders any scene, as :class:`warpshadow.pipeline.renderer.Renderer` does; "auto" is replaced by a choice.

    Args:
        scene: The scene.
        cameras, device, basis, progress: As there.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        cameras: Sequence[Camera] | None = None,
        device: wp.DeviceLike = "cpu",
        basis: Basis | None = None,
        progress: bool = True,
    ):
        check.instance("scene", scene, Scene, SCENE)
        check_basis(basis)
        if scene.visibility.method == AUTO:
            scene = tune.resolved(scene, device=check.device("device", device), progress=progress)
        super().__init__(scene, cameras=cameras, device=device, basis=basis, progress=progress)


@check.keywords(
    bounces="Scene(…, bounces=…)",
    method="Scene(…, visibility=Visibility(method))",
    **dict.fromkeys(("camera", "size"), "Scene(…, camera=Camera.framing(bodies, size=…))"),
    light="Renderer(scene).render(light)",
)
def render(scene: Scene, *, device: wp.DeviceLike = "cpu", progress: bool = True) -> np.ndarray:
    """Render a scene once; for several images of it, keep a :class:`Renderer`.

    Flat bodies, such as grounds, are shaded by pixel unless they say otherwise, so that shadows have smooth edges
    there; under a sun so are all, and their pixels find by rays where they lie in their own body's shadow. A renderer
    that is kept has vertices, which take less time, where faces are small: its own :meth:`Renderer.render` is the image
    to compare with its others. With ``Body(…, receivers="pixel")`` and ``Visibility(self_shadows="rays")`` both are the
    same.

    Args:
        scene: The scene.
        device: Warp device.
        progress: Show progress where something takes longer than a second.

    Returns:
        Linear RGB, premultiplied, and coverage, float32 of shape [height, width, 4]; the background is 0.
    """
    check.instance("scene", scene, Scene, SCENE)
    return Renderer(for_picture(scene), device=device, progress=progress).render()
