"""Self-shadows in images: which bodies have them, how near they are to rays, and their gradients."""

import dataclasses

import numpy as np
import pytest
import torch
import trimesh
import warp as wp

import warpshadow as ws
from warpshadow.assets.cache import cache_path, cached_files, load_or_compute
from warpshadow.device import progress
from warpshadow.pipeline.bodies import self_visibility
from warpshadow.pipeline.bodies.geometry import Geometry
from warpshadow.pipeline.renderer import SceneRenderer
from warpshadow.pipeline.views import receiver_finder
from warpshadow.stages.geometry.poses import Poses
from warpshadow.stages.self_visibility import trace
from warpshadow.torch import TorchRenderer, rotation_matrices

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

# Differences of shading in float32, at a step where its curvature does not show; 3e-5 of a sum is rounding.
GRADIENT = 0.01
ROUNDING = 3e-5
STEP = 2.5e-4
# Share of receivers that may have a kink within a step: a cell sinks below their horizon, or they go over an edge.
KINKED = 0.02


@pytest.fixture(scope="module", autouse=True)
def empty_cache(tmp_path_factory):
    """Nothing is known from before."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path_factory.mktemp("cache")))
        yield


def cup() -> ws.Mesh:
    """A ball with a deep dent, which darkens itself; its top is open where the dent meets the outside."""
    ball = ws.icosphere(1.0, 3)
    points = ball.positions.astype(np.float64)
    radius = np.linalg.norm(points[:, [0, 2]], axis=1)
    points[:, 1] = np.where(points[:, 1] > 0, points[:, 1] - 1.5 * np.clip(1 - (radius / 0.7) ** 2, 0, 1), points[:, 1])
    return ws.Mesh(points, ball.faces)


def scene_of(receivers="vertex", *, light=None, bodies=(), **visibility) -> ws.Scene:
    light = ws.synthetic_sky((-0.6, 0.6, 0.3), height=32, sun_radius=8) if light is None else light
    body = ws.Body(cup(), blockers=12, rotation=(30, 20, -50), receivers=receivers)
    camera = ws.Camera.look_at((1.0, 2.5, 3.5), (0, 0, 0), size=(32, 32))
    settings = {"directions": 64} | visibility
    return ws.Scene((body, *bodies), light, camera, ws.Visibility.of({"method": "directional"} | settings), 1)


def error_of(scene: ws.Scene) -> float:
    truth = ws.render(dataclasses.replace(scene, visibility=ws.Visibility(method="ray-traced", samples=512)))
    image, covered = ws.render(scene), truth[..., 3] == 1
    return np.linalg.norm((image - truth)[covered]) / np.linalg.norm(truth[covered])


def pierced() -> ws.Mesh:
    """A ball, and a coarse spindle through it whose middle is buried in the ball."""
    ball, spindle = ws.icosphere(0.7, 3), ws.icosphere(1.0, 2)
    points = np.concatenate([ball.positions, spindle.positions * (1.6, 0.4, 0.4)])
    return ws.Mesh(points, np.concatenate([ball.faces, spindle.faces + len(ball.positions)]))


def solids() -> ws.Mesh:
    """A wall on a slab, each a box."""
    boxes = [
        trimesh.creation.box(size).apply_translation(at)
        for size, at in (((2, 0.2, 1.6), (0, -0.3, 0)), ((0.3, 1.4, 1.2), (0.4, 0.4, 0)))
    ]
    whole = trimesh.util.concatenate([box.subdivide().subdivide() for box in boxes])
    return ws.Mesh(whole.vertices, whole.faces).creased()


def turned(renderer: SceneRenderer, angles, requires_grad=False) -> Poses:
    """The scene's poses, each body turned on by angles about the axes of the world."""
    poses = renderer.scene_poses()
    x, y, z = angles
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrices = (np.eye(3) + skew + skew @ skew / 2) @ poses.rotations.numpy()
    rotations = wp.array(matrices, dtype=wp.mat33, device=renderer.device, requires_grad=requires_grad)
    return Poses(rotations, poses.translations, poses.scales)


@pytest.mark.parametrize("receivers", ["vertex", "pixel"])
def test_images_are_nearer_to_rays_than_with_spheres(receivers):
    """At vertices a sun's edge is interpolated, and no nearer to rays with 256 directions; by pixel it is looked up."""
    errors = [error_of(scene_of(receivers, self_shadows=how, directions=128)) for how in ("traced", "spheres")]
    ratio, largest = (0.75, 0.06) if receivers == "vertex" else (0.25, 0.016)
    assert errors[0] < ratio * errors[1] and errors[0] < largest


