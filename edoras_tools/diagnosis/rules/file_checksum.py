"""A file that CFDP transferred, or a PDU, has another checksum than its sender says."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.cfdp import CFDP
from edoras_tools.wire.cfdp import ConditionCode
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "file_checksum"


def judge(case: Case) -> Iterator[Verdict]:
    """Name each file whose receiver says so, or whose captured bytes have another checksum than EOF.

    Count PDUs whose own CRC is wrong.
    """
    for item in case.capture.files:
        told = item.condition == ConditionCode.FILE_CHECKSUM_FAILURE
        if told or item.checksum_right is False:
            who = "Finished says so" if told else "calculated from the captured bytes, against that of EOF"
            yield Verdict(
                ID,
                Severity.ERROR,
                f"{item.title} arrived with a wrong checksum",
                link=CFDP.label,
                hop=item.hop,
                start_ns=item.first_ns,
                end_ns=item.last_ns,
                evidence=(who,),
                remedy="send it again; if it happens again, both entities may use different checksum types",
            )
    if count := case.capture.corrupt_pdus:
        yield Verdict(
            ID,
            Severity.WARNING,
            f"{plural(count, 'CFDP PDU')} came with a wrong CRC",
            link=CFDP.label,
            hop="between CFDP entities",
            start_ns=case.capture.corrupt_ns[0],
            end_ns=case.capture.corrupt_ns[1],
            evidence=("calculated from the captured bytes; the receiver drops such a PDU",),
            remedy="look for what changes bytes on the way; what is missing is sent again in class 2 only",
        )
