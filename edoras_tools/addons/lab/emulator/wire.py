"""A ``Wire`` to an emulated cFS, for what sends to a real one."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.addons.lab.emulator.simulation import WireDatagram
from edoras_tools.io.net.transmit import SendStatistics
from edoras_tools.io.net.wire import Arrival

if TYPE_CHECKING:
    from edoras_tools.addons.lab.emulator.simulation import Simulation
    from edoras_tools.model import Endpoint, Link
    from edoras_tools.sessions.outgoing import Outgoing


class SimulatedWire:
    """A ``Wire`` to an emulated cFS; its clock is the simulation's.

    Args:
        simulation: without bridges, because the wire replaces them.
        target: where datagrams go.
        own: where answers are received.
        link: the link of the answers.

    Attributes:
        carried: every datagram, where ``keeps_all``: also what goes between other parts.
    """

    def __init__(
        self, simulation: Simulation, target: Endpoint, own: Endpoint, link: Link, *, keeps_all: bool = False
    ) -> None:
        self.carried: list[WireDatagram] = []
        self._keeps_all = keeps_all
        self.statistics = SendStatistics()
        self._simulation, self._target, self._own, self._link = simulation, target, own, link
        self.ends = own, target
        self._arrived: list[Arrival] = []

    def now(self) -> int:
        """Return the simulation's time in ns."""
        return self._simulation.now

    def epoch_ns(self) -> int:
        """Return 0: the simulation's time is ns since 1970."""
        return 0

    def wait(self, until_ns: int) -> bool:
        """Run the simulation until that time."""
        for item in self._simulation.run(until_ns):
            if self._keeps_all:
                self.carried.append(item)
            if item.destination == self._own:
                self._arrived.append(Arrival(self._link, item.payload, item.source, item.destination))
        return True

    def put(self, payload: bytes) -> bool:
        """Deliver a datagram to the simulation now."""
        self._simulation.feed(self._simulation.now, self._target, payload)
        if self._keeps_all:
            self.carried.append(WireDatagram(self._simulation.now, self._own, self._target, payload))
        self.statistics.sent += 1
        return True

    def send(self, out: Outgoing, first: int, last: int) -> int:
        """Deliver datagrams ``first`` up to ``last``, not included, now."""
        return sum(self.put(out[index]) for index in range(first, last))

    def receive(self) -> list[Arrival]:
        """Return what has arrived."""
        arrived, self._arrived = self._arrived, []
        return arrived
