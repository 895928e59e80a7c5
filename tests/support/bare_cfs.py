"""An emulated cFS without applications, whose time is a test's: a test adds one, and calls it."""

from __future__ import annotations

from edoras_tools.addons.lab.emulator.cfs import Cfs
from edoras_tools.addons.lab.emulator.scheduler import Scheduler
from edoras_tools.cfs.profile import SimProfile


class BareCfs(Cfs):
    """A cFS that keeps what its applications do.

    Attributes:
        published: packets that applications forwarded to the software bus.
        sent: destination and payload of each datagram.
    """

    def __init__(self, profile: SimProfile | None = None) -> None:
        profile = profile or SimProfile()
        self.published: list[bytes] = []
        self.sent: list[tuple[object, bytes]] = []
        super().__init__(
            profile, Scheduler(profile, start_ns=0), lambda _, to, data: self.sent.append((to, data))
        )

    def publish(self, packet, sender, *, stamp=True):
        if not stamp:
            self.published.append(packet)
        return super().publish(packet, sender, stamp=stamp)

    def at(self, now):
        """Let it be a later time, without running tasks; return what is there."""
        self.scheduler.now = now
        return self

    def said(self):
        """Return the events since the last call, as ``APP ID: text``."""
        lines = [text.partition("EVS Port1 66/1/")[2] for _, text in self.console]
        self.console.clear()
        return lines

    def take_sent(self):
        """Return the destinations and payloads of the datagrams since the last call."""
        sent, self.sent = self.sent, []
        return sent
