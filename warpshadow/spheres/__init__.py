"""Spheres that cast the shadows of a mesh in its place.

    cover       stage 1: balls of the medial axis, picked greedily until they cover the mesh  [Wang et al. 2006]
    receivers   receivers on and around the mesh, in its cavities and on grounds, and their visibility, by rays
    refine      stage 2: gradient descent from there, until the spheres' visibility matches the mesh's
    enough      how many spheres a body needs, by short fits of a few counts
    measure     irradiance under a sky with a sun, the spheres' against the mesh's
    fit         the stages in order, the search for an error, the cache

In stage 2, spheres may leave the mesh in part. An open mesh is a sheet, seen
from both sides. Stage 2 uses the cones of warpshadow.stages.visibility.cones and the falloff of the directional method,
so the fit matches the renderer at receivers on and inside spheres.
"""

from warpshadow.spheres.fit import SHADOW_SPHERES, SphereFit, fit_spheres, is_fitted
from warpshadow.spheres.measure import FitReport
from warpshadow.spheres.occlusion import exact_occlusion
from warpshadow.spheres.plot import check_matplotlib, plot_spheres
from warpshadow.spheres.sphere_set import Spheres

__all__ = [
    "SHADOW_SPHERES",
    "FitReport",
    "SphereFit",
    "Spheres",
    "check_matplotlib",
    "exact_occlusion",
    "fit_spheres",
    "is_fitted",
    "plot_spheres",
]
