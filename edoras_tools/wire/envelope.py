"""The EDORAS envelope: two lengths before the CDR, in the sender's native word size and order.

A bridge copies ``buffer_length`` and ``buffer_capacity`` of an ``rcutils_uint8_array_t`` (two ``size_t``) and
then the CDR. A 64-bit little-endian sender makes 8 + 8 bytes; a 32-bit one 4 + 4; the EDORAS paper describes
1 + 1. A mission may define its own envelope: other words, and a CRC after the CDR.

The CDR begins with its encapsulation header (OMG DDSI-RTPS 2.5, 10.2), which is here too; its body is read in
``edoras_tools.ros``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, Final, Literal

import msgspec
import numpy as np

from edoras_tools.errors import ConfigError, TruncatedError
from edoras_tools.wire.arrays import CRC16_BYTES, crc16, crc16_rows, crc32, crc32_rows, gather
from edoras_tools.wire.layout import Field, Layout

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.arrays import Integers, Mask, Octets

CDR_BE: Final = 0x0000
CDR_LE: Final = 0x0001
ROUNDED: Final = 3
"""Most bytes that follow a message because RTPS rounds its length up to 4 (DDSI-RTPS 9.4.2.13)."""

ENCAPSULATION: Final = Layout(
    "cdr",
    "CDR",
    Field(
        "representation",
        16,
        "how the body is encoded; alignment counts from the byte after this header",
        names={
            CDR_BE: "CDR big-endian",
            CDR_LE: "CDR little-endian",
            2: "PL_CDR big-endian",
            3: "PL_CDR little-endian",
        },
        base=16,
        clause="RTPS 10.5",
    ),
    Field("options", 16, "unused, 0", base=16),
)


class EnvelopeFormat(msgspec.Struct, frozen=True):
    """The words of an envelope, and their byte order.

    Attributes:
        width: bytes of each of the two lengths of a bridge: 8, 4, 2 or 1.
        byte_order: byte order of every word.
        own: words instead of the two lengths: name (``length``, ``capacity`` or ``spare``) and bytes.
        crc: bytes of a CRC after the CDR, over envelope and CDR: 2 for CRC-16 (CCSDS), 4 for CRC-32
            (Ethernet); 0 for none.
    """

    width: Literal[1, 2, 4, 8] = 8
    byte_order: Literal["little", "big"] = "little"
    own: tuple[tuple[str, int], ...] = ()
    crc: int = 0

    @property
    def words(self) -> tuple[tuple[str, int], ...]:
        """Name and bytes of each word."""
        return self.own or (("length", self.width), ("capacity", self.width))

    @property
    def size(self) -> int:
        """Bytes before the CDR."""
        return sum(size for _, size in self.words)

    @property
    def most(self) -> int:
        """Bytes of the longest CDR that the length word can state."""
        return (1 << 8 * dict(self.words)["length"]) - 1

    @property
    def layout(self) -> Layout:
        """The layout of the words."""
        return _layout(self.words, self.byte_order)

    @property
    def trailer(self) -> Layout | None:
        """The layout of the CRC after the CDR; None if there is none."""
        return _trailer(self.crc, self.byte_order) if self.crc else None

    def __str__(self) -> str:
        if self.own:
            words = [(name, f"u{8 * size}") for name, size in self.own]
            words += [("crc", f"crc{8 * self.crc}")] * bool(self.crc)
            order = "be" if self.byte_order == "big" else "le"
            return ", ".join(f"{name}: {kind}{'' if kind == 'u8' else order}" for name, kind in words)
        order = "" if self.width == 1 else " le" if self.byte_order == "little" else " be"
        return f"{self.width}/{self.width}{order}"

    @classmethod
    def of_name(cls, text: str) -> EnvelopeFormat:
        """Return the format of a text such as ``8/8``, ``4/4 be``, or ``length: u16be, spare: u8``.

        Raises:
            ConfigError: the text is not a format.
        """
        if ":" in text:
            return cls._of_words(text)
        words = text.lower().split()
        formats = {str(item): item for item in ENVELOPE_FORMATS}
        name = " ".join(words) if len(words) > 1 or words == ["1/1"] else f"{words[0]} le" if words else ""
        if name not in formats:
            raise ConfigError(f"envelope {text!r} is not known; there are {', '.join(formats)}")
        return formats[name]

    @classmethod
    def _of_words(cls, text: str) -> EnvelopeFormat:
        words: list[tuple[str, int]] = []
        orders, crc = set[str](), 0
        for item in text.lower().split(","):
            match = re.fullmatch(_WORD, item.strip())
            if match is None or crc:
                raise ConfigError(f"envelope: {item.strip()!r} is no word of it; {_FORM}")
            name, bits, own, check_bits, check_own = match.groups()
            orders |= {own or check_own} - {None}
            if check_bits:
                crc = int(check_bits) // 8
            elif bits != "8" and not own:
                raise ConfigError(f"envelope: {item.strip()!r} needs its byte order: u{bits}be or u{bits}le")
            else:
                words.append((name, int(bits) // 8))
        names = [name for name, _ in words if name != "spare"]
        if names not in (["length"], ["length", "capacity"], ["capacity", "length"]) or len(orders) > 1:
            raise ConfigError(f"envelope {text!r}: one length, at most one capacity, one byte order; {_FORM}")
        order: Literal["little", "big"] = "big" if "be" in orders else "little"
        same = [item for item in ENVELOPE_FORMATS if item.words == tuple(words) and not crc]
        return next((item for item in same if item.width == 1 or item.byte_order == order), None) or cls(
            byte_order=order, own=tuple(words), crc=crc
        )

    def parse(self, data: bytes | memoryview, offset: int = 0) -> tuple[int, int]:
        """Return ``buffer_length`` and ``buffer_capacity`` at ``offset``; the length twice without one.

        Raises:
            TruncatedError: the envelope is incomplete.
        """
        values = self.layout.parse(data, offset)
        return values["buffer_length"], values.get("buffer_capacity", values["buffer_length"])

    def emit(self, cdr: bytes, *, capacity: int | None = None) -> bytes:
        """Write an envelope, its CDR, and the CRC if it has one.

        Raises:
            FieldError: a length does not fit its word.
        """
        values = {"buffer_length": len(cdr)}
        if "buffer_capacity" in self.layout.by_name:
            values["buffer_capacity"] = len(cdr) if capacity is None else capacity
        data = self.layout.emit(values) + cdr
        return data + self.check(data).to_bytes(self.crc, self.byte_order) if self.crc else data

    def check(self, data: bytes | memoryview) -> int:
        """Return the CRC of an envelope and its CDR."""
        return crc16(data) if self.crc == CRC16_BYTES else crc32(data)

    def intact(self, data: bytes | memoryview, offset: int, length: int) -> bool:
        """Return whether the CRC after a CDR is right; True if the format has no CRC.

        Args:
            offset: start of the envelope; it and its CDR must be complete.
            length: bytes of the CDR.
        """
        end = offset + self.size + length
        sent = bytes(data[end : end + self.crc])
        return not self.crc or int.from_bytes(sent, self.byte_order) == self.check(data[offset:end])


_WORD: Final = r"(length|capacity|spare) *: *u(8|16|32|64)(be|le)?|crc *: *crc(16|32)(be|le)"
_FORM: Final = "write e.g. length: u16be, capacity: u16be, spare: u8, crc: crc16be; the CRC is last"


@cache
def _layout(words: tuple[tuple[str, int], ...], byte_order: Literal["little", "big"]) -> Layout:
    docs = {
        "length": "bytes of CDR that follow, encapsulation included",
        "capacity": "the allocator's figure; never smaller than the length",
        "spare": "not used",
    }
    fields = [
        Field(f"spare_{place}" if name == "spare" else f"buffer_{name}", 8 * size, docs[name])
        for place, (name, size) in enumerate(words, 1)
    ]
    return Layout("edoras", "EDORAS Envelope", *fields, byte_order=byte_order)


@cache
def _trailer(size: int, byte_order: Literal["little", "big"]) -> Layout:
    crc = Field("crc", 8 * size, "of envelope and CDR", base=16)
    return Layout("edoras_crc", "EDORAS Envelope CRC", crc, byte_order=byte_order)


ENVELOPE_FORMATS: Final[Sequence[EnvelopeFormat]] = (
    EnvelopeFormat(8, "little"),
    EnvelopeFormat(8, "big"),
    EnvelopeFormat(4, "little"),
    EnvelopeFormat(4, "big"),
    EnvelopeFormat(2, "little"),
    EnvelopeFormat(2, "big"),
    EnvelopeFormat(1, "little"),
)
"""Every format that can be detected from the bytes, the likeliest first."""
DEFAULT: Final = ENVELOPE_FORMATS[0]


def detect(data: bytes | memoryview, offset: int = 0) -> EnvelopeFormat | None:
    """Detect the format whose lengths fit and whose CDR begins with an encapsulation.

    Returns:
        The format, or None if none fits.
    """
    for item in ENVELOPE_FORMATS:
        try:
            length, capacity = item.parse(data, offset)
        except TruncatedError:
            continue
        start = offset + item.size
        representation = int.from_bytes(data[start : start + 2], "big")
        if (
            4 <= length <= min(capacity, len(data) - start)
            and representation in {CDR_BE, CDR_LE}
            and data[start + 2 : start + 4] == b"\0\0"
        ):
            return item
    return None


def capacity_column(envelope: EnvelopeFormat, head: Octets, length: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return the capacities of many envelopes; their lengths if the format has no capacity.

    Args:
        head: first bytes of the envelopes, (n, size or more).
        length: lengths in the envelopes, (n,).
    """
    if "buffer_capacity" not in envelope.layout.by_name:
        return length
    return envelope.layout.column("buffer_capacity", head).astype(np.uint64)


