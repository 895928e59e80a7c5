"""Raises a rate or a size until messages are lost: finds a route's limit, its hop, and its cause.

The diagnosis shows cFS's losses, with place and cause. A sweep adds what only it knows: how many messages it
sent or requested, and which came back altered.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec.structs import replace

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.addons.lab.emulator.apps import generator
from edoras_tools.addons.lab.emulator.cfs import routes_of
from edoras_tools.addons.lab.emulator.simulation import SimulatedWire
from edoras_tools.addons.lab.sweep import plan as packets
from edoras_tools.addons.lab.sweep.plan import COMMAND_NS, Line, Mark, Observer, SweepPlan, reset_filters
from edoras_tools.cfs import command_ingest, software_bus
from edoras_tools.cfs.edoras_app import BRIDGE_BUFFER, BRIDGE_LENGTH_MODULUS, FLIGHT_BRIDGE_BUFFER
from edoras_tools.cfs.profile import TO_TABLE, SbnPeerConfig, SimProfile
from edoras_tools.cfs.queues import application_pipe
from edoras_tools.diagnosis.accounting.losses import CI_SOCKETS
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.errors import CaptureError, EdorasError
from edoras_tools.io.net.transmit import Wire, precise_timing
from edoras_tools.links.bare import TO
from edoras_tools.links.table import carrying
from edoras_tools.pipelines.reading import on_interrupt
from edoras_tools.pipelines.sending.loop import Condition, conditions
from edoras_tools.pipelines.sending.options import called
from edoras_tools.pipelines.sending.run import open_wire
from edoras_tools.sessions.outgoing import Outgoing, Packet
from edoras_tools.sessions.sbn import SbnConnection
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe, sbn

if TYPE_CHECKING:
    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.mission import Mission, Route
    from edoras_tools.model import Endpoint
    from edoras_tools.pipelines.workbench import Workbench

_PREDICTED: Final = frozenset({"ci_cut", "ground_bridge_buffer", "flight_bridge_length"})
"""Rules about the size of a message only: no loss for a sweep, because it sees which messages get through."""
_GAPS_ONLY: Final = frozenset({"lost_after_cfs", "unexplained_gap"})


class StepOutcome(msgspec.Struct, frozen=True):
    """The fates of the messages of a step.

    Attributes:
        sent: messages to cFS, or published by it.
        delivered: messages that got through.
        lost: messages that did not.
        bus: messages lost by the software bus.
        gaps: messages missing by their sequence counts.
        not_ingested: messages dropped because Command Ingest's socket was full.
        altered: messages that came back with other bytes or another length.
        unseen: messages requested and never published, or lost without any trace.
        hop: place of most losses; empty if none was lost.
        reason: cause of most losses.
        others: verdicts about other messages, or about losses that are not measured here.
    """

    sent: int
    delivered: int
    lost: int
    bus: int = 0
    gaps: int = 0
    not_ingested: int = 0
    altered: int = 0
    unseen: int = 0
    hop: str = ""
    reason: str = ""
    others: tuple[Verdict, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return the evidence in the shape of ``sweep --json``."""
        return {
            "software_bus": self.bus,
            "sequence_gaps": self.gaps,
            "not_ingested": self.not_ingested,
            "altered": self.altered,
            "without_trace": self.unseen,
        }


