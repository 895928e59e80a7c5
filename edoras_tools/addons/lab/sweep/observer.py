"""Records a step of a sweep: every datagram, sent and received, as a capture that the diagnosis can judge.

It also keeps facts that a capture does not show: whether an echo equals the sent message, and the time from
which no message is in transit. The line sends evenly spaced messages, passes what comes to the observer, and
waits for the last ones.
"""

from __future__ import annotations

from threading import Event
from typing import TYPE_CHECKING, Final

import msgspec
from msgspec.structs import replace

from edoras_tools.addons.lab.emulator.simulation import WireDatagram
from edoras_tools.cfs import command_ingest
from edoras_tools.decode import ColumnDecoder, Context
from edoras_tools.diagnosis.case import Capture
from edoras_tools.diagnosis.examination import Diagnosis, Examination
from edoras_tools.errors import CaptureError
from edoras_tools.io.frames.frame_batch import frames_of
from edoras_tools.io.frames.linklayer import demux
from edoras_tools.links.table import carrying
from edoras_tools.mission import Mission, Route
from edoras_tools.model import Endpoint, Link
from edoras_tools.pipelines.sending.responses import Responses
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import cfe, sbn

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from edoras_tools.cfs.profile import SimProfile
    from edoras_tools.io.net.transmit import Wire
    from edoras_tools.pipelines.sending.wait_for import Condition
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.sessions.sbn import SbnConnection

_SLOTS: Final = cfe.SOFTWARE_BUS_HOUSEKEEPING.by_name
_LOSSES: Final = slice(_SLOTS["pipe_overflow_error_counter"].start, _SLOTS["message_limit_error_counter"].end)
"""Bytes of both loss counters in the payload of 0x803."""
_COUNTERS: Final = (cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID, command_ingest.HOUSEKEEPING_MSG_ID)
_BEFORE_NS: Final = 2500 * MILLISECOND
"""Time before a step whose housekeeping is kept, if steps follow each other without a pause."""
# The link of a datagram is known whatever its real ports are; for the diagnosis these ports identify it.
_TO_PORT: Final = 50001


def _ends(link: Link) -> tuple[Endpoint, Endpoint]:
    """Return a link's endpoint on the ground or at the robot, and its endpoint at cFS."""
    if link.peers:
        return Endpoint("127.0.0.1", 2236), Endpoint("127.0.0.1", 2234)
    if link.only_from_cfs:
        return Endpoint("127.0.0.1", _TO_PORT), Endpoint("127.0.0.1", 50002)
    return Endpoint("127.0.0.1", 50000), Endpoint("127.0.0.1", 1234)


class Mark(msgspec.Struct):
    """The counts at one moment.

    Attributes:
        arrived: messages of the route that came from cFS.
        whole: messages among them that were as expected.
        reports: 0x803 packets so far.
        counters: MsgId to the loss counters of the last 0x803, and to the contents of the last 0x884.
        differs_at: first byte at which a message differed from the expected one; None if none differed.
    """

    arrived: int = 0
    whole: int = 0
    reports: int = 0
    counters: dict[int, bytes] = msgspec.field(default_factory=dict)
    differs_at: int | None = None


