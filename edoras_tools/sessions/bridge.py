"""A bridge between a ROS 2 graph and one cFS: messages, datagrams and times in, datagrams and messages out.

Rules that it keeps:

1. Datagrams to send are put into ``outbox``, in order; the owner of the socket empties it.
2. Every incoming message is counted once: as sent, as held back by a limit (or waiting for it), or as refused
   with a reason.
3. Messages for cFS while the session is not ready are never sent, also not later: old commands are dangerous.
4. A packet longer than cFS accepts is refused, never cut.
5. The bytes of a message stay unchanged; only headers and envelopes are written or removed.
6. An envelope whose length exceeds the packet is refused; bytes after the length of an envelope are dropped.

The two kinds of bridges differ in what they send to cFS, and in when they may send messages. A ground bridge
sends commands to Command Ingest, and asks Telemetry Output for telemetry. A flight bridge has an SBN
connection, and lines about it for people.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, Generic, Literal, TypeVar

import msgspec

from edoras_tools.cfs import edoras_app, telemetry_output
from edoras_tools.cfs.command_ingest import CI_BUFFER
from edoras_tools.sessions.sbn import (
    BRIDGE,
    AppMessage,
    Connected,
    Disconnected,
    NotTaken,
    Refusal,
    SbnConnection,
    Subscriptions,
    Trigger,
    UnknownType,
    Version,
)
from edoras_tools.sessions.sequence import MODULUS
from edoras_tools.units import SECOND
from edoras_tools.wire import ccsds, cfe, envelope, sbn
from edoras_tools.wire.cfe import STANDARD, Headers
from edoras_tools.wire.envelope import CDR_BE, CDR_LE, ENCAPSULATION, EnvelopeFormat

if TYPE_CHECKING:
    from edoras_tools.mission import Route
    from edoras_tools.model import Peer
    from edoras_tools.sessions.sbn import ConnectionEvent

_PRIMARY: Final = struct.Struct(">HHH")
_WORDS: Final = {8: "Q", 4: "I", 2: "H", 1: "B"}
_UNSEGMENTED: Final = ccsds.UNSEGMENTED << 14
_PADDING: Final = 3
"""RTPS pads a message to four bytes."""


def _lengths(form: envelope.EnvelopeFormat) -> struct.Struct:
    """Return the struct format of the two lengths of an envelope."""
    return struct.Struct(("<" if form.byte_order == "little" else ">") + 2 * _WORDS[form.width])


class PacketWriter:
    """Writes packets; sequence counts and checksums, which the public bridges leave 0, on request.

    Args:
        checksum: whether to write the checksum of commands.
        sequence: whether to count the packets of each MsgId, as cFE does.
        headers: headers of the cFE that reads the packets.
    """

    def __init__(
        self, *, checksum: bool = False, sequence: bool = False, headers: cfe.Headers = cfe.STANDARD
    ) -> None:
        self._checksum, self._sequence, self._headers = checksum, sequence, headers
        self._spare = bytes(headers.command_bytes - headers.start - 2)
        self._rest = bytes(headers.telemetry_bytes - headers.start)
        self._starts: dict[int, tuple[int, bytes, bool]] = {}
        self._counts: dict[int, int] = {}

    def overhead(self, msg_id: int) -> int:
        """Return the bytes of the headers of a MsgId's packets."""
        return self._headers.size(msg_id)

    def of_known(self, msg_id: int) -> int:
        """Return the MsgId, for the cFE that reads the packets, of a MsgId of version 1."""
        return self._headers.msg_ids.of_known(msg_id)

    def write(self, msg_id: int, payload: bytes, code: int = edoras_app.SET) -> bytes:
        """Return a packet. A telemetry MsgId gets the telemetry header with time 0, and no function code."""
        word = 0
        if self._sequence:
            count = self._counts.get(msg_id, 0)
            self._counts[msg_id] = (count + 1) % MODULUS
            word = _UNSEGMENTED | count
        first, between, command = self._starts.get(msg_id) or self._start(msg_id)
        if not command:
            rest = between + self._rest + payload
            return _PRIMARY.pack(first, word, len(rest) - 1) + rest
        rest = between + bytes((code, 0)) + self._spare + payload
        packet = _PRIMARY.pack(first, word, len(rest) - 1) + rest
        if not self._checksum:
            return packet
        at = self._headers.start + cfe.CHECKSUM_BYTE
        return packet[:at] + bytes((cfe.checksum(packet),)) + packet[at + 1 :]

    def _start(self, msg_id: int) -> tuple[int, bytes, bool]:
        """Return the first word, the bytes between primary and cFE header, and whether it is a command."""
        head = self._headers.emit(msg_id, self._headers.size(msg_id), 0, 0)
        between = head[ccsds.PRIMARY.size :]
        command = bool(self._headers.msg_ids.is_command(msg_id))
        self._starts[msg_id] = start = int.from_bytes(head[:2], "big"), between, command
        return start


