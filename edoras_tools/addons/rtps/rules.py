"""The balance of DDS samples, written, captured and missing ones of each writer, and verdicts on it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.addons.rtps.link import RTPS
from edoras_tools.addons.rtps.wire import PREFIX_BYTES, guid_text
from edoras_tools.addons.rtps.writers import SampleFollower, TopicWriter
from edoras_tools.diagnosis.ledger import Row
from edoras_tools.diagnosis.missing import Missing
from edoras_tools.diagnosis.verdict import Severity, Verdict, verdict
from edoras_tools.model import NO_MSG_ID
from edoras_tools.words import listed, plural

if TYPE_CHECKING:
    from edoras_tools.diagnosis.case import Case

_HOP: Final = "DDS"
_CAUSES: Final = {
    "given_up": "asked for in vain by a reader of DDS",
    "before_capture": "lost before the capture, on DDS",
}
_COUNTED: Final = {"in": "sequence numbers and HEARTBEATs", "out": "samples in the capture"}


def _sample_verdict(
    severity: Severity, item: TopicWriter, reason: str, *evidence: str, **about: Any
) -> Verdict:
    """Return a verdict on the samples of one writer; ``about`` has its further attributes."""
    span = item.writer.first_ns, item.writer.last_ns
    of_writer: Any = {"topic": item.topic, "link": RTPS.label, "hop": _HOP, "span": span}
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
        hop=_HOP,
        came=writer.written,
        out=writer.captured - fates["lost_behind"],
        lost={cause: number for cause, number in lost.items() if number},
        waiting=fates["waiting"],
        not_captured=fates["not_captured"] + (unseen if drops else 0),
        unaccounted=fates["unclear"],
        counted=_COUNTED,
        topic=item.topic,
    )


def _writers(case: Case) -> tuple[TopicWriter, ...]:
    follower = case.capture.evidence_of(RTPS, SampleFollower)
    return follower.topic_writers() if follower else ()


def dds_lost(case: Case) -> Iterator[Verdict]:
    """Samples of DDS were lost, and not sent again.

    Name each writer of which samples did not come, or did not come to a reader that asked for them.
    """
    for item in _writers(case):
        writer, row = item.writer, _row(item, case.capture.drops)
        unseen, given_up = (row.lost.get(cause, 0) for cause in ("before_capture", "given_up"))
        if not row.lost:
            continue
        ways = []
        if unseen:
            ways.append(f"{unseen:,} did not come to the capture: nothing sends them again")
        if given_up:
            ways.append(f"{given_up:,} were asked for, and the writer did not have them any more")
        yield _sample_verdict(
            Severity.ERROR,
            item,
            f"{unseen + given_up:,} of {plural(writer.written, 'sample')} of {item.topic} lost: "
            f"{'; '.join(ways)}",
            f"writer {guid_text(writer.guid)}, sequence numbers {writer.first} to {writer.last}",
            f"{writer.captured:,} captured, {writer.copies:,} copies of them left out",
            lost=unseen + given_up,
            of=writer.written,
            remedy="reliable endpoints send again what is lost; a deeper history keeps it for longer",
        )


def dds_no_samples(case: Case) -> Iterator[Verdict]:
    """Participants of DDS announce topics, and no sample of any is in the capture.

    Say whether they can reach each other through shared memory, which no capture sees. A note where the
    capture has traffic of cFS: it may have been made for that.
    """
    follower = case.capture.evidence_of(RTPS, SampleFollower)
    if follower is None or follower.topic_writers():
        return
    announced = follower.announcements()
    participants = {item.guid[:PREFIX_BYTES] for item in announced}
    writers = [item for item in announced if item.is_writer and item.ros_topic.startswith("/")]
    topics = sorted({item.ros_topic for item in writers})
    if not participants:
        return
    shared = bool(topics) and all(item.shared_memory for item in writers)
    why = "; they share memory, which no capture sees" if shared else ""
    yield verdict(
        Severity.NOTE if len(case.rows) else Severity.ERROR,
        f"no sample of DDS is in the capture: {plural(len(participants), 'participant')}, "
        f"{plural(len(topics), 'topic')} announced{why}",
        f"{plural(follower.datagrams, 'datagram')} of discovery and acknowledgement",
        *([f"writers announced on {listed(topics, 8)}"] if topics else ()),
        *(["each of them announces a locator of shared memory"] if shared else ()),
        link=RTPS.label,
        hop=_HOP,
        span=(follower.first_ns, follower.last_ns),
        remedy="set FASTDDS_BUILTIN_TRANSPORTS=UDPv4 where the nodes start, and capture again"
        if shared
        else "capture while something is published, where it passes",
    )


def dds_not_captured(case: Case) -> Iterator[Verdict]:
    """Readers of DDS have samples that the capture lacks.

    Name each writer of which a reader acknowledged samples that were not captured.
    """
    for item in _writers(case):
        writer, missing = item.writer, _row(item, case.capture.drops).not_captured
        if not missing:
            continue
        yield _sample_verdict(
            Severity.NOTE,
            item,
            f"{missing:,} of {plural(writer.written, 'sample')} of {item.topic} are not in the capture: they "
            "are not known to be lost",
            f"writer {guid_text(writer.guid)}",
            f"{writer.fates()['not_captured']:,} were acknowledged by a reader",
            *case.drops_text(),
            remedy="capture where they pass: at the reader's host, on its interface, or on lo for one host",
        )


def dds_resent(case: Case) -> Iterator[Verdict]:
    """Samples of DDS were lost at first, and sent again.

    Name each writer whose readers asked for samples, and got them.
    """
    for item in _writers(case):
        writer = item.writer
        if not writer.resent:
            continue
        before = writer.asked_for - writer.behind
        yield _sample_verdict(
            Severity.NOTE,
            item,
            f"{writer.resent:,} of {plural(writer.written, 'sample')} of {item.topic} were asked for again, "
            "and came or were acknowledged then",
            f"writer {guid_text(writer.guid)}, ACKNACKs of its readers",
            f"{writer.behind:,} had been captured by then: lost or late behind that; {before:,} had not",
            remedy="nothing is lost; look at the network if it delays what a robot needs at once",
        )
