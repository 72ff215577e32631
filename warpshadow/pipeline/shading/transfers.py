"""Transfer vectors, and the light that they meet: the kinds of light that a call takes, and coefficients in a basis."""

from typing import TypeAlias

import numpy as np
import warp as wp

from warpshadow import check
from warpshadow.assets.light import KNOWN_LIGHTS, LIGHT, KnownLightArgument, check_coefficients
from warpshadow.device.batch import concatenate
from warpshadow.device.constants import constant
from warpshadow.stages.light.shading import shade

LightArgument: TypeAlias = KnownLightArgument | wp.array
"""A map, SH coefficients [order², 3], or free coefficients in the renderer's basis, vec3 [batch, coefficient]."""

LARGEST_COEFFICIENT = 1e3 * check.LARGEST
"""Limit of coefficients after a change of basis: a sum of 64 harmonics of the largest accepted size exceeds that."""


def check_light(light: object) -> None:
    """Raise ValueError for a value that is neither light nor None."""
    expected = f"{LIGHT}, or free coefficients in renderer.basis as a tensor"
    check.instance("light", light, (*KNOWN_LIGHTS, np.ndarray, wp.array, type(None)), expected)
    if isinstance(light, np.ndarray):
        check_coefficients("light", light)


def shade_free(transfers: list[wp.array], light: wp.array, *, matrix: np.ndarray | None) -> wp.array:
    """Light the receivers of all portions by free light, which a matrix converts. Differentiable: transfers, light."""
    maximum = check.LARGEST
    if matrix is not None:
        light, maximum = change_basis(light, matrix), LARGEST_COEFFICIENT
    return join_portions([shade(transfer, light, maximum=maximum) for transfer in transfers])


def change_basis(light: wp.array, matrix: np.ndarray | None) -> wp.array:
    """Coefficients of light in another basis, to which a matrix takes them, None for the same; differentiable in it."""
    return light if matrix is None else shade(constant(matrix[None], wp.float32, light.device), light)


def join_portions(portions: list[wp.array]) -> wp.array:
    """Join the receivers of portions, [batch, receiver]. Differentiable: portions."""
    return portions[0] if len(portions) == 1 else concatenate(portions, [portion.shape[1] for portion in portions])


def join_rows(portions: list[wp.array]) -> wp.array:
    """Join rows of the receivers of portions, such as transfer vectors, [batch, receiver, item]. Differentiable."""
    if len(portions) == 1:
        return portions[0]
    rows = join_portions([portion.reshape((portion.shape[0], -1)) for portion in portions])
    return rows.reshape((rows.shape[0], -1, portions[0].shape[2]))
