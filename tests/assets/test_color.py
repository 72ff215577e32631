"""Colors: sRGB's encoding and its inverse, and exposure."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from warpshadow.assets.color import auto_exposure, linear_to_srgb, srgb_to_linear


@given(st.floats(0, 1))
def test_srgb_encoding_inverts_decoding(value):
    assert abs(linear_to_srgb(srgb_to_linear(value)) - value) < 1e-7  # the standard's branches meet to this


def test_exposure_is_that_of_the_covered_pixels():
    image = np.zeros((10, 10, 4), np.float32)
    assert auto_exposure(image) == 0
    image[5:, :, :] = (4, 1, 1, 1)
    assert auto_exposure(image) == -2
    image[..., :3] = 0
    assert auto_exposure(image) == 0


def test_a_lamp_in_view_does_not_turn_all_else_black():
    image = np.full((20, 20, 3), 0.5)
    image[:3, :3] = 50.0
    assert auto_exposure(image) == 0
    image[:3, :3] = 4.0
    assert auto_exposure(image) == -2  # no lamp, but a highlight
