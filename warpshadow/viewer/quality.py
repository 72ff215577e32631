"""Quality of images: few pixels and cells while something moves, then more while it rests."""

from dataclasses import dataclass

MOVING_SECONDS = 1 / 24  # time budget of an image while something moves; encoding and sending come on top
STILL_SECONDS = 1.0  # time budget of an image while nothing moves [s]: a page waits at most so long when it moves again
MIN_MOVING_PIXELS, MAX_MOVING_PIXELS = 160**2, 512**2  # pixels of an image while something moves
FULL = 1 << 20  # pixels of an image while all rests

_STEP = 1.3  # of pixels, that is worth another image


@dataclass(frozen=True)
class Quality:
    """Cost of an image."""

    pixels: int  # of the image, about
    cells: int  # at most so many direction cells, or directions of rays that all pixels share
    rays: int  # at most so many of a pixel
    supersampling: int  # at most so many samples across a pixel
    is_moving: bool  # whether it is made while something moves


class FrameRate:
    """Choose qualities by the times of past images: the next one of a motion, and the next better one at rest."""

    def __init__(self) -> None:
        self.pixels = 256**2

    def moving(self) -> Quality:
        """While something moves."""
        return Quality(self.pixels, cells=64, rays=16, supersampling=1, is_moving=True)

    def learn_from(self, seconds: float) -> None:
        """Learn from the time of an image in a motion; only a time far from the budget changes anything."""
        if seconds > 1.6 * MOVING_SECONDS:
            self.pixels = max(MIN_MOVING_PIXELS, self.pixels // 2)
        elif seconds < 0.3 * MOVING_SECONDS:
            self.pixels = min(MAX_MOVING_PIXELS, self.pixels * 2)

    def find_better(self, last: Quality, seconds: float, canvas: int) -> Quality | None:
        """The next quality while all rests.

        Args:
            canvas: Pixels that the page has.
        Returns:
            None where no better one can be seen, or would take too long.
        """
        target_quality = min(FULL, canvas)
        if last.is_moving:
            return Quality(min(target_quality, 256**2), cells=1 << 16, rays=1 << 16, supersampling=16, is_moving=False)
        pixels = min(target_quality, 4 * last.pixels, int(last.pixels * STILL_SECONDS / max(seconds, 1e-3)))
        if last.pixels >= target_quality or pixels < min(target_quality, _STEP * last.pixels):
            return None
        return Quality(pixels, last.cells, last.rays, last.supersampling, is_moving=False)
