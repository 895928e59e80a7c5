"""Files that CFDP transfers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

from edoras_tools.addons.cfdp.link import CFDP, ConditionCode
from edoras_tools.addons.cfdp.transactions import FileEvidence, Transaction
from edoras_tools.diagnosis.verdict import Severity, Verdict, verdict, warning
from edoras_tools.units import SECOND
from edoras_tools.words import plural

if TYPE_CHECKING:
    from edoras_tools.diagnosis.case import Case


def _followed(case: Case) -> FileEvidence:
    return case.capture.evidence_of(CFDP, FileEvidence) or FileEvidence()


def _verdict(severity: Severity, item: Transaction, reason: str, *evidence: str, remedy: str) -> Verdict:
    """Return a verdict on one transaction."""
    span = item.first_ns, item.last_ns
    return verdict(severity, reason, *evidence, link=CFDP.label, hop=item.hop, span=span, remedy=remedy)


def file_checksum(case: Case) -> Iterator[Verdict]:
    """A file that CFDP transferred, or a PDU, has another checksum than its sender says.

    Name each file whose receiver says so, or whose captured bytes have another checksum than EOF.

    Count PDUs whose own CRC is wrong.
    """
    for item in _followed(case).transactions:
        failed = item.condition == ConditionCode.FILE_CHECKSUM_FAILURE
        if failed or item.checksum_right is False:
            who = "Finished says so" if failed else "calculated from the captured bytes, against that of EOF"
            yield _verdict(
                Severity.ERROR,
                item,
                f"{item.title} arrived with a wrong checksum",
                who,
                remedy="send it again; if it happens again, both entities may use different checksum types",
            )
    if count := _followed(case).corrupt:
        yield warning(
            f"{plural(count, 'CFDP PDU')} came with a wrong CRC",
            "calculated from the captured bytes; the receiver drops such a PDU",
            link=CFDP.label,
            hop="between CFDP entities",
            span=_followed(case).corrupt_ns,
            remedy="look for what changes bytes on the way; what is missing is sent again in class 2 only",
        )


_GOING_ON_NS: Final = 10 * SECOND
"""Time before the end of the capture in which a PDU means that its transaction may go on."""


def file_not_finished(case: Case) -> Iterator[Verdict]:
    """A file that CFDP transferred did not arrive, or the capture does not show that it did.

    Name each transaction that was cancelled, ended with a fault, or has no end.
    """
    end_ns = max((case.end_ns, *(item.last_ns for item in _followed(case).transactions)))
    for item in _followed(case).transactions:
        if item.state == "finished" or item.condition == ConditionCode.FILE_CHECKSUM_FAILURE:
            continue
        cancelled = item.condition == ConditionCode.CANCEL_REQUEST_RECEIVED
        severity = Severity.WARNING if cancelled else Severity.ERROR
        how = "was cancelled" if cancelled else f"ended with {item.state}"
        if not item.condition:
            # If pieces are missing after everything was sent, the transaction is not merely going on.
            going_on = end_ns - item.last_ns < _GOING_ON_NS and not (item.eof is not None and item.holes)
            severity = Severity.NOTE if going_on else Severity.ERROR
            how = "was not finished when the capture ended" if going_on else "was never finished"
        size = "?" if item.file_size is None else f"{item.file_size:,}"
        ends = {"EOF": item.eof, **({"Finished": item.finished} if item.acknowledged else {})}
        parts = [f"{name} was {'not ' * (end is None)}captured" for name, end in ends.items()]
        yield _verdict(
            severity,
            item,
            f"the transfer of {item.title} {how}: {item.received.size:,} of {size} bytes were captured",
            ", ".join(parts),
            f"{plural(len(item.holes), 'hole')}, {plural(item.naks, 'NAK')} that ask for something",
            remedy="look at both entities, and at what lies between; edoras files takes out what there is",
        )


_LONG_NS: Final = 10 * SECOND
"""Least time of a standstill: twice the usual interval of the timers for ACK and NAK."""


def file_stalled(case: Case) -> Iterator[Verdict]:
    """A file that CFDP transferred stood still for a while.

    Name each transaction in which neither side said anything for long, and that went on then.
    """
    for item in _followed(case).transactions:
        if item.silence_ns > _LONG_NS:
            yield _verdict(
                Severity.WARNING,
                item,
                f"the transfer of {item.title} stood still for {item.silence_ns / SECOND:.1f} s, and went on",
                "the longest time between two of its PDUs",
                remedy="look for an outage of the link, or a suspended entity",
            )


def file_pieces_resent(case: Case) -> Iterator[Verdict]:
    """Pieces of files were lost on the way and sent again.

    Count the pieces of each transaction that came again or late; CFDP has repaired what is finished.
    """
    for item in _followed(case).transactions:
        again = item.resent + item.filled
        if again:
            yield _verdict(
                Severity.NOTE,
                item,
                f"{plural(again, 'piece')} of {item.title} came again or late, of {item.segments:,}",
                f"{item.resent:,} had been captured before: lost behind the capture, or sent twice",
                f"{item.filled:,} filled a hole: lost in front of the capture, or overtaken",
                f"{plural(item.naks, 'NAK')} asked for something",
                remedy="nothing, if this is rare; else send more slowly, or look for what loses datagrams",
            )
