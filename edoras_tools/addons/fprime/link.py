"""F Prime: the link between flight software and its ground system (GDS), one frame a datagram, big-endian.

F Prime's own frame is a start word, a length, one packet, and a CRC-32 of everything in front of it. The
other frame, the default since version 4, is from CCSDS: a TC frame to F Prime, a TM frame from it, with a
CRC-16 and with space packets, each of which contains one packet.

A packet is a packet type, then a command, telemetry or an event. Widths are those of F Prime's default
configuration since version 4.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from enum import IntEnum
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.addons import LINK_PORTS
from edoras_tools.links.doors import Framing, LinkEvidence, Reading, Site, prefixed
from edoras_tools.links.protocol import BY_CONTENT, BatchRows, LinkProtocol, LinkSending, Located, Seen
from edoras_tools.model import Decoded, Finding, LayerField, Link, PacketBatch, Transport
from edoras_tools.wire import ccsds
from edoras_tools.wire import transfer_frames as headers
from edoras_tools.wire.arrays import CRC16_BYTES, crc16_rows, crc32, gather, read_at
from edoras_tools.wire.layout import Field, Layout

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.arrays import Integers, Mask, Octets, Places


class PacketType(IntEnum):
    """Contents of a packet: ``ComCfg.Apid`` of the default configuration."""

    COMMAND = 0
    TELEMETRY = 1
    EVENT = 2
    FILE = 3
    PACKETIZED_TELEMETRY = 4
    DATA_PRODUCT = 5
    IDLE = 6
    PARAMETER = 7
    HANDSHAKE = 0xFE


VALUES_LAYER: Final = "cfs"
"""Name of the layer of values from a dictionary."""
START_WORD: Final = 0xDEADBEEF
_NAMES: Final = {int(item): item.name.lower().replace("_", " ") for item in PacketType}
TIME_BASES: Final = {0: "none", 1: "processor", 2: "workstation", 3: "spacecraft", 0xFFFF: "any"}
_TIME: Final = (
    Field("time_base", 16, "which clock", names=TIME_BASES),
    Field("time_context", 8, "free for the mission"),
    Field("seconds", 32, "of that clock"),
    Field("microseconds", 32, "beyond its seconds"),
)
FRAME: Final = Layout(
    "fprime",
    "F Prime Frame",
    Field("start_word", 32, "always 0xdeadbeef", base=16),
    Field("length", 32, "bytes of the packet"),
)
_SPACE_PACKET: Final = {
    "packet_type": "1 to F Prime",
    "secondary_header_flag": "0: no other header follows",
    "apid": "the packet type again; 0x7ff: idle",
    "sequence_flags": "3: a whole packet",
}
SPACE_PACKET: Final = Layout(
    "fprime_space_packet",
    "CCSDS Space Packet",
    *(
        replace(slot.field, doc=_SPACE_PACKET.get(slot.field.name, slot.field.doc))
        for slot in ccsds.PRIMARY.slots
    ),
)
"""The primary header of a space packet."""
PACKET: Final = Layout(
    "fprime_packet", "F Prime Packet", Field("packet_type", 16, "what it holds", names=_NAMES)
)
ENTRY_HEADERS: Final = {
    PacketType.COMMAND: Layout(
        "fprime_command", "F Prime Command", Field("opcode", 32, "of the command", base=16)
    ),
    PacketType.TELEMETRY: Layout(
        "fprime_channel", "F Prime Channel", Field("channel_id", 32, "of the channel", base=16), *_TIME
    ),
    PacketType.EVENT: Layout(
        "fprime_event", "F Prime Event", Field("event_id", 32, "of the event", base=16), *_TIME
    ),
    PacketType.FILE: Layout(
        "fprime_file",
        "F Prime File",
        Field("kind", 8, "part of the transfer", names={0: "start", 1: "data", 2: "end", 3: "cancel"}),
        Field("sequence_index", 32, "counts the packets of a transfer"),
    ),
    PacketType.PACKETIZED_TELEMETRY: Layout(
        "fprime_telemetry",
        "F Prime Telemetry Packet",
        Field("packet_id", 16, "of the packet of channels"),
        *_TIME,
    ),
}
"""Header behind the packet type; values, arguments, or the bytes of a file follow it."""
TIME_BYTES: Final = sum(field.bits for field in _TIME) // 8
COMMAND_FRAME: Final = Layout("fprime_tc", headers.TC.title, *(slot.field for slot in headers.TC.slots))
TELEMETRY_FRAME: Final = Layout("fprime_tm", headers.TM.title, *(slot.field for slot in headers.TM.slots))
"""Headers of CCSDS TC and TM frames, under this link's own names."""
LINK_LAYOUTS: Final = (FRAME, COMMAND_FRAME, TELEMETRY_FRAME, SPACE_PACKET, PACKET, *ENTRY_HEADERS.values())


