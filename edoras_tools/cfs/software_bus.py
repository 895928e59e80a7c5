"""cFE Software Bus: the results of its calls, and its events about messages that it did not deliver.

The texts are cFE's own, word for word.
"""

from __future__ import annotations

from typing import Final

from edoras_tools.cfs.event_services import EventText, EventType

NAME: Final = "CFE_SB"
NO_SUBSCRIBERS: Final = 14
MSG_TOO_BIG: Final = 15
MSG_LIMIT: Final = 17
INVALID_MSG_ID: Final = 21
PIPE_OVERFLOW: Final = 25

ENABLE_ROUTE, DISABLE_ROUTE = 4, 5
"""Function codes: an application gets a MsgId again, or no longer."""

STOPS_AFTER: Final = 16
"""Number of loss events that cFS reports before its filter stops them."""

SOFTWARE_BUS_MAXIMUM: Final = 32768
"""CFE_MISSION_SB_MAX_SB_MSG_SIZE, in bytes: cFE refuses a longer packet."""

SUCCESS: Final = 0
BAD_ARGUMENT: Final = -905969661
"""``CFE_SB_BAD_ARGUMENT``: the MsgId is invalid."""
TOO_BIG: Final = -905969657
"""``CFE_SB_MSG_TOO_BIG``."""

_TEXTS: Final = (
    EventText(NAME, NO_SUBSCRIBERS, "No subscribers for MsgId 0x{msg_id:x},sender {sender}"),
    EventText(
        NAME,
        MSG_TOO_BIG,
        "Send Err:Msg Too Big MsgId=0x{msg_id:x},app={sender},size={size:d},MaxSz={most:d}",
        EventType.ERROR,
    ),
    EventText(
        NAME, MSG_LIMIT, "Msg Limit Err,MsgId 0x{msg_id:x},pipe {pipe},sender {sender}", EventType.ERROR
    ),
    EventText(
        NAME, INVALID_MSG_ID, "Send Err:Invalid MsgId(0x{msg_id:x})in msg,App {sender}", EventType.ERROR
    ),
    EventText(
        NAME, PIPE_OVERFLOW, "Pipe Overflow,MsgId 0x{msg_id:x},pipe {pipe},sender {sender}", EventType.ERROR
    ),
)
DUPLICATE_SUBSCRIPTION: Final = EventText(
    NAME, 7, "Duplicate Subscription,MsgId 0x{msg_id:x} on {pipe} pipe,app {app}"
)
NOTHING_TO_UNSUBSCRIBE: Final = EventText(
    NAME, 12, "Unsubscribe Err:No subs for Msg 0x{msg_id:x} on {pipe},app {app}"
)
EVENTS: Final = {item.event_id: item for item in _TEXTS}
"""Events by number; each has ``msg_id`` and ``sender``, and ``pipe`` if one is full."""
