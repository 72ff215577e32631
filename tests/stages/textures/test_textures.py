"""Textures: mip levels and filtering against float64 twins, gradients, and that a fit leaves no holes."""

import numpy as np
import pytest
import warp as wp

from warpshadow.assets.camera import Camera
from warpshadow.assets.image import read_image, write_image
from warpshadow.assets.primitives import plane
from warpshadow.stages.raster.barycentrics import find_barycentrics
from warpshadow.stages.raster.interpolation import interpolate
from warpshadow.stages.raster.project import to_clip
from warpshadow.stages.raster.rasterization import Fragments, rasterize
from warpshadow.stages.textures.footprint import Footprints, find_footprints
from warpshadow.stages.textures.pyramid import level_matrices, mip_pyramids
from warpshadow.stages.textures.sample import sample_albedo, textured_radiance
from warpshadow.stages.textures.seen import fill_unseen, seen_texels

MEAN = 5e-7  # float32 means of texels in [0, 1]
SAMPLE = 1e-5  # uvs of up to 2 carry 1e-7, times 64 texels, and the width of a footprint 1e-6 of it
GRADIENT = 2e-5  # relative L2 of directional derivatives, sums over a thousand samples

# ---------------------------------------------------------------------------------------------------- twins


def halved(image):
    """The next mip level, by how far the intervals of its texels and those of the finer one overlap."""
    for axis in (0, 1):
        fine = image.shape[axis]
        coarse = max(fine // 2, 1)
        edges = np.arange(coarse + 1)[:, None] * fine / coarse
        begin, end = np.arange(fine), np.arange(fine) + 1
        shares = np.maximum(np.minimum(edges[1:], end) - np.maximum(edges[:-1], begin), 0) * coarse / fine
        image = np.moveaxis(np.tensordot(shares, image, (1, axis)), 0, axis)
    return image


def pyramid(image):
    levels = [np.asarray(image, np.float64)]
    while max(levels[-1].shape[:2]) > 1:
        levels.append(halved(levels[-1]))
    return levels


def bilinear(image, u, v):
    """An image [height, width, 3], row 0 at v = 1, repeated, between texel centers at (i + ½)/size."""
    height, width = image.shape[:2]
    x, y = np.asarray(u) * width - 0.5, (1 - np.asarray(v)) * height - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    s, t = (x - left)[..., None], (y - top)[..., None]

    def texel(row, column):
        return image[row % height, column % width]

    above = (1 - s) * texel(top, left) + s * texel(top, left + 1)
    below = (1 - s) * texel(top + 1, left) + s * texel(top + 1, left + 1)
    return (1 - t) * above + t * below


def filtered(levels, uv, derivatives, *, most=7, reach=0.25):
    """Color of a footprint: probes along the major axis of the ellipse into which ``derivatives`` takes a circle."""
    height, width = levels[0].shape[:2]
    axes, (major, minor), _ = np.linalg.svd(np.array([[width], [height]]) * derivatives)
    size = max(minor, major / (most + reach), 1)
    length = max(major / size - reach, 1)
    level = min(int(np.log2(size)), len(levels) - 1)
    blend = size / 2**level - 1 if level + 1 < len(levels) else 0.0
    number = np.arange(-((most - 1) // 2), most // 2 + 1)
    shares = np.clip(np.minimum(number + 0.5, length / 2) - np.maximum(number - 0.5, -length / 2), 0, None) / length
    u = uv[0] + number * size * axes[0, 0] / width
    v = uv[1] + number * size * axes[1, 0] / height
    colors = bilinear(levels[level], u, v)
    if blend:
        colors = (1 - blend) * colors + blend * bilinear(levels[level + 1], u, v)
    return shares @ colors


def weights_at(clip, x, y):
    """Perspective-correct weights, on the whole plane of a clip-space triangle [3, 4]."""
    volumes = np.linalg.solve(np.stack([clip[:, 0], clip[:, 1], clip[:, 3]]), [x, y, 1.0])
    return volumes / volumes.sum()


def seen_footprint(clip, uvs, row, column, height, width, step=1e-4):
    """The uv that a sample sees on a triangle, and its derivative by the sample's column and row."""

    def uv_at(column, row):
        return weights_at(clip, 2 * column / width - 1, 2 * row / height - 1) @ uvs

    x, y = column + 0.5, row + 0.5
    by_column = (uv_at(x + step, y) - uv_at(x - step, y)) / (2 * step)
    by_row = (uv_at(x, y + step) - uv_at(x, y - step)) / (2 * step)
    return uv_at(x, y), np.stack([by_column, by_row], axis=-1)


def albedo_twin(face_ids, scene, clip_positions, uvs, images, vertex_albedo):
    """Reflectance of every sample of one instance."""
    height, width = face_ids.shape
    pyramids = [pyramid(image) for image in images]
    result = np.zeros((height, width, 3))
    for row, column in np.argwhere(face_ids >= 0):
        face = face_ids[row, column]
        clip = clip_positions[scene.faces[face]]
        number = scene.texture_of_face[face]
        if number >= 0:
            footprint = seen_footprint(clip, uvs[scene.uv_faces[face]], row, column, height, width)
            result[row, column] = filtered(pyramids[number], *footprint)
        else:
            weights = weights_at(clip, (2 * column + 1) / width - 1, (2 * row + 1) / height - 1)
            result[row, column] = weights @ vertex_albedo[scene.faces[face]]
    return result


# ---------------------------------------------------------------------------------------------------- scenes


class Bodies:
    """A ground and a wall with textures of odd sizes, a triangle without one; the wall's uvs run apart from its faces.

    What the two instances differ in is the camera.
    """

    size = (22, 18)
    positions = np.float32(
        [[-3, 0, 3], [3, 0, 3], [3, 0, -9], [-3, 0, -9]]
        + [[-2, 0, -4], [0, 0.2, -3], [0.3, 2, -4], [-2, 2, -3]]
        + [[0.5, 0.2, -2], [1.8, 0.1, -3], [1.4, 1.5, -2]]
    )
    faces = np.int32([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7], [8, 9, 10]])
    uvs = np.float32(
        [[0.1, 0.2], [1.9, -0.1], [2.1, 2.2], [0.3, 1.8], [0.2, 0.9], [0.8, 0.8], [0.9, 0.1], [0.1, 0.1], [0.4, 0.6]]
    )
    uv_faces = np.int32([[0, 1, 2], [0, 2, 3], [4, 5, 6], [8, 6, 7], [0, 0, 0]])
    texture_of_face = np.int32([0, 0, 1, 1, -1])
    eyes = ((0.0, 0.5, 4.0), (1.5, 1.2, 2.5))

    def __init__(self, device):
        self.device = device
        cameras = [Camera.look_at(eye, (0, 0.5, -3), size=self.size, fov_y=50) for eye in self.eyes]
        matrices = wp.array([camera.clip_matrix() for camera in cameras], dtype=wp.mat44, device=device)
        positions = wp.array(self.positions[None], dtype=wp.vec3, device=device)
        self.clip_positions = to_clip(positions, matrices).numpy()
        clip = wp.array(self.clip_positions, dtype=wp.vec4, device=device)
        self.face_ids = rasterize(clip, self.topology(self.faces), *self.size).face_ids
        random = np.random.default_rng(0)
        self.images = [random.uniform(size=shape).astype(np.float32) for shape in ((2, 27, 41, 3), (1, 16, 5, 3))]
        self.vertex_albedo = random.uniform(size=(2, len(self.positions), 3)).astype(np.float32)

    def topology(self, faces):
        return wp.array(faces, dtype=wp.vec3i, device=self.device)

    def put(self, values, dtype, requires_grad=False):
        return wp.array(values, dtype=dtype, device=self.device, requires_grad=requires_grad)

    def variables(self, requires_grad=False):
        """Clip positions, uvs, vertex albedo and images as arrays."""
        return [
            self.put(self.clip_positions, wp.vec4, requires_grad),
            self.put(self.uvs[None], wp.vec2, requires_grad),
            self.put(self.vertex_albedo, wp.vec3, requires_grad),
            *(self.put(image, wp.vec3, requires_grad) for image in self.images),
        ]

    def albedo(self, clip_positions, uvs, vertex_albedo, *images):
        faces = self.topology(self.faces)
        fragments = Fragments(self.face_ids, find_barycentrics(self.face_ids, faces, clip_positions))
        return surface_albedo(
            fragments,
            faces,
            vertex_albedo,
            clip_positions,
            uvs,
            self.topology(self.uv_faces),
            self.put(self.texture_of_face, wp.int32),
            mip_pyramids(images),
        )

    def albedo_twin(self, clip_positions, uvs, vertex_albedo, *images):
        face_ids = self.face_ids.numpy()
        return np.stack(
            [
                albedo_twin(
                    face_ids[i],
                    self,
                    clip_positions[i],
                    uvs[0],
                    [image[min(i, len(image) - 1)] for image in images],
                    vertex_albedo[i],
                )
                for i in range(len(face_ids))
            ]
        )


def samples_of(device, uvs, probes=(0.0, 0.0, 1.0, 1.0)):
    """Fragments and footprints of one row of samples, all of them on texture 0."""
    uvs = np.atleast_2d(uvs).astype(np.float32)
    probes = np.broadcast_to(probes, (len(uvs), 4))
    shape = (1, 1, len(uvs))
    fragments = Fragments(
        wp.zeros(shape, dtype=wp.int32, device=device), wp.full(shape, wp.vec3(1 / 3), dtype=wp.vec3, device=device)
    )
    footprints = Footprints(
        wp.zeros(shape, dtype=wp.int32, device=device),
        wp.array(uvs[None, None], dtype=wp.vec2, device=device),
        wp.array(probes[None, None], dtype=wp.vec4, device=device),
    )
    return fragments, footprints


def sampled(device, image, fragments, footprints):
    """Reflectance of a row of samples of one image, [sample, 3]."""
    faces = wp.array([[0, 1, 2]], dtype=wp.vec3i, device=device)
    gray = wp.zeros((1, 3), dtype=wp.vec3, device=device)
    pyramids = mip_pyramids([wp.array(image[None], dtype=wp.vec3, device=device)])
    return sample_albedo(fragments, faces, gray, pyramids, footprints).numpy()[0, 0]


def facing(device, texels_a_sample, *, size=24, tilt=0.0, mesh=None):
    """A textured plane that fills the image, its uvs repeated so that a sample covers so many of 64 texels.

    Returns what `surface_albedo` takes, but for the texture.
    """
    mesh = plane(size=2.0, segments=1) if mesh is None else mesh
    eye = (0.0, np.cos(tilt), np.sin(tilt))
    fov = np.degrees(2 * np.arctan(1.0))
    camera = Camera.look_at(eye, (0, 0, 0), up=(0, 0, -1) if tilt == 0 else (0, 1, 0), fov_y=fov, size=(size, size))
    positions = wp.array(1.5 * mesh.positions[None], dtype=wp.vec3, device=device)
    clip = to_clip(positions, wp.array(camera.clip_matrix()[None], dtype=wp.mat44, device=device))
    faces = wp.array(mesh.faces, dtype=wp.vec3i, device=device)
    uvs = 1.5 * (mesh.uvs - 0.5) * texels_a_sample * size / 64
    return (
        rasterize(clip, faces, size, size),
        faces,
        wp.zeros((1, len(mesh.positions)), dtype=wp.vec3, device=device),
        clip,
        wp.array(uvs[None], dtype=wp.vec2, device=device),
        wp.array(mesh.uv_faces, dtype=wp.vec3i, device=device),
        wp.zeros(len(mesh.faces), dtype=wp.int32, device=device),
    )


def surface_albedo(fragments, faces, vertex_albedo, clip_positions, uvs, uv_faces, texture_of_face, textures):
    footprints = find_footprints(fragments, faces, clip_positions, uvs, uv_faces, texture_of_face, textures)
    return sample_albedo(fragments, faces, vertex_albedo, textures, footprints)


def tape_gradients(function, variables, weights):
    """Gradients of Σ weights · function(*variables), by the tape."""
    with wp.Tape() as tape:
        result = function(*variables)
    tape.backward(grads={result: wp.array(weights, dtype=result.dtype, device=result.device)})
    return [variable.grad.numpy().astype(np.float64) for variable in variables]


def relative(got, expected):
    return np.linalg.norm(got - expected) / np.linalg.norm(expected)


# ---------------------------------------------------------------------------------------------------- mip levels


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (5, 1), (2, 2), (8, 8), (3, 5), (13, 6), (31, 17)])
def test_mip_levels_equal_their_twin(device, poisoned_outputs, shape):
    images = np.random.default_rng(0).uniform(size=(2, *shape, 3)).astype(np.float32)
    pyramids = mip_pyramids([wp.array(images, dtype=wp.vec3, device=device)])
    expected = [np.concatenate([level.reshape(-1, 3) for level in pyramid(image)]) for image in images]
    np.testing.assert_allclose(pyramids.texels.numpy(), expected, atol=MEAN)


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (13, 6), (16, 16)])
def test_matrices_take_an_image_to_its_levels(shape):
    image = np.random.default_rng(0).uniform(size=(*shape, 3))
    for matrix, level in zip(level_matrices(*shape), pyramid(image), strict=True):
        np.testing.assert_allclose(matrix @ image.reshape(-1, 3), level.reshape(-1, 3), rtol=1e-12)


