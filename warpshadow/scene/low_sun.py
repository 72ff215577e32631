"""A sun that is below the ground, which then keeps its light from all bodies on it."""

import numpy as np

from warpshadow.assets.light import EnvironmentMap
from warpshadow.scene.placement import grounds_of
from warpshadow.scene.scene import Scene

_SUN_SHARE = 0.01  # of all directions, from which half of the light comes where there is a sun
_LOW = -0.02  # height of the direction to it from which on it is below the horizon, by more than its rim


def sun_below(scene: Scene) -> list[str]:
    """Remark on a map whose sun is below the horizon, where a body that casts shadows is a ground, broader than all."""
    light = scene.known_light
    if not isinstance(light, EnvironmentMap) or light.shell is not None or not grounds_of(scene):
        return []
    solid_angles = np.repeat(light.solid_angles(), light.radiance.shape[1])
    luminance = light.radiance.mean(axis=2, dtype=np.float64).ravel()
    brightest = (-luminance).argsort()
    powers = (luminance * solid_angles)[brightest]
    sun = brightest[: np.searchsorted(powers.cumsum(), powers.sum() / 2) + 1]
    if not powers.sum() or solid_angles[sun].sum() > _SUN_SHARE * 4 * np.pi:
        return []
    direction = powers[: len(sun)] @ light.directions().reshape(-1, 3)[sun]
    direction /= max(np.linalg.norm(direction), 1e-12)
    if direction[1] > _LOW:
        return []
    x, y, z = direction.tolist()
    number = grounds_of(scene)[0]
    return [
        f"light: its sun is at ({x:.2g}, {y:.2g}, {z:.2g}), below body {number} ({scene.bodies[number].name!r}), which "
        "keeps its light from the others; y of a direction towards the sun is above 0"
    ]
