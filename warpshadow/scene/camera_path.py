"""Camera paths: cameras between keyframes, for videos; and files of them.

A file is TOML:

    fps = 24                     # frames a second, default
    loop = 2.0                   # seconds from the last keyframe back to the first; without it the path has an end

    [[keyframe]]
    time = 0.0                   # seconds
    eye = [3.0, 1.5, 4.0]
    target = [0.0, 0.5, 0.0]
    up = [0.0, 1.0, 0.0]         # default
    fov_y = 40.0                 # degrees; by default that of the scene's camera

Each number goes from keyframe to keyframe along a piecewise cubic that has a continuous slope and never leaves the
range of the two keyframes beside it (PCHIP; Fritsch and Butland 1984): a number that is the same in two keyframes
stays.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from warpshadow import check
from warpshadow.assets.camera import Camera
from warpshadow.check import AnyPath
from warpshadow.scene import toml_tables

_KEYS = ("fps", "loop", "keyframe")

MAX_FRAMES = 100_000  # frames beyond which a path is taken for a mistake, such as times in milliseconds


@check.frozen()
@dataclass(frozen=True, eq=False, init=False)
class Keyframe:
    """Where a camera is at a time, and where it looks.

    Args:
        time: Seconds.
        eye: Center of projection [scene units], shape [3].
        target: Point looked at [scene units], shape [3].
        up: Direction that points up in the image, shape [3], any length.
        fov_y: Angle between the top and the bottom edge of the image [degrees]; None for that of the scene's camera.
    """

    time: float
    eye: np.ndarray
    target: np.ndarray
    up: np.ndarray
    fov_y: float | None

    def __init__(
        self,
        time: float,
        eye: npt.ArrayLike,
        target: npt.ArrayLike,
        up: npt.ArrayLike = (0.0, 1.0, 0.0),
        fov_y: float | None = None,
    ):
        vars(self).update(
            time=check.number("time", time),
            eye=check.array("eye", eye, (3,)),
            target=check.array("target", target, (3,)),
            up=check.array("up", up, (3,)),
            fov_y=None if fov_y is None else check.number("fov_y", fov_y),
        )


class CameraPath:
    """Cameras along keyframes.

    Args:
        keyframes: Two or more, at rising times.
        fps: Frames a second.
        loop: Seconds from the last keyframe back to the first, for a path that is closed; None for one that is not.
    """

    def __init__(self, keyframes: Iterable[Keyframe], *, fps: float = 24.0, loop: float | None = None):
        self.keyframes = tuple(keyframes)
        self.fps = check.positive("fps", fps)
        self.loop = None if loop is None else check.positive("loop", loop)
        if len(self.keyframes) < 2:
            raise ValueError(f"keyframes: got {len(self.keyframes)}, expected two or more")
        for number, (before, after) in enumerate(zip(self.keyframes, self.keyframes[1:], strict=False), start=1):
            if after.time <= before.time:
                raise ValueError(
                    f"keyframes[{number}]: time: got {after.time:g} after {before.time:g}, expected rising times"
                )
        if self.frame_count > MAX_FRAMES:
            raise ValueError(
                f"keyframes: got {self.seconds:g} seconds at {self.fps:g} frames a second, expected at most "
                f"{MAX_FRAMES} frames; times are in seconds"
            )

    def __repr__(self) -> str:
        closed = ", closed" if self.loop else ""
        return f"CameraPath({len(self.keyframes)} keyframes, {self.seconds:g} s, {self.frame_count} frames{closed})"

    @property
    def seconds(self) -> float:
        """How long it takes."""
        return self.keyframes[-1].time - self.keyframes[0].time + (self.loop or 0.0)

    @property
    def frame_count(self) -> int:
        """Frames of a video: a path that is not closed ends with its last keyframe, a closed one before its first."""
        return max(1, round(self.seconds * self.fps)) + (self.loop is None)

    @classmethod
    def read(cls, path: AnyPath) -> CameraPath:
        """Read a file.

        Raises:
            ValueError: for a mistake in the file.
            FileNotFoundError: for a file that is not there.
        """
        path = check.path("path", path)
        with check.located(str(path)):
            table = toml_tables.read(path, "camera path")
            check.known_keys("the camera path", table, _KEYS)
            if "keyframe" not in table:
                raise ValueError("[[keyframe]] is missing; a camera path has two or more")
            keyframes = []
            for where, item in toml_tables.numbered(table, "keyframe"):
                with check.located(where):
                    keyframes.append(toml_tables.make(Keyframe, item))
            return cls(keyframes, **{key: table[key] for key in ("fps", "loop") if key in table})

    def write(self, path: AnyPath) -> None:
        """Write a file that reads back as the same path."""
        closing = {} if self.loop is None else {"loop": self.loop}
        tables = [
            {key: value for key, value in vars(keyframe).items() if value is not None} for keyframe in self.keyframes
        ]
        toml_tables.write(check.path("path", path), {"fps": self.fps, **closing, "keyframe": tables})

    def cameras(self, like: Camera) -> list[Camera]:
        """The cameras of the frames of a video.

        Args:
            like: Has their size, near plane, principal point and shape of pixels; and field of view, where keyframes
                say none.
        Raises:
            ValueError: where a camera between keyframes is none: it is where it looks, or looks along ``up``.
        """
        own_fov = float(2 * np.degrees(np.arctan(0.5 * like.height / like.intrinsics[1, 1])))
        rows = [[*key.eye, *key.target, *key.up, own_fov if key.fov_y is None else key.fov_y] for key in self.keyframes]
        start, cameras = self.keyframes[0].time, []
        for number, values in enumerate(self._interpolate(np.array(rows))):
            with check.located(f"the camera at {start + number / self.fps:g} s"):
                eye, target, up = np.split(values[:9], 3)
                seen = Camera.look_at(eye, target, up=up, fov_y=float(values[9]), size=(like.width, like.height))
            intrinsics = like.intrinsics.copy()
            intrinsics[:2, :2] *= seen.intrinsics[1, 1] / intrinsics[1, 1]
            cameras.append(replace(like, intrinsics=intrinsics, rotation=seen.rotation, translation=seen.translation))
        return cameras

    def _interpolate(self, rows: np.ndarray) -> np.ndarray:
        """Interpolate keyframe values at the times of the frames, shape [frame, value]."""
        from scipy.interpolate import PchipInterpolator

        times = np.array([keyframe.time for keyframe in self.keyframes]) - self.keyframes[0].time
        frames = np.minimum(np.arange(self.frame_count) / self.fps, self.seconds)
        if self.loop is None:
            frames[-1] = self.seconds
        else:  # once more before and after, for slopes that go on
            times = np.concatenate([times + turn * self.seconds for turn in (-1, 0, 1)])
            rows = np.tile(rows, (3, 1))
        values: np.ndarray = PchipInterpolator(times, rows)(frames)
        return values
