"""An example of a link that keeps state: what the doors of the radio link open.

The modem counts its frames, so that lost ones show, and says how well it was heard: that becomes messages.
This file is loaded with the first datagram of the link.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from edoras_radio_link import HEADER, PORT, RADIO

from edoras_tools.diagnosis.verdict import Verdict, error
from edoras_tools.io.topics.messages import APART, RECORD, Messages, whole_messages
from edoras_tools.links.doors import LinkEvidence
from edoras_tools.links.protocol import LinkSending
from edoras_tools.wire.arrays import PADDING, by_value, gather

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.links.doors import TopicSpace
    from edoras_tools.model import Columns, Link, PacketBatch

TYPE: Final = "std_msgs/msg/Int8"
_ENCAPSULATION: Final = b"\0\1\0\0"
_COUNTS: Final = 1 << HEADER.by_name["frame_count"].field.bits
_LONGEST_GAP: Final = 1000
"""A larger step of the count is a modem that was started again."""


def _headers(batch: PacketBatch, columns: Columns) -> tuple[NDArray[np.intp], NDArray[np.uint8]]:
    """Return the rows of the link, and their headers, u8 (n, 6)."""
    rows = np.flatnonzero(columns.link == RADIO)
    rows = rows[batch.length[rows] >= HEADER.size]
    return rows, gather(batch.data, batch.offset[rows], HEADER.size)


@dataclass(slots=True)
class Station:
    """What one ground station heard.

    Attributes:
        first_ns: time of its first frame.
        last_ns: time of its last frame.
        count: frame count of the last one.
        frames: those that were captured.
        lost: those that the count shows to be missing.
        weakest: signal, dBm.
        strongest: signal, dBm.
    """

    first_ns: int
    last_ns: int
    count: int
    frames: int = 0
    lost: int = 0
    weakest: int = 127
    strongest: int = -128


class RadioFrames(LinkEvidence):
    """The door ``follow`` and the door ``evidence``: follows the frame counts of each station.

    Attributes:
        stations: by number.
    """

    def __init__(self) -> None:
        self.stations: dict[int, Station] = {}

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Take a batch; they come in order."""
        rows, headers = _headers(batch, columns)
        counts, signals = (HEADER.column(name, headers).astype(int) for name in ("frame_count", "signal_dbm"))
        for number, at in by_value(HEADER.column("station", headers)):
            times = batch.time_ns[rows[at]]
            begin = Station(int(times[0]), 0, int(counts[at[0]]) - 1)
            item = self.stations.setdefault(int(number), begin)
            steps = np.diff(counts[at], prepend=item.count) % _COUNTS
            item.lost += int((steps[(steps > 0) & (steps <= _LONGEST_GAP)] - 1).sum())
            item.count, item.last_ns = int(counts[at[-1]]), int(times[-1])
            item.frames += len(at)
            item.weakest = min(item.weakest, int(signals[at].min()))
            item.strongest = max(item.strongest, int(signals[at].max()))

    def spans(self) -> list[tuple[int, int]]:
        """Return from when to when each station heard something."""
        return [(item.first_ns, item.last_ns) for item in self.stations.values()]


def radio_frames_lost(case: Case) -> Iterator[Verdict]:
    """Frames of the radio modem were lost.

    Name each station whose frame counts have gaps. The packets in them count for themselves.
    """
    follower = case.capture.evidence_of(RADIO, RadioFrames)
    for number, item in sorted(follower.stations.items()) if follower else ():
        if item.lost:
            whole = item.frames + item.lost
            yield error(
                f"station {number} did not hear {item.lost:,} of {whole:,} frames",
                f"frame counts; signal {item.weakest} to {item.strongest} dBm",
                link=RADIO.label,
                hop="radio",
                span=(item.first_ns, item.last_ns),
                remedy="look at the antenna, the power and the distance",
            )


class SignalTopics:
    """The door ``topics``: a message for each frame, on a topic for each station.

    Args:
        space: the topics of the recording.
    """

    def __init__(self, space: TopicSpace) -> None:
        self._space, self._used = space, space.used_names()

    def offer(self) -> None:
        """Do nothing: a topic comes with its first frame."""

    def messages(self, batch: PacketBatch, columns: Columns) -> list[Messages]:
        """Return the messages of a batch: CDR of one byte behind its encapsulation."""
        rows, headers = _headers(batch, columns)
        signals = HEADER.column("signal_dbm", headers).astype(np.int8)
        counts = HEADER.column("frame_count", headers).astype(np.int64)
        made = []
        for number, at in by_value(HEADER.column("station", headers)):
            name = f"/radio/station_{number}/signal_dbm"
            name = f"{APART}{name}" if name in self._used else name
            channel = self._space.place(name, TYPE, {"link": RADIO.label})
            size = np.full(len(at), len(_ENCAPSULATION) + 1, np.int32)
            start = np.cumsum(size, dtype=np.int64) - size
            data = np.zeros(int(size.sum()) + PADDING, np.uint8)
            each = data[: int(size.sum())].reshape(-1, int(size[0]))
            each[:, :-1] = np.frombuffer(_ENCAPSULATION, np.uint8)
            each[:, -1] = signals[at].view(np.uint8)
            row, heads = rows[at], np.empty(len(at), np.dtype(RECORD))
            times = batch.time_ns[row]
            bodies = (data, start, size)
            made.append(whole_messages(row, heads, channel, counts[at], times, times, bodies, repeats=True))
        return made


class RadioSending(LinkSending):
    """The door ``send``: frames with counts of their own, from 0, as those of a modem that was started."""

    port = PORT
    renews = True
    instead = "the modem puts its header before what edoras inject --to ci sends to it"

    def __init__(self, link: Link, *, up: bool) -> None:
        super().__init__(link)
        self._up = up

    def outgoing_rows(self, batch: PacketBatch, columns: Columns) -> NDArray[np.bool_]:
        """Tell which frames go this way: commands up, telemetry down."""
        command = (columns.msg_id & 0x1800) == 0x1800
        way = (columns.msg_id >= 0) & (command == self._up)
        return np.asarray(super().outgoing_rows(batch, columns) & way)

    def renew(
        self, messages: Sequence[bytes], time_ns: NDArray[np.int64]
    ) -> tuple[list[bytes], NDArray[np.int64]]:
        """Count the frames of each station anew."""
        counts: dict[int, int] = {}
        made = []
        for data in messages:
            header = HEADER.parse(data)
            count = counts[header["station"]] = counts.get(header["station"], -1) + 1
            made.append(HEADER.emit({**header, "frame_count": count % _COUNTS}) + data[HEADER.size :])
        return made, time_ns
