"""How visibility is computed: methods, and their settings.

Stages are functions that users call on their own, too. So defaults and choices that a setting shares with a stage stand
beside its kernel, whose error and time they decide, and are imported here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from warpshadow import check
from warpshadow.maths import sh
from warpshadow.maths.directions import check_count, falloff_width
from warpshadow.stages.visibility.directional import SOFTNESS
from warpshadow.stages.visibility.exponential import THRESHOLDS
from warpshadow.stages.visibility.merging import MERGING, check_merging
from warpshadow.stages.visibility.zonal_logs import LOGS

DEFAULT_METHOD = "directional"  # method of renderers, where none is named
AUTO = "auto"


class MethodTraits(NamedTuple):
    """A method of visibility for all that ask for one by its name."""

    settings: tuple[str, ...]  # of a :class:`Visibility` that it reads
    has_spheres: bool = False  # whether these stand in for bodies
    has_cells: bool = False  # whether it finds shadows in cells, past planes and convex parts, too
    every_sample_receives: bool = False  # whether every sample is a receiver, overriding the bodies
    has_shadows: bool = True
    finds_bounces: bool = True  # whether light may bounce
    shows_all_light: bool = True  # whether bodies may shine or emit, and light may be near
    tuned: tuple[str, ...] = ()  # settings that tuning varies


METHOD_TRAITS = {
    "directional": MethodTraits(
        ("directions", "softness", "merging", "self_shadows", "samples"),
        has_spheres=True,
        has_cells=True,
        tuned=("directions",),
    ),
    "log-sh": MethodTraits(
        ("merging", "self_shadows", "order", "log", "base"),
        has_spheres=True,
        shows_all_light=False,
        tuned=("log", "order"),
    ),
    "none": MethodTraits(("order",), has_shadows=False, finds_bounces=False),
    "ray-traced": MethodTraits(("order", "samples", "sampling"), every_sample_receives=True),
    AUTO: MethodTraits(("softness", "merging", "self_shadows", "order", "error")),  # some are left to the chosen one
}
METHODS = tuple(method for method in METHOD_TRAITS if method != AUTO)
SPHERE_METHODS = tuple(method for method, traits in METHOD_TRAITS.items() if traits.has_spheres)
BOUNCE_METHODS = tuple(method for method, traits in METHOD_TRAITS.items() if traits.finds_bounces)
FULL_LIGHT_METHODS = tuple(method for method, traits in METHOD_TRAITS.items() if traits.shows_all_light)
METHODS_OF_SETTING = {
    setting: tuple(method for method, traits in METHOD_TRAITS.items() if setting in traits.settings)
    for setting in dict.fromkeys(setting for traits in METHOD_TRAITS.values() for setting in traits.settings)
}
"""The methods that read each setting."""

_DIRECTIONAL_SETTINGS = {*METHOD_TRAITS[DEFAULT_METHOD].settings} - {*METHOD_TRAITS["ray-traced"].settings}
"""Settings that name :data:`DEFAULT_METHOD` where they are not the default."""

SELF_SHADOWS = ("traced", "rays", "spheres")

SAMPLINGS = ("independent", "shared")

SHARED_DIRECTIONS = 512
"""Directions that receivers share unless ``samples`` says how many: with 256 edges of dim shadows show as streaks."""

DIRECTIONS, DIRECTIONS_OF_GLOSS = 128, 256
"""Cells unless ``directions`` says how many: of scenes that are diffuse or rough, and of scenes with a body below …"""

NARROW_ROUGHNESS = 0.3
"""… this roughness. A metal ball of roughness 0.2 on a ground is 9.2, 6.0 and 3.9% off with 128, 256 and 512 cells."""

DIRECTIONS_OF_SPOTS = 512
"""Cells where light bounces and a lamp is near a flat body. Its spot there, narrower than a cell, draws bands on
walls: a room where a ball of light stands on the floor is 15.2, 8.4 and 4.7% off with 128, 256 and 512 cells, where it
is below the ceiling, by 0.05 of the room's height, 8.8, 6.4 and 4.2%, by 0.15, 3.0, 1.8 and 1.3%. An image of moved
bodies takes 2.2 times as long as with 128."""

_INDEPENDENT_RAYS = 1024  # rays unless ``samples`` says how many, where each receiver has its own


@check.frozen(spp="samples", rays="samples")
@dataclass(frozen=True)
class Visibility:
    """How visibility is computed. A setting that the method does not read is refused unless it is the default.

    Args:
        method: "directional" transmittance of planes, convex parts and spheres, "log-sh" of spheres, "none" (no
            shadows), or "ray-traced" visibility of the meshes, the reference. "auto" leaves the choice to
            :func:`warpshadow.tuning.tune.resolved`. None, where nothing is named: "directional" for renderers, fits and
            data sets, and for stills, as by :func:`warpshadow.render`, rays that all receivers share, which need
            neither spheres nor tables. A setting that "ray-traced" does not read names "directional".
        directions: Number of direction cells of "directional", a multiple of 16. None, the default, for 128, for 256 in
            scenes with narrow lobes, and for 512 where light bounces off narrow spots of lamps
            (:attr:`.Scene.direction_count`).
        softness: κ of "directional": half-width of a shadow's soft edge in cell radii.
        merging: τ: half-angle under which four neighboring spheres of 512 or more are seen as one, in radii of a cell
            ("directional") or of a cell for each coefficient ("log-sh"); 0 for never.
        self_shadows: How bodies cast shadows on themselves: from their meshes, "traced" once by rays; by "rays", which
            pixels send to a sun in every image, too; or from their "spheres". "Self-shadows" in scene/README.md
            compares them. Bodies may say otherwise.
        order: Number of SH bands, 2 to 8: of "log-sh", of the light that "none" shades with, and of free light by
            "ray-traced".
        log: Logarithm of one cap of "log-sh": "eigen" or "cap".
        base: Base approximation of the exponential of "log-sh": "quadratic", "linear" or "optimal_linear".
        samples: Number of rays: of "ray-traced" for a pixel, dealt to its samples, or the directions that are shared;
            of "directional" for a vertex of a static body, where other bodies move. None, the default, for 512 where
            they are shared, as in stills, and for 1024 elsewhere (:attr:`ray_count`).
        sampling: Where the rays of "ray-traced" go: "independent", drawn from the light for each receiver, so that
            errors are noise, and go away as rays become many; or "shared", in directions that all receivers have in
            common, each for a part of the light: few rays are enough and there is no grain, but an edge of a shadow
            has steps, of one ray's light at most. Stills have these.
        error: Largest relative error of shading that "auto" is to accept.
    """

    method: str | None = None
    directions: int | None = None
    softness: float = SOFTNESS
    merging: float = MERGING
    self_shadows: str = "traced"
    order: int = 8
    log: str = "eigen"
    base: str = "quadratic"
    samples: int | None = None
    sampling: str = "independent"
    error: float = 0.05

    def __post_init__(self) -> None:
        self._check_values()
        reader = self.method or DEFAULT_METHOD
        changed = [name for name in METHODS_OF_SETTING if getattr(self, name) != getattr(Visibility, name)]
        for name in changed:
            if name not in self.traits.settings:
                readers = " or ".join(map(repr, METHODS_OF_SETTING[name]))
                raise ValueError(
                    f"{name}: got {getattr(self, name)!r}, which {reader!r} does not read, expected the default, "
                    f"{getattr(Visibility, name)!r}, or method = {readers}; visibility.by({reader!r}) leaves such "
                    "settings out"
                )
        if self.method is None and set(changed) & _DIRECTIONAL_SETTINGS:
            object.__setattr__(self, "method", DEFAULT_METHOD)

    def _check_values(self) -> None:
        if self.method is not None:
            check.choice("method", self.method, (*METHODS, AUTO))
        if self.directions is not None:
            check_count("directions", self.directions)
        sh.check_order(self.order)
        check.choice("log", self.log, LOGS)
        check.choice("base", self.base, THRESHOLDS)
        check.choice("self_shadows", self.self_shadows, SELF_SHADOWS)
        check.choice("sampling", self.sampling, SAMPLINGS)
        if self.samples is not None:
            check.integer("samples", self.samples, unit="directions")
        if not (check.is_number(self.error) and self.error > 0):
            raise ValueError(f"error: got {self.error!r}, expected a positive number such as 0.05, which is 5%")
        falloff_width(self.softness, self.directions or DIRECTIONS)
        check_merging(self.merging)

    @property
    def traits(self) -> MethodTraits:
        """Of the method; where none is named, of the renderers' method."""
        return METHOD_TRAITS[self.method or DEFAULT_METHOD]

    @property
    def ray_count(self) -> int:
        """Number of rays: ``samples``, or as many as the method has by default."""
        if self.samples is not None:
            return self.samples
        return SHARED_DIRECTIONS if self.sampling == "shared" else _INDEPENDENT_RAYS

    @classmethod
    def of(cls, settings: Mapping[str, object]) -> Visibility:
        """Make one from settings for any methods, by their names: all are checked, and the method's own are used."""
        check.known_keys("", settings, ("method", *METHODS_OF_SETTING))
        every = object.__new__(cls)
        vars(every).update(settings)
        every._check_values()
        return cls(every.method, **{name: getattr(every, name) for name in every.traits.settings})

    def with_method(self) -> Visibility:
        """Copy with "directional" where no method is named, as renderers have it."""
        return self if self.method else self.by(DEFAULT_METHOD)

    def by(self, method: str) -> Visibility:
        """Copy for another method, with the settings that both read."""
        return Visibility.of(vars(self) | {"method": method})