class FrameShape(msgspec.Struct, frozen=True):
    """A kind of frame.

    Attributes:
        header: header in front of its packets.
        check: checksum field at its end; None if there is none.
    """

    header: Layout
    check: Field | None

    @property
    def check_bytes(self) -> int:
        """Size of the check, bytes."""
        return self.check.bits // 8 if self.check else 0


_CRC16: Final = Field("frame_error_control", 8 * CRC16_BYTES, "CRC-16 of the frame in front of it", base=16)
FRAME_SHAPES: Final = (
    FrameShape(FRAME, Field("crc32", 32, "of the frame in front of it", base=16)),
    FrameShape(SPACE_PACKET, None),
    FrameShape(COMMAND_FRAME, _CRC16),
    FrameShape(TELEMETRY_FRAME, _CRC16),
)
"""Kinds of frames, by the numbers in ``Frames.shape``; a space packet may come without a frame."""
_OWN, SPACE_SHAPE, TC_SHAPE, _TM = range(4)
_BODY: Final = np.array([FRAME.size, 0, COMMAND_FRAME.size, TELEMETRY_FRAME.size])
"""Offset of the packets in a frame, bytes."""
TM_FRAME_BYTES: Final = 1024
"""Size of a TM frame in F Prime's default configuration (``ComCfg.TmFrameFixedSize``), bytes."""
KEEP_ALIVE: Final = b"sitting well"
"""Text that the ground system writes into a stream between frames, to keep its connection alive."""
STREAM_HEAD: Final = len(KEEP_ALIVE)
"""Number of bytes that determine the length of any frame."""
_LEAST: Final = np.array([item.header.size + item.check_bytes for item in FRAME_SHAPES])


class PacketPlaces(NamedTuple):
    """The packets in some datagrams, in order.

    Attributes:
        row: i64 (m,), index of the datagram.
        space: i64 (m,), position of the space packet around it; -1 for none.
        start: i64 (m,), position of the packet type.
        end: i64 (m,), one past the packet.
        kind: i32 (m,), a ``PacketType``, or another number; -1 if it is cut.
        whole: bool (m,), whether the header of its contents exists, and its space packet is complete.
    """

    row: Places
    space: Integers
    start: Integers
    end: Integers
    kind: NDArray[np.int32]
    whole: Mask

    def take(self, mask: NDArray[Any]) -> PacketPlaces:
        """Return the packets that a mask or indices select."""
        return PacketPlaces(*(column[mask] for column in self))


class Frames(msgspec.Struct, frozen=True):
    """Many datagrams of one frame each; arrays with one element for each datagram.

    Attributes:
        shape: i64 (n,), index into ``FRAME_SHAPES``.
        check: i64 (n,), position of the check.
        cut: bool (n,), whether the frame needs more bytes than exist: then neither check nor packets are
            read.
        truncated: bool (n,), whether the frame, or a packet in it, is cut.
        longer: bool (n,), whether bytes follow the frame.
        corrupt: bool (n,), whether the check is wrong.
        packets: packets of complete frames.
    """

    shape: Integers
    check: Integers
    cut: Mask
    truncated: Mask
    longer: Mask
    corrupt: Mask
    packets: PacketPlaces


def frame_shapes_of(field: Callable[[Layout, str, int], Any], length: Any) -> tuple[Any, Any, Any, Any]:
    """Return which of ``FRAME_SHAPES`` a datagram may have, or each of many.

    Args:
        field: returns a number of a header that starts at a byte; -1 if it does not exist.
        length: size of the datagram, bytes.

    Returns:
        For each of ``FRAME_SHAPES`` whether a datagram may have it; the first true one applies.
    """
    own = field(FRAME, "start_word", 0) == START_WORD
    # The APID of a space packet is the packet type in it.
    inside = field(PACKET, "packet_type", SPACE_PACKET.size)
    space = (field(SPACE_PACKET, "apid", 0) == inside) & (inside >= 0)
    space = space & (field(SPACE_PACKET, "packet_data_length", 0) + ccsds.LENGTH_BIAS == length)
    for name in ("packet_version_number", "secondary_header_flag"):
        space = space & (field(SPACE_PACKET, name, 0) == 0)
    command = COMMAND_FRAME
    last = field(command, "frame_length", 0) + headers.TC_LENGTH_BIAS
    tc = (last == length) & (length >= _LEAST[TC_SHAPE]) & (field(command, "control_command_flag", 0) == 0)
    telemetry = TELEMETRY_FRAME
    first = field(telemetry, "first_header_pointer", 0)
    tm = (length >= _LEAST[_TM]) & ((first < length) | (first >= headers.ONLY_IDLE_DATA))
    for name, value in _TM_WITH_PACKETS.items():
        tm = tm & (field(telemetry, name, 0) == value)
    version = field(telemetry, "transfer_frame_version_number", 0) == 0
    return own, space, tc & version, tm & version


