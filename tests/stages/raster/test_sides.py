"""Sides: an open surface has on each side the light that falls on it there."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp

import warpshadow as ws
from warpshadow.assets.basis import HarmonicBasis
from warpshadow.device import warp_internals
from warpshadow.pipeline.bodies.merged_scene import MergedScene
from warpshadow.pipeline.renderer import SceneRenderer
from warpshadow.pipeline.views import receiver_finder
from warpshadow.pipeline.views import view as view_module
from warpshadow.stages.geometry.normals import vertex_normals
from warpshadow.stages.raster.project import to_clip
from warpshadow.stages.raster.rasterization import rasterize
from warpshadow.stages.raster.sides import find_sides
from warpshadow.torch import TorchRenderer, rotation_matrices
from warpshadow.tuning.point_sample import PointSample

METHODS = ("directional", "log-sh", "none", "ray-traced")
SMOOTH_METHODS = METHODS[:3]
RECEIVERS = ("vertex", "pixel")
# The same float32 numbers, summed in another order; logs of visibility amplify how they are rounded.
FLOAT32 = 2e-5
# Light from one half of all directions: in cells, in bands of spherical harmonics, by 1024 rays.
HALF_LIGHT = {"directional": 0.02, "log-sh": 0.03, "none": 0.03, "ray-traced": 0.03}
# Differences of an image without silhouettes, in which shadows bend over the step; the same for fronts.
SMOOTH = 1e-2
# Differences of points of faces that are as large as samples, against mean slopes over samples; measured 2.0e-2.
SLOPES = 4e-2

pytestmark = pytest.mark.usefixtures("one_thread", "poisoned_outputs", "few_rays")


# ---------------------------------------------------------------------------------------------- scenes

ABOVE = ws.Camera.look_at((0.3, 2.4, 2.6), (0, 0, 0), fov_y=50, size=(28, 24))
"""Sees the inside of the bowl, the outside below its near rim, and the ball."""
BELOW = ws.Camera.look_at((-0.4, -2.6, 1.8), (0, 0, 0), fov_y=50, size=(28, 24))
INSIDE = ws.Camera.look_at((0.15, 0.45, 0.2), (0, -1, 0), fov_y=40, size=(24, 24))
"""Sees nothing but the inside of the bowl."""

SKY = ws.synthetic_sky((-0.7, 0.5, 0.2), height=32, sun_radius=12)


def turned_over(mesh: ws.Mesh, chosen=slice(None)) -> ws.Mesh:
    """The mesh with some faces wound the other way."""
    faces, uv_faces = mesh.faces.copy(), None if mesh.uv_faces is None else mesh.uv_faces.copy()
    faces[chosen] = faces[chosen, ::-1]
    if uv_faces is not None:
        uv_faces[chosen] = uv_faces[chosen, ::-1]
    return replace(mesh, faces=faces, uv_faces=uv_faces)


def bowl() -> ws.Mesh:
    """The lower part of a ball that is not round, its faces counter-clockwise from outside."""
    ball = ws.icosphere(1.0, 3)
    is_low = ball.positions[ball.faces].mean(axis=1)[:, 1] < 0.1
    uvs = ball.positions[:, [0, 2]] * 0.5 + 0.5
    return ws.Mesh(ball.positions * [1.0, 0.7, 0.8], ball.faces[is_low], uvs, ball.faces[is_low], "bowl")


def bowl_scene(method: str, receivers: str = "vertex", *, mesh: ws.Mesh | None = None, camera=ABOVE) -> ws.Scene:
    """A bowl that casts a shadow, and a closed ball over it that casts one into it."""
    texture = np.random.default_rng(0).uniform(0.1, 0.9, (8, 8, 3))
    rim = ws.Spheres([(0.9, -0.1, 0), (-0.9, -0.1, 0.1), (0, -0.6, 0)], [0.15, 0.2, 0.15])
    bodies = (
        ws.Body(bowl() if mesh is None else mesh, texture=texture, blockers=rim, receivers=receivers),
        ws.Body(
            ws.icosphere(0.4, 2), albedo=(0.8, 0.5, 0.3), blockers=ws.Spheres([(0, 0, 0)], [0.4]), receivers=receivers
        ),
    )
    bodies = bodies[0], replace(bodies[1], translation=(-0.2, 0.6, -0.2))
    visibility = ws.Visibility.of({"method": method, "directions": 32, "order": 4, "samples": 256})
    return ws.Scene(bodies, SKY, camera, visibility)


def assert_near(got, expected, tolerance: float = FLOAT32) -> None:
    got, expected = np.asarray(got), np.asarray(expected)
    assert got.shape == expected.shape
    assert np.abs(got - expected).max() <= tolerance * np.abs(expected).max()


# ---------------------------------------------------------------------------------------------- what is seen


def half_lit(method: str, receivers: str, eye, mesh: ws.Mesh) -> ws.Scene:
    """A sheet at y = 0 under a sky of 1 above the horizon and nothing below."""
    sky = np.zeros((32, 64, 3), np.float32)
    sky[:16] = 1
    camera = ws.Camera.look_at(eye, (0, 0, 0), fov_y=30, size=(8, 8))
    visibility = ws.Visibility(method)
    return ws.Scene((ws.Body(mesh, blockers=0, receivers=receivers),), ws.EnvironmentMap(sky), camera, visibility)


@pytest.mark.parametrize("receivers", RECEIVERS)
@pytest.mark.parametrize("method", METHODS)
def test_a_sheet_under_half_a_sky_is_lit_above_and_dark_below_however_it_winds(method, receivers):
    sheet = ws.plane(4.0, 6)
    some = np.random.default_rng(1).random(sheet.face_count) < 0.4
    for mesh in (sheet, turned_over(sheet), turned_over(sheet, some)):
        for eye, expected in (((0.1, 3, 0.5), 1.0), ((0.1, -3, 0.5), 0.0)):
            image = ws.render(half_lit(method, receivers, eye, replace(mesh, uvs=None, uv_faces=None)))
            albedo = ws.Body(mesh, blockers=0).albedo[0]
            assert (image[..., 3] == 1).all()
            assert np.abs(image[..., 0] / albedo - expected).max() < HALF_LIGHT[method]


@pytest.mark.slow
@pytest.mark.parametrize("camera", [ABOVE, BELOW, INSIDE])
@pytest.mark.parametrize("receivers", RECEIVERS)
@pytest.mark.parametrize("method", METHODS)
def test_how_an_open_mesh_winds_does_not_matter_to_an_image(method, receivers, camera):
    """One sees its front from where the other's back is: on fronts, what is known of closed meshes is relied on."""
    images = [
        ws.render(bowl_scene(method, receivers, mesh=mesh, camera=camera)) for mesh in (bowl(), turned_over(bowl()))
    ]
    assert_near(*images)


