"""What a fit may leave free: light, reflectance, poses, shapes, cameras, exposure.

Each starts where the scene has it. Values are in natural units (radians, half diagonals of bodies, reflectances, the
targets' own radiance), so that one learning rate serves all.
"""

from warpshadow.inverse.free.base import Free, Values
from warpshadow.inverse.free.light import Light
from warpshadow.inverse.free.pose import Pose
from warpshadow.inverse.free.reflectance import Albedo, Texture
from warpshadow.inverse.free.shape import Deformation, Radii
from warpshadow.inverse.free.views import CameraPose, Exposure

__all__ = [
    "Albedo",
    "CameraPose",
    "Deformation",
    "Exposure",
    "Free",
    "Light",
    "Pose",
    "Radii",
    "Texture",
    "Values",
]
