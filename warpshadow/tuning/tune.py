"""Tuning: the cost and error of each setting of a scene, and the cheapest that is good enough.

Errors are measured in shading at points that the camera sees, against rays through the meshes: see
:mod:`warpshadow.tuning.point_sample`. They are the same each time. Times are measured: see
:mod:`warpshadow.tuning.timing`.
"""

import contextlib
import itertools
import math
import os
import warnings
import weakref
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.device.progress import progress_bar, remark
from warpshadow.device.threads import locked
from warpshadow.scene import toml_tables
from warpshadow.scene.blockers import fitted_counts, fitted_meshes
from warpshadow.scene.scene import Bounces, Scene, change_bodies, check_bounces, check_scene
from warpshadow.scene.visibility import AUTO, METHOD_TRAITS, SPHERE_METHODS, Visibility
from warpshadow.spheres import Spheres, fit_spheres, is_fitted
from warpshadow.stages.visibility.zonal_logs import LOGS
from warpshadow.tuning.point_sample import PointSample
from warpshadow.tuning.timing import TIMED_RECEIVERS, image_times, whole_image_times

DIRECTION_COUNTS = (32, 64, 128, 256, 512)
ORDERS = (4, 6, 8)
BOUNCE_COUNTS = (0, 1, 2, 4)
SPHERE_COUNTS = (16, 32, 64, 128, 256, 512)

EQUAL_TIME_SHARE = 0.1
"""Settings whose times differ by less than this share count as equally fast; then the more accurate is better.

Where none is accurate enough, the same holds of their errors; then the faster is better.
"""

ERROR_STEP = 0.003  # errors that differ by less than this count as equal, too: it is not visible
# error of interpolation between a body's vertices from which on its pixels are tried as receivers
COARSE_FACES_ERROR = 0.005


class Trial(NamedTuple):
    """A setting that was tried."""

    scene: Scene
    """The scene with it."""
    error: float  # ‖B − B_mesh‖ / ‖B_mesh‖ over points that the camera sees, B the shading
    milliseconds: float  # time of an image; Inf where it is not measured, since the error is too large anyway


@dataclass(frozen=True, eq=False)
class Tuning:
    """The settings chosen for a scene, and all trials.

    Args:
        given: The scene as it was.
        chosen: The best setting. If no setting reaches the target, the nearest one: the fastest of the settings about
            as accurate as can be, or the most accurate of the settings about as fast.
        is_reached: Whether it reaches it.
        trials: All that was tried, the fastest first.
    """

    given: Scene
    chosen: Trial
    is_reached: bool
    trials: tuple[Trial, ...]

    @property
    def scene(self) -> Scene:
        """The scene with the settings."""
        return self.chosen.scene

    @property
    def error(self) -> float:
        """Relative error of the shading."""
        return self.chosen.error

    @property
    def milliseconds(self) -> float:
        """Time of an image."""
        return self.chosen.milliseconds

    @property
    def untried_counts(self) -> tuple[int, ...]:
        """Numbers of spheres that were not tried, since no fit of them is cached: ``fits=True`` makes them."""
        fitted = fitted_counts(self.given)
        tried_counts = {trial.scene.bodies[number].blockers for trial in self.trials for number in fitted}
        return tuple(count for count in SPHERE_COUNTS if fitted and count not in tried_counts)

    def __str__(self) -> str:
        """The table, the units of its errors and times, and the meaning of its marks."""
        camera, samples = self.given.camera, self.given.supersampling
        sample_text = (
            f"; but for times marked *, shadows timed on {TIMED_RECEIVERS} of its receivers, extrapolated to all"
        )
        sample_text *= not any(trial.scene.bounces for trial in self.trials)
        mark = "chosen" if self.is_reached else "nearest"
        is_all_timed = all(math.isfinite(trial.milliseconds) for trial in self.trials)
        untimed_text = "" if is_all_timed else "    – not timed: less accurate than is asked for"
        return (
            "error: of the shading at points of the image, relative, against rays\n"
            f"image: time of a warm one of {camera.width} × {camera.height}, {samples} × {samples} samples a pixel, "
            f"after all bodies have moved{sample_text}\n"
            f"{self.table()}\n* no other is both faster and more accurate    > {mark}{untimed_text}"
        )

    def table(self) -> str:
        """The trials, a line each: "*" marks the Pareto front, ">" the chosen one."""
        front = pareto_front([(trial.milliseconds, trial.error) for trial in self.trials])
        fitted = fitted_counts(self.given)
        lines = [f"  {_HEAD}{'error':>8}{'image':>12}"]
        for number, (scene, error, milliseconds) in enumerate(self.trials):
            mark = (">" if scene is self.scene else " ") + ("*" if number in front else " ")
            time_text = f"{milliseconds:9.2f} ms" if math.isfinite(milliseconds) else f"{'–':>12}"
            lines.append(f"{mark}{_columns(scene, fitted)}{error:8.2%}{time_text}")
        return "\n".join(lines)

    def toml(self) -> str:
        """The settings as lines of a scene file: [visibility], and changes of the bodies."""
        visibility = self.scene.visibility
        chosen = {key: getattr(visibility, key) for key in ("method", *_tuned_settings(visibility))}
        blocks = [toml_tables.block("[visibility]", chosen)]
        if self.scene.bounces != self.given.bounces:
            blocks.insert(0, toml_tables.block("[light]", {"bounces": self.scene.bounces}))
        for number, (before, after) in enumerate(zip(self.given.bodies, self.scene.bodies, strict=True)):
            pairs = {key: (getattr(before, key), getattr(after, key)) for key in ("blockers", "receivers")}
            changes = {key: new for key, (old, new) in pairs.items() if new != old}
            if changes:
                blocks.append(toml_tables.block(f"[[body]]  # body {number} ({before.name!r})", changes))
        return "\n".join(blocks)


