from __future__ import annotations

from xml.etree import ElementTree as ET

from edoras_tools.decode.lines import line_of
from edoras_tools.render.capture.info import capture_summary
from edoras_tools.render.capture.packet_list import PacketList
from edoras_tools.render.svg import terminal_picture


def test_a_picture_of_lines_and_tables(packets, summary):
    view = PacketList(100, colour=True)
    lines = [view.header(), *(view.line(line_of(item)) for item in packets.values())]
    svg = terminal_picture([*lines, capture_summary(summary)], width=100, title="edoras sniff")
    text = "".join(ET.fromstring(svg).itertext()).replace("\xa0", " ")
    assert "edoras sniff" in text
    assert "0x1827" in text
    assert "/robot_1" in text
    assert "@font-face" not in svg
    assert svg == terminal_picture([*lines, capture_summary(summary)], width=100, title="edoras sniff")


def test_long_lines_are_cut():
    svg = terminal_picture(["x" * 100, "[red]y"], width=20, title="t")
    text = "".join(ET.fromstring(svg).itertext())
    assert "x" * 20 in text
    assert "x" * 21 not in text
    assert "[red]y" in text
