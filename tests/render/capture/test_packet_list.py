from __future__ import annotations

import re

import pytest
from msgspec.structs import replace

from edoras_tools.decode.lines import line_of
from edoras_tools.model import NO_MSG_ID, Finding, Peer
from edoras_tools.render.capture.packet_list import PacketList
from edoras_tools.render.terminal.text import cells, plain_cells
from edoras_tools.wire import sbn
from edoras_tools.words import TimeFormat

WIDTHS = [80, 120, 160, 200]


def listing(packets, width, **options):
    view = PacketList(width, colour=False, **options)
    return [view.header(), *(view.line(line_of(item)) for item in packets.values())]


@pytest.mark.parametrize("width", WIDTHS)
def test_looks_as_drawn(packets, golden, width):
    golden(f"packet_list_{width}.txt", "\n".join(listing(packets, width)) + "\n")


@pytest.mark.parametrize("time_format", TimeFormat)
@pytest.mark.parametrize("width", [20, 40, 48, 63, 64, 79, 99, 100, 119, 120, 149, 150, 189, 190, 250])
def test_never_exceeds_the_width(packets, width, time_format):
    for line in listing(packets, width, time_format=time_format, verbose=True):
        assert cells(line) <= width
        assert line.isprintable()


@pytest.mark.parametrize("width", [80, 120, 200])
@pytest.mark.parametrize("shown", [(), ("time",), ("msg_id",), ("ports", "topic"), ("packet", "bytes")])
def test_columns_are_left_out_and_added(packets, width, shown):
    view = PacketList(width, colour=False, columns=shown, added=[("speed", True), ("name", False)])
    header = view.header()
    words = {"time": ["Time"], "msg_id": ["MsgId"], "topic": ["Topic"], "bytes": ["Bytes", "Len"]}
    words |= {"packet": ["Packet"], "ports": ["Ports", "Source"] if width >= 100 else []}
    for name, titles in words.items():
        assert any(title in header.split() for title in titles) == (name in shown and bool(titles))
    for item in packets.values():
        line = view.line(line_of(item), values=["1.5", "x"])
        assert cells(line) <= width
        if item.datagram.number < 100_000:  # a longer number moves the rest of its line
            assert line[: header.index("speed") + 5].endswith(" 1.5")
            assert line[header.index("name")] == "x"


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        ("0.5049979167", "0.504998"),
        ("-0.0123456789", "-0.01235"),
        ("1795241927192459", "1.8e+15"),
        ("12345678", "12345678"),
        ("0x0827 0x0828", "0x0827…"),
        ("-1.23456e-300", "-1e-300"),
    ],
)
def test_a_number_is_rounded_where_a_text_is_cut(packets, value, shown):
    view = PacketList(120, colour=False, columns=(), added=[("speed", True)])
    line = view.line(line_of(next(iter(packets.values()))), values=[value])
    assert line.split()[1] == shown


def test_columns_stand_under_their_names(packets):
    header, *lines = listing(packets, 120)
    assert {line[header.index("Packet")] for line in lines[:-1]} <= set("CTSU")
    assert lines[0][header.index("MsgId") :].startswith("0x1827")
    assert lines[0][: header.index("Bytes") + len("Bytes")].endswith(" 76")


def test_colour_only_where_wanted(packets):
    plain, painted = PacketList(120, colour=False), PacketList(120, colour=True)
    for item in packets.values():
        line, coloured = plain.line(line_of(item)), painted.line(line_of(item))
        assert "\x1b" not in line
        assert re.sub(r"\x1b\[[0-9;]*m", "", coloured).rstrip() == line
        assert plain_cells(coloured) <= 120
        assert "\x1b[" in coloured


def test_link_decides_the_colour(packets):
    view = PacketList(120, colour=True)
    seen = {
        re.search(r"\x1b\[(\d+)m(CI|TO|SBN|UDP) ", view.line(line_of(item))).groups()
        for item in packets.values()
    }
    assert {link for _, link in seen} == {"CI", "TO", "SBN", "UDP"}
    assert len({colour for colour, _ in seen}) == 4


