"""The range of a sweep: a route, rates or sizes, and the packets that are sent for it.

An ``Observer`` records a step of a sweep: every datagram, sent and received, as a capture that the diagnosis
can judge.

It also keeps facts that a capture does not show: whether an echo equals the sent message, and the time from
which no message is in transit. The line sends evenly spaced messages, passes what comes to the observer, and
waits for the last ones.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from threading import Event
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec.structs import replace

from edoras_tools.addons.lab.emulator import Scenario, messages
from edoras_tools.addons.lab.emulator.apps import generator
from edoras_tools.addons.lab.emulator.simulation import WireDatagram
from edoras_tools.cfs import command_ingest, edoras_app, telemetry_output
from edoras_tools.decode import ColumnDecoder, Context
from edoras_tools.diagnosis.case import Capture
from edoras_tools.diagnosis.examination import Diagnosis, Examination
from edoras_tools.errors import CaptureError, ConfigError, RouteError
from edoras_tools.io.frames.frame_batch import frames_of
from edoras_tools.io.frames.linklayer import demux
from edoras_tools.io.net.sockets import is_loopback
from edoras_tools.links.table import carrying
from edoras_tools.mission import Mission, Route
from edoras_tools.model import Endpoint, Link
from edoras_tools.pipelines.sending.options import CAP_HZ, Receiver, SendOptions, check_allowed
from edoras_tools.pipelines.sending.replay import Encoder
from edoras_tools.pipelines.sending.responses import Responses
from edoras_tools.sessions.outgoing import Outgoing, Packet
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import ccsds, cfe, sbn
from edoras_tools.wire.envelope import DEFAULT

if TYPE_CHECKING:
    from edoras_tools.cfs.profile import SimProfile
    from edoras_tools.io.net.transmit import Wire
    from edoras_tools.pipelines.sending.loop import Condition
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


_GROWTH: Final = 2


class Bisection(msgspec.Struct):
    """A search for the highest whole number that is good.

    >>> search = Bisection(1, 100)
    >>> while (value := search.next) is not None:
    ...     search.tell(value, good=value < 9)
    >>> search.good, search.bad
    (8, 9)

    Attributes:
        first: first value.
        last: last value, if no value is bad.
        precision: largest distance between good and bad at the end, as a share of the good one; at least 1.
        good: highest good value so far; None if there is none.
        bad: lowest bad value so far; None if there is none.
    """

    first: int
    last: int
    precision: float = 0.0
    good: int | None = None
    bad: int | None = None

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: the first value is below 1, or above the last.
        """
        if not 1 <= self.first <= self.last:
            raise ConfigError(f"{self.first}..{self.last} is not a rising range from 1 or more")

    @property
    def next(self) -> int | None:
        """The next value to try; None when the result is precise enough."""
        if self.good is None:
            return self.first if self.bad is None else None
        if self.bad is None:
            return min(self.good * _GROWTH, self.last) if self.good < self.last else None
        apart = self.bad - self.good
        return self.good + apart // 2 if apart > max(1, int(self.good * self.precision)) else None

    def tell(self, value: int, *, good: bool) -> None:
        """Record whether ``value`` was good."""
        if good:
            self.good = value
        else:
            self.bad = value


_FILL: Final = 0xA5
_PRECISION: Final = 0.02
_POSE_BYTES: Final = 100
"""Bytes of the struct that contains a PoseStamped."""
_ECHO_LIMIT: Final = 32


