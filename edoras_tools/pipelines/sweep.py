"""Rates or sizes upward until something is lost: where a route's limit is, which hop sets it, and why."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import CaptureError
from edoras_tools.model import Link
from edoras_tools.pipelines import sweep_evidence as evidence
from edoras_tools.pipelines import sweep_plan as packets
from edoras_tools.pipelines.gates import Gate, gates
from edoras_tools.pipelines.interrupt import on_interrupt
from edoras_tools.pipelines.safety import called
from edoras_tools.pipelines.sweep_found import Step, Sweep
from edoras_tools.pipelines.sweep_line import COMMAND_NS, Line, reset_filters
from edoras_tools.pipelines.sweep_simulated import emulated
from edoras_tools.pipelines.sweep_verdict import verdict
from edoras_tools.sessions import telemetry_output
from edoras_tools.sessions.outgoing import Outgoing, Packet
from edoras_tools.sessions.profile import SECOND
from edoras_tools.sessions.sbn_client import SbnClient
from edoras_tools.sim import generator
from edoras_tools.sinks.transmit import Listener, Transmitter
from edoras_tools.sinks.wire import UdpWire, precise_timing
from edoras_tools.wire import cfe
from edoras_tools.wire.limits import BRIDGE_BUFFER

if TYPE_CHECKING:
    from collections.abc import Callable

    from edoras_tools.model import Endpoint
    from edoras_tools.pipelines.sweep_evidence import Account
    from edoras_tools.pipelines.sweep_plan import Plan
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.sessions.sbn_client import Peering
    from edoras_tools.sinks.wire import Wire

_SLACK_NS: Final = SECOND
"""Between two commands to the generator, the time may be shorter by that much than it was meant to be."""
_BEHIND_NS: Final = 5 * SECOND
"""Who has not read a step's messages so long after it falls behind."""
_BACKGROUND_NS: Final = 4 * SECOND
_GENERATOR_NS: Final = 4 * SECOND


def sweep(
    plan: Plan,
    bench: Workbench,
    *,
    trying: Callable[[int, int], None] = lambda *_: None,
    ready: Callable[[Endpoint], None] = lambda _: None,
) -> Sweep:
    """Carry a plan out.

    Args:
        plan: what.
        bench: its mission and types.
        trying: told the rate and the size of each step before it begins.
        ready: told where answers come in, once they can.

    Raises:
        CaptureError: a socket cannot be opened; what goes wrong later is in ``Sweep.failure``.
    """
    orders = plan.orders
    assert orders.target is not None
    assert orders.listen is not None
    found = Sweep(plan)
    with ExitStack() as stack:
        local = orders.listen
        if plan.scenario is not None:
            name = f"the emulated cFS ({plan.scenario})"
            wire: Wire = emulated(plan, bench.mission)
        else:
            name = str(orders.target)
            is_sbn = plan.route.link is Link.SBN
            transmitter = stack.enter_context(Transmitter(orders.target, orders.listen if is_sbn else None))
            ears: list[tuple[Link, Listener]] = []
            if not is_sbn:
                ears.append((Link.TO, Listener(orders.listen)))
                stack.callback(ears[0][1].close)
            local = ears[0][1].local if ears else transmitter.local
            wire = UdpWire(transmitter, orders.to.link, ears)
            stack.enter_context(precise_timing())
        ready(local)
        sweeper = _Sweeper(plan, bench, found, wire, name, local, trying)
        stack.enter_context(on_interrupt(sweeper.line.stopped.set))
        try:
            sweeper.run()
        except CaptureError as error:
            found.failure = error
        except KeyboardInterrupt:  # the second Ctrl-C
            sweeper.line.stopped.set()
        finally:
            sweeper.clean_up()
        found.interrupted = sweeper.line.stopped.is_set() and found.failure is None
    return found


