"""Records of the file that stand behind later ones."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.verdict import Severity, Verdict

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "out_of_order"


def too_many(start_ns: int, end_ns: int, most: int) -> Verdict:
    """Return what has to be said first where they are too many to be sorted."""
    return Verdict(
        ID,
        Severity.ERROR,
        f"the whole capture is out of time order, and holds more than the {most:,} datagrams that can be "
        "sorted: it is judged in parts, and what is said of loss, order and restarts is not right",
        hop="capture",
        start_ns=start_ns,
        end_ns=end_ns,
        remedy="put it in order first: reordercap IN OUT",
    )


def judge(case: Case) -> Iterator[Verdict]:
    """Say that they were sorted."""
    count = case.prepared.disordered
    if count:
        yield Verdict(
            ID,
            Severity.NOTE,
            f"{count:,} records of the capture stand behind later ones; all were put in order of time",
            hop="capture",
            start_ns=case.start_ns,
            end_ns=case.end_ns,
            evidence=("capture times run back, and the times in cFS's packets with them",),
            remedy="none; reordercap writes such a file in order",
        )
