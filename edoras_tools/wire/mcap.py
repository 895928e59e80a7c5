"""MCAP (https://mcap.dev/spec)."""

from typing import Final

MAGIC: Final = b"\x89MCAP0\r\n"
"""What a file begins and ends with."""
