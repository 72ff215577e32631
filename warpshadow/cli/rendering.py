"""Images and videos: render."""

import functools
import itertools
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, Optional

import numpy as np
import typer
import warp as wp

from warpshadow.assets.camera import Camera
from warpshadow.assets.picture import SUFFIXES, Picture
from warpshadow.assets.video import VIDEO_SUFFIXES, check_video, write_video
from warpshadow.cli.console import Device, Quiet, app, check_output, clear_errors, device_of, note
from warpshadow.cli.mesh_options import (
    MeshCommand,
    MeshOptions,
    SceneOrMesh,
    count_of_bounces,
    load,
    method_of_visibility,
    with_mesh_options,
)
from warpshadow.scene.scene import Scene
from warpshadow.scene.visibility import AUTO, METHOD_TRAITS

_of_pictures, _of_videos, _of_method = (  # options, by panels of the help
    functools.partial(typer.Option, rich_help_panel=panel)
    for panel in ("Pictures", "Videos", "Method, in place of the scene's")
)
_BACKGROUNDS = ("transparent", "environment")  # beside colors


class _Render(MeshCommand):
    """The command that renders; a picture that is named without its option gets an answer that says it."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the command line."""
        if not any(text.startswith("-o") or text.partition("=")[0] == "--output" for text in args):
            alone = [
                text for previous_argument, text in itertools.pairwise(args) if not previous_argument.startswith("-")
            ]
            for text in alone:
                if Path(text).suffix.lower() in (".exr", *SUFFIXES, *VIDEO_SUFFIXES):
                    raise typer.BadParameter(f"expected -o {text}", ctx, param_hint=text)
        return super().parse_args(ctx, args)


