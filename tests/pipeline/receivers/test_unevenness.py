"""How far light is off between the vertices of faces, by which bodies get their receivers."""

import dataclasses

import numpy as np
import pytest
import trimesh

import warpshadow as ws
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.receivers.choice_of_receivers import UNEVEN, choose_receivers
from warpshadow.scene.scene import change_bodies


def scene_of(*, sunk=0.1, **options):
    """Pegs whose feet are in a box, of short faces in a small image, beside a ball."""
    rods = [trimesh.creation.cylinder(0.05, 0.4, sections=12) for _ in range(12)]
    for number, rod in enumerate(rods):
        rod.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
        rod.apply_translation((0.3 * (number % 4), 0.2 - sunk, 0.3 * (number // 4)))
    pegs = trimesh.util.concatenate(rods)
    slab = ws.Mesh(*(lambda box: (box.vertices, box.faces))(trimesh.creation.box((3, 0.4, 3)))).creased()
    bodies = [
        ws.Body(ws.Mesh(pegs.vertices, pegs.faces).creased(), name="pegs", **options),
        ws.Body(slab, translation=(0, -0.2, 0), name="slab"),
        ws.Body(ws.icosphere(0.3, 3), translation=(-0.7, 0.3, 0), name="ball"),
    ]
    camera = ws.Camera.look_at((0.4, 4.0, 7.0), (0.2, 0, 0), fov_y=30, size=(48, 48))
    return ws.Scene(bodies, ws.synthetic_sky(), camera)


def chosen(scene):
    return choose_receivers(MergedScene(scene), [scene.camera])


def test_bodies_whose_vertices_are_in_others_are_shaded_by_pixel():
    pegs, _, ball = chosen(scene_of())
    assert pegs.size.length < 16  # short enough for their vertices, but for what they see
    assert pegs.receivers == "pixel" and pegs.unevenness > 2 * UNEVEN
    assert ball.receivers == "vertex" and ball.unevenness < UNEVEN / 2


def test_it_says_why():
    notes = " ".join(ws.Renderer(scene_of()).explain().notes)
    assert "between its vertices light is off by" in notes


@pytest.mark.parametrize(("options", "method"), [({"receivers": "vertex"}, "directional"), ({}, "none")])
def test_nobody_looks_where_it_does_not_matter(options, method):
    scene = dataclasses.replace(scene_of(**options), visibility=ws.Visibility(method))
    assert chosen(scene)[0].unevenness == 0
    assert chosen(scene)[0].receivers == "vertex"


def test_their_light_is_that_of_rays():
    scene = scene_of()
    truth = ws.render(dataclasses.replace(scene, visibility=ws.Visibility("ray-traced")))
    shows = (truth[..., 3] > 0.99) & (ws.Renderer(scene).layers().bodies == 0)
    errors = []
    for receivers in ("auto", "vertex"):
        bodies = [dataclasses.replace(scene.bodies[0], receivers=receivers), *scene.bodies[1:]]
        image = ws.Renderer(dataclasses.replace(scene, bodies=bodies)).render()
        errors.append(np.abs(image - truth)[shows].mean())
    assert errors[0] < 0.7 * errors[1]


def slats(count):
    """Slats over a ground whose faces are smaller than two pixels."""
    boxes = [trimesh.creation.box((0.06, 0.1, 1.6)).apply_translation((x, 1, 0)) for x in np.linspace(-1, 1, count)]
    mesh = trimesh.util.concatenate(boxes)
    bodies = [ws.Body(ws.Mesh(mesh.vertices, mesh.faces).creased()), ws.Body(ws.plane(6.0, 64), name="ground")]
    camera = ws.Camera.look_at((1.6, 2.6, 4.6), (0, 0.5, 0), fov_y=36, size=(64, 64))
    return ws.Scene(bodies, ws.synthetic_sky((0.4, 0.9, 0.3)), camera)


@pytest.mark.parametrize(("count", "expected"), [(12, "adaptive"), (1, "vertex")])
def test_grounds_have_receivers_where_shadows_are_narrower_than_their_faces(count, expected):
    _, ground = chosen(slats(count))
    assert ground.size.area < 2 and ground.receivers == expected


def test_shadows_of_slats_are_those_of_rays():
    scene = slats(12)
    truth = ws.render(scene)[..., :3]
    images = [ws.Renderer(scene), ws.Renderer(change_bodies(scene, "receivers", {1: "vertex"}))]
    error, at_vertices = (np.linalg.norm(each.render()[..., :3] - truth) / np.linalg.norm(truth) for each in images)
    assert error < 0.04 < at_vertices


def wedge_on_ground(height=0.0):
    """A wedge whose toe points to the eye, on a ground whose faces are smaller than two pixels."""
    profile = [(-0.3, 0, -0.3), (-0.3, 0, 0.3), (-0.3, 0.4, -0.3)]
    hull = trimesh.convex.convex_hull(np.array(profile + [(-x, y, z) for x, y, z in profile]))
    wedge = ws.Body(ws.Mesh(hull.vertices, hull.faces).creased(), translation=(0, height, 0.5), name="wedge")
    camera = ws.Camera.look_at((1.4, 1.7, 3.6), (0, 0.5, 0.1), fov_y=32, size=(64, 64))
    bodies = [ws.Body(ws.plane(5.0, 64), name="ground"), wedge]
    return ws.Scene(bodies, ws.synthetic_sky((0.3, 0.9, 0.8)), camera)


@pytest.mark.parametrize(("height", "expected"), [(0.0, "adaptive"), (-0.03, "adaptive"), (0.3, "vertex")])
def test_grounds_with_vertices_inside_a_body_are_not_interpolated_from_these(height, expected):
    ground, _ = chosen(wedge_on_ground(height))
    assert ground.size.area < 2 and ground.unevenness < UNEVEN and ground.receivers == expected
    notes = " ".join(ws.Renderer(wedge_on_ground(height)).explain().notes)
    assert ("vertices inside other bodies" in notes) == (expected == "adaptive")


def test_no_dark_line_is_along_the_toe_of_a_wedge():
    """Pixels had 0.61 of the light there, interpolated from vertices inside the wedge, and have 0.96."""
    scene = wedge_on_ground()
    truth = ws.render(dataclasses.replace(scene, visibility=ws.Visibility("ray-traced", samples=512)))[..., 1]
    renderer = ws.Renderer(scene)
    shows = (renderer.layers().bodies == 0) & (truth > 0.7 * np.median(truth))
    assert (renderer.render()[..., 1][shows] / truth[shows]).min() > 0.85


@pytest.mark.parametrize(("height", "expected"), [(0.3, "vertex"), (0.1, "pixel")], ids=["touching", "sunk"])
def test_bodies_that_sink_into_a_ground_are_not_interpolated_from_below(height, expected):
    ball = ws.Body(ws.icosphere(0.3, 4), translation=(0, height, 0))
    camera = ws.Camera.look_at((0, 1.2, 3.5), (0, 0.2, 0), fov_y=30, size=(48, 48))
    scene = ws.Scene([ball, ws.Body(ws.plane(6.0, 64))], ws.synthetic_sky((0.3, 0.9, 0.8)), camera)
    assert chosen(scene)[0].receivers == expected


@pytest.mark.parametrize(("distance", "expected"), [(-1.05, "adaptive"), (-3.05, "vertex")], ids=["across", "beyond"])
def test_grounds_behind_a_wall_are_not_interpolated_across_it(distance, expected):
    wall = ws.Body(ws.plane((1.0, 1.0), 4), translation=(0, 0.5, distance), rotation=(90, 0, 0))
    camera = ws.Camera.look_at((0, 1.2, 3.5), (0, 0.2, -1), fov_y=30, size=(48, 48))
    scene = ws.Scene([ws.Body(ws.plane(6.0, 64)), wall], ws.EnvironmentMap.constant(), camera)
    assert chosen(scene)[0].receivers == expected


def waves(**options):
    """A body of waves that are high enough for a low sun to leave their backs dark."""
    grid = ws.plane(4.0, 48)
    mesh = ws.Mesh(grid.positions + np.outer(0.25 * np.cos(5 * grid.positions[:, 0]), (0, 1, 0)), grid.faces)
    camera = ws.Camera.look_at((0, 4, 5), (0, 0, 0), fov_y=45, size=(64, 64))
    return ws.Scene([ws.Body(mesh), ws.Body(ws.icosphere(0.3, 3), translation=(0, 1, 0))], camera=camera, **options)


@pytest.mark.parametrize(("sun", "expected"), [((1, 0.2, 0), "pixel"), ((0, 1, 0), "vertex")], ids=["low", "high"])
def test_shadows_that_cross_faces_are_seen_by_pixel(sun, expected):
    body, _ = chosen(waves(light=ws.synthetic_sky(sun)))
    assert body.receivers == expected and not body.size.exceeds(16)


def test_shadows_that_cross_faces_of_several_pixels_are_seen_by_pixel_though_they_are_small():
    bodies = [ws.Body(ws.icosphere(1.0, 4)), ws.Body(ws.icosphere(0.09, 3), translation=(0.45, 1.2, 0.2))]
    camera = ws.Camera.look_at((0, 3, 2), (0, 0.3, 0), fov_y=40, size=(200, 200))
    scene = ws.Scene(bodies, ws.synthetic_sky(), camera)
    hill, _ = chosen(scene)
    assert not hill.size.exceeds(16)
    assert UNEVEN / 2 < hill.max_unevenness < hill.unevenness < UNEVEN and hill.receivers == "pixel"
    assert f"{hill.unevenness:.1%}, more than {hill.max_unevenness:.1%}" in ws.Renderer(scene).explain().notes[0]


def test_free_light_is_taken_as_even():
    scene = waves(light=ws.synthetic_sky((1, 0.2, 0)))
    free, _ = choose_receivers(MergedScene(scene), [scene.camera], is_light_free=True)
    even, _ = chosen(waves(light=ws.EnvironmentMap.constant()))
    assert free.unevenness == even.unevenness < UNEVEN
    assert 3 * even.unevenness < chosen(scene)[0].unevenness


def test_sheets_are_lit_on_the_side_that_is_seen():
    scene = waves(light=ws.synthetic_sky((1, 0.2, 0)))
    body, *others = scene.bodies
    flipped = dataclasses.replace(body, mesh=dataclasses.replace(body.mesh, faces=body.mesh.faces[:, ::-1]))
    over = dataclasses.replace(scene, bodies=[flipped, *others])
    assert chosen(over)[0].unevenness == pytest.approx(chosen(scene)[0].unevenness, rel=1e-5)


def test_no_light_is_even():
    assert chosen(waves(light=ws.EnvironmentMap.constant(0.0)))[0].unevenness == 0


def lit_by(lamp, *, mesh=None, receivers="auto"):
    """A wall of short faces, with a thin panel in front of it, whose sides are strips of 4 cm."""
    wall = ws.Body(mesh or ws.plane(4.0, 40), rotation=(90, 0, 0), name="wall", receivers=receivers)
    box = trimesh.creation.box((1, 1, 0.04))
    panel = ws.Body(ws.Mesh(box.vertices, box.faces), (0, 0, 0), emission=(8, 8, 8), translation=lamp).creased()
    camera = ws.Camera.look_at((0, 0, 7.0), (0, 0, 0), fov_y=30, size=(48, 48))
    return ws.Scene([wall, panel], ws.EnvironmentMap.constant(0.0), camera)


def test_the_light_of_emitters_counts():
    kept = [ws.Renderer(lit_by((0, 0, distance))).scene.bodies[0].receivers for distance in (0.03, 2.0)]
    assert kept == ["pixel", "vertex"]


def test_shadows_in_the_light_of_emitters_count():
    ball = ws.Body(ws.icosphere(0.5, 3), name="ball")
    lamp = ws.Body(ws.icosphere(0.05, 2), (0, 0, 0), emission=(50, 50, 50), translation=(0.2, 1.6, 0.4), name="lamp")
    slats = [ws.Body(ws.plane((0.05, 1.0)), translation=(x, 0.7, 0.1)) for x in np.linspace(-0.4, 0.4, 7)]
    camera = ws.Camera.look_at((0, 1.5, 4.0), (0, 0, 0), fov_y=25, size=(40, 40))
    for bodies, expected in (([ball, lamp], "vertex"), ([ball, lamp, *slats], "pixel")):
        scene = ws.Scene(bodies, ws.EnvironmentMap.constant(0.0), camera)
        assert ws.Renderer(scene).scene.bodies[0].receivers == expected


def test_a_wall_that_a_lamp_nearly_touches_has_its_light():
    """1 cm behind the lamp; the truth has receivers at vertices 1.6 cm apart."""
    near = (0, 0, 0.03)
    renderer = ws.Renderer(lit_by(near))
    shows = renderer.layers().bodies == 0
    truth = ws.Renderer(lit_by(near, mesh=ws.plane(4.0, 250), receivers="vertex")).render()[shows]
    images = renderer.render(), ws.render(lit_by(near)), ws.Renderer(lit_by(near, receivers="vertex")).render()
    kept, still, coarse = (np.linalg.norm(image[shows] - truth) / np.linalg.norm(truth) for image in images)
    assert kept < 0.01 and still < 0.02 and coarse > 0.05
