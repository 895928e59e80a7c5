"""Readers of DDS have samples that the capture lacks."""

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

ID = "dds_not_captured"


def judge(case: Case) -> Iterator[Verdict]:
    """Name each writer of which a reader acknowledged samples that were not captured."""
    for item in case.capture.samples:
        writer, fates = item.writer, item.writer.fates()
        missing = fates["not_captured"] + (fates["missing"] if case.capture.drops else 0)
        if not missing:
            continue
        yield sample_verdict(
            ID,
            Severity.NOTE,
            item,
            f"{missing:,} of {plural(writer.written, 'sample')} of {item.topic} are not in the capture: they "
            "are not known to be lost",
            evidence=(
                f"writer {guid_text(writer.guid)}",
                f"{fates['not_captured']:,} were acknowledged by a reader",
                *case.drops_text(),
            ),
            remedy="capture where they pass: at the reader's host, on its interface, or on lo for one host",
        )
