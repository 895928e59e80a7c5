"""Differences between implementations of SBN: the options of ``SbnConnection``, and a preset for each."""

from __future__ import annotations

from typing import Final, NamedTuple

import msgspec
from msgspec.structs import replace

from edoras_tools.cfs import limits
from edoras_tools.cfs import sbn as facts
from edoras_tools.sessions.sbn.events import Trigger
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire.sbn import MsgType


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
    reading=PolledReading(100 * MILLISECOND, limits.FLIGHT_BRIDGE_BUFFER, limits.BRIDGE_LENGTH_MODULUS),
)
"""The public EDORAS flight bridge with its bugs: it repeats its SUB and answers every datagram with PROTO."""
