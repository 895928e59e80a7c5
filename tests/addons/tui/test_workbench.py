"""What is done with packets that were found: copied, graphed, summed, judged, and filtered for."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
from places import ROOT
from rich.console import Console

from edoras_tools.addons.tui.lists.overviews import finding_rows, room_rows
from edoras_tools.addons.tui.navigation import joined_filter
from edoras_tools.addons.tui.store import WatchThread, _round_before, rate_figure
from edoras_tools.io.net.buffer import UdpSource
from edoras_tools.model import Endpoint
from edoras_tools.pipelines.workbench import Settings, open_files

BENCH = Settings([ROOT / "samples/missions/rover_ground.yaml"]).workbench()
OUT = 189
"""A packet to the robot, whose message is a Twist."""


async def step(hands, key, holds):
    """Press a key until something is so."""
    for _ in range(80):
        if holds():
            return
        await hands.press(key)
    raise AssertionError(key)


def room_text(hands):
    return "\n".join(row.text.plain for row in hands.app.room._rows)


def test_the_control_room_says_what_the_doctor_says(drive, call):
    capture = ROOT / "samples/captures/f_sbn_disconnect.pcap"
    missions = [f"-c{ROOT}/samples/missions/two_rovers_{side}.yaml" for side in ("ground", "flight")]
    doctor = json.loads(call("doctor", "--json", capture, *missions).out)

    async def script(hands):
        app = hands.app
        await hands.press("d")
        await hands.until(lambda: doctor["summary"]["headline"] in " ".join(room_text(hands).split()), "it")
        text = " ".join(room_text(hands).split())
        judged = app._watch.state()["doctor"]
        for name in ("lost", "unaccounted", "uncertain", "messages_lost", "messages_uncertain"):
            assert judged[name] == doctor[name], name
        for problem in doctor["summary"]["problems"]:
            if problem["severity"] != "note":
                assert problem["remedy"] is None or problem["remedy"].split("(")[0].strip() in text
        assert "From hop to hop" in text
        assert "at the end of the file" in text
        assert sum(row["count"] for row in app._watch.state()["routes"]) == 1544
        # A line leads to its packets.
        await step(hands, "j", lambda: app.room.filter == "link == ci and msg_id == 0x1827")
        await hands.press("enter")
        await hands.settle()
        assert len(app.store) == 185
        await hands.press("escape")
        assert app._view == "packet"

    drive(script, size=(120, 50))


def test_silence_is_said_within_three_seconds(drive):
    source = UdpSource([Endpoint("127.0.0.1", 0)])
    now = [10.0]

    async def script(hands):
        app = hands.app
        await hands.press("d")
        link = app._watch._monitor._link
        link.clock = lambda: now[0]
        await hands.until(lambda: "no traffic yet" in room_text(hands), "nothing came yet")
        for at, words in ((10.0, "● live"), (11.9, "● live"), (12.1, "silent for 2 s"), (75.0, "1 min 5 s")):
            link._heard, now[0] = 10.0, at
            app._update_lower()
            assert words in room_text(hands), at

    drive(script, source=source, follow=True)


def test_without_the_add_on_the_control_room_is_one_line(drive, monkeypatch):
    async def script(hands):
        monkeypatch.setattr("edoras_tools.doors.Addition.absent", True)
        await hands.press("d")
        assert "left out of this installation" in hands.status
        assert hands.app._view == "packet"

    drive(script)


STATE = {
    "time_ns": 10**18,
    "silent_s": 13.2,
    "datagrams": 600,
    "bytes_per_s": 2048,
    "rate_hz": 10.0,
    "kernel_drops": 4,
    "doctor": None,
    "routes": [
        {
            **dict.fromkeys(("passed_hz", "sent_hz", "name", "value")),
            **dict(
                zip(("link", "msg_id", "topic", "message"), ("to", "0x0827", "/pose", "cut"), strict=True)
            ),
            **dict(
                zip(("spacecraft", "level", "count", "lost", "uncertain"), (2, 2, 50, 18, 2), strict=True)
            ),
            "rate_hz": 0.0,
            "age_s": 13.2,
        }
    ],
    "events": [{"time_ns": 10**18, "level": 40, "app": "CFE_SB", "text": 'a "b"\x1b', "count": 40}],
}


def test_lines_of_the_control_room():
    rows = room_rows(STATE, 100, Console(), live=True)
    text = "\n".join(row.text.plain for row in rows)
    assert "silent for 13 s  10 datagrams/s, 2.0 KiB/s, 600 in all, 4 lost by this capture" in text
    for words in ("not judged yet", "/pose cut", "silent 13 s", "18 to 20", "\\x1b (40 times)"):
        assert words in text
    assert "\x1b" not in text
    filters = [row.filter for row in rows if row.filter]
    assert filters == [
        "link == to and msg_id == 0x0827 and spacecraft == 2",
        'cfe_event.message contains "a "',
    ]
    for width in (80, 200):
        assert all(row.text.cell_len <= width for row in room_rows(STATE, width, Console(), live=True))
    assert "at the end of the file" in room_rows(STATE, 80, Console(), live=False)[0].text.plain


def test_blocks_reach_the_monitor_in_order():
    calls = []
    block = lambda number: SimpleNamespace(batch=number, columns=-number)  # noqa: E731
    monitor = SimpleNamespace(
        add=lambda batch, columns: calls.append((batch, columns)),
        finish=lambda: calls.append("end"),
        close=lambda: calls.append("closed"),
        state=lambda: len(calls),
    )
    thread = WatchThread(monitor, [block(1), block(2)])
    thread.put(block(3))
    thread.put(None)
    thread.start()
    thread.stop()
    thread.join()
    assert calls[-2:] == ["end", "closed"]
    assert calls[:-2] == [(1, -1), (2, -2), (3, -3)][: len(calls) - 2]
    assert thread.state() == len(calls)


@pytest.mark.parametrize(
    ("before", "joined", "whole"),
    [
        ("", "", "b == 2"),
        ("a", "and ", "a and b == 2"),
        ("a or c", "and ", "(a or c) and b == 2"),
        ("a or c", "or ", "a or c or b == 2"),
        ("a", "and not ", "a and not b == 2"),
        ("", "and not ", "not b == 2"),
        ("", "or ", "b == 2"),
    ],
)
def test_a_filter_takes_another_condition(before, joined, whole):
    assert joined_filter(before, joined, "b == 2") == whole


def test_values_make_filters_that_escape_gives_back(drive):
    async def script(hands):
        app = hands.app
        line = app.filter_line
        await hands.go(OUT)
        await hands.press("enter")
        assert app.layers.choose_byte(2)
        await hands.press("equals_sign", "enter")
        await hands.settle()
        assert line.applied == line.input.value == "sbn.msg_type == 3"
        shown = len(app.store)
        app.layers.focus()
        assert app.layers.choose_byte(3)
        await hands.press("exclamation_mark")
        assert line.input.value == "sbn.msg_type == 3 and not sbn.processor_id == 1"
        app._refresh_status()
        assert str(line.count.render()) == "Enter applies"
        await hands.press("escape")
        assert line.input.value == line.applied == "sbn.msg_type == 3"
        assert len(app.store) == shown
        # What was not applied is not lost: it is the latest of the history.
        await hands.press("f", "up")
        assert line.input.value.endswith("and not sbn.processor_id == 1")
        await hands.press("up")
        assert line.input.value == "sbn.msg_type == 3"
        await hands.press("down", "enter")
        await hands.settle()
        assert 0 < len(app.store) < shown

    drive(script)


@pytest.mark.long
def test_both_directions_of_a_conversation(drive):
    async def script(hands):
        app = hands.app
        await hands.go(OUT)
        ports = {app.decoded.datagram.source.port, app.decoded.datagram.destination.port}
        await hands.press("C")
        await hands.settle()
        assert hands.number == OUT
        pairs = {
            (int(block.batch.source_port[row]), int(block.batch.destination_port[row]))
            for block, _, rows in app.store.parts()
            for row in rows
        }
        assert pairs == {tuple(sorted(ports)), tuple(sorted(ports, reverse=True))}

    drive(script)


@pytest.mark.long
def test_times_count_from_a_packet(drive):
    async def script(hands):
        app = hands.app
        await hands.go(OUT)
        whole = app.store.time_ns(app.packets.cursor) - app.store.begin_ns
        await hands.press("ctrl+t")
        lines = hands.lines(app.packets)
        at = app.packets.cursor - app.packets.scroll_offset.y
        assert lines[at].split()[:3] == ["⌖", str(OUT), "0.000000"]
        after = app.store.time_ns(app.packets.cursor + 1) - app.store.begin_ns - whole
        assert lines[at + 1].split()[1] == f"{after / 1e9:.6f}"
        before = app.store.time_ns(app.packets.cursor - 1) - app.store.begin_ns
        assert lines[at - 1].split()[1] == f"{before / 1e9:.6f}"
        await hands.press("ctrl+t")
        assert hands.lines(app.packets)[at].split()[1] == f"{whole / 1e9:.6f}"

    drive(script)


def test_what_is_selected_is_copied(drive):
    async def script(hands):
        app = hands.app
        await hands.go(OUT)
        await hands.press("enter")
        assert app.layers.choose_byte(3)
        for key, text in {
            "v": "1",
            "f": "processor_id: 1",
            "x": "00 00 00 01",
            "equals_sign": "sbn.processor_id == 1",
        }.items():
            await hands.press("y")
            await hands.pilot.press(key)
            await hands.until(lambda text=text: app.clipboard == text, key)
        await hands.press("y", "escape")
        assert app.clipboard == "sbn.processor_id == 1"
        app.packets.focus()
        await hands.press("y", "l")
        await hands.until(lambda: app.clipboard.startswith(f"{OUT} "), "the line")

    drive(script)


@pytest.mark.long
def test_a_field_is_graphed_by_topic(drive):
    async def script(hands):
        app = hands.app
        await hands.filter("pose.position.x > -1000")
        await hands.settle()
        await hands.press("enter")
        await step(hands, "j", lambda: app.layers.field_name == "pose.position.x")
        values = [
            app._bench.dissector.dissect(app.store.datagram(row)).message.values["pose"]["position"]["x"]
            for row in range(len(app.store))
        ]
        await hands.press("p")
        await hands.until(lambda: app.graph._figure is not None, "the graph")
        (panel,) = app.graph._figure.panels
        assert [line.label for line in panel.lines] == ["to /robot_1/ground/pose", "sbn /robot_1/pose"]
        assert sum(line.read for line in panel.lines) == len(values)
        least, most, mean = min(values), max(values), sum(values) / len(values)
        assert f"{len(values):,} values, {least:g} to {most:g}, mean {mean:g}" in panel.title
        await hands.press("escape")
        app.layers.focus()
        await hands.rest()
        await step(hands, "k", lambda: app.layers.field_name == "header.frame_id")
        await hands.press("p")
        await hands.until(lambda: "no number in" in hands.lines(app.graph)[0], "a text has no graph")

    drive(script)


def test_routes_findings_and_sums_are_those_of_the_filter(drive):
    async def script(hands):
        app = hands.app
        await hands.filter("link == sbn and msg_id == 0x1829")
        await hands.settle()
        await hands.press("r")
        await hands.until(lambda: app.routes.rows() == 1, "one route")
        assert app.routes._rows[0]["count"] == 107
        await hands.press("i")
        rows = [row.text.plain.split() for row in app.sums._rows]
        assert ["packets", "1,544", "107"] in rows
        assert ["SBN", "548", "107"] in rows
        await hands.press("e")
        shown = {row.filter.partition(" == ")[2] for row in app.findings._rows}
        assert shown == set(app.routes.ledger.findings) < set(app.ledger.findings)
        await hands.filter("")
        await hands.settle()
        await hands.until(lambda: len({row.filter for row in app.findings._rows}) == len(app.ledger.findings))
        await hands.press("r")
        await hands.until(lambda: app.routes.rows() > 10, "all routes")

    drive(script)


def test_findings_are_listed_by_their_severity():
    rows = finding_rows({"sequence_unset": 900, "length_mismatch": 2, "truncated": 1}, 60)
    assert list(dict.fromkeys(row.filter.partition(" == ")[2] for row in rows)) == [
        "truncated",
        "length_mismatch",
        "sequence_unset",
    ]
    assert all(row.text.cell_len <= 60 for row in rows)
    assert "no packet" in finding_rows({}, 60)[0].text.plain


def test_rounds_are_spread_over_the_time_before_them():
    rounds = np.repeat(np.arange(1, 9) * 0.5, 3) + np.tile([0, 0.001, 0.002], 8)
    before = _round_before(rounds)
    assert before.tolist() == pytest.approx(np.repeat(np.arange(8) * 0.5, 3).tolist())
    silence = np.append(rounds, 30.0)
    assert _round_before(silence)[-1] == pytest.approx(30 - 1.5 * 0.5), "what came before it is not spread"
    steady = np.arange(100) * 0.11
    assert _round_before(steady).tolist() == pytest.approx((steady - 0.11).tolist())
    assert _round_before(np.array([1.0, 2.0])).tolist() == [1.0, 2.0]


def test_rates_of_telemetry_are_even():
    """Twice a second four messages: 8 Hz, and not 0 and 40."""
    source = open_files([ROOT / "samples/captures/a_rover.pcap"])
    blocks = [SimpleNamespace(batch=batch, columns=BENCH.columns.decode(batch)) for batch in source.batches()]
    source.close()
    begin_ns = int(blocks[0].batch.time_ns[0])
    parts = [(block, 0, np.flatnonzero(block.columns.msg_id == 0x827)) for block in blocks]
    for bars, width in ((60, 2), (400, 0.2)):
        figure = rate_figure(parts, BENCH.columns.context, begin_ns, lambda: False, bars)
        (panel,) = figure.panels
        assert f"mean over {width:g} s" in panel.title
        (line,) = panel.lines
        assert (line.label, line.read) == ("to /telemetry_pose", 63)
        inner = line.values[(line.seconds > 5) & (line.seconds < 60)]
        assert inner.mean() == pytest.approx(1, rel=0.1)
        assert inner.max() < 2.6, "one a second, however short the bars are"


@pytest.mark.long
def test_one_pane_keeps_its_titles(drive):
    async def script(hands):
        app = hands.app
        await hands.press("s")
        await hands.until(lambda: app.sequence.rows() > 10, "it is drawn")
        low = app.sequence.size.height
        await hands.press("z")
        await hands.until(lambda: app.sequence.size.height > low + 10, "it fills the screen")
        heads = app.screen.query_one("#sequence-heads")
        assert heads.region.height == 1
        assert "66:1" in heads.render().plain
        assert not app.packets.region.height
        await hands.press("z")
        await hands.until(lambda: app.packets.region.height > 5, "all panes again")

    drive(script)


def test_the_status_names_the_file_and_what_was_dropped(drive):
    async def script(hands):
        app = hands.app
        assert "f_sbn_disconnect.pcap" in hands.status
        assert "dropped" not in app._figures().plain, "a pcap does not say"
        for drops in (0, 7):
            app._source.statistics.kernel_drops = drops
            assert f"{drops} dropped" in app._figures().plain

    drive(script)
