"""Lengths at which a receiver on the link cuts, drops or refuses; measured, see ``docs/wire.md``."""

from __future__ import annotations

from typing import Final

CI_BUFFER: Final = 768
"""Bytes of CI_LAB's receive buffer; a longer datagram is cut, and accepted silently."""
BRIDGE_BUFFER: Final = 1024
"""Bytes of the ground bridge's receive buffer; a longer packet is published as garbage."""
BRIDGE_LENGTH_MODULUS: Final = 256
"""Modulus of the flight bridge's length, a ``uint8_t``: if the result is below 11, it drops the datagram."""
FLIGHT_BRIDGE_BUFFER: Final = 4096
"""Bytes of the flight bridge's receive buffer, SBN header included."""
SOFTWARE_BUS_MAXIMUM: Final = 32768
"""CFE_MISSION_SB_MAX_SB_MSG_SIZE, in bytes: cFE refuses a longer packet."""
