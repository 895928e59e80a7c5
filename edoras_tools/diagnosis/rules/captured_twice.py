"""The same datagrams are in the capture more than once: on ``any`` or at two taps."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.verdict import Severity, Verdict

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "captured_twice"


def judge(case: Case) -> Iterator[Verdict]:
    """Say how many were counted once."""
    copies = case.prepared.copies
    if copies:
        yield Verdict(
            ID,
            Severity.NOTE,
            f"{copies:,} datagrams were captured twice, and are counted once",
            hop="capture",
            start_ns=case.start_ns,
            end_ns=case.end_ns,
            evidence=(
                "the same bytes with the same IP identification, or at another place, within ms",
                *(
                    f"{other} is another name of {name}: the same datagrams are there within ms, "
                    "and were only forwarded"
                    for other, name in case.prepared.translated.items()
                    if other != name
                ),
            ),
            remedy="capture on one interface instead of any, or at one place",
        )
