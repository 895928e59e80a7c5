"""cFE Table Services: loads of tables that wait, from the command until their application takes them.

Rules, as in the flight code:

1. A load fills a working buffer. Until it is activated, it may be repeated, validated and aborted.
2. An activated load waits until its application manages the table. Telemetry Output never does: its load
   stays pending, and no other load is accepted until it is aborted. SBN manages its table on command.
3. A load ends with its application.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.addons.lab.emulator.services.events import Event
from edoras_tools.cfs import table_services as facts

if TYPE_CHECKING:
    from edoras_tools.addons.lab.emulator.services.executive_services import ExecutiveServices


class TableServices:
    """The waiting loads. The contents of tables are those of the profile, whatever is loaded.

    Args:
        executive: applications that run; their tables are registered.
    """

    def __init__(self, executive: ExecutiveServices) -> None:
        self._executive = executive
        self._loads: dict[str, tuple[int, bool]] = {}

    def command(self, function_code: int, payload: bytes) -> Event | None:
        """Process a command of the right length; return its event, None for an activation, which is silent.

        Args:
            function_code: one of ``facts.CODES``.
        """
        name = payload[2 * (function_code == facts.VALIDATE) :].split(b"\0")[0].decode("ascii", "replace")
        table = facts.TABLE_OF.get(name, "") if function_code == facts.LOAD else name
        if not table:
            return Event.of(facts.NO_FILE, file=name)
        number = self._owner(table)
        if not number:
            return Event.of(facts.NO_TABLE, table=table)
        waits, pending = self._waiting(table)
        if function_code == facts.LOAD:
            if pending:
                return Event.of(facts.STILL_PENDING, table=table)
            self._loads[table] = number, False
            return Event.of(facts.LOADED, file=name, table=table)
        if function_code == facts.VALIDATE:
            inactive = not any(payload[:2])
            return Event.of(
                facts.NO_INACTIVE_BUFFER if inactive and not waits else facts.ASSUMED_VALID, table=table
            )
        if function_code == facts.ABORT_LOAD:
            self._loads.pop(table, None)
            return Event.of(facts.ABORTED if waits else facts.NOT_ABORTED, table=table)
        if not waits:
            return Event.of(facts.NOT_ACTIVATED, table=table)
        self._loads[table] = number, True
        return None

    def take(self, table: str) -> bool:
        """Let an application manage its table; return whether it got a new one."""
        image = self._waiting(table)[1]
        if image:
            del self._loads[table]
        return image

    def _owner(self, table: str) -> int:
        """Return the AppID of the application that registered a table; 0 if none has."""
        application = self._executive.applications.get(table.partition(".")[0])
        owns = table in facts.TABLE_OF.values() and application is not None and application.runs
        return application.number if owns and application else 0

    def _waiting(self, table: str) -> tuple[bool, bool]:
        """Return whether a table has a load, and whether the load is activated."""
        number, pending = self._loads.get(table, (0, False))
        waits = bool(number) and number == self._owner(table)
        return waits, waits and pending
