"""cFE Table Services: its name in events, its commands that replace a table, and a real cFS's answers."""

from __future__ import annotations

from functools import partial
from typing import Final

from edoras_tools.cfs.event_services import EventText, EventType

NAME: Final = "CFE_TBL"
LOAD, VALIDATE, ACTIVATE, ABORT_LOAD = 2, 4, 5, 9
CODES: Final = frozenset({LOAD, VALIDATE, ACTIVATE, ABORT_LOAD})
TABLE_NAME_BYTES: Final = 40
TABLE_OF: Final = {"/cf/to_lab_sub.tbl": "TO_LAB_APP.TO_LAB_Subs", "/cf/sbn_conf_tbl.tbl": "SBN.SBN_ConfTbl"}
"""Table of each file of a cFS that is its image; the table's name begins with its application."""

LOADED: Final = EventText(NAME, 12, "Successful load of '{file}' into '{table}' working buffer")
ABORTED: Final = EventText(NAME, 21, "Table Load Aborted for '{table}'")
ASSUMED_VALID: Final = EventText(
    NAME, 23, "Tbl Services assumes '{table}' is valid. No Validation Function has been registered"
)
UPDATED: Final = EventText(NAME, 37, "{app} Successfully Updated '{table}'")

_error: Final = partial(EventText, NAME, event_type=EventType.ERROR)
BAD_LENGTH: Final = _error(
    52, "Invalid msg length -- ID = 0x1804, CC = {code:d}, Len = {length:d}, Expected = {expected:d}"
)
NO_FILE: Final = _error(53, "Unable to open file '{file}' for table load, Status = -1")
NO_TABLE: Final = _error(57, "Unable to locate '{table}' in Table Registry")
NO_INACTIVE_BUFFER: Final = _error(66, "No Inactive Buffer for Table '{table}' present")
NOT_ABORTED: Final = _error(69, "Cannot abort load of '{table}'. No load started.")
NOT_ACTIVATED: Final = _error(70, "Cannot activate table '{table}'. No Inactive image available")
STILL_PENDING: Final = _error(88, "Attempted to load table '{table}' while previous load is still pending")
