"""The Wireshark dissector: tables and readers made from the layouts, in front of the engine in ``engine/``.

What the layouts do not say (findings, ports, routes, message types) is a :class:`Knowledge`: plain values.
"""

from __future__ import annotations

import hashlib
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from edoras_tools.cfs import names
from edoras_tools.cfs.arguments import ARGUMENTS, BARE_TOO, DEFAULTS, SERVICES, TAILS
from edoras_tools.cfs.edoras_app import BRIDGE_LENGTH_MODULUS
from edoras_tools.cfs.software_bus import SOFTWARE_BUS_MAXIMUM
from edoras_tools.dissectors.lua_text import literal, quoted
from edoras_tools.links.protocol import BY_ADDRESS, BY_CONTENT, LARGEST_DOUBLE, SMALLEST_DOUBLE
from edoras_tools.structs.shapes import COMMANDED
from edoras_tools.wire import ccsds, cfe, envelope, sbn, transfer_frames
from edoras_tools.wire.arrays import CRC16_BYTES
from edoras_tools.wire.envelope import ENVELOPE_FORMATS
from edoras_tools.wire.transfer_frames import FIRST_PART, FRAME_VERSIONS, LATE, count_modulus

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from edoras_tools.links.protocol import LinkProtocol
    from edoras_tools.wire.envelope import EnvelopeFormat
    from edoras_tools.wire.layout import Layout, Slot
    from edoras_tools.wire.transfer_frames import FrameFormat


class Place(NamedTuple):
    """Where a layout's fields are in Wireshark: the protocol, and what stands before their names."""

    protocol: str
    prefix: str


LAYOUTS: Final[dict[str, tuple[Layout, Place]]] = {
    "ccsds": (ccsds.PRIMARY, Place("ccsds_sp", "ccsds_sp")),
    "extended": (cfe.EXTENDED, Place("cfe", "cfe.extended")),
    "command": (cfe.COMMAND, Place("cfe", "cfe.command")),
    "command_extended": (cfe.COMMAND_EXTENDED, Place("cfe", "cfe.command")),
    "telemetry": (cfe.TELEMETRY, Place("cfe", "cfe.telemetry")),
    "telemetry_short": (cfe.TELEMETRY_SHORT, Place("cfe", "cfe.telemetry")),
    "telemetry_extended": (cfe.TELEMETRY_EXTENDED, Place("cfe", "cfe.telemetry")),
    "event": (cfe.EVENT, Place("cfe", "cfe.event")),
    "software_bus": (cfe.SOFTWARE_BUS_HOUSEKEEPING, Place("cfe", "cfe.software_bus")),
    "sbn_legacy": (sbn.LEGACY_HEADER, Place("sbn", "sbn")),
    "subscription": (sbn.SUBSCRIPTION, Place("sbn", "sbn.subscription")),
    "cdr": (envelope.ENCAPSULATION, Place("ros2cdr", "ros2cdr")),
}
"""Headers by what the engine calls them; those of links and the envelopes in each format come to them."""

ENGINE: Final = (
    *("base", "fields", "links", "cdr", "words", "sequence", "network", "packet", "show", "message"),
    *("racs2", "frames", "fprime", "dissector"),
)
"""The parts of the engine, in the order in which they need each other."""
OF_LINKS: Final = ("racs2", "fprime")
"""The parts that a link alone needs, by its label: without the link they are left out."""
TITLE: Final = "-- EDORAS for Wireshark and tshark"
"""How the file begins."""
GUARD: Final = "EDORAS_LUA"
"""The environment variable that names the one digest that may load, where several copies are installed."""


class FindingText(msgspec.Struct, frozen=True):
    """A finding for the expert information.

    Attributes:
        bit: its value.
        label: its name, as in the filter ``edoras.finding.LABEL``.
        severity: ``note``, ``warning`` or ``error``.
        short: for the packet list; empty where a list does not show it.
        meaning: one sentence.
        unknowable: not to be said of a datagram that the capture cut.
    """

    bit: int
    label: str
    severity: str
    short: str
    meaning: str
    unknowable: bool


