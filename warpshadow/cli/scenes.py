"""Scenes: write one to begin with, put it into a photograph, view it, tune its settings."""

import contextlib
import functools
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from warpshadow.assets.camera import DIRECTION
from warpshadow.assets.picture import SUFFIXES
from warpshadow.cli.console import Device, Quiet, app, check_output, clear_errors, device_of, note
from warpshadow.cli.mesh_options import (
    NO_OPTIONS,
    MeshCommand,
    MeshOptions,
    SceneOrMesh,
    count_of_bounces,
    load,
    with_mesh_options,
)
from warpshadow.viewer import HOST, PORT, serve

if TYPE_CHECKING:
    from warpshadow.tuning.tune import Tuning


@app.command(cls=MeshCommand)
@with_mesh_options
def scene(
    mesh: Annotated[
        Optional[Path], typer.Argument(help="Mesh: .obj, .ply, .stl, .glb, .usd; without one, Warp's bunny.")
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="Scene file to write, .toml.")] = Path("scene.toml"),
    mesh_options: MeshOptions = NO_OPTIONS,
    is_quiet: Quiet = False,
) -> None:
    """Write a scene file of a mesh on a ground under a sky, to be edited, rendered and viewed.

    Without a mesh it is of Warp's bunny, which is written beside it, bunny.obj.
    """
    from warpshadow.scene.starter import write_bunny, write_starter

    with clear_errors():
        check_output(output, ".toml")
        if mesh is None:
            mesh = write_bunny(output.parent)
            note(f"{mesh}: Warp's bunny", is_quiet)
        loaded_scene = load(mesh, mesh_options, is_quiet)
        direction, rotation = mesh_options.direction or DIRECTION, mesh_options.light_rotation or 0.0
        write_starter(
            output,
            mesh,
            loaded_scene,
            albedo=mesh_options.albedo,
            light=mesh_options.light,
            direction=direction,
            rotation=rotation,
        )
        note(f"{output}: warpshadow view {output} shows it", is_quiet)


@app.command()
def insert(
    scene: Annotated[
        Path, typer.Argument(help="Scene file, TOML, with the photograph's camera; a body has shadow_catcher = true.")
    ],
    into: Annotated[Path, typer.Option(help="Photograph: .jpg, .png, or linear .exr, .hdr.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Image to write: .png or .jpg, or .exr, linear float32 RGB.")
    ],
    exposure: Annotated[float, typer.Option(help="Factor of the bodies' radiance in the photograph, in stops.")] = 0.0,
    device: Device = "cpu",
    is_quiet: Quiet = False,
) -> None:
    """Put the bodies of a scene into a photograph, with their shadows on the surfaces it shows.

    Bodies with shadow_catcher = true model surfaces in the photograph; they are not drawn, but darken it, and where
    light bounces tint it.
    """
    from warpshadow.assets.image import write_image
    from warpshadow.rendering.insert import insert as insert_bodies
    from warpshadow.scene.files import load_scene

    with clear_errors():
        check_output(output, ".exr", *SUFFIXES)
        loaded_scene, warp_device = load_scene(scene), device_of(device)
        start = time.perf_counter()
        image = insert_bodies(loaded_scene, into, exposure=exposure, device=warp_device)
        write_image(output, image)
        height, width, _ = image.shape
        note(f"{output}: {width} × {height}, {time.perf_counter() - start:.2f} s", is_quiet)


@app.command()
@functools.partial(with_mesh_options, without="size")
def view(
    scene: SceneOrMesh,
    mesh_options: MeshOptions = NO_OPTIONS,
    host: Annotated[
        str, typer.Option(help="Address to serve at; by default for this machine alone, 0.0.0.0 is for everybody.")
    ] = HOST,
    port: Annotated[int, typer.Option(help="Port, or the next one that is free.", min=0, max=65535)] = PORT,
    browser: Annotated[bool, typer.Option(help="Open a browser.")] = True,
    device: Device = "cpu",
    is_quiet: Quiet = False,
) -> None:
    """Show a scene, or a mesh on a ground under a sky, in the browser, to be turned with the mouse, until Ctrl+C."""
    with clear_errors():
        loaded_scene = load(scene, mesh_options, is_quiet)
        file = scene if scene.suffix.lower() == ".toml" else None
        viewer = serve(loaded_scene, host=host, port=port, device=device_of(device), path=file)
        with contextlib.suppress(KeyboardInterrupt):  # from the first moment that a page can be seen
            typer.echo(f"{viewer.url}   (Ctrl+C ends it)")
            viewer.open(browser)
            viewer.wait()
    sys.stdout.flush()
    os._exit(0)  # exit at once: Python's own exit waits for compiling and painting threads, and unloads all kernels


@app.command(cls=MeshCommand)
@with_mesh_options
def tune(
    scene: SceneOrMesh,
    error: Annotated[Optional[float], typer.Option(help="Largest relative error of shading, such as 0.03.")] = None,
    ms: Annotated[
        Optional[float], typer.Option(help="In place of --error: longest time of an image, in milliseconds.")
    ] = None,
    bounces: Annotated[
        Any,
        typer.Option(
            help="How often light bounces in the reference, such as 12; then 0 to 4 bounces are tried, which takes "
            "several times as long.",
            parser=count_of_bounces,
            metavar="INTEGER|all",
        ),
    ] = None,
    fit: Annotated[
        bool, typer.Option(help="Also fit 16 to 512 spheres a body, some 20 s in all; they are cached for later.")
    ] = False,
    mesh_options: MeshOptions = NO_OPTIONS,
    device: Device = "cpu",
    is_quiet: Quiet = False,
) -> None:
    """Measure settings on a scene, and print the cheapest that reach an error, as lines to put into the scene file.

    Each error is printed as it is measured, before times are. Exit status 1: no setting reaches the error; the message
    names the nearest one, and the next attempt.
    """
    from warpshadow.tuning.tune import describe
    from warpshadow.tuning.tune import tune as tune_scene

    with clear_errors():
        if (error is None) == (ms is None):
            got = "neither" if error is None else "both"
            raise ValueError(f"--error, --ms: got {got}, expected one of them, such as --error 0.03, which is 3%")
        loaded_scene = load(scene, mesh_options, is_quiet)
        warp_device = device_of(device)
        tuning_result = tune_scene(
            loaded_scene, error=error, milliseconds=ms, bounces=bounces, fits=fit, device=warp_device, progress=True
        )
        typer.echo(f"{scene}\n{tuning_result}\n")
        if not tuning_result.is_reached:
            requested_text = f"an error of {error:g}" if ms is None else f"{ms:g} ms"
            raise ValueError(
                f"no setting reaches {requested_text}; nearest is {describe(tuning_result.scene)}, with an error of "
                f"{tuning_result.error:.3g} in {tuning_result.milliseconds:.3g} ms; "
                f"{_next_attempt(tuning_result, ms is None)}"
            )
        typer.echo(tuning_result.toml(), nl=False)


def _next_attempt(tuning_result: "Tuning", is_inaccurate: bool) -> str:
    """Suggestions for reaching an error that no setting reached."""
    if not is_inaccurate:
        return "try a smaller image or fewer samples a pixel (supersampling = 1)"
    if tuning_result.untried_counts:
        return f"try --fit, which also fits {', '.join(map(str, tuning_result.untried_counts))} spheres a body"
    return 'try more spheres for the bodies that cast shadows, or rays: method = "ray-traced"'