def test_notes_show_only_when_asked_for(packets):
    assert "no checksum" not in PacketList(160, colour=False).line(line_of(packets["twist"]))
    assert "· no checksum" in PacketList(160, colour=False, verbose=True).line(line_of(packets["twist"]))


def test_gravest_finding_comes_first_and_the_rest_is_counted(packets):
    decoded = replace(packets["twist"], findings=Finding((1 << 27) - 1))
    line = PacketList(120, colour=False).line(line_of(decoded))
    assert re.search(r"✗ truncated( ✗ [^+]+)? \+\d+  linear", line)


@pytest.mark.parametrize(
    ("time_format", "expected"),
    [
        (TimeFormat.RELATIVE, ["0.000000", "1.250000", "2.500000"]),
        (TimeFormat.DELTA, ["0.000000", "1.250000", "1.250000"]),
        (TimeFormat.UTC, ["06:16:42.553538", "06:16:43.803538", "06:16:45.053538"]),
        (TimeFormat.EPOCH, ["1795241802.553538", "1795241803.803538", "1795241805.053538"]),
    ],
)
def test_tells_time(packets, time_format, expected):
    lines = listing(packets, 120, time_format=time_format)[1:]
    assert [line.split()[1] for line in lines[:3]] == expected


def test_date_where_there_is_room(packets):
    assert "2026-11-21 06:16:42.553538" in listing(packets, 200, time_format=TimeFormat.UTC)[1]


def test_long_numbers_take_room_from_the_message(packets):
    decoded = replace(packets["twist"], datagram=packets["twist"].datagram._replace(number=123_456_789))
    line = PacketList(80, colour=False).line(line_of(decoded))
    assert line.startswith("123456789 ")
    assert cells(line) <= 80


def test_why_it_stopped_stands_in_for_a_missing_summary(packets):
    assert "cfe_command at byte 6 needs 2 bytes" in PacketList(200, colour=False).line(
        line_of(packets["truncated"])
    )


def with_field(layer, name, **changed):
    """A layer whose field of that name is another."""
    fields = [item._replace(**changed) if item.name == name else item for item in layer.fields]
    return layer._replace(fields=tuple(fields))


def test_names_fill_in_where_decode_has_none(packets):
    decoded = replace(
        packets["event"], layers=(with_field(packets["event"].layers[0], "msg_id", text="0x0808"),)
    )
    assert "events" in PacketList(120, colour=False, names={0x808: "events"}).line(line_of(decoded))


def test_resize_lays_out_again(packets):
    view = PacketList(200, colour=False)
    wide = view.line(line_of(packets["event"]))
    view.resize(80)
    assert cells(view.line(line_of(packets["event"]))) <= 80 < cells(wide)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("twist", ("cmd", 0x1827, "/cmd_vel")),
        ("event", ("tlm", 0x0808, "EVS_LONG_EVENT")),
        ("subscriptions", ("SUB", NO_MSG_ID, "")),
        ("disconnect", ("DISCONNECT", NO_MSG_ID, "")),
        ("truncated", ("cmd", 0x1827, "/cmd_vel")),
    ],
)
def test_what_a_packet_is(packets, name, expected):
    line = line_of(packets[name])
    assert (line.kind, line.msg_id, line.name) == expected


def test_a_packet_inside_sbn_keeps_the_outer_kind(packets):
    twist, head = (
        packets["twist"],
        with_field(packets["disconnect"].layers[0], "msg_type", value=sbn.MsgType.APP),
    )
    data = sbn.emit(sbn.MsgType.APP, Peer(66, 1), twist.datagram.payload)
    inner = twist.layers[0]._replace(start=11, end=17)
    decoded = replace(twist, datagram=twist.datagram._replace(payload=data), layers=(head, inner))
    line = line_of(decoded)
    assert (line.kind, line.msg_id, line.name) == ("APP", 0x1827, "/cmd_vel")


def test_an_unknown_sbn_type_is_its_number(packets):
    data = sbn.emit(7, Peer(66, 3))
    decoded = packets["disconnect"]
    layers = (with_field(decoded.layers[0], "msg_type", value=7),)
    decoded = replace(decoded, datagram=decoded.datagram._replace(payload=data), layers=layers)
    assert line_of(decoded).kind == "0x07"
