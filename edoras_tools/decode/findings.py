"""Sets of findings that several readers need."""

from __future__ import annotations

from typing import Final

from edoras_tools.model import Finding

UNKNOWABLE: Final = (
    Finding.TRUNCATED
    | Finding.LENGTH_MISMATCH
    | Finding.CHECKSUM_BAD
    | Finding.CHECKSUM_ABSENT
    | Finding.ENVELOPE_OVERRUN
    | Finding.CDR_INVALID
    | Finding.CDR_TRAILING
    | Finding.CDR_TOO_LONG
    | Finding.SBN_SIZE_MISMATCH
    | Finding.COMMAND_LENGTH
    | Finding.HEADER_ONLY
    | Finding.SBN_LEGACY_HEADER
    | Finding.STRUCT_LENGTH
)
"""What a datagram that the capture itself cut cannot be blamed for."""
