"""Narrow cells: which they are, what takes whose place, and the penumbra of a sun."""

import numpy as np
import pytest
import warp as wp

from warpshadow import Body, Camera, EnvironmentMap, Mesh, Renderer, Scene, Spheres, Visibility, plane
from warpshadow.assets.cells import gather_cells, without_spots
from warpshadow.device.tape import recorded
from warpshadow.maths.directions import CHUNK, cell_radius, fibonacci
from warpshadow.stages.geometry.poses import Poses
from warpshadow.stages.visibility.sharp_cells import MAX_RADIUS_PAST_PLANES, blend_sharp_cells, find_sharp_cells

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

SUN = np.array([0.5, 0.8, 0.33]) / np.linalg.norm([0.5, 0.8, 0.33])
HALF_ANGLE = np.radians(2)
CELLS = 128


def map_with_discs(*discs, sky=0.2, height=256, half_angle=HALF_ANGLE):
    """A map of evenly bright discs, each a direction and a radiance, over a sky."""
    directions = EnvironmentMap.constant(0.0, height).directions()
    radiance = np.full(directions.shape, sky, np.float32)
    for center, bright in discs:
        radiance += np.float32(bright) * (directions @ center > np.cos(half_angle))[..., None]
    return EnvironmentMap(radiance)


def narrow_of(light, count=CELLS, **options):
    cells = light.cells(fibonacci(count))
    return cells, find_sharp_cells(cells.radiance.sum(axis=1), cells.spots, cells.half_angles, **options)


def test_an_even_sky_and_a_bright_half_have_no_narrow_cells():
    half = EnvironmentMap(np.float32([[[9.0] * 3] * 4, [[0.1] * 3] * 4]))
    for light in (EnvironmentMap.constant(1.0), half, map_with_discs((SUN, 10.0))):  # the last has 1% of the light
        assert narrow_of(light)[1] is None


def test_a_sun_is_found_where_it_is_and_as_wide_as_it_is():
    cells, sharp_cells = narrow_of(map_with_discs((SUN, 2000.0), sky=0.01))
    brightest = np.argmax(cells.radiance.sum(axis=1))
    assert sharp_cells.directions.shape == (CHUNK, 3)
    np.testing.assert_allclose(sharp_cells.directions[sharp_cells.slots[brightest]] @ SUN, 1, atol=1e-5)
    # the cell's own edge would be 4 times as wide; with it goes the mean of the sky in the cell
    assert 2.3 * HALF_ANGLE < sharp_cells.scale * cell_radius(CHUNK) < 2.7 * HALF_ANGLE


def test_two_suns_have_a_place_each():
    other = SUN * [-1, 1, -1]
    cells, sharp_cells = narrow_of(map_with_discs((SUN, 2000.0), (other, 1000.0)))
    found = np.flatnonzero(sharp_cells.slots >= 0)
    assert len(found) >= 2
    np.testing.assert_array_equal(sharp_cells.directions[sharp_cells.slots[found]], cells.spots[found])


def test_a_sun_of_5_degrees_is_narrow_where_planes_block_it_alone():
    wide = map_with_discs((fibonacci(CELLS)[40], 500.0), half_angle=np.radians(5))
    assert narrow_of(wide)[1] is None
    sharp_cells = narrow_of(wide, max_radius=MAX_RADIUS_PAST_PLANES)[1]
    assert 1 < sharp_cells.scale * cell_radius(CHUNK) / cell_radius(CELLS) < MAX_RADIUS_PAST_PLANES
    assert narrow_of(EnvironmentMap.constant(1.0), max_radius=MAX_RADIUS_PAST_PLANES)[1] is None


def test_without_its_spot_a_cell_has_the_light_around_it():
    light, directions = map_with_discs((SUN, 2000.0)), fibonacci(CELLS)
    cells, sharp_cells = narrow_of(light)
    found = np.flatnonzero(sharp_cells.slots >= 0)
    rest = without_spots(light.radiance, cells.spots[found], 2 * cells.half_angles[found])
    assert rest.max() == np.float32(0.2)
    around = gather_cells(rest, directions)
    changed = np.flatnonzero((around.radiance != cells.radiance).any(axis=1))
    assert set(found) <= set(changed)
    assert (light.directions()[rest[..., 0] == 0] @ SUN > np.cos(3.5 * HALF_ANGLE)).all()
    # its share of a cell; two suns' caps may reach out of it
    cap = (1 - np.cos(2 * cells.half_angles[found])) * CELLS / 2
    assert (around.radiance[found, 0] < 0.21).all()
    assert (around.radiance[found, 0] > 0.2 * (0.75 - cap)).all()


