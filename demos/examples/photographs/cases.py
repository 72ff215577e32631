"""Five photographs whose truth is known: path traced by another renderer, and all that a user is given of them.

Each has something that the fits do not model: a lamp that is near, gloss, a grain of the table; blur, noise and JPEG;
and one a lens with distortion. ``take.py`` made the pictures beside this file.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import warpshadow as ws
from demos.scenes import shipped_mesh
from warpshadow import inverse
from warpshadow.inverse.constraints import stable_rotation

FOLDER = Path(__file__).parent
SIZE = (320, 240)  # pixels
TABLE_SIZE = 6.0  # what is modelled of the table [bodies are 2 units large]
BODY, TABLE = "body", "table"


LAMP = (2.2, 3.4, 0.6)  # of the first case
METRE = 2 / 0.3  # scene units, of bodies 30 cm large
MIDDLE = np.array([0, 0.75, 0])  # of the bodies
LAMP_DISTANCE = float(np.linalg.norm(LAMP - MIDDLE)) / METRE


def lamp_at(metres: float) -> tuple[float, float, float]:
    """The first lamp, moved to a distance from the bodies."""
    return tuple((MIDDLE + metres / LAMP_DISTANCE * (LAMP - MIDDLE)).tolist())


@dataclass(frozen=True)
class Case:
    """A photograph.

    Args:
        name: Of its files.
        mesh: That ships with Warp.
        albedo: Of the body.
        lamp: Middle of a spherical lamp [scene units].
        wattage: Factor of the lamp's radiance.
        gloss: Whether body and table have a coat.
        turn: Of the body about the vertical [degrees].
        lens: OpenCV's k1, k2, p1, p2, k3.
    """

    name: str
    mesh: str
    albedo: tuple[float, float, float]
    lamp: tuple[float, float, float]
    wattage: float = 1.0
    gloss: bool = False
    turn: float = 0.0
    lens: tuple[float, ...] = (0.0,) * 5

    @property
    def camera(self) -> ws.Camera:
        """As calibrated."""
        return ws.Camera.look_at((1.6, 2.6, 4.6), (0, 0.75, 0), fov_y=36, size=SIZE)

    def truth(self) -> ws.Scene:
        """The scene, its table in one color: the body rests as it would on a real one."""
        from scipy.spatial.transform import Rotation

        mesh = shipped_mesh(self.mesh)
        rotation = stable_rotation(mesh, Rotation.from_euler("y", self.turn, degrees=True).as_matrix(), np.eye(3)[1])
        vector = Rotation.from_matrix(rotation).as_rotvec(degrees=True)
        body = ws.Body(mesh, albedo=self.albedo, rotation=vector, blockers=40, name=BODY).on_ground(size=2.0)
        table = ws.Body(ws.plane(TABLE_SIZE, 64), albedo=(0.5,) * 3, name=TABLE)
        return ws.Scene((body, table), ws.EnvironmentMap.constant(1.0), self.camera, ws.Visibility(directions=64))

    def target(self, grown: int = 0, *, moves_outlines: bool = True) -> inverse.Target:
        """The photograph with its masks; that of the body grown by some pixels, or shrunk."""
        from scipy import ndimage

        outline = ws.read_image(FOLDER / f"{self.name}_body.png")[..., 0] > 0.5
        if grown:
            change = ndimage.binary_dilation if grown > 0 else ndimage.binary_erosion
            outline = change(outline, iterations=abs(grown))
        return inverse.Target(
            FOLDER / f"{self.name}.jpg",
            FOLDER / f"{self.name}_mask.png",
            self.camera,
            saturation=250 / 255,
            outlines={BODY: outline.astype(np.float32)},
            moves_outlines=moves_outlines,
            distortion=self.lens if any(self.lens) else None,
        )


CASES = (
    Case("lamp", "bunny", (0.6, 0.45, 0.3), LAMP),
    Case("gloss", "bear", (0.35, 0.15, 0.1), (-2.0, 3.6, 1.4), gloss=True, turn=25),
    Case("lens", "rocks", (0.5, 0.5, 0.45), (1.5, 4.0, -2.0), lens=(-0.18, 0.06, 0.002, -0.003, 0.0)),
    *(
        Case(f"lamp_{metres}m", "bunny", (0.6, 0.45, 0.3), lamp_at(metres), wattage=(metres / LAMP_DISTANCE) ** 2)
        for metres in (1, 2)
    ),
)
"""The lamps of the last two are in the direction of the first, and light the body as much: see :func:`lamp_at`."""


def alone(scene: ws.Scene, number: int) -> ws.Scene:
    """A scene of one body, of which its mask is asked."""
    return dataclasses.replace(scene, bodies=(scene.bodies[number],), visibility=ws.Visibility("none"), supersampling=4)
