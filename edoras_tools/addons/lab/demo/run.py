"""Runs a demo of the paper: emulated cFS, bridges, robots and a ground station in one process.

The tour is an emulated cFS with two rovers on loopback, captured, decoded and recorded at the same time.
"""

from __future__ import annotations

import socket
import tempfile
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext
from importlib.resources import as_file, files
from pathlib import Path
from time import time_ns
from typing import TYPE_CHECKING, Any, Final

import msgspec

from edoras_tools import doors
from edoras_tools.addons.lab.demo import nodes
from edoras_tools.addons.lab.emulator import BOOT_NS, Scenario, Served, Simulation
from edoras_tools.addons.lab.emulator.apps.core import SingleRobotApp
from edoras_tools.addons.lab.emulator.simulation import SimulatedSource
from edoras_tools.cfs.edoras_app import PIPE
from edoras_tools.errors import CaptureError, ConfigError, EdorasError
from edoras_tools.io.capture.live import open_live
from edoras_tools.io.outputs import to_write, write_files
from edoras_tools.middleware import Graph, open_graph
from edoras_tools.model import Columns, Decoded, Endpoint, PacketBatch, SourceInfo, SourceStatistics
from edoras_tools.pipelines.bridge.plan import BridgeRequest, plan_bridges
from edoras_tools.pipelines.bridge.run import Bridges
from edoras_tools.pipelines.capture.record import CaptureReport, Target, check_output, record
from edoras_tools.pipelines.reading import Limits
from edoras_tools.pipelines.recorder import RelayRecorder
from edoras_tools.pipelines.workbench import Settings, Workbench, open_files
from edoras_tools.ros.store import USUAL_DISTRO
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from typing_extensions import Self

    from edoras_tools.io import DisplaySink, Source
    from edoras_tools.render.terminal.text import Watcher

ROUTER_PORT: Final = 7447
"""The port where rmw_zenoh's nodes expect it."""
_PATIENCE_S: Final = 1.0


@contextmanager
def router(ros: str, options: Mapping[str, str], say: Callable[[str], None] | None = None) -> Iterator[None]:
    """Run a Zenoh router, unless this machine has one or the user names one.

    Raises:
        CaptureError: it cannot listen.
    """
    if ros != "zenoh" or {"router", "config"} & options.keys() or _is_running():
        yield
        return
    try:
        import zenoh
    except ImportError:
        yield  # joining the graph reports the missing package
        return
    config = zenoh.Config()
    for key, value in (
        ("mode", '"router"'),
        ("listen/endpoints", f'["tcp/localhost:{ROUTER_PORT}"]'),
        ("scouting/multicast/enabled", "false"),
        ("timestamping/enabled", "true"),
    ):
        config.insert_json5(key, value)
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        raise CaptureError(
            f"TCP localhost:{ROUTER_PORT}: cannot start a Zenoh router: {error}; start rmw_zenohd"
        ) from None
    with session:
        if say is not None:
            say(f"no Zenoh router is running on this machine; this demo runs one at localhost:{ROUTER_PORT}")
        yield


def _is_running() -> bool:
    try:
        socket.create_connection(("localhost", ROUTER_PORT), timeout=_PATIENCE_S).close()
    except OSError:
        return False
    return True


_ATTEMPTS: Final = 4
_PATIENCE_NS: Final = 3 * SECOND
"""Time to wait for a peer's connection; then the demo starts anyway, so that the failure is visible."""
_DRAIN_NS: Final = 1_200_000_000
"""Time in which all messages arrive: two wake-ups of cFS, and a reserve."""
_LAST_EVENTS: Final = 40
STATE_HZ: Final = 250.0
"""The rate at which Gazebo publishes poses."""


class DemoPlan(msgspec.Struct, frozen=True):
    """The demo to run.

    Attributes:
        scenario: one of the four demos.
        output: the recording.
        command_hz: commands per second for each robot; 0: other nodes send them.
        state_hz: states per second that a robot in the graph publishes; None: 250, as Gazebo does.
        max_rate: states per second that the flight bridge forwards; 0 for all.
        ros: the middleware.
        domain: ROS 2 domain.
        options: options of the middleware.
        distro: ROS 2 distribution.
        live: address for Foxglove; None: no server.
        replace: overwrite an existing recording.
    """

    scenario: Scenario
    output: Path
    command_hz: float = 10.0
    state_hz: float | None = None
    max_rate: float = 30.0
    ros: str = "local"
    domain: int = 0
    options: Mapping[str, str] = msgspec.field(default_factory=dict)
    distro: str = USUAL_DISTRO
    live: Endpoint | None = None
    replace: bool = False


