"""Bodies put into a photograph, by a renderer of any scene."""

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import warp as wp

from warpshadow import check
from warpshadow.assets.camera import Camera
from warpshadow.assets.image import ImageError, read_rgb
from warpshadow.check import AnyPath
from warpshadow.device.tape import unrecorded
from warpshadow.pipeline.receivers.choice_of_receivers import for_still
from warpshadow.rendering.renderer import Renderer
from warpshadow.scene.scene import Scene, check_scene

_COVERED_SHARE = 0.5  # part of a pixel that bodies cover, above which it is theirs

_MAX_WHITE_SHARE = 0.1
"""Share of white pixels, more among the inserted bodies than in the photograph, above which a remark is made."""


def insert(
    scene: Scene,
    photograph: npt.ArrayLike | AnyPath,
    *,
    exposure: float = 0.0,
    device: wp.DeviceLike = "cpu",
    progress: bool = True,
) -> np.ndarray:
    """Put the bodies of a scene into a photograph, with their shadows on the surfaces that the shadow catchers model.

    Where the photograph shows a catcher, it is multiplied by the ratio of the light that the catcher receives with the
    other bodies to that without them; these are drawn over it, with soft edges. See
    :mod:`warpshadow.stages.image.photograph`, and :meth:`warpshadow.torch.TorchRenderer.insert` for gradients.

    Args:
        scene: The scene, with one or more bodies that are shadow catchers, and the camera of the photograph, whose size
            becomes that of the photograph.
        photograph: Linear RGB of shape [height, width, 3], or a file that :func:`warpshadow.read_image` reads.
        exposure: Factor of the bodies' radiance in the photograph, in stops.
    Warns:
        Where more of the bodies is brighter than white, 1, than of the photograph, by a tenth: how much, and the
        exposure with which 1% is.
    Returns:
        Linear RGB, float32 of the photograph's shape; :func:`warpshadow.write_image` writes it as a picture.
    Raises:
        ValueError: for a photograph of other proportions than the camera's, and a scene without a catcher.
    """
    check_scene(scene)
    pixels = _linear_photograph(photograph)
    height, width, _ = pixels.shape
    camera, gain = _fitting_camera(scene.camera, width, height), 2.0 ** check.number("exposure", exposure)
    renderer = Renderer(for_still(replace(scene, camera=camera)), device=device, progress=progress)
    photo = wp.array(pixels[None] / gain, dtype=wp.vec3, device=renderer.device)
    with unrecorded():
        image: np.ndarray = renderer.insert(photo).numpy()[0] * np.float32(gain)
    drawn_bodies = [number for number in range(len(scene.bodies)) if number not in scene.catchers]
    if remark := _overexposure(image, pixels, renderer.layers().masks[drawn_bodies].sum(axis=0), exposure):
        check.warn(remark)
    return image


def _overexposure(image: np.ndarray, photograph: np.ndarray, coverage: np.ndarray, exposure: float) -> str | None:
    """Say how much of the bodies is brighter than white, where that is a tenth more than of the photograph.

    Args:
        image: With the bodies, linear RGB.
        photograph: Without; one with values above 1 has no white.
        coverage: Part of each pixel that the bodies cover.
        exposure: Theirs [stops].
    """
    bright_values = image.max(axis=2)[coverage > _COVERED_SHARE]
    if not len(bright_values) or photograph.max() > 1:
        return None
    white, usual = float((bright_values > 1).mean()), float((photograph >= 1).any(axis=2).mean())
    if white <= usual + _MAX_WHITE_SHARE:
        return None
    stops = math.floor(10 * (exposure - math.log2(np.percentile(bright_values, 99)))) / 10
    return (
        f"{white:.0%} of the inserted pixels are brighter than white, as is {usual:.0%} of the photograph; with "
        f"exposure = {stops:.1f} (--exposure {stops:.1f}) 1% is, or scale the light by {2 ** (stops - exposure):.2g}"
    )


def _linear_photograph(photograph: npt.ArrayLike | AnyPath) -> np.ndarray:
    """Linear RGB of a photograph or of its file, float32 of shape [height, width, 3]."""
    if check.is_path(photograph):
        path = check.file("photograph", photograph)
        with check.located("photograph", ImageError):
            return read_rgb(path)
    pixels = check.photograph("photograph", photograph)
    check.shape("photograph", pixels.shape, ("height", "width", 3), check.channels_last(pixels.shape))
    check.finite("photograph", pixels)
    return pixels


def _fitting_camera(camera: Camera, width: int, height: int) -> Camera:
    """The camera for a photograph of another size; ValueError unless its proportions are the same up to a pixel."""
    if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height, width, height):
        raise ValueError(
            f"photograph: got {width} × {height} pixels, expected the proportions of the scene's camera, "
            f"{camera.width} × {camera.height}: crop it, or give [camera] its size"
        )
    return camera.stretched(width, height)
