"""Space packets between F Prime and its ground system that were lost."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.addons.fprime.counts import GroundCounts
from edoras_tools.addons.fprime.link import FPRIME
from edoras_tools.diagnosis.verdict import Verdict, error
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case


def fprime_packets_lost(case: Case) -> Iterator[Verdict]:
    """Space packets between F Prime and its ground system were lost, by the sequence counts of their APIDs.

    Name each APID of each sender whose counts have gaps.
    """
    counts = case.capture.evidence_of(FPRIME, GroundCounts)
    for item in counts.streams if counts else ():
        lost = item.counts.gaps
        if not lost:
            continue
        of = item.counts.packets - item.counts.duplicates + lost
        way = "to" if item.command else "from"
        evidence = [f"sequence counts: {lost:,} missing of {of:,}"]
        if item.counts.restarts:
            evidence.append(f"the count began anew {plural(item.counts.restarts, 'time')}")
        yield error(
            f"{item.name} {way} F Prime: {plural(lost, 'packet')} lost of {of:,}",
            *evidence,
            link=FPRIME.label,
            hop=f"{item.source} to {item.destination}",
            lost=lost,
            of=of,
            span=(item.first_ns, item.last_ns),
            remedy="look for the loss between the two ends: radio, network, or a receiver's buffer",
        )
