"""Reads ``frames``: the ports of CCSDS transfer frames, and what their bytes do not say."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from edoras_tools.links.table import links, named
from edoras_tools.mission.fields import Fields
from edoras_tools.mission.handling import warn_of_unknown
from edoras_tools.mission.model import FramedPort
from edoras_tools.wire.transfer_frames.fields import FRAME_LAYOUTS, FrameFormat

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.mission.parameters import NodeParameters
    from edoras_tools.mission.report import Mistakes

FRAMES_GROUP: Final = "frames"
_LARGEST: Final = {"tm": 2048, "aos": 65507}
"""Bytes of a frame; 131.0-B limits those of TM, a datagram those of AOS."""
_USUAL_LINK: Final = {"tm": "to", "aos": "to", "tc": "ci"}
_KEYS: Final = ("port", "kind", "link", "fecf", "transport")
_OWN_KEYS: Final = {
    "tm": ("length",),
    "aos": ("length", "ocf", "insert_zone", "header_error_control"),
    "tc": ("segment_header",),
}


def read_framed_ports(node: NodeParameters, report: Mistakes, taken: dict[int, str]) -> Iterator[FramedPort]:
    """Yield the ports of one node's ``frames`` that have no mistake; mistakes go to ``report``.

    Args:
        taken: the name of each port, over all files; this call adds to it.
    """
    fields = Fields(node, report)
    names = sorted(
        (name.partition(".")[2] for name in node.groups if name.startswith(f"{FRAMES_GROUP}.")),
        key=lambda name: node.lines[f"{FRAMES_GROUP}.{name}"],
    )
    for name in node.children(FRAMES_GROUP):
        fields.mistake(f"{FRAMES_GROUP}.{name}", "a value; write NAME: {port: 5111, kind: tm, length: 1115}")
    for name in names:
        found = _framed_port(fields, name)
        if found is None:
            continue
        if found.port in taken:
            what = f"{found.port} is the port of {taken[found.port]} already; a port has one kind of frames"
            fields.mistake(f"{FRAMES_GROUP}.{name}.port", what)
            continue
        taken[found.port] = name
        yield found


def _framed_port(fields: Fields, name: str) -> FramedPort | None:
    group = f"{FRAMES_GROUP}.{name}"
    before = len(fields.report.mistakes)
    port = fields.integer(f"{group}.port", 1, 0xFFFF)
    kind: Any = fields.word(f"{group}.kind", tuple(FRAME_LAYOUTS))
    if kind is None:
        if not fields.has(f"{group}.kind"):
            fields.mistake(group, f"kind is missing; {' or '.join(FRAME_LAYOUTS)} is needed")
        return None
    of_packets = [item.label for item in links() if item.packets or item.dictionary]
    link = fields.word(f"{group}.link", of_packets) or _USUAL_LINK[kind]
    own = _OWN_KEYS[kind]
    transport = fields.word(f"{group}.transport", ("udp", "tcp"))
    values: dict[str, Any] = {"kind": kind, "stream": transport == "tcp"}
    for key in ("fecf", *own):
        if key == "length":
            values[key] = fields.integer(f"{group}.{key}", 1, _LARGEST[kind])
        elif fields.has(f"{group}.{key}"):
            whole = key == "insert_zone"
            place = f"{group}.{key}"
            values[key] = fields.integer(place, 0, _LARGEST[kind]) if whole else fields.flag(place)
    warn_of_unknown(fields, group, (*_KEYS, *own))
    if len(fields.report.mistakes) > before or port is None:
        return None
    form = FrameFormat(**values)
    if form.length and form.length < form.smallest:
        fields.mistake(
            f"{group}.length", f"{form.length} has no room for data; at least {form.smallest} is needed"
        )
        return None
    return FramedPort(name, port, form, named(link), fields.report.file, fields.node.lines[group])
