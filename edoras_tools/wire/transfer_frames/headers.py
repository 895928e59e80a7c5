"""The headers of CCSDS transfer frames, big-endian."""

from __future__ import annotations

from typing import Final

from edoras_tools.wire.layout import Field, Layout

NO_PACKET_STARTS: Final = 0x7FF
"""First header pointer: no packet starts in this frame."""
ONLY_IDLE_DATA: Final = 0x7FE
"""First header pointer: there is no packet in this frame."""
OCF_BYTES: Final = 4
"""The operational control field, behind the data of a TM or AOS frame."""
AOS_IDLE_CHANNEL: Final = 63
"""The virtual channel of AOS frames that are only sent so that the link is not silent."""
HEADER_ERROR_CONTROL_BYTES: Final = 2
"""What may follow the header of an AOS frame; Reed-Solomon, not checked here."""

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
"""The segment header, which a mission's TC frames have or not."""
TC_LENGTH_BIAS: Final = 1
"""``frame_length`` is the whole frame's length less this."""
