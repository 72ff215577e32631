"""The command line: render and view scenes, explain images, fit spheres to a mesh, look into a light, compile ahead."""

import contextlib
import itertools
import math
import os
import sys
import time
import warnings
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Optional

import numpy as np
import typer
import typer.core
import warp as wp

from warpshadow import Tuning, __version__, quiet
from warpshadow.assets import files
from warpshadow.assets.camera import DIRECTION, Camera
from warpshadow.assets.picture import SUFFIXES, Picture
from warpshadow.assets.video import VIDEO_SUFFIXES, check_video, write_video
from warpshadow.scene.scene import Scene
from warpshadow.spheres import FitReport
from warpshadow.viewer import HOST, PORT, FitViewer, serve

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Soft shadows on meshes under environment light, differentiable, on CPU and CUDA.",
)

# Exit statuses beside 0, 1 (a mistake in a file or value) and 2 (a mistake in the command line).
DIVERGED = 3
INTERRUPTED = 130

_BACKGROUNDS = ("transparent", "environment")  # beside colors

SceneOrMesh = Annotated[
    Path,
    typer.Argument(
        help="Scene file, TOML, whose keys warpshadow/scene/README.md lists; or a mesh: .obj, .ply, .stl, .glb, .usd."
    ),
]

Up = Annotated[
    Optional[Literal["y", "z"]],
    typer.Option(help="Of a mesh: the axis that points up; without it, it is guessed by how the mesh stands."),
]


def _two_numbers(size: tuple[str, str] | None) -> tuple[str, str] | None:
    """Refuse a size that is not two numbers, such as one number and the next option."""
    if size is not None and not all(text.isdecimal() for text in size):
        square = f", such as {size[0]} {size[0]}" if size[0].isdecimal() else ", such as 512 512"
        raise typer.BadParameter(f"got {' '.join(size)}, expected width and height{square}")
    return size


Size = Annotated[
    Optional[tuple[str, str]],
    typer.Option(
        help="Of a mesh: width and height of the image, in pixels; without it 512 512.",
        metavar="WIDTH HEIGHT",
        callback=_two_numbers,
    ),
]

Light = Annotated[
    Optional[Path], typer.Option(help="Of a mesh: file of an environment map, .exr or .hdr, in place of a sky.")
]

Direction = Annotated[
    Optional[tuple[float, float, float]],
    typer.Option(
        help="Of a mesh: where the camera stands, seen from the mesh's middle, y up; without it 0.3 0.4 0.9; from "
        "behind it is 0.3 0.4 -0.9.",
        metavar="X Y Z",
    ),
]

LightRotation = Annotated[
    Optional[float],
    typer.Option(help="Of a mesh: turn the light, counterclockwise seen from above, in degrees.", metavar="DEGREES"),
]

Device = Annotated[str, typer.Option(help="Where to compute: cpu, cuda:0, …")]


def _start(is_quiet: bool) -> bool:
    """Start Warp without its messages; without progress bars, where that is asked for."""
    quiet(progress=not is_quiet)
    return is_quiet


Quiet = Annotated[
    bool,
    typer.Option(
        "-q",
        "--quiet",
        help="Print reports, warnings and errors alone: no progress, and not what was written.",
        callback=_start,
    ),
]


def _note(text: str, is_quiet: bool) -> None:
    """Print progress and the files that were written."""
    if not is_quiet:
        typer.echo(text)


def _count_of_bounces(text: str) -> Any:
    """A number of bounces, or "all"; others are refused as everywhere else."""
    from warpshadow.scene.scene import check_bounces

    count = int(text) if text.lstrip("-").isdecimal() else text
    try:
        check_bounces(count)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    return count


def _print_version(is_asked: bool) -> None:
    if is_asked:
        typer.echo(f"warpshadow {__version__}")
        raise typer.Exit


