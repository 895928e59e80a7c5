"""The simulation on real sockets and real time: the same core, driven by the host's clock.

SBN over TCP has connections, which the emulated cFS opens or waits for: as in SBN's TCP module, the peer with
the smaller ProcessorID connects, and tries again every few seconds. Any peer of the table may connect, and is
identified by its first message. Without a connection messages are dropped.
"""

from __future__ import annotations

import errno
import selectors
import socket
import time
from contextlib import ExitStack, suppress
from functools import partial
from threading import Event, Thread
from typing import TYPE_CHECKING, Final, Protocol

from edoras_tools.errors import CaptureError, EdorasError, OnFailure
from edoras_tools.io.net.sockets import bind, open_bound, received, resolve, send_one
from edoras_tools.links.sbn import SBN
from edoras_tools.model import Endpoint, Peer
from edoras_tools.units import SECOND
from edoras_tools.wire import sbn

if TYPE_CHECKING:
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


_CONNECT_NS: Final = 6 * SECOND
_AT_ONCE: Final = 1 << 16
_STALLED_S: Final = 1.0
"""Time without reading after which a peer loses its connection, s."""


class PeerStreams:
    """The TCP connections between SBN and its peers.

    Args:
        host: address to listen at.
        selector: gets every socket; its data is a function of the simulation's time to call when one is
            ready.

    Raises:
        CaptureError: the port is in use, or may not be bound.
    """

    def __init__(self, simulation: Simulation, host: str, selector: selectors.BaseSelector) -> None:
        self._simulation, self._selector = simulation, selector
        self._open: dict[Peer, socket.socket] = {}
        self._begun: dict[Peer, socket.socket] = {}
        self._rest: dict[socket.socket, bytes] = {}
        self._due_ns = 0
        profile = simulation.cfs.profile
        listens = Endpoint(host, profile.sbn_port)
        family, address = resolve(listens)
        self._listener = socket.socket(family, socket.SOCK_STREAM)
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        with OnFailure(self._listener.close):
            bind(self._listener, address, f"TCP {listens}", "choose another host, as 127.0.0.2")
        self._port, self._is_listening = profile.sbn_port, False
        self._peers = {config.peer: Endpoint(config.address, config.port) for config in profile.sbn_peers}
        self._by_place = {place: peer for peer, place in self._peers.items()}

    def close(self) -> None:
        """Close every socket."""
        for opened in (self._listener, *self._begun.values(), *self._rest):
            opened.close()

    def connect(self, now: int) -> None:
        """Connect to the peers of larger ProcessorIDs that have no connection, every few seconds.

        Without the application, as before it starts, there are no connections, and no port is open.
        """
        if not self._simulation.cfs.is_listening(self._port):
            for opened in list(self._rest):
                self._close(opened, now)
            return
        if not self._is_listening:
            self._is_listening = True
            self._listener.listen()
            self._selector.register(self._listener, selectors.EVENT_READ, self._accept)
        if now < self._due_ns:
            return
        self._due_ns = now + _CONNECT_NS
        own = self._simulation.cfs.profile.processor_id
        for peer, place in self._peers.items():
            if peer.processor_id <= own or peer in self._open or peer in self._begun:
                continue
            family, address = resolve(place)
            self._begun[peer] = opened = socket.socket(family, socket.SOCK_STREAM)
            opened.setblocking(False)
            if opened.connect_ex(address.host) not in {0, errno.EINPROGRESS}:
                self._begun.pop(peer).close()
                continue
            self._selector.register(opened, selectors.EVENT_WRITE, partial(self._connected, opened, peer))

    def send(self, item: WireDatagram) -> int:
        """Send a message to its peer; return 1, or 0 if there is no connection."""
        peer = self._by_place.get(item.destination)
        opened = self._open.get(peer) if peer else None
        if opened is None:
            return 0
        try:
            opened.sendall(item.payload)
        except OSError:
            self._close(opened, item.time_ns)
            return 0
        return 1

    def _accept(self, now: int) -> None:
        self._read_from(self._listener.accept()[0], None)

    def _connected(self, opened: socket.socket, peer: Peer, now: int) -> None:
        self._selector.unregister(opened)
        del self._begun[peer]
        if opened.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            opened.close()
            return
        self._open[peer] = opened
        self._read_from(opened, peer)
        self._simulation.call_at(now, partial(self._simulation.apps.sbn.node.opened, peer))

    def _read_from(self, opened: socket.socket, peer: Peer | None) -> None:
        opened.settimeout(_STALLED_S)
        opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._rest[opened] = b""
        self._selector.register(opened, selectors.EVENT_READ, partial(self._receive, opened, peer))

    def _receive(self, opened: socket.socket, peer: Peer | None, now: int) -> None:
        try:
            more = opened.recv(_AT_ONCE)
        except OSError:
            more = b""
        messages, self._rest[opened], is_foreign = SBN.framing.cut(self._rest[opened] + more)
        for message in messages:
            if peer is None:
                peer = self._introduce(opened, message)
            self._simulation.feed(now, self._simulation.cfs.sbn_endpoint, message)
        if is_foreign or not more:
            self._close(opened, now)

    def _introduce(self, opened: socket.socket, message: bytes) -> Peer:
        """Identify the peer of a connection by its first message; the latest connection of a peer is used."""
        header = sbn.HEADER.parse(message)
        peer = Peer(header["spacecraft_id"], header["processor_id"])
        self._open[peer] = opened
        self._selector.modify(opened, selectors.EVENT_READ, partial(self._receive, opened, peer))
        return peer

    def _close(self, opened: socket.socket, now: int) -> None:
        self._selector.unregister(opened)
        del self._rest[opened]
        opened.close()
        for peer in [item for item, own in self._open.items() if own is opened]:
            del self._open[peer]
            if peer in self._peers:  # call it after the earlier messages, as the end of a stream is read last
                end = sbn.emit(sbn.MsgType.DISCONNECT, peer)
                self._simulation.feed(now, self._simulation.cfs.sbn_endpoint, end)
