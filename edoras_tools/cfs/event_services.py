"""cFE Event Services: its name, the severities of events, and events as data.

The emulator writes events by their texts; the doctor and the sweep read them.
"""

from __future__ import annotations

import re
from enum import IntEnum
from functools import cached_property
from typing import Final

import msgspec

NAME: Final = "CFE_EVS"


class EventType(IntEnum):
    """Severity of an event."""

    DEBUG = 1
    INFORMATION = 2
    ERROR = 3
    CRITICAL = 4


class EventText(msgspec.Struct, frozen=True, dict=True):
    """An event that an application reports, word for word.

    Attributes:
        app: name of the application.
        event_id: number of the event in the application.
        text: format for ``str.format``: ``{name}`` is text, ``{name:d}`` decimal, ``{name:x}`` hexadecimal.
        event_type: severity.
    """

    app: str
    event_id: int
    text: str
    event_type: EventType = EventType.INFORMATION

    @cached_property
    def pattern(self) -> re.Pattern[str]:
        """Regular expression that reads the text; it has a group for each value."""
        *parts, last = [_group(part) if part.startswith("{") else re.escape(part) for part in self._parts]
        # re.split ends with the text after the last value; if that is empty, the value extends to the end.
        return re.compile("".join(parts) + (last or "$"))

    @cached_property
    def phrase(self) -> str:
        """The longest part without values: it identifies the event even if the values are cut off."""
        return max((part for part in self._parts if not part.startswith("{")), key=len)

    @property
    def _parts(self) -> list[str]:
        return re.split(r"(\{.*?\})", self.text)


def _group(value: str) -> str:
    name, _, form = value.strip("{}").partition(":")
    if form.endswith("d"):
        return f"(?P<{name}>[0-9]+)"
    # Names may be empty, and contain anything: they end at the text after them, or at the end of the event.
    return f"(?P<{name}>[0-9a-fA-F]+)" if form else f"(?P<{name}>.*?)"


SQUELCHED: Final = EventText(NAME, 44, "Events squelched, AppName = {app}", EventType.ERROR)

USUAL_TYPES: Final = 0b1110
"""Events that an application may send, a bit for each severity from the lowest: all but debug."""
ALL_TYPES: Final = 0b1111
ENABLE_TYPE, DISABLE_TYPE = 2, 3
ENABLE_APP_TYPE, DISABLE_APP_TYPE, ENABLE_APP, DISABLE_APP, RESET_APP_COUNTER = 5, 6, 7, 8, 9
SET_FILTER, RESET_FILTER, RESET_ALL_FILTERS, ADD_FILTER, DELETE_FILTER = 10, 13, 14, 15, 16
APP_NAME_BYTES: Final = 20

DONE: Final = {
    code: EventText(NAME, event_id, f"{title} Command Received with {with_what}", EventType.DEBUG)
    for code, event_id, title, with_what in (
        (ENABLE_TYPE, 20, "Enable Event Type", "Event Type Bit Mask = 0x{mask:02x}"),
        (DISABLE_TYPE, 21, "Disable Event Type", "Event Type Bit Mask = 0x{mask:02x}"),
        (ENABLE_APP_TYPE, 23, "Enable App Event Type", "AppName = {app}, EventType Bit Mask = 0x{mask:02x}"),
        (
            DISABLE_APP_TYPE,
            24,
            "Disable App Event Type",
            "AppName = {app}, EventType Bit Mask = 0x{mask:02x}",
        ),
        (ENABLE_APP, 25, "Enable App Events", "AppName = {app}"),
        (DISABLE_APP, 26, "Disable App Events", "AppName = {app}"),
        (RESET_APP_COUNTER, 27, "Reset Event Counter", "AppName = {app}"),
        (RESET_ALL_FILTERS, 29, "Reset All Filters", "AppName = {app}"),
    )
}
"""Event of each command that was obeyed, by function code; debug events, so usually unseen."""
BAD_MASK: Final = EventText(NAME, 40, "Bit Mask = 0x{mask:08x} out of range: CC = {code:d}", EventType.ERROR)
UNKNOWN_APP: Final = EventText(
    NAME, 9, "{prefix}Unable to retrieve application ID for {app}: CC = {code:d}", EventType.ERROR
)
UNKNOWN_APP_PREFIX: Final = {
    DISABLE_APP: "Disable App Events Command: ",
    RESET_APP_COUNTER: "Reset Event Counter Command: ",
}
"""Beginning of the event about an unknown application, by function code."""
