"""``edoras wireshark``: the dissector for Wireshark and tshark, and our links as capture interfaces."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edoras_tools.cli import options

if TYPE_CHECKING:
    from edoras_tools.pipelines.workbench import Settings

To = Annotated[Path | None, typer.Option("--to", metavar="DIR", help="Another folder than Wireshark's own.")]

wireshark = typer.Typer(
    name="wireshark",
    help="Decode the three links in Wireshark and tshark: headers, findings and ROS fields.",
    no_args_is_help=True,
    add_completion=False,
)
extcap = typer.Typer(
    name="extcap",
    help="EDORAS CI, TO and SBN among Wireshark's capture interfaces.",
    no_args_is_help=True,
    add_completion=False,
)
wireshark.add_typer(extcap)


def _dissector(settings: Settings) -> str:
    from edoras_tools.pipelines.wireshark import dissector

    text, warnings = dissector(settings)
    for warning in warnings:
        sys.stderr.write(f"edoras: {warning}\n")
    return text


@wireshark.command()
@options.takes_decoding
def install(settings: Settings, to: To = None) -> None:
    """Copy the dissector to the personal plugin folder, with the missions of -c or the demos' routes."""
    from edoras_tools.pipelines import wireshark_program

    sys.stdout.write(f"{wireshark_program.install(_dissector(settings), to)}\n")


@wireshark.command("print")
@options.takes_decoding
def print_(settings: Settings) -> None:
    """Print the dissector, with the missions of -c or the demos' routes."""
    sys.stdout.write(_dissector(settings))


@wireshark.command()
def path() -> None:
    """Print where the dissector with the demos' routes lies, for tshark -X lua_script:..."""
    from importlib.resources import files

    sys.stdout.write(f"{files('edoras_tools.dissectors') / 'edoras.lua'}\n")


@wireshark.command()
@options.takes_decoding
def run(
    settings: Settings,
    read: Annotated[
        Path | None,
        typer.Option("--read", "-r", metavar="FILE", help="pcap, pcapng or MCAP; - is stdin."),
    ] = None,
    gui: Annotated[bool, typer.Option("--gui", help="Run Wireshark, not tshark.")] = False,
    arguments: Annotated[
        list[str] | None, typer.Argument(metavar="-- ARGUMENTS", help="For tshark or Wireshark.")
    ] = None,
) -> None:
    """Run tshark, or Wireshark, with the dissector.

    For example: edoras wireshark run -r FILE -c MISSION -- -V
    """
    from edoras_tools.pipelines import wireshark_program

    code = wireshark_program.run(_dissector(settings), read, arguments or [], graphical=gui)
    if code:
        raise typer.Exit(code)


@extcap.command("install")
def install_extcap(to: To = None) -> None:
    """Copy the launcher of EDORAS CI, TO and SBN to Wireshark's extcap folder."""
    from edoras_tools.pipelines import wireshark_program

    sys.stdout.write(f"{wireshark_program.install_extcap(to)}\n")
