"""The common part of replay and inject: opens sockets, starts a session, and sends.

Sent and received datagrams are recorded. Rules:

1. A datagram is in the file ``FLUSH_NS`` after it was sent or received, however busy the sending is: a killed
   run loses at most one second. ``receive`` ensures this; the sending loop calls it every 20 ms.
2. From half of that time on, waiting datagrams are written as soon as nothing is due for ``_CALM_NS``: then
   writing delays no datagram.
3. The time of a received datagram is when it was read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from itertools import chain
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.errors import CaptureError
from edoras_tools.io.frames.frame_batch import frames_of
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.io.net import transmit
from edoras_tools.links.table import carrying, protocol
from edoras_tools.model import NO_MSG_ID, Endpoint, Link, SourceInfo, SourceStatistics
from edoras_tools.pipelines.capture.record import FLUSH_NS, Target, open_sink
from edoras_tools.pipelines.recorder import PushedSource
from edoras_tools.pipelines.sending import loop
from edoras_tools.pipelines.sending.options import Receiver, Role, SendOptions, check_allowed
from edoras_tools.pipelines.sending.responses import AwaitedResults, Responses
from edoras_tools.sessions.sbn import CLIENT, PUBLIC_BRIDGE, TCP_CLIENT, SbnConnection
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from edoras_tools.io.formats.watched import OutputLoss
    from edoras_tools.io.net.transmit import Arrival
    from edoras_tools.links.protocol import SendingSession
    from edoras_tools.mission import Mission
    from edoras_tools.pipelines.reading import Keys
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.terminal.text import Watcher
    from edoras_tools.sessions.faults.machine import FaultMachine
    from edoras_tools.sessions.faults.rules import Fault
    from edoras_tools.sessions.outgoing import Changes, Outgoing
    from edoras_tools.sessions.pacing import Timetable
    from edoras_tools.wire.ccsds import MsgIds

_CALM_NS: Final = 10 * MILLISECOND
"""Quiet time in which a block is written; the sending loop never waits longer than 20 ms."""
_BLOCK: Final = 256
"""Datagrams written at once, which takes a few ms."""
_MOST: Final = 200_000
"""Waiting datagrams from which all are written at once, even if this delays others."""


class SentRecording:
    """A wire that records its traffic.

    Args:
        wire: the wire.
        target: output of the recording.
        bench: mission, types and decoders.

    Raises:
        CaptureError: the recording cannot be written.
    """

    def __init__(self, wire: transmit.Wire, target: Target, bench: Workbench) -> None:
        self.now, self.ends, self.statistics = wire.now, wire.ends, wire.statistics
        self._wire, self._bench = wire, bench
        self._source = PushedSource(SourceInfo(f"sent to {wire.ends[1]}", "replay"), SourceStatistics())
        self._sink = open_sink(target, self._source, bench)
        self._demux = Demux()
        self._waiting: list[tuple[int, Endpoint, Endpoint, bytes]] = []
        self._faults: list[Fault] = []
        self._epoch_ns = wire.epoch_ns()
        self._written_ns = wire.now()

    @property
    def losses(self) -> Sequence[OutputLoss]:
        """Outputs that were removed during writing."""
        return self._sink.losses

    def epoch_ns(self) -> int:
        """Return the difference between ns since 1970 and the wire's time."""
        return self._epoch_ns

    def wait(self, until_ns: int) -> bool:
        """Wait, and use the time for writing if it is long enough."""
        while until_ns - (now := self.now()) >= _CALM_NS and now - self._written_ns >= FLUSH_NS // 2:
            self._write(_BLOCK)
        return self._wire.wait(until_ns)

    def send(self, out: Outgoing, first: int, last: int) -> int:
        """Send datagrams ``first`` up to ``last``, not included; return the number that left."""
        now = self.now()
        sent = self._wire.send(out, first, last)
        for index in range(first, last):
            self._keep(now, *self.ends, out[index])
        return sent

    def put(self, payload: bytes) -> bool:
        """Send one datagram of the caller's own; return whether it left."""
        self._keep(self.now(), *self.ends, payload)
        return self._wire.put(payload)

    def receive(self) -> list[Arrival]:
        """Return the arrived datagrams, and write those that have waited long enough."""
        arrived = self._wire.receive()
        now = self.now()
        for item in arrived:
            self._keep(now, item.source, item.destination, item.payload)
        if now - self._written_ns >= FLUSH_NS:
            self._write(_MOST)
        return arrived

    def note(self, faults: Sequence[Fault]) -> None:
        """Record injected faults."""
        self._faults += faults

    def close(self) -> None:
        """Write the rest, and complete the recording.

        Raises:
            CaptureError: the recording cannot be written.
        """
        try:
            while self._waiting or self._faults:
                self._write(_MOST)
        finally:
            self._sink.close(self._source.statistics)

    def _keep(self, now: int, source: Endpoint, destination: Endpoint, payload: bytes) -> None:
        self._waiting.append((now + self._epoch_ns, source, destination, payload))
        if len(self._waiting) >= _MOST:
            self._write(_MOST)

    def _write(self, most: int) -> None:
        rows, self._waiting = self._waiting[:most], self._waiting[most:]
        if rows:
            frames = frames_of(rows, self._source.statistics.frames + 1)
            batch = self._demux.demux(frames)
            self._sink.write(batch, self._bench.columns.decode(batch))
            self._source.statistics.frames += len(frames)
            self._source.statistics.datagrams += len(batch)
        if self._faults:
            self._sink.write_faults(self._faults)
        self._faults = []
        self._sink.flush()
        if not self._waiting:
            self._written_ns = self.now()


