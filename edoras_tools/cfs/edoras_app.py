"""The EDORAS flight applications: their name and pipe, their commands, their events."""

from __future__ import annotations

from typing import Final

from edoras_tools.cfs.event_services import EventText, EventType

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
