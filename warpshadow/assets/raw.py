"""Raw files of cameras, developed by LibRaw."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from warpshadow import check

RAW_SUFFIXES = (".dng", ".nef", ".cr2", ".cr3", ".crw", ".arw", ".orf", ".raf", ".rw2", ".pef", ".srw")


def read_raw(path: Path, check_size: Callable[[int, int], None]) -> np.ndarray:
    """Develop a raw file linearly: no tone curve, no brightening, upright, in the primaries of sRGB.

    The white balance is the camera's, or that of daylight where the file has none.

    Args:
        check_size: Raises ValueError for a width and height that are too large.
    Returns:
        RGB, 1 where the sensor saturates, float32 of shape [height, width, 3].
    Raises:
        ImportError: when rawpy, the extra ``raw``, is not installed.
        ValueError: for a file of another format, or a damaged one.
    """
    check.importable("rawpy", path.suffix, "rawpy", "raw")
    import rawpy

    try:
        with rawpy.imread(str(path)) as raw:
            check_size(raw.sizes.width, raw.sizes.height)
            codes = raw.postprocess(
                gamma=(1, 1),
                no_auto_bright=True,
                adjust_maximum_thr=0,  # white is the sensor's, not the brightest pixel
                use_camera_wb=True,
                output_color=rawpy.ColorSpace.sRGB,
                output_bps=16,
            )
    except rawpy.LibRawError as error:
        raise ValueError(f"not a raw file that LibRaw reads, or a damaged one ({error})") from error
    return (codes / 65535).astype(np.float32)
