"""Small lamps: point and spot lights, whose shadows have edges as soft as the lamps are large."""

import numpy as np
import numpy.typing as npt

from warpshadow import check
from warpshadow.assets.gltf import gltf_tree, punctual_lights
from warpshadow.assets.light import EnvironmentMap
from warpshadow.assets.primitives import icosphere
from warpshadow.check import AnyPath
from warpshadow.scene.body import Body

_SUBDIVISIONS = 2  # of a ball, which the light does not tell from a finer one


@check.keywords(translation="position", emission="intensity", size="radius", cone="spot_light(…, beam=…)")
def point_light(
    position: npt.ArrayLike, intensity: npt.ArrayLike, *, radius: float = 0.05, name: str = "point light"
) -> Body:
    """Make a small ball that emits: a black body that blocks no light.

    Args:
        position: Its middle [scene units], shape [3].
        intensity: Radiant intensity [radiance · square of scene units], one number or RGB [3]: white that faces it from
            a distance d gets intensity / d², and looks intensity / (π d²).
        radius: Of the ball [scene units]. It shows radiance, intensity / (π radius²).
    """
    return _lamp_ball(position, intensity, radius, name, {})


@check.keywords(translation="position", emission="intensity", size="radius", cone="beam", direction="target")
def spot_light(
    position: npt.ArrayLike,
    target: npt.ArrayLike,
    intensity: npt.ArrayLike,
    *,
    beam: npt.ArrayLike = (20.0, 30.0),
    radius: float = 0.05,
    name: str = "spot light",
) -> Body:
    """Make a small ball that emits towards a target: a black body that blocks no light.

    Args:
        position, intensity, radius: As for :func:`point_light`; the intensity is that within the inner angle.
        target: A point on the axis of the beam [scene units], shape [3].
        beam: Inner and outer angle of the cone [degrees], as for :class:`.Body`.
    """
    place = check.array("position", position, (3,), "a point (x, y, z)")
    axis = check.array("target", target, (3,), "a point (x, y, z)") - place
    if not axis.any():
        raise ValueError(f"target: got {place.tolist()}, the position, expected another point")
    return _lamp_ball(place, intensity, radius, name, {"beam": beam, "rotation": _rotation_towards(axis)})


def load_lights(
    path: AnyPath,
    light: EnvironmentMap | None = None,
    *,
    radius: float = 0.05,
    angular_radius: float = 0.27,
    scale: float = 1.0,
) -> tuple[list[Body], EnvironmentMap]:
    """Read the lights of a .glb or .gltf file, KHR_lights_punctual.

    Args:
        path: The file; a body of it has its meshes.
        light: A map to which directional lights are added as suns; by default a dark one.
        radius: Of point and spot lights, which have none in the file [scene units].
        angular_radius: Of directional lights [degrees].
        scale: Factor of all intensities. Candela, lux and the nits of emissive materials fit each other without one.
    Returns:
        Lamps, of point and spot lights, and the map.
    """
    factor = check.nonnegative("scale", scale)
    lamps, result = [], EnvironmentMap.constant(0.0) if light is None else light
    check.instance("light", result, EnvironmentMap, "an EnvironmentMap")
    try:
        lights = punctual_lights(gltf_tree(check.file("path", path)))
    except (ValueError, LookupError, AttributeError, TypeError) as error:
        raise ValueError(f"path: got {path} ({error}), expected a .glb or .gltf file") from error
    for item in lights:
        intensity = factor * np.array(item.intensity)
        if item.kind == "directional":
            result = result.with_sun(-item.direction, intensity, angular_radius=angular_radius)
        elif item.beam is None:
            lamps.append(point_light(item.position, intensity, radius=radius, name=item.name))
        else:
            target = item.position + item.direction
            place = item.position, target, intensity
            lamps.append(spot_light(*place, beam=item.beam, radius=radius, name=item.name))
    return lamps, result


def _lamp_ball(position: npt.ArrayLike, intensity: npt.ArrayLike, radius: float, name: str, options: dict) -> Body:
    place = check.array("position", position, (3,), "a point (x, y, z)")
    colors = check.numbers("intensity", intensity, expected="one number of 0 or more, or RGB [3]", dtype=np.float64)
    if colors.shape not in ((), (3,)):
        raise ValueError(f"intensity: got shape {colors.shape}, expected one number, or RGB [3]")
    check.finite("intensity", colors, minimum=0)
    mesh = icosphere(check.positive("radius", radius), _SUBDIVISIONS)
    emission = np.broadcast_to(4 * colors / mesh.area, (3,))  # a convex body shows a quarter of its area on average
    return Body(mesh, (0.0, 0.0, 0.0), blockers=0, translation=place, emission=emission, name=name, **options)


def _rotation_towards(axis: np.ndarray) -> np.ndarray:
    """A rotation that takes −z to an axis, shape [3, 3]."""
    back = -axis / np.linalg.norm(axis)
    side = np.cross(np.eye(3)[np.abs(back).argmin()], back)
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(back, side), back], axis=1)