def test_a_suns_shadow_is_as_rays_have_it_where_pixels_send_them():
    light = ws.synthetic_sky((0.3, 1, -0.5), height=128, sun_radius=2)
    scenes = [scene_of("pixel", light=light, self_shadows=how, directions=128) for how in ("traced", "rays")]
    truth = ws.render(dataclasses.replace(scenes[0], visibility=ws.Visibility(method="ray-traced", samples=512)))
    covered = truth[..., 3] == 1
    errors = [np.linalg.norm((SceneRenderer(scene).render() - truth)[covered]) for scene in scenes]
    assert errors[1] < 0.6 * errors[0]
    np.testing.assert_array_equal(ws.render(scenes[0]), SceneRenderer(scenes[1]).render())  # stills are so


def test_gradients_of_rotations_are_refused_where_pixels_send_rays():
    light = ws.synthetic_sky((-0.6, 0.6, 0.3), height=64, sun_radius=2)
    renderer = SceneRenderer(scene_of("pixel", light=light, self_shadows="rays", directions=128))
    with wp.Tape():
        poses = turned(renderer, (0, 0, 0), True)
        with pytest.raises(ValueError, match='self_shadows: got "rays" where a pose or a camera has a gradient'):
            renderer.shade(view=renderer.view(renderer.placed(poses)))


@pytest.mark.parametrize("receivers", ["vertex", "pixel"])
def test_a_rail_between_posts_is_not_black(receivers):
    """Its vertices lie in the posts: it has probes between them, which lend what they see."""
    ends, corners = np.array([-1.0, 1.0]), np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * 0.06
    rail = np.concatenate([np.insert(corners, 0, end, axis=1) for end in ends])
    sides = [(k, (k + 1) % 4, k + 4) for k in range(4)] + [((k + 1) % 4, (k + 1) % 4 + 4, k + 4) for k in range(4)]
    faces = np.array([*sides, (0, 2, 1), (0, 3, 2), (4, 5, 6), (4, 6, 7)])
    posts = [ws.icosphere(0.3, 3).positions + (end, 0, 0) for end in ends]
    count = len(posts[0])
    all_faces = [faces, *(ws.icosphere(0.3, 3).faces + 8 + k * count for k in range(2))]
    mesh = ws.Mesh(np.concatenate([rail, *posts]), np.concatenate(all_faces))
    scene = dataclasses.replace(scene_of(receivers), bodies=(ws.Body(mesh, blockers=1, receivers=receivers),))
    image, truth = (
        SceneRenderer(each).render()
        for each in (scene, dataclasses.replace(scene, visibility=ws.Visibility(method="ray-traced", samples=256)))
    )
    rail = (slice(14, 18), slice(13, 19))
    assert truth[rail][..., 3].max() == 1
    # at its vertices it has the light of its ends, which posts hide from the sun: a sharper sun, a darker end
    assert abs(image[rail].mean() / truth[rail].mean() - 1) < (0.4 if receivers == "vertex" else 0.02)


@pytest.mark.parametrize("receivers", ["vertex", "pixel"])
def test_what_is_buried_in_another_part_darkens_nothing(receivers):
    scene = scene_of(receivers)
    body = dataclasses.replace(scene.bodies[0], mesh=pierced(), blockers=1)
    assert error_of(dataclasses.replace(scene, bodies=(body,))) < 0.035  # 0.07 and 0.05 with buried probes as they are


@pytest.mark.parametrize("order", [4, 8])
def test_images_in_harmonics_are_nearer_to_rays_than_with_spheres(order):
    light = ws.synthetic_sky((-0.6, 0.6, 0.3), height=32, sun_radius=40)
    scenes = [scene_of(light=light, method="log-sh", order=order, self_shadows=how) for how in ("traced", "spheres")]
    errors = [error_of(scene) for scene in scenes]
    assert errors[0] < 0.75 * errors[1]


