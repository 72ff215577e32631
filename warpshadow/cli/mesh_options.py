"""Options of meshes that are given in place of scene files: their default scene."""

import functools
import inspect
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Optional

import typer
import typer.core

from warpshadow import check
from warpshadow.assets.camera import DIRECTION
from warpshadow.cli.console import note
from warpshadow.scene.scene import Scene

SceneOrMesh = Annotated[
    Path,
    typer.Argument(
        help="Scene file, TOML, whose keys warpshadow/scene/README.md lists; or a mesh: .obj, .ply, .stl, .glb, .usd."
    ),
]

_mesh = functools.partial(typer.Option, rich_help_panel="Options of a mesh, which scene files have as keys")


_OPTIONS_ELSEWHERE = {
    **dict.fromkeys(("--width", "--height", "--resolution", "--res"), "write --size WIDTH HEIGHT"),
    "--spp": "write --samples COUNT, of --method ray-traced; scene files also have supersampling, samples a pixel "
    "across and down, and directions of [visibility]",
}
"""Options of other programs, and those in their place."""


class MeshCommand(typer.core.TyperCommand):
    """A command of meshes: the size of a square image may be one number, and of others 640x480."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the command line."""
        for name in (text.partition("=")[0] for text in args):
            if name in _OPTIONS_ELSEWHERE:
                ctx.fail(f"No such option: {name} ({_OPTIONS_ELSEWHERE[name]})")
        return super().parse_args(ctx, _with_whole_size(args))


def _with_whole_size(args: list[str]) -> list[str]:
    """The arguments, width and height of the image apart."""
    if "--size" not in args:
        return args
    place = args.index("--size") + 1
    text, next_argument = [*args[place:], "", ""][:2]
    width, x, height = text.partition("x")
    if (width + height).isdecimal() and (x or not next_argument.isdecimal()):
        return [*args[:place], width, height or width, *args[place + 1 :]]
    return args


def _two_numbers(size: tuple[str, str] | None) -> tuple[str, str] | None:
    """Refuse a size that is not two numbers, such as one number and the next option."""
    if size is not None and not all(text.isdecimal() for text in size):
        square = f", such as {size[0]} {size[0]}" if size[0].isdecimal() else ", such as 512 512"
        raise typer.BadParameter(f"got {' '.join(size)}, expected width and height{square}")
    return size


class MeshOptions(NamedTuple):
    """Options of a mesh that is given in place of a scene file; of these the size alone is for scene files, too."""

    up: Annotated[
        Optional[Literal["y", "z"]],
        _mesh(help="Axis that points up; without it, it is guessed by how the mesh stands."),
    ] = None
    size: Annotated[
        Optional[tuple[str, str]],
        typer.Option(
            help="Width and height of the image, in pixels, or one number for both; without it those of the scene "
            "file, of a mesh 512 512.",
            metavar="WIDTH HEIGHT",
            callback=_two_numbers,
        ),
    ] = None
    albedo: Annotated[
        Optional[tuple[float, float, float]],
        _mesh(
            help="Reflectance of the mesh, linear, each from 0 to 1, in place of the file's texture and colors.",
            metavar="R G B",
        ),
    ] = None
    light: Annotated[Optional[Path], _mesh(help="File of an environment map, .exr or .hdr, in place of a sky.")] = None
    direction: Annotated[
        Optional[tuple[float, float, float]],
        _mesh(
            help="Where the camera stands, seen from the mesh's middle, y up; without it 0.3 0.4 0.9; from behind it "
            "is 0.3 0.4 -0.9.",
            metavar="X Y Z",
        ),
    ] = None
    light_rotation: Annotated[
        Optional[float], _mesh(help="Turn the light, counterclockwise seen from above, in degrees.", metavar="DEGREES")
    ] = None


NO_OPTIONS = MeshOptions()


def with_mesh_options(command: Callable[..., None], *, without: str = "") -> Callable[..., None]:
    """Put the options of meshes, but for one, into a command's signature, which takes them as ``mesh_options``."""
    options = {name: item for name, item in inspect.signature(MeshOptions).parameters.items() if name != without}
    parameters: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(command).parameters.items():
        parameters += options.values() if name == "mesh_options" else [parameter]

    @functools.wraps(command)
    def run(**values: Any) -> None:
        command(mesh_options=MeshOptions(**{name: values.pop(name) for name in options}), **values)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


_KEYS_OF_SCENES = {
    "up": "[[body]] rotation",
    "albedo": "[[body]] albedo",
    "light": "[light]",
    "direction": '[camera] direction, beside framing = "auto", or eye and target',
    "light_rotation": "[light] rotation",
}
"""Keys that scene files have in place of the options of meshes."""


def load(file: Path, options: MeshOptions, is_quiet: bool, **settings: Any) -> Scene:
    """The scene of a file, or the default one of a mesh's file; of that a note says which way is up."""
    from warpshadow.assets.mesh_files import MESH_SUFFIXES
    from warpshadow.scene.body import Body
    from warpshadow.scene.files import load_scene, turned_light
    from warpshadow.scene.mesh_scene import default_scene, guess_up
    from warpshadow.scene.visibility import Visibility

    if file.suffix.lower() not in (*MESH_SUFFIXES, ".toml") and file.is_file():
        expected = f".toml for a scene file, or a mesh's: {', '.join(MESH_SUFFIXES)}"
        raise ValueError(f"{file}: got extension {file.suffix!r}, expected {expected}")
    size = None if options.size is None else (int(options.size[0]), int(options.size[1]))
    if file.suffix.lower() not in MESH_SUFFIXES:
        for name, value in options._replace(size=None)._asdict().items():
            if value is not None:
                shown_value = " ".join(map(str, value)) if isinstance(value, tuple) else value
                option, key = f"--{name.replace('_', '-')}", _KEYS_OF_SCENES[name]
                raise ValueError(f"{option}: got {shown_value} with {file}, expected a mesh; scene files have {key}")
        return load_scene(file, size=size, **settings)
    body = Body(file, albedo=options.albedo)
    up: str | None = options.up
    if up is None:
        guess = guess_up(body.mesh, file.suffix.lower())
        up = guess.axis
        note(f"{file}: {up} is taken to be up ({guess.reason}); --up {'zy'['yz'.index(up)]} says otherwise", is_quiet)
    direction = options.direction or DIRECTION
    scene = default_scene(body, up=up, size=size or (512, 512), light=options.light, direction=direction)
    rotated_light = turned_light(scene.light, options.light_rotation or 0.0, 1.0)
    bounces = settings.pop("bounces", scene.bounces)
    return replace(scene, light=rotated_light, visibility=Visibility.of(settings), bounces=bounces)


def method_of_visibility(text: str) -> str:
    """A method of visibility; of others the message names the nearest."""
    from warpshadow.scene.visibility import METHOD_TRAITS

    try:
        check.choice("method", text, METHOD_TRAITS)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    return text


def count_of_bounces(text: str) -> Any:
    """A number of bounces, or "all"; others are refused as everywhere else."""
    from warpshadow.scene.scene import check_bounces

    count = int(text) if text.lstrip("-").isdecimal() else text
    try:
        check_bounces(count)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    return count