@pytest.mark.parametrize("height", [16, 64, 143, 256])
def test_a_sun_of_one_pixel_is_the_spot_of_its_cells(height):
    """Its spread is 0, or that of the part of it that a cell has."""
    rows, columns = np.random.default_rng(3).integers((height // 8, 0), (height // 2, 2 * height), (8, 2)).T
    for row, column in zip(rows, columns, strict=True):
        radiance = np.full((height, 2 * height, 3), 0.3, np.float32)
        radiance[row, column] = 0.5 * height**2
        cells, sharp_cells = narrow_of(EnvironmentMap(radiance))
        if sharp_cells is None and height == 16:  # its pixels are as wide as cells
            continue
        found = np.flatnonzero(sharp_cells.slots >= 0)
        rest = without_spots(radiance, cells.spots[found], 2 * cells.half_angles[found])
        assert rest.max() == np.float32(0.3)
        assert rest[row, column, 0] == 0


def test_where_a_wall_hides_a_sun_the_sky_beside_it_is_seen():
    """A bright ring around the sun: the wall hides the sun and half of the ring, which all is in one cell."""
    sun = min(fibonacci(CELLS), key=lambda towards: abs(towards[1] - 0.6))
    light = map_with_discs((sun, 20.0), sky=0.0, half_angle=np.radians(8)).radiance
    light = EnvironmentMap(light + map_with_discs((sun, 1000.0), sky=0.0).radiance)
    level = np.array([sun[0], 0, sun[2]]) / np.hypot(sun[0], sun[2])
    top = 3 * np.tan(np.arcsin(sun[1]) + np.radians(2.5))
    across = np.cross([0, 1, 0], level)
    corners = [3 * level + s * 20 * across + [0, height, 0] for s, height in ((-1, 0), (1, 0), (1, top), (-1, top))]
    wall = Body(Mesh(np.array(corners), [[0, 1, 2], [0, 2, 3]]), name="wall")
    camera = Camera.look_at((0, 2, 0.01), (0, 0, 0), fov_y=3, size=(4, 4))
    bodies = [Body(plane(20.0, 1), name="ground"), wall]
    kept = Renderer(Scene(bodies, light, camera, visibility=Visibility(directions=CELLS)), progress=False).render()
    rays = Scene(bodies, light, camera, visibility=Visibility("ray-traced", samples=4096))
    assert kept[..., 0].mean() == pytest.approx(Renderer(rays, progress=False).render()[..., 0].mean(), rel=0.3)


def test_in_many_cells_a_sun_is_as_any_light():
    assert narrow_of(map_with_discs((SUN, 2000.0)), 2048)[1] is None


@pytest.mark.parametrize("share", [1.0, 0.75])
def test_narrow_cells_are_blended_with_what_they_had(share, device, verified_tape):
    rng = np.random.default_rng(0)
    passing, sharp_cells = (rng.uniform(size=(2, 5, count)).astype(np.float32) for count in (32, CHUNK))
    places = np.full(32, -1, np.int32)
    places[[3, 20, 31]] = 0, 5, 5
    arrays = [wp.array(values, device=device, requires_grad=True) for values in (passing, sharp_cells)]
    with recorded() as tape:
        result = blend_sharp_cells(*arrays, places, np.full(32, share))
    is_narrow = places >= 0
    expected = passing.copy()
    expected[..., is_narrow] *= 1 - share
    expected[..., is_narrow] += share * sharp_cells[..., places[is_narrow]]
    np.testing.assert_allclose(result.numpy(), expected, rtol=1e-6)
    assert (arrays[0] is result) == (share == 1)  # the adjoint of the rest needs what it was
    weights = rng.normal(size=expected.shape).astype(np.float32)
    tape.backward(grads={result: wp.array(weights, device=device)})
    adj_sharp = np.zeros_like(sharp_cells)
    adj_sharp[..., 0], adj_sharp[..., 5] = share * weights[..., 3], share * (weights[..., 20] + weights[..., 31])
    np.testing.assert_allclose(arrays[0].grad.numpy(), weights * np.where(is_narrow, 1 - share, 1), rtol=1e-6)
    np.testing.assert_allclose(arrays[1].grad.numpy(), adj_sharp, rtol=1e-6)


def make_scene(count=CELLS, softness=0.35):
    """A ground that fills the picture, and over it a ball with one sphere, that is small in the picture."""
    angle = 2 * np.pi * np.arange(3) / 3
    body = Mesh(np.stack([0.01 * np.cos(angle), 0 * angle, 0.01 * np.sin(angle)], axis=1), [[0, 2, 1]])
    ball = Body(body, blockers=Spheres([[0.0, 0, 0]], [0.3]), self_shadows="spheres", translation=(0, 1, 0))
    ground = Body(plane(6.0, 2), blockers=0, receivers="pixel")
    camera = Camera.look_at((0.2, 5, 0.1), (-0.3, 0, -0.2), fov_y=30, size=(48, 48))
    light, visibility = map_with_discs((SUN, 2000.0), sky=0.0), Visibility(directions=count, softness=softness)
    return Scene((ground, ball), light, camera, visibility=visibility, supersampling=1)


def penumbra(points, center, radius):
    """The share of a sun's light that passes a sphere: a float64 twin, of directions all over the disc."""
    index = np.arange(4000) + 0.5
    around, away = np.pi * (1 + np.sqrt(5)) * index, np.sqrt(index / 4000)
    side = np.cross(SUN, [0, 1, 0]) / np.linalg.norm(np.cross(SUN, [0, 1, 0]))
    offsets = away[:, None] * (np.cos(around)[:, None] * side + np.sin(around)[:, None] * np.cross(SUN, side))
    towards = SUN + np.tan(HALF_ANGLE) * offsets
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    along = (center - points) @ towards.T
    across2 = ((center - points) ** 2).sum(axis=1)[:, None] - along**2
    return 1 - ((along > 0) & (across2 < radius**2)).mean(axis=1)


@pytest.mark.parametrize("softness", [0.012, 0.03, 1.5])
def test_any_softness_that_cells_have_suits_a_sun(softness, device):
    image = Renderer(make_scene(softness=softness), device=device).render()
    assert np.isfinite(image).all() and np.ptp(image[..., 0]) > 0


@pytest.mark.parametrize("count", [64, 128, 256])
def test_the_penumbra_of_a_sun_is_that_of_its_disc(count, device):
    points = np.stack([np.linspace(-1.4, 0.2, 400), np.zeros(400), np.full(400, -0.35)], axis=1)
    expected = penumbra(points, np.array([0, 1.0, 0]), 0.3)
    normals = np.broadcast_to([0, 1.0, 0], points.shape)
    given = [wp.array(values[None], dtype=wp.vec3, device=device) for values in (points, normals)]

    def error(softness):
        renderer = Renderer(make_scene(count=count, softness=softness), device=device)
        shading = renderer.shade(view=renderer.at_points(*given)).numpy()[0, :, 0]
        return np.sqrt(np.mean((shading / shading.max() - expected) ** 2))

    assert expected.min() == 0 and expected.max() == 1
    assert error(0.35) < 0.03  # an edge as wide as cells: 0.11, 0.061 and 0.028
    assert error(1.4) > 4 * error(0.35)  # softness counts here, too


def test_the_gradient_to_a_pose_is_that_of_the_image(device):
    renderer = Renderer(make_scene(), device=device)
    weights = np.random.default_rng(1).normal(size=(1, 48, 48, 4)).astype(np.float32)
    weights = np.cumsum(np.cumsum(weights, axis=1), axis=2) / 48  # smooth, so that it is more than noise
    rest = renderer.scene_poses()

    def image(shift, requires_grad=False):
        moved = rest.translations.numpy() + np.float32(shift) * [[[0], [1]]]
        translations = wp.array(moved, dtype=wp.vec3, device=device, requires_grad=requires_grad)
        view = renderer.view(renderer.placed(Poses(rest.rotations, translations, rest.scales)))
        return renderer.draw(view=view), translations

    with recorded() as tape:
        drawn, translations = image(np.zeros(3), True)
    tape.backward(grads={drawn: wp.array(weights, dtype=wp.vec4, device=device)})
    gradient = translations.grad.numpy()[0, 1]
    step, expected = 4e-3, np.zeros(3)
    for axis in range(3):
        ends = [float((weights * image(sign * step * np.eye(3)[axis])[0].numpy()).sum()) for sign in (1, -1)]
        expected[axis] = (ends[0] - ends[1]) / (2 * step)
    assert np.linalg.norm(gradient - expected) < 0.02 * np.linalg.norm(expected)
