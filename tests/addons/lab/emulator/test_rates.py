"""What gets through at which rate, against the marks of c1_tlm_rate_limit4 and the measured thresholds."""

from __future__ import annotations

from collections import Counter

import pytest

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.addons.lab.emulator.apps.generator import set_command
from edoras_tools.cfs.profile import TO_TABLE, SbnPeerConfig, SimProfile
from edoras_tools.model import Peer
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import cfe, sbn

TASK = "EDORAS_GEN.EDORAS_GEN_T"
LIMIT = f"EVS Port1 66/1/CFE_SB 17: Msg Limit Err,MsgId 0x827,pipe TO_LAB_TLM_PIPE,sender {TASK}"
ENABLE = cfe.emit_command(0x1880, 6, b"127.0.0.1".ljust(16, b"\0"))
RESET_FILTERS = cfe.emit_command(0x1801, 14, b"CFE_SB".ljust(20, b"\0"))

# rate; when the console says the generator was set and stopped; received in 8 s; msgLimit; events
MARKS = [
    (1, 783.038794, 791.038949, 8, 0, 0),
    (2, 794.538471, 802.558410, 17, 0, 0),
    (4, 806.558640, 814.558369, 32, 0, 0),
    (6, 818.058714, 826.058725, 48, 0, 0),
    (7, 830.058453, 838.058360, 56, 0, 0),
    (8, 841.558407, 849.558330, 64, 0, 0),
    (9, 853.058413, 861.058856, 65, 7, 7),
    (10, 865.059103, 873.058795, 65, 15, 15),
    (12, 876.558331, 884.558860, 65, 31, 16),
    (20, 888.558716, 896.558329, 65, 95, 16),
    (30, 900.058789, 908.058848, 65, 175, 16),
    (50, 911.558437, 919.558339, 66, 334, 16),
    (100, 923.558358, 931.558719, 68, 732, 16),
    (200, 935.058367, 943.058445, 69, 1530, 16),
    (250, 947.058479, 955.058465, 68, 1931, 16),
    (500, 958.558701, 966.558336, 68, 3929, 16),
    (1000, 970.058685, 978.058625, 68, 7927, 16),
]
FIRST_TO_WAKE = 783.0501
"""When telemetry went out after the first start: it fixes the phase of TO's delay loop."""


def seconds(value: float) -> int:
    return int(value * SECOND)


def generate(simulation: Simulation, msg_id: int, rate: int, at_ns: int) -> None:
    simulation.inject(at_ns, cfe.emit_command(0x18F0, 2, set_command(msg_id, rate)), "CI_LAB_APP")


@pytest.mark.long
def test_c1_at_every_rate_within_5_percent_with_the_same_events():
    boot = seconds(FIRST_TO_WAKE) - 30 * (500 * MILLISECOND + 165_000)
    simulation = Simulation(scenario="two-rovers", start_ns=boot, bridges=False)
    simulation.feed(seconds(778.6), simulation.cfs.ci_endpoint, ENABLE)
    for rate, start, stop, *_ in MARKS:
        simulation.feed(seconds(start - 1.4), simulation.cfs.ci_endpoint, RESET_FILTERS)
        generate(simulation, 0x827, rate, seconds(start))
        generate(simulation, 0x827, 0, seconds(stop))
    list(simulation.run(seconds(782)))
    counted = said = 0
    for rate, _, stop, received, msg_limit, events in MARKS:
        sent = Counter(item.payload[:2].hex() for item in simulation.run(seconds(stop + 1.5)))
        lost = simulation.cfs.bus.counters.msg_limits - counted
        told = [text for _, text in simulation.cfs.console].count(LIMIT) - said
        assert sent["0827"] == pytest.approx(received, rel=0.05), rate
        assert lost == pytest.approx(msg_limit, rel=0.05), rate
        assert told == events, rate
        counted, said = counted + lost, said + told
    assert simulation.cfs.bus.counters.pipe_overflows == 0


@pytest.mark.quick("80*", "95*")
@pytest.mark.parametrize(("rate", "clean"), [(60, True), (80, True), (95, False), (120, False)])
def test_with_a_limit_of_255_the_pipe_itself_overflows_from_about_90_hz(rate, clean):
    profile = SimProfile(to_limits=TO_TABLE | {0x08F1: 255})
    simulation = Simulation(profile, "two-rovers", bridges=False)
    simulation.feed(SECOND, simulation.cfs.ci_endpoint, ENABLE)
    generate(simulation, 0x08F1, rate, 2 * SECOND)
    list(simulation.run(12 * SECOND))
    overflow = f"EVS Port1 66/1/CFE_SB 25: Pipe Overflow,MsgId 0x8f1,pipe TO_LAB_TLM_PIPE,sender {TASK}"
    assert (simulation.cfs.bus.counters.pipe_overflows == 0) == clean
    assert [text for _, text in simulation.cfs.console].count(overflow) <= 16
    assert (overflow in [text for _, text in simulation.cfs.console]) != clean


@pytest.mark.quick("100*", "20*")
@pytest.mark.parametrize(("rate", "low", "high"), [(20, 19, 21), (38, 36, 39), (100, 38, 42), (400, 38, 42)])
def test_cfs_to_peer_tops_out_near_40_a_second_a_msg_id(rate, low, high):
    bridge = Peer(0x42, 3)
    simulation = Simulation(SimProfile(sbn_peers=(SbnPeerConfig(bridge, 2236),)), "two-rovers", bridges=False)
    wanted = sbn.emit_subscriptions([sbn.Subscription(0x08F1)])
    for second in range(1, 13):
        subscribe = sbn.emit(sbn.MsgType.SUB, bridge, wanted)
        simulation.feed(second * SECOND, simulation.cfs.sbn_endpoint, subscribe)
    generate(simulation, 0x08F1, rate, 2 * SECOND)
    sent = [item for item in simulation.run(12 * SECOND) if item.payload[2] == sbn.MsgType.APP]
    assert low <= len(sent) / 10 <= high
    limit = f"EVS Port1 66/1/CFE_SB 17: Msg Limit Err,MsgId 0x8f1,pipe SBN_3_66_Pipe,sender {TASK}"
    assert (limit in [text for _, text in simulation.cfs.console]) == (rate > 40)


@pytest.mark.parametrize(("polls", "clean"), [(False, True), (True, False)])
def test_peer_to_cfs_at_30_hz_fails_only_where_sbn_polls(polls, clean):
    simulation = Simulation(SimProfile(sbn_polls=polls), "two-rovers", bridges=False)
    state = cfe.emit_command(0x1829, 1, bytes(100))
    for index in range(300):
        data = sbn.emit(sbn.MsgType.APP, Peer(0x42, 3), state)
        simulation.feed(SECOND + index * SECOND // 30, simulation.cfs.sbn_endpoint, data)
    list(simulation.run(12 * SECOND))
    limit = "EVS Port1 66/1/CFE_SB 17: Msg Limit Err,MsgId 0x1829,pipe EDORAS_APP_PIPE,sender SBN"
    assert (limit not in [text for _, text in simulation.cfs.console]) == clean


def test_command_ingest_reads_about_22_datagrams_a_second():
    simulation = Simulation(scenario="rover", bridges=False)
    nobody = cfe.emit_command(0x18EE, 0)
    for _ in range(200):
        simulation.feed(SECOND, simulation.cfs.ci_endpoint, nobody)
    list(simulation.run(6 * SECOND))
    # Two wake-ups a second; where a housekeeping request beats the time-out a third is possible.
    assert 5 * 22 - 11 <= simulation.apps.ci.ingest_packets <= 5 * 22 + 22
