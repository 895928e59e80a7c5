"""One connection of the Software Bus Network (SBN over UDP), seen from one side.

Rules that it keeps:

1. Bytes and times in, ``Step`` out: events and datagrams to send. No socket, no clock.
2. The state changes by ``TRANSITIONS`` only, and only by triggers that the habits do not ignore. The diagram
   in ``docs/bridge.md`` is written from that table.
3. Any datagram of the peer except a DISCONNECT connects. Stock SBN announces itself only to other spacecraft,
   so the first SUB or PROTO of either side connects peers of one spacecraft.
4. The peer is identified by spacecraft and processor, never by its address.
5. Subscriptions are sent with the greeting; later only changes. The peer's subscriptions end with the
   connection.
6. Every sent datagram delays the next heartbeat; every received datagram delays the time-out.
7. Any bytes may come. They cause events, never exceptions.

``Habits`` has the differences between implementations, and there is a preset for each.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from enum import Enum
from typing import Final, NamedTuple

import msgspec
from msgspec.structs import replace

from edoras_tools.cfs import edoras_app
from edoras_tools.cfs import sbn as facts
from edoras_tools.errors import TruncatedError
from edoras_tools.model import Peer
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import sbn
from edoras_tools.wire.sbn import MsgType


class ConnectionState(Enum):
    """Whether messages can be sent and received."""

    DISCONNECTED = "disconnected"
    CONNECTED = "connected"


class Trigger(Enum):
    """A cause of a change of state; the value is the text for people."""

    HEARD = "any datagram of the peer but DISCONNECT"
    DISCONNECT = "DISCONNECT"
    TIMEOUT = "nothing from the peer for 11 s"
    RESTART = "PROTO again, 1 s or more after the last SUB"


TRANSITIONS: Final[Mapping[tuple[ConnectionState, Trigger], ConnectionState]] = {
    (ConnectionState.DISCONNECTED, Trigger.HEARD): ConnectionState.CONNECTED,
    (ConnectionState.CONNECTED, Trigger.DISCONNECT): ConnectionState.DISCONNECTED,
    (ConnectionState.CONNECTED, Trigger.TIMEOUT): ConnectionState.DISCONNECTED,
    (ConnectionState.CONNECTED, Trigger.RESTART): ConnectionState.CONNECTED,
}
"""Next state by state and trigger; any other pair changes nothing."""


class Refusal(Enum):
    """The reason why a datagram was refused; the value is the text for people."""

    SHORT = "shorter than an SBN header"
    OLD_HEADER = "SBN header of 7 bytes"
    NEGATIVE_SIZE = "SBN size below 0"
    OTHER_PEER = "another peer"
    CUT_SUBSCRIPTIONS = "subscriptions cut short"
    LENGTH = "length modulo 256 below an SBN header's"


class Connected(NamedTuple):
    """A connection was made."""

    peer: Peer


class Disconnected(NamedTuple):
    """The connection was lost; ``reason`` is ``DISCONNECT`` or ``TIMEOUT``."""

    reason: Trigger


class Version(NamedTuple):
    """A PROTO came; None where it names no version."""

    version: int | None


class Subscriptions(NamedTuple):
    """A SUB or an UNSUB came."""

    msg_type: int
    ident: str
    msg_ids: tuple[int, ...]


class AppMessage(NamedTuple):
    """An APP message came, in its whole datagram."""

    datagram: bytes

    @property
    def packet(self) -> bytes:
        """The space packet."""
        return self.datagram[sbn.HEADER.size :]


class UnknownType(NamedTuple):
    """A message of a type that SBN does not have came."""

    msg_type: int


class NotTaken(NamedTuple):
    """A datagram was refused; ``sender`` if it can be read."""

    reason: Refusal
    sender: Peer | None = None


ConnectionEvent = Connected | Disconnected | Version | Subscriptions | AppMessage | UnknownType | NotTaken


class Step(NamedTuple):
    """The result of one call.

    Attributes:
        events: events, in order.
        datagrams: datagrams to send to the peer, in order.
    """

    events: Sequence[ConnectionEvent] = ()
    datagrams: Sequence[bytes] = ()


class PolledReading(NamedTuple):
    """A receiver that polls its socket, and stops at the first datagram that is not a message.

    Attributes:
        every_ns: polling period.
        buffer: most bytes of a datagram that it keeps.
        length_modulus: modulus of its length variable; a datagram whose result is below a header is dropped.
    """

    every_ns: int
    buffer: int
    length_modulus: int


class Habits(msgspec.Struct, frozen=True):
    """The behaviour of a peer.

    Attributes:
        ask: messages that it sends while it is not connected, in order.
        ask_ns: time between two requests.
        ask_first: messages that it sends before the first request, at the start and after each loss.
        asks_when_silent: whether the time to ask counts from the last datagram of any kind that it sent.
        asks_strangers_only: whether it asks only peers whose spacecraft and processor both differ from its
            own.
        asks_always: whether it also asks while it is connected.
        greeting: messages that it sends when a connection is made.
        farewell: messages that it sends at the end of a connection.
        one_by_one: whether it sends a SUB for each MsgId instead of one for all.
        heartbeat_ns: time without sending, after which it sends a heartbeat; None: it sends none.
        timeout_ns: silence after which the connection is lost; None: it never is.
        ignores: triggers that do not change its state.
        reading: behaviour of a polled socket; None: it reads datagrams as they arrive.
    """

    ask: tuple[MsgType, ...]
    ask_ns: int
    ask_first: tuple[MsgType, ...] = ()
    asks_when_silent: bool = False
    asks_strangers_only: bool = False
    asks_always: bool = False
    greeting: tuple[MsgType, ...] = (MsgType.PROTO, MsgType.SUB)
    farewell: tuple[MsgType, ...] = (MsgType.DISCONNECT,)
    one_by_one: bool = False
    heartbeat_ns: int | None = facts.HEARTBEAT_S * SECOND
    timeout_ns: int | None = facts.TIMEOUT_S * SECOND
    ignores: frozenset[Trigger] = frozenset({Trigger.RESTART})
    reading: PolledReading | None = None


STOCK: Final = Habits(
    ask=(MsgType.ANNOUNCE,), ask_ns=facts.ANNOUNCE_S * SECOND, asks_when_silent=True, asks_strangers_only=True
)
"""SBN in cFS.

