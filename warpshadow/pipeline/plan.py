"""Plans: what the next call computes, what it leaves out, and why.

Two things decide: what requires a gradient, and what changed since the last call. Each part of the pipeline asks here
for its plan and does what it says; :meth:`warpshadow.Renderer.explain` asks for the same plans and prints
them, so that what is said to be left out is left out.
"""

import contextlib
import time
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields

import warp as wp

from warpshadow.device.tape import record_adjoint

VERTICES, SPHERES, CAMERAS = "vertices", "spheres", "cameras"
LIGHT, ALBEDO, TEXTURES = "light", "albedo", "textures"
"""What may require a gradient."""


@dataclass(frozen=True)
class Decision:
    """Whether something runs, and why, or why not; it is true if it runs."""

    runs: bool
    why: str

    def __bool__(self) -> bool:
        return self.runs


@dataclass(frozen=True)
class Stage:
    """A stage of a call; it is true if it runs.

    Args:
        name: What it is called.
        forward: Whether it is computed.
        backward: Whether its adjoint is, when gradients are played back.
        items: On how many items, in words.
    """

    name: str
    forward: Decision
    backward: Decision
    items: str

    def __bool__(self) -> bool:
        return self.forward.runs


class Plan:
    """Stages of a part of the pipeline, in the order in which they run; base of the plans below."""

    def stages(self) -> list[Stage]:
        """The stages."""
        return [getattr(self, field.name) for field in fields(self)]  # type: ignore[arg-type]


def _stage(name: str, forward: Decision, wanted_by: Sequence[str], items: str) -> Stage:
    """A stage whose adjoint runs if it runs itself and something before it requires a gradient."""
    if not forward:
        backward = Decision(False, "nothing is computed")
    elif wanted_by:
        backward = Decision(True, f"a gradient to {' and '.join(wanted_by)} is asked for")
    else:
        backward = Decision(False, "nothing before it requires a gradient")
    return Stage(name, forward, backward, items if forward else "")


# ---------------------------------------------------------------------------------------------- views


@dataclass(frozen=True)
class ViewFacts:
    """What is known of a view, be it made or still to be made, before anything is computed from it.

    Args:
        varying: Which of vertices, spheres and cameras require a gradient.
        lit_by: Which of them light at the receivers depends on.
        moving: Bodies that move, from 0; None where any may.
        samples: Number of samples of its images.
        receivers: Number of receivers that may move; before the view is made, the most that there can be.
        still_receivers: Number of those on bodies that stand still among moving ones; likewise.
        is_made: Whether the view is made.
        keeps_transfer: Whether it keeps its transfer vectors.
        keeps_reflectance: Whether it keeps what its samples reflect in the scene.
    """

    varying: tuple[str, ...]
    lit_by: tuple[str, ...]
    moving: tuple[int, ...] | None
    samples: int
    receivers: int
    still_receivers: int
    is_made: bool
    keeps_transfer: bool = False
    keeps_reflectance: bool = False

    @property
    def placed_by(self) -> tuple[str, ...]:
        """What requires a gradient and places things in the image: all but spheres."""
        return tuple(name for name in self.varying if name != SPHERES)

    def count_of_receivers(self, count: int) -> str:
        """A number of receivers in words."""
        return f"{'' if self.is_made else 'up to '}{count:,} receivers"


@dataclass(frozen=True)
class ViewPlan(Plan):
    """What it takes to see a geometry."""

    clipping: Stage
    rasterization: Stage
    sides: Stage
    silhouettes: Stage
    normals: Stage
    receivers: Stage


