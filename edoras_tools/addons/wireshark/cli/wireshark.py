"""``edoras wireshark``: the dissector for Wireshark and tshark, and the links as capture interfaces."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from typer import Argument, Exit, Option

from edoras_tools.cli import options, recordings
from edoras_tools.cli.main import Command, command_group
from edoras_tools.cli.options import grouped
from edoras_tools.cli.output import tell
from edoras_tools.io.formats.table import READ

To = Annotated[Path | None, Option("--to", help="A folder other than Wireshark's own.")]

wireshark = command_group("wireshark", "Decode the links in Wireshark and tshark, to ROS fields.")
extcap = command_group("extcap", "EDORAS CI, TO and SBN as capture interfaces of Wireshark.")
wireshark.add_typer(extcap)


def _dissector(decoding: options.DecodingOptions) -> str:
    from edoras_tools.addons.wireshark.program import dissector

    text, warnings = dissector(decoding.settings())
    tell(*warnings)
    return text


@wireshark.command(cls=Command)
@grouped
def install(*, to: To = None, force: recordings.Force = False, decoding: options.DecodingOptions) -> None:
    """Copy the dissector to the personal plugin folder, and a profile with columns, colours and graphs.

    The dissector has the missions of -c, or the demos' routes.
    """
    from edoras_tools.addons.wireshark import program

    sys.stdout.write(f"{program.install(_dissector(decoding), to, force=force)}\n")
    if to is not None:
        return
    folder, ours = program.install_profile()
    if ours:
        sys.stdout.write(f"{folder}\n")
    else:
        tell(f"{folder} is another profile of that name, or was changed since, and is kept")


@wireshark.command(cls=Command)
def uninstall() -> None:
    """Remove what install and extcap install wrote; a profile that was changed since is kept."""
    from edoras_tools.addons.wireshark import program

    items = [*program.uninstall()]
    for path, removed in items:
        if removed:
            sys.stdout.write(f"{path}\n")
        else:
            tell(f"{path} is not as it was installed, and is kept; delete it by hand")
    if not items:
        tell("nothing is installed")


@wireshark.command("print", cls=Command)
@grouped
def print_(decoding: options.DecodingOptions) -> None:
    """Print the dissector, with the missions of -c or the demos' routes."""
    sys.stdout.write(_dissector(decoding))


@wireshark.command()
def path() -> None:
    """Print the path of the dissector with the routes of the demos, for tshark -X lua_script:..."""
    from importlib.resources import files

    sys.stdout.write(f"{files('edoras_tools.dissectors') / 'edoras.lua'}\n")


@wireshark.command(cls=Command)
@grouped
def run(
    *,
    read: Annotated[Path | None, Option("--read", "-r", help=f"{READ}; - is stdin.")] = None,
    gui: Annotated[bool, Option("--gui", help="Run Wireshark instead of tshark.")] = False,
    arguments: Annotated[list[str] | None, Argument(metavar="-- ARGUMENTS", help="For Wireshark.")] = None,
    decoding: options.DecodingOptions,
) -> None:
    """Run tshark, or Wireshark, with the dissector.

    For example: edoras wireshark run -r FILE -c MISSION -- -V
    """
    from edoras_tools.addons.wireshark import program

    code = program.run_program(_dissector(decoding), read, arguments or [], graphical=gui)
    if code:
        raise Exit(code)


@extcap.command("install")
@grouped
def install_extcap(to: To = None, force: recordings.Force = False) -> None:
    """Copy the launcher of EDORAS CI, TO and SBN to Wireshark's extcap folder."""
    from edoras_tools.addons.wireshark import program

    sys.stdout.write(f"{program.install_extcap(to, force=force)}\n")
