"""Layers of pixels: the images that a data set may hold. ``LAYERS`` says how each is found, and how PNG has it."""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from warpshadow.dataset.png import Channels, Coding, Even, Srgb
from warpshadow.rendering.renderer import Renderer
from warpshadow.scene.scene import Scene


class LazyLayers:
    """Lazy layers of one image: each is computed when first asked for, once.

    Args:
        mask_count: Number of masks, so that images can be stacked; masks of missing bodies are 0.
    """

    def __init__(self, scene: Scene, device: str, mask_count: int):
        self.mask_count = mask_count
        self.renderer = Renderer(scene, device=device, progress=False)

    @functools.cached_property
    def _channels(self) -> Channels:
        """Layers of the renderer, by its own names."""
        return self.renderer.layers().channels()

    def color(self) -> Channels:
        """Linear RGB, premultiplied, and coverage."""
        return _as_channels("RGBA", self.renderer.render())

    def shadow(self) -> Channels:
        """Direct light on the bodies, divided by the same light without blockers."""
        return _as_channels([f"shadow.{color}" for color in "RGB"], self.renderer.shadow())

    def some(self, *names: str) -> Channels:
        """Some of the channels of the renderer's layers."""
        return {name: self._channels[name] for name in names}

    def masks(self) -> Channels:
        """Part of each pixel that each body covers."""
        names = [f"mask.{number}" for number in range(self.mask_count)]
        return {name: self._channels.get(name, np.zeros_like(self._channels["Z"])) for name in names}


def _as_channels(names: Sequence[str], values: np.ndarray) -> Channels:
    return dict(zip(names, np.moveaxis(values, -1, 0), strict=True))


class Layer(NamedTuple):
    """A layer of pixels."""

    find: Callable[[LazyLayers], Channels]  # finds its channels
    coding: Coding  # how PNG has their numbers
    is_apart: bool = False  # whether each channel is a picture of its own

    def pictures(self, name: str, channels: Channels) -> dict[str, Channels]:
        """The channels of each PNG file, by the end of its name."""
        if self.is_apart:
            return {f"{channel}.png": {channel: values} for channel, values in channels.items()}
        return {f"{name}.png": channels}


LAYERS = {
    "color": Layer(LazyLayers.color, Srgb()),
    "shadow": Layer(LazyLayers.shadow, Even(8)),
    "depth": Layer(lambda image_layers: image_layers.some("Z"), Even(16)),
    "normals": Layer(lambda image_layers: image_layers.some("N.X", "N.Y", "N.Z"), Even(8, low=-128 / 127)),  # 128 is 0
    "bodies": Layer(lambda image_layers: image_layers.some("body"), Even(8, low=-1, high=254)),
    "masks": Layer(LazyLayers.masks, Even(8), is_apart=True),
}
"""The layers, by the names that recipes have for them."""
