"""Light that bounces along paths: against series, balances and a float64 twin."""

import numpy as np
import pytest
import twins
import warp as wp

import warpshadow as ws
from warpshadow.assets.mesh import Mesh
from warpshadow.assets.primitives import icosphere, plane
from warpshadow.stages.light.light_samples import sample_map
from warpshadow.stages.ray_traced import path_tracing
from warpshadow.stages.ray_traced.path_tracing import PathSurfaces, trace_bounces
from warpshadow.stages.textures.pyramid import mip_pyramids

SEED = 3

NOISE = 0.02
"""Of the mean over some receivers of a thousand paths each, of which few meet light; measured up to 0.7%."""


def vectors(values, device) -> wp.array:
    return wp.array(np.asarray(values, np.float32), dtype=wp.vec3, device=device)


def make_surfaces(
    mesh: Mesh, colors, device, *, casting: Mesh | None = None, texture=None, textured=()
) -> PathSurfaces:
    """A mesh with colors [3] or [vertex, 3]; a texture, repeated by uvs, in place of them on some faces."""

    def hierarchy(each: Mesh) -> wp.Mesh:
        return wp.Mesh(vectors(each.positions, device), wp.array(each.faces.ravel(), dtype=wp.int32, device=device))

    a, b, c = np.moveaxis(mesh.positions[mesh.faces].astype(np.float64), 1, 0)
    normals = np.zeros((mesh.vertex_count, 3))
    np.add.at(normals, mesh.faces.ravel(), np.cross(b - a, c - a).repeat(3, axis=0))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    faces = wp.array(mesh.faces, dtype=wp.vec3i, device=device)
    of_face = np.full(len(mesh.faces), -1)
    of_face[list(textured)] = 0
    uvs = np.zeros((1, 2)) if mesh.uvs is None else mesh.uvs
    return PathSurfaces(
        hierarchy(mesh),
        hierarchy(mesh if casting is None else casting),
        faces,
        vectors(normals, device),
        vectors(np.broadcast_to(colors, mesh.positions.shape), device),
        None if texture is None else mip_pyramids([vectors(texture[None], device)]),
        wp.array(of_face, dtype=wp.int32, device=device),
        wp.array(uvs, dtype=wp.vec2, device=device),
        wp.array(np.zeros_like(mesh.faces) if mesh.uvs is None else mesh.uv_faces, dtype=wp.vec3i, device=device),
    )


def bounced(surfaces: PathSurfaces, points, normals, radiance, *, bounces: int, paths: int = 1024) -> np.ndarray:
    device = surfaces.faces.device
    places = vectors(points, device), vectors(normals, device)
    samples = sample_map(np.asarray(radiance, np.float32), 1024)
    return trace_bounces(surfaces, *places, samples, bounces=bounces, paths=paths).numpy()


UNIFORM = np.ones((16, 32, 3))


@pytest.mark.parametrize("albedo", [0.3, 0.9])
def test_light_in_a_ball_with_a_hole_is_the_geometric_series(albedo, device, poisoned_outputs):
    """From any point of a ball each part of it looks as large as it is.

    So with f the part of the hole, light of the uniform sky through it is S = f everywhere, and each bounce brings
    a (1 - f) of the one before: I = f Σ_k (a (1 − f))^k. The ball is open, and seen from behind.
    """
    ball = icosphere(1.0, 5)
    centers = ball.positions[ball.faces].mean(axis=1)
    faces = ball.faces[centers[:, 1] < 0.6]
    surfaces = make_surfaces(Mesh(ball.positions, faces), albedo, device)
    corners = ball.positions[ball.faces].astype(np.float64)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    hole = 1 - areas[centers[:, 1] < 0.6].sum() / areas.sum()
    assert 0.19 < hole < 0.21

    chosen = np.random.default_rng(SEED).choice(len(faces), 100, replace=False)
    points = ball.positions[faces[chosen]].mean(axis=1)
    normals = -points / np.linalg.norm(points, axis=1, keepdims=True)
    for bounces in (1, 4):
        light = bounced(surfaces, points, normals, UNIFORM, bounces=bounces)
        expected = hole * ((albedo * (1 - hole)) ** np.arange(1, bounces + 1)).sum()
        assert np.abs(light.mean(axis=0) / expected - 1).max() < NOISE
        assert np.abs(light / expected - 1).max() < 25 * NOISE  # of one receiver