class Envelope:
    """One route's envelope, both ways.

    Args:
        form: format of the envelope; None detects it from the bytes, and writes the default.
        cdr_bytes: bytes of every message of the type, encapsulation included; None if they vary.
        type_name: type of the message, for refusals.
    """

    def __init__(
        self, form: envelope.EnvelopeFormat | None, cdr_bytes: int | None = None, type_name: str = ""
    ) -> None:
        self._form = form
        self._written = form or envelope.DEFAULT
        self._lengths = None if self._written.own else _lengths(self._written)
        self.most = self._written.most
        self._cdr_bytes, self._type = cdr_bytes, type_name

    @property
    def size(self) -> int:
        """Bytes that ``wrap`` adds."""
        return self._written.size + self._written.crc

    def wrap(self, cdr: bytes) -> bytes:
        """Return a message in its envelope, at most ``most`` bytes."""
        length = len(cdr)
        if self._lengths is None:
            return self._written.emit(cdr)
        return self._lengths.pack(length, length) + cdr

    def open(self, data: bytes, start: int, end: int) -> bytes | str:
        """Return the CDR of an envelope, or the reason why there is none.

        Args:
            data: the datagram.
            start: start of the envelope in it.
            end: end of its packet, within the datagram.
        """
        form = self._form or envelope.detect(data[start:end])
        if form is None:
            return "no envelope that fits"
        at = start + form.size
        if at > end:
            return "cut inside the envelope"
        if form is self._written and self._lengths is not None:
            length = self._lengths.unpack_from(data, start)[0]
        else:
            length = form.parse(data, start)[0]
        if length > end - at - form.crc:
            return "the envelope's length exceeds the packet"
        if length < ENCAPSULATION.size:
            return "no CDR in the envelope"
        if not CDR_BE <= (data[at] << 8 | data[at + 1]) <= CDR_LE:
            return "the content of the envelope is not CDR"
        if not form.intact(data, start, length):
            return "the envelope's CRC is wrong"
        expected = self._cdr_bytes
        if expected is not None and not expected <= length <= expected + _PADDING:
            return f"not the {expected} bytes of a {self._type}"
        return data[at : at + length]


class PacketPlace(msgspec.Struct, frozen=True):
    """A space packet in a datagram.

    Attributes:
        msg_id: MsgId in the version of its cFE.
        body: end of its cFE header.
        end: end of the packet, by its own length and the datagram's.
    """

    msg_id: int
    body: int
    end: int


def find_packet(data: bytes, at: int, headers: cfe.Headers = cfe.STANDARD) -> PacketPlace | None:
    """Return the space packet that starts at byte ``at`` of a datagram; None if its header is incomplete."""
    if len(data) - at < ccsds.PRIMARY.size:
        return None
    msg_id = headers.msg_ids.of(data, at)
    header = headers.size(msg_id)
    end = min(len(data), at + (data[at + 4] << 8 | data[at + 5]) + ccsds.LENGTH_BIAS)
    return PacketPlace(msg_id, at + header, end) if at + header <= end else None


Item = TypeVar("Item")


class Limit(msgspec.Struct, frozen=True):
    """The limit of a lane.

    Attributes:
        rate_hz: most messages a second; None for no limit.
        keep: message to keep at the limit. ``latest``: an excess message waits until the lane is due, and a
            newer one replaces it; ``first``: an excess message is dropped.
    """

    rate_hz: float | None = None
    keep: Literal["latest", "first"] = "latest"


