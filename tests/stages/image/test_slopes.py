"""Slopes: what samples pull at vertices by, against a float64 twin and against the gradient of single faces."""

import numpy as np
import pytest
import warp as wp
from meshes import through_plane
from scipy import ndimage

import warpshadow as ws
from warpshadow.maths.adjacency import edge_neighbors
from warpshadow.stages.image.film import sample_radiance
from warpshadow.stages.image.outlines import MIN_DISTANCE, REACH, detach_near_outlines, find_outline_samples
from warpshadow.stages.image.slopes import MIN_WEIGHT, moving_radiance
from warpshadow.stages.raster.project import to_clip
from warpshadow.stages.raster.rasterization import rasterize
from warpshadow.stages.silhouettes.edge_colors import find_edge_colors
from warpshadow.stages.silhouettes.silhouettes import find_silhouettes

# float32 kernels against float64; measured 2e-6.
FLOAT32 = 2e-5
TRIANGLE = np.array([[-3, -3, -1], [3, -2, 0], [0, 3, 0.5]])
CAMERA = ws.Camera.look_at((0, 0, 4), (0, 0, 0), fov_y=45, size=(26, 22))


class Drawn:
    """Samples of surfaces of random color, and what they pull at clip positions by."""

    def __init__(self, positions, faces, surfaces, device, *, lights=1, camera=CAMERA):
        rng = np.random.default_rng(0)
        self.device, size = device, (camera.height, camera.width)
        world = wp.array(np.float32(positions)[None], dtype=wp.vec3, device=device)
        self.clip = to_clip(world, wp.array(camera.clip_matrix()[None], dtype=wp.mat44, device=device))
        self.clip.requires_grad = True
        self.faces = wp.array(faces, dtype=wp.vec3i, device=device)
        self.fragments = rasterize(self.clip, self.faces, *size[::-1])
        neighbors = wp.array(edge_neighbors(np.asarray(faces)), dtype=wp.vec3i, device=device)
        bodies = wp.array(np.int32(surfaces), device=device)
        self.silhouettes = find_silhouettes(self.fragments, self.faces, neighbors, self.clip, bodies)
        colors = rng.uniform(0.2, 1, (lights, len(positions), 3))
        albedo = rng.uniform(0.2, 1, (1, *size, 3))
        self.shading, self.albedo = (wp.array(np.float32(a), dtype=wp.vec3, device=device) for a in (colors, albedo))
        self.seeds = np.float32(rng.normal(size=(lights, *size, 4)))

    @property
    def receivers(self):
        return wp.array(np.arange(self.clip.shape[1]), dtype=wp.int32, device=self.device)

    def samples(self):
        return sample_radiance(self.fragments, self.faces, self.shading, self.albedo)

    def edge_colors(self, samples):
        return find_edge_colors(samples, self.silhouettes, self.clip, self.shading, self.receivers, self.albedo)

    def mean_slopes(self):
        return find_outline_samples(self.silhouettes, self.clip)

    def pulls(self, seeds, *masks):
        """Gradient to the clip positions by mean slopes."""
        with wp.Tape() as tape:
            seen = self.fragments, self.faces, self.shading, self.albedo
            samples, edge_colors = moving_radiance(*seen, self.silhouettes, self.clip, self.receivers, *masks)
        np.testing.assert_array_equal(samples.numpy(), self.samples().numpy())
        np.testing.assert_array_equal(edge_colors.numpy(), self.edge_colors(samples).numpy())
        return self._played(tape, samples, seeds)

    def pulls_of_faces(self, seeds):
        """Gradient to the clip positions by the faces at the samples' points."""
        self.fragments.barycentrics.grad.zero_()
        with wp.Tape() as tape:
            height, width = self.fragments.face_ids.shape[1:]
            fragments = rasterize(self.clip, self.faces, width, height)
            samples = sample_radiance(fragments, self.faces, self.shading, self.albedo)
        return self._played(tape, samples, seeds)

    def _played(self, tape, samples, seeds):
        self.clip.grad.zero_()
        tape.backward(grads={samples: wp.array(seeds, dtype=wp.vec4, device=self.device)})
        return self.clip.grad.numpy()[0].astype(float)


def image_weight(drawn, sample):
    """Weight of a sample in all of the smoothed image."""
    entries = drawn.silhouettes.entries.numpy()
    areas = drawn.silhouettes.line_areas.numpy().view(np.float32).reshape(-1, 4, 3).astype(float)
    if entries[sample] < 0:
        return 1.0

    def taken(number, side):
        (area, weight, end), across = areas[number, side], areas[number, [2, 3] if side < 2 else [0, 1]]
        losses = 0.5 * (1 + across[:, 2] - end) * np.maximum(weight + across[:, 1] - 1, 0) * across[:, 0]
        return area * (weight - losses.sum())

    total = 1.0
    for side, step in enumerate([1, -1, CAMERA.width, -CAMERA.width]):
        if areas[entries[sample], side, 1] > 0:
            total += taken(entries[sample + step], side ^ 1) - taken(entries[sample], side)
    return max(total, MIN_WEIGHT)


