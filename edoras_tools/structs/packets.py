"""The packets of cFE itself and of the lab applications, and robots' datagrams: the struct of each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from edoras_tools.wire import cfe, robot

if TYPE_CHECKING:
    from edoras_tools.wire.msg_id import MsgIds

SHIPPED: Final = "cfe"
"""The name of their layout."""
PACKETS: Final = {
    0x0800: "CFE_ES_HousekeepingTlm",
    0x0801: "CFE_EVS_HousekeepingTlm",
    cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID: "CFE_SB_HousekeepingTlm",
    0x0804: "CFE_TBL_HousekeepingTlm",
    0x0805: "CFE_TIME_HousekeepingTlm",
    0x0806: "CFE_TIME_DiagnosticTlm",
    cfe.EVENT_MSG_ID: "CFE_EVS_LongEventTlm",
    0x080A: "CFE_SB_StatsTlm",
    0x080B: "CFE_ES_OneAppTlm",
    0x0880: "TO_LAB_HkTlm",
    0x0884: "CI_LAB_HkTlm",
}
"""Struct by MsgId of version 1; :mod:`edoras_tools.structs.cfe` describes them."""
UDP_KEY: Final = 1 << 16
"""A key from here on is a UDP port, not a MsgId: of datagrams of the robot link, on any port if it is 0."""
FPRIME_KEY: Final = 2 * UDP_KEY
"""A key from here on is a place in the table of a dictionary's entries."""
DATAGRAMS: Final = {layout.size: layout for layout in robot.SENT_TO}
"""The header that a datagram on the robot link is, by its bytes."""
OWN_LAYERS: Final = frozenset(
    layout.name for layout in (cfe.EVENT, cfe.SOFTWARE_BUS_HOUSEKEEPING, *DATAGRAMS.values())
)
"""Headers that are structs as well: their layers show the same fields."""


def packets(msg_ids: MsgIds) -> dict[int, str]:
    """Return :data:`PACKETS` by the MsgIds of a version, without one that would be 0, which cFE refuses."""
    return {msg_id: name for msg_id_1, name in PACKETS.items() if (msg_id := msg_ids.of_known(msg_id_1))}