_HEAD = f"{'method':18}{'bounces':>8}{'spheres':>12}  {'receivers':16}"


def _columns(scene: Scene, fitted: Iterable[int]) -> str:
    """The settings of a scene, below the head of a table."""
    columns = f"{_method(scene.visibility):18}{scene.bounces:>8}{_spheres(scene, fitted):>12}"
    return f"{columns}  {_join_words(_receivers(scene)):16}"


def describe(scene: Scene) -> str:
    """Name the settings of a scene in a few words."""
    spheres = f", {_spheres(scene, fitted_counts(scene))} spheres" if scene.visibility.method in SPHERE_METHODS else ""
    return f"{_method(scene.visibility)}{_bounces(scene)}{spheres}, receivers {_join_words(_receivers(scene))}"


def _method(visibility: Visibility) -> str:
    return " ".join(str(getattr(visibility, name)) for name in ("method", *_tuned_settings(visibility)))


def _tuned_settings(visibility: Visibility) -> tuple[str, ...]:
    return METHOD_TRAITS[visibility.method].tuned if visibility.method else ()


def _bounces(scene: Scene) -> str:
    return f", {scene.bounces} bounce{'s' * (scene.bounces != 1)}" if scene.bounces else ""


def _spheres(scene: Scene, fitted: Iterable[int]) -> str:
    """Numbers of spheres that are fitted to bodies, and of given ones."""
    if scene.visibility.method not in SPHERE_METHODS:
        return "–"
    counts = [scene.bodies[number].blockers for number in fitted]
    counts += [len(body.blockers) for body in scene.bodies if isinstance(body.blockers, Spheres)]
    return _join_words([str(count) for count in counts or [0]])


def _receivers(scene: Scene) -> tuple[str, ...]:
    return tuple(body.receivers for body in scene.bodies)


def _join_words(words: Sequence[str]) -> str:
    """Words, once where all are the same."""
    return words[0] if len(set(words)) == 1 else ", ".join(words)


