"""cFE Executive Services: its name in events, its commands and events about applications."""

from __future__ import annotations

from typing import Final, NamedTuple

from edoras_tools.cfs.event_services import EventText, EventType

NAME: Final = "CFE_ES"
COMMAND_MSG_ID: Final = 0x1806
RESET_COUNTERS = 1
COUNTERS_RESET: Final = EventText(NAME, 4, "Reset Counters command")
RESTART, START_APP, STOP_APP, RESTART_APP, RELOAD_APP = 2, 4, 5, 6, 7
ENDS_APP: Final = frozenset({STOP_APP, RESTART_APP, RELOAD_APP})
"""Function codes after which an application stops reading."""
STARTED, STOPPED, RESTARTED, RELOADED = 6, 8, 10, 12
"""Events: ``Started NAME from FILE``, ``Stop Application NAME Completed.``, ``Restart Application NAME``."""
APP_NAME_BYTES: Final = 20
FILE_NAME_BYTES: Final = 64
STARTS: Final = {
    "CI_LAB_APP": ("/cf/ci_lab.so", "CI_LAB_AppMain"),
    "TO_LAB_APP": ("/cf/to_lab.so", "TO_LAB_AppMain"),
    "SCH_LAB_APP": ("/cf/sch_lab.so", "SCH_LAB_AppMain"),
    "CI_LAB": ("/cf/ci_lab.so", "CI_LAB_AppMain"),
    "TO_LAB": ("/cf/to_lab.so", "TO_LAB_AppMain"),
    "SBN": ("/cf/sbn.so", "SBN_AppMain"),
    "EDORAS_APP": ("/cf/edoras_app.so", "EdorasAppMain"),
}
"""File and entry point of each application in the usual ``cfe_es_startup.scr``.

CI_LAB and TO_LAB are names of cFS 7.
"""
SCHEDULERS: Final = frozenset({"SCH_LAB_APP", "SCH_LAB", "SCH"})
"""Applications that request all housekeeping, and receive no topic."""
TICK_MSG_ID: Final = 0x1811
"""MsgId that wakes them once a second."""
USUAL_STACK_BYTES: Final = 65536
USUAL_PRIORITY: Final = 50
RESTART_TYPES: Final = frozenset({1, 2})
"""Types of a processor restart: a processor reset, a power-on reset."""
MARKERS: Final = {
    1: "CFE_ES",
    2: "CFE_EVS",
    3: "CFE_TBL",
    4: "CFE_SB",
    5: "CFE_SB message limit",
    6: "CFE_TIME",
    7: "CFE_TIME tone ISR",
    8: "CFE_TIME local ISR",
    9: "CFE_TIME send MET",
    10: "CFE_TIME local task",
    11: "CFE_TIME tone task",
    27: "CFE_SB pipe overflow",
}
"""Names of the performance log's markers that cFE itself sets; the others are a mission's own."""

NOT_VALID: Final = 0xC4000001
"""``CFE_ES_ERR_RESOURCEID_NOT_VALID``: a core application, or one that does not run."""
NAME_NOT_FOUND: Final = 0xC4000002
NOT_LOADED: Final = 0xC4000009
"""``CFE_ES_ERR_LOAD_LIB``."""
DUPLICATE_NAME: Final = 0xC400002E

STOP: Final = "Stop"
RESTART_VERB: Final = "Restart"
RELOAD_VERB: Final = "Reload"

BUILD: Final = EventText(NAME, 92, "Build {date} by {user}@{host}, config {config}")
"""Build information, reported before the event of a no-op."""
VERSIONS: Final = EventText(NAME, 2, "cFS Versions: {version}. cFE chksm {checksum:d}")
MISSION: Final = EventText(NAME, 91, "Version Info: Mission {mission}, version {version}")
MODULE: Final = EventText(NAME, 91, "Version Info: Module {module}, version {version}")
MODULES: Final = (
    *("CORE_API", "ES", "EVS", "FS", "SB", "TBL", "TIME", "OSAL", "PSP", "MSG", "SBR", "RESOURCEID"),
    "CONFIG",
)
"""Modules whose versions it reports at the start, in order."""
BAD_RESTART_TYPE: Final = EventText(NAME, 24, "Invalid cFE restart type: {kind:d}", EventType.ERROR)
STARTED_APP: Final = EventText(NAME, STARTED, "Started {name} from {file}, AppID = {number:d}")
NOT_STARTED: Final = EventText(
    NAME, 26, "Failed to start {name} from {file}, RC = 0x{status:08X}", EventType.ERROR
)
STOPPED_APP: Final = EventText(NAME, STOPPED, "Stop Application {name} Completed.")
RESTARTED_APP: Final = EventText(NAME, RESTARTED, "Restart Application {name} Completed, AppID={number:d}")
RELOADED_APP: Final = EventText(NAME, RELOADED, "Reload Application {name} Completed, AppID={number:d}")


class Ending(NamedTuple):
    """A command that ends an application.

    Attributes:
        verb: word for the action in events.
        refused_id: number of the event for an application that does not run, or is part of the core.
        unknown_id: number of the event for a name that no application has.
    """

    verb: str
    refused_id: int
    unknown_id: int

    @property
    def refused(self) -> EventText:
        """Return the event for an application that does not run, or is part of the core."""
        text = f"{self.verb} Application {{name}} Failed, RC = 0x{{status:08X}}"
        return EventText(NAME, self.refused_id, text, EventType.ERROR)

    @property
    def unknown(self) -> EventText:
        """Return the event for a name that no application has."""
        text = f"{self.verb} Application {{name}}, GetAppIDByName failed. RC = 0x{{status:08X}}."
        return EventText(NAME, self.unknown_id, text, EventType.ERROR)


ENDING_COMMANDS: Final = {
    STOP_APP: Ending(STOP, 35, 36),
    RESTART_APP: Ending(RESTART_VERB, 38, 39),
    RELOAD_APP: Ending(RELOAD_VERB, 42, 43),
}
"""The commands that end an application, by function code."""
