"""``edoras``: the commands put together, and what the shell is told when one fails."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from importlib import import_module
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, Any, Final, NoReturn

import typer

from edoras_tools import __version__
from edoras_tools.errors import EdorasError

_SETTINGS = {"help_option_names": ["-h", "--help"]}
_USAGE: Final[Any] = typer.BadParameter.__mro__[1]
"""Click's root of all that a command line can be wrong in; typer brings its own click or not, by version."""

INTERRUPTED: Final = 130
"""What shells say of a program that Ctrl-C ended."""

COMMANDS: Final = (
    *("demo", "sniff", "record", "live", "info", "decode", "recover"),
    *("replay", "inject", "sweep", "proxy", "bridge", "doctor", "report", "sim", "wireshark", "codegen"),
    "structs",
)
"""Each is a function, or a group of commands, of that name in a module of that name."""


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"edoras-tools {__version__}")
        raise typer.Exit


def _edoras(
    _version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit."),
    ] = False,
) -> None:
    """Hold the options of no command."""


def program(*names: str) -> typer.Typer:
    """Make ``edoras``.

    Args:
        names: commands to put in; all where none is named. Making one takes time, and most are not run.
    """
    made = typer.Typer(
        name="edoras",
        help="Capture, decode, record, replay and diagnose ROS 2 traffic through NASA's cFS.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        context_settings=_SETTINGS,
        epilog="Start with: edoras demo",
    )
    made.callback()(_edoras)
    for name in names or COMMANDS:
        command = _command(name)
        if isinstance(command, typer.Typer):
            made.add_typer(command)
        else:
            made.command()(command)
    return made


def _command(name: str) -> Any:
    return getattr(import_module(f"edoras_tools.cli.{name}"), name)


def alone(name: str) -> typer.Typer:
    """Make a program of one command."""
    made = typer.Typer(
        name=f"edoras-{name}",
        add_completion=False,
        pretty_exceptions_enable=False,
        context_settings=_SETTINGS,
    )
    made.command()(_command(name))
    return made


def run(made: typer.Typer) -> NoReturn:
    """Run a command line to its exit code: one clear line for what went wrong, never a traceback.

    Exit codes: 0 fine, 1 failed, 2 usage, 3 finished but data was lost or found lost, 130 given up at Ctrl-C.
    """
    _open_streams()
    if isinstance(sys.stdout, TextIOWrapper):
        # File names may hold bytes that are no text, and not every terminal has an arrow.
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        code = made(standalone_mode=False) or 0
        sys.stdout.flush()
    except EdorasError as error:
        code = error.exit_code
        _say(str(error))
    except _USAGE as error:
        code = error.exit_code
        told = error.format_message().replace("Value error, ", "")  # the words of typer's own checks
        command = error.ctx.command_path if error.ctx else made.info.name
        _say(f"{told.removesuffix('.')}; {command} -h tells more" if told else "")
    except SystemExit as error:
        # Click's way out of a broken pipe: the reader of our output, as `head`, has seen enough.
        code = 0 if isinstance(error.__context__, BrokenPipeError) else error.code
        _abandon_output()
    except BrokenPipeError:
        code = 0
        _abandon_output()
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
        _abandon_output()
    except OSError as error:
        # Files and sockets raise EdorasError: this is standard output.
        code = 1
        _say(f"standard output cannot be written: {error.strerror or error}")
        _abandon_output()
    sys.exit(code)


def _open_streams() -> None:
    """Give Python the streams that it goes without when their descriptors were closed, as by ``>&-``."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115  for good


def _say(message: str) -> None:
    with suppress(OSError):
        for line in message.splitlines():
            sys.stderr.write(f"edoras: {line}\n")


def _abandon_output() -> None:
    """Keep Python from writing at exit what could not be written before."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