class RouteText(msgspec.Struct, frozen=True):
    """A route: its topic, its type and the envelope's format; None where the bytes shall tell."""

    topic: str
    type: str
    envelope: EnvelopeFormat | None


class Knowledge(msgspec.Struct, frozen=True):
    """What the dissector knows besides the layouts.

    Attributes:
        findings: every finding.
        links: every link.
        ports: UDP ports by link.
        stream_ports: TCP ports by link.
        bridge_ports: where flight bridges listen.
        cfs_addresses: IPv4 addresses of the cFS of ground missions.
        identities: (SpacecraftID, ProcessorID) that missions name.
        routes: all routes.
        exact: by link, MsgId to the routes that may claim it; the first whose type fits the bytes is taken.
        any_link: the same whatever the link.
        types: ROS types by name: ``{"fixed": bytes or None, "trailing": bytes, "steps": [...]}``, as
            ``engine/cdr.lua`` reads.
        extended_header: packets carry cFE's extended header.
        telemetry_header: 16 or 12.
        msg_id_version: how MsgIds are built, 1 or 2; 2 has the extended header.
        time: how telemetry headers have mission time.
        pdu_msg_ids: of packets that hold a CFDP PDU each, which Wireshark's own dissector reads.
        frames: of ports with transfer frames, their format and the label of the link of the packets in them.
        dictionary: of F Prime, as ``engine/fprime.lua`` reads it; empty for none.
        structs: of layouts, as ``engine/packet.lua`` reads them: ``layouts``, and ``packets`` by MsgId.
        note: what the head of the file says of where the routes are from.
    """

    findings: Sequence[FindingText]
    links: Sequence[LinkProtocol]
    ports: Mapping[str, Sequence[int]]
    bridge_ports: Sequence[int]
    cfs_addresses: Sequence[str] = ()
    identities: Sequence[tuple[int, int]] = ()
    routes: Sequence[RouteText] = ()
    exact: Mapping[str, Mapping[int, Sequence[int]]] = msgspec.field(default_factory=dict)
    any_link: Mapping[int, Sequence[int]] = msgspec.field(default_factory=dict)
    types: Mapping[str, Mapping[str, Any]] = msgspec.field(default_factory=dict)
    extended_header: bool = False
    telemetry_header: int = cfe.TELEMETRY_HEADER_BYTES
    msg_id_version: int = 1
    time: cfe.MissionTime = cfe.MissionTime()
    stream_ports: Mapping[str, Sequence[int]] = msgspec.field(default_factory=dict)
    pdu_msg_ids: Sequence[int] = ()
    frames: Mapping[int, tuple[FrameFormat, str]] = msgspec.field(default_factory=dict)
    dictionary: Mapping[str, Any] = msgspec.field(default_factory=dict)
    structs: Mapping[str, Mapping[Any, Any]] = msgspec.field(default_factory=dict)
    note: str = ""


def generate(knowledge: Knowledge) -> str:
    """Return the Lua file."""
    parts = [_data(knowledge), _readers(knowledge)]
    absent = {*OF_LINKS} - {link.label for link in knowledge.links}
    parts += [_part(name) for name in ENGINE if name not in absent]
    body = "\n".join(parts)
    return _head(knowledge.note, digest(body)) + body


def _part(name: str) -> str:
    """Return a part of the engine; what one returns is known by its name, and its locals to itself alone.

    Lua knows no more than 200 locals at a time.
    """
    text = (files(__package__) / "engine" / f"{name}.lua").read_text("utf-8")
    return f"local {name} = (function()\n{text}end)()\n" if "\nreturn {" in text else text