class Judge:
    """Judges the steps of one route.

    Args:
        profile: constants of the cFS at the other end.
        measures: whether the limit of an application's pipe is measured, not taken from the profile.
    """

    def __init__(self, route: Route, profile: SimProfile, *, measures: bool) -> None:
        self._route, self._profile, self._measures = route, profile, measures

    def commands(
        self, observer: Observer, before: Mark, after: Mark, *, sent: int, rate_hz: float
    ) -> StepOutcome:
        """Judge messages to cFS.

        Args:
            before: counts at the start of the step.
            after: counts when no message of the step was in transit any more.
            sent: number of messages of the route.
            rate_hz: messages of the route per second.
        """
        diagnosis = observer.diagnose(self._profile)
        ours, others = self._divided(diagnosis)
        main = _main(ours)
        by_cfs = min(sent, sum(verdict.lost or 0 for verdict in ours))
        if main is not None and main.rule == "app_pipe_limit" and self._measures:
            pipe = application_pipe(self._profile, over_network=self._route.link.peers)
            limit = max(1, round((sent - by_cfs) / max(1, sent) * rate_hz * pipe.round_ns / SECOND))
            measured = replace(self._profile, app_msg_limit=limit)
            main = _main(self._divided(observer.diagnose(measured))[0]) or main
        not_ingested = sum(verdict.lost or 0 for verdict in ours if verdict.hop in CI_SOCKETS)
        altered = (after.arrived - before.arrived) - (after.whole - before.whole)
        lost = min(sent, by_cfs + altered)
        hop, reason = _cause(main)
        if main is None and altered:
            hop, reason = command_ingest.NAME, f"the echo differs from byte {after.differs_at} on"
            cut = next((item for item in diagnosis.verdicts if item.rule == "ci_cut"), None)
            if cut and after.differs_at == self._profile.ci_buffer:
                hop, reason = _cause(cut)
        return StepOutcome(
            sent,
            sent - lost,
            lost,
            bus=by_cfs - not_ingested,
            not_ingested=not_ingested,
            altered=altered,
            hop=hop,
            reason=reason,
            others=others,
        )

    def telemetry(
        self, observer: Observer, before: Mark, after: Mark, *, least: int = 0, requested: int = 0
    ) -> StepOutcome:
        """Judge messages from cFS.

        Args:
            before: counts at the start of the step.
            after: counts when no message of the step was in transit any more.
            least: messages that must have been published in that time.
            requested: requested messages; 0 if others publish them and the step does not wait for the last
                ones: then only gaps count, because counters come later.
        """
        diagnosis = observer.diagnose(self._profile)
        ours, others = self._divided(diagnosis)
        main = _main(ours)
        delivered = after.whole - before.whole
        altered = after.arrived - before.arrived - delivered
        gaps = sum(
            row["gaps"]
            for row in diagnosis.routes
            if (row["link"], row["msg_id"]) == (self._route.link.label, f"0x{self._route.msg_id:04x}")
        )
        lost = (sum(verdict.lost or 0 for verdict in ours) if requested else gaps) + altered
        unseen = requested - delivered - lost if delivered + lost < least else 0
        hop = reason = ""
        if main is not None and lost:
            hop, reason = _cause(main)
        elif altered:
            hop, reason = "network", f"{altered:,} arrived with another length than they were published with"
        elif lost or unseen:
            hop, reason = self._event(diagnosis) or (
                "unknown",
                f"{lost + unseen:,} of 0x{self._route.msg_id:04x} never came, and cFS reported no reason",
            )
            if not delivered and self._route.link is TO and diagnosis.case is not None:
                add = diagnosis.case.add_line(self._route.msg_id)
                reason += f"; if Telemetry Output is not to send it yet: {add}"
        return StepOutcome(
            delivered + lost + unseen,
            delivered,
            lost + unseen,
            bus=sum(verdict.lost or 0 for verdict in ours if verdict.rule not in _GAPS_ONLY),
            gaps=gaps,
            altered=altered,
            unseen=unseen,
            hop=hop,
            reason=reason,
            others=others,
        )

    def _divided(self, diagnosis: Diagnosis) -> tuple[list[Verdict], tuple[Verdict, ...]]:
        """Return the verdicts on losses of the route, and those on all other losses."""
        errors = [item for item in diagnosis.verdicts if item.severity is Severity.ERROR and item.lost]
        ours = [
            item
            for item in errors
            if (item.msg_id, item.rule in _PREDICTED) == (self._route.msg_id, False)
            and (item.link or self._route.link.label) == self._route.link.label
        ]
        others = [item for item in errors if item not in ours and item.msg_id is not None]
        if not ours and not others:
            # No other messages were sent that could be lost.
            ours = [item for item in errors if item.rule == "unattributed_loss"]
        return ours, tuple(others)

    def _event(self, diagnosis: Diagnosis) -> tuple[str, str] | None:
        """Return the hop and the reason from an event of cFS about the route, if any."""
        assert diagnosis.case is not None
        for reported, loss in diagnosis.case.reported_losses.items():
            if reported.msg_id == self._route.msg_id:
                return reported.pipe or "software bus", f"cFS said: {loss.records[0]}"
        return None


def _main(verdicts: Iterable[Verdict]) -> Verdict | None:
    return max(verdicts, key=lambda item: item.lost or 0, default=None)


