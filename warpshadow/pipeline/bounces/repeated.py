"""How often light bounces between patches: a number of times, or until nothing is left of it."""

from collections.abc import Callable

import numpy as np
import warp as wp

from warpshadow.scene.scene import Bounces
from warpshadow.stages.bounces.tail import TERM_COUNT, add_tail

SELF_BOUNCES = 8  # bounces of light that stays within one body; in a bowl of albedo 0.75 less than 1% is left then


def after_bounces(
    bounces: Bounces,
    by_others: Callable[[wp.array | None], wp.array],
    add_by_self: Callable[[wp.array, wp.array | None], wp.array],
    areas: np.ndarray,
    *,
    self_bounces: int,
) -> wp.array:
    """Radiosity of patches after all bounces but the last, which the receivers gather.

        B₀ = add_by_self(by_others(None), None),   Bₙ₊₁ = add_by_self(by_others(Bₙ), Bₙ)

    After the last bounce between bodies, ``add_by_self`` alone is repeated: light that stays within one body.

    Args:
        bounces: How often light bounces.
        by_others: radiosity B → irradiance of patches from the sky and, unless B is None, from other bodies.
        add_by_self: (that irradiance, B) → the next radiosity, with light from patches of the same body added, unless B
            is None.
        areas: Of patches, shape [patch].
        self_bounces: How often ``add_by_self`` alone is repeated after the last bounce, or after each of "all"; 0 where
            bodies send themselves no light.
    Returns:
        Radiosity, vec3 of shape [batch, patch].
    """
    radiosity_by_others = by_others(None)
    radiosity = add_by_self(radiosity_by_others, None)
    if bounces == "all":
        terms: list[wp.array] = []
        for bounce in range(TERM_COUNT):
            radiosity_by_others = by_others(radiosity) if bounce else radiosity_by_others
            for _ in range(max(self_bounces, 1 if bounce else 0)):
                radiosity = add_by_self(radiosity_by_others, radiosity)
            terms.append(radiosity)
        return add_tail(terms, areas)
    for bounce in range(1, bounces + self_bounces):
        if bounce < bounces:
            radiosity_by_others = by_others(radiosity)
        radiosity = add_by_self(radiosity_by_others, radiosity)
    return radiosity
