"""The captured stimuli go in at their captured times; what the real cFS did must come out."""

from __future__ import annotations

import re
from collections import Counter

import pytest
from beside_real import Beside, boots, console
from places import ROOT

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.units import SECOND
from edoras_tools.wire.cfe import WITH_EXTENDED

SEEDS = (1, 2, 3, 4, 5)
EVENT = re.compile(r"EVS Port1 66/1/(\S+) (\d+): ")
LOST_EVENT, SBN_LINE = ("CFE_SB", "17"), ("SBN", "258")
LOST = "EVS Port1 66/1/CFE_SB 17: Msg Limit Err,MsgId 0x1827,pipe EDORAS_APP_PIPE,sender CI_LAB_APP"


def replay(rows, scenario, boot_s, seed=1):
    """Boot when the console says, feed CI and SBN; return the simulation and what it sent."""
    simulation = Simulation(SimProfile(seed=seed), scenario, start_ns=int(boot_s * SECOND), bridges=False)
    ports = {1234: simulation.cfs.ci_endpoint, 2234: simulation.cfs.sbn_endpoint}
    for row in rows:
        if row.destination_port in ports:
            simulation.feed(row.time_ns, ports[row.destination_port], row.payload)
    return simulation, list(simulation.run(rows[-1].time_ns))


def seconds(line):
    """The time of a line of a console; 0 where it has none."""
    return float(found[0]) if (found := re.match(r"\d{9,}\.\d+", line)) else 0.0


def to_ground(sent):
    return Counter(
        (item.payload[:2].hex(), len(item.payload)) for item in sent if item.destination.port == 1235
    )


@pytest.mark.quick("1")
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_rover_loses_one_in_five_or_so_at_10_hz(captured, seed):
    simulation, sent = replay(captured("a_rover"), "rover", 1795241636.599, seed)
    lost = 600 - simulation.apps.edoras.robot_commands
    assert lost == pytest.approx(92, abs=0.03 * 600)  # 92 in flight
    assert simulation.cfs.bus.counters.msg_limits == lost
    housekeeping = [item.payload for item in sent if item.payload[:2] == b"\x08\x03"][-1]
    assert int.from_bytes(housekeeping[30:32], "little") == lost
    assert [text for _, text in simulation.cfs.console].count(LOST) == 16
    real = Counter(
        (row.payload[:2].hex(), len(row.payload))
        for row in captured("a_rover")
        if row.destination_port == 1235
    )
    ours = to_ground(sent)
    for key in real.keys() - {("0808", 172)}:
        assert abs(ours[key] - real[key]) <= 1, key