class Loaded(msgspec.Struct, frozen=True):
    """The datagrams to send, and notes from reading.

    Attributes:
        out: the datagrams, in the order of the recording.
        subscriptions: MsgIds that the recording's own SBN peer subscribed to.
        notes: for the user, one line each.
    """

    out: Outgoing
    subscriptions: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()

    def numbered(self, old: MsgIds, new: MsgIds) -> Loaded:
        """Return it with the subscriptions translated to the MsgIds of another version."""
        return replace(
            self, subscriptions=tuple(sorted(new.of_known(old.standard(item)) for item in self.subscriptions))
        )


class Transmission(NamedTuple):
    """Everything that a run needs, prepared before the first datagram leaves.

    Attributes:
        out: datagrams, in order.
        table: times of sending.
        options: with defaults filled in, and checked.
        mission: provides names for what is sent and received.
        changes: changes in each pass.
        subscriptions: MsgIds that an SBN session subscribes to.
        notes: for the user, one line each.
    """

    out: Outgoing
    table: Timetable
    options: SendOptions
    mission: Mission
    changes: Changes
    subscriptions: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, loaded: Loaded, options: SendOptions, mission: Mission, changes: Changes) -> Transmission:
        """Prepare a run.

        Args:
            loaded: datagrams as recorded.
            options: with defaults filled in.
            mission: see the class.
            changes: see the class.

        Raises:
            ConfigError: rates contradict each other, or something is not allowed.
            RouteError: no datagram matches the pattern of a rate.
        """
        subscribed = {route.msg_id for route in mission.routes if route.link.peers and not route.to_cfs}
        out = loaded.out
        table = options.pacing(out, mission).timetable(out.time_ns, out.msg_id)
        ready = changes.once(loop.in_order(out, table))
        check_allowed(ready, options.allow, mission)
        builds = ready.headers[(ready.msg_id != NO_MSG_ID) & ready.command]
        for headers in (cfe.WITH_EXTENDED, cfe.WITH_EXTENDED_2):
            if (builds == cfe.HEADERS.index(headers)).any():
                options = replace(options, headers=headers)
        subscriptions = tuple(sorted(subscribed)) or loaded.subscriptions
        return cls(ready, table, options, mission, changes, subscriptions, loaded.notes)

    @property
    def total(self) -> int | None:
        """Datagrams to send; None for no end."""
        return len(self.out) * self.options.passes if self.options.passes else None

    def plan(self) -> dict[str, Any]:
        """Return the plan in the shape of ``--dry-run --json``."""
        options, rate = self.options, self.table.rate_hz
        is_sbn = options.to is Receiver.SBN
        msg_ids, counts = np.unique(self.out.msg_id, return_counts=True)
        topics = {route.msg_id: route.topic for route in reversed(self.mission.routes)}
        return {
            "dry_run": True,
            "to": options.to.value,
            "target": str(options.target),
            "listen": str(options.listen) if options.listen else None,
            "sender": str(options.identity(self.mission)) if is_sbn and options.has_session else None,
            "wait_for": list(options.wait_for),
            "datagrams": self.total,
            "passes": options.passes or None,
            "rate_asked_hz": None if rate is None else round(rate, 3),
            "duration_s": round(int(self.table.due_ns[-1]) / SECOND, 6) if len(self.out) else 0.0,
            "routes": [
                {
                    "msg_id": None if item == NO_MSG_ID else f"0x{item:04x}",
                    "topic": topics.get(item),
                    "count": count,
                }
                for item, count in zip(msg_ids.tolist(), counts.tolist(), strict=True)
            ],
            "notes": list(self.notes),
        }

    def run(
        self,
        *,
        faults: FaultMachine | None = None,
        keys: Keys | None = None,
        watcher: Watcher[loop.SendReport] | None = None,
        recording: Callable[[transmit.Wire], SentRecording] | None = None,
        expected: AwaitedResults | None = None,
        ready: Callable[[Endpoint], None] = lambda _: None,
        wire: transmit.Wire | None = None,
    ) -> loop.SendReport:
        """Open the sockets and send.

        Args:
            faults: the faults to inject.
            keys: the keyboard.
            watcher: updated while it runs.
            recording: makes a recording of the wire.
            expected: expected results.
            ready: called with the endpoint that receives answers, once the sockets are open.
            wire: in place of sockets; its first end receives the answers.

        Raises:
            CaptureError: a socket or the recording cannot be opened; later errors are in
                ``SendReport.failure``.
        """
        options = self.options
        assert options.target is not None
        report = loop.SendReport(
            Responses(self.mission, expected),
            self.total,
            self.table.rate_hz,
            notes=list(self.notes),
            to_ci=options.follows_ci,
        )
        with ExitStack() as stack:
            if wire is None:
                wire, local = open_wire(options, stack, keys)
            else:
                local = wire.ends[0]
            recorded = recording(wire) if recording else None
            wire = recorded or wire
            session = self._session(wire.now())
            sending = loop.Sending(
                wire,
                self._schedule(),
                report,
                session=session,
                faults=faults,
                note=recorded.note if recorded else lambda _: None,
                keys=keys,
                watcher=watcher,
            )
            ready(local)
            stack.enter_context(transmit.precise_timing())
            wait_for = loop.conditions(
                self.out,
                options,
                self.mission,
                responses=report.responses,
                session=session,
                wire=wire,
                local=local,
            )
            wait_for = chain(wait_for, loop.count_known(self.out, options, report.responses, wire))
            sending.run(wait_for, options.timeout_ns)
        if options.to.sending and options.to.sending.session:
            report.notes += options.to.sending.session.notes()
        if report.to_ci and report.failure is None:
            report.notes += self._unanswered(report.responses, local)
        if recorded is not None:
            try:
                recorded.close()
            except CaptureError as error:
                report.failure = report.failure or error
            report.losses = list(recorded.losses)
        return report

    def _unanswered(self, responses: Responses, local: Endpoint) -> Iterator[str]:
        """Yield reasons why nothing shows whether cFS read the datagrams sent to CI."""
        if not responses.telemetry:
            advice = "usually Telemetry Output is not enabled: edoras inject to-enable"
            if loop.only_enables(self.out, self.options.headers):
                advice = "Telemetry Output may answer later: listen longer with --linger 10s"
            yield (
                f"no telemetry came to {local}, so nothing can answer, and nothing shows whether cFS read "
                f"what was sent; {advice}"
            )
        elif responses.ingest.summary()["state"] == "unknown" and loop.leaves_at_once(self.out, self.options):
            yield (
                "whether Command Ingest read it is not known; --max-loss 0 waits for its count "
                "before and after"
            )

    def _schedule(self) -> loop.SendSchedule:
        options = self.options
        return loop.SendSchedule(
            str(options.target),
            self.out,
            self.table,
            self.changes,
            options.passes,
            options.step,
            options.linger_ns or 0,
            options.follow_ns,
        )

    def _session(self, now: int) -> SbnConnection | SendingSession | None:
        if self.options.to.sending:
            return self.options.to.sending.session
        if not self.options.has_session:
            return None
        habits = PUBLIC_BRIDGE if self.options.role is Role.BRIDGE else CLIENT
        if self.options.tcp:
            habits = TCP_CLIENT
        return SbnConnection(self.options.identity(self.mission), self.subscriptions, habits=habits, now=now)


