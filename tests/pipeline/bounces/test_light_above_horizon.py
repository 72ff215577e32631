"""Light of a ground does not depend on where in the cells at the horizon the sky's light comes from."""

import dataclasses

import numpy as np

import warpshadow as ws

TOLERANCE = 0.01  # of the ground's light. Measured 0.0006; 0.042 where cells look to the bright side of the horizon


def test_a_ball_gets_all_light_of_the_ground_under_a_sky_that_ends_at_the_horizon():
    radiance = np.zeros((32, 64, 3), np.float32)
    radiance[:16] = 1.0
    ball = ws.Body(ws.icosphere(0.4, 3), (0.5, 0.5, 0.5), translation=(0, 0.7, 0), receivers="vertex", name="ball")
    ground = ws.Body(ws.plane(6.0, 8), (0.8, 0.8, 0.8), name="ground")
    camera = ws.Camera.look_at((0, 0.7, 3), (0, 0.7, 0), fov_y=14, size=(24, 24))
    scene = ws.Scene([ball, ground], ws.EnvironmentMap(radiance), camera, supersampling=1)

    def light_of_ground(visibility):
        lit = dataclasses.replace(scene, visibility=visibility)
        images = [ws.Renderer(dataclasses.replace(lit, bounces=n), progress=False).render()[..., 0] for n in (1, 0)]
        return (images[0] - images[1])[shown].mean()

    shown = ws.Renderer(scene, progress=False).body_ids()[0] == 0
    found, truth = light_of_ground(ws.Visibility()), light_of_ground(ws.Visibility("ray-traced", samples=4096))
    assert abs(found / truth - 1) < TOLERANCE