def twin(drawn, is_albedo_moving=None):
    """The same in float64, from what was found: a sum over samples of −slope · motion on screen."""
    width, height = CAMERA.width, CAMERA.height
    clip, faces = drawn.clip.numpy()[0].astype(float), drawn.faces.numpy()
    face_ids, weights = drawn.fragments.face_ids.numpy().ravel(), drawn.fragments.barycentrics.numpy().reshape(-1, 3)
    entries, edges = drawn.silhouettes.entries.numpy(), drawn.silhouettes.edges.numpy()
    samples = drawn.samples()
    edge_colors = drawn.edge_colors(samples).numpy()[..., :3].astype(float)
    albedo = drawn.albedo.numpy().reshape(-1, 3).astype(float)
    pulls = np.zeros_like(clip)
    is_albedo_moving = np.zeros(len(face_ids), bool) if is_albedo_moving is None else is_albedo_moving
    for batch, (color, shading) in enumerate(zip(samples.numpy(), drawn.shading.numpy(), strict=True)):
        color, seeds = color.reshape(-1, 4)[:, :3].astype(float), drawn.seeds[batch].reshape(-1, 4)[:, :3]
        received = np.einsum("pk,pkc->pc", weights, shading[faces[face_ids]])
        for sample in np.flatnonzero(face_ids >= 0):
            column, row = sample % width, sample // width
            here, corners = np.array([column + 0.5, row + 0.5]), clip[faces[face_ids[sample]]]
            slope = np.zeros((2, 3))
            around, edge_steps, extents = [not is_albedo_moving[sample]], [], np.ones(2)
            for axis in range(2):
                rises, spans = np.zeros(3), 0.0
                for sign in (1, -1):
                    there = here + sign * np.eye(2)[axis]
                    if not (0 < there[0] < width and 0 < there[1] < height):
                        continue
                    other = int(there[1]) * width + int(there[0])
                    side = 2 * axis + (sign < 0)
                    edge = (-1, -1) if entries[sample] < 0 else edges[entries[sample], side]
                    around.append(edge[0] == -1 and face_ids[other] == face_ids[sample])
                    if edge[0] >= 0:
                        ends = (clip[edge][:, :2] / clip[edge][:, 3:] + 1) / 2 * [width, height]
                        part = (here - ends[0])[1 - axis] / (ends[1] - ends[0])[1 - axis]
                        t = sign * (ends[0] + part * (ends[1] - ends[0]) - here)[axis]
                        is_own = np.linalg.det(
                            np.stack([*clip[edge][:, [0, 1, 3]], [*(2 * here / [width, height] - 1), 1]])
                        )
                        if is_own > 0 and t > MIN_DISTANCE:
                            step = sign * (edge_colors[batch, entries[sample], side] - color[sample])
                            edge_steps.append((axis, edge, step))
                            spans += t
                            extents[axis] += t - 0.5
                    elif edge[0] == -1 and face_ids[other] >= 0:
                        rises += sign * 0.5 * albedo[sample] * (received[other] - received[sample])
                        if is_albedo_moving[sample]:
                            rises += sign * 0.5 * received[other] * (albedo[other] - albedo[sample])
                        spans += 0.5
                slope[axis] = rises / spans if spans else np.nan
                edge_steps = [(k, edge, step / spans if k == axis else step) for k, edge, step in edge_steps]
            for axis in range(2):
                if all(around) or np.isnan(slope[axis, 0]):
                    ends = []
                    for sign in (1, -1):
                        ray = [*(2 * (here + sign * 1e-4 * np.eye(2)[axis]) / [width, height] - 1), 1]
                        found = np.linalg.solve(corners[:, [0, 1, 3]].T, ray)
                        ends.append(found / found.sum() @ shading[faces[face_ids[sample]]])
                    slope[axis] = albedo[sample] * (ends[0] - ends[1]) / 2e-4
            factors = extents / image_weight(drawn, sample)
            u, v = 2 * here / [width, height] - 1
            for axis, edge, step in edge_steps:
                ends = clip[edge]
                offsets = ends[:, 1 - axis] - [u, v][1 - axis] * ends[:, 3]
                shares = np.linalg.solve([offsets, ends[:, 3]], [0, 1])
                pull = np.zeros(4)
                pull[[axis, 3]] = 1, -(shares @ ends[:, axis])
                pull *= -step @ seeds[sample] * factors[axis] * [width, height][axis] / 2
                np.add.at(pulls, edge, shares[:, None] * pull)
            x, y = factors * (slope @ seeds[sample]) * [width / 2, height / 2]
            pull = np.array([-x, -y, 0, x * u + y * v]) / (weights[sample] @ corners[:, 3])
            np.add.at(pulls, faces[face_ids[sample]], weights[sample][:, None] * pull)
    return pulls


@pytest.mark.parametrize("lights", [1, 2])
def test_surfaces_pull_by_mean_slopes(device, lights):
    """A ball through a plane: small faces and large ones, limbs, an intersection, the border of the image."""
    positions, faces, bodies = through_plane(ws.icosphere(0.8, 2))
    drawn = Drawn(positions, faces, bodies, device, lights=lights)
    got, expected = drawn.pulls(drawn.seeds), twin(drawn)
    assert np.abs(got - expected).max() < FLOAT32 * np.abs(expected).max()


