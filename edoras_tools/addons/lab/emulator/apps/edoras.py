"""The EDORAS flight applications: one with its robot behind it, one with two robots across SBN."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any, Final

import msgspec

from edoras_tools.addons.lab.emulator import messages
from edoras_tools.addons.lab.emulator.messages import FixedStruct
from edoras_tools.addons.lab.emulator.scheduler import Receive, Work
from edoras_tools.cfs import edoras_app as facts
from edoras_tools.errors import WireError
from edoras_tools.links import CFS_PORT
from edoras_tools.model import Endpoint
from edoras_tools.wire import cfe
from edoras_tools.wire.cfe import function_code_of, length_of, msg_id_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from edoras_tools.addons.lab.emulator.bridges import Robot
    from edoras_tools.addons.lab.emulator.cfs import Cfs, SystemRoutes
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

    def __init__(self, robot: Robot, routes: SystemRoutes, struct_bytes: int = 0) -> None:
        super().__init__()
        self.robot, self.robot_commands, self.has_robot = robot, 0, False
        self.command, *_ = *routes.commands, 0
        self._states = [(item, FixedStruct(struct_bytes, routes.envelope(item))) for item in routes.telemetry]
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

    def __init__(self, routes: SystemRoutes, state_bytes: int = 0, command_bytes: int = 0) -> None:
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
                FixedStruct(command_bytes, routes.envelope(command)),
                FixedStruct(state_bytes, routes.envelope(state)),
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
