"""Two rovers in one capture: each has its own routes, topics and figures, those of its own capture."""

from __future__ import annotations

import csv
import json
import re
from collections import defaultdict

import duckdb
import merging
import pytest
import yaml
from distributed import LocalCluster
from mcap.reader import make_reader
from places import ROOT

from edoras_tools.diagnosis import examination
from edoras_tools.io.formats import capture_file

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


@pytest.mark.quick("and SBN")
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


@pytest.mark.quick("of IPv6")
def test_a_stream_has_the_same_topics(edoras, call, rovers, tmp_path):
    whole, streamed = tmp_path / "whole.mcap", tmp_path / "streamed.mcap"
    assert call("record", rovers[0], "-o", whole, "-c", MISSION, "-q").code == 0
    with rovers[0].open("rb") as file:
        assert edoras("record", "-", "-o", streamed, "-c", MISSION, "-q", stdin=file).returncode == 0
    assert messages(streamed) == messages(whole)


@pytest.mark.quick("CI and TO")
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


def of_each(whole, parts):
    """Yield the number of each rover, what its topics begin with, and its own capture."""
    yield from zip((1, 2), ("", "/sc_2"), parts, strict=True)


@pytest.mark.quick("and SBN")
def test_what_was_lost_is_listed_for_each(call, rovers):
    whole, parts = rovers
    words = ("--list-lost", "json", "-c", MISSION)
    listed = call("doctor", whole, *words).json()["missing"]
    times = [item["time_ns"] for item in listed]
    assert times == sorted(times)

    def lost(rows):
        return sorted((row["time_ns"], row["link"], row["msg_id"] or "", row["what"]) for row in rows)

    for number, prefix, part in of_each(whole, parts):
        alone = call("doctor", part, *words).json()["missing"]
        own = [row for row in listed if (row["topic"] or "").startswith("/sc_2") == (number == 2)]
        assert lost(own) == lost(alone)
        topic = f"{prefix}/cmd_vel"
        found = call("doctor", whole, *words, "--topic", topic).json()["missing"]
        assert len(found) == sum(row["topic"] == "/cmd_vel" for row in alone)
        assert {row["topic"] for row in found} <= {topic}
    if listed:
        place = len(listed) // 2
        trace = call("trace", whole, "-c", MISSION, "--lost", place + 1, "--json").json()["trace"]
        assert (trace["topic"], trace["link"]) == (
            listed[place]["topic"] or trace["topic"],
            listed[place]["link"],
        )


@pytest.mark.quick("of IPv6")
def test_checks_and_drafts_hold_each_to_its_own(call, rovers, tmp_path):
    whole, parts = rovers
    expect, words = tmp_path / "both.yaml", ("-c", MISSION, "-q")
    drafts = []
    for path in (whole, *parts):
        assert call("check", "--init", path, *words, "-o", expect, "--force").code == 0
        drafts.append(yaml.load(expect.read_text(), yaml.BaseLoader)["topics"])
    # Silence counts from the beginning of the capture, and a rate may last to its end.
    both, *alone = ({name: {**own, "silence": 0, "rate": 0} for name, own in item.items()} for item in drafts)
    expected = {}
    for (_, prefix, _), own in zip(of_each(whole, parts), alone, strict=True):
        expected |= {f"{prefix}/{topic}" if prefix else topic: own[topic] for topic in own if topic[0] != "/"}
        expected |= {f"{prefix}{topic}": own[topic] for topic in own if topic[0] == "/"}
    assert both == expected
    lines = []
    for _, prefix, part in of_each(whole, parts):
        alone = json_of(call, "info", part)["routes"]
        count = next(row["count"] for row in alone if row["topic"] == "/cmd_vel")
        lines.append(f"  {prefix}/cmd_vel: {{count: {count}}}\n")
    expect.write_text(f"schema: 1\ntopics:\n{''.join(lines)}  /sc_2/0x1827: {{count: {count}}}\n")
    report = call("check", whole, expect, "-c", MISSION, "--json").json()
    results = {item["about"]: item["passed"] for item in report["results"] if item["expectation"] == "count"}
    assert results == dict.fromkeys(("/cmd_vel", "/sc_2/cmd_vel", "/sc_2/0x1827"), True)


