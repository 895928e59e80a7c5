"""The table of names behind ``get_float64(message, type, "position.0", ...)``, and the pools."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from edoras_tools.codegen.header import UMBRELLA
from edoras_tools.codegen.layout import LINE_WIDTH, banner

if TYPE_CHECKING:
    from edoras_tools.codegen.plan import CLibrary, CMember, Message

_INCLUDES: Final = f'#include "{UMBRELLA}"\n#include "edoras_core/tables.h"\n'


def tables(library: CLibrary, command: str) -> str:
    """Return the text of the file that holds the tables."""
    about = "Every field by its name, for the functions of edoras_core, and the pools behind create_msg."
    wanted = {message.ros_name for message in library.wanted}
    parts = [banner(command, about) + _INCLUDES]
    parts += [_table(message, pooled=message.ros_name in wanted) for message in library.messages]
    listed = sorted(
        library.messages, key=lambda message: (message.package, message.short_name, message.ros_name)
    )
    rows = "".join(f'    {{"edoras_codegen", &{message.name}__type}},\n' for message in listed)
    parts.append(
        f"const TypeSupport_t edoras_types[] = {{\n{rows}}};\n\n"
        "const size_t edoras_types_count = EDORAS_CAPACITY(edoras_types);\n"
    )
    return "\n".join(parts)


def _table(message: Message, *, pooled: bool) -> str:
    name = message.name
    rows = "".join(_row(name, member) for member in sorted(message.members, key=lambda item: item.ros.name))
    return f"""\
EDORAS_FUNCTIONS({name})

static const MemberInfo_t {name}__members[] = {{
{rows}}};

{f"EDORAS_MAKE_POOL({name}){chr(10) * 2}" if pooled else ""}\
static const TypeInfo_t {name}__type = {{
    "{message.package}",
    "{message.short_name}",
    {len(message.members)}U,
    sizeof({name}),
    EDORAS_BUFFER_SIZE({name}),
    {name}__members,
    {name}__init_any,
    {name}__encode_any,
    {name}__decode_any,
    {f"&{name}__pool" if pooled else "NULL"},
}};
"""


def _row(owner: str, member: CMember) -> str:
    shape = "EDORAS_SEQUENCE" if member.is_sequence else "EDORAS_ARRAY" if member.elements else "EDORAS_ONE"
    nested = f"&{member.message.name}__type" if member.message else "NULL"
    length = member.characters + 1 if member.characters else 0
    head = f'    {{"{member.ros.name}", EDORAS_KIND_{member.kind.upper()}, '
    head += f"{'true' if member.is_sequence else 'false'}, {length}U, {nested},"
    where = f"{shape}({owner}, {member.name})}},\n"
    return f"{head} {where}" if len(head) + len(where) < LINE_WIDTH else f"{head}\n     {where}"
