"""What Foxglove publishes, into cFS: only where it is allowed, and by the rules that hold for ``inject``."""

from __future__ import annotations

import threading
import time
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Final, Protocol

from edoras_tools.errors import ConfigError, EdorasError, RouteError
from edoras_tools.middleware.foxglove import ENCODINGS, as_cdr, full_type
from edoras_tools.pipelines.orders import CAP_HZ, Orders, To
from edoras_tools.pipelines.safety import fits, is_loopback
from edoras_tools.pipelines.topics import Encoder, routes_towards, sender_of
from edoras_tools.sessions.outgoing import Outgoing
from edoras_tools.sessions.profile import MILLISECOND
from edoras_tools.sessions.sbn_client import SbnClient
from edoras_tools.sinks.transmit import Transmitter
from edoras_tools.sinks.wire import UdpWire

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from edoras_tools.mission import Route
    from edoras_tools.pipelines.workbench import Workbench

_ROUND_NS: Final = 50 * MILLISECOND


class Send(Protocol):
    """Sends what goes to cFS on one link."""

    def __call__(self, data: bytes, msg_id: int, /) -> str:
        """Send a datagram, which holds the packet of a MsgId; return why not, empty where it left."""


class Commands:
    """Makes packets of what clients publish, and sends them: a ``Publisher``.

    Args:
        bench: its mission says which topic goes where.
        allow: patterns of topics, keys and MsgIds that may be published, as ``/robot_*``; at least one.
        orders: where to, and as whom; its ``to`` is found by the route.
        outlets: what sends on each link, instead of sockets.

    Attributes:
        orders: of each link that something may be sent on, placed; for ``check_target``.

    Raises:
        RouteError: a pattern fits no topic that goes to cFS.
        ConfigError: one target is named for topics of two links.
    """

    def __init__(
        self,
        bench: Workbench,
        allow: Sequence[str],
        orders: Orders | None = None,
        *,
        outlets: Mapping[To, Send] | None = None,
    ) -> None:
        self._bench = bench
        self._stack = ExitStack()
        self._lock = threading.Lock()
        self._outlets: dict[To, Send] = dict(outlets or {})
        self._routes: dict[str, tuple[To, Encoder]] = {}
        self._due: dict[To, float] = {}
        for to in (To.CI, To.SBN):
            for route in _allowed(bench, to, allow):
                self._routes.setdefault(route.topic, (to, Encoder.of(route, bench)))
        self._check(allow)
        links = {to for to, _ in self._routes.values()}
        orders = orders or Orders()
        if orders.target is not None and len(links) > 1:
            raise ConfigError("--target: topics of CI and SBN may be published; allow those of one link")
        self.orders = {to: _placed(orders, to, bench) for to in links if to not in self._outlets}

    @property
    def topics(self) -> list[str]:
        """What may be published."""
        return sorted(self._routes)

    def open(self) -> None:
        """Open the sockets; on the SBN link a session begins.

        Raises:
            CaptureError: one cannot be opened.
        """
        for to, orders in self.orders.items():
            assert orders.target is not None
            if to is To.CI:
                transmitter = self._stack.enter_context(Transmitter(orders.target))
                self._outlets[to] = _Plain(transmitter).send
            else:
                peer = _PeerLink(orders, self._bench)
                self._stack.callback(peer.close)
                self._outlets[to] = peer.send

    def close(self) -> None:
        """Say goodbye, and close the sockets; may be called twice."""
        self._stack.close()

    def refusal(self, topic: str, type_name: str, encoding: str) -> str:
        """Return why a client may not publish there; empty where it may."""
        found = self._routes.get(topic)
        if found is None:
            return f"{topic} may not be published; --allow-publish lets {', '.join(self.topics)}"
        wanted = found[1].route.type
        if full_type(type_name) != wanted:
            return f"{topic} takes {wanted}, not {type_name or 'a type without name'}"
        if encoding not in ENCODINGS:
            return f"{topic}: {encoding} is not understood; publish {' or '.join(ENCODINGS)}"
        return ""

    def publish(self, topic: str, type_name: str, encoding: str, data: bytes) -> str:
        """Take a message; return why not, empty where it was sent."""
        why = self.refusal(topic, type_name, encoding)
        if why:
            return why
        to, encoder = self._routes[topic]
        try:
            cdr = as_cdr(self._bench.types, encoder.route.type, encoding, data)
            packet = encoder.packet(cdr, time.time_ns())
        except EdorasError as error:
            return f"{topic}: {error}"
        sender = sender_of(self.orders[to], self._bench.mission) if to in self.orders else None
        datagram = Outgoing.packets(to.link, [packet], sender=sender)[0]
        with self._lock:
            return self._cap(to) or self._outlets[to](datagram, encoder.route.msg_id)

    def _cap(self, to: To) -> str:
        """Hold to the cap on the rate that other machines are sent at."""
        orders = self.orders.get(to)
        if orders is None or orders.target is None or orders.unlimited:
            return ""
        cap = orders.max_rate_hz or (0.0 if is_loopback(orders.target.address) else CAP_HZ)
        if not cap:
            return ""
        now = time.monotonic()
        due = max(self._due.get(to, 0.0), now - 1.0)  # a second's worth at once, at most
        if due > now:
            return f"more than {cap:g} a second are not sent to {orders.target}"
        self._due[to] = due + 1 / cap
        return ""

    def _check(self, allow: Sequence[str]) -> None:
        mission = self._bench.mission
        routes = [route for to in (To.CI, To.SBN) for route in routes_towards(to, mission)]
        for pattern in allow:
            if not any(fits(pattern, route.msg_id, mission) for route in routes):
                there = ", ".join(route.topic for route in routes) or "none; name a mission with -c"
                raise RouteError(f"--allow-publish {pattern!r} fits no topic that goes to cFS: {there}")


