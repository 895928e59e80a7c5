"""The tasks of the lab applications: Command Ingest, Telemetry Output, the scheduler."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from edoras_tools.addons.lab.emulator.account import socket
from edoras_tools.addons.lab.emulator.core_apps import CORE
from edoras_tools.addons.lab.emulator.messages import to_link
from edoras_tools.addons.lab.emulator.scheduler import Receive, Sleep, SleepUntil, Work
from edoras_tools.addons.lab.emulator.services.command_ingest import CommandIngest
from edoras_tools.addons.lab.emulator.services.telemetry_output import TelemetryOutput
from edoras_tools.cfs import command_ingest, software_bus, telemetry_output
from edoras_tools.model import Endpoint
from edoras_tools.units import MICROSECOND, MILLISECOND
from edoras_tools.wire import cfe
from edoras_tools.wire.cfe import msg_id_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.addons.lab.emulator.apps.edoras import EdorasApp
    from edoras_tools.addons.lab.emulator.cfs import Cfs
    from edoras_tools.addons.lab.emulator.scheduler import Task

SCHEDULER: Final = "SCH_LAB_APP"
SCHEDULE_LEAD_NS: Final = 17 * MILLISECOND
"""Time by which the first housekeeping request comes before a whole period after start, as captured."""


class CiLab:
    """Command Ingest's task: it reads the socket after each message and after each time-out."""

    def __init__(self, cfs: Cfs) -> None:
        self.socket = CommandIngest(cfs.profile)
        cfs.account.watch(self.socket.queue, socket(cfs.profile.ci_port))
        self._cfs = cfs
        self._pipe = cfs.create_pipe(
            command_ingest.PIPE, command_ingest.COMMAND_MSG_ID, command_ingest.REQUEST_MSG_ID
        )
        cfs.events.register(command_ingest.NAME, now=cfs.scheduler.now)
        cfs.say(command_ingest.INITIALIZED, version="Emulated")
        cfs.listen(cfs.profile.ci_port, self.socket.receive_datagram)
        cfs.spawn(self._run())

    def _run(self) -> Task:
        cfs, profile = self._cfs, self._cfs.profile
        while cfs.executive.run_loop(command_ingest.NAME):
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
                yield Work(profile.ci_read_ns)

    def _message(self, packet: bytes) -> None:
        if msg_id_of(packet) == command_ingest.REQUEST_MSG_ID:
            self._cfs.telemetry(
                command_ingest.HOUSEKEEPING_MSG_ID, self.socket.housekeeping(), command_ingest.NAME
            )
        elif event := self.socket.command(packet):
            self._cfs.report(event)


class ToLab:
    """Telemetry Output's task: a delay, then it sends everything in the pipe, then it reads its commands."""

    def __init__(self, cfs: Cfs, telemetry: Sequence[int]) -> None:
        self.output = TelemetryOutput(cfs.profile, cfs.bus)
        self._cfs = cfs
        cfs.executive.owns(pipe=telemetry_output.PIPE)
        cfs.open_telemetry_socket()
        name = telemetry_output.NAME
        cfs.events.register(name, now=cfs.scheduler.now)
        self._commands = cfs.create_pipe(
            telemetry_output.COMMAND_PIPE, telemetry_output.COMMAND_MSG_ID, telemetry_output.REQUEST_MSG_ID
        )
        self.output.subscribe(telemetry)
        cfs.say(telemetry_output.INITIALIZED, version="Emulated")
        cfs.spawn(self._run())

    def _run(self) -> Task:
        cfs, profile, output = self._cfs, self._cfs.profile, self.output
        while cfs.executive.run_loop(telemetry_output.NAME):
            yield Sleep(profile.to_wake_ns)
            more, data = output.forward()
            while more:
                if data is not None and output.destination is not None:
                    ground = Endpoint(output.destination, profile.to_port)
                    cfs.send(cfs.to_endpoint, ground, to_link(data, profile))
                yield Work(profile.work_ns)
                more, data = output.forward()
            while (packet := self._commands.get()) is not None:
                self._command(packet)
                yield Work(profile.work_ns)

    def _command(self, packet: bytes) -> None:
        cfs, name = self._cfs, telemetry_output.NAME
        if msg_id_of(packet) == telemetry_output.REQUEST_MSG_ID:
            cfs.telemetry(telemetry_output.HOUSEKEEPING_MSG_ID, self.output.housekeeping(), name)
            return
        answer = self.output.command(packet)
        for event in answer.events:
            cfs.report(event)
        if answer.publish:
            cfs.telemetry(*answer.publish, name)


class SchLab:
    """The scheduler's tasks: housekeeping requests, and the wake-ups that applications request."""

    def __init__(self, cfs: Cfs, edoras: EdorasApp) -> None:
        self._cfs = cfs
        requests = [item.request for item in CORE]
        requests += [command_ingest.REQUEST_MSG_ID, telemetry_output.REQUEST_MSG_ID, *edoras.requests]
        cfs.spawn(self._run(requests, cfs.profile.housekeeping_ns))
        if edoras.wakeups:
            cfs.spawn(self._run(list(edoras.wakeups), cfs.profile.wakeup_ns))

    def _run(self, msg_ids: list[int], period_ns: int) -> Task:
        cfs = self._cfs
        due = cfs.scheduler.now + cfs.profile.housekeeping_ns
        due -= min(SCHEDULE_LEAD_NS, cfs.profile.housekeeping_ns // 2)
        while cfs.executive.run_loop(SCHEDULER):
            yield SleepUntil(due)
            for item in msg_ids:
                cfs.publish(cfe.emit_command(item, 0), SCHEDULER)
                yield Work(3 * MICROSECOND)
            due += period_ns