class _Sweeper:
    """One run."""

    def __init__(
        self,
        plan: Plan,
        bench: Workbench,
        found: Sweep,
        wire: Wire,
        name: str,
        local: Endpoint,
        trying: Callable[[int, int], None],
    ) -> None:
        self.plan, self.bench, self.found, self._trying = plan, bench, found, trying
        self.hearing = evidence.Hearing(bench.mission, plan.route.msg_id)
        session = None
        if plan.route.link is Link.SBN:
            wanted = [cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID, cfe.EVENT_MSG_ID]
            wanted += [] if plan.to_cfs else [plan.route.msg_id]
            session = SbnClient(plan.orders.identity(bench.mission), wanted, now=wire.now())
        self.line = Line(wire, name, self.hearing, session)
        self._way_out = "" if plan.to_cfs else telemetry_output.PIPE
        if session is not None and not plan.to_cfs:
            self._way_out = f"SBN_{session.peer.processor_id}_{session.peer.spacecraft_id}_Pipe"
        self._undo: list[bytes] = []
        self._background = self._behind = 0
        first = Outgoing.packets(
            plan.orders.to.link,
            [Packet(packets.message(plan.route, bench, plan.sizes[0]))],
            sender=session.peer if session else None,
        )
        out = first if plan.to_cfs else first.take(slice(0, 0))
        seen = self.hearing.seen
        self._gates = [
            *gates(out, plan.orders, bench.mission, seen=seen, session=session, wire=wire, local=local)
        ]
        if session is not None:
            # cFS sends its own subscriptions to peers that it does not hear, too.
            self._gates.append(
                Gate("messages", lambda: bool(seen.counts), lambda s: _deaf(session, local, s))
            )

    def run(self) -> None:
        """Do all of it."""
        self.line.open(self._gates, self.plan.orders.timeout_ns)
        self.line.command(reset_filters())
        if not self.plan.to_cfs and (self.plan.watch or not self._has_generator()):
            self._watch()
            return
        if not self.plan.to_cfs:
            self._measure_background()
        if self.plan.is_echoed:
            add, remove = packets.echo(self.plan.route.msg_id)
            self._undo.append(remove)
            self.line.command(add)
        self._search()

    def clean_up(self) -> None:
        """Leave cFS as it was found, and tell what only the whole sweep shows."""
        if self._behind:
            self.found.note(
                f"from {self._behind} Hz on cFS falls behind: it reads on long after the last message"
            )
        self.line.last_words(self._undo)

    def _search(self) -> None:
        plan, search = self.plan, self.plan.search()
        self.line.settle()
        while (value := search.next) is not None and not self.line.stopped.is_set():
            rate, size = (plan.rates[0], value) if plan.by_size else (value, plan.sizes[0])
            size = size or packets.natural_size(plan.route, self.bench)
            self._trying(rate, size)
            account = self._commands(rate, size) if plan.to_cfs else self._telemetry(rate, size)
            if self.line.stopped.is_set():
                return
            self._note(account)
            search.tell(value, good=not account.lost)
            self._add(rate, size, account)

    def _add(self, rate: float, size: int, account: Account) -> None:
        hop = reason = ""
        if account.lost:
            hop, reason = verdict(account, rate, self.plan.route.msg_id, self._way_out)
        self.found.steps.append(Step(rate, size, account, hop, reason))

    def _commands(self, rate: int, size: int) -> Account:
        line, hearing, plan = self.line, self.hearing, self.plan
        packet = packets.message(plan.route, self.bench, size)
        hearing.begin()
        hearing.expected = packet if plan.is_echoed else None
        before, before_sent = hearing.mark(), line.sent
        line.command(reset_filters())
        sent = line.evenly(packet, rate, max(1, rate * plan.step_ns // SECOND))
        began = line.now()
        after = line.settle()
        if line.now() - began > _BEHIND_NS:
            self._behind = min(self._behind or rate, rate)
        through_ci = line.sent - before_sent if plan.route.link is Link.CI else 0
        if plan.is_echoed and after.arrived == before.arrived and not line.stopped.is_set():
            self.found.note("no echo came back through Telemetry Output: what CI cuts cannot be seen")
        return evidence.commands(before, after, plan.route.msg_id, sent, through_ci)

    def _telemetry(self, rate: int, size: int) -> Account:
        line, hearing, plan = self.line, self.hearing, self.plan
        line.command(reset_filters())
        hearing.begin()
        hearing.expected_size = size if plan.by_size else 0
        before = hearing.mark()
        asked = max(0, rate - self._background)
        line.command(packets.generate(plan.route, asked, size))
        self._undo[:] = [packets.generate(plan.route, 0, size)]
        line.listen(plan.step_ns - COMMAND_NS)
        line.command(packets.generate(plan.route, 0, size))
        after = line.settle()
        least = asked * max(0, plan.step_ns - _SLACK_NS) // SECOND
        return evidence.telemetry(
            before, after, plan.route.msg_id, least, max(least, asked * plan.step_ns // SECOND)
        )

    def _has_generator(self) -> bool:
        """Ask the telemetry generator to stop what it does not do yet; its event tells that it is there."""

        def answers() -> int:
            return sum(item.count for item in self.hearing.seen.events.values() if item.app == generator.NAME)

        before = answers()
        self.line.command(packets.generate(self.plan.route, 0, 0))
        if self.line.until(lambda: answers() > before, _GENERATOR_NS):
            return True
        if not self.line.stopped.is_set():
            self.found.note(
                f"no telemetry generator answers on 0x{generator.COMMAND_MSG_ID:04x}: sweep can only watch "
                "what is published; change the rate there"
            )
        return False

    def _measure_background(self) -> None:
        """See whether something publishes the route already; the generator then only adds the rest."""
        before = self.hearing.mark()
        self.line.listen(_BACKGROUND_NS)
        after = self.hearing.mark()
        published = after.arrived - before.arrived + after.gaps - before.gaps
        self._background = round(published * SECOND / _BACKGROUND_NS)
        if self._background:
            self.found.note(
                f"{called(self.plan.route.msg_id, self.bench.mission)} is published at {self._background} Hz "
                "already: the generator adds the rest, so messages are not evenly spaced"
            )

    def _watch(self) -> None:
        """Look at what is published, a step's time each."""
        self.found.watched = True
        plan, hearing = self.plan, self.hearing
        end = self.line.now() + plan.watch_ns
        while self.line.now() < end and not self.line.stopped.is_set():
            before = hearing.mark()
            self._trying(0, 0)
            self.line.command(reset_filters())
            self.line.listen(plan.step_ns - COMMAND_NS)
            if self.line.stopped.is_set():
                return
            account = evidence.watched(before, hearing.mark(), plan.route.msg_id)
            self._note(account)
            rate = round(account.sent * SECOND / plan.step_ns, 1)
            self._add(rate, hearing.largest, account)
        if not any(step.account.sent for step in self.found.steps):
            raise CaptureError(
                f"no {called(plan.route.msg_id, self.bench.mission)} came in {plan.watch_ns / SECOND:g} s; "
                "usually nothing publishes it, or it is not in Telemetry Output's table"
            )

    def _note(self, account: Account) -> None:
        """Tell people what they would wonder about."""
        for culprit in account.others:
            self.found.note(
                f"{called(culprit.msg_id, self.bench.mission)} was lost too, at {culprit.pipe}, sent by "
                f"{culprit.sender}"
            )
        if not self.hearing.mark().heard:
            self.found.note(
                "no 0x0803 came: without the software bus's counters loss inside cFS is seen in events only"
            )
        if self.plan.by_size and not self.plan.to_cfs and self.plan.sizes[1] > BRIDGE_BUFFER:
            self.found.note(
                f"the ground bridge receives into {BRIDGE_BUFFER:,} bytes: what is longer arrives here, and "
                "is garbage there"
            )
        if self.plan.by_size and self.plan.to_cfs and self.plan.route.link is Link.SBN:
            self.found.note("nothing echoes what an SBN peer sends: a cut in it would not be seen")


def _deaf(session: Peering, local: Endpoint, seconds: float) -> str:
    return (
        f"SBN peer {session.answered} sent none of the messages that {session.peer} at {local} subscribed "
        f"to, within {seconds:.1f} s; usually its peer table calls UDP {local.port} something else: say "
        "--as SC:CPU as the table does"
    )
