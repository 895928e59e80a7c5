"""A clock was set while the capture ran."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.model import Link
from edoras_tools.sessions.profile import SECOND

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.streams import Stream

ID = "clock_jump"
_BACK_NS: Final = SECOND
_MODULUS: Final = 1 << 14
_NEXT: Final = 16


def judge(case: Case) -> Iterator[Verdict]:
    """Tell the capture's clock (time runs back) from a cFS's (its count goes on, its time does not)."""
    back = np.flatnonzero(np.diff(case.rows.time_ns) < -_BACK_NS)
    for at in back[:4].tolist():
        before, after = (int(case.rows.time_ns[row]) for row in (at, at + 1))
        yield Verdict(
            ID,
            Severity.WARNING,
            f"the capture's own clock jumped back by {(before - after) / SECOND:.1f} s at packet "
            f"{case.rows.number[at + 1]}: rates, latencies and spans across it are not to be trusted",
            hop="capture",
            start_ns=after,
            end_ns=before,
            evidence=(f"packet {case.rows.number[at]} is later than the next",),
            remedy="keep the capture host's clock disciplined (chrony), and do not set it while capturing",
        )
    if not len(back):
        yield from _of_instances(case)


def _of_instances(case: Case) -> Iterator[Verdict]:
    for before, after in jumps(case):
        first, second = (case.instances.items[item] for item in (before, after))
        by = (first.offset_ns - second.offset_ns) / SECOND
        yield Verdict(
            ID,
            Severity.WARNING,
            f"the clock of {second.label}, or the capture's, jumped by {by:+.1f} s at "
            f"{case.at(second.first_ns)}: its sequence counts go on, so it did not restart",
            hop="clock",
            start_ns=first.last_ns,
            end_ns=second.first_ns,
            evidence=("counts of several MsgIds continue across the jump",),
            remedy="mission time before and after does not compare; see who sends TIME commands (0x1805)",
            confidence="medium",
        )


def jumps(case: Case) -> Iterator[tuple[int, int]]:
    """Yield pairs of instances of which the second is the first with its clock set."""
    items = case.instances.items
    for after, second in enumerate(items):
        for before, first in enumerate(items):
            follows = first.last_ns < second.first_ns and first.name == second.name
            if before != after and follows and _goes_on(case, before, after):
                yield before, after


def _goes_on(case: Case, before: int, after: int) -> bool:
    """Tell whether most counts of one instance are taken up by another."""

    def key(stream: Stream) -> tuple[Link, int, int]:
        return stream.link, stream.sender, stream.msg_id

    count = case.rows.sequence_count
    last = {
        key(item): int(count[item.rows[-1]])
        for item in case.streams
        if item.instance == before and item.counted
    }
    steps = [
        (int(count[item.rows[0]]) - last[key(item)]) % _MODULUS
        for item in case.streams
        if item.instance == after and item.link is not Link.CI and key(item) in last
    ]
    return len(steps) > 2 and float(np.mean([0 < step <= _NEXT for step in steps])) > 0.6
