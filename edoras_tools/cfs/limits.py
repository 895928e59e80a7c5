"""Lengths at which a receiver on the link cuts, drops or refuses; measured, see ``docs/wire.md``."""

from __future__ import annotations

from typing import Final

CI_BUFFER: Final = 768
"""CI_LAB receives into so many bytes; a longer datagram is cut, and accepted silently."""
BRIDGE_BUFFER: Final = 1024
"""The ground bridge receives into so many bytes; a longer packet is published as garbage."""
BRIDGE_LENGTH_MODULUS: Final = 256
"""The flight bridge keeps the received length in a ``uint8_t``: below 11 then, it drops the datagram."""
FLIGHT_BRIDGE_BUFFER: Final = 4096
"""The flight bridge receives into so many bytes, SBN header included."""
SOFTWARE_BUS_MAXIMUM: Final = 32768
"""CFE_MISSION_SB_MAX_SB_MSG_SIZE: cFE refuses a longer packet."""
