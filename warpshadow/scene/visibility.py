"""How visibility is computed: methods, and their settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from warpshadow import check
from warpshadow.maths import sh
from warpshadow.maths.directions import check_count, falloff_width
from warpshadow.stages.visibility.directional import SOFTNESS
from warpshadow.stages.visibility.exponential import THRESHOLDS
from warpshadow.stages.visibility.merging import MERGING, check_merging
from warpshadow.stages.visibility.zonal_logs import LOGS

SPHERE_METHODS = ("directional", "log-sh")
METHODS = (*SPHERE_METHODS, "none", "ray-traced")
DEFAULT_METHOD = "directional"  # method of renderers that are kept, where none is named
AUTO = "auto"
METHODS_OF_SETTING = {
    "directions": ("directional",),
    "softness": ("directional", AUTO),
    "merging": (*SPHERE_METHODS, AUTO),
    "self_shadows": (*SPHERE_METHODS, AUTO),
    "order": ("log-sh", "none", "ray-traced", AUTO),
    "log": ("log-sh",),
    "base": ("log-sh",),
    "samples": ("directional", "ray-traced"),
    "sampling": ("ray-traced",),
    "error": (AUTO,),
}
"""The methods that read each setting of a :class:`Visibility`; "auto" leaves some to the chosen method."""

_DIRECTIONAL_SETTINGS = {
    name for name, methods in METHODS_OF_SETTING.items() if DEFAULT_METHOD in methods and "ray-traced" not in methods
}
"""Settings that name :data:`DEFAULT_METHOD` where they are not the default."""

BOUNCE_METHODS = (*SPHERE_METHODS, "ray-traced", AUTO)  # the methods that find light that bounces

SELF_SHADOWS = ("traced", "rays", "spheres")

SAMPLINGS = ("independent", "shared")

SHARED_DIRECTIONS = 512
"""Directions that receivers share unless ``samples`` says how many, as in stills. Of 23 scenes of demos/kinds.py (128²,
direct light) stills have a mean error of 1.5%, at worst 2.5%, in a cage. With 256 edges of dim shadows show as streaks.
"""

_INDEPENDENT_RAYS = 1024  # rays unless ``samples`` says how many, where each receiver has its own
GLOSS_METHODS = ("directional", "none", "ray-traced", AUTO)
"""The methods that show it."""


@check.frozen
@dataclass(frozen=True)
class Visibility:
    """How visibility is computed. A setting that the method does not read is refused unless it is the default.

    Args:
        method: "directional" transmittance of spheres, "log-sh" of spheres, "none" (no shadows), or "ray-traced"
            visibility of the meshes, the reference. "auto" leaves the choice to
            :func:`warpshadow.tuning.tune.resolved`. None, where nothing is named: "directional" for renderers that are
            kept, fits and data sets, and for stills, as by :func:`warpshadow.render`, rays that all receivers share,
            which need neither spheres nor tables. A setting that "directional" alone reads names it.
        directions: Number of direction cells of "directional", a multiple of 16.
        softness: κ of "directional": half-width of a shadow's soft edge in cell radii.
        merging: τ: half-angle under which four neighboring spheres of 512 or more are seen as one, in radii of a cell
            ("directional") or of a cell for each coefficient ("log-sh"); 0 for never.
        self_shadows: How a body casts shadows on itself: from its mesh, "traced" once by rays wherever its shape is not
            free, or from its "spheres". "rays" are as "traced", but under "directional" pixels send rays to the
            brightest cells in every image: a sun's edge has no teeth, and rotations and cameras have no gradient.
            Pictures that are made once have that under a sun. Bodies may say otherwise.
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
            has steps, of at most what a ray brings. Stills have these.
        error: Largest relative error of shading that "auto" is to accept.
    """

    method: str | None = None
    directions: int = 128
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
            if reader not in METHODS_OF_SETTING[name]:
                readers = " or ".join(map(repr, METHODS_OF_SETTING[name]))
                raise ValueError(
                    f"{name}: got {getattr(self, name)!r}, which {reader!r} does not read, expected the default, "
                    f"{getattr(Visibility, name)!r}, or method = {readers}; visibility.by({reader!r}) leaves behind "
                    "what a method does not read"
                )
        if self.method is None and set(changed) & _DIRECTIONAL_SETTINGS:
            object.__setattr__(self, "method", DEFAULT_METHOD)

    def _check_values(self) -> None:
        if self.method is not None:
            check.choice("method", self.method, (*METHODS, AUTO))
        check_count("directions", self.directions)
        sh.check_order(self.order)
        check.choice("log", self.log, LOGS)
        check.choice("base", self.base, THRESHOLDS)
        check.choice("self_shadows", self.self_shadows, SELF_SHADOWS)
        check.choice("sampling", self.sampling, SAMPLINGS)
        if self.samples is not None:
            check.integer("samples", self.samples, what="directions")
        if not (check.is_number(self.error) and self.error > 0):
            raise ValueError(f"error: got {self.error!r}, expected a positive number such as 0.05, which is 5%")
        falloff_width(self.softness, self.directions)
        check_merging(self.merging)

    @property
    def ray_count(self) -> int:
        """Number of rays: ``samples``, or as many as the method has by default."""
        if self.samples is not None:
            return self.samples
        return SHARED_DIRECTIONS if self.sampling == "shared" else _INDEPENDENT_RAYS

    @classmethod
    def of(cls, settings: Mapping[str, object]) -> Visibility:
        """Make one from settings for any methods, by their names: all are checked, and the method's own are used."""
        check.known_keys("key", settings, ("method", *METHODS_OF_SETTING))
        every = object.__new__(cls)
        vars(every).update(settings)
        every._check_values()
        reader = every.method or DEFAULT_METHOD
        return cls(
            every.method,
            **{name: getattr(every, name) for name in METHODS_OF_SETTING if reader in METHODS_OF_SETTING[name]},
        )

    def with_method(self) -> Visibility:
        """The same by "directional" where no method is named, as renderers that are kept have it."""
        return self if self.method else self.by(DEFAULT_METHOD)

    def by(self, method: str) -> Visibility:
        """The same by another method, with the settings that both read."""
        return Visibility.of(vars(self) | {"method": method})