@pytest.mark.parametrize("method", ["directional", "log-sh", "ray-traced"])
def test_free_light_falls_on_backs_as_known_light_does(method):
    """In the terms of a basis, with the same light in both."""
    coefficients = np.random.default_rng(2).uniform(0.1, 1, (9, 3)).astype(np.float32)
    images = []
    for mesh in (bowl(), turned_over(bowl())):
        renderer = SceneRenderer(bowl_scene(method, mesh=mesh), basis=HarmonicBasis(3))
        images.append(renderer.draw(wp.array(coefficients[None], dtype=wp.vec3)).numpy())
    assert_near(*images)
    assert_near(images[0], SceneRenderer(bowl_scene(method)).draw(coefficients).numpy(), 0.05)


@pytest.mark.slow
@pytest.mark.parametrize("receivers", RECEIVERS)
@pytest.mark.parametrize("method", METHODS)
def test_cameras_see_both_sides_of_a_surface_at_once(method, receivers):
    cameras = [ABOVE, BELOW, INSIDE]
    cameras = [ws.Camera(c.intrinsics, c.rotation, c.translation, 24, 24) for c in cameras]
    scene = bowl_scene(method, receivers)
    together = SceneRenderer(scene, cameras=cameras).render()
    for camera, image in zip(cameras, together, strict=True):
        # ray-traced samples take their directions by the number of the receiver, which differs
        assert_near(image, ws.render(replace(scene, camera=camera)), 0.05 if method == "ray-traced" else FLOAT32)