It announces itself only to peers of other spacecraft, and waits for others to send first.
"""

CLIENT: Final = Habits(ask=(MsgType.PROTO, MsgType.SUB), ask_ns=SECOND)
"""A peer that connects at once: the default of replay, inject and sweep."""

TCP_CLIENT: Final = replace(CLIENT, farewell=(), timeout_ns=None)
"""The same over TCP: cFS's module has no timeout and no DISCONNECT; a peer closes the connection."""

BRIDGE: Final = Habits(
    ask=(MsgType.PROTO,),
    ask_ns=SECOND,
    # A cFS that still has this side as connected would not answer: the DISCONNECT resets that first.
    ask_first=(MsgType.DISCONNECT,),
    farewell=(MsgType.UNSUB, MsgType.DISCONNECT),
    ignores=frozenset(),
)
"""The flight bridge of these tools: subscribes once, and again after a restart of cFS."""

PUBLIC_BRIDGE: Final = Habits(
    ask=(MsgType.SUB,),
    ask_ns=500 * MILLISECOND,
    asks_always=True,
    greeting=(),
    farewell=(),
    one_by_one=True,
    heartbeat_ns=None,
    timeout_ns=None,
    ignores=frozenset(Trigger) - {Trigger.HEARD},
    reading=PolledReading(
        100 * MILLISECOND, edoras_app.FLIGHT_BRIDGE_BUFFER, edoras_app.BRIDGE_LENGTH_MODULUS
    ),
)
"""The public EDORAS flight bridge with its bugs: it repeats its SUB and answers every datagram with PROTO."""