def plan_view(
    change: Decision, view: ViewFacts, *, vertices: int, still_vertices: int, faces: int, two_sided_faces: int
) -> ViewPlan:
    """Plan a view, given whether what it depends on changed."""
    sides = change
    if change and not two_sided_faces:
        sides = Decision(False, "every body is closed: none is seen from behind")
    images = f"{view.samples:,} samples"
    corners = f"{vertices:,} vertices"
    moving_corners = f"{vertices - still_vertices:,} vertices, {still_vertices:,} kept" if still_vertices else corners
    shape = [name for name in view.varying if name == VERTICES]
    points = [name for name in view.lit_by if name != SPHERES]
    return ViewPlan(
        _stage("clip positions", change, view.placed_by, corners if CAMERAS in view.varying else moving_corners),
        _stage("rasterization", change, view.placed_by, f"{faces:,} faces, {images}"),
        _stage("sides", sides, (), f"{two_sided_faces:,} faces of open bodies"),
        _stage("silhouettes", change, (), images),
        _stage("normals", change, shape, moving_corners),
        _stage("receivers", change, points, view.count_of_receivers(view.receivers + view.still_receivers)),
    )


# ---------------------------------------------------------------------------------------------- light


@dataclass(frozen=True)
class LightFacts:
    """What is known of light.

    Args:
        is_kept: Whether the view keeps its shading in it.
        is_free: Whether it is given as coefficients that may be free.
        varies: Whether it requires a gradient.
        coefficients: How many take part.
    """

    is_kept: bool
    is_free: bool
    varies: bool
    coefficients: int


@dataclass(frozen=True)
class BlockerFacts:
    """What is known of what blocks light.

    Args:
        method: How visibility is computed.
        spheres: Number of spheres.
        moving_spheres: Number of those of bodies that move, all of them where any may.
        casting: Number of bodies that cast shadows.
        missing: Number of vertices on still bodies for which it is not known yet what still bodies block.
    """

    method: str
    spheres: int
    moving_spheres: int
    casting: int
    missing: int

    @property
    def still_spheres(self) -> int:
        """Number of those of bodies that stand still among moving ones."""
        return self.spheres - self.moving_spheres


@dataclass(frozen=True)
class LightingPlan(Plan):
    """What it takes to light a view's receivers."""

    still_shadows: Stage
    still_visibility: Stage
    visibility: Stage
    transfer: Stage
    shading: Stage


def plan_lighting(view: ViewFacts, light: LightFacts, blockers: BlockerFacts) -> LightingPlan:
    """Plan the light of a view."""
    is_traced = blockers.method == "ray-traced"
    if light.is_kept:
        new = shading = Decision(False, "kept: light, geometry and cameras stand")
    elif view.keeps_transfer and light.is_free:
        new = Decision(False, "kept: geometry and cameras stand")
        shading = Decision(True, "light is free")
    else:
        why = f"a gradient to {' and '.join(view.varying)} is asked for" if view.varying else "nothing is kept of it"
        new = shading = Decision(True, why)
    receivers, still = view.count_of_receivers(view.receivers), view.count_of_receivers(view.still_receivers)
    every = view.count_of_receivers(view.receivers + view.still_receivers)

    def visibility(blocking: int, bodies: str) -> Decision:
        if not new:
            return new
        if blockers.method == "none":
            return Decision(False, "the method is to have no shadows")
        if not blocking:
            return Decision(False, f"{bodies} has blockers")
        return new

    still_why = visibility(blockers.still_spheres, "no body that stands still among moving ones")
    if still_why:
        seen_first = "for vertices on still bodies that were not seen before"
        still_why = Decision(blockers.missing > 0, seen_first if blockers.missing else "kept: those bodies stand")
    on_still = visibility(
        blockers.spheres if blockers.method == "log-sh" else blockers.moving_spheres, "no moving body"
    )
    if on_still and not view.still_receivers:
        on_still = Decision(False, "no vertex that stands still among moving ones is a receiver")
    on_moving = visibility(blockers.casting if is_traced else blockers.spheres, "no body")
    if on_moving and not view.receivers:
        on_moving = Decision(False, "no receiver moves" if view.still_receivers else "nothing is seen")
    cast = f" × {blockers.spheres:,} spheres"
    if is_traced:
        still_why = on_still = Decision(False, "rays treat all receivers alike")
        cast = " by rays"
    transfer = new
    if is_traced and not light.is_free:
        transfer = Decision(False, "rays shade known light at once")
    varying = [*view.lit_by, *([LIGHT] if light.varies else [])]
    spheres = [name for name in view.varying if name == SPHERES]
    return LightingPlan(
        _stage("still shadows", still_why, (), f"up to {min(blockers.missing, view.still_receivers):,} vertices"),
        _stage("still visibility", on_still, spheres, f"{still} × {blockers.moving_spheres:,} spheres"),
        _stage("visibility", on_moving, view.lit_by, receivers + cast),
        _stage("transfer", transfer, view.lit_by, f"{every} × {light.coefficients} coefficients"),
        _stage("shading", shading, varying, every),
    )


