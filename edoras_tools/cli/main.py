"""``edoras``: the commands put together, and what the shell is told when one fails."""

from __future__ import annotations

import os
import sys
from typing import Annotated, NoReturn

import typer

from edoras_tools import __version__
from edoras_tools.cli.decode import decode
from edoras_tools.cli.demo import demo
from edoras_tools.cli.info import info
from edoras_tools.cli.record import record as record_command
from edoras_tools.cli.recover import recover
from edoras_tools.cli.sim import sim
from edoras_tools.cli.sniff import sniff as sniff_command
from edoras_tools.errors import EdorasError

_SETTINGS = {"help_option_names": ["-h", "--help"]}

app = typer.Typer(
    name="edoras",
    help="Capture, decode and record ROS 2 traffic of EDORAS bridges through NASA's core Flight System.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings=_SETTINGS,
    epilog="Start with: edoras demo",
)
for command in (demo, sniff_command, record_command, info, decode, recover, sim):
    app.command()(command)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"edoras-tools {__version__}")
        raise typer.Exit


@app.callback()
def _edoras(
    _version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit."),
    ] = False,
) -> None:
    """Hold the options of no command."""


def _alone(function: typer.models.CommandFunctionType, name: str) -> typer.Typer:
    """Make a program of one command."""
    program = typer.Typer(
        name=name, add_completion=False, pretty_exceptions_enable=False, context_settings=_SETTINGS
    )
    program.command()(function)
    return program


def run(program: typer.Typer) -> NoReturn:
    """Run a command line to its exit code: one clear line for what went wrong, never a traceback.

    Exit codes: 0 fine, 1 failed, 2 usage, 3 finished but data was lost or found lost.
    """
    try:
        program()
    except EdorasError as error:
        for line in str(error).splitlines():
            sys.stderr.write(f"edoras: {line}\n")
        code = error.exit_code
    except BrokenPipeError:
        # The reader of our output, as `head`, has seen enough; Python must not complain of it at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except KeyboardInterrupt:
        code = 130
    else:
        code = 0
    sys.exit(code)


def main() -> NoReturn:
    """Run ``edoras``."""
    run(app)


def sniff() -> NoReturn:
    """Run ``edoras-sniff``."""
    run(_alone(sniff_command, "edoras-sniff"))


def record() -> NoReturn:
    """Run ``edoras-record``."""
    run(_alone(record_command, "edoras-record"))
