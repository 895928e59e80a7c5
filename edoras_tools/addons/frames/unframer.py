"""Extracts space packets from CCSDS transfer frames: adds rows of packets to the rows of frames.

Rules that this file keeps:

1. The row of a frame stays as it was captured. A packet becomes a row of its own behind the frame in which
   it ends, with that frame's time, number and endpoints; its ``original_length`` is -1.
2. The frames of one virtual channel, from one endpoint to another, carry one stream of bytes. A frame
   continues the one before if its count is the next one, or if the sender does not count. If it does not, a
   packet across that border is cut: the frame behind the border gets ``STREAM_GAP``, and the bytes of that
   packet are left out. No other packet is touched.
3. A packet starts where a first header pointer points, or behind another packet. If the two contradict
   each other, the pointer is right and the packet is cut.
4. A damaged frame (its CRC is wrong, its header does not fit, or the capture cut it) counts as lost. A frame
   that repeats an earlier one with the same bytes is left out. A late frame is read, but joined to no other.
5. Idle packets, idle frames and packets that are not space packets are counted and left out.
6. Memory is bounded: at most one incomplete packet of each channel is kept, and the number of channels is
   limited.

All frames of a batch are laid out in one buffer, stream by stream. Packets are found in steps: each step
takes the next packet behind every pointer at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.addons.frames.link import frame_rows
from edoras_tools.decode.columns import blank_columns
from edoras_tools.io.frames.frame_batch import packets_behind
from edoras_tools.model import NO_MSG_ID, Columns, Finding, PacketBatch
from edoras_tools.sessions.sequence import MODULUS, SequenceCounts, SequenceStream
from edoras_tools.wire import arrays, ccsds
from edoras_tools.wire import transfer_frames as headers
from edoras_tools.wire.transfer_frames import LATE, FrameFormat, count_modulus
from edoras_tools.words import plural

if TYPE_CHECKING:
    from numpy.typing import NDArray


MOST_NOTES: Final = 8
"""Most channels in the notes."""
MOST_CHANNELS: Final = 1 << 10
"""Most channels that are followed, because random bytes could name any number; others are left out."""
_UNSOUND: Final = np.uint32(Finding.TRUNCATED | Finding.CHECKSUM_BAD | Finding.CAPTURE_CUT)
_NONE: Final = -1


class FrameChannel(msgspec.Struct, eq=False):
    """One virtual channel from one endpoint to another, or a master channel: all frames of a spacecraft.

    Attributes:
        kind: ``tm``, ``aos`` or ``tc``.
        source: address and port, as text.
        destination: address and port, as text.
        spacecraft_id: spacecraft in the frames' headers.
        virtual_channel_id: channel in the frames' headers; None for a master channel.
        has_count: whether its frames have a count; those of Type-B have none.
        frames: frames that were read, without damaged ones.
        idle: frames without packets.
        packets: packets that were extracted.
        idle_packets: idle packets, which were left out.
        other_packets: stretches of data that are not space packets.
        cut: borders between frames at which a packet was cut.
        counts: result of following the frame counts; None before the second frame that has one.
    """

    kind: str
    source: str
    destination: str
    spacecraft_id: int
    virtual_channel_id: int | None
    has_count: bool
    frames: int = 0
    idle: int = 0
    packets: int = 0
    idle_packets: int = 0
    other_packets: int = 0
    cut: int = 0
    counts: SequenceStream | None = None
    _last: int = _NONE
    _position: int = 0
    _run: int = 0
    _joined: int = _NONE

    @property
    def name(self) -> str:
        """Name for people: ``TM channel 1 of spacecraft 0x02a``."""
        which = "all channels" if self.virtual_channel_id is None else f"channel {self.virtual_channel_id}"
        return f"{self.kind.upper()} {which} of spacecraft 0x{self.spacecraft_id:03x}"

    def __str__(self) -> str:
        parts = [
            plural(self.frames, "frame"),
            f"{self.lost:,} lost" if self.has_count else "not counted",
            plural(self.packets, "packet"),
            *([f"{self.cut:,} cut"] if self.cut else []),
            *([f"{self.other_packets:,} no space packets"] if self.other_packets else []),
        ]
        return f"{self.name}: {', '.join(parts)}"

    @property
    def lost(self) -> int:
        """Frames that never arrived, or arrived damaged."""
        return self.counts.gaps if self.counts else 0

    def unwrapped(self, count: NDArray[np.integer[Any]]) -> NDArray[np.uint16]:
        """Return counts without the wrap of the frame count, modulo ``MODULUS``; u16 (n,)."""
        modulus = count_modulus(self.kind) if self.virtual_channel_id is not None else 1 << 8
        late = LATE if modulus == 1 << 8 else modulus // 2
        before = np.concatenate([[count[0] if self._last == _NONE else self._last], count[:-1]])
        step = (count.astype(np.int64) - before + late) % modulus - late
        # The follower takes a leap of half its modulus as a new beginning; greater leaps are cut to that
        # size.
        step[np.abs(step) > MODULUS // 2] = MODULUS // 2
        position = (self._position + np.cumsum(step)) % MODULUS
        self._last, self._position = int(count[-1]), int(position[-1])
        return position.astype(np.uint16)

    def runs(self, count: NDArray[np.integer[Any]]) -> arrays.Integers:
        """Return each frame's run number, i64 (n,): within a run, each frame continues the one before."""
        if not self.has_count:
            return np.full(len(count), self._run)
        before = np.concatenate([[self._joined], count[:-1].astype(np.int64)])
        step = (count.astype(np.int64) - before) % count_modulus(self.kind)
        breaks = step > 1
        if self._joined == _NONE:
            breaks[0] = False
        run = self._run + np.cumsum(breaks)
        self._run, self._joined = int(run[-1]), int(count[-1])
        return run


