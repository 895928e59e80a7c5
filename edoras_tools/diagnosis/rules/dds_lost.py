"""Samples of DDS were lost, and not sent again."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.samples import sample_verdict
from edoras_tools.diagnosis.verdict import Severity
from edoras_tools.wire.rtps.messages import guid_text
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.verdict import Verdict

ID = "dds_lost"


def judge(case: Case) -> Iterator[Verdict]:
    """Name each writer of which samples did not come, or did not come to a reader that asked for them."""
    for item in case.capture.samples:
        writer, fates = item.writer, item.writer.fates()
        unseen = 0 if case.capture.drops else fates["missing"]
        given_up = fates["given_up"] + fates["lost_behind"]
        if not unseen + given_up:
            continue
        ways = []
        if unseen:
            ways.append(f"{unseen:,} did not come to the capture: nothing sends them again")
        if given_up:
            ways.append(f"{given_up:,} were asked for, and the writer did not have them any more")
        yield sample_verdict(
            ID,
            Severity.ERROR,
            item,
            f"{unseen + given_up:,} of {plural(writer.written, 'sample')} of {item.topic} lost: "
            f"{'; '.join(ways)}",
            lost=unseen + given_up,
            of=writer.written,
            evidence=(
                f"writer {guid_text(writer.guid)}, sequence numbers {writer.first} to {writer.last}",
                f"{writer.captured:,} captured, {writer.copies:,} copies of them left out",
            ),
            remedy="reliable endpoints send again what is lost; a deeper history keeps it for longer",
        )
