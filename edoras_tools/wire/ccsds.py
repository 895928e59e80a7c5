"""The CCSDS space packet primary header (CCSDS 133.0-B-2, 4.1.3), big-endian."""

from __future__ import annotations

from typing import Final

from edoras_tools.wire.layout import Field, Layout

TELEMETRY_TYPE: Final = 0
TELECOMMAND_TYPE: Final = 1
UNSEGMENTED: Final = 3
"""Sequence flags of an unsegmented packet; cFE sends this value."""

PRIMARY: Final = Layout(
    "ccsds",
    "CCSDS Space Packet",
    Field("packet_version_number", 3, "always 0 on this link", clause="133.0-B 4.1.3.2"),
    Field(
        "packet_type",
        1,
        "decides which cFE header follows",
        names={TELEMETRY_TYPE: "telemetry", TELECOMMAND_TYPE: "telecommand"},
        clause="133.0-B 4.1.3.3.2",
    ),
    Field("secondary_header_flag", 1, "set in every cFE packet", clause="133.0-B 4.1.3.3.3"),
    Field("apid", 11, "application process identifier", base=16, clause="133.0-B 4.1.3.3.4"),
    Field(
        "sequence_flags",
        2,
        "cFE sends 3, the EDORAS bridges 0",
        names={0: "continuation", 1: "first", 2: "last", 3: "unsegmented"},
        clause="133.0-B 4.1.3.4.2",
    ),
    Field("packet_sequence_count", 14, "counts the packets of one APID", clause="133.0-B 4.1.3.4.3"),
    Field("packet_data_length", 16, "bytes of the whole packet, less 7", clause="133.0-B 4.1.3.5"),
)
"""The primary header; its whole first word is cFE's MsgId."""

IDLE_APID: Final = 0x7FF
"""CCSDS 133.0-B 4.1.3.3.4.4: a packet without content, which fills a frame."""
LENGTH_BIAS: Final = 7
"""``packet_data_length`` is the length of the whole packet minus this."""


def msg_id(fields: dict[str, int]) -> int:
    """Return the first word of a parsed primary header, which cFE calls the MsgId."""
    return (
        fields["packet_version_number"] << 13
        | fields["packet_type"] << 12
        | fields["secondary_header_flag"] << 11
        | fields["apid"]
    )


def emit(
    msg_id: int, total_length: int, *, sequence_flags: int = UNSEGMENTED, sequence_count: int = 0
) -> bytes:
    """Write a primary header.

    Args:
        msg_id: first word of the packet, u16.
        total_length: bytes of the whole packet, this header included; at least 7.
        sequence_flags: 2 bits.
        sequence_count: 14 bits.

    Raises:
        FieldError: a value does not fit its field.
    """
    return PRIMARY.emit(
        {
            "packet_version_number": msg_id >> 13,
            "packet_type": msg_id >> 12 & 1,
            "secondary_header_flag": msg_id >> 11 & 1,
            "apid": msg_id & 0x7FF,
            "sequence_flags": sequence_flags,
            "packet_sequence_count": sequence_count,
            "packet_data_length": total_length - LENGTH_BIAS,
        }
    )
