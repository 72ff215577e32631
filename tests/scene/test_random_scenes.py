"""The data set of random scenes."""

import hashlib
import subprocess
import sys

import numpy as np
import pytest

import warpshadow as ws
from warpshadow.scene.random_scenes import RandomScenes, Ranges, primitives, random_light
from warpshadow.spheres import Spheres

UNSHADOWED = ws.Visibility(method="none")  # needs no spheres, which would have to be fitted


def numbers(scene):
    """All numbers that a scene consists of, by name."""
    arrays = {"light": scene.light.radiance, "clip": scene.camera.clip_matrix()}
    for number, body in enumerate(scene.bodies):
        arrays[f"{number}.mesh"] = body.mesh.positions
        for name in ("albedo", "rotation", "translation", "scale"):
            arrays[f"{number}.{name}"] = np.asarray(getattr(body, name))
    return arrays


def assert_same(one, other):
    one, other = numbers(one), numbers(other)
    assert one.keys() == other.keys()
    for name, values in one.items():
        np.testing.assert_array_equal(values, other[name], err_msg=name)


def test_a_scene_is_the_same_in_any_order_and_whatever_the_count():
    scenes = RandomScenes(3, 10)
    forward = [scenes[index] for index in range(4)]
    backward = [RandomScenes(3, 100)[index] for index in reversed(range(4))]
    for one, other in zip(forward, reversed(backward), strict=True):
        assert_same(one, other)


