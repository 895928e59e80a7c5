"""cFE Time Services: mission time, and the commands that set and adjust it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.addons.lab.emulator.services.events import Event
from edoras_tools.cfs import time_services as facts
from edoras_tools.units import MICROSECOND, SECOND

if TYPE_CHECKING:
    from edoras_tools.cfs.profile import SimProfile

_LIMIT: int = 1 << 32


class Clock:
    """Mission elapsed time, and the correction to mission time.

    Attributes:
        leap_seconds: leap seconds as in its housekeeping.
        stcf_ns: correction that is added to mission elapsed time, ns.
    """

    def __init__(self, profile: SimProfile, now: int) -> None:
        """Start the clock.

        Args:
            profile: constants, with mission elapsed time at start and the correction.
            now: ns.
        """
        self.leap_seconds = facts.LEAP_SECONDS
        self.stcf_ns = profile.epoch_offset_s * SECOND
        self._zero_ns = now - profile.boot_met_s * SECOND
        if profile.time.epoch_s is not None:
            self.stcf_ns = now - profile.time.epoch_s * SECOND - self.met_ns(now)
        self._adjust_ns, self._since_ns = 0, now

    def met_ns(self, now: int) -> int:
        """Return mission elapsed time in ns."""
        return now - self._zero_ns

    def time_ns(self, now: int) -> int:
        """Return mission time in ns since its epoch, including adjustments each second."""
        seconds = (now - self._since_ns) // SECOND
        self._since_ns += seconds * SECOND
        self.stcf_ns += seconds * self._adjust_ns
        return (self.met_ns(now) + self.stcf_ns) % (_LIMIT * SECOND)

    def command(self, function_code: int, payload: bytes, now: int) -> Event:
        """Process a command that sets or adjusts the time; return its event.

        Args:
            function_code: one of ``facts.SETTING``.
            payload: two words, little-endian; for leap seconds one of 16 bits.
            now: ns.
        """
        first, second = (int.from_bytes(payload.ljust(8, b"\0")[at : at + 4], "little") for at in (0, 4))
        if function_code == facts.SET_LEAP_SECONDS:
            self.leap_seconds = int.from_bytes(payload[:2], "little", signed=True)
            return Event.of(facts.LEAPS_SET, leap_seconds=self.leap_seconds)
        setting = facts.SETTING[function_code]
        if setting.each_second:
            amount = first * SECOND + (second * SECOND >> 32)
            self.time_ns(now)
            self._adjust_ns = setting.sign * amount
            return Event.of(setting.accepted, seconds=first, subseconds=second, sign=setting.direction)
        if second >= facts.MICROSECONDS:
            return Event.of(setting.refused, seconds=first, micros=second, sign=setting.direction)
        time_ns = first * SECOND + second * MICROSECOND
        if function_code == facts.SET_TIME:
            self.stcf_ns = time_ns - self.met_ns(now)
        elif function_code == facts.SET_MET:
            self._zero_ns = now - time_ns
        elif function_code == facts.SET_STCF:
            self.stcf_ns = time_ns
        else:
            self.stcf_ns += setting.sign * time_ns
        fraction = (second << 32) // facts.MICROSECONDS
        return Event.of(
            setting.accepted, seconds=first, micros=second, subseconds=fraction, sign=setting.direction
        )
