"""A cFS started anew while the capture ran: its clock, counts and counters began again."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.cfs.commands import ENABLE_OUTPUT
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.units import SECOND
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "cfs_restart"


def judge(case: Case) -> Iterator[Verdict]:
    """Find boots of the same name, one after the other."""
    items, systems = case.instances.items, case.instances.systems
    order = sorted(range(len(items)), key=lambda index: items[index].first_ns)
    for at, index in enumerate(order):
        later = items[index]
        earlier = next(
            (
                items[before]
                for before in reversed(order[:at])
                if systems[before] == systems[index] and items[before].last_ns < later.first_ns
            ),
            None,
        )
        if earlier is None or not (earlier.name or later.name):
            continue
        down = [
            loss
            for loss in case.losses
            if loss.kind == "down" and earlier.last_ns - SECOND <= loss.start_ns <= later.first_ns
        ]
        lost = sum(loss.lost for loss in down)
        meanwhile = (
            f"{plural(lost, 'command')} sent meanwhile reached nobody" if lost else "counts begin again"
        )
        yield Verdict(
            ID,
            Severity.ERROR if lost else Severity.WARNING,
            f"{case.label(index)} restarted between {case.at(earlier.last_ns)} and "
            f"{case.at(later.first_ns)}: {meanwhile}",
            msg_id=down[0].msg_id if len(down) == 1 else None,
            topic=case.topic(down[0].msg_id) if len(down) == 1 else None,
            link="ci" if down else None,
            hop="cFS",
            lost=lost or None,
            of=sum(loss.of or 0 for loss in down) or None,
            start_ns=earlier.last_ns,
            end_ns=later.first_ns,
            evidence=(
                (
                    "mission time against the capture's moved by "
                    f"{(later.offset_ns - earlier.offset_ns) / SECOND:.1f} s"
                ),
                *(line for loss in down for line in loss.evidence),
            ),
            remedy="commands sent in between reached nobody; enable Telemetry Output again: "
            f"{case.inject(ENABLE_OUTPUT)}",
        )
