from __future__ import annotations

from collections import Counter

import pytest
from msgspec.structs import replace
from places import ROOT

from edoras_tools.addons.lab.emulator import BOOT_NS, MISSIONS, SCENARIOS, Simulation, messages
from edoras_tools.addons.lab.emulator.bridges import Arm, Rover
from edoras_tools.addons.lab.emulator.messages import FixedStruct
from edoras_tools.cfs.profile import FLIGHT_BRIDGE, Ports, SimProfile
from edoras_tools.errors import ConfigError
from edoras_tools.ros import TypeStore
from edoras_tools.units import SECOND
from edoras_tools.wire import envelope, sbn

ROUTES = {
    "rover": {("ci", 0x1827, 76), ("to", 0x0827, 116), ("to", 0x0826, 72)},
    "arm": {("ci", 0x1827, 84), ("to", 0x0827, 276), ("to", 0x0826, 72)},
    "two-rovers": {
        *(("ci", item, 76) for item in (0x1827, 0x1828)),
        *(("to", item, 136) for item in (0x0828, 0x0829)),
        *(("sbn", item, 119) for item in (0x1829, 0x182A)),
        *(("sbn", item, 107) for item in (0x082A, 0x082B)),
    },
    "two-arms": {
        *(("ci", item, 84) for item in (0x1827, 0x1828)),
        *(("to", item, 316) for item in (0x0828, 0x0829)),
        *(("sbn", item, 107) for item in (0x082A, 0x082B)),
    },
}
CORE = {
    *(("to", item, size) for item, size in ((0x800, 164), (0x801, 160), (0x803, 44), (0x804, 300))),
    *(("to", item, size) for item, size in ((0x805, 48), (0x808, 172), (0x880, 20), (0x884, 40))),
    ("ci", 0x1880, 24),
}


def routes(sent):
    for item in sent:
        if 1234 <= item.destination.port <= 1235:
            link, packet = ("ci" if item.destination.port == 1234 else "to"), item.payload
        elif item.payload[2] == sbn.MsgType.APP:
            link, packet = "sbn", item.payload[11:]
        else:
            continue
        yield link, int.from_bytes(packet[:2], "big"), len(item.payload)


@pytest.mark.each(3)
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_each_scenario_has_the_traffic_of_its_demo(scenario):
    simulation = Simulation(scenario=scenario, start_ns=1_800_000_000 * SECOND)
    sent = list(simulation.run(simulation.now + 20 * SECOND))
    seen = Counter(routes(sent))
    assert ROUTES[scenario] | CORE <= seen.keys()
    assert [item.time_ns for item in sent] == sorted(item.time_ns for item in sent)
    once_a_second = [
        seen[link, msg_id, size] for link, msg_id, size in CORE if link == "to" and msg_id != 0x808
    ]
    assert all(18 <= count <= 20 for count in once_a_second)
    assert simulation.cfs.bus.counters.msg_limits == 0
    assert simulation.ground.received[0x0800] == seen["to", 0x0800, 164]


@pytest.mark.long
def test_one_profile_is_one_run_and_another_seed_is_another():
    def run(seed):
        return list(Simulation(SimProfile(seed=seed), "two-rovers").run(10 * SECOND))

    assert run(1) == run(1)
    assert run(1) != run(2)


def test_a_rover_s_commands_reach_it_and_its_pose_comes_back():
    simulation = Simulation(scenario="two-rovers", command_rate_hz=4)
    sent = [item for item in simulation.run(30 * SECOND) if item.payload[:2] == b"\x08\x28"]
    poses = [messages.decode_envelope(messages.POSE_STAMPED, item.payload[16:]) for item in sent]
    travelled = [pose["pose"]["position"]["x"] for pose in poses]
    assert travelled[0] == 0.0
    assert travelled[-1] > 1.0
    assert simulation.flight.received.keys() == {0x082A, 0x082B}


@pytest.mark.parametrize(("scenario", "size"), [("rover", 48), ("arm", 56)])
def test_a_robot_s_port_gets_each_command_where_it_is_named_and_else_nothing(scenario, size):
    for port in (0, 8585):
        simulation = Simulation(SimProfile(robot_port=port), scenario, command_rate_hz=10)
        sent = [item for item in simulation.run(10 * SECOND) if item.destination.port == 8585]
        reached = simulation.apps.edoras.robot_commands
        assert reached > 50
        assert len(sent) == (reached if port else 0)
        assert {(item.source.port, len(item.payload)) for item in sent} <= {(8080, size)}


