"""The EDORAS envelope: two lengths in front of the CDR, in the sender's native word size and order.

A bridge copies ``buffer_length`` and ``buffer_capacity`` of an ``rcutils_uint8_array_t`` (two ``size_t``) and
then the CDR. A 64-bit little-endian sender makes 8 + 8 bytes; a 32-bit one 4 + 4; the EDORAS paper describes
1 + 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from edoras_tools.errors import ConfigError, TruncatedError
from edoras_tools.wire.cdr import CDR_BE, CDR_LE
from edoras_tools.wire.layout import Field, Layout

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class EnvelopeFormat:
    """Word size and byte order of an envelope.

    Attributes:
        width: bytes of each of the two lengths: 8, 4 or 1.
        byte_order: of both.
    """

    width: Literal[1, 4, 8] = 8
    byte_order: Literal["little", "big"] = "little"

    @property
    def size(self) -> int:
        """Bytes in front of the CDR."""
        return 2 * self.width

    @property
    def layout(self) -> Layout:
        """The table of this format."""
        return _layout(self.width, self.byte_order)

    def __str__(self) -> str:
        order = "" if self.width == 1 else " le" if self.byte_order == "little" else " be"
        return f"{self.width}/{self.width}{order}"

    @classmethod
    def of_name(cls, text: str) -> EnvelopeFormat:
        """Return the format with a name such as ``8/8`` or ``4/4 be``.

        Raises:
            ConfigError: it names none.
        """
        words = text.lower().split()
        formats = {str(item): item for item in ENVELOPE_FORMATS}
        name = " ".join(words) if len(words) > 1 or words == ["1/1"] else f"{words[0]} le" if words else ""
        if name not in formats:
            raise ConfigError(f"envelope {text!r} is not known; there are {', '.join(formats)}")
        return formats[name]

    def parse(self, data: bytes | memoryview, offset: int = 0) -> tuple[int, int]:
        """Return ``buffer_length`` and ``buffer_capacity`` at ``offset``.

        Raises:
            TruncatedError: the envelope is not whole.
        """
        values = self.layout.parse(data, offset)
        return values["buffer_length"], values["buffer_capacity"]

    def emit(self, cdr: bytes, *, capacity: int | None = None) -> bytes:
        """Write an envelope and its CDR.

        Raises:
            FieldError: a length does not fit its word.
        """
        capacity = len(cdr) if capacity is None else capacity
        return self.layout.emit({"buffer_length": len(cdr), "buffer_capacity": capacity}) + cdr


@cache
def _layout(width: int, byte_order: Literal["little", "big"]) -> Layout:
    return Layout(
        "edoras",
        "EDORAS Envelope",
        Field("buffer_length", 8 * width, "bytes of CDR that follow, encapsulation included"),
        Field("buffer_capacity", 8 * width, "the allocator's figure; never smaller than the length"),
        byte_order=byte_order,
    )


ENVELOPE_FORMATS: Final[Sequence[EnvelopeFormat]] = (
    EnvelopeFormat(8, "little"),
    EnvelopeFormat(8, "big"),
    EnvelopeFormat(4, "little"),
    EnvelopeFormat(4, "big"),
    EnvelopeFormat(1, "little"),
)
"""Every format, the likeliest first."""
DEFAULT: Final = ENVELOPE_FORMATS[0]


def detect(data: bytes | memoryview, offset: int = 0) -> EnvelopeFormat | None:
    """Detect the format: the one whose lengths fit and whose CDR begins with an encapsulation.

    Returns:
        the format, or None where none fits.
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


def holds(
    head: NDArray[np.uint8], have: NDArray[np.integer[Any]], envelope: EnvelopeFormat
) -> NDArray[np.bool_]:
    """Tell for many payloads whether an envelope of this format fits; the same test as :func:`detect`.

    Args:
        head: (n, 20) first bytes of what may be an envelope.
        have: (n,) bytes from there to the end of the packet.
    """
    size = envelope.size
    length = envelope.layout.column("buffer_length", head).astype(np.uint64)
    capacity = envelope.layout.column("buffer_capacity", head).astype(np.uint64)
    space = np.maximum(have - size, 0).astype(np.uint64)
    start = head[:, size : size + 4]
    encapsulated = (start[:, 0] == 0) & (start[:, 1] <= 1) & (start[:, 2] == 0) & (start[:, 3] == 0)
    fits: NDArray[np.bool_] = (
        (have >= size + 4) & (length >= 4) & (length <= capacity) & (length <= space) & encapsulated
    )
    return fits
