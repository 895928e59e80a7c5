"""The timeline of states, judged by the flight consoles of real captures and by any order of changes."""

from __future__ import annotations

import re
from functools import cache
from itertools import pairwise

import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from places import ROOT

from edoras_tools.cfs.profile import SimProfile
from edoras_tools.diagnosis.case import Capture, Case
from edoras_tools.diagnosis.evidence.table import Recorder
from edoras_tools.diagnosis.evidence.timeline.table import (
    NEVER,
    Change,
    StateOwner,
    Timeline,
    Way,
    reason_text,
)
from edoras_tools.io.formats.open import open_file
from edoras_tools.links.bare import CI, TO
from edoras_tools.links.sbn import SBN
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.units import SECOND

CAPTURES = ROOT / "tests/captures"
NEAR_NS = SECOND // 5
"""The console's time and the capture's are of one clock; a line may be printed a little later."""


def place(name):
    return next(path for path in (CAPTURES, CAPTURES / "season3") if (path / f"{name}.pcap.zst").exists())


@cache
def case(name):
    bench = Settings().workbench()
    recorder = Recorder(bench.columns.context)
    source = open_file(place(name) / f"{name}.pcap.zst")
    for batch in source.batches():
        recorder.add(batch, bench.columns.decode(batch))
    return Case(recorder, SimProfile(), Capture())


def console(name):
    """Yield when a flight console said what, ns and text."""
    with zstandard.open(place(name) / f"{name}.cfs.log.zst", "rt", errors="replace") as file:
        lines = file.read().splitlines()
    for line in lines:
        when, _, text = line.partition(" ")
        yield int(float(when) * SECOND), text


def changes_of(timeline):
    """Return all changes, by the earliest time of each."""
    found = (item for system, subject in timeline.subjects for item in timeline.of(subject, system))
    return sorted(found, key=lambda item: (item.not_before_ns, item.not_after_ns))


def changes(name, kind):
    """Return the changes of a kind: earliest time in s, whose, state, value; steps of clocks in s."""
    found = case(name)
    return [
        (
            round((item.not_before_ns - found.start_ns) / SECOND, 1),
            item.subject.name or (item.subject.msg_id if item.subject.msg_id >= 0 else ""),
            item.state,
            round(item.value / SECOND) if kind == "clock" else item.value,
        )
        for item in changes_of(found.timeline)
        if item.subject.kind == kind
    ]


@pytest.mark.parametrize(
    ("name", "kind", "expected"),
    [
        (
            "p4_apps_stopped",
            "app",
            [
                (24.2, "TO_LAB_APP", "stopped", None),
                (33.6, "TO_LAB_APP", "running", None),
                (45.4, "SBN", "stopped", None),
                (55.2, "SBN", "running", None),
            ],
        ),
        (
            "n5_app_restarts",
            "app",
            [
                (14.6, "CI_LAB_APP", "restarting", None),
                (19.9, "CI_LAB_APP", "running", None),
                (26.7, "TO_LAB_APP", "restarting", None),
                (26.7, "TO_LAB_APP", "running", None),
                (45.6, "EDORAS_APP", "stopped", None),
                (59.2, "EDORAS_APP", "running", None),
            ],
        ),
        (
            "q12_to_limits_changed",
            "entry",
            [
                (19.8, 0x827, "unsubscribed", None),
                (21.0, 0x827, "subscribed", 1),
                (37.2, 0x827, "unsubscribed", None),
                (38.4, 0x827, "subscribed", 20),
                (50.6, 0x827, "unsubscribed", None),
                (51.8, 0x827, "subscribed", 2),
            ],
        ),
        (
            "n8_time_jumps",
            "clock",
            [
                (14.6, "", "set", 3600),
                (26.4, "", "set", -7200),
                (38.2, "", "set", -1038),
            ],
        ),
        ("n3_cfs_restart", "cfs", [(19.2, "", "down", None), (19.2, "", "running", None)]),
        (
            "q04b_bridge_restarts_subscribes_one",
            "peer",
            [
                (0.0, "66:3", "disconnected", None),
                (6.7, "66:3", "connected", None),
                (29.7, "66:3", "silent", None),
                (33.9, "66:3", "connected", None),
                (45.8, "66:3", "silent", None),
                (56.8, "66:3", "timed_out", None),
                (62.1, "66:3", "connected", None),
            ],
        ),
        ("a_rover", "app", []),
        ("hostile_times", "app", []),
    ],
)
def test_states_of_real_captures(name, kind, expected):
    assert changes(name, kind) == expected


