"""What was lost, one by one: as many as the balance says, and which."""

from __future__ import annotations

import pytest
from places import CAPTURES, MISSIONS

from edoras_tools.diagnosis.missing import missing
from edoras_tools.wire import cfe

ROVER = [MISSIONS / "rover_ground.yaml"]


def of_topic(found, topic):
    return [item for item in found if item.topic == topic]


def test_commands_are_told_one_by_one(lab):
    diagnosis = lab.read(CAPTURES / "a_rover.pcap", ROVER)
    found = of_topic(missing(diagnosis.case), "/cmd_vel")
    assert (len(found), {item.what for item in found}) == (92, {"over the message limit of EDORAS_APP_PIPE"})
    assert [item.time_ns for item in found] == sorted(item.time_ns for item in found)
    numbers = [item.number for item in found]
    assert len(set(numbers)) == 92
    rows = diagnosis.case.rows
    sent = {int(number) for number in rows.number[rows.msg_id == 0x1827]}
    assert set(numbers) <= sent


@pytest.mark.parametrize("name", ["a_rover.pcap", "c1_tlm_rate_limit4.pcap.gz", "d3_cpu1_cpu2.pcap.gz"])
def test_the_latest_of_each_loss_are_the_last_of_all(name, lab):
    case = lab.read(CAPTURES / name).case
    every, latest = missing(case), missing(case, 5)
    assert 0 < len(latest) < len(every)
    for kind in {(item.msg_id, item.what) for item in every}:
        own = [item for item in every if (item.msg_id, item.what) == kind]
        some = [item for item in latest if (item.msg_id, item.what) == kind]
        assert some[-5:] == own[-5:]


def test_telemetry_is_told_by_its_counts(lab):
    diagnosis = lab.read(CAPTURES / "c1_tlm_rate_limit4.pcap.gz")
    found = [item for item in missing(diagnosis.case) if item.msg_id == 0x0827]
    (route,) = [row for row in diagnosis.routes if row["msg_id"] == "0x0827"]
    assert sum(item.first is not None for item in found) == route["gaps"]
    # What was lost behind the last count that came has none.
    assert len(found) == route["lost"]
    assert all((item.number, item.count) == (None, 1) for item in found)


@pytest.mark.long
def test_of_losses_that_are_fewer_than_what_may_be_meant_it_is_said(lab):
    found = missing(lab.read(CAPTURES / "d3_cpu1_cpu2.pcap.gz").case)
    vague = [item for item in found if item.one_of is not None]
    assert vague
    for item in vague:
        alike = [other for other in vague if (other.what, other.time_ns) == (item.what, item.time_ns)]
        assert (item.number, item.first) == (None, None)
        assert len(alike) < item.one_of
    told = [(item.link, item.number) for item in found if item.number is not None]
    assert len(set(told)) == len(told)


@pytest.mark.parametrize("left_out", [(3,), (3, 4), (5, 9)])
def test_counts_that_were_cut_out_are_named(lab, left_out):
    sent = [
        lab.at(
            second,
            lab.cfs,
            lab.ground,
            cfe.emit_telemetry(0x0805, bytes(32), seconds=1_001_000 + second, sequence_count=100 + second),
        )
        for second in range(20)
        if second not in left_out
    ]
    # Where no command to cFS is captured, nothing tells whether it was told to send nothing.
    sent.insert(0, lab.at(0, lab.ground, lab.ci, cfe.emit_command(0x1880, 0)))
    found = missing(lab.examine(sent).case)
    assert [item.first for item in found] == [100 + second for second in left_out]


def test_sound_traffic_misses_nothing(lab):
    assert missing(lab.examine(lab.simulate(seconds=20)[0], lab.missions("rover")).case) == []
