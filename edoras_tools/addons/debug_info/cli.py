"""``edoras structs``: C structs of flight software as message definitions, and as a layout to decode with."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, BadParameter, Option

from edoras_tools.cli.options import grouped
from edoras_tools.cli.output import tell
from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from edoras_tools.addons.debug_info.dwarf import Listed
    from edoras_tools.structs.shapes import Key, Member, Struct, StructLayout


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
        Path | None,
        Argument(metavar="FILE", help="ELF file, C header, layout, or data sheets; default: built in."),
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

    They are read from debug information, headers or data sheets (CCSDS 876.0, several files).

    Give the result to sniff, record and other commands with --set structs=DIR.
    """
    from edoras_tools.addons.debug_info import writing
    from edoras_tools.structs.files import is_package

    if package is not None and not is_package(package):
        raise ConfigError(f"--package: {package!r} is not a ROS package name; write a name like rover_msgs")
    names, sheets = _sorted_out(names or ())
    source = writing.open_types(file, include or (), cflag or (), sheets)
    bindings = writing.bindings_of(bind or ())
    out = sys.stdout
    if not names and not bindings and output is None:
        out.writelines(f"{line}\n" for line in listing(source.list(), source.bound()))
        tell(*source.warnings)
        return
    part = writing.take(source, names, bindings, package)
    tell(*source.warnings)
    if output is None:
        for place, (name, message) in enumerate(part.types.items()):
            out.write("\n" if place else "")
            out.writelines(f"{line}\n" for line in layout(part.layout, part.layout.structs[name], message))
        return
    written = writing.write_definitions(part, output, force=force)
    out.writelines(f"{path}\n" for path in written)
    unbound = [name for name in part.types if name not in part.layout.bindings.values()]
    if not part.layout.bindings:
        tell(
            f"no packet is bound yet: add --bind 0x0890={unbound[0] if unbound else 'NAME'}, "
            f"or an entry under 'bind' in {output / 'structs.yaml'}"
        )


def _sorted_out(words: Sequence[str]) -> tuple[list[str], list[Path]]:
    """Split words into names and data sheets (``.xml``)."""
    sheets = [word for word in words if word.lower().endswith(".xml")]
    return [word for word in words if word not in sheets], list(map(Path, sheets))


def listing(items: Sequence[Listed], bound: dict[str, str]) -> Iterator[str]:
    """Yield one line for each struct, first those that begin with a cFE header or are bound to a packet.

    Args:
        bound: the packets that contain structs, by the struct's name.
    """
    width = max([6, *(len(item.name) for item in items)])
    yield f"{'struct':<{width}}  {'bytes':>6}  {'members':>7}  packet"
    for item in sorted(items, key=lambda item: (item.name not in bound, not item.header, item.name)):
        packet = bound.get(item.name) or (f"begins with a header of {item.header}" if item.header else "")
        yield f"{item.name:<{width}}  {item.size:>6}  {item.members:>7}  {packet}".rstrip()


def layout(structs: StructLayout, struct: Struct, message: str) -> Iterator[str]:
    """Yield lines with the offsets of a struct's members, its padding, and the fields of its message.

    Args:
        message: full name of the message type.
    """
    packets = [str(key) for key, name in structs.bindings.items() if name == struct.name]
    kind = "union" if struct.union else "struct"
    yield f"{kind} {struct.name}: {struct.size} bytes, {structs.byte_order}-endian, {message}"
    if packets:
        yield f"  in {', '.join(packets)}"
    from edoras_tools.structs.files import type_text
    from edoras_tools.structs.messages import parts

    whole = bool(struct.header or packets)
    fields = {part.member.name: part.name for part in parts(structs, struct, whole=whole)}
    rows = [(_place(item), type_text(item), item.name, fields.get(item.name, "")) for item in struct.members]
    widths = [max([0, *(len(row[column]) for row in rows)]) for column in range(3)]
    end = 0
    for member, row in zip(struct.members, rows, strict=True):
        if member.offset > end and not struct.union:
            yield f"  {end:>{widths[0]}}  {_padding(member.offset - end)}"
        yield "  {:>{}}  {:<{}}  {:<{}}  {}".format(
            row[0], widths[0], row[1], widths[1], row[2], widths[2], row[3]
        ).rstrip()
        size = (member.bit + member.bits + 7) // 8 if member.bits else structs.size(member) * member.count
        end = max(end, member.offset + size)
    if struct.size > end:
        yield f"  {end:>{widths[0]}}  {_padding(struct.size - end)}"


def _padding(size: int) -> str:
    return f"{size} byte{'s' * (size > 1)} of padding"


def _place(member: Member) -> str:
    return f"{member.offset}.{member.bit}" if member.bits else str(member.offset)