def test_a_white_furnace_sends_out_what_it_gets(device):
    """Under a uniform sky of 1 all light in a white cavity is 1 in the end, wherever it is: S + I = 1."""
    ball = icosphere(1.0, 5)
    faces = ball.faces[ball.positions[ball.faces].mean(axis=1)[:, 1] < 0.0]
    surfaces = make_surfaces(Mesh(ball.positions, faces), 1.0, device)
    points = ball.positions[faces[:: len(faces) // 40]].mean(axis=1)
    normals = -points / np.linalg.norm(points, axis=1, keepdims=True)
    light = bounced(surfaces, points, normals, UNIFORM, bounces=16, paths=2048)
    assert np.abs(0.5 + light.mean(axis=0) - 1).max() < NOISE  # half a sphere is hole: S = 1/2; 2^-17 is on its way


def test_nothing_bounces_from_black_bodies_or_in_the_dark(device):
    ball = icosphere(1.0, 3)
    points, normals = ball.positions[:50], -ball.positions[:50]
    faces = ball.faces[ball.positions[ball.faces].mean(axis=1)[:, 1] < 0.5]
    lit = bounced(
        make_surfaces(Mesh(ball.positions, faces), 0.5, device), points, normals, UNIFORM, bounces=3, paths=64
    )
    assert lit.min() > 0
    black = make_surfaces(Mesh(ball.positions, faces), 0.0, device)
    assert not bounced(black, points, normals, UNIFORM, bounces=3, paths=64).any()
    closed = make_surfaces(ball, 0.5, device)
    assert not bounced(closed, 0.999 * points, normals, UNIFORM, bounces=3, paths=64).any()


# ---------------------------------------------------------------------------------------------- bright faces


def joined(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(mesh.vertex_count for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(np.concatenate([mesh.positions for mesh in meshes]), np.concatenate(faces))


def test_light_of_a_small_bright_face_is_right_on_average_and_varies_less(device, monkeypatch):
    """A square over receivers, lit from below, and black ones beside it, which rays meet more often."""
    square = plane(2.0, 1).transformed(rotation=np.diag([1.0, -1, -1]), translation=[0, 8.0, 0])
    black = plane(100.0, 1).transformed(rotation=np.diag([1.0, -1, -1]), translation=[0, 20.0, 0])
    colors = np.repeat([0.5, 0.0], [square.vertex_count, black.vertex_count])[:, None] * np.ones(3)
    surfaces = make_surfaces(joined(square, black), colors, device)
    below = np.repeat([0.0, 1.0], 8)[:, None, None] * np.ones((32, 3))
    receivers = np.zeros((512, 3)), np.tile([0.0, 1, 0], (512, 1))
    light = bounced(surfaces, *receivers, below, bounces=1, paths=256)
    noise = light.std() / np.sqrt(512)
    assert light.mean() == pytest.approx(0.5 * twins.form_factor_of_square(8.0), abs=4 * noise + 1e-4)
    monkeypatch.setattr(path_tracing, "_MIN_BRIGHT_SHARE", 2)
    assert light.std() < 0.4 * bounced(surfaces, *receivers, below, bounces=1, paths=256).std()


@pytest.mark.parametrize("bounces", [1, 4])
def test_light_of_a_bright_spot_in_a_ball_is_the_geometric_series(bounces, device, monkeypatch):
    """The sun shines through the hole of a ball onto its floor: each bounce brings a (1 − f) of the one before."""
    ball, ground = icosphere(1.0, 4), plane(40.0, 1).transformed(translation=[0, -5.0, 0])
    corners = ball.positions[ball.faces].astype(np.float64)
    area_vectors = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    areas, is_hole = np.linalg.norm(area_vectors, axis=1), corners.mean(axis=1)[:, 1] > 0.7
    holed = Mesh(ball.positions, ball.faces[~is_hole])
    colors = np.repeat([0.8, 0.0], [ball.vertex_count, ground.vertex_count])[:, None] * np.ones(3)
    surfaces = make_surfaces(joined(holed, ground), colors, device)
    sun = np.zeros((64, 128, 3))
    sun[0] = 1000.0
    flux = 1000 * 2 * (1 - np.cos(np.pi / 64)) * area_vectors[is_hole, 1].sum()  # over π
    chosen = np.random.default_rng(SEED).choice(len(holed.faces), 200, replace=False)
    points = holed.positions[holed.faces[chosen]].mean(axis=1)
    normals = -points / np.linalg.norm(points, axis=1, keepdims=True)
    light = bounced(surfaces, points, normals, sun, bounces=bounces)
    kept = 0.8 * (1 - areas[is_hole].sum() / areas.sum())
    expected = 0.8 * flux / areas.sum() * (kept ** np.arange(bounces)).sum()
    assert np.abs(light.mean(axis=0) / expected - 1).max() < NOISE
    monkeypatch.setattr(path_tracing, "_MIN_BRIGHT_SHARE", 2)
    assert not np.array_equal(light, bounced(surfaces, points, normals, sun, bounces=bounces))


# ---------------------------------------------------------------------------------------------- against a twin


def room() -> tuple[Mesh, np.ndarray, np.ndarray, list[int]]:
    """A ground with a texture and two leaning walls, one of many colors: mesh, colors, texture, textured faces."""
    ground = plane(4.0, 1)
    walls = [
        plane(2.0, 1).transformed(
            rotation=np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]), translation=[-1.0, 0.7, 0.1]
        ),
        plane(2.0, 1).transformed(
            rotation=np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]]), translation=[1, 1.2, 0]
        ),
    ]
    meshes = [ground, *walls]
    starts = np.cumsum([0, *(mesh.vertex_count for mesh in meshes)])
    mesh = Mesh(
        np.concatenate([each.positions for each in meshes]),
        np.concatenate([each.faces + start for each, start in zip(meshes, starts, strict=False)]),
        np.concatenate([each.uvs for each in meshes]),
        np.concatenate([each.uv_faces + start for each, start in zip(meshes, starts, strict=False)]),
    )
    rng = np.random.default_rng(SEED)
    return mesh, rng.uniform(size=(mesh.vertex_count, 3)), rng.uniform(size=(3, 5, 3)), [0, 1]


