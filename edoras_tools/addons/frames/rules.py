"""Transfer frames that were lost."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from edoras_tools.addons.frames.link import FRAMES
from edoras_tools.addons.frames.unframer import Unframer
from edoras_tools.diagnosis.verdict import Verdict, error
from edoras_tools.words import plural

if TYPE_CHECKING:
    from edoras_tools.diagnosis.case import Case


def frames_lost(case: Case) -> Iterator[Verdict]:
    """Transfer frames were lost or damaged on their way, and packets with them.

    Name each virtual channel whose frame counts have gaps, or at whose borders packets are cut.
    """
    frames = case.capture.evidence_of(FRAMES, Unframer)
    if frames is None:
        return
    for item in frames.channels:
        if not (item.lost or item.cut):
            continue
        evidence = [
            f"frame counts: {item.lost:,} missing of {item.frames + item.lost:,}",
            f"{plural(item.packets, 'packet')} came whole; at {plural(item.cut, 'place')} one was cut",
        ]
        evidence += [
            f"{master.name}: {master.lost:,} missing of {master.frames + master.lost:,}"
            for master in frames.masters
            if (master.source, master.destination) == (item.source, item.destination)
            and master.spacecraft_id == item.spacecraft_id
        ]
        if frames.damaged:
            evidence.append(f"{plural(frames.damaged, 'frame')} of all came damaged, and count as lost")
        yield error(
            f"{item.name}: {plural(item.lost, 'frame')} lost of {item.frames + item.lost:,}, packets cut at "
            f"{plural(item.cut, 'place')}",
            *evidence,
            link=FRAMES.label,
            hop=f"{item.source} to {item.destination}",
            remedy="look for the loss between the two ends: radio, modem, network, or a receiver's buffer",
        )
