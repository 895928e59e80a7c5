"""The EDORAS flight applications: one with its robot behind it, one with two robots across SBN."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

from edoras_tools.errors import WireError
from edoras_tools.sessions import software_bus
from edoras_tools.sessions.events import EventType
from edoras_tools.sim import messages
from edoras_tools.sim.messages import FixedStruct
from edoras_tools.sim.scheduler import Receive, Work
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.sessions.software_bus import Pipe
    from edoras_tools.sim.cfs import Cfs
    from edoras_tools.sim.robots import Robot
    from edoras_tools.sim.scheduler import Task

NAME: Final = "EDORAS_APP"
PIPE: Final = "EDORAS_APP_PIPE"
NO_OP, SET = 0, 1
_ROBOT_WORK: Final = 4
UNREADABLE: Final = "edoras_core: Failed to apply rmw_deserialize"


class EdorasApp(Protocol):
    """What the emulated cFS asks of its EDORAS application.

    Attributes:
        requests: MsgIds that the scheduler sends it once a second.
        wakeups: and those that it sends each ``wakeup_ns``.
        telemetry: MsgIds that go to the ground.
    """

    requests: Sequence[int]
    wakeups: Sequence[int]
    telemetry: Sequence[int]

    def start(self, cfs: Cfs) -> None:
        """Make its pipe and start its task."""


def _start(cfs: Cfs, *msg_ids: int) -> Pipe:
    cfs.events.register(NAME, now=cfs.scheduler.now)
    pipe = cfs.create_pipe(PIPE, *msg_ids, limit=cfs.profile.app_msg_limit)
    cfs.say(NAME, 1, "Edoras App Initialized. Emulated")
    return pipe


def _accepted(cfs: Cfs, packet: bytes) -> bool:
    """Tell whether a packet is a "set"; say what is wrong with others, as the flight code does."""
    function_code, size = packet[6] & 0x7F, software_bus.length(packet)
    if function_code == SET:
        return True  # its length is not looked at
    if function_code != NO_OP:
        cfs.say(NAME, 2, f"Invalid ground command code: CC = {function_code}", EventType.ERROR)
    elif size != cfe.COMMAND_HEADER_BYTES:
        text = f"Invalid Msg length: ID = 0x{software_bus.msg_id(packet):04X},  CC = 0, Len = {size}"
        cfs.say(NAME, 6, f"{text}, Expected = {cfe.COMMAND_HEADER_BYTES}", EventType.ERROR)
    return False


class SingleRobotApp:
    """Demos 1 and 2: the robot hangs on the application; its state goes to the ground once a second.

    Attributes:
        robot: what obeys and reports.
        robot_commands: commands that reached the robot.
    """

    command: Final = 0x1827
    request: Final = 0x1828
    state: Final = 0x0827
    housekeeping: Final = 0x0826
    wakeups: Sequence[int] = ()
    requests: Sequence[int] = (request,)
    telemetry: Sequence[int] = (housekeeping, state)

    def __init__(self, robot: Robot, struct_bytes: int) -> None:
        self.robot, self.robot_commands = robot, 0
        self._struct = FixedStruct(struct_bytes)
        self._requests = 0

    def start(self, cfs: Cfs) -> None:
        """Make its pipe and start its task."""
        # 0x0828 too: the flight app subscribes to it, and nobody here publishes it.
        cfs.spawn(self._run(cfs, _start(cfs, self.request, self.command, 0x0828)))

    def _run(self, cfs: Cfs, pipe: Pipe) -> Task:
        while True:
            packet = yield Receive(pipe)
            wanted = software_bus.msg_id(packet)
            if wanted == self.request:
                yield Work(_ROBOT_WORK * cfs.profile.work_ns)
                self._struct.put(self.robot.state(now=cfs.scheduler.now))
                cfs.telemetry(self.state, self._struct.data, NAME)
                yield Work(_ROBOT_WORK * cfs.profile.work_ns)
                counters = bytes([2 * self._requests & 0xFF, self._requests & 0xFF])
                cfs.telemetry(self.housekeeping, counters.ljust(56, b"\0"), NAME)
                self._requests += 1
            elif wanted == self.command and _accepted(cfs, packet):
                values = messages.decode(self.robot.command_type, packet[cfe.COMMAND_HEADER_BYTES :])
                self.robot_commands += 1
                if values is None:
                    cfs.print(UNREADABLE)
                else:
                    self.robot.obey(values, now=cfs.scheduler.now)
                yield Work(cfs.profile.work_ns)


@dataclass(slots=True)
class _Channel:
    """One robot's two messages on their way through, kept in structs that never shrink."""

    command: FixedStruct
    state: FixedStruct
    fresh: bool = False


class TwoRobotApp:
    """Demos 3 and 4: every message is read, written anew and sent on under another MsgId.

    A command from the ground waits for the next wake-up, so only the last of a burst goes on; a robot's state
    goes on at once.

    Attributes:
        crossed: MsgId to messages that went on under it.
    """

    commands: Final = (0x1827, 0x1828)
    states: Final = (0x1829, 0x182A)
    flight: Final = (0x082A, 0x082B)
    telemetry: Sequence[int] = (0x0828, 0x0829)
    requests: Sequence[int] = ()
    wakeups: Sequence[int] = (0x182B,)

    def __init__(self, command_type: str, state_type: str, state_bytes: int, command_bytes: int = 80) -> None:
        self.crossed = dict.fromkeys((*self.flight, *self.telemetry), 0)
        self._command_type, self._state_type = command_type, state_type
        self._channels = [
            _Channel(FixedStruct(command_bytes), FixedStruct(state_bytes)) for _ in self.commands
        ]

    def start(self, cfs: Cfs) -> None:
        """Make its pipe and start its task."""
        cfs.spawn(self._run(cfs, _start(cfs, *self.commands, *self.states, *self.wakeups)))

    def _run(self, cfs: Cfs, pipe: Pipe) -> Task:
        while True:
            packet = yield Receive(pipe)
            wanted = software_bus.msg_id(packet)
            if wanted in self.wakeups:
                for index, channel in enumerate(self._channels):
                    if channel.fresh:
                        channel.fresh = False
                        self._publish(cfs, self.flight[index], channel.command)
            elif _accepted(cfs, packet):
                if wanted in self.commands:
                    channel = self._channels[self.commands.index(wanted)]
                    self._read(cfs, self._command_type, packet, channel.command)
                    channel.fresh = True
                else:
                    index = self.states.index(wanted)
                    self._read(cfs, self._state_type, packet, self._channels[index].state)
                    self._publish(cfs, self.telemetry[index], self._channels[index].state)
            yield Work(cfs.profile.work_ns)

    def _read(self, cfs: Cfs, type_name: str, packet: bytes, struct: FixedStruct) -> None:
        """Read and write anew; what cannot be read leaves the last message in place."""
        values = messages.decode(type_name, packet[cfe.COMMAND_HEADER_BYTES :])
        if values is None:
            cfs.print(UNREADABLE)
            return
        try:
            struct.put(messages.encode(type_name, values))
        except WireError:
            cfs.print(UNREADABLE)

    def _publish(self, cfs: Cfs, msg_id: int, struct: FixedStruct) -> None:
        self.crossed[msg_id] += 1
        cfs.telemetry(msg_id, struct.data, NAME)