class Twin:
    """A path tracer in NumPy and float64: every ray meets every face. It integrates over the sky at each hit."""

    def __init__(self, mesh: Mesh, colors: np.ndarray, texture: np.ndarray, textured: list[int], radiance: np.ndarray):
        self.mesh, self.colors, self.texture, self.textured = mesh, colors, texture, textured
        self.corners = mesh.positions[mesh.faces].astype(np.float64)
        rows, columns = (np.indices(radiance.shape[:2]) + 0.5).reshape(2, -1)
        theta, phi = np.pi * rows / len(radiance), np.pi * columns / len(radiance)
        sine = np.sin(theta)
        self.sky = np.stack([np.sin(phi) * sine, np.cos(theta), -np.cos(phi) * sine], axis=1)
        self.radiance = radiance.reshape(-1, 3) * (np.pi / len(radiance)) ** 2 * sine[:, None]

    def meet(self, points: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nearest face of each ray, -1 for none, and barycentrics."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        normals = np.cross(b - a, c - a)
        slope = directions @ normals.T
        t = ((a * normals).sum(axis=1) - points @ normals.T) / np.where(slope == 0, 1e-30, slope)
        reached = points[:, None] + t[..., None] * directions[:, None]
        size = (normals**2).sum(axis=1)
        v = (np.cross(reached - a, c - a) * normals).sum(axis=-1) / size
        w = (np.cross(b - a, reached - a) * normals).sum(axis=-1) / size
        t = np.where((t > 1e-9) & (v >= 0) & (w >= 0) & (v + w <= 1), t, np.inf)
        face = t.argmin(axis=1)
        each = np.arange(len(points))
        weights = np.stack([1 - v - w, v, w], axis=-1)[each, face]
        return np.where(np.isinf(t[each, face]), -1, face), weights

    def albedo(self, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
        colors = np.einsum("rk,rkc->rc", weights, self.colors[self.mesh.faces[face]])
        uv = np.einsum("rk,rkc->rc", weights, self.mesh.uvs[self.mesh.uv_faces[face]].astype(np.float64))
        height, width, _ = self.texture.shape
        x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
        left, top = np.floor(x).astype(int), np.floor(y).astype(int)
        s, t = (x - left)[:, None], (y - top)[:, None]
        texels = [self.texture[(top + i) % height, (left + j) % width] for i in (0, 1) for j in (0, 1)]
        mixed = (1 - t) * ((1 - s) * texels[0] + s * texels[1]) + t * ((1 - s) * texels[2] + s * texels[3])
        return np.where(np.isin(face, self.textured)[:, None], mixed, colors)

    def direct(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        total = np.zeros_like(points)
        for direction, radiance in zip(self.sky, self.radiance, strict=True):
            face, _ = self.meet(points, np.tile(direction, (len(points), 1)))
            total += np.where(face < 0, np.maximum(normals @ direction, 0), 0)[:, None] * radiance / np.pi
        return total

    def bounced(self, point: np.ndarray, normal: np.ndarray, bounces: int, count: int) -> np.ndarray:
        """Of one receiver: its first directions are even over the hemisphere, those at hits are drawn."""
        rng = np.random.default_rng(SEED)
        points, normals, total = np.tile(point, (count, 1)), np.tile(normal, (count, 1)), np.zeros(3)
        reflected = np.ones((count, 3))
        for bounce in range(bounces):
            u, v = rng.random((2, len(points)))
            if not bounce:
                u, v = (np.arange(count) + 0.5) / count, (np.arange(count) * 0.6180339887498949) % 1
            tangent = np.cross(normals, np.where(np.abs(normals[:, :1]) < 0.5, [1.0, 0, 0], [0, 1.0, 0]))
            tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
            directions = (
                np.sqrt(u)[:, None] * np.cos(2 * np.pi * v)[:, None] * tangent
                + np.sqrt(u)[:, None] * np.sin(2 * np.pi * v)[:, None] * np.cross(normals, tangent)
                + np.sqrt(1 - u)[:, None] * normals
            )
            face, weights = self.meet(points, directions)
            met = face >= 0
            face, weights, directions = face[met], weights[met], directions[met]
            points = np.einsum("rk,rkc->rc", weights, self.corners[face])
            face_normals = np.cross(self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0])[
                face
            ]
            normals = face_normals / np.linalg.norm(face_normals, axis=1, keepdims=True)
            normals *= -np.sign((normals * directions).sum(axis=1, keepdims=True))
            reflected = reflected[met] * self.albedo(face, weights)
            total += (reflected * self.direct(points + 1e-7 * normals, normals)).sum(axis=0) / count
        return total


def test_paths_are_those_of_a_twin_in_float64(device, poisoned_outputs):
    """Colors of vertices, a texture, both sides of walls, a sky that differs everywhere, light of three channels."""
    mesh, colors, texture, textured = room()
    radiance = np.random.default_rng(SEED).uniform(0, 3, size=(8, 16, 3)).repeat(2, axis=0).repeat(2, axis=1)
    radiance = radiance.astype(np.float32)
    surfaces = make_surfaces(mesh, colors, device, texture=texture, textured=textured)
    points = np.array([[0.3, 0, 0.2], [-0.6, 0, -0.5], [-1.0, 0.5, 0.3], [1.0, 1.2, 0.0]])
    normals = np.array([[0, 1, 0], [0, 1, 0], [1.0, 0, 0], [0.6, -0.8, 0]])
    twin = Twin(mesh, colors, texture, textured, radiance)
    for bounces in (1, 2):
        light = bounced(surfaces, points, normals, radiance, bounces=bounces, paths=2**18)
        expected = np.stack([twin.bounced(*place, bounces, 1500) for place in zip(points, normals, strict=True)])
        assert (expected > 0.05).all()
        np.testing.assert_allclose(light, expected, rtol=0.03)  # of the few paths of the twin


def test_bodies_that_cast_no_shadow_send_light_back(device):
    """A sheet above a ground that lets light through is seen by the ground from below all the same."""
    sheet = plane(40.0, 1).transformed(translation=[0, 1.0, 0])
    ground = plane(40.0, 1)
    both = Mesh(
        np.concatenate([ground.positions, sheet.positions]),
        np.concatenate([ground.faces, sheet.faces + ground.vertex_count]),
    )
    point, up = np.zeros((1, 3)), np.array([[0.0, 1.0, 0.0]])
    shining = bounced(make_surfaces(both, 0.5, device, casting=ground), point, up, UNIFORM, bounces=1)
    # the underside of the sheet gets no light: the ground blocks the sky below, all but at the rim
    assert shining.max() < 0.05
    below = -up
    lit = bounced(make_surfaces(both, 0.5, device, casting=sheet), point + [0, 0.5, 0], below, UNIFORM, bounces=1)
    dark = bounced(make_surfaces(both, 0.5, device), point + [0, 0.5, 0], below, UNIFORM, bounces=1)
    assert dark.max() < 0.05 and abs(lit - dark).max() < 0.05
    clear = bounced(make_surfaces(both, 0.5, device, casting=icosphere(0.01, 1)), point, up, UNIFORM, bounces=1)
    np.testing.assert_allclose(clear, 0.5, rtol=0.05)


def test_a_receiver_gets_the_same_paths_each_time_and_its_neighbor_others(device):
    mesh, colors, texture, textured = room()
    surfaces = make_surfaces(mesh, colors, device, texture=texture, textured=textured)
    points, normals = np.tile([0.3, 0, 0.2], (20, 1)), np.tile([0.0, 1, 0], (20, 1))
    first, again = (bounced(surfaces, points, normals, UNIFORM, bounces=2, paths=8) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert len(np.unique(first[:, 0])) > 15  # of eight paths some meet nothing


def test_parts_of_receivers_are_those_of_the_whole(device, monkeypatch):
    mesh, colors, texture, textured = room()
    surfaces = make_surfaces(mesh, colors, device, texture=texture, textured=textured)
    points, normals = np.tile([0.3, 0, 0.2], (20, 1)), np.tile([0.0, 1, 0], (20, 1))
    whole = bounced(surfaces, points, normals, UNIFORM, bounces=2, paths=8)
    parts = path_tracing.progress_slices
    monkeypatch.setattr(path_tracing, "progress_slices", lambda total, size, progress: parts(total, 7, progress))
    np.testing.assert_array_equal(bounced(surfaces, points, normals, UNIFORM, bounces=2, paths=8), whole)


def test_noise_falls_with_the_number_of_paths(device):
    mesh, colors, texture, textured = room()
    surfaces = make_surfaces(mesh, colors, device, texture=texture, textured=textured)
    points, normals = np.tile([0.3, 0, 0.2], (200, 1)), np.tile([0.0, 1, 0], (200, 1))
    few, many = (
        bounced(surfaces, points, normals, UNIFORM, bounces=2, paths=paths).std(axis=0).mean() for paths in (8, 128)
    )
    assert many < few / 3.5  # 4 for paths drawn apart


def test_light_in_a_scene_with_bounces_is_more_than_without_and_less_than_white():
    ball = ws.Body(ws.icosphere(0.5, 3), albedo=(0.9, 0.5, 0.1), translation=(0, 0.5, 0), blockers=8)
    ground = ws.Body(ws.plane(4.0, 8), albedo=(0.5, 0.5, 0.5))
    camera = ws.Camera.look_at((0, 2, 4), (0, 0.4, 0), size=(24, 24))
    rays = ws.Visibility(method="ray-traced", samples=256)
    light = ws.EnvironmentMap.constant(1.0)
    scenes = [ws.Scene((ball, ground), light, camera, rays, bounces=bounces) for bounces in (0, 1, 3)]
    direct, once, more = (ws.Renderer(scene).shade().numpy()[0] for scene in scenes)
    assert (more.mean(axis=0) > once.mean(axis=0)).all() and (once.mean(axis=0) > 1.005 * direct.mean(axis=0)).all()
    assert more.mean() < 1