class _Stream(msgspec.Struct, eq=False):
    """The bytes of one channel, or of one MAP of it.

    Attributes:
        rest: bytes of the last packet, if it is incomplete.
        run: number of the run of frames that ``rest`` belongs to; ``_NONE`` before the first frame.
    """

    rest: bytes = b""
    run: int = _NONE


class _Frames(NamedTuple):
    """Sound frames, those of one stream side by side in order of arrival; i64 (n,) each.

    ``row`` is the row in the batch; ``channel`` and ``stream`` are indices into the lists of ``Unframer``;
    ``run``, ``start``, ``end`` and ``first`` are as in ``FrameChannel.runs`` and ``FrameFields``.
    """

    row: arrays.Integers
    channel: arrays.Integers
    stream: arrays.Integers
    run: arrays.Integers
    start: arrays.Integers
    end: arrays.Integers
    first: arrays.Integers


class Unframer(msgspec.Struct):
    """Extracts the packets from the frames of batches, in the order of their capture.

    Attributes:
        formats: format of the frames of each port.
        channels: virtual channels, in order of their first frame.
        masters: master channels of TM frames.
        damaged: frames whose header does not fit, whose CRC is wrong, or that the capture cut.
        strange: datagrams to these ports that are no such frames.
        left_out: frames of channels beyond the limit.
    """

    formats: Mapping[int, FrameFormat]
    channels: list[FrameChannel] = msgspec.field(default_factory=list)
    masters: list[FrameChannel] = msgspec.field(default_factory=list)
    damaged: int = 0
    strange: int = 0
    left_out: int = 0
    _numbers: dict[tuple[Any, ...], int] = msgspec.field(default_factory=dict)
    _master_of: list[int] = msgspec.field(default_factory=list)
    _streams: dict[tuple[int, int], int] = msgspec.field(default_factory=dict)
    _states: list[_Stream] = msgspec.field(default_factory=list)
    _counts: SequenceCounts = msgspec.field(default_factory=SequenceCounts)
    _master_counts: SequenceCounts = msgspec.field(default_factory=SequenceCounts)

    def take(self, batch: PacketBatch) -> PacketBatch:
        """Return a batch with the packets that end in it; the same batch if it has no frames."""
        rows, ports, strange = frame_rows(batch, self.formats)
        self.strange += strange
        if not len(rows):
            return batch
        batch = replace(batch, capture_findings=batch.capture_findings.copy())
        parts = [
            part
            for port, at in arrays.by_value(ports)
            if (part := self._read(batch, rows[at], self.formats[port])) is not None
        ]
        if not parts:
            return batch
        joined = [np.concatenate(column) for column in zip(*parts, strict=True)]
        order = np.lexsort((joined[0], joined[2]))
        return self._join(batch, _Frames(*(column[order] for column in joined)))

    @property
    def pieces(self) -> int:
        """Sound frames that were read."""
        return sum(item.frames for item in self.channels)

    def notes(self) -> list[str]:
        """Return lines for users: one for each channel, and one for each kind of error."""
        notes = [f"transfer frames: {item}" for item in self.channels[:MOST_NOTES]]
        more = len(self.channels) - len(notes)
        notes += [f"transfer frames: {plural(more, 'channel')} more"] * (more > 0)
        counts = (
            (self.damaged, "damaged (wrong CRC, or a header that does not fit)"),
            (self.strange, "to their ports of another kind or length"),
            (self.left_out, "left out: more channels than are followed"),
        )
        return notes + [f"transfer frames: {number:,} {trouble}" for number, trouble in counts if number]

    def _read(self, batch: PacketBatch, rows: arrays.Integers, form: FrameFormat) -> _Frames | None:
        """Read the frames of one port and follow their counts."""
        read = read_frames(batch.data, batch.offset[rows], batch.length[rows], form)
        batch.capture_findings[rows[~read.fits]] |= np.uint32(Finding.TRUNCATED)
        batch.capture_findings[rows[read.error]] |= np.uint32(Finding.CHECKSUM_BAD)
        sound = (batch.capture_findings[rows] & _UNSOUND) == 0
        self.damaged += len(rows) - int(np.count_nonzero(sound))
        rows, read = rows[sound], _selected(read, sound)
        channel = self._channels(batch, rows, read, form)
        kept_rows = channel >= 0
        self.left_out += len(rows) - int(np.count_nonzero(kept_rows))
        rows, read, channel = rows[kept_rows], _selected(read, kept_rows), channel[kept_rows]
        if not len(rows):
            return None
        again = self._follow(batch.take(rows), read, channel)
        rows, read, channel = rows[~again], _selected(read, ~again), channel[~again]
        run = np.zeros(len(rows), np.int64)
        for index, at in arrays.by_value(channel):
            state = self.channels[index]
            state.frames += len(at)
            state.idle += int(np.count_nonzero(read.idle[at]))
            run[at] = state.runs(read.count[at])
        streams = [
            self._streams.setdefault(key, len(self._streams))
            for key in zip(channel.tolist(), read.map_id.tolist(), strict=True)
        ]
        self._states += [_Stream() for _ in range(len(self._streams) - len(self._states))]
        return _Frames(rows, channel, np.array(streams, np.int64), run, read.start, read.end, read.first)

    def _channels(
        self, batch: PacketBatch, rows: arrays.Integers, read: FrameFields, form: FrameFormat
    ) -> arrays.Integers:
        """Return the index of the channel of each frame, ``_NONE`` beyond the limit; i64 (n,)."""
        if not len(rows):
            return rows
        ends = (
            batch.source_address,
            batch.source_port,
            batch.destination_address,
            batch.destination_port,
            batch.ip_version,
        )
        names = read.spacecraft_id, read.virtual_channel_id, read.has_count.view(np.uint8)
        first, which = arrays.numbered(*(column[rows] for column in ends), *names)
        numbers = []
        for at in first.tolist():
            packet = batch[int(rows[at])]
            source, destination = str(packet.source), str(packet.destination)
            craft, channel, has_count = (int(column[at]) for column in names)
            key = source, destination, craft, channel, has_count
            if key not in self._numbers and len(self.channels) < MOST_CHANNELS:
                self._numbers[key] = len(self.channels)
                entry = FrameChannel(form.kind, source, destination, craft, channel, bool(has_count))
                self.channels.append(entry)
                self._master_of.append(self._master(entry) if form.kind == "tm" else _NONE)
            numbers.append(self._numbers.get(key, _NONE))
        return np.array(numbers, np.int64)[which]

    def _master(self, channel: FrameChannel) -> int:
        """Return the index of the master channel of a new virtual channel."""
        for index, item in enumerate(self.masters):
            same = item.source, item.destination, item.spacecraft_id
            if same == (channel.source, channel.destination, channel.spacecraft_id):
                return index
        self.masters.append(replace(channel, virtual_channel_id=None))
        return len(self.masters) - 1

    def _follow(self, frames: PacketBatch, read: FrameFields, channel: arrays.Integers) -> arrays.Mask:
        """Follow the counts of both levels; return which frames repeat an earlier one, bool (n,)."""
        again = _followed(
            self._counts, frames, self.channels, np.where(read.has_count, channel, _NONE), read.count
        )
        master = np.array(self._master_of, np.int64)[channel]
        _followed(self._master_counts, frames, self.masters, master, read.master_count)
        for index, at in arrays.by_value(master):
            if index != _NONE:
                self.masters[index].frames += len(at)
        return again

    def _join(self, batch: PacketBatch, frames: _Frames) -> PacketBatch:
        """Lay the frames out stream by stream, and extract the packets."""
        if not len(frames.row):
            return batch
        laid = _Laid(batch, frames, self._states)
        cut = laid.settle()
        batch.capture_findings[frames.row[cut]] |= np.uint32(Finding.STREAM_GAP)
        idle = (laid.words() & ccsds.IDLE_APID) == ccsds.IDLE_APID
        owner = laid.owner()
        for index, at in arrays.by_value(frames.channel):
            channel = self.channels[index]
            own = frames.channel[owner] == index
            channel.cut += int(np.count_nonzero(cut[at]))
            channel.idle_packets += int(np.count_nonzero(own & idle))
            channel.packets += int(np.count_nonzero(own & ~idle))
            channel.other_packets += int(np.count_nonzero(frames.channel[laid.others()] == index))
        return packets_behind(
            batch, laid.buffer, frames.row[owner[~idle]], laid.start[~idle], laid.length[~idle]
        )


