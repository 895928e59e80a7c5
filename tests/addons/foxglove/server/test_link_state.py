from __future__ import annotations

import re
from types import SimpleNamespace

import pytest
from places import SAMPLES

from edoras_tools.addons.foxglove.server.link_state import LinkState
from edoras_tools.io.topics.streams import Streams
from edoras_tools.mission import Mission
from edoras_tools.model import SourceStatistics
from edoras_tools.pipelines.clocks import open_aligned
from edoras_tools.pipelines.workbench import Settings

EVENTS, STATISTICS = 1, 3


def state_of(read, types, **options):
    """The state after all batches of a capture."""
    state = LinkState(read.mission, types, options.pop("statistics", None))
    streams = Streams(read.mission, types)
    for batch, columns in read.pairs:
        made = [item for item in streams.messages(batch, columns) if isinstance(item.channel_id, int)]
        (counts,) = [item for item in made if item.channel_id == STATISTICS]
        events = [item for item in made if item.channel_id == EVENTS]
        state.add(batch, columns, counts, {"": events}, options.get("statuses", {}))
    return state


def test_routes_are_counted_as_the_statistics_count_them(capture, types):
    rover = capture("a_rover", "rover_ground")
    sums = state_of(rover, types).summary()
    rows = {item["topic"] or item["name"]: item for item in sums["routes"]}
    assert rows["/cmd_vel"]["count"] == 600, "the last second too"
    assert rows["/telemetry_pose"]["rate_hz"] == 1
    assert rows["ES_HK"]["msg_id"] == "0x0800"
    assert rows["/telemetry_pose"]["largest"] > 100
    assert sums["datagrams"] == sum(item["count"] for item in sums["routes"]) == sum(map(len, rover.batches))
    assert sums["kernel_drops"] is None
    assert [item["topic"] for item in sums["routes"][:2]] == ["/cmd_vel", "/telemetry_pose"]


def test_events_are_the_latest_with_their_levels(capture, types):
    events = state_of(capture("a_rover", "rover_ground"), types).summary()["events"]
    assert sum(item["count"] for item in events) == 15
    assert len(events) == len({item["text"] for item in events}) == 2
    assert [item["time_ns"] for item in events] == sorted((item["time_ns"] for item in events), reverse=True)
    limit = next(item for item in events if item["level"] == 40)
    assert limit["text"] == "Msg Limit Err,MsgId 0x1827,pipe EDORAS_APP_PIPE,sender CI_LAB_APP"


def test_events_of_all_kinds_are_among_them(types):
    """Of a batch that holds events of cFE and entries of its reset log."""
    files = SAMPLES / "cfs_files"
    source, _ = open_aligned([files / "events.log", files / "resets.log"], Settings())
    decode = Settings().workbench().columns.decode
    read = SimpleNamespace(mission=Mission(), pairs=[(batch, decode(batch)) for batch in source.batches()])
    events = state_of(read, types).summary()["events"]
    assert any("POWER ON RESET" in item["text"] for item in events)
    assert {"CFE_ES", "TO_LAB"} <= {item["app"] for item in events}


def test_losses_and_findings_stand_at_their_route(capture, types):
    rovers = capture("f_sbn_disconnect", "two_rovers_ground", "two_rovers_flight")
    statuses = {"sbn: /robot_1/cmd_vel": {"level": 2, "message": "cut"}}
    sums = state_of(rovers, types, statuses=statuses, statistics=SourceStatistics(kernel_drops=3)).summary()
    row = next(item for item in sums["routes"] if item["topic"] == "/robot_1/cmd_vel")
    assert row["gaps"] == sums["gaps"] > 0
    assert (row["level"], row["message"]) == (2, "cut")
    assert sums["kernel_drops"] == 3


def test_what_is_silent_has_no_rate(capture, types, monkeypatch):
    state = state_of(capture("a_rover", "rover_ground"), types)
    assert state.summary()["rate_hz"] > 10
    ages = {item["topic"]: item["age_s"] for item in state.summary()["routes"]}
    assert 0 <= ages["/cmd_vel"] < 10
    state._heard -= 100
    silent = state.summary()
    assert all(item["age_s"] > 99 for item in silent["routes"])
    assert silent["rate_hz"] == 0
    assert silent["silent_s"] > 99
    assert LinkState(Mission(), types, None).summary()["silent_s"] is None


@pytest.mark.parametrize(("age_s", "silent_s"), [(0.7, 0.7), (-0.7, 0), (3, 0)])
def test_silence_begins_with_the_last_packet_that_gathered(capture, types, age_s, silent_s):
    rover = capture("a_rover", "rover_ground")
    batch, columns = rover.pairs[0]
    state = LinkState(rover.mission, types, None)
    state.clock, state.wall = lambda: 50.0, lambda: int(batch.time_ns[-1]) + int(age_s * 1e9)
    state.add(batch, columns, (), {}, {})
    assert state.summary()["silent_s"] == pytest.approx(silent_s)


def test_any_number_of_msg_ids_has_a_limit(capture, types, monkeypatch):
    monkeypatch.setattr("edoras_tools.addons.foxglove.server.link_state._MOST_ROUTES", 3)
    rover = capture("a_rover", "rover_ground")
    limited = state_of(rover, types).summary()
    monkeypatch.undo()
    whole = state_of(rover, types).summary()
    assert len(limited["routes"]) == 4
    assert limited["datagrams"] == whole["datagrams"]


def test_the_last_value_of_a_topic_is_shown(capture, types):
    values = {
        item["topic"]: item["value"]
        for item in state_of(capture("a_rover", "rover_ground"), types).summary()["routes"]
    }
    assert re.fullmatch(r"linear\.x=0\.\d+ angular\.z=-?0\.\d+", values["/cmd_vel"])
    assert values["/telemetry_pose"].startswith("pose.position.x=")
    assert values[None] is None, "housekeeping has no ROS type"
