"""Bound spheres: where vertices go, their spheres follow; gradients against central differences of a float64 twin."""

import numpy as np
import pytest
import torch
import warp as wp
from scipy.spatial.transform import Rotation

import warpshadow as ws
from warpshadow.stages.geometry.bound_spheres import SphereBinding
from warpshadow.torch import TorchRenderer

pytestmark = pytest.mark.usefixtures("poisoned_outputs")

FLOAT32 = 2e-6
GRADIENT = 1e-3
# Of the length of the body: the ridge of the weights, by which spheres follow rotations not quite.
FOLLOWED = 0.002


def rod(sphere_count: int = 12) -> tuple[ws.Mesh, ws.Spheres]:
    """A rod along x of a length of 4, and spheres inside it, off its axis."""
    mesh = ws.icosphere(1.0, 3).transformed(scale=(2.0, 0.3, 0.3))
    x = np.linspace(-1.7, 1.7, sphere_count)
    centers = np.stack([x, 0.05 * np.cos(7 * x), 0.05 * np.sin(7 * x)], axis=1)
    return mesh, ws.Spheres(centers, 0.25 * np.sqrt(1 - (x / 2) ** 2))


def bent(points: np.ndarray, radius: float = 2.5) -> np.ndarray:
    """Points of a rod along x, wound around a circle."""
    angle, distance = points[..., 0] / radius, radius - points[..., 1]
    return np.stack([distance * np.sin(angle), radius - distance * np.cos(angle), points[..., 2]], axis=-1)


def put(values, dtype, device, requires_grad=False):
    return wp.array(np.asarray(values, np.float32), dtype=dtype, device=device, requires_grad=requires_grad)


def bound(mesh, spheres, device) -> tuple[SphereBinding, tuple[wp.array, ...]]:
    given = mesh.positions, np.unique(mesh.faces), spheres.centers, spheres.radii
    binding = SphereBinding.bind(*given, device=device)
    rest = mesh.positions[None], spheres.centers[None], spheres.radii[None]
    return binding, tuple(map(put, rest, (wp.vec3, wp.vec3, wp.float32), [device] * 3))


@pytest.mark.parametrize("sphere_count", [1, 12])
def test_spheres_follow_affine_maps_and_bends(device, sphere_count):
    mesh, spheres = rod(sphere_count)
    binding, rest = bound(mesh, spheres, device)
    turn = Rotation.from_rotvec([0.4, 1.1, -0.6]).as_matrix()
    maps = {
        "nowhere": (lambda p: p, 1.0, 0.0),
        "translated": (lambda p: p + [3, -1, 2], 1.0, FLOAT32),
        "turned": (lambda p: p @ turn.T + [0, 1, 0], 1.0, FOLLOWED),
        "scaled": (lambda p: 1.7 * p, 1.7, FOLLOWED),
    }
    if sphere_count > 1:
        maps["bent"] = (bent, 1.0, 3 * FOLLOWED)
    for name, (function, factor, tolerance) in maps.items():
        positions = put(function(mesh.positions.astype(np.float64))[None], wp.vec3, device)
        centers, radii = (array.numpy()[0] for array in binding.moved(positions, *rest))
        assert np.abs(centers - function(spheres.centers)).max() <= 4 * tolerance, name
        bends = 0.03 if name == "bent" else tolerance
        assert np.abs(radii / (factor * spheres.radii) - 1).max() <= bends, name


@pytest.fixture(scope="module")
def renderer() -> TorchRenderer:
    mesh, spheres = rod()
    body = ws.Body(mesh, blockers=spheres, translation=(0, 0.8, 0))
    camera = ws.Camera.look_at((0, 5, 5), (0, 0.4, 0), size=(48, 48))
    scene = ws.Scene([body, ws.Body(ws.plane(8.0, 32), blockers=0)], ws.synthetic_sky(sun_radius=12), camera)
    return TorchRenderer(scene)


def test_the_shadow_of_free_vertices_is_that_of_the_moved_spheres(renderer):
    mesh, spheres = rod()

    def image(*spheres: np.ndarray) -> torch.Tensor:
        given = (torch.tensor(values, dtype=torch.float32) for values in (bent(mesh.positions), *spheres))
        return renderer(geometry=renderer.placed(*renderer.scene_poses(), rest=renderer.deformed(0, *given)))

    expected = image(bent(spheres.centers), spheres.radii)
    left, followed = (image(spheres.centers) - expected).abs().mean(), (image() - expected).abs().mean()
    assert followed < 0.05 * left


def test_all_vertices_have_the_gradient_of_a_translation_shadow_included(renderer):
    rotations, translations, scales = renderer.scene_poses()
    mesh, spheres = rod()
    positions, centers, radii = (torch.tensor(part) for part in (mesh.positions, spheres.centers, spheres.radii))

    def gradient(moved: torch.Tensor, translations: torch.Tensor, *shape: torch.Tensor) -> torch.Tensor:
        geometry = renderer.placed(rotations, translations, scales, rest=renderer.deformed(0, *shape))
        return torch.autograd.grad(renderer(geometry=geometry)[..., :3].square().sum(), moved)[0]

    translations.requires_grad_(), positions.requires_grad_()
    expected = gradient(translations, translations, positions.detach(), centers.float(), radii.float())[0]
    found = gradient(positions, translations.detach(), positions).sum(0)
    torch.testing.assert_close(found, expected, rtol=GRADIENT, atol=GRADIENT * float(expected.abs().max()))
    still = gradient(positions, translations.detach(), positions, centers.float()).sum(0)  # as the shadow stays
    assert (still - expected).abs().max() > 0.1 * expected.abs().max()
