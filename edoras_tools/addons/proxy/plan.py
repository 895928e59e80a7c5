"""The settings of a proxy, and its faults: decided for many datagrams at once; only those are copied.

A fault of a byte stream changes the time when received bytes may leave. Time is an argument. TCP delivers
every byte, in order, or ends. So a stream can be late, slow, stalled or cut; but no byte can be lost,
repeated or overtaken, and rules for that are refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.errors import ConfigError
from edoras_tools.io.net.buffer import SLOTS, SPARE, DatagramBuffer
from edoras_tools.io.net.sockets import arrives_at
from edoras_tools.sessions.faults.machine import HEAD_BYTES, Delivery, FaultMachine, FaultPlan
from edoras_tools.sessions.faults.rules import Fault, Rule, RuleScope, make_rule
from edoras_tools.units import SECOND
from edoras_tools.wire.cfe import STANDARD, Headers

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.mission import Mission
    from edoras_tools.model import Endpoint, Link
    from edoras_tools.pipelines.workbench import Settings

    Send = Callable[[NDArray[np.int64]], None]


class ProxyPlan(msgspec.Struct, frozen=True):
    """The settings of a relay.

    Attributes:
        link: the link of the datagrams.
        listen: address that clients send to; for TO the client is cFS.
        targets: each target gets every datagram.
        bind: address that the target sends to, if it does not answer to the sender's port (an SBN peer); then
            there is one client, the last that sent.
        client: receiver of the target's datagrams before any client has sent; needs ``bind``.
        faults: the faults to inject.
        idle_ns: time without traffic after which a client is removed, ns.
        clients: maximum number of clients.
        queue_bytes: maximum bytes that wait while a socket's buffer is full.
        headers: headers of the cFE, for faults that depend on them.

    Raises:
        ConfigError: there is no target, ``bind`` cannot be combined with the others, or it sends to itself.
    """

    link: Link
    listen: Endpoint
    targets: tuple[Endpoint, ...]
    bind: Endpoint | None = None
    client: Endpoint | None = None
    faults: FaultPlan = msgspec.field(default_factory=FaultPlan)
    idle_ns: int = 60_000_000_000
    clients: int = 256
    queue_bytes: int = 4 << 20
    headers: Headers = STANDARD

    def __post_init__(self) -> None:
        """Check the combination."""
        if not self.targets:
            raise ConfigError("--target is missing: name where the datagrams go, e.g. 127.0.0.1:1234")
        if self.bind and len(self.targets) > 1:
            raise ConfigError("--bind can only be used with one target: leave --to out")
        if self.client and not self.bind:
            raise ConfigError("--client needs --bind: otherwise no target can send before a client")
        for target in self.targets:
            _check_circle("--target", target, "--listen", self.listen)
            if self.bind:
                _check_circle("--target", target, "--bind", self.bind)
        if self.client:
            _check_circle("--client", self.client, "--listen", self.listen)

    @property
    def to_cfs(self) -> bool:
        """Whether the targets are cFS; for TO they are the ground."""
        return not self.link.only_from_cfs

    def summary(self) -> dict[str, Any]:
        """Return the plan's part of ``proxy --json``."""
        return {
            "link": self.link.label,
            "listen": str(self.listen),
            "targets": [str(target) for target in self.targets],
            "bind": str(self.bind) if self.bind else None,
            "seed": self.faults.seed,
            "faults": [
                {"rule": rule.text, "kind": rule.kind.name, "on": rule.enabled, "struck": 0}
                for rule in self.faults.rules
            ],
        }


def _check_circle(sent: str, to: Endpoint, heard: str, at: Endpoint) -> None:
    if arrives_at(to, at):
        raise ConfigError(
            f"{sent} {to} is {heard} {at} itself: datagrams would be sent in a loop; change one of the ports"
        )


def limit_rule(text: str, mission: Mission) -> Rule:
    """Read a rate limit: ``30``, ``/cmd_vel=30``, ``0x1827=30,latest``, ``all=100``.

    Raises:
        ConfigError: it is not a rate limit.
        RouteError: the topic is not configured.
    """
    route, equals, rest = text.rpartition("=")
    rate, _, keep = rest.partition(",")
    words: list[tuple[str, str | None]] = [("", rate)]
    if keep:
        words.append(("keep", keep))
    if route == "all":
        words.append(("per", "link"))
    elif equals:
        words.append(("msg_id", route if route[:2].lower() == "0x" else hex(mission.find(route).msg_id)))
    written = ",".join([f"rate:{rate}", *(f"{name}={value}" for name, value in words[1:])])
    rule, mistakes = make_rule("rate", words, written)
    if rule is None:
        advice = "write 30, /cmd_vel=30,latest or all=100"
        raise ConfigError(*(f"--max-rate {text}: {problem}; {advice}" for _, problem in mistakes))
    return rule


def as_relayed(settings: Settings, link: Link, target: Endpoint) -> Settings:
    """Return settings that assign the target's port to a link, whatever port it is."""
    options = settings.options
    return replace(settings, options=replace(options, ports=(*options.ports, (link, target.port))))


_FEW: Final = 4
"""Up to this many datagrams are decided one by one, which is faster."""