class Observer:
    """Records the datagrams of a step.

    Attributes:
        seen: counts of everything received since the start.
        expected: the bytes that a message of the route must have; None for any.
        expected_size: the length that it must have; 0 for any.
        largest: bytes of the longest one received.
    """

    def __init__(self, bench: Workbench, route: Route) -> None:
        context = bench.columns.context
        self.seen = Responses(bench.mission)
        self.expected: bytes | None = None
        self.expected_size = 0
        self.largest = 0
        options = replace(context.options, ports=((carrying("ground", to_cfs=False), _TO_PORT),))
        self._context = Context(Mission(routes=bench.mission.routes), bench.types, options)
        self._route, self._msg_ids = route, bench.mission.msg_ids
        self._datagrams: list[tuple[int, WireDatagram]] = []
        self._latest: dict[int, WireDatagram] = {}
        self._mark = Mark()
        self._quiet_ns = 0

    def sent(self, data: bytes, now: int) -> None:
        """Record a datagram that was sent, at ``now``, ns since 1970."""
        link = carrying("flight" if self._route.link.peers else "ground", to_cfs=True)
        source, destination = _ends(link)
        self._datagrams.append(
            (self._msg_id(_packet(link, data)), WireDatagram(now, source, destination, data))
        )

    def received(self, link: Link, data: bytes, now: int) -> None:
        """Record a datagram that was received, any bytes, at ``now``, ns since 1970."""
        self.seen.add(link, data, now)
        own, peer = _ends(link)
        packet, item = _packet(link, data), WireDatagram(now, peer, own, data)
        msg_id = self._msg_id(packet)
        standard = self._msg_ids.standard(msg_id)
        self._datagrams.append((msg_id, item))
        if standard in _COUNTERS:
            self._latest[msg_id] = item
            of_bus = standard == cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID
            # The rest of 0x803 changes all the time: messages without a subscriber, memory in use.
            payload = packet[cfe.TELEMETRY_HEADER_BYTES :]
            self._mark.counters[msg_id] = payload[_LOSSES] if of_bus else payload
            self._mark.reports += of_bus
        if msg_id == self._route.msg_id:
            self._compare(packet)

    def _compare(self, packet: bytes) -> None:
        mark = self._mark
        mark.arrived += 1
        self.largest = max(self.largest, len(packet))
        if self.expected is not None and packet != self.expected:
            pairs = zip(packet, self.expected, strict=False)
            shorter = min(len(packet), len(self.expected))
            same = next((at for at, (a, b) in enumerate(pairs) if a != b), shorter)
            mark.differs_at = same if mark.differs_at is None else min(mark.differs_at, same)
        elif not self.expected_size or len(packet) == self.expected_size:
            mark.whole += 1

    def quiet(self, now: int) -> None:
        """Record that no message of the step is in transit from ``now`` on."""
        self._quiet_ns = now

    def begin(self) -> None:
        """Start a step after a quiet time: only the last values of the counters are kept."""
        self._forget(self._quiet_ns)

    def go_on(self, now: int) -> None:
        """Start a step directly after the last one: a gap before its first message counts."""
        last = [item for item in self._datagrams if item[0] == self._route.msg_id][-1:]
        self._forget(now - _BEFORE_NS)
        self._datagrams = sorted(last + self._datagrams, key=lambda item: item[1].time_ns)

    def _forget(self, since_ns: int) -> None:
        judged = {self._route.msg_id, self._msg_ids.of_known(cfe.EVENT_MSG_ID)}
        rest = [item for item in self._datagrams if item[1].time_ns >= since_ns and item[0] not in judged]
        older = [item for item in self._latest.items() if item[1].time_ns < since_ns]
        self._datagrams = sorted(older, key=lambda item: item[1].time_ns) + rest
        self._mark.differs_at = None

    def mark(self) -> Mark:
        """Return the counts so far."""
        return replace(self._mark, counters=dict(self._mark.counters))

    def _msg_id(self, packet: bytes) -> int:
        return self._msg_ids.of(packet) if len(packet) >= cfe.COMMAND_HEADER_BYTES else -1

    def diagnose(self, profile: SimProfile) -> Diagnosis:
        """Diagnose the step, as the doctor does with a capture."""
        examination = Examination(self._context, profile)
        if self._datagrams:
            batch = demux(frames_of([item for _, item in self._datagrams]))
            examination.add(batch, ColumnDecoder(self._context).decode(batch))
        # The messages were sent to this side, so a missing one is lost, not only missing in the capture.
        return examination.diagnose(Capture(drops=0))


def _packet(link: Link, data: bytes) -> bytes:
    """Return the space packet in a datagram; empty if it contains none."""
    if not link.peers:
        return data
    carries = len(data) >= sbn.HEADER.size and sbn.HEADER.parse(data)["msg_type"] == sbn.MsgType.APP
    return data[sbn.HEADER.size :] if carries else b""


_ROUND_NS: Final = 20 * MILLISECOND
_FRESH_NS: Final = 1200 * MILLISECOND
"""Age of an event from which later housekeeping shows that cFS had processed it: CI wakes up within 500 ms,
and TO sends within another 500 ms."""
_PATIENCE_NS: Final = 60 * SECOND
_SILENCE_NS: Final = 8 * SECOND
COMMAND_NS: Final = 700 * MILLISECOND
"""Time in which cFS reads a command."""


