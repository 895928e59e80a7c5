"""Files that cFS wrote: one space packet of its event log, or of Data Storage, as if it were a datagram."""

from __future__ import annotations

from typing import Final

from edoras_tools.links.protocol import LinkProtocol
from edoras_tools.model import Transport


class StoredLink(LinkProtocol):
    """The packets of a file; no wire carries them, so its port is 0, which no datagram has."""

    code = 9
    name = "FILE"
    label = "file"
    colour = "dim"
    doc = "packets in a file that cFS wrote (event log, Data Storage)"
    transport = Transport(ports=(0,), first="server")
    from_cfs = True
    packets = True


STORED: Final = StoredLink()
