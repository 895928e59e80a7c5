"""Telemetry Output: enabled, stopped, and where it sends."""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.cfs import executive_services, telemetry_output
from edoras_tools.cfs.commands import ENABLE_OUTPUT, is_address
from edoras_tools.diagnosis.accounting.closed import diversion
from edoras_tools.diagnosis.evidence.timeline.table import StateOwner
from edoras_tools.diagnosis.rules.about import packet
from edoras_tools.diagnosis.verdict import Severity, Verdict, security, verdict, warning
from edoras_tools.links.bare import CI, ROBOT, TO
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import by_key
from edoras_tools.words import listed, plural

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.payloads import CommandRecord
    from edoras_tools.diagnosis.evidence.timeline.table import Change

_WAIT_NS: Final = 3 * SECOND
_ENDS_NS: Final = 5 * SECOND
_ENDS_ROUNDS: Final = 6
"""Telemetry that does not come for so long, and for so many of its usual rounds, has ended."""
_LEAST: Final = 4
_MOSTLY: Final = 0.5
_warning = partial(warning, place=("to", telemetry_output.NAME))


def to_not_enabled(case: Case) -> Iterator[Verdict]:
    """Commands go to CI, and no telemetry comes: Telemetry Output was not enabled, or sends elsewhere.

    Look for a ground link with one direction only.
    """
    rows = case.rows
    commands = np.flatnonzero(rows.link == CI)
    expected = bool(len(commands)) or bool(case.mission.ground)
    if not expected or (rows.link == TO).any() or case.end_ns - case.start_ns < _WAIT_NS:
        return
    if len(commands) and case.unreachable.closed[commands].mean() > _MOSTLY:
        return  # nobody listened at CI's port: that is said by itself
    enables = case.payloads.outputs(telemetry_output.ENABLE)
    reason = "Telemetry Output sends nothing here, and no command in the capture enables it"
    if enables:
        reason = (
            f"Telemetry Output was enabled for {_address(enables[-1])} and nothing of it is seen here: the "
            "command did not arrive, it sends elsewhere, its datagrams do not pass here, or it does not run"
        )
    yield _warning(
        reason,
        f"{plural(len(commands), 'command')} to CI, no datagram from Telemetry Output",
        *(f"enabled for {_address(item)} at {case.at(item.time_ns)}" for item in enables),
        remedy="to see telemetry, capture on the host that it is enabled for, UDP port 1235; look for "
        f"TO_LAB_APP's first event on cFS's console; or enable it: {case.inject(ENABLE_OUTPUT)}",
        confidence="medium",
    )


def _address(enable: CommandRecord) -> str:
    return repr(enable.address) if "address" in enable.values else "an address that the capture cut off"


def to_destination(case: Case) -> Iterator[Verdict]:
    """Telemetry Output sends to one address at a time: it was told another than where the ground listens.

    Go through the enable commands: addresses that are none, and addresses that change.
    """
    for members in _enables(case):
        yield from (_no_address(case, item) for item in members if not is_address(item.address))
        own = [item for item in members if is_address(item.address)]
        if len({item.address for item in own}) > 1:
            yield _fight(case, own)


def _enables(case: Case) -> list[list[CommandRecord]]:
    """Return the commands that enable Telemetry Output and went to a CI; those to one endpoint together."""
    own = (item for item in case.payloads.outputs(telemetry_output.ENABLE) if case.rows.link[item.row] == CI)
    own = (item for item in own if "address" in item.values)  # else the capture cut it off
    return list(by_key(own, lambda item: int(case.rows.destination[item.row])).values())


