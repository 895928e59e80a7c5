"""Values that arrive and were not sent, or that are old when they arrive."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.diagnosis.rules.about import packet
from edoras_tools.diagnosis.verdict import NOTHING_SENT, Severity, Verdict, verdict, warning
from edoras_tools.links.table import link
from edoras_tools.links.to import TO
from edoras_tools.model import rate_hz
from edoras_tools.units import SECOND
from edoras_tools.words import listed, plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.accounting.content import WayContent
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.wire.arrays.order import Places

_EDORAS = "EDORAS"
"""The public applications, their pipes and their housekeeping begin so; these pass values on as they are."""
_FEW = 4
_LEAST = 3
_APP_NS = SECOND
"""The public applications read their robot's states once a second."""
_SLACK_NS = 3 * SECOND


def changed_values(case: Case) -> Iterator[Verdict]:
    """What reaches a robot, or leaves cFS again, has values that were never sent.

    Tell how many have changed, and how many always hold the same one. An application may change values on
    purpose; those of EDORAS do not.
    """
    passes_on = _is_edoras(case)
    for item in case.contents:
        same, other = len(item.constant), len(item.changed)
        if not same + other:
            continue
        where, same_one = _where(case, item), f"{same:,} always hold the same one"
        if same + other == item.of:  # nothing that came out has a value that was sent
            all_ = f"all {item.of:,}" if not same or not other else f"{other:,} changed, {same_one}"
            how = "" if same and other else " always hold the same one" if same else " changed"
            text = f"{NOTHING_SENT[0]} that {where} {NOTHING_SENT[1]}: {all_}{how}"
        else:
            text = f"{same + other:,} of {item.of:,} that {where} have a value that was never sent"
            text += f": {same_one}" if same else ""
        evidence = [_first(case, item.constant if same else item.changed)]
        if passes_on:
            evidence.append(f"{passes_on} is here: the public EDORAS applications pass values on as they are")
        elif not same:
            evidence.append("an application that changes values on purpose does this, too")
        yield _about(
            Severity.ERROR if passes_on or same else Severity.WARNING,
            case,
            item,
            text,
            *evidence,
            remedy="look at what the application sends: a struct that was not filled, as after a command "
            "that it failed to parse, or one that something else wrote over",
        )


def old_values(case: Case) -> Iterator[Verdict]:
    """What reaches a robot, or leaves cFS again, is older than others, or later than rounds make it.

    Tell how many came again after newer ones, and how many took too long.
    """
    for item in case.contents:
        again, late = len(item.again), len(item.late)
        longest = f"up to {item.longest_ns / SECOND:.1f} s after they were sent"
        if again:
            yield _about(
                Severity.ERROR,
                case,
                item,
                f"{again:,} of {item.of:,} that {_where(case, item)} came with an old value, {longest}",
                _first(case, item.again),
                "others that were sent later had arrived, or were due",
                remedy="look for a network or relay that doubles or delays, and for an application that "
                "reads slower than it is sent to, or sends what it has kept",
            )
        if late:
            yield _about(
                Severity.WARNING,
                case,
                item,
                f"{late:,} of {item.of:,} that {_where(case, item)} were late, {longest}: rounds and CI's "
                f"socket explain {item.rounds_ns / SECOND:.1f} s at most",
                _first(case, item.late),
                remedy="look for a queue on the way that is served slower than it is filled",
            )


def old_states(case: Case) -> Iterator[Verdict]:
    """An application reads slower than its robot sends: what leaves cFS is older and older.

    Tell how old the states of the robot become, and both rates.
    """
    rounds_ns = _APP_NS + case.profile.to_wake_ns + _SLACK_NS
    for item in case.passed_states:
        old = item.age_ns > rounds_ns
        if old.sum() < _LEAST:
            continue
        sent, passed = (
            rate_hz(len(times), int(times[-1] - times[0])) for times in (item.sent_ns, item.time_ns)
        )
        last, oldest = int(np.flatnonzero(old)[-1]), int(item.age_ns.argmax())
        at = case.at(int(item.time_ns[oldest]))
        yield warning(
            f"{int(old.sum()):,} of {len(old):,} messages on {case.name(item.msg_id)} carry an old state of "
            f"the robot, up to {item.age_ns[oldest] / SECOND:.1f} s old",
            f"packet {item.number[oldest]} at {at}: {item.age_ns[oldest] / SECOND:.1f} s after it was sent",
            f"the robot sends {sent:.1f} a second, {passed:.1f} a second are passed on: the rest waits",
            msg_id=item.msg_id,
            place=(TO.label, "flight application"),
            span=(int(item.time_ns[old.argmax()]), int(item.time_ns[last])),
            remedy=f"let the application pass on the newest, or the robot send {passed:.1f} a second",
        )


def value_limits(case: Case) -> Iterator[Verdict]:
    """Values are outside the limits that the layout of their struct sets.

    Name each field, how many values are outside its yellow and its red limits, and the lowest and highest.
    """
    beyond = case.payloads.beyond
    for name, (number, member) in case.payloads.limited.items():
        among = beyond["field"] == number
        rows, value = beyond["row"][among], beyond["value"][among].view(np.float64)
        red, unit = int(beyond["red"][among].sum()), f" {member.unit}".rstrip()
        if len(rows):
            yield warning(
                f"{name}: {plural(len(rows), 'value')} outside its limits, {red:,} outside the red ones",
                f"{packet(case, int(rows[0]))}: {value[0]:.9g}{unit}",
                f"lowest {value.min():.9g}{unit}, highest {value.max():.9g}{unit}; limits: {member.limits}",
                msg_id=int(case.rows.msg_id[rows[0]]),
                link=link(int(case.rows.link[rows[0]])).label,
                span=case.span(rows),
                remedy="look for the cause on board, or correct the limits in the layout or the data sheet",
            )


def _about(
    severity: Severity, case: Case, item: WayContent, text: str, *evidence: str, remedy: str
) -> Verdict:
    return verdict(
        severity,
        text,
        *evidence,
        msg_id=item.into.msg_id if item.out.link.last_hop else item.out.msg_id,
        place=(item.out.link.label, "flight application"),
        span=case.span(item.out.rows),
        remedy=remedy,
        confidence="medium",
    )


def _where(case: Case, item: WayContent) -> str:
    return "reached the robot" if item.out.link.last_hop else f"came out as {case.name(item.out.msg_id)}"


def _first(case: Case, members: Places) -> str:
    packets = listed([packet(case, int(row)) for row in members[:_FEW]])
    return f"{packets}{', and more' * (len(members) > _FEW)}"


def _is_edoras(case: Case) -> str:
    """Return the name of an EDORAS application, or of its pipe, in the capture; empty where it has none."""
    names = [item.app for item in case.payloads.events]
    names += [item.pipe for item in case.reported_losses]
    names += [case.packet_name(stream.msg_id) for stream in case.streams if stream.link.only_from_cfs]
    return next((name for name in names if name.startswith(_EDORAS)), "")
