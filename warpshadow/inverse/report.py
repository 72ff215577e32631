"""Reports: the result of a fit as numbers, files and pictures."""

import json
import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warpshadow import check
from warpshadow.assets import files
from warpshadow.assets.color import auto_exposure, srgb_to_linear
from warpshadow.assets.image import write_image
from warpshadow.assets.picture import Picture
from warpshadow.check import AnyPath
from warpshadow.inverse.diagnostics import DiagnosticWarning
from warpshadow.inverse.encoding import toml_value
from warpshadow.inverse.free.base import Values
from warpshadow.inverse.model import Model, torch_on_one_thread
from warpshadow.inverse.result import Result
from warpshadow.inverse.schedule import Stage
from warpshadow.inverse.uncertainty import MAX_POSE_UNCERTAINTY
from warpshadow.inverse.world import format_numbers
from warpshadow.maths import sh
from warpshadow.scene import toml_tables
from warpshadow.scene.body import Body
from warpshadow.scene.files import camera_table, file_stems, write_scene
from warpshadow.scene.material import GLOSS_ARGUMENTS

SUMMARY = "summary.toml"  # the file of a folder of results that is written last: where it is, the others are


def write_result(result: Result, folder: AnyPath) -> list[Path]:
    """Write the result of a fit; see :meth:`Report.write`."""
    return Report(result).write(folder)


class Report:
    """The result of a fit beside its start, at the targets' own size and the scene's own softness.

    Attributes:
        before, after: Images of the views, [view, height, width, 4].
        loss_before, loss_after: With regularizers.
        pixel_weights: How much each pixel counts in the end, see :attr:`Result.pixel_weights`.
    """

    @torch_on_one_thread()
    def __init__(self, result: Result):
        self.result = result
        model = Model(result.problem, result.context, Stage())
        self.loss_before, self.before = _evaluate(model, result.problem.start(result.context))
        self.loss_after, self.after = _evaluate(model, result.values)
        images = torch.from_numpy(self.after).to(model.targets)
        self.pixel_weights = model.pixel_weights(images).cpu().numpy()

    def write(self, folder: AnyPath) -> list[Path]:
        """Write it.

        Args:
            folder: Made if it is not there. It gets the scene as :func:`warpshadow.write_scene` writes it, to be
                rendered again; light.exr of light in spherical harmonics, too; summary.toml (how the fit ended, the
                verdict, the fitted parameters that are a few numbers, and of each view the camera and the exposure,
                which a scene does not have); light.png of free light, striped where the images did not determine it;
                parameters.npz (all values, as the fit holds them); before.png and after.png beside target.png;
                weights.png, of a robust loss; and loss.png where matplotlib is installed.
        Returns:
            The files.
        """
        folder, result = Path(folder), self.result
        scene = result.scene
        written = write_scene(scene, folder, stems=file_stems(scene, _OTHER_FILES))
        light_map = folder / "light.exr"
        if light_map not in written:
            write_image(light_map, scene.known_light.radiance.astype(np.float32))
            written.append(light_map)
        values: dict[str, Any] = {
            f"{name}.{key}": item.cpu().numpy() for name, parts in result.values.items() for key, item in parts.items()
        }
        with files.atomic_write(folder / "parameters.npz") as temporary_path:
            np.savez(temporary_path, **values)
        written.append(folder / "parameters.npz")
        written += [*self._write_pictures(folder), *plot_losses(result, folder / "loss.png")]
        toml_tables.write(folder / SUMMARY, self._summary())
        return [*written, folder / SUMMARY]

    def _summary(self) -> toml_tables.Table:
        fitted, seconds = self.result.found, self.result.seconds
        fit = {
            "reason": self.result.reason,
            "iterations": sum(map(len, self.result.losses)),
            "loss_before": self.loss_before,
            "loss_after": self.loss_after,
        }
        if math.isfinite(seconds):
            fit["milliseconds_per_iteration"] = round(1e3 * seconds, 3)
        views = [
            {"exposure": factor} | camera_table(camera)
            for camera, factor in zip(fitted.cameras, fitted.exposures, strict=True)
        ]
        images: list[toml_tables.Table] = [
            {"encoding": toml_value(target.encoding), "stops": math.log2(factor)}
            for target, factor in zip(self.result.problem.targets, fitted.exposures, strict=True)
        ]
        for image, gains in zip(images, fitted.white_balances, strict=False):  # none unless they were free
            image["white_balance"] = list(gains)
        light = self.result.light
        known_entries = {} if light is None else {"light": {"undetermined": round(light.undetermined_share, 4)}}
        unsure = self._uncertainty_table()
        figures = {json.dumps(key): item if len(item) > 1 else item[0] for key, item in self.result.figures.items()}
        of_fit = {"figures": figures} if figures else {}
        verdict = self.result.verdict
        judged: toml_tables.Table = {"is_explained": verdict.is_explained, "image_error": verdict.image_error}
        judged = {key: value for key, value in judged.items() if value is not None}
        judged |= {"shown": verdict.shown} if verdict.shown else {}
        return {"fit": fit, "verdict": judged, **of_fit, **known_entries, **unsure, "view": views, "image": images}

    def _uncertainty_table(self) -> toml_tables.Table:
        """Standard deviations of poses, light and exposures; a warning for each body that hardly is where it is."""
        uncertainty = self.result.uncertainty
        if uncertainty is None:
            return {}
        table: toml_tables.Table = {}
        for name, pose in uncertainty.poses.items():
            table[name] = {"shift": pose.shift.tolist(), "turn": pose.turn, "least": str(pose)}
            if pose.is_flat:
                check.warn(
                    f"{name} is uncertain by more than {MAX_POSE_UNCERTAINTY:.0%} of its size; {pose}. "
                    "A plane that it stands on "
                    "(stands_on), a prior or another view would tell more",
                    DiagnosticWarning,
                )
        if uncertainty.light is not None:
            table["light"] = uncertainty.light
        if uncertainty.stops:
            table["stops"] = uncertainty.stops
        return {"uncertainty": table} if table else {}

    def _write_pictures(self, folder: Path) -> list[Path]:
        """Targets, and images before and after, the views side by side, at one exposure."""
        targets = np.stack([target.image[..., :3] for target in self.result.problem.targets])
        pictures = {"target": targets, "before": self.before, "after": self.after}
        exposure = auto_exposure(targets)
        for name, images in pictures.items():
            side_by_side = np.concatenate(list(images[..., :3]), axis=1)
            Picture(side_by_side, exposure=exposure).write(folder / f"{name}.png")
        written = [folder / f"{name}.png" for name in pictures]
        if self.result.problem.loss.is_robust:
            gray = srgb_to_linear(np.concatenate(list(self.pixel_weights), axis=1))  # stored as masks are
            Picture(gray, exposure=0.0).write(folder / "weights.png")
            written.append(folder / "weights.png")
        if self.result.light is not None:
            self.result.light.picture().write(folder / "light.png")
            written.append(folder / "light.png")
        return written


