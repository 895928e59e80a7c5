"""Messages went into cFS and never came out, and nothing in the capture says why."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.cfs import sbn
from edoras_tools.diagnosis.loss_verdict import loss_verdict, lost_at
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.robot import ROBOT

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.accounting.fates import Fate
    from edoras_tools.diagnosis.case import Case

ID = "crossing_loss"


def judge(case: Case) -> Iterator[Verdict]:
    """Say what is not accounted for, and what had nowhere to go."""
    for loss in case.losses:
        if loss.kind == "away":
            yield loss_verdict(
                case,
                ID,
                loss,
                f"{lost_at(case, loss)}: they went into cFS while the peer that they go to was away",
                link=loss.stream.link.label if loss.stream else None,
                remedy="restart the peer; it is connected again with its first SUB or PROTO",
            )
        elif loss.kind == "sbn_socket":
            yield loss_verdict(
                case,
                ID,
                loss,
                f"{lost_at(case, loss)}: more came at once than SBN reads",
                link=loss.stream.link.label if loss.stream else None,
                remedy=f"send at most {sbn.DATAGRAMS_PER_WAKE} datagrams in "
                f"{case.profile.sbn_wake_ns // 1_000_000} ms",
            )
    for fate in case.commands.fates.values():
        if fate.unaccounted:
            yield _verdict(case, fate) if fate.seen else _unfollowed(case, fate)


def _verdict(case: Case, fate: Fate) -> Verdict:
    stream = fate.stream
    into = case.name(stream.msg_id)
    ways = [
        "to the robot" if hop.out.link == ROBOT else f"as {case.name(hop.out.msg_id)}" for hop in fate.hops
    ]
    missing = case.rows.time_ns[stream.rows][np.flatnonzero(fate.open)]
    visible = bool(case.tracks)
    evidence = [f"{int(fate.arrived.sum()):,} came out {', '.join(ways)} with the same values"]
    if fate.superseded:
        evidence.append(f"{fate.superseded:,} more gave way to a newer one, and are not counted here")
    evidence.append(
        "the counters of 0x803 and 0x884 explain no more than is told elsewhere"
        if visible
        else "0x803 is not in the capture, so the software bus cannot be cleared or blamed"
    )
    return Verdict(
        ID,
        Severity.ERROR,
        f"{fate.unaccounted:,} of {len(stream):,} messages that went into cFS on {into} are not accounted "
        f"for: they never came out {' or '.join(ways)}, and nothing in the capture says why",
        msg_id=stream.msg_id,
        topic=case.topic(stream.msg_id),
        link=stream.link.label,
        hop="application",
        of=len(stream),
        start_ns=int(missing[0]),
        end_ns=int(missing[-1]),
        evidence=(*evidence, *case.drops_text()),
        remedy="look at the application's own counters and console: it received them and did not pass them "
        "on, or its task was not there",
        confidence="medium" if visible else "low",
    )


def _unfollowed(case: Case, fate: Fate) -> Verdict:
    """Say that nobody can follow what was sent after an application stopped."""
    stream = fate.stream
    times = case.rows.time_ns[stream.rows]
    if fate.reached is not None:
        why = f"the robot got {fate.reached:,}, and which they were is cut off"
        evidence = ["datagrams counted: to CI, and on the robot link"]
    elif fate.commanded is not None:
        why = f"Telemetry Output counted {fate.commanded:,} commands meanwhile"
        evidence = ["0x880: its counters of commands taken and refused, between the first and the last here"]
    else:
        why = "they were sent after an application was stopped, and nothing here shows whether one took them"
        evidence = [fate.unfollowed_since]
        times = times[fate.unfollowed]
    return Verdict(
        ID,
        Severity.WARNING,
        f"{fate.unaccounted:,} of {len(stream):,} messages that went into cFS on {case.name(stream.msg_id)} "
        f"are not accounted for: {why}",
        msg_id=stream.msg_id,
        topic=case.topic(stream.msg_id),
        link=stream.link.label,
        hop="application",
        of=len(stream),
        start_ns=int(times[0]),
        end_ns=int(times[-1]),
        evidence=(*evidence, *case.drops_text()),
        remedy="capture what comes out of the application too: the robot link (UDP 8080 to 8585), SBN",
        confidence="medium",
    )