def digest(text: str) -> str:
    """Return what tells one generated file from another."""
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def own_digest(text: str) -> str:
    """Return the digest that a generated file bears."""
    return text.partition('local DIGEST = "')[2].partition('"')[0]


def _head(note: str, mark: str) -> str:
    return f"""\
{TITLE}: CCSDS space packets, cFE, SBN, the EDORAS envelope and ROS 2 messages.
-- Generated from the layouts of edoras-tools; do not edit: edoras wireshark print > edoras.lua
-- {note}
-- SPDX-License-Identifier: MIT

local DIGEST = {quoted(mark)}
local wanted = os.getenv("{GUARD}")
if wanted and wanted ~= "" and wanted ~= DIGEST then
	return  -- another copy shall be loaded
end
local first, EDORAS = pcall(Proto, "edoras", "EDORAS")
if not first then
	return  -- another copy is loaded: a protocol can be there only once
end

"""


def _data(knowledge: Knowledge) -> str:
    formats = _formats(knowledge)
    layouts = {name: _layout(layout, place) for name, (layout, place) in _layouts(knowledge).items()}
    arguments = {key: item for key, item in ARGUMENTS.items() if item.size and key not in BARE_TOO}
    layouts |= {layout.name: _arguments(key, layout) for key, layout in arguments.items()}
    layouts |= knowledge.structs.get("layouts", {})
    data = {
        "layouts": layouts,
        "formats": [_format(number, item) for number, item in enumerate(_formats(knowledge), 1)],
        "limits": {
            "bridge_modulus": BRIDGE_LENGTH_MODULUS,
            "software_bus": SOFTWARE_BUS_MAXIMUM,
            "highest_msg_id": cfe.HIGHEST_MSG_ID,
            "length_bias": ccsds.LENGTH_BIAS,
            "rounded": envelope.ROUNDED,
            "sequence_modulus": 1 << ccsds.PRIMARY.by_name["packet_sequence_count"].field.bits,
        },
        "sbn": {
            **{item.name: int(item) for item in sbn.MsgType},
            "names": sbn.MSG_TYPE_NAMES,
            "version": sbn.PROTOCOL_VERSION,
            "ident": sbn.IDENT,
            "ident_bytes": sbn.IDENT_BYTES,
        },
        "pdu_name": next((f"{item.name}_PDU" for item in knowledge.links if item.in_packets), None),
        "pdu_msg_ids": dict.fromkeys(knowledge.pdu_msg_ids, True),
        "msg_id": {"event": cfe.EVENT_MSG_ID, "software_bus": cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID},
        "msg_id_names": names.MSG_ID_NAMES,
        "commands": {
            msg_id: {
                code: {"name": command.name, "lengths": command.lengths or None}
                for code, command in commands.items()
            }
            for msg_id, commands in names.COMMANDS.items()
        },
        "arguments": {
            msg_id: {code: layout.name for (own_id, code), layout in arguments.items() if own_id == msg_id}
            for msg_id in COMMANDED
        },
        "structs": dict(knowledge.structs.get("packets", {})),
        "route_commands": {
            code: {"name": command.name, "lengths": command.lengths or None}
            for code, command in names.ROUTE_COMMANDS.items()
        },
        "findings": [
            {
                "label": item.label,
                "severity": item.severity,
                "short": item.short,
                "meaning": item.meaning,
                "unknowable": item.unknowable or None,
            }
            for item in knowledge.findings
        ],
        "links": [_link(item) for item in _ours(knowledge)],
        "left": {
            port: item.wireshark
            for item in knowledge.links
            if item.wireshark
            for port in knowledge.ports[item.label]
        },
        "sure": {"by_content": BY_CONTENT, "by_address": BY_ADDRESS},
        "doubles": {"smallest": SMALLEST_DOUBLE, "largest": LARGEST_DOUBLE},
        "ports": {item.label: list(knowledge.ports[item.label]) for item in _ours(knowledge)},
        "stream_ports": {
            item.label: list(knowledge.stream_ports[item.label])
            for item in _ours(knowledge)
            if knowledge.stream_ports.get(item.label)
        },
        "frames": {port: _framed(form, label) for port, (form, label) in knowledge.frames.items()},
        "frame_limits": {
            "idle_apid": ccsds.IDLE_APID,
            "no_packet": transfer_frames.NO_PACKET_STARTS,
            "only_idle": transfer_frames.ONLY_IDLE_DATA,
            "aos_idle": transfer_frames.AOS_IDLE_CHANNEL,
            "ocf_bytes": transfer_frames.OCF_BYTES,
            "fecf_bytes": CRC16_BYTES,
            "first_part": FIRST_PART,
            "tc_bias": transfer_frames.TC_LENGTH_BIAS,
            "late": LATE,
        },
        "dictionary": dict(knowledge.dictionary) or None,
        "of_links": {item.label: dict(item.engine_values()) for item in _ours(knowledge)},
        "bridge_ports": list(knowledge.bridge_ports),
        "cfs_addresses": list(knowledge.cfs_addresses),
        "identities": [list(pair) for pair in knowledge.identities],
        "routes": [
            {
                "topic": item.topic,
                "type": item.type,
                "format": formats.index(item.envelope) + 1 if item.envelope else None,
            }
            for item in knowledge.routes
        ],
        "exact": {link: _from_one(claims) for link, claims in knowledge.exact.items()},
        "any_link": _from_one(knowledge.any_link),
        "types": dict(knowledge.types),
        "extended_header": knowledge.extended_header,
        "telemetry_header": knowledge.telemetry_header,
        "msg_id_version": knowledge.msg_id_version,
        "time": {"ticks": knowledge.time.ticks or cfe.USUAL_TICKS, "epoch": knowledge.time.epoch_s},
    }
    return "local D = {}\n" + "".join(f"D.{name} = {literal(value)}\n" for name, value in data.items())


