"""CCSDS transfer frames: TM (132.0-B-3), AOS (732.0-B-4), TC (232.0-B-4); big-endian.

The headers of the frames, and the parameters that a mission defines.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal

import msgspec

from edoras_tools.wire.arrays import CRC16_BYTES
from edoras_tools.wire.layout import Field, Layout

NO_PACKET_STARTS: Final = 0x7FF
"""First header pointer of a frame in which no packet starts."""
ONLY_IDLE_DATA: Final = 0x7FE
"""First header pointer of a frame with only idle data."""
OCF_BYTES: Final = 4
"""Bytes of the operational control field, after the data of a TM or AOS frame."""
AOS_IDLE_CHANNEL: Final = 63
"""Virtual channel of AOS frames that are sent only to keep the link busy."""
HEADER_ERROR_CONTROL_BYTES: Final = 2
"""Bytes of an optional field after the header of an AOS frame; its Reed-Solomon code is not checked."""

_VERSION: Final = "transfer_frame_version_number"
_CRAFT: Final = "of the spacecraft"
_FIRST: Final = Field(
    "first_header_pointer",
    11,
    "where in the data the first packet starts",
    base=16,
    names={NO_PACKET_STARTS: "no packet starts", ONLY_IDLE_DATA: "only idle data"},
    clause="132.0-B 4.1.2.7.6",
)

TM: Final = Layout(
    "tm_frame",
    "CCSDS TM Transfer Frame",
    Field(_VERSION, 2, "0", clause="132.0-B 4.1.2.2.2"),
    Field("spacecraft_id", 10, _CRAFT, base=16, clause="132.0-B 4.1.2.2.3"),
    Field("virtual_channel_id", 3, "the channel of the frame", clause="132.0-B 4.1.2.3"),
    Field("ocf_flag", 1, "an operational control field follows the data", clause="132.0-B 4.1.2.4"),
    Field("master_channel_frame_count", 8, "counts all frames of the spacecraft", clause="132.0-B 4.1.2.5"),
    Field("virtual_channel_frame_count", 8, "counts the frames of the channel", clause="132.0-B 4.1.2.6"),
    Field("secondary_header_flag", 1, "a secondary header follows", clause="132.0-B 4.1.2.7.2"),
    Field("synchronization_flag", 1, "0: packets; 1: other data", clause="132.0-B 4.1.2.7.3"),
    Field("packet_order_flag", 1, "0 with packets", clause="132.0-B 4.1.2.7.4"),
    Field("segment_length_id", 2, "3 with packets", clause="132.0-B 4.1.2.7.5"),
    _FIRST,
)
"""The primary header of a TM frame."""
TM_SECONDARY: Final = Layout(
    "tm_secondary",
    "TM Secondary Header",
    Field("version_number", 2, "0", clause="132.0-B 4.1.3.2.2"),
    Field("secondary_header_length", 6, "bytes that follow this one", clause="132.0-B 4.1.3.2.3"),
)
"""The first byte of the secondary header of a TM frame."""
AOS: Final = Layout(
    "aos_frame",
    "CCSDS AOS Transfer Frame",
    Field(_VERSION, 2, "1", clause="732.0-B 4.1.2.2.2"),
    Field("spacecraft_id", 8, f"{_CRAFT}, its 8 low bits", base=16, clause="732.0-B 4.1.2.2.3"),
    Field(
        "virtual_channel_id",
        6,
        "the channel of the frame",
        names={AOS_IDLE_CHANNEL: "idle frames"},
        clause="732.0-B 4.1.2.3",
    ),
    Field("virtual_channel_frame_count", 24, "counts the frames of the channel", clause="732.0-B 4.1.2.4"),
    Field("replay_flag", 1, "played back", clause="732.0-B 4.1.2.5.2"),
    Field("frame_count_usage_flag", 1, "the cycle is counted, too", clause="732.0-B 4.1.2.5.3"),
    Field("spacecraft_id_high", 2, "further bits of the spacecraft since issue 4; 0 before"),
    Field("frame_count_cycle", 4, "how often the count began anew", clause="732.0-B 4.1.2.5.5"),
)
"""The primary header of an AOS frame; an error control field and an insert zone may follow."""
AOS_PACKETS: Final = Layout(
    "aos_packets",
    "AOS Packet Zone",
    Field("reserved", 5, "0"),
    Field(_FIRST.name, 11, _FIRST.doc, base=16, names=_FIRST.names, clause="732.0-B 4.1.4.2.2.3"),
)
"""The header of an M_PDU, the data field of an AOS frame with packets."""
TC: Final = Layout(
    "tc_frame",
    "CCSDS TC Transfer Frame",
    Field(_VERSION, 2, "0", clause="232.0-B 4.1.2.2.2"),
    Field("bypass_flag", 1, "1 (Type-B): not counted", clause="232.0-B 4.1.2.2.3.1"),
    Field(
        "control_command_flag", 1, "1: a command to the frame's receiver itself", clause="232.0-B 4.1.2.2.3.2"
    ),
    Field("reserved", 2, "0"),
    Field("spacecraft_id", 10, _CRAFT, base=16, clause="232.0-B 4.1.2.4"),
    Field("virtual_channel_id", 6, "the channel of the frame", clause="232.0-B 4.1.2.5"),
    Field("frame_length", 10, "bytes of the whole frame, less 1", clause="232.0-B 4.1.2.6"),
    Field("frame_sequence_number", 8, "counts the Type-A frames of the channel", clause="232.0-B 4.1.2.7"),
)
"""The primary header of a TC frame."""
TC_SEGMENT: Final = Layout(
    "tc_segment",
    "TC Segment",
    Field(
        "segment_sequence_flags",
        2,
        "which part of a packet it is",
        names={0: "continuing", 1: "first", 2: "last", 3: "whole"},
        clause="232.0-B 4.1.3.2.2.2",
    ),
    Field("map_id", 6, "parts of one packet have the same", clause="232.0-B 4.1.3.2.2.3"),
)
"""The segment header, which is optional in a mission's TC frames."""
TC_LENGTH_BIAS: Final = 1
"""``frame_length`` is the length of the whole frame minus this."""


