"""The exception and reset log of cFS: each of its entries as if it were a datagram."""

from __future__ import annotations

from typing import Any, ClassVar, Final

from edoras_tools.links.protocol import CERTAIN, Form, LinkProtocol, Seen
from edoras_tools.model import Decoded, Transport
from edoras_tools.wire.cfe_file import RESET_ENTRY

_KINDS: Final = {name: set(RESET_ENTRY.by_name[name].field.names) for name in ("entry_type", "reset_type")}


class ResetsLink(LinkProtocol):
    """The entries of a reset log; no wire carries them, so their port is 0, like that of stored packets.

    No stored packet is taken for one: the first bytes of an entry would be a packet of another length.
    """

    code = 11
    name = "RESET"
    label = "reset"
    colour = "red"
    doc = "entries of an exception and reset log that cFS wrote to a file"
    transport = Transport(ports=(0,), first="server")
    from_cfs = True
    layouts = (RESET_ENTRY,)
    forms: ClassVar = {RESET_ENTRY.size: Form((RESET_ENTRY,))}

    def recognise(self, facts: Seen) -> Any:
        """Return the confidence: certain if length and kinds are those of an entry."""
        sure: Any = CERTAIN * (facts.length == RESET_ENTRY.size) * (facts.destination_port == 0)
        for name, kinds in _KINDS.items():
            value = facts.field(RESET_ENTRY, name)
            sure = sure * sum((value == kind) for kind in kinds)
        return sure

    def summary(self, decoded: Decoded) -> str:
        """Return the event that the log describes."""
        if not decoded.layers:
            return ""
        entry = {field.name: field for field in decoded.layers[0].fields}
        return f"reset log, {entry['entry_type'].text.partition(' (')[0]}: {entry['description'].value}"


RESETS: Final = ResetsLink()
