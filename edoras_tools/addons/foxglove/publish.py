"""Sends the messages that clients of a Foxglove server publish to cFS, if allowed, like ``inject``."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING, Final

from msgspec.structs import replace

from edoras_tools.addons.foxglove.server.protocol import Publisher
from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.io.net.sockets import is_loopback
from edoras_tools.io.net.transmit import Transmitter, UdpWire
from edoras_tools.pipelines.sending.options import CAP_HZ, Receiver, SendOptions, fits
from edoras_tools.pipelines.sending.replay import Encoder, routes_towards, sender_of
from edoras_tools.sessions.outgoing import Outgoing
from edoras_tools.sessions.sbn import SbnConnection
from edoras_tools.units import MILLISECOND

if TYPE_CHECKING:
    from edoras_tools.pipelines.workbench import Workbench

    Send = Callable[[bytes, int], str]
    """Sends a datagram with a packet of a MsgId to cFS; returns the reason of a failure, or an empty text."""

_ROUND_NS: Final = 50 * MILLISECOND


class CommandPublisher(Publisher):
    """Makes packets from messages that clients publish, and sends them.

    Args:
        bench: workbench whose mission gives the link of each topic.
        allow: patterns of topics, keys and MsgIds that may be published, e.g. ``/robot_*``; at least one.
        options: target and sender; its ``to`` is set by the route.
        outlets: functions that send on a link, instead of sockets.

    Attributes:
        options: options for each link that may be used, with its target; for ``check_target``.

    Raises:
        RouteError: a pattern matches no topic that goes to cFS.
        ConfigError: one target is named for topics of two links.
    """

    def __init__(
        self,
        bench: Workbench,
        allow: Sequence[str],
        options: SendOptions | None = None,
        *,
        outlets: Mapping[Receiver, Send] | None = None,
    ) -> None:
        super().__init__(bench.types, self._not_allowed)
        self._bench = bench
        self._stack = ExitStack()
        self._lock = threading.Lock()
        self._outlets: dict[Receiver, Send] = dict(outlets or {})
        self._due: dict[Receiver, float] = {}
        mission, links = bench.mission, set()
        routes = [(to, route) for to in (Receiver.CI, Receiver.SBN) for route in routes_towards(to, mission)]
        for pattern in allow:
            if not any(fits(pattern, route.msg_id, mission) for _, route in routes):
                existing = ", ".join(route.topic for _, route in routes) or "none; name a mission with -c"
                raise RouteError(f"--allow {pattern!r} matches no topic that goes to cFS: {existing}")
        for to, route in routes:
            is_allowed = any(fits(pattern, route.msg_id, mission) for pattern in allow)
            if is_allowed and route.topic not in self.topics:
                links.add(to)
                self.accept(route.topic, route.type, partial(self._send, to, Encoder.of(route, bench)))
        options = options or SendOptions()
        if options.target is not None and len(links) > 1:
            raise ConfigError("--target: topics of both CI and SBN are allowed; allow those of one link")
        self.options = {
            to: replace(options, to=to, no_listen=to is Receiver.CI).placed(mission)
            for to in links
            if to not in self._outlets
        }

    def open(self) -> None:
        """Open the sockets; on the SBN link a session starts.

        Raises:
            CaptureError: one cannot be opened.
        """
        for to, options in self.options.items():
            assert options.target is not None
            if to is Receiver.CI:
                transmitter = self._stack.enter_context(Transmitter(options.target))
                self._outlets[to] = partial(_send_to_ci, transmitter)
            else:
                peer = _PeerLink(options, self._bench)
                self._stack.callback(peer.close)
                self._outlets[to] = peer.send

    def close(self) -> None:
        """End the sessions and close the sockets; calling it again does nothing."""
        self._stack.close()

    def _not_allowed(self, topic: str) -> str:
        return f"{topic} may not be published; --allow allows {', '.join(self.topics)}"

    def _send(self, to: Receiver, encoder: Encoder, cdr: bytes) -> str:
        packet = encoder.packet(cdr, time.time_ns())
        sender = sender_of(self.options[to], self._bench.mission) if to in self.options else None
        datagram = Outgoing.packets(to.link, [packet], sender=sender)[0]
        with self._lock:
            return self._cap(to) or self._outlets[to](datagram, encoder.route.msg_id)

    def _cap(self, to: Receiver) -> str:
        """Return the reason why a message is refused, or an empty text: other machines have a rate limit."""
        options = self.options.get(to)
        if options is None or options.target is None or options.unlimited:
            return ""
        cap = options.max_rate_hz or (0.0 if is_loopback(options.target.address) else CAP_HZ)
        if not cap:
            return ""
        now = time.monotonic()
        due = max(self._due.get(to, 0.0), now - 1.0)  # at most one second's messages in a burst
        if due > now:
            return f"the rate to {options.target} is limited to {cap:g} messages per second"
        self._due[to] = due + 1 / cap
        return ""


def _send_to_ci(transmitter: Transmitter, data: bytes, _msg_id: int) -> str:
    """Send a command to Command Ingest: one datagram, without an answer."""
    return "" if transmitter.send(data) else f"{transmitter.target} accepts no datagrams"


class _PeerLink:
    """A session with cFS as its SBN peer, in its own thread."""

    def __init__(self, options: SendOptions, bench: Workbench) -> None:
        assert options.target is not None
        self._target = options.target
        self._transmitter = Transmitter(options.target, options.listen)
        self._wire = UdpWire(self._transmitter, Receiver.SBN.link)
        self._session = SbnConnection(options.identity(bench.mission), now=self._wire.now())
        self._lock = threading.Lock()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="foxglove SBN", daemon=True)
        self._thread.start()

    def send(self, data: bytes, msg_id: int) -> str:
        with self._lock:
            if not self._session.connected:
                return f"no SBN peer answers at {self._target}; is cFS running?"
            if msg_id not in self._session.subscribed:
                return f"SBN peer {self._session.answered} has not subscribed to 0x{msg_id:04x}"
            self._session.sent(now=self._wire.now())
            return "" if self._wire.put(data) else f"{self._target} accepts no datagrams"

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
                    for data in session.receive_datagram(item.payload, now=now).datagrams
                ]
                if now >= session.next_ns:
                    answers += session.service(now=now).datagrams
                for data in answers:
                    wire.put(data)
            wire.wait(min(wire.now() + _ROUND_NS, max(session.next_ns, now + MILLISECOND)))