@locked
def tune(
    scene: Scene,
    *,
    error: float | None = None,
    milliseconds: float | None = None,
    bounces: Bounces | None = None,
    fits: bool = False,
    device: wp.DeviceLike = "cpu",
    progress: bool = True,
) -> Tuning:
    """Measure settings of a scene, and choose the cheapest that reaches an error, or the best within a time.

    Tried are all methods but rays that show all that the scene has; 32 to 512 directions, where bodies shine no fewer
    than by default; orders 4, 6 and 8; 16 to 512 spheres for bodies that say how many; and every pixel as a receiver
    for bodies whose vertices miss shadows.

    Args:
        scene: The scene; its "auto" is not looked at.
        error: Largest relative error of the shading, such as 0.03: of diffuse light, whether bodies shine or not.
        milliseconds: In place of an error the longest time of an image.
        bounces: How often light bounces in the reference, such as 12 or "all": then 0, 1, 2 and 4 bounces are tried,
            too, as far as there are so many, and "all". By default the scene's, which are not varied.
        fits: Whether to fit as many spheres as are tried, some 20 s a body; otherwise only the scene's own number is
            tried, and others whose fits are cached already.
        progress: Show progress, and each error as it is measured: an interrupted run has these.
    Returns:
        The choice, and all trials. If no setting reaches the target, it is the nearest. Settings that miss an error are
        not timed.
    Raises:
        ValueError: where the camera sees nothing.
    Warns:
        Where the machine is busy already: its load average is above its number of cores.
    """
    check_scene(scene)
    device = check.device("device", device)
    arguments = {"error": error, "milliseconds": milliseconds}
    requested = next((value for value in arguments.values() if value is not None), None)
    if requested is None or None not in arguments.values():
        raise ValueError(f"error, milliseconds: got {'neither' if requested is None else 'both'}, expected one of them")
    check.positive("error" if milliseconds is None else "milliseconds", requested)
    if error is not None and error > 1:
        raise ValueError(f"error: got {error:g}, expected up to 1: 0.03 is 3%")
    if bounces is not None:
        check_bounces(bounces)
    _warn_if_busy()
    scene = scene.with_method()
    sample = PointSample(scene, bounces=bounces, device=device, progress=progress)
    fine = _fine_receivers(scene, sample)
    counts: Sequence[Bounces] = (scene.bounces,)
    if bounces is not None:
        counts = (*BOUNCE_COUNTS, "all") if bounces == "all" else [count for count in BOUNCE_COUNTS if count <= bounces]
    scenes_with_bounces = [replace(scene, bounces=count) for count in counts]
    settings = [setting for item in scenes_with_bounces for setting in _trial_scenes(item, fine, fits, device)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a setting's warnings show in its error
        errors, fitted = [0.0] * len(settings), fitted_counts(scene)
        order, compiling_count = _measuring_order(settings)
        remark(f"{_HEAD}{'error':>8}", shows=progress)
        with progress_bar(len(settings), "compiling kernels, measuring errors", "setting", shows=progress) as bar:
            for place, number in enumerate(order):
                if place == compiling_count:
                    bar.describe("measuring errors, before times")
                errors[number] = sample.error(sample.shading(settings[number]))
                remark(f"{_columns(settings[number], fitted)}{errors[number]:8.2%}", shows=progress)
                bar.update()
        limit = max(error, _nearest_limit(errors)) if error is not None else math.inf
        timed_numbers = [number for number, item in enumerate(errors) if item <= limit]
        timed_settings = [settings[number] for number in timed_numbers]
        times = image_times(timed_settings, device=device, progress=progress)
        if not any(item.bounces for item in scenes_with_bounces):
            timed_errors = [errors[number] for number in timed_numbers]
            _time_front(timed_settings, timed_errors, times, device=device, progress=progress)
    milliseconds_of = dict(zip(timed_numbers, times, strict=True))
    trials = [
        Trial(*pair, milliseconds_of.get(k, math.inf)) for k, pair in enumerate(zip(settings, errors, strict=True))
    ]
    trials.sort(key=lambda trial: (trial.milliseconds, trial.error))
    if milliseconds is None:
        good_trials = [trial for trial in trials if trial.error <= requested]
        chosen = _cheapest(good_trials) if good_trials else _nearest(trials)
    else:
        good_trials = [trial for trial in trials if trial.milliseconds <= requested]
        chosen = min(good_trials, key=lambda trial: trial.error) if good_trials else _cheapest(trials)
    return Tuning(scene, chosen, bool(good_trials), tuple(trials))


def _fine_receivers(scene: Scene, sample: PointSample) -> list[str]:
    """The finer of the receivers that are tried of each body; its own where renderers choose these, or where it shines.

    They are pixels where interpolation between the vertices misses shadows.
    """
    is_coarse = sample.interpolation_errors() > COARSE_FACES_ERROR
    fine = np.where(is_coarse, "pixel", "vertex").tolist()
    chosen = [body.receivers for body in sample.with_chosen_receivers(scene).bodies]
    return [
        body.receivers if receivers == receivers_chosen or body.is_glossy else receivers
        for body, receivers_chosen, receivers in zip(scene.bodies, chosen, fine, strict=True)
    ]


def _measuring_order(settings: Sequence[Scene]) -> tuple[list[int], int]:
    """Numbers of settings, and how many of them come first since they compile kernels; the others have an even pace."""
    permutation = np.random.default_rng(0).permutation(len(settings)).tolist()  # slow ones come last otherwise
    firsts: dict[object, int] = {}
    for number in permutation:
        visibility = replace(settings[number].visibility, directions=None)
        kernels = *vars(visibility).values(), _receivers(settings[number]), settings[number].bounces != 0
        firsts.setdefault(kernels, number)
    compiling = list(firsts.values())
    return [*compiling, *(number for number in permutation if number not in compiling)], len(compiling)


def _time_front(
    settings: Sequence[Scene], errors: Sequence[float], times: list[float], *, device: wp.Device, progress: bool
) -> None:
    """Replace estimates by times of whole images, until all on the Pareto front are such."""
    timed_settings: set[int] = set()
    while untimed_settings := sorted(set(pareto_front(list(zip(times, errors, strict=True)))) - timed_settings):
        image_milliseconds = whole_image_times(
            [settings[number] for number in untimed_settings], device=device, progress=progress
        )
        for number, milliseconds in zip(untimed_settings, image_milliseconds, strict=True):
            times[number] = milliseconds
        timed_settings.update(untimed_settings)


def _warn_if_busy() -> None:
    """Warn where others already use all cores."""
    cores = os.cpu_count() or 1
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0  # Windows has none
    if load > cores:
        check.warn(
            f"the machine is busy, load average {load:.1f} on {cores} cores: times will be too long, and settings may "
            "be chosen by them that an idle machine would not choose; errors are the same"
        )


def _cheapest(trials: Sequence[Trial]) -> Trial:
    """The fastest trial, or the most accurate of trials that are about as fast."""
    longest_time = (1 + EQUAL_TIME_SHARE) * min(trial.milliseconds for trial in trials)
    return min((trial for trial in trials if trial.milliseconds <= longest_time), key=lambda trial: trial.error)


def _nearest(trials: Sequence[Trial]) -> Trial:
    """The most accurate trial, or the fastest of trials that are about as accurate."""
    maximum = _nearest_limit([trial.error for trial in trials])
    return min((trial for trial in trials if trial.error <= maximum), key=lambda trial: trial.milliseconds)


def _nearest_limit(errors: Sequence[float]) -> float:
    """Error up to which trials are about as accurate as the best."""
    minimum = min(errors)
    return minimum + max(EQUAL_TIME_SHARE * minimum, ERROR_STEP)


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Find the points (time, error) that no other beats in both, or equals in one and beats in the other.

    Returns:
        Their numbers, by time.
    """
    front: list[int] = []
    for number in sorted(range(len(points)), key=lambda number: points[number]):
        if not front or points[number][1] < points[front[-1]][1]:
            front.append(number)
    return front


_resolved: weakref.WeakKeyDictionary[Scene, Scene] = weakref.WeakKeyDictionary()


@locked
def resolved(scene: Scene, *, device: wp.DeviceLike = "cpu", progress: bool = False) -> Scene:
    """Put settings in place of "auto": the first that reach the error of the scene's :class:`Visibility`.

    They are tried in a fixed order, so that the choice, and with it the image, does not depend on how busy a machine
    is: no shadows; then 32, 64, 128, 256, 512 directions with as many spheres as the bodies ask for; then the same
    with twice as many spheres, up to 512 a body, where more spheres can help. Receivers stay as they are. If nothing
    reaches the error the nearest comes with a warning.

    Args:
        scene: The scene. One with another method is returned as it is, and "directional" if it names none.
    Returns:
        The scene, "auto" replaced. It is the same object each time, so that the choice is made once for a scene.
    """
    if scene.visibility.method != AUTO:
        return scene.with_method()
    if scene not in _resolved:
        _resolved[scene] = _resolve(scene, check.device("device", device), progress)
    return _resolved[scene]


def _resolve(scene: Scene, device: wp.DeviceLike, progress: bool) -> Scene:
    accepted_error = scene.visibility.error
    sample = PointSample(scene, device=device, progress=progress)
    tried_scenes: list[tuple[float, Scene]] = []
    for setting in _settings_by_work(scene, sample):
        tried_scenes.append((sample.error(sample.shading(setting)), setting))
        if tried_scenes[-1][0] <= accepted_error:
            return setting
    error, nearest = min(tried_scenes, key=lambda item: item[0])
    interpolation_error = _interpolation_error(scene, sample)
    reason = f"; interpolation between vertices alone has {interpolation_error:.3f}: receivers = 'pixel'"
    reason *= interpolation_error >= accepted_error
    check.warn(
        f"visibility: no setting of method = 'auto' reaches error = {accepted_error:g}; {describe(nearest)} "
        f"comes nearest, with {error:.3f}{reason}"
    )
    return nearest


def _interpolation_error(scene: Scene, sample: PointSample) -> float:
    """Error that is left however visibility is computed: of the bodies whose vertices are receivers."""
    is_interpolated = [body.receivers == "vertex" for body in sample.with_chosen_receivers(scene).bodies]
    return float(np.linalg.norm(sample.interpolation_errors()[is_interpolated]))


def _settings_by_work(scene: Scene, sample: PointSample) -> Iterator[Scene]:
    """Settings that "auto" chooses from, the least work first."""
    if not scene.bounces:  # bounced light needs visibility
        yield replace(scene, visibility=scene.visibility.by("none"))
    yield from _all_directions(scene)
    counts = {
        number: len(fit_spheres(fit.mesh, device=sample.device, seen_from=fit.seen_from).spheres)
        if fit.sphere_count == AUTO
        else int(fit.sphere_count)
        for number, fit in fitted_meshes(scene).items()
    }
    factor, maximum = 2, max(counts.values(), default=SPHERE_COUNTS[-1])
    while factor * maximum <= SPHERE_COUNTS[-1] and _interpolation_error(scene, sample) < scene.visibility.error:
        next_scene = change_bodies(scene, "blockers", {number: factor * count for number, count in counts.items()})
        yield from _all_directions(next_scene)
        factor *= 2


def _all_directions(scene: Scene) -> Iterator[Scene]:
    return (replace(scene, visibility=visibility) for visibility in _variants(scene, "directional"))


def _trial_scenes(scene: Scene, fine: Sequence[str], fits: bool, device: wp.DeviceLike) -> Iterator[Scene]:
    """Trials, a variant of the scene each: with its own receivers, and with fine ones."""
    for receivers in dict.fromkeys((_receivers(scene), tuple(fine))):
        scene_with_receivers = change_bodies(scene, "receivers", dict(enumerate(receivers)))
        if not scene.bounces:
            yield replace(scene_with_receivers, visibility=scene.visibility.by("none"))
        for variant in _sphere_variants(scene_with_receivers, fits, device):
            for method in SPHERE_METHODS:
                for visibility in _variants(scene, method) if method in scene.methods else ():
                    yield replace(variant, visibility=visibility)


def _sphere_variants(scene: Scene, fits: bool, device: wp.DeviceLike) -> Iterator[Scene]:
    """The scene with its own spheres, and with other numbers of them for all bodies."""
    yield scene
    fitted = fitted_counts(scene)
    requests = [] if fits else list(fitted_meshes(scene).values())
    for count in SPHERE_COUNTS if fitted else ():
        is_at_hand = fits or all(
            is_fitted(request.mesh, count, seen_from=request.seen_from, device=device) for request in requests
        )
        if is_at_hand and set(fitted.values()) != {count}:
            yield change_bodies(scene, "blockers", dict.fromkeys(fitted, count))


def _variants(scene: Scene, method: str) -> Iterator[Visibility]:
    """A method with all values that are tried of the settings that tuning varies, as far as its others allow them."""
    fewest = 0
    if any(body.is_glossy for body in scene.bodies):  # of whose gloss errors know nothing
        fewest = replace(scene, visibility=Visibility()).direction_count
    directions = sorted({max(count, fewest) for count in DIRECTION_COUNTS})
    candidates: dict[str, Sequence[Any]] = {"directions": directions, "log": LOGS, "order": ORDERS}
    names = METHOD_TRAITS[method].tuned
    for values in itertools.product(*(candidates[name] for name in names)):
        with contextlib.suppress(ValueError):
            yield replace(scene.visibility.by(method), **dict(zip(names, values, strict=True)))
