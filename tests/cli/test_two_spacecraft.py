"""Two rovers in one capture: each has its own routes, topics and figures, those of its own capture."""

from __future__ import annotations

import csv
import json
from collections import defaultdict

import merging
import pytest
from mcap.reader import make_reader
from places import ROOT

CAPTURES = ROOT / "samples/captures"
MISSION = ROOT / "samples/missions/rover_ground.yaml"
NAMES = """
/**:
  ros__parameters:
    spacecraft:
      beta: 10.0.0.3
      alpha: 10.0.0.2
"""
PAIRS = {
    "CI and TO": {"10.0.0.2": "a_rover.pcap", "10.0.0.3": "b_arm_single.pcap"},
    "and SBN": {"10.0.0.2": "f_sbn_disconnect.pcap", "10.0.0.3": "e_ci_errors.pcap"},
    "of IPv6": {"fd00::2": "e_ci_errors.pcap", "10.0.0.3": "a_rover.pcap"},
}


@pytest.fixture(scope="module", params=PAIRS)
def rovers(request, tmp_path_factory):
    """The merged capture, and those of each rover."""
    files = {address: CAPTURES / name for address, name in PAIRS[request.param].items()}
    return merging.merge(files, tmp_path_factory.mktemp("rovers"))


OF_THE_WHOLE = {"spacecraft", "instance", "reason", "evidence"}
"""What says which spacecraft a row is of, or the number of a packet in the capture."""


def of_second(row):
    """Return a row without what differs where the capture has others beside it."""
    row = {name: value for name, value in row.items() if name not in OF_THE_WHOLE}
    if row.get("topic"):
        row["topic"] = row["topic"].removeprefix("/sc_2")
    return json.dumps(row, sort_keys=True)


def json_of(call, *words):
    result = call(*words, "-c", MISSION, "--json")
    return result.json()


def test_info_counts_each_by_itself(call, rovers):
    whole, parts = rovers
    rows = json_of(call, "info", whole)["routes"]
    assert {row["spacecraft"] for row in rows} == {1, 2}
    for number, part in enumerate(parts, 1):
        alone = json_of(call, "info", part)["routes"]
        assert [of_second(row) for row in rows if row["spacecraft"] == number] == list(map(of_second, alone))
        only = json_of(call, "info", whole, "--where", f"spacecraft == {number}")["routes"]
        assert list(map(of_second, only)) == list(map(of_second, alone))


def test_the_doctor_judges_each_by_itself(call, rovers):
    whole, parts = rovers
    found = json_of(call, "doctor", whole)
    alone = [json_of(call, "doctor", part) for part in parts]
    for table in ("balance", "ways", "routes", "verdicts", "habits", "peers"):
        expected = sorted(of_second(row) for one in alone for row in one[table])
        assert sorted(map(of_second, found[table])) == expected
    assert found["lost"] == sum(one["lost"] for one in alone)
    about_itself = {"capture_drops", "cut_frames", "not_examined", "out_of_order"}
    sentences = [item["reason"] for item in found["verdicts"] if item["rule"] not in about_itself]
    assert all(text.startswith(("spacecraft 1: ", "spacecraft 2: ")) for text in sentences)


def messages(path):
    topics = defaultdict(list)
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            content = message.log_time, message.publish_time, message.sequence, bytes(message.data)
            topics[channel.topic].append(content)
    return topics


def test_a_recording_has_topics_of_each(call, rovers, tmp_path):
    whole, parts = rovers
    paths = [tmp_path / f"{number}.mcap" for number in range(3)]
    for source, path in zip((whole, *parts), paths, strict=True):
        assert call("record", source, "-o", path, "-c", MISSION, "-q").code == 0
    both, *alone = map(messages, paths)
    shared = {"/edoras/datagrams", "/edoras/link_statistics"}
    expected = {}
    for own, prefix in zip(alone, ("", "/sc_2"), strict=True):
        expected |= {prefix + topic: content for topic, content in own.items() if topic not in shared}
    assert {topic: content for topic, content in both.items() if topic not in shared} == expected
    again = tmp_path / "again.mcap"
    assert call("record", paths[0], "-o", again, "-c", MISSION, "-q").code == 0
    assert messages(again) == both