def _ours(knowledge: Knowledge) -> list[LinkProtocol]:
    """Return the links on a wire that Wireshark has no dissector of its own for; port 0 is that of files."""
    return [link for link in knowledge.links if not link.wireshark and link.transport.ports != (0,)]


def _layouts(knowledge: Knowledge) -> dict[str, tuple[Layout, Place]]:
    """Return every header, those of the links among them: each is named as its layout is."""
    own = {
        layout.name: (layout, Place(link.label, _prefix(link.label, layout.name)))
        for link in _ours(knowledge)
        for layout in link.layouts
    }
    time = knowledge.time
    timed = {
        name: (time.layout(layout), place) for name, (layout, place) in LAYOUTS.items() if "telemetry" in name
    }
    return own | LAYOUTS | timed


def _prefix(label: str, name: str) -> str:
    """Return what stands before a header's fields: its name, with the link's label in front."""
    return name.replace("_", ".", 1) if name.split("_", maxsplit=1)[0] == label else f"{label}.{name}"


def _link(link: LinkProtocol) -> dict[str, Any]:
    forms = {
        length: {
            "headers": [layout.name for layout in form.headers],
            "port": form.port or None,
            "doubles": form.doubles or None,
        }
        for length, form in link.forms.items()
    }
    return {
        "label": link.label,
        "code": int(link),
        "name": link.name,
        "doc": link.doc,
        "title": link.layouts[0].title if link.layouts and link.packets else f"{link.name} link",
        "to_cfs": link.to_cfs,
        "from_cfs": link.from_cfs,
        "packets": link.packets,
        "values": link.last_hop or None,
        "headers": [layout.name for layout in link.layouts],
        "header_bytes": link.header_bytes,
        "forms": forms or None,
        "constants": dict(link.constants) or None,
        "sure": link.port_sure,
        "port_decides": link.port_decides or None,
        "sender_port": link.sender_port,
        "receive_buffer": link.receive_buffer or None,
        "over_receive_buffer": link.over_receive_buffer.label if link.receive_buffer else None,
    }