@app.callback()
def main(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Print warnings in one line each."""
    warnings.showwarning = lambda message, *_: typer.secho(f"warning: {message}", fg="yellow", err=True)


def _interrupted(how: str = "") -> typer.Exit:
    """Say in one line that the user interrupted the command, and how it goes on; returns the exit."""
    typer.secho(f"interrupted{how}", fg="yellow", err=True)
    return typer.Exit(INTERRUPTED)


@contextlib.contextmanager
def _clear_errors() -> Iterator[None]:
    """Turn errors in the user's input into one line and exit status 1, and an interrupt into one and 130."""
    try:
        yield
    except KeyboardInterrupt as error:
        remark = f"; {error}" if error.args else ""
        raise _interrupted(remark) from error  # at once: threads and kernels take a second to end
    except (ValueError, OSError, ImportError) as error:
        message = error if error.args else type(error).__name__
        typer.secho(f"error: {message}", fg="red", err=True)
        raise typer.Exit(1) from error


def _check_output(path: Path, *suffixes: str, instead: str = "") -> None:
    """Find out before the work whether its result can be written; a wrong extension may mean another option."""
    if path.suffix.lower() not in suffixes and not path.is_dir():
        raise ValueError(f"{path}: got extension {path.suffix!r}, expected {' or '.join(suffixes)}{instead}")
    files.check_file(path)


class _Render(typer.core.TyperCommand):
    """The command that renders; a picture that is named without its option gets an answer that says it."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the command line."""
        if not any(text.startswith("-o") or text.partition("=")[0] == "--output" for text in args):
            alone = [text for before, text in itertools.pairwise(args) if not before.startswith("-")]
            for text in alone:
                if Path(text).suffix.lower() in (".exr", *SUFFIXES, *VIDEO_SUFFIXES):
                    raise typer.BadParameter(f"expected -o {text}", ctx, param_hint=text)
        return super().parse_args(ctx, args)


@app.command(cls=_Render)
def render(
    scene: SceneOrMesh,
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            help="Image to write: .png or .jpg, in sRGB, or .exr, linear float32 RGBA, alpha = coverage; with "
            "--turntable or --camera-path a video: .mp4, .gif, .webp.",
        ),
    ],
    up: Up = None,
    size: Size = None,
    light: Light = None,
    direction: Direction = None,
    light_rotation: LightRotation = None,
    png: Annotated[Optional[Path], typer.Option(help="Beside an .exr, also write a picture: .png, or .jpg.")] = None,
    exposure: Annotated[
        Optional[float],
        typer.Option(help="Exposure of the picture in stops; without it the brightest 1% just saturate."),
    ] = None,
    tone: Annotated[
        Literal["clip", "filmic"], typer.Option(help="What becomes of bright color in the picture: cut off, or bent.")
    ] = "clip",
    background: Annotated[
        str,
        typer.Option(
            help="Background of the picture or video: environment, a color (white, #ffcc00), or transparent, which "
            ".jpg files and videos show as white."
        ),
    ] = "transparent",
    turntable: Annotated[
        Optional[int], typer.Option(help="Write a video of so many frames in which the camera goes around.", min=1)
    ] = None,
    fps: Annotated[
        Optional[float],
        typer.Option(help="Frames a second of a turntable, 24 by default; 0.1 to 1000, of .webp 90, of .gif 50."),
    ] = None,
    camera_path: Annotated[
        Optional[Path],
        typer.Option(
            help="Write a video along the keyframes of a TOML file, whose keys warpshadow/scene/README.md lists."
        ),
    ] = None,
    stills: Annotated[
        bool,
        typer.Option(
            "--stills",
            help="Render each frame of a video as an image alone: by rays, if the scene names no method. Shadows are "
            "better, and nothing is prepared, but each frame takes two to three times as long.",
        ),
    ] = False,
    layers: Annotated[
        bool,
        typer.Option(
            "--layers",
            help="Also write depth (Z), normals (N.X, N.Y, N.Z), numbers of bodies (body) and their masks (mask.0, …) "
            "as channels of the image.",
        ),
    ] = False,
    method: Annotated[
        Optional[Literal["directional", "log-sh", "none", "ray-traced", "auto"]],
        typer.Option(
            help="How visibility is computed, in place of the scene's; ray-traced, the reference, is a path tracer "
            "where light bounces."
        ),
    ] = None,
    samples: Annotated[
        Optional[int],
        typer.Option(help="Of the ray-traced method: rays of a pixel, and with bounces half as many paths.", min=1),
    ] = None,
    bounces: Annotated[
        Any,
        typer.Option(
            help="How often light bounces, 0 to 16 or all, in place of the scene's.",
            parser=_count_of_bounces,
            metavar="INTEGER|all",
        ),
    ] = None,
    device: Device = "cpu",
    is_quiet: Quiet = False,
) -> None:
    """Render a scene file, or a mesh on a ground under a sky, to an image with soft shadows."""
    from warpshadow.assets.image import write_image
    from warpshadow.pipeline.choice_of_receivers import for_picture
    from warpshadow.pipeline.renderer import SceneRenderer
    from warpshadow.scene.camera_path import CameraPath
    from warpshadow.scene.scene import AUTO
    from warpshadow.tuning.tune import describe, resolved
    from warpshadow.tuning.video_time import remark_on_stills

    with _clear_errors():
        video = "--turntable" if turntable is not None else "--camera-path" if camera_path is not None else None
        path = None if camera_path is None else CameraPath.read(camera_path)
        if video is None:
            if stills:
                raise ValueError("--stills: got it for an image, expected --turntable FRAMES or --camera-path FILE")
            is_video = output.suffix.lower() in VIDEO_SUFFIXES
            remedy = "; videos take --turntable FRAMES or --camera-path FILE" if is_video else ""
            _check_output(output, ".exr", *SUFFIXES, instead=remedy)
            if layers and output.suffix.lower() in SUFFIXES:
                raise ValueError(f"--layers: got it with {output}, expected an .exr file, which has channels for them")
        else:
            _check_output(output, *VIDEO_SUFFIXES)
            for option, value in (("--png", png), ("--layers", layers or None), ("--camera-path", camera_path)):
                if value is not None and option != video:
                    raise ValueError(f"{option}: got it beside {video}, expected one of them")
        if fps is not None and turntable is None:
            expected = "fps in the file" if path is not None else "--turntable FRAMES with it"
            raise ValueError(f"--fps: got {fps:g} without --turntable, expected {expected}")
        rate = path.fps if path is not None else 24.0 if fps is None else fps
        if video is not None:
            check_video(output, rate)
        if png is not None:
            _check_output(png, *SUFFIXES)
        plain = None if background in _BACKGROUNDS else background
        try:
            Picture(np.zeros((1, 1, 4)), exposure=exposure, background=plain)  # refused before the work
        except ValueError as error:
            others = f", or one of {', '.join(_BACKGROUNDS)}" if str(error).startswith("background") else ""
            raise ValueError(f"--{error}{others}") from error
        arguments: dict[str, Any] = {"method": method, "samples": samples, "bounces": bounces}
        arguments = {name: value for name, value in arguments.items() if value is not None}
        parsed = _load(scene, is_quiet, _OfMesh(up, size, light, direction, light_rotation), **arguments)
        where = _device(device)
        loaded = parsed
        if parsed.visibility.method == AUTO:
            loaded = resolved(parsed, device=where, progress=True)
            _note(f"auto: {describe(loaded)}", is_quiet)
        loaded = for_picture(loaded if video is None or stills else loaded.with_method())
        start = time.perf_counter()
        if video is not None:
            cameras = path.cameras(loaded.camera) if path is not None else loaded.camera.around(loaded, turntable or 1)
            if not stills and (remark := remark_on_stills(parsed, len(cameras), device=where)):
                _note(remark, is_quiet)
            frames = _frames(loaded, cameras, where, exposure, tone, background)
            write_video(output, frames, fps=rate)
            _note(f"{output}: {len(cameras)} frames, rendered in {time.perf_counter() - start:.2f} s", is_quiet)
            return
        renderer = SceneRenderer(loaded, device=where, progress=True)
        image = renderer.render()
        seconds = time.perf_counter() - start
        messages = f"{loaded.visibility.method}, {image.shape[1]} × {image.shape[0]}, {seconds:.2f} s"
        if output.suffix.lower() == ".exr":
            write_image(output, image, layers=renderer.layers().channels() if layers else None)
            _note(f"{output}: {messages}", is_quiet)
        for file in (item for item in (output, png) if item is not None and item.suffix.lower() != ".exr"):
            picture = Picture(image, exposure=exposure, tone=tone, background=_behind(loaded, background))
            write_image(file, picture)
            _note(f"{file}: {f'{messages}, ' * (file == output)}exposure {picture.exposure:+.2f} stops", is_quiet)


