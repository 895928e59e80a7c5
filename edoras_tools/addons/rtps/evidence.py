"""The balance of DDS samples: written, captured and missing samples of each writer."""

from __future__ import annotations

from typing import Any, Final

from edoras_tools.addons.rtps.link import RTPS
from edoras_tools.addons.rtps.wire.messages import guid_text
from edoras_tools.addons.rtps.writers import SampleFollower, TopicWriter
from edoras_tools.diagnosis.ledger import Row
from edoras_tools.diagnosis.missing import Missing
from edoras_tools.diagnosis.verdict import Severity, Verdict, verdict
from edoras_tools.model import NO_MSG_ID

SAMPLE_HOP: Final = "DDS"
_CAUSES: Final = {
    "given_up": "asked for in vain by a reader of DDS",
    "before_capture": "lost before the capture, on DDS",
}
_COUNTED: Final = {"in": "sequence numbers and HEARTBEATs", "out": "samples in the capture"}


def sample_verdict(
    severity: Severity, item: TopicWriter, reason: str, *evidence: str, **about: Any
) -> Verdict:
    """Return a verdict on the samples of one writer; ``about`` has its further attributes."""
    span = item.writer.first_ns, item.writer.last_ns
    of_writer: Any = {"topic": item.topic, "link": RTPS.label, "hop": SAMPLE_HOP, "span": span}
    return verdict(severity, reason, *evidence, **of_writer, **about)


class SampleEvidence(SampleFollower):
    """The samples of every writer, as rows of the ledger."""

    def rows(self, drops: int | None) -> list[Row]:
        """Return a row for each writer, in the order of the capture."""
        return [_row(item, drops) for item in self.topic_writers()]

    def missing(self, drops: int | None) -> list[Missing]:
        """Return an entry for each writer and cause; only sequence numbers identify the samples."""
        entries = []
        for item in self.topic_writers():
            row, times = _row(item, drops), (item.writer.first_ns, item.writer.last_ns)
            for cause, count in row.lost.items():
                text = _CAUSES[cause]
                entries.append(
                    Missing(row.link, NO_MSG_ID, row.topic, count, *times, None, None, row.came, text)
                )
        return entries


def _row(item: TopicWriter, drops: int | None) -> Row:
    """Return the row of one writer."""
    writer, fates = item.writer, item.writer.fates()
    unseen = fates["missing"]
    lost = {"given_up": fates["given_up"] + fates["lost_behind"]}
    # If the capture itself lost frames, missing samples may be among them.
    lost["before_capture"] = 0 if drops else unseen
    return Row(
        link=RTPS.label,
        instance=guid_text(writer.guid),
        hop=SAMPLE_HOP,
        came=writer.written,
        out=writer.captured - fates["lost_behind"],
        lost={cause: number for cause, number in lost.items() if number},
        waiting=fates["waiting"],
        not_captured=fates["not_captured"] + (unseen if drops else 0),
        unaccounted=fates["unclear"],
        counted=_COUNTED,
        topic=item.topic,
    )