@pytest.mark.parametrize("receivers", RECEIVERS)
@pytest.mark.parametrize("method", SMOOTH_METHODS)
def test_instances_see_both_sides_of_a_surface_at_once(method, receivers):
    renderer = TorchRenderer(bowl_scene(method, receivers))
    turns = rotation_matrices(torch.tensor([[[0.0, 0, 0], [0, 0, 0]], [[2.5, 0, 0.4], [0, 0, 0]]]))
    rotations, translations, scales = renderer.scene_poses()

    def draw(turns: torch.Tensor) -> torch.Tensor:
        geometry = renderer.placed(turns @ rotations, translations.expand(len(turns), -1, -1), scales)
        return renderer(geometry=geometry)

    together = draw(turns)
    assert (together[0] - together[1]).abs().max() > 0.1
    for instance in range(2):
        assert_near(together[instance], draw(turns[instance : instance + 1]).reshape(together[0].shape))


@pytest.mark.slow
@pytest.mark.parametrize("is_free", [False, True])
@pytest.mark.parametrize("moving", [[0], [1]])
@pytest.mark.parametrize("method", SMOOTH_METHODS)
def test_backs_that_stand_among_moving_bodies_are_lit_as_fronts_that_do(method, moving, is_free):
    """The bowl blocks light, so that rays start on the side that is seen; a second image is made of what is kept."""
    images = []
    for mesh in (bowl(), turned_over(bowl())):
        renderer = SceneRenderer(bowl_scene(method, mesh=mesh))
        light = None
        if is_free:
            values = np.random.default_rng(3).uniform(0.1, 1, (1, renderer.basis.size, 3))
            light = wp.array(values, dtype=wp.vec3)
        for camera in (BELOW, ABOVE):
            matrices = wp.array(camera.clip_matrix()[None], dtype=wp.mat44)
            view = renderer.view(renderer.placed(moving=moving), matrices)
            images.append(renderer.draw(light, view=view).numpy())
    assert_near(images[0], images[2])
    assert_near(images[1], images[3])
    whole = SceneRenderer(bowl_scene(method))
    if method == "none":
        assert_near(images[1], whole.draw(light).numpy())


def test_beside_static_bodies_where_nothing_is_read_back_backs_are_lit_as_well(monkeypatch):
    """As on a GPU, where all vertices are receivers, those of open bodies with their backs where a sample sees one."""
    scene = bowl_scene("none")
    expected = SceneRenderer(scene).render()
    monkeypatch.setattr(receiver_finder, "is_readable", lambda device: False)
    renderer = SceneRenderer(scene)
    view = renderer.view(renderer.placed(moving=[1]))
    vertex_counts = [body.mesh.vertex_count for body in scene.bodies]
    receiver_count = view.receivers.points.shape[1] + len(view.receivers.static_vertices)
    assert receiver_count <= 2 * vertex_counts[0] + vertex_counts[1]
    assert len(view.receivers.static_vertices) == 2 * vertex_counts[0]
    assert_near(renderer.draw(view=view).numpy()[0], expected)


