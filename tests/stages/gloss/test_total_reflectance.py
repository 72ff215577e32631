"""Total reflectance, against sums over lobes that are cut finely."""

import numpy as np
import pytest
import twins
import warp as wp

from warpshadow.stages.gloss.reflection import DIELECTRIC_F0
from warpshadow.stages.gloss.total_reflectance import total_reflectance

FIT = 1e-3  # of polynomials to W and W', the first of which counts for 4%
NODES, NODE_WEIGHTS = np.polynomial.legendre.leggauss(12)
COSINES = (NODES + 1) / 2  # of directions of view


def mean_of(values):
    """Mean over directions of view, by their cosine, [direction, …]."""
    return np.tensordot(NODE_WEIGHTS * COSINES, values, axes=1)


def reflectance_of(device, *values):
    """ρ of a point, of a, r, m and s."""
    arrays = [wp.array(np.full((1, 1, 3), value), dtype=wp.vec3, device=device) for value in values]
    return total_reflectance(*arrays).numpy()[0, 0, 0]


@pytest.mark.parametrize("roughness", [0.1, 0.3, 0.5, 0.7, 1.0])
def test_surfaces_reflect_what_their_lobes_do_on_average(device, roughness):
    white, grazing = mean_of([twins.lobe_energy(cosine, roughness) for cosine in COSINES])
    lost = DIELECTRIC_F0 + (1 - DIELECTRIC_F0) * mean_of([twins.even_grazing(cosine) for cosine in COSINES])
    for albedo, metallic, specular in ((0.5, 1.0, 1.0), (0.0, 0.0, 1.0), (0.8, 0.0, 0.5), (0.6, 0.4, 1.0)):
        mirrored = DIELECTRIC_F0 * (white - grazing) + grazing
        nonmetal = albedo * (1 - specular * lost) + specular * mirrored
        expected = (1 - metallic) * nonmetal + metallic * albedo
        assert reflectance_of(device, albedo, roughness, metallic, specular) == pytest.approx(expected, abs=FIT)


def test_diffuse_surfaces_reflect_their_albedo(device):
    assert reflectance_of(device, 0.3, 0.0, 0.0, 0.0) == pytest.approx(0.3, rel=1e-6)
