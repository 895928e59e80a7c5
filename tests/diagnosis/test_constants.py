"""Constants that a capture shows: another cFS than the usual one is judged by its own."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from places import ROOT

from edoras_tools.cfs.profile import SimProfile
from edoras_tools.diagnosis.constants import find_round
from edoras_tools.units import MILLISECOND, SECOND

OTHER = {
    "to_wake_ns": 100 * MILLISECOND,
    "ci_wake_ns": 250 * MILLISECOND,
    "app_msg_limit": 2,
    "msg_max": 20,
}
SWAPPED = {0x803: ((28, 2), (30, 2)), 0x884: ((28, 4), (32, 4)), 0x808: ((36, 2), (38, 2), (40, 4), (44, 4))}


def big_endian(items):
    """Return telemetry as a cFS writes it that has the highest byte first: counters, and events."""
    found = []
    for item in items:
        data = bytearray(item.payload)
        if item.destination.port == 1235:
            for start, size in SWAPPED.get(int.from_bytes(data[:2], "big"), ()):
                data[start : start + size] = data[start : start + size][::-1]
        found.append(item._replace(payload=bytes(data)))
    return found


@pytest.mark.quick("True")
@pytest.mark.parametrize("big", [False, True])
def test_a_cfs_with_other_constants_is_judged_by_its_own(lab, big):
    sent, counters = lab.simulate(
        "rover", seconds=20, hz=5.0, limits=((0x827, 20),), generators=((5.0, 0x827, 300),), **OTHER
    )
    found = lab.examine(big_endian(sent) if big else sent)
    profile = found.case.profile
    assert profile.to_wake_ns == pytest.approx(OTHER["to_wake_ns"], rel=0.1)
    assert profile.to_limits[0x827] == pytest.approx(20, abs=2)
    assert profile.to_pipe_depth == pytest.approx(20, abs=2)
    assert found.lost + found.unaccounted <= counters.msg_limits + counters.pipe_overflows
    text = json.dumps(found.as_json())
    assert "every 100 ms" in text
    assert "500 ms" not in text
    assert "pipe of 50" not in text


@pytest.mark.quick("20.0-True")
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("hz", [12.0, 20.0])
def test_events_show_the_rounds_of_ci_and_the_limit_behind_it(lab, hz, big):
    """Nothing that comes out of the application is captured."""
    sent, counters = lab.simulate("rover", seconds=20, hz=hz, **OTHER)
    found = lab.examine(big_endian(sent) if big else sent)
    profile = found.case.profile
    assert profile.ci_wake_ns == pytest.approx(OTHER["ci_wake_ns"], rel=0.1)
    assert profile.app_msg_limit == OTHER["app_msg_limit"]
    assert 0 < found.lost + found.unaccounted <= counters.msg_limits + counters.pipe_overflows
    text = json.dumps(found.as_json())
    assert "it keeps 2 of one MsgId, and CI hands over a burst every 250 ms" in text
    assert "500 ms" not in text


def test_events_about_commands_that_are_not_captured_show_no_limit(lab):
    sent, counters = lab.simulate("rover", seconds=20, hz=12.0, **OTHER)
    found = lab.examine([item for item in sent if item.payload[:2] != b"\x18\x27"])
    assert found.case.profile.app_msg_limit == 4
    assert 0 < found.lost + found.unaccounted <= counters.msg_limits + counters.pipe_overflows


@pytest.mark.parametrize("hz", [9.0, 10.0, 30.0])
def test_events_at_multiples_of_the_usual_round_show_no_other(lab, hz):
    sent, _ = lab.simulate("rover", seconds=20, hz=hz)
    profile = lab.examine(sent).case.profile
    assert (profile.ci_wake_ns, profile.app_msg_limit) == (500 * MILLISECOND, 4)


def test_late_rounds_of_a_host_short_of_time_are_no_other_rounds(lab):
    """Events name five bursts, one of them in time after the one before."""
    sent, _ = lab.simulate("rover", seconds=20, hz=9.0)
    events = [item for item in sent if b"Msg Limit Err,MsgId 0x1827" in item.payload]
    rest, begin = [item for item in sent if item not in events], events[0].payload
    first = int.from_bytes(begin[6:10], "big") * 65536 + int.from_bytes(begin[10:12], "big")
    moved = []
    for item, seconds in zip(events, (0.0, 0.630, 1.257, 2.341, 2.841), strict=False):
        when = first + int(seconds * 65536)
        stamp = (when // 65536).to_bytes(4, "big") + (when % 65536).to_bytes(2, "big")
        moved.append(item._replace(payload=item.payload[:6] + stamp + item.payload[12:]))
    profile = lab.examine(lab.merged(rest, *moved)).case.profile
    assert (profile.ci_wake_ns, profile.app_msg_limit) == (500 * MILLISECOND, 4)


def test_counters_of_a_big_endian_cfs_are_read_in_its_order(lab):
    sent, counters = lab.simulate("rover", seconds=40, hz=20.0)
    small, large = lab.examine(sent), lab.examine(big_endian(sent))
    assert 256 < small.lost <= counters.msg_limits
    assert [item.as_json() for item in large.verdicts] == [item.as_json() for item in small.verdicts]
    assert [(row.lost, row.came, row.out) for row in large.balance] == [
        (row.lost, row.came, row.out) for row in small.balance
    ]


def test_a_constant_that_was_given_is_not_replaced(lab):
    sent, _ = lab.simulate("rover", seconds=20, to_wake_ns=OTHER["to_wake_ns"])
    given_ns = 300 * MILLISECOND
    found = lab.examine(sent, profile=SimProfile(to_wake_ns=given_ns))
    assert found.case.profile.to_wake_ns == given_ns
    assert lab.examine(sent).case.profile.to_wake_ns == pytest.approx(OTHER["to_wake_ns"], rel=0.1)


@pytest.mark.long("c4_cmd_rate")
@pytest.mark.parametrize("name", ["a_rover", "c4_cmd_rate", "season3/q17_two_bridges_same_topic"])
def test_what_nothing_shows_is_called_assumed(lab, name):
    found = lab.read(ROOT / f"tests/captures/{name}.pcap.zst")
    reasons = [item.reason for item in found.verdicts if item.rule == "app_pipe_limit"]
    assert reasons
    assert all(
        "hands over a burst every 500 ms: 8 a second get through (assumed)" in line for line in reasons
    )
    assert found.case.constants.rounds["to_wake_ns"] == pytest.approx(SECOND / 2, rel=0.05)
    assert found.case.profile == found.case.assumed


@given(
    st.integers(50, 900),
    st.lists(st.tuples(st.integers(1, 4), st.integers(1, 6)), min_size=40, max_size=120),
)
def test_a_round_is_learned_from_bursts_that_come_in_each_or_some(period_ms, bursts):
    times, now = [], 0
    for skipped, count in bursts:
        now += skipped if len(times) % 3 else 1
        times += [now * period_ms * MILLISECOND + at * MILLISECOND // 10 for at in range(count)]
    found = find_round(np.array(times, np.int64))
    shortest = int(np.diff(np.unique(np.array(times) // (period_ms * MILLISECOND))).min())
    if found is not None and shortest == 1:
        assert found == pytest.approx(period_ms * MILLISECOND, rel=0.1)


@given(st.lists(st.integers(0, 10**6), min_size=30, max_size=100, unique=True))
def test_times_without_a_round_show_none_or_one_of_their_own(places):
    times = np.sort(np.array(places, np.int64)) * MILLISECOND
    found = find_round(times)
    assert found is None or found <= int(np.diff(times).max())
