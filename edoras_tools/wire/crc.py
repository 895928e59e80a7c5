"""CRC-32 as zlib, MCAP and Ethernet have it.

By the ``isal`` library, at ten times the speed of zlib's; by zlib's on machines that it is not made for.
"""

from __future__ import annotations

try:
    from isal.isal_zlib import crc32
except ImportError:
    from zlib import crc32

__all__ = ["crc32"]