@pytest.mark.parametrize(
    ("method", "mesh"),
    [("directional", None), ("log-sh", None), ("directional", solids())],
    ids=["directional", "log-sh", "solids"],
)
@pytest.mark.parametrize("receivers", ["vertex", "pixel"])
def test_gradients_to_rotations_are_central_differences(receivers, method, mesh, device, monkeypatch):
    """Of weighted shading, through vertices, normals, places in faces, and lookups, turned lobes or parts.

    All receivers move with their samples here: in images those along outlines have the mean slopes of colors instead.
    """
    monkeypatch.setattr(receiver_finder, "find_outline_samples", lambda *_: None)
    other = ws.Body(ws.icosphere(0.6, 2), blockers=ws.Spheres([[0, 0, 0]], [0.6]), translation=(-1.4, 0.3, 0))
    bodies = (other,) if method == "log-sh" else ()
    scene = scene_of(receivers, method=method, order=4, bodies=bodies)
    if mesh is not None:
        scene = dataclasses.replace(scene, bodies=(dataclasses.replace(scene.bodies[0], mesh=mesh, blockers="auto"),))
    renderer = SceneRenderer(scene, device=device)
    rng = np.random.default_rng(3)

    def shading_of(poses):
        return renderer.shade(view=renderer.view(renderer.placed(poses)))

    with wp.Tape() as tape:
        poses = turned(renderer, (0, 0, 0), True)
        shading = shading_of(poses)
    middle = shading.numpy().astype(float)
    weights = rng.normal(1, size=middle.shape)

    def differences(axis):
        ends = [shading_of(turned(renderer, sign * STEP * axis)).numpy().astype(float) for sign in (1, -1)]
        if ends[0].shape != middle.shape or ends[1].shape != middle.shape:
            pytest.fail("the step is so large that another part is seen")
        return ends

    axis = max(np.eye(3), key=lambda each: abs((weights * np.subtract(*differences(each))).sum()))
    above, below = differences(axis)
    kinks = np.abs(above - 2 * middle + below).max(axis=2)[0]
    weights[:, np.argsort(-kinks)[: round(KINKED * len(kinks))]] = 0
    tape.backward(grads={shading: wp.array(weights, dtype=wp.vec3, device=device)})
    turns = (turned(renderer, sign * STEP * axis).rotations.numpy().astype(float) for sign in (1, -1))
    slope = (poses.rotations.grad.numpy() * np.subtract(*turns)).sum()
    change = (weights * (above - below)).sum()
    assert abs(change) > 100 * ROUNDING
    assert abs(slope - change) < GRADIENT * abs(change)


def test_without_own_rows_all_is_as_spheres_have_it_in_one_group():
    scene = scene_of(self_shadows="spheres")
    renderer = SceneRenderer(scene)
    assert renderer.view().receivers.spans == ()
    bodies = [dataclasses.replace(body, self_shadows="spheres") for body in scene.bodies]
    each = dataclasses.replace(scene, bodies=bodies, visibility=ws.Visibility(directions=64))
    np.testing.assert_array_equal(ws.render(each), renderer.render())


def test_a_body_whose_shape_is_free_is_shadowed_by_its_spheres():
    renderer = SceneRenderer(scene_of())
    positions = wp.clone(renderer.rest().positions)
    geometry = renderer.placed(rest=renderer.deformed(0, positions))
    assert geometry.deformed == (0,)
    image = renderer.draw(view=renderer.view(geometry)).numpy()[0]
    np.testing.assert_array_equal(image, ws.render(scene_of(self_shadows="spheres")))
    assert "its shape is free" in renderer.explain(geometry=geometry)["self-shadows"].forward.why


def test_a_geometry_without_rotations_is_shadowed_by_spheres_and_explained():
    renderer = SceneRenderer(scene_of())
    plain = Geometry(*renderer.geometry().arrays().values())
    image = renderer.draw(view=renderer.view(plain)).numpy()[0]
    np.testing.assert_array_equal(image, ws.render(scene_of(self_shadows="spheres")))
    assert "geometry has no rotations" in renderer.explain(geometry=plain)["self-shadows"].forward.why


def test_bodies_that_are_flat_or_cast_no_shadow_are_not_traced(monkeypatch):
    monkeypatch.setattr(self_visibility, "trace_rows", None)
    floor, ball = ws.Body(ws.plane(4.0, 8), translation=(0, -1, 0)), ws.Body(ws.icosphere(0.5, 2), blockers=0)
    scene = dataclasses.replace(scene_of(), bodies=(floor, ball))
    ws.render(scene)


