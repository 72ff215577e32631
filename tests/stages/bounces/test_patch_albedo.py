"""Albedo of patches: means of vertex colors and textures, against float64 sums over pieces and texels."""

import numpy as np
import pytest

import warpshadow as ws
from warpshadow.stages.bounces.albedo import mean_over_texels, mean_over_vertices
from warpshadow.stages.patches import find_patches, find_plane_patches

EXACT = 1e-6
"""Weights are float64, and barycentric coordinates of pieces float32."""

RANDOM = np.random.default_rng(0)


def test_colors_of_vertices_have_the_mean_of_their_interpolation_over_each_patch():
    mesh = ws.icosphere(1.0, 3)
    patches = find_patches(mesh.positions, mesh.surface.faces, is_two_sided=False, count=64)
    colors = RANDOM.uniform(size=(mesh.vertex_count, 3))
    faces, pieces = mesh.surface.faces, patches.pieces
    found = mean_over_vertices(patches, mesh.positions, faces) @ colors
    sums, areas = np.zeros((patches.count, 3)), np.zeros(patches.count)
    for face, corners, patch in zip(
        pieces.faces, pieces.corners.astype(float), patches.patch_of_pieces[0], strict=True
    ):
        points, shades = (corners @ values[faces[face]].astype(float) for values in (mesh.positions, colors))
        area = np.linalg.norm(np.cross(points[1] - points[0], points[2] - points[0])) / 2
        sums[patch] += area * shades.mean(axis=0)
        areas[patch] += area
    np.testing.assert_allclose(found, sums / areas[:, None], atol=EXACT)


def texture_means(patches, mesh, texture):
    surface = mesh.surface
    given = mesh.positions, surface.faces, mesh.uvs, surface.uv_faces, texture.shape[:2]
    return mean_over_texels(patches, *given) @ texture.reshape(-1, 3)


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (64, 64)])
@pytest.mark.parametrize("is_two_sided", [False, True])
def test_a_texture_of_one_color_has_that_on_every_patch(size, is_two_sided):
    mesh = ws.plane((2.0, 1.0), 8)
    patches = find_plane_patches(mesh.positions, mesh.surface.faces, is_two_sided=is_two_sided)
    found = texture_means(patches, mesh, np.full((*size, 3), 0.3, np.float32))
    np.testing.assert_allclose(found[patches.areas > 0], 0.3, atol=EXACT)


def test_a_texture_has_its_mean_over_each_patch():
    mesh = ws.plane((2.0, 1.0), 8)
    patches = find_plane_patches(mesh.positions, mesh.surface.faces, is_two_sided=False)
    height, width = 256, 512
    u, v = (np.arange(width) + 0.5) / width, 1 - (np.arange(height) + 0.5) / height
    wave = 0.5 + 0.4 * np.sin(6 * np.pi * u) * np.cos(4 * np.pi * v)[:, None]
    image = wave + 0.1 * (1 - 2 * (np.indices(wave.shape).sum(axis=0) % 2))  # texels of a checkerboard
    found = texture_means(patches, mesh, np.repeat(image[..., None], 3, axis=2).astype(np.float32))[:, 0]
    # the truth: texels go to the node in whose rectangle they lie; uvs are linear in the plane
    uvs, corners = (
        values[indices].reshape(-1, values.shape[1]).astype(float)
        for values, indices in ((mesh.uvs, mesh.surface.uv_faces), (mesh.positions, mesh.surface.faces))
    )
    to_plane = np.linalg.lstsq(np.c_[uvs, np.ones(len(uvs))], corners, rcond=None)[0]
    points = np.stack([*np.meshgrid(u, v), np.ones(wave.shape)], axis=-1).reshape(-1, 3) @ to_plane
    grid = patches.grid
    nodes = grid.texels_of((points - grid.origin) @ grid.frame[:2].T)
    counts = np.bincount(nodes, minlength=patches.count)
    truth = np.bincount(nodes, image.ravel(), patches.count) / np.maximum(counts, 1)
    assert np.abs(found - truth)[counts > 0].max() < 0.05  # pieces are not cut along the borders of nodes
    assert abs(np.average(found, weights=patches.areas) - image.mean()) < 0.002


def test_a_texture_repeats_outside_of_the_unit_square():
    mesh = ws.plane((2.0, 1.0), 8)
    moved = ws.Mesh(mesh.positions, mesh.faces, uvs=mesh.uvs + 3, uv_faces=mesh.uv_faces)
    patches = find_plane_patches(mesh.positions, mesh.surface.faces, is_two_sided=False)
    texture = RANDOM.uniform(size=(16, 32, 3)).astype(np.float32)
    np.testing.assert_allclose(texture_means(patches, moved, texture), texture_means(patches, mesh, texture), atol=1e-5)
