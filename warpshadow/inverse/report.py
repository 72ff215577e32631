"""Reports: what a fit found, as files and pictures."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from warpshadow.image import linear_to_srgb, write_image
from warpshadow.inverse.descent import Result
from warpshadow.inverse.preview import white_of, write_picture
from warpshadow.light import EnvironmentMap
from warpshadow.scene import Body
from warpshadow.sh import reconstruct_map
from warpshadow.spheres import Spheres

_MAP_HEIGHT = 64  # of a map of spherical harmonics [pixels]


def write_result(result: Result, folder: str | Path) -> list[Path]:
    """Write what a fit found.

    Args:
        result: The result.
        folder: Made if it is not there. It gets parameters.toml (numbers to read), parameters.npz (all values, as the
            fit holds them), body_N.obj with body_N.exr and body_N.png for each body whose shape or texture was
            free, light.exr where the light was, before.png and after.png beside target.png, and loss.png where
            matplotlib is installed.

    Returns:
        The files.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    found, names = result.found, set(result.values)
    written = [_write_parameters(result, folder / "parameters.toml")]
    flat: dict[str, Any] = {
        f"{name}.{key}": tensor.cpu().numpy() for name, own in result.values.items() for key, tensor in own.items()
    }
    np.savez(folder / "parameters.npz", **flat)
    written.append(folder / "parameters.npz")
    for number, body in enumerate(found.scene.bodies):
        if names & {f"{kind}[{number}]" for kind in ("texture", "deformation", "radii")}:
            written += _write_body(body, folder / f"body_{number}")
    if "light" in names:
        light = found.scene.light
        pixels = light.radiance if isinstance(light, EnvironmentMap) else reconstruct_map(light, _MAP_HEIGHT)
        write_image(folder / "light.exr", pixels.astype(np.float32))
        written.append(folder / "light.exr")
    targets = np.stack([target.image[..., :3] for target in result.problem.targets])
    pictures = {"target": targets, "before": result.images_at_start(), "after": result.images()}
    for name, images in pictures.items():
        encoded = linear_to_srgb(np.clip(np.concatenate(list(images), axis=1)[..., :3] / white_of(targets), 0, 1))
        write_picture(folder / f"{name}.png", encoded)
        written.append(folder / f"{name}.png")
    return written + plot_losses(result, folder / "loss.png")


def _write_parameters(result: Result, path: Path) -> Path:
    import tomli_w

    found, names = result.found, set(result.values)
    losses = result.losses[-1]
    tables: dict = {
        "fit": {
            "reason": result.reason,
            "iterations": sum(map(len, result.losses)),
            "loss": min(losses) if losses else float("nan"),
            "milliseconds_per_iteration": round(1e3 * result.seconds, 3),
        }
    }
    if "light" in names:
        light = found.scene.light
        tables["light"] = {"envmap": "light.exr"} if isinstance(light, EnvironmentMap) else {"sh": light.tolist()}
    if "exposure" in names:
        tables["exposure"] = {"factors": found.exposures}
    if "camera" in names:
        tables["camera"] = [
            {
                "intrinsics": camera.intrinsics.tolist(),
                "rotation": camera.rotation.tolist(),
                "translation": camera.translation.tolist(),
            }
            for camera in found.cameras
        ]
    bodies = []
    for number, body in enumerate(found.scene.bodies):
        table: dict = {}
        if f"pose[{number}]" in names:
            table |= {
                "rotation": list(map(float, body.rotation)),
                "translation": list(map(float, body.translation)),
                "scale": float(body.scale),
            }
        if f"albedo[{number}]" in names and np.ndim(body.albedo) == 1:
            table["albedo"] = list(map(float, body.albedo))
        if names & {f"{kind}[{number}]" for kind in ("texture", "deformation", "radii")}:
            table["mesh"] = f"body_{number}.obj"
        if f"texture[{number}]" in names:
            table["texture"] = f"body_{number}.exr"
        if table:
            bodies.append({"number": number, **table})
    if bodies:
        tables["body"] = bodies
    path.write_text(tomli_w.dumps(tables))
    return path


def _write_body(body: Body, stem: Path) -> list[Path]:
    """A body's mesh in its own space, its spheres, and its texture, which the mesh's material names."""
    mesh_file = stem.with_suffix(".obj")
    body.mesh.write(mesh_file)
    written = [mesh_file]
    if isinstance(body.blockers, Spheres) and len(body.blockers):
        np.savez(stem.with_suffix(".npz"), centers=body.blockers.centers, radii=body.blockers.radii)
        written.append(stem.with_suffix(".npz"))
    if body.texture is not None:
        for suffix in (".exr", ".png"):
            write_image(stem.with_suffix(suffix), body.texture)
            written.append(stem.with_suffix(suffix))
        material = stem.with_suffix(".mtl")
        material.write_text(f"newmtl textured\nKd 1 1 1\nmap_Kd {stem.name}.png\n")
        mesh_file.write_text(f"mtllib {material.name}\nusemtl textured\n" + mesh_file.read_text())
        written.append(material)
    return written


def plot_losses(result: Result, path: str | Path) -> list[Path]:
    """Plot the loss of each iteration, a color for each stage; nothing, with a warning, without matplotlib."""
    try:
        import matplotlib
    except ImportError:
        warnings.warn(f"{path}: not drawn, since matplotlib is not installed (the extra 'plot')", stacklevel=2)
        return []
    matplotlib.use("agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6, 4), layout="constrained")
    first = 0
    for number, losses in enumerate(result.losses):
        axes.semilogy(range(first, first + len(losses)), losses, label=f"stage {number + 1}")
        first += len(losses)
    axes.set_xlabel("iteration")
    axes.set_ylabel(f"loss ({result.problem.loss.kind})")
    if len(result.losses) > 1:
        axes.legend()
    figure.savefig(path, dpi=120)
    pyplot.close(figure)
    return [Path(path)]