def test_rows_are_traced_once_and_kept_on_disk(monkeypatch):
    scene = scene_of()
    renderer = SceneRenderer(scene)
    first = renderer.render()
    assert "traced once, cached" in renderer.explain(ws.EnvironmentMap.constant())["self-shadows"].items
    monkeypatch.setattr(self_visibility, "trace_rows", None)
    moved = dataclasses.replace(scene.bodies[0], translation=(0.1, 0, 0), scale=0.5)
    ws.render(dataclasses.replace(scene, bodies=(moved,)))
    np.testing.assert_array_equal(SceneRenderer(scene).render(), first)


@pytest.mark.parametrize("method", ["directional", "log-sh"])
def test_a_batch_of_poses_is_poses_one_by_one(method, device):
    renderer = SceneRenderer(scene_of(method=method, order=4), device=device)
    angles = [(0, 0, 0), (0.3, -0.2, 0.1)]
    poses = [turned(renderer, each) for each in angles]
    both = Poses(
        *(
            wp.array(np.concatenate([getattr(each, name).numpy() for each in poses]), dtype=dtype, device=device)
            for name, dtype in (("rotations", wp.mat33), ("translations", wp.vec3), ("scales", wp.float32))
        )
    )
    images = renderer.draw(view=renderer.view(renderer.placed(both))).numpy()
    for pose, image in zip(poses, images, strict=True):
        alone = renderer.draw(view=renderer.view(renderer.placed(pose))).numpy()[0]
        np.testing.assert_allclose(image, alone, atol=1e-5)


def test_bodies_that_move_among_static_ones_have_self_shadows():
    other = ws.Body(ws.icosphere(0.6, 2), blockers=ws.Spheres([[0, 0, 0]], [0.6]), translation=(-1.4, 0.3, 0))
    renderer = SceneRenderer(scene_of(bodies=(other,)))
    geometry = renderer.placed(turned(renderer, (0.1, 0, 0)), moving=[0])
    assert geometry.rotations is not None
    explanation = renderer.explain(geometry=geometry)
    assert explanation["self-shadows"] and explanation["static shadows"]
    whole = renderer.placed(turned(renderer, (0.1, 0, 0)))
    images = [renderer.draw(view=renderer.view(each)).numpy() for each in (geometry, whole)]
    assert np.abs(images[0] - images[1])[0, :, 16:].max() < 0.05


@pytest.mark.parametrize("moving", [0, 1])
def test_static_bodies_keep_their_lobes(moving):
    other = ws.Body(ws.icosphere(0.6, 2), blockers=ws.Spheres([[0, 0, 0]], [0.6]), translation=(-1.4, 0.3, 0))
    renderer = SceneRenderer(scene_of(bodies=(other,), method="log-sh", order=4))
    poses = renderer.scene_poses()
    geometries = renderer.placed(poses, moving=[moving]), renderer.placed(poses)
    images = [renderer.draw(view=renderer.view(each)).numpy() for each in geometries]
    np.testing.assert_allclose(*images, atol=1e-4)


def test_a_mesh_of_too_many_vertices_has_fewer_rays_and_says_so(monkeypatch):
    monkeypatch.setattr(trace, "MAX_MEMORY", 2**18)
    with pytest.warns(UserWarning, match=r"642 points have 1024 rays each for the body's shadow on itself"):
        error = error_of(scene_of())
    assert error < 0.08


def test_torch_carries_rotations_and_what_is_deformed():
    scene = scene_of()
    renderer = TorchRenderer(scene)
    angles = torch.zeros(1, 3, requires_grad=True)
    rotations, translations, scales = renderer.scene_poses()
    geometry = renderer.placed(rotation_matrices(angles) @ rotations, translations, scales)
    assert geometry.rotations.requires_grad and geometry.rotations.shape == (1, 3, 3)
    image = renderer(geometry=geometry)
    np.testing.assert_allclose(image.detach().numpy(), SceneRenderer(scene).render(), atol=1e-4)
    image.square().sum().backward()
    assert torch.isfinite(angles.grad).all() and angles.grad.any()
    rest = renderer.deformed(0, torch.tensor(scene.bodies[0].mesh.positions))
    assert renderer.placed(rotations, translations, scales, rest=rest).deformed == (0,)


# ------------------------------------------------------------------------------------------------- interrupts