_TM_WITH_PACKETS: Final = {
    "secondary_header_flag": 0,
    "synchronization_flag": 0,
    "packet_order_flag": 0,
    "segment_length_id": 3,
}


def read_ground_frames(
    data: Octets, offset: Integers, length: NDArray[np.int32], *, checked: bool = True
) -> Frames:
    """Read many frames; no contents can raise an error.

    Args:
        data: u8, contiguous buffer.
        offset: i64 (n,), first byte of each datagram.
        length: (n,), number of bytes that exist.
        checked: whether checks are computed; if not, no frame is ``corrupt``.
    """
    window = gather(data, offset, FRAME.size)
    length = length.astype(np.int64)

    def field(layout: Layout, name: str, at: int = 0) -> Integers:
        present = length >= at + layout.by_name[name].end
        return np.where(present, layout.column(name, window, at).astype(np.int64), -1)

    framing = np.select(frame_shapes_of(field, length)[:_TM], range(_TM), _TM)
    own = framing == _OWN
    size = np.where(own, _LEAST[_OWN] + field(FRAME, "length"), length)
    cut = (length < _LEAST[framing]) | (size > length)
    check = offset + size - np.array([item.check_bytes for item in FRAME_SHAPES])[framing]
    corrupt = np.zeros(len(offset), bool)
    rows = np.flatnonzero(own & ~cut)
    if len(rows) and checked:
        stated = read_at(data, check[rows], ">u4")
        view = memoryview(data)  # type: ignore[arg-type]
        ranges = zip(offset[rows].tolist(), check[rows].tolist(), strict=True)
        corrupt[rows] = stated != np.array([crc32(view[start:end]) for start, end in ranges], np.uint32)
    whole = _packets(data, rows, np.full(len(rows), -1), offset[rows] + FRAME.size, check[rows])
    rows = np.flatnonzero(~own & ~cut)
    if len(rows):
        if checked:
            framed = rows[framing[rows] != SPACE_SHAPE]
            corrupt[framed] = crc16_rows(data, offset[framed], length[framed].astype(np.int32)) != 0
        first = np.where(framing == _TM, field(TELEMETRY_FRAME, "first_header_pointer"), 0)[rows]
        start = offset[rows] + _BODY[framing[rows]] + first
        ocf = np.where(framing == _TM, field(TELEMETRY_FRAME, "ocf_flag"), 0)[rows] * headers.OCF_BYTES
        spaces = _space_packets(data, rows, start, check[rows] - ocf)
        pairs: Iterator[tuple[Any, Any]] = zip(whole, spaces, strict=True)
        both = [np.concatenate(pair) for pair in pairs]
        whole = PacketPlaces(*both).take(np.argsort(both[0], kind="stable"))
    truncated = cut.copy()
    truncated[whole.row[~whole.whole]] = True
    return Frames(framing, check, cut, truncated, ~truncated & (size < length), corrupt, whole)


def frame_lengths(data: Octets, at: Integers, tm_bytes: int = TM_FRAME_BYTES) -> tuple[Mask, Integers]:
    """Return where in a stream frames start, and their sizes.

    A TM frame does not contain its length; a TC frame must be as long as its single space packet.

    Args:
        data: u8, contiguous buffer.
        at: i64 (n,), positions.

    Returns:
        Whether a frame, or a ``KEEP_ALIVE``, may start there; its size in bytes, which is valid only if
            ``STREAM_HEAD`` bytes exist.
    """
    window = gather(data, at, STREAM_HEAD)

    def field(layout: Layout, name: str, start: int = 0) -> Integers:
        return layout.column(name, window, start).astype(np.int64)

    stated = field(COMMAND_FRAME, "frame_length") + headers.TC_LENGTH_BIAS
    inside = field(SPACE_PACKET, "packet_data_length", COMMAND_FRAME.size) + ccsds.LENGTH_BIAS
    own, _, tc, tm = frame_shapes_of(field, np.where(inside + _LEAST[TC_SHAPE] == stated, stated, tm_bytes))
    tc &= inside + _LEAST[TC_SHAPE] == stated
    own_size = field(FRAME, "length") + _LEAST[_OWN]
    alive = (window == np.frombuffer(KEEP_ALIVE, np.uint8)).all(axis=1)
    sizes = [np.int64(len(KEEP_ALIVE)), own_size, stated]
    return own | tc | tm | alive, np.select([alive, own, tc], sizes, np.int64(tm_bytes))