_NEVER: Final = 2**63 - 1
_NO_CONTENT: Final = frozenset({MsgType.NO_MSG, MsgType.HEARTBEAT, MsgType.ANNOUNCE, MsgType.DISCONNECT})


class SbnConnection:
    """This side of a connection; times in ns.

    Args:
        own: identity of this side.
        msg_ids: MsgIds that this side subscribes to.
        habits: behaviour of this side.
        peer: identity of the other side; None accepts any.
        now: time of the start.

    Attributes:
        own: identity of this side.
        peer: identity of the other side, or None.
        habits: behaviour of this side.
        state: state of the connection.
        answered: identity of the last sender; None while not connected.
        wanted: MsgIds that this side subscribes to.
        subscribed: MsgIds that the other side has subscribed to.
        subscribed_ns: time at which this side last sent all its subscriptions.
    """

    busy = False
    """Whether to wait after the last message: never."""

    def __init__(
        self,
        own: Peer,
        msg_ids: Iterable[int] = (),
        *,
        habits: Habits = CLIENT,
        peer: Peer | None = None,
        now: int,
    ) -> None:
        self.own, self.peer, self.habits = own, peer, habits
        self.state = ConnectionState.DISCONNECTED
        self.answered: Peer | None = None
        self.wanted = tuple(dict.fromkeys(msg_ids))
        self.subscribed: set[int] = set()
        self.subscribed_ns = now
        self._heard_ns = self._sent_ns = self._ask_ns = self._poll_ns = now
        self._asked = self._introduced = False
        self._asks = habits.ask
        if habits.asks_strangers_only and peer is not None:
            both_differ = own.spacecraft_id != peer.spacecraft_id and own.processor_id != peer.processor_id
            self._asks = habits.ask if both_differ else ()
        self._waiting: deque[bytes] = deque()
        self._own_head = sbn.MessageHead(own)
        self._peer_head: sbn.MessageHead | None = None

    @property
    def connected(self) -> bool:
        """Whether messages can be sent and received."""
        return self.state is ConnectionState.CONNECTED

    @property
    def next_ns(self) -> int:
        """Time at which ``service`` is due."""
        habits = self.habits
        if habits.reading is not None:
            return self._poll_ns
        if not self.connected:
            return self._next_ask_ns
        heartbeat = _NEVER if habits.heartbeat_ns is None else self._sent_ns + habits.heartbeat_ns
        timeout = _NEVER if habits.timeout_ns is None else self._heard_ns + habits.timeout_ns
        return min(heartbeat, timeout)

    @property
    def _next_ask_ns(self) -> int:
        if not self._asks:
            return _NEVER
        return self._sent_ns + self.habits.ask_ns if self.habits.asks_when_silent else self._ask_ns

    def receive_message(self, data: bytes, *, now: int) -> bool:
        """Take a datagram if it is an APP message of the connected peer; return whether it is.

        This is the fast path for most datagrams, which need no answer. Polled readers do not have it.
        """
        if self._peer_head is None or not self._peer_head.fits(data):
            return False
        self._heard_ns = now
        return True

    def receive_datagram(self, data: bytes, *, now: int) -> Step:
        """Take a datagram, any bytes."""
        reading = self.habits.reading
        if reading is not None:
            self._waiting.append(data[: reading.buffer])
        elif self.receive_message(data, now=now):
            return Step((AppMessage(data),))
        try:
            header = sbn.HEADER.parse(data)
        except TruncatedError:
            return Step((NotTaken(Refusal.OLD_HEADER if _has_old_header(data) else Refusal.SHORT),))
        sender = Peer(header["spacecraft_id"], header["processor_id"])
        expected = self.peer in {None, sender}
        if header["msg_size"] < 0 or not expected:
            return Step((_refused(data, header["msg_size"], sender),))
        return self._take(data, header["msg_type"], sender, now)

    def answer(self, data: bytes, *, now: int) -> list[bytes]:
        """Take a datagram, any bytes; return the datagrams that answer it."""
        return list(self.receive_datagram(data, now=now).datagrams)

    def due(self, *, now: int) -> list[bytes]:
        """Do the work that is due; return datagrams to send."""
        return list(self.service(now=now).datagrams)

    def service(self, *, now: int) -> Step:
        """Do the work that is due: read, detect a lost peer, request a connection, send a heartbeat."""
        habits = self.habits
        events: list[ConnectionEvent] = []
        out: list[bytes] = []
        if habits.reading is not None:
            if now < self._poll_ns:
                return Step()
            self._poll_ns = max(self._poll_ns + habits.reading.every_ns, now)
            self._read(habits.reading.length_modulus, events, out)
        silent_ns, unsent_ns = now - self._heard_ns, now - self._sent_ns
        if habits.timeout_ns is not None and silent_ns >= habits.timeout_ns:
            events += self._lose(Trigger.TIMEOUT, now)
        if habits.asks_always or not self.connected:
            if now >= self._next_ask_ns:
                out += self._ask(now)
        elif habits.heartbeat_ns is not None and unsent_ns >= habits.heartbeat_ns:
            out += self._say((MsgType.HEARTBEAT,), now)
        return Step(events, out)

    def want(self, msg_ids: Iterable[int], *, now: int) -> list[bytes]:
        """Change the subscriptions of this side; return the datagrams for it: a SUB, an UNSUB, or none."""
        before, self.wanted = self.wanted, tuple(dict.fromkeys(msg_ids))
        if not self.connected:
            return []
        more = [item for item in self.wanted if item not in before]
        fewer = [item for item in before if item not in self.wanted]
        if more or fewer:
            self._sent_ns = now
        return self._subscriptions(MsgType.SUB, more) + self._subscriptions(MsgType.UNSUB, fewer)

    def subscribe(self, msg_ids: Iterable[int], *, now: int) -> list[bytes]:
        """Return the SUB of these MsgIds; it is sent connected or not."""
        self._sent_ns = now
        return self._subscriptions(MsgType.SUB, msg_ids)

    def frame(self, packet: bytes) -> bytes:
        """Return the datagram of a space packet, which has at most 32,767 bytes."""
        return self._own_head.emit(packet)

    def sent(self, *, now: int) -> None:
        """Note that messages were sent: the next heartbeat is later."""
        self._sent_ns = now

    def goodbye(self) -> list[bytes]:
        """Return the datagrams that let the peer close the connection at once."""
        return self._emit(self.habits.farewell) if self.connected else []

    def _take(self, data: bytes, msg_type: int, sender: Peer, now: int) -> Step:
        """Take a datagram of the peer."""
        self._heard_ns = now
        if msg_type == MsgType.DISCONNECT:
            return Step(self._lose(Trigger.DISCONNECT, now))
        events: list[ConnectionEvent] = []
        out: list[bytes] = []
        if self._happens(Trigger.HEARD):
            self._introduced = False
            events.append(Connected(sender))
            out = self._greet(now)
        elif (
            # The first PROTO belongs to the handshake, and some peers answer everything with one.
            msg_type == MsgType.PROTO
            and self._introduced
            and now - self.subscribed_ns >= self.habits.ask_ns
            and self._happens(Trigger.RESTART)
        ):
            self.subscribed.clear()
            self.subscribed_ns = now
            out = self._say((MsgType.SUB,), now)
        if sender != self.answered:
            self.answered, self._peer_head = sender, sbn.MessageHead(sender)
        payload = data[sbn.HEADER.size :]
        if msg_type == MsgType.PROTO:
            self._introduced = True
            events.append(Version(sbn.PROTO.parse(payload)["protocol_version"] if payload else None))
        elif msg_type in {MsgType.SUB, MsgType.UNSUB}:
            events.append(self._subscription(msg_type, payload))
        elif msg_type == MsgType.APP:
            if self.habits.reading is None:
                events.append(AppMessage(data))
        elif msg_type not in _NO_CONTENT:
            events.append(UnknownType(msg_type))
        return Step(events, out)

    def _read(self, length_modulus: int, events: list[ConnectionEvent], out: list[bytes]) -> None:
        """Read the waiting datagrams of the socket like a polled reader, and answer them."""
        while self._waiting:
            data = self._waiting.popleft()
            if len(data) % length_modulus < sbn.HEADER.size:
                events.append(NotTaken(Refusal.LENGTH))
                continue
            msg_type = sbn.HEADER.parse(data)["msg_type"]
            out += self._emit((MsgType.PROTO,))
            if msg_type == MsgType.HEARTBEAT:
                out += self._emit((MsgType.HEARTBEAT,))
            if msg_type != MsgType.APP:
                break
            events.append(AppMessage(data))

    def _subscription(self, msg_type: int, payload: bytes) -> ConnectionEvent:
        try:
            ident, entries = sbn.parse_subscriptions(payload)
        except TruncatedError:
            return NotTaken(Refusal.CUT_SUBSCRIPTIONS)
        msg_ids = tuple(item.msg_id for item in entries)
        if msg_type == MsgType.SUB:
            self.subscribed.update(msg_ids)
        else:
            self.subscribed.difference_update(msg_ids)
        return Subscriptions(msg_type, ident, msg_ids)

    def _happens(self, trigger: Trigger) -> bool:
        """Change the state by the table; return whether the trigger applied."""
        after = TRANSITIONS.get((self.state, trigger))
        if after is None or trigger in self.habits.ignores:
            return False
        self.state = after
        return True

    def _lose(self, reason: Trigger, now: int) -> list[ConnectionEvent]:
        if not self._happens(reason):
            return []
        self.answered = self._peer_head = None
        self.subscribed = set()
        self._ask_ns, self._asked = now, False
        return [Disconnected(reason)]

    def _ask(self, now: int) -> list[bytes]:
        first = () if self._asked else self.habits.ask_first
        self._asked = True
        self._ask_ns = now + self.habits.ask_ns
        return self._say((*first, *self._asks), now)

    def _greet(self, now: int) -> list[bytes]:
        self.subscribed_ns = now
        return self._say(self.habits.greeting, now)

    def _say(self, msg_types: Iterable[MsgType], now: int) -> list[bytes]:
        self._sent_ns = now
        return self._emit(msg_types)

    def _emit(self, msg_types: Iterable[MsgType]) -> list[bytes]:
        """Return the datagrams of these types, in order; those of subscriptions contain ``wanted``."""
        out: list[bytes] = []
        for msg_type in msg_types:
            if msg_type in {MsgType.SUB, MsgType.UNSUB}:
                out += self._subscriptions(msg_type, self.wanted)
            else:
                payload = sbn.emit_proto() if msg_type == MsgType.PROTO else b""
                out.append(sbn.emit(msg_type, self.own, payload))
        return out

    def _subscriptions(self, msg_type: MsgType, msg_ids: Iterable[int]) -> list[bytes]:
        entries = [sbn.Subscription(item) for item in msg_ids]
        if not entries:
            return []
        parts = [[item] for item in entries] if self.habits.one_by_one else [entries]
        return [sbn.emit(msg_type, self.own, sbn.emit_subscriptions(part)) for part in parts]


def _refused(data: bytes, msg_size: int, sender: Peer) -> NotTaken:
    if _has_old_header(data):
        return NotTaken(Refusal.OLD_HEADER)
    return NotTaken(Refusal.NEGATIVE_SIZE) if msg_size < 0 else NotTaken(Refusal.OTHER_PEER, sender)


def _has_old_header(data: bytes) -> bool:
    """Return whether a datagram has the older header of seven bytes, by its size field."""
    size = sbn.LEGACY_HEADER.size
    return len(data) >= size and sbn.LEGACY_HEADER.parse(data)["msg_size"] == len(data) - size