def _no_address(case: Case, item: CommandRecord) -> Verdict:
    near = case.events_between(item.time_ns, item.time_ns + 2 * SECOND, *telemetry_output.NAMES)
    events = [record for record in near if telemetry_output.ENABLED.phrase in record.message]
    return warning(
        f"Telemetry Output was enabled for {item.address!r}, no address: where it sends is up to its host",
        f"{packet(case, item.row)}, {case.rows.length[item.row]} bytes",
        *(f"cFS said: {record}" for record in events[:1]),
        msg_id=case.of_known(telemetry_output.COMMAND_MSG_ID),
        place=("ci", "TO_LAB_APP"),
        span=(item.time_ns, item.time_ns),
        remedy="enable it for the IPv4 address of the ground bridge's host, as text in a whole char[16]",
    )


def _fight(case: Case, members: list[CommandRecord]) -> Verdict:
    steps = [f"{case.at(item.time_ns)} {item.address}" for item in members]
    senders = {case.endpoints[case.rows.source[item.row]].address for item in members}
    changes = sum(a.address != b.address for a, b in pairwise(members))
    who = "two ground stations fight over Telemetry Output: it" if len(senders) > 1 else "Telemetry Output"
    return _warning(
        f"{who} was told {changes} times to send elsewhere, and sends to one address at a time"
        if changes > 1
        else "Telemetry Output was redirected: the first ground station gets nothing from then on",
        f"enabled from: {', '.join(sorted(senders))}",
        f"enabled for: {listed(steps)}",
        msg_id=case.of_known(telemetry_output.COMMAND_MSG_ID),
        span=(members[0].time_ns, members[-1].time_ns),
        remedy="enable TO from one station only, and fan its telemetry out with a proxy there",
    )


def to_stopped(case: Case) -> Iterator[Verdict]:
    """Telemetry Output was told to send less, or forgot where to: what was published meanwhile is missing.

    Name each command that stops telemetry, and what sequence counts show to be missing for all of them.
    """
    lost = [loss for loss in case.losses if loss.closed]
    closed = [
        (part, part.missing - part.assigned.total())
        for part in case.telemetry.parts
        if part.closed and not (part.silenced or part.unexplained or part.cause) and part.stream.link is TO
    ]

    def explain(when: int, msg_id: int = -1) -> tuple[int | None, list[str]]:
        """Return the lost, of those that this stop explains first, and what is known of them."""
        own = [loss for loss in lost if loss.start_ns - SECOND <= when <= loss.end_ns + SECOND]
        for loss in own:
            lost.remove(loss)
        number = sum(loss.lost for loss in own if loss.kind in {"limit", "overflow"})
        missing = sum(loss.lost for loss in own) + sum(
            rest
            for part, rest in closed
            if part.span.start_ns - _WAIT_NS <= when <= part.span.end_ns + SECOND
            and msg_id in {-1, part.stream.msg_id}
        )
        were = "was" if missing == 1 else "were"
        text = f"sequence counts: {plural(missing, 'message')} published meanwhile {were} not sent"
        facts = [text] * bool(missing)
        if number:
            facts.append(
                f"0x803 counts {number:,} of them lost at {telemetry_output.PIPE}, which nobody emptied: "
                "lost, though Telemetry Output would not have sent them either"
            )
        return number or None, facts

    yield from _commanded(case, explain)
    yield from _restarted(case, explain)
    yield from _silent(case)
    yield from _ended(case)