def test_levels_lie_where_the_layout_says(device):
    sizes = [(5, 9), (1, 1), (4, 2)]
    images = [np.random.default_rng(number).uniform(size=(1, *size, 3)) for number, size in enumerate(sizes)]
    pyramids = mip_pyramids([wp.array(image, dtype=wp.vec3, device=device) for image in images])
    assert pyramids.sizes == tuple(sizes)
    texels, levels, counts = pyramids.texels.numpy()[0], pyramids.levels.numpy(), pyramids.level_counts.numpy()
    np.testing.assert_array_equal(counts, [4, 1, 3])
    covered = np.zeros(len(texels), int)
    for number, image in enumerate(images):
        expected = pyramid(image[0])
        assert len(expected) == counts[number]
        for (first, width, height), level in zip(levels[number].tolist(), expected, strict=False):
            stored = texels[first : first + width * height].reshape(height, width, 3)
            np.testing.assert_allclose(stored, level, atol=MEAN)
            covered[first : first + width * height] += 1
    assert (covered == 1).all()


@pytest.mark.parametrize("shape", [(16, 16), (13, 6), (1, 31)])
def test_every_level_has_the_mean_of_the_image(shape):
    levels = pyramid(np.random.default_rng(0).uniform(size=(*shape, 3)))
    np.testing.assert_allclose([level.mean(axis=(0, 1)) for level in levels], [levels[-1][0, 0]] * len(levels))