# ---------------------------------------------------------------------------------------------- reflectance and image


@dataclass(frozen=True)
class ReflectanceFacts:
    """What is known of reflectance.

    Args:
        is_scenes: Whether all of it is the scene's.
        keeps_pyramids: Whether the textures are, and their mip levels have been made.
        texels: Number of texels of the textures of all instances.
        keeps_footprints: Whether the view keeps what its samples cover of textures of such sizes.
        is_flat: Whether the footprints that are kept take the finest levels alone.
        varying: Which of albedo and textures require a gradient.
        exposes: Whether samples are exposed as it is found what they reflect; see :func:`exposes_albedo`.
    """

    is_scenes: bool
    keeps_pyramids: bool
    texels: int
    keeps_footprints: bool
    is_flat: bool
    varying: tuple[str, ...]
    exposes: bool


@dataclass(frozen=True)
class ReflectancePlan(Plan):
    """What it takes to find what a view's samples reflect."""

    pyramids: Stage
    footprints: Stage
    reflectance: Stage


def exposes_albedo(varying: Collection[str]) -> bool:
    """Whether only textures, and maybe albedo, need gradients: one kernel then samples textures and exposes."""
    return TEXTURES in varying and not set(varying) - {ALBEDO, TEXTURES}


def plan_reflectance(view: ViewFacts, given: ReflectanceFacts) -> ReflectancePlan:
    """Plan what the samples of a view reflect."""
    if given.is_scenes and view.keeps_reflectance:
        pyramids = footprints = reflectance = Decision(False, "kept: reflectance, geometry and cameras stand")
    elif not given.texels:
        pyramids = footprints = Decision(False, "no body has a texture")
        reflectance = Decision(True, "nothing is kept of it" if given.is_scenes else "albedo is given")
    else:
        pyramids = Decision(True, "textures are given, or the scene's are used for the first time")
        if given.keeps_pyramids:
            pyramids = Decision(False, "kept: the scene's textures stand")
        elif given.is_flat:
            pyramids = Decision(False, "no sample takes a coarser level of the only texture")
        footprints = Decision(True, "nothing is kept of them")
        if given.keeps_footprints:
            footprints = Decision(False, "kept: geometry, cameras and sizes of textures stand")
        reflectance = Decision(True, "nothing is kept of it" if given.is_scenes else "reflectance is given")
        if given.exposes:
            reflectance = Decision(False, "found as samples are exposed: what they receive stands")
    samples = f"{view.samples:,} samples"
    textures = [name for name in given.varying if name == TEXTURES]
    return ReflectancePlan(
        _stage("mip pyramids", pyramids, textures, f"{given.texels:,} texels"),
        _stage("footprints", footprints, view.placed_by, samples),
        _stage("reflectance", reflectance, [*view.placed_by, *given.varying], samples),
    )


@dataclass(frozen=True)
class ImagePlan(Plan):
    """What it takes to make an image of what samples receive and reflect."""

    exposure: Stage
    contrasts: Stage
    smoothing: Stage
    averaging: Stage


def plan_image(view: ViewFacts, varying: Sequence[str], *, supersampling: int) -> ImagePlan:
    """Plan an image, given all that requires a gradient."""
    always = Decision(True, "light or reflectance may have changed")
    contrasts = Decision(
        bool(view.placed_by), "surfaces that move pull by how colors change on them and across silhouettes"
    )
    if not contrasts:
        contrasts = Decision(False, "no gradient moves silhouettes")
    averaging = always if supersampling > 1 else Decision(False, "a pixel has one sample")
    samples = f"{view.samples:,} samples"
    return ImagePlan(
        _stage("exposure", always, varying, samples),
        _stage("contrasts", contrasts, view.placed_by, samples),
        _stage("smoothing", always, varying, samples),
        _stage("averaging", averaging, varying, samples),
    )


