"""Follows messages by their bytes, from node to node through bridges and cFS.

The time that a message spends in cFS belongs to cFS; the rest to bridges, sockets and middleware.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from typing import TYPE_CHECKING, Any, Final

import msgspec

from edoras_tools.sessions.bridge.packets import Envelope, find_packet
from edoras_tools.sessions.pacing import Lateness
from edoras_tools.wire import envelope, sbn

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.addons.lab.demo.scene import Lane
    from edoras_tools.addons.lab.emulator import WireDatagram
    from edoras_tools.model import Endpoint

_MOST: Final = 8192
"""Maximum number of messages in transit that are kept."""
_SBN_HEADER: Final = sbn.HEADER.size
_ENVELOPE: Final = Envelope(envelope.DEFAULT)


class _Times(msgspec.Struct):
    """Times of one message, monotonic ns; 0 if it did not pass that point."""

    begin: int
    entered: int = 0
    departures: int = 0


class Leg:
    """Counts and times of one topic's messages, from the first node to the last; thread-safe.

    Attributes:
        said: messages that the first node published.
        entered: datagrams with a message that cFS received, from any sender.
        arrived: messages of the first node that reached the last node, byte for byte.
        strange: messages that reached the last node, but were not published by the first.
        total: time from publishing to arrival.
        added: time from publishing to arrival, without the time between reading and sending in cFS.
    """

    def __init__(self) -> None:
        self.said = self.entered = self.arrived = self.strange = 0
        self.total, self.added = Lateness(), Lateness()
        self._under_way: OrderedDict[bytes, _Times] = OrderedDict()
        self._lock = threading.Lock()

    def begin(self, cdr: bytes, now: int) -> None:
        """Count a message that the first node is about to publish."""
        with self._lock:
            self.said += 1
            self._under_way[cdr] = _Times(now)
            self._under_way.move_to_end(cdr)
            if len(self._under_way) > _MOST:
                self._under_way.popitem(last=False)

    def enter(self, cdr: bytes, now: int) -> None:
        """Count a message that cFS receives."""
        with self._lock:
            self.entered += 1
            passage = self._under_way.get(cdr)
            if passage is not None:
                passage.entered = now

    def leave(self, cdr: bytes, now: int) -> None:
        """Count a message that cFS sends."""
        with self._lock:
            passage = self._under_way.get(cdr)
            if passage is not None:
                passage.departures = now

    def arrive(self, cdr: bytes, now: int) -> None:
        """Count a message that the last node receives."""
        with self._lock:
            passage = self._under_way.pop(cdr, None)
            if passage is None:
                self.strange += 1
                return
            self.arrived += 1
            self.total.add(now - passage.begin)
            towards = passage.entered - passage.begin if passage.entered else 0
            self.added.add(towards + (now - passage.departures if passage.departures else 0))

    def summary(self) -> dict[str, Any]:
        """Return this topic's part of ``demo --json``."""
        with self._lock:
            return {
                "said": self.said,
                "into_cfs": self.entered,
                "arrived": self.arrived,
                "of_others": self.strange,
                "latency_us": self.total.summary(),
                "added_us": self.added.summary(),
            }


class Trace:
    """The two paths of every robot; a ``Watch`` of the emulated cFS.

    Attributes:
        commands: path of the commands of each robot.
        states: path of the states of each robot.
    """

    def __init__(self, lanes: Sequence[Lane]) -> None:
        self.commands = [Leg() for _ in lanes]
        self.states = [Leg() for _ in lanes]
        self._entering: dict[int, Leg] = {}
        self._leaving: dict[int, Leg] = {}
        for lane, command, state in zip(lanes, self.commands, self.states, strict=True):
            self._entering[lane.command.msg_id] = command
            self._leaving[lane.state.msg_id] = state
            if lane.board_command and lane.board_state:
                self._leaving[lane.board_command.msg_id] = command
                self._entering[lane.board_state.msg_id] = state

    def received(self, endpoint: Endpoint, data: bytes, /) -> None:
        """See ``Watch``."""
        now = time.monotonic_ns()
        message = _message(data)
        if message and message[0] in self._entering:
            self._entering[message[0]].enter(message[1], now)

    def sent(self, sent: WireDatagram, /) -> None:
        """See ``Watch``."""
        message = _message(sent.payload)
        if message and message[0] in self._leaving:
            self._leaving[message[0]].leave(message[1], time.monotonic_ns())


def _message(data: bytes) -> tuple[int, bytes] | None:
    """Return MsgId and CDR of a datagram of either link; None if there are none."""
    # An SBN header starts with a size below 0x0800, and no packet of a topic does.
    at = _SBN_HEADER if data[:1] < b"\x08" else 0
    if at and (len(data) < at or data[2] != sbn.MsgType.APP):
        return None
    place = find_packet(data, at)
    cdr = _ENVELOPE.open(data, place.body, place.end) if place else ""
    return (place.msg_id, cdr) if place and isinstance(cdr, bytes) else None
