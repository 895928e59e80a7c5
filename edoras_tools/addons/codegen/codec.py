"""The code of a package: its messages' default values, and their CDR, field by field as it travels."""

from __future__ import annotations

from typing import Final

from edoras_tools.addons.codegen.header import c_type, header_name, heads
from edoras_tools.addons.codegen.layout import banner, function, loop, statement
from edoras_tools.addons.codegen.names import literal
from edoras_tools.addons.codegen.plan import CLibrary, CMember, Message, utf16

_ONE_BY_ONE: Final = frozenset({"bool", "string", "wstring", "message"})
"""Kinds of which many are not copied at once: any byte but 0 is true."""


def codec(library: CLibrary, package: str, command: str) -> str:
    """Return the text of a package's ``.c`` file."""
    messages = library.of(package)
    head = banner(command, f"The messages of {package}: default values, CDR to and fro.", messages)
    includes = f'#include "{header_name(package)}"\n\n#include <string.h>\n'
    return "\n".join([head + includes, *(part for item in messages for part in _functions(item))])


def _functions(message: Message) -> list[str]:
    return [_init(message), _read(message), _write(message), _decode(message), _encode(message)]


def _init(message: Message) -> str:
    arrays = [
        f"static const {c_type(member)} {member.name}_default[{len(member.ros.default)}] = "
        f"{{{', '.join(literal(member.ros.type, item) for item in member.ros.default)}}}"
        for member in message.members
        if member.ros.default and member.elements and not member.characters
    ]
    wide = [
        f"static const uint16_t {name}_default[] = {{{', '.join(f'{unit}U' for unit in (*utf16(text), 0))}}}"
        for member in message.members
        if member.kind == "wstring"
        for name, text in _texts(member)
    ]
    loops = any(
        member.message and member.message.has_defaults and member.elements and not member.is_sequence
        for member in message.members
    )
    variables = [*arrays, *wide, *["uint32_t i"] * loops]
    body = "    (void)memset(message, 0, sizeof(*message));\n"
    body += "".join(_default(member) for member in message.members)
    return function(heads(message.name)["init"], variables, body)


def _default(member: CMember) -> str:
    """Return what gives a field its default, once all is zero."""
    place, default = f"message->{member.name}", member.ros.default
    if member.message:
        if not member.message.has_defaults or member.is_sequence:
            return ""
        call = f"{member.message.name}__init(&{place}{{}});"
        if member.elements:
            return loop(f"EDORAS_CAPACITY({place})", call.format("[i]"))
        return statement(call.format(""))
    if default is None:
        return ""
    data = f"{place}.data" if member.is_sequence else place
    text = statement(f"{place}.size = {len(default)}U;") if member.is_sequence else ""
    if member.characters:
        return text + "".join(
            _default_text(member, f"{data}[{number}]" if member.elements else place, name, value)
            for number, (name, value) in enumerate(_texts(member))
        )
    if member.elements:
        copied = f"(void)memcpy({data}, {member.name}_default, sizeof({member.name}_default));"
        return text + (statement(copied) if default else "")
    return statement(f"{place} = {literal(member.ros.type, default)};")


def _texts(member: CMember) -> list[tuple[str, str]]:
    """Return the default strings of a field, each with a name for it."""
    default = member.ros.default
    if not member.elements:
        return [(member.name, default)] if default is not None else []
    return [(f"{member.name}_{number}", item) for number, item in enumerate(default or [])]


def _default_text(member: CMember, place: str, name: str, value: str) -> str:
    if member.kind == "string":
        return statement(f"(void)EDORAS_SET_STRING({place}, {literal('string', value)});")
    copied = f"(void)memcpy({place}.data, {name}_default, sizeof({name}_default));"
    return statement(f"{place}.size = {len(utf16(value))}U;") + statement(copied)


def _read(message: Message) -> str:
    head = heads(message.name)["read"]
    loops = any(_loops(member) for member in message.members)
    return function(head, ["uint32_t i"] * loops, "".join(map(_read_member, message.members)))


def _read_member(member: CMember) -> str:
    place = f"message->{member.name}"
    if not member.elements:
        return statement(_read_one(member, place))
    if member.is_sequence:
        data, limit = f"{place}.data", f"{place}.size"
        text = statement(f"{limit} = edoras_read_count(reader, EDORAS_CAPACITY({data}));")
    else:
        data, limit, text = place, f"EDORAS_CAPACITY({place})", ""
    if member.kind not in _ONE_BY_ONE:
        return text + statement(f"edoras_read_many(reader, {data}, {limit}, sizeof({data}[0]));")
    return text + loop(limit, _read_one(member, f"{data}[i]"))


def _read_one(member: CMember, place: str) -> str:
    if member.message:
        return f"{member.message.name}__read(reader, &{place});"
    if member.characters:
        data = f"{place}.data"
        return f"{place}.size = edoras_read_{member.kind}(reader, {data}, EDORAS_CAPACITY({data}));"
    return f"{place} = edoras_read_{member.kind}(reader);"


def _write(message: Message) -> str:
    head = heads(message.name)["write"]
    loops = any(_loops(member) for member in message.members)
    counts = any(member.is_sequence for member in message.members)
    variables = ["uint32_t count"] * counts + ["uint32_t i"] * loops
    return function(head, variables, "".join(map(_write_member, message.members)))


def _write_member(member: CMember) -> str:
    place = f"message->{member.name}"
    if not member.elements:
        return statement(_write_one(member, place))
    if member.is_sequence:
        data, limit = f"{place}.data", "count"
        text = statement(f"count = edoras_write_count(writer, {place}.size, EDORAS_CAPACITY({data}));")
    else:
        data, limit, text = place, f"EDORAS_CAPACITY({place})", ""
    if member.kind not in _ONE_BY_ONE:
        return text + statement(f"edoras_write_many(writer, {data}, {limit}, sizeof({data}[0]));")
    return text + loop(limit, _write_one(member, f"{data}[i]"))


def _write_one(member: CMember, place: str) -> str:
    if member.message:
        return f"{member.message.name}__write(writer, &{place});"
    if member.characters:
        data = f"{place}.data"
        return f"edoras_write_{member.kind}(writer, {data}, {place}.size, EDORAS_CAPACITY({data}));"
    return f"edoras_write_{member.kind}(writer, {place});"


def _loops(member: CMember) -> bool:
    return bool(member.elements) and member.kind in _ONE_BY_ONE


def _decode(message: Message) -> str:
    name = message.name
    body = f"""\
    if (message != NULL) {{
        edoras_reader_t reader;

        edoras_reader_open(&reader, cdr, length);
        {name}__read(&reader, message);
        status = edoras_reader_close(&reader, {message.most_trailing}U);
        if (status != EDORAS_OK) {{
            {name}__init(message);
        }}
    }}
    return status;
"""
    return function(heads(name)["decode"], ["edoras_status_t status = EDORAS_ARGUMENT"], body)


def _encode(message: Message) -> str:
    name = message.name
    body = f"""\
    edoras_writer_open(&writer, (message == NULL) ? NULL : buffer, size);
    if (message != NULL) {{
        {name}__write(&writer, message);
    }}
    return edoras_writer_close(&writer, length);
"""
    return function(heads(name)["encode"], ["edoras_writer_t writer"], body)