FrameKind = Literal["tm", "aos", "tc"]
FRAME_LAYOUTS: Final[Mapping[str, Layout]] = {"tm": TM, "aos": AOS, "tc": TC}
FRAME_VERSIONS: Final = {"tm": 0, "aos": 1, "tc": 0}
"""The transfer frame version number of each kind."""
FIRST_PART: Final = 1
"""Bit of a segment's sequence flags that marks the start of a packet."""
LATE: Final = 32
"""Most counts of 8 bits by which a frame is late, not ahead."""
NO_FIRST: Final = -1
"""``FrameFields.first`` of a frame in which no packet starts."""


class FrameFormat(msgspec.Struct, frozen=True):
    """Parameters of frames that are not in their bytes.

    Attributes:
        kind: ``tm``, ``aos`` or ``tc``.
        length: bytes of a whole TM or AOS frame; 0 for TC frames, which state their length.
        fecf: whether the last two bytes are a CRC-16 of the frame.
        ocf: whether an operational control field is after the data (TM, AOS); received TM frames state it.
        insert_zone: bytes of the insert zone after the header (AOS).
        header_error_control: whether two bytes of header error control are after the header (AOS).
        segment_header: whether the data begins with a segment header (TC).
        stream: whether frames follow each other in TCP streams; if not, each is a datagram.
    """

    kind: FrameKind
    length: int = 0
    fecf: bool = True
    ocf: bool = False
    insert_zone: int = 0
    header_error_control: bool = False
    segment_header: bool = False
    stream: bool = False

    @property
    def layout(self) -> Layout:
        """The primary header."""
        return FRAME_LAYOUTS[self.kind]

    @property
    def data_start(self) -> int:
        """Bytes before the data, without a TM secondary header."""
        return self.layout.size + HEADER_ERROR_CONTROL_BYTES * self.header_error_control + self.insert_zone

    @property
    def smallest(self) -> int:
        """Bytes of a frame with headers and trailers, and one byte of data."""
        further = {"tm": 0, "aos": AOS_PACKETS.size, "tc": TC_SEGMENT.size}[self.kind]
        further *= self.kind == "aos" or self.segment_header
        return self.data_start + further + CRC16_BYTES * self.fecf + OCF_BYTES * self.ocf + 1


def count_modulus(kind: str) -> int:
    """Return the number of values of a virtual channel's count."""
    name = "frame_sequence_number" if kind == "tc" else "virtual_channel_frame_count"
    return FRAME_LAYOUTS[kind].by_name[name].mask + 1
