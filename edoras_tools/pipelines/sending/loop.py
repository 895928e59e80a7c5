"""The sending loop: sends every datagram at its deadline, keeps the session alive, receives answers.

Rules that it keeps:

1. A datagram leaves at its deadline, or as soon after it as the system allows. Deadlines count from the start
   of the pass, so one delay does not delay later datagrams.
2. Datagrams that are due at the same time leave together, at most ``_BLOCK``.
3. At least once per ``_ROUND_NS`` the loop receives, serves the session and checks keys and Ctrl-C, however
   much there is to send; when nothing is due it sleeps in the wire's ``wait``. Checks that would come
   shortly before a deadline, and delay it, come earlier.
4. A pause moves the start of the pass by its duration, so that nothing is sent in a burst afterwards.
5. Every error ends in ``SendReport.failure``; what was sent until then is counted.

There may be conditions to wait for before the first datagram leaves, with a message if they are not met.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np

from edoras_tools.cfs import sbn, telemetry_output
from edoras_tools.errors import CaptureError, EdorasError
from edoras_tools.io.net.sockets import ANY_ADDRESS, own_address
from edoras_tools.io.processes import Precedence
from edoras_tools.model import NO_MSG_ID, Endpoint, rate_hz
from edoras_tools.pipelines.reading import Keys, on_interrupt
from edoras_tools.pipelines.sending.options import SendOptions, called
from edoras_tools.sessions.outgoing import Changes, Outgoing
from edoras_tools.sessions.pacing import Lateness, Timetable
from edoras_tools.sessions.sbn import SbnConnection
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from edoras_tools.io.formats.watched import OutputLoss
    from edoras_tools.io.net.transmit import Wire
    from edoras_tools.links.protocol import SendingSession
    from edoras_tools.mission import Mission
    from edoras_tools.pipelines.sending.responses import Responses
    from edoras_tools.render.terminal.text import Watcher
    from edoras_tools.sessions.faults.machine import Delivery, FaultMachine
    from edoras_tools.sessions.faults.rules import Fault

_MOST_NAMED: Final = 4
_ONE_REPORT_NS: Final = 4300 * MILLISECOND
"""Time in which CI reports its count: SCH_LAB asks each 4 s in stock cFS, each second in the demos."""
_AFTER_ASKING_NS: Final = 8300 * MILLISECOND
"""Time for a second, equal report as well: then CI has read the commands that enable telemetry."""


class Condition(NamedTuple):
    """Something to wait for before the first datagram leaves.

    Attributes:
        name: for the user.
        met: returns whether it is met.
        ask: called about once a second until it is met.
        explain: returns the usual cause and what was tried; its argument is the time waited, s.
        patience_ns: time to wait before going on without it, ns; 0: it is required.
        hopeless: returns whether it can no longer be met.
    """

    name: str
    met: Callable[[], bool]
    explain: Callable[[float], str]
    ask: Callable[[], None] = lambda: None
    patience_ns: int = 0
    hopeless: Callable[[], bool] = lambda: False


def conditions(
    out: Outgoing,
    options: SendOptions,
    mission: Mission,
    *,
    responses: Responses,
    session: SbnConnection | SendingSession | None,
    wire: Wire,
    local: Endpoint,
) -> Iterator[Condition]:
    """Yield the conditions that the options name.

    Args:
        out: datagrams to send.
        options: options from ``placed``.
        mission: provides the topics of MsgIds.
        responses: responses received so far.
        session: the SBN session, if there is one.
        wire: sends the requests.
        local: endpoint where answers are received.
    """
    for item in options.wait_for:
        if item == "peer" and session is not None and options.to.sending:
            yield Condition(
                "peer", lambda: session.connected, lambda seconds: _silent(options, session, seconds)
            )
        elif item == "peer" and isinstance(session, SbnConnection):
            yield _peer(out, options, mission, responses, session=session, wire=wire, local=local)
        elif item == "to-enabled":
            yield _enabled(options, responses, wire, local)
        elif item.startswith("event:"):
            yield _event(item.removeprefix("event:"), responses, local)


def _silent(options: SendOptions, session: Any, seconds: float) -> str:
    if why := session.absence():
        return f"{why}, within {seconds:.1f} s"
    return (
        f"{options.target} did not answer as a receiver of {options.to.link.name} within {seconds:.1f} s; "
        "name it with --target"
    )


def _peer(
    out: Outgoing,
    options: SendOptions,
    mission: Mission,
    responses: Responses,
    *,
    session: SbnConnection,
    wire: Wire,
    local: Endpoint,
) -> Condition:
    msg_ids = set(np.unique(out.msg_id[out.msg_id != NO_MSG_ID]).tolist())

    own = session.own._asdict()
    refusals = [
        f"{event.app} {event.event_id}: {event.text.format(**own)}"
        for event in (sbn.UNKNOWN_PEER, sbn.UNKNOWN_PROCESSOR)
    ]
    crash = (
        ". Look whether cFS still runs: SBN's TCP module crashes it when a connection closes whose peer it "
        "does not know"
        if options.tcp
        else ""
    )

    def complaint() -> str | None:
        return next((text for text in refusals if text in responses.events), None)

    def unknown() -> bool:
        return session.answered is None and complaint() is not None

    def explain(seconds: float) -> str:
        if unknown():
            return (
                f"no SBN peer answered at {options.target} within {seconds:.1f} s: cFS says {complaint()!r}: "
                f"its SBN peer table has no such peer; set --as SC:CPU as in the table{crash}"
            )
        if session.answered is None:
            place = f" at UDP {local.port}: set --as SC:CPU and --listen PORT"
            if options.tcp:
                place = ": set --as SC:CPU"
            refusal = f"; {options.target} refuses: no program listens there"
            refused = refusal if wire.statistics.refused else ""
            return (
                f"no SBN peer answered at {options.target} within {seconds:.1f} s{refused}; tried PROTO and "
                f"SUB, once a second, as {session.own} from {local}; usually cFS is not running, or its SBN "
                f"peer table has no {session.own}{place} as in the table{crash}"
            )
        missing = sorted(msg_ids - session.subscribed)
        some = ", ".join(called(msg_id, mission) for msg_id in missing[:_MOST_NAMED])
        more = f" and {len(missing) - _MOST_NAMED} more" if len(missing) > _MOST_NAMED else ""
        return (
            f"SBN peer {session.answered} answered, but did not subscribe to {some}{more} within "
            f"{seconds:.1f} s; usually the application that receives it is not running; leave it out with "
            "--route, or send it anyway with --wait-for nothing"
        )

    return Condition(
        "peer", lambda: session.connected and msg_ids <= session.subscribed, explain, hopeless=unknown
    )


def _enabled(options: SendOptions, responses: Responses, wire: Wire, local: Endpoint) -> Condition:
    address = (
        own_address(options.target) if options.target and local.address == ANY_ADDRESS else local.address
    )

    def ask() -> None:
        wire.put(enable_output(address, options.headers))

    def explain(seconds: float) -> str:
        return (
            f"no telemetry came to {local} within {seconds:.1f} s; asked {options.target} once a second to "
            f"enable it towards {address}; usually cFS or its TO_LAB is not running, or it does not send to "
            f"port {local.port}"
        )

    return Condition("to-enabled", lambda: responses.telemetry > 0, explain, ask)


def count_known(out: Outgoing, options: SendOptions, responses: Responses, wire: Wire) -> Iterator[Condition]:
    """Yield the optional condition that CI's count is known, if CI can be followed.

    Args:
        out: datagrams to send; no condition for the command that enables telemetry alone.
        options: options from ``placed``.
        responses: responses received so far.
        wire: wire; it shows whether anything was sent before.
    """
    at_once = not options.follows_ci or "nothing" in options.wait_for or leaves_at_once(out, options)
    if not at_once and not only_enables(out, options.headers):
        yield Condition(
            "count",
            lambda: responses.ingest.is_known,
            lambda _: "",
            patience_ns=_AFTER_ASKING_NS if wire.statistics.sent else _ONE_REPORT_NS,
        )


def leaves_at_once(out: Outgoing, options: SendOptions) -> bool:
    """Return whether a single datagram is sent and its result is not judged: waiting is not worthwhile."""
    return len(out) == options.passes == 1 and not options.expect and options.max_loss is None


def only_enables(out: Outgoing, headers: cfe.Headers) -> bool:
    """Return whether only the command that enables telemetry is sent."""
    enable = headers.msg_ids.of_known(telemetry_output.COMMAND_MSG_ID)
    if len(out) != 1 or out.msg_id[0] != enable:
        return False
    return bool(headers.command.parse(out[0][headers.start :])["function_code"] == telemetry_output.ENABLE)


def _event(text: str, responses: Responses, local: Endpoint) -> Condition:
    def explain(seconds: float) -> str:
        count = len(responses.events)
        return (
            f"no event with {text!r} came to {local} within {seconds:.1f} s ({count} others did); usually "
            "telemetry is not enabled: put --wait-for to-enabled before it, or set a longer --timeout"
        )

    return Condition(f"event:{text}", lambda: responses.says(text), explain)


def enable_output(address: str, headers: cfe.Headers = cfe.STANDARD) -> bytes:
    """Return the command that makes Telemetry Output send to an IPv4 address, as the ground bridge does.

    Args:
        address: address as text.
        headers: headers of the receiving cFE.
    """
    return cfe.emit_command(
        headers.msg_ids.of_known(telemetry_output.COMMAND_MSG_ID),
        telemetry_output.ENABLE,
        address.encode().ljust(16, b"\0"),
        sequence_flags=0,
        with_checksum=False,
        headers=headers,
    )


_BLOCK: Final = 512
"""Maximum datagrams that leave together."""
_ROUND_NS: Final = 20 * MILLISECOND
"""Period of the checks, however busy the loop is; longest delay until Ctrl-C and keys are noticed."""
_CHECK_NS: Final = MILLISECOND // 2
"""Upper bound of the time that the checks take."""
_ABSENT_NS: Final = SECOND
"""A target that refuses within this time after the first datagram is absent."""
_SILENT_NS: Final = 9 * SECOND
"""Silence of CI after which no report is expected; it reports at least every 4 s."""
_LEAD_NS: Final = 2 * MILLISECOND
"""Time from the start to the first deadline, so that the first datagram is not late."""


class SendSchedule(msgspec.Struct, frozen=True):
    """The datagrams, their target and their times.

    Attributes:
        target: target as text for the user.
        out: datagrams in the order of the timetable.
        table: times of sending.
        changes: changes in each pass.
        passes: number of passes; 0: until it is stopped.
        paused: start in single steps.
        linger_ns: time to listen after the last datagram, ns.
        follow_ns: longest time to listen while CI's count shows that it has more to read; 0: no longer.
    """

    target: str
    out: Outgoing
    table: Timetable
    changes: Changes = msgspec.field(default_factory=Changes)
    passes: int = 1
    paused: bool = False
    linger_ns: int = 0
    follow_ns: int = 0


class SendReport(msgspec.Struct):
    """The result of sending.

    Attributes:
        sent: datagrams of the recording that left; at the end without the refused ones.
        total: datagrams to send; None if there is no end.
        send_errors: datagrams that could not be sent, or were refused.
        errors: the reasons, with counts.
        asked_hz: the requested rate; None for as fast as possible.
        first_ns: time when the first left, monotonic, ns.
        last_ns: time when the last left, monotonic, ns.
        lateness: delay of each datagram behind its deadline.
        responses: received messages.
        faults: injected faults by kind.
        interrupted: whether Ctrl-C or the q key ended it.
        signalled: whether it was Ctrl-C, SIGTERM or SIGHUP.
        failure: error that ended it early, if any.
        notes: for the user, one line each.
        losses: outputs of its recording that were removed during writing.
        to_ci: whether it went to Command Ingest, and answers could be received.
    """

    responses: Responses
    total: int | None
    asked_hz: float | None
    sent: int = 0
    send_errors: int = 0
    errors: dict[str, int] = msgspec.field(default_factory=dict)
    first_ns: int = 0
    last_ns: int = 0
    lateness: Lateness = msgspec.field(default_factory=Lateness)
    faults: dict[str, int] = msgspec.field(default_factory=dict)
    interrupted: bool = False
    signalled: bool = False
    failure: EdorasError | None = None
    notes: list[str] = msgspec.field(default_factory=list)
    losses: list[OutputLoss] = msgspec.field(default_factory=list)
    to_ci: bool = False

    @property
    def lost(self) -> int:
        """Datagrams and messages certainly lost: refused, never read by CI, or lost on the bus."""
        return self.send_errors + self.responses.ingest.missing * self.to_ci + self.responses.lost

    def beyond(self, most: float | None) -> list[str]:
        """Return the reasons why the run failed, one line each.

        Args:
            most: largest accepted share of lost datagrams; None: 0.
        """
        seconds = self.responses.expected.within_ns / SECOND
        reasons = [
            f"--expect {item.words}: not within {seconds:g} s after sending; {item.outcome}"
            for item in self.responses.expected.missing
        ]
        if most is None:
            return reasons
        ingest = self.responses.ingest
        if not (ingest.is_known and ingest.is_counted if self.to_ci else self.responses.counters is not None):
            reasons.append(
                "--max-loss: what was lost is not known: no counter came; see --wait-for to-enabled"
            )
        elif self.lost > most * self.sent:
            share = self.lost / self.sent if self.sent else 1.0
            reasons.append(
                f"--max-loss: {self.lost:,} of {self.sent:,} lost ({share:.2%}), allowed {most:.2%}"
            )
        return reasons

    @property
    def achieved_hz(self) -> float | None:
        """Datagrams per second between the first and the last."""
        return rate_hz(self.sent, self.last_ns - self.first_ns) or None

    def summary(self) -> dict[str, Any]:
        """Return the shape of ``replay --json``."""
        return {
            "sent": self.sent,
            "rate_asked_hz": _rounded(self.asked_hz),
            "rate_achieved_hz": _rounded(self.achieved_hz),
            "duration_s": round((self.last_ns - self.first_ns) / SECOND, 6),
            "lateness_us": self.lateness.summary(),
            "send_errors": self.send_errors,
            "errors": self.errors,
            "faults": self.faults,
            "ingest": self.responses.ingest.summary() if self.to_ci else None,
            "interrupted": self.interrupted,
            "failure": str(self.failure) if self.failure else None,
            "notes": [*self.notes, *map(str, self.losses)],
            "expected": self.responses.expected.as_json(),
            "seen": self.responses.summary(),
        }


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


class Sending:
    """One run.

    Args:
        wire: output and input of the datagrams.
        schedule: datagrams and their times.
        report: updated during the run.
        session: session that the datagrams belong to.
        faults: the faults to inject.
        note: called with each fault.
        keys: the keyboard.
        watcher: updated up to fifty times per second, so it must be cheap.
    """

    def __init__(
        self,
        wire: Wire,
        schedule: SendSchedule,
        report: SendReport,
        *,
        session: SbnConnection | SendingSession | None = None,
        faults: FaultMachine | None = None,
        note: Callable[[Sequence[Fault]], None] = lambda _: None,
        keys: Keys | None = None,
        watcher: Watcher[SendReport] | None = None,
    ) -> None:
        self.report = report
        self.stopped = False
        self._wire, self._schedule, self._table = wire, schedule, schedule.table
        self._session, self._faults, self._keys, self._watcher = session, faults, keys, watcher
        self._note = note
        self._precedence = Precedence()
        self._paused = schedule.paused
        self._steps = 0
        self._due = schedule.table.due_ns.data
        self._epoch_ns = wire.epoch_ns()
        self._round_ns = 0
        self._refused = self._sent_before = self._undelivered = 0

    def stop(self) -> None:
        """End as soon as possible."""
        self.stopped = True

    def run(self, wait_for: Iterable[Condition] = (), timeout_ns: int = 10 * SECOND) -> SendReport:
        """Wait for the conditions, send, listen for some time, end the session.

        Every error on the way is in ``SendReport.failure``.
        """
        report = self.report
        with on_interrupt(self.stop) as interrupt, self._keys or nullcontext(), self._precedence:
            try:
                self._wait_for(wait_for, timeout_ns)
                if not self.stopped:
                    report.responses.ingest.begin()
                    report.responses.expected.begin()
                    self._send_all()
                    self._listen()
            except CaptureError as error:
                report.failure = error
            except KeyboardInterrupt:  # the second Ctrl-C
                self.stopped = True
            report.interrupted = self.stopped and report.failure is None
            report.signalled = report.interrupted and interrupt.is_set()
            for data in self._session.goodbye() if self._session else ():
                self._wire.put(data)
        report.errors = dict(self._wire.statistics.errors)
        self._count_refusals()
        if self._undelivered:
            report.errors["Connection refused"] = self._undelivered
            report.sent = max(0, report.sent - self._undelivered)
        report.send_errors = sum(report.errors.values())
        return report

    def _wait_for(self, wait_for: Iterable[Condition], timeout_ns: int) -> None:
        began = self._wire.now()
        for condition in wait_for:
            since = ask_ns = self._wire.now()
            while not self.stopped:
                now = self._look_around()
                if condition.met() or now - since >= condition.patience_ns > 0:
                    break
                if condition.hopeless() or (now - began >= timeout_ns and not condition.patience_ns):
                    raise CaptureError(condition.explain((now - began) / SECOND))
                if now >= ask_ns:
                    condition.ask()
                    ask_ns = now + SECOND
                self._wire.wait(now + _ROUND_NS)

    def _send_all(self) -> None:
        out, changes, passes = self._schedule.out, self._schedule.changes, self._schedule.passes
        self._refused = self._wire.statistics.refused
        start = self._wire.now() + _LEAD_NS
        passes_sent = 0
        while not self.stopped and (not passes or passes_sent < passes):
            batch = out
            if changes.differ:
                batch = changes.each(
                    out, sent=passes_sent, start_ns=start + self._epoch_ns, due_ns=self._table.due_ns
                )
            start = self._one_pass(batch, start) + self._table.period_ns
            passes_sent += 1
        while not self.stopped and (held_ns := self._held_ns()) is not None:
            self._pass_time(held_ns)

    def _one_pass(self, out: Outgoing, start: int) -> int:
        """Send all datagrams once; return the begin of the pass, shifted by its pauses."""
        wire, due, count = self._wire, self._due, len(out)
        report, at = self.report, 0
        while at < count and not self.stopped:
            now = wire.now()
            if now >= self._round_ns:
                now = self._look_around()
            if self._paused:
                if not self._steps:
                    if not wire.wait(now + _ROUND_NS):
                        self._round_ns = 0
                    start = wire.now() - due[at]
                    continue
                self._steps -= 1
                start = now - due[at]
            target = start + due[at]
            if target > now:
                self._pass_time(target)
                if (now := wire.now()) < target:
                    continue
            last = at + 1
            if last < count and start + due[last] <= now and not self._paused:
                last = bisect_right(due, now - start, last, min(count, at + _BLOCK))
            if self._faults is None:
                report.sent += wire.send(out, at, last)
            else:
                self._spoil(out, at, last, now)
            report.last_ns = now
            report.first_ns = report.first_ns or now
            if self._table.period_ns:
                if last - at == 1:
                    report.lateness.add(now - target)
                else:
                    report.lateness.add_all(now - start - self._table.due_ns[at:last])
            at = last
        return start

    def _pass_time(self, until_ns: int) -> None:
        """Wait until a time, the next check, or an arrival."""
        held_ns = self._held_ns()
        if self._round_ns < until_ns and _CHECK_NS < until_ns - self._wire.now() < _ROUND_NS:
            self._look_around()
        if not self._wire.wait(min(until_ns, self._round_ns, until_ns if held_ns is None else held_ns)):
            self._round_ns = 0
        now = self._wire.now()
        if now >= self._round_ns:
            self._look_around()
        if self._faults and held_ns is not None and now >= held_ns:
            self._deliver(self._faults.due(now + self._epoch_ns), now)

    def _held_ns(self) -> int | None:
        """Return the time when a delayed datagram is due; faults use time since 1970."""
        held_ns = self._faults.next_ns if self._faults else None
        return None if held_ns is None else held_ns - self._epoch_ns

    def _look_around(self) -> int:
        """Handle what arrived, keep the session alive, handle keys; return the time."""
        self._precedence.look()
        now = self._wire.now()
        session, responses = self._session, self.report.responses
        responses.ingest.sent = self._wire.statistics.sent
        for item in self._wire.receive():
            responses.add(item.link, item.payload, now + self._epoch_ns)
            if session is not None and item.link == self._schedule.out.link:
                self._put(session.answer(item.payload, now=now))
        if session is not None:
            if now - self.report.last_ns < _ROUND_NS:
                session.sent(now=now)
            if now >= session.next_ns:
                self._put(session.due(now=now))
        self._refusals(now)
        for key in self._keys.pressed() if self._keys else "":
            self._act_on(key)
        if self._watcher is not None:
            self._watcher.update(self.report)
        self._round_ns = now + _ROUND_NS
        return now

    def _put(self, datagrams: Iterable[bytes]) -> None:
        for data in datagrams:
            self._wire.put(data)

    def _refusals(self, now: int) -> None:
        if not self.report.first_ns or not self._count_refusals():
            return
        if now - self.report.first_ns < _ABSENT_NS:
            self._undelivered = max(self._undelivered, self.report.sent)  # nobody received any of them
            raise CaptureError(
                f"{self._schedule.target} refuses: no program listens there (ICMP port unreachable); start "
                "the receiver, or name its address with --target"
            )

    def _count_refusals(self) -> bool:
        """Count datagrams that left since the last check as not delivered if the target refused one of them.

        ICMP refuses a datagram after it has left, and the kernel keeps only one of several refusals: the
        other datagrams were not received either. Some of them may be the session's own.
        """
        refused, sent = self._wire.statistics.refused - self._refused, self.report.sent - self._sent_before
        self._refused += refused
        self._sent_before += sent
        self._undelivered += max(refused, sent) if refused else 0
        return refused > 0

    def _act_on(self, key: str) -> None:
        if key == "q":
            self.stop()
        elif key == " ":
            self._paused = not self._paused
        elif key in "n\n":
            self._steps += self._paused

    def _listen(self) -> None:
        """Listen for the linger time, and longer while CI reads, or until expected results have come."""
        schedule, ingest = self._schedule, self.report.responses.ingest
        expected = self.report.responses.expected
        began = reported = self._wire.now()
        until, count = began + schedule.linger_ns, ingest.reports
        while not self.stopped:
            now = self._look_around()
            if ingest.reports != count:
                reported, count = now, ingest.reports
            follows = (
                now - began < schedule.follow_ns
                and now - reported < _SILENT_NS
                and bool(ingest.reports)
                and not ingest.is_final
            )
            follows = follows or bool(self._session and self._session.busy)
            follows = follows or (bool(expected.missing) and now - began < expected.within_ns)
            if now >= until and not follows:
                break
            self._wire.wait(now + _ROUND_NS if now >= until else min(now + _ROUND_NS, until))

    def _spoil(self, out: Outgoing, first: int, last: int, now: int) -> None:
        assert self._faults is not None
        to_cfs = not out.link.only_from_cfs
        for index in range(first, last):
            deliveries, faults = self._faults.apply(
                out[index], link=out.link, to_cfs=to_cfs, now=now + self._epoch_ns
            )
            for fault in faults:
                self.report.faults[fault.kind] = self.report.faults.get(fault.kind, 0) + 1
            if faults:
                self._note(faults)
            self._deliver(deliveries, now)

    def _deliver(self, deliveries: Iterable[Delivery], now: int) -> None:
        for item in deliveries:
            self.report.sent += self._wire.put(item.payload)
            self.report.last_ns = now


def in_order(out: Outgoing, table: Timetable) -> Outgoing:
    """Return the datagrams in the order of their timetable."""
    return out if np.array_equal(table.order, np.arange(len(table.order))) else out.take(table.order)
