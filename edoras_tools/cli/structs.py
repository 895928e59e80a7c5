"""``edoras structs``: C structs of flight software as message definitions, and as a layout to decode with."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from edoras_tools.structs.shapes import Key


def binding(text: str) -> tuple[Key, str]:
    """Read ``MSGID=STRUCT`` or ``MSGID/CODE=STRUCT``."""
    from edoras_tools.errors import ConfigError
    from edoras_tools.structs.files import parse_key

    key, equals, name = text.partition("=")
    if not equals or not name:
        raise typer.BadParameter(f"{text!r} binds nothing; write 0x0890=ROVER_HkTlm_t")
    try:
        return parse_key(key), name
    except ConfigError as error:
        raise typer.BadParameter(str(error)) from None


def structs(
    file: Annotated[
        Path | None,
        typer.Argument(
            metavar="FILE", help="ELF file (.o, .so, program), C header, or layout; none: what is shipped."
        ),
    ] = None,
    names: Annotated[
        list[str] | None, typer.Argument(metavar="NAME...", help="Structs; none: a list of all there are.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="Write .msg files and structs.yaml there."),
    ] = None,
    bind: Annotated[
        list[Any] | None,
        typer.Option(
            "--bind",
            "-b",
            metavar="ID=NAME",
            parser=binding,
            help="The struct of a MsgId, as 0x0890=ROVER_HkTlm_t; 0x1890/2=X of a function code; repeatable.",
        ),
    ] = None,
    package: Annotated[
        str | None, typer.Option(metavar="NAME", help="ROS package of the messages; cfs_msgs.")
    ] = None,
    include: Annotated[
        list[Path] | None,
        typer.Option("--include", "-I", metavar="DIR", help="Where a header's headers are; repeatable."),
    ] = None,
    cflag: Annotated[
        list[str] | None,
        typer.Option(metavar="FLAG", help="For the compiler of a header, as -m32 or -DX=1; repeatable."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Write over files that are there.")] = False,
) -> None:
    """Turn C structs of flight software into ROS messages, from debug information or headers.

    What is written is given to sniff, record and the others with --structs DIR.
    """
    from edoras_tools.errors import ConfigError
    from edoras_tools.pipelines import structs as run
    from edoras_tools.render import structs as view
    from edoras_tools.structs.files import is_package

    if package is not None and not is_package(package):
        raise ConfigError(f"--package: {package!r} is no name of a ROS package, as rover_msgs")
    source = run.open_types(file, include or (), cflag or ())
    bindings = run.bindings_of(bind or ())
    out = sys.stdout
    if not names and not bindings and output is None:
        bound = run.bound(source)
        out.writelines(f"{line}\n" for line in view.listing(source.list(), bound))
        return
    taken = run.take(source, names or (), bindings, package)
    for line in source.warnings:
        sys.stderr.write(f"edoras: {line}\n")
    if output is None:
        for place, (name, message) in enumerate(taken.types.items()):
            out.write("\n" if place else "")
            out.writelines(
                f"{line}\n" for line in view.layout(taken.layout, taken.layout.structs[name], message)
            )
        return
    written = run.write(taken, output, force=force)
    out.writelines(f"{path}\n" for path in written)
    unbound = [name for name in taken.types if name not in taken.layout.bindings.values()]
    if not taken.layout.bindings:
        sys.stderr.write(
            f"edoras: no packet is bound yet: say --bind 0x0890={unbound[0] if unbound else 'NAME'}, "
            f"or write it into {output / 'structs.yaml'} under 'bind'\n"
        )