def _cause(verdict: Verdict | None) -> tuple[str, str]:
    """Return the place and the cause of a loss, from a verdict on it; empty without one."""
    return (verdict.hop or "", verdict.reason) if verdict else ("", "")


class SweepStep(msgspec.Struct, frozen=True):
    """One step, at one rate and one size.

    Attributes:
        rate_hz: messages per second.
        size: bytes of their space packets.
        outcome: fates of the messages.
    """

    rate_hz: float
    size: int
    outcome: StepOutcome

    @property
    def lost(self) -> int:
        """Number of lost messages."""
        return self.outcome.lost

    def as_json(self) -> dict[str, Any]:
        """Return the step in the shape of ``sweep --json``."""
        return {
            "rate_hz": self.rate_hz,
            "size": self.size,
            "sent": self.outcome.sent,
            "delivered": self.outcome.delivered,
            "lost": self.outcome.lost,
            "hop": self.outcome.hop or None,
            "evidence": self.outcome.as_json(),
        }


class Sweep(msgspec.Struct):
    """The result of a sweep.

    Attributes:
        plan: the plan of the sweep.
        steps: steps in the order in which they ran.
        watched: whether it published nothing and only measured.
        interrupted: whether Ctrl-C ended it.
        failure: error that ended it early, if any.
        notes: for the user, one line each.
    """

    plan: SweepPlan
    steps: list[SweepStep] = msgspec.field(default_factory=list)
    watched: bool = False
    interrupted: bool = False
    failure: EdorasError | None = None
    notes: list[str] = msgspec.field(default_factory=list)

    def value(self, step: SweepStep) -> float:
        """Return a step's rate or size, whichever is swept."""
        return step.size if self.plan.by_size else step.rate_hz

    @property
    def bad(self) -> SweepStep | None:
        """The lowest step that lost something."""
        return min((step for step in self.steps if step.lost), key=self.value, default=None)

    @property
    def good(self) -> SweepStep | None:
        """The highest step below the first loss that lost nothing; None if no step lost anything."""
        bad = self.bad
        if bad is None:
            return None
        below = (step for step in self.steps if not step.lost and self.value(step) < self.value(bad))
        return max(below, key=self.value, default=None)

    @property
    def telling(self) -> SweepStep | None:
        """The step whose hop and reason are reported: the lowest that lost something.

        If the sweep only watched, that step may have started or ended in the middle; then the fastest.
        """
        lossy = [step for step in self.steps if step.lost]
        return max(lossy, key=self.value) if self.watched and lossy else self.bad

    def note(self, text: str) -> None:
        """Add a note, if it is new."""
        if text not in self.notes:
            self.notes.append(text)

    def summary(self) -> dict[str, Any]:
        """Return the shape of ``sweep --json``."""
        route, by_size = self.plan.route, self.plan.by_size
        good, bad, telling = self.good, self.bad, self.telling
        return {
            "route": route.topic,
            "msg_id": f"0x{route.msg_id:04x}",
            "type": route.type or None,
            "link": route.link.label,
            "to_cfs": self.plan.to_cfs,
            "emulated": self.plan.scenario,
            "swept": "size" if by_size else "rate",
            "steps": [step.as_json() for step in self.steps],
            "threshold_hz": good.rate_hz if good and not by_size else None,
            "first_loss_hz": bad.rate_hz if bad and not by_size else None,
            "threshold_bytes": good.size if good and by_size else None,
            "first_loss_bytes": bad.size if bad and by_size else None,
            "limiting_hop": telling.outcome.hop or None if telling else None,
            "reason": telling.outcome.reason or None if telling else None,
            "watched": self.watched,
            "interrupted": self.interrupted,
            "failure": str(self.failure) if self.failure else None,
            "notes": self.notes,
        }