@pytest.mark.parametrize("lights", [1, 2])
def test_near_outlines_surfaces_pull_by_mean_slopes_of_albedo_too(device, lights):
    positions, faces, bodies = through_plane(ws.icosphere(0.8, 2))
    drawn = Drawn(positions, faces, bodies, device, lights=lights)
    mask = drawn.mean_slopes()
    assert 20 < mask.numpy().sum() < 0.5 * mask.size
    got, expected = drawn.pulls(drawn.seeds, None, mask), twin(drawn, mask.numpy()[0])
    assert np.abs(got - expected).max() < FLOAT32 * np.abs(expected).max()
    assert np.abs(got - twin(drawn)).max() > 0.01 * np.abs(expected).max()


def test_samples_up_to_two_from_an_outline_have_mean_slopes_and_hold_their_points(device):
    ball = ws.icosphere(1.2, 3)
    drawn = Drawn(ball.positions, ball.faces, np.zeros(ball.face_count), device)
    on_ball = drawn.fragments.face_ids.numpy()[0] >= 0
    expected = on_ball & ndimage.binary_dilation(~on_ball, iterations=REACH + 1)
    mask = drawn.mean_slopes()
    np.testing.assert_array_equal(mask.numpy().reshape(on_ball.shape), expected)
    drawn.fragments.barycentrics.grad.zero_()
    with wp.Tape() as tape:
        held = detach_near_outlines(drawn.fragments, mask).barycentrics
    np.testing.assert_array_equal(held.numpy(), drawn.fragments.barycentrics.numpy())
    seeds = wp.array(drawn.seeds[..., :3], dtype=wp.vec3, device=device)
    tape.backward(grads={held: seeds})
    handed_on = drawn.fragments.barycentrics.grad.numpy()[0]
    np.testing.assert_array_equal(handed_on, np.where(expected[..., None], 0, drawn.seeds[0, ..., :3]))


def test_a_face_that_all_neighbors_see_pulls_by_its_own_slope(device):
    drawn = Drawn(TRIANGLE, [[0, 1, 2]], [0], device)
    drawn.seeds[0, drawn.fragments.face_ids.numpy()[0] < 0] = 0
    drawn.seeds[0, drawn.silhouettes.entries.numpy().reshape(drawn.seeds.shape[1:3]) >= 0] = 0
    got, expected = drawn.pulls(drawn.seeds), drawn.pulls_of_faces(drawn.seeds)
    assert np.abs(expected).max() > 0.1
    assert np.abs(got - expected).max() < FLOAT32 * np.abs(expected).max()


def test_where_no_slope_is_to_be_seen_it_is_that_of_the_face(device):
    """An image of one sample has no neighbors."""
    one = ws.Camera.look_at((0, 0, 4), (0, 0, 0), fov_y=45, size=(1, 1))
    drawn = Drawn(TRIANGLE, [[0, 1, 2]], [0], device, camera=one)
    got, expected = drawn.pulls(drawn.seeds), drawn.pulls_of_faces(drawn.seeds)
    assert np.abs(expected).max() > 0.01
    assert np.abs(got - expected).max() < FLOAT32 * np.abs(expected).max()


def test_colors_at_edges_are_those_of_both_surfaces_there(device):
    """A card that stands on the ground hides some of it, though the ground below its foot is nearer."""
    card = [[-0.6, -0.79, 0], [0.6, -0.79, 0], [0.6, 0.5, 0], [-0.6, 0.5, 0]]
    ground = [[-9, -0.8, 3], [9, -0.8, 3], [9, -0.8, -9], [-9, -0.8, -9]]
    drawn = Drawn(np.array([*card, *ground]), [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], [0, 0, 1, 1], device)
    drawn.albedo.fill_(1.0)
    colors = np.repeat([[0.9, 0.5, 0.2], [0.1, 0.4, 0.8]], 4, axis=0)
    drawn.shading = wp.array(np.float32(colors)[None], dtype=wp.vec3, device=device)
    edge_colors = drawn.edge_colors(drawn.samples()).numpy()[0]
    seen = drawn.fragments.face_ids.numpy().ravel()
    silhouettes = drawn.silhouettes
    weights = drawn.fragments.barycentrics.numpy().reshape(-1, 3)
    depths = np.einsum("pk,pk->p", weights, drawn.clip.numpy()[0, drawn.faces.numpy()[seen], 3])
    steps = np.array([1, -1, CAMERA.width, -CAMERA.width])
    count = 0
    for pixel, sides, found in zip(silhouettes.samples.numpy(), silhouettes.edges.numpy(), edge_colors, strict=True):
        for side in np.flatnonzero(sides[:, 0] >= 0) if pixel >= 0 else ():
            other = pixel + steps[side]
            count += seen[pixel] < 2 <= seen[other] and depths[other] < depths[pixel]
            np.testing.assert_allclose(
                found[side, :3], colors[0 if seen[pixel] < 2 else 4] * (seen[pixel] >= 0), atol=1e-6
            )
    assert count > 3
