"""Space packets between F Prime and its ground system that were lost: gaps in their counts, by APID."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from edoras_tools.addons.fprime.link import FPRIME, SPACE_PACKET, read_ground_frames
from edoras_tools.decode.columns import blank_columns
from edoras_tools.diagnosis.verdict import Verdict, error
from edoras_tools.links.doors import LinkEvidence
from edoras_tools.model import Columns, Datagram, Finding, PacketBatch
from edoras_tools.sessions.sequence import MODULUS, SequenceCounts, SequenceStream
from edoras_tools.wire import ccsds
from edoras_tools.wire.arrays import gather
from edoras_tools.words import plural

if TYPE_CHECKING:
    from edoras_tools.diagnosis.case import Case


def fprime_packets_lost(case: Case) -> Iterator[Verdict]:
    """Space packets between F Prime and its ground system were lost, by the sequence counts of their APIDs.

    Name each APID of each sender whose counts have gaps.
    """
    counts = case.capture.evidence_of(FPRIME, GroundCounts)
    for item in counts.streams if counts else ():
        lost = item.counts.gaps
        if not lost:
            continue
        of = item.counts.packets - item.counts.duplicates + lost
        way = "to" if item.command else "from"
        evidence = [f"sequence counts: {lost:,} missing of {of:,}"]
        if item.counts.restarts:
            evidence.append(f"the count began anew {plural(item.counts.restarts, 'time')}")
        yield error(
            f"{item.name} {way} F Prime: {plural(lost, 'packet')} lost of {of:,}",
            *evidence,
            link=FPRIME.label,
            hop=f"{item.source} to {item.destination}",
            lost=lost,
            of=of,
            span=(item.first_ns, item.last_ns),
            remedy="look for the loss between the two ends: radio, network, or a receiver's buffer",
        )


class GroundStream(msgspec.Struct, eq=False):
    """The space packets of one APID from one endpoint.

    Attributes:
        apid: APID.
        command: whether they go to F Prime, by their packet type bit.
        source: address and port of the sender, as text.
        destination: address and port that the first one went to.
        counts: sequence counts so far.
        first_ns: time of the first, ns since 1970.
        last_ns: time of the last, ns since 1970.
    """

    apid: int
    command: bool
    source: str
    destination: str
    counts: SequenceStream
    first_ns: int
    last_ns: int = 0

    @property
    def name(self) -> str:
        """Name for people: ``F Prime APID 2``."""
        return f"F Prime APID {self.apid}"


class GroundCounts(LinkEvidence):
    """Follows the sequence counts in batches, in order of the capture.

    Attributes:
        streams: streams in order of their first packet.
        datagrams: number of datagrams with such packets.
    """

    def __init__(self) -> None:
        self.streams: list[GroundStream] = []
        self.datagrams = 0
        self._counts = SequenceCounts()
        self._known: dict[int, GroundStream] = {}

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Add a batch; no contents can raise an error."""
        unsound = np.uint32(Finding.CHECKSUM_BAD | Finding.CAPTURE_CUT)
        rows = np.flatnonzero((columns.link == FPRIME) & (columns.findings & unsound == 0))
        if not len(rows):
            return
        read = read_ground_frames(batch.data, batch.offset[rows], batch.length[rows], checked=False)
        packets = read.packets
        framed = (packets.space >= 0) & (packets.start - packets.space >= SPACE_PACKET.size)
        packets = packets.take(framed)
        if not len(packets.row):
            return
        head = gather(batch.data, packets.space, SPACE_PACKET.size)
        word = head[:, :4].copy().view(">u2")
        part = batch.take(rows[packets.row])
        self.datagrams += len(np.unique(packets.row))
        # The first word of each packet takes the place of a MsgId.
        values = blank_columns(len(part)) | {
            "msg_id": word[:, 0].astype(np.int32),
            "link": np.full(len(part), FPRIME, np.uint8),
            "findings": (word[:, 1] == 0) * np.uint32(Finding.SEQUENCE_UNSET),
            "sequence_count": word[:, 1] & np.uint16(MODULUS - 1),
            "packet_offset": packets.space,
            "packet_length": (packets.end - packets.space).astype(np.int32),
        }
        stream = self._counts.follow(part, Columns(**values)).stream
        streams, first = np.unique(stream, return_index=True)
        for row, index in sorted(zip(first.tolist(), streams.tolist(), strict=True)):
            if index >= 0:
                if index not in self._known:
                    self._known[index] = self._begin(part[row], int(word[row, 0]), index)
                self._known[index].last_ns = int(part.time_ns[stream == index].max())

    def counts(self) -> list[SequenceStream]:
        """Return the counts of each stream."""
        return [item.counts for item in self.streams]

    def spans(self) -> list[tuple[int, int]]:
        """Return the first and last time of each stream."""
        return [(item.first_ns, item.last_ns) for item in self.streams]

    def _begin(self, packet: Datagram, identification: int, index: int) -> GroundStream:
        apid, command = identification & ccsds.IDLE_APID, identification >> 12 & 1 == ccsds.TELECOMMAND_TYPE
        ends, counts = (str(packet.source), str(packet.destination)), self._counts.streams[index]
        self.streams.append(GroundStream(apid, command, *ends, counts, packet.time_ns))
        return self.streams[-1]