def open_wire(
    options: SendOptions, stack: ExitStack, keys: Keys | None = None
) -> tuple[transmit.Wire, Endpoint]:
    """Open the sockets; return them as a wire, with the address that receives answers.

    Args:
        options: from ``placed``.
        stack: closes the sockets.
        keys: end a wait.

    Raises:
        CaptureError: a socket cannot be opened.
    """
    transmitter = _transmitter(options)
    stack.enter_context(transmitter)
    listeners: list[tuple[Link, transmit.Listener]] = []
    if options.listen is not None and not (options.to is Receiver.SBN or options.to.sending):
        listener = stack.enter_context(transmit.Listener(options.listen))
        listeners.append((carrying("ground", to_cfs=options.to is not Receiver.CI), listener))
    local = listeners[0][1].local if listeners else transmitter.local
    if options.events is not None:
        with suppress(CaptureError):  # a bridge that has the port gets the events
            listener = stack.enter_context(transmit.Listener(options.events))
            listeners.append((carrying("ground", to_cfs=False), listener))
    return transmit.UdpWire(transmitter, options.to.link, listeners, [keys.fileno()] if keys else ()), local


def _transmitter(options: SendOptions) -> Any:
    """Open the socket to send from, a ``Transmitter`` or an object with the same methods.

    Raises:
        CaptureError: the target cannot be reached.
    """
    assert options.target is not None
    sending = options.to.sending
    if sending and sending.own_transport:
        return sending.transmitter(options.target)
    framing = sending.framing if sending else protocol(options.to.link).framing if options.tcp else None
    if framing is not None:
        return transmit.StreamTransmitter(options.target, framing)
    answered = options.to is Receiver.SBN or sending is not None
    return transmit.Transmitter(options.target, options.listen if answered else None)
