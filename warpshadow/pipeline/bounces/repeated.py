"""How often light bounces between patches: a number of times, or until nothing is left of it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp

from warpshadow.scene.scene import Bounces
from warpshadow.stages.bounces.tail import TERM_COUNT, with_tail

SELF_BOUNCES = 8  # how often a body's light for itself goes on: in a bowl of albedo 0.75 less than 1% is left then


def after_bounces(
    bounces: Bounces,
    light: Callable[[wp.array | None], wp.array],
    reflect: Callable[[wp.array, wp.array | None], wp.array],
    areas: np.ndarray,
    *,
    self_bounces: int,
) -> wp.array:
    """Radiosity of patches after all bounces but the last, which the receivers gather.

    Args:
        bounces: How often light bounces.
        light: Of the radiosity of patches, or of the sky alone for None: light on patches from the sky and from other
            bodies, in the form that ``reflect`` takes.
        reflect: Of that and of the radiosity, None for none: the radiosity with their own body's light for it.
        areas: Of patches, shape [patch].
        self_bounces: How often a body's light for itself goes on: after the last of a number of bounces, and
            after each of "all"; 0 where there is none.
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
        return with_tail(terms, areas)
    for bounce in range(1, bounces + self_bounces):
        if bounce < bounces:
            bounced_light = light(radiosity)
        radiosity = reflect(bounced_light, radiosity)
    return radiosity
