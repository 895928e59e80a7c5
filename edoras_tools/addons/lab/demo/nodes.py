"""The four demonstrations of the EDORAS paper: mission files with free ports, topics, and their nodes.

The nodes are those of a demo's ROS 2 graph besides the bridges: ground station and robots. Messages are
followed by their bytes, from node to node through bridges and cFS. The time that a message spends in cFS
belongs to cFS; the rest to bridges, sockets and middleware.
"""

from __future__ import annotations

import heapq
import re
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from importlib.resources import files
from itertools import count
from math import atan2, dist
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec.structs import replace

from edoras_tools import doors
from edoras_tools.addons.lab.emulator import MISSIONS, Scenario, WireDatagram
from edoras_tools.addons.lab.emulator.bridges import Arm, Robot, Rover, operator_command
from edoras_tools.addons.lab.emulator.cfs import routes_of_kind
from edoras_tools.cfs.profile import Ports, SimProfile
from edoras_tools.errors import WireError
from edoras_tools.io.net.sockets import local_endpoint, open_bound
from edoras_tools.io.outputs import write_bytes
from edoras_tools.middleware import Graph, Qos
from edoras_tools.model import Endpoint
from edoras_tools.sessions.bridge import Envelope, find_packet
from edoras_tools.sessions.pacing import Lateness
from edoras_tools.units import SECOND
from edoras_tools.wire import envelope, sbn

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.mission import Bridge, Route
    from edoras_tools.ros import TypeStore

    Call = Callable[..., None]

HOST: Final = "127.0.0.1"
LAYOUTS: Final = {
    "rover": "foxglove_layout_rover",
    "arm": "foxglove_layout_arm",
    "two-rovers": "foxglove_layout",
    "two-arms": "foxglove_layout_two_arms",
}
_TO_LIMIT: Final = 20
"""Packets of one state that may wait in Telemetry Output: those of 0.5 s at 30 Hz, and a reserve."""


class Lane(msgspec.Struct, frozen=True):
    """One robot and its four topics.

    Attributes:
        robot: name.
        command: the ground route to cFS.
        state: the ground route from cFS.
        board_command: the command route at the robot; None if the robot is part of the flight application.
        board_state: the state route at the robot; None if the robot is part of the flight application.
    """

    robot: str
    command: Route
    state: Route
    board_command: Route | None = None
    board_state: Route | None = None


def free_ports() -> Ports:
    """Return free ports.

    They are not the default ports: the demo would also receive other programs' traffic on those.

    Raises:
        CaptureError: the system has no free port.
    """
    with ExitStack() as stack:
        opened = [stack.enter_context(open_bound(Endpoint(HOST, 0))) for _ in range(4)]
        return Ports(*(local_endpoint(item).port for item in opened))


def profile(ports: Ports, states: Iterable[int]) -> SimProfile:
    """Return a cFS on these ports, with the flight bridge as its peer, and TO limits for the states.

    Args:
        states: MsgIds of the states that go to the ground.
    """
    usual = SimProfile(address=HOST).on(ports)
    return replace(usual, to_limits={**usual.to_limits, **dict.fromkeys(states, _TO_LIMIT)})


def write_missions(scenario: Scenario, folder: Path, ports: Ports, max_rate: float) -> list[Path]:
    """Write a demo's mission files.

    Args:
        ports: ports that replace the default ones.
        max_rate: states per second that the flight bridge forwards for each robot; 0 for all.

    Raises:
        CaptureError: they cannot be written.
    """
    samples = files("edoras_tools.samples")
    paths = []
    for name in MISSIONS[scenario]:
        text = (samples / f"missions/{name}.yaml").read_text(encoding="utf-8")
        for key, port in (
            ("bridge_port", ports.to),
            ("fsw_port", ports.ci),
            ("peer_port", ports.sbn),
            ("udp_receive_port", ports.peer),
        ):
            text = re.sub(rf"\b{key}: \d+", f"{key}: {port}", text)
        if max_rate and name.endswith("flight"):
            group = (
                f"    edoras: # read by edoras bridge only\n      max_rate: {max_rate:g}\n      keep: first\n"
            )
            text = text.replace("  ros__parameters:\n", f"  ros__parameters:\n{group}\n")
        path = folder / f"{name}.yaml"
        write_bytes(path, text.encode())
        paths.append(path)
    return paths


def lanes_of(scenario: Scenario, bridges: Iterable[Bridge]) -> tuple[Lane, ...]:
    """Return the robots of a demo, from its bridges."""
    bridges = list(bridges)
    ways = (("ground", True), ("ground", False), ("flight", False), ("flight", True))
    groups = [routes_of_kind(bridges, kind, to_cfs=to_cfs) for kind, to_cfs in ways]
    if not groups[-1]:
        return tuple(Lane(scenario, *pair) for pair in zip(*groups[:2], strict=True))
    rows = zip(*groups, strict=True)
    return tuple(Lane(row[0].topic.split("/")[1], *row) for row in rows)