@app.command(cls=_Render)
@with_mesh_options
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
    mesh_options: MeshOptions,
    png: Annotated[Optional[Path], _of_pictures(help="Beside an .exr, also write a picture: .png, or .jpg.")] = None,
    exposure: Annotated[
        Optional[float], _of_pictures(help="Exposure in stops; without it the brightest 1% just saturate.")
    ] = None,
    tone: Annotated[
        Literal["clip", "filmic"], _of_pictures(help="Tone curve of bright color: cut off, or bent.")
    ] = "clip",
    background: Annotated[
        str,
        _of_pictures(
            help="Background of the picture or video: environment, a color (white, #ffcc00), or transparent, which "
            ".jpg files and videos show as white."
        ),
    ] = "transparent",
    turntable: Annotated[
        Optional[int], _of_videos(help="Write a video of so many frames in which the camera goes around.", min=1)
    ] = None,
    fps: Annotated[
        Optional[float],
        _of_videos(help="Frames a second of a turntable, 24 by default; 0.1 to 1000, of .webp 90, of .gif 50."),
    ] = None,
    camera_path: Annotated[
        Optional[Path],
        _of_videos(help="Write a video along the keyframes of a TOML file, whose keys warpshadow/cli/README.md lists."),
    ] = None,
    stills: Annotated[
        bool,
        _of_videos(
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
        Any,
        _of_method(
            help="How visibility is computed; ray-traced, the reference, is a path tracer where light bounces.",
            parser=method_of_visibility,
            metavar="|".join(METHOD_TRAITS),
        ),
    ] = None,
    samples: Annotated[
        Optional[int], _of_method(help="Of ray-traced: rays of a pixel, and with bounces half as many paths.", min=1)
    ] = None,
    bounces: Annotated[
        Any, _of_method(help="How often light bounces, 0 to 16 or all.", parser=count_of_bounces, metavar="INTEGER|all")
    ] = None,
    device: Device = "cpu",
    is_quiet: Quiet = False,
) -> None:
    """Render a scene file, or a mesh on a ground under a sky, to an image with soft shadows."""
    from warpshadow.assets.image import write_image
    from warpshadow.pipeline.receivers.choice_of_receivers import for_still
    from warpshadow.pipeline.renderer import SceneRenderer
    from warpshadow.scene.camera_path import CameraPath
    from warpshadow.tuning.tune import describe, resolved
    from warpshadow.tuning.video_time import remark_on_stills

    with clear_errors():
        video = "--turntable" if turntable is not None else "--camera-path" if camera_path is not None else None
        path = None if camera_path is None else CameraPath.read(camera_path)
        if video is None:
            _check_image_options(output, stills, layers)
        else:
            check_output(output, *VIDEO_SUFFIXES)
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
            check_output(png, *SUFFIXES)
        plain = None if background in _BACKGROUNDS else background
        try:
            Picture(np.zeros((1, 1, 4)), exposure=exposure, background=plain)  # refused before the work
        except ValueError as error:
            others = f", or one of {', '.join(_BACKGROUNDS)}" if str(error).startswith("background") else ""
            raise ValueError(f"--{error}{others}") from error
        arguments: dict[str, Any] = {"method": method, "samples": samples, "bounces": bounces}
        arguments = {name: value for name, value in arguments.items() if value is not None}
        parsed_scene = load(scene, mesh_options, is_quiet, **arguments)
        warp_device = device_of(device)
        loaded_scene = parsed_scene
        if parsed_scene.visibility.method == AUTO:
            loaded_scene = resolved(parsed_scene, device=warp_device, progress=True)
            note(f"auto: {describe(loaded_scene)}", is_quiet)
        loaded_scene = for_still(loaded_scene if video is None or stills else loaded_scene.with_method())
        start = time.perf_counter()
        if video is not None:
            cameras = (
                path.cameras(loaded_scene.camera)
                if path is not None
                else loaded_scene.camera.around(loaded_scene, turntable or 1)
            )
            if not stills and (remark := remark_on_stills(parsed_scene, len(cameras), device=warp_device)):
                note(remark, is_quiet)
            frames = _frames(loaded_scene, cameras, warp_device, exposure, tone, background)
            write_video(output, frames, fps=rate)
            note(f"{output}: {len(cameras)} frames, rendered in {time.perf_counter() - start:.2f} s", is_quiet)
            return
        renderer = SceneRenderer(loaded_scene, device=warp_device, progress=True)
        image = renderer.render()
        seconds = time.perf_counter() - start
        summary = f"{loaded_scene.visibility.method}, {image.shape[1]} × {image.shape[0]}, {seconds:.2f} s"
        if output.suffix.lower() == ".exr":
            write_image(output, image, layers=renderer.layers().channels() if layers else None)
            note(f"{output}: {summary}", is_quiet)
        for file in (item for item in (output, png) if item is not None and item.suffix.lower() != ".exr"):
            picture = Picture(image, exposure=exposure, tone=tone, background=_background_of(loaded_scene, background))
            write_image(file, picture)
            note(f"{file}: {f'{summary}, ' * (file == output)}exposure {picture.exposure:+.2f} stops", is_quiet)
            if picture.pixels.shape[2] == 4 and picture.pixels[..., 3].min() < 255 and file.suffix.lower() != ".png":
                remark = f"white behind the bodies, as {file.suffix} has no transparency"
                note(f"{file}: {remark}; --background environment shows the light", is_quiet)


def _check_image_options(output: Path, stills: bool, layers: bool) -> None:
    """Raise an error for options that an image does not have, or a file that is none."""
    if stills:
        raise ValueError("--stills: got it for an image, expected --turntable FRAMES or --camera-path FILE")
    is_video = output.suffix.lower() in VIDEO_SUFFIXES
    remedy = "; videos take --turntable FRAMES or --camera-path FILE" if is_video else ""
    check_output(output, ".exr", *SUFFIXES, instead=remedy)
    if layers and output.suffix.lower() in SUFFIXES:
        raise ValueError(f"--layers: got it with {output}, expected an .exr file, which has channels for them")


def _background_of(scene: Scene, background: str) -> str | np.ndarray | None:
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
        background_image = _background_of(replace(scene, camera=camera), background)
        return Picture(image, exposure=exposure, tone=tone, background=background_image)

    first = picture(cameras[0], exposure)  # its set-up, fits and tracing, has bars of its own
    with progress_bar(len(cameras), "rendering", "frame", done=1) as bar:
        yield first
        for camera in cameras[1:]:
            yield picture(camera, first.exposure)
            bar.update()