@pytest.mark.quick("of IPv6")
def test_runs_are_compared_rover_by_rover(call, rovers):
    whole, (first, _) = rovers
    found = call("compare", first, whole, "-c", MISSION, "--json").json()
    points = [item for item in found["points"] if item["what"] != "verdict" and item["route"]]
    others = [item for item in points if not item["route"].startswith("/sc_2/")]
    assert {item["route"] for item in others} >= {"/cmd_vel", "ES_HK"}
    assert [item["bad"] for item in others] == pytest.approx([item["good"] for item in others])
    assert {item["what"] for item in points if item not in others} == {"route"}
    alike = call("compare", whole, whole, "-c", MISSION, "--json").json()
    assert alike["changes"] == []
    assert {item["route"] for item in alike["points"]} >= {"/cmd_vel", "/sc_2/cmd_vel", "/sc_2/ES_HK"}


@pytest.mark.quick("and SBN")
def test_an_archive_has_rows_of_each(call, rovers, tmp_path):
    whole, parts = rovers
    index, names = tmp_path / "x.duckdb", [str(path) for path in (whole, *parts)]
    options = {"host": "127.0.0.1", "dashboard_address": None, "silence_logs": 60}
    with LocalCluster(n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", **options) as here:
        words = ("-c", MISSION, "--index", index, "--scheduler", here.scheduler_address, "-q")
        assert call("archive", *names, *words).code == 0
    with duckdb.connect(str(index), read_only=True) as opened:
        for table in ("routes", "outcomes", "losses", "events", "verdicts", "latencies"):
            for number, part in enumerate(names[1:], 1):
                own = archived(opened, table, part)
                assert archived(opened, table, names[0], number) == own
                assert own or table != "routes"
    losses = call("archive", "losses", "--index", index, "--json").json()["losses"]
    assert {item["spacecraft"] for item in losses} <= {1, 2, None}


def archived(opened, table, capture, number=None):
    """Return the rows of a capture, or of a spacecraft in it, without what differs beside others."""
    left_out = "capture, spacecraft" + {
        "events": "",
        "losses": ", instance",
        "latencies": ", instance",
        "verdicts": ", reason, evidence",
    }.get(table, "")
    where = "capture = ?" if number is None else f"capture = ? AND spacecraft = {number}"
    where += " AND rule NOT IN ('not_examined', 'out_of_order')" if table == "verdicts" else ""
    rows = opened.execute(f"SELECT * EXCLUDE ({left_out}) FROM {table} WHERE {where}", [capture]).fetchall()
    return sorted(str([str(cell).removeprefix("/sc_2") for cell in row]) for row in rows)


@pytest.mark.quick("and SBN")
def test_a_plot_and_rates_are_of_each(call, rovers, tmp_path):
    whole, parts = rovers
    figure = json_of(call, "plot", whole)
    lines = {line["label"]: line["read"] for line in figure["panels"][0]["lines"]}
    rates = json_of(call, "hz", whole)["topics"]
    events = left_out = 0
    for number, prefix, part in of_each(whole, parts):
        alone = json_of(call, "plot", part)
        own = {f"{prefix}{line['label']}": line["read"] for line in alone["panels"][0]["lines"]}
        assert {name: lines.get(name) for name in own} == own
        events, left_out = events + alone["events"], left_out + alone["left_out"]
        own_rates = [row for row in rates if row["topic"].startswith("/sc_2/") == (number == 2)]
        for row in json_of(call, "hz", part)["topics"]:
            row["topic"] = prefix + row["topic"]
            assert row in own_rates
        topic = f"{prefix}/cmd_vel"
        (row,) = json_of(call, "hz", whole, topic)["topics"]
        assert row in own_rates
    assert (figure["events"], figure["left_out"]) == (events, left_out)
    page = tmp_path / "x.html"
    assert call("plot", whole, "-c", MISSION, "-o", page).code == 0
    events = re.findall(r'"((?:/sc_2/)?(?:SBN|CFE_SB): [^"]*)"', page.read_text())
    text = "/sc_2/CFE_SB: Send Err:Invalid MsgId(0x2827)in msg,App CI_LAB_APP"
    assert {"SBN: Peer 66:3 connected.", text} <= {*events}


@pytest.mark.quick("CI and TO-*")
@pytest.mark.parametrize(
    "verb", [["topic", "list"], ["topic", "info"], ["bw"], ["delay"], ["echo"]], ids=" ".join
)
def test_verbs_of_ros_do_not_mix_them(call, rovers, verb):
    whole, parts = rovers
    words = ("-c", MISSION)
    named = {"delay": "/telemetry_pose", "list": ""}.get(verb[-1], "/cmd_vel")
    texts = []
    for _, prefix, part in of_each(whole, parts):
        topic = [prefix + named] if named else []
        found = call(*verb, whole, *topic, *words)
        alone = call(*verb, part, *([named] if named else []), *words)
        assert found.code == alone.code
        if named:
            assert (found.out, found.err) == (alone.out, [line.replace("/sc_2", "") for line in alone.err])
        texts += [f"{prefix}{line}" for line in alone.out.splitlines()]
    if not named:
        assert found.out.splitlines() == sorted(texts)


@pytest.mark.quick("CI and TO")
@pytest.mark.parametrize("rovers", ["CI and TO", "and SBN"], indirect=True)
def test_learn_writes_a_file_for_each(call, rovers, tmp_path, monkeypatch):
    whole, parts = rovers
    monkeypatch.chdir(tmp_path)
    made = []
    for verb in ("learn", "draft"):
        for path, output in zip((whole, *parts), ("both.yaml", "a.yaml", "b.yaml"), strict=True):
            assert call("mission", verb, path, "-o", output, "--force", "-q").code == 0
        made.append(
            [constants(tmp_path / name) for name in ("both.yaml", "both_sc_2.yaml", "a.yaml", "b.yaml")]
        )
    for first, second, alone_1, alone_2 in made:
        assert (first, second) == (alone_1, alone_2)
    again = call("mission", "draft", whole, "-o", "other.yaml")
    (tmp_path / "other.yaml").unlink()
    assert again.code == 0
    refused = call("mission", "draft", whole, "-o", "other.yaml")
    assert (refused.code, (tmp_path / "other.yaml").exists()) == (2, False)
    assert "other_sc_2.yaml" in refused.err[0]
    assert call("info", whole, "-c", "both.yaml").code == 0


def constants(path):
    return yaml.safe_load(path.read_text())


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
def test_any_number_of_processes_says_the_same(call, rovers, tmp_path, monkeypatch):
    whole, _ = rovers
    monkeypatch.setattr("edoras_tools.io.processes._LARGE", 1)
    monkeypatch.setattr(examination, "CHAPTER", 400)
    for name in ("FIRST", "_SECOND_WINDOW", "SLICE"):
        monkeypatch.setattr(capture_file, name, 16 << 10)
    found = []
    for jobs in ("1", "2"):
        folder = tmp_path / jobs
        words = ("-c", MISSION, "--jobs", jobs, "--force")
        assert call("record", whole, "-o", folder / "a.mcap", *words, "-q").code == 0
        assert call("export", whole, "-o", folder / "tables/", "--format", "csv", *words, "-q").code == 0
        files = {item.relative_to(folder): item.read_bytes() for item in folder.rglob("*") if item.is_file()}
        reports = [json_of(call, verb, whole, "--jobs", jobs) for verb in ("info", "doctor")]
        found.append((files, *reports))
    assert found[0] == found[1]
    assert any("sc_2" in str(name) for name in found[0][0])