@pytest.mark.slow
def test_a_scene_is_the_same_in_another_process():
    program = (
        "import hashlib; from warpshadow.scene.random_scenes import RandomScenes; scene = RandomScenes(3)[7];"
        "print(hashlib.sha256(scene.light.radiance.tobytes() + scene.camera.clip_matrix().tobytes()).hexdigest())"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    scene = RandomScenes(3)[7]
    digest = hashlib.sha256(scene.light.radiance.tobytes() + scene.camera.clip_matrix().tobytes()).hexdigest()
    assert done.stdout.splitlines()[-1] == digest


def test_scenes_of_other_numbers_and_other_seeds_differ():
    lights = [RandomScenes(seed)[index].light.radiance for seed in range(2) for index in range(2)]
    for number, light in enumerate(lights):
        assert not any(np.array_equal(light, other) for other in lights[:number])


def test_a_data_set_is_a_sequence_that_ends():
    scenes = RandomScenes(0, 3, size=(16, 8))
    assert len(scenes) == 3
    assert sum(1 for _ in scenes) == 3
    assert_same(scenes[-1], scenes[2])
    for index in (3, -4):
        with pytest.raises(IndexError, match=f"index: got {index}, expected a scene from 0 to 2"):
            scenes[index]


def test_bodies_stand_on_the_ground_apart_from_each_other_and_in_view():
    scenes = RandomScenes(1, 60)
    for scene in scenes:
        *bodies, ground = (body.world_mesh() for body in scene.bodies)
        assert 1 <= len(bodies) <= 3
        np.testing.assert_allclose([body.bounds[0][1] for body in bodies], 0, atol=1e-5)
        np.testing.assert_array_equal(ground.positions[:, 1], 0)
        for number, one in enumerate(bodies):
            for other in bodies[:number]:
                gaps = np.maximum(one.bounds[0] - other.bounds[1], other.bounds[0] - one.bounds[1])
                middles = [np.mean(body.bounds, axis=0) for body in (one, other)]
                halves = [np.ptp(body.bounds, axis=0)[[0, 2]] / 2 for body in (one, other)]
                distance = np.linalg.norm((middles[0] - middles[1])[[0, 2]])
                assert gaps.max() > 0 or distance >= sum(map(np.linalg.norm, halves)) - 1e-5
            pixels = scene.camera.project(one.positions)
            middle = np.mean([pixels.min(axis=0), pixels.max(axis=0)], axis=0)
            assert (middle > 0).all() and (middle < 64).all()
        assert scene.camera.eye[1] > max(body.bounds[1][1] for body in bodies)


def test_every_scene_can_be_rendered_and_shows_bodies_and_ground():
    for scene in RandomScenes(2, 20, size=(32, 32), visibility=UNSHADOWED, supersampling=1):
        renderer = ws.Renderer(scene)
        image = renderer.render()
        assert np.isfinite(image).all()
        assert 0.3 < image[..., 3].mean() <= 1
        assert image[..., :3].max() > 0.01
        seen = renderer.body_ids()
        assert np.mean(seen == len(scene.bodies) - 1) > 0.1
        assert np.mean((seen >= 0) & (seen < len(scene.bodies) - 1)) > 0.01


def test_light_is_finite_and_comes_in_all_strengths():
    rng = np.random.default_rng(0)
    lights = [random_light(rng) for _ in range(60)]
    means = [np.mean(light.statistics()["mean_radiance"]) for light in lights]
    assert min(means) > 0
    assert max(means) > 10 * min(means)
    shares = [light.statistics()["brightest_percent_share"] for light in lights]
    assert min(shares) < 0.1 < 0.4 < max(shares)


def test_bodies_can_be_ones_own_and_keep_their_texture():
    texture = np.full((2, 2, 3), 0.25, np.float32)
    own = ws.Body(ws.plane(1.0, 2), texture=texture, blockers=0)
    scene = RandomScenes(0, bodies=[own])[0]
    for body in scene.bodies[:-1]:
        assert body.mesh is own.mesh
        np.testing.assert_array_equal(body.texture, texture)


def test_bodies_keep_colors_of_their_vertices():
    own = ws.Body(ws.plane(1.0, 1), albedo=np.linspace(0, 1, 12).reshape(4, 3), blockers=0)
    for body in RandomScenes(0, bodies=[own])[0].bodies[:-1]:
        np.testing.assert_array_equal(body.albedo, own.albedo)


def test_bodies_keep_the_one_color_of_their_mesh():
    flat = ws.plane(1.0, 1)
    red = ws.Mesh(flat.positions, flat.faces, colors=np.tile((1.0, 0, 0), (4, 1)))
    for body in RandomScenes(0, bodies=[ws.Body(red, blockers=0)])[0].bodies[:-1]:
        np.testing.assert_array_equal(body.albedo, (1, 0, 0))


def test_some_bodies_shine_others_are_as_without_gloss_and_those_that_shine_as_given_stay_so():
    ranges = Ranges(glossy=0.5, roughness=(0.3, 0.4), metal=0.25)
    bodies = [body for scene in RandomScenes(0, 60, ranges=ranges) for body in scene.bodies[:-1]]
    shining = [body for body in bodies if body.is_glossy]
    roughness = np.concatenate([body.roughness for body in shining])
    assert 0.4 < len(shining) / len(bodies) < 0.6 and 0.3 <= roughness.min() < 0.32 and 0.38 < roughness.max() <= 0.4
    assert 0.15 < np.mean([body.metallic for body in shining]) < 0.35
    assert {float(body.metallic[0]) for body in shining} == {0.0, 1.0}
    assert not any(body.is_glossy for scene in RandomScenes(0, 9) for body in scene.bodies)
    dull = ws.Body(ws.plane(1.0, 1), roughness=0.9, blockers=0)
    assert RandomScenes(0, bodies=[dull], ranges=ranges)[0].bodies[0].roughness == pytest.approx(0.9)


def test_near_light_is_that_of_infinitely_far_away_on_a_sphere_around_the_ground():
    near, far = (RandomScenes(0, 4, ranges=Ranges(radius=radius)) for radius in ((1.5, 1.5), None))
    for here, there in zip(near, far, strict=True):
        corner = np.linalg.norm(here.bodies[-1].mesh.positions[0])
        assert here.light.radius == pytest.approx(1.5 * corner, rel=1e-6) and there.light.radius is None
        np.testing.assert_array_equal(here.light.radiance, there.light.radiance)
    assert RandomScenes(0, 1, ranges=Ranges(radius=(1.01, 1.01)))[0].shell is not None  # all is within


def test_primitives_are_closed_face_outward_and_are_made_once():
    assert primitives() is primitives()
    for body in primitives():
        corners = body.mesh.positions[body.mesh.faces].astype(np.float64)
        areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        np.testing.assert_allclose(areas.sum(axis=0), 0, atol=1e-6)
        assert np.einsum("ij,ij->", areas, corners[:, 0]) > 0
        assert 0.5 < np.ptp(body.mesh.positions, axis=0).max() < 1.5
    assert isinstance(primitives()[0].blockers, Spheres)


def test_sharp_edges_stay_sharp():
    box = next(body.mesh for body in primitives() if body.mesh.name == "box")
    assert box.vertex_count == 24


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seed": -1}, "seed: got -1, expected a whole number of at least 0"),
        ({"count": 1.5}, "count: got 1.5, expected a whole number of at least 0"),
        ({"bodies": []}, "bodies: got none, expected one or more"),
    ],
)
def test_arguments_out_of_range_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        RandomScenes(**arguments)


@pytest.mark.slow
def test_importing_the_module_imports_nothing_heavy():
    program = (
        "import sys, warpshadow.scene.random_scenes; print(sorted({'torch', 'trimesh', 'scipy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_many_large_bodies_have_a_ground_that_reaches_beyond_them():
    ranges = Ranges(count=(6, 6), size=(1.5, 1.5), gap=(1.5, 1.5))
    for scene in list(RandomScenes(0, 4, ranges=ranges, visibility=UNSHADOWED)):
        *bodies, ground = scene.bodies
        widest = ground.world_mesh().bounds
        for body in bodies:
            low, high = body.world_mesh().bounds
            assert (low >= widest[0])[[0, 2]].all() and (high <= widest[1])[[0, 2]].all()
    assert RandomScenes(0, 1, visibility=UNSHADOWED)[0].bodies[-1].mesh.bounds[1][0] == 5
