"""The stages of a fit in order, the search for a wanted error, and fits cached on disk."""

from __future__ import annotations

import hashlib
import json
import time
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.assets.cache import Unfinished, cache_folder, cache_path, load_or_compute
from warpshadow.assets.mesh import Mesh
from warpshadow.assets.topology import welded
from warpshadow.device.progress import progress_bar
from warpshadow.device.tape import unrecorded
from warpshadow.device.threads import locked
from warpshadow.maths.adjacency import area_normals
from warpshadow.maths.spatial_sort import compact_order
from warpshadow.spheres.cover import greedy_cover
from warpshadow.spheres.enough import AUTO, MAX_SPHERES, enough_spheres
from warpshadow.spheres.measure import FitReport, measure
from warpshadow.spheres.normalized_mesh import NormalizedMesh, normalize
from warpshadow.spheres.receivers import FitReceivers
from warpshadow.spheres.refine import DescentState, Refinement
from warpshadow.spheres.sphere_set import Spheres

ALGORITHM_VERSION = 11  # part of the key of cached fits: raise it whenever a fit would come out differently

STEPS = 320  # of stage 2: 2000 are no better on a bunny

RECEIVERS = 8192  # receivers that stage 2 draws from
SHADOW_SPHERES = 64  # from so many on one expects the shadow of the mesh. A flat body, which rarely needs any, has them

BAD_SHADOW = 0.18  # error of a shadow above which it is ragged: a fence has 0.21, rocks, whose shadow is whole, 0.16
MIN_GROUND_ERROR = 0.01  # of a ground, below which ragged shadows are not visible: of a slab that lies on it, 0.004
BAD_AIR = 0.45  # error of the light around a body above which its cavities are dark: of a filled half shell 0.51
BAD_SURFACE = 0.25  # of the light on both sides, above which some comes through: a colander has 0.36, a bowl 0.20

_warned: weakref.WeakSet[Mesh] = weakref.WeakSet()

_FITS: weakref.WeakKeyDictionary[Mesh, dict[tuple, SphereFit]] = weakref.WeakKeyDictionary()
"""Fits of meshes in memory, by their inputs and the cache that has them: reading one takes 2 ms."""

_UNWRITTEN: dict[Path, tuple[np.ndarray, FitReport]] = {}
"""Fits that the cache could not take, by where they would be: bodies of one shape share them."""


class SphereFit(NamedTuple):
    """Spheres in the mesh's own coordinates, and how good they are."""

    spheres: Spheres
    report: FitReport


@check.keywords(refine="steps=1, for spheres that cover the mesh and hardly more")
@locked
def fit_spheres(
    mesh: Mesh,
    count: int | str = AUTO,
    *,
    error: float | None = None,
    seed: int = 0,
    steps: int = STEPS,
    device: wp.DeviceLike = "cpu",
    cache: bool = True,
    progress: bool = True,
    warns: bool = True,
    seen_from: Sequence[float] | None = None,
) -> SphereFit:
    """Fit spheres to a mesh so that they cast its shadows.

    The same mesh, moved or scaled, gets the same spheres, moved or scaled (up to float32 rounding), and the same call
    on the same device the same bits.

    Args:
        mesh: The mesh [scene units], y up; open and multi-part meshes, too.
        count: Number of spheres; 0 gives none. "auto" takes as many as the body needs, 8 to 1024: until the error of
            its shadows around it is some 3%, or no longer falls by 15% where they are doubled. It is 8 for a ball, 64
            for a cow, 256 for a bunny and a box, 1024 for a chair.
        error: Instead of a count, the visibility error to reach (see FitReport), for example 0.05: the number of
            spheres is doubled from 16, then bisected. If 1024 do not meet it, their fit comes with a warning.
        steps: Steps of gradient descent, by which spheres that cover the mesh come to cast its shadows.
        seen_from: Direction, in the mesh's axes, to the side from which alone it is seen, as land is; its other faces
            need no spheres. Shape [3]; None for all sides.
        cache: Read and write the fit in a cache on disk, by the mesh's shape and the arguments above: the user's cache
            folder, or WARPSHADOW_CACHE_DIR.
        warns: Warn of spheres that cast a bad shadow. False where something else blocks light in their place.
    Returns:
        The spheres in the mesh's coordinates, and a report. Spheres that shrank to nothing are left out.
    Warns: Once for each mesh, where 64 or more spheres cast a ragged shadow, as on thin legs, fill its cavities, or let
        light through, as a curved sheet's do.
    """
    check.instance("mesh", mesh, Mesh, "a Mesh; load_mesh(path) reads one")
    if isinstance(count, str):
        check.choice("count", count, (AUTO,))
    else:
        check.integer("count", count, minimum=0)
        count = int(count)
    for name, value, minimum in (("seed", seed, 0), ("steps", steps, 1)):
        check.integer(name, value, minimum=minimum)
    if count == AUTO and mesh.is_flat:
        count = SHADOW_SPHERES
    if error is not None:
        check.positive("error", error)
    fit_device = check.device("device", device)
    seen_from = _unit_vector(seen_from)
    key = count, error, seed, steps, seen_from, fit_device.alias, cache_folder()
    if cache and key in _FITS.get(mesh, ()):
        return _FITS[mesh][key]
    fits, center, diagonal = _fits_of(mesh, seed, steps, fit_device, seen_from, progress)
    fit_count = fits.cached_fit if cache else fits.fit
    with unrecorded():
        balls, report = fit_count(count) if error is None else _search(fit_count, error)
    if error is None and warns:
        _warn_of_holes(mesh, count, report, seen_from)
    balls = balls[compact_order(balls[:, :3])]  # neighbors are culled together
    spheres = Spheres(balls[:, :3] * diagonal + center, balls[:, 3] * diagonal)
    if cache:
        _FITS.setdefault(mesh, {})[key] = SphereFit(spheres, replace(report, cached=True))
    return SphereFit(spheres, report)