def _framed(form: FrameFormat, label: str) -> dict[str, Any]:
    return {
        "kind": form.kind,
        "layout": form.layout.name,
        "version": FRAME_VERSIONS[form.kind],
        "length": form.length,
        "smallest": form.smallest,
        "start": form.data_start,
        "fecf": form.fecf or None,
        "ocf": form.ocf or None,
        "segments": form.segment_header or None,
        "stream": form.stream or None,
        "modulus": count_modulus(form.kind),
        "link": label,
    }


def _formats(knowledge: Knowledge) -> list[EnvelopeFormat]:
    """Return the formats of envelopes: those that are told from the bytes, then those of routes alone."""
    own = [item.envelope for item in knowledge.routes if item.envelope not in {None, *ENVELOPE_FORMATS}]
    return [*ENVELOPE_FORMATS, *dict.fromkeys(item for item in own if item is not None)]


_LENGTHS: Final = ("buffer_length", "buffer_capacity")


def _format(number: int, form: EnvelopeFormat) -> dict[str, Any]:
    return {
        "reader": f"envelope_{number}",
        "size": form.size,
        "little": form.byte_order == "little",
        "own": bool(form.own) or None,
        "crc": form.crc or None,
        "words": [
            {"name": name if name in _LENGTHS else "spare", "at": slot.start, "size": slot.end - slot.start}
            for name, slot in form.layout.by_name.items()
        ],
    }


def _from_one(claims: Mapping[int, Sequence[int]]) -> dict[int, list[int]]:
    """Number routes from 1, as Lua does."""
    return {msg_id: [index + 1 for index in indexes] for msg_id, indexes in claims.items()}


def _layout(layout: Layout, place: Place) -> dict[str, Any]:
    return {
        "name": layout.name,
        "protocol": place.protocol,
        "title": layout.title,
        "size": layout.size,
        "little": layout.byte_order == "little" or None,
        "fields": [_field(slot, _word(layout, slot), place.prefix) for slot in layout.slots],
        "place": {slot.field.name: place for place, slot in enumerate(_read(layout), 1)},
    }


def _arguments(key: tuple[int, int], layout: Layout) -> dict[str, Any]:
    """Return the arguments of a command; an application's share their fields, as ``cfe.es.application``."""
    usual = DEFAULTS.get((key[0], layout.title), {})
    table = _layout(layout, Place("cfe", f"cfe.{SERVICES[key[0]][0]}"))
    table["fields"] = [
        field | {"silent": usual.get(field["name"]) == 0 or None}
        for field in table["fields"]
        if field["name"] != "spare"
    ]
    last = table["fields"][-1]
    most = layout.size + TAILS.get((key[0], layout.title), 0)
    return table | {"size": last["start"] + last["size"], "most": most, "place": None}


def _word(layout: Layout, slot: Slot) -> Slot:
    """Return the slot whose bytes show a slot: the widest of bits that has its own among them.

    Bits of one word are shown in that word, and share the one range that Wireshark makes for it.
    """
    words = (
        other
        for other in layout.slots
        if other.field.bits % 8 and other.start <= slot.start and slot.end <= other.end
    )
    return (
        max(words, key=lambda other: other.end - other.start, default=slot) if slot.field.bits % 8 else slot
    )


