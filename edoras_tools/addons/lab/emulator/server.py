"""The simulation on real sockets and real time: the same core, driven by the host's clock."""

from __future__ import annotations

import selectors
import time
from contextlib import ExitStack, suppress
from functools import partial
from threading import Event, Thread
from typing import TYPE_CHECKING, Final, Protocol

from edoras_tools.addons.lab.emulator.streams import PeerStreams
from edoras_tools.errors import CaptureError, EdorasError
from edoras_tools.io.net.sockets import open_bound, received, resolve, send_one
from edoras_tools.model import Endpoint
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable, Iterator

    from typing_extensions import Self

    from edoras_tools.addons.lab.emulator.simulation import Simulation, WireDatagram

_LONGEST_WAIT_S: Final = 0.1
"""Longest time until a stop takes effect, s."""


class Watch(Protocol):
    """An observer of a simulation on sockets."""

    def received(self, endpoint: Endpoint, data: bytes, /) -> None:
        """Process a datagram that a socket has just received."""

    def sent(self, sent: WireDatagram, /) -> None:
        """Process a datagram that is sent now."""


def serve(
    simulation: Simulation,
    host: str = "127.0.0.1",
    duration: float | None = None,
    stop: Event | None = None,
    ready: Callable[[], None] | None = None,
    watch: Watch | None = None,
) -> int:
    """Run a simulation on UDP sockets, and SBN's TCP connections, until it is stopped.

    Args:
        simulation: simulation to run; its clock continues.
        host: address to bind every socket to; loopback by default.
        duration: duration, s; None for no end.
        stop: event that ends it.
        ready: called once all sockets are bound, before the first datagram leaves.

    Returns:
        The number of datagrams sent.

    Raises:
        CaptureError: a port is in use, or may not be bound.
    """
    simulation.routed, cfs, stop = False, simulation.cfs, stop or Event()
    with ExitStack() as stack:
        selector = stack.enter_context(selectors.DefaultSelector())
        sockets: dict[Endpoint, socket.socket] = {}

        def open_socket(endpoint: Endpoint) -> None:
            # The operating system chooses the port of telemetry's source, unless it is set.
            is_free = endpoint == cfs.to_endpoint and not cfs.profile.to_source_port
            place = Endpoint(host, 0 if is_free else endpoint.port)
            opened = stack.enter_context(
                open_bound(place, f"UDP {place}", "choose another host, as 127.0.0.2")
            )
            sockets[endpoint] = opened
            selector.register(opened, selectors.EVENT_READ, partial(take, endpoint, opened))

        def take(endpoint: Endpoint, opened: socket.socket, now: int) -> None:
            for data in _waiting(opened):
                if watch:
                    watch.received(endpoint, data)
                # Queued, not delivered: the simulation's clock still has the time of its last run.
                simulation.feed(now, endpoint, data)

        streams: PeerStreams | None = None
        if cfs.profile.sbn_tcp:
            streams = PeerStreams(simulation, host, selector)
            stack.callback(streams.close)
        for endpoint in simulation.endpoints:
            if streams is None or endpoint != cfs.sbn_endpoint:
                open_socket(endpoint)
        if ready:
            ready()
        # The simulation's clock counts from its start, the host's from now.
        offset = simulation.now - time.monotonic_ns()
        end_ns = None if duration is None else simulation.now + int(duration * SECOND)
        sent = 0
        while not stop.is_set():
            now = time.monotonic_ns() + offset
            if end_ns is not None and now >= end_ns:
                break
            for item in simulation.run(now):
                if watch:
                    watch.sent(item)
                if streams and item.source == cfs.sbn_endpoint:
                    sent += streams.send(item)
                    continue
                if item.source not in sockets:  # Telemetry Output restarted, with another socket
                    open_socket(item.source)
                sent += _send(sockets[item.source], item)
            if streams:
                streams.connect(now)
            for key, _ in selector.select(_wait_s(simulation, time.monotonic_ns() + offset)):
                key.data(time.monotonic_ns() + offset)
        return sent


class Served:
    """A simulation on its sockets, in its own thread, during a ``with`` block.

    Raises:
        CaptureError: a port is in use, or may not be bound; on entering.
    """

    def __init__(self, simulation: Simulation, watch: Watch | None = None) -> None:
        self._simulation, self._watch = simulation, watch
        self._stop, self._ready = Event(), Event()
        self._failure: EdorasError | None = None
        self._thread = Thread(target=self._run, name="emulated cFS", daemon=True)

    def _run(self) -> None:
        try:
            serve(self._simulation, stop=self._stop, ready=self._ready.set, watch=self._watch)
        except EdorasError as error:
            self._failure = error
        finally:
            self._ready.set()

    def __enter__(self) -> Self:
        self._thread.start()
        self._ready.wait()
        if self._failure:
            raise self._failure
        return self

    def __exit__(self, *_error: object) -> None:
        self._stop.set()
        self._thread.join()


def _waiting(opened: socket.socket) -> Iterator[bytes]:
    with suppress(OSError):  # the error of an earlier datagram
        for data, _ in received(opened):
            yield data


def _send(source: socket.socket, item: WireDatagram) -> int:
    try:
        to = resolve(item.destination)[1]
    except CaptureError:
        return 0  # telemetry can be enabled towards any text
    return send_one(source, item.payload, to).accepted


def _wait_s(simulation: Simulation, now: int) -> float:
    due = simulation.next_ns
    return _LONGEST_WAIT_S if due is None else min(max(due - now, 0) / SECOND, _LONGEST_WAIT_S)
