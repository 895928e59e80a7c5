"""cFE's own five applications, as a link shows them: no-op, counters, housekeeping once a second.

SCH_LAB is here too: it asks them, and others, for their housekeeping.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from edoras_tools.addons.lab.emulator.cfs import EMULATOR_VERSION, Cfs
from edoras_tools.addons.lab.emulator.messages import command_length, whole_packet
from edoras_tools.addons.lab.emulator.scheduler import Receive, SleepUntil, Work
from edoras_tools.addons.lab.emulator.services.applications import CORE, CoreApp
from edoras_tools.cfs import (
    command_ingest,
    event_services,
    executive_services,
    sbn,
    software_bus,
    table_services,
    telemetry_output,
    time_services,
)
from edoras_tools.cfs.arguments import ARGUMENTS, TBL_MSG_ID
from edoras_tools.cfs.event_services import EventType
from edoras_tools.cfs.executive_services import ENDING_COMMANDS
from edoras_tools.cfs.names import COMMANDS
from edoras_tools.units import MICROSECOND, MILLISECOND, SECOND
from edoras_tools.wire import cfe
from edoras_tools.wire.cfe import function_code_of, length_of, msg_id_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from edoras_tools.addons.lab.emulator.apps.edoras import EdorasApp
    from edoras_tools.addons.lab.emulator.scheduler import Task
    from edoras_tools.addons.lab.emulator.services.software_bus import Pipe

_APPLICATIONS: Final = frozenset({executive_services.RESTART, executive_services.START_APP, *ENDING_COMMANDS})
_BUILD: Final = {"date": "000000000000", "user": "edoras-tools", "host": "emulator", "config": "emulated"}


def start_core(cfs: Cfs) -> None:
    """Start the five applications."""
    profile = cfs.profile
    loss, nobody = profile.bus_loss_events, profile.bus_no_subscribers_events
    filters = {
        software_bus.NAME: {
            software_bus.NO_SUBSCRIBERS: nobody,
            software_bus.MSG_LIMIT: loss,
            software_bus.PIPE_OVERFLOW: loss,
        }
    }
    for item in CORE:
        cfs.events.register(item.name, now=cfs.scheduler.now, stop_after=filters.get(item.name))
        pipe = cfs.create_pipe(item.pipe, item.command, item.request, *item.others)
        cfs.say(item.initialized, version=EMULATOR_VERSION)
        if item.name == executive_services.NAME:
            _say_versions(cfs)
        cfs.spawn(_run(cfs, item, pipe))


def _say_versions(cfs: Cfs) -> None:
    """Report the versions of the build, as Executive Services does at the start."""
    version = {"version": EMULATOR_VERSION}
    cfs.say(executive_services.VERSIONS, **version, checksum=0)
    cfs.say(executive_services.MISSION, mission="emulated", **version)
    for module in executive_services.MODULES:
        cfs.say(executive_services.MODULE, module=module, **version)
    cfs.say(executive_services.BUILD, **_BUILD)


def _run(cfs: Cfs, core: CoreApp, pipe: Pipe) -> Task:
    counters = [0, 0]
    body = _BODIES[core.name]
    while True:
        packet = yield Receive(pipe)
        msg_id = msg_id_of(packet)
        if msg_id == core.request:
            yield Work(cfs.profile.housekeeping_work_ns)
            cfs.telemetry(core.telemetry, body(cfs, counters[0] & 0xFF, counters[1] & 0xFF), core.name)
        elif msg_id == core.command:
            # Longer than one cycle of its sender's loop: a name is looked up, and a line is printed.
            yield Work(cfs.profile.housekeeping_work_ns)
            accepted = _command(cfs, core, packet)
            counters[not accepted] += 1
            if core.name == executive_services.NAME and accepted and _resets(packet):
                counters[:] = 0, 0
            if core.name == software_bus.NAME:
                cfs.bus.counters.commands, cfs.bus.counters.command_errors = counters


def _resets(packet: bytes) -> bool:
    return function_code_of(packet) == executive_services.RESET_COUNTERS


def _command(cfs: Cfs, core: CoreApp, packet: bytes) -> bool:
    function_code, size = function_code_of(packet), length_of(packet)
    payload = whole_packet(packet)[cfe.COMMAND_HEADER_BYTES :]
    if function_code not in COMMANDS[core.command]:
        cfs.say(core.bad_code, msg_id=core.command, code=function_code)
        return False
    if function_code == 0:
        if size != cfe.COMMAND_HEADER_BYTES:
            return _wrong_length(cfs, core, function_code, size, cfe.COMMAND_HEADER_BYTES)
        if core.name == executive_services.NAME:
            cfs.say(executive_services.BUILD, **_BUILD)
        cfs.say(core.no_op, version=EMULATOR_VERSION)
        return True
    if core.name == executive_services.NAME and function_code == executive_services.RESET_COUNTERS:
        cfs.say(executive_services.COUNTERS_RESET)
        return True
    if core.name == executive_services.NAME and function_code in _APPLICATIONS:
        return cfs.executive.command(function_code, payload)
    layout = ARGUMENTS.get((core.command, function_code))
    expected = cfe.COMMAND_HEADER_BYTES + layout.size if layout else size
    if core.name == event_services.NAME and size != expected:
        return _wrong_length(cfs, core, function_code, size, expected)
    if core.name == event_services.NAME and (answers := cfs.events.command(function_code, payload)):
        for event in answers:
            cfs.report(event)
        return all(event.event_type is not EventType.ERROR for event in answers)
    if core.name == time_services.NAME and function_code in time_services.SETS:
        event = cfs.clock.command(function_code, payload, cfs.scheduler.now)
        cfs.report(event)
        return event.event_type is not EventType.ERROR
    if core.name == table_services.NAME and function_code in table_services.CODES:
        return _table(cfs, function_code, size, payload)
    if function_code in core.packets:
        telemetry, size = core.packets[function_code]
        cfs.telemetry(telemetry, bytes(size), core.name)
        return True
    cfs.print(f"{core.name}: command {function_code} is not emulated")
    return False


def _wrong_length(cfs: Cfs, core: CoreApp, code: int, size: int, expected: int) -> bool:
    """Report a command that is too short or too long, if its application does; it is refused."""
    if core.bad_length is not None:
        length, expected = (command_length(item, cfs.profile) for item in (size, expected))
        cfs.say(core.bad_length, msg_id=core.command, code=code, length=length, expected=expected)
    return False


def _table(cfs: Cfs, function_code: int, size: int, payload: bytes) -> bool:
    """Process a command on a table; notify SBN when its own table has a new image."""
    expected = cfe.COMMAND_HEADER_BYTES + ARGUMENTS[TBL_MSG_ID, function_code].size
    if size != expected:
        length, expected = (command_length(item, cfs.profile) for item in (size, expected))
        cfs.say(table_services.BAD_LENGTH, code=function_code, length=length, expected=expected)
        return False
    event = cfs.tables.command(function_code, payload)
    if event is not None:
        cfs.report(event)
        return event.event_type is not EventType.ERROR
    if payload.startswith(sbn.TABLE.encode() + b"\0"):
        cfs.publish(cfe.emit_command(sbn.COMMAND_MSG_ID, sbn.RELOAD, bytes(4)), table_services.NAME)
    return True


def _counters_in(size: int) -> Callable[[Cfs, int, int], bytes]:
    """Return what makes a body of which only the two counters are emulated."""
    return lambda _, commands, errors: bytes([commands, errors]).ljust(size, b"\0")


def _events(cfs: Cfs, commands: int, errors: int) -> bytes:
    head = bytes([commands, errors, 1, 0, 0, 1, 0, 0]) + (cfs.events.sent & 0xFFFF).to_bytes(2, "little")
    applications = b"".join(
        index.to_bytes(4, "little")
        + (item.sent & 0xFFFF).to_bytes(2, "little")
        + bytes([1, min(item.squelched, 255)])
        for index, item in enumerate(cfs.events.applications.values(), 0x110001)
    )
    return (head.ljust(16, b"\0") + applications)[:144].ljust(144, b"\0")


def _time(cfs: Cfs, commands: int, errors: int) -> bytes:
    clock, now = cfs.clock, cfs.scheduler.now
    clock.time_ns(now)
    parts = (divmod(value % (SECOND << 32), SECOND) for value in (clock.met_ns(now), clock.stcf_ns))
    words = [word for seconds, rest in parts for word in (seconds, (rest << 32) // SECOND)]
    flags = bytes(2) + b"\xff\xff" + clock.leap_seconds.to_bytes(2, "little", signed=True)
    body = b"".join((word & 0xFFFFFFFF).to_bytes(4, "little") for word in words)
    return (bytes([commands, errors]) + flags + body).ljust(32, b"\0")


_BODIES: Final[Mapping[str, Callable[[Cfs, int, int], bytes]]] = {
    executive_services.NAME: _counters_in(148),
    event_services.NAME: _events,
    software_bus.NAME: lambda cfs, _commands, _errors: cfs.bus.housekeeping(),
    time_services.NAME: _time,
    table_services.NAME: _counters_in(284),
}


SCHEDULER: Final = "SCH_LAB_APP"
SCHEDULE_LEAD_NS: Final = 17 * MILLISECOND
"""Time by which the first housekeeping request comes before a whole period after start, as captured."""


def start_scheduler(cfs: Cfs, edoras: EdorasApp) -> None:
    """Start SCH_LAB: it sends housekeeping requests, and the wake-ups that applications request."""
    requests = [item.request for item in CORE]
    requests += [command_ingest.REQUEST_MSG_ID, telemetry_output.REQUEST_MSG_ID, *edoras.requests]
    cfs.spawn(_ask(cfs, requests, cfs.profile.housekeeping_ns))
    if edoras.wakeups:
        cfs.spawn(_ask(cfs, edoras.wakeups, cfs.profile.wakeup_ns))


def _ask(cfs: Cfs, msg_ids: Sequence[int], period_ns: int) -> Task:
    due = cfs.scheduler.now + cfs.profile.housekeeping_ns
    due -= min(SCHEDULE_LEAD_NS, cfs.profile.housekeeping_ns // 2)
    while cfs.executive.run_loop(SCHEDULER):
        yield SleepUntil(due)
        for item in msg_ids:
            cfs.publish(cfe.emit_command(item, 0), SCHEDULER)
            yield Work(3 * MICROSECOND)
        due += period_ns