_OTHER_FILES = ("light", "target", "before", "after", "loss", "preview", "parameters", "weights")
"""Files of a fit whose suffixes bodies' files have, too."""


def _describe_shift(before: Body, after: Body) -> str:
    """How far the middle of a body moved: a translation is of the origin of its mesh, maybe far from it."""
    low, high = (corner.astype(np.float64) for corner in before.mesh.bounds)
    middle = (low + high) / 2
    shift = after.to_world(middle) - before.to_world(middle)
    return f" scene units, its middle moved by ({format_numbers(shift)})"


def found_values(result: Result) -> list[str]:
    """Describe the changes of a fit, a line each, their values below each other: poses, materials, exposures, light."""
    rows, start, scene = list[tuple[str, str]](), result.problem.scene, result.scene
    names = scene.unique_names
    for body_name, before, after in zip(names, start.bodies, scene.bodies, strict=True):
        for name in ("translation", "rotation", "scale", "albedo", *GLOSS_ARGUMENTS, "emission"):
            values = np.asarray(getattr(after, name))
            if (
                getattr(after, name) is not None
                and not np.array_equal(values, getattr(before, name))
                and values.size <= 3
            ):
                remark = {"rotation": "°", "translation": _describe_shift(before, after)}.get(name, "")
                rows.append((f"{body_name} {name}", f"({format_numbers(values)}){remark}"))
    if scene.light is not start.light:
        radiance = scene.known_light.radiance
        directions = sh.equirectangular_directions(len(radiance)).astype(np.float32)
        x, y, z = directions.reshape(-1, 3)[radiance.sum(axis=2).argmax()]
        rows.append(("light", f"strongest from ({x:.3f}, {y:.3f}, {z:.3f})"))
    rows += [row for free in result.problem.free for row in free.report(result.context, result.found)]
    width = max((len(name) for name, _ in rows), default=0)
    return [f"{name:{width}}  {text}" for name, text in rows]


def _evaluate(model: Model, values: dict[str, Values]) -> tuple[float, np.ndarray]:
    with torch.no_grad():
        loss, images = model.loss(values)
    assert images is not None  # only the model of light alone does without
    return float(loss), images.cpu().numpy()


def plot_losses(result: Result, path: AnyPath) -> list[Path]:
    """Plot the loss of each iteration, a color for each descent; nothing, with a warning, without matplotlib."""
    try:
        import matplotlib
    except ImportError:
        check.warn(check.missing(f"{path} is not drawn, which", "matplotlib", "plot"))
        return []
    matplotlib.use("agg")
    logging.getLogger("matplotlib.font_manager").setLevel(logging.ERROR)  # of fonts that a machine does not have
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6, 4), layout="constrained")
    first = 0
    for losses in result.losses:
        axes.semilogy(range(first, first + len(losses)), losses, marker="." if len(losses) == 1 else None)
        first += len(losses)
    axes.set_xlabel("iteration (a color for each candidate of each stage)")
    axes.set_ylabel(f"loss ({result.problem.loss.kind})")
    with files.atomic_write(path) as temporary_path:
        figure.savefig(temporary_path, dpi=120)
    pyplot.close(figure)
    return [Path(path)]