def test_points_that_are_compared_with_rays_are_on_the_side_that_is_seen():
    for eye, expected in (((0.1, 3, 0.5), 1.0), ((0.1, -3, 0.5), 0.0)):
        scene = half_lit("directional", "vertex", eye, ws.plane(4.0, 6))
        if expected == 0:  # a sample under no light is refused, so some comes from below
            sky = scene.light.radiance.copy()
            sky[16:] = 0.25
            scene, expected = replace(scene, light=ws.EnvironmentMap(sky)), 0.25
        sample = PointSample(scene, count=16, direction_count=1024)
        for shading in (sample.reference, sample.interpolated_reference, sample.shading(scene)):
            assert np.abs(shading - expected).max() < 0.03


# ---------------------------------------------------------------------------------------------- gradients


class Motion:
    """An image of a renderer, as a function of (turn [3], shift [3]) of the bowl, and of all else that may be free."""

    def __init__(self, scene: ws.Scene, moving=None):
        self.renderer = TorchRenderer(scene)
        self.moving = moving
        self.radii = torch.from_numpy(self.renderer.array_renderer.rest().radii.numpy().copy())[:, :3]
        self.poses = self.renderer.scene_poses()
        self.camera = torch.tensor(scene.camera.clip_matrix(), dtype=torch.float32)[None]
        light = torch.rand(self.renderer.basis.size, 3, generator=torch.Generator().manual_seed(4))
        self.values = {
            "turn": torch.zeros(3),
            "shift": torch.zeros(3),
            "radii": torch.zeros(3),
            "camera": torch.zeros(3),
            "light": light,
            "albedo": torch.full((3,), 0.6),
            "texture": torch.tensor(scene.bodies[0].texture, dtype=torch.float32),
        }

    def __call__(self, values: dict[str, torch.Tensor]) -> torch.Tensor:
        still = torch.zeros(1, 3)
        rotations, translations, scales = self.poses
        turns = rotation_matrices(torch.cat([values["turn"][None], still]))
        shifts = torch.cat([values["shift"][None], still])
        rest = self.renderer.deformed(0, radii=self.radii * (1 + values["radii"]) if self.radii.numel() else None)
        geometry = self.renderer.placed(turns @ rotations, translations + shifts, scales, rest=rest, moving=self.moving)
        eye = torch.eye(4) + torch.cat([torch.zeros(4, 3), torch.cat([values["camera"], torch.zeros(1)])[:, None]], 1)
        return self.renderer(
            values["light"],
            albedo=[None, values["albedo"]],
            textures=[values["texture"], None],
            geometry=geometry,
            clip_matrices=self.camera @ eye,
        )

    def gradients(self) -> dict[str, torch.Tensor]:
        """Of a weighted sum of the image."""
        values = {name: value.clone().requires_grad_() for name, value in self.values.items()}
        loss = self.loss(values)
        gradients = torch.autograd.grad(loss, list(values.values()), allow_unused=True)
        return {name: gradient for name, gradient in zip(values, gradients, strict=True) if gradient is not None}

    def loss(self, values: dict[str, torch.Tensor]) -> torch.Tensor:
        image = self(values).squeeze(0)
        row, column = torch.meshgrid(*(torch.linspace(0, 4, size) for size in image.shape[:2]), indexing="ij")
        weights = torch.stack([torch.sin(row + column + phase) for phase in range(4)], dim=-1)
        return (image.double() * weights).sum()

    def difference(self, name: str, direction: torch.Tensor, step: float) -> float:
        with torch.no_grad():
            ends = [
                self.loss(self.values | {name: self.values[name] + sign * step * direction}).item() for sign in (1, -1)
            ]
        return (ends[0] - ends[1]) / (2 * step)


@pytest.mark.slow
@pytest.mark.parametrize("moving", [None, [0]])
@pytest.mark.parametrize("receivers", RECEIVERS)
@pytest.mark.parametrize("method", SMOOTH_METHODS)
def test_how_an_open_mesh_winds_does_not_matter_to_gradients(method, receivers, moving):
    """Edges of backs have the colors that they have as edges of fronts, too."""
    got, expected = (
        Motion(bowl_scene(method, receivers, mesh=mesh), moving).gradients() for mesh in (turned_over(bowl()), bowl())
    )
    for name, gradient in expected.items():
        assert_near(got[name], gradient, 20 * FLOAT32)
        assert gradient.any()