def _allowed(bench: Workbench, to: To, allow: Sequence[str]) -> list[Route]:
    mission = bench.mission
    return [
        route
        for route in routes_towards(to, mission)
        if any(fits(pattern, route.msg_id, mission) for pattern in allow)
    ]


def _placed(orders: Orders, to: To, bench: Workbench) -> Orders:
    return replace(orders, to=to, deaf=to is To.CI).placed(bench.mission)


class _Plain:
    """Command Ingest: a datagram a command, and nobody answers."""

    def __init__(self, transmitter: Transmitter) -> None:
        self._transmitter = transmitter

    def send(self, data: bytes, _msg_id: int) -> str:
        return "" if self._transmitter.send(data) else f"{self._transmitter.target} takes nothing"


class _PeerLink:
    """A session with cFS as its SBN peer, in a thread of its own."""

    def __init__(self, orders: Orders, bench: Workbench) -> None:
        assert orders.target is not None
        self._target = orders.target
        self._transmitter = Transmitter(orders.target, orders.listen)
        self._wire = UdpWire(self._transmitter, To.SBN.link)
        self._session = SbnClient(orders.identity(bench.mission), now=self._wire.now())
        self._lock = threading.Lock()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="foxglove SBN", daemon=True)
        self._thread.start()

    def send(self, data: bytes, msg_id: int) -> str:
        with self._lock:
            if not self._session.connected:
                return f"no SBN peer answers at {self._target}; is cFS up?"
            if msg_id not in self._session.subscribed:
                return f"SBN peer {self._session.answered} has not subscribed to 0x{msg_id:04x}"
            self._session.sent(now=self._wire.now())
            return "" if self._wire.put(data) else f"{self._target} takes nothing"

    def close(self) -> None:
        self._stopping = True
        self._thread.join()
        for data in self._session.goodbye():
            self._wire.put(data)
        self._transmitter.close()

    def _run(self) -> None:
        wire, session = self._wire, self._session
        while not self._stopping:
            with self._lock:
                now = wire.now()
                answers = [
                    data
                    for item in wire.receive()
                    for data in session.receive_datagram(item.payload, now=now)
                ]
                if now >= session.next_ns:
                    answers += session.service(now=now)
                for data in answers:
                    wire.put(data)
            wire.wait(min(wire.now() + _ROUND_NS, max(session.next_ns, now + MILLISECOND)))