class _OfMesh(NamedTuple):
    """Options of the default scene of a mesh; None as it is without."""

    up: str | None
    size: tuple[str, str] | None
    light: Path | None
    direction: tuple[float, float, float] | None
    light_rotation: float | None


_KEYS_OF_SCENES = {
    "--up": "[[body]] rotation",
    "--size": "[camera] size",
    "--light": "[light]",
    "--direction": '[camera] direction, beside framing = "auto", or eye and target',
    "--light-rotation": "[light] rotation",
}
"""Keys that scene files have in place of the options of meshes, in the order of these."""


def _load(file: Path, is_quiet: bool, options: _OfMesh, **settings: Any) -> Scene:
    """The scene of a file, or the default one of a mesh's file; of that a note says which way is up."""
    from warpshadow.assets.mesh_files import MESH_SUFFIXES
    from warpshadow.scene.files import load_scene, turned_light
    from warpshadow.scene.mesh_scene import default_scene, guess_up
    from warpshadow.scene.scene import Body, Visibility

    if file.suffix.lower() not in (*MESH_SUFFIXES, ".toml") and file.is_file():
        expected = f".toml for a scene file, or a mesh's: {', '.join(MESH_SUFFIXES)}"
        raise ValueError(f"{file}: got extension {file.suffix!r}, expected {expected}")
    if file.suffix.lower() not in MESH_SUFFIXES:
        for (option, key), value in zip(_KEYS_OF_SCENES.items(), options, strict=True):
            if value is not None:
                shown = " ".join(map(str, value)) if isinstance(value, tuple) else value
                raise ValueError(f"{option}: got {shown} with {file}, expected a mesh; scene files have {key}")
        return load_scene(file, **settings)
    body = Body(file)
    up = options.up
    if up is None:
        guess = guess_up(body.mesh, file.suffix.lower())
        up = guess.axis
        _note(f"{file}: {up} is taken to be up ({guess.reason}); --up {'zy'['yz'.index(up)]} says otherwise", is_quiet)
    width, height = map(int, options.size or ("512", "512"))
    direction = options.direction or DIRECTION
    scene = default_scene(body, up=up, size=(width, height), light=options.light, direction=direction)
    light = turned_light(scene.light, options.light_rotation or 0.0, 1.0)
    bounces = settings.pop("bounces", scene.bounces)
    return replace(scene, light=light, visibility=Visibility.of(settings), bounces=bounces)


