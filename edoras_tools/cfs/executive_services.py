"""cFE Executive Services: its name in events, its commands and events about applications."""

from __future__ import annotations

from typing import Final

NAME: Final = "CFE_ES"
COMMAND_MSG_ID: Final = 0x1806
RESTART, START_APP, STOP_APP, RESTART_APP, RELOAD_APP = 2, 4, 5, 6, 7
ENDS_APP: Final = frozenset({STOP_APP, RESTART_APP, RELOAD_APP})
"""Function codes after which an application does not read on."""
STARTED, STOPPED, RESTARTED = 6, 8, 10
"""Events: ``Started NAME from FILE``, ``Stop Application NAME Completed.``, ``Restart Application NAME``."""
APP_NAME_BYTES: Final = 20
