"""Runs all bridges in one thread, which sleeps until a datagram, a message or a deadline comes."""

from __future__ import annotations

import select
import time
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.errors import CaptureError, OnFailure, RouteError
from edoras_tools.io.net.buffer import make_buffer
from edoras_tools.middleware import Graph, open_graph
from edoras_tools.pipelines.bridge.plan import BridgePlan, BridgeRequest
from edoras_tools.pipelines.bridge.station import BridgeContext, Inbox, Station
from edoras_tools.pipelines.interrupt import on_interrupt, threads_take_turns, watched

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from edoras_tools.pipelines.recorder import RelayRecorder
    from edoras_tools.render.terminal.text import Watcher

_BATCH: Final = 512
"""Messages of the graph that are handled before the sockets are read again."""
_PAGE_NS: Final = 40_000_000
_NOTES: Final = 200
_NEVER: Final = 1 << 63
_SERVERS: Final = frozenset({"foxglove"})
"""Middlewares where clients connect to a port: all bridges share one node."""


class Bridges:
    """All bridges of one process.

    Args:
        domain: ROS 2 domain.
        recorder: called once the ports are bound; returns the recorder of the bridged datagrams.
        say: called with each note for the user.

    Attributes:
        plan: as given.
        stations: the bridges that run.
        notes: notes for the user.
        recorder: the recorder, or None.
        interrupted: whether Ctrl-C ended the run.

    Raises:
        CaptureError: no bridge could bind its port.
        RouteError: the middleware accepts no topic of any bridge.
        ConfigError: the middleware is not installed or refuses.
    """

    def __init__(
        self,
        plan: BridgePlan,
        request: BridgeRequest | None = None,
        *,
        ros: str = "local",
        domain: int = 0,
        options: Mapping[str, str] | None = None,
        recorder: Callable[[], RelayRecorder] | None = None,
        say: Callable[[str], None] | None = None,
    ) -> None:
        self.plan, self.ros = plan, ros
        self.recorder: RelayRecorder | None = None
        self.interrupted = False
        self.notes: list[str] = []
        self.stations: list[Station] = []
        self._said = say
        self._inbox = Inbox()
        self._stopping = self._closed = False
        self._page_ns = _NEVER
        self._full: set[int] = set()
        for note in plan.notes:
            self._say(note)

        server: list[Graph] = []

        def node(name: str) -> Graph:
            if server:
                return server[0]
            graph = open_graph(ros, plan.types, name, domain=domain, options=options or {})
            if ros in _SERVERS:
                server.append(graph)
            return graph

        shared = BridgeContext(plan, request or BridgeRequest(), node, self._inbox, make_buffer(), self._say)
        with OnFailure(self.close):
            for item in plan.stations:
                try:
                    self.stations.append(Station(len(self.stations), item, shared))
                except (CaptureError, RouteError) as error:
                    if item is plan.stations[-1] and not self.stations:
                        raise
                    self._say(f"{item.name} is left out: {error}")
            if recorder is not None:
                self.recorder = recorder()
                for station in self.stations:
                    station.recorder = self.recorder

    @property
    def lost(self) -> int:
        """Messages and datagrams that the bridges themselves lost, including those not recorded."""
        missed = self.recorder.missed if self.recorder else 0
        links = sum(item.drops + item.to_cfs.overflowed + item.overwritten for item in self.stations)
        return links + self._inbox.overflowed + missed

    def stop(self) -> None:
        """End ``run``; for any thread or signal handler."""
        self._stopping = True
        self._inbox.ring()

    def run(self, *, duration_ns: int = 0, watcher: Watcher[Bridges] | None = None) -> None:
        """Run until ``stop``, Ctrl-C, or the end of the duration; then disconnect from cFS.

        Raises:
            CaptureError: a socket failed.
        """
        end = time.monotonic_ns() + duration_ns if duration_ns else _NEVER
        by_fileno = {item.socket.fileno(): item for item in self.stations}
        with (
            select.epoll() as poll,
            on_interrupt(self.stop) as interrupt,
            watched(self, watcher),
            threads_take_turns(),
        ):
            poll.register(self._inbox.fileno(), select.EPOLLIN)
            for fileno in by_fileno:
                poll.register(fileno, select.EPOLLIN)
            more = True
            while not self._stopping and (now := time.monotonic_ns()) < end:
                more = self._turn(poll, by_fileno, 0 if more else self._wait_ns(now, end))
            self.interrupted = interrupt.is_set()
            self._turn(poll, by_fileno, 0)
            for station in self.stations:
                station.machine.goodbye()
                station.flush(time.monotonic_ns())

    def close(self) -> None:
        """Leave the graph, close the ports and the recording; may be called twice."""
        if self._closed:
            return
        self._closed = True
        for station in self.stations:
            station.leave()
        for station in self.stations:
            station.close()
            station.count_latencies()
        self._inbox.close()
        if self.recorder is not None:
            self.recorder.close(sum(item.drops for item in self.stations))

    def summary(self) -> dict[str, Any]:
        """Return the shape of ``bridge --json``."""
        recorded = self.recorder.recorded.datagrams if self.recorder else None
        return {
            "ros": self.ros,
            "bridges": [item.summary() for item in self.stations],
            "inbox_overflowed": self._inbox.overflowed,
            "recorded": recorded,
            "unrecorded": self.recorder.missed if self.recorder else 0,
            "lost": self.lost,
            "notes": list(self.notes),
        }

    def _turn(self, poll: select.epoll, by_fileno: dict[int, Station], wait_ns: int) -> bool:
        """Wait for events, then handle all that is due; return whether more can be done at once."""
        more = False
        for fileno, events in poll.poll(wait_ns / 1e9 if wait_ns >= 0 else None):
            station = by_fileno.get(fileno)
            if station is None:
                self._inbox.reset_signal()
            elif events & ~select.EPOLLOUT:
                more |= station.receive()
        heard = self._inbox.take(_BATCH)
        now = time.monotonic_ns()
        for message in heard:
            self.stations[message.station].hear(message, now)
        for station in self.stations:
            due = station.machine.next_ns
            if due is not None and due <= now:
                station.service(now)
            station.flush(now)
            self._watch_room(poll, station)
        if self.recorder is not None:
            self._turn_page(now)
        return more or len(self._inbox) > 0

    def _wait_ns(self, now: int, end: int) -> int:
        """Return the time until something is due; -1 for ever."""
        due = min(end, self._page_ns)
        for station in self.stations:
            next_ns = station.machine.next_ns
            if next_ns is not None and next_ns < due:
                due = next_ns
        return -1 if due == _NEVER else max(due - now, 0)

    def _watch_room(self, poll: select.epoll, station: Station) -> None:
        """Poll for space in a full socket's buffer."""
        fileno = station.socket.fileno()
        if station.waits != (fileno in self._full):
            self._full ^= {fileno}
            poll.modify(fileno, select.EPOLLIN | (select.EPOLLOUT if station.waits else 0))

    def _turn_page(self, now: int) -> None:
        """Hand recorded datagrams over to the recorder at short intervals."""
        assert self.recorder is not None
        if self._page_ns == _NEVER:
            if self.recorder.pending:
                self._page_ns = now + _PAGE_NS
        elif now >= self._page_ns:
            self.recorder.turn()
            self._page_ns = _NEVER

    def _say(self, text: str) -> None:
        if len(self.notes) < _NOTES:
            self.notes.append(text)
        if self._said is not None:
            self._said(text)
