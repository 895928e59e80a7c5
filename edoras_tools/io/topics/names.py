"""Names in recordings, and constants of MCAP (https://mcap.dev/spec)."""

from typing import Final

MAGIC: Final = b"\x89MCAP0\r\n"
"""The first and last bytes of a file."""
RECORD_PREFIX_BYTES: Final = 9
"""Bytes that a record's length does not include: its opcode, and the length itself."""
DATAGRAMS_TOPIC: Final = "/edoras/datagrams"
OUTAGE_METADATA_NAME: Final = "edoras_outage"
"""A metadata record when an interface went away, and another when it returned."""
APART: Final = "/dds"
"""Put before a topic of DDS that the mission has too, or that two types have: its messages are not mixed."""
