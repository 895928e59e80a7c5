"""cFE's own five applications, as a link shows them: no-op, counters, housekeeping once a second.

SCH_LAB is here too: it asks them, and others, for their housekeeping. So are the EDORAS flight applications:
one with its robot behind it, one with two robots across SBN.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import msgspec

from edoras_tools.addons.lab.emulator import messages
from edoras_tools.addons.lab.emulator.cfs import EMULATOR_VERSION, Cfs, SystemRoutes
from edoras_tools.addons.lab.emulator.messages import FixedStruct, command_length, whole_packet
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
from edoras_tools.cfs import edoras_app as facts
from edoras_tools.cfs.arguments import ARGUMENTS, TBL_MSG_ID
from edoras_tools.cfs.event_services import EventType
from edoras_tools.cfs.executive_services import ENDING_COMMANDS
from edoras_tools.cfs.names import COMMANDS
from edoras_tools.errors import WireError
from edoras_tools.links import CFS_PORT
from edoras_tools.model import Endpoint
from edoras_tools.units import MICROSECOND, MILLISECOND, SECOND
from edoras_tools.wire import cfe
from edoras_tools.wire.cfe import function_code_of, length_of, msg_id_of

if TYPE_CHECKING:
    from edoras_tools.addons.lab.emulator.bridges import Robot
    from edoras_tools.addons.lab.emulator.scheduler import Task
    from edoras_tools.addons.lab.emulator.services.software_bus import Pipe

_ROBOT_WORK: Final = 4
_REQUEST: Final = 0x1828
ROBOT_HOUSEKEEPING: Final = 0x0826
_WAKEUP: Final = 0x182B
"""Wake-up MsgId of an application without a route for it; if a route uses it, the next free one."""


class EdorasApp:
    """An EDORAS application of the emulated cFS.

    Attributes:
        subscriptions: MsgIds that it receives.
        requests: MsgIds that the scheduler sends to it once a second.
        wakeups: MsgIds that the scheduler sends to it each ``wakeup_ns``.
        telemetry: MsgIds that go to the ground.
        crossed: MsgId to the number of messages sent under it in place of another MsgId.
    """

    subscriptions: Sequence[int] = ()
    requests: Sequence[int] = ()
    wakeups: Sequence[int] = ()
    telemetry: Sequence[int] = ()

    def __init__(self) -> None:
        self.crossed: Counter[int] = Counter()

    def start(self, cfs: Cfs) -> None:
        """Create its pipe and start its task."""
        cfs.events.register(facts.NAME, now=cfs.scheduler.now)
        pipe = cfs.create_pipe(facts.PIPE, *self.subscriptions, limit=cfs.profile.app_msg_limit)
        cfs.say(facts.INITIALIZED, version="Emulated")
        cfs.spawn(self._run(cfs, pipe))

    def _run(self, cfs: Cfs, pipe: Pipe) -> Task:
        raise NotImplementedError


def _accepted(cfs: Cfs, packet: bytes) -> bool:
    """Return whether a packet is a "set"; report the error of any other, as the flight code does."""
    function_code, size = function_code_of(packet), length_of(packet)
    if function_code == facts.SET:
        return True  # its length is not checked
    if function_code != facts.NO_OP:
        cfs.say(facts.BAD_FUNCTION_CODE, code=function_code)
    elif size != cfe.COMMAND_HEADER_BYTES:
        length, expected = (messages.command_length(n, cfs.profile) for n in (size, cfe.COMMAND_HEADER_BYTES))
        cfs.say(
            facts.BAD_LENGTH, msg_id=msg_id_of(packet), code=facts.NO_OP, length=length, expected=expected
        )
    else:
        cfs.say(facts.NO_OP_DONE, version="Emulated")
    return False


def _decoded(cfs: Cfs, type_name: str, packet: bytes) -> Mapping[str, Any] | None:
    """Return the values of a command; None if they cannot be decoded."""
    form = cfs.routes.envelope(msg_id_of(packet))
    return messages.decode_envelope(type_name, packet[cfe.COMMAND_HEADER_BYTES :], form, cfs.routes.store)


class SingleRobotApp(EdorasApp):
    """Demos 1 and 2: the robot is connected to the application; its state goes to the ground once a second.

    As in flight, a stopped application leaves its socket to the robot open. After a restart it cannot bind
    the socket, and nothing reaches the robot until cFS restarts.

    Attributes:
        robot: robot that gets the commands and reports its state.
        robot_commands: commands that reached the robot.
        has_robot: whether the application could bind its socket to the robot.
        command: MsgId of the robot's commands.
    """

    def __init__(self, robot: Robot, routes: SystemRoutes) -> None:
        super().__init__()
        self.robot, self.robot_commands, self.has_robot = robot, 0, False
        self.command, *_ = *routes.commands, 0
        self._states = [
            (item, FixedStruct(routes.state_bytes, routes.envelope(item))) for item in routes.telemetry
        ]
        used = {*routes.commands, *routes.telemetry}
        self.request = next(item for item in range(_REQUEST, cfe.HIGHEST_MSG_ID) if item not in used)
        self.housekeeping = next(item for item in range(ROBOT_HOUSEKEEPING, 0, -1) if item not in used)
        self.requests = (self.request,)
        self.telemetry = (self.housekeeping, *routes.telemetry)
        # 0x0828 too: the flight app subscribes to it, although nothing here publishes it.
        self.subscriptions = (self.request, *routes.commands, 0x0828)
        self._routes = routes
        self._requests = self._boot = 0

    def start(self, cfs: Cfs) -> None:
        """Create its pipe and start its task."""
        self.has_robot = self._boot != cfs.boots
        self._boot = cfs.boots
        if not self.has_robot:
            cfs.print(facts.PORT_TAKEN)
        super().start(cfs)

    def _run(self, cfs: Cfs, pipe: Pipe) -> Task:
        while cfs.executive.run_loop(facts.NAME):
            packet = yield Receive(pipe)
            msg_id = msg_id_of(packet)
            if msg_id == self.request:
                yield Work(_ROBOT_WORK * cfs.profile.work_ns)
                for place, (state, struct) in enumerate(self._states):
                    own = self._routes.types[state]
                    struct.put(
                        messages.encode(own, {}, self._routes.store)
                        if place
                        else self.robot.state(now=cfs.scheduler.now)
                    )
                    cfs.telemetry(state, struct.data, facts.NAME)
                yield Work(_ROBOT_WORK * cfs.profile.work_ns)
                counters = bytes([2 * self._requests & 0xFF, self._requests & 0xFF])
                cfs.telemetry(self.housekeeping, counters.ljust(56, b"\0"), facts.NAME)
                self._requests += 1
            elif msg_id in self._routes.commands and _accepted(cfs, packet):
                values = _decoded(cfs, self._routes.types[msg_id], packet)
                self.robot_commands += self.has_robot
                if values is None:
                    cfs.print(facts.UNREADABLE)
                elif self.has_robot:
                    if msg_id == self.command:
                        self.robot.obey(values, now=cfs.scheduler.now)
                    self._send(cfs, values)
                yield Work(cfs.profile.obey_work_ns)

    def _send(self, cfs: Cfs, values: Mapping[str, Any]) -> None:
        """Send a command to the robot, if the robot has a port."""
        profile, data = cfs.profile, messages.robot_datagram(values)
        if profile.robot_port and data is not None:
            own, robot = (Endpoint(profile.address, port) for port in (CFS_PORT, profile.robot_port))
            cfs.send(own, robot, data)


class _Channel(msgspec.Struct):
    """The two messages of one robot, kept in structs of fixed size."""

    command: FixedStruct
    state: FixedStruct
    fresh: bool = False


class TwoRobotApp(EdorasApp):
    """Demos 3 and 4: every message is decoded, encoded again and sent under another MsgId.

    A command from the ground waits for the next wake-up, so only the last of a burst is sent; a robot's
    state is sent at once.
    """

    def __init__(self, routes: SystemRoutes) -> None:
        super().__init__()
        self.commands, self.states = routes.commands, routes.states
        self.flight, self.telemetry = routes.flight, routes.telemetry
        used = {*self.commands, *self.states}
        wakeup = next(item for item in range(_WAKEUP, cfe.HIGHEST_MSG_ID) if item not in used)
        self.wakeups = (wakeup,)
        self.subscriptions = (*self.commands, *self.states, wakeup)
        self._types = routes.types
        self._channels = [
            _Channel(
                FixedStruct(routes.command_bytes, routes.envelope(command)),
                FixedStruct(routes.state_bytes, routes.envelope(state)),
            )
            for command, state in zip(self.flight, self.telemetry, strict=True)
        ]

    def _run(self, cfs: Cfs, pipe: Pipe) -> Task:
        while cfs.executive.run_loop(facts.NAME):
            packet = yield Receive(pipe)
            msg_id = msg_id_of(packet)
            if msg_id in self.wakeups:
                for index, channel in enumerate(self._channels):
                    if channel.fresh:
                        channel.fresh = False
                        self._publish(cfs, self.flight[index], channel.command)
            elif _accepted(cfs, packet):
                if msg_id in self.commands:
                    channel = self._channels[self.commands.index(msg_id)]
                    self._read(cfs, packet, channel.command)
                    channel.fresh = True
                else:
                    index = self.states.index(msg_id)
                    self._read(cfs, packet, self._channels[index].state)
                    self._publish(cfs, self.telemetry[index], self._channels[index].state)
            yield Work(cfs.profile.work_ns)

    def _read(self, cfs: Cfs, packet: bytes, struct: FixedStruct) -> None:
        """Decode a message and encode it again; an undecodable one leaves the previous one in place."""
        type_name = self._types[msg_id_of(packet)]
        values = _decoded(cfs, type_name, packet)
        if values is None:
            cfs.print(facts.UNREADABLE)
            return
        try:
            struct.put(messages.encode(type_name, values, cfs.routes.store))
        except WireError:
            cfs.print(facts.UNREADABLE)

    def _publish(self, cfs: Cfs, msg_id: int, struct: FixedStruct) -> None:
        self.crossed[msg_id] += 1
        cfs.telemetry(msg_id, struct.data, facts.NAME)


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