class Limiter(Generic[Item]):
    """Lanes of messages, each with its own limit, and one limit for all of them together.

    1. A message passes when its lane is due; then the lane is due again one period later.
    2. Due times stay on a grid if messages come a little late: 250 Hz under a limit of 30 Hz leave at 30 Hz,
       not at the 27.8 Hz of every ninth message.
    3. Two messages of a lane are never closer than half a period.
    4. If the total is reached, the lane that has waited longest is next.

    Args:
        limits: limit of each lane.
        total_hz: most messages a second of the counted lanes together; None for no limit.
        in_total: whether the total counts each lane; by default all of them.

    Attributes: held: for each lane, messages that never pass: dropped, or replaced by a newer one.
    """

    def __init__(
        self, limits: Sequence[Limit], total_hz: float | None = None, in_total: Sequence[bool] | None = None
    ) -> None:
        self.held = [0] * len(limits)
        self._latest = [limit.keep == "latest" for limit in limits]
        self._clocks = [_Clock(limit.rate_hz) for limit in limits]
        free = _Clock(None)
        total = _Clock(total_hz)
        self._totals = [total if count else free for count in in_total or [True] * len(limits)]
        self._waiting: dict[int, Item] = {}  # in the order in which the lanes began to wait
        self._free = [
            limit.rate_hz is None and (mine is free or total_hz is None)
            for limit, mine in zip(limits, self._totals, strict=True)
        ]

    @property
    def next_ns(self) -> int | None:
        """Time at which ``due`` returns something, ns; None if nothing waits."""
        if not self._waiting:
            return None
        return min(max(self._clocks[lane].due_ns, self._totals[lane].due_ns) for lane in self._waiting)

    def waits(self, lane: int) -> bool:
        """Return whether a message of a lane waits."""
        return lane in self._waiting

    def offer(self, lane: int, item: Item, *, now: int) -> bool:
        """Return whether a message may pass at once; if not, it is dropped, or ``due`` returns it later."""
        if self._free[lane]:
            return True
        if lane in self._waiting:
            self._waiting[lane] = item  # it keeps its place in the order of waiting
            self.held[lane] += 1
            return False
        # Under a total, a message that already waits goes first.
        if self._may(lane, now) and not any(self._may(other, now) for other in self._waiting):
            self._pass(lane, now)
            return True
        if self._latest[lane]:
            self._waiting[lane] = item
        else:
            self.held[lane] += 1
        return False

    def due(self, *, now: int) -> list[tuple[int, Item]]:
        """Return the lanes and messages that are due, the longest waiting first."""
        messages = []
        for lane in list(self._waiting):
            if self._may(lane, now):
                self._pass(lane, now)
                messages.append((lane, self._waiting.pop(lane)))
        return messages

    def _may(self, lane: int, now: int) -> bool:
        return now >= self._clocks[lane].due_ns and now >= self._totals[lane].due_ns

    def _pass(self, lane: int, now: int) -> None:
        self._clocks[lane].step(now)
        self._totals[lane].step(now)


