"""The CCSDS space packet primary header (CCSDS 133.0-B-2, 4.1.3), big-endian, and the MsgIds of packets.

MsgIds identify packets on a software bus; cFE builds them from the headers in one of two ways.

1. Version 1, the default: the first word of the packet.
2. Version 2, only with the extended header: the low byte of its subsystem, the bit that marks commands, and
   the low 7 bits of the APID. The first word has its type bit too, which marks commands in both versions.
3. The MsgIds of cFE and of apps that this project knows are of version 1. With version 2 a mission chooses
   its own; here those of cFE's sample missions are used for the services (0x1806 becomes 0x0086, 0x0808
   becomes 0x0008). The APIDs of the lab apps have bit 7: commands keep their numbers (0x1880), telemetry
   loses that bit (0x0884 becomes 0x0804), which would make commands of it. No two MsgIds become one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np

from edoras_tools.wire.layout import Field, Layout

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.arrays import Octets

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


MSG_ID_BYTES: Final = PRIMARY.size + 2
"""First bytes of a packet that hold its MsgId in every version."""

_Ids = TypeVar("_Ids", int, "NDArray[np.int32]")
"""One MsgId, or a column of them."""
_APID: Final = 0x7F
_COMMAND_2: Final = 0x80
_SECONDARY: Final = 0x0800
"""Bit of the first word: a secondary header follows, as in every cFE packet."""
_SUBSYSTEM_AT: Final = MSG_ID_BYTES - 1
"""Offset of the low byte of the subsystem."""


class MsgIds:
    """MsgIds of version 1: the first word of the packet.

    Attributes:
        version: number of the version in cFE.
        made_of: parts of the headers that it is made of.
        command_bit: bit that is set in the MsgId of a command; it, not the link, decides the next header.
    """

    version = 1
    made_of = "the first word"
    command_bit = 0x1000

    def is_command(self, msg_id: Any) -> Any:
        """Return whether a MsgId's packet is a command: bool for one, an array of bool for many."""
        return (msg_id & self.command_bit) != 0

    def of(self, packet: bytes, at: int = 0) -> int:
        """Return the MsgId of the packet that starts at byte ``at``; its first word must exist."""
        return packet[at] << 8 | packet[at + 1]

    def column(self, head: Octets, length: NDArray[Any]) -> NDArray[np.int32]:
        """Return the MsgIds of many packets.

        Args:
            head: first bytes of each, u8 (n, ``MSG_ID_BYTES`` or more).
            length: number of existing bytes of each.
        """
        return _first_words(head)

    def words(self, msg_id: _Ids) -> tuple[_Ids, int | NDArray[np.int32]]:
        """Return the first word of a packet, and the subsystem in its extended header."""
        return msg_id, 0

    def of_known(self, standard: _Ids) -> _Ids:
        """Return the MsgId in this version of a MsgId of version 1 that the project knows."""
        return standard

    def standard(self, msg_id: _Ids) -> _Ids:
        """Return the MsgId of version 1 for one of this version: the reverse of :meth:`of_known`."""
        return msg_id


class _Version2(MsgIds):
    """MsgIds of version 2: subsystem, type bit, 7 bits of the APID. Absent bytes count as 0."""

    version = 2
    made_of = "subsystem, type and APID"
    command_bit = _COMMAND_2

    def of(self, packet: bytes, at: int = 0) -> int:
        low = packet[at + 1] & _APID | (_COMMAND_2 if VERSION_1.is_command(packet[at] << 8) else 0)
        subsystem = packet[at + _SUBSYSTEM_AT] if len(packet) - at > _SUBSYSTEM_AT else 0
        return subsystem << 8 | low

    def column(self, head: Octets, length: NDArray[Any]) -> NDArray[np.int32]:
        word = _first_words(head)
        low = word & _APID | VERSION_1.is_command(word) * np.int32(_COMMAND_2)
        subsystem = head[:, _SUBSYSTEM_AT].astype(np.int32) << 8
        return np.where(length > _SUBSYSTEM_AT, subsystem, np.int32(0)) | low

    def words(self, msg_id: _Ids) -> tuple[_Ids, int | NDArray[np.int32]]:
        return _SECONDARY | (msg_id & _COMMAND_2) << 5 | msg_id & _APID, msg_id >> 8

    def of_known(self, standard: _Ids) -> _Ids:
        high = (standard & _COMMAND_2) << 4 | (standard & _SECONDARY ^ _SECONDARY) << 1 ^ (
            standard & standard << 5 & 0x1000
        )
        return standard & 0xE700 | high | (standard & 0x1000) >> 5 | standard & _APID

    def standard(self, msg_id: _Ids) -> _Ids:
        command = (msg_id & _COMMAND_2) << 5
        secondary = (msg_id & 0x1000 ^ (command & msg_id << 1)) >> 1 ^ _SECONDARY
        return msg_id & 0xE700 | command | secondary | (msg_id & 0x0800) >> 4 | msg_id & _APID


def _first_words(head: Octets) -> NDArray[np.int32]:
    return head[:, :2].view(">u2")[:, 0].astype(np.int32)


VERSION_1: Final = MsgIds()
VERSION_2: Final = _Version2()
