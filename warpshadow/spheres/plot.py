"""A picture of spheres in their mesh."""

import numpy as np

from warpshadow import check
from warpshadow.assets import files
from warpshadow.assets.mesh import Mesh
from warpshadow.check import AnyPath
from warpshadow.spheres.sphere_set import Spheres


def check_matplotlib() -> None:
    """Raise ImportError unless matplotlib is installed."""
    check.importable("matplotlib", "a picture of spheres", "matplotlib", "plot")


def plot_spheres(mesh: Mesh, spheres: Spheres, path: AnyPath) -> None:
    """Draw the spheres inside the translucent mesh, from two sides.

    Raises:
        ImportError: when matplotlib, the extra ``plot``, is not installed.
    """
    check_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    upright = [0, 2, 1]  # matplotlib's z is up
    figure = Figure(figsize=(12, 6), layout="constrained")
    FigureCanvasAgg(figure)
    low, high = mesh.positions.min(axis=0), mesh.positions.max(axis=0)
    box_center, half = (low + high) / 2, 0.5 * (high - low).max()
    azimuth, polar = np.meshgrid(np.linspace(0, 2 * np.pi, 25), np.linspace(0, np.pi, 13))
    ball = np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)])
    stride = max(1, len(mesh.faces) // 6000)
    for subplot, turn in enumerate((-60, 30)):
        axes = figure.add_subplot(1, 2, subplot + 1, projection="3d")
        triangles = mesh.positions[mesh.faces[::stride]][:, :, upright] * [1, -1, 1]
        axes.add_collection3d(Poly3DCollection(triangles, facecolors="0.5", alpha=0.12))
        for center, radius in zip(spheres.centers[:, upright] * [1, -1, 1], spheres.radii, strict=True):
            axes.plot_surface(*(center[:, None, None] + radius * ball), color="tab:orange", alpha=0.6, linewidth=0)
        for set_limits, axis, sign in ((axes.set_xlim, 0, 1), (axes.set_ylim, 2, -1), (axes.set_zlim, 1, 1)):
            set_limits(sign * box_center[axis] - half, sign * box_center[axis] + half)
        axes.set_box_aspect((1, 1, 1))
        axes.view_init(elev=15, azim=turn)
        axes.set_axis_off()
    figure.suptitle(f"{mesh.name}: {len(spheres)} spheres")
    with files.atomic_write(path) as unfinished:
        figure.savefig(unfinished, dpi=110)