_BEHIND_NS: Final = SECOND // 4
"""Delay from which a periodic call skips the missed ones."""


class CallScheduler:
    """Makes calls when they are due or requested, one at a time, from ``start`` to ``close``."""

    def __init__(self) -> None:
        self._requests: SimpleQueue[tuple[Call, tuple[Any, ...]] | None] = SimpleQueue()
        self._due: list[tuple[int, int, int, Call]] = []
        self._numbers = count()
        self._repeats = True
        self._thread = threading.Thread(target=self._run, name="demo nodes", daemon=True)

    def ask(self, call: Call, *arguments: Any) -> None:
        """Request a call as soon as possible; from any thread."""
        self._requests.put((call, arguments))

    def every(self, hertz: float, call: Call) -> None:
        """Make a call at a rate from now on; only from the scheduler's thread."""
        self._put(time.monotonic_ns(), int(SECOND / hertz), call)

    def at(self, due_ns: int, call: Call) -> None:
        """Make a call once, at a monotonic time; before ``start``, or from the scheduler's thread."""
        self._put(due_ns, 0, call)

    def cease(self) -> None:
        """Make no more periodic calls; only from the scheduler's thread."""
        self._repeats = False

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """End the thread; does nothing if it has not started or has ended."""
        if self._thread.ident is not None:
            self._requests.put(None)
            self._thread.join()

    def _put(self, due_ns: int, period_ns: int, call: Call) -> None:
        heapq.heappush(self._due, (due_ns, next(self._numbers), period_ns, call))

    def _run(self) -> None:
        while True:
            now = time.monotonic_ns()
            while self._due and self._due[0][0] <= now:
                due_ns, _, period_ns, call = heapq.heappop(self._due)
                if period_ns and not self._repeats:
                    continue
                if period_ns:
                    self._put(max(due_ns, now - _BEHIND_NS) + period_ns, period_ns, call)
                call()
            wait_s = max(self._due[0][0] - time.monotonic_ns(), 0) / 1e9 if self._due else None
            try:
                item = self._requests.get(timeout=wait_s)
            except Empty:
                continue
            if item is None:
                return
            call, arguments = item
            call(*arguments)


_GIVES_WAY_NS: Final = 5 * SECOND
"""Time without commands of the ground station to a robot after a command of another node."""
_TRACK: Final = 400
_QOS: Final = Qos()


class RobotState(msgspec.Struct):
    """The ground station's knowledge of a robot.

    Attributes:
        place: for a rover x, y in m and heading in rad; for an arm its joints in rad; empty at first.
        start: the first place.
        way: distance moved: in m for a rover, in rad over all joints for an arm.
        track: some places of a rover, oldest first.
        updates: number of states received.
    """

    place: tuple[float, ...] = ()
    start: tuple[float, ...] = ()
    way: float = 0.0
    track: list[tuple[float, float]] = msgspec.field(default_factory=list)
    updates: int = 0

    def take(self, values: Mapping[str, Any]) -> None:
        """Process a PoseStamped or a JointState."""
        place = place_of(values)
        if not self.updates:
            self.start = place
        elif len(place) == len(self.place):
            moved = slice(0, 2) if "pose" in values else slice(None)
            self.way += dist(place[moved], self.place[moved])
        self.updates += 1
        self.place = place
        if "pose" in values and (not self.track or dist(place[:2], self.track[-1]) > 0.02):
            self.track.append((place[0], place[1]))
            if len(self.track) > _TRACK:
                del self.track[1::2]


def place_of(values: Mapping[str, Any]) -> tuple[float, ...]:
    """Return a robot's place from its state."""
    if "pose" not in values:
        return tuple(map(float, values["position"]))
    position, turned = values["pose"]["position"], values["pose"]["orientation"]
    return float(position["x"]), float(position["y"]), 2 * atan2(turned["z"], turned["w"])


