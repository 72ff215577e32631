"""Light from a shell: beams to it, and transfer vectors, against the formulas in NumPy."""

import numpy as np
import pytest
import warp as wp

from warpshadow.maths.directions import cell_radius, fibonacci
from warpshadow.stages.light.light_samples import cut_map, sample_map
from warpshadow.stages.ray_traced.shared_rays import trace_shared
from warpshadow.stages.ray_traced.traced_transfer import trace_transfer
from warpshadow.stages.rays.ray_packets import build_face_tree
from warpshadow.stages.rays.ray_tracing import trace_shading
from warpshadow.stages.shell.shell_rays import check_within, exits_from_shell, exits_on_host
from warpshadow.stages.shell.shell_transfer import SHELL_KERNEL_RADIUS, shell_transfer

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

SHELL = np.array([0.1, -0.2, 0.3, 1.4])
SHELL_DIRECTIONS, CELLS = fibonacci(64), fibonacci(32)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def receivers(count, reach=0.8, seed=0):
    """Points within a share of the shell's radius, and normals."""
    rng = np.random.default_rng(seed)
    points = SHELL[:3] + SHELL[3] * reach * unit(rng.normal(size=(count, 3))) * rng.uniform(size=(count, 1)) ** (1 / 3)
    return points, unit(rng.normal(size=(count, 3)))


def put(values, dtype, device):
    return wp.array(np.asarray(values)[None], dtype=dtype, device=device)


def twin(points, normals, transmittance, shell_directions=SHELL_DIRECTIONS):
    """Transfer vectors by the formulas of the module."""
    area = 4 * np.pi * SHELL[3] ** 2 / len(shell_directions)
    beams = SHELL[:3] + SHELL[3] * shell_directions - points[:, None]
    lengths = np.linalg.norm(beams, axis=2)
    above, facing = (beams * normals[:, None]).sum(axis=2), (beams * shell_directions).sum(axis=2)
    factors = area * np.maximum(above, 0) * np.maximum(facing, 0)
    factors /= lengths**2 * np.sqrt(np.pi**2 * lengths**4 + area**2)
    if transmittance is None:
        return factors
    towards = beams / lengths[..., None]
    radius = cell_radius(len(CELLS))
    kernel = np.maximum(towards @ CELLS.T - np.cos(SHELL_KERNEL_RADIUS * radius), 0) ** 2
    height = np.clip((normals @ CELLS.T) / radius / 2 + 0.5, 0, 1)
    horizon = (height**2 * (3 - 2 * height))[:, None]
    through = (kernel * np.minimum(transmittance[:, None], horizon)).sum(axis=2)
    return factors * through / np.maximum((kernel * horizon).sum(axis=2), 1e-9)


@pytest.mark.parametrize("is_blocked", [False, True])
def test_transfer_vectors_are_those_of_the_formulas(is_blocked, device):
    points, normals = receivers(20)
    transmittance = np.random.default_rng(1).uniform(size=(20, 32)) if is_blocked else None
    past = None if transmittance is None else put(transmittance, wp.float32, device)
    shell = put(SHELL, wp.vec4, device)
    vectors = put(points, wp.vec3, device), put(normals, wp.vec3, device)
    found = shell_transfer(*vectors, past, CELLS, shell, SHELL_DIRECTIONS).numpy()[0]
    expected = twin(points, normals, transmittance)
    np.testing.assert_allclose(found, expected, atol=2e-4 * expected.max())  # ε of the kernel


def test_even_light_of_a_shell_is_the_same_everywhere_within_it(device):
    points, normals = receivers(500)
    vectors = put(points, wp.vec3, device), put(normals, wp.vec3, device)
    light = shell_transfer(*vectors, None, CELLS, put(SHELL, wp.vec4, device), fibonacci(512)).numpy()[0].sum(axis=1)
    assert np.abs(light - 1).mean() < 0.01  # measured: 0.003
    assert np.abs(light - 1).max() < 0.06


def test_transfer_from_a_large_shell_is_that_from_infinitely_far(device):
    points, normals = receivers(20)
    vectors = put(points, wp.vec3, device), put(normals, wp.vec3, device)
    found = shell_transfer(*vectors, None, CELLS, put([0, 0, 0, 1e5], wp.vec4, device), SHELL_DIRECTIONS).numpy()[0]
    area = 4 / len(SHELL_DIRECTIONS)
    expected = area * np.maximum(normals @ SHELL_DIRECTIONS.T, 0) / np.sqrt(1 + (area * 1.0) ** 2)
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_rays_leave_the_shell_where_lines_meet_it(device):
    points, directions = receivers(30, reach=0.95)
    exits = exits_from_shell(
        put(points, wp.vec3, device), put(directions[:, None], wp.vec3, device), put(SHELL, wp.vec4, device)
    ).numpy()[0, :, 0]
    np.testing.assert_allclose(exits, exits_on_host(points, directions, SHELL), atol=1e-5)
    along = SHELL[:3] + SHELL[3] * exits - points
    np.testing.assert_allclose(unit(along), directions, atol=1e-4)


def test_all_ways_to_trace_light_of_a_shell_agree_with_a_sum_over_its_pixels(device):
    """In a light that differs from place to place."""
    radiance = np.ones((32, 64, 3), np.float32)
    radiance[:16, :32] += (5, 2, 1)
    points, normals = receivers(100, reach=0.6)
    theta, phi = np.pi * (np.arange(32) + 0.5) / 32, np.pi * (np.arange(64) + 0.5) / 32
    theta, phi = np.meshgrid(theta, phi, indexing="ij")
    towards = np.stack([np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)], axis=2)
    solid_angles = (np.pi / 32) ** 2 * np.sin(theta)
    beams = SHELL[:3] + SHELL[3] * towards.reshape(-1, 3) - points[:, None]
    lengths = np.linalg.norm(beams, axis=2)
    weights = SHELL[3] ** 2 * np.maximum((beams * towards.reshape(-1, 3)).sum(axis=2), 0) / lengths**3
    cosines = np.maximum((beams * normals[:, None]).sum(axis=2), 0) / lengths
    expected = (weights * cosines * solid_angles.ravel() / np.pi) @ radiance.reshape(-1, 3)
    at = wp.array(points, dtype=wp.vec3, device=device), wp.array(normals, dtype=wp.vec3, device=device)
    shell = SHELL.astype(np.float32)
    tree = build_face_tree(np.zeros((0, 3)), np.zeros((0, 3), np.int32), device)

    def light(directions):
        row, column = np.arccos(directions[:, 1]), np.arctan2(directions[:, 0], -directions[:, 2]) % (2 * np.pi)
        return radiance[np.minimum(row / np.pi * 32, 31).astype(int), np.minimum(column / np.pi * 32, 63).astype(int)]

    found = {
        "independent": trace_shading(None, *at, sample_map(radiance, 4096), shell=shell).numpy(),
        "shared": trace_shared(tree, *at, cut_map(radiance, 512), shell=shell).numpy(),
        "transfer": trace_transfer(None, *at, light, 16384, shell=shell).numpy(),
    }
    for name, each in found.items():
        error = np.linalg.norm(each - expected) / np.linalg.norm(expected)
        assert error < 0.01, (name, error)


def test_receivers_outside_of_the_shell_are_refused(device):
    shell = put(SHELL, wp.vec4, device)
    check_within(put([SHELL[:3] + (1.3, 0, 0)], wp.vec3, device), shell)
    with pytest.raises(ValueError, match=r"shell: got receivers 1\.071 radii from its center"):
        check_within(put([SHELL[:3] + (1.5, 0, 0)], wp.vec3, device), shell)