class SweepPlan(msgspec.Struct, frozen=True):
    """The sweep to run.

    Attributes:
        route: the route that is swept.
        rates: first and last rate in Hz; equal if sizes are swept.
        sizes: first and last size of the space packet in bytes; equal if rates are swept, and 0 for the
            message's own size.
        step_ns: duration of a step.
        options: settings of sending, with defaults filled in.
        scenario: an emulated cFS with this demo, in simulated time; None for sockets.
        limit: limit of a MsgId in the emulated cFS's pipe; None: the real limit.
        watch: whether to publish nothing, and only measure what arrives.
        watch_ns: duration of that, ns.
        generator: MsgId of the commands of the app that publishes telemetry.
    """

    route: Route
    rates: tuple[int, int]
    sizes: tuple[int, int]
    step_ns: int
    options: SendOptions
    scenario: Scenario | None = None
    limit: int | None = None
    watch: bool = False
    watch_ns: int = 60 * SECOND
    generator: int = generator.COMMAND_MSG_ID

    @property
    def headers(self) -> cfe.Headers:
        """Headers of the cFE."""
        return self.options.headers

    @property
    def by_size(self) -> bool:
        """Whether sizes are swept."""
        return self.sizes[0] != self.sizes[1]

    @property
    def to_cfs(self) -> bool:
        """Whether messages are sent to cFS; if not, they come from cFS."""
        return self.route.link.only_to_cfs or (self.route.link.peers and self.route.to_cfs)

    @property
    def is_echoed(self) -> bool:
        """Whether Telemetry Output can send the messages back."""
        return self.by_size and self.route.link.only_to_cfs

    def search(self) -> Bisection:
        """Return the search for the limit."""
        return Bisection(*self.sizes) if self.by_size else Bisection(*self.rates, precision=_PRECISION)

    def check(self, bench: Workbench) -> None:
        """Check the plan.

        Raises:
            ConfigError: a range is wrong or too fast, or a packet would be sent that is not allowed.
            FieldError: the message does not fit its packet.
        """
        self.search()
        assert self.options.target is not None
        natural, largest = natural_size(self.route, bench), self.route.link.largest
        first, last = self.sizes
        if first and not natural <= first <= last <= largest:
            name = self.route.type or "a bare header"
            raise ConfigError(
                f"--size {first}..{last}: a packet with {name} has {natural} bytes, and a datagram holds "
                f"{largest:,}; the size must be in between"
            )
        free = self.options.unlimited or self.scenario or is_loopback(self.options.target.address)
        if not free and self.rates[1] > CAP_HZ:
            raise ConfigError(
                f"{self.rates[1]:,} Hz exceeds the limit of {CAP_HZ:,.0f} Hz to other machines; end the "
                "range earlier, or remove the limit with --max-rate 0"
            )
        packets = [Packet(item) for item in self.packets(bench)]
        check_allowed(
            Outgoing.packets(carrying("ground", to_cfs=True), packets, headers=self.headers),
            self.options.allow,
            bench.mission,
        )

    def packets(self, bench: Workbench) -> list[bytes]:
        """Return one of each kind of packet that the sweep sends."""
        packets = [reset_filters(self.headers)]
        if self.to_cfs:
            packets.append(message(self.route, bench, self.sizes[0]))
        elif not self.watch:
            packets.append(generator_command(self, 0, 0))
        if self.is_echoed:
            packets += echo(self.route.msg_id, self.headers)
        return packets

    def as_json(self, bench: Workbench) -> dict[str, Any]:
        """Return the output of ``--dry-run --json``."""
        names = {f"0x{self.headers.msg_ids.of(item):04x}": None for item in self.packets(bench)}
        return {
            "dry_run": True,
            "route": self.route.topic,
            "msg_id": f"0x{self.route.msg_id:04x}",
            "link": self.route.link.label,
            "target": f"emulated {self.scenario}" if self.scenario else str(self.options.target),
            "listen": str(self.options.listen),
            "rates_hz": list(self.rates),
            "sizes": [item or natural_size(self.route, bench) for item in self.sizes],
            "step_s": self.step_ns / SECOND,
            "sends": list(names),
        }