def _commanded(case: Case, explain: Callable[..., tuple[int | None, list[str]]]) -> Iterator[Verdict]:
    """Name each command that stops telemetry."""
    rows = case.rows
    for item in case.payloads.outputs(*telemetry_output.STOPS):
        whose = "every MsgId" if item.entry < 0 else case.name(item.entry)
        lost, facts = explain(item.time_ns, item.entry)
        change = _added_again(case, item)
        again = ""
        if change is not None:
            limit = f", at most {change.value} a round," if change.value is not None else ""
            again = f", and to send it again{limit} at {case.at(change.not_before_ns)}"
        is_sent = change is not None and change.value != 0
        sends = item.entry < 0 or any(item.entry == stream.msg_id for stream in case.streams)
        entry = item.entry if item.entry >= 0 else _ended_at(case, item.time_ns)
        advice = "add it again:" if item.entry >= 0 else "add what is wanted again, e.g."
        advice += f" {case.add_line(entry)}"
        yield verdict(
            Severity.WARNING if facts or (sends and not is_sent) else Severity.NOTE,
            f"Telemetry Output was told to stop sending {whose} at {case.at(item.time_ns)}{again}",
            f"packet {rows.number[item.row]}: {rows.msg_id[item.row]:#06x}, function code "
            f"{item.function_code}, from {case.endpoints[rows.source[item.row]].address}",
            *facts,
            msg_id=item.entry if item.entry >= 0 else None,
            place=("to", telemetry_output.NAME),
            span=(item.time_ns, item.time_ns),
            lost=lost,
            remedy="none: it was added again" if is_sent else advice,
        )


def _ended_at(case: Case, when: int) -> int:
    """Return a MsgId that Telemetry Output has not sent since; that of 0x803 where it sends all of them."""
    last = (item for item in case.streams if item.link is TO and abs(int(item.time_ns[-1]) - when) < _WAIT_NS)
    return next((item.msg_id for item in last), case.of_known(0x0803))


def _added_again(case: Case, item: CommandRecord) -> Change | None:
    """Return the change by which a MsgId that was removed was added again; None where it was not."""
    system = case.instances.system_at(int(case.rows.destination[item.row]), item.time_ns)
    changes = case.timeline.of(StateOwner("entry", "", item.entry), system) if item.entry >= 0 else ()
    later = (change for change in changes if change.not_before_ns > item.time_ns)
    return next((change for change in later if change.state == "subscribed"), None)


def _restarted(case: Case, explain: Callable[..., tuple[int | None, list[str]]]) -> Iterator[Verdict]:
    """Say that Telemetry Output sends from another port: it was restarted."""
    rows = case.rows
    moves = [
        stream.time_ns[at : at + 2].tolist()
        for stream in case.streams
        if stream.link is TO
        for at in (rows.source[stream.rows][1:] != rows.source[stream.rows][:-1]).nonzero()[0].tolist()
    ]
    # Where all of cFS was restarted, that is told by itself.
    resets = [(item.start_ns, item.end_ns) for item in case.resets]
    if moves := [move for move in moves if not any(move[0] <= b and a <= move[1] for a, b in resets)]:
        end_ns = min(end for _, end in moves)
        start_ns = max((start for start, _ in moves if start < end_ns), default=end_ns)
        lost, facts = explain(end_ns)
        yield _warning(
            f"Telemetry Output sends from another port at {case.at(end_ns)}: it was restarted, and forgot "
            "that it was enabled",
            *facts,
            lost=lost,
            span=(start_ns, end_ns),
            remedy=f"enable it again: {case.inject(ENABLE_OUTPUT)}",
        )


def _silent(case: Case) -> Iterator[Verdict]:
    """Say when nothing was sent until Telemetry Output was enabled."""
    silenced = case.telemetry.silenced
    for sender in dict.fromkeys(stream.sender for stream, lost, _ in silenced if lost):
        spans = case.silences_of(sender)
        for (_, back_ns), (start_ns, end_ns) in pairwise([(0, 0), *spans]):
            own = ((lost, *among.times_ns) for item, lost, among in silenced if item.sender == sender)
            # A gap over several silences is counted in the first of them.
            number = sum(lost for lost, before, behind in own if back_ns <= before <= start_ns < behind)
            if not number:
                continue
            failed = case.socket_failure((start_ns, end_ns))
            order = None if failed else diversion(case, sender, start_ns, end_ns)
            why = "its socket failed" if failed else "its socket failed, or it sent to another address"
            if order:
                why = f"it sent to {order.value}, for which it was enabled at {case.at(order.not_before_ns)}"
            yield verdict(
                Severity.ERROR if failed else Severity.WARNING,
                f"nothing came from Telemetry Output from {case.at(start_ns)} to {case.at(end_ns)}, until it "
                f"was enabled: {why}",
                f"sequence counts: {plural(number, 'message')} that the software bus did not lose",
                failed,
                order.witness if order else "",
                place=("to", telemetry_output.SOCKET),
                lost=number if failed and len(spans) == 1 and not case.quality.best[1] else None,
                span=(start_ns, end_ns),
                remedy="look at the address that it was enabled for; after an error of its socket Telemetry "
                f"Output drops what comes until it is enabled again: {case.inject(ENABLE_OUTPUT)}",
                confidence="high" if failed or order else "medium",
            )