def _warn_of_holes(mesh: Mesh, count: int | str, report: FitReport, seen_from: tuple | None) -> None:
    """Warn once of a mesh too thin for spheres that are many; whoever asks for few knows; flats need none."""
    where = "on a ground" if seen_from is None else "around it"
    wrongs = {
        f"the shadow that they cast {where} is off by {report.shadow_error:.0%}, so it is ragged": (
            report.shadow_error > BAD_SHADOW and report.ground_error > MIN_GROUND_ERROR
        ),
        f"the light in its cavities and around it is off by {report.nearby_error:.0%}": report.nearby_error > BAD_AIR,
        f"the light on its sides is off by {report.surface_error:.0%}, so some comes through": (
            report.surface_error > BAD_SURFACE
        ),
    }
    fault = next((words for words, is_wrong in wrongs.items() if is_wrong), None)
    number = report.sphere_count if isinstance(count, str) else count
    if fault is None or number < SHADOW_SPHERES or mesh in _warned or mesh.is_flat:
        return
    _warned.add(mesh)
    auto_advice = "" if count == AUTO else 'blockers = "auto" takes as many as it needs, and '
    parts = "parts of it that are bodies of their own have spheres each"
    closing_advice = "closed with walls and a bottom, where nothing is behind it, it has room for them"
    check.warn(
        f"{mesh.name!r} is thin for {number} spheres: {fault}; {auto_advice}"
        f"{parts if mesh.surface.is_closed else closing_advice}, "
        'and method = "ray-traced" has the shadow of the mesh'
    )


def _unit_vector(seen_from: Sequence[float] | None) -> tuple[float, float, float] | None:
    """The direction, checked, of length 1 to six digits."""
    if seen_from is None:
        return None
    vector = check.array("seen_from", seen_from, (3,), "a direction (x, y, z)").astype(np.float64)
    if not np.any(vector):
        raise ValueError("seen_from: got a zero vector, expected a direction")
    x, y, z = np.round(vector / np.linalg.norm(vector), 6).tolist()
    return x, y, z


def is_fitted(
    mesh: Mesh,
    count: int | str,
    steps: int = STEPS,
    seen_from: Sequence[float] | None = None,
    *,
    device: wp.DeviceLike = "cpu",
) -> bool:
    """Whether the cache has the fit of :func:`fit_spheres` for a mesh, a count, a number of steps and a direction."""
    fits, *_ = _fits_of(mesh, 0, steps, wp.get_device(device), _unit_vector(seen_from))
    return fits.cache_path(count).exists()


def fit_seconds(count: int | str) -> float:
    """Estimate the time of a fit on one thread [s], by the time of a bunny on a Zen 4."""
    return 8.4 if isinstance(count, str) else 1.3 + 0.013 * count


def _fits_of(
    mesh: Mesh,
    seed: int,
    steps: int,
    device: wp.Device,
    seen_from: tuple[float, float, float] | None,
    progress: bool = False,
) -> tuple[_MeshFits, np.ndarray, float]:
    """Fits to a mesh in the frame of the fit; the middle of the mesh's bounds and their diagonal."""
    positions, faces = welded(mesh.positions, mesh.faces)  # parted at creases or not, a mesh has the same spheres
    positions = positions.astype(np.float64)
    corners = positions[faces]
    if not area_normals(corners).any():
        raise ValueError("mesh: got only faces without area, expected a surface")
    normalized, center, diagonal = normalize(positions)
    return _MeshFits(normalized, faces, seed, steps, device, seen_from, progress), center, diagonal


