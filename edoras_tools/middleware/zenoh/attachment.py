"""The attachment that rmw_zenoh adds to each message: sender, time and sequence number."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import FieldError, TruncatedError, WireError

if TYPE_CHECKING:
    from typing_extensions import Self

GID: Final = 16
"""Bytes of a publisher's id."""
ATTACHMENT: Final = struct.Struct(f"<qqB{GID}s")
"""Sequence number, source time in ns, length of the id (one byte of Zenoh's variable-length numbers), id."""


@dataclass(frozen=True, slots=True)
class Attachment:
    """The attachment of a message, 33 bytes, little-endian.

    Attributes:
        sequence_number: i64, from 1, one more for each message of a publisher.
        source_timestamp: i64, ns since 1970-01-01 UTC.
        source_gid: the publisher's id, 16 bytes.
    """

    sequence_number: int
    source_timestamp: int
    source_gid: bytes

    @classmethod
    def parse(cls, data: bytes) -> Self:
        """Read an attachment.

        Raises:
            TruncatedError: there are fewer bytes.
            FieldError: the id is of another length.
            WireError: there are more bytes.
        """
        if len(data) < ATTACHMENT.size:
            raise TruncatedError("attachment", 0, ATTACHMENT.size, len(data))
        sequence_number, source_timestamp, size, gid = ATTACHMENT.unpack_from(data)
        if size != GID:
            raise FieldError("attachment", "source_gid", f"{size} bytes are announced; an id has {GID}")
        if len(data) > ATTACHMENT.size:
            raise WireError(
                f"attachment: {len(data) - ATTACHMENT.size} bytes follow the id; {ATTACHMENT.size} is all"
            )
        return cls(sequence_number, source_timestamp, gid)

    def emit(self) -> bytes:
        """Return the attachment's bytes.

        Raises:
            FieldError: a number needs more than 64 bits, or the id is not of 16 bytes.
        """
        if len(self.source_gid) != GID:
            raise FieldError("attachment", "source_gid", f"{len(self.source_gid)} bytes; an id has {GID}")
        for name in ("sequence_number", "source_timestamp"):
            if not -(2**63) <= getattr(self, name) < 2**63:
                raise FieldError("attachment", name, f"{getattr(self, name)} exceeds 64 bits")
        return ATTACHMENT.pack(self.sequence_number, self.source_timestamp, GID, self.source_gid)