def _behind(scene: Scene, background: str) -> str | np.ndarray | None:
    """The background of a picture, by its option."""
    if background == "environment":
        return scene.background()
    return None if background == "transparent" else background


def _frames(
    scene: Scene, cameras: list[Camera], device: wp.Device, exposure: float | None, tone: str, background: str
) -> Iterator[Picture]:
    """Pictures from cameras, by default at the exposure of the first."""
    from warpshadow.device.progress import progress_bar
    from warpshadow.pipeline.renderer import SceneRenderer

    renderer = SceneRenderer(scene, device=device, progress=True)

    def picture(camera: Camera, exposure: float | None) -> Picture:
        image = renderer.with_cameras([camera]).render()[0]
        behind = _behind(replace(scene, camera=camera), background)
        return Picture(image, exposure=exposure, tone=tone, background=behind)

    first = picture(cameras[0], exposure)  # its set-up, fits and tracing, has bars of its own
    with progress_bar(len(cameras), "rendering", "frame", done=1) as bar:
        yield first
        for camera in cameras[1:]:
            yield picture(camera, first.exposure)
            bar.update()


@app.command()
def scene(
    mesh: Annotated[
        Optional[Path], typer.Argument(help="Mesh: .obj, .ply, .stl, .glb, .usd; without one, Warp's bunny.")
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="Scene file to write, .toml.")] = Path("scene.toml"),
    up: Up = None,
    size: Size = None,
    light: Light = None,
    direction: Direction = None,
    light_rotation: LightRotation = None,
    is_quiet: Quiet = False,
) -> None:
    """Write a scene file of a mesh on a ground under a sky, to be edited, rendered and viewed.

    Without a mesh it is of Warp's bunny, which is written beside it, bunny.obj.
    """
    from warpshadow.scene.starter import write_bunny, write_starter

    with _clear_errors():
        _check_output(output, ".toml")
        if mesh is None:
            mesh = write_bunny(output.parent)
            _note(f"{mesh}: Warp's bunny", is_quiet)
        loaded = _load(mesh, is_quiet, _OfMesh(up, size, light, direction, light_rotation))
        seen_from, turned_by = direction or DIRECTION, light_rotation or 0.0
        write_starter(output, mesh, loaded, light=light, direction=seen_from, rotation=turned_by)
        _note(f"{output}: warpshadow view {output} shows it", is_quiet)