class _Laid:
    """Frames laid out in one buffer, stream by stream, and the packets in it.

    A segment is a stretch of the buffer with the frames of one run of one stream, behind the rest of the
    batch before. A pointer is a position where a packet is known to start.

    Args:
        batch: the batch that holds the frames.
        frames: at least one frame.
        states: the streams.

    Attributes:
        buffer: u8, with ``PADDING`` behind the frames.
        start: i64 (packets,), position in the buffer of each packet, rising.
        length: i64 (packets,), size of each packet in bytes.
    """

    def __init__(self, batch: PacketBatch, frames: _Frames, states: list[_Stream]) -> None:
        self._frames = frames
        begins = np.ones(len(frames.row), bool)
        begins[1:] = (np.diff(frames.stream) != 0) | (np.diff(frames.run) != 0)
        self._heads = np.flatnonzero(begins)
        stream = frames.stream[self._heads]
        self._states = [states[index] for index in stream.tolist()]
        self._fresh = np.append(True, stream[1:] != stream[:-1])
        runs = frames.run[self._heads].tolist()
        rests = [
            state.rest if fresh and state.run == run else b""
            for state, fresh, run in zip(self._states, self._fresh.tolist(), runs, strict=True)
        ]
        size, extra = frames.end - frames.start, np.zeros(len(begins), np.int64)
        ahead = np.array([len(rest) for rest in rests], np.int64)
        extra[self._heads] = ahead
        ends = np.cumsum(size + extra)
        self._at = ends - size
        self._begin = self._at[self._heads] - ahead
        self._end = ends[np.append(self._heads[1:], len(ends)) - 1]
        self.buffer = np.zeros(int(ends[-1]) + arrays.PADDING, np.uint8)
        arrays.copy_rows(self.buffer, self._at, batch.data, frames.start, size)
        for place, rest in zip(self._begin.tolist(), rests, strict=True):
            self.buffer[place : place + len(rest)] = np.frombuffer(rest, np.uint8)
        self._point(ahead > 0, np.cumsum(begins) - 1)
        self._walk()

    def _point(self, rests: arrays.Mask, segment: arrays.Integers) -> None:
        """Collect the pointers, rising: one for each rest, one for each frame that has one."""
        pointed = np.flatnonzero(self._frames.first >= 0)
        inside = self._frames.first[pointed] - self._frames.start[pointed]
        of_rests = np.flatnonzero(rests)
        pointer = np.concatenate([self._begin[of_rests], self._at[pointed] + inside])
        of_segment = np.concatenate([of_rests, segment[pointed]])
        frame = np.concatenate([self._heads[of_rests], pointed])
        order = np.argsort(pointer, kind="stable")
        self._pointer, self._segment, self._pointing = pointer[order], of_segment[order], frame[order]
        self._last = np.append(np.diff(self._segment) != 0, True)[: len(order)]
        limit = np.append(self._pointer[1:], 0)[: len(order)]
        self._limit = np.where(self._last, self._end[self._segment], limit)

    def _walk(self) -> None:
        """Find the packets behind every pointer, up to the next one."""
        self._stop = self._pointer.copy()
        self._open, self._other = np.zeros((2, len(self._pointer)), bool)
        active, starts, lengths = np.arange(len(self._pointer)), [], []
        while len(active := active[self._stop[active] < self._limit[active]]):
            place = self._stop[active]
            head = arrays.gather(self.buffer, place, ccsds.PRIMARY.size)
            length = ccsds.PRIMARY.column("packet_data_length", head) + np.int64(ccsds.LENGTH_BIAS)
            room = self._limit[active] - place
            other = ccsds.PRIMARY.column("packet_version_number", head) != 0
            short = (room < ccsds.PRIMARY.size) | (length > room)
            self._other[active[other]] = True
            self._open[active[short & ~other]] = True
            whole = ~(other | short)
            active, place, length = active[whole], place[whole], length[whole]
            starts.append(place)
            lengths.append(length)
            self._stop[active] += length
        start, length = (np.concatenate([np.zeros(0, np.int64), *part]) for part in (starts, lengths))
        order = np.argsort(start, kind="stable")
        self.start, self.length = start[order], length[order]

    def settle(self) -> arrays.Mask:
        """Keep incomplete packets for the next batch; return at which frames a packet is cut, bool (n,)."""
        cut = np.zeros(len(self._frames.row), bool)
        inner = np.flatnonzero(self._open & ~self._last)
        cut[self._pointing[inner + 1]] = True
        first_pointer = self._end.copy()
        first_pointer[self._segment[::-1]] = self._pointer[::-1]
        rest_at = self._end.copy()
        behind = np.flatnonzero(self._last & self._open)
        rest_at[self._segment[behind]] = self._stop[behind]
        filled = np.flatnonzero(self._frames.end > self._frames.start)
        for index, (state, head) in enumerate(zip(self._states, self._heads.tolist(), strict=True)):
            run = int(self._frames.run[head])
            if self._begin[index] == self._end[index]:
                continue  # idle frames alone: there are no bytes to continue
            if state.run not in {run, _NONE}:
                cut[filled[np.searchsorted(filled, head)]] |= bool(state.rest) or bool(
                    first_pointer[index] > self._begin[index]
                )
            state.run = run
            state.rest = self.buffer[rest_at[index] : self._end[index]].tobytes()
        return cut

    def words(self) -> NDArray[np.integer[Any]]:
        """Return the first word of each packet."""
        return arrays.gather(self.buffer, self.start, 2).view(">u2")[:, 0]

    def owner(self) -> arrays.Integers:
        """Return the frame in which each packet ends."""
        return np.searchsorted(self._at, self.start + self.length - 1, side="right") - 1

    def others(self) -> arrays.Integers:
        """Return the frames in which something starts that is not a space packet."""
        return np.searchsorted(self._at, self._stop[self._other], side="right") - 1