@pytest.mark.slow
@pytest.mark.parametrize("receivers", RECEIVERS)
@pytest.mark.parametrize("method", SMOOTH_METHODS)
def test_gradients_of_backs_are_central_differences_of_the_image(method, receivers):
    """Where no silhouette is in view, of a body of one color: between the texels of a texture differences bend.

    Where samples of a pixel share receivers, the image steps as edges pass them; then pixels have one sample.
    """
    supersampling = 1 if receivers == "pixel" else 2
    motion = Motion(replace(bowl_scene(method, receivers, camera=INSIDE), supersampling=supersampling))
    fragments = motion.renderer.array_renderer.view().fragments
    assert (fragments.sides.numpy() > fragments.face_ids.numpy()).all()
    motion.values["texture"][:] = 0.5
    gradients = motion.gradients()
    generator = torch.Generator().manual_seed(5)
    gradients.pop("albedo")  # of the ball, which is out of view
    for name in gradients:
        directions = [torch.randn(motion.values[name].shape, generator=generator) for _ in range(3)]
        got = np.array([(gradients[name] * direction).sum().item() for direction in directions])
        expected = np.array([motion.difference(name, direction, 1e-4) for direction in directions])
        tolerance = SLOPES if name in ("turn", "shift", "camera") else SMOOTH
        assert np.linalg.norm(got - expected) < tolerance * np.linalg.norm(expected), name


# ---------------------------------------------------------------------------------------------- what it costs


def launches_of(monkeypatch, call) -> Counter:
    """Kernels that a call launches, with their numbers of threads."""
    counts: Counter = Counter()
    bound_kernel = warp_internals.bound_kernel

    def counted(kernel, *arguments, **options):
        launch = bound_kernel(kernel, *arguments, **options)

        def run(dim, *first):
            counts[kernel.key, str(dim)] += 1
            launch(dim, *first)

        return run

    with monkeypatch.context() as patch:
        patch.setattr(warp_internals, "bound_kernel", counted)
        call()
    return counts


def test_closed_bodies_are_not_asked_which_side_is_seen(monkeypatch):
    scene = bowl_scene("directional")
    renderer = SceneRenderer(
        replace(scene, bodies=(replace(scene.bodies[0], mesh=ws.icosphere(1.0, 3), texture=None),))
    )
    monkeypatch.setattr(view_module, "find_sides", None)
    view = renderer.view()
    vertex_count = len(renderer.merged_scene.body_of_vertex)
    assert view.receivers.receiver_of_vertex.shape == (vertex_count,) and view.fragments.sides is None
    assert view.receivers.faces.shape == renderer.merged_scene.faces.shape
    assert view.receivers.fragments is view.fragments
    explained = SceneRenderer(renderer.scene).explain()
    assert not explained["sides"] and "closed" in explained["sides"].forward.why
    assert f"up to {vertex_count} receivers" in explained["receivers"].items


@pytest.mark.parametrize(("mesh", "camera", "more"), [(bowl(), BELOW, 2), (turned_over(bowl()), INSIDE, 1)])
def test_an_open_body_that_shows_its_front_alone_gets_no_receiver_more(mesh, camera, more, monkeypatch):
    """One launch finds that no face turns its back to the camera; or that some do, and a second that no sample sees."""
    scene = bowl_scene("none", mesh=mesh, camera=camera)
    scene = replace(scene, bodies=scene.bodies[:1])
    renderer, one_sided = SceneRenderer(scene), SceneRenderer(scene)
    counts = launches_of(monkeypatch, renderer.view)
    with monkeypatch.context() as patch:
        patch.setattr(MergedScene, "is_two_sided", np.zeros(1, bool))
        expected = launches_of(monkeypatch, one_sided.view)
    assert not expected - counts and (counts - expected).total() == more
    assert renderer.view().fragments.sides is None
    np.testing.assert_array_equal(renderer.view().receivers.points.numpy(), one_sided.view().receivers.points.numpy())


