"""cFE Time Services: its name in events, and its commands that set and adjust the time."""

from __future__ import annotations

from typing import Final, NamedTuple

from edoras_tools.cfs.event_services import EventText, EventType

NAME: Final = "CFE_TIME"
START_S: Final = 1_001_000
"""Mission time, in s, at which it begins after a power-on, in cFE's default configuration."""
LEAP_SECONDS: Final = 37
MICROSECONDS: Final = 1_000_000
SET_TIME, SET_MET, SET_STCF, SET_LEAP_SECONDS = 7, 8, 9, 10
ADD_ADJUST, SUB_ADJUST, ADD_ONE_HZ, SUB_ONE_HZ = 11, 12, 13, 14
LEAPS_SET: Final = EventText(NAME, 17, "Set Leap Seconds = {leap_seconds:d}")


class Setting(NamedTuple):
    """A command that sets or adjusts the time.

    Attributes:
        name: name in events.
        done_id: number of the event for an accepted command.
        refused_id: number of the event for a command whose microseconds are a second or more.
        sign: sign of an adjustment; 0 if it is none.
        each_second: whether it applies again each second.
    """

    name: str
    done_id: int
    refused_id: int = 0
    sign: int = 0
    each_second: bool = False

    @property
    def direction(self) -> int:
        """The sign as events write it: 1 is positive, 2 negative."""
        return 1 if self.sign > 0 else 2

    @property
    def accepted(self) -> EventText:
        """Return the event for an accepted command."""
        if self.each_second:
            text = f"{self.name} -- secs = {{seconds:d}}, ssecs = 0x{{subseconds:X}}"
        else:
            text = f"{self.name} -- secs = {{seconds:d}}, usecs = {{micros:d}}, ssecs = 0x{{subseconds:X}}"
        return EventText(NAME, self.done_id, text + self._signed)

    @property
    def refused(self) -> EventText:
        """Return the event for a command whose microseconds are a second or more."""
        text = f"Invalid {self.name.removeprefix('Set ')} -- secs = {{seconds:d}}, usecs = {{micros:d}}"
        return EventText(NAME, self.refused_id, text + self._signed, EventType.ERROR)

    @property
    def _signed(self) -> str:
        return ", dir[1=Pos, 2=Neg] = {sign:d}" if self.sign else ""


SETTING: Final = {
    SET_TIME: Setting("Set Time", 12, 34),
    SET_MET: Setting("Set MET", 13, 35),
    SET_STCF: Setting("Set STCF", 14, 36),
    ADD_ADJUST: Setting("STCF Adjust", 15, 37, 1),
    SUB_ADJUST: Setting("STCF Adjust", 15, 37, -1),
    ADD_ONE_HZ: Setting("STCF 1Hz Adjust", 16, sign=1, each_second=True),
    SUB_ONE_HZ: Setting("STCF 1Hz Adjust", 16, sign=-1, each_second=True),
}
"""The commands by function code, without leap seconds."""
SETS: Final = frozenset({*SETTING, SET_LEAP_SECONDS})
