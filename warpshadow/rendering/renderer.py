"""Renderers of any scene: choices left to "auto" are made before the pipeline sees the scene."""

from collections.abc import Sequence

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.assets.basis import Basis, check_basis
from warpshadow.assets.camera import Camera
from warpshadow.pipeline import renderer
from warpshadow.pipeline.receivers.choice_of_receivers import for_picture
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
        cameras, device, basis, progress: As there.
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

    Where the scene names no method, and no settings or spheres that "directional" alone reads, this is by rays that all
    pixels share (:func:`.receivers.choice_of_receivers.for_picture`): nothing is fitted or tabulated first,
    and the image does not depend on the content of the cache. Light that bounces goes between patches, by rays, too. A
    :class:`Renderer` is by "directional" then, and its images differ from this by that method's error, of which
    pipeline/README.md has figures. A method that is named gives the same method in both: ``Visibility("directional")``,
    or ``Visibility("ray-traced", sampling="shared")``, which this takes.

    By "directional" flat bodies, such as grounds, are shaded by pixel unless they say otherwise, so that shadows have
    smooth edges there; under a sun so are all, and their pixels find by rays where they lie in their own body's shadow.
    A renderer has vertices, which take less time, where faces are small: its own :meth:`Renderer.render`
    is the image to compare with its others. With ``Body(…, receivers="pixel")`` and ``Visibility(self_shadows="rays")``
    both are the same.

    Returns:
        Linear RGB, premultiplied, and coverage, float32 of shape [height, width, 4]; the background is 0.
    """
    check_scene(scene)
    return Renderer(for_picture(scene), device=device, progress=progress).render()
