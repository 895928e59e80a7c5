"""Captures held against the emulated cFS: which it explains, and where it departs."""

import json

import pytest
from commands import call  # noqa: F401  a fixture
from places import CAPTURES, ROOT
from rewriting import Udp, write

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.units import SECOND

TESTS = ROOT / "tests/captures"
EXPLAINED = {
    TESTS / "p6b_extended_header.pcap.zst": (0x1827, 23),
    CAPTURES / "a_rover.pcap": (0x1827, 92),
    TESTS / "c4_cmd_rate.pcap.zst": (0x1827, 1283),
    TESTS / "season3/q17_two_bridges_same_topic.pcap.zst": (0x1827, 41),
    TESTS / "season3/q27_three_hops_one_counter.pcap.zst": (0x082B, 215),
    TESTS / "season3/q01_two_causes_one_counter.pcap.zst": (0x0827, 229),
}


def proven(run, path):
    done = run("doctor", path, "--prove", "--json")
    return done.code, json.loads(done.out)


@pytest.mark.long
@pytest.mark.parametrize("path", EXPLAINED)
def test_the_model_loses_as_much_and_the_advice_keeps_its_promise(path, call):  # noqa: F811
    code, found = proven(call, path)
    assert (code, found["explained"], found["kept"]) == (0, True, True)
    msg_id, lost = EXPLAINED[path]
    (row,) = [item for item in found["routes"] if item["msg_id"] == f"0x{msg_id:04x}"]
    assert row["lost"][0] <= lost <= row["lost"][1]
    assert found["left"][0] <= found["promised"] + 3


def test_what_the_emulated_cfs_does_not_do_is_where_it_departs(call):  # noqa: F811
    done = call("doctor", TESTS / "season3/n11_jointstate_sizes.pcap.zst", "--prove")
    lines = done.out.splitlines()
    assert done.code == 3
    assert lines[-1] == "This model does not explain this capture; it departs at 0x0828, 0x182a."
    assert [line.split() for line in lines[2:4]] == [
        ["0x0828", "76", "32", "0", "departs"],
        ["0x182a", "12", "12", "0", "departs"],
    ]


@pytest.mark.long
@pytest.mark.parametrize("hz", [8, 9, 10, 12, 15, 30])
@pytest.mark.parametrize("scenario", ["rover", "arm"])
def test_what_was_emulated_is_explained(scenario, hz, call, tmp_path):  # noqa: F811
    start_ns = 1_800_000_000 * SECOND
    run = Simulation(scenario=scenario, start_ns=start_ns, command_rate_hz=hz).boot()
    sent = [
        Udp(item.time_ns, *((end.address, end.port) for end in (item.source, item.destination)), item.payload)
        for item in run.run(run.now + 40 * SECOND)
    ]
    _, found = proven(call, write(tmp_path / "run.pcap", sent))
    assert found["explained"] is True
    assert found["kept"] is not False


def test_a_capture_is_read_several_times(call):  # noqa: F811
    done = call("doctor", "--prove", "-i", "lo")
    assert done.code == 2
    done = call("doctor", CAPTURES / "a_rover.pcap", "--prove", "--predict")
    assert (done.code, done.err) == (
        2,
        ["edoras: --predict and --prove exclude each other; choose one"],
    )
