"""Renderers of any scene: choices left to "auto" are made before the pipeline sees the scene."""

from collections.abc import Sequence

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.assets.basis import Basis, check_basis
from warpshadow.assets.camera import Camera
from warpshadow.pipeline import renderer
from warpshadow.pipeline.receivers.choice_of_receivers import for_still
from warpshadow.scene.scene import Scene, check_scene
from warpshadow.scene.visibility import METHODS_OF_SETTING
from warpshadow.tuning import tune

_IN_SCENES = {
    **dict.fromkeys(METHODS_OF_SETTING, "Scene(…, visibility=Visibility(…))"),
    **dict.fromkeys(("samples", "spp"), "Scene(…, visibility=Visibility('ray-traced', samples=…))"),
    "method": "Scene(…, visibility=Visibility(method))",
    "bounces": "Scene(…, bounces=…)",
}
"""Remedies for keywords that a scene has."""


class Renderer(renderer.SceneRenderer):
    """Renders any scene, as :class:`warpshadow.pipeline.renderer.SceneRenderer` does; "auto" is replaced by a choice.

    Images are linear RGB, premultiplied with coverage, and coverage, float32 of shape [height, width, 4]; row 0 is on
    top, and the background is 0. :meth:`render` returns one as NumPy's array, ``draw`` a batch as Warp's.

    Args:
        scene, cameras, device, basis: As there.
        progress: Whether to show its progress.
    """

    @check.keywords(
        camera="cameras=[camera], or Scene(…, camera=…)",
        size="Scene(…, camera=Camera.framing(…, size=…))",
        **_IN_SCENES,
    )
    def __init__(
        self,
        scene: Scene,
        *,
        cameras: Sequence[Camera] | None = None,
        device: wp.DeviceLike = "cpu",
        basis: Basis | None = None,
        progress: bool = True,
    ):
        check_scene(scene)
        check_basis(basis)
        scene = tune.resolved(scene, device=check.device("device", device), progress=progress)
        super().__init__(scene, cameras=cameras, device=device, basis=basis, progress=progress)


@check.keywords(
    **_IN_SCENES,
    **dict.fromkeys(("camera", "size"), "Scene(…, camera=Camera.framing(bodies, size=…))"),
    light="Renderer(scene).render(light)",
)
def render(scene: Scene, *, device: wp.DeviceLike = "cpu", progress: bool = True) -> np.ndarray:
    """Render a scene once; for several images of it, keep a :class:`Renderer`.

    This is a still: by rays that all pixels share, unless the scene names another method; a :class:`Renderer` is by
    "directional" then. "Stills and renderers" in pipeline/README.md says when, and by how much both images differ. A
    method that is named gives the same method in both: ``Visibility("directional")``, or ``Visibility("ray-traced",
    sampling="shared")``, which this takes. By "directional" receivers differ still
    (:func:`.receivers.choice_of_receivers.for_still`): with ``Body(…, receivers="pixel")`` and
    ``Visibility(self_shadows="rays")`` both are the same.

    Returns:
        Linear RGB, premultiplied, and coverage, float32 of shape [height, width, 4]; the background is 0.
    """
    check_scene(scene)
    return Renderer(for_still(scene), device=device, progress=progress).render()
