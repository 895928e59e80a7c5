"""A file that CFDP transferred did not arrive, or the capture does not show that it did."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.cfdp import CFDP
from edoras_tools.units import SECOND
from edoras_tools.wire.cfdp import ConditionCode
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "file_not_finished"
_GOING_ON_NS: Final = 10 * SECOND
"""A transaction with a PDU so short before the end of the capture may go on behind it."""


def judge(case: Case) -> Iterator[Verdict]:
    """Name each transaction that was cancelled, ended with a fault, or has no end."""
    end_ns = max((case.end_ns, *(item.last_ns for item in case.capture.files)))
    for item in case.capture.files:
        if item.state == "finished" or item.condition == ConditionCode.FILE_CHECKSUM_FAILURE:
            continue
        severity, how = Severity.ERROR, f"ended with {item.state}"
        if item.condition == ConditionCode.CANCEL_REQUEST_RECEIVED:
            severity, how = Severity.WARNING, "was cancelled"
        elif not item.condition:
            going_on = end_ns - item.last_ns < _GOING_ON_NS
            severity = Severity.NOTE if going_on else Severity.ERROR
            how = "was not finished when the capture ended" if going_on else "was never finished"
        size = "?" if item.file_size is None else f"{item.file_size:,}"
        ends = {"EOF": item.eof, **({"Finished": item.finished} if item.acknowledged else {})}
        seen = [f"{name} was {'not ' * (told is None)}captured" for name, told in ends.items()]
        yield Verdict(
            ID,
            severity,
            f"the transfer of {item.title} {how}: {item.received.size:,} of {size} bytes were captured",
            link=CFDP.label,
            hop=item.hop,
            start_ns=item.first_ns,
            end_ns=item.last_ns,
            evidence=(
                ", ".join(seen),
                f"{plural(len(item.holes), 'hole')}, {plural(item.naks, 'NAK')} that ask for something",
            ),
            remedy="look at both entities, and at what lies between; edoras files takes out what there is",
        )