def test_what_was_traced_at_an_interrupt_is_not_traced_again(tmp_path, monkeypatch):
    monkeypatch.setattr(trace, "_BLOCK_RAYS", 2**18)  # 64 points a block, of 642
    blocks, launch = [], trace.launch

    def counting(kernel, dim, **options):
        if kernel.key.startswith("trace_row"):
            blocks.append(dim)
        launch(kernel, dim, **options)

    class Interrupting(progress.Wait):
        def update(self, count=1):
            super().update(count)
            if self.done == 192:
                raise KeyboardInterrupt

    def rows() -> list[np.ndarray]:
        renderer = SceneRenderer(scene_of())  # a mesh of its own: nothing is in memory
        return [array.numpy() for array in renderer._method.scene_blockers.self_visibility.rows(0)]

    monkeypatch.setattr(trace, "launch", counting)
    monkeypatch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path / "whole"))
    whole, all_blocks = rows(), blocks[:]
    monkeypatch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path / "interrupted"))
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt, match="^192 of 642 points of the self-"):
        patch.setattr(progress, "Wait", Interrupting)
        rows()
    (part,) = cached_files("self_shadows")
    assert part.name.endswith(".part.npz")
    blocks.clear()
    for array, other in zip(rows(), whole, strict=True):
        np.testing.assert_array_equal(array, other)
    assert blocks == all_blocks[3:]
    (cached,) = cached_files("self_shadows")
    assert cached.name == part.name.replace(".part", "")
    blocks.clear()
    rows()
    assert not blocks


@pytest.mark.parametrize("receivers", ["vertex", "pixel"])
def test_backs_of_an_open_body_are_traced_once_they_are_seen(tmp_path, monkeypatch, receivers):
    shell = cup()
    open_below = ws.Mesh(shell.positions, shell.faces[shell.positions[shell.faces, 1].mean(axis=1) > -0.7])

    def images(cache: str, *, are_read: bool) -> tuple[list[np.ndarray], list[tuple[int, bool]]]:
        """Images, and after each how many files there are and whether it looked for backs."""
        looks = []
        monkeypatch.setattr(self_visibility, "is_readable", lambda device: looks.append(device) or are_read)
        monkeypatch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path / cache))
        mesh = ws.Mesh(open_below.positions, open_below.faces)  # nothing of it is in memory
        scene = scene_of(receivers)
        renderer = SceneRenderer(dataclasses.replace(scene, bodies=(ws.Body(mesh, blockers=12, receivers=receivers),)))
        found, counts = [], []
        poses = renderer.scene_poses()
        for half_turn in (np.eye(3), np.diag([1.0, -1.0, -1.0]), np.eye(3)):
            rotations = wp.array(half_turn @ poses.rotations.numpy(), dtype=wp.mat33)
            geometry = renderer.placed(Poses(rotations, poses.translations, poses.scales))
            found.append(renderer.draw(view=renderer.view(geometry)).numpy())
            counts.append((len(cached_files("self_shadows")), bool(looks)))
            looks.clear()
        return found, counts

    some, counts = images("once seen", are_read=True)
    assert counts == [(1, True), (2, True), (2, False)]
    all_of_them, counts = images("at once", are_read=False)
    assert counts == [(2, True), (2, False), (2, False)]
    np.testing.assert_array_equal(some, all_of_them)
    assert np.abs(some[0] - some[1]).max() > 0.1


def test_a_damaged_file_of_an_interrupt_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path))
    path = cache_path("self_shadows", "0" * 64)
    path.parent.mkdir()
    path.with_suffix(".part.npz").write_bytes(b"PK damaged")
    found = load_or_compute(path, dict, lambda unfinished: dict(unfinished.before), lambda made: made, noun="thing")
    assert found == {} and cached_files("self_shadows") == [path]


def test_rows_that_take_long_to_trace_are_announced_with_the_way_around_them(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(progress, "ANNOUNCED_SECONDS", 1.0)
    monkeypatch.setattr(self_visibility, "trace_seconds", lambda rays, faces, are_backs: rays / 4096)
    monkeypatch.setenv("WARPSHADOW_NUM_THREADS", "2")
    SceneRenderer(scene_of(), progress=True).render()
    said = capsys.readouterr().err
    assert said.startswith("tracing the shadow of a body on itself, from 642 points, takes about 5 min, once; self_sh")
    assert said.count("\n") == 1
    SceneRenderer(scene_of(), progress=True).render()  # reads them
    monkeypatch.setenv("WARPSHADOW_CACHE_DIR", str(tmp_path / "empty"))
    SceneRenderer(scene_of(), progress=False).render()
    assert not capsys.readouterr().err