def holds(head: Octets, have: NDArray[np.integer[Any]], envelope: EnvelopeFormat) -> Mask:
    """Return whether an envelope of this format fits each of many payloads; the test of :func:`detect`.

    Args:
        head: first bytes of the possible envelopes, (n, 20).
        have: bytes from there to the end of the packet, (n,).
    """
    size = envelope.size
    start = head[:, size : size + 4]
    encapsulated = (start[:, 0] == 0) & (start[:, 1] <= 1) & (start[:, 2] == 0) & (start[:, 3] == 0)
    rows = np.flatnonzero(encapsulated)
    if len(rows):
        head, have = head[rows], have[rows]
        length = envelope.layout.column("buffer_length", head).astype(np.uint64)
        capacity = capacity_column(envelope, head, length)
        space = np.maximum(have - size - envelope.crc, 0).astype(np.uint64)
        encapsulated[rows] = (have >= size + 4) & (length >= 4) & (length <= capacity) & (length <= space)
    return np.asarray(encapsulated)


def intact_rows(data: Octets, offset: Integers, length: NDArray[np.int32], envelope: EnvelopeFormat) -> Mask:
    """Return whether the CRC after each of many CDRs is right; see ``EnvelopeFormat.intact``.

    Args:
        offset: start of each envelope in ``data``, i64 (n,); envelope, CDR and CRC are inside.
        length: bytes of each CDR, i32 (n,), 4 or more.
    """
    trailer = envelope.trailer
    if trailer is None:
        return np.ones(len(offset), bool)
    whole = length + np.int32(envelope.size)
    crc = (crc16_rows if envelope.crc == CRC16_BYTES else crc32_rows)(data, offset, whole)
    return trailer.column("crc", gather(data, offset + whole, envelope.crc)) == crc