# ---------------------------------------------------------------------------------------------- what the last call took


@dataclass
class Timing:
    """How long a stage took when it last ran, seconds of the host; on a GPU that is the time to launch it."""

    forward: float
    backward: float | None = None


class Ledger:
    """How long each stage took when it last ran.

    Attributes:
        timings: By the stages' names.
        waits: Whether a stage begins and ends with the device idle. On a GPU times are of its work then, and an image
            takes longer.
    """

    def __init__(self) -> None:
        self.timings: dict[str, Timing] = {}
        self.waits = False

    def _now(self) -> float:
        if self.waits:
            wp.synchronize()
        return time.perf_counter()

    @contextlib.contextmanager
    def timed(self, stage: Stage, inputs: Iterable[wp.array | None] = (), *, continues: bool = False) -> Iterator[None]:
        """Time a stage that runs, and its adjoint when the tape that is recording, if one is, plays it back.

        Args:
            stage: The stage.
            inputs: Its inputs, some of which require a gradient if it has an adjoint.
            continues: Whether this is a part of what was timed since :meth:`forget`, to which it adds.
        """
        if not stage:
            yield
            return
        inputs = list(inputs) if stage.backward else []
        start = self._now()
        timing = Timing(0.0)

        def end_adjoint() -> None:
            assert timing.backward is not None
            timing.backward += self._now()

        def start_adjoint() -> None:
            timing.backward = -self._now()

        record_adjoint(end_adjoint, inputs)  # the tape plays back from the end
        yield
        record_adjoint(start_adjoint, inputs)
        timing.forward = self._now() - start
        if continues and stage.name in self.timings:
            timing.forward += self.timings[stage.name].forward
        self.timings[stage.name] = timing

    def forget(self, stages: Iterable[Stage]) -> None:
        """Forget how long stages took that are about to run in parts."""
        for stage in stages:
            if stage:
                self.timings.pop(stage.name, None)


class Explanation:
    """What the next call computes, stage by stage; as text a table.

    Args:
        stages: In the order in which they run.
        timings: How long they took last, by name.
        is_host: Whether launches wait until they are done, as they do on a CPU.

    Attributes:
        stages: By name.
    """

    def __init__(self, stages: Iterable[Stage], timings: dict[str, Timing], *, is_host: bool):
        self.stages = {stage.name: stage for stage in stages}
        self.timings = dict(timings)
        self._is_host = is_host

    def __getitem__(self, name: str) -> Stage:
        return self.stages[name]

    def __repr__(self) -> str:
        return str(self)

    def __str__(self) -> str:
        rows = [("forward", "", "last", "items", "why")]
        for stage in self.stages.values():
            timing = self.timings.get(stage.name)
            rows.append(_row(stage.name, stage.forward, None if timing is None else timing.forward, stage.items))
        rows.append(("backward", "", "last", "items", "why"))
        for stage in reversed(self.stages.values()):
            timing = self.timings.get(stage.name)
            last = None if timing is None else timing.backward
            rows.append(_row(stage.name, stage.backward, last, stage.items if stage.backward else ""))
        widths = [max(len(row[column]) for row in rows) for column in range(4)]
        lines = [
            "  ".join([*(cell.ljust(width) for cell, width in zip(row[:4], widths, strict=True)), row[4]]).rstrip()
            for row in rows
        ]
        if not self._is_host:
            lines.append("Times are the host's: a launch returns before the GPU is done.")
        return "\n".join(lines)


def _row(name: str, decision: Decision, last: float | None, items: str) -> tuple[str, str, str, str, str]:
    time_taken = "" if last is None else f"{1e3 * last:.2f} ms"
    return f"  {name}", "runs" if decision else "–", time_taken, items, decision.why
