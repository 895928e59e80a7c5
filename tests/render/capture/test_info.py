from __future__ import annotations

import io

import pytest
from rich.console import Console

from edoras_tools.render.capture.info import capture_summary, departures, findings


def shown(view, width=120):
    out = io.StringIO()
    Console(file=out, width=width, color_system=None, _environ={}).print(view)
    return out.getvalue()


@pytest.mark.parametrize("width", [80, 120, 200])
def test_looks_as_drawn(summary, golden, width):
    golden(f"info_{width}.txt", shown(capture_summary(summary), width))


def test_columns_come_in_with_the_width(summary):
    heads = [
        shown(capture_summary(summary), width).split("Link", 1)[1].splitlines()[0]
        for width in range(70, 200, 7)
    ]
    counts = [len(head.split()) for head in heads]
    assert counts[0] < counts[-1]
    assert all("Findings" in head and "Count" in head and "Rate" in head for head in heads)


def test_a_long_topic_is_cut_in_the_middle(summary):
    assert "/robot_1/grou…a_long_name/telemetry_pose" in shown(capture_summary(summary), 80)


def test_drops_are_an_error(summary):
    out = io.StringIO()
    view = capture_summary({**summary, "capture_drops": 1234})
    Console(file=out, width=120, force_terminal=True, color_system="standard", _environ={}).print(view)
    assert "\x1b[1;31m1,234 frames lost by the capture itself" in out.getvalue()


@pytest.mark.parametrize(
    ("kind", "told"), [("pcap", "unknown (pcap does not record them)"), ("mcap", "unknown")]
)
def test_drops_that_are_not_told_are_not_none(summary, kind, told):
    lines = shown(capture_summary({**summary, "kind": kind, "capture_drops": None})).splitlines()
    (line,) = (line for line in lines if line.startswith("drops"))
    assert line.split(None, 1)[1].rstrip() == told


def test_an_empty_capture(summary):
    nothing = {"datagrams": 0, "start_ns": 0, "end_ns": 0, "capture_drops": 0, "routes": [], "findings": {}}
    words = shown(capture_summary(nothing)).split()
    assert " ".join(words) == "packets 0 datagrams drops none by the capture"


def test_figures_of_a_single_packet_are_left_out(summary):
    line = next(line for line in shown(capture_summary(summary), 200).splitlines() if "SBN_SUB" in line)
    assert line.split() == ["SBN", "-", "SBN_SUB", "1", "1", "-", "-", "0", "0", "67"]


def test_departures_count_by_severity():
    some = {"checksum_absent": 600, "length_mismatch": 2, "truncated": 1, "cdr_invalid": 1000}
    assert departures(some).plain == "✗ 1,001 ! 2"


def test_findings_go_from_grave_to_frequent():
    counts = {"checksum_absent": 3, "sequence_unset": 600, "cdr_invalid": 1}
    lines = shown(findings(counts, 1000, meaning=False)).splitlines()[1:]
    assert [line.split()[1:] for line in lines] == [
        ["cdr_invalid", "1", "<1%"],
        ["sequence_unset", "600", "60%"],
        ["checksum_absent", "3", "<1%"],
    ]


def test_a_finding_of_a_later_version_is_shown():
    assert "made_of_cheese" in shown(findings({"made_of_cheese": 1}, 1))
