"""Writes layouts as text: layout files with every offset, and the types of members."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Final

from edoras_tools.structs.files import LAYOUT_VERSION

if TYPE_CHECKING:
    from edoras_tools.structs.shapes import Key, Member, StructLayout

_WORDS: Final = frozenset({"null", "true", "false", "yes", "no", "on", "off", "y", "n"})


def dumps(layout: StructLayout) -> str:
    """Return the text of a layout file, with every offset."""
    lines = [
        f"edoras_structs: {LAYOUT_VERSION}",
        f"byte_order: {layout.byte_order}",
        f"package: {layout.package}",
    ]
    if layout.bindings:
        lines.append("bind:")
        lines += [f"  {key}: {_name(name)}" for key, name in sorted(layout.bindings.items(), key=_order)]
    if layout.enums:
        lines.append("enums:")
        for item in layout.enums.values():
            lines += [f"  {_name(item.name)}:", f"    type: {item.basic}", "    values:"]
            lines += [f"      {_name(label)}: {value}" for value, label in item.names.items()]
            if not item.names:
                lines[-1] += " {}"
    lines.append("structs:" + ("" if layout.structs else " {}"))
    for struct in layout.structs.values():
        lines += [f"  {_name(struct.name)}:", f"    size: {struct.size}"]
        lines += [f"    header: {struct.header}"] * bool(struct.header)
        lines += ["    union: true"] * struct.union
        lines += [f"    doc: {json.dumps(struct.doc)}"] * bool(struct.doc)
        lines.append("    members:" + ("" if struct.members else " {}"))
        lines += [f"      {_name(item.name)}: {_member_text(item)}" for item in struct.members]
    return "\n".join(lines) + "\n"


def _name(name: str) -> str:
    """Return a name as YAML, in quotes where YAML would read another type."""
    return f"'{name}'" if name.lower() in _WORDS else name


def _order(item: tuple[Key, str]) -> tuple[int, int]:
    return item[0].msg_id, -1 if item[0].function_code is None else item[0].function_code


def _member_text(member: Member) -> str:
    text = type_text(member) + f" @{member.offset}" + (f".{member.bit}" if member.bits else "")
    return f"{{type: '{text}', doc: {json.dumps(member.doc)}}}" if member.doc else text


def type_text(member: Member) -> str:
    """Return a member's type as in a layout file, without its offset."""
    dims = "".join(f"[{size or ''}]" for size in member.dims)
    return f"{member.type}{dims}" + f":{member.bits}" * bool(member.bits) + " hex" * (member.base == 16)
