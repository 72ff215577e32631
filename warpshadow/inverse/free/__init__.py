"""Free parameters of fits: light, lamps, materials, poses, planes, shapes, cameras, exposure.

Each starts where the scene has it. Values are scaled (turns in radians, shifts in half diagonals of bodies, radiance by
the targets' own, …), so that one learning rate serves all.
"""

from warpshadow.inverse.free.base import Free
from warpshadow.inverse.free.emission import Emission
from warpshadow.inverse.free.gloss import Metallic, Roughness
from warpshadow.inverse.free.lamp import Lamp
from warpshadow.inverse.free.light import Light
from warpshadow.inverse.free.plane import Plane
from warpshadow.inverse.free.pose import Pose
from warpshadow.inverse.free.reflectance import Albedo, Texture
from warpshadow.inverse.free.shape import Deformation, Radii
from warpshadow.inverse.free.shell import Shell
from warpshadow.inverse.free.sun import Sun
from warpshadow.inverse.free.views import CameraPose, Exposure, OutlineOffset

FREE: tuple[type[Free], ...] = (
    *(Light, Sun, Shell, Exposure, CameraPose, OutlineOffset),
    *(Albedo, Texture, Roughness, Metallic, Emission, Lamp, Pose, Plane, Deformation, Radii),
)
"""All that may be free, in the order in which fit files list them."""
