"""Remarks on light of a shell that is narrower than cells."""

import numpy as np
import pytest

import warpshadow as ws
from warpshadow.scene.remarks import blurred_shell


def scene_with(light, **options):
    bodies = [ws.Body(ws.icosphere(0.5, 1)), ws.Body(ws.plane(2.0, 1))]
    return ws.Scene(bodies, light, visibility=ws.Visibility("directional", **options))


def spot(width, **options):
    """A disc of this angular radius [degrees], which sends as much light as an even sky around it."""
    middle = np.array([0.0, 1.0, 0.0])
    even = ws.EnvironmentMap.constant(1.0, height=128)
    is_lit = even.directions() @ middle > np.cos(np.radians(width))
    solid_angle = (is_lit * even.solid_angles()[:, None]).sum()
    return ws.EnvironmentMap(even.radiance + (is_lit * 4.2 * np.pi / solid_angle)[..., None], **options)


@pytest.mark.parametrize(
    ("width", "directions", "is_blurred"), [(5.0, 128, True), (5.0, 1024, False), (15.0, 128, False)]
)
def test_a_spot_narrower_than_a_cell_is_remarked_on(width, directions, is_blurred):
    assert bool(blurred_shell(scene_with(spot(width, radius=3.0), directions=directions))) == is_blurred


def test_light_infinitely_far_away_has_its_suns():
    assert not blurred_shell(scene_with(spot(5.0)))


def test_a_renderer_warns_of_it_once():
    scene = scene_with(spot(5.0, radius=3.0))
    with pytest.warns(UserWarning, match="of its shell, less than one of the 128 cells"):
        ws.Renderer(scene).render()