class Demo:
    """A demo: the constructor starts everything, robots move during ``run``; a context manager.

    Args:
        say: called with each note for the user.

    Attributes:
        plan: as given.
        lanes: the robots.
        bridges: the ground bridge, and the flight bridge if there is one.
        station: the ground station.
        trace: counts and latencies of the messages.
        ports: ports of all links.
        foxglove: the server, if there is one.
        layout: path of the Foxglove layout, beside the recording.
        events: the last events of cFS.

    Raises:
        CaptureError: a port, the recording or the server cannot be opened.
        ConfigError: the middleware is not installed or refuses.
    """

    def __init__(self, plan: DemoPlan, say: Callable[[str], None] | None = None) -> None:
        if plan.state_hz is not None and "two" not in plan.scenario:
            raise ConfigError(
                f"--state-rate needs two-rovers or two-arms: the robot of {plan.scenario} is part of its "
                "flight application, which reads it once a second"
            )
        target = Target(plan.output, replace=plan.replace, transforms=True)
        check_output(target, ())
        self.plan = plan
        self.foxglove: DisplaySink | None = None
        self.events: deque[str] = deque(maxlen=_LAST_EVENTS)
        self.event_counts: Counter[str] = Counter()
        self.layout = plan.output.with_name(f"{plan.output.stem}_layout.json")
        layout = {
            self.layout: (files("edoras_tools.samples") / f"{nodes.LAYOUTS[plan.scenario]}.json").read_bytes()
        }
        to_write(layout, force=plan.replace)
        self._say = say
        self._elapsed_ns = self._began_ns = 0
        self._begun = False
        self._watcher: Watcher[Demo] | None = None
        self._stack = ExitStack()
        with ExitStack() as stack:
            stack.enter_context(router(plan.ros, plan.options, say))
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="edoras-demo-")))
            for attempt in range(_ATTEMPTS):
                with ExitStack() as parts:
                    try:
                        self._open(parts, folder, target)
                    except CaptureError:
                        # Another program may have taken a port in between; any other failure is raised again.
                        if attempt == _ATTEMPTS - 1:
                            raise
                    else:
                        stack.push(parts.pop_all())
                        break
            write_files(layout, force=plan.replace)
            self._stack = stack.pop_all()

    @property
    def seconds(self) -> float:
        """Time since the start, s."""
        ended = self._elapsed_ns or (time.monotonic_ns() - self._began_ns if self._began_ns else 0)
        return ended / 1e9

    @property
    def tracks(self) -> list[list[tuple[float, float]]]:
        """The places of each rover, as the ground station received them."""
        return [list(item.track) for item in self.station.seen]

    @property
    def failure(self) -> EdorasError | None:
        """Error that ended recording early, if any."""
        return self.bridges.recorder.failure if self.bridges.recorder else None

    def run(self, *, duration_ns: int = 0, watcher: Watcher[Demo] | None = None) -> None:
        """Run until Ctrl-C, or for a duration.

        Raises:
            CaptureError: a socket failed.
        """
        self._began_ns, self._watcher = time.monotonic_ns(), watcher
        self._scheduler.at(self._began_ns + _PATIENCE_NS, self._begin)
        if duration_ns:
            active_ns = max(duration_ns - _DRAIN_NS, duration_ns // 2)
            self._scheduler.at(self._began_ns + active_ns, self._scheduler.cease)  # the last messages arrive
        self._scheduler.start()
        self._add_note("")
        self.bridges.run(duration_ns=duration_ns, watcher=self if watcher else None)
        self._elapsed_ns = time.monotonic_ns() - self._began_ns
        self._scheduler.close()

    def update(self, _bridges: Bridges, /) -> None:
        """Update the watcher of the demo, when the bridges update theirs."""
        if self._watcher:
            self._watcher.update(self)

    def stop(self) -> None:
        """End ``run``; for any thread."""
        self.bridges.stop()

    def close(self) -> None:
        """Close everything, the recording last; may be called twice."""
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def summary(self) -> dict[str, Any]:
        """Return the shape of ``demo SCENARIO --json``."""
        bridges = self.bridges.summary()
        return {
            "demo": self.plan.scenario,
            "ros": self.plan.ros,
            "seconds": round(self.seconds, 3),
            "ports": {
                name: getattr(self.ports, name)
                for name in ("ci", "to", *(("sbn", "peer") if len(self.bridges.stations) > 1 else ()))
            },
            "output": str(self.plan.output),
            "layout": str(self.layout),
            "foxglove": self.foxglove.summary() if self.foxglove else None,
            "robots": [self._robot(index, bridges) for index in range(len(self.lanes))],
            "cfs": {
                "message_limit": self.simulation.cfs.bus.counters.msg_limits,
                "pipe_overflow": self.simulation.cfs.bus.counters.pipe_overflows,
                "events": dict(self.event_counts),
            },
            "recorded": bridges["recorded"],
            "unrecorded": bridges["unrecorded"],
            "lost": bridges["lost"],
            "bridges": bridges["bridges"],
            "notes": bridges["notes"],
        }

    def _open(self, stack: ExitStack, folder: Path, target: Target) -> None:
        plan = self.plan
        self.ports = nodes.free_ports()
        paths = nodes.write_missions(plan.scenario, folder, self.ports, plan.max_rate)
        bridged = plan_bridges(Settings(paths, plan.distro), BridgeRequest())
        self.lanes = nodes.lanes_of(plan.scenario, [item.bridge for item in bridged.stations])
        self.trace = nodes.Trace(self.lanes)
        self._types = bridged.types
        self.simulation = self._boot()
        bench = bridged.workbench()
        if plan.live:
            self._show(stack, bench, plan.live)
        stack.enter_context(Served(self.simulation, self.trace))
        name = f"emulated {plan.scenario}"
        tap = self.foxglove.write if self.foxglove else None
        self.bridges = Bridges(
            bridged,
            ros=plan.ros,
            domain=plan.domain,
            options=plan.options,
            recorder=lambda: RelayRecorder(target, bench, name, "demo", tap),
            say=self._add_note,
        )
        stack.callback(self.bridges.close)
        if len(self.bridges.stations) < len(bridged.stations):
            raise CaptureError(self.bridges.notes[-1])
        self._scheduler = nodes.CallScheduler()
        self._start_nodes(stack)
        stack.callback(self._scheduler.close)

    def _boot(self) -> Simulation:
        """Return a cFS that has booted, with a counted robot if its application contains one."""
        simulation = Simulation(
            nodes.profile(self.ports, [lane.state.msg_id for lane in self.lanes]),
            self.plan.scenario,
            start_ns=time.time_ns() - BOOT_NS,
            bridges=False,
        ).boot()
        simulation.cfs.listener = self._event
        app = simulation.apps.edoras
        if isinstance(app, SingleRobotApp):
            robot = nodes.make_robot(self.lanes[0], 0)
            app.robot = nodes.AppRobot(robot, self.trace.commands[0], self.trace.states[0], self._types)
        return simulation

    def _start_nodes(self, stack: ExitStack) -> None:
        """Let the ground station and the robots join the graph."""
        trace, types, scheduler = self.trace, self._types, self._scheduler
        self.station = nodes.GroundStation(self.lanes, trace, self.plan.command_hz, types, scheduler)
        self.station.join(self._node(stack, "ground_station"))
        self.robots = [
            nodes.RobotNode(
                lane,
                nodes.make_robot(lane, index),
                trace.commands[index],
                trace.states[index],
                types,
                scheduler,
            )
            for index, lane in enumerate(self.lanes)
            if lane.board_command
        ]
        for lane, robot in zip(self.lanes, self.robots, strict=False):
            robot.join(self._node(stack, lane.robot))

    def _node(self, stack: ExitStack, name: str) -> Graph:
        plan = self.plan
        graph = open_graph(plan.ros, self._types, name, domain=plan.domain, options=plan.options)
        stack.callback(graph.close)
        return graph

    def _show(self, stack: ExitStack, bench: Workbench, where: Endpoint) -> None:
        """Serve everything to Foxglove, and accept commands from there."""
        publisher = nodes.commands(self.lanes, self._types, self._node(stack, "foxglove"))
        info = SourceInfo(f"emulated {self.plan.scenario}", "demo")
        attach = doors.part("foxglove").attach
        sink: DisplaySink = attach(bench, info, listen=where, publisher=publisher)
        self.foxglove = sink
        stack.callback(sink.close, SourceStatistics())

    def _add_note(self, text: str) -> None:
        """Forward a note; start the nodes once cFS is connected."""
        if text and self._say is not None:
            self._say(text)
        if self._began_ns and all(item.machine.link.summary()["connected"] for item in self.bridges.stations):
            self._scheduler.ask(self._begin)

    def _begin(self) -> None:
        if not self._begun:
            self._begun = True
            self.station.start()
            for robot in self.robots:
                robot.start(STATE_HZ if self.plan.state_hz is None else self.plan.state_hz)

    def _event(self, _time_ns: int, text: str) -> None:
        self.events.append(text)
        place, _, _ = text.removeprefix("EVS Port1 ").partition(": ")
        self.event_counts[place.rpartition("/")[2].partition(" ")[0]] += 1

    def _robot(self, index: int, bridges: Mapping[str, Any]) -> dict[str, Any]:
        lane, motion = self.lanes[index], self.station.seen[index]
        command = self._leg(self.trace.commands[index], lane.command, lane.board_command, bridges)
        if lane.board_command:
            into_app = command["into_cfs"] - command["lost"].get(PIPE, 0)
            command["replaced"] = max(
                into_app - self.simulation.apps.edoras.crossed[lane.board_command.msg_id], 0
            )
        state = self._leg(self.trace.states[index], lane.board_state, lane.state, bridges)
        return {
            "robot": lane.robot,
            "place": list(motion.place),
            "start": list(motion.start),
            "way": round(motion.way, 4),
            "commands": {**command, "others_said": self.station.others[index]},
            "states": state,
        }

    def _leg(self, leg: nodes.Leg, first: Any, last: Any, bridges: Mapping[str, Any]) -> dict[str, Any]:
        """Return the counts between two routes; one is None if the path ends at the application."""
        losses: Counter[str] = Counter()
        for (msg_id, pipe), number in dict(self.simulation.cfs.bus.losses).items():
            if msg_id in {route.msg_id for route in (first, last) if route is not None}:
                losses[pipe] += number
        rows = [row for item in bridges["bridges"] for row in item["routes"]]
        row = next((row for row in rows if first is not None and row["topic"] == first.topic), None)
        return {
            "from": first.topic if first is not None else None,
            "to": last.topic if last is not None else None,
            "type": (first or last).type,
            **leg.summary(),
            "held": row["held"] + row["waiting"] if row else 0,
            "refused": sum(row["refused"].values()) if row else 0,
            "lost": dict(losses),
            "replaced": 0,
        }


SAMPLES: Final = files("edoras_tools.samples")
_COMMAND_RATE_HZ: Final = 10.0


def unpack(folder: Path, *, replace: bool = False) -> tuple[Path, Path]:
    """Copy the sample missions, the capture and the Foxglove layout into the user's folder.

    Args:
        folder: target; it is created.
        replace: overwrite files of these names.

    Returns:
        The folder of missions, and the capture.

    Raises:
        ConfigError: such a file exists, and has other contents.
        CaptureError: a file cannot be written.
    """
    with as_file(SAMPLES) as samples:
        missions = [path for path in (samples / "missions").rglob("*") if path.is_file()]
        copies = {folder / path.relative_to(samples): path.read_bytes() for path in missions}
        for name in ("captures/a_rover.pcap", "foxglove_layout.json"):
            copies[folder / Path(name).name] = (samples / name).read_bytes()
    try:
        write_files(copies, force=replace)
    except CaptureError as error:
        raise CaptureError(f"{error}; name another folder with -o") from None
    return folder / "missions", folder / "a_rover.pcap"


def tour(
    folder: Path,
    seconds: float,
    *,
    show: Callable[[Decoded], None],
    notice: Callable[[str], None],
    replace: bool = False,
) -> tuple[CaptureReport, CaptureReport]:
    """Run the tour; return the reports of the live link's recording, and of the sample capture's.

    Args:
        show: called with every packet of the live link.
        notice: called with each note, one line.
        replace: overwrite the files of another tour in that folder.

    Raises:
        ConfigError: files of these names exist.
        CaptureError: a port is in use, or the folder cannot be written.
    """
    live = Target(folder / "two_rovers.mcap", transforms=True, replace=replace)
    recording = Target(folder / "a_rover.mcap", transforms=True, replace=replace)
    for target in (live, recording):
        check_output(target, ())
    missions, capture = unpack(folder, replace=replace)
    settings = Settings((missions / "two_rovers_ground.yaml", missions / "two_rovers_flight.yaml"))
    bench = settings.workbench()
    simulation = Simulation(
        scenario="two-rovers",
        start_ns=time_ns() - BOOT_NS,
        command_rate_hz=_COMMAND_RATE_HZ,
        state_rate_hz=_COMMAND_RATE_HZ,
    ).boot()
    duration_ns = int(seconds * 1e9)
    source = _source(simulation, duration_ns, bench, notice)

    def tap(batch: PacketBatch, _columns: Columns) -> None:
        for row in range(len(batch)):
            show(bench.dissector.dissect(batch[row]))

    with Served(simulation) if source.live else nullcontext():
        limits = Limits(duration_ns=duration_ns)
        report = record(source, bench, live, limits=limits, tap=tap)
    rover = Settings((missions / "rover_ground.yaml",)).workbench()
    real = record(open_files([capture]), rover, recording)
    return report, real


def _source(
    simulation: Simulation, duration_ns: int, bench: Workbench, notice: Callable[[str], None]
) -> Source:
    try:
        return open_live("lo", bench.columns.context.capture_ports())
    except CaptureError as error:
        notice(f"{error}")
        notice("therefore the same link runs in simulated time")
        return SimulatedSource(simulation, duration_ns)
