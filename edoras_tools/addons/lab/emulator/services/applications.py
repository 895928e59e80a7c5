"""The applications of a cFS and loads of their tables: cFE Executive Services and Table Services.

Rules, as in the flight code:

1. A command to stop or restart an application only records the request. The application sees it in the next
   cycle of its main loop, and then stops reading; its pipes and its socket stay open and fill.
2. A scan follows the command at once. An application that has left its loop by then is cleaned up; any other
   one has several seconds to leave it, and is cleaned up after them in any case.
3. Cleaning up closes pipes and sockets with their contents. A restart then starts it under a new number.
4. A load of a table fills a working buffer. Until it is activated, it may be repeated, validated and aborted.
5. An activated load waits until its application manages the table. Telemetry Output never does: its load
   stays pending, and no other load is accepted until it is aborted. SBN manages its table on command.
6. A load ends with its application.

``CORE`` has cFE's own five applications: their names, pipes, MsgIds and the events that a link shows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import count
from typing import TYPE_CHECKING, Any, Final, Protocol

import msgspec

from edoras_tools.addons.lab.emulator.services.events import Event
from edoras_tools.cfs import event_services, executive_services, software_bus, table_services
from edoras_tools.cfs import executive_services as facts
from edoras_tools.cfs.event_services import EventText, EventType

if TYPE_CHECKING:
    from edoras_tools.addons.lab.emulator.scheduler import Scheduler
    from edoras_tools.cfs.profile import SimProfile

_FIRST_ID: Final = 0x110001


class LoadedApp(msgspec.Struct, eq=False):
    """An application and its resources.

    Attributes:
        name: name in events and commands.
        file: file that it is loaded from.
        begin: function that starts it: creates its pipes, sockets and tasks.
        number: AppID.
        runs: whether it is loaded.
        request: name of the pending request, as in events; empty for none.
        has_left: whether it has left its main loop.
        tasks: tasks that end with it.
        pipes: names of the pipes that it created at its start.
        ports: UDP ports that it listens on.
    """

    name: str
    file: str
    begin: Callable[[], object]
    number: int = 0
    runs: bool = False
    request: str = ""
    has_left: bool = False
    tasks: list[Any] = msgspec.field(default_factory=list)
    pipes: list[str] = msgspec.field(default_factory=list)
    ports: list[int] = msgspec.field(default_factory=list)


class Flight(Protocol):
    """The interface of the cFS for its Executive Services."""

    profile: SimProfile
    scheduler: Scheduler

    def say(self, event: EventText, **values: object) -> None:
        """Report an event with its values."""

    def restart(self) -> None:
        """Restart the processor."""

    def clean_up(self, application: LoadedApp) -> None:
        """End the tasks of an application, and close its pipes and sockets."""


class ExecutiveServices:
    """The applications of one cFS instance.

    Attributes:
        applications: applications by name, including stopped ones.
    """

    def __init__(self, cfs: Flight) -> None:
        self.applications: dict[str, LoadedApp] = {}
        self._cfs = cfs
        self._numbers = count(_FIRST_ID + len(CORE))
        self._beginning: LoadedApp | None = None

    def load(self, name: str, file: str, begin: Callable[[], object]) -> None:
        """Load an application and start it now."""
        application = self.applications[name] = LoadedApp(name, file, begin)
        self._begin(application, next(self._numbers))

    def run_loop(self, name: str) -> bool:
        """Return whether an application continues; its main loop calls this in each cycle."""
        application = self.applications.get(name)
        if application is None:
            return True
        application.has_left = bool(application.request) or not application.runs
        return not application.has_left

    def owns(self, *, task: Any = None, pipe: str = "", port: int = 0) -> None:
        """Add resources to the application that is starting now, if there is one."""
        if self._beginning is not None:
            self._beginning.tasks += [task] if task else []
            self._beginning.pipes += [pipe] if pipe else []
            self._beginning.ports += [port] if port else []

    def command(self, function_code: int, payload: bytes) -> bool:
        """Process a command that starts, stops or restarts something; return whether it was accepted."""
        if function_code == facts.RESTART:
            kind = int.from_bytes(payload[:2], "little")
            if kind not in facts.RESTART_TYPES:
                self._cfs.say(facts.BAD_RESTART_TYPE, kind=kind)
                return False
            self._cfs.restart()
            return True
        name = _text(payload[: facts.APP_NAME_BYTES])
        if function_code == facts.START_APP:
            return self._start_command(name, payload)
        return self._end_command(facts.ENDING_COMMANDS[function_code], name)

    def _start_command(self, name: str, payload: bytes) -> bool:
        file = _text(payload[2 * facts.APP_NAME_BYTES : 2 * facts.APP_NAME_BYTES + facts.FILE_NAME_BYTES])
        application = self.applications.get(name)
        if application is None or application.runs or application.file != file:
            why = facts.DUPLICATE_NAME if application and application.runs else facts.NOT_LOADED
            self._cfs.say(facts.NOT_STARTED, name=name, file=file, status=why)
            return False
        self._begin(application, next(self._numbers))
        self._cfs.say(facts.STARTED_APP, name=name, file=file, number=application.number)
        return True

    def _end_command(self, ending: facts.Ending, name: str) -> bool:
        application = self.applications.get(name)
        if any(name == item.name for item in CORE) or (application and application.request):
            self._cfs.say(ending.refused, name=name, status=facts.NOT_VALID)
            return False
        if application is None or not application.runs:
            self._cfs.say(ending.unknown, name=name, status=facts.NAME_NOT_FOUND)
            return False
        application.request = ending.verb
        scheduler = self._cfs.scheduler
        scheduler.call_at(scheduler.now + self._cfs.profile.latency_ns[1], self._scan, application)
        return True

    def _scan(self, application: LoadedApp) -> None:
        scheduler = self._cfs.scheduler
        if application.has_left:
            self._end(application)
        elif application.runs and application.request:
            scheduler.call_at(scheduler.now + self._cfs.profile.app_kill_ns, self._end, application)

    def _end(self, application: LoadedApp) -> None:
        if not application.runs:  # cFS was restarted in between
            return
        verb = application.request
        self._cfs.clean_up(application)
        application.runs, application.request = False, ""
        if verb == facts.STOP:
            self._cfs.say(facts.STOPPED_APP, name=application.name)
            return
        number = next(self._numbers)
        event = facts.RESTARTED_APP if verb == facts.RESTART_VERB else facts.RELOADED_APP
        self._cfs.say(event, name=application.name, number=number)
        scheduler = self._cfs.scheduler
        scheduler.call_at(scheduler.now + self._cfs.profile.app_start_ns, self._begin, application, number)

    def _begin(self, application: LoadedApp, number: int) -> None:
        application.number, application.runs = number, True
        application.request, application.has_left = "", False
        application.tasks, application.pipes, application.ports = [], [], []
        self._beginning = application
        try:
            application.begin()
        finally:
            self._beginning = None


def _text(data: bytes) -> str:
    return data.split(b"\0")[0].decode("ascii", "replace")


class CoreApp(msgspec.Struct, frozen=True):
    """The differences between the five applications.

    Attributes:
        name: name in events.
        pipe: name of its pipe.
        command: MsgId of its commands.
        request: MsgId of the housekeeping request.
        telemetry: MsgId of its housekeeping packet.
        others: further MsgIds that it subscribes to.
        no_op_id: number of the no-op event.
        no_op_text: start of that event's text; the version follows.
        bad_length_id: number of the event for a command of a wrong length; None if none was ever captured.
        bad_length_msg_id: format of the MsgId in that event.
        bad_code_id: number of the event for a function code that it does not have.
        bad_code_text: text of that event.
        packets: function code to the packet that the command requests: MsgId and payload bytes.
    """

    name: str
    pipe: str
    command: int
    request: int
    telemetry: int
    no_op_id: int
    bad_code_id: int
    bad_code_text: str = "Invalid command code -- ID = 0x{msg_id:X}, CC = {code:d}"
    others: tuple[int, ...] = ()
    no_op_text: str = "No-op Cmd Rcvd:  "
    bad_length_id: int | None = None
    bad_length_msg_id: str = "0x{msg_id:04X}"
    packets: Mapping[int, tuple[int, int]] = msgspec.field(default_factory=dict)

    @property
    def initialized(self) -> EventText:
        """Return the event at the start."""
        short = self.name.removeprefix("CFE_")
        return EventText(self.name, 1, f"cFE {short} Initialized:  {{version}}")

    @property
    def no_op(self) -> EventText:
        """Return the event of a no-op."""
        return EventText(self.name, self.no_op_id, self.no_op_text + "{version}")

    @property
    def bad_code(self) -> EventText:
        """Return the event of an unknown function code."""
        return EventText(self.name, self.bad_code_id, self.bad_code_text, EventType.ERROR)

    @property
    def bad_length(self) -> EventText | None:
        """Return the event of a command that is too short or too long."""
        if self.bad_length_id is None:
            return None
        text = f"Invalid msg length: ID = {self.bad_length_msg_id},  CC = {{code:d}}, Len = {{length:d}}, "
        return EventText(self.name, self.bad_length_id, f"{text}Expected = {{expected:d}}", EventType.ERROR)


CORE: Final = (
    CoreApp(
        *(event_services.NAME, "EVS_CMD_PIPE", 0x1801, 0x1809, 0x0801, 0, 15),
        bad_code_text="Invalid command code -- ID = 0x{msg_id:08x}, CC = {code:d}",
        bad_length_id=43,
        bad_length_msg_id="0x{msg_id:X}",
    ),
    CoreApp(
        *(software_bus.NAME, "SB_CMD_PIPE", 0x1803, 0x180B, 0x0803, 28, 42),
        bad_code_text="Invalid Cmd, Unexpected Command Code {code:d}",
        others=(0x180E,),
        packets={2: (0x080A, 828)},
    ),
    CoreApp(
        *(executive_services.NAME, "ES_CMD_PIPE", 0x1806, 0x1808, 0x0800, 3, 22),
        bad_code_text="Invalid ground command code: ID = 0x{msg_id:X}, CC = {code:d}",
        no_op_text="No-op command:\n ",
        bad_length_id=23,
    ),
    CoreApp(
        *("CFE_TIME", "TIME_CMD_PIPE", 0x1805, 0x180D, 0x0805, 4, 27),
        others=(0x1811, 0x1862),
        packets={2: (0x0806, 200)},
    ),
    CoreApp("CFE_TBL", "TBL_CMD_PIPE", 0x1804, 0x180C, 0x0804, 10, 51),
)
"""The five applications in the order in which they start."""


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
            function_code: one of ``table_services.CODES``.
        """
        name = (
            payload[2 * (function_code == table_services.VALIDATE) :]
            .split(b"\0")[0]
            .decode("ascii", "replace")
        )
        table = table_services.TABLE_OF.get(name, "") if function_code == table_services.LOAD else name
        if not table:
            return Event.of(table_services.NO_FILE, file=name)
        number = self._owner(table)
        if not number:
            return Event.of(table_services.NO_TABLE, table=table)
        waits, pending = self._waiting(table)
        if function_code == table_services.LOAD:
            if pending:
                return Event.of(table_services.STILL_PENDING, table=table)
            self._loads[table] = number, False
            return Event.of(table_services.LOADED, file=name, table=table)
        if function_code == table_services.VALIDATE:
            inactive = not any(payload[:2])
            return Event.of(
                table_services.NO_INACTIVE_BUFFER if inactive and not waits else table_services.ASSUMED_VALID,
                table=table,
            )
        if function_code == table_services.ABORT_LOAD:
            self._loads.pop(table, None)
            return Event.of(table_services.ABORTED if waits else table_services.NOT_ABORTED, table=table)
        if not waits:
            return Event.of(table_services.NOT_ACTIVATED, table=table)
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
        owns = table in table_services.TABLE_OF.values() and application is not None and application.runs
        return application.number if owns and application else 0

    def _waiting(self, table: str) -> tuple[bool, bool]:
        """Return whether a table has a load, and whether the load is activated."""
        number, pending = self._loads.get(table, (0, False))
        waits = bool(number) and number == self._owner(table)
        return waits, waits and pending