class GroundStation:
    """The operator: sends commands to every robot at a rate, and receives its state.

    It pauses for some seconds when another node commands a robot.

    Args:
        trace: counts of each robot's commands and states.
        rate_hz: commands per second for each robot; 0 for none.

    Attributes:
        seen: last state of each robot.
        others: number of commands from other nodes, for each robot.
    """

    def __init__(
        self,
        lanes: tuple[Lane, ...],
        trace: Trace,
        rate_hz: float,
        types: TypeStore,
        scheduler: CallScheduler,
    ) -> None:
        self.seen = [RobotState() for _ in lanes]
        self.others = [0] * len(lanes)
        self._lanes, self._trace = lanes, trace
        self._rate_hz, self._types, self._scheduler = rate_hz, types, scheduler
        self._others_ns = [-_GIVES_WAY_NS] * len(lanes)
        self._newest = [b""] * len(lanes)
        self._index = 0
        self._publish: list[Any] = []

    def join(self, graph: Graph) -> None:
        """Subscribe and advertise in a graph.

        Raises:
            ConfigError: the graph refuses a topic.
        """
        for index, lane in enumerate(self._lanes):
            self._publish.append(graph.advertise(lane.command.topic, lane.command.type, _QOS))
            graph.subscribe(lane.command.topic, lane.command.type, _QOS, partial(self._other, index))
            graph.subscribe(lane.state.topic, lane.state.type, _QOS, partial(self._state, index))

    def start(self) -> None:
        """Start sending commands; call it on the scheduler's thread."""
        if self._rate_hz:
            self._scheduler.every(self._rate_hz, self._command)

    def _command(self) -> None:
        for robot, publish in enumerate(self._publish):
            now = time.monotonic_ns()
            if now - self._others_ns[robot] >= _GIVES_WAY_NS:
                cdr = operator_command(self._lanes[0].command.type, self._rate_hz, self._index, robot)
                self._trace.commands[robot].begin(cdr, now)
                publish(cdr)
        self._index += 1

    def _other(self, robot: int, _cdr: bytes) -> None:
        self.others[robot] += 1
        self._others_ns[robot] = time.monotonic_ns()

    def _state(self, robot: int, cdr: bytes) -> None:
        self._trace.states[robot].arrive(cdr, time.monotonic_ns())
        # Telemetry comes in bursts: only the last state of a burst is decoded.
        waits, self._newest[robot] = self._newest[robot], cdr
        if not waits:
            self._scheduler.ask(self._read_state, robot)

    def _read_state(self, robot: int) -> None:
        cdr, self._newest[robot] = self._newest[robot], b""
        with suppress(WireError):
            self.seen[robot].take(self._types.decode(self._lanes[robot].state.type, cdr))


class RobotNode:
    """A robot in the graph: it follows the flight bridge's commands and publishes its state at a rate."""

    def __init__(
        self, lane: Lane, robot: Robot, command: Leg, state: Leg, types: TypeStore, scheduler: CallScheduler
    ) -> None:
        self._lane, self._robot, self._types, self._scheduler = lane, robot, types, scheduler
        self._command, self._state = command, state

    def join(self, graph: Graph) -> None:
        """Subscribe and advertise in a graph.

        Raises:
            ConfigError: the graph refuses a topic.
        """
        lane = self._lane
        assert lane.board_command is not None
        assert lane.board_state is not None
        self._publish = graph.advertise(lane.board_state.topic, lane.board_state.type, _QOS)
        graph.subscribe(lane.board_command.topic, lane.board_command.type, _QOS, self._heard)

    def start(self, rate_hz: float) -> None:
        """Start publishing; call it on the scheduler's thread."""
        if rate_hz:
            self._scheduler.every(rate_hz, self._tell)

    def _heard(self, cdr: bytes) -> None:
        self._command.arrive(cdr, time.monotonic_ns())
        self._scheduler.ask(self._obey, cdr)

    def _obey(self, cdr: bytes) -> None:
        with suppress(WireError):
            values = self._types.decode(self._lane.command.type, cdr)
            self._robot.obey(values, now=time.time_ns())

    def _tell(self) -> None:
        cdr = self._robot.state(now=time.time_ns())
        self._state.begin(cdr, time.monotonic_ns())
        self._publish(cdr)


class AppRobot:
    """The ``Robot`` of the flight application, which also counts its commands and states."""

    def __init__(self, robot: Robot, command: Leg, state: Leg, types: TypeStore) -> None:
        self.command_type, self.state_type = robot.command_type, robot.state_type
        self._robot, self._command, self._state, self._types = robot, command, state, types

    def obey(self, values: Mapping[str, Any], *, now: int) -> None:
        """Execute a command."""
        self._command.arrive(self._types.encode(self.command_type, values), time.monotonic_ns())
        self._robot.obey(values, now=now)

    def state(self, *, now: int) -> bytes:
        """Return the state as CDR."""
        cdr = self._robot.state(now=now)
        self._state.begin(cdr, time.monotonic_ns())
        return cdr


def make_robot(lane: Lane, index: int) -> Robot:
    """Return the robot of a lane."""
    now = time.time_ns()
    return Rover(now=now, y=float(index)) if "Twist" in lane.command.type else Arm(now=now, name=lane.robot)


