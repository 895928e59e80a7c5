"""What a proxy did on purpose: in the balance of the hop where it stood, and blamed on nobody else."""

from __future__ import annotations

from collections import Counter

import pytest
from msgspec.structs import replace
from places import ROOT
from rewriting import datagrams, write

from edoras_tools.diagnosis.examination import Examination
from edoras_tools.diagnosis.missing import missing
from edoras_tools.io.formats.open import open_file
from edoras_tools.links import table
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.sessions.faults.machine import FaultPlan
from edoras_tools.sessions.faults.rules import parse_rule
from tests.support.balance import arrived, ended, wrong_rows

CI, TO = 1234, 1235
TWIST = 0x1827
A_ROVER_LOST = 92


def relayed(rules, seed=3):
    """Return what a proxy in front of CI, and one behind TO, leave of a_rover, and what they did."""
    machine = FaultPlan(tuple(parse_rule(rule) for rule in rules), seed).start(0)
    kept, faults = [], []
    for item in datagrams(ROOT / "tests/captures/a_rover.pcap.zst"):
        port = item.destination[1]
        if port not in {CI, TO}:
            kept.append(item)
            continue
        link = table.link_of_label("ci" if port == CI else "to")
        sent, done = machine.apply(item.payload, link=link, to_cfs=port == CI, now=item.time_ns)
        kept += [replace(item, payload=one.payload).at(place * 1000) for place, one in enumerate(sent)]
        faults += done
    return kept, faults, machine


def diagnosed(tmp_path, kept, faults):
    bench = Settings().workbench()
    examination = Examination(bench.columns.context)
    examination.faults = faults
    for batch in open_file(write(tmp_path / "x.pcap", kept)).batches():
        examination.add(batch, bench.columns.decode(batch))
    return examination.diagnose()


def in_front(items, port, *, moved):
    """Return a capture in front of the proxy: all to a port, 0.2 ms earlier; with other ends if moved."""

    def end(place):
        return ("10.0.0.7", place[1]) if moved else place

    return [
        replace(item, source=end(item.source), destination=end(item.destination), tap=7).at(-200_000)
        for item in items
        if item.destination[1] == port
    ]


@pytest.mark.each(2)
@pytest.mark.quick("ci-1234-other ends", "to-1235-same ends")
@pytest.mark.parametrize("moved", [True, False], ids=["other ends", "same ends"])
@pytest.mark.parametrize(("link", "port"), [("to", TO), ("ci", CI)])
def test_a_capture_from_in_front_of_it_counts_nothing_twice(tmp_path, link, port, moved):
    rule = f"drop:0.1,link={link}" if link == "to" else "drop:0.1,msg_id=0x1827"
    kept, faults, _ = relayed([rule])
    whole = datagrams(ROOT / "tests/captures/a_rover.pcap.zst")
    alone = diagnosed(tmp_path, kept, faults)
    merged = sorted([*kept, *in_front(whole, port, moved=moved)], key=lambda item: item.time_ns)
    found = diagnosed(tmp_path, merged, faults)
    assert wrong_rows(found.balance) == []
    assert by_cause(found) == by_cause(alone)
    assert by_cause(found)["proxy"] == len(faults) > 20
    assert found.unaccounted == alone.unaccounted
    told = [item for item in found.verdicts if item.rule == "proxy_faults"]
    assert sum(item.lost or 0 for item in told) == len(faults)
    assert any("in front of the proxy" in item.reason for item in told)


def by_cause(found):
    total = Counter()
    for row in found.balance:
        total += Counter(row.lost)
    return total


@pytest.mark.quick("1")
@pytest.mark.parametrize("seed", range(3))
def test_what_it_dropped_from_telemetry_is_not_blamed_on_cfs(tmp_path, seed):
    kept, faults, machine = relayed(["drop:0.1,link=to"], seed)
    found = diagnosed(tmp_path, kept, faults)
    assert wrong_rows(found.balance) == []
    dropped = machine.struck[0]
    assert dropped > 20
    # Those before a stream's first and behind its last leave no gap: they are the proxy's all the same.
    assert by_cause(found) == {"limit": A_ROVER_LOST, "proxy": dropped}
    assert found.unaccounted == 0
    (verdicts,) = [[item for item in found.verdicts if item.rule == "proxy_faults"]]
    assert sum(item.lost or 0 for item in verdicts) == dropped
    assert "lost_after_cfs" not in {item.rule for item in found.verdicts}