def _search(
    fit_spheres_of_count: Callable[[int], tuple[np.ndarray, FitReport]], error: float
) -> tuple[np.ndarray, FitReport]:
    """Find the least number of spheres, within an eighth, whose error is met."""
    too_few, count = 0, 16
    best_fit = fit_spheres_of_count(count)
    while best_fit[1].visibility_error > error and count < MAX_SPHERES:
        too_few, count = count, 2 * count
        best_fit = fit_spheres_of_count(count)
    if best_fit[1].visibility_error > error:
        message = f"error: {error} is not met with {count} spheres; the fit has {best_fit[1].visibility_error:.4f}"
        check.warn(message)
        return best_fit
    while count - too_few > max(count // 8, 1):
        middle_count = (too_few + count) // 2
        middle_fit = fit_spheres_of_count(middle_count)
        if middle_fit[1].visibility_error <= error:
            best_fit, count = middle_fit, middle_count
        else:
            too_few = middle_count
    return best_fit


@dataclass(frozen=True)
class _MeshFits:
    """Fits of spheres [sphere, 4] to a normalized mesh, by their number."""

    positions: np.ndarray
    faces: np.ndarray
    seed: int
    steps: int
    device: wp.Device
    seen_from: tuple[float, float, float] | None  # from which alone the mesh is seen
    progress: bool

    def cache_path(self, count: int | str) -> Path:
        """File of a fit in the cache, named by a hash of all that it depends on."""
        kind = "cpu" if self.device.is_cpu else "cuda"
        key_numbers = [ALGORITHM_VERSION, count, self.seed, self.steps, kind, self.positions.shape]
        if self.seen_from is not None:
            key_numbers.append(self.seen_from)
        key = hashlib.sha256(json.dumps(key_numbers).encode())
        key.update(self.positions.tobytes())
        key.update(self.faces.tobytes())
        return cache_path("spheres", key.hexdigest())

    def cached_fit(self, count: int | str) -> tuple[np.ndarray, FitReport]:
        """Read a fit from the cache, or make it and write it there."""

        def read(cached_arrays: Mapping[str, np.ndarray]) -> tuple[np.ndarray, FitReport]:
            spheres, report = cached_arrays["spheres"], FitReport(**json.loads(str(cached_arrays["report"])))
            check.shape("spheres", spheres.shape, (report.sphere_count, 4))
            return spheres, replace(report, cached=True)

        def arrays(fit: tuple[np.ndarray, FitReport]) -> dict[str, np.ndarray]:
            return {"spheres": fit[0], "report": np.array(json.dumps(asdict(fit[1])))}

        path = self.cache_path(count)
        if path in _UNWRITTEN and not path.exists():
            return _UNWRITTEN[path]
        fit = load_or_compute(path, read, partial(self.fit, count), arrays, noun="fit")
        if not path.exists():
            _UNWRITTEN[path] = fit[0], replace(fit[1], cached=True)
        return fit

    def fit(self, count: int | str, unfinished: Unfinished | None = None) -> tuple[np.ndarray, FitReport]:
        """Make a fit, from where an interrupt left it."""
        from threadpoolctl import threadpool_limits

        cached_arrays = {} if unfinished is None else unfinished.before
        began = time.perf_counter() - float(cached_arrays.get("seconds", 0.0))
        seen_from = None if self.seen_from is None else np.array(self.seen_from)
        mesh = NormalizedMesh(self.positions, self.faces, self.device, seen_from)
        spheres = cached_arrays.get("spheres", np.zeros((0, 4)))
        total, done_steps = self.steps if count else 0, int(cached_arrays.get("step_count", 0))
        label = f"fitting {'as many spheres as it takes' if count == AUTO else f'{count} spheres'}"

        def store_part(part: str, **arrays: np.ndarray) -> None:
            if unfinished is not None:
                seconds = np.array(time.perf_counter() - began)
                unfinished.keep(lambda: {"seconds": seconds, **arrays}, part)

        # threads for products of such small matrices wait for each other, for seconds where cores are busy
        with progress_bar(total, label, "step", done=done_steps, shows=self.progress) as bar, threadpool_limits(1):
            if count:
                for descent_state in self._descend(mesh, count, cached_arrays, store_part):
                    spheres = descent_state.spheres
                    bar.update()
            spheres = spheres[spheres[:, 3] > 1e-4].astype(np.float32)
            return spheres, measure(mesh, spheres.astype(np.float64), time.perf_counter() - began)

    def _descend(
        self,
        mesh: NormalizedMesh,
        count: int | str,
        cached_arrays: Mapping[str, np.ndarray],
        store_part: Callable[..., None],
    ) -> Iterator[DescentState]:
        """Fit one sphere or more; yields where it is after every step.

        Args:
            cached_arrays: Arrays that an interrupted call left.
            store_part: Gets how far it is in words, and arrays from which a later call goes on.
        """
        rng = np.random.default_rng(self.seed)
        receivers = FitReceivers(mesh, RECEIVERS, rng)
        start: np.ndarray | DescentState
        if "spheres" in cached_arrays:
            start = DescentState(**{name: cached_arrays[name] for name in DescentState._fields})
        else:
            if isinstance(count, str):

                def store_errors(errors: list[Sequence[float]]) -> None:
                    store_part(f"{len(errors)} short fits", errors=np.array(errors))

                count = enough_spheres(mesh, receivers, self.seed, [*cached_arrays.get("errors", ())], store_errors)
            start = greedy_cover(mesh, count, rng)
        for descent_state in Refinement(mesh, receivers, rng).run(start, self.steps):
            store_part(f"{descent_state.step_count} of {self.steps} steps", **descent_state._asdict())
            yield descent_state
