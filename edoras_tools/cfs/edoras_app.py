"""The EDORAS flight applications and bridges: name and pipe, commands and events, lengths of buffers.

A receiver cuts, drops or refuses what is longer than its buffer; measured, see ``docs/wire.md``.
"""

from __future__ import annotations

from typing import Final

from edoras_tools.cfs.event_services import EventText, EventType

BRIDGE_BUFFER: Final = 1024
"""Bytes of the ground bridge's receive buffer; a longer packet is published as garbage."""
BRIDGE_LENGTH_MODULUS: Final = 256
"""Modulus of the flight bridge's length, a ``uint8_t``: if the result is below 11, it drops the datagram."""
FLIGHT_BRIDGE_BUFFER: Final = 4096
"""Bytes of the flight bridge's receive buffer, SBN header included."""


NAME: Final = "EDORAS_APP"
PIPE: Final = "EDORAS_APP_PIPE"
NO_OP, SET = 0, 1
"""Function codes. The application does not check the length of a SET."""

INITIALIZED: Final = EventText(NAME, 1, "Edoras App Initialized. {version}")
BAD_FUNCTION_CODE: Final = EventText(NAME, 2, "Invalid ground command code: CC = {code:d}", EventType.ERROR)
NO_OP_DONE: Final = EventText(NAME, 3, "Edoras App: NOOP command {version}")
BAD_LENGTH: Final = EventText(
    NAME,
    6,
    "Invalid Msg length: ID = 0x{msg_id:04X},  CC = {code:d}, Len = {length:d}, Expected = {expected:d}",
    EventType.ERROR,
)
UNREADABLE: Final = "edoras_core: Failed to apply rmw_deserialize"
"""Text on the console, not an event."""
PORT_TAKEN: Final = "Error in binding  socket to talk to robot: Address already in use"
"""Text on the console, not an event: the application was restarted, and its old socket is still open."""