@pytest.mark.quick("1")
@pytest.mark.parametrize("seed", range(3))
def test_what_it_dropped_on_the_way_to_ci_was_sent_and_is_lost_there(tmp_path, seed):
    kept, faults, machine = relayed(["drop:0.07,msg_id=0x1827"], seed)
    # The robot's commands are in the capture: those that were dropped never came to be.
    gone = {fault.original[-48:] for fault in faults}
    kept = [item for item in kept if item.destination[1] != 8585 or item.payload not in gone]
    found = diagnosed(tmp_path, kept, faults)
    (row,) = [row for row in found.balance if row.hop == "proxy"]
    assert (row.came, row.out, row.all_lost) == (600, 600 - machine.struck[0], machine.struck[0])
    (line,) = [item for item in found.headlines if item.topic == "0x1827"]
    ends = ended(line)
    rest = ends.total() - ends["uncertain"] - ends["shared"]
    assert line.sent == 600 == arrived(line) + rest


def test_doubles_and_what_it_did_else_are_said_and_not_lost(tmp_path):
    kept, faults, _ = relayed(["duplicate:0.05,link=to", "corrupt:0.01,link=to"])
    found = diagnosed(tmp_path, kept, faults)
    assert wrong_rows(found.balance) == []
    assert by_cause(found)["proxy"] == 0
    doubled = sum(fault.kind == "duplicate" for fault in faults)
    assert sum(row.duplicated for row in found.balance if row.hop == "proxy") == doubled
    told = " ".join(item.reason for item in found.verdicts if item.rule == "proxy_faults")
    assert "sent again" in told
    assert "struck by corrupt" in told


def test_what_it_dropped_is_lost_once_where_two_cfs_get_that_msg_id(tmp_path):
    kept, faults, _ = relayed(["drop:0.1,msg_id=0x1827"])
    other = next(item for item in kept if item.payload.startswith(TWIST.to_bytes(2, "big")))
    second = [
        replace(other, destination=("10.0.0.8", CI), identification=at + 1).at(at * 1_000_000_000)
        for at in range(9)
    ]
    found = diagnosed(tmp_path, sorted([*kept, *second], key=lambda item: item.time_ns), faults)
    assert wrong_rows(found.balance) == []
    assert by_cause(found)["proxy"] == len(faults) > 20
    assert len(missing(found.case)) == found.lost


def test_of_two_rules_that_drop_one_datagram_it_is_lost_once(tmp_path):
    kept, faults, _ = relayed(["drop:0.2,msg_id=0x827", "drop:0.3,msg_id=0x827"])
    lost = 63 - sum(item.payload[:2] == b"\x08\x27" for item in kept if item.destination[1] == TO)
    found = diagnosed(tmp_path, kept, faults)
    assert by_cause(found)["proxy"] == lost < len(faults)


@pytest.mark.quick("1")
@pytest.mark.parametrize("seed", range(3))
def test_what_it_did_and_what_cfs_counted_are_all_that_was_sent(lab, msg_id, seed):
    """Commands through the faults into the emulated cFS: its own counters have what the proxy let through."""
    seconds, until_s = 40, 36
    operator, _ = lab.simulate("rover", seconds=until_s, hz=11.0)
    commands = [item for item in operator if msg_id(item) == TWIST and item.destination == lab.ci]
    rules = ("drop:0.15,msg_id=0x1827", "duplicate:0.05,msg_id=0x1827")
    machine = FaultPlan(tuple(parse_rule(rule) for rule in rules), seed).start(0)
    through, faults = [], []
    for item in commands:
        made, done = machine.apply(
            item.payload, link=table.link_of_label("ci"), to_cfs=True, now=item.time_ns
        )
        through += [
            item._replace(time_ns=item.time_ns + at * 1000, payload=one.payload)
            for at, one in enumerate(made)
        ]
        faults += done
    feeds = tuple(((item.time_ns - lab.start_ns) / 1e9, CI, item.payload) for item in through)
    sent, counters = lab.simulate("rover", seconds=seconds, hz=0.0, feeds=feeds)
    found = lab.examine(lab.merged(sent, *through), lab.mission("rover_ground"), faults=faults)
    assert wrong_rows(found.balance) == []
    rows = {row.hop: row for row in found.balance if row.msg_id == TWIST}
    dropped, doubled = machine.struck
    assert min(dropped, doubled) > 5
    assert (rows["proxy"].came, rows["proxy"].out) == (len(commands), len(through))
    assert (rows["proxy"].all_lost, rows["proxy"].duplicated) == (dropped, doubled)
    # What CI counted of them, less the commands that the simulation itself sends it.
    read = max(int.from_bytes(item.payload[28:32], "little") for item in sent if msg_id(item) == 0x884)
    others = sum(item.destination == lab.ci for item in sent)
    assert rows["CI"].out == len(through) == read - others
    assert by_cause(found) == {"limit": counters.msg_limits, "proxy": dropped}
    assert counters.msg_limits > 0
    assert rows["software bus"].out == len(through) - counters.msg_limits
    assert found.unaccounted == 0
