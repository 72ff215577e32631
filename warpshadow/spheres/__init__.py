"""Spheres that stand in for a mesh as it casts shadows.

    cover       stage 1, the paper's: medial balls picked greedily, then descent on the volume outside the mesh and
                the surface left bare                               [Lyu et al. 2021, section 3.2; Wang et al. 2006]
    refine      stage 2: move, grow, shrink and relocate them until receivers on and around the mesh see through
                them what they see past the mesh: gradient descent on ray-traced visibility
    measure     irradiance under a sky with a sun, the spheres' against the mesh's
    fit         the stages in order, the search for an error, the cache

Stage 1 serves volume, stage 2 serves light: spheres leave the mesh where that helps the shadow. It sees the cones of
warpshadow.stages.visibility.cones with the soft edge of the directional method, so the rules that a renderer applies to
receivers on and inside spheres are part of what is fitted.
"""

from warpshadow.spheres.fit import SphereFit, fit_spheres, is_fitted
from warpshadow.spheres.measure import FitReport
from warpshadow.spheres.occlusion import exact_occlusion
from warpshadow.spheres.plot import check_matplotlib, plot_spheres
from warpshadow.spheres.sphere_set import Spheres

__all__ = [
    "FitReport",
    "SphereFit",
    "Spheres",
    "check_matplotlib",
    "exact_occlusion",
    "fit_spheres",
    "is_fitted",
    "plot_spheres",
]