def test_at_8_hz_the_same_commands_all_arrive(captured):
    commands = [row.payload for row in captured("a_rover") if row.payload[:2] == b"\x18\x27"]
    simulation = Simulation(scenario="rover", bridges=False)
    for index, command in enumerate(commands):
        simulation.feed(2 * SECOND + index * SECOND // 8, simulation.cfs.ci_endpoint, command)
    list(simulation.run(80 * SECOND))
    assert simulation.apps.edoras.robot_commands == 600
    assert simulation.cfs.bus.counters.msg_limits == 0


def test_b_arm_all_120_poses_arrive_and_joint_states_have_their_size(captured):
    rows = captured("b_arm_single")
    simulation, sent = replay(rows, "arm", rows[0].time_ns / SECOND - 0.25)
    assert simulation.apps.edoras.robot_commands == 120
    ours, real = to_ground(sent), [row for row in rows if row.payload[:2] == b"\x08\x27"]
    assert abs(ours["0827", 276] - len(real)) <= 1
    # Same envelope: 236 bytes of CDR, then eight bytes of padding.
    first = next(item.payload for item in sent if item.payload[:2] == b"\x08\x27")
    assert first[16:36] == real[0].payload[16:36]
    assert first[-8:] == bytes(8)


def test_e_every_bad_command_has_its_event_and_its_count(captured):
    rows = captured("e_ci_errors")
    simulation, sent = replay(rows, "rover", 1795241796.469)
    told = [text.partition("66/1/")[2].strip() for _, text in simulation.cfs.console][30:]
    version = "edoras-tools emulated cFS, not flight software"
    build = "CFE_ES 92: Build 000000000000 by edoras-tools@emulator, config emulated"
    enabled = "TO_LAB_APP 3: TO telemetry output enabled for IP 127."
    dropped = "CI_LAB_APP 8: CI: L369, cmd 1827 00 dropped, bad length="
    failed = "CI_LAB_APP 10: CI: L359, CFE_SB_TransmitBuffer() failed, status=-9059696"
    assert told == [
        f"{enabled}0.0.1",
        build,
        f"CFE_ES 3: No-op command:\n {version}",
        build,
        f"CFE_ES 3: No-op command:\n {version}",
        "EDORAS_APP 2: Invalid ground command code: CC = 9",
        "EDORAS_APP 6: Invalid Msg length: ID = 0x1827,  CC = 0, Len = 76, Expected = 8",
        "CI_LAB_APP 5: CI: NOOP command",
        "CI_LAB_APP 16: Invalid msg length: ID = 0x1884,  CC = 0, Len = 12, Expected = 8",
        "CFE_ES 23: Invalid msg length: ID = 0x1806,  CC = 0, Len = 12, Expected = 8",
        "TO_LAB_APP 9: L344 TO: Invalid Function Code Rcvd In Ground Command 0x4d",
        "CFE_SB 21: Send Err:Invalid MsgId(0x0)in msg,App CI_LAB_APP",
        f"{failed}61",
        "CFE_SB 21: Send Err:Invalid MsgId(0x2827)in msg,App CI_LAB_APP",
        f"{failed}61",
        "CFE_SB 21: Send Err:Invalid MsgId(0xffff)in msg,App CI_LAB_APP",
        f"{failed}61",
        f"{dropped}7",
        f"{dropped}6",
        f"{dropped}1",
        "CFE_SB 15: Send Err:Msg Too Big MsgId=0x1827,app=CI_LAB_APP,size=65542,MaxSz=32768",
        f"{failed}57",
        "",  # rmw_deserialize: the console only
        f"{enabled}0.0.1",
        enabled,
        f"{enabled}0.0.1",
        f"CFE_EVS 0: No-op Cmd Rcvd:  {version}",
        f"CFE_SB 28: No-op Cmd Rcvd:  {version}",
        f"CFE_TBL 10: No-op Cmd Rcvd:  {version}",
        f"CFE_TIME 4: No-op Cmd Rcvd:  {version}",
        "SBN 7: hk command",
    ]
    last = [item.payload for item in sent if item.payload[:2] == b"\x08\x84"][-1]
    real = [row.payload for row in rows if row.payload[:2] == b"\x08\x84"][-1]
    assert last[16:] == real[16:]
    for key in (("0806", 216), ("080a", 844), ("0881", 80), ("08fa", 25), ("0827", 76)):
        assert to_ground(sent)[key] == 1, key


def test_f_peer_up_killed_back_and_malformed(captured):
    rows = captured("f_sbn_disconnect")
    simulation, sent = replay(rows, "two-rovers", 1795241926.894)
    base = 1795241900 * SECOND
    up = [
        "SBN 259: connecting to peer 66:3",
        "SBN 5: Created peer pipe 'SBN_3_66_Pipe'",
        "SBN 5: Peer 66:3 connected.",
    ]
    failed, restart = "SBN 10: SBN_ProcessNetMsg failed: 0x00000001", "SBN 5: Creating recv task for net 0"
    not_received = (
        "SBN 10: ERROR: during SBN Receive Net Task: RecvFromNet failed for net 0: status=0x00000001"
    )
    mismatch = "SBN protocol version mismatch with peer 66:3, my version=11, peer version 10"
    expected = [
        *((32.969, text) for text in up),
        (59.804, "SBN 259: disconnected peer 66:3"),
        (59.804, "SBN 5: Disconnected from peer 66:3."),
        *((64.571, text) for text in up),
        (82.172, "SBN 8: cannot process unsubscription from ProcessorID 3, msg 0x08AB not found"),
        (83.410, "TO_LAB_APP 16: L497 TO RemovePkt 0x829"),
        (86.411, "TO_LAB_APP 15: L473 TO AddPkt 0x8f1, QoS 0.0, limit 8"),
        (89.173, "SBN 5: Disconnected from peer 66:3."),
        *((92.175, text) for text in up),
        (97.175, "SBN 6: version number mismatch with peer CpuID 3"),
        (97.175, failed),
        (97.213, restart),
        (99.175, f"SBN 1: ERROR: could not process peer message: {mismatch}"),
        (101.176, "SBN 10: ERROR: could not process peer message: unknown message type 0x00000007"),
        (101.176, failed),
        (101.215, restart),
        (104.176, "SBN 259: ERROR: unknown peer 66:9"),
        (104.176, not_received),
        (104.216, restart),
        (106.177, "SBN 4097: unable to set msgid"),
        (106.177, failed),
        (106.216, restart),
        (110.177, "SBN 259: ERROR: could not unpack message"),
        (110.177, not_received),
        (110.217, restart),
    ]
    told = [
        (time_ns, text.partition("66/1/")[2])
        for time_ns, text in simulation.cfs.console
        if time_ns > base + 32 * SECOND and "EVS" in text and "version match" not in text
    ]
    assert [text for _, text in told] == [text for _, text in expected]
    for (time_ns, text), (seconds, _) in zip(told, expected, strict=True):
        assert abs(time_ns - base - seconds * SECOND) < SECOND / 4, text
    to_bridge = Counter(
        (item.payload[2], len(item.payload)) for item in sent if item.destination.port == 2236
    )
    real = Counter((row.payload[2], len(row.payload)) for row in rows if row.destination_port == 2236)
    commands = (0x03, 107)  # how many depends on how wake-ups fall: 57 in flight
    assert 45 <= to_bridge.pop(commands) <= 65
    assert real.pop(commands) == 57
    heartbeats = (0xA0, 11)  # likewise: 6 s after the last of the above
    assert abs(to_bridge.pop(heartbeats) - real.pop(heartbeats)) <= 1
    assert to_bridge == real
    assert to_ground(sent)["0828", 136] == 106


@pytest.fixture(scope="module")
def command_rates():
    """c4_cmd_rate: rate to its commands, how many were lost in flight, and for each seed."""
    lost = {}
    for seed in SEEDS:
        beside = Beside("c4_cmd_rate", seed)
        for rate, sent, reached, ours in beside.steps():
            lost.setdefault(rate, (sent, sent - reached, []))[2].append(sent - ours)
        real, events = beside.events()
        assert set(events) == set(real)
    return lost


@pytest.mark.long
def test_c4_at_every_rate_as_many_commands_are_lost_within_three_points(command_rates):
    assert list(command_rates) == [2, 4, 6, 7, 8, 9, 10, 15, 20, 22, 25, 30, 50, 100]
    for rate, (sent, flight, emulated) in command_rates.items():
        assert sum(emulated) / len(emulated) == pytest.approx(flight, abs=0.03 * sent), rate
        assert emulated == pytest.approx([flight] * len(emulated), abs=0.06 * sent), rate
        assert flight == max(emulated) == 0 or rate > 8


@pytest.mark.long
def test_the_guide_has_these_figures(command_rates):
    guide = (ROOT / "docs/sim.md").read_text()
    for rate, (sent, flight, emulated) in command_rates.items():
        both = rf"{flight} \| {min(emulated)} to {max(emulated)}"
        row = rf"\| of {sent:,} (?:Twist )?at {rate} Hz[^|]*\| {both} \|"
        assert rate <= 8 or re.search(row, guide), row


def test_n1_remove_all_ends_telemetry_and_two_are_added_again():
    beside = Beside("n1_to_remove_all").run()
    assert beside.reached == (210, 210)
    real, ours = beside.events()
    assert ours == real
    assert ("TO_LAB_APP", 17) in ours
    real = Counter(row.payload[:2] for row in beside.rows if row.destination_port == 1235)
    ours = Counter(item.payload[:2] for item in beside.sent if item.destination.port == 1235)
    assert ours == real


def test_n3_a_cfs_that_is_killed_and_begins_again():
    beside = Beside("n3_cfs_restart").killed(1795306335.69)
    assert beside.commands == 245
    assert beside.reached == (207, pytest.approx(207, abs=2))
    real, ours = beside.events()
    assert ours == real
    assert len({item.source for item in beside.sent if item.destination.port == 1235}) == 2


@pytest.mark.quick("1")
@pytest.mark.parametrize("seed", SEEDS)
def test_n5_applications_restart_stop_and_start(seed):
    beside = Beside("n5_app_restarts", seed).run()
    assert beside.reached == (174, pytest.approx(174, abs=0.03 * beside.commands))
    real, ours = beside.events()
    assert set(ours) == set(real)
    for event in set(real) - {("CFE_SB", 17)}:  # how many depends on when housekeeping falls
        assert ours[event] == real[event], event
    told = [text.partition("66/1/")[2] for _, text in beside.simulation.cfs.console]
    assert "CFE_ES 10: Restart Application CI_LAB_APP Completed, AppID=1114124" in told
    assert "CFE_ES 10: Restart Application TO_LAB_APP Completed, AppID=1114125" in told
    assert "CFE_ES 8: Stop Application EDORAS_APP Completed." in told
    assert "CFE_ES 6: Started EDORAS_APP from /cf/edoras_app.so, AppID = 1114126" in told
    assert len({item.source for item in beside.sent if item.destination.port == 1235}) == 2


@pytest.mark.parametrize("name", ["a_rover", "n1_to_remove_all", "n5_app_restarts", "f_sbn_disconnect"])
def test_it_says_at_its_start_what_cfs_says(name):
    def counted(lines):
        return Counter(found.groups() for line in lines if (found := EVENT.search(line)))

    began_s = boots(name)[0]
    flight = [line for line in console(name)[0].splitlines() if began_s - 4 < seconds(line) < began_s + 0.5]
    beside = Beside(name, sbn_says_start=True).run(int((began_s + 0.5) * SECOND))
    real, ours = counted(flight), counted(text for _, text in beside.simulation.cfs.console)
    # How many of SBN's lines pass the squelch, and how many are lost, depends on when tasks run.
    assert (2 <= real[LOST_EVENT] <= 6, ours[LOST_EVENT]) == (True, 4)
    assert (10 <= real[SBN_LINE] <= 11, ours[SBN_LINE]) == (True, 11)
    assert {**ours, LOST_EVENT: 0, SBN_LINE: 0} == {**real, LOST_EVENT: 0, SBN_LINE: 0}
    housekeeping = next(row.payload for row in beside.rows if row.payload[:2] == b"\x08\x03")
    before, counters = int.from_bytes(housekeeping[30:32], "little"), beside.simulation.cfs.bus.counters
    assert counters.msg_limits == 8
    assert 4 <= before <= 12


@pytest.mark.quick("1")
@pytest.mark.parametrize("seed", SEEDS[:3])
def test_c3_every_pipe_is_cut_where_the_host_allows_ten(seed):
    beside = Beside("c3_mqueue10", seed, msg_max=10).run()
    counters = beside.simulation.cfs.bus.counters
    assert (counters.pipe_overflows, counters.msg_limits) == (67, 111)
    real, ours = beside.events()
    assert ours == real
    uncut = Beside("c3_mqueue10", seed).run().simulation.cfs.bus.counters
    assert uncut.pipe_overflows == 0


@pytest.mark.quick("5")
@pytest.mark.parametrize("seed", SEEDS)
def test_a_cfe_with_extended_headers(seed):
    """What it was sent goes in as it was sent; as many are lost, and packets as long come out."""
    beside = Beside("p6b_extended_header", seed, headers=WITH_EXTENDED).run()
    assert beside.commands == 300
    assert beside.reached == (277, pytest.approx(277, abs=0.03 * 300))
    real, ours = beside.events()
    assert set(real) == set(ours)
    ground = [row.payload for row in beside.rows if row.destination_port == 1235]
    emulated = [item.payload for item in beside.sent if item.destination.port == 1235]
    real, ours = (Counter((data[:2].hex(), len(data)) for data in sent) for sent in (ground, emulated))
    del real["080b", 200]  # the app information that ES was asked for once
    changing = ("0808", 172)
    assert ours.pop(changing) == pytest.approx(real.pop(changing), abs=6)  # an event each 16 losses at most
    assert ours == real
