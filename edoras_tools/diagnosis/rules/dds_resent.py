"""Samples of DDS were lost at first, and sent again."""

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

ID = "dds_resent"


def judge(case: Case) -> Iterator[Verdict]:
    """Name each writer whose readers asked for samples, and got them."""
    for item in case.capture.samples:
        writer = item.writer
        if not writer.resent:
            continue
        before = writer.asked_for - writer.behind
        yield sample_verdict(
            ID,
            Severity.NOTE,
            item,
            f"{writer.resent:,} of {plural(writer.written, 'sample')} of {item.topic} were asked for again, "
            "and came or were acknowledged then",
            evidence=(
                f"writer {guid_text(writer.guid)}, ACKNACKs of its readers",
                f"{writer.behind:,} had been captured by then: lost or late behind that; {before:,} had not",
            ),
            remedy="nothing is lost; look at the network if it delays what a robot needs at once",
        )