def profile_of(plan: SweepPlan, mission: Mission) -> SimProfile:
    """Return the constants of the cFS at the other end: of the emulated one, or of a stock cFS.

    Args:
        plan: with defaults filled in.
    """
    options, route, limit = plan.options, plan.route, plan.limit
    profile = replace(
        mission.software.profile,
        generator_msg_id=plan.headers.msg_ids.standard(plan.generator),
        headers=plan.headers,
    )
    if plan.scenario is None:
        return profile
    assert options.target is not None
    assert options.listen is not None
    if limit is not None and plan.to_cfs:
        profile = replace(profile, app_msg_limit=limit)
    elif limit is not None:
        limits = TO_TABLE | {plan.headers.msg_ids.standard(route.msg_id): limit}
        profile = replace(profile, to_limits=limits, sbn_msg_limit=limit)
    if route.link.peers:
        peer = SbnPeerConfig(options.identity(mission), options.listen.port)
        return replace(profile, sbn_port=options.target.port, sbn_peers=(peer,))
    return replace(profile, ci_port=options.target.port, to_port=options.listen.port)


def emulated(plan: SweepPlan, profile: SimProfile, bench: Workbench) -> SimulatedWire:
    """Boot the emulated cFS of a plan: that of the mission, if the mission describes its build.

    Args:
        plan: its scenario must not be None.
        profile: see ``profile_of``.
    """
    assert plan.options.listen is not None
    assert plan.scenario is not None
    system = routes_of(bench) if bench.mission.software.profile.stated else plan.scenario
    simulation = Simulation(profile, system, bridges=False)
    on_network = plan.route.link.peers
    target = simulation.cfs.sbn_endpoint if on_network else simulation.cfs.ci_endpoint
    own = replace(plan.options.listen, address=profile.address)
    return SimulatedWire(
        simulation, target, own, carrying("flight" if on_network else "ground", to_cfs=False)
    )


_SLACK_NS: Final = SECOND
"""Largest error of the time between two commands to the generator."""
_BEHIND_NS: Final = 5 * SECOND
"""Time after the last message; if messages of a step are read later, cFS is too slow for the rate."""
_BACKGROUND_NS: Final = 4 * SECOND
_GENERATOR_NS: Final = 4 * SECOND


def sweep(
    plan: SweepPlan,
    bench: Workbench,
    *,
    trying: Callable[[str], None] = lambda _: None,
    ready: Callable[[Endpoint], None] = lambda _: None,
) -> Sweep:
    """Run a plan.

    Args:
        trying: called before each step, with a text for the user.
        ready: called with the receiving endpoint, once it is open.

    Raises:
        CaptureError: a socket cannot be opened; later errors are in ``Sweep.failure``.
    """
    options = plan.options
    assert options.target is not None
    assert options.listen is not None
    result = Sweep(plan)
    with ExitStack() as stack:
        if plan.scenario is not None:
            name, local = f"the emulated cFS ({plan.scenario})", options.listen
            wire: Wire = emulated(plan, profile_of(plan, bench.mission), bench)
        else:
            name = str(options.target)
            wire, local = open_wire(replace(options, events=None), stack)
            stack.enter_context(precise_timing())
        ready(local)
        sweeper = _Sweeper(plan, bench, result, wire, name, local, trying)
        stack.enter_context(on_interrupt(sweeper.line.stopped.set))
        try:
            sweeper.run()
        except CaptureError as error:
            result.failure = error
        except KeyboardInterrupt:  # the second Ctrl-C
            sweeper.line.stopped.set()
        finally:
            sweeper.clean_up()
        result.interrupted = sweeper.line.stopped.is_set() and result.failure is None
    return result


