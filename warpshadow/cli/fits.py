"""Fits, and data sets."""

import contextlib
import math
import time
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Optional

import typer

from warpshadow.cli.console import (
    DIVERGED,
    UNEXPLAINED,
    Device,
    Quiet,
    app,
    clear_errors,
    device_of,
    note,
    report_interrupt,
)
from warpshadow.viewer import PORT, FitViewer


@app.command()
def fit(
    file: Annotated[
        list[Path],
        typer.Argument(
            help="Fit file, TOML; warpshadow/inverse/README.md lists its keys. Or many: a pattern, a folder with "
            "files called fit.toml, or a .txt file with a path on each line."
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="Folder for the results, and for the checkpoint that a fit goes on from."),
    ],
    workers: Annotated[
        Optional[int],
        typer.Option(help="Of many fits: how many at a time, which share the cores; by default one a core.", min=1),
    ] = None,
    ray: Annotated[
        Optional[str],
        typer.Option(help="Of many fits: Ray cluster to run them on, HOST:PORT, or auto for that of this machine."),
    ] = None,
    preview: Annotated[
        bool, typer.Option(help="Show target, image and difference in FOLDER/preview.png while the fit runs.")
    ] = True,
    checkpoint_seconds: Annotated[float, typer.Option(help="Time between checkpoints.", min=0.0)] = 10.0,
    view: Annotated[
        bool, typer.Option("--view", help="Open a page that shows the fit, and on which it is paused and stopped.")
    ] = False,
    port: Annotated[int, typer.Option(help="Port of the page, or the next one that is free.", min=0, max=65535)] = PORT,
    browser: Annotated[bool, typer.Option(help="Open a browser with --view.")] = True,
    device: Device = "cpu",
    is_quiet: Quiet = False,
) -> None:
    """Fit the free parameters of a scene to images; run again, it resumes where it was interrupted.

    The folder gets scene.toml, which `warpshadow render` renders, and all that it names. Exit status 3: something
    became NaN or Inf, and the folder has the best values before that; 4: the result does not explain the images.

    With many fits, each has a subfolder, and table.csv says how they ended; finished fits are not run again. One that
    fails costs only itself. Exit status 1: some failed; else 3: some became NaN or Inf; else 4: some do not explain
    their images.
    """
    from warpshadow.inverse import checkpoint as checkpoints
    from warpshadow.inverse.checkpoint import CHECKPOINT, PREVIEW, check_folder
    from warpshadow.inverse.descent import GOOD_ENDINGS
    from warpshadow.inverse.fit_file import load_fit
    from warpshadow.inverse.many import is_of_many
    from warpshadow.inverse.report import SUMMARY, Report, found_values

    fit_path = file[0] if len(file) == 1 else file
    if isinstance(fit_path, list) or is_of_many(fit_path):
        options = {"workers": workers, "ray": ray, "device": device, "checkpoint_seconds": checkpoint_seconds}
        _fit_many(fit_path, output, view, is_quiet, **options)
        return
    with clear_errors(), _resumable(output):
        if workers is not None or ray is not None:
            raise ValueError(
                f"--workers, --ray: got the fit file {fit_path}, expected a pattern, a folder or a .txt file"
            )
        warp_device = device_of(device)
        check_folder(output)
        loaded_fit = load_fit(fit_path)
        output.mkdir(exist_ok=True)
        state = checkpoints.load(output / CHECKPOINT)
        was_over = state is not None and state["reason"] is not None
        if state is None and (output / PREVIEW).exists():
            note(f"no checkpoint in {output} yet; the fit begins anew", is_quiet)
        viewer = FitViewer(port=port) if view else None
        if viewer is not None:
            typer.echo(viewer.url)
            viewer.open(browser)
        result = loaded_fit.run(
            device=str(warp_device),
            checkpoint=output / CHECKPOINT,
            checkpoint_seconds=checkpoint_seconds,
            preview=output / PREVIEW if preview else None,
            view=False if viewer is None else viewer,
            progress=True,
        )
        if result.reason == "stopped":
            raise KeyboardInterrupt  # which the page's button stands for
        has_diverged = result.reason not in GOOD_ENDINGS
        ending = "diverged" if has_diverged else result.reason
        ending += f" after {sum(map(len, result.losses))} iterations"
        if was_over and (output / SUMMARY).exists():
            end_time = datetime.fromtimestamp((output / CHECKPOINT).stat().st_mtime)
            remedy = f"remove {output} or choose another folder by -o to start anew"
            note(f"already {ending} (on {end_time:%Y-%m-%d at %H:%M}); {remedy}", is_quiet)
        else:
            report = Report(result)
            frame_rate = f", {1e3 * result.seconds:.3g} ms each" if math.isfinite(result.seconds) else ""
            note(f"{ending}{frame_rate}", is_quiet)
            note(f"loss {report.loss_before:.4g} before, {report.loss_after:.4g} after", is_quiet)
            for line in found_values(result):
                note(line, is_quiet)
            if result.light is not None:
                note(f"{result.light}", is_quiet)
            note(f"{output}: {', '.join(path.name for path in report.write(output))}", is_quiet)
    if has_diverged:
        typer.secho(f"error: {result.reason}; {output} has the best values before that", fg="red", err=True)
        raise typer.Exit(DIVERGED)
    if not result.verdict.is_explained:
        typer.secho(f"error: {output} does not explain its images: {result.verdict}", fg="red", err=True)
        raise typer.Exit(UNEXPLAINED)


