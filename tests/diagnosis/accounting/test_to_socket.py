"""Telemetry Output's socket: what it took and did not send until it was enabled, by its sequence counts."""

from __future__ import annotations

import numpy as np
import pytest
from places import ROOT

from edoras_tools.cfs import telemetry_output
from edoras_tools.diagnosis.accounting.closed import silences
from edoras_tools.wire import cfe
from tests.support.balance import wrong_rows

FROM_S, UNTIL_S, ALL_S = 15.0, 25.0, 40
TO_PORT = 1235


def silenced(lab, enabled_s):
    """Return a rover whose telemetry is away for a time, with enabling commands; and how much is away."""
    sent, _ = lab.simulate("rover", seconds=ALL_S)
    start_ns, end_ns = (lab.start_ns + int(at * 1e9) for at in (FROM_S, UNTIL_S))
    kept = [
        item for item in sent if not (item.destination.port == TO_PORT and start_ns < item.time_ns < end_ns)
    ]
    packet = cfe.emit_command(
        telemetry_output.COMMAND_MSG_ID,
        telemetry_output.ENABLE,
        b"127.0.0.1".ljust(16, b"\0"),
        sequence_flags=0,
    )
    enables = [lab.at(at, lab.ground, lab.ci, packet) for at in enabled_s]
    return lab.merged(kept, *enables), len(sent) - len(kept)


def at_socket(found):
    return [row for row in found.balance if row.hop == telemetry_output.SOCKET]


@pytest.mark.parametrize("failed", [True, False])
def test_what_it_took_and_did_not_send_has_a_hop(lab, failed):
    kept, away = silenced(lab, [UNTIL_S - 0.5])
    words = "L305 TO sendto error -1. Tlm output suppressed"
    said = [lab.event(UNTIL_S + 0.1, telemetry_output.NAME, 7, words)] if failed else []
    found = lab.examine(lab.merged(kept, *said), lab.mission("rover_ground"))
    assert wrong_rows(found.balance) == []
    rows = at_socket(found)
    assert sum(row.came - row.out for row in rows) == away
    assert sum(row.lost.get("to_socket", 0) for row in rows) == (away if failed else 0)
    assert sum(row.not_captured for row in rows) == (0 if failed else away)
    assert found.lost == (away if failed else 0)
    (verdict,) = [item for item in found.verdicts if item.rule == "to_stopped"]
    assert verdict.lost == (away if failed else None)
    assert "lost_after_cfs" not in {item.rule for item in found.verdicts}


def test_of_two_silences_one_is_its_sockets(lab):
    sent, _ = lab.simulate("rover", seconds=ALL_S)
    spans = [
        [lab.start_ns + int(at * 1e9) for at in span] for span in ((8.0, 15.0), (FROM_S + 7, UNTIL_S + 7))
    ]
    away = [
        [item for item in sent if item.destination.port == TO_PORT and start < item.time_ns < end]
        for start, end in spans
    ]
    kept = [item for item in sent if not any(item in own for own in away)]
    packet = cfe.emit_command(
        telemetry_output.COMMAND_MSG_ID,
        telemetry_output.ENABLE,
        b"127.0.0.1".ljust(16, b"\0"),
        sequence_flags=0,
    )
    enables = [lab.at(at, lab.ground, lab.ci, packet) for at in (14.5, 31.5)]
    words = "L305 TO sendto error -1. Tlm output suppressed"
    event = lab.event(32.1, telemetry_output.NAME, 7, words)
    found = lab.examine(lab.merged(kept, *enables, event), lab.mission("rover_ground"))
    assert sum(row.lost.get("to_socket", 0) for row in at_socket(found)) == len(away[1])
    assert sum(row.not_captured for row in at_socket(found)) == len(away[0])


def test_a_ground_station_that_enables_it_all_the_time_tells_nothing(lab):
    kept, away = silenced(lab, np.arange(2.0, ALL_S, 1.0))
    found = lab.examine(kept, lab.mission("rover_ground"))
    assert at_socket(found) == []
    # The commands are of no simulated CI: they are lost before it.
    assert sum(row.lost.get("after", 0) for row in found.balance) == away


@pytest.mark.parametrize(
    ("sent", "enabled", "expected"),
    [
        ([0, 1, 2, 3], [2], []),
        ([0, 1, 9, 10], [8], [(1, 9)]),
        ([0, 1, 9, 10], [2, 8], []),
        ([0, 1, 9, 10], [11], []),
        ([], [3], []),
    ],
)
def test_when_it_is_silent_until_it_is_enabled(sent, enabled, expected):
    second = 10**9
    times = np.array(sent, np.int64) * second
    found = silences(times, [at * second for at in enabled], second // 2)
    assert found == [(start * second, end * second) for start, end in expected]


def test_one_that_restarted_is_told_so_and_no_more(lab):
    found = lab.read(ROOT / "tests/captures/n5_app_restarts.pcap.zst")
    assert at_socket(found) == []
    assert [item.reason[-30:] for item in found.verdicts if item.rule == "to_stopped"] == [
        "and forgot that it was enabled"
    ]