# ---------------------------------------------------------------------------------------------- parts


def test_sides_are_those_of_float64(device):
    """Of random triangles, seen by cameras of one image or mirrored in it."""
    rng = np.random.default_rng(6)
    positions = rng.normal(size=(2, 90, 3)).astype(np.float32)
    faces = np.arange(90).reshape(30, 3)
    eyes = rng.normal(size=(2, 3)) * 2 + [0, 0, 5]
    matrices = np.array([ws.Camera.look_at(eye, (0, 0, 0), size=(32, 32)).clip_matrix() for eye in eyes])
    matrices[1, 0] *= -1  # mirrored
    arrays = wp.array(positions, dtype=wp.vec3, device=device), wp.array(matrices, dtype=wp.mat44, device=device)
    faces_ = wp.array(faces, dtype=wp.vec3i, device=device)
    fragments = rasterize(to_clip(*arrays), faces_, 32, 32)
    two_sided = np.arange(0, 30, 2)
    found = find_sides(fragments, faces_, wp.array(two_sided, dtype=wp.int32, device=device), *arrays)
    a, b, c = np.moveaxis(positions.astype(np.float64)[:, faces], 2, 0)
    is_back = np.sum(np.cross(b - a, c - a) * (eyes[:, None] - a), axis=-1) < 0
    is_back[:, 1::2] = False
    face_ids = fragments.face_ids.numpy()
    expected = face_ids.copy()
    for view in range(2):
        expected[view] += 30 * (is_back[view][face_ids[view]] & (face_ids[view] >= 0))
    assert (expected >= 30).sum() > 50 and ((expected >= 0) & (expected < 30)).sum() > 50
    np.testing.assert_array_equal(found.sides.numpy(), expected)


def test_a_ground_that_goes_on_to_the_horizon_shows_its_front_alone():
    for size in (10.0, 1e5):
        camera = ws.Camera.look_at((0, 0.01, 2), (0, 0, -1), size=(64, 64))
        body = ws.Body(ws.plane(size, 64), blockers=0, translation=(3e-3 * size, 0, 0))
        scene = ws.Scene((body,), SKY, camera, ws.Visibility("none"))
        assert SceneRenderer(scene).view().fragments.sides is None


def test_a_surface_is_closed_where_two_faces_share_each_edge_and_look_outward():
    ball = ws.icosphere(0.5, 2).transformed(translation=np.array([3.0, 2, 1]))
    apart = ws.Mesh(ball.positions[ball.faces].reshape(-1, 3), np.arange(3 * ball.face_count).reshape(-1, 3))
    some = np.random.default_rng(7).random(ball.face_count) < 0.3
    closed = {"ball": ball, "faces apart": apart, "wound anyhow": turned_over(ball, some)}
    hole = replace(ball, faces=ball.faces[1:])
    opened = {"plane": ws.plane(), "hole": hole, "inside out": turned_over(ball), "bowl": bowl()}
    for name, mesh in (closed | opened).items():
        assert mesh.surface.is_closed == (name in closed), name


def test_boxes_that_share_edges_are_closed():
    """Four faces meet at the edges that steps of stairs share, and at the corners of a box of boards."""

    def steps(upper: np.ndarray) -> ws.Mesh:
        corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
        faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]])
        faces = np.concatenate([faces, [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]])
        higher = corners * (1, 2, 1) + (0, 0, 1)
        return ws.Mesh(np.concatenate([corners, higher]), np.concatenate([faces, faces[upper] + 8]))

    every = np.arange(12)
    assert steps(every).surface.is_closed
    assert (steps(every).surface.neighbors == -2).any()
    assert not steps(every[:-1]).surface.is_closed
    assert not turned_over(steps(every)).surface.is_closed


