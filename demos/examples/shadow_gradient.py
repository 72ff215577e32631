"""A shadow seen alone moves what casts it: derivatives of each pixel by the adjoint against finite differences.

    python demos/examples/shadow_gradient.py [--output out] [--size 48]

The camera sees nothing but a patch of ground, and on it the shadow of a bunny that is out of view, under a sun. Every
pixel's derivatives with respect to the bunny's x, z and scale come from one backward pass for each pixel, and are laid
beside central differences of the image. Then the bunny is shifted on the level, and steepest descent of the loss, which
sees the shadow alone, is compared with the way there. (It leans to the way across a long shadow, which moves more of
its edge; so the bunny is turned until its shadow is about as wide as long.)
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import torch

sys.path.append(str(Path(__file__).parents[2]))  # the folder of demos
import warpshadow as ws
from demos.scenes import shipped_mesh
from warpshadow.torch import TorchRenderer

PARAMETERS = ("x", "z", "scale")
STEP = 2e-3  # of central differences [scene units], and of scale; smaller ones show float32's rounding
SHIFT = 0.05  # scene units; the shadow is about 1 wide
SUN = np.array([-0.64, 0.77, 0.0])
BUNNY = 1.3 * SUN / SUN[1]  # its middle, 1.3 units above that of its shadow, the origin
LUMINANCE = torch.tensor([0.2126, 0.7152, 0.0722])


class Shadow:
    """The luminance of the ground as a function of the (x, z, scale) of the spheres that shade it.

    The bunny is out of view, so that its spheres alone stand for it; a small mesh carries them, whose few vertices make
    a backward pass as cheap as the ground is.

    Args:
        spheres: What casts the shadow, about 1 unit large around the origin.
        size: Width and height of the image [pixels].
    """

    def __init__(self, spheres: ws.Spheres, size: int):
        blocker = ws.Body(ws.icosphere(0.1, 0), blockers=spheres, rotation=(0, 90, 0), translation=BUNNY)
        ground = ws.Body(ws.plane(2.4, 24), blockers=0, receivers="pixel")  # others leap where squares are cut
        sky = ws.synthetic_sky(SUN, sun_radius=6.0)
        camera = ws.Camera.look_at((0, 2.2, 0), (0, 0, 0), up=(0, 0, -1), fov_y=44, size=(size, size))
        self.renderer = TorchRenderer(ws.Scene((blocker, ground), sky, camera, supersampling=1))
        self.start = torch.tensor([BUNNY[0], BUNNY[2], 1.0], dtype=torch.float32)

    def __call__(self, values: torch.Tensor) -> torch.Tensor:
        """Luminance of each pixel, [height, width], for values (x, z, scale)."""
        return self.image(values)[..., :3] @ LUMINANCE

    def image(self, values: torch.Tensor) -> torch.Tensor:
        """The image, [height, width, 4], for values (x, z, scale)."""
        rotations, translations, scales = self.renderer.scene_poses()
        x, z, scale = values
        moved = torch.stack([torch.stack([x, translations[0, 1], z]), translations[1]])
        geometry = self.renderer.placed(rotations, moved, torch.stack([scale, scales[1]]))
        return self.renderer(geometry=geometry)


def by_adjoint(shadow: Shadow) -> torch.Tensor:
    """Derivatives of each pixel's luminance, [height, width, parameter]: a backward pass for each pixel."""
    return torch.autograd.functional.jacobian(shadow, shadow.start)


def by_differences(shadow: Shadow) -> torch.Tensor:
    """The same, by central differences of the image."""
    ends = [[shadow(shadow.start + sign * STEP * axis) for sign in (1, -1)] for axis in torch.eye(len(PARAMETERS))]
    return torch.stack([(right - left) / (2 * STEP) for right, left in ends], dim=-1)


def relative_errors(got: torch.Tensor, expected: torch.Tensor) -> torch.Tensor:
    """Relative L2 error of the image of derivatives for each parameter."""
    return torch.linalg.norm(got - expected, dim=(0, 1)) / torch.linalg.norm(expected, dim=(0, 1))


def cosines(shadow: Shadow, angles: torch.Tensor) -> torch.Tensor:
    """Cosine between the way to a shifted target and the steepest descent of the squared difference of images.

    Args:
        shadow: What descends, from its start.
        angles: Of the shifts on the ground [radians], shape [shift].
    """
    found = []
    for angle in angles:
        way = torch.stack([torch.cos(angle), torch.sin(angle), torch.zeros(())])
        with torch.no_grad():
            target = shadow(shadow.start + SHIFT * way)
        values = shadow.start.clone().requires_grad_()
        (gradient,) = torch.autograd.grad((shadow(values) - target).square().sum(), values)
        found.append(torch.cosine_similarity(-gradient[:2], way[:2], dim=0))
    return torch.stack(found)


def bunny_spheres(count: int = 64) -> ws.Spheres:
    """Spheres of the bunny that ships with Warp, 1 unit large around the origin."""
    mesh = shipped_mesh("bunny")
    low, high = mesh.bounds
    scale = 1 / (high - low).max()
    spheres = ws.fit_spheres(mesh, count).spheres
    return spheres.transformed(rotation=np.eye(3), translation=-scale * (low + high) / 2, scale=scale)


def main(output: Path, size: int) -> None:
    ws.quiet()
    shadow = Shadow(bunny_spheres(), size)
    start = time.perf_counter()
    got = by_adjoint(shadow)
    milliseconds = 1e3 * (time.perf_counter() - start) / size**2
    expected = by_differences(shadow)
    print(f"{size} × {size} backward passes, {milliseconds:.1f} ms each")
    for name, error in zip(PARAMETERS, relative_errors(got, expected), strict=True):
        print(f"d luminance / d {name}: {error:.1e} relative L2 error of the adjoint to central differences")
    aims = cosines(shadow, torch.arange(16) * torch.pi / 8)
    print(
        f"steepest descent to a shadow shifted by {SHIFT}, 16 directions: "
        f"cosine with the way there at least {aims.min():.4f}, mean {aims.mean():.4f}"
    )
    output.mkdir(parents=True, exist_ok=True)
    path = output / "shadow_gradient.png"
    plot(shadow.image(shadow.start).numpy(), got[..., 0].numpy(), expected[..., 0].numpy(), path)
    print(f"wrote {path}")


def plot(image: np.ndarray, got: np.ndarray, expected: np.ndarray, path: Path) -> None:
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    figure, row = pyplot.subplots(1, 4, figsize=(16, 4), layout="constrained")
    row[0].imshow(ws.linear_to_srgb(np.minimum(image[..., :3] / image[..., :3].max(), 1)))
    limit = np.abs(expected).max()
    panels = {"by the adjoint": got, "by differences": expected, "their difference × 10": 10 * (got - expected)}
    for axes, values in zip(row[1:], panels.values(), strict=True):
        shown = axes.imshow(values, cmap="RdBu", vmin=-limit, vmax=limit)
    figure.colorbar(shown, ax=row[1:], label="d luminance / d x")
    for axes, label in zip(row, ["the shadow", *panels], strict=True):
        axes.set_title(label)
        axes.axis("off")
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("out"), help="folder for the picture")
    parser.add_argument("--size", type=int, default=48, help="width and height of the image [pixels]")
    arguments = parser.parse_args()
    main(arguments.output, arguments.size)
