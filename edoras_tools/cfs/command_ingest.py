"""Command Ingest (CI_LAB): its name in events, its MsgIds, its buffer, its events."""

from __future__ import annotations

from typing import Final

from edoras_tools.cfs.event_services import EventText, EventType

NAME: Final = "CI_LAB_APP"
NAMES: Final = (NAME, "CI_LAB")
"""Its names in the start-up scripts of draco-rc4 and of cFS 7."""
PIPE: Final = "CI_LAB_CMD_PIPE"
COMMAND_MSG_ID: Final = 0x1884
REQUEST_MSG_ID: Final = 0x1885
HOUSEKEEPING_MSG_ID: Final = 0x0884
RESET_COUNTERS: Final = 1
"""Function code."""
PORT: Final = 1234
"""UDP port on the first processor; each further processor has the next port."""
CI_BUFFER: Final = 768
"""Bytes of CI_LAB's receive buffer; a longer datagram is cut, and accepted silently."""

INITIALIZED: Final = EventText(NAME, 3, "CI Lab Initialized. {version}")
NOOP: Final = EventText(NAME, 5, "CI: NOOP command")
RESET: Final = EventText(NAME, 6, "CI: RESET command")
TOO_SHORT: Final = EventText(
    NAME, 8, "CI: L{line:d}, cmd {msg_id:04x} {second:02x} dropped, bad length={length:d}\n", EventType.ERROR
)
TOO_SHORT_7: Final = EventText(NAMES[1], 8, "CI: cmd dropped, bad packet length={length:d}", EventType.ERROR)
CUT_7: Final = EventText(
    NAMES[1], 8, "CI: cmd dropped - length mismatch, {wanted:d} (hdr) / {length:d} (packet)", EventType.ERROR
)
"""Events of CI in cFS 7, which refuses a packet that is longer than its datagram, or than its buffer."""
NOT_SENT: Final = EventText(
    NAME, 10, "CI: L{line:d}, CFE_SB_TransmitBuffer() failed, status={status}\n", EventType.ERROR
)
BAD_LENGTH: Final = EventText(
    NAME,
    16,
    "Invalid msg length: ID = 0x{msg_id:04X},  CC = {code:d}, Len = {length:d}, Expected = {expected:d}",
    EventType.ERROR,
)