class _Sweeper:
    """One run of a sweep."""

    def __init__(
        self,
        plan: SweepPlan,
        bench: Workbench,
        result: Sweep,
        wire: Wire,
        name: str,
        local: Endpoint,
        trying: Callable[[str], None],
    ) -> None:
        self.plan, self.bench, self.result, self._trying = plan, bench, result, trying
        self.observer = Observer(bench, plan.route)
        profile = profile_of(plan, bench.mission)
        self._judge = Judge(plan.route, profile, measures=plan.scenario is None)
        session = None
        if plan.route.link.peers:
            own = (cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID, cfe.EVENT_MSG_ID)
            msg_ids = [*map(plan.headers.msg_ids.of_known, own)]
            msg_ids += [] if plan.to_cfs else [plan.route.msg_id]
            session = SbnConnection(plan.options.identity(bench.mission), msg_ids, now=wire.now())
        self.line = Line(wire, name, self.observer, session)
        self._undo: list[bytes] = []
        self._background = self._behind = 0
        first = Outgoing.packets(
            plan.options.to.link,
            [Packet(packets.message(plan.route, bench, plan.sizes[0]))],
            sender=session.own if session else None,
            headers=plan.headers,
        )
        out = first if plan.to_cfs else first.take(slice(0, 0))
        seen = self.observer.seen
        self._conditions = [
            *conditions(
                out, plan.options, bench.mission, responses=seen, session=session, wire=wire, local=local
            )
        ]
        if session is not None:
            # cFS sends its own subscriptions also to peers whose datagrams it refuses.
            self._conditions.append(
                Condition("messages", lambda: bool(seen.counts), lambda s: _nothing_came(session, local, s))
            )

    def run(self) -> None:
        """Run the sweep."""
        self.line.open(self._conditions, self.plan.options.timeout_ns)
        self.line.command(reset_filters(self.plan.headers))
        if self.plan.watch and not self.plan.to_cfs:
            self._watch()
            return
        if not self.plan.to_cfs:
            self._need_generator()
            self._measure_background()
        if self.plan.is_echoed:
            add, remove = packets.echo(self.plan.route.msg_id, self.plan.headers)
            self._undo.append(remove)
            self.line.command(add)
        self._search()

    def clean_up(self) -> None:
        """Restore the state of cFS, and add the notes on the whole sweep."""
        if self._behind:
            self.result.note(
                f"from {self._behind} Hz on cFS is too slow: it still reads long after the last message"
            )
        self.line.close(self._undo)

    def _search(self) -> None:
        plan, search = self.plan, self.plan.search()
        self.line.settle()
        while (value := search.next) is not None and not self.line.stopped.is_set():
            rate, size = (plan.rates[0], value) if plan.by_size else (value, plan.sizes[0])
            size = size or packets.natural_size(plan.route, self.bench)
            self._trying(f"{rate:,} Hz, {size:,} bytes")
            outcome = self._commands(rate, size) if plan.to_cfs else self._telemetry(rate, size)
            if self.line.stopped.is_set():
                return
            self._note(outcome)
            search.tell(value, good=not outcome.lost)
            self.result.steps.append(SweepStep(rate, size, outcome))

    def _commands(self, rate: int, size: int) -> StepOutcome:
        line, observer, plan = self.line, self.observer, self.plan
        packet = packets.message(plan.route, self.bench, size)
        observer.begin()
        observer.expected = packet if plan.is_echoed else None
        before = observer.mark()
        line.command(reset_filters(self.plan.headers))
        sent = line.evenly(packet, rate, max(1, rate * plan.step_ns // SECOND))
        began = line.now()
        after = line.settle()
        if line.now() - began > _BEHIND_NS:
            self._behind = min(self._behind or rate, rate)
        if plan.is_echoed and after.arrived == before.arrived and not line.stopped.is_set():
            self.result.note("no echo came back through Telemetry Output: it is not known what CI cuts")
        return self._judge.commands(observer, before, after, sent=sent, rate_hz=rate)

    def _telemetry(self, rate: int, size: int) -> StepOutcome:
        line, observer, plan = self.line, self.observer, self.plan
        line.command(reset_filters(self.plan.headers))
        observer.begin()
        observer.expected_size = size if plan.by_size else 0
        before = observer.mark()
        requested = max(0, rate - self._background)
        line.command(packets.generator_command(plan, requested, size))
        self._undo[:] = [packets.generator_command(plan, 0, size)]
        line.listen(plan.step_ns - COMMAND_NS)
        line.command(packets.generator_command(plan, 0, size))
        after = line.settle()
        least = requested * max(0, plan.step_ns - _SLACK_NS) // SECOND
        requested = max(least, requested * plan.step_ns // SECOND)
        return self._judge.telemetry(observer, before, after, least=least, requested=requested)

    def _need_generator(self) -> None:
        """Send the telemetry generator a stop command; its event shows that it exists.

        Raises:
            CaptureError: it does not exist.
        """
        event = software_bus.EVENTS[software_bus.NO_SUBSCRIBERS].text.partition(",")[0]
        nobody = event.format(msg_id=self.plan.generator)
        observed = self.observer.seen

        def answers() -> int:
            return sum(item.count for item in observed.events.values() if item.app == generator.NAME)

        before = answers()
        self.line.command(packets.generator_command(self.plan, 0, 0))
        self.line.until(lambda: answers() > before or observed.says(nobody), _GENERATOR_NS)
        if answers() == before and not self.line.stopped.is_set():
            why = f"cFS says: {nobody}" if observed.says(nobody) else f"within {_GENERATOR_NS // SECOND} s"
            raise CaptureError(
                f"no telemetry generator answers on 0x{self.plan.generator:04x} ({why}): add the app that "
                "'edoras codegen generator' writes to this cFS, name its MsgId with --generator, or measure "
                "what others publish with --watch"
            )

    def _measure_background(self) -> None:
        """Measure whether the route is already published; if so, the generator only adds the rest."""
        before = self.observer.mark()
        self.line.listen(_BACKGROUND_NS)
        published = self._judge.telemetry(self.observer, before, self.observer.mark()).sent
        self._background = round(published * SECOND / _BACKGROUND_NS)
        if self._background:
            self.result.note(
                f"{called(self.plan.route.msg_id, self.bench.mission)} is already published at "
                f"{self._background} Hz: the generator adds the rest, so messages are not evenly spaced"
            )

    def _watch(self) -> None:
        """Measure what others publish, in steps."""
        self.result.watched = True
        plan, observer = self.plan, self.observer
        end = self.line.now() + plan.watch_ns
        while self.line.now() < end and not self.line.stopped.is_set():
            observer.go_on(self.line.epoch())
            before = observer.mark()
            self._trying("watching")
            self.line.command(reset_filters(self.plan.headers))
            self.line.listen(plan.step_ns - COMMAND_NS)
            if self.line.stopped.is_set():
                return
            outcome = self._judge.telemetry(observer, before, observer.mark())
            self._note(outcome)
            rate = round(outcome.sent * SECOND / plan.step_ns, 1)
            self.result.steps.append(SweepStep(rate, observer.largest, outcome))
        if not any(step.outcome.sent for step in self.result.steps):
            raise CaptureError(
                f"no {called(plan.route.msg_id, self.bench.mission)} came in {plan.watch_ns / SECOND:g} s; "
                "usually it is not published, or it is not in Telemetry Output's table"
            )

    def _note(self, outcome: StepOutcome) -> None:
        """Add notes on other losses, and on what this sweep cannot see."""
        for verdict in outcome.others:
            if verdict.msg_id is not None and verdict.msg_id != self.plan.route.msg_id:
                self.result.note(
                    f"{called(verdict.msg_id, self.bench.mission)} was lost too, at {verdict.hop}"
                )
        if not self.observer.mark().reports:
            self.result.note(
                "no 0x0803 came: without the software bus's counters, only events show losses inside cFS"
            )
        if self.plan.by_size:
            for text in _size_notes(self.plan):
                self.result.note(text)


def _size_notes(plan: SweepPlan) -> Iterator[str]:
    """Yield what a sweep of sizes cannot see: the effect of the bridge that the sweep replaces."""
    first, last = plan.sizes
    if plan.to_cfs:
        if plan.route.link.peers:
            yield "messages of an SBN peer are not echoed: a cut in them would not be seen"
        return
    if not plan.route.link.peers:
        if last > BRIDGE_BUFFER:
            yield (
                f"the ground bridge receives into {BRIDGE_BUFFER:,} bytes: longer messages arrive here, but "
                "are garbage there"
            )
        return
    # A datagram is dropped if its length in a byte is shorter than its SBN header.
    header = sbn.HEADER.size
    window = -(-(first + 1) // BRIDGE_LENGTH_MODULUS) * BRIDGE_LENGTH_MODULUS
    if window - header <= last:
        yield (
            f"the flight bridge keeps lengths in one byte: it drops packets of {window - header:,} to "
            f"{window - 1:,} bytes, and so again every {BRIDGE_LENGTH_MODULUS}; here they arrive"
        )
    if last + header > FLIGHT_BRIDGE_BUFFER:
        yield (
            f"the flight bridge receives into {FLIGHT_BRIDGE_BUFFER:,} bytes, SBN header included: longer "
            "messages arrive here, but are cut there"
        )


def _nothing_came(session: SbnConnection, local: Endpoint, seconds: float) -> str:
    return (
        f"SBN peer {session.answered} sent none of the messages that {session.own} at {local} subscribed "
        f"to, within {seconds:.1f} s; usually its peer table has another identity for UDP {local.port}: "
        "set --as SC:CPU as in the table"
    )
