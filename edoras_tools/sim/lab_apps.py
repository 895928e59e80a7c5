"""The tasks of the lab applications: Command Ingest, Telemetry Output, the scheduler."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from edoras_tools.model import Endpoint
from edoras_tools.sessions import command_ingest, software_bus, telemetry_output
from edoras_tools.sessions.command_ingest import CommandIngest
from edoras_tools.sessions.profile import MICROSECOND, MILLISECOND
from edoras_tools.sessions.telemetry_output import TelemetryOutput
from edoras_tools.sim.core_apps import CORE
from edoras_tools.sim.scheduler import Receive, Sleep, SleepUntil, Work
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from edoras_tools.sim.cfs import Cfs
    from edoras_tools.sim.scheduler import Task

SCHEDULER: Final = "SCH_LAB_APP"
SCHEDULE_LEAD_NS: Final = 17 * MILLISECOND
"""How much sooner than a whole period after start the first housekeeping request comes, as captured."""


class CiLab:
    """Command Ingest's task: whatever ends its wait, a message or the time-out, it then reads the socket."""

    def __init__(self, cfs: Cfs) -> None:
        self.socket = CommandIngest(cfs.profile)
        self._cfs = cfs
        self._pipe = cfs.create_pipe(
            "CI_LAB_CMD_PIPE", command_ingest.COMMAND_MSG_ID, command_ingest.REQUEST_MSG_ID
        )
        cfs.events.register(command_ingest.NAME, now=cfs.scheduler.now)
        cfs.say(command_ingest.NAME, 3, "CI Lab Initialized. Emulated")
        cfs.spawn(self._run())

    def _run(self) -> Task:
        cfs, profile = self._cfs, self._cfs.profile
        while True:
            packet = yield Receive(self._pipe, profile.ci_wake_ns)
            if packet is not None:
                yield Work(profile.work_ns)
                self._message(packet)
            for _ in range(profile.ci_datagrams_per_wake):
                ingested = self.socket.read()
                if ingested is None:
                    break
                if ingested.event:
                    cfs.report(ingested.event)
                if ingested.packet is not None:
                    status = cfs.publish(ingested.packet, command_ingest.NAME, stamp=False).status
                    if status != software_bus.SUCCESS:
                        cfs.report(self.socket.refused(status))
                yield Work(profile.work_ns)

    def _message(self, packet: bytes) -> None:
        if software_bus.msg_id(packet) == command_ingest.REQUEST_MSG_ID:
            self._cfs.telemetry(
                command_ingest.HOUSEKEEPING_MSG_ID, self.socket.housekeeping(), command_ingest.NAME
            )
        elif event := self.socket.command(packet):
            self._cfs.report(event)


class ToLab:
    """Telemetry Output's task: a delay, then everything in the pipe goes out, then its commands."""

    def __init__(self, cfs: Cfs) -> None:
        self.output = TelemetryOutput(cfs.profile, cfs.bus)
        self._cfs = cfs
        name = telemetry_output.NAME
        cfs.events.register(name, now=cfs.scheduler.now)
        self._commands = cfs.create_pipe(
            "TO_LAB_CMD_PIPE", telemetry_output.COMMAND_MSG_ID, telemetry_output.REQUEST_MSG_ID
        )
        self.output.subscribe(cfs.app.telemetry)
        cfs.say(name, 1, "TO Lab Initialized. Emulated, Awaiting enable command.")
        cfs.spawn(self._run())

    def _run(self) -> Task:
        cfs, profile, output = self._cfs, self._cfs.profile, self.output
        while True:
            yield Sleep(profile.to_wake_ns)
            more, data = output.forward()
            while more:
                if data is not None and output.destination is not None:
                    cfs.send(cfs.to_endpoint, Endpoint(output.destination, profile.to_port), data)
                yield Work(profile.work_ns)
                more, data = output.forward()
            while (packet := self._commands.get()) is not None:
                self._command(packet)
                yield Work(profile.work_ns)

    def _command(self, packet: bytes) -> None:
        cfs, name = self._cfs, telemetry_output.NAME
        if software_bus.msg_id(packet) == telemetry_output.REQUEST_MSG_ID:
            cfs.telemetry(telemetry_output.HOUSEKEEPING_MSG_ID, self.output.housekeeping(), name)
            return
        answer = self.output.command(packet)
        if answer.event:
            cfs.report(answer.event)
        if answer.publish:
            cfs.telemetry(*answer.publish, name)


class SchLab:
    """The scheduler's tasks: housekeeping requests, and the wake-ups that an application asks for."""

    def __init__(self, cfs: Cfs) -> None:
        self._cfs = cfs
        requests = [item.request for item in CORE]
        requests += [command_ingest.REQUEST_MSG_ID, telemetry_output.REQUEST_MSG_ID, *cfs.app.requests]
        cfs.spawn(self._run(requests, cfs.profile.housekeeping_ns))
        if cfs.app.wakeups:
            cfs.spawn(self._run(list(cfs.app.wakeups), cfs.profile.wakeup_ns))

    def _run(self, msg_ids: list[int], period_ns: int) -> Task:
        cfs = self._cfs
        due = cfs.scheduler.now + cfs.profile.housekeeping_ns
        due -= min(SCHEDULE_LEAD_NS, cfs.profile.housekeeping_ns // 2)
        while True:
            yield SleepUntil(due)
            for item in msg_ids:
                cfs.publish(cfe.emit_command(item, 0), SCHEDULER)
                yield Work(3 * MICROSECOND)
            due += period_ns
