"""A demo of the paper at work: emulated cFS, bridges, robots and a ground station in one process."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections import Counter, deque
from contextlib import ExitStack
from dataclasses import dataclass, field
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.middleware import open_graph
from edoras_tools.pipelines.bridge import Bridges
from edoras_tools.pipelines.bridge_plan import Wishes, plan_bridges
from edoras_tools.pipelines.demo_agenda import Agenda
from edoras_tools.pipelines.demo_cfs import Served
from edoras_tools.pipelines.demo_nodes import AppRobot, GroundStation, RobotNode, make_robot
from edoras_tools.pipelines.demo_router import router
from edoras_tools.pipelines.demo_scene import (
    LAYOUTS,
    free_ports,
    lanes_of,
    profile,
    write_missions,
)
from edoras_tools.pipelines.demo_trace import Trace
from edoras_tools.pipelines.proxy_recorder import Recorder
from edoras_tools.pipelines.record import Target, check_target
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.sessions.profile import SECOND
from edoras_tools.sim import Simulation
from edoras_tools.sim.edoras_app import PIPE, SingleRobotApp, TwoRobotApp

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from edoras_tools.errors import EdorasError
    from edoras_tools.middleware import Graph
    from edoras_tools.model import Endpoint
    from edoras_tools.pipelines.demo_trace import Leg
    from edoras_tools.pipelines.proxy_threads import Watcher
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.sim import Scenario
    from edoras_tools.sinks.foxglove import FoxgloveSink

_ATTEMPTS: Final = 4
_BOOT_NS: Final = 3 * SECOND
_PATIENCE_NS: Final = 3 * SECOND
"""Who cannot connect begins all the same: what goes wrong is to be seen."""
_DRAIN_NS: Final = 1_200_000_000
"""Two wake-ups of cFS and some more: what was said has arrived by then."""
_LAST_EVENTS: Final = 40
STATE_HZ: Final = 250.0
"""What Gazebo publishes poses at."""


@dataclass(frozen=True, slots=True)
class DemoPlan:
    """What to run.

    Attributes:
        scenario: which of the four.
        output: the recording.
        command_hz: commands a second and robot; 0 leaves that to other nodes.
        state_hz: states a second that a robot in the graph publishes; None is Gazebo's 250.
        max_rate: states a second that the flight bridge lets through; 0 for all.
        ros: the middleware.
        domain: ROS 2 domain.
        options: of the middleware.
        distro: ROS 2 distribution.
        live: where Foxglove connects to; None: nowhere.
    """

    scenario: Scenario
    output: Path
    command_hz: float = 10.0
    state_hz: float | None = None
    max_rate: float = 30.0
    ros: str = "local"
    domain: int = 0
    options: Mapping[str, str] = field(default_factory=dict)
    distro: str = "humble"
    live: Endpoint | None = None


class Demo:
    """Everything is up once it is constructed, and moves while ``run`` does; a context manager.

    Args:
        plan: what to run.
        say: takes each line that people should know.

    Attributes:
        plan: as given.
        lanes: the robots.
        bridges: of the ground, and of the robots' side where there is one.
        station: who commands.
        trace: what became of the messages.
        ports: where all this is.
        foxglove: the server, if there is one.
        layout: the Foxglove layout beside the recording.
        events: what cFS said last.

    Raises:
        CaptureError: a port, the recording or the server cannot be had.
        ConfigError: the middleware is absent or refuses.
    """

    def __init__(self, plan: DemoPlan, say: Callable[[str], None] | None = None) -> None:
        if plan.state_hz is not None and "two" not in plan.scenario:
            raise ConfigError(
                f"--state-rate goes with two-rovers and two-arms: the robot of {plan.scenario} hangs on its "
                "flight application, which asks it once a second"
            )
        target = Target(plan.output)
        check_target(target, ())
        self.plan = plan
        self.foxglove: FoxgloveSink | None = None
        self.events: deque[str] = deque(maxlen=_LAST_EVENTS)
        self.event_counts: Counter[str] = Counter()
        self.layout = _layout_beside(plan)
        self._say = say
        self._elapsed_ns = self._began_ns = 0
        self._begun = False
        self._stack = ExitStack()
        with ExitStack() as stack:
            stack.enter_context(router(plan.ros, plan.options, say))
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="edoras-demo-")))
            for attempt in range(_ATTEMPTS):
                with ExitStack() as parts:
                    try:
                        self._open(parts, folder, target)
                    except CaptureError:
                        # Somebody was quicker to take a port; what is wrong otherwise is so the next time.
                        if attempt == _ATTEMPTS - 1:
                            raise
                    else:
                        stack.push(parts.pop_all())
                        break
            _copy_layout(plan, self.layout)
            self._stack = stack.pop_all()

    @property
    def seconds(self) -> float:
        """For how long it has been running."""
        ended = self._elapsed_ns or (time.monotonic_ns() - self._began_ns if self._began_ns else 0)
        return ended / 1e9

    @property
    def tracks(self) -> list[list[tuple[float, float]]]:
        """Where each rover was, as the ground heard of it."""
        return [list(item.track) for item in self.station.seen]

    @property
    def last_events(self) -> list[str]:
        """What cFS said last."""
        return list(self.events)

    @property
    def failure(self) -> EdorasError | None:
        """Why recording ended early, if it did."""
        return self.bridges.recorder.failure if self.bridges.recorder else None

    def run(self, *, duration_ns: int = 0, watcher: Watcher[Demo] | None = None) -> None:
        """Let it move until Ctrl-C, or for so long.

        Raises:
            CaptureError: a socket failed.
        """
        self._began_ns = time.monotonic_ns()
        self._agenda.at(self._began_ns + _PATIENCE_NS, self._begin)
        if duration_ns:
            active_ns = max(duration_ns - _DRAIN_NS, duration_ns // 2)
            self._agenda.at(self._began_ns + active_ns, self._rest)
        self._agenda.start()
        self._said("")
        self.bridges.run(duration_ns=duration_ns, watcher=_Looking(self, watcher) if watcher else None)
        self._elapsed_ns = time.monotonic_ns() - self._began_ns
        self._rest()
        self._agenda.close()

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
        self.ports = free_ports()
        paths = write_missions(plan.scenario, folder, self.ports, plan.max_rate)
        bridged = plan_bridges(Settings(paths, plan.distro), Wishes())
        self.lanes = lanes_of(plan.scenario, [item.bridge for item in bridged.stations])
        self.trace = Trace(self.lanes)
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
            recorder=lambda: Recorder(target, bench, name, "demo", tap),
            say=self._said,
        )
        stack.callback(self.bridges.close)
        if len(self.bridges.stations) < len(bridged.stations):
            raise CaptureError(self.bridges.notes[-1])
        self._agenda = Agenda()
        self._people(stack)
        stack.callback(self._agenda.close)

    def _boot(self) -> Simulation:
        """Return a cFS that has booted, its robots looked at."""
        simulation = Simulation(
            profile(self.ports, [lane.state.msg_id for lane in self.lanes]),
            self.plan.scenario,
            start_ns=time.time_ns() - _BOOT_NS,
            bridges=False,
        )
        for _ in simulation.run(simulation.now + _BOOT_NS):
            pass
        simulation.cfs.listener = self._event
        app = simulation.cfs.app
        if isinstance(app, SingleRobotApp):
            robot = make_robot(self.lanes[0], 0)
            app.robot = AppRobot(robot, self.trace.commands[0], self.trace.states[0], self._types)
        return simulation

    def _people(self, stack: ExitStack) -> None:
        """Have the ground station and the robots join the graph."""
        trace, types, agenda = self.trace, self._types, self._agenda
        self.station = GroundStation(
            self.lanes, trace.commands, trace.states, self.plan.command_hz, types, agenda
        )
        self.station.join(self._node(stack, "ground_station"))
        self.robots = [
            RobotNode(
                lane, make_robot(lane, index), trace.commands[index], trace.states[index], types, agenda
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
        """Serve it all to Foxglove, and take commands from there."""
        from edoras_tools.model import SourceInfo, SourceStatistics
        from edoras_tools.pipelines.demo_publish import Commander
        from edoras_tools.pipelines.live import attach

        commander = Commander(self.lanes, self._types, self._node(stack, "foxglove"))
        info = SourceInfo(f"emulated {self.plan.scenario}", "demo")
        self.foxglove = attach(bench, info, listen=where, publisher=commander)
        stack.callback(self.foxglove.close, SourceStatistics())

    def _said(self, text: str) -> None:
        """Pass a note on; begin to move once cFS is connected."""
        if text and self._say is not None:
            self._say(text)
        if self._began_ns and all(item.machine.link.summary()["connected"] for item in self.bridges.stations):
            self._agenda.ask(self._begin)

    def _begin(self) -> None:
        if not self._begun:
            self._begun = True
            self.station.begin()
            for robot in self.robots:
                robot.begin(STATE_HZ if self.plan.state_hz is None else self.plan.state_hz)

    def _rest(self) -> None:
        """Have nobody say more, so that what was said arrives."""
        self.station.rest()
        for robot in self.robots:
            robot.rest()

    def _event(self, _time_ns: int, text: str) -> None:
        self.events.append(text)
        place, _, _ = text.removeprefix("EVS Port1 ").partition(": ")
        self.event_counts[place.rpartition("/")[2].partition(" ")[0]] += 1

    def _robot(self, index: int, bridges: Mapping[str, Any]) -> dict[str, Any]:
        lane, seen = self.lanes[index], self.station.seen[index]
        crossed = self.simulation.cfs.app.crossed if isinstance(self.simulation.cfs.app, TwoRobotApp) else {}
        command = self._leg(self.trace.commands[index], lane.command, lane.board_command, bridges)
        if lane.board_command:
            into_app = command["into_cfs"] - command["lost"].get(PIPE, 0)
            command["replaced"] = max(into_app - crossed.get(lane.board_command.msg_id, 0), 0)
        state = self._leg(self.trace.states[index], lane.board_state, lane.state, bridges)
        return {
            "robot": lane.robot,
            "place": list(seen.place),
            "start": list(seen.start),
            "way": round(seen.way, 4),
            "commands": {**command, "others_said": self.station.others[index]},
            "states": state,
        }

    def _leg(self, leg: Leg, first: Any, last: Any, bridges: Mapping[str, Any]) -> dict[str, Any]:
        """Return what is known of a leg between two routes, of which one is None at the application."""
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


class _Looking:
    """Shows the demo where bridges are looked at."""

    def __init__(self, demo: Demo, watcher: Watcher[Demo]) -> None:
        self._demo, self._watcher = demo, watcher

    def update(self, _bridges: Bridges, /) -> None:
        self._watcher.update(self._demo)


def _layout_beside(plan: DemoPlan) -> Path:
    return plan.output.with_name(f"{plan.output.stem}_layout.json")


def _copy_layout(plan: DemoPlan, path: Path) -> None:
    try:
        with as_file(files("edoras_tools.samples")) as samples:
            shutil.copy(samples / f"{LAYOUTS[plan.scenario]}.json", path)
    except OSError as error:
        raise CaptureError(f"{path}: {error.strerror or error}; name another output with -o") from None