@pytest.mark.parametrize(
    ("images", "message"),
    [
        ([], "images: got none"),
        ([wp.vec3, (4, 4)], r"images\[0\]: got shape \(4, 4\), expected \[batch, height, width\]"),
        ([wp.vec3, (1, 0, 4)], r"images\[0\]: got vec3f? of shape \(1, 0, 4\), expected contiguous vec3"),
        ([wp.float32, (1, 4, 4)], r"images\[0\]: got float32 of shape"),
    ],
)
def test_images_of_no_use_are_refused(device, images, message):
    if images:
        dtype, shape = images
        images = [wp.zeros(shape, dtype=dtype, device=device)]
    with pytest.raises(ValueError, match=message):
        mip_pyramids(images)


def test_strided_images_and_other_batches_are_refused(device):
    image = wp.zeros((3, 4, 4), dtype=wp.vec3, device=device)
    with pytest.raises(ValueError, match=r"images\[0\]: got strided vec3"):
        mip_pyramids([image[:, :, ::2]])
    with pytest.raises(ValueError, match=r"images\[1\]: got a batch of 2, expected 1 or 3"):
        mip_pyramids([image, wp.zeros((2, 4, 4), dtype=wp.vec3, device=device)])


# ---------------------------------------------------------------------------------------------------- reflectance


