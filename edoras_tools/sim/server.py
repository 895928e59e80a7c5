"""The simulation on real sockets and real time: the same core, driven by the host's clock."""

from __future__ import annotations

import selectors
import socket
import time
from contextlib import ExitStack
from typing import TYPE_CHECKING, Final, Protocol

from edoras_tools.errors import CaptureError
from edoras_tools.model import Endpoint
from edoras_tools.sessions.profile import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from threading import Event

    from edoras_tools.sim.simulation import Sent, Simulation

_LONGEST_WAIT_S: Final = 0.1
"""How late a stop is noticed at most."""
_LARGEST_DATAGRAM: Final = 65536


class Watch(Protocol):
    """Looks on while a simulation is served."""

    def entered(self, endpoint: Endpoint, data: bytes, /) -> None:
        """Take what a socket was given and has just been read."""

    def left(self, sent: Sent, /) -> None:
        """Take what leaves now."""


def serve(
    simulation: Simulation,
    host: str = "127.0.0.1",
    duration: float | None = None,
    stop: Event | None = None,
    ready: Callable[[], None] | None = None,
    watch: Watch | None = None,
) -> int:
    """Run a simulation on UDP sockets until it is told to stop.

    Args:
        simulation: what to run; its clock goes on from where it stands.
        host: address to bind every socket to; loopback unless told otherwise.
        duration: seconds to run; None for no end.
        stop: ends it when set.
        ready: called once all sockets are bound, before the first datagram leaves.
        watch: looks on.

    Returns:
        datagrams sent.

    Raises:
        CaptureError: a port is in use, or may not be bound.
    """
    simulation.routed = False
    with ExitStack() as stack:
        selector = stack.enter_context(selectors.DefaultSelector())
        sockets = {}
        for endpoint in simulation.endpoints:
            opened = stack.enter_context(_bind(host, endpoint, chosen=_is_chosen(simulation, endpoint)))
            sockets[endpoint] = opened
            selector.register(opened, selectors.EVENT_READ, endpoint)
        if ready:
            ready()
        # The simulation's clock counts from its start; the host's from now.
        offset = simulation.now - time.monotonic_ns()
        end_ns = None if duration is None else simulation.now + int(duration * SECOND)
        sent = 0
        while not (stop and stop.is_set()):
            now = time.monotonic_ns() + offset
            if end_ns is not None and now >= end_ns:
                break
            for item in simulation.run(now):
                if watch:
                    watch.left(item)
                sent += _send(sockets[item.source], item.destination, item.payload)
            for key, _ in selector.select(_wait_s(simulation, time.monotonic_ns() + offset)):
                for data in _waiting(sockets[key.data]):
                    if watch:
                        watch.entered(key.data, data)
                    # Fed, not delivered: the simulation's clock still stands where it last ran.
                    simulation.feed(time.monotonic_ns() + offset, key.data, data)
        return sent


def _is_chosen(simulation: Simulation, endpoint: Endpoint) -> bool:
    """Tell whether a port is asked for; telemetry's source is the operating system's choice unless it is."""
    return endpoint != simulation.cfs.to_endpoint or simulation.cfs.profile.to_source_port != 0


def _bind(host: str, endpoint: Endpoint, *, chosen: bool) -> socket.socket:
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    wanted = endpoint.port if chosen else 0
    try:
        opened.setblocking(False)
        opened.bind((host, wanted))
    except OSError as error:
        opened.close()
        what = f"UDP {Endpoint(host, wanted)} cannot be bound: {error.strerror or error}"
        raise CaptureError(f"{what}; stop what uses it, or choose other ports") from error
    return opened


def _send(source: socket.socket, destination: Endpoint, payload: bytes) -> int:
    try:
        source.sendto(payload, (destination.address, destination.port))
    except OSError:
        return 0  # UDP: nobody is told
    return 1


def _wait_s(simulation: Simulation, now: int) -> float:
    due = simulation.next_ns
    return _LONGEST_WAIT_S if due is None else min(max(due - now, 0) / SECOND, _LONGEST_WAIT_S)


def _waiting(opened: socket.socket) -> Iterator[bytes]:
    while True:
        try:
            yield opened.recv(_LARGEST_DATAGRAM)
        except OSError:  # nothing more, or an error of an earlier datagram's
            return
