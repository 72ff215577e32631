"""How often light bounces between patches: a number of times, or until nothing is left of it."""

from collections.abc import Callable

import numpy as np
import warp as wp

from warpshadow.scene.scene import Bounces
from warpshadow.stages.bounces.tail import TERM_COUNT, add_tail

SELF_BOUNCES = 8  # bounces of light that stays within one body; in a bowl of albedo 0.75 less than 1% is left then


def after_bounces(
    bounces: Bounces,
    light: Callable[[wp.array | None], wp.array],
    reflect: Callable[[wp.array, wp.array | None], wp.array],
    areas: np.ndarray,
    *,
    self_bounces: int,
) -> wp.array:
    """Radiosity of patches after all bounces but the last, which the receivers gather.

        B₀ = reflect(light(None), None),   Bₙ₊₁ = reflect(light(Bₙ), Bₙ)

    After the last bounce between bodies, ``reflect`` alone is repeated: light that stays within one body.

    Args:
        bounces: How often light bounces.
        light: Function of the radiosity B, None before the first bounce: the light of patches that is not from their
            own body, so from the sky and from other bodies. Only ``reflect`` reads its result.
        reflect: Function of that light and of B: adds the light from their own body, none for None, and returns the
            next radiosity.
        areas: Of patches, shape [patch].
        self_bounces: How often ``reflect`` alone is repeated after the last bounce, or after each of "all"; 0 where
            bodies send themselves no light.
    Returns:
        Radiosity, vec3 of shape [batch, patch].
    """
    bounced_light = light(None)
    radiosity = reflect(bounced_light, None)
    if bounces == "all":
        terms: list[wp.array] = []
        for bounce in range(TERM_COUNT):
            bounced_light = light(radiosity) if bounce else bounced_light
            for _ in range(max(self_bounces, 1 if bounce else 0)):
                radiosity = reflect(bounced_light, radiosity)
            terms.append(radiosity)
        return add_tail(terms, areas)
    for bounce in range(1, bounces + self_bounces):
        if bounce < bounces:
            bounced_light = light(radiosity)
        radiosity = reflect(bounced_light, radiosity)
    return radiosity