def test_a_stream_has_the_same_topics(edoras, call, rovers, tmp_path):
    whole, streamed = tmp_path / "whole.mcap", tmp_path / "streamed.mcap"
    assert call("record", rovers[0], "-o", whole, "-c", MISSION, "-q").code == 0
    with rovers[0].open("rb") as file:
        assert edoras("record", "-", "-o", streamed, "-c", MISSION, "-q", stdin=file).returncode == 0
    assert messages(streamed) == messages(whole)


def test_a_topic_is_of_one_spacecraft(call, tmp_path, rovers):
    whole, _ = rovers
    rows = {row["topic"]: row["count"] for row in json_of(call, "info", whole)["routes"] if row["topic"]}
    for topic in filter(lambda item: item.endswith("/cmd_vel"), rows):
        words = ("sniff", whole, "-c", MISSION, "--json")
        for choice in (("--topic", topic), ("--where", f'topic == "{topic}"')):
            assert call(*words, *choice).out.count("\n") == rows[topic]
    table, housekeeping = tmp_path / "x.csv", "/sc_2/cfs/CFE_ES_HousekeepingTlm"
    assert call("export", whole, "-c", MISSION, "--topic", housekeeping, "-o", table, "-q").code == 0
    with table.open(newline="") as file:
        exported = len(list(csv.reader(file))) - 1
    found = json_of(call, "info", whole, "--where", "spacecraft == 2 and msg_id == 0x0800")
    assert exported == found["datagrams"] > 0


def test_names_of_a_mission_file(call, tmp_path, rovers):
    names = tmp_path / "names.yaml"
    names.write_text(NAMES)
    if b"\x86\xdd" in rovers[0].read_bytes()[:60]:
        names.write_text(NAMES.replace("10.0.0.2", '"fd00::2"'))
    result = call("info", rovers[0], "-c", MISSION, "-c", names, "--json")
    topics = {row["topic"]: row["spacecraft"] for row in json.loads(result.out)["routes"] if row["topic"]}
    assert topics["/sc_beta/cmd_vel"] == 1
    assert {topic.split("/")[1] for topic in topics} <= {"sc_alpha", "sc_beta"}


def test_a_name_without_an_address_is_one_line(call, tmp_path, rovers):
    names = tmp_path / "names.yaml"
    names.write_text(NAMES.replace("10.0.0.3", "rover"))
    result = call("info", rovers[0], "-c", names)
    assert (result.code, len(result.err)) == (2, 1)
    assert 'spacecraft.beta: "rover" is none; an IP address is needed' in result.err[0]


def test_one_cfs_seen_at_two_addresses_is_one(edoras, call, tmp_path):
    """The second sight of each datagram is a millisecond later, as behind a router that writes addresses."""
    one = merging.at_address(CAPTURES / "a_rover.pcap", "10.0.0.2")
    other = merging.at_address(CAPTURES / "a_rover.pcap", "10.0.0.3", 1_000_000)
    items = sorted([*one, *other], key=lambda item: item.time_ns)
    path = merging.rewriting.write(tmp_path / "x.pcap", items)
    packets = [
        item for item in items if item.destination[1] in {1234, 1235}
    ]  # what tells copies at first sight
    with merging.rewriting.write(tmp_path / "packets.pcap", packets).open("rb") as file:
        streamed = json.loads(edoras("info", "-", "-c", MISSION, "--json", stdin=file).stdout)
    for found in (json_of(call, "info", path), streamed):
        assert not any("spacecraft" in row or "/sc_" in (row["topic"] or "") for row in found["routes"])