@pytest.mark.parametrize(
    "name",
    ["n5_app_restarts", "p4_apps_stopped", "q21_app_restart_while_overloaded"],
)
def test_what_the_console_says_lies_in_the_intervals(name):
    """Of what an event in the capture confirms; the event itself may be late, or lost."""
    patterns = {
        r"Restart Application (?P<app>\S+) Completed": "running",
        r"Started (?P<app>\S+) from": "running",
        r"Stop Application (?P<app>\S+) (Completed|Failed: CleanUpApp)": "stopped",
    }
    timeline, judged = case(name).timeline, 0
    for when, text in console(name):
        for pattern, state in patterns.items():
            read = re.search(r"CFE_ES \d+: .*" + pattern, text)
            if not read or when < case(name).start_ns:
                continue
            subject = StateOwner("app", read["app"])
            spans = [item for item in timeline.spans(subject, state) if "event" in item.change.witness]
            near = [item for item in spans if item.start_lo - NEAR_NS <= when <= item.start_hi + NEAR_NS]
            if any(item.start_lo - 10 * SECOND < when < item.start_hi + 10 * SECOND for item in spans):
                assert near, text
                judged += 1
    assert judged


def test_why_messages_do_not_get_through():
    def reasons(name, way, start_s, end_s):
        found = case(name)
        start_ns, end_ns = (found.start_ns + int(at * SECOND) for at in (start_s, end_s))
        return [reason_text(span, found.at) for span in found.timeline.blocking(way, start_ns, end_ns)]

    name = "p4_apps_stopped"
    assert reasons(name, Way(0x827, TO, peer="66:3"), 46, 54) == []
    assert reasons(name, Way(0x1829, SBN, to_cfs=True), 46, 54)[0].startswith(
        "SBN was stopped from 45.4 s to 55."
    )
    assert "STOP_APP SBN" in reasons(name, Way(0x1829, SBN, to_cfs=True), 46, 54)[0]
    assert any("TO_LAB_APP was stopped from 24.2 s" in line for line in reasons(name, Way(0x828, TO), 26, 33))
    assert reasons(name, Way(0x828, TO), 38, 44) == []
    name = "q04b_bridge_restarts_subscribes_one"
    assert reasons(name, Way(0x82A, SBN, peer="66:3"), 64, 80) == []
    (text,) = reasons(name, Way(0x82B, SBN, peer="66:3"), 64, 80)
    assert text.startswith("0x082b for SBN peer 66:3 was not subscribed from 62.1 s on")
    name = "n1_to_remove_all"
    (text,) = reasons(name, Way(0x880, TO), 35, 45)
    assert text.endswith("on: REMOVE_ALL")
    assert reasons(name, Way(0x803, TO), 36, 45) == []
    assert len(reasons(name, Way(0x803, TO), 20, 30)) == 1
    (text,) = reasons("n3_cfs_restart", Way(0x1827, CI), 25, 30)
    assert text.startswith("cFS was down from 19.2 s to 42.0 s")


TIMES = st.integers(0, 60)
CHANGES = st.builds(
    lambda system, name, state, low, width, value, sure: Change(
        system, StateOwner("app", name), state, low, low + width, f"{state} at {low}", (low,), value, sure
    ),
    st.integers(0, 1),
    st.sampled_from(["SBN", "TO_LAB_APP"]),
    st.sampled_from(["running", "stopped", "restarting"]),
    TIMES,
    st.integers(0, 20),
    st.sampled_from([None, 1, 2]),
    st.booleans(),
)


def test_each_step_of_a_clock_is_one_jump_with_its_command(lab):
    """Set ahead, back and to 0: one cFS all the time, no silence, three jumps."""
    found = lab.read(place("n8_time_jumps") / "n8_time_jumps.pcap.zst", lab.mission("rover_ground"))
    jumps = [item for item in found.verdicts if item.rule == "clock_jump"]
    for item, step, command in zip(
        jumps,
        ("ahead by 3600.0 s", "back by 7200.0 s", "back by 1038.0 s"),
        ("14.6 s: ADD_ADJUST 3600 s", "26.4 s: SUB_ADJUST 7200 s", "38.2 s: SET_MET 0 s"),
        strict=True,
    ):
        assert step in item.reason
        assert item.evidence[-1] == f"sent at {command}"
    assert not [item for item in found.verdicts if item.rule == "topic_silent"]
    assert (found.lost, found.unaccounted) == (0, 0)
    assert len(set(case("n8_time_jumps").instances.systems)) == 1


@given(st.lists(CHANGES, max_size=12))
def test_any_changes_are_one_state_at_a_time(items):
    timeline = Timeline(items)
    for system, subject in timeline.subjects:
        own = timeline.of(subject, system)
        assert own
        assert all(item.witness and item.not_before_ns <= item.not_after_ns for item in own)
        for one, other in pairwise(own):
            assert one.not_before_ns <= other.not_before_ns
            assert one.not_after_ns <= other.not_after_ns
            assert one.same != other.same
        states = {item.state for item in own}
        spans = sorted(
            (span for state in states for span in timeline.spans(subject, state, system)),
            key=lambda item: item[:4],
        )
        assert len(spans) == len(own)
        for time in range(-1, 90, 3):
            surely = [span.change for span in spans if span.start_hi <= time <= span.end_lo]
            assert not surely or min(item.not_after_ns for item in surely) <= time
        assert spans[-1].end_hi == NEVER or any(span.end is None for span in spans)
