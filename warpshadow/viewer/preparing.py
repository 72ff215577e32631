"""Preparing in another process: spheres, tables and kernels of a scene, while pages see it by rays.

The process fills the caches on disk, from which this one reads. Should this one end before, the other is interrupted,
and keeps its results so far.
"""

from __future__ import annotations

import _thread
import contextlib
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable
from dataclasses import replace

import warp as wp

from warpshadow.device.parallel import ENVIRONMENT_VARIABLE, thread_count
from warpshadow.device.progress import report_every
from warpshadow.device.startup import start_quietly
from warpshadow.scene.blockers import fitted_meshes
from warpshadow.scene.scene import Scene
from warpshadow.scene.visibility import SPHERE_METHODS
from warpshadow.spheres import is_fitted
from warpshadow.viewer.painter import Painter, own_page
from warpshadow.viewer.quality import FrameRate, Quality
from warpshadow.viewer.state import ViewerState

_NOTE_INTERVAL = 1.0  # time between two notes of how far it is
_PIXELS = 128**2  # of the images that the process renders, for all that they need
_STOP_TIMEOUT = 40.0  # time that the process has to write its results, after this one ended [s]


_QUALITIES = (
    replace(FrameRate().moving(), pixels=_PIXELS),
    Quality(_PIXELS, cells=1 << 16, rays=1 << 16, supersampling=16, is_moving=False),
)


def is_cached_on_disk(painter: Painter, *, device: wp.DeviceLike = "cpu") -> bool:
    """Whether the disk has all spheres and tables that the pages of a scene need."""
    scene = painter.scene
    if scene.visibility.method not in SPHERE_METHODS:
        return True
    fits = fitted_meshes(scene).values()
    has_spheres = all(is_fitted(*fit, device=device) for fit in fits)
    return has_spheres and all(painter.has_tables(ViewerState.of(scene), quality) for quality in _QUALITIES)


class Preparation:
    """Another process that fits spheres, traces shadows of bodies on themselves and compiles kernels.

    Args:
        note: Is told how far it is, in words; "" when all is over.
    """

    def __init__(self, scene: Scene, note: Callable[[str], None], *, device: wp.DeviceLike = "cpu"):
        self.is_over = False
        self._note = note
        paths = os.pathsep.join(path or os.getcwd() for path in sys.path)
        others = {"PYTHONPATH": paths, ENVIRONMENT_VARIABLE: str(max(1, thread_count() - 1))}
        # no multiprocessing: that would run the user's script again, where it has no guard against it
        self._process = subprocess.Popen(
            [sys.executable, "-c", f"from {__name__} import prepare; prepare()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env=os.environ | others,
        )
        threading.Thread(target=self._follow, args=(pickle.dumps((scene, str(device))),), daemon=True).start()

    def close(self) -> None:
        """Interrupt it, if it is not over."""
        self.is_over = True
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()

    def _follow(self, packed_progress: bytes) -> None:
        process = self._process
        assert process.stdin is not None and process.stderr is not None
        with contextlib.suppress(OSError, ValueError):  # it ended, or was closed
            process.stdin.write(packed_progress)
            process.stdin.flush()
        for line in process.stderr:
            if not self.is_over:
                self._note(line.decode(errors="replace").strip())
        process.wait()
        if not self.is_over:
            self.is_over = True
            self._note("")


def prepare() -> None:
    """Prepare the scene that comes on stdin; the end of stdin interrupts that."""
    warnings.simplefilter("ignore")  # the viewer warns of the same
    signal.signal(signal.SIGINT, signal.default_int_handler)  # processes in the background of a shell ignore it
    start_quietly()
    scene, device = pickle.load(sys.stdin.buffer)
    sys.unraisablehook = _interrupt_again
    threading.Thread(target=_end_with_viewer, daemon=True).start()
    if hasattr(os, "nice"):
        os.nice(5)
    report_every(_NOTE_INTERVAL)
    with contextlib.suppress(KeyboardInterrupt):
        painter, viewer_state = Painter(scene, device=device, progress=True), ViewerState.of(scene)
        page = own_page(scene, painter.page_scale)
        for quality in _QUALITIES:
            painter.image(viewer_state, page, quality)


def _interrupt_again(unraisable: sys.UnraisableHookArgs) -> None:
    """Interrupt once more where Python dropped an interrupt, since it came while an array was freed."""
    if isinstance(unraisable.exc_value, KeyboardInterrupt):
        _thread.interrupt_main()
    else:
        sys.__unraisablehook__(unraisable)


def _end_with_viewer() -> None:
    while os.read(0, 1):  # not by sys.stdin, whose lock a process cannot end without
        pass
    _thread.interrupt_main()
    time.sleep(_STOP_TIMEOUT)
    os._exit(1)
