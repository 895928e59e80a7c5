from __future__ import annotations

import re
import threading
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import waiting
from places import SAMPLES

from edoras_tools.addons.foxglove.server import link_state
from edoras_tools.addons.foxglove.server.link_state import LinkState, LiveDiagnosis
from edoras_tools.decode import Context
from edoras_tools.diagnosis.balance import WaySum
from edoras_tools.diagnosis.examination import Examination
from edoras_tools.diagnosis.ledger import Row
from edoras_tools.diagnosis.missing import Missing
from edoras_tools.io.topics.streams import Streams
from edoras_tools.mission import Mission
from edoras_tools.model import NO_MSG_ID, SourceStatistics
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


LOST = 92


class Slow(Examination):
    """Judges only when it is let."""

    may = threading.Event()
    judging = threading.Event()

    def diagnose(self, capture=None):
        Slow.judging.set()
        assert Slow.may.wait(waiting.PATIENCE_S)
        return super().diagnose(capture)


@pytest.fixture
def diagnosis(types):
    opened = []

    def start(read, kind=Examination):
        opened.append(LiveDiagnosis(partial(kind, Context(read.mission, types))))
        return opened[-1]

    Slow.may.clear()
    Slow.judging.clear()
    yield start
    Slow.may.set()
    for item in opened:
        item.close()


def judged(item, datagrams):
    """Its state, once it has judged so many datagrams."""
    waiting.until(lambda: (item.ask() or {}).get("datagrams") == datagrams)
    return item.ask()


def doctor(read, types):
    examination = Examination(Context(read.mission, types))
    for batch, columns in read.pairs:
        examination.add(batch, columns)
    return examination.diagnose()


def test_its_figures_are_those_of_the_doctor(diagnosis, capture, types):
    rover = capture("a_rover", "rover_ground")
    item = diagnosis(rover)
    assert item.ask() is None
    for batch, columns in rover.pairs:
        item.add(batch, columns)
    whole = doctor(rover, types)
    state = judged(item, whole.datagrams)
    assert state["lost"] == whole.lost == LOST
    assert state["messages_lost"] == whole.messages_lost
    assert state["headline"] == "About 1 in 7 commands never arrived: 92 of 600 /cmd_vel were lost."
    (problem,) = state["problems"]
    assert (problem["lost"], problem["severity"], problem["rules"]) == (LOST, "error", ["app_pipe_limit"])
    assert problem["messages"]
    assert {lost["msg_id"] for lost in problem["messages"]} == {"0x1827"}
    flow = state["flows"][0]
    assert (flow["names"], flow["ends"]) == (["/cmd_vel"], ("ground", ""))
    assert [(hop["hop"], hop["in"], hop["lost"], hop["out"]) for hop in flow["hops"]] == [
        ("CI", 600, 0, 600),
        ("software bus", 600, 92, 508),
        ("application", 508, 0, 508),
    ]
    assert sum(hop["lost"] for each in state["flows"] for hop in each["hops"]) == whole.lost
    (route,) = [each for each in state["routes"] if each["msg_id"] == "0x1827"]
    assert (route["in"], route["out"], route["lost"]) == (600, 508, LOST)
    assert route["spacecraft"] == 1


def test_rates_are_those_since_the_judgement_before(diagnosis, capture):
    item = diagnosis(capture("a_rover", "rover_ground"))
    rates = []
    for seconds, outs in ((10, (50, 40)), (14, (70, 42)), (14, (80, 50)), (15, (80, 60, 1))):
        hops = [{"hop": name, "out": out} for name, out in zip(("CI", "bus", "bus"), outs, strict=False)]
        item._add_rates(
            {"until_ns": seconds * 10**9, "flows": [{"spacecraft": 1, "link": "ci", "hops": hops}]}
        )
        rates.append([hop["rate_hz"] for hop in hops])
    assert rates == [[None, None], [5, 0.5], [None, None], [None, None, None]]
    hops = [{"hop": "CI", "out": 81}, {"hop": "bus", "out": 64}, {"hop": "bus", "out": 1}]
    item._add_rates({"until_ns": 17 * 10**9, "flows": [{"spacecraft": 1, "link": "ci", "hops": hops}]})
    assert [hop["rate_hz"] for hop in hops] == [0.5, 2, 0]


def test_who_writes_does_not_wait_for_it(diagnosis, capture, types):
    rover = capture("a_rover", "rover_ground")
    item = diagnosis(rover, Slow)
    item.ask()
    assert Slow.judging.wait(waiting.PATIENCE_S)
    for batch, columns in rover.pairs:
        item.add(batch, columns)  # returns, although nothing is judged yet
    assert item._queue_bytes >= sum(map(len, rover.batches))
    Slow.may.set()
    assert judged(item, doctor(rover, types).datagrams)["lost"] == LOST
    assert item._queue_bytes == 0