def _space_packets(data: Octets, row: Places, start: Integers, end: Integers) -> PacketPlaces:
    """Read space packets that follow each other from ``start`` to ``end``; idle ones are left out."""
    parts = [_packets(data, row[:0], start[:0], start[:0], end[:0])]
    while True:
        open_ = start < end
        row, start, end = row[open_], start[open_], end[open_]
        if not len(row):
            break
        head = gather(data, start, SPACE_PACKET.size)
        size = SPACE_PACKET.column("packet_data_length", head).astype(np.int64) + ccsds.LENGTH_BIAS
        behind = np.where(end - start < SPACE_PACKET.size, end + 1, start + size)
        some = SPACE_PACKET.column("apid", head) != ccsds.IDLE_APID
        some |= end - start < SPACE_PACKET.size
        inside = np.minimum(start + SPACE_PACKET.size, end)[some]
        packets = _packets(data, row[some], start[some], inside, np.minimum(behind, end)[some])
        parts.append(packets._replace(whole=packets.whole & (behind <= end)[some]))
        start = behind
    both = [np.concatenate(columns) for columns in zip(*parts, strict=True)]
    return PacketPlaces(*both).take(np.argsort(both[0], kind="stable"))


def _packets(data: Octets, row: Places, space: Integers, start: Integers, end: Integers) -> PacketPlaces:
    """Read the types of packets, and whether the header behind each type is complete."""
    whole = end - start >= PACKET.size
    kind = np.full(len(row), -1, np.int32)
    kind[whole] = read_at(data, start[whole], ">u2")
    need = np.full(len(row), PACKET.size)
    for item, layout in ENTRY_HEADERS.items():
        need[kind == item] += layout.size
    return PacketPlaces(row, space, start, end, kind, end - start >= need)


_VERDICTS: Final = {
    "truncated": Finding.TRUNCATED,
    "longer": Finding.LENGTH_MISMATCH,
    "corrupt": Finding.CHECKSUM_BAD,
}


class GroundDataFraming(Framing):
    """Frames that follow each other in a TCP stream, and the keep-alive texts between them."""

    head = STREAM_HEAD
    checked = True

    def __init__(self, tm_bytes: int = TM_FRAME_BYTES) -> None:
        self.tm_bytes = tm_bytes

    def lengths(self, data: Octets, at: Integers, end: Integers | int) -> Integers:
        """Return the size of the frame that starts at each position, bytes."""
        starts, size = frame_lengths(data, at, self.tm_bytes)
        return prefixed(starts, size, end - at, self.head, self.largest)

    def likely(self, data: Octets, at: Integers, end: Integers | int) -> Mask:
        """Return at which positions a complete frame with a correct check starts."""
        size = self.lengths(data, at, end)
        likely = (size > 0) & (at + size <= end)
        rows = np.flatnonzero(likely & (size != len(KEEP_ALIVE)))
        frames = read_ground_frames(data, at[rows], size[rows].astype(np.int32))
        likely[rows] = ~frames.corrupt & ~frames.cut
        return likely


