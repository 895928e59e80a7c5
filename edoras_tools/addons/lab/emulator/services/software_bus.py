"""The cFE Software Bus: pipes, routes, the two limits that lose messages, and the events about them."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Final

import msgspec

from edoras_tools.addons.lab.emulator.account import ArrivalAccount, Fifo
from edoras_tools.addons.lab.emulator.services.events import Event
from edoras_tools.cfs import software_bus
from edoras_tools.cfs.queues import QueueEnd
from edoras_tools.errors import ConfigError
from edoras_tools.sessions.sequence import MODULUS
from edoras_tools.wire import ccsds, cfe
from edoras_tools.wire.cfe import length_of, msg_id_of

if TYPE_CHECKING:
    from edoras_tools.cfs.profile import SimProfile


HOP: Final = "software bus"
"""Hop of packets without a subscriber."""


class Pipe(Fifo[bytes], eq=False):
    """The packets that wait for an application.

    Attributes:
        name: name in events.
        ignores: its own application, whose packets it does not accept (cFE's pipe option "ignore mine").
    """

    name: str = ""
    ignores: str = ""


class Counters(msgspec.Struct):
    """The counters of the software bus, as in its housekeeping packet."""

    commands: int = 0
    command_errors: int = 0
    no_subscribers: int = 0
    send_errors: int = 0
    duplicate_subscriptions: int = 0
    pipe_overflows: int = 0
    msg_limits: int = 0


class Publication(msgspec.Struct, frozen=True):
    """The result for one packet.

    Attributes:
        packet: packet as delivered, with its sequence count if it was to be stamped.
        delivered: pipes that accepted it.
        events: events of the bus, before any filter.
        status: 0, or the return value of the sender's call.
    """

    packet: bytes
    delivered: tuple[Pipe, ...] = ()
    events: tuple[Event, ...] = ()
    status: int = software_bus.SUCCESS


class SoftwareBus:
    """The routes between applications.

    Attributes:
        counters: counters.
        losses: packets that a pipe refused, by MsgId and pipe.
        pipes: pipes by name.
        subscribed: MsgIds in the order of their first subscription, as reported to SBN.
    """

    def __init__(self, profile: SimProfile, account: ArrivalAccount | None = None) -> None:
        self.profile = profile
        self._account = account or ArrivalAccount(lambda: 0, is_on=False)
        self.counters = Counters()
        self.losses: Counter[tuple[int, str]] = Counter()
        self.pipes: dict[str, Pipe] = {}
        self.subscribed: list[int] = []
        self._routes: dict[int, list[Pipe]] = {}
        self._sequence: dict[int, int] = {}

    def create_pipe(self, name: str, depth: int, *, ignores: str = "") -> Pipe:
        """Create a pipe.

        Raises:
            ConfigError: a pipe of that name exists, or its depth is 0.
        """
        if name in self.pipes or depth < 1:
            raise ConfigError(f"pipe {name}: depth {depth}; a pipe is made once and holds 1 packet or more")
        depth = min(depth, self.profile.msg_max or depth)
        pipe = self.pipes[name] = Pipe(depth, name=name, ignores=ignores)
        self._account.watch(pipe, name)
        return pipe

    def delete_pipe(self, pipe: Pipe) -> None:
        """Remove a pipe and its subscriptions; the packets in it are lost."""
        del self.pipes[pipe.name]
        for msg_id in list(pipe.limits):
            self.unsubscribe(pipe, msg_id)
        pipe.clear()

    def subscribe(self, pipe: Pipe, msg_id: int, limit: int | None = None, *, local: bool = False) -> None:
        """Route a MsgId to a pipe; a second subscription is only counted.

        Args:
            limit: number of its packets that may wait; the profile's ``app_msg_limit`` by default.
            local: whether it is not reported to SBN, as SBN's own subscriptions on behalf of peers.
        """
        if msg_id in pipe.limits:
            self.counters.duplicate_subscriptions += 1
            return
        pipe.limits[msg_id] = self.profile.app_msg_limit if limit is None else limit
        if msg_id not in self._routes:
            self._routes[msg_id] = []
            self._sequence[msg_id] = 0
        if not local and msg_id not in self.subscribed:
            self.subscribed.append(msg_id)
        # cFE puts a new destination in front of the list.
        self._routes[msg_id].insert(0, pipe)

    def unsubscribe(self, pipe: Pipe, msg_id: int) -> bool:
        """Stop routing a MsgId to a pipe; return whether it was routed. The route itself stays, as in cFE."""
        if pipe.limits.pop(msg_id, None) is None:
            return False
        self._routes[msg_id].remove(pipe)
        return True

    def publish(self, packet: bytes, sender: str, *, stamp: bool) -> Publication:
        """Deliver a packet to every pipe that accepts it.

        Args:
            packet: packet with at least a command header; its length field counts, not ``len``.
            sender: name in events, ``APP`` or ``APP.TASK``.
            stamp: write the route's next sequence count, as for a publisher; an app that forwards a packet
                does not stamp it.
        """
        msg_id, size = msg_id_of(packet), length_of(packet)
        if not 0 < msg_id <= cfe.HIGHEST_MSG_ID:
            self.counters.send_errors += 1
            event = _event(software_bus.INVALID_MSG_ID, msg_id=msg_id, sender=sender)
            return Publication(packet, events=(event,), status=software_bus.BAD_ARGUMENT)
        if size > self.profile.bus_max_bytes:
            self.counters.send_errors += 1
            most = self.profile.bus_max_bytes
            event = _event(software_bus.MSG_TOO_BIG, msg_id=msg_id, sender=sender, size=size, most=most)
            return Publication(packet, events=(event,), status=software_bus.TOO_BIG)
        route = self._routes.get(msg_id)
        if route is None:
            self.counters.no_subscribers += 1
            self._account.note(HOP, msg_id, QueueEnd.CLOSED)
            return Publication(
                packet, events=(_event(software_bus.NO_SUBSCRIBERS, msg_id=msg_id, sender=sender),)
            )
        if stamp:
            count = self._sequence[msg_id] = (self._sequence[msg_id] + 1) % MODULUS
            packet = _with_sequence_count(packet, count)
        delivered, events = [], []
        for pipe in route:
            if sender and pipe.ignores == sender:
                continue
            outcome = pipe.put(packet, msg_id)
            if outcome is QueueEnd.WAITING:
                delivered.append(pipe)
                continue
            over_limit = outcome is QueueEnd.MSG_LIMIT
            self.counters.msg_limits += over_limit
            self.counters.pipe_overflows += not over_limit
            reason = software_bus.MSG_LIMIT if over_limit else software_bus.PIPE_OVERFLOW
            events.append(_event(reason, msg_id=msg_id, pipe=pipe.name, sender=sender))
            self.losses[msg_id, pipe.name] += 1
        if not route:
            self._account.note(HOP, msg_id, QueueEnd.CLOSED)
        self.counters.send_errors += len(events)
        return Publication(packet, tuple(delivered), tuple(events))

    def housekeeping(self) -> bytes:
        """Return the payload of housekeeping packet 0x803, 28 bytes; counters wrap as in flight."""
        count = self.counters
        return cfe.SOFTWARE_BUS_HOUSEKEEPING.emit(
            {
                "command_counter": count.commands & 0xFF,
                "command_error_counter": count.command_errors & 0xFF,
                "no_subscribers_counter": count.no_subscribers & 0xFF,
                "message_send_error_counter": count.send_errors & 0xFF,
                "duplicate_subscriptions_counter": count.duplicate_subscriptions & 0xFF,
                "pipe_overflow_error_counter": count.pipe_overflows & 0xFFFF,
                "message_limit_error_counter": count.msg_limits & 0xFFFF,
            }
        )


def _event(event_id: int, **values: object) -> Event:
    return Event.of(software_bus.EVENTS[event_id], **values)


def _with_sequence_count(packet: bytes, count: int) -> bytes:
    """Return the packet with an unsegmented sequence word, as cFE stamps it."""
    return packet[:2] + (ccsds.UNSEGMENTED << 14 | count).to_bytes(2, "big") + packet[4:]
