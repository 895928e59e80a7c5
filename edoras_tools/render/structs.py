"""Listing of C structs, and the layout of one."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.structs.files import type_text
from edoras_tools.structs.messages import parts

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edoras_tools.structs.debug_info.dwarf import Listed
    from edoras_tools.structs.shapes import Member, Struct, StructLayout


def listing(items: Sequence[Listed], bound: dict[str, str]) -> Iterator[str]:
    """Yield one line for each struct, first those that begin with a cFE header or are bound to a packet.

    Args:
        bound: the packets that some lie in, by name.
    """
    width = max([6, *(len(item.name) for item in items)])
    yield f"{'struct':<{width}}  {'bytes':>6}  {'members':>7}  packet"
    for item in sorted(items, key=lambda item: (item.name not in bound, not item.header, item.name)):
        packet = bound.get(item.name) or (f"begins with a header of {item.header}" if item.header else "")
        yield f"{item.name:<{width}}  {item.size:>6}  {item.members:>7}  {packet}".rstrip()


def layout(structs: StructLayout, struct: Struct, message: str) -> Iterator[str]:
    """Yield where the members of a struct lie, what fills up between them, and its message's fields.

    Args:
        message: the message's type in full.
    """
    packets = [str(key) for key, name in structs.bindings.items() if name == struct.name]
    kind = "union" if struct.union else "struct"
    yield f"{kind} {struct.name}: {struct.size} bytes, {structs.byte_order}-endian, {message}"
    if packets:
        yield f"  in {', '.join(packets)}"
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
