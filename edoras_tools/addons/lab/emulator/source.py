"""A simulation as a source of datagrams and as a wire, without sockets, in simulated or in real time."""

from __future__ import annotations

import time
from collections import deque
from importlib.resources import as_file, files
from itertools import chain
from threading import Event
from typing import TYPE_CHECKING, Final

from msgspec.structs import replace

from edoras_tools.addons.lab.emulator import BOOT_NS, MISSIONS, Scenario, Simulation
from edoras_tools.addons.lab.emulator.simulation import WireDatagram
from edoras_tools.io import SourceDefaults
from edoras_tools.io.frames.frame_batch import frames_of
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.io.net.transmit import Arrival, SendStatistics
from edoras_tools.model import Endpoint, Link, PacketBatch, SourceInfo, SourceStatistics
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from edoras_tools.pipelines.workbench import Settings, Workbench
    from edoras_tools.sessions.outgoing import Outgoing


_TICK_S: Final = 0.02
_COMMAND_SENDER: Final = Endpoint("127.0.0.1", 50000)
"""Source of the user's commands: a port that no other part of the simulation uses."""


class SimulationSource(SourceDefaults):
    """A ``Source`` over the datagrams of a simulation.

    Args:
        simulation: simulation that sends them.
        pieces: the datagrams of each batch, in order of time; empty ones are passed over.

    Attributes:
        info: description of the source.
        statistics: counts so far.
    """

    def __init__(self, simulation: Simulation, pieces: Iterable[Sequence[WireDatagram]]) -> None:
        self.info = SourceInfo(name=f"emulated {simulation.scenario}", kind="sim", time_resolution_ns=1)
        self.statistics = SourceStatistics()
        self._pieces = pieces
        self._demux = Demux()

    def close(self) -> None:
        """Close nothing: a simulation has no handle."""

    def batches(self) -> Iterator[PacketBatch]:
        """Yield a batch for each piece."""
        for sent in filter(None, self._pieces):
            frames = frames_of(sent, self.statistics.frames + 1)
            self.statistics.frames += len(frames)
            self.statistics.datagrams += len(frames)
            self.statistics.bytes += int(frames.length.sum())
            yield self._demux.demux(frames)


class SimulatedSource(SimulationSource):
    """A ``Source`` over a simulation in simulated time: one batch for every second of it.

    Args:
        simulation: simulation to run; its clock continues.
    """

    def __init__(self, simulation: Simulation, duration_ns: int) -> None:
        begin_ns, end_ns = simulation.now, simulation.now + duration_ns
        times = chain(range(begin_ns + SECOND, end_ns, SECOND), [end_ns])
        super().__init__(simulation, (list(simulation.run(until_ns)) for until_ns in times))


class SimulatedWire:
    """A ``Wire`` to an emulated cFS; its clock is the simulation's.

    Args:
        simulation: simulation without bridges, which the wire replaces.
        target: destination of the datagrams.
        own: address that receives answers.
        link: the link of the answers.

    Attributes:
        carried: all datagrams, if ``keeps_all``, including those between other parts.
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
        """Run the simulation until a time."""
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
        """Return the arrived datagrams."""
        arrived, self._arrived = self._arrived, []
        return arrived


class RealTimeSource(SimulationSource):
    """A ``Source`` over a simulation in real time by the host's clock, without sockets.

    Args:
        simulation: simulation to run; its clock continues.
        clock: function that returns monotonic time, ns.
    """

    live = True

    def __init__(self, simulation: Simulation, clock: Callable[[], int]) -> None:
        super().__init__(simulation, self._run(simulation, clock))
        self._commands: deque[bytes] = deque()
        self._stop = Event()

    def command(self, data: bytes, _msg_id: int) -> str:
        """Send a command to Command Ingest, from any thread; it is never refused."""
        self._commands.append(data)
        return ""

    def stop(self) -> None:
        """End the batches; for any thread or signal handler."""
        self._stop.set()

    def _run(self, simulation: Simulation, clock: Callable[[], int]) -> Iterator[list[WireDatagram]]:
        """Run the simulation, and yield the datagrams since the last ones."""
        offset = simulation.now - clock()
        while not self._stop.wait(_TICK_S):
            commands = list(self._commanded(simulation))
            yield [*commands, *simulation.run(clock() + offset)]

    def _commanded(self, simulation: Simulation) -> Iterator[WireDatagram]:
        while self._commands:
            data = self._commands.popleft()
            simulation.deliver(simulation.cfs.ci_endpoint, data)
            yield WireDatagram(simulation.now, _COMMAND_SENDER, simulation.cfs.ci_endpoint, data)


def demo_bench(scenario: str, settings: Settings) -> Workbench:
    """Return the workbench of settings, with the missions of a demo if they name none.

    Raises:
        ConfigError: a mission has errors.
    """
    with as_file(files("edoras_tools.samples")) as samples:
        paths = [samples / f"missions/{name}.yaml" for name in MISSIONS.get(scenario, ())]
        return replace(settings, configs=settings.configs or paths).workbench()


def start_simulation(
    scenario: Scenario, settings: Settings, clock: Callable[[], int]
) -> tuple[RealTimeSource, Workbench]:
    """Boot an emulated cFS with its bridges and robots.

    Args:
        settings: missions and types; if no mission is named, the demo's own are used.
        clock: function that returns monotonic time, ns.

    Raises:
        ConfigError: a mission has errors.
    """
    simulation = Simulation(scenario=scenario, start_ns=time.time_ns() - BOOT_NS).boot()
    return RealTimeSource(simulation, clock), demo_bench(scenario, settings)
