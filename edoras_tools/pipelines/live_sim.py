"""The emulated cFS as a live source: in real time, in this process, without sockets or privileges."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import replace
from importlib.resources import as_file, files
from typing import TYPE_CHECKING, Final

from edoras_tools.model import Endpoint, SourceInfo, SourceStatistics
from edoras_tools.sim import Simulation
from edoras_tools.sim.simulation import Sent
from edoras_tools.sim.source import frames_of
from edoras_tools.sources.linklayer import Demux

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from edoras_tools.model import PacketBatch
    from edoras_tools.pipelines.workbench import Settings, Workbench
    from edoras_tools.sim.simulation import Scenario

_TICK_S: Final = 0.02
_ELSEWHERE: Final = Endpoint("127.0.0.1", 50000)
"""Where commands of the user's come from: a port that nobody else of the simulation has."""

_MISSIONS: Final = {
    "rover": ("rover_ground",),
    "arm": ("single_arm_ground",),
    "two-rovers": ("two_rovers_ground", "two_rovers_flight"),
    "two-arms": ("two_arms_ground", "two_arms_flight"),
}
_BOOT_NS: Final = 3_000_000_000
"""The emulated cFS has booted by then; nobody waits for it."""


def start(
    scenario: Scenario, settings: Settings, clock: Callable[[], int]
) -> tuple[RunningSimulation, Workbench]:
    """Boot an emulated cFS with its bridges and robots.

    Args:
        scenario: which demo.
        settings: missions and types; where no mission is named, the demo's own hold.
        clock: monotonic time in ns.

    Raises:
        ConfigError: a mission has mistakes.
    """
    if not settings.configs:
        with as_file(files("edoras_tools.samples")) as samples:
            paths = [samples / f"missions/{name}.yaml" for name in _MISSIONS[scenario]]
            bench = replace(settings, configs=paths).workbench()
    else:
        bench = settings.workbench()
    simulation = Simulation(scenario=scenario, start_ns=time.time_ns() - _BOOT_NS)
    for _ in simulation.run(simulation.now + _BOOT_NS):
        pass
    return RunningSimulation(simulation, clock), bench


class RunningSimulation:
    """A ``Source`` over a simulation that goes by the host's clock.

    Args:
        simulation: what to run, from where it stands.
        clock: monotonic time in ns.

    Attributes:
        info: what the source is.
        statistics: what it counted so far.
    """

    def __init__(self, simulation: Simulation, clock: Callable[[], int]) -> None:
        self.info = SourceInfo(name=f"emulated {simulation.scenario}", kind="sim", time_resolution_ns=1)
        self.statistics = SourceStatistics()
        self._simulation, self._clock = simulation, clock
        self._commands: deque[bytes] = deque()
        self._stop = threading.Event()
        self._demux = Demux()

    def command(self, data: bytes, _msg_id: int) -> str:
        """Send a command to Command Ingest, on any thread; nothing is ever refused."""
        self._commands.append(data)
        return ""

    def stop(self) -> None:
        """End the batches; for any thread or signal handler."""
        self._stop.set()

    def batches(self) -> Iterator[PacketBatch]:
        """Run, and hand over what was sent since the last time."""
        simulation = self._simulation
        offset = simulation.now - self._clock()
        while not self._stop.wait(_TICK_S):
            sent = [*self._commanded(), *simulation.run(self._clock() + offset)]
            if sent:
                frames = frames_of(sent, self.statistics.frames + 1)
                self.statistics.frames += len(frames)
                self.statistics.datagrams += len(frames)
                self.statistics.bytes += int(frames.length.sum())
                yield self._demux.demux(frames)

    def close(self) -> None:
        """Hold nothing."""

    def _commanded(self) -> Iterator[Sent]:
        simulation = self._simulation
        while self._commands:
            data = self._commands.popleft()
            simulation.deliver(simulation.cfs.ci_endpoint, data)
            yield Sent(simulation.now, _ELSEWHERE, simulation.cfs.ci_endpoint, data)