class _Clock:
    """Time at which the next message may pass, ns."""

    __slots__ = ("_period_ns", "due_ns")

    def __init__(self, rate_hz: float | None) -> None:
        self._period_ns = round(SECOND / rate_hz) if rate_hz else 0
        self.due_ns = -(1 << 62)

    def step(self, now: int) -> None:
        """Note that a message passed."""
        period = self._period_ns
        if not period:
            return
        late = now - self.due_ns
        # Up to half a period late the grid is kept; after a longer pause a new one begins.
        self.due_ns = now + period if late >= period else max(self.due_ns + period, now + period // 2)


CI_LARGEST: Final = CI_BUFFER
"""Largest packet that Command Ingest accepts, in bytes; it would cut a longer one, which is refused."""
_REASONS: Final = 16
SBN_LARGEST: Final = sbn.LARGEST_PAYLOAD


class BridgeOptions(msgspec.Struct, frozen=True):
    """Options for the packets of a bridge.

    Attributes:
        headers: headers of the cFE at the other end.
        envelope: format where a route names none; ``auto`` detects it from the bytes.
        max_size: largest packet in bytes that cFS accepts.
        max_rate_total: most messages a second to cFS; None for no limit.
    """

    headers: cfe.Headers = cfe.STANDARD
    envelope: str = "8/8 le"
    max_size: int = SBN_LARGEST
    max_rate_total: float | None = None


class Traffic(msgspec.Struct):
    """The counts of the messages of one route.

    Attributes:
        received: number of messages that came in.
        sent: number of messages that went out.
        refused: number of messages that could not go out, by reason.
    """

    received: int = 0
    sent: int = 0
    refused: dict[str, int] = msgspec.field(default_factory=dict)

    def refuse(self, reason: str) -> None:
        """Count a refused message.

        The number of reasons is bounded, because some contain values of the message.
        """
        if reason not in self.refused and len(self.refused) >= _REASONS:
            reason = "other reasons"
        self.refused[reason] = self.refused.get(reason, 0) + 1


class BridgeSession:
    """The routes of one bridge, and its session with cFS.

    Args:
        routes: routes to and from cFS.
        link: the session with cFS.
        writer: writer of packets, shared with the session.
        sizes: bytes of the messages of each type; None if they vary.

    Attributes:
        routes: the routes; a route is named by its index.
        link: the session with cFS.
        traffic: counts of each route.
        limiter: rate limits, in the order of the routes.
        outbox: datagrams to send, in order.
        others: number of packets from cFS without a route.
        unreadable: number of datagrams from cFS without a whole packet.
    """

    def __init__(
        self,
        routes: Sequence[Route],
        link: GroundSession | FlightSession,
        writer: PacketWriter,
        options: BridgeOptions | None = None,
        sizes: Mapping[str, int | None] | None = None,
    ) -> None:
        options, sizes = options or BridgeOptions(), sizes or {}
        self.routes, self.link = tuple(routes), link
        self.traffic = [Traffic() for _ in routes]
        self.outbox: list[bytes] = []
        self.others = self.unreadable = 0
        handlings = [route.handling for route in routes]
        # The total protects cFS; packets from cFS do not count.
        limits = [Limit(item.max_rate, item.keep or "latest") for item in handlings]
        self.limiter: Limiter[bytes] = Limiter(
            limits, options.max_rate_total, [route.to_cfs for route in routes]
        )
        self._writer, self._headers = writer, options.headers
        self._envelopes = [
            Envelope(_format(route.envelope or options.envelope), sizes.get(route.type), route.type)
            for route in routes
        ]
        self._largest_cdr = [
            min(envelope.most, options.max_size - writer.overhead(route.msg_id) - envelope.size)
            for route, envelope in zip(routes, self._envelopes, strict=True)
        ]
        self._from_cfs = {route.msg_id: index for index, route in enumerate(routes) if not route.to_cfs}

    @property
    def next_ns(self) -> int | None:
        """Time at which ``service`` is due, ns; None for never."""
        first, second = self.link.next_ns, self.limiter.next_ns
        if first is None or second is None:
            return first if second is None else second
        return min(first, second)

    def receive_message(self, index: int, cdr: bytes, *, now: int) -> bool:
        """Take a message of the graph for cFS; return whether it was put into the outbox at once."""
        traffic = self.traffic[index]
        traffic.received += 1
        if not self.link.ready:
            traffic.refuse("cFS is not connected")
        elif len(cdr) < ENCAPSULATION.size:
            traffic.refuse("no CDR")
        elif len(cdr) > self._largest_cdr[index]:
            traffic.refuse(f"longer than the {self._largest_cdr[index]} bytes of CDR that fit a packet")
        elif self.limiter.offer(index, cdr, now=now):
            self._emit(index, cdr, now)
            return True
        return False

    def receive_datagram(self, data: bytes, *, now: int) -> tuple[int, bytes] | None:
        """Take a datagram of cFS, any bytes; return a route's index and the message to publish, or None."""
        at, answers = self.link.receive_datagram(data, now=now)
        if answers:
            self.outbox += answers
        if at < 0:
            return None
        place = find_packet(data, at, self._headers)
        if place is None:
            self.unreadable += 1
            return None
        index = self._from_cfs.get(place.msg_id)
        if index is None:
            self.others += 1
            return None
        traffic = self.traffic[index]
        traffic.received += 1
        cdr = self._envelopes[index].open(data, place.body, place.end)
        if isinstance(cdr, str):
            traffic.refuse(cdr)
        elif self.limiter.offer(index, cdr, now=now):
            traffic.sent += 1
            return index, cdr
        return None

    def service(self, *, now: int) -> list[tuple[int, bytes]]:
        """Do the work that is due, of the session and the limiter; return the messages to publish."""
        due = self.link.next_ns
        if due is not None and due <= now:
            self.outbox += self.link.service(now=now)
        publish = []
        for index, cdr in self.limiter.due(now=now):
            if not self.routes[index].to_cfs:
                self.traffic[index].sent += 1
                publish.append((index, cdr))
            elif self.link.ready:
                self._emit(index, cdr, now)
            else:
                self.traffic[index].refuse("cFS is not connected")
        return publish

    def not_published(self, index: int, reason: str) -> None:
        """Count a message that could not be published as refused, not as sent."""
        self.traffic[index].sent -= 1
        self.traffic[index].refuse(reason)

    def goodbye(self) -> None:
        """Put the datagrams that end the session into the outbox."""
        self.outbox += self.link.goodbye()

    def summary(self) -> dict[str, Any]:
        """Return the bridge's part of ``bridge --json``."""
        return {
            **self.link.summary(),
            "refused": dict(self.link.refused),
            "others": self.others,
            "unreadable": self.unreadable,
            "routes": [
                {
                    **describe(route),
                    "in": traffic.received,
                    "out": traffic.sent,
                    "held": self.limiter.held[index],
                    "waiting": int(self.limiter.waits(index)),
                    "refused": dict(traffic.refused),
                }
                for index, (route, traffic) in enumerate(zip(self.routes, self.traffic, strict=True))
            ],
        }

    def _emit(self, index: int, cdr: bytes, now: int) -> None:
        packet = self._writer.write(self.routes[index].msg_id, self._envelopes[index].wrap(cdr))
        self.outbox.append(self.link.frame(packet))
        self.link.sent(now=now)
        self.traffic[index].sent += 1


def describe(route: Route) -> dict[str, Any]:
    """Return a route as ``bridge --json`` has it, without counts."""
    return {
        "topic": route.topic,
        "type": route.type,
        "msg_id": f"0x{route.msg_id:04x}",
        "direction": "to_cfs" if route.to_cfs else "from_cfs",
        "max_rate": route.handling.max_rate,
    }


def _format(name: str) -> EnvelopeFormat | None:
    return None if name == "auto" else EnvelopeFormat.of_name(name)


ASK_NS: Final = 2 * SECOND
SILENCE_NS: Final = 10 * SECOND
STEP_NS: Final = SECOND
"""Twice the time between Command Ingest's wake-ups."""
_ASKS: Final = 5
_AT_ONCE: Final = 4
"""Most commands of one MsgId that can wait in Telemetry Output's pipe."""
_ADD: Final = struct.Struct("<IBBBx")
"""MsgId, priority, reliability, message limit."""


class GroundSession:
    """CI and TO of one cFS.

    Args:
        address: IPv4 address that Telemetry Output shall send to; None: send it no commands.
        add: message limit of each MsgId to add to its table.
        now: present time, ns.

    Attributes:
        ready: whether commands may be sent: always True.
        next_ns: time at which ``service`` is due; None for never.
        hearing: whether telemetry arrives.
        asked: number of times that Telemetry Output was asked.
        notes: lines for people; the reader empties the list.
        refused: number of refused datagrams, by reason: always empty, because any sender may be TO.
    """

    def __init__(
        self, writer: PacketWriter, address: str | None, add: Mapping[int, int] | None = None, *, now: int
    ) -> None:
        self.ready = True
        self.hearing = False
        self.asked = 0
        self.notes: list[str] = []
        self.refused: dict[str, int] = {}
        self.next_ns: int | None = None if address is None else now
        self._writer, self._address, self._add = writer, address, dict(add or {})
        self._heard_ns = now
        self._told = False
        self._again_ns = now
        self._bursts: list[list[bytes]] = []

    def receive_datagram(self, data: bytes, *, now: int) -> tuple[int, list[bytes]]:
        """Take a datagram; return the start of its space packet, and no answers."""
        self._heard_ns = now
        if not self.hearing:
            self.hearing, self._told = True, False
            self.notes.append("telemetry arrives")
            if self.next_ns is not None and not self._bursts:
                self.next_ns = now + SILENCE_NS
        return 0, []

    def service(self, *, now: int) -> list[bytes]:
        """Command Telemetry Output to send, if no telemetry arrives."""
        if self.next_ns is None or now < self.next_ns:
            return []
        if not self._bursts:
            silent_ns = now - self._heard_ns
            if self.hearing and silent_ns < SILENCE_NS:
                self.next_ns = self._heard_ns + SILENCE_NS
                return []
            if silent_ns >= SILENCE_NS and not self._told:
                self._told = True
                self.notes.append(
                    f"no telemetry for {silent_ns // SECOND} s: is cFS running, does its TO send here? "
                    f"asking again"
                )
            self.hearing = False
            self.asked += 1
            self._again_ns = now + (ASK_NS if self.asked <= _ASKS else SILENCE_NS)
            self._bursts = self._ask()
        burst = self._bursts.pop(0)
        if self._bursts:
            self.next_ns = now + STEP_NS
        else:
            self.next_ns = self._heard_ns + SILENCE_NS if self.hearing else max(self._again_ns, now + STEP_NS)
        return burst

    def frame(self, packet: bytes) -> bytes:
        """Return the datagram of a packet: itself."""
        return packet

    def sent(self, *, now: int) -> None:
        """Do nothing: Command Ingest expects no heartbeat."""

    def goodbye(self) -> list[bytes]:
        """Return nothing: Telemetry Output has no command that disables it."""
        return []

    def summary(self) -> dict[str, Any]:
        """Return the session's part of ``bridge --json``."""
        return {"connected": self.hearing, "asked": self.asked}

    def _ask(self) -> list[list[bytes]]:
        assert self._address is not None
        write = self._writer.write
        command = self._writer.of_known(telemetry_output.COMMAND_MSG_ID)
        bursts = [[write(command, self._address.encode("ascii").ljust(16, b"\0"), telemetry_output.ENABLE)]]
        for msg_id, limit in self._add.items():
            if len(bursts[-1]) > _AT_ONCE - 2:
                bursts.append([])
            # TO keeps the old limit of a MsgId that is added twice: it is removed first.
            bursts[-1] += [
                write(command, _ADD.pack(msg_id, 0, 0, 0)[:4], telemetry_output.REMOVE_PACKET),
                write(command, _ADD.pack(msg_id, 0, 0, limit), telemetry_output.ADD_PACKET),
            ]
        return bursts


_NO_PACKET: Final = -1
_MOST_TOLD: Final = 64
_MOST_PEERS: Final = 16
_SUBSCRIBED_WITHIN_NS: Final = 2 * SECOND
"""Time within which cFS has sent its subscriptions."""


class FlightSession:
    """One connection to cFS's Software Bus Network.

    Args:
        own: identity of this side.
        peer: identity of cFS; all others are refused.
        msg_ids: MsgIds that this side subscribes to.
        now: present time, ns.
        headers: headers of the cFE at the other end.

    Attributes:
        connection: the SBN connection.
        connections: number of times a connection was made.
        losses: number of times one was lost: by ``disconnect``, by ``timeout``.
        refused: number of refused datagrams, by reason.
        notes: lines for people; the reader empties the list.
    """

    def __init__(
        self, own: Peer, peer: Peer, msg_ids: Iterable[int] = (), *, now: int, headers: Headers = STANDARD
    ) -> None:
        self.connection = SbnConnection(own, msg_ids, habits=BRIDGE, peer=peer, now=now)
        self.connections = 0
        self.losses = {"disconnect": 0, "timeout": 0}
        self.refused: dict[str, int] = {}
        self.notes: list[str] = []
        self._peer, self._headers = peer, headers
        self._told: set[str] = set()
        self._unwanted: set[int] = set()

    @property
    def ready(self) -> bool:
        """Whether messages may be sent."""
        return self.connection.connected

    @property
    def next_ns(self) -> int:
        """Time at which ``service`` is due, ns."""
        return self.connection.next_ns

    def receive_datagram(self, data: bytes, *, now: int) -> tuple[int, list[bytes]]:
        """Take a datagram, any bytes.

        Returns:
            The start of its space packet, -1 if there is none, and the datagrams that answer it.
        """
        if self.connection.receive_message(data, now=now):
            return sbn.HEADER.size, []
        step = self.connection.receive_datagram(data, now=now)
        at = _NO_PACKET
        for event in step.events:
            if isinstance(event, AppMessage):
                at = sbn.HEADER.size
            else:
                self._note(event)
        return at, list(step.datagrams)

    def service(self, *, now: int) -> list[bytes]:
        """Request a connection, keep it alive, or detect that it is lost."""
        step = self.connection.service(now=now)
        for event in step.events:
            self._note(event)
        return list(step.datagrams)

    def want(self, msg_ids: Iterable[int], *, now: int) -> list[bytes]:
        """Change the subscriptions of this side; return the datagrams for it: a SUB, an UNSUB, or none."""
        return self.connection.want(msg_ids, now=now)

    def frame(self, packet: bytes) -> bytes:
        """Return the datagram of a packet, which has at most 32,767 bytes."""
        msg_id = self._headers.msg_ids.of(packet)
        if msg_id not in self.connection.subscribed:
            self._unwanted.add(msg_id)
        return self.connection.frame(packet)

    def sent(self, *, now: int) -> None:
        """Note that messages were sent: the next heartbeat is later."""
        self.connection.sent(now=now)
        if self._unwanted and now - self.connection.subscribed_ns >= _SUBSCRIBED_WITHIN_NS:
            for msg_id in sorted(self._unwanted):
                self._tell(
                    f"cFS has not subscribed to 0x{msg_id:04X}: no application there receives it; is the "
                    f"MsgId the same on both sides?"
                )
            self._unwanted.clear()

    def goodbye(self) -> list[bytes]:
        """Return the UNSUB and the DISCONNECT that let cFS close the pipe at once."""
        return self.connection.goodbye()

    def summary(self) -> dict[str, Any]:
        """Return the session's part of ``bridge --json``."""
        return {
            "peer": str(self._peer),
            "connected": self.ready,
            "connections": self.connections,
            "losses": dict(self.losses),
        }

    def _note(self, event: ConnectionEvent) -> None:
        """Count an event, and add a line for people if it needs one."""
        peer = self._peer
        match event:
            case Connected():
                self.connections += 1
                self.notes.append(f"connected to peer {peer}")
            case Disconnected(Trigger.DISCONNECT):
                self.losses["disconnect"] += 1
                self.notes.append(f"peer {peer} disconnected; asking again")
            case Disconnected():
                self.losses["timeout"] += 1
                seconds = (BRIDGE.timeout_ns or 0) // SECOND
                self.notes.append(f"nothing from peer {peer} for {seconds} s: connection lost; asking again")
            case Version(version) if version not in {None, sbn.PROTOCOL_VERSION}:
                self._tell(
                    f"peer {peer} speaks SBN protocol {version}, this side {sbn.PROTOCOL_VERSION}: it may "
                    f"refuse messages; continuing"
                )
            case Subscriptions(ident=ident):
                self._unwanted -= self.connection.subscribed
                if ident != sbn.IDENT:
                    self._tell(
                        f"peer {peer} is another SBN ({ident or 'no $Id'}): it will refuse our subscriptions"
                    )
            case UnknownType(msg_type):
                self._count(f"unknown SBN message type 0x{msg_type:02x}")
            case NotTaken(Refusal.OTHER_PEER, other):
                self._count(f"peer {other}" if len(self.refused) < _MOST_PEERS else "further peers")
                self._tell(f"peer {other} sends here, but the file expects {peer}: refused")
            case NotTaken(reason):
                self._count(reason.value)
                if reason is Refusal.OLD_HEADER:
                    self._tell(
                        "an older SBN with a header of 7 bytes instead of 11 sends here: not supported"
                    )

    def _count(self, reason: str) -> None:
        self.refused[reason] = self.refused.get(reason, 0) + 1

    def _tell(self, text: str) -> None:
        """Add a line once."""
        if text not in self._told and len(self._told) < _MOST_TOLD:
            self._told.add(text)
            self.notes.append(text)
