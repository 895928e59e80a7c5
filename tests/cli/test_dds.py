"""Topics of DDS straight from a capture, by every command that takes a topic or a field."""

import csv
import io

import pytest
from effort import every
from places import MISSIONS
from rtps import CAPTURES, TRUTH

IDS = [path.name.partition(".")[0] for path in CAPTURES]
SENDERS = [path for path in CAPTURES if "sender" in path.name]
MISSION = MISSIONS / "rover_ground.yaml"


def heard(path, topic):
    """Return how many samples of a topic are in a capture."""
    kind, _, end = path.name.partition(".")[0].partition("_")
    best_effort = topic == "/chatter" and end == "receiver"
    return len(TRUTH[kind]["heard"][topic]) if best_effort else TRUTH[kind]["written"][topic]


def numbers(path, topic, *options, call):
    """Return the sequence numbers of the samples that a selection lists."""
    found = call("sniff", path, "--json", *options)
    assert found.code == 0
    layers = [item for line in found.lines() for item in line["layers"].items()]
    return {
        values["writer_sn"]
        for name, values in layers
        if name.partition("#")[0] == "rtps_data" and values.get("topic") == topic
    }


@pytest.mark.each(2)
@pytest.mark.quick("cyclone_sender")
@pytest.mark.parametrize("path", CAPTURES, ids=IDS)
def test_a_topic_is_selected_that_only_the_capture_names(path, call):
    for topic in every(2, ("/cmd_vel", "/chatter")):
        count = heard(path, topic)
        assert len(numbers(path, topic, "--topic", topic, call=call)) == count
        found = call("info", path, "--topic", topic, "--json").json()
        assert [(item["topic"], item["count"]) for item in found["samples"]] == [(topic, count)]
        table = call("export", path, "--topic", topic, "-o", "-").out
        rows = list(csv.DictReader(io.StringIO(table)))
        assert len(rows) == len({row["sequence"] for row in rows}) == count


def test_fields_of_a_type_that_only_the_capture_names(call):
    path = SENDERS[0]
    found = numbers(path, "/cmd_vel", "--where", "linear.x >= 5", call=call)
    assert found == set(range(51, 101))  # of sample n it is (n - 1) / 10
    told = call("sniff", path, "--where", "linear.q > 5").err[0]
    assert "'linear.q' is not a field; did you mean linear.z, linear.y or linear.x?" in told
    plotted = call("plot", path, "/cmd_vel.linear.x", "--json").json()
    (line,) = plotted["panels"][0]["lines"]
    assert (line["read"], line["least"], line["greatest"]) == (100, 0.0, 9.9)


def test_a_topic_that_is_nowhere(call):
    told = call("sniff", SENDERS[0], "--topic", "/cmd_vle").err[0]
    assert "no configured topic matches '/cmd_vle'; did you mean /cmd_vel?" in told
    told = call("sniff", SENDERS[0], "--topic", "/zzz").err[0]
    assert "/chatter" in told
    assert "/cmd_vel" in told


def test_a_topic_that_the_mission_has_too_is_named_as_in_a_recording(call):
    path = SENDERS[0]
    assert not call("sniff", path, "-c", MISSION, "--topic", "/cmd_vel", "--json").out
    assert len(numbers(path, "/cmd_vel", "-c", MISSION, "--topic", "/dds/cmd_vel", call=call)) == 100


def test_a_table_for_each_topic(tmp_path, call):
    call("export", SENDERS[0], "-o", tmp_path / "all/", "--format", "csv")
    assert {path.name for path in tmp_path.glob("all/*")} > {"cmd_vel.csv", "chatter.csv"}
    call("export", SENDERS[0], "--fields", "linear.x", "-o", tmp_path / "some/", "--format", "csv")
    assert [path.name for path in tmp_path.glob("some/*")] == ["cmd_vel.csv"]
    told = call("export", SENDERS[0], "-o", tmp_path / "one.csv").err[0]
    assert "several topics" in told


