"""The packets of cFE itself and of the lab applications, and the struct of each."""

from typing import Final

from edoras_tools.wire import cfe

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
"""Struct by MsgId; :mod:`edoras_tools.structs.cfe` describes them."""