def route_of(name: str, link: Link | None, mission: Mission) -> Route:
    """Return the route of that name on a link; a MsgId need not be configured.

    Raises:
        RouteError: no route has that name, or several have.
    """
    try:
        number = int(name, 0)
    except ValueError:
        number = 0
    routes = [
        item
        for item in mission.routes
        if (link is None or item.link is link)
        and (
            number == item.msg_id if number else name in {item.topic, item.topic.removeprefix("/"), item.key}
        )
    ]
    if len(routes) == 1:
        return routes[0]
    if number and not routes:
        if not 0 < number <= cfe.HIGHEST_MSG_ID:
            raise RouteError(f"{name} is not a MsgId from 0x0001 to 0x{cfe.HIGHEST_MSG_ID:04x}")
        towards = mission.msg_ids.is_command(number)
        link = link or carrying("ground", to_cfs=towards)
        return Route(f"0x{number:04x}", "", number, link, "command" if towards else "telemetry")
    route = mission.find(name)
    raise RouteError(
        f"{route.topic} uses {route.link.label}, not {link.label if link else 'this link'}; "
        "leave --to out, or name the route by its MsgId"
    )


def command_receiver(link: Link) -> Receiver:
    """Return the receiver of the commands: for telemetry it is also Command Ingest."""
    return Receiver.SBN if link.peers else Receiver.CI


def natural_size(route: Route, bench: Workbench) -> int:
    """Return the size in bytes of a route's space packet with default values."""
    headers = bench.columns.context.options.headers or cfe.STANDARD
    header = headers.size(route.msg_id)
    if not route.type:
        return header
    if route.type == messages.POSE_STAMPED and not headers.msg_ids.is_command(route.msg_id):
        return header + _POSE_BYTES
    return header + DEFAULT.size + len(bench.types.encode(route.type, {}))


def message(route: Route, bench: Workbench, size: int) -> bytes:
    """Return a route's packet towards cFS, padded to a size; 0 for its own size."""
    if route in bench.mission.routes:
        packet = Encoder.of(route, bench).packet(bench.types.encode(route.type, {}), 0).packet
    else:
        headers = bench.columns.context.options.headers or cfe.STANDARD
        packet = (
            cfe.emit_command(
                route.msg_id, edoras_app.SET, sequence_flags=0, with_checksum=False, headers=headers
            )
            if headers.msg_ids.is_command(route.msg_id)
            else cfe.emit_telemetry(route.msg_id, sequence_flags=0, headers=headers)
        )
    if size <= len(packet):
        return packet
    return with_length(packet, size).ljust(size, bytes([_FILL]))


def generator_command(plan: SweepPlan, rate_hz: int, size: int) -> bytes:
    """Return the command that makes the generator publish the route of a plan at a rate; 0 stops it."""
    route = plan.route
    length = max(0, size - plan.headers.telemetry_bytes)
    is_pose = route.type == messages.POSE_STAMPED and length >= _POSE_BYTES
    payload = generator.set_command(
        route.msg_id, rate_hz, length=length, kind=generator.POSE_STAMPED_KIND if is_pose else 0
    )
    return cfe.emit_command(plan.generator, generator.SET, payload, headers=plan.headers)


def echo(msg_id: int, headers: cfe.Headers = cfe.STANDARD) -> tuple[bytes, bytes]:
    """Return the commands that make Telemetry Output also send a MsgId to the ground, and stop it again."""
    add = struct.pack("<IBBBx", msg_id, 0, 0, _ECHO_LIMIT)
    command = headers.msg_ids.of_known(telemetry_output.COMMAND_MSG_ID)
    return (
        cfe.emit_command(command, telemetry_output.ADD_PACKET, add, headers=headers),
        cfe.emit_command(command, telemetry_output.REMOVE_PACKET, struct.pack("<I", msg_id), headers=headers),
    )


def with_length(packet: bytes, size: int) -> bytes:
    """Return the packet with a length field for ``size`` bytes in all; nothing is added or cut."""
    return packet[:4] + (size - ccsds.LENGTH_BIAS).to_bytes(2, "big") + packet[6:]