def _selected(read: FrameFields, rows: arrays.Mask) -> FrameFields:
    return FrameFields(**{name: getattr(read, name)[rows] for name in FrameFields.__struct_fields__})


def _followed(
    counts: SequenceCounts,
    frames: PacketBatch,
    channels: list[FrameChannel],
    which: arrays.Integers,
    count: NDArray[np.integer[Any]],
) -> arrays.Mask:
    """Follow a count of frames; return which frames repeat an earlier one with the same bytes, bool (n,).

    Args:
        counts: the follower, which treats each channel as a sender of its own.
        frames: frames in the order of their capture.
        channels: channels whose ``counts`` are set.
        which: i64 (n,), index into ``channels``; ``_NONE`` for a frame that has no count.
        count: (n,), the frame counts.
    """
    columns = blank_columns(len(frames)) | {
        "msg_id": np.where(which == _NONE, NO_MSG_ID, which).astype(np.int32),
        "processor_id": (which + 1).astype(np.uint32),
        "packet_offset": frames.offset,
        "packet_length": frames.length,
    }
    groups = [(index, at) for index, at in arrays.by_value(which) if index != _NONE]
    for index, at in groups:
        columns["sequence_count"][at] = channels[index].unwrapped(count[at])
    result = counts.follow(frames, Columns(**columns))
    for index, at in groups:
        stream = int(result.stream[at[0]])
        if stream != _NONE:
            channels[index].counts = counts.streams[stream]
    return result.duplicates > 0


