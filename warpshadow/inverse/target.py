"""Targets: the images that a fit explains, and outlines in them, painted by hand or by a segmentation."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from warpshadow import check
from warpshadow.assets.camera import Camera
from warpshadow.assets.lens import checked_distortion, undistorted
from warpshadow.assets.picture import development
from warpshadow.check import AnyPath
from warpshadow.inverse.edges import edge_offset, moved_outline, signed_distances
from warpshadow.inverse.encoding import Encoding, checked_encoding, decoded, guess_encoding, read_linear, read_mask
from warpshadow.scene.scene import BodyLike, Scene


@check.frozen()
@dataclass(frozen=True, eq=False, init=False)
class Target:
    """An image that a fit explains.

    A path, relative to the current folder, stands for its file, as in fit files.

    Args:
        image: Linear RGB, shape [height, width, 3]; or premultiplied RGB with coverage, [height, width, 4], as
            renderers make it, and the coverage is explained, too; or a picture's file.
        mask: How much each pixel counts, 0 to 1, shape [height, width]; by default all do. Mask out pixels that the
            scene does not model: the background of a photograph, say. Or a file of gray.
        camera: Where the image was taken; by default the scene's camera, made as large as the image.
        encoding: Of a file: "srgb", "linear", a gamma, such as 2.2, or the camera's response curve: a .csv file, or
            rows of radiance and value, see :class:`~warpshadow.inverse.encoding.ResponseCurve`; by default as its
            metadata say, see :func:`~warpshadow.inverse.encoding.guess_encoding`.
        exposure: At which the image was taken [stops]: its values are divided by 2^exposure. By default 0; and of a
            picture that :class:`warpshadow.Picture` wrote, as ``warpshadow render -o x.png`` does, as the file says,
            whose tone curve is undone, too.
        white_balance: Gains of red, green and blue with which it was developed: its values are divided by them.
        saturation: Value of the file, 0 to 1 as it is stored, from which a color is saturated: an image may be brighter
            there. None: none is, but 1 in a picture as above.
        outlines: Where bodies are seen, by their numbers or names: masks as above, which the bodies' own are to cover.
            They tell a pose even where light and reflectance are unknown.
        moves_outlines: Move each outline outwards or inwards to the edges of the image beside it, as far as three
            pixels; see :func:`~warpshadow.inverse.edges.edge_offset`. For masks that are not right to the pixel.
        distortion: OpenCV's coefficients k1, k2, p1, p2[, k3] of the camera's lens: the image is made that of a
            pinhole, and pixels that the lens did not see do not count.
    """

    image: np.ndarray = field(repr=False)
    mask: np.ndarray | None = field(repr=False)
    camera: Camera | None
    encoding: Encoding
    saturated: np.ndarray | None = field(repr=False)
    outlines: dict[BodyLike, np.ndarray] = field(repr=False)

    def __init__(
        self,
        image: npt.ArrayLike | AnyPath,
        mask: npt.ArrayLike | AnyPath | None = None,
        camera: Camera | None = None,
        *,
        encoding: Encoding | npt.ArrayLike | AnyPath | None = None,
        exposure: float | None = None,
        white_balance: npt.ArrayLike | None = None,
        saturation: float | None = None,
        outlines: Mapping[BodyLike, npt.ArrayLike | AnyPath] | None = None,
        moves_outlines: bool = False,
        distortion: npt.ArrayLike | None = None,
    ):
        checked_curve = None if encoding is None else checked_encoding(encoding)
        vars(self).update(image=image, mask=mask, camera=camera, encoding=checked_curve or "linear")
        stops, tone = 0.0 if exposure is None else check.number("exposure", exposure), "clip"
        if check.is_path(image):
            path = check.file("image", image)
            exposure_record = development(path)
            if exposure_record is not None:
                tone = exposure_record.tone
                stops = exposure_record.exposure if exposure is None else stops
                saturation = 1.0 if saturation is None else saturation
            with check.located("image"):
                object.__setattr__(self, "encoding", checked_curve or guess_encoding(path))
                object.__setattr__(self, "image", read_linear(path, self.encoding, tone))
        elif checked_curve not in (None, "linear"):
            raise ValueError(f"encoding: got {checked_curve!r} for an array, expected a file, or linear values")
        if check.is_path(mask):
            path = check.file("mask", mask)
            with check.located("mask"):
                object.__setattr__(self, "mask", read_mask(path))
        image = check.photograph("image", self.image)
        if image.ndim != 3 or image.shape[2] not in (3, 4) or image.size == 0:
            remedy = check.channels_last(image.shape)
            raise ValueError(
                f"image: got shape {image.shape}, expected [height, width, 3 or 4]{remedy and f': {remedy}'}"
            )
        if self.mask is not None:
            object.__setattr__(self, "mask", _checked_mask(self.mask, image.shape[:2]))
        object.__setattr__(self, "outlines", _outlines(outlines or {}, image.shape[:2]))
        check.flag("moves_outlines", moves_outlines)
        if moves_outlines:
            colors = np.nan_to_num(image[..., :3])
            self.outlines.update({body: moved_outline(o, edge_offset(colors, o)) for body, o in self.outlines.items()})
        if self.mask is not None:
            image[self.mask == 0] = 0  # whatever the value
        size = image.shape[1], image.shape[0]
        check.instance("camera", self.camera, (Camera, type(None)), "a Camera, or None for the scene's")
        if self.camera is not None and (self.camera.width, self.camera.height) != size:
            raise ValueError(
                f"image: got {size[0]} × {size[1]} pixels, expected the camera's "
                f"{self.camera.width} × {self.camera.height}"
            )
        saturated = (
            None
            if saturation is None
            else image[..., :3] >= decoded(_saturation_share(saturation), self.encoding, tone)
        )
        object.__setattr__(self, "saturated", saturated if saturated is not None and saturated.any() else None)
        gains = 2.0**stops * _gains(white_balance)
        image[..., :3] = image[..., :3] / gains.astype(np.float32)
        if distortion is not None:
            image = self._undistorted(image, distortion)
        check.finite("image", image)
        object.__setattr__(self, "image", image)

    def __repr__(self) -> str:
        height, width = self.image.shape[:2]
        parts = {"a mask": self.mask is not None, "a camera": self.camera is not None, "outlines": bool(self.outlines)}
        return f"Target({', '.join([f'{width} × {height}', *(name for name, has in parts.items() if has)])})"

    def _undistorted(self, image: np.ndarray, distortion: npt.ArrayLike) -> np.ndarray:
        """The image of a pinhole; its mask as well, which is 0 where the lens saw nothing."""
        coefficients = checked_distortion(distortion)
        if self.camera is None:
            raise ValueError("distortion: got it without a camera, expected one with the intrinsics of the calibration")
        image_and_weights = undistorted(
            np.concatenate([image, self.weights()[..., None]], axis=-1), self.camera, coefficients
        )
        is_seen = np.isfinite(image_and_weights).all(axis=-1)
        if self.saturated is not None:
            spread = undistorted(self.saturated.astype(np.float32), self.camera, coefficients)
            object.__setattr__(self, "saturated", spread > 0)
        for body, outline in self.outlines.items():
            self.outlines[body] = np.nan_to_num(undistorted(outline[..., None], self.camera, coefficients)[..., 0])
        image_and_weights[~is_seen] = 0
        object.__setattr__(self, "mask", np.clip(image_and_weights[..., -1], 0, 1))
        return np.ascontiguousarray(image_and_weights[..., :-1])

    def weights(self) -> np.ndarray:
        """Weights of the pixels, float32 of shape [height, width]."""
        return np.ones(self.image.shape[:2], np.float32) if self.mask is None else self.mask


def _checked_mask(mask: npt.ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    """Weights of the pixels of an image of a shape [height, width], float32."""
    is_bool = np.asarray(mask).dtype == bool
    given_mask = np.asarray(mask, np.float32) if is_bool else mask
    weights = check.numbers("mask", given_mask, expected="weights of pixels [height, width], or the path of a picture")
    check.shape("mask", weights.shape, shape)
    check.finite("mask", weights)
    if weights.min() < 0 or weights.max() > 1 or not weights.any():
        raise ValueError(
            f"mask: got values from {weights.min():g} to {weights.max():g}, expected 0 to 1, and not 0 alone; of "
            "8 bits: mask / 255"
        )
    return weights


def _outlines(
    outlines: Mapping[BodyLike, npt.ArrayLike | AnyPath], shape: tuple[int, ...]
) -> dict[BodyLike, np.ndarray]:
    check.instance("outlines", outlines, Mapping, "masks by bodies, such as {'bottle': 'bottle.png'}")
    masks = {}
    for body, outline in outlines.items():
        with check.located(f"outlines[{body!r}]"):
            mask = read_mask(check.file("mask", outline)) if check.is_path(outline) else np.asarray(outline, np.float32)
            check.shape("mask", mask.shape, shape)
            check.finite("mask", mask, minimum=0, maximum=1)
        masks[body] = mask
    return masks


def _gains(white_balance: npt.ArrayLike | None) -> np.ndarray:
    gains = np.ones(3) if white_balance is None else check.array("white_balance", white_balance, (3,))
    if gains.min() <= 0:
        raise ValueError(f"white_balance: got {gains.tolist()}, expected three gains above 0")
    return gains


def _saturation_share(saturation: float) -> np.ndarray:
    if not (check.is_number(saturation) and 0 < saturation <= 1):
        raise ValueError(f"saturation: got {check.described(saturation)}, expected above 0 and up to 1, such as 0.98")
    return np.asarray(saturation - 1e-6)


class Stacked(NamedTuple):
    """Targets of all views at the size of a stage."""

    images: torch.Tensor  # [view, height, width, channel]
    weights: torch.Tensor  # [view, height, width]
    saturated: torch.Tensor | None  # where a part of a pixel is, [view, height, width, 3]; None if nowhere


def stack_targets(targets: Sequence[Target], scale: float, device: torch.device) -> Stacked:
    """Targets at the size of a camera resized."""
    images = np.stack([target.image for target in targets])
    weights = np.stack([target.weights() for target in targets])[..., None]
    height_means, width_means = (
        area_means(count, max(1, round(count * scale))).to(device) for count in images.shape[1:3]
    )

    def resize(pixels: np.ndarray) -> torch.Tensor:
        return torch.einsum("ih,vhwc,jw->vijc", height_means, torch.from_numpy(pixels).to(device), width_means)

    weight = resize(weights)
    image = resize(images * weights) / torch.where(weight > 0, weight, 1)  # masked-out pixels bleed into nothing
    saturated = None
    if any(target.saturated is not None for target in targets):
        none = np.zeros((*images.shape[1:3], 3), bool)
        flags = [none if target.saturated is None else target.saturated for target in targets]
        saturated = resize(np.stack(flags).astype(np.float32)) > 0
    return Stacked(image.contiguous(), weight[..., 0].contiguous(), saturated)


def area_means(count: int, coarse_count: int) -> torch.Tensor:
    """Averages of a row of pixels by area, [coarse_count, count]; ``coarse_count`` need not be a part of ``count``."""
    edges, coarse_edges = np.arange(count + 1), np.arange(coarse_count + 1) * (count / coarse_count)
    ends = np.minimum(edges[1:], coarse_edges[1:, None])
    starts = np.maximum(edges[:-1], coarse_edges[:-1, None])
    return torch.from_numpy((np.maximum(ends - starts, 0) * (coarse_count / count)).astype(np.float32))


@dataclass(frozen=True, eq=False)
class Outlines:
    """The outlines of all targets at the size of a stage."""

    views: tuple[int, ...]  # of each outline, [outline]
    bodies: tuple[int, ...]
    distances: torch.Tensor  # signed [pixels of the targets], positive inside, [outline, height, width]
    scale: float  # pixels of the stage in one of the targets

    def differences(self, masks: torch.Tensor, offsets: torch.Tensor | None) -> torch.Tensor:
        """Masks of bodies [view, body, height, width] minus outlines, moved outwards by offsets [view] [pixels of the
        targets], [outline, height, width]. Differentiable: masks, offsets.
        """
        distances = self.distances
        if offsets is not None:
            distances = distances + offsets[list(self.views)][:, None, None]
        return masks[list(self.views), list(self.bodies)] - (0.5 + self.scale * distances).clamp(0, 1)

    def loss(self, masks: torch.Tensor, offsets: torch.Tensor | None) -> torch.Tensor:
        """Mean square of the differences, summed over outlines. Differentiable: masks, offsets."""
        return self.differences(masks, offsets).square().mean(dim=(1, 2)).sum()


def outlines_of(targets: Sequence[Target], scene: Scene, scale: float, device: torch.device) -> Outlines | None:
    """The outlines of targets; None where they have none."""
    painted_outlines = [
        (view, scene.body_number(body, "outlines"), mask)
        for view, target in enumerate(targets)
        for body, mask in target.outlines.items()
    ]
    if not painted_outlines:
        return None
    views, bodies, masks = zip(*painted_outlines, strict=True)
    distances = np.stack([signed_distances(mask) for mask in masks])
    height_means, width_means = (area_means(count, max(1, round(count * scale))) for count in distances.shape[1:])
    small_distances = torch.einsum("ih,ohw,jw->oij", height_means, torch.from_numpy(distances), width_means)
    return Outlines(views, bodies, small_distances.contiguous().to(device), scale)
