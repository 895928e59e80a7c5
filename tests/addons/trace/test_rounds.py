"""``edoras hz``, beside an emulated run and what a robot counted."""

import pytest

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.addons.lab.emulator.simulation import SimulatedSource
from edoras_tools.addons.trace.rounds import topic_rates
from edoras_tools.pipelines.doctor import examine
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.units import SECOND


@pytest.fixture
def rover(captures, missions):
    return captures("a_rover"), missions("rover_ground")


def test_twenty_hertz_of_an_emulated_run():
    """CI reads all 20; the application's pipe keeps 4 of each 500 ms, or a few more while CI still reads."""
    simulation = Simulation(command_rate_hz=20, start_ns=1_800_000_000 * SECOND)
    source = SimulatedSource(simulation, 45 * SECOND)
    case = examine(source, Settings().workbench()).diagnosis.case
    stream = next(item for item in case.streams if item.msg_id == 0x1827)
    hops = topic_rates(case, stream, "/cmd_vel", 10_000).hops
    assert [(hop.hop, f"{hop.rate_hz:.1f}") for hop in hops] == [
        ("publisher", "20.0"),
        ("CI", "20.0"),
        ("application", "8.6"),
    ]
    sent, lost = simulation.ground.sent, simulation.cfs.bus.counters.msg_limits
    assert abs(hops[-1].rate_hz - 20 * (1 - lost / sent)) < 0.2
    last = topic_rates(case, stream, "/cmd_vel", 200).hops
    assert [f"{hop.rate_hz:.1f}" for hop in last[:2]] == ["20.0", "20.0"]
    assert 7.9 < last[-1].rate_hz < 9


@pytest.mark.quick("25")
@pytest.mark.parametrize("rate_hz", [25, 60])
def test_what_ci_cannot_read_waits_and_does_not_arrive(rate_hz):
    """CI reads 22 a second: the rest waits in its socket; 0x803 has what the pipe loses of what was read."""
    simulation = Simulation(command_rate_hz=rate_hz, start_ns=1_800_000_000 * SECOND)
    source = SimulatedSource(simulation, 30 * SECOND)
    case = examine(source, Settings().workbench()).diagnosis.case
    stream = next(item for item in case.streams if item.msg_id == 0x1827)
    sent, ci, application = topic_rates(case, stream, "/cmd_vel", 10_000).hops
    assert round(sent.rate_hz) == rate_hz
    assert 21 < ci.rate_hz < 23
    assert not ci.exact
    assert 8 <= application.rate_hz < 10


def test_of_a_file(call, rover):
    """600 were sent at 10 Hz, and 508 came to the robot."""
    path, mission = rover
    done = call("hz", path, "/cmd_vel", *mission)
    assert (done.code, done.err) == (0, [])
    lines = done.out.splitlines()
    assert lines[0] == "/cmd_vel (0x1827 on CI): publisher 10.0, CI 10.0, application 8.5"
    assert lines[-1] == "of the last 600 messages"
    assert max(map(len, lines)) <= 80
    (topic,) = call("hz", path, "--topic", "0x1827", "-w", 100, "--json").json()["topics"]
    assert (topic["window"], [hop["count"] for hop in topic["hops"][:2]]) == (100, [100, 100])


def test_of_every_topic(call, rover):
    """Without a topic there is a line for each; without a mission for each MsgId."""
    path, mission = rover
    assert call("hz", path, *mission).out.splitlines() == [
        "/cmd_vel (0x1827 on CI): publisher 10.0, CI 10.0, application 8.5",
        "/telemetry_pose (0x0827 on TO): application 1.0, TO_LAB_TLM_PIPE 1.0, capture 1.0",
    ]
    lines = call("hz", path).out.splitlines()
    assert lines[0] == "0x1827 on CI: publisher 10.0, CI 10.0, application 8.5"
    assert len(lines) == len({line.split(":")[0] for line in lines}) == 12


def test_of_telemetry(call, rover):
    path, mission = rover
    out = call("hz", path, "/telemetry_pose", *mission).out
    assert out.startswith(
        "/telemetry_pose (0x0827 on TO): application 1.0, TO_LAB_TLM_PIPE 1.0, capture 1.0\n"
    )


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "name an input that exists: edoras hz FILE /cmd_vel, or -i IFACE"),
        (["/pose"], "name an input that exists: edoras hz FILE /pose, or -i IFACE"),
        (["no.pcap"], "name an input that exists: edoras hz FILE no.pcap, or -i IFACE"),
    ],
)
def test_what_is_missing(call, words, said):
    done = call("hz", *words)
    assert (done.code, done.out, done.err) == (2, "", [f"edoras: {said}"])


def test_a_topic_that_is_not_there(call, rover):
    path, mission = rover
    done = call("hz", path, "/cmd_vl", *mission)
    assert (done.code, done.out) == (1, "")
    assert done.err[-1].endswith("no message of '/cmd_vl' is there; did you mean /cmd_vel?")
