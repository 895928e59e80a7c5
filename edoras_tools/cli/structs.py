"""``edoras structs``: C structs of flight software as message definitions, and as a layout to decode with."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, BadParameter, Option

from edoras_tools.cli.declare import grouped
from edoras_tools.cli.endings import tell
from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from edoras_tools.structs.shapes import Key


def binding(text: str) -> tuple[Key, str]:
    """Read ``MSGID=STRUCT``, ``MSGID/CODE=STRUCT`` or ``udp:PORT=STRUCT``."""
    from edoras_tools.structs.files import parse_key

    key, equals, name = text.partition("=")
    if not equals or not name:
        raise BadParameter(f"{text!r} is not MSGID=STRUCT; write 0x0890=ROVER_HkTlm_t")
    try:
        return parse_key(key), name
    except ConfigError as error:
        raise BadParameter(str(error)) from None


@grouped
def structs(
    file: Annotated[
        Path | None, Argument(metavar="FILE", help="ELF file, C header, or layout; default: built in.")
    ] = None,
    names: Annotated[list[str] | None, Argument(metavar="NAME...", help="Default: list them all.")] = None,
    output: Annotated[Path | None, Option("--output", "-o", help="For .msg files and structs.yaml.")] = None,
    bind: Annotated[
        list[Any] | None,
        Option(
            "--bind",
            "-b",
            parser=binding,
            metavar="ID=NAME",
            help="The struct of a MsgId, e.g. 0x0890=ROVER_HkTlm_t, 0x1890/2=X for a function code, or "
            "udp:8585=X for what is sent to a robot's port.",
        ),
    ] = None,
    package: Annotated[str | None, Option(help="ROS package of the messages; default: cfs_msgs.")] = None,
    include: Annotated[list[Path] | None, Option("--include", "-I", hidden=True)] = None,
    cflag: Annotated[list[str] | None, Option(help="Compiler option, e.g. -IDIR, -m32 or -DX=1.")] = None,
    force: Annotated[bool, Option("--force", help="Overwrite existing files.")] = False,
) -> None:
    """Turn C structs of flight software into ROS messages.

    They are read from debug information or headers.

    Give the result to sniff, record and other commands with --structs DIR.
    """
    from edoras_tools.pipelines import structs as run
    from edoras_tools.render import structs as view
    from edoras_tools.structs.files import is_package

    if package is not None and not is_package(package):
        raise ConfigError(f"--package: {package!r} is not a ROS package name; write a name like rover_msgs")
    source = run.open_types(file, include or (), cflag or ())
    bindings = run.bindings_of(bind or ())
    out = sys.stdout
    if not names and not bindings and output is None:
        bound = run.bound(source)
        out.writelines(f"{line}\n" for line in view.listing(source.list(), bound))
        return
    taken = run.take(source, names or (), bindings, package)
    for line in source.warnings:
        tell(line)
    if output is None:
        for place, (name, message) in enumerate(taken.types.items()):
            out.write("\n" if place else "")
            out.writelines(
                f"{line}\n" for line in view.layout(taken.layout, taken.layout.structs[name], message)
            )
        return
    written = run.write_definitions(taken, output, force=force)
    out.writelines(f"{path}\n" for path in written)
    unbound = [name for name in taken.types if name not in taken.layout.bindings.values()]
    if not taken.layout.bindings:
        tell(
            f"no packet is bound yet: add --bind 0x0890={unbound[0] if unbound else 'NAME'}, "
            f"or an entry under 'bind' in {output / 'structs.yaml'}"
        )