def _ended(case: Case) -> Iterator[Verdict]:
    """Say that no telemetry comes any more, while commands go on: nothing else can tell of that time."""
    rows = case.rows
    times = rows.time_ns[rows.link == TO]
    rounds = np.diff(times)[np.diff(times) > case.profile.to_wake_ns // 4]
    if len(rounds) < _LEAST:
        return
    last_ns = int(times[-1])
    length = case.end_ns - last_ns
    commands = int(((rows.link == CI) & (rows.time_ns > last_ns + SECOND)).sum())
    ends = [item.time_ns for item in case.payloads.outputs(*telemetry_output.STOPS) if item.entry < 0]
    # That it was stopped is said by itself.
    ends += [item.start_ns for item in case.outages if item.app.startswith("TO_")]
    removed = any(abs(end_ns - last_ns) < _WAIT_NS for end_ns in ends)
    if removed or not commands or length < max(_ENDS_NS, _ENDS_ROUNDS * int(np.median(rounds))):
        return
    robot = int(((rows.link == ROBOT) & (rows.time_ns > last_ns + SECOND)).sum())
    source = int(rows.source[np.flatnonzero(rows.link == TO)[-1]])
    order = diversion(case, case.instances.output(source), last_ns, case.end_ns + 2 * SECOND)
    why = "no counter and no event tells what became of them"
    remedy = f"see whether cFS and Telemetry Output run, and enable it: {case.inject(ENABLE_OUTPUT)}"
    for item in (item for item in case.outages if item.app in executive_services.SCHEDULERS):
        if item.start_ns < last_ns and item.end_ns is None:
            why = f"{item.app}, which asks for housekeeping, was stopped {case.end_of(item)}"
            remedy = f"start it again: {case.inject('es-start-app', item.app)}"
    if order:
        why = f"it sends to {order.value}, for which it was enabled at {case.at(order.not_before_ns)}"
    yield _warning(
        f"Telemetry Output sends nothing from {case.at(last_ns)} to the end, {length / SECOND:.1f} s, while "
        f"commands go on: {why}",
        f"{plural(commands, 'datagram')} to CI since then",
        f"{plural(robot, 'datagram')} to the robot: its application ran at times" if robot else "",
        span=(last_ns, case.end_ns),
        remedy=remedy,
        confidence="medium",
    )


def to_taken_over(case: Case) -> Iterator[Verdict]:
    """Telemetry Output was sent elsewhere by somebody else than who enabled it.

    Name every enable command that takes the telemetry away from whom another host enabled it for.
    """
    rows = case.rows
    for members in _enables(case):
        for before, after in pairwise(item for item in members if is_address(item.address)):
            old, new = (case.endpoints[rows.source[item.row]].address for item in (before, after))
            if before.address == after.address or old == new:
                continue
            reason = f"{new} had all telemetry sent to {after.address}; {before.address} of {old} gets none"
            why = packet(case, after.row), f"before: {packet(case, before.row)}"
            msg_id, span = case.of_known(telemetry_output.COMMAND_MSG_ID), case.span([after.row])
            remedy = "let only the station reach CI's port, and enable TO again"
            yield security(
                reason, *why, msg_id=msg_id, place=("to", telemetry_output.NAME), span=span, remedy=remedy
            )