def commands(lanes: Sequence[Lane], types: TypeStore, graph: Graph) -> Any:
    """Return a publisher of the robots' commands for clients of a Foxglove server; they go to the graph.

    Raises:
        ConfigError: this installation has no such server.
    """
    topics = ", ".join(lane.command.topic for lane in lanes)
    publisher = doors.part("foxglove").Publisher(
        types, lambda topic: f"{topic} is not a command topic; there are {topics}"
    )
    for lane in lanes:
        topic, type_name = lane.command.topic, lane.command.type
        publisher.accept(topic, type_name, graph.advertise(topic, type_name, Qos()))
    return publisher


_MOST: Final = 8192
"""Maximum number of messages in transit that are kept."""
_SBN_HEADER: Final = sbn.HEADER.size
_ENVELOPE: Final = Envelope(envelope.DEFAULT)


class _Times(msgspec.Struct):
    """Times of one message, monotonic ns; 0 if it did not pass that point."""

    begin: int
    entered: int = 0
    departures: int = 0


class Leg:
    """Counts and times of one topic's messages, from the first node to the last; thread-safe.

    Attributes:
        said: messages that the first node published.
        entered: datagrams with a message that cFS received, from any sender.
        arrived: messages of the first node that reached the last node, byte for byte.
        strange: messages that reached the last node, but were not published by the first.
        total: time from publishing to arrival.
        added: time from publishing to arrival, without the time between reading and sending in cFS.
    """

    def __init__(self) -> None:
        self.said = self.entered = self.arrived = self.strange = 0
        self.total, self.added = Lateness(), Lateness()
        self._under_way: OrderedDict[bytes, _Times] = OrderedDict()
        self._lock = threading.Lock()

    def begin(self, cdr: bytes, now: int) -> None:
        """Count a message that the first node is about to publish."""
        with self._lock:
            self.said += 1
            self._under_way[cdr] = _Times(now)
            self._under_way.move_to_end(cdr)
            if len(self._under_way) > _MOST:
                self._under_way.popitem(last=False)

    def enter(self, cdr: bytes, now: int) -> None:
        """Count a message that cFS receives."""
        with self._lock:
            self.entered += 1
            passage = self._under_way.get(cdr)
            if passage is not None:
                passage.entered = now

    def leave(self, cdr: bytes, now: int) -> None:
        """Count a message that cFS sends."""
        with self._lock:
            passage = self._under_way.get(cdr)
            if passage is not None:
                passage.departures = now

    def arrive(self, cdr: bytes, now: int) -> None:
        """Count a message that the last node receives."""
        with self._lock:
            passage = self._under_way.pop(cdr, None)
            if passage is None:
                self.strange += 1
                return
            self.arrived += 1
            self.total.add(now - passage.begin)
            towards = passage.entered - passage.begin if passage.entered else 0
            self.added.add(towards + (now - passage.departures if passage.departures else 0))

    def summary(self) -> dict[str, Any]:
        """Return this topic's part of ``demo --json``."""
        with self._lock:
            return {
                "said": self.said,
                "into_cfs": self.entered,
                "arrived": self.arrived,
                "of_others": self.strange,
                "latency_us": self.total.summary(),
                "added_us": self.added.summary(),
            }


class Trace:
    """The two paths of every robot; a ``Watch`` of the emulated cFS.

    Attributes:
        commands: path of the commands of each robot.
        states: path of the states of each robot.
    """

    def __init__(self, lanes: Sequence[Lane]) -> None:
        self.commands = [Leg() for _ in lanes]
        self.states = [Leg() for _ in lanes]
        self._entering: dict[int, Leg] = {}
        self._leaving: dict[int, Leg] = {}
        for lane, command, state in zip(lanes, self.commands, self.states, strict=True):
            self._entering[lane.command.msg_id] = command
            self._leaving[lane.state.msg_id] = state
            if lane.board_command and lane.board_state:
                self._leaving[lane.board_command.msg_id] = command
                self._entering[lane.board_state.msg_id] = state

    def received(self, endpoint: Endpoint, data: bytes, /) -> None:
        """See ``Watch``."""
        now = time.monotonic_ns()
        message = _message(data)
        if message and message[0] in self._entering:
            self._entering[message[0]].enter(message[1], now)

    def sent(self, sent: WireDatagram, /) -> None:
        """See ``Watch``."""
        message = _message(sent.payload)
        if message and message[0] in self._leaving:
            self._leaving[message[0]].leave(message[1], time.monotonic_ns())


def _message(data: bytes) -> tuple[int, bytes] | None:
    """Return MsgId and CDR of a datagram of either link; None if there are none."""
    # An SBN header starts with a size below 0x0800, and no packet of a topic does.
    at = _SBN_HEADER if data[:1] < b"\x08" else 0
    if at and (len(data) < at or data[2] != sbn.MsgType.APP):
        return None
    place = find_packet(data, at)
    cdr = _ENVELOPE.open(data, place.body, place.end) if place else ""
    return (place.msg_id, cdr) if place and isinstance(cdr, bytes) else None