def test_what_is_too_much_to_wait_is_judged_from_there_on(diagnosis, capture, monkeypatch):
    rover = capture("a_rover", "rover_ground")
    monkeypatch.setattr(link_state, "_MOST_WAITING", 1)
    item = diagnosis(rover, Slow)
    item.ask()
    assert Slow.judging.wait(waiting.PATIENCE_S)
    for batch, columns in rover.pairs:
        item.add(batch, columns)
    Slow.may.set()
    waiting.until(item.ask)
    last, _ = rover.pairs[-1]
    assert item.ask()["since_ns"] == int(last.time_ns[0])


def test_it_judges_only_while_somebody_asks(diagnosis, capture, monkeypatch):
    monkeypatch.setattr(link_state, "_ASKED_S", 0.0)
    monkeypatch.setattr(link_state, "_EVERY_S", 0.01)
    monkeypatch.setattr(link_state, "_PAUSE", 0)
    rover = capture("a_rover", "rover_ground")
    item = diagnosis(rover)
    item.ask()
    waiting.until(lambda: item._thread is None)
    monkeypatch.setattr(link_state, "_ASKED_S", 60.0)
    for batch, columns in rover.pairs:
        item.add(batch, columns)
    waiting.until(item.ask)
    item.close()
    assert item.ask()["lost"] == LOST, "what it judged stays"
    assert not item._thread.is_alive()


@pytest.mark.parametrize(("quiet_s", "judges"), [(3600.0, False), (0.0, True)])
def test_it_pauses_less_where_nothing_comes_any_more(quiet_s, judges, diagnosis, capture, monkeypatch):
    monkeypatch.setattr(link_state, "_EVERY_S", 0.01)
    monkeypatch.setattr(link_state, "_PAUSE", 1e9)
    monkeypatch.setattr(link_state, "_QUIET_PAUSE", 0)
    monkeypatch.setattr(link_state, "_QUIET_S", quiet_s)
    rover = capture("a_rover", "rover_ground")
    batch, columns = rover.pairs[0]
    item, before = diagnosis(rover), 0
    for number, rows in enumerate(np.array_split(np.arange(len(batch)), 3)):
        item.add(batch.take(rows), columns.take(rows))
        if number == 2 and not judges:
            item.close()
            assert item.ask()["datagrams"] == before
        else:
            waiting.until(lambda least=before: (item.ask() or {"datagrams": 0})["datagrams"] > least)
        before = item.ask()["datagrams"]


def test_a_loss_that_names_no_msg_id_lists_the_messages_of_its_time():
    verdict = SimpleNamespace(link=None, msg_id=None, lost=1, start_ns=10, end_ns=20, evidence=())
    problem = SimpleNamespace(verdicts=[verdict], lost=1, spacecraft=None, promise="", as_json=dict)
    entries = [
        Missing(link, NO_MSG_ID, None, 1, at, at + 5, None, None, None, "lost on the software bus")
        for link, at in (("", 0), ("", 12), ("to", 12), ("", 30))
    ]
    found = link_state._problem(problem, SimpleNamespace(parts={}, missing=entries))
    assert [(item["link"], item["time_ns"]) for item in found["messages"]] == [("", 12)]


def test_what_several_links_share_is_a_flow_without_ends():
    shared = Row(
        route=-1, link="", msg_id=None, instance="1", hop="application", came=9, out=5, lost={"?": 4}
    )
    (flow,) = link_state._flows([WaySum((shared,))], {})
    assert (flow["link"], flow["ends"], flow["names"]) == ("", ("", ""), [])
    assert (flow["hops"][0]["in"], flow["hops"][0]["lost"]) == (9, 4)


def test_runs_of_one_cfs_are_one_route_and_spacecraft_are_two():
    ways = []
    for run, number, came, lost in (("1", None, 10, 3), ("2", None, 20, 4), ("1", 2, 30, 5)):
        where = {"route": 0, "link": "to", "msg_id": 0x827, "instance": run, "hop": "TO"}
        figures = {"came": came, "out": came - lost, "lost": {"limit": lost}}
        ways.append(WaySum((Row(**where, **figures, spacecraft=number),)))
    rows = [(row["spacecraft"], row["in"], row["lost"], row["out"]) for row in link_state._routes(ways)]
    assert rows == [(1, 30, 7, 23), (2, 30, 5, 25)]
