from __future__ import annotations

import socket
import struct
import threading
from contextlib import contextmanager
from time import monotonic_ns

import foxglove_client as peer
import pytest
from places import ROOT

from edoras_tools.addons.foxglove.player import LEVELS, attach, live
from edoras_tools.addons.foxglove.publish import CommandPublisher
from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.addons.lab.emulator.simulation import RealTimeSource, start_simulation
from edoras_tools.addons.racs2.link import RACS2
from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.model import Endpoint, Finding, SourceInfo, SourceStatistics
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.reading import Limits
from edoras_tools.pipelines.selection import Selection
from edoras_tools.pipelines.sending.options import Receiver
from edoras_tools.pipelines.workbench import Settings, open_files

ANY = Endpoint("127.0.0.1", 0)
ROVER = ROOT / "samples/captures/a_rover.pcap"
SETTINGS = Settings((ROOT / "samples/missions/rover_ground.yaml",))
TWIST = "geometry_msgs/msg/Twist"


class Clock:
    """A simulation's clock: ten times as fast as the host's, so that nobody waits long."""

    def __call__(self):
        return monotonic_ns() * 10


@contextmanager
def running(scenario="rover", *, allow=(), **options):
    """An emulated cFS that is shown; gives the sink, and the report once it has ended."""
    source, bench = start_simulation(scenario, Settings(), Clock())
    commands = CommandPublisher(bench, allow, outlets={Receiver.CI: source.command}) if allow else None
    sink = attach(bench, source.info, listen=ANY, statistics=source.statistics, publisher=commands)
    reports = []

    def run():
        reports.append(live(source, bench, sink, **options))

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield sink, reports
    finally:
        source.stop()
        thread.join(peer.PATIENCE_S)
        assert not thread.is_alive()


def test_an_emulated_cfs_is_shown():
    with running("two-rovers") as (sink, reports), peer.Client(sink.server.url, 13) as client:
        assert {"/robot_1/ground/pose", "/robot_2/pose", "/edoras/events"} <= {*client.channels}
        client.subscribe("/robot_1/ground/pose", "/edoras/link_statistics", "/diagnostics")
        client.until(lambda: len({item.topic for item in client.messages}) == 3)
        client.until(lambda: client.times)
    assert reports[0].ledger.datagrams > 0
    assert reports[0].summary()["kind"] == "sim"


def test_what_is_published_moves_the_robot():
    """The rover's pose tells that a command from Foxglove went through Command Ingest to the application."""
    with running("rover", allow=["/cmd_vel"]) as (sink, _), peer.Client(sink.server.url, 7) as client:
        client.subscribe("/cmd_vel", "/telemetry_pose")
        client.advertise(1, "/cmd_vel", TWIST)
        ours = bytes.fromhex("00010000") + struct.pack("<6d", 123.25, 0, 0, 0, 0, 0)
        peer.wait(lambda: sink.server.clients)

        def seen():
            client.publish(1, ours)
            return [item for item in client.on("/cmd_vel") if item.data == ours]

        client.until(seen)

        def far():
            poses = client.on("/telemetry_pose")
            return poses and abs(struct.unpack_from("<d", poses[-1].data, 28)[0]) > 5

        client.until(lambda: seen() and far())
        assert not client.statuses
        peer.wait(lambda: sink.summary()["published"] > 0)


def test_a_recording_is_made_at_the_same_time(tmp_path):
    target = Target(tmp_path / "a.mcap")
    with running("rover", target=target) as (sink, reports), peer.Client(sink.server.url, 7) as client:
        client.subscribe("/telemetry_pose")
        client.until(lambda: client.messages)
    assert reports[0].outputs == [target.path]
    recorded = open_files([target.path])
    bench = Settings().workbench(recorded.info)
    recorded.close()
    assert [route.topic for route in bench.mission.routes] == ["/cmd_vel", "/telemetry_pose"]


def test_any_pipeline_can_be_looked_at(tmp_path):
    """The two lines of the module's own example."""
    source = open_files([ROVER])
    bench = SETTINGS.workbench(source.info)
    sink = attach(bench, source.info, listen=ANY, statistics=source.statistics)
    with peer.Client(sink.server.url, 7) as client:
        client.subscribe("/cmd_vel")
        peer.wait(lambda: sink.server.has_subscribers(4))
        record(source, bench, Target(tmp_path / "a.mcap"), tap=sink.write)
        client.until(lambda: len(client.messages) == 600)
    sink.close(source.statistics)


def test_its_own_page_is_no_link_s():
    """Its port is that of a link over TCP: where it may be captured, it is not read as one."""
    for name, kind, left_out in (("lo", "live", True), ("eth0", "live", False), ("x.pcap", "pcap", False)):
        bench = SETTINGS.workbench()
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        bench.columns.context.framings[port] = RACS2.framing
        sink = attach(bench, SourceInfo(name, kind), listen=Endpoint("127.0.0.1", port))
        sink.close(SourceStatistics())
        assert (port not in bench.columns.context.framings) == left_out


def test_a_choice_that_cannot_be_is_said_and_all_is_closed(made_up):
    bench = SETTINGS.workbench()
    source = made_up([])
    sink = attach(bench, source.info, listen=ANY)
    with pytest.raises(RouteError, match="no configured topic matches"):
        live(source, bench, sink, selection=Selection(topics=("/nowhere",)))
    assert source.closed
    with pytest.raises(ConnectionRefusedError):
        peer.Client(sink.server.url)


def test_a_limit_ends_it():
    source, bench = start_simulation("rover", Settings(), Clock())
    sink = attach(bench, source.info, listen=ANY)
    report = live(source, bench, sink, limits=Limits(20))
    assert report.ledger.datagrams == 20


def test_levels_are_those_of_diagnostics():
    assert {*LEVELS.values()} == {0, 1, 2}
    assert LEVELS[Finding.TRUNCATED] == 2
    assert LEVELS[Finding.SEQUENCE_UNSET] == 0


def test_a_command_is_on_the_wire_of_the_emulated_cfs():
    now = [0]
    simulation = Simulation(scenario="rover", start_ns=0, bridges=False)
    source = RealTimeSource(simulation, lambda: now[0])
    source.command(bytes.fromhex("1880c00000010000"), 0x1880)
    batches = source.batches()
    batch = next(batches)
    source.stop()
    assert next(batches, None) is None
    assert batch[0].payload.hex() == "1880c00000010000"
    assert batch[0].destination == simulation.cfs.ci_endpoint


def test_a_mission_that_is_named_holds():
    with pytest.raises(ConfigError):
        start_simulation("rover", Settings((ROOT / "nowhere.yaml",)), Clock())