def test_faces_that_wind_against_their_neighbors_are_turned_over_with_their_uvs():
    some = np.random.default_rng(8).random(bowl().face_count) < 0.3
    for mesh in (bowl(), turned_over(bowl())):
        surface, expected = turned_over(mesh, some).surface, mesh.surface
        assert expected.faces is mesh.faces
        np.testing.assert_array_equal(surface.faces, mesh.faces)
        np.testing.assert_array_equal(surface.uv_faces, mesh.uv_faces)
        np.testing.assert_array_equal(surface.neighbors, expected.neighbors)
    normals = vertex_normals(wp.array(bowl().positions[None], dtype=wp.vec3), wp.array(surface.faces, dtype=wp.vec3i))
    assert np.isfinite(normals.numpy()).all()


def test_a_strip_with_one_side_stays_as_it_is():
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    half_width = np.stack([np.cos(angle / 2) * np.cos(angle), np.sin(angle / 2), np.cos(angle / 2) * np.sin(angle)], -1)
    middle = 3 * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], -1)
    positions = np.concatenate([middle - half_width, middle + half_width])
    low, high = np.arange(24), np.arange(24) + 24
    next_low, next_high = np.append(low[1:], high[0]), np.append(high[1:], low[0])
    faces = np.concatenate([np.stack([low, next_low, high], -1), np.stack([next_low, next_high, high], -1)])
    surface = ws.Mesh(positions, faces).surface
    np.testing.assert_array_equal(surface.faces, faces)
    assert not surface.is_closed


@pytest.mark.parametrize("is_reversed", [False, True])
@pytest.mark.parametrize("has_own_vertices", [False, True])
@pytest.mark.parametrize("chosen", [slice(None), slice(3, 4)])
def test_of_faces_that_are_listed_twice_the_first_is_kept(chosen, is_reversed, has_own_vertices):
    """As exports have them that are "double-sided": normals of copies would cancel, and rays meet both."""
    once, copies = bowl(), turned_over(bowl()) if is_reversed else bowl()
    points = [once.positions, once.positions] if has_own_vertices else [once.positions]
    faces = [once.faces, copies.faces[chosen] + (once.vertex_count if has_own_vertices else 0)]
    uv_faces = [once.uv_faces, copies.uv_faces[chosen]]
    with pytest.warns(UserWarning, match=f"^mesh: {len(faces[1])} duplicate faces dropped$"):
        twice = ws.Mesh(*map(np.concatenate, (points, faces)), once.uvs, np.concatenate(uv_faces))
    np.testing.assert_array_equal(twice.faces, once.faces)
    np.testing.assert_array_equal(twice.uv_faces, once.uv_faces)
    assert twice.vertex_count == len(points) * once.vertex_count
    np.testing.assert_array_equal(twice.surface.neighbors, once.surface.neighbors)


def test_a_mesh_is_closed_only_if_each_of_its_pieces_looks_outward():
    large, small = ws.icosphere(0.6, 2), ws.icosphere(0.3, 2).transformed(translation=np.array([1.2, 0, 0]))

    def both(first: ws.Mesh, second: ws.Mesh) -> ws.Mesh:
        count = len(first.positions)
        return ws.Mesh(
            np.concatenate([first.positions, second.positions]), np.concatenate([first.faces, second.faces + count])
        )

    assert both(large, small).surface.is_closed
    for pieces in ((large, turned_over(small)), (turned_over(large), small)):
        mesh = both(*pieces)
        assert not mesh.surface.is_closed
        scenes = [
            ws.Scene([ws.Body(each, blockers=0) for each in meshes], SKY, ABOVE, ws.Visibility("none"))
            for meshes in ([mesh], [large, small])
        ]
        images = [ws.render(scene) for scene in scenes]
        assert np.abs(images[0] - images[1]).max() < FLOAT32 * images[1].max()
