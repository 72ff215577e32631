"""The application, and the habits that all commands share: notes, errors in one line, interrupts."""

import contextlib
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer
import typer.core
import warp as wp

from warpshadow import __version__, check, quiet
from warpshadow.assets import files

_COMMAND_REMEDIES = {
    "explain": "in Python, Renderer(scene).explain() lists the stages of an image, and which are cached"
}
"""Remedies for commands that there are not."""


class _Commands(typer.core.TyperGroup):
    """All commands."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the command of a command line."""
        if args and args[0] in _COMMAND_REMEDIES:
            ctx.fail(f"No such command '{args[0]}': {_COMMAND_REMEDIES[args[0]]}.")
        return super().resolve_command(ctx, args)


app = typer.Typer(
    cls=_Commands,
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Soft shadows on meshes under environment light, differentiable, on CPU and CUDA.",
)

# Exit statuses beside 0, 1 (a mistake in a file or value) and 2 (a mistake in the command line).
DIVERGED = 3
UNEXPLAINED = 4
INTERRUPTED = 130

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
        help="Print reports, warnings and errors alone: no progress, and no names of files.",
        callback=_start,
    ),
]


def note(text: str, is_quiet: bool) -> None:
    """Print progress and the files that were written."""
    if not is_quiet:
        typer.echo(text)


def _print_version(prints: bool) -> None:
    if prints:
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


def report_interrupt(how: str = "") -> typer.Exit:
    """Say in one line that the user interrupted the command, and how it goes on; returns the exit."""
    typer.secho(f"interrupted{how}", fg="yellow", err=True)
    return typer.Exit(INTERRUPTED)


@contextlib.contextmanager
def clear_errors() -> Iterator[None]:
    """Turn errors in the user's input into one line and exit status 1, and an interrupt into one and 130."""
    try:
        yield
    except KeyboardInterrupt as error:
        remark = f"; {error}" if error.args else ""
        raise report_interrupt(remark) from error  # at once: threads and kernels take a second to end
    except (ValueError, OSError, ImportError) as error:
        message = error if error.args else type(error).__name__
        typer.secho(f"error: {message}", fg="red", err=True)
        raise typer.Exit(1) from error


def check_output(path: Path, *suffixes: str, instead: str = "") -> None:
    """Find out before the work whether its result can be written; a wrong extension may mean another option."""
    if path.suffix.lower() not in suffixes and not path.is_dir():
        raise ValueError(f"{path}: got extension {path.suffix!r}, expected {' or '.join(suffixes)}{instead}")
    files.check_file(path)


def device_of(name: str) -> wp.Device:
    """The device of an option."""
    return check.device("device", name)