def _fit_many(fit_path: Path | list[Path], output: Path, view: bool, is_quiet: bool, **options: Any) -> None:
    """Run many fits, and list the failed ones."""
    from warpshadow.inverse.fit_file import check_kind
    from warpshadow.inverse.many import TABLE, find_fits, fit_many

    with clear_errors():
        for file in fit_path if isinstance(fit_path, list) else []:  # before workers start
            check_kind(file)
        if view:
            raise ValueError("--view: got many fits, expected one, which a page can show")
        try:
            endings = fit_many(find_fits(fit_path), output, **options)
        except KeyboardInterrupt as error:
            raise report_interrupt("; the same command goes on from the checkpoints") from error
    for ending in endings:
        for warning in ending.warnings:
            typer.secho(f"warning: {ending.name}: {warning}", fg="yellow", err=True)
    for ending in endings:
        if not ending.is_good:
            typer.secho(f"error: {ending.name} {ending.reason}: {ending.error}", fg="red", err=True)
        elif ending.doubt:
            typer.secho(f"error: {ending.name} does not explain its images: {ending.doubt}", fg="red", err=True)
    reasons = [ending.reason for ending in endings]
    counts = ", ".join(f"{reasons.count(reason)} {reason}" for reason in dict.fromkeys(reasons))
    doubts = sum(ending.is_good and bool(ending.doubt) for ending in endings)
    counts += f"; {doubts} of them do not explain their images" * (doubts > 0)
    note(f"{output / TABLE}: {counts}", is_quiet)
    if "failed" in reasons:
        raise typer.Exit(1)
    if "diverged" in reasons:
        raise typer.Exit(DIVERGED)
    if doubts:
        raise typer.Exit(UNEXPLAINED)


@contextlib.contextmanager
def _resumable(folder: Path) -> Iterator[None]:
    """Say how a fit goes on when the user interrupts it."""
    from warpshadow.inverse.checkpoint import CHECKPOINT, has_checkpoint

    try:
        yield
    except KeyboardInterrupt as error:
        is_resumable = has_checkpoint(folder)
        remark = (
            f"; the same command goes on from {folder / CHECKPOINT}"
            if is_resumable
            else " before a checkpoint; the same command starts over"
        )
        remark += f"; {error}" if error.args else ""
        raise report_interrupt(remark) from error


@app.command()
def dataset(
    recipe: Annotated[Path, typer.Argument(help="Recipe, TOML; warpshadow/dataset/README.md lists its keys.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for the shards; an interrupted run there goes on.")
    ],
    workers: Annotated[
        Optional[int], typer.Option(help="Processes that render; by default one a core, on a GPU one.", min=1)
    ] = None,
    device: Device = "cpu",
    is_quiet: Quiet = False,
) -> None:
    """Draw random scenes and write their images, with depth, shadows and more, in shards to train networks from.

    Run again, it writes the shards that are missing. The bits are the same for any number of workers.
    """
    from warpshadow.dataset import DataSet, load_recipe, write_shards

    with clear_errors():
        loaded_recipe = load_recipe(recipe)
        data_set = DataSet(loaded_recipe, device=device_of(device))
        start, existing_shards = time.perf_counter(), {*output.glob("*.tar")}
        try:
            shards = write_shards(data_set, output, workers=workers)
        except KeyboardInterrupt as error:
            raise report_interrupt(f"; the same command goes on in {output}") from error
        size = sum(shard.stat().st_size for shard in shards)
        seconds = time.perf_counter() - start
        made_text = (
            f"{seconds:.0f} s"
            if {*shards} - existing_shards
            else f"all there before; to make them anew, remove {output}"
        )
        note(
            f"{output}: {len(shards)} shards, {loaded_recipe.images} images, {size / 1e6:.3g} MB, {made_text}", is_quiet
        )
