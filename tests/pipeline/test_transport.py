"""The choice of how light bounces, row by row of its table; the nodes that follow it are tested by their images."""

import itertools

import pytest

from warpshadow.pipeline.transport import BounceSolver, choose_bounce_solver

PATHS, STATIC, MOVING = BounceSolver.PATHS, BounceSolver.STATIC, BounceSolver.MOVING

# light is free, reflectance is given, bodies and cameras are the scene's: by spheres, by rays
TABLE = {
    (False, False, True): (MOVING, PATHS),
    (False, False, False): (MOVING, PATHS),
    (False, True, True): (STATIC, STATIC),
    (False, True, False): (MOVING, STATIC),
    (True, False, True): (STATIC, STATIC),
    (True, False, False): (MOVING, STATIC),
    (True, True, True): (STATIC, STATIC),
    (True, True, False): (MOVING, STATIC),
}


@pytest.mark.parametrize("facts", list(itertools.product((False, True), repeat=3)))
def test_each_combination_of_inputs_has_the_bounces_of_its_row(facts):
    inputs = dict(zip(("is_free", "is_given", "is_of_scene"), facts, strict=True))
    by_spheres, by_rays = (
        choose_bounce_solver(**inputs, has_spheres=stand_in, shares_directions=False) for stand_in in (True, False)
    )
    assert (by_spheres, by_rays) == TABLE[facts]
    assert choose_bounce_solver(**inputs, has_spheres=False, shares_directions=True) is STATIC
