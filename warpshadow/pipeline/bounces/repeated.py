"""How often light bounces between patches: a number of times, or until nothing is left of it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp

from warpshadow.scene.scene import Bounces
from warpshadow.stages.bounces.tail import with_tail

OWN_BOUNCES = 8
"""How often a body's light for itself goes on: in a bowl of albedo 0.75 less than 1% is left then."""

_COUNTED = 6
"""Terms of the sum over bounces among patches, direct light being the first, before the tail; receivers find one bounce
more. In a white room that is open in front the energy among patches is then 0.1% too low, with four terms 2.0%, and at
an albedo of 0.9 0.01% and 0.9%. In a white room with a window it is 0.7% and 13% too low; with two bodies in it 13% and
37%, for light stays between them and the floor."""


def after_bounces(
    bounces: Bounces,
    light: Callable[[wp.array | None], wp.array],
    reflect: Callable[[wp.array, wp.array | None], wp.array],
    areas: np.ndarray,
    *,
    own_bounces: int,
) -> wp.array:
    """Radiosity of patches after all bounces but the last, which receivers find.

    Args:
        bounces: How often light bounces.
        light: Of the radiosity of patches, or of the sky alone for None: light on patches from the sky and from other
            bodies, in whatever form ``reflect`` takes it.
        reflect: Of that and of the radiosity, None for none: the radiosity with their own body's light for it.
        areas: Of patches, shape [patch].
        own_bounces: How often a body's light for itself goes on: after the last of a number of bounces, and
            after each of "all"; 0 where there is none.
    """
    past = light(None)
    radiosity = reflect(past, None)
    if bounces == "all":
        terms: list[wp.array] = []
        for bounce in range(_COUNTED):
            past = light(radiosity) if bounce else past
            for _ in range(max(own_bounces, 1 if bounce else 0)):
                radiosity = reflect(past, radiosity)
            terms.append(radiosity)
        before, last, now = terms[-3:]
        return with_tail(before, last, now, areas)
    for bounce in range(1, bounces + own_bounces):
        if bounce < bounces:
            past = light(radiosity)
        radiosity = reflect(past, radiosity)
    return radiosity
