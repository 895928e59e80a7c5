"""Transfer frames were lost or damaged on their way, and packets with them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.frames import FRAMES
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "frames_lost"


def judge(case: Case) -> Iterator[Verdict]:
    """Name each virtual channel whose frame counts have gaps, or at whose borders packets are cut."""
    frames = case.capture.frames
    for item in frames.channels if frames else ():
        if not (item.lost or item.cut):
            continue
        evidence = [
            f"frame counts: {item.lost:,} missing of {item.frames + item.lost:,}",
            f"{plural(item.packets, 'packet')} came whole; at {plural(item.cut, 'place')} one was cut",
        ]
        evidence += [
            f"{master.name}: {master.lost:,} missing of {master.frames + master.lost:,}"
            for master in (frames.masters if frames else ())
            if (master.source, master.destination) == (item.source, item.destination)
            and master.spacecraft_id == item.spacecraft_id
        ]
        if frames and frames.damaged:
            evidence.append(f"{plural(frames.damaged, 'frame')} of all came damaged, and count as lost")
        yield Verdict(
            ID,
            Severity.ERROR,
            f"{item.name}: {plural(item.lost, 'frame')} lost of {item.frames + item.lost:,}, packets cut at "
            f"{plural(item.cut, 'place')}",
            link=FRAMES.label,
            hop=f"{item.source} to {item.destination}",
            start_ns=case.start_ns,
            end_ns=case.end_ns,
            evidence=tuple(evidence),
            remedy="look for the loss between the two ends: radio, modem, network, or a receiver's buffer",
        )
