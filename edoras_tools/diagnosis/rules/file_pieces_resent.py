"""Pieces of files were lost on the way and sent again."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.cfdp import CFDP
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "file_pieces_resent"


def judge(case: Case) -> Iterator[Verdict]:
    """Count the pieces of each transaction that came again or late; CFDP has repaired what is finished."""
    for item in case.capture.files:
        again = item.resent + item.filled
        if again:
            yield Verdict(
                ID,
                Severity.NOTE,
                f"{plural(again, 'piece')} of {item.title} came again or late, of {item.segments:,}",
                link=CFDP.label,
                hop=item.hop,
                start_ns=item.first_ns,
                end_ns=item.last_ns,
                evidence=(
                    f"{item.resent:,} had been captured before: lost behind the capture, or sent twice",
                    f"{item.filled:,} filled a hole: lost in front of the capture, or overtaken",
                    f"{plural(item.naks, 'NAK')} asked for something",
                ),
                remedy="nothing, if this is rare; else send more slowly, or look for what loses datagrams",
            )