class Line:
    """Sends and listens.

    Args:
        name: name of the other end, for the user.
        observer: recorder of all datagrams sent and received.
        session: the SBN session that the traffic belongs to.

    Attributes:
        stopped: set it to end the sweep soon.
    """

    def __init__(self, wire: Wire, name: str, observer: Observer, session: SbnConnection | None) -> None:
        self.stopped = Event()
        self._wire, self._name, self._observer, self._session = wire, name, observer, session
        self._epoch_ns = wire.epoch_ns()

    def now(self) -> int:
        """Return monotonic time, ns."""
        return self._wire.now()

    def epoch(self) -> int:
        """Return the time, ns since 1970."""
        return self._wire.now() + self._epoch_ns

    def listen(self, duration_ns: int) -> None:
        """Receive for this time."""
        self.until(lambda: False, duration_ns)

    def until(self, condition: Callable[[], bool], timeout_ns: int) -> bool:
        """Receive until a condition holds; return whether it did in time."""
        end = self._wire.now() + timeout_ns
        while not condition():
            now = self._receive()
            if now >= end or self.stopped.is_set():
                return condition()
            self._wire.wait(min(end, now + _ROUND_NS))
        return True

    def open(self, conditions: Iterable[Condition], timeout_ns: int) -> None:
        """Wait until the other end answers.

        Raises:
            CaptureError: it does not answer; the text says what was tried.
        """
        began = self._wire.now()
        for condition in conditions:
            ask_ns = began
            while not condition.met() and not self.stopped.is_set():
                now = self._receive()
                if now - began >= timeout_ns:
                    raise CaptureError(condition.explain((now - began) / SECOND))
                if now >= ask_ns:
                    condition.ask()
                    ask_ns = now + SECOND
                self._wire.wait(now + _ROUND_NS)

    def command(self, packet: bytes) -> None:
        """Send one of the sweep's own commands, and wait until cFS has read it."""
        if not self.stopped.is_set():
            self._put(packet)
            self.listen(COMMAND_NS)

    def close(self, packets: Iterable[bytes]) -> None:
        """Send the commands that restore the state of cFS, without waiting, and disconnect."""
        for packet in packets:
            self._put(packet)
        for data in self._session.goodbye() if self._session else ():
            self._transmit(data)

    def evenly(self, packet: bytes, rate_hz: float, count: int) -> int:
        """Send a packet ``count`` times, each at its own deadline; return how often it was sent."""
        start = self._wire.now()
        for index in range(count):
            self.listen(start + round(index * SECOND / rate_hz) - self._wire.now())
            if self.stopped.is_set():
                return index
            self._put(packet)
        self.listen(start + round(count * SECOND / rate_hz) - self._wire.now())
        return count

    def settle(self) -> Mark:
        """Wait until no message is in transit: until two successive new reports of every counter are equal.

        Raises:
            CaptureError: cFS stopped sending.
        """
        began = self._wire.now()
        self.listen(_FRESH_NS)
        mark = self._observer.mark()
        while not self.stopped.is_set():
            self._observer.quiet(self.epoch())
            before, mark = mark, self._next_report(mark)
            if mark.counters == before.counters or self._wire.now() - began > _PATIENCE_NS:
                break
        return mark

    def _next_report(self, last: Mark) -> Mark:
        """Wait for the next 0x803; continue without it if none ever came."""
        if self.until(lambda: self._observer.mark().reports > last.reports, _SILENCE_NS):
            return self._observer.mark()
        if last.reports and not self.stopped.is_set():
            raise CaptureError(
                f"{self._name} stopped sending: no housekeeping for {_SILENCE_NS // SECOND} s; cFS has "
                "stopped, or telemetry was enabled for another address (TO sends to one address at a time)"
            )
        return last

    def _put(self, packet: bytes) -> None:
        session = self._session
        if session is not None:
            packet = session.frame(packet)
            session.sent(now=self._wire.now())
        self._transmit(packet)

    def _transmit(self, data: bytes) -> None:
        self._observer.sent(data, self.epoch())
        self._wire.put(data)

    def _receive(self) -> int:
        """Handle what arrived and keep the session alive; return the time."""
        now = self._wire.now()
        session = self._session
        answers: list[bytes] = []
        for item in self._wire.receive():
            self._observer.received(item.link, item.payload, now + self._epoch_ns)
            if session is not None and item.link.peers:
                answers += session.answer(item.payload, now=now)
        if session is not None and now >= session.next_ns:
            answers += session.due(now=now)
        for data in answers:
            self._transmit(data)
        if self._wire.statistics.refused:
            raise CaptureError(
                f"{self._name} refuses: no program listens there (ICMP port unreachable); start cFS or "
                "edoras sim, name it with --target, or sweep an emulated one with --sim"
            )
        return now


def reset_filters(headers: cfe.Headers) -> bytes:
    """Return the command that resets the event filters: after 16 of a kind, the bus sends no more events."""
    return cfe.emit_command(headers.msg_ids.of_known(0x1801), 14, b"CFE_SB".ljust(20, b"\0"), headers=headers)
