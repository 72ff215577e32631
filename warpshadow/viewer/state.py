"""The state of a viewer that a page may change: checked, so that nothing else reaches a renderer."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from warpshadow import check
from warpshadow.assets.light import KnownLightArgument
from warpshadow.maths.directions import check_count
from warpshadow.scene.body import RECEIVERS, Body
from warpshadow.scene.files import turned_light
from warpshadow.scene.material import GLOSS_ARGUMENTS, GLOSS_DEFAULTS
from warpshadow.scene.scene import Bounces, Scene, check_bounces
from warpshadow.scene.visibility import (
    BOUNCE_METHODS,
    DEFAULT_METHOD,
    METHODS,
    METHODS_OF_SETTING,
    SAMPLINGS,
    Visibility,
)
from warpshadow.viewer.quality import Quality

MAX_CELLS, MAX_SPHERES, MAX_BOUNCES, MAX_STOPS = 1024, 512, 8, 20.0  # more than these a page may not ask for
AS_GIVEN = "as given"  # receivers, and numbers of spheres, as the scene has them

PICTURE, ERROR = "picture", "error against rays"
"""Shown image: the scene, or, once nothing moves, its difference from rays."""


@dataclass(frozen=True)
class BodyPose:
    """Pose of a body: a rotation, then a translation."""

    rotation: tuple[float, ...]  # axis-angle vector [degrees]
    translation: tuple[float, ...]  # offset [scene units]

    def __post_init__(self) -> None:
        """Check it."""
        for name in ("rotation", "translation"):
            values = check.array(name, getattr(self, name), (3,))
            check.finite(name, values, maximum=1e9, minimum=-1e9)
            object.__setattr__(self, name, tuple(values.tolist()))


def gloss_of(body: Body) -> dict[str, float]:
    """Numbers of a body's gloss, by name; none of a diffuse body, nor any that vary over it."""
    if not body.is_glossy:
        return {}
    values = {name: getattr(body, name) for name in GLOSS_ARGUMENTS}
    arrays = {name: np.full(1, GLOSS_DEFAULTS[name]) if value is None else value for name, value in values.items()}
    return {name: float(str(array[0])) for name, array in arrays.items() if array.size == 1}