class GroundDataLink(LinkProtocol):
    """The link between F Prime and its ground system: its own frames, or TC and TM frames of CCSDS.

    If a mission has space packets in transfer frames, these are taken out one by one.
    """

    code = 7
    name = "FPRIME"
    label = "fprime"
    colour = "magenta"
    doc = "between F Prime and its ground data system (GDS), one frame a datagram"
    transport = Transport("either", LINK_PORTS["fprime"], first="either")
    framing = GroundDataFraming()
    to_cfs = True
    from_cfs = True
    layouts = LINK_LAYOUTS
    port_decides = False
    sends = True
    dictionary = True
    several = True

    def send(self, site: Site, *, up: bool) -> LinkSending:
        """Return the way in which its frames go to the ground system, or to flight software."""
        return self.part("sending:GroundDataSending")(self, self.framing, up=up)

    def recognise(self, facts: Seen) -> Any:
        """Recognise a start word, or the header of a TC or TM frame that fits the datagram."""
        own, space, command, telemetry = frame_shapes_of(facts.field, facts.length)
        return BY_CONTENT * (own | space | command | telemetry)

    def locate(self, batch: PacketBatch, rows: Places, site: Site) -> Located:
        """Judge frames; see :meth:`LinkProtocol.locate`."""
        located = Located(len(rows))
        frames = read_ground_frames(batch.data, batch.offset[rows], batch.length[rows])
        for name, finding in _VERDICTS.items():
            located.flag(finding, getattr(frames, name))
        return located

    def dissect(self, reading: Reading, site: Site) -> None:
        """Read one frame, and the packets in it."""
        data = reading.data
        frames = read_ground_frames(np.frombuffer(data, np.uint8), np.array([0]), np.array([len(data)]))
        framing, check = FRAME_SHAPES[frames.shape[0]], int(frames.check[0])
        if framing.check:
            reading.read(framing.header, 0)
        if frames.cut[0]:
            reading.truncated(framing.header.name, 0, check + framing.check_bytes)
        for name, finding in _VERDICTS.items():
            reading.findings |= finding if getattr(frames, name)[0] else Finding(0)
        if framing.check:
            end = check + framing.check_bytes
            number = int.from_bytes(data[check:end], "big")
            text = framing.check.text(number) + (", which is wrong" if frames.corrupt[0] else "")
            reading.extend(LayerField(framing.check.name, number, check, end, text, framing.check.doc))
        for index in range(len(frames.packets.row)):
            _packet(reading, frames.packets, index)

    def places(self, layout: Layout, rows: BatchRows, field: str = "") -> tuple[Places, Integers]:
        """Find the frame, the first packet of each datagram, or the first header of one kind."""
        owner = np.flatnonzero(rows.column("link") == self)
        offset, length = rows.datagram("offset")[owner], rows.datagram("length")[owner]
        frames = read_ground_frames(rows.batch.data, offset, length)
        kinds = [item.header for item in FRAME_SHAPES]
        if layout in kinds and layout is not SPACE_PACKET:
            present = (frames.shape == kinds.index(layout)) & (length >= layout.size)
            return owner[present], offset[present]
        packets = frames.packets
        if layout is SPACE_PACKET:
            members = (packets.space >= 0) & (packets.start - packets.space >= layout.size)
            start = packets.space
        elif layout is PACKET:
            members, start = packets.kind >= 0, packets.start
        else:
            kind = next(kind for kind, item in ENTRY_HEADERS.items() if item is layout)
            members, start = (packets.kind == kind) & packets.whole, packets.start + PACKET.size
        row, first = np.unique(packets.row[members], return_index=True)
        return owner[row], start[members][first]

    def framing_of(self, carried: Link, form: Any) -> Framing | None:
        """Return the framing of TM frames that carry its packets; its own frames are separate."""
        return GroundDataFraming(form.length) if carried is self and form.kind == "tm" else None

    def engine_values(self) -> Mapping[str, Any]:
        """Return the values for ``engine/fprime.lua``."""
        return {
            "start_word": START_WORD,
            "keep_alive": KEEP_ALIVE.decode(),
            "tm_bytes": TM_FRAME_BYTES,
            "time_bytes": TIME_BYTES,
            "entry_headers": {int(kind): layout.name for kind, layout in ENTRY_HEADERS.items()},
        }

    def evidence(self, site: Site) -> LinkEvidence:
        """Return a follower of the sequence counts of space packets."""
        return self.part("rules:GroundCounts")()

    follow = evidence

    def summary(self, decoded: Decoded) -> str:
        """Return the contents of the packets, by number if no dictionary names them."""
        texts: list[str] = []
        ids = [layout.name for layout in ENTRY_HEADERS.values()]
        for layer, after in pairwise((*decoded.layers, None)):
            assert layer is not None, "only the last one is"
            header = after is not None and after.name in ids
            if layer.name == VALUES_LAYER or (layer.name == PACKET.name and not header):
                texts.append(layer.title if layer.name == VALUES_LAYER else layer.fields[0].text)
            elif layer.name in ids and not (after is not None and after.name == VALUES_LAYER):
                texts.append(f"{layer.title.removeprefix('F Prime ').lower()} {layer.fields[0].text}")
        return "; ".join(texts) or ("" if decoded.stop else "no packet")


FPRIME: Final = GroundDataLink()


def _packet(reading: Reading, packets: PacketPlaces, index: int) -> None:
    """Read one packet of a frame: its contents by name, if the reader has a dictionary."""
    _, space, start, end, kind, whole = (column[index].item() for column in packets)
    if 0 <= space <= start - SPACE_PACKET.size:
        reading.read(SPACE_PACKET, space)
    if kind >= 0:
        reading.read(PACKET, start)
    behind = start + PACKET.size
    if whole and kind in ENTRY_HEADERS and not reading.described(kind, behind, end):
        reading.read(ENTRY_HEADERS[PacketType(kind)], behind)
