"""Checks of recordings without datagrams: what they show is judged, and nothing else passes."""

from __future__ import annotations

import pytest
from others import write_bag, write_studio
from rosbags.rosbag2 import StoragePlugin

from edoras_tools.addons.runs.check import NOT_OBSERVABLE, check
from edoras_tools.addons.runs.draft import Draft
from edoras_tools.addons.runs.expectations import load_expectations
from edoras_tools.addons.runs.run import Run
from edoras_tools.errors import ConfigError
from edoras_tools.pipelines.messages import open_inputs
from edoras_tools.pipelines.workbench import Settings


def checked(text, folder, *paths):
    (folder / "e.yaml").write_text(f"schema: 1\n{text}")
    source, bench = open_inputs(paths, Settings())
    report = check(source, bench, load_expectations(folder / "e.yaml"))
    return {(item.about, item.name): (item.passed, item.found) for item in report.results}


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp("bag") / "bag")


def test_a_draft_passes_on_its_own_recording_and_on_the_same_by_another_writer(bag, tmp_path):
    source, bench = open_inputs([bag], Settings())
    made = Draft([Run.read(source, bench)])
    assert not any(word in made.text for word in ("lost", "latency", "findings", "verdicts", "events"))
    assert "not observable in it" in made.notes[-1]
    assert made.text.count("count: at least 1") == 5
    again = made.text.replace("schema: 1\n", "")
    for path in (bag, write_bag(tmp_path / "bag", StoragePlugin.SQLITE3)):
        found = checked(again, tmp_path, path)
        assert len(found) > 10
        assert all(passed for passed, _ in found.values())
    halved = checked(again, tmp_path, write_bag(tmp_path / "half", count=20))
    assert halved["/scan", "count: at least 1"] == (True, "10 messages")
    late = write_bag(tmp_path / "late", begin=1_790_000_100_000_000_000)
    doubled = checked(again, tmp_path, bag, late)
    assert [name for (about, name), (passed, _) in doubled.items() if about == "/cmd_vel" and not passed] == [
        "rate: 46.9..53.1 to the end",
        "silence: at most 0.921s",
    ]


FIRST = "of 100 messages; the first is message"
TOPIC = "topics: {/cmd_vel: {%s}}"


@pytest.mark.each(3)
@pytest.mark.parametrize(
    ("text", "passed", "found"),
    [
        (TOPIC % "rate: 49..51", True, "50 Hz"),
        (TOPIC % "rate: 51..99", False, "50 Hz"),
        (TOPIC % "count: 100", True, "100 messages"),
        (TOPIC % "count: 99", False, "100 messages"),
        (TOPIC % "size: 52", True, "52 bytes"),
        (TOPIC % "size: 53", False, "52 bytes"),
        (TOPIC % "silence: at most 21ms", True, "20.0 ms"),
        (TOPIC % "silence: at most 19ms", False, "20.0 ms"),
        (TOPIC % "fields: [always: linear.x < 10]", True, "100 of 100 messages"),
        (TOPIC % "fields: [never: linear.x >= 9]", False, f"10 {FIRST} 186 at 1.800 s"),
        (TOPIC % "fields: [at least once: linear.x == 5]", True, f"1 {FIRST} 104 at 1.000 s"),
        (TOPIC % "lost: 0", False, NOT_OBSERVABLE),
        (TOPIC % "lost: at most 100%", False, NOT_OBSERVABLE),
        (TOPIC % "unaccounted: 0", False, NOT_OBSERVABLE),
        (TOPIC % "superseded: 0", False, NOT_OBSERVABLE),
        (TOPIC % "latency: at most 100s", False, NOT_OBSERVABLE),
        ("findings: []", False, NOT_OBSERVABLE),
        ("verdicts: []", False, NOT_OBSERVABLE),
        ("lost: 0", False, NOT_OBSERVABLE),
        ("duration: at least 1s", True, "2.0 s"),
        ("duration: at least 2s", False, "2.0 s"),
        ("events: {never: [event.event_id == 3]}", False, NOT_OBSERVABLE),
    ],
)  # fmt: skip
def test_each_expectation(text, passed, found, bag, tmp_path):
    (result,) = checked(text, tmp_path, bag).values()
    assert result == (passed, found)


def test_a_topic_that_is_not_there_is_a_mistake(bag, tmp_path):
    with pytest.raises(
        ConfigError, match="no topic of the recording matches '/cmd_vle'; did you mean /cmd_vel"
    ):
        checked("topics: {/cmd_vle: {count: 1}}", tmp_path, bag)
    with pytest.raises(ConfigError, match="linaer"):
        checked(TOPIC % "fields: [always: linaer.x > 1]", tmp_path, bag)


def test_what_cannot_be_read_is_counted_and_told(tmp_path):
    path = write_studio(tmp_path / "x.mcap")
    found = checked("topics: {/proto: {count: 20, size: 2}, /status: {rate: 9..11}}", tmp_path, path)
    assert all(passed for passed, _ in found.values())
    source, bench = open_inputs([path], Settings())
    report = check(source, bench, load_expectations(tmp_path / "e.yaml"))
    assert "/proto: 20 messages: protobuf, not cdr: only counted and copied" in report.findings.warnings


def test_a_recording_that_is_cut_off_does_not_pass(tmp_path):
    whole = write_studio(tmp_path / "whole.mcap", chunk_size=500).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    found = checked("topics: {/cmd_vel: {size: 52}}", tmp_path, tmp_path / "cut.mcap")
    passed, why = found["capture", "input: read to its end"]
    assert not passed
    assert "is cut off" in why