class FrameFields(msgspec.Struct, frozen=True, eq=False):
    """Fields of frames, (n,) each; positions are indices into the data that was read.

    Attributes:
        fits: bool, headers, first header pointer and trailers fit into the frame.
        error: bool, the CRC at the end is wrong.
        spacecraft_id: u32.
        virtual_channel_id: u8.
        map_id: u8, MAP of a TC segment; else 0.
        has_count: bool, the frame has a count of its virtual channel; TC frames of Type-B have none.
        count: u32, count of the virtual channel.
        master_count: u8, count of the master channel; 0 if the kind of frame has none.
        start: i64, position of the first byte of the data field.
        end: i64, one past the last byte of the data field; equal to ``start`` if there are no packets.
        first: i64, position where the first packet starts; ``NO_FIRST`` for none.
        idle: bool, the frame was sent without packets.
    """

    fits: arrays.Mask
    error: arrays.Mask
    spacecraft_id: NDArray[np.uint32]
    virtual_channel_id: arrays.Octets
    map_id: arrays.Octets
    has_count: arrays.Mask
    count: NDArray[np.uint32]
    master_count: arrays.Octets
    start: arrays.Integers
    end: arrays.Integers
    first: arrays.Integers
    idle: arrays.Mask


def read_frames(
    data: arrays.Octets, offset: arrays.Integers, length: NDArray[np.int32], form: headers.FrameFormat
) -> FrameFields:
    """Read many frames of one kind; no content of theirs can make this raise.

    Args:
        data: u8, contiguous.
        offset: i64 (n,), position where each frame begins.
        length: i32 (n,), size of each frame in bytes; at least that of the primary header.
        form: format of all of the frames.
    """
    head = form.layout.columns(arrays.gather(data, offset, form.layout.size))
    none = np.zeros(len(offset), np.uint8)
    start = offset + form.data_start
    end = offset + length - arrays.CRC16_BYTES * form.fecf
    has_count, map_id, master = np.ones(len(offset), bool), none, none
    spacecraft = head["spacecraft_id"].astype(np.uint32)
    # Positions past the end of the data are not read: the window of a short frame is filled with zeros.
    behind = arrays.gather(data, np.minimum(start, len(data)), 2)
    if form.kind == "tm":
        second = headers.TM_SECONDARY.column("secondary_header_length", behind) + np.int64(1)
        start = start + second * head["secondary_header_flag"]
        end = end - headers.OCF_BYTES * head["ocf_flag"].astype(np.int64)
        pointer, count = head["first_header_pointer"], head["virtual_channel_frame_count"]
        idle = (pointer == headers.ONLY_IDLE_DATA) | (head["synchronization_flag"] == 1)
        master = head["master_channel_frame_count"]
    elif form.kind == "aos":
        start = start + headers.AOS_PACKETS.size
        end = end - headers.OCF_BYTES * form.ocf
        pointer = headers.AOS_PACKETS.column("first_header_pointer", behind)
        idle = (head["virtual_channel_id"] == headers.AOS_IDLE_CHANNEL) | (pointer == headers.ONLY_IDLE_DATA)
        count = head["virtual_channel_frame_count"]
        spacecraft |= head["spacecraft_id_high"].astype(np.uint32) << 8
    else:
        idle, has_count = head["control_command_flag"] == 1, head["bypass_flag"] == 0
        count, pointer = head["frame_sequence_number"], none
        if form.segment_header:
            start = start + headers.TC_SEGMENT.size
            map_id = headers.TC_SEGMENT.column("map_id", behind)
            flags = headers.TC_SEGMENT.column("segment_sequence_flags", behind)
            pointer = np.where(flags & headers.FIRST_PART, 0, headers.NO_PACKET_STARTS)
    starts = ~idle & (pointer != headers.NO_PACKET_STARTS)
    first = np.where(starts, start + pointer, headers.NO_FIRST)
    fits = (idle & (form.kind == "tc")) | (start <= end) & (first < np.maximum(end, start + 1))
    return FrameFields(
        fits,
        arrays.crc16_rows(data, offset, length) != 0 if form.fecf else np.zeros(len(offset), bool),
        spacecraft,
        head["virtual_channel_id"],
        map_id,
        has_count,
        count.astype(np.uint32),
        master,
        start,
        np.where(idle, start, end),
        first,
        idle,
    )