@app.command()
def insert(
    scene: Annotated[
        Path,
        typer.Argument(help="Scene file, TOML, with the photograph's camera; a body has shadow_catcher = true."),
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
    from warpshadow.scene.files import load_scene
    from warpshadow.tuning.insert import insert as insert_bodies

    with _clear_errors():
        _check_output(output, ".exr", *SUFFIXES)
        loaded, where = load_scene(scene), _device(device)
        start = time.perf_counter()
        image = insert_bodies(loaded, into, exposure=exposure, device=where)
        write_image(output, image)
        height, width, _ = image.shape
        _note(f"{output}: {width} × {height}, {time.perf_counter() - start:.2f} s", is_quiet)


@app.command()
def view(
    scene: SceneOrMesh,
    up: Up = None,
    light: Light = None,
    direction: Direction = None,
    light_rotation: LightRotation = None,
    host: Annotated[
        str, typer.Option(help="Address to serve at; by default for this machine alone, 0.0.0.0 is for everybody.")
    ] = HOST,
    port: Annotated[int, typer.Option(help="Port, or the next one that is free.", min=0, max=65535)] = PORT,
    browser: Annotated[bool, typer.Option(help="Open a browser.")] = True,
    device: Device = "cpu",
    is_quiet: Quiet = False,
) -> None:
    """Show a scene, or a mesh on a ground under a sky, in the browser, to be turned with the mouse, until Ctrl+C."""
    with _clear_errors():
        loaded = _load(scene, is_quiet, _OfMesh(up, None, light, direction, light_rotation))
        file = scene if scene.suffix.lower() == ".toml" else None
        viewer = serve(loaded, host=host, port=port, device=_device(device), path=file)
        typer.echo(f"{viewer.url}   (Ctrl+C ends it)")
        viewer.open(browser)
        viewer.wait()
    sys.stdout.flush()
    os._exit(0)  # exit at once: Python's own exit waits for compiling and painting threads, and unloads all kernels


@app.command()
def tune(
    scene: SceneOrMesh,
    error: Annotated[Optional[float], typer.Option(help="Largest relative error of shading, such as 0.03.")] = None,
    ms: Annotated[
        Optional[float], typer.Option(help="In place of --error: longest time of an image, in milliseconds.")
    ] = None,
    bounces: Annotated[
        Any,
        typer.Option(
            help="How often light bounces in the truth, such as 12; then 0 to 4 bounces are tried, which takes some "
            "five to ten minutes in place of one.",
            parser=_count_of_bounces,
            metavar="INTEGER|all",
        ),
    ] = None,
    fit: Annotated[
        bool, typer.Option(help="Also fit 16 to 512 spheres a body, some 20 s in all; they are kept for later.")
    ] = False,
    up: Up = None,
    size: Size = None,
    light: Light = None,
    direction: Direction = None,
    light_rotation: LightRotation = None,
    device: Device = "cpu",
    is_quiet: Quiet = False,
) -> None:
    """Measure settings on a scene, and print the cheapest that reach an error, as lines to put into the scene file.

    Errors are printed before times are measured. Exit status 1: no setting reaches the error; the message names the
    nearest one, and what to try next.
    """
    from warpshadow.tuning.tune import describe
    from warpshadow.tuning.tune import tune as tune_scene

    with _clear_errors():
        if (error is None) == (ms is None):
            raise ValueError(f"--error, --ms: got {'neither' if error is None else 'both'}, expected one of them")
        loaded = _load(scene, is_quiet, _OfMesh(up, size, light, direction, light_rotation))
        where = _device(device)
        tuning = tune_scene(
            loaded, error=error, milliseconds=ms, bounces=bounces, fits=fit, device=where, progress=True
        )
        typer.echo(f"{scene}\n{tuning}\n")
        if not tuning.is_reached:
            requested = f"an error of {error:g}" if ms is None else f"{ms:g} ms"
            raise ValueError(
                f"no setting reaches {requested}; nearest is {describe(tuning.scene)}, with an error of "
                f"{tuning.error:.3g} in {tuning.milliseconds:.3g} ms; {_next_attempt(tuning, ms is None)}"
            )
        typer.echo(tuning.toml(), nl=False)


def _next_attempt(tuning: Tuning, is_inaccurate: bool) -> str:
    """Suggestions for reaching an error that no setting reached."""
    if not is_inaccurate:
        return "try a smaller image or fewer samples a pixel (supersampling = 1)"
    if tuning.untried_counts:
        return f"try --fit, which also fits {', '.join(map(str, tuning.untried_counts))} spheres a body"
    return 'try more spheres for the bodies that cast shadows, or rays: method = "ray-traced"'


def _device(name: str) -> wp.Device:
    from warpshadow import check

    return check.device("device", name)


@app.command()
def fit(
    file: Annotated[
        list[Path],
        typer.Argument(
            help="Fit file, TOML; warpshadow/inverse/README.md lists its keys. Or many: a pattern, a folder with "
            "files called fit.toml, or a .txt file with a path on each line.",
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
    became NaN or Inf, and the folder has the best values before that.

    With many fits, each has a subfolder, and table.csv says how they ended; finished fits are not run again. One that
    fails costs only itself. Exit status 1: some failed; 3: none did, but some became NaN or Inf.
    """
    from warpshadow.inverse import checkpoint as checkpoints
    from warpshadow.inverse.descent import GOOD_ENDINGS
    from warpshadow.inverse.fit_file import load_fit
    from warpshadow.inverse.folder import CHECKPOINT, PREVIEW, check_folder
    from warpshadow.inverse.many import is_of_many
    from warpshadow.inverse.report import SUMMARY, Report, found_values

    where = file[0] if len(file) == 1 else file
    if isinstance(where, list) or is_of_many(where):
        options = {"workers": workers, "ray": ray, "device": device, "checkpoint_seconds": checkpoint_seconds}
        _fit_many(where, output, view, is_quiet, **options)
        return
    with _clear_errors(), _resumable(output):
        if workers is not None or ray is not None:
            raise ValueError(f"--workers, --ray: got the fit file {where}, expected a pattern, a folder or a .txt file")
        on = _device(device)
        check_folder(output)
        loaded = load_fit(where)
        output.mkdir(exist_ok=True)
        state = checkpoints.load(output / CHECKPOINT)
        was_over = state is not None and state["reason"] is not None
        if state is not None and not was_over:
            _note(f"going on from {output / CHECKPOINT}", is_quiet)
        elif state is None and (output / PREVIEW).exists():
            _note(f"no checkpoint in {output} yet; the fit begins anew", is_quiet)
        viewer = FitViewer(port=port) if view else None
        if viewer is not None:
            typer.echo(viewer.url)
            viewer.open(browser)
        result = loaded.run(
            device=str(on),
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
            last = datetime.fromtimestamp((output / CHECKPOINT).stat().st_mtime)
            remedy = f"remove {output} or choose another folder by -o to start anew"
            _note(f"already {ending} (on {last:%Y-%m-%d at %H:%M}); {remedy}", is_quiet)
        else:
            report = Report(result)
            frame_rate = f", {1e3 * result.seconds:.3g} ms each" if math.isfinite(result.seconds) else ""
            _note(f"{ending}{frame_rate}", is_quiet)
            _note(f"loss {report.loss_before:.4g} before, {report.loss_after:.4g} after", is_quiet)
            for line in found_values(result):
                _note(line, is_quiet)
            if result.light is not None:
                _note(f"{result.light}", is_quiet)
            _note(f"{output}: {', '.join(path.name for path in report.write(output))}", is_quiet)
    if has_diverged:
        typer.secho(f"error: {result.reason}; {output} has the best values before that", fg="red", err=True)
        raise typer.Exit(DIVERGED)


def _fit_many(where: Path | list[Path], output: Path, view: bool, is_quiet: bool, **options: Any) -> None:
    """Run many fits, and list the failed ones."""
    from warpshadow.inverse.many import TABLE, find_fits, fit_many

    with _clear_errors():
        if view:
            raise ValueError("--view: got many fits, expected one, which a page can show")
        try:
            endings = fit_many(find_fits(where), output, **options)
        except KeyboardInterrupt as error:
            raise _interrupted("; the same command goes on from the checkpoints") from error
    for ending in endings:
        for warning in ending.warnings:
            typer.secho(f"warning: {ending.name}: {warning}", fg="yellow", err=True)
    for ending in endings:
        if not ending.is_good:
            typer.secho(f"error: {ending.name} {ending.reason}: {ending.error}", fg="red", err=True)
    reasons = [ending.reason for ending in endings]
    counts = ", ".join(f"{reasons.count(reason)} {reason}" for reason in dict.fromkeys(reasons))
    _note(f"{output / TABLE}: {counts}", is_quiet)
    if "failed" in reasons:
        raise typer.Exit(1)
    if "diverged" in reasons:
        raise typer.Exit(DIVERGED)


@contextlib.contextmanager
def _resumable(folder: Path) -> Iterator[None]:
    """Say how a fit goes on when the user interrupts it."""
    from warpshadow.inverse.folder import CHECKPOINT, has_checkpoint

    try:
        yield
    except KeyboardInterrupt as error:
        is_kept = has_checkpoint(folder)
        remark = f"; the same command goes on from {folder / CHECKPOINT}" if is_kept else " before a checkpoint"
        remark += f"; {error}" if error.args else ""
        raise _interrupted(remark) from error


@app.command()
def dataset(
    recipe: Annotated[Path, typer.Argument(help="Recipe, TOML; warpshadow/dataset/README.md lists its keys.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for the shards; what was interrupted there goes on.")
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

    with _clear_errors():
        loaded = load_recipe(recipe)
        data_set = DataSet(loaded, device=_device(device))
        start, before = time.perf_counter(), {*output.glob("*.tar")}
        try:
            shards = write_shards(data_set, output, workers=workers)
        except KeyboardInterrupt as error:
            raise _interrupted(f"; the same command goes on in {output}") from error
        size = sum(shard.stat().st_size for shard in shards)
        seconds = time.perf_counter() - start
        made = f"{seconds:.0f} s" if {*shards} - before else f"all there before; to make them anew, remove {output}"
        _note(f"{output}: {len(shards)} shards, {loaded.images} images, {size / 1e6:.3g} MB, {made}", is_quiet)


@app.command()
def spheres(
    mesh: Annotated[Path, typer.Argument(help="Mesh: .obj, .ply, .stl, .glb, .gltf or .usd.")],
    count: Annotated[
        Optional[int], typer.Option(help="Number of spheres; as many as the mesh needs by default.", min=1)
    ] = None,
    error: Annotated[
        Optional[float],
        typer.Option(help="In place of --count: as many spheres as this relative error takes."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the fit.")] = 0,
    picture: Annotated[Optional[Path], typer.Option(help="Draw the spheres in the mesh: .png.")] = None,
    output: Annotated[Optional[Path], typer.Option("-o", "--output", help="Write centers and radii: .npz.")] = None,
    device: Device = "cpu",
    is_quiet: Quiet = False,
) -> None:
    """Fit spheres to a mesh and report how well they stand in for it; the fit is kept for later renders."""
    from warpshadow.assets.mesh_files import load_mesh
    from warpshadow.spheres import check_matplotlib, fit_spheres, plot_spheres

    with _clear_errors():
        if picture is not None:
            _check_output(picture, ".png")
            check_matplotlib()
        if output is not None:
            _check_output(output, ".npz")
        loaded = load_mesh(mesh)
        if count is not None and error is not None:
            raise ValueError("--count, --error: got both, expected one of them")
        requested = {"count": count or "auto"} if error is None else {"error": error}
        fit = fit_spheres(loaded, seed=seed, device=_device(device), progress=True, **requested)
        typer.echo(f"{mesh}: {loaded.vertex_count} vertices, {loaded.face_count} faces")
        report = fit.report
        remark = ", read from the cache" if report.cached else ""
        typer.echo(f"{report.sphere_count} spheres, fitted in {report.seconds:.1f} s{remark}")
        typer.echo(f"irradiance error on the ground   {report.ground_error:6.1%}")
        typer.echo(f"error of the shadow there        {report.shadow_error:6.1%}")
        typer.echo(f"irradiance error on the surface  {report.surface_error:6.1%}")
        typer.echo(f"irradiance error in the air      {report.nearby_error:6.1%}")
        typer.echo(f"surface covered                  {report.coverage:6.1%}")
        typer.echo(f"volume outside the mesh          {report.outside_volume:6.1%}")
        typer.echo(_judgement(report))
        if output is not None:
            fit.spheres.write(output)
        if picture is not None:
            plot_spheres(loaded, fit.spheres, picture)
        if error is not None and report.visibility_error > error:
            raise ValueError(
                f"--error: no fit reaches {error:g}; {report.sphere_count} spheres, the most that are tried, have "
                f'{report.visibility_error:.3g}; bodies that do not move can be exact: method = "ray-traced"'
            )


def _judgement(report: FitReport) -> str:
    """The meaning of a fit's errors for images."""
    from warpshadow.spheres.enough import MOST_SPHERES, RAGGED

    own = "the error on the surface counts where the body deforms, else it traces its shadow on itself"
    if report.shadow_error <= RAGGED:
        return f"the shadow on the ground is whole, as its error is below {RAGGED:.0%}; {own}"
    more = f"--count {2 * report.sphere_count}" if report.sphere_count < MOST_SPHERES else 'method = "ray-traced"'
    return f"the shadow on the ground has holes, as its error is above {RAGGED:.0%}; {more} may mend them; {own}"


@app.command()
def envmap(
    file: Annotated[Path, typer.Argument(help="Environment map, .exr or .hdr, twice as wide as high.")],
    order: Annotated[int, typer.Option(help="Number of spherical-harmonic bands.", min=2, max=8)] = 8,
    sanitize: Annotated[
        Optional[Literal["zero", "neighbors"]], typer.Option(help="Repair NaN, Inf and negative pixels.")
    ] = None,
    output: Annotated[
        Optional[Path],
        typer.Option("-o", "--output", help="Where to write the map; sh_path FILE by default."),
    ] = None,
    is_quiet: Quiet = False,
) -> None:
    """Print an environment map's statistics and write its spherical-harmonic reconstruction beside it."""
    from warpshadow.assets.image import write_image
    from warpshadow.assets.light import EnvironmentMap
    from warpshadow.maths import sh

    with _clear_errors():
        sh_path = file.with_name(f"{file.stem}.sh{order}.exr") if output is None else output
        _check_output(sh_path, ".exr")
        light = EnvironmentMap.read(file, sanitize=sanitize)
        for name, value in light.statistics().items():
            shown = " ".join(f"{number:.4g}" for number in np.array(value).ravel())
            typer.echo(f"{name.replace('_', ' '):26}{shown}")
        write_image(sh_path, sh.reconstruct_map(light.sh(order), len(light.radiance)).astype(np.float32))
        _note(f"{sh_path}: reconstruction from {order**2} coefficients", is_quiet)


@app.command()
def cache(
    clear: Annotated[
        bool, typer.Option("--clear", help="Remove all but Warp's kernels; it is made again when needed.")
    ] = False,
    is_quiet: Quiet = False,
) -> None:
    """Print where spheres, shadows and kernels are kept, and how large that is."""
    from warpshadow.assets.cache import KINDS, cache_folder, cached_files

    with _clear_errors():
        typer.echo(cache_folder())
        for kind, what in KINDS.items():
            remark = cached_files(kind)
            typer.echo(f"  {what:40}{_size(remark)}")
            if clear:
                for file in remark:
                    file.unlink(missing_ok=True)  # another process may clear, too
        wp.init()
        kernels = Path(wp.config.kernel_cache_dir)
        typer.echo(kernels)
        typer.echo(f"  {'compiled kernels, of all that uses Warp':40}{_size([*kernels.rglob('*')])}")
        if clear:
            _note(f"{cache_folder()}: cleared", is_quiet)


def _size(paths: list[Path]) -> str:
    sizes = [path.stat().st_size for path in paths if path.is_file()]
    return f"{len(sizes):6} files {sum(sizes) / 1e6:10.1f} MB"


@app.command()
def warmup(device: Device = "cpu", is_quiet: Quiet = False) -> None:
    """Compile every kernel that rendering needs, so that the first render need not."""
    from warpshadow.assets.camera import Camera
    from warpshadow.assets.light import EnvironmentMap
    from warpshadow.assets.primitives import icosphere
    from warpshadow.device.progress import progress_bar
    from warpshadow.pipeline.renderer import SceneRenderer
    from warpshadow.scene.scene import METHODS, Body, Scene, Visibility
    from warpshadow.spheres import fit_spheres

    with _clear_errors():
        where = _device(device)
        mesh = icosphere(subdivisions=1)
        start = time.perf_counter()
        with progress_bar(len(METHODS) + 1, "compiling", "stage", stays=True) as bar:
            fit_spheres(mesh, 1, steps=100, device=where, cache=False, progress=False)
            bar.update()
            for method in METHODS:
                scene = Scene(
                    (Body(mesh, blockers=1),),
                    EnvironmentMap.constant(1.0),
                    Camera.look_at((0, 0, 5), (0, 0, 0), size=(8, 8)),
                    Visibility.of({"method": method, "samples": 16}),
                )
                SceneRenderer(scene, device=where).render()
                bar.update()
        _note(f"{where.alias}: ready in {time.perf_counter() - start:.1f} s", is_quiet)


if __name__ == "__main__":
    app(prog_name="warpshadow")
