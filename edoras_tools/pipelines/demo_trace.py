"""Messages followed by their bytes, from node to node through bridges and cFS: what arrives is what was said.

What cFS holds back between two of its wake-ups is its own; what is left of the time belongs to the bridges,
the sockets and the middleware.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.sessions.bridge_packets import Envelope, find_packet
from edoras_tools.sessions.pacing import Lateness
from edoras_tools.wire import envelope, sbn

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.model import Endpoint
    from edoras_tools.pipelines.demo_scene import Lane
    from edoras_tools.sim import Sent

_MOST: Final = 8192
"""Messages under way that are remembered."""
_SBN_HEADER: Final = sbn.HEADER.size
_ENVELOPE: Final = Envelope(envelope.DEFAULT)


@dataclass(slots=True)
class _Passage:
    """Times of one message, monotonic ns; 0 where it did not pass."""

    begun: int
    entered: int = 0
    left: int = 0


class Leg:
    """The way of one topic's messages; any thread may call.

    Attributes:
        said: messages that its first node said.
        entered: datagrams with a message that cFS was given, whoever said it.
        arrived: messages of its own that reached the last node, byte for byte.
        strange: messages that reached it and were not said by the first node.
        total: from said to arrived.
        added: that, without the time between cFS's reading a message and its sending it.
    """

    def __init__(self) -> None:
        self.said = self.entered = self.arrived = self.strange = 0
        self.total, self.added = Lateness(), Lateness()
        self._under_way: OrderedDict[bytes, _Passage] = OrderedDict()
        self._lock = threading.Lock()

    def begin(self, cdr: bytes, now: int) -> None:
        """Take what is about to be said."""
        with self._lock:
            self.said += 1
            self._under_way[cdr] = _Passage(now)
            self._under_way.move_to_end(cdr)
            if len(self._under_way) > _MOST:
                self._under_way.popitem(last=False)

    def enter(self, cdr: bytes, now: int) -> None:
        """Take what cFS is given."""
        with self._lock:
            self.entered += 1
            passage = self._under_way.get(cdr)
            if passage is not None:
                passage.entered = now

    def leave(self, cdr: bytes, now: int) -> None:
        """Take what cFS sends."""
        with self._lock:
            passage = self._under_way.get(cdr)
            if passage is not None:
                passage.left = now

    def arrive(self, cdr: bytes, now: int) -> None:
        """Take what the last node hears."""
        with self._lock:
            passage = self._under_way.pop(cdr, None)
            if passage is None:
                self.strange += 1
                return
            self.arrived += 1
            self.total.add(now - passage.begun)
            towards = passage.entered - passage.begun if passage.entered else 0
            self.added.add(towards + (now - passage.left if passage.left else 0))

    def summary(self) -> dict[str, Any]:
        """Return its part of ``demo --json``."""
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
    """The two legs of every robot; a ``Watch`` of the emulated cFS.

    Args:
        lanes: the robots.

    Attributes:
        commands: one a robot.
        states: one a robot.
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

    def entered(self, endpoint: Endpoint, data: bytes, /) -> None:
        """See ``Watch``."""
        del endpoint  # MsgIds of CI and of SBN differ
        now = time.monotonic_ns()
        found = _message(data)
        if found and found[0] in self._entering:
            self._entering[found[0]].enter(found[1], now)

    def left(self, sent: Sent, /) -> None:
        """See ``Watch``."""
        found = _message(sent.payload)
        if found and found[0] in self._leaving:
            self._leaving[found[0]].leave(found[1], time.monotonic_ns())


def _message(data: bytes) -> tuple[int, bytes] | None:
    """Return MsgId and CDR of a datagram of either link; None where there are none."""
    # An SBN header starts with a size below 0x0800, and no packet of a topic does.
    at = _SBN_HEADER if data[:1] < b"\x08" else 0
    if at and (len(data) < at or data[2] != sbn.MsgType.APP):
        return None
    place = find_packet(data, at)
    cdr = _ENVELOPE.open(data, place.body, place.end) if place else ""
    return (place.msg_id, cdr) if place and isinstance(cdr, bytes) else None