def test_reflectance_equals_its_twin_on_every_body(device, poisoned_outputs):
    bodies = Bodies(device)
    variables = bodies.variables()
    got = bodies.albedo(*variables).numpy()
    expected = bodies.albedo_twin(*(variable.numpy().astype(np.float64) for variable in variables))
    seen = bodies.face_ids.numpy()
    assert set(bodies.texture_of_face[seen[seen >= 0]]) == {-1, 0, 1} and (seen < 0).any()
    assert np.abs(got - expected).max() < SAMPLE
    assert (got[seen < 0] == 0).all()


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_reflectance_does_not_depend_on_the_scale_of_the_scene(device, scale):
    bodies = Bodies(device)
    clip, *others = bodies.variables()
    scaled = bodies.put(np.float32(scale) * clip.numpy(), wp.vec4)
    np.testing.assert_allclose(
        bodies.albedo(scaled, *others).numpy(), bodies.albedo(clip, *others).numpy(), atol=10 * SAMPLE
    )


def test_footprints_of_the_scene_are_of_all_kinds(device):
    """What the tests of this scene rest on: magnified, minified, of one probe and of as many as there may be."""
    bodies = Bodies(device)
    clip, uvs, _, *images = bodies.variables()
    faces = bodies.topology(bodies.faces)
    fragments = Fragments(bodies.face_ids, find_barycentrics(bodies.face_ids, faces, clip))
    found = find_footprints(
        fragments,
        faces,
        clip,
        uvs,
        bodies.topology(bodies.uv_faces),
        bodies.put(bodies.texture_of_face, wp.int32),
        mip_pyramids(images),
    )
    numbers = found.texture_ids.numpy()
    faces_seen = bodies.face_ids.numpy()
    np.testing.assert_array_equal(numbers, np.where(faces_seen < 0, -1, bodies.texture_of_face[faces_seen]))
    *_, width, count = np.moveaxis(found.probes.numpy()[numbers >= 0], -1, 0)
    assert (width == 1).any() and width.max() > 3
    assert (count == 1).any() and np.histogram(count, [1.0001, 3, 5, 6.99, 7.01])[0].all()


def test_magnified_textures_are_bilinear_and_repeat(device):
    image = np.random.default_rng(7).uniform(size=(5, 8, 3)).astype(np.float32)
    uvs = np.random.default_rng(8).uniform(-2, 3, size=(40, 2)).astype(np.float32)
    uvs[:6] = [[0, 0], [1, 1], [0.5, 0.5], [-0.0, -1e-9], [0.999999, 0.03], [-1, 2]]
    got = sampled(device, image, *samples_of(device, uvs))
    assert np.abs(got - bilinear(image.astype(np.float64), *uvs.astype(np.float64).T)).max() < 1e-5


def test_texel_centers_get_their_texels(device):
    image = np.random.default_rng(7).uniform(size=(5, 8, 3)).astype(np.float32)
    row, column = np.mgrid[:5, :8]
    uvs = np.stack([(column + 0.5) / 8, 1 - (row + 0.5) / 5], axis=-1).reshape(-1, 2)
    assert np.abs(sampled(device, image, *samples_of(device, uvs)) - image.reshape(-1, 3)).max() < 2e-6


@pytest.mark.parametrize("tilt", [0.0, 0.5])
def test_a_plane_seen_from_near_is_bilinear(device, tilt):
    """Each sample covers less than a texel, so nothing is filtered."""
    image = np.random.default_rng(7).uniform(size=(64, 64, 3)).astype(np.float32)
    arguments = facing(device, 0.3, tilt=tilt)
    fragments, _, _, _, uvs, uv_faces, _ = arguments
    got = surface_albedo(*arguments, mip_pyramids([wp.array(image[None], dtype=wp.vec3, device=device)])).numpy()
    u, v = np.moveaxis(interpolate(fragments, uv_faces, uvs).numpy().astype(np.float64), -1, 0)
    expected = np.where(fragments.face_ids.numpy()[..., None] >= 0, bilinear(image.astype(np.float64), u, v), 0)
    assert np.abs(got - expected).max() < SAMPLE


def test_one_color_stays_that_color_whatever_the_footprint(device):
    color = np.float32([0.2, 0.5, 0.9])
    image = np.broadcast_to(color, (13, 9, 3))
    random = np.random.default_rng(0)
    probes = np.stack(
        [*random.normal(size=(2, 200)), *random.uniform(1, 40, (1, 200)), *random.uniform(1, 7, (1, 200))]
    )
    got = sampled(device, image, *samples_of(device, random.normal(size=(200, 2)), probes.T))
    assert np.abs(got - color).max() < 2e-6


@pytest.mark.parametrize("column", [2, 3])
def test_reflectance_is_continuous_in_the_width_and_in_the_count_of_probes(device, column):
    """Over thousands of steps no step is larger than those of a continuous slope."""
    image = np.random.default_rng(0).uniform(size=(64, 64, 3)).astype(np.float32)
    count = 8000
    probes = np.tile([0.031, 0.017, 1.7, 4.3], (count, 1))
    probes[:, column] = np.linspace(1, (100, 7)[column - 2], count)
    colors = sampled(device, image, *samples_of(device, np.full((count, 2), 0.37), probes))
    assert np.abs(colors[0] - colors[-1]).max() > 0.02
    assert np.abs(np.diff(colors, axis=0)).max() < 5e-3