def _field(slot: Slot, word: Slot, prefix: str) -> dict[str, Any]:
    item, size = slot.field, word.end - word.start
    number = item.kind in {"uint", "int"}
    kinds = {"text": "string", "float": "double" if size == 8 else "float"}
    whole = slot.mask == (1 << 8 * size) - 1
    shift = slot.shift + 8 * (
        word.end - slot.end
    )  # bits are numbered from the big end: no little one has any
    # Where only the highest values have names, the others need none.
    sparse = number and item.names and min(item.names) > slot.mask // 2 > 0
    return {
        "abbreviation": f"{prefix}.{item.name}",
        "name": item.name,
        "start": word.start,
        "size": size,
        "kind": f"{item.kind}{8 * size}" if number else kinds.get(item.kind, item.kind),
        "mask": slot.mask << shift if number and not whole else None,
        "hex": (item.base == 16 and number) or None,
        "names": dict(item.names) or None,
        "special": [8 * size - shift - item.bits, item.bits] if sparse else None,
        "doc": f"{item.doc} ({item.clause})" if item.clause else item.doc,
    }


def _readers(knowledge: Knowledge) -> str:
    """Return a Lua function for each layout: from a string and a place to its numbers and texts."""
    lines = ["local byte = string.byte", "D.read = {}"]
    for name, (layout, _) in _layouts(knowledge).items():
        lines += _reader(name, layout)
    for number, item in enumerate(_formats(knowledge), 1):
        *reader, _, end = _reader(f"envelope_{number}", item.layout)
        capacity = "buffer_capacity" if "buffer_capacity" in item.layout.by_name else "buffer_length"
        lines += [*reader, f"\treturn buffer_length, {capacity}", end]
    return "\n".join(lines) + "\n"


def _reader(name: str, layout: Layout) -> list[str]:
    wanted = _read(layout)
    numbers = [slot for slot in wanted if slot.field.kind != "text"]
    names_read = ", ".join(slot.field.name for slot in wanted)
    lines = ["", f"function D.read.{name}(s, p)"]
    for first, last in _stretches(numbers):
        octets = ", ".join(f"b{at}" for at in range(first, last))
        lines.append(f"\tlocal {octets} = byte(s, p + {first}, p + {last - 1})")
    for slot in numbers:
        lines += [f"\t{line}" for line in _number(layout, slot)]
    lines += [
        f"\tlocal {slot.field.name} = D.text(s, p + {slot.start}, p + {slot.end - 1})"
        for slot in wanted[len(numbers) :]
    ]
    return [*lines, f"\treturn {names_read}", "end"]


def _read(layout: Layout) -> list[Slot]:
    """Return the slots that a reader returns, in its order: numbers, then texts."""
    numbers = [slot for slot in layout.slots if slot.field.kind in {"uint", "int"}]
    return numbers + [slot for slot in layout.slots if slot.field.kind == "text"]


def _stretches(slots: Sequence[Slot]) -> list[tuple[int, int]]:
    """Return the stretches of bytes that hold the slots, so that one call reads many."""
    found: list[tuple[int, int]] = []
    for slot in slots:
        if found and slot.start <= found[-1][1]:
            found[-1] = found[-1][0], max(found[-1][1], slot.end)
        else:
            found.append((slot.start, slot.end))
    return found


def _number(layout: Layout, slot: Slot) -> list[str]:
    """Return the Lua that puts a number together from its bytes b0, b1, ... of the header."""
    size, name = slot.end - slot.start, slot.field.name
    order = list(range(slot.start, slot.end))
    first, *rest = order if layout.byte_order == "big" else reversed(order)
    word = f"b{first}"
    for at in rest:
        # A float holds 64 bits without wrapping round; what it rounds off is beyond any length that can be.
        word = f"{f'({word})' if '*' in word else word} * {'256.0' if size == 8 else '256'} + b{at}"
    lines = [f"local {name} = {word}"]
    if slot.shift:
        step = 1 << slot.shift
        lines.append(f"{name} = ({name} - {name} % {step}) / {step}")
    if slot.shift + slot.field.bits < 8 * size:
        lines.append(f"{name} = {name} % {1 << slot.field.bits}")
    if slot.field.kind == "int":
        half = 1 << slot.field.bits - 1
        lines.append(f"if {name} >= {half} then {name} = {name} - {2 * half} end")
    return lines