@dataclass(frozen=True)
class ViewerState:
    """Viewer state."""

    turn: float  # of the light about +y [degrees]
    scale: float  # of the light
    stops: float  # exposure of the picture
    method: str  # of visibility
    sampling: str  # of "ray-traced"
    directions: int  # cells of "directional"
    softness: float  # κ of "directional"
    spheres: int | None  # for each body that casts shadows, how many; None as the scene has them
    receivers: str  # of all bodies, or AS_GIVEN
    bounces: Bounces  # of light; methods that find none leave them out
    shows: str  # PICTURE or ERROR
    shows_light: bool  # whether the light itself is behind the bodies
    poses: tuple[BodyPose, ...]  # of the bodies
    gloss: tuple[dict[str, float], ...]  # of the bodies: the numbers that there are, by name, 0 to 1

    def __post_init__(self) -> None:
        """Check it."""
        within("turn", self.turn, -360, 360)
        within("scale", self.scale, 0, 1000)
        within("stops", self.stops, -MAX_STOPS, MAX_STOPS)
        check.choice("method", self.method, METHODS)
        check.choice("sampling", self.sampling, SAMPLINGS)
        check_count("directions", self.directions)
        if self.directions > MAX_CELLS:
            raise ValueError(f"directions: got {self.directions}, expected at most {MAX_CELLS}")
        within("softness", self.softness, 0.05, 1.5)
        if self.spheres is not None:
            check.integer("spheres", self.spheres, unit="spheres")
            within("spheres", self.spheres, 1, MAX_SPHERES)
        check.choice("receivers", self.receivers, (AS_GIVEN, *RECEIVERS))
        check_bounces(self.bounces)
        if self.bounces != "all":
            within("bounces", self.bounces, 0, MAX_BOUNCES)
        check.choice("shows", self.shows, (PICTURE, ERROR))
        check.flag("shows_light", self.shows_light)
        for pose in self.poses:
            check.instance("poses", pose, BodyPose, "a Pose for each body")
        for gloss in self.gloss:
            check.instance("gloss", gloss, dict, "numbers by name, for each body")
            for name, value in gloss.items():
                within(name, value, 0, 1)

    @classmethod
    def of(cls, scene: Scene, stops: float = 0.0) -> ViewerState:
        """A scene as it is."""
        return cls(
            turn=0.0,
            scale=1.0,
            stops=stops,
            method=scene.visibility.method or DEFAULT_METHOD,
            sampling=scene.visibility.sampling,
            directions=min(scene.direction_count, MAX_CELLS),
            softness=scene.visibility.softness,
            spheres=None,
            receivers=AS_GIVEN,
            bounces=scene.bounces if scene.bounces == "all" else min(scene.bounces, MAX_BOUNCES),
            shows=PICTURE,
            shows_light=False,
            poses=tuple(BodyPose(tuple(body.rotation), tuple(body.translation)) for body in scene.bodies),
            gloss=tuple(map(gloss_of, scene.bodies)),
        )

    def visibility(self, visibility: Visibility, quality: Quality | None = None) -> Visibility:
        """The settings of a scene, as they are changed; no better than a quality asks for."""
        names = "method", "sampling", "directions", "softness"
        settings = {name: getattr(visibility, name) for name in METHODS_OF_SETTING}
        requested_visibility = Visibility.of(settings | {name: getattr(self, name) for name in names})
        if quality is None:
            return requested_visibility
        rays = quality.cells if requested_visibility.sampling == "shared" else quality.rays
        bounded_settings = {
            "directions": min(self.directions, quality.cells),
            "samples": min(requested_visibility.ray_count, rays),
        }
        return Visibility.of(vars(requested_visibility) | bounded_settings)

    def bodies(self, bodies: tuple[Body, ...]) -> tuple[Body, ...]:
        """Bodies with the spheres and receivers that are asked for, where the scene has them.

        Bodies that shine keep their receivers.
        """
        changed_settings: dict[str, object] = {} if self.receivers == AS_GIVEN else {"receivers": self.receivers}
        counts = {} if self.spheres is None else {"blockers": self.spheres}
        return tuple(
            dataclasses.replace(
                body,
                **({} if body.is_glossy else changed_settings),  # type: ignore[arg-type]
                **(counts if body.casts_shadow else {}),  # type: ignore[arg-type]
            )
            for body in bodies
        )

    def light(self, light: KnownLightArgument) -> KnownLightArgument:
        """Light as it is turned and scaled."""
        return turned_light(light, self.turn, self.scale)

    def settings(self, scene: Scene, quality: Quality | None = None) -> Scene:
        """The scene with the settings that are asked for; its bodies where they were, its light as it was."""
        visibility = self.visibility(scene.visibility, quality)
        return dataclasses.replace(
            scene,
            bodies=self.bodies(scene.bodies),
            visibility=visibility,
            bounces=self.bounces if visibility.method in BOUNCE_METHODS else 0,
            supersampling=min(scene.supersampling, quality.supersampling if quality else scene.supersampling),
        )

    def scene(self, scene: Scene) -> Scene:
        """The scene as it is shown."""
        settings = self.settings(scene)
        bodies = tuple(
            dataclasses.replace(
                body,
                rotation=np.array(pose.rotation),
                translation=np.array(pose.translation),
                **self.changed_gloss(body, number),  # type: ignore[arg-type]
            )
            for number, (body, pose) in enumerate(zip(settings.bodies, self.poses, strict=True))
        )
        return dataclasses.replace(settings, bodies=bodies, light=self.light(scene.light))

    def changed_gloss(self, body: Body, number: int) -> dict[str, float]:
        """Numbers of a body's gloss that are not as it has them, by name."""
        scene_numbers = gloss_of(body)
        return {name: value for name, value in self.gloss[number].items() if value != scene_numbers.get(name)}

    def has_moved(self, scene: Scene) -> bool:
        """Whether a body is not where the scene has it."""
        return self.poses != ViewerState.of(scene).poses


def within(name: str, value: object, minimum: float, maximum: float) -> None:
    """Raise ValueError unless a value is a number in a range."""
    if not (check.is_number(value) and minimum <= value <= maximum):
        raise ValueError(f"{name}: got {check.described(value)}, expected a number from {minimum:g} to {maximum:g}")
