"""Space packets of a bridge, written and read: cFE's header, the EDORAS envelope, the unchanged CDR.

An envelope whose length exceeds the packet is refused; bytes after the length of an envelope are dropped.
"""

from __future__ import annotations

import struct
from typing import Final

import msgspec

from edoras_tools.cfs import edoras_app
from edoras_tools.sessions.sequence import MODULUS
from edoras_tools.wire import ccsds, cfe, envelope
from edoras_tools.wire.envelope import CDR_BE, CDR_LE, ENCAPSULATION

_PRIMARY: Final = struct.Struct(">HHH")
_WORDS: Final = {8: "Q", 4: "I", 2: "H", 1: "B"}
_UNSEGMENTED: Final = ccsds.UNSEGMENTED << 14
_PADDING: Final = 3
"""RTPS pads a message to four bytes."""


def _lengths(form: envelope.EnvelopeFormat) -> struct.Struct:
    """Return the struct format of the two lengths of an envelope."""
    return struct.Struct(("<" if form.byte_order == "little" else ">") + 2 * _WORDS[form.width])


class PacketWriter:
    """Writes packets; sequence counts and checksums, which the public bridges leave 0, on request.

    Args:
        checksum: whether to write the checksum of commands.
        sequence: whether to count the packets of each MsgId, as cFE does.
        headers: headers of the cFE that reads the packets.
    """

    def __init__(
        self, *, checksum: bool = False, sequence: bool = False, headers: cfe.Headers = cfe.STANDARD
    ) -> None:
        self._checksum, self._sequence, self._headers = checksum, sequence, headers
        self._spare = bytes(headers.command_bytes - headers.start - 2)
        self._rest = bytes(headers.telemetry_bytes - headers.start)
        self._starts: dict[int, tuple[int, bytes, bool]] = {}
        self._counts: dict[int, int] = {}

    def overhead(self, msg_id: int) -> int:
        """Return the bytes of the headers of a MsgId's packets."""
        return self._headers.size(msg_id)

    def of_known(self, msg_id: int) -> int:
        """Return the MsgId, for the cFE that reads the packets, of a MsgId of version 1."""
        return self._headers.msg_ids.of_known(msg_id)

    def write(self, msg_id: int, payload: bytes, code: int = edoras_app.SET) -> bytes:
        """Return a packet. A telemetry MsgId gets the telemetry header with time 0, and no function code."""
        word = 0
        if self._sequence:
            count = self._counts.get(msg_id, 0)
            self._counts[msg_id] = (count + 1) % MODULUS
            word = _UNSEGMENTED | count
        first, between, command = self._starts.get(msg_id) or self._start(msg_id)
        if not command:
            rest = between + self._rest + payload
            return _PRIMARY.pack(first, word, len(rest) - 1) + rest
        rest = between + bytes((code, 0)) + self._spare + payload
        packet = _PRIMARY.pack(first, word, len(rest) - 1) + rest
        if not self._checksum:
            return packet
        at = self._headers.start + cfe.CHECKSUM_BYTE
        return packet[:at] + bytes((cfe.checksum(packet),)) + packet[at + 1 :]

    def _start(self, msg_id: int) -> tuple[int, bytes, bool]:
        """Return the first word, the bytes between primary and cFE header, and whether it is a command."""
        head = self._headers.emit(msg_id, self._headers.size(msg_id), 0, 0)
        between = head[ccsds.PRIMARY.size :]
        command = bool(self._headers.msg_ids.is_command(msg_id))
        self._starts[msg_id] = start = int.from_bytes(head[:2], "big"), between, command
        return start


class Envelope:
    """One route's envelope, both ways.

    Args:
        form: format of the envelope; None detects it from the bytes, and writes the default.
        cdr_bytes: bytes of every message of the type, encapsulation included; None if they vary.
        type_name: type of the message, for refusals.
    """

    def __init__(
        self, form: envelope.EnvelopeFormat | None, cdr_bytes: int | None = None, type_name: str = ""
    ) -> None:
        self._form = form
        self._written = form or envelope.DEFAULT
        self._lengths = None if self._written.own else _lengths(self._written)
        self.most = self._written.most
        self._cdr_bytes, self._type = cdr_bytes, type_name

    @property
    def size(self) -> int:
        """Bytes that ``wrap`` adds."""
        return self._written.size + self._written.crc

    def wrap(self, cdr: bytes) -> bytes:
        """Return a message in its envelope, at most ``most`` bytes."""
        length = len(cdr)
        if self._lengths is None:
            return self._written.emit(cdr)
        return self._lengths.pack(length, length) + cdr

    def open(self, data: bytes, start: int, end: int) -> bytes | str:
        """Return the CDR of an envelope, or the reason why there is none.

        Args:
            data: the datagram.
            start: start of the envelope in it.
            end: end of its packet, within the datagram.
        """
        form = self._form or envelope.detect(data[start:end])
        if form is None:
            return "no envelope that fits"
        at = start + form.size
        if at > end:
            return "cut inside the envelope"
        if form is self._written and self._lengths is not None:
            length = self._lengths.unpack_from(data, start)[0]
        else:
            length = form.parse(data, start)[0]
        if length > end - at - form.crc:
            return "the envelope's length exceeds the packet"
        if length < ENCAPSULATION.size:
            return "no CDR in the envelope"
        if not CDR_BE <= (data[at] << 8 | data[at + 1]) <= CDR_LE:
            return "the content of the envelope is not CDR"
        if not form.intact(data, start, length):
            return "the envelope's CRC is wrong"
        expected = self._cdr_bytes
        if expected is not None and not expected <= length <= expected + _PADDING:
            return f"not the {expected} bytes of a {self._type}"
        return data[at : at + length]


class PacketPlace(msgspec.Struct, frozen=True):
    """A space packet in a datagram.

    Attributes:
        msg_id: MsgId in the version of its cFE.
        body: end of its cFE header.
        end: end of the packet, by its own length and the datagram's.
    """

    msg_id: int
    body: int
    end: int


def find_packet(data: bytes, at: int, headers: cfe.Headers = cfe.STANDARD) -> PacketPlace | None:
    """Return the space packet that starts at byte ``at`` of a datagram; None if its header is incomplete."""
    if len(data) - at < ccsds.PRIMARY.size:
        return None
    msg_id = headers.msg_ids.of(data, at)
    header = headers.size(msg_id)
    end = min(len(data), at + (data[at + 4] << 8 | data[at + 5]) + ccsds.LENGTH_BIAS)
    return PacketPlace(msg_id, at + header, end) if at + header <= end else None
