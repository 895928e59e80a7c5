"""Samples of DDS."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.addons.rtps.evidence import SAMPLE_HOP, sample_verdict
from edoras_tools.addons.rtps.link import RTPS
from edoras_tools.addons.rtps.wire.headers import PREFIX_BYTES
from edoras_tools.addons.rtps.wire.messages import guid_text
from edoras_tools.addons.rtps.writers import SampleFollower, TopicWriter
from edoras_tools.diagnosis.verdict import Severity, Verdict, verdict
from edoras_tools.words import listed, plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case


def _writers(case: Case) -> tuple[TopicWriter, ...]:
    follower = case.capture.evidence_of(RTPS, SampleFollower)
    return follower.topic_writers() if follower else ()


def dds_lost(case: Case) -> Iterator[Verdict]:
    """Samples of DDS were lost, and not sent again.

    Name each writer of which samples did not come, or did not come to a reader that asked for them.
    """
    for item in _writers(case):
        writer, fates = item.writer, item.writer.fates()
        unseen = 0 if case.capture.drops else fates["missing"]
        given_up = fates["given_up"] + fates["lost_behind"]
        if not unseen + given_up:
            continue
        ways = []
        if unseen:
            ways.append(f"{unseen:,} did not come to the capture: nothing sends them again")
        if given_up:
            ways.append(f"{given_up:,} were asked for, and the writer did not have them any more")
        yield sample_verdict(
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
        hop=SAMPLE_HOP,
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
        writer, fates = item.writer, item.writer.fates()
        missing = fates["not_captured"] + (fates["missing"] if case.capture.drops else 0)
        if not missing:
            continue
        yield sample_verdict(
            Severity.NOTE,
            item,
            f"{missing:,} of {plural(writer.written, 'sample')} of {item.topic} are not in the capture: they "
            "are not known to be lost",
            f"writer {guid_text(writer.guid)}",
            f"{fates['not_captured']:,} were acknowledged by a reader",
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
        yield sample_verdict(
            Severity.NOTE,
            item,
            f"{writer.resent:,} of {plural(writer.written, 'sample')} of {item.topic} were asked for again, "
            "and came or were acknowledged then",
            f"writer {guid_text(writer.guid)}, ACKNACKs of its readers",
            f"{writer.behind:,} had been captured by then: lost or late behind that; {before:,} had not",
            remedy="nothing is lost; look at the network if it delays what a robot needs at once",
        )