class Outbox:
    """Gathers slots to send, in order; datagrams made on the way go into spare slots.

    Args:
        buffer: the slots.
        send: sends the gathered slots.
    """

    def __init__(self, buffer: DatagramBuffer, send: Send) -> None:
        self._buffer, self._send = buffer, send
        self._slots: list[int] = []
        self._spare = SLOTS

    def add(self, slots: Iterable[int]) -> None:
        """Add slots."""
        self._slots.extend(slots)

    def put(self, payload: bytes) -> None:
        """Add a datagram."""
        if self._spare == SLOTS + SPARE:
            self.flush()
        self._buffer.put(self._spare, payload)
        self._slots.append(self._spare)
        self._spare += 1

    def flush(self) -> None:
        """Send the gathered slots."""
        if self._slots:
            self._send(np.array(self._slots, np.int64))
        self._slots.clear()
        self._spare = SLOTS


class FaultStage:
    """Applies a fault machine to datagrams in a buffer.

    Args:
        machine: decides the faults.
        buffer: the slots.
        link: the link of all datagrams.
        note: called with the faults that were applied.
    """

    def __init__(
        self, machine: FaultMachine, buffer: DatagramBuffer, link: Link, note: Callable[[list[Fault]], None]
    ) -> None:
        self.machine = machine
        self._buffer, self._link, self._note = buffer, link, note

    def apply(self, slots: NDArray[np.int64], *, to_cfs: bool, now: int, stream: int, send: Send) -> None:
        """Send the datagrams in some slots after applying faults.

        Args:
            slots: indices of the slots.
            to_cfs: the direction of the datagrams.
            now: ns since 1970.
            stream: number of the client.
            send: sends slots; called a few times at most.
        """
        machine, buffer, link = self.machine, self._buffer, self._link
        outbox = Outbox(buffer, send)
        selection = slots.tolist()
        if len(selection) <= _FEW:
            for slot in selection:
                payload = buffer.payload(slot)
                result = machine.apply(payload, link=link, to_cfs=to_cfs, now=now, stream=stream)
                self._take(outbox, slot, payload, result)
            outbox.flush()
            return
        verdicts = machine.decide(
            buffer.slots[slots, :HEAD_BYTES],
            buffer.length[slots],
            lambda index: buffer.payload(selection[index]),
            link=link,
            to_cfs=to_cfs,
            now=now,
            stream=stream,
        )
        if verdicts is None:
            send(slots)
            return
        after = 0
        for index in np.flatnonzero(verdicts.any(axis=0)).tolist():
            outbox.add(selection[after:index])
            after = index + 1
            payload = buffer.payload(selection[index])
            result = machine.strike(
                payload, verdicts[:, index], index, link=link, to_cfs=to_cfs, now=now, stream=stream
            )
            self._take(outbox, selection[index], payload, result)
        outbox.add(selection[after:])
        outbox.flush()

    def _take(
        self, outbox: Outbox, slot: int, payload: bytes, result: tuple[list[Delivery], list[Fault]]
    ) -> None:
        deliveries, faults = result
        for delivery in deliveries:
            if delivery.payload is payload:
                outbox.add((slot,))
            else:
                outbox.put(delivery.payload)
        if faults:
            self._note(faults)


STREAM_KINDS: Final = ("delay", "bandwidth", "silence")
"""The kinds of faults that a stream can have; ``silence`` stalls it."""


class StreamFaults:
    """Determines when the bytes of one direction of a connection leave.

    Args:
        rules: faults; those of the other direction are ignored.
        to_cfs: the direction.

    Attributes:
        struck: number of times that each rule made bytes wait.

    Raises:
        ConfigError: a rule is of a kind that streams cannot have, or selects messages.
    """

    def __init__(self, rules: Sequence[Rule], *, to_cfs: bool) -> None:
        for rule in rules:
            _check(rule)
        self._rules = {
            place: rule
            for place, rule in enumerate(rules)
            if rule.enabled and rule.scope.to_cfs in {None, to_cfs}
        }
        self.struck = [0] * len(rules)
        self._free: dict[int, int] = {}
        self._last = 0

    def leave(self, now: int, size: int) -> int:
        """Return when bytes that came at ``now`` may leave, ns; never before earlier bytes.

        Args:
            now: ns since the start of the relay.
            size: number of bytes.
        """
        at = max(now, self._last)
        for place, rule in self._rules.items():
            if not rule.schedule.active(now):
                continue
            before = at
            kind = rule.kind.name
            if kind == "delay":
                at = max(at, now + int(rule.values["time"]))
            elif kind == "silence":
                at = max(at, self._stalled_until(rule, now))
            else:
                begin = max(now, self._free.get(place, 0))
                self._free[place] = begin + round(8 * size * SECOND / float(rule.values["rate"]))
                at = max(at, self._free[place])
            self.struck[place] += at > before
        self._last = at
        return at

    @staticmethod
    def _stalled_until(rule: Rule, now: int) -> int:
        """Return the end of the stall at ``now``, else ``now``; stalls begin with the rule's time."""
        since = now - rule.schedule.from_ns
        if rule.schedule.period_ns:
            since %= rule.schedule.period_ns
        return max(now, now - since + int(rule.values["time"]))


def _check(rule: Rule) -> None:
    """Refuse a rule that a stream cannot have.

    Raises:
        ConfigError: it is such a rule.
    """
    kinds = ", ".join(STREAM_KINDS)
    if rule.kind.name not in STREAM_KINDS:
        raise ConfigError(
            f"--fault {rule}: a TCP stream cannot have this fault: its bytes arrive all, once and in order, "
            f"or it ends; there are {kinds} and --cut"
        )
    if RuleScope(to_cfs=rule.scope.to_cfs) != rule.scope:
        raise ConfigError(f"--fault {rule}: a TCP stream is relayed as bytes; only to= can choose")
    if rule.schedule.every or rule.schedule.probability < 1:
        raise ConfigError(f"--fault {rule}: a TCP stream has no datagrams to choose; use from= and until=")