def test_a_pattern_and_a_plot_of_all_find_them(tmp_path, call):
    call("export", SENDERS[0], "--topic", "/c*", "-o", tmp_path / "some/", "--format", "csv")
    assert {path.name for path in tmp_path.glob("some/*")} == {"cmd_vel.csv", "chatter.csv"}
    panels = call("plot", SENDERS[0], "--json").json()["panels"]
    read = {line["label"]: line["read"] for panel in panels for line in panel["lines"]}
    assert read["/cmd_vel"] == read["/chatter"] == 100
    mixed = tmp_path / "mixed/"
    call("export", SENDERS[0], "-c", MISSION, "--topic", "*cmd_vel", "-o", mixed, "--format", "csv")
    assert [path.name for path in mixed.iterdir()] == ["dds.cmd_vel.csv"]


def test_a_part_has_names_that_were_announced_before_it(call):
    whole, part = (
        call("export", SENDERS[0], "--topic", "/chatter", *some, "-o", "-").out.splitlines()
        for some in ((), ("--start", "8"))
    )
    assert whole[-len(part) + 1 :] == part[1:]
    assert len(whole) > len(part) > 1


@pytest.mark.parametrize("path", SENDERS, ids=lambda path: path.name)
def test_a_recording_of_one_topic_names_it(path, tmp_path, call):
    call("record", path, "--topic", "/cmd_vel", "-o", tmp_path / "x.mcap")
    (found,) = call("info", tmp_path / "x.mcap", "--json").json()["samples"]
    assert (found["topic"], found["count"]) == ("/cmd_vel", 100)


def test_the_doctor_shows_the_losses_of_a_topic(call):
    path = next(path for path in CAPTURES if path.name.startswith("cyclone_receiver"))
    for options in (("--topic", "/chatter"), ("--where", 'rtps.topic == "/chatter"')):
        found = call("doctor", path, *options, "--json").json()
        (row,) = found["balance"]
        assert (row["topic"], row["lost"]) == ("/chatter", 11)
        assert [item["rule"] for item in found["verdicts"]] == ["dds_lost"]
        (lost,) = call("doctor", path, *options, "--list-lost", "json").json()["missing"]
        assert (lost["topic"], lost["count"], lost["one_of"]) == ("/chatter", 11, 100)
    assert call("doctor", path, "--topic", "/cmd_vel", "--list-lost", "json").json()["lost"] == 0
    (panel,) = call("plot", path, "loss:/chatter", "--json").json()["panels"]
    assert [line["read"] for line in panel["lines"]] == [11]


def test_a_check_is_drafted_and_finds_the_losses(tmp_path, call):
    good, bad = (path for end in ("sender", "receiver") for path in CAPTURES if f"cyclone_{end}" in path.name)
    draft = tmp_path / "expect.yaml"
    draft.write_text(call("check", good, "--init").out)
    assert "/chatter:" in draft.read_text()
    assert call("check", good, draft, "--json").json()["passed"]
    results = call("check", bad, draft, "--json").json()["results"]
    wrong = {(item["about"], item["expectation"]): item["found"] for item in results if not item["passed"]}
    assert wrong["/chatter", "lost"] == "11 of 100 (11.00%)"
    assert not any(about == "/cmd_vel" for about, _ in wrong)
    draft.write_text("schema: 1\ntopics: {/cmd_vel: {fields: [{always: linear.x < 5}], size: at most 9}}\n")
    results = call("check", good, draft, "--json").json()["results"]
    told = [item["found"] for item in results if not item["passed"]]
    assert any("of 111 datagrams pass" in item for item in told)
    assert "the capture does not show it" in told


def test_samples_before_their_writer_was_announced(tmp_path, call):
    call("record", SENDERS[0], "--start", "6.34", "-o", tmp_path / "late.pcap")
    found = call("info", tmp_path / "late.pcap")
    assert any(
        "(and copies) of 3 writers that the capture does not announce: no topic" in line for line in found.err
    )