def test_commands_end_after_their_count():
    simulation = Simulation(scenario="rover", command_rate_hz=4, command_count=7)
    list(simulation.run(10 * SECOND))
    assert (simulation.ground.sent, simulation.apps.edoras.robot_commands) == (7, 7)


@pytest.mark.long
def test_ten_minutes_of_one_rover():
    simulation = Simulation(scenario="rover", command_rate_hz=2)
    seen = Counter(routes(simulation.run(600 * SECOND)))
    assert seen["ci", 0x1827, 76] == 1199
    assert 597 <= seen["to", 0x0827, 116] <= 600


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_after_boot_the_bridges_are_connected_and_time_goes_on(scenario):
    ports = Ports(ci=3001, to=3002, sbn=3003, peer=3004)
    simulation = Simulation(SimProfile().on(ports), scenario, start_ns=-BOOT_NS).boot()
    assert simulation.now == 0
    ours = {item.port for item in simulation.endpoints if item != simulation.cfs.to_endpoint}
    assert ours <= {3001, 3002, 3003, 3004}
    assert simulation.ground.received
    connected = simulation.apps.sbn.node.peers[FLIGHT_BRIDGE].connected
    assert connected is ("two" in scenario)
    assert all((ROOT / "samples/missions" / f"{name}.yaml").is_file() for name in MISSIONS[scenario])


def test_it_says_what_it_is():
    simulation = Simulation()
    told = [text for _, text in simulation.cfs.console]
    assert (
        "EVS Port1 66/1/CFE_ES 1: cFE ES Initialized:  edoras-tools emulated cFS, not flight software" in told
    )


@pytest.mark.parametrize(
    ("options", "mistake"),
    [
        ({"scenario": "boat"}, "scenario 'boat' is not known; there are rover, arm, two-rovers, two-arms"),
        ({"command_rate_hz": -1}, "a rate is 0 Hz or more"),
        ({"profile": replace(SimProfile(), sbn_peers=()), "scenario": "two-arms"}, "sbn_peers"),
    ],
)
def test_what_cannot_be_simulated_is_refused(options, mistake):
    with pytest.raises(ConfigError, match=mistake):
        Simulation(**options)


def test_a_struct_keeps_the_tail_of_a_longer_message():
    struct = FixedStruct(60)
    struct.put(b"\xaa" * 40)
    struct.put(b"\xbb" * 10)
    assert struct.data == envelope.DEFAULT.emit(b"\xbb" * 10) + b"\xaa" * 30 + bytes(4)
    with pytest.raises(messages.FieldError, match="61 bytes exceed the struct's 60"):
        struct.put(bytes(45))


def test_messages_are_read_back_by_the_type_store():
    types = TypeStore()
    assert types.decode(messages.TWIST, messages.twist(0.5, -0.25))["angular"]["z"] == -0.25
    state = types.decode(messages.JOINT_STATE, messages.joint_state(3 * SECOND, ["a", "b"], [1.0, 2.0]))
    assert (state["name"], list(state["position"]), state["header"]["stamp"]["sec"]) == (
        ["a", "b"],
        [1.0, 2.0],
        3,
    )
    assert len(messages.pose_stamped(0, "world", 0, 0, 0)) == 84
    assert messages.decode_envelope(messages.TWIST, b"\x34" + bytes(7)) is None


def test_a_rover_drives_an_arc_and_stops_when_nobody_tells_it_anything():
    rover = Rover(now=0)
    rover.obey({"linear": {"x": 1.0}, "angular": {"z": 3.141592653589793 / 2}}, now=0)
    rover.state(now=1 * SECOND)
    assert (rover.x, rover.y) == pytest.approx((2 / 3.141592653589793,) * 2)
    rover.obey({"linear": {"x": 1.0}, "angular": {"z": 0.0}}, now=1 * SECOND)
    rover.state(now=60 * SECOND)
    assert rover.y == pytest.approx(2 / 3.141592653589793 + 5)


def test_an_arm_approaches_its_target():
    arm = Arm(now=0)
    arm.obey(messages.pose(3.0, 4.0), now=0)
    for index in range(1, 100):
        state = messages.decode_envelope(
            messages.JOINT_STATE, envelope.DEFAULT.emit(arm.state(now=index * SECOND // 10))
        )
    assert list(state["position"])[-1] == pytest.approx(5.0)
    assert state["name"][0] == "big_arm_joint_2"
