"""What cFE's core services and the usual applications send and take, so that it decodes without an ELF file.

``cfe.json`` beside this file has the structs, as any layout file. Each describes the bytes after the packet's
header. Numbers are little-endian; the order and widths of telemetry members were measured on a flight. Names
follow this package's words, not cFE's. Events and the counters of the software bus come from the tables of
:mod:`edoras_tools.wire.cfe`, with which the sessions write them; commands come from the table of their
arguments, :mod:`edoras_tools.cfs.arguments`.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Final

from msgspec.structs import replace

from edoras_tools.cfs.arguments import ARGUMENTS, BARE_TOO, SERVICES, TAILS
from edoras_tools.structs import shapes
from edoras_tools.structs.files import layout_of
from edoras_tools.wire import cfe
from edoras_tools.wire import layout as wire
from edoras_tools.wire.ccsds import VERSION_1, MsgIds

LAYOUT_NAME: Final = shapes.SHIPPED
"""Name of this layout on the command line."""
_FILE: Final = Path(__file__).with_name("cfe.json")
"""A layout file without its packets: their MsgIds depend on the version."""
_WIRE_LAYOUTS: Final = {
    cfe.EVENT_MSG_ID: cfe.EVENT,
    cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID: cfe.SOFTWARE_BUS_HOUSEKEEPING,
}
"""Packets that the tables of ``wire`` describe, by MsgId of version 1; so do those of ``DATAGRAMS``."""


@cache
def shipped_layout(msg_ids: MsgIds = VERSION_1) -> shapes.StructLayout:
    """Return the layout of the packets that cFE itself sends and takes, with MsgIds of a version."""
    bound = {
        msg_id: name
        for msg_id, name in shapes.packets(msg_ids).items()
        if msg_ids.standard(msg_id) not in _WIRE_LAYOUTS
    }
    layout = layout_of({**json.loads(_FILE.read_bytes()), "bind": bound}, LAYOUT_NAME)
    structs, enums = dict(layout.structs), dict(layout.enums)
    bindings = dict(layout.bindings)
    for msg_id, header in _WIRE_LAYOUTS.items():
        name = shapes.PACKETS[msg_id]
        structs[name] = _of_header(name, header, enums)
        bindings[shapes.Key(msg_ids.of_known(msg_id))] = name
    for size, header in shapes.DATAGRAMS.items():
        structs[header.name] = _of_header(header.name, header, enums)
        bindings[shapes.Key(shapes.UDP_KEY, size)] = header.name
    for (msg_id, code), arguments in ARGUMENTS.items():
        if arguments.size and (msg_id, code) not in BARE_TOO:
            name = command_type(msg_id, arguments.title)
            command = _of_header(name, arguments, enums)
            structs[name] = replace(command, tail=TAILS.get((msg_id, arguments.title), 0))
            bindings[shapes.Key(msg_ids.of_known(msg_id), code)] = name
    return shapes.StructLayout(structs, enums, bindings, origin=LAYOUT_NAME)


def command_type(msg_id: int, title: str) -> str:
    """Return the struct name of a command, as ``CFE_ES_StopAppCmd``.

    Args:
        msg_id: MsgId of version 1.
        title: name of the command in its application.
    """
    return f"{SERVICES[msg_id][1]}_{title.title().replace('_', '')}Cmd"


def _of_header(name: str, header: wire.Layout, enums: dict[str, shapes.Enumeration]) -> shapes.Struct:
    """Return the table of a header, or of a command's arguments, as a struct, without spare bytes."""
    members = []
    for slot in header.slots:
        item, size = slot.field, slot.end - slot.start
        kind = shapes.BASIC["char"] if item.kind == "text" else shapes.BASIC.get(f"{item.kind}{item.bits}")
        if kind is None or item.name == "spare":
            continue
        enum = shapes.Enumeration(f"{name}_{item.name}", kind, item.names)
        if item.names:
            enums[enum.name] = enum
        members.append(
            shapes.Member(
                item.name,
                enum.name if item.names else kind,
                slot.start,
                (size,) if item.kind == "text" else (),
                base=item.base,
                doc=item.doc,
            )
        )
    return shapes.Struct(name, header.size, tuple(members), doc=header.title)
