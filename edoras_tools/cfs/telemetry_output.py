"""Telemetry Output (TO_LAB): its name and pipes in events, its MsgIds, its function codes, its events."""

from __future__ import annotations

from typing import Final

from edoras_tools.cfs.event_services import EventText, EventType

NAME: Final = "TO_LAB_APP"
NAMES: Final = (NAME, "TO_LAB")
"""Its names in the start-up scripts of draco-rc4 and of cFS 7."""
PIPE: Final = "TO_LAB_TLM_PIPE"
SOCKET: Final = "TO_LAB_APP socket"
COMMAND_PIPE: Final = "TO_LAB_CMD_PIPE"
COMMAND_MSG_ID: Final = 0x1880
REQUEST_MSG_ID: Final = 0x1881
HOUSEKEEPING_MSG_ID: Final = 0x0880
DATA_TYPES_MSG_ID: Final = 0x0881

NOOP, RESET, ADD_PACKET, SEND_DATA_TYPES, REMOVE_PACKET, REMOVE_ALL, ENABLE = range(7)
USUAL_LIMIT: Final = 4
"""Message limit of each MsgId in the usual table."""
STOPS: Final = frozenset({REMOVE_PACKET, REMOVE_ALL})
"""Function codes after which it no longer sends a MsgId, or any."""

INITIALIZED: Final = EventText(NAME, 1, "TO Lab Initialized. {version}, Awaiting enable command.")
NOTHING_DONE: Final = EventText(NAME, 18, "No-op command")
ENABLED: Final = EventText(NAME, 3, "TO telemetry output enabled for IP {address}")
NOT_ADDED: Final = EventText(
    NAME, 10, "L{line:d} TO Can't subscribe 0x{msg_id:x} status {status}", EventType.ERROR
)
BAD_FUNCTION_CODE: Final = EventText(
    NAME, 9, "L{line:d} TO: Invalid Function Code Rcvd In Ground Command 0x{code:x}", EventType.ERROR
)
NOT_REMOVED: Final = EventText(
    NAME, 11, "L{line:d} TO Can't Unsubscribe to Stream 0x{msg_id:x}, status {status}", EventType.ERROR
)
ADDED: Final = EventText(
    NAME, 15, "L{line:d} TO AddPkt 0x{msg_id:x}, QoS {priority:d}.{reliability:d}, limit {limit:d}"
)
REMOVED: Final = EventText(NAME, 16, "L{line:d} TO RemovePkt 0x{msg_id:x}")
ALL_REMOVED: Final = EventText(NAME, 17, "L{line:d} TO Unsubscribed to all Commands and Telemetry")
SUPPRESSED: Final = EventText(
    NAME, 7, "L{line:d} TO sendto error {error}. Tlm output suppressed", EventType.ERROR
)
"""Event after which Telemetry Output drops all messages until it is enabled again; its number varies."""