def test_a_grazing_ground_neither_blurs_nor_aliases(device):
    """Against the mean over the square of each sample."""
    size, fine = 32, 16
    random = np.random.default_rng(0)
    rough = random.uniform(size=(64, 64, 3))
    image = np.float32(0.5 + 0.5 * np.sign(np.sin(np.arange(64) * np.pi / 8))[None, :, None] * (0.5 + 0.5 * rough))

    def seen(size, device="cpu"):
        arguments = facing(device, 32 / size, tilt=1.35, size=size)
        return arguments[0].face_ids.numpy()[0] >= 0, arguments

    covered, arguments = seen(size, device)
    pyramids = mip_pyramids([wp.array(image[None], dtype=wp.vec3, device=device)])
    got = surface_albedo(*arguments, pyramids).numpy()[0]
    fine_covered, (fragments, _, _, _, uvs, uv_faces, _) = seen(size * fine)
    u, v = np.moveaxis(interpolate(fragments, uv_faces, uvs).numpy()[0], -1, 0)
    points = bilinear(image, u, v)
    expected = points.reshape(size, fine, size, fine, 3).mean(axis=(1, 3))
    whole = covered & fine_covered.reshape(size, fine, size, fine).all(axis=(1, 3))
    point = points[fine // 2 :: fine, fine // 2 :: fine]
    error, aliased = (np.sqrt(np.mean((image - expected)[whole] ** 2)) for image in (got, point))
    assert whole.sum() > 200
    assert error < 0.25 * aliased
    assert error < 0.05 * expected[whole].std()


def test_faces_seen_edge_on_or_mapped_to_a_point_give_finite_colors(device):
    image = np.random.default_rng(0).uniform(size=(16, 16, 3)).astype(np.float32)
    clip = np.float32([[[-1, 0, 0.5, 1], [1, 0, 0.5, 1], [0, 0, 0.5, 1], [0, 1e-12, 0.5, 1], [0, 1, 0.5, 1]]])
    faces = np.int32([[0, 1, 2], [0, 1, 3], [0, 1, 4]])
    fragments = Fragments(
        wp.array([[[0, 1, 2, -1]]], dtype=wp.int32, device=device),
        wp.full((1, 1, 4), wp.vec3(1 / 3), dtype=wp.vec3, device=device),
    )
    variables = [wp.array(clip, dtype=wp.vec4, device=device, requires_grad=True)]

    def albedo(clip_positions):
        return surface_albedo(
            fragments,
            wp.array(faces, dtype=wp.vec3i, device=device),
            wp.zeros((1, 5), dtype=wp.vec3, device=device),
            clip_positions,
            wp.array([[[0, 0], [1e5, 0], [0, 1e5], [0.3, 0.3]]], dtype=wp.vec2, device=device),
            wp.array([[0, 1, 2], [0, 1, 2], [3, 3, 3]], dtype=wp.vec3i, device=device),
            wp.zeros(3, dtype=wp.int32, device=device),
            mip_pyramids([wp.array(image[None], dtype=wp.vec3, device=device)]),
        )

    colors = albedo(*variables).numpy()[0, 0]
    np.testing.assert_allclose(colors[:2], np.tile(image.mean(axis=(0, 1)), (2, 1)), atol=1e-5)
    np.testing.assert_allclose(colors[2], bilinear(image, 0.3, 0.3), atol=1e-5)
    (gradient,) = tape_gradients(albedo, variables, np.ones((1, 1, 4, 3)))
    assert np.isfinite(gradient).all()


@pytest.mark.parametrize("batched", ["fragments", "clip_positions", "uvs", "vertex_albedo", "images"])
def test_a_batch_of_1_serves_every_instance(device, batched):
    """With one input in a batch of three, of which only the last is another, the others' single ones serve all."""
    bodies = Bodies(device)
    faces = bodies.topology(bodies.faces)
    random = np.random.default_rng(0)
    face_ids = bodies.face_ids.numpy()[:1]
    values = {
        "fragments": find_barycentrics(bodies.face_ids, faces, bodies.variables()[0]).numpy()[:1],
        "clip_positions": bodies.clip_positions[:1],
        "uvs": bodies.uvs[None],
        "vertex_albedo": bodies.vertex_albedo[:1],
        "images": bodies.images[1],
    }

    def albedo(values):
        count = len(values["fragments"])
        return surface_albedo(
            Fragments(
                bodies.put(np.repeat(face_ids, count, axis=0), wp.int32), bodies.put(values["fragments"], wp.vec3)
            ),
            faces,
            bodies.put(values["vertex_albedo"], wp.vec3),
            bodies.put(values["clip_positions"], wp.vec4),
            bodies.put(values["uvs"], wp.vec2),
            bodies.topology(bodies.uv_faces),
            bodies.put(bodies.texture_of_face, wp.int32),
            mip_pyramids([bodies.put(bodies.images[0][:1], wp.vec3), bodies.put(values["images"], wp.vec3)]),
        ).numpy()

    other = values[batched] + 0.1 * random.uniform(size=values[batched].shape).astype(np.float32)
    got = albedo(values | {batched: np.concatenate([values[batched], values[batched], other])})
    alone, changed = albedo(values)[0], albedo(values | {batched: other})[0]
    assert np.abs(alone - changed).max() > 1e-3
    np.testing.assert_allclose(got, [alone, alone, changed], atol=1e-6)


def test_batches_that_do_not_fit_are_refused(device):
    bodies = Bodies(device)
    clip, uvs, vertex_albedo, *images = bodies.variables()
    images = [bodies.put(np.repeat(image[:1], 3, axis=0), wp.vec3) for image in bodies.images]
    with pytest.raises(ValueError, match="textures: got a batch of 3, expected 1 or 2"):
        bodies.albedo(clip, uvs, vertex_albedo, *images)


def test_uvs_of_no_place_are_refused(device):
    bodies = Bodies(device)
    variables = bodies.variables()
    uvs = bodies.uvs.copy()
    uvs[3, 1] = np.nan
    variables[1] = bodies.put(uvs[None], wp.vec2)
    with pytest.raises(ValueError, match=r"uvs: got 1 NaN or Inf values \(first at index \(0, 3, 1\)\)"):
        bodies.albedo(*variables)


# ---------------------------------------------------------------------------------------------------- gradients


@pytest.mark.slow
@pytest.mark.parametrize("lights", [1, 2])
def test_samples_exposed_at_once_are_albedo_times_what_they_receive_both_ways(device, poisoned_outputs, lights):
    """Against the twin in float64, in which they are linear in what reflects, and so exact differences."""
    bodies, random = Bodies(device), np.random.default_rng(5)
    width, height = bodies.size
    clip, uvs, *reflecting = bodies.variables(requires_grad=True)
    clip.requires_grad = uvs.requires_grad = False
    faces = bodies.topology(bodies.faces)
    fragments = Fragments(bodies.face_ids, find_barycentrics(bodies.face_ids, faces, clip))
    texture_of_face = bodies.put(bodies.texture_of_face, wp.int32)
    uv_faces = bodies.topology(bodies.uv_faces)
    white = random.uniform(size=(lights, height, width, 4)).astype(np.float32)
    white[..., 3] = 1.0

    def radiance(vertex_albedo, *images):
        pyramids = mip_pyramids(images)
        footprints = find_footprints(fragments, faces, clip, uvs, uv_faces, texture_of_face, pyramids)
        return textured_radiance(fragments, faces, vertex_albedo, pyramids, footprints, bodies.put(white, wp.vec4))

    def twin(*values):
        albedo = bodies.albedo_twin(bodies.clip_positions, bodies.uvs[None], *values)
        return white * np.concatenate([albedo, np.ones_like(albedo[..., :1])], axis=-1)

    values = [array.numpy().astype(np.float64) for array in reflecting]
    assert np.abs(radiance(*reflecting).numpy() - twin(*values)).max() < SAMPLE
    weights = random.normal(size=(2, height, width, 4)).astype(np.float32)
    for number, gradient in enumerate(tape_gradients(radiance, reflecting, weights)):
        directions = random.normal(size=(8, *values[number].shape))
        sums = [
            [
                np.sum(weights * twin(*values[:number], values[number] + step * d, *values[number + 1 :]))
                for d in directions
            ]
            for step in (0.5, -0.5)
        ]
        assert relative([np.sum(gradient * d) for d in directions], np.subtract(*sums)) < GRADIENT, number


def test_one_image_without_coarser_levels_is_not_copied(device):
    image = wp.array(np.random.default_rng(0).uniform(size=(1, 8, 8, 3)), dtype=wp.vec3, device=device)
    assert mip_pyramids([image], coarsest=0).texels.ptr == image.ptr
    assert mip_pyramids([image], coarsest=1).texels.ptr != image.ptr
    assert mip_pyramids([image, image], coarsest=0).texels.shape == (1, 2 * (64 + 16 + 4 + 1))


def test_a_round_footprint_has_a_gradient(device):
    """Its axes have none, seen straight on as here; what they lead to does. The width is exactly 2, of a level."""
    clip = np.float32([[[-1, -1, 0.5, 1], [1, -1, 0.5, 1], [1, 1, 0.5, 1], [-1, 1, 0.5, 1]]])
    faces = wp.array([[0, 1, 2], [0, 2, 3]], dtype=wp.vec3i, device=device)
    variables = [wp.array(clip, dtype=wp.vec4, device=device, requires_grad=True)]
    image = np.random.default_rng(0).uniform(size=(1, 32, 32, 3))
    face_ids = rasterize(variables[0], faces, 16, 16).face_ids

    def albedo(clip_positions):
        return surface_albedo(
            Fragments(face_ids, find_barycentrics(face_ids, faces, clip_positions)),
            faces,
            wp.zeros((1, 4), dtype=wp.vec3, device=device),
            clip_positions,
            wp.array([[[0, 1], [1, 1], [1, 0], [0, 0]]], dtype=wp.vec2, device=device),
            faces,
            wp.zeros(2, dtype=wp.int32, device=device),
            mip_pyramids([wp.array(image, dtype=wp.vec3, device=device)]),
        )

    np.testing.assert_allclose(albedo(*variables).numpy()[0], halved(image[0]), atol=1e-6)
    (gradient,) = tape_gradients(albedo, variables, np.random.default_rng(1).normal(size=(1, 16, 16, 3)))
    assert np.isfinite(gradient).all() and np.abs(gradient).max() > 1


def test_a_single_probe_has_no_gradient_by_the_count(device):
    image = wp.array(np.random.default_rng(0).uniform(size=(1, 8, 8, 3)), dtype=wp.vec3, device=device)
    probes = [(0.1, 0.2, 1.5, 1.0), (0.1, 0.2, 1.5, 1.5)]
    fragments, footprints = samples_of(device, np.full((2, 2), 0.3), probes)
    footprints.probes.requires_grad = True
    faces = wp.array([[0, 1, 2]], dtype=wp.vec3i, device=device)
    gray = wp.zeros((1, 3), dtype=wp.vec3, device=device)

    def albedo(_):
        return sample_albedo(fragments, faces, gray, mip_pyramids([image]), footprints)

    (gradient,) = tape_gradients(albedo, [footprints.probes], np.ones((1, 1, 2, 3)))
    single, double = gradient[0, 0]
    assert (single[[0, 1, 3]] == 0).all() and single[2] != 0
    assert (double != 0).all()


def test_a_texture_without_a_gradient_gets_none(device):
    bodies = Bodies(device)
    variables = bodies.variables()
    images = [bodies.put(image, wp.vec3, number == 1) for number, image in enumerate(bodies.images)]
    with wp.Tape() as tape:
        albedo = bodies.albedo(*variables[:3], *images)
    tape.backward(grads={albedo: wp.ones_like(albedo)})
    assert images[0].grad is None and np.abs(images[1].grad.numpy()).max() > 0


def test_playing_back_twice_doubles_the_gradients(device):
    bodies = Bodies(device)
    variables = bodies.variables(requires_grad=True)
    with wp.Tape() as tape:
        albedo = bodies.albedo(*variables)
    once, twice = [], []
    for gradients in (once, twice):
        tape.backward(grads={albedo: wp.ones_like(albedo)})
        gradients += [variable.grad.numpy().copy() for variable in variables]
        tape.zero()
    for first, second in zip(once, twice, strict=True):
        np.testing.assert_allclose(second, first, rtol=1e-5, atol=1e-5)


# ---------------------------------------------------------------------------------------------------- fits


def test_a_texture_fit_leaves_no_holes(device):
    """From one image in which a sample covers four texels across, each texel in view gets its share.

    Bilinear interpolation would have reached a quarter of them.
    """
    truth = np.random.default_rng(0).uniform(size=(64, 64, 3)).astype(np.float32)
    arguments = facing(device, 4.0, size=16, tilt=0.4)
    fragments, faces, vertex_albedo, clip, uvs, uv_faces, texture_of_face = arguments
    fitted = wp.full((1, 64, 64), wp.vec3(0.5), dtype=wp.vec3, device=device, requires_grad=True)
    target = surface_albedo(*arguments, mip_pyramids([wp.array(truth[None], dtype=wp.vec3, device=device)])).numpy()
    errors = []
    for _ in range(60):
        with wp.Tape() as tape:
            albedo = surface_albedo(*arguments, mip_pyramids([fitted]))
        residual = albedo.numpy() - target
        errors.append(np.mean(residual**2))
        tape.backward(grads={albedo: wp.array(residual, dtype=wp.vec3, device=device)})
        gradient = fitted.grad.numpy().copy()
        tape.zero()
        fitted.assign(fitted.numpy() - 12.0 * gradient)
    assert errors[-1] < 1e-3 * errors[0]

    footprints = find_footprints(fragments, faces, clip, uvs, uv_faces, texture_of_face, mip_pyramids([fitted]))
    u, v = footprints.uvs.numpy()[footprints.texture_ids.numpy() >= 0].astype(np.float64).T
    (weights,) = seen_texels(mip_pyramids([fitted]), footprints)
    x, y = (u % 1) * 64, ((1 - v) % 1) * 64
    offset = np.arange(-1, 2)  # what lies within half a sample of one's center is in view
    rows, columns = np.meshgrid(offset, offset)
    in_view = np.zeros((64, 64), bool)
    in_view[np.add.outer(y, rows).astype(int) % 64, np.add.outer(x, columns).astype(int) % 64] = True
    assert in_view.mean() > 0.4
    assert (weights[0][in_view] > 0).all()
    assert (np.abs(fitted.numpy()[0] - 0.5).max(axis=-1)[in_view] > 0).all()

    points = Footprints(footprints.texture_ids, footprints.uvs, wp.full_like(footprints.probes, wp.vec4(0, 0, 1, 1)))
    (weights,) = seen_texels(mip_pyramids([fitted]), points)
    assert (weights[0][in_view] == 0).mean() > 0.3


@pytest.mark.slow
@pytest.mark.parametrize("texels_a_sample", [1.0, 1.4, 2.0, 2.7, 4.0, 5.7])
@pytest.mark.parametrize("tilt", [0.0, 0.8, 1.3])
def test_no_texel_between_samples_is_missed(device, texels_a_sample, tilt):
    """A plane that covers the texture many times over: whatever the footprints, their probes leave no gap."""
    arguments = facing(device, texels_a_sample, size=96, tilt=tilt)
    fragments, faces, _, clip, uvs, uv_faces, texture_of_face = arguments
    pyramids = mip_pyramids([wp.zeros((1, 64, 64), dtype=wp.vec3, device=device)])
    footprints = find_footprints(fragments, faces, clip, uvs, uv_faces, texture_of_face, pyramids)
    shown = footprints.texture_ids.numpy()[0] >= 0
    inner = shown.copy()
    inner[1:-1, 1:-1] &= shown[:-2, 1:-1] & shown[2:, 1:-1] & shown[1:-1, :-2] & shown[1:-1, 2:]
    uv = footprints.uvs.numpy()[0]
    (weights,) = seen_texels(pyramids, footprints)
    # points between neighboring samples, all within the image
    between = np.concatenate(
        [
            (
                (1 - s) * (1 - t) * uv[:-1, :-1]
                + s * (1 - t) * uv[:-1, 1:]
                + (1 - s) * t * uv[1:, :-1]
                + s * t * uv[1:, 1:]
            )[shown[:-1, :-1] & shown[1:, :-1] & shown[:-1, 1:] & shown[1:, 1:]]
            for s in np.linspace(0, 1, 8)
            for t in np.linspace(0, 1, 8)
        ]
    )
    row = np.floor((1 - between[:, 1]) * 64).astype(int) % 64
    column = np.floor(between[:, 0] * 64).astype(int) % 64
    assert len(row) > 10000
    assert (weights[0][row, column] > 0).all()


def test_weights_of_texels_are_the_gradient_of_the_images_sum(device):
    bodies = Bodies(device)
    clip, uvs, vertex_albedo, *images = bodies.variables()
    images = [bodies.put(image, wp.vec3, requires_grad=True) for image in bodies.images]
    faces = bodies.topology(bodies.faces)
    fragments = Fragments(bodies.face_ids, find_barycentrics(bodies.face_ids, faces, clip))
    pyramids = mip_pyramids(images)
    uv_faces = bodies.topology(bodies.uv_faces)
    texture_of_face = bodies.put(bodies.texture_of_face, wp.int32)
    footprints = find_footprints(fragments, faces, clip, uvs, uv_faces, texture_of_face, pyramids)
    weights = seen_texels(pyramids, footprints)
    ones = np.ones((2, *bodies.size[::-1], 3))
    gradients = tape_gradients(lambda *images: bodies.albedo(clip, uvs, vertex_albedo, *images), images, ones)
    seen = bodies.face_ids.numpy()
    for number in (0, 1):
        np.testing.assert_allclose(weights[number].sum(axis=0), gradients[number][..., 0].sum(axis=0), atol=1e-5)
        count = np.sum((seen >= 0) & (bodies.texture_of_face[seen] == number))
        assert weights[number].sum() == pytest.approx(count, rel=1e-5)


def test_texels_out_of_view_weigh_nothing(device):
    """Of a texture of 64 x 64 texels a magnified view of 24 x 24 samples shows those around its middle."""
    fragments, faces, _, clip, uvs, uv_faces, texture_of_face = facing(device, 0.4)
    pyramids = mip_pyramids([wp.zeros((1, 64, 64), dtype=wp.vec3, device=device)])
    footprints = find_footprints(fragments, faces, clip, uvs, uv_faces, texture_of_face, pyramids)
    (weights,) = seen_texels(pyramids, footprints)
    distance = np.abs(np.arange(64) + 0.5)  # uvs are 0 in the middle of the image, and repeat
    distance = np.minimum(distance, 64 - distance)
    is_in_view = distance < 0.4 * 11.5 + 1  # a texel reaches from the outermost samples
    np.testing.assert_array_equal(weights[0] > 0, is_in_view[:, None] & is_in_view)


# ---------------------------------------------------------------------------------------------------- export


def test_unseen_texels_take_the_color_of_the_nearest_seen_one():
    random = np.random.default_rng(0)
    colors = random.uniform(size=(9, 12, 3)).astype(np.float32)
    weights = np.where(random.uniform(size=(9, 12)) < 0.2, random.uniform(size=(9, 12)), 0)
    filled = fill_unseen(colors, weights)
    seen = np.argwhere(weights > 0)
    for texel in np.ndindex(9, 12):
        distances = np.linalg.norm(seen - texel, axis=1)
        nearest = seen[distances <= distances.min() + 1e-9]
        assert any((filled[texel] == colors[tuple(place)]).all() for place in nearest)


def test_nothing_seen_is_nothing_filled():
    colors = np.random.default_rng(0).uniform(size=(4, 5, 3))
    np.testing.assert_array_equal(fill_unseen(colors, np.zeros((4, 5))), colors)


def test_weights_of_another_size_are_refused():
    with pytest.raises(ValueError, match=r"weights: got shape \(5, 4\), expected \[4, 5\]"):
        fill_unseen(np.zeros((4, 5, 3)), np.zeros((5, 4)))


@pytest.mark.parametrize(("name", "tolerance"), [("texture.exr", 0.0), ("texture.png", 0.5 / 255 * 2.3)])
def test_a_texture_survives_its_file_the_right_way_up(tmp_path, device, name, tolerance):
    """Row 0 of the file is at v = 1; a PNG is encoded in sRGB, whose code is up to 2.3 times as dense as the values."""
    image = np.random.default_rng(0).uniform(size=(6, 7, 3)).astype(np.float32)
    write_image(tmp_path / name, image)
    back = read_image(tmp_path / name)
    assert np.abs(back - image).max() <= tolerance
    top_left = sampled(device, back, *samples_of(device, [0.5 / 7, 1 - 0.5 / 6]))
    assert np.abs(top_left - image[0, 0]).max() <= tolerance + 1e-6
