"""MCAP (https://mcap.dev/spec)."""

from typing import Final

MAGIC: Final = b"\x89MCAP0\r\n"
"""What a file begins and ends with."""
RECORD_PREFIX_BYTES: Final = 9
"""What a record's length does not count: its opcode, and the length itself."""
